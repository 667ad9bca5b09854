"""Plan of the hour and the lamps in a scene: which lamps are on, and why."""

from __future__ import annotations

from dataclasses import dataclass, field

from augment.effects.effect import PICTURE, SCENE, Step
from augment.effects.lamps.hour import Hour
from augment.effects.lamps.signs import has_signs
from augment.scene.scene import Scene
from recipes.fields import section_at
from recipes.light import DIM_LUX, Light, foul_weather
from recipes.schema import Recipe

# Names of the passes.
NIGHT_SKY = "sky of the hour"
SURFACES = "lamps: light on surfaces"
WET = "lamps: streaks on wet ground"
AIR = "lamps: light in the air"
DROPS = "lamps: drops and flakes in their light"
EMITTERS = "lamps: lamps in view"
RELIGHT = "hour and exposure"
GLARE = "glare"
METER = "luminance and glare for labels"
SENSOR = "sensor in the dark"
SKY_STEPS = (NIGHT_SKY,)
LAMP_STEPS = (SURFACES, WET, AIR, DROPS, EMITTERS)
CAMERA_STEPS = (RELIGHT, GLARE, METER, SENSOR)


@dataclass(frozen=True)
class LightPlan:
    """Numbers of the hour and the lamps in a scene, `EffectPlan.data` of `LampsEffect`."""

    scene: Scene = field(repr=False, compare=False)
    """The scene, which labels look up their lamps in."""

    light: Light
    """The recipe's section."""

    hour: Hour
    """Light of the sky."""

    seed: int
    """Seed of the recipe."""

    has_vehicle_lamps: bool
    """True if lamps of vehicles are on."""

    own_beam: str
    """Beams of the recording car: dipped, high or off."""

    has_street_lamps: bool
    """True if street lamps are on."""

    has_signs: bool
    """True if traffic signs throw the own beams' light back."""

    has_drops: bool
    """True if rain or snow falls through the lamps' light."""

    extinction_per_m: float
    """Extinction of the fog, 1/m; 0 without fog."""

    wetness: float
    """Wetness of the ground, 0 to 1; 1 in a flood."""

    snow_cover: float
    """Share of the ground that snow covers, 0 to 1."""

    uses_color_map: bool
    """True if pictures have their cameras' colour maps."""

    needs_luminance: bool
    """True if labels of boxes need the picture's luminance."""

    lamp_points: int
    """Points of the sum along each ray for light in the air."""

    lamp_halo_px: int
    """Width of the pixels of halos, of the picture's."""

    lamps_per_pixel: int
    """Lamps that light one part of a surface at most."""

    @property
    def has_air(self) -> bool:
        """Return True if fog, rain or snowfall scatters the lamps' light."""
        return self.extinction_per_m > 0 or self.has_drops

    @property
    def is_wet(self) -> bool:
        """Return True if wet ground or a flood mirrors lamps."""
        return self.wetness > 0

    @property
    def has_lamps(self) -> bool:
        """Return True if any lamp can be on."""
        is_own_on = self.own_beam != "off" and self.hour.is_dark
        return (
            self.has_vehicle_lamps or is_own_on or self.has_street_lamps or bool(self.light.lamps)
        )


def is_foul(recipe: Recipe) -> bool:
    """Return True if the recipe has rain, snowfall, or fog of poor visibility."""
    return _foul_weather(recipe) != ""


def make_light_plan(recipe: Recipe, scene: Scene, light: Light, hour: Hour) -> LightPlan:
    """Return the plan.

    Args:
        recipe: the recipe.
        scene: the scene.
        light: its section.
        hour: light of the sky.
    """
    is_auto_on = auto_reason(recipe, hour)[0]
    own_beam: str = light.own_beams
    if own_beam == "auto":
        own_beam = "dipped" if is_auto_on else "off"
    falling = (recipe.weather.rain, recipe.weather.snowfall)
    wetness = section_at(recipe, "weather.rain.ground_wetness") or 0.0
    snow = recipe.weather.snow
    speed = recipe.render.speed
    return LightPlan(
        scene=scene,
        light=light,
        hour=hour,
        seed=recipe.seed,
        has_vehicle_lamps=light.vehicles == "on" or (light.vehicles == "auto" and is_auto_on),
        own_beam=own_beam,
        has_street_lamps=light.street == "on" or (light.street == "auto" and hour.is_dark),
        has_signs=own_beam != "off" and hour.is_dark and has_signs(scene),
        has_drops=any(section is not None and section.has_effect for section in falling),
        extinction_per_m=section_at(recipe, "weather.smog.resolved_extinction_per_m") or 0.0,
        wetness=1.0 if recipe.weather.flood is not None else wetness,
        snow_cover=0.0 if snow is None else snow.road_cover,
        uses_color_map=bool(scene.color_mapped_cameras) and recipe.render.exposure != "neutral",
        needs_luminance=bool(recipe.output.labels) and scene.labels is not None,
        lamp_points=speed.lamp_points,
        lamp_halo_px=speed.lamp_halo_px,
        lamps_per_pixel=speed.lamps_per_pixel,
    )


def auto_reason(recipe: Recipe, hour: Hour) -> tuple[bool, str]:
    """Return whether `auto` turns lamps on, and why."""
    if hour.is_dark:
        return True, "it is dark"
    weather = _foul_weather(recipe)
    if weather:
        return True, weather
    if hour.ground_lux < DIM_LUX:
        return True, f"{hour.ground_lux:.3g} lx are less than {DIM_LUX:g}"
    return False, "it is a clear day"


def _foul_weather(recipe: Recipe) -> str:
    """Return the weather that makes drivers turn on their lamps, in words; empty for none."""
    return foul_weather(
        section_at(recipe, "weather.rain.rate_mm_h") or 0.0,
        section_at(recipe, "weather.snowfall.rate_mm_h") or 0.0,
        section_at(recipe, "weather.smog.resolved_extinction_per_m") or 0.0,
    )


def steps_of(plan: LightPlan, lamp_reason: str, exposure_reason: str) -> tuple[Step, ...]:
    """Return all passes with their reasons.

    Args:
        plan: the plan.
        lamp_reason: the lamps in words.
        exposure_reason: the camera's exposure in words.
    """
    is_dark = plan.hour.is_dark
    has_lamps = plan.has_lamps
    lamps_at_hour = lamp_reason if has_lamps else "no lamp is on"
    by_day = "by day the scene keeps its own light"
    light = plan.light
    speed = f"{plan.lamp_points} points, every {plan.lamp_halo_px} px"
    surface_reason = f"{lamps_at_hour}; the {plan.lamps_per_pixel} strongest of each place"
    if has_lamps and not is_dark:
        surface_reason = "by day lamps light no surface that is seen"
    sky = f"{plan.hour.reason}, glow {light.glow:g} at the horizon" if is_dark else by_day
    return (
        Step(NIGHT_SKY, is_dark, sky, SCENE),
        Step(SURFACES, has_lamps and is_dark, surface_reason, PICTURE),
        Step(
            WET,
            has_lamps and is_dark and plan.is_wet,
            "wet ground mirrors lamps" if plan.is_wet else "no ground is wet",
            PICTURE,
        ),
        Step(
            AIR,
            has_lamps and plan.has_air,
            f"fog, rain or snowfall scatters light: {speed}"
            if plan.has_air
            else "the air is clear",
            PICTURE,
        ),
        Step(
            DROPS,
            has_lamps and is_dark and plan.has_drops,
            "drops and flakes fall through the lamps' light" if plan.has_drops else "nothing falls",
            PICTURE,
        ),
        Step(EMITTERS, has_lamps, lamps_at_hour, PICTURE),
        Step(
            RELIGHT, True, f"{plan.hour.reason}; {exposure_reason if is_dark else by_day}", PICTURE
        ),
        Step(
            GLARE,
            light.glare > 0 and (is_dark or has_lamps),
            f"light.glare is {light.glare:g}",
            PICTURE,
        ),
        Step(METER, *_meter_reason(plan), PICTURE),
        Step(SENSOR, is_dark, f"light.noise is {light.noise:g}" if is_dark else by_day, PICTURE),
    )


def _meter_reason(plan: LightPlan) -> tuple[bool, str]:
    """Return whether the picture's light is measured, and why."""
    if plan.needs_luminance:
        return True, "labels of boxes have the picture's luminance"
    if plan.hour.is_dark and plan.light.glare > 0:
        return True, "the mask glare has the pixels that glare outshines"
    return False, "neither boxes nor glare need it"
