"""The operations that every column is made of: docs/export.md says what each computes.

A step is an operation, the numbers of earlier steps, then plain numbers. Its value is a whole
number of at most 63 bits, or missing where an operand is ("operands" if that is all). Targets have
a table with a line an operation, and take ranges, missing and look-back from here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from fleet_slip.catalogue.arithmetic import nearest, truncated

Step = tuple[str | int, ...]
Range = tuple[int, int]

Missing = Literal["never", "given", "operands", "divisor", "less", "both"]
"""Where a step is missing: never; where what is given or remembered is; where an operand is; also
for a divisor not above zero, or a first operand below the second; where both are.
"""


@dataclass(frozen=True)
class Operation:
    """An operation: its range, from those of its `steps` operands, then its plain numbers.

    `over_time`: it looks back on its step.
    """

    range_of: Callable[..., Range]
    steps: int = 2
    missing: Missing = "operands"
    over_time: bool = False


def _corners(compute: Callable[[int, int], int]) -> Callable[[Range, Range], Range]:
    """Return the range of what rises or falls in each operand: its extremes are at the ends."""

    def range_of(a: Range, b: Range) -> Range:
        found = [compute(x, y) for x in a for y in b]
        return min(found), max(found)

    return range_of


def _quotients(compute: Callable[[int, int], int]) -> Callable[[Range, Range], Range]:
    found = _corners(compute)
    return lambda a, b: found(a, (max(1, b[0]), max(1, b[1])))


def _first(a: Range, *_: object) -> Range:
    return a


def _sums(a: Range, _: int, most: int) -> Range:
    return min(0, a[0] * most), max(0, a[1] * most)


OPERATIONS: Mapping[str, Operation] = {
    # What is given: its place. The range is that of `given`, see `ranges_of`.
    "signal": Operation(_first, 0, "given"),
    "fact": Operation(_first, 0, "given"),
    "number": Operation(_first, 0, "given"),
    "constant": Operation(lambda n: (n, n), 0, "never"),
    # Arithmetic.
    "+": Operation(_corners(lambda a, b: a + b)),
    "-": Operation(_corners(lambda a, b: a - b)),
    "*": Operation(_corners(lambda a, b: a * b)),
    "//": Operation(_quotients(truncated), missing="divisor"),
    "nearest": Operation(_quotients(nearest), missing="divisor"),
    "min": Operation(_corners(min)),
    "max": Operation(_corners(max)),
    "negative": Operation(lambda a: (-a[1], -a[0]), 1),
    "abs": Operation(lambda a: (0 if a[0] <= 0 <= a[1] else min(map(abs, a)), max(map(abs, a))), 1),
    "sign": Operation(lambda a: ((a[0] > 0) - (a[0] < 0), (a[1] > 0) - (a[1] < 0)), 1),
    "clip": Operation(lambda *of: (-of[1][1], of[1][1])),
    # What may be missing.
    "at_least": Operation(_first, missing="less"),
    "where": Operation(_first),
    "else": Operation(lambda a, b: (min(a[0], b[0]), max(a[1], b[1])), missing="both"),
    # What looks back, on so many ticks.
    "ago": Operation(_first, 1, "given", over_time=True),
    "sum": Operation(_sums, 1, "never", over_time=True),
    "values": Operation(lambda *of: (0, of[2]), 1, "never", over_time=True),
}

GIVEN = ("signal", "fact", "number")


def operation_of(step: Step) -> str:
    """Return the name of a step's operation."""
    return str(step[0])


def plain_of(step: Step) -> tuple[int, ...]:
    """Return everything that a step works on: numbers of steps, then plain numbers."""
    return tuple(int(one) for one in step[1:])


def operands_of(step: Step) -> tuple[int, ...]:
    """Return the numbers of the steps that a step works on."""
    return plain_of(step)[: OPERATIONS[operation_of(step)].steps]


def ranges_of(steps: Sequence[Step], given: Mapping[str, Sequence[Range]]) -> list[Range]:
    """Return the range of each step, zero included in what is `given`, as for missing values."""
    found: list[Range] = []
    for step in steps:
        name, plain = operation_of(step), plain_of(step)
        one = OPERATIONS[name]
        if name in GIVEN:
            least, most = given[name][plain[0]]
            found.append((min(least, 0), max(most, 0)))
        else:
            of = [found[i] for i in plain[: one.steps]]
            found.append(one.range_of(*of, *plain[one.steps :]))
    return found


def roots_of(steps: Sequence[Step], ranges: Sequence[Range]) -> list[tuple[int, ...]]:
    """Return, for each step, the steps that must be there by themselves for it to be there."""
    found: list[tuple[int, ...]] = []
    for number, step in enumerate(steps):
        missing, of = OPERATIONS[operation_of(step)].missing, operands_of(step)
        roots = [root for i in of for root in found[i]]
        if step[0] == "where":  # a value of now is one of its window's, so that it has values
            roots = [one for one in roots if one not in _mean_of(steps, of[0], of[1])]
        if missing == "less" or (missing == "divisor" and ranges[of[1]][0] <= 0):
            roots.append(number)
        elif missing == "given" or (missing == "both" and all(found[i] for i in of)):
            roots = [number]
        elif missing in ("never", "both"):
            roots = []
        found.append(tuple(dict.fromkeys(roots)))
    return found


def _mean_of(steps: Sequence[Step], mean: int, now: int) -> set[int]:
    """Return the quotients in a mean by the number of values of a window that `now` is in."""
    found, inner = set[int](), [mean]
    while inner:
        number = inner.pop()
        one = steps[number]
        if one[0] in ("clip", "where"):
            inner.append(operands_of(one)[0])
        elif one[0] == "nearest":
            divisor = steps[operands_of(one)[1]]
            counts = [divisor, *(steps[i] for i in operands_of(divisor) if divisor[0] == "*")]
            if any(count[:2] == ("values", now) for count in counts):
                found.add(number)
    return found


def rings_of(steps: Sequence[Step]) -> dict[int, int]:
    """Return the steps that are looked back on, and how many ticks; 0 are all since the start."""
    found: dict[int, int] = {}
    for step in steps:
        if OPERATIONS[operation_of(step)].over_time:
            of, ticks, *_ = plain_of(step)
            found[of] = max(found.get(of, 0), ticks)
    return found


def size_of(one: Range) -> int:
    """Return the largest size of a value of a range."""
    return max(-one[0], one[1])
