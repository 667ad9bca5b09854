"""A Street Gaussians dataset directory as a trained model sees it, and its frames.

    intrinsics/<cam>.txt          fx fy cx cy and distortion, which is not used
    extrinsics/<cam>.txt          ego_from_camera, OpenCV axes
    ego_pose/<frame>.txt          world_from_ego at the frame's time
    ego_pose/<frame>_<cam>.txt    the same at the camera's
    timestamps.json               seconds by FRAME or camera name, then by frame

World: the dataset's, minus the mean position of the car over all its frames, as the models are
trained. Vehicle frame: x forward, y left, z up. Times are seconds as the dataset has them.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from adapters.plain_files import read_json, read_numbers, read_pose, read_text
from adapters.world import invert_pose
from augment.cameras import Camera, Frame
from augment.errors import AdapterError
from augment.files.image_size import read_image_header
from augment.geometry import quat_from_rotmat, rotmat_from_quat, slerp

CAMERA_NAMES = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")


@dataclass(frozen=True)
class ModelConfig:
    """What of a model's configuration decides how it is read; the defaults are the project's own.

    cameras: numbers in CAMERA_NAMES. selected_frames: first and last, both included; None for all.
    split_test, split_train: every how manyeth frame is held out or trained on; -1 where unused.
    """

    source_path: str = ""
    cameras: tuple[int, ...] = (0, 1, 2)
    selected_frames: tuple[int, int] | None = None
    use_tracker: bool = False
    split_test: int = -1
    split_train: int = -1
    fourier_scale: float = 1.0
    include_sky: bool = False
    white_background: bool = False
    opt_track: bool = True
    use_color_correction: bool = False
    color_correction_mode: str = "image"
    color_correction_mlp: bool = False
    use_pose_correction: bool = False
    pose_correction_mode: str = "image"


@dataclass(frozen=True, eq=False)
class Lens:
    """camera_from_ego: float64 [4, 4], OpenCV axes. path: of the intrinsics, for messages."""

    path: Path
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_ego: np.ndarray


@dataclass(frozen=True, eq=False)
class StreetImage:
    """One image, or a camera without its image. cam: number in CAMERA_NAMES.

    world_from_ego: float64 [4, 4], at the moment of the image. is_held_out: not trained on.
    number: its position among all images of the selected frames and cameras, by frame, then camera,
    left out or not: the index of per-image corrections.
    """

    frame: int
    cam: int
    path: Path | None
    timestamp_s: float
    world_from_ego: np.ndarray
    lens: Lens
    width: int
    height: int
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

    size_m: length, width, height; training kept splats in a box that was wider and longer by
    data.box_scale. start_frame, end_frame: of its track. start_s, end_s: when it is drawn.
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
    """Where objects are in each of F selected frames, in the columns that the model has them in.

    ids: int64 [F, M], -1 for none. positions: float64 [F, M, 3], metres, vehicle frame at the
    frame's time. quats: float64 [F, M, 4] wxyz.
    """

    ids: np.ndarray
    positions: np.ndarray
    quats: np.ndarray


@dataclass(frozen=True, eq=False)
class StreetData:
    """A dataset directory as a model sees it.

    frames: selected numbers, ascending. world_from_ego: float64 [F, 4, 4]; between its neighbours'
    where the file is missing, so that the rows stay those of the model, but such a frame has no
    images. images: by frame, then camera. objects: moving ones, in the track file's order.
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
TIMES = "timestamps.json"
_NUMBER = re.compile(r"[0-9]{1,9}")
_FRAME_POSE = re.compile(r"([0-9]{1,9})\.txt")
_MAX_GAPS = 1000  # numbers between the first frame and the last that nothing is known of


@dataclass(frozen=True, eq=False)
class EgoPath:
    """The car at every frame of the drive (numbers: consecutive), in the dataset's world.

    world_from_ego: float64 [N, 4, 4]. is_known: bool [N], False where the pose is missing and was
    put between its neighbours. camera_times_s: by camera name, then frame number.
    """

    numbers: range
    times_s: np.ndarray
    world_from_ego: np.ndarray
    is_known: np.ndarray
    camera_times_s: Mapping[str, Mapping[int, float]]
    problems: tuple[str, ...]

    @property
    def centre_m(self) -> np.ndarray:
        """The mean position, float64 [3]: the origin of the models' worlds."""
        return self.world_from_ego[:, :3, 3].mean(axis=0)


def calibrated_cameras(root: Path) -> tuple[int, ...]:
    """The numbers of the cameras that have extrinsics."""
    return tuple(c for c in range(len(CAMERA_NAMES)) if (root / f"extrinsics/{c}.txt").exists())


def read_lens(root: Path, cam: int) -> Lens:
    """A camera's calibration."""
    path = root / "intrinsics" / f"{cam}.txt"
    values = read_numbers(path)
    if values.size < 4 or min(values[:2]) <= 0:
        raise AdapterError(
            f"{path} must begin with fx fy cx cy in pixels, fx and fy > 0; got {values.tolist()}"
        )
    fx, fy, cx, cy = values[:4].tolist()
    ego_from_camera = read_pose(root / "extrinsics" / f"{cam}.txt")
    return Lens(path, fx, fy, cx, cy, invert_pose(ego_from_camera))


def read_ego_path(root: Path) -> EgoPath:
    """Every frame's pose and time."""
    folder = root / "ego_pose"
    if not folder.is_dir():
        raise AdapterError(
            f"{folder} does not exist; expected a drive in Street Gaussians' layout, with "
            f"ego_pose/, extrinsics/, intrinsics/, track/ and {TIMES}"
        )
    found = {int(m[1]): p for p in folder.iterdir() if (m := _FRAME_POSE.fullmatch(p.name))}
    if not found:
        raise AdapterError(f"{folder} holds no pose NNNNNN.txt; copy the folder from the dataset")
    times = read_times(root / TIMES)
    timed = times["FRAME"]
    untimed = sorted(set(found) - set(timed))
    if untimed:
        raise AdapterError(
            f"{root / TIMES}: FRAME lacks frame {untimed[0]:06d}, of which there is {folder}/"
            f"{untimed[0]:06d}.txt; both must be of one conversion"
        )
    numbers = range(min(timed), max(timed) + 1)
    if len(numbers) - len(timed) > _MAX_GAPS:
        raise AdapterError(
            f"{root / TIMES}: FRAME must hold consecutive frames; it holds {len(timed)} from "
            f"{numbers[0]} to {numbers[-1]}"
        )
    known = np.array([number in found for number in numbers])
    timed_numbers = np.array(sorted(timed))
    times_s = np.interp(numbers, timed_numbers, [timed[n] for n in timed_numbers.tolist()])
    if not (np.diff(times_s) > 0).all():
        raise AdapterError(f"{root / TIMES}: the seconds of FRAME must increase with the frames")
    poses = _fill(times_s, known, np.stack([read_pose(found[n]) for n in sorted(found)]))
    problems = ()
    if missing := [numbers[i] for i in np.flatnonzero(~known)]:
        problems = (
            f"{folder} lacks the poses of {len(missing)} of {len(numbers)} frames, such as "
            f"{missing[0]:06d}: these frames are left out, and the middle of the drive, on which "
            f"the world of trained models is centred, is had with guesses from the frames beside "
            f"them",
        )
    return EgoPath(numbers, times_s, poses, known, times, problems)


def read_times(path: Path) -> dict[str, dict[int, float]]:
    """Seconds by FRAME or camera name, then frame number."""
    content = read_json(path)
    times: dict[str, dict[int, float]] = {}
    for name, entries in content.items():
        if name != "FRAME" and name not in CAMERA_NAMES:
            continue
        if not isinstance(entries, dict):
            raise AdapterError(f"{path}: {name} must hold seconds by frame; got {entries!r:.80}")
        times[name] = {}
        for key, value in entries.items():
            is_time = isinstance(value, int | float) and not isinstance(value, bool)
            if not (is_time and 0 <= value < 9e9 and _NUMBER.fullmatch(key)):
                raise AdapterError(
                    f"{path}: {name} must hold seconds by frame, such as "
                    f'"000000": 1550083467.3; got {key!r}: {value!r:.80}'
                )
            times[name][int(key)] = float(value)
    if not times.get("FRAME"):
        raise AdapterError(f"{path} must hold FRAME, seconds by frame; it holds {list(content)}")
    return times


def _fill(times_s: np.ndarray, known: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """The poses of all times, float64 [N, 4, 4], from those of the known ones: on the straight line
    through the two nearest in time, turned as far as between them and no further."""
    filled = np.empty((len(times_s), 4, 4))
    filled[known] = poses
    known_s = times_s[known]
    for i in np.flatnonzero(~known):
        if len(poses) == 1:
            filled[i] = poses[0]
            continue
        after = int(np.clip(np.searchsorted(known_s, times_s[i]), 1, len(poses) - 1))
        a, b = poses[after - 1], poses[after]
        part = (times_s[i] - known_s[after - 1]) / (known_s[after] - known_s[after - 1])
        filled[i] = a + part * (b - a)
        quats = quat_from_rotmat(torch.from_numpy(np.stack([a[:3, :3], b[:3, :3]])))
        part = torch.tensor(min(max(part, 0.0), 1.0), dtype=torch.float64)
        filled[i, :3, :3] = rotmat_from_quat(slerp(quats[0], quats[1], part)).numpy()
    return filled


def read_camera_moments(
    root: Path, path: EgoPath, frames: Sequence[int], cams: Sequence[int]
) -> tuple[dict[tuple[int, int], tuple[float, np.ndarray]], tuple[str, ...]]:
    """Seconds and dataset_from_ego by frame and camera, and a sentence on missing ones."""
    moments: dict[tuple[int, int], tuple[float, np.ndarray]] = {}
    missing: list[Path] = []
    for frame in frames:
        if not path.is_known[path.numbers.index(frame)]:
            continue
        for cam in cams:
            file = root / "ego_pose" / f"{frame:06d}_{cam}.txt"
            if not file.exists():
                missing.append(file)
                continue
            seconds = path.camera_times_s.get(CAMERA_NAMES[cam], {}).get(frame, math.nan)
            if math.isnan(seconds):
                raise AdapterError(
                    f"{root / TIMES}: {CAMERA_NAMES[cam]} lacks frame {frame:06d}, of which there "
                    f"is {file}; both must be of one conversion"
                )
            moments[frame, cam] = seconds, read_pose(file)
    if not moments:
        raise AdapterError(
            f"{root / 'ego_pose'} lacks poses NNNNNN_{cams[0]}.txt at the cameras' times for all "
            f"frames from {frames[0]} to {frames[-1]}; copy the whole folder from the dataset"
        )
    if not missing:
        return moments, ()
    return moments, (
        f"{len(missing)} images are left out for want of the car's pose at their time, such as "
        f"{missing[0]}",
    )


# ---- Images and their sizes, told by their first bytes -------------------------------------------

_NAME = re.compile(r"([0-9]{1,9})_([0-9])\.(png|jpg|jpeg)", re.IGNORECASE)
_FULL_SIZE, _SIDE_SIZE = (1920, 1280), (1920, 886)  # of Waymo's front cameras and side cameras


def find_images(
    root: Path, frames: range, lenses: Mapping[int, Lens]
) -> tuple[dict[tuple[int, int], Path], dict[int, tuple[int, int]], list[str]]:
    """Usable images by frame and camera, each camera's image size, and sentences on the rest.

    Where a camera has no image, its size is Waymo's.
    """
    listed = _listed(root / "images")
    paths: dict[tuple[int, int], Path] = {}
    sizes: dict[int, tuple[int, int]] = {}
    problems: list[str] = []
    without_images = []
    for cam, lens in lenses.items():
        seen = {
            key: _size(listed[key]) for key in sorted(listed) if key[0] in frames and key[1] == cam
        }
        counts = Counter(size for size in seen.values() if size is not None)
        waymo_size = _SIDE_SIZE if CAMERA_NAMES[cam].startswith("SIDE") else _FULL_SIZE
        sizes[cam] = width, height = counts.most_common(1)[0][0] if counts else waymo_size
        if not counts:
            without_images.append(f"{width}x{height} for {CAMERA_NAMES[cam]}")
        for key, size in seen.items():
            if size is None:
                problems.append(f"{listed[key]} is no image, or a damaged one; left out")
            elif size != sizes[cam]:
                problems.append(
                    f"{listed[key]} is {size[0]}x{size[1]} pixels, most images of "
                    f"{CAMERA_NAMES[cam]} are {width}x{height}; left out"
                )
            else:
                paths[key] = listed[key]
        if not (0 < lens.cx < width and 0 < lens.cy < height):
            whose = "as its images are" if counts else "assumed for want of images"
            raise AdapterError(
                f"{lens.path}: cx, cy (its third and fourth number) must lie in the "
                f"{width}x{height} pixels of {CAMERA_NAMES[cam]}, {whose}; got {lens.cx:g}, "
                f"{lens.cy:g}. If the images were resized, scale fx fy cx cy with them"
            )
    if without_images:
        problems.append(
            f"{root / 'images'} holds no usable image NNNNNN_C.png or .jpg of "
            f"{len(without_images)} cameras: their size is taken to be Waymo's, "
            f"{', '.join(without_images)}"
        )
    return paths, sizes, problems


def _listed(folder: Path) -> dict[tuple[int, int], Path]:
    found: dict[tuple[int, int], Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = _NAME.fullmatch(path.name)
        if match is None:
            continue
        key = int(match[1]), int(match[2])
        if key in found:
            raise AdapterError(f"{found[key]} and {path} are one image; delete one of them")
        found[key] = path
    return found


def _size(path: Path) -> tuple[int, int] | None:
    """Width and height, or None for what is no image."""
    try:
        header = read_image_header(path)
    except OSError:
        return None
    return None if header is None else (header.width, header.height)


# ---- The tracked objects of a drive, in the columns in which a trained model has them ------------
# Nothing in a model says which column of its actors' poses is whose. The columns are had again by
# going over the track file as training did: rows in the file's order, each into the first free
# column of its frame; objects that hardly move are then taken out.

NOT_TRACKED = ("sign", "misc")  # classes
_COLUMNS = (
    "frame_id track_id object_class alpha box_height box_width box_length "
    "box_center_x box_center_y box_center_z box_heading"
)
_WORDS = len(_COLUMNS.split())  # of a row; a further one is the speed
_SPREAD_M = 0.5  # standard deviation along an axis of the world above which an object moves
_TRAVEL_M = 2.0  # or distance between its first place and its last
_HOLD_S = 0.1  # an object is drawn so long before its first frame and after its last


@dataclass(frozen=True, eq=False)
class TrackTable:
    """A track file of N rows in its order. All in the vehicle's frame at the frame's time.

    lines: int64 [N], for messages. frames, ids: int64 [N]. sizes_m: float64 [N, 3], length, width,
    height. centers_m: float64 [N, 3]. headings: float64 [N], about z. speeds_mps: None where the
    file has none.
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
    """The track file and the one that says which cameras see its objects."""
    suffix = "_castrack" if use_tracker else ""
    return root / f"track/track_info{suffix}.txt", root / f"track/track_camera_vis{suffix}.json"


def read_track_table(path: Path) -> TrackTable:
    """A track file, of which the first line names the columns and is not read."""
    texts = read_text(path).splitlines()
    rows, widths = [], []
    first_lines: dict[tuple[int, int], int] = {}
    for line, text in enumerate(texts[1:], start=2):
        if words := text.split():
            rows.append((line, *_row(path, line, words)))
            widths.append(min(len(words), _WORDS + 1))
            _, frame, track_id, *_ = rows[-1]
            before = first_lines.setdefault((frame, track_id), line)
            if before != line:
                raise AdapterError(
                    f"{path}, line {line}: object {track_id} is already in frame {frame} by line "
                    f"{before}; delete one of them"
                )
    if odd := [row[0] for row, width in zip(rows, widths, strict=True) if width != widths[0]]:
        raise AdapterError(
            f"{path}, line {odd[0]}: all rows must hold a speed in column {_WORDS + 1}, or none; "
            f"it differs from the first row"
        )
    has_speed = bool(rows) and widths[0] > _WORDS
    numbers = np.array([row[4] for row in rows], np.float64).reshape(len(rows), 8 + has_speed)
    header = texts[0].split() if texts else []
    problems = ()
    if len(header) >= _WORDS and header[0].isdigit():
        problems = (
            f"{path}: line 1, which is not read, should name the columns; it holds an object",
        )
    return TrackTable(
        path=path,
        lines=np.array([row[0] for row in rows], np.int64),
        frames=np.array([row[1] for row in rows], np.int64),
        ids=np.array([row[2] for row in rows], np.int64),
        labels=tuple(row[3] for row in rows),
        alphas=numbers[:, 0],
        sizes_m=numbers[:, 3:0:-1].copy(),
        centers_m=numbers[:, 4:7],
        headings=numbers[:, 7],
        speeds_mps=numbers[:, 8] if has_speed else None,
        problems=problems,
    )


def _row(path: Path, line: int, words: Sequence[str]) -> tuple[int, int, str, list[float]]:
    """Frame, object, class and the numbers after it."""
    where = f"{path}, line {line}"
    if len(words) < _WORDS:
        raise AdapterError(
            f"{where}: a row must hold the {_WORDS} columns {_COLUMNS}; it holds {len(words)}"
        )
    frame, track_id = words[0], words[1]
    if not (_NUMBER.fullmatch(frame) and _NUMBER.fullmatch(track_id)):
        raise AdapterError(
            f"{where}: frame_id and track_id must be whole numbers >= 0; got {frame!r}, "
            f"{track_id!r}"
        )
    values = []
    names = [*_COLUMNS.split()[3:], "speed"]
    for name, word in zip(names, words[3 : _WORDS + 1], strict=False):
        try:
            value = float(word)
        except ValueError:
            value = np.nan
        needs_size = name in ("box_height", "box_width", "box_length")
        if not np.isfinite(value) or (needs_size and value <= 0):
            kind = "a number of metres > 0" if needs_size else "a finite number"
            raise AdapterError(f"{where}: {name} must be {kind}; got {word!r}")
        values.append(value)
    return int(frame), int(track_id), words[2], values


Visibility = Mapping[tuple[int, int], frozenset[int]]


def read_visibility(path: Path) -> Visibility:
    """The cameras that see an object, by object and frame."""
    visible: dict[tuple[int, int], frozenset[int]] = {}
    for track_id, frames in read_json(path).items():
        entries = frames.items() if isinstance(frames, dict) else [("?", frames)]
        for frame, cams in entries:
            is_list = isinstance(cams, list) and all(type(cam) is int for cam in cams)
            if not (is_list and _NUMBER.fullmatch(track_id) and _NUMBER.fullmatch(frame)):
                raise AdapterError(
                    f"{path}: object {track_id!r}, frame {frame!r} must be whole numbers with a "
                    f"list of camera numbers; got {cams!r:.80}"
                )
            visible[int(track_id), int(frame)] = frozenset(cams)
    return visible


def seen_rows(
    table: TrackTable, visible: Visibility, visible_path: Path, cams: Sequence[int]
) -> np.ndarray:
    """Indices of the rows of tracked classes that one of the cameras sees, int64 [R]."""
    kept = []
    used = frozenset(cams)
    for row, label in enumerate(table.labels):
        if label in NOT_TRACKED:
            continue
        track_id, frame = int(table.ids[row]), int(table.frames[row])
        if (track_id, frame) not in visible:
            raise AdapterError(
                f"{table.path}, line {table.lines[row]}: {visible_path} does not say which cameras "
                f"see object {track_id} in frame {frame}; both must be of one conversion"
            )
        if visible[track_id, frame] & used:
            kept.append(row)
    return np.array(kept, np.int64)


def place_rows(
    table: TrackTable, rows: np.ndarray, frames: Sequence[int], world_from_ego: np.ndarray
) -> np.ndarray:
    """The row of the table in every frame and column, int64 [F, M], -1 for none.

    rows: those that were seen. frames: consecutive. world_from_ego: float64 [F, 4, 4].
    """
    steps = table.frames[rows] - frames[0]
    inside = (steps >= 0) & (steps < len(frames))
    rows, steps = rows[inside], steps[inside]
    columns = np.bincount(steps, minlength=len(frames)).max() if len(rows) else 0
    placed = np.full((len(frames), columns), -1, np.int64)
    used = np.zeros(len(frames), np.int64)
    for row, step in zip(rows, steps, strict=True):
        placed[step, used[step]] = row
        used[step] += 1
    placed = np.where(_moves(table, placed, world_from_ego), placed, -1)
    most = int((placed >= 0).sum(1).max()) if columns else 0
    if most < columns:  # every frame's rows in its first columns, in the same order
        moving, placed = placed, np.full((len(frames), most), -1, np.int64)
        for step, row in enumerate(moving):
            kept = row[row >= 0]
            placed[step, : len(kept)] = kept
    return placed if placed.shape[1] else np.full((len(frames), 1), -1, np.int64)


def _moves(table: TrackTable, placed: np.ndarray, world_from_ego: np.ndarray) -> np.ndarray:
    """Whether the object in each place moves, bool [F, M]."""
    steps, columns = np.nonzero(placed >= 0)  # by frame, then column
    rows = placed[steps, columns]
    poses = world_from_ego[steps]
    world = np.einsum("nij,nj->ni", poses[:, :3, :3], table.centers_m[rows]) + poses[:, :3, 3]
    moving = np.zeros(placed.shape, bool)
    for track_id in np.unique(table.ids[rows]):
        own = table.ids[rows] == track_id
        places = world[own]
        spread = places.std(axis=0).max()
        travel = np.linalg.norm(places[-1] - places[0])
        moving[steps[own], columns[own]] = spread > _SPREAD_M or travel > _TRAVEL_M
    return moving


def tracklets_of(table: TrackTable, placed: np.ndarray) -> Tracklets:
    """What the placed rows say, zeros and no rotation in empty places."""
    there = placed >= 0
    if not len(table):
        empty = np.zeros((*placed.shape, 3))
        return Tracklets(placed, empty, np.tile([1.0, 0, 0, 0], (*placed.shape, 1)))
    half = np.where(there, table.headings[placed], 0.0) / 2
    zero = np.zeros_like(half)
    return Tracklets(
        ids=np.where(there, table.ids[placed], -1),
        positions=np.where(there[..., None], table.centers_m[placed], 0.0),
        quats=np.stack([np.cos(half), zero, zero, np.sin(half)], -1),
    )


def tracked_objects(
    table: TrackTable,
    rows: np.ndarray,
    ids: np.ndarray,
    frames: Sequence[int],
    frame_times_s: np.ndarray,
    drawn_s: tuple[float, float],
) -> tuple[TrackedObject, ...]:
    """The objects that have a column, in the order of the rows.

    rows: those that were seen, in all frames of the file; sizes are the largest of them. ids:
    int64 [F, M]. drawn_s: the first and last moment of any image or frame.
    """
    objects = []
    for track_id in dict.fromkeys(table.ids[rows].tolist()):
        steps = np.flatnonzero((ids == track_id).any(axis=1))
        if len(steps) == 0:
            continue
        own = rows[table.ids[rows] == track_id]
        length, width, height = (table.sizes_m[own].max(axis=0)).tolist()
        start, end = frame_times_s[steps[0]] - _HOLD_S, frame_times_s[steps[-1]] + _HOLD_S
        objects.append(
            TrackedObject(
                track_id=track_id,
                label=table.labels[own[0]],
                size_m=(length, width, height),
                start_frame=frames[steps[0]],
                end_frame=frames[steps[-1]],
                start_s=float(np.clip(start, *drawn_s)),
                end_s=float(np.clip(end, *drawn_s)),
            )
        )
    return tuple(objects)


# ---- The whole -----------------------------------------------------------------------------------


def read_data(root: Path, config: ModelConfig) -> StreetData:
    """The frames, cameras and moving objects that the configuration selects.

    Images may be missing: what a camera sees is then told by its calibration and Waymo's sizes.
    """
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a drive in Street Gaussians' layout")
    cams = _cameras(root, config)
    path = read_ego_path(root)
    frames, problems = _selected(root, path, config)
    origin = path.centre_m
    rows = slice(frames[0] - path.numbers[0], frames[-1] + 1 - path.numbers[0])
    world_from_ego = _centred(path.world_from_ego[rows], origin)
    images, image_problems = _images(root, path, frames, cams, config, origin)

    track_path, visible_path = track_files(root, use_tracker=config.use_tracker)
    table = read_track_table(track_path)
    seen = seen_rows(table, read_visibility(visible_path), visible_path, cams)
    tracklets = tracklets_of(table, place_rows(table, seen, frames, world_from_ego))
    times = path.times_s[rows]
    moments = [*times, *(image.timestamp_s for image in images)]
    return StreetData(
        root=root,
        world_origin_m=origin,
        frames=tuple(frames),
        frame_times_s=times,
        world_from_ego=world_from_ego,
        images=images,
        objects=tracked_objects(
            table, seen, tracklets.ids, frames, times, (min(moments), max(moments))
        ),
        tracklets=tracklets,
        problems=(*path.problems, *problems, *image_problems, *table.problems),
    )


def frames_of(data: StreetData) -> tuple[Frame, ...]:
    """The frames that have images or could have, with cameras as they recorded."""
    by_frame: dict[int, list[StreetImage]] = {}
    for image in data.images:
        by_frame.setdefault(image.frame, []).append(image)
    return tuple(
        Frame(
            index=number,
            timestamp_ns=round(float(seconds) * 1e9),
            world_from_ego=torch.from_numpy(pose.copy()),
            cameras={image.name: camera_of(image) for image in by_frame[number]},
            image_paths={i.name: str(i.path) for i in by_frame[number] if i.path is not None},
        )
        for number, seconds, pose in zip(
            data.frames, data.frame_times_s, data.world_from_ego, strict=True
        )
        if number in by_frame
    )


def camera_of(image: StreetImage) -> Camera:
    """The camera at the moment of the image, of the recorded size."""
    camera_from_world = image.lens.camera_from_ego @ invert_pose(image.world_from_ego)
    return Camera(
        name=image.name,
        width=image.width,
        height=image.height,
        fx=image.lens.fx,
        fy=image.lens.fy,
        cx=image.lens.cx,
        cy=image.lens.cy,
        camera_from_world=torch.from_numpy(camera_from_world),
        timestamp_ns=image.timestamp_ns,
    )


def held_out_steps(count: int, config: ModelConfig) -> frozenset[int]:
    """Which of so many selected frames are not trained on, by their position among them."""
    steps = range(count)
    if config.split_test > 0:
        return frozenset(steps[config.split_test :: config.split_test])
    if config.split_train > 0:
        return frozenset(steps) - frozenset(steps[:: config.split_train])
    return frozenset()


def _cameras(root: Path, config: ModelConfig) -> list[int]:
    cams = sorted(set(config.cameras))
    if not cams or not set(cams) <= set(range(len(CAMERA_NAMES))):
        raise AdapterError(
            f"{root}: the configuration's data.cameras must be some of 0 to "
            f"{len(CAMERA_NAMES) - 1} ({', '.join(CAMERA_NAMES)}); got {list(config.cameras)}"
        )
    absent = sorted(set(cams) - set(calibrated_cameras(root)))
    if absent:
        raise AdapterError(
            f"{root / 'extrinsics' / f'{absent[0]}.txt'} does not exist, but camera {absent[0]} "
            f"({CAMERA_NAMES[absent[0]]}) is used; copy it from the dataset"
        )
    return cams


def _selected(root: Path, path: EgoPath, config: ModelConfig) -> tuple[range, tuple[str, ...]]:
    """The selected frames' numbers, and a sentence where the dataset has fewer."""
    there = path.numbers
    if config.selected_frames is None:
        return there, ()
    first, last = config.selected_frames
    frames = range(max(first, there[0]), min(last, there[-1]) + 1)
    if not frames:
        raise AdapterError(
            f"{root}: the configuration's data.selected_frames are {first} to {last}; the dataset "
            f"has {there[0]} to {there[-1]}, so it is another drive's, or not whole"
        )
    if (frames[0], frames[-1]) == (first, last):
        return frames, ()
    return frames, (
        f"{root} has frames {there[0]} to {there[-1]} of the {first} to {last} that the "
        f"configuration selects",
    )


def _centred(poses: np.ndarray, origin: np.ndarray) -> np.ndarray:
    out = poses.copy()
    out[..., :3, 3] -= origin
    return out


def _images(
    root: Path,
    path: EgoPath,
    frames: range,
    cams: Sequence[int],
    config: ModelConfig,
    origin: np.ndarray,
) -> tuple[tuple[StreetImage, ...], tuple[str, ...]]:
    lenses = {cam: read_lens(root, cam) for cam in cams}
    paths, sizes, size_problems = find_images(root, frames, lenses)
    moments, problems = read_camera_moments(root, path, frames, cams)
    held_out = held_out_steps(len(frames), config)
    images = []
    for number, (frame, cam) in enumerate((frame, cam) for frame in frames for cam in cams):
        if (frame, cam) not in moments:
            continue
        timestamp_s, world_from_ego = moments[frame, cam]
        width, height = sizes[cam]
        images.append(
            StreetImage(
                frame=frame,
                cam=cam,
                path=paths.get((frame, cam)),
                timestamp_s=timestamp_s,
                world_from_ego=_centred(world_from_ego, origin),
                lens=lenses[cam],
                width=width,
                height=height,
                is_held_out=frames.index(frame) in held_out,
                number=number,
            )
        )
    return tuple(images), (*size_problems, *problems)
