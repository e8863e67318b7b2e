"""Checks as a table in SI units, for exports that are not programs with a test of their own."""

import csv
from collections.abc import Sequence
from decimal import Decimal
from io import StringIO

from fleet_slip.export.checks import Check
from fleet_slip.export.program import Program


def checks_csv(program: Program, checks: Sequence[Check]) -> str:
    """Return CSV with a row a tick: columns as the statement of SQL reads them, and the angle.

    An empty cell is a missing value, or no angle.
    """
    facts = tuple(dict.fromkeys(one.name for one in program.facts))
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [one.column for one in program.signals]
    numbers = [one.name for one in program.numbers]
    writer.writerow(["drive_id", "tick", *columns, *facts, *numbers, "expected_angle"])
    for check in checks:
        known = [_fact(program, check, name) for name in facts]
        known += [
            _physical(count, one.grain)
            for count, one in zip(check.numbers, program.numbers, strict=True)
        ]
        for tick, (sample, angle) in enumerate(zip(check.samples, check.angles, strict=True)):
            values = [
                _physical(count, one.scale)
                for count, one in zip(sample, program.signals, strict=True)
            ]
            writer.writerow([check.name, tick, *values, *known, angle])
    return text.getvalue()


def _physical(count: int | None, scale: Decimal) -> str | None:
    return None if count is None else f"{count * scale:f}"


def _fact(program: Program, check: Check, name: str) -> object:
    """Return a fact as the logs have it; `another` is a text that no fact of the program is."""
    found: object = None
    for one, count in zip(program.facts, check.facts, strict=True):
        if one.name == name and count is not None:
            if one.equals is None:
                return count
            found = one.equals if count else found or "another"
            if count:
                return found
    return found
