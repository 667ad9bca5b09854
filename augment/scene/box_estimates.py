"""2D boxes of objects that rendered depth does not resolve, from their 3D boxes and LiDAR returns.

In: the labelled boxes of a frame, their outlines and occlusion in an image (`augment.scene.boxes`),
and the frame's LiDAR. Out: `estimate_boxes` gives the pixels of such boxes;
`augment.view.box_labels` puts them into label tables.

A few returns of a far car make no surface: the depth there is that of other splats, before it or
behind it. Its LiDAR returns still prove that nothing hides it. Such a box is taken to show the
pixels of its projection, without those that

    another labelled box hides    whose projection covers them from nearer, or
    a surface certainly hides     the nearest return in the image, of those on the box and those
                                  clearly before it, is before it.

Nothing is estimated for a box without returns in it, for it may stand behind a wall; nor for one
with many, whose depth can be believed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial import KDTree

from augment.errors import ClimateGSError
from augment.memo import LatestValue, memo_of
from augment.scene.boxes import MIN_DEPTH_M, Occlusion, Outlines, WorldBoxes
from augment.scene.cameras import Camera
from augment.scene.pixel_rays import depth_of, local_rays, project_points
from augment.scene.scene import Scene

_log = logging.getLogger(__name__)

# Share of an object's pixels below which depth does not resolve it. Of a resolved object depth
# shows half and more: a car fills three quarters of its projected box.
MIN_SHOWN_FRACTION = 0.25
# Returns in the box that prove a free line of sight; one or two may be stray or on the ground.
MIN_RETURNS = 3
# Returns in the box beyond which depth can find its surface.
MAX_RETURNS = 100
# Height of a box's lowest part in which returns may be the ground's, metres; far off, the ground's
# height is known to some 20 cm.
GROUND_M = 0.25
# Height of that part over the height of the box, at most.
MAX_GROUND_FRACTION = 0.25
# Distance before a box from which a surface hides it, along the optical axis, metres.
MIN_OCCLUDER_GAP_M = 0.5
# Pixels of a projected box below which its shape is not known.
MIN_OUTLINE_PX = 36
# Splats in a box from which the scene is taken to draw its object.
MIN_SPLATS = 3


@dataclass(frozen=True, eq=False)
class SortedPoints:
    """Finite points in the scene's world, ordered by x, so that a box's are found among few."""

    points_m: Float[np.ndarray, "N 3"]
    """The points."""

    @staticmethod
    def from_points(points_m: np.ndarray) -> SortedPoints:
        """Return the finite points of an array, ordered by x."""
        points_m = points_m[np.isfinite(points_m).all(axis=1)]
        return SortedPoints(points_m[np.argsort(points_m[:, 0], kind="stable")])

    def inside(
        self, boxes: WorldBoxes, number: int, low_m: np.ndarray, *, with_margins: bool = True
    ) -> Int64[np.ndarray, " P"]:
        """Return indices of the points in a box.

        Args:
            boxes: the boxes.
            number: index of the box.
            low_m: lowest corner of the part that counts, in the box's axes from its centre.
            with_margins: if True, sides reach as far as the box owns surfaces; else as far as it is
                labelled.
        """
        high_m = boxes.high_m[number] if with_margins else boxes.sizes_m[number] / 2
        centre = boxes.centres_m[number]
        reach_m = np.linalg.norm(np.maximum(np.abs(low_m), high_m))
        ends = np.array([centre[0] - reach_m, centre[0] + reach_m], self.points_m.dtype)
        first, last = np.searchsorted(self.points_m[:, 0], ends)
        points = self.points_m[first:last]
        candidates = np.flatnonzero(np.abs(points[:, 1] - centre[1]) <= reach_m)
        return first + candidates[_are_inside(points[candidates], boxes, number, low_m, high_m)]


def _are_inside(
    points_m: np.ndarray, boxes: WorldBoxes, number: int, low_m: np.ndarray, high_m: np.ndarray
) -> Bool[np.ndarray, " P"]:
    """Return the mask of points [P, 3] between two corners of a box, in the box's axes."""
    local_m = (points_m.astype(np.float64) - boxes.centres_m[number]) @ boxes.rotations[number]
    return ((local_m >= low_m) & (local_m <= high_m)).all(axis=1)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of a frame's objects besides rendered depth."""

    returns: SortedPoints
    """LiDAR returns of the frame."""
    splats: SortedPoints
    """Centres of the background's splats."""
    actors: frozenset[str]
    """Track ids of the scene's actors."""

    def shows_object(self, boxes: WorldBoxes, number: int, track_id: str) -> bool:
        """Return True if the scene's splats show the object of a box."""
        if track_id in self.actors:
            return True
        return len(self.splats.inside(boxes, number, boxes.low_m[number])) >= MIN_SPLATS


def evidence_of(scene: Scene, frame: int) -> Evidence | None:
    """Return the evidence of a frame, kept for its other images.

    None without a sweep that can be read.
    """

    def read() -> Evidence | None:
        try:
            sweep = scene.lidar(frame)
        except ClimateGSError as error:  # the sweep's own file reports it, where that is asked for
            _log.warning("frame %d: no 2D box is estimated without its sweep: %s", frame, error)
            return None
        if sweep is None:
            return None
        points_m = sweep.points_m - np.asarray(scene.world_origin_m, np.float64)
        points_m = _without_moved(scene, frame, points_m)
        returns = SortedPoints.from_points(points_m)
        actors = frozenset(actor.track_id for actor in scene.actors)
        splats = memo_of(scene.as_recorded).get(("sorted splats",), sort_splats)
        return Evidence(returns, splats, actors)

    def sort_splats() -> SortedPoints:
        return SortedPoints.from_points(scene.background.means.detach().cpu().numpy())

    memo = memo_of(scene)
    return memo.get(("evidence of boxes",), LatestValue).get(frame, read)


def _without_moved(
    scene: Scene, frame: int, points_m: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "M 3"]:
    """Return the returns of a sweep without those in boxes of moved actors, there and here.

    The sweep shows these actors where they were recorded, and other things where they are.
    """
    if not scene.moved_instances:
        return points_m
    moved_ids = {scene.actors[number - 1].track_id for number in scene.moved_instances}
    is_free = np.ones(len(points_m), bool)
    for labels in (scene.as_recorded.boxes(frame), scene.boxes(frame)):
        boxes = WorldBoxes.from_labels(labels, scene.world_origin_m)
        for number, track_id in enumerate(labels.track_ids):
            if track_id in moved_ids and boxes.is_usable[number]:
                low_m = boxes.low_m[number]
                high_m = boxes.high_m[number]
                is_free &= ~_are_inside(points_m, boxes, number, low_m, high_m)
    return points_m[is_free]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pixels of one box."""

    rows: Int64[np.ndarray, " P"]
    """Rows of the pixels that show it."""
    columns: Int64[np.ndarray, " P"]
    """Columns of the pixels that show it."""
    num_hidden: int
    """Number of pixels of its projection that other things hide."""

    @property
    def num_pixels(self) -> int:
        """Return the number of pixels that show the box."""
        return len(self.rows)

    @property
    def xyxy(self) -> Float64[np.ndarray, "4"]:
        """Return left, top, right, bottom of the pixels, right and bottom excluded."""
        low = [self.columns.min(), self.rows.min()]
        high = [self.columns.max() + 1, self.rows.max() + 1]
        return np.array([*low, *high], np.float64)


def estimate_boxes(
    boxes: WorldBoxes,
    track_ids: tuple[str, ...],
    camera: Camera,
    outlines: Outlines,
    occlusion: Occlusion,
    evidence: Callable[[], Evidence | None],
    *,
    on_photo: bool,
    own_car: Bool[np.ndarray, "H W"] | None = None,
    buried_m: Float64[np.ndarray, " B"] | None = None,
) -> dict[int, Estimate]:
    """Return estimates of the boxes that depth does not resolve, by box index.

    Args:
        boxes: the boxes, as they are labelled.
        track_ids: track of each box.
        camera: camera of the image.
        outlines: the projected boxes.
        occlusion: pixels of the boxes by rendered depth.
        evidence: reads the frame's evidence; called only where a box needs it.
        on_photo: True for a recorded picture, which also shows what has no splats.
        own_car: pixels of the recording car, which hide what is behind them.
        buried_m: height of the lowest part of each box that snow on the ground hides; None: 0.
    """
    buried_m = np.zeros(len(boxes)) if buried_m is None else buried_m
    areas = (outlines.xyxy[:, 2:] - outlines.xyxy[:, :2]).prod(axis=1)
    is_doubtful = (occlusion.num_shown < MIN_SHOWN_FRACTION * areas) & (areas >= MIN_OUTLINE_PX)
    numbers = np.flatnonzero(is_doubtful & outlines.in_view)
    frame_evidence = evidence() if len(numbers) else None
    estimates: dict[int, Estimate] = {}
    if frame_evidence is None:
        return estimates
    view = _BoxesInImage(boxes, camera, outlines, frame_evidence.returns, own_car, buried_m)
    for number in numbers.tolist():
        estimate = view.estimate(number)
        if estimate is None or occlusion.num_shown[number] >= MIN_SHOWN_FRACTION * len(
            estimate.rows
        ):
            continue
        if on_photo or frame_evidence.shows_object(boxes, number, track_ids[number]):
            estimates[number] = estimate
    return estimates


@dataclass(eq=False)
class _BoxesInImage:
    """A frame's boxes and returns before one camera; fields are as in `estimate_boxes`."""

    boxes: WorldBoxes
    camera: Camera
    outlines: Outlines
    returns: SortedPoints
    """LiDAR returns of the frame."""
    own_car: Bool[np.ndarray, "H W"] | None
    buried_m: Float64[np.ndarray, " B"]

    @cached_property
    def _projected(self) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels [N, 2] of all returns and their depths [N] (see `_project`)."""
        return self._project(self.returns.points_m)

    def _project(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels [P, 2] of points [P, 3], NaN behind the camera, and their depths [P]."""
        camera = self.camera
        camera_from_world = self.camera.camera_from_world.numpy()
        local = points_m @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        if not camera.is_pinhole:
            return project_points(camera, points_m)[0], depth_of(camera, local)
        z = np.where(local[:, 2] > MIN_DEPTH_M, local[:, 2], np.nan)
        pixels = local[:, :2] / z[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        return pixels, local[:, 2]

    def estimate(self, number: int) -> Estimate | None:
        """Return the pixels of one box; None where the returns do not prove that it is in sight."""
        on_box = self.returns.inside(
            self.boxes, number, self._above_ground(number), with_margins=False
        )
        if not MIN_RETURNS <= len(on_box) <= MAX_RETURNS or not self._may_show(number, on_box):
            return None
        left, top = np.floor(self.outlines.xyxy[number, :2]).astype(int).tolist()
        right, bottom = np.ceil(self.outlines.xyxy[number, 2:]).astype(int).tolist()
        rows, columns = (grid.ravel() for grid in np.mgrid[top:bottom, left:right])
        centres = np.stack([columns, rows], axis=1) + 0.5
        enter, leave = self._spans(number, centres)
        is_in_outline = enter <= leave
        is_free = is_in_outline & ~self._covered(number, centres, enter)
        if self.own_car is not None:
            is_free &= ~self.own_car[rows, columns]
        if (
            is_in_outline.sum() < MIN_OUTLINE_PX
            or is_free.sum() < MIN_SHOWN_FRACTION * is_in_outline.sum()
        ):
            return None
        pixels_on_box, pixels_before, num_behind = self._returns_at(
            number, on_box, (left, top, right, bottom), is_free
        )
        # Returns that pass through the box and end behind it prove that the object does not fill
        # the box, as a crane does not. Depth that passes through it is right, too.
        if len(pixels_on_box) < max(MIN_RETURNS, num_behind):
            return None
        _, nearest = KDTree(np.concatenate([pixels_on_box, pixels_before])).query(centres[is_free])
        shown_pixels = np.flatnonzero(is_free)[nearest < len(pixels_on_box)]
        if (
            len(shown_pixels) <= is_free.sum() / 2
            or len(shown_pixels) < MIN_SHOWN_FRACTION * is_in_outline.sum()
        ):
            return None
        return Estimate(
            rows[shown_pixels], columns[shown_pixels], int(is_in_outline.sum()) - len(shown_pixels)
        )

    def _may_show(self, number: int, on_box: np.ndarray) -> bool:
        """Return True if enough returns on a box lie in the image and before other boxes.

        This quick check spares most boxes the look at every pixel.
        """
        pixels, _ = self._project(self.returns.points_m[on_box])
        low, high = np.split(self.outlines.xyxy[number], 2)
        with np.errstate(invalid="ignore"):  # NaN
            pixels = pixels[((pixels >= low) & (pixels < high)).all(axis=1)]
        enter, _ = self._spans(number, pixels)
        return int((~self._covered(number, pixels, enter)).sum()) >= MIN_RETURNS

    def _covered(self, number: int, centres: np.ndarray, enter: np.ndarray) -> np.ndarray:
        """Return the mask of pixels [P] whose rays meet another box before this one.

        Args:
            number: index of this box.
            centres: the pixels, [P, 2].
            enter: depth at which the rays enter this box, [P].
        """
        xyxy = self.outlines.xyxy
        low = np.maximum(xyxy[:, :2], xyxy[number, :2])
        high = xyxy[:, 2:]
        is_overlapping = (low < np.minimum(high, xyxy[number, 2:])).all(
            axis=1
        ) & self.outlines.in_view
        is_covered = np.zeros(len(centres), bool)
        for other in np.flatnonzero(is_overlapping).tolist():
            begin, end = self._spans(other, centres)
            is_covered |= (begin <= end) & (begin < enter)
        return is_covered

    def _returns_at(
        self,
        number: int,
        on_box: np.ndarray,
        window: tuple[int, int, int, int],
        is_free_pixel: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the pixels of returns on a box and before it.

        Args:
            number: index of the box.
            on_box: indices of the returns in the box.
            window: left, top, right, bottom of its pixels.
            is_free_pixel: mask of the window's pixels that no other box covers.

        Returns:
            Pixels [P, 2] of returns on the box, at free pixels; pixels of returns clearly before it
            that are in no other box; and the number of returns that end behind it, at free pixels.
        """
        pixels, depths_m = self._projected
        left, top, right, bottom = window
        with np.errstate(invalid="ignore"):  # NaN
            is_in_window = (pixels >= (left, top)) & (pixels < (right, bottom))
        candidates = np.flatnonzero(is_in_window.all(axis=1))
        column, row = np.floor(pixels[candidates]).astype(int).T
        is_free = is_free_pixel[(row - top) * (right - left) + (column - left)]
        enter, leave = self._spans(number, pixels[candidates])
        is_on = np.isin(candidates, on_box)
        is_before = (enter <= leave) & (depths_m[candidates] < enter - MIN_OCCLUDER_GAP_M)
        is_behind = (enter <= leave) & (depths_m[candidates] > leave) & is_free
        before_box = candidates[is_before]
        is_in_box = np.zeros(len(before_box), bool)
        boxes = self.boxes
        for other in np.flatnonzero(boxes.is_usable).tolist() if len(before_box) else ():
            corners = boxes.low_m[other], boxes.high_m[other]
            is_in_box |= _are_inside(self.returns.points_m[before_box], boxes, other, *corners)
        return (
            pixels[candidates[is_on & is_free]],
            pixels[before_box[~is_in_box]],
            int(is_behind.sum()),
        )

    def _spans(self, number: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the depths [P] at which rays enter a labelled box and leave it.

        For rays that pass beside the box, `enter` is the larger one. The buried part of the box
        does not count.

        Args:
            number: index of the box.
            pixels: pixels of the rays, [P, 2].
        """
        camera = self.camera
        rotation = self.boxes.rotations[number]
        world_from_camera = camera.world_from_camera.numpy()
        rays = local_rays(camera, pixels) @ world_from_camera[:3, :3].T @ rotation
        rays = np.where(rays == 0, 1e-300, rays)
        eye = (world_from_camera[:3, 3] - self.boxes.centres_m[number]) @ rotation
        high = self.boxes.sizes_m[number] / 2
        low = -high
        low[2] = min(low[2] + self.buried_m[number], high[2])
        with np.errstate(over="ignore"):  # of a ray along a side
            a = (low - eye) / rays
            b = (high - eye) / rays
        enter = np.minimum(a, b)
        leave = np.maximum(a, b)
        first_depth = np.maximum(np.maximum(enter[:, 0], enter[:, 1]), enter[:, 2])
        return np.maximum(first_depth, MIN_DEPTH_M), np.minimum(
            np.minimum(leave[:, 0], leave[:, 1]), leave[:, 2]
        )

    def _above_ground(self, number: int) -> np.ndarray:
        """Return the lowest corner of the part of a box in which a return is not the ground's."""
        size = self.boxes.sizes_m[number]
        low = -size / 2
        low[2] += min(GROUND_M, MAX_GROUND_FRACTION * size[2])
        return low
