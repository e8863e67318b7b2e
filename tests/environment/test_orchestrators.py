"""The night under Airflow and Dagster: by their own runners, without their servers."""

import os
import shutil
from datetime import date
from pathlib import Path

import pytest

import fleet_slip
from tests.support.commands import COMMAND, Finished, run
from tests.support.landing import Landing

SCHEDULE = Path(__file__).parents[2] / "jobs/schedule"


@pytest.fixture
def landing(tmp_path: Path, smoke_root: Path) -> Landing:
    landing = Landing(tmp_path / "landing", smoke_root)
    landing.prepare()
    landing.land("first", landing.drives(), date(2026, 10, 5))
    return landing


def environment(landing: Landing, place: Path) -> dict[str, str]:
    return {
        **os.environ,
        "FLEET_SLIP": COMMAND,
        "FLEET_SLIP_ROOT": str(place / "data"),
        "FLEET_SLIP_INBOX": str(landing.folder),
        "FLEET_SLIP_MAPPING": str(landing.mapping),
        "AIRFLOW_HOME": str(place / "airflow"),
        "AIRFLOW__CORE__LOAD_EXAMPLES": "false",
        "DAGSTER_HOME": str(place),
    }


@pytest.mark.tools("airflow")
def test_airflow_runs_the_night_and_then_tells_the_health(landing: Landing, tmp_path: Path) -> None:
    variables = environment(landing, tmp_path)
    program = shutil.which("airflow")
    assert program
    python = Path(program).resolve().with_name("python")
    dags = tmp_path / "airflow" / "dags"
    dags.mkdir(parents=True)
    shutil.copy(SCHEDULE / "airflow_nightly.py", dags)
    migration = run([program, "db", "migrate"], env=variables)
    assert migration.exit_code == 0, migration.stderr
    done = run([str(python), str(dags / "airflow_nightly.py")], env=variables)
    assert done.exit_code == 0, done.stdout + done.stderr
    assert "state=success" in done.stdout + done.stderr
    assert fleet_slip.open(tmp_path / "data").models.get("fleet").reference == "fleet@1"


def materialize(landing: Landing, place: Path, mapping: str) -> Finished:
    config = (
        "{ops: {champion: {config: {"
        f"inbox: '{landing.folder}', mapping: '{mapping}', model: fleet"
        "}}}}"
    )
    file = place / "config.yaml"
    file.write_text(config)
    words = ["dagster", "job", "execute", "-f", str(SCHEDULE / "dagster_nightly.py"), "-j", "night"]
    return run([*words, "-c", str(file)], env=environment(landing, place), cwd=place)


@pytest.mark.tools("dagster")
def test_dagster_makes_the_champion_an_asset(landing: Landing, tmp_path: Path) -> None:
    done = materialize(landing, tmp_path, str(landing.mapping))
    assert done.exit_code == 0, done.stderr
    assert "RUN_SUCCESS" in done.stderr + done.stdout
    assert fleet_slip.open(tmp_path / "data").models.get("fleet").reference == "fleet@1"


@pytest.mark.tools("dagster")
def test_dagster_fails_at_once_where_the_night_fails(landing: Landing, tmp_path: Path) -> None:
    done = materialize(landing, tmp_path, str(tmp_path / "no-such-mapping.toml"))
    assert done.exit_code != 0
    output = done.stderr + done.stdout
    assert "exit code 3" in output
    assert "STEP_UP_FOR_RETRY" not in output
