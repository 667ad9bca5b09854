"""Views grouped into the frames of a drive.

Which camera took an image is read from the images' names, in the first of these ways that fits
all of them (extension and folders common to all names aside):

    front/000012.jpg            one folder a camera, the file name is the frame
    000012/front.jpg            one folder a frame, the file name is the camera
    000012_front, 000012_0      a frame number, then the camera
    front_000012                a camera, then the frame number

The last two count only if at least half of the frames then have two cameras or more: numbers in
names are common, and a single camera's images are one frame each. Without times, the cameras of a
frame fire at one moment, and frames are FRAME_INTERVAL_S apart.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
import torch

from adapters.cameras.posed_views import PosedView
from adapters.world import WorldChange
from augment.cameras import Camera, Frame
from augment.errors import AdapterError

FRAME_INTERVAL_S = 0.1
SINGLE_CAMERA = "camera"
_IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".exr"}
_FRAME_THEN_CAMERA = re.compile(r"(\d+)[_-](\d{1,2}|\w*[A-Za-z]\w*)")
_CAMERA_THEN_FRAME = re.compile(r"(\w*[A-Za-z]\w*?)[_-]?(\d+)")
_MOST_CAMERAS = 32
_LARGEST_FRAME_NUMBER = 10**9  # beyond it the digits are a time or a hash


def frames_from_views(
    views: Sequence[PosedView], change: WorldChange, *, start_ns: int = 0
) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Frames in order of time (or of their names), and sentences on what could not be kept.

    change: from the views' world to the scene's. start_ns: what times in the views count from, and
    the time of the first frame where they have none. world_from_ego stands at the front camera,
    level, x along its optical axis.

    Raises:
        AdapterError: a camera's numbers cannot be used.
    """
    keys, problems = _keys_of_views(views)
    order = sorted(set(frame for _, frame in keys), key=_natural)
    numbers = _frame_numbers(order)
    frames = []
    for rank, key in enumerate(order):
        members = [(k[0], v) for k, v in zip(keys, views, strict=True) if k[1] == key]
        members.sort(key=lambda member: _natural(member[0]))
        default_ns = start_ns + round(rank * FRAME_INTERVAL_S * 1e9)
        times = {
            name: default_ns if view.timestamp_ns is None else start_ns + view.timestamp_ns
            for name, view in members
        }
        cameras = {name: _camera(name, view, change, times[name]) for name, view in members}
        frames.append(
            Frame(
                index=numbers[rank],
                timestamp_ns=min(camera.timestamp_ns for camera in cameras.values()),
                world_from_ego=ego_from_front_camera(cameras),
                cameras=cameras,
                image_paths={name: v.image_path for name, v in members if v.image_path},
            )
        )
    return tuple(frames), problems


def split_names(names: Sequence[str]) -> list[tuple[str, str]] | None:
    """Camera and frame of every image name by the module's rules; None where none of them fits
    (then every image is a frame of a single camera).
    """
    parts = [_parts(name) for name in names]
    while len({p[0] for p in parts}) == 1 and min(map(len, parts)) > 1:
        parts = [p[1:] for p in parts]
    if all(len(p) > 1 for p in parts):
        pairs = [("_".join(p[:-1]), p[-1]) for p in parts]
        if all(folder.isdigit() and not stem.isdigit() for folder, stem in pairs):
            pairs = [(stem, folder) for folder, stem in pairs]
        return pairs
    if any(len(p) > 1 for p in parts):
        return None
    stems = [p[0] for p in parts]
    for pattern, camera, frame in ((_FRAME_THEN_CAMERA, 2, 1), (_CAMERA_THEN_FRAME, 1, 2)):
        matches = [pattern.fullmatch(stem) for stem in stems]
        pairs = [(m[camera], m[frame]) for m in matches if m]
        if len(pairs) == len(stems) and _is_rig(pairs):
            return pairs
    return None


def _is_rig(pairs: Sequence[tuple[str, str]]) -> bool:
    """Whether at least half of the frames have two cameras or more, of not too many in all."""
    per_frame = Counter(frame for _, frame in pairs)
    shared = sum(count > 1 for count in per_frame.values())
    return 2 * shared >= len(per_frame) and len({c for c, _ in pairs}) <= _MOST_CAMERAS


def ego_from_front_camera(cameras: dict[str, Camera]) -> torch.Tensor:
    """world_from_ego of a level vehicle at the front camera: the one named so, else the first."""
    named = [name for name in cameras if "front" in name.lower()]
    front = min(named, key=len) if named else next(iter(cameras))
    world_from_camera = cameras[front].world_from_camera
    heading = world_from_camera[:2, 2]
    if heading.norm() < 1e-6:  # straight up or down: the top of the image is ahead
        heading = -world_from_camera[:2, 1]
    x, y = (heading / heading.norm()).tolist()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, :2] = torch.tensor([[x, -y], [y, x]], dtype=torch.float64)
    pose[:3, 3] = world_from_camera[:3, 3]
    return pose


def _keys_of_views(views: Sequence[PosedView]) -> tuple[list[tuple[str, str]], tuple[str, ...]]:
    keys = [(v.camera, str(v.frame)) for v in views if v.camera is not None]
    if len(keys) < len(views):
        names = [v.name for v in views]
        keys = split_names(names) or [(SINGLE_CAMERA, "/".join(_parts(name))) for name in names]
    if len(set(keys)) == len(keys):
        return keys, ()
    (camera, frame), count = Counter(keys).most_common(1)[0]
    problem = (
        f"{count} views are named camera {camera!r}, frame {frame!r}, so cameras and frames cannot "
        "be told apart by name: every view is a frame of one camera, in the file's order"
    )
    width = len(str(len(views)))
    return [(SINGLE_CAMERA, f"{number:0{width}d}") for number in range(len(views))], (problem,)


def _parts(name: str) -> tuple[str, ...]:
    """Folders and stem; only extensions of images are taken off, a stem may hold dots."""
    path = PurePosixPath(name.replace("\\", "/"))
    stem = path.stem if path.suffix.lower() in _IMAGE_SUFFIXES else path.name
    return (*(part for part in path.parts[:-1] if part not in (".", "..", "/")), stem)


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Sort key in which digits count as numbers: 2 before 10."""
    pieces = re.findall(r"\d+|\D+", text)
    return [(0, int(p), p) if p.isdecimal() and len(p) < 100 else (1, 0, p) for p in pieces]


def _frame_numbers(order: Sequence[str]) -> list[int]:
    """The dataset's own frame numbers where the names end in distinct, growing ones."""
    found = [re.search(r"(\d{1,10})$", key) for key in order]
    numbers = [int(match[1]) for match in found if match]
    growing = all(a < b for a, b in itertools.pairwise(numbers))
    if len(numbers) == len(order) and growing and max(numbers) < _LARGEST_FRAME_NUMBER:
        return numbers
    return list(range(len(order)))


def _camera(name: str, view: PosedView, change: WorldChange, timestamp_ns: int) -> Camera:
    pose = change.pose(view.world_from_camera)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = pose[:3, :3].T
    camera_from_world[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    try:
        return Camera(
            name=name,
            width=view.width,
            height=view.height,
            fx=view.fx,
            fy=view.fy,
            cx=view.cx,
            cy=view.cy,
            camera_from_world=torch.from_numpy(camera_from_world),
            timestamp_ns=timestamp_ns,
        )
    except ValueError as error:
        raise AdapterError(f"image {view.name!r}: {error}") from error
