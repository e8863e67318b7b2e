"""The rule of a minimum cohort: no answer of fewer cars; and masks that cancel in exact sums."""

import re
import shutil
from datetime import date
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.errors import CohortError, ConfigError, QuestionError
from fleet_slip.monitoring.plausibility import Fault
from fleet_slip.monitoring.quality import QualityReport, SensorFault
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.selection.influence import without_vehicles
from fleet_slip.warehouse.condition import parse_condition
from fleet_slip.warehouse.minimum_cohort import MINIMUM_VARIABLE
from tests.support.messages import START_S, gram_of, message_of


@pytest.fixture
def fleet(tmp_path: Path) -> fleet_slip.Fleet:
    """Five cars of all signals and two of few, on two days each."""
    fleet = fleet_slip.open(tmp_path / "data")
    grams = [
        gram_of(i) if i < 5 else gram_of(i).restrict(gram_of(i).signals[-5:]) for i in range(7)
    ]
    messages = [
        message_of(gram, f"VIN{i}", START_S + 86_400 * day)
        for i, gram in enumerate(grams)
        for day in range(2)
    ]
    (tmp_path / "m").write_bytes(b"".join(messages))
    fleet.receive(tmp_path / "m")
    return fleet


FULL = "vehicle_id < 'VIN5'"


def test_an_answer_of_fewer_cars_is_refused(
    fleet: fleet_slip.Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = fleet.cohort("vehicle_id < 'VIN2'")
    assert few.select(model="ax,ay").cohort.drive_count == 4
    monkeypatch.setenv(MINIMUM_VARIABLE, "5")
    for ask in (
        lambda: few.select(model="ax,ay"),
        lambda: few.select(nested="ax,ay", rank="backward"),
        lambda: few.diagnose(signals="ax,ay"),
    ):
        with pytest.raises(CohortError, match="fewer than 5 cars"):
            ask()
    assert fleet.cohort(FULL).select(model="ax,ay").cohort.drive_count == 10
    everybody = fleet.cohort().select(model="ax,ay").as_dict()
    assert everybody["signal_sets_untold"] == 1  # two cars have other signals
    full = fleet.cohort(FULL).select(model="ax,ay").as_dict()
    assert everybody["models"][0]["rmse_deg"] == full["models"][0]["rmse_deg"]
    assert (everybody["drives"], everybody["rows"]) == (full["drives"], full["rows"]) == (10, 5000)
    ranked = fleet.cohort().select(nested="ax,ay", rank="backward")
    assert (ranked.cohort.drive_count, ranked.cohort.untold) == (10, 1)
    monkeypatch.setenv(MINIMUM_VARIABLE, "6")
    with pytest.raises(CohortError, match="fewer than 6 cars"):
        fleet.cohort(FULL).select(model="ax,ay")
    assert CohortError.exit_code == 14


def test_a_day_of_fewer_cars_is_not_monitored(
    fleet: fleet_slip.Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet.publish("cars", fleet.cohort(FULL).select(model="ax,ay"), force=True)
    monkeypatch.setenv(MINIMUM_VARIABLE, "6")
    with pytest.raises(CohortError, match="on 2024-05-01"):
        fleet.monitor("cars")


def test_folds_of_single_cars_are_not_told(
    fleet: fleet_slip.Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked() -> list[dict[str, Any]]:
        compared = fleet.cohort(FULL).select(model="ax,ay", by="vehicle", folds="each")
        ranked = fleet.cohort(FULL).select(nested="ax,ay", rank="backward", by="vehicle")
        return [compared.as_dict(), ranked.as_dict()]

    assert all("VIN" in str(one) for one in asked())
    monkeypatch.setenv(MINIMUM_VARIABLE, "5")
    for one in asked():
        assert not re.search(r"VIN\d", str(one).replace(FULL, "")), one
    pooled = [asked()[0]["models"][0][name] for name in ("rmse_deg", "correlation")]
    monkeypatch.delenv(MINIMUM_VARIABLE)
    full = fleet.cohort(FULL).select(model="ax,ay", by="vehicle", folds="each").as_dict()
    assert [full["models"][0][name] for name in ("rmse_deg", "correlation")] == pooled


def test_one_odd_message_is_in_nobodys_way(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "odd").write_bytes(message_of(gram_of(1).restrict(["sideslip"]), "VIN9", START_S))
    fleet.receive(tmp_path / "odd")
    monkeypatch.setenv(MINIMUM_VARIABLE, "5")
    fleet.publish("cars", fleet.cohort().select(model="ax,ay"), force=True)
    trained = fleet.model("cars").manifest.trained_on
    assert (trained.drives, trained.vehicles) == (10, 5)
    assert fleet.quality().as_dict()["findings"] == []
    assert fleet.cohort().diagnose("cars").drives == 10


def test_a_day_of_few_cars_is_left_out_of_the_chart(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cars_of_day = {2: 5, 3: 5, 4: 4, 5: 5}
    late = [
        message_of(gram_of(10 * day + i), f"VIN{i}", START_S + 86_400 * day)
        for day, cars in cars_of_day.items()
        for i in range(cars)
    ]
    (tmp_path / "late").write_bytes(b"".join(late))
    fleet.receive(tmp_path / "late")
    fleet.publish("cars", fleet.cohort(FULL).select(model="ax,ay"), force=True)
    since = date(2024, 5, 6)
    assert [one.drives for one in fleet.monitor("cars", since=since).days] == [5, 5, 5, 5, 4, 5]
    monkeypatch.setenv(MINIMUM_VARIABLE, "5")
    chart = fleet.monitor("cars", since=since)
    assert [one.drives for one in chart.days] == [5, 5, 5, 5, 5]
    assert chart.days_untold == 1


def test_faults_are_told_without_the_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    faults = [
        SensorFault(f"drive{i}", f"VIN{i}", date(2024, 5, 1), Fault("biased", ("ay",), f"{i} m/s2"))
        for i in range(2)
    ]
    report = QualityReport(9, 9, tuple(faults), {})
    assert len(report.as_dict()["findings"]) == 2
    monkeypatch.setenv(MINIMUM_VARIABLE, "5")
    found = report.as_dict()["findings"]
    assert found == [{"kind": "biased", "signals": ["ay"], "drives": 2}]


@pytest.mark.parametrize(
    "query",
    [
        "FROM drives",
        "SELECT count(*) FROM grams",
        'SELECT 1 FROM "log"',
        "FROM (SELECT * FROM LOG_COUNTS)",
        "FROM quarantine",
        "FROM calibration",
    ],
)
def test_sql_tells_of_no_single_car(
    fleet: fleet_slip.Fleet, monkeypatch: pytest.MonkeyPatch, query: str
) -> None:
    monkeypatch.setenv(MINIMUM_VARIABLE, "2")
    with pytest.raises(CohortError, match="single cars"):
        fleet.sql(query)
    with pytest.raises(CohortError, match="single cars"):
        fleet.unlocked_session(query)
    assert fleet.sql("SELECT count(*) FROM models").fetchall() == [(0,)]


def test_no_file_of_the_warehouse_is_open_to_sql(
    fleet: fleet_slip.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (stored,) = (tmp_path / "data" / "grams").glob("*.parquet")
    file = shutil.copy(stored, tmp_path / "copy.parquet")
    monkeypatch.setenv(MINIMUM_VARIABLE, "2")
    for query in (f"FROM '{file}'", f"FROM read_parquet('{file}')", f"FROM '{stored}'"):
        with pytest.raises((CohortError, QuestionError)):
            fleet.sql(query).fetchall()


@pytest.mark.parametrize("value", ["", "1", "0", "-3", "five", "²", "2.5"])
def test_a_wrong_number_does_not_switch_the_rule_off(
    fleet: fleet_slip.Fleet, monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    monkeypatch.setenv(MINIMUM_VARIABLE, value)
    with pytest.raises(ConfigError, match="at least 2"):
        fleet.cohort().select(model="ax,ay")


def test_masks_of_pairs_of_cars_cancel_exactly_in_sums_of_gram_rows() -> None:
    """Bonawitz et al. (2017), without their treatment of cars that drop out."""
    grams = [gram_of(seed) for seed in range(6)]
    rows = [np.array([g.n, *g.sums, *g.products], np.int64).view(np.uint64) for g in grams]
    masked = [row.copy() for row in rows]
    for one, other in combinations(range(len(rows)), 2):
        mask = np.random.default_rng([one, other]).integers(
            0, 2**64, len(rows[0]), dtype=np.uint64, endpoint=False
        )
        masked[one] += mask  # modulo 2^64
        masked[other] -= mask
    total: list[int] = sum(masked[1:], masked[0]).view(np.int64).tolist()
    k = len(grams[0].signals)
    expected = sum(grams[1:], grams[0])
    assert (
        Gram(grams[0].signals, total[0], tuple(total[1 : k + 1]), tuple(total[k + 1 :])) == expected
    )
    for row, hidden in zip(rows, masked, strict=True):
        assert not (row == hidden).any()
    five = np.sum(masked[1:], axis=0, dtype=np.uint64)
    assert (five != np.sum(rows[1:], axis=0, dtype=np.uint64)).all()


def test_cars_that_are_left_out_stand_in_a_version_by_their_hashes(
    fleet: fleet_slip.Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    everybody = parse_condition(FULL)
    for least in (None, "3"):
        if least:
            monkeypatch.setenv(MINIMUM_VARIABLE, least)
        others = without_vehicles(everybody, ["VIN3", "it's"]).text
        assert ("VIN3" in others) == (least is None)
        assert fleet.cohort(others).select(model="ax,ay").cohort.drive_count == 8
