"""Checkpoints of trained scenes (.pth), read without running what they ask for.

Tensors are mapped from the file: what is not looked at (an optimiser's state) is never read, and
`release` gives back the memory of what has been copied.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import pickle
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.errors import AdapterError

_CHUNK = 1 << 18  # numbers copied at a time: a megabyte
_DONTNEED = 4  # linux/mman.h
_NUMPY_SCALARS = (
    "numpy.core.multiarray.scalar",  # as NumPy 1 writes it
    "numpy._core.multiarray.scalar",
    "numpy.dtype",
)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The dictionary of a checkpoint, its tensors mapped, in the processor's memory.

    NumPy's numbers, which models hold that were saved before the end of their training, are passed
    over.

    Raises:
        AdapterError: missing, damaged, of the old format of torch < 1.6, holding code or objects
            other than tensors and plain values (nothing of which is run), or no dictionary.
    """
    if not path.is_file():
        raise AdapterError(f"{path} does not exist; expected a checkpoint (.pth)")
    try:
        with _passing_over_numpy_scalars():
            found = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        reason = str(error).split("\n")[0]
        raise AdapterError(
            f"{path} was not read, and nothing in it was run: it holds more than tensors and plain "
            f"values ({reason}). Save it again as tensors, or obtain it from who trained it"
        ) from None
    except Exception as error:  # a hostile or damaged file can raise anything at all
        reason = str(error).split("\n")[0]
        raise AdapterError(
            f"{path} is no whole checkpoint of torch 1.6 or newer ({type(error).__name__}: "
            f"{reason}); copy it again"
        ) from None
    if not isinstance(found, dict):
        raise AdapterError(f"{path} must hold a dictionary; it holds a {type(found).__name__}")
    return found


def section(content: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    """A dictionary inside a checkpoint.

    Raises:
        AdapterError: there is none of that name; lists what there is.
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
) -> Tensor:
    """A tensor of a checkpoint, checked. shape: None stands for any length. dtype: None for any.

    Raises:
        AdapterError: missing, no tensor, of another shape or type, or without all its numbers: a
            small file can announce a tensor of any size.
    """
    found = content.get(name)
    if not isinstance(found, Tensor):
        keys = ", ".join(map(str, list(content)[:12])) or "nothing"
        raise AdapterError(f"{where} lacks the tensor {name!r}; it holds {keys}")
    if found.layout != torch.strided or found.is_nested or found.is_meta:
        raise AdapterError(f"{where}: {name} must be plain numbers; got a tensor of another kind")
    fits = len(found.shape) == len(shape) and all(
        want is None or have == want for have, want in zip(found.shape, shape, strict=True)
    )
    if not fits or (dtype is not None and found.dtype != dtype):
        expected = ", ".join("any" if want is None else str(want) for want in shape)
        kind = "" if dtype is None else f"{dtype} ".replace("torch.", "")
        raise AdapterError(
            f"{where}: {name} must be {kind}[{expected}]; got "
            f"{str(found.dtype).replace('torch.', '')} {list(found.shape)}"
        )
    if found.numel() * found.element_size() > found.untyped_storage().nbytes():
        raise AdapterError(
            f"{where}: {name} says it is {list(found.shape)} but the file does not hold as many "
            f"numbers; obtain the file again"
        )
    return found.detach()


def taken(source: Tensor, out: Tensor | None = None) -> Tensor:
    """A copy of a mapped tensor, whose pages are given back as it goes: memory is needed once.

    out: where to copy to, of the source's shape (it may be a part of something larger).
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


class _PassedOver:
    """Stands for a NumPy number that was not read: nothing that a file says of it is evaluated."""

    def __init__(self, *_: object) -> None: ...

    def __setstate__(self, _: object) -> None: ...


@contextlib.contextmanager
def _passing_over_numpy_scalars() -> Iterator[None]:
    with torch.serialization.safe_globals([(_PassedOver, name) for name in _NUMPY_SCALARS]):
        yield
