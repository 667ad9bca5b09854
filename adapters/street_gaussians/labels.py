"""Boxes and LiDAR of a drive in Street Gaussians' layout, in the dataset's own world."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from adapters.plain_files import read_pose
from adapters.street_gaussians.calibration import TIMES, read_times
from adapters.street_gaussians.point_clouds import PointCloud, read_point_cloud
from adapters.street_gaussians.tracks import TrackTable, read_track_table, track_files
from augment.errors import AdapterError
from augment.geometry import quat_from_rotmat
from augment.labels import Boxes, LidarSweep

# Of Waymo's cars, from the ego origin: forward, left, up.
ROOF_SENSOR_M = np.array([1.43, 0.0, 2.18])


@dataclass(frozen=True)
class StreetGaussiansLabels:
    """Labels of one dataset directory, read when asked.

    Boxes: all rows of the frame in track/track_info.txt, of whatever class, carried into the world
    by the car's pose at the frame's time; attributes alpha and, where the file has it, speed
    (metres per second). Sweeps: columns x y z (metres), timestamp_ns (the frame's: the points are
    where they were at that moment), and, where the file has projections, camera, u, v: the number
    of the first camera that sees the point, -1 for none, and the pixel there.
    A frame without the car's pose has no boxes and no sweep.
    """

    root: Path

    def boxes(self, frame_index: int) -> Boxes:
        path, _ = track_files(self.root, use_tracker=False)
        pose = self._world_from_ego(frame_index)
        if pose is None or not path.exists():
            return Boxes.empty()
        stat = path.stat()
        return boxes_of_rows(_table(path, stat.st_mtime_ns, stat.st_size), frame_index, pose)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        pose = self._world_from_ego(frame_index)
        cloud = None if pose is None else read_point_cloud(self.root, frame_index)
        if cloud is None:
            return None
        times = read_times(self.root / TIMES)["FRAME"]
        if frame_index not in times:
            raise AdapterError(f"{self.root / TIMES}: FRAME lacks frame {frame_index:06d}")
        return sweep_of(cloud, pose, round(times[frame_index] * 1e9))

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Waymo's roof sensor in the car's pose of the frame. The files join the returns of five
        sensors and do not tell them apart: those of the four at the bumpers and sides, which see
        20 m far, are taken for the roof's, too.
        """
        pose = self._world_from_ego(frame_index)
        if pose is None:
            return None
        return np.broadcast_to(pose[:3, :3] @ ROOF_SENSOR_M + pose[:3, 3], (len(sweep), 3))

    def _world_from_ego(self, frame: int) -> np.ndarray | None:
        path = self.root / "ego_pose" / f"{frame:06d}.txt"
        return read_pose(path) if path.exists() else None


def labels_of(root: Path) -> StreetGaussiansLabels | None:
    """The labels of a dataset directory; None where there is none."""
    return StreetGaussiansLabels(root) if (root / "ego_pose").is_dir() else None


def boxes_of_rows(table: TrackTable, frame: int, world_from_ego: np.ndarray) -> Boxes:
    """The table's rows of a frame as boxes in the world of the pose, float64 [4, 4]."""
    rows = np.flatnonzero(table.frames == frame)
    world_from_box = world_from_ego @ ego_from_boxes(table, rows)
    attributes = {"alpha": table.alphas[rows]}
    if table.speeds_mps is not None:
        attributes["speed"] = table.speeds_mps[rows]
    return Boxes(
        track_ids=tuple(str(track_id) for track_id in table.ids[rows].tolist()),
        labels=tuple(table.labels[row] for row in rows),
        centers_m=world_from_box[:, :3, 3],
        sizes_m=table.sizes_m[rows],
        quats=quat_from_rotmat(torch.from_numpy(world_from_box[:, :3, :3])).numpy(),
        attributes=attributes,
    )


def ego_from_boxes(table: TrackTable, rows: np.ndarray) -> np.ndarray:
    """Poses of the rows' boxes in the vehicle's frame, float64 [R, 4, 4]."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    cos, sin = np.cos(table.headings[rows]), np.sin(table.headings[rows])
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cos, -sin, sin, cos
    poses[:, :3, 3] = table.centers_m[rows]
    return poses


def sweep_of(cloud: PointCloud, world_from_ego: np.ndarray, timestamp_ns: int) -> LidarSweep:
    """The returns in the world of the pose, in the file's order."""
    world = cloud.points @ world_from_ego[:3, :3].T + world_from_ego[:3, 3]
    columns: dict[str, np.ndarray] = {axis: world[:, i].copy() for i, axis in enumerate("xyz")}
    columns["timestamp_ns"] = np.full(len(world), timestamp_ns, np.int64)
    if cloud.projections is not None:
        for i, name in enumerate(("camera", "u", "v")):
            columns[name] = cloud.projections[:, i].copy()
    return LidarSweep(columns)


@lru_cache(maxsize=2)
def _table(path: Path, mtime_ns: int, size: int) -> TrackTable:
    """A track file; mtime_ns and size tell whether it is still the one that was read."""
    return read_track_table(path)
