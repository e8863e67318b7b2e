"""Times the choice among the windows, cross-validated with the choice redone in every fold.

    python -m benchmarks.search ROOT [--drives 100 10000] [--most 24] [--methods forward ...]

ROOT has Gram rows of the set `windows`, as `make run` leaves them. Its drives are repeated under
other names, in a copy, until there are so many: how long a search takes depends on the number of
columns, folds and Gram rows, not on what these say. Prints JSON: seconds to read the Gram rows and
add them up by fold, and then to search and fit models of 1 to `--most` columns, of the best of some
rounds.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.catalogue.features import features
from fleet_slip.delta import Change
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.cohorts.fold_sums import sum_cohort
from fleet_slip.grams.rows.gram_files import write_rows
from fleet_slip.regression.choice.stepwise import METHODS
from fleet_slip.selection.model_list import Search, load_model_list
from fleet_slip.selection.search import search_models
from fleet_slip.warehouse.tables import Warehouse

MODELS = load_model_list("estimator")
AT_ONCE = 1000


def repeat_drives(root: Path, drives: int, feature_set: str) -> Warehouse:
    """Give a root Gram rows of so many drives of a set, by repeating those that it has."""
    warehouse = Warehouse(LocalFolder(root))
    grams = warehouse.grams.snapshot()
    identity = features().identity(feature_set)
    parts = [grams.table.read(file.path) for file in grams.files]
    usual = grams.table.usual_schema  # without what few files have
    rows = pa.concat_tables(part.select(usual.names).cast(usual) for part in parts)
    known = rows.filter(pc.equal(rows["feature_set"], identity))
    at = known.schema.get_field_index("drive_id")

    def renamed(copy: int) -> pa.Table:
        names = pc.binary_join_element_wise(known["drive_id"].cast(pa.string()), str(copy), "-")
        return known.set_column(at, known.schema.field(at), names.cast(known.schema.field(at).type))

    left, copy = drives - len(known), 0
    while left > 0:
        parts = []
        while left > 0 and sum(map(len, parts)) < AT_ONCE:
            copy += 1
            parts.append(renamed(copy).slice(0, left))
            left -= len(parts[-1])
        change = Change(add=write_rows(warehouse, parts), note={"job": "gram"})
        warehouse.grams.snapshot().commit(change)
    return warehouse


def best_seconds(rounds: int, work: Callable[[], Any]) -> float:
    """Return the time of the fastest of some rounds."""
    seconds = []
    for _ in range(rounds):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return round(min(seconds), 2)


def measure(root: Path, drives: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return the times for so many drives."""
    warehouse = repeat_drives(root, drives, MODELS.features or "")

    def read() -> Any:
        return sum_cohort(warehouse, MODELS.folds, feature_set=MODELS.features or "")

    def search(method: str) -> Any:
        asked = Search.model_validate({"method": method, "most": options.most})
        return search_models(cohort, cohort.inputs, MODELS.folds, asked)

    cohort = read()
    searches = {m: best_seconds(options.rounds, partial(search, m)) for m in options.methods}
    return {
        "drives": cohort.drive_count,
        "inputs": len(cohort.inputs),
        "read_s": best_seconds(options.rounds, read),
        **{f"{method}_s": seconds for method, seconds in searches.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("--drives", type=int, nargs="+", default=(100, 10_000))
    parser.add_argument("--most", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--methods", choices=METHODS, nargs="+", default=METHODS)
    options = parser.parse_args()
    for drives in options.drives:
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder) / "data"
            shutil.copytree(options.root, root)
            print(json.dumps(measure(root, drives, options)), flush=True)


if __name__ == "__main__":
    main()
