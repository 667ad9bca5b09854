"""Motion of a track at a time: speed, and braking by its own deceleration.

A parabola is fitted to the positions within a window around the time. Its curvature along the
direction of motion is the deceleration. Boxes are labelled to some centimetres, so the deceleration
counts only where it is clearly above the noise of the fit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from augment.scene.scene import Track

# Half length of the window, seconds: 4 cm of noise at 10 Hz are then 0.12 m/s² of error.
HALF_WINDOW_S = 0.75
# Fewest samples that a parabola is fitted to.
MIN_SAMPLES = 5
# Shortest time that the samples have to span, seconds.
MIN_SPAN_S = 0.6
# Deceleration from which on the brakes are on, m/s².
BRAKING_MPS2 = 1.0
# Standard errors by which the deceleration has to differ from none.
_MIN_SIGMAS = 3.0
# Least noise of a position that is assumed, metres: a few samples can lie on a parabola by chance.
_MIN_NOISE_M = 0.01
# Speed below which a vehicle stands, m/s.
STANDING_MPS = 0.3
# Time before and after a braking moment in which the stop lamps are on, seconds: no flicker.
HOLD_S = 0.2
# Distance that a track has to cover to be one that moves, metres.
MIN_TRAVEL_M = 0.5
# Shortest track that can show that a vehicle is parked, seconds.
MIN_PARKED_S = 1.0


class Motion(NamedTuple):
    """Motion of a track around a time."""

    speed_mps: float
    """Speed, m/s."""
    deceleration_mps2: float
    """Deceleration along the motion, m/s²; negative where the track speeds up."""
    error_mps2: float
    """Standard error of the deceleration, m/s²."""


def motion_at(track: Track, timestamp_ns: int) -> Motion | None:
    """Return the motion of a track around a time; None where it has too few samples.

    Args:
        track: the track.
        timestamp_ns: the time.
    """
    times_ns = track.timestamps_ns.numpy()
    first = int(np.searchsorted(times_ns, timestamp_ns - round(HALF_WINDOW_S * 1e9)))
    last = int(np.searchsorted(times_ns, timestamp_ns + round(HALF_WINDOW_S * 1e9), side="right"))
    if last - first < MIN_SAMPLES:
        return None
    times_s = (times_ns[first:last] - timestamp_ns) * 1e-9
    if times_s[-1] - times_s[0] < MIN_SPAN_S:
        return None
    return _fit_parabola(times_s, track.world_from_actor[first:last, :3, 3].numpy())


def _fit_parabola(times_s: Float[np.ndarray, "S"], positions_m: Float[np.ndarray, "S 3"]) -> Motion:
    """Return the motion at time 0 of a parabola through positions."""
    powers = np.stack([np.ones_like(times_s), times_s, times_s**2], 1)
    inverse = np.linalg.inv(powers.T @ powers)
    coefficients = inverse @ (powers.T @ positions_m)
    velocity = coefficients[1]
    speed = float(np.linalg.norm(velocity))
    residuals = positions_m - powers @ coefficients
    spare = max(len(times_s) - 3, 1)
    noise_m = max(float(np.sqrt((residuals[:, :2] ** 2).sum() / (2 * spare))), _MIN_NOISE_M)
    error = 2 * noise_m * float(np.sqrt(inverse[2, 2]))
    if speed < 1e-6:
        return Motion(speed, 0.0, error)
    return Motion(speed, float(-2 * coefficients[2] @ velocity / speed), error)


def travels(track: Track) -> bool | None:
    """Return True if a track goes anywhere; None if it is too short to show that it does not."""
    positions = track.world_from_actor[:, :3, 3]
    if bool(((positions - positions[0]).norm(dim=1) > MIN_TRAVEL_M).any()):
        return True
    span_ns = int(track.timestamps_ns[-1] - track.timestamps_ns[0])
    return False if span_ns >= MIN_PARKED_S * 1e9 else None


def is_braking(track: Track, timestamp_ns: int) -> bool:
    """Return True if the stop lamps of a track's vehicle are on at a time.

    They are on while it slows down by more than BRAKING_MPS2, and while it stands after or before a
    drive. A vehicle that never moves has none on.

    Args:
        track: the track.
        timestamp_ns: the time.
    """
    if not travels(track):
        return False
    for offset_s in (0.0, -HOLD_S, HOLD_S):
        motion = motion_at(track, timestamp_ns + round(offset_s * 1e9))
        if motion is None:
            continue
        if offset_s == 0 and motion.speed_mps < STANDING_MPS:
            return True
        is_clear = motion.deceleration_mps2 > _MIN_SIGMAS * motion.error_mps2
        if motion.deceleration_mps2 > BRAKING_MPS2 and is_clear:
            return True
    return False
