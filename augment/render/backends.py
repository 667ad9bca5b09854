"""The rasteriser's backends by name, and which of them can run here."""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from augment.errors import BackendUnavailable

AUTO, REFERENCE, CPU, CUDA = "auto", "reference", "cpu", "cuda"
BACKENDS = (AUTO, REFERENCE, CPU, CUDA)


def available_backends() -> dict[str, str | None]:
    """Every backend but "auto", with None where it can run and else the reason why it cannot."""
    return {REFERENCE: None, CPU: _obstacle(import_cpu), CUDA: _obstacle(import_cuda)}


def import_cpu() -> ModuleType:
    """The numba backend. Raises BackendUnavailable, which says what is missing."""
    try:
        from augment.render import cpu
    except ImportError as error:
        raise BackendUnavailable(
            f"backend 'cpu' is unavailable: {error}. Install the package's dependencies (numba, "
            f"tbb), or use backend 'reference', which needs torch only and is far slower"
        ) from error
    return cpu


def import_cuda() -> ModuleType:
    """The Triton backend. Raises BackendUnavailable, which says what is missing."""
    from augment.render import gpu

    gpu.check_can_run()
    from augment.render import cuda

    return cuda


def kernels_for(backend: str, *images: Tensor | None) -> str:
    """Which kernels a pass over finished images takes: REFERENCE (plain torch), CPU or CUDA.

    Kernels are for float32 without gradients; all else is left to torch. AUTO follows the images:
    CUDA where they lie on a GPU.
    """
    given = [image for image in images if image is not None]
    if backend == REFERENCE or not all(_for_kernels(image) for image in given):
        return REFERENCE
    if backend == AUTO:
        return CUDA if any(image.device.type != "cpu" for image in given) else CPU
    return backend


def _for_kernels(image: Tensor) -> bool:
    tracked = torch.is_grad_enabled() and image.requires_grad
    return image.dtype == torch.float32 and not tracked


def _obstacle(importing: object) -> str | None:
    assert callable(importing)
    try:
        importing()
    except BackendUnavailable as error:
        return str(error)
    return None
