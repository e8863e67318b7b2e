"""Commands as Python methods: on a folder and on an object store, with the same bits."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.errors import DataError, QuestionError, UsageError
from tests.support.s3_server import ServerApart, forget_clients

DAY = date(2024, 5, 1)


@pytest.fixture(
    scope="module", params=["folder", pytest.param("object store", marks=pytest.mark.long)]
)
def filled(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Fleet]:
    """One day of the campaign `smoke`, made by calls."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "folder":
            yield _fill(fleet_slip.open(tmp_path_factory.mktemp("calls") / "data"))
            return
        server = ServerApart()
        for name, value in server.environment.items():
            patch.setenv(name, value)
        forget_clients()
        yield _fill(fleet_slip.open(f"{server.bucket()}/data"))
        server.stop()
        forget_clients()


def _fill(fleet: Fleet) -> Fleet:
    seen: list[tuple[int, int]] = []
    report = fleet.simulate(
        "smoke", through=DAY, workers=2, progress=lambda done, total: seen.append((done, total))
    )
    assert report.changed
    assert seen == sorted(seen)
    assert seen[-1][0] == report.rows
    assert not fleet.simulate("smoke", days=1).changed
    with ThreadPoolExecutor(2) as executor:
        assert fleet.gram(workers=executor).rows_read == report.rows
    return fleet


def test_a_notebook_does_what_the_command_line_does(filled: Fleet) -> None:
    cohort = filled.cohort("adhesion > 0.9")
    selection = cohort.select(models="table1", folds=3)
    publication = filled.models.publish("dry", selection)
    assert publication.new
    assert publication.version.manifest.trained_on.cohort == "adhesion > 0.9"
    assert not filled.models.publish("dry", selection).new
    log = filled.sql("FROM log").pl()
    angles = filled.models.get("dry").predict(log)
    error = (angles - log["sideslip_rad"]).to_numpy()
    score = filled.evaluation.score("dry")
    assert score.rows == len(error)
    assert abs(error).max() == pytest.approx(score.error_max_deg * 3.14159265 / 180, rel=1e-6)
    assert filled.maintenance.check_grams().drives == 4
    assert filled.maintenance.status().tables["logs"].rows == log.height
    assert not filled.maintenance.verify().damage
    assert not filled.maintenance.quality().findings
    assert filled.maintenance.compact(dry_run=True).vacuumed.dry_run


def test_a_call_that_changes_the_warehouse_is_in_the_history_of_runs(filled: Fleet) -> None:
    runs = filled.sql(
        "SELECT command, arguments, outcome, steps FROM runs ORDER BY started_at"
    ).pl()
    first = runs.row(0, named=True)
    assert (first["command"], first["outcome"]) == ("simulate", "done")
    assert first["arguments"] == ["smoke", "--through=2024-05-01", "--workers=2"]
    assert [step["name"] for step in first["steps"]] == ["simulate"]
    assert "check" not in set(runs["command"])


def test_only_what_the_history_may_keep_is_kept(tmp_path: Path) -> None:
    vehicle = "WVWZZZ1JZXW000001"
    fleet_ = fleet_slip.open(tmp_path / "own")
    (tmp_path / "own").mkdir()
    with pytest.raises(QuestionError):
        fleet_.maintenance.forget(vehicle=vehicle)
    history = [file for file in (tmp_path / "own/runs").iterdir() if file.suffix == ".jsonl"]
    text = "".join(file.read_text() for file in history)
    assert "forget" in text
    assert vehicle not in text


def test_running_again_selects_again_where_anything_is_new(tmp_path: Path) -> None:
    """The list and the tables: each is asked for before the champion is kept unseen."""
    fleet, short = fleet_slip.open(tmp_path / "data"), tmp_path / "short.toml"
    short.write_text('description = "One"\n[[model]]\nname = "1"\nsignals = ["ay"]\n')

    steps: list[str] = []

    def selects(**changes: Any) -> bool:
        options = {"days": 1, "models": "table1", **changes}
        report = fleet.run("smoke", progress=lambda step, *_: steps.append(step), **options)
        return report.selection is not None

    assert [selects(), selects()] == [True, False]
    assert {*steps} >= {"simulate smoke", "gram signals"}
    assert selects(name="other")
    assert not selects()
    assert selects(name="other", models=str(short))
    assert selects(days=2)


def test_a_cohort_answers_from_gram_rows(fleet: Fleet) -> None:
    cohort = fleet.cohort("speed_factor < 0.95")
    assert "speed_factor" in repr(cohort)
    diagnosis = cohort.diagnose("bent")
    assert diagnosis.fitted.model.signals == fleet.models.get("bent").manifest.signals
    assert cohort.diagnose(fleet.models.get("bent")).drives == diagnosis.drives
    ranked = cohort.select(order="ay,yaw_rate", ranking="backward", criterion="bic")
    assert ranked.choice and {*ranked.choice.order} == {"ay", "yaw_rate"}
    with pytest.raises(UsageError, match=r"unknown option of select: orders\. Options: models, "):
        cohort.select(orders="ay")
    with pytest.raises(UsageError, match="not both"):
        cohort.diagnose("bent", signals="ay")
    with pytest.raises(QuestionError, match="name a published model"):
        cohort.diagnose()
    with pytest.raises(DataError, match="no drive matches"):
        fleet.cohort("mass_kg > 1e6").select()
    with pytest.raises(QuestionError, match="no_such_column"):
        fleet.cohort("no_such_column > 1").select()


def test_a_campaign_without_such_days_is_refused(fleet: Fleet) -> None:
    for wrong in ({"days": 0}, {"days": -1}, {"through": date(1999, 1, 1)}):
        with pytest.raises(UsageError, match="smoke lasts from 2024-05-01 to 2024-05-02"):
            fleet.simulate("smoke", **wrong)


def test_measured_files_are_ingested_and_reported_in_their_order(tmp_path: Path) -> None:
    fleet = fleet_slip.open(tmp_path / "data")
    files, mapping = _measured(tmp_path)
    names: list[str] = []
    seen: list[tuple[int, int]] = []
    reports = fleet.ingest(
        files,
        mapping,
        on_report=lambda report: names.append(report.file),
        progress=lambda done, total: seen.append((done, total)),
    )
    assert [report.file for report in reports] == names == [str(file) for file in files]
    assert all(report.new for report in reports)
    assert seen[-1] == (len(files), len(files))
    (again,) = fleet.ingest(str(files[0]), mapping)
    assert not again.new
    ((arguments,),) = fleet.sql("SELECT arguments FROM runs LIMIT 1").fetchall()
    assert str(files[0]) not in arguments


def _measured(folder: Path) -> tuple[list[Path], str]:
    mapping = folder / "bench.toml"
    mapping.write_text(
        """
        name = "bench"
        [time]
        column = "t"
        unit = "s"
        [drive]
        vehicle_id = "bench-1"
        vehicle_model = "bench"
        day = 2024-05-01
        [signals.ay]
        column = "ay"
        unit = "m/s^2"
        """
    )
    files = [folder / f"{name}.csv" for name in ("b", "a")]
    for number, file in enumerate(files):
        rows = "\n".join(f"{tick / 100:.2f},{number + tick / 1000}" for tick in range(300))
        file.write_text(f"t,ay\n{rows}\n")
    return files, str(mapping)


def test_two_threads_publish_one_model(smoke_copy: Path) -> None:
    fleet = fleet_slip.open(smoke_copy)
    selection = fleet.cohort().select(models="table1")
    versions: list[object] = []
    threads = [
        threading.Thread(target=lambda: versions.append(fleet.models.publish("slip", selection)))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert len(versions) == 2
    assert fleet.models.versions("slip").num_rows == 1
