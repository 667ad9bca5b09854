"""Blending on the GPU: images from tiles' lists, in one launch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from augment.cameras import Camera
from augment.render import gpu, layout
from augment.render.buffers import (
    ALPHA,
    BUFFERS,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    RGB,
    SNOW,
    SPLAT_IDS,
)
from augment.render.constants import ALPHA_MIN, TRANSMITTANCE_STOP, RasterSettings
from augment.render.cuda_blend_kernels import blend_blocks
from augment.render.cuda_splats import TILE, CudaSplats, CudaTiles

# Pixels of a program, which is one warp. Larger blocks spend less on reading their lists, smaller
# ones less on pixels that a splat does not cover. Powers of 2; the warp's threads must fit into it.
_BLOCK_W, _BLOCK_H = 16, 8

# The kernel reads records and cuts four numbers at a time and names them in this order.
assert (layout.MEAN_X, layout.MEAN_Y, layout.LEAN_X, layout.SHARP_X) == (0, 1, 2, 3)
assert (layout.FALL_Y, layout.LOG_OPACITY, layout.LEAN_Y) == (4, 5, 8)
assert (layout.DEPTH, layout.SPLAT_ID) == (10, 11)
assert (layout.RED, layout.GREEN, layout.BLUE, layout.IS_SNOW) == (12, 13, 14, 15)
assert (layout.C_AT, layout.C_X, layout.C_Y, layout.C_RIGHT) == (0, 1, 2, 3)
assert (layout.C_DOWN, layout.C_REACH) == (4, 5)


def blend(
    splats: CudaSplats,
    tiles: CudaTiles,
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
) -> dict[str, Tensor]:
    """The images asked for, [H, W] each, rgb [H, W, 3], on the GPU."""
    images = {name: _empty(name, camera, splats) for name in buffers | {ALPHA}}
    least = min(settings.transmittance_stop, TRANSMITTANCE_STOP)
    per_tile = (TILE // _BLOCK_W) * (TILE // _BLOCK_H)
    none = images[ALPHA]  # stands for what is not there; nothing is read or written
    gpu.launch(
        blend_blocks,
        (tiles.columns * tiles.rows * per_tile,),
        splats.records,
        tiles.members,
        tiles.starts,
        none if splats.cuts is None else splats.cuts,
        none if splats.lights is None else splats.lights,
        *(images.get(name, none) for name in BUFFERS),
        camera.width,
        camera.height,
        tiles.columns,
        settings.alpha_max,
        math.log2(ALPHA_MIN),
        least,
        settings.transmittance_stop,
        float(camera.is_orthographic),
        settings.mode_depth_floor_m,
        camera.fx**-2,
        camera.fy**-2,
        HAS_CUTS=splats.cuts is not None,
        HAS_LIGHTS=splats.lights is not None and RGB in images,
        HAS_RGB=RGB in images,
        HAS_EXPECTED=EXPECTED_DEPTH in images,
        HAS_MEDIAN=MEDIAN_DEPTH in images,
        HAS_IDS=SPLAT_IDS in images,
        HAS_MODE=MODE_DEPTH in images,
        HAS_SNOW=SNOW in images,
        IS_COARSE=settings.transmittance_stop > least,
        BLOCK_W=_BLOCK_W,
        BLOCK_H=_BLOCK_H,
        num_warps=1,
    )
    return {name: images[name] for name in buffers}


def _empty(name: str, camera: Camera, splats: CudaSplats) -> Tensor:
    size = (camera.height, camera.width)
    return torch.empty(
        (*size, 3) if name == RGB else size,
        dtype=torch.int32 if name == SPLAT_IDS else torch.float32,
        device=splats.records.device,
    )
