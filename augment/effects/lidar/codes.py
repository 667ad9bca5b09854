"""What a weathered sweep says of each return, and sweeps without what was lost."""

from __future__ import annotations

import numpy as np

from augment.labels import LidarSweep

CODE_COLUMN, INDEX_COLUMN = "weather_code", "source_index"

# weather_code. Where several hold, the first of LOST, PRECIPITATION or SCATTERED, MOVED, ATTENUATED
# is given: what a trainer has to know first.
UNCHANGED = 0  # the row is the source's, to the bit
# The same surface with less intensity; in rain and snowfall its range has the noise of that.
ATTENUATED = 1
SCATTERED = 2  # made by droplets in the air, spray too, or by muddy water: no surface is there
LOST = 3  # nothing came back above the sensor's noise: x, y, z are NaN, the intensity is 0
MOVED = 4  # a surface elsewhere on the beam: that of the snow, or a bed as seen through water
PRECIPITATION = 5  # a drop of rain or a flake: no surface is there


def is_in_air(sweep: LidarSweep) -> np.ndarray:
    """Mask of the returns that drops, flakes, fog, spray or muddy water made, bool [N]: no surface
    is there, so the class of the source's return is not theirs.
    """
    return np.isin(sweep.columns[CODE_COLUMN], (SCATTERED, PRECIPITATION))


def drop_lost(sweep: LidarSweep) -> LidarSweep:
    """The sweep without lost returns: what the sensor would have sent. `source_index` still says
    which return of the source each row was. A sweep without codes is returned as it is.
    """
    codes = sweep.columns.get(CODE_COLUMN)
    if codes is None:
        return sweep
    kept = np.asarray(codes) != LOST
    return LidarSweep({name: np.asarray(column)[kept] for name, column in sweep.columns.items()})
