"""Scenes of folders of raw data in this project's own layout: recordings, or outputs of
`climategs render`.

    images/<camera>/<frame>.png|jpg    required, with calibration.json
    lidar/<frame>.parquet              columns x y z (metres, world); timestamp_ns or t, semantic
    depth/<camera>/<frame>.png         without LiDAR: 16 bits, metres x 256, 0 = none
    labels/boxes.parquet               boxes; those that move become actors

Everything is in one world, that of calibration.json: metres, z up. docs/scenes.md has examples.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial import cKDTree
from tqdm import tqdm

from adapters.lidar_scene.depth import sweep_times, whole_numbers
from adapters.lidar_scene.image_views import View, read_image
from adapters.lidar_scene.scene import views_of, without_points
from adapters.lidar_scene.split import join_tracks
from adapters.lidar_scene.surfels import SplatShape, Surfels, gaussians_from_surfels
from adapters.plain_files import LARGEST
from adapters.raw_drive import (
    NO_SURFACE,
    BoxSample,
    DriveOptions,
    RawDrive,
    RecordedObjects,
    Sweep,
    TimedBoxes,
    class_of_air,
    describe_frames,
    find_objects,
    is_in_box,
    names_in,
    scene_of_drive,
    world_classes,
)
from adapters.recorded_lenses import split_lenses
from adapters.recording.files import (
    CALIBRATION,
    Calibration,
    block_files,
    find_images,
    numbered_files,
    read_calibration,
    read_lidar_classes,
    resolve_inside,
    unlisted_images,
)
from adapters.uri import format_uri
from augment.effects.lidar.beam import find_intensity_column
from augment.effects.lidar.codes import INDEX_COLUMN, is_in_air
from augment.errors import AdapterError, OutputError
from augment.output.codecs import decode_png, depth_in_metres
from augment.output.layout import SWEEP_FOLDER
from augment.output.names import folder_name
from augment.output.tables import (
    ATTRIBUTE_PREFIX,
    has_climategs_metadata,
    read_boxes,
    read_lidar,
    read_table,
)
from augment.scene.cameras import Camera, Frame
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Gaussians, Ground, Scene
from augment.scene.semantics import SemanticClass
from recipes.files import open_file

# ---- Boxes and sweeps, of a job or of any other program, with every column -----------------------

_VECTORS = {
    "centers_m": ("center_x_m", "center_y_m", "center_z_m"),
    "sizes_m": ("length_m", "width_m", "height_m"),
    "quats": ("qw", "qx", "qy", "qz"),
}
_REQUIRED = ("frame", "track_id", "label", *(name for names in _VECTORS.values() for name in names))
_CLASS = "semantic"  # the column of class numbers
_CACHED_FILES = 4  # box files kept: every frame asks for its own part of one
_DAMAGED = (OutputError, OSError, pa.ArrowException, KeyError, IndexError, TypeError, ValueError)
_LIDAR_FILE = "a LiDAR file with columns x, y, z"
_FAR_M = 1000.0  # no LiDAR on the ground sees this far
_OWN_M = 1.5  # returns nearer to the cameras' middle are likely on the recording car
_OWN_PART = 1e-3  # of all returns; a car's own are some hundreds a sweep
_TOP_QUANTILE = 0.999
_TOP_BEYOND_M = 5.0  # nearer, a camera's height says little of the sensor's
_TOP_DEG = (2.0, 60.0)


class FrameBoxes(NamedTuple):
    """Boxes of one frame. timestamps_ns: int64 [B], when each stood there.

    The result is None for the frame's time.
    """

    boxes: Boxes
    timestamps_ns: np.ndarray | None


@dataclass(frozen=True)
class RecordingLabels:
    """Labels of one recording, read on demand, in the recording's own world."""

    root: Path

    def boxes(self, frame_index: int) -> Boxes:
        timed = all_boxes(self.root).get(frame_index)
        return Boxes.empty() if timed is None else timed.boxes

    def lidar(self, frame_index: int) -> LidarSweep | None:
        files = self.lidar_files(frame_index)
        return read_sweep(files[0]) if files else None

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        path = lidar_files(self.root).get(frame_index)
        return () if path is None else (path,)

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        """Return a weathered sweep as a file with the columns, types and notes of the clear one."""
        with _reading(file, _LIDAR_FILE):
            table = read_table(file, str(file)).take(pa.array(sweep.columns[INDEX_COLUMN]))
            columns = {name: np.asarray(sweep.columns[name]) for name in "xyz"}
            if (intensity := find_intensity_column(sweep)) is not None:
                columns[intensity] = np.asarray(sweep.columns[intensity])
            if _CLASS in sweep.columns and is_in_air(sweep).any():
                columns[_CLASS] = self._classes_with_air(sweep)
            for name, values in columns.items():
                at = table.schema.get_field_index(name)
                field = table.schema.field(at)
                values = np.rint(values) if pa.types.is_integer(field.type) else values
                table = table.set_column(at, field, pa.array(values).cast(field.type, safe=False))
            sink = pa.BufferOutputStream()
            pq.write_table(table, sink)
            return sink.getvalue().to_pybytes()

    def _classes_with_air(self, sweep: LidarSweep) -> np.ndarray:
        """Return the class numbers of a weathered sweep.

        Returns that drops, flakes or fog made get the number that stands for no surface, else one
        of unknown class. Where the meaning of the numbers is not known, all stay as they are."""
        classes = np.asarray(sweep.columns[_CLASS])
        numbers = class_numbers(self.root / "lidar", classes)
        meaning, _ = class_meanings(read_lidar_classes(self.root), [numbers])
        if meaning is None:
            return classes
        return np.where(is_in_air(sweep), class_of_air(meaning, {}, ""), classes)

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        """Return the SemanticClass of each return, or NO_SURFACE.

        The result is None if the numbers have no known meaning.
        """
        column = sweep.columns.get(_CLASS)
        if column is None or len(column) == 0:
            return None
        numbers = class_numbers(self.root / "lidar", column)
        meaning, _ = class_meanings(read_lidar_classes(self.root), [numbers])
        return None if meaning is None else world_classes(numbers, meaning)

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """Return the columns origin_x, origin_y, origin_z, in the world of the returns, if all
        hold numbers.
        """
        return _origins_of(sweep)


def _origins_of(sweep: LidarSweep) -> np.ndarray | None:
    columns = [sweep.columns.get(f"origin_{axis}") for axis in "xyz"]
    if any(c is None or np.asarray(c).dtype.kind not in "fiu" for c in columns):
        return None
    return np.stack([np.asarray(column, np.float64) for column in columns], axis=1)


def recording_labels(path: str, query: dict[str, str]) -> RecordingLabels:
    """Return the labels of a folder. They cover all its frames, whatever the query."""
    return RecordingLabels(Path(path))


def lidar_files(root: Path) -> dict[int, Path]:
    """Return the sweeps' files by frame number.

    A variant that a job wrote has none of its own where the weather changed no sweep; those of its
    scene are returned then."""
    is_variant = (root / "recipe.yaml").is_file() and not (root / SWEEP_FOLDER).is_dir()
    return numbered_files(root.parent if is_variant else root, SWEEP_FOLDER, (".parquet",))


def all_boxes(root: Path) -> dict[int, FrameBoxes]:
    """Return the boxes of every frame that has any.

    They are read from labels/boxes.parquet, or else from a job's blocks, each of which has all
    boxes of its frames."""
    path = root / "labels" / "boxes.parquet"
    single_file = [resolve_inside(root, path)] if path.exists() else None
    boxes_by_frame: dict[int, FrameBoxes] = {}
    for path in single_file or block_files(root, "labels/boxes", ".parquet"):
        boxes_by_frame = read_frame_boxes(path) | boxes_by_frame
    return boxes_by_frame


def read_sweep(path: Path) -> LidarSweep:
    """Read the sweep in a file, every column under its own name."""
    with _reading(path, _LIDAR_FILE):
        if has_climategs_metadata(path):
            sweep = read_lidar(path)
        else:
            table = read_table(path, str(path))
            sweep = LidarSweep({n: _column(table, n) for n in table.column_names})
        _ = sweep.points_m  # numbers, not texts
        return sweep


def read_frame_boxes(path: Path) -> dict[int, FrameBoxes]:
    """Read the boxes of every frame that has any."""
    with _reading(path, f"a table of boxes with columns {', '.join(_REQUIRED)}"):
        state = path.stat()
        return _read_boxes(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=_CACHED_FILES)
def _read_boxes(path: Path, _changed_ns: int, _size: int) -> dict[int, FrameBoxes]:
    if has_climategs_metadata(path):
        return {
            number: FrameBoxes(f.boxes, np.full(len(f.boxes), f.timestamp_ns, np.int64))
            for number, f in read_boxes(path).items()
        }
    table = read_table(path, str(path))
    missing = [name for name in _REQUIRED if name not in table.column_names]
    if missing:
        raise ValueError(f"it lacks {missing}; it has {table.column_names}")
    frames = whole_numbers(_column(table, "frame"), "frame")
    order = np.argsort(frames, kind="stable")
    numbers, starts = np.unique(frames[order], return_index=True)
    parts = np.split(order, starts[1:]) if len(numbers) else []
    columns = {name: _column(table, name) for name in table.column_names}
    return {int(n): _boxes_at(columns, rows) for n, rows in zip(numbers, parts, strict=True)}


def _boxes_at(columns: dict[str, np.ndarray], rows: np.ndarray) -> FrameBoxes:
    vectors = {
        field: np.stack([columns[name][rows].astype(np.float64) for name in names], axis=1)
        for field, names in _VECTORS.items()
    }
    times = columns.get("timestamp_ns")
    used = {*_REQUIRED, "timestamp_ns"}
    return FrameBoxes(
        Boxes(
            names_in(columns["track_id"][rows]),
            names_in(columns["label"][rows]),
            **vectors,
            attributes={
                name.removeprefix(ATTRIBUTE_PREFIX): values[rows]
                for name, values in columns.items()
                if name not in used
            },
        ),
        None if times is None else whole_numbers(times[rows], "timestamp_ns"),
    )


def _column(table: pa.Table, name: str) -> np.ndarray:
    # A copy: Arrow's own memory is read-only, which torch.from_numpy warns about.
    return np.array(table[name].to_numpy())


@contextmanager
def _reading(path: Path, expected: str) -> Iterator[None]:
    try:
        open_file(path).close()  # to open a pipe would wait for ever
        yield
    except _DAMAGED as error:
        raise AdapterError(f"{path} is not {expected}: {error}") from error


def class_numbers(path: Path, column: np.ndarray) -> np.ndarray:
    """Return the column `semantic` as int64 [N]. path: its file or folder, for messages."""
    try:
        return whole_numbers(column, "semantic")
    except ValueError as error:
        raise AdapterError(f"{path}: {error}") from None


def class_meanings(
    lidar_classes: Mapping[int, int] | None, numbers: Sequence[np.ndarray]
) -> tuple[Mapping[int, int] | None, tuple[str, ...]]:
    """Return SemanticClass (or NO_SURFACE) by the files' class number, and the problems.

    The first is None where the meaning of the numbers is not known; then there is one problem, a
    sentence. lidar_classes: those of the calibration. numbers: the class numbers that occur."""
    if lidar_classes is not None:
        return lidar_classes, ()
    semantic_numbers = {number: number for number in range(SemanticClass.SKY)}
    for column in numbers:
        invalid = column[(column < 0) | (column >= SemanticClass.SKY)]
        if len(invalid):
            return None, (
                f"lidar/: the column semantic holds {int(invalid.min())}, which is no "
                f"SemanticClass (0 to {SemanticClass.SKY - 1}): classes are ignored. Say what "
                f'the numbers mean in calibration.json: "lidar_classes": {{"7": "road", ...}}',
            )
    return semantic_numbers, ()


class LidarDrive(NamedTuple):
    """LiDAR of a drive.

    Attributes:
        sweeps: one for each frame that has a file, scene world.
        top_deg: approximate highest elevation that the LiDAR measures.
        problems: one sentence each.
    """

    sweeps: tuple[Sweep, ...]
    top_deg: float
    problems: tuple[str, ...]


def read_lidar_drive(root: Path, calibration: Calibration, frames: Sequence[Frame]) -> LidarDrive:
    """Read the sweeps of the given frames.

    Returns that are not finite, of no surface, or of the recording car (ego_box_m) are left out.
    """
    files = lidar_files(root)
    lidar_frames = [frame for frame in frames if frame.index in files]
    missing = [frame.index for frame in frames if frame.index not in files] if files else []
    problems = []
    if missing:
        problems.append(
            f"lidar/: the files of {describe_frames(missing)} are missing, their points too"
        )
    raws = []
    timeless = []
    for frame in tqdm(lidar_frames, desc="LiDAR", unit="frame", disable=None):
        sweep, numbers, has_times = _read_returns(files[frame.index], frame, calibration)
        raws.append((sweep, numbers))
        timeless += [] if has_times else [frame.index]
    if timeless:
        problems.append(
            f"lidar/: no column timestamp_ns, or t in seconds, near the frame's time in "
            f"{len(timeless)} sweeps (the first of frame {timeless[0]}); their frames' times are "
            f"used, fast objects are smeared"
        )
    occurring = [numbers for _, numbers in raws if numbers is not None]
    meaning, class_problems = class_meanings(calibration.lidar_classes, occurring)
    sweeps = []
    for sweep, numbers in raws:
        if numbers is not None and meaning is not None:
            semantic = world_classes(numbers, meaning)
            sweep = dataclasses.replace(sweep, semantic=semantic).select(semantic != NO_SURFACE)
        sweeps.append(sweep)
    if calibration.ego_box_m is None:
        problems += _own_returns(sweeps, lidar_frames)
    return LidarDrive(tuple(sweeps), _top_deg(sweeps, lidar_frames), (*problems, *class_problems))


def _read_returns(
    path: Path, frame: Frame, calibration: Calibration
) -> tuple[Sweep, np.ndarray | None, bool]:
    """Return the finite returns of a sweep that are not on the recording car, of unknown class.

    Also returns their class numbers in the file, int64 or None, and True if the file has a time
    for each return."""
    sweep = read_sweep(path)
    world = sweep.points_m - calibration.world_origin_m
    pose = frame.world_from_ego.numpy()
    keep = (np.abs(world) <= LARGEST).all(axis=1)  # not NaN, and float32 has it
    ego = (np.where(keep[:, None], world, 0) - pose[:3, 3]) @ pose[:3, :3]
    if keep.any() and np.median(np.abs(ego[keep]).max(axis=1)) > _FAR_M:
        raise AdapterError(
            f"{path}: most returns lie more than {_FAR_M:.0f} m from the car as calibration.json "
            f"has it in frame {frame.index}; x, y, z must be metres in the world of its poses, not "
            f"in the sensor's"
        )
    if calibration.ego_box_m is not None:
        keep &= ~is_in_box(ego, *calibration.ego_box_m)
    try:
        times = sweep_times(sweep, frame.timestamp_ns)
    except ValueError as error:
        raise AdapterError(f"{path}: {error}") from None
    origins = _origins_of(sweep)
    if origins is not None:
        origins = (origins - calibration.world_origin_m)[keep]
        origins = origins if np.isfinite(origins).all() else None
    returns = Sweep.of_unknown_class(world[keep], frame.timestamp_ns, origins)
    if times is not None:
        returns = dataclasses.replace(returns, timestamps_ns=times[keep])
    column = sweep.columns.get("semantic")
    numbers = None if column is None else class_numbers(path, column)[keep]
    return returns, numbers, times is not None


def _own_returns(sweeps: Sequence[Sweep], frames: Sequence[Frame]) -> list[str]:
    """Return a sentence if the LiDAR seems to see its own car.

    frames: those of the sweeps, in the same order."""
    near = total = 0
    for sweep, frame in zip(sweeps, frames, strict=True):
        if frame.cameras:
            total += len(sweep)
            distance = np.linalg.norm(sweep.points - _middle(frame), axis=1)
            near += int((distance < _OWN_M).sum())
    if near <= _OWN_PART * total:
        return []
    return [
        f"lidar/: {near} of {total} returns lie within {_OWN_M} m of the cameras' middle, likely "
        f"on the recording car, which they smear along the road; give ego_box_m in "
        f"calibration.json to leave them out"
    ]


def _middle(frame: Frame) -> np.ndarray:
    """Return the middle of a frame's cameras, float64 [3]."""
    return np.mean([camera.centre.numpy() for camera in frame.cameras.values()], axis=0)


def _top_deg(sweeps: Sequence[Sweep], frames: Sequence[Frame]) -> float:
    """Estimate the elevation of the LiDAR's highest channel, degrees.

    It is that of nearly the steepest return. The sensor's height is not known, so elevations are
    those seen from the height of the cameras."""
    rises = []
    for sweep, frame in zip(sweeps, frames, strict=True):
        if not frame.cameras or not len(sweep):
            continue
        offset = sweep.points - _middle(frame)
        reach = np.hypot(offset[:, 0], offset[:, 1])
        far = reach > _TOP_BEYOND_M
        rises.append(np.degrees(np.arctan2(offset[far, 2], reach[far])))
    joined = np.concatenate(rises) if rises else np.zeros(0)
    top = float(np.quantile(joined, _TOP_QUANTILE)) if len(joined) else 0.0
    return float(np.clip(top, *_TOP_DEG))


# ---- The scene -----------------------------------------------------------------------------------

_MIN_RETURNS = 100  # no surface is found among fewer
_DEPTH_TOP_DEG = 90.0  # what a depth image leaves open has no surface, however high it is
_SKY_ABOVE_DEG = 15.0  # with nothing but a flat ground drawn, every column's top is sky

# Depth images back-projected: sweeps for a drive without LiDAR.
_POINTS_PER_IMAGE = 40_000  # more than the voxels near the path need of each image of a drive
_MAX_DEPTH_M = 200.0  # beyond, one step of the file's may be less than the depth's own error
# A pixel whose inverse depth is off the line through its neighbours by more than this part lies on
# an edge, where renderers and estimators mix two depths. A plane's inverse depth is linear.
_BENT = 0.05

# Surfaces for a drive of which no distance is known: a start for reconstruction, no more. The road
# is taken to lie under the ego origin, objects fill their boxes, and what the images show elsewhere
# may be at any distance: nearly transparent splats on shells around the cameras, among which
# optimisation chooses.
_MAX_GAUSSIANS = 60_000
_SHELL_SHARE = 2 / 3  # of them; the rest are ground and boxes
_VOXEL_M = 0.15  # finer ground would only be a finer guess
_SHELLS_M = 4.0 * 20.0 ** (np.arange(6) / 5)  # 4 m to 80 m, a factor of 1.8 apart
_GROUND_REACH_M = 40.0  # the guessed ground ends this far from the path
_GROUND_STEP_M = 0.5  # between points of the guessed ground
_BOX_STEP_M = 0.15  # between points of a box's faces
_MAX_VIEWS = 48  # images that shells are guessed from
_DRIVEN_M = 1.6  # the car went through here: nothing stands there
_MIN_CAMERA_HEIGHT_M = 0.1  # above the guessed ground; a lower camera is refused
_ABOVE_GROUND_M = 0.2  # a ray that is lower at a shell has met the ground before
_SHAPE = SplatShape(sigma_per_spacing=0.5, opacity=0.1)
_IMAGE_SCALE = 0.125  # at which images are read for the colours of shells
_SMALL_PX = 64  # images with a shorter side are read at their own size
_NEVER_NS = -(2**62)  # a time at which no object exists: these points belong to the static world


def open_recording(path: str, query: dict[str, str]) -> Scene:
    """Open the scene of a recording's folder, such as `out/street-seed3/clear-000`.

    Opening is deterministic: the same files and options give the same bits. Without LiDAR the scene
    starts from depth images, or else from guesses; Scene.problems says which.

    Args:
        path: the folder.
        query: frames, voxel_m, max_gaussians, image_scale, sky_size, held_out; see DriveOptions.

    Raises:
        AdapterError: an option is wrong; calibration is missing, damaged or not finite; there is no
            usable image; a LiDAR file or the table of boxes is damaged; a file is outside the
            folder.
    """
    options = DriveOptions.from_query("recording", query)
    drive, calibration = read_recording(path, query, options)
    scene = _best_scene(Path(path), drive, calibration, options)
    missing = without_points(join_tracks(drive.boxes), scene)
    return dataclasses.replace(scene, problems=scene.problems + missing)


def read_recording(
    path: str, query: dict[str, str], options: DriveOptions
) -> tuple[RawDrive, Calibration]:
    """Read the frames that the options ask for, with their boxes and LiDAR sweeps, if any."""
    root = Path(path)
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected one with calibration.json in it")
    calibration = read_calibration(root)
    numbers = [frame.index for frame in calibration.frames]
    chosen = options.select(numbers, where=f"recording:{path}")
    listed = [frame for frame in calibration.frames if frame.index in set(chosen.numbers)]
    recorded_frames, image_problems = find_images(root, listed)
    lens_frames = split_lenses(
        calibration.name,
        recorded_frames,
        options.lens,
        published=f"images of {root}, whose {CALIBRATION} states no lens,",
    )
    frames = lens_frames.frames
    used = [frame for frame in frames if frame.index not in chosen.held_out]
    objects = read_objects(root, frames, calibration.world_origin_m)
    lidar = read_lidar_drive(root, calibration, used)
    drive = RawDrive(
        name=calibration.name,
        source=format_uri("recording", path, query),
        frames=frames,
        held_out=chosen.held_out,
        sweeps=lidar.sweeps,
        boxes=objects.moving_boxes,
        labels=RecordingLabels(root),
        world_origin_m=calibration.world_origin_m,
        lidar_top_deg=lidar.top_deg,
        problems=(
            *unlisted_images(root, calibration.frames),
            *image_problems,
            *chosen.problems,
            *objects.problems,
            *lidar.problems,
            *lens_frames.notes,
        ),
        has_metric_scale=calibration.has_metric_scale,
        recorded_frames=lens_frames.recorded_frames,
    )
    return drive, calibration


def read_objects(root: Path, frames: Sequence[Frame], origin: np.ndarray) -> RecordedObjects:
    """Read the objects in the boxes of the frames, in the scene's world."""
    boxes = all_boxes(root)
    timed = (
        TimedBoxes(f.index, frame_boxes.boxes, f.timestamp_ns if times is None else times)
        for f in frames
        if (frame_boxes := boxes.get(f.index)) is not None
        for times in [frame_boxes.timestamps_ns]
    )
    return find_objects(timed, origin)


def _best_scene(
    root: Path, drive: RawDrive, calibration: Calibration, options: DriveOptions
) -> Scene:
    """Return the scene from LiDAR, else from depth images, else from guesses."""
    count = sum(map(len, drive.sweeps))
    if count >= _MIN_RETURNS or not any(frame.image_paths for frame in drive.used):
        return scene_of_drive(drive, options)
    start = f"{root / 'lidar'} holds {count or 'no'} returns"
    used_numbers = {frame.index for frame in drive.used}
    used = [frame for frame in calibration.frames if frame.index in used_numbers]
    sweeps, problems = depth_sweeps(root, used)  # depth images have the lens of the image
    if any(map(len, sweeps)):
        start += f": the scene starts from the points of {len(sweeps)} depth images"
        problems = (*drive.problems, *problems, start)
        depth_drive = dataclasses.replace(
            drive, sweeps=sweeps, lidar_top_deg=_DEPTH_TOP_DEG, problems=problems
        )
        return scene_of_drive(depth_drive, options)
    start += (
        f" and {root / 'depth'} no depth: the scene starts from a flat ground "
        f"{calibration.ego_above_ground_m:g} m below the ego origin, the labelled boxes, and "
        f"splats guessed along the cameras' rays; reconstruct it before rendering it"
    )
    road = ground_heights(drive.frames, calibration.ego_above_ground_m)
    check_cameras_above(root / CALIBRATION, drive.frames, road)
    budget = min(_MAX_GAUSSIANS, options.max_gaussians)
    shells = guess_shells(views_of(drive.used), road, round(budget * _SHELL_SHARE))
    coarse = options.model_copy(
        update={"voxel_m": max(_VOXEL_M, options.voxel_m), "max_gaussians": budget - len(shells)}
    )
    objects = read_objects(root, drive.frames, drive.world_origin_m)
    guessed_drive = dataclasses.replace(
        drive,
        sweeps=guess_surfaces(road, objects.moving_boxes, objects.static_boxes),
        lidar_top_deg=_SKY_ABOVE_DEG,
        problems=(*drive.problems, *problems, start),
    )
    # Whatever is found in the guessed surfaces is the height they were given.
    ground = Ground(float(road[:, 2].min()), float(np.median(road[:, 2])), "ego path")
    return scene_of_drive(guessed_drive, coarse, extra_background=shells, ground=ground)


def depth_sweeps(root: Path, frames: Sequence[Frame]) -> tuple[tuple[Sweep, ...], tuple[str, ...]]:
    """Return one sweep per depth image of the frames' cameras, and a sentence for each unusable
    image.

    Each point has its camera's time.
    """
    sweeps = []
    problems = []
    names = dict.fromkeys(name for frame in frames for name in frame.cameras)
    files = {n: numbered_files(root, f"depth/{folder_name(n)}", (".png",)) for n in names}
    for frame in frames:
        for name, camera in frame.cameras.items():
            path = files[name].get(frame.index)
            if path is None:
                continue
            try:
                with open_file(path) as file:
                    depth_m = depth_in_metres(decode_png(file.read(), np.uint16))
                if depth_m.shape != (camera.height, camera.width):
                    raise ValueError(
                        f"it is {depth_m.shape[1]}x{depth_m.shape[0]} pixels, the camera "
                        f"{camera.width}x{camera.height}"
                    )
            except (OSError, ValueError) as error:
                problems.append(f"camera {name}, frame {frame.index}: depth {path}: {error}")
                continue
            sweeps.append(back_project(depth_m, camera))
    return tuple(sweeps), tuple(problems)


def back_project(depth_m: np.ndarray, camera: Camera) -> Sweep:
    """Return points of a depth image [H, W], about _POINTS_PER_IMAGE at most, on a regular grid
    of pixels.

    Depth is z, or the distance along the ray if the camera's lens says so. Pixels without depth,
    far away, or on edges between near and far give no point.
    """
    inverse = np.where(depth_m > 0, 1 / np.maximum(depth_m, 1e-3), 0).astype(np.float32)
    usable = (depth_m > 0) & (depth_m < _MAX_DEPTH_M)
    usable[1:-1] &= _is_straight(inverse[:-2], inverse[1:-1], inverse[2:])
    usable[:, 1:-1] &= _is_straight(inverse[:, :-2], inverse[:, 1:-1], inverse[:, 2:])
    step = max(1, math.ceil(math.sqrt(depth_m.size / _POINTS_PER_IMAGE)))
    rows, columns = np.nonzero(usable[step // 2 :: step, step // 2 :: step])
    rows = rows * step + step // 2
    columns = columns * step + step // 2
    z = depth_m[rows, columns].astype(np.float64)
    if camera.lens is not None:
        pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
        rays, is_inside = camera.lens.rays(pixels, camera.intrinsics)
        if not camera.lens.is_depth_along_ray:
            rays = rays / rays[:, 2:]
        local = (rays * z[:, None])[is_inside]
    else:
        x = (columns + 0.5 - camera.cx) / camera.fx
        y = (rows + 0.5 - camera.cy) / camera.fy
        local = np.stack([x * z, y * z, z], axis=1)
    pose = camera.world_from_camera.numpy()
    return Sweep.of_unknown_class(local @ pose[:3, :3].T + pose[:3, 3], camera.timestamp_ns)


def _is_straight(before: np.ndarray, middle: np.ndarray, after: np.ndarray) -> np.ndarray:
    return np.abs(before + after - 2 * middle) <= _BENT * middle


def ground_heights(frames: Sequence[Frame], ego_above_ground_m: float) -> np.ndarray:
    """Return points of the road under the ego origins, float64 [F, 3]."""
    poses = np.stack([frame.world_from_ego.numpy() for frame in frames])
    return poses[:, :3, 3] - ego_above_ground_m * poses[:, :3, 2]


def check_cameras_above(path: Path, frames: Sequence[Frame], road: np.ndarray) -> None:
    """Raises AdapterError where a camera is not above the ground. path: of the calibration."""
    for frame, ground in zip(frames, road, strict=True):
        for name, camera in frame.cameras.items():
            height_m = float(camera.centre[2]) - ground[2]
            if height_m < _MIN_CAMERA_HEIGHT_M:
                raise AdapterError(
                    f"{path}, frame {frame.index}, camera {name!r}: it is {height_m:.2f} m above "
                    f"the ground that is taken to lie under the ego origin; without LiDAR or depth "
                    f"the ground must be known: give ego_above_ground_m, the ego origin's height"
                )


def guess_surfaces(
    road: np.ndarray, moving: Sequence[BoxSample], still: Sequence[BoxSample]
) -> tuple[Sweep, ...]:
    """Return points on the ground around the path, and on the sides and tops of all boxes.

    road: float64 [F, 3]; the nearest pose's height counts.
    """
    box_of_object = {box.object_id: box for box in reversed(moving)}
    point_sets = [(_ground(road), _NEVER_NS)]
    point_sets += [(_box_surface(box), _NEVER_NS) for box in still]
    point_sets += [(_box_surface(box), box.timestamp_ns) for box in box_of_object.values()]
    return tuple(Sweep.of_unknown_class(*point_set) for point_set in point_sets)


def guess_shells(views: Sequence[View], road: np.ndarray, count: int) -> Gaussians:
    """Return about `count` Gaussians at the distances _SHELLS_M along rays of the images.

    Neighbours are at different distances. There are none where the car drove, under the ground, or
    without an image.
    """
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, _MAX_VIEWS).astype(int))]
    tree = cKDTree(road[:, :2])
    parts = []
    for number, view in enumerate(chosen):
        small = min(view.camera.width, view.camera.height) < _SMALL_PX
        image = read_image(view.path, 1.0 if small else _IMAGE_SCALE)
        if image is not None:
            parts.append(_shell_points(view.camera, image, number, count // len(chosen)))
    if not parts:
        return Gaussians.empty()
    points, normals, spacing, colours = (np.concatenate(p) for p in zip(*parts, strict=True))
    distance, nearest = tree.query(points[:, :2])
    keep = (distance > _DRIVEN_M) & (points[:, 2] > road[nearest, 2] + _ABOVE_GROUND_M)
    return _facing(points[keep], normals[keep], spacing[keep], colours[keep])


def _ground(road: np.ndarray) -> np.ndarray:
    low = np.floor((road[:, :2].min(axis=0) - _GROUND_REACH_M) / _GROUND_STEP_M)
    high = np.ceil((road[:, :2].max(axis=0) + _GROUND_REACH_M) / _GROUND_STEP_M)
    ticks = [np.arange(a, b + 1) * _GROUND_STEP_M for a, b in zip(low, high, strict=True)]
    xy = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 2)
    distance, nearest = cKDTree(road[:, :2]).query(xy)
    near = distance < _GROUND_REACH_M
    return np.column_stack([xy[near], road[nearest[near], 2]])


def _box_surface(box: BoxSample) -> np.ndarray:
    """Return a grid on the five faces of a box that can be seen from the street, world, [N, 3]."""
    half = box.size_m / 2
    faces = []
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1), (2, 1)):
        side_axes = [side for side in range(3) if side != axis]
        counts = [max(2, int(np.ceil(2 * half[side] / _BOX_STEP_M)) + 1) for side in side_axes]
        ticks = [
            np.linspace(-half[side], half[side], min(count, 200))
            for side, count in zip(side_axes, counts, strict=True)
        ]
        a, b = np.meshgrid(*ticks)
        face = np.empty((a.size, 3))
        face[:, axis] = sign * half[axis]
        face[:, side_axes[0]] = a.ravel()
        face[:, side_axes[1]] = b.ravel()
        faces.append(face)
    local = np.concatenate(faces)
    return local @ box.world_from_box[:3, :3].T + box.world_from_box[:3, 3]


def _shell_points(
    camera: Camera, image: np.ndarray, number: int, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return points, unit directions back to the camera, spacings (metres) and colours of one
    image.
    """
    columns = max(1, round((count * camera.width / camera.height) ** 0.5))
    rows = max(1, round(count / columns))
    colours = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    grid = camera.scaled(columns / camera.width)
    u = (np.arange(columns) + 0.5) / columns * camera.width
    v = (np.arange(rows) + 0.5) / rows * camera.height
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    local = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rotation = camera.world_from_camera.numpy()[:3, :3]
    rays = local @ rotation.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    j, i = np.divmod(np.arange(rows * columns), columns)
    # Neighbours in a row get all distances in turn; rows and images begin elsewhere.
    distance = _SHELLS_M[(i + 2 * j + number) % len(_SHELLS_M)]
    # The points of one shell are sqrt(shells) rays apart.
    spacing = distance / grid.fx * len(_SHELLS_M) ** 0.5
    points = camera.centre.numpy() + distance[:, None] * rays
    return points, -rays, spacing, colours.reshape(-1, 3).astype(np.float32) / 255


def _facing(
    points: np.ndarray, normals: np.ndarray, spacing: np.ndarray, colours: np.ndarray
) -> Gaussians:
    if len(points) == 0:
        return Gaussians.empty()
    up = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    major = np.cross(up, normals)
    major /= np.linalg.norm(major, axis=1, keepdims=True)
    surfels = Surfels.discs(points, normals, major, spacing)
    semantic = np.full(len(points), SemanticClass.UNKNOWN, np.int16)
    return gaussians_from_surfels(surfels, colours.astype(np.float32), semantic, _SHAPE)
