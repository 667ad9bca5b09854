"""The effect spray: behind vehicles in the rain, on the finished picture and along beams."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace

from augment.effects.effect import (
    PICTURE,
    Effect,
    EffectInScene,
    EffectPlan,
    RenderedView,
    Step,
    ViewQuery,
    Visibility,
    skipped_steps,
)
from augment.effects.falling.air import glow_of
from augment.effects.falling.effect import wind_velocity_mps
from augment.effects.lidar.beam import Echoes
from augment.effects.spray.lidar import spray_echoes
from augment.effects.spray.picture import blend_puffs, windows_of
from augment.effects.spray.puffs import (
    MIN_SPEED_MPS,
    Puffs,
    lifted_water_m,
    spray_puffs,
    spraying_actors,
)
from augment.render.buffers import ALPHA, EXPECTED_DEPTH
from augment.rng import rng_for
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.timing import timed
from recipes.rain import Rain
from recipes.schema import Recipe

SPRAY = "spray behind vehicles"


@dataclass(frozen=True)
class SprayPlan:
    """Numbers of the spray in a scene."""

    water_m: float
    """Depth of the water on the road."""

    wind_mps: tuple[float, float]
    """Velocity of the wind along world x and y."""

    seed: int
    """The recipe's seed."""

    def puffs(self, scene: Scene, time_ns: int) -> Puffs:
        """Return the puffs in the air at a time."""
        return spray_puffs(scene, time_ns, self.water_m, seed=self.seed, wind_mps=self.wind_mps)


class SprayEffect(Effect):
    """Water that vehicles lift from a wet road."""

    name = "spray"
    section = "weather.rain"
    model = Rain

    def reads_splats(self, recipe: Recipe) -> bool:
        return False

    def kernel_key(self, section: Rain) -> Hashable:
        return (_lifts_water(section) and section.spray) or None

    def plan_in_scene(
        self, recipe: Recipe, scene: Scene, later_plans: Mapping[str, EffectPlan]
    ) -> EffectPlan:
        rain = self.section_of(recipe)
        why = ""
        if rain is None or not _lifts_water(rain):
            why = "the recipe has no rain" if rain is None else "weather.rain.rate_mm_h is 0"
        elif not rain.spray:
            why = "weather.rain.spray is false"
        elif rain.ground_wetness == 0:
            why = "weather.rain.wetness is 0"
        elif not spraying_actors(scene):
            why = f"no actor drives faster than {3.6 * MIN_SPEED_MPS:.0f} km/h"
        if rain is None or why:
            return EffectPlan(None, skipped_steps((SPRAY,), why, PICTURE))
        wind_mps = wind_velocity_mps(rain.wind_mps, rain.wind_from_deg)
        spray = SprayPlan(lifted_water_m(rain), wind_mps, recipe.seed)
        why = (
            f"{len(spraying_actors(scene))} actors drive faster than {3.6 * MIN_SPEED_MPS:.0f} "
            f"km/h on {1000 * spray.water_m:.2g} mm of water"
        )
        return EffectPlan(
            spray, (Step(SPRAY, True, why, PICTURE),), frozenset({ALPHA, EXPECTED_DEPTH})
        )

    def visibility(self, effect: EffectInScene, query: ViewQuery) -> Visibility:
        puffs = effect.settings.puffs(effect.scene, query.camera.timestamp_ns)
        camera = query.camera
        windows = windows_of(puffs, camera)
        if not ((windows[:, 0] < windows[:, 1]) & (windows[:, 2] < windows[:, 3])).any():
            return Visibility(False, {SPRAY: "no spray can be in view"})
        return Visibility(view_data=puffs)

    def edit_image(self, effect: EffectInScene, view: RenderedView, camera: Camera) -> RenderedView:
        raster = view.raster
        assert raster.alpha is not None and raster.expected_depth is not None
        light = glow_of(effect.lit_scene).mean
        if view.layers.added_colors is not None:
            light = view.layers.added_colors.of_light(light)
        with timed(SPRAY):
            rgb = blend_puffs(
                view.rgb,
                raster.alpha,
                raster.expected_depth,
                camera,
                effect.view_data,
                light,
                fog=view.layers.fog,
                backend=effect.backend,
            )
        return replace(view, rgb=rgb)

    def intersect_beams(self, effect: EffectInScene, echoes: Echoes, frame_ns: int) -> None:
        key = f"lidar.spray at {frame_ns} ns"
        rng = rng_for(seed=effect.settings.seed, scene=effect.scene.name, effect=key)
        spray_echoes(echoes, effect.settings.puffs(effect.scene, frame_ns), rng)


def _lifts_water(rain: Rain) -> bool:
    """Return True if rain falls, or has left a film on the road."""
    return rain.has_effect or (rain.road is not None and rain.road.film_mm > 0)
