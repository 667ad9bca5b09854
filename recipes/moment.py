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

    def curve(self, path: str, value: float) -> Curve:
        """Return a number's course: its timeline, or else the constant `value`."""
        return self.curves.get(path) or Curve.constant(value)
