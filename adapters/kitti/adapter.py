"""Scenes of raw KITTI drives and of single frames of KITTI's object benchmark.

A scene is made of Gaussians from accumulated, image-coloured LiDAR. `open_kitti` makes the scene of
a folder, `kitti_labels` its labels.

World: for a raw drive that of its poses, recentred if it is far. GPS/IMU poses have Mercator
metres, x east, y north; a file or registered sweeps have the world of the first frame. The world of
a single frame without poses, and of an object frame, is the Velodyne's frame. Ego: the Velodyne, x
forward, y left, z up, 1.73 m above the road. Tracklets that move are actors. The Velodyne looks 2
degrees up at most, so anything higher is part of the sky.
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
    Size,
    frame_times,
    is_object_folder,
    kitti_root,
    list_numbered_files,
    odometry_poses,
    oxts_poses,
    read_object_calibration,
    read_raw_calibration,
    read_returns,
    read_times,
    read_velodyne_from_imu,
    registered_poses,
    resolve_file,
    rotation_about,
)
from adapters.kitti.unsynced import (
    is_unsynced,
    match_images,
    pose_path,
    poses_at_sweeps,
    unsynced_times,
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
    describe_frames,
    drive_origin,
    find_objects,
    is_in_box,
    recenter_pose,
    scene_of_drive,
    stored_records,
    usable_images,
)
from adapters.recorded_lenses import UNDISTORTED_LENS, LensChoice, split_lenses
from adapters.uri import format_uri
from augment.errors import AdapterError
from augment.files.image_size import read_image_header
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid, quat_from_rotmat
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Scene

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
# Elements of a tracklet that hold its box's size.
_SIZE_COLUMNS = ("l", "w", "h")
# Elements of a pose: the middle of the box's bottom, and rotations about x, y, z.
_POSE_COLUMNS = ("tx", "ty", "tz", "rx", "ry", "rz")
# Columns of the table of tracklets.
_TRACKLET_COLUMNS = ("number", "label", "frame", *_SIZE_COLUMNS, *_POSE_COLUMNS, *ATTRIBUTES)
# Largest file of tracklets.
_MAX_BYTES = 64 * 2**20
# Largest number of tags in it.
_MAX_TAGS = 8_000_000
# The document type of KITTI's files. It declares nothing.
_ALLOWED_DOCTYPE = re.compile(r"<!DOCTYPE\s+boost_serialization\s*>")
# Largest frame number that a tracklet may have.
_MAX_FRAME_NUMBER = 10**9
# Columns of a label file of the object benchmark.
_OBJECT_COLUMNS = (
    "type", "truncated", "occluded", "alpha", "bbox_left", "bbox_top", "bbox_right", "bbox_bottom",
    "h", "w", "l", "x", "y", "z", "rotation_y", "score",
)  # fmt: skip
# Columns of a sweep's file.
_RECORD_COLUMNS = ("x", "y", "z", "intensity")


@dataclass(frozen=True, eq=False)
class KittiLabels:
    """Labels of a raw drive, or of one frame of the object benchmark.

    Sweeps have the columns x y z (float64 metres), intensity (the file's reflectance, 0 to 1) and
    timestamp_ns (the frame's: the file has none), in the file's order.

    Attributes:
        root: the folder.
        sweeps: files relative to the root, by frame.
        timestamps_ns: times by frame.
        world_from_velodyne: float64 [4, 4] in the dataset's world, by frame. Frames without one
            have no labels.
        tracklets: boxes of a raw drive, as `read_tracklets` returns them.
        velodyne_from_rectified: float64 [4, 4] of an object folder, whose boxes are in label_2/.
            None for a raw drive.
    """

    root: Path
    sweeps: Mapping[int, str]
    timestamps_ns: Mapping[int, int]
    world_from_velodyne: Mapping[int, np.ndarray]
    tracklets: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=_TRACKLET_COLUMNS))
    velodyne_from_rectified: np.ndarray | None = None

    def boxes(self, frame_index: int) -> Boxes:
        """Return the boxes of a frame."""
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
        """Return a frame's sweep in the world.

        The result is None without a file or a pose, and if the file is damaged; then the scene's
        problems say so.
        """
        pose = self.world_from_velodyne.get(frame_index)
        if pose is None or frame_index not in self.sweeps:
            return None
        try:
            returns = read_returns(self.root, self.sweeps[frame_index])
        except AdapterError:
            return None
        with np.errstate(invalid="ignore", over="ignore"):  # of returns that are not finite
            world_points = returns[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        columns = {axis: np.ascontiguousarray(world_points[:, i]) for i, axis in enumerate("xyz")}
        columns["intensity"] = returns[:, 3].copy()
        columns["timestamp_ns"] = np.full(
            len(world_points), self.timestamps_ns[frame_index], np.int64
        )
        return LidarSweep(columns)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Return the Velodyne's position in the frame's pose, once per return, float64 [N, 3].

        The car's motion within the turn of 0.1 s is ignored here, as it is in the returns.
        """
        pose = self.world_from_velodyne.get(frame_index)
        return None if pose is None else np.broadcast_to(pose[:3, 3], (len(sweep), 3))

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """Return the frame's file, if it exists and the frame has a pose."""
        if frame_index not in self.sweeps or frame_index not in self.world_from_velodyne:
            return ()
        file = resolve_file(self.root, self.sweeps[frame_index])
        return (file,) if file.exists() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """Return the content of a file that holds a weathered sweep instead of the recorded one."""
        records = read_returns(self.root, self.sweeps[frame_index])
        content = stored_records(
            records, _RECORD_COLUMNS, sweep, self.world_from_velodyne[frame_index]
        )
        if file.suffix.lower() != ".txt":
            return content
        rows = np.frombuffer(content, "<f4").reshape(-1, len(_RECORD_COLUMNS))
        return "".join("{:.6f} {:.6f} {:.6f} {:.6f}\n".format(*row) for row in rows).encode()


def object_label_file(root: Path, frame: int) -> Path:
    """Return the path of a frame's label file, which need not exist."""
    return resolve_file(root, f"label_2/{frame:0{OBJECT_DIGITS}d}.txt")


def read_tracklets(root: Path) -> pd.DataFrame | None:
    """Read the boxes of the drive's tracklets, one a row.

    The columns are the number of the tracklet in the file from 0, label, frame, size, pose of the
    middle of the bottom, and ATTRIBUTES, NaN where the file has none. Without the file the result
    is None.
    """
    path = resolve_file(root, TRACKLETS)
    if not path.exists():
        return None
    rows = []
    for number, item in enumerate(_parse_xml(path).findall("./tracklets/item")):
        where = f"{path}: tracklet {number}"
        *size_m, first_frame = (
            _number(item, name, where) for name in ("l", "w", "h", "first_frame")
        )
        if min(size_m) <= 0:
            raise AdapterError(f"{where}: l, w, h must be metres > 0; got {size_m}")
        if first_frame % 1 or not 0 <= first_frame <= _MAX_FRAME_NUMBER:
            raise AdapterError(
                f"{where}: first_frame must be a frame's number; got {first_frame:g}"
            )
        label = (item.findtext("objectType") or "").strip() or "unknown"
        for frame, pose in enumerate(item.findall("./poses/item"), start=int(first_frame)):
            numbers = [_number(pose, name, where) for name in _POSE_COLUMNS]
            attributes = [_number(pose, name, where, otherwise=np.nan) for name in ATTRIBUTES]
            rows.append((number, label, frame, *size_m, *numbers, *attributes))
    return pd.DataFrame(rows, columns=_TRACKLET_COLUMNS)


def _number(element: ET.Element, name: str, where: str, *, otherwise: float | None = None) -> float:
    """Return the finite number in an element. otherwise: the value if there is no such element."""
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
    """Return the boxes of a frame in the world of the pose.

    A track_id is the tracklet's number in the file. The attributes are ATTRIBUTES, float64.
    """
    rows = tracklets[tracklets["frame"] == frame]
    sizes_m = rows[[*_SIZE_COLUMNS]].to_numpy(np.float64)
    world_from_box = np.empty((len(rows), 4, 4))
    for i, (x, y, z, rx, ry, rz) in enumerate(rows[[*_POSE_COLUMNS]].to_numpy(np.float64)):
        pose = np.eye(4)
        pose[:3, :3] = rotation_about(2, rz) @ rotation_about(1, ry) @ rotation_about(0, rx)
        pose[:3, 3] = [x, y, z] + pose[:3, 2] * sizes_m[i, 2] / 2  # of the middle
        world_from_box[i] = world_from_velodyne @ pose
    return Boxes(
        track_ids=tuple(map(str, rows["number"])),
        labels=tuple(rows["label"]),
        centers_m=np.ascontiguousarray(world_from_box[:, :3, 3]),
        sizes_m=np.ascontiguousarray(sizes_m),
        quats=quat_from_rotmat(torch.from_numpy(world_from_box[:, :3, :3].copy())).numpy(),
        attributes={name: rows[name].to_numpy(np.float64, copy=True) for name in ATTRIBUTES},
    )


def _parse_xml(path: Path) -> ET.Element:
    """Return the root element of a file of bounded size. Nothing in it is expanded or fetched."""
    if path.stat().st_size > _MAX_BYTES:
        raise AdapterError(f"{path} is larger than {_MAX_BYTES // 2**20} MiB; no drive has that")
    text = _ALLOWED_DOCTYPE.sub("", read_text(path), count=1)
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
    """Read the objects of a label file, indexed by the lines' numbers from 0.

    The columns are `type` and numbers; score is NaN for lines without one. DontCare lines are
    included, but only their type is read.
    """
    rows = {}
    for number, line in enumerate(read_text(path).splitlines()):
        words = line.split()
        where = f"{path}, line {number + 1}"
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
    """Return the objects of a label file as boxes in the Velodyne's frame.

    A track_id is the line's number from 0. Attributes, float64: truncated, occluded, alpha,
    bbox_left, bbox_top, bbox_right, bbox_bottom as in the file, and score if a line has one.
    """
    lines = lines[lines["type"] != "DontCare"]
    values = lines.drop(columns="type").to_numpy(np.float64)
    height, width, length = values[:, 7:10].T
    heading = values[:, 13]
    zeros = np.zeros_like(heading)
    ones = np.ones_like(heading)
    forward = np.stack([np.cos(heading), zeros, -np.sin(heading)], axis=1)
    up = np.stack([zeros, -ones, zeros], axis=1)
    rectified_from_box = np.stack([forward, np.cross(up, forward), up], axis=2)
    centres = values[:, 10:13] + up * height[:, None] / 2
    rotation = velodyne_from_rectified[:3, :3]
    names = _OBJECT_COLUMNS[1:8] + (("score",) if lines["score"].notna().any() else ())
    return Boxes(
        track_ids=tuple(map(str, lines.index)),
        labels=tuple(lines["type"]),
        centers_m=centres @ rotation.T + velodyne_from_rectified[:3, 3],
        sizes_m=np.stack([length, width, height], axis=1),
        quats=quat_from_rotmat(torch.from_numpy(rotation @ rectified_from_box)).numpy(),
        attributes={name: lines[name].to_numpy(np.float64, copy=True) for name in names},
    )


# ---- The scene -----------------------------------------------------------------------------------

# Value of poses= that asks for registration of the sweeps.
ICP = "icp"
# Elevation of the HDL-64E's uppermost channel.
_LIDAR_TOP_DEG = 2.0
# Least and greatest corner of the recording car around its Velodyne. In measured sweeps it encloses
# all returns within 2.6 m that no neighbouring object made.
_EGO_BOX_M = np.array([[-2.0, -1.35, -1.5], [2.6, 1.35, 0.5]])


class KittiOptions(DriveOptions):
    """Options of a KITTI scene.

    poses: where poses come from; the drive's GPS/IMU if it is missing. frame: the frame of an
    object folder; if it is missing the folder must have one frame only.
    """

    poses: str | None = Field(
        None,
        min_length=1,
        description="icp, or a file with a line of 12 numbers a frame (raw drives)",
    )
    frame: int | None = Field(None, ge=0, lt=10**9, description="a frame's number (object folders)")


def open_kitti(path: str, query: dict[str, str]) -> Scene:
    """Open the scene of a raw drive such as `2011_09_26/2011_09_26_drive_0001_sync`, or of an
    object frame.

    Opening is deterministic: the same files and options give the same bits.

    Args:
        path: the folder.
        query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out (see DriveOptions);
            for a drive poses=icp or poses=FILE, for an object folder frame=NUMBER.

    Raises:
        AdapterError: an option is wrong; calibration, poses, times or labels are missing or
            damaged; no sweep or image is usable. What single frames lack is listed in
            Scene.problems.
    """
    source, options = find_source(path, query)
    return scene_of_drive(read_kitti(path, query, source), options)


def read_kitti(path: str, query: dict[str, str], source: DriveSource) -> RawDrive:
    """Read the source's frames with their images, sweeps and boxes."""
    labels = source.labels
    calibration = source.calibration
    pictures = [
        Picture(name, n, resolve_file(labels.root, files[n]) if n in files else None, camera.size)
        for name, camera in calibration.cameras.items()
        for n in source.selection.numbers
        for files in [source.images[name]]
    ]
    images = usable_images(pictures)
    recorded_frames = tuple(_frame(source, images, number) for number in source.selection.numbers)
    lens_frames = split_lenses(
        source.name,
        recorded_frames,
        source.lens,
        published="KITTI's images, rectified in all releases but that before synchronisation "
        "(`_extract`),",
    )
    frames = lens_frames.frames
    used = [frame for frame in frames if frame.index not in source.selection.held_out]
    sweeps, sweep_problems = _read_sweeps(labels, used)
    objects = find_objects(
        (TimedBoxes(f.index, labels.boxes(f.index), f.timestamp_ns) for f in frames),
        source.world_origin_m,
    )
    return RawDrive(
        name=source.name,
        source=format_uri("kitti", path, query),
        frames=frames,
        held_out=source.selection.held_out,
        sweeps=sweeps,
        boxes=objects.moving_boxes,
        labels=labels,
        world_origin_m=source.world_origin_m,
        lidar_top_deg=_LIDAR_TOP_DEG,
        problems=(
            *source.problems,
            *lens_frames.notes,
            *images.problems,
            *sweep_problems,
            *objects.problems,
        ),
        recorded_frames=lens_frames.recorded_frames,
    )


def kitti_labels(path: str, query: dict[str, str]) -> KittiLabels:
    """Return the labels alone, in the world that `open_kitti` with this query has before
    recentring.
    """
    return find_source(path, query)[0].labels


def _read_sweeps(
    labels: KittiLabels, frames: Sequence[Frame]
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """Read the usable returns of the frames in the scene's world."""
    missing = [frame.index for frame in frames if frame.index not in labels.sweeps]
    problems = [f"{describe_frames(missing)} without a sweep"] if missing else []
    sweeps = []
    for frame in tqdm(frames, desc="LiDAR", unit="frame", disable=None):
        if frame.index not in labels.sweeps:
            continue
        try:
            points = read_returns(labels.root, labels.sweeps[frame.index])[:, :3].astype(np.float64)
        except AdapterError as error:
            problems.append(f"frame {frame.index}: {error}")
            continue
        is_finite = np.isfinite(points).all(axis=1)
        num_not_finite = int((~is_finite).sum())
        if num_not_finite:
            problems.append(
                f"frame {frame.index}: left out {num_not_finite} returns that are not finite"
            )
        points = points[is_finite & ~is_in_box(points, *_EGO_BOX_M)]
        pose = frame.world_from_ego.numpy()
        with np.errstate(over="ignore"):
            world_points = points @ pose[:3, :3].T + pose[:3, 3]
            origins = np.broadcast_to(pose[:3, 3], world_points.shape)
            sweeps.append(Sweep.of_unknown_class(world_points, frame.timestamp_ns, origins))
    return tuple(sweeps), tuple(problems)


def _frame(source: DriveSource, images: DriveImages, number: int) -> Frame:
    """Return a frame with all cameras of the calibration."""
    pose = recenter_pose(source.labels.world_from_velodyne[number], source.world_origin_m)
    time = source.labels.timestamps_ns[number]

    def velodyne_from_world(name: str) -> torch.Tensor:
        image_pose = source.image_poses.get(name, {}).get(number)
        if image_pose is None:
            return invert_rigid(pose)
        return invert_rigid(recenter_pose(image_pose, source.world_origin_m))

    return Frame(
        index=number,
        timestamp_ns=time,
        world_from_ego=pose,
        cameras={
            name: Camera(
                name,
                *images.sizes[name],
                *camera.lens,
                camera_from_world=torch.from_numpy(camera.camera_from_velodyne)
                @ velodyne_from_world(name),
                lens=camera.distortion,
                timestamp_ns=source.image_times_ns.get(name, {}).get(number, time),
            )
            for name, camera in source.calibration.cameras.items()
        },
        image_paths=images.paths.get(number, {}),
    )


@dataclass(frozen=True, eq=False)
class DriveSource:
    """Contents of a folder for the selected frames, before images are decoded.

    Attributes:
        name: name of the scene.
        selection: the scene's frames, all with a pose.
        calibration: calibration of the cameras.
        images: names of the files by camera and frame.
        image_times_ns: times by camera and frame, if the camera has its own.
        labels: labels of all frames with poses, in the dataset's world.
        world_origin_m: float64 [3], subtracted from the dataset's coordinates.
        problems: one sentence each.
        image_poses: world_from_velodyne at the times of images, by camera and frame, where it is
            another than the frame's.
        lens: the option of that name.
    """

    name: str
    selection: DriveFrames
    calibration: Calibration
    images: Mapping[str, Mapping[int, str]]
    image_times_ns: Mapping[str, Mapping[int, int]]
    labels: KittiLabels
    world_origin_m: np.ndarray
    problems: tuple[str, ...]
    image_poses: Mapping[str, Mapping[int, np.ndarray]] = field(default_factory=dict)
    lens: LensChoice = UNDISTORTED_LENS


def find_source(path: str, query: dict[str, str]) -> tuple[DriveSource, KittiOptions]:
    """Return the contents of the folder that the URI names, and its options."""
    root, calibration = kitti_root(path)
    is_object = is_object_folder(root)
    options = KittiOptions.from_query("kitti", query)
    if (unsupported_option := "poses" if is_object else "frame") in query:
        data_kind = "an object folder, whose frames are unrelated" if is_object else "a raw drive"
        meaning = KittiOptions.model_fields[unsupported_option].description
        raise AdapterError(
            f"kitti: {unsupported_option}= means nothing for {data_kind}; it is {meaning}"
        )
    source = (_object_source if is_object else _raw_source)(root, calibration, options)
    return replace(source, lens=options.lens), options


def _raw_source(root: Path, calibration_folder: Path, options: KittiOptions) -> DriveSource:
    """Return the contents of a raw drive."""
    sweeps = list_numbered_files(root, f"{VELODYNE}/data", (".bin",), RAW_DIGITS)
    if not sweeps:
        sweeps = list_numbered_files(root, f"{VELODYNE}/data", (".txt",), RAW_DIGITS)
    images, problems = _raw_images(root)
    image_times = {name: read_times(root, name) for name in images}
    has_unsynced_files = is_unsynced(sweeps)
    numbers = sorted(set(sweeps).union(*images.values()))
    if has_unsynced_files:
        numbers = sorted(set(sweeps) & set(unsynced_times(root, VELODYNE)))
    if not sweeps:
        raise AdapterError(
            f"{root / VELODYNE / 'data'} holds no sweep NNNNNNNNNN.bin or .txt; a scene "
            f"cannot be built without them, unpack the drive again"
        )
    selection = options.select(numbers, where=f"kitti:{root}")
    calibration = read_raw_calibration(calibration_folder, _image_sizes(root, images))
    known_times = read_times(root, VELODYNE) or next(filter(None, image_times.values()), {})
    times, time_problems = frame_times(root, known_times, numbers)
    poses = _raw_poses(root, calibration_folder, calibration, options, numbers, selection, sweeps)
    image_poses: dict[str, dict[int, np.ndarray]] = {}
    if has_unsynced_files:
        sweep_times = {number: times[number] for number in numbers}
        has_packets = options.poses is None and len(selection.numbers) > 1
        pose_times = unsynced_times(root, "oxts") if has_packets else sweep_times
        path = pose_path(poses.world_from_velodyne, pose_times)
        if has_packets:
            poses = poses_at_sweeps(path, sweep_times, poses)
        images, image_times, match_problems = match_images(
            root,
            images,
            {name: unsynced_times(root, name) for name in images},
            {number: times[number] for number in selection.numbers},
        )
        image_poses = {
            name: {n: pose for n, t in of_camera.items() if (pose := path.at(t)) is not None}
            for name, of_camera in image_times.items()
        }
        problems = (*problems, *match_problems)
    world_from_velodyne = poses.world_from_velodyne
    tracklets = None if has_unsynced_files else read_tracklets(root)
    labels = KittiLabels(root, sweeps, times, world_from_velodyne)
    if tracklets is not None:
        labels = replace(labels, tracklets=tracklets)
    missing_frames = [number for number in selection.numbers if number not in world_from_velodyne]
    problems = (
        *problems,
        *selection.problems,
        *time_problems,
        *poses.problems,
        *(
            (f"left out {describe_frames(missing_frames)}: no pose is known",)
            if missing_frames
            else ()
        ),
        *(() if tracklets is not None else (_no_boxes_note(root, has_unsynced_files),)),
    )
    frames_with_pose = DriveFrames(
        tuple(n for n in selection.numbers if n in world_from_velodyne), selection.held_out
    )
    if not frames_with_pose.used:
        raise AdapterError(
            f"{root}: no pose is known of any of {describe_frames(selection.used)}"
            + "".join(f"; {problem}" for problem in poses.problems[:3])
        )
    return DriveSource(
        root.absolute().name,
        frames_with_pose,
        calibration,
        images,
        image_times,
        labels,
        drive_origin(np.stack([pose[:3, 3] for _, pose in sorted(world_from_velodyne.items())])),
        problems,
        image_poses,
    )


def _no_boxes_note(root: Path, has_unsynced_files: bool) -> str:
    """Return the sentence on a drive without boxes."""
    if has_unsynced_files:
        return (
            f"{root} is a drive before synchronisation: tracklets count the frames of the "
            f"synchronised release, so no boxes are known"
        )
    return f"{root} has no {TRACKLETS}: no boxes are known"


def _image_sizes(root: Path, images: Mapping[str, Mapping[int, str]]) -> dict[str, Size | None]:
    """Return width and height of each camera's first image that has a header; None without."""
    sizes: dict[str, Size | None] = {}
    for name, files in images.items():
        headers = (read_image_header(resolve_file(root, file)) for file in files.values())
        header = next((header for header in headers if header is not None), None)
        sizes[name] = None if header is None else header.size
    return sizes


def _raw_images(root: Path) -> tuple[dict[str, dict[int, str]], tuple[str, ...]]:
    """Return the files of the colour cameras, or else of the grey ones, by camera and frame."""
    for cameras in (COLOUR_CAMERAS, GREY_CAMERAS):
        files_by_camera = {
            name: list_numbered_files(root, f"{name}/data", IMAGE_SUFFIXES, RAW_DIGITS)
            for name in cameras
        }
        images = {name: files for name, files in files_by_camera.items() if files}
        if images:
            empty_cameras = [n for n in cameras if (root / n).is_dir() and n not in images]
            return images, tuple(
                f"camera {n}: {root / n / 'data'} holds no image" for n in empty_cameras
            )
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
    selection: DriveFrames,
    sweeps: Mapping[int, str],
) -> Poses:
    """Return the poses that the options ask for."""
    if options.poses == ICP:
        return _register_sweeps(root, selection, sweeps)
    if options.poses is not None:
        path = Path(options.poses).expanduser()
        return odometry_poses(path, numbers, calibration.rectified_from_velodyne)
    oxts = list_numbered_files(root, "oxts/data", (".txt",), RAW_DIGITS)
    if oxts:
        return oxts_poses(root, oxts, read_velodyne_from_imu(calibration_folder))
    if len(selection.numbers) == 1:
        return Poses({selection.numbers[0]: np.eye(4)})
    raise AdapterError(
        f"{root} has no poses (oxts/data/NNNNNNNNNN.txt) for {describe_frames(selection.numbers)}. "
        f"Copy the drive's oxts/ there; or give ?poses=FILE, a line of 12 numbers a frame as of "
        f"KITTI's odometry; or ?poses=icp, which registers the sweeps; or one frame, "
        f"?frames={selection.numbers[0]}:{selection.numbers[0] + 1}, which needs none"
    )


def _register_sweeps(root: Path, selection: DriveFrames, sweeps: Mapping[int, str]) -> Poses:
    """Return poses from registering the sweeps, with a sentence for each sweep that cannot be
    read.
    """
    problems: list[str] = []

    def read_sweep(number: int) -> np.ndarray | None:
        if number not in sweeps:
            return None
        try:
            return read_returns(root, sweeps[number])
        except AdapterError as error:
            problems.append(f"frame {number}: {error}")
            return None

    poses = registered_poses(selection.numbers, read_sweep)
    return Poses(poses.world_from_velodyne, (*problems, *poses.problems))


def _object_source(root: Path, calibration_folder: Path, options: KittiOptions) -> DriveSource:
    """Return the contents of an object folder for one frame."""
    sweeps = list_numbered_files(root, "velodyne", (".bin",), OBJECT_DIGITS)
    images = {
        n: list_numbered_files(root, n, IMAGE_SUFFIXES, OBJECT_DIGITS) for n in OBJECT_CAMERAS
    }
    number = _choose_object_frame(root, options.frame, sorted(set(sweeps).union(*images.values())))
    digits = f"{number:0{OBJECT_DIGITS}d}"
    images = {name: {number: files[number]} for name, files in images.items() if number in files}
    problems = []
    if number not in sweeps:
        problems.append(f"{root / 'velodyne' / digits}.bin does not exist")
    if not images:
        problems.append(f"{root / 'image_2' / digits}.png does not exist, nor in image_3/")
    selection = options.select([number], where=f"kitti:{root}, frame {number}")
    calibration = read_object_calibration(calibration_folder, digits, images)
    labels = KittiLabels(
        root,
        {number: sweeps[number]} if number in sweeps else {},
        {number: 0},
        {number: np.eye(4)},
        velodyne_from_rectified=np.linalg.inv(calibration.rectified_from_velodyne),
    )
    path = object_label_file(root, number)
    problems += selection.problems
    if not path.exists():
        problems.append(f"{path} does not exist: no boxes are known")
    elif num_ignored := int((read_object_lines(path)["type"] == "DontCare").sum()):
        problems.append(
            f"{path}: {num_ignored} regions marked DontCare have no 3D box; boxes are without them"
        )
    return DriveSource(
        digits, selection, calibration, images, {}, labels, np.zeros(3), tuple(problems)
    )


def _choose_object_frame(root: Path, frame: int | None, numbers: list[int]) -> int:
    """Return the selected frame, or the only one, of an object folder."""
    digits = [f"{n:0{OBJECT_DIGITS}d}" for n in numbers]
    examples = ", ".join(digits[:3]) + (", ..." if len(digits) > 3 else "")
    if not numbers:
        raise AdapterError(f"{root} holds neither velodyne/NNNNNN.bin nor image_2/NNNNNN.png")
    if frame is None and len(numbers) > 1:
        raise AdapterError(
            f"{root} holds {len(numbers)} unrelated frames ({examples}); a scene is one of them, "
            f"give ?frame={digits[0]}"
        )
    if frame is not None and frame not in numbers:
        raise AdapterError(
            f"{root} has no frame {frame:0{OBJECT_DIGITS}d}; it has {len(numbers)}: {examples}"
        )
    return numbers[0] if frame is None else frame
