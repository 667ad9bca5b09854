"""The table of everything that was written: one row per image, `manifest.parquet`.

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
from augment.jobs.atomic import read_file, write_atomic
from augment.jobs.layout import (
    MANIFEST,
    STATE_FOLDER,
    FileListing,
    path_kinds,
    share_columns,
    variant_name,
)
from augment.jobs.store import Store, StoredFileMissing
from augment.jobs.tables import read_table
from recipes.schema import KNOBS, SECTIONS, Recipe, columns_of_effects, settings_of

OK, FAILED = "ok", "failed"

pc: Any = pyarrow.compute  # type checkers do not see the functions that it makes on import

TRAILING = {
    "seed": pa.int64(),
    **dict.fromkeys(("recipe", "recipe_hash", "trajectory", "version", "backend"), pa.string()),
    **dict.fromkeys(("checksum", "status", "message"), pa.string()),
}
# Columns of the first release; a row without one of the others has none.
_FIRST = {
    *("scene", "source", "variant", "frame", "camera", "timestamp_ns", "width", "height"),
    *("image_path", "depth_path", "semantic_path", "instance_path", "lidar_path", "labels_path"),
    "calibration_path",
}
KEY = ("scene", "variant", "frame", "camera")
MAX_SIDE_PX = 1 << 16  # of an image; no camera has as many
_RANK = "rank"
# Absolute, upwards, or not what all systems and object stores take for the same file.
_STRAYS = r"^$|^/|(^|/)\.{1,2}(/|$)|\\|\x00"

Row = Mapping[str, Any]


def leading_columns() -> dict[str, pa.DataType]:
    """In the order of the file; the numbers of the effects follow, then TRAILING."""
    words = [name for name, column in columns_of_effects().items() if not column.is_number]
    text, whole = pa.string(), pa.int64()
    return {
        **dict.fromkeys(("scene", "source", "variant"), text),
        **{"frame": whole, "camera": text, "timestamp_ns": whole},
        **dict.fromkeys((f"{kind}_path" for kind in path_kinds()), text),
        **{"width": whole, "height": whole},
        **dict.fromkeys(("base", "surface", "lidar", "lidar_note", *words, "quality"), text),
        **{"render_scale": pa.float64(), "settings": text, "source_digest": text},
        **dict.fromkeys(share_columns().values(), pa.float64()),
    }


def later_columns() -> dict[str, str | None]:
    """Leading columns younger than the first release, and what a row without them means.

    Without water and snow all surfaces are the same; new rows of such a variant say the default.
    What old rows were rendered with is in their recipes, and not known here.
    """
    later = dict.fromkeys(name for name in leading_columns() if name not in _FIRST)
    return {**later, "base": "splats", "surface": "solid"}


def weather_columns(table: pa.Table) -> list[str]:
    """Names of the columns that hold numbers of effects."""
    others = leading_columns().keys() | TRAILING.keys()
    return [name for name in table.column_names if name not in others]


def _absent(name: str) -> float | None:
    """What a row means that lacks a number which others have."""
    column = columns_of_effects().get(name)
    return math.nan if column is None else column.absent


def effect_masks(numbers: Mapping[str, np.ndarray], rows: int) -> dict[str, np.ndarray]:
    """bool [rows] by the effects' names: where their numbers say that they are there, and none of
    them that they are not. `other`: of numbers that belong to no effect. numbers: [rows] by column.
    """
    masks = {}
    for path, model in SECTIONS.items():
        there, refuted = np.zeros((2, rows), bool)
        for column in model.columns:
            if column.shows is not None and column.name in numbers:
                values = numbers[column.name].astype(np.float64)
                present = column.is_present(values)
                there |= present
                refuted |= ~present & ~np.isnan(values) & column.refutes
        masks[path.rpartition(".")[2]] = there & ~refuted
    other, known = np.zeros(rows, bool), columns_of_effects()
    for name, values in numbers.items():
        if name not in known and name.partition("_")[0] not in masks:
            other |= ~np.isnan(values) & (values != 0)
    return {**masks, "other": other}


def rows_to_table(rows: Iterable[Row]) -> pa.Table:
    """Rows as a sorted table."""
    rows, others = list(rows), leading_columns().keys() | TRAILING.keys()
    numbers = sorted({name for row in rows for name in row} - others)
    absent = {**later_columns(), **{name: _absent(name) for name in numbers}}
    columns = {
        name: pa.array([row[name] if name in row else absent[name] for row in rows], kind)
        for name, kind in _kinds(numbers).items()
    }
    return _sorted(pa.table(columns))


def _kinds(numbers: Iterable[str]) -> dict[str, pa.DataType]:
    """All columns in their order. numbers: of effects."""
    return {**leading_columns(), **dict.fromkeys(numbers, pa.float64()), **TRAILING}


def read_manifest(out_dir: Path) -> pa.Table:
    """The manifest of an output folder; one of an older version gains the columns it lacks."""
    path = Path(out_dir) / MANIFEST
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


def parse_manifest(data: bytes, where: str, without: Collection[str] = ()) -> pa.Table:
    """The table in a manifest's bytes, with the columns that an older version lacks. without: not
    these columns, to save memory.
    """
    table = _with_later_columns(read_table(data, where, without=without), without)
    _check_types(table, where, without)
    for name in weather_columns(table):
        if table[name].null_count:  # what some programs make of NaN
            filled = pc.fill_null(table[name], math.nan)
            table = table.set_column(table.column_names.index(name), name, filled)
    _check_values(table, where)
    return table


def check_rows(rows: Sequence[Row], key: tuple[str, str], where: str) -> None:
    """Raise OutputError, or what Python and Arrow raise of wrong types, where rows are none of a
    job's. key: scene and variant of all of them. where: the file that they are from.
    """
    if wrong := [row for row in rows if (row["scene"], row["variant"]) != key]:
        raise ValueError(f"a line is of {wrong[0]['variant']!r:.80}, not of {key[1]!r}")
    _check_values(rows_to_table(rows), where)


def _check_types(table: pa.Table, where: str, without: Collection[str]) -> None:
    requested = {n: kind for n, kind in _kinds(weather_columns(table)).items() if n not in without}
    advice = "It was written by another program or version: write to another output folder"
    missing = sorted(requested.keys() - set(table.column_names))
    if missing:
        raise OutputError(f"{where} lacks the columns {missing}. {advice}")
    for field in table.schema:
        if field.type != requested[field.name]:
            raise OutputError(
                f"{where}: column {field.name!r} must be of type {requested[field.name]}; got "
                f"{field.type}. {advice}"
            )


def _check_values(table: pa.Table, where: str) -> None:
    """Raise OutputError at the first value that no job writes."""
    later, paths = later_columns(), {f"{kind}_path" for kind in path_kinds()}
    for name, column in zip(table.column_names, table.columns, strict=True):
        is_path = name in paths
        if column.null_count and not is_path and later.get(name, "") is not None:
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
        elif name in share_columns().values():
            shares = pc.and_(pc.greater_equal(column, 0), pc.less_equal(column, 1))
            _refuse(table, name, pc.invert(shares), "0 to 1, or null", where)
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


def rows_without_files(table: pa.Table, listing: FileListing) -> set[tuple[str, str, int, str]]:
    """The finished images, by `KEY`, of which a file that the manifest names is missing. listing:
    of the output folder.
    """
    mask = np.zeros(table.num_rows, bool)
    for name in (f"{kind}_path" for kind in path_kinds()):
        missing = [p for p in pc.unique(table[name]).to_pylist() if p and not listing.has(p)]
        if missing:
            named = pc.is_in(table[name], pa.array(missing, pa.string()))
            mask |= named.to_numpy(zero_copy_only=False)
    rows = table.filter(pc.and_(pa.array(mask), pc.equal(table["status"], OK)))
    return set(zip(*(rows[name].to_pylist() for name in KEY), strict=True))


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
    """One row an image out of several tables, sorted: that of the first table that has one. Of an
    image's rows in one table, one that is finished comes before one that failed.
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
    """Replace the manifest in one step; untouched where it already says the same."""
    path = Path(out_dir) / MANIFEST
    data = manifest_bytes(table)
    if not (path.is_file() and read_file(path) == data):
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
    whole = []
    for table in tables:
        for name in set(weather) - set(table.column_names):
            absent = pa.array([_absent(name)] * table.num_rows, pa.float64())
            table = table.append_column(name, absent)
        there = set(table.column_names)
        whole.append(table.select([name for name in _kinds(weather) if name in there]))
    return pa.concat_tables(whole)


def _in_variants(table: pa.Table, variants: set[tuple[str, str]]) -> np.ndarray:
    scenes = table["scene"].to_numpy(zero_copy_only=False)
    names = table["variant"].to_numpy(zero_copy_only=False)
    mask = np.zeros(table.num_rows, bool)
    for scene, variant in variants:
        mask |= (scenes == scene) & (names == variant)
    return mask


def _with_later_columns(table: pa.Table, without: Collection[str]) -> pa.Table:
    leading = leading_columns()
    for name, meaning in later_columns().items():
        if name not in table.column_names and name not in without:
            column = pa.array([meaning] * table.num_rows, leading[name])
            place = [n for n in leading if n in table.column_names or n == name].index(name)
            table = table.add_column(place, name, column)
    return table


def _sorted(table: pa.Table) -> pa.Table:
    # Without the chunks of what was joined: they would show in the file.
    return table.sort_by([(name, "ascending") for name in KEY]).combine_chunks()


# ---- What a reader sees of an output, here or in an object store, also while jobs are running ----
# `generate` jobs publish a block of images at a time: first its files, then its rows as one part,
# `.climategs/parts/<scene>/<block>-<digest>.parquet`. From time to time somebody merges all parts
# into `manifest.parquet`, whose metadata lists them. Parts stay: they are what is true, and the
# manifest can be made from them again. So no two writers can lose each other's rows, whatever the
# order.

PARTS = f"{STATE_FOLDER}/parts"
_SUFFIX = ".parquet"
_FAILED = ".failed"
_LISTED = b"climategs.parts"
_MAX_RACES = 100  # times that a part is replaced just before it is read


@dataclass(frozen=True)
class Part:
    """The rows of a finished block. key: `<scene>/<block>`. has_failures: some images failed."""

    key: str
    digest: str
    has_failures: bool
    modified_s: float = 0.0

    @property
    def name(self) -> str:
        return f"{self.key}-{self.digest}{_FAILED if self.has_failures else ''}{_SUFFIX}"

    @property
    def path(self) -> str:
        return f"{PARTS}/{self.name}"

    @staticmethod
    def parse(path: str, modified_s: float = 0.0) -> Part | None:
        """The part of a path in the output; None where it is none."""
        if not (path.startswith(f"{PARTS}/") and path.endswith(_SUFFIX)):
            return None
        stem = path[len(PARTS) + 1 : -len(_SUFFIX)]
        has_failures = stem.endswith(_FAILED)
        key, dash, digest = stem.removesuffix(_FAILED).rpartition("-")
        return Part(key, digest, has_failures, modified_s) if dash else None


def list_parts(store: Store, scene_folder: str | None = None) -> dict[str, Part]:
    """The part of every block that has one, by the block's key; no file is read. scene_folder: of
    one scene only.
    """
    found: dict[str, Part] = {}
    for part in _all_parts(store, scene_folder):
        other = found.get(part.key)
        found[part.key] = part if other is None else max(other, part, key=_worth)
    return found


def publish_part(store: Store, key: str, rows: pa.Table) -> Part:
    """Make a block's rows visible: in one step, and in place of what the block had before. A part
    without failures is never replaced by one with some. Returns the part that stands.
    """
    data = manifest_bytes(rows)
    failed = FAILED in rows["status"].to_pylist()
    part = Part(key, hashlib.sha256(data).hexdigest()[:12], failed)
    # Listed before it is written: of two who publish a block at once, none can delete the other's.
    before = [p for p in _all_parts(store, key.rsplit("/", 1)[0]) if p.key == key]
    whole = [p for p in before if not p.has_failures]
    if failed and whole:
        return max(whole, key=_worth)
    store.write(part.path, data)
    store.delete([other.path for other in before if other.name != part.name])
    return part


def read_finished(store: Store, without: Collection[str] = ()) -> pa.Table:
    """The rows of all finished images and of those that failed, sorted by `manifest.KEY`. without:
    not these columns, to save memory. Raises OutputError: nothing is finished yet, or a file is
    damaged.
    """
    table = _merged(store, without)[0]
    if table is None:
        raise OutputError(
            f"{store.uri} holds neither {MANIFEST} nor finished blocks: it is no output folder, or "
            f"nothing in it is finished yet. A job writes its manifest when it ends"
        )
    return table


def compact(store: Store) -> pa.Table | None:
    """Merge all parts into the manifest; returns its table, None where nothing is finished. Whoever
    calls holds the claim on the manifest, so that the last to write has seen all parts.
    """
    table, before, parts = _merged(store)
    if table is None:
        return None
    listed = json.dumps([part.name for part in parts], separators=(",", ":")).encode()
    data = manifest_bytes(table.replace_schema_metadata({_LISTED: listed} if parts else None))
    if data != before:
        store.write(MANIFEST, data)
    stands = {part.key: _worth(part) for part in parts}
    store.delete([p.path for p in _all_parts(store) if _worth(p) < stands.get(p.key, _worth(p))])
    return table


def parts_to_merge(store: Store) -> int:
    """How many parts the manifest does not have yet."""
    listed = _listed(_manifest(store)[0])
    return sum(part.name not in listed for part in list_parts(store).values())


def _merged(
    store: Store, without: Collection[str] = ()
) -> tuple[pa.Table | None, bytes | None, list[Part]]:
    """The rows of the manifest and of the parts, the manifest's bytes as they are, and the parts. A
    part may be replaced between being listed and being read: then all is looked at again.
    """
    for attempt in range(_MAX_RACES):
        parts = sorted(list_parts(store).values(), key=lambda part: part.name)
        table, data = _manifest(store, without)
        listed = _listed(table)
        try:
            read = [
                parse_manifest(store.read(part.path), f"{store.uri}/{part.path}", without)
                for part in parts
                if part.name not in listed
            ]
        except StoredFileMissing:
            if attempt == _MAX_RACES - 1:
                raise
            continue
        table = None if table is None else table.replace_schema_metadata(None)
        if read:
            table = latest_rows([concat_rows(read), *([] if table is None else [table])])
        return table, data, parts
    raise AssertionError


def _manifest(store: Store, without: Collection[str] = ()) -> tuple[pa.Table | None, bytes | None]:
    try:
        data = store.read(MANIFEST)
    except StoredFileMissing:
        return None, None
    return parse_manifest(data, f"{store.uri}/{MANIFEST}", without), data


def _listed(table: pa.Table | None) -> Collection[str]:
    note = None if table is None else (table.schema.metadata or {}).get(_LISTED)
    if note is None:
        return frozenset()
    try:
        names = json.loads(note)
    except (ValueError, RecursionError):  # damaged: the parts tell it all again
        names = []
    if not isinstance(names, list):
        return frozenset()
    return frozenset(name for name in names if isinstance(name, str))


def _all_parts(store: Store, scene_folder: str | None = None) -> list[Part]:
    """Also those that a killed process left beside the ones that took their place."""
    folder = PARTS if scene_folder is None else f"{PARTS}/{scene_folder}"
    files = store.list(folder).items()
    parts = [Part.parse(path, file.modified_s) for path, file in files]
    return [part for part in parts if part is not None]


def _worth(part: Part) -> tuple[bool, float, str]:
    """Of two parts of a block the greater one stands: without failures, else the later one."""
    return not part.has_failures, part.modified_s, part.name


# ---- A row of the manifest: one image, finished or failed ----------------------------------------


@dataclass(frozen=True)
class Identity:
    """What must agree for two runs to write into the same variant folder. source_digest: of the
    scene's content; None where nobody knows it, which agrees with any.
    """

    source: str
    recipe_hash: str
    trajectory: str
    version: str
    backend: str
    source_digest: str | None = None

    @staticmethod
    def of_row(row: dict[str, Any]) -> Identity:
        return Identity(**{name: row[name] for name in Identity.__dataclass_fields__})

    def is_of_other_content(self, other: Identity) -> bool:
        """Whether the scene's files are known to differ."""
        return None not in (digests := {self.source_digest, other.source_digest}) and (
            len(digests) > 1
        )

    def check(self, found: Identity, where: str) -> None:
        """Raise OutputError where the folder was written by something else."""
        names = {
            "source": "scene",
            "recipe_hash": "recipe hash",
            "trajectory": "camera path",
            "version": "package version",
            "backend": "backend",
        }
        mine, theirs = asdict(self), asdict(found)
        different = [
            f"{label} there {theirs[name]!r}, here {mine[name]!r}"
            for name, label in names.items()
            if mine[name] != theirs[name]
        ]
        if not different and self.is_of_other_content(found):
            different = [
                f"the files of the scene {self.source} have changed since: the digest of their "
                f"content is {theirs['source_digest']!r} there, {mine['source_digest']!r} here"
            ]
        if different:
            raise OutputError(
                f"{where} already holds images of another kind: {'; '.join(different)}. Give the "
                f"recipe another name, choose another output folder, or ask for the variant to be "
                f"overwritten (render --overwrite, overwrite=True)"
            )


class Pictured(NamedTuple):
    """Which image. width, height: of the written image, pixels."""

    frame: int
    camera: str
    timestamp_ns: int
    width: int
    height: int


def image_row(
    scene: str,
    recipe: Recipe,
    identity: Identity,
    pictured: Pictured,
    *,
    paths: Mapping[str, str | None],
    status: str,
    message: str = "",
    checksum: str = "",
    lidar: str | None = None,
    lidar_note: str | None = None,
    shares: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """The row by columns. paths: by column; a failed image has none, whatever they say. shares: as
    of Written.
    """
    return {
        "scene": scene,
        "variant": variant_name(recipe),
        **pictured._asdict(),
        **(paths if status == OK else dict.fromkeys(paths)),
        **shown_words(recipe),
        "lidar": lidar,
        "lidar_note": lidar_note,
        **dict.fromkeys(share_columns().values()),
        **(shares or {}),
        "seed": recipe.seed,
        "recipe": recipe.name,
        **vars(identity),
        "checksum": checksum,
        "status": status,
        "message": message,
    }


def shown_words(recipe: Recipe) -> dict[str, str | float | None]:
    """What a recipe says of its images, by columns. settings: JSON of the values of the knobs that
    a quality may set (recipes.schema) and that have an effect, by dotted path; None where the
    recipe has no quality.
    """
    words, settings = recipe.quality.words, None
    if words is not None:
        chosen = {path: v for path, v in settings_of(recipe).items() if KNOBS[path].chosen}
        settings = json.dumps(chosen, separators=(",", ":"))
    return {
        "base": recipe.render.base,
        "surface": recipe.output.surface,
        **recipe.columns(),
        "quality": words,
        "render_scale": recipe.render.scale,
        "settings": settings,
    }


def lidar_notes(recipes: Iterable[Recipe]) -> list[str]:
    """Where LiDAR sweeps show another world than images or depth: a line for each recipe of which
    they do, about its first such variant."""
    noted: dict[str, list[str]] = {}
    for recipe in recipes:
        note = recipe.lidar_note(recipe.lidar)
        if note is not None:
            how = "meets the weather" if recipe.lidar == "weather" else "passes through clean"
            line = f"{variant_name(recipe)}: LiDAR {how}: {note}"
            noted.setdefault(recipe.name, []).append(line)
    return [
        lines[0] + (f", and {len(lines) - 1} more likewise" if lines[1:] else "")
        for lines in noted.values()
    ]
