"""Adds up the sizes that Parquet and Feather files state, before a reader takes memory for them.

Both formats compress without a limit: 3 kB can say "400 million zeros". Arrow takes the memory that
a file asks for, so a file from anybody is checked first. Parquet's footer has sizes, but Arrow
uses those in the headers of the pages, so the check does, too. Source: the formats' specifications
(parquet-format's PageHeader in Thrift's compact protocol; Arrow's Message and RecordBatch in
FlatBuffers).
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

# Bytes of a table that is read as a whole; a manifest of a million images has some 0.5 GB.
MAX_TABLE_BYTES = 3 << 29
# Values of the columns that are read of one row group; Waymo's tables have up to 390 million.
MAX_GROUP_VALUES = 400_000_000
# Values in one row of a column, as a mean over its row group; Waymo's have up to a million.
MAX_ROW_VALUES = 1 << 22
# Pages of the columns that are read; a page usually has a megabyte.
MAX_PAGES = 200_000
# Rows of a Feather table; a sweep has a hundred thousand.
MAX_FEATHER_ROWS = 1 << 23


class StatedSizeError(ValueError):
    """A file states sizes that no reader should take memory for, or states them wrongly."""


# ---- Parquet -------------------------------------------------------------------------------------

# Bytes of one value by its physical type.
_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}
# Bytes of a text's offset; its letters are added.
_OFFSET_BYTES = 8
# Definition and repetition levels of a value in a list, two bytes each.
_LEVEL_BYTES = 4
# Kind of a page that holds a dictionary.
_DICTIONARY_PAGE = 2
# Encodings whose values are numbers of a dictionary's entries.
_DICTIONARY_ENCODINGS = (2, 8)
# Encoding of texts that share letters with the text before: each may be as long as its page.
_SHARED_LETTERS_ENCODING = 7
# Numbers of the fields of PageHeader: the page's kind, its bytes unpacked and packed, and the
# headers of data pages of versions 1 and 2.
_KIND = 1
_PAGE_BYTES = 2
_STORED_BYTES = 3
_DATA = 5
_DATA_V2 = 8
# Numbers of the fields of those headers: the count of values, and the encoding in both versions.
_COUNT = 1
_ENCODING = 2
_ENCODING_V2 = 4
# Bytes that are read at first to find a header's end, and at most.
_HEADER_BYTES = 1 << 12
_MAX_HEADER_BYTES = 1 << 20


class ChunkSize(NamedTuple):
    """The sizes that the pages of one column in one row group state."""

    path: str  # the column's path in Parquet's schema
    num_values: int  # values, entries of lists included
    num_bytes: int  # memory of the values; of texts the least
    text_bytes: int  # the most that texts of a dictionary take: the longest in every row


def check_table(
    file: pa.NativeFile, parquet: pq.ParquetFile, columns: Collection[str]
) -> list[str]:
    """Check the columns of a Parquet file that is to be read as a whole.

    Args:
        file: where the pages are read from.
        parquet: the same file.
        columns: names of the columns that will be read.

    Returns:
        Paths of text columns that may be too large if they are read as plain texts: a short
        dictionary can stand for long texts in many rows.

    Raises:
        StatedSizeError: together they are larger than MAX_TABLE_BYTES, or have too many pages.
    """
    chunks = [
        chunk
        for group in range(parquet.metadata.num_row_groups)
        for chunk in _chunk_sizes(file, parquet, group, columns)
    ]
    num_bytes = sum(chunk.num_bytes for chunk in chunks)
    if num_bytes > MAX_TABLE_BYTES:
        raise _too_large()
    text_bytes_of: Counter[str] = Counter()
    for chunk in chunks:
        text_bytes_of[chunk.path] += chunk.text_bytes
    free_bytes = MAX_TABLE_BYTES - num_bytes
    return [path for path, text_bytes in text_bytes_of.items() if text_bytes > free_bytes]


def check_row_group(
    file: pa.NativeFile, parquet: pq.ParquetFile, group: int, columns: Sequence[str]
) -> None:
    """Check the columns of a row group that is to be read in pieces of a few rows.

    Raises:
        StatedSizeError: it has more values than MAX_GROUP_VALUES, or than MAX_ROW_VALUES a row, or
            texts that do not fit in MAX_TABLE_BYTES.
    """
    chunks = _chunk_sizes(file, parquet, group, columns)
    num_rows = max(1, parquet.metadata.row_group(group).num_rows)
    for chunk in chunks:
        if chunk.num_values > MAX_ROW_VALUES * num_rows:
            raise StatedSizeError(
                f"column {chunk.path} states {chunk.num_values} values in {num_rows} rows; at most "
                f"{MAX_ROW_VALUES} a row are read"
            )
    num_values = sum(chunk.num_values for chunk in chunks)
    if num_values > MAX_GROUP_VALUES:
        raise StatedSizeError(
            f"row group {group} states {num_values} values; at most {MAX_GROUP_VALUES} are read"
        )
    text_bytes = sum(chunk.text_bytes for chunk in chunks)
    if text_bytes > MAX_TABLE_BYTES:
        raise _too_large()


def check_texts(column: pa.ChunkedArray) -> None:
    """Check a column of texts, read as a dictionary, that is to become plain texts.

    Raises:
        StatedSizeError: they would be larger than MAX_TABLE_BYTES.
    """
    num_bytes = 0
    for chunk in column.chunks:
        buffers = (text.as_buffer() for text in chunk.dictionary)
        lengths = np.array([0 if b is None else b.size for b in buffers], np.int64)
        num_bytes += int(lengths[chunk.indices.drop_null().to_numpy()].sum())
    if num_bytes > MAX_TABLE_BYTES:
        raise _too_large()


def _too_large() -> StatedSizeError:
    """Return the error for too many bytes."""
    limit = f"{MAX_TABLE_BYTES / 2**30:.1f} GiB"
    return StatedSizeError(f"it states more than {limit} of values, which are not read")


def _chunk_sizes(
    file: pa.NativeFile, parquet: pq.ParquetFile, group: int, columns: Collection[str]
) -> list[ChunkSize]:
    """Return the sizes of some columns of one row group."""
    metadata = parquet.metadata.row_group(group)
    sizes = []
    num_pages = 0
    for number in range(metadata.num_columns):
        chunk = metadata.column(number)
        path = chunk.path_in_schema
        if not any(path == name or path.startswith(f"{name}.") for name in columns):
            continue
        leaf = parquet.schema.column(number)
        pages = _read_pages(file, chunk, MAX_PAGES - num_pages)
        num_pages += len(pages)
        sizes.append(_chunk_size(path, leaf, chunk.num_values, pages))
    return sizes


class _Page(NamedTuple):
    """The header of a page."""

    is_dictionary: bool  # True if the page holds the dictionary
    is_coded: bool  # True if its values are numbers of the dictionary's entries
    num_values: int
    num_bytes: int  # the most that its values take after decompression


def _chunk_size(
    path: str, leaf: Any, num_values_in_footer: int, pages: Sequence[_Page]
) -> ChunkSize:
    """Add up the pages of one column."""
    num_values = max(num_values_in_footer, sum(page.num_values for page in pages))
    level_bytes = _LEVEL_BYTES if leaf.max_repetition_level else 0
    page_bytes = sum(page.num_bytes for page in pages)
    if leaf.physical_type == "BYTE_ARRAY":
        dictionary_bytes = sum(page.num_bytes for page in pages if page.is_dictionary)
        num_coded = sum(page.num_values for page in pages if page.is_coded)
        num_bytes = num_values * (_OFFSET_BYTES + level_bytes) + page_bytes
        return ChunkSize(path, num_values, num_bytes, num_coded * dictionary_bytes)
    width = _WIDTHS.get(leaf.physical_type) or max(1, leaf.length)
    return ChunkSize(path, num_values, max(page_bytes, num_values * (width + level_bytes)), 0)


def _read_pages(file: pa.NativeFile, chunk: Any, max_pages: int) -> list[_Page]:
    """Read the headers of all pages of one column."""
    if chunk.num_values == 0:  # Arrow reads none of its pages, and writes no offsets of them
        return []
    offsets = [chunk.data_page_offset]
    if chunk.has_dictionary_page and chunk.dictionary_page_offset:
        offsets.append(chunk.dictionary_page_offset)
    start = min(offsets)
    end = min(start + chunk.total_compressed_size, file.size())
    pages: list[_Page] = []
    while 0 <= start < end:
        if len(pages) >= max_pages:
            raise StatedSizeError(f"it has more than {MAX_PAGES} pages; write larger ones")
        header, header_bytes = _read_header(file, start)
        data = header.get(_DATA, {})
        data_v2 = header.get(_DATA_V2, {})
        values, encoding_field = (data_v2, _ENCODING_V2) if data_v2 else (data, _ENCODING)
        if not isinstance(values, dict):
            raise _damaged(start)
        stored_bytes, num_bytes = (
            _count(header, field, start) for field in (_STORED_BYTES, _PAGE_BYTES)
        )
        num_values = _count({_COUNT: 0} | values, _COUNT, start)
        encoding = values.get(encoding_field)
        is_dictionary = _count(header, _KIND, start) == _DICTIONARY_PAGE
        if encoding == _SHARED_LETTERS_ENCODING:
            num_bytes *= max(1, num_values)
        pages.append(_Page(is_dictionary, encoding in _DICTIONARY_ENCODINGS, num_values, num_bytes))
        start += header_bytes + stored_bytes
    return pages


def _count(fields: dict[int, Any], number: int, start: int) -> int:
    """Return a field that is a whole number >= 0. `start` is the page's offset, for the message."""
    value = fields.get(number)
    if not isinstance(value, int) or value < 0:
        raise _damaged(start)
    return value


def _read_header(file: pa.NativeFile, start: int) -> tuple[dict[int, Any], int]:
    """Return the fields of the page header at an offset of the file, and its length in bytes."""
    length = _HEADER_BYTES
    while True:
        data = file.read_at(length, start)
        reader = _Compact(data)
        try:
            return reader.struct(), reader.position
        except IndexError:
            if len(data) < length or length >= _MAX_HEADER_BYTES:
                raise _damaged(start) from None
        length *= 16


def _damaged(start: int) -> StatedSizeError:
    """Return the error for a damaged page header."""
    return StatedSizeError(f"the header of its page at byte {start} is damaged")


class _Compact:
    """Reads values of Thrift's compact protocol one after another from bytes.

    Raises IndexError where the bytes end, and StatedSizeError where they are invalid.
    """

    _TRUE = 1
    _FALSE = 2
    _BYTE = 3
    _DOUBLE = 7
    _BINARY = 8
    _LIST = 9
    _SET = 10
    _STRUCT = 12
    _WHOLE = (4, 5, 6)
    _MAX_DEPTH = 8

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.position = 0

    def struct(self, depth: int = 0) -> dict[int, Any]:
        """Return the fields of a struct by their numbers."""
        if depth > self._MAX_DEPTH:
            raise StatedSizeError("the header of a page is nested too deeply")
        fields: dict[int, Any] = {}
        number = 0
        while type_byte := self._byte():
            value_type = type_byte & 15
            step = type_byte >> 4
            number = number + step if step else self._whole()
            fields[number] = self._value(value_type, depth)
        return fields

    def _value(self, value_type: int, depth: int) -> Any:
        """Return a value of one type; skipped values are None."""
        if value_type in (self._TRUE, self._FALSE):
            return value_type == self._TRUE
        if value_type == self._BYTE:
            return self._byte()
        if value_type in self._WHOLE:
            return self._whole()
        if value_type == self._DOUBLE:
            return self._skip(8)
        if value_type == self._BINARY:
            return self._skip(self._varint())
        if value_type in (self._LIST, self._SET):
            list_header = self._byte()
            count = list_header >> 4 if list_header >> 4 != 15 else self._varint()
            return [self._value(list_header & 15, depth + 1) for _ in range(count)]
        if value_type == self._STRUCT:
            return self.struct(depth + 1)
        raise StatedSizeError("the header of a page has a field of no known kind")

    def _byte(self) -> int:
        """Return the next byte."""
        value = self._data[self.position]
        self.position += 1
        return value

    def _varint(self) -> int:
        """Return an unsigned number of variable length."""
        value = 0
        shift = 0
        while True:
            byte = self._byte()
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value
            if shift > 63:
                raise StatedSizeError("the header of a page has a number without an end")

    def _whole(self) -> int:
        """Return a signed number (zigzag)."""
        value = self._varint()
        return (value >> 1) ^ -(value & 1)

    def _skip(self, count: int) -> None:
        """Skip bytes."""
        self.position += count
        if self.position > len(self._data):
            raise IndexError(self.position)


# ---- Feather, version 2, which is Arrow's file format --------------------------------------------

_MAGIC = b"ARROW1"  # first bytes of a file
_STREAM_START = 8  # offset of the first message
_NO_COMPRESSION = -1  # the stated size of bytes that are not compressed
_EXTENSION_KEY = b"ARROW:extension:name"  # key of a column of an extension type


def read_feather(data: bytes) -> pa.Table:
    """Return the table of a Feather file from anybody, valid throughout.

    The messages are read in the order of the file; its footer, which may name others, is not used.

    Raises:
        StatedSizeError: the file is no Feather file of version 2, has more rows than
            MAX_FEATHER_ROWS, states more than MAX_TABLE_BYTES, or has a column of an extension
            type, which could run code.
        pyarrow.ArrowException, OSError: it is damaged.
    """
    if not data.startswith(_MAGIC):
        raise StatedSizeError("it does not begin as Feather, version 2, does")
    stream = pa.py_buffer(data).slice(_STREAM_START)
    num_rows = 0
    num_bytes = 0
    for message in pa.ipc.MessageReader.open_stream(pa.BufferReader(stream)):
        try:
            rows, size = _message_size(message)
        except struct.error:
            raise StatedSizeError("the header of one of its messages is damaged") from None
        num_rows = num_rows + rows
        num_bytes = num_bytes + size
        if num_rows > MAX_FEATHER_ROWS:
            raise StatedSizeError(
                f"it states more than {MAX_FEATHER_ROWS} rows, which are not read"
            )
        if num_bytes > MAX_TABLE_BYTES:
            raise _too_large()
    with pa.ipc.open_stream(pa.BufferReader(stream)) as reader:
        table = reader.read_all()
    table.validate(full=True)  # Arrow does not check offsets and texts when it reads
    return table


def _message_size(message: Any) -> tuple[int, int]:
    """Return the rows and bytes of a message after decompression."""
    metadata = message.metadata.to_pybytes()
    if message.type == "schema" and _EXTENSION_KEY in metadata:
        raise StatedSizeError("it has a column of an extension type, which could run code")
    batch = _FlatTable.root(metadata).table(2)
    if message.type == "dictionary" and batch is not None:
        batch = batch.table(1)
    if message.type not in ("record batch", "dictionary") or batch is None:
        return 0, 0
    body = message.body
    num_bytes = 0
    for offset, length in batch.pairs(2):
        is_compressed = batch.has(3) and length >= 8 and 0 <= offset <= len(body) - 8
        stated = struct.unpack_from("<q", body, offset)[0] if is_compressed else _NO_COMPRESSION
        num_bytes += max(length, 0) if stated == _NO_COMPRESSION else max(stated, 0)
    rows = batch.whole_number(0)
    return max(rows, max((count for count, _ in batch.pairs(1)), default=0)), num_bytes


class _FlatTable:
    """A table of FlatBuffers at an offset in bytes. Its fields have numbers.

    Raises struct.error where an offset leads out of the bytes.
    """

    def __init__(self, data: bytes, position: int) -> None:
        self._data = data
        self._position = position
        self._fields = position - self._read("<i", position)

    @staticmethod
    def root(data: bytes) -> _FlatTable:
        """Return the table that the bytes begin with."""
        return _FlatTable(data, struct.unpack_from("<I", data, 0)[0])

    def has(self, number: int) -> bool:
        """Return True if the table has a field."""
        return self._offset_of(number) != 0

    def whole_number(self, number: int) -> int:
        """Return a whole number, or 0 without the field."""
        offset = self._offset_of(number)
        return self._read("<q", offset) if offset else 0

    def table(self, number: int) -> _FlatTable | None:
        """Return a table in a field."""
        offset = self._offset_of(number)
        return _FlatTable(self._data, offset + self._read("<I", offset)) if offset else None

    def pairs(self, number: int) -> list[tuple[int, int]]:
        """Return a vector of records of two whole numbers."""
        offset = self._offset_of(number)
        if not offset:
            return []
        start = offset + self._read("<I", offset)
        count = self._read("<I", start)
        if start + 4 + 16 * count > len(self._data):
            raise struct.error("a vector is longer than its message")
        return list(struct.iter_unpack("<qq", self._data[start + 4 : start + 4 + 16 * count]))

    def _offset_of(self, number: int) -> int:
        """Return the offset of a field's value, or 0 without the field."""
        table_size = self._read("<H", self._fields)
        entry = 4 + 2 * number
        value_offset = self._read("<H", self._fields + entry) if entry < table_size else 0
        return self._position + value_offset if value_offset else 0

    def _read(self, kind: str, position: int) -> int:
        """Read one number."""
        if position < 0:  # Python would count it from the end
            raise struct.error("a position before the message")
        return struct.unpack_from(kind, self._data, position)[0]
