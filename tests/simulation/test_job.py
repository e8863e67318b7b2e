"""The job that fills the logs: plans as it goes, and refuses early."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path

import pytest

from fleet_slip.base import no_progress
from fleet_slip.errors import RefusedError
from fleet_slip.simulation.campaign import Batch, Campaign, load_campaign
from fleet_slip.simulation.job import SimulationReport, simulate_batches, simulate_campaign
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.tables import Warehouse

DAYS = 12


def campaign(**changes: object) -> Campaign:
    """Return a dozen days of one drive of a few seconds."""
    plan = {"number_of_days": DAYS, "drives_per_day": 1, "laps": 0.03, **changes}
    return load_campaign("smoke").model_copy(update=plan)


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
    late = campaign().days()[8:9]
    with ThreadPoolExecutor(2) as executor:
        simulate_campaign(Warehouse(LocalFolder(tmp_path)), campaign(), late, executor)
    before = Warehouse(LocalFolder(tmp_path)).logs.snapshot()
    with pytest.raises(RefusedError, match="was changed"):
        run(tmp_path, campaign(seed=77), no_progress)
    after = Warehouse(LocalFolder(tmp_path)).logs.snapshot()
    assert (after.version, after.rows) == (before.version, before.rows)


def test_a_complete_day_is_never_planned_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path, campaign(), no_progress)
    before = Warehouse(LocalFolder(tmp_path)).logs.snapshot()
    monkeypatch.setattr(type(campaign()), "batches", None)
    again = run(tmp_path, campaign(), no_progress)
    assert (again.days_present, again.logs_version) == (DAYS, before.version)
    with pytest.raises(RefusedError, match="was changed"):
        run(tmp_path, campaign(seed=77), no_progress)


def test_days_that_landed_before_they_were_recorded_are_recorded(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    batches = [batch for day in campaign().days() for batch in campaign().batches(day)]
    with ThreadPoolExecutor(2) as executor:
        simulate_batches(warehouse, batches, executor)
    found = [run(tmp_path, campaign(), no_progress) for _ in range(2)]
    assert [report.rows for report in found] == [0, 0]
    assert [report.days_present for report in found] == [0, DAYS]
    assert found[0].logs_version == found[1].logs_version
