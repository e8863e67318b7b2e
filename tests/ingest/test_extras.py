"""Signals that some cars log besides: stored where they are, and known to features alone."""

from pathlib import Path
from typing import Any

import pytest

from fleet_slip.errors import ConfigError, RefusedError
from fleet_slip.grams.compute import by_sql
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.rewriting import compact, migrate
from fleet_slip.operations.verify import verify
from fleet_slip.resources import folder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS, configs_with
from tests.support.logs import ask
from tests.support.measured import a_mapping, csv_text, ingest_file, physical, read_columns, ticks

ROWS = 300
PLAIN = {"ax": {"column": "ax", "unit": "m/s^2"}, "sideslip": {"column": "beta", "unit": "deg"}}
EXTRA = {
    "steer": {"column": "delta", "unit": "deg"},
    "brake_pressure": {"column": "p", "unit": "bar"},
    "throttle": {"column": "pedal", "unit": "%"},
    "gear": {"column": "gear", "unit": "1"},
    "vehicle_speed": {"column": "v", "unit": "km/h"},
    "roll_rate": {"column": "roll", "unit": "deg/s"},
}
OWN_FEATURES = """
[features.steer_doubled]
counts = "2 * steer"
scale = 0.00005
unit = "rad"
column = "steer_doubled_rad"
description = "Twice the road wheels' angle"

[windows.steer_late]
of = "steer"
over = "lag"
ticks = [1]
scale = 0.00005
unit = "rad"
column = "steer_late_{ticks}_rad"
description = "Angle of the road wheels so many ticks ago"

[sets.one_angle]
description = "One angle for both road wheels"
signals = ["ax", "steer"]
features = ["steer_doubled"]

[sets.looks_back]
description = "The angle of the tick before"
signals = ["ax"]
windows = ["steer_late"]
"""


def columns_of(rows: int = ROWS) -> dict[str, Any]:
    tick = range(rows)
    return {
        "t": [f"{i / 100:.2f}" for i in tick],
        "ax": [i % 5 * 0.1 for i in tick],
        "beta": [i % 7 * 0.1 for i in tick],
        "delta": [i % 11 * 0.2 for i in tick],
        "p": [i % 60 for i in tick],
        "pedal": [i % 101 for i in tick],
        "gear": [i % 7 - 1 for i in tick],
        "v": [90] * rows,
        "roll": [1.5] * rows,
    }


def write(file: Path, seed: int = 0) -> Path:
    file.write_text(csv_text(columns_of(ROWS + seed)), encoding="utf-8")
    return file


def test_extras_are_stored_in_their_units(tmp_path: Path) -> None:
    log = read_columns(tmp_path, columns_of(), a_mapping(signals={**PLAIN, **EXTRA}))
    assert physical(log, "brake_pressure", 1000)[:3] == pytest.approx([0, 1e5, 2e5])
    assert physical(log, "throttle", 0.0001)[100] == pytest.approx(1)
    assert physical(log, "gear", 1)[:3].tolist() == [-1, 0, 1]
    assert physical(log, "vehicle_speed", 0.005)[0] == pytest.approx(25)
    assert physical(log, "steer", 0.00005)[5] == pytest.approx(0.01745, abs=2.5e-5)


def test_one_angle_of_both_front_wheels_needs_no_line_for_each(tmp_path: Path) -> None:
    columns = {"t": ["0.00", "0.01", "0.02"], "delta": ["1", "", "-3"], "ax": ["0", "0", "0"]}
    signals = {"ax": {"column": "ax", "unit": "m/s^2"}, "steer": EXTRA["steer"]}
    log = read_columns(tmp_path, columns, a_mapping(signals=signals))
    assert log.drives["steer"].to_pylist()[1] is None
    for name in ("steer_fl", "steer_fr"):
        assert log.drives[name].to_pylist() == log.drives["steer"].to_pylist()
    one_sided = read_columns(
        tmp_path, columns, a_mapping(signals={**signals, "steer_fl": EXTRA["steer"]})
    )
    assert one_sided.drives["steer_fr"].null_count == 3


def test_a_gear_is_never_between_two_gears(tmp_path: Path) -> None:
    columns = {"t": [0, 0.05, 0.1, 0.15], "gear": [2, 3, 3, 5], "ax": [0, 1, 2, 3]}
    log = read_columns(tmp_path, columns, a_mapping(signals={"ax": PLAIN["ax"], **only("gear")}))
    assert ticks(log) == list(range(16))
    assert physical(log, "gear", 1).tolist() == [2] * 5 + [3] * 10 + [5]
    assert physical(log, "ax", 0.001)[1] == pytest.approx(0.2)


def only(name: str) -> dict[str, Any]:
    return {name: EXTRA[name]}


def test_a_file_has_the_columns_of_extras_only_where_a_drive_has_them(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    ingest_file(warehouse, write(tmp_path / "a.csv"), a_mapping(signals=PLAIN))
    (plain,) = warehouse.logs.snapshot().files
    assert not set(SIGNALS.extras) & set(plain.null_counts)
    assert ask(warehouse.root, "SELECT count(*), count(steer), count(gear) FROM log_counts") == [
        (ROWS, 0, 0)
    ]
    ingest_file(
        warehouse, write(tmp_path / "b.csv", 1), a_mapping(name="two", signals={**PLAIN, **EXTRA})
    )
    query = "SELECT count(*), count(steer_rad), max(gear_number), max(throttle_position) FROM log"
    assert ask(warehouse.root, query) == [(2 * ROWS + 1, ROWS + 1, 5.0, 1.0)]
    update_grams(warehouse)
    assert set(ask(warehouse.root, "SELECT signals FROM grams")) == {
        ("ax,sideslip",), ("ax,steer_fl,steer_fr,sideslip",),
    }  # fmt: skip
    compact(warehouse)
    assert ask(warehouse.root, query) == [(2 * ROWS + 1, ROWS + 1, 5.0, 1.0)]
    assert not list(verify(warehouse, full=True).damage)


def test_features_may_use_extras(warehouse: Warehouse, tmp_path: Path) -> None:
    shipped = {name: CATALOG.identity(name) for name in ("signals", *CATALOG.sets)}
    configs = configs_with(tmp_path / "configs", features=OWN_FEATURES)
    warehouse = Warehouse(warehouse.root, configs)
    assert {name: warehouse.catalog.identity(name) for name in shipped} == shipped
    ingest_file(warehouse, write(tmp_path / "a.csv"), a_mapping(signals=PLAIN))
    ingest_file(
        warehouse,
        write(tmp_path / "b.csv", 1),
        a_mapping(name="two", signals={**PLAIN, **only("steer")}),
    )
    update_grams(warehouse, feature_set="one_angle")
    ((names, n, sums),) = ask(
        warehouse.root,
        "SELECT signals, row_count, sums FROM grams "
        "WHERE starts_with(feature_set, 'one_angle') AND contains(signals, 'steer_doubled')",
    )
    assert (names, n) == ("ax,steer,steer_doubled,sideslip", ROWS + 1)
    assert sums[2] == 2 * sums[1]
    ((total,),) = ask(warehouse.root, "SELECT sum(steer) FROM log_counts")
    assert sums[1] == total
    late = by_sql(warehouse, warehouse.logs.snapshot().files, "looks_back").to_pylist()
    assert {row["n"]: row["signals"] for row in late}[ROWS] == "ax,steer_late_1,sideslip"
    ((plain, rows),) = ask(
        warehouse.root,
        "SELECT signals, row_count FROM grams WHERE starts_with(feature_set, 'one_angle') "
        "AND NOT contains(signals, 'steer')",
    )
    assert (plain, rows) == ("ax,sideslip", ROWS)


def test_a_data_root_of_before_takes_what_has_no_extras_and_asks_to_migrate_for_the_rest(
    warehouse: Warehouse, tmp_path: Path
) -> None:
    shipped = (folder("configs") / "signals.toml").read_text(encoding="utf-8")
    before, _, tail = shipped.partition("[signals.steer]\n")
    # Without the extras but those that shipped feature sets are of.
    signals = before + tail[tail.index("[signals.course]") :]
    old = Warehouse(warehouse.root, configs_with(tmp_path / "configs", signals=signals))
    of_old = a_mapping(signals=PLAIN, catalog=old.catalog)
    ingest_file(old, write(tmp_path / "a.csv"), of_old)
    update_grams(old)
    grams = ask(old, "SELECT * FROM grams")
    now = Warehouse(warehouse.root)
    with pytest.raises(ConfigError, match="loaded with other signals"):
        ingest_file(now, write(tmp_path / "b.csv", 1), of_old)
    assert ask(now.root, "SELECT * FROM grams") == grams
    assert update_grams(now).files_read == 0
    ingest_file(now, write(tmp_path / "b.csv", 1), a_mapping(signals=PLAIN))
    extended = a_mapping(name="two", signals={**PLAIN, **only("steer")})
    late = {**columns_of(), "ax": ["x", *columns_of()["ax"][1:]]}
    (tmp_path / "c.csv").write_text(csv_text(late), encoding="utf-8")
    with pytest.raises(
        RefusedError,
        match=r"lacks columns of the signal catalog: steer\. Add them with: fleet-slip migrate",
    ):
        ingest_file(now, tmp_path / "c.csv", extended)
    assert ask(now.root, "SELECT count(*) FROM quarantine") == [(0,)]
    migrate(now)
    ingest_file(now, tmp_path / "c.csv", extended)
    assert ask(now.root, "SELECT count(*), count(steer), count(gear) FROM log_counts") == [
        (3 * ROWS, ROWS - 1, 0)
    ]
