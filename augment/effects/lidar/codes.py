"""Codes that a weathered sweep gives each return, and sweeps without lost returns."""

from __future__ import annotations

import numpy as np

from augment.scene.labels import LidarSweep

CODE_COLUMN = "weather_code"  # column of the codes below
INDEX_COLUMN = "source_index"  # column of the row in the source's sweep

# Values of weather_code. Where several hold, the first of LOST, PRECIPITATION or SCATTERED, MOVED,
# ATTENUATED is given, since a trainer has to know it first.
UNCHANGED = 0  # the row equals the source's, to the bit
# The same surface with less intensity; in rain and snowfall its range is noisier, too.
ATTENUATED = 1
SCATTERED = 2  # an echo of droplets in the air, spray or muddy water: no surface is there
LOST = 3  # no echo above the sensor's noise: x, y, z are NaN, the intensity is 0
MOVED = 4  # a surface elsewhere on the beam: that of the snow, or the ground under water
PRECIPITATION = 5  # an echo of a raindrop or a flake: no surface is there


def is_in_air(sweep: LidarSweep) -> np.ndarray:
    """Mask of the returns that drops, flakes, fog, spray or muddy water made, bool [N].

    No surface is there, so the class of the source's return is not theirs.
    """
    return np.isin(sweep.columns[CODE_COLUMN], (SCATTERED, PRECIPITATION))


def drop_lost_returns(sweep: LidarSweep) -> LidarSweep:
    """Return the sweep without lost returns: what the sensor would have sent.

    `source_index` still names the source's return of each row. A sweep without codes is returned as
    it is.
    """
    codes = sweep.columns.get(CODE_COLUMN)
    if codes is None:
        return sweep
    is_kept = np.asarray(codes) != LOST
    return LidarSweep({name: np.asarray(column)[is_kept] for name, column in sweep.columns.items()})
