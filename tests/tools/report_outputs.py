"""Small output folders for reports: made of rows and files, nothing is rendered."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from augment.output.box_weather import box_tables
from augment.output.codecs import encode_depth, encode_ids, encode_image
from augment.output.layout import path_kinds
from augment.output.manifest import rows_to_table, write_manifest
from augment.output.tables import FrameBoxes, boxes_bytes, parquet_bytes
from augment.scene.labels import Boxes
from recipes.schema import Output

HEIGHT, WIDTH = 24, 40
CAMERAS = ("front", "left")
Rows = list[dict[str, Any]]


def make_row(
    scene: str = "street",
    recipe: str = "clear",
    variant: int = 0,
    frame: int = 0,
    camera: str = "front",
    **changes: Any,
) -> dict[str, Any]:
    """A row without weather, whose image is not there yet."""
    paths = {f"{kind}_path": None for kind in path_kinds()}
    row: dict[str, Any] = {"scene": scene, "source": f"procedural:{scene}", **paths}
    row |= {"variant": f"{recipe}-{variant:03d}", "frame": frame, "camera": camera}
    row |= {"timestamp_ns": frame, "width": WIDTH, "height": HEIGHT, "surface": "solid"}
    row |= {"style": None, "style_method": None, "quality": None, "base": "splats"}
    row |= {"render_scale": 1.0, "trusted_fraction": None, "lens_drops_fraction": None}
    row |= {"settings": None, "lidar": None, "lidar_note": None, "smog_extinction_per_m": 0.0}
    row |= {"flood_level_m": math.nan, "snow_depth_m": math.nan, "snow_coverage": math.nan}
    row |= {"style_strength": 0.0, "seed": 3, "recipe": recipe, "recipe_hash": "0"}
    row |= {"trajectory": "recorded", "version": "1.2.3", "backend": "cpu", "checksum": ""}
    return row | {"status": "ok", "message": ""} | changes


def write_output(out: Path, rows: Rows, *, buffers: bool = True, lidar: bool = False) -> Path:
    """The files of every finished row that names none, and the manifest."""
    for row in rows:
        if row["status"] == "ok" and row["image_path"] is None:
            _write_files(out, row, buffers=buffers, lidar=lidar)
    write_manifest(out, rows_to_table(rows))
    return out


def street_rows(scenes: int = 2, frames: int = 2) -> Rows:
    """Clear, three draws of fog, and snow under water, in two cameras."""
    weather: dict[tuple[str, int], dict[str, float]] = {("clear", 0): {}}
    weather |= {("fog", i): {"smog_extinction_per_m": 0.02 * 3**i} for i in range(3)}
    weather["wet", 0] = {"flood_level_m": -0.1, "snow_depth_m": 0.25, "snow_coverage": 0.5}
    return [
        make_row(f"street-{scene}", *variant, frame, camera, **numbers)
        for scene in range(scenes)
        for variant, numbers in weather.items()
        for frame in range(frames)
        for camera in CAMERAS
    ]


def _write_files(out: Path, row: dict[str, Any], *, buffers: bool, lidar: bool) -> None:
    base, stem = f"{row['scene']}/{row['variant']}", f"{row['camera']}/{row['frame']:06d}"
    shade = 30 + 37 * (len(row["variant"]) + row["frame"]) % 200
    image = encode_image(np.full((HEIGHT, WIDTH, 3), shade, np.uint8), Output())
    row["checksum"] = hashlib.sha256(image).hexdigest()
    files: dict[str, tuple[str, bytes]] = {"image": (f"{base}/images/{stem}.png", image)}
    if buffers:
        depth = np.linspace(2, 80, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
        classes = np.repeat(np.array([14, 6, 1], np.uint8), HEIGHT // 3)[:, None]
        classes = np.ascontiguousarray(np.broadcast_to(classes, (HEIGHT, WIDTH)))
        files["depth"] = (f"{base}/depth/{stem}.png", encode_depth(depth))
        files["semantic"] = (f"{base}/semantic/{stem}.png", encode_ids(classes, np.uint8))
        files["labels"] = (f"{base}/labels/boxes.parquet", _boxes(row["frame"]))
        files |= _box_weather(row, base)
    if lidar and row["recipe"] != "clear":
        sweep = pa.table({"x": np.zeros(5), "weather_code": np.array([0, 0, 1, 2, 9], np.uint8)})
        files["lidar"] = (f"{base}/lidar/{row['frame']:06d}.parquet", parquet_bytes(sweep, {}))
    for kind, (path, data) in files.items():
        row[f"{kind}_path"] = path
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        (out / path).write_bytes(data)


def _boxes(frame: int) -> bytes:
    places = np.zeros((3, 3)), np.ones((3, 3)), np.tile([1.0, 0, 0, 0], (3, 1))
    return boxes_bytes(
        {frame: FrameBoxes(0, Boxes(("a", "b", "c"), ("Car", "Car", "Bus"), *places))}
    )


def _box_weather(row: dict[str, Any], base: str) -> dict[str, tuple[str, bytes]]:
    """Of one image: the last to be written stands for its variant."""
    item, ids, shown = (row["frame"], row["camera"]), ("a", "b", "c"), [100, 50, 0]
    stored: dict[str, list] = {}
    if row["smog_extinction_per_m"]:
        stored["smog"] = [ids, [0.9, 0.1, 0.3], shown]
    if not math.isnan(row["flood_level_m"]):
        stored["water"] = [ids, [0.5, 0.0, 0.0], shown, [50, 0, 0]]
    if not math.isnan(row["snow_depth_m"]):
        stored["snow"] = [ids, shown, [50, 50, 0]]
    tables = {name: box_tables()[f"box_{name}"] for name in stored}
    return {
        f"box_{n}": (f"{base}/labels/{n}.parquet", t.to_bytes({item: t.from_json(stored[n])}))
        for n, t in tables.items()
    }
