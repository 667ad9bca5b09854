"""How well two views of one scene agree: the error of one warped into the other.

Protocol. Every pixel of view A that the scene fills (alpha >= LEAST_ALPHA) is a point of the world,
by A's depth along the ray through the pixel's centre. The point is projected into view B. The
pixel counts if all four pixels of B around that place are filled and have the point's depth within
a tolerance: where they have not, something else stands before it, or the place lies on an edge,
where depths are mixtures. B's colour there is bilinear. The error is the root of the mean square
of the differences of display-encoded colours over all pixels that count and all three channels.

The world has to stand still between the two: render both at one time stamp, or say where A's points
have gone until B (`augment.metrics.actors` carries those of actors along). The sky is not part of
it. Warping is no exact inverse of rendering (bilinear colours, depths of blended surfaces, colours
that truly depend on the direction), so the error of a perfect scene is small and not 0.

A linear map of colours scales the error with the contrast, consistent or not, which is why the
error relative to the picture's own spread stands beside it. (Comparable figures of stylised scenes
are usually given as short-range and long-range consistency of warped views: Lai et al. 2018.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from augment.cameras import Camera

LEAST_ALPHA = 0.95
RELATIVE_TOLERANCE, TOLERANCE_M = 0.01, 0.05  # of depth; the sum of both is allowed
_NEIGHBOURS = ((0, 0), (0, 1), (1, 0), (1, 1))


@dataclass(frozen=True, eq=False)
class DepthView:
    """What a pinhole camera saw. picture: floats [H, W, 3], display-encoded, in [0, 1]. depth_m:
    z along the optical axis [H, W]. alpha [H, W]: in [0, 1]; depth counts where it is high.
    """

    camera: Camera
    picture: np.ndarray
    depth_m: np.ndarray
    alpha: np.ndarray

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        for name, expected in (("picture", (*shape, 3)), ("depth_m", shape), ("alpha", shape)):
            value = getattr(self, name)
            if value.shape != expected or not np.issubdtype(value.dtype, np.floating):
                raise ValueError(
                    f"{name} must be floats {list(expected)}, as camera {self.camera.name!r}; "
                    f"got {value.dtype} {list(value.shape)}"
                )


@dataclass(frozen=True)
class Consistency:
    """rmse: over the pixels that count, NaN where there are none. spread: standard deviation of
    A's colours over the same pixels, about each channel's mean. share: of A's pixels that count.
    """

    rmse: float
    spread: float
    share: float

    @property
    def relative(self) -> float:
        """rmse over spread; NaN where the picture has one colour only."""
        return self.rmse / self.spread if self.spread > 0 else math.nan


@dataclass(frozen=True, eq=False)
class Warp:
    """Where pixels of view A lie in view B. counts: bool [H, W] of A. columns, rows: float64 [K],
    the places in B of the K pixels that count, in A's order, from the centre of B's first pixel.
    """

    counts: np.ndarray
    columns: np.ndarray
    rows: np.ndarray

    def sample(self, image: np.ndarray) -> np.ndarray:
        """An image of B's [Hb, Wb, C] as A would see it, float64 [H, W, C]: bilinear, and 0 where A
        does not count.
        """
        c0, r0 = np.floor(self.columns).astype(np.int64), np.floor(self.rows).astype(np.int64)
        fc, fr = (self.columns - c0)[:, None], (self.rows - r0)[:, None]
        values = np.zeros((len(c0), image.shape[2]))
        for dr, dc in _NEIGHBOURS:
            weight = (fr if dr else 1 - fr) * (fc if dc else 1 - fc)
            values += weight * image[r0 + dr, c0 + dc]
        warped = np.zeros((*self.counts.shape, image.shape[2]))
        warped[self.counts] = values
        return warped


def warped_consistency(a: DepthView, b: DepthView) -> Consistency:
    """The error of view B warped into view A, by the module's protocol."""
    return consistency_of(a, *warp_view(a, b))


def consistency_of(a: DepthView, warped: np.ndarray, counts: np.ndarray) -> Consistency:
    """The error of a warped picture [H, W, 3] against A's own over some pixels, bool [H, W]."""
    share = float(counts.mean())
    if not counts.any():
        return Consistency(math.nan, math.nan, share)
    own = a.picture[counts].astype(np.float64)
    rmse = math.sqrt(float(((warped[counts] - own) ** 2).mean()))
    spread = math.sqrt(float(own.var(axis=0).mean()))
    return Consistency(rmse, spread, share)


def warp_view(a: DepthView, b: DepthView) -> tuple[np.ndarray, np.ndarray]:
    """B's picture as A would see it, float64 [H, W, 3], and where it counts, bool [H, W]; 0 where
    it does not.

    Raises:
        ValueError: a camera is orthographic.
    """
    warp = find_warp(a, b)
    return warp.sample(b.picture), warp.counts


def find_warp(a: DepthView, b: DepthView, points_m: np.ndarray | None = None) -> Warp:
    """Which pixels of A count, and where they lie in B.

    points_m: float64 [H, W, 3], where A's surfaces are in the world when B is taken, NaN where that
    is not known (such pixels do not count); by default where they are when A is taken.

    Raises:
        ValueError: a camera is orthographic.
    """
    points = world_points(a) if points_m is None else points_m
    column, row, depth_m = _places(points, b.camera)
    filled = (a.alpha >= LEAST_ALPHA) & np.isfinite(a.depth_m) & (a.depth_m > 0)
    inside = filled & (depth_m > 0)  # false for NaN
    # All four neighbours are in the picture.
    inside &= (column >= 0) & (column < b.camera.width - 1)
    inside &= (row >= 0) & (row < b.camera.height - 1)
    c, r, z = column[inside], row[inside], depth_m[inside]
    c0, r0 = np.floor(c).astype(np.int64), np.floor(r).astype(np.int64)
    agrees = np.ones(len(z), bool)
    tolerance = RELATIVE_TOLERANCE * z + TOLERANCE_M
    for dr, dc in _NEIGHBOURS:
        at = r0 + dr, c0 + dc
        agrees &= b.alpha[at] >= LEAST_ALPHA
        agrees &= np.abs(b.depth_m[at] - z) <= tolerance
    counts = np.zeros(a.depth_m.shape, bool)
    counts[inside] = agrees
    return Warp(counts, c[agrees], r[agrees])


def world_points(view: DepthView) -> np.ndarray:
    """The surface that each pixel shows, float64 [H, W, 3], world; the camera's centre where depth
    is not finite.

    Raises:
        ValueError: the camera is orthographic.
    """
    rays = view.camera.ray_directions(torch.float64).numpy()
    depth = np.where(np.isfinite(view.depth_m), view.depth_m, 0.0)[..., None]
    return view.camera.centre.numpy() + depth * rays


def _places(world: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where points [H, W, 3] lie in a camera's picture: column and row counted from the first
    pixel's centre, and depth, metres; float64 [H, W] each.
    """
    pose = camera.camera_from_world.numpy()
    x, y, z = np.moveaxis(world @ pose[:3, :3].T + pose[:3, 3], -1, 0)
    safe = np.where(z > 0, z, 1.0)
    return camera.fx * x / safe + camera.cx - 0.5, camera.fy * y / safe + camera.cy - 0.5, z
