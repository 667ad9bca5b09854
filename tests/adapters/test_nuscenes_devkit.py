"""The official devkit reads the datasets that the tests write, and agrees on boxes and returns.

It needs NumPy 1 and an OpenCV of its own, so it runs in an environment beside this one.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import nuscenes_files as files
import pytest

from adapters.nuscenes.adapter import nuscenes_labels
from adapters.nuscenes.tables import frame_tokens

VARIABLE = "CLIMATEGS_NUSCENES_DEVKIT"
SCRIPT = """
import json, os, sys
import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from pyquaternion import Quaternion

data = NuScenes(version="v1.0-mini", dataroot=sys.argv[1], verbose=False)
rows = {}
for row in data.sample_data:
    assert os.path.isfile(data.get_sample_data_path(row["token"])), row["filename"]
    found = {"channel": row["channel"], "boxes": [
        [*box.center, *box.wlh, *box.orientation.rotation_matrix.ravel(), box.name, box.token]
        for box in data.get_boxes(row["token"])
    ]}
    if row["channel"] == "LIDAR_TOP":
        cloud = LidarPointCloud.from_file(data.get_sample_data_path(row["token"]))
        for table in ("calibrated_sensor", "ego_pose"):
            pose = data.get(table, row[table + "_token"])
            cloud.rotate(Quaternion(pose["rotation"]).rotation_matrix)
            cloud.translate(np.array(pose["translation"]))
        found["points"] = cloud.points[:3, ::97].T.tolist()
        found["count"] = cloud.points.shape[1]
    rows[row["token"]] = found
for sample in data.sample:
    for token in sample["data"].values():
        assert os.path.isfile(data.get_sample_data(token)[0])
for table in data.map:
    assert os.path.isfile(table["mask"].img_file)
print(json.dumps({"scenes": [scene["name"] for scene in data.scene], "rows": rows}))
"""


@pytest.fixture(scope="module")
def python() -> str:
    path = os.environ.get(VARIABLE)
    if not path:
        pytest.skip(
            f"{VARIABLE} is not set to the Python of an environment with the official devkit; make "
            f"one: python -m venv devkit && devkit/bin/pip install nuscenes-devkit==1.2.0, then "
            f"{VARIABLE}=devkit/bin/python"
        )
    return path


def read_by_devkit(python: str, root: Path) -> dict:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [python, "-c", SCRIPT, str(root)],
        capture_output=True, text=True, timeout=300, env=environment, cwd=root,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


def assert_same_labels(found: dict, root: Path, query: dict[str, str]) -> None:
    labels = nuscenes_labels(str(root), query)
    for number, channels in frame_tokens(str(root), query).items():
        theirs = found["rows"][channels["LIDAR_TOP"].token]
        boxes, sweep = labels.boxes(number), labels.lidar(number)
        assert len(boxes) == len(theirs["boxes"]) and len(sweep) == theirs["count"]
        # Their returns are float32 in the global world: a tenth of a millimetre at 2 km.
        np.testing.assert_allclose(sweep.points_m[::97], theirs["points"], atol=1e-3)
        for i, box in enumerate(theirs["boxes"]):
            assert (boxes.labels[i], boxes.attributes["token"][i]) == (box[15], box[16])
            np.testing.assert_allclose(boxes.centers_m[i], box[:3], atol=1e-9)
            np.testing.assert_array_equal(boxes.sizes_m[i][[1, 0, 2]], box[3:6])
            w, x, y, z = boxes.quats[i] / np.linalg.norm(boxes.quats[i])
            forward = [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)]
            np.testing.assert_allclose(forward, np.reshape(box[6:15], (3, 3))[:, 0], atol=1e-7)


def test_the_devkit_reads_the_street(python, tmp_path):
    root = files.write_dataset(tmp_path / "data")
    found = read_by_devkit(python, root)
    assert found["scenes"] == list(files.SCENES)
    per_scene = files.SWEEPS + files.IMAGES * len(files.CAMERAS)
    assert len(found["rows"]) == per_scene * len(files.SCENES)
    for scene in files.SCENES:
        assert_same_labels(found, root, {"scene": scene})


def test_the_devkit_reads_the_real_keyframe(python, shared_dir, tmp_path):
    source = shared_dir / "data/nuscenes_keyframe"
    if not (source / "info.json").is_file():
        pytest.skip(f"no nuScenes keyframe at {source}")
    root = files.write_keyframe(tmp_path / "data", source)
    found = read_by_devkit(python, root)
    assert len(found["rows"]) == 7
    assert_same_labels(found, root, {})
