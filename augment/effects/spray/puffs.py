"""Spray behind vehicles on a wet road: puffs of droplets, a function of their tracks and the time.

A vehicle lifts the water that its tyres meet, a share of which stays in the air as droplets:

    extinction per metre driven = 3 w h f / d   [m^2 / m]        f = 0.1 (v - 40 km/h) / (50 km/h)

w being the tyres' width, h the water's depth, d the droplets' diameter (an extinction of 3 LWC /
(rho d) for a water content LWC, of spheres that are large against the wavelength). At 90 km/h on a
millimetre of water that fills 2 x 1.5 m with 0.067 /m. f, w and d are assumed: right to a factor
of 2.

Every INTERVAL_S of absolute time each vehicle that is fast enough leaves a puff where it then is: a
Gaussian that the wake drags along, that the wind carries, that spreads, and rains out. So a puff's
place is known from when it was born, and no image needs another one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from augment.memo import memo_of
from augment.rng import STEP_X, mix, rng_for
from augment.scene import Actor, Scene

FROM_MPS = 40 / 3.6  # speed from which a vehicle lifts spray
_FULL_MPS = 90 / 3.6  # speed at which _FULL_SHARE of the water is in the air
_FULL_SHARE = 0.1  # share of the water that is in the air at _FULL_MPS
_MAX_SHARE = 0.2  # largest share of the water that is in the air
_TYRE_M = 0.2  # width of the tyres
_DROPLET_M = 3e-4  # diameter of the droplets
_CAR_SIZE_M = (4.5, 1.8)  # length and width of a usual car; others lift more or less by their size
_FLOW_M = 5.0  # length over which the water runs off the road
_CROSSFALL = 0.02  # slope of the road across
INTERVAL_S = 0.1  # time between two puffs of a vehicle
LIFE_S = 3.5  # life of a puff
_RAIN_OUT_S = 1.2  # time constant in which droplets rain out
_GROWTH_S = 0.12  # time in which a puff comes up
_WAKE_SHARE = 0.35  # share of the vehicle's speed with which the wake drags a puff
_WAKE_S = 0.5  # time constant in which that drag ends
_STEP_S = 0.25  # time to either side over which speeds are differences of positions
_MAX_MPS = 70.0  # largest plausible speed; a faster track has jumped
MIN_OPTICAL_DEPTH = 0.003  # optical depth below which a puff is left out
CUT = 9.0  # square of the distance in standard deviations at which a puff ends


class Puffs(NamedTuple):
    """N puffs whose extinction is extinction_per_m exp(-|w (x - c)|^2 / 2)."""

    centres_m: np.ndarray  # [N, 3] c, scene world
    whitenings: np.ndarray  # [N, 3, 3] w, standard deviations per metre
    extinction_per_m: np.ndarray  # [N] extinction at the centre

    @property
    def scales_m(self) -> np.ndarray:
        """Standard deviations along each axis of the world [N, 3]."""
        covariances = np.linalg.inv(np.swapaxes(self.whitenings, 1, 2) @ self.whitenings)
        return np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))


def film_depth_m(rate_mm_h: float) -> float:
    """Return the depth of the water on a road from which rain of this rate runs off.

    It follows the empirical law of road drainage, 0.046 mm sqrt(length rate) / slope^0.2.
    """
    return 0.046e-3 * math.sqrt(_FLOW_M * rate_mm_h) / _CROSSFALL**0.2


def spraying_actors(scene: Scene) -> tuple[int, ...]:
    """Return the numbers (from 0) of the actors that are ever fast enough; cached per scene."""

    def compute() -> tuple[int, ...]:
        return tuple(n for n, actor in enumerate(scene.actors) if _top_speed(actor) > FROM_MPS)

    return memo_of(scene).get(("actors that spray",), compute)


def _top_speed(actor: Actor) -> float:
    times_s = _times_s(actor, int(actor.track.timestamps_ns[0]))
    return float(_speeds(actor, times_s).max())


def spray_puffs(
    scene: Scene,
    time_ns: int,
    water_m: float,
    *,
    seed: int,
    wind_mps: tuple[float, float] = (0.0, 0.0),
) -> Puffs:
    """Return all puffs in the air at a time.

    water_m: depth of the water on the road. wind_mps: velocity of the wind.
    """
    puffs = [
        _puffs_of(scene, number, time_ns, water_m, seed, np.array([*wind_mps, 0.0]))
        for number in spraying_actors(scene)
    ]
    no_puffs = Puffs(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    return Puffs(*(np.concatenate(arrays) for arrays in zip(no_puffs, *puffs, strict=True)))


def _puffs_of(
    scene: Scene, number: int, time_ns: int, water_m: float, seed: int, wind_mps: np.ndarray
) -> Puffs:
    actor = scene.actors[number]
    interval_ns = round(1e9 * INTERVAL_S)
    births = (
        np.arange((time_ns - round(1e9 * LIFE_S)) // interval_ns + 1, time_ns // interval_ns + 1)
        * interval_ns
    )
    # Before its track begins, a vehicle comes straight to its start. It is gone after its end.
    births = births[births <= int(actor.track.timestamps_ns[-1]) + actor.track.hold_ns]
    age_s = (time_ns - births) / 1e9
    start_ns = int(actor.track.timestamps_ns[0])
    born_s = (births - start_ns) / 1e9
    velocity = _velocities(actor, born_s)
    speed = np.linalg.norm(velocity, axis=1)
    share = np.clip((speed - FROM_MPS) / (_FULL_MPS - FROM_MPS) * _FULL_SHARE, 0, _MAX_SHARE)
    share[speed > _MAX_MPS] = 0
    length, width, height = actor.size_m
    size = min(length / _CAR_SIZE_M[0], 4.0) * min(width / _CAR_SIZE_M[1], 2.0)
    per_metre = 3 * _TYRE_M * water_m * share / _DROPLET_M * size
    draws = _draws(seed, scene.name, actor.track_id, births // interval_ns)
    initial_extinction = per_metre * speed * INTERVAL_S * (0.4 + 1.2 * draws[:, 0])  # puffs differ
    remaining_share = (
        np.exp(-age_s / _RAIN_OUT_S)
        * (1 - (age_s / LIFE_S) ** 2)
        * np.minimum(age_s / _GROWTH_S, 1)
    )
    ahead = velocity / np.maximum(speed, 1e-9)[:, None]
    aside = np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))], 1)
    aside /= np.maximum(np.linalg.norm(aside, axis=1), 1e-9)[:, None]
    over = np.cross(ahead, aside)
    dragged = _WAKE_SHARE * speed * _WAKE_S * (1 - np.exp(-age_s / _WAKE_S))
    centres = _places(actor, born_s) + (dragged - 0.4 * length)[:, None] * ahead
    drift = np.minimum(age_s, 2.0)
    centres += (0.5 * (draws[:, 1] - 0.5) * drift)[:, None] * aside
    rise = 0.35 + 0.5 * (1 - np.exp(-age_s / 0.5)) - 0.2 * age_s + 0.3 * (draws[:, 2] - 0.5) * drift
    centres += (np.maximum(rise, 0.2) - height / 2)[:, None] * over
    centres += 0.6 * age_s[:, None] * wind_mps
    lengths = 0.3 + 0.4 * speed * INTERVAL_S + 0.9 * age_s
    widths = 0.35 * width + 0.4 * age_s
    heights = 0.25 + 0.35 * (1 - np.exp(-age_s))
    scales = np.stack([lengths, widths, heights], 1)
    extinction = initial_extinction * remaining_share / ((2 * math.pi) ** 1.5 * scales.prod(1))
    axes = np.stack([ahead, aside, over], 1)
    is_visible = math.sqrt(2 * math.pi) * extinction * scales.max(1) > MIN_OPTICAL_DEPTH
    return Puffs(
        centres[is_visible], (axes / scales[:, :, None])[is_visible], extinction[is_visible]
    )


def _draws(seed: int, scene: str, track_id: str, births: np.ndarray) -> np.ndarray:
    """Return random numbers in [0, 1) of every puff, [N, 3]."""
    rng = rng_for(seed=seed, scene=scene, effect=f"spray of {track_id}")
    key = rng.integers(0, 2**64, dtype=np.uint64)
    columns = np.arange(1, 4, dtype=np.uint64) * np.uint64(STEP_X)
    return (mix(mix(key + births.astype(np.uint64))[:, None] + columns) >> np.uint64(11)) * 2.0**-53


# ---- Positions of vehicles; before their tracks begin they drive straight on ---------------------


def _times_s(actor: Actor, start_ns: int) -> np.ndarray:
    return (actor.track.timestamps_ns.numpy() - start_ns) / 1e9


def _places(actor: Actor, seconds: np.ndarray) -> np.ndarray:
    """Return positions [N, 3] at times since the track's first."""
    track_times_s = _times_s(actor, int(actor.track.timestamps_ns[0]))
    places = actor.track.world_from_actor[:, :3, 3].double().numpy()
    positions = np.stack(
        [np.interp(seconds, track_times_s, places[:, axis]) for axis in range(3)], -1
    )
    if len(track_times_s) > 1:
        # The first and last half second give the speed.
        head = min(np.searchsorted(track_times_s, 2 * _STEP_S), len(track_times_s) - 1)
        tail = max(np.searchsorted(track_times_s, track_times_s[-1] - 2 * _STEP_S, "right") - 1, 0)
        first = (places[head] - places[0]) / (track_times_s[head] - track_times_s[0])
        last = (places[-1] - places[tail]) / (track_times_s[-1] - track_times_s[tail])
        positions = positions + np.minimum(seconds, 0)[:, None] * first
        positions += np.maximum(seconds - track_times_s[-1], 0)[:, None] * last
    return positions


def _velocities(actor: Actor, seconds: np.ndarray) -> np.ndarray:
    return (_places(actor, seconds + _STEP_S) - _places(actor, seconds - _STEP_S)) / (2 * _STEP_S)


def _speeds(actor: Actor, seconds: np.ndarray) -> np.ndarray:
    return np.linalg.norm(_velocities(actor, seconds), axis=1)
