"""The files of a recording's folder by camera and frame number, none of them outside the folder.

    images/<camera>/<frame>.png|jpg   depth/<camera>/<frame>.png   lidar/<frame>.parquet
    labels/boxes.parquet              calibration.json

What a `generate` job wrote has labels/boxes/*.parquet and calibration/*.json in their place.

Frame numbers may have leading zeros or not. A camera's folder is its name, or, for a name that is
no safe folder name, what `augment.batch.layout.folder_name` makes of it.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from adapters.image_checks import look_at_image
from augment.batch.layout import folder_name
from augment.cameras import Camera, Frame
from augment.errors import AdapterError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_READERS = 4  # threads that decode images to check them; decoding releases the interpreter


def numbered_files(root: Path, folder: str, suffixes: Sequence[str]) -> dict[int, Path]:
    """The files of a folder that are named by a number, by that number; none without the folder.

    Raises:
        AdapterError: two files have one number, or a file lies outside `root` through a link.
    """
    where = root / folder
    if not where.is_dir():
        return {}
    found: dict[int, Path] = {}
    for path in sorted(where.iterdir()):
        if path.suffix.lower() not in suffixes or not re.fullmatch(r"[0-9]{1,18}", path.stem):
            continue
        number = int(path.stem)
        if number in found:
            raise AdapterError(
                f"{found[number]} and {path} are both of frame {number}; delete one of them"
            )
        found[number] = inside(root, path)
    return found


def block_files(root: Path, folder: str, suffix: str) -> list[Path]:
    """The files of a folder by blocks of frames, as a `generate` job writes them, in order.

    Raises:
        AdapterError: a file lies outside `root` through a link.
    """
    return [inside(root, path) for path in sorted((root / folder).glob(f"*{suffix}"))]


def inside(root: Path, path: Path) -> Path:
    """The path itself.

    Raises:
        AdapterError: a link leads out of `root`: a folder from elsewhere must not make this
            machine read its other files.
    """
    real, real_root = path.resolve(), root.resolve()
    if not real.is_relative_to(real_root):
        raise AdapterError(
            f"{path} leads through a link to {real}, outside {real_root}; put the files themselves "
            f"into the recording's folder"
        )
    return path


def find_images(root: Path, frames: Sequence[Frame]) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """The frames with the paths of their usable images, and a sentence for what is missing,
    damaged, or not of the size that the calibration says.

    Raises:
        AdapterError: no image is usable, or a file lies outside the folder.
    """
    names = list(dict.fromkeys(name for frame in frames for name in frame.cameras))
    files = {n: numbered_files(root, f"images/{folder_name(n)}", IMAGE_SUFFIXES) for n in names}
    problems = [
        f"camera {name}: {root / 'images' / folder_name(name)} holds no image NNNNNN.png or .jpg"
        for name in names
        if not files[name]
    ]
    wanted = [(frame, name) for frame in frames for name in frame.cameras if files[name]]
    with ThreadPoolExecutor(_READERS) as pool:
        faults = list(
            pool.map(lambda w: _fault(files[w[1]].get(w[0].index), w[0].cameras[w[1]]), wanted)
        )
    usable: dict[int, dict[str, str]] = {frame.index: {} for frame in frames}
    for (frame, name), fault in zip(wanted, faults, strict=True):
        if fault:
            problems.append(f"camera {name}, frame {frame.index}: {fault}")
        else:
            usable[frame.index][name] = str(files[name][frame.index])
    if not any(usable.values()):
        raise AdapterError(
            f"{root / 'images'} holds no usable image of frames {frames[0].index} to "
            f"{frames[-1].index}: " + "; ".join(problems[:3])
        )
    complete = tuple(dataclasses.replace(f, image_paths=usable[f.index]) for f in frames)
    return complete, tuple(problems)


def unlisted_images(root: Path, frames: Sequence[Frame]) -> tuple[str, ...]:
    """A sentence for each folder of images that no camera of the calibration has, and for each
    camera with images of frames that the calibration does not list for it."""
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


def _fault(path: Path | None, camera: Camera) -> str:
    """What is wrong with an image, or nothing."""
    if path is None:
        return "its image is missing"
    seen = look_at_image(path)
    if isinstance(seen, str):
        return f"image {path} {seen}"
    if seen != (camera.width, camera.height):
        return (
            f"image {path} is {seen[0]}x{seen[1]} pixels, calibration.json says "
            f"{camera.width}x{camera.height}; left out"
        )
    return ""
