"""Photometric files of luminaires: IES LM-63 (1986 to 2019), type C.

The text has a header, a line `TILT=...`, and then numbers: 13 of the luminaire, the vertical
angles, the horizontal angles, and candela for every pair. Type C: vertical angle 0 is the nadir, 90
the horizon; horizontal angles turn about the vertical. Files come from anywhere, so sizes and
counts are checked before anything is allocated. Source of the format: I. Ashdown, "Parsing the
IESNA LM-63 photometric data file", 1998.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from augment.errors import LampError
from augment.lamps.patterns import pack_pattern

# Largest file, bytes. Files of luminaires have some 10 kB.
MAX_BYTES = 4_000_000
# Largest number of vertical or horizontal angles.
MAX_ANGLES = 1_000
# Largest number of candela values.
MAX_VALUES = 250_000
# Largest intensity that is believed, candela: ten times the brightest floodlights.
MAX_CANDELA = 1e8
# Metres in a foot, the length of files with unit 1.
_FOOT_M = 0.3048
# Radius of a luminaire whose file states no size, metres.
_DEFAULT_RADIUS_M = 0.15
# Numbers before the vertical angles: ten of the lamp, three of the ballast.
_NUM_HEADER_NUMBERS = 13
_TYPE_NAMES = {1: "C", 2: "B", 3: "A"}


@dataclass(frozen=True, eq=False)
class IesLuminaire:
    """Light of a luminaire by direction."""

    vertical_deg: Float64[np.ndarray, "V"]
    """Angles from the nadir, degrees, increasing, within 0 to 180."""
    horizontal_deg: Float64[np.ndarray, "H"]
    """Angles about the vertical, degrees, increasing; the planes that the file leaves out follow
    from its symmetry."""
    candela: Float64[np.ndarray, "H V"]
    """Intensities, candela, with the file's multipliers applied."""
    radius_m: float
    """Radius of a disc with the area of the luminous opening, metres."""

    def candela_at(
        self, vertical_deg: Float[np.ndarray, "..."], horizontal_deg: Float[np.ndarray, "..."]
    ) -> Float64[np.ndarray, "..."]:
        """Return intensities in directions, bilinear between the file's angles, candela.

        Args:
            vertical_deg: angles from the nadir.
            horizontal_deg: angles about the vertical, any turn.
        """
        shape = np.broadcast(vertical_deg, horizontal_deg).shape
        vertical = np.broadcast_to(vertical_deg, shape).ravel()
        horizontal = _fold(np.broadcast_to(horizontal_deg, shape).ravel(), self.horizontal_deg)
        row, v = _bracket(self.horizontal_deg, horizontal)
        column, u = _bracket(self.vertical_deg, vertical)
        next_row = np.minimum(row + 1, len(self.horizontal_deg) - 1)
        next_column = np.minimum(column + 1, len(self.vertical_deg) - 1)
        near = self.candela[row, column] * (1 - u) + self.candela[row, next_column] * u
        far = self.candela[next_row, column] * (1 - u) + self.candela[next_row, next_column] * u
        is_inside = (vertical >= self.vertical_deg[0] - 1e-6) & (
            vertical <= self.vertical_deg[-1] + 1e-6
        )
        return np.where(is_inside, near * (1 - v) + far * v, 0.0).reshape(shape)

    @property
    def street_side_deg(self) -> float:
        """Return the horizontal angle that looks across the road.

        Roadway luminaires are mirrored about that plane. In files from North America it is 0, in
        others 90. Of the four axes, the ones count about which the light is mirrored best; of
        these, the one along which less light goes, and of its two ends the brighter one.
        """
        turns = np.arange(0.0, 360.0, 5.0)
        verticals = np.arange(2.5, 180.0, 5.0)
        grid = self.candela_at(verticals[None, :], turns[:, None])
        flux = (grid * np.sin(np.radians(verticals))).sum(1)

        def difference(axis_deg: float) -> float:
            mirrored = self.candela_at(verticals[None, :], 2 * axis_deg - turns[:, None])
            return float(np.abs(grid - mirrored).sum() / max(grid.sum(), 1e-9))

        def flux_near(axis_deg: float) -> float:
            return float((flux * np.maximum(np.cos(np.radians(turns - axis_deg)), 0) ** 3).sum())

        first, second = (difference(axis) for axis in (0.0, 90.0))
        if abs(first - second) > 0.01:
            axis = 0.0 if first < second else 90.0
        else:
            along = [flux_near(axis) + flux_near(axis + 180) for axis in (0.0, 90.0)]
            axis = 0.0 if along[0] < along[1] else 90.0
        return axis if flux_near(axis) >= flux_near(axis + 180) - 1e-9 else axis + 180.0

    def pack(self) -> tuple[np.ndarray, float]:
        """Return the packed pattern, 1 at its brightest, and the candela there.

        The pattern's axis runs along the road, and its right side looks across the road.

        Raises:
            LampError: the luminaire is dark.
        """
        side_deg = self.street_side_deg
        table = pack_pattern(
            lambda up_deg, right_deg: self.candela_at(up_deg + 90.0, side_deg + right_deg - 90.0)
        )
        peak = float(table.max())
        if peak <= 0:
            raise LampError("an IES file without any light cannot be used as a lamp: all is 0 cd")
        return (table / np.float32(peak)).astype(np.float32), peak


def _fold(angles_deg: np.ndarray, horizontal_deg: np.ndarray) -> np.ndarray:
    """Return horizontal angles brought into the range that a file states, by its symmetry."""
    turned = np.mod(angles_deg, 360.0)
    first = horizontal_deg[0]
    last = horizontal_deg[-1]
    if len(horizontal_deg) == 1:
        return np.full_like(turned, first)
    if last == 90:  # mirrored about both axes
        turned = np.where(turned > 180, 360 - turned, turned)
        return np.where(turned > 90, 180 - turned, turned)
    if last == 180:  # mirrored about the axis 0 to 180
        return np.where(turned > 180, 360 - turned, turned)
    if first == 90:  # 90 to 270: mirrored about the axis 90 to 270
        return np.where(turned < 90, 180 - turned, np.where(turned > 270, 540 - turned, turned))
    return turned


def _bracket(nodes: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the node before each value, and the share of the way to the next one."""
    if len(nodes) == 1:
        return np.zeros(len(values), np.int64), np.zeros(len(values))
    index = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, len(nodes) - 2)
    share = (values - nodes[index]) / (nodes[index + 1] - nodes[index])
    return index, np.clip(share, 0, 1)


def read_ies(path: str | os.PathLike[str]) -> IesLuminaire:
    """Return the luminaire of an IES LM-63 file.

    Args:
        path: the file.

    Raises:
        LampError: the file is missing, too large, damaged, or of a kind that is not read.
    """
    file = Path(path)
    try:
        with file.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise LampError(f"{file}: cannot be read as an IES file: {error.strerror}") from error
    if len(content) > MAX_BYTES:
        raise LampError(
            f"{file}: an IES file may have at most {MAX_BYTES:,} bytes; this one is larger"
        )
    return parse_ies(content.decode("latin-1"), str(file))


def parse_ies(text: str, where: str) -> IesLuminaire:
    """Return the luminaire of the text of an IES LM-63 file.

    Args:
        text: the text.
        where: names the file in messages.

    Raises:
        LampError: the text is damaged, or of a kind that is not read.
    """
    numbers = _Numbers(_after_tilt(text, where), where)
    header = numbers.take(_NUM_HEADER_NUMBERS, "the luminaire's numbers")
    multiplier = float(header[2] * header[10])
    num_vertical = _count(header[3], "vertical angles", where)
    num_horizontal = _count(header[4], "horizontal angles", where)
    if num_vertical * num_horizontal > MAX_VALUES:
        raise LampError(
            f"{where}: an IES file may have at most {MAX_VALUES:,} candela values; its counts "
            f"{num_vertical} and {num_horizontal} ask for {num_vertical * num_horizontal:,}"
        )
    kind = header[5]
    if kind != 1:
        name = _TYPE_NAMES.get(int(kind)) if kind in _TYPE_NAMES else None
        raise LampError(
            f"{where}: only photometry of type C (1) is read; got "
            f"{f'type {name} ({kind:g})' if name else f'{kind:g}'}. Street lamps are of type C; "
            f"convert the file"
        )
    if header[6] not in (1, 2):
        raise LampError(f"{where}: the unit must be 1 (feet) or 2 (metres); got {header[6]:g}")
    if not 0 < multiplier <= 1e6:
        raise LampError(
            f"{where}: the multipliers of candela must be > 0 and at most 1e6 together; got "
            f"{header[2]:g} and {header[10]:g}"
        )
    vertical = numbers.take(num_vertical, "vertical angles")
    horizontal = numbers.take(num_horizontal, "horizontal angles")
    _check_angles(vertical, horizontal, where)
    candela = numbers.take(num_vertical * num_horizontal, "candela values") * multiplier
    if (candela < 0).any() or (candela > MAX_CANDELA).any():
        wrong = candela[(candela < 0) | (candela > MAX_CANDELA)][0]
        raise LampError(f"{where}: intensities must be 0 to {MAX_CANDELA:g} cd; got {wrong:g} cd")
    unit_m = _FOOT_M if header[6] == 1 else 1.0
    return IesLuminaire(
        vertical,
        horizontal,
        candela.reshape(num_horizontal, num_vertical),
        _radius_m(header[7] * unit_m, header[8] * unit_m),
    )


def _after_tilt(text: str, where: str) -> list[str]:
    """Return the words after the line TILT=, without the numbers of TILT=INCLUDE."""
    lines = text.splitlines()
    for number, line in enumerate(lines):
        name, _, value = line.strip().partition("=")
        if name.strip().upper() != "TILT":
            continue
        words = " ".join(lines[number + 1 :]).replace(",", " ").split()
        match value.strip().upper():
            case "NONE":
                return words
            case "INCLUDE":
                return _skip_tilt(words, where)
            case other:
                raise LampError(
                    f"{where}: TILT={other[:40]} names another file, which is not read. Use "
                    f"TILT=NONE or TILT=INCLUDE"
                )
    raise LampError(f"{where}: is not an IES LM-63 file: it has no line TILT=NONE or TILT=INCLUDE")


def _skip_tilt(words: list[str], where: str) -> list[str]:
    """Return the words after those of a tilt table. A lamp that hangs as designed has factor 1."""
    numbers = _Numbers(words[:2], where)
    count = _count(numbers.take(2, "the numbers of TILT=INCLUDE")[1], "tilt angles", where)
    if len(words) < 2 + 2 * count:
        raise LampError(f"{where}: ends within the {count} angles of TILT=INCLUDE")
    return words[2 + 2 * count :]


class _Numbers:
    """Words that are read as numbers, from first to last."""

    def __init__(self, words: list[str], where: str) -> None:
        self._words = words
        self._where = where
        self._next = 0

    def take(self, count: int, name: str) -> Float64[np.ndarray, "N"]:
        """Return the next numbers, float64.

        Args:
            count: how many.
            name: their name in messages.
        """
        words = self._words[self._next : self._next + count]
        if len(words) < count:
            raise LampError(
                f"{self._where}: {name} must be {count} numbers; the file ends after {len(words)}"
            )
        self._next += count
        values = np.empty(count)
        for i, word in enumerate(words):
            try:
                values[i] = float(word)
            except ValueError:
                raise LampError(
                    f"{self._where}: {name} must be numbers; got {word[:40]!r}"
                ) from None
            if not math.isfinite(values[i]):
                raise LampError(f"{self._where}: {name} must be finite; got {word[:40]!r}")
        return values


def _count(value: float, name: str, where: str) -> int:
    """Return a number of angles."""
    if value != int(value) or not 1 <= value <= MAX_ANGLES:
        raise LampError(
            f"{where}: the number of {name} must be a whole number from 1 to {MAX_ANGLES}; "
            f"got {value:g}"
        )
    return int(value)


def _check_angles(vertical: np.ndarray, horizontal: np.ndarray, where: str) -> None:
    """Raise LampError unless the angles are those of a file of type C."""
    for angles, name in ((vertical, "vertical"), (horizontal, "horizontal")):
        if (np.diff(angles) <= 0).any():
            raise LampError(f"{where}: the {name} angles must increase")
    if vertical[0] not in (0, 90) or vertical[-1] not in (90, 180) or len(vertical) < 2:
        raise LampError(
            f"{where}: the vertical angles must go from 0 or 90 to 90 or 180 degrees; they go from "
            f"{vertical[0]:g} to {vertical[-1]:g}"
        )
    ranges = ((0, 0), (0, 90), (0, 180), (0, 360), (90, 270))
    if (horizontal[0], horizontal[-1]) not in ranges:
        raise LampError(
            f"{where}: the horizontal angles must go from 0 to 0, 90, 180 or 360, or from 90 to "
            f"270 degrees; they go from {horizontal[0]:g} to {horizontal[-1]:g}"
        )


def _radius_m(width_m: float, length_m: float) -> float:
    """Return the radius of a disc with the area of a luminous opening.

    Negative sizes are diameters of round openings.
    """
    area = abs(width_m) * abs(length_m if length_m else width_m)
    if width_m < 0 or length_m < 0:
        area *= math.pi / 4
    radius = math.sqrt(area / math.pi)
    return radius if 0.005 <= radius <= 2.0 else _DEFAULT_RADIUS_M
