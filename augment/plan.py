"""Recipe + scene -> exactly the passes and buffers that the picture requires, before rendering.

A plan is made of plain facts, so it can be printed, compared and tested. `plan_view` leaves out
what one camera cannot see, without changing a bit of what is written; `views` carries it out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from augment import effects
from augment.base_photo import RECORDED, check_base
from augment.bounds import actor_boxes, owners_seen
from augment.cameras import Camera
from augment.effects.effect import DRAWING, PICTURE, SCENE, Active, Effect, Placed, Sight, Step
from augment.lod import check_background
from augment.prune import pruned_share
from augment.render.buffers import ALPHA, AUTO, DEPTH_ESTIMATORS, EXPECTED_DEPTH, RGB, SPLAT_IDS
from augment.render.constants import RasterSettings
from augment.scene import Scene
from recipes.errors import RecipeError
from recipes.schema import Recipe, Sensor

LENS, NOISE = "lens blur", "sensor noise"  # the last passes of all
BARE = "bare surface"  # the pass that draws the scene without what lies on it


@dataclass(frozen=True)
class Plan:
    """What rendering one view under a recipe takes.

    placed: every effect in the scene, by name. buffers: asked of the rasteriser, by all effects
    together; image_buffers: of them, those for the picture, the images and the boxes. bare_buffers:
    what depth, semantic and instance images take from a render of the scene without what lies on
    it; empty where they show it. depth_buffer: written as depth. shows_first: these images show
    what a ray meets first, such as water, not the scene under it. finds_boxes: labels or instance
    images need the depth of the solid surfaces. recorded_exposure: cameras' colour maps apply to
    the finished picture. on_photo: the recorded image stays the picture, and the scene supplies the
    weather. sensor, seed: of the recipe. steps: every pass considered, in order.
    """

    placed: Mapping[str, Placed]
    settings: RasterSettings
    prune: float
    buffers: frozenset[str]
    image_buffers: frozenset[str]
    bare_buffers: frozenset[str]
    depth_buffer: str | None
    semantic: bool
    instance: bool
    shows_first: bool
    finds_boxes: bool
    recorded_exposure: bool
    on_photo: bool
    sensor: Sensor
    seed: int
    steps: tuple[Step, ...]

    @property
    def water_level_z_m(self) -> float | None:
        """Of water that is drawn, scene world."""
        levels = (p.water_level_z_m for p in self.placed.values() if p.data is not None)
        return next((level for level in levels if level is not None), None)

    def active(self, scene: Scene, *, backend: str = AUTO) -> tuple[Active, ...]:
        """The effects that change anything, in the order in which they are applied."""
        found: tuple[Active, ...] = ()
        for effect in effects.EFFECTS:
            data = self.placed[effect.name].data
            if data is not None:
                found = (*found, Active(effect, data, scene, backend, found))
        return found

    def without(self, names: Iterable[str]) -> Plan:
        """The plan as if these effects changed nothing."""
        left_out = {name: replace(self.placed[name], data=None) for name in names}
        return replace(self, placed={**self.placed, **left_out})

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
        SceneError: the recipe needs what the scene does not have (the road's height, photos).
        RecipeError: the recipe's quality has still to choose its settings.
    """
    if recipe.quality.is_open:
        raise RecipeError(
            f"recipe {recipe.name}, variant {recipe.variant}: quality {recipe.quality.words} has "
            f"still to choose its settings in view of a scene, as jobs do; settle the recipe first "
            f"(augment.jobs.quality)"
        )
    check_base(recipe, scene)
    if any(effect.reads_splats(recipe) for effect in effects.EFFECTS):
        check_background(scene.background)
    placed = dict[str, Placed]()
    for effect in reversed(effects.EFFECTS):  # what comes later may cover what comes before
        placed[effect.name] = effect.place(recipe, scene, placed)
    placed = {effect.name: placed[effect.name] for effect in effects.EFFECTS}
    output, render = recipe.output, recipe.render
    depth_buffer = DEPTH_ESTIMATORS.get(output.depth)
    finds_boxes = bool(output.labels or output.instance) and scene.labels is not None
    for_images = {ALPHA, depth_buffer} if depth_buffer else set[str]()
    if output.semantic or output.instance:
        for_images |= {ALPHA, SPLAT_IDS}
    if output.instance and finds_boxes and not depth_buffer:
        for_images.add(EXPECTED_DEPTH)
    image_buffers, bare_buffers = {RGB, ALPHA} | for_images, set[str]()
    if output.surface == "scene" and _is_covered(effects.EFFECTS, placed):
        image_buffers, bare_buffers = {RGB, ALPHA}, for_images
    if finds_boxes and depth_buffer not in image_buffers:
        image_buffers.add(EXPECTED_DEPTH)
    own = (p.buffers for p in placed.values() if p.data is not None)
    buffers = frozenset(image_buffers).union(*own)
    exposure = _exposure_step(recipe, scene)
    return Plan(
        placed=placed,
        settings=RasterSettings(
            near_m=render.near_m,
            alpha_max=render.alpha_max,
            antialiased=render.antialiased,
            sh_degree=render.sh_degree,
            transmittance_stop=render.transmittance_stop,
            radius_clip_px=render.radius_clip_px,
            fog_cut=render.fog_cut,
            lod_px=render.lod_px,
        ),
        prune=pruned_share(render),
        buffers=buffers,
        image_buffers=frozenset(image_buffers),
        bare_buffers=frozenset(bare_buffers),
        depth_buffer=depth_buffer,
        semantic=output.semantic,
        instance=output.instance,
        shows_first=output.surface == "first",
        finds_boxes=finds_boxes,
        recorded_exposure=exposure.runs,
        on_photo=recipe.render.base == RECORDED,
        sensor=recipe.camera,
        seed=recipe.seed,
        steps=_all_steps(recipe, scene, placed, buffers, bare_buffers, exposure),
    )


def _all_steps(
    recipe: Recipe,
    scene: Scene,
    placed: Mapping[str, Placed],
    buffers: Iterable[str],
    bare_buffers: Iterable[str],
    exposure: Step,
) -> tuple[Step, ...]:
    """The effects' passes among those that there are without them."""

    def of_effects(stage: str) -> list[Step]:
        return [step for p in placed.values() for step in p.steps if step.stage == stage]

    output, bare = recipe.output, ", ".join(sorted(bare_buffers))
    actors = f"background and {len(scene.actors)} actors posed at the camera's timestamp"
    drawing = of_effects(DRAWING)
    if not any(step.name == "sky" for step in drawing):
        drawing.append(Step("sky", True, "sampled behind the splats"))
    without = "no image shows the scene without what lies on it"
    if bare:
        without = f"output.surface is 'scene': {bare} of the scene without what lies on it"
    return (
        *of_effects(SCENE),
        Step("rasterise", True, f"{actors}; buffers {', '.join(sorted(buffers))}"),
        _photo_step(recipe),
        *drawing,
        Step(BARE, bool(bare), without),
        *of_effects(PICTURE),
        exposure,
        Step(LENS, recipe.camera.psf_px > 0, f"camera.psf_px is {recipe.camera.psf_px:g}"),
        Step(NOISE, recipe.camera.noise > 0, f"camera.noise is {recipe.camera.noise:g}"),
        Step("depth image", output.depth != "none", f"output.depth is {output.depth!r}"),
        Step("semantic image", output.semantic, _asked("semantic", recipe)),
        Step("instance image", output.instance, _asked("instance", recipe)),
        Step("trust mask", output.trust, _asked("trust", recipe)),
    )


def _is_covered(listed: Iterable[Effect], placed: Mapping[str, Placed]) -> bool:
    return any(e.lies_on_scene and placed[e.name].data is not None for e in listed)


def _photo_step(recipe: Recipe) -> Step:
    base = recipe.render.base
    why = f"render.base is {base!r}"
    if base == RECORDED:
        why += ": the recorded image is the picture, edges of the weather move to its own"
    return Step("photo", base == RECORDED, why)


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


# ---- The plan of one view ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """What rendering one camera's image takes.

    actors: instance ids (1 + index in the scene) of those drawn. effects: that can be seen, in the
    order in which they are applied. buffers, bare_buffers: as those of Plan. steps: the plan's,
    each with this camera's reason.
    """

    actors: tuple[int, ...]
    effects: tuple[Active, ...]
    buffers: frozenset[str]
    bare_buffers: frozenset[str]
    steps: tuple[Step, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(own.effect.name for own in self.effects)

    def skipping(self, reasons: Mapping[str, str]) -> ViewPlan:
        """The same view, of which drawing has shown that some passes are needless."""
        return replace(self, steps=_skip(self.steps, reasons)) if reasons else self


def plan_view(plan: Plan, scene: Scene, camera: Camera, *, backend: str = AUTO) -> ViewPlan:
    """The parts, passes and buffers of the plan that the camera's image can show.

    The first call for a scene bounds its actors, and prepares the effects that ask what of them a
    camera can see.

    Raises:
        SceneError: an effect cannot be placed in this scene.
    """
    active = plan.active(scene, backend=backend)
    looking = [c for own in active for c in own.effect.cameras(own, camera) or ()]
    cameras = tuple(looking) or (camera,)
    poses = scene.poses_at(camera.timestamp_ns)
    sight = Sight(camera, cameras, {0: np.eye(4), **poses}, plan.settings.near_m)
    drawn = owners_seen(actor_boxes(scene), poses, cameras, plan.settings.near_m)
    seen, skipped = list[Active](), dict[str, str]()
    for own in active:
        found = own.effect.in_view(own, sight)
        skipped |= found.skipped
        if found.is_seen:
            drawn |= found.owners
            seen.append(replace(own, seen=found.seen))
    own_buffers = (plan.placed[own.effect.name].buffers for own in seen)
    buffers, bare_buffers = plan.image_buffers.union(*own_buffers), plan.bare_buffers
    layered = cameras != (camera,)  # then even the picture of the bare scene is another one
    if bare_buffers and not layered and not any(own.effect.lies_on_scene for own in seen):
        buffers, bare_buffers = buffers | bare_buffers, frozenset[str]()
        skipped[BARE] = "nothing that lies on the scene can be in view"
    actors = (
        f"background and {len(drawn)} of {len(scene.actors)} actors "
        f"({len(scene.actors) - len(poses)} absent at this time, "
        f"{len(poses) - len(drawn)} out of view); buffers {', '.join(sorted(buffers))}"
    )
    steps = _skip(plan.steps, skipped)
    return ViewPlan(
        actors=tuple(sorted(drawn)),
        effects=tuple(seen),
        buffers=buffers,
        bare_buffers=bare_buffers,
        steps=tuple(replace(s, why=actors) if s.name == "rasterise" else s for s in steps),
    )


def _skip(steps: Iterable[Step], skipped: Mapping[str, str]) -> tuple[Step, ...]:
    """The steps; those that would run but are skipped have that reason."""
    return tuple(
        replace(s, runs=False, why=skipped[s.name]) if s.runs and s.name in skipped else s
        for s in steps
    )
