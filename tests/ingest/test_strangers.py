"""Drafts for logs with names and units that departments publish: what is not known is asked."""

from pathlib import Path

import pytest

from tests.support.strangers import score, strangers

LOGS = strangers()
LESS_THAN_ALL = {"carsim": 4, "grapro": 0}
"""Lines that are right, or ask for the unit, of the logs of which not all are."""


@pytest.mark.parametrize("log", LOGS)
def test_no_line_of_a_draft_is_wrong(tmp_path: Path, log: str) -> None:
    columns = LOGS[log]
    found = score(columns, tmp_path)
    signals = sum(bool(column.signal) for column in columns)
    assert (found["wrong"], found["extra"]) == (0, 0)
    assert found["right"] + found["asked"] >= LESS_THAN_ALL.get(log, signals)


def test_half_of_the_logs_judge_and_each_names_its_source() -> None:
    halves = [columns[0].half for columns in LOGS.values()]
    assert abs(halves.count("build") - halves.count("judge")) <= 1
    for columns in LOGS.values():
        assert len({(column.half, column.layout) for column in columns}) == 1
        assert all(column.source and column.licence for column in columns)
