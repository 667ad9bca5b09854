"""Scenes of nuScenes: Gaussians from accumulated, image-coloured LiDAR.

`open_nuscenes` makes a scene of a dataset's folder, `nuscenes_labels` its labels.

World: nuScenes' global world, less whole metres if the drive is further than a kilometre from its
origin. Ego: nuScenes' frame (x forward, y left, z up, origin on the ground below the rear axle), as
it stood at the frame's LiDAR time. Images are undistorted as published. Cameras stand where the ego
pose of their own image puts them. Moving objects stand where the LiDAR met them (see tables.Turn).
Frame numbers count the LiDAR's files, or keyframes, from 0 in order of time.
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
from adapters.plain_files import resolve_inside
from adapters.raw_drive import (
    NO_SURFACE,
    BoxSample,
    Picture,
    RawDrive,
    Sweep,
    TimedBoxes,
    class_of_air,
    describe_frames,
    drive_origin,
    find_objects,
    is_usable,
    recenter_pose,
    scene_of_drive,
    stored_records,
    usable_images,
    world_classes,
)
from adapters.recorded_lenses import no_lens_note
from adapters.uri import format_uri
from augment.effects.lidar.codes import INDEX_COLUMN, is_in_air
from augment.errors import AdapterError
from augment.files.pickles import read_npy
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from recipes.files import open_file

# ---- Sweeps and boxes by frame, in the global world ----------------------------------------------
# A LiDAR file holds records of five float32: x, y, z (metres, sensor's axes), intensity (0 to 255),
# ring; compensated for the car's motion during the turn of 50 ms, so that the pose of the file's
# own time carries all of its returns. Their times are not stored; bearings tell (tables.Turn).

# Size of a return in a LiDAR file.
RECORD_BYTES = 20
# Values of a return in a LiDAR file.
_RECORD_COLUMNS = ("x", "y", "z", "intensity", "ring")
# Quaternions whose cosine is nearer to 1 than this are interpolated linearly, which is exact then.
_MAX_COSINE_GAP = 1e-9
# Least and greatest corner of the recording car with its sensors, ego frame (x forward, y left, z
# up, origin on the ground below the rear axle). Measured on a published sweep: its returns on the
# car, a quarter of all, lie in x -0.2..2.8, y -0.7..0.7, z 0.8..1.9; the car, 4.1 m by 1.8 m,
# reaches from -0.7 to 3.5.
EGO_BOX_M = np.array([[-0.8, -1.0, -0.5], [3.6, 1.0, 2.3]])
# Number of lidarseg's class of the recording car.
_EGO_CLASS = 31
# Name of lidarseg's class of noise.
_NOISE_CLASS = "noise"
# A panoptic label is this factor times the number of the class, plus the number of the object.
_PANOPTIC_FACTOR = 1000
# lidarseg's classes as published, numbered from 0, with the class that they become.
_C = SemanticClass
_CLASSES: tuple[tuple[str, int], ...] = (
    (_NOISE_CLASS, NO_SURFACE), ("animal", _C.OTHER), ("human.pedestrian.adult", _C.PEDESTRIAN),
    ("human.pedestrian.child", _C.PEDESTRIAN),
    ("human.pedestrian.construction_worker", _C.PEDESTRIAN),
    ("human.pedestrian.personal_mobility", _C.TWO_WHEELER),
    ("human.pedestrian.police_officer", _C.PEDESTRIAN),
    ("human.pedestrian.stroller", _C.PEDESTRIAN), ("human.pedestrian.wheelchair", _C.PEDESTRIAN),
    ("movable_object.barrier", _C.BARRIER), ("movable_object.debris", _C.OTHER),
    ("movable_object.pushable_pullable", _C.OTHER), ("movable_object.trafficcone", _C.OTHER),
    ("static_object.bicycle_rack", _C.OTHER), ("vehicle.bicycle", _C.TWO_WHEELER),
    ("vehicle.bus.bendy", _C.VEHICLE), ("vehicle.bus.rigid", _C.VEHICLE),
    ("vehicle.car", _C.VEHICLE), ("vehicle.construction", _C.VEHICLE),
    ("vehicle.emergency.ambulance", _C.VEHICLE), ("vehicle.emergency.police", _C.VEHICLE),
    ("vehicle.motorcycle", _C.TWO_WHEELER), ("vehicle.trailer", _C.VEHICLE),
    ("vehicle.truck", _C.VEHICLE), ("flat.driveable_surface", _C.ROAD),
    ("flat.other", _C.TERRAIN), ("flat.sidewalk", _C.SIDEWALK), ("flat.terrain", _C.TERRAIN),
    # Walls, but poles and signs too: lidarseg does not tell them apart.
    ("static.manmade", _C.BUILDING), ("static.other", _C.OTHER),
    ("static.vegetation", _C.VEGETATION), ("vehicle.ego", _C.VEHICLE),
)  # fmt: skip


class SweepFault(Exception):
    """Fault of a sweep's file, as the end of a sentence that starts with the file's path."""


class Returns(NamedTuple):
    """Contents of one LiDAR file.

    Attributes:
        points_m: float64 [N, 3], global world.
        timestamps_ns: int64 [N], derived from the bearings.
        intensity: float32 [N], as in the file.
        ring: float32 [N], as in the file.
        classes: uint8 [N], lidarseg's numbers, or None.
        problem: a sentence, or '' without a problem.
    """

    points_m: np.ndarray
    timestamps_ns: np.ndarray
    intensity: np.ndarray
    ring: np.ndarray
    classes: np.ndarray | None
    problem: str


def read_returns(tables: SceneTables, sweep: SensorFile) -> Returns:
    """Read all returns of a sweep, in the file's order.

    Raises:
        SweepFault: the file does not hold whole records.
        FileNotFoundError: the file does not exist.
        AdapterError: the file's name leads outside of the dataset.
    """
    content = _read_bytes(_path(tables, sweep))
    if len(content) == 0 or len(content) % RECORD_BYTES:
        raise SweepFault(
            f"is of {len(content)} bytes, not of whole records of {RECORD_BYTES}: it is cut short"
        )
    records = np.frombuffer(content, "<f4").reshape(-1, 5)
    pose = sweep.world_from_sensor
    with np.errstate(all="ignore"):  # returns that are no numbers stay none
        sensor_points = records[:, :3].astype(np.float64)
        points = sensor_points @ pose[:3, :3].T + pose[:3, 3]
        nanoseconds_before_end = tables.turn.before_ns(
            sensor_points @ sweep.ego_from_sensor[:3, :3].T
        )
    classes, problem = _read_classes(tables, sweep, len(records))
    times_ns = sweep.timestamp_ns - nanoseconds_before_end
    return Returns(points, times_ns, records[:, 3].copy(), records[:, 4].copy(), classes, problem)


@dataclasses.dataclass(frozen=True, eq=False)
class NuScenesLabels:
    """Labels of one scene: boxes in memory, sweeps that are read on demand.

    Boxes: track_ids are instance tokens, labels category names. Attributes: `token` of the
    annotation, `attributes` (names joined by commas), `visibility` (such as v80-100),
    num_lidar_pts, num_radar_pts, `interpolated`. Frames of keyframes have their sample's boxes
    unchanged. A frame between keyframes has the boxes of its sample, which is the next keyframe,
    moved to where they were between that keyframe and the one before: the centre is linear in time,
    the rotation is interpolated by slerp, all else is that of the later box. If the earlier
    keyframe has no box of the instance, the later box is used unchanged. The devkit's get_boxes
    does the same.

    Sweeps: columns x y z (metres, float64, nuScenes' global world), intensity (0 to 255) and ring
    (both float32 as in the file), timestamp_ns (not published: the file's time less how long before
    it the LiDAR looked there, see tables.Turn), and semantic (lidarseg's numbers, uint8) if the
    sweep has them. Returns of the recording car are among them.

    Attributes:
        tables: the scene's tables.
        frames: files by frame number.
    """

    tables: SceneTables
    frames: tuple[FrameFiles, ...]

    def boxes(self, frame_index: int) -> Boxes:
        """Return the boxes of a frame."""
        frame = self._frame(frame_index)
        return Boxes.empty() if frame is None else boxes_of_sweep(self.tables, frame.sweep)

    def lidar(self, frame_index: int) -> LidarSweep | None:
        """Return the sweep of a frame, or None if its file is missing or damaged."""
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
        """Return the SemanticClass of each return, or None if the sweep has no classes."""
        numbers = sweep.columns.get("semantic")
        return None if numbers is None else world_classes(numbers, _class_meanings(self.tables))

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Return the sensor's position at the file's time, once per return, float64 [N, 3].

        The returns are compensated to that time. Within the turn of 50 ms the sensor was up to half
        of the car's way elsewhere.
        """
        frame = self._frame(frame_index)
        if frame is None:
            return None
        return np.broadcast_to(frame.sweep.world_from_sensor[:3, 3], (len(sweep), 3))

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        """Return the existing files of a sweep: returns, their classes (lidarseg), their objects
        (panoptic).
        """
        frame = self._frame(frame_index)
        tables = self.tables
        if frame is None:
            return ()
        token = frame.sweep.token
        label_names = (tables.semantic_files.get(token), tables.panoptic_files.get(token))
        names = [frame.sweep.filename, *(name for name in label_names if name is not None)]
        where = f"sample_data {token!r}"
        files = [resolve_inside(tables.root, name, where) for name in names]
        return tuple(file for file in files if file.exists()) if files[0].exists() else ()

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """Return the content of one of these files for a weathered sweep."""
        sensor = self.frames[frame_index].sweep
        rows = sweep.columns[INDEX_COLUMN]
        in_air = is_in_air(sweep)
        noise = class_of_air(_class_meanings(self.tables), _class_names(self.tables), _NOISE_CLASS)
        if file.suffix == ".npz":
            return _panoptic_content(file, rows, in_air, noise)
        content = np.fromfile(file, np.uint8)
        if file != _path(self.tables, sensor):
            if rows.max(initial=-1) >= len(content):
                raise AdapterError(
                    f"{file} has {len(content)} classes, fewer than {sensor.filename} has returns; "
                    f"copy it again"
                )
            return np.where(in_air, np.uint8(noise), content[rows]).tobytes()
        records = content.view("<f4").reshape(-1, 5)
        return stored_records(records, _RECORD_COLUMNS, sweep, sensor.world_from_sensor)

    def _frame(self, index: int) -> FrameFiles | None:
        return self.frames[index] if 0 <= index < len(self.frames) else None


def _read_bytes(path: Path) -> bytes:
    """Read a whole file."""
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
    """Read the class of each return; or return None and a sentence if the labels are damaged."""
    name = tables.semantic_files.get(sweep.token)
    if name is None:
        return None, ""
    path = resolve_inside(tables.root, name, f"lidarseg of sample_data {sweep.token!r}")
    try:
        classes = np.frombuffer(_read_bytes(path), np.uint8)
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
    """Return the SemanticClass or NO_SURFACE by class number."""
    meanings = dict(_CLASSES)
    return {
        n: meanings.get(name, SemanticClass.UNKNOWN) for n, name in _class_names(tables).items()
    }


# NotImplementedError, RuntimeError: a compression or a password that zipfile does not know.
_NPZ_FAULTS = (
    *(OSError, ValueError, LookupError, EOFError, zlib.error, zipfile.BadZipFile),
    *(NotImplementedError, RuntimeError),
)


def _class_names(tables: SceneTables) -> Mapping[int, str]:
    """Return the class names by number: those of category.json, else the published ones."""
    return tables.class_names or {number: name for number, (name, _) in enumerate(_CLASSES)}


def _panoptic_content(file: Path, rows: np.ndarray, is_in_air: np.ndarray, noise: int) -> bytes:
    """Return a file of panoptic labels that holds the given rows of another one.

    Args:
        file: the recorded file.
        rows: int [N], rows of the recorded file.
        is_in_air: bool [N]. These returns get the class noise and belong to no object.
        noise: number of the class noise.
    """
    try:
        with zipfile.ZipFile(file) as archive, archive.open("data.npy") as member:
            opened_file: Any = member
            numbers = read_npy(opened_file)[rows]
            numbers[is_in_air] = _PANOPTIC_FACTOR * noise
    except _NPZ_FAULTS as error:
        raise AdapterError(
            f"{file} must hold an array `data`, one number a return ({error}); copy it again"
        ) from error
    array_bytes = io.BytesIO()
    archive_bytes = io.BytesIO()
    np.save(array_bytes, numbers)
    with zipfile.ZipFile(archive_bytes, "w") as archive:  # np.savez would write the time of day
        entry = zipfile.ZipInfo("data.npy")
        archive.writestr(entry, array_bytes.getvalue(), zipfile.ZIP_DEFLATED)
    return archive_bytes.getvalue()


def nuscenes_labels(path: str, query: dict[str, str]) -> NuScenesLabels:
    """Return the labels of a scene. They cover all its frames, whatever frames= says."""
    options = NuScenesOptions.from_query("nuscenes", query)
    tables = read_tables(Path(path), options.version, options.scene)
    return NuScenesLabels(tables, scene_frames(tables, sweeps=options.sweeps == "1")[0])


def boxes_of_sweep(tables: SceneTables, sweep: SensorFile) -> Boxes:
    """Return the boxes at a sweep's time, as NuScenesLabels describes."""
    tokens = [sample.token for sample in tables.samples]
    number = tokens.index(sweep.sample_token)
    sample = tables.samples[number]
    boxes = tables.samples[number].boxes
    interpolated = {"interpolated": np.full(len(boxes), not sweep.is_key_frame)}
    boxes = dataclasses.replace(boxes, attributes={**boxes.attributes, **interpolated})
    if sweep.is_key_frame or number == 0:
        return boxes
    previous_sample = tables.samples[number - 1]
    interval_ns = sample.timestamp_ns - previous_sample.timestamp_ns
    fraction = (
        (sweep.timestamp_ns - previous_sample.timestamp_ns) / interval_ns if interval_ns else 1.0
    )
    fraction = min(max(fraction, 0.0), 1.0)
    previous_rows = {name: i for i, name in enumerate(previous_sample.boxes.track_ids)}
    centers_m = boxes.centers_m.copy()
    quats = boxes.quats.copy()
    for i, name in enumerate(boxes.track_ids):
        if name in previous_rows:
            start = previous_sample.boxes.centers_m[previous_rows[name]]
            centers_m[i] = start + fraction * (boxes.centers_m[i] - start)
            quats[i] = slerp(
                previous_sample.boxes.quats[previous_rows[name]], boxes.quats[i], fraction
            )
    return dataclasses.replace(boxes, centers_m=centers_m, quats=quats)


def slerp(a: np.ndarray, b: np.ndarray, fraction: float) -> np.ndarray:
    """Return the unit quaternion at a fraction of the shorter rotation from `a` to `b`."""
    a = a / np.linalg.norm(a)
    b = b / np.linalg.norm(b)
    cosine = float(a @ b)
    if cosine < 0:
        b = -b
        cosine = -cosine
    if cosine > 1 - _MAX_COSINE_GAP:
        quat = a + fraction * (b - a)
    else:
        angle = np.arccos(cosine)
        quat = np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b
    return quat / np.linalg.norm(quat)


# ---- The scene -----------------------------------------------------------------------------------

# Attributes of boxes that move.
_MOVING_ATTRIBUTES = ("vehicle.moving", "pedestrian.moving", "cycle.with_rider")
# Elevation of the sensor's uppermost channel.
_LIDAR_TOP_DEG = 10.67
# Usable fraction of an image's rows, from the top, by camera. The back camera looks over the
# recording car's own edge, which begins at row 854 of 900 on a published image.
_ROWS_ABOVE_CAR = {"CAM_BACK": 0.945}


def open_nuscenes(path: str, query: dict[str, str]) -> Scene:
    """Open one scene of a nuScenes dataset.

    Opening is deterministic: the same files and options give the same bits.

    Args:
        path: the folder that holds v1.0-mini or such.
        query: version (a folder of tables) and scene (name or token), which are needed only if
            there are several; sweeps (1, the default: frames are keyframes and the LiDAR's sweeps
            between them; 0: keyframes only); frames, voxel_m, max_gaussians, image_scale, sky_size,
            held_out, see DriveOptions.

    Raises:
        AdapterError: an option is wrong; tables are missing, damaged or contradict each other;
            there is no LiDAR or no image; all images of a camera are damaged. Single images and
            sweeps that are missing or damaged are listed in Scene.problems.
    """
    options = NuScenesOptions.from_query("nuscenes", query)
    return scene_of_drive(read_nuscenes(path, query, options), options)


def read_nuscenes(path: str, query: dict[str, str], options: NuScenesOptions) -> RawDrive:
    """Read the frames of the scene that the options select, with their sweeps and boxes."""
    tables = read_tables(Path(path), options.version, options.scene)
    files, image_problems = scene_frames(tables, sweeps=options.sweeps == "1")
    where = f"nuscenes:{path}, scene {tables.name}"
    if not files:
        raise AdapterError(f"{where} has no keyframe of LIDAR_TOP; sweeps=1 takes its sweeps")
    selection = options.select(range(len(files)), where=where)
    frame_files = [files[number] for number in selection.numbers]
    origin = drive_origin(np.array([file.sweep.world_from_ego[:3, 3] for file in files]))
    pictures = [
        Picture(channel, f.index, _path(tables, image), image.size)
        for f in frame_files
        for channel, image in sorted(f.images.items())
    ]
    images = usable_images(pictures)
    frames = tuple(_frame(file, origin, images.paths.get(file.index, {})) for file in frame_files)
    sweeps, problems = read_sweeps(tables, [files[n] for n in selection.used], origin)
    return RawDrive(
        name=tables.name,
        source=format_uri("nuscenes", path, query),
        frames=frames,
        held_out=selection.held_out,
        sweeps=sweeps,
        boxes=moving_boxes(tables, frame_files, origin),
        labels=NuScenesLabels(tables, files),
        world_origin_m=origin,
        lidar_top_deg=_LIDAR_TOP_DEG,
        problems=(
            *image_problems,
            *selection.problems,
            *problems,
            *images.problems,
            *no_lens_note("images of nuScenes", options.lens),
        ),
        used_rows=_ROWS_ABOVE_CAR,
    )


def _path(tables: SceneTables, file: SensorFile) -> Path:
    """Return the path of a file of the dataset."""
    return resolve_inside(tables.root, file.filename, f"sample_data {file.token!r}")


def _frame(file: FrameFiles, origin: np.ndarray, paths: Mapping[str, str]) -> Frame:
    """Return a frame with the cameras of its images."""
    return Frame(
        index=file.index,
        timestamp_ns=file.sweep.timestamp_ns,
        world_from_ego=recenter_pose(file.sweep.world_from_ego, origin),
        cameras={
            name: Camera(
                name,
                *image.size,
                *image.intrinsic,
                camera_from_world=invert_rigid(recenter_pose(image.world_from_sensor, origin)),
                timestamp_ns=image.timestamp_ns,
            )
            for name, image in sorted(file.images.items())
        },
        image_paths=paths,
    )


def read_sweeps(
    tables: SceneTables, frames: Sequence[FrameFiles], world_origin_m: np.ndarray
) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """Read the usable returns of every frame that has a file, in the scene's world.

    Returns of the recording car, of no surface, and not finite ones are left out. A sentence is
    returned for everything that is missing.
    """
    sweeps = []
    problems = []
    missing_frames = []
    class_meanings = _class_meanings(tables) | {_EGO_CLASS: NO_SURFACE}
    for frame in tqdm(frames, desc="LiDAR", unit="sweep", disable=None):
        try:
            returns = read_returns(tables, frame.sweep)
        except FileNotFoundError:
            missing_frames.append(frame.index)
            continue
        except SweepFault as fault:
            problems.append(
                f"frame {frame.index}: {frame.sweep.filename} {fault}; its points are left out"
            )
            continue
        if returns.problem:
            problems.append(f"frame {frame.index}: {returns.problem}")
        unknown_classes = np.full(len(returns.points_m), SemanticClass.UNKNOWN, np.int16)
        classes = returns.classes
        semantic = unknown_classes if classes is None else world_classes(classes, class_meanings)
        with np.errstate(over="ignore"):  # of returns that are no numbers
            points = (returns.points_m - world_origin_m).astype(np.float32)
        sensor = (frame.sweep.world_from_sensor[:3, 3] - world_origin_m).astype(np.float32)
        sweep = Sweep(
            points, returns.timestamps_ns, semantic, np.broadcast_to(sensor, points.shape)
        )
        is_usable_return = is_usable(sweep, returns.points_m, frame.sweep.world_from_ego, EGO_BOX_M)
        sweeps.append(sweep.select(is_usable_return))
    if missing_frames:
        problems.append(
            f"the LiDAR's files of {describe_frames(missing_frames)} are missing, their points too"
        )
    return tuple(sweeps), tuple(problems)


def moving_boxes(
    tables: SceneTables, frames: Sequence[FrameFiles], world_origin_m: np.ndarray
) -> tuple[BoxSample, ...]:
    """Return the boxes of moving objects around the given frames, in the scene's world.

    An object moves if any of its boxes in the whole scene says so, or if it travels. The boxes are
    those of the keyframes around the frames' times, each at the time when the LiDAR met it.
    """
    sweeps = {file.sample_token: file for file in tables.lidar if file.is_key_frame}
    timed_boxes = []
    for number, sample in enumerate(tables.samples):
        boxes = sample.boxes
        sweep = sweeps.get(sample.token)
        times_ns = np.full(len(boxes), sample.timestamp_ns)
        if sweep is not None:  # when it met the box
            offsets = boxes.centers_m - sweep.world_from_sensor[:3, 3]
            times_ns -= tables.turn.before_ns(offsets @ sweep.world_from_ego[:3, :3])
        attribute_names = [text.split(",") for text in boxes.attributes["attributes"]]
        is_moving = np.array(
            [any(name in _MOVING_ATTRIBUTES for name in names) for names in attribute_names], bool
        )
        rotations = (
            Rotation.from_quat(boxes.quats[:, [1, 2, 3, 0]]).as_matrix()
            if attribute_names
            else None
        )
        timed_boxes.append(TimedBoxes(number, boxes, times_ns, is_moving, rotations))
    moving_samples = find_objects(
        timed_boxes, world_origin_m, allows_several_boxes=True
    ).moving_boxes
    first_time_ns = frames[0].sweep.timestamp_ns
    last_time_ns = frames[-1].sweep.timestamp_ns
    times = [sample.timestamp_ns for sample in tables.samples]
    start = max((i for i, time in enumerate(times) if time <= first_time_ns), default=0)
    stop = min((i for i, time in enumerate(times) if time >= last_time_ns), default=len(times) - 1)
    return tuple(box for box in moving_samples if start <= box.frame <= stop)
