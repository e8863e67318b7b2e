"""Faulty sensors, labels and repeated drives, found from Gram rows: what was broken is named."""

import math
from collections.abc import Callable, Sequence
from datetime import UTC, date, datetime, timedelta
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.errors import DataError
from fleet_slip.grams.cohort import Cohort, load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.operations import sensor_screen
from fleet_slip.operations.sensor_screen import (
    QualityReport,
    examine,
    examine_drives,
    find_wrong_labels,
)
from fleet_slip.quality.checks import Fault
from fleet_slip.quality.peers import find_repeated, thresholds
from fleet_slip.regression.gram import Gram
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.warehouse.database import parse_predicate
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.cars import TICKS, Signals, broken, counts, drive, gram_of, with_course
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.commands import RunCommand
from tests.support.counts import table_of
from tests.support.logs import DAY, land, log_rows, random_counts

DRIVES = 30


Driven = tuple[str, str, date, Gram]
"""A drive: its name, car, day and sums."""


def driven(name: str, signals: Signals, car: str = "car-1", day: date = DAY) -> Driven:
    return name, car, day, gram_of(counts(signals))


def cohort_of(drives_: Sequence[Driven]) -> Cohort:
    """Return the cohort of some drives of one vehicle model, as from their logs."""
    *_, days, grams = zip(*drives_, strict=True)
    table = drives(*((car, name, None, TICKS / 100) for name, car, *_ in drives_))
    same = {"vehicle_model": ["car"] * len(drives_), "saturated": [0] * len(drives_)}
    for name, values in {"day": [*days], **same}.items():
        table = table.append_column(name, [values])
    return Cohort(
        predicate=parse_predicate(SIGNALS, "true"),
        logs_version=1,
        grams_version=1,
        drives=table,
        tables=(table_of(grams),),
        catalog=CATALOG,
    )


def examine_labels_too(drives_: Sequence[Driven]) -> QualityReport:
    cohort = cohort_of(drives_)
    return examine(cohort, find_wrong_labels(cohort))


def fleet(change: Callable[[Signals], None]) -> Cohort:
    """Return drives of which the last has a fault."""
    signals_of_drives, last = sound()
    return cohort_of([*signals_of_drives, driven("d29", broken(last, change))])


@cache
def sound() -> tuple[list[Driven], Signals]:
    """Return all drives but the last, and what that would be."""
    rng = np.random.default_rng(5)
    *signals, last = [drive(rng) for _ in range(DRIVES)]
    return [driven(f"d{i:02d}", values) for i, values in enumerate(signals)], last


def only_finding(report: QualityReport) -> Fault:
    assert [finding.drive_id for finding in report.findings] == ["d29"]
    return report.findings[0].fault


def swap(a: str, b: str) -> Callable[[Signals], None]:
    def change(signals: Signals) -> None:
        signals[a], signals[b] = signals[b], signals[a]

    return change


def add(name: str, offset: float) -> Callable[[Signals], None]:
    return lambda signals: signals.__setitem__(name, signals[name] + offset)


def multiply(name: str, factor: float) -> Callable[[Signals], None]:
    return lambda signals: signals.__setitem__(name, signals[name] * factor)


def shake(name: str, std: float) -> Callable[[Signals], None]:
    noise = std * np.random.default_rng(9).standard_normal(TICKS)
    return lambda signals: signals.__setitem__(name, signals[name] + noise)


FAULTS = [
    (multiply("ay", -1), "reversed", ("ay",)),
    (multiply("yaw_rate", -1), "reversed", ("yaw_rate",)),
    (multiply("steering_wheel", -1), "reversed", ("steering_wheel",)),
    (swap("ax", "ay"), "swapped", ("ax", "ay")),
    (swap("wheel_fl", "wheel_fr"), "swapped", ("wheel_fl", "wheel_fr")),
    (swap("wheel_rl", "wheel_rr"), "swapped", ("wheel_rl", "wheel_rr")),
    (swap("steer_fl", "steer_fr"), "swapped", ("steer_fl", "steer_fr")),
    (multiply("wheel_rl", 0), "stuck", ("wheel_rl",)),
    (add("yaw_rate", 0.1), "biased", ("yaw_rate",)),
    (add("steering_wheel", 0.1), "biased", ("steering_wheel",)),
    (multiply("wheel_fr", 1.05), "scaled", ("wheel_fr",)),
    (shake("steering_wheel", 0.1), "noisy", ("steering_wheel",)),
    (shake("sideslip", 0.1), "noisy", ("sideslip",)),
]


@pytest.mark.parametrize(("change", "kind", "signals"), FAULTS)
def test_a_broken_sensor_is_named(
    change: Callable[[Signals], None], kind: str, signals: tuple[str, ...]
) -> None:
    fault = only_finding(examine(fleet(change)))
    assert (fault.kind, fault.signals) == (kind, signals)


@pytest.mark.parametrize("turned", [1, DRIVES - 1])
def test_a_label_that_is_reversed_for_one_car_is_found(turned: int) -> None:
    rng = np.random.default_rng(6)
    other = [
        driven(f"e{i:02d}", broken(drive(rng), multiply("sideslip", -1)), "e")
        for i in range(turned)
    ]
    findings = examine_labels_too([*sound()[0], *other]).findings
    assert [(finding.drive_id, finding.vehicle_id) for finding in findings] == [
        (f"e{i:02d}", "e") for i in range(turned)
    ]
    assert {(finding.fault.kind, finding.fault.signals) for finding in findings} == {
        ("reversed", ("sideslip",))
    }


def two_kinds_of_cars(often: Callable[[Signals], None]) -> QualityReport:
    """Examine 60 drives of one car, whose sensors have no offsets, and one each of 30 others."""
    rng = np.random.default_rng(6)
    cars = [driven(f"often-{i:02d}", broken(drive(rng), often), "often") for i in range(60)]
    for i in range(30):
        signals = broken(drive(rng), add("ay", rng.normal(0, 0.3)))
        signals = broken(signals, add("yaw_rate", rng.normal(0, 0.02)))
        cars.append(driven(f"once-{i:02d}", signals, f"car-{i:02d}"))
    return examine(cohort_of(cars))


def test_a_car_that_drives_every_day_does_not_say_what_is_usual() -> None:
    report = two_kinds_of_cars(lambda _: None)
    assert (report.drives, report.compared, report.findings) == (90, 90, ())


def test_a_fault_in_all_drives_of_a_car_shows_beside_other_cars() -> None:
    report = two_kinds_of_cars(add("steering_wheel", 0.3))
    (finding,) = report.findings
    assert (finding.drive_id, finding.fault.kind) == ("often-00", "biased")
    assert finding.fault.signals == ("steering_wheel",)


def test_drives_in_order_raise_no_alarm() -> None:
    report = examine(fleet(lambda _: None))
    assert (report.drives, report.compared, report.findings) == (DRIVES, DRIVES, ())


def choose_limits(monkeypatch: pytest.MonkeyPatch, **changes: int) -> None:
    limits = thresholds(SHIPPED_CONFIGS).quality.model_copy(update=changes)
    chosen = thresholds(SHIPPED_CONFIGS).model_copy(update={"quality": limits})
    monkeypatch.setattr(sensor_screen, "thresholds", lambda _: chosen)


def test_vehicle_models_are_examined_one_after_the_other(
    warehouse: Warehouse, monkeypatch: pytest.MonkeyPatch
) -> None:
    choose_limits(monkeypatch, min_rows=100, min_drives=8)
    rng = np.random.default_rng(3)
    for file, model in enumerate(("beetle", "driver's", None)):
        rows = [
            log_rows(f"{model}-{i}", random_counts(rng, 200), vehicle_model=model)
            for i in range(12)
        ]
        land(warehouse, str(file), *rows)
    update_grams(warehouse)
    for predicate in ("true", "drive_id LIKE '%-1' -- and '%-11'", "vehicle_model IS NULL"):
        cohort = load_cohort(warehouse, f"{predicate}\n")
        together = examine(cohort, find_wrong_labels(cohort))
        assert examine_drives(warehouse, predicate) == together
        assert together.drives > 0
    with pytest.raises(DataError, match="no drive matches"):
        examine_drives(warehouse, "mass_kg > 1e9")


def test_the_command_tells_by_its_exit_code(run_command: RunCommand, warehouse: Warehouse) -> None:
    rng = np.random.default_rng(5)
    signals = [drive(rng) for _ in range(DRIVES)]
    multiply("ay", -1)(signals[-1])
    rows = [
        log_rows(f"d{i:02d}", counts(values), saturated=TICKS // 10 if i == 28 else 0)
        for i, values in enumerate(signals)
    ]
    land(warehouse, "all", *rows)
    update_grams(warehouse)
    bad = run_command("quality", "--json")
    assert bad.exit_code == 10
    assert [(f["drive_id"], f["kind"], f["signals"]) for f in bad.json["findings"]] == [
        ("d28", "saturated", []),
        ("d29", "reversed", ["ay"]),
    ]
    assert "faulty sensors in 2 of 30 drives" in bad.stderr
    good = run_command("quality", "--cohort", "drive_id < 'd28'")
    assert good.exit_code == 0
    assert "28 drives checked" in good.stdout


def test_a_heading_and_a_reversed_course_are_found(warehouse: Warehouse) -> None:
    """From the Gram rows of changes of the course, where they are; before, both trained models."""
    rng = np.random.default_rng(5)
    drives = {}
    for name in ("sound", "heading", "turned"):
        signals = with_course(drive(rng, gentleness=4), rng, slip=name != "heading")
        signals["course"] *= -1 if name == "turned" else 1
        fixes = ~np.isnan(signals["course"])
        columns: dict[str, Any] = {**counts({k: np.nan_to_num(v) for k, v in signals.items()})}
        for extra in ("course", "satellite_speed"):
            columns[extra] = [
                v if fix else None for v, fix in zip(columns[extra].tolist(), fixes, strict=True)
            ]
        drives[name] = columns
    land(warehouse, "all", *(log_rows(name, item) for name, item in drives.items()))
    update_grams(warehouse)
    assert examine_drives(warehouse).findings == ()
    update_grams(warehouse, feature_set="course")
    faults = {item.drive_id: item.fault for item in examine_drives(warehouse).findings}
    assert {name: (item.kind, item.signals) for name, item in faults.items()} == {
        "heading": ("no slip", ("course",)),
        "turned": ("reversed", ("course",)),
    }


def test_steering_of_cars_with_biased_sensors_is_not_called_swapped() -> None:
    """The mean difference of the wheels is some hundredths of a degree; sensors are off by more."""
    rng = np.random.default_rng(8)
    cars = []
    for number in range(DRIVES):
        signals = drive(rng)
        signals["steer_fl"] = 0.4 * signals["steer_fl"] + rng.normal(0, 0.005)
        signals["steer_fr"] = 0.4 * signals["steer_fr"]
        cars.append(driven(f"d{number}", signals, f"car-{number}"))
    assert examine_labels_too(cars).findings == ()


SIDES = {"fl", "fr", "rl", "rr"}


def there_and_mirrored(signals: Signals) -> Signals:
    """Return the first half of a drive, and once more with left for right."""
    halves = {}
    for name, values in signals.items():
        other = name[:-1] + {"l": "r", "r": "l"}[name[-1]] if name[-2:] in SIDES else name
        sign = 1 if name == "ax" or name.startswith("wheel") else -1
        half = values.size // 2
        halves[name] = np.concatenate([values[:half], sign * signals[other][: values.size - half]])
    return halves


def test_a_yaw_rate_without_its_sign_is_found() -> None:
    rng = np.random.default_rng(9)
    drives = []
    for number in range(4):
        signals = there_and_mirrored(drive(rng))
        if number == 2:
            signals["yaw_rate"] = np.abs(signals["yaw_rate"])
        drives.append(driven(f"d{number}", signals))
    faults = {finding.drive_id: finding.fault for finding in examine_labels_too(drives).findings}
    assert {name: (fault.kind, fault.signals) for name, fault in faults.items()} == {
        "d2": ("magnitude", ("yaw_rate",))
    }


BEGAN = datetime(2024, 5, 31, 8, tzinfo=UTC)


def drives(*facts: tuple[str, str, float | None, float]) -> pa.Table:
    """Drives by car, name, begin and duration in s."""
    at = [None if start is None else BEGAN + timedelta(seconds=start) for _, _, start, _ in facts]
    return pa.table(
        {
            "vehicle_id": [car for car, *_ in facts],
            "drive_id": [name for _, name, *_ in facts],
            "started_at": pa.array(at, pa.timestamp("us", tz="UTC")),
            "duration_s": [lasted for *_, lasted in facts],
            "source": ["measured"] * len(facts),
            "n": [0] * len(facts),
        }
    )


def received(car: str, start_s: float, rows: int) -> pa.Table:
    """A drive without a log."""
    name = f"{car}-{BEGAN + timedelta(seconds=start_s):%Y%m%dT%H%M%SZ}"
    table = drives((car, name, None, 0.0))
    table = table.set_column(2, "started_at", pa.nulls(1, table.schema.field(2).type))
    table = table.set_column(3, "duration_s", pa.nulls(1, pa.float64()))
    table = table.set_column(4, "source", [["received"]])
    return table.set_column(5, "n", [[rows]])


def test_the_later_of_two_drives_at_once_is_named() -> None:
    repeated = find_repeated(
        drives(
            ("car", "long", 0, 1000),
            ("car", "within", 100, 50),
            ("car", "beyond", 950, 100),
            ("car", "after", 1049.5, 10),
            ("other", "elsewhere", 0, 1000),
            ("car", "undated", None, 1000),
        )
    )
    assert {name: fault.figure for name, fault in repeated.items()} == {
        "within": "50 s overlap with long",
        "beyond": "50 s overlap with long",
    }
    assert {fault.kind for fault in repeated.values()} == {"repeated"}


def test_a_drive_without_a_log_is_named_beside_its_log() -> None:
    repeated = find_repeated(
        pa.concat_tables(
            [
                received("car", 0, 4000),
                drives(("car", "resampled", 0.25, 39.5), ("car", "next", 41, 100)),
                received("car", 60, 1000),
                received("car", 60, 3000),  # another set of signals of the same drive
                received("car", 150, 1000),
                received("car", 155, 1000),
                received("other", 0, 1000),
                received("other", 9, 1000),  # its clock has whole seconds
            ]
        )
    )
    assert {name: fault.figure for name, fault in repeated.items()} == {
        "car-20240531T080000Z": "40 s overlap with resampled",
        "car-20240531T080100Z": "40 s overlap with next",
        "car-20240531T080235Z": "5 s overlap with car-20240531T080230Z",
    }


CARS, DAYS = 12, 3
NIGHT = DAY + timedelta(days=DAYS - 1)


def three_days(change: Callable[[Signals], None], step: int = 1) -> list[Driven]:
    """Return three days of drives of as many cars; on the last, every n-th label is wrong."""
    before, last = two_days()
    return before + of_day(
        NIGHT, [s if i % step else broken(s, change) for i, s in enumerate(last)]
    )


@cache
def two_days() -> tuple[list[Driven], list[Signals]]:
    """Return the drives of the first days, and those of the last."""
    rng = np.random.default_rng(1)
    factors = 1 + 0.1 * rng.standard_normal(CARS)
    before: list[Driven] = []
    for number in range(DAYS):
        signals = [drive(rng, gentleness=2) for _ in factors]
        for values, factor in zip(signals, factors, strict=True):
            values["sideslip"] *= factor
        if number < DAYS - 1:
            before += of_day(DAY + timedelta(days=number), signals)
    return before, signals


def of_day(day: date, signals: list[Signals]) -> list[Driven]:
    return [driven(f"{day}-{i:02d}", values, f"car-{i}", day) for i, values in enumerate(signals)]


def multiplied(factor: float) -> Callable[[Signals], None]:
    return lambda signals: signals.update(sideslip=factor * signals["sideslip"])


def shifted(degrees: float) -> Callable[[Signals], None]:
    return lambda signals: signals.update(sideslip=signals["sideslip"] + math.radians(degrees))


def iced(signals: Signals) -> None:
    """A tenth more, and as much less zero as ice brings: nothing is wrong."""
    multiplied(1.12)(signals)
    shifted(0.1)(signals)


def kinds_and_days(cars: Sequence[Driven]) -> tuple[set[str], set[str], int]:
    """Return the kinds, days and number of wrong labels, whatever peers tell of the drives."""
    faults = find_wrong_labels(cohort_of(cars))
    return {fault.kind for fault in faults.values()}, {name[:10] for name in faults}, len(faults)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (multiplied(1.6), "scaled"),
        (multiplied(1 / 57.3), "scaled"),
        (multiplied(-1), "reversed"),
        (shifted(1), "biased"),
    ],
)
def test_a_day_on_which_all_labels_are_wrong_is_found(
    change: Callable[[Signals], None], kind: str
) -> None:
    assert kinds_and_days(three_days(change)) == ({kind}, {str(NIGHT)}, CARS)


@pytest.mark.parametrize("change", [multiplied(1 / 57.3), shifted(2)])
def test_a_third_of_a_days_labels_is_found(change: Callable[[Signals], None]) -> None:
    assert kinds_and_days(three_days(change, step=3))[1:] == ({str(NIGHT)}, CARS / 3)


def test_effects_of_roads_and_loads_are_no_faults() -> None:
    assert kinds_and_days(three_days(iced)) == (set(), set(), 0)
