"""Where a KITTI folder keeps its files.

    raw     <drive>/image_0X/data/NNNNNNNNNN.png      timestamps.txt beside data/
            <drive>/velodyne_points/data/NNNNNNNNNN.bin
            <drive>/oxts/data/NNNNNNNNNN.txt          <drive>/tracklet_labels.xml
            calib_*.txt in the drive's folder or the one above (the day's)
    object  calib/NNNNNN.txt  image_2/NNNNNN.png  velodyne/NNNNNN.bin  label_2/NNNNNN.txt

Images may be .jpg too. A frame's number is that of its files.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.lidar_scene.split import Sweep
from adapters.plain_files import checked_pose, inside, read_text
from augment.errors import AdapterError
from augment.labels import LidarSweep
from augment.semantics import SemanticClass

# ---- layout --------------------------------------------------------------------------------------

CAM_TO_CAM = "calib_cam_to_cam.txt"
VELO_TO_CAM = "calib_velo_to_cam.txt"
IMU_TO_VELO = "calib_imu_to_velo.txt"
VELODYNE = "velodyne_points"
COLOUR_CAMERAS, GREY_CAMERAS = ("image_02", "image_03"), ("image_00", "image_01")
OBJECT_CAMERAS = ("image_2", "image_3")
IMAGE_SUFFIXES = (".jpg", ".png")  # the later wins where a frame has both
RAW_DIGITS, OBJECT_DIGITS = 10, 6
_MAX_NAMED = 3


def kitti_root(path: str | Path) -> tuple[Path, Path]:
    """The folder of the drive, and the folder of its calibration.

    path: a raw drive, whose calibration lies in it or above; or a folder of the object benchmark,
    or the one that holds its training/, whose calibration is its calib/.

    Raises:
        AdapterError: neither; says what was looked for.
    """
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
        raise AdapterError(f"{root} holds drives, it is none itself; give one: {_few(drives)}")
    above = next((p for p in root.absolute().parents[:2] if _is_kitti(p)), None)
    raise AdapterError(
        f"{root} is no KITTI folder: expected {VELODYNE}/ (a raw drive), or calib/ beside "
        f"velodyne/ or image_2/ (the object benchmark)"
        + (f"; {above}, above it, is one" if above else "")
    )


def is_object_folder(root: Path) -> bool:
    """Whether a folder is one of the object benchmark."""
    data = (root / "velodyne", root / "image_2")
    return (root / "calib").is_dir() and any(folder.is_dir() for folder in data)


def _is_kitti(root: Path) -> bool:
    return (root / VELODYNE).is_dir() or is_object_folder(root)


def _few(drives: Sequence[Path]) -> str:
    rest = len(drives) - _MAX_NAMED
    named = ", ".join(map(str, drives[:_MAX_NAMED]))
    return named + (f" and {rest} more" if rest > 0 else "")


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
    """A file of the folder, there or not.

    Raises:
        AdapterError: it is a link that leads out of the folder.
    """
    return inside(root, name, str(root))


def some(numbers: Sequence[int]) -> str:
    """How many frames and the first of them, for messages."""
    named = ", ".join(map(str, numbers[:_MAX_NAMED]))
    more = ", ..." if len(numbers) > _MAX_NAMED else ""
    return f"{len(numbers)} frame{'' if len(numbers) == 1 else 's'} ({named}{more})"


# ---- KITTI's calibration files: rectified pinholes, and where they are to the Velodyne -----------
# A point of the Velodyne is at `P_rect_0X @ R_rect_00 @ [R T]` in the image of camera X. P's first
# three columns are its intrinsics K; K^-1 times the fourth is what to add to a point of the
# rectified
# camera 0 to have it in camera X. Intrinsics are taken as they are.


@dataclass(frozen=True, eq=False)
class RectifiedCamera:
    """A rectified camera. camera_from_velodyne: float64 [4, 4]. size: width and height in pixels
    where the calibration says so.
    """

    name: str
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_velodyne: np.ndarray
    size: tuple[int, int] | None


@dataclass(frozen=True, eq=False)
class Calibration:
    """rectified_from_velodyne: float64 [4, 4], into camera 0 after rectification."""

    cameras: tuple[RectifiedCamera, ...]
    rectified_from_velodyne: np.ndarray


@dataclass(frozen=True)
class KeyedLines:
    """A file of lines `key: words`."""

    path: Path
    lines: dict[str, str]

    @staticmethod
    def read(folder: Path, name: str) -> KeyedLines:
        """The file; keys that nobody asks for may hold anything.

        Raises:
            AdapterError: missing, no text, a line without a key, or a key that is there twice.
        """
        path = file_in(folder, name)
        lines: dict[str, str] = {}
        for number, line in enumerate(read_text(path).splitlines(), start=1):
            key, colon, words = line.partition(":")
            if not line.strip():
                continue
            if not colon:
                raise AdapterError(
                    f"{path}, line {number}: expected `key: numbers`; got {line[:60]!r}"
                )
            if key.strip() in lines:
                raise AdapterError(
                    f"{path}, line {number}: {key.strip()!r} is there twice; delete the wrong one"
                )
            lines[key.strip()] = words
        return KeyedLines(path, lines)

    def numbers(self, key: str, *shape: int) -> np.ndarray:
        """A key's numbers, float64 in that shape.

        Raises:
            AdapterError: no such key, another count, or anything but finite numbers.
        """
        if key not in self.lines:
            raise AdapterError(
                f"{self.path} has no {key!r}; it has {', '.join(self.lines) or 'nothing'}. Copy it "
                f"from the dataset again"
            )
        words = self.lines[key].split()
        try:
            values = np.array([float(word) for word in words], np.float64)
        except ValueError as error:
            raise AdapterError(f"{self.path}: {key} must hold numbers ({error})") from None
        if values.size != int(np.prod(shape)):
            expected = " x ".join(map(str, shape))
            raise AdapterError(
                f"{self.path}: {key} must hold {expected} numbers; it holds {values.size}"
            )
        if not np.isfinite(values).all():
            raise AdapterError(f"{self.path}: {key} must be finite; got {self.lines[key].strip()}")
        return values.reshape(shape)

    def pose(self, rotation: str, translation: str) -> np.ndarray:
        """A rigid transform from two keys, float64 [4, 4]."""
        matrix = np.column_stack([self.numbers(rotation, 3, 3), self.numbers(translation, 3)])
        return checked_pose(matrix, f"{self.path}: {rotation} and {translation}")

    def rotation(self, key: str) -> np.ndarray:
        """A rotation as a rigid transform, float64 [4, 4]."""
        matrix = np.column_stack([self.numbers(key, 3, 3), np.zeros(3)])
        return checked_pose(matrix, f"{self.path}: {key}")


def read_raw_calibration(folder: Path, names: Sequence[str]) -> Calibration:
    """The calibration of a day's drives. names: of the cameras, such as image_02.

    Raises:
        AdapterError: a file or key is missing, or holds something else.
    """
    cameras = KeyedLines.read(folder, CAM_TO_CAM)
    velodyne = KeyedLines.read(folder, VELO_TO_CAM).pose("R", "T")
    rectified = cameras.rotation("R_rect_00") @ velodyne
    made = []
    for name in names:
        number = name.removeprefix("image_")
        size = None
        if f"S_rect_{number}" in cameras.lines:
            size = _size(cameras, f"S_rect_{number}")
        made.append(_camera(name, cameras, f"P_rect_{number}", rectified, size))
    return Calibration(tuple(made), rectified)


def read_object_calibration(folder: Path, frame: str, names: Sequence[str]) -> Calibration:
    """The calibration of one frame of the object benchmark. frame: its digits. names: of the
    cameras, such as image_2.

    Raises:
        AdapterError: the file or a key is missing, or holds something else.
    """
    keyed = KeyedLines.read(folder, f"{frame}.txt")
    velodyne = checked_pose(keyed.numbers("Tr_velo_to_cam", 3, 4), f"{keyed.path}: Tr_velo_to_cam")
    rectified = keyed.rotation("R0_rect") @ velodyne
    made = [
        _camera(name, keyed, f"P{name.removeprefix('image_')}", rectified, None) for name in names
    ]
    return Calibration(tuple(made), rectified)


def read_velodyne_from_imu(folder: Path) -> np.ndarray:
    """Where the Velodyne is to the GPS/IMU unit that drives are located by, float64 [4, 4].

    Raises:
        AdapterError: calib_imu_to_velo.txt is missing or holds something else.
    """
    return KeyedLines.read(folder, IMU_TO_VELO).pose("R", "T")


def _camera(
    name: str,
    keyed: KeyedLines,
    key: str,
    rectified_from_velodyne: np.ndarray,
    size: tuple[int, int] | None,
) -> RectifiedCamera:
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
    return RectifiedCamera(
        name,
        float(k[0, 0]),
        float(k[1, 1]),
        float(k[0, 2]),
        float(k[1, 2]),
        camera_from_rectified @ rectified_from_velodyne,
        size,
    )


def _size(keyed: KeyedLines, key: str) -> tuple[int, int]:
    width, height = keyed.numbers(key, 2)
    if not (1 <= width <= 1e5 and 1 <= height <= 1e5 and width % 1 == 0 and height % 1 == 0):
        raise AdapterError(
            f"{keyed.path}: {key} must be a width and a height in pixels; got {width:g} {height:g}"
        )
    return int(width), int(height)


# ---- When the frames of a raw drive were taken ---------------------------------------------------
# A timestamps.txt has a line a frame, line 0 for frame 0: `2011-09-26 13:02:25.964389445`. Its
# clock
# has no zone; it is read as UTC, nanoseconds since 1970.

FRAME_NS = 100_000_000  # the Velodyne turns ten times a second and triggers the cameras
_TIME = re.compile(r"(19[7-9]\d|20\d\d|21\d\d)-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")


def read_times(root: Path, folder: str) -> dict[int, int]:
    """Nanoseconds by frame number from a folder's timestamps.txt, without the frames whose line is
    empty; nothing without the file.

    Raises:
        AdapterError: a line is no time.
    """
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
    the nearest frame whose time is known, or from 0 at frame 0.

    Raises:
        AdapterError: times do not increase with the frames' numbers.
    """
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
                f"({times[after]} ns and {times[before]} ns); copy the file again"
            )
    if not missing:
        return times, ()
    what = "its timestamps.txt has no times" if not known else "timestamps.txt has no line"
    said = f"{root}: {what} for {some(missing)}; ten frames a second are assumed"
    return times, (said,)


# ------------------------------------------------------------------------------------------------
# Velodyne sweeps: float32 x y z reflectance, x forward, y left, z up, metres, as they are stored
# A turn takes 0.1 s, and what a sweep's points are displaced by while the car moves in it stays.

LIDAR_TOP_DEG = 2.0  # the HDL-64E's uppermost channel
# The recording car around its Velodyne: in measured sweeps all returns within 2.6 m of it that no
# neighbour made.
_EGO_LOW_M, _EGO_HIGH_M = np.array([-2.0, -1.35, -1.5]), np.array([2.6, 1.35, 0.5])
_RETURN_BYTES = 16
_MAX_BYTES = 512 * 2**20  # a turn of the sensor is 2 MB


def read_returns(root: Path, name: str) -> np.ndarray:
    """A sweep's returns, float32 [N, 4], in the Velodyne's frame.

    Raises:
        AdapterError: the file is no sequence of returns, has none, or cannot be read.
    """
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


def usable_sweep(returns: np.ndarray, world_from_velodyne: np.ndarray, timestamp_ns: int) -> Sweep:
    """Returns in the scene's world, without those of the recording car and those not finite."""
    points = returns[:, :3].astype(np.float64)
    keep = np.isfinite(points).all(axis=1)
    keep &= ~((points > _EGO_LOW_M) & (points < _EGO_HIGH_M)).all(axis=1)
    world = _moved(points[keep], world_from_velodyne).astype(np.float32)
    return Sweep(
        world,
        np.full(len(world), timestamp_ns, np.int64),
        np.full(len(world), SemanticClass.UNKNOWN, np.int16),
    )


def labelled_sweep(
    returns: np.ndarray, world_from_velodyne: np.ndarray, timestamp_ns: int
) -> LidarSweep:
    """All returns in the dataset's world, in the file's order: x y z (float64 metres), intensity
    (the file's float32 reflectance), timestamp_ns (the frame's, for all: the file has none)."""
    world = _moved(returns[:, :3].astype(np.float64), world_from_velodyne)
    columns = {axis: np.ascontiguousarray(world[:, i]) for i, axis in enumerate("xyz")}
    columns["intensity"] = returns[:, 3].copy()
    columns["timestamp_ns"] = np.full(len(world), timestamp_ns, np.int64)
    return LidarSweep(columns)


def _moved(points: np.ndarray, transform: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", over="ignore"):  # of returns that are not finite
        return points @ transform[:3, :3].T + transform[:3, 3]
