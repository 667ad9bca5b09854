"""Pictures: captions, colour bars and axes; contact sheets and videos of an output folder."""

from __future__ import annotations

import itertools
import json
import math
import subprocess
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from augment.errors import OutputError
from augment.output.atomic import write_atomic, write_file_atomically
from augment.output.codecs import decode_image
from augment.output.layout import folder_name, parse_errors_as_output_errors, resolve_inside
from augment.output.manifest import OK, Row, read_manifest
from augment.output.store import Store, open_store
from recipes.schema import columns_of_effects, parse_frames
from tools.output import print_note

FONT = cv2.FONT_HERSHEY_SIMPLEX
CAPTION_PX = 42  # the height of the two lines under a picture, in pixels
GAP_PX = 8  # the white gap between two pictures, in pixels
Color = tuple[int, int, int]
Value = TypeVar("Value")
VIDEO_WIDTH = 1440
MAX_SHOWN = 12  # the number of scenes and variants in one picture
MAX_LINES = 48  # the number of rows of a contact sheet
CELL_WIDTH = 400  # px of one image on a contact sheet
MARGIN = 6
CAPTION = 26
_TITLE_SIZE = 0.6
# The yaw from which cameras are counted, in degrees: a camera that looks back, or less than 15
# degrees past it, is one at the back.
BACK_DEG = 165.0
SAME_AXIS_DEG = 5.0  # the angle below which, roughly, two axes are those of a stereo pair
# What browsers play, from its start on, in the colours of RGB. One thread and nothing of the moment
# or the version: the same frames give the same bytes.
H264 = (
    "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart -threads 1 -fflags +bitexact "
    "-flags:v +bitexact -vf scale=out_color_matrix=bt709:flags=accurate_rnd+bitexact "
    "-colorspace bt709 -color_primaries bt709 -color_trc bt709"
)


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
    """Write a text with its baseline at y and its left end, or its centre, at x."""
    if centred:
        x -= 0.5 * text_width(text, size, thickness)
    cv2.putText(image, text, (round(x), round(y)), FONT, size, color, thickness, cv2.LINE_AA)


def captioned(image: np.ndarray, title: str, text: str) -> np.ndarray:
    """Return a picture, uint8 [H, W, 3], with two lines of text below it."""
    caption = np.full((CAPTION_PX, image.shape[1], 3), 255, np.uint8)
    write(caption, title, 4, 17, size=0.48)
    write(caption, text, 4, 36, size=0.42, color=(110, 110, 110))
    return np.concatenate([image, caption])


def strip(panels: Sequence[np.ndarray]) -> np.ndarray:
    """Return pictures of one height side by side on white."""
    gap = np.full((panels[0].shape[0], GAP_PX, 3), 255, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)][1:], 1)


def resized(image: np.ndarray, width: int, how: int) -> np.ndarray:
    """Resize a picture to another width, by one of OpenCV's interpolations."""
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=how)


def text_width(text: str, size: float, thickness: int = 1) -> int:
    """Return the width of a text, in pixels."""
    return cv2.getTextSize(text, FONT, size, thickness)[0][0]


def color_mapped(values: np.ndarray, color_map: int) -> np.ndarray:
    """Return colours of values [H, W] in [0, 1] (clamped) by a colour map, uint8 [H, W, 3]."""
    levels = (np.clip(values, 0, 1) * 255).round().astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, color_map), cv2.COLOR_BGR2RGB)


def color_bar(width: int, height: int, color_map: int) -> np.ndarray:
    """Return a colour bar, uint8 [H, W, 3]: 0 at the left, 1 at the right."""
    ramp = np.broadcast_to(np.linspace(0, 1, width), (height, width))
    return color_mapped(ramp, color_map)


def linear_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Return about `most` numbers within [low, high], 1, 2 or 5 times a power of ten apart."""
    rough = (high - low) / most
    if not rough > 1e-300:
        return [low]
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(unit * m for m in (1, 2, 5, 10) if unit * m >= rough * 0.999)
    first_index = math.ceil(low / step - 1e-9)
    last_index = math.floor(high / step + 1e-9)
    return [i * step for i in range(first_index, last_index + 1)]


def log_ticks(low: float, high: float, most: int = 7) -> list[float]:
    """Return 1, 2 and 5 times powers of ten within [low, high].

    If those are more than `most`, only powers are returned. If there would be no number or one,
    any round numbers are returned.

    """
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in ((1, 2, 5), (1,)):
        ticks = [d * 10.0**e for e in decades for d in digits]
        ticks = [t for t in ticks if low * (1 - 1e-9) <= t <= high * (1 + 1e-9)]
        if len(ticks) <= most:
            break
    return ticks if len(ticks) > 1 else linear_ticks(low, high)


def short_number(value: float) -> str:
    """Return a number as text for an axis: 5000 as 5k, 1.5e6 as 1.5M, 0.02 as it is."""
    for limit, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= limit:
            return f"{value / limit:g}{suffix}"
    return f"{value:.6g}"


# ---- Images of an output: which of them, and in what order ---------------------------------------


def value_codes(table: pa.Table, *columns: str) -> np.ndarray:
    """Return an integer for each combination of the columns' values, [rows]; none is null."""
    joined = pc.binary_join_element_wise(*(table[c].cast(pa.string()) for c in columns), "\0")
    return pc.dictionary_encode(joined).combine_chunks().indices.to_numpy()


def first_of_each(table: pa.Table, *columns: str) -> np.ndarray:
    """Return the rows (int64) where a combination of the columns' values stands first, in order."""
    return np.sort(np.unique(value_codes(table, *columns), return_index=True)[1])


def evenly(values: Sequence[Value], most: int) -> list[Value]:
    """Choose at most `most` items in their order, from the middles of as many equal parts."""
    number = min(most, len(values))
    return [values[(2 * i + 1) * len(values) // (2 * number)] for i in range(number)]


def cameras_on_car(store: Store, table: pa.Table) -> list[str]:
    """Return the cameras of a manifest's rows in the order in which they stand on the car.

    Seen from above, they go from left to right with the front in the middle, and those at the back
    come last. Cameras without a calibration follow, sorted by name.
    """
    places = {name: (math.inf, 0.0, name) for name in pc.unique(table["camera"]).to_pylist()}
    read_entries = cache(
        lambda path: {e["frame"]: e for e in json.loads(store.read(path))["frames"]}
    )
    calibration_rows = table.select(["camera", "frame", "calibration_path"]).drop_null()
    for row in calibration_rows.take(first_of_each(calibration_rows, "camera")).to_pylist():
        name = row["camera"]
        with suppress(OutputError), parse_errors_as_output_errors("calibration", ""):
            entry = read_entries(row["calibration_path"])[row["frame"]]
            world_from_camera = np.array(entry["cameras"][name]["world_from_camera"], float)
            ego_from_world = np.linalg.inv(np.array(entry["world_from_ego"], float))
            x, y, left_m = (ego_from_world @ world_from_camera)[(0, 1, 1), (2, 2, 3)].tolist()
            from_left_deg = (BACK_DEG - math.degrees(math.atan2(y, x))) % 360
            places[name] = (round(from_left_deg / SAME_AXIS_DEG), -left_m, name)
    return sorted(places, key=places.__getitem__)


def _finished(out: Path, **choices: str | list[str] | None) -> pa.Table:
    """Return the rows of finished images whose columns have the selected values.

    A selection is a list of values or an option's text. None for frames selects the middle frame.


    Raises:
        OutputError: there is no finished image, or none of one of the values.
        ValueError: a text is no frame numbers.
    """
    table = read_manifest(out)
    table = table.filter(pc.equal(table["status"], OK))
    if not table.num_rows:
        raise OutputError(f"{out} holds no finished image; run `climategs render` first")
    for column, choice in choices.items():
        column_values = sorted(pc.unique(table[column]).to_pylist())
        if choice == "all":
            continue
        values = (
            choice.split(",")
            if isinstance(choice, str)
            else choice or [column_values[len(column_values) // 2]]
        )
        if column == "frame" and isinstance(choice, str):
            values = parse_frames(choice).select(column_values, clip=True) or ()
        if not values or not set(values) <= set(column_values):
            wrong_values = ", ".join(str(v) for v in values if v not in column_values) or choice
            value_list = ", ".join(map(str, column_values[:100]))
            if len(column_values) > 100:
                value_list += ", ..."
            raise OutputError(
                f"{out} holds no image of {column} {wrong_values}; it has {value_list}"
            )
        kind = table.schema.field(column).type
        table = table.filter(pc.is_in(table[column], pa.array(values, kind)))
    return table


def shown_variants(table: pa.Table) -> list[Row]:
    """Return the first row of every scene and variant, and no more than MAX_SHOWN rows.

    The variants of a scene with the least fog, rain and snow come first.

    """
    rows = table.take(first_of_each(table, "scene", "variant")).to_pylist()
    rows.sort(key=lambda row: (row["scene"], *_numbers(row), row["variant"]))
    return rows[:: -(-len(rows) // MAX_SHOWN)]


def _numbers(row: Row) -> list[float]:
    """Return the numbers that captions tell; old folders lack some of the columns."""
    number_columns = (c for c in columns_of_effects().values() if c.caption and c.is_number)
    absence_numbers = {"all": -math.inf, "nonzero": 0.0}
    numbers = (
        (row.get(column.name, math.nan), column.presence_values) for column in number_columns
    )
    return [absence_numbers[shows or "all"] if math.isnan(n) else n for n, shows in numbers]


def _weather(row: Row) -> str:
    """Return the variant's name and its weather in words."""
    columns = sorted(columns_of_effects().values(), key=lambda column: column.is_number)
    values = {column.name: row.get(column.name, column.value_of(None)) for column in columns}
    present_columns = [
        c for c in columns if (c.is_present if c.is_number else bool)(values[c.name])
    ]
    caption_values = values | {
        c.name: c.to_unit(values[c.name]) for c in present_columns if c.is_number
    }
    texts = [
        column.caption.format_map(caption_values) for column in present_columns if column.caption
    ]
    return f"{row['variant']} ({', '.join(texts) or 'no weather'})"


def _read(out: Path, row: Row) -> np.ndarray:
    """Read a row's image, RGB uint8 [H, W, 3]."""
    path = resolve_inside(out, row["image_path"])
    try:
        return decode_image(path.read_bytes())
    except (OSError, ValueError) as error:
        raise OutputError(
            f"cannot read the image {path}: it is missing or damaged ({error})"
        ) from error


# ---- Contact sheets and videos -------------------------------------------------------------------


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
    table = _finished(out, recipe=recipe, camera=camera, frame=frame)
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
        title = f"{key[0]}, frame {key[2]}: {_weather(next(iter(rows.values())))}"
        lines.append((title, [(name, _read(out, rows[name])) for name in cameras if name in rows]))
    return lines


def draw_video(
    out: Path, camera: str, frames_per_second: float = 10.0, recipe: str = "all"
) -> Path:
    """Write OUT/video_<camera>.mp4: scenes and variants side by side, frame by frame.

    Raises:
        OutputError: as `draw_sheet`; or the variants have no frame in common.
    """
    table = _finished(out, recipe=recipe, camera=[camera])
    groups = [(row["scene"], row["variant"]) for row in shown_variants(table)]
    rows = {(row["scene"], row["variant"], row["frame"]): row for row in table.to_pylist()}
    frames = sorted(
        {frame for *_, frame in rows if all((*group, frame) in rows for group in groups)}
    )
    if not frames:
        raise OutputError(f"{out}: its scenes and variants have no frame of {camera} in common")
    pictures = (
        side_by_side([(_weather(r), _read(out, r)) for g in groups for r in [rows[*g, frame]]])
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


def write_video(path: Path, frames: Iterable[np.ndarray], frames_per_second: float) -> None:
    """Write RGB frames as an MP4 file, one frame at a time.

    All frames have one size with even sides. The codec is H.264 if imageio-ffmpeg is installed, and
    else MPEG-4 part 2, which OpenCV can always write.


    Raises:
        OutputError: the file cannot be written, or not encoded.
    """
    first = next(frames := iter(frames))
    height, width = first.shape[:2]
    frames = itertools.chain([first], frames)
    with write_file_atomically(path, ending=path.suffix) as file:
        try:
            from imageio_ffmpeg import get_ffmpeg_exe
        except ImportError:
            code = cv2.VideoWriter.fourcc(*"mp4v")
            writer = cv2.VideoWriter(file.name, code, frames_per_second, (width, height))
            for frame in frames:
                writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            if not writer.isOpened():
                raise OutputError(f"cannot write the video {path}: OpenCV has no encoder") from None
            writer.release()
            print_note(
                f"{path.name} is MPEG-4 part 2, which browsers refuse; with "
                f"`pip install 'climategs[video]'` it becomes H.264"
            )
            return
        source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {frames_per_second} -i -"
        command = [get_ffmpeg_exe(), "-v", "error", "-y", *source.split(), *H264.split(), file.name]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as encoder:
            with suppress(BrokenPipeError):  # what it refuses stands on its stderr
                for frame in frames:
                    encoder.stdin.write(frame.tobytes())
            said = encoder.communicate()[1].decode(errors="replace").strip()
        if encoder.returncode:
            raise OutputError(f"cannot write the video {path}: ffmpeg says {said}")


def write_rgb(path: Path, image: np.ndarray, *, jpeg_quality: int = 95) -> None:
    """Write a picture as PNG or JPEG, by the name's ending.

    Raises:
        OutputError: the file cannot be written.
    """
    settings = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if path.suffix == ".jpg" else []
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)
    write_atomic(path, data.tobytes())
