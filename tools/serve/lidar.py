"""LiDAR of requests: the recorded sweep that is nearest in time and place, in the weather.

A sweep is what the recording car's sensor saw from where it was: returns are put into the frame of
the request, but no beam is cast anew, and moving objects are where they were recorded.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.effects.lidar.beam import find_intensity_column, highest_intensity
from augment.effects.lidar.codes import drop_lost_returns
from augment.scene.cameras import Frame
from augment.scene.geometry import invert_rigid
from augment.scene.labels import LidarSweep
from augment.scene.scene import Scene
from augment.view.weathered_sweep import weathered_sweep
from recipes.schema import Recipe
from tools.serve.cameras import check_exposure, check_time
from tools.serve.errors import unimplemented
from tools.serve.messages import message_class
from tools.serve.poses import pose_pair
from tools.serve.scene_facts import NS_PER_US, SceneFacts

# Distance between the requested sensor and the recording car's origin, at most, metres. Sensors
# stand up to 3 m from that origin.
MAX_DISTANCE_M = 8.0
# Metres that count as much as a second between the request and the sweep.
_METRES_PER_SECOND = 5.0


def requested_sweep(request: Any, scene: Scene, recipe: Recipe, facts: SceneFacts) -> Any:
    """Return the `LidarRenderReturn` of a `LidarRenderRequest`.

    Args:
        request: the message.
        scene: the scene.
        recipe: the weather.
        facts: facts of the scene.

    Raises:
        RequestRefused: the scene has no sweep near the pose, or a field cannot be used.
    """
    check_exposure(request)
    timestamp_ns = request.frame_end_us * NS_PER_US
    check_time(timestamp_ns, facts)
    _, world_from_sensor = pose_pair(request.sensor_pose, "sensor_pose")
    frame, sweep = _nearest_sweep(scene, world_from_sensor[:3, 3], timestamp_ns)
    sweep = drop_lost_returns(weathered_sweep(scene, recipe, frame.index, sweep))
    points_m = torch.from_numpy(sweep.points_m - np.asarray(scene.world_origin_m))
    sensor_from_world = invert_rigid(world_from_sensor)
    local_m = points_m @ sensor_from_world[:3, :3].T + sensor_from_world[:3, 3]
    xyz = local_m.numpy().astype("<f4")
    intensities = _intensities(sweep)
    return message_class("LidarRenderReturn")(
        point_xyzs=xyz.ravel(),
        point_intensities=intensities,
        num_points=len(sweep),
        point_xyzs_buffer=xyz.tobytes(),
        point_intensities_buffer=intensities.tobytes(),
    )


def _nearest_sweep(scene: Scene, position: Tensor, timestamp_ns: int) -> tuple[Frame, LidarSweep]:
    """Return the frame nearest to a place and a time that has a sweep, and the sweep.

    Args:
        scene: the scene.
        position: place of the sensor, world, metres, [3].
        timestamp_ns: end of the requested spin.
    """
    if scene.labels is None:
        raise unimplemented(
            f"scene {scene.name!r} has no LiDAR: this server returns recorded sweeps in the "
            f"weather, and renders none"
        )

    def distance_m(frame: Frame) -> float:
        return float((frame.world_from_ego[:3, 3] - position).norm())

    def cost(frame: Frame) -> float:
        seconds = abs(frame.timestamp_ns - timestamp_ns) / 1e9
        return distance_m(frame) + _METRES_PER_SECOND * seconds

    near_frames = [frame for frame in scene.frames if distance_m(frame) <= MAX_DISTANCE_M]
    for frame in sorted(near_frames, key=cost):
        sweep = scene.lidar(frame.index)
        if sweep is not None:
            return frame, sweep
    raise unimplemented(
        f"scene {scene.name!r} has no recorded sweep near this pose: the recorded path is "
        f"{min(map(distance_m, scene.frames)):.1f} m away; this server returns recorded sweeps up "
        f"to {MAX_DISTANCE_M:g} m away, and renders none"
    )


def _intensities(sweep: LidarSweep) -> np.ndarray:
    """Return the intensities, float32 [N], 0 to 1; 0 where the sweep has none."""
    name = find_intensity_column(sweep)
    if name is None:
        return np.zeros(len(sweep), "<f4")
    column = np.asarray(sweep.columns[name])
    values = np.nan_to_num(column.astype(np.float64)) / highest_intensity(column)
    return np.clip(values, 0, 1).astype("<f4")
