"""A recipe's weather put into a scene: heights and reasons become numbers that kernels take."""

from __future__ import annotations

import math
from pathlib import Path
from weakref import WeakKeyDictionary

from augment.errors import SceneError
from augment.geometry import rotmat_from_quat
from augment.ground import check_metric_and_level, ground_of
from augment.render.constants import MAX_EXTENT_SIGMAS
from augment.scene import Actor, Gaussians, Scene
from augment.snow.placed import PlacedSnow
from augment.weather.flood import FloodMedium
from augment.weather.smog import SmogMedium
from augment.weather.wave_spectrum import make_waves
from recipes.schema import Recipe
from recipes.style import Style

LEAST_DEPTH_M = 0.05  # waves run in at least this much water


def place_style(recipe: Recipe) -> tuple[Style | None, str]:
    """The recipe's style, or None where it would change nothing; and why."""
    style = recipe.style
    if style is None:
        return None, "the recipe has no style"
    if not style.changes:
        return None, "the style has no strength, so it changes nothing"
    source = f"preset {style.preset!r}" if style.preset else f"image {Path(style.image or '').name}"
    return style, f"{style.method} from {source} at strength {style.strength:g}"


def place_smog(recipe: Recipe, scene: Scene) -> tuple[SmogMedium | None, str]:
    """The recipe's smog in the scene's heights, or None where it would change nothing; and why."""
    smog = recipe.weather.smog
    if smog is None:
        return None, "the recipe has no smog"
    if smog.sigma_per_m == 0:
        return None, "the smog has no density, so it changes nothing"
    base_z_m = 0.0
    reason = f"extinction {smog.sigma_per_m:.6g}/m, model {smog.model}"
    if smog.scale_height_m is not None:
        if scene.ground_z_m is None:
            raise SceneError(
                f"weather.smog.scale_height_m = {smog.scale_height_m} needs the road's height, "
                f"which scene {scene.name!r} ({scene.source}) does not know; remove "
                f"scale_height_m, or add ground_z=HEIGHT to the scene's URI"
            )
        base_z_m = scene.ground_z_m + smog.base_height_m
        reason += f", scale height {smog.scale_height_m:g} m above z = {base_z_m:.2f} m"
    if not scene.has_metric_scale:
        reason += "; the scene's unit is not known to be a metre, so densities are per scene unit"
    return SmogMedium(smog.sigma_per_m, smog.color, smog.scale_height_m, base_z_m), reason


def place_flood(recipe: Recipe, scene: Scene) -> tuple[FloodMedium | None, str]:
    """The recipe's flood at its height in the scene, or None without one; and why.

    Raises:
        SceneError: the scene's scale, gravity or road is not known.
    """
    flood = recipe.weather.flood
    if flood is None:
        return None, "the recipe has no flood"
    ground = ground_of(scene)
    bases = {"lowest": ground.lowest_z_m, "median": ground.median_z_m, "absolute": 0.0}
    level_z_m = bases[flood.reference] + flood.level_m
    depth_m = max(level_z_m - ground.lowest_z_m, LEAST_DEPTH_M)
    seed = recipe.seed if flood.waves.seed is None else flood.waves.seed
    medium = FloodMedium(
        level_z_m=level_z_m,
        extinction_per_m=flood.extinction_per_m_rgb,
        rgb=flood.color,
        waves=make_waves(flood.waves, seed=seed, depth_m=depth_m),
        refraction_index=flood.refraction_index,
        fresnel=flood.fresnel,
        reflection=flood.reflection,
    )
    reason = (
        f"surface at z = {level_z_m:.2f} m, {level_z_m - ground.lowest_z_m:.2f} m above the lowest "
        f"road ({ground.source}), reflection {flood.reflection}, "
        f"{len(medium.waves.amplitudes_m)} waves"
    )
    return medium, reason


def place_snow(
    recipe: Recipe, scene: Scene, water_level_z_m: float | None
) -> tuple[PlacedSnow | None, str]:
    """The recipe's snow in the scene, or None where it would change nothing; and why.

    water_level_z_m: of the recipe's flood, scene world.

    Raises:
        SceneError: the scene's scale or gravity is not known.
    """
    snow = recipe.weather.snow
    if snow is None:
        return None, "the recipe has no snow"
    if not snow.lies:
        nothing = "depth" if snow.depth_m == 0 else "coverage"
        return None, f"the snow has no {nothing}, so it changes nothing"
    check_metric_and_level(scene)
    seed = recipe.seed if snow.seed is None else snow.seed
    reason = (
        f"{snow.depth_m:g} m deep on {100 * snow.coverage:.3g} % of what is open to the sky, no "
        f"steeper than {snow.max_slope_deg:g} deg and seen by a camera; cells of "
        f"{100 * snow.cell_m:g} cm near the path"
    )
    if water_level_z_m is not None:
        reason += f"; none below the water's level, z = {water_level_z_m:.2f} m"
    return PlacedSnow(snow, seed, water_level_z_m), reason


def lowest_z_m(scene: Scene) -> float:
    """Height below which no splat of the scene reaches at any time; worked out once per scene."""
    if scene not in _LOWEST:
        lows = [_lowest(scene.background), *(_lowest_of_actor(a) for a in scene.actors)]
        _LOWEST[scene] = min(lows)
    return _LOWEST[scene]


_LOWEST: WeakKeyDictionary[Scene, float] = WeakKeyDictionary()


def _lowest(gaussians: Gaussians) -> float:
    if len(gaussians) == 0:
        return math.inf
    up = rotmat_from_quat(gaussians.quats)[:, 2]  # the world's z along each splat's axes
    reach = MAX_EXTENT_SIGMAS * (up * gaussians.scales).norm(dim=1)
    return float((gaussians.means[:, 2] - reach).min())


def _lowest_of_actor(actor: Actor) -> float:
    """By the sphere about the actor's origin that holds all its splats."""
    g = actor.gaussians
    if len(g) == 0:
        return math.inf
    radius = float((g.means.norm(dim=1) + MAX_EXTENT_SIGMAS * g.scales.amax(1)).max())
    return float(actor.track.world_from_actor[:, 2, 3].min()) - radius


def gaussians_below(scene: Scene, level_z_m: float) -> bool:
    """Whether any splat of the scene reaches below a height: else no water stands anywhere."""
    return lowest_z_m(scene) < level_z_m
