"""The record of KITTI: raw drives and the object benchmark."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from adapters.dataset import Dataset, FolderLayout, OpenLabels, Signature, SourceTree

_SWEEP = r"velodyne_points/data/\d+\.(bin|txt)"
_IMAGE = r"image_\d\d/data/\d+\.(?i:png|jpg)"
_CALIBRATION = "calib_*.txt"


def _is_kitti(folder: Path) -> bool:
    raw = (folder / "velodyne_points").is_dir() and any(
        (place / "calib_cam_to_cam.txt").is_file() for place in (folder, folder.absolute().parent)
    )
    return raw or any(
        (place / "calib").is_dir() and (place / "image_2").is_dir()
        for place in (folder, folder / "training")
    )


def _source_tree(folder: Path, _query: dict[str, str]) -> SourceTree:
    """Return the files of a drive with the calibration beside it, in the folder of its date, or
    the folder itself.
    """
    from adapters.kitti.files import VELODYNE, kitti_root

    if not (folder / VELODYNE).is_dir():
        within = r"((training|testing)/)?"
        images = rf"{within}image_\d/\d+\.(?i:png|jpg)"
        return SourceTree(folder, images, rf"{within}velodyne/\d+\.bin")
    _, calibrated = kitti_root(folder)
    if calibrated == folder:
        return SourceTree(folder, _IMAGE, _SWEEP)
    calibration = (path.name for path in calibrated.glob(_CALIBRATION))
    entries = (folder.name, *calibration)
    return SourceTree(calibrated, rf"[^/]+/{_IMAGE}", rf"[^/]+/{_SWEEP}", entries)


def _scene_files(path: str, _query: dict[str, str], _open_labels: OpenLabels) -> Iterator[Path]:
    from adapters.kitti.files import kitti_root

    yield Path(path)
    yield from sorted(kitti_root(path)[1].glob(_CALIBRATION))


KITTI = Dataset(
    scheme="kitti",
    description="a KITTI raw drive, or KITTI's object benchmark",
    page="kitti.md",
    example="kitti:data/kitti/2011_09_26/2011_09_26_drive_0001_sync",
    opener="adapters.kitti.adapter:open_kitti",
    labels="adapters.kitti.adapter:kitti_labels",
    is_raw=True,
    folder=Signature(
        _is_kitti,
        "a KITTI drive (velodyne_points/, calib_cam_to_cam.txt in it or above) or object folder "
        "(calib/ and image_2/)",
    ),
    layouts=(
        FolderLayout(
            "a KITTI drive",
            {
                "image_02/": ("image_0?",),
                "velodyne_points/": ("velodyne_points",),
                "calib_cam_to_cam.txt": ("calib_cam_to_cam.txt", "../calib_cam_to_cam.txt"),
            },
        ),
        FolderLayout(
            "a KITTI object folder",
            {
                "image_2/": ("image_2", "training/image_2"),
                "velodyne/": ("velodyne", "training/velodyne"),
                "calib/": ("calib", "training/calib"),
            },
        ),
    ),
    source_tree=_source_tree,
    scene_files=_scene_files,
)
