"""A tiny Waymo drive as Street Gaussians' converter writes it, from a street that is known exactly.

The street: x along the road, y left, z up, the road at 0, walls at both sides, boxes on it. The
world is the street turned about z and moved far away. The car drives along x while it turns, so
that its poses differ between the frames' and the cameras' times.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from tests.adapters.street import box_distance, nearest_hits, rigid, turn

NAMES = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
CAMERA_YAWS = np.radians([0.0, 45.0, -45.0, 90.0, -90.0])
CAMERA_DELAYS_S = (0.021, 0.013, 0.029, 0.007, 0.037)
START_S = 1_550_083_467.346
FRAME_S = 0.1
SPEED_MPS = 8.0
TURN_RADPS = 0.2
STREET_YAW = 0.7
STREET_ORIGIN_M = np.array([-2312.25, 5120.5, 41.75])
WALL_Y_M, WALL_TOP_M = 9.0, 6.0
ROAD_RGB, WALL_RGB, SKY_RGB = (90, 90, 95), (150, 110, 80), (140, 180, 230)
# Columns: camera x right, y down, z forward, in axes x forward, y left, z up.
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
HEADER = (
    "frame_id track_id object_class alpha box_height box_width box_length "
    "box_center_x box_center_y box_center_z box_heading speed\n"
)


@dataclass(frozen=True)
class StreetObject:
    """start_m: of its centre at the first frame, street. heading: in the street. size_m: length,
    width, height. frames: positions in the drive where it is labelled; None for all."""

    track_id: int
    label: str
    size_m: tuple[float, float, float]
    start_m: tuple[float, float, float]
    velocity_mps: tuple[float, float] = (0.0, 0.0)
    heading: float = 0.0
    frames: tuple[int, ...] | None = None
    cameras: tuple[int, ...] = (0, 1, 2, 3, 4)
    rgb: tuple[int, int, int] = (200, 60, 50)

    def centre(self, seconds: float) -> np.ndarray:
        return np.array(self.start_m) + np.array([*self.velocity_mps, 0.0]) * seconds

    def is_in(self, step: int) -> bool:
        return self.frames is None or step in self.frames


# In this order in every frame of the file. Of these only 1, 4 and 6 move far enough in 0.3 s, and
# 6 is seen by the right side's camera alone.
OBJECTS = (
    StreetObject(0, "vehicle", (4.0, 1.8, 1.6), (14, -5, 0.8), rgb=(60, 160, 70)),
    StreetObject(1, "vehicle", (4.4, 1.9, 1.5), (16, 3, 0.75), (-12, 0), np.pi),
    StreetObject(2, "sign", (0.3, 0.6, 0.9), (9, 6, 2.2), rgb=(220, 220, 40)),
    StreetObject(3, "pedestrian", (0.6, 0.7, 1.8), (8, 6, 0.9), (1.2, 0), rgb=(60, 60, 200)),
    StreetObject(
        4, "cyclist", (1.8, 0.7, 1.7), (11, -1.5, 0.85), (11, 1), 0.09, (1, 2, 3), (0, 1, 2, 4),
        (180, 60, 180),
    ),
    StreetObject(6, "vehicle", (4.2, 1.8, 1.6), (0, -7, 0.8), (9.5, 0), 0.0, None, (4,)),
)  # fmt: skip


@dataclass(frozen=True)
class Facts:
    """What is true of the drive. numbers: of its frames. All poses are in the dataset's world."""

    root: Path
    numbers: tuple[int, ...]
    cameras: tuple[int, ...]
    size: tuple[int, int]
    objects: tuple[StreetObject, ...]
    points: dict[int, np.ndarray] = field(default_factory=dict)
    projections: dict[int, np.ndarray] = field(default_factory=dict)

    @property
    def origin_m(self) -> np.ndarray:
        """The mean position of the car over all frames."""
        return np.mean([self.world_from_ego(n)[:3, 3] for n in self.numbers], axis=0)

    def seconds(self, number: int, camera: int | None = None) -> float:
        """Since the first frame."""
        delay = 0.0 if camera is None else CAMERA_DELAYS_S[camera]
        return (number - self.numbers[0]) * FRAME_S + delay

    def time_s(self, number: int, camera: int | None = None) -> float:
        return round(START_S + self.seconds(number, camera), 6)

    def world_from_ego(self, number: int, camera: int | None = None) -> np.ndarray:
        return WORLD_FROM_STREET @ street_from_ego(self.seconds(number, camera))

    def image_size(self, camera: int) -> tuple[int, int]:
        return image_size(self.size, camera)

    def intrinsics(self, camera: int) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy."""
        width, height = self.image_size(camera)
        return 0.9 * width, 0.9 * width + 0.5, width / 2 + 0.75, height / 2 - 0.5

    def ego_from_camera(self, camera: int) -> np.ndarray:
        return ego_from_camera(camera)

    def object(self, track_id: int) -> StreetObject:
        return next(o for o in self.objects if o.track_id == track_id)

    def world_from_object(self, track_id: int, seconds: float) -> np.ndarray:
        found = self.object(track_id)
        return WORLD_FROM_STREET @ pose_about_z(found.heading, found.centre(seconds))

    def ego_from_object(self, track_id: int, number: int) -> np.ndarray:
        """At the frame's time, as the track file has it."""
        ego = self.world_from_ego(number)
        return np.linalg.inv(ego) @ self.world_from_object(track_id, self.seconds(number))

    def image_path(self, number: int, camera: int) -> Path:
        return next((self.root / "images").glob(f"{number:06d}_{camera}.*"))


def pose_about_z(angle: float, position: Sequence[float]) -> np.ndarray:
    return rigid(turn(2, angle), position)


WORLD_FROM_STREET = pose_about_z(STREET_YAW, STREET_ORIGIN_M)


def street_from_ego(seconds: float) -> np.ndarray:
    return pose_about_z(TURN_RADPS * seconds, (SPEED_MPS * seconds, 0, 0))


def ego_from_camera(camera: int) -> np.ndarray:
    pose = pose_about_z(CAMERA_YAWS[camera], (1.5, 0.1 * (camera == 1) - 0.1 * (camera == 2), 2.1))
    pose[:3, :3] = pose[:3, :3] @ FORWARD
    return pose


def image_size(size: tuple[int, int], camera: int) -> tuple[int, int]:
    """Of Waymo's side cameras the images are 886 rows high where the others' are 1280."""
    return size if camera < 3 else (size[0], round(size[1] * 886 / 1280))


def write_as_street_gaussians(
    root: Path,
    *,
    frames: int = 4,
    cameras: int = 5,
    size: tuple[int, int] = (96, 64),
    first_frame: int = 0,
    images: bool = True,
    lidar: bool = True,
    depth: bool = False,
    castrack: bool = False,
    objects: tuple[StreetObject, ...] = OBJECTS,
) -> Facts:
    """Write the drive into a folder. cameras: how many, from FRONT on. depth: also lidar_depth/
    and sky_mask/. castrack: also the tracker's files, which lack the object 4."""
    numbers = tuple(range(first_frame, first_frame + frames))
    facts = Facts(Path(root), numbers, tuple(range(cameras)), size, tuple(objects))
    _write_calibration(facts)
    _write_tracks(facts, "", {o.track_id for o in objects})
    if castrack:
        _write_tracks(facts, "_castrack", {o.track_id for o in objects} - {4})
    for number in numbers:
        facts.points[number] = _sweep(facts, number)
        facts.projections[number] = _projections(facts, number)
    if lidar:
        write_point_clouds(facts.root, facts.points, facts.projections)
    for number in numbers if images or depth else ():
        for camera in facts.cameras:
            stem = f"{number:06d}_{camera}"
            if images:
                path = facts.root / "images" / f"{stem}.png"
                path.parent.mkdir(exist_ok=True)
                assert cv2.imwrite(str(path), picture(facts, number, camera)[..., ::-1])
            for name in (f"lidar_depth/{stem}.npy", f"sky_mask/{stem}.png") if depth else ():
                path = facts.root / name
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(b"a stand-in: nothing reads it here")
    return facts


def write_point_clouds(
    root: Path, points: dict[int, np.ndarray], projections: dict[int, np.ndarray] | None
) -> None:
    """pointcloud.npz: dictionaries by frame, each pickled by NumPy in an array without axes."""
    held = {"pointcloud": points}
    if projections is not None:
        held["camera_projection"] = projections
    np.savez_compressed(root / "pointcloud.npz", **held)


def write_members(root: Path, members: dict[str, bytes]) -> None:
    """pointcloud.npz with these bytes in it."""
    with zipfile.ZipFile(root / "pointcloud.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def track_row(facts: Facts, found: StreetObject, number: int, *, speed: bool = True) -> str:
    pose = facts.ego_from_object(found.track_id, number)
    length, width, height = found.size_m
    # Labellers' boxes are not of one size in all frames: the third is the largest.
    length += 0.2 if number - facts.numbers[0] == 2 else 0.0
    heading = np.arctan2(pose[1, 0], pose[0, 0])
    x, y, z = pose[:3, 3]
    words = [number, found.track_id, found.label, -10, height, width, length, x, y, z, heading]
    words += [np.hypot(*found.velocity_mps)] if speed else []
    return " ".join(str(word) for word in words) + " \n"


def _write_calibration(facts: Facts) -> None:
    root = facts.root
    for folder in ("ego_pose", "extrinsics", "intrinsics", "track"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for camera in facts.cameras:
        np.savetxt(root / "extrinsics" / f"{camera}.txt", facts.ego_from_camera(camera))
        distortion = (0.04, -0.34, 0.001, -0.0003, 0.0)
        values = [*facts.intrinsics(camera), *distortion]
        np.savetxt(root / "intrinsics" / f"{camera}.txt", values)
    times: dict[str, dict[str, float]] = {"FRAME": {}, **{NAMES[c]: {} for c in facts.cameras}}
    for number in facts.numbers:
        np.savetxt(root / "ego_pose" / f"{number:06d}.txt", facts.world_from_ego(number))
        times["FRAME"][f"{number:06d}"] = facts.time_s(number)
        for camera in facts.cameras:
            path = root / "ego_pose" / f"{number:06d}_{camera}.txt"
            np.savetxt(path, facts.world_from_ego(number, camera))
            times[NAMES[camera]][f"{number:06d}"] = facts.time_s(number, camera)
    (root / "timestamps.json").write_text(json.dumps(times, indent=1))


def _write_tracks(facts: Facts, suffix: str, ids: set[int]) -> None:
    rows, visible = [], {}
    for step, number in enumerate(facts.numbers):
        for found in facts.objects:
            if found.is_in(step) and found.track_id in ids:
                rows.append(track_row(facts, found, number, speed=not suffix))
                seen = [c for c in found.cameras if c in facts.cameras]
                visible.setdefault(str(found.track_id), {})[str(number)] = seen
    folder = facts.root / "track"
    header = HEADER.replace(" speed", "") if suffix else HEADER
    (folder / f"track_info{suffix}.txt").write_text(header + "".join(rows))
    (folder / f"track_camera_vis{suffix}.json").write_text(json.dumps(visible, indent=1))
    names = {f"waymo{found.track_id}": found.track_id for found in facts.objects}
    (folder / "track_ids.json").write_text(json.dumps(names, indent=2))


def _sweep(facts: Facts, number: int) -> np.ndarray:
    """Returns in the vehicle's axes at the frame's time, float64 [N, 3]."""
    seconds = facts.seconds(number)
    rng = np.random.default_rng(number)
    ahead = SPEED_MPS * seconds
    x, y = np.meshgrid(np.arange(-12, 40, 0.5), np.arange(-8.5, 8.6, 0.5))
    road = np.stack([x.ravel() + ahead, y.ravel(), np.zeros(x.size)], 1)
    road[:, :2] += rng.uniform(-0.2, 0.2, (len(road), 2))
    x, z = np.meshgrid(np.arange(-12, 40, 0.5), np.arange(0.3, WALL_TOP_M, 0.4))
    walls = [
        np.stack([x.ravel() + ahead, np.full(x.size, side), z.ravel()], 1)
        for side in (-WALL_Y_M, WALL_Y_M)
    ]
    parts = [road, *walls]
    step = number - facts.numbers[0]
    for found in facts.objects:
        if found.is_in(step):
            pose = pose_about_z(found.heading, found.centre(seconds))
            parts.append(_surface(found.size_m) @ pose[:3, :3].T + pose[:3, 3])
            local = (road - pose[:3, 3]) @ pose[:3, :3]
            under = (np.abs(local[:, :2]) < np.array(found.size_m[:2]) / 2).all(1)
            parts[0] = road = road[~under]
    street = np.concatenate(parts)
    ego = street_from_ego(seconds)
    return (street - ego[:3, 3]) @ ego[:3, :3]


def _surface(size_m: Sequence[float]) -> np.ndarray:
    """Points on the sides and the top of a box."""
    axes = [np.linspace(-s / 2, s / 2, max(2, round(s / 0.12))) for s in size_m]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    half = np.array(size_m) / 2
    on = (np.abs(np.abs(grid) - half) < 1e-9) & [True, True, False]
    top = np.abs(grid[:, 2] - half[2]) < 1e-9
    return grid[on.any(1) | top]


def _camera_axes(facts: Facts, number: int, camera: int) -> np.ndarray:
    """camera_from_ego at the frame's time: the car moves on until the camera takes its image."""
    world_from_camera = facts.world_from_ego(number, camera) @ ego_from_camera(camera)
    return np.linalg.inv(world_from_camera) @ facts.world_from_ego(number)


def _pixels(facts: Facts, number: int, camera: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """uv float64 [N, 2], depth float64 [N] and whether they are in the image."""
    transform = _camera_axes(facts, number, camera)
    local = facts.points[number] @ transform[:3, :3].T + transform[:3, 3]
    fx, fy, cx, cy = facts.intrinsics(camera)
    z = np.maximum(local[:, 2], 1e-6)
    uv = np.stack([fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy], 1)
    inside = (local[:, 2] > 0.5) & (uv >= 0).all(1) & (uv < facts.image_size(camera)).all(1)
    return uv, local[:, 2], inside


def _projections(facts: Facts, number: int) -> np.ndarray:
    """int16 [N, 6]: camera, x, y of the first and of the second that see the point; -1, 0, 0."""
    found = np.zeros((len(facts.points[number]), 6), np.int16)
    found[:, [0, 3]] = -1
    for camera in facts.cameras:
        uv, _, inside = _pixels(facts, number, camera)
        for at in (0, 3):
            free = inside & (found[:, at] == -1)
            found[free, at] = camera
            found[free, at + 1 : at + 3] = np.floor(uv[free])
            inside &= ~free
    return found


def picture(facts: Facts, number: int, camera: int) -> np.ndarray:
    """What the camera sees: RGB uint8 [H, W, 3]."""
    seconds = facts.seconds(number, camera)
    width, height = facts.image_size(camera)
    fx, fy, cx, cy = facts.intrinsics(camera)
    pose = street_from_ego(seconds) @ ego_from_camera(camera)
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1) @ pose[:3, :3].T
    eye = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        hits = [(np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf), ROAD_RGB)]
        for side in (-WALL_Y_M, WALL_Y_M):
            reach = (side - eye[1]) / rays[..., 1]
            z = eye[2] + reach * rays[..., 2]
            hits.append((np.where(z < WALL_TOP_M, reach, np.inf), WALL_RGB))
    for thing in facts.objects:
        if thing.is_in(number - facts.numbers[0]):
            rotation = turn(2, thing.heading)
            local = (eye - thing.centre(seconds)) @ rotation
            hits.append((box_distance(local, rays @ rotation, thing.size_m), thing.rgb))
    return nearest_hits(SKY_RGB, hits)[1].astype(np.uint8)
