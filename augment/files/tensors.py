"""Safetensors files: written without a copy of the arrays, read mapped into memory."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from safetensors import safe_open
from torch import Tensor

from augment.errors import SceneError
from recipes.files import open_file

MAX_HEADER_BYTES = 100_000_000  # bytes of a header, the format's own limit
# safetensors' names of numpy's types.
_TYPES = {"<f4": "F32", "<f2": "F16", "<i2": "I16", "<i4": "I32", "<i8": "I64"}
_ALIGNMENT = 64  # bytes: a cache line, and any vector register


def write_tensors(
    file: BinaryIO, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str] | None = None
) -> None:
    """Write contiguous arrays, the widest types first, so that each one is aligned."""
    header: dict[str, object] = {} if metadata is None else {"__metadata__": dict(metadata)}
    names = sorted(arrays, key=lambda name: (-arrays[name].itemsize, name))
    end = 0
    for name in names:
        array = arrays[name]
        begin = end
        end = end + array.nbytes
        code = _TYPES[array.dtype.newbyteorder("<").str]
        header[name] = {"dtype": code, "shape": array.shape, "data_offsets": [begin, end]}
    text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-(len(text) + 8) % _ALIGNMENT)
    if len(text) > MAX_HEADER_BYTES:
        raise SceneError(
            f"{file.name}: cameras, tracks and facts take {len(text)} bytes of text; a single file "
            f"may hold {MAX_HEADER_BYTES}. Write a scene folder instead, which has no such limit"
        )
    file.write(len(text).to_bytes(8, "little"))
    file.write(text)
    for name in names:
        little_endian = arrays[name].astype(arrays[name].dtype.newbyteorder("<"), copy=False)
        file.write(little_endian.reshape(-1).view(np.uint8).data)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Map the arrays of a file and read its metadata. Writes to the arrays stay in memory."""
    try:
        open_file(path).close()  # opening a pipe would wait for ever
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return tensors, file.metadata() or {}
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error}") from error
    except Exception as error:  # whatever a damaged header leads to, in safetensors or in torch
        raise SceneError(f"{path} is damaged or no safetensors file: {error}") from error
