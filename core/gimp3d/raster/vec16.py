"""A value type inside numba kernels: 16 float32 lanes, one row of a 16×16 tile.

LLVM maps `<16 x float>` to one AVX-512 register, two AVX, four SSE or four NEON ones, so that pixels are
blended 16 at a time without relying on the loop vectoriser. Only what the blend kernels use is here.
"""

from __future__ import annotations

import operator
import struct
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

# The words `jit import` put this file into the hash that names the kernel cache (jit.py): kernels inline it.
LANES = 16
FAST = ("fast",)
VECTOR = ir.VectorType(ir.FloatType(), LANES)
INTEGERS = ir.VectorType(ir.IntType(32), LANES)
# 2^r on [-0.5, 0.5], highest power first: least relative error, 8e-8, in float32 2e-7 (Taylor: 3e-6)
EXP2 = (0.00132764714, 0.00967554157, 0.05550713277, 0.24022119720, 0.69314696706, 1.00000007166)


class Vec16Type(types.Type):
    """numba's type of a 16-lane vector."""

    def __init__(self) -> None:
        super().__init__(name="Vec16")


vec16 = Vec16Type()
f32 = types.float32


@register_model(Vec16Type)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


def _constant(value: float) -> ir.Constant:
    rounded = struct.unpack("f", struct.pack("f", value))[0]  # LLVM wants the exact float32
    return ir.Constant(VECTOR, [rounded] * LANES)


def _splat(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTEGERS, [0] * LANES))


def _define_operator(op: Any, instruction: str) -> None:
    @infer_global(op)
    class _Template(ConcreteTemplate):
        cases = [signature(vec16, vec16, vec16), signature(vec16, vec16, f32), signature(vec16, f32, vec16)]  # noqa: RUF012

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = (v if isinstance(t, Vec16Type) else _splat(builder, v) for v, t in zip(args, sig.args))
        return getattr(builder, instruction)(a, b, flags=FAST)

    for left, right in ((Vec16Type, Vec16Type), (Vec16Type, types.Float), (types.Float, Vec16Type)):
        lower_builtin(op, left, right)(lower)


for _op, _instruction in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _define_operator(_op, _instruction)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any, pointee: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index], inbounds=True), pointee.as_pointer())


@intrinsic
def load16(typing: Any, array: Any, index: Any) -> Any:
    """Lanes array[index : index + 16] of a flat float32 array."""

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = builder.load(_pointer(context, builder, sig.args[0], args[0], args[1], VECTOR))
        value.align = 4
        return value

    return vec16(array, types.int64), code


@intrinsic
def store16(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + 16] = value."""

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], VECTOR)
        builder.store(args[2], pointer).align = 4
        return context.get_dummy_value()

    return types.void(array, types.int64, vec16), code


@intrinsic
def load1(typing: Any, array: Any, index: Any) -> Any:
    """array[index] without the wrap-around of negative indices, which would block vectorisation."""

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.load(builder.gep(data, [args[1]], inbounds=True))

    return array.dtype(array, types.int64), code


@intrinsic
def splat16(typing: Any, scalar: Any) -> Any:
    """The scalar in every lane."""
    return vec16(f32), lambda context, builder, sig, args: _splat(builder, args[0])


@intrinsic
def ramp16(typing: Any, start: Any) -> Any:
    """start, start + 1, … start + 15."""

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        steps = ir.Constant(VECTOR, [float(k) for k in range(LANES)])
        return builder.fadd(_splat(builder, args[0]), steps, flags=FAST)

    return vec16(f32), code


@intrinsic
def exp2_16(typing: Any, x: Any) -> Any:
    """2^x per lane for x ≤ 0; below −40 it is 2^−40."""

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        low = _constant(-40.0)
        x = builder.select(builder.fcmp_ordered(">", args[0], low), args[0], low)
        whole = builder.fptosi(builder.fsub(x, _constant(0.5), flags=FAST), INTEGERS)
        r = builder.fsub(x, builder.sitofp(whole, VECTOR), flags=FAST)
        p = _constant(EXP2[0])
        for coefficient in EXP2[1:]:
            p = builder.fadd(builder.fmul(p, r, flags=FAST), _constant(coefficient), flags=FAST)
        bias, shift = ir.Constant(INTEGERS, [127] * LANES), ir.Constant(INTEGERS, [23] * LANES)
        power = builder.bitcast(builder.shl(builder.add(whole, bias), shift), VECTOR)
        return builder.fmul(p, power, flags=FAST)

    return vec16(vec16), code


@intrinsic
def where_greater(typing: Any, x: Any, limit: Any, yes: Any, no: Any) -> Any:
    """Per lane: yes where x > limit (a scalar), else no."""

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", args[0], _splat(builder, args[1])), args[2], args[3])

    return vec16(vec16, f32, vec16, vec16), code


def _reduction(combine: Any) -> Any:
    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value, lanes = args[0], LANES
        while lanes > 1:  # halves, so that the order of additions is fixed
            lanes //= 2
            undefined = ir.Constant(value.type, ir.Undefined)
            low, high = (
                builder.shuffle_vector(
                    value,
                    undefined,
                    ir.Constant(ir.VectorType(ir.IntType(32), lanes), list(range(start, start + lanes))),
                )
                for start in (0, lanes)
            )
            value = combine(builder, low, high)
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return code


@intrinsic
def sum16(typing: Any, x: Any) -> Any:
    """The sum of the lanes, always in the same order."""
    return f32(vec16), _reduction(lambda builder, a, b: builder.fadd(a, b))


def _larger(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


@intrinsic
def highest16(typing: Any, x: Any) -> Any:
    """The largest lane."""
    return f32(vec16), _reduction(_larger)


@intrinsic
def max16(typing: Any, x: Any, y: Any) -> Any:
    """The larger of two vectors, lane by lane."""
    return vec16(vec16, vec16), lambda context, builder, sig, args: _larger(builder, args[0], args[1])


@intrinsic
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Ask the memory for the cache line of array[index]: the blend loop jumps between feature rows."""

    def code(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        byte, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [byte, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, i32(0), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), code
