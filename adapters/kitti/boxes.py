"""label_2/NNNNNN.txt of the object benchmark: a line an object,

    type truncated occluded alpha left top right bottom h w l x y z rotation_y [score]

x y z is the middle of the box's bottom in the rectified camera 0 (x right, y down, z forward),
rotation_y the heading about its y, 0 along x. Lines of type DontCare mark image regions: no boxes.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from adapters.kitti.layout import file_in
from adapters.plain_files import read_text
from augment.errors import AdapterError
from augment.geometry import quat_from_rotmat
from augment.labels import Boxes

# ---- tracklet_labels.xml: the boxes of a raw drive, in the Velodyne's frame of each frame --------

TRACKLETS = "tracklet_labels.xml"
ATTRIBUTES = (
    "state", "occlusion", "occlusion_kf", "truncation", "amt_occlusion", "amt_occlusion_kf",
    "amt_border_l", "amt_border_r", "amt_border_kf",
)  # fmt: skip
_POSE = ("tx", "ty", "tz", "rx", "ry", "rz")
_MAX_BYTES, _MAX_ELEMENTS, _DEEPEST = 64 * 2**20, 4_000_000, 8
_OWN_DOCTYPE = re.compile(r"<!DOCTYPE\s+boost_serialization\s*>")  # declares nothing
_LAST_FRAME = 10**9


@dataclass(frozen=True, eq=False)
class Tracklet:
    """One object over T frames from first_frame on.

    size_m: length, width, height. poses: float64 [T, 6], the middle of the box's bottom and its
    turns about x, y, z, as in the file. attributes: float64 [T, 9], NaN where there is none.
    """

    label: str
    size_m: np.ndarray
    first_frame: int
    poses: np.ndarray
    attributes: np.ndarray


def read_tracklets(root: Path) -> tuple[Tracklet, ...] | None:
    """The drive's tracklets in the file's order, or None without the file.

    Raises:
        AdapterError: damaged, too large, with declarations of its own, or a tracklet that is none.
    """
    path = file_in(root, TRACKLETS)
    if not path.exists():
        return None
    items = _parsed(path).findall("./tracklets/item")
    return tuple(_tracklet(item, f"{path}: tracklet {i}") for i, item in enumerate(items))


def boxes_at(tracklets: tuple[Tracklet, ...], frame: int, world_from_velodyne: np.ndarray) -> Boxes:
    """The boxes of a frame in the world of the pose. A track_id is the tracklet's number in the
    file, from 0; attributes are ATTRIBUTES, float64."""
    here = [
        (number, t, frame - t.first_frame)
        for number, t in enumerate(tracklets)
        if 0 <= frame - t.first_frame < len(t.poses)
    ]
    if not here:
        return _named(Boxes.empty(), np.zeros((0, len(ATTRIBUTES))))
    world = np.stack([world_from_velodyne @ _pose(t, row) for _, t, row in here])
    boxes = Boxes(
        track_ids=tuple(str(number) for number, _, _ in here),
        labels=tuple(t.label for _, t, _ in here),
        centers_m=np.ascontiguousarray(world[:, :3, 3]),
        sizes_m=np.stack([t.size_m for _, t, _ in here]),
        quats=quat_from_rotmat(torch.from_numpy(world[:, :3, :3].copy())).numpy(),
    )
    return _named(boxes, np.stack([t.attributes[row] for _, t, row in here]))


def _named(boxes: Boxes, values: np.ndarray) -> Boxes:
    attributes: Mapping[str, np.ndarray] = {n: values[:, i] for i, n in enumerate(ATTRIBUTES)}
    return Boxes(
        boxes.track_ids, boxes.labels, boxes.centers_m, boxes.sizes_m, boxes.quats, attributes
    )


def _pose(tracklet: Tracklet, row: int) -> np.ndarray:
    """velodyne_from_box of the box's middle, float64 [4, 4]."""
    values = tracklet.poses[row]
    (cx, cy, cz), (sx, sy, sz) = np.cos(values[3:]), np.sin(values[3:])
    pose = np.eye(4)
    pose[:3, :3] = (
        np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    )
    pose[:3, 3] = values[:3] + pose[:3, 2] * tracklet.size_m[2] / 2
    return pose


class _BoundedBuilder(ET.TreeBuilder):
    """Stops at more elements, or deeper ones, than a drive has."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path, self._depth, self._count = path, 0, 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ET.Element:
        self._depth, self._count = self._depth + 1, self._count + 1
        if self._depth > _DEEPEST or self._count > _MAX_ELEMENTS:
            raise AdapterError(
                f"{self._path} is nested deeper than {_DEEPEST} elements, or has more than "
                f"{_MAX_ELEMENTS} of them; no drive has that"
            )
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ET.Element:
        self._depth -= 1
        return super().end(tag)


def _parsed(path: Path) -> ET.Element:
    """The file's root element; nothing in it is expanded or fetched, and it is of bounded size."""
    if path.stat().st_size > _MAX_BYTES:
        raise AdapterError(f"{path} is larger than {_MAX_BYTES // 2**20} MiB; no drive has that")
    text = _OWN_DOCTYPE.sub("", read_text(path), count=1)
    # A parser takes text with NUL characters for UTF-16, in which declarations look otherwise.
    if "\0" in text or "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise AdapterError(
            f"{path} is not UTF-8, or declares a document type or entities, as no file of KITTI "
            f"does; copy it from the dataset"
        )
    parser = ET.XMLParser(target=_BoundedBuilder(path))
    try:
        parser.feed(text)
        root = parser.close()
    except ET.ParseError as error:
        raise AdapterError(f"{path} is not whole XML ({error}); copy it again") from None
    if root.find("tracklets") is None:
        raise AdapterError(f"{path} has no <tracklets>; copy it from the dataset")
    return root


def _tracklet(item: ET.Element, where: str) -> Tracklet:
    size = np.array([_number(item, name, where) for name in ("l", "w", "h")])
    if not (size > 0).all():
        raise AdapterError(f"{where}: l, w, h must be metres > 0; got {size.tolist()}")
    first = _number(item, "first_frame", where)
    if first % 1 or not 0 <= first <= _LAST_FRAME:
        raise AdapterError(f"{where}: first_frame must be a frame's number; got {first:g}")
    rows = item.findall("./poses/item")
    poses = [[_number(row, name, where) for name in _POSE] for row in rows]
    attributes = [[_attribute(row, name, where) for name in ATTRIBUTES] for row in rows]
    return Tracklet(
        label=(item.findtext("objectType") or "").strip() or "unknown",
        size_m=size,
        first_frame=int(first),
        poses=np.array(poses, np.float64).reshape(-1, len(_POSE)),
        attributes=np.array(attributes, np.float64).reshape(-1, len(ATTRIBUTES)),
    )


def _attribute(row: ET.Element, name: str, where: str) -> float:
    return np.nan if row.find(name) is None else _number(row, name, where)


def _number(element: ET.Element, name: str, where: str) -> float:
    text = element.findtext(name)
    try:
        value = float(text) if text is not None else np.nan
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise AdapterError(f"{where}: <{name}> must hold a finite number; got {text!r}")
    return value


# ---- object labels -------------------------------------------------------------------------------

DONT_CARE = "DontCare"
_ATTRIBUTES = (
    "truncated", "occluded", "alpha", "bbox_left", "bbox_top", "bbox_right", "bbox_bottom",
)  # fmt: skip
_COLUMNS = 15


@dataclass(frozen=True, eq=False)
class ObjectLines:
    """The objects of a file. rows: their lines' numbers, from 0. labels: their types. values:
    float64 [B, 14], the columns after the type. scores: float64 [B], NaN without one. dont_care:
    how many lines are regions."""

    rows: tuple[int, ...]
    labels: tuple[str, ...]
    values: np.ndarray
    scores: np.ndarray
    dont_care: int


def read_object_lines(path: Path) -> ObjectLines:
    """The objects of a label file.

    Raises:
        AdapterError: missing, or a line that has other columns or sizes that are none.
    """
    rows, labels, values, scores, dont_care = [], [], [], [], 0
    for row, line in enumerate(read_text(path).splitlines()):
        words = line.split()
        if not words:
            continue
        if words[0] == DONT_CARE:
            dont_care += 1
            continue
        numbers = _numbers(words, f"{path}, line {row + 1}")
        rows.append(row)
        labels.append(words[0])
        values.append(numbers[: _COLUMNS - 1])
        scores.append(numbers[_COLUMNS - 1] if len(numbers) == _COLUMNS else np.nan)
    return ObjectLines(
        tuple(rows),
        tuple(labels),
        np.array(values, np.float64).reshape(-1, _COLUMNS - 1),
        np.array(scores, np.float64),
        dont_care,
    )


def boxes_of_lines(lines: ObjectLines, velodyne_from_rectified: np.ndarray) -> Boxes:
    """The objects as boxes in the Velodyne's frame. A track_id is the line's number from 0.
    Attributes: truncated, occluded, alpha, bbox_left, bbox_top, bbox_right, bbox_bottom as in the
    file, and score where a line has one, float64.
    """
    height, width, length = lines.values[:, 7:10].T
    heading = lines.values[:, 13]
    zero, one = np.zeros_like(heading), np.ones_like(heading)
    forward = np.stack([np.cos(heading), zero, -np.sin(heading)], axis=1)
    up = np.stack([zero, -one, zero], axis=1)
    rectified_from_box = np.stack([forward, np.cross(up, forward), up], axis=2)
    centres = lines.values[:, 10:13] + up * height[:, None] / 2
    turn = velodyne_from_rectified[:3, :3]
    attributes = {name: lines.values[:, i].copy() for i, name in enumerate(_ATTRIBUTES)}
    if np.isfinite(lines.scores).any():
        attributes["score"] = lines.scores
    return Boxes(
        track_ids=tuple(map(str, lines.rows)),
        labels=lines.labels,
        centers_m=centres @ turn.T + velodyne_from_rectified[:3, 3],
        sizes_m=np.stack([length, width, height], axis=1),
        quats=quat_from_rotmat(torch.from_numpy(turn @ rectified_from_box)).numpy(),
        attributes=attributes,
    )


def _numbers(words: list[str], where: str) -> list[float]:
    if len(words) not in (_COLUMNS, _COLUMNS + 1):
        raise AdapterError(
            f"{where}: expected a type and 14 numbers, and maybe a score; got {len(words)} words"
        )
    try:
        numbers = [float(word) for word in words[1:]]
    except ValueError as error:
        raise AdapterError(f"{where}: expected numbers after the type ({error})") from None
    if not np.isfinite(numbers).all():
        raise AdapterError(f"{where}: numbers must be finite; got {' '.join(words)}")
    if min(numbers[7:10]) <= 0:
        raise AdapterError(f"{where}: h, w, l must be metres > 0; got {numbers[7:10]}")
    return numbers
