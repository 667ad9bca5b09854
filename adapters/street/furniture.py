"""Street lamps, traffic signs, litter bins and bollards."""

from __future__ import annotations

import numpy as np

from adapters.street.forms import ball, boxes, disc, parallelograms, triangle, tube
from adapters.street.layout import ROAD_HALF_M, Layout, pavement_z
from adapters.street.shapes import Look, Shapes, join
from augment.semantics import SemanticClass as Class

STEEL = Look((0.16, 0.17, 0.17), Class.POLE)
LANTERN = Look((0.72, 0.71, 0.66), Class.POLE)
GREY = Look((0.30, 0.31, 0.32), Class.SIGN, spacing=0.5)
WHITE = Look((0.75, 0.75, 0.74), Class.SIGN, spacing=0.5)
BLUE = Look((0.03, 0.11, 0.36), Class.SIGN, spacing=0.5)
RED = Look((0.48, 0.03, 0.03), Class.SIGN, spacing=0.5)
BIN = Look((0.05, 0.10, 0.07), Class.OTHER)
BOLLARD = Look((0.10, 0.10, 0.105), Class.BARRIER)


def build_furniture(layout: Layout) -> Shapes:
    """Everything man-made that stands on the pavements."""
    rng = np.random.default_rng([layout.parameters.seed, 40])
    parts = []
    for x, y in layout.lamps:
        parts.append(_lamp().moved((x, y, float(pavement_z(y))), 0.0 if y < 0 else np.pi))
    builders = (_crossing_sign, _crossing_sign, _limit_sign, _limit_sign, _parking_sign)
    for number, (x, y) in enumerate(layout.signs):
        # Signs face the traffic on their own side of the road.
        yaw = np.pi if y < 0 else 0.0
        parts.append(builders[number % 5]().moved((x, y, float(pavement_z(y))), yaw))
    for x, y in layout.lamps[::2]:
        place = (x + rng.uniform(1.2, 2.0), y, float(pavement_z(y)))
        parts.append(_bin().moved(place))
    for side in (1, -1):
        y = side * (ROAD_HALF_M + 0.4)
        for offset in (-3.4, 3.4, -4.6, 4.6):
            place = (layout.zebra_x + offset, y, float(pavement_z(y)))
            parts.append(_bollard().moved(place))
    return join(parts)


def _lamp() -> Shapes:
    """A tapered mast with an arm over the road (towards +y)."""
    return join(
        [
            tube((0, 0, -0.05), (0, 0, 0.9), 0.085, STEEL),
            tube((0, 0, 0.9), (0, 0, 6.4), 0.055, STEEL),
            tube((0, 0, 6.35), (0, 1.5, 6.75), 0.035, STEEL),
            boxes((-0.14, 1.35, 6.68), (0.14, 2.05, 6.82), STEEL),
            parallelograms((-0.11, 1.4, 6.675), (0, 0.6, 0), (0.22, 0, 0), LANTERN),
            ball((0, 0, 6.38), (0.07, 0.07, 0.07), STEEL),
        ]
    )


def _pole(height: float) -> Shapes:
    return tube((-0.03, 0, -0.05), (-0.03, 0, height), 0.032, STEEL)


def _plate(z: float, width: float, height: float, look: Look, x: float = 0.012) -> Shapes:
    """An upright rectangle facing +x."""
    corner = (x, -width / 2, z - height / 2)
    return parallelograms(corner, (0, width, 0), (0, 0, height), look)


def _rear(z: float, size: float) -> Shapes:
    corner = (0.0, -size / 2, z - size / 2)
    return parallelograms(corner, (0, 0, size), (0, size, 0), GREY)


def _crossing_sign() -> Shapes:
    figure = np.array([[0.022, -0.2, 2.3], [0.022, 0.2, 2.3], [0.022, 0.0, 2.66]])
    dark = Look((0.02, 0.02, 0.02), Class.SIGN, spacing=0.5)
    return join(
        [
            _pole(2.75),
            _rear(2.45, 0.62),
            _plate(2.45, 0.64, 0.64, BLUE),
            triangle(figure, WHITE),
            _plate(2.40, 0.09, 0.18, dark, 0.032),
        ]
    )


def _limit_sign() -> Shapes:
    plates = [(0.31, RED, 0.010), (0.235, WHITE, 0.018)]
    digits = Look((0.02, 0.02, 0.02), Class.SIGN, spacing=0.5)
    parts = [disc((x, 0, 2.5), (1, 0, 0), radius, look) for radius, look, x in plates]
    parts.append(disc((0, 0, 2.5), (-1, 0, 0), 0.31, GREY))
    for y in (-0.1, 0.1):
        parts.append(_plate(2.5, 0.13, 0.24, digits, 0.024).moved((0, y, 0)))
        parts.append(_plate(2.5, 0.045, 0.14, WHITE, 0.030).moved((0, y, 0)))
    return join([_pole(2.85), *parts])


def _parking_sign() -> Shapes:
    parts = [_pole(2.7), _rear(2.4, 0.5), _plate(2.4, 0.52, 0.52, BLUE)]
    for y, z, width, height in ((-0.09, 2.4, 0.07, 0.36), (0.02, 2.54, 0.18, 0.07)):
        parts.append(_plate(z, width, height, WHITE, 0.02).moved((0, y, 0)))
    for y, z, width, height in ((0.02, 2.4, 0.18, 0.07), (0.11, 2.47, 0.07, 0.2)):
        parts.append(_plate(z, width, height, WHITE, 0.02).moved((0, y, 0)))
    return join(parts)


def _bin() -> Shapes:
    return join(
        [
            tube((0, 0, 0.0), (0, 0, 0.85), 0.22, BIN),
            disc((0, 0, 0.85), (0, 0, 1), 0.22, BIN.tinted((0.02, 0.02, 0.02))),
            tube((0, 0, 0.85), (0, 0, 0.92), 0.23, STEEL),
        ]
    )


def _bollard() -> Shapes:
    return join(
        [
            tube((0, 0, 0.0), (0, 0, 0.85), 0.06, BOLLARD),
            tube((0, 0, 0.66), (0, 0, 0.76), 0.064, WHITE),
            ball((0, 0, 0.85), (0.06, 0.06, 0.05), BOLLARD),
        ]
    )
