"""Triton kernels compiled for a GPU that need not be there, and what became of them.

Runs in processes of its own (`python -m tools.kernel_compiling` reads launches and writes results,
both JSON): whether kernels are compiled or interpreted is settled where they are imported.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tools.kernel_launches import Launch

HOPPER = 90  # compute capability 9.0
# Of one of its processors.
_REGISTERS, _THREADS, _BLOCKS, _SHARED_BYTES = 65536, 2048, 32, 227 * 1024


@dataclass(frozen=True)
class Compiled:
    """A kernel in the GPU's own instructions; or, in `error`, why there is none.

    stack_bytes: of a thread, in slow memory: what did not fit into registers. atomics: PTX
    instructions that would make a result depend on the order of programs. doubles: how many PTX
    instructions compute in float64. instructions: all of the kernel's, None where not counted.
    """

    kernel: str
    given: str
    error: str | None = None
    registers: int = 0
    stack_bytes: int = 0
    shared_bytes: int = 0
    warps: int = 0
    doubles: int = 0
    atomics: tuple[str, ...] = ()
    instructions: int | None = None

    @property
    def occupancy(self) -> float:
        """The share of a processor's threads that can be there at once."""
        # Registers are handed out to warps in steps of 8 a thread, to 4 warps at a time.
        each = max(-(-self.registers // 8) * 8, 8) * 32
        blocks = _REGISTERS // each // 4 * 4 // self.warps
        if self.shared_bytes:
            blocks = min(blocks, _SHARED_BYTES // (self.shared_bytes + 1024))
        return min(blocks, _BLOCKS, _THREADS // (32 * self.warps)) * self.warps * 32 / _THREADS


def compile_launches(
    launches: Sequence[Launch],
    *,
    processes: int | None = None,
    dump: Path | None = None,
    count: bool = False,
) -> list[Compiled]:
    """Every kernel compiled as these launches would have it on a Hopper GPU, in their order.

    dump: a folder that gets PTX and disassembly. count: count the instructions, too.

    Raises:
        RuntimeError: a compiling process failed altogether; the message is what it wrote.
    """
    if not launches:
        return []
    processes = min(processes or os.cpu_count() or 1, len(launches))
    asked = {"dump": None if dump is None else str(dump.resolve()), "count": count}
    # By name: variants of a kernel share what a process has parsed.
    order = sorted(range(len(launches)), key=lambda i: launches[i].kernel)
    shares = [order[first::processes] for first in range(processes)]

    def run(share: list[int]) -> list[Compiled]:
        return _run_apart({**asked, "launches": [asdict(launches[i]) for i in share]})

    with ThreadPoolExecutor(processes) as pool:
        results = pool.map(run, shares)
        found = {
            i: made
            for share, compiled in zip(shares, results, strict=True)
            for i, made in zip(share, compiled, strict=True)
        }
    return [found[i] for i in range(len(launches))]


def _run_apart(request: dict[str, Any]) -> list[Compiled]:
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    done = subprocess.run(
        [sys.executable, "-m", "tools.kernel_compiling"],
        input=json.dumps(request),
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        cwd=Path(__file__).resolve().parents[1],
    )
    if done.returncode != 0:
        raise RuntimeError(f"compiling kernels failed:\n{done.stderr.strip()}")
    results = json.loads(done.stdout.splitlines()[-1])
    return [Compiled(**{**each, "atomics": tuple(each["atomics"])}) for each in results]


class _Hopper:
    """What Triton asks of a driver before it compiles."""

    def get_current_target(self) -> Any:
        from triton.backends.compiler import GPUTarget

        return GPUTarget("cuda", HOPPER, 32)

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return 0


class _Pointer:
    """What Triton asks of a tensor before it compiles."""

    def __init__(self, dtype: str, aligned: bool) -> None:
        import torch

        self.dtype, self._aligned = getattr(torch, dtype), aligned

    def data_ptr(self) -> int:
        return 0 if self._aligned else 4

    def ptr_range(self) -> int:
        return 0


def _compile(launch: Launch, dump: Path | None, count: bool) -> Compiled:
    try:
        arguments = {name: _value(given) for name, given in launch.arguments.items()}
        kernel = _found(launch.kernel).warmup(grid=(1,), **arguments)
    except Exception as error:
        return Compiled(launch.kernel, launch.given, error=f"{type(error).__name__}: {error}")
    ptx, cubin = kernel.asm["ptx"], kernel.asm["cubin"]
    disassembly = None
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        usage = _cuobjdump("-res-usage", file.name)
        if count or dump is not None:
            disassembly = _cuobjdump("-sass", file.name)
    if dump is not None and disassembly is not None:
        _write(dump, launch, ptx, disassembly)
    registers = re.search(r"REG:(\d+) STACK:(\d+)", usage)
    assert registers is not None, usage
    return Compiled(
        launch.kernel,
        launch.given,
        registers=int(registers[1]),
        stack_bytes=int(registers[2]),
        shared_bytes=kernel.metadata.shared,
        warps=kernel.metadata.num_warps,
        doubles=len(re.findall(r"^\s*(?:@\S+ )?(?!ld|st|mov)\S*\.f64\b", ptx, re.MULTILINE)),
        atomics=tuple(sorted(set(re.findall(r"\b(?:atom|red)\.\S+", ptx)))),
        instructions=None
        if disassembly is None
        else len(re.findall(r"^\s*/\*[0-9a-f]{4,}\*/\s+(?!NOP)\S", disassembly, re.MULTILINE)),
    )


def _found(kernel: str) -> Any:
    module, _, name = kernel.partition(":")
    return getattr(importlib.import_module(module), name)


def _value(given: Any) -> Any:
    from triton.language import dtype

    match given:
        case {"tensor": name, "aligned": aligned}:
            return _Pointer(name, aligned)
        case {"dtype": name}:
            return dtype(name)
        case {"tuple": values}:
            return tuple(_value(each) for each in values)
        case {"kernel": kernel}:
            return _found(kernel)
    return given


def _write(folder: Path, launch: Launch, ptx: str, disassembly: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    number = len(list(folder.glob(f"{launch.name}.*.ptx")))
    (folder / f"{launch.name}.{number}.json").write_text(launch.given)
    (folder / f"{launch.name}.{number}.ptx").write_text(ptx)
    (folder / f"{launch.name}.{number}.sass").write_text(disassembly)


def _cuobjdump(*arguments: str) -> str:
    import triton

    program = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    return subprocess.run(
        [str(program), *arguments], capture_output=True, text=True, check=True
    ).stdout


def _main() -> None:
    from triton.runtime.driver import driver

    driver.set_active(_Hopper())  # type: ignore[arg-type]
    request = json.load(sys.stdin)
    dump = None if request["dump"] is None else Path(request["dump"])
    launches = [Launch(**each) for each in request["launches"]]
    print(json.dumps([asdict(_compile(each, dump, request["count"])) for each in launches]))


if __name__ == "__main__":
    _main()
