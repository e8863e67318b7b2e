"""Which columns change sign, and nothing else, when left and right are exchanged: odd ones.

The side-slip angle does. So a line without an intercept is one of odd columns: an even one, such as
the longitudinal acceleration, has a mean that would stand in the place of the intercept.
"""

from collections.abc import Mapping
from functools import cache
from random import Random

from fleet_slip.catalogue.arithmetic import evaluate
from fleet_slip.catalogue.definitions import Definition
from fleet_slip.catalogue.signals import catalogue

OPPOSITE = frozenset(
    {"ay", "yaw_rate", "steering_wheel", "steer", "steer_fl", "steer_fr", "roll_rate"}
)
"""Signals of the other sign in the mirror. A front wheel's angle is nearly that of the other."""
EXCHANGED = {"wheel_fl": "wheel_fr", "wheel_rl": "wheel_rr"}
EXCHANGED |= {right: left for left, right in EXCHANGED.items()}
"""Signals that are those of the other side in the mirror; what is in neither stays."""
OFFSETS = frozenset({"yaw_rate_offset", "ay_offset", "steering_offset"})
"""Numbers of a car of the other sign in the mirror."""
TRIALS = 16
"""Rows that a definition is tried on."""


@cache
def parity(one: Definition) -> int:
    """Return -1 for an odd column, 1 for an even one, 0 for one that is neither.

    A gate must be opened by an even column: hats over an odd one differ from side to side.
    """
    if one.made:  # no set of changes has what is made of columns
        return 0
    if one.gate:
        return parity(one.ungated) if parity(one.gate.by) == 1 else 0
    if one.number:
        of = 1 if one.number.alone else parity(one.model_copy(update={"number": None}))
        return -of if one.number.name in OFFSETS else of
    values = [(_value(one, row), _value(one, _mirrored(row))) for row in _rows()]
    if all(a == b for a, b in values):
        return 1
    return -1 if all(a is not None and b == -a for a, b in values) else 0


def _value(one: Definition, row: Mapping[str, int]) -> int | None:
    return evaluate(one.sql, row) if one.sql else row[one.of]


@cache
def _rows() -> tuple[Mapping[str, int], ...]:
    """Return counts of cars at speed, whose left and right wheels differ, the same every time."""
    draw = Random(1)  # noqa: S311 - no secret
    return tuple(
        {name: draw.randint(4000, 6000) for name in catalogue().feature_inputs}
        | {name: draw.choice((-1, 1)) * draw.randint(500, 3000) for name in sorted(OPPOSITE)}
        for _ in range(TRIALS)
    )


def _mirrored(row: Mapping[str, int]) -> Mapping[str, int]:
    return {
        name: -row[name] if name in OPPOSITE else row[EXCHANGED.get(name, name)] for name in row
    }
