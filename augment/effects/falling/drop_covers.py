"""Cover of a picture by near drops or flakes, by their distance: lamps light them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32
from torch import Tensor

from augment.effects.falling.air import compute_clear_share
from augment.lamps.drop_cover import DropCover
from augment.scene.cameras import Camera

# Distances between which drops are lit alike, metres. A lamp's light falls with the square of the
# distance, so they grow by a factor of two.
EDGES_M = np.array([1.5, 3.0, 6.0, 12.0])
# Distance at which the drops of each range are lit, metres.
LIT_DISTANCES_M = np.array([1.0, 2.1, 4.2, 8.5, 17.0])
# Columns of 1 / z as the shutter opens and as it closes, in the rows of `find_drops`.
_INVERSE_DEPTHS = slice(4, 6)


def cover_of_drops(
    drops: Float32[np.ndarray, "N 9"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    camera: Camera,
    *,
    is_snow: bool,
) -> DropCover:
    """Return the share of each pixel that drops of each range of distances cover.

    Args:
        drops: the drops, as `find_drops` gives them.
        alpha: opacity of the surfaces.
        depth: z of the surfaces, metres; 0 without a surface.
        camera: camera of the picture.
        is_snow: True if they are flakes.
    """
    surfaces = [image.detach().float().cpu().numpy() for image in (alpha, depth)]
    inverse_depths = drops[:, _INVERSE_DEPTHS].mean(1)
    ranges = np.searchsorted(EDGES_M, 1 / np.maximum(inverse_depths, 1e-6))
    covers = np.zeros((len(LIT_DISTANCES_M), camera.height, camera.width), np.float32)
    for number in range(len(LIT_DISTANCES_M)):
        drops_of_range = np.ascontiguousarray(drops[ranges == number])
        if len(drops_of_range):
            covers[number] = 1 - compute_clear_share(drops_of_range, *surfaces)
    return DropCover(covers, LIT_DISTANCES_M, is_snow)
