"""Pickles and .npy files from strangers, read without calling anything of numpy's or pandas'.

A pickle is a program that names functions for the reader to call. Even numpy's own constructors run
whatever a hostile file likes: `dtype.__setstate__` takes fields at negative offsets, and an array
over them writes into other objects. So the program is followed step by step by `Pickle`: a name
stands for a function of ours or is refused, what it makes are values of Python and the records
below, and arrays are made of checked headers and of the bytes that are there.
"""

from __future__ import annotations

import math
import pickle
import pickletools
import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BufferedIOBase
from typing import Any, ClassVar, Literal

import numpy as np

MAX_VALUE_BYTES = 1 << 29  # of one value
MAX_STEPS = 1 << 20  # of the program; a text in a table takes two
MAX_STREAMED_BYTES = 1 << 27  # for one array; a sweep of 200,000 points takes 5 MB
MAX_STREAMED_STEPS = 1 << 18  # a frame takes twenty
MAX_INT_KEYS = 1 << 14  # of a dictionary: whole numbers can be chosen to collide
_MAX_LINE = 1 << 12
_LONG_BYTES = 1 << 10  # longer ones are an array's own: nothing refers back to them
_STEP_NAMES = {ord(opcode.code): opcode.name for opcode in pickletools.opcodes}
_PLAIN_STEPS = (
    "PROTO", "STOP", "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1",
    "BINFLOAT", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BINUNICODE", "SHORT_BINUNICODE",
    "BINSTRING", "SHORT_BINSTRING", "MARK", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3",
    "EMPTY_LIST", "EMPTY_DICT", "MEMOIZE", "BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET",
    "GLOBAL", "STACK_GLOBAL", "REDUCE", "BINPERSID",
)  # fmt: skip
Order = Literal["C", "F"]
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

    make: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        return self.make(*arguments)


class Pickle(pickle._Unpickler):
    """One pickle, read step by step by Python's own reader, in Python (the one in C takes memory as
    the file says), of which the steps that plain values need are left.
    """

    def __init__(
        self,
        file: BufferedIOBase,
        names: Mapping[tuple[str, str], Callable[..., Any]],
        *,
        storage: Callable[..., Any] | None = None,
        is_streamed: bool = False,
    ) -> None:
        """names: what it may name, by module and name, and what stands for it. storage: makes what
        a persistent id stands for, of the id. is_streamed: keep no long bytes once they are used,
        for files larger than memory; then nothing may refer back to them.
        """
        self._source: Any = _Bounded(file, is_streamed)
        super().__init__(self._source, encoding="latin-1")
        self.read, self.readline = self._source.read, self._source.readline
        self._names, self._storage, self._is_streamed = names, storage, is_streamed
        self.memo: dict[int, Any] = _ShortMemo() if is_streamed else {}
        self.metastack: list[list[Any]] = []
        self.stack: list[Any] = []
        self.append = self.stack.append
        self._built: Record | None = None

    def value(self) -> Any:
        """The value of the pickle that starts at the file's position; reads no further."""
        for _ in self.steps():
            pass
        return self.stack[-1]

    def steps(self) -> Iterator[Record]:
        """As `value`, but comes up with every record that has been built. The value is then the
        last one on `stack`.
        """
        most = MAX_STREAMED_STEPS if self._is_streamed else MAX_STEPS
        count, code = 0, b""
        try:
            while code != pickle.STOP:
                if (count := count + 1) > most:
                    raise PickleError(f"it takes more than {most} steps")
                if not (code := self.read(1)) or code[0] not in _STEP_NAMES:
                    raise PickleError("it is cut short or damaged (no known step)")
                if code[0] not in self.dispatch:
                    name = _STEP_NAMES[code[0]]
                    raise PickleError(f"it holds {name}, which plain values do not need")
                if code != pickle.STOP:
                    self.dispatch[code[0]](self)
                if self._built is not None:
                    self._source.held_bytes, built, self._built = 0, self._built, None
                    yield built
            if len(self.stack) != 1 or self.metastack:
                raise PickleError("it is cut short or damaged (no single value)")
        except PickleError:
            raise
        except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, EOFError,
                struct.error, pickle.UnpicklingError) as error:  # fmt: skip
            raise PickleError(f"it is cut short or damaged ({error})") from error

    def find_class(self, module: str, name: str) -> Name:
        if (module, name) not in self._names:
            raise PickleError(f"it asks for {module}.{name}, which is not needed")
        return Name(self._names[module, name])

    def persistent_load(self, pid: Any) -> Any:
        if self._storage is None:
            raise PickleError("it refers to values outside of it")
        return self._storage(pid)

    def _frame(self) -> None:
        self.read(8)  # what a frame holds is read like the rest

    def _bytearray(self) -> None:
        self.append(self.read(int.from_bytes(self.read(8), "little")))

    def _reduce(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        if type(function) is not Name or type(arguments) is not tuple:
            raise PickleError("it calls something that is no name, or without arguments")
        self.append(function(*arguments))

    def _build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, Record):
            target.build(state)
            self._built = target
        elif type(target) is not dict:  # an OrderedDict has attributes beside its entries
            raise PickleError("it fills something that takes no state")

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

    dispatch: ClassVar[dict[int, Callable[[Any], None]]] = {
        **{
            code: step
            for code, step in pickle._Unpickler.dispatch.items()
            if _STEP_NAMES[code] in _PLAIN_STEPS
        },
        pickle.FRAME[0]: _frame,
        pickle.BYTEARRAY8[0]: _bytearray,
        pickle.REDUCE[0]: _reduce,
        pickle.NEWOBJ[0]: _reduce,
        pickle.BUILD[0]: _build,
        pickle.SETITEM[0]: lambda self: self._store([self.stack.pop(-2), self.stack.pop()]),
        pickle.SETITEMS[0]: lambda self: self._store(self.pop_mark()),
        pickle.APPEND[0]: lambda self: self._extend([self.stack.pop()]),
        pickle.APPENDS[0]: lambda self: self._extend(self.pop_mark()),
    }


class _ShortMemo(dict[int, Any]):
    """What a pickle refers back to, but for long bytes."""

    def __setitem__(self, key: int, value: Any) -> None:
        is_long = isinstance(value, bytes) and len(value) > _LONG_BYTES
        super().__setitem__(key, _FORGOTTEN if is_long else value)

    def __getitem__(self, key: int) -> Any:
        if (value := super().__getitem__(key)) is _FORGOTTEN:
            raise PickleError("it refers back to the bytes of an array")
        return value


_FORGOTTEN = object()


class _Bounded:
    """A file that is read forward, in pieces of bounded size. held_bytes: read since a record was
    last built; bounded in streamed files.
    """

    def __init__(self, file: BufferedIOBase, is_streamed: bool) -> None:
        self._file, self._is_streamed, self.held_bytes = file, is_streamed, 0

    def read(self, count: int) -> bytes:
        if not 0 <= count <= MAX_VALUE_BYTES:
            raise PickleError(f"it states {count} bytes for one value")
        self.held_bytes += count
        if self._is_streamed and self.held_bytes > MAX_STREAMED_BYTES:
            raise PickleError(f"it holds {self.held_bytes} bytes that are in no array")
        data = self._file.read(count)
        if len(data) < count:
            raise PickleError("it is cut short or damaged (too few bytes)")
        return data

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
        match state:
            case (3, "<" | ">" | "|" | "=" as order, None, None, None, -1, -1, 0 | 63 as flags):
                if (flags == 63) == self.is_object:
                    self.order = order
                    return
        raise PickleError("it describes values as something else than plain numbers")

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

    def _fill(self, shape: Any, dtype: Any, order: Order, content: Any) -> None:
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


def numbers(shape: tuple[int, ...], dtype: np.dtype, order: Order, content: Any) -> np.ndarray:
    """An array of its own memory, in the machine's byte order."""
    if type(content) is not bytes or math.prod(shape) * dtype.itemsize != len(content):
        held = f"{len(content)} bytes" if type(content) is bytes else "no bytes"
        raise PickleError(f"it holds {held} for an array {list(shape)} of {dtype}")
    array = np.frombuffer(content, dtype).reshape(shape, order=order)
    return array.astype(dtype.newbyteorder("="), order="K")


def _objects(shape: tuple[int, ...], order: Order, content: Any) -> tuple[np.ndarray | None, Any]:
    """Texts, numbers and None; or, of a single object that is none of them, what it is."""
    if type(content) is not list or math.prod(shape) != len(content):
        raise PickleError(f"it holds an array {list(shape)} of objects without as many")
    if shape == () and not isinstance(content[0], _PLAIN_CELLS):
        return None, content[0]
    if not all(isinstance(cell, _PLAIN_CELLS) for cell in content):
        raise PickleError("it holds a cell that is neither a text nor a number")
    flat = np.empty(len(content), dtype=object)
    flat[:] = content
    return flat.reshape(shape, order=order), None


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
    order: Order


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
