"""Snow of a recipe's depth laid on a scene's support: Gaussians in the colours of its light.

Everything is a function of the support, the recipe and the seed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from augment.effects.snow import kernels
from augment.effects.snow.cells import SnowCells, SnowSupport
from augment.effects.snow.kernels import Cells, Depths, Splats
from augment.effects.snow.light import Illumination
from augment.effects.snow.near_camera import Grain, Layer, SnowLayers, crystals_of
from augment.effects.snow.profile import Octaves, Profile, profile_of
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene import Gaussians, Scene
from augment.semantics import SemanticClass
from recipes.snow import Snow

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
    )
    return Cells(*_arrays(*columns))


def find_depths(cells: SnowCells, profile: Profile, seed: np.uint64) -> Depths:
    """Depth of the snow on every cell, as `profile.heights_of` defines it."""
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
