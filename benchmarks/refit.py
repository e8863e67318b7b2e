"""Times the refit of a cohort inside a running process, as a service or a notebook would do it.

    python -m benchmarks.refit ROOT CONDITION

Prints JSON: milliseconds, the median of several after one to warm up, of opening the tables,
reading the cohort's Gram rows from disk and fitting one model; of the same with the tables opened
before, as for one cohort after another; of the fit alone; and of a whole selection.
"""

import json
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.harness import durations
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.models.request import SelectionRequest, load_model_list
from fleet_slip.models.select import run_selection
from fleet_slip.regression.least_squares import fit
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.gram_reader import GramReader
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS

ROUNDS = 7
TABLE = SelectionRequest(models="table1")
MODELS = load_model_list(CATALOG, "table1")
INPUTS, FOLDS = MODELS.model[1].signals, MODELS.folds


def median_ms(function: Callable[[], Any]) -> float:
    """Return the median time of a call after the first, in ms."""
    function()
    return 1e3 * statistics.median(durations(function, ROUNDS))


def main(root: str, predicate: str) -> None:
    warehouse = Warehouse(LocalFolder(Path(root)))
    label = SIGNALS.label
    cohort = load_cohort(warehouse, predicate)

    def fitted_from_disk(source: Warehouse | GramReader) -> None:
        sums = load_cohort(source, predicate, folding=FOLDS).folds("drive", FOLDS.count)
        fit(sums.complete_cases(INPUTS, label).total, INPUTS, label)

    with GramReader(warehouse) as reader:
        again_ms = median_ms(lambda: fitted_from_disk(reader))
    figures = {
        "gram_rows": len(cohort.drives),
        "read_and_fit_ms": median_ms(lambda: fitted_from_disk(warehouse)),
        "read_again_and_fit_ms": again_ms,
        "fit_ms": median_ms(
            lambda: fit(cohort.complete_cases(INPUTS).table.total(), INPUTS, label)
        ),
        "select_ms": median_ms(lambda: run_selection(warehouse, TABLE, predicate)),
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main(*sys.argv[1:])
