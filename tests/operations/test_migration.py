"""Signals come, go and change their scale: old and new files live together, or are refused."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.catalogue.signals import CATALOGUE_VARIABLE, catalogue
from fleet_slip.errors import ConflictError, RefusedError
from fleet_slip.grams.check import check_grams
from fleet_slip.grams.job import update_grams
from fleet_slip.operations.migration import migrate, rescale_counts
from fleet_slip.resources import folder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.storage.table import Change, Table, compare_schemas
from fleet_slip.views import connect
from fleet_slip.warehouse.tables import Warehouse
from tests.support.commands import RunCommand
from tests.support.logs import land, log_rows, path_of, random_counts

SHIPPED = (folder("configs") / "signals.toml").read_text()

PRESSURE = """
[signals.tyre_pressure]
unit = "Pa"
column = "tyre_pressure_pa"
scale = 1000
min = 0
max = 20000000
role = "input"
description = "Pressure in a tyre"

[drive.drive_id]"""

NEW_SIGNAL = SHIPPED.replace("[drive.drive_id]", PRESSURE.lstrip(), 1)
AX = "scale = 0.001\nmin = -30.0\nmax = 30.0"
WIDER_AX = SHIPPED.replace(AX, "scale = 0.002\nmin = -60\nmax = 60", 1)
FINER_AX = SHIPPED.replace(AX, "scale = 0.0005\nmin = -16\nmax = 16", 1)
BEFORE, _, REST = SHIPPED.partition("[signals.lateral_offset]")
WITHOUT_OFFSET = BEFORE + "# What is known" + REST.partition("# What is known")[2]

Use = Callable[[str], None]


@pytest.fixture
def use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Use]:
    """Return a function that makes a text the catalogue, here and in commands."""

    def chosen(text: str) -> None:
        file = tmp_path / "signals.toml"
        file.write_text(text)
        monkeypatch.setenv(CATALOGUE_VARIABLE, str(file))
        catalogue.cache_clear()

    yield chosen
    monkeypatch.undo()
    catalogue.cache_clear()


def small_counts(seed: int, rows: int = 40) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {n: rng.integers(-9000, 9000, rows).astype(np.int16) for n in catalogue().signals}


def fetch(warehouse: Warehouse, query: str) -> list[tuple[Any, ...]]:
    with connect(warehouse.root) as database:
        return database.execute(query).fetchall()


def test_a_new_signal_is_null_in_old_files(warehouse: Warehouse, use: Use) -> None:
    land(warehouse, "old", log_rows("old", small_counts(1)))
    update_grams(warehouse)
    before = fetch(warehouse, "SELECT sums, products FROM grams")
    use(NEW_SIGNAL)
    now = Warehouse(warehouse.root)
    assert fetch(now, "SELECT count(*), count(tyre_pressure_pa) FROM log") == [(40, 0)]
    with pytest.raises(RefusedError, match=r"has not: tyre_pressure.*fleet-slip migrate"):
        land(now, "new", log_rows("new", small_counts(2)))
    report = migrate(now)
    assert (report.added, report.files_rewritten) == (("tyre_pressure",), 0)
    assert not migrate(now).changed
    land(now, "new", log_rows("new", small_counts(2)))
    assert update_grams(now).files_read == 1
    signals = dict(fetch(now, "SELECT drive_id, signals FROM grams"))
    assert "tyre_pressure" in str(signals["new"])
    assert "tyre_pressure" not in str(signals["old"])
    assert fetch(now, "SELECT sums, products FROM grams WHERE drive_id = 'old'") == before
    assert fetch(now, "SELECT count(*), count(tyre_pressure) FROM log_counts") == [(80, 40)]
    check_grams(now, 10)


def test_grams_of_old_files_alone_are_the_same_with_a_new_signal(
    warehouse: Warehouse, use: Use
) -> None:
    land(warehouse, "old", log_rows("old", small_counts(1)))
    use(NEW_SIGNAL)
    now = Warehouse(warehouse.root)
    update_grams(now)
    update_grams(now, feature_set="rows")
    (signals, first), *_ = fetch(
        now, "SELECT signals, sums[1] FROM grams WHERE feature_set = 'signals'"
    )
    assert "tyre_pressure" not in str(signals)
    catalogue.cache_clear()
    assert first == small_counts(1)["ax"].sum()
    check_grams(now, 1)


def test_a_retired_signal_stays_in_old_files_and_is_not_asked_for(
    warehouse: Warehouse, use: Use
) -> None:
    land(warehouse, "old", log_rows("old", small_counts(1)))
    use(WITHOUT_OFFSET)
    now = Warehouse(warehouse.root)
    land(now, "new", log_rows("new", small_counts(2)))
    assert not migrate(now).changed
    assert fetch(now, "SELECT count(*), count(station_m) FROM log") == [(80, 80)]
    assert "lateral_offset_m" not in [row[0] for row in fetch(now, "DESCRIBE log")]


def test_counts_of_another_scale_are_refused_and_migrated(warehouse: Warehouse, use: Use) -> None:
    land(warehouse, "a", log_rows("a", small_counts(1)), log_rows("b", small_counts(2)))
    update_grams(warehouse)
    before = fetch(warehouse, "SELECT ax_mps2, ay_mps2 FROM log ORDER BY drive_id, tick")
    use(WIDER_AX)
    now = Warehouse(warehouse.root)
    for touch in (now.logs.snapshot, lambda: connect(now.root), lambda: update_grams(now)):
        with pytest.raises(RefusedError, match=r"ax 0.001 -> 0.002.*fleet-slip migrate"):
            touch()
    report = migrate(now)
    assert (report.files_rewritten, report.rows_rewritten) == (1, 80)
    after = fetch(now, "SELECT ax_mps2, ay_mps2 FROM log ORDER BY drive_id, tick")
    assert [ay for _, ay in after] == [ay for _, ay in before]
    worst = max(abs(a - b) for (a, _), (b, _) in zip(after, before, strict=True))
    assert 0 < worst <= 0.001 + 1e-12  # half a count of the new scale
    assert update_grams(now).files_dropped == 1
    check_grams(now, 1)
    land(now, "new", log_rows("c", small_counts(3)))
    use(SHIPPED)
    with pytest.raises(RefusedError, match=r"ax 0.002 -> 0.001"):
        warehouse.logs.snapshot()


def test_a_finer_scale_is_exact_and_refused_where_counts_do_not_fit(
    warehouse: Warehouse, use: Use
) -> None:
    land(warehouse, "a", log_rows("a", small_counts(1)))
    before = fetch(warehouse, "SELECT ax_mps2 FROM log ORDER BY tick")
    use(FINER_AX)
    migrate(Warehouse(warehouse.root))
    assert fetch(Warehouse(warehouse.root), "SELECT ax_mps2 FROM log ORDER BY tick") == before
    use(SHIPPED)
    other = Warehouse(LocalFolder(path_of(warehouse.root).parent / "other"))
    land(other, "a", log_rows("a", random_counts(np.random.default_rng(1), 20)))
    use(FINER_AX)
    with pytest.raises(RefusedError, match="do not fit 16 bits"):
        migrate(Warehouse(other.root))
    use(SHIPPED)
    with pytest.raises(RefusedError, match="a migration to other scales is under way"):
        land(other, "b", log_rows("b", small_counts(2)))
    migrate(Warehouse(other.root))
    land(Warehouse(other.root), "b", log_rows("b", small_counts(2)))


def test_a_migration_that_died_is_run_again(
    warehouse: Warehouse, use: Use, monkeypatch: pytest.MonkeyPatch
) -> None:
    for day in range(3):
        land(warehouse, f"f{day}", log_rows(f"d{day}", small_counts(day)))
    early = warehouse.logs.snapshot()
    action = warehouse.logs.write_file("late", log_rows("late", small_counts(9)))
    before = fetch(warehouse, "SELECT ax_mps2 FROM log ORDER BY drive_id, tick")
    use(FINER_AX)

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as dying:
        dying.setattr(Table, "write_file", interrupted)
        with pytest.raises(KeyboardInterrupt):
            migrate(Warehouse(warehouse.root))
    with pytest.raises(ConflictError):
        early.commit(Change(add=[action]))
    use(SHIPPED)  # readers with the old catalogue go on
    assert fetch(Warehouse(warehouse.root), "SELECT ax_mps2 FROM log ORDER BY drive_id, tick") == (
        before
    )
    use(FINER_AX)
    now = Warehouse(warehouse.root)
    assert migrate(now).files_rewritten == 3
    assert fetch(now, "SELECT ax_mps2 FROM log ORDER BY drive_id, tick") == before
    land(now, "new", log_rows("new", small_counts(4)))


def test_a_writer_that_began_before_the_migration_is_refused(
    warehouse: Warehouse, use: Use
) -> None:
    land(warehouse, "a", log_rows("a", small_counts(1)))
    early = warehouse.logs.snapshot()
    action = warehouse.logs.write_file("late", log_rows("late", small_counts(2)))
    use(WIDER_AX)
    migrate(Warehouse(warehouse.root))
    with pytest.raises(ConflictError):
        early.commit(Change(add=[action]))
    assert fetch(Warehouse(warehouse.root), "SELECT count(*) FROM log") == [(40,)]


def test_a_table_records_the_scales_from_the_start(warehouse: Warehouse) -> None:
    land(warehouse, "a", log_rows("a", small_counts(1)))
    delta = warehouse.logs.snapshot().delta
    assert delta is not None
    assert not compare_schemas(warehouse.logs.schema, delta).pending


@given(st.lists(st.integers(-32767, 32767), min_size=1), st.integers(1, 99), st.integers(1, 99))
def test_rescaling_rounds_as_python_does(counts: list[int], old: int, new: int) -> None:
    ratio = Fraction(old, new)
    found = rescale_counts(np.array(counts, dtype=np.int16), ratio).tolist()
    assert found == [round(count * ratio) for count in counts]


def test_the_nightly_job_goes_on_after_a_signal_was_added(
    run_command: RunCommand, use: Use
) -> None:
    run_command("run", "--campaign", "smoke", "--days", "1")
    use(NEW_SIGNAL)
    assert run_command("simulate", "smoke").exit_code == 7
    assert "added: tyre_pressure" in run_command("migrate").stderr
    assert run_command("run", "--campaign", "smoke").exit_code == 0
    assert "nothing to do" in run_command("migrate").stderr


def test_a_quarantine_of_an_earlier_version_gets_its_column(warehouse: Warehouse) -> None:
    now = warehouse.quarantine
    schema = now.schema.remove(now.schema.get_field_index("vehicle_id"))
    then = replace(now, schema=schema, encoding=replace(now.encoding, dictionary=()))
    for table in (then, now):
        row = {"file": "x.csv", "row": 1, "drive_id": "d", "vehicle_id": "car", "reason": "missing"}
        action = table.write_file("q", pa.Table.from_pylist([row], schema=table.schema))
        if table is now:
            with pytest.raises(RefusedError, match="fleet-slip migrate"):
                table.snapshot().commit(Change(add=[action]))
            migrate(warehouse)
        table.snapshot().commit(Change(add=[action]))
    with connect(path_of(warehouse.root)) as database:
        rows = database.execute("SELECT vehicle_id FROM quarantine ORDER BY ALL").fetchall()
    assert rows == [("car",), (None,)]
