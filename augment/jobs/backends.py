"""Which rasteriser backend a job renders with."""

from __future__ import annotations

import torch

from augment.errors import BackendUnavailable
from augment.render.buffers import AUTO, BACKENDS, CPU, CUDA, REFERENCE, import_cpu, import_cuda
from augment.scene import Scene


def choose_backend(backend: str, scene: Scene, *, gpu: bool = True) -> str:
    """The backend that will render the scene: `auto` resolved, any other name checked. `auto` takes
    the GPU where there is one, unless `gpu` says that it must not. Resolved once for the whole job,
    so that a resumed job cannot mix backends in one folder. Raises ValueError: no such backend.
    BackendUnavailable: it cannot run on this machine.
    """
    from augment.render.cuda.runtime import has_gpu

    if backend == AUTO:  # asks for no more than it takes: nothing of triton without a GPU
        means = [scene.background.means, *(actor.gaussians.means for actor in scene.actors)]
        plain = all(m.dtype == torch.float32 and not m.requires_grad for m in means)
        if plain and gpu and has_gpu():
            return CUDA
        try:
            import_cpu()
        except BackendUnavailable:
            return REFERENCE
        return CPU if plain else REFERENCE
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    if backend == CPU:
        import_cpu()
    if backend == CUDA:  # only who names the GPU wakes it
        import_cuda()
    return backend


def gpu_is_lost(backend: str) -> bool:
    """Whether the GPU no longer answers this process, as after a kernel that went astray: then
    nothing succeeds that is asked of it later. Waits for the GPU.
    """
    if backend != CUDA or not torch.cuda.is_initialized():
        return False
    try:
        torch.cuda.synchronize()
    except RuntimeError:
        return True
    return False


def renders_on_gpu(backend: str) -> bool:
    """Whether a job that names this backend draws on a GPU: `auto` does where there is one."""
    if backend == AUTO:
        from augment.render.cuda.runtime import has_gpu

        return has_gpu()
    return backend == CUDA
