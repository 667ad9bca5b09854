"""Which Triton kernels a piece of work launches, and what they compile into for a Hopper GPU that
need not be there.

Triton compiles a kernel anew for other types, other constants, and where a number is 1 or a
multiple of 16. Launches that would run the same compiled kernel are one here. Kernels are recorded
while they are interpreted and compiled in processes of their own (`python -m` this module reads
launches and writes results, both JSON): which of the two is settled where they are imported.
"""

from __future__ import annotations

import importlib
import inspect
import json
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

ALIGNED = 16  # bytes of an address, and what a number is a multiple of, where Triton knows it
# How wide a number's type is follows from its size; within one, it is 1, a multiple or neither.
_SMALL, _LARGE = (1, 16, 17), (2**40, 2**40 + 1)
_HOPPER = 90  # compute capability 9.0


@dataclass(frozen=True)
class Launch:
    """What has its own compiled kernel. kernel: "module:name". given: its parameters, as JSON."""

    kernel: str
    given: str

    @property
    def arguments(self) -> dict[str, Any]:
        return json.loads(self.given)

    @property
    def name(self) -> str:
        return self.kernel.partition(":")[2]


@dataclass(frozen=True)
class Compiled:
    """A kernel in the GPU's own instructions; or, in `error`, why there is none.

    stack_bytes: of a thread, in slow memory: what did not fit into registers. atomics: PTX
    instructions that would make a result depend on the order of programs. doubles: how many PTX
    instructions compute in float64.
    """

    kernel: str
    given: str
    error: str | None = None
    registers: int = 0
    stack_bytes: int = 0
    doubles: int = 0
    atomics: Sequence[str] = ()


def complaints(compiled: Sequence[Compiled]) -> list[str]:
    """What no kernel of the backend may do: fail, spill registers, compute in float64, or leave
    the order of its sums to chance.
    """
    wrong = []
    for each in compiled:
        for what, found in (
            ("does not compile", each.error),
            ("spills bytes", each.stack_bytes),
            ("has float64 instructions", each.doubles),
            ("has atomics", each.atomics),
        ):
            if found:
                wrong.append(f"{each.kernel} {what}: {found}; given {each.given}")
    return wrong


# ---- recording ----------------------------------------------------------------------------------


@contextmanager
def recorded_launches() -> Iterator[Counter[Launch]]:
    """Within it every launch is counted before it is interpreted."""
    from triton.runtime.interpreter import InterpretedFunction

    from augment.render.cuda.runtime import is_interpreted

    assert is_interpreted(), "launches are recorded while kernels are interpreted only"
    counts: Counter[Launch] = Counter()
    run = InterpretedFunction.run

    def noted(kernel: Any, *args: Any, grid: tuple[int, ...], warmup: bool, **named: Any) -> Any:
        counts[_launch(kernel, args, named)] += 1
        return run(kernel, *args, grid=grid, warmup=warmup, **named)

    with patch.object(InterpretedFunction, "run", noted):
        yield counts


def _launch(kernel: Any, args: tuple[Any, ...], named: dict[str, Any]) -> Launch:
    given = dict(zip(kernel.arg_names, args, strict=False)) | named
    unspecialized = kernel.kwargs.get("do_not_specialize") or ()
    described = {}
    for place, (name, parameter) in enumerate(inspect.signature(kernel.fn).parameters.items()):
        value = given.pop(name, parameter.default)
        exact = "constexpr" in str(parameter.annotation)
        general = name in unspecialized or place in unspecialized
        described[name] = _described(value, exact=exact, general=general)
    described |= {name: _described(value, exact=True) for name, value in sorted(given.items())}
    return Launch(f"{kernel.fn.__module__}:{kernel.fn.__qualname__}", json.dumps(described))


def _described(value: Any, *, exact: bool = False, general: bool = False) -> Any:
    """A value as JSON; of numbers that are no constants, one that stands for all of their kind."""
    from triton.language import constexpr, dtype

    if isinstance(value, constexpr):
        value = value.value
    if isinstance(value, torch.Tensor):
        aligned = value.data_ptr() % ALIGNED == 0
        return {"tensor": str(value.dtype).removeprefix("torch."), "aligned": aligned}
    if isinstance(value, dtype):
        return {"dtype": value.name}
    if isinstance(value, tuple):
        return {"tuple": [_described(each, exact=exact, general=general) for each in value]}
    if hasattr(value, "arg_names"):
        return {"kernel": f"{value.fn.__module__}:{value.fn.__qualname__}"}
    if value is None or isinstance(value, bool | str) or exact:
        return value
    if isinstance(value, int):
        one, multiple, other = _SMALL
        if not -(2**31) <= value < 2**31:
            return _LARGE[0] if value % ALIGNED == 0 and not general else _LARGE[1]
        if general:
            return other
        return one if value == 1 else multiple if value % ALIGNED == 0 else other
    return 0.5  # whatever the float is


# ---- compiling ----------------------------------------------------------------------------------


def compile_launches(launches: Sequence[Launch]) -> list[Compiled]:
    """Every kernel compiled as these launches would have it on a Hopper GPU, in their order."""
    processes = min(os.cpu_count() or 1, len(launches))
    # By name: variants of a kernel share what a process has parsed.
    order = sorted(range(len(launches)), key=lambda i: launches[i].kernel)
    shares = [order[first::processes] for first in range(processes)]
    with ThreadPoolExecutor(max(processes, 1)) as pool:
        results = pool.map(lambda share: _compile_in_process([launches[i] for i in share]), shares)
        found = {i: c for own, result in zip(shares, results, strict=True)
                 for i, c in zip(own, result, strict=True)}  # fmt: skip
    return [found[i] for i in range(len(launches))]


def _compile_in_process(launches: Sequence[Launch]) -> list[Compiled]:
    done = subprocess.run(
        [sys.executable, "-m", __spec__.name],
        input=json.dumps([asdict(launch) for launch in launches]),
        capture_output=True,
        text=True,
        check=False,
        env={k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"},
        cwd=Path(__file__).resolve().parents[2],
    )
    assert done.returncode == 0, f"compiling kernels failed:\n{done.stderr.strip()}"
    return [Compiled(**each) for each in json.loads(done.stdout.splitlines()[-1])]


class _Hopper:
    """What Triton asks of a driver before it compiles."""

    def get_current_target(self) -> Any:
        from triton.backends.compiler import GPUTarget

        return GPUTarget("cuda", _HOPPER, 32)

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return 0


class _Pointer:
    """What Triton asks of a tensor before it compiles."""

    def __init__(self, dtype: str, aligned: bool) -> None:
        self.dtype, self._aligned = getattr(torch, dtype), aligned

    def data_ptr(self) -> int:
        return 0 if self._aligned else 4

    def ptr_range(self) -> int:
        return 0


def _compile(launch: Launch) -> Compiled:
    try:
        arguments = {name: _value(given) for name, given in launch.arguments.items()}
        kernel = _found(launch.kernel).warmup(grid=(1,), **arguments)
    except Exception as error:
        return Compiled(launch.kernel, launch.given, error=f"{type(error).__name__}: {error}")
    ptx = kernel.asm["ptx"]
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(kernel.asm["cubin"])
        file.flush()
        usage = _cuobjdump("-res-usage", file.name)
    registers = re.search(r"REG:(\d+) STACK:(\d+)", usage)
    assert registers is not None, usage
    return Compiled(
        launch.kernel,
        launch.given,
        registers=int(registers[1]),
        stack_bytes=int(registers[2]),
        doubles=len(re.findall(r"^\s*(?:@\S+ )?(?!ld|st|mov)\S*\.f64\b", ptx, re.MULTILINE)),
        atomics=sorted(set(re.findall(r"\b(?:atom|red)\.\S+", ptx))),
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


def _cuobjdump(*arguments: str) -> str:
    import triton

    program = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    run = subprocess.run([str(program), *arguments], capture_output=True, text=True, check=True)
    return run.stdout


def _main() -> None:
    from triton.runtime.driver import driver

    driver.set_active(_Hopper())  # type: ignore[arg-type]
    launches = [Launch(**each) for each in json.load(sys.stdin)]
    print(json.dumps([asdict(_compile(each)) for each in launches]))


if __name__ == "__main__":
    _main()
