"""A recording's LiDAR files into sweeps of usable returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from adapters.lidar.split import Sweep
from adapters.lidar.sweep_times import sweep_times
from adapters.plain_files import LARGEST
from adapters.recording.calibration import NO_SURFACE, Calibration
from adapters.recording.classes import class_numbers, class_table
from adapters.recording.labels import lidar_files
from adapters.recording.tables import read_sweep
from augment.cameras import Frame
from augment.errors import AdapterError
from augment.labels import LidarSweep
from augment.semantics import SemanticClass

_FAR_M = 1000.0  # no LiDAR on the ground sees this far
_OWN_M, _OWN_PART = 1.5, 1e-3  # a car's own returns are some hundreds a sweep
_TOP_QUANTILE = 0.999
_TOP_BEYOND_M = 5.0  # nearer, a camera's height says little of the sensor's
_TOP_DEG = (2.0, 60.0)


@dataclass(frozen=True, eq=False)
class LidarDrive:
    """sweeps: one a frame that has a file, scene world. top_deg: about the highest elevation that
    the LiDAR looks at. problems: one sentence each."""

    sweeps: tuple[Sweep, ...]
    top_deg: float
    problems: tuple[str, ...]

    def __len__(self) -> int:
        return sum(len(sweep) for sweep in self.sweeps)


def read_lidar_drive(root: Path, calibration: Calibration, frames: Sequence[Frame]) -> LidarDrive:
    """The sweeps of the given frames.

    Left out: returns that are not finite, of no surface, or of the recording car (ego_box_m).

    Raises:
        AdapterError: a damaged file, or returns that cannot be in the calibration's world.
    """
    files = lidar_files(root)
    problems = []
    if files:
        missing = [f.index for f in frames if f.index not in files]
        problems += [
            f"frame {n}: lidar/{n:06d}.parquet is missing, its points too" for n in missing
        ]
    known = [(frame, files[frame.index]) for frame in frames if frame.index in files]
    raws = [
        _Raw.of(path, frame, calibration)
        for frame, path in tqdm(known, desc="LiDAR", unit="frame", disable=None)
    ]
    timeless = [raw.frame for raw in raws if raw.timeless]
    if timeless:
        problems.append(
            f"lidar/: no column timestamp_ns, or t in seconds, near the frame's time in "
            f"{len(timeless)} sweeps (the first of frame {timeless[0]}); their frames' times are "
            f"used, fast objects are smeared"
        )
    table, more = _class_table(root, raws, calibration)
    sweeps = tuple(raw.usable(table) for raw in raws)
    if calibration.ego_box_m is None:
        problems += _own_returns(sweeps, known)
    return LidarDrive(sweeps, _top_deg(sweeps, known), (*problems, *more))


@dataclass(frozen=True, eq=False)
class _Raw:
    frame: int
    points: np.ndarray  # float32 [N, 3], scene world, finite
    timestamps_ns: np.ndarray  # int64 [N]
    classes: np.ndarray | None  # int64 [N], the file's own numbers
    timeless: bool

    @staticmethod
    def of(path: Path, frame: Frame, calibration: Calibration) -> _Raw:
        sweep = read_sweep(path)
        world = sweep.points_m - calibration.world_origin_m
        pose = frame.world_from_ego.numpy()
        keep = (np.abs(world) <= LARGEST).all(axis=1)  # not NaN, and float32 has it
        ego = (np.where(keep[:, None], world, 0) - pose[:3, 3]) @ pose[:3, :3]
        if keep.any() and np.median(np.abs(ego[keep]).max(axis=1)) > _FAR_M:
            raise AdapterError(
                f"{path}: most returns lie more than {_FAR_M:.0f} m from the car as "
                f"calibration.json has it in frame {frame.index}; x, y, z must be metres in the "
                f"world of its poses, not in the sensor's"
            )
        if calibration.ego_box_m is not None:
            low, high = calibration.ego_box_m
            keep &= ~((ego > low) & (ego < high)).all(axis=1)
        times = _times(path, sweep, frame.timestamp_ns)
        classes = sweep.columns.get("semantic")
        if classes is not None:
            classes = class_numbers(path, classes)[keep]
        return _Raw(
            frame.index,
            world[keep].astype(np.float32),
            np.full(int(keep.sum()), frame.timestamp_ns) if times is None else times[keep],
            classes,
            timeless=times is None,
        )

    def usable(self, table: np.ndarray | None) -> Sweep:
        if self.classes is None or table is None:
            unknown = np.full(len(self.points), SemanticClass.UNKNOWN, np.int16)
            return Sweep(self.points, self.timestamps_ns, unknown)
        semantic = table[np.clip(self.classes, 0, len(table) - 1)]
        keep = semantic != NO_SURFACE
        return Sweep(self.points[keep], self.timestamps_ns[keep], semantic[keep])


def _times(path: Path, sweep: LidarSweep, frame_ns: int) -> np.ndarray | None:
    try:
        return sweep_times(sweep, frame_ns)
    except ValueError as error:
        raise AdapterError(f"{path}: {error}") from None


def _class_table(
    root: Path, raws: Sequence[_Raw], calibration: Calibration
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """As `class_table`, for the classes of all sweeps."""
    present = [np.unique(raw.classes) for raw in raws if raw.classes is not None]
    if not present:
        return None, ()
    return class_table(root, np.unique(np.concatenate(present)), calibration.lidar_classes)


def _own_returns(sweeps: Sequence[Sweep], known: Sequence[tuple[Frame, Path]]) -> list[str]:
    """A sentence where the LiDAR seems to see its own car."""
    near = total = 0
    for sweep, (frame, _) in zip(sweeps, known, strict=True):
        if frame.cameras:
            total += len(sweep)
            distance = np.linalg.norm(sweep.points - _middle(frame), axis=1)
            near += int((distance < _OWN_M).sum())
    if near <= _OWN_PART * total:
        return []
    return [
        f"lidar/: {near} of {total} returns lie within {_OWN_M} m of the cameras' middle, likely "
        f"on the recording car, which they smear along the road; give ego_box_m in "
        f"calibration.json to leave them out"
    ]


def _middle(frame: Frame) -> np.ndarray:
    """The middle of a frame's cameras, float64 [3]."""
    return np.mean([camera.centre.numpy() for camera in frame.cameras.values()], axis=0)


def _top_deg(sweeps: Sequence[Sweep], known: Sequence[tuple[Frame, Path]]) -> float:
    """About the elevation of the highest channel: that of nearly the steepest return, as seen from
    the height of the cameras, for want of the sensor's own."""
    rises = []
    for sweep, (frame, _) in zip(sweeps, known, strict=True):
        if not frame.cameras or not len(sweep):
            continue
        offset = sweep.points - _middle(frame)
        reach = np.hypot(offset[:, 0], offset[:, 1])
        far = reach > _TOP_BEYOND_M
        rises.append(np.degrees(np.arctan2(offset[far, 2], reach[far])))
    joined = np.concatenate(rises) if rises else np.zeros(0)
    top = float(np.quantile(joined, _TOP_QUANTILE)) if len(joined) else 0.0
    return float(np.clip(top, *_TOP_DEG))
