"""Triton functions: mode depth (augment.render.mode_depth), one sample of every pixel at a time.

Sums are kept times the cluster's weight, so that a sample that joins costs no division and no root.
Of the heaviest cluster, too, the sums are kept, and its mode is formed once, at the end.
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
def add_sample(
    depth, weight, floor, first, mass, moment, square, best, best_first, best_moment, best_spread
):
    """The clusters with every pixel's next sample; those of weight 0 change nothing.

    Of the running cluster: first, the depth it began with, and the sums of w, w (z - first) and
    w (z - first)^2. Of the heaviest closed one: its weight, first, sum of w (z - first), and its
    weight^2 times the variance.
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
    is_best = begins & (mass > best)
    best = tl.where(is_best, mass, best)
    best_first = tl.where(is_best, first, best_first)
    best_moment = tl.where(is_best, moment, best_moment)
    best_spread = tl.where(is_best, spread, best_spread)
    first = tl.where(begins, depth, first)
    weighted = tl.where(begins, 0.0, weight * off)
    mass = tl.where(begins, 0.0, mass) + weight
    square = tl.where(begins, 0.0, square) + weighted * off
    moment = tl.where(begins, 0.0, moment) + weighted
    return first, mass, moment, square, best, best_first, best_moment, best_spread


@triton.jit
def can_grow(through, mass, best):
    """Whether a pixel's running cluster may still become the heaviest, or is it.

    through: the light left, negative where blending has stopped.
    """
    return (through > 0) & (mass + through + SLACK >= best)


@triton.jit
def heaviest_mode(first, mass, moment, square, best, best_first, best_moment, best_spread):
    """Mode of the heaviest cluster, the running one included; 0 where there is none."""
    is_last = mass > best
    spread = tl.where(is_last, _spread(mass, moment, square), best_spread)
    moment = tl.where(is_last, moment, best_moment)
    first = tl.where(is_last, first, best_first)
    mass = tl.maximum(mass, best)
    return first + (moment - BACK * tl.sqrt(spread)) / tl.where(mass > 0, mass, 1.0)


@triton.jit
def _spread(mass, moment, square):
    """mass^2 times the variance."""
    return tl.maximum(mass * square - moment * moment, 0.0)
