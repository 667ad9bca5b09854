"""The camera's exposure in a scene: fixed, or by the light of sky and lamps on the road."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

from augment.effects.lamps.exposure import Exposure, auto_exposure, fixed_exposure, white_balance
from augment.effects.lamps.hour import mean_sky_tint, white_of_picture
from augment.effects.lamps.plan import LightPlan
from augment.effects.lamps.view_lamps import fixed_lamps
from augment.lamps.lamp import Lamps, color_of_temperature
from augment.lamps.surface_light import illuminance
from augment.memo import memo_of
from augment.scene.cameras import Camera
from augment.scene.scene import Scene

# Reflectance of a road.
ROAD_REFLECTANCE = 0.1
# Illuminance of the road 10 to 25 m ahead of dipped beams, lux, the mean of both lamps together.
OWN_BEAM_LUX = 2.0
# The same of high beams.
OWN_HIGH_LUX = 4.0
# Colour temperature of these beams, about, kelvin.
OWN_K = 4500.0
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
    scene = scene.as_recorded
    key = ("lamps, exposure", light, plan.has_street_lamps, plan.own_beam)
    key = (*key, plan.extinction_per_m, plan.wetness, plan.snow_cover)
    return memo_of(scene).get(key, lambda: auto_exposure(light, metered_luminance(plan, scene)))


def white_balance_of(plan: LightPlan, scene: Scene) -> Float64[np.ndarray, "3"]:
    """Return the factors of the channels for all cameras at all times."""
    light = plan.light
    scene = scene.as_recorded
    key = ("lamps, white balance", light, plan.has_street_lamps, plan.own_beam)
    return memo_of(scene).get(
        key, lambda: white_balance(_road_color(plan, scene), light.white_balance)
    )


def _road_color(plan: LightPlan, scene: Scene) -> Float64[np.ndarray, "3"]:
    """Return the colour of the median light on the road, linear sRGB, in lux."""
    lamps = fixed_lamps(plan, scene)
    places = _road_places(scene)
    lux = plan.hour.ground_lux * mean_sky_tint(plan.light) + np.zeros((len(places), 3))
    if len(lamps):
        lux += illuminance(lamps, places, _upwards(places)) @ lamps.colors
    lux += _own_lux(plan) * color_of_temperature(OWN_K)
    return np.median(lux, axis=0)


def exposure_of_picture(
    plan: LightPlan, scene: Scene, lit_scene: Scene, camera: Camera
) -> Exposure:
    """Return the exposure of a picture: by day the recorded one, by the picture's white.

    Args:
        plan: the plan.
        scene: the scene.
        lit_scene: the scene as earlier effects relit it.
        camera: the view.
    """
    if plan.hour.is_dark:
        return exposure_of(plan, scene)
    color_map = scene.color_map(camera) if plan.uses_color_map else None
    white = white_of_picture(lit_scene, color_map)
    return Exposure(white / max(plan.hour.white_cd_m2, 1e-9), 1.0, "recorded")


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
    scene = scene.as_recorded
    key = ("lamps, luminance of the road", plan.light, plan.hour, plan.has_street_lamps)
    key = (*key, plan.own_beam)
    return memo_of(scene).get(key, lambda: _find_road_luminance(plan, scene))


def _find_road_luminance(plan: LightPlan, scene: Scene) -> float:
    """Return the median luminance of the road, cd/m2; wetness and snow do not change it."""
    lamps = fixed_lamps(plan, scene)
    places = _road_places(scene)
    lux = np.full(len(places), plan.hour.ground_lux)
    if len(lamps):
        lux += _lux_on_road(lamps, places)
    lux += _own_lux(plan)
    return ROAD_REFLECTANCE * float(np.median(lux)) / math.pi


def _lux_on_road(lamps: Lamps, places: np.ndarray) -> np.ndarray:
    """Return the illuminance of level ground at places [N, 3], lux."""
    return illuminance(lamps, places, _upwards(places)).sum(1)


def _upwards(places: np.ndarray) -> np.ndarray:
    """Return the normals of level ground at places."""
    return np.tile([0.0, 0.0, 1.0], (len(places), 1))


def _own_lux(plan: LightPlan) -> float:
    """Return the illuminance of the road by the recording car's beams, lux."""
    return {"dipped": OWN_BEAM_LUX, "high": OWN_HIGH_LUX}.get(plan.own_beam, 0.0)


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
