"""Boxes and LiDAR of a drive in Street Gaussians' layout, in the dataset's own world."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import threading
import zipfile
import zlib
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from adapters.lidar_scene.scene import build_lidar_scene, views_of, without_points
from adapters.lidar_scene.split import join_tracks
from adapters.plain_files import read_pose
from adapters.raw_drive import BoxSample, DriveOptions, Sweep
from adapters.safe_pickle import check_holds_object, stream_arrays
from adapters.street_gaussians.data import (
    TIMES,
    ModelConfig,
    TrackTable,
    calibrated_cameras,
    frames_of,
    read_data,
    read_times,
    read_track_table,
    track_files,
)
from adapters.training_views.byte_cache import ByteCache
from adapters.uri import format_uri
from augment.cameras import Frame
from augment.errors import AdapterError
from augment.files.pickles import PickleError
from augment.geometry import quat_from_rotmat
from augment.labels import Boxes, LidarSweep
from augment.scene import Scene
from augment.semantics import SemanticClass

# ---- LiDAR: pointcloud.npz, a ZIP of pickled dictionaries ----------------------------------------
#     pointcloud[frame]           float [N, 3], vehicle frame at the frame's time
#     camera_projection[frame]    int16 [N, 6]: camera, x, y of the first camera that sees the point
#                                 and of the second; camera -1 for none
#
# The file holds the whole drive, compressed, with no way to get at one frame. It is read forward,
# and where reading stopped is kept: frames asked for in their order cost one pass.

FILE = "pointcloud.npz"
_POINTS, _PROJECTIONS = "pointcloud.npy", "camera_projection.npy"
_KEPT_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class PointCloud:
    """points: float64 [N, 3], vehicle frame. projections: int16 [N, 6], if the file has any."""

    points: np.ndarray
    projections: np.ndarray | None

    @property
    def nbytes(self) -> int:
        return self.points.nbytes + (0 if self.projections is None else self.projections.nbytes)


def read_point_cloud(root: Path, frame: int) -> PointCloud | None:
    """The returns of a frame; None where there is no file, or no such frame in it."""
    path = root / FILE
    if not path.exists():
        return None
    with _lock:
        return _reader_of(path).read(frame)


def iterate_point_clouds(root: Path) -> Iterator[tuple[int, PointCloud]]:
    """Frame number and returns of every frame, in the file's order; nothing without the file."""
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
        with zipfile.ZipFile(path) as archive, contextlib.ExitStack() as members:
            names = archive.namelist()
            if _POINTS not in names:
                raise AdapterError(
                    f"{path} must hold the arrays pointcloud and camera_projection; it holds "
                    f"{names[:5]}"
                )
            points, projections = (
                _entries(path, name, members.enter_context(archive.open(name)))
                if name in names
                else None
                for name in (_POINTS, _PROJECTIONS)
            )
            assert points is not None
            yield from _checked(path, points, projections)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise AdapterError(
            f"{path} is no whole .npz file of dictionaries ({error}); copy it again"
        ) from error
    except OSError as error:
        raise AdapterError(f"{path} cannot be read: {error}") from error


def _entries(path: Path, member: str, file: BinaryIO) -> Iterator[tuple[int, np.ndarray]]:
    try:
        check_holds_object(file)
        yield from stream_arrays(file)
    except PickleError as error:
        raise AdapterError(
            f"{path}, {member} was not read: {error}. Only a dictionary of arrays of numbers by "
            f"frame is accepted"
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


# ---- Labels --------------------------------------------------------------------------------------

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
        table = _table(path, stat.st_mtime_ns, stat.st_size)
        rows = np.flatnonzero(table.frames == frame_index)
        world_from_box = pose @ ego_from_boxes(table, rows)
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

    def lidar(self, frame_index: int) -> LidarSweep | None:
        pose = self._world_from_ego(frame_index)
        cloud = None if pose is None else read_point_cloud(self.root, frame_index)
        if cloud is None:
            return None
        times = read_times(self.root / TIMES)["FRAME"]
        if frame_index not in times:
            raise AdapterError(f"{self.root / TIMES}: FRAME lacks frame {frame_index:06d}")
        world = cloud.points @ pose[:3, :3].T + pose[:3, 3]
        columns: dict[str, np.ndarray] = {axis: world[:, i].copy() for i, axis in enumerate("xyz")}
        columns["timestamp_ns"] = np.full(len(world), round(times[frame_index] * 1e9), np.int64)
        if cloud.projections is not None:
            for i, name in enumerate(("camera", "u", "v")):
                columns[name] = cloud.projections[:, i].copy()
        return LidarSweep(columns)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Waymo's roof sensor in the car's pose of the frame. The files join the returns of five
        sensors and do not tell them apart: those of the four at the bumpers and sides, which see
        20 m far, are taken for the roof's, too."""
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


def ego_from_boxes(table: TrackTable, rows: np.ndarray) -> np.ndarray:
    """Poses of the rows' boxes in the vehicle's frame, float64 [R, 4, 4]."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    cos, sin = np.cos(table.headings[rows]), np.sin(table.headings[rows])
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cos, -sin, sin, cos
    poses[:, :3, 3] = table.centers_m[rows]
    return poses


@lru_cache(maxsize=2)
def _table(path: Path, mtime_ns: int, size: int) -> TrackTable:
    """A track file; mtime_ns and size tell whether it is still the one that was read."""
    return read_track_table(path)


# ---- A drive without a trained model: Gaussians from coloured LiDAR ------------------------------
# The world is the one that a model trained on it has. Returns are where they were at their frame's
# time, as the converter has it, and so are the boxes.

# Waymo's uppermost LiDAR looks up by 2.4 degrees; those at the sides see further up, but not far.
_LIDAR_TOP_DEG = 2.4
# The recording car in its own frame, whose origin is below its rear axle, on the ground.
_EGO_LOW_M = np.array([-1.4, -1.15, 0.1])
_EGO_HIGH_M = np.array([4.2, 1.15, 2.4])
_MOVED_M = 1.0  # an object whose boxes lie further apart than this moves
_STANDING = ("sign",)  # classes that never move


def open_raw(root: Path, query: dict[str, str]) -> Scene:
    """The scene of a dataset directory alone.

    query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out; see DriveOptions.
    Opening is deterministic: the same files and options give the same bits.
    """
    options = DriveOptions.from_query("street_gaussians", query)
    cams = calibrated_cameras(root)
    if not cams:
        raise AdapterError(
            f"{root / 'extrinsics'} holds no calibration 0.txt to 4.txt; copy it from the dataset"
        )
    data = read_data(root, ModelConfig(cameras=cams))
    frames = frames_of(data)
    chosen = options.select([f.index for f in frames], where=f"street_gaussians:{root}")
    frames = tuple(frame for frame in frames if frame.index in set(chosen.numbers))
    used = [frame for frame in frames if frame.index not in chosen.held_out]
    if not any(frame.image_paths for frame in used):
        raise AdapterError(
            f"{root / 'images'} holds no usable image of the frames that are not held out "
            f"({used[0].index} to {used[-1].index}); colours cannot be had without them"
        )
    sweeps, sweep_problems = _sweeps(root, used)
    problems = data.problems + chosen.problems + sweep_problems
    table = read_track_table(track_files(root, use_tracker=False)[0])
    tracks = join_tracks(_moving_samples(table, frames))
    scene = build_lidar_scene(
        sweeps,
        tracks,
        views_of(used),
        options,
        lidar_top_deg=_LIDAR_TOP_DEG,
        name=root.absolute().name,
        source=format_uri("street_gaussians", root, query),
        frames=frames,
        labels=StreetGaussiansLabels(root),
        world_origin_m=data.world_origin_m,
        problems=problems,
    )
    missing = without_points(tracks, scene)
    faults = scene.problems[len(problems) :]
    return dataclasses.replace(scene, problems=problems + missing + faults)


def _sweeps(root: Path, used: Sequence[Frame]) -> tuple[list[Sweep], tuple[str, ...]]:
    """The usable returns of the frames in the scene's world, without the recording car's own, and a
    sentence where frames have none."""
    by_number = {frame.index: frame for frame in used}
    sweeps = {}
    for number, cloud in iterate_point_clouds(root):
        frame = by_number.get(number)
        if frame is None:
            continue
        own = ((cloud.points > _EGO_LOW_M) & (cloud.points < _EGO_HIGH_M)).all(axis=1)
        points = cloud.points[~own & np.isfinite(cloud.points).all(axis=1)]
        pose = frame.world_from_ego.numpy()
        sweeps[number] = Sweep(
            (points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32),
            np.full(len(points), frame.timestamp_ns, np.int64),
            np.full(len(points), SemanticClass.UNKNOWN, np.int16),
        )
    if not any(len(sweep) for sweep in sweeps.values()):
        raise AdapterError(
            f"{root / FILE} holds no returns of frames {used[0].index} to {used[-1].index}, or is "
            f"missing; a scene cannot be built without them. Make it with the converter's LiDAR "
            f"step, or give a trained model's folder"
        )
    missing = sorted(set(by_number) - set(sweeps))
    found = [sweeps[number] for number in sorted(sweeps)]
    if not missing:
        return found, ()
    return found, (
        f"{root / FILE} lacks {len(missing)} frames, such as {missing[0]}: their points too",
    )


def _moving_samples(table: TrackTable, frames: Sequence[Frame]) -> list[BoxSample]:
    """The boxes of the objects that move within the frames, by frame."""
    samples: list[BoxSample] = []
    for frame in frames:
        rows = np.flatnonzero(table.frames == frame.index)
        poses = frame.world_from_ego.numpy() @ ego_from_boxes(table, rows)
        samples += [
            BoxSample(
                object_id=str(int(table.ids[row])),
                sibling_id=None,
                label=table.labels[row],
                frame=frame.index,
                timestamp_ns=frame.timestamp_ns,
                world_from_box=pose,
                size_m=table.sizes_m[row],
            )
            for row, pose in zip(rows, poses, strict=True)
            if table.labels[row] not in _STANDING
        ]
    places: dict[str, list[np.ndarray]] = {}
    for sample in samples:
        places.setdefault(sample.object_id, []).append(sample.world_from_box[:2, 3])
    extents = {name: np.ptp(np.array(xy), axis=0) for name, xy in places.items()}
    return [sample for sample in samples if np.hypot(*extents[sample.object_id]) > _MOVED_M]
