"""What a KITTI folder holds of the frames asked for, before images are decoded: calibration, poses,
times and labels of a raw drive, or of one frame of the object benchmark.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from adapters.kitti.boxes import (
    TRACKLETS,
    Tracklet,
    boxes_at,
    boxes_of_lines,
    read_object_lines,
    read_tracklets,
)
from adapters.kitti.layout import (
    COLOUR_CAMERAS,
    GREY_CAMERAS,
    IMAGE_SUFFIXES,
    OBJECT_CAMERAS,
    OBJECT_DIGITS,
    RAW_DIGITS,
    VELODYNE,
    Calibration,
    file_in,
    frame_times,
    is_object_folder,
    kitti_root,
    labelled_sweep,
    numbered,
    read_object_calibration,
    read_raw_calibration,
    read_returns,
    read_times,
    read_velodyne_from_imu,
    some,
)
from adapters.lidar_scene.scene import DriveFrames, DriveOptions, drive_origin, stored_records
from adapters.plain_files import checked_pose, read_numbers, read_text
from augment.errors import AdapterError
from augment.labels import Boxes, LidarSweep

# ---- What the URI of a KITTI scene may ask for ---------------------------------------------------

ICP = "icp"
_OWN = {
    "poses": "icp, or a file with a line of 12 numbers a frame (raw drives)",
    "frame": "a frame's number (object folders)",
}


@dataclass(frozen=True)
class KittiOptions:
    """drive: the options of every drive. poses: "icp", a file's name, or None for the drive's own
    GPS/IMU. frame: which frame of an object folder; None: the only one.
    """

    drive: DriveOptions
    poses: str | None = None
    frame: int | None = None

    @staticmethod
    def from_query(query: dict[str, str], *, is_object: bool) -> KittiOptions:
        """The options of a URI's query.

        Raises:
            AdapterError: an unknown key, or a value that is none.
        """
        drive = DriveOptions.from_query("kitti", query, _OWN)
        poses, frame = query.get("poses"), query.get("frame")
        wrong = "poses" if is_object and poses is not None else None
        wrong = "frame" if not is_object and frame is not None else wrong
        if wrong:
            what = "an object folder, whose frames are unrelated" if is_object else "a raw drive"
            raise AdapterError(f"kitti: {wrong}= means nothing for {what}; it is {_OWN[wrong]}")
        if frame is not None and not re.fullmatch("[0-9]{1,9}", frame):
            raise AdapterError(f"kitti: frame must be a frame's number; got {frame!r}")
        if poses == "":
            raise AdapterError("kitti: poses must be icp or the name of a file; got nothing")
        return KittiOptions(drive, poses, None if frame is None else int(frame))


# ---- KITTI's boxes and sweeps in the dataset's world, read when asked ----------------------------

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


# ------------------------------------------------------------------------------------------------
# Where the Velodyne was in each frame of a raw drive: from GPS/IMU files or a file of poses
# The ego frame is the Velodyne's: x forward, y left, z up, its origin 1.73 m above the road.

EARTH_RADIUS_M = 6378137.0
_OXTS_NUMBERS = 30
_MAX_LATITUDE_DEG = 85.0  # Mercator's scale goes to infinity at the poles
# Rows: a z-up world's x (camera's forward), y (its left), z (its up) in a camera's axes.
_UP_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Poses:
    """world_from_velodyne: float64 [4, 4] by frame number, in the dataset's world, z up. problems:
    one sentence each."""

    world_from_velodyne: Mapping[int, np.ndarray]
    problems: tuple[str, ...] = ()


def oxts_poses(root: Path, names: Mapping[int, str], velodyne_from_imu: np.ndarray) -> Poses:
    """Poses from the GPS/IMU files `names`, in KITTI's Mercator world: x east, y north, z the
    altitude, metres, scaled by the cosine of the first file's latitude.

    Raises:
        AdapterError: no file is usable.
    """
    packets, problems = {}, []
    for number, name in sorted(names.items()):
        try:
            packets[number] = _read_packet(file_in(root, name))
        except AdapterError as error:
            problems.append(f"frame {number} has no pose: {error}")
    if not packets:
        raise AdapterError(f"{root / 'oxts'}: no file can be used: {'; '.join(problems[:3])}")
    scale = float(np.cos(np.radians(next(iter(packets.values()))[0])))
    imu_from_velodyne = np.linalg.inv(velodyne_from_imu)
    poses = {n: _mercator_pose(p, scale) @ imu_from_velodyne for n, p in packets.items()}
    return Poses(poses, tuple(problems))


def odometry_poses(
    path: Path, numbers: Sequence[int], rectified_from_velodyne: np.ndarray
) -> Poses:
    """Poses from a file as of KITTI's odometry benchmark: a line of 12 numbers a frame, the rows of
    world_from_camera for the rectified left grey camera 0, whose world is turned to z up here.

    Lines are the frames in their order if there are as many, else line n (from 0) is frame n.
    numbers: the drive's frames.

    Raises:
        AdapterError: no such file, a line is no pose, or no line is of any frame.
    """
    if not path.is_file():
        raise AdapterError(
            f"kitti: poses must be icp or a file of poses; got {str(path)!r}, and there is no file "
            f"{path.absolute()}"
        )
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    in_order = len(lines) == len(numbers)
    poses = {}
    for row, line in enumerate(lines):
        number = numbers[row] if in_order else row
        where = f"{path}, line {row + 1}"
        try:
            values = np.array([float(word) for word in line.split()], np.float64)
        except ValueError as error:
            raise AdapterError(f"{where}: expected 12 numbers ({error})") from None
        if values.size != 12:
            raise AdapterError(f"{where}: expected 12 numbers, a pose; got {values.size}")
        world_from_rectified = checked_pose(values.reshape(3, 4), where)
        poses[number] = _UP_FROM_CAMERA @ world_from_rectified @ rectified_from_velodyne
    if not set(poses) & set(numbers):
        raise AdapterError(
            f"{path} has {len(lines)} poses, none of them of frames {numbers[0]} to {numbers[-1]}"
        )
    return Poses(poses)


def without_poses(numbers: Sequence[int], poses: Mapping[int, np.ndarray]) -> tuple[str, ...]:
    """A sentence for the frames that have no pose."""
    missing = [number for number in numbers if number not in poses]
    return (f"left out {some(missing)}: no pose is known",) if missing else ()


def _read_packet(path: Path) -> np.ndarray:
    """The numbers of a GPS/IMU file: latitude and longitude (degrees), altitude (metres), roll,
    pitch and yaw (radians), and 24 that are not used."""
    values = read_numbers(path, (_OXTS_NUMBERS,))
    latitude, longitude, altitude = values[:3]
    if abs(latitude) > _MAX_LATITUDE_DEG or abs(longitude) > 180 or abs(altitude) > 1e4:
        raise AdapterError(
            f"{path} must begin with latitude, longitude (degrees) and altitude (metres); got "
            f"{latitude:g} {longitude:g} {altitude:g}"
        )
    return values


def _mercator_pose(packet: np.ndarray, scale: float) -> np.ndarray:
    """world_from_imu, float64 [4, 4]."""
    latitude, longitude, altitude, roll, pitch, yaw = packet[:6]
    pose = np.eye(4)
    pose[:3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    pose[0, 3] = scale * EARTH_RADIUS_M * np.radians(longitude)
    pose[1, 3] = scale * EARTH_RADIUS_M * np.log(np.tan(np.pi * (90 + latitude) / 360))
    pose[2, 3] = altitude
    return pose


def _about(axis: int, angle: float) -> np.ndarray:
    """Rotation about x, y or z (0, 1, 2), float64 [3, 3]."""
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = cos
    matrix[i, j], matrix[j, i] = -sin, sin
    return matrix


# ------------------------------------------------------------------------------------------------
# Poses from the sweeps themselves, where a drive has none: point-to-plane ICP between neighbours
# Every step is NumPy on one thread, so that the same sweeps give the same bits; parallel sums, as
# libraries for point clouds take them, change the last ones from run to run.

_VOXEL_M = 0.25
_NEAR_M, _FAR_M = 2.6, 60.0  # nearer is the recording car, further is sparse
_NEIGHBOURS = 12
_FLAT = 0.05  # a normal is believed where its variance is less than this of the next
_STAGES = ((4.0, 12), (1.5, 12), (0.5, 15))  # reach of a match in metres, iterations
_LOOSE_M = 0.2  # of a residual, in the last stage, where its weight has fallen to half
_SETTLED = 1e-6  # metres and radians that a step still changes
_FEWEST = 200
_POOR_FITNESS = 0.5


@dataclass(frozen=True, eq=False)
class _Surface:
    """Thinned points [N, 3] of a sweep, those of them on surfaces [M, 3], and normals [M, 3]."""

    points: np.ndarray
    flat: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True, eq=False)
class Match:
    """before_from_after: float64 [4, 4]. fitness: part of the points with a surface within half a
    metre. rmse_m: of their distances from it."""

    before_from_after: np.ndarray
    fitness: float
    rmse_m: float


def registered_poses(numbers: Sequence[int], read: Callable[[int], np.ndarray | None]) -> Poses:
    """Poses of the frames with a sweep, in the Velodyne's frame of the first.

    read: the returns [N, 3 or more] of a frame in the Velodyne's frame, or None.
    Each sweep is matched with the one before, starting from the motion between the two before.

    Raises:
        AdapterError: no frame has a sweep, or one has too few surfaces.
    """
    pose, step = np.eye(4), np.eye(4)
    poses: dict[int, np.ndarray] = {}
    matches: dict[int, Match] = {}
    before: _Surface | None = None
    for number in tqdm(numbers, desc="registration", unit="sweep", disable=None):
        returns = read(number)
        if returns is None:
            continue
        after = _surface(returns[:, :3].astype(np.float64), number)
        if before is not None:
            match = _match(after, before, step)
            matches[number] = match
            step = match.before_from_after
            pose = pose @ step
        poses[number] = pose
        before = after
    if not poses:
        raise AdapterError(
            f"poses=icp: frames {numbers[0]} to {numbers[-1]} have no sweep to find poses from"
        )
    return Poses(poses, _described(matches))


def _described(matches: dict[int, Match]) -> tuple[str, ...]:
    if not matches:
        return ()
    fitness = np.mean([m.fitness for m in matches.values()])
    rmse = np.mean([m.rmse_m for m in matches.values()])
    said = (
        f"poses are from registering {len(matches) + 1} sweeps one after the other (poses=icp): "
        f"mean fitness {fitness:.3f}, inlier RMSE {rmse:.3f} m; they drift over long drives"
    )
    poor = [number for number, m in matches.items() if m.fitness < _POOR_FITNESS]
    if not poor:
        return (said,)
    return (
        said,
        f"the sweep of frame {poor[0]} and {len(poor) - 1} others hardly match the one before",
    )


def _match(after: _Surface, before: _Surface, guess: np.ndarray) -> Match:
    tree = cKDTree(before.flat)
    transform = guess
    for reach_m, iterations in _STAGES:
        loose = _LOOSE_M * reach_m / _STAGES[-1][0]
        for _ in range(iterations):
            moved, index, near = _nearest(tree, after, transform, reach_m)
            residual = _residuals(moved[near], before, index[near])
            step = _step(moved[near], before.normals[index[near]], residual, loose)
            transform = step @ transform
            if np.abs(step - np.eye(4)).max() < _SETTLED:
                break
    moved, index, near = _nearest(tree, after, transform, _STAGES[-1][0])
    residual = _residuals(moved[near], before, index[near])
    rmse = float(np.sqrt(np.mean(residual**2))) if near.any() else float("inf")
    return Match(transform, float(near.mean()), rmse)


def _nearest(
    tree: cKDTree, after: _Surface, transform: np.ndarray, reach_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points moved [N, 3], the nearest surface point of each [N], and whether it is in reach."""
    moved = after.points @ transform[:3, :3].T + transform[:3, 3]
    distance, index = tree.query(moved, distance_upper_bound=reach_m)
    return moved, index, np.isfinite(distance)


def _residuals(points: np.ndarray, surface: _Surface, index: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", points - surface.flat[index], surface.normals[index])


def _step(
    points: np.ndarray, normals: np.ndarray, residual: np.ndarray, loose_m: float
) -> np.ndarray:
    """The Gauss-Newton step as a rigid transform; far residuals, as of what moves, weigh little."""
    weight = 1 / (1 + (residual / loose_m) ** 2)
    jacobian = np.concatenate([np.cross(points, normals), normals], axis=1)  # [N, 6]
    hessian = np.einsum("n,ni,nj->ij", weight, jacobian, jacobian)
    gradient = np.einsum("n,n,ni->i", weight, residual, jacobian)
    # A direction that no surface holds stays where it is.
    change = -np.linalg.solve(hessian + 1e-6 * np.trace(hessian) * np.eye(6), gradient)
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix()
    step[:3, 3] = change[3:]
    return step


def _surface(points: np.ndarray, number: int) -> _Surface:
    distance = np.linalg.norm(points, axis=1)
    points = points[(distance > _NEAR_M) & (distance < _FAR_M)]  # False for NaN too
    thin = _thinned(points)
    if len(thin) >= _FEWEST:
        normals, flat = _normals(thin)
        if flat.sum() >= _FEWEST:
            return _Surface(thin, thin[flat], normals[flat])
    raise AdapterError(
        f"poses=icp: the sweep of frame {number} has too few surfaces ({len(thin)} points) to be "
        f"registered; give poses=FILE, or frames without it"
    )


def _thinned(points: np.ndarray) -> np.ndarray:
    """The mean of the points of each voxel."""
    x, y, z = np.floor((points + _FAR_M) / _VOXEL_M).astype(np.int64).T
    side = int(2 * _FAR_M / _VOXEL_M) + 1
    _, cell, counts = np.unique((x * side + y) * side + z, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell, points[:, i], len(counts)) for i in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]


def _normals(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The direction of least spread around each point [N, 3]; whether that is flat, bool [N]."""
    _, index = cKDTree(points).query(points, _NEIGHBOURS)
    offset = points[index] - points[index].mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
    return axes[:, :, 0], variance[:, 0] < _FLAT * variance[:, 1]


# ---- source --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Source:
    """chosen: the scene's frames, all with a pose. images: names of the files by camera and frame.
    image_times_ns: by camera and frame, where the camera has its own. labels: of all frames with
    poses, whose world_from_velodyne is in the dataset's world. world_origin_m: float64 [3].
    """

    root: Path
    name: str
    chosen: DriveFrames
    calibration: Calibration
    images: Mapping[str, Mapping[int, str]]
    image_times_ns: Mapping[str, Mapping[int, int]]
    labels: RawLabels | ObjectLabels
    world_origin_m: np.ndarray
    problems: tuple[str, ...]

    @property
    def sweeps(self) -> LocatedSweeps:
        return self.labels.sweeps


def find_source(path: str, query: dict[str, str]) -> tuple[Source, KittiOptions]:
    """What the URI names, and its options.

    Raises:
        AdapterError: a wrong option, no KITTI folder, wrong calibration, times, poses or tracklets.
    """
    root, calibration = kitti_root(path)
    if is_object_folder(root):
        options = KittiOptions.from_query(query, is_object=True)
        return _object_source(root, calibration, options), options
    options = KittiOptions.from_query(query, is_object=False)
    return _raw_source(root, calibration, options), options


def _raw_source(root: Path, calibration_folder: Path, options: KittiOptions) -> Source:
    sweeps = numbered(root, f"{VELODYNE}/data", (".bin",), RAW_DIGITS)
    images, problems = _raw_images(root)
    numbers = sorted(set(sweeps).union(*images.values()))
    if not sweeps:
        raise AdapterError(
            f"{root / VELODYNE / 'data'} holds no sweep NNNNNNNNNN.bin; a scene cannot be built "
            f"without them, unpack the drive again"
        )
    chosen = options.drive.select(numbers, where=f"kitti:{root}")
    calibration = read_raw_calibration(calibration_folder, tuple(images))
    image_times = {name: read_times(root, name) for name in images}
    known = read_times(root, VELODYNE) or next(filter(None, image_times.values()), {})
    times, said = frame_times(root, known, numbers)
    poses = _raw_poses(root, calibration_folder, calibration, options, numbers, chosen, sweeps)
    located = LocatedSweeps(root, sweeps, times, poses.world_from_velodyne)
    tracklets = read_tracklets(root)
    problems = (
        *problems,
        *chosen.problems,
        *said,
        *poses.problems,
        *without_poses(chosen.numbers, poses.world_from_velodyne),
        *(() if tracklets is not None else (f"{root} has no {TRACKLETS}: no boxes are known",)),
    )
    positions = [pose[:3, 3] for _, pose in sorted(poses.world_from_velodyne.items())]
    return Source(
        root,
        root.absolute().name,
        _with_poses(root, chosen, poses),
        calibration,
        images,
        image_times,
        RawLabels(located, tracklets or ()),
        drive_origin(np.stack(positions)),
        problems,
    )


def _raw_images(root: Path) -> tuple[dict[str, dict[int, str]], tuple[str, ...]]:
    """The files of the colour cameras, or else of the grey ones, by camera and frame."""
    for cameras in (COLOUR_CAMERAS, GREY_CAMERAS):
        found = {
            name: numbered(root, f"{name}/data", IMAGE_SUFFIXES, RAW_DIGITS) for name in cameras
        }
        images = {name: files for name, files in found.items() if files}
        if images:
            empty = [n for n in cameras if (root / n).is_dir() and n not in images]
            return images, tuple(f"camera {n}: {root / n / 'data'} holds no image" for n in empty)
    raise AdapterError(
        f"{root} holds no images: expected image_02/data/NNNNNNNNNN.png, or image_03/, or the grey "
        f"image_00/ or image_01/; colours cannot be had without them"
    )


def _raw_poses(
    root: Path,
    calibration_folder: Path,
    calibration: Calibration,
    options: KittiOptions,
    numbers: list[int],
    chosen: DriveFrames,
    sweeps: Mapping[int, str],
) -> Poses:
    if options.poses == ICP:
        return _registered(root, chosen, sweeps)
    if options.poses is not None:
        path = Path(options.poses).expanduser()
        return odometry_poses(path, numbers, calibration.rectified_from_velodyne)
    oxts = numbered(root, "oxts/data", (".txt",), RAW_DIGITS)
    if oxts:
        return oxts_poses(root, oxts, read_velodyne_from_imu(calibration_folder))
    if len(chosen.numbers) == 1:
        return Poses({chosen.numbers[0]: np.eye(4)})
    raise AdapterError(
        f"{root} has no poses (oxts/data/NNNNNNNNNN.txt) for {some(chosen.numbers)}. Copy the "
        f"drive's oxts/ there; or give ?poses=FILE, a line of 12 numbers a frame as of KITTI's "
        f"odometry; or ?poses=icp, which registers the sweeps; or one frame, "
        f"?frames={chosen.numbers[0]}:{chosen.numbers[0] + 1}, which needs none"
    )


def _registered(root: Path, chosen: DriveFrames, sweeps: Mapping[int, str]) -> Poses:
    problems: list[str] = []

    def read(number: int) -> np.ndarray | None:
        if number not in sweeps:
            return None
        try:
            return read_returns(root, sweeps[number])
        except AdapterError as error:
            problems.append(f"frame {number}: {error}")
            return None

    poses = registered_poses(chosen.numbers, read)
    return Poses(poses.world_from_velodyne, (*problems, *poses.problems))


def _with_poses(root: Path, chosen: DriveFrames, poses: Poses) -> DriveFrames:
    kept = DriveFrames(
        tuple(n for n in chosen.numbers if n in poses.world_from_velodyne), chosen.held_out
    )
    if kept.used:
        return kept
    raise AdapterError(
        f"{root}: no pose is known of any of {some(chosen.used)}"
        + "".join(f"; {problem}" for problem in poses.problems[:3])
    )


def _object_source(root: Path, calibration_folder: Path, options: KittiOptions) -> Source:
    sweeps = numbered(root, "velodyne", (".bin",), OBJECT_DIGITS)
    images = {n: numbered(root, n, IMAGE_SUFFIXES, OBJECT_DIGITS) for n in OBJECT_CAMERAS}
    number = _object_frame(root, options.frame, sorted(set(sweeps).union(*images.values())))
    digits = f"{number:0{OBJECT_DIGITS}d}"
    if number not in sweeps:
        raise AdapterError(
            f"{root / 'velodyne' / digits}.bin does not exist; frame {number} has no sweep to "
            f"build a scene from"
        )
    images = {name: {number: files[number]} for name, files in images.items() if number in files}
    if not images:
        raise AdapterError(
            f"{root / 'image_2' / digits}.png does not exist, nor in image_3/; colours cannot be "
            f"had without an image"
        )
    chosen = options.drive.select([number], where=f"kitti:{root}, frame {number}")
    calibration = read_object_calibration(calibration_folder, digits, tuple(images))
    sweep = LocatedSweeps(root, {number: sweeps[number]}, {number: 0}, {number: np.eye(4)})
    inverse = np.linalg.inv(calibration.rectified_from_velodyne)
    return Source(
        root,
        digits,
        chosen,
        calibration,
        images,
        {name: {} for name in images},
        ObjectLabels(sweep, number, inverse),
        np.zeros(3),
        (*chosen.problems, *_object_label_problems(root, number)),
    )


def _object_frame(root: Path, asked: int | None, numbers: list[int]) -> int:
    digits = [f"{n:0{OBJECT_DIGITS}d}" for n in numbers]
    examples = ", ".join(digits[:3]) + (", ..." if len(digits) > 3 else "")
    if not numbers:
        raise AdapterError(f"{root} holds neither velodyne/NNNNNN.bin nor image_2/NNNNNN.png")
    if asked is None and len(numbers) > 1:
        raise AdapterError(
            f"{root} holds {len(numbers)} unrelated frames ({examples}); a scene is one of them, "
            f"give ?frame={digits[0]}"
        )
    if asked is not None and asked not in numbers:
        raise AdapterError(
            f"{root} has no frame {asked:0{OBJECT_DIGITS}d}; it has {len(numbers)}: {examples}"
        )
    return numbers[0] if asked is None else asked


def _object_label_problems(root: Path, number: int) -> tuple[str, ...]:
    path = object_label_file(root, number)
    if not path.exists():
        return (f"{path} does not exist: no boxes are known",)
    ignored = read_object_lines(path).dont_care
    if not ignored:
        return ()
    return (f"{path}: {ignored} regions marked DontCare have no 3D box; boxes are without them",)
