"""Launches of the Triton kernels that shade water."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from augment.cameras import Camera
from augment.effects.flood import cuda_water_kernels as kernels
from augment.effects.flood import cuda_water_kernels as mip_kernels
from augment.effects.flood import refraction as layer_lookup
from augment.effects.flood import refraction as water_surface
from augment.effects.flood.cuda_pour import rows_on_gpu
from augment.effects.flood.flood import FloodMedium, Layer
from augment.effects.flood.refraction import window_offset
from augment.effects.flood.screen_space import ScreenReflection
from augment.effects.flood.water import flat_faces, medium_numbers, view_numbers
from augment.effects.flood.waves import WaveField
from augment.effects.smog import SmogMedium
from augment.render.cuda.runtime import gpu_device, launch, resident, upload
from augment.sky import Sky

WIDE, HIGH = 16, 8  # pixels of a program


def shade(
    camera: Camera,
    cover: Tensor,
    hidden_cover: float,
    medium: FloodMedium,
    field: WaveField,
    bed: Layer,
    mirror: Layer | None,
    screen: ScreenReflection | None,
    sky: Sky,
    smog: SmogMedium | None,
) -> Float[Tensor, "h w 3"]:
    """As `water.shade_water`, on the GPU; smog is None where it has no density."""
    faces, size, layered = flat_faces(sky, smog)
    cover = _there(cover)
    nothing = cover, cover, cover
    mirror_parts = nothing if mirror is None else _parts(mirror)
    mips, levels = (cover, 1) if mirror is None else _averages(*mirror_parts[:2])
    front = None if screen is None else screen.layer
    distance = (
        (cover, cover) if screen is None else (_there(screen.distance), _there(screen.weight))
    )
    out = torch.empty((camera.height, camera.width, 3), dtype=torch.float32, device=gpu_device())
    across = -(-camera.width // WIDE)
    launch(
        kernels.shade,
        (across * -(-camera.height // HIGH),),
        upload(_numbers(camera, hidden_cover, medium, bed, mirror, front, smog, layered)),
        rows_on_gpu(camera),
        resident(faces),
        size,
        cover,
        _there(field.normal_x),
        _there(field.normal_y),
        _there(field.slope_variance),
        *_parts(bed),
        *window_offset(bed.camera, camera),
        *mirror_parts[1:],
        mips,
        levels,
        *(nothing if front is None else _parts(front)),
        *distance,
        out,
        camera.width,
        camera.height,
        across,
        HAS_MIRROR=mirror is not None,
        HAS_FRONT=front is not None,
        BENDS=medium.refraction_index != 1,
        SCHLICK=medium.fresnel == "schlick",
        WIDE=WIDE,
        HIGH=HIGH,
    )
    return out


def _there(part: Tensor) -> Tensor:
    return part.detach().float().to(gpu_device()).contiguous()


def _parts(layer: Layer) -> tuple[Tensor, Tensor, Tensor]:
    return _there(layer.rgb), _there(layer.alpha), _there(layer.depth)


def _averages(
    rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"]
) -> tuple[Float[Tensor, "P 4"], int]:
    """Mip levels one after the other, and how many they are."""
    height, width = high, wide = tuple(alpha.shape)
    total, levels = high * wide, 1
    while levels < layer_lookup.MIP_LEVELS and max(high, wide) > 1:
        high, wide = (high + 1) // 2, (wide + 1) // 2
        total, levels = total + high * wide, levels + 1
    mips = torch.empty((total, 4), dtype=torch.float32, device=alpha.device)
    down, across = (-(-size // mip_kernels.SIDE) for size in (height, width))
    arguments = (rgb, alpha, width, height, across, levels, mips)
    launch(mip_kernels.average, (down * across,), *arguments, num_warps=8)
    return mips, levels


def _numbers(
    camera: Camera,
    hidden_cover: float,
    medium: FloodMedium,
    bed: Layer,
    mirror: Layer | None,
    front: Layer | None,
    smog: SmogMedium | None,
    layered: SmogMedium | None,
) -> Float32[np.ndarray, " n"]:
    """What `kernels.shade` reads beside images."""
    axes = camera.world_from_camera[:3, :3].numpy()
    lens = [1 / camera.fx, 1 / camera.fy, 0.5 - camera.cx, 0.5 - camera.cy]
    views = [view_numbers((bed if other is None else other).camera) for other in (mirror, front)]
    numbers = np.concatenate(
        [
            axes.reshape(-1),
            [*lens, axes[2, 0] / camera.fx],
            view_numbers(bed.camera),
            *views,
            medium_numbers(camera, medium, smog, layered),
            [hidden_cover, water_surface.smooth_variance(camera)],
        ]
    )
    return numbers.astype(np.float32)
