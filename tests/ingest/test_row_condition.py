"""Rows that a mapping leaves out are counted, and not quarantined one by one."""

import re
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pydantic import ValidationError

from fleet_slip.errors import InputError
from tests.support.measured import a_mapping, good_columns, read_columns, read_measured, ticks

IGNITION = [{"column": "KL15", "one_of": ["1"]}]


def columns() -> dict[str, Any]:
    speed = [4, 5, 5.5, None, "n/a", *[20] * 15]
    fix = ["RTK"] * 18 + ["none", ""]
    return good_columns(20) | {"speed": speed, "fix": fix}


@pytest.mark.parametrize(
    ("where", "kept"),
    [
        ([{"column": "speed", "at_least": 5}], [1, 2, *range(5, 20)]),
        ([{"column": "speed", "above": 5}], [2, *range(5, 20)]),
        ([{"column": "speed", "other_than": 20}], [0, 1, 2]),
        ([{"column": "speed", "at_least": 5, "below": 5.6}], [1, 2]),
        ([{"column": "speed", "at_least": 5, "at_most": 5.5}], [1, 2]),
        ([{"column": "fix", "one_of": ["RTK", "float"]}], list(range(18))),
        (
            [{"column": "speed", "above": 5}, {"column": "fix", "one_of": ["RTK"]}],
            [2, *range(5, 18)],
        ),
        ([{"signal": "vehicle_speed", "above": 5.1}], [2, *range(5, 20)]),
    ],
)
def test_rows_that_do_not_meet_the_conditions_are_counted(
    tmp_path: Path, where: Any, kept: list[int]
) -> None:
    rows = columns()
    rows["v"] = [18 if v is None else "" if v == "n/a" else 3.6 * v for v in rows["speed"]]
    signals = {
        "ax": {"column": "ax", "unit": "m/s^2"},
        "vehicle_speed": {"column": "v", "unit": "km/h"},
    }
    log = read_columns(tmp_path, rows, a_mapping(where=where, signals=signals))
    first = kept[0]
    assert ticks(log) == [tick - first for tick in kept]
    assert (log.counts.rows_read, log.counts.rows_left_out) == (20, 20 - len(kept))
    assert (log.counts.rows_kept, log.counts.quarantined) == (len(kept), {})


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("speed > 5", "write it as tables"),
        ([{"signal": "ay", "above": 1}], "'ay' is no signal of this mapping"),
        ([{"signal": "ax", "one_of": ["1"]}], "'one_of' is for a column"),
        ([{"at_least": 1}], "needs either 'column' or 'signal'"),
        ([{"column": "speed"}], "needs 'at_least', 'at_most' or 'one_of'"),
        ([{"column": "speed", "at_least": 1, "one_of": ["a"]}], "and not both"),
        ([{"column": "speed", "at_least": float("nan")}], "finite number"),
    ],
)
def test_what_a_condition_cannot_be(where: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(message)):
        a_mapping(where=where)


def test_a_number_in_parquet_can_be_one_of_several(tmp_path: Path) -> None:
    table = {"t": [0, 0.01, 0.02, 0.03], "ax": [1.0] * 4, "beta": [0.0] * 4, "fix": [4.0, 4, 5, 1]}
    pq.write_table(pa.table(table), tmp_path / "log.parquet")
    where = [{"column": "fix", "one_of": ["4", "5"]}]
    log = read_measured(tmp_path / "log.parquet", a_mapping(where=where))
    assert ticks(log) == [0, 1, 2]
    assert log.counts.rows_left_out == 1


def test_rows_keep_their_numbers_in_the_quarantine(tmp_path: Path) -> None:
    bad = columns()
    bad["ax"][7] = "much"
    log = read_columns(tmp_path, bad, a_mapping(where=[{"column": "speed", "at_least": 6}]))
    assert log.quarantine["row"].to_pylist() == [8]


def test_a_condition_that_no_row_meets_is_an_error(tmp_path: Path) -> None:
    where = [{"column": "speed", "at_least": 500}]
    with pytest.raises(InputError, match=r"none of 20 rows .* 'speed' is at least 500"):
        read_columns(tmp_path, columns(), a_mapping(where=where))


def test_a_drive_ends_where_the_ignition_is_off(tmp_path: Path) -> None:
    rows = good_columns(100)
    rows["t"] = [f"{i / 10:.1f}" for i in range(100)]  # at 10 Hz
    on = [0] * 5 + [1] * 40 + [0] * 15 + [1] * 40
    rows["KL15"] = on
    time = {"longest_gap_s": 0.2, "split_gap_s": 1}
    log = read_columns(tmp_path, rows, a_mapping(where=IGNITION, time=time))
    assert log.counts.rows_left_out == on.count(0)
    first, second = sorted(set(log.drives["drive_id"].to_pylist()))
    assert second == f"{first}-2"
    assert log.counts.ticks == 2 * 391
    assert log.counts.quarantined == {}
    short = {"longest_gap_s": 0.2, "split_gap_s": 2}
    whole = read_columns(tmp_path, rows, a_mapping(where=IGNITION, time=short))
    assert whole.counts.drives == 1
