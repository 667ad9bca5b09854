"""Triton functions: mode depth (augment.render.mode_depth), one sample of every pixel at a time.

Sums are kept times the cluster's weight, so that a sample that joins costs no division and no root.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render import mode_depth

FARTHER = tl.constexpr(mode_depth.FARTHER)
NEARER = tl.constexpr(mode_depth.NEARER)
FARTHER_2 = tl.constexpr((mode_depth.FARTHER * mode_depth.BETA_PER_SIGMA) ** 2)
NEARER_2 = tl.constexpr((mode_depth.NEARER * mode_depth.BETA_PER_SIGMA) ** 2)
BACK = tl.constexpr(mode_depth.GAMMA * mode_depth.BETA_PER_SIGMA)
SLACK = tl.constexpr(1e-4)  # what rounding may add to a sum of weights; far more than it does


@triton.jit
def add_sample(depth, weight, floor, first, mass, moment, square, best, best_mode):
    """The clusters with every pixel's next sample; those of weight 0 change nothing.

    Of the running cluster: first, the depth it began with, and the sums of w, w (z - first) and
    w (z - first)^2. Of the heaviest closed one: its weight and its mode.
    """
    off = depth - first
    aside = off * mass - moment  # mass (z - mean)
    spread = _spread(mass, moment, square)
    is_farther = aside >= 0
    reach = tl.where(is_farther, FARTHER, NEARER)
    reach_2 = tl.where(is_farther, FARTHER_2, NEARER_2)
    by_floor = floor * reach * mass - tl.abs(aside)
    by_spread = reach_2 * spread - aside * aside
    begins = (weight > 0) & (tl.maximum(by_floor, by_spread) <= 0)
    if tl.max(tl.max(begins.to(tl.int32), 0), 0) > 0:
        is_best = begins & (mass > best)
        best_mode = tl.where(is_best, _mode(first, mass, moment, spread), best_mode)
        best = tl.where(is_best, mass, best)
        first = tl.where(begins, depth, first)
        off = tl.where(begins, 0.0, off)
        mass = tl.where(begins, 0.0, mass)
        moment = tl.where(begins, 0.0, moment)
        square = tl.where(begins, 0.0, square)
    weighted = weight * off
    return first, mass + weight, moment + weighted, square + weighted * off, best, best_mode


@triton.jit
def can_grow(through, mass, best):
    """Whether a pixel's running cluster may still become the heaviest, or is it.

    through: the light left, negative where blending has stopped.
    """
    return (through > 0) & (mass + through + SLACK >= best)


@triton.jit
def heaviest_mode(first, mass, moment, square, best, best_mode):
    """Mode of the heaviest cluster, the running one included; 0 where there is none."""
    last = _mode(first, mass, moment, _spread(mass, moment, square))
    return tl.where(mass > best, last, best_mode)


@triton.jit
def _spread(mass, moment, square):
    """mass^2 times the variance."""
    return tl.maximum(mass * square - moment * moment, 0.0)


@triton.jit
def _mode(first, mass, moment, spread):
    return first + (moment - BACK * tl.sqrt(spread)) / tl.where(mass > 0, mass, 1.0)
