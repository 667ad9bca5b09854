"""Intensity of lamps by direction: tables of candela, packed for kernels, and the standard ones.

A direction has an elevation U (degrees up from the plane of axis and right, -90 to 90) and an
azimuth R (degrees from the axis towards the right, -180 to 180). A packed table holds values at
nodes that are fine near the axis, where beams have their edges: rows over U, columns over R, both
spaced by the square root of a diamond angle (`pattern_kernels`). Between nodes it is bilinear.
A standard table is 1 in its brightest direction.

Sources: dipped beam: UN R112 class B, test points and limits; high beam: UN R112 and R149; signal
lamps: UN R7, R38, R6 and R87 in R148. Values between the test points are assumed, as are the street
lamp's shape across the road and the signal's width.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Float32, Float64

from augment.lamps.pattern_kernels import ROOT_OFFSET

# Rows of a table. Odd, so that there is a row at U = 0.
NUM_ROWS = 129
# Columns of a table. Odd, so that there is a column at R = 0.
NUM_COLUMNS = 129
# Steps of elevation over which means are taken.
_NUM_MEAN_ROWS = 240
# Steps of azimuth over which means are taken.
_NUM_MEAN_COLUMNS = 480
# Largest intensity of the dipped beam, candela; `dipped_beam_cd` says where.
DIPPED_PEAK_CD = 14_000.0
# Stray light of a dipped beam above its edge, candela (UN R112: B50L at most 350).
DIPPED_STRAY_CD = 300.0
# Elevation of the dipped beam's edge on the traffic's far side, degrees: an aim of -1 %.
DIPPED_EDGE_DEG = -math.degrees(math.atan(0.01))
# Angle at which the edge rises on the kerb side, degrees.
DIPPED_KINK_DEG = 15.0
# Azimuth at which the rising edge becomes level, degrees.
DIPPED_RISE_END_DEG = 4.3
# Width of the fall of intensity above the edge, degrees: exp(-(e / width)²).
DIPPED_EDGE_WIDTH_DEG = 0.35
# Intensity of the batwing at the nadir, candela per 1,000 lumens.
BATWING_NADIR_CD = 250.0
# Largest intensity of the batwing, candela per 1,000 lumens.
BATWING_PEAK_CD = 490.0


class Pattern(IntEnum):
    """Rows of `standard_tables`."""

    DIPPED_RIGHT = 0
    """Dipped beam for traffic that keeps right."""
    DIPPED_LEFT = 1
    """Dipped beam for traffic that keeps left."""
    HIGH_BEAM = 2
    FRONT_FOG = 3
    REAR = 4
    """Tail, stop and rear fog lamps, indicators."""
    DAYTIME = 5
    STREET = 6
    """Batwing, 1 at its brightest; the axis runs along the road."""
    SIGNAL = 7
    LAMBERT = 8
    """Cosine of the angle to the axis: a lit window, a glowing area."""
    ISOTROPIC = 9
    """The same in all directions."""


CandelaByAngle = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of U and R, degrees, arrays of one shape; returns candela, or another unit."""


# ---- Packing -------------------------------------------------------------------------------------


def node_angles_deg() -> tuple[Float64[np.ndarray, "V"], Float64[np.ndarray, "U"]]:
    """Return the elevations of a table's rows, and the azimuths of its columns, degrees."""
    root = math.sqrt(ROOT_OFFSET)
    rows = np.linspace(-1, 1, NUM_ROWS)
    fold = (np.abs(rows) * (math.sqrt(1 + ROOT_OFFSET) - root) + root) ** 2 - ROOT_OFFSET
    up_deg = np.copysign(np.degrees(np.arctan2(fold, 1 - fold)), rows)
    columns = np.linspace(-1, 1, NUM_COLUMNS)
    fold = (np.abs(columns) * (math.sqrt(2 + ROOT_OFFSET) - root) + root) ** 2 - ROOT_OFFSET
    is_behind = fold > 1
    side = np.where(is_behind, 2 - fold, fold)
    ahead = np.where(is_behind, fold - 1, 1 - fold)
    right_deg = np.degrees(np.arctan2(side, np.where(is_behind, -ahead, ahead)))
    return up_deg, np.copysign(right_deg, columns)


def pack_pattern(candela_at: CandelaByAngle) -> Float32[np.ndarray, "V U"]:
    """Return the packed table of a function of direction.

    Args:
        candela_at: values by U and R, degrees.

    Raises:
        ValueError: a value is negative or not finite.
    """
    up_deg, right_deg = node_angles_deg()
    up_grid, right_grid = np.meshgrid(up_deg, right_deg, indexing="ij")
    values = np.asarray(candela_at(up_grid, right_grid), np.float64)
    if not np.isfinite(values).all() or (values < 0).any():
        raise ValueError("a lamp's intensities must be finite and >= 0 in all directions")
    # The mean of both ends, as they are the same direction.
    values[:, [0, -1]] = values[:, [0, -1]].mean(1, keepdims=True)
    return values.astype(np.float32)


def pattern_value(
    table: Float32[np.ndarray, "V U"], directions: Float[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N"]:
    """Return a pattern's values in directions: the definition of `patterns_of_eight`.

    Args:
        table: a packed table.
        directions: unit vectors from the lamp: along its axis, to its right, along its up.
    """
    forward, right, up = directions.astype(np.float64).T
    root = math.sqrt(ROOT_OFFSET)
    level = np.sqrt(forward**2 + right**2)
    fold = np.abs(up) / np.maximum(np.abs(up) + level, 1e-30)
    row = (np.sqrt(fold + ROOT_OFFSET) - root) / (math.sqrt(1 + ROOT_OFFSET) - root)
    fold = np.abs(right) / np.maximum(np.abs(forward) + np.abs(right), 1e-30)
    fold = np.where(forward < 0, 2 - fold, fold)
    column = (np.sqrt(fold + ROOT_OFFSET) - root) / (math.sqrt(2 + ROOT_OFFSET) - root)
    last_row = table.shape[0] - 1
    last_column = table.shape[1] - 1
    row = np.clip((np.where(up < 0, -row, row) + 1) * 0.5 * last_row, 0, last_row)
    column = np.clip((np.where(right < 0, -column, column) + 1) * 0.5 * last_column, 0, last_column)
    i = np.minimum(row.astype(np.int64), last_row - 1)
    j = np.minimum(column.astype(np.int64), last_column - 1)
    v = row - i
    u = column - j
    below = table[i, j] * (1 - u) + table[i, j + 1] * u
    above = table[i + 1, j] * (1 - u) + table[i + 1, j + 1] * u
    return below * (1 - v) + above * v


def directions_at(
    up_deg: Float[np.ndarray, "*N"], right_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N 3"]:
    """Return unit vectors (along the axis, right, up) of elevations and azimuths in degrees."""
    up = np.radians(up_deg)
    right = np.radians(right_deg)
    return np.stack([np.cos(up) * np.cos(right), np.cos(up) * np.sin(right), np.sin(up)], -1)


def mean_over_directions(table: Float32[np.ndarray, "V U"]) -> float:
    """Return the mean of a pattern over the sphere: its flux / 4 pi."""
    return float(_moments(table)[0])


def spread_deg(table: Float32[np.ndarray, "V U"]) -> float:
    """Return the standard deviation of a beam about its own middle, per axis, degrees.

    It weighs directions by their intensity within 45 degrees of the axis, where the halo is.
    """
    return float(_moments(table)[1])


def _moments(table: np.ndarray) -> tuple[float, float]:
    """Return the mean over the sphere, and the spread in degrees."""
    up_deg = (np.arange(_NUM_MEAN_ROWS) + 0.5) / _NUM_MEAN_ROWS * 180 - 90
    # Steps are spaced evenly in the cube root of the angle, so that a narrow beam is not missed.
    fraction = (np.arange(_NUM_MEAN_COLUMNS) + 0.5) / _NUM_MEAN_COLUMNS * 2 - 1
    up_fraction = up_deg / 90
    up_fine_deg = 90 * up_fraction**3
    right_deg = 180 * fraction**3
    solid_angles = (np.cos(np.radians(up_fine_deg)) * up_fraction**2)[:, None] * fraction[
        None, :
    ] ** 2
    up_grid, right_grid = np.meshgrid(up_fine_deg, right_deg, indexing="ij")
    directions = directions_at(up_grid.ravel(), right_grid.ravel())
    values = pattern_value(table, directions).reshape(up_grid.shape)
    mean = float((values * solid_angles).sum() / solid_angles.sum())
    weights = values * solid_angles * (np.hypot(up_grid, right_grid) < 45)
    total = weights.sum()
    if total <= 0:
        return mean, 90.0
    middle_up = (weights * up_grid).sum() / total
    middle_right = (weights * right_grid).sum() / total
    squares = (up_grid - middle_up) ** 2 + (right_grid - middle_right) ** 2
    return mean, max(math.sqrt(float((weights * squares).sum() / total) / 2), 0.1)


@functools.cache
def standard_tables() -> Float32[np.ndarray, "K V U"]:
    """Return the packed tables of all `Pattern`s, each 1 in its brightest direction."""
    functions: dict[Pattern, CandelaByAngle] = {
        Pattern.DIPPED_RIGHT: dipped_beam_cd,
        Pattern.DIPPED_LEFT: lambda up, right: dipped_beam_cd(up, -right),
        Pattern.HIGH_BEAM: high_beam_share,
        Pattern.FRONT_FOG: front_fog_share,
        Pattern.REAR: rear_lamp_share,
        Pattern.DAYTIME: daytime_share,
        Pattern.STREET: batwing_cd_per_klm,
        Pattern.SIGNAL: signal_share,
        Pattern.LAMBERT: lambert_share,
        Pattern.ISOTROPIC: lambda up, right: np.ones(np.broadcast(up, right).shape),
    }
    tables = np.stack([pack_pattern(functions[pattern]) for pattern in Pattern])
    tables /= tables.max((1, 2), keepdims=True)
    tables.setflags(write=False)
    return tables


@functools.cache
def standard_means() -> Float64[np.ndarray, "K"]:
    """Return the means of all `Pattern`s over the sphere, relative to their brightest direction."""
    return np.array([mean_over_directions(table) for table in standard_tables()])


@functools.cache
def standard_spreads_deg() -> Float64[np.ndarray, "K"]:
    """Return the spreads of all `Pattern`s, degrees; 90 for those that are no beams."""
    beams = {Pattern.DIPPED_RIGHT, Pattern.DIPPED_LEFT, Pattern.HIGH_BEAM, Pattern.FRONT_FOG}
    tables = standard_tables()
    return np.array([spread_deg(tables[p]) if p in beams else 90.0 for p in Pattern])


# ---- Headlamps -----------------------------------------------------------------------------------

# Azimuths of the dipped beam's table, degrees.
_DIPPED_RIGHT_DEG = (-90, -60, -30, -15, -9, -3.43, 0, 1.15, 2.5, 5, 9, 15, 30, 60, 90)
# Candela by angle below the edge, degrees, at those azimuths. The 25 m and 10 m of `own beams on
# the road` are 0.92 and 3.15 degrees below the edge at azimuth 0.
_DIPPED_CD = {
    0.0: (0, 20, 200, 900, 1800, 3900, 4800, 5500, 5600, 5200, 3000, 1300, 300, 20, 0),
    0.3: (0, 30, 350, 1500, 2900, 8000, 11500, 14000, 14000, 10000, 5200, 2000, 450, 30, 0),
    0.92: (0, 40, 480, 1900, 3600, 8000, 10000, 11500, 11500, 9000, 5000, 2200, 550, 40, 0),
    1.5: (0, 50, 550, 2000, 3600, 6900, 8200, 9000, 9000, 7600, 4500, 2200, 600, 50, 0),
    3.15: (0, 60, 550, 1800, 2900, 4500, 5000, 5200, 5200, 4700, 3200, 1900, 600, 60, 0),
    6.0: (0, 60, 420, 1200, 1700, 2200, 2400, 2400, 2400, 2200, 1750, 1200, 450, 60, 0),
    12.0: (0, 50, 220, 520, 650, 800, 850, 850, 850, 800, 680, 520, 230, 50, 0),
    30.0: (0, 20, 70, 130, 160, 180, 190, 190, 190, 180, 160, 130, 70, 20, 0),
    90.0: (0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
}


def dipped_beam_cd(
    up_deg: Float[np.ndarray, "*N"], right_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return the intensity of a dipped beam for traffic that keeps right, candela.

    UN R112 class B: all test points of the regulation lie within their limits. The edge is level on
    the left and rises by 15 degrees on the right. Below it the table is bilinear; above it light
    falls to DIPPED_STRAY_CD.

    Args:
        up_deg: elevations, degrees; the horizon is 0, so the aim of -1 % is part of the pattern.
        right_deg: azimuths, degrees.
    """
    shape = np.broadcast(up_deg, right_deg).shape
    up = np.broadcast_to(up_deg, shape).ravel().astype(np.float64)
    right = np.broadcast_to(right_deg, shape).ravel().astype(np.float64)
    rise = np.clip(right, 0, DIPPED_RISE_END_DEG) * math.tan(math.radians(DIPPED_KINK_DEG))
    below = DIPPED_EDGE_DEG + rise - up
    depths = np.array(list(_DIPPED_CD))
    columns = np.stack([np.interp(right, _DIPPED_RIGHT_DEG, row) for row in _DIPPED_CD.values()])
    upper = np.clip(np.searchsorted(depths, below, side="right") - 1, 0, len(depths) - 2)
    fraction = np.clip((below - depths[upper]) / (depths[upper + 1] - depths[upper]), 0, 1)
    index = np.arange(len(up))
    candela = columns[upper, index] * (1 - fraction) + columns[upper + 1, index] * fraction
    # Stray light above the edge, weaker far to the sides and high up.
    stray = DIPPED_STRAY_CD * np.exp(-((right / 30) ** 2) - (np.maximum(up, 0) / 20) ** 2)
    stray = np.minimum(np.where(np.abs(right) < 90, stray, 0), candela)
    edge = np.exp(-((np.minimum(below, 0) / DIPPED_EDGE_WIDTH_DEG) ** 2))
    return np.where(below >= 0, candela, stray + (candela - stray) * edge).reshape(shape)


def high_beam_share(
    up_deg: Float[np.ndarray, "*N"], right_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return a high beam's intensity relative to its largest: a narrow core in a wide field.

    UN R112 asks for at least half of 40,500 cd at 2.58 degrees to either side and for an eighth of
    it at 5.15 degrees.
    """
    core = np.exp(-0.5 * ((right_deg / 3.2) ** 2 + (up_deg / 1.6) ** 2))
    field = np.exp(-0.5 * ((right_deg / 14) ** 2 + ((up_deg + 1.5) / 5) ** 2))
    return np.where(np.abs(right_deg) < 90, 0.92 * core + 0.08 * field, 0)


def front_fog_share(
    up_deg: Float[np.ndarray, "*N"], right_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return a front fog lamp's intensity relative to its largest: wide, below an edge at -1.2."""
    below = -1.2 - up_deg
    fall = np.where(below >= 0, np.exp(-((below - 1).clip(min=0) / 6)), 1.0)
    edge = np.where(below >= 0, 1.0, np.exp(-((below / 0.6) ** 2)))
    width = np.exp(-0.5 * (right_deg / 24) ** 2)
    return np.where(np.abs(right_deg) < 90, width * fall * np.maximum(edge, 0.01), 0)


# ---- Signal lamps --------------------------------------------------------------------------------


def rear_lamp_share(
    up_deg: Float[np.ndarray, "*N"], right_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return a signal lamp's intensity relative to its axis.

    UN R7 and R148 ask for 20 % of the least intensity at (5, 20) degrees, and for some light within
    80 degrees outwards.
    """
    core = np.exp(-0.5 * ((right_deg / 14) ** 2 + (up_deg / 7) ** 2))
    field = np.exp(-0.5 * ((right_deg / 40) ** 2 + (up_deg / 18) ** 2))
    return np.where(np.abs(right_deg) < 90, 0.7 * core + 0.3 * field, 0)


def daytime_share(
    up_deg: Float[np.ndarray, "*N"], right_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return a daytime running lamp's intensity relative to its axis: as a signal lamp's (R87)."""
    return rear_lamp_share(up_deg, right_deg)


def signal_share(
    up_deg: Float[np.ndarray, "*N"], right_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return a traffic signal's intensity relative to its axis: hooded above, spread below."""
    height = np.where(up_deg > 0, up_deg / 3, up_deg / 9)
    core = np.exp(-0.5 * ((right_deg / 11) ** 2 + height**2))
    field = np.exp(-0.5 * ((right_deg / 30) ** 2 + (up_deg / 16) ** 2))
    return np.where(np.abs(right_deg) < 90, 0.9 * core + 0.1 * field, 0)


def lambert_share(
    up_deg: Float[np.ndarray, "*N"], right_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return the cosine of the angle to the axis, 0 behind."""
    cosines = np.cos(np.radians(up_deg)) * np.cos(np.radians(right_deg))
    return np.where(np.abs(right_deg) < 90, np.maximum(cosines, 0), 0)


# ---- Street lamps --------------------------------------------------------------------------------

# Angle from the nadir at which the batwing ends across the road, degrees: so that all is 1,000 lm.
_BATWING_ACROSS_DEG = 72.3


def batwing_cd_per_klm(
    up_deg: Float[np.ndarray, "*N"], right_deg: Float[np.ndarray, "*N"]
) -> Float64[np.ndarray, "*N"]:
    """Return a street lamp's intensity, candela per 1,000 lumens of its flux.

    Along the road (the axis): 250 at the nadir, 490 at 60 to 65 degrees from it, 0 above 85. Across
    the road it falls to 0, so that the flux is 1,000 lm.
    """
    nadir_deg = np.asarray(up_deg) + 90.0
    along = np.interp(
        nadir_deg, [0, 60, 65, 85, 180], [BATWING_NADIR_CD, BATWING_PEAK_CD, BATWING_PEAK_CD, 0, 0]
    )
    across = np.interp(nadir_deg, [0, _BATWING_ACROSS_DEG, 180], [BATWING_NADIR_CD, 0, 0])
    share = np.cos(np.radians(right_deg)) ** 4
    return along * share + across * (1 - share)
