"""How far a scene is closed: pixels below the horizon that show what should not be there, the sky.

Fog, water and snow take what has no surface for sky, so that such pixels are not fit for weather.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Bool
from torch import Tensor

from augment.cameras import Camera
from augment.render.buffers import ALPHA, AUTO
from augment.render.rasterize import rasterize
from augment.scene import Scene
from augment.view_images import SURFACE_ALPHA

MAX_TRANSMITTANCE = 0.02  # of a pixel that is closed


class Openings(NamedTuple):
    """pixels: how many lie below the horizon, of which shares from 0 to 1 are open. no_surface:
    their alpha is less than a surface's (SURFACE_ALPHA). leaking: more than MAX_TRANSMITTANCE of
    the light comes through, those without a surface among them."""

    pixels: int
    no_surface: float
    leaking: float


def measure_openings(
    scene: Scene,
    camera: Camera,
    left_out: Bool[Tensor, "H W"] | None = None,
    *,
    backend: str = AUTO,
) -> Openings:
    """The openings in a view below the horizon, which is level: rays that do not point down are not
    counted. left_out: pixels that do not count either, such as the recording car's."""
    alpha = rasterize(scene.parts_for(camera), camera, buffers=(ALPHA,), backend=backend).alpha
    assert alpha is not None
    below = camera.ray_directions(device=alpha.device)[..., 2] < 0
    if left_out is not None:
        below &= ~left_out.to(alpha.device)
    alpha = alpha[below]
    if not len(alpha):
        return Openings(0, 0.0, 0.0)
    return Openings(
        len(alpha),
        float((alpha < SURFACE_ALPHA).float().mean()),
        float((alpha < 1 - MAX_TRANSMITTANCE).float().mean()),
    )
