"""Round numbers for the axes of charts and colour bars, and their texts."""

from __future__ import annotations

import math


def linear_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Return about `most` numbers within [low, high], 1, 2 or 5 times a power of ten apart."""
    rough = (high - low) / most
    if not rough > 1e-300:
        return [low]
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(unit * m for m in (1, 2, 5, 10) if unit * m >= rough * 0.999)
    first_index = math.ceil(low / step - 1e-9)
    last_index = math.floor(high / step + 1e-9)
    return [i * step for i in range(first_index, last_index + 1)]


def log_ticks(low: float, high: float, most: int = 7) -> list[float]:
    """Return 1, 2 and 5 times powers of ten within [low, high].

    If those are more than `most`, only powers are returned. If there would be no number or one,
    any round numbers are returned.

    """
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in ((1, 2, 5), (1,)):
        ticks = [d * 10.0**e for e in decades for d in digits]
        ticks = [t for t in ticks if low * (1 - 1e-9) <= t <= high * (1 + 1e-9)]
        if len(ticks) <= most:
            break
    return ticks if len(ticks) > 1 else linear_ticks(low, high)


def short_number(value: float) -> str:
    """Return a number as text for an axis: 5000 as 5k, 1.5e6 as 1.5M, 0.02 as it is."""
    for limit, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= limit:
            return f"{value / limit:g}{suffix}"
    return f"{value:.6g}"
