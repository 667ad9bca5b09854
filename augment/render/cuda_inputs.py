"""What the GPU's projection reads: scene parts by address, and the numbers of a view."""

from __future__ import annotations

import weakref
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
from augment.render.gpu import address_of, gpu_device, resident, upload, version_of
from augment.render.part_views import raster_modes, views_of
from augment.scene import Gaussians, PosedGaussians
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
    device = gpu_device()
    tensors: list[Tensor] = []
    rows: list[list[int]] = []
    for part in parts:
        gaussians = _resident_gaussians(part.gaussians, device)
        others = [None if tensor is None else _readable(tensor) for tensor in _looks(part)]
        tensors += gaussians.tensors + [tensor for tensor in others if tensor is not None]
        addresses = [0 if tensor is None else address_of(tensor) for tensor in others]
        rows.append([*gaussians.addresses, *addresses, *part.gaussians.sh.shape[:2], 0, 0])
    table = np.array(rows, np.int64)
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


@dataclass(frozen=True, eq=False)
class _Resident:
    """Gaussians on the GPU, as `layout` lists what a part is read from. versions: of the tensors
    when that was.
    """

    device: torch.device
    versions: list[int | None]
    tensors: list[Tensor]
    addresses: list[int]


# Of scenes' parts, which stay the same from frame to frame: asking for every tensor of every part
# anew would take longer than the GPU takes to project them.
_known: weakref.WeakKeyDictionary[Gaussians, _Resident] = weakref.WeakKeyDictionary()


def _resident_gaussians(gaussians: Gaussians, device: torch.device) -> _Resident:
    g = gaussians
    given = (g.means, g.quats, g.scales, g.opacities, g.sh)
    versions = [version_of(tensor) for tensor in given]
    known = _known.get(g)
    if known is not None and known.versions == versions and known.device == device:
        return known
    tensors = [_readable(tensor) for tensor in given]
    known = _Resident(device, versions, tensors, [address_of(tensor) for tensor in tensors])
    if None not in versions:
        _known[g] = known
    return known


def _looks(part: PosedGaussians) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """What a part is read from besides its Gaussians, as `layout` lists it."""
    slopes = None if part.shading is None else part.shading.slopes
    return slopes, part.color_maps, part.map_rows


def _readable(tensor: Tensor) -> Tensor:
    """Float32, or int16 as it is, on the GPU."""
    if tensor.is_floating_point() and tensor.dtype != torch.float32:
        tensor = tensor.to(torch.float32)
    return resident(tensor)
