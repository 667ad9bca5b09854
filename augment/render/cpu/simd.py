"""Eight float32 in one register: a numba type, so that kernels say what the processor does.

A compiler's own vectoriser gives up on pixel loops for reasons that are hard to see and change with
every release. `Float8` values are LLVM vectors instead: `+ - * /` work lane by lane, the rest are
the functions below. No fast-math anywhere, and `fmuladd` is the only fused operation (where the
processor has it), so the bits of a result do not depend on the code around it.
Indices are uint64 into flat contiguous arrays; nothing checks them.
"""

from __future__ import annotations

import inspect
import math
import operator

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from augment.render.cpu.jit import inner

LANES = 8

_INT = ir.IntType(32)
_F8 = ir.VectorType(ir.FloatType(), LANES)
_I8 = ir.VectorType(_INT, LANES)
_B8 = ir.VectorType(ir.IntType(1), LANES)
_SQRT_HALF = 0x3F3504F3  # bits of the float32 nearest sqrt(1/2)


class _Float8(types.Type):
    def __init__(self) -> None:
        super().__init__(name="float32x8")


class _Mask8(types.Type):
    def __init__(self) -> None:
        super().__init__(name="boolx8")


float8, mask8 = _Float8(), _Mask8()


@register_model(_Float8)
class _Float8Model(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, _F8)


@register_model(_Mask8)
class _Mask8Model(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, _B8)


def _add_operator(op, method: str) -> None:
    """Let kernels write `float8 op float8` for one instruction of the LLVM builder."""

    @infer_global(op)
    class _Typing(ConcreteTemplate):
        cases = [signature(float8, float8, float8)]  # noqa: RUF012 - numba's way

    @lower_builtin(op, float8, float8)
    def _lower(context, builder, sig, args):
        return getattr(builder, method)(*args)


for _op, _method in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _add_operator(_op, _method)


def _pointer(context, builder, array_type, array, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def _all(value):
    return ir.Constant(_I8, [value] * LANES)


def _broadcast(builder, value, kind):
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, value, _INT(0))
    return builder.shuffle_vector(first, undefined, _all(0))


def _call(builder, name: str, args):
    kind = ir.FunctionType(_F8, [_F8] * len(args))
    function = builder.module.declare_intrinsic(f"llvm.{name}.v8f32", (), kind)
    return builder.call(function, args)


@intrinsic
def load(typingctx, array, index):
    """array[index : index + 8]."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args)
        return builder.load(builder.bitcast(at, _F8.as_pointer()), align=4)

    return float8(array, types.uint64), codegen


@intrinsic
def store(typingctx, array, index, value):
    """array[index : index + 8] = value."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args[:2])
        builder.store(args[2], builder.bitcast(at, _F8.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, float8), codegen


@intrinsic
def store_ramp(typingctx, array, index, start, step):
    """array[index : index + 8] = start + step * (0 ... 7), for an int32 array."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args[:2])
        start, step = (_broadcast(builder, value, _I8) for value in args[2:])
        ramp = builder.mul(step, ir.Constant(_I8, list(range(LANES))))
        builder.store(builder.add(start, ramp), builder.bitcast(at, _I8.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, types.int32, types.int32), codegen


@intrinsic
def gather(typingctx, array, rows, first, stride, column):
    """array[rows[first + lane] * stride + column]; rows is an int32 array."""

    def codegen(context, builder, sig, args):
        wide = ir.IntType(64)
        value = ir.Constant(_F8, ir.Undefined)
        for lane in range(LANES):
            at = builder.add(args[2], wide(lane))
            row = builder.load(_pointer(context, builder, sig.args[1], args[1], at))
            index = builder.add(builder.mul(builder.zext(row, wide), args[3]), args[4])
            element = builder.load(_pointer(context, builder, sig.args[0], args[0], index))
            value = builder.insert_element(value, element, _INT(lane))
        return value

    return float8(array, rows, types.uint64, types.uint64, types.uint64), codegen


def _operation(result, *kinds):
    """Makes a function for kernels of emit(builder, *values), which writes its instructions."""

    def wrap(emit):
        def codegen(context, builder, sig, args):
            return emit(builder, *args)

        def define(typingctx, *values):
            return result(*kinds), codegen

        names = ("typingctx", *"abcdefgh"[: len(kinds)])
        define.__name__ = emit.__name__
        define.__signature__ = inspect.Signature(
            [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in names]
        )
        return intrinsic(define)

    return wrap


_unary, _binary = _operation(float8, float8), _operation(float8, float8, float8)
_ternary, _comparison = _operation(float8, *[float8] * 3), _operation(mask8, float8, float8)

# The same number in all lanes; 0, 1, ... 7; a b + c, rounded once.
splat = _operation(float8, types.float32)(lambda b, value: _broadcast(b, value, _F8))
lane_numbers = _operation(float8)(lambda b: ir.Constant(_F8, [float(i) for i in range(LANES)]))
fmuladd = _ternary(lambda b, *args: _call(b, "fmuladd", args))
sqrt = _unary(lambda b, value: _call(b, "sqrt", [value]))
floor = _unary(lambda b, value: _call(b, "floor", [value]))
negate = _unary(lambda b, value: b.fneg(value))
# a where a < b (a > b), else b, so b where a is NaN.
minimum = _binary(lambda b, *args: b.select(b.fcmp_ordered("<", *args), *args))
maximum = _binary(lambda b, *args: b.select(b.fcmp_ordered(">", *args), *args))
# Lanes where a > b, or a >= b; never where either is NaN. Lanes that are in both masks.
greater = _comparison(lambda b, *args: b.fcmp_ordered(">", *args))
at_least = _comparison(lambda b, *args: b.fcmp_ordered(">=", *args))
both = _operation(mask8, mask8, mask8)(lambda b, *masks: b.and_(*masks))
# a in the lanes of the mask, b in the others: select(mask, a, b).
select = _operation(float8, mask8, float8, float8)(lambda b, *args: b.select(*args))


@_unary
def minus_abs(builder, value):
    """-|a|: a with its sign bit set."""
    return builder.bitcast(builder.or_(builder.bitcast(value, _I8), _all(-(2**31))), _F8)


@_unary
def absolute(builder, value):
    """|a|: a with its sign bit clear."""
    return builder.bitcast(builder.and_(builder.bitcast(value, _I8), _all(2**31 - 1)), _F8)


@_operation(float8, *[float8] * LANES)
def totals(builder, *rows):
    """The sums of the eight lanes of a to h, as lanes 0 to 7; always added in the same order."""

    def fold(left, right, low, high):
        halves = [
            builder.shuffle_vector(left, right, ir.Constant(_I8, lanes)) for lanes in (low, high)
        ]
        return builder.fadd(*halves)

    pairs = [
        fold(rows[i], rows[i + 1], [0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15])
        for i in range(0, LANES, 2)
    ]
    fours = [
        fold(*pairs[i : i + 2], [0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15])
        for i in (0, 2)
    ]
    return fold(*fours, [0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15])


# ---- Pixels of three colours, which lie one after the other --------------------------------------
# Of 24 such numbers each register has a colour's in lanes that the other two have not: lane
# (colour + 3 pixel) % 8. So two blends and a permutation sort them, and the same way back.

_MIXED = [[(colour + 3 * pixel) % LANES for pixel in range(LANES)] for colour in range(3)]


def _owner(colour: int, lane: int) -> int:
    """Which of three registers has a colour's number in a lane."""
    return (colour + 3 * _MIXED[colour].index(lane)) // LANES


def _blend(builder, values, choose):
    """Lane by lane the value that `choose` names."""
    pairs = [choose(lane) for lane in range(LANES)]
    two = [lane + LANES * (pick == 1) for lane, pick in enumerate(pairs)]
    mixed = builder.shuffle_vector(*values[:2], ir.Constant(_I8, two))
    three = [lane + LANES * (pick == 2) for lane, pick in enumerate(pairs)]
    return builder.shuffle_vector(mixed, values[2], ir.Constant(_I8, three))


@intrinsic
def load_colours(typingctx, array, index):
    """Red, green and blue of the eight pixels from array[index] on."""
    kind = types.UniTuple(float8, 3)

    def codegen(context, builder, sig, args):
        at = builder.bitcast(_pointer(context, builder, sig.args[0], *args), _F8.as_pointer())
        rows = [builder.load(builder.gep(at, [_INT(k)]), align=4) for k in range(3)]
        sorted_rows = []
        for colour in range(3):
            mixed = _blend(builder, rows, lambda lane, c=colour: _owner(c, lane))
            lanes = ir.Constant(_I8, _MIXED[colour])
            sorted_rows.append(builder.shuffle_vector(mixed, mixed, lanes))
        return context.make_tuple(builder, kind, sorted_rows)

    return kind(array, types.uint64), codegen


@intrinsic
def store_colours(typingctx, array, index, red, green, blue):
    """What `load_colours` loads."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args[:2])
        at = builder.bitcast(at, _F8.as_pointer())
        mixed = []
        for colour, value in enumerate(args[2:]):
            lanes = [_MIXED[colour].index(lane) for lane in range(LANES)]
            mixed.append(builder.shuffle_vector(value, value, ir.Constant(_I8, lanes)))
        for k in range(3):
            own = [next(c for c in range(3) if _owner(c, lane) == k) for lane in range(LANES)]
            row = _blend(builder, mixed, lambda lane, own=own: own[lane])
            builder.store(row, builder.gep(at, [_INT(k)]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, float8, float8, float8), codegen


@_operation(types.boolean, float8)
def any_not_negative(builder, value):
    """Whether the sign bit of any lane is clear."""
    clear = builder.icmp_signed(">=", builder.bitcast(value, _I8), _all(0))
    return builder.icmp_unsigned("!=", builder.bitcast(clear, ir.IntType(8)), ir.IntType(8)(0))


@_binary
def add_exponent(builder, *args):
    """a 2**k, where k stands in the low bits of b's bit pattern; overflow is not looked for."""
    bits, power = (builder.bitcast(arg, _I8) for arg in args)
    return builder.bitcast(builder.add(bits, builder.shl(power, _all(23))), _F8)


def _exponent_bits(builder, value):
    above = builder.sub(builder.bitcast(value, _I8), _all(_SQRT_HALF))
    return builder.ashr(above, _all(23))


@_unary
def exponent(builder, value):
    """The k for which a / 2**k lies in [sqrt(1/2), sqrt(2)); a > 0 and normal."""
    return builder.sitofp(_exponent_bits(builder, value), _F8)


@_unary
def mantissa(builder, value):
    """a / 2**exponent(a)."""
    power = builder.shl(_exponent_bits(builder, value), _all(23))
    return builder.bitcast(builder.sub(builder.bitcast(value, _I8), power), _F8)


@intrinsic
def prefetch(typingctx, array, index):
    """Ask for the cache line of array[index] before it is needed."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args)
        kind = ir.FunctionType(ir.VoidType(), [at.type, _INT, _INT, _INT])
        function = builder.module.declare_intrinsic("llvm.prefetch", [at.type], kind)
        builder.call(function, [at, _INT(0), _INT(3), _INT(1)])  # to read, to keep, data
        return context.get_dummy_value()

    return types.void(array, types.uint64), codegen


# ---- What the CPU kernels need beyond arithmetic: exponentials, logarithms, arrays by address ----

LOG2_E = np.float32(math.log2(math.e))
_ROUND = np.float32(1.5 * 2**23)  # adding it leaves the nearest integer in the low bits
# 2**x on [-0.5, 0.5], least maximal relative error (2.6e-6), lowest power first.
_COARSE = tuple(
    np.float32(c) for c in (0.999999261, 0.693121815, 0.240247448, 0.0559178609, 0.00957010198)
)
# 2**x likewise with 2**0 exactly 1 (9e-8).
_FINE = tuple(
    np.float32(c) for c in (1, 0.693146978, 0.240222421, 0.0555073374, 0.00967151266, 0.00132647272)
)
# log2((1 + s) / (1 - s)) = 2 / ln 2 (s + s^3 / 3 + s^5 / 5 + ...)
_LOG1, _LOG3, _LOG5, _LOG7 = (np.float32(2 / math.log(2) / n) for n in (1, 3, 5, 7))


@inner()
def exp2(x):
    """2**x, eight at once, for |x| <= 126; any bits at all elsewhere. Relative error 3e-6."""
    shifted = x + splat(_ROUND)
    f = x - (shifted - splat(_ROUND))
    p = fmuladd(splat(_COARSE[4]), f, splat(_COARSE[3]))
    p = fmuladd(p, f, splat(_COARSE[2]))
    p = fmuladd(p, f, splat(_COARSE[1]))
    return add_exponent(fmuladd(p, f, splat(_COARSE[0])), shifted)


@inner()
def exp2_fine(x):
    """2**x as `exp2`, to float32's precision and exact at 0."""
    shifted = x + splat(_ROUND)
    f = x - (shifted - splat(_ROUND))
    p = fmuladd(splat(_FINE[5]), f, splat(_FINE[4]))
    p = fmuladd(p, f, splat(_FINE[3]))
    p = fmuladd(p, f, splat(_FINE[2]))
    p = fmuladd(p, f, splat(_FINE[1]))
    return add_exponent(fmuladd(p, f, splat(_FINE[0])), shifted)


@inner()
def log2(x):
    """Base-2 logarithm, eight at once, for normal x > 0; error below 2e-7 (1 + |result|)."""
    one = splat(np.float32(1))
    m = mantissa(x)
    s = (m - one) / (m + one)
    ss = s * s
    p = fmuladd(splat(_LOG7), ss, splat(_LOG5))
    p = fmuladd(p, ss, splat(_LOG3))
    p = fmuladd(p, ss, splat(_LOG1))
    return fmuladd(p, s, exponent(x))


@_operation(types.float32, *[types.float32] * 3)
def scalar_fmuladd(builder, *args):
    """a b + c of scalars, rounded once where the processor has fused multiply-add."""
    kind = ir.FunctionType(ir.FloatType(), [ir.FloatType()] * 3)
    return builder.call(builder.module.declare_intrinsic("llvm.fmuladd.f32", (), kind), args)


def _pointer_to(number, bits):
    """From an address to a pointer."""
    to = _operation(types.CPointer(number), types.uint64)
    return to(lambda b, address: b.inttoptr(address, bits.as_pointer()))


_float_pointer = _pointer_to(types.float32, ir.FloatType())
_short_pointer = _pointer_to(types.int16, ir.IntType(16))


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
