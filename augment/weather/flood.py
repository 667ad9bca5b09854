"""A flood placed in a scene, and the layers that its water is drawn from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.weather.waves import WaveSet

FresnelModel = Literal["exact", "schlick"]
ReflectionTier = Literal["sky", "screen_space", "mirrored"]


@dataclass(frozen=True, eq=False)
class FloodMedium:
    """Water placed in a scene: its surface is the plane z = level_z_m, scene world, metres.

    extinction_per_m: of red, green and blue along the way through the water, >= 0, may be
    infinite. rgb: colour of deep water seen from above, display-encoded.
    """

    level_z_m: float
    extinction_per_m: tuple[float, float, float]
    rgb: tuple[float, float, float]
    waves: WaveSet
    refraction_index: float = 1.333
    fresnel: FresnelModel = "exact"
    reflection: ReflectionTier = "mirrored"


@dataclass(frozen=True, eq=False)
class Layer:
    """What one side of the water looks like from a camera.

    rgb [H, W, 3]: premultiplied, display-encoded, without sky. alpha [H, W]. depth [H, W]: expected
    z in the camera, metres; meaningless where alpha is 0.
    """

    camera: Camera
    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"]
