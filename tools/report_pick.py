"""Which images of an output its report shows: evenly spread, and the same every time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tools.report_weather import Draws

Value = TypeVar("Value")
# Multiples of either, less their whole parts, fill an interval evenly however many there are.
_GOLDEN, _SILVER = (math.sqrt(5) - 1) / 2, math.sqrt(2) - 1


@dataclass(frozen=True)
class Place:
    """What several variants show of one scene, frame and camera. rows: of the manifest, those
    without weather first; clear: which of them are.
    """

    scene: str
    frame: int
    camera: str
    rows: tuple[dict[str, Any], ...]
    clear: tuple[bool, ...]


def evenly(values: Sequence[Value], most: int) -> list[Value]:
    """At most `most` of them in their order, from the middles of as many equal parts."""
    number = min(most, len(values))
    return [values[(2 * i + 1) * len(values) // (2 * number)] for i in range(number)]


def first_of_each(table: pa.Table, column: str) -> list[int]:
    """Row numbers where a value of the column stands first, in the table's order."""
    codes = table[column].combine_chunks().dictionary_encode().indices.to_numpy()
    _, first = np.unique(codes, return_index=True)
    return sorted(int(row) for row in first)


def pick_images(table: pa.Table, number: int, shift: int = 0) -> list[dict[str, Any]]:
    """At most `number` rows: one each of evenly chosen variants, wandering over frames and cameras.

    Evenly spaced rows would mostly show one camera: the numbers of frames and cameras divide them.
    shift: of the place, so that calls for one row each do not all take the same.
    """
    starts = first_of_each(table, "draw")
    bounds = [*starts, table.num_rows]
    rows: list[int] = []
    for i in range(min(number, table.num_rows)):
        within = (0.5 + (i + shift) * _GOLDEN) % 1
        group = int((i + within) * len(starts) / min(number, table.num_rows))
        low, size = bounds[group], bounds[group + 1] - bounds[group]
        inside = int(size * ((0.5 + (i + shift) * _SILVER) % 1))
        free = [low + (inside + k) % size for k in range(size)]
        rows += [next(row for row in free if row not in rows)] if set(free) - set(rows) else []
    return table.take(pa.array(sorted(rows), pa.int64())).to_pylist()


def pick_places(table: pa.Table, draws: Draws, places: int, variants: int) -> list[Place]:
    """Scenes evenly chosen, and in each the frame and camera that most variants show.

    Those without weather come first, then at most one of each recipe until there are none left.
    Only scenes in which two variants show the same are taken, those with weather and without first.
    """
    clear = set(draws.draw[draws.clear].tolist())
    names, candidates = sorted(pc.unique(table["scene"]).to_pylist()), []
    for name in evenly(names, 8 * places):  # reading rows of thousands of scenes takes seconds
        place = _place_of(table.filter(pc.equal(table["scene"], name)), name, clear, variants)
        if place is not None:
            candidates.append(place)
    paired = [place for place in candidates if any(place.clear) and not all(place.clear)]
    return evenly(paired or candidates, places)


def _place_of(rows: pa.Table, scene: str, clear: set[int], variants: int) -> Place | None:
    counted = rows.group_by(["frame", "camera"], use_threads=False)
    seen = counted.aggregate([("draw", "count_distinct")]).to_pylist()
    most = max(entry["draw_count_distinct"] for entry in seen)
    if most < 2:
        return None
    full = [e for e in seen if e["draw_count_distinct"] == most]
    camera = min({e["camera"] for e in full}, key=_camera_order)
    frames = sorted(e["frame"] for e in full if e["camera"] == camera)
    frame = frames[len(frames) // 2]
    here = pc.and_(pc.equal(rows["frame"], frame), pc.equal(rows["camera"], camera))
    shown = rows.filter(here).to_pylist()
    bare = [row for row in shown if row["draw"] in clear]
    weathered = [row for row in shown if row["draw"] not in clear]
    chosen = bare[:1] + evenly(_one_of_each_recipe(weathered or bare[1:]), variants - len(bare[:1]))
    return Place(scene, frame, camera, tuple(chosen), tuple(r["draw"] in clear for r in chosen))


def _one_of_each_recipe(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each recipe its first variant; all of them where there is one recipe only."""
    first: dict[str, dict[str, Any]] = {}
    for row in rows:
        first.setdefault(row["recipe"], row)
    return rows if len(first) < 2 else list(first.values())


def _camera_order(name: str) -> tuple[bool, int, str]:
    """The camera that looks ahead first, as far as names tell."""
    return ("front" not in name.lower(), len(name), name)
