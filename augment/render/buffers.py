"""What a rasteriser returns, and the names of the buffers that can be asked for."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int32
from torch import Tensor

RGB, ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH, SPLAT_IDS, MODE_DEPTH, SNOW = (
    "rgb",
    "alpha",
    "expected_depth",
    "median_depth",
    "splat_ids",
    "mode_depth",
    "snow",
)
BUFFERS = (RGB, ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH, SPLAT_IDS, MODE_DEPTH, SNOW)
# Depth estimators by the names that recipes and placement give them.
DEPTH_ESTIMATORS = {"median": MEDIAN_DEPTH, "expected": EXPECTED_DEPTH, "mode": MODE_DEPTH}
DIFFERENTIABLE = frozenset({RGB, ALPHA, EXPECTED_DEPTH})  # by every backend that has gradients


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """Image buffers of one camera; None where not asked for.

    rgb: sum of weights times colour, without background. alpha: 1 - final transmittance.
    expected_depth: sum(w z) / max(sum(w), 1e-10), metres; 0 where nothing was hit; z is that of a
    splat's centre, or, with a clip, of its surface at the pixel (see augment.render.clip).
    median_depth: z of the centre of the first splat that brings transmittance below 0.5, metres; 0
    where none does. splat_ids: index of the splat with the largest weight, counted through the
    parts in order; -1 where nothing was hit. The first of equal weights wins. mode_depth: mode of
    the heaviest cluster of depths along the ray (augment.render.mode_depth), metres; 0 where
    nothing was hit; z is that of expected_depth. snow: sum of weights of the splats that are snow,
    in [0, alpha].
    """

    rgb: Float[Tensor, "H W 3"] | None = None
    alpha: Float[Tensor, "H W"] | None = None
    expected_depth: Float[Tensor, "H W"] | None = None
    median_depth: Float[Tensor, "H W"] | None = None
    splat_ids: Int32[Tensor, "H W"] | None = None
    mode_depth: Float[Tensor, "H W"] | None = None
    snow: Float[Tensor, "H W"] | None = None
