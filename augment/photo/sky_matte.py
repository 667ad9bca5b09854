"""Sky mattes of recorded images: the share of sky in each pixel, and colours without it.

In: a recorded image and its camera, and LiDAR returns where there are any. Out: a `SkyMatte`.
Trust, fits, pictures on photos and the sky of raw scenes use the same regions of sky.

A pixel at the edge of a roof, or of a wire, shows both: I = a S + (1 - a) F, with the sky's share
a, the sky's colour S and the surface's colour F. A picture with another sky needs F, since I keeps
a rim of the recorded sky. `augment.photo.sky_regions` says where the sky surely is, and S is its
local mean. With D = |I - S|, pure sky has D = 0, and pure surface beside it has the largest D
around. So 1 - a = D / max D, and F = S + (I - S) / (1 - a).
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8

from augment.files.image_size import read_image_header
from augment.files.recorded_images import ImageFault, decode_image, read_scaled
from augment.memo import memo_of
from augment.photo.lidar_view import elevation_rad, find_returns, highest_channel_rad, sweep_of
from augment.photo.packed_matte import PackedMatte, pack_matte, unpack_matte
from augment.photo.sky_regions import (
    EDGE,
    SKY,
    SURFACE,
    WORK_WIDTH,
    find_sky_regions,
    largest_channel,
)
from augment.scene.cameras import Camera, Frame
from augment.scene.pixel_rays import turn_between, turned_rays
from augment.scene.scene import Scene

# Difference of an image's proportions from the camera's beyond which it is another camera's.
_MAX_SQUEEZE = 0.05
# Difference from the sky's local mean that is noise, of 255.
_NOISE_LEVELS = 14.0
# The same in standard deviations of the sky around.
_NOISE_DEVIATIONS = 2.0
# Largest difference that is noise, of 255.
_MAX_NOISE_LEVELS = 40.0
# Share of the largest difference around up to which a pixel shows pure sky.
_PURE_SHARE = 0.35
# Distance over which an edge is blurred, and its neighbours are searched, pixels of 1920.
_EDGE_PX = 3
# Distance from pure sky up to which a pixel may show some of it, pixels of 1920.
_MIXED_PX = 2
# Distance within which a surface is near, pixels of the working size.
_SURFACE_REACH_PX = 9
# Darkness of surfaces below the sky from which pixels brighter than the sky are no surface's.
_DARK_SURFACE_LEVELS = 10
# Difference of a channel by which the overshoot of sharpening may be paler than the sky, of 255.
_PALE_LEVELS = 40
# Share of sky or surface in a pixel below which its colour is not taken apart.
_MIN_SHARE = 0.02
# Share of a surface in a pixel by which its colour is divided, at least.
_MIN_SOLID = 0.1
# Distance up to which pixels have a say in another's share of sky, pixels of 1920.
_MARGIN_PX = 18
# Height and width of the blocks of an image whose shares are found at a time, pixels.
_BLOCK_SIZE_PX = (128, 480)
# Width of thin things (wires, twigs) that are found by their darkness alone, pixels of 1920.
_THIN_PX = 12
# Darkness of thin things over their surroundings that is noise, of 255.
_THIN_NOISE_LEVELS = 9
# Darkness of a thin thing at its middle, at least, of 255.
_MIN_THIN_LEVELS = 24
# Luma of thin things against the sky over that of the sky: they show their unlit side.
_THIN_LUMA_SHARE = 0.25
# Radii of the windows over which the sky's colour is averaged, the narrowest that holds sky first,
# pixels of half the working size.
_SKY_WINDOWS_PX = (2, 8, 32)
# Least share of a view that the undistorted copy of its image shows for the copy's sky to count.
_MIN_COPY_SHARE = 0.7
# Samples of an image along a side, of which the share is measured.
_SHARE_SAMPLES = 32
# Difference of a view from a recorded one that is rounding of its size, pixels.
_MAX_VIEW_OFFSET_PX = 2.0
# Weight of each window over the one before.
_WINDOW_WEIGHT = 1e-3


class SkyMatte(NamedTuple):
    """The sky in one image, and the image's colours without it."""

    sky_share: Float32[np.ndarray, "H W"]
    """Share of sky in each pixel: 0 for a surface, 1 for sky, between at soft edges."""
    surface_rgb: UInt8[np.ndarray, "H W 3"]
    """The image with the sky's colour taken out of mixed pixels; the image itself where
    `sky_share` is 0 or 1."""
    sky_rgb: UInt8[np.ndarray, "H W 3"]
    """Mean colour of the sky around each pixel, also behind surfaces; it means nothing far from any
    sky. Black in an image without sky."""


def sky_matte(
    scene: Scene, camera: Camera, rgb: UInt8[np.ndarray, "H W 3"] | None = None
) -> SkyMatte | None:
    """Return the sky matte of the image that a camera recorded, at the camera's size.

    The matte is found once for each recorded image and size, and kept in the scene's memo.

    Args:
        scene: the scene.
        camera: one of its cameras, at any scale.
        rgb: the recorded image at the camera's size, if the caller has it; else it is read.

    Returns:
        The matte; None where there is no image that can be read, or where it is too dark to tell.
    """
    frame = recorded_frame(scene, camera)
    if frame is None:
        return None
    if not is_same_view(frame.cameras[camera.name], camera):
        return None
    regions = recorded_sky_regions(scene, frame, camera.name)
    if regions is None:
        return None
    if rgb is None:
        try:
            path = Path(frame.image_paths[camera.name])
            rgb = read_scaled(path, frame.cameras[camera.name], camera)
        except ImageFault:
            return None
    image = rgb
    numbers = camera.width, camera.height, camera.cx, camera.cy, camera.fx, camera.fy
    key = (
        "sky matte",
        frame.index,
        camera.name,
        *numbers,
        camera.camera_from_world.numpy().tobytes(),
    )
    packed = memo_of(scene.as_recorded).get(key, lambda: _refine(image, regions))
    return SkyMatte(*unpack_matte(packed, image))


def find_sky_matte(
    rgb: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
    has_return: Bool[np.ndarray, "h w"] | None = None,
    lidar_top_rad: float = math.inf,
) -> SkyMatte | None:
    """Return the sky matte of an image; None where it is too dark to tell.

    Args:
        rgb: the image.
        camera: its camera, at the image's size.
        has_return: pixels with a LiDAR return, at the image's size or another; None without LiDAR.
        lidar_top_rad: elevation of the LiDAR's highest channel, as the camera sees it.
    """
    regions = find_regions(rgb, camera, has_return, lidar_top_rad)
    return None if regions is None else SkyMatte(*unpack_matte(_refine(rgb, regions), rgb))


def find_regions(
    rgb: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
    has_return: Bool[np.ndarray, "h w"] | None = None,
    lidar_top_rad: float = math.inf,
) -> UInt8[np.ndarray, "m n"] | None:
    """Return the kinds of an image's pixels as `find_sky_regions`, at most WORK_WIDTH wide.

    The arguments are those of `find_sky_matte`.
    """
    small = camera.scaled(min(1.0, WORK_WIDTH / camera.width))
    if (small.height, small.width) != rgb.shape[:2]:
        rgb = cv2.resize(rgb, (small.width, small.height), interpolation=cv2.INTER_AREA)
    if has_return is not None and has_return.shape != rgb.shape[:2]:
        has_return = _resize_returns(has_return, small.height, small.width)
    return find_sky_regions(rgb, elevation_rad(small), has_return, lidar_top_rad)


def _resize_returns(has_return: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return a mask of returns at another size, without losing one."""
    rows, columns = np.nonzero(has_return)
    out = np.zeros((height, width), np.bool_)
    out[rows * height // has_return.shape[0], columns * width // has_return.shape[1]] = True
    return out


# ---- The recorded images of a scene --------------------------------------------------------------


def recorded_frame(scene: Scene, camera: Camera) -> Frame | None:
    """Return the frame in which a camera recorded an image at this time and place; None without.

    Where a scene shows images with their lenses, it is the frame with the undistorted copies.
    """

    def index() -> dict[tuple[str, int], Frame]:
        return {
            (name, frame.cameras[name].timestamp_ns): frame
            for frame in (*scene.frames, *(scene.seen_frames or ()))
            for name in frame.image_paths
            if name in frame.cameras and frame.cameras[name].is_pinhole
        }

    scene = scene.as_recorded
    frames = memo_of(scene).get(("frames with images",), index)
    frame = frames.get((camera.name, camera.timestamp_ns))
    if frame is None:
        return None
    centre = frame.cameras[camera.name].centre
    is_same = torch.allclose(centre, camera.centre, rtol=0, atol=1e-6)
    return frame if is_same else None


def is_same_view(recorded: Camera, camera: Camera) -> bool:
    """Return True if a camera shows the recorded one's whole image, at any scale."""
    if not torch.allclose(recorded.camera_from_world, camera.camera_from_world, rtol=0, atol=1e-6):
        return False
    scales = camera.fx / recorded.fx, camera.fy / recorded.fy
    middle = (abs(recorded.cx * scales[0] - camera.cx), abs(recorded.cy * scales[1] - camera.cy))
    sizes = (
        abs(recorded.width * scales[0] - camera.width),
        abs(recorded.height * scales[1] - camera.height),
    )
    return max(*middle, *sizes) <= _MAX_VIEW_OFFSET_PX


def sky_matte_of_view(
    scene: Scene, frame: Frame, lens_camera: Camera, view: Camera, rgb: UInt8[np.ndarray, "H W 3"]
) -> SkyMatte | None:
    """Return the sky matte of an image that was recorded through a lens, in a pinhole view of it.

    Args:
        scene: the scene.
        frame: the frame of the image.
        lens_camera: the camera with its lens, at the view's place.
        view: the view.
        rgb: the image in the view.
    """
    numbers = view.width, view.height, *view.intrinsics
    pose = view.camera_from_world.numpy().tobytes()
    key = "sky matte of view", frame.index, view.name, *numbers, pose

    def make() -> tuple[PackedMatte | None]:  # a value that is None would be made again
        small = view.scaled(min(1.0, WORK_WIDTH / view.width))
        kinds = _kinds_of_copy(scene, frame, lens_camera, small)
        if kinds is None:
            kinds = _kinds_in_view(scene, frame, small, rgb)
        return (None if kinds is None else _refine(rgb, kinds),)

    packed = memo_of(scene).get(key, make)[0]
    return None if packed is None else SkyMatte(*unpack_matte(packed, rgb))


def _kinds_of_copy(
    scene: Scene, frame: Frame, lens_camera: Camera, view: Camera
) -> UInt8[np.ndarray, "h w"] | None:
    """Return the kinds of pixels that the undistorted copy of an image tells of a view.

    Beyond the copy the nearest pixel counts. None where there is no copy, where it is too dark, or
    where it shows too little of the image. This is the same for all views of an image, so that the
    sky does not change from strip to strip.
    """
    of_frame = (f for f in scene.seen_frames or () if f.index == frame.index)
    copy_frame = next(of_frame, None)
    copy = None if copy_frame is None else copy_frame.cameras.get(view.name)
    if copy_frame is None or copy is None or not copy.is_pinhole:
        return None
    if _share_in_copy(frame.cameras[view.name], copy) < _MIN_COPY_SHARE:
        return None
    kinds = recorded_sky_regions(scene, copy_frame, view.name)
    if kinds is None:
        return None
    # The lens and its copy are of one camera, whatever the pose of a strip of the image.
    rays = turned_rays(view, turn_between(lens_camera, view))
    small = copy.resized(kinds.shape[1], kinds.shape[0])
    z = np.maximum(rays[..., 2], 1e-6)
    u = np.floor(small.fx * rays[..., 0] / z + small.cx)
    v = np.floor(small.fy * rays[..., 1] / z + small.cy)
    last_row = small.height - 1
    last_column = small.width - 1
    return kinds[v.clip(0, last_row).astype(int), u.clip(0, last_column).astype(int)]


def _share_in_copy(lens_camera: Camera, copy: Camera) -> float:
    """Return the share of an image's pixels, sampled, that its undistorted copy shows.

    Args:
        lens_camera: the camera with its lens.
        copy: the pinhole camera of the copy.
    """
    if lens_camera.lens is None:
        return 1.0
    columns = (np.arange(_SHARE_SAMPLES) + 0.5) * lens_camera.width / _SHARE_SAMPLES
    rows = (np.arange(_SHARE_SAMPLES) + 0.5) * lens_camera.height / _SHARE_SAMPLES
    pixels = np.stack(np.meshgrid(columns, rows), -1)
    rays, is_seen = lens_camera.lens.rays(pixels, lens_camera.intrinsics)
    is_seen &= rays[..., 2] > 0
    z = np.where(is_seen, rays[..., 2], 1.0)
    u = copy.fx * rays[..., 0] / z + copy.cx
    v = copy.fy * rays[..., 1] / z + copy.cy
    is_shown = is_seen & (u >= 0) & (u < copy.width) & (v >= 0) & (v < copy.height)
    return float(is_shown.mean())


def _kinds_in_view(
    scene: Scene, frame: Frame, view: Camera, rgb: UInt8[np.ndarray, "H W 3"]
) -> UInt8[np.ndarray, "h w"] | None:
    """Return the kinds of pixels that the image itself tells, as `find_sky_regions`."""
    points = sweep_of(scene, frame.index)
    if points is None:
        return find_regions(rgb, view)
    top_rad = highest_channel_rad(scene, points, view)
    return find_regions(rgb, view, find_returns(points, view), top_rad)


def recorded_sky_regions(scene: Scene, frame: Frame, name: str) -> UInt8[np.ndarray, "m n"] | None:
    """Return the kinds of the pixels of a camera's recorded image, as `find_sky_regions`.

    None where there is no image that can be read, or where it is too dark to tell.

    Args:
        scene: the scene.
        frame: one of its frames.
        name: name of the camera.
    """
    scene = scene.as_recorded
    key = "sky regions", frame.index, name
    return memo_of(scene).get(key, lambda: (_find_recorded_regions(scene, frame, name),))[0]


def _find_recorded_regions(scene: Scene, frame: Frame, name: str) -> np.ndarray | None:
    """Return the regions of a frame's image, as `recorded_sky_regions`."""
    path = frame.image_paths.get(name)
    if path is None:
        return None
    full_camera = frame.cameras[name]
    header = read_image_header(Path(path))
    width = min(WORK_WIDTH, full_camera.width, WORK_WIDTH if header is None else header.size[0])
    camera = full_camera.scaled(width / full_camera.width)
    rgb = read_small_image(Path(path), camera)
    if rgb is None:
        return None
    points = sweep_of(scene, frame.index)
    if points is None:
        return find_regions(rgb, camera)
    top_rad = highest_channel_rad(scene, points, camera)
    return find_regions(rgb, camera, find_returns(points, camera), top_rad)


def read_small_image(path: Path, camera: Camera) -> np.ndarray | None:
    """Return an image at the camera's size, RGB; None for what is no image of its proportions."""
    header = read_image_header(path)
    is_large = header is not None and header.size[0] >= 2 * camera.width
    image = decode_image(path, cv2.IMREAD_REDUCED_COLOR_2 if is_large else cv2.IMREAD_COLOR)
    if image is None:
        return None
    height, width = image.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1) > _MAX_SQUEEZE:
        return None
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_BGR2RGB)


# ---- From regions to shares ----------------------------------------------------------------------


def _refine(rgb: np.ndarray, kinds: np.ndarray) -> PackedMatte:
    """Return the matte of an image from the kinds of pixels of a smaller one."""
    height, width = rgb.shape[:2]
    is_sky_row = (kinds == SKY).any(axis=1)
    if not is_sky_row.any():
        return pack_matte(np.zeros((0, width), np.float32), rgb[:0], np.zeros((0, 0, 3), np.uint8))
    last = min(len(kinds), int(np.flatnonzero((kinds != 0).any(axis=1))[-1]) + 2)
    rows = min(height, -(-last * height // len(kinds)))
    kinds = kinds[:last]
    size = width, rows
    share = np.zeros((rows, width), np.float32)
    surface_rgb = rgb[:rows].copy()
    full_kinds = cv2.resize(kinds, size, interpolation=cv2.INTER_NEAREST)
    sky, noise = _sky_color(rgb[:rows], kinds)
    is_bright = _has_bright_surface(rgb[:rows], kinds, sky)
    is_bright = cv2.resize(is_bright, size, interpolation=cv2.INTER_NEAREST)
    sky_rgb = cv2.resize(sky, size, interpolation=cv2.INTER_LINEAR)
    noise = cv2.resize(noise, size, interpolation=cv2.INTER_LINEAR)
    # Blocks fit into the processor's cache, and those far from any sky are left out.
    margin = math.ceil(_MARGIN_PX * max(1.0, width / 1920))
    for top, left in itertools.product(
        range(0, rows, _BLOCK_SIZE_PX[0]), range(0, width, _BLOCK_SIZE_PX[1])
    ):
        block = (
            slice(top, min(top + _BLOCK_SIZE_PX[0], rows)),
            slice(left, min(left + _BLOCK_SIZE_PX[1], width)),
        )
        # Pixels of surfaces have no share, so that the rectangle around all others is enough.
        x, y, block_width, block_height = cv2.boundingRect(full_kinds[block])
        if block_width == 0:
            continue
        first = top + y, left + x
        end = first[0] + block_height, first[1] + block_width
        start = max(first[0] - margin, 0), max(first[1] - margin, 0)
        part = (
            slice(start[0], min(end[0] + margin, rows)),
            slice(start[1], min(end[1] + margin, width)),
        )
        part_share = np.zeros(full_kinds[part].shape, np.float32)
        part_surface = rgb[part].copy()
        _share_of_sky(
            rgb[part],
            full_kinds[part],
            sky_rgb[part],
            noise[part],
            is_bright[part],
            part_share,
            part_surface,
            width / 1920,
        )
        inner = (
            slice(first[0] - start[0], end[0] - start[0]),
            slice(first[1] - start[1], end[1] - start[1]),
        )
        share[first[0] : end[0], first[1] : end[1]] = part_share[inner]
        surface_rgb[first[0] : end[0], first[1] : end[1]] = part_surface[inner]
    return pack_matte(share, surface_rgb, sky)


def _sky_color(rgb: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sky's mean colour around each pixel, and the difference from it that is noise.

    Args:
        rgb: rows of the image.
        kinds: kinds of their pixels, in a smaller image.

    Returns:
        Colours, uint8 [h, w, 3], and differences, uint8 [h, w], at half the size of `kinds`.
    """
    size = max(1, kinds.shape[1] // 2), max(1, kinds.shape[0] // 2)
    sure = cv2.erode((kinds == SKY).astype(np.uint8), np.ones((3, 3), np.uint8))
    if not sure.any():
        sure = (kinds == SKY).astype(np.uint8)
    weight = cv2.resize(sure * 255, size, interpolation=cv2.INTER_AREA)
    weight = (weight == 255 if (weight == 255).any() else weight > 0).astype(np.float32)
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    luma = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    values = np.dstack([small.astype(np.float32), luma, luma * luma, np.ones_like(luma)])
    values *= weight[..., None]
    sums = values.mean(axis=(0, 1)) * _WINDOW_WEIGHT ** len(_SKY_WINDOWS_PX)
    for number, radius in enumerate(_SKY_WINDOWS_PX):
        side = 2 * radius + 1
        window = cv2.blur(values, (side, side), borderType=cv2.BORDER_REPLICATE)
        sums = sums + window * np.float32(_WINDOW_WEIGHT**number)
    means = sums[..., :5] / np.maximum(sums[..., 5:], 1e-20)
    deviation = np.sqrt(np.maximum(means[..., 4] - means[..., 3] ** 2, 0))
    noise = np.clip(_NOISE_DEVIATIONS * deviation, _NOISE_LEVELS, _MAX_NOISE_LEVELS)
    return np.rint(means[..., :3]).astype(np.uint8), np.rint(noise).astype(np.uint8)


def _has_bright_surface(rgb: np.ndarray, kinds: np.ndarray, sky: np.ndarray) -> np.ndarray:
    """Return 255 where a surface as bright as the sky is near, else 0, at the size of `kinds`.

    Args:
        rgb: rows of the image.
        kinds: kinds of their pixels, in a smaller image.
        sky: the sky's colours, at any size.
    """
    size = kinds.shape[1], kinds.shape[0]
    luma = cv2.cvtColor(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    is_surface = (kinds == SURFACE).astype(np.uint8)
    luma *= cv2.morphologyEx(is_surface, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    brightest = cv2.dilate(luma, np.ones((2 * _SURFACE_REACH_PX + 1,) * 2, np.uint8))
    sky_luma = cv2.cvtColor(cv2.resize(sky, size), cv2.COLOR_RGB2GRAY)
    return cv2.bitwise_not(_above(cv2.subtract(sky_luma, brightest), _DARK_SURFACE_LEVELS))


def _share_of_sky(
    rgb: np.ndarray,
    kinds: np.ndarray,
    sky_rgb: np.ndarray,
    noise: np.ndarray,
    has_bright_surface: np.ndarray,
    share: np.ndarray,
    surface_rgb: np.ndarray,
    scale: float,
) -> None:
    """Write the sky's share and the surfaces' colours of a part of an image.

    Args:
        rgb: the image's colours, uint8 [h, w, 3].
        kinds: kinds of the pixels.
        sky_rgb: the sky's colour at each pixel.
        noise: difference from it that is noise, uint8 [h, w].
        has_bright_surface: 255 where a surface as bright as the sky is near, else 0.
        share: the sky's share, which is written.
        surface_rgb: colours of the image, which are replaced in mixed pixels.
        scale: width of the whole image over 1920 pixels.
    """
    smooth = cv2.GaussianBlur(rgb, (3, 3), 0) if scale > 0.4 else rgb
    window = np.ones((2 * max(1, round(_EDGE_PX * scale)) + 1,) * 2, np.uint8)
    can_be_sky = _above(kinds, 0)
    is_sure = _above(kinds, EDGE)
    # Difference from the sky. Where no bright surface is near, brighter pixels are clouds, or the
    # overshoot of the camera's sharpening, which is paler than the sky.
    luma = cv2.cvtColor(smooth, cv2.COLOR_RGB2GRAY)
    difference = cv2.subtract(cv2.cvtColor(sky_rgb, cv2.COLOR_RGB2GRAY), luma)
    darker = largest_channel(cv2.subtract(sky_rgb, smooth))
    colored = cv2.threshold(darker, _PALE_LEVELS, 0, cv2.THRESH_TOZERO)[1]
    difference = cv2.max(difference, colored)
    if has_bright_surface.any():
        brighter = largest_channel(cv2.subtract(smooth, sky_rgb))
        color_difference = cv2.bitwise_and(cv2.max(darker, brighter), has_bright_surface)
        difference = cv2.max(difference, color_difference)
    difference = cv2.bitwise_and(difference, can_be_sky)
    largest = cv2.dilate(difference, window)
    # Pure sky, and the pixels beside it that may be mixed.
    pure_levels = cv2.max(cv2.convertScaleAbs(largest, alpha=_PURE_SHARE), noise)
    is_pure = cv2.bitwise_and(cv2.compare(difference, pure_levels, cv2.CMP_LE), can_be_sky)
    is_pure = cv2.bitwise_or(is_pure, is_sure)
    reach = 2 * max(1, round(_MIXED_PX * scale)) + 1
    is_mixed = cv2.bitwise_and(cv2.dilate(is_pure, np.ones((reach, reach), np.uint8)), can_be_sky)
    is_mixed = cv2.bitwise_and(is_mixed, cv2.bitwise_not(is_sure))
    np.copyto(share, cv2.threshold(is_sure, 0, 1, cv2.THRESH_BINARY)[1])
    mixed = np.flatnonzero(is_mixed != 0)
    levels = difference.ravel()[mixed]
    solid = levels / np.maximum(largest.ravel()[mixed], np.float32(1))
    share.ravel()[mixed] = 1 - solid * (levels > noise.ravel()[mixed])
    _remove_thin_things(luma, cv2.bitwise_or(is_sure, is_mixed), share, scale)
    _unmix(rgb, sky_rgb, share, surface_rgb)


def _remove_thin_things(
    luma: np.ndarray, is_searched: np.ndarray, share: np.ndarray, scale: float
) -> None:
    """Lower the sky's share where something dark and thin stands before it.

    Args:
        luma: the image's luma.
        is_searched: pixels that are looked at, uint8, 0 or 255.
        share: the sky's share, which is written.
        scale: width of the whole image over 1920 pixels.
    """
    side = 2 * max(1, round(_THIN_PX * scale / 2)) + 1
    darkness = cv2.morphologyEx(luma, cv2.MORPH_BLACKHAT, np.ones((side, side), np.uint8))
    darkness = cv2.bitwise_and(darkness, is_searched)
    darkest = cv2.dilate(darkness, np.ones((5, 5), np.uint8))
    is_thin = cv2.bitwise_and(
        _above(darkest, _MIN_THIN_LEVELS), _above(darkness, _THIN_NOISE_LEVELS)
    )
    thin = np.flatnonzero(is_thin != 0)
    depth = darkness.ravel()[thin].astype(np.float32)
    # A wire is thinner than a pixel: how dark it is shows how much of the sky it hides.
    solid = depth / ((1 - _THIN_LUMA_SHARE) * (luma.ravel()[thin] + depth))
    share.ravel()[thin] = np.minimum(share.ravel()[thin], 1 - np.minimum(solid, 1))


def _above(image: np.ndarray, level: int) -> np.ndarray:
    """Return 255 where an image of bytes is above a level, else 0."""
    return cv2.threshold(image, level, 255, cv2.THRESH_BINARY)[1]


def _unmix(
    rgb: np.ndarray, sky_rgb: np.ndarray, share: np.ndarray, surface_rgb: np.ndarray
) -> None:
    """Write the surfaces' colours of mixed pixels: F = S + (I - S) / (1 - a)."""
    mixed = np.flatnonzero(np.abs(share - np.float32(0.5)) < 0.5 - _MIN_SHARE)
    sky = sky_rgb.reshape(-1, 3)[mixed].astype(np.float32)
    solid = 1 - share.ravel()[mixed][:, None]
    color = sky + (rgb.reshape(-1, 3)[mixed] - sky) / np.maximum(solid, _MIN_SOLID)
    surface_rgb.reshape(-1, 3)[mixed] = np.clip(np.rint(color), 0, 255).astype(np.uint8)
