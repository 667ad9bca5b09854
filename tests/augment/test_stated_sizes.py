"""Files of a few kB that say "a gigabyte of zeros" are refused before memory is taken for them."""

from __future__ import annotations

import io
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as pq
import pytest

from augment.errors import AdapterError, OutputError
from augment.files.packed_images import NUMBER_LISTS, RowReader
from augment.files.stated_sizes import StatedSizeError, read_feather
from augment.output.tables import read_table

COUNT = 5_000_000
LETTERS = "x" * 40_000
ROWS = 50_000


def parquet(column: pa.Array, **options: object) -> bytes:
    sink = io.BytesIO()
    pq.write_table(pa.table({"a": column}), sink, compression="zstd", **options)
    return sink.getvalue()


def lists(count: int) -> pa.Array:
    zeros = pa.array(np.zeros(count, np.float32))
    return pa.ListArray.from_arrays(pa.array([0, count], pa.int32()), zeros)


def varint(value: int) -> bytes:
    """A number of Thrift's compact protocol."""
    digits, value = [], value << 1
    while value:
        digits.append(value & 127)
        value >>= 7
    return bytes([*(digit | 128 for digit in digits[:-1]), digits[-1]])


def restated(data: bytes, count: int, stated: int) -> bytes:
    """The file with a footer that says another number in place of a count of values."""
    start = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    footer = data[start:-8]
    assert varint(count) in footer
    footer = footer.replace(varint(count), varint(stated))
    return data[:start] + footer + len(footer).to_bytes(4, "little") + b"PAR1"


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


TABLES: dict[str, tuple[Callable[[], bytes], str]] = {
    "numbers": (
        lambda: restated(parquet(pa.array(np.arange(1000.0))), 1000, 300_000_000),
        r"x\.parquet .* states more than 1\.5 GiB of values",
    ),
    "texts": (
        lambda: parquet(pa.DictionaryArray.from_arrays(np.zeros(ROWS, np.int8), [LETTERS])),
        r"x\.parquet .* states more than 1\.5 GiB of values",
    ),
}


def test_tables_without_rows_are_read() -> None:
    """They may have a dictionary and no page of data."""
    empty = pa.table({"a": pa.array([], pa.string()), "b": pa.array([], pa.int64())})
    sink = io.BytesIO()
    pq.write_table(empty, sink, compression="zstd")
    assert read_table(sink.getvalue(), "x.parquet").num_rows == 0


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_too_many_values_are_refused_without_the_memory(name: str) -> None:
    write, message = TABLES[name]
    data = write()
    assert len(data) < 100_000
    before = peak_mib()
    with pytest.raises(OutputError, match=message):
        read_table(data, "x.parquet")
    assert peak_mib() < before + 200


@pytest.mark.parametrize("change", [lambda data: data, lambda data: restated(data, COUNT, 100)])
def test_long_lists_are_refused_whatever_the_footer_says(
    change: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    path = tmp_path / "x.parquet"
    path.write_bytes(change(parquet(lists(COUNT))))
    before = peak_mib()
    with pytest.raises(AdapterError, match=rf"x\.parquet .*states {COUNT} values in 1 rows"):
        RowReader(path, {"a": NUMBER_LISTS}, 5).read([0])
    assert peak_mib() < before + 200


def test_pages_with_a_damaged_header_are_refused() -> None:
    data = bytearray(parquet(pa.array(np.arange(1000)), use_dictionary=False))
    data[4:12] = b"\xff" * 8  # the first page's header
    with pytest.raises(OutputError, match=r"header of (its|a) page"):
        read_table(bytes(data), "x.parquet")


def test_texts_that_may_be_too_long_but_are_not_are_read() -> None:
    texts = [*(f"{n}" for n in range(ROWS)), LETTERS]
    column = pa.array(texts).dictionary_encode()
    data = parquet(column.take(pa.array([*range(ROWS), ROWS])), dictionary_pagesize_limit=2**21)
    table = read_table(data, "x.parquet")
    assert table["a"].type == pa.string() and table["a"].to_pylist() == texts


def feather_file(table: pa.Table, compression: str = "zstd") -> bytes:
    sink = io.BytesIO()
    feather.write_feather(table, sink, compression=compression)
    return sink.getvalue()


FORMS = [
    pa.table({"a": np.arange(10.0), "b": list("abcdefghij")}),
    pa.table({"a": pa.array(["x", "y", "x"]).dictionary_encode(), "b": [[1], None, [2, 3]]}),
    pa.table({"a": pa.array([], pa.int8())}),
]


@pytest.mark.parametrize("compression", ["uncompressed", "lz4", "zstd"])
@pytest.mark.parametrize("table", FORMS)
def test_feather_is_read_as_it_was_written(table: pa.Table, compression: str) -> None:
    assert read_feather(feather_file(table, compression)).equals(table)


class Code(pa.ExtensionType):
    def __init__(self) -> None:
        super().__init__(pa.int8(), "test.code")

    def __arrow_ext_serialize__(self) -> bytes:
        return b""

    @classmethod
    def __arrow_ext_deserialize__(cls, storage_type: pa.DataType, serialized: bytes) -> Code:
        return cls()


BAD_FEATHER: list[tuple[Callable[[], bytes], str]] = [
    (lambda: feather_file(pa.table({"a": np.zeros(10_000_000, np.int8)})), "than 8388608 rows"),
    (
        lambda: feather_file(pa.table({str(i): np.zeros(8_000_000) for i in range(30)})),
        r"more than 1\.5 GiB of values",
    ),
    (lambda: b"FEA1" + bytes(100), "does not begin as Feather, version 2"),
    (
        lambda: feather_file(pa.table({"a": pa.array([1], pa.int8()).cast(Code())})),
        "extension type",
    ),
]


@pytest.mark.parametrize(("write", "message"), BAD_FEATHER)
def test_feather_files_of_strangers_are_bounded(write: Callable[[], bytes], message: str) -> None:
    data = write()
    before = peak_mib()
    with pytest.raises(StatedSizeError, match=message):
        read_feather(data)
    assert peak_mib() < before + 200
