"""Light sources of a scene at one moment: place, direction, candela by angle, colour.

Photometric units throughout: candela, lux, cd/m². Symbols: M lamps, K patterns. A pattern's table
has V rows and U columns, see `augment.lamps.patterns`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from augment.light.srgb import LUMINANCE_WEIGHTS

# Largest number of lamps at one moment. Every pixel looks at those near to it, and the light in the
# air sums over all that are bright enough.
MAX_LAMPS = 5000
# Spread of the beam, degrees, from which on a lamp is no beam but shines all around.
MIN_WIDE_SPREAD_DEG = 90.0
# `owners` of lamps of the map: street lamps, signals, windows.
MAP_OWNER = 0
# `owners` of lamps of the recording car.
EGO_OWNER = -1
# Largest error of the length of a unit vector, and of the cosine of a right angle.
_UNIT_TOLERANCE = 1e-6


class LampKind(IntEnum):
    """Kinds of lamps. Their names are written to `labels/light.parquet` in lower case."""

    DIPPED = 0
    HIGH = 1
    TAIL = 2
    STOP = 3
    REAR_FOG = 4
    FRONT_FOG = 5
    INDICATOR = 6
    DAYTIME = 7
    STREET = 8
    SIGNAL = 9
    WINDOW = 10
    OTHER = 11


@dataclass(frozen=True, eq=False)
class Lamps:
    """M light sources at one moment, scene world, metres."""

    positions_m: Float64[np.ndarray, "M 3"]
    """Centres of the discs that shine, metres, scene world."""
    axes: Float64[np.ndarray, "M 3"]
    """Unit vectors of the patterns' zero directions: along the beam of a headlamp, horizontally
    along the road of a street lamp (plane C0)."""
    ups: Float64[np.ndarray, "M 3"]
    """Unit vectors of the patterns' upward directions, at right angles to the axes."""
    intensities_cd: Float64[np.ndarray, "M"]
    """Luminous intensities where the pattern is 1, candela, >= 0."""
    patterns: Int64[np.ndarray, "M"]
    """Rows of `tables`."""
    tables: Float32[np.ndarray, "K V U"]
    """Packed patterns, see `augment.lamps.patterns.pack_pattern`."""
    colors: Float64[np.ndarray, "M 3"]
    """Linear sRGB colours of luminance 1."""
    radii_m: Float64[np.ndarray, "M"]
    """Radii of the discs that shine, metres, > 0."""
    spreads_deg: Float64[np.ndarray, "M"]
    """Standard deviations of the beams, degrees; MIN_WIDE_SPREAD_DEG or more for no beam."""
    mean_intensities_cd: Float64[np.ndarray, "M"]
    """Means of the intensities over all directions: flux / 4 pi, candela."""
    kinds: Int64[np.ndarray, "M"]
    """`LampKind` of each lamp."""
    owners: Int64[np.ndarray, "M"]
    """Instance ids of the actors that the lamps are fixed to; MAP_OWNER or EGO_OWNER where there is
    no such actor."""

    def __post_init__(self) -> None:
        count = len(self.positions_m)
        if count > MAX_LAMPS:
            raise ValueError(
                f"there may be at most {MAX_LAMPS} lamps at a moment; got {count}. Take those near "
                f"the camera"
            )
        if self.tables.dtype != np.float32 or self.tables.ndim != 3:
            raise ValueError(
                f"tables must be float32 [K, V, U]; got {self.tables.dtype} "
                f"{list(self.tables.shape)}"
            )
        for name, columns in _COLUMNS.items():
            value = getattr(self, name)
            shape = (count, *columns)
            dtype = np.int64 if name in _INTEGERS else np.float64
            if value.dtype != dtype or value.shape != shape:
                raise ValueError(
                    f"{name} must be {np.dtype(dtype)} {list(shape)} with M={count} (from "
                    f"positions_m); got {value.dtype} {list(value.shape)}"
                )
            if name not in _INTEGERS and not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite; row {_first(~np.isfinite(value))} is not")
        self._check_values()

    def _check_values(self) -> None:
        """Raise ValueError unless the numbers are those of lamps."""
        for name in ("intensities_cd", "mean_intensities_cd", "colors"):
            value = getattr(self, name)
            if (value < 0).any():
                row = _first(value < 0)
                raise ValueError(f"{name} must be >= 0; got {value[row].tolist()} in row {row}")
        for name in ("radii_m", "spreads_deg"):
            value = getattr(self, name)
            if (value <= 0).any():
                row = _first(value <= 0)
                raise ValueError(f"{name} must be > 0; got {value[row]} in row {row}")
        is_outside = (self.patterns < 0) | (self.patterns >= len(self.tables))
        if is_outside.any():
            row = _first(is_outside)
            raise ValueError(
                f"patterns must be rows of tables, 0 to {len(self.tables) - 1}; got "
                f"{self.patterns[row]} in row {row}"
            )
        lengths = np.stack([np.linalg.norm(self.axes, axis=1), np.linalg.norm(self.ups, axis=1)], 1)
        cosines = (self.axes * self.ups).sum(1)
        is_skew = (np.abs(lengths - 1) > _UNIT_TOLERANCE).any(1) | (
            np.abs(cosines) > _UNIT_TOLERANCE
        )
        if is_skew.any():
            row = _first(is_skew)
            raise ValueError(
                f"axes and ups must be unit vectors at right angles; got {self.axes[row].tolist()} "
                f"and {self.ups[row].tolist()} in row {row}"
            )

    def __len__(self) -> int:
        return len(self.positions_m)

    @property
    def peak_intensities_cd(self) -> Float64[np.ndarray, "M"]:
        """Largest intensities in any direction, candela."""
        return self.intensities_cd * self.tables.max((1, 2), initial=0.0)[self.patterns]

    def select(self, index: np.ndarray | slice) -> Lamps:
        """Return the lamps at the given indices or mask, in that order, with the same tables."""
        return replace(self, **{name: getattr(self, name)[index] for name in _COLUMNS})

    @staticmethod
    def concatenate(parts: Sequence[Lamps]) -> Lamps:
        """Return the lamps of all parts, in order. Parts that share their tables go on doing so."""
        parts = [part for part in parts if len(part)]
        if not parts:
            return Lamps.none()
        if len(parts) == 1:
            return parts[0]
        tables, offsets = _join_tables([part.tables for part in parts])
        columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _COLUMNS}
        shifts = np.repeat(np.array(offsets, np.int64), [len(part) for part in parts])
        return Lamps(**{**columns, "patterns": columns["patterns"] + shifts}, tables=tables)

    @staticmethod
    def none() -> Lamps:
        """Return no lamps."""
        columns = {
            name: np.zeros((0, *shape), np.int64 if name in _INTEGERS else np.float64)
            for name, shape in _COLUMNS.items()
        }
        return Lamps(**columns, tables=np.zeros((0, 1, 1), np.float32))


# Columns of `Lamps`, each with the shape of a row.
_COLUMNS: dict[str, tuple[int, ...]] = {
    "positions_m": (3,),
    "axes": (3,),
    "ups": (3,),
    "intensities_cd": (),
    "patterns": (),
    "colors": (3,),
    "radii_m": (),
    "spreads_deg": (),
    "mean_intensities_cd": (),
    "kinds": (),
    "owners": (),
}
_INTEGERS = frozenset({"patterns", "kinds", "owners"})


def _first(mask: np.ndarray) -> int:
    """Return the first row of a mask with a True in it."""
    return int(mask.reshape(len(mask), -1).any(1).argmax())


def _join_tables(all_tables: Sequence[np.ndarray]) -> tuple[np.ndarray, list[int]]:
    """Return different tables joined, and the first row of each of the given tables in them."""
    joined: list[np.ndarray] = []
    first_rows: dict[int, int] = {}
    num_rows = 0
    for tables in all_tables:
        if id(tables) not in first_rows:
            first_rows[id(tables)] = num_rows
            joined.append(tables)
            num_rows += len(tables)
    sizes = {table.shape[1:] for table in joined}
    if len(sizes) > 1:
        raise ValueError(f"tables of lamps must have one size to be joined; got {sorted(sizes)}")
    offsets = [first_rows[id(tables)] for tables in all_tables]
    return (joined[0] if len(joined) == 1 else np.concatenate(joined)), offsets


def lamp_frame(
    axes: Float[np.ndarray, "M 3"], ups: Float[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "M 3"], Float64[np.ndarray, "M 3"]]:
    """Return unit axes, and unit vectors at right angles to them that point up as far as they can.

    Args:
        axes: directions of any length but zero.
        ups: a direction that is not along any of the axes, as (0, 0, 1) for horizontal beams.
    """
    unit_axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    sides = np.cross(unit_axes, ups)
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    return unit_axes, np.cross(sides, unit_axes)


# ---- Colours -------------------------------------------------------------------------------------

_RGB_FROM_XYZ = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)


def color_of_chromaticity(x: float, y: float) -> Float64[np.ndarray, "3"]:
    """Return the linear sRGB colour of luminance 1 of CIE 1931 coordinates x, y.

    Colours outside sRGB lose their negative channels, and keep luminance 1.

    Args:
        x: red share of the chromaticity.
        y: green share of the chromaticity, > 0.
    """
    rgb = np.maximum(_RGB_FROM_XYZ @ np.array([x / y, 1.0, (1 - x - y) / y]), 0.0)
    return rgb / (rgb @ np.array(LUMINANCE_WEIGHTS))


def color_of_temperature(temperature_k: float) -> Float64[np.ndarray, "3"]:
    """Return the linear sRGB colour of luminance 1 of a black body, 1,667 to 25,000 K.

    Cubic approximation of the Planckian locus by Kim et al. 2002 (US patent 7,024,034).

    Raises:
        ValueError: the temperature is outside these limits.
    """
    if not 1667.0 <= temperature_k <= 25000.0:
        raise ValueError(f"temperature_k must be 1667 to 25000; got {temperature_k}")
    k = 1000.0 / temperature_k
    if temperature_k <= 4000:
        x = ((-0.2661239 * k - 0.2343589) * k + 0.8776956) * k + 0.179910
    else:
        x = ((-3.0258469 * k + 2.1070379) * k + 0.2226347) * k + 0.240390
    if temperature_k <= 2222:
        y = ((-1.1063814 * x - 1.34811020) * x + 2.18555832) * x - 0.20219683
    elif temperature_k <= 4000:
        y = ((-0.9549476 * x - 1.37418593) * x + 2.09137015) * x - 0.16748867
    else:
        y = ((3.0817580 * x - 5.87338670) * x + 3.75112997) * x - 0.37001483
    return color_of_chromaticity(x, y)


# Colour of red lamps: the middle of the UN R48 region "red".
RED = color_of_chromaticity(0.69, 0.31)
# Colour of amber lamps: the middle of the UN R48 region "amber".
AMBER = color_of_chromaticity(0.57, 0.42)
# Colour of green signals: a point of the EN 12368 region.
GREEN = color_of_chromaticity(0.17, 0.45)
