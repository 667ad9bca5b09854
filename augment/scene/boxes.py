"""Labelled boxes in images: their pixels, 2D outlines, occlusion, and numbers in instance images.

In: the labelled boxes of a frame, a camera and the depth of a rendered view. Out: counts of pixels,
2D boxes and instance numbers, as the label tables of jobs hold them (`augment.view.box_labels`);
effects count pixels of their masks here.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8, UInt16

from augment.memo import memo_of
from augment.scene.box_kernels import count_box_pixels
from augment.scene.cameras import Camera
from augment.scene.geometry import rotmat_from_quat
from augment.scene.labels import Boxes, LabelSource
from augment.scene.lens_boxes import (
    BoxFrames,
    count_pixels_through_lens,
    crossings,
    project_edges,
    windows_of,
)
from augment.scene.pixel_rays import pixel_rays_of
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass

# Value that stands for a number of pixels that was not counted.
NOT_COUNTED = -1

# Height of the lowest part of a box that owns no surfaces, metres. The road under a car is inside
# the box as often as not: labels, ground and depth agree to some 5 cm. Of the pixels in the boxes
# of a recorded drive, 1.2 % are then road, against 6.1 % with the whole box and 3.5 % with 4 cm
# less left out; 0.3 % of the vehicles' pixels are lost.
BOTTOM_MARGIN_M = 0.08
# Largest height of that part over the height of the box: a low box keeps three quarters.
MAX_BOTTOM_FRACTION = 0.25
# Margin on the other five sides in which a box owns surfaces, metres. Boxes are drawn tight
# (mirrors and bumpers reach beyond them), and splats blur a surface by a few centimetres.
SIDE_MARGIN_M = 0.10
# Depth below which the parts of a box are not projected, metres.
MIN_DEPTH_M = 0.01

# Corners of a unit cube about its centre.
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
# Pairs of corners that an edge joins: they differ in one axis.
EDGES = np.array(
    [(a, b) for a in range(8) for b in range(a) if (CORNERS[a] != CORNERS[b]).sum() == 1]
)


@dataclass(frozen=True, eq=False)
class BoxPixels:
    """Numbers of pixels of B boxes in an image."""

    num_pixels: Int64[np.ndarray, " B"]
    """Pixels that show each box."""
    num_marked: Int64[np.ndarray, " B"]
    """Those of them that a mask marks."""


def marked_fraction(
    num_marked: Int64[np.ndarray, " B"], num_pixels: Int64[np.ndarray, " B"]
) -> Float64[np.ndarray, " B"]:
    """Return marked / pixels; 0 where pixels were not counted, NaN where there are none."""
    return np.where(num_pixels == 0, np.nan, num_marked / np.maximum(num_pixels, 1))


def count_pixels(
    boxes: WorldBoxes,
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    mask: UInt8[np.ndarray, "H W"],
) -> BoxPixels:
    """Count the pixels that show each box, and those of them that are 255 in a mask.

    Args:
        boxes: the boxes.
        camera: the camera of the image.
        depth_m: as for `pixels_of_boxes`.
        mask: the mask.
    """
    num_pixels = np.zeros(len(boxes), np.int64)
    num_marked = np.zeros(len(boxes), np.int64)
    for number, rows, columns in pixels_of_boxes(boxes, camera, depth_m):
        num_pixels[number] = len(rows)
        num_marked[number] = np.count_nonzero(mask[rows, columns] == 255)
    return BoxPixels(num_pixels, num_marked)


def pixels_of_boxes(
    boxes: WorldBoxes, camera: Camera, depth_m: Float32[np.ndarray, "H W"]
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield (box, rows [P], columns [P]) of the pixels that show each box that has any.

    A pixel belongs to a box if the surface there lies in the part of the box that owns surfaces. So
    what hides a box, or stands beside it, does not count. Where boxes overlap, a pixel belongs to
    each.

    Args:
        boxes: the boxes.
        camera: the camera of the image.
        depth_m: z of the surface that decides whose pixel it is, metres; 0 = none.
    """
    if not camera.is_pinhole:
        yield from _pixels_through_lens(boxes, camera, depth_m)
        return
    windows = pixel_windows(boxes, camera)
    world_from_camera = camera.world_from_camera.numpy()
    across = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx  # x / z of the pixels' rays
    down = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy  # y / z
    for number, (left, top, right, bottom) in enumerate(windows):
        if left >= right or top >= bottom:
            continue
        window = np.s_[top:bottom, left:right]
        rays = across[left:right], down[top:bottom]
        pixels_inside = _pixels_inside(boxes, number, world_from_camera, rays, depth_m[window])
        if len(pixels_inside):
            rows, columns = np.divmod(pixels_inside, right - left)
            yield number, rows + top, columns + left


def _pixels_through_lens(
    boxes: WorldBoxes, camera: Camera, depth_m: Float32[np.ndarray, "H W"]
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield the pixels of `pixels_of_boxes` for a camera with a lens or a rolling shutter."""
    rays = pixel_rays_of(camera)
    frames = _frames_of(boxes)
    for number, (left, top, right, bottom) in enumerate(pixel_windows(boxes, camera)):
        if left >= right or top >= bottom:
            continue
        window = (slice(top, bottom), slice(left, right))
        enter, leave = crossings(rays, window, frames, number, is_owned=True)
        z = depth_m[window]
        rows, columns = np.nonzero((z > 0) & (enter <= z) & (z <= leave))
        if len(rows):
            yield number, rows + top, columns + left


def _frames_of(boxes: WorldBoxes) -> BoxFrames:
    """Return the frames and sides of boxes, as rays are tested with."""
    half = boxes.sizes_m / 2
    low = boxes.low_m
    high = boxes.high_m
    return BoxFrames(
        boxes.centres_m,
        boxes.rotations,
        np.stack([low, high], axis=1),
        np.stack([np.maximum(low, -half), np.minimum(high, half)], axis=1),
    )


def are_usable(
    numbers: Float64[np.ndarray, "B N"], sizes_m: Float64[np.ndarray, "B 3"]
) -> Bool[np.ndarray, " B"]:
    """Return the mask of boxes with finite numbers [B, N] and sides longer than 0."""
    finite = np.logical_and.reduce(np.isfinite(numbers), axis=1)
    return finite & np.logical_and.reduce(sizes_m > 0, axis=1)


@dataclass(frozen=True, eq=False)
class WorldBoxes:
    """B boxes in the scene's world.

    Boxes that are not usable hold zeros.
    """

    is_usable: Bool[np.ndarray, " B"]
    """True for boxes with finite numbers, sides longer than 0, and a quaternion that is a
    rotation."""
    centres_m: Float64[np.ndarray, "B 3"]
    """Centres."""
    sizes_m: Float64[np.ndarray, "B 3"]
    """Length, width and height of the labelled boxes."""
    rotations: Float64[np.ndarray, "B 3 3"]
    """world_from_box."""
    low_m: Float64[np.ndarray, "B 3"]
    """Lowest corner of the part that owns surfaces, along the box's axes from its centre: the
    lowest centimetres are left out, other sides are drawn wider (BOTTOM_MARGIN_M,
    SIDE_MARGIN_M)."""
    high_m: Float64[np.ndarray, "B 3"]
    """Highest corner of that part."""
    corners_m: Float64[np.ndarray, "B 8 3"]
    """Corners of the labelled boxes, in the order of CORNERS."""
    track_ids: tuple[str, ...]
    """Tracks of the boxes."""

    def __len__(self) -> int:
        return len(self.is_usable)

    @staticmethod
    def from_labels(boxes: Boxes, world_origin_m: Float64[np.ndarray, "3"]) -> WorldBoxes:
        """Return labelled boxes in the scene's world.

        Args:
            boxes: the boxes, in the dataset's world.
            world_origin_m: origin of the scene's world in the dataset's.
        """
        numbers = np.concatenate([boxes.centers_m, boxes.sizes_m, boxes.quats], axis=1)
        has_rotation = np.linalg.norm(boxes.quats, axis=1) > 0
        is_usable = are_usable(numbers, boxes.sizes_m) & has_rotation
        quats = np.where(is_usable[:, None], boxes.quats, np.array([1.0, 0, 0, 0]))
        rotations = rotmat_from_quat(torch.from_numpy(quats)).numpy()
        centres = np.where(is_usable[:, None], boxes.centers_m - world_origin_m, 0.0)
        sizes = np.where(is_usable[:, None], boxes.sizes_m, 0.0)
        low = -sizes / 2 - SIDE_MARGIN_M
        high = sizes / 2 + SIDE_MARGIN_M
        low[:, 2] = -sizes[:, 2] / 2 + np.minimum(
            BOTTOM_MARGIN_M, MAX_BOTTOM_FRACTION * sizes[:, 2]
        )
        corners = _to_world(centres, rotations, CORNERS * sizes[:, None, :])
        return WorldBoxes(is_usable, centres, sizes, rotations, low, high, corners, boxes.track_ids)

    def without_margins(self) -> WorldBoxes:
        """Return the boxes with sides that own surfaces no further out than they are labelled.

        Tops and bottoms stay.
        """
        half = self.sizes_m / 2
        low = np.maximum(self.low_m, -half)
        high = np.minimum(self.high_m, half)
        low[:, 2] = self.low_m[:, 2]
        high[:, 2] = self.high_m[:, 2]
        return replace(self, low_m=low, high_m=high)


def _to_world(centres_m: np.ndarray, rotations: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Return points [B, K, 3] in the world, from their boxes' axes."""
    return centres_m[:, None, :] + points_m @ rotations.transpose(0, 2, 1)


def pixel_windows(boxes: WorldBoxes, camera: Camera) -> Int64[np.ndarray, "B 4"]:
    """Return left, top, right and bottom of the pixels that can show each box.

    Right and bottom are excluded; the window of a box out of view is empty.
    """
    middles = (boxes.low_m + boxes.high_m)[:, None, :] / 2
    extents = (boxes.high_m - boxes.low_m)[:, None, :]
    corners = _to_world(boxes.centres_m, boxes.rotations, middles + CORNERS * extents)
    if not camera.is_pinhole:
        return windows_of(project_edges(corners, EDGES, camera), boxes.is_usable, camera)
    camera_from_world = camera.camera_from_world.numpy()
    corners = corners @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    a = corners[:, EDGES[:, 0]]  # [B, 12, 3]
    b = corners[:, EDGES[:, 1]]
    ends = np.concatenate([cut_edges(a, b), cut_edges(b, a)], axis=1)
    is_before_camera = (np.maximum(a[..., 2], b[..., 2]) > MIN_DEPTH_M) & boxes.is_usable[:, None]
    is_before_camera = np.concatenate([is_before_camera, is_before_camera], axis=1)
    z = np.where(is_before_camera, ends[..., 2], 1.0)
    windows = np.zeros((len(corners), 4), np.int64)
    sides = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    for axis, (focal, centre, size) in enumerate(sides):
        pixel_places = (
            focal * ends[..., axis] / z + centre - 0.5
        )  # of pixel centres, counted from 0
        first = np.where(is_before_camera, pixel_places, np.inf).min(axis=1, initial=np.inf)
        last = np.where(is_before_camera, pixel_places, -np.inf).max(axis=1, initial=-np.inf)
        windows[:, axis] = np.clip(np.ceil(first), 0, size)
        windows[:, axis + 2] = np.clip(np.floor(last) + 1, 0, size)
    return windows


def cut_edges(end: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return `end` of each edge [..., 3], moved along it to MIN_DEPTH_M where it is nearer."""
    length = other[..., 2] - end[..., 2]
    is_behind = (end[..., 2] < MIN_DEPTH_M) & (length > 0)
    t = np.where(is_behind, (MIN_DEPTH_M - end[..., 2]) / np.where(is_behind, length, 1.0), 0.0)
    return end + t[..., None] * (other - end)


def _pixels_inside(
    boxes: WorldBoxes,
    number: int,
    world_from_camera: np.ndarray,
    rays: tuple[np.ndarray, np.ndarray],
    depth_m: np.ndarray,
) -> np.ndarray:
    """Return flat indices of those pixels of a window whose surface lies inside one box.

    Args:
        boxes: the boxes.
        number: index of the box.
        world_from_camera: pose of the camera.
        rays: x / z of the window's columns [w], and y / z of its rows [h].
        depth_m: z of the surfaces in the window, [h, w].
    """
    box_from_world = boxes.rotations[number].T
    axes = box_from_world @ world_from_camera[:3, :3]  # columns: the camera's axes in the box
    eye = box_from_world @ (world_from_camera[:3, 3] - boxes.centres_m[number])
    low = boxes.low_m[number]
    high = boxes.high_m[number]
    # The depths of the box leave few pixels of many to be tested closely, mostly.
    depth_of_centre = -(eye @ axes[:, 2])
    reach = np.maximum(-low, high) @ np.abs(axes[:, 2])
    nearest = max(depth_of_centre - reach, 0.0)
    flat = np.ascontiguousarray(depth_m).ravel()
    candidates = np.flatnonzero((flat > nearest) & (flat <= depth_of_centre + reach))
    rows, columns = np.divmod(candidates, depth_m.shape[1])
    z = flat[candidates].astype(np.float64)
    x = rays[0][columns] * z
    y = rays[1][rows] * z
    is_inside = np.ones(len(candidates), bool)
    for axis in range(3):
        along = eye[axis] + axes[axis, 0] * x + axes[axis, 1] * y + axes[axis, 2] * z
        is_inside &= (along >= low[axis]) & (along <= high[axis])
    return candidates[is_inside]


# ---- Outlines of projected boxes, and their occlusion --------------------------------------------
# A box's own axes: x along its length, y its width, z its height. Pixels count from the image's
# upper left corner: the first one's centre is at 0.5.


@dataclass(frozen=True, eq=False)
class Outlines:
    """Projected outlines of B boxes."""

    xyxy: Float64[np.ndarray, "B 4"]
    """Left, top, right, bottom of the part inside the image, pixels; zeros for boxes out of
    view."""
    in_view: Bool[np.ndarray, " B"]
    """True for boxes with a part inside the image, hidden by others or not."""
    truncated_fraction: Float64[np.ndarray, " B"]
    """Share of the projection's area outside the image; 1 for boxes out of view, NaN for boxes that
    are not usable (`are_usable`)."""


@dataclass(frozen=True, eq=False)
class Occlusion:
    """Visible and hidden pixels of B boxes."""

    num_shown: Int64[np.ndarray, " B"]
    """Pixels that show each box."""
    num_hidden: Int64[np.ndarray, " B"]
    """Pixels inside each outline that show what stands before the box."""
    xyxy: Float64[np.ndarray, "B 4"]
    """Left, top, right, bottom of the shown pixels; NaN where there are none."""
    owner_boxes: UInt16[np.ndarray, "H W"] | None = None
    """1 + the smallest of the boxes that a pixel shows by depth, 0 = none; None unless asked
    for."""


def outline_world_boxes(boxes: WorldBoxes, camera: Camera) -> Outlines:
    """Return the outlines of boxes in the scene's world."""
    if not camera.is_pinhole:
        return _outline_through_lens(boxes, camera)
    world_from_camera = camera.world_from_camera.numpy()
    rotation = world_from_camera[:3, :3]
    centers_m = (boxes.centres_m - world_from_camera[:3, 3]) @ rotation
    rotations = np.where(boxes.is_usable[:, None, None], rotation.T @ boxes.rotations, np.nan)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return outline_boxes(centers_m, boxes.sizes_m, rotations, K, (camera.width, camera.height))


def _outline_through_lens(boxes: WorldBoxes, camera: Camera) -> Outlines:
    """Return the outlines of boxes for a camera with a lens or a rolling shutter.

    The image's corners count where their rays meet a box, whose edges then may all lie outside.
    """
    pieces = project_edges(boxes.corners_m, EDGES, camera)
    size = np.array([camera.width, camera.height], np.float64)
    ends, is_shown = _clip_edges(pieces.first, pieces.second, pieces.is_shown, size)
    rows = np.array([0, 0, camera.height - 1, camera.height - 1])
    columns = np.array([0, camera.width - 1, 0, camera.width - 1])
    corner_points = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size
    rays = pixel_rays_of(camera)
    frames = _frames_of(boxes)
    labelled = replace(frames, labelled_m=np.stack([-boxes.sizes_m, boxes.sizes_m], axis=1) / 2)
    hits = np.zeros((len(boxes), 4), bool)
    for number in range(len(boxes)):
        for corner, (row, column) in enumerate(zip(rows, columns, strict=True)):
            window = (slice(row, row + 1), slice(column, column + 1))
            enter, leave = crossings(rays, window, labelled, number, is_owned=False)
            hits[number, corner] = max(enter[0, 0], MIN_DEPTH_M) <= leave[0, 0]
    points = np.concatenate([ends, np.broadcast_to(corner_points, (len(ends), 4, 2))], axis=1)
    is_shown = np.concatenate([is_shown, hits], axis=1)
    low = np.where(is_shown[..., None], points, np.inf).min(axis=1, initial=np.inf)
    high = np.where(is_shown[..., None], points, -np.inf).max(axis=1, initial=-np.inf)
    in_view = boxes.is_usable & (high > low).all(axis=1)
    xyxy = np.where(in_view[:, None], np.concatenate([low, high], axis=1), 0.0)
    truncated_fraction = np.where(boxes.is_usable, 1.0, np.nan)
    for number in np.flatnonzero(in_view):
        is_projected = pieces.is_shown[number]
        edge_points = np.concatenate(
            [pieces.first[number][is_projected], pieces.second[number][is_projected]]
        )
        area = _hull_area(edge_points) if len(edge_points) else 0.0
        shown_area = _hull_area(points[number][is_shown[number]])
        truncated_fraction[number] = min(max(1 - shown_area / area, 0.0), 1.0) if area > 0 else 0.0
    return Outlines(xyxy, in_view, truncated_fraction)


def outline_boxes(
    centers_m: Float64[np.ndarray, "B 3"],
    sizes_m: Float64[np.ndarray, "B 3"],
    rotations: Float64[np.ndarray, "B 3 3"],
    K: Float64[np.ndarray, "3 3"],
    image_size: tuple[int, int],
) -> Outlines:
    """Return the outlines of boxes in the camera's frame.

    Args:
        centers_m: centres.
        sizes_m: length, width and height.
        rotations: camera_from_box.
        K: intrinsic matrix.
        image_size: width and height, pixels.
    """
    numbers = np.concatenate([centers_m, sizes_m, rotations.reshape(-1, 9)], axis=1)
    is_usable = are_usable(numbers, sizes_m)
    centers_m, sizes_m = np.where(is_usable[:, None], (centers_m, sizes_m), 0.0)
    rotations = np.where(is_usable[:, None, None], rotations, np.eye(3))
    corners_m = centers_m[:, None] + (CORNERS * sizes_m[:, None]) @ rotations.transpose(0, 2, 1)
    size = np.array(image_size, np.float64)
    ends, is_edge_shown = _edges_in_image(corners_m, K, size)  # [B, E, 2]
    image_corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size
    points = np.concatenate([ends, np.broadcast_to(image_corners, (len(ends), 4, 2))], axis=1)
    is_shown = [is_edge_shown, _rays_hit_boxes(centers_m, sizes_m, rotations, image_corners, K)]
    is_shown = np.concatenate(is_shown, axis=1)[..., None]
    low = np.where(is_shown, points, np.inf).min(axis=1, initial=np.inf)
    high = np.where(is_shown, points, -np.inf).max(axis=1, initial=-np.inf)
    in_view = is_usable & (high > low).all(axis=1)
    xyxy = np.where(in_view[:, None], np.concatenate([low, high], axis=1), 0.0)
    truncated_fraction = np.where(is_usable, 1.0, np.nan)
    projected, is_before_camera = _project_edges(corners_m, K)
    for number in np.flatnonzero(in_view):
        area = _hull_area(projected[number][is_before_camera[number]])
        shown_area = _hull_area(points[number][is_shown[number, :, 0]])
        truncated_fraction[number] = min(max(1 - shown_area / area, 0.0), 1.0) if area > 0 else 0.0
    return Outlines(xyxy, in_view, truncated_fraction)


def find_occlusion(
    boxes: WorldBoxes,
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    instance: UInt16[np.ndarray, "H W"] | None = None,
    actors: UInt16[np.ndarray, " B"] | None = None,
    *,
    classes: UInt8[np.ndarray, "H W"] | None = None,
    with_owners: bool = False,
) -> Occlusion:
    """Count the pixels that show each box, and those that show what stands before it.

    A pixel shows a box whose part that owns surfaces (`low_m`, `high_m`) has the surface there. It
    shows what hides the box if its ray meets the labelled box, and the surface lies before that
    part. It does neither where the background or the sky is seen through the outline, for a car
    does not fill its box.

    Args:
        boxes: the boxes.
        camera: the camera of the image.
        depth_m: z of the surface, metres; 0 = none.
        instance: the actors' numbers by pixel, 0 = none; None where they are not known. An actor's
            pixels are those with its number, wherever they are, and no other box's.
        actors: the actors' numbers by box, 0 = none.
        classes: classes of the surfaces, where they are known. A surface of a class that no object
            has (a bush beside a car, the road under it) shows no box that it lies in.
        with_owners: if True, also find the box that each pixel shows.
    """
    num_boxes = len(boxes)
    numbers = np.zeros(num_boxes, np.int64) if actors is None else actors.astype(np.int64)
    if instance is None:
        instance = np.zeros((0, 0), np.uint16)
        numbers = np.zeros(num_boxes, np.int64)
    scenery = np.zeros((0, 0), bool) if classes is None else np.isin(classes, _NO_OBJECT)
    if not camera.is_pinhole:
        counts, owners = count_pixels_through_lens(
            pixel_rays_of(camera),
            _frames_of(boxes),
            pixel_windows(boxes, camera),
            depth_m,
            instance,
            scenery,
            numbers,
            MIN_DEPTH_M,
        )
        return _occlusion_of(counts, owners if with_owners else None)
    world_from_camera = camera.world_from_camera.numpy()
    box_from_world = boxes.rotations.transpose(0, 2, 1)
    axes = box_from_world @ world_from_camera[:3, :3]  # columns: the camera's axes in each box
    eyes = box_from_world @ (world_from_camera[:3, 3] - boxes.centres_m)[..., None]
    half_sizes = boxes.sizes_m / 2
    counts = np.zeros((num_boxes, 6), np.int64)
    owners = np.zeros(depth_m.shape if with_owners else (0, 0), np.uint16)
    count_box_pixels(
        np.ascontiguousarray(depth_m),
        np.ascontiguousarray(instance),
        scenery,
        numbers,
        pixel_windows(boxes, camera),
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,  # x / z of the pixels' rays
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,  # y / z
        np.ascontiguousarray(axes),
        np.ascontiguousarray(eyes[..., 0]),
        np.stack([boxes.low_m, boxes.high_m], axis=1),
        np.stack(
            [np.maximum(boxes.low_m, -half_sizes), np.minimum(boxes.high_m, half_sizes)], axis=1
        ),
        MIN_DEPTH_M,
        counts,
        owners,
    )
    return _occlusion_of(counts, owners if with_owners else None)


def _occlusion_of(counts: np.ndarray, owners: np.ndarray | None) -> Occlusion:
    """Return the record of counted pixels.

    Args:
        counts: rows of `count_box_pixels`, int64 [B, 6].
        owners: the boxes that pixels show; None unless asked for.
    """
    num_shown = counts[:, 0]
    bounds = counts[:, 2:].astype(np.float64)
    modal = np.where(num_shown[:, None] > 0, bounds, np.nan)
    return Occlusion(num_shown, counts[:, 1], modal, owners)


def _edges_in_image(
    corners_m: np.ndarray, K: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of those parts of the boxes' edges that the image shows.

    Args:
        corners_m: [B, 8, 3], camera frame.
        K: intrinsic matrix.
        size: width and height of the image.

    Returns:
        Pixels [B, 24, 2], and the mask of ends of edges that have such a part [B, 24].
    """
    ends, is_shown = _project_edges(corners_m, K)
    a, b = np.split(ends, 2, axis=1)  # [B, 12, 2]
    return _clip_edges(a, b, is_shown[:, :12], size)


def _clip_edges(
    a: np.ndarray, b: np.ndarray, is_shown: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of those parts of straight edges that the image shows.

    Args:
        a: pixels at which the edges begin, [B, E, 2].
        b: pixels at which they end, [B, E, 2].
        is_shown: edges before the camera, [B, E].
        size: width and height of the image.

    Returns:
        Pixels [B, 2 E, 2], and the mask of ends of edges that have such a part [B, 2 E].
    """
    # Liang and Barsky 1984: the part t in [start, end] of a + t (b - a) between both borders.
    along = np.where(a == b, 1e-300, b - a)
    with np.errstate(over="ignore"):  # of an edge that is a point: outside or inside, both infinite
        crossings = np.sort(np.stack([-a / along, (size - a) / along]), axis=0)
    start = crossings[0].max(axis=-1, initial=0.0).clip(0.0, None)
    end = crossings[1].min(axis=-1, initial=1.0).clip(None, 1.0)
    is_shown = is_shown & (start <= end)
    ends = [a + np.where(is_shown, t, 0.0)[..., None] * (b - a) for t in (start, end)]
    return np.concatenate(ends, axis=1).clip(0.0, size), np.concatenate(
        [is_shown, is_shown], axis=1
    )


def _project_edges(corners_m: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of the boxes' edges, cut off near the camera's plane: pixels [B, 24, 2], and
    the mask of edges before the camera [B, 24].
    """
    a = corners_m[:, EDGES[:, 0]]  # [B, 12, 3]
    b = corners_m[:, EDGES[:, 1]]
    is_before_camera = np.maximum(a[..., 2], b[..., 2]) > MIN_DEPTH_M
    ends = np.concatenate([cut_edges(a, b), cut_edges(b, a)], axis=1)
    z = np.maximum(ends[..., 2:], MIN_DEPTH_M)  # nearer ones belong to edges that are not seen
    pixels = ends[..., :2] / z * K[[0, 1], [0, 1]] + K[:2, 2]
    return pixels, np.concatenate([is_before_camera, is_before_camera], axis=1)


def _hull_area(points: np.ndarray) -> float:
    """Return the area of the convex hull of points [P, 2]."""
    middle = points.mean(axis=0)
    reach = max(float(np.abs(points - middle).max()), 1e-9)  # OpenCV's are float32
    hull = cv2.convexHull(((points - middle) / reach).astype(np.float32))
    return cv2.contourArea(hull) * reach**2


def _rays_hit_boxes(
    centers_m: np.ndarray,
    sizes_m: np.ndarray,
    rotations: np.ndarray,
    pixels: np.ndarray,
    K: np.ndarray,
) -> np.ndarray:
    """Return the mask [B, P] of boxes that the rays through pixels [P, 2] meet, in the camera's
    frame.
    """
    rays = np.concatenate(
        [(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((len(pixels), 1))], axis=1
    )
    directions = rays @ rotations  # [B, P, 3], the boxes' axes
    origins = -(centers_m[:, None] @ rotations)  # [B, 1, 3]
    directions = np.where(directions == 0, 1e-300, directions)
    with np.errstate(over="ignore"):  # of a ray along a side
        half_sizes = sizes_m[:, None] / 2
        depths = np.sort(
            np.stack([(-half_sizes - origins) / directions, (half_sizes - origins) / directions]),
            axis=0,
        )
    enter = depths[0].max(axis=-1)
    leave = depths[1].min(axis=-1)
    return np.maximum(enter, MIN_DEPTH_M) <= leave


# ---- Numbers of a scene's objects, in instance images and beside its boxes -----------------------
# An actor has 1 + its index in the scene. Boxes without an actor (parked cars: splats of the
# background) come after those, by tracks, in the order in which the frames of the whole scene first
# show them. So a number depends neither on the frames and cameras that are rendered nor on who
# renders them.

# Largest number of an object: instance images have 16 bits.
MAX_INSTANCE = 65535
# Classes that no labelled object has: they lie under it, beside it, before it or behind it.
_NO_OBJECT = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
    SemanticClass.VEGETATION,
    SemanticClass.BUILDING,
    SemanticClass.SKY,
    SemanticClass.WATER,
)
_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, eq=False)
class Instances:
    """Numbers of the objects of one scene. Picklable."""

    own_bytes: ClassVar[int] = 0
    """Bytes beside the scene's own: none, as labels are the scene's."""

    actors: tuple[str, ...]
    """Track ids of the actors, in the scene's order."""
    frames: tuple[int, ...]
    """Numbers of all frames."""
    labels: LabelSource | None
    """Reader of boxes; None where there are no boxes."""

    @cached_property
    def by_track(self) -> Mapping[str, int]:
        """Return the number of every track.

        The first use reads the boxes of all frames. Those of a frame that cannot be read are left
        out, for that is an error of the frame's own images.
        """
        numbers = {track_id: number for number, track_id in enumerate(self.actors, start=1)}
        labels = self.labels
        for frame in self.frames:
            try:
                boxes = Boxes.empty() if labels is None else labels.boxes(frame)
            except Exception as error:
                _log.debug("boxes of frame %d", frame, exc_info=error)
                continue
            for track_id in boxes.track_ids:
                numbers.setdefault(track_id, len(numbers) + 1)
        if len(numbers) > MAX_INSTANCE:
            _log.warning(
                "the scene has %d actors and tracks of boxes; instance images number %d of them, "
                "and the rest have instance 0",
                len(numbers),
                MAX_INSTANCE,
            )
        return numbers

    def has_same_numbers(self, track_ids: tuple[str, ...], numbers: np.ndarray) -> bool:
        """Return True if boxes that were numbered earlier still have these numbers.

        Tracks that are not known are left out.
        """
        is_known = np.array([track_id in self.by_track for track_id in track_ids], bool)
        return bool((self.numbers_of(track_ids) == numbers)[is_known].all())

    def numbers_of(self, track_ids: tuple[str, ...]) -> UInt16[np.ndarray, " B"]:
        """Return the number of each box, by its track.

        It is 0 for a track of none of the scene's frames, and beyond MAX_INSTANCE.
        """
        numbers = np.array([self.by_track.get(track_id, 0) for track_id in track_ids], np.int64)
        return np.where(numbers > MAX_INSTANCE, 0, numbers).astype(np.uint16)


def instances_of(scene: Scene) -> Instances:
    """Return the numbers of the scene's objects, remembered as long as the scene lives."""
    scene = scene.as_recorded  # a moved actor keeps its number
    actors = tuple(actor.track_id for actor in scene.actors)
    frames = tuple(sorted(frame.index for frame in scene.frames))
    return memo_of(scene).get(("instances",), lambda: Instances(actors, frames, scene.labels))


def paint_boxes(
    instance: UInt16[np.ndarray, "H W"],
    boxes: WorldBoxes,
    numbers: UInt16[np.ndarray, " B"],
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    classes: UInt8[np.ndarray, "H W"],
    num_actors: int,
) -> UInt16[np.ndarray, "H W"]:
    """Return the instance image of a scene's actors with the boxes that have no actor.

    A pixel of no actor shows the box in which its surface lies (`pixels_of_boxes`), unless the
    surface is of a class that no object has. Of several boxes, a box whose labelled sides enclose
    the surface goes before one in whose margin it lies, and then the smaller box.

    Args:
        instance: the actors' numbers by pixel.
        boxes: the boxes.
        numbers: numbers of the boxes, those of actors up to `num_actors`.
        camera: the camera of the image.
        depth_m: z of the surfaces that the image shows, 0 = none.
        classes: classes of these surfaces.
        num_actors: number of the scene's actors.
    """
    is_free = (instance == 0) & ~np.isin(classes, _NO_OBJECT)
    volumes = np.prod(boxes.sizes_m, axis=1)
    painted_instance = instance.copy()
    for sided_boxes in (boxes, boxes.without_margins()):
        shown_boxes = list(pixels_of_boxes(sided_boxes, camera, depth_m))
        # The last stays: the smallest, and of equal ones that of the lowest number.
        shown_boxes.sort(key=lambda pixels: (-volumes[pixels[0]], -int(numbers[pixels[0]])))
        for number, rows, columns in shown_boxes:
            if numbers[number] > num_actors:
                is_free_pixel = is_free[rows, columns]
                painted_instance[rows[is_free_pixel], columns[is_free_pixel]] = numbers[number]
    return painted_instance


# ---- Masks of an instance image's objects, as COCO writes them -----------------------------------


def encode_masks(
    instance: UInt16[np.ndarray, "H W"], numbers: UInt16[np.ndarray, " B"]
) -> dict[str, np.ndarray]:
    """Return the pixels that have the number of each box, as COCO writes masks.

    COCO counts down the columns, by turns pixels that are not the object's and pixels that are.
    From the fourth on, a count is the difference to the last but one. Each goes out in groups of
    five bits, the lowest first, as the character 48 + group, plus 32 where more follow; the last
    group's fifth bit is the sign (pycocotools 2.0, maskApi.c).

    Args:
        instance: the instance image.
        numbers: number of each box; 0 for none.

    Returns:
        Columns of B entries: left, top, right, bottom (excluded) and pixels, int64, and rle, COCO's
            compressed run lengths as texts. They are zeros and empty where no pixel has the number.
    """
    height = instance.shape[0]
    flat = cv2.transpose(instance).ravel()
    starts = np.concatenate([[0], np.flatnonzero(flat[1:] != flat[:-1]) + 1])
    ends = np.append(starts[1:], flat.size)
    values = flat[starts]
    object_runs = np.flatnonzero(values)
    object_runs = object_runs[np.argsort(values[object_runs], kind="stable")]
    objects, first = np.unique(values[object_runs], return_index=True)
    runs = dict(zip(objects.tolist(), np.split(object_runs, first[1:]), strict=bool(len(objects))))
    sides = np.zeros((5, len(numbers)), np.int64)
    counts = [np.zeros(0, np.int64) for _ in numbers]
    for box, number in enumerate(numbers.tolist()):
        if (run_numbers := runs.get(number)) is None:
            continue
        begins = starts[run_numbers]
        run_ends = ends[run_numbers]
        edges = np.stack([begins, run_ends], axis=1).ravel()
        edges = edges if edges[-1] == flat.size else np.append(edges, flat.size)
        counts[box] = np.diff(edges, prepend=0)
        counts[box][3:] -= np.diff(edges, prepend=0)[1:-2]
        columns = begins // height
        last = (run_ends - 1) // height
        spans_columns = bool(
            (columns != last).any()
        )  # from one column's foot to the next one's head
        top = 0 if spans_columns else (begins % height).min()
        bottom = height if spans_columns else ((run_ends - 1) % height).max() + 1
        sides[:, box] = columns.min(), top, last.max() + 1, bottom, (run_ends - begins).sum()
    names = ("left", "top", "right", "bottom", "pixels")
    return {**dict(zip(names, sides, strict=True)), "rle": _as_texts(counts)}


def _as_texts(counts: list[np.ndarray]) -> np.ndarray:
    """Return differences of run lengths as COCO's texts."""
    all_counts = np.concatenate([np.zeros(0, np.int64), *counts])
    groups = all_counts[:, None] >> np.arange(0, 35, 5)  # [N, 7]: of 35 bits
    remaining_bits = groups >> 5  # what follows is zeros, or ones of a negative number
    is_last = np.where(groups & 16, remaining_bits == -1, remaining_bits == 0)
    last = is_last.argmax(axis=1)[:, None]
    is_used = np.arange(7) <= last
    has_more = np.arange(7) < last
    text = ((groups & 31) + 48 + 32 * has_more)[is_used].astype(np.uint8).tobytes().decode("ascii")
    ends = np.concatenate([[0], np.cumsum(is_used.sum(axis=1))])  # of the counts' characters
    bounds = ends[
        np.concatenate([[0], np.cumsum([len(box_counts) for box_counts in counts])]).astype(
            np.int64
        )
    ]
    return np.array([text[a:b] for a, b in pairwise(bounds.tolist())], object)
