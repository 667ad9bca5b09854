"""What is known of a Street Gaussians scene besides its Gaussians.

World: the dataset's, minus the mean position of the car over all its frames, as the models are
trained. Vehicle frame: x forward, y left, z up. Times are seconds as the dataset has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from augment.errors import AdapterError

# ---- records -------------------------------------------------------------------------------------

CAMERA_NAMES = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")


@dataclass(frozen=True)
class ModelConfig:
    """What of a model's configuration decides how it is read; the defaults are the project's own.

    cameras: numbers in CAMERA_NAMES. selected_frames: first and last, both included; None for all.
    split_test, split_train: every how manyeth frame is held out or trained on; -1 where unused.
    """

    source_path: str = ""
    cameras: tuple[int, ...] = (0, 1, 2)
    selected_frames: tuple[int, int] | None = None
    use_tracker: bool = False
    split_test: int = -1
    split_train: int = -1
    sh_degree: int = 3
    fourier_dim: int = 1
    fourier_scale: float = 1.0
    include_sky: bool = False
    white_background: bool = False
    opt_track: bool = True
    use_color_correction: bool = False
    color_correction_mode: str = "image"
    color_correction_mlp: bool = False
    use_pose_correction: bool = False
    pose_correction_mode: str = "image"


@dataclass(frozen=True, eq=False)
class StreetImage:
    """One image, or a camera without its image. cam: number in CAMERA_NAMES.

    world_from_ego: float64 [4, 4], at the moment of the image. camera_from_ego: float64 [4, 4],
    OpenCV axes. width, height, fx, fy, cx, cy: of the recorded image, pixels. is_held_out: not
    trained on. number: its position among all images of the selected frames and cameras, by frame,
    then camera, those included that are left out: the index of per-image corrections.
    """

    frame: int
    cam: int
    path: Path | None
    timestamp_s: float
    world_from_ego: np.ndarray
    camera_from_ego: np.ndarray
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    is_held_out: bool
    number: int

    @property
    def name(self) -> str:
        return CAMERA_NAMES[self.cam]

    @property
    def timestamp_ns(self) -> int:
        return round(self.timestamp_s * 1e9)


@dataclass(frozen=True, eq=False)
class TrackedObject:
    """A moving object of the model: `obj_{track_id:03d}`.

    size_m: length, width, height; training kept splats in a box that was wider and longer by
    data.box_scale. start_frame, end_frame: first and last in which it is tracked.
    start_s, end_s: when it is drawn.
    """

    track_id: int
    label: str
    size_m: tuple[float, float, float]
    start_frame: int
    end_frame: int
    start_s: float
    end_s: float


@dataclass(frozen=True, eq=False)
class Tracklets:
    """Where objects are in each of F selected frames, in the columns that the model has them in.

    ids: int64 [F, M], -1 for none. positions: float64 [F, M, 3], metres, vehicle frame at the
    frame's time. quats: float64 [F, M, 4] wxyz.
    """

    ids: np.ndarray
    positions: np.ndarray
    quats: np.ndarray


@dataclass(frozen=True, eq=False)
class StreetData:
    """A dataset directory as a model sees it.

    frames: selected numbers, ascending. frame_times_s: float64 [F]. world_from_ego: float64
    [F, 4, 4] at the frames' times; between its neighbours' where the file is missing, so that the
    rows stay those of the model, but such a frame has no images. images: of the selected frames and
    cameras, by frame, then camera. objects: in order of their first appearance in the track file,
    static ones left out.
    """

    root: Path
    world_origin_m: np.ndarray
    frames: tuple[int, ...]
    frame_times_s: np.ndarray
    world_from_ego: np.ndarray
    images: tuple[StreetImage, ...]
    objects: tuple[TrackedObject, ...]
    tracklets: Tracklets
    problems: tuple[str, ...] = ()


# ------------------------------------------------------------------------------------------------
# Where a model's actors are at the moment of an image: tracklets of the dataset, moved as
# training
# has moved them, interpolated in the vehicle frame.

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


# ---- What a model learnt for single images or cameras: colour maps and moved cameras -------------


@dataclass(frozen=True, eq=False)
class CameraChanges:
    """What the background is moved by before an image is taken.

    changes: float64 [n, 4, 4], rigid. rows: of every image's, by frame and camera.
    """

    changes: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    rows: Mapping[tuple[int, int], int] = field(default_factory=dict)

    def row(self, image: StreetImage) -> int:
        return self.rows.get((image.frame, image.cam), 0)

    def of(self, image: StreetImage) -> np.ndarray:
        return self.changes[self.row(image)]

    @cached_property
    def inverses(self) -> np.ndarray:
        return np.linalg.inv(self.changes)


def camera_changes(
    changes: np.ndarray | None, data: StreetData, config: ModelConfig, where: str
) -> CameraChanges:
    """The pose correction of every image; without any, cameras stay where they are.

    Raises:
        AdapterError: another number than of images or frames.
    """
    if changes is None:
        return CameraChanges()
    frames = {frame: row for row, frame in enumerate(data.frames)}
    by_image = config.pose_correction_mode == "image"
    rows = {
        (image.frame, image.cam): image.number if by_image else frames[image.frame]
        for image in data.images
    }
    expected = _image_count(data, config) if by_image else len(data.frames)
    _check_count(
        len(changes), expected, f"{where}, pose_correction", config.pose_correction_mode, data
    )
    return CameraChanges(changes, rows)


@dataclass(frozen=True, eq=False)
class ColorMaps:
    """As Scene.color_maps and Scene.image_color_maps."""

    by_camera: Mapping[str, Tensor] = field(default_factory=dict)
    by_image: Mapping[tuple[str, int], Tensor] = field(default_factory=dict)


def color_maps(maps: Tensor | None, data: StreetData, config: ModelConfig, where: str) -> ColorMaps:
    """The colour correction, applied after the sky: of cameras, or of images, whose cameras then
    have the mean of those that were trained on for other views.

    Raises:
        AdapterError: another number than of images or cameras.
    """
    if maps is None:
        return ColorMaps()
    mode, where = config.color_correction_mode, f"{where}, color_correction"
    if mode == "sensor":
        cams = sorted({image.cam for image in data.images})
        _check_count(len(maps), len(config.cameras), where, mode, data)
        if cams[-1] >= len(maps):
            raise AdapterError(
                f"{where}: affine_trans has maps of cameras 0 to {len(maps) - 1}, but the "
                f"configuration's data.cameras has {list(config.cameras)}"
            )
        return ColorMaps({CAMERA_NAMES[cam]: maps[cam].clone() for cam in cams})
    _check_count(len(maps), _image_count(data, config), where, mode, data)
    by_camera = {}
    for name in dict.fromkeys(image.name for image in data.images):
        own = [image for image in data.images if image.name == name]
        trained = [image.number for image in own if not image.is_held_out]
        chosen = trained or [image.number for image in own]
        by_camera[name] = maps[chosen].mean(0)
    by_image = {(i.name, i.timestamp_ns): maps[i.number].clone() for i in data.images}
    return ColorMaps(by_camera, by_image)


def _image_count(data: StreetData, config: ModelConfig) -> int:
    return len(data.frames) * len(config.cameras)


def _check_count(found: int, expected: int, where: str, mode: str, data: StreetData) -> None:
    if found != expected:
        raise AdapterError(
            f"{where} has {found} entries; with mode {mode!r} and the dataset {data.root} it must "
            f"have {expected}. The number follows from data.cameras and data.selected_frames of "
            f"the configuration: give the data and the configs/ that the model was trained with"
        )


def moved_camera(camera_from_world: Tensor, change: np.ndarray) -> Tensor:
    """camera_from_world of a camera that sees the background where the change moves it."""
    return camera_from_world @ torch.from_numpy(np.ascontiguousarray(change))
