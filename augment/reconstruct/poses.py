"""Small corrections of where actors and cameras are, learnt with the scene.

Labelled boxes are centimetres off, and recorded poses some tenths of a pixel. Corrections are given
at knots and linear in time between them, so that what is not learnt from, held-out frames above
all, shares what its neighbours found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from augment.cameras import Camera
from augment.labels import EGO_VEHICLE
from augment.reconstruct.forces import Forces
from augment.reconstruct.knots import Knots
from augment.reconstruct.view import ViewSource
from augment.scene import Actor, Track

KNOT_EVERY = 4  # track samples between an actor's knots
_REACH_M = 2.0  # a turn moves an actor's points about this far from its origin as a shift does
_DEPTH_M = 10.0  # and a camera's turn what it sees this far away


class ActorPoses:
    """A shift in the world (3, metres) and a turn about the vertical (its arc at 2 m)."""

    def __init__(self, actors: Sequence[Actor]) -> None:
        self.knots = Knots([_actor_knots(actor) for actor in actors], 4)

    def corrected(self, number: int, pose: np.ndarray, timestamp_ns: int) -> np.ndarray:
        """world_from_actor, float64 [4, 4], of the actor with this index, moved and turned."""
        shift = self.knots.at(number, timestamp_ns)
        if shift is None:
            return pose
        out = pose.copy()
        out[:3, :3] = _turn([0.0, 0.0, shift[3] / _REACH_M]) @ pose[:3, :3]
        out[:3, 3] += shift[:3]
        return out

    def update(
        self,
        parts: Sequence[int],
        poses: np.ndarray,
        forces: Forces,
        timestamp_ns: int,
        *,
        rate_m: float,
        pull: float,
    ) -> None:
        """One step for every actor that a view shows. parts, poses: those of its inputs."""
        rates = np.full(4, rate_m)
        for place in np.flatnonzero(forces.seen).tolist():
            if parts[place] == 0:
                continue
            rotation = poses[place, :3, :3]
            turn = (rotation @ forces.turn[place])[2] / _REACH_M
            gradient = np.append(rotation @ forces.shift[place], turn)
            self.knots.update(parts[place] - 1, timestamp_ns, gradient, rates, pull)

    def track(self, number: int, track: Track) -> Track:
        """The actor's track with its corrections."""
        times = track.timestamps_ns.tolist()
        poses = [
            self.corrected(number, pose.numpy(), time)
            for pose, time in zip(track.world_from_actor, times, strict=True)
        ]
        return dataclasses.replace(track, world_from_actor=torch.from_numpy(np.stack(poses)))


class CameraPoses:
    """A turn (3, arcs at 10 m) and a shift (3, metres) in camera axes of what a camera sees."""

    def __init__(self, source: ViewSource) -> None:
        times: dict[str, list[int]] = {}
        for key in source.train:
            times.setdefault(key.camera, []).append(source.camera(key).timestamp_ns)
        self._names: Mapping[str, int] = {name: i for i, name in enumerate(times)}
        self.knots = Knots([np.unique(np.array(t, np.int64)) for t in times.values()], 6)

    def corrected(self, camera: Camera) -> Camera:
        """The camera where it was found to be; itself where nothing is known of it."""
        number = self._names.get(camera.name)
        change = None if number is None else self.knots.at(number, camera.timestamp_ns)
        if change is None or not change.any():
            return camera
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = _turn(change[:3] / _DEPTH_M), change[3:]
        pose = torch.from_numpy(moved @ camera.camera_from_world.numpy())
        return dataclasses.replace(camera, camera_from_world=pose)

    def update(
        self, camera: Camera, poses: np.ndarray, forces: Forces, *, rate_px: float, pull: float
    ) -> None:
        """One step for a view's camera, as corrected. poses: world_from_part of its inputs."""
        number = self._names.get(camera.name)
        if number is None:
            return
        gradient = forces.on_camera(camera.camera_from_world.numpy() @ poses)
        gradient[:3] /= _DEPTH_M
        rates = np.full(6, rate_px * _DEPTH_M / camera.fx)
        self.knots.update(number, camera.timestamp_ns, gradient, rates, pull)


def _actor_knots(actor: Actor) -> np.ndarray:
    """int64 [K] times; none for the recording car's own body, whose track is exact."""
    times = actor.track.timestamps_ns.numpy()
    if actor.label == EGO_VEHICLE:
        return times[:0]
    knots = times[::KNOT_EVERY]
    return knots if knots[-1] == times[-1] else np.append(knots, times[-1])


def _turn(vector_rad: Sequence[float] | np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    x, y, z = (float(v) for v in vector_rad)
    angle = (x * x + y * y + z * z) ** 0.5
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-12:
        return np.eye(3) + cross
    return (
        np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * (cross @ cross)
    )
