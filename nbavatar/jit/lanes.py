"""A vector of eight numbers as a type of Numba's, so that kernels can work on eight pixels at a time.

LLVM cannot prove that loops over pixels or channels are free of aliasing and leaves them scalar. Values of
this type are vectors from the start: operators between them are vector instructions, comparisons give masks,
and `scalar.py` applies to them as to single numbers. Where a processor's vectors are shorter, LLVM splits them.
"""

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

__all__ = [
    "LANES", "Lanes", "any_lane", "broadcast", "count_bits", "count_trailing_zeros", "first_lanes", "floor", "is_nan",
    "lane_numbers", "largest_lane", "mask_bits", "mask_to_int", "maximum", "minimum", "ramp", "select", "set_lanes",
    "sum_lanes", "to_int", "to_real", "transpose",
]  # fmt: skip

LANES = 8
I32, I64, _WORD = ir.IntType(32), ir.IntType(64), ir.IntType(LANES)
_ELEMENTS = {
    "float32": ir.FloatType(), "float64": ir.DoubleType(), "int32": I32, "int64": I64, "mask": ir.IntType(1),
}  # fmt: skip
_SCALARS = {"float32": types.float32, "float64": types.float64, "int32": types.int32, "int64": types.int64}


class Lanes(types.Type):
    """Numba's view of `LANES` numbers, or of a mask of as many truths."""

    def __init__(self, element: str) -> None:
        self.element = element
        super().__init__(f"lanes({element})")

    @property
    def scalar(self) -> Any:
        """Numba type of one number."""
        return _SCALARS[self.element]


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Lanes) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(_ELEMENTS[fe_type.element], LANES))


MASK, INTS = Lanes("mask"), Lanes("int32")


def lanes_type(number: Any) -> Lanes:
    """Lanes of a scalar's type."""
    return Lanes(str(number))


def _operators() -> None:
    """Gives Lanes their operators."""
    real = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
    whole = {operator.add: "add", operator.sub: "sub", operator.mul: "mul", operator.and_: "and_",
             operator.rshift: "ashr"}  # fmt: skip
    mask = {operator.and_: "and_", operator.or_: "or_"}
    compared = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">=", operator.eq: "=="}

    def type_of(symbol: Any) -> None:
        class Typing(AbstractTemplate):
            def generic(self, args: Any, kws: Any) -> Any:
                if len(args) != 2 or not isinstance(args[0], Lanes) or args[0] != args[1]:
                    return None
                return signature(MASK if symbol in compared else args[0], *args)

        infer_global(symbol)(Typing)

    def lower(symbol: Any) -> None:
        @lower_builtin(symbol, Lanes, Lanes)
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = sig.args[0].element
            if symbol in compared:
                compare = builder.icmp_signed if kind.startswith("int") else builder.fcmp_ordered
                return compare(compared[symbol], *args)
            names = {"int32": whole, "int64": whole, "mask": mask}.get(kind, real)
            return getattr(builder, names[symbol])(*args)

    for symbol in {*real, *whole, *mask, *compared}:
        type_of(symbol)
        lower(symbol)

    @infer_global(operator.neg)
    class _Negative(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            return signature(args[0], *args) if isinstance(args[0], Lanes) else None

    @lower_builtin(operator.neg, Lanes)
    def negative(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.fneg(args[0])


_operators()


def _splat(builder: Any, value: Any) -> Any:
    kind = ir.VectorType(value.type, LANES)
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(I32, 0))
    zeros = ir.Constant(ir.VectorType(I32, LANES), [0] * LANES)
    return builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), zeros)


def _numbers() -> Any:
    return ir.Constant(ir.VectorType(I32, LANES), list(range(LANES)))


def call_intrinsic(builder: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


def shuffle(builder: Any, a: Any, b: Any, chosen: Any) -> Any:
    picks = list(chosen)
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(I32, len(picks)), picks))


def suffix(kind: Any) -> str:
    element = kind.element
    return f"v{kind.count}" + ("f32" if element == ir.FloatType() else "f64" if element == ir.DoubleType() else "i32")


@intrinsic
def broadcast(typingctx: Any, value: Any) -> Any:
    """One number in all lanes."""
    return lanes_type(value)(value), lambda context, builder, sig, args: _splat(builder, args[0])


@intrinsic
def ramp(typingctx: Any, like: Any) -> Any:
    """The numbers 0, 1, 2 ... in the type of the argument."""
    kind = ir.VectorType(_ELEMENTS[str(like)], LANES)
    constant = ir.Constant(kind, [float(i) for i in range(LANES)])
    return lanes_type(like)(like), lambda context, builder, sig, args: constant


@intrinsic
def lane_numbers(typingctx: Any) -> Any:
    """The int32 numbers 0, 1, 2 ..."""
    return INTS(), lambda context, builder, sig, args: _numbers()


@intrinsic
def first_lanes(typingctx: Any, count: Any) -> Any:
    """Mask of the first `count` lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.icmp_signed("<", _numbers(), _splat(builder, builder.trunc(args[0], I32)))

    return MASK(types.int64), generate


@intrinsic
def transpose(typingctx: Any, rows: Any) -> Any:
    """Columns of LANES rows."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = [builder.extract_value(args[0], i) for i in range(LANES)]
        distance = 1
        while distance < LANES:  # swaps blocks of growing size across the diagonal
            swapped = list(values)
            for i in range(LANES):
                if i & distance:
                    continue
                a, b = values[i], values[i + distance]
                upper = [j if not j & distance else LANES + j - distance for j in range(LANES)]
                lower = [j + distance if not j & distance else LANES + j for j in range(LANES)]
                swapped[i], swapped[i + distance] = shuffle(builder, a, b, upper), shuffle(builder, a, b, lower)
            values = swapped
            distance *= 2
        return context.make_tuple(builder, sig.return_type, values)

    return rows(rows), generate


@intrinsic
def select(typingctx: Any, mask: Any, yes: Any, no: Any) -> Any:
    """`yes` in the lanes of the mask, `no` in the others."""
    return yes(MASK, yes, yes), lambda context, builder, sig, args: builder.select(*args)


def _extreme(sign: str) -> Any:
    @intrinsic
    def extreme(typingctx: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return builder.select(builder.fcmp_ordered(sign, *args), *args)

        return a(a, a), generate

    return extreme


minimum, maximum = _extreme("<"), _extreme(">")


@intrinsic
def floor(typingctx: Any, a: Any) -> Any:
    """Greatest whole number below, as a float."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return call_intrinsic(builder, f"llvm.floor.{suffix(args[0].type)}", args[0].type, [args[0]])

    return a(a), generate


@intrinsic
def to_int(typingctx: Any, a: Any) -> Any:
    """Whole floating-point numbers as int32."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.fptosi(args[0], ir.VectorType(I32, LANES))

    return INTS(a), generate


@intrinsic
def to_real(typingctx: Any, whole: Any, like: Any) -> Any:
    """int32 as numbers of the type of the second argument."""
    kind = ir.VectorType(_ELEMENTS[str(like)], LANES)
    return lanes_type(like)(INTS, like), lambda context, builder, sig, args: builder.sitofp(args[0], kind)


@intrinsic
def is_nan(typingctx: Any, a: Any) -> Any:
    """Mask of the lanes that hold no number."""
    return MASK(a), lambda context, builder, sig, args: builder.fcmp_unordered("uno", args[0], args[0])


@intrinsic
def mask_bits(typingctx: Any, mask: Any) -> Any:
    """A mask as an int64, lane 0 in the lowest bit."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], _WORD), I64)

    return types.int64(MASK), generate


@intrinsic
def set_lanes(typingctx: Any, word: Any) -> Any:
    """The numbers of the lanes set in the `mask_bits` of a mask, one behind the other, and then zeros: int32."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        small = ir.VectorType(ir.IntType(8), LANES)
        table = ir.ArrayType(small, 1 << LANES)
        held = [[lane for lane in range(LANES) if word >> lane & 1] for word in range(1 << LANES)]
        rows = [ir.Constant(small, (lanes + [0] * LANES)[:LANES]) for lanes in held]
        base = cgutils.global_constant(builder, "set_lanes", ir.Constant(table, rows))
        row = builder.load(builder.gep(base, [ir.Constant(I64, 0), args[0]]))
        return builder.zext(row, ir.VectorType(I32, LANES))

    return INTS(types.int64), generate


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """Whether a mask has a lane."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], _WORD), ir.Constant(_WORD, 0))

    return types.boolean(MASK), generate


@intrinsic
def sum_lanes(typingctx: Any, a: Any) -> Any:
    """Sum over the lanes, pairwise, so that its order is fixed."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value, count = args[0], LANES
        while count > 1:
            count //= 2
            undefined = ir.Constant(value.type, ir.Undefined)
            halves = [ir.Constant(ir.VectorType(I32, count), list(range(start, start + count))) for start in (0, count)]
            parts = [builder.shuffle_vector(value, undefined, half) for half in halves]
            value = builder.fadd(*parts)
        return builder.extract_element(value, ir.Constant(I32, 0))

    return a.scalar(a), generate


@intrinsic
def largest_lane(typingctx: Any, a: Any) -> Any:
    """Greatest of int32 lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return call_intrinsic(builder, f"llvm.vector.reduce.smax.{suffix(args[0].type)}", I32, [args[0]])

    return types.int32(INTS), generate


@intrinsic
def mask_to_int(typingctx: Any, mask: Any) -> Any:
    """A mask as the int32 numbers 1 and 0."""
    kind = ir.VectorType(I32, LANES)
    return INTS(MASK), lambda context, builder, sig, args: builder.zext(args[0], kind)


@intrinsic
def count_trailing_zeros(typingctx: Any, value: Any) -> Any:
    """Index of the lowest bit set in an int64 that is not 0."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


@intrinsic
def count_bits(typingctx: Any, value: Any) -> Any:
    """Number of bits set in an int64."""
    return types.int64(types.int64), lambda context, builder, sig, args: builder.ctpop(args[0])
