"""Kernel functions for eight numbers or eight vectors at a time.

Other kernels call these functions; they are compiled into them. `augment.render.cpu.simd` has the
operations.
"""

from __future__ import annotations

import numpy as np

from augment.render.cpu import simd as v8
from augment.render.cpu.jit import kernel_function
from augment.render.layout import NUM_LANES, Index


@kernel_function()
def copies(value):
    """Return eight copies of a number."""
    return v8.broadcast(np.float32(value))


@kernel_function()
def vector_copies(x, y, z):
    """Return eight copies of a vector."""
    return copies(x), copies(y), copies(z)


@kernel_function()
def dot(a, b):
    """Return the dot products of eight vectors and eight others."""
    return v8.fmuladd(a[0], b[0], v8.fmuladd(a[1], b[1], a[2] * b[2]))


@kernel_function()
def largest_of(values):
    """Return the largest of eight numbers."""
    largest = v8.lane(values, Index(0))
    for lane in range(Index(1), Index(NUM_LANES)):
        largest = max(largest, v8.lane(values, lane))
    return largest
