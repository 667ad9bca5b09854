"""Where snow can lie in a scene: cells of surfaces that are open to the sky, found once.

A support knows nothing of a recipe's depth: snow of any depth is laid on the same support.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Float32, Int16, Int32
from torch import Tensor

# In SnowCells.neighbours, where no cell of the same size follows on that side: the surface falls
# away (a roof's edge, or the shade of something above it), or it goes on or rises (a wall, cells of
# another size), against which the layer keeps its depth.
OPEN_EDGE, FLUSH = -1, -2
EDGE_CAP_M = 2.0  # distances to the edge are not told apart beyond this


@dataclass(frozen=True, eq=False)
class SnowCells:
    """C cells on the surfaces of one part of a scene: squares seen from above, in the part's frame
    (an actor's: origin at its box's centre, z up).

    centers_m [C, 3]: x and y of the middle, and z of the surface there. normals [C, 3]: unit, of
    the surface, z > 0. sizes_m [C]: sides. edge_m [C]: level distance from the middle to the
    nearest open edge (see OPEN_EDGE), half a cell at least, EDGE_CAP_M at most. neighbours [C, 4]:
    cells to the -x, +x, -y and +y side, or OPEN_EDGE or FLUSH. light [C]: brightness of the bare
    surface relative to what is usual for its class nearby, 1 = usual; shadows that the recording
    holds show in it. tracks [C]: 0 to 1, how much of a wheel track it is. banks [C, 2]: level
    vector towards obstacles that stand beside the cell, 0 far from any to about 1 at their foot.
    semantic [C]: class of the surface; VEGETATION is foliage, not grass.

    buried [B]: Gaussians of the part that are the surface, or lie close beneath it.
    buried_by [B, 5]: cells over each of them, at its middle and at 1.5 standard deviations along
    its two longest axes; what all of these cells cover with snow is hidden by it. -1 where there
    is no cell, so that the Gaussian is never hidden.
    """

    centers_m: Float32[Tensor, "C 3"]
    normals: Float32[Tensor, "C 3"]
    sizes_m: Float32[Tensor, "C"]
    edge_m: Float32[Tensor, "C"]
    neighbours: Int32[Tensor, "C 4"]
    light: Float32[Tensor, "C"]
    tracks: Float32[Tensor, "C"]
    banks: Float32[Tensor, "C 2"]
    semantic: Int16[Tensor, "C"]
    buried: Int32[Tensor, "B"]
    buried_by: Int32[Tensor, "B 5"]

    def __len__(self) -> int:
        return self.centers_m.shape[0]


@dataclass(frozen=True, eq=False)
class SnowSupport:
    """The cells of a whole scene. ground: of the background. actors: by track_id, of those that
    carry snow.
    """

    ground: SnowCells
    actors: Mapping[str, SnowCells]
