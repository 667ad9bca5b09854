"""Reads pickles and .npy files from strangers without calling numpy or pandas.

A pickle is a program that names functions for the reader to call. Even numpy's own constructors run
whatever a hostile file likes: `dtype.__setstate__` takes fields at negative offsets, and an array
over them writes into other objects. So `Pickle` follows the program step by step. A name stands for
one of our functions or is refused; the results are values of Python and the records below; arrays
are made of checked headers and of the bytes that exist.
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

MAX_VALUE_BYTES = 1 << 29  # bytes of one value
MAX_STEPS = 1 << 20  # steps of the program; a text in a table takes two
MAX_STREAMED_BYTES = 1 << 27  # bytes for one array; a sweep of 200,000 points takes 5 MB
MAX_STREAMED_STEPS = 1 << 18  # steps of a streamed program; a frame takes twenty
MAX_INT_KEYS = 1 << 14  # whole-number keys of a dictionary: they can be chosen to collide
_MAX_LINE_BYTES = 1 << 12  # bytes of a line, which holds a name
# A memo keeps bytes up to this length. Longer ones are an array's: no program refers back to them.
_MAX_MEMO_BYTES = 1 << 10
_STEP_NAMES = {ord(opcode.code): opcode.name for opcode in pickletools.opcodes}
_PLAIN_STEPS = (
    "PROTO", "STOP", "NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1",
    "BINFLOAT", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BINUNICODE", "SHORT_BINUNICODE",
    "BINSTRING", "SHORT_BINSTRING", "MARK", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3",
    "EMPTY_LIST", "EMPTY_DICT", "MEMOIZE", "BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET",
    "GLOBAL", "STACK_GLOBAL", "REDUCE", "BINPERSID",
)  # fmt: skip
Order = Literal["C", "F"]
_DTYPE_CODE = re.compile(r"[fiu][1248]|b1|O8?")
_CELL_TYPES = (type(None), bool, int, float, str, np.generic)
_NPY_HEADER = re.compile(
    r"\{'descr': '([<>|=]?)([fiub][1248]|O)', 'fortran_order': (True|False), "
    r"'shape': \(((?:\d{1,15}L?,? ?)*)\), ?\}\s*"
)


class PickleError(ValueError):
    """The file holds something else than plain values and arrays, or is damaged."""


class Record(ABC):
    """An object that a pickle creates and then fills with a state (pickle's BUILD step)."""

    @abstractmethod
    def build(self, state: Any) -> None:
        """Fill the object with the state of the pickle."""
        ...


@dataclass(frozen=True)
class Name:
    """A function or class that a pickle names."""

    make: Callable[..., Any]  # the function that replaces it

    def __call__(self, *arguments: Any) -> Any:
        return self.make(*arguments)


class Pickle(pickle._Unpickler):
    """One pickle, read step by step by Python's own reader in Python.

    The reader in C would take as much memory as the file says. Only the steps that plain values
    need are left.
    """

    def __init__(
        self,
        file: BufferedIOBase,
        names: Mapping[tuple[str, str], Callable[..., Any]],
        *,
        storage: Callable[..., Any] | None = None,
        is_streamed: bool = False,
    ) -> None:
        """Prepare to read one pickle.

        Args:
            file: the file, at the start of the pickle.
            names: the functions that replace the allowed names, by module and name.
            storage: makes the value of a persistent id, given the id.
            is_streamed: drop long bytes once they are used, for files larger than memory; then the
                program may not refer back to them.
        """
        self._source: Any = _BoundedFile(file, is_streamed)
        super().__init__(self._source, encoding="latin-1")
        self.read, self.readline = self._source.read, self._source.readline
        self._names = names
        self._storage = storage
        self._is_streamed = is_streamed
        self.memo: dict[int, Any] = _MemoWithoutLongBytes() if is_streamed else {}
        self.metastack: list[list[Any]] = []
        self.stack: list[Any] = []
        self.append = self.stack.append
        self._built: Record | None = None

    def value(self) -> Any:
        """Return the value of the pickle that starts at the file's position; read no further."""
        for _ in self.steps():
            pass
        return self.stack[-1]

    def steps(self) -> Iterator[Record]:
        """Run the program and yield every record after it was built.

        The value is the last item of `stack` at the end.
        """
        max_steps = MAX_STREAMED_STEPS if self._is_streamed else MAX_STEPS
        num_steps = 0
        code = b""
        try:
            while code != pickle.STOP:
                if (num_steps := num_steps + 1) > max_steps:
                    raise PickleError(f"it takes more than {max_steps} steps")
                if not (code := self.read(1)) or code[0] not in _STEP_NAMES:
                    raise PickleError("it is cut short or damaged (no known step)")
                if code[0] not in self.dispatch:
                    name = _STEP_NAMES[code[0]]
                    raise PickleError(f"it holds {name}, which plain values do not need")
                if code != pickle.STOP:
                    self.dispatch[code[0]](self)
                if self._built is not None:
                    record = self._built
                    self._built = None
                    self._source.held_bytes = 0
                    yield record
            if len(self.stack) != 1 or self.metastack:
                raise PickleError("it is cut short or damaged (no single value)")
        except PickleError:
            raise
        except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, EOFError,
                struct.error, pickle.UnpicklingError) as error:  # fmt: skip
            raise PickleError(f"it is cut short or damaged ({error})") from error

    def find_class(self, module: str, name: str) -> Name:
        """Return the replacement of a name."""
        if (module, name) not in self._names:
            raise PickleError(f"it asks for {module}.{name}, which is not needed")
        return Name(self._names[module, name])

    def persistent_load(self, pid: Any) -> Any:
        """Return the value of a persistent id."""
        if self._storage is None:
            raise PickleError("it refers to values outside of it")
        return self._storage(pid)

    def _frame(self) -> None:
        """Skip the length of a frame."""
        self.read(8)  # the content of a frame is read like everything else

    def _bytearray(self) -> None:
        """Push bytes."""
        self.append(self.read(int.from_bytes(self.read(8), "little")))

    def _reduce(self) -> None:
        """Call a function with its arguments."""
        arguments = self.stack.pop()
        function = self.stack.pop()
        if type(function) is not Name or type(arguments) is not tuple:
            raise PickleError("it calls something that is no name, or without arguments")
        self.append(function(*arguments))

    def _build(self) -> None:
        """Fill the last object with its state."""
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, Record):
            target.build(state)
            self._built = target
        elif type(target) is not dict:  # an OrderedDict has attributes beside its entries
            raise PickleError("it fills something that takes no state")

    def _store(self, pairs: list[Any]) -> None:
        """Put entries into the last dictionary."""
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
        """Add items to the last list."""
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


class _MemoWithoutLongBytes(dict[int, Any]):
    """The values that a pickle may refer back to; long bytes are dropped."""

    def __setitem__(self, key: int, value: Any) -> None:
        is_dropped = isinstance(value, bytes) and len(value) > _MAX_MEMO_BYTES
        super().__setitem__(key, _DROPPED_BYTES if is_dropped else value)

    def __getitem__(self, key: int) -> Any:
        if (value := super().__getitem__(key)) is _DROPPED_BYTES:
            raise PickleError("it refers back to the bytes of an array")
        return value


_DROPPED_BYTES = object()


class _BoundedFile:
    """A file that is read forward, in pieces of bounded size.

    `held_bytes` counts the bytes read since a record was last built; streamed files bound it.
    """

    def __init__(self, file: BufferedIOBase, is_streamed: bool) -> None:
        self._file = file
        self._is_streamed = is_streamed
        self.held_bytes = 0

    def read(self, count: int) -> bytes:
        """Read exactly `count` bytes."""
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
        """Read a line without escapes."""
        line = self._file.readline(_MAX_LINE_BYTES)
        if not line.endswith(b"\n") or b"\\" in line:
            raise PickleError("it holds a name without end or with escapes")
        return line


# ---- arrays ----------------------------------------------------------------------------------


@dataclass
class DtypeRecord(Record):
    """One of numpy's plain kinds of numbers, or objects."""

    code: str  # numpy's code of the type, without byte order
    order: str = "="  # numpy's character of the byte order

    @staticmethod
    def make(code: Any, align: Any = False, copy: Any = True) -> DtypeRecord:
        """Check numpy's arguments of a dtype."""
        if type(code) is not str or not _DTYPE_CODE.fullmatch(code) or align not in (False, 0):
            raise PickleError("it holds an array of something else than numbers or objects")
        return DtypeRecord(code)

    def build(self, state: Any) -> None:
        """Set the byte order; fields, sub-arrays and other sizes and flags are refused."""
        match state:
            case (3, "<" | ">" | "|" | "=" as order, None, None, None, -1, -1, 0 | 63 as flags):
                if (flags == 63) == self.is_object:
                    self.order = order
                    return
        raise PickleError("it describes values as something else than plain numbers")

    @property
    def is_object(self) -> bool:
        """True for an array of Python objects."""
        return self.code.startswith("O")

    @property
    def numpy(self) -> np.dtype:
        """Return the dtype of plain numbers."""
        if self.is_object:
            raise PickleError("it holds objects where numbers are expected")
        # "|" is for single bytes, which have no order.
        return np.dtype(("=" if self.order == "|" else self.order) + self.code)


@dataclass(eq=False)
class ArrayRecord(Record):
    """An array that a pickle creates."""

    values: np.ndarray | None = None  # None before it is filled, and after it was taken
    # An object that is neither text nor number, in place of values: `np.save` wraps whatever is no
    # array in an array of one object.
    wrapped: Any = None
    is_filled: bool = False  # True after `build`

    @staticmethod
    def reconstruct(kind: Any, shape: Any, code: Any) -> ArrayRecord:
        """Create an empty array, as numpy's `_reconstruct`."""
        if type(kind) is not Name or kind.make is not _ndarray:
            raise PickleError("it makes an array of a kind of its own")
        return ArrayRecord()

    def build(self, state: Any) -> None:
        """Fill the array with its shape, type and numbers."""
        if self.is_filled:
            raise PickleError("it fills one array twice")
        _, shape, dtype, is_fortran, content = state
        self._fill(shape, dtype, "F" if is_fortran is True else "C", content)

    @staticmethod
    def from_buffer(
        content: Any, dtype: Any, shape: Any, order: Any, axes: Any = None
    ) -> ArrayRecord:
        """Create an array as protocol 5 stores it.

        Args:
            content: the bytes.
            dtype: the type of the numbers.
            shape: the lengths of the axes.
            order: "C", "F", or "K" for an array in neither order.
            axes: the order of the axes in memory, for "K".
        """
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
        """Check and set the values."""
        if type(dtype) is not DtypeRecord:
            raise PickleError("it holds an array without a type")
        sides = _checked_shape(shape)
        self.is_filled = True
        if dtype.is_object:
            self.values, self.wrapped = _objects(sides, order, content)
        else:
            self.values = numbers(sides, dtype.numpy, order, content)

    def take(self) -> np.ndarray:
        """Return the array, once: a few bytes that refer to it often cannot fill the memory."""
        if self.values is None:
            raise PickleError("it holds one array twice, or one without values")
        values = self.values
        self.values = None
        return values


def numbers(shape: tuple[int, ...], dtype: np.dtype, order: Order, content: Any) -> np.ndarray:
    """Return an array with its own memory, in the machine's byte order."""
    if type(content) is not bytes or math.prod(shape) * dtype.itemsize != len(content):
        content_text = f"{len(content)} bytes" if type(content) is bytes else "no bytes"
        raise PickleError(f"it holds {content_text} for an array {list(shape)} of {dtype}")
    array = np.frombuffer(content, dtype).reshape(shape, order=order)
    return array.astype(dtype.newbyteorder("="), order="K")


def _objects(shape: tuple[int, ...], order: Order, content: Any) -> tuple[np.ndarray | None, Any]:
    """Return an array of texts, numbers and None, or the single object that is none of them."""
    if type(content) is not list or math.prod(shape) != len(content):
        raise PickleError(f"it holds an array {list(shape)} of objects without as many")
    if shape == () and not isinstance(content[0], _CELL_TYPES):
        return None, content[0]
    if not all(isinstance(cell, _CELL_TYPES) for cell in content):
        raise PickleError("it holds a cell that is neither a text nor a number")
    flat = np.empty(len(content), dtype=object)
    flat[:] = content
    return flat.reshape(shape, order=order), None


def _checked_shape(shape: Any) -> tuple[int, ...]:
    """Check that a value is a shape of at most 8 axes."""
    is_shape = type(shape) is tuple and all(type(n) is int and 0 <= n < 1 << 48 for n in shape)
    if not is_shape or len(shape) > 8:
        raise PickleError("it holds an array without a shape")
    return shape


def _scalar(dtype: Any, content: Any) -> np.generic:
    """Return one number, as numpy's `scalar`."""
    if type(dtype) is not DtypeRecord:
        raise PickleError("it holds a number without a type")
    return numbers((1,), dtype.numpy, "C", content)[0]


def _ndarray(*_: Any) -> None:
    """Refuse an array without bytes; also stands for numpy's class."""
    raise PickleError("it makes an array without its bytes")


def _encode_latin1(text: Any, encoding: Any = "utf-8") -> bytes:
    """Return the bytes of a text, as protocol 2 stores bytes; any other codec is refused."""
    if type(text) is not str or encoding not in ("latin1", "latin-1"):
        codec = encoding if type(encoding) is str else type(encoding).__name__
        raise PickleError(f"it decodes by {codec[:40]!r}, which is not needed")
    return text.encode("latin-1")


def _bytes(content: Any = b"", encoding: Any = None) -> bytes:
    """Return the bytes of a bytearray; protocol 2 spells them as text."""
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
    """Describes the bytes after the header of a .npy file."""

    shape: tuple[int, ...]
    dtype: np.dtype | None  # None where one pickled object follows
    order: Order  # C: the last axis varies fastest; F: the first


def read_npy_header(file: BufferedIOBase) -> NpyHeader:
    """Read a header as `np.save` writes it; numpy's own reader would evaluate it as Python."""
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
    """Read the numbers of a .npy file."""
    header = read_npy_header(file)
    if header.dtype is None:
        raise PickleError("it holds objects where numbers are expected")
    size = math.prod(header.shape) * header.dtype.itemsize
    if size > MAX_VALUE_BYTES:
        raise PickleError(f"it states {size} bytes")
    return numbers(header.shape, header.dtype, header.order, file.read(size))
