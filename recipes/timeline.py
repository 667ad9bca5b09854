"""Timelines: fields of a recipe whose values change while the weather goes on.

A recipe file has a timeline in place of a field's value. A recipe in numbers has the timelines in
`Recipe.timelines`, and in the field the largest value (of words the first one): the value for which
room is made once a scene. `Recipe.at` puts the value of a moment into the field.
"""

from __future__ import annotations

import bisect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from recipes.curve import Curve, Shape
from recipes.errors import RecipeError, join
from recipes.fields import ClosedModel
from recipes.moment import Clock, SceneTimes

# Key of a timeline in the place of a field's value, and of its parts beside the points.
TIMELINE = "timeline"

PointValue = float | int | bool | str
TimeUnit = Literal["seconds", "share"]


class FieldTimeline(ClosedModel):
    """The values of one field over time."""

    path: str
    """Dotted path of the field."""
    points: tuple[tuple[float, PointValue], ...] = Field(min_length=1)
    """Times, rising, each with the field's value there."""
    shape: Shape = "linear"
    """Form of the curve between points; words and whole numbers only step."""
    times: TimeUnit = "seconds"
    """Unit of the times: seconds of the weather, or shares of the drive."""
    place: str = Field(default="", exclude=True, repr=False)
    """File and line where the timeline is written, for messages; no part of its identity."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FieldTimeline) and self._identity == other._identity

    def __hash__(self) -> int:
        return hash(self._identity)

    @property
    def _identity(self) -> tuple[object, ...]:
        return self.path, self.points, self.shape, self.times

    @property
    def values(self) -> tuple[PointValue, ...]:
        """Return the values at the points."""
        return tuple(value for _, value in self.points)

    @property
    def is_number(self) -> bool:
        """Return True if the values are numbers, so that there is a curve."""
        return not any(isinstance(value, str | bool) for value in self.values)

    @property
    def largest(self) -> PointValue:
        """Return the largest value; of words the first one."""
        words = [value for value in self.values if isinstance(value, str)]
        return words[0] if words else max(self.values)

    def times_s(self, clock: Clock, scene_times: SceneTimes) -> tuple[float, ...]:
        """Return the points' times in seconds of the weather.

        Args:
            clock: the recipe's clock.
            scene_times: the drive's times.

        Raises:
            RecipeError: a point lies beyond the drive, or the drive has no length to take shares
                of.
        """
        times = tuple(time for time, _ in self.points)
        if self.times == "share":
            if scene_times.duration_s <= 0 and len(times) > 1:
                raise self.error(
                    "times: share are shares of the drive, and all images of this scene have the "
                    "same time; write times in seconds, which may be negative"
                )
            return tuple(clock.time_s(share * scene_times.duration_s) for share in times)
        end_s = clock.time_s(scene_times.duration_s)
        for index, time_s in enumerate(times):
            # a drive of 10 frames, 0.1 s each, lasts a second, though its last image is at 0.9 s
            if time_s > end_s + scene_times.frame_s * clock.speed * (1 + 1e-6):
                raise self.error(
                    f"time {time_s:g} s lies beyond the drive, whose weather goes from "
                    f"{clock.start_s:g} to {end_s:g} s; write 'times: share' for shares of the "
                    "drive, or a larger weather.clock.speed",
                    index,
                )
        return times

    def error(self, text: str, point: int | None = None) -> RecipeError:
        """Return the error for a problem of the timeline, or of one of its points."""
        where = f"{self.path}.{TIMELINE}" + ("" if point is None else f"[{point}]")
        return RecipeError(f"{self.place}: {where}: {text}" if self.place else f"{where}: {text}")

    def curve(self, times_s: tuple[float, ...]) -> Curve:
        """Return the course of a number, from the points' times in seconds."""
        return Curve(times_s, tuple(float(value) for value in self.values), self.shape)

    def value(self, times_s: tuple[float, ...], time_s: float) -> PointValue:
        """Return the field's value at a time.

        Args:
            times_s: the points' times, seconds of the weather.
            time_s: the time, seconds of the weather.
        """
        if isinstance(self.largest, float):
            return self.curve(times_s).value(time_s)
        return self.values[max(bisect.bisect_right(times_s, time_s) - 1, 0)]

    def as_field(self) -> dict[str, object]:
        """Return what a recipe file has in the place of the field's value."""
        return {TIMELINE: self.points, "shape": self.shape, "times": self.times}


@dataclass(frozen=True)
class DrawnTimeline:
    """A timeline in numbers, in the place of a field's value, before its field is known."""

    points: tuple[tuple[float, PointValue], ...]
    """Times, rising, each with the field's value there."""
    shape: Shape = "linear"
    """Form of the curve between points."""
    times: TimeUnit = "seconds"
    """Unit of the times."""
    place: str = ""
    """File and line, for messages."""

    @property
    def is_constant(self) -> bool:
        """Return True if the value never changes."""
        return len({value for _, value in self.points}) == 1

    def of_field(self, path: str) -> FieldTimeline:
        """Return the timeline of the field at a dotted path."""
        return FieldTimeline(
            path=path, points=self.points, shape=self.shape, times=self.times, place=self.place
        )


def take_timelines(data: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[FieldTimeline, ...]]:
    """Return a recipe's fields with plain values only, and the timelines that some had instead.

    A timeline whose values are all equal becomes the plain value.

    Args:
        data: fields of a recipe by section, some of them `DrawnTimeline`.
    """
    timelines: list[FieldTimeline] = []
    fields = _plain_fields(data, "", timelines)
    return fields, tuple(sorted(timelines, key=lambda timeline: timeline.path))


def _plain_fields(
    section: Mapping[str, Any], path: str, timelines: list[FieldTimeline]
) -> dict[str, Any]:
    """Return a section with plain values; its timelines are added to `timelines`."""
    fields: dict[str, Any] = {}
    for name, value in section.items():
        field_path = join(path, name)
        if isinstance(value, Mapping):
            fields[name] = _plain_fields(value, field_path, timelines)
        elif isinstance(value, DrawnTimeline):
            timeline = value.of_field(field_path)
            fields[name] = timeline.largest
            if not value.is_constant:
                timelines.append(timeline)
        else:
            fields[name] = value
    return fields
