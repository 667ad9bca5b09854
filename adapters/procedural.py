"""A street made from a seed: the built-in default scene, and the ground truth of tests.

`procedural:street?seed=3&frames=20` is a drive down a street with houses, trees, parked and moving
cars and people, six cameras and a LiDAR. `open_procedural` makes the scene. For the same query,
`open_truth` says exactly what any ray through it meets.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from adapters.street.forms import unit as unit_vectors
from adapters.street.forms import xyz
from adapters.street.layout import (
    FRAME_NS,
    StreetParameters,
    build_frames,
    camera_path,
    ego_pose,
    frame_time_ns,
    parse_parameters,
)
from adapters.street.light import build_sky
from adapters.street.splats import (
    SHADOW_RGB,
    ContactShadow,
    coarseness_for,
    contact_shadow,
    plan_splats,
    shadow_gaussians,
    splat,
)
from adapters.street.world import Street, build_street
from adapters.world import join_gaussians
from augment.errors import SceneError
from augment.scene.cameras import Camera
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Actor, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import Sky

logger = logging.getLogger(__name__)

EYE_STEP_M = 2.0
MAX_EYES = 40


def open_procedural(query: Mapping[str, str]) -> Scene:
    """Open the scene of a procedural street: Gaussians, actors, sky, cameras and labels.

    Equal parameters give equal bits. query: its keys are the fields of StreetParameters.

    Raises:
        AdapterError: keys are unknown or values outside their limits.
    """
    parameters = parse_parameters(query)
    start_s = time.perf_counter()
    street = build_street(parameters)
    eyes, times = _eyes(parameters)
    static = plan_splats(street.static, eyes)
    moving = []
    for mover in street.movers:
        turn = np.cos(mover.motion.yaw)  # its heading is along +x or -x
        seen_from = (eyes - mover.motion.at(times)[0]) * np.array([turn, turn, 1.0])
        moving.append(plan_splats(mover.body, seen_from))
    coarseness = coarseness_for([static, *moving], parameters.gaussians)
    actors = []
    for mover, plan in zip(street.movers, moving, strict=True):
        shadow = shadow_gaussians(contact_shadow(mover))
        gaussians = join_gaussians([splat(plan, coarseness), shadow])
        actors.append(Actor(mover.name, mover.label, gaussians, mover.motion.track, mover.size_m))
    times_ns = np.array([frame_time_ns(i) for i in range(parameters.frames)])
    scene = Scene(
        name=parameters.name,
        source=parameters.uri,
        background=splat(static, coarseness),
        actors=tuple(actors),
        sky=build_sky(parameters.seed),
        frames=build_frames(parameters),
        labels=StreetLabels(parameters),
        ground_z_m=float(ego_pose(parameters, times_ns)[0][:, 2].min()),  # lowest under the path
    )
    count = len(scene.background) + sum(len(a.gaussians) for a in actors)
    logger.info("%s: %d Gaussians in %.1f s", scene.name, count, time.perf_counter() - start_s)
    return scene


def _eyes(parameters: StreetParameters) -> tuple[np.ndarray, np.ndarray]:
    """Return the places [E, 3] of the cameras along the drive, and the times [E] at which they
    are there.
    """
    first = frame_time_ns(0)
    last = frame_time_ns(parameters.frames - 1)
    length = parameters.speed_mps * (last - first) * 1e-9
    count = int(np.clip(np.ceil(length / EYE_STEP_M) + 1, 1, MAX_EYES))
    times = np.linspace(0, last - first, count).round().astype(np.int64) + first
    return camera_path(parameters, times), times


def procedural_labels(path: str, query: Mapping[str, str]) -> StreetLabels:
    """Return the labels of a street's query. It raises as open_procedural does."""
    return StreetLabels(parse_parameters(query))


# ---- What the street's surfaces really are: distance, normal, class and colour along any ray -----


class RayHits(NamedTuple):
    """Surfaces that N rays hit.

    Attributes:
        distance: float64 [N], metres, infinite for sky.
        normal: float64 [N, 3], world, unit, towards the ray's origin; zero for sky.
        semantic: int16 [N].
        instance: int32 [N], 0 or 1 + the actor's index.
        shape: int64 [N], shape of the body that was hit, -1 for sky.
        rgb: float [N, 3], display-encoded, with baked light, zero for sky. None unless requested.
    """

    distance: np.ndarray
    normal: np.ndarray
    semantic: np.ndarray
    instance: np.ndarray
    shape: np.ndarray
    rgb: np.ndarray | None


class ExactView(NamedTuple):
    """Exact image of a camera.

    Attributes:
        rgb: float32 [H, W, 3], with sky.
        depth: float64 [H, W], z, infinite for sky.
        normal: float [H, W, 3].
        semantic: int16 [H, W].
        instance: int32 [H, W].
    """

    rgb: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    semantic: np.ndarray
    instance: np.ndarray


@dataclass(frozen=True, eq=False)
class StreetTruth:
    """Exact answers about a street, by ray casting."""

    street: Street

    @cached_property
    def sky(self) -> Sky:
        return build_sky(self.street.parameters.seed)

    @cached_property
    def _shadows(self) -> list[ContactShadow]:
        return [contact_shadow(mover) for mover in self.street.movers]

    def cast(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        timestamp_ns: int | np.ndarray,
        *,
        with_rgb: bool = True,
    ) -> RayHits:
        """Follow rays [N, 3] (origins may be [3]) at a time, or at each ray's own time [N]."""
        rays = len(directions)
        unit = unit_vectors(directions)
        origins = np.ascontiguousarray(np.broadcast_to(origins, unit.shape), np.float64)
        times = np.broadcast_to(np.asarray(timestamp_ns, np.int64), (rays,))
        distance, shape, local = self.street.static.tree.cast(origins, unit)
        instance = np.zeros(rays, np.int32)
        for number, mover in enumerate(self.street.movers, start=1):
            centres, present = mover.motion.at(times)
            relative = origins - centres
            reach = np.linalg.norm(mover.size_m) / 2
            along = -(relative * unit).sum(1)
            passing = (relative**2).sum(1) - along**2 < reach**2
            index = np.flatnonzero(present & passing)
            turn = _turn(mover.motion.yaw)
            actor_hits = mover.body.tree.cast(relative[index] @ turn, unit[index] @ turn)
            nearer = actor_hits.distance < distance[index]
            index = index[nearer]
            for values, actor_values in zip((distance, shape, local), actor_hits, strict=True):
                values[index] = actor_values[nearer]
            instance[index] = number
        normal = np.zeros((rays, 3))
        semantic = np.full(rays, SemanticClass.SKY, np.int16)
        rgb = np.zeros((rays, 3)) if with_rgb else None
        bodies = [(self.street.static, np.eye(3))]
        bodies += [(mover.body, _turn(mover.motion.yaw)) for mover in self.street.movers]
        for number in np.unique(instance):
            index = np.flatnonzero((instance == number) & (shape >= 0))
            body, turn = bodies[number]
            hit_shapes = shape[index]
            normal[index] = body.shapes.normals(hit_shapes, local[index]) @ turn.T
            semantic[index] = body.shapes.semantic[hit_shapes]
            if rgb is not None:
                rgb[index] = body.colors(hit_shapes, local[index][None])
        normal[(normal * unit).sum(1) > 0] *= -1
        if rgb is not None:
            surface_rays = np.flatnonzero((instance == 0) & (shape >= 0))
            points = origins[surface_rays] + distance[surface_rays, None] * unit[surface_rays]
            for mover, shadow in zip(self.street.movers, self._shadows, strict=True):
                centres, present = mover.motion.at(times[surface_rays])
                relative = (points - centres) @ _turn(mover.motion.yaw)
                cover = shadow.cover(relative) * present
                rgb[surface_rays] += cover[:, None] * (SHADOW_RGB - rgb[surface_rays])
        return RayHits(distance, normal, semantic, instance, shape, rgb)

    def render(self, camera: Camera) -> ExactView:
        """Cast a ray through every pixel centre."""
        size = (camera.height, camera.width)
        rays = camera.ray_directions(torch.float64)
        flat = rays.reshape(-1, 3).numpy()
        hits = self.cast(camera.centre.numpy(), flat, camera.timestamp_ns)
        assert hits.rgb is not None
        sky = self.sky.sample(rays.float()).numpy()
        is_sky = np.isinf(hits.distance).reshape(size)
        rgb = np.where(is_sky[..., None], sky, hits.rgb.reshape(*size, 3)).astype(np.float32)
        return ExactView(
            rgb=rgb,
            depth=(hits.distance / np.linalg.norm(flat, axis=1)).reshape(size),
            normal=hits.normal.reshape(*size, 3),
            semantic=hits.semantic.reshape(size),
            instance=hits.instance.reshape(size),
        )


def _turn(yaw: float) -> np.ndarray:
    """Return the rotation world_from_actor.

    `world @ turn` takes row vectors into the actor's frame.
    """
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def open_truth(query: Mapping[str, str]) -> StreetTruth:
    """Return the truth of the street that `open_procedural` opens for the same query.

    Raises:
        AdapterError: as open_procedural.
    """
    return StreetTruth(build_street(parse_parameters(query)))


# ---- A spinning LiDAR on the ego car's roof; things stand where they are at each ray's own time --

SENSOR_M = (0.6, 0.0, 1.95)  # forward, left, up from the ego origin
LOWEST_DEG = -24.0  # elevation of ring 0
HIGHEST_DEG = 14.0  # elevation of the last ring
REACH_M = (1.5, 120.0)
# Share of the beam that comes back from a surface met head on.
REFLECTIVITY = {
    SemanticClass.ROAD: 0.14,
    SemanticClass.LANE_MARKING: 0.62,
    SemanticClass.SIDEWALK: 0.30,
    SemanticClass.TERRAIN: 0.38,
    SemanticClass.VEGETATION: 0.42,
    SemanticClass.BUILDING: 0.40,
    SemanticClass.BARRIER: 0.36,
    SemanticClass.POLE: 0.45,
    SemanticClass.SIGN: 0.95,
    SemanticClass.VEHICLE: 0.34,
    SemanticClass.PEDESTRIAN: 0.30,
    SemanticClass.OTHER: 0.30,
}


def lidar_rays(
    parameters: StreetParameters, frame_index: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origins [C, 3], unit directions [C, R, 3] and times [C] of a sweep of C columns, R
    rings.

    The beam starts behind the car half a frame early, turns clockwise, and looks ahead at the
    frame's time. Ring 0 is the lowest.
    """
    columns = parameters.lidar_columns
    rings = parameters.lidar_rings
    turn = (np.arange(columns) + 0.5) / columns - 0.5
    times = frame_time_ns(frame_index) + np.round(turn * FRAME_NS).astype(np.int64)
    azimuth = (ego_pose(parameters, times)[1] - 2 * np.pi * turn)[:, None]
    elevation = np.radians(np.linspace(LOWEST_DEG, HIGHEST_DEG, rings))[None, :]
    level = np.cos(elevation)
    directions = xyz(level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation))
    return sensor_origins(parameters, times), directions, times


def sensor_origins(parameters: StreetParameters, timestamps_ns: np.ndarray) -> np.ndarray:
    """Return the positions of the sensor at times [N], float64 [N, 3]."""
    positions, yaws = ego_pose(parameters, timestamps_ns)
    forward, left, up = SENSOR_M
    c = np.cos(yaws)
    s = np.sin(yaws)
    return positions + xyz(c * forward - s * left, s * forward + c * left, up)


@dataclass(frozen=True)
class StreetLabels:
    """Labels of a street. They hold only its parameters, so they are cheap to pickle."""

    parameters: StreetParameters

    def boxes(self, frame_index: int) -> Boxes:
        """Return the boxes of a frame: moving ones in the order of the scene's actors, then
        parked cars.
        """
        time = np.array([self._time_ns(frame_index)])
        street = build_street(self.parameters)
        rows = []
        for number, mover in enumerate(street.movers, start=1):
            centres, present = mover.motion.at(time)
            if present[0]:
                box = centres[0], mover.size_m, mover.motion.yaw
                rows.append((mover.name, mover.label, *box, False, number))
        for name, *box in street.parked:
            rows.append((name, "Car", *box, True, 0))
        if not rows:
            return Boxes.empty()
        names, labels, centres, sizes, yaws, parked, instances = zip(*rows, strict=True)
        half = np.array(yaws) / 2
        zero = np.zeros_like(half)
        return Boxes(
            track_ids=names,
            labels=labels,
            centers_m=np.array(centres, np.float64),
            sizes_m=np.array(sizes, np.float64),
            quats=np.stack([np.cos(half), zero, zero, np.sin(half)], 1),
            attributes={"is_parked": np.array(parked), "instance": np.array(instances, np.uint16)},
        )

    def lidar(self, frame_index: int) -> LidarSweep:
        """Return the returns of one turn.

        Columns: x, y, z float64 metres; intensity float32 in [0, 1]; timestamp_ns int64; ring
        uint8; semantic uint8 (SemanticClass); instance uint16 (as in images).
        """
        self._time_ns(frame_index)
        origins, directions, times = lidar_rays(self.parameters, frame_index)
        rings = directions.shape[1]
        origin = np.repeat(origins, rings, axis=0)
        time = np.repeat(times, rings)
        direction = directions.reshape(-1, 3)
        truth = StreetTruth(build_street(self.parameters))
        hits = truth.cast(origin, direction, time, with_rgb=False)
        returns = np.flatnonzero((hits.distance > REACH_M[0]) & (hits.distance < REACH_M[1]))
        distance = hits.distance[returns]
        semantic = hits.semantic[returns]
        x, y, z = (origin[returns] + distance[:, None] * direction[returns]).T
        reflectivity = np.array([REFLECTIVITY.get(value, 0.0) for value in SemanticClass])
        incidence = np.abs((hits.normal[returns] * direction[returns]).sum(1))
        intensity = reflectivity[semantic] * (0.25 + 0.75 * incidence) * np.exp(-distance / 150)
        return LidarSweep(
            {
                "x": x,
                "y": y,
                "z": z,
                "intensity": intensity.astype(np.float32),
                "timestamp_ns": time[returns],
                "ring": np.tile(np.arange(rings), len(times))[returns].astype(np.uint8),
                "semantic": semantic.astype(np.uint8),
                "instance": hits.instance[returns].astype(np.uint16),
            }
        )

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray:
        """Return the SemanticClass of each return: the sweep's own numbers."""
        return np.asarray(sweep.columns["semantic"], np.int16)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray:
        """Return the exact position of the sensor at the time of each return."""
        self._time_ns(frame_index)
        return sensor_origins(self.parameters, np.asarray(sweep.columns["timestamp_ns"], np.int64))

    def _time_ns(self, frame_index: int) -> int:
        if not 0 <= frame_index < self.parameters.frames:
            raise SceneError(
                f"{self.parameters.uri} has frames 0 to {self.parameters.frames - 1}; "
                f"got {frame_index}"
            )
        return frame_time_ns(frame_index)
