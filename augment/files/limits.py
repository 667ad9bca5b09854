"""What a splat file from anywhere may cost: memory by its size, and values in its JSON.

A file of some megabytes can announce, or be unpacked to, more than any machine holds. Its readers
ask here before they allocate. Scenes of cities keep 5 to 60 bytes a Gaussian and stay far below
these limits.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from augment.errors import SceneError
from recipes.files import open_file

FREE_BYTES = 512 << 20  # of Gaussians in memory, whatever the size of their file
BYTES_PER_BYTE = 32  # of Gaussians in memory beyond that, for each byte of their file
_ROW_BYTES = 44  # place, rotation, scale and opacity of a Gaussian in float32
_COLOUR_BYTES = 12  # one spherical harmonic of three channels in float32
_ROWS = 1 << 18  # Gaussians that are decoded together, so that temporaries stay small

MAX_VALUES = 16_000_000  # of a JSON text, counted by its commas and brackets
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")


def check_memory(where: str, rows: int, *, functions: int, size: int) -> None:
    """Refuse a file whose Gaussians would take far more memory than the file has bytes.

    Args:
        where: the file, for the message.
        rows: how many Gaussians it announces.
        functions: spherical harmonics a Gaussian, 1 to 16.
        size: bytes of the file, or of all files that hold the Gaussians.

    Raises:
        SceneError: they take more than FREE_BYTES and BYTES_PER_BYTE for each byte of the file.
    """
    each = _ROW_BYTES + _COLOUR_BYTES * functions
    most = (FREE_BYTES + BYTES_PER_BYTE * size) // each
    if rows > most:
        raise SceneError(
            f"{where} announces {rows} Gaussians of {each} bytes in memory each; at most {most} "
            f"are taken from its {size} bytes ({FREE_BYTES >> 20} MiB, and {BYTES_PER_BYTE} bytes "
            f"for each of the file's): it is damaged, or made to fill the memory. If it is whole, "
            f"export it as .ply"
        )


def row_slices(count: int) -> Iterator[slice]:
    """Slices of the rows 0 to `count`, to decode large columns piece by piece."""
    for start in range(0, count, _ROWS):
        yield slice(start, min(start + _ROWS, count))


def read_json(path: Path, most: int) -> dict[str, Any]:
    """The object that a JSON file of at most `most` bytes holds; see `parsed_json`.

    Raises:
        SceneError: the file is larger, or its text cannot be used. OSError: it cannot be read.
    """
    with open_file(path) as file:
        text = file.read(most + 1)
    if len(text) > most:
        raise SceneError(f"{path} is larger than the {most} bytes that are read of such a file")
    return parsed_json(text, str(path))


def check_values(text: bytes, where: str, *, max_values: int = MAX_VALUES) -> None:
    """Refuse a JSON text with more commas and opening brackets than so many."""
    values = sum(text.count(mark) for mark in (b",", b"[", b"{"))
    if values > max_values:
        raise SceneError(f"{where}: its JSON holds {values} values; at most {max_values} are read")


def parsed_json(text: bytes, where: str, *, max_values: int = MAX_VALUES) -> dict[str, Any]:
    """The object of a JSON text.

    Args:
        text: UTF-8.
        where: the file, for messages.
        max_values: how many commas and brackets the text may have; every value costs some 60 bytes.

    Raises:
        SceneError: no JSON, no object, too many values, nested too deeply, a number of thousands
            of digits, or text with half a character (an unpaired surrogate).
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
