"""Which folder and files make up the dataset behind a scene, for copies of it in other weather."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from adapters.uri import CAMERA_PATH_KEY, parse_uri
from augment.batch.mirror_tree import SourceTree
from augment.errors import AdapterError
from augment.scene import Scene

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
    scheme, path, _ = parse_uri(uri)
    find = _TREES.get(scheme or "")
    if find is None:
        raise AdapterError(
            f"{uri} has no dataset's folder that could be copied with weathered images; "
            f"{', '.join(_TREES)} scenes have one, and scenes fitted to them"
        )
    folder = Path(os.path.abspath(path))
    if not folder.is_dir():
        raise AdapterError(
            f"{folder}, which the scene was made from, is no folder; where it has moved, say so in "
            f"the scene's URI (data=URI)"
        )
    root, images, entries = find(folder)
    return SourceTree(uri, root, images, None if entries is None else tuple(sorted(entries)))


def _pandaset(folder: Path) -> tuple[Path, str, None]:
    return folder, r"camera/[^/]+/\d+\.jpg", None


def _nuscenes(folder: Path) -> tuple[Path, str, None]:
    return folder, r"(samples|sweeps)/CAM_[^/]+/[^/]+\.jpg", None


def _kitti(folder: Path) -> tuple[Path, str, Iterable[str] | None]:
    """A drive with the calibration beside it, in the folder of its date; or the folder itself."""
    from adapters.kitti.layout import VELODYNE, kitti_root

    if not (folder / VELODYNE).is_dir():
        return folder, r"((training|testing)/)?image_\d/\d+\.(?i:png|jpg)", None
    _, calibrated = kitti_root(folder)
    if calibrated == folder:
        return folder, _KITTI_CAMERA, None
    calibration = (path.name for path in calibrated.glob("calib_*.txt"))
    return calibrated, rf"[^/]+/{_KITTI_CAMERA}", (folder.name, *calibration)


def _street_gaussians(folder: Path) -> tuple[Path, str, None]:
    return folder, r"images/[^/]+\.(png|jpg)", None


def _recording(folder: Path) -> tuple[Path, str, None]:
    return folder, r"images/[^/]+/\d+\.(?i:png|jpe?g)", None


_TREES: dict[str, Callable[[Path], tuple[Path, str, Iterable[str] | None]]] = {
    "pandaset": _pandaset,
    "nuscenes": _nuscenes,
    "kitti": _kitti,
    "street_gaussians": _street_gaussians,
    "recording": _recording,
}
