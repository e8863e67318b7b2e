"""Exported DBC files, read by cantools: a drive that goes over the bus gives the same angles."""

from collections.abc import Sequence
from fractions import Fraction

import cantools
import pytest
from cantools.database.can.database import Database

from fleet_slip.export.program import Program
from fleet_slip.export.stepping import Sample, angles_by_kernel, compile_program
from fleet_slip.models.registry import ModelVersion
from tests.export.cars import Car
from tests.export.models import DEFINITIONS, export_texts, hostile_drive, model_of
from tests.support.catalog import CATALOG, SIGNALS

VERSION = ModelVersion(
    7, model_of(dict.fromkeys(DEFINITIONS, Fraction(1, 10**6))), "12ab34" * 10, CATALOG
)
PROGRAM = compile_program(CATALOG, VERSION.manifest)


@pytest.fixture(scope="module")
def bus() -> Database:
    text = export_texts(VERSION, None, "dbc")["sideslip_sideslip.dbc"]
    database = cantools.database.load_string(text, "dbc")
    assert isinstance(database, Database)
    return database


def over_the_bus(bus: Database, program: Program, sample: Sample) -> Sample:
    """Encode counts as physical values in messages; return the counts of the decoded ones."""
    counts: dict[str, int] = {}
    names = [item.name for item in program.signals]
    counts_with_code = [-(2**15) if count is None else count for count in sample]
    frame = dict(zip(names, counts_with_code, strict=True))
    for message in bus.messages[:-1]:
        raw = {signal.name: frame[signal.name] for signal in message.signals}
        data = message.encode(raw, scaling=False, strict=False)
        assert len(data) <= 8
        decoded = message.decode(data, scaling=False)
        assert isinstance(decoded, dict)
        counts |= {name: int(str(value)) for name, value in decoded.items()}
    return tuple(counts[item.name] for item in program.signals)


def test_a_drive_over_the_bus_gives_the_same_angles(bus: Database) -> None:
    samples: Sequence[Sample] = hostile_drive(PROGRAM, 100, 5)
    received = [over_the_bus(bus, PROGRAM, sample) for sample in samples]
    car = Car({"mass_kg": 1500.0, "vehicle_model": "suv"}, {})
    sent, angles = (
        angles_by_kernel(SIGNALS, VERSION.manifest, PROGRAM, car.facts, car.numbers, counts)
        for counts in (samples, received)
    )
    assert angles == sent
    assert len({*angles}) > 10
    angle = bus.get_message_by_name("sideslip_estimate").get_signal_by_name("sideslip")
    largest = max(abs(value) for value in angles if value is not None) * float(PROGRAM.angle.scale)
    assert angle.maximum is not None
    assert largest <= angle.maximum < 100 * largest
    assert angle.minimum == -angle.maximum


def test_signals_have_the_scales_units_and_ranges_of_the_catalog(bus: Database) -> None:
    by_name = {signal.name: signal for message in bus.messages for signal in message.signals}
    for program_signal in PROGRAM.signals:
        signal = by_name[program_signal.name]
        assert (signal.scale, signal.unit) == (float(program_signal.scale), program_signal.unit)
        assert signal.minimum == float(program_signal.min_count * program_signal.scale)
        assert signal.maximum == float(program_signal.max_count * program_signal.scale)
    assert [message.cycle_time for message in bus.messages] == [10] * len(bus.messages)


def test_the_angle_s_message_says_the_angle_and_of_which_version(bus: Database) -> None:
    message = bus.get_message_by_name("sideslip_estimate")
    data = message.encode({"sideslip": -0.12345, "valid": 1, "model_sha256": 0x12AB34})
    decoded = message.decode(data)
    assert decoded == {"sideslip": -0.12345, "valid": 1, "model_sha256": 0x12AB34}
    comment = message.get_signal_by_name("model_sha256").comment
    assert comment is not None
    assert str(0x12AB34) in comment
    assert "sideslip@7" in comment
