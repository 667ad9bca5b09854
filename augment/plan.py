"""Recipe + scene -> exactly the passes and buffers that the picture requires, before rendering.

A plan is made of plain facts, so it can be printed, compared and tested; `apply` carries it out.
"""

from __future__ import annotations

from dataclasses import dataclass

from augment.errors import SceneError
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, MEDIAN_DEPTH, RGB, SPLAT_IDS
from augment.render.constants import RasterSettings
from augment.scene import Scene
from augment.weather.smog import SmogMedium
from recipes.schema import Recipe

DEPTH_BUFFERS = {"median": MEDIAN_DEPTH, "expected": EXPECTED_DEPTH}


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

    @property
    def smog(self) -> SmogMedium | None:
        """The smog in front of the sky, whichever way it reaches the splats."""
        return self.smog_in_splats or self.smog_on_buffers

    def as_dict(self) -> dict[str, object]:
        """For machines: buffers sorted, one entry a step."""
        return {
            "buffers": sorted(self.buffers),
            "steps": [{"name": s.name, "runs": s.runs, "why": s.why} for s in self.steps],
        }


def make_plan(recipe: Recipe, scene: Scene) -> Plan:
    """The passes that `recipe` requires of `scene`.

    Raises:
        SceneError: the recipe needs a fact that the scene does not know (the road's height).
    """
    smog, smog_reason = place_smog(recipe, scene)
    per_gaussian = recipe.weather.smog is not None and recipe.weather.smog.model == "per_gaussian"
    depth_buffer = DEPTH_BUFFERS.get(recipe.output.depth)
    buffers = {RGB, ALPHA}
    if depth_buffer:
        buffers.add(depth_buffer)
    if smog and not per_gaussian:
        buffers.add(EXPECTED_DEPTH)
    if recipe.output.semantic or recipe.output.instance:
        buffers.add(SPLAT_IDS)
    settings = RasterSettings(
        near_m=recipe.render.near_m,
        alpha_max=recipe.render.alpha_max,
        antialiased=recipe.render.antialiased,
        sh_degree=recipe.render.sh_degree,
    )
    exposure = _exposure_step(recipe, scene)
    actors = f"background and {len(scene.actors)} actors posed at the camera's timestamp"
    return Plan(
        settings=settings,
        buffers=frozenset(buffers),
        smog_in_splats=smog if per_gaussian else None,
        smog_on_buffers=None if per_gaussian else smog,
        depth_buffer=depth_buffer,
        semantic=recipe.output.semantic,
        instance=recipe.output.instance,
        recorded_exposure=exposure.runs,
        steps=(
            Step("rasterise", True, f"{actors}; buffers {', '.join(sorted(buffers))}"),
            _smog_step("per Gaussian", smog, per_gaussian, smog_reason),
            _smog_step("on buffers", smog, not per_gaussian, smog_reason),
            _sky_step(smog),
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


def _exposure_step(recipe: Recipe, scene: Scene) -> Step:
    name = "camera colour map"
    mapped = sum(scene.color_map(camera) is not None for camera in scene.camera_names)
    if mapped == 0:
        return Step(name, False, "the scene's cameras record the scene's own colours")
    if recipe.render.exposure == "neutral":
        return Step(name, False, "render.exposure is 'neutral'")
    why = f"{mapped} of {len(scene.camera_names)} cameras have one, applied after the weather"
    return Step(name, True, why)


def _asked(name: str, recipe: Recipe) -> str:
    return f"output.{name} is {str(getattr(recipe.output, name)).lower()}"
