"""Fog, haze and smog as a LiDAR meets them (Hahner et al. 2021, "Fog Simulation on Real LiDAR Point
Clouds in Adverse Weather", ICCV), from the equations of the paper.

The echo of a pulse P(t) = P0 sin^2(pi t / (2 tau)), 0 <= t <= 2 tau, whose half-power width is tau:

    hard, from a surface at R0   (rho / pi) exp(-2 T(R0)) / R0^2
    soft, of droplets, at R      beta int_0^{2w} sin^2(pi x / (2w)) exp(-2 alpha r) xi(r) / r^2 dx
                                 r = R - x, w = c tau / 2

T is the optical depth, alpha the extinction, beta = 0.046 / MOR the backscatter and MOR = ln(20) /
alpha the meteorological optical range; xi rises from 0 at overlap_from_m to 1 at overlap_full_m.
Ranges count from the pulse's middle, so that a surface at R0 is reported at R0 and not at R0 + w.

The smog is that of the images, thinned to the LiDAR's wavelength (`wavelength_factor`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass

import numpy as np

from augment.lidar_weather.sensors import LidarModel, signal
from augment.weather.smog import MAX_EXPONENT, SmogMedium
from recipes.schema import KOSCHMIEDER

VISIBLE_UM = 0.55
BACKSCATTER_MOR = 0.046  # beta x MOR, 1/sr
MOR_OPTICAL_DEPTH = math.log(20)
# Fog is clumpy: the backscatter of what a pulse fills varies about its mean as a gamma variate of
# this shape, by half of it.
CLUMPS = 4.0
_STEP_M, _FAR_M = 0.02, 15.0  # of the soft echo, tabulated
_PULSE_STEPS = 150
_DENSITY_STEP = 0.02  # of log alpha, within which the soft echo is one

# q(V) of Kim, McArthur and Korevaar (2001), V in km: sigma ~ wavelength^-q. Least V, slope, offset.
_KIM = ((50.0, 0.0, 1.6), (6.0, 0.0, 1.3), (1.0, 0.16, 0.34), (0.5, 1.0, -0.5), (0.0, 0.0, 0.0))


def wavelength_factor(extinction_per_m: float, wavelength_um: float = 0.905) -> float:
    """Extinction at the LiDAR's wavelength over that of visible light (0.55 um).

    (wavelength / 0.55 um)^-q with q by the visibility: 0 below 500 m, as fog's droplets are larger
    than either wavelength, up to 1.6 in clear air. At 905 nm: 1 in fog, 0.78 at 1 km, 0.52 at 6 km.
    Kim et al. fitted it to models of fog and haze; single measurements differ by some 20 %, and
    dry city smog of fine particles may have less in the infrared than fog of its visibility.
    """
    if extinction_per_m <= 0:
        return 1.0
    visibility_km = KOSCHMIEDER / extinction_per_m / 1000
    _, slope, offset = next(row for row in _KIM if visibility_km > row[0] or row[0] == 0)
    return (wavelength_um / VISIBLE_UM) ** -(slope * visibility_km + offset)


def medium_for(medium: SmogMedium, model: LidarModel) -> SmogMedium:
    """The images' smog as the LiDAR's light meets it."""
    factor = wavelength_factor(medium.sigma_per_m, model.wavelength_um)
    return dataclasses.replace(medium, sigma_per_m=factor * medium.sigma_per_m)


def optical_depth(
    medium: SmogMedium, ranges_m: np.ndarray, eyes_z_m: np.ndarray, points_z_m: np.ndarray
) -> np.ndarray:
    """tau [N] of beams from eyes to points, scene world: `augment.weather.smog.optical_depth`, with
    an eye for each point.
    """
    uniform = medium.sigma_per_m * ranges_m
    if medium.scale_height_m is None:
        return uniform
    a = (eyes_z_m - medium.base_z_m) / medium.scale_height_m
    b = (points_z_m - medium.base_z_m) / medium.scale_height_m
    difference = np.abs(b - a)
    small = difference < 1e-4
    safe = np.where(small, 1.0, difference)
    mean = np.where(small, 1 - difference / 2, -np.expm1(-safe) / safe)
    return uniform * np.exp(np.minimum(-np.minimum(a, b), MAX_EXPONENT)) * mean


def extinction_at(medium: SmogMedium, z_m: np.ndarray) -> np.ndarray:
    """alpha [N] at heights, 1/metre."""
    if medium.scale_height_m is None:
        return np.full(len(z_m), medium.sigma_per_m)
    height = (z_m - medium.base_z_m) / medium.scale_height_m
    return medium.sigma_per_m * np.exp(np.minimum(-height, MAX_EXPONENT))


@dataclass(frozen=True, eq=False)
class SoftEcho:
    """What droplets give back, by reported range. ranges_m [K]: rising. signal [K]: as
    `sensors.signal`, near_gain included. strongest [K]: the greatest signal up to each range.
    share [K]: of the whole echo, that comes from up to each range.
    """

    ranges_m: np.ndarray
    signal: np.ndarray
    strongest: np.ndarray
    share: np.ndarray


def soft_response(alpha_per_m: float, echoes_m: np.ndarray, model: LidarModel) -> np.ndarray:
    """The soft integral, without near_gain, at reported ranges [K]; midpoint rule over the pulse.

    An echo at R is reported at R - w. Droplets nearer than overlap_from_m are not seen.
    """
    w = model.pulse_m
    x = (np.arange(_PULSE_STEPS) + 0.5) * (2 * w / _PULSE_STEPS)
    r = echoes_m[:, None] + w - x
    seen = np.clip(
        (r - model.overlap_from_m) / (model.overlap_full_m - model.overlap_from_m), 0.0, 1.0
    )
    r = np.maximum(r, model.overlap_from_m)
    echo = np.sin(math.pi * x / (2 * w)) ** 2 * np.exp(-2 * alpha_per_m * r) * seen / r**2
    beta = BACKSCATTER_MOR * alpha_per_m / MOR_OPTICAL_DEPTH
    return beta * echo.sum(1) * (2 * w / _PULSE_STEPS)


@functools.lru_cache(maxsize=256)
def soft_echo(alpha_per_m: float, model: LidarModel) -> SoftEcho:
    """The soft echo tabulated; what comes from beyond _FAR_M is too weak to count."""
    ranges = np.arange(model.overlap_from_m, _FAR_M, _STEP_M)
    response = model.near_gain * soft_response(alpha_per_m, ranges, model)
    total = np.cumsum(response)
    return SoftEcho(
        ranges, response, np.maximum.accumulate(response), total / max(total[-1], 1e-300)
    )


@dataclass(frozen=True, eq=False)
class Scatter:
    """The strongest echo of the droplets before each return. signal [N]: as `sensors.signal`, 0
    where none can be. ranges_m [N]: where it is reported."""

    signal: np.ndarray
    ranges_m: np.ndarray


def scatter_before(
    medium: SmogMedium,
    eyes_z_m: np.ndarray,
    ends_m: np.ndarray,
    model: LidarModel,
    rng: np.random.Generator,
) -> Scatter:
    """What comes back from the smog before surfaces at ends_m [N].

    Its strength varies with the clumps that a beam meets (CLUMPS), and where along the echo the
    strongest of them is, is drawn from the echo's own shape. N numbers of each are drawn whatever
    the density, so that denser smog differs by nothing else.
    """
    count = len(ends_m)
    clump = rng.standard_gamma(CLUMPS, count) / CLUMPS
    where = rng.random(count)
    alpha = extinction_at(medium, eyes_z_m)
    out = Scatter(np.zeros(count), np.zeros(count))
    usable = (alpha > 0) & (ends_m > model.overlap_from_m) & np.isfinite(alpha)
    group = np.rint(np.log(np.where(usable, alpha, 1.0)) / _DENSITY_STEP).astype(np.int64)
    low, high = (group[usable].min(), group[usable].max()) if usable.any() else (0, -1)
    for number in range(low, high + 1):
        rows = np.flatnonzero(usable & (group == number)) if high > low else np.flatnonzero(usable)
        if not len(rows):
            continue
        mean = medium.sigma_per_m if medium.scale_height_m is None else _alpha_of(number)
        echo = soft_echo(float(mean), model)
        last = np.clip(
            ((ends_m[rows] - echo.ranges_m[0]) / _STEP_M).astype(np.int64),
            0,
            len(echo.ranges_m) - 1,
        )
        out.signal[rows] = echo.strongest[last] * clump[rows]
        at = np.interp(where[rows] * echo.share[last], echo.share, echo.ranges_m)
        out.ranges_m[rows] = np.minimum(at, ends_m[rows])
    return out


def _alpha_of(group: int) -> float:
    return math.exp(group * _DENSITY_STEP)


def apparent_reflectance(power: np.ndarray, ranges_m: np.ndarray) -> np.ndarray:
    """The reflectance of a surface whose echo from that range is as strong: inverse of `signal`."""
    return power / signal(np.ones_like(power), np.maximum(ranges_m, 1e-3))
