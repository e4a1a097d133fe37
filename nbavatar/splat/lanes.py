"""Eight numbers as one value in Numba kernels.

LLVM cannot prove that our loops over pixels are free of aliasing and leaves them scalar. Here a value holds
eight numbers of one floating-point type, or eight truths, from the start: operators between such values
become vector instructions, which LLVM splits where a processor's vectors are shorter.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

__all__ = [
    "LANES", "bits", "choose", "falloff", "first_lanes", "load", "minimum", "ramp", "spread", "store", "total",
]  # fmt: skip

LANES = 8
_I32, _I64, _TRUTH, _WORD = ir.IntType(32), ir.IntType(64), ir.IntType(1), ir.IntType(LANES)
_REALS = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}
_CONTRACT = ("contract",)  # a product and a sum may be rounded once


class _Lanes(types.Type):
    """Numba's type of `LANES` numbers of a scalar type."""

    def __init__(self, scalar: Any) -> None:
        self.scalar = scalar
        super().__init__(f"splat.lanes({scalar})")


@register_model(_Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: _Lanes) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(_REALS.get(fe_type.scalar, _TRUTH), LANES))


_MASK = _Lanes(types.boolean)


def _define(symbol: Any, of_masks: bool, result: Callable[[_Lanes], _Lanes], emit: Callable[..., Any]) -> None:
    """Gives an operator a meaning between values of lanes."""

    class Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) != 2 or not isinstance(args[0], _Lanes) or args[0] != args[1]:
                return None
            return signature(result(args[0]), *args) if (args[0] == _MASK) == of_masks else None

    infer_global(symbol)(Typing)
    lower_builtin(symbol, _Lanes, _Lanes)(lambda context, builder, sig, args: emit(builder, *args))


_define(operator.add, False, lambda kind: kind, lambda builder, a, b: builder.fadd(a, b, flags=_CONTRACT))
_define(operator.sub, False, lambda kind: kind, lambda builder, a, b: builder.fsub(a, b, flags=_CONTRACT))
_define(operator.mul, False, lambda kind: kind, lambda builder, a, b: builder.fmul(a, b, flags=_CONTRACT))
_define(operator.ge, False, lambda kind: _MASK, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_define(operator.gt, False, lambda kind: _MASK, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_define(operator.le, False, lambda kind: _MASK, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_define(operator.and_, True, lambda kind: kind, lambda builder, a, b: builder.and_(a, b))


def _splat(builder: Any, value: Any) -> Any:
    kind = ir.VectorType(value.type, LANES)
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_I32, 0))
    zeros = ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES)
    return builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), zeros)


def _address(context: Any, builder: Any, base: Any, index: Any, number: Any) -> tuple[Any, int]:
    """Address of LANES numbers as a pointer to a vector, and the size of a number."""
    kind = ir.VectorType(context.get_value_type(number), LANES)
    size = 4 if number == types.float32 else 8
    return builder.bitcast(builder.gep(base, [index]), kind.as_pointer()), size


@intrinsic
def spread(typingctx: Any, value: Any) -> Any:
    """One number in all lanes."""
    return _Lanes(value)(value), lambda context, builder, sig, args: _splat(builder, args[0])


@intrinsic
def ramp(typingctx: Any, like: Any) -> Any:
    """The numbers 0, 1, 2 ... in the type of the argument."""
    constant = ir.Constant(ir.VectorType(_REALS[like], LANES), [float(i) for i in range(LANES)])
    return _Lanes(like)(like), lambda context, builder, sig, args: constant


@intrinsic
def first_lanes(typingctx: Any, count: Any) -> Any:
    """Mask of the first `count` lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        numbers = ir.Constant(ir.VectorType(_I32, LANES), list(range(LANES)))
        return builder.icmp_signed("<", numbers, _splat(builder, builder.trunc(args[0], _I32)))

    return _MASK(types.int64), generate


@intrinsic
def load(typingctx: Any, base: Any, index: Any) -> Any:
    """The numbers from `index` on behind a pointer."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address, size = _address(context, builder, *args, base.dtype)
        return builder.load(address, align=size)

    return _Lanes(base.dtype)(base, types.intp), generate


@intrinsic
def store(typingctx: Any, base: Any, index: Any, value: Any) -> Any:
    """Writes the numbers from `index` on behind a pointer."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address, size = _address(context, builder, args[0], args[1], base.dtype)
        builder.store(args[2], address, align=size)
        return context.get_dummy_value()

    return types.none(base, types.intp, _Lanes(base.dtype)), generate


@intrinsic
def choose(typingctx: Any, mask: Any, yes: Any, no: Any) -> Any:
    """`yes` in the lanes of the mask, `no` in the others."""
    return yes(_MASK, yes, yes), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def minimum(typingctx: Any, a: Any, b: Any) -> Any:
    """The smaller number, lane by lane."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return a(a, a), generate


@intrinsic
def bits(typingctx: Any, mask: Any) -> Any:
    """A mask as an int64, lane 0 in the lowest bit."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], _WORD), _I64)

    return types.int64(_MASK), generate


@intrinsic
def total(typingctx: Any, a: Any) -> Any:
    """Sum over the lanes, by halves, in a fixed order."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value, count = args[0], LANES
        while count > 1:
            count //= 2
            undefined = ir.Constant(value.type, ir.Undefined)
            lanes = [ir.Constant(ir.VectorType(_I32, count), list(range(at, at + count))) for at in (0, count)]
            value = builder.fadd(*(builder.shuffle_vector(value, undefined, half) for half in lanes))
        return builder.extract_element(value, ir.Constant(_I32, 0))

    return a.scalar(a), generate


# Degree of the Taylor polynomial of 2^f on [-1/2, 1/2], whose remainder is under half a unit in the last
# place; bits of the mantissa; least power of two that is kept apart from smaller ones.
_POWERS = {types.float32: (7, 23, -110.0), types.float64: (13, 52, -1000.0)}


@intrinsic
def falloff(typingctx: Any, squared: Any) -> Any:
    """exp(-squared / 2) of numbers at least 0, to a few units in the last place.

    2^t = 2^n 2^f with n the whole number nearest to t: n goes into the exponent's bits. Numbers above
    about 150 (float32) or 1380 (float64) give the value there.
    """

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = args[0].type
        degree, mantissa, lowest = _POWERS[squared.scalar]
        size = 32 if mantissa == 23 else 64
        whole = ir.VectorType(ir.IntType(size), LANES)

        def constant(number: float) -> Any:
            return ir.Constant(kind, [number] * LANES)

        power = builder.fmul(args[0], constant(-0.5 / math.log(2.0)))
        power = builder.select(builder.fcmp_ordered(">", power, constant(lowest)), power, constant(lowest))
        function = ir.FunctionType(kind, [kind])
        floor = cgutils.get_or_insert_function(builder.module, function, f"llvm.floor.v{LANES}f{size}")
        nearest = builder.call(floor, [builder.fadd(power, constant(0.5))])
        rest = builder.fsub(power, nearest)
        value = constant(math.log(2.0) ** degree / math.factorial(degree))
        for k in range(degree - 1, -1, -1):
            term = constant(math.log(2.0) ** k / math.factorial(k))
            value = builder.fadd(builder.fmul(value, rest, flags=_CONTRACT), term, flags=_CONTRACT)
        shift = ir.Constant(whole, [mantissa] * LANES)
        exponent = builder.shl(builder.fptosi(nearest, whole), shift)
        return builder.bitcast(builder.add(builder.bitcast(value, whole), exponent), kind)

    return squared(squared), generate
