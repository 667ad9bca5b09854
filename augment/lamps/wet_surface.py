"""Water that mirrors lamps: share, roughness and depth of each pixel.

Wet ground and floods set it in a `RenderedView` if lamps ask for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

# Beckmann roughness of standing water, at least: ripples that are too fine to be drawn.
MIN_ROUGHNESS = 0.02


@dataclass(frozen=True, eq=False)
class WetSurface:
    """Water in one picture."""

    share: Float32[np.ndarray, "H W"]
    """Share of each pixel that shows water, 0 to 1."""
    roughness: Float32[np.ndarray, "H W"]
    """Beckmann roughness of the water, at least MIN_ROUGHNESS where `share` is above 0."""
    depth_m: Float32[np.ndarray, "H W"]
    """z of the water, metres."""
    up: tuple[float, float, float]
    """Unit normal of the water's plane, world."""
    tilts: Float32[np.ndarray, "H W 2"] | None = None
    """x and y of the unit normal of waves less those of `up`, world; None for a flat surface."""

    def __post_init__(self) -> None:
        for name in ("roughness", "depth_m"):
            shape = getattr(self, name).shape
            if shape != self.share.shape:
                raise ValueError(
                    f"{name} must be {list(self.share.shape)} (from share); got {list(shape)}"
                )

    def before(self, farther: WetSurface | None) -> WetSurface:
        """Return this water with another one where this one has no share."""
        if farther is None:
            return self
        is_here = self.share > 0
        images = (
            np.where(is_here, getattr(self, name), getattr(farther, name))
            for name in ("share", "roughness", "depth_m")
        )
        tilts = None
        if self.tilts is not None or farther.tilts is not None:
            flat = np.zeros((*is_here.shape, 2), np.float32)
            tilts_of_self = flat if self.tilts is None else self.tilts
            tilts_of_farther = flat if farther.tilts is None else farther.tilts
            tilts = np.where(is_here[..., None], tilts_of_self, tilts_of_farther)
        return WetSurface(*images, self.up, tilts)
