"""Boxes around Gaussians, and whether any of them can touch a camera's image.

A rasteriser draws a Gaussian if its mean lies at `near_m` or beyond and its splat's box touches the
image. With g = MAX_EXTENT_SIGMAS sqrt(1 + w^2), w the largest tangent that the projection's
Jacobian is clamped to, the splat of a Gaussian at depth z whose longest axis is s reaches at most
fx g s / z + 2 px from its mean's place (the 2 px: its blur). So it lies left of the image where

    fx x / z + cx + fx g s / z + 2 < 0,    that is    fx x + (cx + 2) z + fx g s < 0 :

a half-space of the mean, and so are the other sides. A box of means that lies wholly in one of
these, or before the near plane, shows nothing. Rays of an orthographic camera are parallel: z drops
out of the sides, and w is 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from augment.cameras import Camera
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, TAN_FOV_MARGIN
from augment.scene import Gaussians

_BLUR_PX = 3.0  # 1.9 of it is the blur, the rest float32's rounding of pixels
_ROUNDING = 1e-5  # of all terms of a sum: a hundred times float32's


@dataclass(frozen=True, eq=False)
class Bounds:
    """B boxes along the axes of a part's frame that hold means. centres, halves [B, 3]: metres.

    longest [B]: the largest standard deviation of a Gaussian in the box, metres.
    """

    centres: Float[np.ndarray, "B 3"]
    halves: Float[np.ndarray, "B 3"]
    longest: Float[np.ndarray, "B"]

    def __len__(self) -> int:
        return len(self.longest)

    def grown(self, metres: Float[np.ndarray, "B"]) -> Bounds:
        """The boxes with room on every side."""
        return Bounds(self.centres, self.halves + metres[:, None], self.longest)

    @staticmethod
    def join(bounds: list[Bounds]) -> Bounds:
        """All boxes of a list, in their order."""
        return Bounds(
            np.concatenate([np.zeros((0, 3)), *(b.centres for b in bounds)]),
            np.concatenate([np.zeros((0, 3)), *(b.halves for b in bounds)]),
            np.concatenate([np.zeros(0), *(b.longest for b in bounds)]),
        )


def bound(gaussians: Gaussians) -> Bounds:
    """One box around all that are opaque enough to be drawn; none where there are none."""
    shown = gaussians.opacities.detach().numpy() >= ALPHA_MIN
    means, longest = _numbers(gaussians, shown)
    return _boxes(means, longest, np.zeros(len(means), np.int64))


def bound_chunks(gaussians: Gaussians, chosen: np.ndarray, side_m: float) -> Bounds:
    """Boxes around the chosen (bool [N]), one for each square of x and y that has any."""
    means, longest = _numbers(gaussians, chosen)
    return bound_points(means, longest, side_m)


def bound_points(
    means: Float[np.ndarray, "N 3"], longest: Float[np.ndarray, "N"], side_m: float
) -> Bounds:
    """As bound_chunks, of means and the largest standard deviation of each."""
    squares = np.floor(means[:, :2] / side_m).astype(np.int64)
    return _boxes(means, longest, np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1))


def _numbers(gaussians: Gaussians, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    means = gaussians.means.detach().numpy()[chosen].astype(np.float64)
    return means, gaussians.scales.detach().numpy()[chosen].max(1, initial=0).astype(np.float64)


def _boxes(means: np.ndarray, longest: np.ndarray, numbers: np.ndarray) -> Bounds:
    """Of the points that share a number, counted from 0 without gaps."""
    if len(means) == 0:
        return Bounds.join([])
    order = np.argsort(numbers, kind="stable")
    starts = np.flatnonzero(np.diff(numbers[order], prepend=-1))
    lows = np.minimum.reduceat(means[order], starts, axis=0)
    highs = np.maximum.reduceat(means[order], starts, axis=0)
    widest = np.maximum.reduceat(longest[order], starts)
    return Bounds((lows + highs) / 2, (highs - lows) / 2, widest)


def may_show(
    bounds: Bounds,
    world_from_part: np.ndarray | None,
    camera: Camera,
    near_m: float,
) -> np.ndarray:
    """Whether a Gaussian of each box can touch the image, bool [B]; True where it is not known.

    world_from_part: float64, [4, 4] of all boxes or [B, 4, 4]; None for the identity.
    """
    camera_from_part = camera.camera_from_world.numpy()
    if world_from_part is not None:
        camera_from_part = camera_from_part @ world_from_part
    sides, offsets, reach = _half_spaces(camera, near_m)
    rotation, shift = camera_from_part[..., :3, :3], camera_from_part[..., :3, 3]
    axes = (sides @ rotation).reshape(-1, 5, 3)  # along the part's own axes, [1 or B, 5, 3]
    centres = (axes * bounds.centres[:, None]).sum(-1)
    extents = (np.abs(axes) * bounds.halves[:, None]).sum(-1)
    placed = shift @ sides.T + offsets
    most = centres + placed + extents + bounds.longest[:, None] * reach
    slack = _ROUNDING * (np.abs(centres) + np.abs(placed) + extents)
    return ~(most + slack < 0).any(-1)  # not `>=`: of NaN nothing is known


def _half_spaces(camera: Camera, near_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the camera's axes: sides [5, 3], offsets [5] and reach [5]. A Gaussian at p whose longest
    axis is s is not drawn where sides . p + offsets + reach s < 0 in any row.
    """
    focal = np.array([camera.fx, camera.fy])
    centre = np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height], np.float64)
    before, beyond = centre + _BLUR_PX, size - centre + _BLUR_PX  # px from the centre to the sides
    sides, offsets = np.zeros((5, 3)), np.zeros(5)
    sides[0, 2], offsets[0] = 1.0, -near_m
    sides[[1, 2], [0, 1]], sides[[3, 4], [0, 1]] = focal, -focal
    widest = np.zeros(2)
    if camera.is_orthographic:
        offsets[1:] = *before, *beyond
    else:
        sides[1:, 2] = *before, *beyond
        margin = TAN_FOV_MARGIN * 0.5 * size
        widest = (np.maximum(np.abs(centre), np.abs(size - centre)) + margin) / focal
    reach = MAX_EXTENT_SIGMAS * focal * np.sqrt(1 + widest**2)
    return sides, offsets, np.array([0.0, *reach, *reach])
