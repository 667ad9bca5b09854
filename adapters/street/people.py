"""A person in mid-stride: tubes and ellipsoids, one rigid body.

Frame: x forward, y left, z up, origin on the ground between the feet.
"""

from __future__ import annotations

import numpy as np

from adapters.street.forms import ball, ellipsoids, tube
from adapters.street.shapes import Look, Shapes, join
from augment.semantics import SemanticClass as Class

SIZE_M = (0.92, 0.66, 1.80)
SKIN = ((0.52, 0.31, 0.21), (0.28, 0.15, 0.09), (0.60, 0.40, 0.29))
COATS = ((0.30, 0.05, 0.05), (0.05, 0.10, 0.22), (0.36, 0.31, 0.22), (0.06, 0.14, 0.09))
TROUSERS = ((0.035, 0.045, 0.08), (0.05, 0.05, 0.05), (0.20, 0.17, 0.12))


def draw_person(seed: int) -> Shapes:
    """A person with clothes drawn from the seed."""
    rng = np.random.default_rng(seed)
    plain = Look((0.5, 0.5, 0.5), Class.PEDESTRIAN, spacing=0.7)
    skin = plain.tinted(SKIN[rng.integers(len(SKIN))])
    coat = plain.tinted(COATS[rng.integers(len(COATS))])
    legs = plain.tinted(TROUSERS[rng.integers(len(TROUSERS))])
    hair = plain.tinted(np.array((0.03, 0.02, 0.015)) * rng.uniform(1, 4))
    shoes = plain.tinted((0.03, 0.028, 0.025))
    parts = [
        _tilted((0.01, 0, 1.20), (0.125, 0.20, 0.33), 0.06, coat),
        ball((0.0, 0, 0.93), (0.125, 0.175, 0.16), legs),
        ball((0.035, 0, 1.635), (0.098, 0.08, 0.125), skin),
        ball((0.012, 0, 1.67), (0.105, 0.09, 0.105), hair),
        tube((0.01, 0, 1.46), (0.02, 0, 1.56), 0.055, skin),
    ]
    for side, phase in ((1, 1), (-1, -1)):
        y = side * 0.095
        knee = np.array([0.10 * phase + 0.06, y, 0.50])
        foot = np.array([0.27 * phase - (0.06 if phase < 0 else 0), y, 0.10 + 0.03 * (phase < 0)])
        shoulder = np.array([0.0, side * 0.19, 1.41])
        elbow = np.array([-0.13 * phase, side * 0.255, 1.15])
        hand = np.array([-0.20 * phase + 0.12, side * 0.245, 0.93])
        parts += [
            tube((0, y, 0.93), knee, 0.085, legs),
            tube(knee, foot, 0.062, legs),
            ball(knee, (0.072, 0.07, 0.075), legs),
            ball(foot + np.array([0.055, 0, -0.04]), (0.135, 0.05, 0.055), shoes),
            tube(shoulder, elbow, 0.052, coat),
            tube(elbow, hand, 0.043, coat),
            ball(shoulder, (0.062, 0.058, 0.068), coat),
            ball(elbow, (0.05, 0.05, 0.05), coat),
            ball(hand, (0.045, 0.03, 0.055), skin),
        ]
    return join(parts)


def _tilted(centre: tuple, radii: tuple, angle_rad: float, look: Look) -> Shapes:
    """An ellipsoid leaning forward."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turn = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    return ellipsoids(np.array([centre]), (turn * np.array(radii)[:, None])[None], look)
