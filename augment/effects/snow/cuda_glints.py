"""Glints of all snow in a view, found on the GPU in one launch, as `Crystals.glints` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from augment.effects.snow import glint_layout as layout
from augment.effects.snow.blocks import Blocks, blocks_of
from augment.effects.snow.cuda_constants import glint_columns, snow_classes
from augment.effects.snow.near_camera import FARTHEST_M, Crystals
from augment.render.cuda import runtime as gpu
from augment.scene import Gaussians

_ALIGNED = 4  # slots: a layer's arrays begin at a multiple of 16 bytes


@dataclass(frozen=True, eq=False)
class Glints:
    """What is asked of a view's crystals. rows, layers, numbers: see glint_layout. spans: first
    slot and number of slots of every layer, 0 where none of it is near. tensors: what the layers'
    addresses point to, kept alive by this.
    """

    rows: np.ndarray
    layers: np.ndarray
    numbers: np.ndarray
    spans: Sequence[tuple[int, int]]
    total: int
    tensors: Sequence[Tensor]

    def run(self, rows: Tensor, layers: Tensor, numbers: Tensor) -> list[Gaussians | None]:
        """Of every layer; None where it is too far for any. Arguments: as they lie on the GPU."""
        from augment.effects.snow import cuda_glints_kernels as kernels

        means = torch.empty((self.total, 3), dtype=torch.float32, device=rows.device)
        opacities = torch.empty(self.total, dtype=torch.float32, device=rows.device)
        gpu.launch(
            kernels.find_glints,
            (len(self.rows),),
            *(rows, layers, numbers, means, opacities),
            BLOCK=layout.BLOCK,
            num_warps=8,
        )
        out = list[Gaussians | None]()
        for first, count in self.spans:
            if not count:
                out.append(None)
                continue
            quats, scales, sh = glint_columns(count)
            own = slice(first, first + count)
            out.append(
                Gaussians(means[own], quats, scales, opacities[own], sh, snow_classes(count))
            )
        return out


def plan_glints(
    crystals: Sequence[Crystals | None], suns: np.ndarray, eyes_m: np.ndarray
) -> Glints | None:
    """What to ask of each layer's crystals; None where no layer has any near its eye.

    suns: unit, towards it; eyes_m: the camera's centre; float64 [L, 3], in the layers' frames.
    """
    rows, spans, slot, tensors = [], [], 0, list[Tensor]()
    layers = np.zeros((len(crystals), layout.ADDRESSES), np.int64)
    for number, (own, eye_m) in enumerate(zip(crystals, eyes_m, strict=True)):
        first = slot
        if own is not None and len(own.places_m):
            sorted_ = _sorted(own)
            own_tensors = [gpu.resident(sorted_.places), gpu.resident(sorted_.mirrors)]
            layers[number] = [gpu.address_of(tensor) for tensor in own_tensors]
            tensors += own_tensors
            near = sorted_.blocks.near(eye_m, FARTHEST_M)[0]
            counts = sorted_.blocks.counts(near)
            ends = np.cumsum(np.minimum(counts, layout.MOST))
            row = np.empty((len(near), layout.ROW), np.int32)
            row[:, layout.R_LAYER], row[:, layout.R_FIRST] = number, near * layout.BLOCK
            row[:, layout.R_COUNT] = counts
            row[:, layout.R_SLOT] = first + ends - np.minimum(counts, layout.MOST)
            rows.append(row)
            slot += int(ends[-1]) if len(near) else 0
        spans.append((first, slot - first))
        slot += -slot % _ALIGNED
    if not slot:
        return None
    numbers = np.zeros((len(crystals), layout.NUMBERS))
    coarse = eyes_m.astype(np.float32)
    numbers[:, layout.N_EYE :][:, :6] = np.concatenate([coarse, eyes_m - coarse], 1)
    numbers[:, layout.N_SUN :][:, :3] = suns
    numbers[:, layout.N_STRENGTH] = [0 if own is None else own.strength for own in crystals]
    return Glints(np.concatenate(rows), layers, numbers.astype(np.float32), spans, slot, tensors)


@dataclass(frozen=True, eq=False)
class _Sorted:
    """Crystals, neighbours beside each other. places, mirrors [G, 3]: in the blocks' order."""

    blocks: Blocks
    places: Tensor
    mirrors: Tensor


_known: WeakKeyDictionary[Crystals, _Sorted] = WeakKeyDictionary()


def _sorted(crystals: Crystals) -> _Sorted:
    """Worked out once for as long as the crystals live."""
    found = _known.get(crystals)
    if found is None:
        blocks = blocks_of(crystals.places_m.numpy(), layout.BLOCK)
        order = torch.from_numpy(blocks.order).long()
        found = _Sorted(blocks, crystals.places_m[order], crystals.mirrors[order])
        _known[crystals] = found
    return found
