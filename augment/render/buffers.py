"""Image buffers that a rasteriser returns, their names, and the names of the backends."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int32
from torch import Tensor

# ---- The backends of the rasteriser by name ------------------------------------------------------

AUTO = "auto"
REFERENCE = "reference"
CPU = "cpu"
CUDA = "cuda"
BACKENDS = (AUTO, REFERENCE, CPU, CUDA)


def choose_kernels(backend: str, *images: Tensor | None) -> str:
    """Return the kernels for a pass over finished images: REFERENCE (plain torch), CPU or CUDA.

    Kernels take float32 without gradients; torch does everything else. AUTO follows the images: it
    means CUDA if any of them lies on a GPU.
    """
    present_images = [image for image in images if image is not None]
    is_recording = torch.is_grad_enabled()
    if backend == REFERENCE or not all(
        image.dtype == torch.float32 and not (is_recording and image.requires_grad)
        for image in present_images
    ):
        return REFERENCE
    if backend == AUTO:
        return CUDA if any(image.device.type != "cpu" for image in present_images) else CPU
    return backend


RGB = "rgb"
ALPHA = "alpha"
EXPECTED_DEPTH = "expected_depth"
MEDIAN_DEPTH = "median_depth"
SPLAT_IDS = "splat_ids"
MODE_DEPTH = "mode_depth"
OVERLAY = "overlay"
BUFFERS = (RGB, ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH, SPLAT_IDS, MODE_DEPTH, OVERLAY)
# Depth estimators by the names that recipes and placement give them.
DEPTH_ESTIMATORS = {"median": MEDIAN_DEPTH, "expected": EXPECTED_DEPTH, "mode": MODE_DEPTH}
# Buffers that every backend with gradients can differentiate.
DIFFERENTIABLE = frozenset({RGB, ALPHA, EXPECTED_DEPTH})


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """Image buffers of one camera; None for a buffer that was not asked for.

    rgb: sum of weights times colour, without background.
    alpha: 1 - final transmittance.
    expected_depth: sum(w z) / max(sum(w), 1e-10), metres; 0 where nothing was hit. z is that of a
        splat's centre, or, with a clip, of its surface at the pixel (see augment.render.layout).
    median_depth: z of the centre of the first splat that brings transmittance below 0.5, metres; 0
        where no splat does.
    splat_ids: index of the splat with the largest weight, counted through the parts in order; -1
        where nothing was hit. Of equal weights, the first one counts.
    mode_depth: mode of the heaviest cluster of depths along the ray (augment.render.mode_depth),
        metres; 0 where nothing was hit. z is that of expected_depth.
    overlay: sum of weights of the splats of parts that lie on the scene
        (PosedGaussians.is_overlay), in [0, alpha].
    fog_share: 1 - transmittance of the fog that each pixel of a recorded image was mixed with, at
        the image's own edges. It is no buffer of the rasteriser's: None where splats are drawn.
    """

    rgb: Float[Tensor, "H W 3"] | None = None
    alpha: Float[Tensor, "H W"] | None = None
    expected_depth: Float[Tensor, "H W"] | None = None
    median_depth: Float[Tensor, "H W"] | None = None
    splat_ids: Int32[Tensor, "H W"] | None = None
    mode_depth: Float[Tensor, "H W"] | None = None
    overlay: Float[Tensor, "H W"] | None = None
    fog_share: Float[Tensor, "H W"] | None = None
