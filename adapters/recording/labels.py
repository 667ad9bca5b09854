"""A recording's boxes and sweeps: Parquet files of a job, read back to the bit by
augment.jobs.tables, or plain ones of any other program, passed through with every column.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tqdm import tqdm

from adapters.lidar_scene.depth import sweep_times, whole_numbers
from adapters.plain_files import LARGEST
from adapters.raw_drive import NO_SURFACE, Sweep, TimedBoxes, is_in_box
from adapters.recording.files import (
    Calibration,
    block_files,
    inside,
    numbered_files,
    read_lidar_classes,
)
from augment.cameras import Frame
from augment.effects.lidar.beam import intensity_column
from augment.effects.lidar.codes import INDEX_COLUMN
from augment.errors import AdapterError, OutputError
from augment.jobs.tables import ATTRIBUTE_PREFIX, is_ours, read_boxes, read_lidar, read_table
from augment.labels import Boxes, LidarSweep
from augment.semantics import SemanticClass
from recipes.files import open_file

_VECTORS = {
    "centers_m": ("center_x_m", "center_y_m", "center_z_m"),
    "sizes_m": ("length_m", "width_m", "height_m"),
    "quats": ("qw", "qx", "qy", "qz"),
}
_REQUIRED = ("frame", "track_id", "label", *(name for names in _VECTORS.values() for name in names))
_CACHED_FILES = 4  # box files kept: every frame asks for its own part of one
_DAMAGED = (OutputError, OSError, pa.ArrowException, KeyError, IndexError, TypeError, ValueError)
Value = TypeVar("Value")
_FAR_M = 1000.0  # no LiDAR on the ground sees this far
_OWN_M, _OWN_PART = 1.5, 1e-3  # a car's own returns are some hundreds a sweep
_TOP_QUANTILE = 0.999
_TOP_BEYOND_M = 5.0  # nearer, a camera's height says little of the sensor's
_TOP_DEG = (2.0, 60.0)


@dataclass(frozen=True)
class RecordingLabels:
    """Labels of one recording, read when asked, in the recording's own world."""

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
        return sweep_content(file, sweep)

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        """The SemanticClass of each return, or NO_SURFACE; None where the numbers are not known to
        mean anything."""
        column = sweep.columns.get("semantic")
        if column is None:
            return None
        numbers = class_numbers(self.root / "lidar", column)
        table, _ = class_table(self.root, np.unique(numbers), read_lidar_classes(self.root))
        return None if table is None else table[numbers]

    def lidar_origins(self, frame_index: int, sweep: LidarSweep) -> np.ndarray | None:
        """The columns origin_x, origin_y, origin_z, in the world of the returns, where all three
        hold numbers."""
        columns = [sweep.columns.get(f"origin_{axis}") for axis in "xyz"]
        if any(c is None or np.asarray(c).dtype.kind not in "fiu" for c in columns):
            return None
        return np.stack([np.asarray(column, np.float64) for column in columns], axis=1)


def recording_labels(path: str, query: dict[str, str]) -> RecordingLabels:
    """The labels of a folder; whatever the query, they are those of all its frames."""
    return RecordingLabels(Path(path))


def lidar_files(root: Path) -> dict[int, Path]:
    """The sweeps' files by frame number."""
    return numbered_files(root, "lidar", (".parquet",))


def all_boxes(root: Path) -> dict[int, TimedBoxes]:
    """The boxes of every frame that has any: of labels/boxes.parquet, or of a job's blocks, each of
    which has all boxes of its frames."""
    path = root / "labels" / "boxes.parquet"
    one = [inside(root, path)] if path.exists() else None
    found: dict[int, TimedBoxes] = {}
    for path in one or block_files(root, "labels/boxes", ".parquet"):
        found = read_frame_boxes(path) | found
    return found


def read_sweep(path: Path) -> LidarSweep:
    """The sweep in a file, every column under its own name."""

    def read() -> LidarSweep:
        if is_ours(path):
            sweep = read_lidar(path)
        else:
            table = read_table(path, str(path))
            sweep = LidarSweep({n: _column(table, n) for n in table.column_names})
        _ = sweep.points_m  # numbers, not texts
        return sweep

    return _reading(path, "a LiDAR file with columns x, y, z", read)


def sweep_content(path: Path, sweep: LidarSweep) -> bytes:
    """The LiDAR file with a weathered sweep in place of its own: the same columns, types and
    notes."""

    def content() -> bytes:
        table = read_table(path, str(path)).take(pa.array(sweep.columns[INDEX_COLUMN]))
        for name in {*"xyz", intensity_column(sweep)} - {None}:
            at = table.schema.get_field_index(name)
            field = table.schema.field(at)
            values = np.asarray(sweep.columns[name])
            values = np.rint(values) if pa.types.is_integer(field.type) else values
            table = table.set_column(at, field, pa.array(values).cast(field.type, safe=False))
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        return sink.getvalue().to_pybytes()

    return _reading(path, "a LiDAR file with columns x, y, z", content)


def read_frame_boxes(path: Path) -> dict[int, TimedBoxes]:
    """The boxes of every frame that has any."""

    def read() -> dict[int, TimedBoxes]:
        state = path.stat()
        return _read_boxes(path, state.st_mtime_ns, state.st_size)

    return _reading(path, f"a table of boxes with columns {', '.join(_REQUIRED)}", read)


@lru_cache(maxsize=_CACHED_FILES)
def _read_boxes(path: Path, _changed_ns: int, _size: int) -> dict[int, TimedBoxes]:
    if is_ours(path):
        return {
            number: TimedBoxes(f.boxes, np.full(len(f.boxes), f.timestamp_ns, np.int64))
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


def _boxes_at(columns: dict[str, np.ndarray], rows: np.ndarray) -> TimedBoxes:
    vectors = {
        field: np.stack([columns[name][rows].astype(np.float64) for name in names], axis=1)
        for field, names in _VECTORS.items()
    }
    times = columns.get("timestamp_ns")
    used = {*_REQUIRED, "timestamp_ns"}
    return TimedBoxes(
        Boxes(
            tuple(str(value) for value in columns["track_id"][rows]),
            tuple(str(value) for value in columns["label"][rows]),
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


def _reading(path: Path, expected: str, read: Callable[[], Value]) -> Value:
    try:
        open_file(path).close()  # to open a pipe would wait for ever
        return read()
    except _DAMAGED as error:
        raise AdapterError(f"{path} is not {expected}: {error}") from error


def class_numbers(path: Path, column: np.ndarray) -> np.ndarray:
    """The column `semantic` as int64 [N]. path: its file or folder, for messages."""
    try:
        return whole_numbers(column, "semantic")
    except ValueError as error:
        raise AdapterError(f"{path}: {error}") from None


def class_table(
    root: Path, numbers: np.ndarray, lidar_classes: Mapping[int, int] | None
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """SemanticClass (or NO_SURFACE) by the files' class number, int16, None where their meaning is
    not known; and a sentence where that is so. numbers: those that occur."""
    if len(numbers) == 0:
        return None, ()
    if lidar_classes is None:
        known = (numbers >= 0) & (numbers < SemanticClass.SKY)
        if not known.all():
            return None, (
                f"lidar/: the column semantic holds {int(numbers[~known][0])}, which is no "
                f"SemanticClass (0 to {SemanticClass.SKY - 1}): classes are ignored. Say what the "
                f'numbers mean in calibration.json: "lidar_classes": {{"7": "road", ...}}',
            )
        return np.arange(SemanticClass.SKY, dtype=np.int16), ()
    size = max(0, int(numbers.max()), *lidar_classes) + 1
    if numbers.min() < 0 or min(lidar_classes, default=0) < 0 or size > 2**16:
        raise AdapterError(
            f"{root / 'lidar'}: class numbers must lie in 0 to 65535; the files hold "
            f"{int(numbers.min())} to {int(numbers.max())}, lidar_classes names "
            f"{sorted(lidar_classes)}"
        )
    table = np.full(size, SemanticClass.UNKNOWN, np.int16)
    for number, meaning in lidar_classes.items():
        table[number] = meaning
    return table, ()


@dataclass(frozen=True, eq=False)
class LidarDrive:
    """sweeps: one a frame that has a file, scene world. top_deg: about the highest elevation that
    the LiDAR looks at. problems: one sentence each."""

    sweeps: tuple[Sweep, ...]
    top_deg: float
    problems: tuple[str, ...]

    def __len__(self) -> int:
        return sum(len(sweep) for sweep in self.sweeps)


def read_lidar_drive(root: Path, calibration: Calibration, frames: Sequence[Frame]) -> LidarDrive:
    """The sweeps of the given frames, without returns that are not finite, of no surface, or of the
    recording car (ego_box_m)."""
    files = lidar_files(root)
    problems = []
    if files:
        missing = [f.index for f in frames if f.index not in files]
        problems += [
            f"frame {n}: lidar/{n:06d}.parquet is missing, its points too" for n in missing
        ]
    known = [(frame, files[frame.index]) for frame in frames if frame.index in files]
    raws = [
        _Raw.of(path, frame, calibration)
        for frame, path in tqdm(known, desc="LiDAR", unit="frame", disable=None)
    ]
    timeless = [raw.frame for raw in raws if raw.timeless]
    if timeless:
        problems.append(
            f"lidar/: no column timestamp_ns, or t in seconds, near the frame's time in "
            f"{len(timeless)} sweeps (the first of frame {timeless[0]}); their frames' times are "
            f"used, fast objects are smeared"
        )
    present = [np.unique(raw.classes) for raw in raws if raw.classes is not None]
    numbers = np.unique(np.concatenate(present)) if present else np.zeros(0, np.int64)
    table, more = class_table(root, numbers, calibration.lidar_classes)
    sweeps = tuple(raw.usable(table) for raw in raws)
    if calibration.ego_box_m is None:
        problems += _own_returns(sweeps, known)
    return LidarDrive(sweeps, _top_deg(sweeps, known), (*problems, *more))


@dataclass(frozen=True, eq=False)
class _Raw:
    frame: int
    points: np.ndarray  # float32 [N, 3], scene world, finite
    timestamps_ns: np.ndarray  # int64 [N]
    classes: np.ndarray | None  # int64 [N], the file's own numbers
    timeless: bool

    @staticmethod
    def of(path: Path, frame: Frame, calibration: Calibration) -> _Raw:
        sweep = read_sweep(path)
        world = sweep.points_m - calibration.world_origin_m
        pose = frame.world_from_ego.numpy()
        keep = (np.abs(world) <= LARGEST).all(axis=1)  # not NaN, and float32 has it
        ego = (np.where(keep[:, None], world, 0) - pose[:3, 3]) @ pose[:3, :3]
        if keep.any() and np.median(np.abs(ego[keep]).max(axis=1)) > _FAR_M:
            raise AdapterError(
                f"{path}: most returns lie more than {_FAR_M:.0f} m from the car as "
                f"calibration.json has it in frame {frame.index}; x, y, z must be metres in the "
                f"world of its poses, not in the sensor's"
            )
        if calibration.ego_box_m is not None:
            keep &= ~is_in_box(ego, *calibration.ego_box_m)
        try:
            times = sweep_times(sweep, frame.timestamp_ns)
        except ValueError as error:
            raise AdapterError(f"{path}: {error}") from None
        classes = sweep.columns.get("semantic")
        if classes is not None:
            classes = class_numbers(path, classes)[keep]
        return _Raw(
            frame.index,
            world[keep].astype(np.float32),
            np.full(int(keep.sum()), frame.timestamp_ns) if times is None else times[keep],
            classes,
            timeless=times is None,
        )

    def usable(self, table: np.ndarray | None) -> Sweep:
        if self.classes is None or table is None:
            unknown = np.full(len(self.points), SemanticClass.UNKNOWN, np.int16)
            return Sweep(self.points, self.timestamps_ns, unknown)
        semantic = table[np.clip(self.classes, 0, len(table) - 1)]
        keep = semantic != NO_SURFACE
        return Sweep(self.points[keep], self.timestamps_ns[keep], semantic[keep])


def _own_returns(sweeps: Sequence[Sweep], known: Sequence[tuple[Frame, Path]]) -> list[str]:
    """A sentence where the LiDAR seems to see its own car."""
    near = total = 0
    for sweep, (frame, _) in zip(sweeps, known, strict=True):
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
    """The middle of a frame's cameras, float64 [3]."""
    return np.mean([camera.centre.numpy() for camera in frame.cameras.values()], axis=0)


def _top_deg(sweeps: Sequence[Sweep], known: Sequence[tuple[Frame, Path]]) -> float:
    """About the elevation of the highest channel: that of nearly the steepest return, as seen from
    the height of the cameras, for want of the sensor's own."""
    rises = []
    for sweep, (frame, _) in zip(sweeps, known, strict=True):
        if not frame.cameras or not len(sweep):
            continue
        offset = sweep.points - _middle(frame)
        reach = np.hypot(offset[:, 0], offset[:, 1])
        far = reach > _TOP_BEYOND_M
        rises.append(np.degrees(np.arctan2(offset[far, 2], reach[far])))
    joined = np.concatenate(rises) if rises else np.zeros(0)
    top = float(np.quantile(joined, _TOP_QUANTILE)) if len(joined) else 0.0
    return float(np.clip(top, *_TOP_DEG))
