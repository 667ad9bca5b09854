"""Pickles and .npy files from strangers, read without calling anything of numpy's or pandas'.

A pickle is a program that names functions for the reader to call. Even numpy's own constructors run
whatever a hostile file likes: `dtype.__setstate__` takes fields at negative offsets, and an array
over them writes into other objects. So the program is followed step by step by `Pickle`: a name
stands for a function of ours or is refused, what it makes are values of Python and the records
below, and arrays are made of checked headers and of the bytes that are there.
"""

from __future__ import annotations

import math
import pickletools
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BufferedIOBase
from typing import Any

import numpy as np

MAX_VALUE_BYTES = 1 << 29  # of one value
MAX_STEPS = 1 << 20  # of the program; a text in a table takes two
MAX_STREAMED_BYTES = 1 << 27  # for one array; a sweep of 200,000 points takes 5 MB
MAX_STREAMED_STEPS = 1 << 18  # a frame takes twenty
MAX_INT_KEYS = 1 << 14  # of a dictionary: whole numbers can be chosen to collide
_MAX_LINE = 1 << 12
_OPCODES = {opcode.code: opcode for opcode in pickletools.opcodes}
_LONG_BYTES = 1 << 10  # longer ones are an array's own: nothing refers back to them
_DTYPE = re.compile(r"[fiu][1248]|b1|O8?")
_PLAIN_CELLS = (type(None), bool, int, float, str, np.generic)
_NPY_HEADER = re.compile(
    r"\{'descr': '([<>|=]?)([fiub][1248]|O)', 'fortran_order': (True|False), "
    r"'shape': \(((?:\d{1,15}L?,? ?)*)\), ?\}\s*"
)


class PickleError(ValueError):
    """The file holds something else than plain values and arrays, or is damaged."""


class Record(ABC):
    """What a pickle makes and then fills with a state, in the words of pickle: builds."""

    @abstractmethod
    def build(self, state: Any) -> None: ...


@dataclass(frozen=True)
class Name:
    """A function or class that a pickle names. make: what stands for it here."""

    text: str
    make: Callable[..., Any]


class Pickle:
    """One pickle, followed step by step."""

    def __init__(
        self,
        names: Mapping[tuple[str, str], Callable[..., Any]],
        *,
        storage: Callable[..., Any] | None = None,
        is_streamed: bool = False,
    ) -> None:
        """names: what it may name, by module and name, and what stands for it. storage: makes what
        a persistent id stands for, of the id. is_streamed: keep no long bytes once they are used,
        for files larger than memory; then nothing may refer back to them.
        """
        self._names = names
        self._storage = storage
        self._is_streamed = is_streamed
        self._held_bytes = 0  # of a streamed file's values that wait for their array
        self._memo: dict[int, Any] = {}
        self.stack: list[Any] = []

    def read(self, file: BufferedIOBase) -> Any:
        """The value of the pickle that starts at the file's position; reads no further."""
        for _ in self.steps(file):
            pass
        return self.stack[-1]

    def steps(self, file: BufferedIOBase) -> Iterator[Record]:
        """As `read`, but comes up with every record that has been built. Its value is then the last
        one on `stack`.
        """
        most = MAX_STREAMED_STEPS if self._is_streamed else MAX_STEPS
        try:
            for count, (step, argument) in enumerate(_steps_of(file)):
                if count > most:
                    raise PickleError(f"it takes more than {most} steps")
                built = step(self, argument)
                if built is not None:
                    self._held_bytes = 0
                    yield built
            if len(self.stack) != 1 or self.stack[0] is _MARK:
                raise PickleError("it is cut short or damaged (no single value)")
        except PickleError:
            raise
        except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError) as error:
            raise PickleError(f"it is cut short or damaged ({error})") from error

    def _push(self, value: Any) -> None:
        if self._is_streamed and isinstance(value, bytes | bytearray | str):
            self._held_bytes += len(value)
            if self._held_bytes > MAX_STREAMED_BYTES:
                raise PickleError(f"it holds {self._held_bytes} bytes that are in no array")
        self.stack.append(bytes(value) if isinstance(value, bytearray) else value)

    def _pop_to_mark(self) -> list[Any]:
        at = len(self.stack) - 1
        while self.stack[at] is not _MARK:
            at -= 1
            if at < 0:
                raise PickleError("it is cut short or damaged (no mark)")
        items = self.stack[at + 1 :]
        del self.stack[at:]
        return items

    def _pop_tuple(self, count: int) -> None:
        at = len(self.stack) - count
        if at < 0:
            raise PickleError("it is cut short or damaged (short stack)")
        self.stack[at:] = [tuple(self.stack[at:])]

    def _put(self, key: int) -> None:
        value = self.stack[-1]
        is_long = self._is_streamed and isinstance(value, bytes) and len(value) > _LONG_BYTES
        self._memo[key] = _FORGOTTEN if is_long else value

    def _get(self, key: int) -> None:
        if self._memo[key] is _FORGOTTEN:
            raise PickleError("it refers back to the bytes of an array")
        self.stack.append(self._memo[key])

    def _global(self, module: str, name: str) -> None:
        make = self._names.get((module, name))
        if make is None:
            raise PickleError(f"it asks for {module}.{name}, which is not needed")
        self.stack.append(Name(f"{module}.{name}", make))

    def _global_by_stack(self) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        if type(name) is not str or type(module) is not str:
            raise PickleError("it names something by what is no text")
        self._global(module, name)

    def _reduce(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        if type(function) is not Name or type(arguments) is not tuple:
            raise PickleError("it calls something that is no name, or without arguments")
        self.stack.append(function.make(*arguments))

    def _build(self) -> Record | None:
        state, target = self.stack.pop(), self.stack[-1]
        if type(target) is dict:  # of an OrderedDict: attributes beside its entries
            return None
        if not isinstance(target, Record):
            raise PickleError("it fills something that takes no state")
        target.build(state)
        return target

    def _store(self, pairs: list[Any]) -> None:
        target = self.stack[-1]
        if type(target) is not dict or len(pairs) % 2:
            raise PickleError("it puts entries into something that is no dictionary")
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            key = key.item() if isinstance(key, np.generic) else key
            if type(key) not in (str, int, bool, type(None)):
                raise PickleError("it holds a dictionary by keys that are neither text nor numbers")
            if type(key) is int and len(target) >= MAX_INT_KEYS:
                raise PickleError(f"it holds a dictionary of more than {MAX_INT_KEYS} numbers")
            target[key] = value

    def _extend(self, items: list[Any]) -> None:
        if type(self.stack[-1]) is not list:
            raise PickleError("it adds items to something that is no list")
        self.stack[-1].extend(items)

    def _persistent(self) -> None:
        key = self.stack.pop()
        if self._storage is None:
            raise PickleError("it refers to values outside of it")
        self.stack.append(self._storage(key))


_MARK = object()
_FORGOTTEN = object()

_STEPS: dict[str, Callable[[Pickle, Any], Record | None]] = {
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), lambda p, _: None),
    **dict.fromkeys(
        ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINBYTES", "SHORT_BINBYTES",
         "BINBYTES8", "BYTEARRAY8", "BINUNICODE", "SHORT_BINUNICODE", "BINSTRING",
         "SHORT_BINSTRING"),
        Pickle._push,
    ),
    "NONE": lambda p, _: p._push(None),
    "NEWTRUE": lambda p, _: p._push(True),
    "NEWFALSE": lambda p, _: p._push(False),
    "MARK": lambda p, _: p._push(_MARK),
    "EMPTY_TUPLE": lambda p, _: p._push(()),
    "EMPTY_LIST": lambda p, _: p._push([]),
    "EMPTY_DICT": lambda p, _: p._push({}),
    "TUPLE": lambda p, _: p._push(tuple(p._pop_to_mark())),
    "TUPLE1": lambda p, _: p._pop_tuple(1),
    "TUPLE2": lambda p, _: p._pop_tuple(2),
    "TUPLE3": lambda p, _: p._pop_tuple(3),
    "SETITEM": lambda p, _: p._store([p.stack.pop(-2), p.stack.pop()]),
    "SETITEMS": lambda p, _: p._store(p._pop_to_mark()),
    "APPEND": lambda p, _: p._extend([p.stack.pop()]),
    "APPENDS": lambda p, _: p._extend(p._pop_to_mark()),
    "MEMOIZE": lambda p, _: p._put(len(p._memo)),
    **dict.fromkeys(("BINPUT", "LONG_BINPUT"), Pickle._put),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), Pickle._get),
    "GLOBAL": lambda p, text: p._global(*text.split(" ", 1)),
    "STACK_GLOBAL": lambda p, _: p._global_by_stack(),
    **dict.fromkeys(("REDUCE", "NEWOBJ"), lambda p, _: p._reduce()),
    "BUILD": lambda p, _: p._build(),
    "BINPERSID": lambda p, _: p._persistent(),
}  # fmt: skip


def _steps_of(file: BufferedIOBase) -> Iterator[tuple[Callable[[Pickle, Any], Any], Any]]:
    """Every step of a pickle and its argument. Not by pickletools.genops, which would decode the
    arguments of steps that are refused, and imports codecs to do so.
    """
    source: Any = _Bounded(file)  # all that readers of arguments need of a file
    while True:
        code = source.read(1)
        opcode = _OPCODES.get(code.decode("latin-1"))
        if opcode is None:
            raise PickleError("it is cut short or damaged (no known step)")
        step = _STEPS.get(opcode.name)
        if step is None:
            raise PickleError(f"it holds {opcode.name}, which plain values do not need")
        yield step, None if opcode.arg is None else opcode.arg.reader(source)
        if opcode.name == "STOP":
            return


class _Bounded:
    """A file that is read forward, in pieces of bounded size."""

    def __init__(self, file: BufferedIOBase) -> None:
        self._file = file

    def read(self, count: int) -> bytes:
        if not 0 <= count <= MAX_VALUE_BYTES:
            raise PickleError(f"it states {count} bytes for one value")
        return self._file.read(count)

    def readline(self) -> bytes:
        line = self._file.readline(_MAX_LINE)
        if not line.endswith(b"\n") or b"\\" in line:
            raise PickleError("it holds a name without end or with escapes")
        return line


# ---- arrays ----------------------------------------------------------------------------------


@dataclass
class DtypeRecord(Record):
    """One of numpy's plain kinds of numbers, or objects. code: numpy's, without byte order."""

    code: str
    order: str = "="

    @staticmethod
    def make(code: Any, align: Any = False, copy: Any = True) -> DtypeRecord:
        if type(code) is not str or not _DTYPE.fullmatch(code) or align not in (False, 0):
            raise PickleError("it holds an array of something else than numbers or objects")
        return DtypeRecord(code)

    def build(self, state: Any) -> None:
        """Takes the byte order; fields, sub-arrays, sizes and flags of one's own are refused."""
        flags = 63 if self.is_object else 0
        plain = type(state) is tuple and len(state) == 8 and type(state[1]) is str
        if not plain or state[1] not in ("<", ">", "|", "="):
            raise PickleError("it holds values in no known byte order")
        rest = (state[0], *state[2:])
        if any(type(value) not in (int, type(None)) for value in rest) or rest != (
            3, None, None, None, -1, -1, flags
        ):  # fmt: skip
            raise PickleError("it describes values as something else than plain numbers")
        self.order = state[1]

    @property
    def is_object(self) -> bool:
        return self.code.startswith("O")

    @property
    def numpy(self) -> np.dtype:
        if self.is_object:
            raise PickleError("it holds objects where numbers are expected")
        # "|" is for single bytes, which have no order.
        return np.dtype(("=" if self.order == "|" else self.order) + self.code)


@dataclass(eq=False)
class ArrayRecord(Record):
    """An array that a pickle makes. values: None until it is filled, and once it was taken.
    wrapped: instead of values, what is neither text nor number: `np.save` makes an array of one
    object of whatever is no array.
    """

    values: np.ndarray | None = None
    wrapped: Any = None
    is_filled: bool = False

    @staticmethod
    def reconstruct(kind: Any, shape: Any, code: Any) -> ArrayRecord:
        if type(kind) is not Name or kind.make is not _ndarray:
            raise PickleError("it makes an array of a kind of its own")
        return ArrayRecord()

    def build(self, state: Any) -> None:
        if self.is_filled:
            raise PickleError("it fills one array twice")
        _, shape, dtype, is_fortran, content = state
        self._fill(shape, dtype, "F" if is_fortran is True else "C", content)

    @staticmethod
    def from_buffer(
        content: Any, dtype: Any, shape: Any, order: Any, axes: Any = None
    ) -> ArrayRecord:
        """As protocol 5 has it. axes: of an array in no plain order, which ones it runs along."""
        array = ArrayRecord()
        if order != "K":
            array._fill(shape, dtype, "F" if order == "F" else "C", content)
            return array
        if sorted(_checked_shape(axes)) != list(range(len(shape))):
            raise PickleError("it holds an array along axes that it has not")
        array._fill(tuple(shape[axis] for axis in axes), dtype, "C", content)
        array.values = array.take().transpose(np.argsort(axes))
        return array

    def _fill(self, shape: Any, dtype: Any, order: str, content: Any) -> None:
        if type(dtype) is not DtypeRecord:
            raise PickleError("it holds an array without a type")
        sides = _checked_shape(shape)
        self.is_filled = True
        if dtype.is_object:
            self.values, self.wrapped = _objects(sides, order, content)
        else:
            self.values = numbers(sides, dtype.numpy, order, content)

    def take(self) -> np.ndarray:
        """The array, once: a few bytes that refer to it often cannot fill the memory."""
        if self.values is None:
            raise PickleError("it holds one array twice, or one without values")
        values, self.values = self.values, None
        return values


def numbers(shape: tuple[int, ...], dtype: np.dtype, order: str, content: Any) -> np.ndarray:
    """An array of its own memory, in the machine's byte order."""
    if type(content) is not bytes or math.prod(shape) * dtype.itemsize != len(content):
        held = f"{len(content)} bytes" if type(content) is bytes else "no bytes"
        raise PickleError(f"it holds {held} for an array {list(shape)} of {dtype}")
    flat = np.frombuffer(content, dtype)
    return (
        flat.reshape(shape, order="F" if order == "F" else "C")
        .astype(dtype.newbyteorder("="), order="K")
    )  # fmt: skip


def _objects(shape: tuple[int, ...], order: str, content: Any) -> tuple[np.ndarray | None, Any]:
    """Texts, numbers and None; or, of a single object that is none of them, what it is."""
    if type(content) is not list or math.prod(shape) != len(content):
        raise PickleError(f"it holds an array {list(shape)} of objects without as many")
    if shape == () and not isinstance(content[0], _PLAIN_CELLS):
        return None, content[0]
    if not all(isinstance(cell, _PLAIN_CELLS) for cell in content):
        raise PickleError("it holds a cell that is neither a text nor a number")
    flat = np.empty(len(content), dtype=object)
    flat[:] = content
    return flat.reshape(shape, order="F" if order == "F" else "C"), None


def _checked_shape(shape: Any) -> tuple[int, ...]:
    is_shape = type(shape) is tuple and all(type(n) is int and 0 <= n < 1 << 48 for n in shape)
    if not is_shape or len(shape) > 8:
        raise PickleError("it holds an array without a shape")
    return shape


def _scalar(dtype: Any, content: Any) -> np.generic:
    if type(dtype) is not DtypeRecord:
        raise PickleError("it holds a number without a type")
    return numbers((1,), dtype.numpy, "C", content)[0]


def _ndarray(*_: Any) -> None:
    raise PickleError("it makes an array without its bytes")


def _encode_latin1(text: Any, encoding: Any = "utf-8") -> bytes:
    """What protocol 2 carries bytes by; any other codec is refused."""
    if type(text) is not str or encoding not in ("latin1", "latin-1"):
        codec = encoding if type(encoding) is str else type(encoding).__name__
        raise PickleError(f"it decodes by {codec[:40]!r}, which is not needed")
    return text.encode("latin-1")


def _bytes(content: Any = b"", encoding: Any = None) -> bytes:
    """Of a bytearray; protocol 2 spells it as text."""
    return content if type(content) is bytes else _encode_latin1(content, encoding)


_CORES = ("numpy.core", "numpy._core")  # numpy 2 renamed it
ARRAY_NAMES: dict[tuple[str, str], Callable[..., Any]] = {
    **{(f"{core}.multiarray", "_reconstruct"): ArrayRecord.reconstruct for core in _CORES},
    **{(f"{core}.multiarray", "scalar"): _scalar for core in _CORES},
    **{(f"{core}.numeric", "_frombuffer"): ArrayRecord.from_buffer for core in _CORES},
    ("numpy", "ndarray"): _ndarray,
    ("numpy", "dtype"): DtypeRecord.make,
    ("_codecs", "encode"): _encode_latin1,
    **{(module, "bytearray"): _bytes for module in ("builtins", "__builtin__")},
}

# ---- .npy ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NpyHeader:
    """What the bytes after the header are: numbers of `dtype`, or one pickled object."""

    shape: tuple[int, ...]
    dtype: np.dtype | None
    order: str


def read_npy_header(file: BufferedIOBase) -> NpyHeader:
    """The header as `np.save` writes it; numpy's own reader would evaluate it as Python."""
    start = file.read(8)
    if len(start) < 8 or start[:6] != b"\x93NUMPY" or start[6] not in (1, 2, 3):
        raise PickleError("it does not start as a .npy file does")
    size = int.from_bytes(file.read(2 if start[6] == 1 else 4), "little")
    if size > 1 << 16:
        raise PickleError(f"it has a header of {size} bytes")
    match = _NPY_HEADER.fullmatch(file.read(size).decode("latin-1"))
    if match is None:
        raise PickleError("it holds no plain numbers, or its header is damaged")
    order, code, is_fortran, sides = match.groups()
    shape = tuple(int(side.strip("L ")) for side in sides.split(",") if side.strip())
    dtype = None if code == "O" else np.dtype(order.replace("|", "=") + code)
    return NpyHeader(shape, dtype, "F" if is_fortran == "True" else "C")


def read_npy(file: BufferedIOBase) -> np.ndarray:
    """The numbers of a .npy file."""
    header = read_npy_header(file)
    if header.dtype is None:
        raise PickleError("it holds objects where numbers are expected")
    size = math.prod(header.shape) * header.dtype.itemsize
    if size > MAX_VALUE_BYTES:
        raise PickleError(f"it states {size} bytes")
    return numbers(header.shape, header.dtype, header.order, file.read(size))
