"""A tiny drivestudio run and its processed data, written from the facts of the format alone.

A car drives six frames; the run was trained on frames 1 to 5, of which 4 (position 3) was held out.
`Numbers` holds what the checkpoint does, so that tests can compose images from it by themselves.
"""

from __future__ import annotations

import functools
import json
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation

from tests.adapters.street import rigid, turn

FRAMES, START, COUNT = 6, 1, 5
CAMERAS = (0, 2, 3)  # numbers; the third is 866 pixels high in Waymo
DOWNSCALE = 30
STRIDE = 3
SIZES = {
    "waymo": [(1920, 1280), (1920, 1280), (1920, 866)],
    "nuscenes": [(1600, 900)] * 3,
    "pandaset": [(1920, 1080)] * 3,
    "argoverse": [(1550, 2048), (2048, 1550), (2048, 1550)],
}
LIDAR_COLUMNS = {"waymo": 14, "nuscenes": 4, "pandaset": 5, "argoverse": 4}
FOCAL_PX, DISTORTION = 1900.0, [0.04, -0.2, 0, 0, 0]
# x right, y down, z forward: columns of that camera's axes among x forward, y left, z up
OPENCV_AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
# the same of x right, y forward, z up, as PandaSet has its car and boxes
RIGHT_AXES = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])


@dataclass(frozen=True)
class Numbers:
    """models: as in the checkpoint. model_from_camera [COUNT, 3, 4, 4]: of the data, uncorrected.
    dataset_from_model [4, 4]. flat_from_model [3, 3]: to x forward, y left, z up.
    """

    dataset: str
    folder: Path
    data: Path
    models: dict
    model_from_camera: np.ndarray
    dataset_from_model: np.ndarray
    flat_from_model: np.ndarray


def dataset_from_ego(frame: int) -> np.ndarray:
    return rigid(turn(2, 0.6 + 0.02 * frame), [3000 + 0.9 * frame, -2000 + 0.6 * frame, 55.0])


def ego_from_opencv(position: int) -> np.ndarray:
    """The mounting of a camera, the second and third looking to the right and left."""
    yaw = (0.0, -0.7, 0.9)[position]
    return rigid(turn(2, yaw) @ OPENCV_AXES, [1.5, (0.0, -0.2, 0.3)[position], 1.6])


def quat_of(rotation: np.ndarray) -> np.ndarray:
    """wxyz."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def rotation_of(quat: np.ndarray) -> np.ndarray:
    """Of a wxyz quaternion of any length."""
    return Rotation.from_quat(np.roll(quat, -1)).as_matrix()


def write_as_drivestudio(
    folder: Path, *, dataset: str = "waymo", degree: int = 1, config: dict | None = None
) -> Numbers:
    """The run at folder/run and its data at folder/data/007. config: dotted keys that differ."""
    data, run = folder / "data" / "007", folder / "run"
    run.mkdir(parents=True)
    car_axes = RIGHT_AXES if dataset == "pandaset" else np.eye(3)
    egos = [dataset_from_ego(frame) for frame in range(FRAMES)]
    cameras = [[ego @ ego_from_opencv(p) for p in range(3)] for ego in egos]
    cars = [ego @ rigid(car_axes, [0, 0, 0]) for ego in egos]
    flat_from_model = OPENCV_AXES if dataset == "nuscenes" else car_axes
    dataset_from_model = cameras[START][0] if dataset == "nuscenes" else cars[START]
    model_from_camera = np.stack(
        [[np.linalg.inv(dataset_from_model) @ c for c in row] for row in cameras[START:]]
    )
    models = make_models(np.random.default_rng(3), degree, flat_from_model, car_axes)
    _write_data(data, dataset, cars, cameras)
    _write_objects(data, models["RigidNodes"], dataset_from_model)
    content = {
        "models": models,
        "step": 30000,
        "lpips.net.lin0.weight": torch.zeros(2, 2),  # the trainer's own modules, of no use here
    }
    torch.save(content, run / "checkpoint_final.pth")
    write_config(run, folder / "data", dataset, config or {})
    return Numbers(
        dataset, run, data, models, model_from_camera, dataset_from_model, flat_from_model
    )


def write_config(run: Path, root: Path, dataset: str, changes: dict) -> None:
    content = {
        "seed": 0,
        "trainer": {
            "render": {"antialiased": False, "near_plane": 0.1},
            "gaussian_ctrl_general_cfg": {"sh_degree": 3, "sh_degree_interval": 1000},
        },
        "model": {"Background": {"type": "models.gaussians.VanillaGaussians"}},
        "data": {
            "data_root": str(root),
            "dataset": dataset,
            "scene_idx": 7,
            "start_timestep": START,
            "end_timestep": -1,
            "pixel_source": {
                "cameras": list(CAMERAS),
                "downscale_when_loading": [DOWNSCALE] * 3,
                "undistort": True,
                "test_image_stride": STRIDE,
            },
        },
    }
    for key, value in changes.items():
        *above, last = key.split(".")
        place = content
        for name in above:
            place = place[name]
        if value is None:
            del place[last]
        else:
            place[last] = value
    (run / "config.yaml").write_text(yaml.safe_dump(content))


def make_models(
    rng: np.random.Generator, degree: int, flat_from_model: np.ndarray, box_axes: np.ndarray
) -> dict:
    """The checkpoint's models; places are made x forward, z up, and turned to the model's axes.

    box_axes: of the objects' boxes, in x forward, y left, z up.
    """
    rows = (degree + 1) ** 2 - 1

    def gaussians(means: np.ndarray, size: float) -> OrderedDict:
        count = len(means)
        return OrderedDict(
            _means=floats(means),
            _scales=floats(np.log(rng.uniform(0.3 * size, size, (count, 3)))),
            _quats=floats(rng.normal(size=(count, 4)) * 2),  # not normalised
            _opacities=floats(rng.uniform(-1, 3, (count, 1))),
            _features_dc=floats(rng.uniform(-1, 1, (count, 3))),
            _features_rest=floats(rng.uniform(-0.4, 0.4, (count, rows, 3))),
        )

    def turned(points: np.ndarray) -> np.ndarray:
        return points @ flat_from_model

    ahead = rng.uniform([6, -9, -1], [25, 9, 4], (80, 3))
    background = gaussians(turned(ahead), 0.8)
    rigid_nodes = gaussians(rng.uniform(-0.9, 0.9, (40, 3)), 0.4)
    rigid_nodes["points_ids"] = torch.arange(40)[:, None] % 2
    sizes = np.array([[4.0, 1.8, 1.5], [4.5, 1.9, 1.6]])
    rigid_nodes["instances_size"] = floats(sizes @ np.abs(box_axes))
    visible = torch.ones(COUNT, 2, dtype=torch.bool)
    visible[2, 1] = False
    rigid_nodes["instances_fv"] = visible
    places, quats = np.zeros((COUNT, 2, 3)), np.zeros((COUNT, 2, 4))
    for at in range(COUNT):
        # The held-out pose of the first is far from between its neighbours: it was not trained.
        off = 3.0 if at == STRIDE else 0.0
        places[at] = [[8 + 0.7 * at**1.2 + off, 1.5, 0.3], [13 - 0.5 * at, -2.5, 0.2]]
        for index, heading in enumerate((0.4, 2.9)):
            # Straight ahead: colours that stay with the world cannot be had of what turns.
            rotation = flat_from_model.T @ turn(2, heading) @ box_axes
            quats[at, index] = quat_of(rotation) * (1.3 + at)
    rigid_nodes["instances_trans"] = floats(turned(places))
    rigid_nodes["instances_quats"] = floats(quats)
    images = COUNT * len(CAMERAS)
    return {
        "Background": background,
        "RigidNodes": rigid_nodes,
        "SMPLNodes": OrderedDict(_means=torch.zeros(7, 3), smpl_qauts=torch.zeros(1, 1, 23, 4)),
        "DeformableNodes": OrderedDict(_means=torch.zeros(5, 3)),
        "Sky": OrderedDict(base=floats(rng.uniform(0, 1.1, (6, 8, 8, 3)))),
        "Affine": OrderedDict(
            {
                "embedding.weight": floats(rng.normal(size=(images, 4)) * 0.3),
                "decoder.0.weight": floats(rng.normal(size=(16, 4)) * 0.4),
                "decoder.0.bias": floats(rng.normal(size=16) * 0.2),
                "decoder.2.weight": floats(rng.normal(size=(12, 16)) * 0.1),
                "decoder.2.bias": floats(rng.normal(size=12) * 0.05),
            }
        ),
        "CamPose": OrderedDict(
            {
                "embeds.weight": floats(rng.normal(size=(images, 9)) * 0.03),
                "identity": torch.tensor([1.0, 0, 0, 0, 1, 0]),
            }
        ),
    }


def floats(values) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, np.float32).copy())


def _write_data(data: Path, dataset: str, cars: list, cameras: list) -> None:
    is_fixed = dataset in ("waymo", "argoverse")
    for name in ("images", "extrinsics", "intrinsics", "lidar", "instances"):
        (data / name).mkdir(parents=True)
    poses = data / ("lidar_pose" if dataset == "nuscenes" else "ego_pose")
    poses.mkdir()
    for position, number in enumerate(CAMERAS):
        width, height = SIZES[dataset][position]
        values = [FOCAL_PX, FOCAL_PX * 1.02, 0.49 * width, 0.52 * height, *DISTORTION]
        if dataset != "waymo":
            values[4:] = [0] * 5
        np.savetxt(data / "intrinsics" / f"{number}.txt", values)
        if is_fixed:
            axes = OPENCV_AXES.T if dataset == "waymo" else np.eye(3)
            mounting = ego_from_opencv(position) @ rigid(axes, [0, 0, 0])
            np.savetxt(data / "extrinsics" / f"{number}.txt", mounting)
    for frame in range(FRAMES):
        np.savetxt(poses / f"{frame:03d}.txt", cars[frame])
        for position, number in enumerate(CAMERAS):
            file = data / "images" / f"{frame:03d}_{number}.jpg"
            file.write_bytes(picture(*SIZES[dataset][position]))
            if not is_fixed:
                name = f"{frame:03d}_{number}.txt"
                np.savetxt(data / "extrinsics" / name, cameras[frame][position])
        lidar_rows(dataset, frame).tofile(data / "lidar" / f"{frame:03d}.bin")


@functools.cache
def picture(width: int, height: int) -> bytes:
    """A black JPEG file."""
    return cv2.imencode(".jpg", np.zeros((height, width, 3), np.uint8))[1].tobytes()


def lidar_rows(dataset: str, frame: int) -> np.ndarray:
    shape = (9, LIDAR_COLUMNS[dataset])
    return np.random.default_rng(100 + frame).uniform(-20, 20, shape).astype("<f4")


def _write_objects(data: Path, rigid_nodes: dict, dataset_from_model: np.ndarray) -> None:
    """A pedestrian first, then the model's two in the other order, each a hand's breadth away."""
    walk = [rigid(np.eye(3), [3000.0, -2000.0, 55.0]).tolist()] * FRAMES
    info = {"0": _object("walker", "Pedestrian", range(FRAMES), walk, [0.6, 0.6, 1.8])}
    for key, index in (("1", 1), ("2", 0)):
        frames, poses = [], []
        for at in range(COUNT):
            if bool(rigid_nodes["instances_fv"][at, index]):
                quat = rigid_nodes["instances_quats"][at, index].double().numpy()
                place = rigid_nodes["instances_trans"][at, index].double().numpy()
                place = place + np.array([0.06, 0, 0.02])
                frames.append(START + at)
                poses.append((dataset_from_model @ rigid(rotation_of(quat), place)).tolist())
        size = rigid_nodes["instances_size"][index].double().tolist()
        info[key] = _object(f"car-{'ab'[index]}", "Vehicle", frames, poses, size)
    (data / "instances" / "instances_info.json").write_text(json.dumps(info))


def _object(name: str, label: str, frames, poses: list, size: list) -> dict:
    notes = {"frame_idx": list(frames), "obj_to_world": poses, "box_size": [size] * len(poses)}
    return {"id": name, "class_name": label, "frame_annotations": notes}
