"""What shines through pixels that a raised transmittance stop has finished: more of the same.

Behind the stop nothing has been blended, so at most this share of a pixel is unknown. Left
transparent it would show the sky through every wall; instead, what the pixel has blended stands for
it: rgb and snow are divided by alpha, which becomes 1. At the default stop and below nothing is
done: 1e-4 is less than 8 bits show, and gsplat leaves it transparent, too.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from augment.render.backends import CPU, CUDA, kernels_for
from augment.render.buffers import RenderOutput
from augment.render.constants import TRANSMITTANCE_STOP


def needs_remainder(stop: float) -> bool:
    return stop > TRANSMITTANCE_STOP


def share_remainder(output: RenderOutput, stop: float, *, backend: str = CPU) -> RenderOutput:
    """Pixels of alpha >= 1 - stop become opaque. output: with alpha; written to by kernels.

    backend: with kernels, float32 without gradients goes through them, equal within float rounding.
    """
    alpha = output.alpha
    assert alpha is not None
    images = {name: getattr(output, name) for name in ("rgb", "snow")}
    images = {name: image for name, image in images.items() if image is not None}
    kernels = kernels_for(backend, alpha, *images.values())
    if kernels == CPU:
        _by_kernel(alpha, images, stop)
        return output
    if kernels == CUDA:
        from augment.render import cuda_composite

        cuda_composite.share_remainder(alpha, images.get("rgb"), images.get("snow"), stop)
        return output
    finished = alpha >= 1 - stop
    scale = torch.where(finished, 1 / alpha.clamp_min(1 - stop), torch.ones_like(alpha))
    scaled = {
        name: image * (scale[..., None] if image.ndim == 3 else scale)
        for name, image in images.items()
    }
    opaque = torch.where(finished, torch.ones_like(alpha), alpha)
    return dataclasses.replace(output, alpha=opaque, **scaled)


def _by_kernel(alpha: Tensor, images: dict[str, Tensor], stop: float) -> None:
    from augment.render import remainder_kernels
    from augment.render.threads import kernel_threads

    flat = {name: image.numpy().reshape(-1) for name, image in images.items()}
    none = np.empty(0, np.float32)
    with kernel_threads():
        remainder_kernels.share_remainder(
            alpha.numpy().reshape(-1),
            flat.get("rgb", none),
            flat.get("snow", none),
            np.float32(1 - stop),
        )
