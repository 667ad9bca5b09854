"""Where an actor is over time."""

from __future__ import annotations

import dataclasses
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from augment.geometry import quat_from_rotmat

_STRAIGHT_RAD = 1e-6  # sin of a smaller angle loses its digits; the straight line is exact there


@dataclass(frozen=True, eq=False)
class Track:
    """Where an actor is over time. Linear in position, slerp in rotation, between samples.

    timestamps_ns: int64 [T], strictly increasing. world_from_actor: float64 [T, 4, 4].
    hold_ns: how long before the first and after the last sample the actor stays at that pose
    (cameras of a frame fire at slightly different moments); beyond it the actor is absent.
    max_gap_ns: between samples further apart than this the actor is absent too, but for hold_ns
    after the one and before the other, where it stays at that pose; None: always interpolated.
    """

    timestamps_ns: Tensor
    world_from_actor: Float[Tensor, "T 4 4"]
    hold_ns: int = 100_000_000
    max_gap_ns: int | None = None

    def __post_init__(self) -> None:
        count = self.timestamps_ns.shape[0]
        if count < 1 or tuple(self.world_from_actor.shape) != (count, 4, 4):
            raise ValueError(
                f"a track needs T >= 1 timestamps and world_from_actor [T, 4, 4]; "
                f"got {count} and {list(self.world_from_actor.shape)}"
            )
        if count > 1 and not bool((self.timestamps_ns.diff() > 0).all()):
            raise ValueError("track timestamps must be strictly increasing")

    def pose_at(self, timestamp_ns: int) -> Float[Tensor, "4 4"] | None:
        """world_from_actor at a time, float64, or None where the actor does not exist."""
        knots = self._knots
        times = knots.times_ns
        if not times[0] - self.hold_ns <= timestamp_ns <= times[-1] + self.hold_ns:
            return None
        if timestamp_ns <= times[0]:
            return self.world_from_actor[0]
        if timestamp_ns >= times[-1]:
            return self.world_from_actor[-1]
        after = bisect_right(times, timestamp_ns)
        before = after - 1
        if self.max_gap_ns is not None and times[after] - times[before] > self.max_gap_ns:
            if timestamp_ns - times[before] <= self.hold_ns:
                return self.world_from_actor[before]
            is_near = times[after] - timestamp_ns <= self.hold_ns
            return self.world_from_actor[after] if is_near else None
        fraction = (timestamp_ns - times[before]) / (times[after] - times[before])
        rows = _rotation(_slerp(knots.quats[before], knots.quats[after], fraction))
        for row, a, b in zip(rows, knots.centres[before], knots.centres[after], strict=True):
            row.append(a + fraction * (b - a) if fraction < 0.5 else b - (b - a) * (1 - fraction))
        return torch.tensor([*rows, [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)

    @cached_property
    def _knots(self) -> _Knots:
        poses = self.world_from_actor.detach()
        return _Knots(
            self.timestamps_ns.tolist(),
            quat_from_rotmat(poses[:, :3, :3]).tolist(),
            poses[:, :3, 3].tolist(),
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without what is cached, which other processes make again in less time than it travels."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


@dataclass(frozen=True)
class _Knots:
    """A track in Python's own numbers: for a single pose, torch's and NumPy's calls take a hundred
    times as long as the arithmetic. quats: wxyz, T of 4. centres: T of 3.
    """

    times_ns: list[int]
    quats: list[list[float]]
    centres: list[list[float]]


def _slerp(a: Sequence[float], b: Sequence[float], fraction: float) -> list[float]:
    """As augment.geometry.slerp."""
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    angle = math.acos(min(abs(dot), 1.0))
    weight_a, weight_b = 1 - fraction, fraction
    if angle >= _STRAIGHT_RAD:
        sin = math.sin(angle)
        weight_a, weight_b = math.sin(weight_a * angle) / sin, math.sin(weight_b * angle) / sin
    if dot < 0:  # the shorter way round
        weight_b = -weight_b
    return [weight_a * p + weight_b * q for p, q in zip(a, b, strict=True)]


def _rotation(quat: Sequence[float]) -> list[list[float]]:
    """Rows of the rotation of a wxyz quaternion of any length, as geometry.rotmat_from_quat."""
    length = math.sqrt(sum(v * v for v in quat))
    w, x, y, z = (v / length for v in quat)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
