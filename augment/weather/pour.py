"""Putting the layers of a flooded view together: the torch definition, and the way to kernels."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.cameras import Camera
from augment.render.backends import CPU, CUDA, REFERENCE, kernels_for
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB, SPLAT_IDS, RenderOutput
from augment.render.composite import composite_sky
from augment.render.constants import DEPTH_EPS
from augment.render.threads import kernel_threads
from augment.sky import Sky
from augment.weather import pour_kernels
from augment.weather.smog import SmogMedium
from augment.weather.water_plane import Window, falling

ROWS = 32  # image rows a thread takes at a time


def find_water(
    alpha: Float[Tensor, "H W"], camera: Camera, *, backend: str = CPU
) -> tuple[Bool[Tensor, "H W"], float]:
    """Where a camera above the water sees it first, and the largest share of it in any pixel.

    alpha: of what stands before the water. It is seen first where that leaves more than half.
    """
    kernels = kernels_for(backend, alpha)
    if kernels == CUDA:
        from augment.weather import cuda_pour

        water, most = cuda_pour.find_water(alpha, camera)
        return water, float(most)  # waits for the GPU: what is drawn next depends on it
    if kernels == CPU:
        water = np.empty(tuple(alpha.shape), np.uint8)
        shown = np.empty(len(alpha), np.float32)
        with kernel_threads(ROWS):
            pour_kernels.find_water(*_rays(camera), alpha.detach().numpy(), shown, water)
        return torch.from_numpy(water).view(torch.bool), float(shown.max())
    share = torch.where(falling(camera), 1 - alpha, torch.zeros_like(alpha))
    return share > 0.5, float(share.max())


def pour(
    front: RenderOutput,
    camera: Camera,
    window: Window,
    color: Float[Tensor, "h w 3"],
    sky: Sky,
    smog: SmogMedium | None,
    *,
    backend: str = CPU,
) -> Float[Tensor, "H W 3"]:
    """front + (1 - front's alpha) times the water's colour where rays fall, the sky's elsewhere.

    color: of the window's pixels. backend: kernels work on float32 in place, in the front's own
    colours: fresh memory would take as long as the arithmetic.
    """
    assert front.rgb is not None and front.alpha is not None
    rgb, alpha = front.rgb, front.alpha
    kernels = kernels_for(backend, rgb, alpha)
    if kernels == REFERENCE:
        image = composite_sky(rgb, alpha, camera, sky, smog=smog, backend=backend)
        mixed = window.cut(rgb) + (1 - window.cut(alpha))[..., None] * color
        meets = falling(window.of(camera))[..., None]
        window.paste(image, torch.where(meets, mixed, window.cut(image)))
        return image
    if kernels == CUDA:
        from augment.weather import cuda_pour
        from augment.weather.cuda_rows import dry_rows

        part, dry = rgb, dry_rows(camera)
        if dry:
            above = camera.cropped(0, 0, camera.width, dry)
            part = composite_sky(rgb[:dry], alpha[:dry], above, sky, smog=smog, backend=backend)
        cuda_pour.pour(rgb, alpha, camera, window, color, part, dry)
        return rgb
    dry = _dry_rows(camera)
    if dry:
        part = composite_sky(
            rgb[:dry], alpha[:dry], camera.cropped(0, 0, camera.width, dry), sky, smog=smog
        )
        # Rows that show both: what falls there belongs to the water, the rest to the sky.
        shared = rgb[window.top : dry].clone()
        rgb[:dry] = part
        if window.top < dry:
            wet = falling(camera.cropped(0, window.top, camera.width, dry - window.top))
            rgb[window.top : dry][wet] = shared[wet]
    with kernel_threads(ROWS):
        pour_kernels.pour(
            *_rays(window.of(camera)),
            window.top,
            window.left,
            alpha.numpy(),
            color.contiguous().numpy(),
            rgb.numpy(),
        )
    return rgb


def _dry_rows(camera: Camera) -> int:
    """One past the last row in which a ray does not fall."""
    first, last = (falling(camera.cropped(c, 0, 1, camera.height)) for c in (0, camera.width - 1))
    dry = torch.nonzero(~(first & last)[:, 0])
    return int(dry.max()) + 1 if len(dry) else 0


def _rays(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    u = (np.arange(camera.width, dtype=np.float64) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height, dtype=np.float64) + 0.5 - camera.cy) / camera.fy
    return u, v, np.ascontiguousarray(camera.world_from_camera[2, :3].numpy())


def both_sides(
    front: RenderOutput,
    behind: RenderOutput,
    window: Window,
    buffers: frozenset[str],
    *,
    backend: str = CPU,
) -> RenderOutput:
    """Buffers of two layers as one scene's, colour excepted: what stands before the water, and, in
    the window, what is seen through it.

    Alpha and expected depth are what one render would give. Median depth and the heaviest splat
    are those of the layer that covers more of the pixel. backend: kernels work on float32 in place.
    """
    assert front.alpha is not None and behind.alpha is not None
    wanted = buffers - {RGB, ALPHA}
    if not wanted:
        return RenderOutput()
    values = {name: getattr(front, name) for name in (*wanted, ALPHA)}
    kernels = kernels_for(backend, front.alpha)
    if kernels == CUDA:
        from augment.weather import cuda_pour

        pairs = {name: (values[name], getattr(behind, name)) for name in sorted(wanted)}
        depths = pairs.pop(EXPECTED_DEPTH, None)
        cuda_pour.join(front.alpha, behind.alpha, depths, list(pairs.values()), window)
        return RenderOutput(**values)
    if kernels == CPU:
        here, there = window.overlap(front.alpha)
        alphas = (front.alpha.numpy()[here], behind.alpha.numpy()[there])
        with kernel_threads(ROWS):
            for name in sorted(wanted):
                pair = (values[name].numpy()[here], getattr(behind, name).numpy()[there])
                if name == EXPECTED_DEPTH:
                    pour_kernels.join_depth(*alphas, *pair, np.float32(DEPTH_EPS))
                else:
                    pour_kernels.join_heavier(*alphas, *pair)
            pour_kernels.join_alpha(*alphas)
        return RenderOutput(**values)
    covered = torch.zeros_like(front.alpha)
    window.paste(covered, behind.alpha)
    share = (1 - front.alpha) * covered
    values[ALPHA] = front.alpha + share
    for name in wanted:
        nearer = values[name]
        other = torch.full_like(nearer, -1) if name == SPLAT_IDS else torch.zeros_like(nearer)
        window.paste(other, getattr(behind, name))
        if name == EXPECTED_DEPTH:
            total = front.alpha * nearer + share * other
            values[name] = total / values[ALPHA].clamp_min(DEPTH_EPS)
        else:
            values[name] = torch.where(share > front.alpha, other, nearer)
    return RenderOutput(**values)
