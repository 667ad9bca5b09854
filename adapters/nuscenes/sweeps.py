"""nuScenes' LiDAR files: returns in the global world, and sweeps of usable ones for a scene.

A file holds records of five float32: x, y, z (metres, sensor's axes), intensity (0 to 255), ring.
The published files are taken as they are described: compensated for the car's motion during the
turn of 50 ms, so that one pose, that of the file's own time, carries all of its returns. When each
was measured is not stored; its bearing tells (see turning.py).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from adapters.lidar.split import Sweep
from adapters.nuscenes.classes import EGO_CLASS, NO_SURFACE, class_table
from adapters.nuscenes.frames import FrameFiles
from adapters.nuscenes.tables import SceneTables, SensorFile
from adapters.plain_files import inside
from augment.semantics import SemanticClass
from recipes.files import open_file

RECORD_BYTES = 20
# The recording car with its sensors in its own frame (x forward, y left, z up, origin on the ground
# below the rear axle). Measured on a published sweep: its returns on the car, a quarter of all, lie
# in x -0.2..2.8, y -0.7..0.7, z 0.8..1.9; the car, 4.1 m by 1.8 m, reaches from -0.7 to 3.5.
EGO_LOW_M = np.array([-0.8, -1.0, -0.5])
EGO_HIGH_M = np.array([3.6, 1.0, 2.3])


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
    return Returns(
        points_m=points,
        timestamps_ns=sweep.timestamp_ns - before,
        intensity=records[:, 3].copy(),
        ring=records[:, 4].copy(),
        classes=classes,
        problem=problem,
    )


def read_sweeps(
    tables: SceneTables,
    frames: Sequence[FrameFiles],
    world_origin_m: np.ndarray,
    *,
    held_out: Collection[int] = frozenset(),
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """The usable returns of every frame that has a file and is not held out, in the scene's world,
    and what was missing, one sentence each.

    Left out: returns of the recording car itself, of no surface (lidarseg's noise), not finite.
    """
    sweeps, problems, missing = [], [], []
    used = [frame for frame in frames if frame.index not in held_out]
    table = class_table(tables.class_names)
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
    keep &= ~((ego > EGO_LOW_M) & (ego < EGO_HIGH_M)).all(axis=1)
    semantic = np.full(len(returns), SemanticClass.UNKNOWN, np.int16)
    if returns.classes is not None:
        semantic = table[returns.classes]
        keep &= (semantic != NO_SURFACE) & (returns.classes != EGO_CLASS)
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
