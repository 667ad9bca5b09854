"""Drops on a camera's glass: a function of seed, camera, time and the car's path.

Each of the drops that a recipe counts lives through one life after another. The time gives the
number of a life. Its position and size are hashed from seed, camera, drop and life. With a wiper,
lives end when it wipes, and drops arrive one by one until it wipes again. Larger drops run: down by
gravity, and with the air stream by the distance that the car has driven since they came. No state
is carried from image to image.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from augment.memo import memo_of
from augment.rng import STEP_X, mix, rng_for
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from recipes.lens_drops import MAX_COUNT, LensDrops

LIFE_S = (8.0, 40.0)  # shortest and longest life of a drop on glass without a wiper
# Drops above 0.5 mm that come down on a square metre in a second, by the rate in mm/h to the power
# of 0.53: Marshall and Palmer's sizes at Atlas's speeds within 8 % from 2.5 to 100 mm/h.
FLUX = 850.0
RUNS_FROM_M = 1.2e-3  # radius from which a drop runs down the glass
RUN_MPS = 3e-3  # speed of a drop whose radius is larger than that by a millimetre
BALANCE_MPS = 15.0  # speed of the car at which the air stream drives drops as strongly as gravity
_MAX_RUN = 2.0  # largest speed of a drop, in RUN_MPS
_MEANDER_M = 0.6e-3  # amplitude of a drop's path to its sides
_MEANDER_TURN_M = 8e-3  # length of a bend of that path
_MAX_RADIUS_SD = 2.5  # end of the radii's distribution, in standard deviations of their logarithm
_NUM_DRAWS = 12  # random numbers of a drop's life


class Drops(NamedTuple):
    """N drops on the glass, in the order of their numbers."""

    centres_m: np.ndarray  # [N, 2] right and down from the optical axis
    radii_m: np.ndarray  # [N] mean radius
    bends: np.ndarray  # [N, 4] shape of the outline, see augment.effects.lens_drops.optics
    contact_rad: np.ndarray  # [N] angle between glass and water at the rim


@dataclass(frozen=True)
class LensDropsPlan:
    """Numbers of the drops on cameras' glasses."""

    drops: LensDrops
    """The recipe's section."""

    seed: int
    """The recipe's seed."""

    rate_mm_h: float = 0.0
    """Rate of the recipe's rain."""

    def count_on(self, camera: Camera) -> int:
        """Return the number of drops on a camera's glass.

        It is the recipe's number; or the number that covers the recipe's share of the picture where
        drops lie independently of each other; or the number that its rain brings to an upright pane
        in the time that drops stay.
        """
        if self.drops.count is not None:
            return self.drops.count
        area_m2 = self.drops.glass_m**2 * camera.width * camera.height / (camera.fx * camera.fy)
        if self.drops.share is not None:
            count = -math.log1p(-self.drops.share) * area_m2 / self.drops.mean_area_m2
            return min(round(count), MAX_COUNT)
        stay_s = sum(LIFE_S) / 2 if self.drops.wiper_s is None else self.drops.wiper_s
        return min(round(FLUX * self.rate_mm_h**0.53 * area_m2 * stay_s), MAX_COUNT)


def drops_at(plan: LensDropsPlan, scene: Scene, camera: Camera) -> Drops:
    """Return the drops on the camera's glass at its time."""
    section = plan.drops
    count = plan.count_on(camera)
    rng = rng_for(seed=plan.seed, scene=scene.name, effect="camera.lens_drops", camera=camera.name)
    key = rng.integers(0, 2**64, dtype=np.uint64)
    time_ns = np.full(count, camera.timestamp_ns, np.int64)
    slots = np.arange(count, dtype=np.uint64)
    if section.wiper_s is None:
        constant = _units(key, slots, np.zeros(count, np.int64))
        life_s = LIFE_S[0] + (LIFE_S[1] - LIFE_S[0]) * constant[:, 0]
        life_ns = (1e9 * life_s).astype(np.int64)
        time_ns += (constant[:, 1] * life_ns).astype(np.int64)
    else:
        life_ns = np.full(count, round(1e9 * section.wiper_s))
        wiper = rng_for(seed=plan.seed, scene=scene.name, effect="camera.lens_drops.wiper")
        time_ns += int(wiper.random() * life_ns[0]) if count else 0
    lives = time_ns // life_ns
    units = _units(key, slots, lives + 1)
    age_s = (time_ns - lives * life_ns) / 1e9
    if section.wiper_s is not None:
        age_s = age_s - units[:, 2] * section.wiper_s
    sd = np.clip(ndtri(np.clip(units[:, 3], 1e-9, 1 - 1e-9)), -_MAX_RADIUS_SD, _MAX_RADIUS_SD)
    radii_m = section.radius_mm / 1000 * np.exp(section.radius_spread * sd)
    low = section.glass_m * np.array([-camera.cx / camera.fx, -camera.cy / camera.fy])
    extent = section.glass_m * np.array([camera.width / camera.fx, camera.height / camera.fy])
    centres_m = low + extent * units[:, 4:6]
    centres_m += _run(scene, camera, np.maximum(age_s, 0.0), radii_m, units)
    bends = np.stack(
        [0.14 * units[:, 8], math.tau * units[:, 9], 0.08 * units[:, 10], math.tau * units[:, 7]],
        -1,
    )
    contact_rad = np.radians(35 + 30 * units[:, 11])
    has_arrived = age_s >= 0
    return Drops(
        centres_m[has_arrived], radii_m[has_arrived], bends[has_arrived], contact_rad[has_arrived]
    )


def _run(
    scene: Scene, camera: Camera, age_s: np.ndarray, radii_m: np.ndarray, units: np.ndarray
) -> np.ndarray:
    """Return how far drops have run since they came [N, 2], metres on the glass."""
    larger = np.clip((radii_m - RUNS_FROM_M) / 1e-3, 0, _MAX_RUN) * (0.5 + units[:, 6])
    rotation = camera.camera_from_world[:3, :3].numpy()
    down = -rotation[:2, 2] if scene.has_known_gravity else np.array([0.0, 1.0])
    recorded = scene.as_recorded
    odometer = memo_of(recorded).get(("odometer",), lambda: Odometer.of(recorded))
    ahead = rotation @ odometer.ahead_at(camera.timestamp_ns)
    # The glass turns air along the axis upwards, as a windscreen does.
    air = np.array([-ahead[0], -ahead[1] - abs(ahead[2])])
    driven_m = odometer.driven_m(camera.timestamp_ns, age_s)
    run_m = age_s[:, None] * down + (driven_m / BALANCE_MPS)[:, None] * air
    run_m *= (RUN_MPS * larger)[:, None]
    length = np.hypot(*run_m.T)
    across = np.stack([-run_m[:, 1], run_m[:, 0]], -1) / np.maximum(length, 1e-12)[:, None]
    bend = np.sin(math.tau * (length / _MEANDER_TURN_M + units[:, 7]))
    bend -= np.sin(math.tau * units[:, 7])
    return run_m + (_MEANDER_M * bend * np.minimum(length / _MEANDER_TURN_M, 1))[:, None] * across


@dataclass(frozen=True, eq=False)
class Odometer:
    """Distance that the car has driven."""

    times_ns: list[int]
    """[T] times of the frames, strictly increasing."""

    metres: np.ndarray
    """[T] distance driven since the first frame."""

    ahead: np.ndarray
    """[T, 3] the car's x axis in the world."""

    @staticmethod
    def of(scene: Scene) -> Odometer:
        """Return the odometer of a scene's frames."""
        poses = {frame.timestamp_ns: frame.world_from_ego.numpy() for frame in scene.frames}
        times = sorted(poses)
        places = np.array([poses[t][:3, 3] for t in times]).reshape(-1, 3)
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        ahead = np.array([poses[t][:3, 0] for t in times]).reshape(-1, 3)
        return Odometer(times, np.concatenate([[0.0], np.cumsum(steps)]), ahead)

    def ahead_at(self, time_ns: int) -> np.ndarray:
        """Return the car's x axis [3] at the last frame before this time; 0 without frames."""
        if not self.times_ns:
            return np.zeros(3)
        return self.ahead[max(bisect_right(self.times_ns, time_ns) - 1, 0)]

    def driven_m(self, time_ns: int, before_s: np.ndarray) -> np.ndarray:
        """Return the metres driven in the seconds before a time [N].

        Beyond the frames the car goes on at the same speed. With fewer than two frames it stands.
        """
        if len(self.times_ns) < 2:
            return np.zeros(len(before_s))
        seconds = np.array([t - self.times_ns[0] for t in self.times_ns]) / 1e9
        now_s = (time_ns - self.times_ns[0]) / 1e9

        def at(s: np.ndarray) -> np.ndarray:
            first = (self.metres[1] - self.metres[0]) / (seconds[1] - seconds[0])
            last = (self.metres[-1] - self.metres[-2]) / (seconds[-1] - seconds[-2])
            inside = np.interp(s, seconds, self.metres)
            return inside + first * np.minimum(s, 0) + last * np.maximum(s - seconds[-1], 0)

        return at(np.full(len(before_s), now_s)) - at(now_s - before_s)


def _units(key: np.uint64, slots: np.ndarray, lives: np.ndarray) -> np.ndarray:
    """Return random numbers in [0, 1) of every drop's life [N, _NUM_DRAWS].

    They are rounds of SplitMix64 (Steele, Lea and Flood 2014).
    """
    state = mix(mix(key + slots) + lives.astype(np.uint64))
    columns = np.arange(1, _NUM_DRAWS + 1, dtype=np.uint64) * np.uint64(STEP_X)
    return (mix(state[:, None] + columns) >> np.uint64(11)) * 2.0**-53
