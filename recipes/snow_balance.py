"""Water and depth of lying snow as functions of time, in closed form.

In: the courses of snowfall, rain and temperature (`recipes.curve.Curve`), and the snow at their
begin. Out: `SnowLayer` at any time. `recipes.snow` puts it into the fields of its section.

Water. Snow falls at the rate P, and melts at the rate M while there is any:

    M = DEGREE_DAY max(T, 0) + rain c max(T, 0) / L                    mm of water per time

T is the temperature of the surface. With X(t) = W0 + the integral of P - M, the water that lies is
W = X - min(0, the least X so far): what would melt of bare ground melts nothing. P and M are
polynomials between the curves' points, so X and its least value are exact, and nothing steps.
Water that melts runs off.

A warm road first spends its heat. A layer as deep as a road's changes its temperature by as much as
melts `STORED_MM_PER_K` for each kelvin above zero: X starts lower by that, and has this floor.

Depth. Fresh snow has the density of Hedstrom and Pomeroy (1998), "Measurements and modelling of
snow interception in the boreal forest", Hydrological Processes 12,

    rho = 67.92 + 51.25 exp(T / 2.59)                                   kg/m3, T of the air

It settles by a constant share a day. Melt takes water at the mean density of all snow since the
ground was bare, so depth = W x (settled depth of what fell) / (water that fell).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

from recipes import polynomial
from recipes.curve import Curve
from recipes.polynomial import Polynomial

SECONDS_PER_HOUR = 3600.0
SECONDS_PER_DAY = 86400.0
# Water that melts per kelvin above zero, mm a day; the literature has 2 to 6. Assumed.
DEGREE_DAY_MM = 4.0
# Heat of rain: specific heat of water, J/(kg K), over the latent heat of melting, J/kg.
RAIN_MELT_PER_K = 4186.0 / 334e3
# Share of its depth that fresh snow loses in a day as it settles. Assumed.
SETTLING_A_DAY = 0.1
# Largest density of fresh snow, kg/m3: wet snow. Assumed; the formula is of temperatures below 0.
MAX_FRESH_DENSITY = 200.0
# Water that a road's heat melts per kelvin above zero, mm: 4 cm of asphalt of 2.1 MJ/(m3 K), which
# cool as the snow falls. Assumed.
STORED_MM_PER_K = 0.04 * 2.1e6 / 334e3
# Nodes and weights of Gauss and Legendre's rule on [-1, 1], 5 points.
_NODES = (0.0, 0.5384693101056831, -0.5384693101056831, 0.9061798459386640, -0.9061798459386640)
_WEIGHTS = (
    0.5688888888888889,
    0.4786286704993665,
    0.4786286704993665,
    0.2369268850561891,
    0.2369268850561891,
)
# Parts of a stretch between two points to which the rule is applied: errors stay below 1e-7.
_NUM_PARTS = 4

_ALWAYS_ZERO = Curve.constant(0.0)


@dataclass(frozen=True)
class SnowWeather:
    """The weather that snow lies in."""

    snowfall_mm_h: Curve
    """Water that falls as snow, mm/h."""
    rain_mm_h: Curve
    """Rain, mm/h."""
    air_c: Curve
    """Temperature of the air, degrees Celsius."""
    begin_s: float
    """Time up to which the snow keeps its depth, seconds."""
    begin_depth_m: float = 0.0
    """Depth of the snow then, metres."""


@dataclass(frozen=True)
class Surface:
    """A surface that snow lies on."""

    warmer_k: Curve = _ALWAYS_ZERO
    """How much warmer it is than the air, kelvin."""
    has_heat: bool = False
    """True for a road, whose heat melts the first snow."""


_GROUND = Surface()


@dataclass(frozen=True)
class SnowLayer:
    """Snow on a surface at a time."""

    depth_m: float
    """Depth, metres."""
    water_mm: float
    """Water in the layer."""
    fallen_mm: float
    """Water that has fallen as snow since the begin, and that lay there then."""
    melted_mm: float
    """Water that has melted since the begin: fallen_mm less water_mm."""


def fresh_density(air_c: float) -> float:
    """Return the density of fresh snow, kg/m3, by the air's temperature in degrees Celsius."""
    return min(67.92 + 51.25 * math.exp(min(air_c, 50.0) / 2.59), MAX_FRESH_DENSITY)


@lru_cache(maxsize=512)
def layer_at(time_s: float, weather: SnowWeather, surface: Surface = _GROUND) -> SnowLayer:
    """Return the snow on a surface at a time.

    Args:
        time_s: the time, seconds of the weather.
        weather: the weather up to then, and the snow at its begin.
        surface: the surface; that of grass, roofs and all else but roads by default.
    """
    end_s = max(time_s, weather.begin_s)
    begin_mm = weather.begin_depth_m * fresh_density(weather.air_c.value(weather.begin_s))
    floor_mm = 0.0
    if surface.has_heat and begin_mm == 0:
        first_s = first_snow_s(weather)
        surface_c = weather.air_c.value(first_s) + surface.warmer_k.value(first_s)
        floor_mm = -STORED_MM_PER_K * max(surface_c, 0.0)
    total_mm = begin_mm + floor_mm  # X of the module's docstring
    potential_mm = 0.0  # integral of M
    least_mm = 0.0  # the least X - floor so far, 0 at most
    bare_s = weather.begin_s  # last time at which the ground was bare, or the begin
    fallen_mm = begin_mm
    is_begin_left = True
    for begin, end, snowfall, melt in _stretches(weather, surface, weather.begin_s, end_s):
        change = polynomial.integral(polynomial.add(snowfall, polynomial.scale(melt, -1.0)))
        for t in (*polynomial.roots(polynomial.derivative(change), end - begin), end - begin):
            excess_mm = total_mm + polynomial.value(change, t) - floor_mm
            if excess_mm <= least_mm:
                least_mm = excess_mm
                bare_s = begin + t
                is_begin_left = False
        total_mm += polynomial.value(change, end - begin)
        fallen_mm += polynomial.value(polynomial.integral(snowfall), end - begin)
        potential_mm += polynomial.value(polynomial.integral(melt), end - begin)
    water_mm = max(total_mm - least_mm, 0.0)
    volume = _depth_per_water(weather, bare_s, end_s, begin_mm if is_begin_left else 0.0)
    return SnowLayer(
        depth_m=water_mm * volume,
        water_mm=water_mm,
        fallen_mm=fallen_mm,
        melted_mm=potential_mm + least_mm + min(total_mm - least_mm, 0.0) - floor_mm,
    )


def first_snow_s(weather: SnowWeather) -> float:
    """Return the time at which snow begins to fall, or the begin of the weather without any."""
    times_s = sorted({weather.begin_s, *weather.snowfall_mm_h.times_s})
    for begin, end in itertools.pairwise(t for t in times_s if t >= weather.begin_s):
        if weather.snowfall_mm_h.largest(begin, end) > 0:
            return begin
    return times_s[-1] if weather.snowfall_mm_h.value(times_s[-1]) > 0 else weather.begin_s


def largest_depth_m(weather: SnowWeather, end_s: float) -> float:
    """Return the largest depth at any point of the weather's curves, or at the end, metres.

    Args:
        weather: the weather.
        end_s: the end, seconds.
    """
    curves = (weather.snowfall_mm_h, weather.rain_mm_h, weather.air_c)
    times_s = {weather.begin_s, end_s, *(t for curve in curves for t in curve.times_s)}
    return max(layer_at(time_s, weather).depth_m for time_s in sorted(times_s))


def _depth_per_water(weather: SnowWeather, bare_s: float, end_s: float, begin_mm: float) -> float:
    """Return the depth per water of the snow that has fallen since the ground was bare, m/mm.

    Args:
        weather: the weather.
        bare_s: last time at which the ground was bare.
        end_s: the time.
        begin_mm: water that lay at `bare_s` all the same: that of the weather's begin.
    """
    settling_per_s = -math.log(1 - SETTLING_A_DAY) / SECONDS_PER_DAY

    def fresh_m(time_s: float) -> float:
        """Return the settled depth of what fell at a time, metres an hour."""
        rate_mm_h = weather.snowfall_mm_h.value(time_s)
        age = math.exp(-settling_per_s * (end_s - time_s))
        return rate_mm_h / fresh_density(weather.air_c.value(time_s)) * age

    water_mm = begin_mm + weather.snowfall_mm_h.integral(bare_s, end_s) / SECONDS_PER_HOUR
    if water_mm <= 1e-12:  # all of it is fresh
        return 1 / fresh_density(weather.air_c.value(end_s))
    depth_m = math.exp(-settling_per_s * (end_s - bare_s)) * begin_mm
    depth_m /= fresh_density(weather.air_c.value(weather.begin_s))
    times_s = _times(bare_s, end_s, weather.snowfall_mm_h, weather.air_c)
    for begin, end in itertools.pairwise(times_s):
        depth_m += _quadrature(fresh_m, begin, end) / SECONDS_PER_HOUR
    return depth_m / water_mm


def _quadrature(function: Callable[[float], float], begin: float, end: float) -> float:
    """Return the integral of a smooth function, by Gauss and Legendre's rule."""
    half = (end - begin) / (2 * _NUM_PARTS)
    middles = (begin + (2 * part + 1) * half for part in range(_NUM_PARTS))
    return half * math.fsum(
        weight * function(middle + node * half)
        for middle in middles
        for node, weight in zip(_NODES, _WEIGHTS, strict=True)
    )


# ---- Rates between the points of the curves, as polynomials of the time since the first one ------


def _stretches(
    weather: SnowWeather, surface: Surface, begin_s: float, end_s: float
) -> Iterator[tuple[float, float, Polynomial, Polynomial]]:
    """Yield stretches of time with the rates of snowfall and of melt, mm/s."""
    curves = (weather.snowfall_mm_h, weather.rain_mm_h, weather.air_c, surface.warmer_k)
    for begin, end in itertools.pairwise(_times(begin_s, end_s, *curves)):
        snowfall, rain, air, warmer = (
            next(curve.pieces(begin, end)).coefficients for curve in curves
        )
        celsius = polynomial.add(air, warmer)
        snowfall = polynomial.scale(snowfall, 1 / SECONDS_PER_HOUR)
        per_kelvin = polynomial.add(
            (DEGREE_DAY_MM / SECONDS_PER_DAY,),
            polynomial.scale(rain, RAIN_MELT_PER_K / SECONDS_PER_HOUR),
        )
        zeros = [0.0, *polynomial.roots(celsius, end - begin), end - begin]
        for first, last in itertools.pairwise(zeros):
            if last <= first:
                continue
            is_warm = polynomial.value(celsius, (first + last) / 2) > 0
            melt = polynomial.multiply(per_kelvin, celsius) if is_warm else (0.0,)
            yield (
                begin + first,
                begin + last,
                polynomial.shift(snowfall, first),
                polynomial.shift(melt, first),
            )


def _times(begin_s: float, end_s: float, *curves: Curve) -> list[float]:
    """Return the begin, the points of curves inside, and the end; only the begin if no later."""
    if end_s <= begin_s:
        return [begin_s]
    inner = {t for curve in curves for t in curve.times_s if begin_s < t < end_s}
    return [begin_s, *sorted(inner), end_s]
