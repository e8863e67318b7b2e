"""Cohorts of few cars, which differ in their coefficients and in how much they drive."""

from collections.abc import Sequence

import numpy as np

from fleet_slip.regression.drives import DriveMoments
from fleet_slip.regression.inference import FTest, wald_test
from fleet_slip.regression.least_squares import fit
from tests.support.counts import Matrix, gram_of, names, table_of


def drives_of(
    random: np.random.Generator, clusters: int, inputs: int, *, rows: float = 30, own: float = 0.3
) -> list[Matrix]:
    """Draw the rows of unequal clusters, whose coefficients differ by `own`."""
    found = []
    for _ in range(clusters):
        many = int(rows * np.exp(0.6 * random.normal())) + inputs + 2
        x = random.normal(size=(many, inputs)) * np.exp(0.3 * random.normal(size=inputs))
        x += 0.3 * random.normal(size=inputs)
        b = 1 + own * random.normal(size=inputs)
        y = x @ b + own * random.normal() + random.normal(size=many)
        found.append(np.rint(1000 * np.column_stack([x, y])).astype(np.int64))
    return found


def compared(
    one: Sequence[Matrix],
    other: Sequence[Matrix],
    numbers: tuple[Sequence[int], Sequence[int]] | None = None,
) -> FTest:
    """Compare two cohorts; `numbers` are of the cars of each, where there are cars."""
    fits = []
    for i, each in enumerate((one, other)):
        cars = None if numbers is None else np.array(numbers[i], dtype=np.int64)
        table = table_of([gram_of(part) for part in each])
        inputs = names(each[0].shape[1] - 1)[:-1]
        drives = DriveMoments.of(table, cars, "drive" if cars is None else "vehicle")
        fits.append((fit(table.total(), inputs, "y"), drives))
    return wald_test(*fits[0], *fits[1])
