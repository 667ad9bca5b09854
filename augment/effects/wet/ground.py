"""The ground that rain wets: its heights, how open to the sky it is, where water would stand.

A map over the world's x and y, made once a scene from the cells that snow can lie on
(augment.effects.snow.support): both fall from the same sky. What stands over the ground keeps it
dry, and the shelter's edge is soft.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from augment.effects.snow.cells import SnowCells
from augment.effects.snow.layer import field_of, octaves_of
from augment.effects.snow.placement import PlacementSettings
from augment.effects.snow.support import support_of
from augment.effects.wet.kernels import CHANNELS, HEIGHT, OPEN
from augment.geometry import rotmat_from_quat
from augment.memo import memo_of
from augment.rng import rng_for
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass

SETTINGS = PlacementSettings()  # of the cells: those of snow, so that both take one search
CELL_M = 0.2  # of the map; finer than the ground's water is patchy

# How much of a surface a film of water closes over where it is wet through: asphalt and concrete
# hold one, soil and grass let it seep.
_FILMS = {
    SemanticClass.UNKNOWN: 1.0,
    SemanticClass.ROAD: 1.0,
    SemanticClass.LANE_MARKING: 1.0,
    SemanticClass.SIDEWALK: 0.9,
    SemanticClass.TERRAIN: 0.25,
    SemanticClass.OTHER: 0.8,
}
GROUND = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
)
_UNSURE = (SemanticClass.UNKNOWN, SemanticClass.OTHER)
_STEP_M = 0.25  # a rise between neighbouring cells that ground does not make
_NEAR_PATH_M = 6.0
_SHELTER_SIGMA_M = 0.3  # how far wind drives drops in under an edge
_SMOOTH_M, _LEVEL_M = 0.4, 1.2  # blurs of heights: for what lies on the ground, and for its tilt
_HOLLOW_M = 2.6  # wider dips drain
_DEEPEST_M = 0.03  # water that a hollow of a street holds before it runs over
_STEEPEST = np.tan(np.radians(15.0))  # no water stands on more
# Of puddles' noise: (lattice step in metres, standard deviation), and its weight beside hollows,
# whose centimetres count as much as so many standard deviations.
_NOISE = ((7.0, 0.8), (2.9, 0.5), (1.2, 0.25), (0.55, 0.1))
_PER_CM = 0.8
_NOISE_EVERY = 2  # cells
NO_PUDDLES = 1e6  # of HOLLOW, that no place has


@dataclass(frozen=True, eq=False)
class WetGround:
    """The ground about the cameras' path. left_m, bottom_m: the corner. channels [Y, X, CHANNELS],
    rows towards +y, at the cells' middles:

    HEIGHT: z of the ground, smoothed, world; that of the nearest where there is none. OPEN: 0 to 1,
    how far rain reaches it, times the film that its surface holds; 0 where it is no ground. RISE_X,
    RISE_Y: its slope. HOLLOW: how soon water stands there, see `puddle_level`. TRACK: 0 to 1, how
    much of a wheel track it is. tops_m, exposed [Y, X]: highest surface that can be wet, ground or
    roof, NaN where there is none, and how open that is to the rain.
    """

    left_m: float
    bottom_m: float
    channels: Float[Tensor, "Y X C"]
    tops_m: Float[Tensor, "Y X"]
    exposed: Float[Tensor, "Y X"]
    ordered_hollows: np.ndarray

    @property
    def is_empty(self) -> bool:
        return not bool((self.channels[..., OPEN] > 0).any())

    def at(self, x_m: Tensor, y_m: Tensor) -> Float[Tensor, "*B C"]:
        """The channels between the cells' middles; beyond the map its border's, and not open."""
        rows, columns = self.channels.shape[:2]
        x, y = (x_m - self.left_m) / CELL_M - 0.5, (y_m - self.bottom_m) / CELL_M - 0.5
        inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)
        x, y = x.clamp(0, columns - 1), y.clamp(0, rows - 1)
        i, j = x.long().clamp_max(max(columns - 2, 0)), y.long().clamp_max(max(rows - 2, 0))
        u, v = (x - i)[..., None].float(), (y - j)[..., None].float()
        i1, j1 = (i + 1).clamp_max(columns - 1), (j + 1).clamp_max(rows - 1)
        flat = self.channels.reshape(-1, CHANNELS)
        below = flat[j * columns + i] * (1 - u) + flat[j * columns + i1] * u
        above = flat[j1 * columns + i] * (1 - u) + flat[j1 * columns + i1] * u
        out = below * (1 - v) + above * v
        out[..., OPEN] *= inside
        return out

    def nearest(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """The channels of the cells about points, as `at` beyond the map."""
        rows, columns = self.channels.shape[:2]
        i = np.floor((x_m - self.left_m) / CELL_M).astype(np.int64)
        j = np.floor((y_m - self.bottom_m) / CELL_M).astype(np.int64)
        inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
        out = self.channels.numpy()[np.clip(j, 0, rows - 1), np.clip(i, 0, columns - 1)]
        out[..., OPEN] *= inside
        return out

    def puddle_level(self, share: float) -> float:
        """The HOLLOW beyond which water stands where `share` of the open ground has puddles."""
        ordered = self.ordered_hollows
        if share <= 0 or not len(ordered):
            return NO_PUDDLES
        return float(ordered[min(int((1 - share) * len(ordered)), len(ordered) - 1)])


def wet_ground(scene: Scene, seed: int, *, backend: str = "auto") -> WetGround:
    """The ground of a scene; seed: of the noise that puddles follow.

    Raises:
        SceneError: metres or gravity are not known.
    """
    cells = support_of(scene, SETTINGS, backend=backend).ground
    key = ("wet ground", seed)
    path = [frame.world_from_ego[:3, 3].numpy() for frame in scene.frames]
    path += [c.centre.numpy() for f in scene.frames for c in f.cameras.values()]
    return memo_of(scene).get(key, lambda: _make(cells, np.array(path).reshape(-1, 3), seed))


def _make(cells: SnowCells, path: np.ndarray, seed: int) -> WetGround:
    classes = cells.semantic.numpy()
    kept = classes != SemanticClass.VEGETATION
    if not kept.any():
        nothing = torch.zeros(2, 2)
        channels = torch.zeros(2, 2, CHANNELS)
        return WetGround(0.0, 0.0, channels, nothing / 0, nothing, np.zeros(0, np.float32))
    centres, sizes = cells.centers_m.double().numpy()[kept], cells.sizes_m.double().numpy()[kept]
    classes, tracks = classes[kept], cells.tracks.numpy()[kept]
    low = np.floor((centres[:, :2] - sizes[:, None] / 2).min(0) / CELL_M) - 2
    high = np.ceil((centres[:, :2] + sizes[:, None] / 2).max(0) / CELL_M) + 2
    columns, rows = (high - low).astype(np.int64)
    paint = _Painter(low, int(columns), int(rows), centres[:, :2], sizes)
    tops = paint.mean(centres[:, 2])
    films = np.array([_FILMS.get(SemanticClass(c), 0.0) for c in range(len(SemanticClass))])
    film = np.nan_to_num(paint.mean(films[classes]))
    unsure = np.nan_to_num(paint.mean(np.isin(classes, _UNSURE).astype(np.float64))) > 0.5
    known = np.nan_to_num(paint.mean(np.isin(classes, GROUND).astype(np.float64))) > 0.5
    ground = known | (unsure & _about_path(tops, path, low))
    track = np.where(ground, np.nan_to_num(paint.mean(tracks.astype(np.float64))), 0)
    exposed = _softened(np.isfinite(tops))
    open_ = _softened(ground) * np.where(ground, film, 0)
    open_ = _blur(open_, _SHELTER_SIGMA_M / 2)
    heights = _smooth(tops, ground, _SMOOTH_M)
    level = _smooth(tops, ground, _LEVEL_M)
    rise_y, rise_x = np.gradient(level, CELL_M)
    hollows = _hollows(heights, np.hypot(rise_x, rise_y), ground, track, low, seed)
    channels = np.stack([heights, open_, rise_x, rise_y, hollows, _blur(track, 0.15)], -1)
    ordered = np.sort(hollows[open_ > 0.5]).astype(np.float32)
    left_m, bottom_m = (low * CELL_M).tolist()
    return WetGround(
        left_m,
        bottom_m,
        torch.from_numpy(np.ascontiguousarray(channels, np.float32)),
        torch.from_numpy(tops.astype(np.float32)),
        torch.from_numpy(exposed.astype(np.float32)),
        ordered[:: max(1, len(ordered) // 4096)],
    )


class _Painter:
    """Cells of many sizes onto the map's, each over all that its square covers."""

    def __init__(
        self, low: np.ndarray, columns: int, rows: int, xy: np.ndarray, sizes: np.ndarray
    ) -> None:
        self._shape = rows, columns
        place, source = [], []
        for size in np.unique(sizes):
            index = np.flatnonzero(sizes == size)
            across = max(1, round(float(size) / CELL_M))
            steps = (np.arange(across) + 0.5) * (size / across) - size / 2
            for dx in steps:
                for dy in steps:
                    at = np.floor((xy[index] + (dx, dy)) / CELL_M - low).astype(np.int64)
                    place.append(at[:, 1] * columns + at[:, 0])
                    source.append(index)
        self._place, self._source = np.concatenate(place), np.concatenate(source)
        self._count = np.bincount(self._place, minlength=rows * columns)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """[Y, X]; NaN where no cell lies."""
        sums = np.bincount(self._place, values[self._source], len(self._count))
        with np.errstate(invalid="ignore", divide="ignore"):
            return (sums / self._count).reshape(self._shape)


def _about_path(tops: np.ndarray, path: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Where surfaces without a class are ground: they go on without a step from the path."""
    there = np.isfinite(tops)
    filled = np.where(there, tops, 0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    most = cv2.dilate(np.where(there, filled, -np.float32(1e6)), kernel)
    least = cv2.erode(np.where(there, filled, np.float32(1e6)), kernel)
    labels = np.zeros(tops.shape, np.int32)
    ndimage.label(there & (most - least < _STEP_M), output=labels)
    places = np.floor(path[:, :2] / CELL_M - low).astype(np.int64)
    near = np.zeros(tops.shape, np.uint8)
    inside = ((places >= 0) & (places < np.array(tops.shape[::-1]))).all(1)
    near[places[inside, 1], places[inside, 0]] = 1
    reach = 2 * round(_NEAR_PATH_M / CELL_M) + 1
    near = cv2.dilate(near, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))) > 0
    counts = np.bincount(labels[near & (labels > 0)], minlength=1)
    found = (labels == counts.argmax()) & (labels > 0) if counts.any() else np.zeros_like(there)
    return cv2.dilate(found.astype(np.uint8), kernel).astype(bool) & there


def _softened(mask: np.ndarray) -> np.ndarray:
    """1 inside, falling to 0 at the edge."""
    return np.clip(2 * _blur(mask.astype(np.float64), _SHELTER_SIGMA_M) - 0.9, 0, 1)


def _blur(values: np.ndarray, sigma_m: float) -> np.ndarray:
    sigma = sigma_m / CELL_M
    return cv2.GaussianBlur(
        values.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE
    ).astype(np.float64)


def _smooth(tops: np.ndarray, ground: np.ndarray, sigma_m: float) -> np.ndarray:
    """Heights of the ground, blurred over ground alone; the nearest beyond it."""
    middle = float(np.median(tops[ground])) if ground.any() else 0.0  # keeps float32's digits
    weight = _blur(ground.astype(np.float64), sigma_m)
    sums = _blur(np.where(ground, np.nan_to_num(tops) - middle, 0), sigma_m)
    known = weight > 0.02
    if not known.any():
        return np.zeros(tops.shape)
    out = np.where(known, sums / np.maximum(weight, 0.02), 0) + middle
    nearest: Any = ndimage.distance_transform_edt(
        ~known, return_distances=False, return_indices=True
    )
    return out[tuple(nearest)]


def _hollows(
    heights: np.ndarray,
    slope: np.ndarray,
    ground: np.ndarray,
    track: np.ndarray,
    low: np.ndarray,
    seed: int,
) -> np.ndarray:
    """How soon water stands: a hollow's depth, which a closing of the heights fills, ruts, and
    noise of the place; less on slopes.
    """
    wide = 2 * round(_HOLLOW_M / CELL_M / 2) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    base = heights.astype(np.float32)
    filled = cv2.morphologyEx(base, cv2.MORPH_CLOSE, disc)
    depth_cm = _blur(np.clip(filled - base, 0, _DEEPEST_M) * 100, 0.2)
    rng = rng_for(seed=seed, scene="", effect="puddles")
    rows, columns = (-(-n // _NOISE_EVERY) + 1 for n in heights.shape)
    x = (low[0] + (np.arange(columns) + 0.5) * _NOISE_EVERY) * CELL_M
    y = (low[1] + (np.arange(rows) + 0.5) * _NOISE_EVERY) * CELL_M
    grid_x, grid_y = np.meshgrid(x, y)
    noise = field_of(octaves_of(_NOISE, rng), grid_x.ravel(), grid_y.ravel()).reshape(rows, columns)
    size = (columns * _NOISE_EVERY, rows * _NOISE_EVERY)
    noise = cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC)
    noise = noise[: heights.shape[0], : heights.shape[1]]
    out = _PER_CM * depth_cm + noise + 0.3 * track
    return out - 4 * np.clip(slope / _STEEPEST, 0, 2) - 6.0 * (_blur(ground, 0.2) < 0.5)


# ---- Which splats are wetted ---------------------------------------------------------------------

_ON_SURFACE_M = 0.15  # splats as far off a cell's surface are it
_UPRIGHT = 0.8  # cosine of the tilt of a splat that may be a roof
_MIN_ROOF = (SemanticClass.BUILDING, SemanticClass.BARRIER)


@dataclass(frozen=True, eq=False)
class WetSplats:
    """Of N background Gaussians. wet [N]: 0 to 1, how far rain reaches them. is_ground [N]: which
    are the ground's, wet or dry.
    """

    wet: Float[Tensor, "N"]
    is_ground: Tensor


def wet_splats(scene: Scene, ground: WetGround) -> WetSplats:
    """The background's splats that lie on open ground or roofs."""
    return memo_of(ground).get(("wet splats",), lambda: _find_splats(scene.background, ground))


def _find_splats(own: Gaussians, ground: WetGround) -> WetSplats:
    classes = np.zeros(len(own), np.int16) if own.semantic is None else own.semantic.numpy()
    x, y, z = own.means.double().numpy().T.reshape(3, -1)
    channels = ground.at(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    near = np.abs(z - channels[:, HEIGHT]) < 2 * _ON_SURFACE_M
    is_ground = np.isin(classes, GROUND) | (np.isin(classes, _UNSURE) & near)
    i = np.floor((x - ground.left_m) / CELL_M).astype(np.int64)
    j = np.floor((y - ground.bottom_m) / CELL_M).astype(np.int64)
    rows, columns = ground.tops_m.shape
    inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
    i, j = np.clip(i, 0, columns - 1), np.clip(j, 0, rows - 1)
    off = np.abs(z - ground.tops_m.numpy()[j, i])
    on = np.clip(2 - off / _ON_SURFACE_M, 0, 1) * inside
    on = np.nan_to_num(on) * ground.exposed.numpy()[j, i]
    thinnest = own.scales.argmin(1)
    up = rotmat_from_quat(own.quats)[:, 2][torch.arange(len(own)), thinnest].abs().numpy()
    can_be = is_ground | (np.isin(classes, _MIN_ROOF) & (up > _UPRIGHT))
    wet = np.where(can_be, on, 0).astype(np.float32)
    return WetSplats(torch.from_numpy(wet), torch.from_numpy(is_ground & near))
