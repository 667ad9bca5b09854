"""The sky that a fit starts from, as a cube map, and what of it is sky at all."""

from __future__ import annotations

import numpy as np
import torch

from augment.sky import CubemapSky, Sky, directions_of_cubemap

_SIZE = 512  # texels along a cube edge where the starting sky is no cube map
# Sines of elevations: what lies lower is no sky, also where the road falls; the horizon's colour.
_BELOW, _HAZE = -0.05, 0.15


def starting_sky(sky: Sky) -> np.ndarray:
    """float32 [6, R, R, 3]: a copy of a cube map, or any other sky sampled into one."""
    if isinstance(sky, CubemapSky):
        return sky.faces.float().numpy().copy()
    directions = directions_of_cubemap(_SIZE).float()
    return np.ascontiguousarray(sky.sample(directions).float().numpy())


def paint_below_horizon(faces: np.ndarray) -> np.ndarray:
    """Which texels are sky, bool [6 R R]; the others, below the horizon, get its mean colour.

    They are not learnt: a hole in the road must look wrong, not like road infinitely far away,
    which weather would uncover.
    """
    flat = faces.reshape(-1, 3)
    z = directions_of_cubemap(faces.shape[1]).reshape(-1, 3)
    z = torch.nn.functional.normalize(z, dim=1)[:, 2].numpy()
    horizon = (z >= 0) & (z < _HAZE)
    flat[z < _BELOW] = flat[horizon if horizon.any() else z >= 0].mean(0, dtype=np.float64)
    return z >= _BELOW
