"""The table of everything that was written: one row per image, `manifest.parquet`.

Rows are sorted, and nothing in them depends on when, where or by how many processes they were
made: the same images give the same file to the bit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet as pq

from augment.batch.atomic import write_atomic
from augment.batch.columns import read_table
from augment.batch.layout import MANIFEST, PATH_KINDS
from augment.errors import OutputError

OK, FAILED = "ok", "failed"

pc: Any = pyarrow.compute  # type checkers do not see the functions that it makes on import

# In the order of the file; the weather numbers of the recipes stand between the two groups.
LEADING = {
    "scene": pa.string(),
    "source": pa.string(),
    "variant": pa.string(),
    "frame": pa.int64(),
    "camera": pa.string(),
    "timestamp_ns": pa.int64(),
    **{f"{kind}_path": pa.string() for kind in PATH_KINDS},
    "width": pa.int64(),
    "height": pa.int64(),
    "surface": pa.string(),
    "lidar": pa.string(),
    "lidar_note": pa.string(),
    "style": pa.string(),
    "style_method": pa.string(),
    "quality": pa.string(),
    "render_scale": pa.float64(),
    "settings": pa.string(),
}
TRAILING = {
    "seed": pa.int64(),
    "recipe": pa.string(),
    "recipe_hash": pa.string(),
    "trajectory": pa.string(),
    "version": pa.string(),
    "backend": pa.string(),
    "checksum": pa.string(),
    "status": pa.string(),
    "message": pa.string(),
}
# Columns younger than the first release, and what a row without them means.
# Without water and snow all surfaces are the same; new rows of such a variant say the default.
# What old rows were rendered with is in their recipes, and not known here.
LATER: dict[str, str | None] = {
    "water_path": None,
    "snow_path": None,
    "box_2d_path": None,
    "box_water_path": None,
    "box_snow_path": None,
    "box_smog_path": None,
    "surface": "solid",
    "lidar": None,
    "lidar_note": None,
    "style": None,
    "style_method": None,
    "quality": None,
    "render_scale": None,
    "settings": None,
}
# What a row without them means by weather numbers that others have; NaN for all else.
LATER_NUMBERS = {"style_strength": 0.0}
KEY = ("scene", "variant", "frame", "camera")
MAX_SIDE_PX = 1 << 16  # of an image; no camera has as many
_RANK = "rank"
# Absolute, upwards, or not what all systems and object stores take for the same file.
_STRAYS = r"^$|^/|(^|/)\.{1,2}(/|$)|\\|\x00"

Row = Mapping[str, Any]


def weather_columns(table: pa.Table) -> list[str]:
    """Names of the columns that hold weather numbers."""
    return [n for n in table.column_names if n not in LEADING and n not in TRAILING]


def rows_to_table(rows: Iterable[Row]) -> pa.Table:
    """Rows as a sorted table; a weather number that a row lacks is what LATER_NUMBERS says."""
    rows = list(rows)
    names = {name for row in rows for name in row}
    weather = sorted(names - LEADING.keys() - TRAILING.keys())
    columns = {name: pa.array([row[name] for row in rows], kind) for name, kind in LEADING.items()}
    for name in weather:
        absent = LATER_NUMBERS.get(name, math.nan)
        columns[name] = pa.array([row.get(name, absent) for row in rows], pa.float64())
    columns |= {
        name: pa.array([row[name] for row in rows], kind) for name, kind in TRAILING.items()
    }
    return _sorted(pa.table(columns))


def read_manifest(out_dir: Path) -> pa.Table:
    """The manifest of an output folder; one of an older version gains the columns it lacks.

    Raises:
        OutputError: there is none, or as parse_manifest raises it.
    """
    path = Path(out_dir) / MANIFEST
    if not path.is_file():
        raise OutputError(
            f"{path} does not exist: {out_dir} is no finished output folder. A job writes its "
            f"manifest when it ends; run it again to let it finish"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise OutputError(f"{path} cannot be read: {error.strerror}") from error
    return parse_manifest(data, str(path))


def parse_manifest(data: bytes, where: str) -> pa.Table:
    """The table in a manifest's bytes, with the columns that an older version lacks.

    Raises:
        OutputError: the bytes are damaged, or a column is missing, of another type, or holds what
            no job writes; `where` they were read.
    """
    table = _with_later_columns(read_table(data, where))
    _check_types(table, where)
    for name in weather_columns(table):
        if table[name].null_count:  # what some programs make of NaN
            filled = pc.fill_null(table[name], math.nan)
            table = table.set_column(table.column_names.index(name), name, filled)
    _check_values(table, where)
    return table


def _check_types(table: pa.Table, where: str) -> None:
    wanted = {**LEADING, **dict.fromkeys(weather_columns(table), pa.float64()), **TRAILING}
    advice = "It was written by another program or version: write to another output folder"
    missing = sorted(wanted.keys() - set(table.column_names))
    if missing:
        raise OutputError(f"{where} lacks the columns {missing}. {advice}")
    for field in table.schema:
        if field.type != wanted[field.name]:
            raise OutputError(
                f"{where}: column {field.name!r} must be of type {wanted[field.name]}; got "
                f"{field.type}. {advice}"
            )


def _check_values(table: pa.Table, where: str) -> None:
    """Raise OutputError at the first value that no job writes."""
    for name, column in zip(table.column_names, table.columns, strict=True):
        is_path = name.removesuffix("_path") in PATH_KINDS
        if column.null_count and not is_path and LATER.get(name, "") is not None:
            _refuse(table, name, pc.is_null(column), "a value", where)
        if column.null_count == table.num_rows:
            continue
        if is_path:
            strays = pc.match_substring_regex(column, _STRAYS)
            _refuse(table, name, strays, "a path inside the output folder, relative to it", where)
        elif name in ("width", "height"):
            wrong = pc.or_(pc.less(column, 1), pc.greater(column, MAX_SIDE_PX))
            _refuse(table, name, wrong, f"1 to {MAX_SIDE_PX} (pixels)", where)
        elif name == "render_scale":
            scaled = pc.and_(pc.greater(column, 0), pc.is_finite(column))
            _refuse(table, name, pc.invert(scaled), "a number above 0, or null", where)
        elif pa.types.is_floating(column.type):
            _refuse(table, name, pc.is_inf(column), "a finite number, or NaN", where)
        elif name == "status":
            known = pc.is_in(column, pa.array([OK, FAILED]))
            _refuse(table, name, pc.invert(known), f"{OK!r} or {FAILED!r}", where)
    if table["image_path"].null_count:
        pathless = pc.and_(pc.equal(table["status"], OK), pc.is_null(table["image_path"]))
        _refuse(table, "image_path", pathless, f"a path where status is {OK!r}", where)
    if table.num_rows > table.group_by(list(KEY), use_threads=False).aggregate([]).num_rows:
        raise _repeated(table, where)


def _repeated(table: pa.Table, where: str) -> OutputError:
    keys = list(zip(*(table[name].to_pylist() for name in KEY), strict=True))
    key, count = Counter(keys).most_common(1)[0]
    image = ", ".join(f"{name} {part!r:.80}" for name, part in zip(KEY, key, strict=True))
    return OutputError(
        f"{where}: an image must have one row; {count} are of {image}, the first of them row "
        f"{keys.index(key)} (counted from 0). Leave one of them"
    )


def _refuse(table: pa.Table, name: str, wrong: pa.ChunkedArray, expected: str, where: str) -> None:
    """Raise OutputError if `wrong` is true of a row."""
    row = pc.index(wrong, True).as_py()
    if row >= 0:
        raise OutputError(
            f"{where}: column {name!r}, row {row} (counted from 0) must be {expected}; got "
            f"{table[name][row].as_py()!r:.200}. No job writes that: take the file from a copy, or "
            f"write to another output folder"
        )


def merge_rows(
    old: pa.Table | None, rows: Collection[Row], replaced: set[tuple[str, str]]
) -> pa.Table:
    """`old` with all rows of the (scene, variant) pairs in `replaced` exchanged for `rows`."""
    new = rows_to_table(rows)
    if old is None:
        return new
    kept = old.filter(pa.array(~_in_variants(old, replaced)))
    return _sorted(concat_rows([kept, new]))


def latest_rows(tables: Sequence[pa.Table]) -> pa.Table:
    """One row an image out of several tables, sorted: that of the first table that has one.

    Of an image's rows in one table, one that is finished comes before one that failed.
    """
    rank = [np.full(table.num_rows, number, np.int64) for number, table in enumerate(tables)]
    table = concat_rows(list(tables))
    failed = table["status"].to_numpy(zero_copy_only=False) != OK
    failed_last = np.concatenate(rank) * 2 + failed
    table = table.append_column(_RANK, pa.array(failed_last))
    order = [(name, "ascending") for name in (*KEY, _RANK)]
    table = table.sort_by(order).combine_chunks().drop_columns(_RANK)
    is_first = np.zeros(table.num_rows, bool)
    is_first[:1] = True
    for name in KEY:
        column = table[name].to_numpy(zero_copy_only=False)
        is_first[1:] |= column[1:] != column[:-1]
    return table if is_first.all() else table.filter(pa.array(is_first)).combine_chunks()


def rows_of(table: pa.Table, variants: set[tuple[str, str]]) -> list[dict[str, Any]]:
    """The rows of some (scene, variant) pairs, as dictionaries."""
    return table.filter(pa.array(_in_variants(table, variants))).to_pylist()


def write_manifest(out_dir: Path, table: pa.Table) -> Path:
    """Replace the manifest in one step; untouched where it already says the same.

    Raises:
        OutputError: the system refused; the old manifest then still stands.
    """
    path = Path(out_dir) / MANIFEST
    data = manifest_bytes(table)
    if not (path.is_file() and path.read_bytes() == data):
        write_atomic(path, data)
    return path


def manifest_bytes(table: pa.Table) -> bytes:
    """The table as a Parquet file: the same rows, the same bytes."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, version="2.6", compression="zstd", row_group_size=1 << 16)
    return sink.getvalue().to_pybytes()


def concat_rows(tables: Sequence[pa.Table]) -> pa.Table:
    """Tables below each other, with the weather numbers of all; unsorted."""
    weather = sorted({name for table in tables for name in weather_columns(table)})
    order = [*LEADING, *weather, *TRAILING]
    return pa.concat_tables([_with_columns(table, weather).select(order) for table in tables])


def _in_variants(table: pa.Table, variants: set[tuple[str, str]]) -> np.ndarray:
    scenes = table["scene"].to_numpy(zero_copy_only=False)
    names = table["variant"].to_numpy(zero_copy_only=False)
    mask = np.zeros(table.num_rows, bool)
    for scene, variant in variants:
        mask |= (scenes == scene) & (names == variant)
    return mask


def _with_columns(table: pa.Table, weather: list[str]) -> pa.Table:
    for name in weather:
        if name not in table.column_names:
            meaning = LATER_NUMBERS.get(name, math.nan)
            absent = pa.array([meaning] * table.num_rows, pa.float64())
            table = table.append_column(name, absent)
    return table


def _with_later_columns(table: pa.Table) -> pa.Table:
    for name, meaning in LATER.items():
        if name not in table.column_names:
            column = pa.array([meaning] * table.num_rows, LEADING[name])
            place = [n for n in LEADING if n in table.column_names or n == name].index(name)
            table = table.add_column(place, name, column)
    return table


def _sorted(table: pa.Table) -> pa.Table:
    # Without the chunks of what was joined: they would show in the file.
    return table.sort_by([(name, "ascending") for name in KEY]).combine_chunks()
