"""What the stages of the GPU rasteriser hand to each other. Tensors lie on the GPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from augment.cameras import Camera
from augment.memo import memo_of
from augment.render import layout
from augment.render.constants import RasterSettings
from augment.render.cuda.runtime import address_of, gpu_device, resident, upload, version_of
from augment.render.fog import Fog
from augment.render.layout import HeightClip
from augment.render.part_views import raster_modes, views_of
from augment.scene import Gaussians, PosedGaussians

# ---- What the GPU's projection reads: scene parts by address, and the numbers of a view ----------

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
    fog: Fog | None,
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
    modes = raster_modes(settings, fog, clip, with_color=with_color)
    modes[layout.M_LIGHT] = with_color and any(part.shading is not None for part in parts)
    views = views_of(parts, camera, settings, fog, clip)
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


class _Resident(NamedTuple):
    """Gaussians on the GPU, as `layout` lists what a part is read from. versions: of the tensors
    when that was.
    """

    versions: list[int | None]
    tensors: list[Tensor]
    addresses: list[int]


def _resident_gaussians(g: Gaussians, device: torch.device) -> _Resident:
    """Known of scenes' parts, which stay the same from frame to frame: asking for every tensor of
    every part anew would take longer than the GPU takes to project them.
    """
    given = (g.means, g.quats, g.scales, g.opacities, g.sh)
    versions = [version_of(tensor) for tensor in given]

    def read() -> _Resident:
        tensors = [_readable(tensor) for tensor in given]
        return _Resident(versions, tensors, [address_of(tensor) for tensor in tensors])

    if None in versions:
        return read()
    memo, key = memo_of(g), ("on the GPU", device)
    known = memo.get(key, read)
    if known.versions != versions:
        known = read()
        memo.put(key, known)
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


HIDDEN = 0x7F800000  # key of Gaussians that are not drawn: infinity's bits, behind all others
TILE = 16  # pixels a side


@dataclass(frozen=True, eq=False)
class CudaSplats:
    """All N Gaussians of all parts, by index; rows of those that are not drawn are not written.

    records: as augment.render.layout's RECORD. keys: bits of float32 z, HIDDEN where not drawn.
    rects: first tile of a splat, column + (row << 16), and its last, likewise; not written where it
    is not drawn. counts: how many tiles that is, 0 where not drawn. cuts: of a clip, as layout's
    CUT; None without one. lights: augment.render.shading's lines; None
    where no part is lit pixel by pixel or no colour is asked for.
    """

    records: Float32[Tensor, "N 16"]
    keys: Int32[Tensor, "N"]
    rects: Int32[Tensor, "N 2"]
    counts: Int32[Tensor, "N"]
    cuts: Float32[Tensor, "N 8"] | None
    lights: Float32[Tensor, "N 9"] | None


@dataclass(frozen=True, eq=False)
class CudaTiles:
    """Which splats each tile blends, nearest first, ties by index.

    tile_splat_ids: rows of CudaSplats, tile after tile. tile_offsets: int32 [tiles + 1]: tile i
    (row by row) owns tile_splat_ids[tile_offsets[i]:tile_offsets[i + 1]]. Tiles without a wanted
    pixel own none.
    """

    tile_splat_ids: Int32[Tensor, "E"]
    tile_offsets: Int32[Tensor, "T"]
    columns: int
    rows: int


class GpuStageTimer:
    """Times of a frame's stages on the GPU, by events, so that nothing waits until they are read.

    Where kernels are interpreted there is no GPU to time, and all are 0.
    """

    def __init__(self) -> None:
        self._names: list[str] = []
        self._events: list[torch.cuda.Event] = []
        self.counts: dict[str, int] = {}
        self._mark()

    def end_stage(self, name: str) -> None:
        """The time since the lap before belongs to `name`."""
        self._names.append(name)
        self._mark()

    def _mark(self) -> None:
        if torch.cuda.is_available():
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self._events.append(event)

    def milliseconds(self) -> dict[str, float]:
        """Waits for the GPU."""
        out = dict.fromkeys(self._names, 0.0)
        if self._events:
            self._events[-1].synchronize()
            for name, start, end in zip(
                self._names, self._events[:-1], self._events[1:], strict=True
            ):
                out[name] += start.elapsed_time(end)
        return out
