"""Memory that rendering one frame takes on top of its scene, measured in a process of its own.

A process that has rendered before holds scratch memory that would hide the need of the next frame.
So a fresh one builds the scene, compiles, notes its resident size, resets the kernel's high-water
mark, renders once, and reads the mark: the frame's buffers and images and all scratch are in it,
Python, torch, compiled kernels and the scene are not.
"""

from __future__ import annotations

import ctypes
import dataclasses
import gc
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools.bench_scene import RasterCase

_STATUS, RESET_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_extra_mib(case: RasterCase) -> float | None:
    """MiB above the scene at the highest moment of one clear frame; None where /proc is missing.

    Raises:
        RuntimeError: the measuring process failed; the message is what it wrote.
    """
    if not (_STATUS.is_file() and RESET_PEAK.is_file()):
        return None
    return measured_apart("tools.bench_memory", dataclasses.asdict(case), case.name)


def measured_apart(module: str, arguments: dict[str, Any], what: str) -> float:
    """The number that `python -m module JSON` prints last.

    Raises:
        RuntimeError: the process failed; the message is what it wrote.
    """
    done = subprocess.run(
        [sys.executable, "-m", module, json.dumps(arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).resolve().parents[1],
    )
    if done.returncode != 0:
        raise RuntimeError(f"measuring the memory of {what} failed:\n{done.stderr.strip()}")
    return float(done.stdout.strip().splitlines()[-1])


def _render_once(case: RasterCase) -> float:
    from augment.render.buffers import ALPHA, RGB
    from augment.render.constants import RasterSettings
    from augment.render.cpu.driver import rasterize_cpu, warm_up
    from augment.scene import PosedGaussians
    from tools.bench_scene import random_scene

    warm_up()
    gaussians, camera = random_scene(case)
    parts, buffers = [PosedGaussians(gaussians)], frozenset({RGB, ALPHA})
    return extra_mib(lambda: rasterize_cpu(parts, camera, buffers, RasterSettings(), None))


def extra_mib(action: Callable[[], object]) -> float:
    """MiB that this process takes at the highest moment of an action, above what it holds before;
    what the action returns counts.
    """
    gc.collect()
    return_free_memory()
    before = status_mib("VmRSS")
    RESET_PEAK.write_text("5")
    kept = action()
    highest = status_mib("VmHWM")
    del kept  # alive until the mark was read
    return highest - before


def return_free_memory() -> None:
    """Give freed heap back to the system, or what building the scene left would hide the frame's.

    glibc keeps up to 64 MiB; elsewhere nothing is done.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def status_mib(field: str) -> float:
    for line in _STATUS.read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError(f"{_STATUS} has no {field}")


if __name__ == "__main__":
    print(_render_once(RasterCase(**json.loads(sys.argv[1]))))
