"""Detect the kind of scene that a path holds, from names in folders and the first bytes of files.

`detect_scheme` returns the scheme, `describe_unrecognised` explains a failure, `source_tree` finds
the dataset behind a scene. The callers are `adapters.base` and `tools`.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from adapters.uri import CAMERA_PATH_KEY, GROUND_KEY, WAYMO_REQUIRED, WAYMO_SPLITS, parse_uri
from augment.errors import AdapterError
from augment.files.formats import splat_names, splat_suffixes
from augment.files.ply import PLY
from augment.files.scene_file import is_scene_file, is_scene_folder
from augment.files.sog import META, is_sog_folder
from augment.files.streamed_sog import LOD_META
from augment.jobs.mirror import DatasetFolder
from augment.scene.scene import Scene
from recipes.files import open_file

# ---- Which folder and files make up the dataset behind a scene, for copies in other weather ------

_KITTI_SWEEP = r"velodyne_points/data/\d+\.bin"
_KITTI_CAMERA = r"image_\d\d/data/\d+\.(?i:png|jpg)"


def source_tree(scene: Scene) -> DatasetFolder:
    """Return the dataset from which the scene was made: the opened one, or the one that recorded
    it.
    """
    uri = scene.recorded_source or scene.source
    for part in (scene.source, uri):
        if CAMERA_PATH_KEY in parse_uri(part)[2]:
            raise AdapterError(
                f"{part} shows the frames of a camera path; a dataset's copy takes images of its "
                f"own frames, leave {CAMERA_PATH_KEY} out"
            )
    scheme, path, query = parse_uri(uri)
    query.pop(GROUND_KEY, None)
    find = _TREES.get(scheme or "")
    if find is None:
        raise AdapterError(
            f"{uri} has no dataset's folder that could be copied with weathered images; "
            f"{', '.join(_TREES)} scenes have one, and scenes fitted to them"
        )
    if not Path(path).exists():
        raise AdapterError(
            f"{path}, which the scene was made from, is not there; where it has moved, say so in "
            f"the scene's URI (data=URI)"
        )
    tree = find(Path(os.path.abspath(path)), query)
    entries = None if tree.entries is None else tuple(sorted(tree.entries))
    return DatasetFolder(uri, tree.root, tree.images, entries, tree.sweeps)


_NONE = r"(?!)"  # matches nothing


class _Found(NamedTuple):
    """Folders of a dataset, as in DatasetFolder."""

    root: Path
    images: str
    sweeps: str = _NONE
    entries: Iterable[str] | None = None


def _kitti(folder: Path, _query: dict[str, str]) -> _Found:
    """Return the files of a drive with the calibration beside it, in the folder of its date, or
    the folder itself.
    """
    from adapters.kitti.files import VELODYNE, kitti_root

    if not (folder / VELODYNE).is_dir():
        within = r"((training|testing)/)?"
        images = rf"{within}image_\d/\d+\.(?i:png|jpg)"
        return _Found(folder, images, rf"{within}velodyne/\d+\.bin")
    _, calibrated = kitti_root(folder)
    if calibrated == folder:
        return _Found(folder, _KITTI_CAMERA, _KITTI_SWEEP)
    calibration = (path.name for path in calibrated.glob("calib_*.txt"))
    images = rf"[^/]+/{_KITTI_CAMERA}"
    sweeps = rf"[^/]+/{_KITTI_SWEEP}"
    return _Found(calibrated, images, sweeps, (folder.name, *calibration))


def _drivestudio(path: Path, query: dict[str, str]) -> _Found:
    """Return the processed data on which a run was trained."""
    from adapters.drivestudio.drive import RunOptions, find_run

    data = find_run(path, RunOptions.from_query("drivestudio", query)).data
    return _Found(Path(os.path.abspath(data)), r"images/\d+_\d+\.jpg", r"lidar/\d+\.bin")


def _fixed(images: str, sweeps: str = _NONE) -> Callable[[Path, dict[str, str]], _Found]:
    return lambda folder, _query: _Found(folder, images, sweeps)


_TREES: dict[str, Callable[[Path, dict[str, str]], _Found]] = {
    "pandaset": _fixed(r"camera/[^/]+/\d+\.jpg", r"lidar/\d+\.pkl\.gz"),
    "nuscenes": _fixed(
        r"(samples|sweeps)/CAM_[^/]+/[^/]+\.jpg", r"(samples|sweeps)/LIDAR_TOP/[^/]+\.pcd\.bin"
    ),
    "kitti": _kitti,
    "av2": _fixed(r"sensors/cameras/[^/]+/\d+\.jpg", r"sensors/lidar/\d+\.feather"),
    "street_gaussians": _fixed(r"images/[^/]+\.(png|jpg)"),
    "drivestudio": _drivestudio,
    "recording": _fixed(r"images/[^/]+/\d+\.(?i:png|jpe?g)", r"lidar/\d+\.parquet"),
}


# ---- Signatures ----------------------------------------------------------------------------------

_MAX_ENTRIES = 1000  # of a folder that are looked at below the one given
_MAX_LISTED = 1_000_000  # names of a folder: some tenths of a second
_MULTI_PART = b"element vertex_"  # how a Street Gaussians .ply names its parts


@dataclass(frozen=True)
class Signature:
    """Signs of one kind of scene. kind_words: the kind in words, for messages."""

    scheme: str
    is_here: Callable[[Path], bool]
    kind_words: str


def detect_scheme(path: Path) -> str | None:
    """Return the scheme of a path's contents, or None if they are not known."""
    signatures = FILES if path.is_file() else FOLDERS
    try:
        return next((s.scheme for s in signatures if s.is_here(path)), None)
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error}") from error


def describe_unrecognised(path: Path) -> str:
    """Return sentences on a path that is not recognised.

    They say what lies at the path or below it, what it lacks, and what was looked for.
    """
    signatures = FILES if path.is_file() else FOLDERS
    *most, last = (s.kind_words for s in signatures)
    text = f"{', '.join(most)}, or {last}"
    if path.is_file():
        return f"Looked for {text}"
    below = next(_scenes_below(path), None)
    if below is not None:
        return f"It holds scenes: give one, such as {below}. Looked for {text}"
    return f"{_advice(path)}. Looked for {text}"


# What makes a folder each of these: patterns below it, any of which does, in the words for them.
_RECORDING = "a recording"
_PARTS: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "a PandaSet sequence": (("camera/", ("camera",)), ("lidar/", ("lidar",))),
    "a nuScenes dataset": (
        ("v1.0-*/scene.json", ("v1.0-*/scene.json",)),
        ("samples/", ("samples",)),
    ),
    "a KITTI drive": (
        ("image_02/", ("image_0?",)),
        ("velodyne_points/", ("velodyne_points",)),
        ("calib_cam_to_cam.txt", ("calib_cam_to_cam.txt", "../calib_cam_to_cam.txt")),
    ),
    "a KITTI object folder": (
        ("image_2/", ("image_2", "training/image_2")),
        ("velodyne/", ("velodyne", "training/velodyne")),
        ("calib/", ("calib", "training/calib")),
    ),
    "a segment of the Waymo Open Dataset v2": tuple(
        (f"{name}/", (name, f"{name}.parquet", *(f"{split}/{name}" for split in WAYMO_SPLITS)))
        for name in WAYMO_REQUIRED
    ),
    "an Argoverse 2 log": (
        ("city_SE3_egovehicle.feather", ("city_SE3_egovehicle.feather",)),
        ("calibration/intrinsics.feather", ("calibration/intrinsics.feather",)),
        ("sensors/lidar/", ("sensors/lidar",)),
        ("sensors/cameras/", ("sensors/cameras",)),
    ),
    _RECORDING: (
        ("calibration.json", ("calibration.json", "calibration/*.json")),
        ("images/<camera>/000000.jpg", ("images/*/*[0-9].jpg", "images/*/*[0-9].png")),
    ),
}
_IMAGES = (".jpg", ".jpeg", ".png")  # suffixes of images
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv")  # suffixes of videos
_MAX_SEEN = 20_000  # files of an unknown folder that are counted
_MOST_KINDS = 6  # that are named


def _advice(folder: Path) -> str:
    """Return what an unknown folder holds, which kind it nearly is, and how to make it a
    recording.
    """
    from adapters.camera_files.camera_files import find_colmap_model

    places: dict[str, Counter[str]] = {}
    walk = ((place, name) for place, _, names in os.walk(folder) for name in sorted(names))
    for place, name in itertools.islice(walk, _MAX_SEEN):
        kind = os.path.splitext(name)[1].lower() or name
        places.setdefault(kind, Counter())[os.path.relpath(place, folder)] += 1
    kinds = sorted(places.items(), key=lambda kind: (-kind[1].total(), kind[0]))
    counts = [
        f"{where.total()} {kind} ({where.most_common(1)[0][0]}/"
        f"{' and others' if len(where) > 1 else ''})".replace(" (./)", "")
        for kind, where in kinds[:_MOST_KINDS]
    ]
    more = f" and {len(kinds) - _MOST_KINDS} more kinds" if len(kinds) > _MOST_KINDS else ""
    said = [f"It holds {', '.join(counts) or 'no files'}{more}"]
    for dataset_name, parts in _PARTS.items():
        existing_parts = [n for n, patterns in parts if any(any(folder.glob(p)) for p in patterns)]
        missing = [name for name, _ in parts if name not in existing_parts]
        # Of many parts, one alone is anybody's name.
        if missing and len(existing_parts) > len(parts) // 5:
            is_are = "is" if len(existing_parts) == 1 else "are"
            said.append(
                f"It is nearly {dataset_name}: {', '.join(existing_parts)} {is_are} there, "
                f"{', '.join(missing)} not"
            )
    guide = "docs/datasets/own-drive.md"
    if (model := find_colmap_model(folder)) is not None:
        said.append(
            f"It holds a COLMAP model: `climategs record {model} --images FOLDER --out RECORDING "
            f"--fps N --camera-height METRES` makes a recording of it"
        )
    elif any(kind in places for kind in _IMAGES):
        said.append(
            f"Its images make a recording with their poses: images/<camera>/000000.jpg and "
            f"calibration.json (docs/datasets/recording.md); COLMAP finds poses ({guide})"
        )
    elif any(kind in places for kind in _VIDEOS):
        said.append(f"Of a video's frames COLMAP and `climategs record` make a recording ({guide})")
    return ". ".join(said)


def _scenes_below(folder: Path) -> Iterator[Path]:
    for level in ("*", "*/*"):
        for entry in sorted(itertools.islice(folder.glob(level), _MAX_ENTRIES)):
            with contextlib.suppress(OSError, AdapterError):  # another user's
                if entry.is_dir() and detect_scheme(entry) is not None:
                    yield entry


def _is_nuscenes(folder: Path) -> bool:
    versions = (name for name in _names(folder) if name.startswith("v1.0-"))
    if any((folder / name / "scene.json").is_file() for name in versions):
        return True
    from adapters.nuscenes.tables import table_folders  # under any other name

    return (folder / "samples").is_dir() and bool(table_folders(folder))


def _is_kitti(folder: Path) -> bool:
    raw = (folder / "velodyne_points").is_dir() and any(
        (place / "calib_cam_to_cam.txt").is_file() for place in (folder, folder.absolute().parent)
    )
    return raw or any(
        (place / "calib").is_dir() and (place / "image_2").is_dir()
        for place in (folder, folder / "training")
    )


def _is_waymo(folder: Path) -> bool:
    splits = (folder, *(folder / name for name in WAYMO_SPLITS))
    poses = "vehicle_pose"
    return (folder / f"{poses}.parquet").is_file() or any(
        (split / poses).is_dir() and any((split / poses).glob("*.parquet")) for split in splits
    )


def _is_street_gaussians(folder: Path) -> bool:
    is_data = all((folder / name).is_dir() for name in ("ego_pose", "extrinsics", "track"))
    if is_data or any(folder.glob("trained_model/iteration_*.pth")):
        return True
    return any(map(_is_multi_part, folder.glob("point_cloud/iteration_*/point_cloud.ply")))


def _is_recording(folder: Path) -> bool:
    is_calibrated = (folder / "calibration.json").is_file() or any(
        folder.glob("calibration/*.json")
    )
    return is_calibrated and (folder / "images").is_dir()


def _holds_splats(folder: Path) -> bool:
    if any(folder.glob("point_cloud/iteration_*/point_cloud.ply")):
        return True
    if (folder / LOD_META).is_file() or is_sog_folder(folder):
        return True
    return any(name.lower().endswith(splat_suffixes()) for name in _names(folder))


def _is_splat_file(path: Path) -> bool:
    if path.name == LOD_META or (path.name == META and is_sog_folder(path.parent)):
        return True
    suffix = path.suffix.lower()
    is_named = suffix in splat_suffixes() and suffix not in PLY.suffixes
    return is_named or _start_of(path).startswith(PLY.first_bytes)


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
    Signature(
        "pandaset",
        lambda folder: (folder / "camera").is_dir() and (folder / "lidar").is_dir(),
        "a PandaSet sequence (camera/ and lidar/)",
    ),
    Signature("nuscenes", _is_nuscenes, "a nuScenes dataset (v1.0-*/scene.json)"),
    Signature("waymo", _is_waymo, "Waymo Open Dataset v2 tables (vehicle_pose/, of Parquet files)"),
    Signature(
        "street_gaussians",
        _is_street_gaussians,
        "a Street Gaussians model (trained_model/iteration_N.pth) or its dataset (ego_pose/, "
        "extrinsics/, track/)",
    ),
    Signature(
        "drivestudio",
        lambda folder: (folder / "config.yaml").is_file() and any(folder.glob("checkpoint_*.pth")),
        "a drivestudio run (config.yaml, checkpoint_*.pth)",
    ),
    Signature(
        "kitti",
        _is_kitti,
        "a KITTI drive (velodyne_points/, calib_cam_to_cam.txt in it or above) or object folder "
        "(calib/ and image_2/)",
    ),
    Signature(
        "av2",
        lambda folder: (folder / "city_SE3_egovehicle.feather").is_file(),
        "a log of Argoverse 2 (city_SE3_egovehicle.feather)",
    ),
    Signature("recording", _is_recording, "a recording (calibration.json and images/)"),
    Signature(
        "gaussians",
        _holds_splats,
        f"a trained 3DGS model (point_cloud/iteration_N/point_cloud.ply), {splat_names()} files, a "
        f"{LOD_META}, or {META} and images of SOG, in it",
    ),
)
FILES = (
    Signature("scene", is_scene_file, "a scene file (.climategs)"),
    Signature(
        "street_gaussians",
        lambda path: _is_multi_part(path) or bool(re.fullmatch(r"iteration_\d+\.pth", path.name)),
        "iteration_N.pth of Street Gaussians",
    ),
    Signature(
        "drivestudio",
        lambda path: re.fullmatch(r"checkpoint_\w+\.pth", path.name) is not None,
        "checkpoint_*.pth of drivestudio",
    ),
    Signature("gaussians", _is_splat_file, f"a {splat_names()} file or a {LOD_META}"),
)
