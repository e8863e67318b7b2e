"""Signals come and go, roots of earlier releases are read, and other scales are refused."""

import os
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.errors import RefusedError
from fleet_slip.grams.update import update_grams
from fleet_slip.operations.rewriting import migrate
from fleet_slip.operations.verify import check_grams
from fleet_slip.resources import folder
from fleet_slip.views import open_views
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS, configs_with
from tests.support.commands import RunCommand
from tests.support.counted_rows import gram_of, row_of, write_counted
from tests.support.logs import ask, land, log_rows

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
BEFORE, _, REST = SHIPPED.partition("[signals.lateral_offset]")
WITHOUT_OFFSET = BEFORE + REST[REST.index("[signals.") :]

Use = Callable[[str], Warehouse]


@pytest.fixture
def use(tmp_path: Path, warehouse: Warehouse) -> Use:
    """Return a function that opens the warehouse with a text as its signals."""

    def opened(text: str) -> Warehouse:
        return Warehouse(warehouse.root, configs_with(tmp_path / "configs", signals=text))

    return opened


def small_counts(seed: int, rows: int = 40, signals: SignalCatalog = SIGNALS) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {n: rng.integers(-9000, 9000, rows).astype(np.int16) for n in signals.signals}


def new_rows(warehouse: Warehouse) -> pa.Table:
    """Return a drive `new` with all signals of a warehouse."""
    signals = warehouse.catalog.signals
    return log_rows("new", small_counts(2, signals=signals), signals=signals)


def test_a_new_signal_is_null_in_old_files(warehouse: Warehouse, use: Use) -> None:
    land(warehouse, "old", log_rows("old", small_counts(1)))
    update_grams(warehouse)
    before = ask(warehouse.root, "SELECT sums, products FROM grams")
    now = use(NEW_SIGNAL)
    assert ask(now, "SELECT count(*), count(tyre_pressure_pa) FROM log") == [(40, 0)]
    with pytest.raises(RefusedError, match=r"lacks columns .*: tyre_pressure.*fleet-slip migrate"):
        land(now, "new", new_rows(now))
    report = migrate(now)
    assert report.added == ("tyre_pressure",)
    assert not migrate(now).changed
    land(now, "new", new_rows(now))
    assert update_grams(now).files_read == 1
    signals = dict(ask(now, "SELECT drive_id, signals FROM grams"))
    assert "tyre_pressure" in str(signals["new"])
    assert "tyre_pressure" not in str(signals["old"])
    assert ask(now, "SELECT sums, products FROM grams WHERE drive_id = 'old'") == before
    assert ask(now, "SELECT count(*), count(tyre_pressure) FROM log_counts") == [(80, 40)]
    check_grams(now, 10)


def test_a_retired_signal_stays_in_old_files_and_is_not_asked_for(
    warehouse: Warehouse, use: Use
) -> None:
    land(warehouse, "old", log_rows("old", small_counts(1)))
    now = use(WITHOUT_OFFSET)
    land(now, "new", new_rows(now))
    assert not migrate(now).changed
    assert ask(now, "SELECT count(*), count(station_m) FROM log") == [(80, 80)]
    assert "lateral_offset_m" not in [row[0] for row in ask(now, "DESCRIBE log")]


def test_counts_of_another_scale_are_refused(warehouse: Warehouse, use: Use) -> None:
    land(warehouse, "a", log_rows("a", small_counts(1)), log_rows("b", small_counts(2)))
    update_grams(warehouse)
    now = use(WIDER_AX)
    for touch in (
        now.logs.snapshot,
        lambda: open_views(now, None),
        lambda: update_grams(now),
        lambda: migrate(now),
    ):
        with pytest.raises(RefusedError, match=r"ax 0.001 -> 0.002.*another data root"):
            touch()
    assert ask(warehouse, "SELECT count(*) FROM log") == [(80,)]


def test_the_nightly_job_goes_on_after_a_signal_was_added(
    tmp_path: Path, run_command: RunCommand
) -> None:
    night = ("run", "--campaign", "smoke", "--models", "table1")
    run_command(*night, "--days", "1")
    configs = configs_with(tmp_path / "configs", signals=NEW_SIGNAL)
    other = {"env": {**os.environ, "FLEET_SLIP_CONFIG": str(configs.folder)}}
    assert run_command("simulate", "smoke", **other).exit_code == 7
    assert "added: tyre_pressure" in run_command("migrate", **other).stderr
    assert run_command(*night, **other).exit_code == 0
    assert "nothing to do" in run_command("migrate", **other).stderr


ROOTS = sorted((Path(__file__).parents[1] / "evidence/roots").glob("*.tar.gz"))
DRIVES, ROWS = 5, 2227
ERASED = "smoke-2024-05-02-0002"


@pytest.fixture(params=ROOTS, ids=lambda file: file.name.removesuffix(".tar.gz"))
def fleet(request: pytest.FixtureRequest, tmp_path: Path) -> Fleet:
    with tarfile.open(request.param) as archive:
        archive.extractall(tmp_path, filter="data")
    return fleet_slip.open(tmp_path / "data")


def test_a_root_is_migrated_read_and_sound(fleet: Fleet) -> None:
    fleet.maintenance.migrate()
    assert not fleet.maintenance.migrate().changed
    fleet.gram()
    assert fleet.maintenance.check_grams().drives == DRIVES
    (rows,) = fleet.sql("SELECT count(*) FROM log").fetchall()
    assert rows == (ROWS,)
    assert not fleet.maintenance.verify(full=True).findings
    assert not fleet.maintenance.quality().findings
    assert not fleet.maintenance.forget(drive=ERASED).changed


def test_its_model_estimates_and_is_trained_again_to_the_same(fleet: Fleet) -> None:
    fleet.maintenance.migrate()
    fleet.gram()
    old = fleet.models.get("smoke")
    score = fleet.evaluation.score(old)
    assert score.rows == ROWS
    assert score.error_std_deg < 0.2
    selection = fleet.cohort().select(model=",".join(old.manifest.signals))
    again = fleet.models.publish("smoke", selection, force=True).version.manifest
    assert [term.coefficient_exact for term in again.terms] == [
        term.coefficient_exact for term in old.manifest.terms
    ]
    assert again.intercept == old.manifest.intercept


def test_it_takes_gram_rows_of_cars_once_it_is_migrated(fleet: Fleet, tmp_path: Path) -> None:
    fleet.maintenance.migrate()
    fleet.gram()
    report = fleet.import_onboard_grams(write_counted(tmp_path / "rows", [row_of(gram_of(1))]))
    assert report.gram_rows == 1
    fleet.maintenance.forget(vehicle="VIN1")
    assert not fleet.maintenance.verify(full=True).damage
