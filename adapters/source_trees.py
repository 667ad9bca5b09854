"""Which folder and files make up the dataset behind a scene, for copies of it in other weather."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from adapters.uri import CAMERA_PATH_KEY, GROUND_KEY, parse_uri
from augment.batch.mirror_tree import SourceTree
from augment.errors import AdapterError
from augment.scene import Scene

_KITTI_SWEEP = r"velodyne_points/data/\d+\.bin"
_KITTI_CAMERA = r"image_\d\d/data/\d+\.(?i:png|jpg)"


def source_tree(scene: Scene) -> SourceTree:
    """The dataset that the scene was made from: the one it was opened from, or recorded in.

    Raises:
        AdapterError: the scene is of no dataset, has a camera path's frames, or the dataset is not
            where it was.
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
    found = find(Path(os.path.abspath(path)), query)
    entries = None if found.entries is None else tuple(sorted(found.entries))
    return SourceTree(uri, found.root, found.images, entries, found.sweeps)


class _Found(NamedTuple):
    """As of SourceTree."""

    root: Path
    images: str
    sweeps: str = r"(?!)"
    entries: Iterable[str] | None = None


def _pandaset(folder: Path, _query: dict[str, str]) -> _Found:
    return _Found(folder, r"camera/[^/]+/\d+\.jpg", r"lidar/\d+\.pkl\.gz")


def _nuscenes(folder: Path, _query: dict[str, str]) -> _Found:
    sweeps = r"(samples|sweeps)/LIDAR_TOP/[^/]+\.pcd\.bin"
    return _Found(folder, r"(samples|sweeps)/CAM_[^/]+/[^/]+\.jpg", sweeps)


def _kitti(folder: Path, _query: dict[str, str]) -> _Found:
    """A drive with the calibration beside it, in the folder of its date; or the folder itself."""
    from adapters.kitti.layout import VELODYNE, kitti_root

    if not (folder / VELODYNE).is_dir():
        within = r"((training|testing)/)?"
        images = rf"{within}image_\d/\d+\.(?i:png|jpg)"
        return _Found(folder, images, rf"{within}velodyne/\d+\.bin")
    _, calibrated = kitti_root(folder)
    if calibrated == folder:
        return _Found(folder, _KITTI_CAMERA, _KITTI_SWEEP)
    calibration = (path.name for path in calibrated.glob("calib_*.txt"))
    images, sweeps = rf"[^/]+/{_KITTI_CAMERA}", rf"[^/]+/{_KITTI_SWEEP}"
    return _Found(calibrated, images, sweeps, (folder.name, *calibration))


def _street_gaussians(folder: Path, _query: dict[str, str]) -> _Found:
    return _Found(folder, r"images/[^/]+\.(png|jpg)")


def _drivestudio(path: Path, query: dict[str, str]) -> _Found:
    """The processed data that a run was trained on."""
    from adapters.drivestudio.options import RunOptions
    from adapters.drivestudio.run import find_run

    data = find_run(path, RunOptions.from_query(query)).data
    return _Found(Path(os.path.abspath(data)), r"images/\d+_\d+\.jpg", r"lidar/\d+\.bin")


def _recording(folder: Path, _query: dict[str, str]) -> _Found:
    return _Found(folder, r"images/[^/]+/\d+\.(?i:png|jpe?g)", r"lidar/\d+\.parquet")


_TREES: dict[str, Callable[[Path, dict[str, str]], _Found]] = {
    "pandaset": _pandaset,
    "nuscenes": _nuscenes,
    "kitti": _kitti,
    "street_gaussians": _street_gaussians,
    "drivestudio": _drivestudio,
    "recording": _recording,
}
