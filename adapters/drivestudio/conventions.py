"""What drivestudio's processed data of each dataset means: cameras, axes, worlds, LiDAR columns.

Facts of the project's loaders and of its table of image sizes, to which it resizes whatever images
it finds. The model's world is the first frame's pose of `world`, undone.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from augment.errors import AdapterError

# Rows: x forward, y left, z up, in OpenCV's camera axes x right, y down, z forward.
FLAT_FROM_OPENCV = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
# Columns: x forward, y left, z up, in axes x right, y forward, z up.
_RIGHT_FORWARD_FROM_FLAT = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@dataclass(frozen=True)
class CameraKind:
    """A camera as the dataset has it. width, height: pixels that its intrinsics are given for."""

    name: str
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Convention:
    """How one dataset's processed data is to be read.

    cameras: by number. lidar_columns: of lidar/{frame}.bin, float32. poses_per_frame:
    extrinsics/{frame}_{camera}.txt is world_from_camera; else extrinsics/{camera}.txt is
    ego_from_camera. world_of_front_camera: the model's world is camera 0's first frame, else the
    first ego_pose. camera_from_opencv: [3, 3], the axes of the extrinsics. scene_from_model:
    [3, 3], a permutation of axes that turns the model's world z up, as far as the car stands level.
    pose_from_ego: [3, 3], ego axes (x forward, y left, z up) in those of ego_pose, or of camera 0
    where that is the world's. object_from_actor: [3, 3], x forward, y left, z up in the axes of its
    boxes.
    """

    cameras: tuple[CameraKind, ...]
    lidar_columns: tuple[str, ...]
    poses_per_frame: bool = False
    world_of_front_camera: bool = False
    camera_from_opencv: np.ndarray = field(default_factory=lambda: np.eye(3))
    scene_from_model: np.ndarray = field(default_factory=lambda: np.eye(3))
    pose_from_ego: np.ndarray = field(default_factory=lambda: np.eye(3))
    object_from_actor: np.ndarray = field(default_factory=lambda: np.eye(3))


def convention_of(dataset: str, where: str) -> Convention:
    """The convention of `data.dataset`; where: the file that says so, for messages.

    Raises:
        AdapterError: a dataset that is not known here.
    """
    found = _CONVENTIONS.get(dataset.lower())
    if found is None:
        raise AdapterError(
            f"{where}: data.dataset is {dataset!r}; its axes are not known here. Known datasets: "
            f"{', '.join(_CONVENTIONS)}"
        )
    return found


def _cameras(width: int, height: int, *names: str) -> tuple[CameraKind, ...]:
    return tuple(CameraKind(name, width, height) for name in names)


_XYZI = ("x", "y", "z", "intensity")
_CONVENTIONS = {
    "waymo": Convention(
        cameras=(
            *_cameras(1920, 1280, "front_camera", "front_left_camera", "front_right_camera"),
            *_cameras(1920, 866, "left_camera", "right_camera"),
        ),
        lidar_columns=(
            *("origin_x", "origin_y", "origin_z", "x", "y", "z", "flow_x", "flow_y", "flow_z"),
            *("flow_class", "ground", "intensity", "elongation", "laser_id"),
        ),
        camera_from_opencv=FLAT_FROM_OPENCV,
    ),
    "nuscenes": Convention(
        cameras=_cameras(
            *(1600, 900, "CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"),
            *("CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_BACK"),
        ),
        lidar_columns=_XYZI,
        poses_per_frame=True,
        world_of_front_camera=True,
        scene_from_model=FLAT_FROM_OPENCV,
        pose_from_ego=FLAT_FROM_OPENCV.T,
    ),
    "pandaset": Convention(
        cameras=_cameras(
            *(1920, 1080, "front_camera", "front_left_camera", "front_right_camera"),
            *("left_camera", "right_camera", "back_camera"),
        ),
        lidar_columns=(*_XYZI, "laser_id"),
        poses_per_frame=True,
        pose_from_ego=_RIGHT_FORWARD_FROM_FLAT,
        object_from_actor=_RIGHT_FORWARD_FROM_FLAT,
    ),
    "argoverse": Convention(
        cameras=(
            CameraKind("ring_front_center", 1550, 2048),
            *_cameras(2048, 1550, "ring_front_left", "ring_front_right", "ring_side_left"),
            *_cameras(2048, 1550, "ring_side_right", "ring_rear_left", "ring_rear_right"),
        ),
        lidar_columns=_XYZI,
    ),
    "kitti": Convention(cameras=_cameras(1242, 375, "CAM_LEFT", "CAM_RIGHT"), lidar_columns=_XYZI),
    "nuplan": Convention(
        cameras=_cameras(
            *(1920, 1080, "CAM_F0", "CAM_L0", "CAM_R0", "CAM_L1"),
            *("CAM_R1", "CAM_L2", "CAM_R2", "CAM_B0"),
        ),
        lidar_columns=(*_XYZI, "ring", "lidar_id"),
    ),
}
