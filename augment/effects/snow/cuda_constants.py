"""Columns on the GPU that are the same for every splat of a kind: sent once, a frame takes as many
rows as it needs.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from augment.effects.snow.near_camera import SIZE_M
from augment.render.cuda import runtime as gpu
from augment.render.sh import SH_C0
from augment.semantics import SemanticClass

_FEWEST = 1 << 14  # rows that are sent at least


def snow_classes(count: int) -> Tensor:
    """int16 [count]"""
    return gpu.resident(_classes(_enough(count)))[:count]


def glint_columns(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Quaternions, scales and SH (white) of glints: [count, 4], [count, 3], [count, 1, 3]."""
    quats, scales, sh = (gpu.resident(column)[:count] for column in _glints(_enough(count)))
    return quats, scales, sh


def _enough(count: int) -> int:
    return max(_FEWEST, 1 << (count - 1).bit_length())


@cache
def _classes(rows: int) -> Tensor:
    return torch.full((rows,), int(SemanticClass.SNOW), dtype=torch.int16)


@cache
def _glints(rows: int) -> tuple[Tensor, Tensor, Tensor]:
    return (
        torch.tensor([[1.0, 0, 0, 0]]).repeat(rows, 1),
        torch.full((rows, 3), SIZE_M),
        torch.full((rows, 1, 3), 0.5 / SH_C0),
    )
