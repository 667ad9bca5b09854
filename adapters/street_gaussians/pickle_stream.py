"""Arrays by number out of a pickled dictionary, one at a time, without running what it asks for.

NumPy pickles a dictionary of arrays as a program that names a handful of its own functions. Here
that program is followed, never run: names only stand for what they mean, arrays are made of checked
headers and the bytes that follow, and each is handed over and forgotten before the next is read, so
that a file of many gigabytes passes through little memory.
"""

from __future__ import annotations

import math
import pickletools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np

MAX_ARRAY_BYTES = 1 << 27  # a sweep of 200,000 points takes 5 MB
MAX_BYTES = 1 << 35
_MAX_LINE = 1 << 12
_MAX_STEPS = 1 << 18  # of the program; a frame takes twenty
_MOST_TEXT = 1 << 12
_MEMO_BYTES = 1 << 10  # longer bytes are an array's own and nothing refers back to them
_DTYPE = re.compile(r"[fiu][1248]|b1|O8?")

_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_MEANINGS = {
    **{(module, "_reconstruct"): "array" for module in _MULTIARRAY},
    **{(module, "scalar"): "scalar" for module in _MULTIARRAY},
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
}


class PickleStreamError(ValueError):
    """The pickle holds something else than arrays by number."""


@dataclass(frozen=True)
class _Name:
    meaning: str


@dataclass
class _Dtype:
    code: str
    order: str = "="

    @property
    def numpy(self) -> np.dtype:
        if self.code.startswith("O"):
            raise PickleStreamError("an array of objects where numbers are expected")
        # "|" is for single bytes, which have no order.
        return np.dtype(("=" if self.order == "|" else self.order) + self.code)


@dataclass
class _Array:
    """An array that is being made, or that was handed over."""

    is_given: bool = False


_MARK = object()
_BYTES = object()  # long bytes that were used and let go


def stream_arrays(file: BinaryIO) -> Iterator[tuple[int, np.ndarray]]:
    """Number and array of every entry, in the pickle's order.

    file: read forward from its position to the pickle's end. The pickle is a dictionary, bare or
    the only object of an array without axes, as `np.save` has it.

    Raises:
        PickleStreamError: anything else is in it, it is cut short, or an array takes more than
            MAX_ARRAY_BYTES.
    """
    machine = _Machine()
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(_Bounded(file))):
            step = _STEPS.get(opcode.name)
            if step is None:
                raise PickleStreamError(f"it holds {opcode.name}, which arrays do not need")
            if count > _MAX_STEPS:
                raise PickleStreamError(f"it takes more than {_MAX_STEPS} steps")
            step(machine, argument)
            if machine.ready is not None:
                yield machine.ready
                machine.ready = None
    except PickleStreamError:
        raise
    except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError) as error:
        raise PickleStreamError(f"it is cut short or damaged ({error})") from error


class _Bounded:
    """A file that is read forward, in pieces of bounded size."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._left = MAX_BYTES

    def read(self, count: int) -> bytes:
        if not 0 <= count <= MAX_ARRAY_BYTES:
            raise PickleStreamError(f"it states {count} bytes for one value")
        self._left -= count
        if self._left < 0:
            raise PickleStreamError(f"it is larger than {MAX_BYTES} bytes")
        return self._file.read(count)

    def readline(self) -> bytes:
        line = self._file.readline(_MAX_LINE)
        if not line.endswith(b"\n") or b"\\" in line:
            raise PickleStreamError("it holds a name without end or with escapes")
        return line


@dataclass
class _Machine:
    """The state of the program: its stack, what it may refer back to, and an entry to hand over.

    held_bytes: of the values that wait for their array.
    """

    stack: list[Any] = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)
    ready: tuple[int, np.ndarray] | None = None
    held_bytes: int = 0

    def push_value(self, value: int | str | bytes) -> None:
        if isinstance(value, str) and len(value) > _MOST_TEXT:
            raise PickleStreamError(f"it holds a text of {len(value)} characters")
        if isinstance(value, bytes):
            self.held_bytes += len(value)
            if self.held_bytes > MAX_ARRAY_BYTES:
                raise PickleStreamError(f"it holds {self.held_bytes} bytes that are in no array")
        self.push(value)

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def pop_to_mark(self) -> list[Any]:
        at = len(self.stack) - 1
        while self.stack[at] is not _MARK:
            at -= 1
            if at < 0:
                raise PickleStreamError("it is cut short or damaged (no mark)")
        items = self.stack[at + 1 :]
        del self.stack[at:]
        return items

    def pop_tuple(self, count: int) -> None:
        at = len(self.stack) - count
        items = tuple(self.stack[at:])
        if at < 0:
            raise PickleStreamError("it is cut short or damaged (short stack)")
        del self.stack[at:]
        self.push(items)

    def remember(self, key: int) -> None:
        value = self.stack[-1]
        is_long = isinstance(value, bytes) and len(value) > _MEMO_BYTES
        self.memo[key] = _BYTES if is_long else value

    def name(self, module: str, name: str) -> None:
        meaning = _MEANINGS.get((module, name))
        if meaning is None:
            raise PickleStreamError(f"it asks for {module}.{name}, which arrays do not need")
        self.push(_Name(meaning))

    def reduce(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        meaning = function.meaning if isinstance(function, _Name) else ""
        if meaning == "dtype":
            code = arguments[0]
            if not (isinstance(code, str) and _DTYPE.fullmatch(code)):
                raise PickleStreamError("it holds values that are no numbers")
            self.push(_Dtype(code))
        elif meaning == "array":
            self.push(_Array())
        elif meaning == "scalar":
            dtype, content = arguments
            self.push(np.frombuffer(content, dtype.numpy, 1).item())
        else:
            raise PickleStreamError("it calls something that arrays do not need")

    def build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, _Dtype):
            if state[1] not in ("<", ">", "|", "="):
                raise PickleStreamError("it holds values in no known byte order")
            target.order = state[1]
        elif isinstance(target, _Array) and not target.is_given:
            _, shape, dtype, is_fortran, content = state
            target.is_given = True
            if shape != ():  # else the one that the dictionary is wrapped in
                array = _array(shape, dtype.numpy, is_fortran, content)
                self.held_bytes -= len(content)
                number = self.stack[-2]
                if type(number) is not int:
                    raise PickleStreamError("it holds an array under something that is no number")
                self.ready = number, array
        else:
            raise PickleStreamError("it changes something that is no array")


def _array(shape: Any, dtype: np.dtype, is_fortran: Any, content: Any) -> np.ndarray:
    """An array of its own memory."""
    is_shape = isinstance(shape, tuple) and all(type(side) is int and side >= 0 for side in shape)
    if not is_shape or not isinstance(content, bytes):
        raise PickleStreamError("it holds an array without a shape or its bytes")
    if math.prod(shape) * dtype.itemsize != len(content):
        raise PickleStreamError(
            f"it holds {len(content)} bytes for an array {list(shape)} of {dtype}"
        )
    flat = np.frombuffer(content, dtype)
    return flat.reshape(shape, order="F" if is_fortran else "C").astype(dtype.newbyteorder("="))


def _join_names(machine: _Machine, _: Any) -> None:
    name, module = machine.stack.pop(), machine.stack.pop()
    machine.name(module, name)


def _global(machine: _Machine, argument: str) -> None:
    module, _, name = argument.partition(" ")
    machine.name(module, name)


def _recall(machine: _Machine, key: int) -> None:
    value = machine.memo[key]
    if isinstance(value, _Array) and value.is_given:
        raise PickleStreamError("it holds one array twice")
    machine.push(value)


def _drop_one_pair(machine: _Machine, _: Any) -> None:
    del machine.stack[-2:]


def _nothing(machine: _Machine, _: Any) -> None:
    """A step that says something of the pickle itself."""


_Step = Callable[[_Machine, Any], None]
_STEPS: dict[str, _Step] = {
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), _nothing),
    **dict.fromkeys(
        ("BININT", "BININT1", "BININT2", "LONG1", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8",
         "BINUNICODE", "SHORT_BINUNICODE"),
        _Machine.push_value,
    ),
    "NONE": lambda machine, _: machine.push(None),
    "NEWTRUE": lambda machine, _: machine.push(True),
    "NEWFALSE": lambda machine, _: machine.push(False),
    "MARK": lambda machine, _: machine.push(_MARK),
    "EMPTY_TUPLE": lambda machine, _: machine.push(()),
    "EMPTY_LIST": lambda machine, _: machine.push([]),
    "EMPTY_DICT": lambda machine, _: machine.push({}),
    "TUPLE": lambda machine, _: machine.push(tuple(machine.pop_to_mark())),
    "TUPLE1": lambda machine, _: machine.pop_tuple(1),
    "TUPLE2": lambda machine, _: machine.pop_tuple(2),
    "TUPLE3": lambda machine, _: machine.pop_tuple(3),
    # Arrays were handed over when they were built; what holds them needs not be filled.
    "SETITEM": _drop_one_pair,
    "SETITEMS": lambda machine, _: machine.pop_to_mark().clear(),
    "APPEND": lambda machine, _: machine.stack.pop(),
    "MEMOIZE": lambda machine, _: machine.remember(len(machine.memo)),
    **dict.fromkeys(("BINPUT", "LONG_BINPUT"), _Machine.remember),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), _recall),
    "GLOBAL": _global,
    "STACK_GLOBAL": _join_names,
    "REDUCE": lambda machine, _: machine.reduce(),
    "BUILD": lambda machine, _: machine.build(),
}  # fmt: skip
