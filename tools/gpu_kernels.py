"""The GPU backend's kernels as a table: registers, instructions, threads that run at once.

python -m tools.gpu_kernels [FOLDER] renders small views with interpreted kernels, compiles every
kernel that they launched for a Hopper GPU, and prints Markdown; into the folder go PTX and
disassembly. It needs no GPU, and times nothing. Where a kernel is not as it should be, it says why
and exits with 1.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Collection, Sequence
from pathlib import Path

from tqdm import tqdm

from tools.kernel_compiling import Compiled, compile_launches
from tools.kernel_launches import Recording, recorded_launches

HEADER = (
    "| kernel | variant | programs | registers | stack | shared | instructions | occupancy |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- |"
)


def record_views(names: Collection[str] | None = None, *, progress: bool = False) -> Recording:
    """What small views launch; all of `tools.kernel_frames` by default. Kernels are interpreted.

    Raises:
        RuntimeError: they are not (set TRITON_INTERPRET=1 before anything is imported).
    """
    from tools.kernel_frames import views

    with recorded_launches() as recording:
        every = views()
        for name in tqdm(names or every, "views", disable=not progress):
            every[name]()
    return recording


def report(recording: Recording, *, dump: Path | None = None) -> tuple[str, list[Compiled]]:
    """The table of all that was recorded, and what it was made of."""
    launches = sorted(recording.counts, key=lambda each: (each.name, each.given))
    compiled = compile_launches(launches, dump=dump, count=True)
    rows = [
        f"| `{launch.name}` | {variant} | {recording.programs[launch]} "
        f"in {recording.counts[launch]} | {_measures(made)} |"
        for launch, made, variant in zip(launches, compiled, _variants(launches), strict=True)
    ]
    return "\n".join([HEADER, *rows]), compiled


def complaints(compiled: Sequence[Compiled]) -> list[str]:
    """What no kernel of the backend may do: fail, spill registers, compute in float64, or leave
    the order of its sums to chance.
    """
    out = []
    for each in compiled:
        if each.error is not None:
            out.append(f"{each.kernel} does not compile: {each.error}; given {each.given}")
        if each.stack_bytes:
            out.append(f"{each.kernel} spills {each.stack_bytes} bytes; given {each.given}")
        if each.doubles:
            out.append(f"{each.kernel}: {each.doubles} float64 instructions; given {each.given}")
        if each.atomics:
            out.append(f"{each.kernel}: atomics {', '.join(each.atomics)}; given {each.given}")
    return out


def _measures(made: Compiled) -> str:
    if made.error is not None:
        return f"{made.error.splitlines()[0]} | | | | "
    return (
        f"{made.registers} | {made.stack_bytes} | {made.shared_bytes} | {made.instructions} | "
        f"{made.occupancy:.0%}"
    )


def _variants(launches: Sequence) -> list[str]:
    """What tells each launch from others of the same kernel."""
    out = []
    for launch in launches:
        others = [each.arguments for each in launches if each.kernel == launch.kernel]
        own = launch.arguments
        differing = [n for n in own if any(each.get(n, own[n]) != own[n] for each in others)]
        out.append(", ".join(f"{name} {_short(own[name])}" for name in differing))
    return out


def _short(given: object) -> str:
    match given:
        case {"tensor": dtype, "aligned": aligned}:
            return str(dtype) if aligned else f"{dtype} unaligned"
        case None:
            return "none"
    return str(given)


def _main(folder: str | None = None) -> int:
    os.environ["TRITON_INTERPRET"] = "1"
    recording = record_views(progress=True)
    table, compiled = report(recording, dump=None if folder is None else Path(folder))
    print(table)
    wrong = complaints(compiled)
    print("\n".join(wrong), file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:2]))
