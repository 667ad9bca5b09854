"""Gradients of geometry on the GPU, by gsplat 1.5 (Ye et al. 2025), which is an extra.

Its thresholds are those of the definition (augment.render.reference), so are its pictures and
gradients, up to what it does another way: a radius clip is of whole pixels.

    pip install 'climategs[gsplat]'        a toolkit of CUDA compiles it when it is first used
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from augment.cameras import Camera
from augment.errors import BackendUnavailable
from augment.geometry import multiply_quats, quat_from_rotmat
from augment.render.constants import COV2D_BLUR, TRANSMITTANCE_STOP, RasterSettings
from augment.render.cuda.runtime import gpu_device
from augment.scene import PosedGaussians

GEOMETRY = ("means", "quats", "scales", "opacities")
_ALPHA_MAX = 0.999  # its clamp, which is compiled in
_VERSIONS = "1.5."  # later ones may have other thresholds


@dataclass(frozen=True, eq=False)
class GsplatImages:
    """One camera's images and what gsplat tells of the splats in them, recorded by autograd.

    rgb [H, W, 3], alpha [H, W], expected_depth [H, W] or None. colors: [N, 3], of all splats before
    their clamp at 0. means2d [M, 2], conics [M, 3] (inverse covariances: xx, xy, yy, px^-2) and ids
    [M], of the splats that were drawn; after backward means2d.absgrad [M, 2] holds, x and y, the
    sums over pixels of absolute gradients, 1/px.
    """

    rgb: Float32[Tensor, "H W 3"]
    alpha: Float32[Tensor, "H W"]
    expected_depth: Float32[Tensor, "H W"] | None
    colors: Float32[Tensor, "N 3"]
    means2d: Any  # a Tensor, to which gsplat adds an attribute
    conics: Tensor
    ids: Tensor


def tracked_geometry(parts: Sequence[PosedGaussians]) -> list[str]:
    """Names of the fields other than sh that ask for gradients in any part."""
    return [
        name for name in GEOMETRY if any(getattr(p.gaussians, name).requires_grad for p in parts)
    ]


def import_gsplat() -> ModuleType:
    """gsplat. Raises BackendUnavailable, which says what is missing."""
    try:
        import gsplat  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise BackendUnavailable(
            f"on the GPU, gradients of means, quats, scales and opacities are gsplat's: {error}. "
            f"Install it with `pip install 'climategs[gsplat]'`, or use backend 'cpu', which has "
            f"them (of sh alone, 'cuda' has its own)"
        ) from error
    version = str(gsplat.__version__)
    if not version.startswith(_VERSIONS):
        raise BackendUnavailable(
            f"gsplat {version} is installed, whose thresholds may be others than those of "
            f"{_VERSIONS}x: `pip install 'gsplat==1.5.3'`, or use backend 'cpu'"
        )
    _check_compiled()
    return gsplat


def _check_compiled() -> None:
    """Its kernels are there; or they are compiled now, which takes minutes the first time."""
    try:
        from gsplat.cuda import _backend  # pyright: ignore[reportMissingImports]
    except Exception as error:  # also of the compilers that it starts
        if isinstance(error, ModuleNotFoundError) and str(error.name).startswith("gsplat"):
            return  # a release that keeps them elsewhere
        raise BackendUnavailable(
            f"gsplat could not be set up: {error}. Mend its installation, or use backend 'cpu'"
        ) from error
    if getattr(_backend, "_C", True) is None:
        raise BackendUnavailable(
            "gsplat is installed without its kernels, and found no CUDA toolkit (nvcc) to compile "
            "them with: install one, or a gsplat built for this torch, or use backend 'cpu'"
        )


def draw_with_gsplat(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    *,
    with_depth: bool,
    functions: int | None = None,
    keep_color_slopes: bool = False,
) -> GsplatImages:
    """The parts in one picture, differentiable in all their float tensors, which may lie on either
    side; the images lie on the GPU. functions: SH functions used, None for the settings'.
    keep_color_slopes: after backward, colors.grad holds theirs, though sh asks for none.

    Everything is counted from the eye, so that float32 keeps its digits in scenes that are
    kilometres wide, and colours are evaluated in each part's own axes.

    Raises:
        BackendUnavailable: gsplat is not there.
        ValueError: the settings or the camera are none that it knows.
    """
    gsplat = import_gsplat()
    _check(camera, settings)
    device = gpu_device()
    means, quats, scales, opacities, colors = (
        torch.cat(values)
        for values in zip(
            *(_placed(gsplat, p, camera, settings, functions, device) for p in parts), strict=True
        )
    )
    if keep_color_slopes:
        colors = colors if colors.requires_grad else colors.requires_grad_()
        colors.retain_grad()
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = camera.camera_from_world[:3, :3]
    intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    rendered, alphas, meta = gsplat.rasterization(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        colors=colors.clamp_min(0),
        viewmats=view.float()[None].to(device),
        Ks=torch.tensor([intrinsics]).to(device),
        width=camera.width,
        height=camera.height,
        near_plane=settings.near_m,
        radius_clip=float(math.floor(settings.radius_clip_px)),
        eps2d=COV2D_BLUR,
        packed=True,
        render_mode="RGB+ED" if with_depth else "RGB",
        absgrad=True,
        rasterize_mode="antialiased" if settings.antialiased else "classic",
    )
    return GsplatImages(
        rgb=rendered[0, :, :, :3],
        alpha=alphas[0, :, :, 0],
        expected_depth=rendered[0, :, :, 3] if with_depth else None,
        colors=colors,
        means2d=meta["means2d"],
        conics=meta["conics"],
        ids=meta["gaussian_ids"],
    )


def _placed(
    gsplat: Any,
    part: PosedGaussians,
    camera: Camera,
    settings: RasterSettings,
    functions: int | None,
    device: torch.device,
) -> tuple[Tensor, ...]:
    """Means from the eye and quats, both in the world's axes, scales, opacities and colours."""
    own = part.gaussians
    means, quats, scales, opacities, sh = (
        getattr(own, name).to(device) for name in (*GEOMETRY, "sh")
    )
    pose = np.eye(4) if part.world_from_part is None else part.world_from_part.cpu().numpy()
    from_part = camera.camera_from_world.numpy() @ pose
    eye = np.linalg.solve(from_part[:3, :3], -from_part[:3, 3])  # in the part
    coarse = eye.astype(np.float32)
    offsets = means - torch.from_numpy(coarse).to(device)
    offsets = offsets - torch.from_numpy((eye - coarse).astype(np.float32)).to(device)
    degree = math.isqrt(sh.shape[1] if functions is None else min(functions, sh.shape[1])) - 1
    if settings.sh_degree is not None:
        degree = min(degree, settings.sh_degree)
    colors = gsplat.spherical_harmonics(degree, offsets, sh) + 0.5
    if part.world_from_part is None:
        return offsets, quats, scales, opacities, colors
    turn = torch.from_numpy(pose[:3, :3])
    quat = quat_from_rotmat(turn).float().to(device)
    return (
        offsets @ turn.T.float().to(device),
        multiply_quats(quat.expand_as(quats), quats),
        scales,
        opacities,
        colors,
    )


def _check(camera: Camera, settings: RasterSettings) -> None:
    if camera.is_orthographic:
        raise ValueError(
            f"camera {camera.name!r} is orthographic; gradients are of pinhole cameras"
        )
    fixed = {
        "alpha_max": (settings.alpha_max, _ALPHA_MAX),
        "transmittance_stop": (settings.transmittance_stop, TRANSMITTANCE_STOP),
    }
    for name, (value, known) in fixed.items():
        if value != known:
            raise ValueError(
                f"settings.{name} must be {known} where gsplat has the gradients, since that is "
                f"compiled into it; got {value}. Use backend 'cpu' for another"
            )
