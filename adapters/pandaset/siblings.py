"""Which cuboids of a sequence are one object: the two LiDARs' boxes of what moves are one vehicle.

PandaSet labels a moving object once a sensor, up to 0.1 s apart, with a uuid for each of both
(`cuboids.sensor_id`: 0 the spinning sensor, 1 the forward one, -1 a box of both) and each other's
uuid in `cuboids.sibling_id`. Published links are not all whole: some go one way only, are cut
short, or name their own box.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from adapters.pandaset.files import read_cuboids
from augment.errors import AdapterError
from augment.semantics import class_of_label

# The area that two boxes share, of that which either covers. In sequence 002 boxes tied by links
# share 0.31 to 0.98 of it on average over their frames, others of one class 0.01 at most.
MIN_OVERLAP = 0.25
_Rectangle = tuple[list[float], list[float], float]  # centre, sides, degrees
_EACH_ALONE = -1  # the sensor of a box that was drawn around both sensors' returns


@dataclass(frozen=True, eq=False)
class Objects:
    """The objects of a sequence. names: by uuid, the object's name: that of its best box. ranks: by
    uuid, which of an object's boxes to keep of those that a frame has: the lowest.

    The best is the one with boxes in most frames, so that a track keeps to one sensor; then the
    spinning sensor's, which sees all around; then the first in the files.
    """

    names: Mapping[str, str]
    ranks: Mapping[str, int]

    def kept(self, uuids: Iterable[str]) -> np.ndarray:
        """bool: the boxes of one frame to keep, one an object, by their uuids."""
        uuids = list(uuids)
        best: dict[str, str] = {}
        for uuid in sorted(uuids, key=self.ranks.__getitem__):
            best.setdefault(self.names[uuid], uuid)
        return np.array([best[self.names[uuid]] == uuid for uuid in uuids], bool)


def sensors_of(table: pd.DataFrame) -> list[int]:
    """Each box's sensor: 0, 1, or -1 where it has none or the table does not say."""
    column = table.get("cuboids.sensor_id", pd.Series([_EACH_ALONE] * len(table)))
    return [int(value) if value in (0, 1) else _EACH_ALONE for value in column]


def read_objects(root: Path) -> Objects:
    """The objects of all frames of a sequence; remembered as long as its files stay as they are.

    A table that cannot be read says nothing here: it is an error of its own frame.
    """
    paths = sorted((root / "annotations" / "cuboids").glob("*.pkl.gz"))
    frames = [(int(path.name[:-7]), path.stat()) for path in paths if path.name[:-7].isdecimal()]
    return _read_objects(root, tuple((n, s.st_mtime_ns, s.st_size) for n, s in frames))


@lru_cache(maxsize=4)
def _read_objects(root: Path, state: tuple[tuple[int, int, int], ...]) -> Objects:
    tables = {}
    for frame, _, _ in state:
        try:
            table = read_cuboids(root, frame)
        except AdapterError:
            continue
        if table is not None:
            tables[frame] = table
    return find_objects(tables)


def find_objects(tables: Mapping[int, pd.DataFrame]) -> Objects:
    """The objects in the cuboids of some frames, by frame.

    By links in both directions, then by those in one, then, of boxes without a partner, by overlap:
    of one class, of both sensors where the tables name these, and MIN_OVERLAP at least on average
    over the frames that have both. A tie is refused where it would make two boxes of one sensor in
    one frame the same object.
    """
    boxes = _Boxes.of(tables)
    group = {uuid: [uuid] for uuid in boxes.frames}
    for a, b in [*_links(tables, boxes), *_overlapping(tables, boxes)]:
        if group[a] is not group[b] and boxes.are_one(group[a], group[b], (a, b)):
            group[a] += group[b]
            group |= dict.fromkeys(group[b], group[a])
    order = {uuid: number for number, uuid in enumerate(boxes.frames)}
    merit = {u: (-len(boxes.frames[u]), boxes.sensors[u] == 1, order[u]) for u in order}
    ranks = {uuid: rank for rank, uuid in enumerate(sorted(order, key=merit.__getitem__))}
    return Objects({u: min(group[u], key=ranks.__getitem__) for u in order}, ranks)


@dataclass(frozen=True, eq=False)
class _Boxes:
    """What the tables say of each uuid, in order of first appearance."""

    frames: dict[str, set[int]]
    sensors: dict[str, int]
    kinds: dict[str, str]  # the class, or where it is not known the label

    @staticmethod
    def of(tables: Mapping[int, pd.DataFrame]) -> _Boxes:
        found = _Boxes(defaultdict(set), {}, {})
        for frame, table in tables.items():
            rows = zip(table["uuid"], sensors_of(table), table["label"], strict=True)
            for uuid, sensor, label in rows:
                found.frames[str(uuid)].add(frame)
                found.sensors.setdefault(str(uuid), sensor)
                kind = class_of_label(str(label))
                found.kinds.setdefault(str(uuid), kind.name if kind else str(label))
        return found

    def are_one(self, a: list[str], b: list[str], tie: tuple[str, str]) -> bool:
        """Whether all these uuids can be one object, two of them being tied: it has a box of each
        sensor in a frame at most."""
        return all(
            self.frames[one].isdisjoint(self.frames[other])
            or ((one, other) == tie and not self.same_sensor(one, other))
            for one in a
            for other in b
        )

    def same_sensor(self, a: str, b: str) -> bool:
        return self.sensors[a] == self.sensors[b] != _EACH_ALONE


def _links(tables: Mapping[int, pd.DataFrame], boxes: _Boxes) -> list[tuple[str, str]]:
    """Pairs of uuids that name each other, then those of which one names the other."""
    named: dict[tuple[str, str], None] = {}
    for table in tables.values():
        if "cuboids.sibling_id" in table:
            pairs = zip(table["uuid"].astype(str), table["cuboids.sibling_id"], strict=True)
            named |= dict.fromkeys((a, b) for a, b in pairs if a != b and b in boxes.frames)
    return sorted(named, key=lambda pair: pair[::-1] not in named)


def _overlapping(tables: Mapping[int, pd.DataFrame], boxes: _Boxes) -> list[tuple[str, str]]:
    """Pairs of uuids that lie in each other, the most overlapping first."""
    total: Counter[tuple[str, str]] = Counter()
    for table in tables.values():
        total.update(dict(_overlaps(table, boxes)))
    mean = {(a, b): s / len(boxes.frames[a] & boxes.frames[b]) for (a, b), s in total.items()}
    tied = [pair for pair, overlap in mean.items() if overlap >= MIN_OVERLAP]
    return sorted(tied, key=lambda pair: (-mean[pair], pair))


def _overlaps(table: pd.DataFrame, boxes: _Boxes) -> Iterator[tuple[tuple[str, str], float]]:
    """Pairs of a frame that may be siblings, with their areas' intersection over union."""
    uuids = [str(uuid) for uuid in table["uuid"]]
    columns = [f"{name}.{axis}" for name in ("position", "dimensions") for axis in "xyz"]
    values = table[[*columns, "yaw"]].to_numpy(dtype=np.float64)
    places, sizes, yaws = values[:, :3], values[:, 3:6], np.degrees(values[:, 6])
    usable = np.isfinite(values).all(axis=1) & (sizes > 0).all(axis=1)
    if "cuboids.sensor_id" in table:
        usable &= np.array(sensors_of(table)) != _EACH_ALONE
    chosen = np.flatnonzero(usable)
    for place, i in enumerate(chosen):
        others = chosen[place + 1 :]
        offsets, reach = places[others] - places[i], (sizes[others] + sizes[i]) / 2
        near = np.hypot(*offsets[:, :2].T) < np.hypot(*reach[:, :2].T)
        near &= np.abs(offsets[:, 2]) < reach[:, 2]
        for j in others[near]:
            a, b = sorted((uuids[i], uuids[j]))
            if boxes.kinds[a] == boxes.kinds[b] and not boxes.same_sensor(a, b):
                own = ([0.0, 0.0], sizes[i, :2].tolist(), yaws[i])
                other = ((places[j] - places[i])[:2].tolist(), sizes[j, :2].tolist(), yaws[j])
                yield (a, b), _intersection_over_union(own, other)


def _intersection_over_union(a: _Rectangle, b: _Rectangle) -> float:
    _, corners = cv2.rotatedRectangleIntersection(a, b)
    shared = 0.0 if corners is None else cv2.contourArea(cv2.convexHull(corners))
    return shared / (np.prod(a[1]) + np.prod(b[1]) - shared)
