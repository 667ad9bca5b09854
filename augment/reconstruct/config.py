"""Settings of a reconstruction: those that users choose, and the numbers behind them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Densify = Literal["absgrad", "none"]


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of a view's loss.

    loss = (1 - d_ssim) L1 + d_ssim (1 - SSIM) / 2   mean over weighted pixels
         + depth * mean |1/ED - 1/z|                 over the pixels with a depth prior, in 1/m
         + surface * mean (1 - alpha)                over the same pixels
         + sky * mean alpha                          over the pixels marked as sky
         + ground * mean (1 - alpha)                 below the horizon, without the sky

    The last two means divide by the image's pixel count. `surface` closes holes in ground and
    walls. `ground` closes holes below the horizon, which weather would fill with something that
    lies infinitely far away.
    """

    d_ssim: float = 0.2  # share of SSIM in the image loss
    depth: float = 2.0  # of depth priors
    surface: float = 0.05  # of opaque surfaces
    sky: float = 0.15  # of transparent sky
    ground: float = 0.2  # of opaque ground


class FitConfig(BaseModel):
    """Settings of one reconstruction that users choose.

    Args:
        seed: seed of everything random.
        depth_weight: weight of the depth priors. 0 switches them off.
        sh_degree: highest band of spherical harmonics, 0 to 3.
        max_splats: splats are not added beyond this number.
        densify: the rule by which splats are added.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    seed: int = Field(default=0, ge=0)
    depth_weight: float = Field(default=LossWeights.depth, ge=0)
    sh_degree: int = Field(default=1, ge=0, le=3)
    max_splats: int = Field(default=600_000, ge=1)
    densify: Densify = "absgrad"


@dataclass(frozen=True)
class LearningRates:
    """Adam's step sizes.

    Means and the sky's texels decay exponentially over the run to means_end and sky_end, all others
    to `late` times their value.
    """

    means: float = 0.3  # pixels of the current view, so that a distant splat moves further
    means_end: float = 0.003  # pixels, at the end of the run
    quats: float = 6e-3
    scales: float = 0.02  # of the scales' logarithms
    opacities: float = 0.1  # of the opacities' logits
    sh_dc: float = 0.02  # of the band of degree 0
    sh_rest: float = 2.5e-4  # of the bands above degree 0
    sky: float = 0.03  # of the sky's texels
    sky_end: float = 1e-3  # the same at the end of the run
    color_map: float = 2e-3  # of the cameras' colour maps
    actors: float = 3e-3  # metres of a box's position
    cameras: float = 0.12  # pixels of points 10 m in front of a camera
    late: float = 0.2  # factor of the other step sizes at the end of the run


@dataclass(frozen=True)
class Growth:
    """Rounds that add and remove splats."""

    every: int = 200  # steps between two rounds
    start: float = 0.05  # fraction of the run before the first round
    stop: float = 0.6  # fraction of the run after which no round follows
    prune_opacity: float = 0.02  # fainter splats are removed
    fraction: float = 0.05  # splats that a round adds, as a fraction of all


@dataclass(frozen=True)
class Tuning:
    """Settings that users do not choose. Weights of the loss are in `LossWeights`."""

    sh_every: int = 500  # steps after which one more band of SH is learnt
    exposure_pull: float = 0.001  # pulls each camera's colour map to the identity
    pose_pull: float = 1e-4  # 1/m^2, pulls boxes and cameras to their recorded poses
    rates: LearningRates = field(default_factory=LearningRates)
    growth: Growth = field(default_factory=Growth)
