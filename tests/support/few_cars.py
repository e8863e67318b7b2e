"""Cohorts of few cars, which differ in their coefficients and in how much they drive."""

from collections.abc import Sequence

import numpy as np

from tests.support.counts import Matrix


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


def by_rows(clusters: Sequence[Matrix], *, intercept: bool = True) -> tuple[Matrix, Matrix]:
    """CR2 errors and Satterthwaite's degrees of freedom from n x n matrices.

    Bell and McCaffrey (2002), and equation (11) of Imbens and Kolesar (2016).
    """
    rows = np.concatenate(clusters).astype(float)
    x, y = rows[:, :-1], rows[:, -1]
    if intercept:
        x = np.column_stack([np.ones(len(rows)), x])
    unit = np.sqrt((x**2).mean(axis=0))
    x = x / unit
    bread = np.linalg.inv(x.T @ x)
    left = np.eye(len(x)) - x @ bread @ x.T
    of = np.repeat(np.arange(len(clusters)), [len(part) for part in clusters])
    moves = []
    for number in range(len(clusters)):
        mine = of == number
        values, vectors = np.linalg.eigh(left[np.ix_(mine, mine)])
        moves.append(bread @ x[mine].T @ (vectors / np.sqrt(values)) @ vectors.T @ left[mine])
    each = np.array(moves)  # (clusters, coefficients, rows): what is squared, of the label
    errors = np.sqrt(((each @ y) ** 2).sum(axis=0)) / unit
    covariances = np.einsum("gjn,hjn->jgh", each, each)
    traces = np.einsum("jgg->j", covariances)
    return errors, traces**2 / (covariances**2).sum(axis=(1, 2))
