"""KITTI's boxes and sweeps in the dataset's world, read when asked.

Boxes of a raw drive: tracklet_labels.xml, in the Velodyne's frame of each frame. Of the object
benchmark: label_2/NNNNNN.txt, a line an object,

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

from adapters.kitti.files import OBJECT_DIGITS, file_in, read_returns, rotation_about
from adapters.plain_files import parse_numbers, read_text
from adapters.raw_drive import stored_records
from augment.errors import AdapterError
from augment.geometry import quat_from_rotmat
from augment.labels import Boxes, LidarSweep

TRACKLETS = "tracklet_labels.xml"
ATTRIBUTES = (
    "state", "occlusion", "occlusion_kf", "truncation", "amt_occlusion", "amt_occlusion_kf",
    "amt_border_l", "amt_border_r", "amt_border_kf",
)  # fmt: skip
_POSE = ("tx", "ty", "tz", "rx", "ry", "rz")
_MAX_BYTES, _MAX_ELEMENTS, _MAX_DEPTH = 64 * 2**20, 4_000_000, 8
_OWN_DOCTYPE = re.compile(r"<!DOCTYPE\s+boost_serialization\s*>")  # declares nothing
_LAST_FRAME = 10**9
_OBJECT_ATTRIBUTES = (
    "truncated", "occluded", "alpha", "bbox_left", "bbox_top", "bbox_right", "bbox_bottom",
)  # fmt: skip
_COLUMNS = 15
_RECORD = ("x", "y", "z", "intensity")  # of a sweep's file


@dataclass(frozen=True, eq=False)
class KittiLabels:
    """Labels of a raw drive, or of one frame of the object benchmark.

    sweeps: files relative to the root, by frame. world_from_velodyne: float64 [4, 4] in the
    dataset's world, by frame; frames without one have no labels. tracklets: of a raw drive.
    velodyne_from_rectified: of an object folder, where boxes are in label_2/. Sweeps have the
    columns x y z (float64 metres), intensity (the file's reflectance, 0 to 1) and timestamp_ns (the
    frame's: the file has none), in the file's order."""

    root: Path
    sweeps: Mapping[int, str]
    timestamps_ns: Mapping[int, int]
    world_from_velodyne: Mapping[int, np.ndarray]
    tracklets: tuple[Tracklet, ...] = ()
    velodyne_from_rectified: np.ndarray | None = None

    def boxes(self, frame_index: int) -> Boxes:
        pose = self.world_from_velodyne.get(frame_index)
        if pose is None:
            return Boxes.empty()
        if self.velodyne_from_rectified is None:
            return boxes_at(self.tracklets, frame_index, pose)
        path = object_label_file(self.root, frame_index)
        if not path.exists():
            return Boxes.empty()
        return boxes_of_lines(read_object_lines(path), self.velodyne_from_rectified)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """None without a file or a pose, or where the file is damaged, which the scene's problems
        say."""
        pose = self.world_from_velodyne.get(frame_index)
        if pose is None or frame_index not in self.sweeps:
            return None
        try:
            returns = read_returns(self.root, self.sweeps[frame_index])
        except AdapterError:
            return None
        with np.errstate(invalid="ignore", over="ignore"):  # of returns that are not finite
            world = returns[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        columns = {axis: np.ascontiguousarray(world[:, i]) for i, axis in enumerate("xyz")}
        columns["intensity"] = returns[:, 3].copy()
        columns["timestamp_ns"] = np.full(len(world), self.timestamps_ns[frame_index], np.int64)
        return LidarSweep(columns)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """The Velodyne's place in its pose of the frame; what the car drives within the turn of
        0.1 s is left out, as it is left in the returns."""
        pose = self.world_from_velodyne.get(frame_index)
        return None if pose is None else np.broadcast_to(pose[:3, 3], (len(sweep), 3))

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """The frame's file, where it is there and has a pose."""
        if frame_index not in self.sweeps or frame_index not in self.world_from_velodyne:
            return ()
        file = file_in(self.root, self.sweeps[frame_index])
        return (file,) if file.exists() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """That file with a weathered sweep in place of its own."""
        records = read_returns(self.root, self.sweeps[frame_index])
        return stored_records(records, _RECORD, sweep, self.world_from_velodyne[frame_index])


def object_label_file(root: Path, frame: int) -> Path:
    """The label file of a frame, there or not."""
    return file_in(root, f"label_2/{frame:0{OBJECT_DIGITS}d}.txt")


@dataclass(frozen=True, eq=False)
class Tracklet:
    """One object over T frames from first_frame on.

    size_m: length, width, height. poses: float64 [T, 6], the middle of the box's bottom and its
    turns about x, y, z, as in the file. attributes: float64 [T, 9], NaN where there is none."""

    label: str
    size_m: np.ndarray
    first_frame: int
    poses: np.ndarray
    attributes: np.ndarray


def read_tracklets(root: Path) -> tuple[Tracklet, ...] | None:
    """The drive's tracklets in the file's order, or None without the file."""
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
    rows = [t.attributes[row] for _, t, row in here]
    values = np.array(rows, np.float64).reshape(-1, len(ATTRIBUTES))
    world = np.array([world_from_velodyne @ _pose(t, row) for _, t, row in here]).reshape(-1, 4, 4)
    return Boxes(
        track_ids=tuple(str(number) for number, _, _ in here),
        labels=tuple(t.label for _, t, _ in here),
        centers_m=np.ascontiguousarray(world[:, :3, 3]),
        sizes_m=np.array([t.size_m for _, t, _ in here], np.float64).reshape(-1, 3),
        quats=quat_from_rotmat(torch.from_numpy(world[:, :3, :3].copy())).numpy(),
        attributes={name: values[:, i] for i, name in enumerate(ATTRIBUTES)},
    )


def _pose(tracklet: Tracklet, row: int) -> np.ndarray:
    """velodyne_from_box of the box's middle, float64 [4, 4]."""
    values = tracklet.poses[row]
    rx, ry, rz = values[3:]
    pose = np.eye(4)
    pose[:3, :3] = rotation_about(2, rz) @ rotation_about(1, ry) @ rotation_about(0, rx)
    pose[:3, 3] = values[:3] + pose[:3, 2] * tracklet.size_m[2] / 2
    return pose


class _BoundedBuilder(ET.TreeBuilder):
    """Stops at more elements, or deeper ones, than a drive has."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path, self._depth, self._count = path, 0, 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ET.Element:
        self._depth, self._count = self._depth + 1, self._count + 1
        if self._depth > _MAX_DEPTH or self._count > _MAX_ELEMENTS:
            raise AdapterError(
                f"{self._path} is nested deeper than {_MAX_DEPTH} elements, or has more than "
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
    attributes = [
        [np.nan if row.find(name) is None else _number(row, name, where) for name in ATTRIBUTES]
        for row in rows
    ]
    return Tracklet(
        label=(item.findtext("objectType") or "").strip() or "unknown",
        size_m=size,
        first_frame=int(first),
        poses=np.array(poses, np.float64).reshape(-1, len(_POSE)),
        attributes=np.array(attributes, np.float64).reshape(-1, len(ATTRIBUTES)),
    )


def _number(element: ET.Element, name: str, where: str) -> float:
    text = element.findtext(name)
    try:
        value = float(text) if text is not None else np.nan
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise AdapterError(f"{where}: <{name}> must hold a finite number; got {text!r}")
    return value


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
    """The objects of a label file."""
    rows, labels, values, dont_care = [], [], [], 0
    for row, line in enumerate(read_text(path).splitlines()):
        words = line.split()
        if not words:
            continue
        if words[0] == "DontCare":
            dont_care += 1
            continue
        rows.append(row)
        labels.append(words[0])
        values.append(_object_numbers(words, f"{path}, line {row + 1}"))
    table = np.array(values, np.float64).reshape(-1, _COLUMNS)
    return ObjectLines(tuple(rows), tuple(labels), table[:, :-1], table[:, -1], dont_care)


def boxes_of_lines(lines: ObjectLines, velodyne_from_rectified: np.ndarray) -> Boxes:
    """The objects as boxes in the Velodyne's frame. A track_id is the line's number from 0.
    Attributes: truncated, occluded, alpha, bbox_left, bbox_top, bbox_right, bbox_bottom as in the
    file, and score where a line has one, float64."""
    height, width, length = lines.values[:, 7:10].T
    heading = lines.values[:, 13]
    zero, one = np.zeros_like(heading), np.ones_like(heading)
    forward = np.stack([np.cos(heading), zero, -np.sin(heading)], axis=1)
    up = np.stack([zero, -one, zero], axis=1)
    rectified_from_box = np.stack([forward, np.cross(up, forward), up], axis=2)
    centres = lines.values[:, 10:13] + up * height[:, None] / 2
    turn = velodyne_from_rectified[:3, :3]
    attributes = {name: lines.values[:, i].copy() for i, name in enumerate(_OBJECT_ATTRIBUTES)}
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


def _object_numbers(words: list[str], where: str) -> np.ndarray:
    """The numbers after the type, the score last, NaN without one: float64 [15]."""
    if len(words) not in (_COLUMNS, _COLUMNS + 1):
        raise AdapterError(
            f"{where}: expected a type and 14 numbers, and maybe a score; got {len(words)} words"
        )
    numbers = parse_numbers(" ".join(words[1:]), where)
    if min(numbers[7:10]) <= 0:
        raise AdapterError(f"{where}: h, w, l must be metres > 0; got {numbers[7:10].tolist()}")
    return numbers if len(numbers) == _COLUMNS else np.append(numbers, np.nan)
