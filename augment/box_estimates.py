"""2D boxes of objects that rendered depth does not resolve, by their 3D boxes and LiDAR returns.

A few returns of a far car make no surface: the depth there is that of other splats, before it or
behind it. Its LiDAR returns still prove that nothing hides it. Such a box is taken to show the
pixels of its projection that remain when those are taken away that

    another labelled box hides    whose projection covers them from nearer, or
    a surface certainly hides     the nearest return in the image, of those on the box and those
                                  clearly before it, is before it.

Nothing is estimated of a box without returns in it, for it may stand behind a wall; nor of one with
many, of which depth can be believed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial import KDTree

from augment.boxes import NEAR_M, Occlusion, Outlines, PlacedBoxes
from augment.cameras import Camera
from augment.errors import ClimateGSError
from augment.memo import Latest, memo_of
from augment.scene import Scene

_log = logging.getLogger(__name__)

# Of the pixels that an object should show, depth shows less than this part: it is not resolved.
# Of objects that are, it shows half and more: a car fills three quarters of its projected box.
MIN_SHOWN = 0.25
# Returns in the box that prove a free line of sight; one or two may be stray or on the ground.
MIN_RETURNS = 3
# Surfaces can be found among more returns than these.
MAX_RETURNS = 100
# Returns in a box's lowest part may be the ground's, whose height is known to some 20 cm far off.
GROUND_M = 0.25
MAX_OF_HEIGHT = 0.25
# A surface hides a box that is nearer than it by more than this along the optical axis.
CLEAR_M = 0.5
# Pixels of a projected box below which its shape is not known.
MIN_OUTLINE_PX = 36
# Splats in a box from which the scene is taken to draw its object.
MIN_SPLATS = 3


@dataclass(frozen=True, eq=False)
class SortedPoints:
    """Finite points in the scene's world, ordered by x, so that a box's are found among few."""

    points_m: Float[np.ndarray, "N 3"]

    @staticmethod
    def of(points_m: np.ndarray) -> SortedPoints:
        points_m = points_m[np.isfinite(points_m).all(axis=1)]
        return SortedPoints(points_m[np.argsort(points_m[:, 0], kind="stable")])

    def inside(
        self, placed: PlacedBoxes, number: int, low_m: np.ndarray, *, margins: bool = True
    ) -> Int64[np.ndarray, " P"]:
        """Indices of the points in a box, from low_m in its axes up; its sides as they are
        labelled, or with the margins in which they own surfaces.
        """
        high_m = placed.high_m[number] if margins else placed.sizes_m[number] / 2
        centre = placed.centres_m[number]
        reach = np.linalg.norm(np.maximum(np.abs(low_m), high_m))
        ends = np.array([centre[0] - reach, centre[0] + reach], self.points_m.dtype)
        first, last = np.searchsorted(self.points_m[:, 0], ends)
        points = self.points_m[first:last]
        near = np.flatnonzero(np.abs(points[:, 1] - centre[1]) <= reach)
        return first + near[_are_inside(points[near], placed, number, low_m, high_m)]


def _are_inside(
    points_m: np.ndarray, placed: PlacedBoxes, number: int, low_m: np.ndarray, high_m: np.ndarray
) -> Bool[np.ndarray, " P"]:
    """Return for points [P, 3] if they lie between two corners of a box, in the box's axes."""
    along = (points_m.astype(np.float64) - placed.centres_m[number]) @ placed.rotations[number]
    return ((along >= low_m) & (along <= high_m)).all(axis=1)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of a frame's objects besides rendered depth.

    returns: of the frame's sweep. splats: centres of the background's splats. actors: track_ids of
    the scene's actors.
    """

    returns: SortedPoints
    splats: SortedPoints
    actors: frozenset[str]

    def draws(self, placed: PlacedBoxes, number: int, track_id: str) -> bool:
        """Return True if the scene's splats show the object of a box."""
        if track_id in self.actors:
            return True
        return len(self.splats.inside(placed, number, placed.low_m[number])) >= MIN_SPLATS


def evidence_of(scene: Scene, frame: int) -> Evidence | None:
    """The evidence of a frame, kept for its other images; None without a sweep that can be read."""

    def read() -> Evidence | None:
        try:
            sweep = scene.lidar(frame)
        except ClimateGSError as error:  # of the sweep's own file, where that is asked for
            _log.warning("frame %d: no 2D box is estimated without its sweep: %s", frame, error)
            return None
        if sweep is None:
            return None
        returns = SortedPoints.of(sweep.points_m - np.asarray(scene.world_origin_m, np.float64))
        actors = frozenset(actor.track_id for actor in scene.actors)
        return Evidence(returns, memo.get(("sorted splats",), sort_splats), actors)

    def sort_splats() -> SortedPoints:
        return SortedPoints.of(scene.background.means.detach().cpu().numpy())

    memo = memo_of(scene)
    return memo.get(("evidence of boxes",), Latest).get(frame, read)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pixels of one box. rows, columns [P]: that show it. hidden: how many of its projection other
    things hide.
    """

    rows: Int64[np.ndarray, " P"]
    columns: Int64[np.ndarray, " P"]
    hidden: int

    @property
    def pixels(self) -> int:
        return len(self.rows)

    @property
    def xyxy(self) -> Float64[np.ndarray, "4"]:
        """Left, top, right, bottom of the pixels, right and bottom excluded."""
        low = [self.columns.min(), self.rows.min()]
        high = [self.columns.max() + 1, self.rows.max() + 1]
        return np.array([*low, *high], np.float64)


def estimate_boxes(
    placed: PlacedBoxes,
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
    """Return estimates of those boxes that depth does not resolve, by their places.

    Args:
        placed: the boxes, as they are labelled.
        track_ids: of the boxes.
        camera: of the image.
        outlines: the projected boxes.
        occlusion: what rendered depth shows of them.
        evidence: reads the frame's evidence; called only where a box needs it.
        on_photo: the picture is a recorded one, which shows also what has no splats.
        own_car: pixels of the recording car, which hide what is behind them.
        buried_m: height of the lowest part of each box that snow on the ground hides; None: 0.
    """
    buried_m = np.zeros(len(placed)) if buried_m is None else buried_m
    areas = (outlines.xyxy[:, 2:] - outlines.xyxy[:, :2]).prod(axis=1)
    doubtful = (occlusion.shown < MIN_SHOWN * areas) & (areas >= MIN_OUTLINE_PX)
    numbers = np.flatnonzero(doubtful & outlines.in_view)
    known = evidence() if len(numbers) else None
    estimates: dict[int, Estimate] = {}
    if known is None:
        return estimates
    view = _BoxesInView(placed, camera, outlines, known.returns, own_car, buried_m)
    for number in numbers.tolist():
        estimate = view.estimate(number)
        if estimate is None or occlusion.shown[number] >= MIN_SHOWN * len(estimate.rows):
            continue
        if on_photo or known.draws(placed, number, track_ids[number]):
            estimates[number] = estimate
    return estimates


@dataclass(eq=False)
class _BoxesInView:
    """A frame's boxes and returns before one camera. The fields are as in `estimate_boxes`."""

    placed: PlacedBoxes
    camera: Camera
    outlines: Outlines
    returns: SortedPoints
    own_car: Bool[np.ndarray, "H W"] | None
    buried_m: Float64[np.ndarray, " B"]

    @cached_property
    def _projected(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [N, 2] of all returns and their depths [N] (see `_project`)."""
        return self._project(self.returns.points_m)

    def _project(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [P, 2] of points [P, 3], NaN behind the camera, and their depths [P]."""
        camera, camera_from_world = self.camera, self.camera.camera_from_world.numpy()
        local = points_m @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        z = np.where(local[:, 2] > NEAR_M, local[:, 2], np.nan)
        pixels = local[:, :2] / z[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        return pixels, local[:, 2]

    def estimate(self, number: int) -> Estimate | None:
        """Return the pixels of one box; None where the returns do not prove that it is in sight."""
        on_box = self.returns.inside(self.placed, number, self._above_ground(number), margins=False)
        if not MIN_RETURNS <= len(on_box) <= MAX_RETURNS or not self._may_show(number, on_box):
            return None
        left, top = np.floor(self.outlines.xyxy[number, :2]).astype(int).tolist()
        right, bottom = np.ceil(self.outlines.xyxy[number, 2:]).astype(int).tolist()
        rows, columns = (grid.ravel() for grid in np.mgrid[top:bottom, left:right])
        centres = np.stack([columns, rows], axis=1) + 0.5
        enter, leave = self._spans(number, centres)
        outline = enter <= leave
        free = outline & ~self._covered(number, centres, enter)
        if self.own_car is not None:
            free &= ~self.own_car[rows, columns]
        if outline.sum() < MIN_OUTLINE_PX or free.sum() < MIN_SHOWN * outline.sum():
            return None
        on, before, behind = self._returns_at(number, on_box, (left, top, right, bottom), free)
        # What passes the box and ends behind it says that the object does not fill the box, as of a
        # crane: depth that passes it, too, is right.
        if len(on) < max(MIN_RETURNS, behind):
            return None
        _, nearest = KDTree(np.concatenate([on, before])).query(centres[free])
        shown = np.flatnonzero(free)[nearest < len(on)]
        if len(shown) <= free.sum() / 2 or len(shown) < MIN_SHOWN * outline.sum():
            return None
        return Estimate(rows[shown], columns[shown], int(outline.sum()) - len(shown))

    def _may_show(self, number: int, on_box: np.ndarray) -> bool:
        """Whether enough of the returns on a box lie in the image and before other boxes: a quick
        check that spares most boxes the look at every pixel.
        """
        pixels, _ = self._project(self.returns.points_m[on_box])
        low, high = np.split(self.outlines.xyxy[number], 2)
        with np.errstate(invalid="ignore"):  # NaN
            pixels = pixels[((pixels >= low) & (pixels < high)).all(axis=1)]
        enter, _ = self._spans(number, pixels)
        return int((~self._covered(number, pixels, enter)).sum()) >= MIN_RETURNS

    def _covered(self, number: int, centres: np.ndarray, enter: np.ndarray) -> np.ndarray:
        """Pixels [P] whose rays meet another box before they enter this one, at depth enter [P]."""
        xyxy = self.outlines.xyxy
        low, high = np.maximum(xyxy[:, :2], xyxy[number, :2]), xyxy[:, 2:]
        overlaps = (low < np.minimum(high, xyxy[number, 2:])).all(axis=1) & self.outlines.in_view
        covered = np.zeros(len(centres), bool)
        for other in np.flatnonzero(overlaps).tolist():
            begin, end = self._spans(other, centres)
            covered |= (begin <= end) & (begin < enter)
        return covered

    def _returns_at(
        self, number: int, on_box: np.ndarray, window: tuple[int, int, int, int], free: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Return pixels [P, 2] of returns on the box, at free pixels; pixels of those clearly
        before it that are in no other box; and how many end behind it, at free pixels.
        """
        pixels, depths_m = self._projected
        left, top, right, bottom = window
        with np.errstate(invalid="ignore"):  # NaN
            inside = (pixels >= (left, top)) & (pixels < (right, bottom))
        near = np.flatnonzero(inside.all(axis=1))
        column, row = np.floor(pixels[near]).astype(int).T
        is_free = free[(row - top) * (right - left) + (column - left)]
        enter, leave = self._spans(number, pixels[near])
        is_on = np.isin(near, on_box)
        is_before = (enter <= leave) & (depths_m[near] < enter - CLEAR_M)
        is_behind = (enter <= leave) & (depths_m[near] > leave) & is_free
        before = near[is_before]
        held, placed = np.zeros(len(before), bool), self.placed
        for other in np.flatnonzero(placed.is_usable).tolist() if len(before) else ():
            corners = placed.low_m[other], placed.high_m[other]
            held |= _are_inside(self.returns.points_m[before], placed, other, *corners)
        return pixels[near[is_on & is_free]], pixels[before[~held]], int(is_behind.sum())

    def _spans(self, number: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depths [P] at which the rays of pixels [P, 2] enter a labelled box and leave it; enter is
        the larger of rays that pass it. The buried part of the box does not count.
        """
        camera, rotation = self.camera, self.placed.rotations[number]
        world_from_camera = camera.world_from_camera.numpy()
        across = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        rays = np.concatenate([across, np.ones((len(pixels), 1))], axis=1)
        rays = rays @ world_from_camera[:3, :3].T @ rotation
        rays = np.where(rays == 0, 1e-300, rays)
        eye = (world_from_camera[:3, 3] - self.placed.centres_m[number]) @ rotation
        high = self.placed.sizes_m[number] / 2
        low = -high
        low[2] = min(low[2] + self.buried_m[number], high[2])
        with np.errstate(over="ignore"):  # of a ray along a side
            a, b = (low - eye) / rays, (high - eye) / rays
        enter, leave = np.minimum(a, b), np.maximum(a, b)
        near = np.maximum(np.maximum(enter[:, 0], enter[:, 1]), enter[:, 2])
        return np.maximum(near, NEAR_M), np.minimum(
            np.minimum(leave[:, 0], leave[:, 1]), leave[:, 2]
        )

    def _above_ground(self, number: int) -> np.ndarray:
        """The lowest corner of that part of a box in which a return is not the ground's."""
        size = self.placed.sizes_m[number]
        low = -size / 2
        low[2] += min(GROUND_M, MAX_OF_HEIGHT * size[2])
        return low
