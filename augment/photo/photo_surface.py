"""Surfaces of a photo: the share and the depth of what it shows in every pixel that is not sky.

In: the buffers of a scene and the sky matte of the photo. Out: the buffers with the surfaces that
the photo shows. Every pass that looks at alpha and depth afterwards sees the same: smog, rain,
snowfall, spray, wet ground, water, styles, and depth images.

Alpha becomes 1 - the matte's share of sky. A pixel with a surface in the photo and none in the
scene takes the depth of the pixel to which the cheapest path leads through the photo: a path is
cheap upwards and within one colour, and sky is a barrier. So a wall, a pole or a crown goes on
above the LiDAR's highest beam as far as the photo shows it. What no path reaches stands at
FAR_DEPTH_M.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64, UInt8
from torch import Tensor

from augment.photo import outline_kernels as kernels
from augment.photo.photo_objects import copy_size, nearest_pixels
from augment.render.buffers import (
    ALPHA,
    EXPECTED_DEPTH,
    MEDIAN_DEPTH,
    MODE_DEPTH,
    SPLAT_IDS,
    RenderOutput,
)
from augment.render.composite import unit_depth_coordinates
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera

# Alpha of reconstructed surfaces up to which a pixel counts as empty. What a photo shows is opaque,
# while reconstructed surfaces let some light through.
CLEAR_ALPHA = 0.04
# Alpha of reconstructed surfaces from which a pixel counts as opaque.
OPAQUE_ALPHA = 0.96
# Width of the copy in which depth spreads, pixels.
FILL_PX = 480
# Depth of things that nothing tells the depth of, metres.
FAR_DEPTH_M = 300.0
# Alpha from which the scene has a surface in a pixel.
MIN_SURFACE_ALPHA = 0.5
# Alpha from which a surface's depth spreads to others.
MIN_SOURCE_ALPHA = 0.9
# Share of sky from which a pixel is a barrier.
BARRIER_SHARE = 0.97
# Share of sky up to which a surface's depth spreads to others.
MAX_SOURCE_SKY = 0.5
# Cost of a step up, down, left, right from a known pixel, levels of 255.
STEP_COSTS = (1, 24, 8, 8)
# Largest cost of a step, levels.
MAX_STEP_COST = 96
# Fall of a ray, metres a metre, from which it meets the road, not the sky, where nothing is
# rendered.
MIN_ROAD_FALL = 0.02
# An image without pixels, for a kernel's optional input.
NO_NUMBERS = np.empty((0, 0), np.float32)
# Image rows that a thread takes at a time.
ROWS_PER_THREAD = 32
# Estimators of depth among the buffers.
DEPTH_BUFFERS = (EXPECTED_DEPTH, MEDIAN_DEPTH, MODE_DEPTH)


def complete_surfaces(
    raster: RenderOutput,
    sky_share: Float32[np.ndarray, "H W"],
    pixels: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
    road_height_m: float | None = None,
    is_complete: Bool[np.ndarray, "H W"] | None = None,
) -> RenderOutput:
    """Return the buffers with the surfaces that the photo shows.

    On the CPU they are written in place.

    Args:
        raster: the buffers, with alpha and expected depth.
        sky_share: share of sky in each pixel of the photo.
        pixels: the photo.
        camera: its camera.
        road_height_m: height of the camera above the road, metres: nothing lies beyond the road.
            None where it is unknown.
        is_complete: pixels that stay as they are, apart from the stretch of alpha by
            `opaque_alpha`; None for no pixels.
    """
    assert raster.alpha is not None and raster.expected_depth is not None
    images = {
        name: _writable_array(buffer)
        for name in (ALPHA, SPLAT_IDS, *DEPTH_BUFFERS)
        if (buffer := getattr(raster, name)) is not None
    }
    alpha = images[ALPHA]
    roots = None
    if alpha.min(initial=1) < MIN_SURFACE_ALPHA:
        roots = _find_roots(alpha, sky_share, pixels, camera)
    is_missing = np.empty(alpha.shape, np.bool_)
    # Snow on a roof covers the sky behind it.
    overlay = NO_NUMBERS if raster.overlay is None else raster.overlay.detach().cpu().numpy()
    complete_pixels = np.empty((0, 0), np.bool_) if is_complete is None else is_complete
    limits = np.array([CLEAR_ALPHA, OPAQUE_ALPHA, MIN_SURFACE_ALPHA], np.float32)
    with kernel_threads(ROWS_PER_THREAD):
        kernels.fill_surfaces(sky_share, overlay, complete_pixels, limits, alpha, is_missing)
    if roots is not None:
        depth = images[EXPECTED_DEPTH]
        small_depth = _shrink(depth, roots).reshape(-1)[roots]
        small_depth[roots < 0] = FAR_DEPTH_M
        coordinates = [np.asarray(c, np.float32) for c in unit_depth_coordinates(camera)]
        fall = (-camera.world_from_camera[2, :3]).tolist()
        road = np.array([*fall, road_height_m or 0, MIN_ROAD_FALL], np.float32)
        for name in DEPTH_BUFFERS:
            if name in images:
                with kernel_threads(ROWS_PER_THREAD):
                    kernels.fill_missing(is_missing, small_depth, *coordinates, road, images[name])
        if SPLAT_IDS in images:
            small_ids = _shrink(images[SPLAT_IDS], roots).reshape(-1)[roots]
            small_ids[roots < 0] = -1
            with kernel_threads(ROWS_PER_THREAD):
                kernels.fill_missing(
                    is_missing, small_ids, *coordinates, np.zeros_like(road), images[SPLAT_IDS]
                )
    device = raster.alpha.device
    buffers = {name: torch.from_numpy(image).to(device) for name, image in images.items()}
    return replace(raster, **buffers)


def _writable_array(buffer: Tensor) -> np.ndarray:
    """Return a buffer's own memory on the CPU, and a copy of others."""
    if buffer.device.type == "cpu" and not buffer.requires_grad and buffer.is_contiguous():
        return buffer.numpy()
    return buffer.detach().cpu().numpy().copy()


def _shrink(image: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return a copy of an image at the size of another one, pixel by pixel."""
    return cv2.resize(image, like.shape[::-1], interpolation=cv2.INTER_NEAREST)


def _find_roots(
    alpha: Float32[np.ndarray, "H W"],
    sky_share: Float32[np.ndarray, "H W"],
    pixels: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
) -> Int64[np.ndarray, "h w"]:
    """Return for each small pixel the flat index of the one whose depth it takes; -1 for none.

    A pixel of sky takes that of the nearest surface, so that depth has no edge at the sky line.
    """
    size = copy_size(camera, FILL_PX)
    small_pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    small_sky = cv2.resize(sky_share, size, interpolation=cv2.INTER_AREA)
    small_alpha = cv2.resize(alpha, size, interpolation=cv2.INTER_NEAREST)
    is_barrier = small_sky > BARRIER_SHARE
    is_known = (small_alpha > MIN_SOURCE_ALPHA) & (small_sky < MAX_SOURCE_SKY)
    state = np.where(is_barrier, 0, np.where(is_known, 2, 1)).astype(np.uint8)
    roots = np.empty(state.shape, np.int64)
    kernels.spread_roots(
        small_pixels, state, np.array(STEP_COSTS, np.int64), np.int64(MAX_STEP_COST), roots
    )
    if is_barrier.any() and not is_barrier.all():
        roots[is_barrier] = roots.reshape(-1)[nearest_pixels(~is_barrier)[is_barrier]]
    return roots
