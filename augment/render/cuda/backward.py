"""The GPU rasteriser as a torch operation.

Training a style network needs the gradients of colours only. They come from our own kernels: dL by
sh of every part from rgb. Other buffers may be made beside it, since colours change none of them.
Gradients of means, quats, scales and opacities, from rgb, alpha and expected depth, come from
gsplat (augment.render.gsplat_backend), which is an extra. Camera and part poses have no gradients.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float32
from torch import Tensor

from augment.render.buffers import EXPECTED_DEPTH, RGB, RenderOutput
from augment.render.constants import RasterSettings
from augment.render.cuda import blend_kernels as kernels
from augment.render.cuda.driver import blend, limits_of, list_tiles, project
from augment.render.cuda.runtime import gpu_copy, launch
from augment.render.cuda.splats import CudaSplats, CudaTiles, gather_inputs
from augment.render.gsplat_backend import render_with_gsplat, tracked_geometry
from augment.render.layout import M_NUM_SH_FUNCTIONS, VIEW
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians

# ---- Gradients of colours on the GPU: the transposed blend, then the spherical harmonics ---------
#     color_gradients(splats, tiles, camera, settings, d_rgb)   dL by every splat's colour
#     sh_gradients(means, view, d_colors, ...)                  dL by one part's sh
#
# Only colours move: order, alpha and transmittance are constants of the image, so nothing of the
# forward blend is kept but its lists. The same bits come out every time.

# Entries of a tile's list that are processed at a time. All pixels of a tile times _BATCH entries
# lie in the registers of two warps: more entries do not fit, and more warps wait for each other.
_BATCH = 8
# Warps of a program.
_TILE_WARPS = 2
# Splats of a program that adds up shares.
_SPLATS = 8
# Sums of each splat. Most splats are in few tiles, but a splat in all of them must be fast, too.
_LANES = 16
# Splats of a program that computes gradients of sh.
_SH_SPLATS = 32


def color_gradients(
    splats: CudaSplats,
    tiles: CudaTiles,
    camera: Camera,
    settings: RasterSettings,
    d_rgb: Float32[Tensor, "H W 3"],
) -> Float32[Tensor, "N 3"]:
    """Return dL by the colours of the spherical harmonics, 0 where the clamp at 0 holds them.

    d_rgb: dL by the image that `blend` makes of the splats, without cuts and light per pixel.
    """
    entries = len(tiles.tile_splat_ids)
    count = len(splats.keys)
    device = splats.keys.device
    d_colors = torch.zeros(count, 3, device=device)
    if entries == 0:
        return d_colors
    shares = torch.zeros(3, entries, device=device)
    launch(
        kernels.share_colors,
        (tiles.columns * tiles.rows,),
        splats.records,
        tiles.tile_splat_ids,
        tiles.tile_offsets,
        d_rgb.contiguous(),
        shares,
        camera.width,
        camera.height,
        limits_of(settings),
        BATCH=_BATCH,
        num_warps=_TILE_WARPS,
    )
    owners, order = torch.sort(tiles.tile_splat_ids, stable=True)  # lists are tile after tile
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
    num_stored_functions: int,
    num_functions: int,
) -> Float32[Tensor, "M K 3"]:
    """Return dL by the sh of a part, [M, K, 3]; 0 in functions from `num_functions` on.

    view: numbers of the camera's view of the part (layout's V_*).
    """
    values = 3 * num_stored_functions
    d_sh = torch.empty(len(means), num_stored_functions, 3, device=means.device)
    launch(
        kernels.spread_to_sh,
        (-(-len(means) // _SH_SPLATS),),
        means,
        view,
        d_colors,
        d_sh,
        len(means),
        num_functions,
        SPLATS=_SH_SPLATS,
        VALUES=values,
        COLUMNS=1 << (values - 1).bit_length(),
    )
    return d_sh


def rasterize_with_gradients(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
) -> RenderOutput:
    """Return `cuda.rasterize_cuda` without fog and clip, recorded by autograd.

    No part has light per pixel or colour maps. The splats' records and the tiles' lists are kept
    until backward.

    buffers: some of DIFFERENTIABLE if geometry requires gradients.

    Raises:
        BackendUnavailable: geometry requires gradients, and gsplat is not installed.
    """
    if tracked_geometry(parts):
        gsplat_images = render_with_gsplat(
            parts, camera, settings, with_depth=EXPECTED_DEPTH in buffers
        )
        return RenderOutput(**{name: getattr(gsplat_images, name) for name in buffers})
    names = tuple(sorted(buffers))
    arguments = _OperationArguments(
        tuple(_detached(part) for part in parts), camera, settings, names
    )
    images = _Rasterize.apply(arguments, *[part.gaussians.sh for part in parts])
    return RenderOutput(**dict(zip(names, images, strict=True)))


class _OperationArguments(NamedTuple):
    """Arguments of an operation besides its tensors."""

    parts: tuple[PosedGaussians, ...]
    camera: Camera
    settings: RasterSettings
    buffers: tuple[str, ...]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, arguments: _OperationArguments, *shs: Tensor) -> tuple[Tensor, ...]:
        parts = arguments.parts
        camera = arguments.camera
        settings = arguments.settings
        names = frozenset(arguments.buffers)
        inputs = gather_inputs(parts, camera, settings, None, None, with_color=RGB in names)
        splats = project(inputs)
        tiles = list_tiles(splats, camera, None)
        images = blend(splats, tiles, camera, names, settings)
        ctx.arguments = arguments
        ctx.splats = splats
        ctx.tiles = tiles
        ctx.views = inputs.views.reshape(-1, VIEW)
        ctx.max_functions = int(inputs.modes[M_NUM_SH_FUNCTIONS])
        ctx.sh_layouts = [(sh.device, sh.shape[1]) for sh in shs]
        # Kept by autograd, so that a change in place before backward is noticed.
        ctx.save_for_backward(*[gpu_copy(part.gaussians.means) for part in parts])
        ctx.mark_non_differentiable(*[images[n] for n in arguments.buffers if n != RGB])
        return tuple(images[name] for name in arguments.buffers)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] - torch's own way
        ctx: Any, *d_images: Tensor
    ) -> tuple[Any, ...]:
        arguments: _OperationArguments = ctx.arguments
        if RGB not in arguments.buffers:
            return (None,) * (1 + len(arguments.parts))
        d_rgb = d_images[arguments.buffers.index(RGB)]
        d_colors = color_gradients(
            ctx.splats, ctx.tiles, arguments.camera, arguments.settings, d_rgb
        )
        gradients: list[Tensor | None] = [None]
        first = 0
        for number, means in enumerate(ctx.saved_tensors):
            device, num_stored_functions = ctx.sh_layouts[number]
            part_d_colors = d_colors[first : first + len(means)]
            first += len(means)
            if not ctx.needs_input_grad[1 + number]:
                gradients.append(None)
                continue
            num_functions = min(ctx.max_functions, num_stored_functions)
            d_sh = sh_gradients(
                means, ctx.views[number], part_d_colors, num_stored_functions, num_functions
            )
            gradients.append(d_sh.to(device))
        return tuple(gradients)


def _detached(part: PosedGaussians) -> PosedGaussians:
    sh = part.gaussians.sh.detach()
    return dataclasses.replace(part, gaussians=dataclasses.replace(part.gaussians, sh=sh))
