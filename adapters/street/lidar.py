"""A spinning LiDAR on the ego car's roof, by exact ray casting; moving things stand where they are
at each ray's own time.
"""

from __future__ import annotations

import numpy as np

from adapters.street.layout import FRAME_NS
from adapters.street.parameters import StreetParameters
from adapters.street.rig import ego_pose, frame_time_ns
from adapters.street.truth import StreetTruth
from adapters.street.world import Street
from augment.labels import LidarSweep
from augment.semantics import SemanticClass

SENSOR_M = (0.6, 0.0, 1.95)  # forward, left, up from the ego origin
LOWEST_DEG, HIGHEST_DEG = -24.0, 14.0
REACH_M = (1.5, 120.0)
# Share of the beam that comes back from a surface met head on.
REFLECTIVITY = {
    SemanticClass.ROAD: 0.14,
    SemanticClass.LANE_MARKING: 0.62,
    SemanticClass.SIDEWALK: 0.30,
    SemanticClass.TERRAIN: 0.38,
    SemanticClass.VEGETATION: 0.42,
    SemanticClass.BUILDING: 0.40,
    SemanticClass.BARRIER: 0.36,
    SemanticClass.POLE: 0.45,
    SemanticClass.SIGN: 0.95,
    SemanticClass.VEHICLE: 0.34,
    SemanticClass.PEDESTRIAN: 0.30,
    SemanticClass.OTHER: 0.30,
}


def lidar_rays(street: Street, frame_index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins [C, 3], unit directions [C, R, 3] and times [C] of a sweep of C columns, R rings.

    The beam starts behind the car half a frame early, turns clockwise, and looks ahead at the
    frame's time. Ring 0 is the lowest.
    """
    parameters = street.parameters
    columns, rings = parameters.lidar_columns, parameters.lidar_rings
    turn = (np.arange(columns) + 0.5) / columns - 0.5
    times = frame_time_ns(frame_index) + np.round(turn * FRAME_NS).astype(np.int64)
    pose = ego_pose(parameters, times)
    azimuth = (pose.yaws - 2 * np.pi * turn)[:, None]
    elevation = np.radians(np.linspace(LOWEST_DEG, HIGHEST_DEG, rings))[None, :]
    directions = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0 * azimuth,
        ],
        -1,
    )
    return sensor_origins(parameters, times), directions, times


def sensor_origins(parameters: StreetParameters, timestamps_ns: np.ndarray) -> np.ndarray:
    """Where the sensor is at times [N], float64 [N, 3]."""
    pose = ego_pose(parameters, timestamps_ns)
    forward, left, up = SENSOR_M
    c, s = np.cos(pose.yaws), np.sin(pose.yaws)
    offset = np.stack([c * forward - s * left, s * forward + c * left, np.full(len(c), up)], 1)
    return pose.positions + offset


def sweep(truth: StreetTruth, frame_index: int) -> LidarSweep:
    """One turn's returns. Columns: x, y, z float64 metres; intensity float32 in [0, 1];
    timestamp_ns int64; ring uint8; semantic uint8 (SemanticClass); instance uint16 (as images').
    """
    origins, directions, times = lidar_rays(truth.street, frame_index)
    rings = directions.shape[1]
    origin, time = np.repeat(origins, rings, axis=0), np.repeat(times, rings)
    direction = directions.reshape(-1, 3)
    hits = truth.cast(origin, direction, time, with_rgb=False)
    kept = np.flatnonzero((hits.distance > REACH_M[0]) & (hits.distance < REACH_M[1]))
    distance, semantic = hits.distance[kept], hits.semantic[kept]
    points = origin[kept] + distance[:, None] * direction[kept]
    table = np.zeros(len(SemanticClass))
    for value, share in REFLECTIVITY.items():
        table[value] = share
    incidence = np.abs((hits.normal[kept] * direction[kept]).sum(1))
    intensity = table[semantic] * (0.25 + 0.75 * incidence) * np.exp(-distance / 150)
    return LidarSweep(
        {
            "x": points[:, 0],
            "y": points[:, 1],
            "z": points[:, 2],
            "intensity": intensity.astype(np.float32),
            "timestamp_ns": time[kept],
            "ring": np.tile(np.arange(rings), len(times))[kept].astype(np.uint8),
            "semantic": semantic.astype(np.uint8),
            "instance": hits.instance[kept].astype(np.uint16),
        }
    )
