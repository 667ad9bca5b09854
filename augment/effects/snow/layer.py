"""Lays snow of a recipe's depth on a scene's exposed surface, as Gaussians in the colours of its
light.

Input: an `ExposedSurface`, the recipe's snow, its light and a seed. The result depends on nothing
else. Output: `SnowLayers`. Caller: `effect.build_snow_layers`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from augment.effects.snow import layer_kernels
from augment.effects.snow.depth import (
    CELLS_PER_TASK,
    DepthProfile,
    as_arrays,
    cell_arrays,
    find_depths,
    profile_on_part,
)
from augment.effects.snow.glints import draw_crystals
from augment.effects.snow.layer_kernels import CellDepths, SplatArrays
from augment.effects.snow.light import SnowIllumination
from augment.effects.snow.part_snow import PartSnow, SnowLayers
from augment.effects.snow.plan import SnowPlan
from augment.effects.snow.relief import Grain
from augment.effects.snow.slush import RoadSnow, road_snow
from augment.effects.snow.wet_tracks import make_wet_road
from augment.exposure.cells import ExposedCells, ExposedSurface
from augment.render.sh import SH_C0
from augment.render.threads import kernel_threads
from augment.rng import rng_for
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from recipes.snow import Snow

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

    plan = SnowPlan(snow, seed, water_level_z_m)

    def layer_of(
        cells: ExposedCells, gaussians: Gaussians, track_id: str | None
    ) -> tuple[PartSnow, RoadSnow | None]:
        """Return the layer on one part, and the traces on it; track_id: None for the background."""
        profile, rng = profile_on_part(track_id, scene, snow, seed, water_level_z_m)
        splat_seed = rng.integers(0, 2**64, dtype=np.uint64)
        depths = find_depths(cells, profile, splat_seed)
        traces = road_snow(depths, cells, scene, plan) if track_id is None else None
        depths = depths if traces is None else traces.depths
        tints = None if traces is None else traces.tints
        moves = track_id is not None
        part, _ = build_part_layer(
            cells, gaussians, snow, light, profile, rng, depths, tints, moves=moves
        )
        return part, traces

    actors = {actor.track_id: actor.gaussians for actor in scene.actors}
    ground, traces = layer_of(exposed_surface.ground, scene.background, None)
    actor_layers = {
        name: layer_of(cells, actors[name], name)[0]
        for name, cells in exposed_surface.actors.items()
    }
    return SnowLayers(
        ground,
        actor_layers,
        light.sun,
        light.wrap,
        thickness_m=snow.depth_m,
        grain=grain_of_snow(snow, scene, light, seed),
        wet_road=traces and make_wet_road(exposed_surface.ground, traces.wetness),
    )


def grain_of_snow(snow: Snow, scene: Scene, light: SnowIllumination, seed: int) -> Grain:
    """Return the grain of the recipe's snow in the scene's light."""
    rng = rng_for(seed=seed, scene=scene.name, effect="snow.grain")
    lit = math.fsum(light.lit_rgb)
    shadow = math.fsum(light.shadow_rgb)
    contrast = min(max(1 - shadow / lit, 0.0), 1.0) if lit > 0 else 0.0
    return Grain(snow.grain, contrast, int(rng.integers(0, 2**63)))


def build_part_layer(
    cells: ExposedCells,
    gaussians: Gaussians,
    snow: Snow,
    light: SnowIllumination,
    profile: DepthProfile,
    rng: np.random.Generator,
    depths: CellDepths,
    tints: np.ndarray | None,
    *,
    moves: bool,
) -> tuple[PartSnow, np.ndarray]:
    """Lay snow of known depths and tints (None for clean snow) on one part of the scene.

    Returns:
        The layer, and the number of its Gaussians on each cell, int64 [C].
    """
    per_pixel = snow.shading == "per_pixel"
    colors = LayerColors(
        wrap=float(light.wrap),
        grain=float(snow.grain),
        packed=1.0 if profile.settings.pressed > 0 else 0.0,
        is_baked=not per_pixel and not moves,
    )
    lights = np.array([light.sun, light.lit_rgb, light.shadow_rgb], np.float64)
    snow_gaussians, normals, slopes, counts = _make_splats(
        cells,
        depths,
        profile.settings.depth_m,
        lights,
        colors,
        tints,
        keep_normals=snow.sparkle > 0 or (moves and not per_pixel),
        keep_slopes=per_pixel or moves,
    )
    crystals = None
    if snow.sparkle > 0:
        assert normals is not None
        sun_contrast = float(lights[1].mean() - lights[2].mean())
        crystals = draw_crystals(snow_gaussians, normals, sun_contrast, snow.sparkle, rng)
    part = PartSnow(
        gaussians=snow_gaussians,
        visible_opacities=_hide_buried(cells, gaussians, depths.depths_m),
        sunlight_rgb=slopes,
        normals=normals if moves and not per_pixel else None,
        crystals=crystals,
    )
    return part, counts


def _make_splats(
    cells: ExposedCells,
    depths: CellDepths,
    depth_m: float,
    lights: np.ndarray,
    colors: LayerColors,
    tints: np.ndarray | None,
    *,
    keep_normals: bool,
    keep_slopes: bool,
) -> tuple[Gaussians, Tensor | None, Tensor | None, np.ndarray]:
    """Make the Gaussians of the snow, their normals and slopes if asked for, and their counts."""
    depths_m = depths.depths_m
    arrays = cell_arrays(cells)._replace(light=_soften_light(cells, depths_m, depth_m))
    tops = find_snow_tops(cells, depths_m)
    counts = np.empty(len(cells), np.int64)
    with kernel_threads(CELLS_PER_TASK):
        layer_kernels.count_splats(
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
        layer_kernels.fill_splats(
            arrays, depths, tops, end_offsets - counts, lights, colors, splats
        )
    if tints is not None:
        _tint_splats(splats, np.repeat(tints, counts, axis=0))
    opacities = torch.full((num_splats,), OPACITY)
    classes = torch.full((num_splats,), int(SemanticClass.SNOW), dtype=torch.int16)
    gaussians = Gaussians(means, quats, scales, opacities, sh, semantic=classes)
    return gaussians, normals if keep_normals else None, slopes if keep_slopes else None, counts


def _tint_splats(splats: SplatArrays, tints: np.ndarray) -> None:
    """Multiply the display-encoded colours of S Gaussians by factors [S, 3], in place."""
    splats.sh[:, 0] = (tints * (0.5 + SH_C0 * splats.sh[:, 0]) - 0.5) / np.float32(SH_C0)
    if len(splats.slopes):
        splats.slopes[:] *= tints


def find_snow_tops(cells: ExposedCells, depths_m: np.ndarray) -> np.ndarray:
    """Return z of every cell's surface with snow of these heights on it, float64 [C].

    Snow evens out the relief beneath it. Deeper snow never lies lower.
    """
    centers, neighbours = as_arrays(cells.centers_m, cells.neighbours)
    z = np.ascontiguousarray(centers[:, 2])
    tops = np.empty(len(cells), np.float64)
    with kernel_threads(CELLS_PER_TASK):
        for _ in range(MAX_SMOOTHING_STEPS):
            next_z = np.empty(len(z), np.float32)
            layer_kernels.relax_heights(neighbours, z, next_z)
            z = next_z
        layer_kernels.find_tops(centers, depths_m, z, tops)
    return tops


def _soften_light(cells: ExposedCells, depths_m: np.ndarray, depth_m: float) -> np.ndarray:
    """Return the light on the bare surface without its finest spots, float32 [C].

    The deeper the snow, the fewer spots it shows.
    """
    sizes, neighbours, light = as_arrays(cells.sizes_m, cells.neighbours, cells.relative_light)
    finest = float(sizes.min()) if len(sizes) else 1.0
    steps = min(max(math.ceil(2 * depth_m / finest), MIN_SMOOTHING_STEPS), MAX_SMOOTHING_STEPS)
    with kernel_threads(CELLS_PER_TASK):
        for _ in range(steps):
            next_light = np.empty(len(light), np.float32)
            layer_kernels.soften_light(neighbours, depths_m, light, next_light)
            light = next_light
    return light


def _hide_buried(cells: ExposedCells, gaussians: Gaussians, depths_m: np.ndarray) -> Tensor:
    """Return opacities of a part's own Gaussians, 0 for those that the snow buries."""
    if len(cells.hideable_ids) == 0 or not depths_m.any():
        return gaussians.opacities
    opacities = gaussians.opacities.detach().clone()
    with kernel_threads(CELLS_PER_TASK):
        layer_kernels.hide_buried(
            *as_arrays(cells.hideable_ids, cells.covering_cells), depths_m, opacities.numpy()
        )
    return opacities
