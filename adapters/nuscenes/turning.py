"""When the LiDAR looked where: the moment of a return from its bearing.

nuScenes publishes one time a sweep, that of the end of its turn, and no times of returns. But the
sensor turns clockwise in 50 ms, and each camera is triggered as the LiDAR sweeps across the middle
of its view. So the keyframes' images tell the bearing at which a turn ends (to the left, a little
behind), and that tells the time of everything. It matters for what moves: its boxes stand where the
LiDAR met it, up to 50 ms before the sweep's time, as do the images.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

TURN_NS = 50_000_000
_TWO_PI = 2 * np.pi
# Images of one keyframe published agree to 4 degrees; other data in nuScenes's form need not turn
# like this at all.
_MOST_SPREAD_RAD = np.radians(20)


@dataclass(frozen=True)
class Turn:
    """end_rad: bearing of the end of a turn, from the car's forward axis to the left; None where it
    is not known, then everything counts as seen at the sweep's time."""

    end_rad: float | None

    @staticmethod
    def of_images(bearings_rad: np.ndarray, before_ns: np.ndarray) -> Turn:
        """The turn told by images: where their cameras look, and how long before their keyframe's
        sweep they were taken; both [N]."""
        looks_apart = len(bearings_rad) > 1 and np.ptp(bearings_rad) > _MOST_SPREAD_RAD
        if not looks_apart:
            return Turn(None)
        ends = bearings_rad - _TWO_PI * before_ns / TURN_NS
        end = float(np.angle(np.exp(1j * ends).mean()))
        spread = np.abs(np.angle(np.exp(1j * (ends - end))))
        return Turn(end if np.quantile(spread, 0.9) < _MOST_SPREAD_RAD else None)

    def before_ns(self, directions: np.ndarray) -> np.ndarray:
        """How long before the sweep's time the LiDAR looked there, int64 [N].

        directions: [N, 2 or 3] from the sensor, in the car's axes; no numbers count as forward.
        """
        if self.end_rad is None:
            return np.zeros(len(directions), np.int64)
        bearings = np.arctan2(directions[:, 1], directions[:, 0])
        past = np.mod(np.nan_to_num(bearings) - self.end_rad, _TWO_PI) / _TWO_PI
        return np.round(past * TURN_NS).astype(np.int64)
