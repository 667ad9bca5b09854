"""Reflections in flat water found in the camera's own image: a march through its depth.

The torch definition, and the entry to the kernels that do it in less time.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.weather.flood import Layer


@dataclass(frozen=True, eq=False)
class ScreenReflection:
    """How far the mirrored rays of a window's pixels run until they meet what the image shows.

    layer: what was marched through, with the whole image's camera. distance [h, w]: metres along
    the mirrored ray from the flat surface; infinite where it ends in the sky or nothing is known.
    weight [h, w]: how far that can be trusted, 0 to 1.
    """

    layer: Layer
    distance: Float[Tensor, "h w"]
    weight: Float[Tensor, "h w"]


def trace_screen(
    front: Layer, camera: Camera, level_z_m: float, *, stride: int = 2, fast: bool = True
) -> ScreenReflection:
    """The mirrored ray of every pixel of `camera`, a window of the front's image."""
    raise NotImplementedError
