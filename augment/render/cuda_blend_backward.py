"""Gradients of colours on the GPU: the transposed blend, then the spherical harmonics.

    color_gradients(splats, tiles, camera, settings, d_rgb)   dL by every splat's colour
    sh_gradients(means, view, d_colors, functions, used)      dL by one part's sh

Only colours move: order, alpha and transmittance are constants of the image, so nothing of the
forward blend is kept but its lists. The same bits come out every time.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float32
from torch import Tensor

from augment.cameras import Camera
from augment.render import cuda_blend_backward_kernels as kernels
from augment.render.constants import ALPHA_MIN, TRANSMITTANCE_STOP, RasterSettings
from augment.render.cuda_splats import CudaSplats, CudaTiles
from augment.render.gpu import launch

# All pixels of a tile times BATCH entries in the registers of two warps: more entries do not fit,
# more warps wait for each other.
_BATCH, _TILE_WARPS = 8, 2
# Most splats are in few tiles; one that is in all must not take long either.
_SPLATS, _LANES = 8, 16
_SH_SPLATS = 32


def color_gradients(
    splats: CudaSplats,
    tiles: CudaTiles,
    camera: Camera,
    settings: RasterSettings,
    d_rgb: Float32[Tensor, "H W 3"],
) -> Float32[Tensor, "N 3"]:
    """dL by the colours that spherical harmonics make, 0 where the clamp at 0 holds them.

    d_rgb: dL by the image that `blend` makes of the splats, without cuts and light per pixel.
    """
    entries, count = len(tiles.members), len(splats.keys)
    device = splats.keys.device
    d_colors = torch.zeros(count, 3, device=device)
    if entries == 0:
        return d_colors
    shares = torch.zeros(3, entries, device=device)
    launch(
        kernels.share_colors,
        (tiles.columns * tiles.rows,),
        splats.records,
        tiles.members,
        tiles.starts,
        d_rgb.contiguous(),
        shares,
        camera.width,
        camera.height,
        tiles.columns,
        settings.alpha_max,
        math.log2(ALPHA_MIN),
        min(settings.transmittance_stop, TRANSMITTANCE_STOP),
        settings.transmittance_stop,
        BATCH=_BATCH,
        num_warps=_TILE_WARPS,
    )
    owners, order = torch.sort(tiles.members, stable=True)  # lists are tile after tile
    bounds = torch.arange(count + 1, dtype=owners.dtype, device=device)
    launch(
        kernels.sum_shares,
        (-(-count // _SPLATS),),
        shares,
        order,
        torch.searchsorted(owners, bounds),
        splats.records,
        d_colors,
        count,
        entries,
        SPLATS=_SPLATS,
        LANES=_LANES,
        num_warps=1,
    )
    return d_colors


def sh_gradients(
    means: Float32[Tensor, "M 3"],
    view: Float32[Tensor, "V"],
    d_colors: Float32[Tensor, "M 3"],
    functions: int,
    used: int,
) -> Float32[Tensor, "M K 3"]:
    """dL by sh [M, K = functions, 3] of a part, of which the camera's view is `view` (layout's
    V_*); 0 in functions from `used` on.
    """
    values = 3 * functions
    d_sh = torch.empty(len(means), functions, 3, device=means.device)
    launch(
        kernels.spread_to_sh,
        (-(-len(means) // _SH_SPLATS),),
        means,
        view,
        d_colors,
        d_sh,
        len(means),
        used,
        SPLATS=_SH_SPLATS,
        VALUES=values,
        COLUMNS=1 << (values - 1).bit_length(),
    )
    return d_sh
