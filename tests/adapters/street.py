"""The tiny street through which every writer's recording car drives.

Ground, a wall on the left, a red car that drives off, and a parked one. The world is x forward,
y left, z up. The recording car drives along +x. Everything is analytic, so that tests know the
answer: see `colour_at` and `depth_at`. A dataset's writer, `write_as_X(folder)`, puts this street
into the form of its dataset.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from adapters.uri import format_uri

FRAMES = 3
START_NS = 1_557_539_960_000_000_000
FRAME_S = 0.1
EGO_SPEED_MPS = 8.0
CAR_SPEED_MPS = 6.0
CAMERA_HEIGHT_M = 1.5
WIDTH = 160
HEIGHT = 96
FOCAL_PX = 80.0
WALL_Y = 8.0
WALL_TOP_M = 4.0
CAR_SIZE_M = np.array([4.0, 2.0, 1.6])  # length, width, height
PARKED_AT = np.array([-7.0, -5.0, 0.4])
PARKED_SIZE_M = np.array([4.5, 1.9, 1.6])
GROUND_Z = -0.4
SKY = np.array([120.0, 160, 220])
WALL = np.array([200.0, 180, 130])
CAR = np.array([190.0, 30, 30])
ROAD = np.full(3, 90.0)
LINE = np.full(3, 230.0)
# World axes of each camera's x (right), y (down), z (forward).
CAMERAS = {
    "front_camera": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "left_camera": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
LENS = (WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2)
GROUND_CLASS = 7  # of returns, as PandaSet numbers them
WALL_CLASS = 41
CAR_CLASS = 13


def car_centre(time_s: float) -> np.ndarray:
    """Centre of the moving car's box, time in seconds from the first frame."""
    return np.array([9.0 + CAR_SPEED_MPS * time_s, 3.0, GROUND_Z + CAR_SIZE_M[2] / 2])


def ego_position(frame: int) -> np.ndarray:
    return np.array([EGO_SPEED_MPS * FRAME_S * frame, 0.0, 0.0])


def camera_centre(frame: int) -> np.ndarray:
    return ego_position(frame) + np.array([0, 0, CAMERA_HEIGHT_M + GROUND_Z])


def time_s(frame: int) -> float:
    return START_NS * 1e-9 + FRAME_S * frame


def world_from_car(timestamp_ns: int) -> np.ndarray:
    return rigid(np.eye(3), car_centre((timestamp_ns - START_NS) * 1e-9))


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Pose [4, 4] of a rotation [3, 3] and a translation [3]."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def turn(axis: int, angle_rad: float) -> np.ndarray:
    """Rotation [3, 3] about x, y or z, axis 0 to 2."""
    first = (axis + 1) % 3
    second = (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle_rad)
    matrix[second, first] = np.sin(angle_rad)
    matrix[first, second] = -np.sin(angle_rad)
    return matrix


def local_rays() -> np.ndarray:
    """Rays [H, W, 3] of unit depth through the pixels' centres, in a camera's axes."""
    u = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL_PX
    v = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL_PX
    return np.stack([*np.meshgrid(u, v), np.ones((HEIGHT, WIDTH))], axis=-1)


def image(camera: str, frame: int) -> np.ndarray:
    """Image of a camera at a frame's time, BGR uint8 [H, W, 3]."""
    rays = local_rays() @ CAMERAS[camera].T
    rgb = colour_at(camera_centre(frame), rays, FRAME_S * frame)
    return np.ascontiguousarray(rgb[..., ::-1].astype(np.uint8))


def depth_image(camera: str, frame: int) -> np.ndarray:
    """Depth of `image`'s pixels in metres [H, W]; 0 for sky."""
    depths = distances(camera_centre(frame), local_rays() @ CAMERAS[camera].T, FRAME_S * frame)
    nearest = np.min(depths, axis=0)
    return np.where(np.isfinite(nearest), nearest, 0)


def distances(origin: np.ndarray, rays: np.ndarray, at_s: float) -> list[np.ndarray]:
    """Distances [...] along rays [..., 3] from a point to ground, wall and car, in lengths of the
    ray; infinite where a ray misses.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = (GROUND_Z - origin[2]) / rays[..., 2]
        wall = (WALL_Y - origin[1]) / rays[..., 1]
        z = origin[2] + wall * rays[..., 2]
    is_on_wall = (wall > 0) & (z < WALL_TOP_M) & (z > GROUND_Z)
    return [
        np.where(ground > 0, ground, np.inf),
        np.where(is_on_wall, wall, np.inf),
        box_distance(origin - car_centre(at_s), rays, CAR_SIZE_M),
    ]


def colour_at(origin: np.ndarray, rays: np.ndarray, at_s: float) -> np.ndarray:
    """Colours [..., 3] along rays [..., 3] from a point, RGB 0 to 255."""
    ground, wall, car = distances(origin, rays, at_s)
    with np.errstate(invalid="ignore"):
        is_line = np.abs(origin[1] + ground * rays[..., 1] - 1.5) < 0.25
    road = np.where(is_line[..., None], LINE, ROAD)
    return nearest_hits(SKY, [(ground, road), (wall, WALL), (car, CAR)])[1]


def box_distance(origin: np.ndarray, rays: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Distances [...] along rays [..., 3] to a box around the zero of their axes, infinite where a
    ray misses. origin: [3] or [..., 3].
    """
    half = np.asarray(size_m) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        low = (-half - origin) / rays
        high = (half - origin) / rays
    enter = np.fmin(low, high).max(-1)
    leave = np.fmax(low, high).min(-1)
    return np.where((enter > 0) & (enter < leave), enter, np.inf)


def nearest_hits(
    sky: np.ndarray, hits: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Distances [...] and colours [..., 3] of the nearest surface on each ray.

    Args:
        sky: colour [3] of a ray that meets none.
        hits: distance [...] and colour [3] or [..., 3] of each surface. A distance that is not
            above 0 is a miss.
    """
    best = np.full(hits[0][0].shape, np.inf)
    rgb = np.broadcast_to(np.asarray(sky, float), (*best.shape, 3)).copy()
    for distance, colour in hits:
        is_nearer = (distance > 0) & (distance < best)
        best[is_nearer] = distance[is_nearer]
        rgb[is_nearer] = np.broadcast_to(colour, rgb.shape)[is_nearer]
    return best, rgb


def sweep(frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns [N, 3] on ground, wall and car, with classes, times and sensors (0 or 1)."""
    rng = np.random.default_rng(frame)
    x, y = np.meshgrid(np.arange(-8, 26, 0.2), np.arange(-6, WALL_Y, 0.2))
    ground = np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_Z)], 1)
    x, z = np.meshgrid(np.arange(-8, 26, 0.2), np.arange(0, WALL_TOP_M, 0.2))
    wall = np.stack([x.ravel(), np.full(x.size, WALL_Y), z.ravel()], 1)
    a, b = (v.ravel() for v in np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(-0.4, 0.5, 14)))
    local = car_faces(a, b)
    offset_s = rng.uniform(-0.01, 0.01, len(local))  # a car is swept in a fraction of the turn
    at_s = FRAME_S * frame + offset_s
    car = local + car_centre(0.0) + np.stack([CAR_SPEED_MPS * at_s, 0 * at_s, 0 * at_s], 1)
    points = np.concatenate([ground, wall, car])
    parts = (len(ground), len(wall), len(car))
    times = np.concatenate([np.full(parts[0] + parts[1], 0.0), offset_s]) + time_s(frame)
    sensor = np.concatenate([np.zeros(parts[0] + parts[1], int), np.arange(parts[2]) % 2])
    return points, np.repeat([GROUND_CLASS, WALL_CLASS, CAR_CLASS], parts), times, sensor


def scattered_surfaces(
    rng: np.random.Generator, *, step_m: float, reach_m: float, jitter_m: float, num_on_face: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [N, 3] on ground and wall every step_m, the ground's moved by jitter_m at most, and
    random points of the car around its centre.
    """
    x, y = np.meshgrid(np.arange(-8, reach_m, step_m), np.arange(-6, WALL_Y, step_m))
    ground = np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_Z)], 1)
    ground[:, :2] += rng.uniform(-jitter_m, jitter_m, (len(ground), 2))
    x, z = np.meshgrid(np.arange(-8, reach_m, step_m), np.arange(0, WALL_TOP_M, step_m))
    wall = np.stack([x.ravel(), np.full(x.size, WALL_Y), z.ravel()], 1)
    a = rng.uniform(-0.5, 0.5, num_on_face)
    return ground, wall, car_faces(a, rng.uniform(-0.4, 0.5, num_on_face))


def car_faces(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Points [3 N, 3] on the car's side, back and roof around its centre, from places [N] on a
    face in parts of its edges.
    """
    half = np.full_like(a, 0.5)
    faces = [np.stack(face, 1) for face in ([a, -half, b], [-half, a, b], [a, b, half])]
    return np.concatenate(faces) * CAR_SIZE_M


@dataclass(frozen=True)
class View:
    """Pose and time of one image. world_from_camera: [4, 4]."""

    timestamp_ns: int
    world_from_camera: np.ndarray


@dataclass(frozen=True)
class LabelledBox:
    """Box of one frame, in the dataset's world. size_m: length, width, height."""

    label: str
    centre_m: np.ndarray
    size_m: np.ndarray


def car_box(frame: int) -> LabelledBox:
    return LabelledBox("Car", car_centre(FRAME_S * frame), CAR_SIZE_M)


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A drive as a dataset's files state it, which the scene made of them must give back.

    Each `write_as_X` has a `drive_of_X` beside it, which knows the facts by the street's formulas
    and not by the adapter. Poses are in the dataset's world.
    """

    scheme: str
    path: Path
    query: dict[str, str] = field(default_factory=dict)
    """Options that name the scene in the path."""
    name: str
    times_ns: dict[int, int]
    """Time of each frame, by its number."""
    world_from_ego: dict[int, np.ndarray]
    views: dict[int, dict[str, View]]
    """By frame and camera."""
    lenses: dict[str, tuple[float, ...]]
    """Width, height, fx, fy, cx, cy of each camera; pixel centres lie at +0.5."""
    boxes: dict[int, dict[str, LabelledBox]]
    """By labelled frame and name of the object."""
    points_m: dict[int, np.ndarray] = field(default_factory=dict)
    """Returns [N, 3] of some frames."""
    car: str
    """Name of the car that drives off. Nothing else moves."""
    world_from_car: Callable[[int], np.ndarray]
    """Pose of its box at a time, ns."""
    car_rgb: np.ndarray = field(default_factory=lambda: CAR)
    """Colour of the car, 0 to 255."""
    has_discs_in_car: bool = False
    """True if discs that close gaps between few returns stay where the car was: a known fault."""
    ground_z_m: float
    problems: tuple[str, ...] = ()
    """Beginnings or parts of the sentences on what the files lack."""
    min_psnr_db: float = 24.5
    """Likeness of the scene, of voxels of 10 cm, to images in its middle: some 1 dB less than when
    written."""
    time_atol_ns: int = 0
    pose_atol: float = 1e-8
    box_atol_m: float = 1e-8
    point_atol_m: float = 1e-8
    car_atol_m: float = 1e-2
    car_turn_atol: float = 1e-6
    ground_atol_m: float = 1e-3

    def uri(self, **options: str) -> str:
        return format_uri(self.scheme, self.path, self.query | options)
