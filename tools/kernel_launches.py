"""Which Triton kernels a piece of work launches, and with what, seen while they are interpreted.

Triton compiles a kernel anew for other types, other constants, and where a number is 1 or a
multiple of 16. Launches that would run the same compiled kernel are one here.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import torch

ALIGNED = 16  # bytes of an address, and what a number is a multiple of, where Triton knows it
# How wide a number's type is follows from its size; within one, it is 1, a multiple or neither.
_SMALL, _LARGE = (1, 16, 17), (2**40, 2**40 + 1)


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


@dataclass
class Recording:
    """counts: how often each was launched. programs: how many of each there were in all."""

    counts: dict[Launch, int] = field(default_factory=dict)
    programs: dict[Launch, int] = field(default_factory=dict)

    def add(self, launch: Launch, programs: int) -> None:
        self.counts[launch] = self.counts.get(launch, 0) + 1
        self.programs[launch] = self.programs.get(launch, 0) + programs


@contextmanager
def recorded_launches() -> Iterator[Recording]:
    """Within it every launch is noted before it is interpreted.

    Raises:
        RuntimeError: kernels are not interpreted (set TRITON_INTERPRET=1 before they are imported).
    """
    from triton.runtime.interpreter import InterpretedFunction

    from augment.render.cuda.runtime import is_interpreted

    if not is_interpreted():
        raise RuntimeError("launches are recorded while kernels are interpreted only")
    recording, run = Recording(), InterpretedFunction.run

    def noted(kernel: Any, *args: Any, grid: tuple[int, ...], warmup: bool, **named: Any) -> Any:
        programs = 1
        for count in grid:
            programs *= count
        recording.add(_launch(kernel, args, named), programs)
        return run(kernel, *args, grid=grid, warmup=warmup, **named)

    with patch.object(InterpretedFunction, "run", noted):
        yield recording


def _launch(kernel: Any, args: tuple[Any, ...], named: dict[str, Any]) -> Launch:
    given = dict(zip(kernel.arg_names, args, strict=False)) | named
    parameters = inspect.signature(kernel.fn).parameters
    unspecialized = kernel.kwargs.get("do_not_specialize") or ()
    described = {}
    for place, (name, parameter) in enumerate(parameters.items()):
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
