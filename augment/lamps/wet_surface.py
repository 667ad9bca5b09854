"""Water that mirrors lamps: shares and roughness of each pixel, as wet ground and floods set them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True, eq=False)
class WetSurface:
    """Water in one picture."""

    share: Float32[np.ndarray, "H W"]
    """Share of each pixel that shows water, 0 to 1."""
    roughness: Float32[np.ndarray, "H W"]
    """Beckmann roughness of the water, at least MIN_ROUGHNESS where `share` is above 0."""
    up: tuple[float, float, float]
    """Unit normal of the water's plane, world."""
    depth_m: Float32[np.ndarray, "H W"] | None = None
    """z of the water, metres; None where the water lies on the scene's surfaces."""

    def __post_init__(self) -> None:
        for name in ("roughness", "depth_m"):
            image = getattr(self, name)
            if image is not None and image.shape != self.share.shape:
                raise ValueError(
                    f"{name} must be [H, W] as share, {list(self.share.shape)}; got "
                    f"{list(image.shape)}"
                )
