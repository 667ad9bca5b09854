"""Record of the drops and flakes before a picture, which lamps light.

Rain and snowfall set it in a `RenderedView` if lamps ask for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64


@dataclass(frozen=True, eq=False)
class DropCover:
    """Cover of a picture by the drops or flakes that are drawn one by one."""

    covers: Float32[np.ndarray, "K H W"]
    """Share of each pixel that drops of a range of distances cover, nearest range first."""
    distances_m: Float64[np.ndarray, "K"]
    """Distance of the drops of each range, metres."""
    is_snow: bool
    """True for flakes."""
