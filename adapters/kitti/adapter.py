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
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
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
    some,
)
from adapters.lidar_scene.scene import build_lidar_scene, views_of
from adapters.lidar_scene.split import join_tracks
from adapters.plain_files import parse_numbers, read_image_size, read_text
from adapters.raw_drive import (
    DriveFrames,
    DriveOptions,
    Sweep,
    TimedBoxes,
    drive_origin,
    is_in_box,
    read_objects,
    stored_records,
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
_POSE = ("tx", "ty", "tz", "rx", "ry", "rz")
_MAX_BYTES, _MAX_ELEMENTS, _MAX_DEPTH = 64 * 2**20, 4_000_000, 8
_OWN_DOCTYPE = re.compile(r"<!DOCTYPE\s+boost_serialization\s*>")  # declares nothing
_LAST_FRAME = 10**9
_OBJECT_ATTRIBUTES = (
    "truncated", "occluded", "alpha", "bbox_left", "bbox_top", "bbox_right", "bbox_bottom",
)  # fmt: skip
_COLUMNS = 15
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
    tracklets: tuple[Tracklet, ...] = ()
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


@dataclass(frozen=True, eq=False)
class Tracklet:
    """One object over T frames from first_frame on.

    size_m: length, width, height. poses: float64 [T, 6], the middle of the box's bottom and its
    turns about x, y, z, as in the file. attributes: float64 [T, 9], NaN where there is none."""

    label: str
    size_m: np.ndarray
    first_frame: int
    poses: np.ndarray
    attributes: np.ndarray


def read_tracklets(root: Path) -> tuple[Tracklet, ...] | None:
    """The drive's tracklets in the file's order, or None without the file."""
    path = file_in(root, TRACKLETS)
    if not path.exists():
        return None
    items = _parsed(path).findall("./tracklets/item")
    return tuple(_tracklet(item, f"{path}: tracklet {i}") for i, item in enumerate(items))


def boxes_at(tracklets: tuple[Tracklet, ...], frame: int, world_from_velodyne: np.ndarray) -> Boxes:
    """The boxes of a frame in the world of the pose. A track_id is the tracklet's number in the
    file, from 0; attributes are ATTRIBUTES, float64."""
    here = [
        (number, t, frame - t.first_frame)
        for number, t in enumerate(tracklets)
        if 0 <= frame - t.first_frame < len(t.poses)
    ]
    rows = [t.attributes[row] for _, t, row in here]
    values = np.array(rows, np.float64).reshape(-1, len(ATTRIBUTES))
    world = np.array([world_from_velodyne @ _pose(t, row) for _, t, row in here]).reshape(-1, 4, 4)
    return Boxes(
        track_ids=tuple(str(number) for number, _, _ in here),
        labels=tuple(t.label for _, t, _ in here),
        centers_m=np.ascontiguousarray(world[:, :3, 3]),
        sizes_m=np.array([t.size_m for _, t, _ in here], np.float64).reshape(-1, 3),
        quats=quat_from_rotmat(torch.from_numpy(world[:, :3, :3].copy())).numpy(),
        attributes={name: values[:, i] for i, name in enumerate(ATTRIBUTES)},
    )


def _pose(tracklet: Tracklet, row: int) -> np.ndarray:
    """velodyne_from_box of the box's middle, float64 [4, 4]."""
    values = tracklet.poses[row]
    rx, ry, rz = values[3:]
    pose = np.eye(4)
    pose[:3, :3] = rotation_about(2, rz) @ rotation_about(1, ry) @ rotation_about(0, rx)
    pose[:3, 3] = values[:3] + pose[:3, 2] * tracklet.size_m[2] / 2
    return pose


class _BoundedBuilder(ET.TreeBuilder):
    """Stops at more elements, or deeper ones, than a drive has."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path, self._depth, self._count = path, 0, 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ET.Element:
        self._depth, self._count = self._depth + 1, self._count + 1
        if self._depth > _MAX_DEPTH or self._count > _MAX_ELEMENTS:
            raise AdapterError(
                f"{self._path} is nested deeper than {_MAX_DEPTH} elements, or has more than "
                f"{_MAX_ELEMENTS} of them; no drive has that"
            )
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ET.Element:
        self._depth -= 1
        return super().end(tag)


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
    parser = ET.XMLParser(target=_BoundedBuilder(path))
    try:
        parser.feed(text)
        root = parser.close()
    except ET.ParseError as error:
        raise AdapterError(f"{path} is not whole XML ({error}); copy it again") from None
    if root.find("tracklets") is None:
        raise AdapterError(f"{path} has no <tracklets>; copy it from the dataset")
    return root


def _tracklet(item: ET.Element, where: str) -> Tracklet:
    size = np.array([_number(item, name, where) for name in ("l", "w", "h")])
    if not (size > 0).all():
        raise AdapterError(f"{where}: l, w, h must be metres > 0; got {size.tolist()}")
    first = _number(item, "first_frame", where)
    if first % 1 or not 0 <= first <= _LAST_FRAME:
        raise AdapterError(f"{where}: first_frame must be a frame's number; got {first:g}")
    rows = item.findall("./poses/item")
    poses = [[_number(row, name, where) for name in _POSE] for row in rows]
    attributes = [
        [np.nan if row.find(name) is None else _number(row, name, where) for name in ATTRIBUTES]
        for row in rows
    ]
    return Tracklet(
        label=(item.findtext("objectType") or "").strip() or "unknown",
        size_m=size,
        first_frame=int(first),
        poses=np.array(poses, np.float64).reshape(-1, len(_POSE)),
        attributes=np.array(attributes, np.float64).reshape(-1, len(ATTRIBUTES)),
    )


def _number(element: ET.Element, name: str, where: str) -> float:
    text = element.findtext(name)
    try:
        value = float(text) if text is not None else np.nan
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise AdapterError(f"{where}: <{name}> must hold a finite number; got {text!r}")
    return value


@dataclass(frozen=True, eq=False)
class ObjectLines:
    """The objects of a file. rows: their lines' numbers, from 0. labels: their types. values:
    float64 [B, 14], the columns after the type. scores: float64 [B], NaN without one. dont_care:
    how many lines are regions."""

    rows: tuple[int, ...]
    labels: tuple[str, ...]
    values: np.ndarray
    scores: np.ndarray
    dont_care: int


def read_object_lines(path: Path) -> ObjectLines:
    """The objects of a label file."""
    rows, labels, values, dont_care = [], [], [], 0
    for row, line in enumerate(read_text(path).splitlines()):
        words = line.split()
        if not words:
            continue
        if words[0] == "DontCare":
            dont_care += 1
            continue
        rows.append(row)
        labels.append(words[0])
        values.append(_object_numbers(words, f"{path}, line {row + 1}"))
    table = np.array(values, np.float64).reshape(-1, _COLUMNS)
    return ObjectLines(tuple(rows), tuple(labels), table[:, :-1], table[:, -1], dont_care)


def boxes_of_lines(lines: ObjectLines, velodyne_from_rectified: np.ndarray) -> Boxes:
    """The objects as boxes in the Velodyne's frame. A track_id is the line's number from 0.
    Attributes: truncated, occluded, alpha, bbox_left, bbox_top, bbox_right, bbox_bottom as in the
    file, and score where a line has one, float64."""
    height, width, length = lines.values[:, 7:10].T
    heading = lines.values[:, 13]
    zero, one = np.zeros_like(heading), np.ones_like(heading)
    forward = np.stack([np.cos(heading), zero, -np.sin(heading)], axis=1)
    up = np.stack([zero, -one, zero], axis=1)
    rectified_from_box = np.stack([forward, np.cross(up, forward), up], axis=2)
    centres = lines.values[:, 10:13] + up * height[:, None] / 2
    turn = velodyne_from_rectified[:3, :3]
    attributes = {name: lines.values[:, i].copy() for i, name in enumerate(_OBJECT_ATTRIBUTES)}
    if np.isfinite(lines.scores).any():
        attributes["score"] = lines.scores
    return Boxes(
        track_ids=tuple(map(str, lines.rows)),
        labels=lines.labels,
        centers_m=centres @ turn.T + velodyne_from_rectified[:3, 3],
        sizes_m=np.stack([length, width, height], axis=1),
        quats=quat_from_rotmat(torch.from_numpy(turn @ rectified_from_box)).numpy(),
        attributes=attributes,
    )


def _object_numbers(words: list[str], where: str) -> np.ndarray:
    """The numbers after the type, the score last, NaN without one: float64 [15]."""
    if len(words) not in (_COLUMNS, _COLUMNS + 1):
        raise AdapterError(
            f"{where}: expected a type and 14 numbers, and maybe a score; got {len(words)} words"
        )
    numbers = parse_numbers(" ".join(words[1:]), where)
    if min(numbers[7:10]) <= 0:
        raise AdapterError(f"{where}: h, w, l must be metres > 0; got {numbers[7:10].tolist()}")
    return numbers if len(numbers) == _COLUMNS else np.append(numbers, np.nan)


# ---- The scene -----------------------------------------------------------------------------------

ICP = "icp"
_LIDAR_TOP_DEG = 2.0  # the HDL-64E's uppermost channel
# The recording car around its Velodyne: in measured sweeps all returns within 2.6 m of it that no
# neighbour made.
_EGO_LOW_M, _EGO_HIGH_M = np.array([-2.0, -1.35, -1.5]), np.array([2.6, 1.35, 0.5])
_READERS = 4  # threads that decode; decoding releases the interpreter


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
        options,
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
    """The camera's images `names` of the frames, all decoded once to be sure of them, and their
    width and height: `size` by the calibration, else that of most images."""
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
    chosen = options.select([number], where=f"kitti:{root}, frame {number}")
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
