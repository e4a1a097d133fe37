"""Sorting networks for the queues of eight pixels: the same comparisons whatever waits there, and no branches."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from nbavatar.jit.lanes import LANES, Lanes

__all__ = ["LONGEST", "comparisons", "merge_exchange", "network"]

LONGEST = 16  # slots that a network sorts: three numbers of each are held at once


def merge_exchange(count, exchange, context):
    """Calls `exchange(context, i, j)` for the pairs of places to compare, in order, so that `count` items get sorted.

    Batcher's method (Knuth, The Art of Computer Programming 3, 5.2.2, algorithm M). Plain enough for kernels as well.
    """
    top = 1
    while 2 * top < count:
        top *= 2
    p = top
    while p > 0:
        q, r, d = top, 0, p
        while True:
            for i in range(count - d):
                if i & p == r:
                    exchange(context, i, i + d)
            if q == p:
                break
            q, r, d = q // 2, p, q - p
        p //= 2


def comparisons(count: int) -> list[tuple[int, int]]:
    """The pairs of places that `merge_exchange` compares."""
    pairs: list[tuple[int, int]] = []
    merge_exchange(count, lambda found, i, j: found.append((i, j)), pairs)
    return pairs


def network(count: int) -> Any:
    """Makes the function for kernels that sorts the first `count` slots of queues; its documentation is below."""

    @intrinsic
    def sort(
        typingctx: Any, keys: Any, alphas: Any, hits: Any, first: Any, stride: Any, length: Any, empty_key: Any
    ) -> Any:
        """Sorts the queues `first + lane` by descending key, and with the keys the two other numbers.

        Args:
            keys, alphas, hits: pointers; slot j of a queue lies at `j * stride + first + lane`.
            length: int32 lanes, slots in use; the others count as holding the empty key, and do so afterwards.
            empty_key: the least key, in all lanes.

        Returns:
            Mask of the lanes in which two keys are equal and not empty: their order is left to chance.
        """

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            first, stride, length, empty_key = args[3:]
            rows, places = [], []
            for slot in range(count):
                at = builder.add(first, builder.mul(stride, ir.Constant(stride.type, slot)))
                kinds = [ir.VectorType(base.type.pointee, LANES) for base in args[:3]]
                places.append([
                    builder.bitcast(builder.gep(base, [at]), kind.as_pointer())
                    for base, kind in zip(args[:3], kinds, strict=True)
                ])  # fmt: skip
                row = [builder.load(place, align=4) for place in places[-1]]
                used = builder.icmp_signed(">", length, ir.Constant(length.type, [slot] * LANES))
                rows.append([builder.select(used, row[0], empty_key), *row[1:]])
            for i, j in comparisons(count):
                swap = builder.fcmp_ordered("<", rows[i][0], rows[j][0])
                pairs = list(zip(rows[i], rows[j], strict=True))
                rows[i] = [builder.select(swap, b, a) for a, b in pairs]
                rows[j] = [builder.select(swap, a, b) for a, b in pairs]
            tied = ir.Constant(ir.VectorType(ir.IntType(1), LANES), [0] * LANES)
            for row, after in zip(rows, rows[1:], strict=False):
                equal = builder.fcmp_ordered("==", row[0], after[0])
                tied = builder.or_(tied, builder.and_(equal, builder.fcmp_ordered(">", row[0], empty_key)))
            for row, place in zip(rows, places, strict=True):
                for value, address in zip(row, place, strict=True):
                    builder.store(value, address, align=4)
            return tied

        return Lanes("mask")(keys, alphas, hits, types.intp, types.intp, length, empty_key), generate

    return sort
