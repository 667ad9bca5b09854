"""Boxes and LiDAR of a drive in Street Gaussians' layout, in the dataset's own world."""

from __future__ import annotations

import os
import threading
import zipfile
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from adapters.plain_files import read_pose
from adapters.safe_pickle import check_holds_object, stream_arrays
from adapters.street_gaussians.data import (
    TIMES,
    TrackTable,
    read_times,
    read_track_table,
    track_files,
)
from adapters.training_views.byte_cache import ByteCache
from augment.errors import AdapterError
from augment.files.pickles import PickleError
from augment.geometry import quat_from_rotmat
from augment.labels import Boxes, LidarSweep

# ------------------------------------------------------------------------------------------------
# LiDAR of a drive in Street Gaussians' layout: pointcloud.npz, a ZIP of pickled dictionaries
#     pointcloud[frame]           float [N, 3], vehicle frame at the frame's time
#     camera_projection[frame]    int16 [N, 6]: camera, x, y of the first camera that sees the point
#                                 and of the second; camera -1 for none
#
# The file holds the whole drive, compressed, in no way to get at one frame. It is therefore read
# forward, and where reading stopped is kept: frames asked for in their order cost one pass.

FILE = "pointcloud.npz"
_POINTS, _PROJECTIONS = "pointcloud.npy", "camera_projection.npy"
_KEPT_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class PointCloud:
    """points: float64 [N, 3], vehicle frame. projections: int16 [N, 6], or None where the file has
    none."""

    points: np.ndarray
    projections: np.ndarray | None

    @property
    def nbytes(self) -> int:
        return self.points.nbytes + (0 if self.projections is None else self.projections.nbytes)


def read_point_cloud(root: Path, frame: int) -> PointCloud | None:
    """The returns of a frame; None where there is no file, or no such frame in it.

    Raises:
        AdapterError: the file is damaged, asks for anything but arrays, or holds others.
    """
    path = root / FILE
    if not path.exists():
        return None
    with _lock:
        return _reader_of(path).read(frame)


def iterate_point_clouds(root: Path) -> Iterator[tuple[int, PointCloud]]:
    """Frame number and returns of every frame, in the file's order; nothing without the file.

    Raises:
        AdapterError: as for read_point_cloud.
    """
    path = root / FILE
    if path.exists():
        yield from _clouds(path)


class _Reader:
    """One file being read forward, and the frames that were last passed by."""

    def __init__(self, path: Path, state: tuple[int, ...]) -> None:
        self.path = path
        self.state = state
        self._recent: ByteCache[PointCloud] = ByteCache(_KEPT_BYTES)
        self._all: frozenset[int] | None = None  # frames of the file, known after a whole pass
        self._passed: set[int] = set()
        self._clouds = _clouds(path)

    def read(self, frame: int) -> PointCloud | None:
        found = self._recent.get(frame)
        if found is not None:
            return found
        if self._all is not None and frame not in self._all:
            return None
        if frame in self._passed:
            self.close()
        try:
            for number, cloud in self._clouds:
                self._passed.add(number)
                self._recent.put(number, cloud, cloud.nbytes)
                if number == frame:
                    return cloud
        except BaseException:
            self.close()
            raise
        self._all = frozenset(self._passed)
        self.close()
        return None

    def close(self) -> None:
        """Leave the file; the next reading starts at its beginning."""
        self._clouds.close()
        self._clouds = _clouds(self.path)
        self._passed = set()


_lock = threading.Lock()
_readers: list[_Reader] = []  # of the file last read from


def _reader_of(path: Path) -> _Reader:
    stat = path.stat()
    # A forked process shares its parent's place in an open file: it opens the file itself.
    state = (stat.st_mtime_ns, stat.st_size, os.getpid())
    if not _readers or (_readers[0].path, _readers[0].state) != (path, state):
        for reader in _readers:
            reader.close()
        _readers[:] = [_Reader(path, state)]
    return _readers[0]


def _clouds(path: Path) -> Generator[tuple[int, PointCloud]]:
    """Every frame of the file."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if _POINTS not in names:
                raise AdapterError(
                    f"{path} must hold the arrays pointcloud and camera_projection; it holds "
                    f"{names[:5]}"
                )
            with archive.open(_POINTS) as points:
                if _PROJECTIONS not in names:
                    yield from _checked(path, _entries(path, _POINTS, points), None)
                    return
                with archive.open(_PROJECTIONS) as projections:
                    yield from _checked(
                        path,
                        _entries(path, _POINTS, points),
                        _entries(path, _PROJECTIONS, projections),
                    )
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise AdapterError(
            f"{path} is no whole .npz file of dictionaries ({error}); copy it again"
        ) from error
    except OSError as error:
        raise AdapterError(f"{path} cannot be read: {error}") from error


def _entries(path: Path, member: str, file: BinaryIO) -> Iterator[tuple[int, np.ndarray]]:
    where = f"{path}, {member}"
    try:
        check_holds_object(file)
        yield from stream_arrays(file)
    except PickleError as error:
        raise AdapterError(
            f"{where} was not read: {error}. Only a dictionary of arrays of numbers by frame is "
            f"accepted"
        ) from None


def _checked(
    path: Path,
    points: Iterator[tuple[int, np.ndarray]],
    projections: Iterator[tuple[int, np.ndarray]] | None,
) -> Iterator[tuple[int, PointCloud]]:
    for frame, xyz in points:
        if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind != "f":
            raise AdapterError(
                f"{path}: pointcloud[{frame}] must be floats [N, 3]; got {xyz.dtype} "
                f"{list(xyz.shape)}"
            )
        seen = None
        if projections is not None:
            number, seen = next(projections, (None, None))
            if number != frame:
                raise AdapterError(
                    f"{path}: pointcloud and camera_projection must hold the same frames in the "
                    f"same order; got {frame} and {number}"
                )
            if seen.shape != (len(xyz), 6) or seen.dtype.kind not in "iu":
                raise AdapterError(
                    f"{path}: camera_projection[{frame}] must be whole numbers [{len(xyz)}, 6], a "
                    f"row for each point; got {seen.dtype} {list(seen.shape)}"
                )
            seen = seen.astype(np.int16)
        yield frame, PointCloud(xyz.astype(np.float64), seen)


# ---- labels --------------------------------------------------------------------------------------

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
