"""Spray behind vehicles on a wet road: puffs of droplets from the vehicles' tracks and the time.

`augment.effects.spray` draws the puffs that `spray_puffs` returns. A vehicle lifts the water that
its tyres meet, and a share f of it stays in the air as droplets:

    extinction per metre driven = 3 w h f / d   [m^2 / m]        f = 0.1 (v - 40 km/h) / (50 km/h)

Here w is the tyres' width, h the water's depth, v the speed and d the droplets' diameter. (The
extinction of spheres that are large against the wavelength is 3 LWC / (rho d), for a water content
LWC.) At 90 km/h on a millimetre of water, this fills 2 x 1.5 m with 0.067 /m. f, w and d are
assumed; they are right to a factor of 2.

Every INTERVAL_S of absolute time, each vehicle that is fast enough leaves a puff at its position. A
puff is a Gaussian that the wake drags along, that the wind carries, that spreads, and rains out.
Its position follows from the time when it was born, so no image needs another image.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from augment.memo import memo_of
from augment.rng import STEP_X, mix, rng_for
from augment.scene.scene import Actor, Scene
from recipes.rain import Rain
from recipes.road_water import TRACK_FILM_SHARE

# Speed from which a vehicle lifts spray.
MIN_SPEED_MPS = 40 / 3.6
# Speed at which _FULL_SHARE of the water is in the air.
_FULL_SHARE_SPEED_MPS = 90 / 3.6
# Share of the water that is in the air at _FULL_SHARE_SPEED_MPS.
_FULL_SHARE = 0.1
# Largest share of the water that is in the air.
_MAX_SHARE = 0.2
# Width of the tyres.
_TYRE_M = 0.2
# Diameter of the droplets.
_DROPLET_M = 3e-4
# Length and width of a usual car; others lift more or less by their size.
_CAR_SIZE_M = (4.5, 1.8)
# Length over which the water runs off the road.
_FLOW_M = 5.0
# Slope of the road across.
_CROSSFALL = 0.02
# Film that tyres do not lift, mm.
_LEAST_FILM_MM = 0.05
# Time between two puffs of a vehicle.
INTERVAL_S = 0.1
# Life of a puff.
LIFE_S = 3.5
# Time constant in which droplets rain out.
_RAIN_OUT_S = 1.2
# Time in which a puff comes up.
_APPEARANCE_S = 0.12
# Share of the vehicle's speed with which the wake drags a puff.
_WAKE_SHARE = 0.35
# Time constant in which that drag ends.
_WAKE_S = 0.5
# Time to either side over which speeds are differences of positions.
_STEP_S = 0.25
# Largest plausible speed; a faster track has jumped.
_MAX_MPS = 70.0
# Optical depth below which a puff is left out.
MIN_OPTICAL_DEPTH = 0.003
# Square of the distance in standard deviations at which a puff ends.
CUT_DISTANCE2 = 9.0


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


def lifted_water_m(rain: Rain) -> float:
    """Return the depth of the water that tyres meet on the road.

    While it rains it is the film that runs off. After rain it is what wheels leave in their tracks,
    less a film that tyres do not lift (NORTRIP).
    """
    running_m = film_depth_m(rain.rate_mm_h) * rain.ground_wetness
    if rain.road is None:
        return running_m
    track_m = 1e-3 * TRACK_FILM_SHARE * max(rain.road.film_mm - _LEAST_FILM_MM, 0.0)
    return max(running_m, track_m * rain.film_wetness)


def spraying_actors(scene: Scene) -> tuple[int, ...]:
    """Return the numbers (from 0) of the actors that are ever fast enough; cached per scene."""

    def compute() -> tuple[int, ...]:
        return tuple(n for n, actor in enumerate(scene.actors) if _top_speed(actor) > MIN_SPEED_MPS)

    return memo_of(scene).get(("actors that spray",), compute)


def _top_speed(actor: Actor) -> float:
    """Return the largest speed at the times of the track, m/s."""
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

    Args:
        scene: the scene with its actors.
        time_ns: absolute time.
        water_m: depth of the water on the road.
        seed: seed of the differences between puffs.
        wind_mps: velocity of the wind along the world's x and y.
    """
    puffs = [
        _puffs_of(scene, number, time_ns, water_m, seed, np.array([*wind_mps, 0.0]))
        for number in spraying_actors(scene)
    ]
    no_puffs = Puffs(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    return Puffs(*(np.concatenate(arrays) for arrays in zip(no_puffs, *puffs, strict=True)))


def _puffs_of(
    scene: Scene, actor_number: int, time_ns: int, water_m: float, seed: int, wind_mps: np.ndarray
) -> Puffs:
    actor = scene.actors[actor_number]
    interval_ns = round(1e9 * INTERVAL_S)
    birth_times_ns = (
        np.arange((time_ns - round(1e9 * LIFE_S)) // interval_ns + 1, time_ns // interval_ns + 1)
        * interval_ns
    )
    # Before its track begins, a vehicle comes straight to its start. It is gone after its end.
    birth_times_ns = birth_times_ns[
        birth_times_ns <= int(actor.track.timestamps_ns[-1]) + actor.track.hold_ns
    ]
    age_s = (time_ns - birth_times_ns) / 1e9
    start_ns = int(actor.track.timestamps_ns[0])
    birth_times_s = (birth_times_ns - start_ns) / 1e9
    velocities = _velocities(actor, birth_times_s)
    speeds = np.linalg.norm(velocities, axis=1)
    water_share = np.clip(
        (speeds - MIN_SPEED_MPS) / (_FULL_SHARE_SPEED_MPS - MIN_SPEED_MPS) * _FULL_SHARE,
        0,
        _MAX_SHARE,
    )
    water_share[speeds > _MAX_MPS] = 0
    length, width, height = actor.size_m
    size_factor = min(length / _CAR_SIZE_M[0], 4.0) * min(width / _CAR_SIZE_M[1], 2.0)
    extinction_per_driven_m = 3 * _TYRE_M * water_m * water_share / _DROPLET_M * size_factor
    random_numbers = _random_numbers(
        seed, scene.name, actor.track_id, birth_times_ns // interval_ns
    )
    initial_extinction = (
        extinction_per_driven_m * speeds * INTERVAL_S * (0.4 + 1.2 * random_numbers[:, 0])
    )  # puffs differ
    remaining_share = (
        np.exp(-age_s / _RAIN_OUT_S)
        * (1 - (age_s / LIFE_S) ** 2)
        * np.minimum(age_s / _APPEARANCE_S, 1)
    )
    forward = velocities / np.maximum(speeds, 1e-9)[:, None]
    sideways = np.stack([-forward[:, 1], forward[:, 0], np.zeros(len(forward))], 1)
    sideways /= np.maximum(np.linalg.norm(sideways, axis=1), 1e-9)[:, None]
    upward = np.cross(forward, sideways)
    drag_m = _WAKE_SHARE * speeds * _WAKE_S * (1 - np.exp(-age_s / _WAKE_S))
    centres = _positions(actor, birth_times_s) + (drag_m - 0.4 * length)[:, None] * forward
    drift_time_s = np.minimum(age_s, 2.0)
    centres += (0.5 * (random_numbers[:, 1] - 0.5) * drift_time_s)[:, None] * sideways
    rise_m = (
        0.35
        + 0.5 * (1 - np.exp(-age_s / 0.5))
        - 0.2 * age_s
        + 0.3 * (random_numbers[:, 2] - 0.5) * drift_time_s
    )
    centres += (np.maximum(rise_m, 0.2) - height / 2)[:, None] * upward
    centres += 0.6 * age_s[:, None] * wind_mps
    lengths = 0.3 + 0.4 * speeds * INTERVAL_S + 0.9 * age_s
    widths = 0.35 * width + 0.4 * age_s
    heights = 0.25 + 0.35 * (1 - np.exp(-age_s))
    scales = np.stack([lengths, widths, heights], 1)
    extinction = initial_extinction * remaining_share / ((2 * math.pi) ** 1.5 * scales.prod(1))
    axes = np.stack([forward, sideways, upward], 1)
    is_visible = math.sqrt(2 * math.pi) * extinction * scales.max(1) > MIN_OPTICAL_DEPTH
    return Puffs(
        centres[is_visible], (axes / scales[:, :, None])[is_visible], extinction[is_visible]
    )


def _random_numbers(seed: int, scene: str, track_id: str, birth_numbers: np.ndarray) -> np.ndarray:
    """Return random numbers in [0, 1) of every puff, [N, 3]."""
    rng = rng_for(seed=seed, scene=scene, effect=f"spray of {track_id}")
    seed_key = rng.integers(0, 2**64, dtype=np.uint64)
    columns = np.arange(1, 4, dtype=np.uint64) * np.uint64(STEP_X)
    return (
        mix(mix(seed_key + birth_numbers.astype(np.uint64))[:, None] + columns) >> np.uint64(11)
    ) * 2.0**-53


# ---- Positions of vehicles; before their tracks begin they drive straight on ---------------------


def _times_s(actor: Actor, start_ns: int) -> np.ndarray:
    """Return the times of the track, seconds since start_ns."""
    return (actor.track.timestamps_ns.numpy() - start_ns) / 1e9


def _positions(actor: Actor, seconds: np.ndarray) -> np.ndarray:
    """Return positions [N, 3] at times since the track's first."""
    track_times_s = _times_s(actor, int(actor.track.timestamps_ns[0]))
    track_positions = actor.track.world_from_actor[:, :3, 3].double().numpy()
    positions = np.stack(
        [np.interp(seconds, track_times_s, track_positions[:, axis]) for axis in range(3)], -1
    )
    if len(track_times_s) > 1:
        # The first and last half second give the speed.
        head_index = min(np.searchsorted(track_times_s, 2 * _STEP_S), len(track_times_s) - 1)
        tail_index = max(
            np.searchsorted(track_times_s, track_times_s[-1] - 2 * _STEP_S, "right") - 1, 0
        )
        first_velocity = (track_positions[head_index] - track_positions[0]) / (
            track_times_s[head_index] - track_times_s[0]
        )
        last_velocity = (track_positions[-1] - track_positions[tail_index]) / (
            track_times_s[-1] - track_times_s[tail_index]
        )
        positions = positions + np.minimum(seconds, 0)[:, None] * first_velocity
        positions += np.maximum(seconds - track_times_s[-1], 0)[:, None] * last_velocity
    return positions


def _velocities(actor: Actor, seconds: np.ndarray) -> np.ndarray:
    """Return velocities at times since the track's first, m/s, [N, 3]."""
    return (_positions(actor, seconds + _STEP_S) - _positions(actor, seconds - _STEP_S)) / (
        2 * _STEP_S
    )


def _speeds(actor: Actor, seconds: np.ndarray) -> np.ndarray:
    """Return speeds at times since the track's first, m/s, [N]."""
    return np.linalg.norm(_velocities(actor, seconds), axis=1)
