"""The usable images of a camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from adapters.image_checks import look_at_image
from adapters.kitti.layout import file_in, some
from augment.errors import AdapterError

_READERS = 4  # threads that decode; decoding releases the interpreter


@dataclass(frozen=True, eq=False)
class CameraImages:
    """paths: of the frames that have a usable image. size: width and height of all of them."""

    paths: dict[int, Path]
    size: tuple[int, int]
    problems: tuple[str, ...]


def find_images(
    root: Path,
    camera: str,
    names: Mapping[int, str],
    numbers: Sequence[int],
    size: tuple[int, int] | None,
) -> CameraImages:
    """The images of the frames, all of them decoded once to be sure of them.

    names: the camera's files by frame. size: what the calibration says; None: that of most images.

    Raises:
        AdapterError: no image is usable, or none is of the calibration's size.
    """
    wanted = [number for number in numbers if number in names]
    missing = [number for number in numbers if number not in names]
    problems = [f"camera {camera}: {some(missing)} without an image"] if missing else []
    paths = {number: file_in(root, names[number]) for number in wanted}
    with ThreadPoolExecutor(_READERS) as pool:
        looked_at = dict(zip(wanted, pool.map(look_at_image, paths.values()), strict=True))
    sizes = Counter(seen for seen in looked_at.values() if not isinstance(seen, str))
    if not sizes:
        faults = [f"{paths[n]} {looked_at[n]}" for n in wanted[:3]] or problems
        raise AdapterError(f"camera {camera}: none of its images is usable: {'; '.join(faults)}")
    expected = size or sizes.most_common(1)[0][0]
    if expected not in sizes:
        first = next(n for n in wanted if not isinstance(looked_at[n], str))
        raise AdapterError(
            f"{paths[first]} is {_text(looked_at[first])} pixels, the calibration's S_rect says "
            f"{_text(expected)}; images and calibration must be of one day, rectified (sync) and "
            f"not resized"
        )
    usable = {}
    for number in wanted:
        seen = looked_at[number]
        if seen == expected:
            usable[number] = paths[number]
            continue
        fault = seen if isinstance(seen, str) else f"is {_text(seen)} pixels, not {_text(expected)}"
        problems.append(f"camera {camera}, frame {number}: image {paths[number]} {fault}; left out")
    return CameraImages(usable, expected, tuple(problems))


def _text(size: tuple[int, int] | str) -> str:
    return f"{size[0]}x{size[1]}"
