"""Sun and shade on the ground of a scene, as its colours show them.

In: a scene's background. Out: `CastShadows` (by `shadows_of`): the sun's direction, how dark its
shadows are, and a map of lit ground. Smog and clouds fade these shadows (`faded_shadows`), and
`scene_light` takes the sun from here.

A dark ground is a shadow or dark asphalt. The things that stand on it tell which. They cast shadows
on the ground from every direction of a coarse grid, and the direction whose shadows differ most in
brightness from the other ground is the sun's. If even those shadows are hardly darker, or half as
bright without being bluer, there is no sun.

The darkness of shadows comes from the ground's two modes of luminance (Otsu 1979), where modes and
cast shadows agree, since things that stand higher than a recording reaches cast shadows as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int16
from torch import Tensor

from augment.light.srgb import LUMINANCE_WEIGHTS, linear_from_display
from augment.memo import memo_of
from augment.render.fog import Fog, vertical_optical_depth
from augment.render.sh import SH_C0
from augment.scene.geometry import rotmat_from_quat
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.scene.semantics import SemanticClass

# Classes of ground whose shadows count; the first decides the sun's direction. Paint is left out.
_GROUNDS = (SemanticClass.ROAD, SemanticClass.SIDEWALK, SemanticClass.TERRAIN)
# Opacity from which a splat casts a shadow.
SOLID_OPACITY = 0.5
# Cosine to +z from which a splat may be ground where no class says so.
_LEVEL_COSINE = 0.9
# Weights of linear red, green and blue in luminance.
_LUMINANCE = np.array(LUMINANCE_WEIGHTS)

# Side of a cell of the map, metres.
_CELL_M = 0.25
# Cells along the map's longer side; a larger map has larger cells.
_MAX_CELLS = 1024
# Margin of the map around the cameras, metres.
_AROUND_M = 40.0
# Standard deviation of the blur that closes gaps between splats, cells.
_SPREAD_CELLS = 1.0
# Side of the median filter, cells; paint, manholes and cracks are narrower.
_MEDIAN_CELLS = 5
# Cells of ground below which nothing can be told: 25 m2.
_MIN_CELLS = 400

# Azimuths that the sun is looked for in, radians.
_AZIMUTHS = np.radians(np.arange(0, 360, 10.0))
# Elevations that the sun is looked for in, radians.
_ELEVATIONS = np.radians([6.0, 9, 12, 16, 20, 25, 30, 36, 43, 50, 58, 66])
# Distance from which things count as casting shadows, metres. Nearer things also keep sky light off
# the ground.
_FROM_M = 0.8
# Distance up to which things count, metres.
_REACH_M = 27.0
# Factor from one distance to the next.
_STEP = 1.07
# Height above the ground that casts no shadow, metres.
_OVER_M = 0.1
# Height above the ground from which things are no buildings, metres.
_HIGHEST_M = 60.0
# Standard deviation from which splats are sky or haze, metres.
_LARGEST_M = 1.5
# Cells of ground that are tested at most.
_MAX_ASKED = 8000
# Share of these cells that a direction must shade to tell anything.
_MIN_SHARE = 0.02
# Shaded over lit luminance of a direction's shadows as blue as the sky that lights them: at most
# the first is a sun, at least the second is none. (Nothing casts shadows in PandaSet 002, whose sun
# is behind clouds: the darkest direction has 0.84.)
_BLUE = (0.65, 0.8)
# The same for grey shadows: asphalt is grey, and half as bright where it is new.
_GREY = (0.4, 0.5)
# Blue over red of shadows, over that of lit ground: at most the first is grey, at least the second
# is blue.
_BLUENESS = (1.03, 1.12)
# Distance from the ground's height within which a place lies on the ground, metres.
ON_GROUND_M = 0.3
# Shaded over lit luminance in clear air, at least, whatever a camera's contrast makes of it.
_DARKEST = 0.15


@dataclass(frozen=True, eq=False)
class CastShadows:
    """Light of the sun on the ground of a scene."""

    certainty: float
    """0 without any shadow, 1 where shadows are plain."""
    shade_ratio: tuple[float, float, float]
    """Shaded over lit ground, linear red, green and blue."""
    lit_rgb: tuple[float, float, float]
    """Colour of the lit road, linear; its median without shadows."""
    lit_share: float
    """Share of the ground that is lit."""
    azimuth_deg: float
    """Azimuth of the sun by its shadows; 0 degrees is world +x."""
    elevation_deg: float
    """Elevation of the sun by its shadows."""
    explained_share: Float32[np.ndarray, "A E"]
    """Share of the variance of log luminance that shadows explain, -1 to 1, by azimuth and
    elevation of the grid."""
    sun_share: Float32[np.ndarray, "H W"]
    """Share of the sun that each cell sees, 0 to 1; the first axis is x."""
    known_share: Float32[np.ndarray, "H W"]
    """1 for cells of known ground, else 0."""
    height_m: Float32[np.ndarray, "H W"]
    """Height of the ground in each cell."""
    corner_m: tuple[float, float]
    """x and y of the first cell's corner."""
    cell_m: float
    """Side of a cell."""

    @property
    def luminance_ratio(self) -> float:
        """Return shaded over lit luminance."""
        return float(np.dot(self.shade_ratio, _LUMINANCE))

    def explained_by(self, azimuth_deg: float, elevation_deg: float) -> float:
        """Return the variance that a sun near a direction explains, over that of the best
        direction.
        """
        best = float(self.explained_share.max())
        if best <= 0:
            return 0.0
        azimuth_index = round(azimuth_deg / 10) % len(_AZIMUTHS)
        elevation_index = int(np.abs(_ELEVATIONS - math.radians(elevation_deg)).argmin())
        neighbours = np.take(
            self.explained_share,
            [azimuth_index - 1, azimuth_index, (azimuth_index + 1) % len(_AZIMUTHS)],
            axis=0,
        )
        return float(neighbours[:, max(elevation_index - 1, 0) : elevation_index + 2].max()) / best

    def light_at(self, places_m: np.ndarray) -> np.ndarray:
        """Return luminance over that in the sun at places [N, 3], [N]; NaN off the known ground."""
        sun_share, known_share, height_m = self.sample(places_m[:, 0], places_m[:, 1])
        ratio = self.luminance_ratio
        on_ground = (known_share > 0.5) & (np.abs(places_m[:, 2] - height_m) < ON_GROUND_M)
        light = ratio + (1 - ratio) * sun_share / np.maximum(known_share, 0.5)
        return np.where(on_ground, light, np.nan)

    def sample(self, x_m: np.ndarray, y_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return lit, known and height_m at places of any shape, float32, interpolated.

        `known_share` is 0 beyond the map.
        """
        # OpenCV's pixels are centred at whole numbers.
        rows = ((x_m - self.corner_m[0]) / self.cell_m - 0.5).astype(np.float32)
        columns = ((y_m - self.corner_m[1]) / self.cell_m - 0.5).astype(np.float32)
        shape = rows.shape
        rows, columns = (np.atleast_2d(np.nan_to_num(c, nan=-9.0)) for c in (rows, columns))
        rows = _wrapped(rows)
        columns = _wrapped(columns)
        maps = (self.sun_share, self.known_share, self.height_m)
        map_values = (
            cv2.remap(m, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            for m in maps
        )
        lit, known_share, height = (_unwrapped(values, shape) for values in map_values)
        return lit, known_share, height


def _wrapped(values: np.ndarray) -> np.ndarray:
    """Return a long row as an image: OpenCV takes no more than 32767 values of a row."""
    if values.shape[0] > 1 or values.shape[1] < 32_000:
        return np.ascontiguousarray(values)
    rows = -(-values.size // 16_384)
    out = np.full(rows * 16_384, -9.0, np.float32)
    out[: values.size] = values.ravel()
    return out.reshape(rows, 16_384)


def _unwrapped(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the values of an image of `_wrapped` in their own shape."""
    return values.ravel()[: math.prod(shape)].reshape(shape)


def is_low_and_level(g: Gaussians, scene: Scene) -> np.ndarray:
    """Return the mask of splats that may be ground.

    They are flat, and below the cameras, or in the scene's lower half without cameras.
    """
    if len(g) == 0:
        return np.zeros(0, bool)
    up = rotmat_from_quat(g.quats)[:, 2].double().numpy()  # the world's z along each splat's axes
    thinnest = g.scales.argmin(1).numpy()
    is_level = np.abs(up[np.arange(len(g)), thinnest]) > _LEVEL_COSINE
    z = g.means[:, 2].double().numpy()
    eyes = _eyes(scene)
    return is_level & (z < (float(eyes[:, 2].min()) if len(eyes) else float(np.median(z))))


# Key of the shadows in a scene's memo.
_MEMO = ("cast shadows",)


def shadows_of(scene: Scene) -> CastShadows | None:
    """Return the sun's light on the scene's ground, computed once a scene.

    None where the scene has too little ground, or nothing that could cast a shadow on it.
    """

    def find() -> tuple[CastShadows | None]:  # a value that is None would be made again
        return (_find_shadows(scene),)

    scene = scene.as_recorded
    return memo_of(scene).get(_MEMO, find)[0]


def precompute_shadows(scene: Scene) -> None:
    """Compute the shadows now, so that a job's processes need not."""
    scene = scene.as_recorded
    memo_of(scene).put(_MEMO, (shadows_of(scene),), shared=True)


def _eyes(scene: Scene) -> np.ndarray:
    """Return the places of the cameras, [P, 3]."""
    cameras = [c for frame in scene.frames for c in frame.cameras.values()]
    return np.array([c.centre.numpy() for c in cameras]).reshape(-1, 3)


def _find_shadows(scene: Scene) -> CastShadows | None:
    """Return the sun's light on the scene's ground, as `shadows_of`."""
    g = scene.background
    is_solid = (g.opacities > SOLID_OPACITY).numpy() & g.means.isfinite().all(1).numpy()
    ground_masks = _ground_splats(g, scene, is_solid)
    if not ground_masks:
        return None
    grid = _Grid.of(scene, g.means.double().numpy(), ground_masks[0])
    # Explain the road's brightness by the shadows of every direction; the best one is the sun's.
    road = grid.surface(g, ground_masks[0], np.ones(len(g)))
    rows, columns = np.nonzero(road.is_known)
    if len(rows) < _MIN_CELLS:
        return None
    tops = grid.tops(g, is_solid & (g.scales.max(1).values < _LARGEST_M).numpy())
    sampling = slice(None, None, 1 + len(rows) // _MAX_ASKED)
    rows = rows[sampling]
    columns = columns[sampling]
    horizons = grid.horizons(tops, road.height_m, rows, columns, _AZIMUTHS)
    log_luminance = road.log_luminance[rows, columns]
    log_luminance = log_luminance.clip(*np.quantile(log_luminance, [0.01, 0.99]))
    explained_share = _explain_variance(horizons, log_luminance)
    if not np.isfinite(explained_share).any():
        return None
    explained_share = np.where(np.isfinite(explained_share), explained_share, 0.0)
    azimuth_index, elevation_index = np.unravel_index(
        explained_share.argmax(), explained_share.shape
    )
    slope = math.tan(_ELEVATIONS[elevation_index])
    is_shaded = horizons[azimuth_index] > slope
    log_rgb = np.log(np.maximum(road.linear[rows, columns], 1e-4))
    change = np.median(log_rgb[is_shaded], 0) - np.median(log_rgb[~is_shaded], 0)
    blueness = _ramp(math.exp(change[2] - change[0]), *_BLUENESS)
    sunny, sunless = (g + blueness * (b - g) for g, b in zip(_GREY, _BLUE, strict=True))
    direction_ratio = math.exp(
        np.median(log_luminance[is_shaded]) - np.median(log_luminance[~is_shaded])
    )
    certainty = 1 - _ramp(direction_ratio, sunny, sunless)
    is_dark = log_luminance <= _otsu_threshold(log_luminance)
    dark_and_lit = (is_shaded & is_dark, ~is_shaded & ~is_dark)
    if min(dark_and_lit[0].sum(), dark_and_lit[1].sum()) < _MIN_SHARE * len(is_dark):
        certainty = 0.0
        dark_and_lit = (is_dark, ~is_dark)
    modes = [np.median(log_rgb[mask], 0) if mask.any() else log_rgb[0] for mask in dark_and_lit]
    change = (modes[0] - modes[1]).clip(math.log(_DARKEST), 0)
    ratio = np.exp(certainty * change)

    # Other ground: its albedo over the road's, then the map of lit ground.
    albedos = np.ones(len(g))
    for ground_mask in ground_masks[1:]:
        part = grid.surface(g, ground_mask, albedos)
        known_cells = np.nonzero(part.is_known)
        if len(known_cells[0]) == 0:
            continue
        horizon = grid.horizons(
            tops,
            part.height_m,
            known_cells[0],
            known_cells[1],
            _AZIMUTHS[azimuth_index : azimuth_index + 1],
        )[0]
        light = np.where(horizon > slope, float(np.exp(change) @ _LUMINANCE), 1.0)
        lit_road = float(np.exp(modes[1]) @ _LUMINANCE)
        albedos[ground_mask] = np.median(np.exp(part.log_luminance[known_cells]) / light) / lit_road
    all_ground = grid.surface(g, np.logical_or.reduce(ground_masks), albedos)
    dark_level, lit_level = (float(np.exp(mode) @ _LUMINANCE) for mode in modes)
    lit = np.exp(all_ground.log_luminance) - dark_level
    lit = (lit / max(lit_level - dark_level, 1e-3 * lit_level)).clip(0, 1)
    return CastShadows(
        certainty=certainty,
        shade_ratio=_triple(ratio),
        lit_rgb=_triple(np.exp(modes[1] if certainty > 0 else np.median(log_rgb, 0))),
        lit_share=float(lit[all_ground.is_known].mean()),
        azimuth_deg=math.degrees(_AZIMUTHS[azimuth_index]),
        elevation_deg=math.degrees(_ELEVATIONS[elevation_index]),
        explained_share=explained_share.astype(np.float32),
        sun_share=np.where(all_ground.is_known, lit, 0).astype(np.float32),
        known_share=all_ground.is_known.astype(np.float32),
        height_m=np.where(all_ground.is_known, all_ground.height_m, 0).astype(np.float32),
        corner_m=(float(grid.corner[0]), float(grid.corner[1])),
        cell_m=grid.cell_m,
    )


def _ground_splats(g: Gaussians, scene: Scene, is_solid: np.ndarray) -> list[np.ndarray]:
    """Return masks of the splats that are ground, bool [N], one for each kind of ground.

    The road comes first, or all splats that may be ground where no class is known.
    """
    if g.semantic is not None:
        classes = g.semantic.numpy()
        masks = [is_solid & (classes == int(semantic)) for semantic in _GROUNDS]
        if masks[0].sum() >= _MIN_CELLS:
            return masks
    is_low = is_solid & is_low_and_level(g, scene)
    return [is_low] if is_low.sum() >= _MIN_CELLS else []


class _Surface(NamedTuple):
    """Ground seen from above, without what is narrow."""

    linear: np.ndarray
    """Linear colour, [H, W, 3]."""
    log_luminance: np.ndarray
    """Logarithm of luminance, [H, W]."""
    height_m: np.ndarray
    """Height, [H, W]."""
    is_known: np.ndarray
    """Mask of cells with ground, [H, W]."""


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cells seen from above; the first axis is x."""

    corner: np.ndarray
    """x and y of the first cell's corner, metres."""
    cell_m: float
    """Side of a cell."""
    size: tuple[int, int]
    """Number of cells along x and y."""
    places: np.ndarray
    """Centres of the splats, [N, 3], metres."""

    @staticmethod
    def of(scene: Scene, places: np.ndarray, ground: np.ndarray) -> _Grid:
        """Return the grid around the cameras, or around the middle of the ground."""
        eyes = _eyes(scene)[:, :2]
        eyes = eyes if len(eyes) else np.median(places[ground, :2], 0)[None]
        corner = eyes.min(0) - _AROUND_M
        ends = eyes.max(0) + _AROUND_M
        cell_m = max(_CELL_M, float((ends - corner).max()) / _MAX_CELLS)
        height, width = (int(n) for n in np.ceil((ends - corner) / cell_m))
        return _Grid(corner, cell_m, (height, width), places)

    def cells_of(self, is_chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return flat numbers of the cells of chosen splats, and the splats within the grid."""
        splats = np.flatnonzero(is_chosen)
        index = np.floor((self.places[splats, :2] - self.corner) / self.cell_m)
        is_inside = ((index >= 0) & (index < self.size)).all(1)
        index = index[is_inside].astype(np.int64)
        return index[:, 0] * self.size[1] + index[:, 1], splats[is_inside]

    def surface(self, g: Gaussians, is_chosen: np.ndarray, albedos: np.ndarray) -> _Surface:
        """Return the ground that chosen splats show.

        Args:
            g: the N splats.
            is_chosen: mask of the splats, [N].
            albedos: albedo of each splat, by which its colour is divided, [N].
        """
        cells, splats = self.cells_of(is_chosen)
        scales = g.scales.double().numpy()[splats]
        areas = np.minimum(scales.prod(1) / np.maximum(scales.min(1), 1e-12), self.cell_m**2)
        rgb = 0.5 + SH_C0 * g.sh[:, 0].double().numpy()[splats]
        linear = linear_from_display(np.clip(np.nan_to_num(rgb), 0, 1)) / albedos[splats, None]

        def blurred(values: np.ndarray) -> np.ndarray:
            sums = np.bincount(cells, areas * values, math.prod(self.size)).reshape(self.size)
            return cv2.GaussianBlur(sums.astype(np.float32), (0, 0), _SPREAD_CELLS)

        weight = blurred(np.ones(len(splats)))
        is_known = weight > 0.02 * self.cell_m**2
        safe_weight = np.where(is_known, weight, 1)
        means = [
            cv2.medianBlur(
                np.where(is_known, blurred(values) / safe_weight, 0).astype(np.float32),
                _MEDIAN_CELLS,
            )
            for values in (*linear.T, self.places[splats, 2])
        ]
        is_known = cv2.erode(is_known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rgb = np.stack(means[:3], -1)
        return _Surface(rgb, np.log(np.maximum(rgb @ _LUMINANCE, 1e-4)), means[3], is_known)

    def tops(self, g: Gaussians, is_chosen: np.ndarray) -> np.ndarray:
        """Return the height of the highest chosen splat in each cell, [H, W]; -inf without any."""
        cells, splats = self.cells_of(is_chosen)
        out = np.full(math.prod(self.size), -np.inf)
        np.maximum.at(out, cells, self.places[splats, 2])
        return out.reshape(self.size)

    def horizons(
        self,
        tops: np.ndarray,
        ground_m: np.ndarray,
        rows: np.ndarray,
        columns: np.ndarray,
        azimuths: np.ndarray,
    ) -> np.ndarray:
        """Return the slope from K cells of ground to the highest thing in each direction, [A, K].

        Args:
            tops: height of the highest splat in each cell, [H, W].
            ground_m: height of the ground, [H, W].
            rows: rows of the cells of ground, [K].
            columns: their columns, [K].
            azimuths: the directions, radians, [A].
        """
        height, width = self.size
        z = ground_m[rows, columns] + _OVER_M
        out = np.full((len(azimuths), len(rows)), -np.inf)
        for slopes, azimuth in zip(out, azimuths, strict=True):
            distance_m = _FROM_M
            while distance_m < _REACH_M:
                i = rows + round(math.cos(azimuth) * distance_m / self.cell_m)
                j = columns + round(math.sin(azimuth) * distance_m / self.cell_m)
                is_inside = (i >= 0) & (i < height) & (j >= 0) & (j < width)
                height_over = tops[i.clip(0, height - 1), j.clip(0, width - 1)] - z
                height_over = np.where(is_inside & (height_over < _HIGHEST_M), height_over, -np.inf)
                np.maximum(slopes, height_over / distance_m, out=slopes)
                distance_m = max(distance_m + self.cell_m, distance_m * _STEP)
        return out


def _explain_variance(horizons: np.ndarray, log_luminance: np.ndarray) -> np.ndarray:
    """Return the share of the variance of K values that each direction's shadows explain, [A, E].

    It is negative where shadows are brighter, and -inf where there are too few.
    """
    out = np.full((len(_AZIMUTHS), len(_ELEVATIONS)), -np.inf)
    total = log_luminance.sum()
    variance = max(float(log_luminance.var()), 1e-6)
    num_values = len(log_luminance)
    for row, direction_horizons in zip(out, horizons, strict=True):
        for elevation_index, slope in enumerate(np.tan(_ELEVATIONS)):
            is_shaded = direction_horizons > slope
            num_shaded = int(is_shaded.sum())
            shaded_share = num_shaded / num_values
            if _MIN_SHARE <= shaded_share <= 1 - _MIN_SHARE:
                shaded_sum = log_luminance[is_shaded].sum()
                contrast = (total - shaded_sum) / (
                    num_values - num_shaded
                ) - shaded_sum / num_shaded
                row[elevation_index] = (
                    shaded_share * (1 - shaded_share) * contrast * abs(contrast) / variance
                )
    return out


def _ramp(value: float, low: float, high: float) -> float:
    """Return 0 below low, 1 above high, and a straight line between."""
    return min(1.0, max(0.0, (value - low) / (high - low)))


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    """Return three values as floats."""
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _otsu_threshold(values: np.ndarray) -> float:
    """Return Otsu's threshold between two modes of values."""
    low = float(values.min())
    high = float(values.max())
    scaled = (255 * (values - low) / max(high - low, 1e-6)).astype(np.uint8)
    threshold, _ = cv2.threshold(scaled, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    return low + (threshold + 0.5) / 255 * (high - low)


# ---- Shadows in smog -----------------------------------------------------------------------------
# Of the light on lit ground, q comes from the sky and 1 - q from the sun. Smog transmits T of the
# sun's light. The rest arrives scattered, the same everywhere, so that the ground's mean stays. A
# place sees a share s of the sun, and f is the mean of s over the ground:
#
#     before  E = q + (1 - q) s          after  E' = q + (1 - q) (T s + (1 - T) f)
#
# which multiplies linear colours by E' / E, and encoded ones by its 1/2.2th power.

# Depth of uniform smog, which has no top, metres: fog lies 50 to 300 m deep.
SMOG_DEPTH_M = 200.0
# Sine of the sun's elevation, at least, whatever its shadows look like.
_LOWEST_SUN = math.sin(math.radians(10.0))
# Steps from shaded to lit.
NUM_FADES = 32
# Exponent of encoded colours.
_ENCODING = 2.2
# Side of the square in which the light changes at an edge, cells.
_EDGE_CELLS = 7
# Change of the share of the sun within the square that is an edge.
_EDGE_STEP = 0.4
# Classes of ground whose shadows fade.
_GROUND_CLASSES = (*_GROUNDS, SemanticClass.LANE_MARKING)


@dataclass(frozen=True, eq=False)
class FadedShadows:
    """The ground of a scene under a sun that smog has dimmed."""

    shadows: CastShadows
    """The sun's light on the ground."""
    transmittance: float
    """T, 0 to 1."""
    rows: Int16[Tensor, "N"]
    """Row of `maps` for each splat of the background, int16 [N]."""
    maps: Float[Tensor, "K 3 4"]
    """Colour maps, [NUM_FADES + 1, 3, 4]; the first changes nothing."""

    def apply_to(self, part: PosedGaussians) -> PosedGaussians:
        """Return the background with its shadows faded, before any maps that it has."""
        if part.color_maps is None:
            return replace(part, color_maps=self.maps, color_rows=self.rows)
        outer_maps = part.color_maps.to(self.maps)
        outer_rows = part.color_map_rows
        maps = outer_maps[:, None, :, :3] @ self.maps[None, :, :, :3]
        maps = torch.cat([maps, outer_maps[:, None, :, 3:].expand(-1, len(self.maps), -1, -1)], -1)
        if outer_rows is None:
            return replace(part, color_maps=maps.flatten(0, 1), color_rows=self.rows)
        safe_rows = torch.where((outer_rows >= 0) & (outer_rows < len(outer_maps)), outer_rows, 0)
        return replace(
            part,
            color_maps=maps.flatten(0, 1),
            color_rows=(safe_rows * len(self.maps) + self.rows).to(torch.int16),
        )

    def gains_at(
        self, points_m: Float32[np.ndarray, "H W 3"]
    ) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "K 3"]]:
        """Return what fades the colours of points in the world.

        Args:
            points_m: the points.

        Returns:
            The share of the sun that each point sees (the mean for points that are no ground, which
            changes nothing), and factors of encoded colours by steps of that share.
        """
        sun_share = _find_sun_share(self.shadows, *np.moveaxis(points_m, -1, 0))
        factors = _fade_factors(self.shadows, self.transmittance, np.linspace(0, 1, 256))
        factors[round(255 * self.shadows.lit_share)] = 1
        return sun_share.astype(np.float32), factors


def faded_shadows(scene: Scene, transmittance: float) -> FadedShadows | None:
    """Return the scene's shadows under a dimmed sun; None where it shows no shadows.

    Args:
        scene: the scene.
        transmittance: share of the sun's light that arrives.
    """
    shadows = shadows_of(scene)
    if shadows is None or shadows.certainty == 0 or transmittance >= 1:
        return None

    def place() -> Tensor:
        g = scene.background
        sun_share = _sun_share_of_splats(shadows, g)
        rows = 1 + np.rint(sun_share * (NUM_FADES - 1))
        is_unchanged = np.abs(sun_share - shadows.lit_share) < 1e-6
        if g.semantic is not None:
            is_unchanged |= ~np.isin(
                g.semantic.numpy(), [int(semantic) for semantic in _GROUND_CLASSES]
            )
        return torch.from_numpy(np.where(is_unchanged, 0, rows).astype(np.int16))

    def scale() -> Tensor:
        factors = _fade_factors(shadows, transmittance, np.linspace(0, 1, NUM_FADES))
        maps = torch.zeros(NUM_FADES + 1, 3, 4)
        maps[:, :, :3] = torch.diag_embed(torch.from_numpy(np.vstack([np.ones(3), factors])))
        return maps

    memo = memo_of(scene.as_recorded)
    rows = memo.get(("faded shadows",), place)
    return FadedShadows(
        shadows, transmittance, rows, memo.get(("faded shadows", transmittance), scale)
    )


def sun_transmittance(fog: Fog, shadows: CastShadows, ground_z_m: float) -> float:
    """Return T of the sun's light, down to the ground."""
    sun_sine = max(math.sin(math.radians(shadows.elevation_deg)), _LOWEST_SUN)
    if fog.scale_height_m is None:
        return math.exp(-fog.extinction_per_m * SMOG_DEPTH_M / sun_sine)
    return math.exp(-vertical_optical_depth(fog, ground_z_m) / sun_sine)


def _find_sun_share(
    shadows: CastShadows, x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray
) -> np.ndarray:
    """Return the share of the sun that places see, blended to the mean off the ground."""
    sun_share, known_share, height_m = shadows.sample(x_m, y_m)
    relative_height = np.abs(z_m - height_m / np.maximum(known_share, 1e-6)) / ON_GROUND_M
    weight = known_share * (2 - 2 * relative_height).clip(0, 1)
    return shadows.lit_share + weight * (
        sun_share / np.maximum(known_share, 1e-6) - shadows.lit_share
    )


def _sun_share_of_splats(shadows: CastShadows, g: Gaussians) -> np.ndarray:
    """Return the share of the sun that N splats see, [N], as `_find_sun_share`.

    The map of lit ground is a metre wide at edges of shadows. There the splats' own colours tell,
    over the median of their class away from edges.
    """
    x_m, y_m, z_m = g.means.double().numpy().T
    sun_share = _find_sun_share(shadows, x_m, y_m, z_m)
    edges = _edges_of_light(shadows)
    rows = np.nan_to_num((x_m - shadows.corner_m[0]) / shadows.cell_m, nan=-1.0)
    columns = np.nan_to_num((y_m - shadows.corner_m[1]) / shadows.cell_m, nan=-1.0)
    is_inside = (rows >= 0) & (rows < edges.shape[0]) & (columns >= 0) & (columns < edges.shape[1])
    is_edge = np.zeros(len(g), bool)
    is_edge[is_inside] = edges[rows[is_inside].astype(int), columns[is_inside].astype(int)]
    is_on_ground = np.abs(sun_share - shadows.lit_share) > 1e-6
    semantic = np.zeros(len(g), np.int16) if g.semantic is None else g.semantic.numpy()
    rgb = (0.5 + SH_C0 * g.sh[:, 0].double().numpy()).clip(0, 1)
    luminance = linear_from_display(np.nan_to_num(rgb)) @ _LUMINANCE
    ratio = shadows.luminance_ratio
    light = ratio + (1 - ratio) * sun_share
    out = sun_share.copy()
    for semantic_class in np.unique(semantic):
        is_class = (semantic == semantic_class) & is_on_ground
        is_sure = is_class & ~is_edge
        if is_sure.sum() < _MIN_CELLS:
            continue
        albedo = max(float(np.median(luminance[is_sure] / light[is_sure])), 1e-4)
        is_unsure = is_class & is_edge
        out[is_unsure] = ((luminance[is_unsure] / albedo - ratio) / (1 - ratio)).clip(0, 1)
    return out


def _edges_of_light(shadows: CastShadows) -> np.ndarray:
    """Return the cells of known ground beside an edge between sun and shade, bool [H, W]."""
    square = np.ones((_EDGE_CELLS, _EDGE_CELLS), np.uint8)
    is_known = shadows.known_share > 0.5
    highest = cv2.dilate(np.where(is_known, shadows.sun_share, 0).astype(np.float32), square)
    lowest = cv2.erode(np.where(is_known, shadows.sun_share, 1).astype(np.float32), square)
    return is_known & (highest - lowest > _EDGE_STEP)


def _fade_factors(shadows: CastShadows, transmittance: float, sun_shares: np.ndarray) -> np.ndarray:
    """Return (E' / E)^(1/2.2) for shares of the sun [K], float32 [K, 3]."""
    q = np.array(shadows.shade_ratio)
    sun_share = sun_shares[:, None]
    mean_share = shadows.lit_share
    faded_light = q + (1 - q) * (transmittance * sun_share + (1 - transmittance) * mean_share)
    return ((faded_light / (q + (1 - q) * sun_share)) ** (1 / _ENCODING)).astype(np.float32)
