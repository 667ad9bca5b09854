"""Velodyne sweeps: float32 x y z reflectance, x forward, y left, z up, metres, as they are stored.

A turn takes 0.1 s, and what a sweep's points are displaced by while the car moves in it stays.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adapters.kitti.layout import file_in
from adapters.lidar.split import Sweep
from augment.errors import AdapterError
from augment.labels import LidarSweep
from augment.semantics import SemanticClass

LIDAR_TOP_DEG = 2.0  # the HDL-64E's uppermost channel
# The recording car around its Velodyne: in measured sweeps all returns within 2.6 m of it that no
# neighbour made.
_EGO_LOW_M, _EGO_HIGH_M = np.array([-2.0, -1.35, -1.5]), np.array([2.6, 1.35, 0.5])
_RETURN_BYTES = 16
_MOST_BYTES = 512 * 2**20  # a turn of the sensor is 2 MB


def read_returns(root: Path, name: str) -> np.ndarray:
    """A sweep's returns, float32 [N, 4], in the Velodyne's frame.

    Raises:
        AdapterError: the file is no sequence of returns, has none, or cannot be read.
    """
    path = file_in(root, name)
    try:
        size = path.stat().st_size
        if size == 0 or size % _RETURN_BYTES or size > _MOST_BYTES:
            raise AdapterError(
                f"{path} must be returns of 16 bytes (x y z reflectance, float32); it has {size} "
                f"bytes. Copy it again"
            )
        return np.fromfile(path, "<f4").reshape(-1, 4)
    except OSError as error:
        raise AdapterError(f"{path} cannot be read ({error.strerror or error})") from None


def usable_sweep(returns: np.ndarray, world_from_velodyne: np.ndarray, timestamp_ns: int) -> Sweep:
    """Returns in the scene's world, without those of the recording car and those not finite."""
    points = returns[:, :3].astype(np.float64)
    keep = np.isfinite(points).all(axis=1)
    keep &= ~((points > _EGO_LOW_M) & (points < _EGO_HIGH_M)).all(axis=1)
    world = _moved(points[keep], world_from_velodyne).astype(np.float32)
    return Sweep(
        world,
        np.full(len(world), timestamp_ns, np.int64),
        np.full(len(world), SemanticClass.UNKNOWN, np.int16),
    )


def labelled_sweep(
    returns: np.ndarray, world_from_velodyne: np.ndarray, timestamp_ns: int
) -> LidarSweep:
    """All returns in the dataset's world, in the file's order: x y z (float64 metres), intensity
    (the file's float32 reflectance), timestamp_ns (the frame's, for all: the file has none)."""
    world = _moved(returns[:, :3].astype(np.float64), world_from_velodyne)
    columns = {axis: np.ascontiguousarray(world[:, i]) for i, axis in enumerate("xyz")}
    columns["intensity"] = returns[:, 3].copy()
    columns["timestamp_ns"] = np.full(len(world), timestamp_ns, np.int64)
    return LidarSweep(columns)


def _moved(points: np.ndarray, transform: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", over="ignore"):  # of returns that are not finite
        return points @ transform[:3, :3].T + transform[:3, 3]
