"""What boxes and LiDAR sweeps of an output say of its weather, from an even sample of its files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tools.report_files import ReportFiles
from tools.report_pick import evenly, first_of_each

MAX_BOX_FILES = 40
MAX_TABLES = 6  # of each recipe
MAX_SWEEPS = 3  # of each recipe
VISIBILITY_STEPS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95)  # lower bounds of the bins; the last is open
# What of a box an effect leaves, from its column, by the manifest's kind of path.
_LEFT: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "box_smog": ("transmittance", lambda value: value),
    "box_water": ("hidden_fraction", lambda value: 1 - value),
    "box_snow": ("snow_fraction", lambda value: 1 - value),
}
_BOX = ("frame", "camera", "box")
_TYPES = [pa.int64(), pa.string(), pa.int64(), pa.int64(), pa.float64()]  # and pixels and a share


@dataclass(frozen=True)
class Sample:
    """How much of what there is was looked at. files, of: numbers of files."""

    files: int
    of: int


@dataclass(frozen=True)
class Classes:
    """Boxes by class, the most frequent first: (class, boxes, tracks)."""

    rows: tuple[tuple[str, int, int], ...]
    sample: Sample


@dataclass(frozen=True)
class Shares:
    """Counts in categories for every recipe that has any: (recipe, [c] counts)."""

    rows: tuple[tuple[str, tuple[int, ...]], ...]
    sample: Sample


def count_classes(table: pa.Table, files: ReportFiles) -> Classes | None:
    """Of every scene's first variant that has labels: they are the same in the others."""
    labelled = table.filter(pc.is_valid(table["labels_path"]))
    if not labelled.num_rows:
        return None
    first = first_of_each(labelled, "scene")
    of_first = labelled.filter(
        pc.is_in(
            labelled["draw"], value_set=labelled["draw"].take(pa.array(first)).combine_chunks()
        )
    )
    rows = first_of_each(of_first, "labels_path")
    chosen = evenly(rows, MAX_BOX_FILES)
    boxes: Counter[str] = Counter()
    tracks: dict[str, set[tuple[str, str]]] = {}
    read = 0
    for row in of_first.select(["scene", "labels_path"]).take(pa.array(chosen)).to_pylist():
        found = files.read_columns(row["labels_path"], ("label", "track_id"))
        if found is None or found.num_columns < 2:
            continue
        read += 1
        for label, track in zip(
            found["label"].to_pylist(), found["track_id"].to_pylist(), strict=True
        ):
            boxes[str(label)] += 1
            tracks.setdefault(str(label), set()).add((row["scene"], str(track)))
    order = sorted(boxes, key=lambda label: (-boxes[label], label))
    counted = tuple((label, boxes[label], len(tracks[label])) for label in order)
    return Classes(counted, Sample(read, len(rows)))


def share_visible(table: pa.Table, recipes: list[str], files: ReportFiles) -> Shares | None:
    """How much the weather leaves of each box that an image shows, in VISIBILITY_STEPS.

    Transmittance of smog, times what water does not hide, times what snow does not cover, as
    `augment.jobs.view_files.visibility` has it.
    """
    columns = [f"{kind}_path" for kind in _LEFT if f"{kind}_path" in table.column_names]
    rows, read, there = [], 0, 0
    for recipe in recipes:
        own = table.filter(pc.equal(table["recipe"], recipe))
        found = own.group_by(columns, use_threads=False).aggregate([]).to_pylist()
        sets = sorted((tuple(row[c] for c in columns) for row in found), key=str)
        sets = [paths for paths in sets if any(paths)]
        there += len(sets)
        counts = np.zeros(len(VISIBILITY_STEPS), np.int64)
        for paths in evenly(sets, MAX_TABLES):
            visible = _visible(dict(zip(columns, paths, strict=True)), files)
            if visible is None:
                continue
            read += 1
            edges = [*VISIBILITY_STEPS, np.inf]
            counts += np.histogram(np.clip(visible, 0, 1), edges)[0]
        if counts.any():
            rows.append((recipe, tuple(int(n) for n in counts)))
    return Shares(tuple(rows), Sample(read, there)) if rows else None


def share_codes(
    table: pa.Table, recipes: list[str], files: ReportFiles
) -> tuple[tuple[int, ...], Shares] | None:
    """The weather codes of LiDAR points, and how many points of each recipe's sweeps have which.

    None where no sweep has the column `weather_code`.
    """
    counted: list[tuple[str, Counter[int]]] = []
    read, there = 0, 0
    for recipe in recipes:
        own = table.filter(pc.equal(table["recipe"], recipe))
        paths = sorted(path for path in pc.unique(own["lidar_path"]).to_pylist() if path)
        codes: Counter[int] = Counter()
        for path in evenly(paths, MAX_SWEEPS):
            sweep = files.read_columns(path, ("weather_code",))
            if sweep is None or not sweep.num_columns:
                break  # a recipe's sweeps all have the column, or none has it
            read += 1
            column = sweep["weather_code"]
            if pa.types.is_integer(column.type):
                entries = pc.value_counts(column.combine_chunks()).to_pylist()
                codes.update({e["values"]: e["counts"] for e in entries if e["values"] is not None})
        if codes:
            there += len(paths)
            counted.append((recipe, codes))
    if not counted:
        return None
    known = tuple(sorted({code for _, codes in counted for code in codes}))
    rows = tuple((recipe, tuple(codes[code] for code in known)) for recipe, codes in counted)
    return known, Shares(rows, Sample(read, there))


def _visible(paths: dict[str, str | None], files: ReportFiles) -> np.ndarray | None:
    """float64 [boxes that a pixel shows] of the images that a variant's tables hold."""
    parts = []
    for column, path in paths.items():
        if path is None:
            continue
        name, left = _LEFT[column.removesuffix("_path")]
        found = files.read_columns(path, (*_BOX, "pixels", name))
        if found is None:
            return None
        if found.num_columns < 5:  # `pixels` of smog are younger than its transmittance
            continue
        if found.schema.types != _TYPES:
            return files.note(path, "its columns are not of the types that a job writes")
        value = left(np.asarray(pc.fill_null(found[name], np.nan), np.float64))
        shown = pc.fill_null(pc.greater(found["pixels"], 0), False).cast(pa.int8())
        part = found.select(list(_BOX))
        part = part.append_column("left", pa.array(np.where(np.isfinite(value), value, 1.0)))
        parts.append(part.append_column("shown", shown))
    if not parts:
        return None
    together = pa.concat_tables(parts).group_by(list(_BOX), use_threads=False)
    boxes = together.aggregate([("left", "product"), ("shown", "max")])
    return boxes.filter(pc.equal(boxes["shown_max"], 1))["left_product"].to_numpy()
