"""Rows of a nuScenes table, read one after another and checked field by field.

A table is a JSON list of objects. The largest of trainval hold millions of rows and more than a
gigabyte, of which one scene needs a thousandth, so a table is never in memory as a whole.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.plain_files import LARGEST
from augment.errors import AdapterError
from recipes.files import open_file

_CHUNK = 1 << 22  # characters read at a time
_LONGEST_ROW = 1 << 24  # no published row has a ten-thousandth of it
_BETWEEN = re.compile(r"[\s,]*")
_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Row:
    """One row. path: its table. fields: as in the file; further ones than are asked for may be
    there, as later editions of the dataset have them.

    All readers raise AdapterError, naming table, row and field, where a field is missing or wrong.
    """

    path: Path
    number: int
    fields: dict[str, Any]

    def __str__(self) -> str:
        name = self.fields.get("token")
        return f"{self.path}: row {name!r}" if isinstance(name, str) else self._numbered

    @property
    def _numbered(self) -> str:
        return f"{self.path}: row number {self.number}"

    @property
    def token(self) -> str:
        token = self.text("token")
        if not token:
            raise AdapterError(f"{self._numbered}: field 'token' must not be empty")
        return token

    def fault(self, field: str, expected: str) -> AdapterError:
        """The error that the field is not what was expected."""
        try:
            got = repr(self.fields[field]) if field in self.fields else "no such field"
        except RecursionError:
            got = "lists in lists"
        got = got if len(got) <= 200 else got[:200] + "…"
        return AdapterError(f"{self}: field {field!r} must be {expected}; got {got}")

    def text(self, field: str) -> str:
        value = self.fields.get(field)
        if not _is_text(value):
            raise self.fault(field, "a text")
        return value

    def texts(self, field: str) -> tuple[str, ...]:
        value = self.fields.get(field)
        if not isinstance(value, list) or not all(map(_is_text, value)):
            raise self.fault(field, "a list of texts")
        return tuple(value)

    def integer(self, field: str, *, low: int = 0) -> int:
        value = self.fields.get(field)
        if type(value) is not int or not low <= value < 2**62:
            raise self.fault(field, f"an integer of at least {low}")
        return value

    def nanoseconds(self) -> int:
        """The field `timestamp`, which the table has in microseconds."""
        value = self.fields.get("timestamp")
        # Some converters write the same number as a float.
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if type(value) is not int or not 0 < value < 2**62 // 1000:
            raise self.fault("timestamp", "a time in microseconds, a whole number above 0")
        return value * 1000

    def flag(self, field: str) -> bool:
        value = self.fields.get(field)
        if not isinstance(value, bool):
            raise self.fault(field, "true or false")
        return value

    def numbers(self, field: str, count: int) -> np.ndarray:
        """float64 [count], finite."""
        value = self.fields.get(field)
        if not isinstance(value, list) or len(value) != count or not all(map(_is_finite, value)):
            raise self.fault(field, f"a list of {count} finite numbers of at most {LARGEST:g}")
        return np.array(value, np.float64)

    def quaternion(self) -> np.ndarray:
        """The field `rotation`, wxyz, as it is: float64 [4]."""
        quat = self.numbers("rotation", 4)
        if abs(float(np.linalg.norm(quat)) - 1) > _UNIT_TOLERANCE:
            raise self.fault("rotation", "a quaternion wxyz of length 1")
        return quat

    def pose(self) -> np.ndarray:
        """The fields `translation` (metres) and `rotation`, float64 [4, 4]."""
        w, x, y, z = self.quaternion()
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        pose[:3, 3] = self.numbers("translation", 3)
        return pose


def read_rows(path: Path) -> Iterator[Row]:
    """The rows of a table, in its order.

    Raises:
        AdapterError: missing, unreadable, no JSON, cut short, or no list of objects.
    """
    try:
        with io.TextIOWrapper(open_file(path), encoding="utf-8") as file:
            yield from _rows(path, file)
    except FileNotFoundError:
        raise AdapterError(f"{path} does not exist; copy it from the dataset") from None
    except (OSError, UnicodeDecodeError) as error:
        raise AdapterError(f"{path} cannot be read as text: {error}") from None


def read_where(path: Path, field: str, wanted: Container[str]) -> dict[str, Row]:
    """The rows whose text `field` is among those wanted, by their token, in the table's order.

    Raises:
        AdapterError: as read_rows; a row without the field; two of these rows with one token.
    """
    kept: dict[str, Row] = {}
    for row in read_rows(path):
        if row.text(field) in wanted:
            _add(kept, row)
    return kept


def read_all(path: Path) -> dict[str, Row]:
    """All rows of a table by their token, as read_where."""
    kept: dict[str, Row] = {}
    for row in read_rows(path):
        _add(kept, row)
    return kept


def referred(row: Row, field: str, table: dict[str, Row], name: str) -> Row:
    """The row that a field names by its token. name: the table's, for the message."""
    found = table.get(row.text(field))
    if found is None:
        raise row.fault(field, f"the token of a row of {name}.json, which has no such row")
    return found


def _add(kept: dict[str, Row], row: Row) -> None:
    if row.token in kept:
        raise AdapterError(
            f"{row}: the token of an earlier row too (row number {kept[row.token].number}); "
            f"tokens must be unique, copy the table again"
        )
    kept[row.token] = row


def _rows(path: Path, file: Any) -> Iterator[Row]:
    decoder = json.JSONDecoder()
    first = file.read(1)
    while first.isspace():
        first = file.read(1)
    if first != "[":
        start = first + file.read(20)
        raise AdapterError(f"{path} must hold a list of rows; it starts with {start!r}")
    text, position, number, ended = "", 0, 0, False
    while True:
        between = _BETWEEN.match(text, position)
        assert between is not None
        position = between.end()
        if text[position : position + 1] == "]":
            return
        try:
            fields, position = decoder.raw_decode(text, position)
        except (ValueError, RecursionError) as error:
            if ended or len(text) - position > _LONGEST_ROW or isinstance(error, RecursionError):
                reason = "it is cut short" if ended and position >= len(text) else str(error)
                raise AdapterError(
                    f"{path} is not readable JSON after its first {number} rows ({reason}); copy "
                    f"it again"
                ) from None
            more = file.read(_CHUNK)
            text, position, ended = text[position:] + more, 0, not more
            continue
        if not isinstance(fields, dict):
            raise AdapterError(
                f"{path}: row number {number} must be an object; got {type(fields).__name__}"
            )
        yield Row(path, number, fields)
        number += 1


def _is_finite(value: object) -> bool:
    return type(value) in (int, float) and -LARGEST <= value <= LARGEST  # type: ignore[operator]


def _is_text(value: object) -> TypeGuard[str]:
    """Whether a text can be written again: half a pair of surrogates, as JSON can have, cannot."""
    if not isinstance(value, str):
        return False
    return value.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in value)
