"""A raw KITTI drive, or a frame of its object benchmark, as a scene: Gaussians from accumulated,
image-coloured LiDAR.

World: of a raw drive that of its poses (GPS/IMU: Mercator metres, x east, y north; a file or
registered sweeps: that of the first frame), recentred where it is far; of a single frame without
poses, and of an object frame, the Velodyne's. Ego: the Velodyne, x forward, y left, z up, 1.73 m
above the road. Tracklets that move are actors. The Velodyne looks 2 degrees up at most, so what
rises above is in the sky.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from adapters.kitti.layout import (
    LIDAR_TOP_DEG,
    RectifiedCamera,
    file_in,
    read_returns,
    some,
    usable_sweep,
)
from adapters.kitti.source import ObjectLabels, RawLabels, Source, find_source
from adapters.lidar_scene.scene import build_lidar_scene, path_of, scene_of, views_of
from adapters.lidar_scene.split import BoxSample, Sweep, join_tracks
from adapters.plain_files import read_image_size
from adapters.recording.labels import TimedBoxes, read_objects
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.geometry import invert_rigid
from augment.scene import Scene

# ---- The usable images of a camera ---------------------------------------------------------------

_READERS = 4  # threads that decode; decoding releases the interpreter


@dataclass(frozen=True, eq=False)
class CameraImages:
    """paths: of the frames that have a usable image. size: width and height of all of them."""

    paths: dict[int, Path]
    size: tuple[int, int]
    problems: tuple[str, ...]


def find_images(
    root: Path,
    camera: str,
    names: Mapping[int, str],
    numbers: Sequence[int],
    size: tuple[int, int] | None,
) -> CameraImages:
    """The images of the frames, all of them decoded once to be sure of them.

    names: the camera's files by frame. size: what the calibration says; None: that of most images.

    Raises:
        AdapterError: no image is usable, or none is of the calibration's size.
    """
    wanted = [number for number in numbers if number in names]
    missing = [number for number in numbers if number not in names]
    problems = [f"camera {camera}: {some(missing)} without an image"] if missing else []
    paths = {number: file_in(root, names[number]) for number in wanted}
    with ThreadPoolExecutor(_READERS) as pool:
        looked_at = dict(zip(wanted, pool.map(read_image_size, paths.values()), strict=True))
    sizes = Counter(seen for seen in looked_at.values() if not isinstance(seen, str))
    if not sizes:
        faults = [f"{paths[n]} {looked_at[n]}" for n in wanted[:3]] or problems
        raise AdapterError(f"camera {camera}: none of its images is usable: {'; '.join(faults)}")
    expected = size or sizes.most_common(1)[0][0]
    if expected not in sizes:
        first = next(n for n in wanted if not isinstance(looked_at[n], str))
        raise AdapterError(
            f"{paths[first]} is {_text(looked_at[first])} pixels, the calibration's S_rect says "
            f"{_text(expected)}; images and calibration must be of one day, rectified (sync) and "
            f"not resized"
        )
    usable = {}
    for number in wanted:
        seen = looked_at[number]
        if seen == expected:
            usable[number] = paths[number]
            continue
        fault = seen if isinstance(seen, str) else f"is {_text(seen)} pixels, not {_text(expected)}"
        problems.append(f"camera {camera}, frame {number}: image {paths[number]} {fault}; left out")
    return CameraImages(usable, expected, tuple(problems))


def _text(size: tuple[int, int] | str) -> str:
    return f"{size[0]}x{size[1]}"


# ---- adapter -------------------------------------------------------------------------------------


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
