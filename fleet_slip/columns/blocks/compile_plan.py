"""Writes the program that computes the columns of a plan; what several are made of, once."""

from collections.abc import Mapping, Sequence
from math import inf
from typing import TypeVar

from fleet_slip.catalogue.definitions import Definition, limit_of
from fleet_slip.columns.blocks.block_operations import (
    ADD_UP,
    AGO,
    FACT,
    KEEP,
    QUOTIENT,
    SCALE,
    WEIGH,
    Region,
)
from fleet_slip.columns.blocks.block_program import BlockProgram, Code, Value, VectorOperation
from fleet_slip.columns.blocks.row_code import RowColumn, add_row_column


def compile_plan(
    names: Sequence[str],
    rows: Mapping[str, RowColumn],
    windows: Mapping[str, Definition],
    also: Sequence[str] = (),
) -> BlockProgram:
    """Return the program of columns: of `rows`, and of `windows` that look back on one of `rows`.

    `also` are those of `rows` that it leaves beside the columns. Raises `QuestionError` for
    arithmetic that divides by a number that is not positive.
    """
    code = Code()
    found: dict[str, Value] = {}
    values: dict[str, Value] = {}
    gates = {name: (one.ungated, one.gate) for name, one in windows.items() if one.gate}
    parts: dict[Definition, Value] = {}
    for name, row in rows.items():
        value = values[name] = add_row_column(code, row)
        found.setdefault(name, value)
        for window, one in windows.items():
            if one.of == name and window not in gates:
                found[window] = _add_window(code, one, value)
        for part in (part for window in gates for part in windows[window].parts):
            if part.of == name and part not in parts:
                parts[part] = _add_window(code, part, value)
    for window, (part, gate) in gates.items():
        high = inf if gate.high is None else float(gate.high)
        knots = (float(gate.low), float(gate.peak), 0.0, high)
        found[window] = code.add_anew(
            VectorOperation(WEIGH, parts[part], parts[gate.by], ratio=knots)
        )
    return code.assemble([found[name] for name in names], [values[name] for name in also])


def _add_window(code: Code, one: Definition, value: Value) -> int:
    """Add what computes a column over time, given what it looks back on."""
    numerator, denominator = float(one.ratio.numerator), float(one.ratio.denominator)
    limit = float(limit_of(one.bits))
    scale = (numerator, denominator, 0.0, limit)
    if one.over is None:
        found = code.add_anew(VectorOperation(SCALE, value, ratio=scale))
    elif one.over == "lag":
        found = code.add_anew(
            VectorOperation(SCALE, _value_ago(code, one.ticks, value), ratio=scale)
        )
    else:
        ratio = scale if one.over == "sum" else (numerator, 0.0, denominator, limit)
        found = _quotient(code, one.ticks, value, ratio)
    if one.fact is None:
        return found
    fact, times = _number(code.facts, one.fact), one.fact.ratio
    scale = (float(times.numerator), float(times.denominator), 0.0, limit)
    return code.add_anew(VectorOperation(FACT, found, (Region.FACT, fact), ratio=scale))


def _quotient(
    code: Code, ticks: int, value: Value, ratio: tuple[float, float, float, float]
) -> int:
    slot, kind = _number(code.summed, value), _number(code.kinds, ticks)
    sums, counts = (Region.SUM, slot), (Region.COUNT, slot)
    code.add(VectorOperation(ADD_UP, value, sums, counts, slot=slot))
    begins = (Region.BEGIN, kind)
    return code.add_anew(
        VectorOperation(
            QUOTIENT, value, sums, begins, counts, slot=slot, kind=kind, ticks=ticks, ratio=ratio
        )
    )


def _value_ago(code: Code, ticks: int, value: Value) -> int:
    """Add what reads the value so many ticks ago: its window begins there, one tick longer."""
    slot, kind = _number(code.kept, value), _number(code.kinds, ticks + 1)
    code.add(VectorOperation(KEEP, value, (Region.VALUE, slot)))
    begins = (Region.BEGIN, kind)
    return code.add(VectorOperation(AGO, (Region.VALUE, slot), c=begins, kind=kind, ticks=ticks))


Key = TypeVar("Key")


def _number(known: dict[Key, int], key: Key) -> int:
    """Return the number of a key, in the order in which they came."""
    return known.setdefault(key, len(known))
