"""The tiny street of pandaset_folder as a recording: images, calibration.json, plain Parquet files
as any other program writes them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandaset_folder as street
import pyarrow as pa
import pyarrow.parquet as pq

from augment.output.codecs import encode_depth

# PandaSet's class numbers of the street's returns, by name of SemanticClass.
CLASSES = {"7": "road", "41": "building", "13": "vehicle"}
EGO_ABOVE_GROUND_M = -street.GROUND_Z
QUERY = {"voxel_m": "0.1", "image_scale": "1", "sky_size": "32"}


def write_recording(
    root: Path,
    *,
    lidar: bool = True,
    depth: bool = False,
    boxes: bool = True,
    frames: int = street.FRAMES,
    cameras: tuple[str, ...] = tuple(street.CAMERAS),
    offset_m: np.ndarray | None = None,
) -> Path:
    """Write the recording into a folder, coordinates moved by offset_m; returns the folder."""
    offset = np.zeros(3) if offset_m is None else offset_m
    root.mkdir(parents=True, exist_ok=True)
    entries = [_frame_entry(frame, cameras, offset) for frame in range(frames)]
    content = {"ego_above_ground_m": EGO_ABOVE_GROUND_M, "lidar_classes": CLASSES}
    (root / "calibration.json").write_text(json.dumps({**content, "frames": entries}))
    for frame in range(frames):
        for name in cameras:
            _write_view(root, name, frame, with_depth=depth)
        if lidar:
            write_lidar(root, frame, sweep_columns(frame, offset))
    if boxes:
        write_boxes(root, box_columns(frames, offset))
    return root


def edit_calibration(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change calibration.json in place."""
    path = root / "calibration.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def sweep_columns(frame: int, offset: np.ndarray | None = None) -> dict[str, np.ndarray]:
    points, classes, times, _ = street._sweep(frame)
    points = points if offset is None else points + offset
    columns = {axis: points[:, i] for i, axis in enumerate("xyz")}
    return columns | {"t": times, "semantic": classes, "intensity": np.ones(len(points), "f4")}


def write_lidar(root: Path, frame: int, columns: dict[str, Any]) -> None:
    (root / "lidar").mkdir(exist_ok=True)
    pq.write_table(pa.table(columns), root / "lidar" / f"{frame:06d}.parquet")


def box_columns(frames: int, offset: np.ndarray | None = None) -> dict[str, list]:
    """The moving car in every frame, and a parked one."""
    offset = np.zeros(3) if offset is None else offset
    rows = []
    for frame in range(frames):
        places = {
            "car": street.car_centre(street.FRAME_S * frame),
            "parked": np.array([-7.0, -5, 0.4]),
        }
        for name, centre in places.items():
            rows.append((frame, name, *(centre + offset), *street.CAR_SIZE_M, name == "parked"))
    names = ["frame", "track_id", "center_x_m", "center_y_m", "center_z_m"]
    names += ["length_m", "width_m", "height_m", "attribute_stationary"]
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    count = len(rows)
    columns |= {"label": ["Car"] * count, "qw": [1.0] * count}
    return columns | {name: [0.0] * count for name in ("qx", "qy", "qz")}


def write_boxes(root: Path, columns: dict[str, list]) -> None:
    (root / "labels").mkdir(exist_ok=True)
    pq.write_table(pa.table(columns), root / "labels" / "boxes.parquet")


def time_ns(frame: int) -> int:
    return round(street.time_s(frame) * 1e9)


def _camera_centre(frame: int) -> np.ndarray:
    return street.ego_position(frame) + np.array([0, 0, street.CAMERA_HEIGHT_M + street.GROUND_Z])


def _frame_entry(frame: int, cameras: tuple[str, ...], offset: np.ndarray) -> dict[str, Any]:
    intrinsics = {"width": street.WIDTH, "height": street.HEIGHT}
    intrinsics |= {"fx": street.FOCAL_PX, "fy": street.FOCAL_PX}
    intrinsics |= {"cx": street.WIDTH / 2, "cy": street.HEIGHT / 2}
    return {
        "frame": frame,
        "timestamp_ns": time_ns(frame),
        "world_from_ego": _pose(np.eye(3), street.ego_position(frame) + offset),
        "cameras": {
            name: {
                **intrinsics,
                "world_from_camera": _pose(street.CAMERAS[name], _camera_centre(frame) + offset),
            }
            for name in cameras
        },
    }


def _pose(rotation: np.ndarray, position: np.ndarray) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix.tolist()


def _write_view(root: Path, name: str, frame: int, *, with_depth: bool) -> None:
    u = (np.arange(street.WIDTH) + 0.5 - street.WIDTH / 2) / street.FOCAL_PX
    v = (np.arange(street.HEIGHT) + 0.5 - street.HEIGHT / 2) / street.FOCAL_PX
    local = np.stack([*np.meshgrid(u, v), np.ones((street.HEIGHT, street.WIDTH))], axis=-1)
    rays, centre = local @ street.CAMERAS[name].T, _camera_centre(frame)
    image = street.colour_at(centre, rays, street.FRAME_S * frame)
    for folder in ("images", "depth") if with_depth else ("images",):
        (root / folder / name).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(root / "images" / name / f"{frame:06d}.png"), image[..., ::-1].astype(np.uint8))
    if with_depth:
        depth_m = _depth(centre, rays, street.FRAME_S * frame).astype(np.float32)
        (root / "depth" / name / f"{frame:06d}.png").write_bytes(encode_depth(depth_m))


def _depth(origin: np.ndarray, rays: np.ndarray, at_s: float) -> np.ndarray:
    """Depth of what `street.colour_at` shows along rays of unit depth; 0 for sky."""
    half = street.CAR_SIZE_M / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = (street.GROUND_Z - origin[2]) / rays[..., 2]
        wall = (street.WALL_Y - origin[1]) / rays[..., 1]
        low = (street.car_centre(at_s) - half - origin) / rays
        high = (street.car_centre(at_s) + half - origin) / rays
        z = origin[2] + wall * rays[..., 2]
    enter, leave = np.fmin(low, high).max(-1), np.fmax(low, high).min(-1)
    on_wall = (wall > 0) & (z < street.WALL_TOP_M) & (z > street.GROUND_Z)
    depths = [
        np.where(ground > 0, ground, np.inf),
        np.where(on_wall, wall, np.inf),
        np.where((enter > 0) & (enter < leave), enter, np.inf),
    ]
    nearest = np.min(depths, axis=0)
    return np.where(np.isfinite(nearest), nearest, 0)
