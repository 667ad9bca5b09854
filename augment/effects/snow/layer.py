"""Snow of a recipe's depth laid on a scene's support: Gaussians in the colours of its light.

Everything is a function of the support, the recipe and the seed. Its depth:

h = depth * drift(x, y) * shoulder(edge), less in wheel tracks, and 0 between patches and by water.

- drift = exp(noise), whose median is 1, times what the wind piles up before obstacles.
- shoulder: at an open edge the layer is rounded like a pillow, a quarter of a circle.
- foliage: about a third of it carries a thin share of the depth, in flecks; the rest falls through.
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
import torch
from torch import Tensor

from augment.effects.snow import kernels
from augment.effects.snow.cells import EDGE_CAP_M, SnowCells, SnowSupport
from augment.effects.snow.kernels import Cells, Depths, Splats
from augment.effects.snow.light import Illumination
from augment.effects.snow.near_camera import Layer, SnowLayers, crystals_of
from augment.effects.snow.relief import Grain
from augment.render.threads import kernel_threads
from augment.rng import STEP_X, STEP_Y, mix, rng_for
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass
from recipes.snow import Snow

# ---- Noise over the plane that snow's depth and patches follow: the numpy definition -------------
# Gradient noise (Perlin 1985) with the fade curve of Perlin 2002, its gradients drawn by a hash of
# the lattice's integers: a function of the place and the seed alone, of median 0. A field is a sum
# of octaves, each with a lattice and a hash of its own.

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
    return (near + fade_y * (far - near)) / kernels.DEVIATION


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

COVERING_M = 0.004  # depth that covers all but 1/e of the surface
FULL = 0.9999  # shares above this are the whole
PRESSED = 0.8  # share of the depth that wheels take
AUTO_TRACKS_M = 0.3  # deepest snow that shows tracks by itself

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
        floor_z_m = water_level_z_m + kernels.WATER_MARGIN_M
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
    what `kernels.lay` computes.
    """
    n = profile.numbers
    x_m, y_m, z_m = (cells.centers_m[:, i].numpy().astype(np.float64) for i in range(3))
    sizes_m, edge_m, tracks, banks = (
        t.numpy().astype(np.float64)
        for t in (cells.sizes_m, cells.edge_m, cells.tracks, cells.banks)
    )
    at_wind = banks[:, 0] * n.wind_x + banks[:, 1] * n.wind_y
    piled = 1 + n.drift * np.where(at_wind > 0, kernels.PILED, kernels.SCOURED) * at_wind
    log_drift = field_of(profile.drifts, x_m, y_m, sizes_m)
    log_drift = np.clip(log_drift, -kernels.STEEPEST, kernels.STEEPEST)
    full = n.depth_m * np.exp(log_drift) * piled * _pillow(edge_m / n.radius_m)
    foliage = cells.semantic.numpy() == kernels.FOLIAGE
    thin = np.minimum(kernels.FOLIAGE_SHARE * full, kernels.FOLIAGE_MOST_M)
    full = np.where(foliage, thin, full)

    shelter = kernels.SHELTER * np.hypot(banks[:, 0], banks[:, 1])
    above = field_of(profile.patches, x_m, y_m) + shelter - n.threshold
    h = kernels.BARE_M + np.maximum(full - kernels.BARE_M, 0) * np.clip(above / n.rim, 0, 1)

    tracks = tracks + kernels.CRUMBLED * mottle_of(cells, profile) * tracks * (1 - tracks)
    h = np.maximum(h * (1 - n.pressed * np.clip(tracks, 0, 1)), np.minimum(h, kernels.FILM_M))
    room = z_m - n.floor_z_m
    h = kernels.BARE_M + (h - kernels.BARE_M) * np.clip(room / kernels.WATER_RIM_M, 0, 1)
    lies = (above > 0) & (room > 0) & (~foliage | _flecks(profile.patches, x_m, y_m))
    return np.where(lies, h, 0.0)


def _flecks(patches: Octaves, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """bool [N]: whether snow lies on foliage at points [N], float64."""
    shares, total = (kernels.FOLIAGE_COARSE, kernels.FOLIAGE_FINE), np.zeros(len(x_m))
    for share, ((a, b), (c, d)), seed in zip(
        shares, patches.turns[-2:], patches.seeds[-2:], strict=True
    ):
        total += share * gradient_noise(a * x_m + b * y_m, c * x_m + d * y_m, seed)
    return total > kernels.FOLIAGE_ABOVE


def _pillow(t: np.ndarray) -> np.ndarray:
    """A quarter of a circle from (0, 0) up to (1, 1), and 1 from there on."""
    t = np.clip(t, 0, 1)
    return np.sqrt(t * (2 - t))


def mottle_of(cells: SnowCells, profile: Profile) -> np.ndarray:
    """Noise of about unit deviation that the snow's colour follows, float64 [C]."""
    x_m, y_m = (cells.centers_m[:, i].numpy().astype(np.float64) for i in range(2))
    return field_of(profile.mottle, x_m, y_m, cells.sizes_m.numpy().astype(np.float64))


# ---- The layer ----------------------------------------------------------------------------------

CELLS = 2048  # that a thread takes at a time
# A rasteriser stops before the splat that would leave 1e-4 of the light behind it. With opaque
# discs up to a tenth may still shine through then; with these, no more than a two-hundredth.
OPACITY = 0.98
MIN_STEPS, MAX_STEPS = 6, 10  # of evening out the light; the surface beneath takes the most


class LayerColors(NamedTuple):
    """What colours are made from besides the cells; a tuple, as kernels take it.

    wrap: see augment.effects.snow.light. grain: the recipe's. packed: 1 where tracks show, else 0.
    is_baked: the light by the splats' normals is in `sh`.
    """

    wrap: float
    grain: float
    packed: float
    is_baked: bool


def build_snow_layer(
    support: SnowSupport,
    scene: Scene,
    snow: Snow,
    light: Illumination,
    *,
    seed: int,
    water_level_z_m: float | None = None,
) -> SnowLayers:
    """The recipe's snow on a support of the scene.

    seed: of drifts, patches and grain. water_level_z_m: height of standing water, which melts what
    it reaches, in the scene's world; snow on actors is not asked.

    No tensor of the scene is written to: `Layer.opacities` is the part's own tensor where nothing
    is buried, and a copy else.
    """

    def layer_of(cells: SnowCells, own: Gaussians, track_id: str | None) -> Layer:
        profile, rng = profile_on(track_id, scene, snow, seed, water_level_z_m)
        return _lay(cells, own, snow, light, profile, rng, moves=track_id is not None)

    actors = {actor.track_id: actor.gaussians for actor in scene.actors}
    ground = layer_of(support.ground, scene.background, None)
    own = {name: layer_of(cells, actors[name], name) for name, cells in support.actors.items()}
    grain = _grain(snow, scene, light, seed)
    return SnowLayers(ground, own, light.sun, light.wrap, thickness_m=snow.depth_m, grain=grain)


def profile_on(
    track_id: str | None, scene: Scene, snow: Snow, seed: int, water_level_z_m: float | None
) -> tuple[Profile, np.random.Generator]:
    """The profile of the snow on an actor or the ground (None), and its own random numbers."""
    part = "ground" if track_id is None else f"actor {track_id}"
    rng = rng_for(seed=seed, scene=scene.name, effect=f"snow.layer of {part}")
    return profile_of(snow, rng, on_ground=track_id is None, water_level_z_m=water_level_z_m), rng


def _grain(snow: Snow, scene: Scene, light: Illumination, seed: int) -> Grain:
    rng = rng_for(seed=seed, scene=scene.name, effect="snow.grain")
    lit, shadow = math.fsum(light.lit_rgb), math.fsum(light.shadow_rgb)
    contrast = min(max(1 - shadow / lit, 0.0), 1.0) if lit > 0 else 0.0
    return Grain(snow.grain, contrast, int(rng.integers(0, 2**63)))


def _lay(
    cells: SnowCells,
    own: Gaussians,
    snow: Snow,
    light: Illumination,
    profile: Profile,
    rng: np.random.Generator,
    *,
    moves: bool,
) -> Layer:
    """The snow on one part. own: the part's Gaussians."""
    per_pixel = snow.shading == "per_pixel"
    colors = LayerColors(
        wrap=float(light.wrap),
        grain=float(snow.grain),
        packed=1.0 if profile.numbers.pressed > 0 else 0.0,
        is_baked=not per_pixel and not moves,
    )
    lights = np.array([light.sun, light.lit_rgb, light.shadow_rgb], np.float64)
    seed = rng.integers(0, 2**64, dtype=np.uint64)
    depths = find_depths(cells, profile, seed)
    gaussians, normals, slopes = _splats(
        *(cells, depths, profile.numbers.depth_m, lights, colors),
        keep_normals=snow.sparkle > 0 or (moves and not per_pixel),
        keep_slopes=per_pixel or moves,
    )
    crystals = None
    if snow.sparkle > 0:
        assert normals is not None
        rises = float(lights[1].mean() - lights[2].mean())
        crystals = crystals_of(gaussians, normals, rises, snow.sparkle, rng)
    return Layer(
        gaussians=gaussians,
        opacities=_left_visible(cells, own, depths.heights),
        slopes=slopes,
        normals=normals if moves and not per_pixel else None,
        crystals=crystals,
    )


def arrays_of(cells: SnowCells) -> Cells:
    c = cells
    columns = (
        c.centers_m,
        c.normals,
        c.sizes_m,
        c.edge_m,
        c.neighbours,
        c.light,
        c.tracks,
        c.banks,
        c.semantic,
    )
    return Cells(*_arrays(*columns))


def find_depths(cells: SnowCells, profile: Profile, seed: np.uint64) -> Depths:
    """Depth of the snow on every cell, as `heights_of` defines it."""
    count = len(cells)
    heights, mottle = np.empty((2, count), np.float32)
    depths = Depths(heights, mottle, np.empty(count, np.uint64))
    with kernel_threads(CELLS):
        kernels.lay(
            arrays_of(cells),
            profile.numbers,
            *(_columns(octaves) for octaves in (profile.drifts, profile.patches, profile.mottle)),
            *(seed, depths),
        )
    return depths


def _splats(
    cells: SnowCells,
    depths: Depths,
    depth_m: float,
    lights: np.ndarray,
    colors: LayerColors,
    *,
    keep_normals: bool,
    keep_slopes: bool,
) -> tuple[Gaussians, Tensor | None, Tensor | None]:
    """The Gaussians of the snow, with their normals and slopes where asked for."""
    heights = depths.heights
    arrays = arrays_of(cells)._replace(light=_softened_light(cells, heights, depth_m))
    tops, counts = surface_heights(cells, heights), np.empty(len(cells), np.int64)
    with kernel_threads(CELLS):
        kernels.count_splats(arrays.neighbours, arrays.sizes, arrays.centers, heights, tops, counts)
        lasts = np.cumsum(counts)
        total = int(lasts[-1]) if len(cells) else 0
        means, scales, quats, sh = (
            torch.empty(total, *shape) for shape in ((3,), (3,), (4,), (1, 3))
        )
        normals, slopes = (
            torch.empty(total if keep else 0, 3) for keep in (keep_normals, keep_slopes)
        )
        splats = Splats(*(t.numpy() for t in (means, quats, scales, sh, normals, slopes)))
        kernels.fill(arrays, depths, tops, lasts - counts, lights, colors, splats)
    opacities = torch.full((total,), OPACITY)
    classes = torch.full((total,), int(SemanticClass.SNOW), dtype=torch.int16)
    gaussians = Gaussians(means, quats, scales, opacities, sh, semantic=classes)
    return gaussians, normals if keep_normals else None, slopes if keep_slopes else None


def surface_heights(cells: SnowCells, heights: np.ndarray) -> np.ndarray:
    """World z of every cell's surface, float64 [C], with snow of these heights on it. It evens out
    the relief beneath it, and never lies lower where it is deeper.
    """
    centers, neighbours = _arrays(cells.centers_m, cells.neighbours)
    z, tops = np.ascontiguousarray(centers[:, 2]), np.empty(len(cells), np.float64)
    with kernel_threads(CELLS):
        for _ in range(MAX_STEPS):
            next_z = np.empty(len(z), np.float32)
            kernels.relax_heights(neighbours, z, next_z)
            z = next_z
        kernels.find_tops(centers, heights, z, tops)
    return tops


def _softened_light(cells: SnowCells, heights: np.ndarray, depth_m: float) -> np.ndarray:
    """The light on the bare surface without its finest spots, float32 [C]: the deeper the snow, the
    less of them it shows.
    """
    sizes, neighbours, light = _arrays(cells.sizes_m, cells.neighbours, cells.light)
    finest = float(sizes.min()) if len(sizes) else 1.0
    steps = min(max(math.ceil(2 * depth_m / finest), MIN_STEPS), MAX_STEPS)
    with kernel_threads(CELLS):
        for _ in range(steps):
            next_light = np.empty(len(light), np.float32)
            kernels.soften(neighbours, heights, light, next_light)
            light = next_light
    return light


def _left_visible(cells: SnowCells, own: Gaussians, heights: np.ndarray) -> Tensor:
    """Opacities of a part's own Gaussians, 0 for those that the snow buries."""
    if len(cells.buried) == 0 or not heights.any():
        return own.opacities
    opacities = own.opacities.detach().clone()
    with kernel_threads(CELLS):
        kernels.bury(*_arrays(cells.buried, cells.buried_by), heights, opacities.numpy())
    return opacities


def _arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    return tuple(t.contiguous().numpy() for t in tensors)


def _columns(octaves: Octaves) -> tuple[np.ndarray, ...]:
    return octaves.turns, octaves.amplitudes, octaves.lengths_m, octaves.seeds
