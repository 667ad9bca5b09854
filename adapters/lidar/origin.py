"""Where a drive's world has its origin, so that float32 keeps its digits."""

from __future__ import annotations

import numpy as np

FAR_FROM_ORIGIN_M = 1000.0  # float32 still resolves a tenth of a millimetre there


def drive_origin(positions_m: np.ndarray) -> np.ndarray:
    """What to subtract from the dataset's coordinates, float64 [3].

    Zero for a drive near the dataset's origin; else whole metres near its start. positions_m:
    float64 [F, 3], where the car was.
    """
    far = np.linalg.norm(positions_m, axis=1).max() > FAR_FROM_ORIGIN_M
    return np.round(positions_m[0]) if far else np.zeros(3)
