"""Numbers as people read them: counts, bytes, and weather with its units."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from recipes.schema import KOSCHMIEDER

_BYTES = ("B", "kB", "MB", "GB", "TB", "PB")
# By ending of a column's name, the longest first.
_UNITS = {
    "_per_m": "1/m",
    "_ntu": "NTU",
    "_mps": "m/s",
    "_mm_per_h": "mm/h",
    "_deg": "°",
    "_m": "m",
}


@dataclass(frozen=True)
class Quantity:
    """A weather number as the page shows it.

    column: of the manifest. zero_is_absent: 0 says that the effect is not there, as NaN does
    elsewhere. inverted: shown as KOSCHMIEDER over the number. factor: of the number shown.
    linear: its axis is not logarithmic, however far it is spread.
    """

    column: str
    title: str
    unit: str
    zero_is_absent: bool = False
    inverted: bool = False
    factor: float = 1.0
    linear: bool = False

    @property
    def formula(self) -> str:
        """How it comes from the manifest."""
        return f"{KOSCHMIEDER} / {self.column}" if self.inverted else self.column


_KNOWN = {
    q.column: q
    for q in (
        Quantity("smog_extinction_per_m", "Visibility in smog", "m", True, inverted=True),
        Quantity("smog_scale_height_m", "Scale height of smog", "m"),
        Quantity("flood_level_m", "Water level", "m", linear=True),
        Quantity("flood_turbidity_ntu", "Turbidity of water", "NTU"),
        Quantity("flood_wave_height", "Wave height, × preset", ""),
        Quantity("snow_depth_m", "Snow depth", "cm", factor=100),
        Quantity("snow_coverage", "Snow coverage", "", linear=True),
        Quantity("style_strength", "Strength of style", "", True, linear=True),
    )
}


def known_order(column: str) -> tuple[int, str]:
    """A key that sorts columns: those known here first."""
    names = list(_KNOWN)
    return (names.index(column) if column in _KNOWN else len(names), column)


def quantity_of(column: str) -> Quantity:
    """What a weather column of the manifest means; one not known here by its name's ending."""
    if column in _KNOWN:
        return _KNOWN[column]
    for ending, unit in _UNITS.items():
        if column.endswith(ending):
            return Quantity(column, _words(column.removesuffix(ending)), unit)
    return Quantity(column, _words(column), "")


def shown_values(quantity: Quantity, values: np.ndarray) -> np.ndarray:
    """The numbers in the quantity's unit."""
    return KOSCHMIEDER / values if quantity.inverted else quantity.factor * values


def with_unit(number: float, unit: str) -> str:
    """0.31 m, 4.8 NTU; a number without a unit stands alone."""
    return f"{short(number)} {unit}".rstrip()


def short(number: float) -> str:
    """Three significant digits, no exponent where there need be none."""
    if not math.isfinite(number):
        return str(number)
    if number == 0:
        return "0"
    size = abs(number)
    if size >= 1e7 or size < 1e-4:
        return f"{number:.2e}".replace("-", "−")
    digits = max(0, 2 - math.floor(math.log10(size)))
    said = f"{round(number, digits):,.{digits}f}"
    said = said.rstrip("0").rstrip(".") if "." in said else said
    return said.replace("-", "−")


def count(number: int, noun: str = "") -> str:
    """12,000 images; 1 image."""
    return f"{number:,} {plural_of(number, noun)}".rstrip()


def plural_of(number: int, noun: str) -> str:
    """The noun as it stands behind the number."""
    if number == 1 or not noun:
        return noun
    return noun + ("es" if noun.endswith(("x", "ss")) else "s")


def byte_size(number: int) -> str:
    """3.2 MB, in steps of 1000."""
    size, unit = float(number), 0
    while size >= 999.5 and unit < len(_BYTES) - 1:
        size, unit = size / 1000, unit + 1
    return f"{number:,} B" if unit == 0 else f"{size:.3g} {_BYTES[unit]}"


def percent(part: float, whole: float) -> str:
    """41 %, < 1 %; an empty whole has no parts."""
    if not whole:
        return "–"
    share = 100 * part / whole
    if 0 < share < 1:
        return "< 1 %"
    return "> 99 %" if 99 < share < 100 else f"{share:.0f} %"


def _words(name: str) -> str:
    said = name.replace("_", " ").strip()
    return said[:1].upper() + said[1:]
