"""A manifest's rows in a fifth of its memory, with random access to single ones.

A row of a manifest with short names takes 440 bytes in an Arrow table and 84 here: most of it are
paths and names that repeat. Here a column is its distinct values and one small number a row; paths
are split into folder and file name, of which there are few. Rows are NumPy arrays, so
forked workers share them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from augment.batch.manifest import weather_columns

_PATH = r"(?s)^(?P<folder>.*/)?(?P<name>[^/]*)$"  # the folder with its slash
_MOST_CODES = 1 << 16  # numbers of more distinct values are kept as they are
_DIGEST_LENGTH = 64  # hexadecimal digits of a SHA-256
_HEX_DIGITS = np.frombuffer(b"0123456789abcdef", np.uint8)


@runtime_checkable
class Column(Protocol):
    """One column: a value by its row, or as an Arrow array."""

    def __len__(self) -> int: ...
    def __getitem__(self, row: int) -> Any: ...
    def take(self, rows: np.ndarray) -> Column: ...
    @property
    def nbytes(self) -> int: ...
    def arrow(self, kind: pa.DataType) -> pa.Array: ...


@dataclass(frozen=True, eq=False)
class Coded:
    """values: the distinct ones. codes: unsigned [N], which of them a row has."""

    codes: np.ndarray
    values: list[Any]

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, row: int) -> Any:
        return self.values[self.codes[row]]

    @property
    def nbytes(self) -> int:
        return self.codes.nbytes

    def take(self, rows: np.ndarray) -> Coded:
        return Coded(self.codes[rows], self.values)

    def arrow(self, kind: pa.DataType) -> pa.Array:
        return pa.array(self.values, kind).take(pa.array(self.codes))


@dataclass(frozen=True, eq=False)
class Numbers:
    """A number a row."""

    numbers: np.ndarray

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, row: int) -> Any:
        return self.numbers[row].item()

    @property
    def nbytes(self) -> int:
        return self.numbers.nbytes

    def take(self, rows: np.ndarray) -> Numbers:
        return Numbers(self.numbers[rows])

    def arrow(self, kind: pa.DataType) -> pa.Array:
        return pa.array(self.numbers, kind)


@dataclass(frozen=True, eq=False)
class Paths:
    """folders, names: whose texts joined are the path; None where a row has none."""

    folders: Coded
    names: Coded

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, row: int) -> str | None:
        parts = self.parts(row)
        return None if parts is None else parts[0] + parts[1]

    def parts(self, row: int) -> tuple[str, str] | None:
        """The folder, with its slash or empty, and the file's name."""
        name = self.names[row]
        return None if name is None else (self.folders[row], name)

    @property
    def nbytes(self) -> int:
        return self.folders.nbytes + self.names.nbytes

    def take(self, rows: np.ndarray) -> Paths:
        return Paths(self.folders.take(rows), self.names.take(rows))

    def arrow(self, kind: pa.DataType) -> pa.Array:
        joined: Any = pc.binary_join_element_wise(  # pyright: ignore[reportAttributeAccessIssue]
            self.folders.arrow(kind), self.names.arrow(kind), ""
        )
        return joined


@dataclass(frozen=True, eq=False)
class Digests:
    """SHA-256 digests, which all differ. digests: uint8 [N, 32]."""

    digests: np.ndarray

    def __len__(self) -> int:
        return len(self.digests)

    def __getitem__(self, row: int) -> str:
        return self.digests[row].tobytes().hex()

    @property
    def nbytes(self) -> int:
        return self.digests.nbytes

    def take(self, rows: np.ndarray) -> Digests:
        return Digests(self.digests[rows])

    def arrow(self, kind: pa.DataType) -> pa.Array:
        digits = np.stack([self.digests >> 4, self.digests & 15], axis=-1)
        text = _HEX_DIGITS[digits].tobytes()
        ends = np.arange(len(self) + 1, dtype=np.int32) * _DIGEST_LENGTH
        return pa.StringArray.from_buffers(len(self), pa.py_buffer(ends), pa.py_buffer(text))


@dataclass(frozen=True, eq=False)
class Rows:
    """Columns of equal length by name. schema: the manifest's, in its order of columns.

    weather: the names of the columns that hold weather numbers.
    """

    columns: Mapping[str, Column]
    schema: pa.Schema
    weather: tuple[str, ...]

    @staticmethod
    def of(table: pa.Table) -> Rows:
        """The rows of a manifest; its columns ending in `_path` hold paths."""
        schema, weather = table.schema, tuple(weather_columns(table))
        return Rows(dict(_packed_columns(table)), schema, weather)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, name: str) -> Column:
        return self.columns[name]

    @property
    def nbytes(self) -> int:
        """Of the columns' arrays; their distinct values come on top."""
        return sum(column.nbytes for column in self.columns.values())

    def take(self, rows: np.ndarray) -> Rows:
        """The rows of these numbers, or where a mask is true."""
        columns = {name: column.take(rows) for name, column in self.columns.items()}
        return Rows(columns, self.schema, self.weather)

    def coded(self, name: str) -> Coded:
        """A column of names or of other values that repeat.

        Raises:
            TypeError: the column is none of those.
        """
        column = self.columns[name]
        if isinstance(column, Numbers):  # numbers that hardly repeat
            values, codes = np.unique(column.numbers, return_inverse=True)
            return Coded(_smallest(codes, len(values)), values.tolist())
        if not isinstance(column, Coded):
            raise TypeError(f"column {name!r} holds {type(column).__name__}, not names or numbers")
        return column

    def with_outputs(self, uris: list[str], lengths: list[int]) -> Rows:
        """The rows with a column `output`: the first rows are of the first URI, and so on."""
        codes = _smallest(np.repeat(np.arange(len(uris)), lengths), len(uris))
        schema = self.schema.append(pa.field("output", pa.string()))
        return Rows({**self.columns, "output": Coded(codes, list(uris))}, schema, self.weather)

    def output_of(self, row: int) -> int:
        """Which of several outputs a row is of, by its number."""
        return int(self.coded("output").codes[row]) if "output" in self.columns else 0

    def variants(self) -> tuple[list[tuple[int, str, str]], np.ndarray]:
        """The output's number, scene and variant of all that there are, and which of them each row
        is of, int64 [N].
        """
        scenes, variants = self.coded("scene"), self.coded("variant")
        keys = scenes.codes.astype(np.int64) * len(variants.values) + variants.codes
        if "output" in self.columns:
            outputs = self.coded("output").codes.astype(np.int64)
            keys += outputs * len(scenes.values) * len(variants.values)
        found, codes = np.unique(keys, return_inverse=True)
        rest, variant = np.divmod(found, max(len(variants.values), 1))
        output, scene = np.divmod(rest, max(len(scenes.values), 1))
        each = zip(output.tolist(), scene.tolist(), variant.tolist(), strict=True)
        return [(o, scenes.values[s], variants.values[v]) for o, s, v in each], codes

    def has(self, kind: str) -> np.ndarray:
        """bool [N]: the rows that name a file of a kind of `samples.LOADABLE`."""
        column = self.columns[f"{'labels' if kind == 'boxes' else kind}_path"]
        assert isinstance(column, Paths)
        there = np.array([name is not None for name in column.names.values], bool)
        return there[column.names.codes] if len(there) else np.zeros(len(self), bool)

    def numbers(self, name: str) -> np.ndarray:
        """A numeric column, [N]; null is NaN.

        Raises:
            TypeError: the column holds no numbers.
        """
        column = self.columns[name]
        if isinstance(column, Numbers):
            return column.numbers
        kind = self.schema.field(name).type
        if not (isinstance(column, Coded) and (pa.types.is_integer(kind) or _is_float(kind))):
            raise TypeError(f"column {name!r} holds {kind}, not numbers")
        is_whole = pa.types.is_integer(kind) and None not in column.values
        values = np.array(column.values, np.int64 if is_whole else np.float64)
        return values[column.codes] if len(values) else np.zeros(0, values.dtype)

    def to_arrow(self) -> pa.Table:
        """The manifest's rows again."""
        arrays = [self.columns[field.name].arrow(field.type) for field in self.schema]
        return pa.Table.from_arrays(arrays, schema=self.schema)


def _packed_columns(table: pa.Table) -> Iterator[tuple[str, Column]]:
    for name in table.column_names:
        column = table[name]
        table = table.drop_columns(name)  # its memory is free as soon as it is packed
        yield name, _packed(name, column)


def _packed(name: str, column: pa.ChunkedArray) -> Column:
    if name.endswith("_path") and pa.types.is_string(column.type):
        parts: Any = pc.extract_regex(column, _PATH)  # pyright: ignore[reportAttributeAccessIssue]
        folders, names = parts.combine_chunks().flatten() if len(column) else (column, column)
        return Paths(_coded(pa.chunked_array([folders])), _coded(pa.chunked_array([names])))
    if name == "checksum" and (digests := _digests(column)) is not None:
        return Digests(digests)
    coded = _coded(column)
    is_number = pa.types.is_integer(column.type) or _is_float(column.type)
    if is_number and len(coded.values) > _MOST_CODES and column.null_count == 0:
        return Numbers(column.to_numpy())
    return coded


def _coded(column: pa.ChunkedArray) -> Coded:
    # Nulls have no code in Arrow: they get the one behind the last.
    encoded: Any = column.dictionary_encode().unify_dictionaries()
    values = encoded.chunk(0).dictionary.to_pylist() if encoded.num_chunks else []
    codes = np.concatenate(
        [
            np.zeros(0, np.int32),
            *(
                c.indices.fill_null(len(values)).to_numpy(zero_copy_only=False)
                for c in encoded.chunks
            ),
        ]
    )
    if column.null_count:
        values = [*values, None]
    return Coded(_smallest(codes, len(values)), values)


def _smallest(codes: np.ndarray, count: int) -> np.ndarray:
    """Codes below `count` in as few bytes as hold them."""
    return codes.astype(np.min_scalar_type(max(count - 1, 0)))


def _digests(column: pa.ChunkedArray) -> np.ndarray | None:
    """uint8 [N, 32] of a column of SHA-256 in lower-case digits; None where it is not one."""
    if column.null_count:
        return None
    pieces: list[np.ndarray] = [np.zeros((0, _DIGEST_LENGTH // 2), np.uint8)]
    value_of = np.full(256, 255, np.uint8)
    value_of[_HEX_DIGITS] = np.arange(16)
    for chunk in column.chunks:
        lengths: Any = pc.binary_length(chunk)  # pyright: ignore[reportAttributeAccessIssue]
        if (lengths.to_numpy(zero_copy_only=False) != _DIGEST_LENGTH).any():
            return None
        if not len(chunk):
            continue
        data = np.frombuffer(chunk.buffers()[2], np.uint8)
        start = np.frombuffer(chunk.buffers()[1], np.int32)[chunk.offset]
        digits = value_of[data[start : start + len(chunk) * _DIGEST_LENGTH]]
        if (digits == 255).any():
            return None
        digits = digits.reshape(len(chunk), -1, 2)
        pieces.append(digits[..., 0] << 4 | digits[..., 1])
    return np.concatenate(pieces)


def _is_float(kind: pa.DataType) -> bool:
    return pa.types.is_floating(kind)
