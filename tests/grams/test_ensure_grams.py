"""`ensure_grams`: the recorded step that computes missing Gram rows before a selection."""

import logging
import shutil
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.grams.update import ensure_grams


def runs_of(fleet: Fleet, command: str) -> list[tuple[str, ...]]:
    return fleet.sql(
        f"SELECT outcome, arguments::VARCHAR FROM runs WHERE command = '{command}'"
    ).fetchall()


def state_of(root: Path) -> dict[str, tuple[int, bytes]]:
    return {
        str(path): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b"")
        for path in [root, *root.rglob("*")]
    }


@pytest.fixture
def without_windows(smoke_copy: Path) -> Fleet:
    """A root whose Gram rows are gone, except those of `signals`."""
    fleet = fleet_slip.open(smoke_copy)
    shutil.rmtree(smoke_copy / "grams")
    fleet.gram()
    return fleet


def test_select_records_the_step_that_computes_gram_rows(
    without_windows: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    fleet = without_windows
    assert not runs_of(fleet, "ensure_grams")
    with caplog.at_level(logging.INFO, logger="fleet_slip"):
        selection = fleet.cohort().select()
    assert selection.cohort.feature_set != "signals"
    [(outcome, arguments)] = runs_of(fleet, "ensure_grams")
    assert outcome == "done"
    assert f"--features={selection.cohort.feature_set}" in arguments
    [line] = [text for text in caplog.messages if "computing Gram rows" in text]
    assert selection.cohort.feature_set in line
    assert "model list" in line
    fleet.cohort().select()
    assert len(runs_of(fleet, "ensure_grams")) == 1


def test_select_on_a_read_only_root_changes_no_file(smoke_copy: Path) -> None:
    before = state_of(smoke_copy)
    folders = [smoke_copy, *(path for path in smoke_copy.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    try:
        assert fleet_slip.open(smoke_copy).cohort().select().models
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert state_of(smoke_copy) == before


def test_more_rows_than_the_limit_are_not_computed(without_windows: Fleet) -> None:
    version = without_windows.warehouse.grams.snapshot().version
    warehouse = without_windows.warehouse
    assert ensure_grams(warehouse, "windows", reason="a test needs them", max_rows=10) is None
    assert warehouse.grams.snapshot().version == version
    assert not runs_of(without_windows, "ensure_grams")
