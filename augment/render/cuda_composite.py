"""Launches of the passes over finished images on the GPU. Images are float32, without gradients.

Definitions: augment.render.composite, augment.weather.smog, augment.render.remainder.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.render import cuda_composite_kernels as kernels
from augment.render.gpu import launch, resident
from augment.weather.smog import SmogMedium, vertical_optical_depth

BLOCK = 128  # pixels of a program: one a thread, which needs few registers and no exchange
MOST_STRENGTH = 1e30  # of smog before the sky: finite in float32, and nothing is seen through it


def composite_color(
    rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"], color: Float[Tensor, "3"]
) -> Float[Tensor, "H W 3"]:
    """rgb + (1 - alpha) color. color: read on the host, so it had better lie there."""
    rgb, alpha = rgb.detach().contiguous(), alpha.detach().contiguous()
    out = torch.empty_like(rgb)
    count = alpha.numel()
    given = (rgb, alpha, out, count, *color.tolist())
    launch(kernels.composite_color, _grid(count), *given, BLOCK=BLOCK)
    return out


def composite_cubemap(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    camera: Camera,
    faces: Float[Tensor, "6 S S 3"],
    smog: SmogMedium | None,
) -> Float[Tensor, "H W 3"]:
    """The sky of a cube map behind the image. faces: with a border, on either side; kept on the GPU
    for as long as they live. smog: layered.
    """
    rgb, alpha, faces = rgb.detach().contiguous(), alpha.detach().contiguous(), resident(faces)
    out = torch.empty_like(rgb)
    strength, airlight = 0.0, (0.0, 0.0, 0.0)
    if smog is not None:
        vertical = vertical_optical_depth(smog, float(camera.centre[2]))
        strength, airlight = min(vertical, MOST_STRENGTH), smog.rgb
    launch(
        kernels.composite_cubemap,
        _grid(alpha.numel()),
        *(rgb, alpha, faces, out, alpha.numel(), camera.width, faces.shape[1]),
        *_rays(camera),
        *camera.world_from_camera[:3, :3].flatten().tolist(),
        *(strength, *airlight),
        SMOG=smog is not None,
        BLOCK=BLOCK,
    )
    return out


def fog(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    camera: Camera,
    medium: SmogMedium,
) -> Float[Tensor, "H W 3"]:
    """Deferred smog: the image through what lies before its surfaces. depth: z over alpha."""
    rgb, alpha, depth = (image.detach().contiguous() for image in (rgb, alpha, depth))
    out = torch.empty_like(rgb)
    eye, up = 0.0, (0.0, 0.0, 0.0)
    if medium.scale_height_m is not None:
        pose = camera.world_from_camera
        eye = (float(pose[2, 3]) - medium.base_z_m) / medium.scale_height_m
        up = (pose[2, :3] / medium.scale_height_m).tolist()
    launch(
        kernels.fog,
        _grid(alpha.numel()),
        *(rgb, alpha, depth, out, alpha.numel(), camera.width),
        *_rays(camera),
        *(medium.sigma_per_m, *medium.rgb, eye, *up),
        LAYERED=medium.scale_height_m is not None,
        BLOCK=BLOCK,
    )
    return out


def map_colors(rgb: Float[Tensor, "H W 3"], color_map: Float[Tensor, "3 4"]) -> None:
    """Every colour under the map, in place. rgb: contiguous. color_map: read on the host."""
    count = rgb.numel() // 3
    numbers = color_map.detach().flatten().tolist()
    launch(kernels.map_colors, _grid(count), rgb.detach(), count, *numbers, BLOCK=BLOCK)


def share_remainder(alpha: Tensor, rgb: Tensor | None, snow: Tensor | None, stop: float) -> None:
    """Finished pixels become opaque, in place; all contiguous."""
    count = alpha.numel()
    launch(
        kernels.share_remainder,
        _grid(count),
        *(alpha, rgb, snow, count, 1 - stop),
        BLOCK=BLOCK,
    )


def _grid(count: int) -> tuple[int]:
    return (-(-count // BLOCK),)


def _rays(camera: Camera) -> tuple[float, float, float, float]:
    """cx, cy, 1 / fx, 1 / fy."""
    return camera.cx, camera.cy, 1 / camera.fx, 1 / camera.fy
