"""Times exact fits by the number of columns, as ratios to float64 fits of the same sums.

    python -m benchmarks.exact_columns [COLUMNS ...]

Prints JSON: for each number of columns the time of one fit, of a cross-validation over ten folds
and of all nested models, each over that of one `numpy.linalg.solve`. The latter two are left out
beyond `MAX_VALIDATED` and `MAX_NESTED` columns.
"""

import json
import sys
import time
from collections.abc import Callable
from fractions import Fraction

import numpy as np

from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.folds import Folds, cross_validate, least_squares
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import fit

COLUMNS = (24, 60, 120, 200, 400)
MAX_VALIDATED, MAX_NESTED = 120, 60
FOLDS, ROWS = 10, 1000


def seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def draw_folds(columns: int) -> tuple[Folds, list[str]]:
    """Return ten folds of correlated columns of 16 bits, the label last, and the inputs."""
    rng = np.random.default_rng(columns)
    names = [f"x{i}" for i in range(columns)]
    grams = []
    for _ in range(FOLDS):
        counts = rng.integers(-8000, 8000, (ROWS, columns + 1))
        counts += rng.integers(-24000, 24000, (ROWS, 1))
        grams.append(Gram.from_counts((*names, "y"), counts))
    return Folds(tuple(grams), tuple(map(str, range(FOLDS))), FOLDS), names


def ratios(columns: int) -> dict[str, float]:
    folds, names = draw_folds(columns)
    total = folds.total
    matrix = np.array(total.centered_products(), dtype=np.float64)
    unit = min(
        seconds(lambda: np.linalg.solve(matrix[:-1, :-1], matrix[:-1, -1])) for _ in range(9)
    )
    scales = dict.fromkeys((*names, "y"), Fraction(1))
    results = {"solve_float_ms": 1e3 * unit, "fit": seconds(lambda: fit(total, names, "y")) / unit}
    if columns <= MAX_VALIDATED:
        procedure = least_squares(names, "y")
        validation = seconds(lambda: cross_validate("all", folds, procedure, scales))
        results["cross_validate"] = validation / unit
    if columns <= MAX_NESTED:
        results["nested"] = seconds(lambda: nested_fits(total, names, "y")) / unit
    return {name: float(f"{value:.3g}") for name, value in results.items()}


def main(columns: tuple[int, ...]) -> None:
    ratios(8)  # imports and caches
    for number in columns:
        print(json.dumps({"columns": number, **ratios(number)}), flush=True)


if __name__ == "__main__":
    main(tuple(map(int, sys.argv[1:])) or COLUMNS)
