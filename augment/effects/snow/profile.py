"""How deep snow lies on each cell: the formulas, and their definition in numpy.

h = depth * drift(x, y) * shoulder(edge), less in wheel tracks, and 0 between patches and by water.

- drift = exp(noise), whose median is 1, times what the wind piles up before obstacles.
- shoulder: at an open edge the layer is rounded like a pillow, a quarter of a circle.
- patches: thin snow leaves bare what the noise holds lowest; a share of coverage
  (1 - exp(-depth / 4 mm)) is covered. What fell lies on that share, so it is never thinner than
  a few millimetres there.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from augment.effects.snow.cells import EDGE_CAP_M, SnowCells
from recipes.snow import Snow

# ---- Noise over the plane that snow's depth and patches follow: the numpy definition -------------
# Gradient noise (Perlin 1985) with the fade curve of Perlin 2002, its gradients drawn by a hash of
# the lattice's integers: a function of the place and the seed alone, of median 0. A field is a sum
# of octaves, each with a lattice and a hash of its own.

# Standard deviation of the noise over the plane where the gradients' components are uniform in
# [-1, 1]: the mean over a square of 4 w^2 (x^2 + y^2) / 3, w the blend of a corner at (0, 0).
DEVIATION = 0.17612713
MIX_A, MIX_B = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB  # splitmix64 (Steele et al. 2014)
STEP_X, STEP_Y = 0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F  # odd, far apart in all their bits
_SAMPLES = 1 << 17  # points that the shares of a field's values are measured at
_GOLDEN = (0.7548776662466927, 0.5698402909980532)  # plane-filling sequence (Roberts 2018)
_SPREAD_M = 5000.0  # side of the square that they fill


@dataclass(frozen=True, eq=False)
class Octaves:
    """K octaves of noise.

    turns [K, 2, 2]: lattice coordinates = turns @ (x, y) in metres. amplitudes [K]: standard
    deviation of each. lengths_m [K]: what a lattice's step measures; cells larger than half of it
    cannot show the octave, see `field_of`. seeds [K]: uint64.
    """

    turns: np.ndarray
    amplitudes: np.ndarray
    lengths_m: np.ndarray
    seeds: np.ndarray

    def __len__(self) -> int:
        return len(self.amplitudes)


def octaves_of(
    rows: Iterable[tuple[float, float]],
    rng: np.random.Generator,
    *,
    along: float = 0.0,
    stretch: float = 1.0,
) -> Octaves:
    """Octaves of the given (lattice step in metres, standard deviation) pairs.

    stretch >= 1: what the noise shows is that much shorter in the direction `along` (radians from
    +x) and longer across it. 1: every octave is turned by an angle of its own instead, so that
    their lattices do not line up.
    """
    pairs = np.array(list(rows), np.float64).reshape(-1, 2)
    count = len(pairs)
    angles = np.full(count, along) if stretch != 1 else rng.uniform(0, 2 * math.pi, count)
    cos, sin = np.cos(angles), np.sin(angles)
    turns = np.stack([cos, sin, -sin, cos], -1).reshape(count, 2, 2) / pairs[:, :1, None]
    turns *= np.array([stretch, 1 / stretch])[:, None]
    seeds = rng.integers(0, 2**64, count, np.uint64)
    return Octaves(np.ascontiguousarray(turns), pairs[:, 1].copy(), pairs[:, 0].copy(), seeds)


def mix(bits: np.ndarray) -> np.ndarray:
    """uint64 with every bit of the result hanging on every bit of the input (splitmix64)."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(MIX_A)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(MIX_B)
    return bits ^ (bits >> np.uint64(31))


def gradient_noise(u: np.ndarray, v: np.ndarray, seed: np.uint64) -> np.ndarray:
    """Noise of unit standard deviation at lattice coordinates u, v [N], float64."""
    column, row = np.floor(u), np.floor(v)
    x, y = u - column, v - row
    fade_x, fade_y = (t * t * t * (t * (t * 6 - 15) + 10) for t in (x, y))
    corners = []
    for j in (0, 1):
        for i in (0, 1):
            across = (column.astype(np.int64) + i).astype(np.uint64) * np.uint64(STEP_X)
            down = (row.astype(np.int64) + j).astype(np.uint64) * np.uint64(STEP_Y)
            bits = mix((across + down) ^ seed)
            gx = (bits >> np.uint64(32)).astype(np.float64) * 2.0**-31 - 1
            gy = (bits & np.uint64(0xFFFFFFFF)).astype(np.float64) * 2.0**-31 - 1
            corners.append(gx * (x - i) + gy * (y - j))
    near = corners[0] + fade_x * (corners[1] - corners[0])
    far = corners[2] + fade_x * (corners[3] - corners[2])
    return (near + fade_y * (far - near)) / DEVIATION


def field_of(
    octaves: Octaves, x_m: np.ndarray, y_m: np.ndarray, sizes_m: np.ndarray | float = 0.0
) -> np.ndarray:
    """Sum of the octaves at points [N], float64.

    sizes_m: cells that the points stand for. An octave fades between cells of a quarter of its
    lattice's step and of half of it, which would show no more than its aliases.
    """
    total = np.zeros(np.shape(x_m), np.float64)
    for k in range(len(octaves)):
        (a, b), (c, d) = octaves.turns[k]
        shown = np.clip(2 - 4 * np.asarray(sizes_m) / octaves.lengths_m[k], 0, 1)
        noise = gradient_noise(a * x_m + b * y_m, c * x_m + d * y_m, octaves.seeds[k])
        total += octaves.amplitudes[k] * shown * noise
    return total


def threshold_of(octaves: Octaves, share: float) -> float:
    """The value that the field exceeds on `share` of the plane; infinite where that is 0 or 1.

    It hangs on the octaves' steps and amplitudes alone, not on their seeds.
    """
    if share <= 0:
        return math.inf
    if share >= 1:
        return -math.inf
    values = _ordered_values(tuple(octaves.lengths_m), tuple(octaves.amplitudes))
    return float(values[min(int((1 - share) * len(values)), len(values) - 1)])


@functools.lru_cache(maxsize=8)
def _ordered_values(lengths_m: tuple[float, ...], amplitudes: tuple[float, ...]) -> np.ndarray:
    """A field's values at points spread evenly over much of the plane, in rising order."""
    octaves = octaves_of(zip(lengths_m, amplitudes, strict=True), np.random.default_rng(0))
    x_m, y_m = (np.arange(1, _SAMPLES + 1) * g % 1 * _SPREAD_M for g in _GOLDEN)
    return np.sort(field_of(octaves, x_m, y_m))


# ---- The depth -----------------------------------------------------------------------------------

BARE_M = 0.002  # less snow than this is none
COVERING_M = 0.004  # depth that covers all but 1/e of the surface
FULL = 0.9999  # shares above this are the whole
FILM_M = 0.004  # what wheels leave at least
PRESSED = 0.8  # share of the depth that wheels take
CRUMBLED = 0.8  # of the mottling noise, by which a track's sides are uneven
AUTO_TRACKS_M = 0.3  # deepest snow that shows tracks by itself
WATER_MARGIN_M, WATER_RIM_M = 0.005, 0.02  # bare above the water, and thinner above that
SHELTER = 0.4  # what the foot of an obstacle adds to the noise of the patches, which it keeps
PILED, SCOURED = 0.8, 0.4  # by wind that blows at an obstacle, and off one
STEEPEST = 1.4  # of the logarithm of the drift: within four times the depth, or a quarter of it

# Octaves: (lattice step in metres, standard deviation). Of drifts, with wind.drift 0 and 1:
_CALM = ((6.0, 0.015), (2.6, 0.02), (1.1, 0.02))
_WINDY = ((6.0, 0.25), (2.6, 0.25), (1.1, 0.14))
_CALM_RISE, _WINDY_RISE = 0.008, 0.035  # their most height in metres per metre of lattice step
# Of the surface's own relief, in metres of height and at most this share of the depth:
_RELIEF_M = ((0.52, 0.0045), (0.21, 0.0018))
_RELIEF_SHARE = 0.08
# Of patches, and of what mottles the snow's colour:
_PATCHES = ((2.6, 1.0), (1.1, 0.55), (0.45, 0.3), (0.19, 0.16))
_MOTTLE = ((0.9, 0.75), (0.31, 0.65))
RIM_M = 0.2  # over which patches thin out
RIM_SLOPE = 1.8  # rise of the patches' noise over a metre, at a patch's rim: the usual one


class Numbers(NamedTuple):
    """What the depth is made from besides the cells and the noise; a tuple, as kernels take it.

    depth_m: where snow lies. threshold: of the patches' noise, above which snow lies. rim: rise of
    that noise over a patch's rim. radius_m: of the shoulder. drift: of the wind, which blows
    towards (wind_x, wind_y). pressed: share that wheels take. floor_z_m: lowest support with snow.
    """

    depth_m: float
    threshold: float
    rim: float
    radius_m: float
    drift: float
    wind_x: float
    wind_y: float
    pressed: float
    floor_z_m: float


@dataclass(frozen=True, eq=False)
class Profile:
    """All that the snow's depth on a part's cells is made from, besides the cells."""

    numbers: Numbers
    drifts: Octaves
    patches: Octaves
    mottle: Octaves


def share_covered(snow: Snow) -> float:
    """The share of open, level surface that carries snow."""
    share = snow.coverage * -math.expm1(-snow.depth_m / COVERING_M)
    return 1.0 if share > FULL else share


def profile_of(
    snow: Snow, rng: np.random.Generator, *, on_ground: bool, water_level_z_m: float | None = None
) -> Profile:
    """The profile of the recipe's snow. on_ground: of what does not move, so that wind, tracks and
    water count; what moves has met many winds.
    """
    # What fell lies on the covered share; the less fell, the nearer this comes to COVERING_M.
    settled = -math.expm1(-snow.depth_m / COVERING_M)
    depth_m = snow.depth_m / settled if settled > 0 else COVERING_M
    drift = snow.wind.drift if on_ground else snow.wind.drift / 2
    along = math.radians(snow.wind.direction_deg) if on_ground else 0.0
    rise = _CALM_RISE + drift * (_WINDY_RISE - _CALM_RISE)
    rows = [
        (step, min(calm + drift * (windy - calm), rise * step / depth_m))
        for (step, calm), (_, windy) in zip(_CALM, _WINDY, strict=True)
    ]
    relief = [
        (step, (0.4 + 0.6 * snow.grain) * min(height / depth_m, _RELIEF_SHARE))
        for step, height in _RELIEF_M
    ]
    wind = octaves_of(rows, rng, along=along, stretch=1 + 0.8 * drift)
    pairs = zip(vars(wind).values(), vars(octaves_of(relief, rng)).values(), strict=True)
    drifts = Octaves(*map(np.concatenate, pairs))
    patches = octaves_of(_PATCHES, rng)
    threshold = threshold_of(patches, share_covered(snow))
    pressed = snow.tracks == "always" or (snow.tracks == "auto" and snow.depth_m <= AUTO_TRACKS_M)
    floor_z_m = -1e30
    if water_level_z_m is not None and on_ground:
        floor_z_m = water_level_z_m + WATER_MARGIN_M
    numbers = Numbers(
        depth_m=depth_m,
        threshold=max(min(threshold, 1e9), -1e9),
        rim=RIM_M * RIM_SLOPE,
        radius_m=min(max(depth_m, 1e-3), EDGE_CAP_M),
        drift=drift if on_ground else 0.0,
        wind_x=math.cos(along),
        wind_y=math.sin(along),
        pressed=PRESSED if pressed and on_ground else 0.0,
        floor_z_m=floor_z_m,
    )
    return Profile(numbers, drifts, patches, octaves_of(_MOTTLE, rng))


def heights_of(cells: SnowCells, profile: Profile) -> np.ndarray:
    """Depth of the snow on each cell, metres, float64 [C]; below BARE_M it is 0. The definition of
    what `augment.effects.snow.kernels.lay` computes.
    """
    n = profile.numbers
    x_m, y_m, z_m = (cells.centers_m[:, i].numpy().astype(np.float64) for i in range(3))
    sizes_m, edge_m, tracks, banks = (
        t.numpy().astype(np.float64)
        for t in (cells.sizes_m, cells.edge_m, cells.tracks, cells.banks)
    )
    at_wind = banks[:, 0] * n.wind_x + banks[:, 1] * n.wind_y
    piled = 1 + n.drift * np.where(at_wind > 0, PILED, SCOURED) * at_wind
    log_drift = np.clip(field_of(profile.drifts, x_m, y_m, sizes_m), -STEEPEST, STEEPEST)
    full = n.depth_m * np.exp(log_drift) * piled * _pillow(edge_m / n.radius_m)

    shelter = SHELTER * np.hypot(banks[:, 0], banks[:, 1])
    above = field_of(profile.patches, x_m, y_m) + shelter - n.threshold
    h = BARE_M + np.maximum(full - BARE_M, 0) * np.clip(above / n.rim, 0, 1)

    tracks = tracks + CRUMBLED * mottle_of(cells, profile) * tracks * (1 - tracks)
    h = np.maximum(h * (1 - n.pressed * np.clip(tracks, 0, 1)), np.minimum(h, FILM_M))
    room = z_m - n.floor_z_m
    h = BARE_M + (h - BARE_M) * np.clip(room / WATER_RIM_M, 0, 1)
    return np.where((above > 0) & (room > 0), h, 0.0)


def _pillow(t: np.ndarray) -> np.ndarray:
    """A quarter of a circle from (0, 0) up to (1, 1), and 1 from there on."""
    t = np.clip(t, 0, 1)
    return np.sqrt(t * (2 - t))


def mottle_of(cells: SnowCells, profile: Profile) -> np.ndarray:
    """Noise of about unit deviation that the snow's colour follows, float64 [C]."""
    x_m, y_m = (cells.centers_m[:, i].numpy().astype(np.float64) for i in range(2))
    return field_of(profile.mottle, x_m, y_m, cells.sizes_m.numpy().astype(np.float64))
