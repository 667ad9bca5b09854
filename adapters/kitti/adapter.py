"""A raw KITTI drive, or a frame of its object benchmark, as a scene: Gaussians from accumulated,
image-coloured LiDAR.

World: of a raw drive that of its poses (GPS/IMU: Mercator metres, x east, y north; a file or
registered sweeps: that of the first frame), recentred where it is far; of a single frame without
poses, and of an object frame, the Velodyne's. Ego: the Velodyne, x forward, y left, z up, 1.73 m
above the road. Tracklets that move are actors. The Velodyne looks 2 degrees up at most, so what
rises above is in the sky.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from adapters.kitti.files import (
    COLOUR_CAMERAS,
    GREY_CAMERAS,
    IMAGE_SUFFIXES,
    OBJECT_CAMERAS,
    OBJECT_DIGITS,
    RAW_DIGITS,
    VELODYNE,
    Calibration,
    Poses,
    file_in,
    frame_times,
    is_object_folder,
    kitti_root,
    numbered,
    odometry_poses,
    oxts_poses,
    read_object_calibration,
    read_raw_calibration,
    read_returns,
    read_times,
    read_velodyne_from_imu,
    registered_poses,
    some,
)
from adapters.kitti.labels import (
    TRACKLETS,
    KittiLabels,
    object_label_file,
    read_object_lines,
    read_tracklets,
)
from adapters.lidar_scene.scene import build_lidar_scene, views_of
from adapters.lidar_scene.split import join_tracks
from adapters.plain_files import read_image_size
from adapters.raw_drive import (
    DriveFrames,
    DriveOptions,
    Sweep,
    TimedBoxes,
    drive_origin,
    is_in_box,
    read_objects,
)
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.geometry import invert_rigid
from augment.scene import Scene

ICP = "icp"
_LIDAR_TOP_DEG = 2.0  # the HDL-64E's uppermost channel
# The recording car around its Velodyne: in measured sweeps all returns within 2.6 m of it that no
# neighbour made.
_EGO_LOW_M, _EGO_HIGH_M = np.array([-2.0, -1.35, -1.5]), np.array([2.6, 1.35, 0.5])
_READERS = 4  # threads that decode; decoding releases the interpreter
_OWN = {
    "poses": "icp, or a file with a line of 12 numbers a frame (raw drives)",
    "frame": "a frame's number (object folders)",
}


@dataclass(frozen=True)
class KittiOptions:
    """drive: the options of every drive. poses: "icp", a file's name, or None for the drive's own
    GPS/IMU. frame: which frame of an object folder; None: the only one."""

    drive: DriveOptions
    poses: str | None = None
    frame: int | None = None

    @staticmethod
    def from_query(query: dict[str, str], *, is_object: bool) -> KittiOptions:
        drive = DriveOptions.from_query("kitti", query, _OWN)
        poses, frame = query.get("poses"), query.get("frame")
        wrong = "poses" if is_object else "frame"
        if wrong in query:
            what = "an object folder, whose frames are unrelated" if is_object else "a raw drive"
            raise AdapterError(f"kitti: {wrong}= means nothing for {what}; it is {_OWN[wrong]}")
        if frame is not None and not re.fullmatch("[0-9]{1,9}", frame):
            raise AdapterError(f"kitti: frame must be a frame's number; got {frame!r}")
        if poses == "":
            raise AdapterError("kitti: poses must be icp or the name of a file; got nothing")
        return KittiOptions(drive, poses, None if frame is None else int(frame))


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
    images, image_problems = {}, []
    for camera in source.calibration.cameras:
        files = source.images[camera.name]
        images[camera.name] = _usable_images(
            source.labels.root, camera.name, files, numbers, camera.size, image_problems
        )
    frames = tuple(_frame(source, images, number) for number in numbers)
    used = [frame for frame in frames if frame.index not in held_out]
    sweeps, sweep_problems = _read_sweeps(source.labels, used)
    if not any(frame.image_paths for frame in used):
        raise AdapterError(
            f"{source.labels.root}: none of the frames that are not held out has a usable image; "
            f"colours cannot be had without them"
        )
    boxes = {frame.index: TimedBoxes(source.labels.boxes(frame.index), None) for frame in frames}
    objects = read_objects(frames, boxes, source.world_origin_m)
    return build_lidar_scene(
        sweeps,
        join_tracks(objects.moving),
        views_of(used),
        options.drive,
        lidar_top_deg=_LIDAR_TOP_DEG,
        name=source.name,
        source=format_uri("kitti", path, query),
        frames=frames,
        labels=source.labels,
        world_origin_m=source.world_origin_m,
        problems=(*source.problems, *image_problems, *sweep_problems, *objects.problems),
        if_empty=f"{source.labels.root}: none of the sweeps' points is in any image; check that "
        f"calibration, sweeps and images are of one day",
    )


def kitti_labels(path: str, query: dict[str, str]) -> KittiLabels:
    """The labels alone, in the world that `open_kitti` with this query has before recentring."""
    return find_source(path, query)[0].labels


def _usable_images(
    root: Path,
    camera: str,
    names: Mapping[int, str],
    numbers: Sequence[int],
    size: tuple[int, int] | None,
    problems: list[str],
) -> tuple[dict[int, Path], tuple[int, int]]:
    """The camera's images of the frames, all decoded once to be sure of them, and their width and
    height.

    names: the camera's files by frame. size: what the calibration says; None: that of most images.
    """
    present = [number for number in numbers if number in names]
    missing = [number for number in numbers if number not in names]
    faults = [f"camera {camera}: {some(missing)} without an image"] if missing else []
    paths = {number: file_in(root, names[number]) for number in present}
    with ThreadPoolExecutor(_READERS) as pool:
        found = dict(zip(present, pool.map(read_image_size, paths.values()), strict=True))
    sizes = Counter(seen for seen in found.values() if not isinstance(seen, str))
    if not sizes:
        faults = [f"{paths[n]} {found[n]}" for n in present[:3]] or faults
        raise AdapterError(f"camera {camera}: none of its images is usable: {'; '.join(faults)}")
    expected = size or sizes.most_common(1)[0][0]
    text = "{0[0]}x{0[1]}".format
    if expected not in sizes:
        first = next(n for n in present if not isinstance(found[n], str))
        raise AdapterError(
            f"{paths[first]} is {text(found[first])} pixels, the calibration's S_rect says "
            f"{text(expected)}; images and calibration must be of one day, rectified (sync) and "
            f"not resized"
        )
    problems += faults
    for number, seen in found.items():
        if seen != expected:
            fault = (
                seen if isinstance(seen, str) else f"is {text(seen)} pixels, not {text(expected)}"
            )
            problems.append(
                f"camera {camera}, frame {number}: image {paths.pop(number)} {fault}; left out"
            )
    return paths, expected


def _read_sweeps(
    labels: KittiLabels, frames: Sequence[Frame]
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """The usable returns of the frames in the scene's world."""
    missing = [frame.index for frame in frames if frame.index not in labels.sweeps]
    problems = [f"{some(missing)} without a sweep"] if missing else []
    sweeps = []
    for frame in tqdm(frames, desc="LiDAR", unit="frame", disable=None):
        name = labels.sweeps.get(frame.index)
        if name is None:
            continue
        try:
            points = read_returns(labels.root, name)[:, :3].astype(np.float64)
        except AdapterError as error:
            problems.append(f"frame {frame.index}: {error}")
            continue
        finite = np.isfinite(points).all(axis=1)
        bad = int((~finite).sum())
        if bad:
            problems.append(f"frame {frame.index}: left out {bad} returns that are not finite")
        points = points[finite & ~is_in_box(points, _EGO_LOW_M, _EGO_HIGH_M)]
        pose = frame.world_from_ego.numpy()
        with np.errstate(over="ignore"):
            world = points @ pose[:3, :3].T + pose[:3, 3]
            sweeps.append(Sweep.of_unknown_class(world, frame.timestamp_ns))
    if not sum(len(sweep) for sweep in sweeps):
        raise AdapterError(
            f"{labels.root}: there are no returns in {some([f.index for f in frames])}; a scene "
            f"cannot be built without them" + "".join(f"; {problem}" for problem in problems[:3])
        )
    return tuple(sweeps), tuple(problems)


def _frame(
    source: Source, images: Mapping[str, tuple[dict[int, Path], tuple[int, int]]], number: int
) -> Frame:
    pose = source.labels.world_from_velodyne[number].copy()
    pose[:3, 3] -= source.world_origin_m
    ego_from_world = invert_rigid(torch.from_numpy(pose))
    time = source.labels.timestamps_ns[number]
    return Frame(
        index=number,
        timestamp_ns=time,
        world_from_ego=torch.from_numpy(pose),
        cameras={
            camera.name: Camera(
                camera.name,
                *images[camera.name][1],
                *camera.lens,
                camera_from_world=torch.from_numpy(camera.camera_from_velodyne) @ ego_from_world,
                timestamp_ns=source.image_times_ns[camera.name].get(number, time),
            )
            for camera in source.calibration.cameras
        },
        image_paths={
            name: str(paths[number]) for name, (paths, _) in images.items() if number in paths
        },
    )


@dataclass(frozen=True, eq=False)
class Source:
    """What a folder holds of the frames asked for, before images are decoded.

    chosen: the scene's frames, all with a pose. images: names of the files by camera and frame.
    image_times_ns: by camera and frame, where the camera has its own. labels: of all frames with
    poses, in the dataset's world. world_origin_m: float64 [3]."""

    name: str
    chosen: DriveFrames
    calibration: Calibration
    images: Mapping[str, Mapping[int, str]]
    image_times_ns: Mapping[str, Mapping[int, int]]
    labels: KittiLabels
    world_origin_m: np.ndarray
    problems: tuple[str, ...]


def find_source(path: str, query: dict[str, str]) -> tuple[Source, KittiOptions]:
    """What the URI names, and its options."""
    root, calibration = kitti_root(path)
    is_object = is_object_folder(root)
    options = KittiOptions.from_query(query, is_object=is_object)
    return (_object_source if is_object else _raw_source)(root, calibration, options), options


def _raw_source(root: Path, calibration_folder: Path, options: KittiOptions) -> Source:
    sweeps = numbered(root, f"{VELODYNE}/data", (".bin",), RAW_DIGITS)
    images, problems = _raw_images(root)
    numbers = sorted(set(sweeps).union(*images.values()))
    if not sweeps:
        raise AdapterError(
            f"{root / VELODYNE / 'data'} holds no sweep NNNNNNNNNN.bin; a scene cannot be built "
            f"without them, unpack the drive again"
        )
    chosen = options.drive.select(numbers, where=f"kitti:{root}")
    calibration = read_raw_calibration(calibration_folder, tuple(images))
    image_times = {name: read_times(root, name) for name in images}
    known = read_times(root, VELODYNE) or next(filter(None, image_times.values()), {})
    times, time_problems = frame_times(root, known, numbers)
    poses = _raw_poses(root, calibration_folder, calibration, options, numbers, chosen, sweeps)
    located = poses.world_from_velodyne
    tracklets = read_tracklets(root)
    missing = [number for number in chosen.numbers if number not in located]
    problems = (
        *problems,
        *chosen.problems,
        *time_problems,
        *poses.problems,
        *((f"left out {some(missing)}: no pose is known",) if missing else ()),
        *(() if tracklets is not None else (f"{root} has no {TRACKLETS}: no boxes are known",)),
    )
    with_pose = DriveFrames(tuple(n for n in chosen.numbers if n in located), chosen.held_out)
    if not with_pose.used:
        raise AdapterError(
            f"{root}: no pose is known of any of {some(chosen.used)}"
            + "".join(f"; {problem}" for problem in poses.problems[:3])
        )
    return Source(
        root.absolute().name,
        with_pose,
        calibration,
        images,
        image_times,
        KittiLabels(root, sweeps, times, located, tracklets or ()),
        drive_origin(np.stack([pose[:3, 3] for _, pose in sorted(located.items())])),
        problems,
    )


def _raw_images(root: Path) -> tuple[dict[str, dict[int, str]], tuple[str, ...]]:
    """The files of the colour cameras, or else of the grey ones, by camera and frame."""
    for cameras in (COLOUR_CAMERAS, GREY_CAMERAS):
        found = {
            name: numbered(root, f"{name}/data", IMAGE_SUFFIXES, RAW_DIGITS) for name in cameras
        }
        images = {name: files for name, files in found.items() if files}
        if images:
            empty = [n for n in cameras if (root / n).is_dir() and n not in images]
            return images, tuple(f"camera {n}: {root / n / 'data'} holds no image" for n in empty)
    raise AdapterError(
        f"{root} holds no images: expected image_02/data/NNNNNNNNNN.png, or image_03/, or the grey "
        f"image_00/ or image_01/; colours cannot be had without them"
    )


def _raw_poses(
    root: Path,
    calibration_folder: Path,
    calibration: Calibration,
    options: KittiOptions,
    numbers: list[int],
    chosen: DriveFrames,
    sweeps: Mapping[int, str],
) -> Poses:
    if options.poses == ICP:
        return _registered(root, chosen, sweeps)
    if options.poses is not None:
        path = Path(options.poses).expanduser()
        return odometry_poses(path, numbers, calibration.rectified_from_velodyne)
    oxts = numbered(root, "oxts/data", (".txt",), RAW_DIGITS)
    if oxts:
        return oxts_poses(root, oxts, read_velodyne_from_imu(calibration_folder))
    if len(chosen.numbers) == 1:
        return Poses({chosen.numbers[0]: np.eye(4)})
    raise AdapterError(
        f"{root} has no poses (oxts/data/NNNNNNNNNN.txt) for {some(chosen.numbers)}. Copy the "
        f"drive's oxts/ there; or give ?poses=FILE, a line of 12 numbers a frame as of KITTI's "
        f"odometry; or ?poses=icp, which registers the sweeps; or one frame, "
        f"?frames={chosen.numbers[0]}:{chosen.numbers[0] + 1}, which needs none"
    )


def _registered(root: Path, chosen: DriveFrames, sweeps: Mapping[int, str]) -> Poses:
    problems: list[str] = []

    def read(number: int) -> np.ndarray | None:
        if number not in sweeps:
            return None
        try:
            return read_returns(root, sweeps[number])
        except AdapterError as error:
            problems.append(f"frame {number}: {error}")
            return None

    poses = registered_poses(chosen.numbers, read)
    return Poses(poses.world_from_velodyne, (*problems, *poses.problems))


def _object_source(root: Path, calibration_folder: Path, options: KittiOptions) -> Source:
    sweeps = numbered(root, "velodyne", (".bin",), OBJECT_DIGITS)
    images = {n: numbered(root, n, IMAGE_SUFFIXES, OBJECT_DIGITS) for n in OBJECT_CAMERAS}
    number = _object_frame(root, options.frame, sorted(set(sweeps).union(*images.values())))
    digits = f"{number:0{OBJECT_DIGITS}d}"
    if number not in sweeps:
        raise AdapterError(
            f"{root / 'velodyne' / digits}.bin does not exist; frame {number} has no sweep to "
            f"build a scene from"
        )
    images = {name: {number: files[number]} for name, files in images.items() if number in files}
    if not images:
        raise AdapterError(
            f"{root / 'image_2' / digits}.png does not exist, nor in image_3/; colours cannot be "
            f"had without an image"
        )
    chosen = options.drive.select([number], where=f"kitti:{root}, frame {number}")
    calibration = read_object_calibration(calibration_folder, digits, tuple(images))
    labels = KittiLabels(
        root,
        {number: sweeps[number]},
        {number: 0},
        {number: np.eye(4)},
        velodyne_from_rectified=np.linalg.inv(calibration.rectified_from_velodyne),
    )
    path = object_label_file(root, number)
    problems = list(chosen.problems)
    if not path.exists():
        problems.append(f"{path} does not exist: no boxes are known")
    elif ignored := read_object_lines(path).dont_care:
        problems.append(
            f"{path}: {ignored} regions marked DontCare have no 3D box; boxes are without them"
        )
    times = {name: {} for name in images}
    return Source(digits, chosen, calibration, images, times, labels, np.zeros(3), tuple(problems))


def _object_frame(root: Path, asked: int | None, numbers: list[int]) -> int:
    digits = [f"{n:0{OBJECT_DIGITS}d}" for n in numbers]
    examples = ", ".join(digits[:3]) + (", ..." if len(digits) > 3 else "")
    if not numbers:
        raise AdapterError(f"{root} holds neither velodyne/NNNNNN.bin nor image_2/NNNNNN.png")
    if asked is None and len(numbers) > 1:
        raise AdapterError(
            f"{root} holds {len(numbers)} unrelated frames ({examples}); a scene is one of them, "
            f"give ?frame={digits[0]}"
        )
    if asked is not None and asked not in numbers:
        raise AdapterError(
            f"{root} has no frame {asked:0{OBJECT_DIGITS}d}; it has {len(numbers)}: {examples}"
        )
    return numbers[0] if asked is None else asked
