"""A Street Gaussians dataset directory as a trained model sees it, and its frames.

    intrinsics/<cam>.txt          fx fy cx cy and distortion, which is not used
    extrinsics/<cam>.txt          ego_from_camera, OpenCV axes
    ego_pose/<frame>.txt          world_from_ego at the frame's time
    ego_pose/<frame>_<cam>.txt    the same at the camera's
    timestamps.json               seconds by FRAME or camera name, then by frame

`read_data` reads all of it. World: the dataset's, minus the mean position of the car over all its
frames, as the models are trained. Vehicle frame: x forward, y left, z up. Times are seconds as the
dataset has them. The callers are `adapters.street_gaussians.adapter` and `.model`.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    RootModel,
    StrictBool,
    StrictInt,
    field_validator,
)

from adapters.camera_files.camera_files import validate
from adapters.plain_files import read_json, read_numbers, read_pose, read_text
from adapters.raw_drive import Picture, image_notes
from adapters.world import invert_pose
from augment.errors import AdapterError
from augment.files.image_size import ImageHeader, read_image_header
from augment.files.recorded_images import exif_hint
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import quat_from_rotmat, rotmat_from_quat, slerp
from augment.scene.lenses import OpenCVLens

CAMERA_NAMES = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
Number = Annotated[int, Field(ge=0, lt=10**9)]  # of a frame or object


class ModelConfig(BaseModel):
    """The part of a model's configuration that decides how the model is read, by its keys there.

    The defaults are the project's. cameras: numbers in CAMERA_NAMES. selected_frames: first and
    last, both included; None for all. split_test, split_train: step between frames that are held
    out or trained on; -1 if unused.
    """

    model_config = ConfigDict(frozen=True, populate_by_name=True)

    source_path: str = ""
    cameras: tuple[StrictInt, ...] = Field((0, 1, 2), alias="data.cameras")
    selected_frames: tuple[StrictInt, StrictInt] | None = Field(None, alias="data.selected_frames")
    use_tracker: StrictBool = Field(False, alias="data.use_tracker")
    split_test: StrictInt = Field(-1, alias="data.split_test")
    split_train: StrictInt = Field(-1, alias="data.split_train")
    white_background: StrictBool = Field(False, alias="data.white_background")
    fourier_scale: float = Field(
        1.0, strict=True, allow_inf_nan=False, alias="model.gaussian.fourier_scale"
    )
    include_sky: StrictBool = Field(False, alias="model.nsg.include_sky")
    opt_track: StrictBool = Field(True, alias="model.nsg.opt_track")
    use_color_correction: StrictBool = Field(False, alias="model.use_color_correction")
    color_correction_mode: Literal["image", "sensor"] = Field(
        "image", alias="model.color_correction.mode"
    )
    color_correction_mlp: StrictBool = Field(False, alias="model.color_correction.use_mlp")
    use_pose_correction: StrictBool = Field(False, alias="model.use_pose_correction")
    pose_correction_mode: Literal["image", "frame"] = Field(
        "image", alias="model.pose_correction.mode"
    )

    @field_validator("cameras")
    @classmethod
    def _are_known(cls, cameras: tuple[int, ...]) -> tuple[int, ...]:
        known_cameras = range(len(CAMERA_NAMES))
        if (
            not cameras
            or len(set(cameras)) != len(cameras)
            or not set(cameras) <= set(known_cameras)
        ):
            raise ValueError(f"must be different camera numbers from 0 to {known_cameras[-1]}")
        return cameras

    @field_validator("selected_frames")
    @classmethod
    def _are_in_order(cls, pair: tuple[int, int] | None) -> tuple[int, int] | None:
        if pair is not None and not 0 <= pair[0] <= pair[1]:
            raise ValueError("must be [first, last] or null")
        return pair


class Lens(NamedTuple):
    """Calibration of a camera: intrinsics in pixels, and camera_from_ego, float64 [4, 4], OpenCV
    axes.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_ego: np.ndarray


@dataclass(frozen=True, eq=False)
class StreetImage:
    """One image, or a camera without its image.

    Attributes:
        frame: number of the frame.
        cam: number in CAMERA_NAMES.
        path: the image's file. None without an image.
        timestamp_s: time of the image.
        world_from_ego: float64 [4, 4], at the moment of the image.
        camera: the camera.
        is_held_out: True if the image was not trained on.
        number: position among all images of the selected frames and cameras, by frame, then camera,
            including left-out ones. It is the index of per-image corrections.
    """

    frame: int
    cam: int
    path: Path | None
    timestamp_s: float
    world_from_ego: np.ndarray
    camera: Camera
    is_held_out: bool
    number: int

    @property
    def name(self) -> str:
        return CAMERA_NAMES[self.cam]

    @property
    def timestamp_ns(self) -> int:
        return round(self.timestamp_s * 1e9)


@dataclass(frozen=True, eq=False)
class TrackedObject:
    """A moving object of the model: `obj_{track_id:03d}`.

    Attributes:
        track_id: its number.
        label: its class.
        size_m: length, width, height. Training kept splats in a box that was wider and longer by
            data.box_scale.
        start_frame, end_frame: first and last frame of its track.
        start_s, end_s: time span in which it is drawn.
    """

    track_id: int
    label: str
    size_m: tuple[float, float, float]
    start_frame: int
    end_frame: int
    start_s: float
    end_s: float


@dataclass(frozen=True, eq=False)
class Tracklets:
    """Places of objects in each of F selected frames, in the columns of the model.

    Attributes:
        ids: int64 [F, M], -1 for none.
        positions: float64 [F, M, 3], metres, vehicle frame at the frame's time.
        quats: float64 [F, M, 4], wxyz.
    """

    ids: np.ndarray
    positions: np.ndarray
    quats: np.ndarray


@dataclass(frozen=True, eq=False)
class StreetData:
    """A dataset directory as a model sees it.

    Attributes:
        root: the directory.
        world_origin_m: float64 [3], subtracted from the dataset's world.
        frames: selected numbers, ascending.
        frame_times_s: float64 [F].
        world_from_ego: float64 [F, 4, 4]. If the file is missing, the pose lies between its
            neighbours', so that the rows stay those of the model; such a frame has no images.
        images: by frame, then camera.
        objects: moving objects, in the track file's order.
        tracklets: places of the objects.
        problems: one sentence each.
    """

    root: Path
    world_origin_m: np.ndarray
    frames: tuple[int, ...]
    frame_times_s: np.ndarray
    world_from_ego: np.ndarray
    images: tuple[StreetImage, ...]
    objects: tuple[TrackedObject, ...]
    tracklets: Tracklets
    problems: tuple[str, ...] = ()


# ---- Cameras, poses and times --------------------------------------------------------------------

# Name of the file of times.
TIMES = "timestamps.json"
# Name of a file with the pose of a frame.
_FRAME_POSE = re.compile(r"([0-9]{1,9})\.txt")
# Largest number of frames between the first and the last of which nothing is known.
_MAX_GAPS = 1000
_Seconds = dict[Number, Annotated[float, Field(strict=True, ge=0, lt=9e9, allow_inf_nan=False)]]


class _Times(BaseModel):
    FRAME: Annotated[_Seconds, Field(min_length=1)]
    FRONT: _Seconds = {}
    FRONT_LEFT: _Seconds = {}
    FRONT_RIGHT: _Seconds = {}
    SIDE_LEFT: _Seconds = {}
    SIDE_RIGHT: _Seconds = {}


def read_times(root: Path) -> dict[str, dict[int, float]]:
    """Read seconds by FRAME or camera name, then frame number."""
    path = root / TIMES
    return validate(_Times, read_json(path), path, "table of seconds by frame").model_dump()


@dataclass(frozen=True, eq=False)
class EgoPath:
    """The car at every frame of the drive, in the dataset's world.

    Attributes:
        numbers: consecutive frame numbers.
        times_s: float64 [N].
        world_from_ego: float64 [N, 4, 4].
        is_known: bool [N], False if the pose is missing and was interpolated.
        camera_times_s: by camera name, then frame number.
        problems: one sentence each.
    """

    numbers: range
    times_s: np.ndarray
    world_from_ego: np.ndarray
    is_known: np.ndarray
    camera_times_s: Mapping[str, Mapping[int, float]]
    problems: tuple[str, ...]


def calibrated_cameras(root: Path) -> tuple[int, ...]:
    """Return the numbers of the cameras that have extrinsics."""
    return tuple(c for c in range(len(CAMERA_NAMES)) if (root / f"extrinsics/{c}.txt").exists())


def read_lens(root: Path, cam: int) -> Lens:
    """Read a camera's calibration."""
    path = root / "intrinsics" / f"{cam}.txt"
    values = read_numbers(path)
    if values.size < 4 or min(values[:2]) <= 0:
        raise AdapterError(
            f"{path} must begin with fx fy cx cy in pixels, fx and fy > 0; got {values.tolist()}"
        )
    ego_from_camera = read_pose(root / "extrinsics" / f"{cam}.txt")
    return Lens(*values[:4].tolist(), invert_pose(ego_from_camera))


def read_ego_path(root: Path) -> EgoPath:
    """Read every frame's pose and time."""
    folder = root / "ego_pose"
    if not folder.is_dir():
        raise AdapterError(
            f"{folder} does not exist; expected a drive in Street Gaussians' layout, with "
            f"ego_pose/, extrinsics/, intrinsics/, track/ and {TIMES}"
        )
    pose_files = {int(m[1]): p for p in folder.iterdir() if (m := _FRAME_POSE.fullmatch(p.name))}
    if not pose_files:
        raise AdapterError(f"{folder} holds no pose NNNNNN.txt; copy the folder from the dataset")
    times = read_times(root)
    frame_times_s = dict(sorted(times["FRAME"].items()))
    if frames_without_time := sorted(set(pose_files) - set(frame_times_s)):
        raise AdapterError(
            f"{root / TIMES}: FRAME lacks frame {frames_without_time[0]:06d}, of which there is "
            f"{pose_files[frames_without_time[0]]}; both must be of one conversion"
        )
    numbers = range(min(frame_times_s), max(frame_times_s) + 1)
    if len(numbers) - len(frame_times_s) > _MAX_GAPS:
        raise AdapterError(
            f"{root / TIMES}: FRAME must hold consecutive frames; it holds {len(frame_times_s)} "
            f"from {numbers[0]} to {numbers[-1]}"
        )
    has_pose = np.array([number in pose_files for number in numbers])
    times_s = np.interp(numbers, list(frame_times_s), list(frame_times_s.values()))
    if not (np.diff(times_s) > 0).all():
        raise AdapterError(f"{root / TIMES}: the seconds of FRAME must increase with the frames")
    poses = _fill_missing_poses(
        times_s, has_pose, np.stack([read_pose(pose_files[n]) for n in sorted(pose_files)])
    )
    problems = ()
    if frames_without_pose := [numbers[i] for i in np.flatnonzero(~has_pose)]:
        problems = (
            f"{folder} lacks the poses of {len(frames_without_pose)} of {len(numbers)} frames, "
            f"such as {frames_without_pose[0]:06d}: these frames are left out, and the middle of "
            f"the drive, on which the world of trained models is centred, is guessed from the "
            f"frames beside them",
        )
    return EgoPath(numbers, times_s, poses, has_pose, times, problems)


def _fill_missing_poses(times_s: np.ndarray, has_pose: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return the poses of all times, float64 [N, 4, 4], from those that are known.

    A missing pose is on the straight line through the two nearest in time. Its rotation is between
    theirs, and never beyond.
    """
    all_poses = np.empty((len(times_s), 4, 4))
    all_poses[has_pose] = poses
    known_s = times_s[has_pose]
    for i in np.flatnonzero(~has_pose):
        if len(poses) == 1:
            all_poses[i] = poses[0]
            continue
        after = int(np.clip(np.searchsorted(known_s, times_s[i]), 1, len(poses) - 1))
        a = poses[after - 1]
        b = poses[after]
        fraction = (times_s[i] - known_s[after - 1]) / (known_s[after] - known_s[after - 1])
        all_poses[i] = a + fraction * (b - a)
        quats = quat_from_rotmat(torch.from_numpy(np.stack([a[:3, :3], b[:3, :3]])))
        fraction = torch.tensor(min(max(fraction, 0.0), 1.0), dtype=torch.float64)
        all_poses[i, :3, :3] = rotmat_from_quat(slerp(quats[0], quats[1], fraction)).numpy()
    return all_poses


# ---- Images and their sizes, told by their first bytes -------------------------------------------

# Name of an image's file: frame and camera.
_IMAGE_NAME = re.compile(r"([0-9]{1,9})_([0-9])\.(png|jpg|jpeg)", re.IGNORECASE)
# Width and height of the images of Waymo's front cameras.
_FRONT_IMAGE_SIZE = (1920, 1280)
# Width and height of the images of Waymo's side cameras.
_SIDE_IMAGE_SIZE = (1920, 886)


def find_images(
    root: Path, frames: range, lenses: Mapping[int, Lens]
) -> tuple[dict[tuple[int, int], Path], dict[int, tuple[int, int]], list[str]]:
    """Return usable images by frame and camera, each camera's image size, and sentences on the
    rest.

    The size of a camera without images is Waymo's.
    """
    folder = root / "images"
    listed_paths: dict[tuple[int, int], Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if match := _IMAGE_NAME.fullmatch(path.name):
            other = listed_paths.setdefault((int(match[1]), int(match[2])), path)
            if other != path:
                raise AdapterError(f"{other} and {path} are one image; delete one of them")
    paths: dict[tuple[int, int], Path] = {}
    sizes: dict[int, tuple[int, int]] = {}
    used: list[tuple[Picture, ImageHeader]] = []
    problems: list[str] = []
    without_images = []
    for cam, lens in lenses.items():
        name = CAMERA_NAMES[cam]
        keys = [key for key in sorted(listed_paths) if key[0] in frames and key[1] == cam]
        headers = {key: _image_header(listed_paths[key]) for key in keys}
        counts = Counter(header.size for header in headers.values() if header is not None)
        waymo_size = _SIDE_IMAGE_SIZE if name.startswith("SIDE") else _FRONT_IMAGE_SIZE
        sizes[cam] = width, height = counts.most_common(1)[0][0] if counts else waymo_size
        if not counts:
            without_images.append(f"{width}x{height} for {name}")
        for key, header in headers.items():
            if header is None:
                problems.append(f"{listed_paths[key]} is no image, or a damaged one; left out")
            elif header.size != sizes[cam]:
                problems.append(
                    f"{listed_paths[key]} is {header.width}x{header.height} pixels, most images of "
                    f"{name} are {width}x{height}; left out{exif_hint(header, sizes[cam])}"
                )
            else:
                paths[key] = listed_paths[key]
                used.append((Picture(name, key[0], listed_paths[key]), header))
        if not (0 < lens.cx < width and 0 < lens.cy < height):
            reason = "as its images are" if counts else "assumed for want of images"
            raise AdapterError(
                f"{root}/intrinsics/{cam}.txt: cx, cy (its third and fourth number) must lie in "
                f"the {width}x{height} pixels of {name}, {reason}; got {lens.cx:g}, {lens.cy:g}. "
                f"If the images were resized, scale fx fy cx cy with them"
            )
    if without_images:
        problems.append(
            f"{folder} holds no usable image NNNNNN_C.png or .jpg of {len(without_images)} "
            f"cameras: their size is taken to be Waymo's, {', '.join(without_images)}"
        )
    return paths, sizes, problems + image_notes(used)


def _image_header(path: Path) -> ImageHeader | None:
    """Return the header of an image, or None if the file is no image."""
    try:
        return read_image_header(path)
    except OSError:
        return None


# ---- The tracked objects of a drive, in the columns in which a trained model has them ------------
# Nothing in a model says which column of its actors' poses belongs to which object. The columns are
# reconstructed by reading the track file as training did: rows in the file's order, each into the
# first free column of its frame. Then objects that hardly move are removed.

# Classes whose objects are not tracked.
NOT_TRACKED = ("sign", "misc")
# An object moves if the standard deviation of its places along a world axis is above this,
_MIN_SPREAD_M = 0.5
# or if the distance between its first place and its last is above this.
_MIN_TRAVEL_M = 2.0
# An object is drawn this long before its first frame and after its last.
_HOLD_S = 0.1
_Metres = Annotated[FiniteFloat, Field(gt=0)]


class _TrackRow(BaseModel):
    """Columns of a track file, in their order."""

    frame_id: Number
    track_id: Number
    object_class: str
    alpha: FiniteFloat
    box_height: _Metres
    box_width: _Metres
    box_length: _Metres
    box_center_x: FiniteFloat
    box_center_y: FiniteFloat
    box_center_z: FiniteFloat
    box_heading: FiniteFloat
    speed: FiniteFloat | None = None


@dataclass(frozen=True, eq=False)
class TrackTable:
    """A track file of N rows in its order.

    Everything is in the vehicle's frame at the frame's time.

    Attributes:
        path: the file.
        lines: int64 [N], for messages.
        frames, ids: int64 [N].
        labels: classes.
        alphas: float64 [N], as in the file.
        sizes_m: float64 [N, 3], length, width, height.
        centers_m: float64 [N, 3].
        headings: float64 [N], about z.
        speeds_mps: float64 [N]. None if the file has none.
        problems: one sentence each.
    """

    path: Path
    lines: np.ndarray
    frames: np.ndarray
    ids: np.ndarray
    labels: tuple[str, ...]
    alphas: np.ndarray
    sizes_m: np.ndarray
    centers_m: np.ndarray
    headings: np.ndarray
    speeds_mps: np.ndarray | None
    problems: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.labels)


def track_files(root: Path, *, use_tracker: bool) -> tuple[Path, Path]:
    """Return the track file, and the file of the cameras that see its objects."""
    suffix = "_castrack" if use_tracker else ""
    return root / f"track/track_info{suffix}.txt", root / f"track/track_camera_vis{suffix}.json"


def read_track_table(path: Path) -> TrackTable:
    """Read a track file. Its first line names the columns and is not read."""
    texts = read_text(path).splitlines()
    names = list(_TrackRow.model_fields)
    rows: dict[int, _TrackRow] = {}
    first_lines: dict[tuple[int, int], int] = {}
    for line, text in enumerate(texts[1:], start=2):
        if not (words := dict(zip(names, text.split(), strict=False))):
            continue
        row = rows[line] = validate(_TrackRow, words, f"{path}, line {line}", "row of a track file")
        first_line = first_lines.setdefault((row.frame_id, row.track_id), line)
        if first_line != line:
            raise AdapterError(
                f"{path}, line {line}: object {row.track_id} is already in frame {row.frame_id} by "
                f"line {first_line}; delete one of them"
            )
    has_speed = bool(rows) and next(iter(rows.values())).speed is not None
    if deviating_lines := [
        line for line, row in rows.items() if (row.speed is not None) != has_speed
    ]:
        raise AdapterError(
            f"{path}, line {deviating_lines[0]}: all rows must hold a speed in column "
            f"{len(names)}, or none; it differs from the first row"
        )
    header = texts[0].split() if texts else []
    problems = ()
    if len(header) >= len(names) - 1 and header[0].isdigit():
        problems = (
            f"{path}: line 1, which is not read, should name the columns; it holds an object",
        )

    def columns(*names: str, dtype: type = np.float64) -> np.ndarray:
        values = [[getattr(row, name) for name in names] for row in rows.values()]
        return np.array(values, dtype).reshape(len(rows), len(names))

    return TrackTable(
        path=path,
        lines=np.array(list(rows), np.int64),
        frames=columns("frame_id", dtype=np.int64)[:, 0],
        ids=columns("track_id", dtype=np.int64)[:, 0],
        labels=tuple(row.object_class for row in rows.values()),
        alphas=columns("alpha")[:, 0],
        sizes_m=columns("box_length", "box_width", "box_height"),
        centers_m=columns("box_center_x", "box_center_y", "box_center_z"),
        headings=columns("box_heading")[:, 0],
        speeds_mps=columns("speed")[:, 0] if has_speed else None,
        problems=problems,
    )


class _Visibility(RootModel[dict[Number, dict[Number, frozenset[StrictInt]]]]):
    """Cameras that see an object, by object and frame."""


def find_visible_rows(table: TrackTable, visible_path: Path, cams: Sequence[int]) -> np.ndarray:
    """Return the indices of the rows of tracked classes that one of the cameras sees, int64 [R]."""
    content = read_json(visible_path)
    kind = "list of camera numbers by object and frame"
    visible = validate(_Visibility, content, visible_path, kind)
    visible_rows = []
    for row, label in enumerate(table.labels):
        if label in NOT_TRACKED:
            continue
        track_id = int(table.ids[row])
        frame = int(table.frames[row])
        cameras = visible.root.get(track_id, {}).get(frame)
        if cameras is None:
            raise AdapterError(
                f"{table.path}, line {table.lines[row]}: {visible_path} does not say which cameras "
                f"see object {track_id} in frame {frame}; both must be of one conversion"
            )
        if not cameras.isdisjoint(cams):
            visible_rows.append(row)
    return np.array(visible_rows, np.int64)


def assign_columns(
    table: TrackTable, rows: np.ndarray, frames: Sequence[int], world_from_ego: np.ndarray
) -> np.ndarray:
    """Return the row of the table in every frame and column, int64 [F, M], -1 for none.

    Args:
        table: the track file.
        rows: visible rows.
        frames: consecutive frames.
        world_from_ego: float64 [F, 4, 4].
    """
    by_frame = [rows[table.frames[rows] == frame] for frame in frames]
    moving = _moving_ids(table, by_frame, world_from_ego)
    columns_by_frame = [
        [row if table.ids[row] in moving else -1 for row in column] for column in by_frame
    ]
    compacted = [[row for row in column if row >= 0] for column in columns_by_frame]
    # Training compacts only where that leaves fewer columns.
    if max(map(len, compacted)) < max(map(len, columns_by_frame)):
        columns_by_frame = compacted
    placements = np.full((len(frames), max(1, *map(len, columns_by_frame))), -1, np.int64)
    for step, column in enumerate(columns_by_frame):
        placements[step, : len(column)] = column
    return placements


def _moving_ids(
    table: TrackTable, by_frame: Sequence[np.ndarray], world_from_ego: np.ndarray
) -> set[int]:
    """Return the numbers of the objects that move."""
    rows = np.concatenate(by_frame)
    poses = np.repeat(world_from_ego, list(map(len, by_frame)), axis=0)
    world_positions = (
        np.einsum("nij,nj->ni", poses[:, :3, :3], table.centers_m[rows]) + poses[:, :3, 3]
    )
    moving_ids = set()
    for track_id in np.unique(table.ids[rows]):
        positions = world_positions[table.ids[rows] == track_id]
        travel = np.linalg.norm(positions[-1] - positions[0])
        if positions.std(axis=0).max() > _MIN_SPREAD_M or travel > _MIN_TRAVEL_M:
            moving_ids.add(int(track_id))
    return moving_ids


def tracklets_of(table: TrackTable, placements: np.ndarray) -> Tracklets:
    """Return the tracklets of the placed rows. Empty places have zeros and no rotation."""
    is_placed = placements >= 0
    if not len(table):
        empty = np.zeros((*placements.shape, 3))
        return Tracklets(placements, empty, np.tile([1.0, 0, 0, 0], (*placements.shape, 1)))
    half_angles = np.where(is_placed, table.headings[placements], 0.0) / 2
    zeros = np.zeros_like(half_angles)
    return Tracklets(
        ids=np.where(is_placed, table.ids[placements], -1),
        positions=np.where(is_placed[..., None], table.centers_m[placements], 0.0),
        quats=np.stack([np.cos(half_angles), zeros, zeros, np.sin(half_angles)], -1),
    )


def tracked_objects(
    table: TrackTable,
    rows: np.ndarray,
    ids: np.ndarray,
    frames: Sequence[int],
    frame_times_s: np.ndarray,
    visible_span_s: tuple[float, float],
) -> tuple[TrackedObject, ...]:
    """Return the objects that have a column, in the order of the rows.

    Args:
        table: the track file.
        rows: visible rows of all frames of the file. An object's size is the largest of its rows.
        ids: int64 [F, M].
        frames: selected frames.
        frame_times_s: float64 [F].
        visible_span_s: first and last moment of any image or frame.
    """
    objects = []
    for track_id in dict.fromkeys(table.ids[rows].tolist()):
        steps = np.flatnonzero((ids == track_id).any(axis=1))
        if len(steps) == 0:
            continue
        object_rows = rows[table.ids[rows] == track_id]
        length, width, height = (table.sizes_m[object_rows].max(axis=0)).tolist()
        start = frame_times_s[steps[0]] - _HOLD_S
        end = frame_times_s[steps[-1]] + _HOLD_S
        objects.append(
            TrackedObject(
                track_id=track_id,
                label=table.labels[object_rows[0]],
                size_m=(length, width, height),
                start_frame=frames[steps[0]],
                end_frame=frames[steps[-1]],
                start_s=float(np.clip(start, *visible_span_s)),
                end_s=float(np.clip(end, *visible_span_s)),
            )
        )
    return tuple(objects)


# ---- The whole -----------------------------------------------------------------------------------


def read_data(root: Path, config: ModelConfig) -> StreetData:
    """Read the frames, cameras and moving objects that the configuration selects.

    Images may be missing. A camera's field of view then follows from its calibration and Waymo's
    sizes.
    """
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a drive in Street Gaussians' layout")
    cams = sorted(config.cameras)
    if missing_cameras := sorted(set(cams) - set(calibrated_cameras(root))):
        raise AdapterError(
            f"{root / 'extrinsics' / f'{missing_cameras[0]}.txt'} does not exist, but camera "
            f"{missing_cameras[0]} ({CAMERA_NAMES[missing_cameras[0]]}) is used; copy it from the "
            f"dataset"
        )
    path = read_ego_path(root)
    frames, problems = _select_frames(root, path.numbers, config)
    poses = path.world_from_ego.copy()
    origin = poses[:, :3, 3].mean(axis=0)
    poses[:, :3, 3] -= origin
    rows = slice(frames[0] - path.numbers[0], frames[-1] + 1 - path.numbers[0])
    times = path.times_s[rows]
    world_from_ego = poses[rows]
    images, image_problems = _read_images(root, path, frames, config, origin)

    track_path, visible_path = track_files(root, use_tracker=config.use_tracker)
    table = read_track_table(track_path)
    visible_rows = find_visible_rows(table, visible_path, cams)
    tracklets = tracklets_of(table, assign_columns(table, visible_rows, frames, world_from_ego))
    moments = [*times, *(image.timestamp_s for image in images)]
    visible_span_s = min(moments), max(moments)
    return StreetData(
        root=root,
        world_origin_m=origin,
        frames=tuple(frames),
        frame_times_s=times,
        world_from_ego=world_from_ego,
        images=images,
        objects=tracked_objects(table, visible_rows, tracklets.ids, frames, times, visible_span_s),
        tracklets=tracklets,
        problems=(*path.problems, *problems, *image_problems, *table.problems),
    )


def with_lenses(root: Path, frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Return frames whose cameras have the lenses of intrinsics/: k1 k2 p1 p2 k3 of Waymo."""
    lens_of_camera: dict[str, OpenCVLens] = {}
    for cam in calibrated_cameras(root):
        coefficients = read_numbers(root / "intrinsics" / f"{cam}.txt")[4:9]
        if coefficients.any():
            lens = OpenCVLens.from_coefficients(coefficients.tolist())
            lens_of_camera[CAMERA_NAMES[cam]] = lens
    return tuple(
        dataclasses.replace(
            frame,
            cameras={
                name: dataclasses.replace(camera, lens=lens_of_camera.get(name))
                for name, camera in frame.cameras.items()
            },
        )
        for frame in frames
    )


def frames_of(data: StreetData) -> tuple[Frame, ...]:
    """Return the frames that have images or could have them, with the recorded cameras."""
    by_frame: dict[int, list[StreetImage]] = {}
    for image in data.images:
        by_frame.setdefault(image.frame, []).append(image)
    return tuple(
        Frame(
            index=number,
            timestamp_ns=round(float(seconds) * 1e9),
            world_from_ego=torch.from_numpy(pose.copy()),
            cameras={image.name: image.camera for image in by_frame[number]},
            image_paths={i.name: str(i.path) for i in by_frame[number] if i.path is not None},
        )
        for number, seconds, pose in zip(
            data.frames, data.frame_times_s, data.world_from_ego, strict=True
        )
        if number in by_frame
    )


def held_out_steps(count: int, config: ModelConfig) -> frozenset[int]:
    """Return the positions, among the selected frames, of those that are not trained on."""
    steps = range(count)
    if config.split_test > 0:
        return frozenset(steps[config.split_test :: config.split_test])
    if config.split_train > 0:
        return frozenset(steps) - frozenset(steps[:: config.split_train])
    return frozenset()


def _select_frames(
    root: Path, dataset_frames: range, config: ModelConfig
) -> tuple[range, tuple[str, ...]]:
    """Return the selected frames' numbers, and a sentence if the dataset has fewer."""
    first, last = config.selected_frames or (dataset_frames[0], dataset_frames[-1])
    frames = range(max(first, dataset_frames[0]), min(last, dataset_frames[-1]) + 1)
    if not frames:
        raise AdapterError(
            f"{root}: the configuration's data.selected_frames are {first} to {last}; the dataset "
            f"has {dataset_frames[0]} to {dataset_frames[-1]}, so it is another drive's, or not "
            f"whole"
        )
    if (frames[0], frames[-1]) == (first, last):
        return frames, ()
    return frames, (
        f"{root} has frames {dataset_frames[0]} to {dataset_frames[-1]} of the {first} to {last} "
        f"that the configuration selects",
    )


def _read_images(
    root: Path, path: EgoPath, frames: range, config: ModelConfig, origin: np.ndarray
) -> tuple[tuple[StreetImage, ...], list[str]]:
    """Return all images of the frames with a pose, by frame, then camera, and sentences on the
    rest.
    """
    cams = sorted(config.cameras)
    lenses = {cam: read_lens(root, cam) for cam in cams}
    paths, sizes, problems = find_images(root, frames, lenses)
    held_out = held_out_steps(len(frames), config)
    images = []
    missing_files = []
    for number, (frame, cam) in enumerate(itertools.product(frames, cams)):
        name = CAMERA_NAMES[cam]
        lens = lenses[cam]
        file = root / "ego_pose" / f"{frame:06d}_{cam}.txt"
        if not path.is_known[path.numbers.index(frame)]:
            continue
        if not file.exists():
            missing_files.append(file)
            continue
        timestamp_s = path.camera_times_s[name].get(frame)
        if timestamp_s is None:
            raise AdapterError(
                f"{root / TIMES}: {name} lacks frame {frame:06d}, of which there is {file}; both "
                f"must be of one conversion"
            )
        world_from_ego = read_pose(file)
        world_from_ego[:3, 3] -= origin
        camera_from_world = torch.from_numpy(lens.camera_from_ego @ invert_pose(world_from_ego))
        time_ns = round(timestamp_s * 1e9)
        images.append(
            StreetImage(
                frame=frame,
                cam=cam,
                path=paths.get((frame, cam)),
                timestamp_s=timestamp_s,
                world_from_ego=world_from_ego,
                camera=Camera(name, *sizes[cam], *lens[:4], camera_from_world, time_ns),
                is_held_out=frames.index(frame) in held_out,
                number=number,
            )
        )
    if not images:
        raise AdapterError(
            f"{root / 'ego_pose'} lacks poses NNNNNN_{cams[0]}.txt at the cameras' times for all "
            f"frames from {frames[0]} to {frames[-1]}; copy the whole folder from the dataset"
        )
    if missing_files:
        problems.append(
            f"{len(missing_files)} images are left out for want of the car's pose at their time, "
            f"such as {missing_files[0]}"
        )
    return tuple(images), problems
