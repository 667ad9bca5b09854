"""Launches the GPU's kernel that folds colour maps into spherical harmonics."""

from __future__ import annotations

from jaxtyping import Float32, Int16
from torch import Tensor

from augment.effects.style import cuda_sh_kernels
from augment.render import sh as sh_layout
from augment.render.cuda import runtime

_QUADS = 256  # of four colours, a program


def map_sh(
    sh: Float32[Tensor, "N K 3"],
    target: Float32[Tensor, "N K 3"],
    classes: Int16[Tensor, "N"] | None,
    folded: Float32[Tensor, "C 13"],
) -> None:
    """target = sh mapped; it may be sh itself. Both lie contiguous on the GPU.

    classes: rows of folded, which no splat goes beyond; None where all take the first. Both may lie
    on either side.
    """
    numbers, functions = sh.numel(), sh.shape[1]
    runtime.launch(
        cuda_sh_kernels.map_sh,
        (-(-numbers // (12 * _QUADS)),),
        sh,
        target,
        numbers,
        None if classes is None else runtime.resident(classes),
        runtime.upload(folded),
        float(sh_layout.BLACK),
        FUNCTIONS=functions,
        BY_CLASS=classes is not None,
        BLOCK=_QUADS,
        num_warps=4,
    )
