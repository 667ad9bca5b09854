"""Pickled pandas tables from strangers, read without running what they ask for.

A pickle names functions for the reader to call. This reader knows the dozen that tables of numbers
and strings need, by exact module and name, and refuses every other before anything is called.
"""

from __future__ import annotations

import gzip
import io
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas._libs import internals
from pandas.core.indexes import base as index_base
from pandas.core.internals import managers

from augment.errors import AdapterError

MAX_BYTES = 1 << 29  # unpacked; a sweep of 170,000 points takes 8 MB
_CHUNK = 1 << 22
_GZIP_MAGIC = b"\x1f\x8b"


def _encode_latin1(text: str, encoding: str = "utf-8") -> bytes:
    """What protocol 2 pickles use to carry bytes; any other codec is refused."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"codec {encoding!r} is not needed by a table")
    return text.encode("latin1")


def _bytearray(text: str = "", encoding: str = "latin-1") -> bytearray:
    return bytearray(_encode_latin1(text, encoding))


def _allowed() -> dict[tuple[str, str], Callable[..., Any]]:
    multiarray = np.empty(0).__reduce__()[
        0
    ]  # numpy's own _reconstruct, wherever this version keeps it
    frombuffer = np.empty(0).__reduce_ex__(5)[0]  # and its _frombuffer
    scalar = np.float64(0).__reduce__()[0]
    table: dict[tuple[str, str], Callable[..., Any]] = {
        ("builtins", "slice"): slice,
        ("__builtin__", "slice"): slice,
        ("builtins", "bytearray"): _bytearray,
        ("__builtin__", "bytearray"): _bytearray,
        ("_codecs", "encode"): _encode_latin1,
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("pandas._libs.internals", "_unpickle_block"): internals._unpickle_block,
        ("pandas.core.indexes.base", "_new_Index"): index_base._new_Index,
        ("pandas.core.internals.managers", "BlockManager"): managers.BlockManager,
        ("pandas.core.internals", "BlockManager"): managers.BlockManager,
    }
    # numpy 2 renamed numpy.core to numpy._core; files of either kind must open under either.
    for core in ("numpy.core", "numpy._core"):
        table[f"{core}.multiarray", "_reconstruct"] = multiarray
        table[f"{core}.multiarray", "scalar"] = scalar
        table[f"{core}.numeric", "_frombuffer"] = frombuffer
    for module in ("pandas", "pandas.core.frame"):
        table[module, "DataFrame"] = pd.DataFrame
    for module in ("pandas", "pandas.core.indexes.range"):
        table[module, "RangeIndex"] = pd.RangeIndex
    for module in ("pandas", "pandas.core.indexes.base"):
        table[module, "Index"] = pd.Index
    # Before pandas 2 an index of integers had a class of its own.
    for module in ("pandas", "pandas.core.indexes.numeric"):
        for name in ("Int64Index", "UInt64Index", "Float64Index"):
            table[module, name] = pd.Index
    return table


_ALLOWED = _allowed()


class _TableUnpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str) -> Any:
        try:
            return _ALLOWED[module_name, global_name]
        except KeyError:
            raise pickle.UnpicklingError(
                f"it asks for {module_name}.{global_name}, which a table does not need"
            ) from None


def read_frame(path: Path, *, max_bytes: int = MAX_BYTES) -> pd.DataFrame:
    """The pandas table pickled in a file, gzipped or not.

    Numbers, booleans and object columns (strings, None, NaN) of pandas 0.25 to 3; pandas' own
    string columns are refused, since restoring them trusts lengths that the file states.

    Raises:
        AdapterError: the file is missing, truncated, larger than max_bytes when unpacked, asks for
            anything but tables and arrays, or holds no table.
    """
    data = _read_bounded(path, max_bytes)
    try:
        frame = _TableUnpickler(io.BytesIO(data)).load()
    except pickle.UnpicklingError as error:
        raise AdapterError(
            f"{path} was not read: {error}. Only pickled pandas tables of numbers and object "
            f"columns of strings are accepted: obtain the file from the dataset's publisher again"
        ) from None
    except Exception as error:  # a hostile or damaged pickle can raise anything at all
        raise AdapterError(
            f"{path} holds a damaged table ({type(error).__name__}: {error}); download it again"
        ) from error
    if type(frame) is not pd.DataFrame:
        raise AdapterError(f"{path} must hold a pandas table; it holds a {type(frame).__name__}")
    return frame


def read_array_dict(path: Path, *, max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """The arrays by name that `np.save` wrote as one dictionary into a .npy file.

    Raises:
        AdapterError: the file is missing, truncated, too large, asks for anything but arrays, or
            holds something else.
    """
    stream = io.BytesIO(_read_bounded(path, max_bytes))
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, _, dtype = read_header(stream)
        if shape != () or not dtype.hasobject:
            raise AdapterError(
                f"{path} must hold one dictionary of arrays; it holds {dtype} {list(shape)}"
            )
        held = _TableUnpickler(stream).load()
        found = held.item() if type(held) is np.ndarray and held.shape == () else held
    except AdapterError:
        raise
    except pickle.UnpicklingError as error:
        raise AdapterError(
            f"{path} was not read: {error}. Only a dictionary of arrays is accepted"
        ) from None
    except Exception as error:  # a hostile or damaged file can raise anything at all
        raise AdapterError(
            f"{path} is no .npy file of a dictionary, or a damaged one "
            f"({type(error).__name__}: {error})"
        ) from error
    is_plain = type(found) is dict and all(
        type(name) is str and type(value) is np.ndarray and not value.dtype.hasobject
        for name, value in found.items()
    )
    if not is_plain:
        raise AdapterError(f"{path} must hold a dictionary of arrays; it holds something else")
    return found


def _read_bounded(path: Path, max_bytes: int) -> bytes:
    """The file's bytes, unpacked if gzipped, never more than max_bytes of them."""
    try:
        with open(path, "rb") as raw:
            zipped = raw.read(2) == _GZIP_MAGIC
            raw.seek(0)
            stream = gzip.GzipFile(fileobj=raw) if zipped else raw
            chunks, size = [], 0
            while chunk := stream.read(_CHUNK):
                size += len(chunk)
                if size > max_bytes:
                    raise AdapterError(
                        f"{path} unpacks to more than {max_bytes} bytes; a sweep or a list of "
                        f"boxes is far smaller, so the file is not what its name says"
                    )
                chunks.append(chunk)
    except FileNotFoundError:
        raise AdapterError(f"{path} does not exist") from None
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise AdapterError(
            f"{path} is not a whole gzip file ({error}); download it again"
        ) from error
    except OSError as error:
        raise AdapterError(f"{path} cannot be read: {error}") from error
    return b"".join(chunks)
