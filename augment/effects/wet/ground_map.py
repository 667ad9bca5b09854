"""Maps the ground that rain wets: its heights, how open to the sky it is, where water would stand.

Input: a scene's exposed surface (augment.exposure.exposed_surface), since rain and snow fall from
the same sky. Output: `WetGround`, a map over the world's x and y, made once a scene, and
`WetSplats`. Callers: `wet.effect`, `wet.reflection`, `wet.lidar`. A thing that stands over the
ground keeps it dry, and the shelter's edge is soft.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from augment.effects.gradient_noise import Octaves, draw_octaves, sum_octaves
from augment.effects.wet.film_kernels import (
    EXPOSURE,
    HEIGHT,
    NUM_CHANNELS,
    PUDDLE_ORDER,
    PUDDLE_RIM,
    WHEEL_TRACK,
)
from augment.errors import SceneError
from augment.exposure.cells import ExposedCells
from augment.exposure.exposed_surface import exposed_surface_of
from augment.exposure.search import ExposureSettings
from augment.exposure.tiles import TooManyCellsError
from augment.memo import memo_of
from augment.rng import rng_for
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass

# Settings of the cells. They equal those of snow by default, so that both share one search.
EXPOSURE_SETTINGS = ExposureSettings()
GROUND_CELL_M = 0.2  # side of the map's cells; the ground's water is less finely patched

# Share of a wet surface that a film of water covers: asphalt and concrete hold a film, soil and
# grass let it seep.
_FILM_SHARES = {
    SemanticClass.UNKNOWN: 1.0,
    SemanticClass.ROAD: 1.0,
    SemanticClass.LANE_MARKING: 1.0,
    SemanticClass.SIDEWALK: 0.9,
    SemanticClass.TERRAIN: 0.25,
    SemanticClass.OTHER: 0.8,
}
GROUND_CLASSES = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
)
_UNSURE_CLASSES = (SemanticClass.UNKNOWN, SemanticClass.OTHER)
_MAX_GROUND_STEP_M = 0.25  # least step between neighbouring cells that is no ground
_PATH_RADIUS_M = 6.0  # distance from the path within which its surface is looked for
_SHELTER_SIGMA_M = 0.3  # distance to which wind drives drops in under an edge
_HEIGHT_BLUR_M = 0.4  # standard deviation of the blur of heights
_SLOPE_BLUR_M = 1.2  # the same for the heights that slopes are taken from
_MAX_HOLLOW_WIDTH_M = 2.6  # largest width of a hollow; wider dips drain
_MAX_WATER_DEPTH_M = 0.03  # largest depth of water in a street's hollow, before it runs over
_MAX_PUDDLE_SLOPE = np.tan(np.radians(15.0))  # steepest slope with standing water
# Octaves of the puddles' noise: (lattice step in metres, standard deviation).
_PUDDLE_OCTAVES = ((7.0, 0.8), (2.9, 0.5), (1.2, 0.25), (0.55, 0.1))
_WEIGHT_PER_CM = 0.8  # weight of a hollow's centimetre, in standard deviations of that noise
_NOISE_STRIDE = 2  # distance between samples of the noise, cells
# Inverse of the share of ground below which the rims of the last puddles close.
_CLOSING = 200.0
NO_PUDDLES = 1e6  # value of PUDDLE_ORDER that no place has


@dataclass(frozen=True, eq=False)
class WetGround:
    """Ground about the cameras' path.

    `channels` has rows towards +y, and values at the cells' middles:

    - HEIGHT: z of the ground, smoothed, world; z of the nearest ground where there is none.
    - EXPOSURE: 0 to 1, how far rain reaches it, times the film that its surface holds; 0 where
      there is no ground.
    - SLOPE_X, SLOPE_Y: slope of the ground.
    - PUDDLE_ORDER: order in which puddles form; water stands first where it is highest.
    - WHEEL_TRACK: 0 to 1, how much of a wheel track it is.
    """

    left_m: float  # least x of the map
    bottom_m: float  # least y of the map
    channels: Float[Tensor, "Y X C"]
    # Height of the highest surface that can be wet, ground or roof; NaN where there is none.
    tops_m: Float[Tensor, "Y X"]
    # How open that surface is to the rain, 0 to 1.
    surface_exposure: Float[Tensor, "Y X"]
    # Values of PUDDLE_ORDER on open ground, in rising order.
    sorted_puddle_order: np.ndarray

    def interpolate(self, x_m: Tensor, y_m: Tensor) -> Float[Tensor, "*B C"]:
        """Return the channels between the cells' middles.

        Beyond the map they are those of its border, but not open.
        """
        rows, columns = self.channels.shape[:2]
        x = (x_m - self.left_m) / GROUND_CELL_M - 0.5
        y = (y_m - self.bottom_m) / GROUND_CELL_M - 0.5
        is_inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)
        values = self.interpolate_values(self.channels, x_m, y_m)
        values[..., EXPOSURE] *= is_inside
        return values

    def interpolate_values(
        self, values: Float[Tensor, "Y X C"], x_m: Tensor, y_m: Tensor
    ) -> Float[Tensor, "*B C"]:
        """Return values of the map's cells between their middles; beyond the map its border's."""
        rows, columns = values.shape[:2]
        x = ((x_m - self.left_m) / GROUND_CELL_M - 0.5).clamp(0, columns - 1)
        y = ((y_m - self.bottom_m) / GROUND_CELL_M - 0.5).clamp(0, rows - 1)
        i = x.long().clamp_max(max(columns - 2, 0))
        j = y.long().clamp_max(max(rows - 2, 0))
        u = (x - i)[..., None].float()
        v = (y - j)[..., None].float()
        i1 = (i + 1).clamp_max(columns - 1)
        j1 = (j + 1).clamp_max(rows - 1)
        flat = values.reshape(rows * columns, -1).to(x_m.device)
        below = flat[j * columns + i] * (1 - u) + flat[j * columns + i1] * u
        above = flat[j1 * columns + i] * (1 - u) + flat[j1 * columns + i1] * u
        return below * (1 - v) + above * v

    def puddles_and_tracks(self, x_m: Tensor, y_m: Tensor) -> Float[Tensor, "*B 2"]:
        """Return PUDDLE_ORDER and WHEEL_TRACK as `interpolate` does."""
        return self.interpolate_values(self.channels[..., PUDDLE_ORDER : WHEEL_TRACK + 1], x_m, y_m)

    def nearest(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return the channels of the cells about points; beyond the map, see `interpolate`."""
        rows, columns = self.channels.shape[:2]
        i = np.floor((x_m - self.left_m) / GROUND_CELL_M).astype(np.int64)
        j = np.floor((y_m - self.bottom_m) / GROUND_CELL_M).astype(np.int64)
        is_inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
        values = self.channels.numpy()[np.clip(j, 0, rows - 1), np.clip(i, 0, columns - 1)]
        values[..., EXPOSURE] *= is_inside
        return values

    def find_puddle_threshold(self, share: float) -> float:
        """Return the PUDDLE_ORDER above which water covers `share` of the open ground."""
        ordered = self.sorted_puddle_order
        if share <= 0 or not len(ordered):
            return NO_PUDDLES
        return float(ordered[min(int((1 - share) * len(ordered)), len(ordered) - 1)])

    def interpolate_puddle_threshold(self, share: float) -> float:
        """Return the same threshold as a continuous function of the share.

        A share of 0 has a threshold above all water. Thresholds between values are interpolated.
        """
        ordered = self.sorted_puddle_order
        if share <= 0 or not len(ordered):
            return NO_PUDDLES
        position = (1 - share) * len(ordered) - 0.5
        threshold = float(np.interp(position, np.arange(len(ordered)), ordered))
        # The rim of the last puddle closes while its share goes to nothing.
        return threshold + PUDDLE_RIM * max(1 - share * _CLOSING, 0.0)


def wet_ground(scene: Scene, seed: int, *, backend: str = "auto") -> WetGround:
    """Return the ground of a scene; seed: seed of the noise that puddles follow.

    Raises:
        SceneError: metres or gravity are not known.
    """
    scene = scene.as_recorded
    with refusing_cell_size():
        cells = exposed_surface_of(scene, EXPOSURE_SETTINGS, backend=backend).ground
    key = ("wet ground", seed)
    places = [frame.world_from_ego[:3, 3].numpy() for frame in scene.frames]
    places += [camera.centre.numpy() for f in scene.frames for camera in f.cameras.values()]
    return memo_of(scene).get(
        key, lambda: _make_ground(cells, np.array(places).reshape(-1, 3), seed)
    )


@contextlib.contextmanager
def refusing_cell_size() -> Iterator[None]:
    """Add to the error of an exposed surface with too many cells that rain cannot change them."""
    try:
        yield
    except TooManyCellsError as error:
        raise SceneError(
            f"{error}; weather.rain has no size of cells, take fewer frames"
        ) from error


def _make_ground(cells: ExposedCells, path: np.ndarray, seed: int) -> WetGround:
    """Make the map from the scene's cells."""
    classes = cells.semantic.numpy()
    is_kept = classes != SemanticClass.VEGETATION
    if not is_kept.any():
        empty_map = torch.zeros(2, 2)
        channels = torch.zeros(2, 2, NUM_CHANNELS)
        return WetGround(0.0, 0.0, channels, empty_map / 0, empty_map, np.zeros(0, np.float32))
    centres = cells.centers_m.double().numpy()[is_kept]
    sizes = cells.sizes_m.double().numpy()[is_kept]
    classes = classes[is_kept]
    tracks = cells.track_share.numpy()[is_kept]
    low_cell = np.floor((centres[:, :2] - sizes[:, None] / 2).min(0) / GROUND_CELL_M) - 2
    high_cell = np.ceil((centres[:, :2] + sizes[:, None] / 2).max(0) / GROUND_CELL_M) + 2
    columns, rows = (high_cell - low_cell).astype(np.int64)
    painter = _Painter(low_cell, int(columns), int(rows), centres[:, :2], sizes)
    tops = painter.mean(centres[:, 2])
    films = np.array([_FILM_SHARES.get(SemanticClass(c), 0.0) for c in range(len(SemanticClass))])
    film = np.nan_to_num(painter.mean(films[classes]))
    is_unsure = (
        np.nan_to_num(painter.mean(np.isin(classes, _UNSURE_CLASSES).astype(np.float64))) > 0.5
    )
    is_known = (
        np.nan_to_num(painter.mean(np.isin(classes, GROUND_CLASSES).astype(np.float64))) > 0.5
    )
    is_ground = is_known | (is_unsure & _is_ground_by_path(tops, path, low_cell))
    track = np.where(is_ground, np.nan_to_num(painter.mean(tracks.astype(np.float64))), 0)
    exposed = _soften_mask(np.isfinite(tops))
    openness = _soften_mask(is_ground) * np.where(is_ground, film, 0)
    openness = blur_map(openness, _SHELTER_SIGMA_M / 2)
    heights = _smooth_heights(tops, is_ground, _HEIGHT_BLUR_M)
    level = _smooth_heights(tops, is_ground, _SLOPE_BLUR_M)
    rise_y, rise_x = np.gradient(level, GROUND_CELL_M)
    puddle_order = _puddle_order(
        heights, np.hypot(rise_x, rise_y), is_ground, track, low_cell, seed
    )
    channels = np.stack(
        [heights, openness, rise_x, rise_y, puddle_order, blur_map(track, 0.15)], -1
    )
    ordered = np.sort(puddle_order[openness > 0.5]).astype(np.float32)
    left_m, bottom_m = (low_cell * GROUND_CELL_M).tolist()
    return WetGround(
        left_m,
        bottom_m,
        torch.from_numpy(np.ascontiguousarray(channels, np.float32)),
        torch.from_numpy(tops.astype(np.float32)),
        torch.from_numpy(exposed.astype(np.float32)),
        ordered[:: max(1, len(ordered) // 4096)],
    )


class _Painter:
    """Painter of cells of many sizes on the map's cells, each over all that its square covers."""

    def __init__(
        self, low: np.ndarray, columns: int, rows: int, xy: np.ndarray, sizes: np.ndarray
    ) -> None:
        self._shape = rows, columns
        map_ids = []
        cell_ids = []
        for size in np.unique(sizes):
            index = np.flatnonzero(sizes == size)
            num_steps = max(1, round(float(size) / GROUND_CELL_M))
            steps = (np.arange(num_steps) + 0.5) * (size / num_steps) - size / 2
            for dx in steps:
                for dy in steps:
                    columns_rows = np.floor((xy[index] + (dx, dy)) / GROUND_CELL_M - low).astype(
                        np.int64
                    )
                    map_ids.append(columns_rows[:, 1] * columns + columns_rows[:, 0])
                    cell_ids.append(index)
        self._map_ids = np.concatenate(map_ids)
        self._cell_ids = np.concatenate(cell_ids)
        self._count = np.bincount(self._map_ids, minlength=rows * columns)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of the cells' values in each cell of the map, [Y, X]; NaN without any."""
        sums = np.bincount(self._map_ids, values[self._cell_ids], len(self._count))
        with np.errstate(invalid="ignore", divide="ignore"):
            return (sums / self._count).reshape(self._shape)


def _is_ground_by_path(tops: np.ndarray, path: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Tell where surfaces without a class are ground: they go on without a step from the path."""
    is_surface = np.isfinite(tops)
    heights = np.where(is_surface, tops, 0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(np.where(is_surface, heights, -np.float32(1e6)), kernel)
    lowest = cv2.erode(np.where(is_surface, heights, np.float32(1e6)), kernel)
    labels = np.zeros(tops.shape, np.int32)
    ndimage.label(is_surface & (highest - lowest < _MAX_GROUND_STEP_M), output=labels)
    places = np.floor(path[:, :2] / GROUND_CELL_M - low).astype(np.int64)
    near_path = np.zeros(tops.shape, np.uint8)
    is_inside = ((places >= 0) & (places < np.array(tops.shape[::-1]))).all(1)
    near_path[places[is_inside, 1], places[is_inside, 0]] = 1
    reach = 2 * round(_PATH_RADIUS_M / GROUND_CELL_M) + 1
    near_path = (
        cv2.dilate(near_path, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))) > 0
    )
    counts = np.bincount(labels[near_path & (labels > 0)], minlength=1)
    is_ground = (
        (labels == counts.argmax()) & (labels > 0) if counts.any() else np.zeros_like(is_surface)
    )
    return cv2.dilate(is_ground.astype(np.uint8), kernel).astype(bool) & is_surface


def _soften_mask(mask: np.ndarray) -> np.ndarray:
    """Blur a mask: 1 inside, falling to 0 at the edge."""
    return np.clip(2 * blur_map(mask.astype(np.float64), _SHELTER_SIGMA_M) - 0.9, 0, 1)


def blur_map(values: np.ndarray, sigma_m: float) -> np.ndarray:
    """Return values of the map's cells [Y, X], blurred by a standard deviation in metres."""
    sigma = sigma_m / GROUND_CELL_M
    return cv2.GaussianBlur(
        values.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE
    ).astype(np.float64)


def _smooth_heights(tops: np.ndarray, is_ground: np.ndarray, sigma_m: float) -> np.ndarray:
    """Return heights of the ground, blurred over ground alone; the nearest beyond it."""
    # Heights relative to their median keep float32's digits.
    median_height = float(np.median(tops[is_ground])) if is_ground.any() else 0.0
    weight = blur_map(is_ground.astype(np.float64), sigma_m)
    sums = blur_map(np.where(is_ground, np.nan_to_num(tops) - median_height, 0), sigma_m)
    is_known = weight > 0.02
    if not is_known.any():
        return np.zeros(tops.shape)
    out = np.where(is_known, sums / np.maximum(weight, 0.02), 0) + median_height
    nearest: Any = ndimage.distance_transform_edt(
        ~is_known, return_distances=False, return_indices=True
    )
    return out[tuple(nearest)]


def _puddle_order(
    heights: np.ndarray,
    slope: np.ndarray,
    is_ground: np.ndarray,
    track: np.ndarray,
    low: np.ndarray,
    seed: int,
) -> np.ndarray:
    """Return the order in which puddles form, [Y, X]; water stands first where it is highest.

    It adds up the depth of a hollow, which a closing of the heights fills, ruts, and noise. It is
    less on slopes.
    """
    width = 2 * round(_MAX_HOLLOW_WIDTH_M / GROUND_CELL_M / 2) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    heights_m = heights.astype(np.float32)
    closed = cv2.morphologyEx(heights_m, cv2.MORPH_CLOSE, disc)
    depth_cm = blur_map(np.clip(closed - heights_m, 0, _MAX_WATER_DEPTH_M) * 100, 0.2)
    rng = rng_for(seed=seed, scene="", effect="puddles")
    noise = noise_on_map(draw_octaves(_PUDDLE_OCTAVES, rng), low, heights.shape)
    order = _WEIGHT_PER_CM * depth_cm + noise + 0.3 * track
    return (
        order
        - 4 * np.clip(slope / _MAX_PUDDLE_SLOPE, 0, 2)
        - 6.0 * (blur_map(is_ground, 0.2) < 0.5)
    )


def noise_on_map(octaves: Octaves, low: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return noise in the cells of a map, [Y, X].

    Args:
        octaves: the noise.
        low: column and row of the map's first cell, counted from the world's origin.
        shape: rows and columns of the map.
    """
    rows, columns = (-(-n // _NOISE_STRIDE) + 1 for n in shape)
    x = (low[0] + (np.arange(columns) + 0.5) * _NOISE_STRIDE) * GROUND_CELL_M
    y = (low[1] + (np.arange(rows) + 0.5) * _NOISE_STRIDE) * GROUND_CELL_M
    grid_x, grid_y = np.meshgrid(x, y)
    noise = sum_octaves(octaves, grid_x.ravel(), grid_y.ravel()).reshape(rows, columns)
    size = (columns * _NOISE_STRIDE, rows * _NOISE_STRIDE)
    noise = cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC)
    return noise[: shape[0], : shape[1]]


# ---- Splats that rain wets -----------------------------------------------------------------------

_SURFACE_DISTANCE_M = 0.15  # distance from a cell's surface up to which a splat belongs to it
_MIN_ROOF_COSINE = 0.8  # least cosine of the tilt of a splat that may be a roof
_ROOF_CLASSES = (SemanticClass.BUILDING, SemanticClass.BARRIER)  # classes that may be roofs


@dataclass(frozen=True, eq=False)
class WetSplats:
    """Wetness of N background Gaussians."""

    wet: Float[Tensor, "N"]  # how far rain reaches them, 0 to 1
    is_ground: Tensor  # bool [N], Gaussians of the ground, wet or dry


def wet_splats(scene: Scene, ground: WetGround) -> WetSplats:
    """Find the background's splats that lie on open ground or roofs."""
    return memo_of(ground).get(("wet splats",), lambda: _find_splats(scene.background, ground))


def _find_splats(gaussians: Gaussians, ground: WetGround) -> WetSplats:
    """Find the wet splats by their height over the map and their class."""
    classes = (
        np.zeros(len(gaussians), np.int16)
        if gaussians.semantic is None
        else gaussians.semantic.numpy()
    )
    x, y, z = gaussians.means.double().numpy().T.reshape(3, -1)
    channels = ground.interpolate(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    is_near = np.abs(z - channels[:, HEIGHT]) < 2 * _SURFACE_DISTANCE_M
    is_ground = np.isin(classes, GROUND_CLASSES) | (np.isin(classes, _UNSURE_CLASSES) & is_near)
    i = np.floor((x - ground.left_m) / GROUND_CELL_M).astype(np.int64)
    j = np.floor((y - ground.bottom_m) / GROUND_CELL_M).astype(np.int64)
    rows, columns = ground.tops_m.shape
    is_inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
    i = np.clip(i, 0, columns - 1)
    j = np.clip(j, 0, rows - 1)
    surface_distance = np.abs(z - ground.tops_m.numpy()[j, i])
    wetness = np.clip(2 - surface_distance / _SURFACE_DISTANCE_M, 0, 1) * is_inside
    wetness = np.nan_to_num(wetness) * ground.surface_exposure.numpy()[j, i]
    thinnest = gaussians.scales.argmin(1)
    thin_axis_z = (
        rotmat_from_quat(gaussians.quats)[:, 2][torch.arange(len(gaussians)), thinnest]
        .abs()
        .numpy()
    )
    can_be_wet = is_ground | (np.isin(classes, _ROOF_CLASSES) & (thin_axis_z > _MIN_ROOF_COSINE))
    wet = np.where(can_be_wet, wetness, 0).astype(np.float32)
    return WetSplats(torch.from_numpy(wet), torch.from_numpy(is_ground & is_near))
