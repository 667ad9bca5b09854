"""nuScenes' boxes and sweeps by frame, passed through in its global world."""

from __future__ import annotations

import dataclasses
import io
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adapters.lidar.stored import stored_records
from adapters.nuscenes.classes import NO_SURFACE, class_table
from adapters.nuscenes.frames import FrameFiles, scene_frames
from adapters.nuscenes.options import NuScenesOptions
from adapters.nuscenes.sweeps import SweepFault, read_returns
from adapters.nuscenes.tables import Annotation, SceneTables, SensorFile, read_tables
from adapters.plain_files import inside
from augment.errors import AdapterError
from augment.files.pickles import read_npy
from augment.labels import Boxes, LidarSweep
from augment.lidar_weather.codes import INDEX_COLUMN

_RECORD = ("x", "y", "z", "intensity", "ring")  # of a sweep's file
_STRAIGHT = 1e-9  # of the cosine: between nearly equal rotations a straight line is exact


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
    it the LiDAR looked there, see turning.py), and semantic (lidarseg's numbers, uint8) where the
    sweep has them. Returns of the recording car are among them.
    """

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

    @property
    def no_surface_classes(self) -> tuple[int, ...]:
        """The sweeps' class numbers of returns that no surface made: noise."""
        table = class_table(self.tables.class_names)
        return tuple(int(n) for n in np.flatnonzero(table == NO_SURFACE))

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        """The SemanticClass of each return, or NO_SURFACE; None for a sweep without classes."""
        classes = sweep.columns.get("semantic")
        if classes is None:
            return None
        table = class_table(self.tables.class_names)
        return table[np.clip(classes.astype(np.int64), 0, len(table) - 1)]

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """The sensor's place at the time of the file, to which its returns are compensated: within
        the turn of 50 ms it was up to half of the way elsewhere that the car drives in it.
        """
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


def _panoptic_of(file: Path, rows: np.ndarray) -> bytes:
    """The numbers of those returns in a file of nuScenes' panoptic labels.

    Raises:
        AdapterError: the file is damaged, or has no number for one of them.
    """
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
    """The labels of a scene; whatever frames= says, they are those of all its frames.

    Raises:
        AdapterError: as open_nuscenes for the options and the tables.
    """
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
    moved = [
        _between(earlier[box.instance], box, fraction) if box.instance in earlier else box
        for box in sample.annotations
    ]
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


def _between(before: Annotation, after: Annotation, fraction: float) -> Annotation:
    return dataclasses.replace(
        after,
        center_m=before.center_m + fraction * (after.center_m - before.center_m),
        quat=slerp(before.quat, after.quat, fraction),
    )


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
