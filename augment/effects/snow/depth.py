"""Depth of a recipe's snow on every cell of an exposed surface.

Input: cells, the recipe's snow and a seed. The result depends on nothing else. `define_depths` is
the definition, and `find_depths` launches its kernel. Callers: `layer` and `lidar`. The depth is

h = depth * drift(x, y) * shoulder(edge), less in wheel tracks and on the glass of vehicles, and 0
between patches and by water.

- drift = exp(noise), whose median is 1, times the height that the wind piles up before obstacles.
- shoulder: at an open edge the layer is rounded like a pillow, a quarter of a circle.
- foliage: about a third of it carries a thin share of the depth, in flecks; the rest falls through.
- patches: thin snow leaves bare the places where the noise is lowest. It covers a share of coverage
  (1 - exp(-depth / 4 mm)). All of the snow lies on that share, so it is never thinner than a few
  millimetres there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from torch import Tensor

from augment.effects.gradient_noise import (
    Octaves,
    draw_octaves,
    find_threshold,
    gradient_noise,
    sum_octaves,
)
from augment.effects.snow import layer_kernels
from augment.effects.snow.layer_kernels import CellArrays, CellDepths
from augment.exposure.cells import MAX_EDGE_DISTANCE_M, ExposedCells
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene.scene import Scene
from recipes.snow import Snow

COVERING_DEPTH_M = 0.004  # depth that covers all but 1/e of the surface
MIN_FULL_SHARE = 0.9999  # larger shares count as 1
PRESSED_SHARE = 0.8  # share of the depth that wheels take
# Depth of the deepest snow that shows tracks if the recipe says "auto".
MAX_AUTO_TRACKS_DEPTH_M = 0.3
CELLS_PER_TASK = 2048  # number of cells that a thread takes at a time

# Octaves of the noises below: (lattice step in metres, standard deviation).
_CALM_OCTAVES = ((6.0, 0.015), (2.6, 0.02), (1.1, 0.02))  # drifts if wind.drift is 0
_WINDY_OCTAVES = ((6.0, 0.25), (2.6, 0.25), (1.1, 0.14))  # drifts if wind.drift is 1
# Largest height of a drift in metres per metre of lattice step, for both.
_CALM_RISE = 0.008
_WINDY_RISE = 0.035
# Relief of the snow's surface: standard deviation in metres, and its largest share of the depth.
_RELIEF_OCTAVES = ((0.52, 0.0045), (0.21, 0.0018))
_MAX_RELIEF_SHARE = 0.08
_PATCH_OCTAVES = ((2.6, 1.0), (1.1, 0.55), (0.45, 0.3), (0.19, 0.16))  # patches of bare ground
_MOTTLE_OCTAVES = ((0.9, 0.75), (0.31, 0.65))  # mottling of the snow's colour
PATCH_RIM_M = 0.2  # width of a patch's rim, over which snow thins out
PATCH_RIM_SLOPE = 1.8  # usual rise of the patches' noise over a metre, at a patch's rim


class DepthSettings(NamedTuple):
    """Scalars that the depth is made from, besides the cells and noise; a tuple for kernels."""

    depth_m: float  # depth where snow lies
    threshold: float  # value of the patches' noise above which snow lies
    rim: float  # rise of that noise over a patch's rim
    radius_m: float  # radius of the shoulder at open edges
    drift: float  # strength of the wind's drifts
    wind_x: float  # direction that the wind blows towards
    wind_y: float
    pressed: float  # share of the depth that wheels take
    floor_z_m: float  # z of the lowest surface with snow


@dataclass(frozen=True, eq=False)
class DepthProfile:
    """Everything besides the cells that the depth of the snow on a part is made from."""

    settings: DepthSettings
    drifts: Octaves
    patches: Octaves
    mottle: Octaves


def covered_share(snow: Snow) -> float:
    """Return the share of open, level surface that carries snow."""
    share = snow.coverage * -math.expm1(-snow.depth_m / COVERING_DEPTH_M)
    return 1.0 if share > MIN_FULL_SHARE else share


def make_depth_profile(
    snow: Snow, rng: np.random.Generator, *, on_ground: bool, water_level_z_m: float | None = None
) -> DepthProfile:
    """Return the profile of the recipe's snow.

    Args:
        snow: the recipe's snow.
        rng: random numbers of this part.
        on_ground: if True, the part does not move, so that wind, tracks and water count. A part
            that moves has met many winds.
        water_level_z_m: height of standing water, world; None without water.
    """
    # All of the snow lies on the covered share; the less it is, the nearer depth_m comes to
    # COVERING_DEPTH_M.
    settled_share = -math.expm1(-snow.depth_m / COVERING_DEPTH_M)
    depth_m = snow.depth_m / settled_share if settled_share > 0 else COVERING_DEPTH_M
    drift = snow.wind.drift if on_ground else snow.wind.drift / 2
    wind_rad = math.radians(snow.wind.direction_deg) if on_ground else 0.0
    rise = _CALM_RISE + drift * (_WINDY_RISE - _CALM_RISE)
    drift_octaves = [
        (step, min(calm + drift * (windy - calm), rise * step / depth_m))
        for (step, calm), (_, windy) in zip(_CALM_OCTAVES, _WINDY_OCTAVES, strict=True)
    ]
    relief_octaves = [
        (step, (0.4 + 0.6 * snow.grain) * min(height / depth_m, _MAX_RELIEF_SHARE))
        for step, height in _RELIEF_OCTAVES
    ]
    wind_octaves = draw_octaves(drift_octaves, rng, direction_rad=wind_rad, stretch=1 + 0.8 * drift)
    joined_fields = zip(
        vars(wind_octaves).values(), vars(draw_octaves(relief_octaves, rng)).values(), strict=True
    )
    drifts = Octaves(*map(np.concatenate, joined_fields))
    patches = draw_octaves(_PATCH_OCTAVES, rng)
    threshold = find_threshold(patches, covered_share(snow))
    has_tracks = snow.tracks == "always" or (
        snow.tracks == "auto" and snow.depth_m <= MAX_AUTO_TRACKS_DEPTH_M
    )
    has_tracks &= snow.traffic == 0  # `slush` then presses the tracks of many cars
    floor_z_m = -1e30
    if water_level_z_m is not None and on_ground:
        floor_z_m = water_level_z_m + layer_kernels.WATER_MARGIN_M
    settings = DepthSettings(
        depth_m=depth_m,
        threshold=max(min(threshold, 1e9), -1e9),
        rim=PATCH_RIM_M * PATCH_RIM_SLOPE,
        radius_m=min(max(depth_m, 1e-3), MAX_EDGE_DISTANCE_M),
        drift=drift if on_ground else 0.0,
        wind_x=math.cos(wind_rad),
        wind_y=math.sin(wind_rad),
        pressed=PRESSED_SHARE if has_tracks and on_ground else 0.0,
        floor_z_m=floor_z_m,
    )
    return DepthProfile(settings, drifts, patches, draw_octaves(_MOTTLE_OCTAVES, rng))


def profile_on_part(
    track_id: str | None, scene: Scene, snow: Snow, seed: int, water_level_z_m: float | None
) -> tuple[DepthProfile, np.random.Generator]:
    """Return the profile and the random numbers of an actor's snow, or of the ground's (None)."""
    part = "ground" if track_id is None else f"actor {track_id}"
    rng = rng_for(seed=seed, scene=scene.name, effect=f"snow.layer of {part}")
    return make_depth_profile(
        snow, rng, on_ground=track_id is None, water_level_z_m=water_level_z_m
    ), rng


def define_depths(cells: ExposedCells, profile: DepthProfile) -> np.ndarray:
    """Return the depth of the snow on each cell, metres, float64 [C]; depths below BARE_M become 0.

    This is the definition of `layer_kernels.find_depths`.
    """
    settings = profile.settings
    x_m, y_m, z_m = (cells.centers_m[:, i].numpy().astype(np.float64) for i in range(3))
    sizes_m, edge_m, tracks, banks = (
        t.numpy().astype(np.float64)
        for t in (cells.sizes_m, cells.edge_distance_m, cells.track_share, cells.obstacle_vectors)
    )
    bank_along_wind = banks[:, 0] * settings.wind_x + banks[:, 1] * settings.wind_y
    pile_factor = (
        1
        + settings.drift
        * np.where(bank_along_wind > 0, layer_kernels.WINDWARD_GAIN, layer_kernels.LEEWARD_LOSS)
        * bank_along_wind
    )
    log_drift = sum_octaves(profile.drifts, x_m, y_m, sizes_m)
    log_drift = np.clip(log_drift, -layer_kernels.MAX_LOG_DRIFT, layer_kernels.MAX_LOG_DRIFT)
    full_depth = (
        settings.depth_m * np.exp(log_drift) * pile_factor * _pillow(edge_m / settings.radius_m)
    )
    is_foliage = cells.semantic.numpy() == layer_kernels.FOLIAGE
    foliage_depth = np.minimum(
        layer_kernels.FOLIAGE_SHARE * full_depth, layer_kernels.MAX_FOLIAGE_DEPTH_M
    )
    full_depth = np.where(is_foliage, foliage_depth, full_depth)

    shelter = layer_kernels.OBSTACLE_SHELTER * np.hypot(banks[:, 0], banks[:, 1])
    over_threshold = sum_octaves(profile.patches, x_m, y_m) + shelter - settings.threshold
    depths = layer_kernels.MIN_DEPTH_M + np.maximum(
        full_depth - layer_kernels.MIN_DEPTH_M, 0
    ) * np.clip(over_threshold / settings.rim, 0, 1)

    tracks = tracks + layer_kernels.TRACK_UNEVENNESS * mottle_noise(cells, profile) * tracks * (
        1 - tracks
    )
    depths = np.maximum(
        depths * (1 - settings.pressed * np.clip(tracks, 0, 1)),
        np.minimum(depths, layer_kernels.MIN_TRACK_DEPTH_M),
    )
    above_water = z_m - settings.floor_z_m
    depths = layer_kernels.MIN_DEPTH_M + (depths - layer_kernels.MIN_DEPTH_M) * np.clip(
        above_water / layer_kernels.WATER_RIM_M, 0, 1
    )
    has_snow = (
        (over_threshold > 0)
        & (above_water > 0)
        & (~is_foliage | _is_fleck(profile.patches, x_m, y_m))
    )
    return _held_depths(cells, np.where(has_snow, depths, 0.0))


def _is_fleck(patches: Octaves, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Tell where snow lies on foliage at points [N], bool [N]."""
    shares = (layer_kernels.FOLIAGE_COARSE_WEIGHT, layer_kernels.FOLIAGE_FINE_WEIGHT)
    total = np.zeros(len(x_m))
    for share, ((a, b), (c, d)), seed in zip(
        shares, patches.turns[-2:], patches.seeds[-2:], strict=True
    ):
        total += share * gradient_noise(a * x_m + b * y_m, c * x_m + d * y_m, seed)
    return total > layer_kernels.FOLIAGE_THRESHOLD


def _pillow(t: np.ndarray) -> np.ndarray:
    """Quarter of a circle from (0, 0) up to (1, 1), then 1."""
    t = np.clip(t, 0, 1)
    return np.sqrt(t * (2 - t))


def mottle_noise(cells: ExposedCells, profile: DepthProfile) -> np.ndarray:
    """Noise of about unit deviation that the snow's colour follows, float64 [C]."""
    x_m, y_m = (cells.centers_m[:, i].numpy().astype(np.float64) for i in range(2))
    return sum_octaves(profile.mottle, x_m, y_m, cells.sizes_m.numpy().astype(np.float64))


def cell_arrays(cells: ExposedCells) -> CellArrays:
    """Return the arrays of cells, as kernels take them."""
    c = cells
    tensors = (
        c.centers_m,
        c.normals,
        c.sizes_m,
        c.edge_distance_m,
        c.neighbours,
        c.relative_light,
        c.track_share,
        c.obstacle_vectors,
        c.semantic,
    )
    return CellArrays(*as_arrays(*tensors))


def find_depths(cells: ExposedCells, profile: DepthProfile, seed: np.uint64) -> CellDepths:
    """Compute the depth of the snow on every cell, as `define_depths` defines it."""
    count = len(cells)
    heights, mottle = np.empty((2, count), np.float32)
    depths = CellDepths(heights, mottle, np.empty(count, np.uint64))
    with kernel_threads(CELLS_PER_TASK):
        layer_kernels.find_depths(
            cell_arrays(cells),
            profile.settings,
            *(
                _octave_arrays(octaves)
                for octaves in (profile.drifts, profile.patches, profile.mottle)
            ),
            seed,
            depths,
        )
    return depths._replace(depths_m=_held_depths(cells, depths.depths_m))


def _held_depths(cells: ExposedCells, depths_m: np.ndarray) -> np.ndarray:
    """Return the depths that the surface holds, see ExposedCells.depth_share."""
    share = cells.depth_share.numpy()
    held_m = depths_m * share
    is_bare = (share < 1) & (held_m < layer_kernels.MIN_DEPTH_M)
    return np.where(is_bare, 0, held_m).astype(depths_m.dtype)


def as_arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    """Return tensors as contiguous arrays."""
    return tuple(t.contiguous().numpy() for t in tensors)


def _octave_arrays(octaves: Octaves) -> tuple[np.ndarray, ...]:
    """Return the arrays of octaves, as kernels take them."""
    return octaves.turns, octaves.amplitudes, octaves.lengths_m, octaves.seeds
