"""The effects rain and snowfall: they edit the finished picture by its depth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from augment.boxes import PlacedBoxes
from augment.cameras import Camera
from augment.effects.effect import PICTURE, Active, Drawn, Effect, EffectView, Placed, Step, skipped
from augment.effects.falling.air import Falling, draw_falling
from augment.effects.falling.drops import Kind
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

STREAKS = "rain streaks and veil"
FLAKES = "snowflakes and veil"


class FallingEffect(Effect):
    """Precipitation in the air. The data of its plan are a `Falling`."""

    is_see_through: ClassVar[bool] = True

    step: ClassVar[str]
    """Name of the pass."""

    kind: ClassVar[Kind]
    """Kind of the precipitation, as in `Falling`."""

    def reads_splats(self, recipe: Recipe) -> bool:
        return False

    def kernels(self, section: Rain | Snowfall) -> Any:
        return section.changes or None

    def place(self, recipe: Recipe, scene: Scene, later: Mapping[str, Placed]) -> Placed:
        section: Rain | Snowfall | None = self.of(recipe)
        if section is None or not section.changes:
            why = f"the recipe has no {self.name}"
            if section is not None:
                why = f"{self.section}.rate_mm_h is 0"
            return Placed(None, skipped((self.step,), why, PICTURE))
        falling = Falling(
            self.kind,
            section.rate_mm_h,
            blows_to(section.wind_mps, section.wind_from_deg),
            section.turbulence_mps if isinstance(section, Snowfall) else 0.0,
            recipe.seed,
            recipe.camera.exposure_ms / 1000,
            section.min_width_px,
            section.color,
        )
        return _plan_of(falling, self.step, scene)

    def edit_image(self, own: Active, drawn: Drawn, camera: Camera) -> Drawn:
        assert self.mask is not None
        return _draw_over(own, drawn, camera, self.step, self.mask)

    def measure(
        self, placed: PlacedBoxes, camera: Camera, view: EffectView
    ) -> dict[str, np.ndarray]:
        assert self.table is not None
        return measure_falling(self.table, placed, camera, view)

    def attenuate(self, own: Active, echoes: Echoes, rng: np.random.Generator) -> None:
        kind = own.data.kind
        rate = float(own.data.rate_mm_h)
        precipitation_echoes(echoes, scatterers_of(kind, rate), rng)


class RainEffect(FallingEffect):
    """Rain in the air."""

    name = "rain"
    section = "weather.rain"
    model = Rain
    mask = "rain"
    step = STREAKS
    kind = "rain"
    table = falling_table("rain", "streak")


class SnowfallEffect(FallingEffect):
    """Snow in the air."""

    name = "snowfall"
    section = "weather.snowfall"
    model = Snowfall
    mask = "snowfall"
    step = FLAKES
    kind = "snow"
    table = falling_table("snowfall", "flake")


def blows_to(speed_mps: float, from_deg: float) -> tuple[float, float]:
    """Return a wind's velocity along x and y. from_deg: 0 comes from +x, 90 from +y."""
    angle = math.radians(from_deg)
    return -speed_mps * math.cos(angle), -speed_mps * math.sin(angle)


def _plan_of(falling: Falling, step: str, scene: Scene) -> Placed:
    """Return the plan. Raise SceneError if the exposure is longer than the frame interval."""
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


def _draw_over(own: Active, drawn: Drawn, camera: Camera, step: str, mask: str) -> Drawn:
    alpha = drawn.raster.alpha
    depth = drawn.raster.expected_depth
    assert alpha is not None and depth is not None
    with timed(step):
        rgb, drop_mask = draw_falling(
            drawn.rgb,
            alpha,
            depth,
            camera,
            own.data,
            scene=own.light,
            fog=drawn.layers.fog,
            motion=motion_of(own.scene, camera),
            splats=_surfaces_of(drawn),
            backend=own.backend,
        )
    masks = {**drawn.masks, mask: drop_mask}
    return replace(drawn, rgb=rgb, masks=masks)


def _surfaces_of(drawn: Drawn) -> Float[Tensor, "H W 3"] | None:
    """Return the Gaussians' part of the picture; None if something was drawn over all of it."""
    splats = drawn.raster.rgb
    if splats is None or drawn.layers.photo is not None:
        return None
    is_first = not drawn.masks.keys() & {"rain", "snowfall"}
    return splats if is_first and splats.data_ptr() != drawn.rgb.data_ptr() else None
