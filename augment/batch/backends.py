"""Which rasteriser backend a job renders with."""

from __future__ import annotations

import torch

from augment.errors import BackendUnavailable
from augment.scene import Scene


def choose_backend(backend: str, scene: Scene) -> str:
    """The backend that will render the scene: `auto` resolved, any other name checked. `auto` takes
    the GPU where there is one.

    Resolved once for the whole job, so that a resumed job cannot mix backends in one folder.

    Raises:
        ValueError: no such backend. BackendUnavailable: it cannot run on this machine.
    """
    from augment.render.backends import available_backends
    from augment.render.gpu import has_gpu

    obstacles = available_backends()
    if backend == "auto":
        means = [scene.background.means, *(actor.gaussians.means for actor in scene.actors)]
        plain = all(m.dtype == torch.float32 and not m.requires_grad for m in means)
        if plain and has_gpu():
            return "cuda"
        return "cpu" if plain and obstacles["cpu"] is None else "reference"
    if backend not in obstacles:
        raise ValueError(f"backend must be one of auto, {', '.join(obstacles)}; got {backend!r}")
    obstacle = obstacles[backend]
    if obstacle is not None:
        raise BackendUnavailable(obstacle)
    return backend
