"""What steers a reconstruction: what a user may choose, and the numbers behind it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Densify = Literal["absgrad", "none"]


@dataclass(frozen=True)
class LossWeights:
    """Loss of one view = (1 - d_ssim) L1 + d_ssim (1 - SSIM) / 2 (mean over weighted pixels)
    + depth * mean |1/ED - 1/z| over the pixels with a depth prior (1/m)
    + surface * mean (1 - alpha) over the same pixels, so that ground and walls have no holes
    + sky * mean alpha over all pixels marked as sky (relative to the image's pixel count)
    + ground * mean (1 - alpha) over those below the horizon that are no sky (likewise): weather
    fills what is left open there with what lies infinitely far away.
    """

    d_ssim: float = 0.2
    depth: float = 2.0
    surface: float = 0.05
    sky: float = 0.15
    ground: float = 0.2


class FitConfig(BaseModel):
    """What a user may choose of one reconstruction.

    Args:
        seed: Of everything random.
        depth_weight: How much depth priors count. 0 switches them off.
        sh_degree: Highest band of spherical harmonics, 0 to 3.
        max_splats: Splats are not added beyond this number.
        densify: How splats are added.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    seed: int = Field(default=0, ge=0)
    depth_weight: float = Field(default=LossWeights.depth, ge=0)
    sh_degree: int = Field(default=1, ge=0, le=3)
    max_splats: int = Field(default=600_000, ge=1)
    densify: Densify = "absgrad"


@dataclass(frozen=True)
class LearningRates:
    """Adam's step sizes. means: pixels of the view at hand, so that a distant splat moves further;
    scales: of their logarithm; opacities: of their logit; sh_rest: of the bands above degree 0;
    actors: metres of a box's position; cameras: pixels of what a camera sees 10 m away. Means and
    the sky's texels decay exponentially to means_end and sky_end over the run, the others to `late`
    of their value.
    """

    means: float = 0.3
    means_end: float = 0.003
    quats: float = 6e-3
    scales: float = 0.02
    opacities: float = 0.1
    sh_dc: float = 0.02
    sh_rest: float = 2.5e-4
    sky: float = 0.03
    sky_end: float = 1e-3
    color_map: float = 2e-3
    actors: float = 3e-3
    cameras: float = 0.12
    late: float = 0.2


@dataclass(frozen=True)
class Growth:
    """How the number of splats grows. every: steps between two rounds. start, stop: parts of the
    run. prune_opacity: fainter splats are removed. fraction: of the splats, that a round adds.
    """

    every: int = 200
    start: float = 0.05
    stop: float = 0.6
    prune_opacity: float = 0.02
    fraction: float = 0.05


@dataclass(frozen=True)
class Tuning:
    """The numbers that nobody is asked for. sh_every: steps after which one more band is learnt.
    exposure_pull draws each camera's colour map to the identity, pose_pull (1/m^2) boxes and
    cameras to where they were recorded. Weights of the loss: see `LossWeights`.
    """

    sh_every: int = 500
    exposure_pull: float = 0.001
    pose_pull: float = 1e-4
    rates: LearningRates = field(default_factory=LearningRates)
    growth: Growth = field(default_factory=Growth)
