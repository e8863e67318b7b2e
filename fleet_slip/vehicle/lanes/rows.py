"""Lanes in memory: every quantity is a row of `LANES` numbers in one flat array.

With all rows in one array at offsets known at compile time, the compiler needs no check that they
overlap, and a loop over lanes that reads, computes and writes becomes vector instructions.
"""

from collections.abc import Callable
from typing import Any

from fleet_slip.extras import needed

with needed("compiled", "simulating drives"):
    from llvmlite import ir  # type: ignore[import-untyped]
    from numba import types
    from numba.extending import intrinsic

LANES = 8
"""Lanes of the kernel: one or two of a processor's vectors."""


def _address(context: Any, builder: Any, array_type: Any, args: Any, index: int) -> Any:
    """Emit the address of the `index`-th row after a first row, at a lane."""
    memory, first_row, lane = args[:3]
    integer = first_row.type
    row = builder.add(first_row, ir.Constant(integer, index))
    offset = builder.add(builder.mul(row, ir.Constant(integer, LANES)), lane)
    data = context.make_array(array_type)(context, builder, memory).data
    return builder.gep(data, [offset], inbounds=True)


@intrinsic
def _read(_typing_context: Any, memory: Any, _first_row: Any, _lane: Any, kind: Any) -> Any:
    """Type and emit `read`."""
    fields = kind.instance_class
    count = len(fields._fields)
    result = types.NamedUniTuple(types.float64, count, fields)  # type: ignore[no-untyped-call]

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array_type = signature.args[0]
        values = [
            builder.load(_address(context, builder, array_type, args, index))
            for index in range(count)
        ]
        return context.make_tuple(builder, result, values)

    return result(memory, types.intp, types.intp, kind), codegen


@intrinsic
def _write(_typing_context: Any, memory: Any, _first_row: Any, _lane: Any, values: Any) -> Any:
    """Type and emit `write`."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array_type = signature.args[0]
        for index in range(signature.args[3].count):
            value = builder.extract_value(args[3], index)
            builder.store(value, _address(context, builder, array_type, args, index))
        return context.get_dummy_value()

    return types.void(memory, types.intp, types.intp, values), codegen


read: Callable[..., Any] = _read
"""Return one lane of successive rows as a named tuple: `read(memory, ROW, lane, State)`."""

write: Callable[..., None] = _write
"""Write a tuple of floats to one lane of successive rows: `write(memory, ROW, lane, values)`."""
