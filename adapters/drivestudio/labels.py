"""Boxes and LiDAR of the processed data a run was trained on, in the scene's world."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from adapters.drivestudio.drive import dataset_from_lidar, scene_from_dataset
from adapters.drivestudio.instances import read_instances
from adapters.drivestudio.options import RunOptions
from adapters.drivestudio.run import Run, find_run
from adapters.lidar.stored import stored_records
from augment.errors import AdapterError
from augment.geometry import quat_from_rotmat
from augment.labels import Boxes, LidarSweep

_MOVED = (("x", "y", "z"), ("origin_x", "origin_y", "origin_z"))
_TURNED = ("flow_x", "flow_y", "flow_z")


@dataclass(frozen=True, eq=False)
class DriveStudioLabels:
    """Labels of a run's data, read when asked.

    The scene's world is the model's (see adapters.drivestudio.drive), not the dataset's, from which
    it is turned: so are these labels. Boxes: x forward; track_ids are the data's ids; `instance` is
    their number in instances_info.json. Sweeps: the columns of Convention.lidar_columns, of which
    points, and Waymo's origins and flows, are moved from the frame of the car (nuScenes: of the
    sensor, lidar_pose) at that moment; they are taken to be in it, as the project's loaders do.
    """

    run: Run

    def boxes(self, frame_index: int) -> Boxes:
        scene = scene_from_dataset(self.run)
        object_from_actor = self.run.convention.object_from_actor
        found = [
            (instance, int(at[0]))
            for instance in read_instances(self.run.data) or ()
            if len(at := np.flatnonzero(instance.frames == frame_index))
        ]
        if not found:
            return Boxes.empty()
        poses = scene @ np.stack([instance.poses[at] for instance, at in found])
        rotations = poses[:, :3, :3] @ object_from_actor
        sizes = np.stack([instance.sizes_m[at] for instance, at in found])
        return Boxes(
            track_ids=tuple(instance.track_id for instance, _ in found),
            labels=tuple(instance.label for instance, _ in found),
            centers_m=poses[:, :3, 3].copy(),
            sizes_m=sizes @ np.abs(object_from_actor),
            quats=quat_from_rotmat(torch.from_numpy(rotations)).numpy(),
            attributes={"instance": np.array([instance.number for instance, _ in found])},
        )

    def lidar(self, frame_index: int) -> LidarSweep | None:
        file = self._lidar_file(frame_index)
        if not file.is_file():
            return None
        names = self.run.convention.lidar_columns
        if file.stat().st_size % (4 * len(names)):
            raise AdapterError(
                f"{file} must hold rows of {len(names)} float32 ({', '.join(names)}); its "
                f"{file.stat().st_size} bytes are no whole number of them"
            )
        table = np.fromfile(file, "<f4").reshape(-1, len(names))
        pose = self._world_from_lidar(frame_index)
        columns = {name: table[:, i].copy() for i, name in enumerate(names)}
        for group in (*_MOVED, _TURNED):
            if group[0] not in columns:
                continue
            values = np.stack([columns[name] for name in group], axis=1).astype(np.float64)
            values = values @ pose[:3, :3].T + (0 if group == _TURNED else pose[:3, 3])
            columns |= {name: values[:, i].copy() for i, name in enumerate(group)}
        return LidarSweep(columns)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Waymo's own origins, return by return; nuScenes' sensor in lidar_pose. The other
        datasets' files have returns in the car's frame and do not say where the sensor is on it.
        """
        names = _MOVED[1]
        if all(name in sweep.columns for name in names):
            return np.stack([np.asarray(sweep.columns[name], np.float64) for name in names], axis=1)
        if not self.run.convention.world_of_front_camera:
            return None
        return np.broadcast_to(self._world_from_lidar(frame_index)[:3, 3], (len(sweep), 3))

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        file = self._lidar_file(frame_index)
        return (file,) if file.is_file() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        names = self.run.convention.lidar_columns
        records = np.fromfile(file, "<f4").reshape(-1, len(names))
        return stored_records(records, names, sweep, self._world_from_lidar(frame_index))

    def _lidar_file(self, frame: int) -> Path:
        return self.run.data / "lidar" / f"{frame:03d}.bin"

    def _world_from_lidar(self, frame: int) -> np.ndarray:
        return scene_from_dataset(self.run) @ dataset_from_lidar(self.run, frame)


def drivestudio_labels(path: str, query: dict[str, str]) -> DriveStudioLabels:
    """The labels of a run's data; whatever frames the query asks for, they are those of all.

    Raises:
        AdapterError: as for open_drivestudio, as far as config and data are concerned.
    """
    return DriveStudioLabels(find_run(Path(path), RunOptions.from_query(query)))
