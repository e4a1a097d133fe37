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

__all__ = ["fetch_add", "get", "move4", "pointer", "put"]


@intrinsic
def pointer(typingctx: Any, array: Any, offset: Any) -> Any:
    """Address of element `offset` of a flat array, which the caller keeps alive."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        view = context.make_array(signature.args[0])(context, builder, args[0])
        return builder.gep(view.data, [args[1]])

    return types.CPointer(array.dtype)(array, types.intp), generate


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
def move4(typingctx: Any, base: Any, to: Any, source: Any) -> Any:
    """Copies four neighbouring elements."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        size = 4 if base.dtype == types.float32 else 8
        kind = ir.VectorType(context.get_value_type(base.dtype), 4).as_pointer()
        value = builder.load(builder.bitcast(builder.gep(args[0], [args[2]]), kind), align=size)
        builder.store(value, builder.bitcast(builder.gep(args[0], [args[1]]), kind), align=size)
        return context.get_dummy_value()

    return types.none(base, types.intp, types.intp), generate


@intrinsic
def fetch_add(typingctx: Any, array: Any, amount: Any) -> Any:
    """Adds to the first element of an int64 array, atomically, and returns what it was."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        view = context.make_array(signature.args[0])(context, builder, args[0])
        return builder.atomic_rmw("add", cgutils.gep(builder, view.data, 0), args[1], "monotonic")

    return types.int64(array, types.int64), generate
