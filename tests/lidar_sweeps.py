"""Sweeps and scenes made by hand for the tests of weather on LiDAR."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Scene
from recipes.flood import Flood
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.snow import Snow
from tests.snow_scenes import drive, sheet

WORLD_ORIGIN_M = np.array([448_262.125, 4_421_337.5, 41.5])
SENSOR_M = np.array([0.0, 0.0, 1.8])  # scene world


@dataclass(frozen=True)
class SensorLabels:
    """Labels of a sensor that stands still: all sweeps start at sensor_m, dataset world."""

    sensor_m: tuple[float, float, float] | None
    sweeps: Mapping[int, LidarSweep] = field(default_factory=dict)

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return self.sweeps.get(frame_index)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        return None if self.sensor_m is None else np.tile(self.sensor_m, (len(sweep), 1))


def street(*, labels=None, actors=()) -> Scene:
    """Level ground at z = 0 whose dataset lies far from its origin."""
    if labels is None:
        labels = SensorLabels(tuple(SENSOR_M + WORLD_ORIGIN_M))
    return drive(
        sheet((-5, 25), (-5, 5)),
        actors=actors,
        labels=labels,
        world_origin_m=WORLD_ORIGIN_M,
        ground_z_m=0.0,
    )


def sweep_of(points_m: np.ndarray, intensity=0.3, **columns) -> LidarSweep:
    """Returns at points [N, 3] of the scene's world; intensity: fractions, or None for none."""
    points = np.asarray(points_m, np.float64) + WORLD_ORIGIN_M
    named = {name: points[:, axis].copy() for axis, name in enumerate("xyz")}
    if intensity is not None:
        named["intensity"] = np.broadcast_to(intensity, len(points)).astype(np.float32)
    return LidarSweep({**named, **columns})


def ground_points(ranges_m: np.ndarray, z_m: float = 0.0) -> np.ndarray:
    """Points at level distances ahead of the sensor, [N, 3]."""
    distances = np.asarray(ranges_m, np.float64)
    return np.stack([distances, np.zeros_like(distances), np.full_like(distances, z_m)], 1)


def beams(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(origins, unit directions, lengths) of the beams to points [N, 3]."""
    offsets = points - SENSOR_M
    ranges = np.linalg.norm(offsets, axis=1)
    return np.tile(SENSOR_M, (len(points), 1)), offsets / ranges[:, None], ranges


def some_points(count: int = 400, *, seed: int = 0) -> np.ndarray:
    """Points around the sensor, on the ground and above it, [N, 3]."""
    rng = np.random.default_rng(seed)
    angle, reach = rng.uniform(-np.pi, np.pi, count), rng.uniform(3, 90, count)
    height = np.where(rng.random(count) < 0.6, 0.0, rng.uniform(0.1, 6, count))
    return np.stack([reach * np.cos(angle), reach * np.sin(angle), height], 1)


def recipe(smog=None, flood=None, snow=None, **options) -> Recipe:
    """A recipe that weathers its LiDAR; visibility_m of the smog, level_m, depth_m, or models."""
    if isinstance(smog, (int, float)):
        smog = Smog(visibility_m=float(smog))
    if isinstance(flood, (int, float)):
        flood = Flood(level_m=float(flood), reference="absolute")
    if isinstance(snow, (int, float)):
        snow = Snow(depth_m=float(snow))
    weather = Weather(smog=smog, flood=flood, snow=snow)
    return Recipe(weather=weather, output=Output(lidar="weather"), **options)


def ranges_of(sweep: LidarSweep) -> np.ndarray:
    """Distances from the sensor, [N]."""
    return np.linalg.norm(sweep.points_m - WORLD_ORIGIN_M - SENSOR_M, axis=1)
