"""Height of the road along a driven path, from points that lie on it.

The path is cut into stretches of STRETCH_M; each has the median height of the points in a corridor
around it, so that neither a stray point nor the pavement decides. A road slopes: it has no one
height, but a lowest and a median one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

GroundSource = Literal["lidar labels", "road splats", "ransac", "ego path", "stated"]

STRETCH_M = 3.0
LEVEL_M = 6.0  # a road this far above or below the car is another one
# Half widths of the corridor across and along the path. A LiDAR sees no road right below itself,
# so that beside a short path the road must be sought further away.
_REACHES_M = ((2.5, STRETCH_M / 2), (4.0, 4.0), (8.0, 8.0), (16.0, 16.0), (math.inf, math.inf))
_MIN_IN_STRETCH = 20
_MIN_IN_ALL = 200  # some returns near a sensor are mislabelled: a few are not enough
_MAX_POINTS = 400_000
_STANDING_M = 0.5  # positions nearer to each other are noise of a car that stands
_STEEPEST = 0.15  # rise over run; no road is steeper over a stretch


@dataclass(frozen=True)
class Ground:
    """Where the road under the ego path is, scene world, and how that is known.

    lowest_z_m, median_z_m: over the stretches of the path. residual_m: median distance of the
    points from the planes of their stretches; None where no points were used. points: how many
    were used. tilt_deg: angle between the road's normal, over all the points, and +z: a road that
    slopes, or a gravity that is off; None where unknown.
    """

    lowest_z_m: float
    median_z_m: float
    source: GroundSource
    residual_m: float | None = None
    points: int = 0
    tilt_deg: float | None = None

    def __post_init__(self) -> None:
        if not self.lowest_z_m <= self.median_z_m:  # also catches NaN
            raise ValueError(
                f"a ground's lowest height must not be above its median one; got lowest_z_m "
                f"{self.lowest_z_m}, median_z_m {self.median_z_m}"
            )


@dataclass(frozen=True, eq=False)
class LocatedPoints:
    """For each of N points: its stretch, and metres to its middle along and across the path."""

    stretch: np.ndarray
    along_m: np.ndarray
    across_m: np.ndarray

    def within(self, across_m: float, along_m: float) -> np.ndarray:
        """Which points are, bool [N]."""
        return (self.across_m <= across_m) & (self.along_m <= along_m)


@dataclass(frozen=True, eq=False)
class Stretches:
    """The stretches of a path: their middles float64 [S, 3] and unit directions [S, 2]."""

    middles: np.ndarray
    headings: np.ndarray

    def __len__(self) -> int:
        return len(self.middles)

    @staticmethod
    def of(positions: np.ndarray) -> Stretches:
        """Points every STRETCH_M along positions float64 [P, 3], P >= 1, in order of time."""
        kept = [positions[0]]
        for position in positions[1:]:
            if np.hypot(*(position - kept[-1])[:2]) >= _STANDING_M:
                kept.append(position)
        if len(kept) == 1:
            return Stretches(np.array(kept, np.float64), np.array([[1.0, 0.0]]))
        corners = np.array(kept, np.float64)
        steps = np.hypot(*np.diff(corners[:, :2], axis=0).T)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        places = np.linspace(0, along[-1], 1 + max(1, round(along[-1] / STRETCH_M)))
        middles = np.stack([np.interp(places, along, c) for c in corners.T], axis=1)
        segment = np.clip(np.searchsorted(along, places, side="right") - 1, 0, len(steps) - 1)
        headings = np.diff(corners[:, :2], axis=0)[segment] / steps[segment, None]
        return Stretches(middles, headings)

    def locate(self, points: np.ndarray) -> LocatedPoints:
        """Which stretch each of the points [N, 3] is nearest to, seen from above, and where."""
        nearest = np.asarray(KDTree(self.middles[:, :2]).query(points[:, :2])[1])
        offset = points[:, :2] - self.middles[nearest, :2]
        heading = self.headings[nearest]
        along = (offset * heading).sum(1)
        across = offset[:, 1] * heading[:, 0] - offset[:, 0] * heading[:, 1]
        return LocatedPoints(nearest, np.abs(along), np.abs(across))


def measure_ground(
    points: np.ndarray, positions: np.ndarray, source: GroundSource, *, level_m: float = LEVEL_M
) -> Ground | None:
    """The road along positions float64 [P, 3] from points [N, 3] of its surface; both in the
    scene's world. None where there are too few.

    level_m: points further above or below the path are another road's.
    """
    stretches = Stretches.of(positions)
    points = np.asarray(points[:: 1 + len(points) // _MAX_POINTS], np.float64)
    if len(points) < _MIN_IN_ALL:
        return None
    located = stretches.locate(points)
    level = np.abs(points[:, 2] - stretches.middles[located.stretch, 2]) <= level_m
    groups = _widest_known(located, level, len(stretches))
    if not groups:
        return None
    heights = np.array([np.median(points[index, 2]) for index in groups.values()])
    places = stretches.middles[list(groups), :2]
    used = points[np.concatenate(list(groups.values()))]
    residuals = [_plane(points[index])[1] for index in groups.values()]
    median_z = float(np.median(heights))
    return Ground(
        lowest_z_m=min(_lowest(heights, places), median_z),
        median_z_m=median_z,
        source=source,
        residual_m=float(np.median(np.abs(np.concatenate(residuals)))),
        points=len(used),
        tilt_deg=_tilt_deg(used),
    )


def _widest_known(located: LocatedPoints, level: np.ndarray, count: int) -> dict[int, np.ndarray]:
    """Indices of the points of each stretch that has enough of them; none where all have too few.

    The narrowest corridor in which half of the stretches are known, or else the one that knows
    most of them.
    """
    best: dict[int, np.ndarray] = {}
    for across_m, along_m in _REACHES_M:
        groups = _by_stretch(located, level & located.within(across_m, along_m))
        if len(groups) > len(best) and sum(map(len, groups.values())) >= _MIN_IN_ALL:
            best = groups
        if 2 * len(best) >= count:
            break
    return best


def _by_stretch(located: LocatedPoints, chosen: np.ndarray) -> dict[int, np.ndarray]:
    index = np.flatnonzero(chosen)
    index = index[np.argsort(located.stretch[index], kind="stable")]
    numbers, first = np.unique(located.stretch[index], return_index=True)
    parts = np.split(index, first[1:])
    return {
        int(number): part
        for number, part in zip(numbers, parts, strict=False)  # no numbers still have one part
        if len(part) >= _MIN_IN_STRETCH
    }


def _lowest(heights: np.ndarray, places: np.ndarray) -> float:
    """The lowest of the heights [S] at places [S, 2] that a neighbour confirms: roads climb only
    so steeply, and a single wrong stretch must not set the level of a flood.
    """
    if len(heights) == 1:
        return float(heights[0])
    allowed = _STEEPEST * np.hypot(*np.diff(places, axis=0).T)
    rise = np.diff(heights)  # from each stretch to the next
    confirmed = np.zeros(len(heights), bool)
    confirmed[:-1] |= rise <= allowed
    confirmed[1:] |= -rise <= allowed
    return float(heights[confirmed].min())


def _plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes [2] of the least-squares plane over x and y, and residuals [N] at right angles."""
    local = points - points.mean(axis=0)
    slopes = np.linalg.lstsq(local[:, :2], local[:, 2], rcond=1e-6)[0]
    residuals = local[:, 2] - local[:, :2] @ slopes
    return slopes, residuals / math.sqrt(1 + float(slopes @ slopes))


def _tilt_deg(points: np.ndarray) -> float:
    """Angle to +z of the normal of one plane through all points, the furthest left out."""
    slopes, residuals = _plane(points)
    for _ in range(2):
        near = np.abs(residuals) <= max(3 * float(np.median(np.abs(residuals))), 0.01)
        points = points[near]
        slopes, residuals = _plane(points)
    return math.degrees(math.atan(float(np.hypot(*slopes))))
