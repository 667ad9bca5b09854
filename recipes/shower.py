"""Showers in space: the rate along the wind at a moment, from the rate's course over time.

A shower is a frozen field that the wind carries (Taylor 1938, "The spectrum of turbulence"). If
f(t) falls at the reference place, U is the shower's speed over the ground, and d is the distance
from that place in the direction in which the shower moves, then f(t - d / U) falls there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Protocol, TypeVar

from pydantic import Field

from recipes.curve import Curve
from recipes.effect import EffectModel
from recipes.fields import ClosedModel, Number
from recipes.moment import Moment

# Largest speed of a shower over the ground, m/s.
MAX_FRONT_MPS = 60.0
# Largest rate at a place of a shower, mm/h.
MAX_PLACE_RATE_MM_H = 300.0
# Largest number of places along a shower.
MAX_PLACES = 4096
# Distance beyond which the course of a shower is left out, metres: it is far below the horizon.
FAR_M = 1e6
# Distance over which the edge of a shower's cloud thins, before and behind the rain's edge, metres.
# Assumed.
CLOUD_EDGE_M = 600.0
# Number of straight lines that stand for a smooth rise or fall of the rate.
_NUM_LINES = 24
# Number of places in a straight line where its cloud is summed up.
_NUM_CLOUD_PLACES = 16


class RateAtPlace(ClosedModel):
    """Rate at one place of a shower."""

    distance_m: Number = Field(ge=-FAR_M, le=FAR_M)
    """Distance from the drive's first camera, in the direction in which the shower moves."""
    rate_mm_h: Number = Field(ge=0, le=MAX_PLACE_RATE_MM_H)
    """Rate there; straight lines connect the places, and the first and last hold beyond."""


Along = tuple[RateAtPlace, ...]


class _Shower(Protocol):
    """Section that may pass as a shower."""

    rate_mm_h: float
    front_mps: float | None
    along: Along | None
    peak_mm_h: float | None
    shadow_fade: float | None
    gloss_fade: float | None


Section = TypeVar("Section", bound=EffectModel)


def check_along(along: Along | None) -> None:
    """Raise ValueError if the places of a shower are not in order."""
    for before, after in itertools.pairwise(along or ()):
        if after.distance_m < before.distance_m:
            raise ValueError(
                f"along must rise by distance_m; {after.distance_m:g} comes after "
                f"{before.distance_m:g}"
            )


def rates_along(curve: Curve, front_mps: float, time_s: float) -> Along:
    """Return the rate along the direction in which a shower moves, at a moment.

    Args:
        curve: rate at the reference place over time.
        front_mps: speed of the shower, m/s.
        time_s: time of the weather.
    """
    first_s = max(curve.times_s[0], time_s - FAR_M / front_mps)
    last_s = min(curve.times_s[-1], time_s + FAR_M / front_mps)
    times: list[tuple[float, float]] = []
    for piece in curve.pieces(first_s, last_s):
        count = _NUM_LINES if len(piece.coefficients) > 2 else 1
        inner = [piece.start_s + (piece.end_s - piece.start_s) * n / count for n in range(count)]
        if piece.start_s < time_s < piece.end_s:
            inner = sorted({*inner, time_s})
        times += [(t, piece.value(t)) for t in (*inner, piece.end_s)]
    if last_s <= first_s:
        times = [(time_s, curve.value(time_s))]
    # At the last time of a step, the curve has the number of its last point already.
    times.append((last_s, curve.value(last_s)))
    times = [pair for pair, _ in itertools.groupby(times)]
    return tuple(
        RateAtPlace(
            distance_m=min(max(front_mps * (time_s - t), -FAR_M), FAR_M), rate_mm_h=max(rate, 0.0)
        )
        for t, rate in reversed(times)
    )


def cloud_share(along: Along, overcast_mm_h: float) -> float:
    """Return the share of the reference place that a shower's cloud covers, 0 to 1.

    It is the mean of 1 - exp(-rate / overcast_mm_h) up to CLOUD_EDGE_M before and behind.
    """
    inner = [place.distance_m for place in along if abs(place.distance_m) < CLOUD_EDGE_M]
    edges = [-CLOUD_EDGE_M, *inner, CLOUD_EDGE_M]
    total = 0.0
    for low, high in itertools.pairwise(edges):
        step = (high - low) / _NUM_CLOUD_PLACES
        places = (low + (n + 0.5) * step for n in range(_NUM_CLOUD_PLACES))
        total += step * sum(-math.expm1(-rate_at(along, d) / overcast_mm_h) for d in places)
    return min(total / (2 * CLOUD_EDGE_M), 1.0)


def rate_at(along: Sequence[RateAtPlace], distance_m: float) -> float:
    """Return the rate at a distance from the reference place, mm/h."""
    before = along[0]
    for place in along:
        if place.distance_m >= distance_m:
            width = place.distance_m - before.distance_m
            if width <= 0:
                return place.rate_mm_h
            share = (distance_m - before.distance_m) / width
            return before.rate_mm_h + share * (place.rate_mm_h - before.rate_mm_h)
        before = place
    return before.rate_mm_h


def with_shower(section: Section, path: str, moment: Moment, overcast_mm_h: float) -> Section:
    """Return rain or snowfall with the numbers that follow from its rate's course.

    The largest rate makes drops last from image to image. If the shower moves, the rates along its
    way and the share of its cloud before the sun follow, too. Fields that the recipe gives stay.

    Args:
        section: rain or snowfall at the moment.
        path: dotted path of the section.
        moment: the moment.
        overcast_mm_h: rate at which clouds hide most of the sun, as in `cloud_share`.
    """
    curve = moment.curves.get(f"{path}.rate_mm_h")
    if curve is None or curve.is_constant:
        return section
    shower: _Shower = section  # type: ignore[assignment]
    numbers: dict[str, object] = {}
    if shower.peak_mm_h is None:
        numbers["peak_mm_h"] = max(curve.values)
    if shower.front_mps is not None and shower.along is None:
        along = rates_along(curve, shower.front_mps, moment.time_s)
        numbers["along"] = along
        cloud = cloud_share(along, overcast_mm_h)
        for name in ("shadow_fade", "gloss_fade"):
            if getattr(shower, name) is None:
                numbers[name] = cloud
    return section.model_copy(update=numbers)
