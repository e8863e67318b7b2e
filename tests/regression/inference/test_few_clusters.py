"""The test for few clusters is what its definition says of the rows, and holds its level."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy import linalg, stats

from fleet_slip.errors import DataError
from tests.support.counts import Matrix
from tests.support.few_cars import compared, drives_of


def by_rows(
    one: Sequence[Matrix], other: Sequence[Matrix], numbers: tuple[Sequence[int], Sequence[int]]
) -> tuple[float, float]:
    """F and its degrees of freedom from n x n matrices: section 3 of Pustejovsky and Tipton."""
    blocks, noise, gaps, clusters = [], [], [], []
    for i, parts in enumerate((one, other)):
        rows = np.concatenate(parts).astype(float)
        x, y = np.column_stack([np.ones(len(rows)), rows[:, :-1]]), rows[:, -1]
        b = np.linalg.lstsq(x, y, rcond=None)[0]
        residual = y - x @ b
        noise.append(np.full(len(rows), residual @ residual / (len(rows) - x.shape[1])))
        blocks.append((x, residual))
        gaps.append(b)
        clusters.append(np.repeat(numbers[i], [len(part) for part in parts]))
    x = linalg.block_diag(*(block[0] for block in blocks))
    residual = np.concatenate([block[1] for block in blocks])
    q = x.shape[1] // 2
    contrast = np.hstack([np.eye(q), -np.eye(q)])
    bread = np.linalg.inv(x.T @ x)
    hat, phi = x @ bread @ x.T, np.diag(np.concatenate(noise))
    of = np.concatenate(clusters)
    remaining = np.eye(len(x)) - hat
    covariance = np.zeros((q, q))
    moves = []
    for car in np.unique(of):
        mine = of == car
        values, vectors = np.linalg.eigh(remaining[np.ix_(mine, mine)])
        root = (vectors / np.sqrt(values)) @ vectors.T
        half = contrast @ bread @ x[mine].T @ root
        moved = half @ residual[mine]
        covariance += np.outer(moved, moved)
        moves.append(half @ remaining[mine])
    expected = contrast @ bread @ x.T @ phi @ x @ bread @ contrast.T
    whiten = np.linalg.inv(linalg.sqrtm(expected).real)
    spread = 0.0
    for g in moves:
        for h in moves:
            p = whiten @ g @ phi @ h.T @ whiten
            spread += np.trace(p) ** 2 + np.trace(p @ p)
    eta = q * (q + 1) / spread
    gap = gaps[0] - gaps[1]
    square = gap @ np.linalg.solve(covariance, gap)
    return float(square * (eta - q + 1) / (eta * q)), float(eta - q + 1)


@pytest.mark.parametrize("common", [0, 3])
def test_it_is_what_the_definition_says_of_the_rows(common: int) -> None:
    """A car may be in both cohorts: then its rows of both are one cluster."""
    random = np.random.default_rng(4)
    one, other = drives_of(random, 7, 2), drives_of(random, 9, 2)
    numbers = list(range(7)), list(range(7 - common, 16 - common))
    found = compared(one, other, numbers)
    f, degrees = by_rows(one, other, numbers)
    assert found.numerator == 3
    assert (found.f, found.denominator) == pytest.approx((f, degrees), rel=1e-6)
    assert found.p == pytest.approx(stats.f.sf(f, 3, degrees), rel=1e-6)


def test_of_means_it_is_the_test_of_welch() -> None:
    """Clusters of like size and nothing but a mean: Welch's statistic of the clusters' means.

    Its degrees of freedom are those of Welch where the noise of rows is alike.
    """
    random = np.random.default_rng(1)
    cohorts = [random.integers(-900, 900, (many, 40, 1)) for many in (6, 11)]
    found = compared([*cohorts[0]], [*cohorts[1]])
    means = [rows.mean(axis=(1, 2)) for rows in cohorts]
    welch = stats.ttest_ind(*means, equal_var=False)
    assert found.f == pytest.approx(float(welch.statistic) ** 2, rel=1e-9)
    noise = [rows.var(ddof=1) / len(rows) for rows in cohorts]
    alike = sum(noise) ** 2 / sum(v**2 / (len(r) - 1) for v, r in zip(noise, cohorts, strict=True))
    assert found.denominator == pytest.approx(alike, rel=1e-9)


@pytest.mark.parametrize(("here", "there", "inputs"), [(8, 7, 2), (10, 40, 4), (25, 25, 6)])
def test_it_holds_its_level_where_few_cars_differ(here: int, there: int, inputs: int) -> None:
    """At nominal 5 %: of 100 comparisons without a difference no more than 12 say so."""
    random = np.random.default_rng(0)
    wrong = sum(
        compared(drives_of(random, here, inputs), drives_of(random, there, inputs)).p < 0.05
        for _ in range(100)
    )
    assert wrong <= 12


def test_a_difference_is_found() -> None:
    random = np.random.default_rng(2)
    one, other = (drives_of(random, 20, 2, own=0.1) for _ in range(2))
    for part in other:
        part[:, -1] += part[:, 0] // 2
    assert compared(one, other).p < 1e-4


def test_too_few_clusters_are_refused() -> None:
    random = np.random.default_rng(3)
    with pytest.raises(DataError, match="needs more than 4 drives in each cohort"):
        compared(drives_of(random, 4, 3), drives_of(random, 30, 3))
    one = drives_of(random, 6, 4)
    one[0] = np.concatenate([one[0]] * 200)
    with pytest.raises(DataError, match="too few to compare 5 coefficients"):
        compared(one, drives_of(random, 6, 4))
