"""Moving objects of requests: the scene's actors at the poses that a simulator states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from augment.scene.labels import EGO_VEHICLE
from augment.scene.moved_actors import carry_track, move_actors
from augment.scene.scene import Scene, Track
from tools.serve.errors import invalid, quote_text
from tools.serve.poses import pose_pair
from tools.serve.scene_facts import NS_PER_US

# Moving objects of a request, at most.
MAX_OBJECTS = 4096
# Length of a track's name, at most, characters.
_MAX_NAME_LENGTH = 200


@dataclass(frozen=True, eq=False)
class RequestedScene:
    """A scene with its actors at a request's poses."""

    scene: Scene
    """The scene."""
    unknown_tracks: tuple[str, ...]
    """Tracks of the request that the scene does not have."""


def requested_scene(request: Any, scene: Scene) -> RequestedScene:
    """Return the scene with its actors where an `RGBRenderRequest` says.

    A request without moving objects gets the recorded ones. With some, the list is complete: the
    scene's other actors are absent. Simulators state all their traffic, so that tracks which the
    scene does not have are left out.

    Args:
        request: the message, whose times are checked.
        scene: the scene.

    Raises:
        RequestRefused: a track is named twice, or a pose cannot be used.
    """
    objects = request.dynamic_objects
    if not objects:
        return RequestedScene(scene, ())
    if len(objects) > MAX_OBJECTS:
        raise invalid(
            f"a request may have {MAX_OBJECTS} dynamic_objects, at most; got {len(objects)}"
        )
    pairs: dict[str, tuple[Tensor, Tensor]] = {}
    for number, item in enumerate(objects):
        name = item.track_id
        field = f"dynamic_objects[{number}]"
        if name in pairs:
            raise invalid(f"{field}: track_id {quote_text(name)} is there twice")
        if len(name) > _MAX_NAME_LENGTH:
            raise invalid(f"{field}.track_id must have at most {_MAX_NAME_LENGTH} characters")
        pairs[name] = pose_pair(item.pose_pair, f"{field}.pose_pair")
    tracks = _tracks(scene, pairs, request.frame_start_us, request.frame_end_us)
    known_names = {actor.track_id for actor in scene.actors}
    unknown = tuple(name for name in pairs if name not in known_names)
    return RequestedScene(move_actors(scene, tracks), unknown)


def _tracks(
    scene: Scene, pairs: Mapping[str, tuple[Tensor, Tensor]], start_us: int, end_us: int
) -> dict[str, Track | None]:
    """Return the track of each actor of a scene: None for those without poses."""
    tracks: dict[str, Track | None] = {}
    for actor in scene.actors:
        if actor.label == EGO_VEHICLE:  # a part of the recording car: it stays
            continue
        pair = pairs.get(actor.track_id)
        if pair is None:
            tracks[actor.track_id] = None
            continue
        poses = _poses(pair, start_us, end_us)
        tracks[actor.track_id] = carry_track(actor.track, poses, f"track {actor.track_id!r}")
    return tracks


def _poses(pair: tuple[Tensor, Tensor], start_us: int, end_us: int) -> Sequence[tuple[int, Tensor]]:
    """Return poses by time, ns: one for an object that stands still during the exposure."""
    start, end = pair
    if start is end or end_us == start_us:
        return [((start_us + (end_us - start_us) // 2) * NS_PER_US, start)]
    return [(start_us * NS_PER_US, start), (end_us * NS_PER_US, end)]
