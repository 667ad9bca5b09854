"""nuScenes' sweeps and boxes by frame, in its global world.

A LiDAR file holds records of five float32: x, y, z (metres, sensor's axes), intensity (0 to 255),
ring. The published files are taken as they are described: compensated for the car's motion during
the turn of 50 ms, so that one pose, that of the file's own time, carries all of its returns. When
each was measured is not stored; its bearing tells (see tables.Turn).
"""

from __future__ import annotations

import dataclasses
import io
import zipfile
import zlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from adapters.nuscenes.tables import (
    Annotation,
    FrameFiles,
    NuScenesOptions,
    SceneTables,
    SensorFile,
    read_tables,
    scene_frames,
)
from adapters.plain_files import inside
from adapters.raw_drive import NO_SURFACE, Sweep, class_table, classes_of, is_in_box, stored_records
from augment.effects.lidar.codes import INDEX_COLUMN
from augment.errors import AdapterError
from augment.files.pickles import read_npy
from augment.labels import Boxes, LidarSweep
from augment.semantics import SemanticClass
from recipes.files import open_file

RECORD_BYTES = 20
_RECORD = ("x", "y", "z", "intensity", "ring")
_STRAIGHT = 1e-9  # of the cosine: between nearly equal rotations a straight line is exact
# The recording car with its sensors in its own frame (x forward, y left, z up, origin on the ground
# below the rear axle). Measured on a published sweep: its returns on the car, a quarter of all, lie
# in x -0.2..2.8, y -0.7..0.7, z 0.8..1.9; the car, 4.1 m by 1.8 m, reaches from -0.7 to 3.5.
EGO_LOW_M = np.array([-0.8, -1.0, -0.5])
EGO_HIGH_M = np.array([3.6, 1.0, 2.3])
_EGO_CLASS = 31
# lidarseg's classes as published, numbered from 0, and what they mean here.
_S = SemanticClass
_CLASSES: tuple[tuple[str, int], ...] = (
    ("noise", NO_SURFACE), ("animal", _S.OTHER), ("human.pedestrian.adult", _S.PEDESTRIAN),
    ("human.pedestrian.child", _S.PEDESTRIAN),
    ("human.pedestrian.construction_worker", _S.PEDESTRIAN),
    ("human.pedestrian.personal_mobility", _S.TWO_WHEELER),
    ("human.pedestrian.police_officer", _S.PEDESTRIAN),
    ("human.pedestrian.stroller", _S.PEDESTRIAN), ("human.pedestrian.wheelchair", _S.PEDESTRIAN),
    ("movable_object.barrier", _S.BARRIER), ("movable_object.debris", _S.OTHER),
    ("movable_object.pushable_pullable", _S.OTHER), ("movable_object.trafficcone", _S.OTHER),
    ("static_object.bicycle_rack", _S.OTHER), ("vehicle.bicycle", _S.TWO_WHEELER),
    ("vehicle.bus.bendy", _S.VEHICLE), ("vehicle.bus.rigid", _S.VEHICLE),
    ("vehicle.car", _S.VEHICLE), ("vehicle.construction", _S.VEHICLE),
    ("vehicle.emergency.ambulance", _S.VEHICLE), ("vehicle.emergency.police", _S.VEHICLE),
    ("vehicle.motorcycle", _S.TWO_WHEELER), ("vehicle.trailer", _S.VEHICLE),
    ("vehicle.truck", _S.VEHICLE), ("flat.driveable_surface", _S.ROAD),
    ("flat.other", _S.TERRAIN), ("flat.sidewalk", _S.SIDEWALK), ("flat.terrain", _S.TERRAIN),
    # Walls, but poles and signs too: lidarseg does not tell them apart.
    ("static.manmade", _S.BUILDING), ("static.other", _S.OTHER),
    ("static.vegetation", _S.VEGETATION), ("vehicle.ego", _S.VEHICLE),
)  # fmt: skip


class SweepFault(Exception):
    """What is wrong with a sweep's file, as the end of a sentence that starts with its path."""


@dataclass(frozen=True, eq=False)
class Returns:
    """What one LiDAR file holds. points_m: float64 [N, 3], global. intensity, ring: float32 [N], as
    in the file. timestamps_ns: int64 [N], told by bearing. classes: uint8 [N], lidarseg's numbers,
    or None. problem: a sentence or ''."""

    points_m: np.ndarray
    timestamps_ns: np.ndarray
    intensity: np.ndarray
    ring: np.ndarray
    classes: np.ndarray | None
    problem: str

    def __len__(self) -> int:
        return len(self.points_m)


def read_returns(tables: SceneTables, sweep: SensorFile) -> Returns:
    """All returns of a sweep, in the file's order.

    Raises:
        SweepFault: no file, or not of whole records.
        AdapterError: the file's name leads outside of the dataset.
    """
    content = _bytes(inside(tables.root, sweep.filename, f"sample_data {sweep.token!r}"))
    if len(content) == 0 or len(content) % RECORD_BYTES:
        raise SweepFault(
            f"is of {len(content)} bytes, not of whole records of {RECORD_BYTES}: it is cut short"
        )
    records = np.frombuffer(content, "<f4").reshape(-1, 5)
    pose = sweep.world_from_sensor
    with np.errstate(all="ignore"):  # returns that are no numbers stay none
        local = records[:, :3].astype(np.float64)
        points = local @ pose[:3, :3].T + pose[:3, 3]
        before = tables.turn.before_ns(local @ sweep.ego_from_sensor[:3, :3].T)
    classes, problem = _read_classes(tables, sweep, len(records))
    times_ns = sweep.timestamp_ns - before
    return Returns(points, times_ns, records[:, 3].copy(), records[:, 4].copy(), classes, problem)


@dataclass(frozen=True, eq=False)
class NuScenesLabels:
    """Labels of one scene: boxes from memory, sweeps read when asked.

    Boxes: track_ids are instance tokens, labels category names. Attributes: `token` of the
    annotation, `attributes` (names joined by commas), `visibility` (such as v80-100),
    num_lidar_pts, num_radar_pts, `interpolated`. Frames of keyframes have their sample's boxes as
    they are. Those of sweeps between have the boxes of their sample, which is the next keyframe,
    moved to where they were between that keyframe and the one before: centre linear in time,
    rotation by slerp, all else that of the later box. Where the earlier keyframe has no box of the
    instance, the later box stands as it is. So it is in the devkit's get_boxes.

    Sweeps: columns x y z (metres, float64, nuScenes' global world), intensity (0 to 255) and ring
    (both float32 as in the file), timestamp_ns (not published: the file's time less how long before
    it the LiDAR looked there, see tables.Turn), and semantic (lidarseg's numbers, uint8) where the
    sweep has them. Returns of the recording car are among them."""

    tables: SceneTables
    frames: tuple[FrameFiles, ...]

    def boxes(self, frame_index: int) -> Boxes:
        frame = self._frame(frame_index)
        return Boxes.empty() if frame is None else boxes_of_sweep(self.tables, frame.sweep)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        frame = self._frame(frame_index)
        if frame is None:
            return None
        try:
            returns = read_returns(self.tables, frame.sweep)
        except (FileNotFoundError, SweepFault):
            return None
        columns = {name: returns.points_m[:, i] for i, name in enumerate("xyz")}
        columns |= {"intensity": returns.intensity, "ring": returns.ring}
        columns["timestamp_ns"] = returns.timestamps_ns
        if returns.classes is not None:
            columns["semantic"] = returns.classes
        return LidarSweep(columns)

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        return classes_of(sweep, _class_table(self.tables))

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """The sensor's place at the time of the file, to which its returns are compensated: within
        the turn of 50 ms it was up to half of the way elsewhere that the car drives in it."""
        frame = self._frame(frame_index)
        if frame is None:
            return None
        return np.broadcast_to(frame.sweep.world_from_sensor[:3, 3], (len(sweep), 3))

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """Sweep, classes (lidarseg) and objects (panoptic) of the returns, as far as they exist."""
        frame, tables = self._frame(frame_index), self.tables
        if frame is None:
            return ()
        token = frame.sweep.token
        named = (tables.semantic_files.get(token), tables.panoptic_files.get(token))
        names = [frame.sweep.filename, *(name for name in named if name is not None)]
        where = f"sample_data {token!r}"
        files = [inside(tables.root, name, where) for name in names]
        return tuple(file for file in files if file.exists()) if files[0].exists() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        sensor, rows = self.frames[frame_index].sweep, sweep.columns[INDEX_COLUMN]
        if file.suffix == ".npz":
            return _panoptic_of(file, rows)
        content = np.fromfile(file, np.uint8)
        if file != inside(self.tables.root, sensor.filename, f"sample_data {sensor.token!r}"):
            if rows.max(initial=-1) >= len(content):
                raise AdapterError(
                    f"{file} has {len(content)} classes, fewer than {sensor.filename} has returns; "
                    f"copy it again"
                )
            return content[rows].tobytes()
        records = content.view("<f4").reshape(-1, 5)
        return stored_records(records, _RECORD, sweep, sensor.world_from_sensor)

    def _frame(self, index: int) -> FrameFiles | None:
        return self.frames[index] if 0 <= index < len(self.frames) else None


def read_sweeps(
    tables: SceneTables,
    frames: Sequence[FrameFiles],
    world_origin_m: np.ndarray,
    *,
    held_out: Collection[int] = frozenset(),
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """The usable returns of every frame that has a file and is not held out, in the scene's world,
    and what was missing, one sentence each.

    Left out: returns of the recording car itself, of no surface (lidarseg's noise), not finite."""
    sweeps, problems, missing = [], [], []
    used = [frame for frame in frames if frame.index not in held_out]
    table = _class_table(tables)
    for frame in tqdm(used, desc="LiDAR", unit="sweep", disable=None):
        try:
            returns = read_returns(tables, frame.sweep)
        except FileNotFoundError:
            missing.append(frame)
            continue
        except SweepFault as fault:
            problems.append(
                f"frame {frame.index}: {frame.sweep.filename} {fault}; its points are left out"
            )
            continue
        if returns.problem:
            problems.append(f"frame {frame.index}: {returns.problem}")
        sweeps.append(_usable(returns, frame.sweep, world_origin_m, table))
    if missing:
        problems.append(
            f"{len(missing)} of {len(used)} LiDAR files are missing, their points too (the first: "
            f"frame {missing[0].index}, {missing[0].sweep.filename})"
        )
    return tuple(sweeps), tuple(problems)


def _usable(
    returns: Returns, sweep: SensorFile, world_origin_m: np.ndarray, table: np.ndarray
) -> Sweep:
    pose = sweep.world_from_ego
    keep = np.isfinite(returns.points_m).all(axis=1)
    with np.errstate(all="ignore"):
        ego = (returns.points_m - pose[:3, 3]) @ pose[:3, :3]
    keep &= ~is_in_box(ego, EGO_LOW_M, EGO_HIGH_M)
    semantic = np.full(len(returns), SemanticClass.UNKNOWN, np.int16)
    if returns.classes is not None:
        semantic = table[returns.classes]
        keep &= (semantic != NO_SURFACE) & (returns.classes != _EGO_CLASS)
    points = (returns.points_m[keep] - world_origin_m).astype(np.float32)
    return Sweep(points, returns.timestamps_ns[keep], semantic[keep])


def _bytes(path: Path) -> bytes:
    try:
        with open_file(path) as file:
            return file.read()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise SweepFault(f"cannot be read ({error.strerror or error})") from None


def _read_classes(
    tables: SceneTables, sweep: SensorFile, count: int
) -> tuple[np.ndarray | None, str]:
    """The class of each return, and why there is none where there should be."""
    name = tables.semantic_files.get(sweep.token)
    if name is None:
        return None, ""
    path = inside(tables.root, name, f"lidarseg of sample_data {sweep.token!r}")
    try:
        classes = np.frombuffer(_bytes(path), np.uint8)
    except FileNotFoundError:
        return None, f"{name} is missing; its points have no class"
    except SweepFault as fault:
        return None, f"{name} {fault}; its points have no class"
    if len(classes) != count:
        return None, (
            f"{name} has {len(classes)} classes for {count} returns; its points have no class"
        )
    return classes, ""


def _class_table(tables: SceneTables) -> np.ndarray:
    """As class_table; where category.json numbers none, by the published numbers."""
    numbered = tables.class_names or {n: name for n, (name, _) in enumerate(_CLASSES)}
    return class_table(numbered, dict(_CLASSES))


def _panoptic_of(file: Path, rows: np.ndarray) -> bytes:
    """The numbers of those returns in a file of nuScenes' panoptic labels."""
    try:
        with zipfile.ZipFile(file) as archive, archive.open("data.npy") as member:
            opened: Any = member
            numbers = read_npy(opened)[rows]
    except (OSError, ValueError, KeyError, IndexError, zlib.error, zipfile.BadZipFile) as error:
        raise AdapterError(
            f"{file} must hold an array `data`, one number a return ({error}); copy it again"
        ) from error
    content, out = io.BytesIO(), io.BytesIO()
    np.save(content, numbers)
    with zipfile.ZipFile(out, "w") as archive:  # np.savez would write the time of day
        entry = zipfile.ZipInfo("data.npy")
        archive.writestr(entry, content.getvalue(), zipfile.ZIP_DEFLATED)
    return out.getvalue()


def nuscenes_labels(path: str, query: dict[str, str]) -> NuScenesLabels:
    """The labels of a scene; whatever frames= says, they are those of all its frames."""
    options = NuScenesOptions.from_query(query)
    tables = read_tables(Path(path), options.version, options.scene)
    return NuScenesLabels(tables, scene_frames(tables, sweeps=options.sweeps)[0])


def boxes_of_sweep(tables: SceneTables, sweep: SensorFile) -> Boxes:
    """The boxes at a sweep's time, as in NuScenesLabels."""
    tokens = [sample.token for sample in tables.samples]
    number = tokens.index(sweep.sample_token)
    sample = tables.samples[number]
    if sweep.is_key_frame or number == 0:
        return _boxes(sample.annotations, interpolated=not sweep.is_key_frame)
    before = tables.samples[number - 1]
    earlier = {box.instance: box for box in before.annotations}
    span = sample.timestamp_ns - before.timestamp_ns
    fraction = (sweep.timestamp_ns - before.timestamp_ns) / span if span else 1.0
    fraction = min(max(fraction, 0.0), 1.0)
    moved = []
    for box in sample.annotations:
        start = earlier.get(box.instance)
        if start is not None:
            center_m = start.center_m + fraction * (box.center_m - start.center_m)
            quat = slerp(start.quat, box.quat, fraction)
            box = dataclasses.replace(box, center_m=center_m, quat=quat)
        moved.append(box)
    return _boxes(moved, interpolated=True)


def slerp(a: np.ndarray, b: np.ndarray, fraction: float) -> np.ndarray:
    """The rotation at a fraction of the shorter way from one quaternion to another, unit length."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    if cosine > 1 - _STRAIGHT:
        quat = a + fraction * (b - a)
    else:
        angle = np.arccos(cosine)
        quat = np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b
    return quat / np.linalg.norm(quat)


def _boxes(annotations: Sequence[Annotation], *, interpolated: bool) -> Boxes:
    count = len(annotations)
    return Boxes(
        track_ids=tuple(a.instance for a in annotations),
        labels=tuple(a.category for a in annotations),
        centers_m=np.array([a.center_m for a in annotations], np.float64).reshape(count, 3),
        sizes_m=np.array([a.size_m for a in annotations], np.float64).reshape(count, 3),
        quats=np.array([a.quat for a in annotations], np.float64).reshape(count, 4),
        attributes={
            "token": np.array([a.token for a in annotations], object),
            "attributes": np.array([",".join(a.attributes) for a in annotations], object),
            "visibility": np.array([a.visibility for a in annotations], object),
            "num_lidar_pts": np.array([a.lidar_points for a in annotations], np.int64),
            "num_radar_pts": np.array([a.radar_points for a in annotations], np.int64),
            "interpolated": np.full(count, interpolated),
        },
    )
