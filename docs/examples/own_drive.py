"""Write a drive of your own as a recording, open it as a scene, and render it in fog.

Run it with: python docs/examples/own_drive.py [OUTPUT_FOLDER]
docs/datasets/recording.md lists all files of a recording. The embedded street stands for your car.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from adapters.base import open_scene
from augment import render_view
from recipes.load import load_recipe

STREET = "procedural:street?seed=3&gaussians=60000&frames=4&width=320&height=180"


def write_recording(root: Path) -> None:
    """Write four frames of one camera, with a LiDAR sweep each."""
    street = open_scene(STREET)
    clear = load_recipe("clear").resolve(0)
    (root / "images" / "front").mkdir(parents=True, exist_ok=True)
    (root / "lidar").mkdir(exist_ok=True)
    entries = []
    for frame in street.frames:
        camera = frame.cameras["front"]
        name = f"{frame.index:06d}"
        picture = render_view(street, camera, clear).rgb  # uint8 [H, W, 3]
        cv2.imwrite(str(root / "images" / "front" / f"{name}.png"), picture[..., ::-1])
        returns = street.lidar(frame.index).columns  # x, y, z in the world, timestamp_ns, ...
        columns = {key: returns[key] for key in ("x", "y", "z", "timestamp_ns")}
        pq.write_table(pa.table(columns), root / "lidar" / f"{name}.parquet")
        lens = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        lens["world_from_camera"] = camera.world_from_camera.tolist()  # x right, y down, z forward
        entry = {"frame": frame.index, "timestamp_ns": frame.timestamp_ns}
        entry["world_from_ego"] = frame.world_from_ego.tolist()  # x forward, y left, z up
        entries.append({**entry, "cameras": {"front": lens}})
    (root / "calibration.json").write_text(json.dumps({"frames": entries}))


def main(output_dir: Path) -> None:
    """Write the recording own_drive/, and own_drive.png: an image of it, and the same in fog."""
    write_recording(output_dir / "own_drive")
    scene = open_scene(f"recording:{output_dir}/own_drive?image_scale=1")
    print(f"{len(scene.background)} Gaussians; problems: {scene.problems or 'none'}")
    fog = load_recipe("dense-fog", {"weather.smog.visibility_m": 120}).resolve(0)
    view = render_view(scene, scene.frames[1].cameras["front"], fog)
    recorded = cv2.imread(str(output_dir / "own_drive" / "images" / "front" / "000001.png"))
    path = output_dir / "own_drive.png"
    cv2.imwrite(str(path), np.hstack([recorded, view.rgb[..., ::-1]]))
    print(f"picture: {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
