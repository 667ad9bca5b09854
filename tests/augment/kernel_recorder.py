"""The kernels that tests launch, compiled: python -m tests.augment.kernel_recorder PYTEST-ARGUMENTS

For whoever works on a kernel: its tests run interpreted, then each kernel that they launched is
compiled for a Hopper GPU and reported. With KERNEL_DUMP=FOLDER its PTX and disassembly lie there.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ["TRITON_INTERPRET"] = "1"

import pytest

from tools.gpu_kernels import complaints, report
from tools.kernel_launches import recorded_launches


def main() -> int:
    with recorded_launches() as recording:
        failed = pytest.main(["-q", *sys.argv[1:]])
    folder = os.environ.get("KERNEL_DUMP")
    table, compiled = report(recording, dump=None if folder is None else Path(folder))
    print(table)
    wrong = complaints(compiled)
    print("\n".join(wrong))
    return int(failed) or bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
