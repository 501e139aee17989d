"""Explicit SIMD for Numba: vectors of 16 float32 values, as LLVM vectors.

The compiler maps a vector to what the machine has: one register of AVX-512, two of AVX2, four of SSE or NEON. Two
registers side by side are no loss: they give the processor two independent chains of operations to overlap. Only sums
that live through a loop are better kept in the width of one register, see `register_lanes`. No operation may be
contracted or reordered by the compiler: the same source gives the same bits in every kernel.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import cache
from typing import Any

import llvmlite.binding
import numba
import numpy as np
from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.extending import models, overload, register_model

Lanes = tuple[int, ...]
"""A width is the type of an argument, a tuple of that length: one source compiles for every width."""
ALL: Lanes = (0,) * 16
HALF: Lanes = (0,) * 8
WIDTH = 16

intrinsic: Any = extending.intrinsic
# Numba's own type would count the typing context among the arguments.
_numba: Any = numba.config  # its settings are made when it is imported

_I1, _I8, _I32, _I64, _F32 = ir.IntType(1), ir.IntType(8), ir.IntType(32), ir.IntType(64), ir.FloatType()


@cache
def register_lanes() -> Lanes:
    """The lanes that fill one register of this CPU: 16 with AVX-512, else 8.

    Sixteen lanes of AVX2 are two of the sixteen registers that there are, so running sums spill to memory; folded to
    one register each they cost half as many loads and stores.
    """
    return ALL if "+avx512f" in _cpu_features() else HALF


def cpu_description() -> str:
    """Processor and width of its vectors that kernels are compiled for: where two agree, so do results, to the bit."""
    name = _numba.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    return f"{name}, {len(register_lanes())} lanes"


def _cpu_features() -> list[str]:
    """Signed names of what kernels may use, as Numba takes them: NUMBA_CPU_FEATURES, or all that the machine has."""
    given: str | None = _numba.CPU_FEATURES
    return (llvmlite.binding.get_host_cpu_features().flatten() if given is None else given).split(",")


class FloatVector(types.Type):
    """Numba's type of `count` float32 values."""

    def __init__(self, count: int):
        self.count = count
        super().__init__(name=f"float32x{count}")


class MaskVector(types.Type):
    """Numba's type of `count` truth values."""

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


def _fma(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
    return _call(builder, f"llvm.fma.v{c.type.count}f32", c.type, [a, b, c])


def _pointer(context: Any, builder: ir.IRBuilder, kind: Any, array: ir.Value, index: ir.Value, to: ir.Type) -> ir.Value:
    """Address of flat element `index` of a C-contiguous array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), to.as_pointer())


def _read(builder: ir.IRBuilder, address: ir.Value) -> ir.Value:
    """A vector at any address that a float may have."""
    value = builder.load(address, typ=address.type.pointee)
    value.align = 4
    return value


def _write(builder: ir.IRBuilder, value: ir.Value, address: ir.Value) -> None:
    builder.store(value, address).align = 4


def _part(builder: ir.IRBuilder, vector: ir.Value, part: int, width: int) -> ir.Value:
    """Lanes part * width and the `width` - 1 after it."""
    if vector.type.count == width:
        return vector
    return _shuffle(builder, vector, vector, list(range(part * width, (part + 1) * width)))


# -- arithmetic and comparison ----------------------------------------------------------------------------------------


def _binary(instruction: str) -> Any:
    @intrinsic
    def operation(typing, a, b):
        return a(a, b), lambda context, builder, signature, args: getattr(builder, instruction)(*args)

    return operation


def _overload_operator(symbol: Callable[..., Any], operation: Any) -> None:
    @overload(symbol)
    def implementation(a, b):
        if isinstance(a, FloatVector) and a == b:
            return lambda a, b: operation(a, b)
        return None


_overload_operator(operator.add, _binary("fadd"))
_overload_operator(operator.sub, _binary("fsub"))
_overload_operator(operator.mul, _binary("fmul"))
_overload_operator(operator.truediv, _binary("fdiv"))


@intrinsic
def fma(typing, a, b, c):
    """a * b + c, rounded once."""
    return a(a, b, c), lambda context, builder, signature, args: _fma(builder, *args)


@intrinsic
def square_root(typing, a):
    """Lane by lane."""

    def generate(context, builder, signature, args):
        return _call(builder, f"llvm.sqrt.v{a.count}f32", args[0].type, list(args))

    return a(a), generate


def _comparison(predicate: str) -> Any:
    @intrinsic
    def operation(typing, a, b):
        def generate(context, builder, signature, args):
            return builder.fcmp_ordered(predicate, *args)

        return MaskVector(a.count)(a, b), generate

    return operation


at_least, at_most, above = _comparison(">="), _comparison("<="), _comparison(">")
"""Lane by lane; false where a value is not a number."""


def _extremum(predicate: str) -> Any:
    # (a < b) ? a : b is exactly the machine's min: it gives b where a is not a number.
    @intrinsic
    def operation(typing, a, b):
        def generate(context, builder, signature, args):
            return builder.select(builder.fcmp_ordered(predicate, *args), *args)

        return a(a, b), generate

    return operation


smaller, larger = _extremum("<"), _extremum(">")


def _extremum_of_four(predicate: str) -> Any:
    @intrinsic
    def operation(typing, a):
        def generate(context, builder, signature, args):
            best = _part(builder, args[0], 0, 4)
            for k in range(1, 4):
                part = _part(builder, args[0], k, 4)
                best = builder.select(builder.fcmp_ordered(predicate, best, part), best, part)
            return _shuffle(builder, best, best, [lane // 4 for lane in range(WIDTH)])

        return a(a), generate

    return operation


least_of_four, greatest_of_four = _extremum_of_four("<"), _extremum_of_four(">")
"""Lanes 4 k to 4 k + 3 of the result hold the least or greatest of lanes k, k + 4, k + 8 and k + 12."""


@intrinsic
def select(typing, mask, a, b):
    """a where the mask is set, b elsewhere."""
    return a(mask, a, b), lambda context, builder, signature, args: builder.select(*args)


@intrinsic
def both(typing, a, b):
    """Where two masks are set."""
    return a(a, b), lambda context, builder, signature, args: builder.and_(*args)


@intrinsic
def bits(typing, mask):
    """The mask as an int64, lane 0 in the lowest bit."""

    def generate(context, builder, signature, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(mask.count)), _I64)

    return types.int64(mask), generate


# -- 2 ** x -----------------------------------------------------------------------------------------------------------

_SQUARINGS = 3


def _exp2_polynomial(degree: int) -> list[float]:
    """2 ** x on [-1, 0], least relative squares on Chebyshev nodes, lowest power first."""
    x = np.cos(np.pi * (np.arange(4000) + 0.5) / 4000) / 2 - 0.5
    weighted = np.vander(x, degree + 1, increasing=True) / (2.0**x)[:, None]
    solution = np.linalg.lstsq(weighted, np.ones_like(x), rcond=None)[0]
    return [float(np.float32(value)) for value in solution]


_EXP2 = _exp2_polynomial(5)


@intrinsic
def exp2_8(typing, a):
    """2 ** (8 a) for -1 <= a <= 0, to 2e-6 relative; anything for smaller a, even what is not a number.

    A polynomial squared three times: over the range that blending needs this takes fewer operations than splitting off
    an integer exponent.
    """

    def generate(context, builder, signature, args):
        power = _constant(_EXP2[-1], a.count)
        for coefficient in _EXP2[-2::-1]:
            power = _fma(builder, power, args[0], _constant(coefficient, a.count))
        for _ in range(_SQUARINGS):
            power = builder.fmul(power, power)
        return power

    return a(a), generate


# -- making, loading and storing --------------------------------------------------------------------------------------


@intrinsic
def zeros(typing, lanes):
    """A vector as wide as `lanes`."""
    kind = FloatVector(lanes.count)
    return kind(lanes), lambda context, builder, signature, args: _constant(0.0, lanes.count)


@intrinsic
def splat(typing, value):
    """The same value, as float32, in every lane."""

    def generate(context, builder, signature, args):
        scalar = context.cast(builder, args[0], value, types.float32)
        undefined = ir.Constant(_floats(WIDTH), ir.Undefined)
        first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
        return _shuffle(builder, first, undefined, [0] * WIDTH)

    return FloatVector(WIDTH)(value), generate


@intrinsic
def load(typing, array, index):
    """Vector at flat element `index` of a C-contiguous float32 array; any alignment."""

    def generate(context, builder, signature, args):
        return _read(builder, _pointer(context, builder, array, args[0], args[1], _floats(WIDTH)))

    return FloatVector(WIDTH)(array, types.int64), generate


@intrinsic
def store(typing, array, index, vector):
    """Inverse of `load`."""

    def generate(context, builder, signature, args):
        _write(builder, args[2], _pointer(context, builder, array, args[0], args[1], _floats(vector.count)))
        return context.get_dummy_value()

    return types.void(array, types.int64, vector), generate


@intrinsic
def load_block(typing, array, index, stride):
    """A block of 4 x 4 pixels whose rows begin at index, index + stride, ..."""

    def generate(context, builder, signature, args):
        rows, at = [], args[1]
        for _ in range(4):
            rows.append(_read(builder, _pointer(context, builder, array, args[0], at, _floats(4))))
            at = builder.add(at, args[2])
        upper, lower = [_shuffle(builder, rows[k], rows[k + 1], list(range(8))) for k in (0, 2)]
        return _shuffle(builder, upper, lower, list(range(16)))

    return FloatVector(WIDTH)(array, types.int64, types.int64), generate


@intrinsic
def store_block(typing, array, index, stride, vector):
    """Inverse of `load_block`."""

    def generate(context, builder, signature, args):
        at = args[1]
        for row in range(4):
            _write(builder, _part(builder, args[3], row, 4), _pointer(context, builder, array, args[0], at, _floats(4)))
            at = builder.add(at, args[2])
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, vector), generate


# -- sums -------------------------------------------------------------------------------------------------------------


@intrinsic
def fold(typing, a, total):
    """total + a; where total has half the lanes of a, both halves are added."""

    def generate(context, builder, signature, args):
        sums = args[1]
        for part in range(a.count // total.count):
            sums = builder.fadd(sums, _part(builder, args[0], part, total.count))
        return sums

    return total(a, total), generate


@intrinsic
def fold_product(typing, a, b, total):
    """total + a * b, halves as in `fold`."""

    def generate(context, builder, signature, args):
        sums = args[2]
        for part in range(a.count // total.count):
            first, second = [_part(builder, factor, part, total.count) for factor in args[:2]]
            sums = _fma(builder, first, second, sums)
        return sums

    return total(a, a, total), generate


@intrinsic
def store_sums(typing, array, index, vectors):
    """Write 16 floats: the sum over the lanes of each vector of a tuple, in its order, then zeros.

    A transposing tree: each level adds pairs of vectors, and keeps in every lane the half that belongs there.
    """
    count = vectors[0].count

    def generate(context, builder, signature, args):
        given = [builder.extract_value(args[2], i) for i in range(len(vectors))]
        for group in range(WIDTH // count):
            members: list[ir.Value | None] = given[group * count : (group + 1) * count]
            value = _transposed_sum(builder, members + [None] * (count - len(members)))
            at = builder.add(args[1], ir.Constant(_I64, group * count))
            to = _pointer(context, builder, array, args[0], at, _floats(count))
            _write(builder, _constant(0.0, count) if value is None else value, to)
        return context.get_dummy_value()

    return types.void(array, types.int64, vectors), generate


@intrinsic
def sum_lanes(typing, vector):
    """The sum of all lanes, float32."""

    def generate(context, builder, signature, args):
        total = _transposed_sum(builder, [args[0]] + [None] * (vector.count - 1))
        return builder.extract_element(total, ir.Constant(_I32, 0))

    return types.float32(vector), generate


def _transposed_sum(builder: ir.IRBuilder, vectors: list[Any]) -> ir.Value | None:
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
    upper = [lane + step for lane in lower]
    return builder.fadd(_shuffle(builder, a, other, lower), _shuffle(builder, a, other, upper))


# -- scalars and memory -----------------------------------------------------------------------------------------------


@intrinsic
def lowest_bit(typing, value):
    """Position of the lowest set bit of a non-zero int64."""

    def generate(context, builder, signature, args):
        return _call(builder, "llvm.cttz.i64", _I64, [args[0], ir.Constant(_I1, 1)])

    return types.int64(types.int64), generate


@intrinsic
def bit_count(typing, value):
    """Number of set bits of an int64."""

    def generate(context, builder, signature, args):
        return _call(builder, "llvm.ctpop.i64", _I64, [args[0]])

    return types.int64(types.int64), generate


@intrinsic
def align_stack(typing):
    """Align the stack frame of the calling kernel to cache lines.

    Without an aligned variable LLVM finds out too late that vectors are spilled, and lets them straddle cache lines.
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
