"""Water on a road over time: film, puddles, wheel tracks and first drops, in closed form.

Every store of water gains from the rain, loses to the air, and has a largest level:

    dw/dt = gain R(t) - E        0 <= w <= capacity

R is the rate of the rain and E the evaporation, both in mm/h. Between two points of its curve, R is
a polynomial that only rises or only falls. Cut where gain R = E, each part fills or empties the
store, so its level follows from one exact integral and one clamp. There is no step of time: any
moment alone has the level that it has in sequence.

- The film fills at R - E. Above its capacity water runs off at once; below, only the air takes it.
- Puddles collect the rain of a larger area (their catchment). They do not drain.
- Stains of drops are a thin film of their own, which the first second of rain begins to fill.
- Wheels push water out of their tracks while the air takes more than the rain brings.

Capacities: NORTRIP's road model (film 0.6 mm, above which a road drains at once). Catchment, depth
of puddles and the time in which tracks clear are assumed, not measured.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from recipes.curve import Curve, Piece
from recipes.moment import Air, Moment

# Film that a road holds; more water runs off at once (NORTRIP, drainage of type 2), mm.
MAX_FILM_MM = 0.6
# Mean depth of full puddles, mm; assumed.
FULL_PUDDLE_MM = 5.0
# Area whose rain runs into a puddle, over the puddle's area; assumed.
CATCHMENT = 5.0
# Share of a road's area that hollows take, in its water balance; assumed.
HOLLOW_SHARE = 0.05
# Water in stains of drops above which they do not grow, mm; assumed. exp(-0.2 / 0.0316) is 0.2 %.
MAX_STAIN_MM = 0.2
# Radius of the stain of a drop, metres, at 10 mm/h.
STAIN_RADIUS_M = 0.003
# Drops wider than 0.5 mm that meet level ground at 10 mm/h, 1/(m2 s): Marshall and Palmer's sizes
# with Atlas' speeds.
_DROPS_PER_M2_S = 3114.0
# Depth of the water in a stain, mm: 10 mm/h over the area that its drops cover in that time. A
# drop covers as much as its volume allows, so the depth holds for all rates.
STAIN_DEPTH_MM = 10 / 3600 / (_DROPS_PER_M2_S * math.pi * STAIN_RADIUS_M**2)
# Share of the film that wheels leave in their tracks; assumed.
TRACK_FILM_SHARE = 0.3
# Water that wheels push out of their tracks when the road is full, mm.
_MAX_TRACK_MM = (1 - TRACK_FILM_SHARE) * MAX_FILM_MM
# Time in which traffic clears full tracks once the rain ends, hours: some 20 vehicles; assumed.
_TRACK_CLEARING_H = 2 / 60
# Number of parts into which the time between two points of the air's curves is cut. Evaporation is
# constant in each; air that does not change is exact.
_NUM_AIR_PARTS = 16

# ---- Evaporation ---------------------------------------------------------------------------------

# Karman's constant.
_KARMAN = 0.4
# Height of the wind over the ground, metres, as weather services state it.
_WIND_HEIGHT_M = 10.0
# Height of the air's moisture over the ground, metres.
_MOISTURE_HEIGHT_M = 2.0
# Roughness lengths of a road for momentum and for moisture, metres (NORTRIP).
_ROUGHNESS_M = 0.01
_MOISTURE_ROUGHNESS_M = 1e-5
# Resistance of the air to moisture, times the wind.
_RESISTANCE = (
    math.log(_WIND_HEIGHT_M / _ROUGHNESS_M)
    * math.log(_MOISTURE_HEIGHT_M / _MOISTURE_ROUGHNESS_M)
    / _KARMAN**2
)
# Least wind: a calm road still dries, m/s.
_MIN_WIND_M_S = 0.2
# Density of air, kg/m3.
_AIR_KG_M3 = 1.225
# Pressure of air, hPa.
_PRESSURE_HPA = 1013.25


def evaporation_mm_h(air: Air) -> float:
    """Return the water that a wet road loses to the air, mm/h; never below 0 (no dew).

    E = rho (q_s(T_road) - q) / r, r = ln(z / z0) ln(z_q / z0q) / (kappa^2 U), the bulk formula.
    """
    return _evaporation(air.temperature_c, air.humidity, air.wind_m_s, air.road_warmer_k)


def _evaporation(
    temperature_c: float, humidity: float, wind_m_s: float, road_warmer_k: float
) -> float:
    """Return `evaporation_mm_h` of the numbers of the air."""
    conductance_m_s = max(wind_m_s, _MIN_WIND_M_S) / _RESISTANCE
    moisture = _saturated_moisture(temperature_c + road_warmer_k)
    moisture -= humidity * _saturated_moisture(temperature_c)
    return max(3600 * _AIR_KG_M3 * moisture * conductance_m_s, 0.0)


def _saturated_moisture(temperature_c: float) -> float:
    """Return the water in saturated air, kg/kg (Magnus' formula over water)."""
    vapour_hpa = 6.112 * math.exp(17.62 * temperature_c / (243.12 + temperature_c))
    return 0.622 * vapour_hpa / _PRESSURE_HPA


class AirCurves(NamedTuple):
    """The air over time."""

    temperature_c: Curve
    """Temperature of the air, degrees Celsius."""
    humidity: Curve
    """Relative humidity, 0 to 1."""
    wind_m_s: Curve
    """Speed of the wind."""
    road_warmer_k: Curve
    """How much warmer the road is than the air, kelvin."""

    @staticmethod
    def constant(air: Air) -> AirCurves:
        """Return air that does not change."""
        numbers = (air.temperature_c, air.humidity, air.wind_m_s, air.road_warmer_k)
        return AirCurves(*map(Curve.constant, numbers))

    @staticmethod
    def at(moment: Moment) -> AirCurves:
        """Return the air of a moment's history; a recipe without air has Air's defaults."""
        air = moment.air or Air()
        names = AirCurves._fields
        return AirCurves(*(moment.curve(f"weather.air.{n}", getattr(air, n)) for n in names))

    def evaporation_mm_h(self, time_s: float) -> float:
        """Return the evaporation at a time, mm/h."""
        return _evaporation(*(curve.value(time_s) for curve in self))


# ---- Rain and evaporation in parts ---------------------------------------------------------------


class _Part(NamedTuple):
    """Time in which the rain's rate is one monotone polynomial and the evaporation is constant."""

    rate: Piece
    """Rate of the rain, mm/h, with times in seconds."""
    evaporation_mm_h: float
    """Evaporation."""


def _parts(rate: Curve, air: AirCurves, end_s: float) -> Iterator[_Part]:
    """Yield all parts from the first change of rain or air to a time."""
    air_times = sorted({t for curve in air if not curve.is_constant for t in curve.times_s})
    times: list[float] = []
    for first, second in itertools.pairwise(air_times):
        step = (second - first) / _NUM_AIR_PARTS
        times += [first + k * step for k in range(_NUM_AIR_PARTS)]
    times += air_times[-1:]
    begin_s = min([rate.times_s[0], *times[:1]])
    cuts = [begin_s, *(t for t in times if begin_s < t < end_s), end_s]
    for start, end in itertools.pairwise(cuts):
        if end > start:
            evaporation = air.evaporation_mm_h((start + end) / 2)
            for piece in rate.pieces(start, end):
                yield _Part(piece, evaporation)


def _crossing(piece: Piece, value: float) -> float | None:
    """Return the time at which a monotone polynomial passes a value; None if it does not."""
    low_s = piece.start_s
    high_s = piece.end_s
    first = piece.value(low_s) - value
    last = piece.value(high_s) - value
    if first * last >= 0:
        return None
    if len(piece.coefficients) == 2:
        return low_s + (value - piece.coefficients[0]) / piece.coefficients[1]
    while True:
        middle_s = 0.5 * (low_s + high_s)
        if not low_s < middle_s < high_s:
            return middle_s
        if (piece.value(middle_s) - value) * first > 0:
            low_s = middle_s
        else:
            high_s = middle_s


class _Span(NamedTuple):
    """Part in which a store only fills or only empties."""

    first_mm_h: float
    """Rate of the rain at its begin."""
    last_mm_h: float
    """Rate of the rain at its end."""
    rain_mm: float
    """Water that falls in it."""
    loss_mm: float
    """Water that evaporates in it from a store that has some."""
    hours: float
    """Its length."""


def _spans(part: _Part, gain: float) -> list[_Span]:
    """Cut a part where the store's gain equals its loss."""
    piece = part.rate
    crossing = _crossing(piece, part.evaporation_mm_h / gain)
    times = [piece.start_s, *([] if crossing is None else [crossing]), piece.end_s]
    spans: list[_Span] = []
    fallen = 0.0
    for start, end in itertools.pairwise(times):
        hours = (end - start) / 3600
        fallen_before = fallen
        fallen = piece.integral(end)
        spans.append(
            _Span(
                piece.value(start),
                piece.value(end),
                (fallen - fallen_before) / 3600,
                part.evaporation_mm_h * hours,
                hours,
            )
        )
    return spans


# ---- Stores of water -----------------------------------------------------------------------------


@dataclass
class _Store:
    """A store of water up to a moment."""

    capacity_mm: float
    """Largest level."""
    gain: float
    """Area whose rain it collects, over its area."""
    level_mm: float = 0.0
    """Level of the water."""
    peak_mm: float = 0.0
    """Largest level since it was last dry."""
    peak_rate_mm_h: float = 0.0
    """Largest rate of rain since it was last dry."""
    overflow_mm: float = 0.0
    """Water that ran over."""
    evaporated_mm: float = 0.0
    """Water that the air took."""

    def settle(self, rate_mm_h: float, evaporation_mm_h: float) -> None:
        """Set the level that a rate leads to if it has lasted for ever."""
        is_full = self.gain * rate_mm_h > evaporation_mm_h
        self.level_mm = self.capacity_mm if is_full else 0.0
        self.peak_mm = self.level_mm
        self.peak_rate_mm_h = rate_mm_h

    def advance(self, spans: list[_Span]) -> None:
        """Follow the level through a part that `_spans` has cut for the store's gain."""
        for span in spans:
            if self.level_mm == 0:
                self.peak_rate_mm_h = 0.0
                self.peak_mm = 0.0
            gained_mm = self.gain * span.rain_mm
            level_mm = self.level_mm + gained_mm - span.loss_mm
            self.peak_rate_mm_h = max(self.peak_rate_mm_h, span.first_mm_h, span.last_mm_h)
            if level_mm < 0:
                self.evaporated_mm += self.level_mm + gained_mm
                level_mm = 0.0
                self.peak_rate_mm_h = span.last_mm_h
                self.peak_mm = 0.0
            else:
                self.evaporated_mm += span.loss_mm
                self.overflow_mm += max(level_mm - self.capacity_mm, 0.0)
                level_mm = min(level_mm, self.capacity_mm)
            self.level_mm = level_mm
            self.peak_mm = max(self.peak_mm, level_mm)


@dataclass(frozen=True)
class RoadState:
    """Water on a road at a moment."""

    film_mm: float
    """Film of water on the road."""
    peak_film_mm: float
    """Largest film since the road was last dry."""
    peak_rate_mm_h: float
    """Largest rate of rain since then."""
    puddle_fill: float
    """Level of the puddles: 0 dry, 1 full."""
    puddle_rate_mm_h: float
    """Largest rate of rain since the puddles were last dry."""
    tracks: float
    """How far wheels have pushed the water out of their tracks: 0 not, 1 as far as they do."""
    spots: float
    """Share of the area that drops of this shower have stained, 0 to 1."""


def spot_share(stain_mm: float) -> float:
    """Return the share of the area under stains, from the water in them: 1 - exp(-N pi r^2)."""
    return math.expm1(-stain_mm / STAIN_DEPTH_MM) / math.expm1(-MAX_STAIN_MM / STAIN_DEPTH_MM)


def road_state(rate: Curve, air: AirCurves, time_s: float) -> RoadState:
    """Return the water on a road at a time.

    Args:
        rate: rate of the rain, mm/h. Its first number has lasted for ever before its first point.
        air: the air.
        time_s: the time, seconds.
    """
    film, puddles = _settled_stores(rate, air, time_s)
    stains = _Store(MAX_STAIN_MM, 1.0)
    stains.settle(film.peak_rate_mm_h if film.level_mm > 0 else 0.0, 0.0)
    track_mm = _MAX_TRACK_MM if film.level_mm > 0 else 0.0
    for part in _parts(rate, air, time_s):
        spans = _spans(part, 1.0)
        film.advance(spans)
        puddles.advance(_spans(part, CATCHMENT))
        stains.advance(spans)
        for span in spans:
            gained_mm = span.rain_mm - span.loss_mm
            if gained_mm > 0:
                track_mm = min(track_mm + gained_mm, _MAX_TRACK_MM)
            else:
                track_mm = max(track_mm - _MAX_TRACK_MM * span.hours / _TRACK_CLEARING_H, 0.0)
    return RoadState(
        film_mm=film.level_mm,
        peak_film_mm=film.peak_mm,
        peak_rate_mm_h=film.peak_rate_mm_h,
        puddle_fill=puddles.level_mm / FULL_PUDDLE_MM,
        puddle_rate_mm_h=puddles.peak_rate_mm_h,
        tracks=1 - track_mm / _MAX_TRACK_MM,
        spots=spot_share(stains.level_mm),
    )


def _settled_stores(rate: Curve, air: AirCurves, time_s: float) -> tuple[_Store, _Store]:
    """Return film and puddles as they were before the first change."""
    part = next(_parts(rate, air, time_s), None)
    begin_s = time_s if part is None else part.rate.start_s
    film = _Store(MAX_FILM_MM, 1.0)
    puddles = _Store(FULL_PUDDLE_MM, CATCHMENT)
    evaporation = air.evaporation_mm_h(begin_s)
    for store in (film, puddles):
        store.settle(rate.value(begin_s), evaporation)
    return film, puddles


# ---- Balance -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WaterBalance:
    """Water of one square metre of road up to a moment, millimetres.

    rain_mm = film_mm + puddle_mm + drained_mm + evaporated_mm
    """

    rain_mm: float
    """Water that has fallen."""
    film_mm: float
    """Change of the film."""
    puddle_mm: float
    """Change of the puddles."""
    drained_mm: float
    """Water that has run off."""
    evaporated_mm: float
    """Water that the air has taken."""


def water_balance(rate: Curve, air: AirCurves, time_s: float) -> WaterBalance:
    """Return where the rain has gone since the first point of the curves.

    HOLLOW_SHARE of the road is under puddles and CATCHMENT times as much drains into them; the
    rest holds the film.
    """
    film, puddles = _settled_stores(rate, air, time_s)
    film_mm = film.level_mm
    puddle_mm = puddles.level_mm
    rain_mm = 0.0
    for part in _parts(rate, air, time_s):
        rain_mm += part.rate.integral(part.rate.end_s) / 3600
        film.advance(_spans(part, 1.0))
        puddles.advance(_spans(part, CATCHMENT))
    film_share = 1 - HOLLOW_SHARE * CATCHMENT
    return WaterBalance(
        rain_mm,
        film_share * (film.level_mm - film_mm),
        HOLLOW_SHARE * (puddles.level_mm - puddle_mm),
        film_share * film.overflow_mm + HOLLOW_SHARE * puddles.overflow_mm,
        film_share * film.evaporated_mm + HOLLOW_SHARE * puddles.evaporated_mm,
    )
