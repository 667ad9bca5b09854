"""Style images: read from a file into a small picture with weights and a sky."""

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
# By colour and place, and only where it is clear: for a region that is missed the map of the whole
# picture, or of all the land, stands in; a wrong one gives a sky the colours of a wall.

_SIDE_PX = 128  # the longer side of the picture in which regions are found
_STEPS = np.geomspace(0.015, 0.2, 20)  # of colour, that may end a sky; the best of them is taken
_MIN_SHARE = 0.04  # of the picture, or the statistics are of a handful of pixels
_MIN_COLUMNS = 0.6  # of the picture's columns that begin with sky
_MIN_SIDE_PX = 16  # of a picture that shows anything


def find_sky(rgb: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The sky of a picture, bool [H, W]; empty where there is none, or none that is clear.

    rgb: float32 [H, W, 3] in [0, 1]. weights: float32 [H, W]; where 0, nothing is sky.

    In every column a sky reaches from the top to the first step of colour; how large a step is
    one, is what leaves sky and land each the most of one colour (after Shen and Wang 2013, "Sky
    region detection in a single image", eq. 4). It is kept where it is wide, smoother than the
    land, and brighter or bluer: see `_is_sky`.
    """
    if min(weights.shape) < _MIN_SIDE_PX:
        return np.zeros(weights.shape, bool)
    small = _small(rgb)
    small_weights = _small(weights)
    steps = _color_steps(small)
    border = _best_border(small, small_weights, steps)
    sky = (np.arange(len(small))[:, None] < border) & (small_weights > 0)
    if not _is_sky(small, sky, steps):
        return np.zeros(weights.shape, bool)
    sky = _grown(small, sky, steps, border)
    return _full(sky, weights.shape) & (weights > 0)


def region_masks(rgb: np.ndarray, weights: np.ndarray, sky: np.ndarray) -> dict[str, np.ndarray]:
    """bool [H, W] of the regions that the picture shows clearly.

    SKY and LAND part the picture where both show. Of the land, VEGETATION is greener than it is
    red or blue, and neither black nor white. ROAD is grey, smooth, in the lower half and reaches
    the bottom edge; only below a sky, for indoors the same is a table. REST is what remains, where
    either was found. None is smaller than 4 % of the picture.
    """
    min_pixels = _MIN_SHARE * sky.size
    masks: dict[str, np.ndarray] = {}
    outdoors = sky.sum() >= min_pixels
    land = ~sky & (weights > 0)
    if outdoors and land.sum() >= min_pixels:
        masks |= {SKY: sky, LAND: land}
    if min(sky.shape) < _MIN_SIDE_PX:
        return masks
    green = _green(rgb) & land
    grey = _road(rgb) & land & ~green if outdoors else np.zeros_like(land)
    land_masks = {
        name: m for name, m in ((VEGETATION, green), (ROAD, grey)) if m.sum() >= min_pixels
    }
    rest_mask = land & ~np.logical_or.reduce([*land_masks.values(), np.zeros_like(land)])
    if land_masks and rest_mask.sum() >= min_pixels:
        land_masks[REST] = rest_mask
    return masks | land_masks


def _small(values: np.ndarray) -> np.ndarray:
    height, width = values.shape[:2]
    scale = min(1.0, _SIDE_PX / max(height, width))
    size = (max(4, round(width * scale)), max(4, round(height * scale)))
    return cv2.resize(values, size, interpolation=cv2.INTER_AREA)


def _full(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    size = (shape[1], shape[0])
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _color_steps(small: np.ndarray) -> np.ndarray:
    """The steepest channel's slope at each pixel, by the pixel, [h, w]."""
    blurred = cv2.GaussianBlur(small, (3, 3), 0)
    across, down = (cv2.Sobel(blurred, cv2.CV_32F, *axis, ksize=3) for axis in ((1, 0), (0, 1)))
    return (np.abs(across) + np.abs(down)).max(2) / 4


def _best_border(small: np.ndarray, weights: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """How many rows of each column are sky by the best of _STEPS, int [w]."""
    above = steps[None] > _STEPS[:, None, None].astype(np.float32)
    end = np.ones_like(above[:, :1])  # a column without a step is sky to its last row
    borders = np.concatenate([above, end], axis=1).argmax(1)  # [S, w]
    energies = _energies(small, weights, borders)
    border = borders[int(np.argmax(energies))].astype(np.uint8)
    # A step missed in a column or two is no crack in the land.
    around = cv2.medianBlur(border[None], 9)[0]
    return np.minimum(border, around + 2).astype(np.int64)


def _energies(small: np.ndarray, weights: np.ndarray, borders: np.ndarray) -> np.ndarray:
    """How well each of the borders [S, w] parts the picture: large where both sides vary little.

    1 / (2 |S| + |G| + 2 s1 + g1) of the covariances S of the sky and G of the ground, in steps of
    8 bits, with their largest eigenvalues s1 and g1.
    """
    moments = np.concatenate([np.ones((*weights.shape, 1)), small], axis=2)  # [h, w, 4]
    weighted = moments * weights[..., None]
    products = weighted[..., :, None] * moments[..., None, :]  # [h, w, 4, 4]
    sums = np.concatenate([np.zeros_like(products[:1]), np.cumsum(products, axis=0)])
    sky = sums[borders, np.arange(borders.shape[1])].sum(1)  # [S, 4, 4]
    ground = sums[-1].sum(0) - sky
    share = sky[:, 0, 0] / max(sums[-1, :, 0, 0].sum(), 1e-9)
    usable = (share >= _MIN_SHARE) & (share <= 1 - _MIN_SHARE)
    cost = sum(weight * term for weight, side in ((2, sky), (1, ground)) for term in _spread(side))
    return np.where(usable, 1 / np.maximum(cost, 1e-9), 0.0)


def _spread(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Determinant and largest eigenvalue of the covariances, from sums [S, 4, 4] of products."""
    weight = np.maximum(sums[:, 0, 0], 1e-9)[:, None]
    mean = sums[:, 0, 1:] / weight
    covariance = sums[:, 1:, 1:] / weight[..., None] - mean[:, :, None] * mean[:, None, :]
    covariance *= 255.0**2
    return np.linalg.det(covariance), np.linalg.eigvalsh(covariance)[:, -1]


def _is_sky(small: np.ndarray, sky: np.ndarray, steps: np.ndarray) -> bool:
    """Return True if the region at the top must be a sky: by day, at dusk, overcast, or lit night.

    Numbers chosen by eye on photographs of skies and of walls, water, leaves and rooms.
    """
    share = sky.mean()
    columns = (sky.sum(0) > len(sky) // 25).mean()
    if not _MIN_SHARE <= share <= 1 - _MIN_SHARE or columns < _MIN_COLUMNS:
        return False
    red, green, blue = small[sky].mean(0).tolist()
    land = small[~sky].mean(0).tolist()
    brighter = (red + green + blue - sum(land)) / 3
    rougher = float(steps[sky].mean() / max(float(steps[~sky].mean()), 1e-6))
    if rougher > 0.55 or max(red, green, blue) < 0.15 or green > max(red, blue) + 0.07:
        return False  # texture; black; leaves out of focus
    if blue < red - 0.1:
        return brighter > 0.2 and rougher < 0.5  # dusk; else a wall in warm light
    bluer = (blue - red) - (land[2] - land[0])
    return brighter > 0.08 or (brighter > -0.2 and blue - red > 0.12 and bluer > 0.1)


def _grown(small: np.ndarray, sky: np.ndarray, steps: np.ndarray, border: np.ndarray) -> np.ndarray:
    """With what is connected to the sky, of its colours, and no lower than nearly all of it.

    The first step of a column may be a cloud or a wire, with more sky below.
    """
    colors = small[sky].astype(np.float64)
    centred = small - colors.mean(0)
    precision = np.linalg.inv(np.cov(colors.T) + 0.02**2 * np.eye(3))
    near = ((centred @ precision) * centred).sum(2) < 3.0**2
    near &= np.abs(centred).max(2) < 0.25
    high = np.arange(len(small))[:, None] < np.percentile(border, 90)
    candidates = sky | (near & high & (steps < 0.1))
    _, parts = cv2.connectedComponents(candidates.astype(np.uint8), connectivity=4)
    return np.isin(parts, np.unique(parts[sky]))


def _green(rgb: np.ndarray) -> np.ndarray:
    red = rgb[..., 0]
    green = rgb[..., 1]
    blue = rgb[..., 2]
    total = red + green + blue
    excess = 2 * green - red - blue > 0.1 * total
    return excess & (green > red) & (blue < 0.85 * green) & (total > 0.15) & (total < 2.4)


def _road(rgb: np.ndarray) -> np.ndarray:
    small = _small(rgb)
    most = small.max(2)
    least = small.min(2)
    grey = (most - least < 0.2 * most) & (most > 0.1) & (_color_steps(small) < 0.08)
    grey[: len(grey) // 2] = False
    _, parts = cv2.connectedComponents(grey.astype(np.uint8), connectivity=4)
    touching = np.unique(parts[-1])
    return _full(np.isin(parts, touching[touching > 0]), rgb.shape)


SIDE_PX = 512  # colours need no more, and everything after the reading costs the same for any file
MAX_BYTES = 256 * 1024**2
MAX_PIXELS = 64_000_000  # about 1 GiB while an image of this size with alpha is averaged
_ENOUGH_PIXELS = 65_536  # for statistics; of more, every second row and column says the same
_SHAPE_TOLERANCE = 0.02  # by which a mask's aspect ratio may miss: a pixel's rounding when small

_REDUCED = {  # libjpeg averages while it decodes, for less than the whole costs
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
}


@dataclass(frozen=True, eq=False)
class StyleImage:
    """A style image as the transfer sees it, upright and at most SIDE_PX on its longer side.

    rgb: float32 [H, W, 3] in [0, 1], display-encoded. weights: float32 [H, W] in [0, 1], how much a
    pixel counts (its alpha). sky: bool [H, W].
    """

    rgb: Float32[np.ndarray, "H W 3"]
    weights: Float32[np.ndarray, "H W"]
    sky: Bool[np.ndarray, "H W"]


def read_style_image(path: Path, mask: Path | None = None) -> StyleImage:
    """The picture in a file: 8 or 16 bits, grey, colour, palette, CMYK (JPEG) or with alpha.

    EXIF's orientation is followed. mask: a picture of the same shape, white where the style image
    shows sky (more than half white counts); where None the sky is looked for. CMYK is read as
    inverted, as Photoshop writes it and browsers read it, and without its colour profile.

    Raises:
        StyleError: a file cannot be read, is no image of these kinds, is too large or fully
            transparent, or the mask's shape is not the image's.
    """
    bgr, alpha = _read(Path(path), "style image")
    if alpha is not None and not alpha.any():
        raise StyleError(f"style image {path}: is fully transparent; it shows no colour to take on")
    rgb, weights = _shrunk(bgr[..., ::-1], alpha)
    sky = find_sky(rgb, weights) if mask is None else _mask(Path(mask), bgr.shape, rgb.shape, path)
    return StyleImage(rgb, weights, sky)


def image_statistics(image: StyleImage) -> Statistics:
    """The colour statistics of the image's regions.

    WHOLE always; SKY and LAND where it shows both; VEGETATION, ROAD and REST where found.
    """
    step = 1 if image.sky.size <= _ENOUGH_PIXELS else 2
    image = StyleImage(*(part[::step, ::step] for part in (image.rgb, image.weights, image.sky)))
    masks = region_masks(image.rgb, image.weights, image.sky)
    parts = np.zeros(image.sky.shape, np.int64)  # each pixel in one part, so that each counts once
    inside = {WHOLE: {0}}
    for number, (region, mask) in enumerate(masks.items(), start=1):
        if region != LAND:
            parts[mask] = number
            inside[WHOLE].add(number)
            inside[region] = {number}
    if SKY in inside:
        inside[LAND] = inside[WHOLE] - inside[SKY]
    sums = _sums(image, parts, len(masks) + 1)
    return {region: _statistics(sums, sorted(of)) for region, of in inside.items()}


def _sums(image: StyleImage, parts: np.ndarray, count: int) -> np.ndarray:
    """Weighted sums of products of (1, r, g, b) in each part, float64 [count, 4, 4]."""
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


def _statistics(sums: np.ndarray, parts: list[int]) -> ColorStatistics:
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


def _read(path: Path, what: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Upright BGR [H, W, 3] and alpha [H, W] or None, of the file's own depth."""
    data = _bytes(path, what)
    header = image_header(data)
    if header is None:
        raise StyleError(f"{what} {path}: is no {FORMATS} image, or ends within its header")
    if header.width * header.height > MAX_PIXELS:
        raise StyleError(
            f"{what} {path}: has {header.width} x {header.height} pixels, more than "
            f"{MAX_PIXELS:,}; make it smaller, {SIDE_PX} pixels across are all that is used"
        )
    try:
        bgr, alpha = _decoded(np.frombuffer(data, np.uint8), header)
    except cv2.error as error:
        raise StyleError(f"{what} {path}: cannot be decoded as {header.format}: {error}") from None
    if bgr is None:
        raise StyleError(
            f"{what} {path}: cannot be decoded as {header.format}; it may be cut short or damaged"
        )
    if bgr.dtype not in (np.uint8, np.uint16):
        raise StyleError(
            f"{what} {path}: has {bgr.dtype} pixels; expected 8 or 16 bits a channel, display-"
            "encoded. Save it as PNG or JPEG"
        )
    return bgr, alpha


def _bytes(path: Path, what: str) -> bytes:
    try:
        with open_file(path) as file:
            data = file.read(MAX_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise StyleError(f"{what} {path}: there is no such file") from None
    except IsADirectoryError:
        raise StyleError(f"{what} {path}: is a folder; give one image file") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise StyleError(f"{what} {str(path)!a}: cannot be read: {error}") from None
    if not data:
        raise StyleError(f"{what} {path}: is empty")
    if len(data) > MAX_BYTES:
        raise StyleError(f"{what} {path}: is larger than {MAX_BYTES:,} bytes; make it smaller")
    return data


def _decoded(data: np.ndarray, header: ImageHeader) -> tuple[np.ndarray | None, np.ndarray | None]:
    if header.format == "JPEG":
        side = max(header.width, header.height)
        flag = next((_REDUCED[n] for n in _REDUCED if side // n >= SIDE_PX), cv2.IMREAD_COLOR)
        return cv2.imdecode(data, flag), None
    stored = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if stored is None:
        return None, None
    upright = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if upright is None or stored.ndim != 3 or stored.shape[2] != 4:
        return upright, None
    return upright, _upright_alpha(stored, upright)


def _upright_alpha(stored: np.ndarray, upright: np.ndarray) -> np.ndarray:
    """The fourth channel turned as EXIF turned the others: OpenCV turns colours alone."""
    for quarter in range(4):
        for flipped in (stored, stored[:, ::-1]):
            turned = np.rot90(flipped, quarter)
            if np.array_equal(turned[..., :3], upright):
                return turned[..., 3]
    return stored[..., 3]


def _shrunk(rgb: np.ndarray, alpha: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Averaged to at most SIDE_PX: float32 colours [H, W, 3] and weights [H, W]."""
    most = np.float32(np.iinfo(rgb.dtype).max)
    scale = min(1.0, SIDE_PX / max(rgb.shape[:2]))
    size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
    if alpha is None:
        small = cv2.resize(np.ascontiguousarray(rgb), size, interpolation=cv2.INTER_AREA)
        small = small.reshape(size[1], size[0], 3)
        return small.astype(np.float32) / most, np.ones((size[1], size[0]), np.float32)
    weights = alpha.astype(np.float32) / most
    weighted = rgb.astype(np.float32) * (weights / most)[..., None]
    weights = cv2.resize(weights, size, interpolation=cv2.INTER_AREA)
    weighted = cv2.resize(weighted, size, interpolation=cv2.INTER_AREA)
    colors = weighted / np.maximum(weights, 1e-6)[..., None]
    return np.clip(colors, 0, 1), np.clip(weights, 0, 1)


def _mask(mask: Path, full: tuple[int, ...], small: tuple[int, ...], image: Path) -> np.ndarray:
    bgr, alpha = _read(mask, "sky mask")
    if alpha is not None:
        bgr = bgr * (alpha[..., None] > np.iinfo(alpha.dtype).max // 2)  # transparent: no sky
    height, width = bgr.shape[:2]
    room = _SHAPE_TOLERANCE * height * full[1] + max(full[:2])
    if abs(width * full[0] - height * full[1]) > room:
        raise StyleError(
            f"sky mask {mask}: is {width} x {height}, and style image {image} is of another "
            f"shape, {full[1]} x {full[0]}; a mask has the image's aspect ratio"
        )
    white = bgr.max(2).astype(np.float32) / np.iinfo(bgr.dtype).max
    shrunk = cv2.resize(white, (small[1], small[0]), interpolation=cv2.INTER_AREA)
    return shrunk.reshape(small[:2]) > 0.5
