"""An output's weather in numbers: quantities with their units, how they are spread, histograms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from augment.output.manifest import effect_masks, weather_columns
from recipes.effect import Column
from recipes.schema import columns_of_effects
from tools.axis_ticks import linear_ticks, log_ticks

MAX_BINS = 24
LOG_RATIO = 10  # largest over smallest value from which an axis is logarithmic
MAX_MARKS = 300
# Sizes of a histogram, in SVG units.
WIDTH = 340  # the whole picture's width
LEFT = 6  # the margin on the left
RIGHT = 6  # the margin on the right
TOP = 14  # the margin above the bars
FLOOR = 104  # the height, from the top, at which the bars stand
_MAX_NUMBER = 1e99  # greater numbers are as little a weather's as infinity is
_BYTES = ("B", "kB", "MB", "GB", "TB", "PB")
# By ending of a column's name, the longest first.
_UNITS = {
    "_per_m": "1/m",
    "_ntu": "NTU",
    "_mps": "m/s",
    "_mm_per_h": "mm/h",
    "_deg": "°",
    "_m": "m",
}


def quantity_of(column: str) -> Column:
    """Return the quantity of a manifest's column; an unknown one is told by its name's ending."""
    if column in (columns := columns_of_effects()):
        return columns[column]
    ending = next((e for e in _UNITS if column.endswith(e)), "")
    name = column.removesuffix(ending).replace("_", " ").strip()
    title = name[:1].upper() + name[1:]
    return Column(column, lambda section: None, title=title, unit=_UNITS.get(ending, ""))


def shown_numbers(quantity: Column, numbers: np.ndarray) -> np.ndarray:
    """float64 [n] in the unit shown; NaN where the manifest's numbers say that there is no effect,
    or are none that an effect has.
    """
    has_effect = np.abs(numbers) < _MAX_NUMBER  # false for NaN
    if quantity.value_if_absent == 0:
        has_effect &= numbers != 0
    if quantity.numerator is not None:  # a visibility of infinity or below 0 is none
        has_effect &= numbers > 1 / _MAX_NUMBER
    return quantity.to_unit(np.where(has_effect, numbers, np.nan))


def find_draws(table: pa.Table) -> pa.Table:
    """Return the first row of each scene and variant, with two more columns.

    `images` is the number of its images; `is_clear` is True without weather and style.

    Args:
        table: The rows of finished images, with the column `draw`.

    """
    _, first, images = np.unique(table["draw"].to_numpy(), return_index=True, return_counts=True)
    rows = table.take(first)
    numbers = {name: _as_floats(rows, name) for name in _number_columns(rows)}
    weathered = np.logical_or.reduce([*effect_masks(numbers, rows.num_rows).values()])
    rows = rows.append_column("images", pa.array(images))
    return rows.append_column("is_clear", pa.array(~weathered))


@dataclass(frozen=True, eq=False)
class Spread:
    """One number of the weather over the finished images.

    values: [v] of each variant that has it, in the unit shown. images: [v] int64, how many images
    each of them has. absent_images: those without the effect.
    """

    quantity: Column
    values: np.ndarray
    images: np.ndarray
    absent_images: int

    @property
    def is_constant(self) -> bool:
        """True if all values are equal except for rounding."""
        low = self.values.min()
        high = self.values.max()
        return not high - low > 1e-9 * max(abs(low), abs(high))

    @property
    def range_text(self) -> str:
        low = "" if self.is_constant else f"{short(self.values.min())} to "
        highest = self.values.min() if self.is_constant else self.values.max()
        return low + with_unit(highest, self.quantity.unit)

    @property
    def where_text(self) -> str:
        text = f"{count(int(self.images.sum()), 'image')}, {count(len(self.values), 'variant')}"
        return f"{text}; absent in {self.absent_images:,}" if self.absent_images else text


def spreads(draws: pa.Table) -> list[Spread]:
    """Return the spread of every weather column in which some image has a number.

    All images of a variant have the variant's number.
    """
    all_spreads = []
    images = draws["images"].to_numpy()
    for name in _number_columns(draws):
        quantity = quantity_of(name)
        values = shown_numbers(quantity, _as_floats(draws, name))
        has_number = ~np.isnan(values)
        if has_number.any():
            absent = int(images[~has_number].sum())
            all_spreads.append(Spread(quantity, values[has_number], images[has_number], absent))
    return all_spreads


def weather_of_recipes(draws: pa.Table) -> dict[str, str]:
    """Describe the weather that each recipe's variants drew, in words; "" without weather."""
    words = [c for c in columns_of_effects().values() if not c.is_number and c.title]
    numbers = [quantity_of(name) for name in _number_columns(draws)]
    ranges = {
        q.name: pa.array(shown_numbers(q, _as_floats(draws, q.name)), from_pandas=True)
        for q in numbers
    }
    table = draws.select(["recipe", *(c.name for c in words)])
    for name, values in ranges.items():
        table = table.append_column(name, values)
    ends = [(q.name, end) for q in numbers for end in ("min", "max")]
    groups = table.group_by("recipe").aggregate([*((c.name, "distinct") for c in words), *ends])
    text_by_recipe = {}
    for row in groups.to_pylist():
        names = {c.title: sorted(set(row[f"{c.name}_distinct"]) - {None}) for c in words}
        texts = [
            f"{title}: {', '.join(entries[:4])}" for title, entries in names.items() if entries
        ]
        quantities = [q for q in numbers if row[f"{q.name}_min"] is not None]
        for quantity in quantities[:10]:
            low = row[f"{quantity.name}_min"]
            high = row[f"{quantity.name}_max"]
            span = short(low) if low == high else f"{short(low)} to {short(high)}"
            texts.append(f"{quantity.title} {span} {quantity.unit}".rstrip())
        text_by_recipe[row["recipe"]] = "; ".join(texts)
    return text_by_recipe


def weather_text(row: Mapping[str, Any]) -> str:
    """Return a row's weather in a few words."""
    texts = []
    for column in sorted(columns_of_effects().values(), key=lambda column: column.is_number):
        value = row.get(column.name)
        if not column.label or value is None:
            continue
        if column.is_number:
            value = float(shown_numbers(column, np.array([value], float))[0])
            value = None if math.isnan(value) else with_unit(value, column.unit)
        if value is not None:
            texts.append(f"{column.label} {value}")
    return ", ".join(texts) or "no weather"


def _number_columns(table: pa.Table) -> list[str]:
    """Return the weather's columns that have numbers; columns that are known here come first."""
    order = {column: number for number, column in enumerate(columns_of_effects())}
    columns = [
        c for c in weather_columns(table) if pa.types.is_floating(table.schema.field(c).type)
    ]
    return sorted(columns, key=lambda column: (order.get(column, len(order)), column))


def _as_floats(table: pa.Table, column: str) -> np.ndarray:
    """Return a column as float64 [rows]; null is NaN."""
    return pc.fill_null(table[column], np.nan).to_numpy().astype(np.float64)


def histogram(
    values: np.ndarray, weights: np.ndarray, *, linear: bool = False
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return edges [n + 1], counts [n], and True if edges are evenly spaced in the logarithm.

    values: finite [v], two of them unlike, each counted as often as its whole weight says. linear:
    not logarithmic, however far the values are spread.
    """
    low = float(values.min())
    high = float(values.max())
    log = not linear and low > 0 and high / low > LOG_RATIO
    bins = int(min(MAX_BINS, max(6, 2 * math.ceil(math.sqrt(len(values))))))
    edges = np.geomspace(low, high, bins + 1) if log else np.linspace(low, high, bins + 1)
    edges[0] = min(edges[0], low)
    edges[-1] = max(edges[-1], high)
    counts, _ = np.histogram(values, edges, weights=weights)
    return edges, counts, log


def chart(spread: Spread) -> dict[str, Any]:
    """Return a histogram for the template, with positions in SVG units.

    bars: (x, y, width, height, from, to, images). marks: x of a tick for each variant beneath, of
    at most MAX_MARKS, evenly chosen. labels: (x, number) of the axis. most: of the tallest bar.
    """
    edges, counts, log = histogram(spread.values, spread.images, linear=spread.quantity.linear)
    low, high = (math.log(e) if log else float(e) for e in edges[[0, -1]])

    def x_of(value: float) -> float:
        place = ((math.log(value) if log else value) - low) / ((high - low) or 1.0)
        return LEFT + (WIDTH - RIGHT - LEFT) * min(1.0, max(0.0, place))

    tallest = max(float(counts.max()), 1.0)
    bars = []
    for a, b, n in zip(edges[:-1], edges[1:], counts, strict=True):
        if n > 0:
            y = min(FLOOR - (FLOOR - TOP) * n / tallest, FLOOR - 1.5)  # one of a million shows
            bars.append((x_of(a) + 0.5, y, max(x_of(b) - x_of(a) - 1, 1), FLOOR - y, a, b, int(n)))
    marks = np.sort(spread.values)
    marks = marks[np.linspace(0, len(marks) - 1, min(len(marks), MAX_MARKS)).astype(int)]
    ticks = linear_ticks(float(edges[0]), float(edges[-1]))
    if log:
        ticks = log_ticks(float(edges[0]), float(edges[-1]), most=5)
        ticks = ticks[:: -(-len(ticks) // 5)]
    return {
        "spread": spread,
        "bars": bars,
        "marks": sorted({x_of(float(value)) for value in marks}),
        "labels": [(x_of(value), value) for value in ticks],
        "is_log": log,
        "most": int(tallest),
    }


def with_unit(number: float, unit: str) -> str:
    """Return a number with its unit, such as 0.31 m or 4.8 NTU; without a unit, the number."""
    return f"{short(number)} {unit}".rstrip()


def short(number: float) -> str:
    """Return a number as text with three significant digits, and no exponent if possible."""
    if not math.isfinite(number) or number == 0:
        return f"{number + 0.0:g}"  # without the sign of -0.0
    size = abs(number)
    if size >= 1e7 or size < 1e-4:
        return f"{number:.2e}".replace("-", "−")
    digits = max(0, 2 - math.floor(math.log10(size)))
    text = f"{round(number, digits):,.{digits}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return text.replace("-", "−")


def count(number: int, noun: str = "") -> str:
    """Return a count with its noun, such as 12,000 images or 1 image."""
    return f"{number:,} {plural_of(number, noun)}".rstrip()


def plural_of(number: int, noun: str) -> str:
    """Return the noun in singular or plural, as it follows the number."""
    if number == 1 or not noun:
        return noun
    return noun + ("es" if noun.endswith(("x", "ss")) else "s")


def byte_size(number: int) -> str:
    """Return a size as text, such as 3.2 MB, in steps of 1000."""
    size = float(number)
    unit = 0
    while size >= 999.5 and unit < len(_BYTES) - 1:
        size = size / 1000
        unit = unit + 1
    return f"{number:,} B" if unit == 0 else f"{size:.3g} {_BYTES[unit]}"


def percent(part: float, total: float) -> str:
    """Return a share as text, such as 41 % or < 1 %; – where the total is 0."""
    if not total:
        return "–"
    share = 100 * part / total
    if 0 < share < 1:
        return "< 1 %"
    return "> 99 %" if 99 < share < 100 else f"{share:.0f} %"
