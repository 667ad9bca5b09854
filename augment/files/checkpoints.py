"""What torch saved (.pth, .pt), read without running what it asks for and without torch's reader.

Tensors are mapped from the file: what is not looked at (an optimiser's state) is never read, and
`release` gives back the memory of what has been copied.
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
from augment.files.pickles import ARRAY_NAMES, Name, Pickle, PickleError
from recipes.files import open_file

_CHUNK = 1 << 18  # numbers copied at a time: a megabyte
_DONTNEED = 4  # linux/mman.h
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The dictionary of a checkpoint, its tensors mapped, in the processor's memory. Raises
    AdapterError: missing, damaged, holding code or objects other than tensors and plain values
    (nothing of which is run), or no dictionary.
    """
    if not path.is_file():
        raise AdapterError(f"{path} does not exist; expected a checkpoint (.pth)")
    try:
        found = read_torch(path)
    except PickleError as error:
        raise AdapterError(
            f"{path} was not read, and nothing in it was run: {error}. Only tensors and plain "
            f"values are accepted: save it again as such, or copy it again"
        ) from None
    if not isinstance(found, dict):
        raise AdapterError(f"{path} must hold a dictionary; it holds a {type(found).__name__}")
    return found


def read_state_dict(
    path: Path, error: type[ClimateGSError], *, wrapped_in: Sequence[str] = ()
) -> dict[str, Tensor]:
    """Names and tensors of a network's weights, from a .safetensors file or one that torch saved.
    wrapped_in: names under which training scripts keep the state dict of a checkpoint. Raises
    error: there is no such file, it cannot be read, or it holds something else.
    """
    if not path.is_file():
        raise error(f"{path}: there is no such file of weights")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            found: Any = load_file(path)
        else:
            found = read_torch(path)
    except Exception as reason:  # safetensors' errors have no base of their own
        raise error(
            f"{path} cannot be read as weights: {str(reason).splitlines()[0]}; expected a state "
            f"dict saved by torch, or a .safetensors file"
        ) from reason
    for key in wrapped_in:
        if isinstance(found, dict) and isinstance(found.get(key), dict):
            found = found[key]
    if not isinstance(found, dict) or not all(isinstance(v, Tensor) for v in found.values()):
        raise error(
            f"{path} holds a {type(found).__name__} and not a state dict of tensors; save "
            f"model.state_dict()"
        )
    return {str(name): value for name, value in found.items()}


def read_torch(path: Path) -> Any:
    """What `torch.save` wrote, in its format or that of before torch 1.6: tensors mapped from the
    file, parameters as tensors, ordered dictionaries as dictionaries. Raises PickleError: it holds
    something else than tensors and plain values, or is damaged.
    """
    try:
        with open_file(path) as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
            if content[:4] != b"PK\3\4":
                return _read_legacy(file, content)
            with zipfile.ZipFile(file) as archive:
                return _read_zip(archive, content)
    except PickleError:
        raise
    except Exception as error:  # zipfile raises half a dozen kinds for what is damaged
        raise PickleError(f"it is no whole checkpoint of torch ({error})") from None


def _read_zip(archive: zipfile.ZipFile, content: mmap.mmap) -> Any:
    members = {entry.filename.partition("/")[2]: entry for entry in archive.infolist()}
    if "data.pkl" not in members or len(members) != len(archive.infolist()):
        raise PickleError("it is no whole checkpoint of torch (no data.pkl, or several)")
    if "byteorder" in members and archive.read(members["byteorder"]) != b"little":
        raise PickleError("it was saved on a machine of another byte order")

    storages = _Storages(content, partial(_place_in_zip, content, members))
    with archive.open(members["data.pkl"]) as opened:
        file: Any = opened  # a BufferedIOBase
        return Pickle(file, _NAMES, storage=storages).value()


def _place_in_zip(
    content: mmap.mmap, members: Mapping[str, zipfile.ZipInfo], key: str, *_: int
) -> tuple[int, int]:
    entry = members.get(f"data/{key}")
    if entry is None or entry.compress_type != zipfile.ZIP_STORED:
        raise PickleError(f"it lacks the numbers of storage {key}, or has them compressed")
    names = struct.unpack_from("<HH", content, entry.header_offset + 26)
    return entry.header_offset + 30 + sum(names), entry.file_size


def _read_legacy(file: BufferedReader, content: mmap.mmap) -> Any:
    """Three pickles of what wrote it, one of the value, one of its storages' keys; then each one's
    length and numbers. The value is read twice, for where its numbers are stands behind it.
    """
    if [Pickle(file, {}).value() for _ in range(2)] != [_LEGACY_MAGIC, _LEGACY_PROTOCOL]:
        raise PickleError("it is no whole checkpoint of torch")
    Pickle(file, {}).value()
    start = file.tell()
    sizes: dict[str, tuple[int, int]] = {}
    storages = _Storages(None, lambda key, *size: (0, math.prod(sizes.setdefault(key, size))))
    Pickle(file, _NAMES, storage=storages).value()
    keys = Pickle(file, {}).value()
    places: dict[str, tuple[int, int]] = {}
    at = file.tell()
    for key in keys:
        count, itemsize = sizes[key]
        if struct.unpack_from("<q", content, at) != (count,):  # how many numbers follow
            raise PickleError(f"it does not hold the {count} numbers of storage {key}")
        places[key] = (at + 8, count * itemsize)
        at += 8 + count * itemsize
    file.seek(start)
    return Pickle(file, _NAMES, storage=_Storages(content, lambda key, *_: places[key])).value()


@dataclass(frozen=True)
class _StorageType:
    """Stands for torch's FloatStorage and its like, which nothing calls."""

    dtype: torch.dtype

    def __call__(self, *_: Any) -> None:
        raise PickleError("it makes a storage without its numbers")


@dataclass(frozen=True)
class _Storages:
    """Makes the numbers that a checkpoint refers to, flat. content: the file; None makes them
    without values. place: of a key, how many numbers and of how many bytes each, where they start
    and how many bytes there are.
    """

    content: mmap.mmap | None
    place: Callable[[str, int, int], tuple[int, int]]

    def __call__(self, reference: Any) -> _Storage:
        what, name, key, _, count, *_ = reference
        kind = name.make if type(name) is Name else None
        if what != "storage" or not isinstance(kind, _StorageType):
            raise PickleError("it refers to something else than numbers")
        if type(key) is not str or type(count) is not int or not 0 <= count < 1 << 40:
            raise PickleError("it refers to numbers without a key or a length")
        dtype = kind.dtype
        size = count * dtype.itemsize
        start, held = self.place(key, count, dtype.itemsize)
        if held != size or (self.content is not None and start + size > len(self.content)):
            raise PickleError(f"it states {size} bytes for storage {key}, and holds {held}")
        if self.content is None or count == 0:
            where = "cpu" if self.content is not None else "meta"
            return _Storage(torch.empty(count, dtype=dtype, device=where))
        if start % dtype.itemsize:
            part = bytearray(self.content[start : start + size])
            return _Storage(torch.frombuffer(part, dtype=dtype))
        return _Storage(torch.frombuffer(self.content, dtype=dtype, count=count, offset=start))


@dataclass(frozen=True, eq=False)
class _Storage:
    flat: Tensor


def _tensor(storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> Tensor:
    """A view of a storage's numbers, after checking that they are all there."""
    numbers = (offset, *size, *stride)
    is_plain = all(type(n) is int and 0 <= n < 1 << 48 for n in numbers)
    if type(storage) is not _Storage or not is_plain or len(size) != len(stride):
        raise PickleError("it holds a tensor without its numbers or its shape")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if math.prod(size) >= 1 << 48 or (math.prod(size) and last >= len(storage.flat)):
        raise PickleError(f"it holds a tensor {list(size)} without as many numbers")
    return storage.flat.as_strided(size, stride, offset if math.prod(size) else 0)


def _parameter(data: Any, *_: Any) -> Tensor:
    if not isinstance(data, Tensor):
        raise PickleError("it holds a parameter that is no tensor")
    return data


def _dictionary(items: Any = ()) -> dict[Any, Any]:
    if type(items) is dict:  # a Counter's
        return items
    if type(items) not in (tuple, list) or not all(type(key) is str for key, _ in items):
        raise PickleError("it holds a dictionary by keys that are no text")
    return dict(items)


def _as_it_is(value: Any, *_: Any) -> Any:
    """Sizes, sets and devices: as the tuple, list or text that they are made of."""
    return value


def _names() -> dict[tuple[str, str], Callable[..., Any]]:
    kinds = {
        "Double": torch.float64, "Float": torch.float32, "Half": torch.float16,
        "BFloat16": torch.bfloat16, "Long": torch.int64, "Int": torch.int32, "Short": torch.int16,
        "Char": torch.int8, "Byte": torch.uint8, "Bool": torch.bool,
    }  # fmt: skip
    storages = {f"{name}Storage": _StorageType(dtype) for name, dtype in kinds.items()}
    dtypes = {str(d).removeprefix("torch."): _StorageType(d) for d in kinds.values()}
    return {
        **ARRAY_NAMES,
        **{("torch", name): made for name, made in (storages | dtypes).items()},
        **{("torch.cuda", name): made for name, made in storages.items()},
        **{("torch._utils", f"_rebuild_tensor{v}"): _tensor for v in ("", "_v2")},
        **{("torch._utils", f"_rebuild_parameter{v}"): _parameter for v in ("", "_with_state")},
        ("collections", "OrderedDict"): _dictionary,
        ("collections", "Counter"): _dictionary,
        **{(module, "set"): _as_it_is for module in ("builtins", "__builtin__")},
        ("torch", "Size"): _as_it_is,
        ("torch", "device"): _as_it_is,
    }


_NAMES = _names()


def section(content: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    """A dictionary inside a checkpoint. Raises AdapterError: there is none of that name; lists what
    there is.
    """
    found = content.get(name)
    if not isinstance(found, Mapping):
        keys = ", ".join(map(str, list(content)[:12])) or "nothing"
        raise AdapterError(f"{where} holds no dictionary {name!r}; it holds {keys}")
    return found


def tensor(
    content: Mapping[str, Any],
    name: str,
    shape: Sequence[int | None],
    where: str,
    *,
    dtype: torch.dtype | None = torch.float32,
    error: type[ClimateGSError] = AdapterError,
) -> Tensor:
    """A tensor of a file, checked. shape: None stands for any length. dtype: None for any. Raises
    error: missing, no tensor, of another shape or type, or without all its numbers: a small file
    can announce a tensor of any size.
    """
    found = content.get(name)
    if not isinstance(found, Tensor):
        keys = ", ".join(map(str, list(content)[:12])) or "nothing"
        raise error(f"{where} lacks the tensor {name!r}; it holds {keys}")
    if found.layout != torch.strided or found.is_nested or found.is_meta:
        raise error(f"{where}: {name} must be plain numbers; got a tensor of another kind")
    fits = len(found.shape) == len(shape) and all(
        want is None or have == want for have, want in zip(found.shape, shape, strict=True)
    )
    if not fits or (dtype is not None and found.dtype != dtype):
        expected = ", ".join("any" if want is None else str(want) for want in shape)
        kind = "" if dtype is None else f"{str(dtype)[6:]} "
        raise error(
            f"{where}: {name} must be {kind}[{expected}]; got {str(found.dtype)[6:]} "
            f"{list(found.shape)}"
        )
    if found.numel() * found.element_size() > found.untyped_storage().nbytes():
        raise error(
            f"{where}: {name} says it is {list(found.shape)} but the file does not hold as many "
            f"numbers; obtain the file again"
        )
    return found.detach()


def finite_numbers(
    content: Mapping[str, Any], name: str, shape: Sequence[int | None], where: str
) -> np.ndarray:
    """A small float32 tensor, checked, as float64. Raises AdapterError: as for `tensor`, or it
    holds NaN or infinite numbers.
    """
    values = taken(tensor(content, name, shape, where)).double().numpy()
    if not np.isfinite(values).all():
        raise AdapterError(f"{where}: {name} holds NaN or infinite numbers")
    return values


def taken(source: Tensor, out: Tensor | None = None) -> Tensor:
    """A copy of a mapped tensor, whose pages are given back as it goes: memory is needed once. out:
    where to copy to, of the source's shape (it may be a part of something larger).
    """
    out = torch.empty(source.shape, dtype=source.dtype) if out is None else out
    if not source.is_contiguous() or source.dim() == 0:
        return out.copy_(source)
    rows = max(1, _CHUNK // max(1, source[:1].numel()))
    for start in range(0, len(source), rows):
        out[start : start + rows] = source[start : start + rows]
        release(source[start : start + rows])
    return out


def release(source: Tensor) -> None:
    """Give back the pages of a mapped tensor that nobody has written to; reading brings them back.
    Call it only with tensors of `load_checkpoint`.
    """
    begin = source.data_ptr()
    end = begin + source.numel() * source.element_size()
    first = -(-begin // mmap.PAGESIZE) * mmap.PAGESIZE
    last = end // mmap.PAGESIZE * mmap.PAGESIZE
    if last > first:
        ctypes.CDLL(None).madvise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), _DONTNEED)
