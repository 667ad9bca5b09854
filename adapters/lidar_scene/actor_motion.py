"""Points carried along an actor's track, each at its own time.

It is `Track.pose_at`, compiled for many times at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from augment.geometry import quat_from_rotmat
from augment.scene import Track


@dataclass(frozen=True, eq=False)
class Motion:
    """A track as arrays: knots_ns int64 [T], quats float64 [T, 4] wxyz, centres float64 [T, 3]."""

    knots_ns: np.ndarray
    quats: np.ndarray
    centres: np.ndarray
    hold_ns: int

    @staticmethod
    def of(track: Track) -> Motion:
        poses = track.world_from_actor
        return Motion(
            knots_ns=track.timestamps_ns.numpy(),
            quats=quat_from_rotmat(poses[:, :3, :3]).numpy(),
            centres=np.ascontiguousarray(poses[:, :3, 3].numpy()),
            hold_ns=track.hold_ns,
        )

    def exists_at(self, timestamps_ns: np.ndarray) -> np.ndarray:
        """Whether the actor is there at each time, bool [N]."""
        first, last = self.knots_ns[0] - self.hold_ns, self.knots_ns[-1] + self.hold_ns
        return (timestamps_ns >= first) & (timestamps_ns <= last)

    def pose_at(self, timestamp_ns: int) -> np.ndarray | None:
        """world_from_actor, float64 [4, 4], or None where the actor does not exist."""
        if not self.exists_at(np.array([timestamp_ns]))[0]:
            return None
        pose = np.eye(4)
        _pose(self.knots_ns, self.quats, self.centres, timestamp_ns, pose)
        return pose

    def into_actor(self, points: np.ndarray, timestamps_ns: np.ndarray) -> np.ndarray:
        """World points [N, 3], each seen at its own time, in the actor's frame; float64 [N, 3].

        Callers leave out times at which the actor does not exist.
        """
        out = np.empty((len(points), 3))
        _into(self.knots_ns, self.quats, self.centres, points, timestamps_ns, out)
        return out

    def span(self, first_ns: int, last_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest coordinates of the centre over a time span, two float64 [3]."""
        # Every pose in the span lies between the knots just before and just after it.
        low = max(0, int(np.searchsorted(self.knots_ns, first_ns, side="right")) - 1)
        high = min(len(self.knots_ns) - 1, int(np.searchsorted(self.knots_ns, last_ns)))
        centres = self.centres[low : high + 1]
        return centres.min(axis=0), centres.max(axis=0)


def inside_box(local: np.ndarray, size_m: np.ndarray, margin_m: float) -> np.ndarray:
    """Whether points in the box's frame lie in the box grown by a margin on all sides, bool [N]."""
    return (np.abs(local) <= size_m / 2 + margin_m).all(axis=1)


def indices_between(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Indices of the points [N, 3] strictly inside an axis-aligned box, int64, ascending."""
    # One column first: it leaves few points for the rest, and this runs once a box and sweep.
    x = points[:, 0]
    index = np.flatnonzero((x > low[0]) & (x < high[0]))
    rest = points[index, 1:]
    return index[((rest > low[1:]) & (rest < high[1:])).all(axis=1)]


@numba.njit(cache=True)
def _pose(knots, quats, centres, time, out):  # pragma: no cover - compiled
    """Linear in position, slerp in rotation, held before the first and after the last knot."""
    last = len(knots) - 1
    i = min(max(np.searchsorted(knots, time, side="right") - 1, 0), max(last - 1, 0))
    f = 0.0
    j = min(i + 1, last)
    if j > i:
        f = min(max((time - knots[i]) / (knots[j] - knots[i]), 0.0), 1.0)
    a, b = quats[i], quats[j]
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    sign = -1.0 if dot < 0 else 1.0
    angle = np.arccos(min(abs(dot), 1.0))
    wa, wb = 1.0 - f, f
    if angle > 1e-6:  # below, sin loses its digits and the straight line is exact
        wa, wb = np.sin(wa * angle) / np.sin(angle), np.sin(wb * angle) / np.sin(angle)
    wb *= sign
    w, x, y, z = (
        wa * a[0] + wb * b[0],
        wa * a[1] + wb * b[1],
        wa * a[2] + wb * b[2],
        wa * a[3] + wb * b[3],
    )
    n = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * n, x * n, y * n, z * n
    out[0, 0], out[0, 1], out[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    for k in range(3):
        out[k, 3] = (1.0 - f) * centres[i, k] + f * centres[j, k]


@numba.njit(cache=True)
def _into(knots, quats, centres, points, times, out):  # pragma: no cover - compiled
    pose = np.eye(4)
    for i in range(len(points)):
        if i == 0 or times[i] != times[i - 1]:
            _pose(knots, quats, centres, times[i], pose)
        dx = points[i, 0] - pose[0, 3]
        dy = points[i, 1] - pose[1, 3]
        dz = points[i, 2] - pose[2, 3]
        for k in range(3):
            out[i, k] = pose[0, k] * dx + pose[1, k] * dy + pose[2, k] * dz
