"""How the weather's numbers are spread over the images, and which variants have none."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from augment.jobs.manifest import weather_columns
from tools.report_numbers import Quantity, known_order, quantity_of, shown_values, with_unit
from tools.report_summary import as_floats

_MOST = 1e99  # greater numbers are as little a weather's as infinity is
# What a caption says of an image's weather.
_MAIN = {"smog_extinction_per_m": "visibility", "flood_level_m": "water at", "snow_depth_m": "snow"}


@dataclass(frozen=True, eq=False)
class Spread:
    """One number of the weather over the finished images.

    values: [v] of each variant that has it, in the unit shown. images: [v] int64, how many images
    each of them has. absent_images, absent_variants: those without the effect.
    """

    quantity: Quantity
    values: np.ndarray
    images: np.ndarray
    absent_images: int
    absent_variants: int

    @property
    def is_constant(self) -> bool:
        """All values are one, but for rounding."""
        low, high = float(self.values.min()), float(self.values.max())
        return not high - low > 1e-9 * max(abs(low), abs(high))


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
    rows = table.take(pa.array(first))
    return Draws(draw, first, images, _is_clear(rows))


def spreads(table: pa.Table, draws: Draws) -> list[Spread]:
    """Of every weather column that some image has a number in.

    A variant's images all have its numbers.
    """
    rows = table.take(pa.array(draws.first))
    found = []
    for column in number_columns(table):
        quantity = quantity_of(column)
        numbers = as_floats(rows, column)
        there = _is_there(numbers, quantity)
        if not there.any():
            continue
        found.append(
            Spread(
                quantity,
                shown_values(quantity, numbers[there]),
                draws.images[there],
                int(draws.images[~there].sum()),
                int((~there).sum()),
            )
        )
    return found


@dataclass(frozen=True)
class RecipeWeather:
    """What a recipe's variants drew. ranges: of each number that any of them has, in its unit."""

    ranges: tuple[tuple[Quantity, float, float], ...]
    styles: tuple[str, ...]


def weather_of_recipes(
    table: pa.Table, draws: Draws, names: Collection[str]
) -> dict[str, RecipeWeather]:
    """Of those of the recipes that have finished images."""
    rows = table.take(pa.array(draws.first))
    recipes = np.array(rows["recipe"].to_pylist(), object)
    styles = rows["style"].to_pylist()
    numbers = [(quantity_of(name), as_floats(rows, name)) for name in number_columns(table)]
    numbers = [(q, shown_values(q, np.where(_is_there(v, q), v, np.nan))) for q, v in numbers]
    found = {}
    for recipe in names:
        own = np.flatnonzero(recipes == recipe)
        ranges = []
        for quantity, values in numbers:
            there = values[own][~np.isnan(values[own])]
            if len(there):
                ranges.append((quantity, float(there.min()), float(there.max())))
        named = tuple(sorted({s for k in own if (s := styles[k]) is not None}))
        if len(own):
            found[recipe] = RecipeWeather(tuple(ranges), named)
    return found


def weather_text(row: Mapping[str, Any]) -> str:
    """A row's weather in a few words."""
    said = []
    if (style := row.get("style")) is not None:
        said.append(f"style {style}")
    for column, words in _MAIN.items():
        number, quantity = row.get(column), quantity_of(column)
        if number is not None and _is_there(np.array([number], float), quantity)[0]:
            shown = shown_values(quantity, np.array([number], float))
            said.append(f"{words} {with_unit(float(shown[0]), quantity.unit)}")
    return ", ".join(said) or "no weather"


def number_columns(table: pa.Table) -> list[str]:
    """The weather's columns that hold numbers, in the order of the page."""
    kinds = {name: table.schema.field(name).type for name in weather_columns(table)}
    return sorted((n for n, kind in kinds.items() if pa.types.is_floating(kind)), key=known_order)


def _is_there(numbers: np.ndarray, quantity: Quantity) -> np.ndarray:
    there = np.abs(numbers) < _MOST  # false for NaN
    if quantity.zero_is_absent:
        there &= numbers != 0
    if quantity.inverted:  # a visibility of infinity or below 0 is none
        there &= numbers > 1 / _MOST
    return there


def _is_clear(rows: pa.Table) -> np.ndarray:
    """bool [rows]. Snow of no depth is none, whatever its coverage; water at level 0 is water."""
    clear = np.array([style is None for style in rows["style"].to_pylist()], bool)
    no_snow = np.zeros(rows.num_rows, bool)
    for column in ("snow_depth_m", "snow_coverage"):
        if column in rows.column_names:
            no_snow |= as_floats(rows, column) == 0
    for column in number_columns(rows):
        numbers = as_floats(rows, column)
        none = np.isnan(numbers)
        if column != "flood_level_m":
            none |= numbers == 0
        if column.startswith("snow_"):
            none |= no_snow
        clear &= none
    return clear
