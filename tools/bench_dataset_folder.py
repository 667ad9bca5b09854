"""Output folders to read in benchmarks: written as a job writes them, without rendering."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from recipes.schema import Output

CAMERAS = ("front", "left", "right", "back")
BOXES = 30
KINDS = 8  # different images; the others are copies of them


def write_folder(folder: Path, images: int, width: int, height: int) -> None:
    """A clear variant of one scene: JPEGs, depth, boxes and calibration, with its manifest."""
    from augment.jobs.files import encode_depth, encode_image

    output = Output(image="jpg", jpeg_quality=92)
    made = [_picture(number, width, height) for number in range(min(KINDS, images))]
    jpegs = [encode_image(rgb, output) for rgb, _ in made]
    depths = [encode_depth(depth_m) for _, depth_m in made]
    frames = -(-images // len(CAMERAS))
    rows = []
    for number in range(images):
        frame, camera = divmod(number, len(CAMERAS))
        row = _row("scene/clear-000", frame, CAMERAS[camera], width, height)
        jpeg = jpegs[number % len(jpegs)]
        row["checksum"] = hashlib.sha256(jpeg).hexdigest()
        for kind, data in (("image", jpeg), ("depth", depths[number % len(depths)])):
            path = folder / row[f"{kind}_path"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        rows.append(row)
    _write_companions(folder / "scene/clear-000", frames, width, height)
    _write_rows(folder, rows)


def write_manifest_of(folder: Path, rows: int) -> None:
    """A manifest of many images that are not there: 80 frames of four cameras a variant."""
    import pyarrow as pa

    from augment.jobs.atomic import write_atomic
    from augment.jobs.layout import MANIFEST
    from augment.jobs.manifest import manifest_bytes, rows_to_table

    each = 80 * len(CAMERAS)
    pieces = []
    for variant in range(-(-rows // each)):
        count = min(each, rows - variant * each)
        name = f"fog-{variant:04d}"
        made = [
            {
                **_row(f"scene/{name}", k // len(CAMERAS), CAMERAS[k % len(CAMERAS)], 960, 540),
                "variant": name,
                "smog_extinction_per_m": 0.001 * variant,
                "checksum": hashlib.sha256(f"{variant} {k}".encode()).hexdigest(),
            }
            for k in range(count)
        ]
        pieces.append(rows_to_table(made))
    write_atomic(folder / MANIFEST, manifest_bytes(pa.concat_tables(pieces)))


def _row(base: str, frame: int, camera: str, width: int, height: int) -> dict[str, Any]:
    from augment.jobs.layout import PATH_KINDS

    stem = f"{camera}/{frame:06d}"
    paths = {
        "image": f"{base}/images/{stem}.jpg",
        "depth": f"{base}/depth/{stem}.png",
        "labels": f"{base}/labels/boxes.parquet",
        "calibration": f"{base}/calibration.json",
    }
    return {
        "scene": "scene",
        "source": "none:scene",
        "variant": "clear-000",
        "frame": frame,
        "camera": camera,
        "timestamp_ns": 10**18 + frame * 100_000_000 + CAMERAS.index(camera),
        **{f"{kind}_path": paths.get(kind) for kind in PATH_KINDS},
        "width": width,
        "height": height,
        "surface": "solid",
        "lidar": None,
        "lidar_note": None,
        "style": None,
        "style_method": None,
        "quality": None,
        "render_scale": 1.0,
        "settings": None,
        "smog_extinction_per_m": 0.0,
        "style_strength": 0.0,
        "seed": 0,
        "recipe": "clear",
        "recipe_hash": "0" * 16,
        "trajectory": "recorded",
        "version": "0",
        "backend": "none",
        "checksum": "",
        "status": "ok",
        "message": "",
    }


def _write_rows(folder: Path, rows: list[dict[str, Any]]) -> None:
    from augment.jobs.atomic import write_atomic
    from augment.jobs.layout import MANIFEST
    from augment.jobs.manifest import manifest_bytes, rows_to_table

    write_atomic(folder / MANIFEST, manifest_bytes(rows_to_table(rows)))


def _write_companions(variant: Path, frames: int, width: int, height: int) -> None:
    from augment.jobs.tables import FrameBoxes, boxes_bytes
    from augment.labels import Boxes

    rng = np.random.default_rng(0)
    names = tuple(f"track-{number}" for number in range(BOXES))
    boxes = Boxes(
        names,
        ("Car",) * BOXES,
        rng.normal(0, 20, (BOXES, 3)),
        rng.uniform(1, 4, (BOXES, 3)),
        np.tile([1.0, 0, 0, 0], (BOXES, 1)),
    )
    (variant / "labels").mkdir(parents=True)
    listed = {frame: FrameBoxes(10**18 + frame * 100_000_000, boxes) for frame in range(frames)}
    (variant / "labels/boxes.parquet").write_bytes(boxes_bytes(listed))
    camera = {
        "timestamp_ns": 10**18, "width": width, "height": height, "fx": width, "fy": width,
        "cx": width / 2, "cy": height / 2, "world_from_camera": np.eye(4).tolist(),
    }  # fmt: skip
    entries = [
        {
            "frame": frame,
            "world_from_ego": np.eye(4).tolist(),
            "cameras": dict.fromkeys(CAMERAS, camera),
        }
        for frame in range(frames)
    ]
    (variant / "calibration.json").write_text(json.dumps({"frames": entries}))


def _picture(number: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Smooth colours with the grain of a photograph, and a road's depth."""
    import cv2

    rng = np.random.default_rng(number)
    coarse = rng.integers(0, 256, (height // 16 + 1, width // 16 + 1, 3), dtype=np.uint8)
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    rgb = np.clip(smooth + rng.normal(0, 4, (height, width, 1)), 0, 255).astype(np.uint8)
    below = np.maximum(np.arange(height) - height / 2, 0)
    depth_m = np.where(below > 4, 1.6 * width / np.maximum(below, 1), 0)
    depth_m = np.repeat(depth_m[:, None], width, axis=1) * (
        1 + rng.normal(0, 0.002, (height, width))
    )
    return rgb, depth_m.astype(np.float32)
