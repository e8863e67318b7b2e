"""Metrics, as the parsers of Prometheus and OpenMetrics read them."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families as parse_prometheus

from fleet_slip.operations.status import (
    ChampionStatus,
    TableStatus,
    WarehouseStatus,
    as_openmetrics,
)
from tests.support.commands import done_on, run_on

MOMENT = datetime(2026, 10, 5, 2, 30, tzinfo=UTC)
HOSTILE = 'a "root"\\with\nlines'
STATUS = WarehouseStatus(
    root=HOSTILE,
    checked_at=MOMENT,
    newest_day=date(2026, 10, 4),
    data_age_hours=1.5,
    tables={
        "logs": TableStatus(7, MOMENT, 3, 1_000_000, 9_500_000),
        "quarantine": TableStatus(None, None, 0, 0, 0),
    },
    backlog_files=1,
    backlog_rows=70,
    disk_free_bytes=None,
    disk_free_fraction=None,
    last_runs=(
        {"command": "nightly", "started_at": MOMENT, "state": "failed", "seconds": 12.5}
        | {"exit_code": 4},
        {"command": "gram", "started_at": MOMENT, "state": "running", "seconds": None}
        | {"exit_code": None},
    ),
    champions=(ChampionStatus("fleet", 8, MOMENT, 2.0, 1, 2),),
    problems=("nightly failed",),
)
Parse = Callable[[str], Any]


def samples(text: str, parse: Parse) -> dict[tuple[str, ...], float]:
    """Return each value by its name and its labels, without the root's."""
    found = {}
    for family in parse(text):
        assert family.type == "gauge"
        assert family.documentation
        for one in family.samples:
            assert one.timestamp is None  # which the textfile collector refuses
            labels = [text for name, text in one.labels.items() if name != "root"]
            found[(one.name.removeprefix("fleet_slip_"), *labels)] = one.value
    return found


@pytest.mark.parametrize("parse", [parse_openmetrics, parse_prometheus])
def test_every_figure_is_read_as_it_is(parse: Parse) -> None:
    text = as_openmetrics(STATUS)
    found = samples(text, parse)
    assert found["data_age_seconds",] == 5400
    assert found["status_timestamp_seconds",] == MOMENT.timestamp()
    assert found["newest_day_timestamp_seconds",] == datetime(2026, 10, 4, tzinfo=UTC).timestamp()
    assert found["table_rows", "logs"] == 1_000_000
    assert found["table_size_bytes", "logs"] == 9_500_000
    assert found["run_exit_code", "nightly"] == 4
    assert found["run_state", "nightly", "failed"] == 1
    assert found["run_state", "nightly", "done"] == 0
    assert found["run_state", "gram", "running"] == 1
    assert found["champion_version", "fleet"] == 8
    assert found["problems",] == 1
    roots = {one.labels["root"] for family in parse(text) for one in family.samples}
    assert roots == {HOSTILE}


def test_what_is_not_known_is_left_out() -> None:
    found = samples(as_openmetrics(STATUS), parse_openmetrics)
    unknown = {
        ("disk_free_bytes",),
        ("run_exit_code", "gram"),
        ("run_duration_seconds", "gram"),
        ("table_committed_timestamp_seconds", "quarantine"),
    }
    assert not unknown & found.keys()
    fresh = replace(STATUS, data_age_hours=None, newest_day=None, champions=(), last_runs=())
    names = {name for name, *_ in samples(as_openmetrics(fresh), parse_openmetrics)}
    assert not [name for name in names if name.startswith(("run_", "champion_", "data_age"))]


def test_the_command_prints_them_and_its_exit_code_is_that_of_status(
    smoke_root: Path, tmp_path: Path
) -> None:
    """Of a root without the commands that other tests let fail."""
    without = shutil.ignore_patterns("runs")
    root = Path(shutil.copytree(smoke_root, tmp_path / "data", ignore=without))
    done_on(root, "run", "--campaign", "smoke")
    done = run_on(root, "status", "--prometheus")
    assert done.exit_code == 0
    found = samples(done.stdout, parse_openmetrics)
    assert found["run_state", "run", "done"] == 1
    stale = run_on(root, "status", "--prometheus", "--max-age-hours", "0")
    assert stale.exit_code == 10
    assert samples(stale.stdout, parse_openmetrics)["problems",] == 1
    assert run_on(root, "status", "--prometheus", "--json").exit_code == 2
