"""All tables of measured numbers of boxes, and what the weather leaves visible of each box.

In: numbers of boxes by table (`BoxWeather`). Out: fractions. Jobs and readers of an output call it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from augment import effects
from augment.output.box_tables import BOXES_2D, MASKS, BoxTable, BoxWeather


def box_tables() -> dict[str, BoxTable]:
    """Return all tables of measured numbers of boxes, by name.

    They are the tables of the boxes and those of the effects.
    """
    effect_tables = (e.box_table for e in reversed(effects.EFFECTS) if e.box_table is not None)
    return {table.name: table for table in (BOXES_2D, MASKS, *effect_tables)}


def combine_visibility(weather: BoxWeather, count: int) -> Float64[np.ndarray, " B"]:
    """Return the fraction of each box that the weather leaves visible, float64 [B], 0 to 1.

    It is the product of the fractions of all effects. An effect that is absent, or that has no
    number of a box (NaN), hides nothing. Whether a box is in view, or behind another one, is in the
    column `pixels` of the tables.

    Args:
        count: Number of boxes.
    """
    tables = box_tables()
    factors = [
        np.ones(count),
        *(tables[name].visible_fractions(numbers) for name, numbers in weather.items()),
    ]
    return np.prod([np.where(np.isnan(f), 1.0, f) for f in factors if f is not None], axis=0)
