"""Drift of a published model, on a control chart from Gram rows."""

import math
import shutil
from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import fleet_slip
from fleet_slip.errors import DataError, UsageError
from fleet_slip.grams.update import update_grams
from fleet_slip.models.publish import manifest_of, publish_challenger
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.models.request import SelectionRequest
from fleet_slip.models.select import run_selection
from fleet_slip.operations.monitor import Chart, Limits, monitor
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.cars import counts, drive
from tests.support.catalog import CATALOG
from tests.support.commands import RunCommand
from tests.support.logs import DAY, ask, land, log_rows

TRAINING_DAYS = 6


def add_days(warehouse: Warehouse, first: int, number: int, bias_rad: float = 0) -> None:
    """Land days of four drives; a bias of the label stands for cars that changed."""
    for i in range(first, first + number):
        rng = np.random.default_rng(100 + i)
        day = DAY + timedelta(days=i)
        rows = []
        for j in range(4):
            signals = drive(rng)
            signals["sideslip"] += bias_rad
            rows.append(log_rows(f"d{i}-{j}", counts(signals), day))
        land(warehouse, f"day{i}", *rows, day=day)
    update_grams(warehouse)


@pytest.fixture(scope="module")
def of_training_days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with a model of six days."""
    root = tmp_path_factory.mktemp("trained") / "data"
    warehouse = Warehouse(LocalFolder(root))
    add_days(warehouse, 0, TRAINING_DAYS)
    planned = run_selection(warehouse, SelectionRequest(models="table1"))
    publish_challenger(Registry(warehouse.root, CATALOG), manifest_of(planned, "m"), planned)
    return root


@pytest.fixture
def trained(of_training_days: Path, warehouse: Warehouse) -> tuple[Warehouse, ModelVersion]:
    shutil.copytree(of_training_days, str(warehouse.root))
    return warehouse, Registry(warehouse.root, CATALOG).resolve("m")


def new_days(chart: Chart) -> list[tuple[date, tuple[str, ...]]]:
    return [(day.day, day.alarms) for day in chart.days if not day.training]


def test_the_error_of_a_day_is_what_its_rows_say(trained: tuple[Warehouse, ModelVersion]) -> None:
    warehouse, version = trained
    add_days(warehouse, TRAINING_DAYS, 1)
    chart = monitor(warehouse, version)
    manifest = version.manifest
    estimate = " + ".join(f"{t.coefficient!r} * {t.column}" for t in manifest.terms)
    error = f"degrees({manifest.intercept!r} + {estimate} - {manifest.label.column})"
    figures = f"SELECT avg({error}), stddev_samp({error}), count(*) FROM log WHERE day = $day"
    (expected,) = ask(warehouse.root, figures, {"day": chart.days[-1].day})
    last = chart.days[-1]
    assert (last.error_mean_deg, last.error_std_deg, last.rows) == pytest.approx(expected, rel=1e-9)
    assert [day.training for day in chart.days] == [True] * TRAINING_DAYS + [False]


def test_a_training_day_is_judged_by_a_model_that_it_did_not_make(
    trained: tuple[Warehouse, ModelVersion],
) -> None:
    warehouse, version = trained
    first = monitor(warehouse, version).days[0]
    signals = ",".join(version.manifest.signals)
    plan = SelectionRequest(order=signals)
    without = run_selection(warehouse, plan, f"day > '{DAY}'")
    model = next(m for m in without.models if m.signals == version.manifest.signals)
    estimate = " + ".join(
        f"{float(b)!r} * {term.column}"
        for b, term in zip(model.model.coefficients, version.manifest.terms, strict=True)
    )
    error = f"degrees({model.model.offset!r} + {estimate} - sideslip_rad)"
    figures = f"SELECT avg({error}), stddev_samp({error}) FROM log WHERE day = $day"
    (expected,) = ask(warehouse.root, figures, {"day": DAY})
    assert (first.error_mean_deg, first.error_std_deg) == pytest.approx(expected, rel=1e-9)


def test_usual_days_raise_no_alarm_and_a_drift_does(
    trained: tuple[Warehouse, ModelVersion],
) -> None:
    warehouse, version = trained
    add_days(warehouse, TRAINING_DAYS, 2)
    assert monitor(warehouse, version).alarms == ()
    add_days(warehouse, TRAINING_DAYS + 2, 1, bias_rad=math.radians(1))
    chart = monitor(warehouse, version)
    assert [alarms for _, alarms in new_days(chart)] == [(), (), ("mean",)]
    assert chart.alarms[0].day == DAY + timedelta(days=TRAINING_DAYS + 2)


def test_days_to_learn_from_may_be_chosen_and_must_be_enough(
    trained: tuple[Warehouse, ModelVersion],
) -> None:
    warehouse, version = trained
    chart = monitor(warehouse, version, since=DAY + timedelta(days=5))
    assert [day.training for day in chart.days] == [True] * 5 + [False]
    with pytest.raises(DataError, match="has 2 in the cohort"):
        monitor(warehouse, version, since=DAY + timedelta(days=2))
    fleet = fleet_slip.open(warehouse.root)
    assert fleet.maintenance.monitor("m", since=str(DAY + timedelta(days=5))) == chart
    with pytest.raises(UsageError, match="since tomorrow: not a date; write it as 2024-05-01"):
        fleet.maintenance.monitor("m", since="tomorrow")


def test_limits_are_the_prediction_interval_of_one_more_day() -> None:
    usual = [1.0, 2.0, 4.0, 3.5]
    limits = Limits.from_values(usual, 0.01)
    t = stats.t.ppf(0.995, 3)
    half = t * np.std(usual, ddof=1) * math.sqrt(1 + 1 / 4)
    assert (limits.lower, limits.upper) == pytest.approx((2.625 - half, 2.625 + half), rel=1e-12)
    above = Limits.above(usual, 0.01)
    logarithms = np.log(usual)
    edge = stats.t.ppf(0.99, 3) * np.std(logarithms, ddof=1) * math.sqrt(1 + 1 / 4)
    assert above.upper == pytest.approx(math.exp(logarithms.mean() + edge), rel=1e-12)
    assert not above.beyond(0.001)
    assert limits.beyond(2.625 - 1.01 * half)


def test_the_command_tells_by_its_exit_code(
    run_command: RunCommand, trained: tuple[Warehouse, ModelVersion]
) -> None:
    warehouse, _ = trained
    add_days(warehouse, TRAINING_DAYS, 1)
    good = run_command("monitor", "m")
    assert good.exit_code == 0
    assert "training" in good.stdout
    add_days(warehouse, TRAINING_DAYS + 1, 1, bias_rad=math.radians(1))
    bad = run_command("monitor", "m", "--json")
    assert bad.exit_code == 10
    assert bad.json["days"][-1]["alarms"] == ["mean"]
    assert "beyond its limits on 2024-05-08 (mean)" in bad.stderr
    assert run_command("monitor", "m", "--since", "tomorrow").exit_code == 2
