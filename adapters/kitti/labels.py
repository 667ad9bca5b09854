"""KITTI's boxes and sweeps in the dataset's world, read when asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.kitti.layout import OBJECT_DIGITS, file_in
from adapters.kitti.object_labels import boxes_of_lines, read_object_lines
from adapters.kitti.sweeps import labelled_sweep, read_returns
from adapters.kitti.tracklets import Tracklet, boxes_at
from adapters.lidar.stored import stored_records
from augment.errors import AdapterError
from augment.labels import Boxes, LidarSweep

_RECORD = ("x", "y", "z", "intensity")  # of a sweep's file


@dataclass(frozen=True, eq=False)
class LocatedSweeps:
    """Sweeps and where they were taken, by frame. names: files relative to the root.
    world_from_velodyne: float64 [4, 4] in the dataset's world."""

    root: Path
    names: Mapping[int, str]
    timestamps_ns: Mapping[int, int]
    world_from_velodyne: Mapping[int, np.ndarray]

    def read(self, frame: int) -> LidarSweep | None:
        """The frame's sweep; None without a file or a pose, or where the file is damaged, which
        the scene's problems say."""
        name, pose = self.names.get(frame), self.world_from_velodyne.get(frame)
        if name is None or pose is None:
            return None
        try:
            returns = read_returns(self.root, name)
        except AdapterError:
            return None
        return labelled_sweep(returns, pose, self.timestamps_ns[frame])

    def origins(self, frame: int, sweep: LidarSweep) -> np.ndarray | None:
        """The Velodyne's place in its pose of the frame; what the car drives within the turn of
        0.1 s is left out, as it is left in the returns."""
        pose = self.world_from_velodyne.get(frame)
        return None if pose is None else np.broadcast_to(pose[:3, 3], (len(sweep), 3))

    def files(self, frame: int) -> tuple[Path, ...]:
        """The frame's file, where it is there and has a pose."""
        name = self.names.get(frame)
        if name is None or frame not in self.world_from_velodyne:
            return ()
        file = file_in(self.root, name)
        return (file,) if file.exists() else ()

    def content(self, frame: int, sweep: LidarSweep) -> bytes:
        """That file with a weathered sweep in place of its own."""
        records = read_returns(self.root, self.names[frame])
        return stored_records(records, _RECORD, sweep, self.world_from_velodyne[frame])


@dataclass(frozen=True, eq=False)
class RawLabels:
    """Labels of a raw drive. Boxes are tracklets (see tracklets.boxes_at); sweeps have the columns
    x y z (metres), intensity (reflectance 0 to 1), timestamp_ns (the frame's)."""

    sweeps: LocatedSweeps
    tracklets: tuple[Tracklet, ...]

    def boxes(self, frame_index: int) -> Boxes:
        pose = self.sweeps.world_from_velodyne.get(frame_index)
        return Boxes.empty() if pose is None else boxes_at(self.tracklets, frame_index, pose)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return self.sweeps.read(frame_index)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        return self.sweeps.origins(frame_index, sweep)

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        return self.sweeps.files(frame_index)

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        return self.sweeps.content(frame_index, sweep)


@dataclass(frozen=True, eq=False)
class ObjectLabels:
    """Labels of one frame of the object benchmark, in its Velodyne's frame; see
    object_labels.boxes_of_lines and RawLabels for the columns."""

    sweeps: LocatedSweeps
    number: int
    velodyne_from_rectified: np.ndarray

    def boxes(self, frame_index: int) -> Boxes:
        path = object_label_file(self.sweeps.root, frame_index)
        if frame_index != self.number or not path.exists():
            return Boxes.empty()
        return boxes_of_lines(read_object_lines(path), self.velodyne_from_rectified)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return self.sweeps.read(frame_index)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        return self.sweeps.origins(frame_index, sweep)

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        return self.sweeps.files(frame_index)

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        return self.sweeps.content(frame_index, sweep)


def object_label_file(root: Path, frame: int) -> Path:
    """The label file of a frame, there or not."""
    return file_in(root, f"label_2/{frame:0{OBJECT_DIGITS}d}.txt")
