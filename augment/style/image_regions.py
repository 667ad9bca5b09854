"""Where a picture shows sky, vegetation and road: by colour and place, and only where it is clear.

A region that is missed costs little: the map of the whole picture, or of all the land, stands in
for it. One that is wrong gives a sky the colours of a wall. So every rule here leans towards none.
"""

from __future__ import annotations

import cv2
import numpy as np

from augment.style.statistics import LAND, REST, ROAD, SKY, VEGETATION

_SIDE_PX = 128  # the longer side of the picture in which regions are found
_STEPS = np.geomspace(0.015, 0.2, 20)  # of colour, that may end a sky; the best of them is taken
_LEAST_SHARE = 0.04  # of the picture, or the statistics are of a handful of pixels
_LEAST_COLUMNS = 0.6  # of the picture's columns that begin with sky
_LEAST_SIDE_PX = 16  # of a picture that shows anything


def find_sky(rgb: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The sky of a picture, bool [H, W]; empty where there is none, or none that is clear.

    rgb: float32 [H, W, 3] in [0, 1]. weights: float32 [H, W]; where 0, nothing is sky.

    In every column a sky reaches from the top to the first step of colour; how large a step is
    one, is what leaves sky and land each the most of one colour (after Shen and Wang 2013, "Sky
    region detection in a single image", eq. 4). It is kept where it is wide, smoother than the
    land, and brighter or bluer: see `_is_sky`.
    """
    if min(weights.shape) < _LEAST_SIDE_PX:
        return np.zeros(weights.shape, bool)
    small, small_weights = _small(rgb), _small(weights)
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
    enough = _LEAST_SHARE * sky.size
    masks: dict[str, np.ndarray] = {}
    outdoors = sky.sum() >= enough
    land = ~sky & (weights > 0)
    if outdoors and land.sum() >= enough:
        masks |= {SKY: sky, LAND: land}
    if min(sky.shape) < _LEAST_SIDE_PX:
        return masks
    green = _green(rgb) & land
    grey = _road(rgb) & land & ~green if outdoors else np.zeros_like(land)
    found = {name: m for name, m in ((VEGETATION, green), (ROAD, grey)) if m.sum() >= enough}
    rest = land & ~np.logical_or.reduce([*found.values(), np.zeros_like(land)])
    if found and rest.sum() >= enough:
        found[REST] = rest
    return masks | found


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
    usable = (share >= _LEAST_SHARE) & (share <= 1 - _LEAST_SHARE)
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
    """Whether the region at the top can be nothing else: by day, at dusk, overcast, or lit night.

    Numbers chosen by eye on photographs of skies and of walls, water, leaves and rooms.
    """
    share, columns = sky.mean(), (sky.sum(0) > len(sky) // 25).mean()
    if not _LEAST_SHARE <= share <= 1 - _LEAST_SHARE or columns < _LEAST_COLUMNS:
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
    red, green, blue = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    total = red + green + blue
    excess = 2 * green - red - blue > 0.1 * total
    return excess & (green > red) & (blue < 0.85 * green) & (total > 0.15) & (total < 2.4)


def _road(rgb: np.ndarray) -> np.ndarray:
    small = _small(rgb)
    most, least = small.max(2), small.min(2)
    grey = (most - least < 0.2 * most) & (most > 0.1) & (_color_steps(small) < 0.08)
    grey[: len(grey) // 2] = False
    _, parts = cv2.connectedComponents(grey.astype(np.uint8), connectivity=4)
    touching = np.unique(parts[-1])
    return _full(np.isin(parts, touching[touching > 0]), rgb.shape)
