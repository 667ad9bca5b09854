"""Applies a recipe's weather to LiDAR sweeps: smog, rain, snowfall, lying snow, standing water."""

from augment.effects.lidar.codes import (
    ATTENUATED,
    LOST,
    MOVED,
    PRECIPITATION,
    SCATTERED,
    UNCHANGED,
    drop_lost,
    is_in_air,
)

__all__ = [
    "ATTENUATED",
    "LOST",
    "MOVED",
    "PRECIPITATION",
    "SCATTERED",
    "UNCHANGED",
    "drop_lost",
    "is_in_air",
]
