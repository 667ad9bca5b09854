"""Boxes and LiDAR sweeps of a street, worked out when asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.street.lidar import sensor_origins, sweep
from adapters.street.parameters import StreetParameters
from adapters.street.rig import frame_time_ns
from adapters.street.truth import StreetTruth
from adapters.street.world import build_street
from augment.errors import SceneError
from augment.labels import Boxes, LidarSweep


@dataclass(frozen=True)
class StreetLabels:
    """Labels of a street; holds only its parameters, so it is cheap to pickle."""

    parameters: StreetParameters

    def boxes(self, frame_index: int) -> Boxes:
        """Moving things first, in the order of the scene's actors, then parked cars."""
        time = np.array([self._time_ns(frame_index)])
        street = build_street(self.parameters)
        rows = []
        for number, mover in enumerate(street.movers, start=1):
            centres, present = mover.motion.at(time)
            if present[0]:
                yaw = mover.motion.yaw
                rows.append((mover.name, mover.label, centres[0], mover.size_m, yaw, False, number))
        for car in street.parked:
            rows.append((car.name, "Car", car.centre, car.size_m, car.yaw, True, 0))
        if not rows:
            return Boxes.empty()
        names, labels, centres, sizes, yaws, parked, instances = zip(*rows, strict=True)
        half = np.array(yaws) / 2
        zero = np.zeros_like(half)
        return Boxes(
            track_ids=names,
            labels=labels,
            centers_m=np.array(centres, np.float64),
            sizes_m=np.array(sizes, np.float64),
            quats=np.stack([np.cos(half), zero, zero, np.sin(half)], 1),
            attributes={
                "is_parked": np.array(parked),
                "instance": np.array(instances, np.uint16),
            },
        )

    def lidar(self, frame_index: int) -> LidarSweep:
        self._time_ns(frame_index)
        return sweep(StreetTruth(build_street(self.parameters)), frame_index)

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray:
        """The SemanticClass of each return: the sweeps' own numbers."""
        return np.asarray(sweep.columns["semantic"], np.int16)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray:
        """Where the sensor was at each return's own time, exactly."""
        self._time_ns(frame_index)
        return sensor_origins(self.parameters, np.asarray(sweep.columns["timestamp_ns"], np.int64))

    def _time_ns(self, frame_index: int) -> int:
        if not 0 <= frame_index < self.parameters.frames:
            raise SceneError(
                f"{self.parameters.uri} has frames 0 to {self.parameters.frames - 1}; "
                f"got {frame_index}"
            )
        return frame_time_ns(frame_index)
