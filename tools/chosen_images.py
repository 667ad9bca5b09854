"""Images of an output: selections of the manifest's rows, their order, captions and pixels."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from augment.errors import OutputError
from augment.output.codecs import decode_image
from augment.output.layout import parse_errors_as_output_errors
from augment.output.manifest import OK, Row, read_manifest
from augment.output.names import resolve_inside
from augment.output.store import Store
from recipes.schema import columns_of_effects, parse_frames

Value = TypeVar("Value")
MAX_SHOWN = 12  # the number of scenes and variants in one picture
# The yaw from which cameras are counted, in degrees: a camera that looks back, or less than 15
# degrees past it, is one at the back.
BACK_DEG = 165.0
SAME_AXIS_DEG = 5.0  # the angle below which, roughly, two axes are those of a stereo pair


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


def finished_images(out: Path, **choices: str | list[str] | None) -> pa.Table:
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


def weather_caption(row: Row) -> str:
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


def read_image(out: Path, row: Row) -> np.ndarray:
    """Read a row's image, RGB uint8 [H, W, 3]."""
    path = resolve_inside(out, row["image_path"])
    try:
        return decode_image(path.read_bytes())
    except (OSError, ValueError) as error:
        raise OutputError(
            f"cannot read the image {path}: it is missing or damaged ({error})"
        ) from error
