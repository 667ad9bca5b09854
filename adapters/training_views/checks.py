"""Checks of a drive before training: whether the calibration fits, and whether exposure is
steady.

Paint, signs and edges differ in reflectance as they do in brightness. Over a range of shifts of the
projected returns, the mutual information of intensity and grey value is measured. It is highest
where they coincide (Pandey et al. 2012, here with shifts for rotations). Rolling shutters, exposure
and transport leave time stamps some tens of milliseconds beside the moment that an image shows, and
a car at 15 m/s moves 30 cm in 20 ms: the same measure tells which time fits best.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from adapters.lidar_scene.depth import project_points
from adapters.training_views.depth_priors import is_visible_return
from adapters.training_views.views import RecordedViews
from augment.photo.own_car import spread_evenly
from augment.reconstruct.view import ViewKey
from augment.scene.cameras import Camera
from augment.scene.geometry import (
    invert_rigid,
    multiply_quats,
    quat_from_rotmat,
    rigid,
    rotmat_from_quat,
    slerp,
)
from augment.scene.labels import LidarSweep
from augment.scene.scene import Scene

_WIDTH = 480  # columns of the images compared, at most
_REACH_DEG = 1.2  # largest shift that is searched, to each side
_NEAR_M = 8.0  # nearer returns shift with the camera's position and time, not only its rotation
_BINS = 16  # of intensity and of grey value, equally filled
_MAX_POINTS = 60_000  # returns that are compared with the images, over all views
_MIN_POINTS = 3000  # returns in all views together; fewer measure no shift
_CONTRAST = 0.1  # how much the best shift must stand out
_AGREE_PX = 0.75  # between the measurement in every other frame and the rest
_ALONE_PX = 2.0  # a single frame says less, and less exactly
_STEPS_S = np.arange(-5, 6) * 0.010  # time offsets that are compared
_TIMING_NEAR_M = 3.0  # near returns shift most with time
_MIN_SPEED_MPS = 1.0  # of the camera; a slower one shows no time
_RETURN_STRIDE = 3  # returns from one that is compared to the next
_TIMING_CONTRAST = 0.02  # how much the best time must stand out from the range's mean
_MAX_TIME_OFFSET_S = 0.030  # rolling shutters alone make 10 to 20 ms
_MAX_SHIFT_DEG = 0.35  # a pixel at 480 columns is up to 0.25
_MAX_SHIFT_PX = 1.2
_NUM_FRAMES = 7  # that the calibration is measured in
_JUMP_STOPS = 0.4  # a third more or less light
_JUMP_TIMES = 5.0  # this many times the camera's usual change
_BLOCKS = (32, 18)  # columns and rows of the means that are compared
_MAX_NAMED = 3  # jumps of a camera that are named one by one
_INTENSITY = ("intensity", "i")  # names that a sweep's column of intensities may have
_SENSOR = ("sensor", "d")  # names that a sweep's column of sensor numbers may have


@dataclass(frozen=True)
class CameraOffset:
    """Shift of one camera's images against the LiDAR's returns.

    Attributes:
        right_px, down_px: pixels of an image of `width_px` columns.
        is_sure: True if the shift stands out, lies within the searched range, and two halves of the
            frames agree.
    """

    camera: str
    right_px: float
    down_px: float
    width_px: int
    angle_deg: float
    is_sure: bool

    @property
    def problems(self) -> tuple[str, ...]:
        """Return a sentence if the shift is beyond that of rolling shutters and pixels."""
        shift_px = float(np.hypot(self.right_px, self.down_px))
        if not self.is_sure or self.angle_deg < _MAX_SHIFT_DEG or shift_px < _MAX_SHIFT_PX:
            return ()
        return (
            f"camera {self.camera}: its images lie {self.angle_deg:.2f} degrees beside the LiDAR "
            f"({self.right_px:+.1f} px to the right, {self.down_px:+.1f} px down, of "
            f"{self.width_px} columns); its rotation, focal length or timestamps are wrong, and "
            f"what it shows will be blurred or doubled",
        )


class Returns(NamedTuple):
    """Returns of a sweep with intensity. points: float64 [N, 3], scene world. intensity: [N]."""

    points: np.ndarray
    intensity: np.ndarray


class Points(NamedTuple):
    """Returns in one image: columns, rows int32 [M], intensity [M]; grey uint8 [H, W]."""

    columns: np.ndarray
    rows: np.ndarray
    intensity: np.ndarray
    grey: np.ndarray


def measure_offset(
    returns: Mapping[int, Returns], views: RecordedViews, cameras: Mapping[ViewKey, Camera]
) -> CameraOffset | None:
    """Return the shift of one camera's images; None if they show fewer than 3000 returns.

    returns: by frame. cameras: the views to compare, at any resolution."""
    camera = _compared(next(iter(cameras.values())))
    reach = min(max(round(math.radians(_REACH_DEG) * camera.fx), 4), 16)
    points_by_view = project_returns(returns, views, cameras, reach=reach, near_m=_NEAR_M)
    if sum(len(points.rows) for points in points_by_view) < _MIN_POINTS:
        return None
    score = shared_information(points_by_view, reach)
    right, down = _peak(score)

    def shift_distance_px(points_of_views: Sequence[Points]) -> float:
        shift = _peak(shared_information(points_of_views, reach))
        return math.hypot(right - shift[0], down - shift[1])

    halves = [
        shift_distance_px(half) for half in (points_by_view[::2], points_by_view[1::2]) if half
    ]
    # Repeated shapes can look shifted to all frames together, but not to most of them one by one.
    agrees = [shift_distance_px([points]) < _ALONE_PX for points in points_by_view]
    contrast = float(score.max() / max(float(np.median(score)), 1e-12) - 1)
    is_inside = max(abs(right), abs(down)) < reach - 0.5
    return CameraOffset(
        camera=camera.name,
        right_px=right,
        down_px=down,
        width_px=camera.width,
        angle_deg=math.degrees(math.hypot(right / camera.fx, down / camera.fy)),
        # At the border of the range the shift is at least as large as that.
        is_sure=contrast > _CONTRAST
        and len(halves) == 2
        and (max(halves) < _AGREE_PX or not is_inside)
        and 2 * sum(agrees) >= len(agrees),
    )


def _compared(camera: Camera) -> Camera:
    return camera.scaled(min(1.0, _WIDTH / camera.width))


def read_intensities(scene: Scene, frames: Iterable[int]) -> dict[int, Returns]:
    """Return the returns of each frame's sweep, from the sensor that has most of them.

    Frames without intensity are left out."""
    out: dict[int, Returns] = {}
    for frame in dict.fromkeys(frames):
        sweep = scene.lidar(frame)
        intensity = None if sweep is None else _column(sweep, _INTENSITY)
        if sweep is None or intensity is None:
            continue
        points = sweep.points_m - scene.world_origin_m
        use = np.isfinite(points).all(axis=1) & np.isfinite(intensity.astype(np.float64))
        sensor = _column(sweep, _SENSOR)
        if sensor is not None and len(sensor):
            names, counts = np.unique(sensor, return_counts=True)
            use &= sensor == names[counts.argmax()]  # each sensor has its own scale of intensity
        out[frame] = Returns(points[use], intensity[use])
    return out


def _column(sweep: LidarSweep, names: Sequence[str]) -> np.ndarray | None:
    return next((np.asarray(sweep.columns[name]) for name in names if name in sweep.columns), None)


def project_returns(
    returns: Mapping[int, Returns],
    views: RecordedViews,
    cameras: Mapping[ViewKey, Camera],
    *,
    reach: int,
    near_m: float,
) -> list[Points]:
    """Return, for each view, its grey image and the returns beyond near_m that its camera sees.

    Views of frames without returns are left out. reach: pixels from the image's border that are
    left out."""
    out = []
    for key, camera in cameras.items():
        if key.frame not in returns:
            continue
        camera = _compared(camera)
        grey = cv2.cvtColor(views.image(key), cv2.COLOR_RGB2GRAY)
        grey = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        points, intensity = returns[key.frame]
        depth_pixels, index = project_points(points, camera, near_m=near_m, margin_px=reach)
        is_visible = is_visible_return(depth_pixels, camera)
        rows, columns = np.divmod(depth_pixels.pixels[is_visible], camera.width)
        out.append(Points(columns, rows, intensity[index[is_visible]], grey))
    return out


def shared_information(points_by_view: Sequence[Points], reach: int) -> np.ndarray:
    """Return the mutual information of intensity and grey value, over their joint entropy.

    float64 [2 reach + 1, 2 reach + 1], one value for each shift; rows are downward shifts."""
    stride = max(1, -(-sum(len(points.rows) for points in points_by_view) // _MAX_POINTS))
    columns = np.concatenate([p.columns[::stride] for p in points_by_view])
    rows = np.concatenate([p.rows[::stride] for p in points_by_view])
    intensity = np.concatenate([p.intensity[::stride] for p in points_by_view])
    images = np.repeat(
        np.arange(len(points_by_view)), [len(p.rows[::stride]) for p in points_by_view]
    )
    grey = _pad_and_stack([points.grey for points in points_by_view])
    ranks = np.linspace(0, 1, _BINS + 1)[1:-1]
    a = np.searchsorted(np.quantile(intensity, ranks), intensity) * _BINS
    bins = np.quantile(grey[images, rows, columns], ranks)
    levels = np.searchsorted(bins, np.arange(256)).astype(np.int64)[grey]
    shifts = range(-reach, reach + 1)
    out = np.zeros((len(shifts), len(shifts)))
    for i, down in enumerate(shifts):
        for j, right in enumerate(shifts):
            b = levels[images, rows + down, columns + right]
            joint = np.bincount(a + b, minlength=_BINS**2) / len(a)
            both = _entropy(joint)
            table = joint.reshape(_BINS, _BINS)
            out[i, j] = (_entropy(table.sum(0)) + _entropy(table.sum(1)) - both) / max(both, 1e-12)
    return out


def _pad_and_stack(images: Sequence[np.ndarray]) -> np.ndarray:
    """Return grey images uint8 [I, H, W]. Smaller ones are padded to the right and below."""
    size = np.max([image.shape for image in images], axis=0)
    out = np.zeros((len(images), *size), np.uint8)
    for place, image in zip(out, images, strict=True):
        place[: image.shape[0], : image.shape[1]] = image
    return out


def _entropy(p: np.ndarray) -> float:
    p = p[p > 0]
    return float(-(p * np.log(p)).sum())


def _peak(score: np.ndarray) -> tuple[float, float]:
    """Return the shift to the right and down of the highest score, refined by parabolas."""
    reach = len(score) // 2
    i, j = np.unravel_index(int(score.argmax()), score.shape)
    down = float(i) - reach
    right = float(j) - reach
    if 0 < i < 2 * reach:
        down += _vertex(score[i - 1, j], score[i, j], score[i + 1, j])
    if 0 < j < 2 * reach:
        right += _vertex(score[i, j - 1], score[i, j], score[i, j + 1])
    return right, down


def _vertex(before: float, middle: float, after: float) -> float:
    bend = before - 2 * middle + after
    return 0.0 if bend == 0 else float(0.5 * (before - after) / bend)


def with_camera_times(scene: Scene, offset_s: float) -> Scene:
    """Return the scene with every image taken offset_s later than stamped: poses and times of
    cameras.

    Positions and rotations follow the camera's own path, which continues straight at its ends.
    """
    paths = {name: _path(scene, name) for name in scene.camera_names}
    frames = []
    for frame in scene.frames:
        cameras = {n: camera_at(paths[n], c, offset_s) for n, c in frame.cameras.items()}
        frames.append(dataclasses.replace(frame, cameras=cameras))
    return dataclasses.replace(scene, frames=tuple(frames))


def _path(scene: Scene, name: str) -> list[Camera]:
    return [frame.cameras[name] for frame in scene.frames if name in frame.cameras]


def camera_at(path: Sequence[Camera], camera: Camera, offset_s: float) -> Camera:
    """Return the camera offset_s later, with the motion of its neighbours in the path.

    path: the same camera over time, in order, this one among them.
    """
    times = [other.timestamp_ns for other in path]
    place = times.index(camera.timestamp_ns)
    before = path[max(place - 1, 0)]
    after = path[min(place + 1, len(path) - 1)]
    span_s = (after.timestamp_ns - before.timestamp_ns) * 1e-9
    if span_s <= 0 or offset_s == 0:
        return camera
    part = torch.tensor(offset_s / span_s, dtype=torch.float64)
    turn = after.world_from_camera[:3, :3] @ before.world_from_camera[:3, :3].T
    identity = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    part_turn = slerp(identity, quat_from_rotmat(turn), part)
    camera_quat = quat_from_rotmat(camera.world_from_camera[:3, :3])
    pose = rigid(
        rotmat_from_quat(multiply_quats(part_turn, camera_quat)),
        camera.centre + (after.centre - before.centre) * part,
    )
    return dataclasses.replace(
        camera,
        camera_from_world=invert_rigid(pose),
        timestamp_ns=camera.timestamp_ns + round(offset_s * 1e9),
    )


def measure_time_offset(
    scene: Scene,
    returns: Mapping[int, Returns],
    views: RecordedViews,
    keys: Mapping[str, Sequence[ViewKey]],
) -> float | None:
    """Return the seconds after their stamps at which images fit the LiDAR best, for all cameras
    together.

    Cameras count by how clearly they show a time: those that look sideways do. The result is None
    if the car hardly moves, sweeps have no intensity, or no time within 50 ms stands out.

    Args:
        scene: the scene.
        returns: by frame.
        views: the recorded views.
        keys: views by camera, in order of time.
    """
    returns = {
        frame: Returns(
            frame_returns.points[::_RETURN_STRIDE], frame_returns.intensity[::_RETURN_STRIDE]
        )
        for frame, frame_returns in returns.items()
    }
    total = np.zeros(len(_STEPS_S))
    cameras = 0
    for name, camera_keys in keys.items():
        path = _path(scene, name)
        camera_keys = [key for key in camera_keys if key.frame in returns]
        moving = [key for key in camera_keys if _speed_mps(path, scene, key) > _MIN_SPEED_MPS]
        scores = [_fit(scene, returns, views, path, moving, float(offset)) for offset in _STEPS_S]
        valid_scores = np.array([score for score in scores if score is not None])
        if len(valid_scores) == len(_STEPS_S) and valid_scores.mean() > 0:
            total += valid_scores / valid_scores.mean()
            cameras += 1
    i = int(total.argmax())
    stands_out = total[i] >= (1 + _TIMING_CONTRAST) * total.mean()
    if cameras == 0 or not 0 < i < len(total) - 1 or not stands_out:
        return None
    step = _vertex(*total[i - 1 : i + 2])
    return float(_STEPS_S[i] + step * (_STEPS_S[1] - _STEPS_S[0]))


def _fit(
    scene: Scene,
    returns: Mapping[int, Returns],
    views: RecordedViews,
    path: Sequence[Camera],
    keys: Sequence[ViewKey],
    offset_s: float,
) -> float | None:
    """Return the shared information of images and returns, had images been taken offset_s later."""
    stamped_cameras = {key: scene.frame(key.frame).cameras[key.camera] for key in keys}
    later_cameras = {
        key: camera_at(path, camera, offset_s) for key, camera in stamped_cameras.items()
    }
    points_by_view = project_returns(returns, views, later_cameras, reach=0, near_m=_TIMING_NEAR_M)
    return float(shared_information(points_by_view, 0)[0, 0]) if points_by_view else None


def _speed_mps(path: Sequence[Camera], scene: Scene, key: ViewKey) -> float:
    camera = scene.frame(key.frame).cameras[key.camera]
    later = camera_at(path, camera, 0.01)
    return float((later.centre - camera.centre).norm()) / 0.01


@dataclass(frozen=True)
class ViewCheckResults:
    """Results of `check_views`.

    Attributes:
        problems: one sentence each.
        time_offset_s: seconds after their stamps at which images fit the LiDAR best. None if
            unknown.
        offsets: the shift of each camera, measured at the corrected times.
    """

    problems: tuple[str, ...]
    time_offset_s: float | None
    offsets: tuple[CameraOffset, ...]

    @property
    def report_facts(self) -> dict[str, Any]:
        """Return JSON-able facts for reports: pixels of the compared image, to the right and
        down.
        """
        offset_s = self.time_offset_s
        names = ("right_px", "down_px", "angle_deg", "is_sure")
        offsets = {o.camera: {name: getattr(o, name) for name in names} for o in self.offsets}
        return {
            "camera_time_offset_ms": None if offset_s is None else 1e3 * offset_s,
            "calibration_offsets": offsets,
        }


def check_views(scene: Scene, views: RecordedViews) -> ViewCheckResults:
    """Compare LiDAR with images and images with each other; takes some seconds.

    The calibration is not checked where sweeps have no intensity."""
    keys = sorted((*views.train, *views.test), key=lambda key: key.frame)
    keys_by_camera = {name: [k for k in keys if k.camera == name] for name in scene.camera_names}
    keys_by_camera = {
        name: camera_keys for name, camera_keys in keys_by_camera.items() if camera_keys
    }
    problems: list[str] = []
    for camera_keys in keys_by_camera.values():
        problems += exposure_jumps(views, camera_keys)
    # What is measured changes the cameras, so held-out images have no part in it.
    train_keys = {
        name: [k for k in camera_keys if k in set(views.train)]
        for name, camera_keys in keys_by_camera.items()
    }
    keys_by_camera = {
        name: spread_evenly(camera_keys, _NUM_FRAMES)
        for name, camera_keys in train_keys.items()
        if camera_keys
    }
    returns = read_intensities(
        scene, (key.frame for camera_keys in keys_by_camera.values() for key in camera_keys)
    )
    time_offset_s = measure_time_offset(scene, returns, views, keys_by_camera)
    if time_offset_s is not None and abs(time_offset_s) > _MAX_TIME_OFFSET_S:
        problems.append(
            f"images fit the LiDAR best if they were taken {abs(time_offset_s) * 1e3:.0f} ms "
            f"{'after' if time_offset_s > 0 else 'before'} their time stamps: one of the "
            f"clocks is wrong"
        )
    timed = scene if time_offset_s is None else with_camera_times(scene, time_offset_s)
    offsets = []
    for camera_keys in keys_by_camera.values():
        cameras = {k: timed.frame(k.frame).cameras[k.camera] for k in camera_keys}
        offset = measure_offset(returns, views, cameras)
        if offset is not None:
            offsets.append(offset)
            problems += offset.problems
    return ViewCheckResults(tuple(problems), time_offset_s, tuple(offsets))


def exposure_jumps(views: RecordedViews, keys: Sequence[ViewKey]) -> list[str]:
    """Return a sentence for each sudden change of brightness between neighbouring images of a
    camera.

    The change is the median, over blocks, of the logarithm of their ratio, so that moving objects
    hardly count.
    """
    if len(keys) < 3:
        return []
    cameras = [views.camera(key) for key in keys]
    size = (
        min(_BLOCKS[0], *(camera.width for camera in cameras)),
        min(_BLOCKS[1], *(camera.height for camera in cameras)),
    )
    levels = [_block_stops(views.image(key), size) for key in keys]
    change = np.array([np.median(b - a) for a, b in itertools.pairwise(levels)])
    usual = float(np.median(np.abs(change)))
    bound = max(_JUMP_STOPS, _JUMP_TIMES * usual)
    jumps = np.flatnonzero(np.abs(change) > bound)
    sentences = [
        f"camera {keys[i].camera}: brightness changes by a factor of {2 ** change[i]:.2f} between "
        f"frames {keys[i].frame} and {keys[i + 1].frame}; one exposure for the whole drive will "
        f"not fit both"
        for i in jumps[:_MAX_NAMED]
    ]
    if len(jumps) > _MAX_NAMED:
        sentences.append(
            f"camera {keys[0].camera}: brightness jumps {len(jumps) - _MAX_NAMED} more times, last "
            f"after frame {keys[jumps[-1]].frame}"
        )
    return sentences


def _block_stops(rgb: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the logarithm to base 2 of the mean brightness of each block, float32.

    size: blocks across and down."""
    grey = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    return np.log2(grey.astype(np.float32) + 4)  # a few levels, so that black does not count
