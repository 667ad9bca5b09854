"""Snow lit by its own normals on the GPU, all layers of a view in one launch."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from augment.effects.snow import light_layout as layout
from augment.effects.snow.near_camera import Layer
from augment.render.cuda import runtime as gpu
from augment.scene import Gaussians

_ALIGNED = 4  # splats: a layer's SH begin at a multiple of 16 bytes


@dataclass(frozen=True, eq=False)
class Light:
    """What is asked of layers with normals. rows, numbers: see light_layout. total: splats.
    tensors: what the rows' addresses point to, kept alive by this.
    """

    layers: Sequence[Layer]
    tensors: Sequence[Tensor]
    rows: np.ndarray
    numbers: np.ndarray
    total: int

    def run(self, rows: Tensor, numbers: Tensor) -> list[Gaussians]:
        """Every layer's Gaussians as they are lit; rows and numbers as they lie on the GPU."""
        from augment.effects.snow import cuda_light_kernels as kernels

        lit = torch.empty((self.total, 1, 3), dtype=torch.float32, device=rows.device)
        counts, slots = self.rows[:, layout.R_COUNT], self.rows[:, layout.R_SLOT]
        programs = -(-int(counts.max()) // layout.BLOCK)
        gpu.launch(
            kernels.light_splats,
            (programs, len(self.rows)),
            *(rows, numbers, lit),
            BLOCK=layout.BLOCK,
        )
        return [
            dataclasses.replace(layer.gaussians, sh=lit[slot : slot + count])
            for layer, slot, count in zip(self.layers, slots, counts, strict=True)
        ]


def plan_light(layers: Sequence[Layer], suns: np.ndarray, wrap: float) -> Light | None:
    """Of layers that have normals and splats; None where there are no layers.

    suns: unit, towards it, float64 [L, 3], in the layers' frames.
    """
    if not layers:
        return None
    rows = np.zeros((len(layers), layout.ROW), np.int64)
    tensors, slot = list[Tensor](), 0
    for row, layer in zip(rows, layers, strict=True):
        normals, slopes, sh = layer.normals, layer.slopes, layer.gaussians.sh
        assert normals is not None and slopes is not None
        own = [gpu.resident(tensor) for tensor in (normals, slopes, sh)]
        tensors += own
        row[:] = *(gpu.address_of(tensor) for tensor in own), len(normals), slot
        slot += -(-len(normals) // _ALIGNED) * _ALIGNED
    numbers = np.concatenate([suns, np.full((len(layers), 1), wrap)], 1)
    return Light(layers, tensors, rows, numbers.astype(np.float32), slot)
