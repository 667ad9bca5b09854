"""Record of the drops and flakes before a picture, which lamps light.

Rain and snowfall set it in a `RenderedView` if lamps ask for it.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64


@runtime_checkable
class DropCover(Protocol):
    """Cover of a picture by the drops or flakes that are drawn one by one."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the picture."""
        ...

    @property
    def distances_m(self) -> Float64[np.ndarray, "K"]:
        """Distance at which the drops of each range of distances are lit, nearest range first."""
        ...

    @property
    def is_snow(self) -> bool:
        """True for flakes."""
        ...

    @property
    def has_drops(self) -> bool:
        """True if there is any drop."""
        ...

    def add_light(
        self,
        picture: Float32[np.ndarray, "H W 3"],
        cells: Float32[np.ndarray, "K h 3 w"],
        step_px: int,
    ) -> None:
        """Add the light of the drops to a picture, in place; nearer ones hide those behind.

        Args:
            picture: luminance in linear sRGB, cd/m2.
            cells: luminance of drops in cells of the picture, which is linear between the cells'
                middles. Cells beyond the picture are not used.
            step_px: side of a cell, a multiple of 16.
        """
        ...
