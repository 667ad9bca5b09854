"""Scenes of trained Street Gaussians models, and of the datasets that they were trained on.

    street_gaussians:MODEL?data=DIR&iteration=N&weights=pth&width=1600&frames=0:50&rotation_bug=1

Training images, COLMAP and CUDA are not needed. The dataset's folder is needed for the cameras' and
actors' poses. World: the dataset's, minus the mean position of the car. Cameras are those of the
project's renders: at most `width` pixels wide, without distortion. A dataset's folder alone opens
as a raw drive.

Images differ from the project's in two points. Colours above 1 are not cut before the sky and the
colour map. With a pose correction the sky turns with the background, by the fraction of a degree
that corrections have.

rotation_bug=1 turns actors as an older release of the project did. Models that were trained with
that release need it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import threading
import zipfile
import zlib
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from torch import Tensor

from adapters.lidar_scene.scene import without_points
from adapters.lidar_scene.split import join_tracks
from adapters.plain_files import read_pose
from adapters.raw_drive import (
    BoxSample,
    DriveOptions,
    RawDrive,
    Sweep,
    is_in_box,
    objects_that_travel,
    scene_of_drive,
)
from adapters.recorded_lenses import RECORDED_LENS, LensFrames, split_lenses
from adapters.safe_pickle import check_holds_object, stream_arrays
from adapters.street_gaussians.data import (
    CAMERA_NAMES,
    TIMES,
    ModelConfig,
    StreetData,
    TrackedObject,
    TrackTable,
    calibrated_cameras,
    frames_of,
    read_data,
    read_times,
    read_track_table,
    track_files,
    with_lenses,
)
from adapters.street_gaussians.model import (
    SCHEME,
    ModelOptions,
    Part,
    PoseChanges,
    TrainedModel,
    find_model,
    is_dataset,
    read_checkpoint,
    read_ply_model,
)
from adapters.uri import format_uri
from adapters.world import with_class_of
from augment.errors import AdapterError
from augment.files.pickles import PickleError
from augment.memo import SceneMemo
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import quat_from_rotmat, rotmat_from_quat
from augment.scene.labels import Boxes, LabelSource, LidarSweep
from augment.scene.scene import Actor, ColorSeries, Scene, Track
from augment.scene.sky import ConstantSky, CubemapSky


def open_street_gaussians(path: str, query: dict[str, str]) -> Scene:
    """Open the scene of a trained model, or of a dataset's folder.

    Args:
        path: a model's folder, a .pth or .ply in it, or a dataset's folder.
        query: see ModelOptions; for a dataset see open_raw.

    Raises:
        AdapterError: an option is wrong, or a file is missing, damaged, of another version, or does
            not belong to the others. The message names file and key.
    """
    if is_dataset(Path(path)):
        return open_raw(Path(path), query)
    options = ModelOptions.from_query(SCHEME, query)
    files = find_model(Path(path), options)
    data = read_data(files.data, files.config)
    recorded_frames = frames_of(data)
    selection = options.frames.select([f.index for f in recorded_frames], where=f"{SCHEME}:{path}")
    read_weights = read_checkpoint if files.weights.suffix.lower() == ".pth" else read_ply_model
    model = read_weights(files.weights, files.config)
    if model.pose_changes is not None:
        check_changes(model.pose_changes, data, str(model.file))
    changes = camera_changes(model.camera_changes, data, files.config, str(model.file))
    by_camera, by_image = color_maps(model.color_maps, data, files.config, str(model.file))
    recorded_frames = [frame for frame in recorded_frames if frame.index in selection.numbers]
    frames = _with_model_cameras(recorded_frames, data, changes, options.width)
    actors, problems = _actors(data, model, changes, files.config, options.rotation_bug == "1")
    sky = ConstantSky(torch.full((3,), float(files.config.white_background)))
    if model.sky is not None:
        sky = CubemapSky(model.sky)
    image_times = {(c.name, c.timestamp_ns) for frame in frames for c in frame.cameras.values()}
    return Scene(
        name=files.folder.resolve().name,
        source=format_uri(SCHEME, path, query),
        background=model.background.gaussians,
        actors=actors,
        sky=sky,
        frames=frames,
        labels=labels_of(files.data),
        world_origin_m=data.world_origin_m,
        problems=(
            *data.problems,
            *selection.problems,
            *model.problems,
            *problems,
            *([_TRAINED_AS_PINHOLES] if options.lens == RECORDED_LENS else []),
        ),
        color_maps=by_camera,
        image_color_maps={k: v for k, v in by_image.items() if k in image_times},
        recorded_source=format_uri(SCHEME, files.data, {}),
        made_by={
            "method": "Street Gaussians",
            "weights": str(files.weights),
            "iteration": files.iteration,
            "config": str(files.config_file),
        },
    )


def street_gaussians_labels(path: str, query: dict[str, str]) -> LabelSource | None:
    """Return the labels alone, of a dataset's folder or of a model's dataset.

    Raises:
        AdapterError: as open_street_gaussians.
    """
    if is_dataset(Path(path)):
        return labels_of(Path(path))
    return labels_of(find_model(Path(path), ModelOptions.from_query(SCHEME, query)).data)


def _actors(
    data: StreetData,
    model: TrainedModel,
    changes: np.ndarray,
    config: ModelConfig,
    has_rotation_bug: bool,
) -> tuple[tuple[Actor, ...], Sequence[str]]:
    """Return the actors in the order in which their objects appear, and sentences on missing
    ones.
    """
    actors = []
    problems = []
    for tracked in data.objects:
        part = model.actors.get(tracked.track_id)
        if part is None:
            problems.append(
                f"the {tracked.label} obj_{tracked.track_id:03d} of the tracks has no Gaussians in "
                f"{model.file} and is left out"
            )
            continue
        actor, actor_problems = make_actor(
            data, tracked, part, model.pose_changes, changes, config, rotation_bug=has_rotation_bug
        )
        problems += actor_problems
        actors += [] if actor is None else [actor]
    track_ids = {tracked.track_id for tracked in data.objects}
    problems += [
        f"{model.file}: obj_{number:03d} has no track among the moving objects of {data.root} and "
        f"is left out"
        for number in model.actors
        if number not in track_ids
    ]
    return tuple(actors), problems


def _with_model_cameras(
    frames: Sequence[Frame], data: StreetData, changes: np.ndarray, width: int
) -> tuple[Frame, ...]:
    """Return the frames with the cameras that the model renders instead of the recorded ones."""
    rows = {(image.frame, image.name): row for row, image in enumerate(data.images)}
    model_frames = []
    for frame in frames:
        cameras = {}
        for name, camera in frame.cameras.items():
            change = torch.from_numpy(changes[rows[frame.index, name]])
            cameras[name] = dataclasses.replace(
                _limit_width(camera, width), camera_from_world=camera.camera_from_world @ change
            )
        model_frames.append(dataclasses.replace(frame, cameras=cameras))
    return tuple(model_frames)


def _limit_width(camera: Camera, max_width: int) -> Camera:
    """Return a camera of limited width, as the project renders it.

    Both axes have one scale. The part of a row below the last whole one is cut off.
    """
    if max_width == 0 or camera.width <= max_width:
        return camera
    scale = camera.width / max_width
    return dataclasses.replace(
        camera,
        width=max_width,
        height=max(1, int(camera.height / scale)),
        fx=camera.fx / scale,
        fy=camera.fy / scale,
        cx=camera.cx / scale,
        cy=camera.cy / scale,
    )


# ---- A model's actors: Gaussians, tracks at the moments of the images, colours over time ---------

# An actor's first and last poses hold at most this long.
_MAX_HOLD_NS = 100_000_000
# Largest distance of an actor's places in images of one moment that is not reported.
_MAX_SPREAD_M = 0.01


def make_actor(
    data: StreetData,
    tracked: TrackedObject,
    part: Part,
    pose_changes: PoseChanges | None,
    camera_changes: np.ndarray,
    config: ModelConfig,
    *,
    rotation_bug: bool = False,
) -> tuple[Actor | None, tuple[str, ...]]:
    """Return the actor of an object's Gaussians, or None if no image shows it, and sentences."""
    name = f"obj_{tracked.track_id:03d}"
    times = np.array([image.timestamp_s for image in data.images])
    image_rows = np.flatnonzero((times >= tracked.start_s) & (times <= tracked.end_s))
    if len(image_rows) == 0:
        return None, (f"{name} is in none of the images' moments and is left out",)
    poses = image_poses(
        data,
        tracked,
        image_rows,
        pose_changes,
        interpolate_held_out=config.opt_track,
        rotation_bug=rotation_bug,
    )
    images = [data.images[i] for i in image_rows]
    ego_from_actor = np.tile(np.eye(4), (len(image_rows), 1, 1))
    ego_from_actor[:, :3, :3] = rotmat_from_quat(torch.from_numpy(poses.quats)).numpy()
    ego_from_actor[:, :3, 3] = poses.positions
    world_from_ego = np.stack([image.world_from_ego for image in images])
    world_from_actor = np.linalg.inv(camera_changes[image_rows]) @ world_from_ego @ ego_from_actor
    stamps = np.array([image.timestamp_ns for image in images])
    knots, first_rows, knot_of_image = np.unique(stamps, return_index=True, return_inverse=True)
    offsets = world_from_actor[:, :3, 3] - world_from_actor[first_rows[knot_of_image], :3, 3]
    spread_m = np.linalg.norm(offsets, axis=1).max()
    problems = []
    if spread_m > _MAX_SPREAD_M:
        problems.append(
            f"{name} is at places up to {spread_m:.2f} m apart in images of one moment; the first "
            f"camera's is taken"
        )
    if part.terms is not None and tracked.start_frame == tracked.end_frame:
        problems.append(f"{name} is tracked in one frame only; its colours do not change over time")
    stamps = np.array([image.timestamp_ns for image in data.images])
    gaps_before_ns = knots[0] - stamps[stamps < knots[0]]
    gaps_after_ns = stamps[stamps > knots[-1]] - knots[-1]
    hold_ns = int(
        min([_MAX_HOLD_NS, *(gaps_before_ns - 1), *(gaps_after_ns - 1)])
    )  # into no other image
    waves = None
    if part.terms is not None:  # all images of a frame have the phase of its number
        span = tracked.end_frame - tracked.start_frame
        steps = np.array([images[i].frame for i in first_rows], np.float64) - tracked.start_frame
        phases = config.fourier_scale * steps / span if span else np.zeros(len(first_rows))
        waves = ColorSeries(part.terms, torch.from_numpy(knots), torch.from_numpy(phases))
    actor = Actor(
        track_id=str(tracked.track_id),
        label=tracked.label,
        gaussians=with_class_of(tracked.label, part.gaussians),
        track=Track(
            torch.from_numpy(knots), torch.from_numpy(world_from_actor[first_rows]), hold_ns=hold_ns
        ),
        size_m=tracked.size_m,
        color_waves=waves,
        colors_in_world=True,
    )
    return actor, tuple(problems)


# ---- Poses of actors: tracklets, moved by training, interpolated in the vehicle frame ------------

# Smaller angles are interpolated linearly: their sine loses its digits, and the line is exact.
_MIN_ANGLE_RAD = 1e-6


class Poses(NamedTuple):
    """T poses. positions: float64 [T, 3], metres. quats: float64 [T, 4], unit wxyz."""

    positions: np.ndarray
    quats: np.ndarray


def check_changes(changes: PoseChanges, data: StreetData, where: str) -> None:
    """Check that the poses of a model belong to the dataset's tracklets."""
    model_shape = changes.positions.shape[:2]
    data_shape = data.tracklets.ids.shape
    if model_shape != data_shape:
        raise AdapterError(
            f"{where}: actor_pose has {model_shape[0]} frames and {model_shape[1]} columns "
            f"(opt_trans {list(changes.positions.shape)}), but the tracks of {data.root} give "
            f"{data_shape[0]} frames and {data_shape[1]} columns ({[*data_shape, 3]}). Frames "
            f"follow from data.selected_frames of the configuration, columns also from "
            f"data.cameras and data.use_tracker and from track/: give the data and the configs/ "
            f"that the model was trained with"
        )


def vehicle_poses(
    data: StreetData,
    tracked: TrackedObject,
    times_s: np.ndarray,
    changes: PoseChanges | None,
    *,
    rotation_bug: bool = False,
) -> Poses:
    """Return the poses of an object in the vehicle frame at T times, float64 [T].

    A pose is interpolated between the two frames nearest to each time, linearly in position and by
    slerp in rotation. Before and after these frames both are extrapolated. An object that is
    tracked in one frame only stays at its pose.

    Args:
        data: the dataset.
        tracked: the object.
        times_s: the times.
        changes: changes of the poses by training.
        rotation_bug: True for the poses of an older release of the project. It reads the turn of
            the second frame in the first frame's row, and applies it to the turned rotation.
    """
    rows, columns = np.nonzero(data.tracklets.ids == tracked.track_id)
    frame_times = data.frame_times_s[rows]
    order = np.argsort(np.abs(frame_times - times_s[:, None]), axis=1, kind="stable")
    first = order[:, 0]
    second = order[:, min(1, len(rows) - 1)]
    positions = data.tracklets.positions[rows, columns]
    quats = data.tracklets.quats[rows, columns]
    if changes is not None:
        positions = positions + changes.positions[rows, columns]
        turned_quats = _turn_about_z(quats, changes.half_turns[rows, columns])
        quats_first = turned_quats[first]
        quats_second = turned_quats[second]
        if rotation_bug:
            misread_turns = changes.half_turns[rows[first], columns[second]]
            quats_second = _turn_about_z(quats_first, misread_turns)
    else:
        quats_first = quats[first]
        quats_second = quats[second]
    fraction = _interpolation_fraction(times_s, frame_times[first], frame_times[second])
    return Poses(
        _interpolate_linearly(positions[first], positions[second], fraction),
        slerp(quats_first, quats_second, fraction),
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
    """Return the poses of an object in the vehicle frame at the moments of images.

    Args:
        data: the dataset.
        tracked: the object.
        images: positions in data.images.
        changes: changes of the poses by training.
        interpolate_held_out: True if images that were not trained on have no poses of their own.
            Their poses are interpolated between those of their camera's two nearest trained images,
            if the object has two.
        rotation_bug: as in vehicle_poses.
    """
    times = np.array([data.images[i].timestamp_s for i in images])
    poses = vehicle_poses(data, tracked, times, changes, rotation_bug=rotation_bug)
    if not interpolate_held_out:
        return poses
    for position, index in enumerate(images):
        image = data.images[index]
        if not image.is_held_out:
            continue
        nearest_times_s = _nearest_trained(data, tracked, image.cam, image.timestamp_s)
        if nearest_times_s is None:
            continue
        end_poses = vehicle_poses(
            data, tracked, nearest_times_s, changes, rotation_bug=rotation_bug
        )
        fraction = _interpolation_fraction(times[position], nearest_times_s[0], nearest_times_s[1])
        poses.positions[position] = _interpolate_linearly(
            end_poses.positions[0], end_poses.positions[1], fraction
        )
        poses.quats[position] = slerp(end_poses.quats[:1], end_poses.quats[1:], fraction[None])[0]
    return poses


def _nearest_trained(
    data: StreetData, tracked: TrackedObject, cam: int, time_s: float
) -> np.ndarray | None:
    """Return the times of a camera's two images nearest to a time that were trained on and show
    the object.
    """
    trained_times = (i.timestamp_s for i in data.images if i.cam == cam and not i.is_held_out)
    times = np.array([t for t in trained_times if tracked.start_s <= t <= tracked.end_s])
    if len(times) < 2:
        return None
    return times[np.argsort(np.abs(times - time_s), kind="stable")[:2]]


def _interpolation_fraction(times: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the positions of times between the first and the second time, which may be equal."""
    interval = np.asarray(second - first)
    return np.where(interval == 0, 0.0, (times - first) / np.where(interval == 0, 1.0, interval))


def _interpolate_linearly(
    first: np.ndarray, second: np.ndarray, fraction: np.ndarray
) -> np.ndarray:
    """Return the points at fractions between the first and the second points."""
    return first * (1 - fraction)[..., None] + second * fraction[..., None]


def _turn_about_z(quats: np.ndarray, half_turns: np.ndarray) -> np.ndarray:
    """Return quats times (cos, 0, 0, sin): turned about their own z by twice the half turns."""
    w, x, y, z = np.moveaxis(quats, -1, 0)
    c = np.cos(half_turns)
    s = np.sin(half_turns)
    return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, w * s + z * c], -1)


def slerp(first: np.ndarray, second: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Interpolate unit quaternions [T, 4] the shorter way round.

    Fractions [T] outside of [0, 1] extrapolate.
    """
    dots = (first * second).sum(1)
    second = np.where(dots[:, None] < 0, -second, second)
    angles = np.arccos(np.clip(np.abs(dots), 0, 1))
    is_straight = angles < _MIN_ANGLE_RAD
    sines = np.where(is_straight, 1.0, np.sin(angles))
    first_weight = np.where(is_straight, 1 - fraction, np.sin((1 - fraction) * angles) / sines)
    second_weight = np.where(is_straight, fraction, np.sin(fraction * angles) / sines)
    quats = first_weight[:, None] * first + second_weight[:, None] * second
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


# ---- What a model learnt for single images or cameras: colour maps and moved cameras -------------


def camera_changes(
    changes: np.ndarray | None, data: StreetData, config: ModelConfig, where: str
) -> np.ndarray:
    """Return the rigid motion of the background before each of data.images is taken, float64 [I,
    4, 4].

    Without a pose correction it is the identity.
    """
    if changes is None:
        return np.tile(np.eye(4), (len(data.images), 1, 1))
    mode = config.pose_correction_mode
    if mode == "image":
        expected = len(data.frames) * len(config.cameras)
        rows = [image.number for image in data.images]
    else:
        expected = len(data.frames)
        rows = [data.frames.index(image.frame) for image in data.images]
    _check_count(len(changes), expected, f"{where}, pose_correction", mode, data)
    return changes[rows]


def color_maps(
    maps: Tensor | None, data: StreetData, config: ModelConfig, where: str
) -> tuple[dict[str, Tensor], dict[tuple[str, int], Tensor]]:
    """Return the colour correction as Scene.color_maps and Scene.image_color_maps.

    It is applied after the sky. Maps belong to cameras or to images. If they belong to images, a
    camera has the mean of the images that were trained on, for other views.
    """
    if maps is None:
        return {}, {}
    mode = config.color_correction_mode
    where = f"{where}, color_correction"
    if mode == "sensor":
        cams = sorted({image.cam for image in data.images})
        _check_count(len(maps), len(config.cameras), where, mode, data)
        if cams[-1] >= len(maps):
            raise AdapterError(
                f"{where}: affine_trans has maps of cameras 0 to {len(maps) - 1}, but the "
                f"configuration's data.cameras has {list(config.cameras)}"
            )
        return {CAMERA_NAMES[cam]: maps[cam].clone() for cam in cams}, {}
    _check_count(len(maps), len(data.frames) * len(config.cameras), where, mode, data)
    by_camera = {}
    for name in dict.fromkeys(image.name for image in data.images):
        camera_images = [image for image in data.images if image.name == name]
        trained_numbers = [image.number for image in camera_images if not image.is_held_out]
        by_camera[name] = maps[trained_numbers or [image.number for image in camera_images]].mean(0)
    return by_camera, {(i.name, i.timestamp_ns): maps[i.number].clone() for i in data.images}


def _check_count(count: int, expected: int, where: str, mode: str, data: StreetData) -> None:
    """Raise an AdapterError if a table has another number of entries than expected."""
    if count != expected:
        raise AdapterError(
            f"{where} has {count} entries; with mode {mode!r} and the dataset {data.root} it must "
            f"have {expected}. The number follows from data.cameras and data.selected_frames of "
            f"the configuration: give the data and the configs/ that the model was trained with"
        )


# ---- LiDAR: pointcloud.npz, a ZIP of pickled dictionaries ----------------------------------------
#     pointcloud[frame]           float [N, 3], vehicle frame at the frame's time
#     camera_projection[frame]    int16 [N, 6]: camera, x, y of the first camera that sees the point
#                                 and of the second; camera -1 for none
#
# The file holds the whole drive, compressed, with no way to get at one frame. It is read forward,
# and where reading stopped is kept: frames asked for in their order cost one pass.

POINT_CLOUD_FILE = "pointcloud.npz"
# Member of the ZIP with the points.
_POINTS_MEMBER = "pointcloud.npy"
# Member of the ZIP with the projections.
_PROJECTIONS_MEMBER = "camera_projection.npy"
# Memory for the point clouds that were read last.
_CACHE_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Returns of a frame.

    Attributes:
        points: float64 [N, 3], vehicle frame.
        projections: int16 [N, 6]. None if the file has none.
    """

    points: np.ndarray
    projections: np.ndarray | None


class _Reader:
    """Forward reader of one file. It caches the frames that it passed last."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._recent_clouds = SceneMemo(_CACHE_BYTES)
        self._all_frames: set[int] | None = None  # frames of the file, known after a whole pass
        self._passed_frames: set[int] = set()
        self._cloud_iterator = _cloud_iterator(path)

    def read(self, frame: int) -> PointCloud | None:
        """Return the returns of a frame, or None if the file lacks it."""
        return self._recent_clouds.get(frame, lambda: self._read_forward(frame))

    def _read_forward(self, frame: int) -> PointCloud | None:
        if self._all_frames is not None and frame not in self._all_frames:
            return None
        if frame in self._passed_frames:
            self.rewind()
        try:
            for number, cloud in self._cloud_iterator:
                self._passed_frames.add(number)
                self._recent_clouds.put(number, cloud)
                if number == frame:
                    return cloud
        except BaseException:
            self.rewind()
            raise
        self._all_frames = self._passed_frames
        self.rewind()
        return None

    def rewind(self) -> None:
        """Close the file. The next reading starts at its beginning."""
        self._cloud_iterator.close()
        self._cloud_iterator = _cloud_iterator(self._path)
        self._passed_frames = set()


_lock = threading.Lock()


@lru_cache(maxsize=1)
def _open_reader(path: Path, *_state: int) -> _Reader:
    """Return the reader of the file that was read last, as long as the file stays unchanged."""
    return _Reader(path)


def read_point_cloud(root: Path, frame: int) -> PointCloud | None:
    """Return the returns of a frame, or None if there is no file, or no such frame in it."""
    path = root / POINT_CLOUD_FILE
    if not path.exists():
        return None
    stat = path.stat()
    # A forked process shares its parent's place in an open file: it opens the file itself.
    with _lock:
        return _open_reader(path, stat.st_mtime_ns, stat.st_size, os.getpid()).read(frame)


def iterate_point_clouds(root: Path) -> Iterator[tuple[int, PointCloud]]:
    """Return frame number and returns of every frame, in the file's order.

    Nothing without the file.
    """
    if (root / POINT_CLOUD_FILE).exists():
        yield from _cloud_iterator(root / POINT_CLOUD_FILE)


def _cloud_iterator(path: Path) -> Generator[tuple[int, PointCloud]]:
    """Return frame number and returns of every frame of the file."""
    try:
        with zipfile.ZipFile(path) as archive, contextlib.ExitStack() as members:
            names = archive.namelist()
            if _POINTS_MEMBER not in names:
                raise AdapterError(
                    f"{path} must hold the arrays pointcloud and camera_projection; it holds "
                    f"{names[:5]}"
                )
            points, projections = (
                _iterate_arrays(path, name, members.enter_context(archive.open(name)))
                if name in names
                else None
                for name in (_POINTS_MEMBER, _PROJECTIONS_MEMBER)
            )
            for frame, xyz in points or ():
                projection = None if projections is None else next(projections, (None, None))
                yield frame, _make_cloud(path, frame, xyz, projection)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise AdapterError(
            f"{path} is no whole .npz file of dictionaries ({error}); copy it again"
        ) from error
    except OSError as error:
        raise AdapterError(f"{path} cannot be read: {error}") from error


def _iterate_arrays(path: Path, member: str, file: BinaryIO) -> Iterator[tuple[int, np.ndarray]]:
    """Return frame number and array of every entry of a member."""
    try:
        check_holds_object(file)
        yield from stream_arrays(file)
    except PickleError as error:
        raise AdapterError(
            f"{path}, {member} was not read: {error}. Only a dictionary of arrays of numbers by "
            f"frame is accepted"
        ) from None


def _make_cloud(
    path: Path, frame: int, xyz: np.ndarray, projection: tuple[int | None, Any] | None
) -> PointCloud:
    """Check the arrays of a frame. projection: frame number and array, None if the file has
    none.
    """
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind != "f":
        raise AdapterError(
            f"{path}: pointcloud[{frame}] must be floats [N, 3]; got {xyz.dtype} {list(xyz.shape)}"
        )
    if projection is None:
        return PointCloud(xyz.astype(np.float64), None)
    number, projections = projection
    if number != frame:
        raise AdapterError(
            f"{path}: pointcloud and camera_projection must hold the same frames in the same "
            f"order; got {frame} and {number}"
        )
    if projections.shape != (len(xyz), 6) or projections.dtype.kind not in "iu":
        raise AdapterError(
            f"{path}: camera_projection[{frame}] must be whole numbers [{len(xyz)}, 6], a row for "
            f"each point; got {projections.dtype} {list(projections.shape)}"
        )
    return PointCloud(xyz.astype(np.float64), projections.astype(np.int16))


# ---- Labels --------------------------------------------------------------------------------------

# Position of the roof LiDAR of Waymo's cars in the ego frame: forward, left, up.
ROOF_SENSOR_M = np.array([1.43, 0.0, 2.18])


@dataclass(frozen=True)
class StreetGaussiansLabels:
    """Labels of one dataset directory, read on demand.

    Boxes: all rows of the frame in track/track_info.txt, of any class, carried into the world by
    the car's pose at the frame's time. Attributes are alpha and, if the file has it, speed (metres
    per second). Sweeps: columns x y z (metres), timestamp_ns (the frame's: the points are where
    they were at that moment), and, if the file has projections, camera, u, v: the number of the
    first camera that sees the point, -1 for none, and the pixel there. A frame without the car's
    pose has no boxes and no sweep.
    """

    root: Path

    def boxes(self, frame_index: int) -> Boxes:
        """Return the boxes of a frame."""
        path, _ = track_files(self.root, use_tracker=False)
        pose = self._world_from_ego(frame_index)
        if pose is None or not path.exists():
            return Boxes.empty()
        stat = path.stat()
        table = _cached_track_table(path, stat.st_mtime_ns, stat.st_size)
        rows = np.flatnonzero(table.frames == frame_index)
        world_from_box = pose @ ego_from_boxes(table, rows)
        attributes = {"alpha": table.alphas[rows]}
        if table.speeds_mps is not None:
            attributes["speed"] = table.speeds_mps[rows]
        return Boxes(
            track_ids=tuple(str(track_id) for track_id in table.ids[rows].tolist()),
            labels=tuple(table.labels[row] for row in rows),
            centers_m=world_from_box[:, :3, 3],
            sizes_m=table.sizes_m[rows],
            quats=quat_from_rotmat(torch.from_numpy(world_from_box[:, :3, :3])).numpy(),
            attributes=attributes,
        )

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """Return the sweep of a frame in the world, or None without returns or the car's pose."""
        pose = self._world_from_ego(frame_index)
        cloud = None if pose is None else read_point_cloud(self.root, frame_index)
        if cloud is None:
            return None
        times = read_times(self.root)["FRAME"]
        if frame_index not in times:
            raise AdapterError(f"{self.root / TIMES}: FRAME lacks frame {frame_index:06d}")
        world_points = cloud.points @ pose[:3, :3].T + pose[:3, 3]
        columns: dict[str, np.ndarray] = {
            axis: world_points[:, i].copy() for i, axis in enumerate("xyz")
        }
        columns["timestamp_ns"] = np.full(
            len(world_points), round(times[frame_index] * 1e9), np.int64
        )
        if cloud.projections is not None:
            for i, name in enumerate(("camera", "u", "v")):
                columns[name] = cloud.projections[:, i].copy()
        return LidarSweep(columns)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Return the position of Waymo's roof sensor in the frame's pose, once per return,
        float64 [N, 3].

        The files join the returns of five sensors and do not tell them apart. The returns of the
        four sensors at the bumpers and sides, which reach 20 m, are assigned to the roof's, too.
        """
        pose = self._world_from_ego(frame_index)
        if pose is None:
            return None
        return np.broadcast_to(pose[:3, :3] @ ROOF_SENSOR_M + pose[:3, 3], (len(sweep), 3))

    def _world_from_ego(self, frame: int) -> np.ndarray | None:
        path = self.root / "ego_pose" / f"{frame:06d}.txt"
        return read_pose(path) if path.exists() else None


def labels_of(root: Path) -> StreetGaussiansLabels | None:
    """Return the labels of a dataset directory, or None if it is no dataset."""
    return StreetGaussiansLabels(root) if (root / "ego_pose").is_dir() else None


def ego_from_boxes(table: TrackTable, rows: np.ndarray) -> np.ndarray:
    """Return the poses of the rows' boxes in the vehicle's frame, float64 [R, 4, 4]."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    cos = np.cos(table.headings[rows])
    sin = np.sin(table.headings[rows])
    poses[:, 0, 0] = cos
    poses[:, 0, 1] = -sin
    poses[:, 1, 0] = sin
    poses[:, 1, 1] = cos
    poses[:, :3, 3] = table.centers_m[rows]
    return poses


@lru_cache(maxsize=2)
def _cached_track_table(path: Path, mtime_ns: int, size: int) -> TrackTable:
    """Read a track file. mtime_ns and size change when the file changes."""
    return read_track_table(path)


# ---- A drive without a trained model: Gaussians from coloured LiDAR ------------------------------
# The world is the one that a model trained on it has. Returns are where they were at their frame's
# time, as the converter has it, and so are the boxes.

# Elevation of the uppermost channel of Waymo's roof LiDAR. Those at the sides look higher, but not
# far.
_LIDAR_TOP_DEG = 2.4
# Least and greatest corner of the recording car in its own frame, whose origin is on the ground
# below its rear axle.
_EGO_BOX_M = np.array([[-1.4, -1.15, 0.1], [4.2, 1.15, 2.4]])
# Note on a trained model of which recorded lenses are asked for.
_TRAINED_AS_PINHOLES = (
    "the model was trained on the recorded images as if they were those of pinholes, so it has "
    "their lens distortion in its Gaussians: lens=recorded changes nothing; of the "
    "dataset's folder alone it keeps the lenses"
)
# Classes that never move.
_STATIC_CLASSES = ("sign",)


def open_raw(root: Path, query: dict[str, str]) -> Scene:
    """Open the scene of a dataset directory alone.

    Opening is deterministic: the same files and options give the same bits.

    Args:
        root: the directory.
        query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out; see DriveOptions.
    """
    options = DriveOptions.from_query(SCHEME, query)
    cams = calibrated_cameras(root)
    if not cams:
        raise AdapterError(
            f"{root / 'extrinsics'} holds no calibration 0.txt to 4.txt; copy it from the dataset"
        )
    data = read_data(root, ModelConfig(cameras=cams))
    frames = frames_of(data)
    selection = options.select([f.index for f in frames], where=f"{SCHEME}:{root}")
    frames = tuple(frame for frame in frames if frame.index in set(selection.numbers))
    lens_frames = LensFrames(frames, None, ())
    if options.has_recorded_lens:
        lens_frames = split_lenses(
            root.absolute().name,
            with_lenses(root, frames),
            options.lens,
            published=f"images of {root}, whose intrinsics/ have no distortion,",
        )
        frames = lens_frames.frames
    sweeps, sweep_problems = _read_sweeps(
        root, [f for f in frames if f.index not in selection.held_out]
    )
    table = read_track_table(track_files(root, use_tracker=False)[0])
    drive = RawDrive(
        name=root.absolute().name,
        source=format_uri(SCHEME, root, query),
        frames=frames,
        held_out=selection.held_out,
        sweeps=sweeps,
        boxes=_moving_samples(table, frames),
        labels=StreetGaussiansLabels(root),
        world_origin_m=data.world_origin_m,
        lidar_top_deg=_LIDAR_TOP_DEG,
        problems=(*data.problems, *selection.problems, *sweep_problems, *lens_frames.notes),
        recorded_frames=lens_frames.recorded_frames,
    )
    scene = scene_of_drive(drive, options)
    missing_problems = without_points(join_tracks(drive.boxes), scene)
    faults = scene.problems[len(drive.problems) :]
    return dataclasses.replace(scene, problems=drive.problems + missing_problems + faults)


def _read_sweeps(root: Path, frames: Sequence[Frame]) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """Read the usable returns of the frames in the scene's world, without those of the recording
    car.

    A sentence is returned if frames have none.
    """
    by_number = {frame.index: frame for frame in frames}
    sweeps = {}
    for number, cloud in iterate_point_clouds(root):
        frame = by_number.get(number)
        if frame is None:
            continue
        is_of_ego_car = is_in_box(cloud.points, *_EGO_BOX_M)
        points = cloud.points[~is_of_ego_car & np.isfinite(cloud.points).all(axis=1)]
        pose = frame.world_from_ego.numpy()
        world_points = points @ pose[:3, :3].T + pose[:3, 3]
        sweeps[number] = Sweep.of_unknown_class(world_points, frame.timestamp_ns)
    problems = ()
    if missing_frames := sorted(set(by_number) - set(sweeps)):
        problems = (
            f"{root / POINT_CLOUD_FILE} lacks {len(missing_frames)} frames, such as "
            f"{missing_frames[0]}: their points too",
        )
    return tuple(sweeps[number] for number in sorted(sweeps)), problems


def _moving_samples(table: TrackTable, frames: Sequence[Frame]) -> tuple[BoxSample, ...]:
    """Return the boxes of the objects that move within the frames, by frame."""
    samples: list[BoxSample] = []
    for frame in frames:
        rows = np.flatnonzero(table.frames == frame.index)
        poses = frame.world_from_ego.numpy() @ ego_from_boxes(table, rows)
        samples += [
            BoxSample(
                object_id=str(int(table.ids[row])),
                sibling_id=None,
                label=table.labels[row],
                frame=frame.index,
                timestamp_ns=frame.timestamp_ns,
                world_from_box=pose,
                size_m=table.sizes_m[row],
            )
            for row, pose in zip(rows, poses, strict=True)
            if table.labels[row] not in _STATIC_CLASSES
        ]
    moving_ids = objects_that_travel((s.object_id, s.world_from_box[:3, 3]) for s in samples)
    return tuple(sample for sample in samples if sample.object_id in moving_ids)
