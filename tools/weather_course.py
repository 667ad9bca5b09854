"""The course of a recipe's numbers over a drive: as rows for `climategs explain`, and as a picture.

Numbers that follow a timeline are among them, and so are those that sections derive from the
weather before, such as the water on a road.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from augment.errors import ClimateGSError
from augment.output.atomic import write_atomic
from recipes.moment import SceneTimes
from recipes.ranges import is_number
from recipes.schema import Recipe, columns_of_effects
from recipes.sections import unit_of_field

# Times of a picture's curves, beside the points of timelines.
NUM_PLOTTED = 240
# Times of a table.
NUM_ROWS = 9
# Colour of numbers that have a timeline.
TIMELINE_COLOR = "#1864ab"
# Colour of numbers that follow from others.
DERIVED_COLOR = "#2b8a3e"
# Colour of the line at the explained time.
MARK_COLOR = "#c92a2a"
# Least change that counts, as a share of the largest absolute value.
MIN_CHANGE = 1e-9


@dataclass(frozen=True)
class WeatherCourse:
    """Numbers of a recipe at some times of a drive."""

    drive_s: tuple[float, ...]
    """Times since the drive's first image, seconds, rising."""
    weather_s: tuple[float, ...]
    """The same times of the weather, seconds."""
    values: Mapping[str, tuple[float, ...]]
    """Values of every number that changes, by the dotted path of its field or its column; NaN
    where there is none."""

    def as_dict(self) -> dict[str, Any]:
        """Return the course for JSON, with None in place of NaN."""
        values = {
            path: [value if math.isfinite(value) else None for value in row]
            for path, row in self.values.items()
        }
        return {"drive_s": self.drive_s, "weather_s": self.weather_s, "values": values}


def course_of(recipe: Recipe, times: SceneTimes, count: int = NUM_ROWS) -> WeatherCourse:
    """Return the numbers of a recipe that change over a drive.

    Args:
        recipe: the recipe.
        times: the drive's times.
        count: number of times, evenly spread over the drive.

    Raises:
        RecipeError: a timeline goes beyond the drive.
    """
    num_times = count if times.duration_s > 0 else 1
    drive_s = tuple(times.duration_s * i / max(num_times - 1, 1) for i in range(num_times))
    weather_s = tuple(recipe.weather.clock.time_s(t) for t in drive_s)
    rows = [dict(_numbers(recipe.at_weather_time(times, t))) for t in weather_s]
    paths = dict.fromkeys(path for row in rows for path in row)
    columns = {path: tuple(row.get(path, math.nan) for row in rows) for path in paths}
    changing = {path: values for path, values in columns.items() if _changes(values)}
    # A manifest column often repeats a field; the field is enough.
    first_paths = dict[tuple[float, ...], str]()
    for path, values in changing.items():
        first_paths.setdefault(values, path)
    return WeatherCourse(drive_s, weather_s, {path: v for v, path in first_paths.items()})


def _numbers(recipe: Recipe) -> Iterator[tuple[str, float]]:
    """Yield all numbers of the effects and the air by path, then those of manifest columns."""
    dump = recipe.model_dump(mode="python")
    for path in (*recipe.sections(), "weather.air"):
        section: Any = dump
        for name in path.split("."):
            section = section[name]
        yield from _numbers_below(section, path)
    for name, value in recipe.columns().items():
        if is_number(value):
            yield name, float(value)


def _numbers_below(value: Any, path: str) -> Iterator[tuple[str, float]]:
    """Yield the numbers below a value; True counts as 1."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _numbers_below(inner, f"{path}.{name}")
    elif isinstance(value, bool | int | float):
        yield path, float(value)


def _changes(values: tuple[float, ...]) -> bool:
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return False
    span = max(finite) - min(finite)
    return span > MIN_CHANGE * max(map(abs, finite)) or len(finite) < len(values)


def unit_of(path: str) -> str:
    """Return the unit of a field or a column in words, '' for a pure number."""
    column = columns_of_effects().get(path)
    if column is not None and column.factor == 1 and column.numerator is None:
        return column.unit
    return unit_of_field(path) or ""


def write_course(path: Path, recipe: Recipe, times: SceneTimes, at_s: float | None = None) -> None:
    """Write a PNG with a panel for each number that changes over a drive.

    Args:
        path: the file.
        recipe: the recipe.
        times: the drive's times.
        at_s: time since the first image that gets a mark, seconds; None for none.

    Raises:
        ClimateGSError: nothing changes, or matplotlib is missing.
        OutputError: the file cannot be written.
    """
    course = course_of(recipe, times, NUM_PLOTTED)
    if not course.values:
        raise ClimateGSError(
            f"--plot {path}: no number of recipe {recipe.name} changes over the drive of "
            f"{times.duration_s:g} s; give a field a timeline, as docs/recipes.md shows"
        )
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ClimateGSError(
            f"--plot {path}: matplotlib is missing: pip install 'climategs[plots]'"
        ) from None
    columns = min(2, len(course.values))
    rows = -(-len(course.values) // columns)
    figure = Figure(figsize=(6.4 * columns, 2.6 * rows), layout="constrained")
    timelines = {timeline.path: timeline for timeline in recipe.timelines}
    mark_s = None if at_s is None else recipe.weather.clock.time_s(at_s)
    for number, (name, values) in enumerate(course.values.items(), 1):
        axes = figure.add_subplot(rows, columns, number)
        unit = unit_of(name)
        axes.set_title(name + (f" [{unit}]" if unit else ""), loc="left", fontsize="medium")
        axes.set_xlabel("seconds of weather", fontsize="small")
        axes.grid(color="#e1e1e1")
        timeline = timelines.get(name)
        if timeline is None:
            axes.plot(course.weather_s, values, color=DERIVED_COLOR)
        else:
            style = "steps-post" if timeline.shape == "step" else "default"
            axes.plot(course.weather_s, values, color=TIMELINE_COLOR, drawstyle=style)
            points_s = timeline.times_s(recipe.weather.clock, times)
            for time_s in points_s:
                if course.weather_s[0] <= time_s <= course.weather_s[-1]:
                    value = timeline.value(points_s, time_s)
                    axes.plot(time_s, float(value), "o", color=TIMELINE_COLOR, markersize=4)
        if mark_s is not None:
            axes.axvline(mark_s, color=MARK_COLOR, linewidth=1)
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    write_atomic(path, data.getvalue())
