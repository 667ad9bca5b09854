"""What an output holds, in numbers: by scene, by recipe, by kind of file, and what failed."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from augment.jobs.layout import STATE_FOLDER
from augment.jobs.manifest import OK

MAX_EXAMPLES = 3
_DIGITS = re.compile(r"\d+")
# Of a variant's folder; what else lies there, such as its recipe, is small.
_KINDS = (
    "images", "depth", "semantic", "instance", "water", "snow", "lidar", "labels", "calibration",
)  # fmt: skip
OTHER, STATE = "other", "state of jobs"


@dataclass(frozen=True)
class Group:
    """The images of a scene, of a recipe, or of all. source: of a scene, else empty."""

    name: str
    source: str
    finished: int
    failed: int
    scenes: int
    variants: int
    frames: int
    cameras: int

    @property
    def images(self) -> int:
        return self.finished + self.failed


@dataclass(frozen=True)
class Failure:
    """Failed images whose messages differ in numbers alone. message: of the first of them."""

    message: str
    images: int
    examples: tuple[str, ...]


@dataclass(frozen=True)
class Files:
    """files, bytes: of one kind."""

    kind: str
    files: int
    bytes: int


def add_variant_key(table: pa.Table) -> pa.Table:
    """With a column `draw`: one whole number for each scene and variant, in the table's order."""
    pairs = pa.StructArray.from_arrays(
        [pc.fill_null(table[name].combine_chunks(), "") for name in ("scene", "variant")],
        ["scene", "variant"],
    )
    texts = pc.binary_join_element_wise(pairs.field(0), pairs.field(1), "\0")
    return table.append_column("draw", texts.dictionary_encode().indices.cast(pa.int64()))


def overall(table: pa.Table) -> Group:
    """Of the whole output. table: as `add_variant_key` returns it."""
    everything = table.append_column("all", pa.array([""] * table.num_rows, pa.string()))
    groups = group_by(everything, "all")
    return groups[0] if groups else Group("", "", 0, 0, 0, 0, 0, 0)


def group_by(table: pa.Table, column: str) -> list[Group]:
    """Sorted by name. Frames are counted once per scene, whatever their variants and cameras."""
    finished = pc.equal(table["status"], OK).cast(pa.int64())
    table = table.append_column("finished", finished).append_column("place", _places(table))
    functions = [("finished", "sum"), ("finished", "count"), ("source", "min")] + [
        (name, "count_distinct") for name in ("scene", "draw", "place", "camera")
    ]
    rows = table.group_by(column).aggregate(functions).to_pylist()
    groups = [
        Group(
            name=row[column] or "",
            source=row["source_min"] or "",
            finished=row["finished_sum"] or 0,
            failed=row["finished_count"] - (row["finished_sum"] or 0),
            scenes=row["scene_count_distinct"],
            variants=row["draw_count_distinct"],
            frames=row["place_count_distinct"],
            cameras=row["camera_count_distinct"],
        )
        for row in rows
    ]
    return sorted(groups, key=lambda group: group.name)


def group_failures(table: pa.Table) -> list[Failure]:
    """Most frequent first. Numbers in messages are often frames and paths: they are looked past."""
    failed = table.filter(pc.not_equal(table["status"], OK))
    names = ("message", "scene", "variant", "frame", "camera")
    found: dict[str, tuple[str, list[str], int]] = {}
    for message, *place in zip(*(failed[name].to_pylist() for name in names), strict=True):
        key = _DIGITS.sub("#", message or "")
        first, examples, number = found.get(key, (message or "no message", [], 0))
        if number < MAX_EXAMPLES:
            examples.append(place_text(*place))
        found[key] = (first, examples, number + 1)
    failures = [Failure(first, n, tuple(examples)) for first, examples, n in found.values()]
    return sorted(failures, key=lambda failure: (-failure.images, failure.message))


def place_text(scene: Any, variant: Any, frame: Any, camera: Any) -> str:
    """Which image, for people."""
    return f"{scene} · {variant} · frame {frame} · {camera}"


def files_by_kind(listing: Mapping[str, Any], own: Sequence[str] = ()) -> list[Files]:
    """What lies in the output, the largest kind first. own: the page itself, which is left out.

    listing: of the whole store, each entry with a `size` in bytes.
    """
    counts: dict[str, list[int]] = {}
    for path, stored in listing.items():
        if path not in own:
            totals = counts.setdefault(_kind_of(path), [0, 0])
            totals[0] += 1
            totals[1] += stored.size
    found = [Files(kind, *totals) for kind, totals in counts.items()]
    return sorted(found, key=lambda files: (-files.bytes, files.kind))


def distinct(table: pa.Table, column: str, most: int = 6) -> list[Any]:
    """The values of a column, the most frequent first; None are left out."""
    counted = pc.value_counts(table[column].combine_chunks()).to_pylist()
    known = [entry for entry in counted if entry["values"] is not None]
    known.sort(key=lambda entry: (-entry["counts"], str(entry["values"])))
    return [entry["values"] for entry in known[:most]]


def image_sizes(table: pa.Table) -> list[str]:
    """1600×1066, the most frequent first."""
    sizes = pa.table({"size": _joined_columns(table, ("width", "height"), "×")})
    return distinct(sizes, "size")


def _kind_of(path: str) -> str:
    parts = PurePosixPath(path).parts
    if parts[:1] == (STATE_FOLDER,):
        return STATE
    folder = parts[2] if len(parts) > 3 else parts[-1].partition(".")[0]
    if folder == "manifest":
        return "manifest"
    return folder if folder in _KINDS and len(parts) > 2 else OTHER


def _places(table: pa.Table) -> pa.ChunkedArray:
    joined = _joined_columns(table, ("scene", "frame"), "\0")
    codes = pc.dictionary_encode(joined)
    return codes.combine_chunks().indices.cast(pa.int64())


def _joined_columns(table: pa.Table, names: Sequence[str], between: str) -> pa.ChunkedArray:
    columns = [pc.fill_null(table[name].cast(pa.string()), "?") for name in names]
    return pc.binary_join_element_wise(*columns, between)


def as_floats(table: pa.Table, column: str) -> np.ndarray:
    """float64 [rows]; null is NaN."""
    return np.asarray(pc.fill_null(table[column], np.nan).to_numpy(), np.float64)
