"""Drafts for logs with names and units that departments publish: what is not known is asked.

`tests/data/stranger_names.csv` has them: of each log one half or the other, so that what guesses
was made on one half of the logs alone, and is judged on both.
"""

import csv
import re
import tomllib
from collections import Counter
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asammdf import MDF, Signal

from fleet_slip.arrays import FloatArray
from fleet_slip.errors import InputError
from fleet_slip.ingest.columns import SignalColumn, conversion_factor
from fleet_slip.ingest.draft import draft_mapping, write_draft
from fleet_slip.ingest.profile import profile_file
from fleet_slip.quality.drive_signals import RADIUS_M
from tests.support.catalog import SIGNALS
from tests.support.textbook_car import a_car

NAMES = Path(__file__).parents[1] / "data" / "stranger_names.csv"
ROWS = 4000


@dataclass(frozen=True)
class Named:
    """One column of a stranger's log; `signal` is empty where it is none of ours."""

    half: str
    log: str
    layout: str
    name: str
    unit: str
    signal: str
    measured_in: str
    sign: str
    source: str
    licence: str


def strangers() -> dict[str, list[Named]]:
    """Return the columns of each log."""
    with NAMES.open(encoding="utf-8", newline="") as stream:
        rows = [Named(**row) for row in csv.DictReader(stream)]
    return {log: list(columns) for log, columns in groupby(rows, lambda row: row.log)}


def score(columns: list[Named], folder: Path) -> Counter[str]:
    """Return how many lines of a draft are right, asked, wrong, missing, or extra."""
    file = folder / f"{columns[0].log}.{'mf4' if columns[0].layout == 'mdf' else 'csv'}"
    _write(file, columns)
    try:
        text = write_draft(draft_mapping(SIGNALS, file, profile_file(file)), "draft")
    except InputError:
        return Counter(missing=sum(bool(column.signal) for column in columns))
    return _judge(columns, text)


_KEY_A_LINE = re.compile(r"^(# )?(\w+)\.column = (.*)\n((?:(?:# )?\2\.\w+ = .*\n?)*)", re.MULTILINE)
"""A signal whose keys are on a line each."""


def _on_one_line(match: re.Match[str]) -> str:
    more = "".join(f", {line.partition('.')[2]}" for line in match[4].splitlines())
    return f"{match[1] or ''}{match[2]} = {{ column = {match[3]}{more} }}\n"


def _judge(columns: list[Named], text: str) -> Counter[str]:
    text = _KEY_A_LINE.sub(_on_one_line, text)
    choices = [
        line.replace('"choose"', unit.replace(" with", ","))
        for units, line in re.findall(r"^# Choose the unit: (.*)\.\n(.*)", text, re.MULTILINE)
        for unit in units.split(" or ")
    ]
    text = re.sub(r"^.*\"choose\".*$", "", text, flags=re.MULTILINE)
    lines = tomllib.loads(text).get("signals", {})
    choices += re.findall(r"^# (\w+ = \{.*\})", text, re.MULTILINE)
    verdicts: Counter[str] = Counter()
    for column in columns:
        if not column.signal:
            continue
        if column.signal in lines:
            keys = lines.pop(column.signal)
            verdicts["right" if _is_right(column, keys) else "wrong"] += 1
        else:
            alternatives = [tomllib.loads(line) for line in choices]
            right = any(
                _is_right(column, alternative.get(column.signal, {}))
                for alternative in alternatives
            )
            verdicts["asked" if right else "missing"] += 1
    verdicts["extra"] += len(lines)
    return verdicts


def _is_right(column: Named, keys: dict[str, Any]) -> bool:
    if keys.get("column") != _header(column):
        return False
    if column.sign and keys.get("sign", {}).get("column") != column.sign:
        return False
    given_keys = {key: value for key, value in keys.items() if key != "longest_gap_s"}
    si_unit = SIGNALS[column.signal].unit
    try:
        gain, _ = SignalColumn.model_validate(given_keys).linear(si_unit)
    except ValueError:
        return False
    return bool(np.isclose(gain, 1 / _per_si(column), rtol=1e-2))


def _header(column: Named) -> str:
    if not column.unit:
        return column.name
    texts = {
        "brackets": f"{column.name} [{column.unit}]",
        "parens": f"{column.name} ({column.unit})",
    }
    return texts.get(column.layout, column.name)


def _per_si(column: Named) -> float:
    """Return what one SI unit is in the file."""
    si_unit = SIGNALS[column.signal].unit
    if column.signal.startswith("wheel_") and column.measured_in in {"m/s", "km/h"}:
        return RADIUS_M / conversion_factor(column.measured_in, "m/s")
    return 1 / conversion_factor(column.measured_in, si_unit)


def _write(file: Path, columns: list[Named]) -> None:
    car = _car()
    values: dict[str, FloatArray] = {}
    for number, column in enumerate(columns):
        if not column.signal:
            values[column.name] = _other(column.measured_in, car, number)
            continue
        samples = car[column.signal] * _per_si(column)
        values[column.name] = np.abs(samples) if column.sign else samples
        if column.sign:
            values[column.sign] = (samples < 0).astype(np.float64)
    units = {column.name: column.unit for column in columns}
    time_s = np.arange(ROWS) / 100
    if columns[0].layout == "mdf":
        with MDF(version="4.10") as mdf:
            mdf.append(
                [Signal(v, time_s, name=n, unit=units.get(n, "")) for n, v in values.items()]
            )
            mdf.save(file)
        return
    headers = {column.name: _header(column) for column in columns}
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time_s", *(headers.get(name, name) for name in values)])
        if columns[0].layout == "row":
            writer.writerow(["s", *(units.get(name, "") for name in values)])
        writer.writerows(np.round(np.column_stack([time_s, *values.values()]), 6).tolist())


def _car() -> dict[str, FloatArray]:
    """Return the car by the textbook, with what other cars log beside it."""
    car = {name: values[:ROWS] for name, values in a_car().items()}
    speed = np.asarray((car["wheel_rl"] + car["wheel_rr"]) / 2 * RADIUS_M)
    return {
        **car,
        "vehicle_speed": speed,
        "vx": speed,
        "vy": speed * np.tan(car["sideslip"]),
        "roll_rate": np.gradient(0.04 * car["ay"], 0.01),
        "brake_pressure": np.maximum(-car["ax"], 0) * 1e6,
    }


def _other(kind: str, car: dict[str, FloatArray], number: int) -> FloatArray:
    """Return values of what is none of our signals: a motor, a rate of steering."""
    rate = np.degrees(np.gradient(car["steering_wheel"], 0.01)) * (1 + number / 50)
    kinds = {"engine": car["vehicle_speed"] * 90 + 40 * number, "absrate": np.abs(rate)}
    return kinds.get(kind, rate)


LOGS = strangers()
LESS_THAN_ALL = {"carsim": 4, "grapro": 0}
"""Lines that are right, or ask for the unit, of the logs of which not all are."""


@pytest.mark.parametrize("log", LOGS)
def test_no_line_of_a_draft_is_wrong(tmp_path: Path, log: str) -> None:
    columns = LOGS[log]
    verdicts = score(columns, tmp_path)
    signals = sum(bool(column.signal) for column in columns)
    assert (verdicts["wrong"], verdicts["extra"]) == (0, 0)
    assert verdicts["right"] + verdicts["asked"] >= LESS_THAN_ALL.get(log, signals)


def test_half_of_the_logs_judge_and_each_names_its_source() -> None:
    halves = [columns[0].half for columns in LOGS.values()]
    assert abs(halves.count("build") - halves.count("judge")) <= 1
    for columns in LOGS.values():
        assert len({(column.half, column.layout) for column in columns}) == 1
        assert all(column.source and column.licence for column in columns)
