"""What gsplat 1.5.3 would do, by the definition: for tests where it cannot be built.

Names, order and defaults of arguments are its own, and so are the shapes of what comes back. Its
pictures are the same up to float32. absgrad is the absolute value of a sum over pixels here, and
there the sum of absolute values.
"""

from __future__ import annotations

import math
import sys
import types
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB
from augment.render.constants import COV2D_BLUR, RasterSettings
from augment.render.cuda import runtime as gpu
from augment.render.reference import (
    bin_to_tiles,
    blend,
    half_extents,
    order_by_depth,
    project_parts,
)
from augment.render.sh import SH_C0, evaluate_sh
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians
from tests.augment.pretend_gpu import AwayTensor, held_by


def install(monkeypatch: pytest.MonkeyPatch, **replaced: Any) -> None:
    """Make it what `import gsplat` finds. replaced: attributes that are others than these. Skips
    the test where kernels are compiled: it computes on the CPU.
    """
    if not gpu.is_interpreted():
        pytest.skip("the stand-in computes on the CPU; TRITON_INTERPRET=1 interprets kernels")
    module = types.ModuleType("gsplat")
    named = {
        "__version__": "1.5.3",
        "rasterization": rasterization,
        "spherical_harmonics": spherical_harmonics,
    }
    for name, value in {**named, **replaced}.items():
        setattr(module, name, value)
    monkeypatch.setitem(sys.modules, "gsplat", module)


def spherical_harmonics(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None
) -> Tensor:
    assert (degrees_to_use + 1) ** 2 <= coeffs.shape[-2] and masks is None
    return evaluate_sh(coeffs, functional.normalize(dirs, dim=-1), degrees_to_use)


def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, 3]
    viewmats: Tensor,  # [1, 4, 4]
    Ks: Tensor,  # [1, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    given = {k: v for k, v in locals().items() if not isinstance(v, Tensor)}
    tensors = (means, quats, scales, opacities, colors, viewmats, Ks)
    if isinstance(means, AwayTensor):
        return _on_the_pretended_gpu(tensors, given)
    assert (far_plane, tile_size, backgrounds, sparse_grad) == (1e10, 16, None, False)
    assert (sh_degree, packed, eps2d) == (None, True, COV2D_BLUR)
    assert colors.shape == means.shape and bool((colors >= 0).all())
    intrinsics = Ks[0].double()
    camera = Camera(
        name="gsplat",
        width=width,
        height=height,
        fx=float(intrinsics[0, 0]),
        fy=float(intrinsics[1, 1]),
        cx=float(intrinsics[0, 2]),
        cy=float(intrinsics[1, 2]),
        camera_from_world=viewmats[0].double(),
    )
    settings = RasterSettings(
        near_m=near_plane, radius_clip_px=radius_clip, antialiased=rasterize_mode == "antialiased"
    )
    sh = (colors - 0.5)[:, None] / SH_C0
    part = PosedGaussians(Gaussians(means, quats, scales, opacities, sh))
    splats = order_by_depth(project_parts([part], camera, settings))
    means2d = splats.means2d
    if absgrad and means2d.requires_grad:

        def keep(gradient: Tensor) -> None:
            means2d.absgrad = gradient.abs()

        means2d.register_hook(keep)
    names = frozenset({RGB, ALPHA} | ({EXPECTED_DEPTH} if render_mode == "RGB+ED" else set()))
    images = blend(splats, bin_to_tiles(splats, camera), camera, names, settings)
    assert images.rgb is not None and images.alpha is not None
    rendered = images.rgb
    if images.expected_depth is not None:
        rendered = torch.cat([rendered, images.expected_depth[..., None]], -1)
    meta = {
        "means2d": means2d,
        "radii": torch.ceil(half_extents(splats)).int(),
        "conics": splats.covs2d[:, [2, 1, 0]] * torch.tensor([1.0, -1, 1]) / splats.dets[:, None],
        "gaussian_ids": splats.ids,
        "width": width,
        "height": height,
        "n_cameras": 1,
        "tile_width": math.ceil(width / tile_size),
    }
    return rendered[None], images.alpha[None, :, :, None], meta


def _on_the_pretended_gpu(
    tensors: tuple[Tensor, ...], given: dict[str, Any]
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """All on the CPU, by what the tensors hold; every one of them must lie on the GPU."""
    meta: dict[str, Any] = {}
    rendered, alphas = _Held.apply(given, meta, *tensors)
    return rendered, alphas, meta


class _Held(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, given: dict[str, Any], meta: dict[str, Any], *tensors: Tensor):
        held = [held_by(t).detach().requires_grad_(t.requires_grad) for t in tensors]
        with torch.enable_grad():
            rendered, alphas, found = rasterization(*held, **given)
        ctx.held, ctx.made, ctx.found, ctx.meta = held, (rendered, alphas), found, meta
        for name, value in found.items():
            meta[name] = AwayTensor(value.detach()) if isinstance(value, Tensor) else value
        return AwayTensor(rendered.detach()), AwayTensor(alphas.detach())

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor):
        moving = [t for t in ctx.held if t.requires_grad]
        inner = [held_by(slope) for slope in slopes]
        found = iter(torch.autograd.grad(ctx.made, moving, inner))
        ctx.meta["means2d"].absgrad = AwayTensor(ctx.found["means2d"].absgrad)
        return None, None, *(AwayTensor(next(found)) if t.requires_grad else None for t in ctx.held)
