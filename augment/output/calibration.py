"""`calibration.json`: poses of all cameras of all frames, in the dataset's own world.

In: frames, cameras and the origin of the scene's world. Out: entries of the file and its bytes;
`read_entries` and `read_camera` read them back. `trajectory_id` is the identity of a camera path in
the manifest.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment.errors import OutputError
from augment.files.lens_records import lens_of_record, optics_record, shutter_of_record
from augment.output.atomic import read_file
from augment.output.tables import checked_int
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid
from augment.scene.lenses import Lens
from augment.scene.scene_index import SceneIndex
from augment.scene.shutter import RollingShutter

# Explanations that the file itself carries.
CONVENTIONS = {
    "world": "the dataset's own: metres, right-handed, +z up; boxes and LiDAR are given in it too",
    "world_origin_m": "subtracted from the dataset's world while rendering, already added back in "
    "every pose here",
    "world_from_camera": "4x4, row by row: p_world = world_from_camera @ p_camera. Camera axes are "
    "OpenCV's: x right, y down, z forward",
    "world_from_ego": "4x4, row by row. Ego axes: x forward, y left, z up",
    "intrinsics": "pinhole without distortion, pixels of the written images: "
    "u = fx x / z + cx, v = fy y / z + cy, where the centre of the first pixel is (0.5, 0.5)",
    "timestamp_ns": "of a frame: its reference time; of a camera: when its image was taken",
    "depth": "uint16 PNG, metres x 256 along the optical axis, 0 = none",
}
# Explanations in place of these, and beside them, in a file with cameras that are no pinholes.
LENS_CONVENTIONS = {
    "intrinsics": "pixels of the written images, where the centre of the first pixel is (0.5, 0.5)."
    " A camera without a lens is a pinhole: u = fx x / z + cx, v = fy y / z + cy. With a lens, fx, "
    "fy, cx, cy are the numbers of its model",
    "lens": "model opencv: as cv2.projectPoints, coefficients k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4; "
    "opencv_fisheye: as cv2.fisheye, k1 to k4; ftheta: polynomials between the angle in radians and"
    " the distance in pixels of the calibrated image, whose slope at the axis is fx of that image. "
    "Coefficients that are left out are 0. OpenCV's own pixel coordinates are smaller by 0.5",
    "shutter": "read-out of rows or columns one after another, within duration_ns. "
    "world_from_camera and timestamp_ns are of its middle; start_from_camera and end_from_camera, "
    "4x4, take points from the camera's axes then to those at the start and the end",
    "depth": "uint16 PNG, metres x 256, 0 = none: along the optical axis, and with a lens of model "
    "opencv_fisheye or ftheta along each pixel's ray",
}


@dataclass(frozen=True, eq=False)
class CameraRecord:
    """One camera at one time."""

    name: str
    """Name of the camera."""
    width: int
    """Width of the image, pixels."""
    height: int
    """Height of the image, pixels."""
    timestamp_ns: int
    """Time at which the image was taken."""
    K: torch.Tensor
    """Intrinsics, float64 [3, 3], pixels; with a lens, the numbers that its model takes."""
    world_from_camera: torch.Tensor
    """Pose in the dataset's world, float64 [4, 4]."""
    lens: Lens | None = None
    """Lens; None for a pinhole."""
    shutter: RollingShutter | None = None
    """Rolling shutter; None if all pixels are exposed at `timestamp_ns`."""

    @property
    def camera(self) -> Camera:
        """Return the camera in the dataset's world."""
        (fx, _, cx), (_, fy, cy), _ = self.K.tolist()
        return Camera(
            self.name,
            *(self.width, self.height, fx, fy, cx, cy),
            camera_from_world=invert_rigid(self.world_from_camera),
            timestamp_ns=self.timestamp_ns,
            lens=self.lens,
            shutter=self.shutter,
        )


def camera_record(camera: Camera, world_origin_m: np.ndarray) -> CameraRecord:
    """Return the record of a camera at its written resolution, in the dataset's world."""
    return CameraRecord(
        camera.name,
        camera.width,
        camera.height,
        camera.timestamp_ns,
        camera.without_lens().K,
        _in_dataset(camera.world_from_camera, world_origin_m),
        camera.lens,
        camera.shutter,
    )


def frame_entry(
    frame: Frame, names: Iterable[str], scale: float, world_origin_m: np.ndarray
) -> dict[str, Any]:
    """Return the JSON entry of a frame with some of its cameras.

    Args:
        names: Camera names.
        scale: Value of recipe.render.scale.
    """
    cameras = {}
    for name in sorted(names):
        camera = frame.cameras[name].scaled(scale)
        record = camera_record(camera, world_origin_m)
        (fx, _, cx), (_, fy, cy), _ = record.K.tolist()
        cameras[name] = {
            **{key: getattr(record, key) for key in ("timestamp_ns", "width", "height")},
            **{"fx": fx, "fy": fy, "cx": cx, "cy": cy},
            "world_from_camera": record.world_from_camera.tolist(),
            **optics_record(camera),
        }
    return {
        "frame": frame.index,
        "timestamp_ns": frame.timestamp_ns,
        "world_from_ego": _in_dataset(frame.world_from_ego, world_origin_m).tolist(),
        "cameras": cameras,
    }


def calibration_bytes(
    index: SceneIndex, variant: str, trajectory: str, entries: Mapping[int, Mapping[str, Any]]
) -> bytes:
    """Return the file's text, ordered by frame and camera; floats keep all their digits."""
    has_lens = any(
        "lens" in camera or "shutter" in camera
        for entry in entries.values()
        for camera in entry["cameras"].values()
    )
    content = {
        "scene": index.name,
        "source": index.source,
        "variant": variant,
        "trajectory": trajectory,
        "conventions": CONVENTIONS | (LENS_CONVENTIONS if has_lens else {}),
        "has_metric_scale": index.has_metric_scale,
        "world_origin_m": index.world_origin_m.tolist(),
        "frames": [entries[number] for number in sorted(entries)],
    }
    return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()


def read_entries(path: Path) -> dict[int, dict[str, Any]]:
    """Return the frame entries of a calibration file by frame number."""
    try:
        frames = json.loads(read_file(path))["frames"]
        return {entry["frame"]: entry for entry in frames}
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise OutputError(f"{path} is missing or not a calibration file: {error!r}") from error


def read_camera(entry: Mapping[str, Any], name: str) -> CameraRecord:
    """Return one camera of a frame entry.

    Raises:
        KeyError: The entry lacks the camera or one of its numbers.
        ValueError, TypeError, RuntimeError: A value is not a number.
    """
    camera = entry["cameras"][name]
    rows = [[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]]
    return CameraRecord(
        name,
        checked_int(camera["width"]),
        checked_int(camera["height"]),
        checked_int(camera["timestamp_ns"]),
        torch.tensor(rows, dtype=torch.float64),
        torch.tensor(camera["world_from_camera"], dtype=torch.float64),
        lens_of_record(camera["lens"]) if "lens" in camera else None,
        shutter_of_record(camera["shutter"]) if "shutter" in camera else None,
    )


def _in_dataset(world_from_x: torch.Tensor, world_origin_m: np.ndarray) -> torch.Tensor:
    """Return a pose moved from the scene's world to the dataset's."""
    pose = world_from_x.clone()
    pose[:3, 3] += torch.from_numpy(world_origin_m)
    return pose


# ---- The identity of a camera path in the manifest -----------------------------------------------

# Trajectory of a scene's own frames.
RECORDED = "recorded"
# Numbers of a camera that decide the identity of a path.
_CAMERA_NUMBERS = ("name", "timestamp_ns", "width", "height", "fx", "fy", "cx", "cy")


def trajectory_id(camera_path: Sequence[Frame] | None) -> str:
    """Return the identity of a camera path in the manifest.

    It is `recorded` for a scene's own frames; otherwise `path-` and 16 hex digits of the SHA-256 of
    the path as JSON, exact to the last bit.
    """
    if camera_path is None:
        return RECORDED
    frame_entries = [
        {
            "index": frame.index,
            "timestamp_ns": frame.timestamp_ns,
            "world_from_ego": frame.world_from_ego.tolist(),
            "cameras": [
                {
                    **{name: getattr(camera, name) for name in _CAMERA_NUMBERS},
                    "camera_from_world": camera.camera_from_world.tolist(),
                    **optics_record(camera),
                }
                for camera in frame.cameras.values()
            ],
        }
        for frame in camera_path
    ]
    text = json.dumps({"frames": frame_entries}, indent=1)
    return "path-" + hashlib.sha256(text.encode()).hexdigest()[:16]
