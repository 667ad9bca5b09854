"""Plan of the passes and buffers that a picture requires, made before rendering.

In: a recipe and a scene. Out: a `Plan` for all views, and for each camera a `ViewPlan` that leaves
out what the camera cannot see, without changing a bit of what is written. Both are made of plain
facts, so they can be printed, compared and tested. `augment.view.render_view` carries them out;
`climategs explain` prints their steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from augment import effects
from augment.detail.lod import check_background
from augment.detail.prune import prune_error_of
from augment.effects.effect import (
    DRAWING,
    PICTURE,
    SCENE,
    Effect,
    EffectInScene,
    EffectPlan,
    Step,
    ViewQuery,
)
from augment.light.cast_shadows import shadows_of
from augment.light.sky_gloss import find_sky_gloss
from augment.photo.recorded_base import check_base
from augment.render.buffers import ALPHA, AUTO, DEPTH_ESTIMATORS, EXPECTED_DEPTH, RGB, SPLAT_IDS
from augment.render.constants import RasterSettings
from augment.scene.bounds import actor_boxes, find_visible_owners
from augment.scene.cameras import Camera
from augment.scene.pinhole_scene import pinhole_scene
from augment.scene.pinhole_views import covering_camera
from augment.scene.scene import Scene
from augment.scene.scene_times import scene_times
from recipes.errors import RecipeError
from recipes.schema import Recipe, Sensor

# Name of the pass that blurs the finished picture as a lens does.
LENS_BLUR_PASS = "lens blur"
# Name of the pass that adds sensor noise, the last one of all.
SENSOR_NOISE_PASS = "sensor noise"
# Name of the pass that fades the cast shadows on the ground.
SHADOW_PASS = "cast shadows"
# Name of the pass that turns the blue sky in glossy surfaces grey.
GLOSS_PASS = "gloss of a clear day"
# Name of the pass that renders the scene without what lies on it.
BARE_SURFACE_PASS = "bare surface"


@dataclass(frozen=True)
class Plan:
    """Passes and buffers of one recipe in one scene, for all views."""

    effect_plans: Mapping[str, EffectPlan]
    """Plan of every effect in the scene, by effect name."""
    settings: RasterSettings
    """Settings of the rasteriser."""
    prune: float
    """Share of white by which a recorded view may change when splats are left out
    (`augment.detail.prune`); 0 leaves none out."""
    buffers: frozenset[str]
    """Buffers that the rasteriser computes, for all effects together."""
    image_buffers: frozenset[str]
    """Those of `buffers` that the picture, the images and the boxes need."""
    bare_buffers: frozenset[str]
    """Buffers of the scene without what lies on it, for depth, semantic and instance images; empty
    where these show what lies on it."""
    depth_buffer: str | None
    """Name of the buffer that is written as depth; None without a depth image."""
    has_semantic: bool
    """If True, a semantic image is written."""
    has_instance: bool
    """If True, an instance image is written."""
    shows_first_hit: bool
    """If True, those images show the first thing that a ray meets, such as water; else the scene
    under it."""
    finds_boxes: bool
    """If True, labels or instance images need the depth of the solid surfaces."""
    uses_recorded_exposure: bool
    """If True, the cameras' colour maps are applied to the finished picture."""
    uses_common_exposure: bool
    """If True, the colours that effects add look as by the mean of all colour maps."""
    is_on_photo: bool
    """If True, the recorded image stays the picture, and the scene supplies the weather."""
    covers_own_car: bool
    """If True, snow lies on the recording car in a recorded image; else the car stays dry."""
    sun_share: float
    """Share of the sun's light that arrives at the ground; 1 leaves cast shadows as they are."""
    gloss_fade: float
    """How much of the blue sky in glossy surfaces turns grey, 0 to 1."""
    sensor: Sensor
    """Lens and sensor of the recipe."""
    seed: int
    """Seed of the recipe."""
    steps: tuple[Step, ...]
    """Every pass considered, in order."""
    weather_time_s: float = 0.0
    """Time of the weather at the image, seconds: the wind has moved its fields for as long."""

    @property
    def water_level_z_m(self) -> float | None:
        """Return the height of the water that is drawn, scene world; None without water."""
        levels = (p.water_level_z_m for p in self.effect_plans.values() if p.data is not None)
        return next((level for level in levels if level is not None), None)

    def active_effects(self, scene: Scene, *, backend: str = AUTO) -> tuple[EffectInScene, ...]:
        """Return the effects that change anything, in the order in which they are applied.

        Args:
            scene: the scene.
            backend: the rasteriser's backend.
        """
        active_effects: tuple[EffectInScene, ...] = ()
        for effect in effects.EFFECTS:
            data = self.effect_plans[effect.name].data
            if data is not None:
                active_effects = (
                    *active_effects,
                    EffectInScene(
                        effect,
                        data,
                        scene,
                        backend,
                        active_effects,
                        weather_time_s=self.weather_time_s,
                    ),
                )
        return active_effects

    def without_effects(self, names: Iterable[str]) -> Plan:
        """Return the plan as if the named effects changed nothing."""
        idle_plans = {name: replace(self.effect_plans[name], data=None) for name in names}
        return replace(self, effect_plans={**self.effect_plans, **idle_plans})

    def as_dict(self) -> dict[str, object]:
        """Return the plan for machines: buffers sorted, one entry a step."""
        return {
            "buffers": sorted(self.buffers),
            "bare_buffers": sorted(self.bare_buffers),
            "steps": [{"name": s.name, "runs": s.runs, "why": s.why} for s in self.steps],
        }


def plan_at(recipe: Recipe, scene: Scene, timestamp_ns: int) -> tuple[Recipe, Plan]:
    """Return the recipe at the time of an image, and the passes that it requires of the scene.

    Args:
        recipe: the recipe, in which values may change over time.
        scene: the scene.
        timestamp_ns: time of the image.

    Raises:
        SceneError: the recipe needs what the scene does not have.
        RecipeError: a timeline goes beyond the drive, or the quality is open.
    """
    times = scene_times(scene)
    time_s = recipe.weather_time_s(times, timestamp_ns)
    recipe = recipe.at_weather_time(times, time_s)
    return recipe, make_plan(recipe, scene, weather_time_s=time_s)


def check_plans(recipe: Recipe, scene: Scene) -> None:
    """Refuse a recipe that is impossible in a scene at any time of its drive.

    Raises:
        SceneError: the recipe needs what the scene does not have.
        RecipeError: a timeline goes beyond the drive, or the quality is open.
    """
    for state in recipe.over_time(scene_times(scene)):
        make_plan(state, scene)


def make_plan(recipe: Recipe, scene: Scene, *, weather_time_s: float = 0.0) -> Plan:
    """Return the passes that `recipe` requires of `scene`.

    Args:
        recipe: the recipe at the time of an image (`plan_at`).
        scene: the scene.
        weather_time_s: time of the weather at that image, seconds.

    Raises:
        SceneError: the recipe needs what the scene does not have (the road's height, photos).
        RecipeError: the recipe's quality has still to choose its settings.
    """
    if recipe.has_open_choice:
        raise RecipeError(
            f"recipe {recipe.name}, variant {recipe.variant}: quality {recipe.quality.summary} has "
            f"still to choose its settings for a scene, as jobs do; resolve its quality first "
            f"(augment.view.quality)"
        )
    check_base(recipe, scene)
    if any(effect.reads_splats(recipe) for effect in effects.EFFECTS):
        check_background(scene.background)
    effect_plans = dict[str, EffectPlan]()
    for effect in reversed(effects.EFFECTS):  # later effects may cover earlier ones
        effect_plans[effect.name] = effect.plan_in_scene(recipe, scene, effect_plans)
    effect_plans = {effect.name: effect_plans[effect.name] for effect in effects.EFFECTS}
    output = recipe.output
    render = recipe.render
    depth_buffer = DEPTH_ESTIMATORS.get(output.depth)
    finds_boxes = bool(output.labels or output.instance) and scene.labels is not None
    label_buffers = {ALPHA, depth_buffer} if depth_buffer else set[str]()
    if output.semantic or output.instance:
        label_buffers |= {ALPHA, SPLAT_IDS}
    if output.instance and finds_boxes and not depth_buffer:
        label_buffers.add(EXPECTED_DEPTH)
    image_buffers = {RGB, ALPHA} | label_buffers
    bare_buffers = set[str]()
    if output.surface == "scene" and _is_covered(effects.EFFECTS, effect_plans):
        image_buffers = {RGB, ALPHA}
        bare_buffers = label_buffers
    if finds_boxes and depth_buffer not in image_buffers:
        image_buffers.add(EXPECTED_DEPTH)
    sun_share, shadow_reason = _find_sun_share(recipe, scene)
    gloss_fade, gloss_reason = _find_gloss_fade(recipe, scene)
    if sun_share < 1 and render.is_on_recorded:  # depth says where a photo shows the ground
        image_buffers.add(EXPECTED_DEPTH)
    effect_buffers = (p.buffers for p in effect_plans.values() if p.data is not None)
    buffers = frozenset(image_buffers).union(*effect_buffers)
    exposure = _exposure_step(recipe, scene)
    return Plan(
        effect_plans=effect_plans,
        settings=RasterSettings(
            near_m=render.near_m,
            alpha_max=render.speed.alpha_max,
            antialiased=render.speed.antialiased,
            sh_degree=render.sh_degree,
            transmittance_stop=render.speed.transmittance_stop,
            radius_clip_px=render.speed.radius_clip_px,
            fog_cut=render.speed.fog_cut,
            lod_px=render.speed.lod_px,
        ),
        prune=prune_error_of(render),
        buffers=buffers,
        image_buffers=frozenset(image_buffers),
        bare_buffers=frozenset(bare_buffers),
        depth_buffer=depth_buffer,
        has_semantic=output.semantic,
        has_instance=output.instance,
        shows_first_hit=output.surface == "first",
        finds_boxes=finds_boxes,
        uses_recorded_exposure=exposure.runs,
        uses_common_exposure=exposure.runs and recipe.render.exposure == "common",
        is_on_photo=recipe.render.is_on_recorded,
        covers_own_car=recipe.render.is_on_recorded and recipe.render.own_car == "snowy",
        sun_share=sun_share,
        gloss_fade=gloss_fade,
        sensor=recipe.camera,
        seed=recipe.seed,
        steps=(
            Step(SHADOW_PASS, sun_share < 1, shadow_reason, SCENE),
            Step(GLOSS_PASS, gloss_fade > 0, gloss_reason, SCENE),
            *_all_steps(recipe, scene, effect_plans, buffers, bare_buffers, exposure),
        ),
        weather_time_s=weather_time_s,
    )


def _find_sun_share(recipe: Recipe, scene: Scene) -> tuple[float, str]:
    """Return the share of the sun's light that all effects let through, and the reason.

    It is 1 where the ground shows no cast shadows.
    """
    shares = [effect.sun_share(recipe, scene) for effect in effects.EFFECTS]
    share = math.prod(share for share, _ in shares)
    if share == 1:
        return 1.0, "no effect keeps the sun's light from the ground"
    shadows = shadows_of(scene)
    if shadows is None or shadows.certainty == 0:
        return 1.0, "the ground shows no shadows of a sun"
    reasons = "; ".join(reason for other, reason in shares if other < 1)
    return share, (
        f"shadows have {shadows.luminance_ratio:.2f} of the light beside them; {reasons}"
    )


def _find_gloss_fade(recipe: Recipe, scene: Scene) -> tuple[float, str]:
    """Return how much of the blue sky in glossy surfaces turns grey, and the reason.

    It is 0 where the scene's sky is not blue.
    """
    shares = [effect.gloss_share(recipe, scene) for effect in effects.EFFECTS]
    share = math.prod(share for share, _ in shares)
    if share == 1:
        return 0.0, "no effect hides the blue sky"
    gloss = find_sky_gloss(scene)
    if gloss is None:
        return 0.0, "the scene has no blue sky, or no classes"
    reasons = "; ".join(reason for other, reason in shares if other < 1)
    return 1 - share, f"the sky has a saturation of {gloss.saturation:.2f}; {reasons}"


def _all_steps(
    recipe: Recipe,
    scene: Scene,
    effect_plans: Mapping[str, EffectPlan],
    buffers: Iterable[str],
    bare_buffers: Iterable[str],
    exposure: Step,
) -> tuple[Step, ...]:
    """Return the effects' passes among the passes that every recipe has, in order."""

    def steps_of_effects(stage: str) -> list[Step]:
        return [step for p in effect_plans.values() for step in p.steps if step.stage == stage]

    output = recipe.output
    bare = ", ".join(sorted(bare_buffers))
    raster_reason = f"background and {len(scene.actors)} actors posed at the camera's timestamp"
    drawing_steps = steps_of_effects(DRAWING)
    if not any(step.name == "sky" for step in drawing_steps):
        drawing_steps.append(Step("sky", True, "sampled behind the splats"))
    bare_reason = "no image shows the scene without what lies on it"
    if bare:
        bare_reason = f"output.surface is 'scene': {bare} of the scene without what lies on it"
    return (
        *steps_of_effects(SCENE),
        Step("rasterise", True, f"{raster_reason}; buffers {', '.join(sorted(buffers))}"),
        _photo_step(recipe),
        *drawing_steps,
        Step(BARE_SURFACE_PASS, bool(bare), bare_reason),
        *steps_of_effects(PICTURE),
        exposure,
        Step(
            LENS_BLUR_PASS, recipe.camera.psf_px > 0, f"camera.psf_px is {recipe.camera.psf_px:g}"
        ),
        Step(
            SENSOR_NOISE_PASS, recipe.camera.noise > 0, f"camera.noise is {recipe.camera.noise:g}"
        ),
        Step("depth image", output.depth != "none", f"output.depth is {output.depth!r}"),
        _semantic_step(recipe, scene),
        Step("instance image", output.instance, _output_reason("instance", recipe)),
        Step("trust mask", output.trust, _output_reason("trust", recipe)),
    )


def _is_covered(candidates: Iterable[Effect], effect_plans: Mapping[str, EffectPlan]) -> bool:
    """Return True if an effect lies on the scene."""
    return any(e.adds_overlays and effect_plans[e.name].data is not None for e in candidates)


def _photo_step(recipe: Recipe) -> Step:
    """Return the pass that keeps the recorded image as the picture."""
    is_on_recorded = recipe.render.is_on_recorded
    why = f"render.base is {recipe.render.base!r}"
    if is_on_recorded:
        why += ": the recorded image is the picture, edges of the weather move to its own"
        why += f"; the recording car in it stays {recipe.render.own_car}"
    return Step("photo", is_on_recorded, why)


def _exposure_step(recipe: Recipe, scene: Scene) -> Step:
    """Return the pass that applies the cameras' colour maps."""
    name = "camera colour map"
    names = scene.color_mapped_cameras
    if not names:
        return Step(name, False, "the scene's cameras record the scene's own colours")
    if recipe.render.exposure == "neutral":
        return Step(name, False, "render.exposure is 'neutral'")
    why = f"{len(names)} of {len(scene.camera_names)} cameras have one, applied after the weather"
    if recipe.render.exposure == "common":
        why += ", whose own colours look as by the mean of all maps"
    return Step(name, True, why)


def _semantic_step(recipe: Recipe, scene: Scene) -> Step:
    """Return the pass that looks up the class of each pixel."""
    why = _output_reason("semantic", recipe)
    paints_boxes = recipe.output.instance and scene.labels is not None
    if paints_boxes and not recipe.output.semantic:
        why += ", but output.instance finds labelled boxes by their pixels' classes"
    return Step("semantic image", recipe.output.semantic or paints_boxes, why)


def _output_reason(name: str, recipe: Recipe) -> str:
    """Return the reason of a pass that an output of the recipe asks for."""
    return f"output.{name} is {str(getattr(recipe.output, name)).lower()}"


# ---- The plan of one view ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """Passes and buffers of one camera's image."""

    actor_ids: tuple[int, ...]
    """Instance ids (1 + index in the scene) of the actors to render."""
    effects: tuple[EffectInScene, ...]
    """Effects that can be seen, in the order in which they are applied."""
    buffers: frozenset[str]
    """Buffers that the rasteriser computes, as those of `Plan`."""
    bare_buffers: frozenset[str]
    """Buffers of the scene without what lies on it, as those of `Plan`."""
    steps: tuple[Step, ...]
    """Steps of the plan, each with this camera's reason."""

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Return the names of the effects."""
        return tuple(effect.hooks.name for effect in self.effects)

    def skip_steps(self, reasons: Mapping[str, str]) -> ViewPlan:
        """Return the plan without passes that rendering has shown to be needless.

        Args:
            reasons: why each such pass is needless, by its name.
        """
        return replace(self, steps=_skip(self.steps, reasons)) if reasons else self


def plan_view(plan: Plan, scene: Scene, camera: Camera, *, backend: str = AUTO) -> ViewPlan:
    """Return the parts, passes and buffers of the plan that the camera's image can show.

    The first call for a scene bounds its actors, and prepares the effects that ask what of them a
    camera can see.

    Args:
        plan: the plan of all views.
        scene: the scene.
        camera: the view, at the resolution to render. The plan of a camera with a lens is that of
            a pinhole that looks the same way; each of its views gets a plan of its own.
        backend: the rasteriser's backend.

    Raises:
        SceneError: an effect is not possible in this scene.
    """
    if not (camera.is_pinhole or camera.is_orthographic):
        scene = pinhole_scene(scene)
        camera = covering_camera(camera)
    active_effects = plan.active_effects(scene, backend=backend)
    effect_cameras = [
        effect_camera
        for effect in active_effects
        for effect_camera in effect.hooks.cameras(effect, camera) or ()
    ]
    cameras = tuple(effect_cameras) or (camera,)
    poses = scene.poses_at(camera.timestamp_ns)
    query = ViewQuery(camera, cameras, {0: np.eye(4), **poses}, plan.settings.near_m)
    owners = find_visible_owners(actor_boxes(scene), poses, cameras, plan.settings.near_m)
    effects_in_view = list[EffectInScene]()
    skip_reasons = dict[str, str]()
    for effect in active_effects:
        visibility = effect.hooks.visibility(effect, query)
        skip_reasons |= visibility.skip_reasons
        if visibility.is_visible:
            owners |= visibility.instance_ids
            effects_in_view.append(replace(effect, view_data=visibility.view_data))
    effect_buffers = (plan.effect_plans[effect.hooks.name].buffers for effect in effects_in_view)
    buffers = plan.image_buffers.union(*effect_buffers)
    bare_buffers = plan.bare_buffers
    is_layered = cameras != (camera,)  # then the picture differs even for a bare scene
    if (
        bare_buffers
        and not is_layered
        and not any(effect.hooks.adds_overlays for effect in effects_in_view)
    ):
        buffers = buffers | bare_buffers
        bare_buffers = frozenset[str]()
        skip_reasons[BARE_SURFACE_PASS] = "nothing that lies on the scene can be in view"
    raster_reason = (
        f"background and {len(owners)} of {len(scene.actors)} actors "
        f"({len(scene.actors) - len(poses)} absent at this time, "
        f"{len(poses) - len(owners)} out of view); buffers {', '.join(sorted(buffers))}"
    )
    steps = _skip(plan.steps, skip_reasons)
    return ViewPlan(
        actor_ids=tuple(sorted(owners)),
        effects=tuple(effects_in_view),
        buffers=buffers,
        bare_buffers=bare_buffers,
        steps=tuple(replace(s, why=raster_reason) if s.name == "rasterise" else s for s in steps),
    )


def _skip(steps: Iterable[Step], skip_reasons: Mapping[str, str]) -> tuple[Step, ...]:
    """Return the steps; steps that would run but have a reason to skip are skipped."""
    return tuple(
        replace(step, runs=False, why=skip_reasons[step.name])
        if step.runs and step.name in skip_reasons
        else step
        for step in steps
    )
