"""Scenes of segments of the Waymo Open Dataset v2: Gaussians from accumulated, coloured LiDAR.

World: the dataset's (metres, z up), less whole metres if the drive is further than a kilometre from
its origin. Ego: the dataset's vehicle (x forward, y left, z up, origin on the ground below the rear
axle). A frame's time is that of its vehicle pose, about the middle of the TOP laser's turn. Images
are undistorted. Each stands where the car was in the middle of its readout. Columns near its
borders were taken up to half of the readout earlier or later, and are off by the car's motion
meanwhile.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from pydantic import Field
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from adapters.raw_drive import (
    DriveOptions,
    RawDrive,
    Sweep,
    TimedBoxes,
    colour_every,
    describe_frames,
    drive_origin,
    find_objects,
    is_usable,
    recenter_pose,
    scene_of_drive,
    world_classes,
)
from adapters.uri import format_uri
from adapters.waymo.tables import (
    CAMERAS,
    COMPONENTS,
    LASERS,
    MAX_SIDE,
    STAMP,
    TOP,
    Mount,
    Rows,
    Segment,
    Shot,
    extract_images,
    find_segment,
    read_segment,
)
from augment.effects.lidar.codes import INDEX_COLUMN
from augment.errors import AdapterError
from augment.files.image_size import image_header
from augment.files.packed_images import (
    FILE_BYTES,
    NUMBER_LISTS,
    WHOLE_NUMBERS,
    ColumnKind,
    RowReader,
)
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.lenses import OpenCVLens
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from augment.scene.shutter import RollingShutter

_SPIN_NS = 100_000_000  # the TOP laser turns ten times a second
# The recording car in its own frame, a sedan or van of 4.7 to 5.2 m whose rear axle is 1.1 m from
# its end, with mirrors and roof.
EGO_M = np.array([[-1.15, -1.1, -0.5], [4.1, 1.1, 2.3]])
_MAX_FAULTS = 3  # sweeps with a sentence of their own
_MAX_RETURNS = 12_000_000  # that a scene is built from; each takes 50 bytes on the way
_MAX_READOUT_S = 0.2  # a longer readout is a mix-up of units
_THREADS = 4  # NumPy releases the interpreter

# ---- Range images --------------------------------------------------------------------------------
# A laser's range image holds range (metres, none where it is not > 0), intensity, elongation, and
# 1 where a return is in a zone without labels. A second image has the second return of each beam.

_ROWS_AT_ONCE = 5  # a frame's five lasers: 21 MB
_MAX_DIVISOR = 65_535  # labels have 16 bits
_Columns = tuple[tuple[str, ColumnKind], ...]


class Returns(NamedTuple):
    """All returns of a frame.

    Attributes:
        points_m: float64 [N, 3], places of the returns in the dataset's world.
        origins_m: float64 [N, 3], places of their lasers then.
        timestamps_ns: int64 [N].
        intensity, elongation: float32 [N], as recorded.
        sensor: uint8 [N], 1 TOP, 2 FRONT, 3 SIDE_LEFT, 4 SIDE_RIGHT, 5 REAR.
        number: uint8 [N], 1 or 2, first or second return of its beam.
        in_no_label_zone: bool [N].
        classes, objects: int32 [N], the dataset's numbers, 0 for lasers except TOP. None if the
            frame has no LiDAR segmentation.
        camera_classes: uint8 [N], number of the camera segmentation at the pixel to which the
            dataset projects a return, 0 if no camera sees it. None if the frame has none.
    """

    points_m: np.ndarray
    origins_m: np.ndarray
    timestamps_ns: np.ndarray
    intensity: np.ndarray
    elongation: np.ndarray
    sensor: np.ndarray
    number: np.ndarray
    in_no_label_zone: np.ndarray
    classes: np.ndarray | None
    objects: np.ndarray | None
    camera_classes: np.ndarray | None


def frame_returns(segment: Segment, frame: int) -> Returns | None:
    """Return all returns of a frame; None where the table has no row of the frame.

    Lasers come in the order of their numbers, and each laser's first returns before its second."""
    scans = _read_scans(segment, frame)
    return None if scans is None else scans.returns()


class _Scans(NamedTuple):
    """Range images, poses and labels of one frame, as in the tables.

    Attributes:
        images: range images of both returns, by laser.
        poses: the car's pose at each pixel of the TOP laser's image.
        labels: objects and classes of the LiDAR segmentation, as `images`.
        projections: the camera pixels that see each return, as `images`.
        pictures: classes [h, w] by camera.
    """

    segment: Segment
    frame: int
    images: Mapping[int, tuple[np.ndarray | None, ...]]
    poses: np.ndarray | None
    labels: Mapping[int, tuple[np.ndarray | None, ...]]
    projections: Mapping[int, tuple[np.ndarray | None, ...]]
    pictures: Mapping[int, np.ndarray]

    def returns(self, stride: int = 1) -> Returns | None:
        """Return the frame's returns; None where its range images hold none.

        stride: takes one return in so many; the next frame starts at the next return."""
        no_images = (None, None)
        parts = []
        for laser, images in sorted(self.images.items()):
            beams = _Beams(self.segment, self.frame, laser, self.poses if laser == TOP else None)
            labels = self.labels.get(laser, no_images)
            projections = self.projections.get(laser, no_images)
            images_by_return = zip(images, labels, projections, strict=True)
            for number, (image, classes, pixels) in enumerate(images_by_return, start=1):
                if image is not None:
                    parts.append(
                        beams.returns(image, number, classes, pixels, self.pictures, stride)
                    )
        if not parts:
            return None
        returns = Returns(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        if not self.labels:
            returns = returns._replace(classes=None, objects=None)
        return returns if self.projections else returns._replace(camera_classes=None)


def _read_scans(segment: Segment, frame: int) -> _Scans | None:
    images = _range_images(segment, "lidar", frame, 4)
    if not images:
        return None
    (poses,) = _range_images(segment, "lidar_pose", frame, 6, returns=(1,)).get(TOP, (None,))
    labels = _range_images(segment, "lidar_segmentation", frame, 2)
    pictures = _label_images(segment, frame)
    projections = _range_images(segment, "lidar_camera_projection", frame, 6) if pictures else {}
    return _Scans(segment, frame, images, poses, labels, projections, pictures)


class _Beams(NamedTuple):
    """The beams of one laser in one frame.

    poses: [H, W, 6], the car's pose at each pixel of the TOP laser's image.
    """

    segment: Segment
    frame: int
    laser: int
    poses: np.ndarray | None

    def returns(
        self,
        image: np.ndarray,
        number: int,
        labels: np.ndarray | None,
        pixels: np.ndarray | None,
        pictures: Mapping[int, np.ndarray],
        stride: int,
    ) -> Returns:
        """Return the returns of a range image.

        image: [H, W, 4]. number: 1 or 2, which return of its beam. labels: [H, W, 2], objects and
        classes. pixels: [H, W, 6], camera, x and y of two cameras that see the return. pictures:
        classes [h, w] by camera. stride: takes one return in so many."""
        segment = self.segment
        rows, columns = image.shape[:2]
        name = LASERS[self.laser - 1]
        where = f"{segment.files.path('lidar')}: frame {segment.stamps_us[self.frame]}, {name}"
        laser = segment.lasers.get(name)
        if laser is None:
            raise AdapterError(f"{where}: lidar_calibration has no such laser")
        if laser.inclinations_rad is not None and len(laser.inclinations_rad) != rows:
            raise AdapterError(
                f"{where}: its range image has {rows} rows, its calibration "
                f"{len(laser.inclinations_rad)} inclinations. Copy both again"
            )
        for component, label_image in (
            ("lidar_segmentation", labels),
            ("lidar_camera_projection", pixels),
        ):
            if label_image is not None and label_image.shape[:2] != (rows, columns):
                raise AdapterError(
                    f"{where}: {component} must be of {rows} x {columns} pixels; it is of "
                    f"{list(label_image.shape[:2])}. Copy it again"
                )
        directions = _directions(laser, rows, columns)
        with np.errstate(invalid="ignore"):
            pixel_ids = np.flatnonzero((image[..., 0] > 0) & np.isfinite(image[..., 0]))
        pixel_ids = pixel_ids[self.frame % stride :: stride]
        values = image.reshape(-1, 4)[pixel_ids]
        mount = laser.vehicle_from_laser[:3, 3]
        offsets = values[:, :1].astype(np.float64) * directions.reshape(-1, 3)[pixel_ids]
        pose = segment.world_from_vehicle[self.frame]
        times = np.full(len(pixel_ids), segment.pose_times_ns[self.frame])
        if self.laser != TOP:
            # Moved by the dataset to where the car was at the vehicle pose's time.
            points = (offsets + mount) @ pose[:3, :3].T + pose[:3, 3]
            origins = np.broadcast_to(pose[:3, :3] @ mount + pose[:3, 3], points.shape)
        else:
            if self.poses is None or self.poses.shape[:2] != (rows, columns):
                size = "none" if self.poses is None else list(self.poses.shape[:2])
                raise AdapterError(
                    f"{where}: lidar_pose must have a pose for each of {rows} x {columns} "
                    f"pixels; it has {size}. Copy it again"
                )
            turns, places = _car_at(self.poses.reshape(-1, 6)[pixel_ids])
            points = np.einsum("nij,nj->ni", turns, offsets + mount) + places
            origins = turns @ mount + places
            share = (pixel_ids % columns + 0.5) / columns
            times = segment.stamps_us[self.frame] * 1000 + np.round(share * _SPIN_NS).astype(int)
        no_labels = np.zeros((len(pixel_ids), 2), np.int32)
        objects, classes = (no_labels if labels is None else labels.reshape(-1, 2)[pixel_ids]).T
        return Returns(
            points,
            origins,
            times,
            values[:, 1],
            values[:, 2],
            np.full(len(pixel_ids), self.laser, np.uint8),
            np.full(len(pixel_ids), number, np.uint8),
            values[:, 3] > 0,
            classes,
            objects,
            _classes_in_images(pixels.reshape(-1, 6)[pixel_ids], pictures)
            if pixels is not None
            else np.zeros(len(pixel_ids), np.uint8),
        )


def _classes_in_images(pixels: np.ndarray, pictures: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return the camera segmentation's class of each return, uint8 [N], 0 where there is none.

    pixels: [N, 6], camera, x and y of two cameras; the first of them that has a class counts.
    pictures: classes [h, w] by camera."""
    classes = np.zeros(len(pixels), np.uint8)
    places = np.nan_to_num(pixels).clip(0, MAX_SIDE).astype(np.int64)
    for camera, x, y in (places[:, :3].T, places[:, 3:].T):
        for number, picture in pictures.items():
            mask = (camera == number) & (classes == 0)
            mask &= (x < picture.shape[1]) & (y < picture.shape[0])
            classes[mask] = picture[y[mask], x[mask]]
    return classes


@lru_cache(maxsize=8)
def _directions(laser: Any, rows: int, columns: int) -> np.ndarray:
    return laser.directions(rows, columns)


def _car_at(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations [N, 3, 3] and positions [N, 3] of world_from_vehicle, float64.

    poses: [N, 6], rows of roll, pitch, yaw, x, y, z. R = Rz(yaw) Ry(pitch) Rx(roll)."""
    values = poses.astype(np.float64)
    cr, cp, cy = np.cos(values[:, :3].T)
    sr, sp, sy = np.sin(values[:, :3].T)
    turns = np.empty((len(values), 3, 3))
    turns[:, 0] = np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], axis=1)
    turns[:, 1] = np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], axis=1)
    turns[:, 2] = np.stack([-sp, cp * sr, cp * cr], axis=1)
    return turns, values[:, 3:]


def _range_images(
    segment: Segment, component: str, frame: int, channels: int, returns: tuple[int, ...] = (1, 2)
) -> dict[int, tuple[np.ndarray | None, ...]]:
    """Return the range images of a frame by laser, one for each return, None for null.

    Each is [H, W, channels] and shares the table's memory. The result is empty without the
    component or a row of the frame."""
    if not segment.files.has(component):
        return {}
    rows_by_laser = _index(segment, component, "key.laser_name", LASERS).get(frame, {})
    names = [f"[{COMPONENTS[component]}].range_image_return{n}" for n in returns]
    columns = tuple(
        (f"{name}.{part}", NUMBER_LISTS) for name in names for part in ("values", "shape")
    )
    cells = _reader(segment, component, columns).read(list(rows_by_laser.values()))
    where = f"{segment.files.path(component)}: frame {segment.stamps_us[frame]}"
    return {
        laser: tuple(_range_image(cells[row], name, channels, where) for name in names)
        for laser, row in rows_by_laser.items()
    }


def _range_image(cells: dict[str, Any], name: str, channels: int, where: str) -> np.ndarray | None:
    values = cells[f"{name}.values"].values
    shape = cells[f"{name}.shape"].as_py()
    if values is None or shape is None:
        return None
    is_size = len(shape) == 3 and all(isinstance(n, int) and 1 <= n <= MAX_SIDE for n in shape)
    is_whole = is_size and shape[2] == channels and len(values) == np.prod(shape)
    if not is_whole or values.null_count:
        raise AdapterError(
            f"{where}: {name} must have height x width x {channels} numbers, none of them null, "
            f"and sides up to {MAX_SIDE}; got shape {shape} and {len(values)} of {values.type}. "
            f"Copy it again"
        )
    return values.to_numpy(zero_copy_only=False).reshape(shape)


def _label_images(segment: Segment, frame: int) -> dict[int, np.ndarray]:
    """Return the classes of the recorded images' pixels, uint8 [H, W], by the camera's number."""
    component = "camera_segmentation"
    if not (segment.files.has(component) and segment.files.has("lidar_camera_projection")):
        return {}
    rows_by_camera = _index(segment, component, "key.camera_name", CAMERAS).get(frame, {})
    image, divisor = (
        f"[{COMPONENTS[component]}].{name}" for name in ("panoptic_label", "panoptic_label_divisor")
    )
    columns = ((image, FILE_BYTES), (divisor, WHOLE_NUMBERS))
    cells = _reader(segment, component, columns).read(list(rows_by_camera.values()))
    classes_by_camera = {}
    for number, row in rows_by_camera.items():
        name = CAMERAS[number - 1]
        path = segment.files.path(component)
        lens = segment.cameras[name].lens if name in segment.cameras else None
        data = cells[row][image].as_py()
        step = cells[row][divisor].as_py()
        header = image_header(data) if isinstance(data, bytes) else None
        size = None if header is None else (header.width, header.height)
        panoptic = None
        if header and lens and header.format == "PNG" and size == (lens.width, lens.height):
            panoptic = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        is_divisor = isinstance(step, int) and 1 <= step <= _MAX_DIVISOR
        if panoptic is None or panoptic.ndim != 2 or not is_divisor:
            raise AdapterError(
                f"{path}: frame {segment.stamps_us[frame]}, camera {name}: panoptic_label must be "
                f"a grey PNG of the camera's size with a divisor of 1 to {_MAX_DIVISOR}; got size "
                f"{size}, divisor {step}. Copy it again"
            )
        classes_by_camera[number] = (
            (panoptic.astype(np.int64) // step).clip(0, 255).astype(np.uint8)
        )
    return classes_by_camera


def _reader(segment: Segment, component: str, columns: _Columns) -> RowReader:
    # Another process must not go on with this one's files.
    return _reader_of(segment, component, columns, os.getpid())


@lru_cache(maxsize=8)
def _reader_of(segment: Segment, component: str, columns: _Columns, _pid: int) -> RowReader:
    return RowReader(segment.files.path(component), dict(columns), _ROWS_AT_ONCE)


@lru_cache(maxsize=8)
def _index(
    segment: Segment, component: str, key: str, words: tuple[str, ...]
) -> dict[int, dict[int, int]]:
    """Return row numbers by frame and by laser or camera."""
    rows = Rows(segment.files, component, [STAMP, key])
    frames = segment.frames_of(rows.stamps(), rows.path)
    rows_by_frame: dict[int, dict[int, int]] = {}
    for frame, number, row in zip(frames, rows.enum(key, words), rows.numbers, strict=True):
        frame_rows = rows_by_frame.setdefault(int(frame), {})
        if frame_rows.setdefault(int(number), int(row)) != row:
            raise rows.fault(key, f"has two rows of {words[number - 1]} in one frame")
    return rows_by_frame


# ---- Labels --------------------------------------------------------------------------------------

_TYPES = ("Vehicle", "Pedestrian", "Sign", "Cyclist")  # numbered from 1; 0 is unknown
_S = SemanticClass
# lidar_segmentation's classes as published, from 0.
_CLASSES = dict(
    enumerate(
        (
            _S.UNKNOWN, _S.VEHICLE, _S.VEHICLE, _S.VEHICLE, _S.VEHICLE, _S.TWO_WHEELER,
            _S.TWO_WHEELER, _S.PEDESTRIAN, _S.SIGN, _S.SIGN, _S.POLE, _S.OTHER, _S.TWO_WHEELER,
            _S.TWO_WHEELER, _S.BUILDING, _S.VEGETATION, _S.VEGETATION, _S.SIDEWALK, _S.ROAD,
            _S.LANE_MARKING, _S.TERRAIN, _S.TERRAIN, _S.SIDEWALK,
        )
    )
)  # fmt: skip
# camera_segmentation's from 0; a return is not the recording car (1), nor sky (25).
_CAMERA_CLASSES = dict(
    enumerate(
        (
            _S.UNKNOWN, _S.UNKNOWN, _S.VEHICLE, _S.VEHICLE, _S.VEHICLE, _S.VEHICLE, _S.TWO_WHEELER,
            _S.TWO_WHEELER, _S.VEHICLE, _S.PEDESTRIAN, _S.TWO_WHEELER, _S.TWO_WHEELER, _S.OTHER,
            _S.OTHER, _S.OTHER, _S.POLE, _S.OTHER, _S.SIGN, _S.SIGN, _S.BUILDING, _S.ROAD,
            _S.LANE_MARKING, _S.LANE_MARKING, _S.SIDEWALK, _S.VEGETATION, _S.UNKNOWN, _S.TERRAIN,
            _S.OTHER, _S.OTHER,
        )
    )
)  # fmt: skip


def _semantic(
    classes: np.ndarray | None, camera_classes: np.ndarray | None, count: int
) -> np.ndarray:
    """Return the SemanticClass of each return, int16 [count].

    The LiDAR's segmentation decides; where it has no class, the cameras' segmentation does."""
    lidar_semantic = (
        np.zeros(count, np.int16) if classes is None else world_classes(classes, _CLASSES)
    )
    if camera_classes is None:
        return lidar_semantic
    camera_semantic = world_classes(camera_classes, _CAMERA_CLASSES)
    return np.where(lidar_semantic == SemanticClass.UNKNOWN, camera_semantic, lidar_semantic)


_BOX = (*(f"box.{n}.{axis}" for n in ("center", "size") for axis in "xyz"), "box.heading")
# What becomes an attribute of that name, and what stands for null.
_ATTRIBUTES = {
    "num_lidar_points_in_box": 0,
    "num_top_lidar_points_in_box": 0,
    **{f"{name}.{axis}": np.nan for name in ("speed", "acceleration") for axis in "xyz"},
    **{f"difficulty_level.{name}": 0 for name in ("detection", "tracking")},
}


@dataclass(frozen=True, eq=False)
class WaymoLabels:
    """Labels of one segment, read on demand.

    Boxes: track_ids are laser_object_ids, labels Vehicle, Pedestrian, Sign, Cyclist or Unknown.
    Attributes, as far as the table has them: num_lidar_points_in_box, num_top_lidar_points_in_box,
    speed_{x,y,z} and acceleration_{x,y,z} (SI, world axes), difficulty_level_{detection,tracking}.

    Sweeps: columns x y z (metres, float64, the dataset's world), intensity (the hyperbolic tangent
    of the recorded value, which has no upper limit), raw_intensity, elongation, sensor,
    return_number and in_no_label_zone (see Returns), and timestamp_ns. The time is derived from the
    column for the TOP laser, since the dataset does not state it, and is that of the vehicle pose
    for the others. If the frame has LiDAR segmentation, there are semantic and instance (0 for
    lasers except TOP); if it has camera segmentation and lidar_camera_projection, there is
    camera_class. All returns are among them, also those of the recording car.
    """

    segment: Segment

    @property
    def max_lidar_elevation_rad(self) -> float:
        """Return the highest elevation of the TOP laser.

        The others look 30 degrees up, but 20 m far.
        """
        top = self.segment.lasers.get("TOP")
        return 0.0 if top is None else float(top.highest_rad)

    def boxes(self, frame_index: int) -> Boxes:
        return _all_boxes(self.segment).get(frame_index, Boxes.empty())

    def lidar(self, frame_index: int) -> LidarSweep | None:
        returns = _last_returns(self.segment, frame_index)
        if returns is None:
            return None
        columns = {name: returns.points_m[:, i] for i, name in enumerate("xyz")}
        columns |= {
            "intensity": np.tanh(np.maximum(returns.intensity, 0)),
            "raw_intensity": returns.intensity,
            "elongation": returns.elongation,
            "sensor": returns.sensor,
            "return_number": returns.number,
            "in_no_label_zone": returns.in_no_label_zone,
            "timestamp_ns": returns.timestamps_ns,
        }
        if returns.classes is not None and returns.objects is not None:
            columns |= {"semantic": returns.classes, "instance": returns.objects}
        if returns.camera_classes is not None:
            columns["camera_class"] = returns.camera_classes
        return LidarSweep({name: np.array(column) for name, column in columns.items()})

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        classes = sweep.columns.get("semantic")
        camera_classes = sweep.columns.get("camera_class")
        if classes is None and camera_classes is None:
            return None
        return _semantic(classes, camera_classes, len(sweep))

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Return the laser's position of each return, float64 [N, 3], the dataset's world.

        The TOP laser's is that at the time of each beam, by the dataset's pose of each pixel. The
        other lasers' is that at the time of the vehicle pose, to which the dataset moved their
        returns."""
        returns = _last_returns(self.segment, frame_index)
        if returns is None:
            return None
        rows = sweep.columns.get(INDEX_COLUMN)
        return returns.origins_m.copy() if rows is None else returns.origins_m[rows]


@lru_cache(maxsize=2)
def _last_returns(segment: Segment, frame: int) -> Returns | None:
    return frame_returns(segment, frame) if 0 <= frame < len(segment.stamps_us) else None


@lru_cache(maxsize=2)
def _all_boxes(segment: Segment) -> dict[int, Boxes]:
    """Return the boxes by frame, in the dataset's world."""
    if not segment.files.has("lidar_box"):
        return {}
    key = "key.laser_object_id"
    rows = Rows(segment.files, "lidar_box", [STAMP, key, *_BOX, "type", *_ATTRIBUTES])
    names = np.array(rows.texts(key), object)
    types = rows.box_types("type", _TYPES)
    values = np.stack([rows.values(name, or_else=np.nan) for name in _BOX], axis=1)
    attributes = {
        name.replace(".", "_"): rows.values(name, or_else=null)
        for name, null in _ATTRIBUTES.items()
        if rows.has(name)
    }
    frames = segment.frames_of(rows.stamps(), rows.path)
    order = np.lexsort((names.astype(str), frames))  # rows have no order of their own
    starts = np.flatnonzero(np.diff(frames[order], prepend=-1))
    boxes_by_frame = {}
    for box_rows in np.split(order, starts[1:]):
        pose = segment.world_from_vehicle[frames[box_rows[0]]]
        heading = Rotation.from_rotvec(np.nan_to_num(values[box_rows, 6:]) * [0, 0, 1])
        quats = (Rotation.from_matrix(pose[:3, :3]) * heading).as_quat()[:, [3, 0, 1, 2]]
        quats[~np.isfinite(values[box_rows, 6])] = np.nan
        boxes_by_frame[int(frames[box_rows[0]])] = Boxes(
            tuple(names[box_rows]),
            tuple(types[i] for i in box_rows),
            values[box_rows, :3] @ pose[:3, :3].T + pose[:3, 3],
            values[box_rows, 3:6].astype(np.float64),
            quats,
            {name: column[box_rows] for name, column in attributes.items()},
        )
    return boxes_by_frame


def moving_boxes(
    segment: Segment, numbers: Sequence[int], origin: np.ndarray
) -> tuple[tuple[Any, ...], tuple[str, ...]]:
    """Return the boxes of moving objects in the frames, and a sentence for each fault.

    The dataset does not state the time of a box. It is taken to be the time at which the TOP
    laser's turn passed the box."""
    timed = []
    for n in numbers:
        boxes = _all_boxes(segment).get(n, Boxes.empty())
        pose = segment.world_from_vehicle[n]
        local = (boxes.centers_m - pose[:3, 3]) @ pose[:3, :3]
        share = (np.pi - np.arctan2(local[:, 1], local[:, 0])) / (2 * np.pi)
        times = segment.stamps_us[n] * 1000 + np.nan_to_num(share * _SPIN_NS).astype(np.int64)
        timed.append(TimedBoxes(n, boxes, times))
    objects = find_objects(timed, origin)
    return objects.moving_boxes, objects.problems


# ---- The scene -----------------------------------------------------------------------------------


class WaymoOptions(DriveOptions):
    """Options of a Waymo scene. segment: its name, or the first part of it."""

    segment: str | None = Field(
        None, min_length=1, description="a segment's name, or its number before the first '_'"
    )


def open_waymo(path: str, query: dict[str, str]) -> Scene:
    """Open one segment of the Waymo Open Dataset v2.

    Opening is deterministic: the same files and options give the same bits.

    Args:
        path: a folder with its components' folders (that of a split or the one above), or one with
            a segment's files (vehicle_pose.parquet and so on).
        query: segment, needed if there are several; frames, voxel_m, max_gaussians, image_scale,
            sky_size, held_out, see DriveOptions.

    Raises:
        AdapterError: an option is wrong, a component is missing, a table is damaged or contradicts
            another, there is no LiDAR or no image. Single images and sweeps that are missing or
            damaged are listed in Scene.problems.
    """
    options = WaymoOptions.from_query("waymo", query)
    return scene_of_drive(read_waymo(path, query, options), options)


def read_waymo(path: str, query: dict[str, str], options: WaymoOptions) -> RawDrive:
    """Read the frames of the segment that the options select, with their sweeps and boxes."""
    segment = read_segment(find_segment(Path(path), options.segment))
    where = f"waymo:{path}, segment {segment.files.name}"
    chosen = options.select(range(len(segment.stamps_us)), where=where)
    origin = drive_origin(segment.world_from_vehicle[:, :3, 3])
    step = colour_every(sum(len(segment.shots.get(n, {})) for n in chosen.used))
    with ThreadPoolExecutor(1) as pool:  # both are decoders' work, without the interpreter
        coloured = set(chosen.used[::step])
        images = pool.submit(extract_images, segment, chosen.numbers, coloured)
        recorded_paths = None
        if options.has_recorded_lens:
            recorded_paths, _ = extract_images(segment, chosen.numbers, (), is_undistorted=False)
        sweeps, sweep_problems = read_sweeps(segment, chosen.used, origin)
        paths, image_problems = images.result()
    frames = tuple(_frame(segment, n, origin, paths[n]) for n in chosen.numbers)
    recorded_frames = None
    if recorded_paths is not None:
        usable_paths = {
            n: {name: recorded_paths[n][name] for name in frame_paths}
            for n, frame_paths in paths.items()
        }
        recorded_frames = tuple(
            _frame(segment, n, origin, usable_paths[n], has_lens=True) for n in chosen.numbers
        )
    boxes, box_problems = moving_boxes(segment, chosen.numbers, origin)
    labels = WaymoLabels(segment)
    return RawDrive(
        name=segment.files.name,
        source=format_uri("waymo", path, query),
        frames=frames,
        held_out=chosen.held_out,
        sweeps=sweeps,
        boxes=boxes,
        labels=labels,
        world_origin_m=origin,
        lidar_top_deg=float(np.degrees(labels.max_lidar_elevation_rad)),
        problems=(
            *segment.problems,
            *chosen.problems,
            *image_problems,
            *sweep_problems,
            *box_problems,
            *_notes(segment, chosen.numbers, has_recorded_lens=options.has_recorded_lens),
        ),
        colour_every=step,
        recorded_frames=recorded_frames,
    )


def waymo_labels(path: str, query: dict[str, str]) -> WaymoLabels:
    """Return the labels of a segment. They cover all its frames, whatever frames= says."""
    options = WaymoOptions.from_query("waymo", query)
    return WaymoLabels(read_segment(find_segment(Path(path), options.segment)))


def waymo_files(path: Path | str, query: dict[str, str]) -> list[Path]:
    """Return the paths of all files that a segment may have; they need not exist."""
    files = find_segment(Path(path), query.get("segment"))
    return [files.path(component) for component in COMPONENTS]


def _notes(segment: Segment, numbers: Sequence[int], *, has_recorded_lens: bool) -> list[str]:
    """Return sentences on boxes, lenses and read-outs."""
    notes = []
    if not segment.files.has("lidar_box"):
        path = segment.files.path("lidar_box")
        notes.append(f"{path} does not exist: no boxes are known, what moves leaves a trace")
    shots = [shot for n in numbers for shot in segment.shots.get(n, {}).values()]
    longest_s = max((shot.readout_s for shot in shots), default=0.0)
    distorted = [name for name, mount in segment.cameras.items() if not mount.lens.is_pinhole]
    if distorted and not has_recorded_lens:
        notes.append(
            f"images of {', '.join(distorted)} are without their lens distortion, in copies that "
            f"cameras and weather go with; lens=recorded keeps lens and read-out"
        )
    if has_recorded_lens:
        unknown = [name for name, mount in segment.cameras.items() if mount.read_out is None]
        notes += [
            f"camera_calibration states no rolling shutter of {name}: all of its columns show the "
            f"middle of the readout"
            for name in unknown
        ]
    if len(numbers) > 1 and longest_s and not has_recorded_lens:
        steps_m = np.linalg.norm(np.diff(segment.world_from_vehicle[:, :3, 3], axis=0), axis=1)
        speeds = steps_m / (np.diff(segment.pose_times_ns) * 1e-9)
        half_m = float(speeds.max()) * longest_s / 2
        notes.append(
            f"images are read out in {longest_s * 1e3:.0f} ms and stand where the car was halfway: "
            f"what their borders show is off by up to {half_m:.2f} m of driving"
        )
    return notes


def _frame(
    segment: Segment, n: int, origin: np.ndarray, paths: dict[str, str], *, has_lens: bool = False
) -> Frame:
    """Return a frame.

    Args:
        segment: the segment.
        n: the frame's number.
        origin: subtracted from the dataset's coordinates, float64 [3].
        paths: the frame's images by camera.
        has_lens: if True, cameras have their lens and rolling shutter; if False, they are the
            pinholes of undistorted images.
    """
    cameras = {}
    for name, mount in segment.cameras.items():
        shot = segment.shots.get(n, {}).get(name)
        if shot is None:
            continue
        pose = recenter_pose(shot.world_from_vehicle @ mount.vehicle_from_camera, origin)
        cameras[name] = Camera(
            name,
            mount.lens.width,
            mount.lens.height,
            *(mount.lens.intrinsics if has_lens else mount.lens.pinhole),
            camera_from_world=invert_rigid(pose),
            timestamp_ns=shot.timestamp_ns,
            lens=OpenCVLens.from_coefficients(mount.lens.coefficients)
            if has_lens and not mount.lens.is_pinhole
            else None,
            shutter=_shutter(mount, shot) if has_lens else None,
        )
    return Frame(
        index=n,
        timestamp_ns=int(segment.pose_times_ns[n]),
        world_from_ego=recenter_pose(segment.world_from_vehicle[n], origin),
        cameras=cameras,
        image_paths=paths,
    )


def _shutter(mount: Mount, shot: Shot) -> RollingShutter | None:
    """Return the rolling shutter of an image; None for a global or an unknown one.

    A column at the share s of the image's width is exposed around trigger + shutter / 2 + s T, with
    T from the first to the last column: T / 2 before and after the middle of the readout.
    """
    if mount.read_out is None or not 0 < shot.readout_s <= _MAX_READOUT_S:
        return None
    starts_and_ends = [
        invert_rigid(
            torch.from_numpy(shot.world_from_vehicle_at(offset_s) @ mount.vehicle_from_camera)
        )
        for offset_s in (-shot.readout_s / 2, shot.readout_s / 2)
    ]
    middle = torch.from_numpy(shot.world_from_vehicle @ mount.vehicle_from_camera)
    return RollingShutter.between(
        *starts_and_ends,
        read_out=mount.read_out,
        duration_ns=round(shot.readout_s * 1e9),
        camera_from_world=invert_rigid(middle),
    )


def read_sweeps(
    segment: Segment, numbers: Sequence[int], origin: np.ndarray
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """Return the usable returns of the frames in the scene's world, and a sentence for each fault.

    Long drives are thinned: every second return is taken, or every third, and so on, so that there
    are at most _MAX_RETURNS."""
    sweeps: dict[int, Sweep] = {}
    missing: list[int] = []
    faults: dict[int, AdapterError] = {}
    step = 0  # of the returns that are taken, 0 until the first sweep is read
    has_returns = segment.files.has("lidar")
    rows = _index(segment, "lidar", "key.laser_name", LASERS) if has_returns else {}
    in_file = sorted(numbers, key=lambda n: min(rows.get(n, {0: 0}).values()))
    waiting: deque[tuple[int, Future[Sweep | None]]] = deque()

    def finish(n: int, future: Future[Sweep | None]) -> None:
        try:
            sweep = future.result()
        except AdapterError as error:
            faults[n] = error
        else:
            missing.extend([n] if sweep is None else [])
            sweeps.update({} if sweep is None else {n: sweep})

    with ThreadPoolExecutor(_THREADS) as pool:
        for n in tqdm(in_file, desc="LiDAR", unit="sweep", disable=None):
            try:  # read in the file's order; the threads only convert what was read
                scans = _read_scans(segment, n)
                first = None if scans is None or step else scans.returns()
                if first is not None:  # as if all frames had as many as the first
                    step = max(1, -(-len(first.points_m) * len(numbers) // _MAX_RETURNS))
            except AdapterError as error:
                faults[n] = error
                continue
            if scans is None:
                missing.append(n)
                continue
            waiting.append((n, pool.submit(_usable_sweep, scans, step or 1, origin)))
            if len(waiting) > _THREADS:
                finish(*waiting.popleft())
        while waiting:
            finish(*waiting.popleft())
    problems = [
        f"frame {n}: its LiDAR returns are left out: {faults[n]}" for n in in_file if n in faults
    ]
    if len(problems) > _MAX_FAULTS:
        problems[_MAX_FAULTS:] = [f"so are those of {len(problems) - _MAX_FAULTS} more frames"]
    if missing:
        problems.append(f"the LiDAR has no row of {describe_frames(sorted(missing))}")
    if step > 1:
        problems.append(
            f"the scene is built from one return in {step}, of {len(numbers)} frames; fewer "
            f"(frames=) use all"
        )
    return tuple(sweeps[n] for n in sorted(sweeps)), tuple(problems)


def _usable_sweep(scans: _Scans, stride: int, origin: np.ndarray) -> Sweep | None:
    returns = scans.returns(stride)
    if returns is None:
        return None
    points = returns.points_m
    semantic = _semantic(returns.classes, returns.camera_classes, len(points))
    sweep = Sweep(
        (points - origin).astype(np.float32),
        returns.timestamps_ns,
        semantic,
        (returns.origins_m - origin).astype(np.float32),
    )
    pose = scans.segment.world_from_vehicle[scans.frame]
    return sweep.select(is_usable(sweep, points, pose, EGO_M))
