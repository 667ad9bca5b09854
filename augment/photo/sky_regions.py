"""Regions of a recorded image that show sky, by contrast, LiDAR and colour.

In: a small image, the elevation of its rays, and its LiDAR returns where there are any. Out: the
kind of every pixel (`SURFACE`, `EDGE`, `SOFT_EDGE`, `SKY`). `augment.photo.sky_matte` refines it.

1. Pixels of low contrast form connected regions. Roofs, poles and wires have sharp edges, and
   clouds have soft ones, so that a region is sky or surface as a whole.
2. A region with LiDAR returns is a surface. Where the LiDAR looked over all surfaces of a column
   and met nothing, a region is open. Large open regions at the top of the image are the sky.
3. Other regions are judged by their colour: by the ratio of its shares in the histograms of the
   sky and of surfaces. Bright regions with soft edges are clouds.
4. Pixels of high contrast are edges. Those near the sky may show both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

# Kind of a pixel that shows a surface.
SURFACE = 0
# Kind of a pixel of high contrast beside the sky, which may show both.
EDGE = 1
# Kind of a pixel of high contrast inside the sky, which may show a cloud or a thin thing.
SOFT_EDGE = 2
# Kind of a pixel of a region of sky.
SKY = 3

# Columns of the image in which regions are looked for, at most.
WORK_WIDTH = 640
# Difference of the highest and lowest value of a pixel and its neighbours, from which there is an
# edge, of 255: sunlit clouds have 8 to 14, noise at dusk 6.
_EDGE_LEVELS = 14
# The same of an edge that no cloud has.
_SHARP_LEVELS = 40
# The same below which an edge is as soft as a cloud's.
_CLOUD_LEVELS = 28
# Share of soft edges around a cloud, at least: the others are those of roofs below it.
_CLOUD_EDGE_SHARE = 0.5
# The same of a cloud that is brighter than the sky.
_GLARE_EDGE_SHARE = 0.3
# Factor by which an image is shrunk where it has no sky at its own size: its edges may be blurred.
_BLURRED_FACTOR = 3
# Columns of an image that is shrunk for this, at least.
_MIN_BLURRED_WIDTH = 300
# Luma of a region below which it is no sky, of 255, where the LiDAR says that it is open.
_MIN_LUMA = 60.0
# The same without LiDAR.
_MIN_LUMA_ALONE = 90.0
# Difference from the brightest large region beyond which a region is no sky without LiDAR, of 255.
_DARK_LEVELS = 70.0
# Share of the image from which an open region is sky without a look at its colour.
_MAIN_SHARE = 0.003
# The same for a region that does not reach the image's first rows.
_INNER_MAIN_SHARE = 0.01
# Last row at which a region reaches the image's top: lenses darken the first rows.
_TOP_ROWS = 2
# Share of a region's inner pixels with returns up to which it may be sky: poles near the camera
# have moved between the LiDAR's look and the camera's.
_FEW_RETURNS = 0.02
# The same for a region whose colour is the sky's beyond doubt.
_SOME_RETURNS = 0.12
# Mean logarithm of the ratio of colour shares from which a region is sky, where it is open.
_SKY_SCORE = 1.5
# The same where the LiDAR does not say that it is open.
_SURE_SCORE = 2.0
# The same below which a region is a surface whatever its edges are.
_SURFACE_SCORE = -1.5
# Least share of a colour in a histogram: colours that neither has tell nothing.
_RARE_SHARE = 2e-6
# Margin below the LiDAR's highest channel, within which a return is of that channel.
_TOP_MARGIN_RAD = math.radians(2.0)
# Columns beside one whose surface goes on that may show the same surface, as a part of the width.
_BESIDE_SHARE = 0.015
# Luma of a cloud over that of the sky, at least.
_CLOUD_LUMA_SHARE = 0.7
# Distance from the sky up to which edges may show it, pixels.
_EDGE_REACH_PX = 5
# Area below which a region that lies wholly beside the sky counts as an edge, pixels.
_SMALL_AREA_PX = 200
# Width of things before the sky, as poles and cables, between which it shows in gaps, pixels.
_GAP_PX = 10
# Rounds in which gaps beside gaps are found.
_GAP_ROUNDS = 2
# Distance from surfaces from which an edge is inside the sky, pixels.
_INSIDE_PX = 6
# Rows over the highest return of a column that its surface may still fill, as a part of the height.
_GAP_SHARE = 0.03


class _Pixels(NamedTuple):
    """Facts about the pixels of the image's rows above the horizon, [H, W] each."""

    rgb: np.ndarray
    """Colours, [H, W, 3]."""
    luma: np.ndarray
    """Luma, uint8."""
    contrast: np.ndarray
    """Largest difference of a channel between a pixel and its neighbours, uint8."""
    is_above: np.ndarray
    """True above the horizon."""
    is_hit: np.ndarray
    """True at LiDAR returns and beside them."""
    is_open: np.ndarray
    """True where the LiDAR looked over all surfaces of the column, or where there is no LiDAR."""
    has_lidar: bool
    """False without LiDAR."""


class _Regions(NamedTuple):
    """Connected regions of low contrast, R with number 0, which is all the rest."""

    labels: np.ndarray
    """Number of each pixel's region, int32 [H, W]; 0 at edges and below the horizon."""
    area: np.ndarray
    """Number of pixels, [R]."""
    returns: np.ndarray
    """Share of the inner pixels with LiDAR returns, [R]."""
    open: np.ndarray
    """Share of the pixels that are open, [R]."""
    luma: np.ndarray
    """Mean luma, [R]."""
    is_at_top: np.ndarray
    """True for regions that reach the image's first rows, [R]."""
    soft_edges: np.ndarray
    """Share of the edges around that are as soft as those of clouds, [R]."""


def find_sky_regions(
    rgb: UInt8[np.ndarray, "H W 3"],
    elevation_rad: Float[np.ndarray, "H W"],
    has_return: Bool[np.ndarray, "H W"] | None = None,
    lidar_top_rad: float = math.inf,
) -> UInt8[np.ndarray, "H W"] | None:
    """Return the kind of every pixel; None where the image is too dark to tell.

    Args:
        rgb: the image, at most WORK_WIDTH wide.
        elevation_rad: elevation of the pixels' rays above the horizon.
        has_return: pixels with a LiDAR return; None without LiDAR.
        lidar_top_rad: elevation of the LiDAR's highest channel; above a surface that reaches it, a
            wall may go on.
    """
    kinds = np.zeros(rgb.shape[:2], np.uint8)
    above = elevation_rad > 0
    if not above.any():
        return kinds
    rows = int(np.flatnonzero(above.any(axis=1))[-1]) + 1
    rgb = np.ascontiguousarray(rgb[:rows])
    above = above[:rows]
    is_hit = np.zeros_like(above)
    is_open = above
    if has_return is not None:
        is_hit = _grow(has_return[:rows], 3)
        is_open = above & _open_pixels(
            has_return[:rows], is_hit, elevation_rad[:rows], lidar_top_rad
        )
    pixels = _Pixels(
        rgb=rgb,
        luma=cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY),
        contrast=_contrast(rgb),
        is_above=above,
        is_hit=is_hit,
        is_open=is_open,
        has_lidar=has_return is not None,
    )
    regions = _measure_regions(pixels)
    main = _find_main_regions(regions, kinds.size, pixels.has_lidar)
    if not main.any():
        if np.quantile(pixels.luma[above], 0.9) < _MIN_LUMA_ALONE:
            return None
        if rgb.shape[1] >= _MIN_BLURRED_WIDTH and has_return is not None:
            kinds[:rows] = _find_in_smaller_image(rgb, elevation_rad, has_return, lidar_top_rad)
        return kinds
    score = _color_scores(pixels, regions, main)
    sky_luma = float(np.average(regions.luma[main], weights=regions.area[main]))
    is_sky_region = main | _find_other_regions(regions, main, score, sky_luma, pixels.has_lidar)
    is_sky_region[0] = False
    kinds[:rows] = _pixel_kinds(pixels, regions, is_sky_region, score, sky_luma)
    return kinds


def _find_in_smaller_image(
    rgb: np.ndarray, elevation_rad: np.ndarray, has_return: np.ndarray, lidar_top_rad: float
) -> np.ndarray:
    """Return the kinds of pixels of some rows, as found in a smaller image.

    In a blurred image, sky and walls run into each other without an edge of _EDGE_LEVELS.
    """
    rows, columns = rgb.shape[:2]
    size = -(-columns // _BLURRED_FACTOR), -(-rows // _BLURRED_FACTOR)
    square = np.ones((_BLURRED_FACTOR, _BLURRED_FACTOR), np.uint8)
    grown_returns = cv2.dilate(has_return[:rows].astype(np.uint8), square)
    kinds = find_sky_regions(
        cv2.resize(rgb, size, interpolation=cv2.INTER_AREA),
        cv2.resize(elevation_rad[:rows], size, interpolation=cv2.INTER_AREA),
        cv2.resize(grown_returns, size, interpolation=cv2.INTER_NEAREST) > 0,
        lidar_top_rad,
    )
    if kinds is None:
        return np.zeros((rows, columns), np.uint8)
    return cv2.resize(kinds, (columns, rows), interpolation=cv2.INTER_NEAREST)


def _open_pixels(
    has_return: np.ndarray, is_hit: np.ndarray, elevation_rad: np.ndarray, lidar_top_rad: float
) -> np.ndarray:
    """Return the pixels above all returns of a column in which the LiDAR looked over them."""
    half_width = round(_BESIDE_SHARE * has_return.shape[1])
    reaches_top = np.any(has_return & (elevation_rad > lidar_top_rad - _TOP_MARGIN_RAD), axis=0)
    reaches_top = _grow(reaches_top[None], 2 * half_width + 1)[0]
    return (np.cumsum(is_hit, axis=0, dtype=np.int32) == 0) & ~reaches_top


def _contrast(rgb: np.ndarray) -> np.ndarray:
    """Return the largest difference of a channel between a pixel and its neighbours, uint8."""
    smooth = cv2.GaussianBlur(rgb, (3, 3), 0)
    square = np.ones((3, 3), np.uint8)
    return largest_channel(cv2.subtract(cv2.dilate(smooth, square), cv2.erode(smooth, square)))


def largest_channel(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
    """Return the largest of the three channels."""
    first, second, third = cv2.split(image)
    return cv2.max(cv2.max(first, second), third)


def _grow(mask: np.ndarray, size: int) -> np.ndarray:
    """Return a mask grown by a square of `size` pixels."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0


def _measure_regions(pixels: _Pixels) -> _Regions:
    """Return the regions of low contrast above the horizon."""
    is_low = ((pixels.contrast < _EDGE_LEVELS) & pixels.is_above).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        is_low, connectivity=4, ltype=cv2.CV_32S
    )
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)

    def count_in(mask: np.ndarray) -> np.ndarray:
        return np.bincount(labels[mask], minlength=count)

    is_inner = cv2.erode(is_low, np.ones((5, 5), np.uint8)) > 0
    is_edge = labels == 0
    # Many small regions lie around few edges: the highest number beside an edge gets it.
    beside = cv2.dilate(labels.astype(np.uint16), np.ones((5, 5), np.uint8))[is_edge]
    num_edges = np.bincount(beside, minlength=count)
    num_soft = np.bincount(beside, pixels.contrast[is_edge] < _CLOUD_LEVELS, count)
    return _Regions(
        labels=labels,
        area=area,
        returns=count_in(pixels.is_hit & is_inner) / np.maximum(count_in(is_inner), 1),
        open=count_in(pixels.is_open) / area.clip(1),
        luma=np.bincount(labels.ravel(), pixels.luma.ravel(), count) / area.clip(1),
        is_at_top=stats[:, cv2.CC_STAT_TOP] <= _TOP_ROWS,
        soft_edges=num_soft / np.maximum(num_edges, 1),
    )


def _find_main_regions(regions: _Regions, num_pixels: int, has_lidar: bool) -> np.ndarray:
    """Return the regions that are sky without a look at their colour, bool [R]."""
    is_large = regions.area > _MAIN_SHARE * num_pixels
    is_free = (regions.open > 0.5) & (regions.returns < _FEW_RETURNS)
    is_free[0] = False
    is_bright = regions.luma > _MIN_LUMA
    if not has_lidar:
        brightest = max(regions.luma[1:][is_large[1:] & regions.is_at_top[1:]], default=0.0)
        is_bright = regions.luma > max(_MIN_LUMA_ALONE, brightest - _DARK_LEVELS)
    main = is_large & is_free & is_bright & regions.is_at_top
    if main.any() or not has_lidar:
        return main
    is_wide = regions.area > _INNER_MAIN_SHARE * num_pixels
    return is_wide & is_free & is_bright


def _color_scores(pixels: _Pixels, regions: _Regions, main: np.ndarray) -> np.ndarray:
    """Return the mean logarithm of each region's colour shares in the sky over surfaces', [R]."""
    levels = np.asarray(cv2.GaussianBlur(pixels.rgb, (5, 5), 0), np.int32) // 8
    colors = ((levels[..., 0] << 10) | (levels[..., 1] << 5) | levels[..., 2]).ravel()
    is_main = main[regions.labels]
    is_surface = ~is_main
    if pixels.has_lidar:
        has_returns = regions.returns > 2.5 * _FEW_RETURNS
        has_returns[0] = False
        is_surface = has_returns[regions.labels] | pixels.is_hit

    def shares(mask: np.ndarray) -> np.ndarray:
        counts = np.bincount(colors[mask.ravel()], minlength=1 << 15).astype(np.float32)
        cube = counts.reshape(32, 32, 32)
        for axis in range(3):
            cube = _blur_histogram(cube, axis)
        return cube.ravel() / max(float(cube.sum()), 1.0)

    ratio = np.log((shares(is_main) + _RARE_SHARE) / (shares(is_surface) + _RARE_SHARE))
    sums = np.bincount(regions.labels.ravel(), ratio[colors], len(regions.area))
    return sums / regions.area.clip(1)


def _blur_histogram(cube: np.ndarray, axis: int) -> np.ndarray:
    """Return a histogram blurred along an axis."""
    return cube + 0.6 * (np.roll(cube, 1, axis) + np.roll(cube, -1, axis))


def _find_other_regions(
    regions: _Regions, main: np.ndarray, score: np.ndarray, sky_luma: float, has_lidar: bool
) -> np.ndarray:
    """Return the regions whose colour or soft edges say that they are sky, bool [R]."""
    is_free = (regions.returns < 1.5 * _FEW_RETURNS) & (regions.luma > _MIN_LUMA)
    is_open = regions.open > 0.5
    has_sky_color = is_free & is_open & (score > _SKY_SCORE)
    # Gaps between things before the sky, under surfaces that hide whether they are open.
    is_like_sky = is_free & (score > _SURE_SCORE)
    is_like_sky |= (score > 1.5 * _SURE_SCORE) & (regions.returns < _SOME_RETURNS)
    can_be_gap = regions.is_at_top
    for _ in range(_GAP_ROUNDS):
        has_sky_color |= can_be_gap & is_like_sky
        can_be_gap = _regions_near(regions, main | has_sky_color)
    has_sky_color |= can_be_gap & is_like_sky
    if not has_lidar:
        return has_sky_color
    can_be_cloud = is_free & (regions.open > 0.9) & (score > _SURFACE_SCORE)
    is_cloud = can_be_cloud & (regions.soft_edges > _CLOUD_EDGE_SHARE)
    is_cloud &= regions.luma > _CLOUD_LUMA_SHARE * sky_luma
    is_glare = can_be_cloud & (regions.soft_edges > _GLARE_EDGE_SHARE)
    is_glare &= regions.luma > sky_luma
    return has_sky_color | is_cloud | is_glare


def _regions_near(regions: _Regions, is_sky_region: np.ndarray) -> np.ndarray:
    """Return the regions within _GAP_PX of some regions, bool [R]."""
    is_sky = is_sky_region[regions.labels] & (regions.labels > 0)
    is_near = _grow(is_sky, 2 * _GAP_PX + 1)
    return np.bincount(regions.labels[is_near], minlength=len(is_sky_region)) > 0


def _pixel_kinds(
    pixels: _Pixels,
    regions: _Regions,
    is_sky_region: np.ndarray,
    score: np.ndarray,
    sky_luma: float,
) -> np.ndarray:
    """Return the kind of every pixel, as `find_sky_regions`."""
    is_sky = is_sky_region[regions.labels]
    # A pale wall and a pale sky without an edge between them: the wall ends near its returns.
    is_mixed = (
        ~is_sky_region & (regions.open > 0.3) & regions.is_at_top & (score > 0)
        & (regions.luma > _MIN_LUMA) & (regions.area > _MAIN_SHARE * pixels.luma.size)
    )  # fmt: skip
    is_mixed[0] = False
    if is_mixed.any():
        gap = 2 * round(_GAP_SHARE * len(pixels.luma)) + 1
        is_far_over = cv2.erode(pixels.is_open.astype(np.uint8), np.ones((gap, 1), np.uint8)) > 0
        is_sky |= is_mixed[regions.labels] & is_far_over
    is_edge = regions.labels == 0
    is_surface_region = ~is_sky_region & (
        (regions.returns > 0) | (score < _SURFACE_SCORE) | (regions.open < 0.5)
    )
    is_surface_region[0] = False
    is_solid = is_surface_region[regions.labels] | ~pixels.is_above | pixels.is_hit
    # Things before the sky have sharp edges or are darker than any cloud.
    square = np.ones((9, 9), np.uint8)
    is_soft = cv2.dilate(pixels.contrast, square) < _SHARP_LEVELS
    is_soft |= cv2.erode(pixels.luma, square) > _CLOUD_LUMA_SHARE * sky_luma
    is_inside = ~_grow(is_solid, 2 * _INSIDE_PX + 1) & is_soft
    is_near = pixels.is_above & _grow(is_sky, 2 * _EDGE_REACH_PX + 1)
    is_small = ~is_sky_region & (regions.area < _SMALL_AREA_PX) & (regions.returns < _FEW_RETURNS)
    is_small[regions.labels[~is_near]] = False  # wholly beside the sky
    is_near &= is_edge | is_small[regions.labels]
    kinds = np.where(is_near, np.where(is_inside, SOFT_EDGE, EDGE), SURFACE)
    return np.where(is_sky, SKY, kinds).astype(np.uint8)
