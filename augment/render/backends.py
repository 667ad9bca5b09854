"""The backends that work here, and the choice of one, once for a job, a viewer or a live dataset.

In: the name of a backend or `auto`, and a scene. Out: the name of a backend that works here.
`augment.render.rasterize` chooses for a single picture, from the tensors that it gets.
"""

from __future__ import annotations

from types import ModuleType

import torch

from augment.errors import BackendUnavailable
from augment.render.buffers import AUTO, BACKENDS, CPU, CUDA, REFERENCE
from augment.scene.scene import Scene


def choose_backend(backend: str, scene: Scene, *, gpu: bool = True) -> str:
    """Return the backend that will render the scene: `auto` resolved, any other name checked.

    It is resolved once for the whole job, so that a resumed job cannot mix backends in one folder.

    Args:
        backend: Name of a backend, or `auto`, which takes the GPU where there is one.
        gpu: If False, `auto` never takes the GPU.

    Raises:
        ValueError: There is no such backend.
        BackendUnavailable: It cannot run on this machine.
    """
    from augment.render.cuda.runtime import has_gpu

    if backend == AUTO:  # imports only what it uses: no triton without a GPU
        means = [scene.background.means, *(actor.gaussians.means for actor in scene.actors)]
        is_plain = all(m.dtype == torch.float32 and not m.requires_grad for m in means)
        if is_plain and gpu and has_gpu():
            return CUDA
        try:
            import_cpu()
        except BackendUnavailable:
            return REFERENCE
        return CPU if is_plain else REFERENCE
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    if backend == CPU:
        import_cpu()
    if backend == CUDA:  # only this name initialises the GPU
        import_cuda()
    return backend


def renders_on_gpu(backend: str) -> bool:
    """Return True if a job that names this backend renders on a GPU.

    `auto` does so where there is one.
    """
    if backend == AUTO:
        from augment.render.cuda.runtime import has_gpu

        return has_gpu()
    return backend == CUDA


def gpu_is_lost(backend: str) -> bool:
    """Return True if the GPU no longer answers this process, as after a faulty kernel.

    Every later call to the GPU fails then. Waits for the GPU.
    """
    if backend != CUDA or not torch.cuda.is_initialized():
        return False
    try:
        torch.cuda.synchronize()
    except RuntimeError:
        return True
    return False


def available_backends() -> dict[str, str | None]:
    """Return every backend but "auto": None if it can run here, else the reason why it cannot."""
    obstacles: dict[str, str | None] = {REFERENCE: None, CPU: None, CUDA: None}
    for backend, import_backend in ((CPU, import_cpu), (CUDA, import_cuda)):
        try:
            import_backend()
        except BackendUnavailable as error:
            obstacles[backend] = str(error)
    return obstacles


def import_cpu() -> ModuleType:
    """Import the numba backend.

    Raises:
        BackendUnavailable: a package is missing; the message names it.
    """
    try:
        from augment.render.cpu import driver as cpu
    except ImportError as error:
        raise BackendUnavailable(
            f"backend 'cpu' is unavailable: {error}. Install the package's dependencies (numba, "
            f"tbb), or use backend 'reference', which needs torch only and is far slower"
        ) from error
    return cpu


def import_cuda() -> ModuleType:
    """Import the Triton backend.

    Raises:
        BackendUnavailable: a package or a GPU is missing; the message names it.
    """
    from augment.render.cuda import runtime

    runtime.require_gpu()
    from augment.render.cuda import driver as cuda

    return cuda
