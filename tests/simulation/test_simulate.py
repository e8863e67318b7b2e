"""The job that fills the logs: plans as it goes, and refuses early."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from highway_env.vehicle.dynamics import BicycleVehicle

from fleet_slip.base import no_progress
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.errors import RefusedError
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation import simulate
from fleet_slip.simulation.campaign import Batch, Campaign, load_campaign
from fleet_slip.simulation.simulate import (
    Engine,
    SimulationReport,
    lane_drive,
    simulate_batch,
    simulate_batches,
    simulate_campaign,
)
from fleet_slip.storage.local import LocalFolder
from fleet_slip.vehicle import batch as lanes
from fleet_slip.vehicle.highway import FourWheelVehicle, HighwayLanes
from fleet_slip.warehouse.erasure_log import ErasureLog, ErasureSubject
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import SIGNALS
from tests.support.commands import RunCommand, run_on
from tests.support.rolling import simulate_drives

DAYS = 5


def campaign(**changes: object) -> Campaign:
    """Return days of one drive of a few seconds."""
    plan = {"number_of_days": DAYS, "drives_per_day": 1, "laps": 0.03, **changes}
    return load_campaign("smoke", SHIPPED_CONFIGS).model_copy(update=plan)


def run(root: Path, plan: Campaign, progress: Callable[[int, int], None]) -> SimulationReport:
    with ThreadPoolExecutor(2) as executor:
        return simulate_campaign(
            Warehouse(LocalFolder(root)), plan, plan.days(), executor, progress
        )


def test_days_are_planned_while_others_are_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned: list[date] = []
    batches = Campaign.batches

    def counted(self: Campaign, day: date) -> tuple[Batch, ...]:
        planned.append(day)
        return batches(self, day)

    monkeypatch.setattr(Campaign, "batches", counted)
    at_landing: list[tuple[int, int, int]] = []
    report = run(
        tmp_path,
        campaign(),
        lambda rows, expected: at_landing.append((len(planned), rows, expected)),
    )
    assert at_landing[0][0] < DAYS
    assert planned == list(campaign().days())
    assert report.batches_written == DAYS
    for _, _, expected in at_landing:
        assert expected == pytest.approx(report.rows, rel=0.3)
    assert sum(rows for _, rows, _ in at_landing) == report.rows


def test_a_changed_campaign_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    late = campaign().days()[3:4]
    with ThreadPoolExecutor(2) as executor:
        simulate_campaign(Warehouse(LocalFolder(tmp_path)), campaign(), late, executor)
    before = Warehouse(LocalFolder(tmp_path)).logs.snapshot()
    with pytest.raises(RefusedError, match="has changed"):
        run(tmp_path, campaign(seed=77), no_progress)
    after = Warehouse(LocalFolder(tmp_path)).logs.snapshot()
    assert (after.version, after.rows) == (before.version, before.rows)


@pytest.mark.parametrize("index", [0, 1])
def test_a_change_is_refused_before_the_first_write_if_a_later_day_is_half_written(
    tmp_path: Path, index: int
) -> None:
    warehouse, plan = Warehouse(LocalFolder(tmp_path)), campaign(drives_per_day=2, rows_per_file=1)
    batches = plan.batches(plan.days()[3])
    assert len(batches) == 2
    with ThreadPoolExecutor(1) as executor:
        simulate_batches(warehouse, batches[index : index + 1], executor)
    before = warehouse.logs.snapshot()
    with pytest.raises(RefusedError, match="has changed"):
        run(tmp_path, plan.model_copy(update={"seed": 77}), no_progress)
    assert warehouse.logs.snapshot().version == before.version


def test_a_batch_is_rewritten_by_the_same_engine_after_an_erasure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse, plan = Warehouse(LocalFolder(tmp_path)), campaign(number_of_days=1, drives_per_day=2)
    erased, remaining = plan.drives(plan.first_day)
    written: list[tuple[tuple[str, ...], Engine]] = []

    def simulate_and_erase(signals: SignalCatalog, batch: Batch, engine: Engine) -> pa.Table:
        if not written:
            subject = ErasureSubject("drive", erased.drive_id)
            ErasureLog(warehouse.root).begin(subject, 1, [])
        written.append((tuple(drive.drive_id for drive in batch.drives), engine))
        return simulate_batch(signals, batch)

    monkeypatch.setattr(simulate, "simulate_batch", simulate_and_erase)
    with ThreadPoolExecutor(1) as executor:
        report = simulate_campaign(warehouse, plan, plan.days(), executor, engine="highway-env")
    both = (erased.drive_id, remaining.drive_id)
    assert written == [(both, "highway-env"), ((remaining.drive_id,), "highway-env")]
    assert (report.drives, report.drives_forgotten) == (1, 1)


def test_a_complete_day_is_never_planned_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path, campaign(), no_progress)
    before = Warehouse(LocalFolder(tmp_path)).logs.snapshot()
    monkeypatch.setattr(type(campaign()), "batches", None)
    again = run(tmp_path, campaign(), no_progress)
    assert (again.days_present, again.logs_version) == (DAYS, before.version)
    with pytest.raises(RefusedError, match="has changed"):
        run(tmp_path, campaign(seed=77), no_progress)


def test_days_that_landed_before_they_were_recorded_are_recorded(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    batches = [batch for day in campaign().days() for batch in campaign().batches(day)]
    with ThreadPoolExecutor(2) as executor:
        simulate_batches(warehouse, batches, executor)
    reports = [run(tmp_path, campaign(), no_progress) for _ in range(2)]
    assert [report.rows for report in reports] == [0, 0]
    assert [report.days_present for report in reports] == [0, DAYS]
    assert reports[0].logs_version == reports[1].logs_version


def broken_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    simulate = lanes.simulate_lanes

    def skewed(*arguments: Any) -> None:
        simulate(*arguments)
        with np.errstate(all="ignore"):  # rows after the end of a drive are not initialized
            arguments[6][:] *= 1 + 1e-8  # the truth of all lanes

    monkeypatch.setattr(lanes, "simulate_lanes", skewed)


def broken_bicycle(monkeypatch: pytest.MonkeyPatch) -> None:
    rates = BicycleVehicle.derivative_func

    def skewed(self: Any, *arguments: Any) -> Any:
        return rates(self, *arguments) * (1 + 1e-6)

    monkeypatch.setattr(BicycleVehicle, "derivative_func", skewed)


def broken_step(monkeypatch: pytest.MonkeyPatch) -> None:
    step = FourWheelVehicle.step
    monkeypatch.setattr(FourWheelVehicle, "step", lambda self, dt: step(self, dt * (1 + 1e-7)))


@pytest.mark.parametrize(
    ("breaking", "vehicle"),
    [
        (broken_kernel, "FourWheelVehicle"),
        (broken_step, "FourWheelVehicle"),
        (broken_bicycle, "BicycleVehicle"),
    ],
)
def test_drives_that_differ_from_highway_env_are_not_written(
    breaking: Callable[[pytest.MonkeyPatch], None],
    vehicle: str,
    run_command: RunCommand,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    breaking(monkeypatch)
    done = run_command("simulate", "smoke")
    assert done.exit_code == RefusedError.exit_code
    assert "the simulated car departs from highway-env" in done.stderr
    assert f"in {vehicle}. The file was not written" in done.stderr
    assert not list((tmp_path / "data").rglob("*.parquet"))


@pytest.mark.long
def test_a_campaign_that_highway_env_drives_has_the_same_logs(
    run_command: RunCommand, tmp_path: Path
) -> None:
    words = ("simulate", "smoke", "--days", "1")
    assert run_command(*words, "--engine", "highway-env").exit_code == 0
    run_on(tmp_path / "other", *words)
    logs, by_kernel = (
        {file.name: file.read_bytes() for file in (tmp_path / root).rglob("smoke-*.parquet")}
        for root in ("data", "other")
    )
    assert logs
    assert logs == by_kernel


def test_highway_env_drives_whole_drives_as_the_kernel() -> None:
    """Within 2e-11: its action is an angle of the road wheels, whose tangent is rounded.

    One car and its road are imperfect; both drives are longer than a lap.
    """
    plan = load_campaign("fleet_realistic", SHIPPED_CONFIGS)
    smoke = load_campaign("smoke", SHIPPED_CONFIGS)
    specs = [*plan.drives(plan.first_day)[:1], *smoke.drives(smoke.first_day)[:1]]
    drives = [lane_drive(replace(spec, laps=min(spec.laps, 1.1))) for spec in specs]
    by_kernel = simulate_drives(drives)
    by_highway_env = simulate_drives(drives, simulate_lanes=HighwayLanes(drives))
    for expected, truth in zip(by_kernel, by_highway_env, strict=True):
        assert truth.lost_control_tick == expected.lost_control_tick
        for name in lanes.CHANNELS:
            values = getattr(truth, name)
            np.testing.assert_allclose(values, getattr(expected, name), rtol=2e-11, atol=2e-11)
    batch = Batch("smoke", smoke.first_day, 0, (replace(specs[1], laps=0.1),))
    logs = simulate_batch(SIGNALS, batch, "highway-env")
    assert logs.equals(simulate_batch(SIGNALS, batch))
