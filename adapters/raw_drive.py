"""What raw drives have in common: the options of their URIs, which frames are used and held out,
sweeps, boxes, class tables, and weathered sweeps in the form of the dataset's files.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import BeforeValidator, Field

from adapters.uri import UriOptions
from augment.cameras import Frame
from augment.effects.lidar.codes import CODE_COLUMN, INDEX_COLUMN, MOVED, SCATTERED
from augment.errors import AdapterError
from augment.geometry import rotmat_from_quat
from augment.labels import Boxes, LidarSweep
from augment.semantics import SemanticClass

NO_SURFACE = -1  # stands for returns that no surface made, where a SemanticClass is expected
MOVED_M = 1.0  # an object whose boxes lie further apart than this moves, whatever its label says
# Attributes that say so themselves, as PandaSet's and the street's boxes do.
_STATIONARY = ("stationary", "is_parked")
_SIBLING = ("sibling_id", "cuboids.sibling_id")  # another sensor's box of the same object
FAR_FROM_ORIGIN_M = 1000.0  # float32 still resolves a tenth of a millimetre there


@dataclass(frozen=True)
class DriveFrames:
    """Frame numbers of a scene, ascending, and those of them that are held out."""

    numbers: tuple[int, ...]
    held_out: frozenset[int]
    problems: tuple[str, ...] = ()

    @property
    def used(self) -> tuple[int, ...]:
        """The numbers of the frames that the scene is built from."""
        return tuple(number for number in self.numbers if number not in self.held_out)


def _frame_range(text: object, max_parts: int) -> range:
    if isinstance(text, range):
        return text
    parts = str(text).split(":")
    if not 2 <= len(parts) <= max_parts:
        raise ValueError(text)
    first, stop, step = (int(part) if part else None for part in (*parts, "")[:3])
    found = range(first or 0, sys.maxsize if stop is None else stop, 1 if step is None else step)
    if found.start < 0 or found.step < 1 or found.stop <= found.start:
        raise ValueError(text)
    return found


def _shown(frames: range) -> str:
    return f"{frames.start}:{'' if frames.stop == sys.maxsize else frames.stop}"


class DriveOptions(UriOptions):
    """Options of one opening, as in `pandaset:<path>?voxel_m=0.05&frames=0:10`.

    voxel_m: edge of a voxel near the ego path; it grows with the distance from it. max_gaussians:
    voxels are enlarged until the scene holds no more than about this many. image_scale: resolution
    that images are decoded at for colours and sky, as JPEGs can be without a second resize.
    sky_size: texels along an edge of the sky's cube map. held_out: frames that the Gaussians, their
    colours and the sky are made without; they stay in the scene, and their boxes still make
    tracks."""

    frames: Annotated[range, BeforeValidator(lambda text: _frame_range(text, 2))] = Field(
        range(sys.maxsize),
        description="first:stop, frame numbers with stop excluded, either side may be empty",
    )
    voxel_m: float = Field(0.04, ge=0.01, le=2, description="a number of metres from 0.01 to 2")
    max_gaussians: int = Field(
        500_000, ge=1_000, le=20_000_000, description="an integer from 1000 to 20000000"
    )
    image_scale: Annotated[Literal[1, 0.5, 0.25, 0.125], BeforeValidator(float)] = Field(
        0.5, description="one of 1, 0.5, 0.25, 0.125"
    )
    sky_size: int = Field(768, ge=8, le=4096, description="an integer from 8 to 4096")
    held_out: Annotated[range, BeforeValidator(lambda text: _frame_range(text, 3))] | None = Field(
        None,
        description="first:stop:step, frame numbers with stop excluded, such as 1::2 for every "
        "other one",
    )

    def select(self, numbers: Sequence[int], *, where: str) -> DriveFrames:
        """Which of the dataset's frames, ascending, the scene has. where: for messages."""
        kept = tuple(number for number in numbers if number in self.frames)
        if not kept:
            raise AdapterError(
                f"{where}: frames={_shown(self.frames)} selects none of the {len(numbers)} "
                f"frames ({numbers[0]} to {numbers[-1]})"
            )
        if self.held_out is None:
            return DriveFrames(kept, frozenset())
        held = frozenset(number for number in kept if number in self.held_out)
        stated = f"held_out={_shown(self.held_out)}:{self.held_out.step} holds out"
        if len(held) == len(kept):
            raise AdapterError(
                f"{where}: {stated} all {len(kept)} frames ({kept[0]} to {kept[-1]}); leave some "
                f"to build the scene from, as 1::2 does"
            )
        problem = f"{stated} none of frames {kept[0]} to {kept[-1]}"
        return DriveFrames(kept, held, () if held else (problem,))


def drive_origin(positions_m: np.ndarray) -> np.ndarray:
    """What to subtract from the dataset's coordinates so that float32 keeps its digits, float64
    [3]: zero near the dataset's origin, else whole metres near the first of the car's positions [F,
    3]."""
    far = np.linalg.norm(positions_m, axis=1).max() > FAR_FROM_ORIGIN_M
    return np.round(positions_m[0]) if far else np.zeros(3)


@dataclass(frozen=True, eq=False)
class Sweep:
    """The usable returns of one frame: points float32 [N, 3] in the scene's world, timestamps_ns
    int64 [N], semantic int16 [N], SemanticClass values."""

    points: np.ndarray
    timestamps_ns: np.ndarray
    semantic: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def of_unknown_class(points: np.ndarray, timestamp_ns: int) -> Sweep:
        """Points [N, 3] of one time."""
        return Sweep(
            points.astype(np.float32),
            np.full(len(points), timestamp_ns, np.int64),
            np.full(len(points), SemanticClass.UNKNOWN, np.int16),
        )


def is_in_box(points: np.ndarray, low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
    """Which points [N, 3] lie strictly inside an axis-aligned box, such as the recording car."""
    return ((points > low_m) & (points < high_m)).all(axis=1)


@dataclass(frozen=True, eq=False)
class BoxSample:
    """One box of a moving object: where it stood at one moment.

    object_id: the dataset's name of the object. sibling_id: the name that another sensor's box of
    the same object goes by, or None. frame: the dataset's frame number. world_from_box: float64
    [4, 4] in the scene's world, box x forward. size_m: length, width, height."""

    object_id: str
    sibling_id: str | None
    label: str
    frame: int
    timestamp_ns: int
    world_from_box: np.ndarray
    size_m: np.ndarray


def objects_that_travel(places: Iterable[tuple[str, np.ndarray]]) -> set[str]:
    """The objects of which two boxes are further apart in plan than MOVED_M. places: the name of
    each box's object and its centre, metres."""
    by_name: dict[str, list[np.ndarray]] = defaultdict(list)
    for name, centre in places:
        by_name[name].append(centre[:2])
    extents = {n: np.fmax.reduce(xy) - np.fmin.reduce(xy) for n, xy in by_name.items()}
    return {name for name, extent in extents.items() if np.hypot(*extent) > MOVED_M}


@dataclass(frozen=True, eq=False)
class TimedBoxes:
    """Boxes of one frame. timestamps_ns: int64 [B], when each stood there; None: the frame's."""

    boxes: Boxes
    timestamps_ns: np.ndarray | None


@dataclass(frozen=True, eq=False)
class RecordedObjects:
    """moving: samples of the objects that move, in order of frames. still: one sample of each
    object that does not. problems: one sentence each."""

    moving: tuple[BoxSample, ...]
    still: tuple[BoxSample, ...]
    problems: tuple[str, ...]


def read_objects(
    frames: Sequence[Frame], boxes: Mapping[int, TimedBoxes], world_origin_m: np.ndarray
) -> RecordedObjects:
    """The objects of the frames. An object moves if an attribute says that it is not stationary or
    if its boxes lie further apart than MOVED_M; others stay part of the static world."""
    samples: list[BoxSample] = []
    labelled: set[str] = set()
    bad, twice = [], []
    for frame in frames:
        timed = boxes.get(frame.index)
        seen: set[str] = set()
        for sample, moves in [] if timed is None else _samples(frame, timed, world_origin_m):
            if sample is None:
                bad.append(frame.index)
            elif sample.object_id in seen:
                twice.append((sample.object_id, frame.index))
            else:
                seen.add(sample.object_id)
                samples.append(sample)
                labelled |= {sample.object_id} if moves else set()
    moving = labelled | objects_that_travel((s.object_id, s.world_from_box[:3, 3]) for s in samples)
    still = {s.object_id: s for s in reversed(samples) if s.object_id not in moving}
    problems = []
    if bad:
        problems.append(
            f"labels/boxes.parquet: {len(bad)} boxes, the first in frame {bad[0]}, have a centre, "
            f"size or rotation that is not finite or zero; objects are built without them"
        )
    if twice:
        name, frame = twice[0]
        problems.append(
            f"labels/boxes.parquet: {len(twice)} boxes share track_id and frame with another, such "
            f"as {name!r} in frame {frame}; the first one counts"
        )
    return RecordedObjects(
        tuple(s for s in samples if s.object_id in moving),
        tuple(reversed(still.values())),
        tuple(problems),
    )


def _samples(
    frame: Frame, timed: TimedBoxes, world_origin_m: np.ndarray
) -> Iterator[tuple[BoxSample | None, bool]]:
    """Each box as a sample, None where it is unusable, and whether it is labelled as moving."""
    boxes = timed.boxes
    times = timed.timestamps_ns
    values = np.concatenate([boxes.centers_m, boxes.sizes_m, boxes.quats], axis=1)
    good = np.isfinite(values).all(1) & (boxes.sizes_m > 0).all(1)
    good &= np.linalg.norm(boxes.quats, axis=1) > 1e-6
    stationary = next((boxes.attributes[n] for n in _STATIONARY if n in boxes.attributes), None)
    siblings = next((boxes.attributes[n] for n in _SIBLING if n in boxes.attributes), None)
    for i in range(len(boxes)):
        if not good[i]:
            yield None, False
            continue
        pose = np.eye(4)
        pose[:3, :3] = rotmat_from_quat(torch.from_numpy(boxes.quats[i])).numpy()
        pose[:3, 3] = boxes.centers_m[i] - world_origin_m
        sibling = None if siblings is None else siblings[i]
        sample = BoxSample(
            boxes.track_ids[i],
            sibling if isinstance(sibling, str) and sibling not in ("", "-") else None,
            boxes.labels[i],
            frame.index,
            frame.timestamp_ns if times is None else int(times[i]),
            pose,
            boxes.sizes_m[i],
        )
        yield sample, stationary is not None and _is_false(stationary[i])


def _is_false(value: object) -> bool:
    """False or 0; a missing value says nothing."""
    return isinstance(value, bool | int | np.bool_ | np.integer) and not value


def class_table(names: Mapping[int, str], meaning: Mapping[str, int]) -> np.ndarray:
    """SemanticClass, or NO_SURFACE, by the dataset's class number, int16 [256]; UNKNOWN for names
    without a meaning."""
    table = np.full(256, SemanticClass.UNKNOWN, np.int16)
    for number, name in names.items():
        if number < len(table):
            table[number] = meaning.get(name, SemanticClass.UNKNOWN)
    return table


def classes_of(sweep: LidarSweep, table: np.ndarray) -> np.ndarray | None:
    """The SemanticClass of each return, or NO_SURFACE; None for a sweep without classes."""
    classes = sweep.columns.get("semantic")
    if classes is None:
        return None
    return table[np.clip(classes.astype(np.int64), 0, len(table) - 1)]


def stored_records(
    records: np.ndarray, columns: Sequence[str], sweep: LidarSweep, world_from_file: np.ndarray
) -> bytes:
    """Records float32 [N, C] of a file with a weathered sweep of them in their place.

    columns: x, y, z, intensity and others, in the file's order. Returns that did not move keep
    their coordinates to the bit; the others are carried back in float64, so that only float32's
    rounding is left: less than 0.01 mm within 100 m of the sensor."""
    out = records[sweep.columns[INDEX_COLUMN]]
    moved = np.flatnonzero(np.isin(sweep.columns[CODE_COLUMN], (MOVED, SCATTERED)))
    offsets = sweep.points_m[moved] - world_from_file[:3, 3]
    places = np.linalg.solve(world_from_file[:3, :3], offsets.T)
    for axis, name in enumerate("xyz"):
        out[moved, columns.index(name)] = places[axis]
    out[:, columns.index("intensity")] = sweep.columns["intensity"]
    return out.tobytes()
