"""Labelled boxes as an image shows them: outlines of the projected boxes, and what hides them.

A box's own axes: x along its length, y its width, z its height. Pixels count from the image's upper
left corner: the first one's centre is at 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt16

from augment.box_kernels import count_occlusion
from augment.box_pixels import (
    CORNERS,
    EDGES,
    NEAR_M,
    PlacedBoxes,
    cut_edges,
    pixel_windows,
)
from augment.cameras import Camera


@dataclass(frozen=True, eq=False)
class Outlines:
    """Projected boxes. xyxy: left, top, right, bottom of what lies inside the image, zeros of boxes
    out of view. in_view: whether any of the box lies in the image, hidden by others or not.
    truncated_fraction: of the projection's area, what lies outside the image; 1 of boxes out of
    view, NaN of those whose numbers are not finite.
    """

    xyxy: Float64[np.ndarray, "B 4"]
    in_view: Bool[np.ndarray, " B"]
    truncated_fraction: Float64[np.ndarray, " B"]


@dataclass(frozen=True, eq=False)
class Occlusion:
    """Pixels of boxes. shown: that show each. hidden: inside its outline, that show what stands
    before it. xyxy: left, top, right, bottom of the shown ones, NaN where there are none.
    """

    shown: Int64[np.ndarray, " B"]
    hidden: Int64[np.ndarray, " B"]
    xyxy: Float64[np.ndarray, "B 4"]


def outline_placed(placed: PlacedBoxes, camera: Camera) -> Outlines:
    """The outlines of boxes in the scene's world."""
    world_from_camera = camera.world_from_camera.numpy()
    rotation = world_from_camera[:3, :3]
    centers_m = (placed.centres_m - world_from_camera[:3, 3]) @ rotation
    rotations = np.where(placed.is_finite[:, None, None], rotation.T @ placed.rotations, np.nan)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return outline_boxes(centers_m, placed.sizes_m, rotations, K, (camera.width, camera.height))


def outline_boxes(
    centers_m: Float64[np.ndarray, "B 3"],
    sizes_m: Float64[np.ndarray, "B 3"],
    rotations: Float64[np.ndarray, "B 3 3"],
    K: Float64[np.ndarray, "3 3"],
    image_size: tuple[int, int],
) -> Outlines:
    """The outlines of boxes in the camera's frame. rotations: camera_from_box. image_size: width,
    height.
    """
    numbers = np.concatenate([centers_m, sizes_m, rotations.reshape(-1, 9)], axis=1)
    finite = np.logical_and.reduce(np.isfinite(numbers), axis=1)
    centers_m, sizes_m = np.where(finite[:, None], (centers_m, sizes_m), 0.0)
    rotations = np.where(finite[:, None, None], rotations, np.eye(3))
    corners_m = centers_m[:, None] + (CORNERS * sizes_m[:, None]) @ rotations.transpose(0, 2, 1)
    size = np.array(image_size, np.float64)
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
    truncated = np.where(finite, 1.0, np.nan)
    whole, before = _projected_edges(corners_m, K)
    for number in np.flatnonzero(in_view):
        area = _hull_area(whole[number][before[number]])
        inside = _hull_area(points[number][shown[number, :, 0]])
        truncated[number] = min(max(1 - inside / area, 0.0), 1.0) if area > 0 else 0.0
    return Outlines(xyxy, in_view, truncated)


def find_occlusion(
    placed: PlacedBoxes,
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    instance: UInt16[np.ndarray, "H W"] | None = None,
    actors: UInt16[np.ndarray, " B"] | None = None,
) -> Occlusion:
    """Which pixels show each box, and which show what stands before it.

    A pixel shows a box whose part that owns surfaces (`box_pixels`) has the surface there. It shows
    what hides the box if its ray meets the labelled box, and the surface lies before that part.
    Where the background is seen through the outline, for a car does not fill its box, or the sky,
    it does neither.

    depth_m: z of the surface, 0 = none. instance, actors: where they are known, the actors' numbers
    by pixel and by box, 0 = none. An actor's pixels are then those with its number, wherever they
    are, and no other box's.
    """
    count = len(placed)
    numbers = np.zeros(count, np.int64) if actors is None else actors.astype(np.int64)
    if instance is None:
        instance, numbers = np.zeros((0, 0), np.uint16), np.zeros(count, np.int64)
    world_from_camera = camera.world_from_camera.numpy()
    box_from_world = placed.rotations.transpose(0, 2, 1)
    axes = box_from_world @ world_from_camera[:3, :3]  # columns: the camera's axes in each box
    eyes = box_from_world @ (world_from_camera[:3, 3] - placed.centres_m)[..., None]
    half = placed.sizes_m / 2
    found = np.zeros((count, 6), np.int64)
    count_occlusion(
        np.ascontiguousarray(depth_m),
        np.ascontiguousarray(instance),
        numbers,
        pixel_windows(placed, camera),
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,  # x / z of the pixels' rays
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,  # y / z
        np.ascontiguousarray(axes),
        np.ascontiguousarray(eyes[..., 0]),
        np.stack([placed.low_m, placed.high_m], axis=1),
        np.stack([np.maximum(placed.low_m, -half), np.minimum(placed.high_m, half)], axis=1),
        NEAR_M,
        found,
    )
    shown, bounds = found[:, 0], found[:, 2:].astype(np.float64)
    return Occlusion(shown, found[:, 1], np.where(shown[:, None] > 0, bounds, np.nan))


def _edges_in_image(
    corners_m: np.ndarray, K: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of those parts of the boxes' edges that the image shows.

    corners_m: [B, 8, 3], camera frame. Returns pixels [B, 24, 2] and whether an edge has such a
    part [B, 24].
    """
    ends, seen = _projected_edges(corners_m, K)
    a, b = np.split(ends, 2, axis=1)  # [B, 12, 2]
    seen = seen[:, :12]
    # Liang and Barsky 1984: the part t in [start, end] of a + t (b - a) between both borders.
    along = np.where(a == b, 1e-300, b - a)
    with np.errstate(over="ignore"):  # of an edge that is a point: outside or inside, both infinite
        crossings = np.sort(np.stack([-a / along, (size - a) / along]), axis=0)
    start = crossings[0].max(axis=-1, initial=0.0).clip(0.0, None)
    end = crossings[1].min(axis=-1, initial=1.0).clip(None, 1.0)
    seen &= start <= end
    ends = [a + np.where(seen, t, 0.0)[..., None] * (b - a) for t in (start, end)]
    return np.concatenate(ends, axis=1).clip(0.0, size), np.concatenate([seen, seen], axis=1)


def _projected_edges(corners_m: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of the boxes' edges, cut off near the camera's plane: pixels [B, 24, 2], and
    whether an edge lies before it [B, 24].
    """
    a, b = corners_m[:, EDGES[:, 0]], corners_m[:, EDGES[:, 1]]  # [B, 12, 3]
    seen = np.maximum(a[..., 2], b[..., 2]) > NEAR_M
    ends = np.concatenate([cut_edges(a, b), cut_edges(b, a)], axis=1)
    return _project(ends, K), np.concatenate([seen, seen], axis=1)


def _hull_area(points: np.ndarray) -> float:
    """Of the convex hull of points [P, 2]."""
    middle = points.mean(axis=0)
    reach = max(float(np.abs(points - middle).max()), 1e-9)  # OpenCV's are float32
    hull = cv2.convexHull(((points - middle) / reach).astype(np.float32))
    return cv2.contourArea(hull) * reach**2


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
