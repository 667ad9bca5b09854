"""Coloured LiDAR surfels as Gaussians: the scene before any optimisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from adapters.lidar.split import is_flat
from adapters.lidar.surfels import Surfels
from augment.geometry import quat_from_rotmat
from augment.render.sh import SH_C0
from augment.scene import Gaussians

_GROUND_SIGMA_PER_SPACING = 0.6  # wider than elsewhere: the ground must not leak
_THICKNESS = 0.15  # standard deviation along the normal over the smaller tangent one
_MIN_THICKNESS_M = 0.005


@dataclass(frozen=True)
class SplatShape:
    """How a surfel becomes a Gaussian.

    sigma_per_spacing: standard deviation along a tangent axis over the spacing there; 0.4 leaves
    a lattice visible, 0.6 blurs. opacity: of every splat; high, so that a surface hides
    what lies behind it.
    """

    sigma_per_spacing: float = 0.5
    opacity: float = 0.95


def gaussians_from_surfels(
    surfels: Surfels,
    colours: np.ndarray,
    semantic: np.ndarray | None = None,
    shape: SplatShape = SplatShape(),
) -> Gaussians:
    """Degree-0 Gaussians flattened along the surfels' normals.

    colours: float32 [N, 3] in [0, 1]. semantic: int16 [N] or None.
    """
    second = np.cross(surfels.normals, surfels.major)
    axes = np.stack([surfels.major, second, surfels.normals], axis=2)  # columns
    sigma = np.full(len(surfels), shape.sigma_per_spacing, np.float32)
    if semantic is not None:
        sigma[is_flat(semantic)] = _GROUND_SIGMA_PER_SPACING
    tangent = surfels.spacing * sigma[:, None]
    thin = np.maximum(tangent.min(axis=1) * _THICKNESS, _MIN_THICKNESS_M)
    scales = np.concatenate([tangent, thin[:, None]], axis=1).astype(np.float32)
    return Gaussians(
        means=torch.from_numpy(np.ascontiguousarray(surfels.centres, np.float32)),
        quats=quat_from_rotmat(torch.from_numpy(axes.astype(np.float64))).float(),
        scales=torch.from_numpy(scales),
        opacities=torch.full((len(surfels),), shape.opacity),
        sh=((torch.from_numpy(colours).float() - 0.5) / SH_C0)[:, None, :],
        semantic=None if semantic is None else torch.from_numpy(semantic.astype(np.int16)),
    )


def borrow_colours(
    points: np.ndarray, colours: np.ndarray, seen: np.ndarray, reach_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colours for unseen points from the nearest seen one within reach, and who has a colour now.

    points: float32 [N, 3]. colours: float32 [N, 3]. seen: bool [N]. reach_m: float32 [N].
    """
    if seen.all() or not seen.any():
        return colours, seen
    unseen = np.flatnonzero(~seen)
    distance, nearest = cKDTree(points[seen]).query(points[unseen], workers=-1)
    near = distance <= reach_m[unseen]
    colours, seen = colours.copy(), seen.copy()
    colours[unseen[near]] = colours[np.flatnonzero(seen)[nearest[near]]]
    seen[unseen[near]] = True
    return colours, seen
