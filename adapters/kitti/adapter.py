"""A raw KITTI drive, or a frame of its object benchmark, as a scene: Gaussians from accumulated,
image-coloured LiDAR.

World: of a raw drive that of its poses (GPS/IMU: Mercator metres, x east, y north; a file or
registered sweeps: that of the first frame), recentred where it is far; of a single frame without
poses, and of an object frame, the Velodyne's. Ego: the Velodyne, x forward, y left, z up, 1.73 m
above the road. Tracklets that move are actors. The Velodyne looks 2 degrees up at most, so what
rises above is in the sky.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from tqdm import tqdm

from adapters.kitti.calibration import RectifiedCamera
from adapters.kitti.images import CameraImages, find_images
from adapters.kitti.labels import ObjectLabels, RawLabels
from adapters.kitti.layout import some
from adapters.kitti.source import Source, find_source
from adapters.kitti.sweeps import LIDAR_TOP_DEG, read_returns, usable_sweep
from adapters.lidar.box_tracks import BoxSample, join_tracks
from adapters.lidar.drive_scene import path_of, scene_of, views_of
from adapters.lidar.scene import build_lidar_scene
from adapters.lidar.split import Sweep
from adapters.recording.tables import TimedBoxes
from adapters.recording.tracks import read_objects
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.geometry import invert_rigid
from augment.scene import Scene


def open_kitti(path: str, query: dict[str, str]) -> Scene:
    """The scene of a raw drive such as `2011_09_26/2011_09_26_drive_0001_sync`, or of one frame of
    an object folder.

    query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out (see DriveOptions);
    of a drive poses=icp or poses=FILE, of an object folder frame=NUMBER.
    Opening is deterministic: the same files and options give the same bits.

    Raises:
        AdapterError: a wrong option; missing or damaged calibration, poses, times or labels; no
            usable sweep or image. What single frames lack is in Scene.problems.
    """
    source, options = find_source(path, query)
    numbers, held_out = source.chosen.numbers, source.chosen.held_out
    images = {
        camera.name: find_images(
            source.root, camera.name, source.images[camera.name], numbers, camera.size
        )
        for camera in source.calibration.cameras
    }
    frames = tuple(_frame(source, images, number) for number in numbers)
    used = [frame for frame in frames if frame.index not in held_out]
    sweeps, sweep_problems = _read_sweeps(source, used)
    if not any(frame.image_paths for frame in used):
        raise AdapterError(
            f"{source.root}: none of the frames that are not held out has a usable image; colours "
            f"cannot be had without them"
        )
    samples, sample_problems = _moving_boxes(source, frames)
    built = build_lidar_scene(
        sweeps,
        join_tracks(samples),
        views_of(used),
        path_of(frames),
        options.drive.scene_options(lidar_top_deg=LIDAR_TOP_DEG),
    )
    if len(built.background) + len(built.actors) == 0:
        raise AdapterError(
            f"{source.root}: none of the sweeps' points is in any image; check that calibration, "
            f"sweeps and images are of one day"
        )
    return scene_of(
        built,
        name=source.name,
        source=format_uri("kitti", path, query),
        frames=frames,
        labels=source.labels,
        world_origin_m=source.world_origin_m,
        problems=(
            *source.problems,
            *(problem for found in images.values() for problem in found.problems),
            *sweep_problems,
            *sample_problems,
        ),
    )


def kitti_labels(path: str, query: dict[str, str]) -> RawLabels | ObjectLabels:
    """The labels alone, in the world that `open_kitti` with this query has before recentring.

    Raises:
        AdapterError: as for `open_kitti`, but for images.
    """
    return find_source(path, query)[0].labels


def _read_sweeps(
    source: Source, frames: Sequence[Frame]
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """The usable returns of the frames in the scene's world."""
    missing = [frame.index for frame in frames if frame.index not in source.sweeps.names]
    problems = [f"{some(missing)} without a sweep"] if missing else []
    sweeps = []
    for frame in tqdm(frames, desc="LiDAR", unit="frame", disable=None):
        name = source.sweeps.names.get(frame.index)
        if name is None:
            continue
        try:
            returns = read_returns(source.root, name)
        except AdapterError as error:
            problems.append(f"frame {frame.index}: {error}")
            continue
        bad = int((~np.isfinite(returns[:, :3]).all(axis=1)).sum())
        if bad:
            problems.append(f"frame {frame.index}: left out {bad} returns that are not finite")
        sweeps.append(usable_sweep(returns, frame.world_from_ego.numpy(), frame.timestamp_ns))
    if not sum(len(sweep) for sweep in sweeps):
        raise AdapterError(
            f"{source.root}: there are no returns in {some([f.index for f in frames])}; a scene "
            f"cannot be built without them" + "".join(f"; {problem}" for problem in problems[:3])
        )
    return tuple(sweeps), tuple(problems)


def _moving_boxes(
    source: Source, frames: Sequence[Frame]
) -> tuple[tuple[BoxSample, ...], tuple[str, ...]]:
    boxes = {frame.index: TimedBoxes(source.labels.boxes(frame.index), None) for frame in frames}
    objects = read_objects(frames, boxes, source.world_origin_m)
    return objects.moving, objects.problems


def _frame(source: Source, images: Mapping[str, CameraImages], number: int) -> Frame:
    pose = source.sweeps.world_from_velodyne[number].copy()
    pose[:3, 3] -= source.world_origin_m
    world_from_ego = torch.from_numpy(pose)
    time = source.sweeps.timestamps_ns[number]
    return Frame(
        index=number,
        timestamp_ns=time,
        world_from_ego=world_from_ego,
        cameras={
            camera.name: _camera(
                camera,
                images[camera.name].size,
                world_from_ego,
                source.image_times_ns[camera.name].get(number, time),
            )
            for camera in source.calibration.cameras
        },
        image_paths={
            name: str(found.paths[number])
            for name, found in images.items()
            if number in found.paths
        },
    )


def _camera(
    camera: RectifiedCamera, size: tuple[int, int], world_from_ego: torch.Tensor, time_ns: int
) -> Camera:
    return Camera(
        name=camera.name,
        width=size[0],
        height=size[1],
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        camera_from_world=torch.from_numpy(camera.camera_from_velodyne)
        @ invert_rigid(world_from_ego),
        timestamp_ns=time_ns,
    )
