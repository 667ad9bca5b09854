"""Consistency of two views of one scene: the error of one warped into the other.

In: two pictures with depth (`DepthView`). Out: `Consistency`. `climategs evaluate` calls it.

Protocol. Every pixel of view A that the scene fills (alpha >= MIN_ALPHA) is a point of the world,
by A's depth along the ray through the pixel's centre. The point is projected into view B. The pixel
counts if all four pixels of B around that place are filled and have the point's depth within a
tolerance. Where they have not, something else stands before it, or the place lies on an edge, where
depths are mixtures. B's colour there is bilinear. The error is the root of the mean square of the
differences of display-encoded colours over all pixels that count and all three channels.

The world has to stand still between the two: render both at one time stamp, or say where A's points
are when B is taken (`move_surfaces` computes it for the points of actors). The sky is not part of
it.
Warping is no exact inverse of rendering (bilinear colours, depths of blended surfaces, colours that
truly depend on the direction), so the error of a perfect scene is small and not 0.

A linear map of colours scales the error with the contrast, consistent or not, which is why the
error relative to the picture's own spread stands beside it. (Comparable figures of stylised scenes
are usually given as short-range and long-range consistency of warped views: Lai et al. 2018.)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.output.tables import FrameBoxes
from augment.scene.boxes import CORNERS, WorldBoxes, pixels_of_boxes
from augment.scene.cameras import Camera
from augment.scene.geometry import invert_rigid, quat_from_rotmat, rigid
from augment.scene.labels import Boxes
from augment.scene.scene import Track

MIN_ALPHA = 0.95  # smallest alpha of a pixel that the scene fills, 0 to 1
# Two depths agree if they differ by at most the sum of the two tolerances.
RELATIVE_TOLERANCE = 0.01  # tolerance of a depth, as a fraction of the depth
TOLERANCE_M = 0.05  # tolerance of a depth at any distance, metres
_NEIGHBOURS = ((0, 0), (0, 1), (1, 0), (1, 1))  # offsets of the four pixels: rows, columns


@dataclass(frozen=True, eq=False)
class DepthView:
    """Picture and depth of a pinhole camera."""

    camera: Camera
    """The camera."""
    picture: np.ndarray
    """Colours, floats [H, W, 3], display-encoded, 0 to 1."""
    depth_m: np.ndarray
    """z along the optical axis, [H, W]."""
    alpha: np.ndarray
    """Alpha, 0 to 1, [H, W]; depth counts where it is high."""

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        for name, expected in (("picture", (*shape, 3)), ("depth_m", shape), ("alpha", shape)):
            value = getattr(self, name)
            if value.shape != expected or not np.issubdtype(value.dtype, np.floating):
                raise ValueError(
                    f"{name} must be floats {list(expected)}, as camera {self.camera.name!r}; "
                    f"got {value.dtype} {list(value.shape)}"
                )


@dataclass(frozen=True)
class Consistency:
    """Agreement of two views."""

    rmse: float
    """Error over the pixels that count; NaN if none counts."""
    spread: float
    """Standard deviation of A's colours over the same pixels, about each channel's mean."""
    share: float
    """Fraction of A's pixels that count."""
    noise: float = 0.0
    """Root mean square of the cameras' noise, which rmse and spread do not include."""

    @property
    def relative(self) -> float:
        """Return the ratio of rmse to spread; NaN if the picture has one colour only."""
        return self.rmse / self.spread if self.spread > 0 else math.nan


@dataclass(frozen=True, eq=False)
class Warp:
    """Places in view B of the pixels of view A."""

    is_counted: np.ndarray
    """Pixels of A that count, bool [H, W]."""
    columns: np.ndarray
    """Columns in B of these K pixels, float64 [K], in A's order, pixels from the centre of B's
    first pixel."""
    rows: np.ndarray
    """Rows in B of these pixels, float64 [K]."""

    def sample(self, image: np.ndarray) -> np.ndarray:
        """Return an image of B's [Hb, Wb, C] as A would see it, float64 [H, W, C].

        It is bilinear, and 0 where A does not count.
        """
        c0 = np.floor(self.columns).astype(np.int64)
        r0 = np.floor(self.rows).astype(np.int64)
        fc = (self.columns - c0)[:, None]
        fr = (self.rows - r0)[:, None]
        values = np.zeros((len(c0), image.shape[2]))
        for dr, dc in _NEIGHBOURS:
            weight = (fr if dr else 1 - fr) * (fc if dc else 1 - fc)
            values += weight * image[r0 + dr, c0 + dc]
        warped = np.zeros((*self.is_counted.shape, image.shape[2]))
        warped[self.is_counted] = values
        return warped


def warped_consistency(a: DepthView, b: DepthView) -> Consistency:
    """Return the error of view B warped into view A, by the module's protocol."""
    return consistency_of(a, *warp_view(a, b))


def consistency_of(
    a: DepthView, warped: np.ndarray, counts: np.ndarray, noise: np.ndarray | None = None
) -> Consistency:
    """Return the error of a warped picture against A's own over some pixels.

    Args:
        a: view A.
        warped: the warped picture, [H, W, 3].
        counts: pixels that count, bool [H, W].
        noise: expected squares of independent noise in A and in the warped picture, [H, W, 2].
    """
    share = float(counts.mean())
    if not counts.any():
        return Consistency(math.nan, math.nan, share)
    colors = a.picture[counts].astype(np.float64)
    in_a, in_b = (0.0, 0.0) if noise is None else noise[counts].mean(0)
    square = float(((warped[counts] - colors) ** 2).mean()) - in_a - in_b
    variance = float(colors.var(axis=0).mean()) - in_a
    rmse, spread = (math.sqrt(max(0.0, mean)) for mean in (square, variance))
    return Consistency(rmse, spread, share, math.sqrt(in_a + in_b))


def warp_view(a: DepthView, b: DepthView) -> tuple[np.ndarray, np.ndarray]:
    """Return B's picture as A would see it, float64 [H, W, 3], and the pixels that count, bool [H,
    W].

    The picture is 0 where pixels do not count.

    Raises:
        ValueError: a camera is orthographic.
    """
    warp = find_warp(a, b)
    return warp.sample(b.picture), warp.is_counted


def find_warp(a: DepthView, b: DepthView, points_m: np.ndarray | None = None) -> Warp:
    """Return the pixels of A that count and their places in B.

    Args:
        a: view A.
        b: view B.
        points_m: positions in the world of A's surfaces when B is taken, float64 [H, W, 3]; NaN
            where not known (such pixels do not count). None takes the positions when A is taken.

    Raises:
        ValueError: a camera is orthographic.
    """
    points = world_points(a) if points_m is None else points_m
    column, row, depth_m = _places(points, b.camera)
    has_surface = (a.alpha >= MIN_ALPHA) & np.isfinite(a.depth_m) & (a.depth_m > 0)
    inside = has_surface & (depth_m > 0)  # false for NaN
    # All four neighbours are in the picture.
    inside &= (column >= 0) & (column < b.camera.width - 1)
    inside &= (row >= 0) & (row < b.camera.height - 1)
    c = column[inside]
    r = row[inside]
    z = depth_m[inside]
    c0 = np.floor(c).astype(np.int64)
    r0 = np.floor(r).astype(np.int64)
    agrees = np.ones(len(z), bool)
    tolerance = RELATIVE_TOLERANCE * z + TOLERANCE_M
    for dr, dc in _NEIGHBOURS:
        place = r0 + dr, c0 + dc
        agrees &= b.alpha[place] >= MIN_ALPHA
        agrees &= np.abs(b.depth_m[place] - z) <= tolerance
    counts = np.zeros(a.depth_m.shape, bool)
    counts[inside] = agrees
    return Warp(counts, c[agrees], r[agrees])


def world_points(view: DepthView) -> np.ndarray:
    """Return the surface that each pixel shows, float64 [H, W, 3], world.

    It is the camera's centre where depth is not finite.

    Raises:
        ValueError: the camera is orthographic.
    """
    rays = view.camera.ray_directions(torch.float64).numpy()
    depth = np.where(np.isfinite(view.depth_m), view.depth_m, 0.0)[..., None]
    return view.camera.centre.numpy() + depth * rays


def _places(world: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points [H, W, 3] of the world into a camera's picture.

    Returns:
        Column and row, pixels from the first pixel's centre, and depth, metres; float64 [H, W]
        each.
    """
    pose = camera.camera_from_world.numpy()
    x, y, z = np.moveaxis(world @ pose[:3, :3].T + pose[:3, 3], -1, 0)
    positive_z = np.where(z > 0, z, 1.0)
    return (
        camera.fx * x / positive_z + camera.cx - 0.5,
        camera.fy * y / positive_z + camera.cy - 0.5,
        z,
    )


# ---- Motion of things inside labelled boxes between the times of two pictures --------------------
# A box is a rigid body. Its pose at a picture's own time is linear in position and slerp in
# rotation between the labels before and after, as the renderer poses actors. A pixel shows a box by
# the rule of `augment.scene.boxes`. From picture A to picture B a pixel of a box that moves goes
# along with it. Left out are: pixels of a moving box whose pose is not known at one of the two
# times; pixels that show two moving boxes; and, in both pictures, other pixels within MARGIN_M of a
# moving box: the road under a car, which has its shadow, parts of the car that reach beyond the
# label, and blurred edges. Boxes that move less than STILL_M between the two times stand still, and
# their content belongs to the world. A pose is known from HOLD_NS before a track's first label to
# as long after its last, and not within gaps of more than MAX_GAP_NS. A box whose nearest label is
# further away than that is not there.

MARGIN_M = 0.5  # width of the strip around a moving box that is left out, metres
# Labels of parked cars tremble, and the tolerance of depths is larger than this.
STILL_M = 0.03  # largest motion of a corner of a box that stands still, metres
HOLD_NS = 1_000_000  # time before the first and after the last label, as clocks are rounded
MAX_GAP_NS = 600_000_000  # longest time between labels, as some datasets label twice a second


@dataclass(frozen=True, eq=False)
class PosedBox:
    """A box at one time."""

    world_from_box: np.ndarray
    """Pose, float64 [4, 4]."""
    size_m: np.ndarray
    """Length, width and height, float64 [3]."""
    is_from_track: bool
    """False where the pose is that of the label nearest in time."""
    is_moving: bool
    """True if the box moves between that label and the next one; False where the pose is known."""


class ActorPaths:
    """Poses of a drive's boxes at any time.

    Boxes whose numbers are not finite are left out.
    """

    def __init__(self, frames: Mapping[int, FrameBoxes]) -> None:
        times: dict[str, list[int]] = {}
        poses: dict[str, list[np.ndarray]] = {}
        self._sizes: dict[str, np.ndarray] = {}
        for frame in sorted(frames.values(), key=lambda frame: frame.timestamp_ns):
            for name, size, pose in _finite_boxes(frame.boxes):
                if times.get(name, [-1])[-1] == frame.timestamp_ns:
                    continue  # one thing under two boxes, as where sensors overlap: the first
                times.setdefault(name, []).append(frame.timestamp_ns)
                poses.setdefault(name, []).append(pose)
                self._sizes[name] = np.maximum(size, self._sizes.get(name, 0.0))
        self._poses = {name: np.stack(box_poses) for name, box_poses in poses.items()}
        self._times = {name: np.array(box_times, np.int64) for name, box_times in times.items()}
        self._tracks = {
            name: Track(
                torch.from_numpy(self._times[name]),
                torch.from_numpy(track_poses),
                HOLD_NS,
                MAX_GAP_NS,
            )
            for name, track_poses in self._poses.items()
        }

    def boxes_at(self, timestamp_ns: int) -> dict[str, PosedBox]:
        """Return the boxes at a time, by their track ids."""
        boxes = {}
        for name, track in self._tracks.items():
            gaps_ns = np.abs(self._times[name] - timestamp_ns)
            nearest = int(gaps_ns.argmin())
            if gaps_ns[nearest] > MAX_GAP_NS:
                continue
            pose = track.pose_at(timestamp_ns)
            size = self._sizes[name]
            if pose is not None:
                boxes[name] = PosedBox(pose.numpy(), size, is_from_track=True, is_moving=False)
                continue
            poses = self._poses[name]
            neighbour = nearest - 1 if nearest else min(1, len(poses) - 1)
            restless = _distance(poses[nearest], poses[neighbour], size) > STILL_M
            boxes[name] = PosedBox(poses[nearest], size, is_from_track=False, is_moving=restless)
        return boxes


@dataclass(frozen=True, eq=False)
class MovedSurfaces:
    """Positions of A's surfaces when B is taken."""

    points_m: np.ndarray
    """Positions, float64 [H, W, 3], world; NaN where not known."""
    is_moved: np.ndarray
    """Pixels of A that go along with a box, bool [H, W]."""
    is_unclear_in_b: np.ndarray
    """Pixels of B that are left out, bool [H, W]."""


def move_surfaces(
    paths: ActorPaths, a: DepthView, b: DepthView, is_actor: np.ndarray | None = None
) -> MovedSurfaces:
    """Return the positions of A's surfaces when B is taken.

    Cameras are in the world of the boxes.

    Args:
        paths: poses of the boxes.
        a: view A.
        b: view B.
        is_actor: pixels of A that are known to show an actor, bool [H, W]. Those outside of every
            box are left out, as their motion is not known (the recording car's own bonnet, for
            example).

    Raises:
        ValueError: a camera is orthographic.
    """
    points = world_points(a)
    at_a = paths.boxes_at(a.camera.timestamp_ns)
    at_b = paths.boxes_at(b.camera.timestamp_ns)
    moving = [n for n in {**at_a, **at_b} if _moves(at_a.get(n), at_b.get(n))]
    unclear_a, unclear_b = (
        _around([at[n] for n in moving if n in at], view) for at, view in ((at_a, a), (at_b, b))
    )
    claims = np.zeros(a.depth_m.shape, np.int64)
    track_ids = [n for n in moving if n in at_a]
    for number, rows, columns in _shown([at_a[n] for n in track_ids], a):
        box_a = at_a[track_ids[number]]
        box_b = at_b.get(track_ids[number])
        if box_b is None or not (box_a.is_from_track and box_b.is_from_track):
            claims[rows, columns] += 2
            continue
        claims[rows, columns] += 1
        b_from_a = box_b.world_from_box @ _inverse(box_a.world_from_box)
        points[rows, columns] = points[rows, columns] @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    points[unclear_a | (claims > 1)] = np.nan
    if is_actor is not None:
        points[is_actor & ~_inside(list(at_a.values()), a)] = np.nan
    return MovedSurfaces(points, claims == 1, unclear_b)


def _moves(a: PosedBox | None, b: PosedBox | None) -> bool:
    """Return True unless the box is known to stand still between the two times."""
    if a is None or b is None:
        return True
    if a.is_from_track and b.is_from_track:
        return _distance(a.world_from_box, b.world_from_box, a.size_m) > STILL_M
    return a.is_moving or b.is_moving


def _distance(a: np.ndarray, b: np.ndarray, size_m: np.ndarray) -> float:
    """Return the largest distance that a corner of a box moves between two poses, metres."""
    ends = [(CORNERS * size_m) @ pose[:3, :3].T + pose[:3, 3] for pose in (a, b)]
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).max())


def _around(boxes: Sequence[PosedBox], view: DepthView) -> np.ndarray:
    """Return the pixels within MARGIN_M of a box and outside of all boxes, bool [H, W]."""
    mask = np.zeros(view.depth_m.shape, bool)
    for _, rows, columns in _shown(boxes, view, MARGIN_M):
        mask[rows, columns] = True
    return mask & ~_inside(boxes, view)


def _inside(boxes: Sequence[PosedBox], view: DepthView) -> np.ndarray:
    """Return the pixels that show one of the boxes, bool [H, W]."""
    mask = np.zeros(view.depth_m.shape, bool)
    for _, rows, columns in _shown(boxes, view):
        mask[rows, columns] = True
    return mask


def _shown(
    boxes: Sequence[PosedBox], view: DepthView, margin_m: float = 0.0
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield the pixels of boxes as `pixels_of_boxes`, with a margin on all sides."""
    if not boxes:
        return iter(())
    poses = torch.from_numpy(np.stack([box.world_from_box for box in boxes]))
    placed_boxes = WorldBoxes.from_labels(
        Boxes(
            ("",) * len(boxes),
            ("",) * len(boxes),
            poses[:, :3, 3].numpy(),
            np.stack([box.size_m for box in boxes]),
            quat_from_rotmat(poses[:, :3, :3]).numpy(),
        ),
        np.zeros(3),
    )
    low = placed_boxes.low_m - margin_m
    high = placed_boxes.high_m + margin_m
    wide_boxes = dataclasses.replace(placed_boxes, low_m=low, high_m=high)
    depth = np.where(np.isfinite(view.depth_m), view.depth_m, 0.0).astype(np.float32)
    return pixels_of_boxes(wide_boxes, view.camera, depth)


def _finite_boxes(boxes: Boxes) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield track, size [3] and world_from_box [4, 4] of every box whose numbers are usable."""
    placed_boxes = WorldBoxes.from_labels(boxes, np.zeros(3))
    poses = rigid(
        torch.from_numpy(placed_boxes.rotations), torch.from_numpy(placed_boxes.centres_m)
    ).numpy()
    for number in np.flatnonzero(placed_boxes.is_usable):
        yield boxes.track_ids[number], placed_boxes.sizes_m[number], poses[number]


def _inverse(pose: np.ndarray) -> np.ndarray:
    """Return the inverse of a pose."""
    return invert_rigid(torch.from_numpy(pose)).numpy()
