"""Files of a KITTI folder: calibration, times, sweeps, and poses.

Poses come from GPS/IMU, from a file, or from registering the sweeps. The caller is
`adapters.kitti.adapter`.

    raw     <drive>/image_0X/data/NNNNNNNNNN.png      timestamps.txt beside data/
            <drive>/velodyne_points/data/NNNNNNNNNN.bin
            <drive>/oxts/data/NNNNNNNNNN.txt          <drive>/tracklet_labels.xml
            calib_*.txt in the drive's folder or the one above (the day's)
    object  calib/NNNNNN.txt  image_2/NNNNNN.png  velodyne/NNNNNN.bin  label_2/NNNNNN.txt

Images may be .jpg too. A frame's number is that of its files. A point of the Velodyne is at
`P_rect_0X @ R_rect_00 @ [R T]` in the image of camera X. P's first three columns are the intrinsics
K of camera X. K^-1 times the fourth column is the offset that takes a point from the rectified
camera 0 to camera X. The ego frame is the Velodyne's: x forward, y left, z up, its origin 1.73 m
above the road. Times have no zone; they are read as UTC, nanoseconds since 1970. Errors are
AdapterErrors that name the file.
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

from adapters.plain_files import (
    checked_pose,
    parse_numbers,
    read_numbers,
    read_text,
    resolve_inside,
)
from adapters.raw_drive import describe_frames
from augment.errors import AdapterError
from augment.scene.lenses import OpenCVLens

CAM_TO_CAM = "calib_cam_to_cam.txt"
VELODYNE = "velodyne_points"
COLOUR_CAMERAS = ("image_02", "image_03")
GREY_CAMERAS = ("image_00", "image_01")
OBJECT_CAMERAS = ("image_2", "image_3")
# Endings of image files. The later one is used if a frame has both.
IMAGE_SUFFIXES = (".jpg", ".png")
RAW_DIGITS = 10
OBJECT_DIGITS = 6
# Drives that a message names.
_MAX_LISTED_DRIVES = 3
# Time between frames: the Velodyne turns ten times a second and triggers the cameras.
FRAME_NS = 100_000_000
# A time in timestamps.txt.
_TIME_PATTERN = re.compile(r"(19[7-9]\d|20\d\d|21\d\d)-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")
# Size of a return in a sweep's file: four float32.
_RETURN_BYTES = 16
# Largest file of a sweep. A turn of the sensor is 2 MB.
_MAX_BYTES = 512 * 2**20
# Width and height, pixels.
Size = tuple[int, int]

# Radius of KITTI's Mercator projection.
EARTH_RADIUS_M = 6378137.0
# Numbers in a GPS/IMU file.
_NUM_OXTS_VALUES = 30
# Largest absolute latitude that is accepted. Mercator's scale goes to infinity at the poles.
_MAX_LATITUDE_DEG = 85.0
# Rows: a z-up world's x (camera's forward), y (its left), z (its up) in a camera's axes.
_UP_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

# Registration of sweeps is NumPy on one thread: the parallel sums of libraries for point clouds
# change the last bits from run to run.

# Edge of the voxels in which a sweep's points are averaged.
_VOXEL_M = 0.25
# Points nearer to the Velodyne than this are of the recording car.
_MIN_RANGE_M = 2.6
# Points further from the Velodyne than this are too sparse.
_MAX_RANGE_M = 60.0
# Points from which a normal is estimated.
_NUM_NEIGHBOURS = 12
# A point is on a surface if the variance along its normal is below this part of the next one.
_MAX_FLAT_RATIO = 0.05
# Stages of the registration: largest distance of a match in metres, number of iterations.
_STAGES = ((4.0, 12), (1.5, 12), (0.5, 15))
# Residual whose weight is one half in the last stage.
_HALF_WEIGHT_RESIDUAL_M = 0.2
# Iterations end if a step changes the pose by less than this, in metres and radians.
_MIN_STEP_CHANGE = 1e-6
# A sweep with fewer points on surfaces cannot be registered.
_MIN_SURFACE_POINTS = 200
# Matches of lower fitness are reported.
_MIN_GOOD_FITNESS = 0.5


def kitti_root(path: str | Path) -> tuple[Path, Path]:
    """Return the folder of the data and the folder of its calibration.

    The folder of a raw drive has its calibration inside or in the folder above. A folder of the
    object benchmark, or the folder above its training/, has its calibration in calib/.
    """
    root = Path(path)
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a KITTI drive or object folder")
    if (root / VELODYNE).is_dir():
        for folder in (root, root.absolute().parent):
            if (folder / CAM_TO_CAM).is_file():
                return root, folder
        raise AdapterError(
            f"{root} holds {VELODYNE}/ but there is no {CAM_TO_CAM} in it or in "
            f"{root.absolute().parent}; unpack the day's calibration there (KITTI's "
            f"<date>_calib.zip)"
        )
    for folder in (root, root / "training"):
        if is_object_folder(folder):
            return folder, folder / "calib"
    drives = sorted(p.parent for p in root.glob(f"*/{VELODYNE}"))
    if drives:
        num_others = len(drives) - _MAX_LISTED_DRIVES
        drive_names = ", ".join(map(str, drives[:_MAX_LISTED_DRIVES])) + (
            f" and {num_others} more" if num_others > 0 else ""
        )
        raise AdapterError(f"{root} holds drives, it is none itself; give one: {drive_names}")
    parents = root.absolute().parents[:2]
    parent_root = next((p for p in parents if (p / VELODYNE).is_dir() or is_object_folder(p)), None)
    raise AdapterError(
        f"{root} is no KITTI folder: expected {VELODYNE}/ (a raw drive), or calib/ beside "
        f"velodyne/ or image_2/ (the object benchmark)"
        + (f"; {parent_root}, above it, is one" if parent_root else "")
    )


def is_object_folder(root: Path) -> bool:
    """Return True if a folder is one of the object benchmark."""
    data = (root / "velodyne", root / "image_2")
    return (root / "calib").is_dir() and any(folder.is_dir() for folder in data)


def list_numbered_files(
    root: Path, folder: str, suffixes: Sequence[str], digits: int
) -> dict[int, str]:
    """Return the files of a folder whose names are `digits` digits, by number, relative to the
    root.
    """
    directory = root / folder
    if not directory.is_dir():
        return {}
    files_by_number: dict[int, str] = {}
    for name in sorted(entry.name for entry in directory.iterdir()):
        stem, dot, ending = name.partition(".")
        if re.fullmatch(rf"[0-9]{{{digits}}}", stem) and dot + ending.lower() in suffixes:
            files_by_number[int(stem)] = f"{folder}/{name}"
    return files_by_number


def resolve_file(root: Path, name: str) -> Path:
    """Return the path of a file in the folder, which need not exist.

    A link out of the folder raises.
    """
    return resolve_inside(root, name, str(root))


class RectifiedCamera(NamedTuple):
    """Calibration of one camera.

    Attributes:
        lens: fx, fy, cx, cy in pixels.
        camera_from_velodyne: float64 [4, 4].
        size: width and height in pixels. None if the calibration does not state them.
        distortion: lens of images that are not rectified; None for rectified ones.
    """

    lens: tuple[float, float, float, float]
    camera_from_velodyne: np.ndarray
    size: tuple[int, int] | None
    distortion: OpenCVLens | None = None


class Calibration(NamedTuple):
    """Calibration of a folder.

    Attributes:
        cameras: calibration by camera.
        rectified_from_velodyne: float64 [4, 4], into camera 0 after rectification.
    """

    cameras: Mapping[str, RectifiedCamera]
    rectified_from_velodyne: np.ndarray


@dataclass(frozen=True)
class KeyedLines:
    """Lines `key: words` of a file. Keys that are not read may hold anything."""

    path: Path
    lines: dict[str, str]

    @staticmethod
    def read(folder: Path, name: str) -> KeyedLines:
        """Read the lines of a file."""
        path = resolve_file(folder, name)
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
        """Return a key's finite numbers, float64 of the given shape."""
        if key not in self.lines:
            raise AdapterError(
                f"{self.path} has no {key!r}; it has {', '.join(self.lines) or 'nothing'}. Copy it "
                f"from the dataset again"
            )
        return parse_numbers(self.lines[key], f"{self.path}: {key}", shape)

    def pose(self, rotation: str, translation: str | None = None) -> np.ndarray:
        """Return a rigid transform from two keys, or a rotation from one, float64 [4, 4]."""
        position = np.zeros(3) if translation is None else self.numbers(translation, 3)
        keys = rotation if translation is None else f"{rotation} and {translation}"
        matrix = np.column_stack([self.numbers(rotation, 3, 3), position])
        return checked_pose(matrix, f"{self.path}: {keys}")


def read_raw_calibration(folder: Path, image_sizes: Mapping[str, Size | None]) -> Calibration:
    """Read the calibration of a day's drives.

    Images of the size before rectification (S_xx) are those of an unrectified release: their
    cameras have the intrinsics K_xx, the distortion D_xx and the pose R_xx, T_xx. All others are
    rectified, and have P_rect_xx.

    Args:
        folder: the folder of the calibration files.
        image_sizes: width and height of the images, None if not known, by camera, such as image_02.
    """
    calibration_lines = KeyedLines.read(folder, CAM_TO_CAM)
    camera_from_velodyne = KeyedLines.read(folder, "calib_velo_to_cam.txt").pose("R", "T")
    rectified_from_velodyne = calibration_lines.pose("R_rect_00") @ camera_from_velodyne
    cameras = {}
    for name, size in image_sizes.items():
        number = name.removeprefix("image_")
        if size is not None and _is_unrectified(calibration_lines, number, size):
            cameras[name] = _read_unrectified(calibration_lines, number, camera_from_velodyne)
        else:
            cameras[name] = _read_camera(
                calibration_lines, f"P_rect_{number}", rectified_from_velodyne
            )
    return Calibration(cameras, rectified_from_velodyne)


def read_object_calibration(folder: Path, frame: str, names: Iterable[str]) -> Calibration:
    """Read the calibration of one frame of the object benchmark.

    Args:
        folder: the folder of the calibration files.
        frame: the digits of the frame's number.
        names: the cameras, such as image_2.
    """
    calibration_lines = KeyedLines.read(folder, f"{frame}.txt")
    camera_from_velodyne = checked_pose(
        calibration_lines.numbers("Tr_velo_to_cam", 3, 4),
        f"{calibration_lines.path}: Tr_velo_to_cam",
    )
    rectified_from_velodyne = calibration_lines.pose("R0_rect") @ camera_from_velodyne
    return Calibration(
        {
            n: _read_camera(calibration_lines, n.replace("image_", "P"), rectified_from_velodyne)
            for n in names
        },
        rectified_from_velodyne,
    )


def read_velodyne_from_imu(folder: Path) -> np.ndarray:
    """Read velodyne_from_imu, float64 [4, 4]. The GPS/IMU unit is what drives are located by."""
    return KeyedLines.read(folder, "calib_imu_to_velo.txt").pose("R", "T")


def _read_camera(
    calibration_lines: KeyedLines, key: str, rectified_from_velodyne: np.ndarray
) -> RectifiedCamera:
    """Return the camera whose projection matrix P is stored under a key."""
    projection = calibration_lines.numbers(key, 3, 4)
    k = projection[:, :3]
    pinhole = np.array([[k[0, 0], 0, k[0, 2]], [0, k[1, 1], k[1, 2]], [0, 0, 1]])
    if not (np.allclose(k, pinhole, atol=1e-6) and k[0, 0] > 0 and k[1, 1] > 0):
        raise AdapterError(
            f"{calibration_lines.path}: {key} must be a rectified pinhole: fx 0 cx . 0 fy cy . 0 0 "
            f"1 . with fx, fy > 0; got {projection.tolist()}"
        )
    camera_from_rectified = np.eye(4)
    camera_from_rectified[:3, 3] = np.linalg.solve(pinhole, projection[:, 3])
    lens = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    pose = camera_from_rectified @ rectified_from_velodyne
    return RectifiedCamera(
        lens, pose, _read_image_size(calibration_lines, key.replace("P_rect", "S_rect"))
    )


def _is_unrectified(calibration_lines: KeyedLines, number: str, size: Size) -> bool:
    """Return True if images of this size are those before rectification."""
    recorded_size = _read_image_size(calibration_lines, f"S_{number}")
    return size == recorded_size != _read_image_size(calibration_lines, f"S_rect_{number}")


def _read_unrectified(
    calibration_lines: KeyedLines, number: str, camera_from_velodyne: np.ndarray
) -> RectifiedCamera:
    """Return a camera before rectification.

    Args:
        calibration_lines: the calibration of the cameras.
        number: the camera's two digits.
        camera_from_velodyne: float64 [4, 4], into camera 0 before rectification.
    """
    k = calibration_lines.numbers(f"K_{number}", 3, 3)
    pinhole = np.array([[k[0, 0], 0, k[0, 2]], [0, k[1, 1], k[1, 2]], [0, 0, 1]])
    if not (np.allclose(k, pinhole, atol=1e-6) and k[0, 0] > 0 and k[1, 1] > 0):
        raise AdapterError(
            f"{calibration_lines.path}: K_{number} must be fx 0 cx 0 fy cy 0 0 1 with fx, fy > 0; "
            f"got {k.tolist()}"
        )
    distortion = OpenCVLens.from_coefficients(calibration_lines.numbers(f"D_{number}", 5).tolist())
    # OpenCV, in whose model the calibration is, has whole numbers at the middle of pixels.
    lens = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]) + 0.5, float(k[1, 2]) + 0.5)
    pose = calibration_lines.pose(f"R_{number}", f"T_{number}") @ camera_from_velodyne
    size = _read_image_size(calibration_lines, f"S_{number}")
    return RectifiedCamera(lens, pose, size, distortion)


def _read_image_size(calibration_lines: KeyedLines, key: str) -> Size | None:
    """Return the width and height of a camera's image in the calibration, or None without them."""
    if not key.startswith("S_") or key not in calibration_lines.lines:
        return None
    width, height = calibration_lines.numbers(key, 2)
    if not (1 <= width <= 1e5 and 1 <= height <= 1e5 and width % 1 == 0 and height % 1 == 0):
        raise AdapterError(
            f"{calibration_lines.path}: {key} must be a width and a height in pixels; got "
            f"{width:g} {height:g}"
        )
    return int(width), int(height)


def read_times(root: Path, folder: str) -> dict[int, int]:
    """Read a folder's timestamps.txt: nanoseconds by frame number.

    Frames whose line is empty are left out. Without the file the result is empty.
    """
    path = resolve_file(root, f"{folder}/timestamps.txt")
    if not path.exists():
        return {}
    times = {}
    for number, line in enumerate(read_text(path).splitlines()):
        text = line.strip()
        if not text:
            continue
        try:
            if not _TIME_PATTERN.fullmatch(text):
                raise ValueError(text)
            times[number] = int(np.datetime64(text.replace(" ", "T"), "ns").astype(np.int64))
        except ValueError:
            raise AdapterError(
                f"{path}, line {number + 1}: expected a time such as "
                f"2011-09-26 13:02:25.964389445; got {text[:60]!r}"
            ) from None
    return times


def frame_times(
    root: Path, known_times: Mapping[int, int], numbers: Sequence[int]
) -> tuple[dict[int, int], tuple[str, ...]]:
    """Return the time of every frame, and a sentence if times had to be assumed.

    An assumed time counts ten frames a second from the nearest frame whose time is known, or from 0
    at frame 0.
    """
    missing = [number for number in numbers if number not in known_times]
    known_frames = np.array(sorted(known_times) or [0])
    times = {}
    for number in numbers:
        known_frame = int(known_frames[np.abs(known_frames - number).argmin()])
        times[number] = known_times.get(known_frame, 0) + (number - known_frame) * FRAME_NS
    for before, after in itertools.pairwise(numbers):
        if times[after] <= times[before]:
            raise AdapterError(
                f"{root}: by timestamps.txt frame {after} was not taken after frame {before} "
                f"({times[after]} ns and {times[before]} ns); correct the file, or leave it "
                f"out: ten frames a second are assumed then"
            )
    if not missing:
        return times, ()
    fault = "its timestamps.txt has no times" if not known_times else "timestamps.txt has no line"
    return times, (
        f"{root}: {fault} for {describe_frames(missing)}; ten frames a second are assumed",
    )


def read_returns(root: Path, name: str) -> np.ndarray:
    """Read a sweep's returns as stored, float32 [N, 4]: x y z and reflectance.

    A file ending in .txt has a line of four numbers for each return.

    x y z are metres in the Velodyne's frame. A turn takes 0.1 s; the displacement of the points by
    the car's motion during the turn is not corrected.
    """
    path = resolve_file(root, name)
    if path.suffix.lower() == ".txt":
        values = read_numbers(path)
        if not values.size or values.size % 4:
            raise AdapterError(
                f"{path} must have four numbers (x y z reflectance) for each return; it has "
                f"{values.size}. Copy it again"
            )
        return values.astype(np.float32).reshape(-1, 4)
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
    """Poses of a drive's frames.

    Attributes:
        world_from_velodyne: float64 [4, 4] by frame number, in the dataset's world, z up.
        problems: one sentence each.
    """

    world_from_velodyne: Mapping[int, np.ndarray]
    problems: tuple[str, ...] = ()


def oxts_poses(root: Path, names: Mapping[int, str], velodyne_from_imu: np.ndarray) -> Poses:
    """Read the poses in the GPS/IMU files `names`, in KITTI's Mercator world.

    Its x is east, y north and z the altitude, in metres, scaled by the cosine of the first file's
    latitude.
    """
    packets = {}
    problems = []
    for number, name in sorted(names.items()):
        try:
            packets[number] = _read_packet(resolve_file(root, name))
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
    """Read poses from a file in the format of KITTI's odometry benchmark.

    Each line has 12 numbers: the rows of world_from_camera for the rectified left grey camera 0.
    Its world is turned to z up here. If there are as many lines as frames, they are the frames in
    their order; else line n (from 0) is frame n.

    Args:
        path: the file.
        numbers: the drive's frames.
        rectified_from_velodyne: float64 [4, 4].
    """
    if not path.is_file():
        raise AdapterError(
            f"kitti: poses must be icp or a file of poses; got {str(path)!r}, and there is no file "
            f"{path.absolute()}"
        )
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    is_in_order = len(lines) == len(numbers)
    poses = {}
    for row, line in enumerate(lines):
        number = numbers[row] if is_in_order else row
        where = f"{path}, line {row + 1}"
        world_from_rectified = checked_pose(parse_numbers(line, where, (3, 4)), where)
        poses[number] = _UP_FROM_CAMERA @ world_from_rectified @ rectified_from_velodyne
    if not set(poses) & set(numbers):
        raise AdapterError(
            f"{path} has {len(lines)} poses, none of them of frames {numbers[0]} to {numbers[-1]}"
        )
    return Poses(poses)


def _read_packet(path: Path) -> np.ndarray:
    """Read the 30 numbers of a GPS/IMU file.

    They are latitude and longitude (degrees), altitude (metres), roll, pitch and yaw (radians), and
    24 that are not used.
    """
    values = read_numbers(path, (_NUM_OXTS_VALUES,))
    latitude, longitude, altitude = values[:3]
    if abs(latitude) > _MAX_LATITUDE_DEG or abs(longitude) > 180 or abs(altitude) > 1e4:
        raise AdapterError(
            f"{path} must begin with latitude, longitude (degrees) and altitude (metres); got "
            f"{latitude:g} {longitude:g} {altitude:g}"
        )
    return values


def _mercator_pose(packet: np.ndarray, scale: float) -> np.ndarray:
    """Return world_from_imu, float64 [4, 4]."""
    latitude, longitude, altitude, roll, pitch, yaw = packet[:6]
    pose = np.eye(4)
    pose[:3, :3] = rotation_about(2, yaw) @ rotation_about(1, pitch) @ rotation_about(0, roll)
    pose[0, 3] = scale * EARTH_RADIUS_M * np.radians(longitude)
    pose[1, 3] = scale * EARTH_RADIUS_M * np.log(np.tan(np.pi * (90 + latitude) / 360))
    pose[2, 3] = altitude
    return pose


def rotation_about(axis: int, angle: float) -> np.ndarray:
    """Return the rotation about x, y or z (axis 0, 1, 2), float64 [3, 3]."""
    cos = np.cos(angle)
    sin = np.sin(angle)
    matrix = np.eye(3)
    i = (axis + 1) % 3
    j = (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = cos
    matrix[i, j] = -sin
    matrix[j, i] = sin
    return matrix


class _Surface(NamedTuple):
    """Thinned points of a sweep.

    Attributes:
        points: float64 [N, 3].
        surface_points: float64 [M, 3], the points that lie on surfaces.
        normals: float64 [M, 3], normals of the surface points.
    """

    points: np.ndarray
    surface_points: np.ndarray
    normals: np.ndarray


class Match(NamedTuple):
    """Registration of a sweep with the one before.

    Attributes:
        before_from_after: float64 [4, 4].
        fitness: fraction of the points that have a surface within half a metre.
        rmse_m: root mean square of these points' distances to the surface.
    """

    before_from_after: np.ndarray
    fitness: float
    rmse_m: float


def registered_poses(
    numbers: Sequence[int], read_sweep: Callable[[int], np.ndarray | None]
) -> Poses:
    """Return poses of the frames with a sweep, in the Velodyne's frame of the first one.

    Each sweep is matched with the one before. The first guess is the motion between the two sweeps
    before.

    Args:
        numbers: frames, ascending.
        read_sweep: function that returns the returns [N, 3 or more] of a frame in the Velodyne's
            frame, or None.
    """
    pose = np.eye(4)
    step = np.eye(4)
    poses: dict[int, np.ndarray] = {}
    matches: dict[int, Match] = {}
    previous_surface: _Surface | None = None
    for number in tqdm(numbers, desc="registration", unit="sweep", disable=None):
        returns = read_sweep(number)
        if returns is None:
            continue
        surface = _build_surface(returns[:, :3].astype(np.float64), number)
        if previous_surface is not None:
            match = _register(surface, previous_surface, step)
            matches[number] = match
            step = match.before_from_after
            pose = pose @ step
        poses[number] = pose
        previous_surface = surface
    if not poses:
        raise AdapterError(
            f"poses=icp: frames {numbers[0]} to {numbers[-1]} have no sweep to find poses from"
        )
    return Poses(poses, _registration_problems(matches))


def _registration_problems(matches: dict[int, Match]) -> tuple[str, ...]:
    """Return sentences on the quality of the registration."""
    if not matches:
        return ()
    fitness = np.mean([m.fitness for m in matches.values()])
    rmse = np.mean([m.rmse_m for m in matches.values()])
    summary = (
        f"poses are from registering {len(matches) + 1} sweeps one after the other (poses=icp): "
        f"mean fitness {fitness:.3f}, inlier RMSE {rmse:.3f} m; they drift over long drives"
    )
    poor_frames = [number for number, m in matches.items() if m.fitness < _MIN_GOOD_FITNESS]
    if not poor_frames:
        return (summary,)
    return (
        summary,
        f"the sweep of frame {poor_frames[0]} and {len(poor_frames) - 1} others hardly match the "
        f"one before",
    )


def _register(source: _Surface, target: _Surface, guess: np.ndarray) -> Match:
    """Register a sweep with the one before: point-to-plane ICP with robust weights, coarse to
    fine.

    Args:
        source: the later sweep.
        target: the earlier sweep.
        guess: target_from_source, float64 [4, 4], to start from.
    """
    tree = cKDTree(target.surface_points)
    transform = guess
    for max_distance_m, iterations in _STAGES:
        half_weight_residual_m = _HALF_WEIGHT_RESIDUAL_M * max_distance_m / _STAGES[-1][0]
        for _ in range(iterations):
            moved_points, index, is_near = _find_nearest(tree, source, transform, max_distance_m)
            residual = _residuals(moved_points[is_near], target, index[is_near])
            step = _solve_step(
                moved_points[is_near],
                target.normals[index[is_near]],
                residual,
                half_weight_residual_m,
            )
            transform = step @ transform
            if np.abs(step - np.eye(4)).max() < _MIN_STEP_CHANGE:
                break
    moved_points, index, is_near = _find_nearest(tree, source, transform, _STAGES[-1][0])
    residual = _residuals(moved_points[is_near], target, index[is_near])
    rmse = float(np.sqrt(np.mean(residual**2))) if is_near.any() else float("inf")
    return Match(transform, float(is_near.mean()), rmse)


def _find_nearest(
    tree: cKDTree, source: _Surface, transform: np.ndarray, max_distance_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the moved points [N, 3], the nearest surface point of each [N], and a mask of
    matches [N].
    """
    moved_points = source.points @ transform[:3, :3].T + transform[:3, 3]
    distance, index = tree.query(moved_points, distance_upper_bound=max_distance_m)
    return moved_points, index, np.isfinite(distance)


def _residuals(points: np.ndarray, surface: _Surface, index: np.ndarray) -> np.ndarray:
    """Return the signed distances of points to the planes of their surface points, metres [N]."""
    return np.einsum("ij,ij->i", points - surface.surface_points[index], surface.normals[index])


def _solve_step(
    points: np.ndarray, normals: np.ndarray, residual: np.ndarray, half_weight_residual_m: float
) -> np.ndarray:
    """Return the Gauss-Newton step as a rigid transform, float64 [4, 4].

    Large residuals, such as those of moving objects, weigh little.
    """
    weight = 1 / (1 + (residual / half_weight_residual_m) ** 2)
    jacobian = np.concatenate([np.cross(points, normals), normals], axis=1)  # [N, 6]
    hessian = np.einsum("n,ni,nj->ij", weight, jacobian, jacobian)
    gradient = np.einsum("n,n,ni->i", weight, residual, jacobian)
    # A direction that no surface holds stays where it is.
    change = -np.linalg.solve(hessian + 1e-6 * np.trace(hessian) * np.eye(6), gradient)
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix()
    step[:3, 3] = change[3:]
    return step


def _build_surface(points: np.ndarray, number: int) -> _Surface:
    """Return a sweep's thinned points and surfaces. number: its frame, for messages."""
    distance = np.linalg.norm(points, axis=1)
    points = points[(distance > _MIN_RANGE_M) & (distance < _MAX_RANGE_M)]  # False for NaN too
    thinned_points = _average_voxels(points)
    if len(thinned_points) >= _MIN_SURFACE_POINTS:
        normals, is_flat = _estimate_normals(thinned_points)
        if is_flat.sum() >= _MIN_SURFACE_POINTS:
            return _Surface(thinned_points, thinned_points[is_flat], normals[is_flat])
    raise AdapterError(
        f"poses=icp: the sweep of frame {number} has too few surfaces ({len(thinned_points)} "
        f"points) to be registered; give poses=FILE, or frames without it"
    )


def _average_voxels(points: np.ndarray) -> np.ndarray:
    """Return the mean of the points of each voxel, float64 [M, 3]."""
    x, y, z = np.floor((points + _MAX_RANGE_M) / _VOXEL_M).astype(np.int64).T
    side = int(2 * _MAX_RANGE_M / _VOXEL_M) + 1
    _, cell, counts = np.unique((x * side + y) * side + z, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell, points[:, i], len(counts)) for i in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]


def _estimate_normals(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal of each point's neighbourhood [N, 3], and a mask of the flat ones [N].

    The normal is the direction of least spread of the nearest points.
    """
    _, index = cKDTree(points).query(points, _NUM_NEIGHBOURS)
    offsets = points[index] - points[index].mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    return axes[:, :, 0], variance[:, 0] < _MAX_FLAT_RATIO * variance[:, 1]
