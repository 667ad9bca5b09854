"""What the GPU's projection reads: scene parts by address, and the numbers of a view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from augment.cameras import Camera
from augment.render import layout
from augment.render.clip import HeightClip
from augment.render.constants import RasterSettings
from augment.render.gpu import address_of, resident, upload
from augment.render.part_views import raster_modes, views_of
from augment.scene import PosedGaussians
from augment.weather.smog import SmogMedium

BLOCK = 128  # Gaussians that one program projects, all of one part

# A part's row in the table: ADDRESSES (see layout), its Gaussians, the SH functions of each, and
# how many Gaussians and how many programs the parts before it take.
T_COUNT, T_FUNCTIONS, T_FIRST, T_BLOCK = range(layout.ADDRESSES, layout.ADDRESSES + 4)
COLUMNS = T_BLOCK + 1


@dataclass(frozen=True, eq=False)
class CudaInputs:
    """All P parts for one launch: nothing is concatenated, and actors cost no launch of their own.

    table: rows as above. views, modes: see layout; modes stay on the CPU. block_parts: the part of
    every program. count: Gaussians of all parts. tensors: what the addresses point to, kept alive
    by this.
    """

    table: Int64[Tensor, "R"]
    views: Float32[Tensor, "V"]
    block_parts: Int32[Tensor, "B"]
    count: int
    modes: np.ndarray
    tensors: list[Tensor]

    @property
    def device(self) -> torch.device:
        return self.table.device


def gather_inputs(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    smog: SmogMedium | None,
    clip: HeightClip | None = None,
    *,
    with_color: bool,
) -> CudaInputs:
    """Addresses and numbers of all parts. Tensors are copied to the GPU the first time only; per
    frame there is one small upload.
    """
    tensors: list[Tensor] = []
    table = np.zeros((len(parts), COLUMNS), np.int64)
    for row, part in zip(table, parts, strict=True):
        for column, tensor in _read_of(part).items():
            own = _aligned(resident(tensor))
            tensors.append(own)
            row[column] = address_of(own)
        row[T_COUNT], row[T_FUNCTIONS] = part.gaussians.sh.shape[:2]
    blocks = -(-table[:, T_COUNT] // BLOCK)
    for column, sizes in ((T_FIRST, table[:, T_COUNT]), (T_BLOCK, blocks)):
        table[1:, column] = np.cumsum(sizes[:-1])
    modes = raster_modes(settings, smog, clip, with_color=with_color)
    modes[layout.M_LIGHT] = with_color and any(part.shading is not None for part in parts)
    views = views_of(parts, camera, settings, smog, clip)
    block_parts = np.repeat(np.arange(len(parts), dtype=np.int32), blocks)
    packed = upload(np.concatenate([*(a.reshape(-1).view(np.int32) for a in (table, views)),
                                    block_parts]))  # fmt: skip
    views_at, parts_at = 2 * table.size, 2 * table.size + views.size
    return CudaInputs(
        table=packed[:views_at].view(torch.int64),
        views=packed[views_at:parts_at].view(torch.float32),
        block_parts=packed[parts_at:],
        count=int(table[:, T_COUNT].sum()),
        modes=modes,
        tensors=tensors,
    )


def _aligned(tensor: Tensor) -> Tensor:
    """The tensor, or a copy of it where it begins at no multiple of 16 bytes, as within another."""
    return tensor if address_of(tensor) % 16 == 0 else tensor.clone()


def _read_of(part: PosedGaussians) -> dict[int, Tensor]:
    """What a part is read from, by its column in the table."""
    g = part.gaussians
    floats = {
        layout.A_MEANS: g.means,
        layout.A_QUATS: g.quats,
        layout.A_SCALES: g.scales,
        layout.A_OPACITIES: g.opacities,
        layout.A_SH: g.sh,
    }
    if part.shading is not None:
        floats[layout.A_SLOPES] = part.shading.slopes
    if part.color_maps is not None:
        floats[layout.A_MAPS] = part.color_maps
    read = {column: tensor.to(torch.float32) for column, tensor in floats.items()}
    if part.map_rows is not None:
        read[layout.A_ROWS] = part.map_rows
    return read
