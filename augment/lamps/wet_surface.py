"""Water that mirrors lamps: share, roughness and depth of each pixel.

Floods and wet ground set it in a `RenderedView` if lamps ask for it. Of wet ground, they set what
changes slowly over it in some pixels alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

# Beckmann roughness of standing water, at least: ripples that are too fine to be drawn.
MIN_ROUGHNESS = 0.02
# z from which on a pixel shows no water, metres.
MAX_DEPTH_M = 1e6


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

    def without(self, pixels: Bool[np.ndarray, "H W"]) -> WetSurface:
        """Return the water without some pixels."""
        return replace(self, share=np.where(pixels, np.float32(0), self.share))


@dataclass(frozen=True, eq=False)
class WetRoad:
    """Film of water on the ground of one picture. `road_unevenness.water_of_road` has its water."""

    share: Float32[np.ndarray, "H W"]
    """Share of each pixel that shows open ground, 0 to 1."""
    depth_m: Float32[np.ndarray, "H W"]
    """z of what a pixel shows, metres."""
    film: Float32[np.ndarray, "h w 3"]
    """Film in a coarser picture of the view, linear between the middles of its pixels: Beckmann
    roughness, share of the ground that it covers, share of the slopes' variance that waves of the
    road may have."""
    up: tuple[float, float, float]
    """Unit normal of the ground's plane, world."""

    def __post_init__(self) -> None:
        if self.depth_m.shape != self.share.shape:
            raise ValueError(
                f"depth_m must be {list(self.share.shape)} (from share); got "
                f"{list(self.depth_m.shape)}"
            )

    def without(self, pixels: Bool[np.ndarray, "H W"]) -> WetRoad:
        """Return the road without some pixels."""
        return replace(self, share=np.where(pixels, np.float32(0), self.share))
