"""A segment of the Waymo Open Dataset v2 as a scene: Gaussians from accumulated, coloured LiDAR.

World: the dataset's (metres, z up), less whole metres where the drive is further than a kilometre
from its origin. Ego: the dataset's vehicle (x forward, y left, z up, origin on the ground below
the rear axle). A frame's time is that of its vehicle pose, about the middle of the TOP laser's
turn. Images are undistorted; each stands where the car was in the middle of its readout, so that
columns near its borders, which were taken up to half of the readout earlier or later, are off by
what the car drove meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from adapters.raw_drive import (
    DriveOptions,
    RawDrive,
    Sweep,
    TimedBoxes,
    drive_origin,
    find_objects,
    is_usable,
    recentred,
    scene_of_drive,
    some,
    world_classes,
)
from adapters.uri import format_uri
from adapters.waymo.tables import (
    COMPONENTS,
    LASERS,
    MAX_SIDE,
    STAMP,
    TOP,
    RowReader,
    Rows,
    Segment,
    extract_images,
    find_segment,
    read_segment,
)
from augment.cameras import Camera, Frame
from augment.effects.lidar.codes import INDEX_COLUMN
from augment.errors import AdapterError
from augment.geometry import invert_rigid
from augment.labels import Boxes, LidarSweep
from augment.scene import Scene
from augment.semantics import SemanticClass

_SPIN_NS = 100_000_000  # the TOP laser turns ten times a second
# The recording car in its own frame, a sedan or van of 4.7 to 5.2 m whose rear axle is 1.1 m from
# its end, with mirrors and roof.
EGO_M = np.array([[-1.15, -1.1, -0.5], [4.1, 1.1, 2.3]])
_MAX_FAULTS = 3  # sweeps with a sentence of their own
_MAX_RETURNS = 12_000_000  # that a scene is built from; each takes 50 bytes on the way

# ---- Range images --------------------------------------------------------------------------------
# A laser's range image holds range (metres, none where it is not > 0), intensity, elongation, and
# 1 where a return is in a zone without labels. A second image has the second return of each beam.

_IMAGES = tuple(f"[{COMPONENTS['lidar']}].range_image_return{n}" for n in (1, 2))
_POSE_IMAGE = f"[{COMPONENTS['lidar_pose']}].range_image_return1"
_CLASS_IMAGES = tuple(f"[{COMPONENTS['lidar_segmentation']}].range_image_return{n}" for n in (1, 2))
_ROWS_AT_ONCE = 5  # a frame's five lasers: 21 MB


class Returns(NamedTuple):
    """All returns of a frame. points_m, origins_m: float64 [N, 3], the dataset's world; where each
    return lies, and where its laser was then. timestamps_ns: int64 [N]. intensity, elongation:
    float32 [N], as recorded. sensor: uint8 [N], 1 TOP, 2 FRONT, 3 SIDE_LEFT, 4 SIDE_RIGHT, 5 REAR.
    number: uint8 [N], 1 or 2, which of its beam's returns. in_no_label_zone: bool [N]. classes,
    objects: int32 [N], the dataset's numbers, 0 of lasers but TOP; None where the frame has no
    LiDAR segmentation."""

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


def frame_returns(segment: Segment, frame: int) -> Returns | None:
    """The returns of a frame, lasers in their order, each laser's first returns first; None where
    the table has no row of it."""
    index = _index(segment, "lidar")
    own = index.get(frame)
    if own is None:
        return None
    path = segment.files.path("lidar")
    cells = _reader(segment, "lidar", _IMAGES).read(list(own.values()))
    poses = _pixel_poses(segment, frame)
    labels = _pixel_classes(segment, frame)
    parts = []
    for laser, row in sorted(own.items()):
        where = f"{path}: frame {segment.stamps_us[frame]}, laser {LASERS[laser - 1]}"
        for number, name in enumerate(_IMAGES, start=1):
            image = _image(cells[row], name, 4, where)
            if image is not None:
                beams = _Beams(segment, frame, laser, poses if laser == TOP else None, where)
                classes = labels.get(number) if laser == TOP else None
                parts.append(beams.returns(image, number, classes))
    if not parts:
        return None
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Returns(*columns) if labels else Returns(*columns[:-2], None, None)


class _Beams(NamedTuple):
    """One laser's beams of one frame. poses: of the TOP laser's car at each pixel, [H, W, 6]."""

    segment: Segment
    frame: int
    laser: int
    poses: np.ndarray | None
    where: str

    def returns(self, image: np.ndarray, number: int, labels: np.ndarray | None) -> Returns:
        """Those of a range image [H, W, 4]. labels: objects and classes [H, W, 2]."""
        segment, rows, columns = self.segment, *image.shape[:2]
        laser = segment.lasers.get(LASERS[self.laser - 1])
        if laser is None:
            raise AdapterError(f"{self.where}: lidar_calibration has no such laser")
        try:
            directions = _directions(laser, rows, columns)
        except AdapterError as error:
            raise AdapterError(f"{self.where}: {error}; copy lidar_calibration again") from None
        with np.errstate(invalid="ignore"):
            hit = np.flatnonzero((image[..., 0] > 0) & np.isfinite(image[..., 0]))
        values = image.reshape(-1, 4)[hit]
        mount = laser.vehicle_from_laser[:3, 3]
        offsets = values[:, :1].astype(np.float64) * directions.reshape(-1, 3)[hit]
        pose = segment.world_from_vehicle[self.frame]
        times = np.full(len(hit), segment.pose_times_ns[self.frame])
        if self.laser != TOP:
            # Moved by the dataset to where the car was at the vehicle pose's time.
            points = (offsets + mount) @ pose[:3, :3].T + pose[:3, 3]
            origins = np.broadcast_to(pose[:3, :3] @ mount + pose[:3, 3], points.shape)
        else:
            if self.poses is None or self.poses.shape[:2] != (rows, columns):
                size = "none" if self.poses is None else list(self.poses.shape[:2])
                raise AdapterError(
                    f"{self.where}: lidar_pose must have a pose for each of {rows} x {columns} "
                    f"pixels; it has {size}. Copy it again"
                )
            turns, places = _car_at(self.poses.reshape(-1, 6)[hit])
            points = np.einsum("nij,nj->ni", turns, offsets + mount) + places
            origins = turns @ mount + places
            share = (hit % columns + 0.5) / columns
            times = segment.stamps_us[self.frame] * 1000 + np.round(share * _SPIN_NS).astype(int)
        if labels is not None and labels.shape[:2] != (rows, columns):
            raise AdapterError(
                f"{self.where}: lidar_segmentation must be of {rows} x {columns} pixels; it is of "
                f"{list(labels.shape[:2])}. Copy it again"
            )
        none = np.zeros((len(hit), 2), np.int32)
        objects, classes = (none if labels is None else labels.reshape(-1, 2)[hit]).T
        return Returns(
            points,
            origins,
            times,
            values[:, 1],
            values[:, 2],
            np.full(len(hit), self.laser, np.uint8),
            np.full(len(hit), number, np.uint8),
            values[:, 3] > 0,
            classes,
            objects,
        )


@lru_cache(maxsize=8)
def _directions(laser: Any, rows: int, columns: int) -> np.ndarray:
    return laser.directions(rows, columns)


def _car_at(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [N, 3, 3] and places [N, 3] of world_from_vehicle from rows of roll, pitch, yaw, x,
    y, z, float64: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    values = poses.astype(np.float64)
    (cr, cp, cy), (sr, sp, sy) = np.cos(values[:, :3].T), np.sin(values[:, :3].T)
    turns = np.empty((len(values), 3, 3))
    turns[:, 0] = np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], axis=1)
    turns[:, 1] = np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], axis=1)
    turns[:, 2] = np.stack([-sp, cp * sr, cp * cr], axis=1)
    return turns, values[:, 3:]


def _pixel_poses(segment: Segment, frame: int) -> np.ndarray | None:
    row = _index(segment, "lidar_pose").get(frame, {}).get(TOP)
    if row is None:
        return None
    cells = _reader(segment, "lidar_pose", (_POSE_IMAGE,)).read([row])[row]
    where = f"{segment.files.path('lidar_pose')}: frame {segment.stamps_us[frame]}"
    return _image(cells, _POSE_IMAGE, 6, where)


def _pixel_classes(segment: Segment, frame: int) -> dict[int, np.ndarray]:
    """Objects and classes [H, W, 2] of the TOP laser's pixels by number of the return."""
    if not segment.files.has("lidar_segmentation"):
        return {}
    row = _index(segment, "lidar_segmentation").get(frame, {}).get(TOP)
    if row is None:
        return {}
    cells = _reader(segment, "lidar_segmentation", _CLASS_IMAGES).read([row])[row]
    where = f"{segment.files.path('lidar_segmentation')}: frame {segment.stamps_us[frame]}"
    images = {n: _image(cells, name, 2, where) for n, name in enumerate(_CLASS_IMAGES, start=1)}
    return {n: image for n, image in images.items() if image is not None}


def _image(cells: dict[str, Any], name: str, channels: int, where: str) -> np.ndarray | None:
    """A range image [H, W, channels], or None for null; its memory is the table's."""
    values, shape = cells[f"{name}.values"].values, cells[f"{name}.shape"].as_py()
    if values is None or shape is None:
        return None
    is_size = len(shape) == 3 and all(isinstance(n, int) and 1 <= n <= MAX_SIDE for n in shape)
    if not is_size or shape[2] != channels or len(values) != np.prod(shape) or values.null_count:
        raise AdapterError(
            f"{where}: {name} must have height x width x {channels} values, none of them null, and "
            f"sides up to {MAX_SIDE}; got shape {shape} and {len(values)} values. Copy it again"
        )
    return values.to_numpy(zero_copy_only=False).reshape(shape)


@lru_cache(maxsize=8)
def _reader(segment: Segment, component: str, images: tuple[str, ...]) -> RowReader:
    columns = [f"{name}.{part}" for name in images for part in ("values", "shape")]
    return RowReader(segment.files.path(component), columns, _ROWS_AT_ONCE)


@lru_cache(maxsize=8)
def _index(segment: Segment, component: str) -> dict[int, dict[int, int]]:
    """Row numbers by frame and laser."""
    rows = Rows(segment.files, component, [STAMP, "key.laser_name"])
    frames = segment.frames_of(rows.stamps(), rows.path)
    lasers = rows.enum("key.laser_name", LASERS)
    found: dict[int, dict[int, int]] = {}
    for frame, laser, row in zip(frames, lasers, rows.numbers, strict=True):
        own = found.setdefault(int(frame), {})
        if own.setdefault(int(laser), int(row)) != row:
            raise rows.fault(STAMP, f"has two rows of laser {LASERS[laser - 1]} and one frame")
    return found


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
    """Labels of one segment, read when asked.

    Boxes: track_ids are laser_object_ids, labels Vehicle, Pedestrian, Sign, Cyclist or Unknown.
    Attributes, as far as the table has them: num_lidar_points_in_box, num_top_lidar_points_in_box,
    speed_{x,y,z} and acceleration_{x,y,z} (SI, world axes), difficulty_level_{detection,tracking}.

    Sweeps: columns x y z (metres, float64, the dataset's world), intensity (the hyperbolic tangent
    of what was recorded, which has no upper limit), raw_intensity, elongation, sensor,
    return_number and in_no_label_zone (see Returns), timestamp_ns (of the TOP laser by column,
    which the dataset does not state; of the others that of the vehicle pose), and where the frame
    has LiDAR segmentation semantic and instance (0 of lasers but TOP). All returns are among them,
    also of the recording car."""

    segment: Segment

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
        return LidarSweep({name: np.array(column) for name, column in columns.items()})

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        numbers = sweep.columns.get("semantic")
        return None if numbers is None else world_classes(numbers, _CLASSES)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Where the TOP laser was as each beam left it, by the dataset's pose of each pixel; the
        other lasers at the time of the vehicle pose, to which their returns were moved."""
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
    """The boxes by frame, in the dataset's world."""
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
    found = {}
    for own in np.split(order, starts[1:]):
        pose = segment.world_from_vehicle[frames[own[0]]]
        heading = Rotation.from_rotvec(np.nan_to_num(values[own, 6:]) * [0, 0, 1])
        quats = (Rotation.from_matrix(pose[:3, :3]) * heading).as_quat()[:, [3, 0, 1, 2]]
        quats[~np.isfinite(values[own, 6])] = np.nan
        found[int(frames[own[0]])] = Boxes(
            tuple(names[own]),
            tuple(types[i] for i in own),
            values[own, :3] @ pose[:3, :3].T + pose[:3, 3],
            values[own, 3:6].astype(np.float64),
            quats,
            {name: column[own] for name, column in attributes.items()},
        )
    return found


def moving_boxes(
    segment: Segment, numbers: Sequence[int], origin: np.ndarray
) -> tuple[tuple[Any, ...], tuple[str, ...]]:
    """The boxes of moving objects in the frames, and a sentence for each fault. When the labels
    stand for is not published: a box is taken to be where its object was as the TOP laser's turn
    came past it."""
    timed = []
    for n in numbers:
        boxes = _all_boxes(segment).get(n, Boxes.empty())
        pose = segment.world_from_vehicle[n]
        local = (boxes.centers_m - pose[:3, 3]) @ pose[:3, :3]
        share = (np.pi - np.arctan2(local[:, 1], local[:, 0])) / (2 * np.pi)
        times = segment.stamps_us[n] * 1000 + np.nan_to_num(share * _SPIN_NS).astype(np.int64)
        timed.append(TimedBoxes(n, boxes, times))
    objects = find_objects(timed, origin)
    return objects.moving, objects.problems


# ---- The scene -----------------------------------------------------------------------------------


class WaymoOptions(DriveOptions):
    """segment: its name, or the first part of it."""

    segment: str | None = Field(
        None, min_length=1, description="a segment's name, or its number before the first '_'"
    )


def open_waymo(path: str, query: dict[str, str]) -> Scene:
    """One segment of the Waymo Open Dataset v2; path: a folder with its components' folders, that
    of a split or the one above, or one with a segment's files (vehicle_pose.parquet and so on).

    query: segment, needed where there are several; and frames, voxel_m, max_gaussians, image_scale,
    sky_size, held_out, see DriveOptions. Opening is deterministic: the same files and options give
    the same bits.

    Raises:
        AdapterError: a wrong option, a missing component, a table that is damaged or contradicts
            another, no LiDAR, no image. Single images and sweeps that are missing or damaged are
            Scene.problems."""
    options = WaymoOptions.from_query("waymo", query)
    return scene_of_drive(read_waymo(path, query, options), options)


def read_waymo(path: str, query: dict[str, str], options: WaymoOptions) -> RawDrive:
    """The frames of the segment that the options ask for, with their sweeps and boxes."""
    segment = read_segment(find_segment(Path(path), options.segment))
    where = f"waymo:{path}, segment {segment.files.name}"
    chosen = options.select(range(len(segment.stamps_us)), where=where)
    origin = drive_origin(segment.world_from_vehicle[:, :3, 3])
    paths, image_problems = extract_images(segment, chosen.numbers)
    frames = tuple(_frame(segment, n, origin, paths[n]) for n in chosen.numbers)
    boxes, box_problems = moving_boxes(segment, chosen.numbers, origin)
    sweeps, sweep_problems = read_sweeps(segment, chosen.used, origin)
    top = segment.lasers.get("TOP")
    return RawDrive(
        name=segment.files.name,
        source=format_uri("waymo", path, query),
        frames=frames,
        held_out=chosen.held_out,
        sweeps=sweeps,
        boxes=boxes,
        labels=WaymoLabels(segment),
        world_origin_m=origin,
        lidar_top_deg=0.0 if top is None else float(np.degrees(top.highest_rad)),
        problems=(
            *segment.problems,
            *chosen.problems,
            *image_problems,
            *sweep_problems,
            *box_problems,
            *_notes(segment, chosen.numbers),
        ),
    )


def waymo_labels(path: str, query: dict[str, str]) -> WaymoLabels:
    """The labels of a segment; whatever frames= says, they are those of all its frames."""
    options = WaymoOptions.from_query("waymo", query)
    return WaymoLabels(read_segment(find_segment(Path(path), options.segment)))


def waymo_files(path: Path | str, query: dict[str, str]) -> list[Path]:
    """The files that are read of a segment, whether they are there or not."""
    files = find_segment(Path(path), query.get("segment"))
    return [files.path(component) for component in COMPONENTS]


def _notes(segment: Segment, numbers: Sequence[int]) -> list[str]:
    notes = []
    if not segment.files.has("lidar_box"):
        path = segment.files.path("lidar_box")
        notes.append(f"{path} does not exist: no boxes are known, what moves leaves a trace")
    shots = [shot for n in numbers for shot in segment.shots.get(n, {}).values()]
    longest_s = max((shot.readout_s for shot in shots), default=0.0)
    distorted = [name for name, mount in segment.cameras.items() if not mount.lens.is_pinhole]
    if distorted:
        notes.append(
            f"images of {', '.join(distorted)} are without their lens distortion, in copies that "
            f"cameras and weather go with"
        )
    if len(numbers) > 1 and longest_s:
        places, times = segment.world_from_vehicle[:, :3, 3], segment.pose_times_ns
        speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / (np.diff(times) * 1e-9)
        half_m = float(speeds.max()) * longest_s / 2
        notes.append(
            f"images are read out in {longest_s * 1e3:.0f} ms and stand where the car was halfway: "
            f"what their borders show is off by up to {half_m:.2f} m of driving"
        )
    return notes


def _frame(segment: Segment, n: int, origin: np.ndarray, paths: dict[str, str]) -> Frame:
    cameras = {}
    for name, mount in segment.cameras.items():
        shot = segment.shots.get(n, {}).get(name)
        if shot is None:
            continue
        pose = recentred(shot.world_from_vehicle @ mount.vehicle_from_camera, origin)
        cameras[name] = Camera(
            name,
            mount.lens.width,
            mount.lens.height,
            *mount.lens.pinhole,
            camera_from_world=invert_rigid(pose),
            timestamp_ns=shot.timestamp_ns,
        )
    return Frame(
        index=n,
        timestamp_ns=int(segment.pose_times_ns[n]),
        world_from_ego=recentred(segment.world_from_vehicle[n], origin),
        cameras=cameras,
        image_paths=paths,
    )


def read_sweeps(
    segment: Segment, numbers: Sequence[int], origin: np.ndarray
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """The usable returns of the frames in the scene's world, and what was missing. Of long drives
    every second return is taken, or every third, and so on, so that there are at most
    _MAX_RETURNS."""
    sweeps, missing, problems, step = [], [], [], 1
    for n in tqdm(numbers, desc="LiDAR", unit="sweep", disable=None):
        try:
            returns = frame_returns(segment, n)
        except AdapterError as error:
            problems.append(f"frame {n}: its LiDAR returns are left out: {error}")
            continue
        if returns is None:
            missing.append(n)
            continue
        if not sweeps:
            step = -(-len(returns.points_m) * len(numbers) // _MAX_RETURNS)
        own = slice(n % step, None, step)
        points = returns.points_m[own]
        classes = np.zeros(0) if returns.classes is None else returns.classes[own]
        semantic = (
            np.full(len(points), SemanticClass.UNKNOWN, np.int16)
            if returns.classes is None
            else world_classes(classes, _CLASSES)
        )
        sweep = Sweep((points - origin).astype(np.float32), returns.timestamps_ns[own], semantic)
        sweeps.append(sweep.select(is_usable(sweep, points, segment.world_from_vehicle[n], EGO_M)))
    if len(problems) > _MAX_FAULTS:
        problems[_MAX_FAULTS:] = [f"so are those of {len(problems) - _MAX_FAULTS} more frames"]
    if missing:
        problems.append(f"the LiDAR has no row of {some(missing)}")
    if step > 1:
        problems.append(
            f"the scene is built from one return in {step}, of {len(numbers)} frames; fewer "
            f"(frames=) use all"
        )
    return tuple(sweeps), tuple(problems)
