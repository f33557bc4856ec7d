"""One SIMD register as a Numba type, so that kernels say what runs in lockstep instead of hoping for it.

LLVM vectorises a loop of unknown length with checks before it and a scalar tail behind it; over the few
rows of a small splat those cost several times what the arithmetic does. A value of type `floats` holds LANES
float32: `+ - * /` act on every lane, with a scalar float32 on either side too, and comparisons give a `mask`.
"""

import operator
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

from dsar.raster.jit import inlined

LANES = 16 if llvmlite.binding.get_host_cpu_features().get("avx512f", False) else 8
"""Lanes of a register: as many as this machine's hold. Where they hold four, eight are two registers."""

_FLOAT, _BIT, _INT, _LONG = ir.FloatType(), ir.IntType(1), ir.IntType(32), ir.IntType(64)
_INTS = ir.VectorType(_INT, LANES)


class _Register(types.Type):
    """A vector of LANES elements."""

    def __init__(self, name: str, element: ir.Type) -> None:
        super().__init__(name)
        self.vector = ir.VectorType(element, LANES)


@register_model(_Register)
class _RegisterModel(models.PrimitiveModel):
    """Numba keeps it as the LLVM vector that it is."""

    def __init__(self, manager: Any, register: _Register) -> None:
        super().__init__(manager, register, register.vector)


floats = _Register("floats", _FLOAT)
mask = _Register("mask", _BIT)
_FLOATS = floats.vector


# One vector, or a vector and a scalar in either order.
_PAIRS = ((floats, floats), (floats, types.float32), (types.float32, floats))


def _constant(value: float) -> ir.Constant:
    """Return one number in every lane."""
    return ir.Constant(_FLOATS, [float(np.float32(value))] * LANES)


def _broadcast(builder: ir.IRBuilder, value: Any) -> Any:
    """Return a scalar in every lane, a vector as it is."""
    if isinstance(value.type, ir.VectorType):
        return value
    undefined = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_INTS, [0] * LANES))


def _define(
    function: Callable[..., Any],
    result: types.Type,
    operands: tuple[tuple[types.Type, ...], ...],
    emit: Callable[..., Any],
) -> None:
    """Give an operator its meaning on registers."""

    class _Operator(ConcreteTemplate):
        cases = [signature(result, *kinds) for kinds in operands]  # noqa: RUF012  # read by Numba

    infer_global(function)(_Operator)  # pyright: ignore[reportOptionalCall]  # Numba's own idiom
    for one in operands:

        @lower_builtin(function, *one)
        def lower(context, builder, signature, arguments):
            return emit(builder, *(_broadcast(builder, argument) for argument in arguments))


_define(operator.add, floats, _PAIRS, lambda builder, x, y: builder.fadd(x, y))
_define(operator.iadd, floats, _PAIRS, lambda builder, x, y: builder.fadd(x, y))
_define(operator.sub, floats, _PAIRS, lambda builder, x, y: builder.fsub(x, y))
_define(operator.mul, floats, _PAIRS, lambda builder, x, y: builder.fmul(x, y))
_define(operator.truediv, floats, _PAIRS, lambda builder, x, y: builder.fdiv(x, y))
_define(operator.neg, floats, ((floats,),), lambda builder, x: builder.fneg(x))
# Ordered: a comparison with NaN fails.
_define(operator.gt, mask, _PAIRS, lambda builder, x, y: builder.fcmp_ordered(">", x, y))
_define(operator.ge, mask, _PAIRS, lambda builder, x, y: builder.fcmp_ordered(">=", x, y))
_define(operator.lt, mask, _PAIRS, lambda builder, x, y: builder.fcmp_ordered("<", x, y))
_define(operator.le, mask, _PAIRS, lambda builder, x, y: builder.fcmp_ordered("<=", x, y))
_define(operator.and_, mask, ((mask, mask),), lambda builder, x, y: builder.and_(x, y))


def _operation(function: Callable[..., Any]) -> Callable[..., Any]:
    """Make a function that emits LLVM code callable from kernels, there without the argument `typing`."""
    return intrinsic(function)


def _call(builder: ir.IRBuilder, name: str, result: ir.Type, *arguments: Any) -> Any:
    """Call one of LLVM's own functions."""
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(function, arguments)


def _is_flat(array: types.Type) -> bool:
    """Return whether an argument is a contiguous one-dimensional float32 array; else typing must fail."""
    return isinstance(array, types.Array) and (array.dtype, array.ndim, array.layout) == (
        types.float32,
        1,
        "C",
    )


def _address(context: Any, builder: ir.IRBuilder, kind: types.Array, array: Any, index: Any) -> Any:
    """Return where element `index` of a one-dimensional contiguous array lies."""
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


@_operation
def load(typing, array, index):
    """Return the LANES values of a flat float32 array from an index on."""

    def emit(context, builder, signature, arguments):
        place = _address(context, builder, signature.args[0], *arguments)
        return builder.load(builder.bitcast(place, _FLOATS.as_pointer()), align=4)

    return (floats(array, types.uintp), emit) if _is_flat(array) else None


@_operation
def store(typing, array, index, values):
    """Write LANES values into a flat float32 array from an index on."""

    def emit(context, builder, signature, arguments):
        place = _address(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], builder.bitcast(place, _FLOATS.as_pointer()), align=4)
        return context.get_dummy_value()

    return (types.void(array, types.uintp, floats), emit) if _is_flat(array) else None


@inlined
def plane(scratch, index):
    """Return one plane of a scratch array, which holds as many planes of LANES values as its kernel needs."""
    return load(scratch, np.uint64(index * LANES))


@inlined
def planes(scratch, first):
    """Return three consecutive planes of a scratch array."""
    return plane(scratch, first), plane(scratch, first + 1), plane(scratch, first + 2)


@inlined
def write_plane(scratch, index, values):
    """Write one plane of a scratch array."""
    store(scratch, np.uint64(index * LANES), values)


@_operation
def prefetch(typing, array, index):
    """Start to fetch the cache line of element `index` of a flat float32 array, which is read soon."""

    def emit(context, builder, signature, arguments):
        place = _address(context, builder, signature.args[0], *arguments)
        place = builder.bitcast(place, ir.IntType(8).as_pointer())
        read, keep, data = (ir.Constant(_INT, value) for value in (0, 3, 1))
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), place, read, keep, data)
        return context.get_dummy_value()

    return (types.void(array, types.uintp), emit) if _is_flat(array) else None


@_operation
def broadcast(typing, value):
    """Return one float32 in every lane."""

    def emit(context, builder, signature, arguments):
        return _broadcast(builder, arguments[0])

    return floats(types.float32), emit


@_operation
def select(typing, condition, one, other):
    """Return, lane by lane, `one` where the condition holds, else `other`."""

    def emit(context, builder, signature, arguments):
        return builder.select(*arguments)

    return floats(mask, floats, floats), emit


@_operation
def minimum(typing, one, other):
    """Return, lane by lane, the smaller of two; the second where either is NaN."""

    def emit(context, builder, signature, arguments):
        return builder.select(builder.fcmp_ordered("<", *arguments), *arguments)

    return floats(floats, floats), emit


@_operation
def maximum(typing, one, other):
    """Return, lane by lane, the larger of two; the second where either is NaN."""

    def emit(context, builder, signature, arguments):
        return builder.select(builder.fcmp_ordered(">", *arguments), *arguments)

    return floats(floats, floats), emit


@_operation
def negative_abs(typing, values):
    """Return -abs(values)."""

    def emit(context, builder, signature, arguments):
        return builder.fneg(_call(builder, f"llvm.fabs.v{LANES}f32", _FLOATS, *arguments))

    return floats(floats), emit


@_operation
def sqrt(typing, values):
    """Return the square root of every lane."""

    def emit(context, builder, signature, arguments):
        return _call(builder, f"llvm.sqrt.v{LANES}f32", _FLOATS, *arguments)

    return floats(floats), emit


@_operation
def floor(typing, values):
    """Return the largest whole number that is not larger, in every lane."""

    def emit(context, builder, signature, arguments):
        return _call(builder, f"llvm.floor.v{LANES}f32", _FLOATS, *arguments)

    return floats(floats), emit


@_operation
def reduce_add(typing, values):
    """Return the sum of all lanes."""

    def emit(context, builder, signature, arguments):
        start = ir.Constant(_FLOAT, -0.0)
        return _call(builder, f"llvm.vector.reduce.fadd.v{LANES}f32", _FLOAT, start, *arguments)

    return types.float32(floats), emit


@_operation
def movemask(typing, condition):
    """Return a condition as an integer: bit k is lane k."""

    def emit(context, builder, signature, arguments):
        return builder.zext(builder.bitcast(arguments[0], ir.IntType(LANES)), _INT)

    return types.uint32(mask), emit


@_operation
def count_trailing_zeros(typing, bits):
    """Return the position of the lowest bit that is set in a uint32 other than 0."""

    def emit(context, builder, signature, arguments):
        position = _call(builder, "llvm.cttz.i32", _INT, arguments[0], ir.Constant(_BIT, 1))
        return builder.zext(position, _LONG)

    return types.uintp(types.uint32), emit


# 2**f for f in [-.5, .5] (Chebyshev interpolation, 1e-7 relative).
_POWER = np.polynomial.Chebyshev.interpolate(np.exp2, 5, domain=[-0.5, 0.5])
_P0, _P1, _P2, _P3, _P4, _P5 = _POWER.convert(kind=np.polynomial.Polynomial).coef


@_operation
def exp2(typing, values):
    """Return 2**values to 2e-7 relative for values in [-126, 127]; anything beyond."""

    def emit(context, builder, signature, arguments):
        def fused(x, y, z):
            return builder.fadd(builder.fmul(x, y), z)

        whole = _call(builder, f"llvm.rint.v{LANES}f32", _FLOATS, *arguments)
        f = builder.fsub(arguments[0], whole)
        f2 = builder.fmul(f, f)
        p0, p1, p2, p3, p4, p5 = map(_constant, (_P0, _P1, _P2, _P3, _P4, _P5))
        power = fused(f2, fused(f2, fused(f, p5, p4), fused(f, p3, p2)), fused(f, p1, p0))
        # The whole part is added to the exponent.
        exponent = builder.shl(builder.fptosi(whole, _INTS), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(power, _INTS), exponent), _FLOATS)

    return floats(floats), emit


# log2(1 + f) / f for 1 + f in [sqrt(.5), sqrt(2)] (Chebyshev interpolation; 1e-7 on the logarithm).
_LOGARITHM = np.polynomial.Chebyshev.interpolate(
    lambda f: np.log2(1 + f) / f, 7, domain=[np.sqrt(0.5) - 1, np.sqrt(2) - 1]
)
_LOGARITHM_TERMS = _LOGARITHM.convert(kind=np.polynomial.Polynomial).coef


@_operation
def log2(typing, values):
    """Return the logarithm to base 2 of positive, normal values; anything for others."""

    def emit(context, builder, signature, arguments):
        def constant(value):
            return ir.Constant(_INTS, [value] * LANES)

        # The exponent is what must be taken from the bits to leave a mantissa in [sqrt(.5), sqrt(2)].
        bits = builder.bitcast(arguments[0], _INTS)
        exponent = builder.ashr(
            builder.sub(bits, constant(int(np.float32(0.5**0.5).view(np.int32)))), constant(23)
        )
        mantissa = builder.bitcast(builder.sub(bits, builder.shl(exponent, constant(23))), _FLOATS)
        f = builder.fsub(mantissa, _constant(1.0))
        series = _constant(_LOGARITHM_TERMS[-1])
        for term in _LOGARITHM_TERMS[-2::-1]:
            series = builder.fadd(builder.fmul(series, f), _constant(term))
        return builder.fadd(builder.fmul(series, f), builder.sitofp(exponent, _FLOATS))

    return floats(floats), emit
