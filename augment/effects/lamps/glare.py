"""Glare: light of bright lamps that lens, glass and sensor scatter over the picture.

The point spread function has a core, which is the picture itself, and two tails in the shape of
Spencer et al. 1995 ("Physically-based glare effects for digital images", photopic eye):

    f1 ~ 1 / (theta + 0.02)^3        f2 ~ 1 / (theta + 0.02)^2        theta in degrees

each normalised to 1 within RADIUS_DEG. Of the eye they have 48 % and 14 %. A clean camera lens
scatters far less: 2 % in f1 and 1 % in f2 (assumed), times the recipe's `glare`. All but the
innermost pixels of the tails is taken from the core, which needs no change: it is saturated.

Only light beyond saturation is scattered, since the rest changes nothing that is seen. A tail is a
sum of Gaussians, one an octave, each as heavy as the tail's ring of that octave. Each is computed
in pixels as coarse as it is wide.
"""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
from jaxtyping import Float32

# Share of the light in the narrow tail f1, for a clean lens.
NARROW_SHARE = 0.02
# Share of the light in the wide tail f2, for a clean lens.
WIDE_SHARE = 0.01
# Angle that both tails have, degrees.
_CORE_DEG = 0.02
# Angle beyond which no light is scattered, degrees.
RADIUS_DEG = 40.0
# Width of the finest Gaussian's pixels, of the picture's.
_FINEST_PX = 2
# Standard deviation of each Gaussian in its own pixels.
_SIGMA = 1.5
# Radius of each Gaussian's window, its own pixels: four standard deviations.
_RADIUS = 6
# Light of a Gaussian that is left out: an eighth of a grey level of a black pixel.
MIN_GLARE = 3.8e-5
# Median radius of a Gaussian in two dimensions over its standard deviation.
_MEDIAN_RADIUS = math.sqrt(2 * math.log(2))


def spread_glare(
    excess: Float32[np.ndarray, "h w 3"], side_px: int, focal_px: float, strength: float
) -> Float32[np.ndarray, "h w 3"]:
    """Return the light that tails of the point spread function add, at half the resolution.

    Args:
        excess: light beyond saturation at half the resolution.
        side_px: longer side of the picture, pixels.
        focal_px: focal length, pixels of the picture.
        strength: the tails' share of the light, over that of a clean lens.
    """
    levels = tail_levels(focal_px, side_px)
    coarsest = 1 << (len(levels) - 1)
    padding = [-(-size // coarsest) * coarsest - size for size in excess.shape[:2]]
    grids = [np.pad(excess, ((0, padding[0]), (0, padding[1]), (0, 0)))]
    for _ in levels[1:]:
        size = (grids[-1].shape[1] // 2, grids[-1].shape[0] // 2)
        grids.append(cv2.resize(grids[-1], size, interpolation=cv2.INTER_AREA))
    total = np.zeros_like(grids[-1])
    for weight, grid in zip(reversed(levels), reversed(grids), strict=True):
        if total.shape != grid.shape:
            size = (grid.shape[1], grid.shape[0])
            total = cv2.resize(total, size, interpolation=cv2.INTER_LINEAR)
        _add_blurred(total, grid, np.float32(weight * strength))
    return np.ascontiguousarray(total[: excess.shape[0], : excess.shape[1]])


def _add_blurred(
    total: Float32[np.ndarray, "h w 3"], grid: Float32[np.ndarray, "h w 3"], weight: np.float32
) -> None:
    """Add a grid's light under a Gaussian to `total`, in place, where it can be seen.

    Args:
        total: the sum.
        grid: light of the grid's pixels.
        weight: factor of the light.
    """
    row_light = grid.reshape(len(grid), -1).max(1)
    if row_light.max() * weight < MIN_GLARE:
        return
    rows = np.flatnonzero(row_light)
    columns = np.flatnonzero(grid.max(0).any(1))
    top = max(rows[0] - _RADIUS, 0)
    left = max(columns[0] - _RADIUS, 0)
    box = (slice(top, rows[-1] + _RADIUS + 1), slice(left, columns[-1] + _RADIUS + 1))
    source = np.ascontiguousarray(grid[box])
    size = (2 * _RADIUS + 1, 2 * _RADIUS + 1)
    blurred = cv2.GaussianBlur(source, size, _SIGMA, borderType=cv2.BORDER_CONSTANT)
    blurred *= weight
    total[box] += blurred


def widen_glare(
    glare: Float32[np.ndarray, "h w 3"], width: int, height: int
) -> Float32[np.ndarray, "H W 3"]:
    """Return glare at the resolution of the picture, interpolated.

    Args:
        glare: result of `spread_glare`.
        width: width of the picture, pixels.
        height: height of the picture, pixels.
    """
    size = (_FINEST_PX * glare.shape[1], _FINEST_PX * glare.shape[0])
    return cv2.resize(glare, size, interpolation=cv2.INTER_LINEAR)[:height, :width]


def tail_levels(focal_px: float, side_px: int) -> list[float]:
    """Return the share of a lamp's light in the Gaussian of each octave, finest first.

    What the tails have within the first octave is the core's, and stays where it is. The last
    octave has all that lies beyond it.

    Args:
        focal_px: focal length, pixels.
        side_px: longer side of the picture, pixels.
    """
    count = max(1, math.ceil(math.log2(max(side_px, 8) / (8 * _FINEST_PX))))
    pixel_deg = math.degrees(1 / focal_px)
    middles = [_MEDIAN_RADIUS * _SIGMA * _FINEST_PX * 2**i * pixel_deg for i in range(count)]
    root = math.sqrt(2)
    edges = [middles[0] / root, *(root * middle for middle in middles[:-1]), RADIUS_DEG]
    within = [
        NARROW_SHARE * _share_within(edge, 3) + WIDE_SHARE * _share_within(edge, 2)
        for edge in edges
    ]
    return [max(outer - inner, 0.0) for inner, outer in itertools.pairwise(within)]


def _share_within(angle_deg: float, power: int) -> float:
    """Return the share of a tail 1 / (theta + a)^power within an angle, of RADIUS_DEG."""

    def integral(theta: float) -> float:
        ratio = theta / _CORE_DEG
        if power == 2:
            return math.log1p(ratio) - ratio / (1 + ratio)
        return ratio**2 / (2 * (1 + ratio) ** 2)

    return min(integral(angle_deg) / integral(RADIUS_DEG), 1.0)
