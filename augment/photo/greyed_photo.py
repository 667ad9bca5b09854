"""Recorded images whose glossy surfaces mirror a grey sky in place of the blue one.

In: a `Photo`, the classes of its pixels, and the scene's `SkyGloss`. Out: a `Photo`. How a colour
tells that it is of the sky: `augment.light.sky_gloss`.

The share of mirrored sky is found in a smaller image, whose noise is less. At full size it counts
where a pixel is bluer than grey things, so that frames of windows and walls beside them keep their
colours.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int16, UInt8
from torch import Tensor

from augment.light.sky_gloss import (
    GREY_CLASSES,
    MATTE_CLASSES,
    SkyGloss,
    grey_of,
    grey_weights,
    mirror_share,
)
from augment.photo.greyed_photo_kernels import grey_image
from augment.photo.photo_objects import copy_size
from augment.photo.recorded_base import ROWS_PER_THREAD, Photo
from augment.render.threads import kernel_threads

# Largest width of the smaller image, pixels.
SMALL_PX = 480
# Excess of blue over red of a pixel, by its largest channel, at which the share counts in full.
FULL_EXCESS = 0.06
# Pixels of the smaller image over which the share is smoothed.
SMOOTHING_PX = 3
# Share below which a pixel keeps its bits, of 255.
MIN_LEVEL = 4


def grey_photo(
    photo: Photo, classes: Int16[np.ndarray, "h w"], gloss: SkyGloss, fade: float
) -> Photo:
    """Return a photo in which what mirrors the blue sky mirrors a grey one.

    Args:
        photo: the photo.
        classes: class of the surface in each pixel of the smaller image, -1 for none.
        gloss: colours of the scene's sky.
        fade: how much of the mirrored blue goes, 0 to 1.
    """
    pixels = photo.pixels
    height, width = pixels.shape[:2]
    small_size = copy_size(photo.camera, SMALL_PX)
    small = cv2.resize(pixels, small_size, interpolation=cv2.INTER_AREA)
    small_rgb = small.astype(np.float32) / 255
    sky_rgb = _recorded_color(gloss.sky_rgb, photo.scene_from_recorded)
    grey_rgb = grey_of(small_rgb[np.isin(classes, GREY_CLASSES)])
    recorded_gloss = SkyGloss(sky_rgb, grey_rgb)
    if not recorded_gloss.is_blue:
        return photo
    share = mirror_share(small_rgb, recorded_gloss)
    share[(classes < 0) | np.isin(classes, MATTE_CLASSES)] = 0
    if photo.matte is not None:
        sky_share = cv2.resize(photo.matte.sky_share, small_size, interpolation=cv2.INTER_NEAREST)
        share *= 1 - np.clip(sky_share, 0, 1)
    share = cv2.blur(share, (SMOOTHING_PX, SMOOTHING_PX))
    levels = np.rint(255 * share).astype(np.uint8)
    levels = cv2.resize(levels, (width, height), interpolation=cv2.INTER_LINEAR)
    if photo.matte is not None:  # the sky keeps its colour, also where a pixel mixes it
        levels[photo.matte.sky_share > 0] = 0
    return replace(photo, pixels=_grey_on_cpu(pixels, levels, grey_rgb, fade))


def _recorded_color(
    rgb: tuple[float, float, float], scene_from_recorded: Float[Tensor, "3 4"] | None
) -> tuple[float, float, float]:
    """Return a colour of the scene as its photo shows it, clamped to 0 to 1."""
    if scene_from_recorded is None:
        return rgb
    color_map = scene_from_recorded.double()
    color = torch.tensor(rgb, dtype=torch.float64) - color_map[:, 3]
    red, green, blue = torch.linalg.solve(color_map[:, :3], color).clamp(0, 1).tolist()
    return red, green, blue


def grey_pixels(
    pixels: UInt8[np.ndarray, "H W 3"],
    levels: UInt8[np.ndarray, "H W"],
    grey_rgb: tuple[float, float, float],
    fade: float,
) -> UInt8[np.ndarray, "H W 3"]:
    """Return an image with the blue of mirrored sky taken out; the definition of the kernel.

    Args:
        pixels: the image.
        levels: share of mirrored sky, 0 to 255.
        grey_rgb: colour of grey things, of green 1.
        fade: how much of the blue goes, 0 to 1.
    """
    rgb = pixels.astype(np.float32)
    grey = np.array(grey_rgb, np.float32)
    relative = rgb / grey
    excess = (relative[..., 2] - relative[..., 0]) / np.maximum(relative.max(-1), 1)
    weight = np.clip(excess / FULL_EXCESS, 0, 1) * np.where(levels < MIN_LEVEL, 0, levels) / 255
    target = (rgb @ np.array(grey_weights(grey_rgb), np.float32))[..., None] * grey
    greyed = rgb + fade * weight[..., None] * (target - rgb)
    return np.clip(np.floor(greyed + 0.5), 0, 255).astype(np.uint8)


def _grey_on_cpu(
    pixels: UInt8[np.ndarray, "H W 3"],
    levels: UInt8[np.ndarray, "H W"],
    grey_rgb: tuple[float, float, float],
    fade: float,
) -> UInt8[np.ndarray, "H W 3"]:
    """Return `grey_pixels` of the same arguments, by the CPU kernel."""
    out = np.empty_like(pixels)
    with kernel_threads(ROWS_PER_THREAD):
        grey_image(
            pixels,
            levels,
            MIN_LEVEL,
            np.array(grey_rgb, np.float32),
            np.array(grey_weights(grey_rgb), np.float32),
            np.float32(fade),
            np.float32(FULL_EXCESS),
            out,
        )
    return out
