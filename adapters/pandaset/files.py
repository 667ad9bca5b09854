"""The files of one PandaSet sequence, read and checked, and their labels.

    camera/<name>/NN.jpg            undistorted images; intrinsics.json, poses.json, timestamps.json
    lidar/NN.pkl.gz                 returns of both sensors; poses.json, timestamps.json
    annotations/cuboids/NN.pkl.gz   boxes
    annotations/semseg/NN.pkl.gz    class of each return; classes.json

The world is the sequence's own: metres, z up. Camera poses are world_from_camera with OpenCV axes.
A LiDAR pose is the car's: x right, y forward, z up, so world_from_ego is that pose turned by a
quarter about z. Times are seconds, stored here as integer nanoseconds. Errors are AdapterErrors
that name the file.
"""

from __future__ import annotations

import gzip
import io
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch

from adapters.plain_files import ImageFault, decode_image, is_whole_jpeg, number_of, read_json
from adapters.raw_drive import NO_SURFACE, class_table, classes_of, drive_origin
from adapters.safe_pickle import read_frame
from augment.effects.lidar.codes import INDEX_COLUMN
from augment.errors import AdapterError
from augment.geometry import rigid, rotmat_from_quat
from augment.labels import Boxes, LidarSweep
from augment.semantics import SemanticClass, class_of_label

_LATEST_S = 9e9  # int64 nanoseconds reach 9.2e9 s
LIDAR_COLUMNS = ("x", "y", "z", "i", "t", "d")
# Columns: ego x (forward), y (left), z in the axes of the LiDAR pose (x right, y forward).
LIDAR_POSE_FROM_EGO = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class CameraTrack:
    """One camera over the sequence. size: width and height, pixels. lens: fx, fy, cx, cy, pixels.

    world_from_camera: float64 [F, 4, 4]; timestamps_ns: int64 [F]; images: one path a frame, None
    where the image is missing or damaged."""

    name: str
    size: tuple[int, int]
    lens: tuple[float, float, float, float]
    world_from_camera: np.ndarray
    timestamps_ns: np.ndarray
    images: tuple[Path | None, ...]


@dataclass(frozen=True, eq=False)
class Sequence:
    """Calibration and timing of a sequence of F frames, numbered from 0 as the files are.

    world_origin_m: float64 [3], what was subtracted from the files' coordinates to give the scene's
    world, in which all poses here are. world_from_ego: float64 [F, 4, 4], ego x forward, y left,
    z up. timestamps_ns: int64 [F], the ends of the sweeps. problems: what was missing and gone on
    without, one sentence each."""

    root: Path
    world_origin_m: np.ndarray
    world_from_ego: np.ndarray
    timestamps_ns: np.ndarray
    cameras: tuple[CameraTrack, ...]
    problems: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.timestamps_ns)


def read_sequence(root: Path) -> Sequence:
    """The calibration, poses and times of the sequence in a folder."""
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a PandaSet sequence such as .../002")
    poses, times = _read_lidar_track(root)
    if not (root / "camera").is_dir():
        raise AdapterError(
            f"{root / 'camera'} does not exist; expected a PandaSet sequence's camera/"
        )
    folders = sorted(p for p in (root / "camera").iterdir() if p.is_dir())
    if not folders:
        raise AdapterError(f"{root / 'camera'} holds no camera folder; unpack the sequence again")
    problems: list[str] = []
    cameras = [_read_camera(folder, len(poses), problems) for folder in folders]
    origin = drive_origin(poses[:, :3, 3])
    poses[:, :3, 3] -= origin
    for camera in cameras:
        camera.world_from_camera[:, :3, 3] -= origin
    ego = poses @ LIDAR_POSE_FROM_EGO
    return Sequence(root, origin, ego, times, tuple(cameras), tuple(problems))


def read_ego_track(root: Path) -> tuple[np.ndarray, np.ndarray]:
    """world_from_ego [F, 4, 4] in the dataset's own world and the times [F] of the sweeps' ends,
    remembered as long as the files stay as they are."""
    files = [root / "lidar" / name for name in ("poses.json", "timestamps.json")]
    state = tuple((f.stat().st_mtime_ns, f.stat().st_size) if f.exists() else None for f in files)
    return _ego_track(root, state)


@lru_cache(maxsize=2)
def _ego_track(root: Path, state: object) -> tuple[np.ndarray, np.ndarray]:
    poses, times = _read_lidar_track(root)
    return poses @ LIDAR_POSE_FROM_EGO, times


def _read_lidar_track(root: Path) -> tuple[np.ndarray, np.ndarray]:
    """The LiDAR's poses [F, 4, 4] in the dataset's own world, and the times [F]."""
    poses = _read_poses(root / "lidar" / "poses.json")
    return poses, _read_times(root / "lidar" / "timestamps.json", expected=len(poses))


def frame_file(root: Path, folder: str, frame: int) -> Path:
    """The path of a frame's table: `folder` is lidar, annotations/cuboids or annotations/semseg."""
    return root / folder / f"{frame:02d}.pkl.gz"


def read_lidar(root: Path, frame: int) -> pd.DataFrame | None:
    """The returns of a frame, columns x y z i t d as in the file, or None without a file."""
    path = frame_file(root, "lidar", frame)
    return _read_table(path, LIDAR_COLUMNS) if path.exists() else None


def read_semantics(root: Path, frame: int, rows: int) -> np.ndarray | None:
    """The class number of each return of the frame, int64 [rows], or None without a file."""
    path = frame_file(root, "annotations/semseg", frame)
    if not path.exists():
        return None
    classes = _read_table(path, ("class",))["class"].to_numpy()
    if len(classes) != rows:
        raise AdapterError(
            f"{path} must have a class for each of the {rows} returns in lidar/{frame:02d}.pkl.gz; "
            f"it has {len(classes)}"
        )
    return classes


def read_cuboids(root: Path, frame: int) -> pd.DataFrame | None:
    """The boxes of a frame with all their columns, or None without a file."""
    path = frame_file(root, "annotations/cuboids", frame)
    needed = ("uuid", "label", "yaw", "stationary")
    needed += tuple(f"{group}.{axis}" for group in ("position", "dimensions") for axis in "xyz")
    return _read_table(path, needed) if path.exists() else None


def _read_table(path: Path, needed: tuple[str, ...]) -> pd.DataFrame:
    table = read_frame(path)
    missing = [name for name in needed if name not in table.columns]
    if missing:
        raise AdapterError(f"{path} lacks the columns {missing}; it has {list(table.columns)}")
    return table


def _read_camera(folder: Path, frames: int, problems: list[str]) -> CameraTrack:
    path = folder / "intrinsics.json"
    lens = read_json(path)
    fx, fy, cx, cy = (
        number_of(lens.get(key), f"{path}: {key} (pixels)") for key in ("fx", "fy", "cx", "cy")
    )
    if min(fx, fy) <= 0:
        raise AdapterError(f"{path}: fx and fy (pixels) must be above 0; got {fx} and {fy}")
    poses = _read_poses(folder / "poses.json")
    if len(poses) != frames:
        raise AdapterError(
            f"{folder / 'poses.json'} has {len(poses)} poses; lidar/poses.json has {frames}"
        )
    times = _read_times(folder / "timestamps.json", expected=frames)
    images, (height, width) = _find_images(folder, frames, problems)
    return CameraTrack(folder.name, (width, height), (fx, fy, cx, cy), poses, times, images)


def _find_images(
    folder: Path, frames: int, problems: list[str]
) -> tuple[tuple[Path | None, ...], tuple[int, int]]:
    """The usable image of every frame, and the rows and columns of all."""
    numbers = {int(p.stem) for p in folder.glob("*.jpg") if re.fullmatch(r"\d+", p.stem)}
    if not numbers:
        raise AdapterError(f"{folder} holds no images NN.jpg; unpack the sequence again")
    if max(numbers) >= frames:
        raise AdapterError(
            f"{folder} holds image {max(numbers):02d}.jpg, but timestamps.json ends with frame "
            f"{frames - 1:02d}: images and timestamps are not of one sequence"
        )
    paths = [folder / f"{frame:02d}.jpg" for frame in range(frames)]
    faults = [_file_fault(path) for path in paths]
    size = _image_size(folder, [p for p, fault in zip(paths, faults, strict=True) if not fault])
    images: list[Path | None] = []
    for frame, (path, fault) in enumerate(zip(paths, faults, strict=True)):
        fault = fault or _picture_fault(path, size)
        if fault:
            problems.append(f"camera {folder.name}, frame {frame}: image {path} {fault}")
        images.append(None if fault else path)
    return tuple(images), size


def _file_fault(path: Path) -> str:
    try:
        return "" if is_whole_jpeg(path) else "is not a JPEG file"
    except ImageFault as fault:
        return str(fault)


def _picture_fault(path: Path, size: tuple[int, int]) -> str:
    """What is wrong with the picture in a JPEG file, decoded at an eighth of its size."""
    image = decode_image(path, cv2.IMREAD_REDUCED_GRAYSCALE_8)
    if image is None:
        return "cannot be decoded"
    if image.shape != tuple(-(-side // 8) for side in size):
        return f"is not of {size[1]}x{size[0]} pixels as the camera's first image"
    return ""


def _image_size(folder: Path, paths: list[Path]) -> tuple[int, int]:
    """Rows and columns of the first image that can be decoded."""
    for path in paths:
        image = decode_image(path, cv2.IMREAD_UNCHANGED)
        if image is not None:
            return image.shape[0], image.shape[1]
    raise AdapterError(f"{folder} holds no image that can be decoded; unpack the sequence again")


def _read_times(path: Path, *, expected: int) -> np.ndarray:
    """Nanoseconds, int64 [expected]."""
    times = np.array(
        [
            number_of(seconds, f"{path}, frame {frame}: the time in seconds", largest=_LATEST_S)
            for frame, seconds in enumerate(read_json(path, list))
        ]
    )
    if len(times) != expected:
        raise AdapterError(f"{path} has {len(times)} entries; there are {expected} LiDAR poses")
    if not (np.diff(times) > 0).all():
        frame = int(np.argmin(np.diff(times) > 0)) + 1
        raise AdapterError(
            f"{path} must be increasing; frame {frame} is at {times[frame]} s after "
            f"{times[frame - 1]} s. Copy it again"
        )
    return np.round(times * 1e9).astype(np.int64)


def _read_poses(path: Path) -> np.ndarray:
    """Rigid transforms, float64 [F, 4, 4]."""
    values = np.array(
        [
            _pose_numbers(entry, f"{path}, frame {i}")
            for i, entry in enumerate(read_json(path, list))
        ]
    )
    if len(values) == 0:
        raise AdapterError(f"{path} holds no poses")
    norms = np.linalg.norm(values[:, 3:], axis=1)
    # Headings are stored to 16 digits; a norm off by a thousandth is no rotation.
    if not (np.abs(norms - 1) < 1e-3).all():
        frame = int(np.argmax(np.abs(norms - 1) >= 1e-3))
        raise AdapterError(
            f"{path}, frame {frame}: heading must be a unit quaternion w x y z; got "
            f"{values[frame, 3:].tolist()}. Copy the file again"
        )
    rotation = rotmat_from_quat(torch.from_numpy(values[:, 3:]))
    return rigid(rotation, torch.from_numpy(values[:, :3])).numpy()


def _pose_numbers(entry: Any, where: str) -> list[float]:
    """x y z and w x y z of an entry of poses.json."""
    numbers = []
    for group, axes in (("position", "xyz"), ("heading", "wxyz")):
        values = entry.get(group) if isinstance(entry, dict) else None
        if not isinstance(values, dict):
            raise AdapterError(
                f"{where} must have a position x y z and a heading w x y z; got {entry!r:.80}"
            )
        numbers += [number_of(values.get(axis), f"{where}: {group}.{axis}") for axis in axes]
    return numbers


# ---- Boxes, sweeps and classes -------------------------------------------------------------------
# A moving object is labelled once a sensor, up to 0.1 s apart, with a uuid for each box
# (`cuboids.sensor_id`: 0 the spinning sensor, 1 the forward one, -1 a box of both) and the other's
# uuid in `cuboids.sibling_id`. Published links go one way only, are cut short, or name their own
# box. Here both boxes are one object.

# The area that two boxes share, of that which either covers. In sequence 002 boxes tied by links
# share 0.31 to 0.98 of it on average over their frames, others of one class 0.01 at most.
MIN_OVERLAP = 0.25
_Rectangle = tuple[list[float], list[float], float]  # centre, sides, degrees
_NO_SENSOR = -1  # the sensor of a box that was drawn around both sensors' returns

# The sensors on the car: forward, left, up of the ego origin. The spinning one is where all six
# cameras' poses put it by the published extrinsics, within 2 cm. Those of the forward one put it at
# (1.41, 0.00, 1.55); from (1.35, 0.04, 1.65) its returns hide each other least, within about 5 cm.
SENSORS_M = np.array([[0.81, 0.0, 1.85], [1.35, 0.04, 1.65]])

# The published classes.json, numbered from 1.
_S = SemanticClass
_CLASSES: tuple[tuple[str, int], ...] = (
    ("Smoke", NO_SURFACE), ("Exhaust", NO_SURFACE), ("Spray or rain", NO_SURFACE),
    ("Reflection", NO_SURFACE), ("Vegetation", _S.VEGETATION), ("Ground", _S.TERRAIN),
    ("Road", _S.ROAD), ("Lane Line Marking", _S.LANE_MARKING),
    ("Stop Line Marking", _S.LANE_MARKING), ("Other Road Marking", _S.LANE_MARKING),
    ("Sidewalk", _S.SIDEWALK), ("Driveway", _S.SIDEWALK), ("Car", _S.VEHICLE),
    ("Pickup Truck", _S.VEHICLE), ("Medium-sized Truck", _S.VEHICLE), ("Semi-truck", _S.VEHICLE),
    ("Towed Object", _S.VEHICLE), ("Motorcycle", _S.TWO_WHEELER),
    ("Other Vehicle - Construction Vehicle", _S.VEHICLE),
    ("Other Vehicle - Uncommon", _S.VEHICLE), ("Other Vehicle - Pedicab", _S.TWO_WHEELER),
    ("Emergency Vehicle", _S.VEHICLE), ("Bus", _S.VEHICLE),
    ("Personal Mobility Device", _S.TWO_WHEELER), ("Motorized Scooter", _S.TWO_WHEELER),
    ("Bicycle", _S.TWO_WHEELER), ("Train", _S.VEHICLE), ("Trolley", _S.VEHICLE),
    ("Tram / Subway", _S.VEHICLE), ("Pedestrian", _S.PEDESTRIAN),
    ("Pedestrian with Object", _S.PEDESTRIAN), ("Animals - Bird", _S.OTHER),
    ("Animals - Other", _S.OTHER), ("Pylons", _S.BARRIER), ("Road Barriers", _S.BARRIER),
    ("Signs", _S.SIGN), ("Cones", _S.OTHER), ("Construction Signs", _S.SIGN),
    ("Temporary Construction Barriers", _S.BARRIER), ("Rolling Containers", _S.OTHER),
    ("Building", _S.BUILDING), ("Other Static Object", _S.OTHER),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Objects:
    """names: by uuid, the object's name: that of its best box, the one with boxes in most frames,
    then the spinning sensor's, then the first in the files. ranks: by uuid; of an object's boxes in
    one frame the lowest is kept."""

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
    column = table.get("cuboids.sensor_id", pd.Series([_NO_SENSOR] * len(table)))
    return [int(value) if value in (0, 1) else _NO_SENSOR for value in column]


def read_objects(root: Path) -> Objects:
    """The objects of all frames, remembered as long as the files stay as they are. A table that
    cannot be read is an error of its own frame, not here."""
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
    """The objects in the cuboids of some frames: tied by links in both directions, then in one,
    then, without a partner, by overlap: boxes of one class and both sensors that share MIN_OVERLAP
    on average. No tie makes two boxes of one sensor in one frame the same object."""
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
        return self.sensors[a] == self.sensors[b] != _NO_SENSOR


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
        usable &= np.array(sensors_of(table)) != _NO_SENSOR
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


def semantic_table(root: Path) -> np.ndarray:
    """SemanticClass (or NO_SURFACE) by the sequence's class number, int16 [256]; unknown names
    are UNKNOWN. Numbers are those of annotations/semseg/classes.json, or of the published list."""
    names = {number: name for number, (name, _) in enumerate(_CLASSES, start=1)}
    path = root / "annotations" / "semseg" / "classes.json"
    if path.exists():
        found = read_json(path)
        for key, name in found.items():
            if not (re.fullmatch("[0-9]{1,9}", key) and isinstance(name, str)):
                raise AdapterError(
                    f"{path} must map class numbers to names; got {key!r:.80}: {name!r:.80}"
                )
        names = {int(key): name for key, name in found.items()}
        if max(names, default=0) > 255:
            raise AdapterError(f"{path}: class numbers must lie in 0 to 255; got {max(names)}")
    return class_table(names, dict(_CLASSES))


@dataclass(frozen=True)
class PandaSetLabels:
    """Labels of one sequence, read when asked.

    Boxes: one an object; where both sensors' cuboids of it are in the file, the one that
    `Objects` ranks first. A track_id is the uuid of the object's best box, the same in all
    frames; attributes hold every column of the file under its own name (None where a text is
    missing), the box's own uuid, yaw and sibling included. Sweeps: columns x y z (metres), i
    (intensity 0 to 255), t (seconds), d (0: the spinning sensor, 1: the forward one) exactly as in
    the file, and semantic (the dataset's own class numbers) where the frame has them."""

    root: Path

    def boxes(self, frame_index: int) -> Boxes:
        table = read_cuboids(self.root, frame_index)
        if table is None:
            return Boxes.empty()
        objects = read_objects(self.root)
        boxes = boxes_of_cuboids(table[objects.kept(table["uuid"].astype(str))])
        return replace(boxes, track_ids=tuple(objects.names[uuid] for uuid in boxes.track_ids))

    @property
    def no_surface_classes(self) -> tuple[int, ...]:
        """The sweeps' class numbers of returns that no surface made: smoke, spray, reflections."""
        return tuple(int(n) for n in np.flatnonzero(semantic_table(self.root) == NO_SURFACE))

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        """The SemanticClass of each return, or NO_SURFACE; None for a sweep without classes."""
        return classes_of(sweep, semantic_table(self.root))

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Where each return's own sensor was at its own time: the car on a straight line between
        its poses at the ends of the sweeps, and turned as at the end of this one."""
        world_from_ego, times_ns = read_ego_track(self.root)
        if not 0 <= frame_index < len(times_ns):
            return None
        turn = world_from_ego[frame_index, :3, :3]
        seconds = np.asarray(sweep.columns["t"], np.float64) - times_ns[0] * 1e-9
        places = places_at(world_from_ego[:, :3, 3], (times_ns - times_ns[0]) * 1e-9, seconds)
        offsets = np.stack([turn @ SENSORS_M[0], turn @ SENSORS_M[1]])
        return places + offsets[(np.asarray(sweep.columns["d"]) == 1).astype(np.int64)]

    def lidar(self, frame_index: int) -> LidarSweep | None:
        table = read_lidar(self.root, frame_index)
        if table is None:
            return None
        columns = {name: table[name].to_numpy() for name in LIDAR_COLUMNS}
        classes = read_semantics(self.root, frame_index, len(table))
        if classes is not None:
            columns["semantic"] = classes
        return LidarSweep(columns)

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        folders = ("lidar", "annotations/semseg")
        files = tuple(frame_file(self.root, folder, frame_index) for folder in folders)
        return tuple(file for file in files if file.exists()) if files[0].exists() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """Tables of those rows under their own index: rows of both files still name each other."""
        table = read_frame(file).iloc[sweep.columns[INDEX_COLUMN]].copy()
        if file == frame_file(self.root, "lidar", frame_index):
            for name in "xyzi":
                table[name] = sweep.columns[name]
        stream = io.BytesIO()
        table.to_pickle(stream, compression=None, protocol=4)
        return gzip.compress(stream.getvalue(), compresslevel=6, mtime=0)


def places_at(places_m: np.ndarray, times_s: np.ndarray, wanted_s: np.ndarray) -> np.ndarray:
    """Positions [N, 3] at times [N] on the straight lines through places [F, 3] at rising times
    [F], the first of which goes on to before it and the last to after it."""
    if len(times_s) == 1:
        return np.broadcast_to(places_m[0], (len(wanted_s), 3))
    after = np.clip(np.searchsorted(times_s, wanted_s), 1, len(times_s) - 1)
    span = times_s[after] - times_s[after - 1]
    share = ((wanted_s - times_s[after - 1]) / span)[:, None]
    return places_m[after - 1] + share * (places_m[after] - places_m[after - 1])


def boxes_of_cuboids(table: pd.DataFrame) -> Boxes:
    """A frame's cuboids as boxes. PandaSet's have their length along y and their width along x: the
    heading is a quarter turn more than yaw and the first two sizes swap."""
    half = (table["yaw"].to_numpy(dtype=np.float64) + np.pi / 2) / 2
    zero = np.zeros_like(half)
    dimensions = [table[f"dimensions.{axis}"].to_numpy(dtype=np.float64) for axis in "yxz"]
    positions = [table[f"position.{axis}"].to_numpy(dtype=np.float64) for axis in "xyz"]
    return Boxes(
        track_ids=tuple(str(v) for v in table["uuid"]),
        labels=tuple(str(v) for v in table["label"]),
        centers_m=np.stack(positions, axis=1),
        sizes_m=np.stack(dimensions, axis=1),
        quats=np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1),
        attributes={str(name): _plain(table[name]) for name in table.columns},
    )


def _plain(column: pd.Series) -> np.ndarray:
    """The column's values; NaN among texts, pandas' mark of a missing one, becomes None."""
    values = column.to_numpy()
    if values.dtype != object:
        return values
    return np.array([None if isinstance(v, float) and np.isnan(v) else v for v in values], object)


def pandaset_labels(path: str, query: dict[str, str]) -> PandaSetLabels:
    """The labels of a folder; whatever the query, they are those of all its frames."""
    return PandaSetLabels(Path(path))
