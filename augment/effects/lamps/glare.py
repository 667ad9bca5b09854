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

from augment.effects.lamps import light_kernels
from augment.render.threads import kernel_threads

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
# Median radius of a Gaussian in two dimensions over its standard deviation.
_MEDIAN_RADIUS = math.sqrt(2 * math.log(2))


def add_glare(
    linear: Float32[np.ndarray, "H W 3"], focal_px: float, strength: float
) -> Float32[np.ndarray, "H W 3"] | None:
    """Return the light that tails of the point spread function add to a picture; None for none.

    Args:
        linear: exposed linear light; 1 saturates the sensor.
        focal_px: focal length, pixels.
        strength: the tails' share of the light, over that of a clean lens.
    """
    if strength <= 0:
        return None
    height, width, _ = linear.shape
    levels = tail_levels(focal_px, max(height, width))
    coarsest = _FINEST_PX << (len(levels) - 1)
    padded_height = -(-height // coarsest) * coarsest
    padded_width = -(-width // coarsest) * coarsest
    source = np.empty((padded_height // _FINEST_PX, padded_width // _FINEST_PX, 3), np.float32)
    with kernel_threads(len(source)):
        light_kernels.saturated_light(
            np.ascontiguousarray(linear).reshape(height, -1), source.reshape(len(source), -1)
        )
    if not source.any():
        return None
    grids = [source]
    for _ in levels[1:]:
        grids.append(_half(grids[-1]))
    total: np.ndarray | None = None
    for weight, grid in zip(reversed(levels), reversed(grids), strict=True):
        blurred = cv2.GaussianBlur(grid, (0, 0), _SIGMA, borderType=cv2.BORDER_CONSTANT)
        blurred *= np.float32(weight * strength)
        if total is not None:
            blurred += cv2.resize(
                total, (grid.shape[1], grid.shape[0]), interpolation=cv2.INTER_LINEAR
            )
        total = blurred
    assert total is not None
    size = (padded_width, padded_height)
    full = cv2.resize(total, size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(full[:height, :width])


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


def _half(image: np.ndarray) -> np.ndarray:
    """Return the image at half the resolution, the mean of four pixels."""
    size = (image.shape[1] // 2, image.shape[0] // 2)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
