"""Pixels of traffic signs, which throw the own beams' light back.

The splats of signs are few. They are drawn alone, in the window of the picture that holds them, and
count where the picture's depth shows nothing before them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float32

from augment.memo import memo_of
from augment.render.buffers import ALPHA, EXPECTED_DEPTH
from augment.render.constants import MAX_EXTENT_SIGMAS, SURFACE_ALPHA, RasterSettings
from augment.render.cpu.order import cached_of_tensor
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.scene.semantics import SemanticClass

# Distance behind the picture's surface up to which a sign is visible, metres.
SAME_DEPTH_M = 0.15
# The same, as a share of the depth.
SAME_DEPTH_SHARE = 0.01
# Depth below which a splat counts for no window, metres.
_MIN_DEPTH_M = 0.1


def has_signs(scene: Scene) -> bool:
    """Return True if the background has Gaussians of the class of signs."""
    classes = scene.background.semantic
    if classes is None:
        return False
    return memo_of(scene.as_recorded).get(
        ("lamps, signs",), lambda: bool((classes == SemanticClass.SIGN).any())
    )


def sign_pixels(
    parts: Sequence[PosedGaussians],
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    *,
    settings: RasterSettings,
    backend: str,
) -> Bool[np.ndarray, "H W"] | None:
    """Return the pixels that show the surface of a sign; None where no sign is in view.

    Args:
        parts: the posed Gaussians of the picture.
        camera: the view.
        depth_m: z of the surfaces, metres; 0 for the sky.
        settings: settings of the rasteriser.
        backend: backend of the rasteriser.
    """
    signs = [_signs_of(part) for part in parts]
    sign_parts = [part for part in signs if part is not None]
    window = _window_of(sign_parts, camera)
    if window is None:
        return None
    rows, columns = window
    size = (columns.stop - columns.start, rows.stop - rows.start)
    raster = rasterize(
        sign_parts,
        camera.cropped(columns.start, rows.start, *size),
        buffers={ALPHA, EXPECTED_DEPTH},
        settings=settings,
        backend=backend,
    )
    assert raster.alpha is not None and raster.expected_depth is not None
    alpha = raster.alpha.detach().cpu().numpy()
    depth = raster.expected_depth.detach().cpu().numpy()
    surface = depth_m[window]
    # A sign's depth is mixed with that of things behind it at its edges, so it may lie before.
    is_visible = depth <= surface + SAME_DEPTH_M + SAME_DEPTH_SHARE * surface
    is_sign = np.zeros(depth_m.shape, bool)
    is_sign[window] = (alpha >= SURFACE_ALPHA) & is_visible & (surface > 0)
    return is_sign


def _signs_of(part: PosedGaussians) -> PosedGaussians | None:
    """Return the splats of a part that belong to signs; None without any."""
    classes = part.gaussians.semantic
    if classes is None:
        return None

    def find_rows() -> torch.Tensor:
        return torch.nonzero(classes == SemanticClass.SIGN)[:, 0]

    rows = cached_of_tensor(classes, "rows of signs", find_rows)
    if len(rows) == 0:
        return None
    return PosedGaussians(part.gaussians.select(rows), part.world_from_part)


def _window_of(parts: list[PosedGaussians], camera: Camera) -> tuple[slice, slice] | None:
    """Return rows and columns of the window of the picture that holds all splats of the parts."""
    pose = camera.camera_from_world.numpy()
    low = np.full(2, np.inf)
    high = np.full(2, -np.inf)
    for part in parts:
        centres, radii_m = _spheres(part.gaussians)
        if part.world_from_part is not None:
            world_from_part = part.world_from_part.numpy()
            centres = centres @ world_from_part[:3, :3].T + world_from_part[:3, 3]
        points = centres @ pose[:3, :3].T + pose[:3, 3]
        is_ahead = points[:, 2] > _MIN_DEPTH_M
        points = points[is_ahead]
        pixels = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        reach_px = (radii_m[is_ahead] / points[:, 2] * max(camera.fx, camera.fy) + 2)[:, None]
        size = (camera.width, camera.height)
        is_inside = ((pixels + reach_px > 0) & (pixels - reach_px < size)).all(1)
        if is_inside.any():
            low = np.minimum(low, (pixels - reach_px)[is_inside].min(0))
            high = np.maximum(high, (pixels + reach_px)[is_inside].max(0))
    if not (high > low).all():
        return None
    left, top = np.maximum(np.floor(low), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(high), (camera.width, camera.height)).astype(int).tolist()
    return slice(top, bottom), slice(left, right)


def _spheres(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres of splats [N, 3], and radii [N] beyond which they show nothing, metres."""
    centres = gaussians.means.detach().cpu().double().numpy()
    largest = gaussians.scales.detach().cpu().double().numpy().max(1)
    return centres, MAX_EXTENT_SIGMAS * largest
