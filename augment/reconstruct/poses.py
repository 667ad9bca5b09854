"""Small corrections of where actors and cameras are, learnt with the scene.

Labelled boxes are centimetres off, and recorded poses some tenths of a pixel. Corrections are given
at knots and linear in time between them, so that what is not learnt from, held-out frames above
all, shares what its neighbours found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.cameras import Camera
from augment.labels import EGO_VEHICLE
from augment.reconstruct.kernels import MOMENTS, sum_forces
from augment.reconstruct.view import ViewSource
from augment.render.cpu.backward import SplatGradients
from augment.render.cpu.driver import Inputs
from augment.render.threads import kernel_threads
from augment.scene import Actor, Track

# ---- Corrections over time: numbers at knots, linear between them, with an Adam of their own -----

# Forces are some 1e-4 a metre: what is smaller than this is rounding, and must not be a direction.
_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-10


class Knots:
    """D numbers at the knots of several things, float64, all zero to begin with.

    Before the first and after the last knot the nearest one holds. A thing without knots is never
    corrected.
    """

    def __init__(self, times_ns: Sequence[np.ndarray], width: int) -> None:
        """times_ns: int64 [K] a thing, increasing."""
        self._times = list(times_ns)
        self._firsts = np.cumsum([0, *(len(times) for times in times_ns)])
        shape = (int(self._firsts[-1]), width)
        self.values = np.zeros(shape)
        self._m, self._v = np.zeros(shape), np.zeros(shape)
        self._count = np.zeros(shape[0], np.int64)

    def at(self, number: int, timestamp_ns: int) -> np.ndarray | None:
        """The thing's correction, float64 [D], at a time; None where it has no knots."""
        place = self._place(number, timestamp_ns)
        return None if place is None else place[1] @ self.values[place[0]]

    def update(
        self, number: int, timestamp_ns: int, gradient: np.ndarray, rates: np.ndarray, pull: float
    ) -> None:
        """A step of Adam for the knots around a time. gradient, rates: [D]. pull: towards 0."""
        place = self._place(number, timestamp_ns)
        if place is None:
            return
        for row, weight in zip(*place, strict=True):
            if weight > 0:
                self._step(row, weight * gradient + pull * self.values[row], rates)

    def arrays(self) -> dict[str, np.ndarray]:
        return {"values": self.values, "m": self._m, "v": self._v, "count": self._count}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        for name, array in self.arrays().items():
            array[:] = arrays[name]

    def _place(self, number: int, timestamp_ns: int) -> tuple[list[int], np.ndarray] | None:
        """Rows of `values` around a time, and their weights."""
        times = self._times[number]
        if len(times) == 0:
            return None
        first = int(self._firsts[number])
        after = int(np.searchsorted(times, timestamp_ns, side="right"))
        if after == 0 or after == len(times):
            return [first + min(after, len(times) - 1)], np.ones(1)
        span = int(times[after]) - int(times[after - 1])
        part = (timestamp_ns - int(times[after - 1])) / span
        return [first + after - 1, first + after], np.array([1 - part, part])

    def _step(self, row: int, gradient: np.ndarray, rates: np.ndarray) -> None:
        self._count[row] += 1
        n = int(self._count[row])
        self._m[row] += (1 - _BETA1) * (gradient - self._m[row])
        self._v[row] += (1 - _BETA2) * (gradient * gradient - self._v[row])
        first, second = self._m[row] / (1 - _BETA1**n), self._v[row] / (1 - _BETA2**n)
        self.values[row] -= rates * first / (np.sqrt(second) + _EPS)


# --------------------------------------------------------------------------------------------------
# How the loss of a view pulls at rigid things: at every part of the scene, and at the camera


@dataclass(frozen=True, eq=False)
class Forces:
    """Of P parts, in each part's own axes, float64. seen: bool [P], whether the view shows it.

    shift [P, 3]: dL by a shift of the part. turn [P, 3]: dL by a turn about its origin (rad), of
    means and ellipsoids; that view-dependent colours turn along is left out.
    """

    seen: np.ndarray
    shift: np.ndarray
    turn: np.ndarray

    def on_camera(self, camera_from_parts: np.ndarray) -> np.ndarray:
        """dL [6] by a turn, then a shift, of everything as the camera sees it, in camera axes.

        camera_from_parts: float64 [P, 4, 4].
        """
        rotations, offsets = camera_from_parts[:, :3, :3], camera_from_parts[:, :3, 3]
        shift = (rotations @ self.shift[..., None])[..., 0]
        turn = (rotations @ self.turn[..., None])[..., 0] + np.cross(offsets, shift)
        return np.concatenate([turn.sum(0), shift.sum(0)])


def part_forces(inputs: Inputs, grads: SplatGradients) -> Forces:
    """The forces of one view's gradients, the same for any number of threads."""
    moments = np.empty((len(inputs.blocks), MOMENTS))
    with kernel_threads():
        sum_forces(
            inputs.addresses,
            inputs.sizes,
            inputs.blocks,
            grads.rows.reshape(-1),
            grads.ids,
            grads.counts,
            moments,
        )
    parts = len(inputs.sizes)
    # Blocks of a part stand together; an empty part has none.
    totals = np.zeros((parts, MOMENTS))
    np.add.at(totals, inputs.blocks[:, 0], moments)
    seen = np.bincount(inputs.blocks[:, 0], grads.counts, minlength=parts) > 0
    return Forces(seen, totals[:, :3], totals[:, 3:])


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
