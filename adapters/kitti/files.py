"""The files of a KITTI folder: calibration, times, sweeps, and poses from GPS/IMU, from a file, or
from registering the sweeps.

    raw     <drive>/image_0X/data/NNNNNNNNNN.png      timestamps.txt beside data/
            <drive>/velodyne_points/data/NNNNNNNNNN.bin
            <drive>/oxts/data/NNNNNNNNNN.txt          <drive>/tracklet_labels.xml
            calib_*.txt in the drive's folder or the one above (the day's)
    object  calib/NNNNNN.txt  image_2/NNNNNN.png  velodyne/NNNNNN.bin  label_2/NNNNNN.txt

Images may be .jpg too. A frame's number is that of its files. A point of the Velodyne is at
`P_rect_0X @ R_rect_00 @ [R T]` in the image of camera X: P's first three columns are its intrinsics
K, and K^-1 times the fourth is what to add to a point of the rectified camera 0 to have it in
camera X. The ego frame is the Velodyne's: x forward, y left, z up, its origin 1.73 m above the
road. Times have no zone; they are read as UTC, nanoseconds since 1970. Errors are AdapterErrors
that name the file.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from adapters.plain_files import checked_pose, inside, parse_numbers, read_numbers, read_text
from adapters.raw_drive import some
from augment.errors import AdapterError

CAM_TO_CAM = "calib_cam_to_cam.txt"
VELODYNE = "velodyne_points"
COLOUR_CAMERAS, GREY_CAMERAS = ("image_02", "image_03"), ("image_00", "image_01")
OBJECT_CAMERAS = ("image_2", "image_3")
IMAGE_SUFFIXES = (".jpg", ".png")  # the later wins where a frame has both
RAW_DIGITS, OBJECT_DIGITS = 10, 6
_MAX_DRIVES = 3  # that a message names
FRAME_NS = 100_000_000  # the Velodyne turns ten times a second and triggers the cameras
_TIME = re.compile(r"(19[7-9]\d|20\d\d|21\d\d)-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")
_RETURN_BYTES = 16
_MAX_BYTES = 512 * 2**20  # a turn of the sensor is 2 MB

EARTH_RADIUS_M = 6378137.0
_OXTS_NUMBERS = 30
_MAX_LATITUDE_DEG = 85.0  # Mercator's scale goes to infinity at the poles
# Rows: a z-up world's x (camera's forward), y (its left), z (its up) in a camera's axes.
_UP_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

# Registration of sweeps is NumPy on one thread: the parallel sums of libraries for point clouds
# change the last bits from run to run.
_VOXEL_M = 0.25
_NEAR_M, _FAR_M = 2.6, 60.0  # nearer is the recording car, further is sparse
_NEIGHBOURS = 12
_FLAT = 0.05  # a normal is believed where its variance is less than this of the next
_STAGES = ((4.0, 12), (1.5, 12), (0.5, 15))  # reach of a match in metres, iterations
_LOOSE_M = 0.2  # of a residual, in the last stage, where its weight has fallen to half
_SETTLED = 1e-6  # metres and radians that a step still changes
_MIN_SURFACE_POINTS = 200
_POOR_FITNESS = 0.5


def kitti_root(path: str | Path) -> tuple[Path, Path]:
    """The folder of a raw drive and that of its calibration (the same or the one above); or a
    folder of the object benchmark, given itself or above its training/, and its calib/."""
    root = Path(path)
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a KITTI drive or object folder")
    if (root / VELODYNE).is_dir():
        for place in (root, root.absolute().parent):
            if (place / CAM_TO_CAM).is_file():
                return root, place
        raise AdapterError(
            f"{root} holds {VELODYNE}/ but there is no {CAM_TO_CAM} in it or in "
            f"{root.absolute().parent}; unpack the day's calibration there (KITTI's "
            f"<date>_calib.zip)"
        )
    for place in (root, root / "training"):
        if is_object_folder(place):
            return place, place / "calib"
    drives = sorted(p.parent for p in root.glob(f"*/{VELODYNE}"))
    if drives:
        rest = len(drives) - _MAX_DRIVES
        few = ", ".join(map(str, drives[:_MAX_DRIVES])) + (f" and {rest} more" if rest > 0 else "")
        raise AdapterError(f"{root} holds drives, it is none itself; give one: {few}")
    parents = root.absolute().parents[:2]
    above = next((p for p in parents if (p / VELODYNE).is_dir() or is_object_folder(p)), None)
    raise AdapterError(
        f"{root} is no KITTI folder: expected {VELODYNE}/ (a raw drive), or calib/ beside "
        f"velodyne/ or image_2/ (the object benchmark)"
        + (f"; {above}, above it, is one" if above else "")
    )


def is_object_folder(root: Path) -> bool:
    """Whether a folder is one of the object benchmark."""
    data = (root / "velodyne", root / "image_2")
    return (root / "calib").is_dir() and any(folder.is_dir() for folder in data)


def numbered(root: Path, folder: str, suffixes: Sequence[str], digits: int) -> dict[int, str]:
    """The files of a folder that are named by so many digits, relative to the root, by number."""
    where = root / folder
    if not where.is_dir():
        return {}
    found: dict[int, str] = {}
    for name in sorted(entry.name for entry in where.iterdir()):
        stem, dot, ending = name.partition(".")
        if re.fullmatch(rf"[0-9]{{{digits}}}", stem) and dot + ending.lower() in suffixes:
            found[int(stem)] = f"{folder}/{name}"
    return found


def file_in(root: Path, name: str) -> Path:
    """A file of the folder, there or not, but no link that leads out of it."""
    return inside(root, name, str(root))


class RectifiedCamera(NamedTuple):
    """lens: fx, fy, cx, cy, pixels. camera_from_velodyne: float64 [4, 4]. size: width and height in
    pixels where the calibration says so."""

    lens: tuple[float, float, float, float]
    camera_from_velodyne: np.ndarray
    size: tuple[int, int] | None


class Calibration(NamedTuple):
    """cameras: by name. rectified_from_velodyne: float64 [4, 4], into camera 0 after
    rectification."""

    cameras: Mapping[str, RectifiedCamera]
    rectified_from_velodyne: np.ndarray


@dataclass(frozen=True)
class KeyedLines:
    """A file of lines `key: words`; keys that nobody asks for may hold anything."""

    path: Path
    lines: dict[str, str]

    @staticmethod
    def read(folder: Path, name: str) -> KeyedLines:
        path = file_in(folder, name)
        lines: dict[str, str] = {}
        for number, line in enumerate(read_text(path).splitlines(), start=1):
            key, colon, words = line.partition(":")
            key = key.strip()
            if not line.strip():
                continue
            if not colon:
                raise AdapterError(
                    f"{path}, line {number}: expected `key: numbers`; got {line[:60]!r}"
                )
            if key in lines:
                raise AdapterError(
                    f"{path}, line {number}: {key!r} is there twice; delete the wrong one"
                )
            lines[key] = words
        return KeyedLines(path, lines)

    def numbers(self, key: str, *shape: int) -> np.ndarray:
        """A key's finite numbers, float64 in that shape."""
        if key not in self.lines:
            raise AdapterError(
                f"{self.path} has no {key!r}; it has {', '.join(self.lines) or 'nothing'}. Copy it "
                f"from the dataset again"
            )
        return parse_numbers(self.lines[key], f"{self.path}: {key}", shape)

    def pose(self, rotation: str, translation: str | None = None) -> np.ndarray:
        """A rigid transform from two keys, or a rotation from one, float64 [4, 4]."""
        place = np.zeros(3) if translation is None else self.numbers(translation, 3)
        keys = rotation if translation is None else f"{rotation} and {translation}"
        matrix = np.column_stack([self.numbers(rotation, 3, 3), place])
        return checked_pose(matrix, f"{self.path}: {keys}")


def read_raw_calibration(folder: Path, names: Iterable[str]) -> Calibration:
    """The calibration of a day's drives. names: of the cameras, such as image_02."""
    keyed = KeyedLines.read(folder, CAM_TO_CAM)
    velodyne = KeyedLines.read(folder, "calib_velo_to_cam.txt").pose("R", "T")
    rectified = keyed.pose("R_rect_00") @ velodyne
    return Calibration(
        {n: _camera(keyed, n.replace("image", "P_rect"), rectified) for n in names}, rectified
    )


def read_object_calibration(folder: Path, frame: str, names: Iterable[str]) -> Calibration:
    """The calibration of one frame of the object benchmark. frame: its digits. names: of the
    cameras, such as image_2."""
    keyed = KeyedLines.read(folder, f"{frame}.txt")
    velodyne = checked_pose(keyed.numbers("Tr_velo_to_cam", 3, 4), f"{keyed.path}: Tr_velo_to_cam")
    rectified = keyed.pose("R0_rect") @ velodyne
    return Calibration(
        {n: _camera(keyed, n.replace("image_", "P"), rectified) for n in names}, rectified
    )


def read_velodyne_from_imu(folder: Path) -> np.ndarray:
    """Where the Velodyne is to the GPS/IMU unit that drives are located by, float64 [4, 4]."""
    return KeyedLines.read(folder, "calib_imu_to_velo.txt").pose("R", "T")


def _camera(keyed: KeyedLines, key: str, rectified_from_velodyne: np.ndarray) -> RectifiedCamera:
    projection = keyed.numbers(key, 3, 4)
    k = projection[:, :3]
    pinhole = np.array([[k[0, 0], 0, k[0, 2]], [0, k[1, 1], k[1, 2]], [0, 0, 1]])
    if not (np.allclose(k, pinhole, atol=1e-6) and k[0, 0] > 0 and k[1, 1] > 0):
        raise AdapterError(
            f"{keyed.path}: {key} must be a rectified pinhole: fx 0 cx . 0 fy cy . 0 0 1 . with "
            f"fx, fy > 0; got {projection.tolist()}"
        )
    camera_from_rectified = np.eye(4)
    camera_from_rectified[:3, 3] = np.linalg.solve(pinhole, projection[:, 3])
    lens = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    pose = camera_from_rectified @ rectified_from_velodyne
    return RectifiedCamera(lens, pose, _size(keyed, key.replace("P_rect", "S_rect")))


def _size(keyed: KeyedLines, key: str) -> tuple[int, int] | None:
    if not key.startswith("S_rect") or key not in keyed.lines:
        return None
    width, height = keyed.numbers(key, 2)
    if not (1 <= width <= 1e5 and 1 <= height <= 1e5 and width % 1 == 0 and height % 1 == 0):
        raise AdapterError(
            f"{keyed.path}: {key} must be a width and a height in pixels; got {width:g} {height:g}"
        )
    return int(width), int(height)


def read_times(root: Path, folder: str) -> dict[int, int]:
    """Nanoseconds by frame number from a folder's timestamps.txt, without the frames whose line is
    empty; nothing without the file."""
    path = file_in(root, f"{folder}/timestamps.txt")
    if not path.exists():
        return {}
    times = {}
    for number, line in enumerate(read_text(path).splitlines()):
        text = line.strip()
        if not text:
            continue
        try:
            if not _TIME.fullmatch(text):
                raise ValueError(text)
            times[number] = int(np.datetime64(text.replace(" ", "T"), "ns").astype(np.int64))
        except ValueError:
            raise AdapterError(
                f"{path}, line {number + 1}: expected a time such as "
                f"2011-09-26 13:02:25.964389445; got {text[:60]!r}"
            ) from None
    return times


def frame_times(
    root: Path, known: Mapping[int, int], numbers: Sequence[int]
) -> tuple[dict[int, int], tuple[str, ...]]:
    """The time of every frame, and a sentence where it had to be assumed: ten frames a second from
    the nearest frame whose time is known, or from 0 at frame 0."""
    missing = [number for number in numbers if number not in known]
    anchors = np.array(sorted(known) or [0])
    times = {}
    for number in numbers:
        anchor = int(anchors[np.abs(anchors - number).argmin()])
        times[number] = known.get(anchor, 0) + (number - anchor) * FRAME_NS
    for before, after in itertools.pairwise(numbers):
        if times[after] <= times[before]:
            raise AdapterError(
                f"{root}: by timestamps.txt frame {after} was not taken after frame {before} "
                f"({times[after]} ns and {times[before]} ns); correct the file, or leave it "
                f"out: ten frames a second are assumed then"
            )
    if not missing:
        return times, ()
    what = "its timestamps.txt has no times" if not known else "timestamps.txt has no line"
    return times, (f"{root}: {what} for {some(missing)}; ten frames a second are assumed",)


def read_returns(root: Path, name: str) -> np.ndarray:
    """A sweep's returns as stored, float32 [N, 4]: x y z (metres, the Velodyne's frame) and
    reflectance. A turn takes 0.1 s; what the car's motion displaces its points by stays."""
    path = file_in(root, name)
    try:
        size = path.stat().st_size
        if size == 0 or size % _RETURN_BYTES or size > _MAX_BYTES:
            raise AdapterError(
                f"{path} must be returns of 16 bytes (x y z reflectance, float32); it has {size} "
                f"bytes. Copy it again"
            )
        return np.fromfile(path, "<f4").reshape(-1, 4)
    except OSError as error:
        raise AdapterError(f"{path} cannot be read ({error.strerror or error})") from None


class Poses(NamedTuple):
    """world_from_velodyne: float64 [4, 4] by frame number, in the dataset's world, z up. problems:
    one sentence each."""

    world_from_velodyne: Mapping[int, np.ndarray]
    problems: tuple[str, ...] = ()


def oxts_poses(root: Path, names: Mapping[int, str], velodyne_from_imu: np.ndarray) -> Poses:
    """Poses from the GPS/IMU files `names`, in KITTI's Mercator world: x east, y north, z the
    altitude, metres, scaled by the cosine of the first file's latitude."""
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
    numbers: the drive's frames."""
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
        world_from_rectified = checked_pose(parse_numbers(line, where, (3, 4)), where)
        poses[number] = _UP_FROM_CAMERA @ world_from_rectified @ rectified_from_velodyne
    if not set(poses) & set(numbers):
        raise AdapterError(
            f"{path} has {len(lines)} poses, none of them of frames {numbers[0]} to {numbers[-1]}"
        )
    return Poses(poses)


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
    pose[:3, :3] = rotation_about(2, yaw) @ rotation_about(1, pitch) @ rotation_about(0, roll)
    pose[0, 3] = scale * EARTH_RADIUS_M * np.radians(longitude)
    pose[1, 3] = scale * EARTH_RADIUS_M * np.log(np.tan(np.pi * (90 + latitude) / 360))
    pose[2, 3] = altitude
    return pose


def rotation_about(axis: int, angle: float) -> np.ndarray:
    """Rotation about x, y or z (0, 1, 2), float64 [3, 3]."""
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = cos
    matrix[i, j], matrix[j, i] = -sin, sin
    return matrix


class _Surface(NamedTuple):
    """Thinned points [N, 3] of a sweep, those of them on surfaces [M, 3], and normals [M, 3]."""

    points: np.ndarray
    flat: np.ndarray
    normals: np.ndarray


class Match(NamedTuple):
    """before_from_after: float64 [4, 4]. fitness: part of the points with a surface within half a
    metre. rmse_m: of their distances from it."""

    before_from_after: np.ndarray
    fitness: float
    rmse_m: float


def registered_poses(numbers: Sequence[int], read: Callable[[int], np.ndarray | None]) -> Poses:
    """Poses of the frames with a sweep, in the Velodyne's frame of the first.

    read: the returns [N, 3 or more] of a frame in the Velodyne's frame, or None.
    Each sweep is matched with the one before, starting from the motion between the two before."""
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
    measured = (
        f"poses are from registering {len(matches) + 1} sweeps one after the other (poses=icp): "
        f"mean fitness {fitness:.3f}, inlier RMSE {rmse:.3f} m; they drift over long drives"
    )
    poor = [number for number, m in matches.items() if m.fitness < _POOR_FITNESS]
    if not poor:
        return (measured,)
    return (
        measured,
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
    if len(thin) >= _MIN_SURFACE_POINTS:
        normals, flat = _normals(thin)
        if flat.sum() >= _MIN_SURFACE_POINTS:
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
