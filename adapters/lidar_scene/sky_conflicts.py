"""Points at which recorded images see sky, or a surface behind: nothing stands there.

Wires, birds and noise return single points. As splats they are bars and dashes that float over the
roofs, as wide as a voxel. Points of a guessed depth may lie before what other images show. The
caller is `adapters.lidar_scene.beyond_beams`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from adapters.lidar_scene.solid_views import SolidView, project_into
from augment.scene.scene import Gaussians

_BEHIND_RATIO = 1.1  # ratio of depths from which a surface is clearly behind a point
_BEHIND_M = 0.5  # the same as a difference, metres
_ONE_COLOR = 12.0  # distance in CIELAB up to which two colours may be of one surface
_NO_SUPPORT = 0.5  # doubt about a point whose colour no other image shows
_MIN_VIEWS = 2  # fewest images that speak for or against a point


class Agreement(NamedTuple):
    """Agreement of images with M points."""

    conflicts: np.ndarray
    """Part of a point's images that show nothing there, float64 [M]."""
    has_support: np.ndarray
    """True if an image shows the point's colour there, or if hardly any sees it, bool [M]."""

    def doubt(self) -> np.ndarray:
        """Return how unlikely each point is, float64 [M]: 0 if no image speaks against it."""
        return self.conflicts + _NO_SUPPORT * ~self.has_support


def measure_agreement(points: np.ndarray, lab: np.ndarray, views: Sequence[SolidView]) -> Agreement:
    """Return how well images agree with points.

    An image shows nothing at a point where it shows sky, or a known surface clearly behind it in
    another colour.

    Args:
        points: float64 [M, 3], world.
        lab: float32 [M, 3], colours of the points in CIELAB.
        views: recorded images.
    """
    num_views = np.zeros(len(points))
    num_conflicts = np.zeros(len(points))
    num_supports = np.zeros(len(points))
    for view in views:
        index, rows, columns, depth_m = project_into(view.camera, points)
        difference = np.linalg.norm(view.lab[rows, columns] - lab[index], axis=1)
        has_color = difference < _ONE_COLOR
        conflicts = view.sure_sky[rows, columns]
        if view.known_m is not None:
            known_m = view.known_m[rows, columns]
            is_before = np.isfinite(known_m) & (known_m > _BEHIND_RATIO * depth_m + _BEHIND_M)
            conflicts |= is_before & ~has_color
        num_views[index] += 1
        num_conflicts[index] += conflicts
        num_supports[index] += has_color & ~conflicts
    return Agreement(
        num_conflicts / np.maximum(num_views, 1), (num_supports > 0) | (num_views < _MIN_VIEWS)
    )


def without_sky_splats(
    background: Gaussians,
    views: Sequence[SolidView],
    *,
    min_views: int = _MIN_VIEWS,
    max_conflicts: float,
) -> Gaussians:
    """Return the background without splats that images see as sky.

    Args:
        background: splats of what stands still.
        views: recorded images.
        min_views: fewest images that show sky at a splat that is left out.
        max_conflicts: part of the images of a splat in which it may cover sky.
    """
    if not views:
        return background
    lowest_m = min(float(view.camera.centre[2]) for view in views)
    high = np.flatnonzero(background.means[:, 2].numpy() > lowest_m)
    points = background.means[torch.from_numpy(high)].numpy().astype(np.float64)
    num_views = np.zeros(len(points))
    num_sky = np.zeros(len(points))
    for view in views:
        index, rows, columns, _ = project_into(view.camera, points)
        num_views[index] += 1
        num_sky[index] += view.sure_sky[rows, columns]
    is_stray = (num_sky >= min_views) & (num_sky > max_conflicts * num_views)
    keep = np.ones(len(background), np.bool_)
    keep[high[is_stray]] = False
    return background.select(torch.from_numpy(np.flatnonzero(keep)))
