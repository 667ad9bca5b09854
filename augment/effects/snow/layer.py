"""Lays snow of a recipe's depth on a scene's exposed surface, as Gaussians in the colours of its
light.

Input: an `ExposedSurface`, the recipe's snow, its light and a seed. The result depends on nothing
else. Output: `SnowLayers`. Caller: `effect.build_snow_layers`; `lidar` uses the depths alone. The
depth of the snow is

h = depth * drift(x, y) * shoulder(edge), less in wheel tracks, and 0 between patches and by water.

- drift = exp(noise), whose median is 1, times the height that the wind piles up before obstacles.
- shoulder: at an open edge the layer is rounded like a pillow, a quarter of a circle.
- foliage: about a third of it carries a thin share of the depth, in flecks; the rest falls through.
- patches: thin snow leaves bare the places where the noise is lowest. It covers a share of coverage
  (1 - exp(-depth / 4 mm)). All of the snow lies on that share, so it is never thinner than a few
  millimetres there.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from augment.effects.snow import kernels
from augment.effects.snow.kernels import CellArrays, CellDepths, SplatArrays
from augment.effects.snow.light import SnowIllumination
from augment.effects.snow.near_camera import PartSnow, SnowLayers, draw_crystals
from augment.effects.snow.relief import Grain
from augment.exposure.cells import MAX_EDGE_DISTANCE_M, ExposedCells, ExposedSurface
from augment.render.threads import kernel_threads
from augment.rng import STEP_X, STEP_Y, mix, rng_for
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from recipes.snow import Snow

# ---- Noise over the plane that snow's depth and patches follow: the numpy definition -------------
# Gradient noise (Perlin 1985) with the fade curve of Perlin 2002. A hash of the lattice's integers
# draws the gradients, so the noise is a function of the place and the seed alone; its median is 0.
# A field is a sum of octaves, each with a lattice and a hash of its own.

_NUM_SAMPLES = 1 << 17  # number of points at which a field's values are measured
# Steps of a plane-filling sequence (Roberts 2018).
_GOLDEN_STEPS = (0.7548776662466927, 0.5698402909980532)
_SAMPLED_SIDE_M = 5000.0  # side of the square that the points fill


@dataclass(frozen=True, eq=False)
class Octaves:
    """K octaves of noise."""

    turns: np.ndarray  # [K, 2, 2], lattice coordinates = turns @ (x, y) in metres
    amplitudes: np.ndarray  # [K], standard deviation of each octave
    # [K], step of each lattice. Cells larger than half of it cannot show the octave, see
    # `sum_octaves`.
    lengths_m: np.ndarray
    seeds: np.ndarray  # [K], uint64

    def __len__(self) -> int:
        return len(self.amplitudes)


def draw_octaves(
    rows: Iterable[tuple[float, float]],
    rng: np.random.Generator,
    *,
    direction_rad: float = 0.0,
    stretch: float = 1.0,
) -> Octaves:
    """Draw octaves of noise.

    Args:
        rows: (lattice step in metres, standard deviation) of each octave.
        rng: random numbers.
        direction_rad: direction of the stretch, radians from +x.
        stretch: factor >= 1 by which the noise is shorter in that direction and longer across it.
            With 1, each octave is turned by a random angle instead, so that the lattices do not
            line up.
    """
    pairs = np.array(list(rows), np.float64).reshape(-1, 2)
    count = len(pairs)
    angles = np.full(count, direction_rad) if stretch != 1 else rng.uniform(0, 2 * math.pi, count)
    cos = np.cos(angles)
    sin = np.sin(angles)
    turns = np.stack([cos, sin, -sin, cos], -1).reshape(count, 2, 2) / pairs[:, :1, None]
    turns *= np.array([stretch, 1 / stretch])[:, None]
    seeds = rng.integers(0, 2**64, count, np.uint64)
    return Octaves(np.ascontiguousarray(turns), pairs[:, 1].copy(), pairs[:, 0].copy(), seeds)


def gradient_noise(u: np.ndarray, v: np.ndarray, seed: np.uint64) -> np.ndarray:
    """Noise of unit standard deviation at lattice coordinates u, v [N], float64."""
    column = np.floor(u)
    row = np.floor(v)
    x = u - column
    y = v - row
    fade_x, fade_y = (t * t * t * (t * (t * 6 - 15) + 10) for t in (x, y))
    corners = []
    for j in (0, 1):
        for i in (0, 1):
            column_bits = (column.astype(np.int64) + i).astype(np.uint64) * np.uint64(STEP_X)
            row_bits = (row.astype(np.int64) + j).astype(np.uint64) * np.uint64(STEP_Y)
            bits = mix((column_bits + row_bits) ^ seed)
            gx = (bits >> np.uint64(32)).astype(np.float64) * 2.0**-31 - 1
            gy = (bits & np.uint64(0xFFFFFFFF)).astype(np.float64) * 2.0**-31 - 1
            corners.append(gx * (x - i) + gy * (y - j))
    lower = corners[0] + fade_x * (corners[1] - corners[0])
    upper = corners[2] + fade_x * (corners[3] - corners[2])
    return (lower + fade_y * (upper - lower)) / kernels.DEVIATION


def sum_octaves(
    octaves: Octaves, x_m: np.ndarray, y_m: np.ndarray, sizes_m: np.ndarray | float = 0.0
) -> np.ndarray:
    """Sum the octaves at points [N], float64.

    Args:
        octaves: octaves of the noise.
        x_m: [N], world.
        y_m: [N], world.
        sizes_m: sides of the cells that the points stand for. An octave fades between cells of a
            quarter and of half its lattice's step; larger cells would show its aliases only.
    """
    total = np.zeros(np.shape(x_m), np.float64)
    for k in range(len(octaves)):
        (a, b), (c, d) = octaves.turns[k]
        visible_share = np.clip(2 - 4 * np.asarray(sizes_m) / octaves.lengths_m[k], 0, 1)
        noise = gradient_noise(a * x_m + b * y_m, c * x_m + d * y_m, octaves.seeds[k])
        total += octaves.amplitudes[k] * visible_share * noise
    return total


def find_threshold(octaves: Octaves, share: float) -> float:
    """Return the value that the field exceeds on `share` of the plane; infinite for 0 and 1.

    It depends on the octaves' steps and amplitudes alone, not on their seeds.
    """
    if share <= 0:
        return math.inf
    if share >= 1:
        return -math.inf
    values = _ordered_values(tuple(octaves.lengths_m), tuple(octaves.amplitudes))
    return float(values[min(int((1 - share) * len(values)), len(values) - 1)])


@functools.lru_cache(maxsize=8)
def _ordered_values(lengths_m: tuple[float, ...], amplitudes: tuple[float, ...]) -> np.ndarray:
    """Return a field's values at points spread evenly over much of the plane, in rising order."""
    octaves = draw_octaves(zip(lengths_m, amplitudes, strict=True), np.random.default_rng(0))
    x_m, y_m = (np.arange(1, _NUM_SAMPLES + 1) * g % 1 * _SAMPLED_SIDE_M for g in _GOLDEN_STEPS)
    return np.sort(sum_octaves(octaves, x_m, y_m))


# ---- The depth -----------------------------------------------------------------------------------

COVERING_DEPTH_M = 0.004  # depth that covers all but 1/e of the surface
MIN_FULL_SHARE = 0.9999  # larger shares count as 1
PRESSED_SHARE = 0.8  # share of the depth that wheels take
# Depth of the deepest snow that shows tracks if the recipe says "auto".
MAX_AUTO_TRACKS_DEPTH_M = 0.3

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
    floor_z_m = -1e30
    if water_level_z_m is not None and on_ground:
        floor_z_m = water_level_z_m + kernels.WATER_MARGIN_M
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


def define_depths(cells: ExposedCells, profile: DepthProfile) -> np.ndarray:
    """Return the depth of the snow on each cell, metres, float64 [C]; depths below BARE_M become 0.

    This is the definition of `kernels.find_depths`.
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
        * np.where(bank_along_wind > 0, kernels.WINDWARD_GAIN, kernels.LEEWARD_LOSS)
        * bank_along_wind
    )
    log_drift = sum_octaves(profile.drifts, x_m, y_m, sizes_m)
    log_drift = np.clip(log_drift, -kernels.MAX_LOG_DRIFT, kernels.MAX_LOG_DRIFT)
    full_depth = (
        settings.depth_m * np.exp(log_drift) * pile_factor * _pillow(edge_m / settings.radius_m)
    )
    is_foliage = cells.semantic.numpy() == kernels.FOLIAGE
    foliage_depth = np.minimum(kernels.FOLIAGE_SHARE * full_depth, kernels.MAX_FOLIAGE_DEPTH_M)
    full_depth = np.where(is_foliage, foliage_depth, full_depth)

    shelter = kernels.OBSTACLE_SHELTER * np.hypot(banks[:, 0], banks[:, 1])
    over_threshold = sum_octaves(profile.patches, x_m, y_m) + shelter - settings.threshold
    depths = kernels.MIN_DEPTH_M + np.maximum(full_depth - kernels.MIN_DEPTH_M, 0) * np.clip(
        over_threshold / settings.rim, 0, 1
    )

    tracks = tracks + kernels.TRACK_UNEVENNESS * mottle_noise(cells, profile) * tracks * (
        1 - tracks
    )
    depths = np.maximum(
        depths * (1 - settings.pressed * np.clip(tracks, 0, 1)),
        np.minimum(depths, kernels.MIN_TRACK_DEPTH_M),
    )
    above_water = z_m - settings.floor_z_m
    depths = kernels.MIN_DEPTH_M + (depths - kernels.MIN_DEPTH_M) * np.clip(
        above_water / kernels.WATER_RIM_M, 0, 1
    )
    has_snow = (
        (over_threshold > 0)
        & (above_water > 0)
        & (~is_foliage | _is_fleck(profile.patches, x_m, y_m))
    )
    return np.where(has_snow, depths, 0.0)


def _is_fleck(patches: Octaves, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Tell where snow lies on foliage at points [N], bool [N]."""
    shares = (kernels.FOLIAGE_COARSE_WEIGHT, kernels.FOLIAGE_FINE_WEIGHT)
    total = np.zeros(len(x_m))
    for share, ((a, b), (c, d)), seed in zip(
        shares, patches.turns[-2:], patches.seeds[-2:], strict=True
    ):
        total += share * gradient_noise(a * x_m + b * y_m, c * x_m + d * y_m, seed)
    return total > kernels.FOLIAGE_THRESHOLD


def _pillow(t: np.ndarray) -> np.ndarray:
    """Quarter of a circle from (0, 0) up to (1, 1), then 1."""
    t = np.clip(t, 0, 1)
    return np.sqrt(t * (2 - t))


def mottle_noise(cells: ExposedCells, profile: DepthProfile) -> np.ndarray:
    """Noise of about unit deviation that the snow's colour follows, float64 [C]."""
    x_m, y_m = (cells.centers_m[:, i].numpy().astype(np.float64) for i in range(2))
    return sum_octaves(profile.mottle, x_m, y_m, cells.sizes_m.numpy().astype(np.float64))


# ---- The layer ----------------------------------------------------------------------------------

CELLS_PER_TASK = 2048  # number of cells that a thread takes at a time
# Opacity of snow. A rasteriser stops before the splat that would leave 1e-4 of the light behind it.
# With opaque discs up to a tenth may still shine through then; with this, no more than 1 / 200.
OPACITY = 0.98
# Least and largest number of steps that even out the light; the surface takes the largest.
MIN_SMOOTHING_STEPS = 6
MAX_SMOOTHING_STEPS = 10


class LayerColors(NamedTuple):
    """Scalars that colours are made from, besides the cells; a tuple for the kernels."""

    wrap: float  # how far light reaches around, see augment.effects.snow.light
    grain: float  # grain of the recipe
    packed: float  # 1 where tracks show, else 0
    is_baked: bool  # True if `sh` holds the light by the splats' normals


def lay_snow(
    exposed_surface: ExposedSurface,
    scene: Scene,
    snow: Snow,
    light: SnowIllumination,
    *,
    seed: int,
    water_level_z_m: float | None = None,
) -> SnowLayers:
    """Lay the recipe's snow on the exposed surface of the scene.

    No tensor of the scene is written to. `PartSnow.visible_opacities` is the part's own tensor
    where nothing is buried, and a copy otherwise.

    Args:
        exposed_surface: cells of the scene.
        scene: the scene.
        snow: the recipe's snow.
        light: light on the snow.
        seed: seed of drifts, patches and grain.
        water_level_z_m: height of standing water, world, which melts the snow that it reaches; snow
            on actors stays. None without water.
    """

    def layer_of(cells: ExposedCells, gaussians: Gaussians, track_id: str | None) -> PartSnow:
        """Return the layer on one part; track_id: None for the background."""
        profile, rng = profile_on_part(track_id, scene, snow, seed, water_level_z_m)
        return _build_part_layer(
            cells, gaussians, snow, light, profile, rng, moves=track_id is not None
        )

    actors = {actor.track_id: actor.gaussians for actor in scene.actors}
    ground = layer_of(exposed_surface.ground, scene.background, None)
    actor_layers = {
        name: layer_of(cells, actors[name], name) for name, cells in exposed_surface.actors.items()
    }
    grain = _grain_of_snow(snow, scene, light, seed)
    return SnowLayers(
        ground, actor_layers, light.sun, light.wrap, thickness_m=snow.depth_m, grain=grain
    )


def profile_on_part(
    track_id: str | None, scene: Scene, snow: Snow, seed: int, water_level_z_m: float | None
) -> tuple[DepthProfile, np.random.Generator]:
    """Return the profile and the random numbers of an actor's snow, or of the ground's (None)."""
    part = "ground" if track_id is None else f"actor {track_id}"
    rng = rng_for(seed=seed, scene=scene.name, effect=f"snow.layer of {part}")
    return make_depth_profile(
        snow, rng, on_ground=track_id is None, water_level_z_m=water_level_z_m
    ), rng


def _grain_of_snow(snow: Snow, scene: Scene, light: SnowIllumination, seed: int) -> Grain:
    """Return the grain of the recipe's snow in the scene's light."""
    rng = rng_for(seed=seed, scene=scene.name, effect="snow.grain")
    lit = math.fsum(light.lit_rgb)
    shadow = math.fsum(light.shadow_rgb)
    contrast = min(max(1 - shadow / lit, 0.0), 1.0) if lit > 0 else 0.0
    return Grain(snow.grain, contrast, int(rng.integers(0, 2**63)))


def _build_part_layer(
    cells: ExposedCells,
    gaussians: Gaussians,
    snow: Snow,
    light: SnowIllumination,
    profile: DepthProfile,
    rng: np.random.Generator,
    *,
    moves: bool,
) -> PartSnow:
    """Lay snow on one part of the scene."""
    per_pixel = snow.shading == "per_pixel"
    colors = LayerColors(
        wrap=float(light.wrap),
        grain=float(snow.grain),
        packed=1.0 if profile.settings.pressed > 0 else 0.0,
        is_baked=not per_pixel and not moves,
    )
    lights = np.array([light.sun, light.lit_rgb, light.shadow_rgb], np.float64)
    seed = rng.integers(0, 2**64, dtype=np.uint64)
    depths = find_depths(cells, profile, seed)
    snow_gaussians, normals, slopes = _make_splats(
        cells,
        depths,
        profile.settings.depth_m,
        lights,
        colors,
        keep_normals=snow.sparkle > 0 or (moves and not per_pixel),
        keep_slopes=per_pixel or moves,
    )
    crystals = None
    if snow.sparkle > 0:
        assert normals is not None
        sun_contrast = float(lights[1].mean() - lights[2].mean())
        crystals = draw_crystals(snow_gaussians, normals, sun_contrast, snow.sparkle, rng)
    return PartSnow(
        gaussians=snow_gaussians,
        visible_opacities=_hide_buried(cells, gaussians, depths.depths_m),
        sunlight_rgb=slopes,
        normals=normals if moves and not per_pixel else None,
        crystals=crystals,
    )


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
    return CellArrays(*_as_arrays(*tensors))


def find_depths(cells: ExposedCells, profile: DepthProfile, seed: np.uint64) -> CellDepths:
    """Compute the depth of the snow on every cell, as `define_depths` defines it."""
    count = len(cells)
    heights, mottle = np.empty((2, count), np.float32)
    depths = CellDepths(heights, mottle, np.empty(count, np.uint64))
    with kernel_threads(CELLS_PER_TASK):
        kernels.find_depths(
            cell_arrays(cells),
            profile.settings,
            *(
                _octave_arrays(octaves)
                for octaves in (profile.drifts, profile.patches, profile.mottle)
            ),
            seed,
            depths,
        )
    return depths


def _make_splats(
    cells: ExposedCells,
    depths: CellDepths,
    depth_m: float,
    lights: np.ndarray,
    colors: LayerColors,
    *,
    keep_normals: bool,
    keep_slopes: bool,
) -> tuple[Gaussians, Tensor | None, Tensor | None]:
    """Make the Gaussians of the snow, with their normals and slopes if asked for."""
    depths_m = depths.depths_m
    arrays = cell_arrays(cells)._replace(light=_soften_light(cells, depths_m, depth_m))
    tops = find_snow_tops(cells, depths_m)
    counts = np.empty(len(cells), np.int64)
    with kernel_threads(CELLS_PER_TASK):
        kernels.count_splats(
            arrays.neighbours, arrays.sizes, arrays.centers, depths_m, tops, counts
        )
        end_offsets = np.cumsum(counts)
        num_splats = int(end_offsets[-1]) if len(cells) else 0
        means, scales, quats, sh = (
            torch.empty(num_splats, *shape) for shape in ((3,), (3,), (4,), (1, 3))
        )
        normals, slopes = (
            torch.empty(num_splats if is_kept else 0, 3) for is_kept in (keep_normals, keep_slopes)
        )
        splats = SplatArrays(*(t.numpy() for t in (means, quats, scales, sh, normals, slopes)))
        kernels.fill_splats(arrays, depths, tops, end_offsets - counts, lights, colors, splats)
    opacities = torch.full((num_splats,), OPACITY)
    classes = torch.full((num_splats,), int(SemanticClass.SNOW), dtype=torch.int16)
    gaussians = Gaussians(means, quats, scales, opacities, sh, semantic=classes)
    return gaussians, normals if keep_normals else None, slopes if keep_slopes else None


def find_snow_tops(cells: ExposedCells, depths_m: np.ndarray) -> np.ndarray:
    """Return z of every cell's surface with snow of these heights on it, float64 [C].

    Snow evens out the relief beneath it. Deeper snow never lies lower.
    """
    centers, neighbours = _as_arrays(cells.centers_m, cells.neighbours)
    z = np.ascontiguousarray(centers[:, 2])
    tops = np.empty(len(cells), np.float64)
    with kernel_threads(CELLS_PER_TASK):
        for _ in range(MAX_SMOOTHING_STEPS):
            next_z = np.empty(len(z), np.float32)
            kernels.relax_heights(neighbours, z, next_z)
            z = next_z
        kernels.find_tops(centers, depths_m, z, tops)
    return tops


def _soften_light(cells: ExposedCells, depths_m: np.ndarray, depth_m: float) -> np.ndarray:
    """Return the light on the bare surface without its finest spots, float32 [C].

    The deeper the snow, the fewer spots it shows.
    """
    sizes, neighbours, light = _as_arrays(cells.sizes_m, cells.neighbours, cells.relative_light)
    finest = float(sizes.min()) if len(sizes) else 1.0
    steps = min(max(math.ceil(2 * depth_m / finest), MIN_SMOOTHING_STEPS), MAX_SMOOTHING_STEPS)
    with kernel_threads(CELLS_PER_TASK):
        for _ in range(steps):
            next_light = np.empty(len(light), np.float32)
            kernels.soften_light(neighbours, depths_m, light, next_light)
            light = next_light
    return light


def _hide_buried(cells: ExposedCells, gaussians: Gaussians, depths_m: np.ndarray) -> Tensor:
    """Return opacities of a part's own Gaussians, 0 for those that the snow buries."""
    if len(cells.hideable_ids) == 0 or not depths_m.any():
        return gaussians.opacities
    opacities = gaussians.opacities.detach().clone()
    with kernel_threads(CELLS_PER_TASK):
        kernels.hide_buried(
            *_as_arrays(cells.hideable_ids, cells.covering_cells), depths_m, opacities.numpy()
        )
    return opacities


def _as_arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    """Return tensors as contiguous arrays."""
    return tuple(t.contiguous().numpy() for t in tensors)


def _octave_arrays(octaves: Octaves) -> tuple[np.ndarray, ...]:
    """Return the arrays of octaves, as kernels take them."""
    return octaves.turns, octaves.amplitudes, octaves.lengths_m, octaves.seeds
