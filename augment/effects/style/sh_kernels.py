"""Numba kernel that folds colour maps into spherical harmonics, as fast as memory gives and takes.

Results go past the cache: a line that is written as a whole need not be read before.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import prange
from numba.core import types
from numba.extending import intrinsic

from augment.render.cpu.jit import inner, kernel
from augment.render.layout import LANES, U
from augment.render.sh import BLACK, FOLDED

SPLATS = 2048  # of a piece of work
RUN = 128  # splats mapped at a time, whose results (24 KB at degree 3) stay in the first cache
ALIGNMENT = 4 * LANES  # bytes, of the target


@intrinsic
def _stream(typingctx, source, at, target, to):
    """target[to : to + 8] = source[at : at + 8] past the cache; target + to is aligned."""

    def codegen(context, builder, sig, args):
        vector = ir.VectorType(ir.FloatType(), LANES)

        def pointer(kind, array, index):
            data = context.make_array(kind)(context, builder, array).data
            return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())

        value = builder.load(pointer(sig.args[0], args[0], args[1]), align=4)
        stored = builder.store(value, pointer(sig.args[2], args[2], args[3]), align=ALIGNMENT)
        one = ir.Constant(ir.IntType(32), 1)
        stored.set_metadata("nontemporal", builder.module.add_metadata([one]))
        return context.get_dummy_value()

    return types.void(source, types.uint64, target, types.uint64), codegen


@intrinsic
def _fence(typingctx):
    """Other threads see what was streamed before."""

    def codegen(context, builder, sig, args):
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), codegen


@inner()
def _map_splats(source, at, work, to, count, functions, folded):
    """`count` splats, from source[at:] to work[to:], by one map; see apply.map_sh for `least`."""
    least = BLACK if functions == U(1) else np.float32(-np.inf)
    a0, a1, a2 = folded[0], folded[1], folded[2]
    b0, b1, b2 = folded[3], folded[4], folded[5]
    c0, c1, c2 = folded[6], folded[7], folded[8]
    for i in range(count * functions):
        j, k = at + U(3) * i, to + U(3) * i
        red, green = max(source[j], least), max(source[j + U(1)], least)
        blue = max(source[j + U(2)], least)
        work[k] = a0 * red + a1 * green + a2 * blue
        work[k + U(1)] = b0 * red + b1 * green + b2 * blue
        work[k + U(2)] = c0 * red + c1 * green + c2 * blue
    row = U(3) * functions
    for splat in range(count):
        for channel in range(U(3)):
            work[to + splat * row + channel] += folded[U(9) + channel]


@inner()
def _map_run(source, first, end, work, functions, classes, folded):
    """Splats `first` to `end` into work; neighbours of one class together."""
    row = U(3) * functions
    at = first
    while at < end:
        last, of = end, U(0)
        if classes.size:
            of = U(classes[at])
            last = at + U(1)
            while last < end and U(classes[last]) == of:
                last += U(1)
        to = (at - first) * row
        if folded[of, U(FOLDED - 1)] != np.float32(0):
            _map_splats(source, at * row, work, to, last - at, functions, folded[of])
        else:
            for i in range((last - at) * row):
                work[to + i] = source[at * row + i]
        at = last


@kernel
def map_sh(source, target, functions, classes, folded):
    """target = source with every splat's functions mapped; both float32 [N * K * 3], or one array.

    target: aligned to ALIGNMENT bytes. functions: K. classes: int16 [N], rows of folded, or [0]
    where all splats take the first. folded: float32 [C, FOLDED]; a last number of 0 says that the
    map changes nothing, and the splat's bits are copied.
    """
    row = U(3 * functions)
    count = source.size // (3 * functions)
    for block in prange((count + SPLATS - 1) // SPLATS):
        work = np.empty(RUN * 3 * functions, np.float32)
        end = U(min((block + 1) * SPLATS, count))
        for first in range(U(block * SPLATS), end, U(RUN)):
            last = min(first + U(RUN), end)
            _map_run(source, first, last, work, U(functions), classes, folded)
            size = (last - first) * row
            whole = size - size % U(LANES)
            for i in range(U(0), whole, U(LANES)):
                _stream(work, i, target, first * row + i)
            for i in range(whole, size):
                target[first * row + i] = work[i]
        _fence()
