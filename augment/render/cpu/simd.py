"""Eight or sixteen float32 in one register: numba types with which kernels say what the processor
does.

A compiler's own vectoriser gives up on pixel loops for reasons that are hard to see and that change
with every release. `float8` and `float16` values are LLVM vectors instead: `+ - * /` work lane by
lane, and the functions below do the rest. Functions that make a vector from numbers make `float8`;
functions that take a vector make one of its type. So a kernel for `WIDE` lanes is the same source
on every processor.

There is no fast-math, and `fmuladd` is the only fused operation (if the processor has it). So the
bits of a result depend neither on the code around it nor on the number of lanes. Indices are uint64
into flat contiguous arrays; nothing checks them.
"""

from __future__ import annotations

import inspect
import math
import operator

import numba
import numpy as np
from llvmlite import ir
from numba.core import codegen, config, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from augment.render.cpu.jit import inner

# Lanes of float8.
LANES = 8
# Processor features that numba needs for sixteen lanes.
_AVX512 = {"+avx512f", "+avx512bw", "+avx512dq", "+avx512vl"}


def _widest() -> int:
    """Return the lanes of the widest register that numba compiles for, 8 or 16."""
    features = config.CPU_FEATURES
    features = codegen.get_host_cpu_features() if features is None else features
    return 16 if set(features.split(",")) >= _AVX512 else LANES


# Lanes of the widest register.
WIDE = _widest()

_INT = ir.IntType(32)
# Bits of the float32 nearest sqrt(1/2).
_SQRT_HALF = 0x3F3504F3


class _Floats(types.Type):
    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        super().__init__(name=f"float32x{lanes}")


class _Masks(types.Type):
    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        super().__init__(name=f"boolx{lanes}")


float8 = _Floats(8)
float16 = _Floats(16)


@register_model(_Floats)
class _FloatsModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.FloatType(), kind.lanes))


@register_model(_Masks)
class _MasksModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.lanes))


def _add_operator(op, method: str) -> None:
    """Let kernels write `vector op vector` for one instruction of the LLVM builder."""

    @infer_global(op)
    class _Typing(ConcreteTemplate):
        cases = [signature(kind, kind, kind) for kind in (float8, float16)]  # noqa: RUF012 - numba's way

    for kind in (float8, float16):

        @lower_builtin(op, kind, kind)
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


def _floats(lanes: int) -> ir.VectorType:
    return ir.VectorType(ir.FloatType(), lanes)


def _like(value, numbers):
    """Return a constant for each lane of a vector: the same number, or numbers lane by lane.

    Float numbers give floats; other numbers give int32.
    """
    lanes = value.type.count
    numbers = list(numbers) if hasattr(numbers, "__iter__") else [numbers] * lanes
    kind = ir.FloatType() if isinstance(numbers[0], float) else _INT
    return ir.Constant(ir.VectorType(kind, lanes), numbers)


def _bits(builder, value):
    return builder.bitcast(value, ir.VectorType(_INT, value.type.count))


def _numbers(builder, value):
    return builder.bitcast(value, _floats(value.type.count))


def _broadcast(builder, value, lanes):
    kind = ir.VectorType(value.type, lanes)
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, value, _INT(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_INT, lanes), None))


def _call(builder, name: str, args):
    kind = args[0].type
    function = builder.module.declare_intrinsic(
        f"llvm.{name}.v{kind.count}f32", (), ir.FunctionType(kind, [kind] * len(args))
    )
    return builder.call(function, args)


def _load(lanes: int):
    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[-2], *args[-2:])
        return builder.load(builder.bitcast(at, _floats(lanes).as_pointer()), align=4)

    return codegen


@intrinsic
def load(typingctx, array, index):
    """Return array[index : index + 8]."""
    return float8(array, types.uint64), _load(LANES)


@intrinsic
def load_as(typingctx, vector, array, index):
    """Return array[index : index + lanes], with the lanes of the vector."""
    return vector(vector, array, types.uint64), _load(vector.lanes)


@intrinsic
def store(typingctx, array, index, value):
    """Store array[index : index + lanes] = value."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args[:2])
        builder.store(args[2], builder.bitcast(at, args[2].type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, value), codegen


@intrinsic
def store_whole(typingctx, array, index, value):
    """Store array[index : index + lanes] = value without its fraction, for an int32 array."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args[:2])
        integers = builder.fptosi(args[2], ir.VectorType(_INT, args[2].type.count))
        builder.store(integers, builder.bitcast(at, integers.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, value), codegen


@intrinsic
def store_ramp(typingctx, array, index, start):
    """Store array[index : index + 8] = start + (0 ... 7), for an int32 array."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args[:2])
        start = _broadcast(builder, args[2], LANES)
        ramp = builder.add(start, _like(start, range(LANES)))
        builder.store(ramp, builder.bitcast(at, ramp.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, types.int32), codegen


@intrinsic
def transpose_rows(typingctx, vector, array, rows, first, last, transposed, column):
    """Store transposed[field, column + lane] = array[rows[first + lane], field] for 16 fields, all
    lanes.

    array: flat, rows of 16. rows: int32; the row at `last` stands for those after it. transposed:
    flat, rows of 32.
    """
    lanes = vector.lanes

    def codegen(context, builder, sig, args):
        wide = ir.IntType(64)
        kind = _floats(lanes).as_pointer()
        starts = []
        for lane in range(lanes):
            number = builder.add(args[3], wide(lane))
            is_last = builder.icmp_unsigned(">", number, args[4])
            number = builder.select(is_last, args[4], number)
            row = builder.load(_pointer(context, builder, sig.args[2], args[2], number))
            starts.append(builder.shl(builder.zext(row, wide), wide(4)))
        for field in range(0, 16, lanes):
            values = []
            for start in starts:
                index = builder.add(start, wide(field))
                pointer = _pointer(context, builder, sig.args[1], args[1], index)
                values.append(builder.load(builder.bitcast(pointer, kind), align=4))
            for k, value in enumerate(_transposed(builder, values)):
                index = builder.add(args[6], wide(32 * (field + k)))
                pointer = _pointer(context, builder, sig.args[5], args[5], index)
                builder.store(value, builder.bitcast(pointer, kind), align=4)
        return context.get_dummy_value()

    number = types.uint64
    return types.void(vector, array, rows, number, number, transposed, number), codegen


def _transposed(builder, rows):
    """Return the transpose of a square of vectors. Every step is one AVX instruction."""
    lanes = len(rows)

    def pick(left, right, numbers):
        return builder.shuffle_vector(left, right, _like(left, numbers))

    def weave(left, right, width, half):
        """Return one half of every four lanes of both vectors, alternating after `width` lanes."""
        numbers = [
            block + 2 * half + repeat * width + k + side * lanes
            for block in range(0, lanes, 4)
            for repeat in range(2 // width)
            for side in range(2)
            for k in range(width)
        ]
        return pick(left, right, numbers)

    groups = []  # for each four rows, their columns k, k + 4, ... as fours of lanes in vector k
    for i in range(0, lanes, 4):
        pairs = [weave(*rows[j : j + 2], 1, half) for j in (i, i + 2) for half in range(2)]
        groups.append(
            [weave(pairs[k], pairs[k + 2], 2, half) for k in range(2) for half in range(2)]
        )
    while len(groups) > 1:  # the even, then the odd fours of two
        fours = [[n for n in range(2 * lanes) if n // 4 % 2 == odd] for odd in range(2)]
        groups = [
            [
                pick(left, right, numbers)
                for numbers in fours
                for left, right in zip(*pair, strict=True)
            ]
            for pair in zip(groups[::2], groups[1::2], strict=True)
        ]
    return groups[0]


@intrinsic
def gather(typingctx, array, rows, first, stride, column):
    """Return array[rows[first + lane] * stride + column]; rows is an int32 array."""

    def codegen(context, builder, sig, args):
        wide = ir.IntType(64)
        value = ir.Constant(_floats(LANES), ir.Undefined)
        for lane in range(LANES):
            at = builder.add(args[2], wide(lane))
            row = builder.load(_pointer(context, builder, sig.args[1], args[1], at))
            index = builder.add(builder.mul(builder.zext(row, wide), args[3]), args[4])
            element = builder.load(_pointer(context, builder, sig.args[0], args[0], index))
            value = builder.insert_element(value, element, _INT(lane))
        return value

    return float8(array, rows, types.uint64, types.uint64, types.uint64), codegen


def _operation(result, *kinds):
    """Return a decorator that makes a function for kernels from emit(builder, *values).

    emit writes the instructions. _Floats and _Masks among the types have as many lanes as the
    vectors that the function gets.
    """

    def wrap(emit):
        def codegen(context, builder, sig, args):
            return emit(builder, *args)

        def define(typingctx, *values):
            lanes = next((value.lanes for value in values if hasattr(value, "lanes")), None)
            lane_types = [
                kind(lanes) if isinstance(kind, type) else kind for kind in (result, *kinds)
            ]
            return lane_types[0](*lane_types[1:]), codegen

        names = ("typingctx", *"abcdefgh"[: len(kinds)])
        define.__name__ = emit.__name__
        define.__signature__ = inspect.Signature(
            [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in names]
        )
        return intrinsic(define)

    return wrap


_unary = _operation(_Floats, _Floats)
_binary = _operation(_Floats, _Floats, _Floats)
_ternary = _operation(_Floats, *[_Floats] * 3)
_comparison = _operation(_Masks, _Floats, _Floats)

# The same number in all lanes, of eight or of the vector's; 0, 1, ... 7; a b + c, rounded once.
splat = _operation(float8, types.float32)(lambda b, value: _broadcast(b, value, LANES))
splat_as = _operation(_Floats, _Floats, types.float32)(
    lambda b, vector, value: _broadcast(b, value, vector.type.count)
)
lane_numbers = _operation(float8)(
    lambda b: ir.Constant(_floats(LANES), [*map(float, range(LANES))])
)
fmuladd = _ternary(lambda b, *args: _call(b, "fmuladd", args))
sqrt = _unary(lambda b, value: _call(b, "sqrt", [value]))
floor = _unary(lambda b, value: _call(b, "floor", [value]))
negate = _unary(lambda b, value: b.fneg(value))
# a where a < b (a > b), else b, so b where a is NaN.
minimum = _binary(lambda b, *args: b.select(b.fcmp_ordered("<", *args), *args))
maximum = _binary(lambda b, *args: b.select(b.fcmp_ordered(">", *args), *args))
# Masks of the lanes where a > b, or a >= b (not where either is NaN), and of lanes in both masks.
greater = _comparison(lambda b, *args: b.fcmp_ordered(">", *args))
at_least = _comparison(lambda b, *args: b.fcmp_ordered(">=", *args))
both = _operation(_Masks, _Masks, _Masks)(lambda b, *masks: b.and_(*masks))
# a in the lanes of the mask, b in the others: select(mask, a, b).
select = _operation(_Floats, _Masks, _Floats, _Floats)(lambda b, *args: b.select(*args))
# One bit for each lane of a mask.
mask_bits = _operation(types.uint64, _Masks)(
    lambda b, mask: b.zext(b.bitcast(mask, ir.IntType(mask.type.count)), ir.IntType(64))
)
# The number of the lowest bit that is set; there must be one.
lowest_bit = _operation(types.uint64, types.uint64)(lambda b, bits: b.cttz(bits, ir.IntType(1)(1)))

# ---- Pixels of a register: eight columns, of one row or, sixteen of them, of two rows in turn ----

ROWS = WIDE // LANES
wide_columns = _operation(_Floats(WIDE))(
    lambda b: ir.Constant(_floats(WIDE), [float(i // ROWS) for i in range(WIDE)])
)
# Number of rows of a vector's pixels, and the row of every lane.
rows_in = _operation(types.uint64, _Floats)(
    lambda b, vector: ir.IntType(64)(vector.type.count // LANES)
)
row_numbers = _unary(
    lambda b, vector: _like(
        vector, [float(i % (vector.type.count // LANES)) for i in range(vector.type.count)]
    )
)


@intrinsic
def load_row(typingctx, vector, array, index):
    """Return one row of a vector that begins at array[index]; index is its place plus the row."""
    lanes = vector.lanes
    load_lanes = _load(vector.lanes)

    def codegen(context, builder, sig, args):
        value = load_lanes(context, builder, sig, args)
        mask = ir.Constant(ir.VectorType(_INT, LANES), [*range(0, lanes, lanes // LANES)])
        return builder.shuffle_vector(value, value, mask)

    return float8(vector, array, types.uint64), codegen


@intrinsic
def by_row(typingctx, vector, array, index):
    """Return array[index] in all lanes, or, for two rows, array[2 index] and array[2 index + 1]."""
    lanes = vector.lanes

    def codegen(context, builder, sig, args):
        rows = lanes // LANES
        index = builder.mul(args[2], ir.IntType(64)(rows))
        at = _pointer(context, builder, sig.args[1], args[1], index)
        kind = ir.FloatType() if rows == 1 else ir.DoubleType()
        value = builder.load(builder.bitcast(at, kind.as_pointer()), align=4)
        return builder.bitcast(_broadcast(builder, value, lanes // rows), _floats(lanes))

    return vector(vector, array, types.uint64), codegen


@_unary
def minus_abs(builder, value):
    """Return -|a|: a with its sign bit set."""
    return _numbers(builder, builder.or_(_bits(builder, value), _like(value, -(2**31))))


@_unary
def absolute(builder, value):
    """Return |a|: a with its sign bit clear."""
    return _numbers(builder, builder.and_(_bits(builder, value), _like(value, 2**31 - 1)))


@_operation(float8, *[float8] * LANES)
def totals(builder, *rows):
    """Return the sums of the lanes of a to h, as lanes 0 to 7; the order of addition is fixed."""

    def fold(left, right, low, high):
        halves = [builder.shuffle_vector(left, right, _like(left, lanes)) for lanes in (low, high)]
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


@_operation(types.float32, float8, types.uint64)
def lane(builder, value, number):
    return builder.extract_element(value, number)


# ---- Pixels of three colours, which lie one after the other --------------------------------------
# 24 such numbers fill three registers. A colour's number of a pixel is in lane
# (colour + 3 pixel) % 8, so each register has a colour's numbers in lanes where the other two have
# none. Two blends and a permutation sort them, and the same steps lead back.

_MIXED = [[(colour + 3 * pixel) % LANES for pixel in range(LANES)] for colour in range(3)]


def _owner(colour: int, lane: int) -> int:
    """Return the number of the register, of three, that has a colour's number in a lane."""
    return (colour + 3 * _MIXED[colour].index(lane)) // LANES


def _blend(builder, values, choose):
    """Return lane by lane the value that `choose` names."""
    picks = [choose(lane) for lane in range(LANES)]
    first_lanes = [lane + LANES * (pick == 1) for lane, pick in enumerate(picks)]
    mixed = builder.shuffle_vector(*values[:2], _like(values[0], first_lanes))
    all_lanes = [lane + LANES * (pick == 2) for lane, pick in enumerate(picks)]
    return builder.shuffle_vector(mixed, values[2], _like(mixed, all_lanes))


@intrinsic
def load_colours(typingctx, array, index):
    """Return red, green and blue of the eight pixels from array[index] on."""
    kind = types.UniTuple(float8, 3)

    def codegen(context, builder, sig, args):
        at = builder.bitcast(
            _pointer(context, builder, sig.args[0], *args), _floats(LANES).as_pointer()
        )
        rows = [builder.load(builder.gep(at, [_INT(k)]), align=4) for k in range(3)]
        sorted_rows = []
        for colour in range(3):
            mixed = _blend(builder, rows, lambda lane, c=colour: _owner(c, lane))
            lanes = _like(mixed, _MIXED[colour])
            sorted_rows.append(builder.shuffle_vector(mixed, mixed, lanes))
        return context.make_tuple(builder, kind, sorted_rows)

    return kind(array, types.uint64), codegen


@intrinsic
def store_colours(typingctx, array, index, red, green, blue):
    """Store red, green and blue of the eight pixels from array[index] on."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args[:2])
        at = builder.bitcast(at, _floats(LANES).as_pointer())
        mixed = []
        for colour, value in enumerate(args[2:]):
            lanes = [_MIXED[colour].index(lane) for lane in range(LANES)]
            mixed.append(builder.shuffle_vector(value, value, _like(value, lanes)))
        for k in range(3):
            source_registers = [
                next(c for c in range(3) if _owner(c, lane) == k) for lane in range(LANES)
            ]
            row = _blend(
                builder,
                mixed,
                lambda lane, source_registers=source_registers: source_registers[lane],
            )
            builder.store(row, builder.gep(at, [_INT(k)]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uint64, float8, float8, float8), codegen


@_operation(types.boolean, _Floats)
def any_not_negative(builder, value):
    """Return True if the sign bit of any lane is clear."""
    all_bits = ir.IntType(value.type.count)
    clear = builder.icmp_signed(">=", _bits(builder, value), _like(value, 0))
    return builder.icmp_unsigned("!=", builder.bitcast(clear, all_bits), all_bits(0))


def _exponent_bits(builder, value):
    above = builder.sub(_bits(builder, value), _like(value, _SQRT_HALF))
    return builder.ashr(above, _like(value, 23))


@_unary
def exponent(builder, value):
    """Return the k for which a / 2**k lies in [sqrt(1/2), sqrt(2)); a > 0 and normal."""
    return builder.sitofp(_exponent_bits(builder, value), value.type)


@_unary
def mantissa(builder, value):
    """Return a / 2**exponent(a)."""
    power = builder.shl(_exponent_bits(builder, value), _like(value, 23))
    return _numbers(builder, builder.sub(_bits(builder, value), power))


def _prefetch(to_write: int):
    """Return the code generator of a prefetch, to read or to write."""

    def codegen(context, builder, sig, args):
        at = _pointer(context, builder, sig.args[0], *args)
        kind = ir.FunctionType(ir.VoidType(), [at.type, _INT, _INT, _INT])
        function = builder.module.declare_intrinsic("llvm.prefetch", [at.type], kind)
        builder.call(function, [at, _INT(to_write), _INT(3), _INT(1)])  # to keep, data
        return context.get_dummy_value()

    return codegen


@intrinsic
def prefetch(typingctx, array, index):
    """Fetch the cache line of array[index] before it is needed."""
    return types.void(array, types.uint64), _prefetch(0)


@intrinsic
def prefetch_to_write(typingctx, array, index):
    """Fetch the cache line of array[index] before it is written."""
    return types.void(array, types.uint64), _prefetch(1)


# ---- Beyond arithmetic: exponentials, logarithms, arrays by address ------------------------------

LOG2_E = np.float32(math.log2(math.e))
# Number whose addition leaves the nearest integer in the low bits.
_ROUND = 1.5 * 2**23
# 2**x on [-0.5, 0.5], least maximal relative error (2.6e-6), lowest power first.
_COARSE = tuple(
    np.float32(c) for c in (0.999999261, 0.693121815, 0.240247448, 0.0559178609, 0.00957010198)
)
# The same with 2**0 exactly 1 (9e-8).
_FINE = tuple(
    np.float32(c) for c in (1, 0.693146978, 0.240222421, 0.0555073374, 0.00967151266, 0.00132647272)
)
# log2((1 + s) / (1 - s)) = 2 / ln 2 (s + s^3 / 3 + s^5 / 5 + ...)
_LOG1, _LOG3, _LOG5, _LOG7 = (np.float32(2 / math.log(2) / n) for n in (1, 3, 5, 7))


def _emit_exp2(builder, coefficients, x, mask=None):
    """Write the instructions of 2**x; lanes outside the mask, if there is one, become 0.

    With AVX-512, the distance of x from the nearest integer and a scaling by 2**k are one
    instruction each, with the same bits. Lanes outside the mask must not be scaled: numbers below
    2**-126 would cost a hundred times as much.

    coefficients: of 2**x on [-0.5, 0.5].
    """
    lanes = x.type.count
    has_avx512 = lanes == 16
    if has_avx512:
        fraction = _avx512(builder, "reduce", [x, _INT(8)])  # 8: from the nearest, no exceptions
        power = builder.fsub(x, fraction)
    else:
        power = builder.fadd(x, _like(x, _ROUND))
        fraction = builder.fsub(x, builder.fsub(power, _like(x, _ROUND)))
    power_of_fraction = _like(x, float(coefficients[-1]))
    for coefficient in coefficients[-2::-1]:
        power_of_fraction = _call(
            builder, "fmuladd", [power_of_fraction, fraction, _like(x, float(coefficient))]
        )
    if has_avx512:
        return _avx512(builder, "scalef", [power_of_fraction, power], mask)
    power = builder.shl(_bits(builder, power), _like(x, 23))
    scaled = _numbers(builder, builder.add(_bits(builder, power_of_fraction), power))
    return scaled if mask is None else builder.select(mask, scaled, _like(x, 0.0))


def _avx512(builder, name: str, args, mask=None):
    """Write an AVX-512 instruction on sixteen floats; lanes outside the mask become 0."""
    kind = args[0].type
    bits16 = ir.IntType(16)
    mask = bits16(-1) if mask is None else builder.bitcast(mask, bits16)
    args = [*args, _like(args[0], 0.0), mask, _INT(4)]  # 4: round as always
    function = builder.module.declare_intrinsic(
        f"llvm.x86.avx512.mask.{name}.ps.512", (), ir.FunctionType(kind, [a.type for a in args])
    )
    return builder.call(function, args)


# 2**x for |x| <= 126, and undefined elsewhere, with a relative error of 3e-6. The second is 0
# outside a mask.
exp2 = _unary(lambda b, x: _emit_exp2(b, _COARSE, x))
exp2_where = _operation(_Floats, _Masks, _Floats)(
    lambda b, mask, x: _emit_exp2(b, _COARSE, x, mask)
)
# 2**x to float32's precision, and exact at 0.
exp2_fine = _unary(lambda b, x: _emit_exp2(b, _FINE, x))


@inner()
def log2(x):
    """Return the base-2 logarithm of eight normal x > 0; error below 2e-7 (1 + |result|)."""
    ones = splat(np.float32(1))
    m = mantissa(x)
    s = (m - ones) / (m + ones)
    ss = s * s
    p = fmuladd(splat(_LOG7), ss, splat(_LOG5))
    p = fmuladd(p, ss, splat(_LOG3))
    p = fmuladd(p, ss, splat(_LOG1))
    return fmuladd(p, s, exponent(x))


@_operation(types.float32, *[types.float32] * 3)
def scalar_fmuladd(builder, *args):
    """Return a b + c of scalars, rounded once if the processor has fused multiply-add."""
    kind = ir.FunctionType(ir.FloatType(), [ir.FloatType()] * 3)
    return builder.call(builder.module.declare_intrinsic("llvm.fmuladd.f32", (), kind), args)


def _pointer_to(number, bits):
    """Return a function that makes a pointer from an address."""
    to = _operation(types.CPointer(number), types.uint64)
    return to(lambda b, address: b.inttoptr(address, bits.as_pointer()))


_float_pointer = _pointer_to(types.float32, ir.FloatType())
_short_pointer = _pointer_to(types.int16, ir.IntType(16))


@inner()
def shorts_at(address, count):
    """Return the int16 array of `count` numbers at an address; the caller keeps it alive."""
    return numba.carray(_short_pointer(address), (count,))


@inner()
def floats_at(address, count):
    """Return the float32 array of `count` numbers at an address; the caller keeps it alive.

    One launch can then serve any number of scene parts, whose arrays differ in shape.
    """
    return numba.carray(_float_pointer(address), (count,))
