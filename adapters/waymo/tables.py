"""A segment of the Waymo Open Dataset v2 (perception): its Parquet tables, calibration and images.

    <split>/<component>/<segment>.parquet     or, of one segment alone, <folder>/<component>.parquet

A component is a flat table with columns `key.<name>` and `[<Class>].<field>`. Releases differ in
types: cameras and lasers are numbers or words, transforms float64 or float32; both are read. Rows
have no order, so they are joined by keys. Camera axes are turned to OpenCV's (x right, y down, z
forward); pixel centres are at +0.5 already. Errors are AdapterErrors that name file and column.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from adapters.plain_files import LARGEST, checked_pose
from adapters.raw_drive import describe_frames
from adapters.scene_cache import image_folder
from adapters.waymo.dataset import POSES, REQUIRED, SPLITS
from augment.errors import AdapterError
from augment.files.packed_images import NUMBER_LISTS, Lens, PackedImages, is_number, parquet_errors
from augment.output.manifest import MAX_SIDE_PX
from augment.output.tables import read_table
from augment.scene.shutter import ReadOut

COMPONENTS = {
    "vehicle_pose": "VehiclePoseComponent",
    "camera_calibration": "CameraCalibrationComponent",
    "camera_image": "CameraImageComponent",
    "lidar_calibration": "LiDARCalibrationComponent",
    "lidar": "LiDARComponent",
    "lidar_pose": "LiDARPoseComponent",
    "lidar_box": "LiDARBoxComponent",
    "lidar_segmentation": "LiDARSegmentationLabelComponent",
    "camera_segmentation": "CameraSegmentationLabelComponent",
    "lidar_camera_projection": "LiDARCameraProjectionComponent",
}
CAMERAS = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")  # numbered from 1
LASERS = ("TOP", "FRONT", "SIDE_LEFT", "SIDE_RIGHT", "REAR")  # numbered from 1
TOP = 1
SEGMENT = "key.segment_context_name"  # column of a row's segment
STAMP = "key.frame_timestamp_micros"  # column of a row's frame, Unix time in microseconds
MAX_SIDE = 10_000  # of a range image; published ones have 2650 columns
# Axes of the dataset's cameras (x out of the lens, y left, z up) from OpenCV's.
_CAMERA_FROM_OPENCV = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_LATEST_S = 9e9  # nanoseconds in int64 reach 9.2e18
_NEAR_S = 0.25  # an image is taken this close to its frame's time
# Directions of the read-out, by the dataset's numbers and names.
_READ_OUTS: Mapping[Any, ReadOut] = {
    1: "top_to_bottom",
    2: "left_to_right",
    3: "bottom_to_top",
    4: "right_to_left",
    "TOP_TO_BOTTOM": "top_to_bottom",
    "LEFT_TO_RIGHT": "left_to_right",
    "BOTTOM_TO_TOP": "bottom_to_top",
    "RIGHT_TO_LEFT": "right_to_left",
}
_SPIN_NS = 100_000_000  # one turn of the TOP laser, from the frame's time on
_ADVICE = "write it as the dataset does, or copy the dataset's own file"


# ---- Which files ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class SegmentFiles:
    """Tables of one segment. is_alone: True if its folder holds the files themselves."""

    name: str
    root: Path
    is_alone: bool = False

    def path(self, component: str) -> Path:
        if self.is_alone:
            return self.root / f"{component}.parquet"
        return self.root / component / f"{self.name}.parquet"

    def has(self, component: str) -> bool:
        return self.path(component).is_file()


def find_segments(path: Path) -> dict[str, SegmentFiles]:
    """Return the files of all segments at a path, by the segment's name."""
    files = SegmentFiles("", path, is_alone=True)
    if files.has(POSES):
        file = files.path(POSES)
        with parquet_errors(file):
            table = read_table(file, str(file), [SEGMENT])
        names = set(_segment_names(table, file))
        return {str(name): SegmentFiles(str(name), path, is_alone=True) for name in names}
    return {
        file.stem: SegmentFiles(file.stem, folder)
        for folder in (path, *(path / split for split in SPLITS))
        for file in sorted((folder / POSES).glob("*.parquet"))
    }


def find_segment(path: Path, segment_name: str | None) -> SegmentFiles:
    """Return the files of one segment at a path.

    segment_name: the segment's name or the first part of it; None for the only one."""
    segments = find_segments(path)
    if not segments:
        raise AdapterError(
            f"{path} holds no segment of the Waymo Open Dataset v2; expected "
            f"{POSES}/SEGMENT.parquet in it or in its {', '.join(SPLITS)}"
        )
    names = sorted(segments)
    if segment_name is not None:
        segment_name = segment_name.removeprefix("segment-").removesuffix("_with_camera_labels")
        names = [n for n in names if n == segment_name] or [
            n for n in names if n.startswith(f"{segment_name}_")
        ]
    if len(names) == 1:
        return segments[names[0]]
    examples = ", ".join(names[:3] or sorted(segments)[:3])
    if not names:
        raise AdapterError(
            f"{path} has no segment {segment_name!r}; it has {len(segments)}, such as {examples}"
        )
    raise AdapterError(
        f"{path} has {len(names)} segments; a scene is one of them, give ?segment={names[0]} "
        f"(there are {examples})"
    )


# ---- Columns -------------------------------------------------------------------------------------


def _segment_names(table: pa.Table, path: Path) -> list[str]:
    """Return the segment of each row."""
    if SEGMENT not in table.column_names:
        raise AdapterError(f"{path}: column {SEGMENT} is missing; {_ADVICE}")
    kind = table[SEGMENT].type
    if not _is_text(kind) or table[SEGMENT].null_count:
        raise AdapterError(
            f"{path}: column {SEGMENT} must hold a text in every row; it holds {kind} with "
            f"{table[SEGMENT].null_count} nulls; {_ADVICE}"
        )
    return table[SEGMENT].to_pylist()


class Rows:
    """Rows of one segment in one component.

    A column is named by its field, such as `type`, or by its key, such as `key.laser_name`.
    """

    def __init__(self, files: SegmentFiles, component: str, fields: Sequence[str]) -> None:
        self.path = files.path(component)
        self._class = COMPONENTS[component]
        columns = [field if field == STAMP else self.name(field) for field in fields]
        with parquet_errors(self.path):
            table = read_table(self.path, str(self.path), [SEGMENT, *columns])
            names = _segment_names(table, self.path)
            is_segment = pa.array([name == files.name for name in names], pa.bool_())
            numbered = table.append_column("row", pa.array(np.arange(len(table))))
            self._table = numbered.filter(is_segment)
        if not len(self._table):
            other_names = ", ".join(map(repr, list(dict.fromkeys(names))[:3])) or "none"
            raise self.fault(SEGMENT, f"must be {files.name!r} in some rows; got {other_names}")

    def __len__(self) -> int:
        return len(self._table)

    @property
    def numbers(self) -> np.ndarray:
        """Return the rows' numbers in the file."""
        return self._table["row"].to_numpy()

    def name(self, field: str) -> str:
        return field if field.startswith("key.") else f"[{self._class}].{field}"

    def has(self, field: str) -> bool:
        return self.name(field) in self._table.column_names

    def fault(self, field: str, problem: str) -> AdapterError:
        return AdapterError(f"{self.path}: column {self.name(field)} {problem}; {_ADVICE}")

    def column(self, field: str) -> pa.Array:
        if not self.has(field):
            raise self.fault(field, "is missing")
        return self._table[self.name(field)].combine_chunks()

    def values(self, field: str, *, or_else: float | None = None) -> np.ndarray:
        """Return a number for each row, in the file's type.

        or_else: value for nulls, and for all rows where there is no such column; without it, both
        are refused."""
        if or_else is not None and not self.has(field):
            return np.full(len(self), or_else)
        column = self.column(field)
        kind = column.type
        if not is_number(kind):
            raise self.fault(field, f"must hold numbers; it holds {kind}")
        if column.null_count and or_else is None:
            raise self.fault(
                field, f"must have a value in every row; {column.null_count} have none"
            )
        if column.null_count:
            column = column.cast(pa.float64()).fill_null(or_else)
        return column.to_numpy(zero_copy_only=False)

    def finite(self, field: str, largest: float = LARGEST) -> np.ndarray:
        """Return a column in float64, all finite and none beyond `largest` in size."""
        values = self.values(field).astype(np.float64)
        if not (np.abs(values) <= largest).all():
            bad = values[~(np.abs(values) <= largest)][0]
            raise self.fault(field, f"must hold finite numbers up to {largest:g}; got {bad}")
        return values

    def xyz(self, field: str) -> np.ndarray:
        return np.stack([self.finite(f"{field}.{axis}") for axis in "xyz"], axis=1)

    def stamps(self) -> np.ndarray:
        values = self.values(STAMP)
        if values.dtype.kind not in "iu":
            raise self.fault(STAMP, f"must hold whole microseconds; it holds {values.dtype}")
        return values.astype(np.int64)

    def texts(self, field: str) -> list[str]:
        values = self.column(field).to_pylist()
        if not all(isinstance(value, str) for value in values):
            raise self.fault(field, "must hold a text in every row")
        return values

    def enum(self, field: str, words: Sequence[str]) -> np.ndarray:
        """Return the number of each row's word, from 1, int64; the file may hold either."""
        number_of = {word: number for number, word in enumerate(words, start=1)}
        number_of |= {number: number for number in number_of.values()}
        values = self._words(field)
        if unknown_values := [value for value in values if value not in number_of]:
            expected = f"numbers from 1 to {len(words)} or {', '.join(words)}"
            raise self.fault(field, f"must hold {expected}; got {unknown_values[0]!r}")
        return np.array([number_of[value] for value in values], np.int64)

    def box_types(self, field: str, words: Sequence[str]) -> list[str]:
        """Return the word of each row; Unknown where the row has another value.

        A row holds the word's number, from 1, or the dataset's name of it, such as
        TYPE_VEHICLE."""
        word_of = {number: word for number, word in enumerate(words, start=1)}
        word_of |= {f"TYPE_{word.upper()}": word for word in words}
        return [word_of.get(value, "Unknown") for value in self._words(field)]

    def read_outs(self, field: str) -> list[ReadOut | None]:
        """Return the direction of each row's read-out; None for a global or an unknown one."""
        if not self.has(field):
            return [None] * len(self)
        return [_READ_OUTS.get(value) for value in self._words(field)]

    def _words(self, field: str) -> list[Any]:
        """Return a column of numbers, texts or None."""
        column = self.column(field)
        if not (is_number(column.type) or _is_text(column.type) or pa.types.is_null(column.type)):
            raise self.fault(field, f"must hold whole numbers or texts; it holds {column.type}")
        return column.to_pylist()

    def poses(self, field: str) -> np.ndarray:
        """Return rigid transforms, float64 [N, 4, 4]."""
        flat = self.lists(field)
        if any(values is None or values.shape != (16,) for values in flat):
            raise self.fault(field, "must hold 16 numbers in every row")
        where = f"{self.path}: column {self.name(field)}, row"
        return np.stack(
            [
                checked_pose(values.reshape(4, 4), f"{where} {row}")
                for row, values in zip(self.numbers, flat, strict=True)
            ]
        )

    def lists(self, field: str) -> list[np.ndarray | None]:
        """Return the float64 numbers of each row's list, None for null."""
        column = self.column(field)
        if not NUMBER_LISTS.matches(column.type):
            raise self.fault(field, f"must hold {NUMBER_LISTS.words}; it holds {column.type}")
        lists = [None if cell.values is None else _flat(cell) for cell in column]
        if any(values is not None and not np.isfinite(values).all() for values in lists):
            raise self.fault(field, "holds numbers that are not finite")
        return lists


def _is_text(kind: pa.DataType) -> bool:
    """Return True for a column of texts, plain or by a dictionary, as categories of pandas are."""
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _flat(cell: Any) -> np.ndarray:
    return cell.values.to_numpy(zero_copy_only=False).astype(np.float64)


# ---- Calibration ---------------------------------------------------------------------------------


class Mount(NamedTuple):
    """A camera on the car.

    Attributes:
        lens: size, intrinsics and distortion.
        vehicle_from_camera: float64 [4, 4], OpenCV axes.
        read_out: direction in which its rows or columns are read; None for a global shutter, or if
            the calibration does not say.
    """

    lens: Lens
    vehicle_from_camera: np.ndarray
    read_out: ReadOut | None = None


@dataclass(frozen=True, eq=False)
class Laser:
    """A laser on the car.

    Attributes:
        vehicle_from_laser: float64 [4, 4].
        inclinations_rad: those of the range image's rows from the last to the first; or their
            lowest and highest limit, if rows are evenly spread.
    """

    name: str
    vehicle_from_laser: np.ndarray
    limits_rad: tuple[float, float]
    inclinations_rad: np.ndarray | None

    @property
    def highest_rad(self) -> float:
        return self.limits_rad[1] if self.inclinations_rad is None else self.inclinations_rad.max()

    def directions(self, rows: int, columns: int) -> np.ndarray:
        """Return unit vectors [rows, columns, 3] of a range image's beams, vehicle axes,
        float64.
        """
        low, high = self.limits_rad
        up = low + (np.arange(rows) + 0.5) / rows * (high - low)
        if self.inclinations_rad is not None:
            up = self.inclinations_rad
        up = up[::-1, None]
        turn = self.vehicle_from_laser[:3, :3]
        around = np.pi * (1 - (2 * np.arange(columns) + 1) / columns)
        around -= np.arctan2(turn[1, 0], turn[0, 0])
        flat = np.cos(up)
        height = np.broadcast_to(np.sin(up), (rows, columns))
        local = np.stack([flat * np.cos(around), flat * np.sin(around), height], axis=2)
        return local @ turn.T


class Shot(NamedTuple):
    """Time and vehicle pose of a camera's image of a frame, at the middle of its readout.

    Attributes:
        pose_ns: time of the pose that the dataset gives.
        readout_s: duration of the readout, 0 if it is not known.
        row: row of the image in camera_image.
        velocity: float64 [6], metres a second in world axes, radians a second in vehicle axes; 0
            where it is not known.
    """

    timestamp_ns: int
    world_from_vehicle: np.ndarray
    pose_ns: int
    readout_s: float
    row: int
    velocity: np.ndarray

    def world_from_vehicle_at(self, offset_s: float) -> np.ndarray:
        """Return the vehicle's pose at a time after the middle of the readout, float64 [4, 4]."""
        pose = self.world_from_vehicle.copy()
        pose[:3, 3] += self.velocity[:3] * offset_s
        turn = Rotation.from_rotvec(self.velocity[3:] * offset_s).as_matrix()
        pose[:3, :3] = pose[:3, :3] @ turn
        return pose


# ---- The segment ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Segment:
    """Calibration, poses and image times of one segment.

    Frames are numbered from 0 in order of time.

    Attributes:
        stamps_us: int64 [F], the frames' keys: when the TOP laser begins its turn.
        world_from_vehicle: float64 [F, 4, 4], at pose_times_ns.
        pose_times_ns: int64 [F], about the middle of that turn.
        cameras, lasers: by name.
        shots: by frame and camera.
        problems: one sentence each.
    """

    files: SegmentFiles
    stamps_us: np.ndarray
    world_from_vehicle: np.ndarray
    pose_times_ns: np.ndarray
    cameras: Mapping[str, Mount]
    lasers: Mapping[str, Laser]
    shots: Mapping[int, Mapping[str, Shot]]
    problems: tuple[str, ...]

    def frames_of(self, stamps_us: np.ndarray, path: Path) -> np.ndarray:
        """Return the frame numbers of a table's rows, int64."""
        frames = np.clip(np.searchsorted(self.stamps_us, stamps_us), 0, len(self.stamps_us) - 1)
        if (is_unknown := self.stamps_us[frames] != stamps_us).any():
            raise AdapterError(
                f"{path}: {is_unknown.sum()} rows are of frames without a row in vehicle_pose, "
                f"such as {stamps_us[is_unknown][0]}; {_ADVICE}"
            )
        return frames


def read_segment(files: SegmentFiles) -> Segment:
    """Read the poses, calibration and image times of a segment, from the components it has."""
    rows = Rows(files, "vehicle_pose", [STAMP, "world_from_vehicle.transform"])
    stamps = rows.stamps()
    poses = rows.poses("world_from_vehicle.transform")
    order = np.argsort(stamps, kind="stable")
    stamps = stamps[order]
    poses = poses[order]
    if not (np.abs(stamps.astype(np.float64)) <= _LATEST_S * 1e6).all():
        raise rows.fault(
            STAMP, f"must be Unix time in microseconds; got {stamps[0]} to {stamps[-1]}"
        )
    if (np.diff(stamps) <= 0).any():
        repeated_stamp = stamps[1:][np.diff(stamps) <= 0][0]
        raise rows.fault(STAMP, f"must name each frame once; {repeated_stamp} stands twice")
    cameras = _read_cameras(files) if files.has("camera_calibration") else {}
    lasers = _read_lasers(files) if files.has("lidar_calibration") else {}
    segment = Segment(files, stamps, poses, stamps * 1000 + _SPIN_NS // 2, cameras, lasers, {}, ())
    shots, problems = _read_shots(segment) if cameras and files.has("camera_image") else ({}, ())
    if missing := [name for name in REQUIRED if not files.has(name)]:
        sentence = (
            f"the segment lacks {', '.join(str(files.path(name)) for name in missing)}; a scene "
            f"needs the components {', '.join(REQUIRED)}, download them too"
        )
        problems = (sentence, *problems)
    times = [
        frame_shots["FRONT"].pose_ns
        if "FRONT" in (frame_shots := shots.get(n, {}))
        else int(pose_time_ns)
        for n, pose_time_ns in enumerate(segment.pose_times_ns)
    ]
    times_ns = np.array(times, np.int64)
    return replace(segment, pose_times_ns=times_ns, shots=shots, problems=problems)


def _read_cameras(files: SegmentFiles) -> dict[str, Mount]:
    numbers = [f"intrinsic.{n}" for n in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")]
    key = "key.camera_name"
    pose = "extrinsic.transform"
    direction = "rolling_shutter_direction"
    rows = Rows(files, "camera_calibration", [key, *numbers, pose, "width", "height", direction])
    read_outs = rows.read_outs(direction)
    vehicle_from_camera = rows.poses(pose) @ _CAMERA_FROM_OPENCV
    sizes = np.stack([rows.finite("width"), rows.finite("height")], axis=1)
    if not ((sizes >= 1) & (sizes <= MAX_SIDE_PX)).all():
        raise rows.fault("width", f"and height must be 1 to {MAX_SIDE_PX} pixels; got {sizes[0]}")
    values = np.stack([rows.finite(name) for name in numbers], axis=1)
    mounts = {}
    for i, number in enumerate(rows.enum(key, CAMERAS)):
        name = CAMERAS[number - 1]
        lens = Lens(*map(int, sizes[i]), *map(float, values[i]))
        try:
            if min(lens.f_u, lens.f_v) <= 0:
                raise ValueError("its focal length is not > 0")
            _ = lens.pinhole
        except ValueError as error:
            raise rows.fault("intrinsic.f_u", f"and the others: camera {name}, {error}") from None
        mounts[name] = Mount(lens, vehicle_from_camera[i], read_outs[i])
    return {name: mounts[name] for name in CAMERAS if name in mounts}


def _read_lasers(files: SegmentFiles) -> dict[str, Laser]:
    key = "key.laser_name"
    pose = "extrinsic.transform"
    low, high, values = (f"beam_inclination.{name}" for name in ("min", "max", "values"))
    rows = Rows(files, "lidar_calibration", [key, pose, low, high, values])
    poses = rows.poses(pose)
    lows = rows.finite(low)
    highs = rows.finite(high)
    inclinations = rows.lists(values)
    lasers = {}
    for i, number in enumerate(rows.enum(key, LASERS)):
        inclinations_rad = (
            inclinations[i] if inclinations[i] is not None and len(inclinations[i]) else None
        )
        name = LASERS[number - 1]
        lasers[name] = Laser(name, poses[i], (float(lows[i]), float(highs[i])), inclinations_rad)
    return {name: lasers[name] for name in LASERS if name in lasers}


def _read_shots(segment: Segment) -> tuple[dict[int, dict[str, Shot]], tuple[str, ...]]:
    """Return the shots by frame and camera, and a sentence for each problem.

    A shot's pose is that at the middle of its readout. The dataset's poses are up to some
    milliseconds off it, so each is carried on with the velocities: the position by the linear
    velocity (world axes), the rotation by the angular velocity (vehicle axes)."""
    key = "key.camera_name"
    pose = "pose.transform"
    time = "pose_timestamp"
    speeds = [
        f"velocity.{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz"
    ]
    names = ("camera_trigger_time", "camera_readout_done_time", "shutter")
    shutter = [f"rolling_shutter_params.{name}" for name in names]
    fields = [STAMP, key, pose, time, *speeds, *shutter]
    rows = Rows(segment.files, "camera_image", fields)
    frames = segment.frames_of(rows.stamps(), rows.path)
    poses = rows.poses(pose)
    pose_s = rows.finite(time, _LATEST_S)
    velocity = np.stack([rows.values(name, or_else=0) for name in speeds], axis=1)
    begun_s, done_s, open_s = (rows.values(name, or_else=0) for name in shutter)
    if np.abs(pose_s - segment.stamps_us[frames] * 1e-6).max(initial=0) > _NEAR_S:
        raise rows.fault(time, f"must be seconds of Unix time within {_NEAR_S} s of its frame's")
    with np.errstate(all="ignore"):
        offset_s = (begun_s + done_s) / 2 - pose_s
        has_motion = (np.abs(offset_s) < _NEAR_S) & np.isfinite(velocity).all(axis=1)
    offset_s[~has_motion] = 0
    middle_poses = poses.copy()
    middle_poses[has_motion, :3, 3] += (velocity[:, :3] * offset_s[:, None])[has_motion]
    turns = Rotation.from_rotvec((velocity[:, 3:] * offset_s[:, None])[has_motion]).as_matrix()
    middle_poses[has_motion, :3, :3] = poses[has_motion, :3, :3] @ turns
    pose_ns = np.round(pose_s * 1e9).astype(np.int64)
    times_ns = pose_ns + np.round(offset_s * 1e9).astype(np.int64)
    readout_s = np.where(has_motion, done_s - begun_s - open_s, 0)
    shots: dict[int, dict[str, Shot]] = {}
    for i, number in enumerate(rows.enum(key, CAMERAS)):
        name = CAMERAS[number - 1]
        frame = int(frames[i])
        if name not in segment.cameras:
            raise rows.fault(key, f"names camera {name}, which camera_calibration has not")
        shot = Shot(
            int(times_ns[i]),
            middle_poses[i],
            int(pose_ns[i]),
            float(readout_s[i]),
            int(rows.numbers[i]),
            np.where(has_motion[i], velocity[i], 0.0).astype(np.float64),
        )
        if name in shots.setdefault(frame, {}):
            raise rows.fault(key, f"has two images of {name} at {segment.stamps_us[frame]}")
        shots[frame][name] = shot
    problems = []
    if not has_motion.all():
        problems.append(
            f"{(~has_motion).sum()} images have no times of their shutter or no velocity; their "
            f"cameras stand where the car was at {time}"
        )
    return shots, tuple(problems)


# ---- Images --------------------------------------------------------------------------------------

_MAX_FAULTS = 3  # images with a sentence of their own


def extract_images(
    segment: Segment, numbers: Sequence[int], now: Collection[int], *, is_undistorted: bool = True
) -> tuple[dict[int, dict[str, str]], tuple[str, ...]]:
    """Return the paths of the frames' images by frame and camera, and the problems.

    The images lie in the user's cache (`adapters.scene_cache.image_folder`). Those of the frames in
    `now` are written at once, each other one when it is first read. A problem is a sentence about
    images that cannot be used.

    Args:
        segment: the segment.
        numbers: the frames.
        now: the frames whose images are written at once.
        is_undistorted: if True, images lose their distortion, and are checked; if False, the files
            have the bytes of the table, and nothing is checked.
    """
    if not segment.shots:
        return {n: {} for n in numbers}, ()
    files = [segment.files.path(name) for name in ("camera_image", "camera_calibration")]
    folder = image_folder(segment.files.name + ("" if is_undistorted else "-recorded"), files)
    shots = {
        f"{name}/{segment.stamps_us[n]}.jpg": (n, name, shot.row)
        for n, frame_shots in segment.shots.items()
        for name, shot in frame_shots.items()
    }
    packed = PackedImages(
        table=os.path.abspath(files[0]),
        column=f"[{COMPONENTS['camera_image']}].image",
        lenses={
            name: mount.lens if is_undistorted else mount.lens.without_distortion
            for name, mount in segment.cameras.items()
        },
        rows={file: row for file, (_, _, row) in shots.items()},
    )
    frames = set(numbers)
    requested = {file: shot for file, shot in shots.items() if shot[0] in frames}
    checked_names = list(requested) if is_undistorted else []
    faults = packed.write_folder(
        folder, checked_names, [f for f in checked_names if requested[f][0] in now]
    )
    sentences = [
        f"camera {name}, frame {n}: its image {faults[file]}; left out"
        for file, (n, name, _) in requested.items()
        if file in faults
    ]
    problems = sentences[:_MAX_FAULTS]
    if len(sentences) > _MAX_FAULTS:
        problems.append(f"{len(sentences) - _MAX_FAULTS} more images cannot be used")
    paths: dict[int, dict[str, str]] = {n: {} for n in numbers}
    for file, (n, name, _) in requested.items():
        if file not in faults:
            paths[n][name] = str(folder / file)
    for name in segment.cameras:
        if without := [n for n in numbers if name not in segment.shots.get(n, {})]:
            problems.append(f"camera {name}: no image of {describe_frames(without)}")
    ordered = {
        n: {name: frame_paths[name] for name in CAMERAS if name in frame_paths}
        for n, frame_paths in paths.items()
    }
    return ordered, tuple(problems)
