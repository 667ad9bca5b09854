"""A raw PandaSet sequence as a scene: Gaussians from accumulated, image-coloured LiDAR.

    camera/<name>/NN.jpg            undistorted images; intrinsics.json, poses.json, timestamps.json
    lidar/NN.pkl.gz                 returns of both sensors; poses.json, timestamps.json
    annotations/cuboids/NN.pkl.gz   boxes
    annotations/semseg/NN.pkl.gz    class of each return; classes.json

World: PandaSet's own (metres, z up), unless the drive is further than a kilometre from its origin.
Ego: the LiDAR pose (x right, y forward, z up) turned by a quarter about z, so that x is forward, y
left; its origin is the pose's. Camera poses are world_from_camera with OpenCV axes. Times are
seconds, stored here as integer nanoseconds. One actor stands for each moving object, whichever
sensor's boxes it has; its track_id is the one that the object's boxes have in the labels. Errors
are AdapterErrors that name the file.
"""

from __future__ import annotations

import gzip
import io
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import pandas as pd
import torch
from pydantic import BaseModel, Field
from tqdm import tqdm

from adapters.lidar_scene.split import indices_between, inside_box
from adapters.plain_files import Number, check_image, read_json, validate_content
from adapters.raw_drive import (
    NO_SURFACE,
    BoxSample,
    DriveFrames,
    DriveOptions,
    Picture,
    RawDrive,
    Sweep,
    TimedBoxes,
    class_of_air,
    drive_origin,
    find_objects,
    is_usable,
    names_in,
    recenter_pose,
    scene_of_drive,
    usable_images,
    world_classes,
)
from adapters.recorded_lenses import no_lens_note
from adapters.safe_pickle import read_frame
from adapters.uri import format_uri
from augment.effects.lidar.codes import INDEX_COLUMN, is_in_air
from augment.errors import AdapterError
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid, rigid, rotmat_from_quat
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass, class_of_label

# The recording car in its own frame (x forward, y left, z up): no other surface can be in there.
EGO_M = np.array([[-3.0, -1.05, -1.0], [3.0, 1.05, 2.2]])
_TIMING_MARGIN_M = 0.25  # returns this near a box tell when its sensor saw the object
_LIDAR_TOP_DEG = 15.0  # the spinning sensor's uppermost channel
# The back camera looks over the recording car's own roof, the same in every PandaSet sequence:
# from this part of its rows downwards.
_ROWS_ABOVE_CAR = {"back_camera": 0.745}
LIDAR_COLUMNS = ("x", "y", "z", "i", "t", "d")
# Columns: ego x (forward), y (left), z in the axes of the LiDAR pose (x right, y forward).
LIDAR_POSE_FROM_EGO = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def open_pandaset(path: str, query: dict[str, str]) -> Scene:
    """Open the scene of one PandaSet sequence folder, such as `pandaset/002`.

    Opening is deterministic: the same files and options give the same bits.

    Args:
        path: the folder.
        query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out; see DriveOptions.

    Raises:
        AdapterError: an option is wrong, calibration is missing or damaged, a table is damaged, or
            there is no LiDAR. Missing LiDAR or annotation files and images of single frames are
            listed in Scene.problems.
    """
    options = DriveOptions.from_query("pandaset", query)
    return scene_of_drive(read_pandaset(path, query, options), options)


def read_pandaset(path: str, query: dict[str, str], options: DriveOptions) -> RawDrive:
    """Read the frames of the sequence that the options select, with their sweeps and boxes."""
    root = Path(path)
    frames, chosen, origin, problems = read_frames(root, options)
    sweeps, boxes, more = read_sweeps(root, frames, chosen.held_out, origin)
    return RawDrive(
        name=root.name,
        source=format_uri("pandaset", path, query),
        frames=frames,
        held_out=chosen.held_out,
        sweeps=sweeps,
        boxes=boxes,
        labels=PandaSetLabels(root),
        world_origin_m=origin,
        lidar_top_deg=_LIDAR_TOP_DEG,
        problems=(
            *problems,
            *chosen.problems,
            *more,
            *no_lens_note("PandaSet's images", options.lens),
        ),
        used_rows=_ROWS_ABOVE_CAR,
    )


# ---- Calibration, poses and times ----------------------------------------------------------------

# int64 nanoseconds reach 9.2e9 s.
_Seconds = Annotated[float, Field(strict=True, ge=-9e9, le=9e9, allow_inf_nan=False)]
_Focal = Annotated[Number, Field(gt=0)]


class _Xyz(BaseModel):
    x: Number
    y: Number
    z: Number


class _Wxyz(_Xyz):
    w: Number


class _Pose(BaseModel):
    position: _Xyz
    heading: _Wxyz


class _Lens(BaseModel):
    fx: _Focal
    fy: _Focal
    cx: Number
    cy: Number


class _CameraTrack(NamedTuple):
    """One camera over the sequence.

    Attributes:
        lens, size: intrinsics, and (width, height), in pixels.
        world_from_camera: float64 [F, 4, 4] in the dataset's world.
        timestamps_ns: int64 [F], times of its images.
    """

    lens: _Lens
    size: tuple[int, int]
    world_from_camera: np.ndarray
    timestamps_ns: np.ndarray


def read_frames(
    root: Path, options: DriveOptions
) -> tuple[tuple[Frame, ...], DriveFrames, np.ndarray, tuple[str, ...]]:
    """Read the frames that the options select, with their usable images, in the scene's world.

    Returns:
        The frames; their numbers; the world's origin in the dataset's; and a sentence for each
        unusable image.
    """
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a PandaSet sequence such as .../002")
    world_from_ego, times_ns = read_ego_track(root)
    chosen = options.select(range(len(times_ns)), where=f"pandaset:{root}")
    has_images = any((root / "camera").glob("*/*.jpg"))
    folders = sorted(p for p in (root / "camera").iterdir() if p.is_dir()) if has_images else []
    missing = () if folders else (f"{root / 'camera'} holds no images <camera>/NN.jpg",)
    cameras = {folder.name: _read_camera(folder, len(times_ns)) for folder in folders}
    pictures = [
        Picture(folder.name, n, folder / f"{n:02d}.jpg", cameras[folder.name].size)
        for folder in folders
        for n in chosen.numbers
    ]
    images = usable_images(pictures, every_camera=False)
    origin = drive_origin(world_from_ego[:, :3, 3])
    frames = tuple(
        Frame(
            index=n,
            timestamp_ns=int(times_ns[n]),
            world_from_ego=recenter_pose(world_from_ego[n], origin),
            cameras={
                name: Camera(
                    name,
                    *camera.size,
                    **camera.lens.model_dump(),
                    camera_from_world=invert_rigid(
                        recenter_pose(camera.world_from_camera[n], origin)
                    ),
                    timestamp_ns=int(camera.timestamps_ns[n]),
                )
                for name, camera in cameras.items()
            },
            image_paths=images.paths.get(n, {}),
        )
        for n in chosen.numbers
    )
    return frames, chosen, origin, missing + images.problems


def read_ego_track(root: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read world_from_ego [F, 4, 4] in the dataset's own world, and the times [F] of the sweeps'
    ends.

    The result is cached as long as the files stay unchanged.
    """
    files = [root / "lidar" / name for name in ("poses.json", "timestamps.json")]
    state = tuple((f.stat().st_mtime_ns, f.stat().st_size) if f.exists() else None for f in files)
    return _ego_track(root, state)


@lru_cache(maxsize=2)
def _ego_track(root: Path, state: object) -> tuple[np.ndarray, np.ndarray]:
    poses = _read_poses(root / "lidar" / "poses.json")
    return poses @ LIDAR_POSE_FROM_EGO, _read_times(root / "lidar" / "timestamps.json", len(poses))


def _read_camera(folder: Path, frames: int) -> _CameraTrack:
    path = folder / "intrinsics.json"
    lens = validate_content(_Lens, read_json(path), str(path))
    poses = _read_poses(folder / "poses.json")
    if len(poses) != frames:
        raise AdapterError(
            f"{folder / 'poses.json'} has {len(poses)} poses; lidar/poses.json has {frames}"
        )
    numbers = [int(p.stem) for p in folder.glob("*.jpg") if re.fullmatch(r"\d+", p.stem)]
    if not numbers:
        raise AdapterError(f"{folder} holds no images NN.jpg; unpack the sequence again")
    if max(numbers) >= frames:
        raise AdapterError(
            f"{folder} holds image {max(numbers):02d}.jpg, but timestamps.json ends with frame "
            f"{frames - 1:02d}: images and timestamps are not of one sequence"
        )
    headers = (check_image(folder / f"{n:02d}.jpg") for n in sorted(numbers))
    size = next((header.size for header in headers if not isinstance(header, str)), None)
    if size is None:
        raise AdapterError(f"{folder} holds no image that can be used; unpack the sequence again")
    return _CameraTrack(lens, size, poses, _read_times(folder / "timestamps.json", frames))


def _read_times(path: Path, expected: int) -> np.ndarray:
    """Read times in nanoseconds, int64 [expected]."""
    entries = enumerate(read_json(path, list))
    times = np.array(
        [validate_content(_Seconds, t, f"{path}, frame {n}, seconds") for n, t in entries]
    )
    if len(times) != expected:
        raise AdapterError(f"{path} has {len(times)} entries; there are {expected} LiDAR poses")
    if not (np.diff(times) > 0).all():
        frame = int(np.argmin(np.diff(times) > 0)) + 1
        raise AdapterError(
            f"{path} must be increasing; frame {frame} is at {times[frame]} s after "
            f"{times[frame - 1]} s. Correct the times in the file"
        )
    return np.round(times * 1e9).astype(np.int64)


def _read_poses(path: Path) -> np.ndarray:
    """Read rigid transforms, float64 [F, 4, 4]."""
    poses = [
        validate_content(_Pose, p, f"{path}, frame {n}")
        for n, p in enumerate(read_json(path, list))
    ]
    if not poses:
        raise AdapterError(f"{path} holds no poses")
    headings = np.array([(p.heading.w, p.heading.x, p.heading.y, p.heading.z) for p in poses])
    # Headings are stored to 16 digits; a norm off by a thousandth is no rotation.
    off = np.abs(np.linalg.norm(headings, axis=1) - 1) >= 1e-3
    if off.any():
        frame = int(np.argmax(off))
        raise AdapterError(
            f"{path}, frame {frame}: heading must be a unit quaternion w x y z; got "
            f"{headings[frame].tolist()}. Divide it by its length"
        )
    positions = np.array([(p.position.x, p.position.y, p.position.z) for p in poses])
    return rigid(rotmat_from_quat(torch.from_numpy(headings)), torch.from_numpy(positions)).numpy()


# ---- Tables --------------------------------------------------------------------------------------


def frame_file(root: Path, folder: str, frame: int) -> Path:
    """Return the path of a frame's table.

    folder: lidar, annotations/cuboids or annotations/semseg.
    """
    return root / folder / f"{frame:02d}.pkl.gz"


def read_lidar(root: Path, frame: int) -> pd.DataFrame | None:
    """Read the returns of a frame, columns x y z i t d as in the file, or None without a file."""
    path = frame_file(root, "lidar", frame)
    return _read_table(path, LIDAR_COLUMNS) if path.exists() else None


def read_semantics(root: Path, frame: int, rows: int) -> np.ndarray | None:
    """Read the class number of each return of the frame, int64 [rows], or None without a file."""
    path = frame_file(root, "annotations/semseg", frame)
    if not path.exists():
        return None
    classes = _read_table(path, ("class",))["class"].to_numpy()
    if len(classes) != rows:
        raise AdapterError(
            f"{path} must have a class for each of the {rows} returns in lidar/{frame:02d}.pkl.gz; "
            f"it has {len(classes)}"
        )
    return classes


def read_cuboids(root: Path, frame: int) -> pd.DataFrame | None:
    """Read the boxes of a frame with all their columns, or None without a file.

    Several steps of opening a drive ask for them: they are cached as long as the file stays
    unchanged, and callers must not change them.
    """
    path = frame_file(root, "annotations/cuboids", frame)
    if not path.exists():
        return None
    status = path.stat()
    return _read_cuboids(path, (status.st_mtime_ns, status.st_size))


@lru_cache(maxsize=128)  # tables of some 30 kB
def _read_cuboids(path: Path, state: tuple[int, int]) -> pd.DataFrame:
    needed = ("uuid", "label", "yaw", "stationary")
    needed += tuple(f"{group}.{axis}" for group in ("position", "dimensions") for axis in "xyz")
    return _read_table(path, needed)


def _read_table(path: Path, needed: tuple[str, ...]) -> pd.DataFrame:
    table = read_frame(path)
    missing = [name for name in needed if name not in table.columns]
    if missing:
        raise AdapterError(f"{path} lacks the columns {missing}; it has {list(table.columns)}")
    return table


# ---- Sweeps, and when their sensors saw the boxes ------------------------------------------------


def read_sweeps(
    root: Path, frames: Sequence[Frame], held_out: frozenset[int], origin: np.ndarray
) -> tuple[tuple[Sweep, ...], tuple[BoxSample, ...], tuple[str, ...]]:
    """Read usable sweeps of frames that are not held out, the boxes of moving objects, and
    problems.

    Returns of smoke, exhaust, spray, mirror images and the recording car are left out. The boxes
    are those of all frames; held-out sweeps only give the times at which their boxes were seen.
    Problems are a sentence for each missing file.
    """
    meaning = class_meanings(root)
    cuboids = {frame.index: read_cuboids(root, frame.index) for frame in frames}
    moving = _moving_boxes(root, frames, cuboids, origin)
    ego_track = read_ego_track(root)
    sweeps = []
    boxes = []
    problems = []
    for frame in tqdm(frames, desc="LiDAR", unit="frame", disable=None):
        n = frame.index
        lidar = read_lidar(root, n)
        if lidar is None:
            problems.append(f"frame {n}: lidar/{n:02d}.pkl.gz is missing, its points too")
        else:
            world = lidar[["x", "y", "z"]].to_numpy(dtype=np.float64) - origin
            classes = read_semantics(root, n, len(lidar))
            if classes is None:
                problems.append(
                    f"frame {n}: annotations/semseg/{n:02d}.pkl.gz is missing; its points have no "
                    f"class"
                )
            sweep = Sweep(
                world.astype(np.float32),
                np.round(lidar["t"].to_numpy(dtype=np.float64) * 1e9).astype(np.int64),
                np.full(len(lidar), SemanticClass.UNKNOWN, np.int16)
                if classes is None
                else world_classes(classes, meaning),
                (_origins_at(*ego_track, n, lidar) - origin).astype(np.float32),
            )
            sensor = lidar["d"].to_numpy()
            if n not in held_out:
                keep = is_usable(sweep, world, frame.world_from_ego.numpy(), EGO_M)
                sweeps.append(sweep.select(keep))
        table = cuboids[n]
        if table is None:
            problems.append(
                f"frame {n}: annotations/cuboids/{n:02d}.pkl.gz is missing; moving objects are "
                f"interpolated"
            )
        elif lidar is None:
            boxes += moving[n]
        else:
            box_sensors = sensors_of(table)
            boxes += [_when_seen(b, box_sensors[b.row], sweep, sensor, frame) for b in moving[n]]
    return tuple(sweeps), tuple(boxes), tuple(problems)


def _moving_boxes(
    root: Path,
    frames: Sequence[Frame],
    cuboids: Mapping[int, pd.DataFrame | None],
    origin: np.ndarray,
) -> Mapping[int, list[BoxSample]]:
    """Return the boxes of moving objects by frame, those of both sensors under the object's
    name.
    """
    names = read_objects(root).names

    def timed(frame: Frame, table: pd.DataFrame) -> TimedBoxes:
        boxes = boxes_of_cuboids(table)
        object_names = tuple(names[uuid] for uuid in boxes.track_ids)
        moves = ~table["stationary"].to_numpy().astype(bool)
        boxes = replace(boxes, track_ids=object_names, attributes={})
        return TimedBoxes(frame.index, boxes, frame.timestamp_ns, moves)

    tables = ((frame, cuboids[frame.index]) for frame in frames)
    objects = find_objects(
        (timed(frame, table) for frame, table in tables if table is not None),
        origin,
        allows_several_boxes=True,
    )
    by_frame: dict[int, list[BoxSample]] = defaultdict(list)
    for box in objects.moving_boxes:
        by_frame[box.frame].append(box)
    return by_frame


def _when_seen(
    box: BoxSample, sensor_number: int, sweep: Sweep, sensor: np.ndarray, frame: Frame
) -> BoxSample:
    """Return the box at the time when its own sensor saw it.

    Boxes were drawn around returns of 0.1 s. The time is the median of its returns' times, or,
    without returns in the box, the time of the return of nearest bearing from the car.

    Args:
        box: the box.
        sensor_number: number of the box's sensor.
        sweep: the frame's sweep.
        sensor: int [N], sensor of each of the sweep's returns.
        frame: the frame.
    """
    points = sweep.points
    times = sweep.timestamps_ns
    pose = box.world_from_box
    reach = float(np.linalg.norm(box.size_m))
    near = indices_between(points, pose[:3, 3] - reach, pose[:3, 3] + reach)
    if sensor_number >= 0:
        near = near[sensor[near] == sensor_number]
    local = (points[near] - pose[:3, 3]) @ pose[:3, :3]
    inside = near[inside_box(local, box.size_m, _TIMING_MARGIN_M)]
    if len(inside):
        return replace(box, timestamp_ns=int(np.sort(times[inside])[len(inside) // 2]))
    finite = np.isfinite(points[:, 0])
    ofs = finite & (sensor == sensor_number) if (sensor == sensor_number).any() else finite
    if not ofs.any():
        return box
    origin = frame.world_from_ego.numpy()[:2, 3]
    to_points = points[ofs, :2] - origin
    to_box = pose[:2, 3] - origin
    cosine = (to_points @ to_box) / np.maximum(np.linalg.norm(to_points, axis=1), 1e-6)
    return replace(box, timestamp_ns=int(times[ofs][np.argmax(cosine)]))


# ---- Objects and classes -------------------------------------------------------------------------
# A moving object is labelled once a sensor, up to 0.1 s apart, with a uuid for each box
# (`cuboids.sensor_id`: 0 the spinning sensor, 1 the forward one, -1 a box of both) and the other's
# uuid in `cuboids.sibling_id`. Published links go one way only, are cut short, or name their own
# box. Here both boxes are one object.

# The area that two boxes share, of that which either covers. In sequence 002 boxes tied by links
# share 0.31 to 0.98 of it on average over their frames, others of one class 0.01 at most.
MIN_OVERLAP = 0.25
_Rectangle = tuple[list[float], list[float], float]  # centre, sides, degrees
_NO_SENSOR = -1  # the sensor of a box that was drawn around both sensors' returns

# The sensors on the car: forward, left, up of the ego origin. The spinning one is where all six
# cameras' poses put it by the published extrinsics, within 2 cm. Those of the forward one put it at
# (1.41, 0.00, 1.55); from (1.35, 0.04, 1.65) its returns hide each other least, within about 5 cm.
SENSORS_M = np.array([[0.81, 0.0, 1.85], [1.35, 0.04, 1.65]])

# The published classes.json, numbered from 1.
_AIR = "Spray or rain"
_S = SemanticClass
_CLASSES: tuple[tuple[str, int], ...] = (
    ("Smoke", NO_SURFACE), ("Exhaust", NO_SURFACE), (_AIR, NO_SURFACE),
    ("Reflection", NO_SURFACE), ("Vegetation", _S.VEGETATION), ("Ground", _S.TERRAIN),
    ("Road", _S.ROAD), ("Lane Line Marking", _S.LANE_MARKING),
    ("Stop Line Marking", _S.LANE_MARKING), ("Other Road Marking", _S.LANE_MARKING),
    ("Sidewalk", _S.SIDEWALK), ("Driveway", _S.SIDEWALK), ("Car", _S.VEHICLE),
    ("Pickup Truck", _S.VEHICLE), ("Medium-sized Truck", _S.VEHICLE), ("Semi-truck", _S.VEHICLE),
    ("Towed Object", _S.VEHICLE), ("Motorcycle", _S.TWO_WHEELER),
    ("Other Vehicle - Construction Vehicle", _S.VEHICLE),
    ("Other Vehicle - Uncommon", _S.VEHICLE), ("Other Vehicle - Pedicab", _S.TWO_WHEELER),
    ("Emergency Vehicle", _S.VEHICLE), ("Bus", _S.VEHICLE),
    ("Personal Mobility Device", _S.TWO_WHEELER), ("Motorized Scooter", _S.TWO_WHEELER),
    ("Bicycle", _S.TWO_WHEELER), ("Train", _S.VEHICLE), ("Trolley", _S.VEHICLE),
    ("Tram / Subway", _S.VEHICLE), ("Pedestrian", _S.PEDESTRIAN),
    ("Pedestrian with Object", _S.PEDESTRIAN), ("Animals - Bird", _S.OTHER),
    ("Animals - Other", _S.OTHER), ("Pylons", _S.BARRIER), ("Road Barriers", _S.BARRIER),
    ("Signs", _S.SIGN), ("Cones", _S.OTHER), ("Construction Signs", _S.SIGN),
    ("Temporary Construction Barriers", _S.BARRIER), ("Rolling Containers", _S.OTHER),
    ("Building", _S.BUILDING), ("Other Static Object", _S.OTHER),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Objects:
    """Objects of a sequence.

    Attributes:
        names: the object's name by uuid. It is the uuid of its best box: the one with boxes in most
            frames, then the spinning sensor's, then the first in the files.
        ranks: rank by uuid. Of an object's boxes in one frame the lowest is kept.
    """

    names: Mapping[str, str]
    ranks: Mapping[str, int]

    def is_best_box(self, uuids: Iterable[str]) -> np.ndarray:
        """Return a mask of the boxes of one frame to keep, one per object, by their uuids."""
        uuids = list(uuids)
        best: dict[str, str] = {}
        for uuid in sorted(uuids, key=self.ranks.__getitem__):
            best.setdefault(self.names[uuid], uuid)
        return np.array([best[self.names[uuid]] == uuid for uuid in uuids], bool)


def sensors_of(table: pd.DataFrame) -> list[int]:
    """Return each box's sensor: 0, 1, or -1 if it has none or the table does not say."""
    column = table.get("cuboids.sensor_id", pd.Series([_NO_SENSOR] * len(table)))
    return [int(value) if value in (0, 1) else _NO_SENSOR for value in column]


def read_objects(root: Path) -> Objects:
    """Read the objects of all frames. They are cached as long as the files stay unchanged.

    A table that cannot be read is an error of its own frame, not here.
    """
    paths = sorted((root / "annotations" / "cuboids").glob("*.pkl.gz"))
    frames = [(int(path.name[:-7]), path.stat()) for path in paths if path.name[:-7].isdecimal()]
    return _read_objects(root, tuple((n, s.st_mtime_ns, s.st_size) for n, s in frames))


@lru_cache(maxsize=4)
def _read_objects(root: Path, state: tuple[tuple[int, int, int], ...]) -> Objects:
    tables = {}
    for frame, _, _ in state:
        try:
            table = read_cuboids(root, frame)
        except AdapterError:
            continue
        if table is not None:
            tables[frame] = table
    return tie_boxes(tables)


def tie_boxes(tables: Mapping[int, pd.DataFrame]) -> Objects:
    """Identify the objects in the cuboids of some frames.

    Boxes are tied by links in both directions, then by links in one, then, without a partner, by
    overlap: boxes of one class and both sensors with an overlap of MIN_OVERLAP on average. No tie
    makes two boxes of one sensor in one frame the same object.
    """
    boxes = _Boxes(defaultdict(set), {}, {})
    uuid_pairs: dict[tuple[str, str], None] = {}
    for frame, table in tables.items():
        siblings = table.get("cuboids.sibling_id", table["uuid"])
        rows = zip(
            table["uuid"].astype(str), siblings, sensors_of(table), table["label"], strict=True
        )
        for uuid, sibling, sensor, label in rows:
            boxes.frames[uuid].add(frame)
            boxes.sensors.setdefault(uuid, sensor)
            kind = class_of_label(str(label))
            boxes.kinds.setdefault(uuid, kind.name if kind else str(label))
            uuid_pairs[uuid, sibling] = None
    links = [pair for pair in uuid_pairs if pair[0] != pair[1] and pair[1] in boxes.frames]
    links.sort(key=lambda pair: pair[::-1] not in uuid_pairs)
    total: Counter[tuple[str, str]] = Counter()
    for table in tables.values():
        total.update(dict(_overlaps(table, boxes)))
    mean = {(a, b): s / len(boxes.frames[a] & boxes.frames[b]) for (a, b), s in total.items()}
    overlapping = [pair for pair, overlap in mean.items() if overlap >= MIN_OVERLAP]
    group = {uuid: [uuid] for uuid in boxes.frames}
    for a, b in [*links, *sorted(overlapping, key=lambda pair: (-mean[pair], pair))]:
        if group[a] is not group[b] and boxes.are_one(group[a], group[b], (a, b)):
            group[a] += group[b]
            group |= dict.fromkeys(group[b], group[a])
    order = {uuid: number for number, uuid in enumerate(boxes.frames)}
    merit = {u: (-len(boxes.frames[u]), boxes.sensors[u] == 1, order[u]) for u in order}
    ranks = {uuid: rank for rank, uuid in enumerate(sorted(order, key=merit.__getitem__))}
    return Objects({u: min(group[u], key=ranks.__getitem__) for u in order}, ranks)


class _Boxes(NamedTuple):
    """Facts of the tables about each uuid, in order of first appearance.

    They are its frames, its sensor, and its class, or its label if the class is not known.
    """

    frames: dict[str, set[int]]
    sensors: dict[str, int]
    kinds: dict[str, str]

    def are_one(self, a: list[str], b: list[str], tie: tuple[str, str]) -> bool:
        """Return True if all these uuids, two of which are tied, can be one object.

        An object has at most one box of each sensor in a frame.
        """
        return all(
            self.frames[first].isdisjoint(self.frames[second])
            or ((first, second) == tie and not self.same_sensor(first, second))
            for first in a
            for second in b
        )

    def same_sensor(self, a: str, b: str) -> bool:
        return self.sensors[a] == self.sensors[b] != _NO_SENSOR


def _overlaps(table: pd.DataFrame, boxes: _Boxes) -> Iterator[tuple[tuple[str, str], float]]:
    """Return pairs of a frame that may be siblings, with their areas' intersection over union."""
    uuids = [str(uuid) for uuid in table["uuid"]]
    columns = [f"{name}.{axis}" for name in ("position", "dimensions") for axis in "xyz"]
    values = table[[*columns, "yaw"]].to_numpy(dtype=np.float64)
    places = values[:, :3]
    sizes = values[:, 3:6]
    yaws = np.degrees(values[:, 6])
    usable = np.isfinite(values).all(axis=1) & (sizes > 0).all(axis=1)
    if "cuboids.sensor_id" in table:
        usable &= np.array(sensors_of(table)) != _NO_SENSOR
    usable_boxes = np.flatnonzero(usable)
    for place, i in enumerate(usable_boxes):
        later_boxes = usable_boxes[place + 1 :]
        offsets = places[later_boxes] - places[i]
        reach = (sizes[later_boxes] + sizes[i]) / 2
        near = np.hypot(*offsets[:, :2].T) < np.hypot(*reach[:, :2].T)
        near &= np.abs(offsets[:, 2]) < reach[:, 2]
        for j in later_boxes[near]:
            a, b = sorted((uuids[i], uuids[j]))
            if boxes.kinds[a] == boxes.kinds[b] and not boxes.same_sensor(a, b):
                rectangle_i = ([0.0, 0.0], sizes[i, :2].tolist(), yaws[i])
                rectangle_j = ((places[j] - places[i])[:2].tolist(), sizes[j, :2].tolist(), yaws[j])
                yield (a, b), _intersection_over_union(rectangle_i, rectangle_j)


def _intersection_over_union(a: _Rectangle, b: _Rectangle) -> float:
    _, corners = cv2.rotatedRectangleIntersection(a, b)
    shared = 0.0 if corners is None else cv2.contourArea(cv2.convexHull(corners))
    return shared / (np.prod(a[1]) + np.prod(b[1]) - shared)


def class_names(root: Path) -> dict[int, str]:
    """Return the sequence's classes by number.

    They are those of annotations/semseg/classes.json, or of the published list.
    """
    path = root / "annotations" / "semseg" / "classes.json"
    if not path.exists():
        return {number: name for number, (name, _) in enumerate(_CLASSES, start=1)}
    names = read_json(path)
    for key, name in names.items():
        if not (re.fullmatch("[0-9]{1,9}", key) and isinstance(name, str)):
            raise AdapterError(
                f"{path} must map class numbers to names; got {key!r:.80}: {name!r:.80}"
            )
    return {int(number): name for number, name in names.items()}


def class_meanings(root: Path) -> dict[int, int]:
    """Return the SemanticClass (or NO_SURFACE) by class number. Unknown names are UNKNOWN."""
    meaning = dict(_CLASSES)
    return {n: meaning.get(name, SemanticClass.UNKNOWN) for n, name in class_names(root).items()}


# ---- Labels --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PandaSetLabels:
    """Labels of one sequence, read on demand.

    Boxes: one per object. If the file has both sensors' cuboids of it, the one that `Objects` ranks
    first is used. A track_id is the uuid of the object's best box, the same in all frames.
    Attributes hold every column of the file under its own name (None for a missing text), including
    the box's own uuid, yaw and sibling. Sweeps: columns x y z (metres), i (intensity 0 to 255), t
    (seconds), d (0: the spinning sensor, 1: the forward one) exactly as in the file, and semantic
    (the dataset's own class numbers) if the frame has them.
    """

    root: Path

    def boxes(self, frame_index: int) -> Boxes:
        table = read_cuboids(self.root, frame_index)
        if table is None:
            return Boxes.empty()
        objects = read_objects(self.root)
        boxes = boxes_of_cuboids(table[objects.is_best_box(table["uuid"].astype(str))])
        return replace(boxes, track_ids=tuple(objects.names[uuid] for uuid in boxes.track_ids))

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        """Return the SemanticClass of each return, or NO_SURFACE.

        The result is None for a sweep without classes.
        """
        numbers = sweep.columns.get("semantic")
        return None if numbers is None else world_classes(numbers, class_meanings(self.root))

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Return the position of each return's sensor at the return's time, float64 [N, 3].

        The car is on a straight line between its poses at the ends of the sweeps, and turned as at
        the end of this one.
        """
        world_from_ego, times_ns = read_ego_track(self.root)
        if not 0 <= frame_index < len(times_ns):
            return None
        return _origins_at(world_from_ego, times_ns, frame_index, sweep.columns)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        table = read_lidar(self.root, frame_index)
        if table is None:
            return None
        columns = {name: table[name].to_numpy() for name in LIDAR_COLUMNS}
        classes = read_semantics(self.root, frame_index, len(table))
        if classes is not None:
            columns["semantic"] = classes
        return LidarSweep(columns)

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        folders = ("lidar", "annotations/semseg")
        files = tuple(frame_file(self.root, folder, frame_index) for folder in folders)
        return tuple(file for file in files if file.exists()) if files[0].exists() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """Return tables of the sweep's rows under their own index.

        Rows of both files still name each other.
        """
        table = read_frame(file).iloc[sweep.columns[INDEX_COLUMN]].copy()
        if file == frame_file(self.root, "lidar", frame_index):
            for name in "xyzi":
                table[name] = sweep.columns[name]
        else:
            air = class_of_air(class_meanings(self.root), class_names(self.root), _AIR)
            table["class"] = np.where(is_in_air(sweep), air, table["class"].to_numpy())
        stream = io.BytesIO()
        table.to_pickle(stream, compression=None, protocol=4)
        return gzip.compress(stream.getvalue(), compresslevel=6, mtime=0)


def _origins_at(
    world_from_ego: np.ndarray,
    times_ns: np.ndarray,
    frame: int,
    columns: Mapping[str, np.ndarray] | pd.DataFrame,
) -> np.ndarray:
    """Return the sensors' places at the returns' times, float64 [N, 3], dataset world.

    Args:
        world_from_ego: float64 [F, 4, 4], the car's poses at the ends of the sweeps.
        times_ns: int64 [F], their times.
        frame: number of the sweep.
        columns: t and d of its returns.
    """
    turn = world_from_ego[frame, :3, :3]
    seconds = np.asarray(columns["t"], np.float64) - times_ns[0] * 1e-9
    places = places_at(world_from_ego[:, :3, 3], (times_ns - times_ns[0]) * 1e-9, seconds)
    offsets = np.stack([turn @ SENSORS_M[0], turn @ SENSORS_M[1]])
    return places + offsets[(np.asarray(columns["d"]) == 1).astype(np.int64)]


def places_at(places_m: np.ndarray, times_s: np.ndarray, wanted_s: np.ndarray) -> np.ndarray:
    """Interpolate positions linearly in time.

    Before the first and after the last place the outer lines continue.

    Args:
        places_m: float64 [F, 3].
        times_s: float64 [F], rising.
        wanted_s: float64 [N].

    Returns:
        Positions, float64 [N, 3].
    """
    if len(times_s) == 1:
        return np.broadcast_to(places_m[0], (len(wanted_s), 3))
    after = np.clip(np.searchsorted(times_s, wanted_s), 1, len(times_s) - 1)
    span = times_s[after] - times_s[after - 1]
    share = ((wanted_s - times_s[after - 1]) / span)[:, None]
    return places_m[after - 1] + share * (places_m[after] - places_m[after - 1])


def boxes_of_cuboids(table: pd.DataFrame) -> Boxes:
    """Return a frame's cuboids as boxes.

    PandaSet's cuboids have their length along y and their width along x: the heading is a quarter
    turn more than yaw, and the first two sizes swap.
    """
    half = (table["yaw"].to_numpy(dtype=np.float64) + np.pi / 2) / 2
    zero = np.zeros_like(half)
    dimensions = [table[f"dimensions.{axis}"].to_numpy(dtype=np.float64) for axis in "yxz"]
    positions = [table[f"position.{axis}"].to_numpy(dtype=np.float64) for axis in "xyz"]
    return Boxes(
        track_ids=tuple(str(v) for v in table["uuid"]),
        labels=names_in(table["label"]),
        centers_m=np.stack(positions, axis=1),
        sizes_m=np.stack(dimensions, axis=1),
        quats=np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1),
        attributes={str(name): _plain(table[name]) for name in table.columns},
    )


def _plain(column: pd.Series) -> np.ndarray:
    """Return the column's values. NaN among texts, pandas' mark of a missing one, becomes None."""
    values = column.to_numpy()
    if values.dtype != object:
        return values
    return np.array([None if isinstance(v, float) and np.isnan(v) else v for v in values], object)


def pandaset_labels(path: str, query: dict[str, str]) -> PandaSetLabels:
    """Return the labels of a folder. They cover all its frames, whatever the query."""
    return PandaSetLabels(Path(path))
