"""Heads of street lamps at the tops of a scene's poles.

In: Gaussians of the class pole. Out: for each mast the place of its head, under the arm's end.
Masts of signs are too low to count. Utility poles and masts of signals have the same class, so some
heads are on masts that carry none.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from augment.lamps.road_heights import RoadHeights
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass

# Level distance over which Gaussians of one mast hang together, metres.
_LINK_M = 0.7
# Ratio of the distance upwards over which they do to the level one: far masts have gaps.
_UPWARD_RATIO = 4.0
# Least height of a mast above the road, metres.
MIN_MAST_M = 4.5
# Largest height, metres: higher ones are masts of wires and antennas.
MAX_MAST_M = 16.0
# Height up to which a mast has to reach down, metres above the road.
_MAX_FOOT_M = 2.5
# Fewest Gaussians of a mast.
_MIN_GAUSSIANS = 5
# Depth of the head below the top, metres.
_HEAD_DEPTH_M = 0.25
# Distance of the lamp under the lowest part of the head, metres.
_CLEARANCE_M = 0.03
# Largest number of Gaussians of poles that are looked at; more are thinned evenly.
_MAX_GAUSSIANS = 200_000
# Standard deviation from which on the ends of a Gaussian count beside its centre, metres.
_LONG_M = 0.1
# Standard deviations at which a Gaussian ends.
_END_SIGMAS = 1.5
# Opacity from which on a Gaussian counts.
_MIN_OPACITY = 0.2


@dataclass(frozen=True, eq=False)
class LampHeads:
    """Heads of N street lamps."""

    positions_m: Float64[np.ndarray, "N 3"]
    """Places, metres, scene world."""
    feet_m: Float64[np.ndarray, "N 3"]
    """Feet of their masts, metres."""

    def __len__(self) -> int:
        return len(self.positions_m)


def lamp_heads(scene: Scene) -> LampHeads:
    """Return the heads at the tops of a scene's masts, in the order of their places.

    Args:
        scene: the scene; without classes it has no known masts.
    """
    points = _pole_points(scene.background)
    if len(points) < _MIN_GAUSSIANS:
        return LampHeads(np.zeros((0, 3)), np.zeros((0, 3)))
    pairs = KDTree(points / [1.0, 1.0, _UPWARD_RATIO]).query_pairs(_LINK_M, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), np.int8), tuple(pairs.T)), (len(points),) * 2)
    num_masts, mast_of_point = connected_components(links, directed=False)
    order = np.argsort(mast_of_point, kind="stable")
    ends = np.searchsorted(mast_of_point[order], np.arange(num_masts + 1))
    heights = RoadHeights.of_scene(scene)
    heads: list[np.ndarray] = []
    feet: list[np.ndarray] = []
    for first, last in pairwise(ends.tolist()):
        mast = points[order[first:last]]
        if len(mast) < _MIN_GAUSSIANS:
            continue
        lowest = mast[mast[:, 2] < mast[:, 2].min() + 1.0]
        foot = np.array([*np.median(lowest[:, :2], axis=0), mast[:, 2].min()])
        ground_m = heights.height_at(foot, float(foot[2]))
        top_m = mast[:, 2].max()
        is_mast = MIN_MAST_M <= top_m - ground_m <= MAX_MAST_M
        if not is_mast or foot[2] - ground_m > _MAX_FOOT_M:
            continue
        head = mast[mast[:, 2] > top_m - _HEAD_DEPTH_M]
        # Arms rise to their ends: of the head, the far half from the foot counts.
        reach = np.hypot(*(head[:, :2] - foot[:2]).T)
        head = head[reach >= np.median(reach)]
        heads.append(np.array([*head[:, :2].mean(0), head[:, 2].min() - _CLEARANCE_M]))
        feet.append(np.array([*foot[:2], ground_m]))
    if not heads:
        return LampHeads(np.zeros((0, 3)), np.zeros((0, 3)))
    rows = np.lexsort(np.round(np.array(heads), 2).T)
    return LampHeads(np.array(heads)[rows], np.array(feet)[rows])


def _pole_points(background: Gaussians) -> Float64[np.ndarray, "N 3"]:
    """Return points on the Gaussians of poles: the centres, and of long ones both ends, metres."""
    if background.semantic is None:
        return np.zeros((0, 3))
    is_pole = background.semantic.numpy() == int(SemanticClass.POLE)
    is_pole &= background.opacities.detach().numpy() > _MIN_OPACITY
    rows = np.flatnonzero(is_pole)
    step = max(-(-len(rows) // _MAX_GAUSSIANS), 1)
    rows = rows[::step]
    means = background.means.detach()[rows].double().numpy()
    scales = background.scales.detach()[rows].double().numpy()
    axes = rotmat_from_quat(background.quats.detach()[rows]).double().numpy()
    longest = scales.argmax(1)
    index = np.arange(len(rows))
    offsets = _END_SIGMAS * scales[index, longest, None] * axes[index, :, longest]
    is_long = scales[index, longest] > _LONG_M
    ends = [means[is_long] + offsets[is_long], means[is_long] - offsets[is_long]]
    return np.concatenate([means, *ends])
