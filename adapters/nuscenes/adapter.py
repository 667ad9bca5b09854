"""A nuScenes scene: Gaussians from accumulated, image-coloured LiDAR.

World: nuScenes' global one, less whole metres where the drive is further than a kilometre from its
origin. Ego: nuScenes' (x forward, y left, z up, origin on the ground below the rear axle), as it
stood at the frame's LiDAR time. Images are undistorted as published. Cameras stand where the ego
pose of their own image puts them, and moving objects where the LiDAR met them (see tables.Turn).
Frame numbers count the LiDAR's files, or keyframes, from 0 in order of time; `frame_tokens` says
which rows of sample_data they are.
"""

from __future__ import annotations

import dataclasses
import io
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from adapters.nuscenes.tables import (
    FrameFiles,
    NuScenesOptions,
    SceneTables,
    SensorFile,
    read_tables,
    scene_frames,
)
from adapters.plain_files import inside
from adapters.raw_drive import (
    NO_SURFACE,
    BoxSample,
    Picture,
    RawDrive,
    Sweep,
    TimedBoxes,
    class_of_air,
    drive_origin,
    find_objects,
    is_usable,
    recentred,
    scene_of_drive,
    some,
    stored_records,
    usable_images,
    world_classes,
)
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.effects.lidar.codes import INDEX_COLUMN, is_in_air
from augment.errors import AdapterError
from augment.files.pickles import read_npy
from augment.geometry import invert_rigid
from augment.labels import Boxes, LidarSweep
from augment.scene import Scene
from augment.semantics import SemanticClass
from recipes.files import open_file

# ---- Sweeps and boxes by frame, in the global world ----------------------------------------------
# A LiDAR file holds records of five float32: x, y, z (metres, sensor's axes), intensity (0 to 255),
# ring; compensated for the car's motion during the turn of 50 ms, so that the pose of the file's
# own time carries all of its returns. Their times are not stored; bearings tell (tables.Turn).

RECORD_BYTES = 20
_RECORD = ("x", "y", "z", "intensity", "ring")
_STRAIGHT = 1e-9  # of the cosine: between nearly equal rotations a straight line is exact
# The recording car with its sensors in its own frame (x forward, y left, z up, origin on the ground
# below the rear axle). Measured on a published sweep: its returns on the car, a quarter of all, lie
# in x -0.2..2.8, y -0.7..0.7, z 0.8..1.9; the car, 4.1 m by 1.8 m, reaches from -0.7 to 3.5.
EGO_M = np.array([[-0.8, -1.0, -0.5], [3.6, 1.0, 2.3]])
_EGO_CLASS = 31
_NOISE = "noise"
_PANOPTIC_STEP = 1000  # a number of the panoptic labels is that many times the class, and an object
# lidarseg's classes as published, numbered from 0, and what they mean here.
_S = SemanticClass
_CLASSES: tuple[tuple[str, int], ...] = (
    (_NOISE, NO_SURFACE), ("animal", _S.OTHER), ("human.pedestrian.adult", _S.PEDESTRIAN),
    ("human.pedestrian.child", _S.PEDESTRIAN),
    ("human.pedestrian.construction_worker", _S.PEDESTRIAN),
    ("human.pedestrian.personal_mobility", _S.TWO_WHEELER),
    ("human.pedestrian.police_officer", _S.PEDESTRIAN),
    ("human.pedestrian.stroller", _S.PEDESTRIAN), ("human.pedestrian.wheelchair", _S.PEDESTRIAN),
    ("movable_object.barrier", _S.BARRIER), ("movable_object.debris", _S.OTHER),
    ("movable_object.pushable_pullable", _S.OTHER), ("movable_object.trafficcone", _S.OTHER),
    ("static_object.bicycle_rack", _S.OTHER), ("vehicle.bicycle", _S.TWO_WHEELER),
    ("vehicle.bus.bendy", _S.VEHICLE), ("vehicle.bus.rigid", _S.VEHICLE),
    ("vehicle.car", _S.VEHICLE), ("vehicle.construction", _S.VEHICLE),
    ("vehicle.emergency.ambulance", _S.VEHICLE), ("vehicle.emergency.police", _S.VEHICLE),
    ("vehicle.motorcycle", _S.TWO_WHEELER), ("vehicle.trailer", _S.VEHICLE),
    ("vehicle.truck", _S.VEHICLE), ("flat.driveable_surface", _S.ROAD),
    ("flat.other", _S.TERRAIN), ("flat.sidewalk", _S.SIDEWALK), ("flat.terrain", _S.TERRAIN),
    # Walls, but poles and signs too: lidarseg does not tell them apart.
    ("static.manmade", _S.BUILDING), ("static.other", _S.OTHER),
    ("static.vegetation", _S.VEGETATION), ("vehicle.ego", _S.VEHICLE),
)  # fmt: skip


class SweepFault(Exception):
    """What is wrong with a sweep's file, as the end of a sentence that starts with its path."""


class Returns(NamedTuple):
    """What one LiDAR file holds. points_m: float64 [N, 3], global. intensity, ring: float32 [N], as
    in the file. timestamps_ns: int64 [N], told by bearing. classes: uint8 [N], lidarseg's numbers,
    or None. problem: a sentence or ''."""

    points_m: np.ndarray
    timestamps_ns: np.ndarray
    intensity: np.ndarray
    ring: np.ndarray
    classes: np.ndarray | None
    problem: str


def read_returns(tables: SceneTables, sweep: SensorFile) -> Returns:
    """All returns of a sweep, in the file's order.

    Raises:
        SweepFault: no file, or not of whole records.
        AdapterError: the file's name leads outside of the dataset."""
    content = _bytes(_path(tables, sweep))
    if len(content) == 0 or len(content) % RECORD_BYTES:
        raise SweepFault(
            f"is of {len(content)} bytes, not of whole records of {RECORD_BYTES}: it is cut short"
        )
    records = np.frombuffer(content, "<f4").reshape(-1, 5)
    pose = sweep.world_from_sensor
    with np.errstate(all="ignore"):  # returns that are no numbers stay none
        local = records[:, :3].astype(np.float64)
        points = local @ pose[:3, :3].T + pose[:3, 3]
        before = tables.turn.before_ns(local @ sweep.ego_from_sensor[:3, :3].T)
    classes, problem = _read_classes(tables, sweep, len(records))
    times_ns = sweep.timestamp_ns - before
    return Returns(points, times_ns, records[:, 3].copy(), records[:, 4].copy(), classes, problem)


@dataclasses.dataclass(frozen=True, eq=False)
class NuScenesLabels:
    """Labels of one scene: boxes from memory, sweeps read when asked.

    Boxes: track_ids are instance tokens, labels category names. Attributes: `token` of the
    annotation, `attributes` (names joined by commas), `visibility` (such as v80-100),
    num_lidar_pts, num_radar_pts, `interpolated`. Frames of keyframes have their sample's boxes as
    they are. Those of sweeps between have the boxes of their sample, which is the next keyframe,
    moved to where they were between that keyframe and the one before: centre linear in time,
    rotation by slerp, all else that of the later box. Where the earlier keyframe has no box of the
    instance, the later box stands as it is. So it is in the devkit's get_boxes.

    Sweeps: columns x y z (metres, float64, nuScenes' global world), intensity (0 to 255) and ring
    (both float32 as in the file), timestamp_ns (not published: the file's time less how long before
    it the LiDAR looked there, see tables.Turn), and semantic (lidarseg's numbers, uint8) where the
    sweep has them. Returns of the recording car are among them."""

    tables: SceneTables
    frames: tuple[FrameFiles, ...]

    def boxes(self, frame_index: int) -> Boxes:
        frame = self._frame(frame_index)
        return Boxes.empty() if frame is None else boxes_of_sweep(self.tables, frame.sweep)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        frame = self._frame(frame_index)
        if frame is None:
            return None
        try:
            returns = read_returns(self.tables, frame.sweep)
        except (FileNotFoundError, SweepFault):
            return None
        columns = {name: returns.points_m[:, i] for i, name in enumerate("xyz")}
        columns |= {"intensity": returns.intensity, "ring": returns.ring}
        columns["timestamp_ns"] = returns.timestamps_ns
        if returns.classes is not None:
            columns["semantic"] = returns.classes
        return LidarSweep(columns)

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        numbers = sweep.columns.get("semantic")
        return None if numbers is None else world_classes(numbers, _class_meanings(self.tables))

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """The sensor's place at the time of the file, to which its returns are compensated: within
        the turn of 50 ms it was up to half of the way elsewhere that the car drives in it."""
        frame = self._frame(frame_index)
        if frame is None:
            return None
        return np.broadcast_to(frame.sweep.world_from_sensor[:3, 3], (len(sweep), 3))

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """Sweep, classes (lidarseg) and objects (panoptic) of the returns, as far as they exist."""
        frame, tables = self._frame(frame_index), self.tables
        if frame is None:
            return ()
        token = frame.sweep.token
        named = (tables.semantic_files.get(token), tables.panoptic_files.get(token))
        names = [frame.sweep.filename, *(name for name in named if name is not None)]
        where = f"sample_data {token!r}"
        files = [inside(tables.root, name, where) for name in names]
        return tuple(file for file in files if file.exists()) if files[0].exists() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        sensor, rows = self.frames[frame_index].sweep, sweep.columns[INDEX_COLUMN]
        in_air = is_in_air(sweep)
        noise = class_of_air(_class_meanings(self.tables), _class_names(self.tables), _NOISE)
        if file.suffix == ".npz":
            return _panoptic_of(file, rows, in_air, noise)
        content = np.fromfile(file, np.uint8)
        if file != _path(self.tables, sensor):
            if rows.max(initial=-1) >= len(content):
                raise AdapterError(
                    f"{file} has {len(content)} classes, fewer than {sensor.filename} has returns; "
                    f"copy it again"
                )
            return np.where(in_air, np.uint8(noise), content[rows]).tobytes()
        records = content.view("<f4").reshape(-1, 5)
        return stored_records(records, _RECORD, sweep, sensor.world_from_sensor)

    def _frame(self, index: int) -> FrameFiles | None:
        return self.frames[index] if 0 <= index < len(self.frames) else None


def _bytes(path: Path) -> bytes:
    try:
        with open_file(path) as file:
            return file.read()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise SweepFault(f"cannot be read ({error.strerror or error})") from None


def _read_classes(
    tables: SceneTables, sweep: SensorFile, count: int
) -> tuple[np.ndarray | None, str]:
    """The class of each return, and why there is none where there should be."""
    name = tables.semantic_files.get(sweep.token)
    if name is None:
        return None, ""
    path = inside(tables.root, name, f"lidarseg of sample_data {sweep.token!r}")
    try:
        classes = np.frombuffer(_bytes(path), np.uint8)
    except FileNotFoundError:
        return None, f"{name} is missing; its points have no class"
    except SweepFault as fault:
        return None, f"{name} {fault}; its points have no class"
    if len(classes) != count:
        return None, (
            f"{name} has {len(classes)} classes for {count} returns; its points have no class"
        )
    return classes, ""


def _class_meanings(tables: SceneTables) -> dict[int, int]:
    """SemanticClass or NO_SURFACE by number."""
    meaning = dict(_CLASSES)
    return {n: meaning.get(name, SemanticClass.UNKNOWN) for n, name in _class_names(tables).items()}


# NotImplementedError, RuntimeError: a compression or a password that zipfile does not know.
_NPZ_FAULTS = (
    *(OSError, ValueError, LookupError, EOFError, zlib.error, zipfile.BadZipFile),
    *(NotImplementedError, RuntimeError),
)


def _class_names(tables: SceneTables) -> Mapping[int, str]:
    """The classes by number; the published ones where category.json has none."""
    return tables.class_names or {number: name for number, (name, _) in enumerate(_CLASSES)}


def _panoptic_of(file: Path, rows: np.ndarray, in_air: np.ndarray, noise: int) -> bytes:
    """The numbers of those returns in a file of nuScenes' panoptic labels; those in the air have
    the class noise, and are no object's."""
    try:
        with zipfile.ZipFile(file) as archive, archive.open("data.npy") as member:
            opened: Any = member
            numbers = read_npy(opened)[rows]
            numbers[in_air] = _PANOPTIC_STEP * noise
    except _NPZ_FAULTS as error:
        raise AdapterError(
            f"{file} must hold an array `data`, one number a return ({error}); copy it again"
        ) from error
    content, out = io.BytesIO(), io.BytesIO()
    np.save(content, numbers)
    with zipfile.ZipFile(out, "w") as archive:  # np.savez would write the time of day
        entry = zipfile.ZipInfo("data.npy")
        archive.writestr(entry, content.getvalue(), zipfile.ZIP_DEFLATED)
    return out.getvalue()


def nuscenes_labels(path: str, query: dict[str, str]) -> NuScenesLabels:
    """The labels of a scene; whatever frames= says, they are those of all its frames."""
    options = NuScenesOptions.from_query("nuscenes", query)
    tables = read_tables(Path(path), options.version, options.scene)
    return NuScenesLabels(tables, scene_frames(tables, sweeps=options.sweeps == "1")[0])


def boxes_of_sweep(tables: SceneTables, sweep: SensorFile) -> Boxes:
    """The boxes at a sweep's time, as in NuScenesLabels."""
    tokens = [sample.token for sample in tables.samples]
    number = tokens.index(sweep.sample_token)
    sample, boxes = tables.samples[number], tables.samples[number].boxes
    mark = {"interpolated": np.full(len(boxes), not sweep.is_key_frame)}
    boxes = dataclasses.replace(boxes, attributes={**boxes.attributes, **mark})
    if sweep.is_key_frame or number == 0:
        return boxes
    before = tables.samples[number - 1]
    span = sample.timestamp_ns - before.timestamp_ns
    fraction = (sweep.timestamp_ns - before.timestamp_ns) / span if span else 1.0
    fraction = min(max(fraction, 0.0), 1.0)
    earlier = {name: i for i, name in enumerate(before.boxes.track_ids)}
    centers_m, quats = boxes.centers_m.copy(), boxes.quats.copy()
    for i, name in enumerate(boxes.track_ids):
        if name in earlier:
            start = before.boxes.centers_m[earlier[name]]
            centers_m[i] = start + fraction * (boxes.centers_m[i] - start)
            quats[i] = slerp(before.boxes.quats[earlier[name]], boxes.quats[i], fraction)
    return dataclasses.replace(boxes, centers_m=centers_m, quats=quats)


def slerp(a: np.ndarray, b: np.ndarray, fraction: float) -> np.ndarray:
    """The rotation at a fraction of the shorter way from one quaternion to another, unit length."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    if cosine > 1 - _STRAIGHT:
        quat = a + fraction * (b - a)
    else:
        angle = np.arccos(cosine)
        quat = np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b
    return quat / np.linalg.norm(quat)


# ---- The scene -----------------------------------------------------------------------------------

_MOVING = ("vehicle.moving", "pedestrian.moving", "cycle.with_rider")
_LIDAR_TOP_DEG = 10.67  # the sensor's uppermost channel
# The back camera looks over the recording car's own edge, which on a published image begins at row
# 854 of 900.
_ROWS_ABOVE_CAR = {"CAM_BACK": 0.945}


def open_nuscenes(path: str, query: dict[str, str]) -> Scene:
    """One scene of a nuScenes dataset; path: the folder that holds v1.0-mini or such.

    query: version (a folder of tables), scene (name or token), both needed only where there are
    several; sweeps (1, the default: frames are keyframes and the LiDAR's sweeps between them; 0:
    keyframes only); and frames, voxel_m, max_gaussians, image_scale, sky_size, held_out, see
    DriveOptions. Opening is deterministic: the same files and options give the same bits.

    Raises:
        AdapterError: a wrong option, tables that are missing, damaged or contradict each other, no
            LiDAR, no image, or a camera all of whose images are damaged. Single images and sweeps
            that are missing or damaged are Scene.problems."""
    options = NuScenesOptions.from_query("nuscenes", query)
    return scene_of_drive(read_nuscenes(path, query, options), options)


def read_nuscenes(path: str, query: dict[str, str], options: NuScenesOptions) -> RawDrive:
    """The frames of the scene that the options ask for, with their sweeps and boxes."""
    tables = read_tables(Path(path), options.version, options.scene)
    files, unused = scene_frames(tables, sweeps=options.sweeps == "1")
    where = f"nuscenes:{path}, scene {tables.name}"
    if not files:
        raise AdapterError(f"{where} has no keyframe of LIDAR_TOP; sweeps=1 takes its sweeps")
    chosen = options.select(range(len(files)), where=where)
    own = [files[number] for number in chosen.numbers]
    origin = drive_origin(np.array([file.sweep.world_from_ego[:3, 3] for file in files]))
    pictures = [
        Picture(channel, f.index, _path(tables, image), image.size)
        for f in own
        for channel, image in sorted(f.images.items())
    ]
    images = usable_images(pictures)
    frames = tuple(_frame(file, origin, images.paths.get(file.index, {})) for file in own)
    sweeps, problems = read_sweeps(tables, [files[n] for n in chosen.used], origin)
    return RawDrive(
        name=tables.name,
        source=format_uri("nuscenes", path, query),
        frames=frames,
        held_out=chosen.held_out,
        sweeps=sweeps,
        boxes=moving_boxes(tables, own, origin),
        labels=NuScenesLabels(tables, files),
        world_origin_m=origin,
        lidar_top_deg=_LIDAR_TOP_DEG,
        problems=unused + chosen.problems + problems + images.problems,
        used_rows=_ROWS_ABOVE_CAR,
    )


def _path(tables: SceneTables, file: SensorFile) -> Path:
    return inside(tables.root, file.filename, f"sample_data {file.token!r}")


def _frame(file: FrameFiles, origin: np.ndarray, paths: Mapping[str, str]) -> Frame:
    return Frame(
        index=file.index,
        timestamp_ns=file.sweep.timestamp_ns,
        world_from_ego=recentred(file.sweep.world_from_ego, origin),
        cameras={
            name: Camera(
                name,
                *image.size,
                *image.intrinsic,
                camera_from_world=invert_rigid(recentred(image.world_from_sensor, origin)),
                timestamp_ns=image.timestamp_ns,
            )
            for name, image in sorted(file.images.items())
        },
        image_paths=paths,
    )


def read_sweeps(
    tables: SceneTables, frames: Sequence[FrameFiles], world_origin_m: np.ndarray
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """The usable returns of every frame that has a file, in the scene's world, and what was
    missing. Left out: returns of the recording car, of no surface, not finite."""
    sweeps, problems, missing = [], [], []
    meaning = _class_meanings(tables) | {_EGO_CLASS: NO_SURFACE}
    for frame in tqdm(frames, desc="LiDAR", unit="sweep", disable=None):
        try:
            returns = read_returns(tables, frame.sweep)
        except FileNotFoundError:
            missing.append(frame.index)
            continue
        except SweepFault as fault:
            problems.append(
                f"frame {frame.index}: {frame.sweep.filename} {fault}; its points are left out"
            )
            continue
        if returns.problem:
            problems.append(f"frame {frame.index}: {returns.problem}")
        unknown = np.full(len(returns.points_m), SemanticClass.UNKNOWN, np.int16)
        classes = returns.classes
        semantic = unknown if classes is None else world_classes(classes, meaning)
        with np.errstate(over="ignore"):  # of returns that are no numbers
            points = (returns.points_m - world_origin_m).astype(np.float32)
        sweep = Sweep(points, returns.timestamps_ns, semantic)
        keep = is_usable(sweep, returns.points_m, frame.sweep.world_from_ego, EGO_M)
        sweeps.append(sweep.select(keep))
    if missing:
        problems.append(f"the LiDAR's files of {some(missing)} are missing, their points too")
    return tuple(sweeps), tuple(problems)


def moving_boxes(
    tables: SceneTables, frames: Sequence[FrameFiles], world_origin_m: np.ndarray
) -> tuple[BoxSample, ...]:
    """The boxes of moving objects around the given frames, in the scene's world.

    An object moves if any of its boxes in the whole scene says so, or if it travels. Boxes are
    those of the keyframes around the frames' times, each at the time that the LiDAR met it."""
    sweeps = {file.sample_token: file for file in tables.lidar if file.is_key_frame}
    timed = []
    for number, sample in enumerate(tables.samples):
        boxes, sweep = sample.boxes, sweeps.get(sample.token)
        times_ns = np.full(len(boxes), sample.timestamp_ns)
        if sweep is not None:  # when it met the box
            offsets = boxes.centers_m - sweep.world_from_sensor[:3, 3]
            times_ns -= tables.turn.before_ns(offsets @ sweep.world_from_ego[:3, :3])
        named = [text.split(",") for text in boxes.attributes["attributes"]]
        moves = np.array([any(name in _MOVING for name in names) for names in named], bool)
        turns = Rotation.from_quat(boxes.quats[:, [1, 2, 3, 0]]).as_matrix() if named else None
        timed.append(TimedBoxes(number, boxes, times_ns, moves, turns))
    moving = find_objects(timed, world_origin_m, several=True).moving
    first, last = frames[0].sweep.timestamp_ns, frames[-1].sweep.timestamp_ns
    times = [sample.timestamp_ns for sample in tables.samples]
    start = max((i for i, time in enumerate(times) if time <= first), default=0)
    stop = min((i for i, time in enumerate(times) if time >= last), default=len(times) - 1)
    return tuple(box for box in moving if start <= box.frame <= stop)
