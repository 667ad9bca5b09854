"""A street made from a seed: the embedded default scene, and the tests' ground truth.

`procedural:street?seed=3&frames=20` is a drive down a street with houses, trees, parked and moving
cars and people, six cameras and a LiDAR. `adapters.street.labels.open_truth` answers exactly, for
the same query, what any ray through it meets.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping

import numpy as np

from adapters.street.labels import StreetLabels
from adapters.street.layout import (
    StreetParameters,
    build_frames,
    camera_path,
    ego_pose,
    frame_time_ns,
    parse_parameters,
)
from adapters.street.light import build_sky
from adapters.street.splats import (
    SplatPlan,
    coarseness_for,
    contact_shadow,
    plan_splats,
    shadow_gaussians,
    splat,
)
from adapters.street.world import MovingBody, Street, build_street
from adapters.world import join_gaussians
from augment.scene import Actor, Scene

logger = logging.getLogger(__name__)

EYE_STEP_M = 2.0
MAX_EYES = 40


def open_procedural(query: Mapping[str, str]) -> Scene:
    """The scene of a procedural street's query (keys as StreetParameters' fields).

    Raises:
        AdapterError: unknown keys or values outside their limits.
    """
    return build_scene(parse_parameters(query))


def procedural_labels(path: str, query: Mapping[str, str]) -> StreetLabels:
    """The labels of a street's query.

    Raises:
        AdapterError: unknown keys or values outside their limits.
    """
    return StreetLabels(parse_parameters(query))


def build_scene(parameters: StreetParameters) -> Scene:
    """A street as Gaussians, actors, sky, cameras and labels. Equal parameters, equal bits."""
    begun = time.perf_counter()
    street = build_street(parameters)
    eyes, times = _eyes(parameters)
    static = plan_splats(street.static, eyes)
    moving = [plan_splats(m.body, _eyes_from(m, eyes, times)) for m in street.movers]
    coarseness = coarseness_for([static, *moving], parameters.gaussians)
    actors = tuple(
        _actor(mover, plan, coarseness) for mover, plan in zip(street.movers, moving, strict=True)
    )
    scene = Scene(
        name=parameters.name,
        source=parameters.uri,
        background=splat(static, coarseness),
        actors=actors,
        sky=build_sky(parameters.seed, street.to_sun),
        frames=build_frames(parameters),
        labels=StreetLabels(parameters),
        ground_z_m=_ground_z(street),
    )
    count = len(scene.background) + sum(len(a.gaussians) for a in actors)
    seconds = time.perf_counter() - begun
    logger.info("%s: %d Gaussians in %.1f s", parameters.name, count, seconds)
    return scene


def _actor(mover: MovingBody, plan: SplatPlan, coarseness: float) -> Actor:
    gaussians = [splat(plan, coarseness), shadow_gaussians(contact_shadow(mover))]
    return Actor(
        track_id=mover.name,
        label=mover.label,
        gaussians=join_gaussians(gaussians),
        track=mover.motion.track,
        size_m=mover.size_m,
    )


def _eyes(parameters: StreetParameters) -> tuple[np.ndarray, np.ndarray]:
    """Places [E, 3] of the cameras along the drive, and the times [E] they are there."""
    first, last = frame_time_ns(0), frame_time_ns(parameters.frames - 1)
    length = parameters.speed_mps * (last - first) * 1e-9
    count = int(np.clip(np.ceil(length / EYE_STEP_M) + 1, 1, MAX_EYES))
    times = np.linspace(0, last - first, count).round().astype(np.int64) + first
    return camera_path(parameters, times), times


def _eyes_from(mover: MovingBody, eyes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The same places as a mover sees them."""
    turn = np.cos(mover.motion.yaw)  # its heading is along +x or -x
    return (eyes - mover.motion.at(times)[0]) * np.array([turn, turn, 1.0])


def _ground_z(street: Street) -> float:
    """Lowest road height under the ego path."""
    parameters = street.parameters
    times = np.array([frame_time_ns(i) for i in range(parameters.frames)])
    return float(ego_pose(parameters, times).positions[:, 2].min())
