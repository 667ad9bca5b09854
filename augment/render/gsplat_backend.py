"""Gradients of geometry on the GPU, by gsplat 1.5 (Ye et al. 2025), which is an optional extra.

Its thresholds are those of the definition (augment.render.reference), and so are its images and
gradients, with one exception: it rounds a radius clip to whole pixels. The trainer calls it.

    pip install 'climategs[gsplat]'        a CUDA toolkit compiles it when it is first used
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

from augment.errors import BackendUnavailable
from augment.render.constants import COV2D_BLUR, TRANSMITTANCE_STOP, RasterSettings
from augment.render.cuda.runtime import gpu_device
from augment.scene.cameras import Camera
from augment.scene.geometry import multiply_quats, quat_from_rotmat
from augment.scene.scene import PosedGaussians

# Fields of Gaussians whose gradients are gsplat's on the GPU.
GEOMETRY = ("means", "quats", "scales", "opacities")
# gsplat's upper limit of alpha, which is compiled in.
_ALPHA_MAX = 0.999
# Prefix of the versions that may be used; later ones may have other thresholds.
_VERSIONS = "1.5."


@dataclass(frozen=True, eq=False)
class GsplatImages:
    """Images of one camera and gsplat's data of the splats in them, recorded by autograd.

    rgb: colour without background.
    alpha: 1 - final transmittance.
    expected_depth: mean depth of the splats, metres; None if it was not asked for.
    colors: colours of all splats before their clamp at 0.
    means2d: [M, 2], image positions of the drawn splats, px. After backward, means2d.absgrad [M, 2]
        holds the sums over pixels of absolute gradients by x and y, 1/px.
    conics: [M, 3], inverse covariances of the drawn splats: xx, xy, yy, px^-2.
    ids: [M], indices of the drawn splats.
    """

    rgb: Float32[Tensor, "H W 3"]
    alpha: Float32[Tensor, "H W"]
    expected_depth: Float32[Tensor, "H W"] | None
    colors: Float32[Tensor, "N 3"]
    means2d: Any  # a Tensor, to which gsplat adds an attribute
    conics: Tensor
    ids: Tensor


def tracked_geometry(parts: Sequence[PosedGaussians]) -> list[str]:
    """Return the names of the fields other than sh that require gradients in any part."""
    return [
        name for name in GEOMETRY if any(getattr(p.gaussians, name).requires_grad for p in parts)
    ]


def import_gsplat() -> ModuleType:
    """Import gsplat.

    Raises:
        BackendUnavailable: it cannot be used here; the message says what is missing.
    """
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
    """Check that gsplat's kernels exist. Compiling them takes minutes the first time."""
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


def render_with_gsplat(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    settings: RasterSettings,
    *,
    with_depth: bool,
    num_sh_functions: int | None = None,
    keeps_color_gradients: bool = False,
) -> GsplatImages:
    """Return images of the parts that are differentiable in all their float tensors.

    The tensors may lie on either side; the images lie on the GPU. Positions are counted from the
    eye, so that float32 keeps its digits in scenes that are kilometres wide. Colours are evaluated
    in each part's own axes.

    Args:
        parts: Gaussians with their poses.
        camera: a pinhole camera.
        settings: thresholds of the image; they must be those that gsplat is compiled with.
        with_depth: if True, expected depth is rendered, too.
        num_sh_functions: number of SH functions; None for the number that the settings say.
        keeps_color_gradients: if True, colors.grad holds the colours' gradients after backward,
            even if sh requires none.

    Raises:
        BackendUnavailable: gsplat is not installed, or cannot be used.
        ValueError: gsplat cannot render with these settings or this camera.
    """
    gsplat = import_gsplat()
    _check_settings(camera, settings)
    device = gpu_device()
    means, quats, scales, opacities, colors = (
        torch.cat(values)
        for values in zip(
            *(_gsplat_inputs(gsplat, p, camera, settings, num_sh_functions, device) for p in parts),
            strict=True,
        )
    )
    if keeps_color_gradients:
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


def _gsplat_inputs(
    gsplat: Any,
    part: PosedGaussians,
    camera: Camera,
    settings: RasterSettings,
    num_sh_functions: int | None,
    device: torch.device,
) -> tuple[Tensor, ...]:
    """Return means, quats, scales, opacities and colours of a part, as gsplat takes them.

    Means are counted from the eye; means and quats are in the world's axes.
    """
    gaussians = part.gaussians
    means, quats, scales, opacities, sh = (
        getattr(gaussians, name).to(device) for name in (*GEOMETRY, "sh")
    )
    pose = np.eye(4) if part.world_from_part is None else part.world_from_part.cpu().numpy()
    camera_from_part = camera.camera_from_world.numpy() @ pose
    eye = np.linalg.solve(camera_from_part[:3, :3], -camera_from_part[:3, 3])  # in the part
    coarse_eye = eye.astype(np.float32)
    offsets = means - torch.from_numpy(coarse_eye).to(device)
    offsets = offsets - torch.from_numpy((eye - coarse_eye).astype(np.float32)).to(device)
    degree = (
        math.isqrt(sh.shape[1] if num_sh_functions is None else min(num_sh_functions, sh.shape[1]))
        - 1
    )
    if settings.sh_degree is not None:
        degree = min(degree, settings.sh_degree)
    colors = gsplat.spherical_harmonics(degree, offsets, sh) + 0.5
    if part.world_from_part is None:
        return offsets, quats, scales, opacities, colors
    world_rotation = torch.from_numpy(pose[:3, :3])
    world_quat = quat_from_rotmat(world_rotation).float().to(device)
    return (
        offsets @ world_rotation.T.float().to(device),
        multiply_quats(world_quat.expand_as(quats), quats),
        scales,
        opacities,
        colors,
    )


def _check_settings(camera: Camera, settings: RasterSettings) -> None:
    """Check that gsplat can render with this camera and these settings."""
    if camera.is_orthographic:
        raise ValueError(
            f"camera {camera.name!r} is orthographic; gradients are of pinhole cameras"
        )
    compiled_values = {
        "alpha_max": (settings.alpha_max, _ALPHA_MAX),
        "transmittance_stop": (settings.transmittance_stop, TRANSMITTANCE_STOP),
    }
    for name, (value, compiled_value) in compiled_values.items():
        if value != compiled_value:
            raise ValueError(
                f"settings.{name} must be {compiled_value} where gsplat has the gradients, since "
                f"that is compiled into it; got {value}. Use backend 'cpu' for another"
            )
