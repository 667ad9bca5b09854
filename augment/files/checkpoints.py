"""Reads what torch saved (.pth, .pt) without running its code and without torch's own reader.

Scene adapters and networks load their weights through this module. Tensors are mapped from the
file: a tensor that nobody uses (an optimiser's state) is never read from disk, and `release` gives
back the memory of tensors that have been copied.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import struct
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.errors import AdapterError, ClimateGSError
from augment.files.pickles import ARRAY_NAMES, Name, Pickle, PickleError, Record
from recipes.files import open_file

_COPY_CHUNK = 1 << 18  # numbers that are copied at a time: a megabyte of float32
_MADV_DONTNEED = 4  # the advice "do not need" of madvise, from linux/mman.h
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C  # first value of a file of torch before 1.6
_LEGACY_PROTOCOL = 1001  # second value of such a file


def load_checkpoint(path: Path, *, has_settings: bool = False) -> dict[str, Any]:
    """Load the dictionary of a checkpoint; its tensors are mapped into the processor's memory.

    Args:
        path: the file.
        has_settings: if True, OmegaConf's settings are accepted, and become `SettingsRecord`s.

    Raises:
        AdapterError: the file is missing, damaged, holds code or objects other than tensors and
            plain values (nothing of which is run), or holds no dictionary.
    """
    if not path.is_file():
        raise AdapterError(f"{path} does not exist; expected a checkpoint (.pth)")
    try:
        content = read_torch(path, has_settings=has_settings)
    except PickleError as error:
        raise AdapterError(
            f"{path} was not read, and nothing in it was run: {error}. Only tensors and plain "
            f"values are accepted: save it again as such, or copy it again"
        ) from None
    if not isinstance(content, dict):
        raise AdapterError(f"{path} must hold a dictionary; it holds a {type(content).__name__}")
    return content


def read_state_dict(
    path: Path, error: type[ClimateGSError], *, wrapped_in: Sequence[str] = ()
) -> dict[str, Tensor]:
    """Read the names and tensors of a network's weights.

    Args:
        path: a .safetensors file, or a file that torch saved.
        error: the class of the exception to raise.
        wrapped_in: names under which training scripts keep the state dict of a checkpoint.

    Raises:
        error: the file does not exist, cannot be read, or holds something else.
    """
    if not path.is_file():
        raise error(f"{path}: there is no such file of weights")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            state_dict: Any = load_file(path)
        else:
            state_dict = read_torch(path)
    except Exception as reason:  # safetensors' errors have no base of their own
        raise error(
            f"{path} cannot be read as weights: {str(reason).splitlines()[0]}; expected a state "
            f"dict saved by torch, or a .safetensors file"
        ) from reason
    for key in wrapped_in:
        if isinstance(state_dict, dict) and isinstance(state_dict.get(key), dict):
            state_dict = state_dict[key]
    if not isinstance(state_dict, dict) or not all(
        isinstance(v, Tensor) for v in state_dict.values()
    ):
        raise error(
            f"{path} holds a {type(state_dict).__name__} and not a state dict of tensors; save "
            f"model.state_dict()"
        )
    return {str(name): value for name, value in state_dict.items()}


def read_torch(path: Path, *, has_settings: bool = False) -> Any:
    """Read a file that `torch.save` wrote, in its current format or that of before torch 1.6.

    Tensors are mapped from the file. Parameters become tensors, and ordered dictionaries become
    dictionaries.

    Args:
        path: the file.
        has_settings: as in `load_checkpoint`; for the current format only.

    Raises:
        PickleError: the file holds something else than tensors and plain values, or is damaged.
    """
    try:
        with open_file(path) as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
            if content[:4] != b"PK\3\4":
                return _read_legacy(file, content)
            with zipfile.ZipFile(file) as archive:
                names = _NamesWithSettings(_NAMES) if has_settings else _NAMES
                return _read_zip(archive, content, names)
    except PickleError:
        raise
    except Exception as error:  # zipfile raises half a dozen kinds for what is damaged
        raise PickleError(f"it is no whole checkpoint of torch ({error})") from None


def _read_zip(
    archive: zipfile.ZipFile,
    content: mmap.mmap,
    names: Mapping[tuple[str, str], Callable[..., Any]],
) -> Any:
    entries = {entry.filename.partition("/")[2]: entry for entry in archive.infolist()}
    if "data.pkl" not in entries or len(entries) != len(archive.infolist()):
        raise PickleError("it is no whole checkpoint of torch (no data.pkl, or several)")
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries.values()):
        raise PickleError("it is compressed, as torch saves nothing")
    if "byteorder" in entries and archive.read(entries["byteorder"]) != b"little":
        raise PickleError("it was saved on a machine of another byte order")

    storages = _Storages(content, partial(_locate_in_zip, content, entries))
    with archive.open(entries["data.pkl"]) as opened:
        file: Any = opened  # a BufferedIOBase
        return Pickle(file, names, storage=storages).value()


def _locate_in_zip(
    content: mmap.mmap, entries: Mapping[str, zipfile.ZipInfo], key: str, *_: int
) -> tuple[int, int]:
    """Return the offset of a storage's numbers in the file, and their size in bytes."""
    entry = entries.get(f"data/{key}")
    if entry is None:
        raise PickleError(f"it lacks the numbers of storage {key}")
    lengths = struct.unpack_from("<HH", content, entry.header_offset + 26)
    return entry.header_offset + 30 + sum(lengths), entry.file_size


def _read_legacy(file: BufferedReader, content: mmap.mmap) -> Any:
    """Read the format of before torch 1.6.

    The file holds three pickles about its writer, one of the value and one of the storages' keys;
    then the length and the numbers of each storage. The value is read twice, because the offsets
    of its numbers stand behind it.
    """
    if [Pickle(file, {}).value() for _ in range(2)] != [_LEGACY_MAGIC, _LEGACY_PROTOCOL]:
        raise PickleError("it is no whole checkpoint of torch")
    Pickle(file, {}).value()
    start = file.tell()
    sizes: dict[str, tuple[int, int]] = {}
    storages = _Storages(None, lambda key, *size: (0, math.prod(sizes.setdefault(key, size))))
    Pickle(file, _NAMES, storage=storages).value()
    keys = Pickle(file, {}).value()
    locations: dict[str, tuple[int, int]] = {}
    offset = file.tell()
    for key in keys:
        count, itemsize = sizes[key]
        if struct.unpack_from("<q", content, offset) != (count,):  # how many numbers follow
            raise PickleError(f"it does not hold the {count} numbers of storage {key}")
        locations[key] = (offset + 8, count * itemsize)
        offset += 8 + count * itemsize
    file.seek(start)
    return Pickle(file, _NAMES, storage=_Storages(content, lambda key, *_: locations[key])).value()


@dataclass(frozen=True)
class _StorageType:
    """Stand-in for torch's FloatStorage and its like, which nothing calls."""

    dtype: torch.dtype  # of its numbers

    def __call__(self, *_: Any) -> None:
        raise PickleError("it makes a storage without its numbers")


@dataclass(frozen=True)
class _Storages:
    """Maps the storages that a checkpoint refers to, as flat tensors."""

    content: mmap.mmap | None  # the file; None makes tensors without values
    # Maps a key, the count of numbers and the bytes of each number to the offset of the numbers in
    # the file and their size in bytes.
    locate: Callable[[str, int, int], tuple[int, int]]

    def __call__(self, reference: Any) -> _Storage:
        tag, name, key, _, count, *_ = reference
        storage_type = name.make if type(name) is Name else None
        if tag != "storage" or not isinstance(storage_type, _StorageType):
            raise PickleError("it refers to something else than numbers")
        if type(key) is not str or type(count) is not int or not 0 <= count < 1 << 40:
            raise PickleError("it refers to numbers without a key or a length")
        dtype = storage_type.dtype
        size = count * dtype.itemsize
        start, held_size = self.locate(key, count, dtype.itemsize)
        if held_size != size or (self.content is not None and start + size > len(self.content)):
            raise PickleError(f"it states {size} bytes for storage {key}, and holds {held_size}")
        if self.content is None or count == 0:
            device = "cpu" if self.content is not None else "meta"
            return _Storage(torch.empty(count, dtype=dtype, device=device))
        if start % dtype.itemsize:
            numbers = bytearray(self.content[start : start + size])
            return _Storage(torch.frombuffer(numbers, dtype=dtype))
        return _Storage(torch.frombuffer(self.content, dtype=dtype, count=count, offset=start))


@dataclass(frozen=True, eq=False)
class _Storage:
    """The numbers of one storage."""

    flat: Tensor  # [N]


def _tensor(storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> Tensor:
    """Return a view of a storage's numbers, after checking that all of them exist."""
    numbers = (offset, *size, *stride)
    is_plain = all(type(n) is int and 0 <= n < 1 << 48 for n in numbers)
    if type(storage) is not _Storage or not is_plain or len(size) != len(stride):
        raise PickleError("it holds a tensor without its numbers or its shape")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if math.prod(size) >= 1 << 48 or (math.prod(size) and last >= len(storage.flat)):
        raise PickleError(f"it holds a tensor {list(size)} without as many numbers")
    return storage.flat.as_strided(size, stride, offset if math.prod(size) else 0)


def _parameter(data: Any, *_: Any) -> Tensor:
    """Return the tensor of a parameter."""
    if not isinstance(data, Tensor):
        raise PickleError("it holds a parameter that is no tensor")
    return data


def _dictionary(items: Any = ()) -> dict[Any, Any]:
    """Return the dictionary of an OrderedDict or a Counter."""
    if type(items) is dict:  # a Counter's
        return items
    if type(items) not in (tuple, list) or not all(type(key) is str for key, _ in items):
        raise PickleError("it holds a dictionary by keys that are no text")
    return dict(items)


def _unchanged(value: Any, *_: Any) -> Any:
    """Return sizes, sets and devices as the tuple, list or text that they are made of."""
    return value


def _names() -> dict[tuple[str, str], Callable[..., Any]]:
    """Map the modules and names that a checkpoint may use to the functions that replace them."""
    torch_dtypes = {
        "Double": torch.float64,
        "Float": torch.float32,
        "Half": torch.float16,
        "BFloat16": torch.bfloat16,
        "Long": torch.int64,
        "Int": torch.int32,
        "Short": torch.int16,
        "Char": torch.int8,
        "Byte": torch.uint8,
        "Bool": torch.bool,
    }
    storages = {f"{name}Storage": _StorageType(dtype) for name, dtype in torch_dtypes.items()}
    dtype_names = {str(d).removeprefix("torch."): _StorageType(d) for d in torch_dtypes.values()}
    return {
        **ARRAY_NAMES,
        **{
            ("torch", name): storage_type for name, storage_type in (storages | dtype_names).items()
        },
        **{("torch.cuda", name): storage_type for name, storage_type in storages.items()},
        **{("torch._utils", f"_rebuild_tensor{v}"): _tensor for v in ("", "_v2")},
        **{("torch._utils", f"_rebuild_parameter{v}"): _parameter for v in ("", "_with_state")},
        ("collections", "OrderedDict"): _dictionary,
        ("collections", "Counter"): _dictionary,
        **{(module, "set"): _unchanged for module in ("builtins", "__builtin__")},
        ("torch", "Size"): _unchanged,
        ("torch", "device"): _unchanged,
    }


_NAMES = _names()


@dataclass(eq=False)
class SettingsRecord(Record):
    """An object of OmegaConf's, or a value inside of one, of which no code is run."""

    state: Any = None  # the attributes of the object

    def build(self, state: Any) -> None:
        """Keep the attributes."""
        self.state = state

    def setting(self, *names: str) -> Any:
        """Return the text or number under these names; None if there is none."""
        node: Any = self
        for name in names:
            state = node.state if isinstance(node, SettingsRecord) else None
            content = state.get("_content") if isinstance(state, dict) else None
            node = content.get(name) if isinstance(content, dict) else None
        state = node.state if isinstance(node, SettingsRecord) else None
        value = state.get("_val") if isinstance(state, dict) else None
        return value if isinstance(value, str | int | float) else None


class _NamesWithSettings(dict[tuple[str, str], Callable[..., Any]]):
    """The names of a checkpoint, and those of OmegaConf's settings in it."""

    def __contains__(self, key: object) -> bool:
        """Return True for a name that is replaced."""
        if super().__contains__(key) or key == ("collections", "defaultdict"):
            return True
        module, name = key if isinstance(key, tuple) else ("", "")
        if module in ("builtins", "__builtin__"):
            return name in ("dict", "list", "tuple", "str", "unicode", "int", "float", "bool")
        return str(module).partition(".")[0] in ("omegaconf", "typing", "pathlib")

    def __missing__(self, key: tuple[str, str]) -> Callable[..., Any]:
        """Return the replacement of a name of the settings."""
        if key == ("collections", "defaultdict"):
            return lambda *_: {}
        return lambda *_: SettingsRecord()


def dictionary_in(content: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    """Return a dictionary inside a checkpoint.

    Raises:
        AdapterError: the checkpoint has no dictionary of that name; the message lists its names.
    """
    entries = content.get(name)
    if not isinstance(entries, Mapping):
        keys = ", ".join(map(str, list(content)[:12])) or "nothing"
        raise AdapterError(f"{where} holds no dictionary {name!r}; it holds {keys}")
    return entries


def checked_tensor(
    content: Mapping[str, Any],
    name: str,
    shape: Sequence[int | None],
    where: str,
    *,
    dtype: torch.dtype | None = torch.float32,
    error: type[ClimateGSError] = AdapterError,
) -> Tensor:
    """Return a checked tensor of a file.

    Args:
        content: the file's tensors by name.
        name: the tensor's name.
        shape: its shape; None stands for any length.
        where: the file, for messages.
        dtype: its type; None for any.
        error: the class of the exception to raise.

    Raises:
        error: the tensor is missing, is no tensor, has another shape or type, or lacks some of its
            numbers: a small file can announce a tensor of any size.
    """
    values = content.get(name)
    if not isinstance(values, Tensor):
        keys = ", ".join(map(str, list(content)[:12])) or "nothing"
        raise error(f"{where} lacks the tensor {name!r}; it holds {keys}")
    if values.layout != torch.strided or values.is_nested or values.is_meta:
        raise error(f"{where}: {name} must be plain numbers; got a tensor of another kind")
    has_shape = len(values.shape) == len(shape) and all(
        expected_length is None or length == expected_length
        for length, expected_length in zip(values.shape, shape, strict=True)
    )
    if not has_shape or (dtype is not None and values.dtype != dtype):
        shape_text = ", ".join(
            "any" if expected_length is None else str(expected_length) for expected_length in shape
        )
        dtype_text = "" if dtype is None else f"{str(dtype)[6:]} "
        raise error(
            f"{where}: {name} must be {dtype_text}[{shape_text}]; got {str(values.dtype)[6:]} "
            f"{list(values.shape)}"
        )
    if values.numel() * values.element_size() > values.untyped_storage().nbytes():
        raise error(
            f"{where}: {name} says it is {list(values.shape)} but the file does not hold as many "
            f"numbers; obtain the file again"
        )
    return values.detach()


def finite_array(
    content: Mapping[str, Any], name: str, shape: Sequence[int | None], where: str
) -> np.ndarray:
    """Return a small checked float32 tensor as float64.

    Raises:
        AdapterError: as `checked_tensor`, or the tensor holds NaN or infinite numbers.
    """
    values = copy_mapped_tensor(checked_tensor(content, name, shape, where)).double().numpy()
    if not np.isfinite(values).all():
        raise AdapterError(f"{where}: {name} holds NaN or infinite numbers")
    return values


def copy_mapped_tensor(source: Tensor, out: Tensor | None = None) -> Tensor:
    """Copy a mapped tensor and give its pages back on the way, so that its memory is needed once.

    Args:
        source: the mapped tensor.
        out: the tensor to copy into, of the source's shape; it may be a part of a larger one.
    """
    out = torch.empty(source.shape, dtype=source.dtype) if out is None else out
    if not source.is_contiguous() or source.dim() == 0:
        return out.copy_(source)
    rows = max(1, _COPY_CHUNK // max(1, source[:1].numel()))
    for start in range(0, len(source), rows):
        out[start : start + rows] = source[start : start + rows]
        release(source[start : start + rows])
    return out


def release(source: Tensor) -> None:
    """Give back the pages of a mapped tensor that nobody has written to.

    Reading the tensor again brings them back. Only tensors of `load_checkpoint` may be given.
    """
    begin = source.data_ptr()
    end = begin + source.numel() * source.element_size()
    first = -(-begin // mmap.PAGESIZE) * mmap.PAGESIZE
    last = end // mmap.PAGESIZE * mmap.PAGESIZE
    if last > first:
        ctypes.CDLL(None).madvise(
            ctypes.c_void_p(first), ctypes.c_size_t(last - first), _MADV_DONTNEED
        )
