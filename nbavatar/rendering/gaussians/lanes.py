"""The fall-off of Gaussians on eight pixels at a time, beside the operations of `nbavatar.jit.lanes`."""

import math
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from nbavatar.jit.lanes import LANES

__all__ = ["falloff"]

_CONTRACT = ("contract",)  # a product and a sum may be rounded once
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
