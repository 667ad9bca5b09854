"""What the CPU kernels need beyond arithmetic: exponentials, logarithms, arrays by address."""

from __future__ import annotations

import math

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from augment.render import cpu_simd as v8
from augment.render.cpu_jit import inner

LOG2_E = np.float32(math.log2(math.e))
_ROUND = np.float32(1.5 * 2**23)  # adding it leaves the nearest integer in the low bits
# 2**x on [-0.5, 0.5], least maximal relative error (2.6e-6), lowest power first.
_EXP0 = np.float32(0.999999261)
_EXP1 = np.float32(0.693121815)
_EXP2 = np.float32(0.240247448)
_EXP3 = np.float32(0.0559178609)
_EXP4 = np.float32(0.00957010198)
# 2**x likewise with 2**0 exactly 1 (9e-8).
_FINE = tuple(
    np.float32(c) for c in (0.693146978, 0.240222421, 0.0555073374, 0.00967151266, 0.00132647272)
)
# log2((1 + s) / (1 - s)) = 2 / ln 2 (s + s^3 / 3 + s^5 / 5 + ...)
_LOG1, _LOG3, _LOG5, _LOG7 = (np.float32(2 / math.log(2) / n) for n in (1, 3, 5, 7))


@inner()
def exp2(x):
    """2**x, eight at once, for |x| <= 126; any bits at all elsewhere. Relative error 3e-6."""
    shifted = x + v8.splat(_ROUND)
    f = x - (shifted - v8.splat(_ROUND))
    p = v8.fmuladd(v8.splat(_EXP4), f, v8.splat(_EXP3))
    p = v8.fmuladd(p, f, v8.splat(_EXP2))
    p = v8.fmuladd(p, f, v8.splat(_EXP1))
    p = v8.fmuladd(p, f, v8.splat(_EXP0))
    return v8.add_exponent(p, shifted)


@inner()
def exp2_fine(x):
    """2**x as `exp2`, to float32's precision and exact at 0."""
    shifted = x + v8.splat(_ROUND)
    f = x - (shifted - v8.splat(_ROUND))
    p = v8.fmuladd(v8.splat(_FINE[4]), f, v8.splat(_FINE[3]))
    p = v8.fmuladd(p, f, v8.splat(_FINE[2]))
    p = v8.fmuladd(p, f, v8.splat(_FINE[1]))
    p = v8.fmuladd(p, f, v8.splat(_FINE[0]))
    p = v8.fmuladd(p, f, v8.splat(np.float32(1)))
    return v8.add_exponent(p, shifted)


@inner()
def log2(x):
    """Base-2 logarithm, eight at once, for normal x > 0; error below 2e-7 (1 + |result|)."""
    one = v8.splat(np.float32(1))
    m = v8.mantissa(x)
    s = (m - one) / (m + one)
    ss = s * s
    p = v8.fmuladd(v8.splat(_LOG7), ss, v8.splat(_LOG5))
    p = v8.fmuladd(p, ss, v8.splat(_LOG3))
    p = v8.fmuladd(p, ss, v8.splat(_LOG1))
    return v8.fmuladd(p, s, v8.exponent(x))


@intrinsic
def fmuladd(typingctx, a, b, c):
    """a b + c of scalars, rounded once where the processor has fused multiply-add."""

    def codegen(context, builder, sig, args):
        single = ir.FloatType()
        kind = ir.FunctionType(single, [single] * 3)
        return builder.call(builder.module.declare_intrinsic("llvm.fmuladd.f32", (), kind), args)

    return types.float32(types.float32, types.float32, types.float32), codegen


@intrinsic
def _float_pointer(typingctx, address):
    def codegen(context, builder, sig, args):
        return builder.inttoptr(args[0], ir.FloatType().as_pointer())

    return types.CPointer(types.float32)(types.uint64), codegen


@intrinsic
def _short_pointer(typingctx, address):
    def codegen(context, builder, sig, args):
        return builder.inttoptr(args[0], ir.IntType(16).as_pointer())

    return types.CPointer(types.int16)(types.uint64), codegen


@inner()
def shorts_at(address, count):
    """The int16 array of `count` numbers at a memory address; the caller keeps it alive."""
    return numba.carray(_short_pointer(address), (count,))


@inner()
def floats_at(address, count):
    """The float32 array of `count` numbers at a memory address; the caller keeps it alive.

    One launch can then serve any number of scene parts, whose arrays differ in shape.
    """
    return numba.carray(_float_pointer(address), (count,))
