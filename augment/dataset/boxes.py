"""Boxes for training: in the frame of the world, the car or the camera, and as 2D boxes.

Quaternions are wxyz. A box's own axes: x along its length, y its width, z its height.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from augment.batch.box_weather import TABLES, BoxWeather, visibility
from augment.boxes_2d import outline_boxes
from augment.geometry import rotmat_from_quat
from augment.labels import Boxes

BoxFrame = Literal["world", "ego", "camera"]
BOX_FRAMES = ("world", "ego", "camera")


@dataclass(frozen=True, eq=False)
class Boxes2d:
    """Boxes in the image. xyxy: float32 [B, 4], pixels, left, top, right, bottom, inside the image
    (0 to its width and height; the first pixel's centre is at 0.5); zeros of boxes out of view.
    in_view: bool [B], whether any of the box lies in the image, hidden by others or not.
    """

    xyxy: torch.Tensor
    in_view: torch.Tensor


def box_tensors(
    boxes: Boxes,
    weather: BoxWeather,
    box_frame: BoxFrame,
    world_from_frame: np.ndarray,
    *,
    instances: np.ndarray | None = None,
) -> dict[str, Any]:
    """centers_m [B, 3], sizes_m [B, 3] (length, width, height), quats [B, 4] (wxyz,
    frame_from_box): float64 tensors in `frame`, which is `box_frame`. labels, track_ids: lists of
    strings. attributes: the dataset's further columns, NumPy arrays by name.

    instance: int32 [B], the objects' numbers in instance images. modal_xyxy: float32 [B, 4], as
    `Boxes2d.xyxy`, but of the pixels that show a box; NaN where none does. visible_fraction:
    float64 [B], of the pixels that show a box or what stands before it; NaN where there are
    neither. truncated_fraction: float64 [B], of the projected box's area, outside the image. All
    four None where the output is older than they.

    submerged_fraction, hidden_fraction: float64 [B], how much of a box's height is under water,
    and of its pixels behind water (NaN where the image shows none); None where there is no flood.
    snow_fraction: float64 [B], how much of its pixels is snow (as above); None without snow.
    transmittance: float64 [B], of the smog before the box, 0 to 1; None without smog.
    visibility: float64 [B], what all of that leaves of the box, 0 to 1
    (`augment.batch.box_weather.visibility`).

    world_from_frame: float64 [4, 4]; unused where the frame is the world, whose numbers keep their
    bits.
    """
    centers_m, quats = boxes.centers_m.copy(), boxes.quats.copy()
    if box_frame != "world":
        centers_m = moved_points(centers_m, world_from_frame)
        quats = _turned(quats, world_from_frame)
    fractions = {
        name: torch.from_numpy(getattr(weather[kind], name).copy()) if kind in weather else None
        for kind, table in TABLES.items()
        for name in table.sampled
    }
    return {
        "frame": box_frame,
        "centers_m": torch.from_numpy(centers_m),
        "sizes_m": torch.from_numpy(boxes.sizes_m.copy()),
        "quats": torch.from_numpy(quats),
        "labels": list(boxes.labels),
        "track_ids": list(boxes.track_ids),
        "attributes": dict(boxes.attributes),
        "instance": None if instances is None else torch.from_numpy(instances.astype(np.int32)),
        **fractions,
        "visibility": torch.from_numpy(visibility(weather, len(boxes))),
    }


def moved_points(points_m: np.ndarray, world_from_frame: np.ndarray) -> np.ndarray:
    """Points of the world [N, 3] in another frame."""
    with np.errstate(invalid="ignore"):  # of points that are not finite, and stay so
        return (points_m - world_from_frame[:3, 3]) @ world_from_frame[:3, :3]


def boxes_2d(sample: Mapping[str, Any]) -> Boxes2d:
    """A sample's boxes as the image shows them: bounds of what lies inside the image, tight.

    They enclose the projected box cut off at the image's borders, not the projected corners, whose
    bounds are wider for a box that a border cuts. Weather and what hides a box change nothing. A
    box whose numbers are not finite is out of view.

    Raises:
        ValueError: the sample has no boxes.
    """
    boxes, camera = sample["boxes"], sample["camera"]
    if boxes is None:
        raise ValueError(
            f"scene {sample['scene']!r}, frame {sample['frame']}: the sample has no boxes; open "
            f"the dataset with 'boxes' in load, of a variant whose recipe writes labels"
        )
    centers_m, quats = boxes_in_camera(boxes, camera)
    rotations = rotmat_from_quat(torch.from_numpy(quats)).numpy()  # NaN of quaternions of zeros
    size = (camera["width"], camera["height"])
    outlines = outline_boxes(
        centers_m, boxes["sizes_m"].numpy(), rotations, camera["K"].numpy(), size
    )
    return Boxes2d(
        torch.from_numpy(outlines.xyxy.astype(np.float32)), torch.from_numpy(outlines.in_view)
    )


def boxes_in_camera(
    boxes: Mapping[str, Any], camera: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    """centers_m [B, 3] and quats [B, 4] of a sample's boxes in its camera's frame, float64,
    whatever frame they are in.
    """
    centers_m, quats = boxes["centers_m"].numpy(), boxes["quats"].numpy()
    if boxes["frame"] == "camera":
        return centers_m, quats
    frame_from_camera = camera["world_from_camera"].numpy()
    if boxes["frame"] == "ego":
        frame_from_camera = inverted(camera["world_from_ego"].numpy()) @ frame_from_camera
    return moved_points(centers_m, frame_from_camera), _turned(quats, frame_from_camera)


def inverted(transform: np.ndarray) -> np.ndarray:
    """The inverse of a rigid transform [4, 4]."""
    inverse = np.eye(4)
    inverse[:3, :3] = transform[:3, :3].T
    inverse[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return inverse


def _turned(quats: np.ndarray, world_from_frame: np.ndarray) -> np.ndarray:
    """Rotations world_from_box as frame_from_box; the quaternions keep their norms."""
    x, y, z, w = Rotation.from_matrix(world_from_frame[:3, :3].T).as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    with np.errstate(invalid="ignore"):
        return quats @ left.T
