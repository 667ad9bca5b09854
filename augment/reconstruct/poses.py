"""Small corrections of where actors are, learnt with them: labelled boxes are centimetres off.

An actor's correction is a shift in the world (3, metres) and a turn about the vertical through its
origin (radians), given at knots a few track samples apart and linear between them, so that frames
which are not learnt from share what their neighbours found. The gradient of a pose is that of the
splats' means carried along rigidly; what a turn does to the shape of single splats is left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from augment.labels import EGO_VEHICLE
from augment.reconstruct.splats import Splats
from augment.render.cpu_backward import SplatGradients
from augment.render.cpu_layout import BLOCK
from augment.render.cpu_project_backward import G_MEAN
from augment.scene import Actor, Track

KNOT_EVERY = 4  # track samples between knots
_REACH_M = 2.0  # a turn moves points about this far from the origin as much as a shift does
_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-15


class PoseCorrections:
    """Corrections of all actors, and their Adam. Values are metres, three and the turn's arc."""

    def __init__(self, actors: Sequence[Actor]) -> None:
        self._knots = [_knots(actor) for actor in actors]
        counts = [len(knots) for knots in self._knots]
        self._firsts = np.cumsum([0, *counts])
        shape = (int(self._firsts[-1]), 4)
        self.values = np.zeros(shape)
        self._m, self._v = np.zeros(shape), np.zeros(shape)
        self._count = np.zeros(shape[0], np.int64)

    def corrected(self, number: int, pose: np.ndarray, timestamp_ns: int) -> np.ndarray:
        """world_from_actor, float64 [4, 4], of the actor with this index, moved and turned."""
        place = self._place(number, timestamp_ns)
        if place is None:
            return pose
        rows, weights = place
        shift = weights @ self.values[rows]
        out = pose.copy()
        out[:3, :3] = _turn(shift[3] / _REACH_M) @ pose[:3, :3]
        out[:3, 3] += shift[:3]
        return out

    def update(
        self,
        splats: Splats,
        parts: Sequence[int],
        poses: np.ndarray,
        grads: SplatGradients,
        timestamp_ns: int,
        *,
        rate: float,
        pull: float,
    ) -> None:
        """One step of Adam for the knots around a view. parts, poses: those of its inputs.

        rate: metres. pull: 1/m^2, draws every correction that is touched back to 0.
        """
        forces = part_forces(splats, parts, grads)
        for place_in_view, (force, torque) in forces.items():
            number = parts[place_in_view] - 1
            place = self._place(number, timestamp_ns)
            if place is None:
                continue
            rotation = poses[place_in_view, :3, :3]
            turn = (rotation @ torque)[2] / _REACH_M
            gradient = np.append(rotation @ force, turn)
            rows, weights = place
            for row, weight in zip(rows, weights, strict=True):
                if weight > 0:
                    self._step(row, weight * gradient + pull * self.values[row], rate)

    def track(self, number: int, track: Track) -> Track:
        """The actor's track with its corrections."""
        times = track.timestamps_ns.tolist()
        poses = [
            self.corrected(number, pose.numpy(), time)
            for pose, time in zip(track.world_from_actor, times, strict=True)
        ]
        return dataclasses.replace(track, world_from_actor=torch.from_numpy(np.stack(poses)))

    def arrays(self) -> dict[str, np.ndarray]:
        return {"values": self.values, "m": self._m, "v": self._v, "count": self._count}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        for name, array in self.arrays().items():
            array[:] = arrays[name]

    def _place(self, number: int, timestamp_ns: int) -> tuple[list[int], np.ndarray] | None:
        """Rows of `values` around a time and their weights; None where nothing is corrected."""
        knots = self._knots[number]
        if len(knots) == 0:
            return None
        first = int(self._firsts[number])
        after = int(np.searchsorted(knots, timestamp_ns, side="right"))
        if after == 0 or after == len(knots):
            return [first + min(after, len(knots) - 1)], np.ones(1)
        span = int(knots[after]) - int(knots[after - 1])
        part = (timestamp_ns - int(knots[after - 1])) / span
        return [first + after - 1, first + after], np.array([1 - part, part])

    def _step(self, row: int, gradient: np.ndarray, rate: float) -> None:
        self._count[row] += 1
        n = int(self._count[row])
        self._m[row] += (1 - _BETA1) * (gradient - self._m[row])
        self._v[row] += (1 - _BETA2) * (gradient * gradient - self._v[row])
        first, second = self._m[row] / (1 - _BETA1**n), self._v[row] / (1 - _BETA2**n)
        self.values[row] -= rate * first / (np.sqrt(second) + _EPS)


def part_forces(
    splats: Splats, parts: Sequence[int], grads: SplatGradients
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """dL by a shift and by a turn about the origin, float64 [3] each, in each actor's own frame.

    By place in `parts`; the world (part 0) and parts that the view does not show are left out.
    """
    forces: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    seen = np.flatnonzero((grads.counts > 0) & (np.asarray(parts)[grads.blocks[:, 0]] > 0))
    for block in seen:
        place = int(grads.blocks[block, 0])
        own = slice(block * BLOCK, block * BLOCK + int(grads.counts[block]))
        g = grads.rows[own, G_MEAN : G_MEAN + 3].astype(np.float64)
        p = splats.means[splats.starts[parts[place]] + grads.ids[own]].astype(np.float64)
        moments = p.T @ g  # [i, j] = sum p_i g_j
        torque = np.array([
            moments[1, 2] - moments[2, 1],
            moments[2, 0] - moments[0, 2],
            moments[0, 1] - moments[1, 0],
        ])  # fmt: skip
        force, before = forces.get(place, (np.zeros(3), np.zeros(3)))
        forces[place] = (force + g.sum(0), before + torque)
    return forces


def _knots(actor: Actor) -> np.ndarray:
    """int64 [K] times; none for the recording car's own body, whose track is exact."""
    times = actor.track.timestamps_ns.numpy()
    if actor.label == EGO_VEHICLE:
        return times[:0]
    knots = times[::KNOT_EVERY]
    return knots if knots[-1] == times[-1] else np.append(knots, times[-1])


def _turn(angle_rad: float) -> np.ndarray:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
