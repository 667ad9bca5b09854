"""Where the ground of a scene lies in the sun and where in the shade, as its colours show it.

A dark ground is a shadow or dark asphalt. Things that stand on it tell which: from every direction
of a coarse grid they are let cast shadows on the ground, and the direction whose shadows differ
most from the rest in brightness is the sun's. If even those are hardly darker, or half as bright
without being bluer, there is no sun.
How dark shadows are comes from the ground's two modes of luminance (Otsu 1979), where modes and
cast shadows agree, since what stands higher than a recording reaches casts shadows as well.
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

from augment.geometry import rotmat_from_quat
from augment.memo import memo_of
from augment.render.fog import Fog, vertical_optical_depth
from augment.render.sh import SH_C0
from augment.scene import Gaussians, PosedGaussians, Scene
from augment.semantics import SemanticClass

# The first tells; paint is left out.
_GROUNDS = (SemanticClass.ROAD, SemanticClass.SIDEWALK, SemanticClass.TERRAIN)
SOLID_OPACITY = 0.5
_LEVEL_COSINE = 0.9  # of a splat that may be ground where no class says so
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

_CELL_M, _MAX_CELLS, _AROUND_M = 0.25, 1024, 40.0
_SPREAD_CELLS = 1.0  # of the blur that closes gaps between splats
_MEDIAN_CELLS = 5  # paint, manholes and cracks are narrower
_MIN_CELLS = 400  # 25 m2: less ground tells nothing

# Of the sun's directions. Nearer than _FROM_M every thing keeps sky light off the ground, too.
_AZIMUTHS = np.radians(np.arange(0, 360, 10.0))
_ELEVATIONS = np.radians([6.0, 9, 12, 16, 20, 25, 30, 36, 43, 50, 58, 66])
_FROM_M, _REACH_M, _STEP = 0.8, 27.0, 1.07
_OVER_M = 0.1  # what stands no higher casts no shadow
_HIGHEST_M = 60.0
_LARGEST_M = 1.5  # standard deviation; larger splats are sky or haze
_MAX_ASKED = 8000  # cells of ground, of all
_MIN_SHARE = 0.02  # of them in the shade of a direction, for it to tell anything
# Shaded over lit luminance of a direction's shadows: at most the first is a sun, at least the
# second is none, if they are as blue as the sky that lights them, and if they are grey, as asphalt
# is, half as bright where it is new. (Nothing casts shadows in PandaSet 002, whose sun is behind
# clouds: the darkest direction has 0.84.)
_BLUE, _GREY = (0.65, 0.8), (0.4, 0.5)
_BLUENESS = (1.03, 1.12)  # their blue over red, beside what is lit
ON_GROUND_M = 0.3  # off the ground's height
_DARKEST = 0.15  # of a shadow in clear air, whatever a camera's contrast makes of it


@dataclass(frozen=True, eq=False)
class CastShadows:
    """What the ground shows of the sun's light.

    certainty: 0 without any shadow, 1 where they are plain. ratio: shaded over lit, linear red,
    green and blue. lit_rgb: of the road, linear; its median without shadows. lit_share: of the
    ground. azimuth_deg, elevation_deg: of the sun, by its
    shadows, 0 degrees azimuth is world +x. explained: share of the variance of log luminance that
    these explain, -1 to 1, by azimuth and elevation of the grid.

    lit, known: by place, float32 [H, W], 0 to 1; the first axis is x. height_m: of the ground
    there. corner_m: x and y of the first cell's corner.
    """

    certainty: float
    ratio: tuple[float, float, float]
    lit_rgb: tuple[float, float, float]
    lit_share: float
    azimuth_deg: float
    elevation_deg: float
    explained: Float32[np.ndarray, "A E"]
    lit: Float32[np.ndarray, "H W"]
    known: Float32[np.ndarray, "H W"]
    height_m: Float32[np.ndarray, "H W"]
    corner_m: tuple[float, float]
    cell_m: float

    @property
    def luminance_ratio(self) -> float:
        return float(np.dot(self.ratio, _LUMINANCE))

    def explained_by(self, azimuth_deg: float, elevation_deg: float) -> float:
        """Share of the variance that a sun near this direction explains, of the best one's."""
        best = float(self.explained.max())
        if best <= 0:
            return 0.0
        a = round(azimuth_deg / 10) % len(_AZIMUTHS)
        e = int(np.abs(_ELEVATIONS - math.radians(elevation_deg)).argmin())
        around = np.take(self.explained, [a - 1, a, (a + 1) % len(_AZIMUTHS)], axis=0)
        return float(around[:, max(e - 1, 0) : e + 2].max()) / best

    def light_at(self, places_m: np.ndarray) -> np.ndarray:
        """Luminance at places [N, 3] over what it is in the sun, [N]; NaN off the known ground."""
        lit, known, height_m = self.at(places_m[:, 0], places_m[:, 1])
        q = self.luminance_ratio
        on_ground = (known > 0.5) & (np.abs(places_m[:, 2] - height_m) < ON_GROUND_M)
        light = q + (1 - q) * lit / np.maximum(known, 0.5)
        return np.where(on_ground, light, np.nan)

    def at(self, x_m: np.ndarray, y_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """lit, known and height_m at places of any shape, float32; known is 0 beyond the map."""
        # OpenCV's pixels are centred at whole numbers.
        rows = ((x_m - self.corner_m[0]) / self.cell_m - 0.5).astype(np.float32)
        columns = ((y_m - self.corner_m[1]) / self.cell_m - 0.5).astype(np.float32)
        shape = rows.shape
        rows, columns = (np.atleast_2d(np.nan_to_num(c, nan=-9.0)) for c in (rows, columns))
        rows, columns = _wrapped(rows), _wrapped(columns)
        maps = (self.lit, self.known, self.height_m)
        found = (
            cv2.remap(m, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            for m in maps
        )
        lit, known, height = (_unwrapped(f, shape) for f in found)
        return lit, known, height


def _wrapped(values: np.ndarray) -> np.ndarray:
    """OpenCV takes no more than 32767 of a row: a list becomes an image."""
    if values.shape[0] > 1 or values.shape[1] < 32_000:
        return np.ascontiguousarray(values)
    rows = -(-values.size // 16_384)
    out = np.full(rows * 16_384, -9.0, np.float32)
    out[: values.size] = values.ravel()
    return out.reshape(rows, 16_384)


def _unwrapped(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return values.ravel()[: math.prod(shape)].reshape(shape)


def linear_from_display(rgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((np.maximum(rgb, 0) + 0.055) / 1.055) ** 2.4)


def is_low_and_level(g: Gaussians, scene: Scene) -> np.ndarray:
    """Splats that may be ground: flat, and below the cameras, or in the scene's lower half."""
    if len(g) == 0:
        return np.zeros(0, bool)
    up = rotmat_from_quat(g.quats)[:, 2].double().numpy()  # the world's z along each splat's axes
    thinnest = g.scales.argmin(1).numpy()
    is_level = np.abs(up[np.arange(len(g)), thinnest]) > _LEVEL_COSINE
    z = g.means[:, 2].double().numpy()
    eyes = _eyes(scene)
    return is_level & (z < (float(eyes[:, 2].min()) if len(eyes) else float(np.median(z))))


_MEMO = ("cast shadows",)


def shadows_of(scene: Scene) -> CastShadows | None:
    """What the scene's ground shows of the sun, worked out once a scene; None where it has too
    little ground, or nothing that could cast a shadow on it.
    """

    def find() -> tuple[CastShadows | None]:  # a value that is None would be made again
        return (_find_shadows(scene),)

    return memo_of(scene).get(_MEMO, find)[0]


def share_shadows(scene: Scene) -> None:
    """Find them before a job's processes would."""
    memo_of(scene).put(_MEMO, (shadows_of(scene),), shared=True)


def _eyes(scene: Scene) -> np.ndarray:
    """Where the cameras stood, [P, 3]."""
    cameras = [c for frame in scene.frames for c in frame.cameras.values()]
    return np.array([c.centre.numpy() for c in cameras]).reshape(-1, 3)


def _find_shadows(scene: Scene) -> CastShadows | None:
    g = scene.background
    solid = (g.opacities > SOLID_OPACITY).numpy() & g.means.isfinite().all(1).numpy()
    grounds = _ground_splats(g, scene, solid)
    if not grounds:
        return None
    grid = _Grid.of(scene, g.means.double().numpy(), grounds[0])
    road = grid.surface(g, grounds[0], np.ones(len(g)))
    rows, columns = np.nonzero(road.known)
    if len(rows) < _MIN_CELLS:
        return None
    tops = grid.tops(g, solid & (g.scales.max(1).values < _LARGEST_M).numpy())
    asked = slice(None, None, 1 + len(rows) // _MAX_ASKED)
    rows, columns = rows[asked], columns[asked]
    horizons = grid.horizons(tops, road.height_m, rows, columns, _AZIMUTHS)
    own = road.log_luminance[rows, columns]
    own = own.clip(*np.quantile(own, [0.01, 0.99]))
    explained = _explained(horizons, own)
    if not np.isfinite(explained).any():
        return None
    explained = np.where(np.isfinite(explained), explained, 0.0)
    a, e = np.unravel_index(explained.argmax(), explained.shape)
    slope = math.tan(_ELEVATIONS[e])
    shaded = horizons[a] > slope
    log_rgb = np.log(np.maximum(road.linear[rows, columns], 1e-4))
    change = np.median(log_rgb[shaded], 0) - np.median(log_rgb[~shaded], 0)
    blue = _ramp(math.exp(change[2] - change[0]), *_BLUENESS)
    sunny, sunless = (g + blue * (b - g) for g, b in zip(_GREY, _BLUE, strict=True))
    by_direction = math.exp(np.median(own[shaded]) - np.median(own[~shaded]))
    certainty = 1 - _ramp(by_direction, sunny, sunless)
    dark = own <= _between(own)
    both = (shaded & dark, ~shaded & ~dark)
    if min(both[0].sum(), both[1].sum()) < _MIN_SHARE * len(dark):
        certainty, both = 0.0, (dark, ~dark)
    modes = [np.median(log_rgb[chosen], 0) if chosen.any() else log_rgb[0] for chosen in both]
    change = (modes[0] - modes[1]).clip(math.log(_DARKEST), 0)
    ratio = np.exp(certainty * change)

    albedos = np.ones(len(g))
    for ground in grounds[1:]:
        part = grid.surface(g, ground, albedos)
        there = np.nonzero(part.known)
        if len(there[0]) == 0:
            continue
        horizon = grid.horizons(tops, part.height_m, there[0], there[1], _AZIMUTHS[a : a + 1])[0]
        light = np.where(horizon > slope, float(np.exp(change) @ _LUMINANCE), 1.0)
        lit_road = float(np.exp(modes[1]) @ _LUMINANCE)
        albedos[ground] = np.median(np.exp(part.log_luminance[there]) / light) / lit_road
    whole = grid.surface(g, np.logical_or.reduce(grounds), albedos)
    dark_level, lit_level = (float(np.exp(mode) @ _LUMINANCE) for mode in modes)
    lit = np.exp(whole.log_luminance) - dark_level
    lit = (lit / max(lit_level - dark_level, 1e-3 * lit_level)).clip(0, 1)
    return CastShadows(
        certainty=certainty,
        ratio=_triple(ratio),
        lit_rgb=_triple(np.exp(modes[1] if certainty > 0 else np.median(log_rgb, 0))),
        lit_share=float(lit[whole.known].mean()),
        azimuth_deg=math.degrees(_AZIMUTHS[a]),
        elevation_deg=math.degrees(_ELEVATIONS[e]),
        explained=explained.astype(np.float32),
        lit=np.where(whole.known, lit, 0).astype(np.float32),
        known=whole.known.astype(np.float32),
        height_m=np.where(whole.known, whole.height_m, 0).astype(np.float32),
        corner_m=(float(grid.corner[0]), float(grid.corner[1])),
        cell_m=grid.cell_m,
    )


def _ground_splats(g: Gaussians, scene: Scene, solid: np.ndarray) -> list[np.ndarray]:
    """Which splats are ground, bool [N], a kind at a time; the road, or all that may be, first."""
    if g.semantic is not None:
        classes = g.semantic.numpy()
        found = [solid & (classes == int(semantic)) for semantic in _GROUNDS]
        if found[0].sum() >= _MIN_CELLS:
            return found
    low = solid & is_low_and_level(g, scene)
    return [low] if low.sum() >= _MIN_CELLS else []


class _Surface(NamedTuple):
    """Without what is narrow. linear [H, W, 3]. log_luminance, height_m [H, W]. known: bool."""

    linear: np.ndarray
    log_luminance: np.ndarray
    height_m: np.ndarray
    known: np.ndarray


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cells seen from above, the first axis x. places [N, 3]: of a part's splats."""

    corner: np.ndarray
    cell_m: float
    size: tuple[int, int]
    places: np.ndarray

    @staticmethod
    def of(scene: Scene, places: np.ndarray, ground: np.ndarray) -> _Grid:
        """Around the cameras, or around the middle of the ground."""
        eyes = _eyes(scene)[:, :2]
        eyes = eyes if len(eyes) else np.median(places[ground, :2], 0)[None]
        corner, ends = eyes.min(0) - _AROUND_M, eyes.max(0) + _AROUND_M
        cell_m = max(_CELL_M, float((ends - corner).max()) / _MAX_CELLS)
        height, width = (int(n) for n in np.ceil((ends - corner) / cell_m))
        return _Grid(corner, cell_m, (height, width), places)

    def cells_of(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flat numbers of the cells of chosen splats, and the numbers of those within the grid."""
        splats = np.flatnonzero(chosen)
        index = np.floor((self.places[splats, :2] - self.corner) / self.cell_m)
        inside = ((index >= 0) & (index < self.size)).all(1)
        index = index[inside].astype(np.int64)
        return index[:, 0] * self.size[1] + index[:, 1], splats[inside]

    def surface(self, g: Gaussians, chosen: np.ndarray, albedos: np.ndarray) -> _Surface:
        """What the chosen splats show over their albedos [N]."""
        where, splats = self.cells_of(chosen)
        scales = g.scales.double().numpy()[splats]
        areas = np.minimum(scales.prod(1) / np.maximum(scales.min(1), 1e-12), self.cell_m**2)
        rgb = 0.5 + SH_C0 * g.sh[:, 0].double().numpy()[splats]
        linear = linear_from_display(np.clip(np.nan_to_num(rgb), 0, 1)) / albedos[splats, None]

        def blurred(values: np.ndarray) -> np.ndarray:
            sums = np.bincount(where, areas * values, math.prod(self.size)).reshape(self.size)
            return cv2.GaussianBlur(sums.astype(np.float32), (0, 0), _SPREAD_CELLS)

        weight = blurred(np.ones(len(splats)))
        known = weight > 0.02 * self.cell_m**2
        safe = np.where(known, weight, 1)
        means = [
            cv2.medianBlur(
                np.where(known, blurred(own) / safe, 0).astype(np.float32), _MEDIAN_CELLS
            )
            for own in (*linear.T, self.places[splats, 2])
        ]
        known = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rgb = np.stack(means[:3], -1)
        return _Surface(rgb, np.log(np.maximum(rgb @ _LUMINANCE, 1e-4)), means[3], known)

    def tops(self, g: Gaussians, chosen: np.ndarray) -> np.ndarray:
        """Height of the highest of the chosen splats in each cell, [H, W]; -inf without any."""
        where, splats = self.cells_of(chosen)
        out = np.full(math.prod(self.size), -np.inf)
        np.maximum.at(out, where, self.places[splats, 2])
        return out.reshape(self.size)

    def horizons(
        self, tops: np.ndarray, ground_m: np.ndarray, rows: np.ndarray, columns: np.ndarray,
        azimuths: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Slope from K cells of ground to the highest thing in each direction, [A, K]."""
        height, width = self.size
        z = ground_m[rows, columns] + _OVER_M
        out = np.full((len(azimuths), len(rows)), -np.inf)
        for own, azimuth in zip(out, azimuths, strict=True):
            distance_m = _FROM_M
            while distance_m < _REACH_M:
                i = rows + round(math.cos(azimuth) * distance_m / self.cell_m)
                j = columns + round(math.sin(azimuth) * distance_m / self.cell_m)
                inside = (i >= 0) & (i < height) & (j >= 0) & (j < width)
                over = tops[i.clip(0, height - 1), j.clip(0, width - 1)] - z
                over = np.where(inside & (over < _HIGHEST_M), over, -np.inf)
                np.maximum(own, over / distance_m, out=own)
                distance_m = max(distance_m + self.cell_m, distance_m * _STEP)
        return out


def _explained(horizons: np.ndarray, log_luminance: np.ndarray) -> np.ndarray:
    """Of the variance of K values, by the shadows of each direction, [A, E]; negative where shadows
    are brighter, -inf where there are too few.
    """
    out = np.full((len(_AZIMUTHS), len(_ELEVATIONS)), -np.inf)
    total, variance = log_luminance.sum(), max(float(log_luminance.var()), 1e-6)
    count = len(log_luminance)
    for row, own in zip(out, horizons, strict=True):
        for e, slope in enumerate(np.tan(_ELEVATIONS)):
            shaded = own > slope
            number = int(shaded.sum())
            share = number / count
            if _MIN_SHARE <= share <= 1 - _MIN_SHARE:
                dark = log_luminance[shaded].sum()
                apart = (total - dark) / (count - number) - dark / number
                row[e] = share * (1 - share) * apart * abs(apart) / variance
    return out


def _ramp(value: float, low: float, high: float) -> float:
    """0 below low, 1 above high, straight between."""
    return min(1.0, max(0.0, (value - low) / (high - low)))


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _between(values: np.ndarray) -> float:
    """Otsu's threshold between two modes."""
    low, high = float(values.min()), float(values.max())
    scaled = (255 * (values - low) / max(high - low, 1e-6)).astype(np.uint8)
    threshold, _ = cv2.threshold(scaled, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    return low + (threshold + 0.5) / 255 * (high - low)


# ---- Shadows in smog -----------------------------------------------------------------------------
# Of the light on lit ground, q comes from the sky and 1 - q from the sun. Smog lets T of the sun's
# through; the rest arrives scattered, everywhere alike, so that the ground's mean stays: with a
# share s of the sun seen from a place, and f of it in the mean,
#
#     before  E = q + (1 - q) s          after  E' = q + (1 - q) (T s + (1 - T) f)
#
# which multiplies linear colours by E' / E, and encoded ones by its 1/2.2th power.

SMOG_DEEP_M = 200.0  # uniform smog has no top: fog lies 50 to 300 m deep
_LOWEST_SUN = math.sin(math.radians(10.0))  # whatever its shadows look like
NUM_FADES = 32  # from shaded to lit
_ENCODING = 2.2
_GROUND_CLASSES = (*_GROUNDS, SemanticClass.LANE_MARKING)


@dataclass(frozen=True, eq=False)
class FadedShadows:
    """The ground of a scene under a sun that smog has dimmed. transmittance: T, 0 to 1. rows int16
    [N]: of the background's splats among `maps` [NUM_FADES + 1, 3, 4]; the first changes nothing.
    """

    shadows: CastShadows
    transmittance: float
    rows: Int16[Tensor, "N"]
    maps: Float[Tensor, "K 3 4"]

    def on(self, part: PosedGaussians) -> PosedGaussians:
        """The background with its shadows faded, before any maps that it has."""
        if part.color_maps is None:
            return replace(part, color_maps=self.maps, color_rows=self.rows)
        outer, rows = part.color_maps.to(self.maps), part.map_rows
        maps = outer[:, None, :, :3] @ self.maps[None, :, :, :3]
        maps = torch.cat([maps, outer[:, None, :, 3:].expand(-1, len(self.maps), -1, -1)], -1)
        if rows is None:
            return replace(part, color_maps=maps.flatten(0, 1), color_rows=self.rows)
        known = torch.where((rows >= 0) & (rows < len(outer)), rows, 0)
        return replace(
            part,
            color_maps=maps.flatten(0, 1),
            color_rows=(known * len(self.maps) + self.rows).to(torch.int16),
        )

    def gains(
        self, points_m: Float32[np.ndarray, "H W 3"]
    ) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "K 3"]]:
        """Of points in the world: the share of the sun that they see, where they are no ground the
        mean, which changes nothing; and factors of encoded colours by steps of that share.
        """
        lit = _lit_near(self.shadows, *np.moveaxis(points_m, -1, 0))
        factors = _factors(self.shadows, self.transmittance, np.linspace(0, 1, 256))
        factors[round(255 * self.shadows.lit_share)] = 1
        return lit.astype(np.float32), factors


def faded_shadows(scene: Scene, transmittance: float) -> FadedShadows | None:
    """The scene's shadows under a sun of which this arrives; None where it shows none."""
    shadows = shadows_of(scene)
    if shadows is None or shadows.certainty == 0 or transmittance >= 1:
        return None

    def place() -> Tensor:
        g = scene.background
        lit = _lit_near(shadows, *g.means.double().numpy().T)
        rows = 1 + np.rint(lit * (NUM_FADES - 1))
        off = np.abs(lit - shadows.lit_share) < 1e-6
        if g.semantic is not None:
            off |= ~np.isin(g.semantic.numpy(), [int(own) for own in _GROUND_CLASSES])
        return torch.from_numpy(np.where(off, 0, rows).astype(np.int16))

    def scale() -> Tensor:
        factors = _factors(shadows, transmittance, np.linspace(0, 1, NUM_FADES))
        maps = torch.zeros(NUM_FADES + 1, 3, 4)
        maps[:, :, :3] = torch.diag_embed(torch.from_numpy(np.vstack([np.ones(3), factors])))
        return maps

    memo = memo_of(scene)
    rows = memo.get(("faded shadows",), place)
    return FadedShadows(
        shadows, transmittance, rows, memo.get(("faded shadows", transmittance), scale)
    )


def sun_transmittance(fog: Fog, shadows: CastShadows, ground_z_m: float) -> float:
    """T of the sun's light, down to the ground."""
    climb = max(math.sin(math.radians(shadows.elevation_deg)), _LOWEST_SUN)
    if fog.scale_height_m is None:
        return math.exp(-fog.sigma_per_m * SMOG_DEEP_M / climb)
    return math.exp(-vertical_optical_depth(fog, ground_z_m) / climb)


def _lit_near(
    shadows: CastShadows, x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray
) -> np.ndarray:
    """Share of the sun that places see, drawn to the mean off the ground."""
    lit, known, height_m = shadows.at(x_m, y_m)
    over = np.abs(z_m - height_m / np.maximum(known, 1e-6)) / ON_GROUND_M
    weight = known * (2 - 2 * over).clip(0, 1)
    return shadows.lit_share + weight * (lit / np.maximum(known, 1e-6) - shadows.lit_share)


def _factors(shadows: CastShadows, transmittance: float, lit: np.ndarray) -> np.ndarray:
    """(E' / E)^(1/2.2) of shares of the sun [K], float32 [K, 3]."""
    q = np.array(shadows.ratio)
    seen, mean = lit[:, None], shadows.lit_share
    after = q + (1 - q) * (transmittance * seen + (1 - transmittance) * mean)
    return ((after / (q + (1 - q) * seen)) ** (1 / _ENCODING)).astype(np.float32)
