"""Where things inside labelled boxes go from the time of one picture to that of another.

A box is a rigid body. Its pose at a picture's own time is linear in position and slerp in rotation
between the labels before and after, as the renderer poses actors. A pixel shows a box by the rule
of `augment.box_pixels`. From picture A to picture B a pixel of a box that moves goes along with it.
Left out are: pixels of a moving box whose pose is not known at one of the two times; pixels that
show two of them; and, in both pictures, what else lies within MARGIN_M of a moving box: the road
under a car, which has its shadow, its own parts that reach beyond the label, blurred edges.

Boxes that move less than STILL_M between the two times stand, and what they hold is the world's.

A pose is known from HOLD_NS before a track's first label to as long after its last, and not within
gaps of more than MAX_GAP_NS. A box whose nearest label is further away than that is not there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from augment.batch.label_files import FrameBoxes
from augment.box_pixels import CORNERS, PlacedBoxes, shown_pixels
from augment.geometry import invert_rigid, quat_from_rotmat, rigid
from augment.labels import Boxes
from augment.metrics.consistency import DepthView, world_points
from augment.track import Track

MARGIN_M = 0.5
STILL_M = 0.03  # of any corner; labels of parked cars tremble, and depths may differ by more
HOLD_NS = 1_000_000  # clocks are rounded
MAX_GAP_NS = 600_000_000  # some datasets label twice a second


@dataclass(frozen=True, eq=False)
class PosedBox:
    """A box at one time. world_from_box: float64 [4, 4]. size_m: float64 [3].

    known: false where the pose is that of the label nearest in time. restless: whether the box
    moves between that label and the next one; false where the pose is known.
    """

    world_from_box: np.ndarray
    size_m: np.ndarray
    known: bool
    restless: bool


class ActorPaths:
    """Where the boxes of a drive are at any time. Boxes without finite numbers are left out."""

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
        self._poses = {name: np.stack(each) for name, each in poses.items()}
        self._times = {name: np.array(each, np.int64) for name, each in times.items()}
        self._tracks = {
            name: Track(
                torch.from_numpy(self._times[name]), torch.from_numpy(each), HOLD_NS, MAX_GAP_NS
            )
            for name, each in self._poses.items()
        }

    def at(self, timestamp_ns: int) -> dict[str, PosedBox]:
        """The boxes that are there, by their tracks."""
        found = {}
        for name, track in self._tracks.items():
            gaps_ns = np.abs(self._times[name] - timestamp_ns)
            nearest = int(gaps_ns.argmin())
            if gaps_ns[nearest] > MAX_GAP_NS:
                continue
            pose, size = track.pose_at(timestamp_ns), self._sizes[name]
            if pose is not None:
                found[name] = PosedBox(pose.numpy(), size, known=True, restless=False)
                continue
            poses = self._poses[name]
            other = nearest - 1 if nearest else min(1, len(poses) - 1)
            restless = _distance(poses[nearest], poses[other], size) > STILL_M
            found[name] = PosedBox(poses[nearest], size, known=False, restless=restless)
        return found


@dataclass(frozen=True, eq=False)
class Carried:
    """points_m: float64 [H, W, 3], where A's surfaces are when B is taken, NaN where that is not
    known. moved: bool [H, W], carried along with a box. unclear_b: bool [H, W] of B, left out.
    """

    points_m: np.ndarray
    moved: np.ndarray
    unclear_b: np.ndarray


def carry(
    paths: ActorPaths, a: DepthView, b: DepthView, is_actor: np.ndarray | None = None
) -> Carried:
    """Where A's surfaces are when B is taken. Cameras are in the world of the boxes.

    is_actor: bool [H, W], pixels of A that are known to show an actor: outside of every box they
    are left out, as nobody knows where they go (the recording car's own bonnet, say).

    Raises:
        ValueError: a camera is orthographic.
    """
    points = world_points(a)
    at_a, at_b = paths.at(a.camera.timestamp_ns), paths.at(b.camera.timestamp_ns)
    moving = [n for n in {**at_a, **at_b} if _moves(at_a.get(n), at_b.get(n))]
    unclear_a, unclear_b = (
        _around([at[n] for n in moving if n in at], view) for at, view in ((at_a, a), (at_b, b))
    )
    claims = np.zeros(a.depth_m.shape, np.int64)
    there = [n for n in moving if n in at_a]
    for number, rows, columns in _shown([at_a[n] for n in there], a):
        one, other = at_a[there[number]], at_b.get(there[number])
        if other is None or not (one.known and other.known):
            claims[rows, columns] += 2
            continue
        claims[rows, columns] += 1
        b_from_a = other.world_from_box @ _inverse(one.world_from_box)
        points[rows, columns] = points[rows, columns] @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    points[unclear_a | (claims > 1)] = np.nan
    if is_actor is not None:
        points[is_actor & ~_inside(list(at_a.values()), a)] = np.nan
    return Carried(points, claims == 1, unclear_b)


def _moves(a: PosedBox | None, b: PosedBox | None) -> bool:
    """Whether what a box holds cannot be taken to stand."""
    if a is None or b is None:
        return True
    if a.known and b.known:
        return _distance(a.world_from_box, b.world_from_box, a.size_m) > STILL_M
    return a.restless or b.restless


def _distance(a: np.ndarray, b: np.ndarray, size_m: np.ndarray) -> float:
    """How far a corner of a box is at most between two poses, metres."""
    ends = [(CORNERS * size_m) @ pose[:3, :3].T + pose[:3, 3] for pose in (a, b)]
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).max())


def _around(boxes: Sequence[PosedBox], view: DepthView) -> np.ndarray:
    """bool [H, W]: what lies within MARGIN_M of a box and is not the box."""
    mask = np.zeros(view.depth_m.shape, bool)
    for _, rows, columns in _shown(boxes, view, MARGIN_M):
        mask[rows, columns] = True
    return mask & ~_inside(boxes, view)


def _inside(boxes: Sequence[PosedBox], view: DepthView) -> np.ndarray:
    """bool [H, W]: what shows one of the boxes."""
    mask = np.zeros(view.depth_m.shape, bool)
    for _, rows, columns in _shown(boxes, view):
        mask[rows, columns] = True
    return mask


def _shown(
    boxes: Sequence[PosedBox], view: DepthView, margin_m: float = 0.0
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """As `shown_pixels`, of boxes with a margin on all sides."""
    if not boxes:
        return iter(())
    poses = torch.from_numpy(np.stack([box.world_from_box for box in boxes]))
    placed = PlacedBoxes.of(
        Boxes(
            ("",) * len(boxes),
            ("",) * len(boxes),
            poses[:, :3, 3].numpy(),
            np.stack([box.size_m for box in boxes]),
            quat_from_rotmat(poses[:, :3, :3]).numpy(),
        ),
        np.zeros(3),
    )
    low, high = placed.low_m - margin_m, placed.high_m + margin_m
    grown = dataclasses.replace(placed, low_m=low, high_m=high)
    depth = np.where(np.isfinite(view.depth_m), view.depth_m, 0.0).astype(np.float32)
    return shown_pixels(grown, view.camera, depth)


def _finite_boxes(boxes: Boxes) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Track, size [3] and world_from_box [4, 4] of every box whose numbers can be used."""
    placed = PlacedBoxes.of(boxes, np.zeros(3))
    poses = rigid(torch.from_numpy(placed.rotations), torch.from_numpy(placed.centres_m)).numpy()
    for number in np.flatnonzero(placed.is_finite):
        yield boxes.track_ids[number], placed.sizes_m[number], poses[number]


def _inverse(pose: np.ndarray) -> np.ndarray:
    return invert_rigid(torch.from_numpy(pose)).numpy()
