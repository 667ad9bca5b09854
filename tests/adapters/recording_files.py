"""The tiny street as a recording: images, calibration.json, and Parquet files as any program writes
them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from augment.output.codecs import encode_depth
from tests.adapters import street
from tests.adapters.pandaset_files import drive_of_pandaset
from tests.adapters.street import Drive

# PandaSet's class numbers of the street's returns, by name of SemanticClass.
CLASSES = {"7": "road", "41": "building", "13": "vehicle"}
EGO_ABOVE_GROUND_M = -street.GROUND_Z
QUERY = {"voxel_m": "0.1", "image_scale": "1", "sky_size": "32"}


def write_as_recording(
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


def drive_of_recording(root: Path) -> Drive:
    same = drive_of_pandaset(root)
    names = {"car-a": "car", "parked": "parked"}
    boxes = {n: {names[k]: box for k, box in found.items()} for n, found in same.boxes.items()}
    return dataclasses.replace(
        same, scheme="recording", boxes=boxes, car="car", time_atol_ns=0, car_atol_m=1e-6
    )


def edit_calibration(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change calibration.json in place."""
    path = root / "calibration.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def sweep_columns(frame: int, offset: np.ndarray | None = None) -> dict[str, np.ndarray]:
    points, classes, times, _ = street.sweep(frame)
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
        places = {"car": street.car_centre(street.FRAME_S * frame), "parked": street.PARKED_AT}
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


def _frame_entry(frame: int, cameras: tuple[str, ...], offset: np.ndarray) -> dict[str, Any]:
    intrinsics = {"width": street.WIDTH, "height": street.HEIGHT}
    intrinsics |= {"fx": street.FOCAL_PX, "fy": street.FOCAL_PX}
    intrinsics |= {"cx": street.WIDTH / 2, "cy": street.HEIGHT / 2}
    return {
        "frame": frame,
        "timestamp_ns": time_ns(frame),
        "world_from_ego": street.rigid(np.eye(3), street.ego_position(frame) + offset).tolist(),
        "cameras": {
            name: {
                **intrinsics,
                "world_from_camera": street.rigid(
                    street.CAMERAS[name], street.camera_centre(frame) + offset
                ).tolist(),
            }
            for name in cameras
        },
    }


def _write_view(root: Path, name: str, frame: int, *, with_depth: bool) -> None:
    for folder in ("images", "depth") if with_depth else ("images",):
        (root / folder / name).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(root / "images" / name / f"{frame:06d}.png"), street.image(name, frame))
    if with_depth:
        depth_m = street.depth_image(name, frame).astype(np.float32)
        (root / "depth" / name / f"{frame:06d}.png").write_bytes(encode_depth(depth_m))
