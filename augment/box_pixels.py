"""Which pixels of an image show which labelled box, by the depth of what they show.

Boxes come in the dataset's world (`augment.labels`), depth and cameras in the scene's, which is the
dataset's less `world_origin_m`. A box's own axes: x along its length, y its width, z its height.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from augment.cameras import Camera
from augment.geometry import rotmat_from_quat
from augment.labels import Boxes

NOT_COUNTED = -1  # in place of a number of pixels

# Which surfaces a box owns. Its lowest 8 cm are left out, for the road under a car is inside the
# box as often as not: labels, ground and depth agree to some 5 cm. Of the pixels in the boxes of a
# recorded drive that makes 1.2 % road, where all of the box has 6.1 % and 4 cm less have 3.5 %, and
# costs 0.3 % of the vehicles'. A low box keeps three quarters.
BOTTOM_M = 0.08
MOST_OF_HEIGHT = 0.25
# On the other five sides boxes are drawn tight (mirrors and bumpers reach beyond them), and splats
# blur a surface by a few centimetres.
SIDES_M = 0.10
NEAR_M = 0.01  # what of a box is nearer to the camera's plane, or behind it, is not projected

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
# Corners that differ in one axis are joined by an edge.
EDGES = np.array([
    (a, b) for a in range(8) for b in range(a) if (CORNERS[a] != CORNERS[b]).sum() == 1
])  # fmt: skip


@dataclass(frozen=True, eq=False)
class BoxPixels:
    """pixels: of the image, that show each box. marked: those of them that a mask marks."""

    pixels: Int64[np.ndarray, " B"]
    marked: Int64[np.ndarray, " B"]


def fraction_of(
    marked: Int64[np.ndarray, " B"], pixels: Int64[np.ndarray, " B"]
) -> Float64[np.ndarray, " B"]:
    """`marked / pixels`; 0 where pixels were not counted, NaN where there are none."""
    return np.where(pixels == 0, np.nan, marked / np.maximum(pixels, 1))


def count_pixels(
    placed: PlacedBoxes,
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    mask: UInt8[np.ndarray, "H W"],
) -> BoxPixels:
    """How many pixels show each box, and how many of them are 255 in the mask.

    depth_m: as for `shown_pixels`.
    """
    pixels = np.zeros(len(placed), np.int64)
    marked = np.zeros(len(placed), np.int64)
    for number, rows, columns in shown_pixels(placed, camera, depth_m):
        pixels[number] = len(rows)
        marked[number] = np.count_nonzero(mask[rows, columns] == 255)
    return BoxPixels(pixels, marked)


def shown_pixels(
    placed: PlacedBoxes, camera: Camera, depth_m: Float32[np.ndarray, "H W"]
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """(box, rows [P], columns [P]) of the pixels that show each box, for boxes that have any.

    depth_m: z of the surface that decides whose pixel it is; 0 = none. A pixel belongs to a box if
    the surface there lies in the part of the box that owns surfaces, so what hides a box, or stands
    beside it, does not count. Where boxes overlap, a pixel belongs to each.
    """
    windows = pixel_windows(placed, camera)
    world_from_camera = camera.world_from_camera.numpy()
    across = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx  # x / z of the pixels' rays
    down = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy  # y / z
    for number, (left, top, right, bottom) in enumerate(windows):
        if left >= right or top >= bottom:
            continue
        window = np.s_[top:bottom, left:right]
        rays = across[left:right], down[top:bottom]
        inside = _inside(placed, number, world_from_camera, rays, depth_m[window])
        if len(inside):
            rows, columns = np.divmod(inside, right - left)
            yield number, rows + top, columns + left


@dataclass(frozen=True, eq=False)
class PlacedBoxes:
    """Boxes in the scene's world. rotations: world_from_box.

    low_m, high_m: the part of each box, along its own axes from its centre, that owns surfaces: its
    lowest centimetres left out and its other sides drawn wider (see BOTTOM_M and SIDES_M).
    sizes_m, corners_m: of the labelled box. Boxes that are not finite hold zeros.
    """

    is_finite: Bool[np.ndarray, " B"]
    centres_m: Float64[np.ndarray, "B 3"]
    sizes_m: Float64[np.ndarray, "B 3"]
    rotations: Float64[np.ndarray, "B 3 3"]
    low_m: Float64[np.ndarray, "B 3"]
    high_m: Float64[np.ndarray, "B 3"]
    corners_m: Float64[np.ndarray, "B 8 3"]

    def __len__(self) -> int:
        return len(self.is_finite)

    @staticmethod
    def of(boxes: Boxes, world_origin_m: Float64[np.ndarray, "3"]) -> PlacedBoxes:
        numbers = np.concatenate([boxes.centers_m, boxes.sizes_m, boxes.quats], axis=1)
        turned = np.linalg.norm(boxes.quats, axis=1) > 0
        finite = np.isfinite(numbers).all(axis=1) & turned
        quats = np.where(finite[:, None], boxes.quats, np.array([1.0, 0, 0, 0]))
        rotations = rotmat_from_quat(torch.from_numpy(quats)).numpy()
        centres = np.where(finite[:, None], boxes.centers_m - world_origin_m, 0.0)
        sizes = np.where(finite[:, None], boxes.sizes_m, 0.0)
        low, high = -sizes / 2 - SIDES_M, sizes / 2 + SIDES_M
        low[:, 2] = -sizes[:, 2] / 2 + np.minimum(BOTTOM_M, MOST_OF_HEIGHT * sizes[:, 2])
        corners = _to_world(centres, rotations, CORNERS * sizes[:, None, :])
        return PlacedBoxes(finite, centres, sizes, rotations, low, high, corners)

    def without_margins(self) -> PlacedBoxes:
        """The boxes whose sides own surfaces no further out than they are labelled; their tops and
        bottoms stay.
        """
        half = self.sizes_m / 2
        low, high = np.maximum(self.low_m, -half), np.minimum(self.high_m, half)
        low[:, 2], high[:, 2] = self.low_m[:, 2], self.high_m[:, 2]
        return replace(self, low_m=low, high_m=high)


def _to_world(centres_m: np.ndarray, rotations: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Points [B, K, 3] from their boxes' axes to the world."""
    return centres_m[:, None, :] + points_m @ rotations.transpose(0, 2, 1)


def pixel_windows(placed: PlacedBoxes, camera: Camera) -> Int64[np.ndarray, "B 4"]:
    """Left, top, right, bottom of the pixels that can show the box; right and bottom
    are excluded, and nothing is left of a box out of view.
    """
    middle = (placed.low_m + placed.high_m)[:, None, :] / 2
    extent = (placed.high_m - placed.low_m)[:, None, :]
    corners = _to_world(placed.centres_m, placed.rotations, middle + CORNERS * extent)
    camera_from_world = camera.camera_from_world.numpy()
    corners = corners @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    a, b = corners[:, EDGES[:, 0]], corners[:, EDGES[:, 1]]  # [B, 12, 3]
    ends = np.concatenate([cut_edges(a, b), cut_edges(b, a)], axis=1)
    seen = (np.maximum(a[..., 2], b[..., 2]) > NEAR_M) & placed.is_finite[:, None]
    seen = np.concatenate([seen, seen], axis=1)
    z = np.where(seen, ends[..., 2], 1.0)
    windows = np.zeros((len(corners), 4), np.int64)
    sides = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    for axis, (focal, centre, size) in enumerate(sides):
        at = focal * ends[..., axis] / z + centre - 0.5  # of pixel centres, counted from 0
        first = np.where(seen, at, np.inf).min(axis=1, initial=np.inf)
        last = np.where(seen, at, -np.inf).max(axis=1, initial=-np.inf)
        windows[:, axis] = np.clip(np.ceil(first), 0, size)
        windows[:, axis + 2] = np.clip(np.floor(last) + 1, 0, size)
    return windows


def cut_edges(end: np.ndarray, other: np.ndarray) -> np.ndarray:
    """`end` of each edge [..., 3], moved along the edge to z = NEAR_M where it lies nearer."""
    length = other[..., 2] - end[..., 2]
    behind = (end[..., 2] < NEAR_M) & (length > 0)
    t = np.where(behind, (NEAR_M - end[..., 2]) / np.where(behind, length, 1.0), 0.0)
    return end + t[..., None] * (other - end)


def _inside(
    placed: PlacedBoxes,
    number: int,
    world_from_camera: np.ndarray,
    rays: tuple[np.ndarray, np.ndarray],
    depth_m: np.ndarray,
) -> np.ndarray:
    """Flat indices of those pixels of a window whose surface lies inside one box.

    rays: x / z of the window's columns [w], y / z of its rows [h]. depth_m: [h, w].
    """
    box_from_world = placed.rotations[number].T
    axes = box_from_world @ world_from_camera[:3, :3]  # columns: the camera's axes in the box
    eye = box_from_world @ (world_from_camera[:3, 3] - placed.centres_m[number])
    low, high = placed.low_m[number], placed.high_m[number]
    # The depths of the box bound what is looked at closely: a few pixels of many, mostly.
    depth_of_centre = -(eye @ axes[:, 2])
    reach = np.maximum(-low, high) @ np.abs(axes[:, 2])
    nearest = max(depth_of_centre - reach, 0.0)
    flat = np.ascontiguousarray(depth_m).ravel()
    near = np.flatnonzero((flat > nearest) & (flat <= depth_of_centre + reach))
    rows, columns = np.divmod(near, depth_m.shape[1])
    z = flat[near].astype(np.float64)
    x = rays[0][columns] * z
    y = rays[1][rows] * z
    kept = np.ones(len(near), bool)
    for axis in range(3):
        along = eye[axis] + axes[axis, 0] * x + axes[axis, 1] * y + axes[axis, 2] * z
        kept &= (along >= low[axis]) & (along <= high[axis])
    return near[kept]
