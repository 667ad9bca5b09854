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
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from adapters.lidar_scene.scene import (
    DriveOptions,
    build_lidar_scene,
    path_of,
    scene_of,
    views_of,
    without_points,
)
from adapters.lidar_scene.split import BoxSample, Sweep, join_tracks
from adapters.street_gaussians.data import (
    TrackTable,
    calibrated_cameras,
    frames_of,
    read_data,
    read_track_table,
    track_files,
)
from adapters.street_gaussians.labels import (
    FILE,
    StreetGaussiansLabels,
    ego_from_boxes,
    iterate_point_clouds,
    labels_of,
)
from adapters.street_gaussians.model import (
    SCHEME,
    ModelFiles,
    ModelOptions,
    Part,
    TrainedModel,
    find_data,
    find_model,
    is_dataset,
    read_checkpoint,
    read_point_cloud,
)
from adapters.street_gaussians.records import (
    CameraChanges,
    ModelConfig,
    PoseChanges,
    Poses,
    StreetData,
    TrackedObject,
    camera_changes,
    check_changes,
    color_maps,
    image_poses,
    moved_camera,
    rotations_of,
)
from adapters.uri import format_uri
from adapters.world import with_class_of
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.labels import LabelSource
from augment.scene import Actor, ColorWaves, Scene, Track
from augment.semantics import SemanticClass
from augment.sky import ConstantSky, CubemapSky, Sky

# ---- A model's actors: Gaussians, tracks at the moments of the images, colours over time ---------

_MAX_HOLD_NS = 100_000_000
_SAME_MOMENT_M = 0.01


@dataclass(frozen=True)
class ActorSettings:
    """fourier_scale, opt_track: as in ModelConfig. rotation_bug: as in vehicle_poses."""

    fourier_scale: float
    opt_track: bool
    rotation_bug: bool

    @staticmethod
    def of(config: ModelConfig, *, rotation_bug: bool) -> ActorSettings:
        return ActorSettings(config.fourier_scale, config.opt_track, rotation_bug)


def make_actor(
    data: StreetData,
    tracked: TrackedObject,
    part: Part,
    pose_changes: PoseChanges | None,
    camera_changes: CameraChanges,
    settings: ActorSettings,
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
        interpolate_held_out=settings.opt_track,
        rotation_bug=settings.rotation_bug,
    )
    world_from_actor = _in_world(data, shown, poses, camera_changes)
    stamps = np.array([data.images[i].timestamp_ns for i in shown])
    knots, first, which = np.unique(stamps, return_index=True, return_inverse=True)
    apart = np.linalg.norm(
        world_from_actor[:, :3, 3] - world_from_actor[first[which], :3, 3], axis=1
    ).max()
    problems = []
    if apart > _SAME_MOMENT_M:
        problems.append(
            f"{name} is at places up to {apart:.2f} m apart in images of one moment; the first "
            f"camera's is taken"
        )
    if part.terms is not None and tracked.start_frame == tracked.end_frame:
        problems.append(f"{name} is tracked in one frame only; its colours do not change over time")
    actor = Actor(
        track_id=str(tracked.track_id),
        label=tracked.label,
        gaussians=with_class_of(tracked.label, part.gaussians),
        track=Track(
            torch.from_numpy(knots),
            torch.from_numpy(world_from_actor[first]),
            hold_ns=_hold_ns(knots, data),
        ),
        size_m=tracked.size_m,
        color_waves=_waves(data, tracked, part, shown[first], knots, settings.fourier_scale),
        colors_in_world=True,
    )
    return actor, tuple(problems)


def _in_world(
    data: StreetData, images: np.ndarray, poses: Poses, camera_changes: CameraChanges
) -> np.ndarray:
    """world_from_actor at the moments of images, float64 [T, 4, 4]."""
    ego_from_actor = np.tile(np.eye(4), (len(images), 1, 1))
    ego_from_actor[:, :3, :3] = rotations_of(poses.quats)
    ego_from_actor[:, :3, 3] = poses.positions
    world_from_ego = np.stack([data.images[i].world_from_ego for i in images])
    world_from_moved = camera_changes.inverses[[camera_changes.row(data.images[i]) for i in images]]
    return world_from_moved @ world_from_ego @ ego_from_actor


def _hold_ns(knots: np.ndarray, data: StreetData) -> int:
    """How long the actor stays before and after its knots without getting into other images."""
    stamps = np.array([image.timestamp_ns for image in data.images])
    away = np.concatenate(
        [knots[0] - stamps[stamps < knots[0]], stamps[stamps > knots[-1]] - knots[-1]]
    )
    return int(min([_MAX_HOLD_NS, *(away - 1)]))


def _waves(
    data: StreetData,
    tracked: TrackedObject,
    part: Part,
    images: np.ndarray,
    knots: np.ndarray,
    fourier_scale: float,
) -> ColorWaves | None:
    """Colours over time; all images of a frame have the phase of its number."""
    if part.terms is None:
        return None
    span = tracked.end_frame - tracked.start_frame
    frames = np.array([data.images[i].frame for i in images], np.float64)
    phases = (
        fourier_scale * (frames - tracked.start_frame) / span if span else np.zeros(len(images))
    )
    return ColorWaves(part.terms, torch.from_numpy(knots), torch.from_numpy(phases))


# ------------------------------------------------------------------------------------------------
# A drive in Street Gaussians' layout without a trained model: Gaussians from coloured LiDAR
# The world is the one that a model trained on it has. Returns are where they were at their frame's
# time, as the converter has it, and so are the boxes.

# Waymo's uppermost LiDAR looks up by 2.4 degrees; those at the sides see further up, but not far.
_LIDAR_TOP_DEG = 2.4
# The recording car in its own frame, whose origin is below its rear axle, on the ground.
_EGO_LOW_M = np.array([-1.4, -1.15, 0.1])
_EGO_HIGH_M = np.array([4.2, 1.15, 2.4])
_MOVED_M = 1.0  # an object whose boxes lie further apart than this moves
_STANDING = ("sign",)  # classes that never move


def open_raw(root: Path, query: dict[str, str]) -> Scene:
    """The scene of a dataset directory alone.

    query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out; see DriveOptions.
    Opening is deterministic: the same files and options give the same bits.

    Raises:
        AdapterError: a wrong option; calibration, poses, times or tracks that are missing or
            damaged; no LiDAR or no image of the frames that are not held out.
    """
    options = DriveOptions.from_query("street_gaussians", query)
    cams = calibrated_cameras(root)
    if not cams:
        raise AdapterError(
            f"{root / 'extrinsics'} holds no calibration 0.txt to 4.txt; copy it from the dataset"
        )
    data = read_data(root, ModelConfig(cameras=cams))
    frames = frames_of(data)
    chosen = options.select([f.index for f in frames], where=f"street_gaussians:{root}")
    frames = tuple(frame for frame in frames if frame.index in set(chosen.numbers))
    used = [frame for frame in frames if frame.index not in chosen.held_out]
    if not any(frame.image_paths for frame in used):
        raise AdapterError(
            f"{root / 'images'} holds no usable image of the frames that are not held out "
            f"({used[0].index} to {used[-1].index}); colours cannot be had without them"
        )
    sweeps, problems = _sweeps(root, used)
    table = read_track_table(track_files(root, use_tracker=False)[0])
    tracks = join_tracks(_moving_samples(table, frames))
    built = build_lidar_scene(
        sweeps,
        tracks,
        views_of(used),
        path_of(frames),
        options.scene_options(lidar_top_deg=_LIDAR_TOP_DEG),
    )
    return scene_of(
        built,
        name=root.absolute().name,
        source=format_uri("street_gaussians", root, query),
        frames=frames,
        labels=StreetGaussiansLabels(root),
        world_origin_m=data.world_origin_m,
        problems=data.problems + chosen.problems + problems + without_points(tracks, built),
    )


def _sweeps(root: Path, used: Sequence[Frame]) -> tuple[list[Sweep], tuple[str, ...]]:
    """The usable returns of the frames in the scene's world, without the recording car's own, and a
    sentence where frames have none."""
    by_number = {frame.index: frame for frame in used}
    sweeps = {}
    for number, cloud in iterate_point_clouds(root):
        frame = by_number.get(number)
        if frame is None:
            continue
        own = ((cloud.points > _EGO_LOW_M) & (cloud.points < _EGO_HIGH_M)).all(axis=1)
        points = cloud.points[~own & np.isfinite(cloud.points).all(axis=1)]
        pose = frame.world_from_ego.numpy()
        sweeps[number] = Sweep(
            (points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32),
            np.full(len(points), frame.timestamp_ns, np.int64),
            np.full(len(points), SemanticClass.UNKNOWN, np.int16),
        )
    if not any(len(sweep) for sweep in sweeps.values()):
        raise AdapterError(
            f"{root / FILE} holds no returns of frames {used[0].index} to {used[-1].index}, or is "
            f"missing; a scene cannot be built without them. Make it with the converter's LiDAR "
            f"step, or give a trained model's folder"
        )
    missing = sorted(set(by_number) - set(sweeps))
    found = [sweeps[number] for number in sorted(sweeps)]
    if not missing:
        return found, ()
    said = f"{root / FILE} lacks {len(missing)} frames, such as {missing[0]}: their points too"
    return found, (said,)


def _moving_samples(table: TrackTable, frames: Sequence[Frame]) -> list[BoxSample]:
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
    moving = _moving_ids(samples)
    return [sample for sample in samples if sample.object_id in moving]


def _moving_ids(samples: Sequence[BoxSample]) -> Collection[str]:
    places: dict[str, list[np.ndarray]] = {}
    for sample in samples:
        places.setdefault(sample.object_id, []).append(sample.world_from_box[:2, 3])
    extents = {name: np.ptp(np.array(xy), axis=0) for name, xy in places.items()}
    return {name for name, extent in extents.items() if np.hypot(*extent) > _MOVED_M}


# ---- adapter -------------------------------------------------------------------------------------


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
    model = _read_model(files)
    if model.pose_changes is not None:
        check_changes(model.pose_changes, data, str(model.file))
    changes = camera_changes(model.camera_changes, data, files.config, str(model.file))
    maps = color_maps(model.color_maps, data, files.config, str(model.file))
    recorded = [frame for frame in recorded if frame.index in chosen.numbers]
    frames = _with_model_cameras(recorded, data, changes, options.width)
    settings = ActorSettings.of(files.config, rotation_bug=options.rotation_bug)
    actors, problems = _actors(data, model, changes, settings)
    moments = {(c.name, c.timestamp_ns) for frame in frames for c in frame.cameras.values()}
    return Scene(
        name=files.folder.resolve().name,
        source=format_uri(SCHEME, path, query),
        background=model.background.gaussians,
        actors=actors,
        sky=_sky(model, white=files.config.white_background),
        frames=frames,
        labels=labels_of(files.data),
        world_origin_m=data.world_origin_m,
        problems=(*data.problems, *chosen.problems, *model.problems, *problems),
        color_maps=maps.by_camera,
        image_color_maps={k: v for k, v in maps.by_image.items() if k in moments},
        recorded_source=format_uri(SCHEME, files.data, {}),
        made_by=_facts(files),
    )


def street_gaussians_labels(path: str, query: dict[str, str]) -> LabelSource | None:
    """The labels alone, of a dataset's folder or of a model's dataset.

    Raises:
        AdapterError: as open_street_gaussians.
    """
    if is_dataset(Path(path)):
        return labels_of(Path(path))
    return labels_of(find_data(Path(path), ModelOptions.from_query(query)))


def _read_model(files: ModelFiles) -> TrainedModel:
    read = read_checkpoint if files.weights.suffix.lower() == ".pth" else read_point_cloud
    return read(files.weights, files.config)


def _actors(
    data: StreetData, model: TrainedModel, changes: CameraChanges, settings: ActorSettings
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
        actor, found = make_actor(data, tracked, part, model.pose_changes, changes, settings)
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


def _sky(model: TrainedModel, *, white: bool) -> Sky:
    if model.sky is not None:
        return CubemapSky(model.sky)
    return ConstantSky(torch.full((3,), float(white)))


def _with_model_cameras(
    frames: Sequence[Frame], data: StreetData, changes: CameraChanges, width: int
) -> tuple[Frame, ...]:
    """Frames with the cameras that the model renders in place of those that recorded."""
    images = {(image.frame, image.name): image for image in data.images}
    return tuple(
        dataclasses.replace(
            frame,
            cameras={
                name: dataclasses.replace(
                    _capped(camera, width),
                    camera_from_world=moved_camera(
                        camera.camera_from_world, changes.of(images[frame.index, name])
                    ),
                )
                for name, camera in frame.cameras.items()
            },
        )
        for frame in frames
    )


def _capped(camera: Camera, width: int) -> Camera:
    """The camera at most so wide, as the project renders it: the scale is one for both axes, and
    what is left of a row below the last whole one is cut off.
    """
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


def _facts(files: ModelFiles) -> dict[str, object]:
    return {
        "method": "Street Gaussians",
        "weights": str(files.weights),
        "iteration": files.iteration,
        "config": str(files.config_file),
    }
