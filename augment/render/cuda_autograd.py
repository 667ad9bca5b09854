"""The GPU rasteriser as a torch operation.

Colours' gradients, which are all that training a style network takes, are our own kernels': dL by
sh of every part from rgb, whatever other buffers are made beside it, since colours move none of
them. Gradients of means, quats, scales and opacities, from rgb, alpha and expected depth, are
gsplat's (augment.render.gsplat_backend), which is an extra. Camera and part poses get none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from augment.cameras import Camera
from augment.render.buffers import RGB, RenderOutput
from augment.render.constants import RasterSettings
from augment.render.cuda_blend import blend
from augment.render.cuda_blend_backward import color_gradients, sh_gradients
from augment.render.cuda_inputs import gather_inputs
from augment.render.cuda_project import project
from augment.render.cuda_tiles import list_tiles
from augment.render.gpu import resident
from augment.render.gsplat_backend import rasterize_gsplat, tracked_geometry
from augment.render.layout import M_FUNCTIONS, VIEW
from augment.scene import PosedGaussians


def rasterize_with_gradients(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    buffers: frozenset[str],
    settings: RasterSettings,
) -> RenderOutput:
    """As `cuda.rasterize_cuda` without smog and clip, recorded by autograd; no part has light per
    pixel or colour maps. buffers: some of DIFFERENTIABLE where geometry asks for gradients.

    The splats' records and the tiles' lists are kept until backward.

    Raises:
        BackendUnavailable: geometry asks for gradients, and gsplat is not installed.
    """
    if tracked_geometry(parts):
        return rasterize_gsplat(parts, camera, buffers, settings)
    names = tuple(sorted(buffers))
    setting = _Setting(tuple(_detached(part) for part in parts), camera, settings, names)
    images = _Rasterize.apply(setting, *[part.gaussians.sh for part in parts])
    return RenderOutput(**dict(zip(names, images, strict=True)))


@dataclasses.dataclass(frozen=True, eq=False)
class _Setting:
    """What an operation is told besides its tensors."""

    parts: tuple[PosedGaussians, ...]
    camera: Camera
    settings: RasterSettings
    buffers: tuple[str, ...]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, setting: _Setting, *shs: Tensor) -> tuple[Tensor, ...]:
        parts, camera, settings = setting.parts, setting.camera, setting.settings
        names = frozenset(setting.buffers)
        inputs = gather_inputs(parts, camera, settings, None, None, with_color=RGB in names)
        splats = project(inputs)
        tiles = list_tiles(splats, camera, None)
        images = blend(splats, tiles, camera, names, settings)
        ctx.setting, ctx.splats, ctx.tiles = setting, splats, tiles
        ctx.views, ctx.most = inputs.views.reshape(-1, VIEW), int(inputs.modes[M_FUNCTIONS])
        ctx.likenesses = [(sh.device, sh.shape[1]) for sh in shs]
        # Kept by autograd, so that a change in place before backward is noticed.
        ctx.save_for_backward(*[resident(part.gaussians.means) for part in parts])
        ctx.mark_non_differentiable(*[images[n] for n in setting.buffers if n != RGB])
        return tuple(images[name] for name in setting.buffers)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] - torch's own way
        ctx: Any, *d_images: Tensor
    ) -> tuple[Any, ...]:
        setting: _Setting = ctx.setting
        if RGB not in setting.buffers:
            return (None,) * (1 + len(setting.parts))
        d_rgb = d_images[setting.buffers.index(RGB)]
        d_colors = color_gradients(ctx.splats, ctx.tiles, setting.camera, setting.settings, d_rgb)
        out: list[Tensor | None] = [None]
        first = 0
        for number, means in enumerate(ctx.saved_tensors):
            device, functions = ctx.likenesses[number]
            own = d_colors[first : first + len(means)]
            first += len(means)
            if not ctx.needs_input_grad[1 + number]:
                out.append(None)
                continue
            used = min(ctx.most, functions)
            d_sh = sh_gradients(means, ctx.views[number], own, functions, used)
            out.append(d_sh.to(device))
        return tuple(out)


def _detached(part: PosedGaussians) -> PosedGaussians:
    sh = part.gaussians.sh.detach()
    return dataclasses.replace(part, gaussians=dataclasses.replace(part.gaussians, sh=sh))
