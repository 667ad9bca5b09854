"""How deep snow lies on each cell: the formulas, and their definition in numpy.

h = depth * drift(x, y) * shoulder(edge), less in wheel tracks, and 0 between patches and by water.

- drift = exp(noise), whose median is 1, times what the wind piles up before obstacles.
- shoulder: at an open edge the layer is rounded like a pillow, a quarter of a circle.
- patches: thin snow leaves bare what the noise holds lowest; a share of coverage
  (1 - exp(-depth / 4 mm)) is covered. What fell lies on that share, so it is never thinner than
  a few millimetres there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from augment.snow.cells import EDGE_CAP_M, SnowCells
from augment.snow.noise import Octaves, field_of, octaves_of, threshold_of
from recipes.snow import Snow

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
    towards (wind_x, wind_y). pressed: share that wheels take. floor_z_m: lowest bed with snow.
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
    snow: Snow,
    rng: np.random.Generator,
    *,
    on_ground: bool,
    water_level_z_m: float | None = None,
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
    drifts = _joined(wind, octaves_of(relief, rng))
    patches = octaves_of(_PATCHES, rng)
    threshold = threshold_of(patches, share_covered(snow))
    pressed = snow.tracks == "always" or (snow.tracks == "auto" and snow.depth_m <= AUTO_TRACKS_M)
    numbers = Numbers(
        depth_m=depth_m,
        threshold=max(min(threshold, 1e9), -1e9),
        rim=RIM_M * RIM_SLOPE,
        radius_m=min(max(depth_m, 1e-3), EDGE_CAP_M),
        drift=drift if on_ground else 0.0,
        wind_x=math.cos(along),
        wind_y=math.sin(along),
        pressed=PRESSED if pressed and on_ground else 0.0,
        floor_z_m=-1e30
        if water_level_z_m is None or not on_ground
        else water_level_z_m + WATER_MARGIN_M,
    )
    return Profile(numbers, drifts, patches, octaves_of(_MOTTLE, rng))


def _joined(first: Octaves, second: Octaves) -> Octaves:
    return Octaves(
        *(
            np.concatenate([getattr(first, name), getattr(second, name)])
            for name in ("turns", "amplitudes", "lengths_m", "seeds")
        )
    )


def heights_of(cells: SnowCells, profile: Profile) -> np.ndarray:
    """Depth of the snow on each cell, metres, float64 [C]; below BARE_M it is 0. The definition of
    what `augment.snow.noise_kernels.lay` computes.
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
