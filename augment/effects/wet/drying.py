"""A road that gets wet and dries: how dark each place is, and how much of it mirrors.

Input: the film of water on the whole road (`RoadFilm`, from `recipes.rain.RoadWater`), and a map of
the order in which places dry (`DryingMap`), made once a scene. With q the place's rank in that
order, 0 for the first to dry, it is dry once the road's film, over the largest since the road was
dry, falls to

    f_dry = FIRST_DRY_SHARE (1 - q)

and in between its film is peak (f - f_dry) / (1 - f_dry). So a film as large as its peak is even,
and a falling one is a sweep of a threshold over a fixed field: dark islands that shrink. Ground
darkens with a film of some hundredths of a millimetre; it mirrors only where water covers the
stones. Ranks follow from wheel tracks (first), heights (crowns before gutters and kerbs), hollows
(last) and noise of 0.6 to 9 m. Their weights, as the films at which ground darkens and mirrors, are
assumed.

The first drops are stains: a table holds the share of ground that has been hit when a place is hit.
Where a pixel is larger than a stain it shows the mean over its size.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.gradient_noise import draw_octaves
from augment.effects.wet import film_kernels
from augment.effects.wet.darkening import INNER_REFLECTANCE, OUTER_REFLECTANCE
from augment.effects.wet.film_kernels import (
    DARK_FILM_MM,
    EVEN_FILM_MM,
    EXPOSURE,
    FIRST_DRY_SHARE,
    HEIGHT,
    MATT_FILM_MM,
    NUM_STAIN_LEVELS,
    PUDDLE_ORDER,
    STAIN_SIDE,
    STAIN_TEXEL_M,
    WHEEL_TRACK,
)
from augment.effects.wet.ground_map import GROUND_CELL_M, WetGround, blur_map, noise_on_map
from augment.memo import memo_of
from augment.rng import rng_for
from recipes.rain import Rain
from recipes.road_water import MAX_FILM_MM, STAIN_RADIUS_M, TRACK_FILM_SHARE

# Octaves of the noise in the order of drying: (lattice step in metres, standard deviation).
_OCTAVES = ((9.0, 0.7), (3.6, 0.55), (1.5, 0.3), (0.6, 0.14))
# Distance over which a place is compared with its surroundings, metres.
_SURROUNDINGS_M = 2.5
# Weight of a centimetre below the surroundings, in standard deviations of the noise.
_WEIGHT_PER_CM = 0.6
# Largest height that counts, cm.
_MAX_HEIGHT_CM = 4.0
# Weight of a wheel track.
_TRACK_WEIGHT = 1.3
# Weight of the order in which puddles form.
_HOLLOW_WEIGHT = 0.4
# Range of that order that counts.
_HOLLOW_RANGE = (-1.0, 2.0)
# Number of ranks that are told apart.
_NUM_RANKS = 4096
# Share of ground that is hit when the last stain of the table falls.
_LAST_STAINED_SHARE = 0.985
# Radii of stains, over the mean one, in equal numbers.
_STAIN_SIZES = (0.6, 0.8, 1.0, 1.15, 1.3)


@dataclass(frozen=True)
class RoadFilm:
    """Water on the road at one moment."""

    film_mm: float
    """Film of the road, mm."""
    peak_mm: float
    """Largest film since the road was dry, mm; at least `film_mm`."""
    film_wetness: float
    """Wetness under a full film, 0 to 1."""
    puddle_wetness: float
    """Wetness under puddles, 0 to 1; at least `film_wetness`."""
    tracks: float
    """How far wheels have pushed the water out of their tracks, 0 to 1."""
    spots: float
    """Share of the ground that drops have stained, 0 to 1."""

    @property
    def film_share(self) -> float:
        """Return the film over its peak, 0 to 1."""
        return self.film_mm / self.peak_mm if self.peak_mm > 0 else 0.0

    @property
    def hit_share(self) -> float:
        """Return how far a film has reached all places; before that, there are stains alone."""
        t = min(self.peak_mm / EVEN_FILM_MM, 1.0)
        return t * t * (3 - 2 * t)

    @property
    def track_loss(self) -> float:
        """Return the share of the film that tracks have lost, 0 to 1."""
        return self.tracks * (1 - TRACK_FILM_SHARE)


def road_film(rain: Rain) -> RoadFilm | None:
    """Return the water on the road of a recipe's rain; None if it has no history."""
    road = rain.road
    if road is None:
        return None
    return RoadFilm(
        film_mm=road.film_mm,
        peak_mm=max(road.film_mm, road.peak_film_mm),
        film_wetness=rain.film_wetness,
        puddle_wetness=rain.puddle_wetness,
        tracks=road.tracks,
        spots=road.spots,
    )


# ---- The order of drying -------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DryingMap:
    """Map of the order in which open ground dries, over the cells of a `WetGround`.

    `channels`: DRYING_RANK, 0 (dries first) to 1 (last), even over open ground; PUDDLE_RANK and
    TRACK, the map's PUDDLE_ORDER and WHEEL_TRACK.
    """

    channels: Float[Tensor, "Y X C"]


def drying_map(ground: WetGround, seed: int) -> DryingMap:
    """Return the order in which ground dries; it is found once for a scene.

    Args:
        ground: map of the ground.
        seed: seed of the noise.
    """
    return memo_of(ground).get(("drying", seed), lambda: _make_drying_map(ground, seed))


def _make_drying_map(ground: WetGround, seed: int) -> DryingMap:
    """Make the map."""
    channels = ground.channels.numpy()
    track = channels[..., WHEEL_TRACK]
    order = channels[..., PUDDLE_ORDER]
    low = np.round(np.array([ground.left_m, ground.bottom_m]) / GROUND_CELL_M)
    rng = rng_for(seed=seed, scene="", effect="drying")
    noise = noise_on_map(draw_octaves(_OCTAVES, rng), low, track.shape)
    height_m = channels[..., HEIGHT].astype(np.float64)
    level_m = blur_map(height_m - np.median(height_m), _SURROUNDINGS_M) + np.median(height_m)
    depth_cm = np.clip(100 * (level_m - height_m), -_MAX_HEIGHT_CM, _MAX_HEIGHT_CM)
    score = (
        noise
        + _WEIGHT_PER_CM * depth_cm
        - _TRACK_WEIGHT * track
        + _HOLLOW_WEIGHT * np.clip(order, *_HOLLOW_RANGE)
    )
    open_scores = np.sort(score[channels[..., EXPOSURE] > 0.5])
    rank = np.zeros(score.shape)
    if len(open_scores) > 1:
        shares = np.linspace(0, 1, min(len(open_scores), _NUM_RANKS))
        quantiles = np.quantile(open_scores, shares)
        rank = np.interp(score, quantiles, shares)
    return DryingMap(
        torch.from_numpy(np.ascontiguousarray(np.stack([rank, order, track], -1), np.float32))
    )


# ---- Stains of the first drops -------------------------------------------------------------------


@functools.cache
def stain_table() -> np.ndarray:
    """Share of ground that is hit when a texel is hit, float32 [STAIN_SIDE, STAIN_SIDE].

    Shares are even between 0 and 1, so that a share s of the texels is below s. The sides meet.
    """
    rng = np.random.Generator(np.random.PCG64(2))
    radius = STAIN_RADIUS_M / STAIN_TEXEL_M
    sizes = np.array(_STAIN_SIZES)
    mean_area = math.pi * radius**2 * float((sizes**2).mean())
    count = round(-math.log(1 - _LAST_STAINED_SHARE) * STAIN_SIDE**2 / mean_area)
    centres = rng.random((count, 2)) * STAIN_SIDE
    radii = radius * sizes[rng.integers(0, len(sizes), count)]
    reach = math.ceil(radii.max()) + 1
    steps = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    hit_numbers = np.full(STAIN_SIDE**2, count, np.int64)
    corner = np.floor(centres).astype(np.int64)
    for dx, dy in offsets.tolist():
        x = corner[:, 0] + dx
        y = corner[:, 1] + dy
        distance2 = (x + 0.5 - centres[:, 0]) ** 2 + (y + 0.5 - centres[:, 1]) ** 2
        drops = np.flatnonzero(distance2 < radii**2)
        texels = (y[drops] % STAIN_SIDE) * STAIN_SIDE + x[drops] % STAIN_SIDE
        np.minimum.at(hit_numbers, texels, drops)
    order = np.argsort(hit_numbers + rng.random(len(hit_numbers)), kind="stable")
    shares = np.empty(len(order), np.float32)
    shares[order] = (np.arange(len(order)) + 0.5) / len(order)
    return shares.reshape(STAIN_SIDE, STAIN_SIDE)


@functools.lru_cache(4)
def stain_levels(share: float) -> np.ndarray:
    """Share of stained ground in the texels of all levels, flat float32, for a share in all.

    Level k has texels of 2^k STAIN_TEXEL_M, and STAIN_SIDE / 2^k of them on a side.
    """
    if not 0 < share < 1:
        return np.zeros(1, np.float32)
    level = (stain_table() < share).astype(np.float32)
    levels: list[np.ndarray] = [level.ravel()]
    for _ in range(1, NUM_STAIN_LEVELS):
        level = cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        levels.append(level.ravel())
    return np.concatenate(levels)


def stained_share(
    share: float, x_m: Float[Tensor, "*B"], y_m: Float[Tensor, "*B"], size_m: Float[Tensor, "*B"]
) -> Float[Tensor, "*B"]:
    """Return the share of stained ground about points.

    Args:
        share: share of the whole ground.
        x_m: world.
        y_m: world.
        size_m: size of the area about each point.
    """
    if not 0 < share < 1:
        return torch.full_like(size_m, share)
    flat = torch.from_numpy(stain_levels(share)).to(size_m.device)
    level = torch.log2(size_m / STAIN_TEXEL_M).clamp_min(0)
    last = NUM_STAIN_LEVELS - 1
    lower = level.floor().clamp_max(last)
    mean = torch.full_like(size_m, share)
    below = torch.where(lower < last, _stain_at(flat, lower, x_m, y_m), mean)
    above = torch.where(lower + 1 < last, _stain_at(flat, lower + 1, x_m, y_m), mean)
    return torch.where(level < last, below + (above - below) * (level - lower), mean)


def _stain_at(flat: Tensor, level: Tensor, x_m: Tensor, y_m: Tensor) -> Tensor:
    """Return a level of the table between its texels; level: of each point."""
    sides = STAIN_SIDE >> torch.arange(NUM_STAIN_LEVELS)
    starts = torch.cat([torch.zeros(1, dtype=torch.int64), (sides * sides).cumsum(0)[:-1]])
    k = level.long().clamp_max(NUM_STAIN_LEVELS - 1)
    side = sides.to(flat.device)[k]
    start = starts.to(flat.device)[k]
    scale = 1 / (STAIN_TEXEL_M * 2.0 ** k.double())
    u = x_m.double() * scale - 0.5
    v = y_m.double() * scale - 0.5
    left = u.floor().long() % side
    low = start + v.floor().long() % side * side
    right = (left + 1) % side
    high = start + (v.floor().long() + 1) % side * side
    u = (u - u.floor()).float()
    v = (v - v.floor()).float()
    below = flat[low + left] * (1 - u) + flat[low + right] * u
    above = flat[high + left] * (1 - u) + flat[high + right] * u
    return below * (1 - v) + above * v


# ---- Water at a place ----------------------------------------------------------------------------


def local_water(
    film: RoadFilm,
    rank: Float[Tensor, "*B"],
    track: Float[Tensor, "*B"],
    spots: Float[Tensor, "*B"],
    puddle: Float[Tensor, "*B"],
) -> tuple[Tensor, Tensor]:
    """Return the wetness of places, and the share of a full film's mirror image that they have.

    Args:
        film: water on the whole road.
        rank: place in the order of drying, 0 first to 1 last.
        track: 0 to 1, how much of a wheel track a place is.
        spots: share of the place that drops have stained.
        puddle: share of the place that is under standing water.
    """
    dry_share = FIRST_DRY_SHARE * (1 - rank.clamp(0, 1))
    film_mm = film.peak_mm * (film.film_share - dry_share).clamp_min(0) / (1 - dry_share)
    film_mm = film_mm * (1 - film.track_loss * track)
    dark = torch.maximum(film.hit_share * _smoothstep(film_mm / DARK_FILM_MM), spots)
    wetness = torch.maximum(film.film_wetness * dark, film.puddle_wetness * puddle)
    if film.puddle_wetness == 0:
        return wetness, torch.zeros_like(wetness)
    mirror = _smoothstep((film_mm - MATT_FILM_MM) / (MAX_FILM_MM - MATT_FILM_MM))
    return wetness, torch.maximum(film.film_wetness / film.puddle_wetness * mirror, puddle)


def _smoothstep(t: Tensor) -> Tensor:
    """Smooth step from 0 at t = 0 to 1 at t = 1."""
    t = t.clamp(0, 1)
    return t * t * (3 - 2 * t)


def water_numbers(
    film: RoadFilm, puddle_threshold: float, white: float
) -> film_kernels.RoadWaterNumbers:
    """Return the water as kernels take it.

    Args:
        film: water on the road.
        puddle_threshold: value of PUDDLE_RANK above which water stands.
        white: result of `darkening.white_level`.
    """
    numbers = (
        *(film.film_share, film.peak_mm, MAX_FILM_MM, film.hit_share, film.film_wetness),
        *(max(film.puddle_wetness, 1e-6), film.track_loss, film.spots, puddle_threshold, white),
        (1 - OUTER_REFLECTANCE) * (1 - INNER_REFLECTANCE),
        INNER_REFLECTANCE,
    )
    return film_kernels.RoadWaterNumbers(*map(np.float32, numbers))
