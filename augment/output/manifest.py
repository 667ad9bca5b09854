"""Manifest of an output: the table `manifest.parquet`, with one row for each image.

In: rows of images from jobs (`image_row`). Out: the table, and the file. Jobs write it, and readers
of an output (`augment.dataset`, `tools`) read it.

Rows are sorted, and nothing in them depends on when, where or by how many processes they were
made: the same images give the same file to the bit.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet as pq

from augment.errors import OutputError
from augment.output.atomic import read_file, write_atomic
from augment.output.layout import (
    FileListing,
    mask_share_columns,
    measured_columns,
    path_kinds,
    variant_name,
)
from augment.output.names import MANIFEST_FILE, STATE_FOLDER
from augment.output.store import Store, StoredFileMissing
from augment.output.tables import read_table
from recipes.fields import section_at
from recipes.moment import SceneTimes
from recipes.schema import KNOBS, SECTIONS, Recipe, columns_of_effects, settings_of
from recipes.speed import former_path
from recipes.tags import CLASS_COLUMNS, NUMBER_COLUMNS, columns_of_tags

# Status of an image whose files are complete.
OK = "ok"
# Status of an image that could not be rendered.
FAILED = "failed"

pc: Any = pyarrow.compute  # type checkers do not see the functions that it makes on import

# The last columns, behind the numbers of the effects.
TRAILING = {
    "seed": pa.int64(),
    **dict.fromkeys(("recipe", "recipe_hash", "trajectory", "version", "backend"), pa.string()),
    **dict.fromkeys(("checksum", "status", "message"), pa.string()),
}
# Columns of the first release. Every row has them; rows of older files may lack any other column.
_FIRST = {
    *("scene", "source", "variant", "frame", "camera", "timestamp_ns", "width", "height"),
    *("image_path", "depth_path", "semantic_path", "instance_path", "lidar_path", "labels_path"),
    "calibration_path",
}
# Columns that identify an image.
KEY = ("scene", "variant", "frame", "camera")
# Largest width or height of an image, pixels; no camera has as many.
MAX_SIDE_PX = 1 << 16
# Temporary column of `latest_rows`.
_RANK_COLUMN = "rank"
# Paths that are absolute, that lead upwards, or that some system or object store takes for another
# file.
_UNSAFE_PATH = r"^$|^/|(^|/)\.{1,2}(/|$)|\\|\x00"

Row = Mapping[str, Any]


def leading_columns() -> dict[str, pa.DataType]:
    """Return the first columns by name, in the file's order.

    The numbers of effects and TRAILING follow.
    """
    text_columns = [name for name, column in columns_of_effects().items() if not column.is_number]
    text = pa.string()
    integer = pa.int64()
    return {
        **dict.fromkeys(("scene", "source", "variant"), text),
        **{"frame": integer, "camera": text, "timestamp_ns": integer},
        **dict.fromkeys((f"{kind}_path" for kind in path_kinds()), text),
        **{"width": integer, "height": integer},
        **dict.fromkeys(("base", "surface", "lidar", "lidar_note", *text_columns, "quality"), text),
        **{"render_scale": pa.float64(), "settings": text, "source_digest": text},
        **{"weather_time_s": pa.float64(), "timeline_values": text},
        **dict.fromkeys(NUMBER_COLUMNS, pa.float64()),
        **dict.fromkeys(CLASS_COLUMNS, text),
        **dict.fromkeys(mask_share_columns().values(), pa.float64()),
        **dict.fromkeys(measured_columns(), pa.float64()),
    }


def later_columns() -> dict[str, str | None]:
    """Return the default values of columns that are younger than the first release.

    Without water and snow all surfaces are the same; new rows of such a variant hold the default.
    The settings that old rows were rendered with are in their recipes, and are not known here.
    """
    columns = dict.fromkeys(name for name in leading_columns() if name not in _FIRST)
    return {**columns, "base": "splats", "surface": "solid"}


def weather_columns(table: pa.Table) -> list[str]:
    """Return the names of the columns that hold numbers of effects."""
    other_columns = leading_columns().keys() | TRAILING.keys()
    return [name for name in table.column_names if name not in other_columns]


def _default_number(name: str) -> float | None:
    """Return the number that a row stands for which lacks this column."""
    column = columns_of_effects().get(name)
    return math.nan if column is None else column.value_if_absent


def effect_masks(numbers: Mapping[str, np.ndarray], rows: int) -> dict[str, np.ndarray]:
    """Return the rows in which each effect is present, bool [rows] by effect name.

    An effect is present in a row where one of its numbers says so and no number says that it is
    absent. The mask `other` marks rows with numbers that belong to no effect.

    Args:
        numbers: Values [rows] by column.
        rows: Number of rows.
    """
    masks = {}
    for path, model in SECTIONS.items():
        is_present, is_absent = np.zeros((2, rows), bool)
        for column in model.columns:
            if column.presence_values is not None and column.name in numbers:
                values = numbers[column.name].astype(np.float64)
                has_effect = column.is_present(values)
                is_present |= has_effect
                is_absent |= ~has_effect & ~np.isnan(values) & column.decides_absence
        masks[path.rpartition(".")[2]] = is_present & ~is_absent
    other_mask = np.zeros(rows, bool)
    effect_columns = columns_of_effects()
    for name, values in numbers.items():
        if name not in effect_columns and name.partition("_")[0] not in masks:
            other_mask |= ~np.isnan(values) & (values != 0)
    return {**masks, "other": other_mask}


def rows_to_table(rows: Iterable[Row]) -> pa.Table:
    """Return rows as a sorted table."""
    rows = list(rows)
    other_columns = leading_columns().keys() | TRAILING.keys()
    numbers = sorted({name for row in rows for name in row} - other_columns)
    defaults = {**later_columns(), **{name: _default_number(name) for name in numbers}}
    columns = {
        name: pa.array([row[name] if name in row else defaults[name] for row in rows], kind)
        for name, kind in _column_types(numbers).items()
    }
    return _sort_rows(pa.table(columns))


def _column_types(numbers: Iterable[str]) -> dict[str, pa.DataType]:
    """Return the types of all columns by name, in the file's order.

    Args:
        numbers: Names of the columns with numbers of effects.
    """
    return {**leading_columns(), **dict.fromkeys(numbers, pa.float64()), **TRAILING}


def read_manifest(out_dir: Path) -> pa.Table:
    """Return the manifest of an output folder.

    A manifest of an older version gains the columns that it lacks.
    """
    path = Path(out_dir) / MANIFEST_FILE
    if not path.is_file():
        raise OutputError(
            f"{path} does not exist: {out_dir} is no finished output folder. A job writes its "
            f"manifest when it ends; run it again to let it finish"
        )
    try:
        data = read_file(path)
    except OSError as error:
        raise OutputError(f"{path} cannot be read: {error.strerror}") from error
    return parse_manifest(data, str(path))


def parse_manifest(
    data: bytes, source_name: str, excluded_columns: Collection[str] = ()
) -> pa.Table:
    """Return the table in a manifest's bytes, with the columns that an older version lacks.

    Args:
        data: Bytes of the Parquet file.
        source_name: Name of the file, for errors.
        excluded_columns: Columns to leave out, which saves memory.
    """
    table = _with_later_columns(
        read_table(data, source_name, excluded_columns=excluded_columns), excluded_columns
    )
    _check_types(table, source_name, excluded_columns)
    for name in weather_columns(table):
        if table[name].null_count:  # some programs write NaN as null
            column = pc.fill_null(table[name], math.nan)
            table = table.set_column(table.column_names.index(name), name, column)
    _check_values(table, source_name)
    return table


def check_rows(rows: Sequence[Row], key: tuple[str, str], source_name: str) -> None:
    """Raise OutputError, or an error of Python or Arrow, unless a job has written these rows.

    Args:
        key: Scene and variant of all rows.
        source_name: File that holds the rows, for errors.
    """
    if wrong_rows := [row for row in rows if (row["scene"], row["variant"]) != key]:
        raise ValueError(f"a line is of {wrong_rows[0]['variant']!r:.80}, not of {key[1]!r}")
    _check_values(rows_to_table(rows), source_name)


def _check_types(table: pa.Table, source_name: str, excluded_columns: Collection[str]) -> None:
    """Raise OutputError where a column is missing or has another type."""
    column_types = {
        n: kind
        for n, kind in _column_types(weather_columns(table)).items()
        if n not in excluded_columns
    }
    advice = "It was written by another program or version: write to another output folder"
    missing_columns = sorted(column_types.keys() - set(table.column_names))
    if missing_columns:
        raise OutputError(f"{source_name} lacks the columns {missing_columns}. {advice}")
    for field in table.schema:
        if field.type != column_types[field.name]:
            raise OutputError(
                f"{source_name}: column {field.name!r} must be of type "
                f"{column_types[field.name]}; got {field.type}. {advice}"
            )


def _check_values(table: pa.Table, source_name: str) -> None:
    """Raise OutputError at the first value that no job writes."""
    later_defaults = later_columns()
    path_columns = {f"{kind}_path" for kind in path_kinds()}
    for name, column in zip(table.column_names, table.columns, strict=True):
        is_path = name in path_columns
        if column.null_count and not is_path and later_defaults.get(name, "") is not None:
            _refuse(table, name, pc.is_null(column), "a value", source_name)
        if column.null_count == table.num_rows:
            continue
        if is_path:
            is_unsafe = pc.match_substring_regex(column, _UNSAFE_PATH)
            _refuse(
                table,
                name,
                is_unsafe,
                "a path inside the output folder, relative to it",
                source_name,
            )
        elif name in ("width", "height"):
            is_wrong = pc.or_(pc.less(column, 1), pc.greater(column, MAX_SIDE_PX))
            _refuse(table, name, is_wrong, f"1 to {MAX_SIDE_PX} (pixels)", source_name)
        elif name == "render_scale":
            is_scale = pc.and_(pc.greater(column, 0), pc.is_finite(column))
            _refuse(table, name, pc.invert(is_scale), "a number above 0, or null", source_name)
        elif name in mask_share_columns().values():
            is_share = pc.and_(pc.greater_equal(column, 0), pc.less_equal(column, 1))
            _refuse(table, name, pc.invert(is_share), "0 to 1, or null", source_name)
        elif pa.types.is_floating(column.type):
            _refuse(table, name, pc.is_inf(column), "a finite number, or NaN", source_name)
        elif name == "status":
            is_status = pc.is_in(column, pa.array([OK, FAILED]))
            _refuse(table, name, pc.invert(is_status), f"{OK!r} or {FAILED!r}", source_name)
    if table["image_path"].null_count:
        lacks_path = pc.and_(pc.equal(table["status"], OK), pc.is_null(table["image_path"]))
        _refuse(table, "image_path", lacks_path, f"a path where status is {OK!r}", source_name)
    if table.num_rows > table.group_by(list(KEY), use_threads=False).aggregate([]).num_rows:
        raise _repeated_row_error(table, source_name)


def _repeated_row_error(table: pa.Table, source_name: str) -> OutputError:
    """Return the error of an image that has several rows."""
    keys = list(zip(*(table[name].to_pylist() for name in KEY), strict=True))
    key, count = Counter(keys).most_common(1)[0]
    image = ", ".join(f"{name} {part!r:.80}" for name, part in zip(KEY, key, strict=True))
    return OutputError(
        f"{source_name}: an image must have one row; {count} are of {image}, the first of them row "
        f"{keys.index(key)} (counted from 0). Leave one of them"
    )


def _refuse(
    table: pa.Table, name: str, is_wrong: pa.ChunkedArray, expected: str, source_name: str
) -> None:
    """Raise OutputError if `is_wrong` is true of a row; names the first such row."""
    row = pc.index(is_wrong, True).as_py()
    if row >= 0:
        raise OutputError(
            f"{source_name}: column {name!r}, row {row} (counted from 0) must be {expected}; got "
            f"{table[name][row].as_py()!r:.200}. No job writes that: take the file from a copy, or "
            f"write to another output folder"
        )


def rows_without_files(table: pa.Table, listing: FileListing) -> set[tuple[str, str, int, str]]:
    """Return the finished images, by `KEY`, of which a file is missing that the manifest names.

    Args:
        listing: Files of the output folder.
    """
    is_incomplete = np.zeros(table.num_rows, bool)
    for name in (f"{kind}_path" for kind in path_kinds()):
        missing_paths = [p for p in pc.unique(table[name]).to_pylist() if p and not listing.has(p)]
        if missing_paths:
            names_missing_file = pc.is_in(table[name], pa.array(missing_paths, pa.string()))
            is_incomplete |= names_missing_file.to_numpy(zero_copy_only=False)
    rows = table.filter(pc.and_(pa.array(is_incomplete), pc.equal(table["status"], OK)))
    return set(zip(*(rows[name].to_pylist() for name in KEY), strict=True))


def merge_rows(
    old_table: pa.Table | None, rows: Collection[Row], replaced_variants: set[tuple[str, str]]
) -> pa.Table:
    """Return `old_table` with new rows for the (scene, variant) pairs in `replaced_variants`."""
    new_rows = rows_to_table(rows)
    if old_table is None:
        return new_rows
    remaining_rows = old_table.filter(pa.array(~_in_variants(old_table, replaced_variants)))
    return _sort_rows(concat_rows([remaining_rows, new_rows]))


def latest_rows(tables: Sequence[pa.Table]) -> pa.Table:
    """Return one row for each image out of several tables, sorted.

    The row comes from the first table that has the image. Where that table has several rows of it,
    a finished row comes before a failed one.
    """
    table_numbers = [
        np.full(table.num_rows, number, np.int64) for number, table in enumerate(tables)
    ]
    table = concat_rows(list(tables))
    is_failed = table["status"].to_numpy(zero_copy_only=False) != OK
    rank = np.concatenate(table_numbers) * 2 + is_failed
    table = table.append_column(_RANK_COLUMN, pa.array(rank))
    order = [(name, "ascending") for name in (*KEY, _RANK_COLUMN)]
    table = table.sort_by(order).combine_chunks().drop_columns(_RANK_COLUMN)
    is_first = np.zeros(table.num_rows, bool)
    is_first[:1] = True
    for name in KEY:
        column = table[name].to_numpy(zero_copy_only=False)
        is_first[1:] |= column[1:] != column[:-1]
    return table if is_first.all() else table.filter(pa.array(is_first)).combine_chunks()


def select_variant_rows(table: pa.Table, variants: set[tuple[str, str]]) -> list[dict[str, Any]]:
    """Return the rows of some (scene, variant) pairs as dictionaries."""
    return table.filter(pa.array(_in_variants(table, variants))).to_pylist()


def write_manifest(out_dir: Path, table: pa.Table) -> Path:
    """Replace the manifest in one step; leave it as it is where the content is the same."""
    path = Path(out_dir) / MANIFEST_FILE
    data = manifest_bytes(table)
    if not (path.is_file() and read_file(path) == data):
        write_atomic(path, data)
    return path


def manifest_bytes(table: pa.Table) -> bytes:
    """Return the table as a Parquet file; the same rows give the same bytes."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, version="2.6", compression="zstd", row_group_size=1 << 16)
    return sink.getvalue().to_pybytes()


def concat_rows(tables: Sequence[pa.Table]) -> pa.Table:
    """Return the rows of all tables in one table, unsorted, with the effect numbers of all."""
    number_columns = sorted({name for table in tables for name in weather_columns(table)})
    complete_tables = []
    for table in tables:
        for name in set(number_columns) - set(table.column_names):
            defaults = pa.array([_default_number(name)] * table.num_rows, pa.float64())
            table = table.append_column(name, defaults)
        column_names = set(table.column_names)
        complete_tables.append(
            table.select([name for name in _column_types(number_columns) if name in column_names])
        )
    return pa.concat_tables(complete_tables)


def _in_variants(table: pa.Table, variants: set[tuple[str, str]]) -> np.ndarray:
    """Return the rows of some (scene, variant) pairs, bool [rows]."""
    scenes = table["scene"].to_numpy(zero_copy_only=False)
    names = table["variant"].to_numpy(zero_copy_only=False)
    is_in_variants = np.zeros(table.num_rows, bool)
    for scene, variant in variants:
        is_in_variants |= (scenes == scene) & (names == variant)
    return is_in_variants


def _with_later_columns(table: pa.Table, excluded_columns: Collection[str]) -> pa.Table:
    """Return the table with the columns that older versions lack, filled with their defaults."""
    column_types = leading_columns()
    for name, default in later_columns().items():
        if name not in table.column_names and name not in excluded_columns:
            column = pa.array([default] * table.num_rows, column_types[name])
            position = [n for n in column_types if n in table.column_names or n == name].index(name)
            table = table.add_column(position, name, column)
    return table


def _sort_rows(table: pa.Table) -> pa.Table:
    # Chunks of joined tables would show in the file, so they are combined.
    """Return the rows sorted by KEY."""
    return table.sort_by([(name, "ascending") for name in KEY]).combine_chunks()


# ---- Parts: the rows of finished blocks, which readers see also while jobs are running -----------
# `generate` jobs publish a block of images at a time: first its files, then its rows as one part,
# `.climategs/parts/<scene>/<block>-<digest>.parquet`. From time to time a process merges all parts
# into `manifest.parquet`, whose metadata lists them. The parts stay: they are the true record, and
# the manifest can be made from them again. Therefore no two writers can lose each other's rows,
# whatever their order.

# Folder of the parts.
PARTS = f"{STATE_FOLDER}/parts"
_SUFFIX = ".parquet"
# End of the names of parts with failed images, before the suffix.
_FAILED_MARK = ".failed"
# Key of the manifest's metadata that lists the merged parts.
_PARTS_KEY = b"climategs.parts"
# Times that a part may be replaced just before it is read.
_MAX_RACES = 100


@dataclass(frozen=True)
class Part:
    """The rows of a finished block, as a file."""

    key: str
    """Key of the block, `<scene>/<block>`."""
    digest: str
    """First 12 hex digits of the SHA-256 of the file."""
    has_failures: bool
    """True if some images of the block failed."""
    modified_s: float = 0.0
    """Time of the file's last change, seconds since 1970; 0 where it is not known."""

    @property
    def name(self) -> str:
        """File name of the part below the folder of parts."""
        return f"{self.key}-{self.digest}{_FAILED_MARK if self.has_failures else ''}{_SUFFIX}"

    @property
    def path(self) -> str:
        """Path of the part in the output."""
        return f"{PARTS}/{self.name}"

    @staticmethod
    def parse(path: str, modified_s: float = 0.0) -> Part | None:
        """Return the part of a path in the output; None where the path names no part."""
        if not (path.startswith(f"{PARTS}/") and path.endswith(_SUFFIX)):
            return None
        stem = path[len(PARTS) + 1 : -len(_SUFFIX)]
        has_failures = stem.endswith(_FAILED_MARK)
        key, dash, digest = stem.removesuffix(_FAILED_MARK).rpartition("-")
        return Part(key, digest, has_failures, modified_s) if dash else None


def list_parts(store: Store, scene_folder: str | None = None) -> dict[str, Part]:
    """Return the part of every published block by the block's key; reads no file.

    Args:
        scene_folder: If given, only parts of this scene.
    """
    parts: dict[str, Part] = {}
    for part in _all_parts(store, scene_folder):
        other_part = parts.get(part.key)
        parts[part.key] = part if other_part is None else max(other_part, part, key=_part_rank)
    return parts


def publish_part(store: Store, key: str, rows: pa.Table) -> Part:
    """Make a block's rows visible in one step, in place of the block's earlier rows.

    A part without failures is never replaced by a part with some.

    Returns:
        The part that stands.
    """
    data = manifest_bytes(rows)
    has_failures = FAILED in rows["status"].to_pylist()
    part = Part(key, hashlib.sha256(data).hexdigest()[:12], has_failures)
    # Parts are listed before the write: of two processes that publish one block at the same time,
    # none can then delete the other's part.
    earlier_parts = [p for p in _all_parts(store, key.rsplit("/", 1)[0]) if p.key == key]
    complete_parts = [p for p in earlier_parts if not p.has_failures]
    if has_failures and complete_parts:
        return max(complete_parts, key=_part_rank)
    store.write(part.path, data)
    store.delete([other.path for other in earlier_parts if other.name != part.name])
    return part


def read_manifest_rows(store: Store, excluded_columns: Collection[str] = ()) -> pa.Table:
    """Return the rows of all finished and failed images, sorted by `manifest.KEY`.

    Args:
        excluded_columns: Columns to leave out, which saves memory.

    Raises:
        OutputError: Nothing is finished yet, or a file is damaged.
    """
    table = _merge_parts(store, excluded_columns)[0]
    if table is None:
        raise OutputError(
            f"{store.uri} holds neither {MANIFEST_FILE} nor finished blocks: it is no output "
            f"folder, or nothing in it is finished yet. A job writes its manifest when it ends"
        )
    return table


def compact(store: Store) -> pa.Table | None:
    """Merge all parts into the manifest and return its table; None where nothing is finished.

    The caller holds the claim on the manifest, so that the last writer has seen all parts.
    """
    table, old_data, parts = _merge_parts(store)
    if table is None:
        return None
    part_names = json.dumps([part.name for part in parts], separators=(",", ":")).encode()
    data = manifest_bytes(
        table.replace_schema_metadata({_PARTS_KEY: part_names} if parts else None)
    )
    if data != old_data:
        store.write(MANIFEST_FILE, data)
    rank_of_key = {part.key: _part_rank(part) for part in parts}
    store.delete(
        [p.path for p in _all_parts(store) if _part_rank(p) < rank_of_key.get(p.key, _part_rank(p))]
    )
    return table


def parts_to_merge(store: Store) -> int:
    """Return the number of parts that the manifest does not have yet."""
    merged_names = _merged_part_names(_load_manifest(store)[0])
    return sum(part.name not in merged_names for part in list_parts(store).values())


def _merge_parts(
    store: Store, excluded_columns: Collection[str] = ()
) -> tuple[pa.Table | None, bytes | None, list[Part]]:
    """Return the rows of manifest and parts, the manifest's bytes as they are, and the parts.

    A part may be replaced between being listed and being read; then everything is read again.
    """
    for attempt in range(_MAX_RACES):
        parts = sorted(list_parts(store).values(), key=lambda part: part.name)
        table, data = _load_manifest(store, excluded_columns)
        merged_names = _merged_part_names(table)
        try:
            new_tables = [
                parse_manifest(store.read(part.path), f"{store.uri}/{part.path}", excluded_columns)
                for part in parts
                if part.name not in merged_names
            ]
        except StoredFileMissing:
            if attempt == _MAX_RACES - 1:
                raise
            continue
        table = None if table is None else table.replace_schema_metadata(None)
        if new_tables:
            table = latest_rows([concat_rows(new_tables), *([] if table is None else [table])])
        return table, data, parts
    raise AssertionError


def _load_manifest(
    store: Store, excluded_columns: Collection[str] = ()
) -> tuple[pa.Table | None, bytes | None]:
    """Return the manifest's table and bytes; None for both where there is no manifest."""
    try:
        data = store.read(MANIFEST_FILE)
    except StoredFileMissing:
        return None, None
    return parse_manifest(data, f"{store.uri}/{MANIFEST_FILE}", excluded_columns), data


def _merged_part_names(table: pa.Table | None) -> Collection[str]:
    """Return the names of the parts that a manifest's metadata lists."""
    note = None if table is None else (table.schema.metadata or {}).get(_PARTS_KEY)
    if note is None:
        return frozenset()
    try:
        names = json.loads(note)
    except (ValueError, RecursionError):  # damaged: then all parts are read again
        names = []
    if not isinstance(names, list):
        return frozenset()
    return frozenset(name for name in names if isinstance(name, str))


def _all_parts(store: Store, scene_folder: str | None = None) -> list[Part]:
    """Return all parts, including replaced ones that a killed process has left."""
    folder = PARTS if scene_folder is None else f"{PARTS}/{scene_folder}"
    files = store.list(folder).items()
    parts = [Part.parse(path, file.modified_s) for path, file in files]
    return [part for part in parts if part is not None]


def _part_rank(part: Part) -> tuple[bool, float, str]:
    """Return a sort key: of two parts of a block the greater one stands.

    A part without failures is greater; otherwise the later one is.
    """
    return not part.has_failures, part.modified_s, part.name


# ---- A row of the manifest: one image, finished or failed ----------------------------------------


@dataclass(frozen=True)
class Identity:
    """Properties that must agree for two runs to write into the same variant folder."""

    source: str
    """The scene's own statement of its origin."""
    recipe_hash: str
    """Hash of the recipe."""
    trajectory: str
    """Camera path, as of `calibration.trajectory_id`."""
    version: str
    """Version of this package."""
    backend: str
    """Backend of the rasteriser."""
    source_digest: str | None = None
    """Digest of the scene's content; None where it is not known, which agrees with any digest."""

    @staticmethod
    def of_row(row: dict[str, Any]) -> Identity:
        """Return the identity that a row of the manifest states."""
        return Identity(**{name: row[name] for name in Identity.__dataclass_fields__})

    def is_of_other_content(self, other_identity: Identity) -> bool:
        """Return True if the scene's files are known to differ."""
        return None not in (digests := {self.source_digest, other_identity.source_digest}) and (
            len(digests) > 1
        )

    def check(self, stored_identity: Identity, source_name: str) -> None:
        """Raise OutputError where images of another identity are in the folder."""
        names = {
            "source": "scene",
            "recipe_hash": "recipe hash",
            "trajectory": "camera path",
            "version": "package version",
            "backend": "backend",
        }
        new_values = asdict(self)
        stored_values = asdict(stored_identity)
        different = [
            f"{label} there {stored_values[name]!r}, here {new_values[name]!r}"
            for name, label in names.items()
            if new_values[name] != stored_values[name]
        ]
        if not different and self.is_of_other_content(stored_identity):
            different = [
                f"the files of the scene {self.source} have changed since: the digest of their "
                f"content is {stored_values['source_digest']!r} there, "
                f"{new_values['source_digest']!r} here"
            ]
        if different:
            raise OutputError(
                f"{source_name} already holds images of another kind: {'; '.join(different)}. Give "
                f"the recipe another name, choose another output folder, or ask for the variant to "
                f"be overwritten (render --overwrite, overwrite=True)"
            )


class ImageFacts(NamedTuple):
    """Identification of one image."""

    frame: int
    """Frame number."""
    camera: str
    """Camera name."""
    timestamp_ns: int
    """Time at which the image was taken."""
    width: int
    """Width of the written image, pixels."""
    height: int
    """Height of the written image, pixels."""


def image_row(
    scene: str,
    recipe: Recipe,
    identity: Identity,
    pictured: ImageFacts,
    scene_times: SceneTimes,
    *,
    paths: Mapping[str, str | None],
    status: str,
    message: str = "",
    checksum: str = "",
    lidar: str | None = None,
    lidar_note: str | None = None,
    measures: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Return the manifest's row of an image, by columns.

    Args:
        pictured: The image.
        scene_times: Times of the scene's drive.
        paths: Paths of the image's files by column; a failed image gets none, whatever they say.
        status: OK or FAILED.
        measures: Numbers that were measured of the image, as of `view_files.ViewFiles`.
    """
    return {
        "scene": scene,
        "variant": variant_name(recipe),
        **pictured._asdict(),
        **(paths if status == OK else dict.fromkeys(paths)),
        **recipe_columns(recipe),
        **moment_columns(recipe, scene_times, pictured.timestamp_ns),
        "lidar": lidar,
        "lidar_note": lidar_note,
        **dict.fromkeys((*mask_share_columns().values(), *measured_columns())),
        **(measures or {}),
        "seed": recipe.seed,
        "recipe": recipe.name,
        **vars(identity),
        "checksum": checksum,
        "status": status,
        "message": message,
    }


def moment_columns(
    recipe: Recipe, scene_times: SceneTimes, timestamp_ns: int
) -> dict[str, str | float | None]:
    """Return the values that a recipe gives an image at its own time, by columns.

    The column `timeline_values` is JSON of the values of all timelines, by dotted path. The dict is
    empty for a recipe that never changes, whose rows hold null there.

    Args:
        recipe: The recipe.
        scene_times: Times of the scene's drive.
        timestamp_ns: Time of the image.
    """
    if not recipe.changes_over_time:
        return {}
    state = recipe.at(scene_times, timestamp_ns)
    values = {timeline.path: section_at(state, timeline.path) for timeline in recipe.timelines}
    return {
        **state.columns(),
        **columns_of_tags(state),
        "weather_time_s": recipe.weather_time_s(scene_times, timestamp_ns),
        "timeline_values": json.dumps(values, separators=(",", ":")) if values else None,
    }


def recipe_columns(recipe: Recipe) -> dict[str, str | float | None]:
    """Return the values that a recipe gives all its images, by columns.

    The column `settings` is JSON of the knobs that a quality may set (recipes.schema) and that have
    an effect, by dotted path; None where the recipe has no quality. Fields of `render.speed` have
    their former paths, so that rows of all versions agree.
    """
    quality_words = recipe.quality.summary
    settings = None
    if quality_words is not None:
        knob_values = {
            former_path(path): value
            for path, value in settings_of(recipe).items()
            if KNOBS[path].is_selectable
        }
        settings = json.dumps(knob_values, separators=(",", ":"))
    return {
        "base": recipe.render.base,
        "surface": recipe.output.surface,
        **recipe.columns(),
        **columns_of_tags(recipe),
        "quality": quality_words,
        "render_scale": recipe.render.scale,
        "settings": settings,
    }


def lidar_notes(recipes: Iterable[Recipe]) -> list[str]:
    """Return notes on LiDAR sweeps that show another world than images or depth.

    There is one line for each recipe of which they do, about its first such variant.
    """
    lines_of_recipe: dict[str, list[str]] = {}
    for recipe in recipes:
        note = recipe.lidar_note(recipe.lidar)
        if note is not None:
            manner = "meets the weather" if recipe.lidar == "weather" else "passes through clean"
            line = f"{variant_name(recipe)}: LiDAR {manner}: {note}"
            lines_of_recipe.setdefault(recipe.name, []).append(line)
    return [
        lines[0] + (f", and {len(lines) - 1} more likewise" if lines[1:] else "")
        for lines in lines_of_recipe.values()
    ]
