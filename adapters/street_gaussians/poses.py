"""Where a model's actors are at the moment of an image: tracklets of the dataset, moved as training
has moved them, interpolated in the vehicle frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapters.street_gaussians.records import StreetData, TrackedObject
from augment.errors import AdapterError

_STRAIGHT_RAD = 1e-6  # sin of a smaller angle loses its digits; the straight line is exact there


@dataclass(frozen=True, eq=False)
class PoseChanges:
    """What training added to the poses of each frame and column of the tracklets.

    positions: float64 [F, M, 3], metres, vehicle frame. half_turns: float64 [F, M], radians about
    the object's z; it turns by twice as much.
    """

    positions: np.ndarray
    half_turns: np.ndarray


@dataclass(frozen=True, eq=False)
class Poses:
    """T poses. positions: float64 [T, 3], metres. quats: float64 [T, 4] unit wxyz."""

    positions: np.ndarray
    quats: np.ndarray


def check_changes(changes: PoseChanges, data: StreetData, where: str) -> None:
    """Whether poses of a model belong to the dataset's tracklets.

    Raises:
        AdapterError: other numbers of frames or columns.
    """
    have, want = changes.positions.shape[:2], data.tracklets.ids.shape
    if have != want:
        raise AdapterError(
            f"{where}: actor_pose has {have[0]} frames and {have[1]} columns (opt_trans "
            f"{list(changes.positions.shape)}), but the tracks of {data.root} give {want[0]} "
            f"frames and {want[1]} columns ({[*want, 3]}). Frames follow from data.selected_frames "
            f"of the configuration, columns also from data.cameras and data.use_tracker and from "
            f"track/: give the data and the configs/ that the model was trained with"
        )


def vehicle_poses(
    data: StreetData,
    tracked: TrackedObject,
    times_s: np.ndarray,
    changes: PoseChanges | None,
    *,
    rotation_bug: bool = False,
) -> Poses:
    """Poses of an object in the vehicle frame at T times, float64 [T].

    Between the two frames nearest to each time, linear in position and slerp in rotation; beyond
    them both go on. An object that is tracked in one frame only stays at its pose. rotation_bug: as
    an older release of the project has it, which reads the turn of the second frame in the first
    frame's row and turns what it has turned already.
    """
    rows, columns = np.nonzero(data.tracklets.ids == tracked.track_id)
    frame_times = data.frame_times_s[rows]
    order = np.argsort(np.abs(frame_times - times_s[:, None]), axis=1, kind="stable")
    first, second = order[:, 0], order[:, min(1, len(rows) - 1)]
    positions = data.tracklets.positions[rows, columns]
    quats = data.tracklets.quats[rows, columns]
    if changes is not None:
        positions = positions + changes.positions[rows, columns]
        turned = _turned(quats, changes.half_turns[rows, columns])
        quats_first, quats_second = turned[first], turned[second]
        if rotation_bug:
            misread = changes.half_turns[rows[first], columns[second]]
            quats_second = _turned(quats_first, misread)
    else:
        quats_first, quats_second = quats[first], quats[second]
    share = _share(times_s, frame_times[first], frame_times[second])
    return Poses(
        _between(positions[first], positions[second], share),
        slerp(quats_first, quats_second, share),
    )


def image_poses(
    data: StreetData,
    tracked: TrackedObject,
    images: np.ndarray,
    changes: PoseChanges | None,
    *,
    interpolate_held_out: bool,
    rotation_bug: bool = False,
) -> Poses:
    """Poses of an object in the vehicle frame at the moments of images (positions in data.images).

    interpolate_held_out: images that were not trained on have no poses of their own, but what lies
    between those of their camera's two nearest images that were, if the object has two.
    """
    times = np.array([data.images[i].timestamp_s for i in images])
    poses = vehicle_poses(data, tracked, times, changes, rotation_bug=rotation_bug)
    if not interpolate_held_out:
        return poses
    for position, index in enumerate(images):
        image = data.images[index]
        if not image.is_held_out:
            continue
        near = _nearest_trained(data, tracked, image.cam, image.timestamp_s)
        if near is None:
            continue
        ends = vehicle_poses(data, tracked, near, changes, rotation_bug=rotation_bug)
        share = _share(times[position], near[0], near[1])
        poses.positions[position] = _between(ends.positions[0], ends.positions[1], share)
        poses.quats[position] = slerp(ends.quats[:1], ends.quats[1:], share[None])[0]
    return poses


def _nearest_trained(
    data: StreetData, tracked: TrackedObject, cam: int, time_s: float
) -> np.ndarray | None:
    """Times of a camera's two images nearest to a time that were trained on and show the object."""
    times = np.array(
        [
            image.timestamp_s
            for image in data.images
            if image.cam == cam
            and not image.is_held_out
            and tracked.start_s <= image.timestamp_s <= tracked.end_s
        ]
    )
    if len(times) < 2:
        return None
    return times[np.argsort(np.abs(times - time_s), kind="stable")[:2]]


def _share(times: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """How far times are from the first to the second, which may be one."""
    gap = np.asarray(second - first)
    return np.where(gap == 0, 0.0, (times - first) / np.where(gap == 0, 1.0, gap))


def _between(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    return first * (1 - share)[..., None] + second * share[..., None]


def _turned(quats: np.ndarray, half_turns: np.ndarray) -> np.ndarray:
    """quats times (cos, 0, 0, sin): turned about their own z by twice the half turns."""
    w, x, y, z = np.moveaxis(quats, -1, 0)
    c, s = np.cos(half_turns), np.sin(half_turns)
    return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, w * s + z * c], -1)


def slerp(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Between unit quaternions [T, 4] the shorter way round, and beyond where share [T] is outside
    [0, 1].
    """
    dots = (first * second).sum(1)
    second = np.where(dots[:, None] < 0, -second, second)
    angles = np.arccos(np.clip(np.abs(dots), 0, 1))
    is_straight = angles < _STRAIGHT_RAD
    sines = np.where(is_straight, 1.0, np.sin(angles))
    a = np.where(is_straight, 1 - share, np.sin((1 - share) * angles) / sines)
    b = np.where(is_straight, share, np.sin(share * angles) / sines)
    between = a[:, None] * first + b[:, None] * second
    return between / np.linalg.norm(between, axis=1, keepdims=True)


def rotations_of(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices [T, 3, 3] of wxyz quaternions [T, 4] of any length but zero."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
