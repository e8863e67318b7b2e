"""How often Wald's test says that two cohorts of cars differ which do not, at a nominal 5 %.

    python -m benchmarks.few_cars --draws 1000

Cars differ in their coefficients and in how much they drive. Printed beside it is what the sandwich
of residuals with the factor for few clusters (CR1) says, with F of the cars less two.
"""

import argparse

import numpy as np

from fleet_slip.regression.exact.distributions import f_upper
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.regression.inference.drive_moments import DriveMoments
from fleet_slip.regression.inference.standard_errors import cluster_covariance
from tests.support.counts import Matrix, gram_of, names, table_of
from tests.support.few_cars import compared, drives_of

COHORTS = ((8, 7, 2), (15, 15, 4), (10, 40, 4), (25, 25, 8), (50, 50, 8))
"""Cars here and there, and inputs."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=1000)
    draws = parser.parse_args().draws
    print(
        "| cars | coefficients | cars differ by | CR1 | the test |\n| --- | --- | --- | --- | --- |"
    )
    for here, there, inputs in COHORTS:
        for own in (0.0, 0.3):
            random, wrong = np.random.default_rng(0), np.zeros(2)
            for _ in range(draws):
                one, other = (drives_of(random, cars, inputs, own=own) for cars in (here, there))
                wrong += np.array([uncorrected(one, other), compared(one, other).p]) < 0.05
            plain, corrected = wrong / draws
            what = f"{here} and {there} | {inputs + 1} | {own:g}"
            print(f"| {what} | {plain:.1%} | {corrected:.1%} |", flush=True)


def uncorrected(one: list[Matrix], other: list[Matrix]) -> float:
    """Return the p of CR1."""
    inputs = names(one[0].shape[1] - 1)[:-1]
    gap, covariance = np.zeros(len(inputs) + 1), np.zeros((len(inputs) + 1,) * 2)
    for sign, each in ((1, one), (-1, other)):
        table = table_of([gram_of(part) for part in each])
        found = fit(table.total(), inputs, "y")
        coefficients = [found.model.intercept, *found.model.coefficients]
        gap += sign * np.array([float(value) for value in coefficients])
        covariance += cluster_covariance(found, DriveMoments.of(table))
    cars = len(one) + len(other)
    f = float(gap @ np.linalg.solve(covariance, gap)) / len(gap)
    return f_upper(f, len(gap), cars - 2)


if __name__ == "__main__":
    main()
