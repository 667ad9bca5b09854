"""What a KITTI folder holds of the frames asked for, before images are decoded: calibration, poses,
times and labels of a raw drive, or of one frame of the object benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.kitti.calibration import (
    Calibration,
    read_object_calibration,
    read_raw_calibration,
    read_velodyne_from_imu,
)
from adapters.kitti.labels import LocatedSweeps, ObjectLabels, RawLabels, object_label_file
from adapters.kitti.layout import (
    COLOUR_CAMERAS,
    GREY_CAMERAS,
    IMAGE_SUFFIXES,
    OBJECT_CAMERAS,
    OBJECT_DIGITS,
    RAW_DIGITS,
    VELODYNE,
    is_object_folder,
    kitti_root,
    numbered,
    some,
)
from adapters.kitti.object_labels import read_object_lines
from adapters.kitti.options import ICP, KittiOptions
from adapters.kitti.poses import Poses, odometry_poses, oxts_poses, without_poses
from adapters.kitti.registration import registered_poses
from adapters.kitti.sweeps import read_returns
from adapters.kitti.times import frame_times, read_times
from adapters.kitti.tracklets import TRACKLETS, read_tracklets
from adapters.lidar.options import DriveFrames
from adapters.lidar.origin import drive_origin
from augment.errors import AdapterError


@dataclass(frozen=True, eq=False)
class Source:
    """chosen: the scene's frames, all with a pose. images: names of the files by camera and frame.
    image_times_ns: by camera and frame, where the camera has its own. labels: of all frames with
    poses, whose world_from_velodyne is in the dataset's world. world_origin_m: float64 [3].
    """

    root: Path
    name: str
    chosen: DriveFrames
    calibration: Calibration
    images: Mapping[str, Mapping[int, str]]
    image_times_ns: Mapping[str, Mapping[int, int]]
    labels: RawLabels | ObjectLabels
    world_origin_m: np.ndarray
    problems: tuple[str, ...]

    @property
    def sweeps(self) -> LocatedSweeps:
        return self.labels.sweeps


def find_source(path: str, query: dict[str, str]) -> tuple[Source, KittiOptions]:
    """What the URI names, and its options.

    Raises:
        AdapterError: a wrong option, no KITTI folder, wrong calibration, times, poses or tracklets.
    """
    root, calibration = kitti_root(path)
    if is_object_folder(root):
        options = KittiOptions.from_query(query, is_object=True)
        return _object_source(root, calibration, options), options
    options = KittiOptions.from_query(query, is_object=False)
    return _raw_source(root, calibration, options), options


def _raw_source(root: Path, calibration_folder: Path, options: KittiOptions) -> Source:
    sweeps = numbered(root, f"{VELODYNE}/data", (".bin",), RAW_DIGITS)
    images, problems = _raw_images(root)
    numbers = sorted(set(sweeps).union(*images.values()))
    if not sweeps:
        raise AdapterError(
            f"{root / VELODYNE / 'data'} holds no sweep NNNNNNNNNN.bin; a scene cannot be built "
            f"without them, unpack the drive again"
        )
    chosen = options.drive.select(numbers, where=f"kitti:{root}")
    calibration = read_raw_calibration(calibration_folder, tuple(images))
    image_times = {name: read_times(root, name) for name in images}
    known = read_times(root, VELODYNE) or next(filter(None, image_times.values()), {})
    times, said = frame_times(root, known, numbers)
    poses = _raw_poses(root, calibration_folder, calibration, options, numbers, chosen, sweeps)
    located = LocatedSweeps(root, sweeps, times, poses.world_from_velodyne)
    tracklets = read_tracklets(root)
    problems = (
        *problems,
        *chosen.problems,
        *said,
        *poses.problems,
        *without_poses(chosen.numbers, poses.world_from_velodyne),
        *(() if tracklets is not None else (f"{root} has no {TRACKLETS}: no boxes are known",)),
    )
    positions = [pose[:3, 3] for _, pose in sorted(poses.world_from_velodyne.items())]
    return Source(
        root,
        root.absolute().name,
        _with_poses(root, chosen, poses),
        calibration,
        images,
        image_times,
        RawLabels(located, tracklets or ()),
        drive_origin(np.stack(positions)),
        problems,
    )


def _raw_images(root: Path) -> tuple[dict[str, dict[int, str]], tuple[str, ...]]:
    """The files of the colour cameras, or else of the grey ones, by camera and frame."""
    for cameras in (COLOUR_CAMERAS, GREY_CAMERAS):
        found = {
            name: numbered(root, f"{name}/data", IMAGE_SUFFIXES, RAW_DIGITS) for name in cameras
        }
        images = {name: files for name, files in found.items() if files}
        if images:
            empty = [n for n in cameras if (root / n).is_dir() and n not in images]
            return images, tuple(f"camera {n}: {root / n / 'data'} holds no image" for n in empty)
    raise AdapterError(
        f"{root} holds no images: expected image_02/data/NNNNNNNNNN.png, or image_03/, or the grey "
        f"image_00/ or image_01/; colours cannot be had without them"
    )


def _raw_poses(
    root: Path,
    calibration_folder: Path,
    calibration: Calibration,
    options: KittiOptions,
    numbers: list[int],
    chosen: DriveFrames,
    sweeps: Mapping[int, str],
) -> Poses:
    if options.poses == ICP:
        return _registered(root, chosen, sweeps)
    if options.poses is not None:
        path = Path(options.poses).expanduser()
        return odometry_poses(path, numbers, calibration.rectified_from_velodyne)
    oxts = numbered(root, "oxts/data", (".txt",), RAW_DIGITS)
    if oxts:
        return oxts_poses(root, oxts, read_velodyne_from_imu(calibration_folder))
    if len(chosen.numbers) == 1:
        return Poses({chosen.numbers[0]: np.eye(4)})
    raise AdapterError(
        f"{root} has no poses (oxts/data/NNNNNNNNNN.txt) for {some(chosen.numbers)}. Copy the "
        f"drive's oxts/ there; or give ?poses=FILE, a line of 12 numbers a frame as of KITTI's "
        f"odometry; or ?poses=icp, which registers the sweeps; or one frame, "
        f"?frames={chosen.numbers[0]}:{chosen.numbers[0] + 1}, which needs none"
    )


def _registered(root: Path, chosen: DriveFrames, sweeps: Mapping[int, str]) -> Poses:
    problems: list[str] = []

    def read(number: int) -> np.ndarray | None:
        if number not in sweeps:
            return None
        try:
            return read_returns(root, sweeps[number])
        except AdapterError as error:
            problems.append(f"frame {number}: {error}")
            return None

    poses = registered_poses(chosen.numbers, read)
    return Poses(poses.world_from_velodyne, (*problems, *poses.problems))


def _with_poses(root: Path, chosen: DriveFrames, poses: Poses) -> DriveFrames:
    kept = DriveFrames(
        tuple(n for n in chosen.numbers if n in poses.world_from_velodyne), chosen.held_out
    )
    if kept.used:
        return kept
    raise AdapterError(
        f"{root}: no pose is known of any of {some(chosen.used)}"
        + "".join(f"; {problem}" for problem in poses.problems[:3])
    )


def _object_source(root: Path, calibration_folder: Path, options: KittiOptions) -> Source:
    sweeps = numbered(root, "velodyne", (".bin",), OBJECT_DIGITS)
    images = {n: numbered(root, n, IMAGE_SUFFIXES, OBJECT_DIGITS) for n in OBJECT_CAMERAS}
    number = _object_frame(root, options.frame, sorted(set(sweeps).union(*images.values())))
    digits = f"{number:0{OBJECT_DIGITS}d}"
    if number not in sweeps:
        raise AdapterError(
            f"{root / 'velodyne' / digits}.bin does not exist; frame {number} has no sweep to "
            f"build a scene from"
        )
    images = {name: {number: files[number]} for name, files in images.items() if number in files}
    if not images:
        raise AdapterError(
            f"{root / 'image_2' / digits}.png does not exist, nor in image_3/; colours cannot be "
            f"had without an image"
        )
    chosen = options.drive.select([number], where=f"kitti:{root}, frame {number}")
    calibration = read_object_calibration(calibration_folder, digits, tuple(images))
    sweep = LocatedSweeps(root, {number: sweeps[number]}, {number: 0}, {number: np.eye(4)})
    inverse = np.linalg.inv(calibration.rectified_from_velodyne)
    return Source(
        root,
        digits,
        chosen,
        calibration,
        images,
        {name: {} for name in images},
        ObjectLabels(sweep, number, inverse),
        np.zeros(3),
        (*chosen.problems, *_object_label_problems(root, number)),
    )


def _object_frame(root: Path, asked: int | None, numbers: list[int]) -> int:
    digits = [f"{n:0{OBJECT_DIGITS}d}" for n in numbers]
    examples = ", ".join(digits[:3]) + (", ..." if len(digits) > 3 else "")
    if not numbers:
        raise AdapterError(f"{root} holds neither velodyne/NNNNNN.bin nor image_2/NNNNNN.png")
    if asked is None and len(numbers) > 1:
        raise AdapterError(
            f"{root} holds {len(numbers)} unrelated frames ({examples}); a scene is one of them, "
            f"give ?frame={digits[0]}"
        )
    if asked is not None and asked not in numbers:
        raise AdapterError(
            f"{root} has no frame {asked:0{OBJECT_DIGITS}d}; it has {len(numbers)}: {examples}"
        )
    return numbers[0] if asked is None else asked


def _object_label_problems(root: Path, number: int) -> tuple[str, ...]:
    path = object_label_file(root, number)
    if not path.exists():
        return (f"{path} does not exist: no boxes are known",)
    ignored = read_object_lines(path).dont_care
    if not ignored:
        return ()
    return (f"{path}: {ignored} regions marked DontCare have no 3D box; boxes are without them",)
