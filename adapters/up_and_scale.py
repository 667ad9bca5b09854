"""Which way is up in a splat file and how long its unit is, where nothing in it says so.

The ground is the widest flat surface that has everything else on one side, and no parallel one of
its size there: a floor under a ceiling and the facades of a canyon look like each other, and are
refused. Surface is counted in voxels, so that it matters neither how densely splats lie nor how
large they are; distances are parts of the scene's own size, so that the unit does not matter. The
same file gives the same numbers every time.

The unit is the height of cameras above the ground, where they were driven or carried; without
cameras there is only the question whether the scene can be a street in metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from torch import Tensor

from adapters.cameras.ground_estimate import (
    BULK_REACH,
    ground_under,
    in_bulk,
    road_heights,
    solid_points,
)
from adapters.world import nearest_axis
from augment.rng import rng_for
from augment.scene import Gaussians

CAMERAS_ABOVE_GROUND_M = 1.6
_METRIC_HEIGHTS_M = (1.0, 2.6)  # cameras this high are on a car or a head, and the unit is a metre
_HEIGHTS_SPREAD = 0.5  # interquartile range over median, of cameras that were driven or carried
_STEEPEST_LOOK_DEG = 30.0  # drones look down
_WIDE_M, _TALL_M, _SPLAT_M = (10.0, 2000.0), (2.0, 150.0), (0.003, 0.6)  # of a street

_VOXELS, _FINER_STEPS = 5000, 16  # wanted, and how often they may shrink for it
_NEIGHBOURS = 12  # of a voxel, that its surface is fitted to
_FLAT = 0.5  # thickness of that surface over its width, at most
_TRIES = 400
_SAME_WAY = math.cos(math.radians(25.0))  # of surface and plane
_OTHER_WAY = math.cos(math.radians(30.0))  # of planes that would make another up
_MUCH_BELOW = 0.05  # of the surface under a plane: it is not the ground
_COUNTERPART = 1.25  # above 1: of two facades that face each other one has more gaps
_LEAST_SHARE, _LEAST_LEAD = 0.05, 4.0
_SNAP_DEG = 3.0  # a road's slope; a world that is turned at random rarely comes this close
_FEWEST_POINTS = 100


@dataclass(frozen=True, eq=False)
class GroundFound:
    """up: unit [3], in the file's world. share: of the scene's surface, that lies in the ground's
    plane. below: of it, that lies under the plane. above: in the fullest parallel plane over it.
    lead: how many times better than the best plane of another direction it is.
    """

    up: np.ndarray
    share: float
    below: float
    above: float
    lead: float

    @property
    def is_clear(self) -> bool:
        return self.share - self.above >= _LEAST_SHARE and self.lead >= _LEAST_LEAD

    @property
    def sentence(self) -> str:
        name = ",".join(f"{value:.4g}" for value in self.up)
        if np.abs(self.up).max() == 1:
            name = nearest_axis(self.up)
        return (
            f"{name}: {self.share:.0%} of the surface lies in one plane, {self.below:.1%} under it "
            f"and {self.above:.0%} in a parallel one above it; that is {min(self.lead, 99):.1f} "
            "times as clear as in any other direction"
        )


def find_ground(gaussians: Gaussians, *, near: np.ndarray | None = None) -> GroundFound | None:
    """The plane that is most like a ground; None where nothing is flat.

    near: a unit vector within 45 degrees of which up must be, such as the cameras' mean.
    """
    points = solid_points(gaussians)
    points = points[in_bulk(points, 3.0)]
    if len(points) < _FEWEST_POINTS:
        return None
    surface = _Surface.of(points - points.mean(axis=0))
    if surface is None:
        return None
    flat = np.flatnonzero(surface.is_flat)
    rng = rng_for(seed=0, scene="", effect="adapters.up_and_scale")
    chosen = rng.permutation(flat)[:_TRIES]
    ups = np.concatenate([surface.normals[chosen], -surface.normals[chosen]])
    places = np.tile(surface.places[chosen], (2, 1))
    if near is not None:
        able = ups @ near > math.cos(math.radians(45.0))
        ups, places = ups[able], places[able]
    if len(ups) == 0:
        return None
    scores = np.array([surface.score(up, at) for up, at in zip(ups, places, strict=True)])
    best = int(scores.argmax())
    others = scores[ups @ ups[best] < _OTHER_WAY]
    rival = max(float(others.max(initial=0.0)), 1e-6)
    up, at = surface.refined(ups[best], places[best])
    return GroundFound(_snapped(up), *surface.judge(up, at), float(scores[best]) / rival)


def scale_from_cameras(points: np.ndarray, poses: np.ndarray) -> tuple[float, str] | None:
    """Metres per unit by the height of level cameras above the ground, and a sentence about it;
    None where they do not stand as on a car or in a hand.

    points: [N, 3], and poses: world_from_camera [C, 4, 4], in a world whose +z is up.
    """
    eyes, looks = poses[:, :3, 3], poses[:, 2, 2]
    if np.median(np.abs(looks)) > math.sin(math.radians(_STEEPEST_LOOK_DEG)):
        return None
    radius = 0.25 * float(np.linalg.norm(np.ptp(eyes[:, :2], axis=0)))
    low, over = ground_under(points, eyes, radius=radius)
    if len(low):  # once more from nearby: a wide circle reaches into ditches and up slopes
        low, over = ground_under(points, eyes, radius=3 * float(np.median(over[:, 2] - low)))
    if len(low) == 0:
        return None
    height = float(np.median(over[:, 2] - low))
    unit = height / CAMERAS_ABOVE_GROUND_M
    heights = over[:, 2] - road_heights(points, np.ones(len(points)), over, low, unit=unit)
    least, height, most = np.nanquantile(heights, [0.25, 0.5, 0.75])
    if not most - least <= _HEIGHTS_SPREAD * height:
        return None
    if _METRIC_HEIGHTS_M[0] <= height <= _METRIC_HEIGHTS_M[1]:
        return 1.0, f"the cameras stand {height:.2f} units above the ground"
    scale = CAMERAS_ABOVE_GROUND_M / height
    return scale, (
        f"the cameras stand {height:.3g} units above the ground, which is taken as "
        f"{CAMERAS_ABOVE_GROUND_M} m, give or take a quarter"
    )


def doubt_about_metres(points: np.ndarray, scales: Tensor) -> str | None:
    """Why these solid points [N, 3] (+z up) and the scales of all Gaussians cannot be of a street
    in metres; None where they may be.
    """
    points = points[in_bulk(points, BULK_REACH)]
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    measures = {
        "wide": (float(np.hypot(*(high - low)[:2])), _WIDE_M),
        "tall": (float(np.quantile(points[:, 2], 0.98) - low[2]), _TALL_M),
        "a splat": (float(scales.amax(1).median()), _SPLAT_M),
    }
    if all(least <= value <= most for value, (least, most) in measures.values()):
        return None
    return "in metres it would be no street: " + ", ".join(
        f"{value:.3g} {what} ({least:g} to {most:g} expected)"
        for what, (value, (least, most)) in measures.items()
    )


@dataclass(frozen=True, eq=False)
class _Surface:
    """A scene's surface as voxels: places [V, 3] and normals [V, 3] of either sign. size: edge."""

    places: np.ndarray
    normals: np.ndarray
    is_flat: np.ndarray
    size: float

    @staticmethod
    def of(points: np.ndarray) -> _Surface | None:
        """None where the points are in too few places to have a surface."""
        size = float(np.linalg.norm(points, axis=1).max()) / 8 + 1e-9
        places = _voxel_means(points, size)
        for _ in range(_FINER_STEPS):
            if len(places) >= min(_VOXELS, len(points) / 4):
                break
            size /= 1.2
            places = _voxel_means(points, size)
        # A surface on the border of two layers of voxels would count twice: it lies amid one of
        # those that are half a voxel further.
        places = _voxel_means(places + size / 2, size) - size / 2
        if len(places) < _NEIGHBOURS:
            return None
        _, near = KDTree(places).query(places, _NEIGHBOURS)
        offsets = places[near] - places[near].mean(axis=1, keepdims=True)
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
        thickness = np.sqrt(np.maximum(spread[:, 0], 0) / np.maximum(spread[:, 1], 1e-30))
        return _Surface(places, axes[:, :, 0], thickness < _FLAT, size)

    def judge(self, up: np.ndarray, at: np.ndarray) -> tuple[float, float, float]:
        """Shares of the surface: in the plane, under it, and in the fullest parallel one above."""
        height = (self.places - at) @ up
        parallel = self.is_flat & (np.abs(self.normals @ up) > _SAME_WAY)
        share = float((parallel & (np.abs(height) < 0.75 * self.size)).mean())
        below = float((height < -1.5 * self.size).mean())
        higher = height[parallel & (height > 2.25 * self.size)]
        floors = np.bincount((higher / (0.75 * self.size)).astype(int), minlength=2)
        return share, below, float((floors[:-1] + floors[1:]).max()) / len(height)

    def score(self, up: np.ndarray, at: np.ndarray) -> float:
        share, below, above = self.judge(up, at)
        return (share - _COUNTERPART * above) * math.exp(-below / _MUCH_BELOW)

    def refined(self, up: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The plane through the surface near it, by least squares, ever closer."""
        for reach in (1.0, 0.7, 0.5, 0.4):
            near = self.is_flat & (np.abs(self.normals @ up) > _SAME_WAY)
            near &= np.abs((self.places - at) @ up) < reach * self.size
            if near.sum() < _NEIGHBOURS:
                break
            at = self.places[near].mean(axis=0)
            offsets = self.places[near] - at
            normal = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]
            up = normal if normal @ up > 0 else -normal
        return up, at


def _voxel_means(points: np.ndarray, size: float) -> np.ndarray:
    """Mean of the points in every voxel that has not far fewer of them than a point's usually has:
    stray ones fill many voxels.
    """
    index = np.floor(points / size).astype(np.int64)
    index -= index.min(axis=0)
    _, y, z = index.max(axis=0) + 1
    _, voxel, count = np.unique(
        (index[:, 0] * y + index[:, 1]) * z + index[:, 2], return_inverse=True, return_counts=True
    )
    sums = np.stack([np.bincount(voxel, points[:, axis]) for axis in range(3)], axis=1)
    return (sums / count[:, None])[count >= 0.05 * np.median(count[voxel])]


def _snapped(up: np.ndarray) -> np.ndarray:
    axis = np.zeros(3)
    index = int(np.abs(up).argmax())
    axis[index] = math.copysign(1.0, up[index])
    return axis if up @ axis > math.cos(math.radians(_SNAP_DEG)) else up
