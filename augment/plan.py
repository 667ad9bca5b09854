"""Recipe + scene -> exactly the passes and buffers that the picture requires, before rendering.

A plan is made of plain facts, so it can be printed, compared and tested. `view_plan` leaves out of
it what one camera cannot see, and `apply` carries that out.
"""

from __future__ import annotations

from dataclasses import dataclass

from augment.place import gaussians_below, place_flood, place_smog, place_snow, place_style
from augment.render.buffers import (
    ALPHA,
    DEPTH_ESTIMATORS,
    EXPECTED_DEPTH,
    RGB,
    SNOW,
    SPLAT_IDS,
)
from augment.render.constants import RasterSettings
from augment.scene import Scene
from augment.snow.placed import PlacedSnow
from augment.weather.flood import FloodMedium
from augment.weather.smog import SmogMedium
from recipes.errors import RecipeError
from recipes.schema import Recipe
from recipes.style import Style


@dataclass(frozen=True)
class Step:
    """One possible pass. why: the reason it runs, or the reason it does not."""

    name: str
    runs: bool
    why: str


@dataclass(frozen=True)
class Plan:
    """What rendering one view under a recipe takes.

    buffers: what the rasteriser is asked for. smog_in_splats: smog blended per Gaussian inside the
    rasteriser; smog_on_buffers: smog applied to finished buffers; at most one of them is set.
    recorded_exposure: whether cameras' colour maps apply to the finished picture.
    depth_buffer: which buffer is written as depth, or None. steps: every pass considered, in order.
    flood: the water, None where there is none. shows_water: whether depth, semantic and instance
    images show the water's surface or the scene's under it. snow: None where there is none.
    finds_boxes: whether labels or instance images need the depth of the solid surfaces, snow
    included, for what is seen of the boxes.
    snowless_buffers: what takes the place of buffers in views that no snow is in. bare_buffers:
    what depth, semantic and instance images take from a render of the scene without its snow;
    empty where they show the snow.
    style: what the colours of the scene are turned into; None leaves them. styles_picture: whether
    it is put on the finished picture, weather and all, and not on the scene in it.
    """

    settings: RasterSettings
    buffers: frozenset[str]
    smog_in_splats: SmogMedium | None
    smog_on_buffers: SmogMedium | None
    depth_buffer: str | None
    semantic: bool
    instance: bool
    steps: tuple[Step, ...]
    recorded_exposure: bool = False
    flood: FloodMedium | None = None
    flood_level_z_m: float | None = None
    shows_water: bool = False
    snow: PlacedSnow | None = None
    finds_boxes: bool = False
    snowless_buffers: frozenset[str] = frozenset()
    bare_buffers: frozenset[str] = frozenset()
    style: Style | None = None
    styles_picture: bool = False

    @property
    def smog(self) -> SmogMedium | None:
        """The smog in front of the sky, whichever way it reaches the splats."""
        return self.smog_in_splats or self.smog_on_buffers

    def as_dict(self) -> dict[str, object]:
        """For machines: buffers sorted, one entry a step."""
        return {
            "buffers": sorted(self.buffers),
            "bare_buffers": sorted(self.bare_buffers),
            "steps": [{"name": s.name, "runs": s.runs, "why": s.why} for s in self.steps],
        }


def make_plan(recipe: Recipe, scene: Scene) -> Plan:
    """The passes that `recipe` requires of `scene`.

    Raises:
        SceneError: the recipe needs a fact that the scene does not know (the road's height).
        RecipeError: the recipe's quality has still to choose its settings.
    """
    if recipe.quality.is_open:
        raise RecipeError(
            f"recipe {recipe.name}, variant {recipe.variant}: quality {recipe.quality.words} has "
            f"still to choose its settings in view of a scene, as jobs do; settle the recipe first "
            f"(augment.quality.settle)"
        )
    flood, flood_reason = place_flood(recipe, scene)
    level_z_m = None if flood is None else flood.level_z_m
    if flood is not None and not gaussians_below(scene, flood.level_z_m):
        flood, flood_reason = None, f"no splat reaches below the level, z = {flood.level_z_m:.2f} m"
    snow, snow_reason = place_snow(recipe, scene, level_z_m)
    smog, smog_reason = place_smog(recipe, scene)
    style, style_reason = place_style(recipe)
    styles_picture = style is not None and style.applied_to == "picture"
    per_gaussian = recipe.weather.smog is not None and recipe.weather.smog.model == "per_gaussian"
    depth_buffer = DEPTH_ESTIMATORS.get(recipe.output.depth)
    wants_boxes = recipe.output.labels or recipe.output.instance
    finds_boxes = wants_boxes and scene.labels is not None
    for_images = {ALPHA, depth_buffer} if depth_buffer else set[str]()
    if recipe.output.semantic or recipe.output.instance:
        for_images |= {ALPHA, SPLAT_IDS}
    if recipe.output.instance and finds_boxes and not depth_buffer:
        for_images.add(EXPECTED_DEPTH)
    snowless, bare_buffers = {RGB, ALPHA} | for_images, set[str]()
    if snow is not None and recipe.output.surface == "scene":
        snowless, bare_buffers = {RGB, ALPHA}, for_images
    if (smog and not per_gaussian) or (finds_boxes and depth_buffer not in snowless):
        snowless.add(EXPECTED_DEPTH)
    buffers = snowless | {SNOW} if snow is not None else set(snowless)
    settings = RasterSettings(
        near_m=recipe.render.near_m,
        alpha_max=recipe.render.alpha_max,
        antialiased=recipe.render.antialiased,
        sh_degree=recipe.render.sh_degree,
        transmittance_stop=recipe.render.transmittance_stop,
        radius_clip_px=recipe.render.radius_clip_px,
    )
    exposure = _exposure_step(recipe, scene)
    actors = f"background and {len(scene.actors)} actors posed at the camera's timestamp"
    return Plan(
        settings=settings,
        buffers=frozenset(buffers),
        snowless_buffers=frozenset(snowless),
        smog_in_splats=smog if per_gaussian else None,
        smog_on_buffers=None if per_gaussian else smog,
        depth_buffer=depth_buffer,
        semantic=recipe.output.semantic,
        instance=recipe.output.instance,
        recorded_exposure=exposure.runs,
        flood=flood,
        flood_level_z_m=level_z_m,
        shows_water=flood is not None and recipe.output.surface == "first",
        snow=snow,
        finds_boxes=finds_boxes,
        bare_buffers=frozenset(bare_buffers),
        style=style,
        styles_picture=styles_picture,
        steps=(
            _style_step("on the scene", style, not styles_picture, style_reason),
            *_snow_steps(snow, snow_reason, bare_buffers),
            Step("rasterise", True, f"{actors}; buffers {', '.join(sorted(buffers))}"),
            _smog_step("per Gaussian", smog, per_gaussian, smog_reason),
            _smog_step("on buffers", smog, not per_gaussian, smog_reason),
            _sky_step(smog),
            *_flood_steps(flood, flood_reason),
            _style_step("on the picture", style, styles_picture, style_reason),
            exposure,
            Step(
                "depth image",
                depth_buffer is not None,
                f"output.depth is {recipe.output.depth!r}",
            ),
            Step("semantic image", recipe.output.semantic, _asked("semantic", recipe)),
            Step("instance image", recipe.output.instance, _asked("instance", recipe)),
        ),
    )


def _style_step(how: str, style: Style | None, chosen: bool, reason: str) -> Step:
    """On the scene it takes no pass of its own: splats are mapped as they are projected, or were
    once for all views.
    """
    if style is not None and not chosen:
        reason = f"style.applied_to is {style.applied_to!r}"
    elif style is not None and how == "on the scene":
        maps = "a map for every region" if style.per_region else "one map for all splats"
        when = {
            "color": "applied as they are projected",
            "sh": "folded into the background's SH once, applied to actors as they are projected",
        }[style.evaluated]
        reason += f", {maps}, {when}; snow and water keep their colours"
    return Step(f"style {how}", style is not None and chosen, reason)


def _smog_step(how: str, smog: SmogMedium | None, chosen: bool, reason: str) -> Step:
    if smog is not None and not chosen:
        reason = "weather.smog.model chooses the other way"
    return Step(f"smog {how}", smog is not None and chosen, reason)


def _sky_step(smog: SmogMedium | None) -> Step:
    if smog is None:
        return Step("sky", True, "sampled behind the splats")
    if smog.scale_height_m is None:
        return Step("sky", False, "uniform smog hides it: the airlight colour stands for it")
    return Step("sky", True, "sampled, then faded through the smog up to infinity")


def _flood_steps(flood: FloodMedium | None, reason: str) -> tuple[Step, ...]:
    """What runs does so in views that the water's plane reaches; the others are drawn as ever."""
    if flood is None:
        names = ("flood: waves", "flood: bed", "flood: mirrored view", "flood: screen march")
        return tuple(Step(name, False, reason) for name in names)
    waves, tier = len(flood.waves.amplitudes_m), flood.reflection
    mirrored = {
        "sky": "reflection 'sky' shows no scene",
        "screen_space": "at a quarter of the resolution, for what the screen does not show",
        "mirrored": "at full resolution",
    }
    return (
        Step("flood: waves", waves > 0, reason if waves else "the surface is still"),
        Step("flood: bed", True, f"{reason}; splats are cut at the surface"),
        Step("flood: mirrored view", tier != "sky", mirrored[tier]),
        Step("flood: screen march", tier == "screen_space", f"reflection is {tier!r}"),
    )


def _snow_steps(snow: PlacedSnow | None, reason: str, bare_buffers: set[str]) -> tuple[Step, ...]:
    """Placement runs once for all views of a scene, and the layer is laid once for each recipe."""
    if snow is None:
        names = ("snow: placement and layer", "snow: light per pixel", "snow: bare surface")
        return tuple(Step(name, False, reason) for name in names)
    per_pixel = snow.snow.shading == "per_pixel"
    bare = f"output.surface is 'scene': {', '.join(sorted(bare_buffers))} of the bare scene"
    return (
        Step("snow: placement and layer", True, reason),
        Step("snow: light per pixel", per_pixel, f"shading is {snow.snow.shading!r}"),
        Step(
            "snow: bare surface",
            bool(bare_buffers),
            bare if bare_buffers else "no image shows the surface under the snow",
        ),
    )


def _exposure_step(recipe: Recipe, scene: Scene) -> Step:
    name = "camera colour map"
    mapped = scene.mapped_cameras
    if not mapped:
        return Step(name, False, "the scene's cameras record the scene's own colours")
    if recipe.render.exposure == "neutral":
        return Step(name, False, "render.exposure is 'neutral'")
    why = f"{len(mapped)} of {len(scene.camera_names)} cameras have one, applied after the weather"
    return Step(name, True, why)


def _asked(name: str, recipe: Recipe) -> str:
    return f"output.{name} is {str(getattr(recipe.output, name)).lower()}"
