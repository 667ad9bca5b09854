"""Recipe + scene -> exactly the passes and buffers that the picture requires, before rendering.

A plan is made of plain facts, so it can be printed, compared and tested. `plan_view` leaves out
what one camera cannot see, without changing a bit of what is written; `views` carries it out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Int64

from augment.cameras import Camera
from augment.effects.flood.flood import FloodMedium
from augment.effects.flood.flood_view import COARSE, MAX_MARGIN, MAX_SHIFT
from augment.effects.flood.water_plane import mirrored_camera, plane_window
from augment.effects.flood.waves import make_waves
from augment.effects.snow.near_camera import SIZE_M, Layer, SnowLayers
from augment.effects.snow.snow import PlacedSnow, snow_layers_of
from augment.effects.style.style import scene_style_of
from augment.errors import SceneError
from augment.geometry import rotmat_from_quat
from augment.ground import check_metric_and_level, ground_of
from augment.render.buffers import (
    ALPHA,
    AUTO,
    DEPTH_ESTIMATORS,
    EXPECTED_DEPTH,
    OVERLAY,
    RGB,
    SPLAT_IDS,
)
from augment.render.constants import ALPHA_MIN, MAX_EXTENT_SIGMAS, TAN_FOV_MARGIN, RasterSettings
from augment.render.fog import Fog
from augment.scene import Actor, Gaussians, Scene
from recipes.errors import RecipeError
from recipes.schema import Recipe
from recipes.weather import Style

# ---- A recipe's weather placed in a scene --------------------------------------------------------

MIN_DEPTH_M = 0.05  # waves run in at least this much water


def place_style(recipe: Recipe) -> tuple[Style | None, str]:
    """The recipe's style, or None where it would change nothing; and why."""
    style = recipe.style
    if style is None:
        return None, "the recipe has no style"
    if not style.changes:
        return None, "the style has no strength, so it changes nothing"
    source = f"preset {style.preset!r}" if style.preset else f"image {Path(style.image or '').name}"
    return style, f"{style.method} from {source} at strength {style.strength:g}"


def place_smog(recipe: Recipe, scene: Scene) -> tuple[Fog | None, str]:
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
    return Fog(smog.sigma_per_m, smog.color, smog.scale_height_m, base_z_m), reason


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
    depth_m = max(level_z_m - ground.lowest_z_m, MIN_DEPTH_M)
    medium = FloodMedium(
        level_z_m=level_z_m,
        extinction_per_m=flood.extinction_per_m_rgb,
        rgb=flood.color,
        waves=make_waves(flood.waves, seed=recipe.seed, depth_m=depth_m),
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


def _lowest_z_m(scene: Scene) -> float:
    """Height below which no splat of the scene reaches at any time; found once per scene."""
    if scene not in _lowest_known:
        lows = [_lowest(scene.background), *(_lowest_of_actor(a) for a in scene.actors)]
        _lowest_known[scene] = min(lows)
    return _lowest_known[scene]


_lowest_known: WeakKeyDictionary[Scene, float] = WeakKeyDictionary()


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


# ---- The plan of a recipe for a scene ------------------------------------------------------------

WATER_PASSES = ("flood: waves", "flood: bed", "flood: mirrored view", "flood: screen march")
SNOW_PASSES = ("snow: placement and layer", "snow: light per pixel", "snow: bare surface")


@dataclass(frozen=True)
class Step:
    """One possible pass. why: the reason it runs, or the reason it does not."""

    name: str
    runs: bool
    why: str


@dataclass(frozen=True)
class Plan:
    """What rendering one view under a recipe takes.

    buffers: asked of the rasteriser. smog_in_splats: blended per Gaussian by the rasteriser;
    smog_on_buffers: applied to finished buffers; at most one is set. depth_buffer: written as
    depth. steps: every pass considered, in order. recorded_exposure: cameras' colour maps apply to
    the finished picture. shows_water: depth, semantic and instance images show the water's surface,
    not the scene under it. finds_boxes: labels or instance images need the depth of the solid
    surfaces, snow included. buffers_without_snow: replace buffers in views without snow.
    bare_buffers: what depth, semantic and instance images take from a render of the scene without
    its snow; empty where they show it. styles_picture: the style maps the finished picture, not the
    scene in it.
    """

    settings: RasterSettings
    buffers: frozenset[str]
    smog_in_splats: Fog | None
    smog_on_buffers: Fog | None
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
    buffers_without_snow: frozenset[str] = frozenset()
    bare_buffers: frozenset[str] = frozenset()
    style: Style | None = None
    styles_picture: bool = False

    @property
    def smog(self) -> Fog | None:
        """The smog in front of the sky, whichever way it reaches the splats."""
        return self.smog_in_splats or self.smog_on_buffers

    def as_dict(self) -> dict[str, object]:
        """For machines: buffers sorted, one entry a step."""
        return {
            "buffers": sorted(self.buffers),
            "bare_buffers": sorted(self.bare_buffers),
            "steps": [asdict(step) for step in self.steps],
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
            f"(augment.jobs.quality)"
        )
    output = recipe.output
    flood, flood_reason = place_flood(recipe, scene)
    level_z_m = None if flood is None else flood.level_z_m
    if flood is not None and _lowest_z_m(scene) >= flood.level_z_m:
        flood, flood_reason = None, f"no splat reaches below the level, z = {flood.level_z_m:.2f} m"
    snow, snow_reason = place_snow(recipe, scene, level_z_m)
    smog, smog_reason = place_smog(recipe, scene)
    style, style_reason = place_style(recipe)
    styles_picture = style is not None and style.applied_to == "picture"
    per_gaussian = recipe.weather.smog is not None and recipe.weather.smog.model == "per_gaussian"
    depth_buffer = DEPTH_ESTIMATORS.get(output.depth)
    wants_boxes = output.labels or output.instance
    finds_boxes = wants_boxes and scene.labels is not None
    for_images = {ALPHA, depth_buffer} if depth_buffer else set[str]()
    if output.semantic or output.instance:
        for_images |= {ALPHA, SPLAT_IDS}
    if output.instance and finds_boxes and not depth_buffer:
        for_images.add(EXPECTED_DEPTH)
    without_snow, bare_buffers = {RGB, ALPHA} | for_images, set[str]()
    if snow is not None and output.surface == "scene":
        without_snow, bare_buffers = {RGB, ALPHA}, for_images
    if (smog and not per_gaussian) or (finds_boxes and depth_buffer not in without_snow):
        without_snow.add(EXPECTED_DEPTH)
    buffers = without_snow | {OVERLAY} if snow is not None else set(without_snow)
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
        buffers_without_snow=frozenset(without_snow),
        smog_in_splats=smog if per_gaussian else None,
        smog_on_buffers=None if per_gaussian else smog,
        depth_buffer=depth_buffer,
        semantic=output.semantic,
        instance=output.instance,
        recorded_exposure=exposure.runs,
        flood=flood,
        flood_level_z_m=level_z_m,
        shows_water=flood is not None and output.surface == "first",
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
            Step("depth image", depth_buffer is not None, f"output.depth is {output.depth!r}"),
            Step("semantic image", output.semantic, _asked("semantic", recipe)),
            Step("instance image", output.instance, _asked("instance", recipe)),
        ),
    )


def _style_step(how: str, style: Style | None, chosen: bool, reason: str) -> Step:
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


def _smog_step(how: str, smog: Fog | None, chosen: bool, reason: str) -> Step:
    if smog is not None and not chosen:
        reason = "weather.smog.model chooses the other way"
    return Step(f"smog {how}", smog is not None and chosen, reason)


def _sky_step(smog: Fog | None) -> Step:
    if smog is None:
        return Step("sky", True, "sampled behind the splats")
    if smog.scale_height_m is None:
        return Step("sky", False, "uniform smog hides it: the airlight colour stands for it")
    return Step("sky", True, "sampled, then faded through the smog up to infinity")


def _flood_steps(flood: FloodMedium | None, reason: str) -> tuple[Step, ...]:
    if flood is None:
        return tuple(Step(name, False, reason) for name in WATER_PASSES)
    waves, tier = len(flood.waves.amplitudes_m), flood.reflection
    mirrored = {
        "sky": "reflection 'sky' shows no scene",
        "screen_space": "at a quarter of the resolution, for what the screen does not show",
        "mirrored": "at full resolution",
    }
    steps = (
        (waves > 0, reason if waves else "the surface is still"),
        (True, f"{reason}; splats are cut at the surface"),
        (tier != "sky", mirrored[tier]),
        (tier == "screen_space", f"reflection is {tier!r}"),
    )
    return tuple(Step(name, *step) for name, step in zip(WATER_PASSES, steps, strict=True))


def _snow_steps(snow: PlacedSnow | None, reason: str, bare_buffers: set[str]) -> tuple[Step, ...]:
    if snow is None:
        return tuple(Step(name, False, reason) for name in SNOW_PASSES)
    bare = "no image shows the surface under the snow"
    if bare_buffers:
        bare = f"output.surface is 'scene': {', '.join(sorted(bare_buffers))} of the bare scene"
    shading = snow.snow.shading
    steps = (
        (True, reason),
        (shading == "per_pixel", f"shading is {shading!r}"),
        (bool(bare_buffers), bare),
    )
    return tuple(Step(name, *step) for name, step in zip(SNOW_PASSES, steps, strict=True))


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


# ---- Whether Gaussians in a box can touch a camera's image ---------------------------------------
# A rasteriser draws a Gaussian if its mean lies at `near_m` or beyond and its splat's box touches
# the image. With g = MAX_EXTENT_SIGMAS sqrt(1 + w^2), w the largest tangent that the projection's
# Jacobian is clamped to, the splat of a Gaussian at depth z whose longest axis is s reaches at most
# fx g s / z + 2 px from its mean's place (the 2 px: its blur). So it lies left of the image where
#
#     fx x / z + cx + fx g s / z + 2 < 0,    that is    fx x + (cx + 2) z + fx g s < 0 :
#
# a half-space of the mean, and so are the other sides. A box of means that lies wholly in one of
# these, or before the near plane, shows nothing. For an orthographic camera, z drops out of the
# sides, and w is 0.

_BLUR_PX = 3.0  # 1.9 of it is the blur, the rest float32's rounding of pixels
_ROUNDING = 1e-5  # of all terms of a sum: a hundred times float32's


@dataclass(frozen=True, eq=False)
class Bounds:
    """B boxes along the axes of a part's frame that hold means. centres, halves: metres.

    longest: the largest standard deviation of a Gaussian in the box, metres. owners: instance ids
    of the parts, 0 for the background.
    """

    centres: Float[np.ndarray, "B 3"]
    halves: Float[np.ndarray, "B 3"]
    longest: Float[np.ndarray, "B"]
    owners: Int64[np.ndarray, "B"]

    def __len__(self) -> int:
        return len(self.longest)

    def select(self, rows: np.ndarray) -> Bounds:
        return Bounds(*(getattr(self, f.name)[rows] for f in fields(self)))

    @staticmethod
    def join(bounds: Iterable[Bounds]) -> Bounds:
        """All boxes, in their order."""
        nothing = Bounds(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
        each, names = [nothing, *bounds], [f.name for f in fields(Bounds)]
        return Bounds(*(np.concatenate([getattr(b, name) for b in each]) for name in names))


def bound(gaussians: Gaussians, owner: int = 0) -> Bounds:
    """One box around all that are opaque enough to be drawn; none where there are none."""
    return bound_chunks(gaussians, gaussians.opacities.detach().numpy() >= ALPHA_MIN, owner=owner)


def bound_chunks(
    gaussians: Gaussians, chosen: np.ndarray, side_m: float = math.inf, owner: int = 0
) -> Bounds:
    """Boxes around the chosen (bool [N]), one for each square of x and y that has any."""
    means = gaussians.means.detach().numpy()[chosen].astype(np.float64)
    longest = gaussians.scales.detach().numpy()[chosen].max(1, initial=0).astype(np.float64)
    return _bound_points(means, longest, side_m, owner)


def _bound_points(
    means: Float[np.ndarray, "N 3"], longest: Float[np.ndarray, "N"], side_m: float, owner: int
) -> Bounds:
    if len(means) == 0:
        return Bounds.join([])
    numbers = np.zeros(len(means), np.int64)
    if side_m < math.inf:
        squares = np.floor(means[:, :2] / side_m).astype(np.int64)
        numbers = np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(numbers, kind="stable")
    starts = np.flatnonzero(np.diff(numbers[order], prepend=-1))
    lows = np.minimum.reduceat(means[order], starts, axis=0)
    highs = np.maximum.reduceat(means[order], starts, axis=0)
    widest = np.maximum.reduceat(longest[order], starts)
    owners = np.full(len(starts), owner, np.int64)
    return Bounds((lows + highs) / 2, (highs - lows) / 2, widest, owners)


def may_show(
    bounds: Bounds, world_from_part: np.ndarray | None, camera: Camera, near_m: float
) -> Bool[np.ndarray, "B"]:
    """Whether a Gaussian of each box can touch the image; True where it is not known.

    world_from_part: float64, [4, 4] of all boxes or [B, 4, 4]; None for the identity.
    """
    camera_from_part = camera.camera_from_world.numpy()
    if world_from_part is not None:
        camera_from_part = camera_from_part @ world_from_part
    sides, offsets, reach = _half_spaces(camera, near_m)
    rotation, shift = camera_from_part[..., :3, :3], camera_from_part[..., :3, 3]
    axes = (sides @ rotation).reshape(-1, 5, 3)  # along the part's own axes, [1 or B, 5, 3]
    centres = (axes * bounds.centres[:, None]).sum(-1)
    extents = (np.abs(axes) * bounds.halves[:, None]).sum(-1)
    placed = shift @ sides.T + offsets
    most = centres + placed + extents + bounds.longest[:, None] * reach
    slack = _ROUNDING * (np.abs(centres) + np.abs(placed) + extents)
    return ~(most + slack < 0).any(-1)  # not `>=`: of NaN nothing is known


def _half_spaces(camera: Camera, near_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the camera's axes: sides [5, 3], offsets [5] and reach [5]. A Gaussian at p whose longest
    axis is s is not drawn where sides . p + offsets + reach s < 0 in any row.
    """
    focal = np.array([camera.fx, camera.fy])
    centre = np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height], np.float64)
    before, beyond = centre + _BLUR_PX, size - centre + _BLUR_PX  # px from the centre to the sides
    sides, offsets = np.zeros((5, 3)), np.zeros(5)
    sides[0, 2], offsets[0] = 1.0, -near_m
    sides[[1, 2], [0, 1]], sides[[3, 4], [0, 1]] = focal, -focal
    widest = np.zeros(2)
    if camera.is_orthographic:
        offsets[1:] = *before, *beyond
    else:
        sides[1:, 2] = *before, *beyond
        margin = TAN_FOV_MARGIN * 0.5 * size
        widest = (np.maximum(np.abs(centre), np.abs(size - centre)) + margin) / focal
    reach = MAX_EXTENT_SIGMAS * focal * np.sqrt(1 + widest**2)
    return sides, offsets, np.array([0.0, *reach, *reach])


# ---- The plan of one view ------------------------------------------------------------------------

_CHUNK_M = 8.0  # side of the squares that snow is bounded in
_SPARE_PX = 8.0  # of the margins in flood_view, and of the splats' blur at a coarse resolution


@dataclass(frozen=True)
class ViewPlan:
    """What rendering one camera's image takes.

    actors: instance ids (1 + index in the scene) of those drawn. snowy: of the parts whose snow is
    drawn, 0 for the ground. water: whether the water's plane can be in view. buffers, bare_buffers:
    as those of Plan. steps: the plan's, each with this camera's reason.
    """

    actors: tuple[int, ...]
    snowy: tuple[int, ...]
    water: bool
    buffers: frozenset[str]
    bare_buffers: frozenset[str]
    steps: tuple[Step, ...]

    @property
    def snow(self) -> bool:
        """Whether any snow can be in view."""
        return bool(self.snowy)

    def with_hidden_water(self) -> ViewPlan:
        """The same view once its front layer has shown that nothing of the water is to be seen."""
        why = "what stands before the water hides all of it"
        return replace(self, steps=_skip(self.steps, {name: why for name in WATER_PASSES}))


def plan_view(plan: Plan, scene: Scene, camera: Camera, *, backend: str = AUTO) -> ViewPlan:
    """The parts, passes and buffers of the plan that the camera's image can show.

    The first call for a scene bounds its actors; under snow, it also lays the snow
    (snow_layers_of), by `backend`.

    Raises:
        SceneError: snow cannot be placed in this scene.
    """
    water, skipped = plan.flood is not None, dict[str, str]()
    if plan.flood is not None and float(camera.centre[2]) <= plan.flood.level_z_m:
        why = "the camera is under water: it sees what lies below and what lies above"
        skipped |= {name: why for name in WATER_PASSES}
    elif plan.flood is not None and plane_window(camera, plan.flood.level_z_m) is None:
        water = False
        skipped |= {name: "no ray of this camera meets the water's plane" for name in WATER_PASSES}
    cameras = _layer_cameras(plan, camera) if water else (camera,)
    poses = _poses(scene, camera)
    drawn = _owners_seen(_actor_boxes(scene), poses, cameras, plan.settings.near_m)
    layers, snowy = snow_layers_for(plan, scene, backend=backend), set[int]()
    if layers is not None:
        with_ground = {0: np.eye(4), **poses}
        snowy = _owners_seen(_snow_boxes(scene, layers), with_ground, cameras, plan.settings.near_m)
        drawn |= snowy - {0}
    buffers, bare_buffers = plan.buffers, plan.bare_buffers
    if layers is not None and not snowy:
        buffers = plan.buffers_without_snow
        if not water:  # the scene is the bare one already
            buffers, bare_buffers = buffers | bare_buffers, frozenset[str]()
        why = "neither snow nor what it buries can be in view"
        skipped |= {name: why for name in SNOW_PASSES[: 2 if bare_buffers else 3]}
    elif layers is not None and not any(_lit_per_pixel(layers.layer_on(scene, n)) for n in snowy):
        skipped["snow: light per pixel"] = "no snow that is lit per pixel can be in view"
    actors = (
        f"background and {len(drawn)} of {len(scene.actors)} actors "
        f"({len(scene.actors) - len(poses)} absent at this time, "
        f"{len(poses) - len(drawn)} out of view); buffers {', '.join(sorted(buffers))}"
    )
    steps = _skip(plan.steps, skipped)
    return ViewPlan(
        actors=tuple(sorted(drawn)),
        snowy=tuple(sorted(snowy)),
        water=water,
        buffers=buffers,
        bare_buffers=bare_buffers,
        steps=tuple(replace(s, why=actors) if s.name == "rasterise" else s for s in steps),
    )


def snow_layers_for(plan: Plan, scene: Scene, *, backend: str = AUTO) -> SnowLayers | None:
    """The plan's snow as it lies in the scene; None without one. backend: see snow_layers_of."""
    if plan.snow is None:
        return None
    style_parts = (
        None if plan.style is None or plan.styles_picture else scene_style_of(scene, plan.style)
    )
    return snow_layers_of(scene, plan.snow, style_parts, backend=backend)


def _layer_cameras(plan: Plan, camera: Camera) -> tuple[Camera, ...]:
    """Cameras that see, between them, what the layers of a view with water can show."""
    assert plan.flood is not None
    wide = _grown(camera, MAX_SHIFT * camera.height + _SPARE_PX)
    if plan.flood.reflection == "sky" or float(camera.centre[2]) <= plan.flood.level_z_m:
        return (wide,)
    margin = MAX_MARGIN * max(camera.width, camera.height) + _SPARE_PX / COARSE
    return wide, _grown(mirrored_camera(camera, plan.flood.level_z_m), margin)


def _grown(camera: Camera, margin_px: float) -> Camera:
    m = int(np.ceil(margin_px))
    return camera.cropped(-m, -m, camera.width + 2 * m, camera.height + 2 * m)


def _poses(scene: Scene, camera: Camera) -> dict[int, np.ndarray]:
    """world_from_actor of the actors that exist when the image was taken, by instance id."""
    found = ((n, a.track.pose_at(camera.timestamp_ns)) for n, a in enumerate(scene.actors, start=1))
    return {number: pose.numpy() for number, pose in found if pose is not None}


def _owners_seen(
    bounds: Bounds, poses: Mapping[int, np.ndarray], cameras: Iterable[Camera], near_m: float
) -> set[int]:
    """Instance ids of which a box may be seen. poses: world_from_part of those that exist."""
    bounds = bounds.select(np.isin(bounds.owners, list(poses)))
    if not len(bounds):
        return set()
    placed = np.stack([poses[owner] for owner in bounds.owners.tolist()])
    seen = np.any([may_show(bounds, placed, camera, near_m) for camera in cameras], axis=0)
    return set(bounds.owners[seen].tolist())


def _actor_boxes(scene: Scene) -> Bounds:
    """One box around each actor; found once per scene."""
    if scene not in _boxes_of_actors:
        numbered = enumerate(scene.actors, start=1)
        _boxes_of_actors[scene] = Bounds.join(bound(a.gaussians, n) for n, a in numbered)
    return _boxes_of_actors[scene]


_boxes_of_actors: WeakKeyDictionary[Scene, Bounds] = WeakKeyDictionary()


def _snow_boxes(scene: Scene, layers: SnowLayers) -> Bounds:
    """Around the snow of the ground and the actors; found once per layers (of one scene)."""
    if layers not in _boxes_of_snow:
        parts = [(0, layers.ground, scene.background)]
        parts += [(n, layers.layer_on(scene, n), a.gaussians)
            for n, a in enumerate(scene.actors, start=1)]  # fmt: skip
        _boxes_of_snow[layers] = Bounds.join(
            _bound_snow(layer, own, n) for n, layer, own in parts if layer
        )
    return _boxes_of_snow[layers]


_boxes_of_snow: WeakKeyDictionary[SnowLayers, Bounds] = WeakKeyDictionary()


def _bound_snow(layer: Layer, own: Gaussians, owner: int) -> Bounds:
    """Around a part's snow, its glints, and what of the part it buries: where none of these is in
    view, the part looks as it does without snow.
    """
    buried = (layer.opacities.numpy() == 0) & (own.opacities.numpy() > 0)
    everywhere = np.ones(len(layer.gaussians), bool)
    snow = bound_chunks(layer.gaussians, everywhere, _CHUNK_M, owner)
    # Close to a camera discs are split: their parts lie within one standard deviation.
    snow = replace(snow, halves=snow.halves + snow.longest[:, None])
    bounds = [snow, bound_chunks(own, buried, _CHUNK_M, owner)]
    if layer.crystals is not None:
        places = layer.crystals.places_m.numpy().astype(np.float64)
        bounds.append(_bound_points(places, np.full(len(places), SIZE_M), _CHUNK_M, owner))
    return Bounds.join(bounds)


def _lit_per_pixel(layer: Layer | None) -> bool:
    return layer is not None and layer.slopes is not None and layer.normals is None


def _skip(steps: Iterable[Step], skipped: Mapping[str, str]) -> tuple[Step, ...]:
    """The steps; those that would run but are skipped have that reason."""
    return tuple(
        Step(s.name, False, skipped[s.name]) if s.runs and s.name in skipped else s for s in steps
    )
