"""One drive in the form that all raw datasets share, and the scene that is made of it.

An adapter fills a `RawDrive` from its dataset's files; `scene_of_drive` turns it into Gaussians.
This module holds what datasets have in common: options of URIs, held-out frames, the origin,
images, sweeps, boxes, classes, and weathered sweeps in the form of the dataset's files.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from pydantic import BeforeValidator, Field

from adapters.drive_checks import camera_problems, lidar_problems
from adapters.plain_files import MISSING, check_image
from adapters.recorded_lenses import (
    LENS_MEANING,
    RECORDED_LENS,
    UNDISTORTED_LENS,
    LensChoice,
    with_recorded_frames,
)
from adapters.uri import UriOptions
from augment.effects.lidar.codes import CODE_COLUMN, INDEX_COLUMN, UNCHANGED, is_in_air
from augment.errors import AdapterError
from augment.files.image_size import ImageHeader
from augment.files.recorded_images import exif_hint
from augment.scene.cameras import Frame
from augment.scene.geometry import rotmat_from_quat
from augment.scene.labels import Boxes, LabelSource, LidarSweep
from augment.scene.scene import Gaussians, Ground, Scene
from augment.scene.semantics import SemanticClass

NO_SURFACE = -1  # stands for returns that no surface made, where a SemanticClass is expected
# Returns further from the car's path than this are none: LiDARs of cars see some 300 m.
_MAX_RANGE_M = 1000.0
# Plan of a drive with what lies around it: maps of it have a cell a square metre.
_MAX_AREA_M2 = 1 << 26
MOVED_M = 1.0  # an object whose boxes lie further apart than this moves, whatever its label says
# Attributes that say so themselves, as PandaSet's and the street's boxes do.
_STATIONARY = ("stationary", "is_parked")
_SIBLING = ("sibling_id", "cuboids.sibling_id")  # another sensor's box of the same object
FAR_FROM_ORIGIN_M = 1000.0  # float32 still resolves a tenth of a millimetre there
_MAX_COLOUR_IMAGES = 150  # images that colour a drive: one every few metres shows all there is
_MAX_DECODED = 600  # images of a drive that are decoded to check them, some 5 ms each
_READERS = 4  # threads that decode images to check them; decoding releases the interpreter
_MAX_FAULTS = 3  # sentences about one camera's images; more become one
_MAX_NAMED = 3  # frames that a message lists
_NO_FILE = "has no image"  # fault of a picture without a path
_STILL_M = 1e-4  # largest distance from its record of a return that has not moved


# ---- Which frames --------------------------------------------------------------------------------


@dataclass(frozen=True)
class DriveFrames:
    """Frame numbers of a scene, ascending, and those of them that are held out."""

    numbers: tuple[int, ...]
    held_out: frozenset[int]
    problems: tuple[str, ...] = ()

    @property
    def used(self) -> tuple[int, ...]:
        """Return the numbers of the frames from which the scene is built."""
        return tuple(number for number in self.numbers if number not in self.held_out)


def _frame_range(text: object, max_parts: int) -> range:
    if isinstance(text, range):
        return text
    parts = str(text).split(":")
    if not 2 <= len(parts) <= max_parts:
        raise ValueError(text)
    first, stop, step = (int(part) if part else None for part in (*parts, "")[:3])
    frames = range(first or 0, sys.maxsize if stop is None else stop, 1 if step is None else step)
    if frames.start < 0 or frames.step < 1 or frames.stop <= frames.start:
        raise ValueError(text)
    return frames


def _shown(frames: range) -> str:
    return f"{frames.start}:{'' if frames.stop == sys.maxsize else frames.stop}"


class DriveOptions(UriOptions):
    """Options of one opening, as in `pandaset:<path>?voxel_m=0.05&frames=0:10`.

    voxel_m: edge of a voxel near the ego path; it grows with the distance from it. max_gaussians:
    voxels are enlarged until the scene holds no more than about this many. image_scale: resolution
    that images are decoded at for colours and sky, as JPEGs can be without a second resize.
    sky_size: texels along an edge of the sky's cube map. held_out: frames that the Gaussians, their
    colours and the sky are made without; they stay in the scene, and their boxes still make
    tracks. depth: a user's depth maps for surfaces beyond the LiDAR's view. lens: recorded for
    cameras with the dataset's lenses and its images as recorded; the scene itself is made from
    undistorted images all the same."""

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
    depth: str | None = Field(
        None,
        description="a folder of depth maps, FOLDER/<camera>/<frame>.png or .npy, also as "
        "metric:FOLDER or relative:FOLDER",
    )
    lens: LensChoice = Field(UNDISTORTED_LENS, description=LENS_MEANING)

    @property
    def has_recorded_lens(self) -> bool:
        """Return True if the scene's cameras keep the lenses of the dataset."""
        return self.lens == RECORDED_LENS

    def select(self, numbers: Sequence[int], *, where: str) -> DriveFrames:
        """Select the scene's frames from the dataset's, which ascend. where: for messages."""
        selection = tuple(number for number in numbers if number in self.frames)
        if not selection:
            raise AdapterError(
                f"{where}: frames={_shown(self.frames)} selects none of the {len(numbers)} "
                f"frames ({numbers[0]} to {numbers[-1]})"
            )
        if self.held_out is None:
            return DriveFrames(selection, frozenset())
        held_out = frozenset(number for number in selection if number in self.held_out)
        stated = f"held_out={_shown(self.held_out)}:{self.held_out.step} holds out"
        if len(held_out) == len(selection):
            raise AdapterError(
                f"{where}: {stated} all {len(selection)} frames "
                f"({selection[0]} to {selection[-1]}); leave some to build the scene from, "
                f"as 1::2 does"
            )
        problem = f"{stated} none of frames {selection[0]} to {selection[-1]}"
        return DriveFrames(selection, held_out, () if held_out else (problem,))


def describe_frames(numbers: Sequence[int]) -> str:
    """Return the number of frames and the first of them, for messages."""
    first_numbers = ", ".join(map(str, numbers[:_MAX_NAMED]))
    more = ", ..." if len(numbers) > _MAX_NAMED else ""
    return f"{len(numbers)} frame{'' if len(numbers) == 1 else 's'} ({first_numbers}{more})"


def drive_origin(positions_m: np.ndarray) -> np.ndarray:
    """Return the offset to subtract from the dataset's coordinates, float64 [3].

    It lets float32 keep its digits. It is zero near the dataset's origin, else whole metres near
    the first of the car's positions [F, 3].
    """
    far = np.linalg.norm(positions_m, axis=1).max() > FAR_FROM_ORIGIN_M
    return np.round(positions_m[0]) if far else np.zeros(3)


def recenter_pose(world_from_thing: np.ndarray, world_origin_m: np.ndarray) -> torch.Tensor:
    """Return a pose [4, 4] of the dataset's world in the scene's."""
    pose = world_from_thing.copy()
    pose[:3, 3] -= world_origin_m
    return torch.from_numpy(pose)


# ---- Images --------------------------------------------------------------------------------------


class Picture(NamedTuple):
    """One camera's image of one frame.

    Attributes:
        camera, frame: name and number.
        path: None without an image.
        size: width and height in the calibration. Without it, those of most of the camera's images.
    """

    camera: str
    frame: int
    path: Path | None
    size: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class DriveImages:
    """Images of a drive.

    Attributes:
        paths: usable images by frame and camera.
        sizes: width and height of the cameras' images.
        problems: a sentence for each unusable image.
    """

    paths: Mapping[int, Mapping[str, str]]
    sizes: Mapping[str, tuple[int, int]]
    problems: tuple[str, ...]


def usable_images(pictures: Sequence[Picture], *, every_camera: bool = True) -> DriveImages:
    """Return the images that are whole and of their camera's size.

    Up to _MAX_DECODED images are decoded to be sure of them; if there are more, only headers and
    ends are checked.

    Raises:
        AdapterError: a camera's size is known from no calibration and no image; or, for
            every_camera, none of its images can be used.
    """
    with ThreadPoolExecutor(_READERS) as pool:
        look = partial(_header_or_fault, decode=len(pictures) <= _MAX_DECODED)
        header_or_fault = dict(zip(pictures, pool.map(look, pictures), strict=True))
    by_camera: dict[str, list[Picture]] = defaultdict(list)
    for picture in pictures:
        by_camera[picture.camera].append(picture)
    paths: dict[int, dict[str, str]] = {picture.frame: {} for picture in pictures}
    sizes = {}
    problems = []
    for camera, camera_pictures in by_camera.items():
        headers = [
            header for p in camera_pictures if not isinstance(header := header_or_fault[p], str)
        ]
        usual = Counter(header.size for header in headers).most_common(1)
        size = camera_pictures[0].size or (usual[0][0] if usual else None)
        faults = []
        for picture in camera_pictures:
            fault = _fault(picture, header_or_fault[picture], picture.size or size)
            if fault:
                faults.append(f"camera {camera}, frame {picture.frame}: {fault}")
            else:
                paths[picture.frame][camera] = str(picture.path)
        has_files = any(
            header_or_fault[picture] not in (MISSING, _NO_FILE) for picture in camera_pictures
        )
        if size is None or (len(faults) == len(camera_pictures) and every_camera and has_files):
            raise AdapterError(
                f"none of the {len(camera_pictures)} images of camera {camera} can be used: "
                f"{'; '.join(faults[:_MAX_FAULTS])}. Images and calibration must be of one drive, "
                f"and not resized; unpack them again"
            )
        if len(faults) > _MAX_FAULTS:
            faults = [f"{faults[0]}; so are {len(faults) - 1} more of {len(camera_pictures)}"]
        sizes[camera] = size
        problems += faults
    used = [
        (p, h)
        for p, h in header_or_fault.items()
        if p.camera in paths[p.frame] and not isinstance(h, str)
    ]
    return DriveImages(paths, sizes, (*problems, *image_notes(used)))


def _header_or_fault(picture: Picture, *, decode: bool) -> ImageHeader | str:
    return _NO_FILE if picture.path is None else check_image(picture.path, decode=decode)


def _fault(
    picture: Picture, header_or_fault: ImageHeader | str, expected: tuple[int, int] | None
) -> str:
    if picture.path is None:
        return "its image is missing"
    if isinstance(header_or_fault, str):
        return f"image {picture.path} {header_or_fault}; left out"
    if expected is None or header_or_fault.size == expected:
        return ""
    size = "{0[0]}x{0[1]}".format
    return (
        f"image {picture.path} is {size(header_or_fault.size)} pixels, its camera "
        f"{size(expected)}; left out"
        f"{exif_hint(header_or_fault, expected)}"
    )


def image_notes(images: Sequence[tuple[Picture, ImageHeader]]) -> list[str]:
    """Return a sentence if usable images have an EXIF orientation, and one if they have 16 bits."""
    notes = []
    turned = [(picture, header) for picture, header in images if header.orientation != 1]
    if turned:
        picture, header = turned[0]
        notes.append(
            f"{len(turned)} of {len(images)} images have an EXIF orientation, such as "
            f"{header.orientation} in camera {picture.camera}, frame {picture.frame}; it is "
            f"ignored: poses and intrinsics are of the pixels as they are stored"
        )
    deep = [picture for picture, header in images if header.bits == 16]
    if deep:
        notes.append(
            f"{len(deep)} of {len(images)} images have 16 bits a channel, such as of camera "
            f"{deep[0].camera}, frame {deep[0].frame}; they are read as their values / 256"
        )
    return notes


# ---- Sweeps and classes --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Sweep:
    """Usable returns of one frame.

    Attributes:
        points: float32 [N, 3] in the scene's world.
        timestamps_ns: int64 [N].
        semantic: int16 [N], SemanticClass values.
        origins: float32 [N, 3], the sensor's place for each return, or None if it is not known.
    """

    points: np.ndarray
    timestamps_ns: np.ndarray
    semantic: np.ndarray
    origins: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def of_unknown_class(
        points: np.ndarray, timestamp_ns: int, origins: np.ndarray | None = None
    ) -> Sweep:
        """Return a sweep of points [N, 3] of one time. origins: the sensor's places [N, 3]."""
        return Sweep(
            points.astype(np.float32),
            np.full(len(points), timestamp_ns, np.int64),
            np.full(len(points), SemanticClass.UNKNOWN, np.int16),
            None if origins is None else origins.astype(np.float32),
        )

    def select(self, keep: np.ndarray) -> Sweep:
        origins = None if self.origins is None else self.origins[keep]
        return Sweep(self.points[keep], self.timestamps_ns[keep], self.semantic[keep], origins)


def is_in_box(points: np.ndarray, low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
    """Return True for points [N, 3] strictly inside an axis-aligned box, such as the recording
    car.
    """
    return ((points > low_m) & (points < high_m)).all(axis=1)


def is_usable(
    sweep: Sweep, points_m: np.ndarray, world_from_ego: np.ndarray, ego_m: np.ndarray
) -> np.ndarray:
    """Return True for returns that are finite, of a surface, and not in the recording car's box,
    bool [N].

    Args:
        sweep: the sweep.
        points_m: float64 [N, 3], its points.
        world_from_ego: the car's pose.
        ego_m: [2, 3], the car's box in its own axes.
    """
    with np.errstate(all="ignore"):
        ego = (points_m - world_from_ego[:3, 3]) @ world_from_ego[:3, :3]
    keep = ~is_in_box(ego, *ego_m) & (sweep.semantic != NO_SURFACE)
    return keep & np.isfinite(sweep.points).all(axis=1)


def world_classes(numbers: np.ndarray, meaning: Mapping[int, int]) -> np.ndarray:
    """Return the SemanticClass, or NO_SURFACE, of a dataset's class numbers [N], int16.

    Numbers without a meaning are UNKNOWN.
    """
    if not meaning:
        return np.full(len(numbers), SemanticClass.UNKNOWN, np.int16)
    class_numbers = np.array(sorted(meaning), np.int64)
    classes = np.array([meaning[int(number)] for number in class_numbers], np.int16)
    at = np.clip(np.searchsorted(class_numbers, numbers), 0, len(class_numbers) - 1)
    return np.where(class_numbers[at] == numbers, classes[at], np.int16(SemanticClass.UNKNOWN))


def class_of_air(meaning: Mapping[int, int], names: Mapping[int, str], name: str) -> int:
    """Return the dataset's class number for returns that drops, flakes or fog made.

    It is that of the name, else the lowest that stands for no surface, else the lowest of unknown
    meaning.

    Args:
        meaning: SemanticClass or NO_SURFACE by class number.
        names: the dataset's word by class number.
        name: the preferred word.
    """
    number = next((number for number, word in names.items() if word == name), None)
    if number is not None:
        return number
    for semantic in (NO_SURFACE, SemanticClass.UNKNOWN):
        if numbers := [number for number, meant in meaning.items() if meant == semantic]:
            return min(numbers)
    return next(number for number in itertools.count() if number not in meaning)


def stored_records(
    records: np.ndarray,
    columns: Sequence[str],
    sweep: LidarSweep,
    world_from_file: np.ndarray,
    air: Mapping[str, float] = MappingProxyType({}),
) -> bytes:
    """Return the records of a file, float32 [N, C], with those of a weathered sweep instead.

    Returns that did not move keep their coordinates to the bit. The others are carried back in
    float64, so that only float32's rounding is left: less than 0.01 mm within 100 m of the sensor.

    Args:
        records: float32 [M, C], the recorded records.
        columns: x, y, z, intensity and others, in the file's order.
        sweep: the weathered sweep.
        world_from_file: pose of the file's coordinates.
        air: values of the columns that describe a return's surface, for returns that drops, flakes
            or fog made.
    """
    out = records[sweep.columns[INDEX_COLUMN]]
    changed = np.flatnonzero(sweep.columns[CODE_COLUMN] != UNCHANGED)
    offsets = sweep.points_m[changed] - world_from_file[:3, 3]
    places = np.linalg.solve(world_from_file[:3, :3], offsets.T)
    axes = [columns.index(name) for name in "xyz"]
    moved = (np.abs(places - out[changed][:, axes].T) > _STILL_M).any(0)
    for axis, column in enumerate(axes):
        out[changed[moved], column] = places[axis, moved]
    out[:, columns.index("intensity")] = sweep.columns["intensity"]
    for name, value in air.items():
        out[is_in_air(sweep), columns.index(name)] = value
    return out.tobytes()


# ---- Boxes ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BoxSample:
    """One box of a moving object: its place at one moment.

    Attributes:
        object_id: the dataset's name of the object.
        sibling_id: name of another sensor's box of the same object, or None.
        label: class.
        frame: the dataset's frame number.
        timestamp_ns: the moment.
        world_from_box: float64 [4, 4] in the scene's world, box x forward.
        size_m: length, width, height.
        row: number among the frame's boxes.
    """

    object_id: str
    sibling_id: str | None
    label: str
    frame: int
    timestamp_ns: int
    world_from_box: np.ndarray
    size_m: np.ndarray
    row: int = -1


@dataclass(frozen=True, eq=False)
class TimedBoxes:
    """Boxes of one frame with the times at which they stood there.

    Attributes:
        frame: number of the frame.
        boxes: the boxes.
        timestamps_ns: int64 [B], or one time for all.
        is_moving: bool [B], True for boxes that are labelled as moving. None if their attributes
            say it.
        rotations: float64 [B, 3, 3], if they are known better than from the quaternions.
    """

    frame: int
    boxes: Boxes
    timestamps_ns: np.ndarray | int
    is_moving: np.ndarray | None = None
    rotations: np.ndarray | None = None

    def samples(self, world_origin_m: np.ndarray) -> Iterator[tuple[BoxSample | None, bool]]:
        """Yield each box, None for an impossible one, and whether it is labelled as moving."""
        boxes = self.boxes
        values = np.concatenate([boxes.centers_m, boxes.sizes_m, boxes.quats], axis=1)
        good = np.isfinite(values).all(1) & (boxes.sizes_m > 0).all(1)
        good &= np.linalg.norm(boxes.quats, axis=1) > 1e-6
        times = np.broadcast_to(self.timestamps_ns, len(boxes))
        rotations = self.rotations
        if rotations is None:
            rotations = rotmat_from_quat(torch.from_numpy(boxes.quats)).numpy()
        moves = self.is_moving
        if moves is None:
            stationary = _attribute(boxes, _STATIONARY)
            moves = [False] * len(boxes) if stationary is None else list(map(_is_false, stationary))
        siblings = _attribute(boxes, _SIBLING)
        for i in range(len(boxes)):
            if not good[i]:
                yield None, False
                continue
            pose = np.eye(4)
            pose[:3, :3] = rotations[i]
            pose[:3, 3] = boxes.centers_m[i] - world_origin_m
            sibling = None if siblings is None else siblings[i]
            sibling = sibling if isinstance(sibling, str) and sibling not in ("", "-") else None
            name = boxes.track_ids[i]
            label = boxes.labels[i]
            size_m = boxes.sizes_m[i]
            sample = BoxSample(name, sibling, label, self.frame, int(times[i]), pose, size_m, row=i)
            yield sample, bool(moves[i])


def names_in(values: Iterable[object]) -> tuple[str, ...]:
    """Return the texts of a dataset's column of names; "" for missing ones (None or NaN)."""
    return tuple(
        "" if value is None or (isinstance(value, float) and math.isnan(value)) else str(value)
        for value in values
    )


def _attribute(boxes: Boxes, names: Sequence[str]) -> np.ndarray | None:
    return next((boxes.attributes[name] for name in names if name in boxes.attributes), None)


def _is_false(value: object) -> bool:
    """Return True for False or 0. A missing value says nothing."""
    return isinstance(value, bool | int | np.bool_ | np.integer) and not value


@dataclass(frozen=True, eq=False)
class RecordedObjects:
    """Objects of a drive.

    Attributes:
        moving_boxes: samples of the objects that move, in order of frames.
        static_boxes: one sample of each object that does not.
        problems: one sentence each.
    """

    moving_boxes: tuple[BoxSample, ...]
    static_boxes: tuple[BoxSample, ...]
    problems: tuple[str, ...]


def find_objects(
    frames: Iterable[TimedBoxes], world_origin_m: np.ndarray, *, allows_several_boxes: bool = False
) -> RecordedObjects:
    """Find the objects in the boxes of frames.

    An object moves if a box is labelled so, or if its boxes lie further apart than MOVED_M. Others
    stay part of the static world. several: True if an object may have several boxes in a frame;
    else the first one counts.
    """
    samples: list[BoxSample] = []
    labelled: set[str] = set()
    bad = []
    twice = []
    nameless = []
    for timed in frames:
        nameless += [timed.frame for label in timed.boxes.labels if not label]
        frame_object_ids: set[str] = set()
        for sample, moves in timed.samples(world_origin_m):
            if sample is None:
                bad.append(timed.frame)
            elif sample.object_id in frame_object_ids and not allows_several_boxes:
                twice.append((sample.object_id, timed.frame))
            else:
                frame_object_ids.add(sample.object_id)
                samples.append(sample)
                labelled |= {sample.object_id} if moves else set()
    moving = labelled | objects_that_travel((s.object_id, s.world_from_box[:3, 3]) for s in samples)
    still = {s.object_id: s for s in reversed(samples) if s.object_id not in moving}
    problems = []
    if bad:
        problems.append(
            f"{len(bad)} boxes, the first in frame {bad[0]}, have a centre, size or rotation that "
            f"is not finite or zero, or a negative size; objects are built without them, "
            f"and labels for trainers have them as DontCare or not at all"
        )
    if nameless:
        problems.append(
            f"{len(nameless)} boxes, the first in frame {nameless[0]}, have no label; they are of "
            f"no category, and left out of labels for trainers"
        )
    if twice:
        name, frame = twice[0]
        problems.append(
            f"{len(twice)} boxes share name and frame with another, such as {name!r} in frame "
            f"{frame}; the first one counts"
        )
    return RecordedObjects(
        tuple(s for s in samples if s.object_id in moving),
        tuple(reversed(still.values())),
        tuple(problems),
    )


def objects_that_travel(places: Iterable[tuple[str, np.ndarray]]) -> set[str]:
    """Return the objects of which two boxes are further apart in plan than MOVED_M.

    places: name of each box's object, and its centre in metres.
    """
    by_name: dict[str, list[np.ndarray]] = defaultdict(list)
    for name, centre in places:
        by_name[name].append(centre[:2])
    extents = {n: np.fmax.reduce(xy) - np.fmin.reduce(xy) for n, xy in by_name.items()}
    return {name for name, extent in extents.items() if np.hypot(*extent) > MOVED_M}


# ---- The drive, and the scene that is made of it -------------------------------------------------


def colour_every(images: int) -> int:
    """Return the step between the frames that give colours, in a drive with so many images."""
    return max(1, -(-images // _MAX_COLOUR_IMAGES))


@dataclass(frozen=True, eq=False)
class RawDrive:
    """One drive of a dataset, in the scene's world: the dataset's less world_origin_m.

    Attributes:
        frames: selected frames, in order of time, with cameras and usable images.
        held_out: numbers of the frames without which the scene is built.
        sweeps: usable returns, one sweep for each used frame that has any.
        boxes: boxes of moving objects, in order of frames.
        labels: labels of all frames, in the dataset's world, with the meaning of the sweeps'
            classes.
        lidar_top_deg: highest elevation that the LiDAR measures.
        problems: a sentence for each thing that is missing or damaged.
        used_rows: fraction of the rows from the top that does not show the car, by camera.
        grey_cameras: cameras without colours.
        colour_every: step between the used frames that give colours and sky.
        recorded_frames: the same frames with the dataset's lenses and its images as recorded, which
            the scene gets in place of `frames`. None if the scene keeps `frames`.
    """

    name: str
    source: str
    frames: tuple[Frame, ...]
    held_out: frozenset[int]
    sweeps: tuple[Sweep, ...]
    boxes: tuple[BoxSample, ...]
    labels: LabelSource
    world_origin_m: np.ndarray
    lidar_top_deg: float
    problems: tuple[str, ...]
    used_rows: Mapping[str, float] = field(default_factory=dict)
    grey_cameras: frozenset[str] = frozenset()
    colour_every: int = 1
    has_metric_scale: bool = True
    recorded_frames: tuple[Frame, ...] | None = None

    def __post_init__(self) -> None:
        """
        Raises:
            AdapterError: the car's path is wider than maps of it can be."""
        path = self.path
        width_m = np.ptp(path, axis=0)[:2]
        if np.prod(width_m + 2 * _MAX_RANGE_M) > _MAX_AREA_M2:
            steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
            number = int(steps.argmax())
            raise AdapterError(
                f"{self.source}: the car's path is {width_m[0]:.3g} x {width_m[1]:.3g} m wide, "
                f"more than a scene can be; it goes furthest, {steps[number]:.3g} m, between "
                f"frames {self.frames[number].index} and {self.frames[number + 1].index}. Poses "
                f"must be metres; of a longer drive choose some frames (frames=)"
            )

    @property
    def path(self) -> np.ndarray:
        """Return the car's places in the frames, float64 [F, 3]."""
        return np.stack([frame.world_from_ego[:3, 3].numpy() for frame in self.frames])

    @property
    def used(self) -> tuple[Frame, ...]:
        """Return the frames from which the scene is built."""
        return tuple(frame for frame in self.frames if frame.index not in self.held_out)


class IncompleteDrive(AdapterError):
    """Raised for a drive without images or LiDAR returns, of which no scene can be built.

    drive: its data. ground: the road, if it is known from elsewhere.
    """

    def __init__(self, message: str, drive: RawDrive, ground: Ground | None) -> None:
        super().__init__(message)
        self.drive = drive
        self.ground = ground


def scene_of_drive(
    drive: RawDrive,
    options: DriveOptions,
    *,
    extra_background: Gaussians | None = None,
    ground: Ground | None = None,
) -> Scene:
    """Build the scene of a drive: accumulated returns, coloured by the images.

    Args:
        drive: the drive.
        options: options of the opening.
        extra_background: Gaussians of the background from elsewhere.
        ground: the road, if it is known from elsewhere.

    Raises:
        IncompleteDrive: there is no return or no image.
        AdapterError: no image shows a return.
    """
    # Labels are read without the kernels that scenes are built by.
    from adapters.lidar_scene.scene import build_lidar_scene

    drive = _check_frames_of_reference(drive)
    numbers = describe_frames([frame.index for frame in drive.used])
    held_out = " that are not held out" if drive.held_out else ""
    first = "".join(f"; {problem}" for problem in drive.problems[:_MAX_FAULTS])
    if not any(frame.image_paths for frame in drive.used):
        raise IncompleteDrive(
            f"{drive.source}: there is no usable image in {numbers}{held_out}; colours cannot be "
            f"had without them, choose more frames or unpack the images again{first}",
            drive,
            ground,
        )
    if not any(map(len, drive.sweeps)):
        raise IncompleteDrive(
            f"{drive.source}: there are no LiDAR returns in {numbers}; a scene cannot be built "
            f"without them, unpack the sweeps again{first}",
            drive,
            ground,
        )
    scene = build_lidar_scene(drive, options, added=extra_background, ground=ground)
    return with_recorded_frames(scene, drive.recorded_frames)


def _check_frames_of_reference(drive: RawDrive) -> RawDrive:
    """Return the drive without returns beyond any LiDAR's reach, and with sentences on wrong
    frames.
    """
    low = drive.path.min(axis=0)
    high = drive.path.max(axis=0)
    is_near = [
        ((sweep.points > low - _MAX_RANGE_M) & (sweep.points < high + _MAX_RANGE_M)).all(axis=1)
        for sweep in drive.sweeps
    ]
    sweeps = tuple(
        sweep if keep.all() else sweep.select(keep)
        for sweep, keep in zip(drive.sweeps, is_near, strict=True)
    )
    timed = [(int(np.median(s.timestamps_ns)), s.points) for s in sweeps if len(s)]
    problems = [*camera_problems(drive.frames), *lidar_problems(drive.frames, timed)]
    num_far = sum(int((~keep).sum()) for keep in is_near)
    if num_far:
        problems.append(
            f"{num_far} LiDAR returns lie further than {_MAX_RANGE_M:.0f} m from the car's path "
            f"and are left out; coordinates must be metres"
        )
    return replace(drive, sweeps=sweeps, problems=(*problems, *drive.problems))
