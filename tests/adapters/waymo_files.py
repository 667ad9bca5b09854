"""Small segments of the Waymo Open Dataset v2 by its format, knowing nothing of the adapter.

The car drives a gentle left-hand bend on a slope; `World` says what beams and pixels meet. World
and time are the dataset's: metres far from the origin, Unix seconds. The TOP laser turns clockwise
from the rear in 0.1 s from a frame's stamp on; cameras and vehicle poses have the offsets of a
published frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.adapters.street import Drive, LabelledBox, View, box_distance, nearest_hits, rigid, turn

NAME = "10017090168044687777_6380_000_6400_000"
T0 = 1_550_083_467.346_12
ORIGIN = np.array([-3412.7, 21870.4, 35.2])
CAMERA_NAMES = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
LASER_NAMES = ("TOP", "FRONT", "SIDE_LEFT", "SIDE_RIGHT", "REAR")
# Seconds after the stamp: the middle of the readout, and the pose that the dataset gives.
MIDDLES_S = (0.0502, 0.0380, 0.0628, 0.0256, 0.0754)
POSES_S = (0.0524, 0.0424, 0.0624, 0.0224, 0.0724)
SHUTTER_S, READOUT_S = 0.003, 0.044
YAWS_DEG = (0.0, 45.0, -45.0, 90.0, -90.0)
# x, y, z and yaw in the vehicle's axes; TOP's yaw is large, as on the cars.
LASERS = ((1.43, 0.0, 2.18, -148.0), (4.07, 0, 0.69, 0), (3.24, 1.0, 0.97, 90),
          (3.24, -1.0, 0.97, -90), (-1.15, 0.0, 0.46, 180))  # fmt: skip
SHORT_LIMITS = (-np.pi / 2, np.pi / 6)
CLASS = {"Pedestrian": 7, "Vehicle": 1, "Road": 18, "Building": 14}


SLOPE = np.array([[np.cos(0.03), 0, np.sin(0.03)], [0, 1, 0], [-np.sin(0.03), 0, np.cos(0.03)]])
SPEED, YAW_RATE, YAW0 = 8.0, 0.12, 0.6


def car_pose(seconds: float) -> np.ndarray:
    """world_from_vehicle at a time after T0."""
    yaw = YAW0 + YAW_RATE * seconds
    pose = np.eye(4)
    pose[:3, :3] = turn(2, yaw) @ SLOPE
    radius = SPEED / YAW_RATE
    pose[:3, 3] = ORIGIN + radius * np.array(
        [np.sin(yaw) - np.sin(YAW0), np.cos(YAW0) - np.cos(yaw), 0]
    )
    return pose


def car_velocity(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Linear in world axes, angular in the vehicle's."""
    yaw = YAW0 + YAW_RATE * seconds
    rotation = car_pose(seconds)[:3, :3]
    return SPEED * np.array([np.cos(yaw), np.sin(yaw), 0]), rotation.T @ [0, 0, YAW_RATE]


class World(Protocol):
    def hit(
        self, origins: np.ndarray, directions: np.ndarray, seconds: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Along rays [N, 3] of the dataset's world, each at its time after T0: the distance in
        lengths of the direction, infinite for sky, and the colour, RGB in 0 to 255 [N, 3]."""
        ...


@dataclass(frozen=True)
class Box:
    """A cuboid of the world that may move. centre: at T0. velocity: metres a second."""

    name: str
    kind: int
    centre: np.ndarray
    size: np.ndarray
    yaw: float
    velocity: np.ndarray

    def place(self, seconds: np.ndarray | float) -> np.ndarray:
        return self.centre + np.multiply.outer(seconds, self.velocity)


class Street:
    """A chequered ground at ORIGIN's height, a red wall on the left, and boxes."""

    def __init__(self, boxes: Sequence[Box] = ()) -> None:
        self.boxes = tuple(boxes)
        self.wall = ORIGIN + turn(2, YAW0) @ [0, 9, 0]
        self.normal = turn(2, YAW0) @ [0, -1, 0]

    def hit(self, origins, directions, seconds):
        with np.errstate(all="ignore"):
            down = (ORIGIN[2] - origins[:, 2]) / directions[:, 2]
            at = origins + down[:, None] * directions - ORIGIN
            light = 70 + 60 * (np.floor(at[:, :2] / 2).sum(1) % 2)
            across = (self.wall - origins) @ self.normal / (directions @ self.normal)
            height = (origins + across[:, None] * directions)[:, 2] - ORIGIN[2]
        is_wall = (height > 0) & (height < 5) & (across < 80)
        hits = [
            (np.where(down < 80, down, np.inf), np.stack([light] * 3, 1)),
            (np.where(is_wall, across, np.inf), np.array([180, 60, 50])),
        ]
        for box in self.boxes:
            rotation = turn(2, box.yaw)
            local = (origins - box.place(seconds)) @ rotation
            distance = box_distance(local, directions @ rotation, box.size)
            hits.append((distance, np.array([40, 90, 200])))
        return nearest_hits(np.array([150.0, 180, 220]), hits)


DRIVER = Box(
    "car-1", 1, ORIGIN + turn(2, YAW0) @ [14, -3, 0.75], np.array([4.2, 1.9, 1.5]), YAW0,
    turn(2, YAW0) @ [6.0, 0, 0],
)  # fmt: skip
PARKED = Box(
    "car-2", 1, ORIGIN + turn(2, YAW0) @ [11, 5, 0.75], np.array([4.2, 1.9, 1.5]), YAW0,
    np.array([0.02, 0, 0]),
)  # fmt: skip


@dataclass(frozen=True)
class Rig:
    """Sizes: of FRONT cameras, SIDE cameras, the TOP range image and the others, width x height."""

    front: tuple[int, int] = (192, 128)
    side: tuple[int, int] = (192, 88)
    top: tuple[int, int] = (180, 24)
    short: tuple[int, int] = (60, 20)
    focal: float = 205.0
    distortion: tuple[float, ...] = (0.04, -0.33, 0.001, -0.0005, 0.02)

    def camera(self, number: int) -> tuple[int, int, float, float]:
        """Width, height, c_u, c_v of camera 0 to 4."""
        width, height = self.front if number < 3 else self.side
        return width, height, width / 2 - 1.3, height * (0.5 if number < 3 else 0.277) + 0.7

    @cache  # noqa: B019 - a few small ones
    def rays(self, number: int) -> np.ndarray:
        """Directions [H, W, 3] of the recorded pixels' centres, OpenCV axes, by OpenCV's model,
        whose pixel centres are whole numbers."""
        width, height, c_u, c_v = self.camera(number)
        matrix = np.array([[self.focal, 0, c_u - 0.5], [0, self.focal, c_v - 0.5], [0, 0, 1]])
        u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        wanted = np.stack([u, v], -1).reshape(-1, 2)
        rays = np.ones((len(wanted), 3))
        rays[:, :2] = (wanted - [c_u - 0.5, c_v - 0.5]) / self.focal
        zero, lens = np.zeros(3), np.array(self.distortion)
        for _ in range(12):  # each step leaves about a twentieth of the error
            at = cv2.projectPoints(rays, zero, zero, matrix, lens)[0][:, 0]
            rays[:, :2] += (wanted - at) / self.focal
        return rays.reshape(height, width, 3)

    def inclinations(self) -> np.ndarray:
        """Of the TOP laser's rows from the lowest, denser towards the horizon."""
        return -0.31 + 0.354 * np.linspace(0, 1, self.top[1]) ** 0.7


def camera_extrinsic(number: int) -> np.ndarray:
    """vehicle_from_camera as the dataset has it: x out of the lens, y left, z up."""
    pose = np.eye(4)
    pitch = np.deg2rad(1.5)
    c, s = np.cos(pitch), np.sin(pitch)
    tilt = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    pose[:3, :3] = turn(2, np.deg2rad(YAWS_DEG[number])) @ tilt
    pose[:3, 3] = [1.54, 0.1 * np.sign(YAWS_DEG[number]), 2.11]
    return pose


def laser_extrinsic(number: int) -> np.ndarray:
    x, y, z, yaw = LASERS[number]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn(2, np.deg2rad(yaw)), (x, y, z)
    return pose


def image_of(rig: Rig, world: World, number: int, seconds: float) -> np.ndarray:
    """The image that camera 0 to 4 records all at once at a time, RGB uint8."""
    rays = rig.rays(number)
    cv = rays.reshape(-1, 3)
    out = np.stack([cv[:, 2], -cv[:, 0], -cv[:, 1]], axis=1)  # x out of the lens, y left, z up
    pose = car_pose(seconds) @ camera_extrinsic(number)
    origins = np.broadcast_to(pose[:3, 3], out.shape)
    colour = world.hit(origins, out @ pose[:3, :3].T, np.full(len(out), seconds))[1]
    return np.clip(np.round(colour), 0, 255).astype(np.uint8).reshape(rays.shape)


@dataclass(frozen=True, eq=False)
class Scan:
    """A laser's range images of one frame, float32 [H, W, 4]; poses of the car by pixel [H, W, 6];
    objects and classes [H, W, 2]. points: of the first returns, world [H, W, 3]."""

    first: np.ndarray
    second: np.ndarray
    poses: np.ndarray | None
    labels: np.ndarray
    points: np.ndarray


def scan_of(rig: Rig, world: World, number: int, stamp_s: float) -> Scan:
    """What laser 0 to 4 measures in the turn that begins at a time after T0."""
    width, height = rig.top if number == 0 else rig.short
    mount = laser_extrinsic(number)
    # By columns the azimuth in the vehicle's axes falls from +180 degrees at the rear.
    azimuth = np.pi - 2 * np.pi * (np.arange(width) + 0.5) / width
    if number == 0:
        up = rig.inclinations()[::-1]
        times = stamp_s + 0.1 * (np.arange(width) + 0.5) / width
    else:
        low, high = SHORT_LIMITS
        up = (low + (high - low) * (np.arange(height) + 0.5) / height)[::-1]
        times = np.full(width, stamp_s + POSES_S[0])
    origins = np.empty((height, width, 3))
    rays = np.empty((height, width, 3))
    poses = np.empty((height, width, 6))
    for column in range(width):
        pose = car_pose(times[column])
        flat = np.stack(
            [np.cos(up) * np.cos(azimuth[column]), np.cos(up) * np.sin(azimuth[column]), np.sin(up)]
        )
        rays[:, column] = (pose[:3, :3] @ flat).T
        origins[:, column] = pose[:3, :3] @ mount[:3, 3] + pose[:3, 3]
        r = pose[:3, :3]
        angles = np.arctan2(r[2, 1], r[2, 2]), -np.arcsin(r[2, 0]), np.arctan2(r[1, 0], r[0, 0])
        poses[:, column] = [*angles, *pose[:3, 3]]
    flat_times = np.broadcast_to(times, (height, width)).reshape(-1)
    found = world.hit(origins.reshape(-1, 3), rays.reshape(-1, 3), flat_times)
    reach = 75.0 if number == 0 else 20.0
    ranges = np.where(found[0] < reach, found[0], -1.0).reshape(height, width)
    is_wall = (found[1] == [180, 60, 50]).all(1).reshape(height, width)
    labels = np.stack([np.zeros_like(is_wall), np.where(is_wall, 14, 18)], -1).astype(np.int32)
    labels[ranges < 0] = 0
    first = np.stack(
        [ranges, 0.3 + 2000 * (ranges > 60), 0.1 * (ranges > 0), np.zeros_like(ranges)], -1
    )
    first[ranges < 0] = -1
    second = np.full_like(first, -1.0)
    second[::5, ::7] = first[::5, ::7] + np.array([0.5, 0, 0, 1])  # half a metre behind
    second[first[..., 0] < 0] = -1
    return Scan(
        first.astype(np.float32),
        second.astype(np.float32),
        poses.astype(np.float32) if number == 0 else None,
        labels,
        origins + ranges[..., None] * rays,
    )


# ---- Tables --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Form:
    """older: names in place of numbers, float32 transforms. rows_in_group: frames in each row group
    of large tables. is_alone: files of one segment in its folder. order: of the rows."""

    older: bool = False
    rows_in_group: int = 2
    is_alone: bool = False
    seed: int = 3
    compression: str = "brotli"

    def names(self, numbers: Sequence[int], words: Sequence[str]) -> pa.Array:
        """Numbers from 1, or the words."""
        if self.older:
            return pa.array([words[n - 1] for n in numbers], pa.string())
        return pa.array(numbers, pa.int8())

    def transforms(self, poses: Sequence[np.ndarray]) -> pa.Array:
        kind = pa.float32() if self.older else pa.float64()
        flat = np.concatenate([np.asarray(pose, np.float64).reshape(-1) for pose in poses])
        return pa.FixedSizeListArray.from_arrays(pa.array(flat).cast(kind, safe=False), 16)


CLASSES = {
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


def table_path(root: Path, tag: str, form: Form = Form(), name: str = NAME) -> Path:
    return root / f"{tag}.parquet" if form.is_alone else root / tag / f"{name}.parquet"


def write_table(
    root: Path,
    tag: str,
    keys: Mapping[str, pa.Array],
    fields: Mapping[str, pa.Array],
    form: Form,
    *,
    name: str = NAME,
    rows_in_group: int | None = None,
) -> None:
    """One component; rows in a mixed order within each row group, and a column `index` too, as
    published files have."""
    columns = {f"key.{key}": column for key, column in keys.items()}
    columns |= {f"[{CLASSES[tag]}].{key}": column for key, column in fields.items()}
    count = len(next(iter(columns.values())))
    columns["key.segment_context_name"] = pa.array([name] * count)
    columns["index"] = pa.array([f"{name};{i}" for i in range(count)])
    size = rows_in_group or count
    rng = np.random.default_rng(form.seed)
    order = [i + s for s in range(0, count, size) for i in rng.permutation(min(size, count - s))]
    table = pa.table(columns).take(pa.array(order))
    path = table_path(root, tag, form, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    level = 1 if form.compression == "brotli" else None
    pq.write_table(
        table, path, row_group_size=size, compression=form.compression, compression_level=level
    )


def _ranges(scans: Sequence[np.ndarray | None], kind: pa.DataType) -> dict[str, pa.Array]:
    """Columns .values and .shape; None for null."""
    flat = [None if scan is None else pa.array(scan.reshape(-1), kind) for scan in scans]
    sizes = np.cumsum([0, *(0 if f is None else len(f) for f in flat)])
    mask = pa.array([f is None for f in flat])
    values = pa.concat_arrays([f for f in flat if f is not None] or [pa.array([], kind)])
    lists = pa.ListArray.from_arrays(pa.array(sizes, pa.int32()), values, mask=mask)
    shapes = pa.array(
        [None if s is None else list(s.shape) for s in scans], pa.list_(pa.int32(), 3)
    )
    return {"values": lists, "shape": shapes}


def stamps_of(frames: int, dropped: int | None = None) -> list[float]:
    """Of the frames' stamps after T0, 0.1 s apart; before frame `dropped` one is missing."""
    return [0.1 * (n + (dropped is not None and n >= dropped)) for n in range(frames)]


def stamp_us(seconds: float) -> int:
    return round((T0 + seconds) * 1e6)


def write_as_waymo(
    root: Path,
    *,
    frames: int = 3,
    rig: Rig = Rig(),
    world: World | None = None,
    boxes: Sequence[Box] = (DRIVER, PARKED),
    form: Form = Form(),
    dropped: int | None = 2,
    segmented: Sequence[int] = (1,),
    pictured: Sequence[int] = (),
    name: str = NAME,
    image: Callable[[Rig, World, int, float], np.ndarray] = image_of,
    quality: int = 98,
) -> Path:
    """All components of a segment. segmented, pictured: frames with segmentation of TOP's returns,
    and of images. Returns root."""
    world = Street(boxes) if world is None else world
    stamps = stamps_of(frames, dropped)
    key = [stamp_us(s) for s in stamps]
    poses = form.transforms([car_pose(s + POSES_S[0]) for s in stamps])
    keys, fields = (
        {"frame_timestamp_micros": pa.array(key)},
        {"world_from_vehicle.transform": poses},
    )
    write_table(root, "vehicle_pose", keys, fields, form, name=name)
    _write_cameras(root, rig, form, name)
    _write_images(root, rig, world, form, name, stamps, image, quality)
    _write_lasers(root, rig, form, name)
    _write_scans(root, rig, world, form, name, stamps, segmented)
    if pictured:
        _write_label_images(root, rig, world, form, name, [stamps[n] for n in pictured])
    _write_boxes(root, form, name, stamps, boxes)
    return root


def drive_of_waymo(root: Path) -> Drive:
    stamps = stamps_of(3, 2)
    opencv = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # axes of x out of the lens, z up

    def time_ns(seconds: float) -> int:
        return round((T0 + seconds) * 1e9)

    def view(number: int, stamp: float) -> View:
        seconds = stamp + MIDDLES_S[number]
        pose = car_pose(seconds) @ camera_extrinsic(number) @ rigid(opencv, np.zeros(3))
        return View(time_ns(seconds), pose)

    def box(thing: Box, stamp: float) -> LabelledBox:
        return LabelledBox("Vehicle", thing.place(met_s(thing, stamp)), thing.size)

    return Drive(
        scheme="waymo",
        path=root,
        name=NAME,
        times_ns={n: time_ns(s + POSES_S[0]) for n, s in enumerate(stamps)},
        world_from_ego={n: car_pose(s + POSES_S[0]) for n, s in enumerate(stamps)},
        views={
            n: {name: view(number, s) for number, name in enumerate(CAMERA_NAMES)}
            for n, s in enumerate(stamps)
        },
        lenses={},  # without distortion the focal length is another
        boxes={n: {b.name: box(b, s) for b in (DRIVER, PARKED)} for n, s in enumerate(stamps)},
        car=DRIVER.name,
        world_from_car=lambda t: rigid(turn(2, DRIVER.yaw), DRIVER.place(t * 1e-9 - T0)),
        ground_z_m=ORIGIN[2],
        problems=("lens distortion", f"{READOUT_S * SPEED / 2:.2f} m"),
        car_rgb=np.array([40, 90, 200]),
        car_atol_m=1e-4,
        car_turn_atol=0.03,  # boxes lean with the recording car on its slope
        has_discs_in_car=True,
        min_psnr_db=21.5,
        time_atol_ns=2000,  # float64 seconds
        # Going on with a velocity over 4 ms of a bend at 1 m/s2 leaves 8 micrometres.
        pose_atol=2e-5,
        box_atol_m=1e-6,
        ground_atol_m=0.02,
    )


def _write_cameras(root: Path, rig: Rig, form: Form, name: str) -> None:
    lenses = [rig.camera(n) for n in range(5)]
    k1, k2, p1, p2, k3 = rig.distortion
    numbers = {"f_u": [rig.focal] * 5, "f_v": [rig.focal] * 5, "c_u": [lens[2] for lens in lenses],
               "c_v": [lens[3] for lens in lenses], "k1": [k1] * 5, "k2": [k2] * 5, "p1": [p1] * 5,
               "p2": [p2] * 5, "k3": [k3] * 5}  # fmt: skip
    fields = {f"intrinsic.{key}": pa.array(v, pa.float64()) for key, v in numbers.items()}
    fields["extrinsic.transform"] = form.transforms([camera_extrinsic(n) for n in range(5)])
    fields["width"] = pa.array([lens[0] for lens in lenses], pa.int32())
    fields["height"] = pa.array([lens[1] for lens in lenses], pa.int32())
    fields["rolling_shutter_direction"] = pa.array([2] * 5, pa.int8())
    keys = {"camera_name": form.names(range(1, 6), CAMERA_NAMES)}
    write_table(root, "camera_calibration", keys, fields, form, name=name)


def _write_images(root, rig, world, form, name, stamps, image, quality) -> None:
    rows: dict[str, list] = {}
    cameras = []
    for s in stamps:
        for number in range(5):
            at, middle = s + POSES_S[number], s + MIDDLES_S[number]
            picture = image(rig, world, number, middle)
            options = [cv2.IMWRITE_JPEG_QUALITY, quality]
            data = cv2.imencode(".jpg", picture[..., ::-1], options)[1].tobytes()
            linear, angular = car_velocity(at)
            whole = SHUTTER_S + READOUT_S
            row = {"image": data, "pose_timestamp": T0 + at, "pose": car_pose(at)}
            shutter = {
                "shutter": SHUTTER_S,
                "camera_trigger_time": T0 + middle - whole / 2,
                "camera_readout_done_time": T0 + middle + whole / 2,
            }
            row |= {f"rolling_shutter_params.{key}": value for key, value in shutter.items()}
            row |= {f"velocity.linear_velocity.{a}": linear[i] for i, a in enumerate("xyz")}
            row |= {f"velocity.angular_velocity.{a}": angular[i] for i, a in enumerate("xyz")}
            for key, value in row.items():
                rows.setdefault(key, []).append(value)
            cameras.append(number + 1)
    fields = {key: pa.array(values) for key, values in rows.items() if key != "pose"}
    fields |= {n: v.cast(pa.float32()) for n, v in fields.items() if ".linear_velocity." in n}
    fields["pose.transform"] = form.transforms(rows["pose"])
    keys = {
        "frame_timestamp_micros": pa.array(np.repeat([stamp_us(s) for s in stamps], 5)),
        "camera_name": form.names(cameras, CAMERA_NAMES),
    }
    size = 5 * form.rows_in_group
    write_table(root, "camera_image", keys, fields, form, name=name, rows_in_group=size)


def _write_lasers(root: Path, rig: Rig, form: Form, name: str) -> None:
    up = rig.inclinations()
    fields = {
        "extrinsic.transform": form.transforms([laser_extrinsic(n) for n in range(5)]),
        "beam_inclination.min": pa.array([up[0], *[SHORT_LIMITS[0]] * 4]),
        "beam_inclination.max": pa.array([up[-1], *[SHORT_LIMITS[1]] * 4]),
        "beam_inclination.values": pa.array([up.tolist(), *[None] * 4], pa.list_(pa.float64())),
    }
    keys = {"laser_name": form.names(range(1, 6), LASER_NAMES)}
    write_table(root, "lidar_calibration", keys, fields, form, name=name)


def _write_scans(root, rig, world, form, name, stamps, segmented) -> None:
    scans = [scan_of(rig, world, number, s) for s in stamps for number in range(5)]
    key = np.repeat([stamp_us(s) for s in stamps], 5)
    numbers = list(range(1, 6)) * len(stamps)
    keys = {"frame_timestamp_micros": pa.array(key), "laser_name": form.names(numbers, LASER_NAMES)}
    fields = {}
    for number, images in ((1, [s.first for s in scans]), (2, [s.second for s in scans])):
        # SIDE_LEFT has no second returns.
        own = [None if number == 2 and i % 5 == 2 else image for i, image in enumerate(images)]
        columns = _ranges(own, pa.float32())
        fields |= {f"range_image_return{number}.{part}": c for part, c in columns.items()}
    size = 5 * form.rows_in_group
    write_table(root, "lidar", keys, fields, form, name=name, rows_in_group=size)
    names = form.names([1] * len(stamps), LASER_NAMES)
    top = {"frame_timestamp_micros": pa.array(key[::5]), "laser_name": names}
    columns = _ranges([s.poses for s in scans[::5]], pa.float32())
    fields = {f"range_image_return1.{part}": column for part, column in columns.items()}
    size = form.rows_in_group
    write_table(root, "lidar_pose", top, fields, form, name=name, rows_in_group=size)
    if segmented := [n for n in segmented if n < len(stamps)]:
        keys = {
            "frame_timestamp_micros": pa.array([stamp_us(stamps[n]) for n in segmented]),
            "laser_name": form.names([1] * len(segmented), LASER_NAMES),
        }
        columns = _ranges([scans[5 * n].labels for n in segmented], pa.int32())
        fields = {f"range_image_return{r}.{part}": c for r in (1, 2) for part, c in columns.items()}
        write_table(root, "lidar_segmentation", keys, fields, form, name=name)


def _write_label_images(root, rig, world, form, name, stamps) -> None:
    """Panoptic images, in whose corner the car shows itself, and where returns lie in them."""
    pictures, projections = [], []
    for s in stamps:
        for n in range(5):
            image = image_of(rig, world, n, s + MIDDLES_S[n])
            grey, red = (image == image[..., :1]).all(-1), (image == [180, 60, 50]).all(-1)
            blue = (image == [40, 90, 200]).all(-1)
            classes = np.select([grey, red, blue], [20, 19, 2], 25)
            classes[-4:, :8] = 1
            panoptic = (classes * 1000 + 7 * (classes == 2)).astype(np.uint16)
            pictures.append(cv2.imencode(".png", panoptic)[1].tobytes())
        for laser in range(5):
            scan = scan_of(rig, world, laser, s)
            pixels = np.zeros((*scan.points.shape[:2], 6), np.float32)
            seen = np.zeros(scan.points.shape[:2], int)
            for n in range(5):
                u, v, inside = pixels_of(rig, n, s + MIDDLES_S[n], scan.points)
                for place in range(2):
                    own = inside & (seen == place) & (scan.first[..., 0] > 0)
                    values = np.stack([np.full(u.shape, n + 1), np.floor(u), np.floor(v)], -1)
                    pixels[own, 3 * place : 3 * place + 3] = values[own]
                    seen[own] += 10  # not again below
                seen[seen >= 10] -= 9
            projections.append(pixels)
    key = np.repeat([stamp_us(s) for s in stamps], 5)
    keys = {
        "frame_timestamp_micros": pa.array(key),
        "camera_name": form.names([1, 2, 3, 4, 5] * len(stamps), CAMERA_NAMES),
    }
    fields = {
        "panoptic_label": pa.array(pictures),
        "panoptic_label_divisor": pa.array([1000] * len(key), pa.int32()),
    }
    write_table(root, "camera_segmentation", keys, fields, form, name=name)
    keys = {
        "frame_timestamp_micros": keys["frame_timestamp_micros"],
        "laser_name": form.names([1, 2, 3, 4, 5] * len(stamps), LASER_NAMES),
    }
    columns = _ranges(projections, pa.float32())
    fields = {f"range_image_return{r}.{part}": c for r in (1, 2) for part, c in columns.items()}
    write_table(root, "lidar_camera_projection", keys, fields, form, name=name)


def pixels_of(
    rig: Rig, number: int, seconds: float, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Recorded pixels u, v of points [..., 3] in camera 0 to 4 at a time, the left edge of the
    first one being 0, and which are in the image."""
    pose = car_pose(seconds) @ camera_extrinsic(number)
    local = (points.reshape(-1, 3) - pose[:3, 3]) @ pose[:3, :3]
    width, height, c_u, c_v = rig.camera(number)
    matrix = np.array([[rig.focal, 0, c_u], [0, rig.focal, c_v], [0, 0, 1]])
    cv = np.stack([-local[:, 1], -local[:, 2], local[:, 0]], axis=1)
    zero, lens = np.zeros(3), np.array(rig.distortion)
    u, v = cv2.projectPoints(cv, zero, zero, matrix, lens)[0][:, 0].T
    ahead = (cv[:, 2] > 0.1) & (np.hypot(cv[:, 0], cv[:, 1]) < 0.9 * cv[:, 2])
    inside = ahead & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return *(values.reshape(points.shape[:-1]) for values in (u, v)), inside.reshape(
        points.shape[:-1]
    )


def _write_boxes(root, form, name, stamps, boxes) -> None:
    keys: dict[str, list] = {"frame_timestamp_micros": [], "laser_object_id": []}
    fields: dict[str, list] = {}
    for s in stamps:
        pose = car_pose(s + POSES_S[0])
        for box in boxes:
            centre = pose[:3, :3].T @ (box.place(met_s(box, s)) - pose[:3, 3])
            forward = pose[:3, :3].T @ turn(2, box.yaw)[:, 0]
            row = {f"box.center.{a}": centre[i] for i, a in enumerate("xyz")}
            row |= {f"box.size.{a}": box.size[i] for i, a in enumerate("xyz")}
            row |= {"box.heading": np.arctan2(forward[1], forward[0])}
            row |= {f"speed.{a}": box.velocity[i] for i, a in enumerate("xyz")}
            row |= {f"acceleration.{a}": None for a in "xyz"}
            for key, value in row.items():
                fields.setdefault(key, []).append(value)
            fields.setdefault("type", []).append(box.kind)
            fields.setdefault("num_lidar_points_in_box", []).append(77)
            fields.setdefault("difficulty_level.detection", []).append(None)
            keys["frame_timestamp_micros"].append(stamp_us(s))
            keys["laser_object_id"].append(box.name)
    ints = {"type": pa.int8(), "num_lidar_points_in_box": pa.int64(),
            "difficulty_level.detection": pa.int8()}  # fmt: skip
    columns = {key: pa.array(v, ints.get(key, pa.float64())) for key, v in fields.items()}
    write_table(
        root, "lidar_box", {k: pa.array(v) for k, v in keys.items()}, columns, form, name=name
    )


def met_s(box: Box, stamp_s: float) -> float:
    """When the TOP laser's turn that begins at the stamp comes past the box."""
    at = stamp_s + 0.05
    for _ in range(3):
        pose = car_pose(stamp_s + POSES_S[0])
        centre = pose[:3, :3].T @ (box.place(at) - pose[:3, 3])
        at = stamp_s + 0.1 * (np.pi - np.arctan2(centre[1], centre[0])) / (2 * np.pi)
    return at


def changed(root: Path, tag: str, change: Callable[[pa.Table], pa.Table], form: Form) -> None:
    """Write a component again with a change."""
    path = table_path(root, tag, form)
    pq.write_table(change(pq.read_table(path)), path)
