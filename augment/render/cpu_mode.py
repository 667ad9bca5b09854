"""Numba functions: mode depth, eight pixels at a time (see augment.render.mode_depth).

Sums are kept times the cluster's weight, so that a sample that joins costs no division and no root.
"""

from __future__ import annotations

import numpy as np

from augment.render import cpu_simd as v8
from augment.render.cpu_jit import inner
from augment.render.layout import LANES, PIXELS, U
from augment.render.mode_depth import BETA_PER_SIGMA, FARTHER, GAMMA, NEARER

# Planes of a tile, from where the caller says: of the running cluster the depth it began with and
# the sums of w, w (z - first), w (z - first)^2; of the heaviest one its weight and mode.
FIRST, MASS, MOMENT, SQUARE, HEAVIEST, MODE = (U(i * PIXELS) for i in range(6))
MODE_PLANES = 6

_FARTHER, _NEARER = np.float32(FARTHER), np.float32(NEARER)
_FARTHER_2 = np.float32((FARTHER * BETA_PER_SIGMA) ** 2)
_NEARER_2 = np.float32((NEARER * BETA_PER_SIGMA) ** 2)
_BACK = np.float32(GAMMA * BETA_PER_SIGMA)
# What rounding may add to a sum of weights; far more than it does.
_SLACK = np.float32(1e-4)


@inner()
def add_sample(state, at, depth, weight, floor):
    """Eight pixels' next samples. state, at: their place in the plane FIRST."""
    zero, none = v8.splat(np.float32(0)), v8.splat(np.float32(-1))
    first, mass = v8.load(state, at + FIRST), v8.load(state, at + MASS)
    moment, square = v8.load(state, at + MOMENT), v8.load(state, at + SQUARE)
    off = depth - first
    aside = v8.fmuladd(off, mass, v8.negate(moment))  # mass (z - mean)
    spread = _spread(mass, moment, square)
    is_farther = v8.at_least(aside, zero)
    reach = v8.select(is_farther, v8.splat(_FARTHER), v8.splat(_NEARER))
    reach_2 = v8.select(is_farther, v8.splat(_FARTHER_2), v8.splat(_NEARER_2))
    by_floor = v8.splat(floor) * reach * mass - v8.absolute(aside)
    by_spread = v8.fmuladd(reach_2, spread, v8.negate(aside * aside))
    joins = v8.greater(v8.maximum(by_floor, by_spread), zero)
    begins = v8.select(joins, none, v8.select(v8.greater(weight, zero), zero, none))
    if v8.any_not_negative(begins):
        is_new = v8.at_least(begins, zero)
        best = v8.load(state, at + HEAVIEST)
        heavier = v8.both(is_new, v8.greater(mass, best))
        mode = v8.select(heavier, _mode(first, mass, moment, spread), v8.load(state, at + MODE))
        v8.store(state, at + HEAVIEST, v8.select(heavier, mass, best))
        v8.store(state, at + MODE, mode)
        v8.store(state, at + FIRST, v8.select(is_new, depth, first))
        off, mass = v8.select(is_new, zero, off), v8.select(is_new, zero, mass)
        moment, square = v8.select(is_new, zero, moment), v8.select(is_new, zero, square)
    weighted = weight * off
    v8.store(state, at + MASS, mass + weight)
    v8.store(state, at + MOMENT, moment + weighted)
    v8.store(state, at + SQUARE, v8.fmuladd(weighted, off, square))


@inner()
def can_grow(state, at, through):
    """Not negative where the running cluster may still become the heaviest, or is it.

    through: what light is left, negative where blending has stopped.
    """
    none = v8.splat(np.float32(-1))
    mass, best = v8.load(state, at + MASS), v8.load(state, at + HEAVIEST)
    most = mass + through + v8.splat(_SLACK) - best
    return v8.select(v8.greater(through, v8.splat(np.float32(0))), most, none)


@inner()
def close_clusters(state, start):
    """The last cluster is compared too: leaves the result in the plane MODE."""
    for i in range(U(0), U(PIXELS), U(LANES)):
        at = U(start) + i
        first, mass = v8.load(state, at + FIRST), v8.load(state, at + MASS)
        moment, square = v8.load(state, at + MOMENT), v8.load(state, at + SQUARE)
        mode = _mode(first, mass, moment, _spread(mass, moment, square))
        heavier = v8.greater(mass, v8.load(state, at + HEAVIEST))
        v8.store(state, at + MODE, v8.select(heavier, mode, v8.load(state, at + MODE)))


@inner()
def _spread(mass, moment, square):
    """mass^2 times the variance."""
    spread = v8.fmuladd(mass, square, v8.negate(moment * moment))
    return v8.maximum(spread, v8.splat(np.float32(0)))


@inner()
def _mode(first, mass, moment, spread):
    return first + (moment - v8.splat(_BACK) * v8.sqrt(spread)) / mass
