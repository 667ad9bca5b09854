"""A moment of the weather: its time, the air, and how the recipe's numbers change over time.

`Recipe.at` makes one for each image. Sections derive from it what has its own history, such as the
water on a road, as numbers of plain fields. So every image can be rendered alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pydantic import Field

from recipes.curve import Curve
from recipes.fields import ClosedModel, Number, Unit

# Nanoseconds of a second.
NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class SceneTimes:
    """The time that a drive takes: of its images, in the dataset's own nanoseconds."""

    start_ns: int
    """Time of the first image."""
    end_ns: int
    """Time of the last image."""
    num_frames: int = 2
    """Number of frames, of which each has the images of one moment."""

    @property
    def duration_s(self) -> float:
        """Return the time from the first image to the last one, seconds."""
        return (self.end_ns - self.start_ns) / NS_PER_S

    @property
    def frame_s(self) -> float:
        """Return the mean time from frame to frame, seconds; 0 for a single frame."""
        return self.duration_s / max(self.num_frames - 1, 1)

    def drive_s(self, timestamp_ns: int) -> float:
        """Return the time of an image since the first one, seconds."""
        return (timestamp_ns - self.start_ns) / NS_PER_S


# A drive that is longer than all others, where the scene is not known: no timeline goes beyond it.
ANY_DRIVE = SceneTimes(0, 10**7 * NS_PER_S)


class Clock(ClosedModel):
    """The time of the weather, by which timelines go, from the time of the drive."""

    start_s: Number = Field(default=0.0, ge=-1e7, le=1e7)
    """Time of the weather at the drive's first image."""
    speed: Number = Field(default=1.0, gt=0, le=1e4)
    """Seconds of weather in a second of the drive: 60 lets a road dry within a drive of some
    seconds."""

    def time_s(self, drive_s: float) -> float:
        """Return the time of the weather at a time of the drive, both in seconds."""
        return self.start_s + self.speed * drive_s


class Air(ClosedModel):
    """The air near the ground, which dries roads and decides how snow lies and melts."""

    temperature_c: Number = Field(default=15.0, ge=-60, le=60)
    """Temperature of the air, degrees Celsius."""
    humidity: Unit = 0.6
    """Relative humidity: 0 dry, 1 saturated."""
    wind_m_s: Number = Field(default=3.0, ge=0, le=60)
    """Speed of the wind 10 m above the ground, as weather services state it."""
    road_warmer_k: Number = Field(default=0.0, ge=-30, le=50)
    """How much warmer the road's surface is than the air, kelvin: some 5 in a weak sun."""


@dataclass(frozen=True)
class Moment:
    """A time of the weather, and the history that led to it."""

    time_s: float
    """Time of the weather since the drive's start, seconds; before it negative."""
    air: Air | None = None
    """The air; None if the recipe says nothing about it."""
    curves: Mapping[str, Curve] = field(default_factory=dict)
    """Numbers that change over time, by the dotted path of their field."""
    constants: Mapping[str, float] = field(default_factory=dict)
    """Rates of rain and snowfall that stay as they are, by the dotted path of their field."""
    end_s: float = 0.0
    """Time of the weather at the drive's last image, seconds."""

    def curve(self, path: str, value: float) -> Curve:
        """Return a number's course: its timeline, or else a constant.

        Args:
            path: dotted path of the number's field.
            value: the number if the recipe has no such rate.
        """
        return self.curves.get(path) or Curve.constant(self.constants.get(path, value))
