"""Limits of what a splat file from anywhere may cost: memory by its size, and values in its JSON.

A file of some megabytes can announce, or be unpacked to, more than any machine holds. Readers of
such files call these checks before they allocate. Scenes of cities need 5 to 60 bytes of file a
Gaussian and stay far below these limits.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from augment.errors import SceneError
from recipes.files import open_file

FREE_BYTES = 512 << 20  # bytes of Gaussians in memory that a file of any size may take
BYTES_PER_BYTE = 32  # further bytes of Gaussians in memory for each byte of their file
_ROW_BYTES = 44  # bytes of a Gaussian's mean, rotation, scale and opacity in float32
_COLOUR_BYTES = 12  # bytes of one spherical harmonic of three channels in float32
_ROWS_AT_ONCE = 1 << 18  # Gaussians that are decoded together, so that temporaries stay small

MAX_VALUES = 16_000_000  # values of a JSON text, counted by its commas and brackets
_MAX_PROBLEMS_SHOWN = 5  # problems of JSON that a message names
Entry = TypeVar("Entry", bound=BaseModel)
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")


def check_memory(where: str, num_gaussians: int, *, num_sh: int, file_bytes: int) -> None:
    """Refuse a file whose Gaussians would take far more memory than the file has bytes.

    Args:
        where: the file, for the message.
        num_gaussians: the number of Gaussians that the file announces.
        num_sh: spherical harmonics a Gaussian, 1 to 16.
        file_bytes: bytes of the file, or of all files that hold the Gaussians.

    Raises:
        SceneError: they take more than FREE_BYTES and BYTES_PER_BYTE for each byte of the file.
    """
    row_bytes = _ROW_BYTES + _COLOUR_BYTES * num_sh
    max_rows = (FREE_BYTES + BYTES_PER_BYTE * file_bytes) // row_bytes
    if num_gaussians > max_rows:
        raise SceneError(
            f"{where} announces {num_gaussians} Gaussians of {row_bytes} bytes in memory each; at "
            f"most {max_rows} are taken from its {file_bytes} bytes ({FREE_BYTES >> 20} MiB, and "
            f"{BYTES_PER_BYTE} bytes for each of the file's): it is damaged, or made to fill the "
            "memory. If it is whole, "
            f"export it as .ply"
        )


def row_slices(count: int) -> Iterator[slice]:
    """Yield slices of the rows 0 to `count`, to decode large columns piece by piece."""
    for start in range(0, count, _ROWS_AT_ONCE):
        yield slice(start, min(start + _ROWS_AT_ONCE, count))


def read_json_object(path: Path, max_bytes: int) -> dict[str, Any]:
    """Read a JSON file that holds an object; see `parse_json_object`.

    Args:
        path: the file.
        max_bytes: the largest size that is read, bytes.

    Raises:
        SceneError: the file is larger, or its text cannot be used.
        OSError: the file cannot be read.
    """
    with open_file(path) as file:
        text = file.read(max_bytes + 1)
    if len(text) > max_bytes:
        raise SceneError(
            f"{path} is larger than the {max_bytes} bytes that are read of such a file"
        )
    return parse_json_object(text, str(path))


def check_values(text: bytes, where: str, *, max_values: int = MAX_VALUES) -> None:
    """Refuse a JSON text with more than `max_values` commas and opening brackets."""
    values = sum(text.count(mark) for mark in (b",", b"[", b"{"))
    if values > max_values:
        raise SceneError(f"{where}: its JSON holds {values} values; at most {max_values} are read")


def parse_json_object(text: bytes, where: str, *, max_values: int = MAX_VALUES) -> dict[str, Any]:
    """Return the object of a JSON text.

    Args:
        text: UTF-8.
        where: the file, for messages.
        max_values: how many commas and brackets the text may have; every value costs some 60 bytes.

    Raises:
        SceneError: the text is no JSON or no object, has too many values, is nested too deeply, or
            holds a number of thousands of digits or half a character (an unpaired surrogate).
    """
    check_values(text, where, max_values=max_values)
    try:
        content = json.loads(text)
        if _SURROGATE.search(text):  # nothing could print or open such text
            json.dumps(content, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise SceneError(
            f"{where}: its JSON holds half a character (an unpaired surrogate); export it again"
        ) from None
    except (ValueError, RecursionError) as error:  # also what is no UTF-8
        reason = str(error)
        if isinstance(error, RecursionError):
            reason = "it is nested too deeply"
        elif "integer string conversion" in reason:
            reason = "it holds a number of thousands of digits"
        raise SceneError(f"{where}: its JSON cannot be read: {reason}; export it again") from None
    if not isinstance(content, dict):
        raise SceneError(f"{where}: its JSON must be an object; got {content!r:.60}")
    return content


def validate_model(model: type[Entry], content: object, where: str) -> Entry:
    """Return JSON, or a record, as the model.

    Raises:
        SceneError: it does not fit; the message names the fields.
    """
    try:
        return model.model_validate(content)
    except (RecursionError, OverflowError):
        raise SceneError(f"{where}: nested too deeply or numbers too large") from None
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False)
    problem_texts = [
        f"{'.'.join(map(str, p['loc']))}: {p['msg']}; got {p['input']!r:.60}"
        for p in problems[:_MAX_PROBLEMS_SHOWN]
    ]
    num_hidden = len(problems) - len(problem_texts)
    raise SceneError(
        f"{where}: " + "; ".join(problem_texts) + (f"; and {num_hidden} more" if num_hidden else "")
    )
