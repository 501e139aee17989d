"""Explicit SIMD for Numba: vectors of 8 or 16 float32 values.

A vector is an LLVM vector, so the compiler maps it to what the machine has: 16 lanes are one register of AVX-512,
8 lanes one register of AVX2, two of SSE or NEON. The width is the type of an argument: kernels take `lanes`, a tuple of
that length, so one source compiles for both widths, the compile cache tells them apart, and one process can compare
them. No operation may be contracted or reordered by the compiler: the same source gives the same bits in every kernel.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.extending import models, overload, register_model

Lanes = tuple[int, ...]
LANES_8: Lanes = (0,) * 8
LANES_16: Lanes = (0,) * 16

intrinsic: Any = extending.intrinsic
# Numba's own type would count the typing context among the arguments.

_I1, _I8, _I32, _I64, _F32 = ir.IntType(1), ir.IntType(8), ir.IntType(32), ir.IntType(64), ir.FloatType()


def preferred_lanes() -> Lanes:
    """The width that fills one register of this CPU: 16 with AVX-512, else 8."""
    return LANES_16 if llvmlite.binding.get_host_cpu_features().get("avx512f", False) else LANES_8


class FloatVector(types.Type):
    def __init__(self, count: int):
        self.count = count
        super().__init__(name=f"float32x{count}")


class MaskVector(types.Type):
    def __init__(self, count: int):
        self.count = count
        super().__init__(name=f"maskx{count}")


@register_model(FloatVector)
class _FloatModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: FloatVector):
        super().__init__(manager, kind, ir.VectorType(_F32, kind.count))


@register_model(MaskVector)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: MaskVector):
        super().__init__(manager, kind, ir.VectorType(_I1, kind.count))


def _floats(count: int) -> ir.VectorType:
    return ir.VectorType(_F32, count)


def _constant(value: float, count: int) -> ir.Constant:
    return ir.Constant(_floats(count), [value] * count)


def _shuffle(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, lanes: list[int]) -> ir.Value:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, len(lanes)), lanes))


def _call(builder: ir.IRBuilder, name: str, result: ir.Type, arguments: list[ir.Value]) -> ir.Value:
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


def _pointer(context: Any, builder: ir.IRBuilder, kind: Any, array: ir.Value, index: ir.Value, to: ir.Type) -> ir.Value:
    """Address of flat element `index` of a C-contiguous array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), to.as_pointer())


# -- arithmetic and comparison --------------------------------------------------------------------------------------


def _binary(instruction: str) -> Callable:
    @intrinsic
    def operation(typing, a, b):
        if not (isinstance(a, FloatVector) and a == b):
            return None
        return a(a, b), lambda context, builder, signature, args: getattr(builder, instruction)(*args)

    return operation


def _operators() -> None:
    for symbol, instruction in (
        (operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv"),
    ):  # fmt: skip
        _overload_operator(symbol, _binary(instruction))


def _overload_operator(symbol: Callable, operation: Callable) -> None:
    @overload(symbol, inline="never")
    def implementation(a, b):
        if isinstance(a, FloatVector) and isinstance(b, FloatVector):
            return lambda a, b: operation(a, b)
        return None


_operators()


@intrinsic
def fma(typing, a, b, c):
    """a * b + c, rounded once."""

    def generate(context, builder, signature, args):
        return _call(builder, f"llvm.fma.v{a.count}f32", args[0].type, list(args))

    return a(a, b, c), generate


@intrinsic
def square_root(typing, a):
    def generate(context, builder, signature, args):
        return _call(builder, f"llvm.sqrt.v{a.count}f32", args[0].type, list(args))

    return a(a), generate


def _comparison(predicate: str) -> Callable:
    @intrinsic
    def operation(typing, a, b):
        return (
            MaskVector(a.count)(a, b),
            lambda context, builder, signature, args: builder.fcmp_ordered(predicate, *args),
        )

    return operation


at_least, at_most, above = _comparison(">="), _comparison("<="), _comparison(">")


def _extremum(predicate: str) -> Callable:
    # (x < y) ? x : y is exactly the machine's min: it gives y where x is not a number.
    @intrinsic
    def operation(typing, a, b):
        def generate(context, builder, signature, args):
            return builder.select(builder.fcmp_ordered(predicate, *args), *args)

        return a(a, b), generate

    return operation


smaller, larger = _extremum("<"), _extremum(">")


@intrinsic
def select(typing, mask, a, b):
    """a where the mask is set, b elsewhere."""
    return a(mask, a, b), lambda context, builder, signature, args: builder.select(*args)


@intrinsic
def both(typing, a, b):
    return a(a, b), lambda context, builder, signature, args: builder.and_(*args)


@intrinsic
def bits(typing, mask):
    """The mask as an int64, lane 0 in the lowest bit."""

    def generate(context, builder, signature, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(mask.count)), _I64)

    return types.int64(mask), generate


# -- making, loading and storing ------------------------------------------------------------------------------------


@intrinsic
def splat(typing, lanes, value):
    """The same value, as float32, in every lane."""
    count = lanes.count

    def generate(context, builder, signature, args):
        scalar = context.cast(builder, args[1], value, types.float32)
        undefined = ir.Constant(_floats(count), ir.Undefined)
        first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
        return _shuffle(builder, first, undefined, [0] * count)

    return FloatVector(count)(lanes, value), generate


@intrinsic
def load(typing, lanes, array, index):
    """Vector at flat element `index` of a C-contiguous float32 array; any alignment."""
    count = lanes.count

    def generate(context, builder, signature, args):
        value = builder.load(_pointer(context, builder, array, args[1], args[2], _floats(count)), typ=_floats(count))
        value.align = 4
        return value

    return FloatVector(count)(lanes, array, types.int64), generate


@intrinsic
def store(typing, array, index, vector):
    def generate(context, builder, signature, args):
        to = _pointer(context, builder, array, args[0], args[1], _floats(vector.count))
        builder.store(args[2], to).align = 4
        return context.get_dummy_value()

    return types.void(array, types.int64, vector), generate


@intrinsic
def load_parts(typing, lanes, block, array, a, b):
    """Vector of `lanes` from one or two pieces of `block` lanes, at flat elements a and b; b is idle if one fills it."""
    count, width = lanes.count, block.count

    def generate(context, builder, signature, args):
        parts = []
        for at in args[3 : 3 + count // width]:
            part = builder.load(_pointer(context, builder, array, args[2], at, _floats(width)), typ=_floats(width))
            part.align = 4
            parts.append(part)
        return parts[0] if len(parts) == 1 else _shuffle(builder, parts[0], parts[1], list(range(count)))

    return FloatVector(count)(lanes, block, array, types.int64, types.int64), generate


@intrinsic
def store_parts(typing, block, array, a, b, vector):
    """Inverse of `load_parts`."""
    width = block.count

    def generate(context, builder, signature, args):
        for part, at in enumerate(args[2 : 2 + vector.count // width]):
            value = _part(builder, args[4], part, width)
            builder.store(value, _pointer(context, builder, array, args[1], at, _floats(width))).align = 4
        return context.get_dummy_value()

    return types.void(block, array, types.int64, types.int64, vector), generate


def _part(builder: ir.IRBuilder, vector: ir.Value, part: int, width: int) -> ir.Value:
    if vector.type.count == width:
        return vector
    return _shuffle(builder, vector, vector, list(range(part * width, (part + 1) * width)))


@intrinsic
def fold(typing, a, b, total):
    """total + a * b, where a and b may hold twice the lanes of total: both halves are added to it."""

    def generate(context, builder, signature, args):
        sums = args[2]
        for part in range(a.count // total.count):
            factors = [_part(builder, args[k], part, total.count) for k in (0, 1)]
            sums = _call(builder, f"llvm.fma.v{total.count}f32", sums.type, [*factors, sums])
        return sums

    return total(a, a, total), generate


@intrinsic
def fold_sum(typing, a, total):
    """total + a, halves of a as in `fold`."""

    def generate(context, builder, signature, args):
        sums = args[1]
        for part in range(a.count // total.count):
            sums = builder.fadd(sums, _part(builder, args[0], part, total.count))
        return sums

    return total(a, total), generate


@intrinsic
def load_block(typing, lanes, array, index, stride):
    """A block of 4 x (lanes / 4) pixels whose rows begin at index, index + stride, ..."""
    count = lanes.count

    def generate(context, builder, signature, args):
        rows, at = [], args[2]
        for _ in range(count // 4):
            row = builder.load(_pointer(context, builder, array, args[1], at, _floats(4)), typ=_floats(4))
            row.align = 4
            rows.append(row)
            at = builder.add(at, args[3])
        while len(rows) > 1:
            wide = list(range(2 * rows[0].type.count))
            rows = [_shuffle(builder, a, b, wide) for a, b in zip(rows[::2], rows[1::2], strict=True)]
        return rows[0]

    return FloatVector(count)(lanes, array, types.int64, types.int64), generate


@intrinsic
def store_block(typing, array, index, stride, vector):
    """Inverse of `load_block`."""

    def generate(context, builder, signature, args):
        at = args[1]
        for row in range(vector.count // 4):
            part = _shuffle(builder, args[3], args[3], list(range(4 * row, 4 * row + 4)))
            builder.store(part, _pointer(context, builder, array, args[0], at, _floats(4))).align = 4
            at = builder.add(at, args[2])
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, vector), generate


@intrinsic
def store_sums(typing, array, index, vectors):
    """Write 16 floats: the sum over the lanes of each vector, in the tuple's order, then zeros.

    A transposing tree: each level adds pairs of vectors, and keeps in every lane the half that belongs there.
    """
    count = vectors[0].count

    def generate(context, builder, signature, args):
        given = [builder.extract_value(args[2], i) for i in range(len(vectors))]
        for group in range(16 // count):
            members: list = given[group * count : (group + 1) * count]
            value = _transposed_sum(builder, members + [None] * (count - len(members)))
            at = builder.add(args[1], ir.Constant(_I64, group * count))
            to = _pointer(context, builder, array, args[0], at, _floats(count))
            builder.store(_constant(0.0, count) if value is None else value, to).align = 4
        return context.get_dummy_value()

    return types.void(array, types.int64, vectors), generate


def _transposed_sum(builder: ir.IRBuilder, vectors: list) -> ir.Value | None:
    """Lane k holds the sum over the lanes of vector k; None stands for zeros."""
    count, step = len(vectors), 1
    while len(vectors) > 1:
        vectors = [_half_sum(builder, a, b, step, count) for a, b in zip(vectors[::2], vectors[1::2], strict=True)]
        step *= 2
    return vectors[0]


def _half_sum(builder: ir.IRBuilder, a: Any, b: Any, step: int, count: int) -> ir.Value | None:
    if a is None:
        return None
    other = _constant(0.0, count) if b is None else b
    lower = [(lane & ~step) + (count if lane & step else 0) for lane in range(count)]
    return builder.fadd(
        _shuffle(builder, a, other, lower), _shuffle(builder, a, other, [lane + step for lane in lower])
    )


# -- 2 ** x ---------------------------------------------------------------------------------------------------------


def _exp2_polynomial(degree: int) -> list[float]:
    """2 ** x on [-0.5, 0.5], least relative squares on Chebyshev nodes, lowest power first."""
    x = 0.5 * np.cos(np.pi * (np.arange(4000) + 0.5) / 4000)
    weighted = np.vander(x, degree + 1, increasing=True) / (2.0**x)[:, None]
    solution = np.linalg.lstsq(weighted, np.ones_like(x), rcond=None)[0]
    return [float(np.float32(value)) for value in solution]


_EXP2 = _exp2_polynomial(5)
_ROUNDER = 12582912.0
"""1.5 * 2 ** 23: adding it leaves the nearest integer in the lowest bits of the mantissa."""


@intrinsic
def exp2(typing, a):
    """2 ** a for -126 <= a <= 126, to 3e-7 relative."""
    count = a.count

    def generate(context, builder, signature, args):
        integers, rounder = ir.VectorType(_I32, count), _constant(_ROUNDER, count)
        shifted = builder.fadd(args[0], rounder)
        fraction = builder.fsub(args[0], builder.fsub(shifted, rounder))
        power = _constant(_EXP2[-1], count)
        for coefficient in _EXP2[-2::-1]:
            terms = [power, fraction, _constant(coefficient, count)]
            power = _call(builder, f"llvm.fma.v{count}f32", power.type, terms)
        exponent = builder.shl(builder.bitcast(shifted, integers), ir.Constant(integers, [23] * count))
        return builder.bitcast(builder.add(builder.bitcast(power, integers), exponent), power.type)

    return a(a), generate


def _poly(n):
    # minimax-ish relative fit of 2**x on [-8/2^n... ]
    lo = -8.1 / 2**n
    k = np.arange(4000)
    x = lo / 2 + lo / 2 * np.cos(np.pi * (k + 0.5) / 4000)
    deg = {2: 6, 3: 5, 4: 4}[n]
    w = np.vander(x, deg + 1, increasing=True) / (2.0**x)[:, None]
    return [float(np.float32(v)) for v in np.linalg.lstsq(w, np.ones_like(x), rcond=None)[0]]


def _sq(n, estrin):
    C = _poly(n)

    @intrinsic
    def f(typing, a):
        count = a.count

        def generate(context, builder, signature, args):
            x = args[0]
            fm = lambda p, q, r: _call(builder, f"llvm.fma.v{count}f32", x.type, [p, q, r])
            K = lambda v: _constant(v, count)
            if estrin and n == 4:
                x2 = builder.fmul(x, x)
                p = fm(x2, fm(x2, K(C[4]), fm(x, K(C[3]), K(C[2]))), fm(x, K(C[1]), K(C[0])))
            elif estrin and n == 3:
                x2 = builder.fmul(x, x)
                p = fm(x2, fm(x2, fm(x, K(C[5]), K(C[4])), fm(x, K(C[3]), K(C[2]))), fm(x, K(C[1]), K(C[0])))
            else:
                p = K(C[-1])
                for c in C[-2::-1]:
                    p = fm(p, x, K(c))
            for _ in range(n):
                p = builder.fmul(p, p)
            return p

        return a(a), generate

    return f


sq2, sq3, sq4, sq3e, sq4e = _sq(2, 0), _sq(3, 0), _sq(4, 0), _sq(3, 1), _sq(4, 1)


# -- scalars --------------------------------------------------------------------------------------------------------


@intrinsic
def lowest_bit(typing, value):
    """Position of the lowest set bit of an int64; 64 if there is none."""

    def generate(context, builder, signature, args):
        return _call(builder, "llvm.cttz.i64", _I64, [args[0], ir.Constant(_I1, 0)])

    return types.int64(types.int64), generate


@intrinsic
def bit_count(typing, value):
    def generate(context, builder, signature, args):
        return _call(builder, "llvm.ctpop.i64", _I64, [args[0]])

    return types.int64(types.int64), generate


@intrinsic
def align_stack(typing):
    """Align the caller's stack frame to cache lines.

    Without an aligned variable LLVM notices too late that vectors will be spilled, and lets them straddle cache lines.
    """

    def generate(context, builder, signature, args):
        slot = cgutils.alloca_once(builder, _I64)
        slot.align = 64
        # Empty assembly that takes the address: the variable must exist.
        builder.asm(ir.FunctionType(ir.VoidType(), [slot.type]), "", "r", [slot], side_effect=True)
        return context.get_dummy_value()

    return types.void(), generate


def _prefetch(write: int) -> Any:
    @intrinsic
    def operation(typing, array, index):
        def generate(context, builder, signature, args):
            address = _pointer(context, builder, array, args[0], args[1], _I8)
            flags = [ir.Constant(_I32, flag) for flag in (write, 3, 1)]  # keep in every cache, data
            _call(builder, "llvm.prefetch.p0", ir.VoidType(), [address, *flags])
            return context.get_dummy_value()

        return types.void(array, types.int64), generate

    return operation


prefetch, prefetch_to_write = _prefetch(0), _prefetch(1)
"""Ask for the cache line of flat element `index`, which need not exist."""
