"""Rain and falling snow as effects: on the finished picture, by its depth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from augment.boxes import PlacedBoxes
from augment.cameras import Camera
from augment.effects.effect import PICTURE, Active, Drawn, Effect, EffectView, Placed, Step, skipped
from augment.effects.falling.air import Falling, draw_falling
from augment.effects.falling.labels import falling_table, measure_falling
from augment.effects.falling.lidar import precipitation_echoes, scatterers_of
from augment.effects.falling.shutter import frame_interval_s, motion_of
from augment.effects.lidar.beam import Echoes
from augment.errors import SceneError
from augment.render.buffers import ALPHA, EXPECTED_DEPTH
from augment.scene import Scene
from augment.timing import timed
from recipes.rain import Rain
from recipes.schema import Recipe
from recipes.snowfall import Snowfall

STREAKS, FLAKES = "rain streaks and veil", "snowflakes and veil"
MASK_SHARE = 0.05  # of a pixel, covered by near drops: from here on it is the mask's


class FallingEffect(Effect):
    """What falls through the air, on labels and LiDAR sweeps. Its placed data are a Falling."""

    is_see_through: ClassVar[bool] = True

    def measure(
        self, placed: PlacedBoxes, camera: Camera, view: EffectView
    ) -> dict[str, np.ndarray]:
        assert self.table is not None
        return measure_falling(self.table, placed, camera, view)

    def attenuate(self, own: Active, echoes: Echoes, rng: np.random.Generator) -> None:
        kind, rate = own.data.kind, float(own.data.rate_mm_h)
        precipitation_echoes(echoes, scatterers_of(kind, rate), rng)


class RainEffect(FallingEffect):
    """Rain in the air."""

    name, section, model, mask = "rain", "weather.rain", Rain, "rain"
    table = falling_table("rain", "streak")

    def kernels(self, section: Rain) -> Any:
        return section.changes or None

    def place(self, recipe: Recipe, scene: Scene, later: Mapping[str, Placed]) -> Placed:
        rain = self.of(recipe)
        if rain is None or not rain.changes:
            why = "the recipe has no rain" if rain is None else "weather.rain.rate_mm_h is 0"
            return Placed(None, skipped((STREAKS,), why, PICTURE))
        falling = Falling(
            "rain",
            rain.rate_mm_h,
            blows_to(rain.wind_mps, rain.wind_from_deg),
            0.0,
            recipe.seed,
            recipe.camera.exposure_ms / 1000,
            rain.min_width_px,
            rain.color,
        )
        return _placed(falling, STREAKS, scene)

    def edit_image(self, own: Active, drawn: Drawn, camera: Camera) -> Drawn:
        return _fallen(own, drawn, camera, STREAKS, "rain")


class SnowfallEffect(FallingEffect):
    """Snow in the air."""

    name, section, model, mask = "snowfall", "weather.snowfall", Snowfall, "snowfall"
    table = falling_table("snowfall", "flake")

    def kernels(self, section: Snowfall) -> Any:
        return section.changes or None

    def place(self, recipe: Recipe, scene: Scene, later: Mapping[str, Placed]) -> Placed:
        snowfall = self.of(recipe)
        if snowfall is None or not snowfall.changes:
            why = "the recipe has no snowfall"
            if snowfall is not None:
                why = "weather.snowfall.rate_mm_h is 0"
            return Placed(None, skipped((FLAKES,), why, PICTURE))
        falling = Falling(
            "snow",
            snowfall.rate_mm_h,
            blows_to(snowfall.wind_mps, snowfall.wind_from_deg),
            snowfall.turbulence_mps,
            recipe.seed,
            recipe.camera.exposure_ms / 1000,
            snowfall.min_width_px,
            snowfall.color,
        )
        return _placed(falling, FLAKES, scene)

    def edit_image(self, own: Active, drawn: Drawn, camera: Camera) -> Drawn:
        return _fallen(own, drawn, camera, FLAKES, "snowfall")


def blows_to(speed_mps: float, from_deg: float) -> tuple[float, float]:
    """A wind's velocity along x and y. from_deg: 0 comes from +x, 90 from +y."""
    angle = math.radians(from_deg)
    return -speed_mps * math.cos(angle), -speed_mps * math.sin(angle)


def _placed(falling: Falling, step: str, scene: Scene) -> Placed:
    """Raises SceneError where the shutter is open for longer than from image to image."""
    interval = frame_interval_s(scene)
    if interval is not None and falling.exposure_s >= interval:
        raise SceneError(
            f"camera.exposure_ms = {falling.exposure_s * 1000:g} is not below the "
            f"{interval * 1000:.4g} ms between two images of a camera of scene {scene.name!r} "
            f"({scene.source}); set a shorter exposure"
        )
    why = (
        f"{falling.rate_mm_h:g} mm/h: extinction {1000 * falling.sizes.extinction_per_m:.3g}/km, "
        f"shutter open for {falling.exposure_s * 1000:g} ms"
    )
    if interval is None:
        why += "; the cameras' speed is not known, so they stand"
    if not scene.has_metric_scale:
        why += "; the scene's unit is not known to be a metre, so sizes are in scene units"
    if not scene.has_known_gravity:
        why += "; it falls along -z, which is not known to point down"
    return Placed(falling, (Step(step, True, why, PICTURE),), frozenset({ALPHA, EXPECTED_DEPTH}))


def _fallen(own: Active, drawn: Drawn, camera: Camera, step: str, mask: str) -> Drawn:
    alpha, depth = drawn.raster.alpha, drawn.raster.expected_depth
    assert alpha is not None and depth is not None
    with timed(step):
        rgb, clear = draw_falling(
            drawn.rgb,
            alpha,
            depth,
            camera,
            own.data,
            scene=own.light,
            fog=drawn.layers.fog,
            motion=motion_of(own.scene, camera),
            backend=own.backend,
        )
    masks = {**drawn.masks, mask: clear < 1 - MASK_SHARE}
    return replace(drawn, rgb=rgb, masks=masks)
