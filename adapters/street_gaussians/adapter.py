"""Trained Street Gaussians models as scenes.

    street_gaussians:MODEL?data=DIR&iteration=N&weights=pth&width=1600&frames=0:50&rotation_bug=1

Neither training images nor COLMAP nor CUDA are needed; the dataset's folder is, for the cameras'
and actors' poses. World: the dataset's, minus the mean position of the car. Cameras are those of
the project's renders: at most `width` pixels wide, without distortion. The dataset's folder alone
opens as a raw drive.

Where pictures differ from the project's: colours above 1 are not cut before the sky and the colour
map; with a pose correction the sky turns with the background, by the fraction of a degree that
corrections have.

rotation_bug=1 turns actors as an older release of the project did, which models that were trained
with that release have learnt to live with.
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
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.files.pickles import PickleError
from augment.geometry import quat_from_rotmat, rotmat_from_quat
from augment.labels import Boxes, LabelSource, LidarSweep
from augment.memo import SceneMemo
from augment.scene import Actor, ColorWaves, Scene, Track
from augment.sky import ConstantSky, CubemapSky


def open_street_gaussians(path: str, query: dict[str, str]) -> Scene:
    """The scene of a trained model, or of a dataset's folder.

    path: a model's folder, a .pth or .ply in it, or a dataset's folder. query: see ModelOptions; of
    a dataset: see open_raw.

    Raises:
        AdapterError: a wrong option, or a file that is missing, damaged, of another version, or
            does not belong to the others; names file and key.
    """
    if is_dataset(Path(path)):
        return open_raw(Path(path), query)
    options = ModelOptions.from_query(SCHEME, query)
    files = find_model(Path(path), options)
    data = read_data(files.data, files.config)
    recorded = frames_of(data)
    chosen = options.frames.select([f.index for f in recorded], where=f"{SCHEME}:{path}")
    read_weights = read_checkpoint if files.weights.suffix.lower() == ".pth" else read_ply_model
    model = read_weights(files.weights, files.config)
    if model.pose_changes is not None:
        check_changes(model.pose_changes, data, str(model.file))
    changes = camera_changes(model.camera_changes, data, files.config, str(model.file))
    by_camera, by_image = color_maps(model.color_maps, data, files.config, str(model.file))
    recorded = [frame for frame in recorded if frame.index in chosen.numbers]
    frames = _with_model_cameras(recorded, data, changes, options.width)
    actors, problems = _actors(data, model, changes, files.config, options.rotation_bug == "1")
    sky = ConstantSky(torch.full((3,), float(files.config.white_background)))
    if model.sky is not None:
        sky = CubemapSky(model.sky)
    moments = {(c.name, c.timestamp_ns) for frame in frames for c in frame.cameras.values()}
    return Scene(
        name=files.folder.resolve().name,
        source=format_uri(SCHEME, path, query),
        background=model.background.gaussians,
        actors=actors,
        sky=sky,
        frames=frames,
        labels=labels_of(files.data),
        world_origin_m=data.world_origin_m,
        problems=(*data.problems, *chosen.problems, *model.problems, *problems),
        color_maps=by_camera,
        image_color_maps={k: v for k, v in by_image.items() if k in moments},
        recorded_source=format_uri(SCHEME, files.data, {}),
        made_by={
            "method": "Street Gaussians",
            "weights": str(files.weights),
            "iteration": files.iteration,
            "config": str(files.config_file),
        },
    )


def street_gaussians_labels(path: str, query: dict[str, str]) -> LabelSource | None:
    """The labels alone, of a dataset's folder or of a model's dataset.

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
    rotation_bug: bool,
) -> tuple[tuple[Actor, ...], Sequence[str]]:
    """Actors in the order in which their objects appear, and sentences."""
    actors, problems = [], []
    for tracked in data.objects:
        part = model.actors.get(tracked.track_id)
        if part is None:
            problems.append(
                f"the {tracked.label} obj_{tracked.track_id:03d} of the tracks has no Gaussians in "
                f"{model.file} and is left out"
            )
            continue
        actor, found = make_actor(
            data, tracked, part, model.pose_changes, changes, config, rotation_bug=rotation_bug
        )
        problems += found
        actors += [] if actor is None else [actor]
    known = {tracked.track_id for tracked in data.objects}
    problems += [
        f"{model.file}: obj_{number:03d} has no track among the moving objects of {data.root} and "
        f"is left out"
        for number in model.actors
        if number not in known
    ]
    return tuple(actors), problems


def _with_model_cameras(
    frames: Sequence[Frame], data: StreetData, changes: np.ndarray, width: int
) -> tuple[Frame, ...]:
    """Frames with the cameras that the model renders in place of those that recorded."""
    rows = {(image.frame, image.name): row for row, image in enumerate(data.images)}
    shown = []
    for frame in frames:
        cameras = {}
        for name, camera in frame.cameras.items():
            change = torch.from_numpy(changes[rows[frame.index, name]])
            cameras[name] = dataclasses.replace(
                _capped(camera, width), camera_from_world=camera.camera_from_world @ change
            )
        shown.append(dataclasses.replace(frame, cameras=cameras))
    return tuple(shown)


def _capped(camera: Camera, width: int) -> Camera:
    """The camera at most so wide, as the project renders it: the scale is one for both axes, and
    what is left of a row below the last whole one is cut off."""
    if width == 0 or camera.width <= width:
        return camera
    scale = camera.width / width
    return dataclasses.replace(
        camera,
        width=width,
        height=max(1, int(camera.height / scale)),
        fx=camera.fx / scale,
        fy=camera.fy / scale,
        cx=camera.cx / scale,
        cy=camera.cy / scale,
    )


# ---- A model's actors: Gaussians, tracks at the moments of the images, colours over time ---------

_MAX_HOLD_NS = 100_000_000
_SAME_MOMENT_M = 0.01


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
    """The actor of an object's Gaussians, None where no image shows it, and sentences."""
    name = f"obj_{tracked.track_id:03d}"
    times = np.array([image.timestamp_s for image in data.images])
    shown = np.flatnonzero((times >= tracked.start_s) & (times <= tracked.end_s))
    if len(shown) == 0:
        return None, (f"{name} is in none of the images' moments and is left out",)
    poses = image_poses(
        data,
        tracked,
        shown,
        pose_changes,
        interpolate_held_out=config.opt_track,
        rotation_bug=rotation_bug,
    )
    images = [data.images[i] for i in shown]
    ego_from_actor = np.tile(np.eye(4), (len(shown), 1, 1))
    ego_from_actor[:, :3, :3] = rotmat_from_quat(torch.from_numpy(poses.quats)).numpy()
    ego_from_actor[:, :3, 3] = poses.positions
    world_from_ego = np.stack([image.world_from_ego for image in images])
    world_from_actor = np.linalg.inv(camera_changes[shown]) @ world_from_ego @ ego_from_actor
    stamps = np.array([image.timestamp_ns for image in images])
    knots, first, which = np.unique(stamps, return_index=True, return_inverse=True)
    offsets = world_from_actor[:, :3, 3] - world_from_actor[first[which], :3, 3]
    spread_m = np.linalg.norm(offsets, axis=1).max()
    problems = []
    if spread_m > _SAME_MOMENT_M:
        problems.append(
            f"{name} is at places up to {spread_m:.2f} m apart in images of one moment; the first "
            f"camera's is taken"
        )
    if part.terms is not None and tracked.start_frame == tracked.end_frame:
        problems.append(f"{name} is tracked in one frame only; its colours do not change over time")
    stamps = np.array([image.timestamp_ns for image in data.images])
    before, after = knots[0] - stamps[stamps < knots[0]], stamps[stamps > knots[-1]] - knots[-1]
    hold_ns = int(min([_MAX_HOLD_NS, *(before - 1), *(after - 1)]))  # into no other image
    waves = None
    if part.terms is not None:  # all images of a frame have the phase of its number
        span = tracked.end_frame - tracked.start_frame
        steps = np.array([images[i].frame for i in first], np.float64) - tracked.start_frame
        phases = config.fourier_scale * steps / span if span else np.zeros(len(first))
        waves = ColorWaves(part.terms, torch.from_numpy(knots), torch.from_numpy(phases))
    actor = Actor(
        track_id=str(tracked.track_id),
        label=tracked.label,
        gaussians=with_class_of(tracked.label, part.gaussians),
        track=Track(
            torch.from_numpy(knots), torch.from_numpy(world_from_actor[first]), hold_ns=hold_ns
        ),
        size_m=tracked.size_m,
        color_waves=waves,
        colors_in_world=True,
    )
    return actor, tuple(problems)


# ---- Poses of actors: tracklets, moved by training, interpolated in the vehicle frame ------------

_STRAIGHT_RAD = 1e-6  # sin of a smaller angle loses its digits; the straight line is exact there


class Poses(NamedTuple):
    """T poses. positions: float64 [T, 3], metres. quats: float64 [T, 4] unit wxyz."""

    positions: np.ndarray
    quats: np.ndarray


def check_changes(changes: PoseChanges, data: StreetData, where: str) -> None:
    """Whether poses of a model belong to the dataset's tracklets."""
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
    trained = (i.timestamp_s for i in data.images if i.cam == cam and not i.is_held_out)
    times = np.array([t for t in trained if tracked.start_s <= t <= tracked.end_s])
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
    [0, 1]."""
    dots = (first * second).sum(1)
    second = np.where(dots[:, None] < 0, -second, second)
    angles = np.arccos(np.clip(np.abs(dots), 0, 1))
    is_straight = angles < _STRAIGHT_RAD
    sines = np.where(is_straight, 1.0, np.sin(angles))
    a = np.where(is_straight, 1 - share, np.sin((1 - share) * angles) / sines)
    b = np.where(is_straight, share, np.sin(share * angles) / sines)
    between = a[:, None] * first + b[:, None] * second
    return between / np.linalg.norm(between, axis=1, keepdims=True)


# ---- What a model learnt for single images or cameras: colour maps and moved cameras -------------


def camera_changes(
    changes: np.ndarray | None, data: StreetData, config: ModelConfig, where: str
) -> np.ndarray:
    """What the background is moved by before each of data.images is taken, rigid, float64
    [I, 4, 4]; without a pose correction it stays where it is."""
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
    """The colour correction, applied after the sky, as Scene.color_maps and Scene.image_color_maps:
    of cameras, or of images, whose cameras then have the mean of those that were trained on for
    other views."""
    if maps is None:
        return {}, {}
    mode, where = config.color_correction_mode, f"{where}, color_correction"
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
        own = [image for image in data.images if image.name == name]
        trained = [image.number for image in own if not image.is_held_out]
        by_camera[name] = maps[trained or [image.number for image in own]].mean(0)
    return by_camera, {(i.name, i.timestamp_ns): maps[i.number].clone() for i in data.images}


def _check_count(found: int, expected: int, where: str, mode: str, data: StreetData) -> None:
    if found != expected:
        raise AdapterError(
            f"{where} has {found} entries; with mode {mode!r} and the dataset {data.root} it must "
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

FILE = "pointcloud.npz"
_POINTS, _PROJECTIONS = "pointcloud.npy", "camera_projection.npy"
_KEPT_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class PointCloud:
    """points: float64 [N, 3], vehicle frame. projections: int16 [N, 6], if the file has any."""

    points: np.ndarray
    projections: np.ndarray | None


class _Reader:
    """One file being read forward, and the frames that were last passed by."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._recent = SceneMemo(_KEPT_BYTES)
        self._all: set[int] | None = None  # frames of the file, known after a whole pass
        self._passed: set[int] = set()
        self._clouds = _clouds(path)

    def read(self, frame: int) -> PointCloud | None:
        return self._recent.get(frame, lambda: self._read_on(frame))

    def _read_on(self, frame: int) -> PointCloud | None:
        if self._all is not None and frame not in self._all:
            return None
        if frame in self._passed:
            self.rewind()
        try:
            for number, cloud in self._clouds:
                self._passed.add(number)
                self._recent.put(number, cloud)
                if number == frame:
                    return cloud
        except BaseException:
            self.rewind()
            raise
        self._all = self._passed
        self.rewind()
        return None

    def rewind(self) -> None:
        """Leave the file; the next reading starts at its beginning."""
        self._clouds.close()
        self._clouds, self._passed = _clouds(self._path), set()


_lock = threading.Lock()


@lru_cache(maxsize=1)
def _reader(path: Path, *_state: int) -> _Reader:
    """Of the file last read from, as long as it stays as it is."""
    return _Reader(path)


def read_point_cloud(root: Path, frame: int) -> PointCloud | None:
    """The returns of a frame; None where there is no file, or no such frame in it."""
    path = root / FILE
    if not path.exists():
        return None
    stat = path.stat()
    # A forked process shares its parent's place in an open file: it opens the file itself.
    with _lock:
        return _reader(path, stat.st_mtime_ns, stat.st_size, os.getpid()).read(frame)


def iterate_point_clouds(root: Path) -> Iterator[tuple[int, PointCloud]]:
    """Frame number and returns of every frame, in the file's order; nothing without the file."""
    if (root / FILE).exists():
        yield from _clouds(root / FILE)


def _clouds(path: Path) -> Generator[tuple[int, PointCloud]]:
    """Every frame of the file."""
    try:
        with zipfile.ZipFile(path) as archive, contextlib.ExitStack() as members:
            names = archive.namelist()
            if _POINTS not in names:
                raise AdapterError(
                    f"{path} must hold the arrays pointcloud and camera_projection; it holds "
                    f"{names[:5]}"
                )
            points, projections = (
                _entries(path, name, members.enter_context(archive.open(name)))
                if name in names
                else None
                for name in (_POINTS, _PROJECTIONS)
            )
            for frame, xyz in points or ():
                seen = None if projections is None else next(projections, (None, None))
                yield frame, _checked_cloud(path, frame, xyz, seen)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise AdapterError(
            f"{path} is no whole .npz file of dictionaries ({error}); copy it again"
        ) from error
    except OSError as error:
        raise AdapterError(f"{path} cannot be read: {error}") from error


def _entries(path: Path, member: str, file: BinaryIO) -> Iterator[tuple[int, np.ndarray]]:
    try:
        check_holds_object(file)
        yield from stream_arrays(file)
    except PickleError as error:
        raise AdapterError(
            f"{path}, {member} was not read: {error}. Only a dictionary of arrays of numbers by "
            f"frame is accepted"
        ) from None


def _checked_cloud(
    path: Path, frame: int, xyz: np.ndarray, seen: tuple[int | None, Any] | None
) -> PointCloud:
    """seen: frame number and array of the projections, if the file has any."""
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind != "f":
        raise AdapterError(
            f"{path}: pointcloud[{frame}] must be floats [N, 3]; got {xyz.dtype} {list(xyz.shape)}"
        )
    if seen is None:
        return PointCloud(xyz.astype(np.float64), None)
    number, projections = seen
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

# Of Waymo's cars, from the ego origin: forward, left, up.
ROOF_SENSOR_M = np.array([1.43, 0.0, 2.18])


@dataclass(frozen=True)
class StreetGaussiansLabels:
    """Labels of one dataset directory, read when asked.

    Boxes: all rows of the frame in track/track_info.txt, of whatever class, carried into the world
    by the car's pose at the frame's time; attributes alpha and, where the file has it, speed
    (metres per second). Sweeps: columns x y z (metres), timestamp_ns (the frame's: the points are
    where they were at that moment), and, where the file has projections, camera, u, v: the number
    of the first camera that sees the point, -1 for none, and the pixel there.
    A frame without the car's pose has no boxes and no sweep.
    """

    root: Path

    def boxes(self, frame_index: int) -> Boxes:
        path, _ = track_files(self.root, use_tracker=False)
        pose = self._world_from_ego(frame_index)
        if pose is None or not path.exists():
            return Boxes.empty()
        stat = path.stat()
        table = _table(path, stat.st_mtime_ns, stat.st_size)
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
        pose = self._world_from_ego(frame_index)
        cloud = None if pose is None else read_point_cloud(self.root, frame_index)
        if cloud is None:
            return None
        times = read_times(self.root)["FRAME"]
        if frame_index not in times:
            raise AdapterError(f"{self.root / TIMES}: FRAME lacks frame {frame_index:06d}")
        world = cloud.points @ pose[:3, :3].T + pose[:3, 3]
        columns: dict[str, np.ndarray] = {axis: world[:, i].copy() for i, axis in enumerate("xyz")}
        columns["timestamp_ns"] = np.full(len(world), round(times[frame_index] * 1e9), np.int64)
        if cloud.projections is not None:
            for i, name in enumerate(("camera", "u", "v")):
                columns[name] = cloud.projections[:, i].copy()
        return LidarSweep(columns)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Waymo's roof sensor in the car's pose of the frame. The files join the returns of five
        sensors and do not tell them apart: those of the four at the bumpers and sides, which see
        20 m far, are taken for the roof's, too."""
        pose = self._world_from_ego(frame_index)
        if pose is None:
            return None
        return np.broadcast_to(pose[:3, :3] @ ROOF_SENSOR_M + pose[:3, 3], (len(sweep), 3))

    def _world_from_ego(self, frame: int) -> np.ndarray | None:
        path = self.root / "ego_pose" / f"{frame:06d}.txt"
        return read_pose(path) if path.exists() else None


def labels_of(root: Path) -> StreetGaussiansLabels | None:
    """The labels of a dataset directory; None where there is none."""
    return StreetGaussiansLabels(root) if (root / "ego_pose").is_dir() else None


def ego_from_boxes(table: TrackTable, rows: np.ndarray) -> np.ndarray:
    """Poses of the rows' boxes in the vehicle's frame, float64 [R, 4, 4]."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    cos, sin = np.cos(table.headings[rows]), np.sin(table.headings[rows])
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cos, -sin, sin, cos
    poses[:, :3, 3] = table.centers_m[rows]
    return poses


@lru_cache(maxsize=2)
def _table(path: Path, mtime_ns: int, size: int) -> TrackTable:
    """A track file; mtime_ns and size tell whether it is still the one that was read."""
    return read_track_table(path)


# ---- A drive without a trained model: Gaussians from coloured LiDAR ------------------------------
# The world is the one that a model trained on it has. Returns are where they were at their frame's
# time, as the converter has it, and so are the boxes.

# Waymo's uppermost LiDAR looks up by 2.4 degrees; those at the sides see further up, but not far.
_LIDAR_TOP_DEG = 2.4
# The recording car in its own frame, whose origin is below its rear axle, on the ground.
_EGO_M = np.array([[-1.4, -1.15, 0.1], [4.2, 1.15, 2.4]])
_STANDING = ("sign",)  # classes that never move


def open_raw(root: Path, query: dict[str, str]) -> Scene:
    """The scene of a dataset directory alone.

    query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out; see DriveOptions.
    Opening is deterministic: the same files and options give the same bits.
    """
    options = DriveOptions.from_query(SCHEME, query)
    cams = calibrated_cameras(root)
    if not cams:
        raise AdapterError(
            f"{root / 'extrinsics'} holds no calibration 0.txt to 4.txt; copy it from the dataset"
        )
    data = read_data(root, ModelConfig(cameras=cams))
    frames = frames_of(data)
    chosen = options.select([f.index for f in frames], where=f"{SCHEME}:{root}")
    frames = tuple(frame for frame in frames if frame.index in set(chosen.numbers))
    sweeps, sweep_problems = _sweeps(root, [f for f in frames if f.index not in chosen.held_out])
    table = read_track_table(track_files(root, use_tracker=False)[0])
    drive = RawDrive(
        name=root.absolute().name,
        source=format_uri(SCHEME, root, query),
        frames=frames,
        held_out=chosen.held_out,
        sweeps=sweeps,
        boxes=_moving_samples(table, frames),
        labels=StreetGaussiansLabels(root),
        world_origin_m=data.world_origin_m,
        lidar_top_deg=_LIDAR_TOP_DEG,
        problems=(*data.problems, *chosen.problems, *sweep_problems),
    )
    scene = scene_of_drive(drive, options)
    missing = without_points(join_tracks(drive.boxes), scene)
    faults = scene.problems[len(drive.problems) :]
    return dataclasses.replace(scene, problems=drive.problems + missing + faults)


def _sweeps(root: Path, used: Sequence[Frame]) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """The usable returns of the frames in the scene's world, without the recording car's own, and a
    sentence where frames have none."""
    by_number = {frame.index: frame for frame in used}
    sweeps = {}
    for number, cloud in iterate_point_clouds(root):
        frame = by_number.get(number)
        if frame is None:
            continue
        own = is_in_box(cloud.points, *_EGO_M)
        points = cloud.points[~own & np.isfinite(cloud.points).all(axis=1)]
        pose = frame.world_from_ego.numpy()
        world = points @ pose[:3, :3].T + pose[:3, 3]
        sweeps[number] = Sweep.of_unknown_class(world, frame.timestamp_ns)
    problems = ()
    if missing := sorted(set(by_number) - set(sweeps)):
        problems = (
            f"{root / FILE} lacks {len(missing)} frames, such as {missing[0]}: their points too",
        )
    return tuple(sweeps[number] for number in sorted(sweeps)), problems


def _moving_samples(table: TrackTable, frames: Sequence[Frame]) -> tuple[BoxSample, ...]:
    """The boxes of the objects that move within the frames, by frame."""
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
            if table.labels[row] not in _STANDING
        ]
    moving = objects_that_travel((s.object_id, s.world_from_box[:3, 3]) for s in samples)
    return tuple(sample for sample in samples if sample.object_id in moving)
