"""The camera's exposure in a scene: fixed, or by the light of sky and lamps on the road."""

from __future__ import annotations

import math

import numpy as np

from augment.effects.lamps.exposure import Exposure, auto_exposure, fixed_exposure
from augment.effects.lamps.plan import LightPlan
from augment.effects.lamps.view_lamps import fixed_lamps
from augment.lamps.lamp import Lamps
from augment.lamps.surface_light import illuminance
from augment.memo import memo_of
from augment.scene.scene import Scene

# Reflectance of a road.
ROAD_REFLECTANCE = 0.1
# Illuminance of the road 10 to 25 m ahead of dipped beams, lux, the mean of both lamps together.
OWN_BEAM_LUX = 2.0
# The same of high beams.
OWN_HIGH_LUX = 4.0
# Weight of the sky's luminance in the metered one.
SKY_WEIGHT = 0.15
# Weight of the luminance of lit air in the metered one.
AIR_WEIGHT = 0.5
# Metered luminance that wet ground adds to a dry road's, over that.
WET_GAIN = 2.0
# Metered luminance that snow adds to a road's, over that.
SNOW_GAIN = 2.0
# Intensity of a lamp that lights the air, candela.
OTHER_CD = 1000.0
# Distance of that lamp, metres.
OTHER_M = 30.0
# Luminance of the air 5 to 10 degrees beside a lamp at optical distance 1, times distance squared
# over intensity (Monte Carlo, asymmetry 0.8).
HALO = 1.8
# Number of places along the path at which the road's light is computed.
_NUM_PLACES = 64


def exposure_of(plan: LightPlan, scene: Scene) -> Exposure:
    """Return the exposure of all cameras at all times; it is computed once for a scene."""
    light = plan.light
    if light.exposure == "fixed":
        return fixed_exposure(light)
    key = ("lamps, exposure", light, plan.has_street_lamps, plan.own_beam)
    key = (*key, plan.extinction_per_m, plan.wetness, plan.snow_cover)
    return memo_of(scene).get(key, lambda: auto_exposure(light, metered_luminance(plan, scene)))


def metered_luminance(plan: LightPlan, scene: Scene) -> float:
    """Return the luminance that the camera exposes for as if it were all road, cd/m2.

    Sky and lit air count with SKY_WEIGHT and AIR_WEIGHT, so that neither dusk nor fog turns white.
    The lit air is that about a lamp of OTHER_CD at OTHER_M metres. A wet road mirrors lamps, and
    snow is several times as bright as a road: the camera closes, but shows both brighter.
    """
    optical_depth = min(plan.extinction_per_m * OTHER_M, 1.0)
    has_traffic = plan.has_vehicle_lamps or plan.has_street_lamps
    halo_cd_m2 = HALO * OTHER_CD / OTHER_M**2 * optical_depth if has_traffic else 0.0
    light_of_sky = SKY_WEIGHT * plan.hour.sky_cd_m2
    road = road_luminance(plan, scene) * (1 + WET_GAIN * plan.wetness + SNOW_GAIN * plan.snow_cover)
    return road + light_of_sky + AIR_WEIGHT * halo_cd_m2


def road_luminance(plan: LightPlan, scene: Scene) -> float:
    """Return the median luminance of the road along the recording car's path, cd/m2.

    It has the light of sky and moon, of lamps that do not move, and of the car's own beams.
    """
    lamps = fixed_lamps(plan, scene)
    places = _road_places(scene)
    lux = np.full(len(places), plan.hour.ground_lux)
    if len(lamps):
        lux += _lux_on_road(lamps, places)
    if plan.own_beam == "high":
        lux += OWN_HIGH_LUX
    elif plan.own_beam == "dipped":
        lux += OWN_BEAM_LUX
    return ROAD_REFLECTANCE * float(np.median(lux)) / math.pi


def _lux_on_road(lamps: Lamps, places: np.ndarray) -> np.ndarray:
    """Return the illuminance of level ground at places [N, 3], lux."""
    normals = np.tile([0.0, 0.0, 1.0], (len(places), 1))
    return illuminance(lamps, places, normals).sum(1)


def _road_places(scene: Scene) -> np.ndarray:
    """Return places [N, 3] on the road along the path, evenly by frame."""
    poses = [frame.world_from_ego[:3, 3].numpy() for frame in scene.frames]
    if not poses:
        return np.zeros((1, 3))
    index = np.linspace(0, len(poses) - 1, min(_NUM_PLACES, len(poses))).round().astype(int)
    places = np.array([poses[i] for i in index])
    if scene.ground_z_m is not None:
        places[:, 2] = np.minimum(places[:, 2], scene.ground_z_m)
    return places
