"""What kernels compute with: a value of 16 float32 lanes, one block of 4×4 pixels, and functions that vectorise.

LLVM maps `<16 x float>` to one AVX-512 register, two AVX, four SSE or four NEON ones, so that pixels are blended 16
at a time without relying on the loop vectoriser. Nothing here is fast-math: the forward and the backward kernels
must come to the same bits. Only what the kernels use is here.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from functools import wraps
from operator import add, mul, sub, truediv
from typing import Any

import numpy as np
from llvmlite import ir
from numba import int64
from numba.core import cgutils, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from .jit import inline_kernel

LANES = 16
I16, I32, I64 = ir.IntType(16), ir.IntType(32), ir.IntType(64)
VECTOR = ir.VectorType(ir.FloatType(), LANES)
INTEGERS = ir.VectorType(I32, LANES)
# 2^r on [-0.5, 0.5], highest power first: least relative error, 8e-8, in float32 2e-7 (Taylor: 3e-6)
EXP2 = (0.00132764714, 0.00967554157, 0.05550713277, 0.24022119720, 0.69314696706, 1.00000007166)
ROUNDING = 1.5 * 2.0**23  # added to a float32 it leaves the nearest integer in the low mantissa bits
ROUNDING64 = 1.5 * 2.0**52  # the same for a float64
LOG2E, LN2 = math.log2(math.e), math.log(2.0)
MANTISSA_BITS = np.int64(0xFFFFFFFFFFFFF)
INTEGER_BITS, INTEGER_OFFSET = np.int64(0x4330000000000000), 2.0**52  # float_of(INTEGER_BITS | k) = 2^52 + k


class Vec16Type(types.Type):
    """numba's type of a 16-lane vector."""


vec16 = Vec16Type(name="Vec16")
f32 = types.float32


@register_model(Vec16Type)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


def _constant(value: float) -> ir.Constant:
    rounded = struct.unpack("f", struct.pack("f", value))[0]  # LLVM wants the exact float32
    return ir.Constant(VECTOR, [rounded] * LANES)


def _integers(value: int) -> ir.Constant:
    return ir.Constant(INTEGERS, [value] * LANES)


def _shuffle(builder: Any, a: Any, b: Any, lanes: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(I32, len(lanes)), lanes))


def _splat(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(VECTOR, ir.Undefined)
    return _shuffle(builder, builder.insert_element(undefined, scalar, I32(0)), undefined, [0] * LANES)


def _vectors(builder: Any, sig: Any, args: Any) -> list[Any]:
    """The arguments, scalars spread over the lanes."""
    return [v if isinstance(t, Vec16Type) else _splat(builder, v) for v, t in zip(args, sig.args)]


def _call(builder: Any, name: str, *args: Any) -> Any:
    """An LLVM intrinsic over whole vectors."""
    kind = ir.FunctionType(VECTOR, [VECTOR] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v16f32"), args)


def _define_operator(op: Any, instruction: str) -> None:
    @infer_global(op)
    class _Template(ConcreteTemplate):
        cases = [signature(vec16, vec16, vec16), signature(vec16, vec16, f32), signature(vec16, f32, vec16)]  # noqa: RUF012

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*_vectors(builder, sig, args))

    for left, right in ((Vec16Type, Vec16Type), (Vec16Type, types.Float), (types.Float, Vec16Type)):
        lower_builtin(op, left, right)(lower)


for _op, _instruction in ((add, "fadd"), (sub, "fsub"), (mul, "fmul"), (truediv, "fdiv")):
    _define_operator(_op, _instruction)


def _pointer(context: Any, builder: Any, sig: Any, args: Any, pointee: Any = None, row: int = 0) -> Any:
    """Where array[index + row · stride] lies; args: the array, an index and, for rows after the first, a stride."""
    place = builder.add(args[1], builder.mul(args[2], I64(row))) if row else args[1]
    data = context.make_array(sig.args[0])(context, builder, args[0]).data
    pointer = builder.gep(data, [place], inbounds=True)
    return builder.bitcast(pointer, pointee.as_pointer()) if pointee else pointer


def _intrinsic(typed: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """LLVM code as a function for kernels; `typed` makes its signature of the typing context and arguments' types."""

    def decorate(code: Callable[..., Any]) -> Any:
        @wraps(typed)  # numba reads the names of the parameters
        def typer(*given: Any) -> Any:
            return typed(*given), code

        return intrinsic(typer)

    return decorate


@_intrinsic(lambda _, array, index: vec16(array, types.int64))
def load16(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Lanes array[index : index + 16] of a flat float32 array."""
    value = builder.load(_pointer(context, builder, sig, args, VECTOR))
    value.align = 4
    return value


@_intrinsic(lambda _, array, index, value: types.void(array, types.int64, vec16))
def store16(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """array[index : index + 16] = value."""
    builder.store(args[2], _pointer(context, builder, sig, args, VECTOR)).align = 4
    return context.get_dummy_value()


@_intrinsic(lambda _, array, index, stride, value: types.void(array, types.int64, types.int64, vec16))
def store_block(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """A block's 4 rows to array[index + row · stride : … + 4]."""
    for row in range(4):
        four = _shuffle(builder, args[3], args[3], list(range(4 * row, 4 * row + 4)))
        builder.store(four, _pointer(context, builder, sig, args, four.type, row)).align = 4
    return context.get_dummy_value()


@_intrinsic(lambda _, array, index, stride, x, y, z: types.void(array, types.int64, types.int64, vec16, vec16, vec16))
def store_block3(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """A block's 4 rows of 4 triples (x, y, z) to array[index + row · stride : … + 12]."""
    for row in range(4):
        lanes = range(4 * row, 4 * row + 4)
        pairs = _shuffle(builder, args[3], args[4], [v for k in lanes for v in (k, k + LANES)] + [0] * 8)
        chosen = [v for n, k in enumerate(lanes) for v in (2 * n, 2 * n + 1, k + LANES)]
        triples = _shuffle(builder, pairs, args[5], chosen)
        builder.store(triples, _pointer(context, builder, sig, args, triples.type, row)).align = 4
    return context.get_dummy_value()


def _block_loader(channels: int, channel: int) -> Any:
    @_intrinsic(lambda _, array, index, stride: vec16(array, types.int64, types.int64))
    def load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind, rows = ir.VectorType(ir.FloatType(), 4 * channels), []
        for row in range(4):
            loaded = builder.load(_pointer(context, builder, sig, args, kind, row))
            loaded.align = 4
            rows.append(_shuffle(builder, loaded, loaded, list(range(channel, 4 * channels, channels))))
        top, bottom = (_shuffle(builder, rows[k], rows[k + 1], list(range(8))) for k in (0, 2))
        return _shuffle(builder, top, bottom, list(range(LANES)))

    return load


# A block's 4 rows from array[index + row · stride : …]: 4 values each, or one channel of 4 triples.
load_block = _block_loader(1, 0)
_load_x, _load_y, _load_z = (_block_loader(3, c) for c in range(3))


@inline_kernel
def load_block3(array, index, stride):
    """A block's 4 rows of 4 triples from array[index + row · stride : … + 12], as store_block3 leaves them."""
    return _load_x(array, index, stride), _load_y(array, index, stride), _load_z(array, index, stride)


@_intrinsic(lambda _, array, index: array.dtype(array, types.int64))
def load1(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """array[index] without the wrap-around of negative indices, which would block vectorisation."""
    return builder.load(_pointer(context, builder, sig, args))


@_intrinsic(lambda _, array, index, value: types.void(array, types.int64, array.dtype))
def store1(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """array[index] = value without the wrap-around of negative indices."""
    builder.store(args[2], _pointer(context, builder, sig, args))
    return context.get_dummy_value()


@_intrinsic(lambda _, x: types.int64(types.float64))
def bits_of(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """The bits of a float64."""
    return builder.bitcast(args[0], I64)


@_intrinsic(lambda _, bits: types.float64(types.int64))
def float_of(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """The float64 with these bits."""
    return builder.bitcast(args[0], ir.DoubleType())


def _per_lane(build: Callable[..., Any]) -> Any:
    """A function of vectors, or scalars that go to every lane, to the vector that `build` makes of them."""

    @wraps(build)
    def typer(typing: Any, *given: Any) -> Any:
        return vec16(*given), lambda context, builder, sig, args: build(builder, *_vectors(builder, sig, args))

    return intrinsic(typer)


def _lanes(number: Callable[[int], int]) -> Any:
    return _per_lane(lambda builder: ir.Constant(VECTOR, [float(number(k)) for k in range(LANES)]))


def _selected(comparison: str) -> Callable[..., Any]:
    """Per lane: yes where the comparison of x and y holds, which it never does for NaN, else no."""
    return lambda builder, x, y, yes, no: builder.select(builder.fcmp_ordered(comparison, x, y), yes, no)


def _larger(builder: Any, x: Any, y: Any) -> Any:
    return _selected(">")(builder, x, y, x, y)


def _exp2(builder: Any, x: Any) -> Any:
    x = _larger(builder, x, _constant(-120.0))
    shifted = builder.fadd(x, _constant(ROUNDING))
    r = builder.fsub(x, builder.fsub(shifted, _constant(ROUNDING)))
    p = _constant(EXP2[0])
    for coefficient in EXP2[1:]:
        p = _call(builder, "fmuladd", p, r, _constant(coefficient))
    exponent = builder.shl(builder.bitcast(shifted, INTEGERS), _integers(23))
    return builder.bitcast(builder.add(builder.bitcast(p, INTEGERS), exponent), VECTOR)


ramp16 = _lanes(lambda k: k)  # 0, 1, … 15
columns16, rows16 = _lanes(lambda k: k % 4), _lanes(lambda k: k // 4)  # each lane's in a block of 4×4 pixels
splat16 = _per_lane(lambda builder, x: x)
sqrt16 = _per_lane(lambda builder, x: _call(builder, "sqrt", x))
floor16 = _per_lane(lambda builder, x: _call(builder, "floor", x))
exp2_16 = _per_lane(_exp2)  # 2^x for x ≤ 0; below −120 it is 2^−120
max16 = _per_lane(_larger)  # y where x is NaN, as with the smaller
min16 = _per_lane(lambda builder, x, y: _selected("<")(builder, x, y, x, y))
fma16 = _per_lane(lambda builder, a, b, c: _call(builder, "fmuladd", a, b, c))  # a · b + c, in one rounding if possible
where_greater, where_equal = _per_lane(_selected(">")), _per_lane(_selected("=="))  # (x, y, yes, no)


@_intrinsic(lambda _, x, low, high: types.boolean(vec16, f32, f32))
def any_between(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Whether low < x < high in any lane."""
    value, low, high = _vectors(builder, sig, args)
    inside = builder.and_(builder.fcmp_ordered(">", value, low), builder.fcmp_ordered("<", value, high))
    return builder.icmp_unsigned("!=", builder.bitcast(inside, I16), I16(0))


@_intrinsic(lambda _, first, end: types.uint64(vec16, vec16))
def spans_to_bits(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """A 64-bit mask: in byte k the bits first_k … end_k − 1, for lanes 0–7 of integers within 0 … 8."""
    low, high = (builder.shl(_integers(1), builder.fptosi(v, INTEGERS)) for v in args)
    span = builder.select(builder.icmp_signed(">", high, low), builder.sub(high, low), _integers(0))
    low_half = _shuffle(builder, span, span, list(range(8)))
    return builder.bitcast(builder.trunc(low_half, ir.VectorType(ir.IntType(8), 8)), I64)


@_intrinsic(lambda _, bits: types.int64(types.uint64))
def lowest_bit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Index of the lowest set bit of a mask that is not 0."""
    kind = ir.FunctionType(I64, [I64, ir.IntType(1)])
    function = cgutils.get_or_insert_function(builder.module, kind, "llvm.cttz.i64")
    return builder.call(function, [args[0], ir.Constant(ir.IntType(1), 1)])


@inline_kernel
def next_bit(mask):
    """Index of the lowest set bit of a mask that is not 0, and the mask without it."""
    return lowest_bit(mask), mask & (mask - types.uint64(1))


def _reduction(combine: Callable[..., Any]) -> Any:
    @_intrinsic(lambda _, x: f32(vec16))
    def reduced(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value, lanes = args[0], LANES
        while lanes > 1:  # halves, so that the order of additions is fixed
            lanes //= 2
            low, high = (_shuffle(builder, value, value, list(range(s, s + lanes))) for s in (0, lanes))
            value = combine(builder, low, high)
        return builder.extract_element(value, I32(0))

    return reduced


# The sum of the lanes, always in the same order, and the largest lane
sum16, highest16 = _reduction(lambda builder, low, high: builder.fadd(low, high)), _reduction(_larger)


@_intrinsic(lambda _, a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p: vec16(*[vec16] * LANES))
def sums16(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Lane k is the sum of the lanes of the k-th vector: 16 sums for the work of three."""
    vectors, width = list(args), LANES
    while len(vectors) > 1:  # every group of `width` lanes is added to half its width, two vectors to one
        width //= 2
        low = [k for k in range(2 * LANES) if k // width % 2 == 0]
        high = [k + width for k in low]
        vectors = [
            builder.fadd(_shuffle(builder, x, y, low), _shuffle(builder, x, y, high))
            for x, y in zip(vectors[::2], vectors[1::2])
        ]
    return vectors[0]


@_intrinsic(lambda _, array, index: types.void(array, types.int64))
def prefetch(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Ask the memory for the cache line of array[index]: the blend loop jumps between feature rows."""
    byte = ir.IntType(8).as_pointer()
    pointer = _pointer(context, builder, sig, args, ir.IntType(8))
    kind = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
    function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    builder.call(function, [pointer, I32(0), I32(3), I32(1)])
    return context.get_dummy_value()


@inline_kernel
def exp64(x):
    """e^x with a relative error of 1e-11 for |x| ≤ 700; it is clamped beyond. For exact kernels only: fast-math
    would cancel ROUNDING64."""
    x = min(max(x, -700.0), 700.0)
    shifted = x * LOG2E + ROUNDING64
    r = x - (shifted - ROUNDING64) * LN2
    p = 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    return float_of(bits_of(p) + (bits_of(shifted) << int64(52)))


@inline_kernel
def log2_64(y):
    """log₂ y of a normal number with an absolute error of 1e-11."""
    bits = bits_of(y)
    # the exponent is counted from √½, so that the mantissa lies in [√½, √2)
    lifted = bits - np.int64(0x3FE6A09E667F3BCD)
    exponent = float_of(INTEGER_BITS | ((lifted >> int64(52)) + int64(2048))) - (INTEGER_OFFSET + 2048.0)
    m = float_of((lifted & MANTISSA_BITS) + np.int64(0x3FE6A09E667F3BCD))
    s = (m - 1.0) / (m + 1.0)
    ss = s * s
    p = 1.0 / 13.0
    p = p * ss + 1.0 / 11.0
    p = p * ss + 1.0 / 9.0
    p = p * ss + 1.0 / 7.0
    p = p * ss + 1.0 / 5.0
    p = p * ss + 1.0 / 3.0
    p = p * ss + 1.0
    return exponent + 2.0 * LOG2E * s * p
