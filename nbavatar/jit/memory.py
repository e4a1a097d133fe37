"""Plain memory access for the CPU kernels.

Numba counts references to an array whenever it is handed to a function, with atomic
instructions, and tests every index for being negative. In loops of a few dozen instructions
both cost more than the work itself, so the kernels read and write through plain pointers.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

__all__ = ["advance", "fetch_add", "get", "pointer", "pointers", "prefetch", "put"]


@intrinsic
def pointer(typingctx: Any, array: Any, offset: Any) -> Any:
    """Address of element `offset` of a flat array, which the caller keeps alive."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        view = context.make_array(signature.args[0])(context, builder, args[0])
        return builder.gep(view.data, [args[1]])

    return types.CPointer(array.dtype)(array, types.intp), generate


@intrinsic
def pointers(typingctx: Any, group: Any) -> Any:
    """A named tuple with the address of each array in place of it; other members stay. The caller keeps the arrays."""

    def plain(kind: Any) -> Any:
        return types.CPointer(kind.dtype) if isinstance(kind, types.Array) else kind

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        members = []
        for kind, member in zip(group.types, cgutils.unpack_tuple(builder, args[0]), strict=True):
            view = context.make_array(kind)(context, builder, member).data if isinstance(kind, types.Array) else member
            members.append(view)
        return context.make_tuple(builder, signature.return_type, members)

    return types.BaseTuple.from_types([plain(kind) for kind in group.types], group.instance_class)(group), generate


@intrinsic
def get(typingctx: Any, base: Any, index: Any) -> Any:
    """Element `index` after a pointer."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(builder.gep(args[0], [args[1]]))

    return base.dtype(base, types.intp), generate


@intrinsic
def put(typingctx: Any, base: Any, index: Any, value: Any) -> Any:
    """Sets element `index` after a pointer."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], builder.gep(args[0], [args[1]]))
        return context.get_dummy_value()

    return types.none(base, types.intp, base.dtype), generate


@intrinsic
def advance(typingctx: Any, base: Any, count: Any) -> Any:
    """The pointer `count` elements on.

    Where several addresses share a part, making it a pointer of its own keeps LLVM from working out the
    products in it once for each of them.
    """
    return base(base, types.intp), lambda context, builder, signature, args: builder.gep(args[0], [args[1]])


@intrinsic
def fetch_add(typingctx: Any, array: Any, amount: Any) -> Any:
    """Adds to the first element of an int64 array, atomically, and returns what it was."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        view = context.make_array(signature.args[0])(context, builder, args[0])
        return builder.atomic_rmw("add", cgutils.gep(builder, view.data, 0), args[1], "monotonic")

    return types.int64(array, types.int64), generate


@intrinsic
def prefetch(typingctx: Any, base: Any, index: Any) -> Any:
    """Asks for element `index` after a pointer to be brought near; an address that is none does no harm."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = builder.bitcast(builder.gep(args[0], [args[1]]), ir.IntType(8).as_pointer())
        hints = [ir.Constant(ir.IntType(32), hint) for hint in (0, 3, 1)]  # to read, often, data
        kind = ir.FunctionType(ir.VoidType(), [place.type, *(hint.type for hint in hints)])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0"), [place, *hints])
        return context.get_dummy_value()

    return types.none(base, types.intp), generate
