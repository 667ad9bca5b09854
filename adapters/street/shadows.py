"""The shadow a mover casts on the ground, which travels with it as a soft dark layer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.street.lighting import SKY_RGB, SUN_RGB
from adapters.street.world import MovingBody

CELL_M = 0.06
MARGIN_M = 2.0
MOST_COVER = 0.5  # never more: what lies below must stay the heaviest thing in its pixels
GROUND_BAND_M = 0.25  # surfaces this near the ground's plane receive the shadow
SHADOW_RGB = np.array([0.03, 0.032, 0.04])


@dataclass(frozen=True, eq=False)
class ContactShadow:
    """Share of SHADOW_RGB mixed into the ground, on a grid in the mover's frame.

    values [X, Y]: cover in [0, MOST_COVER], zero at the rim. origin: x, y of values[0, 0], metres.
    """

    values: np.ndarray
    origin: np.ndarray
    ground_z: float

    def cover(self, points: np.ndarray) -> np.ndarray:
        """Bilinear cover at points [N, 3] of the mover's frame; zero away from the ground."""
        cell = (points[:, :2] - self.origin) / CELL_M
        low = np.floor(cell).astype(np.int64)
        inside = np.all((low >= 0) & (low < np.array(self.values.shape) - 1), axis=1)
        inside &= np.abs(points[:, 2] - self.ground_z) < GROUND_BAND_M
        out = np.zeros(len(points))
        i, j = low[inside].T
        fx, fy = (cell[inside] - low[inside]).T
        v = self.values
        out[inside] = (v[i, j] * (1 - fx) + v[i + 1, j] * fx) * (1 - fy) + (
            v[i, j + 1] * (1 - fx) + v[i + 1, j + 1] * fx
        ) * fy
        return out


def contact_shadow(mover: MovingBody) -> ContactShadow:
    """Sun shadow by ray casting, and sky shadow by the distance to the body's outline."""
    lighting = mover.body.lighting
    half = np.array(mover.size_m[:2]) / 2
    length = mover.size_m[2] / np.tan(np.arcsin(lighting.to_sun[2]))
    reach = half + np.minimum(length, MARGIN_M) + 0.4
    counts = np.ceil(2 * reach / CELL_M).astype(int) + 1
    origin = -(counts - 1) * CELL_M / 2
    x, y = (origin[k] + CELL_M * np.arange(counts[k]) for k in range(2))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    points = np.concatenate([grid, np.full((len(grid), 1), mover.ground_z)], 1)
    directions = lighting.sun_directions()
    shaded = np.zeros(len(points))
    for direction in directions:
        rays = np.broadcast_to(direction, points.shape)
        shaded += mover.body.tree.occluded(points, rays)
    full_sun = lighting.sunlit * lighting.to_sun[2] * SUN_RGB.mean()
    sun = (1 - shaded / len(directions)) * full_sun
    rounding = 0.8 * half.min()
    outside = np.linalg.norm(np.maximum(np.abs(grid) - half + rounding, 0), axis=1) - rounding
    hidden = 0.8 / (1 + np.exp((outside - 0.02) / (0.11 * half.min() / 0.9)))
    sky = (1 - hidden) * SKY_RGB.mean() * 0.75
    lit = full_sun + SKY_RGB.mean() * 0.75
    cover = 1 - ((sun + sky) / lit) ** 0.45  # the display's encoding of that ratio, nearly
    rim = np.min(np.minimum(grid - origin, -origin - grid), axis=1)  # fade out before the grid ends
    cover = np.minimum(cover, MOST_COVER) * np.clip(rim / 0.3, 0, 1)
    return ContactShadow(cover.reshape(counts), origin, mover.ground_z)
