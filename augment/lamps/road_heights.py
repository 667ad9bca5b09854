"""Height of the road beside a path, from the Gaussians of road and pavement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from augment.errors import ClimateGSError
from augment.memo import memo_of
from augment.scene.ground import ground_of
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass

# Side of the squares that each have one height, metres.
CELL_M = 2.0
# Distance up to which the nearest square's height counts, metres.
REACH_M = 12.0
# Fewest Gaussians that give a square a height.
_MIN_IN_CELL = 5
_GROUND_CLASSES = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
)


@dataclass(frozen=True, eq=False)
class RoadHeights:
    """Heights of the ground in squares, and a height for all other places."""

    tree: KDTree | None
    """Middles of the squares, x and y in metres; None without any."""
    heights_m: Float[np.ndarray, "C"]
    """Median height of each square, metres."""
    other_height_m: float | None
    """Height of a scene without squares; None where it is not known."""

    def height_at(self, position_m: Float[np.ndarray, "3"], default_m: float) -> float:
        """Return the height of the ground at a place, metres.

        Args:
            position_m: the place; its x and y count.
            default_m: height where neither squares nor the scene's ground tell one.
        """
        return float(self.heights_at(position_m[None], np.array([default_m]))[0])

    def heights_at(
        self, positions_m: Float[np.ndarray, "N 3"], defaults_m: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N"]:
        """Return the heights of the ground at places, metres.

        Args:
            positions_m: the places; their x and y count.
            defaults_m: heights where neither squares nor the scene's ground tell one.
        """
        heights_m = np.array(defaults_m, np.float64)
        if self.other_height_m is not None:
            heights_m[:] = self.other_height_m
        if self.tree is not None and len(positions_m):
            distances, rows = self.tree.query(positions_m[:, :2], distance_upper_bound=REACH_M)
            is_near = np.isfinite(distances)
            heights_m[is_near] = self.heights_m[np.asarray(rows)[is_near]]
        return heights_m

    @staticmethod
    def of_scene(scene: Scene) -> RoadHeights:
        """Return the heights of a scene, remembered as long as the scene lives."""
        scene = scene.as_recorded
        return memo_of(scene).get(("lamps, road heights",), lambda: _find_heights(scene))


def _find_heights(scene: Scene) -> RoadHeights:
    """Return the median height of the ground's Gaussians in squares."""
    background = scene.background
    if background.semantic is None:
        return RoadHeights(None, np.zeros(0), _median_height_m(scene))
    classes = np.array([int(c) for c in _GROUND_CLASSES])
    is_ground = np.isin(background.semantic.numpy(), classes)
    points = background.means.detach().numpy()[is_ground].astype(np.float64)
    cells = np.floor(points[:, :2] / CELL_M).astype(np.int64)
    unique_cells, cell_of_point, counts = np.unique(
        cells, axis=0, return_inverse=True, return_counts=True
    )
    order = np.lexsort((points[:, 2], cell_of_point.ravel()))
    ends = np.cumsum(counts)
    heights = points[order[(ends - counts) + counts // 2], 2] if len(counts) else np.zeros(0)
    is_dense = counts >= _MIN_IN_CELL
    if not is_dense.any():
        return RoadHeights(None, np.zeros(0), _median_height_m(scene))
    middles = (unique_cells[is_dense] + 0.5) * CELL_M
    return RoadHeights(KDTree(middles), heights[is_dense], None)


def _median_height_m(scene: Scene) -> float | None:
    """Return the height of the scene's ground; None without metres or a level world."""
    try:
        return ground_of(scene).median_z_m
    except ClimateGSError:
        return None
