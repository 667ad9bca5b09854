"""The choice of the backend that renders, once for a whole job, a viewer or a live dataset.

In: the name of a backend or `auto`, and a scene. Out: the name of a backend that works here.
`augment.render.rasterize` chooses for a single picture, from the tensors that it gets.
"""

from __future__ import annotations

import torch

from augment.errors import BackendUnavailable
from augment.render.buffers import AUTO, BACKENDS, CPU, CUDA, REFERENCE, import_cpu, import_cuda
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
