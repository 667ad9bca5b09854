"""Standard lamps: candela, pattern, colour and size of each kind, and their making in numbers.

Sources: signal lamps: UN R148 (R7, R6, R38, R87), within their limits; front fog lamps: data sheets
of 9,000 to 18,000 cd; bicycles, third stop lamps and all sizes are assumed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from augment.lamps.lamp import RED, LampKind, Lamps, color_of_temperature, lamp_frame
from augment.lamps.patterns import (
    DIPPED_PEAK_CD,
    Pattern,
    standard_means,
    standard_spreads_deg,
    standard_tables,
)

# Colour of lamps without one of their own: an LED headlamp.
_WHITE_K = 5000.0


@dataclass(frozen=True, eq=False)
class LampType:
    """Light of one kind of lamp."""

    kind: LampKind
    """Kind of the lamp."""
    pattern: Pattern
    """Standard pattern."""
    intensity_cd: float
    """Intensity in the brightest direction, candela."""
    color: Float64[np.ndarray, "3"]
    """Linear sRGB colour of luminance 1."""
    radius_m: float
    """Radius of the disc that shines, metres."""


_WHITE = color_of_temperature(_WHITE_K)

DIPPED = LampType(LampKind.DIPPED, Pattern.DIPPED_RIGHT, DIPPED_PEAK_CD, _WHITE, 0.044)
HIGH = LampType(LampKind.HIGH, Pattern.HIGH_BEAM, 50_000.0, _WHITE, 0.044)
FRONT_FOG = LampType(LampKind.FRONT_FOG, Pattern.FRONT_FOG, 9_000.0, _WHITE, 0.04)
DAYTIME = LampType(LampKind.DAYTIME, Pattern.DAYTIME, 600.0, _WHITE, 0.04)
TAIL = LampType(LampKind.TAIL, Pattern.REAR, 10.0, RED, 0.06)
STOP = LampType(LampKind.STOP, Pattern.REAR, 110.0, RED, 0.06)  # tail and stop lamp together
THIRD_STOP = LampType(LampKind.STOP, Pattern.REAR, 50.0, RED, 0.03)
REAR_FOG = LampType(LampKind.REAR_FOG, Pattern.REAR, 200.0, RED, 0.04)
BICYCLE_FRONT = LampType(LampKind.DIPPED, Pattern.DIPPED_RIGHT, 1_000.0, _WHITE, 0.02)
BICYCLE_REAR = LampType(LampKind.TAIL, Pattern.REAR, 5.0, RED, 0.015)


def make_lamps(
    positions_m: Float[np.ndarray, "M 3"],
    axes: Float[np.ndarray, "M 3"],
    lamp_type: LampType,
    *,
    factors: Float[np.ndarray, "M"] | float = 1.0,
    up: Float[np.ndarray, "3"] | tuple[float, float, float] = (0.0, 0.0, 1.0),
    color: Float[np.ndarray, "3"] | None = None,
    owner: int = 0,
) -> Lamps:
    """Return lamps of one type at given places.

    Args:
        positions_m: places, metres, scene world.
        axes: directions of the axes, of any length but zero, not along `up`.
        lamp_type: their type.
        factors: factors of the type's intensity.
        up: upward direction.
        color: linear sRGB of luminance 1; None for the type's own.
        owner: instance id of the object that they are fixed to.
    """
    count = len(positions_m)
    unit_axes, ups = lamp_frame(np.asarray(axes, np.float64), np.asarray(up, np.float64))
    intensities_cd = lamp_type.intensity_cd * np.broadcast_to(
        np.asarray(factors, np.float64), (count,)
    )
    pattern = int(lamp_type.pattern)
    lamp_color = lamp_type.color if color is None else color
    return Lamps(
        positions_m=np.asarray(positions_m, np.float64),
        axes=unit_axes,
        ups=ups,
        intensities_cd=intensities_cd,
        patterns=_filled(count, pattern),
        tables=standard_tables(),
        colors=np.tile(np.asarray(lamp_color, np.float64), (count, 1)),
        radii_m=np.full(count, lamp_type.radius_m),
        spreads_deg=np.full(count, standard_spreads_deg()[pattern]),
        mean_intensities_cd=intensities_cd * standard_means()[pattern],
        kinds=_filled(count, int(lamp_type.kind)),
        owners=_filled(count, owner),
    )


def _filled(count: int, value: int) -> Int64[np.ndarray, "M"]:
    return np.full(count, value, np.int64)
