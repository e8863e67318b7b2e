"""How long model selection takes from Gram rows, with scikit-learn on the rows beside it.

    python -m benchmarks.statistics [DRIVES]

Synthetic counts of 11 signals and a label with drive effects, 40 rows a drive; 50,000 drives are
the paper's 2 million rows. Times are the best of three on this machine, in one run.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression

from fleet_slip.regression.choice.nested_choice import (
    Rule,
    Training,
    cross_validate_selection,
    select_nested,
)
from fleet_slip.regression.choice.ranking import RANKINGS, rank
from fleet_slip.regression.choice.subsets import all_rss, best_subsets
from fleet_slip.regression.choice.winner import choose
from fleet_slip.regression.exact.gram_table import GramTable
from fleet_slip.regression.exact.least_squares import correlation_matrix, fit
from fleet_slip.regression.inference.drive_moments import DriveMoments
from fleet_slip.regression.inference.resampling import (
    bootstrap_coefficients,
    bootstrap_correlations,
    held_out_products,
    repeated_cross_validation,
)
from fleet_slip.regression.inference.standard_errors import infer_by_clusters
from fleet_slip.regression.validation.crossval import cross_validate_inputs
from fleet_slip.regression.validation.folds import CohortFolds, by_hash

INPUTS = tuple(f"x{i}" for i in range(1, 12))
LABEL = "sideslip"
ROWS_PER_DRIVE = 40
TABLE_1 = [INPUTS[:3], INPUTS[:4], INPUTS[:6], INPUTS[:8], INPUTS[:9]]
SCALES = {**{name: Fraction(1, 1000) for name in INPUTS}, LABEL: Fraction(1, 10_000)}

T = TypeVar("T")


@dataclass(frozen=True)
class Fleet:
    table: GramTable
    ids: list[str]
    rows: NDArray[np.int16]
    drive_of_row: NDArray[np.int64]


def simulate(drives: int) -> Fleet:
    rng = np.random.default_rng(1)
    k = len(INPUTS)
    mix = rng.normal(size=(k, k)) / 3 + np.eye(k)
    shape = (drives, ROWS_PER_DRIVE, k)
    x = (rng.normal(size=shape) @ mix + rng.normal(size=(drives, 1, k))) * 800
    y = x @ rng.normal(size=k) * 0.3 + rng.normal(size=(drives, 1)) * 150
    y = y[..., None] + rng.normal(size=(drives, ROWS_PER_DRIVE, 1)) * 200
    counts = np.rint(np.concatenate([x, y], axis=2)).clip(-32767, 32767)
    row, column = np.tril_indices(k + 1)
    products = np.einsum("drk,drl->dkl", counts, counts)[:, row, column]
    table = GramTable(
        (*INPUTS, LABEL),
        np.full(drives, ROWS_PER_DRIVE),
        counts.sum(axis=1).astype(np.int64),
        products.astype(np.int64),
    )
    rows = counts.reshape(-1, k + 1).astype(np.int16)
    ids = [f"drive-{i:06d}" for i in range(drives)]
    return Fleet(table, ids, rows, np.repeat(np.arange(drives), ROWS_PER_DRIVE))


def timed(name: str, work: Callable[[], T], repeats: int = 3) -> tuple[T, float]:
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        result = work()
        best = min(best, time.perf_counter() - start)
    print(f"{name:<58} {best * 1000:10.2f} ms", flush=True)
    return result, best


def refit(fleet: Fleet) -> None:
    cohort = np.arange(len(fleet.ids)) % 10 != 0
    timed("cohort refit: total of 90 % of the drives, exact solve", lambda: fit(
        fleet.table.total(cohort), INPUTS, LABEL
    ))  # fmt: skip


def table_1(fleet: Fleet) -> float:
    def work() -> str:
        cohort = CohortFolds.of([fleet.table], by_hash(fleet.ids, 5))
        models = [
            cross_validate_inputs(f"model {i}", cohort, inputs, LABEL, SCALES)
            for i, inputs in enumerate(TABLE_1, start=1)
        ]
        return choose(models).model.name

    return timed("Table I: 5 models, 5 folds, winner", work)[1]


def whole_selection(fleet: Fleet) -> None:
    rule = Rule("backward", "bic")

    def work() -> None:
        assignment = by_hash(fleet.ids, 5)
        folds = CohortFolds.of([fleet.table], assignment).serving(INPUTS, LABEL)
        drives = DriveMoments.of(fleet.table)
        training = Training(folds, drives, SCALES)
        for ranking in RANKINGS:
            rank(ranking, folds.total, INPUTS, LABEL)
        chosen = select_nested(training, INPUTS, LABEL, rule)
        cross_validate_selection("rule", training, assignment.fold, INPUTS, LABEL, rule)
        best_subsets(folds.total, INPUTS, LABEL)
        infer_by_clusters(chosen.fit, drives, SCALES)
        models = [fit(folds.total - f, chosen.fit.model.signals, LABEL).model for f in folds.grams]
        products = held_out_products(drives, assignment.fold, models)
        bootstrap_correlations(products, 1000, seed=1)

    timed("8 rankings, nested, nested CV, subsets, 1,000 bootstraps", work)


def parts(fleet: Fleet) -> None:
    total = fleet.table.total()
    assignment = by_hash(fleet.ids, 5)
    folds = CohortFolds.of([fleet.table], assignment).serving(INPUTS, LABEL)
    drives, _ = timed("  per-drive moments", lambda: DriveMoments.of(fleet.table))
    training = Training(folds, drives, SCALES)
    for ranking in RANKINGS:
        timed(f"  ranking {ranking}", lambda r=ranking: rank(r, total, INPUTS, LABEL))  # type: ignore[misc]
    timed("  nested by drives", lambda: select_nested(training, INPUTS, LABEL, Rule("t", "bic")))
    nine = correlation_matrix(total.restrict([*INPUTS[:9], LABEL]))
    timed("  512 subsets of nine signals", lambda: all_rss(nine), repeats=20)
    timed("  best of every size of 11, exact", lambda: best_subsets(total, INPUTS, LABEL))
    models = [fit(folds.total - f, INPUTS, LABEL).model for f in folds.grams]
    products = held_out_products(drives, assignment.fold, models)
    timed(
        "  1,000 bootstraps of the correlation", lambda: bootstrap_correlations(products, 1000, 1)
    )
    timed("  1,000 bootstraps, refitted", lambda: bootstrap_coefficients(drives, 1000, 1))
    timed("  5-fold repeated 100 times", lambda: repeated_cross_validation(drives, 5, 100, 1))


def peer(fleet: Fleet) -> float:
    fold = by_hash(fleet.ids, 5).fold[fleet.drive_of_row]

    def work() -> list[float]:
        correlations = []
        for inputs in TABLE_1:
            x = fleet.rows[:, : len(inputs)].astype(np.float64)
            y = fleet.rows[:, -1].astype(np.float64)
            predicted = np.empty(len(y))
            for number in range(5):
                test = fold == number
                model = LinearRegression(tol=0).fit(x[~test], y[~test])
                predicted[test] = model.predict(x[test])
            correlations.append(float(np.corrcoef(predicted, y)[0, 1]))
        return correlations

    return timed("scikit-learn on the rows in memory: Table I", work, repeats=1)[1]


def main() -> None:
    drives = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000
    fleet = simulate(drives)
    print(f"{drives} drives, {len(fleet.rows)} rows, {len(INPUTS)} inputs")
    refit(fleet)
    grams = table_1(fleet)
    whole_selection(fleet)
    parts(fleet)
    rows = peer(fleet)
    print(f"Table I from Grams is {rows / grams:.0f} times as fast as from rows")


if __name__ == "__main__":
    main()
