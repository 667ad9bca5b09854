"""A nuScenes scene: Gaussians from accumulated, image-coloured LiDAR.

World: nuScenes' global one, less whole metres where the drive is further than a kilometre from its
origin. Ego: nuScenes' (x forward, y left, z up, origin on the ground below the rear axle), as it
stood at the frame's LiDAR time. Images are undistorted as published. Cameras stand where the ego
pose of their own image puts them, and moving objects where the LiDAR met them (see tables.Turn).
Frame numbers count the LiDAR's files, or keyframes, from 0 in order of time; `frame_tokens` says
which rows of sample_data they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from adapters.lidar_scene.scene import build_lidar_scene, views_of
from adapters.lidar_scene.split import ObjectTrack, join_tracks
from adapters.nuscenes.labels import NuScenesLabels, read_sweeps
from adapters.nuscenes.tables import (
    FrameFiles,
    NuScenesOptions,
    SceneTables,
    SensorFile,
    read_tables,
    scene_frames,
)
from adapters.plain_files import ImageFault, inside
from adapters.raw_drive import BoxSample, drive_origin, objects_that_travel
from adapters.training_views.views import read_scaled
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.geometry import invert_rigid
from augment.scene import Scene

_MOVING = ("vehicle.moving", "pedestrian.moving", "cycle.with_rider")
_LIDAR_TOP_DEG = 10.67  # the sensor's uppermost channel
# The back camera looks over the recording car's own edge, which on a published image begins at row
# 854 of 900.
_ROWS_ABOVE_CAR = {"CAM_BACK": 0.945}
_CHECK_SCALE = 0.125
_MAX_FAULTS = 3  # sentences about one camera's images; more become one


def open_nuscenes(path: str, query: dict[str, str]) -> Scene:
    """One scene of a nuScenes dataset; path: the folder that holds v1.0-mini or such.

    query: version (a folder of tables), scene (name or token), both needed only where there are
    several; sweeps (1, the default: frames are keyframes and the LiDAR's sweeps between them; 0:
    keyframes only); and frames, voxel_m, max_gaussians, image_scale, sky_size, held_out, see
    DriveOptions. Opening is deterministic: the same files and options give the same bits.

    Raises:
        AdapterError: a wrong option, tables that are missing, damaged or contradict each other, no
            LiDAR, no image, or a camera all of whose images are damaged. Single images and sweeps
            that are missing or damaged are Scene.problems.
    """
    options = NuScenesOptions.from_query(query)
    tables = read_tables(Path(path), options.version, options.scene)
    files, unused = scene_frames(tables, sweeps=options.sweeps)
    where = f"nuscenes:{path}, scene {tables.name}"
    if not files:
        raise AdapterError(f"{where} has no keyframe of LIDAR_TOP; sweeps=1 takes its sweeps")
    chosen = options.drive.select(range(len(files)), where=where)
    used = [files[number] for number in chosen.numbers]
    origin = drive_origin(np.array([file.sweep.world_from_ego[:3, 3] for file in files]))
    sweeps, lidar_problems = read_sweeps(tables, used, origin, held_out=chosen.held_out)
    if sum(len(sweep) for sweep in sweeps) == 0:
        raise AdapterError(
            f"{where}: no LiDAR returns in {_span(used)}; a scene cannot be built without them, "
            f"unpack samples/LIDAR_TOP and sweeps/LIDAR_TOP" + _first(lidar_problems)
        )
    usable, image_problems = _usable_images(tables, used)
    frames = tuple(_frame(file, origin, usable) for file in used)
    views = views_of((f for f in frames if f.index not in chosen.held_out), _ROWS_ABOVE_CAR)
    if not views:
        but = " but those held out" if chosen.held_out else ""
        raise AdapterError(
            f"{where}: no usable image in {_span(used)}{but}, and colours come from images; choose "
            f"more frames, or unpack samples/CAM_* and sweeps/CAM_*" + _first(image_problems)
        )
    return build_lidar_scene(
        sweeps,
        read_tracks(tables, used, origin),
        views,
        options.drive,
        lidar_top_deg=_LIDAR_TOP_DEG,
        name=tables.name,
        source=format_uri("nuscenes", path, query),
        frames=frames,
        labels=NuScenesLabels(tables, files),
        world_origin_m=origin,
        problems=unused + chosen.problems + lidar_problems + image_problems,
    )


def read_tracks(
    tables: SceneTables, frames: Sequence[FrameFiles], world_origin_m: np.ndarray
) -> tuple[ObjectTrack, ...]:
    """The moving objects around the given frames, in the scene's world.

    An object moves if any of its boxes in the whole scene says so, or if it travels. Boxes are
    those of the keyframes among the frames' times and of the next on either side, each at the time
    that the LiDAR met it; between them the Track interpolates."""
    annotations = [box for sample in tables.samples for box in sample.annotations]
    moving = {b.instance for b in annotations if any(name in _MOVING for name in b.attributes)}
    moving |= objects_that_travel((box.instance, box.center_m) for box in annotations)
    first, last = frames[0].sweep.timestamp_ns, frames[-1].sweep.timestamp_ns
    times = [sample.timestamp_ns for sample in tables.samples]
    start = max((i for i, time in enumerate(times) if time <= first), default=0)
    stop = min((i for i, time in enumerate(times) if time >= last), default=len(times) - 1)
    sweeps = {file.sample_token: file for file in tables.lidar if file.is_key_frame}
    samples = []
    for number in range(start, stop + 1):
        sample = tables.samples[number]
        sweep = sweeps.get(sample.token)
        for box in sample.annotations:
            if box.instance not in moving:
                continue
            w, x, y, z = box.quat
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
            pose[:3, 3] = box.center_m - world_origin_m
            time_ns = sample.timestamp_ns
            if sweep is not None:  # when it met the box
                offset = box.center_m - sweep.world_from_sensor[:3, 3]
                direction = offset @ sweep.world_from_ego[:3, :3]
                time_ns -= int(tables.turn.before_ns(direction[None])[0])
            samples.append(
                BoxSample(box.instance, None, box.category, number, time_ns, pose, box.size_m)
            )
    return join_tracks(samples)


def _span(frames: Sequence[FrameFiles]) -> str:
    first, last = frames[0].index, frames[-1].index
    return f"frame {first}" if first == last else f"frames {first} to {last}"


def _first(problems: Sequence[str]) -> str:
    return "".join(f" ({problem})" for problem in problems[:1])


def _usable_images(
    tables: SceneTables, frames: Sequence[FrameFiles]
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The images that can be used, by token; what is wrong with others, one sentence each."""
    paths: dict[str, Path] = {}
    problems: list[str] = []
    for channel in tables.images:
        of_camera = [(f.index, f.images[channel]) for f in frames if channel in f.images]
        faults, damaged = [], 0
        for index, image in of_camera:
            path = inside(tables.root, image.filename, f"sample_data {image.token!r}")
            try:
                camera = _camera(image, np.zeros(3))
                read_scaled(path, camera, camera.scaled(_CHECK_SCALE))
            except ImageFault as fault:
                faults.append(f"camera {channel}, frame {index}: image {image.filename} {fault}")
                damaged += path.exists()
            else:
                paths[image.token] = path
        if damaged and len(faults) == len(of_camera):
            raise AdapterError(
                f"{tables.root / tables.version}, scene {tables.name}: none of the {len(faults)} "
                f"images of {channel} can be used; {faults[0]}; unpack them again"
            )
        if len(faults) > _MAX_FAULTS:
            faults = [f"{faults[0]}; so are {len(faults) - 1} more of {len(of_camera)}: left out"]
        problems += faults
    return paths, tuple(problems)


def _frame(file: FrameFiles, origin: np.ndarray, usable: dict[str, Path]) -> Frame:
    images = dict(sorted(file.images.items()))
    world_from_ego = file.sweep.world_from_ego.copy()
    world_from_ego[:3, 3] -= origin
    return Frame(
        index=file.index,
        timestamp_ns=file.sweep.timestamp_ns,
        world_from_ego=torch.from_numpy(world_from_ego),
        cameras={name: _camera(image, origin) for name, image in images.items()},
        image_paths={
            name: str(usable[image.token])
            for name, image in images.items()
            if image.token in usable
        },
    )


def _camera(image: SensorFile, origin: np.ndarray) -> Camera:
    assert image.intrinsic is not None
    world_from_camera = image.world_from_sensor
    world_from_camera[:3, 3] -= origin
    return Camera(
        image.channel,
        image.width,
        image.height,
        *image.intrinsic,
        camera_from_world=invert_rigid(torch.from_numpy(world_from_camera)),
        timestamp_ns=image.timestamp_ns,
    )
