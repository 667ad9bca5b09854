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
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from pydantic import Field
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
    rotation_about,
)
from adapters.plain_files import parse_numbers, read_text
from adapters.raw_drive import (
    DriveFrames,
    DriveImages,
    DriveOptions,
    Picture,
    RawDrive,
    Sweep,
    TimedBoxes,
    drive_origin,
    find_objects,
    is_in_box,
    recentred,
    scene_of_drive,
    some,
    stored_records,
    usable_images,
)
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.geometry import invert_rigid, quat_from_rotmat
from augment.labels import Boxes, LidarSweep
from augment.scene import Scene

# ---- Boxes and sweeps, read when asked -----------------------------------------------------------
# A raw drive's boxes are in tracklet_labels.xml, in the Velodyne's frame of each frame. The object
# benchmark's are in label_2/NNNNNN.txt, a line an object:
#     type truncated occluded alpha left top right bottom h w l x y z rotation_y [score]
# x y z is the middle of the box's bottom in the rectified camera 0 (x right, y down, z forward),
# rotation_y the heading about its y, 0 along x. DontCare lines mark image regions: no boxes.

TRACKLETS = "tracklet_labels.xml"
ATTRIBUTES = (
    "state", "occlusion", "occlusion_kf", "truncation", "amt_occlusion", "amt_occlusion_kf",
    "amt_border_l", "amt_border_r", "amt_border_kf",
)  # fmt: skip
_SIZE, _POSE = ("l", "w", "h"), ("tx", "ty", "tz", "rx", "ry", "rz")
_TRACKLET_COLUMNS = ("number", "label", "frame", *_SIZE, *_POSE, *ATTRIBUTES)
_MAX_BYTES, _MAX_TAGS = 64 * 2**20, 8_000_000
_OWN_DOCTYPE = re.compile(r"<!DOCTYPE\s+boost_serialization\s*>")  # declares nothing
_LAST_FRAME = 10**9
_OBJECT_COLUMNS = (
    "type", "truncated", "occluded", "alpha", "bbox_left", "bbox_top", "bbox_right", "bbox_bottom",
    "h", "w", "l", "x", "y", "z", "rotation_y", "score",
)  # fmt: skip
_RECORD = ("x", "y", "z", "intensity")  # of a sweep's file


@dataclass(frozen=True, eq=False)
class KittiLabels:
    """Labels of a raw drive, or of one frame of the object benchmark.

    sweeps: files relative to the root, by frame. world_from_velodyne: float64 [4, 4] in the
    dataset's world, by frame; frames without one have no labels. tracklets: of a raw drive.
    velodyne_from_rectified: of an object folder, where boxes are in label_2/. Sweeps have the
    columns x y z (float64 metres), intensity (the file's reflectance, 0 to 1) and timestamp_ns (the
    frame's: the file has none), in the file's order."""

    root: Path
    sweeps: Mapping[int, str]
    timestamps_ns: Mapping[int, int]
    world_from_velodyne: Mapping[int, np.ndarray]
    tracklets: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=_TRACKLET_COLUMNS))
    velodyne_from_rectified: np.ndarray | None = None

    def boxes(self, frame_index: int) -> Boxes:
        pose = self.world_from_velodyne.get(frame_index)
        if pose is None:
            return Boxes.empty()
        if self.velodyne_from_rectified is None:
            return boxes_at(self.tracklets, frame_index, pose)
        path = object_label_file(self.root, frame_index)
        if not path.exists():
            return Boxes.empty()
        return boxes_of_lines(read_object_lines(path), self.velodyne_from_rectified)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """None without a file or a pose, or where the file is damaged, which the scene's problems
        say."""
        pose = self.world_from_velodyne.get(frame_index)
        if pose is None or frame_index not in self.sweeps:
            return None
        try:
            returns = read_returns(self.root, self.sweeps[frame_index])
        except AdapterError:
            return None
        with np.errstate(invalid="ignore", over="ignore"):  # of returns that are not finite
            world = returns[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        columns = {axis: np.ascontiguousarray(world[:, i]) for i, axis in enumerate("xyz")}
        columns["intensity"] = returns[:, 3].copy()
        columns["timestamp_ns"] = np.full(len(world), self.timestamps_ns[frame_index], np.int64)
        return LidarSweep(columns)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """The Velodyne's place in its pose of the frame; what the car drives within the turn of
        0.1 s is left out, as it is left in the returns."""
        pose = self.world_from_velodyne.get(frame_index)
        return None if pose is None else np.broadcast_to(pose[:3, 3], (len(sweep), 3))

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """The frame's file, where it is there and has a pose."""
        if frame_index not in self.sweeps or frame_index not in self.world_from_velodyne:
            return ()
        file = file_in(self.root, self.sweeps[frame_index])
        return (file,) if file.exists() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """That file with a weathered sweep in place of its own."""
        records = read_returns(self.root, self.sweeps[frame_index])
        return stored_records(records, _RECORD, sweep, self.world_from_velodyne[frame_index])


def object_label_file(root: Path, frame: int) -> Path:
    """The label file of a frame, there or not."""
    return file_in(root, f"label_2/{frame:0{OBJECT_DIGITS}d}.txt")


def read_tracklets(root: Path) -> pd.DataFrame | None:
    """The boxes of the drive's tracklets, a row each: number of the tracklet in the file from 0,
    label, frame, size, pose of the middle of the bottom, and ATTRIBUTES, NaN where there is none.
    None without the file."""
    path = file_in(root, TRACKLETS)
    if not path.exists():
        return None
    rows = []
    for number, item in enumerate(_parsed(path).findall("./tracklets/item")):
        where = f"{path}: tracklet {number}"
        *size_m, first = (_number(item, name, where) for name in ("l", "w", "h", "first_frame"))
        if min(size_m) <= 0:
            raise AdapterError(f"{where}: l, w, h must be metres > 0; got {size_m}")
        if first % 1 or not 0 <= first <= _LAST_FRAME:
            raise AdapterError(f"{where}: first_frame must be a frame's number; got {first:g}")
        label = (item.findtext("objectType") or "").strip() or "unknown"
        for frame, pose in enumerate(item.findall("./poses/item"), start=int(first)):
            numbers = [_number(pose, name, where) for name in _POSE]
            extra = [_number(pose, name, where, otherwise=np.nan) for name in ATTRIBUTES]
            rows.append((number, label, frame, *size_m, *numbers, *extra))
    return pd.DataFrame(rows, columns=_TRACKLET_COLUMNS)


def _number(element: ET.Element, name: str, where: str, *, otherwise: float | None = None) -> float:
    """The finite number in an element. otherwise: where there is no such element."""
    text = element.findtext(name)
    if text is None and otherwise is not None:
        return otherwise
    try:
        value = float(text) if text is not None else np.nan
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise AdapterError(f"{where}: <{name}> must hold a finite number; got {text!r:.80}")
    return value


def boxes_at(tracklets: pd.DataFrame, frame: int, world_from_velodyne: np.ndarray) -> Boxes:
    """The boxes of a frame in the world of the pose. A track_id is the tracklet's number in the
    file; attributes are ATTRIBUTES, float64."""
    here = tracklets[tracklets["frame"] == frame]
    sizes_m = here[[*_SIZE]].to_numpy(np.float64)
    world = np.empty((len(here), 4, 4))
    for i, (x, y, z, rx, ry, rz) in enumerate(here[[*_POSE]].to_numpy(np.float64)):
        pose = np.eye(4)
        pose[:3, :3] = rotation_about(2, rz) @ rotation_about(1, ry) @ rotation_about(0, rx)
        pose[:3, 3] = [x, y, z] + pose[:3, 2] * sizes_m[i, 2] / 2  # of the middle
        world[i] = world_from_velodyne @ pose
    return Boxes(
        track_ids=tuple(map(str, here["number"])),
        labels=tuple(here["label"]),
        centers_m=np.ascontiguousarray(world[:, :3, 3]),
        sizes_m=np.ascontiguousarray(sizes_m),
        quats=quat_from_rotmat(torch.from_numpy(world[:, :3, :3].copy())).numpy(),
        attributes={name: here[name].to_numpy(np.float64, copy=True) for name in ATTRIBUTES},
    )


def _parsed(path: Path) -> ET.Element:
    """The file's root element; nothing in it is expanded or fetched, and it is of bounded size."""
    if path.stat().st_size > _MAX_BYTES:
        raise AdapterError(f"{path} is larger than {_MAX_BYTES // 2**20} MiB; no drive has that")
    text = _OWN_DOCTYPE.sub("", read_text(path), count=1)
    # A parser takes text with NUL characters for UTF-16, in which declarations look otherwise.
    if "\0" in text or "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise AdapterError(
            f"{path} is not UTF-8, or declares a document type or entities, as no file of KITTI "
            f"does; copy it from the dataset"
        )
    if text.count("<") > _MAX_TAGS:
        raise AdapterError(f"{path} has more than {_MAX_TAGS} tags; no drive has that")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise AdapterError(f"{path} is not whole XML ({error}); copy it again") from None
    if root.find("tracklets") is None:
        raise AdapterError(f"{path} has no <tracklets>; copy it from the dataset")
    return root


def read_object_lines(path: Path) -> pd.DataFrame:
    """The objects of a label file: `type` and numbers by column (score NaN without one), indexed by
    the lines' numbers from 0; DontCare lines too, of which only the type is read."""
    rows = {}
    for number, line in enumerate(read_text(path).splitlines()):
        words, where = line.split(), f"{path}, line {number + 1}"
        if not words:
            continue
        if words[0] == "DontCare":
            rows[number] = [words[0], *[np.nan] * 15]
            continue
        if len(words) not in (15, 16):
            raise AdapterError(
                f"{where}: expected a type and 14 numbers, and maybe a score; got {len(words)} "
                f"words"
            )
        values = parse_numbers(" ".join(words[1:]), where)
        if min(values[7:10]) <= 0:
            raise AdapterError(f"{where}: h, w, l must be metres > 0; got {values[7:10].tolist()}")
        rows[number] = [words[0], *values, *[np.nan] * (16 - len(words))]
    return pd.DataFrame.from_dict(rows, orient="index", columns=_OBJECT_COLUMNS)


def boxes_of_lines(lines: pd.DataFrame, velodyne_from_rectified: np.ndarray) -> Boxes:
    """The objects as boxes in the Velodyne's frame. A track_id is the line's number from 0.
    Attributes: truncated, occluded, alpha, bbox_left, bbox_top, bbox_right, bbox_bottom as in the
    file, and score where a line has one, float64."""
    lines = lines[lines["type"] != "DontCare"]
    values = lines.drop(columns="type").to_numpy(np.float64)
    height, width, length = values[:, 7:10].T
    heading = values[:, 13]
    zero, one = np.zeros_like(heading), np.ones_like(heading)
    forward = np.stack([np.cos(heading), zero, -np.sin(heading)], axis=1)
    up = np.stack([zero, -one, zero], axis=1)
    rectified_from_box = np.stack([forward, np.cross(up, forward), up], axis=2)
    centres = values[:, 10:13] + up * height[:, None] / 2
    turn = velodyne_from_rectified[:3, :3]
    names = _OBJECT_COLUMNS[1:8] + (("score",) if lines["score"].notna().any() else ())
    return Boxes(
        track_ids=tuple(map(str, lines.index)),
        labels=tuple(lines["type"]),
        centers_m=centres @ turn.T + velodyne_from_rectified[:3, 3],
        sizes_m=np.stack([length, width, height], axis=1),
        quats=quat_from_rotmat(torch.from_numpy(turn @ rectified_from_box)).numpy(),
        attributes={name: lines[name].to_numpy(np.float64, copy=True) for name in names},
    )


# ---- The scene -----------------------------------------------------------------------------------

ICP = "icp"
_LIDAR_TOP_DEG = 2.0  # the HDL-64E's uppermost channel
# The recording car around its Velodyne: in measured sweeps all returns within 2.6 m of it that no
# neighbour made.
_EGO_M = np.array([[-2.0, -1.35, -1.5], [2.6, 1.35, 0.5]])


class KittiOptions(DriveOptions):
    """poses: the drive's own GPS/IMU without it. frame: of an object folder; else its only one."""

    poses: str | None = Field(
        None,
        min_length=1,
        description="icp, or a file with a line of 12 numbers a frame (raw drives)",
    )
    frame: int | None = Field(None, ge=0, lt=10**9, description="a frame's number (object folders)")


def open_kitti(path: str, query: dict[str, str]) -> Scene:
    """The scene of a raw drive such as `2011_09_26/2011_09_26_drive_0001_sync`, or of one frame of
    an object folder.

    query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out (see DriveOptions);
    of a drive poses=icp or poses=FILE, of an object folder frame=NUMBER.
    Opening is deterministic: the same files and options give the same bits.

    Raises:
        AdapterError: a wrong option; missing or damaged calibration, poses, times or labels; no
            usable sweep or image. What single frames lack is in Scene.problems."""
    source, options = find_source(path, query)
    return scene_of_drive(read_kitti(path, query, source), options)


def read_kitti(path: str, query: dict[str, str], source: Source) -> RawDrive:
    """The source's frames with their images, sweeps and boxes."""
    labels, calibration = source.labels, source.calibration
    pictures = [
        Picture(name, n, file_in(labels.root, files[n]) if n in files else None, camera.size)
        for name, camera in calibration.cameras.items()
        for n in source.chosen.numbers
        for files in [source.images[name]]
    ]
    images = usable_images(pictures)
    frames = tuple(_frame(source, images, number) for number in source.chosen.numbers)
    used = [frame for frame in frames if frame.index not in source.chosen.held_out]
    sweeps, sweep_problems = _read_sweeps(labels, used)
    objects = find_objects(
        (TimedBoxes(f.index, labels.boxes(f.index), f.timestamp_ns) for f in frames),
        source.world_origin_m,
    )
    return RawDrive(
        name=source.name,
        source=format_uri("kitti", path, query),
        frames=frames,
        held_out=source.chosen.held_out,
        sweeps=sweeps,
        boxes=objects.moving,
        labels=labels,
        world_origin_m=source.world_origin_m,
        lidar_top_deg=_LIDAR_TOP_DEG,
        problems=(*source.problems, *images.problems, *sweep_problems, *objects.problems),
    )


def kitti_labels(path: str, query: dict[str, str]) -> KittiLabels:
    """The labels alone, in the world that `open_kitti` with this query has before recentring."""
    return find_source(path, query)[0].labels


def _read_sweeps(
    labels: KittiLabels, frames: Sequence[Frame]
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """The usable returns of the frames in the scene's world."""
    missing = [frame.index for frame in frames if frame.index not in labels.sweeps]
    problems = [f"{some(missing)} without a sweep"] if missing else []
    sweeps = []
    for frame in tqdm(frames, desc="LiDAR", unit="frame", disable=None):
        if frame.index not in labels.sweeps:
            continue
        try:
            points = read_returns(labels.root, labels.sweeps[frame.index])[:, :3].astype(np.float64)
        except AdapterError as error:
            problems.append(f"frame {frame.index}: {error}")
            continue
        finite = np.isfinite(points).all(axis=1)
        bad = int((~finite).sum())
        if bad:
            problems.append(f"frame {frame.index}: left out {bad} returns that are not finite")
        points = points[finite & ~is_in_box(points, *_EGO_M)]
        pose = frame.world_from_ego.numpy()
        with np.errstate(over="ignore"):
            world = points @ pose[:3, :3].T + pose[:3, 3]
            sweeps.append(Sweep.of_unknown_class(world, frame.timestamp_ns))
    return tuple(sweeps), tuple(problems)


def _frame(source: Source, images: DriveImages, number: int) -> Frame:
    pose = recentred(source.labels.world_from_velodyne[number], source.world_origin_m)
    ego_from_world = invert_rigid(pose)
    time = source.labels.timestamps_ns[number]
    return Frame(
        index=number,
        timestamp_ns=time,
        world_from_ego=pose,
        cameras={
            name: Camera(
                name,
                *images.sizes[name],
                *camera.lens,
                camera_from_world=torch.from_numpy(camera.camera_from_velodyne) @ ego_from_world,
                timestamp_ns=source.image_times_ns.get(name, {}).get(number, time),
            )
            for name, camera in source.calibration.cameras.items()
        },
        image_paths=images.paths.get(number, {}),
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
    options = KittiOptions.from_query("kitti", query)
    if (wrong := "poses" if is_object else "frame") in query:
        what = "an object folder, whose frames are unrelated" if is_object else "a raw drive"
        meaning = KittiOptions.model_fields[wrong].description
        raise AdapterError(f"kitti: {wrong}= means nothing for {what}; it is {meaning}")
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
    chosen = options.select(numbers, where=f"kitti:{root}")
    calibration = read_raw_calibration(calibration_folder, images)
    image_times = {name: read_times(root, name) for name in images}
    known = read_times(root, VELODYNE) or next(filter(None, image_times.values()), {})
    times, time_problems = frame_times(root, known, numbers)
    poses = _raw_poses(root, calibration_folder, calibration, options, numbers, chosen, sweeps)
    located = poses.world_from_velodyne
    tracklets = read_tracklets(root)
    labels = KittiLabels(root, sweeps, times, located)
    if tracklets is not None:
        labels = replace(labels, tracklets=tracklets)
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
        labels,
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
    return {}, (
        f"{root} holds no images: expected image_02/data/NNNNNNNNNN.png, or image_03/, or the grey "
        f"image_00/ or image_01/",
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
    images = {name: {number: files[number]} for name, files in images.items() if number in files}
    problems = []
    if number not in sweeps:
        problems.append(f"{root / 'velodyne' / digits}.bin does not exist")
    if not images:
        problems.append(f"{root / 'image_2' / digits}.png does not exist, nor in image_3/")
    chosen = options.select([number], where=f"kitti:{root}, frame {number}")
    calibration = read_object_calibration(calibration_folder, digits, images)
    labels = KittiLabels(
        root,
        {number: sweeps[number]} if number in sweeps else {},
        {number: 0},
        {number: np.eye(4)},
        velodyne_from_rectified=np.linalg.inv(calibration.rectified_from_velodyne),
    )
    path = object_label_file(root, number)
    problems += chosen.problems
    if not path.exists():
        problems.append(f"{path} does not exist: no boxes are known")
    elif ignored := int((read_object_lines(path)["type"] == "DontCare").sum()):
        problems.append(
            f"{path}: {ignored} regions marked DontCare have no 3D box; boxes are without them"
        )
    return Source(digits, chosen, calibration, images, {}, labels, np.zeros(3), tuple(problems))


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
