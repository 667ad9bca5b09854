"""Tables of lamps for kernels that look at eight directions at a time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int32

from augment.lamps.lamp import Lamps
from augment.lamps.lamp_lane_kernels import (
    AXIS,
    CANDELA,
    COLOR,
    EXTINCTION,
    NUM_COLUMNS,
    PEAK,
    PLACE,
    RIGHT,
    SOFTENING,
    UP,
)


def lamp_table(
    lamps: Lamps,
    extinctions_per_m: Float64[np.ndarray, "M"] | float,
    softening_m2: Float64[np.ndarray, "M"],
    frame: Float64[np.ndarray, "3 3"],
    eye: Float64[np.ndarray, "3"],
) -> Float32[np.ndarray, "M 19"]:
    """Return a row for each lamp, as `lamp_lane_kernels` names its columns.

    Args:
        lamps: the lamps.
        extinctions_per_m: extinction of the air about each lamp.
        softening_m2: square of the distance below which a lamp is no point.
        frame: x, y and z of the table's frame in the world, rows.
        eye: origin of the table's frame, world, metres.
    """
    table = np.empty((len(lamps), NUM_COLUMNS), np.float32)
    table[:, PLACE : PLACE + 3] = (lamps.positions_m - eye) @ frame.T
    table[:, AXIS : AXIS + 3] = lamps.axes @ frame.T
    table[:, RIGHT : RIGHT + 3] = np.cross(lamps.axes, lamps.ups) @ frame.T
    table[:, UP : UP + 3] = lamps.ups @ frame.T
    table[:, CANDELA] = lamps.intensities_cd
    table[:, EXTINCTION] = extinctions_per_m
    table[:, SOFTENING] = softening_m2
    table[:, PEAK] = lamps.peak_intensities_cd
    table[:, COLOR : COLOR + 3] = lamps.colors
    return table


def pattern_starts(lamps: Lamps) -> Int32[np.ndarray, "M"]:
    """Return the index of each lamp's first value in the flat tables of the patterns."""
    return (lamps.patterns * lamps.tables[:1].size).astype(np.int32)
