"""An output's weather in numbers: quantities with their units, how they are spread, histograms."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from markupsafe import Markup

from augment.jobs.manifest import effect_masks, weather_columns
from recipes.effect import Column
from recipes.schema import columns_of_effects

MAX_BINS = 24
LOG_RATIO = 10  # largest over smallest value from which an axis is logarithmic
MAX_MARKS = 300
_WIDTH, _LEFT, _RIGHT, _TOP, _FLOOR = 340, 6, 6, 14, 104  # of a histogram, in SVG units
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
    """What a number of an effect in the manifest means; one not known by its name's ending."""
    known = columns_of_effects().get(column)
    if known is not None:
        return known
    ending = next((e for e in _UNITS if column.endswith(e)), "")
    name = column.removesuffix(ending).replace("_", " ").strip()
    title, unit = name[:1].upper() + name[1:], _UNITS.get(ending, "")
    return Column(column, lambda section: None, title=title, unit=unit)


def _is_there(quantity: Column, numbers: np.ndarray) -> np.ndarray:
    """bool [n]: which of the manifest's numbers say that the effect is there, of those at which it
    is not absent."""
    there = np.abs(numbers) < _MAX_NUMBER  # false for NaN
    if quantity.absent == 0:
        there &= numbers != 0
    if quantity.over is not None:  # a visibility of infinity or below 0 is none
        there &= numbers > 1 / _MAX_NUMBER
    return there


@dataclass(frozen=True, eq=False)
class Draws:
    """Each scene and variant once, sorted by the column `draw` [d].

    first: int64 [d], the row of its first image. images: int64 [d]. clear: bool [d], without
    weather and style.
    """

    draw: np.ndarray
    first: np.ndarray
    images: np.ndarray
    clear: np.ndarray


def find_draws(table: pa.Table) -> Draws:
    """Of a table of finished images with the column `draw`."""
    draw, first, images = np.unique(table["draw"].to_numpy(), return_index=True, return_counts=True)
    return Draws(draw, first, images, _is_clear(table.take(pa.array(first))))


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
    def bounds(self) -> tuple[float, float]:
        return float(self.values.min()), float(self.values.max())

    @property
    def is_constant(self) -> bool:
        """All values are one, but for rounding."""
        low, high = self.bounds
        return not high - low > 1e-9 * max(abs(low), abs(high))

    @property
    def range_text(self) -> str:
        low, high = self.bounds
        if self.is_constant:
            return with_unit(low, self.quantity.unit)
        return f"{short(low)} to {with_unit(high, self.quantity.unit)}"

    @property
    def where_text(self) -> str:
        text = f"{count(int(self.images.sum()), 'image')}, {count(len(self.values), 'variant')}"
        return f"{text}; absent in {self.absent_images:,}" if self.absent_images else text


def spreads(table: pa.Table, draws: Draws) -> list[Spread]:
    """Of every weather column that some image has a number in; a variant's images all have its."""
    rows = table.take(pa.array(draws.first))
    found = []
    for column in _number_columns(table):
        quantity, numbers = quantity_of(column), _as_floats(rows, column)
        there = _is_there(quantity, numbers)
        if there.any():
            values, images = quantity.shown(numbers[there]), draws.images[there]
            found.append(Spread(quantity, values, images, int(draws.images[~there].sum())))
    return found


def weather_of_recipes(table: pa.Table, draws: Draws, names: Collection[str]) -> dict[str, str]:
    """What the variants of each of these recipes drew, in words; "" without weather."""
    rows = table.take(pa.array(draws.first))
    recipes = np.array(rows["recipe"].to_pylist(), object)
    words = [c for c in columns_of_effects().values() if not c.is_number and c.title]
    named = [(column.title, rows[column.name].to_pylist()) for column in words]
    numbers = [(quantity_of(name), _as_floats(rows, name)) for name in _number_columns(table)]
    numbers = [(q, q.shown(np.where(_is_there(q, v), v, np.nan))) for q, v in numbers]
    found = {}
    for recipe in names:
        own = np.flatnonzero(recipes == recipe)
        if not len(own):
            continue
        texts = []
        for title, values in named:
            if names := sorted({v for k in own if (v := values[k]) is not None}):
                texts.append(f"{title}: {', '.join(names[:4])}")
        known = [(q, there) for q, v in numbers if len(there := v[own][~np.isnan(v[own])])]
        for quantity, there in known[:10]:
            low, high = float(there.min()), float(there.max())
            span = short(low) if low == high else f"{short(low)} to {short(high)}"
            texts.append(f"{quantity.title} {span} {quantity.unit}".rstrip())
        found[recipe] = "; ".join(texts)
    return found


def weather_text(row: Mapping[str, Any]) -> str:
    """A row's weather in a few words."""
    texts = []
    for column in sorted(columns_of_effects().values(), key=lambda column: column.is_number):
        value = row.get(column.name)
        if not column.label or value is None:
            continue
        if not column.is_number:
            texts.append(f"{column.label} {value}")
        elif _is_there(column, np.array([value], float))[0]:
            texts.append(f"{column.label} {with_unit(column.shown(float(value)), column.unit)}")
    return ", ".join(texts) or "no weather"


def _number_columns(table: pa.Table) -> list[str]:
    """The weather's columns that hold numbers, those known here first."""
    order = {column: number for number, column in enumerate(columns_of_effects())}
    columns = [
        c for c in weather_columns(table) if pa.types.is_floating(table.schema.field(c).type)
    ]
    return sorted(columns, key=lambda column: (order.get(column, len(order)), column))


def _as_floats(table: pa.Table, column: str) -> np.ndarray:
    """float64 [rows]; null is NaN."""
    return np.asarray(pc.fill_null(table[column], np.nan).to_numpy(), np.float64)


def _is_clear(rows: pa.Table) -> np.ndarray:
    """bool [rows]: without weather and style."""
    numbers = {column: _as_floats(rows, column) for column in _number_columns(rows)}
    return ~np.logical_or.reduce(list(effect_masks(numbers, rows.num_rows).values()))


def histogram(
    values: np.ndarray, weights: np.ndarray, *, linear: bool = False
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Edges [n + 1], counts [n], and whether edges are spaced evenly in the logarithm.

    values: finite [v], two of them unlike, each counted as often as its whole weight says. linear:
    not logarithmic, however far the values are spread.
    """
    low, high = float(values.min()), float(values.max())
    log = not linear and low > 0 and high / low > LOG_RATIO
    bins = int(min(MAX_BINS, max(6, 2 * math.ceil(math.sqrt(len(values))))))
    edges = np.geomspace(low, high, bins + 1) if log else np.linspace(low, high, bins + 1)
    edges[0], edges[-1] = min(edges[0], low), max(edges[-1], high)
    counts, _ = np.histogram(values, edges, weights=weights)
    return edges, counts, log


class Chart(NamedTuple):
    """A histogram as the template draws it, places in SVG units.

    bars: (x, y, width, height, what it counts). marks: the path of a tick for each variant beneath.
    labels: (x, anchor, number) of the axis. scale: its unit. most: the tallest bar's count.
    """

    spread: Spread
    bars: list[tuple[str, str, str, str, str]]
    marks: Markup
    labels: list[tuple[str, str, str]]
    scale: str
    most: str


def chart(spread: Spread) -> Chart:
    """Bars count images; of the ticks beneath MAX_MARKS are drawn at most, evenly chosen."""
    edges, counts, log = histogram(spread.values, spread.images, linear=spread.quantity.linear)
    unit = spread.quantity.unit
    places = np.log(edges) if log else edges
    span = float(places[-1] - places[0]) or 1.0
    right = _WIDTH - _RIGHT

    def x_of(value: float) -> float:
        place = math.log(value) if log else value
        return _LEFT + (right - _LEFT) * min(1.0, max(0.0, (place - places[0]) / span))

    tallest = max(float(counts.max()), 1.0)
    bars = []
    for a, b, n in zip(edges[:-1], edges[1:], counts, strict=True):
        if n > 0:
            # One of a million still shows.
            y, x, end = min(_FLOOR - (_FLOOR - _TOP) * n / tallest, _FLOOR - 1.5), x_of(a), x_of(b)
            box = (x + 0.5, y, max(end - x - 1, 1), _FLOOR - y)
            title = f"{with_unit(a, unit)} to {with_unit(b, unit)}: {count(int(n), 'image')}"
            bars.append((*(f"{number:.1f}" for number in box), title))
    marks = np.sort(spread.values)
    marks = marks[np.linspace(0, len(marks) - 1, min(len(marks), MAX_MARKS)).astype(int)]
    stems = "".join(f"M{x:.1f} {_FLOOR + 4}v8" for x in sorted({x_of(float(v)) for v in marks}))
    labels = []
    for value in ticks(float(edges[0]), float(edges[-1]), log):
        x = x_of(value)
        anchor = "start" if x < _LEFT + 16 else "end" if x > right - 16 else "middle"
        labels.append((f"{x:.1f}", anchor, short(value)))
    scale = f"{unit}{', log scale' if log else ''}".lstrip(", ")
    return Chart(spread, bars, Markup(stems), labels, scale, count(int(tallest)))


def ticks(low: float, high: float, log: bool) -> list[float]:
    """Round numbers within [low, high]: 1, 2 or 5 times powers of ten."""
    if log:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        every = [m * 10.0**p for p in powers for m in (1, 2, 5)]
        inside = [v for v in every if low <= v <= high]
        tens = [v for v in inside if math.log10(v) % 1 < 1e-9]
        shown = inside if len(inside) <= 5 or len(tens) < 2 else tens
        return shown[:: -(-len(shown) // 5)]
    rough = (high - low) / 6
    if rough < 1e-300:
        return [low]
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(m * unit for m in (1, 2, 5, 10) if m * unit >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    found = [(first + k) * step for k in range(8)]
    return [v for v in found if low - 1e-9 * step <= v <= high + 1e-9 * step]


def with_unit(number: float, unit: str) -> str:
    """0.31 m, 4.8 NTU; a number without a unit stands alone."""
    return f"{short(number)} {unit}".rstrip()


def short(number: float) -> str:
    """Three significant digits, no exponent where there need be none."""
    if not math.isfinite(number):
        return str(number)
    if number == 0:
        return "0"
    size = abs(number)
    if size >= 1e7 or size < 1e-4:
        return f"{number:.2e}".replace("-", "−")
    digits = max(0, 2 - math.floor(math.log10(size)))
    text = f"{round(number, digits):,.{digits}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return text.replace("-", "−")


def count(number: int, noun: str = "") -> str:
    """12,000 images; 1 image."""
    return f"{number:,} {plural_of(number, noun)}".rstrip()


def plural_of(number: int, noun: str) -> str:
    """The noun as it stands behind the number."""
    if number == 1 or not noun:
        return noun
    return noun + ("es" if noun.endswith(("x", "ss")) else "s")


def byte_size(number: int) -> str:
    """3.2 MB, in steps of 1000."""
    size, unit = float(number), 0
    while size >= 999.5 and unit < len(_BYTES) - 1:
        size, unit = size / 1000, unit + 1
    return f"{number:,} B" if unit == 0 else f"{size:.3g} {_BYTES[unit]}"


def percent(part: float, whole: float) -> str:
    """41 %, < 1 %; an empty whole has no parts."""
    if not whole:
        return "–"
    share = 100 * part / whole
    if 0 < share < 1:
        return "< 1 %"
    return "> 99 %" if 99 < share < 100 else f"{share:.0f} %"
