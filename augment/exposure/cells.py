"""Records of the cells of a scene's surfaces that are open to the sky.

`search` finds them once a scene, `exposed_surface` stores them, and effects that fall from the sky
read them. They do not depend on how much falls: a layer of any depth lies on the same cells.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Float32, Int16, Int32
from torch import Tensor

# Codes in ExposedCells.neighbours for a side where no cell of the same size follows.
OPEN_EDGE = -1  # the surface falls away: a roof's edge, or the shade of something above it
# The surface goes on or rises (a wall, cells of another size); the layer keeps its depth.
FLUSH = -2
MAX_EDGE_DISTANCE_M = 2.0  # largest distance to an edge that is recorded


@dataclass(frozen=True, eq=False)
class ExposedCells:
    """Cells on the surfaces of one part of a scene that are open to the sky.

    Each of the C cells is a square seen from above, in the part's frame (an actor's frame has its
    origin at the box's centre, z up). B Gaussians of the part are the surface, or lie close beneath
    it: a layer on the cells can hide them.
    """

    # Middle of each cell: x, y, and z of the surface there.
    centers_m: Float32[Tensor, "C 3"]
    # Unit normals of the surface, z > 0.
    normals: Float32[Tensor, "C 3"]
    # Sides of the squares.
    sizes_m: Float32[Tensor, "C"]
    # Level distance from the middle to the nearest open edge (OPEN_EDGE): half a cell at least,
    # MAX_EDGE_DISTANCE_M at most.
    edge_distance_m: Float32[Tensor, "C"]
    # Indices of the cells to the -x, +x, -y and +y side, or OPEN_EDGE or FLUSH.
    neighbours: Int32[Tensor, "C 4"]
    # Brightness of the bare surface relative to what is usual for its class nearby, 1 = usual;
    # shadows that the recording holds show in it.
    relative_light: Float32[Tensor, "C"]
    # How much of a wheel track the cell is, 0 to 1.
    track_share: Float32[Tensor, "C"]
    # Level vector towards obstacles beside the cell: 0 far from any, about 1 long at their foot.
    obstacle_vectors: Float32[Tensor, "C 2"]
    # Class of the surface; VEGETATION is foliage, not grass.
    semantic: Int16[Tensor, "C"]
    # Share of a layer's depth that the surface holds, 0 to 1: less on the glass of a vehicle and on
    # the bonnet of one that moves, 1 elsewhere.
    depth_share: Float32[Tensor, "C"]
    # Indices of the Gaussians that a layer on the cells can hide.
    hideable_ids: Int32[Tensor, "B"]
    # Cells over each of these Gaussians: at its middle, and at 1.5 standard deviations along its
    # two longest axes. A layer on all of these cells hides the Gaussian; -1 (no cell) means never.
    covering_cells: Int32[Tensor, "B 5"]

    def __len__(self) -> int:
        return self.centers_m.shape[0]


@dataclass(frozen=True, eq=False)
class ExposedSurface:
    """Cells of a whole scene."""

    ground: ExposedCells  # cells of the background
    actors: Mapping[str, ExposedCells]  # cells of the actors that have any, by track_id
