"""The files of a recording's folder by camera and frame number, none of them outside the folder.

    images/<camera>/<frame>.png|jpg   depth/<camera>/<frame>.png   lidar/<frame>.parquet
    labels/boxes.parquet              calibration.json

What a `generate` job wrote has labels/boxes/*.parquet and calibration/*.json in their place, each
of some frames and cameras; they are taken together. Frame numbers may have leading zeros or not. A
camera's folder is its name, or, for a name that is no safe folder name, what
`augment.output.layout.folder_name` makes of it.

Of calibration.json, the file that a render job writes, only `frames` is required, and in each frame
`frame`, `timestamp_ns`, `world_from_ego` and `cameras`; a camera's timestamp_ns is the frame's
where it has none. Further keys, all optional:

    ego_above_ground_m   height of the ego origin above the road, 0 by default
    ego_box_m            [[x, y, z], [x, y, z]], lowest and highest corner of the recording car in
                         ego axes: LiDAR returns in it are left out
    lidar_classes        the LiDAR's class numbers by name of SemanticClass: {"7": "road"}; "none"
                         for returns that no surface made

Errors are AdapterErrors that name the file, the frame and the camera.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import AfterValidator, BaseModel, Field

from adapters.plain_files import Number, read_json, validate_content
from adapters.raw_drive import NO_SURFACE, Picture, drive_origin, usable_images
from augment.errors import AdapterError, SceneError
from augment.files.lens_records import LensRecord, ShutterRecord
from augment.output.manifest import MAX_SIDE_PX
from augment.output.names import folder_name
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid
from augment.scene.semantics import SemanticClass

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
CALIBRATION = "calibration.json"
_HINT = "docs/datasets/recording.md shows what is in it"
_IF_MISSING = f"a recording needs it, {_HINT}"
_RIGID = 1e-4  # rotations written with six digits are off by a few millionths


def numbered_files(root: Path, folder: str, suffixes: Sequence[str]) -> dict[int, Path]:
    """Return the files of a folder that are named by a number, by that number.

    It is empty without the folder.
    """
    where = root / folder
    if not where.is_dir():
        return {}
    paths: dict[int, Path] = {}
    for path in sorted(where.iterdir()):
        if path.suffix.lower() not in suffixes or not re.fullmatch(r"[0-9]{1,18}", path.stem):
            continue
        number = int(path.stem)
        if number in paths:
            raise AdapterError(
                f"{paths[number]} and {path} are both of frame {number}; delete one of them"
            )
        paths[number] = resolve_inside(root, path)
    return paths


def block_files(root: Path, folder: str, suffix: str) -> list[Path]:
    """Return the files of a folder by blocks of frames, as a `generate` job writes them, in
    order.
    """
    return [resolve_inside(root, path) for path in sorted((root / folder).glob(f"*{suffix}"))]


def resolve_inside(root: Path, path: Path) -> Path:
    """Return the path; raise AdapterError where a link in it leads out of `root`.

    A folder from elsewhere must not make this machine read its other files."""
    real = path.resolve()
    real_root = root.resolve()
    if not real.is_relative_to(real_root):
        raise AdapterError(
            f"{path} leads through a link to {real}, outside {real_root}; put the files themselves "
            f"into the recording's folder"
        )
    return path


def find_images(root: Path, frames: Sequence[Frame]) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Return the frames with the paths of their usable images, and sentences on other images.

    These are missing, damaged, or of another size than the calibration's.
    """
    names = list(dict.fromkeys(name for frame in frames for name in frame.cameras))
    files = {n: numbered_files(root, f"images/{folder_name(n)}", IMAGE_SUFFIXES) for n in names}
    problems = [
        f"camera {name}: {root / 'images' / folder_name(name)} holds no image NNNNNN.png or .jpg"
        for name in names
        if not files[name]
    ]
    pictures = [
        Picture(name, frame.index, files[name].get(frame.index), (camera.width, camera.height))
        for name in names
        for frame in frames
        if files[name] and (camera := frame.cameras.get(name))
    ]
    images = usable_images(pictures, every_camera=False)
    frames_with_images = (
        dataclasses.replace(f, image_paths=images.paths.get(f.index, {})) for f in frames
    )
    return tuple(frames_with_images), (*problems, *images.problems)


def unlisted_images(root: Path, frames: Sequence[Frame]) -> tuple[str, ...]:
    """Return sentences on images that the calibration does not list.

    There is one for each folder of images that belongs to no camera of the calibration, and one for
    each camera with images of frames that are not listed for it.
    """
    if not (root / "images").is_dir():
        return ()
    names = dict.fromkeys(name for frame in frames for name in frame.cameras)
    folders = {folder_name(name): name for name in names}
    problems = []
    for folder in sorted(path for path in (root / "images").iterdir() if path.is_dir()):
        name = folders.get(folder.name)
        if name is None:
            problems.append(f"{folder} belongs to no camera of calibration.json; left out")
            continue
        listed = {frame.index for frame in frames if name in frame.cameras}
        more = sorted(set(numbered_files(root, f"images/{folder.name}", IMAGE_SUFFIXES)) - listed)
        if more:
            problems.append(
                f"camera {name}: {len(more)} images, such as of frame {more[0]}, have no entry in "
                f"calibration.json; left out"
            )
    return tuple(problems)


# ---- Calibration ---------------------------------------------------------------------------------

_Vector = tuple[Number, Number, Number]
_Row = tuple[Number, Number, Number, Number]
_Nanoseconds = Annotated[int, Field(strict=True, ge=-(2**62), le=2**62)]
_Pixels = Annotated[int, Field(strict=True, ge=1, le=MAX_SIDE_PX)]


def _rigid(rows: tuple[_Row, _Row, _Row, _Row]) -> torch.Tensor:
    """Return a rigid transform, float64 [4, 4]."""
    matrix = np.array(rows, np.float64)
    rotation = matrix[:3, :3].clip(-2, 2)  # larger entries are wrong anyway, and would overflow
    error = max(
        np.abs(rotation @ rotation.T - np.eye(3)).max(),
        np.abs(matrix[3] - np.array([0.0, 0, 0, 1])).max(),
    )
    if error > _RIGID or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"must be a rotation and a translation, last row 0 0 0 1, determinant +1; it is off by "
            f"{error:.3g}, determinant {np.linalg.det(rotation):.3g}"
        )
    return torch.from_numpy(matrix)


def _box(corners: tuple[_Vector, _Vector]) -> np.ndarray:
    box = np.array(corners)
    if not (box[0] < box[1]).all():
        raise ValueError("must be [[x, y, z], [x, y, z]], the lowest and the highest corner")
    return box


def _classes(names: Any) -> Mapping[int, int] | None:
    if names is None:
        return None
    meanings = {member.name.lower(): int(member) for member in SemanticClass}
    meanings["none"] = NO_SURFACE
    try:
        classes = {int(number): meanings[str(name).lower()] for number, name in names.items()}
        np.array([*classes], np.int64)
    except (AttributeError, ValueError, KeyError, OverflowError) as error:
        text = f"must map class numbers to {', '.join(meanings)} ({error!r:.80})"
        raise ValueError(text) from None
    return classes


# Numbers of a camera's entry that are the camera's own.
_CAMERA_NUMBERS = ("width", "height", "fx", "fy", "cx", "cy")

_Pose = Annotated[tuple[_Row, _Row, _Row, _Row], AfterValidator(_rigid)]


class _CameraEntry(BaseModel):
    """One camera in one frame of calibration.json. timestamp_ns: None for the frame's time.

    lens, shutter: None for a pinhole, and if all pixels are exposed at once.
    """

    width: _Pixels
    height: _Pixels
    fx: Number
    fy: Number
    cx: Number
    cy: Number
    world_from_camera: _Pose
    timestamp_ns: _Nanoseconds | None = None
    lens: LensRecord | None = None
    shutter: ShutterRecord | None = None


class _FrameEntry(BaseModel):
    frame: Annotated[_Nanoseconds, Field(ge=0)]
    timestamp_ns: _Nanoseconds
    world_from_ego: _Pose
    cameras: dict[str, Any]


class _Settings(BaseModel):
    """All of a calibration except the frames."""

    frames: Annotated[list[Any], Field(min_length=1)]
    has_metric_scale: Any = True
    ego_above_ground_m: Number = 0.0
    ego_box_m: Annotated[tuple[_Vector, _Vector], AfterValidator(_box)] | None = None
    lidar_classes: Annotated[Any, AfterValidator(_classes)] = None


@dataclass(frozen=True, eq=False)
class Calibration:
    """A recording's cameras over time, in the scene's world: the file's minus world_origin_m.

    Attributes:
        frames: in order of number and time, without image paths.
        lidar_classes: SemanticClass, or NO_SURFACE, by the LiDAR's own number. None if the numbers
            are those of SemanticClass.
        ego_box_m: float64 [2, 3], or None.
    """

    name: str
    frames: tuple[Frame, ...]
    world_origin_m: np.ndarray
    has_metric_scale: bool
    ego_above_ground_m: float
    ego_box_m: np.ndarray | None
    lidar_classes: Mapping[int, int] | None


def read_calibration(root: Path) -> Calibration:
    """Read the calibration of the recording in a folder."""
    path, content = _content(root)
    settings = validate_content(_Settings, content, str(path), hint=_HINT)
    frames = sorted((_frame(path, entry) for entry in settings.frames), key=lambda f: f.index)
    for before, after in itertools.pairwise(frames):
        if after.index == before.index:
            raise AdapterError(f"{path} lists frame {after.index} twice")
        if after.timestamp_ns <= before.timestamp_ns:
            raise AdapterError(
                f"{path}: timestamp_ns must increase with the frame's number; frame "
                f"{before.index} has {before.timestamp_ns}, frame {after.index} "
                f"{after.timestamp_ns}"
            )
    origin = drive_origin(np.stack([f.world_from_ego[:3, 3].numpy() for f in frames]))
    return Calibration(
        name=_name(content, root),
        frames=tuple(_recentred(frame, origin) for frame in frames),
        world_origin_m=origin,
        has_metric_scale=settings.has_metric_scale is not False,
        ego_above_ground_m=settings.ego_above_ground_m,
        ego_box_m=settings.ego_box_m,
        lidar_classes=settings.lidar_classes,
    )


def read_lidar_classes(root: Path) -> Mapping[int, int] | None:
    """Read the calibration's lidar_classes alone."""
    path, content = _content(root)
    return validate_content(_Settings, content, str(path), hint=_HINT).lidar_classes


def _content(root: Path) -> tuple[Path, dict[str, Any]]:
    """Return the calibration's file, or the folder of a job's blocks, and its content."""
    path = root / CALIBRATION
    blocks = [] if path.exists() else block_files(root, "calibration", ".json")
    if not blocks:
        return path, read_json(path, if_missing=_IF_MISSING)
    parts = [read_json(block) for block in blocks]
    frames: dict[Any, dict[str, Any]] = {}
    for block, part in zip(blocks, parts, strict=True):
        entries = part.get("frames")
        for entry in entries if isinstance(entries, list) else [entries]:
            if not isinstance(entry, dict) or not isinstance(entry.get("cameras"), dict):
                raise AdapterError(f"{block}: each of 'frames' must be an object with cameras")
            number = entry.get("frame")
            earlier_entry = frames.get(number) if isinstance(number, int) else None
            if earlier_entry is None:
                frames[number if isinstance(number, int) else repr(number)] = entry
                continue
            if any(
                earlier_entry.get(key) != entry.get(key)
                for key in ("timestamp_ns", "world_from_ego")
            ):
                raise AdapterError(
                    f"{block}: frame {number} has another time or ego pose than in the files "
                    f"before it; the folder holds blocks of different recordings"
                )
            frames[number] = earlier_entry | {
                "cameras": earlier_entry["cameras"] | entry["cameras"]
            }
    return blocks[0].parent, parts[0] | {"frames": list(frames.values())}


def _frame(path: Path, content: Any) -> Frame:
    number = content.get("frame") if isinstance(content, dict) else None
    where = f"{path}, frame {number!r:.20}"
    entry = validate_content(_FrameEntry, content, where, hint=_HINT)
    cameras = {}
    for name, values in entry.cameras.items():
        camera_where = f"{where}, camera {name!r:.80}"
        camera = validate_content(_CameraEntry, values, camera_where, hint=_HINT)
        numbers = {key: getattr(camera, key) for key in _CAMERA_NUMBERS}
        pose = invert_rigid(camera.world_from_camera)
        time = entry.timestamp_ns if camera.timestamp_ns is None else camera.timestamp_ns
        try:
            lens = None if camera.lens is None else camera.lens.lens()
            shutter = None if camera.shutter is None else camera.shutter.shutter()
            cameras[name] = Camera(
                name,
                **numbers,
                camera_from_world=pose,
                timestamp_ns=time,
                lens=lens,
                shutter=shutter,
            )
        except ValueError as error:
            raise AdapterError(f"{camera_where}: {error}") from None
    try:
        return Frame(entry.frame, entry.timestamp_ns, entry.world_from_ego, cameras)
    except SceneError as error:
        raise AdapterError(f"{path}: {error}") from None


def _recentred(frame: Frame, origin: np.ndarray) -> Frame:
    world_from_ego = frame.world_from_ego.clone()
    world_from_ego[:3, 3] -= torch.from_numpy(origin)
    cameras = {}
    for name, camera in frame.cameras.items():
        camera_from_scene = camera.camera_from_world.clone()
        camera_from_scene[:3, 3] += camera_from_scene[:3, :3] @ torch.from_numpy(origin)
        cameras[name] = dataclasses.replace(camera, camera_from_world=camera_from_scene)
    return dataclasses.replace(frame, world_from_ego=world_from_ego, cameras=cameras)


def _name(content: Mapping[str, Any], root: Path) -> str:
    """Return the recording's name: a job's names of scene and variant, else the folder's name."""
    parts = [content.get("scene"), content.get("variant")]
    names = [part for part in parts if isinstance(part, str) and part]
    return "-".join(names) if names else root.resolve().name
