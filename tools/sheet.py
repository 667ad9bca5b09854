"""`climategs sheet`: contact sheets and videos of an output folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from augment.errors import OutputError
from augment.output.manifest import Row
from augment.output.names import folder_name
from augment.output.store import open_store
from tools.chosen_images import (
    cameras_on_car,
    evenly,
    finished_images,
    read_image,
    shown_variants,
    weather_caption,
)
from tools.pictures import resized, text_width, write, write_rgb, write_video

VIDEO_WIDTH = 1440
MAX_LINES = 48  # the number of rows of a contact sheet
CELL_WIDTH = 400  # px of one image on a contact sheet
MARGIN = 6
CAPTION = 26
_TITLE_SIZE = 0.6


def draw_sheet(
    out: Path, recipe: str = "all", camera: str = "all", frame: str | None = None
) -> Path:
    """Write OUT/contact_sheet.png with the images that `sheet_lines` chooses."""
    path = out / "contact_sheet.png"
    write_rgb(path, contact_sheet(sheet_lines(out, recipe, camera, frame)))
    return path


def sheet_lines(
    out: Path, recipe: str = "all", camera: str = "all", frame: str | None = None
) -> list[tuple[str, list[tuple[str, np.ndarray]]]]:
    """Return a title for every scene, variant and frame, and its images by camera.

    recipe, camera: names separated by commas, or all. frame: numbers as `parse_frames` has them, by
    default the middle one. At most MAX_SHOWN variants and MAX_LINES lines, evenly spread.

    Raises:
        OutputError: there is no manifest, no finished image of one of these, or no such file.
    """
    table = finished_images(out, recipe=recipe, camera=camera, frame=frame)
    cameras = cameras_on_car(open_store(out), table)
    rows_by_key: dict[tuple[str, str, int], dict[str, Row]] = {}
    for row in table.to_pylist():
        key = (row["scene"], row["variant"], row["frame"])
        rows_by_key.setdefault(key, {})[row["camera"]] = row
    variants = [(row["scene"], row["variant"]) for row in shown_variants(table)]
    lines = []
    keys = [key for variant in variants for key in rows_by_key if key[:2] == variant]
    for key in evenly(keys, MAX_LINES):
        rows = rows_by_key[key]
        title = f"{key[0]}, frame {key[2]}: {weather_caption(next(iter(rows.values())))}"
        lines.append(
            (title, [(name, read_image(out, rows[name])) for name in cameras if name in rows])
        )
    return lines


def draw_video(
    out: Path, camera: str, frames_per_second: float = 10.0, recipe: str = "all"
) -> Path:
    """Write OUT/video_<camera>.mp4: scenes and variants side by side, frame by frame.

    Raises:
        OutputError: as `draw_sheet`; or the variants have no frame in common.
    """
    table = finished_images(out, recipe=recipe, camera=[camera])
    groups = [(row["scene"], row["variant"]) for row in shown_variants(table)]
    rows = {(row["scene"], row["variant"], row["frame"]): row for row in table.to_pylist()}
    frames = sorted(
        {frame for *_, frame in rows if all((*group, frame) in rows for group in groups)}
    )
    if not frames:
        raise OutputError(f"{out}: its scenes and variants have no frame of {camera} in common")
    pictures = (
        side_by_side(
            [(weather_caption(r), read_image(out, r)) for g in groups for r in [rows[*g, frame]]]
        )
        for frame in frames
    )
    path = out / f"video_{folder_name(camera)}.mp4"
    write_video(path, pictures, frames_per_second)
    return path


def contact_sheet(rows: Sequence[tuple[str, Sequence[tuple[str, np.ndarray]]]]) -> np.ndarray:
    """Return one picture of many: a row for each (title, images), a caption below each image.

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
        top = MARGIN + r * row_height + CAPTION
        write(sheet, title, MARGIN + 2, top - 8, size=_TITLE_SIZE, color=(255, 255, 255))
        for c, (caption, image) in enumerate(images):
            left = MARGIN + c * (CELL_WIDTH + MARGIN)
            small = resized(image, CELL_WIDTH, cv2.INTER_AREA)
            sheet[top : top + len(small), left : left + CELL_WIDTH] = small
            bottom = top + cell_height + CAPTION - 9
            write(sheet, caption, left + 2, bottom, size=0.45, color=(190, 190, 190))
    return sheet


def side_by_side(images: Sequence[tuple[str, np.ndarray]]) -> np.ndarray:
    """Return named images of equal size in a row of up to three, or else in a square grid."""
    columns = len(images) if len(images) <= 3 else math.ceil(math.sqrt(len(images)))
    source_height, source_width = images[0][1].shape[:2]
    width = VIDEO_WIDTH // columns // 2 * 2  # codecs want even sides
    height = max(2, round(source_height * width / source_width) // 2 * 2)
    lines = -(-len(images) // columns)
    canvas = np.zeros((lines * height, columns * width, 3), np.uint8)
    for number, (caption, image) in enumerate(images):
        top = number // columns * height
        left = number % columns * width
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        canvas[top : top + height, left : left + width] = small
        write(canvas, caption, left + 9, top + 23, size=0.55, color=(0, 0, 0))
        write(canvas, caption, left + 8, top + 22, size=0.55, color=(255, 255, 255))
    return canvas
