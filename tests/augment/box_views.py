"""Labelled boxes before a camera, for the tests of what weather does to them."""

from __future__ import annotations

import numpy as np
import torch

from augment.scene.boxes import WorldBoxes
from augment.scene.cameras import Camera
from augment.scene.geometry import rotmat_from_quat
from augment.scene.labels import Boxes
from tests.augment.batch_scenes import ORIGIN_M

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
CAR_M = (4.0, 2.0, 1.5)


def make_boxes(*boxes: tuple, origin: np.ndarray = ORIGIN_M) -> Boxes:
    """Boxes from (centre in the scene, size, quaternion)."""
    centres, sizes, quats = (np.array(column, np.float64) for column in zip(*boxes, strict=True))
    names = tuple(f"track-{i}" for i in range(len(boxes)))
    return Boxes(names, ("Car",) * len(boxes), centres + origin, sizes, quats)


def placed(boxes: Boxes) -> WorldBoxes:
    return WorldBoxes.from_labels(boxes, ORIGIN_M)


def make_camera(width: int = 160, height: int = 106, pitch: float = 0.0) -> Camera:
    """At (0, 0, 1.6), looking along +x; pitch in radians, downwards."""
    level = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    c = np.cos(pitch)
    s = np.sin(pitch)
    down = torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64)
    rotation = down @ level
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ torch.tensor([0, 0, 1.6], dtype=torch.float64)
    return Camera("front", width, height, 101.3, 99.7, 79.2, 55.1, pose)


def plane_depth(camera: Camera, z_m: float) -> np.ndarray:
    """float32 [H, W]: depth of the plane at that height, 0 where no ray meets it."""
    rays = camera.ray_directions(torch.float64).numpy()
    with np.errstate(divide="ignore"):
        depth = (z_m - camera.centre[2].item()) / rays[..., 2]
    return np.where((depth > 0) & (depth < 1000), depth, 0).astype(np.float32)


def count_by_hand(
    boxes: Boxes, extents_m: list, camera: Camera, depth_m: np.ndarray, mask: np.ndarray
) -> tuple[list[int], list[int]]:
    """Every pixel of the image against every box, in the box's own axes: all, and those marked.

    extents_m: of each box the two ends of what owns surfaces, from its centre.
    """
    rays = camera.ray_directions(torch.float64).numpy()
    points = camera.centre.numpy() + depth_m[..., None].astype(np.float64) * rays
    pixels = []
    marked = []
    for centre, quat, (low, high) in zip(boxes.centers_m, boxes.quats, extents_m, strict=True):
        rotation = rotmat_from_quat(torch.from_numpy(quat)).numpy()
        along = (points - (centre - ORIGIN_M)) @ rotation  # [H, W, 3]
        inside = ((along >= low) & (along <= high)).all(axis=-1) & (depth_m > 0)
        pixels.append(inside.sum())
        marked.append((inside & (mask == 255)).sum())
    return pixels, marked


def boxes_at_random(rng: np.random.Generator) -> Boxes:
    """Near and far, tilted, cut by the borders, behind the camera; the last but one is around it,
    the last one is flat.
    """
    listed = [
        (rng.uniform((-6, -8, -0.5), (25, 8, 2)), rng.uniform(0.3, 5, 3), rng.normal(size=4))
        for _ in range(60)
    ]
    listed += [((0.0, 0, 1.6), (3, 3, 3), UPRIGHT), ((10, 0, 0.05), (3, 3, 0.1), UPRIGHT)]
    return make_boxes(*listed)
