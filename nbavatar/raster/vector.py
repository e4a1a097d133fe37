"""Vector instructions for the CPU kernels, emitted as LLVM code.

LLVM cannot prove that our loops over 16 pixels or 6 channels are free of aliasing and leaves
them scalar, so those loops are spelled out here: `Lanes` records arithmetic on Python operators
as vector instructions, which lets the functions of `scalar.py` run on a row of pixels.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from nbavatar.raster import scalar

__all__ = ["LANES", "count_trailing_zeros", "evaluate_row", "make_blend", "make_dot", "make_scatter", "make_slopes"]

LANES = 8  # pixels of a row evaluated together
_FLAGS = ("contract", "reassoc", "nsz", "arcp")
_I32, _I1 = ir.IntType(32), ir.IntType(1)


class Lanes:
    """A vector value under construction."""

    def __init__(self, builder: ir.IRBuilder, value: Any) -> None:
        self.builder, self.value = builder, value

    def _of(self, value: Any) -> "Lanes":
        return Lanes(self.builder, value)

    def __add__(self, other: "Lanes") -> "Lanes":
        return self._of(self.builder.fadd(self.value, other.value, flags=_FLAGS))

    def __sub__(self, other: "Lanes") -> "Lanes":
        return self._of(self.builder.fsub(self.value, other.value, flags=_FLAGS))

    def __mul__(self, other: "Lanes") -> "Lanes":
        return self._of(self.builder.fmul(self.value, other.value, flags=_FLAGS))

    def __truediv__(self, other: "Lanes") -> "Lanes":
        return self._of(self.builder.fdiv(self.value, other.value))

    def __neg__(self) -> "Lanes":
        return self._of(self.builder.fneg(self.value))

    def __lt__(self, other: "Lanes") -> "Lanes":
        return self._of(self.builder.fcmp_ordered("<", self.value, other.value))

    def __le__(self, other: "Lanes") -> "Lanes":
        return self._of(self.builder.fcmp_ordered("<=", self.value, other.value))

    def __gt__(self, other: "Lanes") -> "Lanes":
        return self._of(self.builder.fcmp_ordered(">", self.value, other.value))

    def __ge__(self, other: "Lanes") -> "Lanes":
        return self._of(self.builder.fcmp_ordered(">=", self.value, other.value))

    def __and__(self, other: "Lanes") -> "Lanes":
        return self._of(self.builder.and_(self.value, other.value))

    def is_nan(self) -> "Lanes":
        """Lanes that hold no number."""
        return self._of(self.builder.fcmp_unordered("uno", self.value, self.value))


def _select(condition: Lanes, yes: Lanes, no: Lanes) -> Lanes:
    return Lanes(yes.builder, yes.builder.select(condition.value, yes.value, no.value))


def _minimum(a: Lanes, b: Lanes) -> Lanes:
    return _select(a < b, a, b)


def _maximum(a: Lanes, b: Lanes) -> Lanes:
    return _select(a > b, a, b)


def _floor(a: Lanes) -> Lanes:
    kind = a.value.type
    name = f"llvm.floor.v{kind.count}f{32 if isinstance(kind.element, ir.FloatType) else 64}"
    function = cgutils.get_or_insert_function(a.builder.module, ir.FunctionType(kind, [kind]), name)
    return Lanes(a.builder, a.builder.call(function, [a.value]))


_ROW = scalar.build(lambda function: function, _floor, _minimum, _maximum, _select)


def _splat(builder: ir.IRBuilder, value: Any, count: int) -> Any:
    kind = ir.VectorType(value.type, count)
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_I32, 0))
    zeros = ir.Constant(ir.VectorType(_I32, count), [0] * count)
    return builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), zeros)


def _pointer(builder: ir.IRBuilder, base: Any, index: Any, element: ir.Type, count: int) -> Any:
    """Address of `count` elements from `index` on, as a pointer to a vector."""
    return builder.bitcast(builder.gep(base, [index]), ir.VectorType(element, count).as_pointer())


def _load(builder: ir.IRBuilder, base: Any, index: Any, element: ir.Type, count: int) -> Any:
    size = 4 if isinstance(element, ir.FloatType) else 8
    return builder.load(_pointer(builder, base, index, element, count), align=size)


def _store(builder: ir.IRBuilder, value: Any, base: Any, index: Any, element: ir.Type, count: int) -> None:
    size = 4 if isinstance(element, ir.FloatType) else 8
    builder.store(value, _pointer(builder, base, index, element, count), align=size)


def _sum(builder: ir.IRBuilder, value: Any) -> Any:
    """Sum of a vector's elements, pairwise, so that its order is fixed."""
    count = value.type.count
    while count > 1:
        half = count // 2
        undefined = ir.Constant(value.type, ir.Undefined)
        parts = []
        for start in (0, half):
            mask = ir.Constant(ir.VectorType(_I32, half), list(range(start, start + half)))
            parts.append(builder.shuffle_vector(value, undefined, mask))
        value = builder.fadd(parts[0], parts[1], flags=_FLAGS)
        count = half
    return builder.extract_element(value, ir.Constant(_I32, 0))


@intrinsic
def count_trailing_zeros(typingctx: Any, value: Any) -> Any:
    """Index of the lowest bit set in an int64 that is not 0."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(_I1, 1))

    return types.int64(types.int64), generate


@intrinsic
def evaluate_row(
    typingctx: Any, coefficients: Any, at: Any, x: Any, y: Any, count: Any, textures: Any, base: Any, texels: Any,
    limits: Any, through: Any, pixel: Any, found: Any,
) -> Any:  # fmt: skip
    """Intersects one billboard with LANES neighbouring pixels of a row.

    Args:
        coefficients: records of the billboards, flat; `at` is where this one's begins.
        x, y: first pixel relative to the record's origin, in the records' dtype.
        count: how many of the lanes to use.
        textures: alpha textures, flat; `base` is where this billboard's begins; `texels` its side.
        limits: zero, one, texels a side, min(1, texels - 1), 1 / near, alpha_min, t_min, alpha_max.
        through: transmittance of the tile's pixels; `pixel` is the first lane's.
        found: 4 LANES numbers that receive s, t, key and opacity (without fade) of the lanes.

    Returns:
        int64: bit i is set where lane i holds a hit of a pixel not finished yet; bit 32 is set if
        any alpha sample was no number.
    """
    element = coefficients.dtype

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> Any:
        (_, at_, x_, y_, count_, _, base_, texels_, _, _, pixel_, _) = args
        records, alphas = args[0], args[5]
        bounds, passing = args[8], args[9]
        results = args[11]
        number = context.get_value_type(element)
        index = at_.type

        def spread(value: Any) -> Lanes:
            return Lanes(builder, _splat(builder, value, LANES))

        def at_offset(start: Any, offset: int) -> Any:
            return builder.add(start, ir.Constant(index, offset))

        def record(offset: int) -> Lanes:
            return spread(builder.load(builder.gep(records, [at_offset(at_, offset)])))

        zero, one, size, step, inverse_near, alpha_min, t_min = (
            spread(builder.load(builder.gep(bounds, [ir.Constant(index, i)]))) for i in range(7)
        )
        ramp = ir.Constant(ir.VectorType(number, LANES), [float(i) for i in range(LANES)])
        px, py = spread(x_) + Lanes(builder, ramp), spread(y_)
        s, t, w = (_ROW.affine(record(3 * i), record(3 * i + 1), record(3 * i + 2), px, py) for i in range(3))
        key = _ROW.affine(record(6), record(7), record(9), px, py)
        lane = ir.Constant(ir.VectorType(_I32, LANES), list(range(LANES)))
        used = builder.icmp_signed("<", lane, _splat(builder, builder.trunc(count_, _I32), LANES))
        valid = Lanes(builder, used) & (w > zero) & (w <= inverse_near)
        r = one / _select(valid, w, one)
        # what is not valid is moved outside the texture: no index may depend on it
        s, t = _select(valid, s * r, -one), _select(valid, t * r, -one)
        column, row = _ROW.first_texel(s, size, zero, one), _ROW.first_texel(t, size, zero, one)
        x0, x1 = _ROW.weights(s, column, step, zero, one)
        y0, y1 = _ROW.weights(t, row, step, zero, one)
        whole = ir.VectorType(_I32, LANES)
        side = _splat(builder, builder.trunc(texels_, _I32), LANES)
        first = builder.add(builder.mul(builder.fptosi(row.value, whole), side), builder.fptosi(column.value, whole))
        right = builder.fptosi(step.value, whole)
        down = builder.mul(right, side)
        texture = builder.gep(alphas, [base_])

        def gather(offset: Any) -> Lanes:
            value: Any = ir.Constant(ir.VectorType(number, LANES), ir.Undefined)
            for i in range(LANES):
                where = builder.zext(builder.extract_element(offset, ir.Constant(_I32, i)), index)
                texel = builder.load(builder.gep(texture, [where]))
                value = builder.insert_element(value, texel, ir.Constant(_I32, i))
            return Lanes(builder, value)

        below = builder.add(first, down)
        corners = [gather(offset) for offset in (first, builder.add(first, right), below, builder.add(below, right))]
        opacity = _ROW.mix(*corners, x0, x1, y0, y1)
        ongoing = Lanes(builder, _load(builder, passing, pixel_, number, LANES)) >= t_min
        hit = valid & (opacity >= alpha_min) & ongoing
        broken = valid & opacity.is_nan()
        for i, value in enumerate((s, t, key, opacity)):
            _store(builder, value.value, results, ir.Constant(index, i * LANES), number, LANES)
        word = ir.IntType(LANES)
        mask = builder.zext(builder.bitcast(hit.value, word), ir.IntType(64))
        no_number = builder.icmp_unsigned("!=", builder.bitcast(broken.value, word), ir.Constant(word, 0))
        flag = builder.shl(builder.zext(no_number, ir.IntType(64)), ir.Constant(ir.IntType(64), 32))
        return builder.or_(mask, flag)

    signature = types.int64(
        coefficients, types.intp, element, element, types.intp, textures, types.intp, types.intp, limits, through,
        types.intp, found,
    )  # fmt: skip
    return signature, generate


def _corner_lanes(context: Any, builder: ir.IRBuilder, data: Any, indices: Any, number: Any, count: int) -> list[Lanes]:
    return [Lanes(builder, _load(builder, data, index, number, count)) for index in indices]


def make_blend(count: int) -> Any:
    """Builds `blend(sums, at, textures, i00, i01, i10, i11, w00, w01, w10, w11)` for `count` channels.

    Adds the four texels, weighted, to `sums[at : at + count]`.
    """

    @intrinsic
    def blend(typingctx: Any, sums: Any, at: Any, textures: Any, i00: Any, i01: Any, i10: Any, i11: Any, w00: Any,
              w01: Any, w10: Any, w11: Any) -> Any:  # fmt: skip
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> Any:
            number = context.get_value_type(sums.dtype)
            total_at = args[0]
            texture = args[2]
            texels = _corner_lanes(context, builder, texture, args[3:7], number, count)
            total = Lanes(builder, _load(builder, total_at, args[1], number, count))
            for texel, weight in zip(texels, args[7:11], strict=True):
                total = total + texel * Lanes(builder, _splat(builder, weight, count))
            _store(builder, total.value, total_at, args[1], number, count)
            return context.get_dummy_value()

        real = sums.dtype
        return types.none(sums, types.intp, textures, *[types.intp] * 4, *[real] * 4), generate

    return blend


def make_dot(count: int) -> Any:
    """Builds `dot(grads, at, textures, i00 ... i11, w00 ... w11)`: grads . (weighted texels), over `count` channels."""

    @intrinsic
    def dot(typingctx: Any, grads: Any, at: Any, textures: Any, i00: Any, i01: Any, i10: Any, i11: Any, w00: Any,
            w01: Any, w10: Any, w11: Any) -> Any:  # fmt: skip
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> Any:
            number = context.get_value_type(grads.dtype)
            texture = args[2]
            texels = _corner_lanes(context, builder, texture, args[3:7], number, count)
            parts = [t * Lanes(builder, _splat(builder, w, count)) for t, w in zip(texels, args[7:11], strict=True)]
            colour = (parts[0] + parts[1]) + (parts[2] + parts[3])
            grad_at = args[0]
            grad = Lanes(builder, _load(builder, grad_at, args[1], number, count))
            return _sum(builder, (colour * grad).value)

        real = grads.dtype
        return real(grads, types.intp, textures, *[types.intp] * 4, *[real] * 4), generate

    return dot


def make_slopes(count: int) -> Any:
    """Builds `slopes(grads, at, textures, i00 ... i11, x0, x1, y0, y1, dx0, dx1, dy0, dy1)`.

    Returns the derivatives by s and by t of grads . (bilinear sample) over `count` channels.
    """

    @intrinsic
    def slopes(typingctx: Any, grads: Any, at: Any, textures: Any, i00: Any, i01: Any, i10: Any, i11: Any, x0: Any,
               x1: Any, y0: Any, y1: Any, dx0: Any, dx1: Any, dy0: Any, dy1: Any) -> Any:  # fmt: skip
        real = grads.dtype
        pair = types.UniTuple(real, 2)

        def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> Any:
            number = context.get_value_type(grads.dtype)
            texture = args[2]
            texels = _corner_lanes(context, builder, texture, args[3:7], number, count)
            grad_at = args[0]
            grad = Lanes(builder, _load(builder, grad_at, args[1], number, count))
            a0, a1, b0, b1, c0, c1, d0, d1 = (Lanes(builder, _splat(builder, value, count)) for value in args[7:15])
            by_s = _ROW.mix(*texels, c0, c1, b0, b1) * grad
            by_t = _ROW.mix(*texels, a0, a1, d0, d1) * grad
            return context.make_tuple(builder, pair, [_sum(builder, by_s.value), _sum(builder, by_t.value)])

        return pair(grads, types.intp, textures, *[types.intp] * 4, *[real] * 8), generate

    return slopes


def make_scatter(count: int) -> Any:
    """Builds `scatter(totals, i00 ... i11, w00 ... w11, grads, at)`: totals[i .. i + count] += w grads[at ..]."""

    @intrinsic
    def scatter(typingctx: Any, totals: Any, i00: Any, i01: Any, i10: Any, i11: Any, w00: Any, w01: Any, w10: Any,
                w11: Any, grads: Any, at: Any) -> Any:  # fmt: skip
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> Any:
            number = context.get_value_type(totals.dtype)
            total_at = args[0]
            grad_at = args[9]
            grad = Lanes(builder, _load(builder, grad_at, args[10], number, count))
            # one after the other: of a single-texel texture all four are the same place
            for index, weight in zip(args[1:5], args[5:9], strict=True):
                total = Lanes(builder, _load(builder, total_at, index, number, count))
                total = total + grad * Lanes(builder, _splat(builder, weight, count))
                _store(builder, total.value, total_at, index, number, count)
            return context.get_dummy_value()

        real = totals.dtype
        return types.none(totals, *[types.intp] * 4, *[real] * 4, grads, types.intp), generate

    return scatter
