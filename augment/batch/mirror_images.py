"""Weathered images in the form of a dataset's recorded ones: file format, size, channels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from augment.batch.atomic import output_error
from augment.batch.encode import decode_image, encode_image
from augment.batch.layout import resolve_inside
from augment.batch.manifest import OK
from augment.batch.mirror_tree import SourceTree
from augment.cameras import Frame
from augment.errors import AdapterError, OutputError
from augment.image_header import read_image_header
from recipes.schema import Output

FORMATS = {"PNG": "png", "JPEG": "jpg"}  # of ImageHeader, and of recipes


@dataclass(frozen=True)
class ImageForm:
    """format: png or jpg. width, height: pixels. is_grey: one channel (told of PNG only)."""

    format: str
    width: int
    height: int
    is_grey: bool = False


@dataclass(frozen=True)
class Weathered:
    """A finished image of ours and where the dataset has the recorded one.

    scene: whose image it is. path: of our file. name: the same, relative to the output folder.
    form: what our file is. checksum: its SHA-256. jpeg_quality: for writing it anew.
    """

    scene: str
    path: Path
    name: str
    form: ImageForm
    checksum: str
    jpeg_quality: int

    @staticmethod
    def of_row(out_dir: Path, row: Mapping[str, Any], jpeg_quality: int) -> Weathered:
        """The image of a manifest's row.

        Raises:
            OutputError: the row names a file outside the output folder.
        """
        name = row["image_path"]
        form = ImageForm("jpg" if name.endswith(".jpg") else "png", row["width"], row["height"])
        path = resolve_inside(out_dir, name)
        return Weathered(row["scene"], path, name, form, row["checksum"], jpeg_quality)


def image_form(path: str | Path) -> ImageForm | None:
    """Of an image file by its first bytes; None where it is neither PNG nor JPEG."""
    header = read_image_header(path)
    if header is None or header.format not in FORMATS:
        return None
    return ImageForm(FORMATS[header.format], header.width, header.height, header.is_grey)


def dataset_format(frames: Iterable[Frame]) -> str:
    """The format in which to render so that the dataset's images are of it: that of the recorded
    ones, png where they are of several.

    Raises:
        AdapterError: no frame has a recorded image that is PNG or JPEG.
    """
    suffixes = {Path(path).suffix.lower() for f in frames for path in f.image_paths.values()}
    formats = {{".png": "png", ".jpg": "jpg", ".jpeg": "jpg"}.get(suffix) for suffix in suffixes}
    formats.discard(None)
    if not formats:
        raise AdapterError(
            f"the scene knows no recorded image in PNG or JPEG (found: {sorted(suffixes) or 'none'}"
            f"); a dataset's copy replaces those"
        )
    return "jpg" if formats == {"jpg"} else "png"


def weathered_images(
    out_dir: Path,
    rows: Sequence[Mapping[str, Any]],
    frames: Sequence[Frame],
    tree: SourceTree,
    jpeg_quality: int,
) -> tuple[dict[str, Weathered], list[str]]:
    """The finished images of a variant's rows by their place in the dataset, and a sentence for
    those that have none.

    Raises:
        OutputError: a row names a file outside the output folder.
    """
    recorded = {frame.index: frame.image_paths for frame in frames}
    found: dict[str, Weathered] = {}
    unplaced, doubled = [], []
    for row in rows:
        if row["status"] != OK:
            continue
        path = recorded.get(row["frame"], {}).get(row["camera"])
        place = None if path is None else tree.relative(path)
        if place is None:
            unplaced.append(f"frame {row['frame']}, camera {row['camera']}")
            continue
        if place in found:
            doubled.append(place)
        found[place] = Weathered.of_row(out_dir, row, jpeg_quality)
    notes = []
    if unplaced:
        notes.append(
            f"{len(unplaced)} rendered images, such as {unplaced[0]}, have no recorded image in "
            f"the dataset: they are not in its copy"
        )
    if doubled:
        notes.append(
            f"{len(doubled)} recorded images, such as {doubled[0]}, belong to several frames: the "
            f"copy shows the last of them"
        )
    return found, notes


def fits(image: Weathered, recorded: ImageForm) -> bool:
    """Whether our file can stand for the recorded one as it is."""
    return image.form == recorded


def fitted(image: Weathered, recorded: ImageForm) -> bytes:
    """Our image as a file of the recorded one's form: smaller by area, larger by cubic splines.

    Raises:
        OutputError: our file is missing or damaged.
    """
    try:
        rgb = decode_image(image.path.read_bytes())
    except OSError as error:
        raise output_error(image.path, error) from error
    except ValueError as error:
        raise OutputError(
            f"{image.path} is damaged ({error}); delete it and render again"
        ) from error
    size = (recorded.width, recorded.height)
    if (rgb.shape[1], rgb.shape[0]) != size:
        is_smaller = size[0] < rgb.shape[1] and size[1] < rgb.shape[0]
        method = cv2.INTER_AREA if is_smaller else cv2.INTER_CUBIC
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=method), np.uint8)
    if recorded.is_grey:
        return _encode_grey(rgb)
    settings = {"image": recorded.format, "jpeg_quality": image.jpeg_quality}
    return encode_image(rgb, Output.model_validate(settings))


def _encode_grey(rgb: np.ndarray) -> bytes:
    """uint8 [H, W, 3] as a PNG of its luma."""
    done, data = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    assert done
    return data.tobytes()
