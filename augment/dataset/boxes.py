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
from augment.box_pixels import CORNERS, EDGES, NEAR_M, cut_edges
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
    boxes: Boxes, weather: BoxWeather, box_frame: BoxFrame, world_from_frame: np.ndarray
) -> dict[str, Any]:
    """centers_m [B, 3], sizes_m [B, 3] (length, width, height), quats [B, 4] (wxyz,
    frame_from_box): float64 tensors in `frame`, which is `box_frame`. labels, track_ids: lists of
    strings. attributes: the dataset's further columns, NumPy arrays by name.

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
    rotations = _rotations(quats)
    sizes_m = boxes["sizes_m"].numpy()
    numbers = np.concatenate([centers_m, sizes_m, rotations.reshape(-1, 9)], axis=1)
    finite = np.logical_and.reduce(np.isfinite(numbers), axis=1)
    centers_m, sizes_m = np.where(finite[:, None], (centers_m, sizes_m), 0.0)
    rotations = np.where(finite[:, None, None], rotations, np.eye(3))
    corners_m = centers_m[:, None] + (CORNERS * sizes_m[:, None]) @ rotations.transpose(0, 2, 1)
    size = np.array([camera["width"], camera["height"]], np.float64)
    K = camera["K"].numpy()
    ends, seen = _edges_in_image(corners_m, K, size)  # [B, E, 2]
    points = np.concatenate(
        [ends, np.broadcast_to(_image_corners(size), (len(ends), 4, 2))], axis=1
    )
    shown = [seen, _hit(centers_m, sizes_m, rotations, _image_corners(size), K)]
    shown = np.concatenate(shown, axis=1)[..., None]
    low = np.where(shown, points, np.inf).min(axis=1, initial=np.inf)
    high = np.where(shown, points, -np.inf).max(axis=1, initial=-np.inf)
    in_view = finite & (high > low).all(axis=1)
    xyxy = np.where(in_view[:, None], np.concatenate([low, high], axis=1), 0.0)
    return Boxes2d(torch.from_numpy(xyxy.astype(np.float32)), torch.from_numpy(in_view))


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


def _rotations(quats: np.ndarray) -> np.ndarray:
    """[B, 3, 3]; NaN of quaternions that are zero or not finite."""
    with np.errstate(invalid="ignore", divide="ignore"):
        w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return np.moveaxis(np.array(rows), -1, 0)


def _edges_in_image(
    corners_m: np.ndarray, K: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of those parts of the boxes' edges that the image shows.

    corners_m: [B, 8, 3], camera frame. Returns pixels [B, 24, 2] and whether an edge has such a
    part [B, 24].
    """
    a, b = corners_m[:, EDGES[:, 0]], corners_m[:, EDGES[:, 1]]  # [B, 12, 3]
    seen = np.maximum(a[..., 2], b[..., 2]) > NEAR_M
    a, b = _project(cut_edges(a, b), K), _project(cut_edges(b, a), K)  # [B, 12, 2]
    # Liang and Barsky 1984: the part t in [start, end] of a + t (b - a) between both borders.
    along = np.where(a == b, 1e-300, b - a)
    with np.errstate(over="ignore"):  # of an edge that is a point: outside or inside, both infinite
        crossings = np.sort(np.stack([-a / along, (size - a) / along]), axis=0)
    start = crossings[0].max(axis=-1, initial=0.0).clip(0.0, None)
    end = crossings[1].min(axis=-1, initial=1.0).clip(None, 1.0)
    seen &= start <= end
    ends = [a + np.where(seen, t, 0.0)[..., None] * (b - a) for t in (start, end)]
    return np.concatenate(ends, axis=1).clip(0.0, size), np.concatenate([seen, seen], axis=1)


def _project(points_m: np.ndarray, K: np.ndarray) -> np.ndarray:
    z = np.maximum(points_m[..., 2:], NEAR_M)  # nearer ones belong to edges that are not seen
    return points_m[..., :2] / z * K[[0, 1], [0, 1]] + K[:2, 2]


def _image_corners(size: np.ndarray) -> np.ndarray:
    return np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size


def _hit(
    centers_m: np.ndarray,
    sizes_m: np.ndarray,
    rotations: np.ndarray,
    pixels: np.ndarray,
    K: np.ndarray,
) -> np.ndarray:
    """Whether the rays through some pixels [P, 2] meet boxes, all in the camera's frame: [B, P]."""
    rays = np.concatenate(
        [(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((len(pixels), 1))], axis=1
    )
    directions = rays @ rotations  # [B, P, 3], the boxes' axes
    eyes = -(centers_m[:, None] @ rotations)  # [B, 1, 3]
    directions = np.where(directions == 0, 1e-300, directions)
    with np.errstate(over="ignore"):  # of a ray along a side
        far = sizes_m[:, None] / 2
        depths = np.sort(np.stack([(-far - eyes) / directions, (far - eyes) / directions]), axis=0)
    enter, leave = depths[0].max(axis=-1), depths[1].min(axis=-1)
    return np.maximum(enter, NEAR_M) <= leave
