"""The images of a drive in Street Gaussians' layout and their sizes, told by their first bytes."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from adapters.street_gaussians.calibration import Lens
from adapters.street_gaussians.records import CAMERA_NAMES
from augment.errors import AdapterError
from augment.image_header import read_image_header

_NAME = re.compile(r"([0-9]{1,9})_([0-9])\.(png|jpg|jpeg)", re.IGNORECASE)
_FULL_SIZE = (1920, 1280)  # of Waymo's front cameras, and of its side cameras:
_SIDE_SIZE = (1920, 886)


@dataclass(frozen=True, eq=False)
class Images:
    """paths: of usable images by frame and camera. sizes: width and height by camera. problems: one
    sentence each."""

    paths: Mapping[tuple[int, int], Path]
    sizes: Mapping[int, tuple[int, int]]
    problems: tuple[str, ...]


def find_images(root: Path, frames: range, lenses: Mapping[int, Lens]) -> Images:
    """The images of these frames and cameras. Where a camera has none, its size is Waymo's.

    Raises:
        AdapterError: two files of one image, or a principal point outside the images.
    """
    listed = _listed(root / "images")
    wanted = {key: p for key, p in listed.items() if key[0] in frames and key[1] in lenses}
    paths: dict[tuple[int, int], Path] = {}
    sizes: dict[int, tuple[int, int]] = {}
    problems: list[str] = []
    for cam, lens in lenses.items():
        seen = {key: _size(path) for key, path in sorted(wanted.items()) if key[1] == cam}
        counts = Counter(size for size in seen.values() if size is not None)
        sizes[cam] = counts.most_common(1)[0][0] if counts else _waymo_size(cam)
        for key, size in seen.items():
            if size == sizes[cam]:
                paths[key] = wanted[key]
            else:
                problems.append(_fault(wanted[key], size, sizes[cam], cam))
        _check_centre(lens, cam, sizes[cam], is_assumed=not counts)
    problems += _none(root, lenses, paths, sizes)
    return Images(paths, sizes, tuple(problems))


def _listed(folder: Path) -> dict[tuple[int, int], Path]:
    found: dict[tuple[int, int], Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = _NAME.fullmatch(path.name)
        if match is None:
            continue
        key = int(match[1]), int(match[2])
        if key in found:
            raise AdapterError(f"{found[key]} and {path} are one image; delete one of them")
        found[key] = path
    return found


def _size(path: Path) -> tuple[int, int] | None:
    """Width and height, or None for what is no image."""
    try:
        header = read_image_header(path)
    except OSError:
        return None
    return None if header is None else (header.width, header.height)


def _waymo_size(cam: int) -> tuple[int, int]:
    return _SIDE_SIZE if CAMERA_NAMES[cam].startswith("SIDE") else _FULL_SIZE


def _fault(path: Path, size: tuple[int, int] | None, expected: tuple[int, int], cam: int) -> str:
    if size is None:
        return f"{path} is no image, or a damaged one; left out"
    return (
        f"{path} is {size[0]}x{size[1]} pixels, most images of {CAMERA_NAMES[cam]} are "
        f"{expected[0]}x{expected[1]}; left out"
    )


def _check_centre(lens: Lens, cam: int, size: tuple[int, int], *, is_assumed: bool) -> None:
    width, height = size
    if 0 < lens.cx < width and 0 < lens.cy < height:
        return
    whose = "assumed for want of images" if is_assumed else "as its images are"
    raise AdapterError(
        f"{lens.path}: cx, cy (its third and fourth number) must lie in the {width}x{height} "
        f"pixels of {CAMERA_NAMES[cam]}, {whose}; got {lens.cx:g}, {lens.cy:g}. If the images were "
        f"resized, scale fx fy cx cy with them"
    )


def _none(
    root: Path,
    lenses: Mapping[int, Lens],
    paths: Mapping[tuple[int, int], Path],
    sizes: Mapping[int, tuple[int, int]],
) -> list[str]:
    """A sentence for the cameras without images."""
    bare = sorted(set(lenses) - {cam for _, cam in paths})
    if not bare:
        return []
    taken = ", ".join(f"{sizes[c][0]}x{sizes[c][1]} for {CAMERA_NAMES[c]}" for c in bare)
    return [
        f"{root / 'images'} holds no usable image NNNNNN_C.png or .jpg of {len(bare)} cameras: "
        f"their size is taken to be Waymo's, {taken}"
    ]
