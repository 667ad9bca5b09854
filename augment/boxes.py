"""Labelled boxes in an image: their pixels, 2D boxes, occlusion, and numbers in instance images."""

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

from augment.cameras import Camera
from augment.geometry import rotmat_from_quat
from augment.kernels import count_occlusion
from augment.labels import Boxes, LabelSource
from augment.memo import memo_of
from augment.scene import Scene
from augment.semantics import SemanticClass

NOT_COUNTED = -1  # in place of a number of pixels

# Which surfaces a box owns. Its lowest 8 cm are left out, for the road under a car is inside the
# box as often as not: labels, ground and depth agree to some 5 cm. Of the pixels in the boxes of a
# recorded drive that makes 1.2 % road, where all of the box has 6.1 % and 4 cm less have 3.5 %, and
# costs 0.3 % of the vehicles'. A low box keeps three quarters.
BOTTOM_M = 0.08
MAX_OF_HEIGHT = 0.25
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


def are_usable(
    numbers: Float64[np.ndarray, "B N"], sizes_m: Float64[np.ndarray, "B 3"]
) -> Bool[np.ndarray, " B"]:
    """Which boxes have numbers [B, N] that are all finite, and sides longer than 0."""
    finite = np.logical_and.reduce(np.isfinite(numbers), axis=1)
    return finite & np.logical_and.reduce(sizes_m > 0, axis=1)


@dataclass(frozen=True, eq=False)
class PlacedBoxes:
    """Boxes in the scene's world. rotations: world_from_box.

    low_m, high_m: the part of each box, along its own axes from its centre, that owns surfaces: its
    lowest centimetres left out and its other sides drawn wider (see BOTTOM_M and SIDES_M).
    sizes_m, corners_m: of the labelled box. is_usable: its numbers are finite, its sides longer
    than 0 and its quaternion is a rotation; other boxes hold zeros.
    """

    is_usable: Bool[np.ndarray, " B"]
    centres_m: Float64[np.ndarray, "B 3"]
    sizes_m: Float64[np.ndarray, "B 3"]
    rotations: Float64[np.ndarray, "B 3 3"]
    low_m: Float64[np.ndarray, "B 3"]
    high_m: Float64[np.ndarray, "B 3"]
    corners_m: Float64[np.ndarray, "B 8 3"]

    def __len__(self) -> int:
        return len(self.is_usable)

    @staticmethod
    def of(boxes: Boxes, world_origin_m: Float64[np.ndarray, "3"]) -> PlacedBoxes:
        numbers = np.concatenate([boxes.centers_m, boxes.sizes_m, boxes.quats], axis=1)
        turned = np.linalg.norm(boxes.quats, axis=1) > 0
        usable = are_usable(numbers, boxes.sizes_m) & turned
        quats = np.where(usable[:, None], boxes.quats, np.array([1.0, 0, 0, 0]))
        rotations = rotmat_from_quat(torch.from_numpy(quats)).numpy()
        centres = np.where(usable[:, None], boxes.centers_m - world_origin_m, 0.0)
        sizes = np.where(usable[:, None], boxes.sizes_m, 0.0)
        low, high = -sizes / 2 - SIDES_M, sizes / 2 + SIDES_M
        low[:, 2] = -sizes[:, 2] / 2 + np.minimum(BOTTOM_M, MAX_OF_HEIGHT * sizes[:, 2])
        corners = _to_world(centres, rotations, CORNERS * sizes[:, None, :])
        return PlacedBoxes(usable, centres, sizes, rotations, low, high, corners)

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
    seen = (np.maximum(a[..., 2], b[..., 2]) > NEAR_M) & placed.is_usable[:, None]
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


# ---- Outlines of projected boxes, and what hides them --------------------------------------------
# A box's own axes: x along its length, y its width, z its height. Pixels count from the image's
# upper left corner: the first one's centre is at 0.5.


@dataclass(frozen=True, eq=False)
class Outlines:
    """Projected boxes. xyxy: left, top, right, bottom of what lies inside the image, zeros of boxes
    out of view. in_view: whether any of the box lies in the image, hidden by others or not.
    truncated_fraction: of the projection's area, what lies outside the image; 1 of boxes out of
    view, NaN of those that are not usable (`are_usable`).
    """

    xyxy: Float64[np.ndarray, "B 4"]
    in_view: Bool[np.ndarray, " B"]
    truncated_fraction: Float64[np.ndarray, " B"]


@dataclass(frozen=True, eq=False)
class Occlusion:
    """Pixels of boxes. shown: that show each. hidden: inside its outline, that show what stands
    before it. xyxy: left, top, right, bottom of the shown ones, NaN where there are none. owners:
    1 + the smallest of the boxes that a pixel shows by depth, 0 = none; None unless asked for.
    """

    shown: Int64[np.ndarray, " B"]
    hidden: Int64[np.ndarray, " B"]
    xyxy: Float64[np.ndarray, "B 4"]
    owners: UInt16[np.ndarray, "H W"] | None = None


def outline_placed(placed: PlacedBoxes, camera: Camera) -> Outlines:
    """The outlines of boxes in the scene's world."""
    world_from_camera = camera.world_from_camera.numpy()
    rotation = world_from_camera[:3, :3]
    centers_m = (placed.centres_m - world_from_camera[:3, 3]) @ rotation
    rotations = np.where(placed.is_usable[:, None, None], rotation.T @ placed.rotations, np.nan)
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
    usable = are_usable(numbers, sizes_m)
    centers_m, sizes_m = np.where(usable[:, None], (centers_m, sizes_m), 0.0)
    rotations = np.where(usable[:, None, None], rotations, np.eye(3))
    corners_m = centers_m[:, None] + (CORNERS * sizes_m[:, None]) @ rotations.transpose(0, 2, 1)
    size = np.array(image_size, np.float64)
    ends, seen = _edges_in_image(corners_m, K, size)  # [B, E, 2]
    image_corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size
    points = np.concatenate([ends, np.broadcast_to(image_corners, (len(ends), 4, 2))], axis=1)
    shown = [seen, _hit(centers_m, sizes_m, rotations, image_corners, K)]
    shown = np.concatenate(shown, axis=1)[..., None]
    low = np.where(shown, points, np.inf).min(axis=1, initial=np.inf)
    high = np.where(shown, points, -np.inf).max(axis=1, initial=-np.inf)
    in_view = usable & (high > low).all(axis=1)
    xyxy = np.where(in_view[:, None], np.concatenate([low, high], axis=1), 0.0)
    truncated = np.where(usable, 1.0, np.nan)
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
    *,
    classes: UInt8[np.ndarray, "H W"] | None = None,
    with_owners: bool = False,
) -> Occlusion:
    """Which pixels show each box, and which show what stands before it.

    A pixel shows a box whose part that owns surfaces (`box_pixels`) has the surface there. It shows
    what hides the box if its ray meets the labelled box, and the surface lies before that part.
    Where the background is seen through the outline, for a car does not fill its box, or the sky,
    it does neither.

    depth_m: z of the surface, 0 = none. instance, actors: where they are known, the actors' numbers
    by pixel and by box, 0 = none. An actor's pixels are then those with its number, wherever they
    are, and no other box's. classes: of those surfaces, where they are known. A surface of a class
    that no object is of (a bush beside a car, the road under it) shows no box that it lies in.
    """
    count = len(placed)
    numbers = np.zeros(count, np.int64) if actors is None else actors.astype(np.int64)
    if instance is None:
        instance, numbers = np.zeros((0, 0), np.uint16), np.zeros(count, np.int64)
    scenery = np.zeros((0, 0), bool) if classes is None else np.isin(classes, _NO_OBJECT)
    world_from_camera = camera.world_from_camera.numpy()
    box_from_world = placed.rotations.transpose(0, 2, 1)
    axes = box_from_world @ world_from_camera[:3, :3]  # columns: the camera's axes in each box
    eyes = box_from_world @ (world_from_camera[:3, 3] - placed.centres_m)[..., None]
    half = placed.sizes_m / 2
    found = np.zeros((count, 6), np.int64)
    owners = np.zeros(depth_m.shape if with_owners else (0, 0), np.uint16)
    count_occlusion(
        np.ascontiguousarray(depth_m),
        np.ascontiguousarray(instance),
        scenery,
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
        owners,
    )
    shown, bounds = found[:, 0], found[:, 2:].astype(np.float64)
    modal = np.where(shown[:, None] > 0, bounds, np.nan)
    return Occlusion(shown, found[:, 1], modal, owners if with_owners else None)


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
    z = np.maximum(ends[..., 2:], NEAR_M)  # nearer ones belong to edges that are not seen
    pixels = ends[..., :2] / z * K[[0, 1], [0, 1]] + K[:2, 2]
    return pixels, np.concatenate([seen, seen], axis=1)


def _hull_area(points: np.ndarray) -> float:
    """Of the convex hull of points [P, 2]."""
    middle = points.mean(axis=0)
    reach = max(float(np.abs(points - middle).max()), 1e-9)  # OpenCV's are float32
    hull = cv2.convexHull(((points - middle) / reach).astype(np.float32))
    return cv2.contourArea(hull) * reach**2


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


# ---- The numbers of a scene's objects, one for each, in instance images and beside its boxes -----
# An actor has 1 + its index in the scene. Boxes without an actor (parked cars: splats of the
# background) come after those, by tracks, in the order in which the frames of the whole scene first
# show them. So a number depends neither on the frames and cameras that are rendered nor on who
# renders them.

MAX_INSTANCE = 65535  # instance images have 16 bits
# Classes that no labelled object is of: they lie under it, beside it, before it or behind it.
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
    """Numbers of the objects of one scene. Picklable.

    actors: their track_ids, in the scene's order. frames: numbers of all its frames. labels: None
    where there are no boxes.
    """

    own_bytes: ClassVar[int] = 0  # labels are the scene's

    actors: tuple[str, ...]
    frames: tuple[int, ...]
    labels: LabelSource | None

    @cached_property
    def by_track(self) -> Mapping[str, int]:
        """The number of every track. The first use reads the boxes of all frames; those of a frame
        that cannot be read are left out, for that is an error of the frame's own images.
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

    def agree(self, track_ids: tuple[str, ...], numbers: np.ndarray) -> bool:
        """Whether boxes numbered so earlier have these numbers today; of tracks that are known."""
        known = np.array([track_id in self.by_track for track_id in track_ids], bool)
        return bool((self.of(track_ids) == numbers)[known].all())

    def of(self, track_ids: tuple[str, ...]) -> UInt16[np.ndarray, " B"]:
        """The number of each box, by its track; 0 of what is no track of the scene's frames, or
        beyond MAX_INSTANCE.
        """
        numbers = np.array([self.by_track.get(track_id, 0) for track_id in track_ids], np.int64)
        return np.where(numbers > MAX_INSTANCE, 0, numbers).astype(np.uint16)


def instances_of(scene: Scene) -> Instances:
    """The numbers of the scene's objects, remembered as long as the scene lives."""
    actors = tuple(actor.track_id for actor in scene.actors)
    frames = tuple(sorted(frame.index for frame in scene.frames))
    return memo_of(scene).get(("instances",), lambda: Instances(actors, frames, scene.labels))


def with_boxes(
    instance: UInt16[np.ndarray, "H W"],
    placed: PlacedBoxes,
    numbers: UInt16[np.ndarray, " B"],
    camera: Camera,
    depth_m: Float32[np.ndarray, "H W"],
    classes: UInt8[np.ndarray, "H W"],
    num_actors: int,
) -> UInt16[np.ndarray, "H W"]:
    """The instance image of a scene's actors with the boxes that have none.

    A pixel of no actor shows the box in which its surface lies (`box_pixels.shown_pixels`), unless
    it is of a class that no object is of. Of several boxes it is that whose labelled sides enclose
    the surface before one of which it lies in the margin, and then the smaller one.

    numbers: of the boxes, those of actors up to num_actors. depth_m, classes: of the surfaces that
    the image shows, 0 = none.
    """
    free = (instance == 0) & ~np.isin(classes, _NO_OBJECT)
    volumes = np.prod(placed.sizes_m, axis=1)
    painted = instance.copy()
    for boxes in (placed, placed.without_margins()):
        shown = list(shown_pixels(boxes, camera, depth_m))
        # The last stays: the smallest, and of equal ones that of the lowest number.
        shown.sort(key=lambda pixels: (-volumes[pixels[0]], -int(numbers[pixels[0]])))
        for number, rows, columns in shown:
            if numbers[number] > num_actors:
                own = free[rows, columns]
                painted[rows[own], columns[own]] = numbers[number]
    return painted


# ---- Masks of an instance image's objects, as COCO writes them -----------------------------------


def encode_masks(
    instance: UInt16[np.ndarray, "H W"], numbers: UInt16[np.ndarray, " B"]
) -> dict[str, np.ndarray]:
    """Of each box the pixels that have its number: left, top, right, bottom (excluded) and pixels,
    int64 [B], and rle, texts [B]: COCO's compressed run lengths. Zeros and empty where no pixel
    has the number, or it is 0.

    COCO counts down the columns, by turns pixels that are not the object's and pixels that are.
    From the fourth on a count is the difference to the last but one. Each goes out in groups of
    five bits, the lowest first, as the character 48 + group, plus 32 where more follow; the last
    group's fifth bit is the sign (pycocotools 2.0, maskApi.c).
    """
    height = instance.shape[0]
    flat = cv2.transpose(instance).ravel()
    starts = np.concatenate([[0], np.flatnonzero(flat[1:] != flat[:-1]) + 1])
    ends, values = np.append(starts[1:], flat.size), flat[starts]
    shown = np.flatnonzero(values)
    shown = shown[np.argsort(values[shown], kind="stable")]
    objects, first = np.unique(values[shown], return_index=True)
    runs = dict(zip(objects.tolist(), np.split(shown, first[1:]), strict=bool(len(objects))))
    sides = np.zeros((5, len(numbers)), np.int64)
    counts = [np.zeros(0, np.int64) for _ in numbers]
    for box, number in enumerate(numbers.tolist()):
        if (own := runs.get(number)) is None:
            continue
        begin, end = starts[own], ends[own]
        edges = np.stack([begin, end], axis=1).ravel()
        edges = edges if edges[-1] == flat.size else np.append(edges, flat.size)
        counts[box] = np.diff(edges, prepend=0)
        counts[box][3:] -= np.diff(edges, prepend=0)[1:-2]
        columns, last = begin // height, (end - 1) // height
        spans = bool((columns != last).any())  # from one column's foot to the next one's head
        top = 0 if spans else (begin % height).min()
        bottom = height if spans else ((end - 1) % height).max() + 1
        sides[:, box] = columns.min(), top, last.max() + 1, bottom, (end - begin).sum()
    names = ("left", "top", "right", "bottom", "pixels")
    return {**dict(zip(names, sides, strict=True)), "rle": _as_texts(counts)}


def _as_texts(counts: list[np.ndarray]) -> np.ndarray:
    """Differences of run lengths as COCO's texts."""
    joined = np.concatenate([np.zeros(0, np.int64), *counts])
    groups = joined[:, None] >> np.arange(0, 35, 5)  # [N, 7]: of 35 bits
    rest = groups >> 5  # what follows is zeros, or ones of a negative number
    is_last = np.where(groups & 16, rest == -1, rest == 0)
    last = is_last.argmax(axis=1)[:, None]
    used, more = np.arange(7) <= last, np.arange(7) < last
    text = ((groups & 31) + 48 + 32 * more)[used].astype(np.uint8).tobytes().decode("ascii")
    ends = np.concatenate([[0], np.cumsum(used.sum(axis=1))])  # of the counts' characters
    bounds = ends[np.concatenate([[0], np.cumsum([len(own) for own in counts])]).astype(np.int64)]
    return np.array([text[a:b] for a, b in pairwise(bounds.tolist())], object)
