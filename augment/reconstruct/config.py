"""Every number that steers a reconstruction, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LossWeights:
    """Loss of one view = (1 - d_ssim) L1 + d_ssim (1 - SSIM) / 2 (mean over weighted pixels)
    + depth * mean |1/ED - 1/z| over the pixels with a depth prior (1/m)
    + surface * mean (1 - alpha) over the same pixels, so that ground and walls have no holes
    + sky * mean alpha over all pixels marked as sky (relative to the image's pixel count).

    depth 0 switches depth regularisation off. opacity_decay and scale_decay pull the opacity and
    the size (1/m) of every splat that a view touches towards 0.
    """

    d_ssim: float = 0.2
    depth: float = 2.0
    surface: float = 0.05
    sky: float = 0.05
    opacity_decay: float = 0.0
    scale_decay: float = 0.0


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
class DensifyConfig:
    """How the number of splats grows. method: "absgrad" clones and splits where image gradients
    are large; "mcmc" moves dead splats onto living ones and adds more in proportion to opacity.

    max_splats: none are added beyond. every: steps between two rounds. start, stop: parts of the
    run. prune_opacity: fainter splats are removed (absgrad) or moved (mcmc). split: where absgrad's
    children of large splats go, "sampled" within the parent or side by side on its "long_axis".
    noise: 1/m, how far mcmc shakes faint splats at every step, decaying as the steps of means do.
    """

    method: str = "absgrad"
    max_splats: int = 600_000
    every: int = 200
    start: float = 0.05
    stop: float = 0.6
    prune_opacity: float = 0.02
    grow_fraction: float = 0.05
    noise: float = 50.0
    split: str = "long_axis"


@dataclass(frozen=True)
class FitConfig:
    """One reconstruction. steps: optimiser updates, one view each. sh_degree: highest band that is
    learnt; one more every sh_every steps. pose_refinement: whether actors' boxes and
    cameras may move a little.
    exposure: whether every camera gets a colour map; exposure_pull draws it to the identity,
    pose_pull (1/m^2) boxes and cameras to where they were recorded.
    """

    steps: int = 5000
    seed: int = 0
    sh_degree: int = 1
    sh_every: int = 500
    pose_refinement: bool = True
    exposure: bool = True
    exposure_pull: float = 0.001
    pose_pull: float = 1e-4
    loss: LossWeights = field(default_factory=LossWeights)
    rates: LearningRates = field(default_factory=LearningRates)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
