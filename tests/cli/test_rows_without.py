"""Rows in which the label or a signal is missing tell nothing, and that is said."""

import numpy as np

from fleet_slip.grams.job import update_grams
from fleet_slip.warehouse.tables import Warehouse
from tests.support.cars import TICKS, counts, drive
from tests.support.commands import RunCommand
from tests.support.logs import land, log_rows


def test_rows_that_tell_nothing_are_told(run_command: RunCommand, warehouse: Warehouse) -> None:
    rng = np.random.default_rng(7)
    known = [counts(drive(rng, gentleness=2)) for _ in range(30)]
    for one in known[24:]:
        del one["sideslip"]
    land(warehouse, "all", *(log_rows(f"d{i}", one) for i, one in enumerate(known)))
    update_grams(warehouse)
    asked = ("--nested", "ay,yaw_rate")
    told = f"{6 * TICKS:,} of {30 * TICKS:,} rows skipped"
    chosen = run_command("select", *asked)
    assert told in chosen.stderr, chosen.stderr
    assert run_command("select", *asked, "--json").json["rows_without"] == 6 * TICKS
    assert run_command("publish", "beta", *asked, "--force").exit_code == 0
    cohort = ("--cohort", "true")
    assert told in run_command("score", "beta", *cohort).stderr
    assert run_command("score", "beta", *cohort, "--json").json["rows_without"] == 6 * TICKS
