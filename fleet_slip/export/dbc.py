"""The messages of an estimator on a CAN bus, as a DBC file: what it needs, and what it says."""

from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.export.program import Program
from fleet_slip.export.templating import different, fill_in_version
from fleet_slip.models.registry import ModelVersion

FIRST_ID = 0x100
"""Identifier of the first message; whose bus it is decides."""

LONGEST_NAME = 32
PER_MESSAGE = 4
"""Signals of 16 bits in a message of 8 bytes."""

MISSING = -(2**15)


def dbc_text(version: ModelVersion, program: Program) -> str:
    """Return the file: messages of four signals each, and one with the angle.

    Raw values of signals are counts. In the angle's message are its count, whether there is one,
    and the first 24 bits of the version's SHA-256. `GenMsgCycleTime` is the attribute of a message
    that tools read as milliseconds from one to the next.
    """
    return fill_in_version(
        "templates/estimator.dbc",
        version,
        program,
        node="fleet_slip",
        names=different([one.name for one in program.signals], LONGEST_NAME),
        longest_name=LONGEST_NAME,
        first_id=FIRST_ID,
        last_id=FIRST_ID + -(-len(program.signals) // PER_MESSAGE),
        per_message=PER_MESSAGE,
        missing=MISSING,
        tick_ms=round(1000 * SAMPLE_TIME_S),
    )
