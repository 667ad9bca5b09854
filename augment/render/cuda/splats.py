"""Records that the stages of the GPU rasteriser hand to each other. Tensors lie on the GPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from augment.memo import memo_of
from augment.render import layout
from augment.render.constants import RasterSettings
from augment.render.cuda.runtime import address_of, gpu_copy, gpu_device, upload, version_of
from augment.render.fog import Fog
from augment.render.layout import HeightClip
from augment.render.part_views import raster_modes, views_of
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians

# ---- Inputs of the GPU's projection: scene parts by address, and the numbers of a view -----------

# Gaussians that one program projects, all of one part.
BLOCK = 128

# A part's row in the table: NUM_ADDRESSES (see layout), its Gaussians, the SH functions of each,
# and how many Gaussians and how many programs the parts before it take.
T_COUNT, T_FUNCTIONS, T_FIRST, T_BLOCK = range(layout.NUM_ADDRESSES, layout.NUM_ADDRESSES + 4)
COLUMNS = T_BLOCK + 1


@dataclass(frozen=True, eq=False)
class CudaInputs:
    """All P parts for one launch. Nothing is concatenated, and actors cost no launch of their own.

    table: rows of COLUMNS numbers, as listed above.
    views: see layout.
    block_parts: the part of every program.
    count: Gaussians of all parts.
    modes: see layout; they stay on the CPU.
    tensors: owners of the memory that the addresses point to.
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
    """Return addresses and numbers of all parts.

    Tensors are copied to the GPU the first time only; each frame has one small upload.
    """
    device = gpu_device()
    tensors: list[Tensor] = []
    rows: list[list[int]] = []
    for part in parts:
        gaussians = _resident_gaussians(part.gaussians, device)
        appearance = [
            None if tensor is None else _as_kernel_tensor(tensor)
            for tensor in _appearance_tensors(part)
        ]
        tensors += gaussians.tensors + [tensor for tensor in appearance if tensor is not None]
        addresses = [0 if tensor is None else address_of(tensor) for tensor in appearance]
        rows.append([*gaussians.addresses, *addresses, *part.gaussians.sh.shape[:2], 0, 0])
    table = np.array(rows, np.int64)
    blocks = -(-table[:, T_COUNT] // BLOCK)
    for column, sizes in ((T_FIRST, table[:, T_COUNT]), (T_BLOCK, blocks)):
        table[1:, column] = np.cumsum(sizes[:-1])
    modes = raster_modes(settings, fog, clip, with_color=with_color)
    modes[layout.M_LIGHT] = with_color and any(part.shading is not None for part in parts)
    views = views_of(parts, camera, settings, fog, clip)
    block_parts = np.repeat(np.arange(len(parts), dtype=np.int32), blocks)
    upload_buffer = upload(
        np.concatenate([*(a.reshape(-1).view(np.int32) for a in (table, views)), block_parts])
    )
    views_start = 2 * table.size
    parts_start = 2 * table.size + views.size
    return CudaInputs(
        table=upload_buffer[:views_start].view(torch.int64),
        views=upload_buffer[views_start:parts_start].view(torch.float32),
        block_parts=upload_buffer[parts_start:],
        count=int(table[:, T_COUNT].sum()),
        modes=modes,
        tensors=tensors,
    )


class _Resident(NamedTuple):
    """Gaussians on the GPU, as `layout` lists the arrays of a part.

    versions: versions of the tensors when the addresses were taken.
    """

    versions: list[int | None]
    tensors: list[Tensor]
    addresses: list[int]


def _resident_gaussians(gaussians: Gaussians, device: torch.device) -> _Resident:
    """Return Gaussians on the GPU, cached for the parts of scenes.

    The parts stay the same from frame to frame. Looking up every tensor of every part again would
    take longer than the GPU takes to project them.
    """
    sources = (
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
    )
    versions = [version_of(tensor) for tensor in sources]

    def copy_to_gpu() -> _Resident:
        tensors = [_as_kernel_tensor(tensor) for tensor in sources]
        return _Resident(versions, tensors, [address_of(tensor) for tensor in tensors])

    if None in versions:
        return copy_to_gpu()
    memo = memo_of(gaussians)
    key = ("on the GPU", device)
    gpu_gaussians = memo.get(key, copy_to_gpu)
    if gpu_gaussians.versions != versions:
        gpu_gaussians = copy_to_gpu()
        memo.put(key, gpu_gaussians)
    return gpu_gaussians


def _appearance_tensors(part: PosedGaussians) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Return the arrays of a part besides its Gaussians, as `layout` lists them."""
    slopes = None if part.shading is None else part.shading.slopes
    return slopes, part.color_maps, part.color_map_rows


def _as_kernel_tensor(tensor: Tensor) -> Tensor:
    """Return the tensor on the GPU: float32, or int16 if it is."""
    if tensor.is_floating_point() and tensor.dtype != torch.float32:
        tensor = tensor.to(torch.float32)
    return gpu_copy(tensor)


# Key of Gaussians that are not drawn: the bits of infinity, behind all other keys.
HIDDEN = 0x7F800000
# Side of a tile, pixels.
TILE = 16


@dataclass(frozen=True, eq=False)
class CudaSplats:
    """All N Gaussians of all parts, by index. Rows of Gaussians that are not drawn are not written.

    records: RECORD numbers, see layout.
    keys: bits of float32 z, HIDDEN if not drawn.
    rects: first tile of a splat, column + (row << 16), and its last tile in the same form.
    counts: number of these tiles, 0 if not drawn.
    cuts: CUT numbers, see layout; None without a clip.
    lights: LINES numbers, see augment.render.shading; None if no part is lit pixel by pixel or no
        colour is asked for.
    """

    records: Float32[Tensor, "N 16"]
    keys: Int32[Tensor, "N"]
    rects: Int32[Tensor, "N 2"]
    counts: Int32[Tensor, "N"]
    cuts: Float32[Tensor, "N 8"] | None
    lights: Float32[Tensor, "N 9"] | None


@dataclass(frozen=True, eq=False)
class CudaTiles:
    """The splats that each tile blends, nearest first, ties by index.

    tile_splat_ids: rows of CudaSplats, tile after tile.
    tile_offsets: int32 [tiles + 1]. Tile i (row by row) has
        tile_splat_ids[tile_offsets[i]:tile_offsets[i + 1]]; tiles that are not drawn have none.
    columns: number of tile columns.
    rows: number of tile rows.
    """

    tile_splat_ids: Int32[Tensor, "E"]
    tile_offsets: Int32[Tensor, "T"]
    columns: int
    rows: int


class CudaStageTimer:
    """Times of a frame's stages on the GPU, by events, so that nothing waits until they are read.

    If kernels are interpreted there is no GPU to time, and all times are 0.
    """

    def __init__(self) -> None:
        self._names: list[str] = []
        self._events: list[torch.cuda.Event] = []
        self.counts: dict[str, int] = {}
        self._mark()

    def end_stage(self, name: str) -> None:
        """Add the time since the last end of a stage to `name`."""
        self._names.append(name)
        self._mark()

    def _mark(self) -> None:
        if torch.cuda.is_available():
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self._events.append(event)

    def milliseconds(self) -> dict[str, float]:
        """Wait for the GPU and return the milliseconds of every stage."""
        out = dict.fromkeys(self._names, 0.0)
        if self._events:
            self._events[-1].synchronize()
            for name, start, end in zip(
                self._names, self._events[:-1], self._events[1:], strict=True
            ):
                out[name] += start.elapsed_time(end)
        return out
