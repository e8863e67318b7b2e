"""The messages of an estimator on a CAN bus, as a DBC file: what it needs, and what it says."""

from collections.abc import Sequence
from itertools import islice

from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.export.c.c_names import different
from fleet_slip.export.program import Input, Program
from fleet_slip.models.model_version import ModelVersion

FIRST_ID = 0x100
"""Identifier of the first message; whose bus it is decides."""

NODE = "fleet_slip"
LONGEST_NAME = 32
PER_MESSAGE = 4
"""Signals of 16 bits in a message of 8 bytes."""

MISSING = -(2**15)

CYCLE = "GenMsgCycleTime"
"""The attribute of a message that tools read as milliseconds from one to the next."""
TICK_MS = round(1000 * SAMPLE_TIME_S)


def dbc_text(version: ModelVersion, program: Program) -> str:
    """Return the file: messages of four signals each, and one with the angle.

    Raw values of signals are counts. In the angle's message are its count, whether there is one,
    and the first 24 bits of the version's SHA-256.
    """
    names = different([one.name for one in program.signals], LONGEST_NAME)
    signals = iter(zip(names, program.signals, strict=True))
    parts, comments = [_HEAD], [f'CM_ "{_about(version, program)}";']
    cycles = [f'BA_DEF_ BO_ "{CYCLE}" INT 0 65535;', f'BA_DEF_DEF_ "{CYCLE}" 0;']
    number = 0
    while chosen := list(islice(signals, PER_MESSAGE)):
        parts.append(_message(FIRST_ID + number, f"inputs_{number + 1}", _inputs(chosen)))
        comments += [
            f'CM_ SG_ {FIRST_ID + number} {name} "Count {MISSING} means that it is missing";'
            for name, _ in chosen
        ]
        number += 1
    identifier, angle = FIRST_ID + number, program.angle
    most = min(angle.largest, angle.limit) * angle.scale
    parts.append(
        _message(
            identifier,
            f"{angle.name}_estimate"[:LONGEST_NAME],
            [
                f" SG_ {angle.name[:LONGEST_NAME]} : 0|32@1- ({angle.scale:f},0) "
                f'[-{most:f}|{most:f}] "{angle.unit}" {NODE}',
                f' SG_ valid : 32|1@1+ (1,0) [0|1] "" {NODE}',
                f' SG_ model_sha256 : 40|24@1+ (1,0) [0|16777215] "" {NODE}',
            ],
        )
    )
    first = int(version.sha256[:6], 16)
    said = f"Of {version.reference} it is {first}: the first 24 bits"
    comments.append(f'CM_ SG_ {identifier} model_sha256 "{said}";')
    cycles += [f'BA_ "{CYCLE}" BO_ {FIRST_ID + i} {TICK_MS};' for i in range(number + 1)]
    return "\n".join([*parts, *comments, *cycles, ""])


_HEAD = f'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: {NODE}\n'


def _about(version: ModelVersion, program: Program) -> str:
    known = [one.field for one in program.facts] + [one.name for one in program.numbers]
    also = f" It needs to know of the car: {', '.join(known)}." if known else ""
    drives = version.manifest.trained_on.told_by or "unknown"
    return (
        f"{version.reference}, SHA-256 {version.sha256}, trained on drives with SHA-256 {drives}. "
        f"Identifiers are examples.{also}"
    )


def _inputs(chosen: Sequence[tuple[str, Input]]) -> list[str]:
    return [
        f" SG_ {name} : {16 * place}|16@1- ({one.scale:f},0) "
        f'[{one.min_count * one.scale:f}|{one.max_count * one.scale:f}] "{one.unit}" {NODE}'
        for place, (name, one) in enumerate(chosen)
    ]


def _message(identifier: int, name: str, signals: Sequence[str]) -> str:
    return "\n".join([f"BO_ {identifier} {name}: 8 {NODE}", *signals, ""])
