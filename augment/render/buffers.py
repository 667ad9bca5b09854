"""What a rasteriser returns, and the names of the buffers that can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from augment.errors import BackendUnavailable

# ---- The rasteriser's backends by name, and which of them can run here ---------------------------

AUTO, REFERENCE, CPU, CUDA = "auto", "reference", "cpu", "cuda"
BACKENDS = (AUTO, REFERENCE, CPU, CUDA)


def available_backends() -> dict[str, str | None]:
    """Every backend but "auto", with None where it can run and else the reason why it cannot."""
    obstacles: dict[str, str | None] = {REFERENCE: None, CPU: None, CUDA: None}
    for backend, import_it in ((CPU, import_cpu), (CUDA, import_cuda)):
        try:
            import_it()
        except BackendUnavailable as error:
            obstacles[backend] = str(error)
    return obstacles


def import_cpu() -> ModuleType:
    """The numba backend. Raises BackendUnavailable, which says what is missing."""
    try:
        from augment.render.cpu import driver as cpu
    except ImportError as error:
        raise BackendUnavailable(
            f"backend 'cpu' is unavailable: {error}. Install the package's dependencies (numba, "
            f"tbb), or use backend 'reference', which needs torch only and is far slower"
        ) from error
    return cpu


def import_cuda() -> ModuleType:
    """The Triton backend. Raises BackendUnavailable, which says what is missing."""
    from augment.render.cuda import runtime

    runtime.check_can_run()
    from augment.render.cuda import driver as cuda

    return cuda


def kernels_for(backend: str, *images: Tensor | None) -> str:
    """Which kernels a pass over finished images takes: REFERENCE (plain torch), CPU or CUDA.

    Kernels are for float32 without gradients; all else is left to torch. AUTO follows the images:
    CUDA where they lie on a GPU.
    """
    given = [image for image in images if image is not None]
    tracking = torch.is_grad_enabled()
    if backend == REFERENCE or not all(
        image.dtype == torch.float32 and not (tracking and image.requires_grad) for image in given
    ):
        return REFERENCE
    if backend == AUTO:
        return CUDA if any(image.device.type != "cpu" for image in given) else CPU
    return backend


RGB, ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH = "rgb", "alpha", "expected_depth", "median_depth"
SPLAT_IDS, MODE_DEPTH, OVERLAY = "splat_ids", "mode_depth", "overlay"
BUFFERS = (RGB, ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH, SPLAT_IDS, MODE_DEPTH, OVERLAY)
# Depth estimators by the names that recipes and placement give them.
DEPTH_ESTIMATORS = {"median": MEDIAN_DEPTH, "expected": EXPECTED_DEPTH, "mode": MODE_DEPTH}
DIFFERENTIABLE = frozenset({RGB, ALPHA, EXPECTED_DEPTH})  # by every backend that has gradients


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """Image buffers of one camera; None where not asked for.

    rgb: sum of weights times colour, without background. alpha: 1 - final transmittance.
    expected_depth: sum(w z) / max(sum(w), 1e-10), metres; 0 where nothing was hit; z is that of a
    splat's centre, or, with a clip, of its surface at the pixel (see augment.render.layout).
    median_depth: z of the centre of the first splat that brings transmittance below 0.5, metres; 0
    where none does. splat_ids: index of the splat with the largest weight, counted through the
    parts in order; -1 where nothing was hit. The first of equal weights wins. mode_depth: mode of
    the heaviest cluster of depths along the ray (augment.render.mode_depth), metres; 0 where
    nothing was hit; z is that of expected_depth. overlay: sum of weights of the splats
    of parts that lie on the scene (PosedGaussians.is_overlay), in [0, alpha].
    """

    rgb: Float[Tensor, "H W 3"] | None = None
    alpha: Float[Tensor, "H W"] | None = None
    expected_depth: Float[Tensor, "H W"] | None = None
    median_depth: Float[Tensor, "H W"] | None = None
    splat_ids: Int32[Tensor, "H W"] | None = None
    mode_depth: Float[Tensor, "H W"] | None = None
    overlay: Float[Tensor, "H W"] | None = None
