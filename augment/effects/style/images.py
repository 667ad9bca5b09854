"""Style images: read from a file into a small picture with weights and a sky mask.

`read_style_image` opens a file, `image_statistics` gives the colour statistics of its regions.
Their caller is `augment.effects.style.style`; the training reads its photos here, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from augment.effects.style.statistics import (
    LAND,
    REST,
    ROAD,
    SKY,
    VEGETATION,
    WHOLE,
    ColorStatistics,
    Statistics,
)
from augment.errors import StyleError
from augment.files.image_size import FORMATS, ImageHeader, image_header
from recipes.files import open_file

# ---- Where a picture shows sky, vegetation and road ----------------------------------------------
# Regions are found by colour and position, and only where they are clear. A missed region takes
# the map of the whole picture or of all the land. A wrong region gives a sky the colours of a wall.

# Longer side of the small picture in which regions are found.
_REGION_SIDE_PX = 128
# Colour steps that may end a sky; the best of these thresholds is taken.
_STEP_THRESHOLDS = np.geomspace(0.015, 0.2, 20)
# Smallest share of the picture that a region has; statistics need more than a few pixels.
_MIN_SHARE = 0.04
# Smallest share of the picture's columns that begin with sky.
_MIN_COLUMN_SHARE = 0.6
# Shorter side from which a picture is searched for regions.
_MIN_SIDE_PX = 16


def find_sky(rgb: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the sky mask of a picture, bool [H, W]; all False if no sky is clear.

    In every column a sky reaches from the top to the first step of colour. The threshold of a step
    is the one that leaves sky and land with the least variation of colour (after Shen and Wang
    2013, "Sky region detection in a single image", eq. 4). The sky is accepted if it is wide,
    smoother than the land, and brighter or bluer: see `_is_sky`.

    Args:
        rgb: display-encoded colours, float32 [H, W, 3] in [0, 1].
        weights: weights of the pixels, float32 [H, W]; pixels of weight 0 are never sky.
    """
    if min(weights.shape) < _MIN_SIDE_PX:
        return np.zeros(weights.shape, bool)
    small = _shrink_for_regions(rgb)
    small_weights = _shrink_for_regions(weights)
    color_steps = _color_steps(small)
    border = _best_border(small, small_weights, color_steps)
    sky = (np.arange(len(small))[:, None] < border) & (small_weights > 0)
    if not _is_sky(small, sky, color_steps):
        return np.zeros(weights.shape, bool)
    sky = _grow_sky(small, sky, color_steps, border)
    return _enlarge_mask(sky, weights.shape) & (weights > 0)


def region_masks(rgb: np.ndarray, weights: np.ndarray, sky: np.ndarray) -> dict[str, np.ndarray]:
    """Return masks, bool [H, W], of the regions that the picture shows clearly, by region.

    SKY and LAND divide the picture if both are visible. VEGETATION is land that is greener than it
    is red or blue, and neither black nor white. ROAD is land that is grey and smooth, lies in the
    lower half and reaches the bottom edge. It is looked for below a sky only, because indoors such
    a region is a table. REST is the remaining land, if vegetation or road was found. No region is
    smaller than 4 % of the picture.

    Args:
        rgb: display-encoded colours, float32 [H, W, 3] in [0, 1].
        weights: weights of the pixels, float32 [H, W].
        sky: sky mask, bool [H, W].
    """
    min_pixels = _MIN_SHARE * sky.size
    masks: dict[str, np.ndarray] = {}
    is_outdoors = sky.sum() >= min_pixels
    land_mask = ~sky & (weights > 0)
    if is_outdoors and land_mask.sum() >= min_pixels:
        masks |= {SKY: sky, LAND: land_mask}
    if min(sky.shape) < _MIN_SIDE_PX:
        return masks
    vegetation_mask = _green_mask(rgb) & land_mask
    road_mask = (
        _road_mask(rgb) & land_mask & ~vegetation_mask if is_outdoors else np.zeros_like(land_mask)
    )
    land_masks = {
        name: mask
        for name, mask in ((VEGETATION, vegetation_mask), (ROAD, road_mask))
        if mask.sum() >= min_pixels
    }
    rest_mask = land_mask & ~np.logical_or.reduce([*land_masks.values(), np.zeros_like(land_mask)])
    if land_masks and rest_mask.sum() >= min_pixels:
        land_masks[REST] = rest_mask
    return masks | land_masks


def _shrink_for_regions(values: np.ndarray) -> np.ndarray:
    """Return values [H, W, ...], averaged to at most _REGION_SIDE_PX on the longer side."""
    height, width = values.shape[:2]
    scale = min(1.0, _REGION_SIDE_PX / max(height, width))
    size = (max(4, round(width * scale)), max(4, round(height * scale)))
    return cv2.resize(values, size, interpolation=cv2.INTER_AREA)


def _enlarge_mask(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the mask at the size of the picture."""
    size = (shape[1], shape[0])
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _color_steps(small: np.ndarray) -> np.ndarray:
    """Return the slope of the steepest channel at each pixel, per pixel, [h, w]."""
    blurred = cv2.GaussianBlur(small, (3, 3), 0)
    across, down = (cv2.Sobel(blurred, cv2.CV_32F, *axis, ksize=3) for axis in ((1, 0), (0, 1)))
    return (np.abs(across) + np.abs(down)).max(2) / 4


def _best_border(small: np.ndarray, weights: np.ndarray, color_steps: np.ndarray) -> np.ndarray:
    """Return the number of sky rows of each column for the best of _STEP_THRESHOLDS, int [w]."""
    is_step = color_steps[None] > _STEP_THRESHOLDS[:, None, None].astype(np.float32)
    last_row = np.ones_like(is_step[:, :1])  # a column without a step is sky to its last row
    borders = np.concatenate([is_step, last_row], axis=1).argmax(1)  # [S, w]
    energies = _border_energies(small, weights, borders)
    border = borders[int(np.argmax(energies))].astype(np.uint8)
    # A step that was missed in one or two columns must not cut sky into the land.
    smooth_border = cv2.medianBlur(border[None], 9)[0]
    return np.minimum(border, smooth_border + 2).astype(np.int64)


def _border_energies(small: np.ndarray, weights: np.ndarray, borders: np.ndarray) -> np.ndarray:
    """Return how well each of the borders [S, w] divides the picture, [S].

    The energy 1 / (2 |S| + |G| + 2 s1 + g1) is large where the colours of both sides vary little.
    S and G are the covariances of the sky and the ground, in steps of 8 bits, and s1 and g1 their
    largest eigenvalues.
    """
    terms = np.concatenate([np.ones((*weights.shape, 1)), small], axis=2)  # [h, w, 4]
    weighted_terms = terms * weights[..., None]
    products = weighted_terms[..., :, None] * terms[..., None, :]  # [h, w, 4, 4]
    sums = np.concatenate([np.zeros_like(products[:1]), np.cumsum(products, axis=0)])
    sky = sums[borders, np.arange(borders.shape[1])].sum(1)  # [S, 4, 4]
    ground = sums[-1].sum(0) - sky
    share = sky[:, 0, 0] / max(sums[-1, :, 0, 0].sum(), 1e-9)
    is_valid = (share >= _MIN_SHARE) & (share <= 1 - _MIN_SHARE)
    spread_sum = sum(
        weight * spread
        for weight, side_sums in ((2, sky), (1, ground))
        for spread in _covariance_size(side_sums)
    )
    return np.where(is_valid, 1 / np.maximum(spread_sum, 1e-9), 0.0)


def _covariance_size(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return determinants and largest eigenvalues of covariances, from product sums [S, 4, 4]."""
    weight = np.maximum(sums[:, 0, 0], 1e-9)[:, None]
    mean = sums[:, 0, 1:] / weight
    covariance = sums[:, 1:, 1:] / weight[..., None] - mean[:, :, None] * mean[:, None, :]
    covariance *= 255.0**2
    return np.linalg.det(covariance), np.linalg.eigvalsh(covariance)[:, -1]


def _is_sky(small: np.ndarray, sky: np.ndarray, color_steps: np.ndarray) -> bool:
    """Return True if the region at the top must be a sky: by day, at dusk, overcast, or lit night.

    The thresholds were chosen by eye on photographs of skies and of walls, water, leaves and rooms.
    """
    share = sky.mean()
    column_share = (sky.sum(0) > len(sky) // 25).mean()
    if not _MIN_SHARE <= share <= 1 - _MIN_SHARE or column_share < _MIN_COLUMN_SHARE:
        return False
    red, green, blue = small[sky].mean(0).tolist()
    land = small[~sky].mean(0).tolist()
    brightness_gain = (red + green + blue - sum(land)) / 3
    roughness_ratio = float(color_steps[sky].mean() / max(float(color_steps[~sky].mean()), 1e-6))
    if roughness_ratio > 0.55 or max(red, green, blue) < 0.15 or green > max(red, blue) + 0.07:
        return False  # texture; black; leaves out of focus
    if blue < red - 0.1:
        return brightness_gain > 0.2 and roughness_ratio < 0.5  # dusk; else a wall in warm light
    blueness_gain = (blue - red) - (land[2] - land[0])
    return brightness_gain > 0.08 or (
        brightness_gain > -0.2 and blue - red > 0.12 and blueness_gain > 0.1
    )


def _grow_sky(
    small: np.ndarray, sky: np.ndarray, color_steps: np.ndarray, border: np.ndarray
) -> np.ndarray:
    """Return the sky mask, extended by connected pixels of the sky's colours.

    Pixels lower than nearly all of the sky are not added. The first step of a column may be a cloud
    or a wire, with more sky below.
    """
    sky_colors = small[sky].astype(np.float64)
    color_difference = small - sky_colors.mean(0)
    precision = np.linalg.inv(np.cov(sky_colors.T) + 0.02**2 * np.eye(3))
    is_sky_color = ((color_difference @ precision) * color_difference).sum(2) < 3.0**2
    is_sky_color &= np.abs(color_difference).max(2) < 0.25
    is_high = np.arange(len(small))[:, None] < np.percentile(border, 90)
    candidates = sky | (is_sky_color & is_high & (color_steps < 0.1))
    _, component_ids = cv2.connectedComponents(candidates.astype(np.uint8), connectivity=4)
    return np.isin(component_ids, np.unique(component_ids[sky]))


def _green_mask(rgb: np.ndarray) -> np.ndarray:
    """Return the mask of pixels with the colours of vegetation."""
    red = rgb[..., 0]
    green = rgb[..., 1]
    blue = rgb[..., 2]
    total = red + green + blue
    has_green_excess = 2 * green - red - blue > 0.1 * total
    return has_green_excess & (green > red) & (blue < 0.85 * green) & (total > 0.15) & (total < 2.4)


def _road_mask(rgb: np.ndarray) -> np.ndarray:
    """Return the mask of grey, smooth pixels that are connected to the bottom edge."""
    small = _shrink_for_regions(rgb)
    max_channel = small.max(2)
    min_channel = small.min(2)
    grey_mask = (
        (max_channel - min_channel < 0.2 * max_channel)
        & (max_channel > 0.1)
        & (_color_steps(small) < 0.08)
    )
    grey_mask[: len(grey_mask) // 2] = False
    _, component_ids = cv2.connectedComponents(grey_mask.astype(np.uint8), connectivity=4)
    bottom_ids = np.unique(component_ids[-1])
    return _enlarge_mask(np.isin(component_ids, bottom_ids[bottom_ids > 0]), rgb.shape)


# Longest side of a style image in memory. Colours need no more, and all later work costs the same
# for every file.
SIDE_PX = 512
# Largest size of an image file.
MAX_BYTES = 256 * 1024**2
# Largest number of pixels of an image file; averaging one with alpha takes about 1 GiB.
MAX_PIXELS = 64_000_000
# Number of pixels above which statistics take every second row and column only.
_MAX_STATISTICS_PIXELS = 65_536
# Relative error that a mask's aspect ratio may have: the rounding to a pixel of a small mask.
_SHAPE_TOLERANCE = 0.02

# OpenCV's flags by the factor that they shrink a JPEG by. libjpeg averages while it decodes, which
# costs less than to decode all pixels.
_REDUCED_FLAGS = {
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
}


@dataclass(frozen=True, eq=False)
class StyleImage:
    """A style image in memory, upright and at most SIDE_PX on its longer side."""

    rgb: Float32[np.ndarray, "H W 3"]
    """Display-encoded colours in [0, 1]."""

    weights: Float32[np.ndarray, "H W"]
    """Weights of the pixels in [0, 1]: their alpha."""

    sky: Bool[np.ndarray, "H W"]
    """Sky mask."""


def read_style_image(path: Path, mask: Path | None = None) -> StyleImage:
    """Read a style image from a file: 8 or 16 bits, grey, colour, palette, CMYK (JPEG), or alpha.

    EXIF's orientation is followed. CMYK is read as inverted, as Photoshop writes it and browsers
    read it, and without its colour profile.

    Args:
        path: the image file.
        mask: an image file of the same aspect ratio, white where the style image shows sky (more
            than half white counts). None to find the sky in the image.

    Raises:
        StyleError: a file cannot be read, is no image of these kinds, is too large or fully
            transparent, or the mask's shape is not the image's.
    """
    bgr, alpha = _read_pixels(Path(path), "style image")
    if alpha is not None and not alpha.any():
        raise StyleError(f"style image {path}: is fully transparent; it shows no colour to take on")
    rgb, weights = _shrink(bgr[..., ::-1], alpha)
    sky = (
        find_sky(rgb, weights)
        if mask is None
        else _read_mask(Path(mask), bgr.shape, rgb.shape, path)
    )
    return StyleImage(rgb, weights, sky)


def image_statistics(image: StyleImage) -> Statistics:
    """Return the colour statistics of the image's regions.

    WHOLE is always among them, SKY and LAND if the image shows both, and VEGETATION, ROAD and REST
    if they were found.
    """
    step = 1 if image.sky.size <= _MAX_STATISTICS_PIXELS else 2
    image = StyleImage(
        *(values[::step, ::step] for values in (image.rgb, image.weights, image.sky))
    )
    masks = region_masks(image.rgb, image.weights, image.sky)
    part_map = np.zeros(image.sky.shape, np.int64)  # a pixel is in one part and counts once
    parts_of_region = {WHOLE: {0}}
    for number, (region, mask) in enumerate(masks.items(), start=1):
        if region != LAND:
            part_map[mask] = number
            parts_of_region[WHOLE].add(number)
            parts_of_region[region] = {number}
    if SKY in parts_of_region:
        parts_of_region[LAND] = parts_of_region[WHOLE] - parts_of_region[SKY]
    sums = _product_sums(image, part_map, len(masks) + 1)
    return {
        region: _statistics_of_parts(sums, sorted(part_numbers))
        for region, part_numbers in parts_of_region.items()
    }


def _product_sums(image: StyleImage, parts: np.ndarray, count: int) -> np.ndarray:
    """Return weighted sums of products of (1, r, g, b) in each part, float64 [count, 4, 4]."""
    labels = parts.ravel()
    weights = image.weights.ravel().astype(np.float64)
    channels = [np.ones_like(weights), *image.rgb.reshape(-1, 3).T.astype(np.float64)]
    sums = np.empty((count, 4, 4))
    for i in range(4):
        weighted = weights * channels[i]
        for j in range(i, 4):
            sums[:, i, j] = np.bincount(labels, weighted * channels[j], minlength=count)
            sums[:, j, i] = sums[:, i, j]
    return sums


def _statistics_of_parts(sums: np.ndarray, parts: list[int]) -> ColorStatistics:
    """Return the statistics of these parts together, from product sums [P, 4, 4]."""
    total = sums[:, 0, 0].sum()
    part_sums = sums[parts].sum(0)
    mean = part_sums[0, 1:] / part_sums[0, 0]
    covariance = part_sums[1:, 1:] / part_sums[0, 0] - np.outer(mean, mean)
    # A constant colour's variance is zero less rounding.
    values, vectors = np.linalg.eigh(covariance)
    if values[0] < 0:
        covariance = (vectors * np.maximum(values, 0)) @ vectors.T
        covariance = (covariance + covariance.T) / 2
    return ColorStatistics(mean, covariance, float(part_sums[0, 0] / total))


def _read_pixels(path: Path, file_kind: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Return upright BGR [H, W, 3] and alpha [H, W] or None, in the file's bit depth."""
    data = _read_bytes(path, file_kind)
    header = image_header(data)
    if header is None:
        raise StyleError(f"{file_kind} {path}: is no {FORMATS} image, or ends within its header")
    if header.width * header.height > MAX_PIXELS:
        raise StyleError(
            f"{file_kind} {path}: has {header.width} x {header.height} pixels, more than "
            f"{MAX_PIXELS:,}; make it smaller, {SIDE_PX} pixels across are all that is used"
        )
    try:
        bgr, alpha = _decode(np.frombuffer(data, np.uint8), header)
    except cv2.error as error:
        raise StyleError(
            f"{file_kind} {path}: cannot be decoded as {header.format}: {error}"
        ) from None
    if bgr is None:
        raise StyleError(
            f"{file_kind} {path}: cannot be decoded as {header.format}; "
            "it may be cut short or damaged"
        )
    if bgr.dtype not in (np.uint8, np.uint16):
        raise StyleError(
            f"{file_kind} {path}: has {bgr.dtype} pixels; expected 8 or 16 bits a channel, display-"
            "encoded. Save it as PNG or JPEG"
        )
    return bgr, alpha


def _read_bytes(path: Path, file_kind: str) -> bytes:
    """Return the content of a file."""
    try:
        with open_file(path) as file:
            data = file.read(MAX_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise StyleError(f"{file_kind} {path}: there is no such file") from None
    except IsADirectoryError:
        raise StyleError(f"{file_kind} {path}: is a folder; give one image file") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise StyleError(f"{file_kind} {str(path)!a}: cannot be read: {error}") from None
    if not data:
        raise StyleError(f"{file_kind} {path}: is empty")
    if len(data) > MAX_BYTES:
        raise StyleError(f"{file_kind} {path}: is larger than {MAX_BYTES:,} bytes; make it smaller")
    return data


def _decode(data: np.ndarray, header: ImageHeader) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return BGR and alpha of the data; BGR is None if the data are damaged."""
    if header.format == "JPEG":
        longer_side = max(header.width, header.height)
        read_flag = next(
            (_REDUCED_FLAGS[n] for n in _REDUCED_FLAGS if longer_side // n >= SIDE_PX),
            cv2.IMREAD_COLOR,
        )
        return cv2.imdecode(data, read_flag), None
    stored = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if stored is None:
        return None, None
    upright = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if upright is None or stored.ndim != 3 or stored.shape[2] != 4:
        return upright, None
    return upright, _upright_alpha(stored, upright)


def _upright_alpha(stored: np.ndarray, upright: np.ndarray) -> np.ndarray:
    """Return the alpha channel, turned as EXIF turned the colours: OpenCV turns these alone."""
    for quarter_turns in range(4):
        for mirrored in (stored, stored[:, ::-1]):
            candidate = np.rot90(mirrored, quarter_turns)
            if np.array_equal(candidate[..., :3], upright):
                return candidate[..., 3]
    return stored[..., 3]


def _shrink(rgb: np.ndarray, alpha: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return colours [H, W, 3] and weights [H, W], float32, averaged to at most SIDE_PX."""
    max_value = np.float32(np.iinfo(rgb.dtype).max)
    scale = min(1.0, SIDE_PX / max(rgb.shape[:2]))
    size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
    if alpha is None:
        small_rgb = cv2.resize(np.ascontiguousarray(rgb), size, interpolation=cv2.INTER_AREA)
        small_rgb = small_rgb.reshape(size[1], size[0], 3)
        return small_rgb.astype(np.float32) / max_value, np.ones((size[1], size[0]), np.float32)
    weights = alpha.astype(np.float32) / max_value
    weighted = rgb.astype(np.float32) * (weights / max_value)[..., None]
    weights = cv2.resize(weights, size, interpolation=cv2.INTER_AREA)
    weighted = cv2.resize(weighted, size, interpolation=cv2.INTER_AREA)
    colors = weighted / np.maximum(weights, 1e-6)[..., None]
    return np.clip(colors, 0, 1), np.clip(weights, 0, 1)


def _read_mask(
    mask: Path, image_shape: tuple[int, ...], small_shape: tuple[int, ...], image: Path
) -> np.ndarray:
    """Return the sky mask in a file, bool, at the size of the small picture."""
    bgr, alpha = _read_pixels(mask, "sky mask")
    if alpha is not None:
        bgr = bgr * (alpha[..., None] > np.iinfo(alpha.dtype).max // 2)  # transparent: no sky
    height, width = bgr.shape[:2]
    tolerance = _SHAPE_TOLERANCE * height * image_shape[1] + max(image_shape[:2])
    if abs(width * image_shape[0] - height * image_shape[1]) > tolerance:
        raise StyleError(
            f"sky mask {mask}: is {width} x {height}, and style image {image} is of another "
            f"shape, {image_shape[1]} x {image_shape[0]}; a mask has the image's aspect ratio"
        )
    whiteness = bgr.max(2).astype(np.float32) / np.iinfo(bgr.dtype).max
    small_mask = cv2.resize(
        whiteness, (small_shape[1], small_shape[0]), interpolation=cv2.INTER_AREA
    )
    return small_mask.reshape(small_shape[:2]) > 0.5
