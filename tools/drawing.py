"""Pictures: captions, colour bars and axes; contact sheets and videos of an output folder."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from augment.errors import OutputError
from augment.jobs.atomic import replaced_file, write_atomic
from augment.jobs.layout import folder_name, resolve_inside
from augment.jobs.manifest import OK, read_manifest
from recipes.schema import columns_of_effects

FONT = cv2.FONT_HERSHEY_SIMPLEX
CAPTION_PX, GAP_PX = 42, 8
Color = tuple[int, int, int]
VIDEO_WIDTH = 1440
MAX_SHOWN = 12  # scenes and variants in one picture
CELL_WIDTH = 400  # px of one image on a contact sheet
MARGIN = 6
CAPTION = 26
_TITLE_SIZE = 0.6


def write(
    image: np.ndarray,
    text: str,
    x: float,
    y: float,
    *,
    size: float = 0.5,
    color: Color = (40, 40, 40),
    centred: bool = False,
    thickness: int = 1,
) -> None:
    """Text with its baseline at y and its left end, or its centre, at x."""
    if centred:
        x -= 0.5 * text_width(text, size, thickness)
    cv2.putText(image, text, (round(x), round(y)), FONT, size, color, thickness, cv2.LINE_AA)


def captioned(image: np.ndarray, title: str, text: str) -> np.ndarray:
    """A picture uint8 [H, W, 3] with two lines under it."""
    caption = np.full((CAPTION_PX, image.shape[1], 3), 255, np.uint8)
    write(caption, title, 4, 17, size=0.48)
    write(caption, text, 4, 36, size=0.42, color=(110, 110, 110))
    return np.concatenate([image, caption])


def strip(panels: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of one height side by side on white."""
    gap = np.full((panels[0].shape[0], GAP_PX, 3), 255, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)][1:], 1)


def resized(image: np.ndarray, width: int, how: int) -> np.ndarray:
    """At another width, by one of OpenCV's interpolations."""
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=how)


def text_width(text: str, size: float, thickness: int = 1) -> int:
    """Pixels."""
    return cv2.getTextSize(text, FONT, size, thickness)[0][0]


def color_mapped(values: np.ndarray, color_map: int) -> np.ndarray:
    """uint8 [H, W, 3] RGB of values [H, W] in [0, 1] (clamped), by one of OpenCV's colour maps."""
    levels = (np.clip(values, 0, 1) * 255).round().astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, color_map), cv2.COLOR_BGR2RGB)


def color_bar(width: int, height: int, color_map: int) -> np.ndarray:
    """uint8 [H, W, 3]: 0 at the left, 1 at the right."""
    ramp = np.broadcast_to(np.linspace(0, 1, width), (height, width))
    return color_mapped(ramp, color_map)


def linear_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """At most about `most` round numbers within [low, high]."""
    span = high - low
    if not span > 0:
        return [low]
    raw = span / most
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 2.5, 5, 10) if unit * m >= raw * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten within [low, high]; powers alone where those are
    many, and any round numbers where there would be none or one.
    """
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in ((1, 2, 5), (1,)):
        ticks = [d * 10.0**e for e in decades for d in digits]
        ticks = [t for t in ticks if low * (1 - 1e-9) <= t <= high * (1 + 1e-9)]
        if len(ticks) <= 7:
            break
    return ticks if len(ticks) > 1 else linear_ticks(low, high)


def short_number(value: float) -> str:
    """For an axis: 5000 as 5k, 1.5e6 as 1.5M, 0.02 as it is."""
    for limit, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= limit:
            return f"{value / limit:g}{suffix}"
    return f"{value:.6g}"


def draw_sheet(out: Path, frame: int | None = None) -> Path:
    """Writes OUT/contact_sheet.png: a row per scene and variant, a column per camera.

    Of more than MAX_SHOWN variants, as many are shown, evenly spread.

    Raises:
        OutputError: there is no manifest, no finished image, or none of the frame.
    """
    rows = _read_rows(out)
    frames = sorted({row["frame"] for row in rows})
    frame = frames[len(frames) // 2] if frame is None else frame
    cameras = list(dict.fromkeys(row["camera"] for row in rows))
    lines = []
    for scene, variant in shown_groups(rows):
        group = {
            row["camera"]: row
            for row in rows
            if (row["scene"], row["variant"], row["frame"]) == (scene, variant, frame)
        }
        if group:
            title = f"{scene}, frame {frame}: {_weather(next(iter(group.values())))}"
            images = [(name, _read(out, group[name])) for name in cameras if name in group]
            lines.append((title, images))
    if not lines:
        raise OutputError(f"{out} holds no image of frame {frame}; it has frames {frames}")
    path = out / "contact_sheet.png"
    write_rgb(path, contact_sheet(lines))
    return path


def draw_video(out: Path, camera: str, frames_per_second: float = 10.0) -> Path:
    """Writes OUT/video_<camera>.mp4: scenes and variants side by side, frame by frame."""
    rows = [row for row in _read_rows(out) if row["camera"] == camera]
    by_key = {(row["scene"], row["variant"], row["frame"]): row for row in rows}
    groups = shown_groups(rows)
    frames = [
        frame
        for frame in sorted({row["frame"] for row in rows})
        if all((*group, frame) in by_key for group in groups)
    ]
    pictures = (
        side_by_side(
            [(_weather(row), _read(out, row)) for g in groups for row in [by_key[(*g, frame)]]],
            VIDEO_WIDTH,
        )
        for frame in frames
    )
    path = out / f"video_{folder_name(camera)}.mp4"
    write_video(path, pictures, frames_per_second)
    return path


def _read_rows(out: Path) -> list[dict[str, Any]]:
    """The finished images of an output folder, as manifest rows."""
    rows = [row for row in read_manifest(out).to_pylist() if row["status"] == OK]
    if not rows:
        raise OutputError(f"{out} holds no finished image; run `climategs render` first")
    return rows


def shown_groups(rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Scene and variant of every row, each once and at most MAX_SHOWN of them: a scene's clearest,
    driest and barest first.
    """
    weather = {(row["scene"], row["variant"]): _numbers(row) for row in rows}
    groups = sorted(weather, key=lambda group: (group[0], *weather[group], group[1]))
    return groups[:: -(-len(groups) // MAX_SHOWN)]


def _numbers(row: dict[str, Any]) -> list[float]:
    """What captions tell in numbers; old folders lack some of the columns."""
    told = (c for c in columns_of_effects().values() if c.caption and c.is_number)
    absent = {"all": -math.inf, "nonzero": 0.0}
    numbers = ((row.get(column.name, math.nan), column.shows) for column in told)
    return [absent[shows or "all"] if math.isnan(n) else n for n, shows in numbers]


def _weather(row: dict[str, Any]) -> str:
    """The variant's name and what its weather means to a person."""
    columns = sorted(columns_of_effects().values(), key=lambda column: column.is_number)
    values = {column.name: row.get(column.name, column.of(None)) for column in columns}
    there = [c for c in columns if (c.is_present if c.is_number else bool)(values[c.name])]
    shown = values | {c.name: c.shown(values[c.name]) for c in there if c.is_number}
    texts = [column.caption.format_map(shown) for column in there if column.caption]
    return f"{row['variant']} ({', '.join(texts) or 'no weather'})"


def _read(out: Path, row: dict[str, Any]) -> np.ndarray:
    """uint8 [H, W, 3] RGB of a row's image."""
    path = resolve_inside(out, row["image_path"])
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise OutputError(f"cannot read the image {path}: it is missing or damaged")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


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
        left, bottom = MARGIN + 2, top + CAPTION - 8
        write(sheet, title, left, bottom, size=_TITLE_SIZE, color=(255, 255, 255))
        for c, (caption, image) in enumerate(images):
            left = MARGIN + c * (CELL_WIDTH + MARGIN)
            small = resized(image, CELL_WIDTH, cv2.INTER_AREA)
            height = len(small)
            sheet[top + CAPTION : top + CAPTION + height, left : left + CELL_WIDTH] = small
            bottom = top + CAPTION + cell_height + CAPTION - 9
            write(sheet, caption, left + 2, bottom, size=0.45, color=(190, 190, 190))
    return sheet


def side_by_side(images: Sequence[tuple[str, np.ndarray]], width: int) -> np.ndarray:
    """Images of equal size in a row of up to three, else in a square grid, each named."""
    columns = len(images) if len(images) <= 3 else math.ceil(math.sqrt(len(images)))
    source_height, source_width = images[0][1].shape[:2]
    cell_width = width // columns // 2 * 2  # codecs want even sides
    cell_height = round(source_height * cell_width / source_width) // 2 * 2
    lines = -(-len(images) // columns)
    canvas = np.zeros((lines * cell_height, columns * cell_width, 3), np.uint8)
    for number, (caption, image) in enumerate(images):
        top, left = number // columns * cell_height, number % columns * cell_width
        small = cv2.resize(image, (cell_width, cell_height), interpolation=cv2.INTER_AREA)
        canvas[top : top + cell_height, left : left + cell_width] = small
        write(canvas, caption, left + 9, top + 23, size=0.55, color=(0, 0, 0))
        write(canvas, caption, left + 8, top + 22, size=0.55, color=(255, 255, 255))
    return canvas


def write_video(path: Path, frames: Iterable[np.ndarray], frames_per_second: float) -> None:
    """An MP4 (MPEG-4 part 2, which OpenCV can always write) of RGB frames of equal size, which are
    taken one at a time.
    """
    with replaced_file(path, ending=path.suffix) as file:
        writer = None
        for frame in frames:
            if writer is None:
                code, (height, width) = cv2.VideoWriter.fourcc(*"mp4v"), frame.shape[:2]
                writer = cv2.VideoWriter(file.name, code, frames_per_second, (width, height))
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        if writer is None or not writer.isOpened():
            raise OutputError(f"cannot write the video {path}: there are no frames, or no encoder")
        writer.release()


def write_rgb(path: Path, image: np.ndarray, *, jpeg_quality: int = 95) -> None:
    """PNG or JPEG by the name's ending.

    Raises:
        OutputError: the file cannot be written.
    """
    settings = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if path.suffix == ".jpg" else []
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)
    write_atomic(path, data.tobytes())
