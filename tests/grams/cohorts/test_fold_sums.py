"""The sums of a cohort are those of its Gram rows, whatever the batches and the folds."""

from datetime import timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import DataError, FleetSlipError
from fleet_slip.grams.cohort import Cohort, FoldCount, Folding, FoldKey, load_cohort, sum_days
from fleet_slip.grams.update import update_grams
from fleet_slip.models.request import SelectionRequest, load_model_list
from fleet_slip.models.select import run_selection, select
from fleet_slip.regression.gram import Gram
from fleet_slip.storage.local import LocalFolder
from fleet_slip.views import VIEWS, connect, needed_views
from fleet_slip.warehouse import gram_reader
from fleet_slip.warehouse.database import parse_predicate
from fleet_slip.warehouse.gram_reader import GramReader
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.growth_history import write_fleet, write_grams
from tests.support.logs import DAY, land, log_rows, random_counts

MODELS = load_model_list(CATALOG, "table1")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Warehouse:
    """Return a warehouse of 60 drives, each of its own car, over three days."""
    warehouse = Warehouse(LocalFolder(tmp_path_factory.mktemp("fleet")))
    write_fleet(warehouse, 60)
    return warehouse


@pytest.mark.parametrize(
    ("by", "batch", "count"),
    [
        *((by, 7, 4) for by in ("drive", "vehicle", "track", "day", "mass", "adhesion", "speed")),
        ("drive", 1000, 4),
        ("vehicle", 7, "each"),
    ],
)
def test_sums_equal_those_of_the_cohort(
    fleet: Warehouse, monkeypatch: pytest.MonkeyPatch, by: FoldKey, batch: int, count: FoldCount
) -> None:
    monkeypatch.setattr(gram_reader, "BATCH_ROWS", batch)
    plan = Folding(by=by, count=count)
    cohort = load_cohort(fleet, "adhesion > 0.65")
    summed = load_cohort(fleet, "adhesion > 0.65", folding=plan)
    of_drives, of_sums = (source.folds(plan.by, plan.count) for source in (cohort, summed))
    assert of_drives.names == of_sums.names
    assert of_drives.tables == of_sums.tables
    assert (summed.rows, summed.drive_count) == (cohort.rows, cohort.drive_count)
    assert summed.inputs == cohort.inputs
    assert summed.gram_condition(["ax"]) == cohort.gram_condition(["ax"])


@pytest.mark.parametrize(
    ("period", "compared", "drives"), [(3, {"1", "2"}, {36}), (18, {"1", "2", "3", "4", "5"}, {34})]
)
def test_models_are_compared_on_the_same_drives_or_not_at_all(
    warehouse: Warehouse, period: int, compared: set[str], drives: set[int]
) -> None:
    """Every third drive lacks wheel speeds, and every 18th: less than a tenth of them."""
    rng = np.random.default_rng(1)
    rows = []
    for i in range(36):
        counts = random_counts(rng, 40)
        if i % period == 0:  # no wheel speeds in any row, or in some: then two Gram rows
            for name in [name for name in counts if name.startswith("wheel")]:
                counts[name] = pa.array(counts[name], mask=np.arange(40) >= 20 * (i % 2))
        rows.append(log_rows(f"drive-{i}", counts))
    land(warehouse, "one", *rows)
    update_grams(warehouse)
    plan = Folding(count=3)
    shared = MODELS.model_copy(update={"folds": plan})
    selection = select(load_cohort(warehouse), shared)
    summed = select(load_cohort(warehouse, folding=plan), shared)
    assert summed.as_dict() == selection.as_dict()
    assert {model.name for model in summed.models} == compared
    assert {model.drives for model in summed.models} == drives
    assert len({model.pooled.rows for model in summed.models}) == 1
    for name in {model.name for model in MODELS.model} - compared:
        assert "not comparable: 6 of 36 drives lack wheel_" in summed.skipped[name]
    complete = load_cohort(warehouse).complete_cases(summed.winner.model.signals)
    assert summed.winner.model.drives == len(complete.drives)


def test_days_add_up_to_those_of_the_drives(
    warehouse: Warehouse, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(1)
    for number in range(3):
        rows = []
        for i in range(12):
            counts = random_counts(rng, 40)
            if i % 3 == 0:  # the steering wheel in no row, or in some: then two Gram rows
                mask = np.arange(40) >= 20 * (i % 2)
                counts["steering_wheel"] = pa.array(counts["steering_wheel"], mask=mask)
            rows.append(log_rows(f"drive-{number}-{i}", counts))
        land(warehouse, str(number), *rows, day=DAY + timedelta(days=number))
    update_grams(warehouse)
    for inputs in (["ax"], ["ax", "steering_wheel"]):
        served = load_cohort(warehouse).complete_cases(inputs)
        sums = sum_days(warehouse, inputs)
        monkeypatch.setattr(gram_reader, "BATCH_ROWS", 7)
        assert sum_days(warehouse, inputs) == sums
        monkeypatch.undo()
        days = served.drives["day"].to_pylist()
        assert sums.days == tuple(sorted(set(days)))
        assert sums.drives == tuple(days.count(day) for day in sums.days)
        for day, gram in zip(sums.days, sums.grams, strict=True):
            assert (
                gram
                == served.table.take(np.array([drive_day == day for drive_day in days])).total()
            )
    with pytest.raises(DataError, match="no drive matches"):
        sum_days(warehouse, ["ax"], "mass_kg > 1e9")
    with pytest.raises(DataError, match="no drive of the cohort has all of"):
        sum_days(warehouse, ["steering_wheel"], "drive_id IN ('drive-0-0', 'drive-0-6')")


@pytest.mark.parametrize(
    "predicate",
    ["mass_kg > 1e9", "no_such_column = 1", "mass_kg >", "drive_id = 'drive-000000001'"],
)
def test_errors_are_those_of_the_cohort(fleet: Warehouse, predicate: str) -> None:
    with pytest.raises(FleetSlipError) as caught:
        load_cohort(fleet, predicate).folds("drive", 5)
    with pytest.raises(type(caught.value)) as summed:
        load_cohort(fleet, predicate, folding=Folding())
    assert str(summed.value) == str(caught.value)


def test_sums_over_other_folds_are_read_again(fleet: Warehouse) -> None:
    again = load_cohort(fleet, folding=Folding()).folds("drive", 7)
    at_once = load_cohort(fleet, folding=Folding(count=7)).folds("drive", 7)
    assert (again.names, again.tables) == (at_once.names, at_once.tables)


def test_gram_job_takes_the_made_history_for_its_own(fleet: Warehouse) -> None:
    assert not update_grams(fleet).changed


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("SELECT count(*) FROM Grams", {"grams"}),
        ('FROM "log" LIMIT 1', {"log", "log_counts"}),
        ("FROM drives", {"drives", "grams", "log_counts"}),
        ("FROM models -- and runs", {"models", "runs"}),
        ("SHOW TABLES", VIEWS),
        ("SELECT 1", set()),
        ("FROM unknown", VIEWS),
        ("FROM duckdb_columns() WHERE table_name = 'log'", VIEWS),
        ("SELECT * FROM dictionary", VIEWS),
    ],
)
def test_a_query_opens_what_it_names(query: str, expected: set[str]) -> None:
    assert needed_views(query) == expected


def test_a_query_of_gram_rows_needs_no_log_file(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    write_fleet(warehouse, 20)
    for path in warehouse.logs.snapshot().paths:
        Path(path).unlink()
    query = "SELECT count(*) FROM grams"
    with connect(tmp_path, query=query) as database:
        assert database.execute(query).fetchone() == (20,)
    assert run_selection(warehouse, SelectionRequest()).cohort.drive_count == 20


def test_a_reader_opens_anew_only_what_changed(tmp_path: Path) -> None:
    warehouse = Warehouse(LocalFolder(tmp_path))
    write_fleet(warehouse, 20)
    plan = Folding(count=3)

    def tables(cohort: Cohort) -> tuple[tuple[Gram, ...], ...]:
        return cohort.folds(plan.by, plan.count).tables

    with GramReader(warehouse) as reader:
        before = load_cohort(reader, folding=plan)
        opened = reader.opened(PLAIN, parse_predicate(SIGNALS, "true")).database
        assert load_cohort(reader, "adhesion > 0.7", folding=plan).drive_count == 14
        assert reader.opened(PLAIN, parse_predicate(SIGNALS, "true")).database is opened
        assert tables(load_cohort(reader, folding=plan)) == tables(before)
        write_grams(warehouse, [warehouse.logs.snapshot().files[0].path], 10)
        after = load_cohort(reader, folding=plan)
        assert tables(after) == tables(load_cohort(warehouse, folding=plan))
        assert after.grams_version == before.grams_version + 1
        assert after.rows > before.rows


def test_the_next_command_with_logs_is_gram_alone(warehouse: Warehouse) -> None:
    land(warehouse, "a", log_rows("a", random_counts(np.random.default_rng(1), 50)))
    with pytest.raises(DataError, match=r"no Gram rows yet\. Run: fleet-slip gram\.$"):
        load_cohort(warehouse, folding=Folding())
