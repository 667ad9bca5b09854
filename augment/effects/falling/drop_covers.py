"""Cover of a picture by near drops or flakes, by their distance: lamps light them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor

from augment.effects.falling import drop_kernels
from augment.effects.falling.air import list_drops, padded_image
from augment.render.threads import kernel_threads

# Distances between which drops are lit alike, metres. A lamp's light falls with the square of the
# distance, so they grow by a factor of two.
EDGES_M = np.array([1.5, 3.0, 6.0, 12.0])
# Distance at which the drops of each range are lit, metres.
LIT_DISTANCES_M = np.array([1.0, 2.1, 4.2, 8.5, 17.0])
# Columns of 1 / z as the shutter opens and as it closes, in the rows of `find_drops`.
_INVERSE_DEPTHS = slice(4, 6)


@dataclass(frozen=True, eq=False)
class DropsInRanges:
    """Drops before a picture in ranges of distances: a `lamps.drop_cover.DropCover`."""

    drops: Float32[np.ndarray, "N 9"]
    """The drops, as `find_drops` gives them, nearest range first."""
    ends: Int64[np.ndarray, "K"]
    """Number of drops up to the end of each range."""
    alpha: Float32[np.ndarray, "H W"]
    """Opacity of the surfaces."""
    depth: Float32[np.ndarray, "H W"]
    """z of the surfaces, metres; 0 without a surface."""
    is_snow: bool
    """True for flakes."""
    distances_m: Float64[np.ndarray, "K"]
    """Distance at which the drops of each range are lit, metres."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the picture."""
        height, width = self.depth.shape
        return height, width

    @property
    def has_drops(self) -> bool:
        """True if there is any drop."""
        return len(self.drops) > 0

    def add_light(
        self,
        picture: Float32[np.ndarray, "H W 3"],
        cells: Float32[np.ndarray, "K h 3 w"],
        step_px: int,
    ) -> None:
        """Add the light of the drops to a picture, as `DropCover.add_light` says.

        Args:
            picture: luminance in linear sRGB, cd/m2.
            cells: luminance of drops in cells of the picture.
            step_px: side of a cell.
        """
        surfaces = [padded_image(image) for image in (self.alpha, self.depth)]
        with kernel_threads(1):
            drop_kernels.add_lit_drops(
                *list_drops(self.drops, len(picture)),
                self.ends,
                *(image.reshape(-1) for image in surfaces),
                surfaces[0].shape[1],
                cells,
                step_px,
                picture,
            )


def cover_of_drops(
    drops: Float32[np.ndarray, "N 9"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    *,
    is_snow: bool,
) -> DropsInRanges:
    """Return the drops before a picture in ranges of distances.

    Args:
        drops: the drops, as `find_drops` gives them.
        alpha: opacity of the surfaces.
        depth: z of the surfaces, metres; 0 without a surface.
        is_snow: True if they are flakes.
    """
    inverse_depths = drops[:, _INVERSE_DEPTHS].mean(1)
    ranges = np.searchsorted(EDGES_M, 1 / np.maximum(inverse_depths, 1e-6))
    order = np.argsort(ranges, kind="stable")
    ends = np.cumsum(np.bincount(ranges, minlength=len(LIT_DISTANCES_M)))
    return DropsInRanges(
        np.ascontiguousarray(drops[order]),
        ends,
        alpha.detach().float().cpu().numpy(),
        depth.detach().float().cpu().numpy(),
        is_snow,
        LIT_DISTANCES_M,
    )
