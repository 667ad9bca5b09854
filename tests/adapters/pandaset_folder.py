"""A tiny street in PandaSet's layout: ground, a wall on the left, one red car that drives off.

The world is the sequence's own, z up. The recording car drives along +x. Everything is analytic, so
tests know the answer: see `colour_at`.
"""

from __future__ import annotations

import gzip
import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

FRAMES = 3
START_NS = 1_557_539_960_000_000_000
FRAME_S = 0.1
EGO_SPEED_MPS, CAR_SPEED_MPS = 8.0, 6.0
CAMERA_HEIGHT_M = 1.5
WIDTH, HEIGHT, FOCAL_PX = 160, 96, 80.0
WALL_Y, WALL_TOP_M = 8.0, 4.0
CAR_SIZE_M = np.array([4.0, 2.0, 1.6])  # length, width, height
GROUND_Z = -0.4
SKY, WALL, CAR = np.array([[120.0, 160, 220], [200, 180, 130], [190, 30, 30]])
ROAD, LINE = np.full(3, 90.0), np.full(3, 230.0)
# World axes of each camera's x (right), y (down), z (forward).
CAMERAS = {
    "front_camera": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "left_camera": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
CAR_IDS = ("car-a", "car-b")  # the same car as either sensor's box


def car_centre(time_s: float) -> np.ndarray:
    """Of the moving car's box, time in seconds from the first frame."""
    return np.array([9.0 + CAR_SPEED_MPS * time_s, 3.0, GROUND_Z + CAR_SIZE_M[2] / 2])


def ego_position(frame: int) -> np.ndarray:
    return np.array([EGO_SPEED_MPS * FRAME_S * frame, 0.0, 0.0])


def write_sequence(
    root: Path, *, offset_m: np.ndarray | None = None, semantic: bool = True
) -> Path:
    """Write the sequence into a folder, coordinates moved by offset_m; returns the folder."""
    offset = np.zeros(3) if offset_m is None else offset_m
    for name in CAMERAS:
        _write_camera(root, name, offset)
    (root / "lidar").mkdir()
    heading = {"w": np.sqrt(0.5), "x": 0.0, "y": 0.0, "z": -np.sqrt(0.5)}  # y forward, x right
    poses = [
        {"position": _xyz(ego_position(f) + offset), "heading": heading} for f in range(FRAMES)
    ]
    _dump(root / "lidar" / "poses.json", poses)
    _dump(root / "lidar" / "timestamps.json", [time_s(f) for f in range(FRAMES)])
    for frame in range(FRAMES):
        points, classes, times, sensor = _sweep(frame)
        points = points + offset
        table = {c: points[:, i] for i, c in enumerate("xyz")}
        table |= {"i": np.full(len(points), 12.0), "t": times, "d": sensor}
        write_table(root / "lidar" / f"{frame:02d}.pkl.gz", table)
        if semantic:
            write_table(root / "annotations/semseg" / f"{frame:02d}.pkl.gz", {"class": classes})
        write_table(root / "annotations/cuboids" / f"{frame:02d}.pkl.gz", _cuboids(frame, offset))
    return root


def time_s(frame: int) -> float:
    return START_NS * 1e-9 + FRAME_S * frame


def write_table(path: Path, columns: dict[str, object]) -> None:
    """Pickle a table as the dataset does: object columns, named by an object index."""
    path.parent.mkdir(parents=True, exist_ok=True)
    series = {}
    for name, values in columns.items():
        is_text = isinstance(values, list)
        series[name] = pd.Series(values, dtype=object if is_text else None)
    frame = pd.DataFrame(series)
    frame.columns = pd.Index(list(columns), dtype=object)
    with gzip.open(path, "wb", compresslevel=1) as file:
        pickle.dump(frame, file, protocol=4)


def colour_at(origin: np.ndarray, rays: np.ndarray, at_s: float) -> np.ndarray:
    """What is seen along rays [.., 3] from a point, RGB 0 to 255."""
    best = np.full(rays.shape[:-1], np.inf)
    colour = np.broadcast_to(SKY, rays.shape).copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = (GROUND_Z - origin[2]) / rays[..., 2]
        wall = (WALL_Y - origin[1]) / rays[..., 1]
        low = (car_centre(at_s) - CAR_SIZE_M / 2 - origin) / rays
        high = (car_centre(at_s) + CAR_SIZE_M / 2 - origin) / rays
    enter, leave = np.fmin(low, high).max(-1), np.fmax(low, high).min(-1)
    hit = ground > 0
    side = origin[1] + ground * rays[..., 1]
    paint = np.where((np.abs(side - 1.5) < 0.25)[..., None], LINE, ROAD)
    colour[hit], best[hit] = paint[hit], ground[hit]
    z = origin[2] + wall * rays[..., 2]
    hit = (wall > 0) & (wall < best) & (z < WALL_TOP_M) & (z > GROUND_Z)
    colour[hit], best[hit] = WALL, wall[hit]
    hit = (enter > 0) & (enter < leave) & (enter < best)
    colour[hit] = CAR
    return colour


def _write_camera(root: Path, name: str, offset: np.ndarray) -> None:
    folder = root / "camera" / name
    folder.mkdir(parents=True)
    rotation = CAMERAS[name]
    u = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL_PX
    v = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL_PX
    pixels = np.stack([*np.meshgrid(u, v), np.ones((HEIGHT, WIDTH))], axis=-1)
    poses = []
    for frame in range(FRAMES):
        origin = ego_position(frame) + np.array([0, 0, CAMERA_HEIGHT_M + GROUND_Z])
        image = colour_at(origin, pixels @ rotation.T, FRAME_S * frame)
        cv2.imwrite(str(folder / f"{frame:02d}.jpg"), image[..., ::-1].astype(np.uint8))
        poses.append({"position": _xyz(origin + offset), "heading": _quat(rotation)})
    _dump(folder / "poses.json", poses)
    _dump(folder / "timestamps.json", [time_s(f) for f in range(FRAMES)])
    k = {"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    _dump(folder / "intrinsics.json", k)


def _sweep(frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns on ground, wall and car, with classes, times and sensors."""
    rng = np.random.default_rng(frame)
    x, y = np.meshgrid(np.arange(-8, 26, 0.2), np.arange(-6, WALL_Y, 0.2))
    ground = np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_Z)], 1)
    x, z = np.meshgrid(np.arange(-8, 26, 0.2), np.arange(0, WALL_TOP_M, 0.2))
    wall = np.stack([x.ravel(), np.full(x.size, WALL_Y), z.ravel()], 1)
    a, b = np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(-0.4, 0.5, 14))
    a, b = a.ravel(), b.ravel()
    half = np.full_like(a, 0.5)
    faces = [
        np.stack([a, -half, b], 1),
        np.stack([-half, a, b], 1),
        np.stack([a, a * 0 + b, half], 1),
    ]
    local = np.concatenate(faces) * CAR_SIZE_M
    offset_s = rng.uniform(-0.01, 0.01, len(local))  # a car is swept in a fraction of the turn
    at_s = FRAME_S * frame + offset_s
    car = local + car_centre(0.0) + np.stack([CAR_SPEED_MPS * at_s, 0 * at_s, 0 * at_s], 1)
    points = np.concatenate([ground, wall, car])
    parts = (len(ground), len(wall), len(car))
    times = np.concatenate([np.full(parts[0] + parts[1], 0.0), offset_s]) + time_s(frame)
    sensor = np.concatenate([np.zeros(parts[0] + parts[1], int), np.arange(parts[2]) % 2])
    return points, np.repeat([7, 41, 13], parts), times, sensor


def _cuboids(frame: int, offset: np.ndarray) -> dict[str, object]:
    """The moving car once a sensor, and a parked one far away."""
    centre = np.stack([car_centre(FRAME_S * frame)] * 2 + [np.array([-7.0, -5.0, 0.4])]) + offset
    return {
        "uuid": [*CAR_IDS, "parked"],
        "label": ["Car"] * 3,
        "yaw": np.full(3, -np.pi / 2),  # PandaSet's zero points along +y; this is +x
        "stationary": np.array([False, False, True]),
        "camera_used": np.full(3, -1),
        **{f"position.{axis}": centre[:, i] for i, axis in enumerate("xyz")},
        "dimensions.x": np.full(3, CAR_SIZE_M[1]),
        "dimensions.y": np.full(3, CAR_SIZE_M[0]),
        "dimensions.z": np.full(3, CAR_SIZE_M[2]),
        "attributes.object_motion": ["Moving", "Moving", "Parked"],
        "cuboids.sibling_id": [CAR_IDS[1], CAR_IDS[0], "-"],
        "cuboids.sensor_id": np.array([0, 1, -1]),
        "attributes.rider_status": [np.nan, np.nan, np.nan],
    }


def _quat(rotation: np.ndarray) -> dict[str, float]:
    """wxyz of the two rotations used here, whose trace is zero: w = 1/2."""
    r = rotation
    w = np.sqrt(1 + np.trace(r)) / 2
    x, y, z = (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    return {"w": w, "x": x / (4 * w), "y": y / (4 * w), "z": z / (4 * w)}


def _xyz(position: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", (float(v) for v in position), strict=True))


def _dump(path: Path, value: object) -> None:
    path.write_text(json.dumps(value), encoding="utf-8")
