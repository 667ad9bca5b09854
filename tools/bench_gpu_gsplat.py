"""gsplat's clean render of the same scene, where it is installed and can be built."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import torch
from torch import Tensor

from augment.cameras import Camera
from augment.render.constants import COV2D_BLUR, RasterSettings
from augment.render.cuda.runtime import gpu_device
from augment.scene import Gaussians

Draw = Callable[[], Tensor]  # rgb [H, W, 3], on the GPU


def gsplat_draws(gaussians: Gaussians, camera: Camera) -> dict[str, Draw] | str:
    """Ways to draw the scene with gsplat, by name; or why there is none. The first draw of each has
    been done: it compiles where gsplat was installed without compiled kernels.
    """
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed (pip install 'climategs[gsplat]')"
    try:
        draws = {
            "packed": _draw_with(gaussians, camera, packed=True),
            "unpacked": _draw_with(gaussians, camera, packed=False),
        }
        for draw in draws.values():
            draw()
    except Exception as error:  # another's code, which may fail in ways of its own
        return f"gsplat failed: {type(error).__name__}: {error}"
    return draws


def _draw_with(gaussians: Gaussians, camera: Camera, *, packed: bool) -> Draw:
    from gsplat import rasterization  # type: ignore[import-not-found]

    device, settings = gpu_device(), RasterSettings()
    tensors = ("means", "quats", "scales", "opacities", "sh")
    means, quats, scales, opacities, sh = (
        getattr(gaussians, name).detach().contiguous().to(device) for name in tensors
    )
    intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    viewmats = camera.camera_from_world.float().to(device)[None]
    intrinsic_matrices = torch.tensor([intrinsics], device=device)

    @torch.no_grad()
    def draw() -> Tensor:
        colors, _, _ = rasterization(
            means=means,
            quats=quats,
            scales=scales,
            opacities=opacities,
            colors=sh,
            viewmats=viewmats,
            Ks=intrinsic_matrices,
            width=camera.width,
            height=camera.height,
            near_plane=settings.near_m,
            eps2d=COV2D_BLUR,
            sh_degree=gaussians.sh_degree,
            packed=packed,
            render_mode="RGB",
        )
        return colors[0]

    return draw
