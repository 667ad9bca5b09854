"""Where a KITTI folder keeps its files.

    raw     <drive>/image_0X/data/NNNNNNNNNN.png      timestamps.txt beside data/
            <drive>/velodyne_points/data/NNNNNNNNNN.bin
            <drive>/oxts/data/NNNNNNNNNN.txt          <drive>/tracklet_labels.xml
            calib_*.txt in the drive's folder or the one above (the day's)
    object  calib/NNNNNN.txt  image_2/NNNNNN.png  velodyne/NNNNNN.bin  label_2/NNNNNN.txt

Images may be .jpg too. A frame's number is that of its files.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from adapters.plain_files import inside
from augment.errors import AdapterError

CAM_TO_CAM = "calib_cam_to_cam.txt"
VELO_TO_CAM = "calib_velo_to_cam.txt"
IMU_TO_VELO = "calib_imu_to_velo.txt"
VELODYNE = "velodyne_points"
COLOUR_CAMERAS, GREY_CAMERAS = ("image_02", "image_03"), ("image_00", "image_01")
OBJECT_CAMERAS = ("image_2", "image_3")
IMAGE_SUFFIXES = (".jpg", ".png")  # the later wins where a frame has both
RAW_DIGITS, OBJECT_DIGITS = 10, 6
_MOST_NAMED = 3


def kitti_root(path: str | Path) -> tuple[Path, Path]:
    """The folder of the drive, and the folder of its calibration.

    path: a raw drive, whose calibration lies in it or above; or a folder of the object benchmark,
    or the one that holds its training/, whose calibration is its calib/.

    Raises:
        AdapterError: neither; says what was looked for.
    """
    root = Path(path)
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a KITTI drive or object folder")
    if (root / VELODYNE).is_dir():
        for place in (root, root.absolute().parent):
            if (place / CAM_TO_CAM).is_file():
                return root, place
        raise AdapterError(
            f"{root} holds {VELODYNE}/ but there is no {CAM_TO_CAM} in it or in "
            f"{root.absolute().parent}; unpack the day's calibration there (KITTI's "
            f"<date>_calib.zip)"
        )
    for place in (root, root / "training"):
        if is_object_folder(place):
            return place, place / "calib"
    drives = sorted(p.parent for p in root.glob(f"*/{VELODYNE}"))
    if drives:
        raise AdapterError(f"{root} holds drives, it is none itself; give one: {_few(drives)}")
    above = next((p for p in root.absolute().parents[:2] if _is_kitti(p)), None)
    raise AdapterError(
        f"{root} is no KITTI folder: expected {VELODYNE}/ (a raw drive), or calib/ beside "
        f"velodyne/ or image_2/ (the object benchmark)"
        + (f"; {above}, above it, is one" if above else "")
    )


def is_object_folder(root: Path) -> bool:
    """Whether a folder is one of the object benchmark."""
    data = (root / "velodyne", root / "image_2")
    return (root / "calib").is_dir() and any(folder.is_dir() for folder in data)


def _is_kitti(root: Path) -> bool:
    return (root / VELODYNE).is_dir() or is_object_folder(root)


def _few(drives: Sequence[Path]) -> str:
    rest = len(drives) - _MOST_NAMED
    named = ", ".join(map(str, drives[:_MOST_NAMED]))
    return named + (f" and {rest} more" if rest > 0 else "")


def numbered(root: Path, folder: str, suffixes: Sequence[str], digits: int) -> dict[int, str]:
    """The files of a folder that are named by so many digits, relative to the root, by number."""
    where = root / folder
    if not where.is_dir():
        return {}
    found: dict[int, str] = {}
    for name in sorted(entry.name for entry in where.iterdir()):
        stem, dot, ending = name.partition(".")
        if re.fullmatch(rf"[0-9]{{{digits}}}", stem) and dot + ending.lower() in suffixes:
            found[int(stem)] = f"{folder}/{name}"
    return found


def file_in(root: Path, name: str) -> Path:
    """A file of the folder, there or not.

    Raises:
        AdapterError: it is a link that leads out of the folder.
    """
    return inside(root, name, str(root))


def some(numbers: Sequence[int]) -> str:
    """How many frames and the first of them, for messages."""
    named = ", ".join(map(str, numbers[:_MOST_NAMED]))
    more = ", ..." if len(numbers) > _MOST_NAMED else ""
    return f"{len(numbers)} frame{'' if len(numbers) == 1 else 's'} ({named}{more})"
