"""Pictures of an output folder for people: a contact sheet and a side-by-side video."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from augment.errors import OutputError
from augment.jobs.atomic import replaced_file, write_atomic
from tools.drawing import text_width

CELL_WIDTH = 400  # px of one image on a contact sheet
MARGIN = 6
CAPTION = 26
_TITLE_SIZE = 0.6


def contact_sheet(rows: Sequence[tuple[str, Sequence[tuple[str, np.ndarray]]]]) -> np.ndarray:
    """One picture of many: a row per (title, images), a caption under each image.

    Images are uint8 [H, W, 3] RGB of any size; all are scaled to one width. Returns RGB.
    """
    columns = max(len(images) for _, images in rows)
    cell_height = max(
        round(image.shape[0] * CELL_WIDTH / image.shape[1]) for _, r in rows for _, image in r
    )
    row_height = CAPTION + cell_height + CAPTION + MARGIN
    longest = max(text_width(title, _TITLE_SIZE) for title, _ in rows)
    width = MARGIN + max(columns * (CELL_WIDTH + MARGIN), 2 + longest + MARGIN)
    sheet = np.full((row_height * len(rows) + MARGIN, width, 3), 24, np.uint8)
    for r, (title, images) in enumerate(rows):
        top = MARGIN + r * row_height
        _write(sheet, title, MARGIN + 2, top + CAPTION - 8, _TITLE_SIZE, (255, 255, 255))
        for c, (caption, image) in enumerate(images):
            left = MARGIN + c * (CELL_WIDTH + MARGIN)
            height = round(image.shape[0] * CELL_WIDTH / image.shape[1])
            small = cv2.resize(image, (CELL_WIDTH, height), interpolation=cv2.INTER_AREA)
            sheet[top + CAPTION : top + CAPTION + height, left : left + CELL_WIDTH] = small
            baseline = top + CAPTION + cell_height + CAPTION - 9
            _write(sheet, caption, left + 2, baseline, 0.45, (190, 190, 190))
    return sheet


def side_by_side(images: Sequence[tuple[str, np.ndarray]], width: int) -> np.ndarray:
    """Images of equal size in a row of up to three, else in a square grid, each named."""
    columns = len(images) if len(images) <= 3 else math.ceil(math.sqrt(len(images)))
    source_height, source_width = images[0][1].shape[:2]
    cell_width = width // columns // 2 * 2
    cell_height = (
        round(source_height * cell_width / source_width) // 2 * 2
    )  # codecs want even sides
    lines = -(-len(images) // columns)
    canvas = np.zeros((lines * cell_height, columns * cell_width, 3), np.uint8)
    for number, (caption, image) in enumerate(images):
        top, left = number // columns * cell_height, number % columns * cell_width
        small = cv2.resize(image, (cell_width, cell_height), interpolation=cv2.INTER_AREA)
        canvas[top : top + cell_height, left : left + cell_width] = small
        _write(canvas, caption, left + 9, top + 23, 0.55, (0, 0, 0))
        _write(canvas, caption, left + 8, top + 22, 0.55, (255, 255, 255))
    return canvas


def write_video(path: Path, frames: Iterable[np.ndarray], frames_per_second: float) -> None:
    """An MP4 (MPEG-4 part 2, which OpenCV can always write) of RGB frames of equal size.

    Frames are taken one at a time, so a long sequence need not fit in memory.

    Raises:
        OutputError: the file cannot be written, or there are no frames.
    """
    with replaced_file(path, ending=path.suffix) as file:
        writer = None
        for frame in frames:
            if writer is None:
                code, (height, width) = cv2.VideoWriter.fourcc(*"mp4v"), frame.shape[:2]
                writer = cv2.VideoWriter(file.name, code, frames_per_second, (width, height))
                if not writer.isOpened():
                    raise OutputError(f"cannot write the video {path}: does its name end in .mp4?")
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        if writer is None:
            raise OutputError(f"no frames for the video {path}")
        writer.release()


def read_rgb(path: Path) -> np.ndarray:
    """uint8 [H, W, 3] RGB.

    Raises:
        OutputError: the file is missing or no image.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise OutputError(f"cannot read the image {path}: it is missing or damaged")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def write_rgb(path: Path, image: np.ndarray) -> None:
    """PNG or JPEG by the name's ending.

    Raises:
        OutputError: the file cannot be written.
    """
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    write_atomic(path, data.tobytes())


def _write(
    image: np.ndarray, text: str, x: int, y: int, size: float, color: tuple[int, int, int]
) -> None:
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)
