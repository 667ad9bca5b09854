"""Which kind of scene a path holds, told by a few names in it; nothing is opened for it but the
first bytes of a file.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from augment.errors import AdapterError
from augment.files.scene_files import is_scene_file, is_scene_folder
from recipes.files import open_file

_MOST_ENTRIES = 1000  # of a folder that are looked at below the one given
_MAX_LISTED = 1_000_000  # names of a folder: some tenths of a second
_MULTI_PART = b"element vertex_"  # how a Street Gaussians .ply names its parts


@dataclass(frozen=True)
class Signature:
    """How one kind of scene looks. what: that in words, for messages."""

    scheme: str
    is_here: Callable[[Path], bool]
    what: str


def recognised(path: Path) -> str | None:
    """The scheme of what lies at a path; None for what is not known.

    Raises:
        AdapterError: it cannot be read.
    """
    signatures = FILES if path.is_file() else FOLDERS
    try:
        return next((s.scheme for s in signatures if s.is_here(path)), None)
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error}") from error


def looked_for(path: Path) -> str:
    """What was looked for at a path that is not recognised, and scenes that lie below it."""
    signatures = FILES if path.is_file() else FOLDERS
    *most, last = (s.what for s in signatures)
    text = f"{', '.join(most)}, or {last}"
    if path.is_file():
        return text
    below = next(_scenes_below(path), None)
    return text if below is None else f"{text}. It holds scenes: give one, such as {below}"


def _scenes_below(folder: Path) -> Iterator[Path]:
    for level in ("*", "*/*"):
        for entry in sorted(itertools.islice(folder.glob(level), _MOST_ENTRIES)):
            with contextlib.suppress(OSError, AdapterError):  # another user's
                if entry.is_dir() and recognised(entry) is not None:
                    yield entry


def _is_pandaset(folder: Path) -> bool:
    return (folder / "camera").is_dir() and (folder / "lidar").is_dir()


def _is_nuscenes(folder: Path) -> bool:
    versions = (name for name in _names(folder) if name.startswith("v1.0-"))
    return any((folder / name / "scene.json").is_file() for name in versions)


def _is_kitti(folder: Path) -> bool:
    raw = (folder / "velodyne_points").is_dir() and any(
        (place / "calib_cam_to_cam.txt").is_file() for place in (folder, folder.absolute().parent)
    )
    return raw or any(
        (place / "calib").is_dir() and (place / "image_2").is_dir()
        for place in (folder, folder / "training")
    )


def _is_street_gaussians(folder: Path) -> bool:
    is_data = all((folder / name).is_dir() for name in ("ego_pose", "extrinsics", "track"))
    if is_data or any(folder.glob("trained_model/iteration_*.pth")):
        return True
    return any(map(_is_multi_part, folder.glob("point_cloud/iteration_*/point_cloud.ply")))


def _is_drivestudio(folder: Path) -> bool:
    return (folder / "config.yaml").is_file() and any(folder.glob("checkpoint_*.pth"))


def _is_street_gaussians_file(path: Path) -> bool:
    return _is_multi_part(path) or re.fullmatch(r"iteration_\d+\.pth", path.name) is not None


def _is_drivestudio_file(path: Path) -> bool:
    return re.fullmatch(r"checkpoint_\w+\.pth", path.name) is not None


def _is_recording(folder: Path) -> bool:
    is_calibrated = (folder / "calibration.json").is_file() or any(
        folder.glob("calibration/*.json")
    )
    return is_calibrated and (folder / "images").is_dir()


def _holds_splats(folder: Path) -> bool:
    if any(folder.glob("point_cloud/iteration_*/point_cloud.ply")):
        return True
    return sum(name.lower().endswith((".ply", ".splat")) for name in _names(folder)) == 1


def _is_splat_file(path: Path) -> bool:
    return path.suffix.lower() == ".splat" or _start_of(path)[:4] in (b"ply\n", b"ply\r")


def _is_multi_part(path: Path) -> bool:
    start = _start_of(path)
    return start.startswith(b"ply") and _MULTI_PART in start


def _start_of(path: Path) -> bytes:
    with open_file(path) as file:
        return file.read(4096)


def _names(folder: Path) -> list[str]:
    with os.scandir(folder) as entries:
        return [entry.name for entry in itertools.islice(entries, _MAX_LISTED)]


# In this order: a later one may fit where an earlier one does.
FOLDERS = (
    Signature("scene", is_scene_folder, "a scene folder (scene.json)"),
    Signature("pandaset", _is_pandaset, "a PandaSet sequence (camera/ and lidar/)"),
    Signature("nuscenes", _is_nuscenes, "a nuScenes dataset (v1.0-*/scene.json)"),
    Signature(
        "street_gaussians",
        _is_street_gaussians,
        "a Street Gaussians model (trained_model/iteration_N.pth) or its dataset (ego_pose/, "
        "extrinsics/, track/)",
    ),
    Signature("drivestudio", _is_drivestudio, "a drivestudio run (config.yaml, checkpoint_*.pth)"),
    Signature(
        "kitti",
        _is_kitti,
        "a KITTI drive (velodyne_points/, calib_cam_to_cam.txt in it or above) or object folder "
        "(calib/ and image_2/)",
    ),
    Signature("recording", _is_recording, "a recording (calibration.json and images/)"),
    Signature(
        "gaussians",
        _holds_splats,
        "a trained 3DGS model (point_cloud/iteration_N/point_cloud.ply) or a single .ply or "
        ".splat file in it",
    ),
)
FILES = (
    Signature("scene", is_scene_file, "a scene file (.climategs)"),
    Signature("street_gaussians", _is_street_gaussians_file, "iteration_N.pth of Street Gaussians"),
    Signature("drivestudio", _is_drivestudio_file, "checkpoint_*.pth of drivestudio"),
    Signature("gaussians", _is_splat_file, "a .ply or .splat file"),
)
