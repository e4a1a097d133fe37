"""Vectors of `lanes.py` from memory and to it: rows of neighbouring numbers, with and without a mask, and gathers."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from nbavatar.jit.lanes import I32, I64, INTS, LANES, MASK, call_intrinsic, lanes_type, shuffle, suffix

__all__ = ["gather", "gather_pairs", "load", "masked_load", "masked_store", "store", "stream"]


def _size(kind: Any) -> int:
    return 8 if kind.element in (ir.DoubleType(), I64) else 4


def _row(context: Any, builder: Any, base: Any, index: Any, number: Any) -> tuple[Any, Any]:
    """Address of LANES numbers as a pointer to a vector, and the vector's type."""
    kind = ir.VectorType(context.get_value_type(number), LANES)
    return builder.bitcast(builder.gep(base, [index]), kind.as_pointer()), kind


@intrinsic
def load(typingctx: Any, base: Any, index: Any) -> Any:
    """Lanes from `index` on."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address, kind = _row(context, builder, *args, base.dtype)
        return builder.load(address, align=_size(kind))

    return lanes_type(base.dtype)(base, types.intp), generate


@intrinsic
def store(typingctx: Any, base: Any, index: Any, value: Any) -> Any:
    """Writes lanes from `index` on."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address, kind = _row(context, builder, args[0], args[1], base.dtype)
        builder.store(args[2], address, align=_size(kind))
        return context.get_dummy_value()

    return types.none(base, types.intp, lanes_type(base.dtype)), generate


@intrinsic
def stream(typingctx: Any, base: Any, index: Any, value: Any) -> Any:
    """Writes lanes from `index` on past the caches; their address is a multiple of their size."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address, kind = _row(context, builder, args[0], args[1], base.dtype)
        written = builder.store(args[2], address, align=LANES * _size(kind))
        written.set_metadata("nontemporal", builder.module.add_metadata([ir.Constant(I32, 1)]))
        return context.get_dummy_value()

    return types.none(base, types.intp, lanes_type(base.dtype)), generate


@intrinsic
def masked_load(typingctx: Any, base: Any, index: Any, mask: Any) -> Any:
    """Lanes from `index` on; those not in the mask are 0 and their memory is not touched."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address, kind = _row(context, builder, args[0], args[1], base.dtype)
        aligned = ir.Constant(I32, _size(kind))
        arguments = [address, aligned, args[2], ir.Constant(kind, None)]
        return call_intrinsic(builder, f"llvm.masked.load.{suffix(kind)}.p0", kind, arguments)

    return lanes_type(base.dtype)(base, types.intp, MASK), generate


@intrinsic
def masked_store(typingctx: Any, base: Any, index: Any, value: Any, mask: Any) -> Any:
    """Writes the lanes of the mask from `index` on."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address, kind = _row(context, builder, args[0], args[1], base.dtype)
        arguments = [args[2], address, ir.Constant(I32, _size(kind)), args[3]]
        call_intrinsic(builder, f"llvm.masked.store.{suffix(kind)}.p0", ir.VoidType(), arguments)
        return context.get_dummy_value()

    return types.none(base, types.intp, lanes_type(base.dtype), MASK), generate


def _wide(builder: Any, offset: Any, lane: int) -> Any:
    return builder.zext(builder.extract_element(offset, ir.Constant(I32, lane)), I64)


@intrinsic
def gather(typingctx: Any, base: Any, offset: Any) -> Any:
    """Elements at int32 offsets from a pointer, none of them negative.

    One load a lane: the processors' own gather instructions are slower than that where they are mended
    against leaks between programs.
    """

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = ir.Constant(ir.VectorType(context.get_value_type(base.dtype), LANES), ir.Undefined)
        for lane in range(LANES):
            place = builder.gep(args[0], [_wide(builder, args[1], lane)])
            value = builder.insert_element(value, builder.load(place), ir.Constant(I32, lane))
        return value

    return lanes_type(base.dtype)(base, INTS), generate


@intrinsic
def gather_pairs(typingctx: Any, base: Any, offset: Any) -> Any:
    """Elements at int32 offsets from a pointer, none of them negative, and those after them."""
    lanes = lanes_type(base.dtype)
    both = types.UniTuple(lanes, 2)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        number = context.get_value_type(base.dtype)
        pair = ir.VectorType(number, 2)
        parts = []
        for lane in range(LANES):
            place = builder.gep(args[0], [_wide(builder, args[1], lane)])
            parts.append(builder.load(builder.bitcast(place, pair.as_pointer()), align=4))
        while len(parts) > 2:
            parts = [shuffle(builder, a, b, range(2 * a.type.count)) for a, b in zip(parts[::2], parts[1::2])]
        split = [shuffle(builder, *parts, range(start, 2 * LANES, 2)) for start in (0, 1)]
        return context.make_tuple(builder, both, split)

    return both(base, INTS), generate
