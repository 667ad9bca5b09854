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

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from adapters.street_gaussians.data import (
    CAMERA_NAMES,
    ModelConfig,
    StreetData,
    StreetImage,
    TrackedObject,
    frames_of,
    read_data,
)
from adapters.street_gaussians.labels import labels_of, open_raw
from adapters.street_gaussians.model import (
    SCHEME,
    ModelOptions,
    Part,
    PoseChanges,
    TrainedModel,
    find_model,
    is_dataset,
    read_checkpoint,
    read_point_cloud,
    rotations_of,
)
from adapters.uri import format_uri
from adapters.world import with_class_of
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.labels import LabelSource
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
    options = ModelOptions.from_query(query)
    files = find_model(Path(path), options)
    data = read_data(files.data, files.config)
    recorded = frames_of(data)
    chosen = options.frames.select([f.index for f in recorded], where=f"{SCHEME}:{path}")
    read_weights = read_checkpoint if files.weights.suffix.lower() == ".pth" else read_point_cloud
    model = read_weights(files.weights, files.config)
    if model.pose_changes is not None:
        check_changes(model.pose_changes, data, str(model.file))
    changes = camera_changes(model.camera_changes, data, files.config, str(model.file))
    maps = color_maps(model.color_maps, data, files.config, str(model.file))
    recorded = [frame for frame in recorded if frame.index in chosen.numbers]
    frames = _with_model_cameras(recorded, data, changes, options.width)
    actors, problems = _actors(data, model, changes, files.config, options.rotation_bug)
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
        color_maps=maps.by_camera,
        image_color_maps={k: v for k, v in maps.by_image.items() if k in moments},
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
    return labels_of(find_model(Path(path), ModelOptions.from_query(query)).data)


def _actors(
    data: StreetData,
    model: TrainedModel,
    changes: CameraChanges,
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
        if actor is not None:
            actors.append(actor)
    known = {tracked.track_id for tracked in data.objects}
    problems += [
        f"{model.file}: obj_{number:03d} has no track among the moving objects of {data.root} and "
        f"is left out"
        for number in model.actors
        if number not in known
    ]
    return tuple(actors), problems


def _with_model_cameras(
    frames: Sequence[Frame], data: StreetData, changes: CameraChanges, width: int
) -> tuple[Frame, ...]:
    """Frames with the cameras that the model renders in place of those that recorded."""
    images = {(image.frame, image.name): image for image in data.images}
    shown = []
    for frame in frames:
        cameras = {}
        for name, camera in frame.cameras.items():
            change = np.ascontiguousarray(changes.of(images[frame.index, name]))
            camera_from_world = camera.camera_from_world @ torch.from_numpy(change)
            cameras[name] = dataclasses.replace(
                _capped(camera, width), camera_from_world=camera_from_world
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
    camera_changes: CameraChanges,
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
    ego_from_actor = np.tile(np.eye(4), (len(shown), 1, 1))
    ego_from_actor[:, :3, :3] = rotations_of(poses.quats)
    ego_from_actor[:, :3, 3] = poses.positions
    world_from_ego = np.stack([data.images[i].world_from_ego for i in shown])
    world_from_moved = camera_changes.inverses[[camera_changes.row(data.images[i]) for i in shown]]
    world_from_actor = world_from_moved @ world_from_ego @ ego_from_actor
    stamps = np.array([data.images[i].timestamp_ns for i in shown])
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
        numbers = np.array([data.images[i].frame for i in shown[first]], np.float64)
        phases = np.zeros(len(first))
        if span:
            phases = config.fourier_scale * (numbers - tracked.start_frame) / span
        waves = ColorWaves(part.terms, torch.from_numpy(knots), torch.from_numpy(phases))
    poses_of_track = torch.from_numpy(world_from_actor[first])
    actor = Actor(
        track_id=str(tracked.track_id),
        label=tracked.label,
        gaussians=with_class_of(tracked.label, part.gaussians),
        track=Track(torch.from_numpy(knots), poses_of_track, hold_ns=hold_ns),
        size_m=tracked.size_m,
        color_waves=waves,
        colors_in_world=True,
    )
    return actor, tuple(problems)


# ---- Poses of actors: tracklets, moved by training, interpolated in the vehicle frame ------------

_STRAIGHT_RAD = 1e-6  # sin of a smaller angle loses its digits; the straight line is exact there


@dataclass(frozen=True, eq=False)
class Poses:
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
    """The pose correction of every image; without any, cameras stay where they are."""
    if changes is None:
        return CameraChanges()
    frames = {frame: row for row, frame in enumerate(data.frames)}
    by_image = config.pose_correction_mode == "image"
    rows = {
        (image.frame, image.cam): image.number if by_image else frames[image.frame]
        for image in data.images
    }
    expected = len(data.frames) * len(config.cameras) if by_image else len(data.frames)
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
    have the mean of those that were trained on for other views."""
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
    _check_count(len(maps), len(data.frames) * len(config.cameras), where, mode, data)
    by_camera = {}
    for name in dict.fromkeys(image.name for image in data.images):
        own = [image for image in data.images if image.name == name]
        trained = [image.number for image in own if not image.is_held_out]
        chosen = trained or [image.number for image in own]
        by_camera[name] = maps[chosen].mean(0)
    by_image = {(i.name, i.timestamp_ns): maps[i.number].clone() for i in data.images}
    return ColorMaps(by_camera, by_image)


def _check_count(found: int, expected: int, where: str, mode: str, data: StreetData) -> None:
    if found != expected:
        raise AdapterError(
            f"{where} has {found} entries; with mode {mode!r} and the dataset {data.root} it must "
            f"have {expected}. The number follows from data.cameras and data.selected_frames of "
            f"the configuration: give the data and the configs/ that the model was trained with"
        )
