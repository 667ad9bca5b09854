"""The .ply container: its header, and rows of fixed size read in pieces.

Knows nothing of Gaussians. A header is not trusted: counts are compared with the size of the file
before anything is allocated, so a damaged or hostile file costs a message and no memory.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from augment.errors import SceneError

ROWS_PER_CHUNK = 16384  # about 4 MB of degree-3 rows: columns are picked out while in the cache
_MAX_HEADER_BYTES = 1 << 20
_MAX_COUNT_DIGITS = 18  # more than any file holds, few enough for int64
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "ascii"}
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class PlyElement:
    """One table of the file. columns: names and numpy type codes without byte order, in order.

    list_columns: names of properties whose length varies by row; such an element has no row size.
    """

    name: str
    count: int
    columns: tuple[tuple[str, str], ...]
    list_columns: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.columns)

    def row_dtype(self, byte_order: str) -> np.dtype:
        return np.dtype([(name, byte_order + code) for name, code in self.columns])


@dataclass(frozen=True)
class PlyHeader:
    """What a .ply says of itself. byte_order: '<', '>' or 'ascii'. body_offset: bytes."""

    path: Path
    byte_order: str
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    body_offset: int

    def element(self, name: str) -> PlyElement:
        """The element of that name.

        Raises:
            SceneError: there is none; lists those there are.
        """
        for element in self.elements:
            if element.name == name:
                return element
        found = ", ".join(repr(e.name) for e in self.elements) or "none"
        raise SceneError(f"{self.path}: expected an element {name!r} in the .ply; found {found}")


def read_ply_header(path: str | Path) -> PlyHeader:
    """Read the header of a .ply file.

    Raises:
        SceneError: not a .ply, or a header that does not parse; names the line.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: no such file; expected a .ply file")
    with path.open("rb") as file:
        lines = _header_lines(file, path)
        offset = file.tell()
    byte_order = None
    elements: list[PlyElement] = []
    comments: list[str] = []
    for number, line in enumerate(lines, start=2):
        words = line.split()
        if not words:
            continue
        if words[0] in ("comment", "obj_info"):
            comments.append(line.partition(" ")[2].strip())
        elif words[0] == "format" and len(words) == 3 and words[1] in _BYTE_ORDERS:
            byte_order = _BYTE_ORDERS[words[1]]
        elif words[0] == "element":
            elements.append(_parse_element(words, path, number))
        elif words[0] == "property" and elements:
            elements[-1] = _add_property(elements[-1], words, path, number)
        else:
            raise _bad_line(path, number, line)
    if byte_order is None:
        raise SceneError(
            f"{path}: the .ply header names no format; expected a line 'format X 1.0' with X "
            "one of " + ", ".join(_BYTE_ORDERS)
        )
    return PlyHeader(path, byte_order, tuple(elements), tuple(comments), offset)


def count_surplus_bytes(header: PlyHeader) -> int:
    """Bytes after the last row announced; 0 where that cannot be known (ascii, lists)."""
    if header.byte_order == "ascii" or any(e.list_columns for e in header.elements):
        return 0
    body = sum(e.count * e.row_dtype(header.byte_order).itemsize for e in header.elements)
    return max(0, header.path.stat().st_size - header.body_offset - body)


def iterate_rows(header: PlyHeader, name: str) -> Iterator[np.ndarray]:
    """Structured arrays of at most ROWS_PER_CHUNK rows of one element, in order.

    Ascii values arrive as float64, binary ones in the file's own types.

    Raises:
        SceneError: fewer rows than announced, a value that is no number, or rows of varying size
            in or before the element. The size is checked before the first chunk.
    """
    position = [e.name for e in header.elements].index(header.element(name).name)
    before, element = header.elements[:position], header.elements[position]
    for other in (*before, element):
        if other.list_columns and (other is element or header.byte_order != "ascii"):
            raise SceneError(
                f"{header.path}: cannot read element {name!r}: element {other.name!r} has list "
                f"properties ({', '.join(other.list_columns)}), so its rows have no fixed size; "
                f"re-save the file with {name!r} first and without lists"
            )
    if header.byte_order == "ascii":
        yield from _ascii_rows(header, element, skip=sum(e.count for e in before))
    else:
        skip = sum(e.count * e.row_dtype(header.byte_order).itemsize for e in before)
        yield from _binary_rows(header, element, header.body_offset + skip)


def _header_lines(file: BinaryIO, path: Path) -> list[str]:
    if file.readline(8).rstrip(b"\r\n") != b"ply":
        raise SceneError(f"{path}: not a .ply file: expected 'ply' as its first line")
    lines: list[str] = []
    while file.tell() < _MAX_HEADER_BYTES:
        raw = file.readline(_MAX_HEADER_BYTES)
        if not raw.endswith(b"\n"):
            break
        line = raw.decode("utf-8", errors="replace").strip()
        if line == "end_header":
            return lines
        lines.append(line)
    raise SceneError(
        f"{path}: the .ply header has no 'end_header' line in its first "
        f"{min(file.tell(), _MAX_HEADER_BYTES)} bytes; the file is truncated or not a .ply"
    )


def _bad_line(path: Path, number: int, line: str) -> SceneError:
    return SceneError(
        f"{path}: line {number} of the .ply header cannot be used: {line[:80]!r}; expected "
        "'element NAME COUNT' and 'property TYPE NAME' lines"
    )


def _parse_element(words: list[str], path: Path, number: int) -> PlyElement:
    digits = words[2] if len(words) == 3 else ""
    if not (digits.isascii() and digits.isdigit() and len(digits) <= _MAX_COUNT_DIGITS):
        raise _bad_line(path, number, " ".join(words))
    return PlyElement(words[1], int(digits), ())


def _add_property(element: PlyElement, words: list[str], path: Path, number: int) -> PlyElement:
    line = " ".join(words)
    name = words[-1]
    if name in element.names or name in element.list_columns:
        raise SceneError(
            f"{path}: line {number} of the .ply header repeats the property {name!r} of element "
            f"{element.name!r}"
        )
    if len(words) == 3 and words[1] in _TYPES:
        columns = (*element.columns, (name, _TYPES[words[1]]))
        return PlyElement(element.name, element.count, columns, element.list_columns)
    if len(words) == 5 and words[1] == "list" and words[2] in _TYPES and words[3] in _TYPES:
        lists = (*element.list_columns, name)
        return PlyElement(element.name, element.count, element.columns, lists)
    raise _bad_line(path, number, line)


def _binary_rows(header: PlyHeader, element: PlyElement, offset: int) -> Iterator[np.ndarray]:
    dtype = element.row_dtype(header.byte_order)
    available = os.stat(header.path).st_size - offset
    if element.count * dtype.itemsize > available:
        raise SceneError(
            f"{header.path}: the header announces {element.count} rows of {element.name!r} "
            f"({dtype.itemsize} bytes each), but the file ends after "
            f"{max(0, available) // max(1, dtype.itemsize)} of them; it is truncated or its header "
            "is wrong: copy or export it again"
        )
    with header.path.open("rb") as file:
        file.seek(offset)
        for start in range(0, element.count, ROWS_PER_CHUNK):
            wanted = min(ROWS_PER_CHUNK, element.count - start)
            rows = np.fromfile(file, dtype=dtype, count=wanted)
            if len(rows) < wanted:
                raise SceneError(f"{header.path}: the file became shorter while it was read")
            yield rows


def _ascii_rows(header: PlyHeader, element: PlyElement, skip: int) -> Iterator[np.ndarray]:
    dtype = np.dtype([(name, "f8") for name in element.names])
    width = len(element.columns)
    available = header.path.stat().st_size - header.body_offset
    if element.count * 2 * width > available + 1:  # a digit and a separator a value, at the least
        raise SceneError(
            f"{header.path}: the header announces {element.count} rows of {width} values in "
            f"{element.name!r}, more than the file's {available} bytes can hold; it is truncated "
            "or its header is wrong: copy or export it again"
        )
    with header.path.open("rb") as file:
        file.seek(header.body_offset)
        for _ in islice(file, skip):
            pass
        for start in range(0, element.count, ROWS_PER_CHUNK):
            wanted = min(ROWS_PER_CHUNK, element.count - start)
            words = [line.split() for line in islice(file, wanted)]
            for number, row in enumerate(words, start=start):
                if len(row) != width:
                    raise SceneError(
                        f"{header.path}: row {number} of {element.name!r} must have {width} values "
                        f"(one per property); got {len(row)}"
                    )
            if len(words) < wanted:
                raise SceneError(
                    f"{header.path}: the header announces {element.count} rows of "
                    f"{element.name!r}, but the file ends after {start + len(words)} of them"
                )
            yield _parse_numbers(words, dtype, header.path, element.name, start)


def _parse_numbers(
    words: list[list[bytes]], dtype: np.dtype, path: Path, name: str, start: int
) -> np.ndarray:
    try:
        values = np.array(words, dtype="S").astype(np.float64)
    except ValueError as error:
        raise SceneError(
            f"{path}: rows {start} to {start + len(words) - 1} of {name!r} hold a value that is "
            f"not a number ({error})"
        ) from error
    return values.view(dtype).reshape(len(words))
