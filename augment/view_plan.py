"""What one camera needs of a plan: parts, passes and buffers that can show in its image.

A plan is made once for a recipe and a scene. A camera that looks away from the water, the snow or
an actor needs less, which is found from boxes around them before anything is drawn. What is left
out changes no bit of what is written.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from augment.bounds import Bounds, bound, bound_chunks, bound_points, may_show
from augment.cameras import Camera
from augment.plan import Plan, Step
from augment.render.backends import AUTO
from augment.scene import Gaussians, Scene
from augment.snow.cover import Layer, SnowCover
from augment.snow.covers import cover_of
from augment.snow.sparkle import SIZE_M
from augment.style.looks import look_of
from augment.weather.flood_view import COARSE, MOST_MARGIN, MOST_SHIFT
from augment.weather.water_plane import mirrored_camera, plane_window

WATER_PASSES = ("flood: waves", "flood: bed", "flood: mirrored view", "flood: screen march")
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

    def as_dict(self) -> dict[str, object]:
        """For machines: buffers sorted, one entry a step."""
        return {
            "actors": list(self.actors),
            "snowy": list(self.snowy),
            "water": self.water,
            "buffers": sorted(self.buffers),
            "bare_buffers": sorted(self.bare_buffers),
            "steps": [{"name": s.name, "runs": s.runs, "why": s.why} for s in self.steps],
        }

    def with_hidden_water(self) -> ViewPlan:
        """The same view once its front layer has shown that nothing of the water is to be seen."""
        why = "what stands before the water hides all of it"
        return replace(self, steps=tuple(_replaced(self.steps, dict.fromkeys(WATER_PASSES, why))))


def plan_view(plan: Plan, scene: Scene, camera: Camera, *, backend: str = AUTO) -> ViewPlan:
    """The parts, passes and buffers of the plan that the camera's image can show.

    The first call for a scene bounds its actors; under snow, it also lays the snow (cover_of), by
    `backend`.

    Raises:
        SceneError: snow cannot be placed in this scene.
    """
    water, water_why = _water(plan, camera)
    cameras = _lookers(plan, camera) if water else (camera,)
    poses = _poses(scene, camera)
    near_m = plan.settings.near_m
    drawn = _owners_seen(_actor_boxes(scene), poses, cameras, near_m)
    cover, snowy = cover_for(plan, scene, backend=backend), set[int]()
    if cover is not None:
        on_ground, on_actors = _snow_boxes(scene, cover)
        if any(may_show(on_ground, None, view, near_m).any() for view in cameras):
            snowy.add(0)
        snowy |= _owners_seen(on_actors, poses, cameras, near_m)
        drawn |= snowy - {0}
    buffers, bare_buffers = _buffers(plan, bool(snowy), water)
    return ViewPlan(
        actors=tuple(sorted(drawn)),
        snowy=tuple(sorted(snowy)),
        water=water,
        buffers=buffers,
        bare_buffers=bare_buffers,
        steps=_steps(plan, scene, poses, drawn, cover, snowy, water_why, buffers, bare_buffers),
    )


def cover_for(plan: Plan, scene: Scene, *, backend: str = AUTO) -> SnowCover | None:
    """The plan's snow as it lies in the scene; None without one. backend: see cover_of."""
    if plan.snow is None:
        return None
    worn = None if plan.style is None or plan.styles_picture else look_of(scene, plan.style)
    return cover_of(scene, plan.snow, worn, backend=backend)


def _water(plan: Plan, camera: Camera) -> tuple[bool, str | None]:
    """Whether the water's plane can be in view; why its passes are skipped, if they are."""
    if plan.flood is None:
        return False, None
    if float(camera.centre[2]) <= plan.flood.level_z_m:
        return True, "the camera is under water: it sees what lies below and what lies above"
    if plane_window(camera, plan.flood.level_z_m) is None:
        return False, "no ray of this camera meets the water's plane"
    return True, None


def _lookers(plan: Plan, camera: Camera) -> tuple[Camera, ...]:
    """Cameras that see, between them, what the layers of a view with water can show."""
    assert plan.flood is not None
    wide = _grown(camera, MOST_SHIFT * camera.height + _SPARE_PX)
    if plan.flood.reflection == "sky" or float(camera.centre[2]) <= plan.flood.level_z_m:
        return (wide,)
    margin = MOST_MARGIN * max(camera.width, camera.height) + _SPARE_PX / COARSE
    return wide, _grown(mirrored_camera(camera, plan.flood.level_z_m), margin)


def _grown(camera: Camera, margin_px: float) -> Camera:
    m = int(np.ceil(margin_px))
    return camera.cropped(-m, -m, camera.width + 2 * m, camera.height + 2 * m)


def _poses(scene: Scene, camera: Camera) -> dict[int, np.ndarray]:
    """world_from_actor of the actors that exist when the image was taken, by instance id."""
    found = ((n, a.track.pose_at(camera.timestamp_ns)) for n, a in enumerate(scene.actors, start=1))
    return {number: pose.numpy() for number, pose in found if pose is not None}


@dataclass(frozen=True, eq=False)
class _Owned:
    """Boxes in the frames of their owners. owners [B]: instance ids."""

    bounds: Bounds
    owners: np.ndarray


def _owned(each: Iterable[tuple[int, Bounds]]) -> _Owned:
    each = list(each)
    counts = [len(bounds) for _, bounds in each]
    return _Owned(
        Bounds.join([bounds for _, bounds in each]),
        np.repeat(np.array([number for number, _ in each], np.int64), counts),
    )


def _owners_seen(
    boxes: _Owned, poses: dict[int, np.ndarray], cameras: Iterable[Camera], near_m: float
) -> set[int]:
    """Instance ids of which a box may be seen."""
    rows = [row for row, owner in enumerate(boxes.owners.tolist()) if owner in poses]
    if not rows:
        return set()
    b, owners = boxes.bounds, boxes.owners[rows]
    bounds = Bounds(b.centres[rows], b.halves[rows], b.longest[rows])
    placed = np.stack([poses[owner] for owner in owners.tolist()])
    seen = np.zeros(len(rows), bool)
    for camera in cameras:
        seen |= may_show(bounds, placed, camera, near_m)
    return set(owners[seen].tolist())


def _actor_boxes(scene: Scene) -> _Owned:
    """One box around each actor; worked out once per scene."""
    if scene not in _of_actors:
        numbered = enumerate(scene.actors, start=1)
        _of_actors[scene] = _owned((number, bound(a.gaussians)) for number, a in numbered)
    return _of_actors[scene]


_of_actors: WeakKeyDictionary[Scene, _Owned] = WeakKeyDictionary()


def _snow_boxes(scene: Scene, cover: SnowCover) -> tuple[Bounds, _Owned]:
    """Around the ground's snow, and the actors'; worked out once per cover (of one scene)."""
    if cover not in _of_covers:
        on_ground = _bound_snow(cover.ground, scene.background)
        layers = ((n, a, cover.layer_on(scene, n)) for n, a in enumerate(scene.actors, start=1))
        on_actors = _owned((n, _bound_snow(own, a.gaussians)) for n, a, own in layers if own)
        _of_covers[cover] = (on_ground, on_actors)
    return _of_covers[cover]


_of_covers: WeakKeyDictionary[SnowCover, tuple[Bounds, _Owned]] = WeakKeyDictionary()


def _bound_snow(layer: Layer, own: Gaussians) -> Bounds:
    """Around a part's snow, its glints, and what of the part it buries: where none of these is in
    view, the part looks as it does without snow.
    """
    buried = (layer.opacities.numpy() == 0) & (own.opacities.numpy() > 0)
    everywhere = np.ones(len(layer.gaussians), bool)
    snow = bound_chunks(layer.gaussians, everywhere, _CHUNK_M)
    # Close to a camera discs are split: their parts lie within one standard deviation.
    bounds = [snow.grown(snow.longest), bound_chunks(own, buried, _CHUNK_M)]
    if layer.crystals is not None:
        places = layer.crystals.places_m.numpy().astype(np.float64)
        bounds.append(bound_points(places, np.full(len(places), SIZE_M), _CHUNK_M))
    return Bounds.join(bounds)


def _buffers(plan: Plan, snow: bool, water: bool) -> tuple[frozenset[str], frozenset[str]]:
    """Without snow in view the scene is the bare one already, but for its water."""
    if plan.snow is None or snow:
        return plan.buffers, plan.bare_buffers
    if water:
        return plan.snowless_buffers, plan.bare_buffers
    return plan.snowless_buffers | plan.bare_buffers, frozenset()


def _steps(
    plan: Plan,
    scene: Scene,
    poses: dict[int, np.ndarray],
    drawn: set[int],
    cover: SnowCover | None,
    snowy: set[int],
    no_water: str | None,
    buffers: frozenset[str],
    bare_buffers: frozenset[str],
) -> tuple[Step, ...]:
    """The plan's steps with what this camera leaves out."""
    skipped = dict[str, str]()
    if no_water is not None:
        skipped |= dict.fromkeys(WATER_PASSES, no_water)
    if cover is not None:
        if not snowy:
            names = ("snow: placement and layer", "snow: light per pixel", "snow: bare surface")
            skipped |= dict.fromkeys(names, "neither snow nor what it buries can be in view")
        elif not any(_lit_per_pixel(cover.layer_on(scene, number)) for number in snowy):
            skipped["snow: light per pixel"] = "no snow that is lit per pixel can be in view"
        if bare_buffers:
            skipped.pop("snow: bare surface", None)
    steps = _replaced(plan.steps, skipped)
    beyond, absent = len(poses) - len(drawn), len(scene.actors) - len(poses)
    actors = (
        f"background and {len(drawn)} of {len(scene.actors)} actors ({absent} absent at this time, "
        f"{beyond} out of view); buffers {', '.join(sorted(buffers))}"
    )
    return tuple(Step(s.name, s.runs, actors) if s.name == "rasterise" else s for s in steps)


def _lit_per_pixel(layer: Layer | None) -> bool:
    return layer is not None and layer.slopes is not None and layer.normals is None


def _replaced(steps: Iterable[Step], skipped: dict[str, str]) -> list[Step]:
    """The steps, those that would run but are skipped with the reason."""
    return [
        Step(s.name, False, skipped[s.name]) if s.runs and s.name in skipped else s for s in steps
    ]
