"""The GPU rasteriser: stages in Triton, and the order in which they run.

    project   record, tiles and colour of every Gaussian                  (project_kernels)
    list      by z, ties by index; then the splats of every tile          (blend_kernels)
    blend     every tile's, front to back, into the images asked for      (blend_kernels)

No sum depends on the order in which programs run, so the same bits come out every time.
`rasterize` calls `rasterize_cuda`; `cuda.backward` uses the stages one by one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Int32
from torch import Tensor

from augment.render import layout, shading
from augment.render.buffers import ALPHA, BUFFERS, RGB, SPLAT_IDS, RenderOutput
from augment.render.constants import ALPHA_MIN, TRANSMITTANCE_STOP, RasterSettings
from augment.render.cuda import runtime
from augment.render.cuda.blend_kernels import blend_blocks, count_tiles, list_pairs
from augment.render.cuda.project_kernels import project_gaussians
from augment.render.cuda.runtime import launch
from augment.render.cuda.splats import (
    BLOCK,
    TILE,
    CudaInputs,
    CudaSplats,
    CudaStageTimer,
    CudaTiles,
    gather_inputs,
)
from augment.render.fog import Fog
from augment.render.layout import HeightClip
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians

# ---- The GPU's projection: splats of all Gaussians of all parts, in one launch -------------------


def project(inputs: CudaInputs) -> CudaSplats:
    """Return records, keys and tiles of all splats; cuts and lights too, if the modes ask."""
    count = inputs.count
    device = inputs.device
    modes = [int(mode) for mode in inputs.modes]

    def floats(columns: int) -> torch.Tensor:
        return torch.empty((count, columns), dtype=torch.float32, device=device)

    def ints(*shape: int) -> torch.Tensor:
        return torch.empty(shape, dtype=torch.int32, device=device)

    splats = CudaSplats(
        records=floats(layout.RECORD),
        keys=ints(count),
        rects=ints(count, 2),
        counts=ints(count),
        cuts=floats(layout.CUT) if modes[layout.M_CLIP] else None,
        lights=floats(shading.LINES) if modes[layout.M_LIGHT] else None,
    )
    launch(
        project_gaussians,
        (len(inputs.block_parts),),
        inputs.table,
        inputs.views,
        inputs.block_parts,
        (splats.records, splats.keys, splats.rects, splats.counts, splats.cuts, splats.lights),
        COLOR=modes[layout.M_COLOR],
        FUNCTIONS=modes[layout.M_NUM_SH_FUNCTIONS],
        ANTIALIASED=modes[layout.M_ANTIALIASED],
        FOG=modes[layout.M_FOG],
        BLOCK=BLOCK,
        num_warps=BLOCK // 32,
    )
    return splats


# ---- Tile lists: the splats that every tile blends, nearest first, ties by index -----------------
#     order    of the Gaussians by the bits of z                                stable sort
#     expand   every splat to its pairs with tiles, in that order               list_pairs
#     group    the pairs by tile, which leaves each tile's in order of depth    stable sort

# Splats of a program.
_SPLATS = 256
# Pairs of a program; a thread searches the owners of four pairs at a time.
_PAIRS = 512
# Largest number of pairs: a list begins at an int32 position, and some positions beyond are read.
_MAX_PAIRS = 2**31 - 1024


def list_tiles(splats: CudaSplats, camera: Camera, pixel_mask: Tensor | None) -> CudaTiles:
    """Return the lists of all tiles.

    This waits for the GPU once, to learn how many pairs there are.

    pixel_mask: bool [H, W]; tiles without a pixel of it get no list.

    Raises:
        ValueError: there are more pairs than an int32 can count.
    """
    columns = -(-camera.width // TILE)
    rows = -(-camera.height // TILE)
    count = len(splats.keys)
    tiles = columns * rows
    device = splats.keys.device
    is_drawn = (
        None if pixel_mask is None else _tiles_with_pixels(pixel_mask.to(device), columns, rows)
    )

    order = torch.sort(splats.keys, stable=True).indices
    counts = torch.empty(count, dtype=torch.int32, device=device)
    runtime.launch(
        count_tiles,
        (-(-count // _SPLATS),),
        order,
        splats.counts,
        splats.rects,
        None if is_drawn is None else _sums_from_corner(is_drawn),
        counts,
        count,
        columns,
        BLOCK=_SPLATS,
    )
    ends = torch.cumsum(counts, 0, dtype=torch.int64)
    pairs = int(ends[-1]) if count else 0
    if pairs > _MAX_PAIRS:
        raise ValueError(
            f"the {count} Gaussians touch {pairs} tiles of a {camera.width} x {camera.height} "
            f"image together, which is more than {_MAX_PAIRS}; render a smaller image, or fewer "
            f"or smaller Gaussians"
        )

    # The number after the last tile stands for all tiles that are not drawn.
    index_dtype = torch.int16 if tiles <= torch.iinfo(torch.int16).max else torch.int32
    tile_of = torch.empty(pairs, dtype=index_dtype, device=device)
    owners = torch.empty(pairs, dtype=torch.int32, device=device)
    runtime.launch(
        list_pairs,
        (-(-pairs // _PAIRS),),
        order,
        ends,
        splats.rects,
        is_drawn,
        tile_of,
        owners,
        pairs,
        count,
        count.bit_length(),
        columns,
        tiles,
        BLOCK=_PAIRS,
    )
    sorted_tiles, index = torch.sort(tile_of, stable=True)
    edges = torch.arange(tiles + 1, dtype=index_dtype, device=device)
    tile_offsets = torch.searchsorted(sorted_tiles, edges, out_int32=True)
    return CudaTiles(owners[index], tile_offsets, columns, rows)


def _tiles_with_pixels(
    pixel_mask: Bool[Tensor, "H W"], columns: int, rows: int
) -> Bool[Tensor, "R C"]:
    """Return the tiles with a pixel of the mask."""
    height, width = pixel_mask.shape
    padded = pixel_mask.new_zeros(rows * TILE, columns * TILE)
    padded[:height, :width] = pixel_mask
    return padded.reshape(rows, TILE, columns, TILE).any(3).any(1).contiguous()


def _sums_from_corner(is_drawn: Bool[Tensor, "R C"]) -> Int32[Tensor, "R1 C1"]:
    """Return the number of drawn tiles above and to the left of each corner."""
    sums = is_drawn.cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32)
    return torch.nn.functional.pad(sums, (1, 0, 1, 0))


# ---- Blending on the GPU: images from tiles' lists, in one launch --------------------------------

# Pixels of a program, which is one warp. Larger blocks spend less on reading their lists, smaller
# ones less on pixels that a splat does not cover. Powers of 2; the warp's threads must fit into it.
_BLOCK_W = 16
_BLOCK_H = 8

# The kernel reads records and cuts four numbers at a time and names them in this order.
assert (layout.MEAN_X, layout.MEAN_Y, layout.LEAN_X, layout.SHARP_X) == (0, 1, 2, 3)
assert (layout.FALL_Y, layout.LOG_OPACITY, layout.LEAN_Y) == (4, 5, 8)
assert (layout.DEPTH, layout.SPLAT_ID) == (10, 11)
assert (layout.RED, layout.GREEN, layout.BLUE, layout.IS_OVERLAY) == (12, 13, 14, 15)
assert (layout.C_VALUE, layout.C_X, layout.C_Y, layout.C_RIGHT) == (0, 1, 2, 3)
assert (layout.C_DOWN, layout.C_REACH) == (4, 5)


def blend(
    splats: CudaSplats,
    tiles: CudaTiles,
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
) -> dict[str, Tensor]:
    """Return the requested images, [H, W] each, rgb [H, W, 3], on the GPU."""
    images = {name: _empty(name, camera, splats) for name in buffers | {ALPHA}}
    per_tile = (TILE // _BLOCK_W) * (TILE // _BLOCK_H)
    runtime.launch(
        blend_blocks,
        (tiles.columns * tiles.rows * per_tile,),
        (splats.records, splats.cuts, splats.lights if RGB in images else None),
        tiles.tile_splat_ids,
        tiles.tile_offsets,
        tuple(images.get(name) for name in BUFFERS),
        *(camera.width, camera.height, limits_of(settings)),
        (float(camera.is_orthographic), settings.mode_depth_floor_m, camera.fx**-2, camera.fy**-2),
        IS_COARSE=settings.transmittance_stop > TRANSMITTANCE_STOP,
        BLOCK_W=_BLOCK_W,
        BLOCK_H=_BLOCK_H,
        num_warps=1,
    )
    return {name: images[name] for name in buffers}


def limits_of(settings: RasterSettings) -> tuple[float, float, float, float]:
    """Return the limits of blending, as blend_blocks names them."""
    stop = settings.transmittance_stop
    return settings.alpha_max, math.log2(ALPHA_MIN), min(stop, TRANSMITTANCE_STOP), stop


def _empty(name: str, camera: Camera, splats: CudaSplats) -> Tensor:
    size = (camera.height, camera.width)
    return torch.empty(
        (*size, 3) if name == RGB else size,
        dtype=torch.int32 if name == SPLAT_IDS else torch.float32,
        device=splats.records.device,
    )


def rasterize_cuda(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
    fog: Fog | None,
    clip: HeightClip | None = None,
    pixel_mask: torch.Tensor | None = None,
    *,
    timer: CudaStageTimer | None = None,
) -> RenderOutput:
    """Return the image of the parts in float32, on the GPU, without gradients.

    `rasterize` checks the arguments.

    Args:
        parts: Gaussians with their poses.
        camera: the camera.
        buffers: names of the buffers.
        settings: thresholds of the image.
        fog: fog before the splats; None for clear air.
        clip: height at which splats are cut; None for no cut.
        pixel_mask: bool [H, W]; tiles without a pixel of the mask are left out and hold zeros.
        timer: gets the ends of "project", "list" and "blend", and the counts "visible" (splats that
            touch a tile) and "pairs" (of splats and tiles).
    """
    inputs = gather_inputs(parts, camera, settings, fog, clip, with_color=RGB in buffers)
    splats = project(inputs)
    if timer is not None:
        timer.end_stage("project")
    tiles = list_tiles(splats, camera, pixel_mask)
    if timer is not None:
        timer.end_stage("list")
        timer.counts["visible"] = int((splats.counts > 0).sum())
        timer.counts["pairs"] = len(tiles.tile_splat_ids)
    images = blend(splats, tiles, camera, buffers, settings)
    if timer is not None:
        timer.end_stage("blend")
    return RenderOutput(**images)
