"""Weathered sweeps in the form in which datasets store theirs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from augment.labels import LidarSweep
from augment.lidar_weather.codes import CODE_COLUMN, INDEX_COLUMN, MOVED, SCATTERED


def stored_records(
    records: np.ndarray, columns: Sequence[str], sweep: LidarSweep, world_from_file: np.ndarray
) -> bytes:
    """Records float32 [N, C] of a file with a weathered sweep of them in their place.

    columns: x, y, z, intensity and others, in the file's order. Returns that did not move keep
    their coordinates to the bit; the others are carried back in float64, so that only float32's
    rounding is left: less than 0.01 mm within 100 m of the sensor.
    """
    out = records[sweep.columns[INDEX_COLUMN]]
    moved = np.flatnonzero(np.isin(sweep.columns[CODE_COLUMN], (MOVED, SCATTERED)))
    offsets = sweep.points_m[moved] - world_from_file[:3, 3]
    places = np.linalg.solve(world_from_file[:3, :3], offsets.T)
    for axis, name in enumerate("xyz"):
        out[moved, columns.index(name)] = places[axis]
    out[:, columns.index("intensity")] = sweep.columns["intensity"]
    return out.tobytes()
