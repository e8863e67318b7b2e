"""Of an answer that is wider than the terminal it is said what is left out, and how to see it."""

import os
from pathlib import Path

from tests.support.commands import Finished, run_on


def ask(root: Path, query: str, columns: int, *options: str) -> Finished:
    env = {**os.environ, "COLUMNS": str(columns), "FLEET_SLIP_LOG": "text"}
    return run_on(root, "sql", query, *options, env=env)


def test_columns_without_a_value_give_way_and_the_others_are_counted(smoke_root: Path) -> None:
    told = ask(smoke_root, "FROM log LIMIT 3", 100)
    assert told.exit_code == 0
    assert max(map(len, told.stdout.splitlines())) <= 100
    assert "gear_number" not in told.stdout
    assert "lateral_offset_m" in told.stdout
    assert "columns do not fit; without a value: " in told.stderr
    assert "gear_number" in told.stderr
    assert "SELECT …" in told.stderr
    assert "all: --all" in told.stderr


def test_what_fits_is_shown_whole_and_nothing_is_said(smoke_root: Path) -> None:
    told = ask(smoke_root, "SELECT drive_id, lost_control_s FROM drives", 100)
    assert "NULL" in told.stdout
    assert told.stderr == ""


def test_columns_of_the_same_name_are_told_apart(smoke_root: Path) -> None:
    wide = ", ".join(f"repeat('x', 30) AS column_{i}" for i in range(9))
    told = ask(smoke_root, f"SELECT NULL AS a, 1 AS a, {wide}", 60)
    assert told.exit_code == 0
    assert "without a value: a. " in told.stderr


def test_an_answer_without_rows_says_no_column_is_empty(smoke_root: Path) -> None:
    told = ask(smoke_root, "FROM log WHERE false", 100)
    assert told.exit_code == 0
    assert "without a value" not in told.stderr
