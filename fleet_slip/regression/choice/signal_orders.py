"""Rankings: the predefined order on which nested models depend (Section II-B).

All decide exactly; ties go to the declared order.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression.exact.elimination import adjugate, eliminate
from fleet_slip.regression.exact.gram import Gram
from fleet_slip.regression.exact.least_squares import dependence, moments

Matrix = list[list[int]]
Score = Callable[[list[int], int], Fraction]
Ranking = Callable[[Gram, Sequence[str], str], tuple[str, ...]]
"""Orders inputs, given a Gram with them and the label. Raises `DataError` if dependent."""


def declared(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:  # noqa: ARG001
    """Keep the declared order, as the paper does."""
    return tuple(inputs)


def correlation(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Order by the absolute correlation with the label, largest first."""
    matrix = _moments(gram, inputs, label)
    scores = [_gain(matrix[i], i) for i in range(len(inputs))]
    return _descending(inputs, scores)


def t_value(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Order by |t| in the full model, largest first: b_i^2 / (S^-1)_ii."""
    matrix, _ = _full_model(_moments(gram, inputs, label))
    return _descending(inputs, [_gain(matrix[i], i) for i in range(len(inputs))])


def forward(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Add, at each step, the signal that reduces the residual sum of squares most."""
    order = _pivot(_moments(gram, inputs, label), _gain, largest=True)
    return tuple(inputs[i] for i in order)


def backward(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Remove the signal whose loss costs least, of equals the later: Wang's and WEKA's order."""
    k = len(inputs)
    matrix = _moments(gram, inputs, label)
    later_first = [*reversed(range(k)), k]
    rows, determinant = _full_model([[matrix[i][j] for j in later_first] for i in later_first])
    removed = _pivot(rows, _gain, largest=False, divisor=determinant)
    return tuple(inputs[k - 1 - i] for i in reversed(removed))


def pivoted_cholesky(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Take the signal that those before it explain least, as a column-pivoted QR does."""
    matrix = _moments(gram, inputs, label)
    squares = [matrix[i][i] for i in range(len(inputs))]

    def remaining(row: list[int], i: int) -> Fraction:
        return Fraction(row[i], squares[i])

    return tuple(inputs[i] for i in _pivot(matrix, remaining, largest=True))


def replacement(gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Order by sequential replacement (Miller 2002, section 3.3): after each step exchange signals.

    Sets need not be nested: a signal ranks by the first size at which it appears.
    """
    order: list[str] = []
    for chosen in replacement_sets(gram, inputs, label):
        order += [name for name in inputs if name in chosen and name not in order]
    return tuple(order)


def replacement_sets(gram: Gram, inputs: Sequence[str], label: str) -> list[frozenset[str]]:
    """Return the sets of 1, ..., k signals that sequential replacement ends with."""
    matrix = _moments(gram, inputs, label)
    chosen: list[int] = []
    sets = []
    for _ in inputs:
        outside = [i for i in range(len(inputs)) if i not in chosen]
        chosen.append(min(outside, key=lambda i: (_rss(matrix, [*chosen, i]), i)))
        _exchange(matrix, chosen)
        sets.append(frozenset(inputs[i] for i in chosen))
    return sets


RANKINGS: dict[str, Ranking] = {
    "declared": declared,
    "correlation": correlation,
    "t": t_value,
    "forward": forward,
    "backward": backward,
    "replacement": replacement,
    "pivoted-cholesky": pivoted_cholesky,
}


def rank(name: str, gram: Gram, inputs: Sequence[str], label: str) -> tuple[str, ...]:
    """Order the inputs. Raises `QuestionError` for an unknown ranking, `DataError` if dependent."""
    if name not in RANKINGS:
        raise QuestionError(f"unknown ranking {name!r}. Known rankings: {', '.join(RANKINGS)}.")
    return RANKINGS[name](gram, inputs, label)


def _moments(gram: Gram, inputs: Sequence[str], label: str) -> Matrix:
    matrix = moments(gram.restrict([*inputs, label]))
    if eliminate(matrix).singular is not None:
        raise DataError(dependence(gram, inputs))
    return matrix


def _full_model(matrix: Matrix) -> tuple[Matrix, int]:
    """Return the rows (adj N, d b) of the full model and its determinant d (Jacobi's identity)."""
    inverse, determinant = adjugate([row[:-1] for row in matrix[:-1]])
    numerators = [
        sum(a * row[-1] for a, row in zip(line, matrix, strict=False)) for line in inverse
    ]
    return [[*line, b] for line, b in zip(inverse, numerators, strict=True)], determinant


def _gain(row: list[int], i: int) -> Fraction:
    return Fraction(row[-1] ** 2, row[i])


def _pivot(matrix: Matrix, score: Score, *, largest: bool, divisor: int = 1) -> list[int]:
    """Eliminate inputs by the best score, fraction-free: entries share one positive factor."""
    sign = -1 if largest else 1
    inputs = len(matrix[0]) - 1
    work = {i: matrix[i] for i in range(inputs)}
    order = []
    while work:
        scores = {i: sign * score(row, i) for i, row in work.items()}
        pivot = min(work, key=lambda i: (scores[i], i))
        pivot_row = work.pop(pivot)
        d = pivot_row[pivot]
        for i, row in work.items():
            f = row[pivot]
            work[i] = [(x * d - f * y) // divisor for x, y in zip(row, pivot_row, strict=True)]
        divisor = d
        order.append(pivot)
    return order


def _descending(inputs: Sequence[str], scores: Sequence[Fraction]) -> tuple[str, ...]:
    order = sorted(range(len(inputs)), key=lambda i: (-scores[i], i))
    return tuple(inputs[i] for i in order)


def _rss(matrix: Matrix, chosen: Sequence[int]) -> Fraction:
    at = [*chosen, len(matrix) - 1]
    return eliminate([[matrix[i][j] for j in at] for i in at]).residual(len(chosen))


def _exchange(matrix: Matrix, chosen: list[int]) -> None:
    """Exchange chosen inputs, in place, until no exchange lowers the residual sum of squares."""
    best = _rss(matrix, chosen)
    improved = True
    while improved:
        improved = False
        for position in range(len(chosen)):
            for i in range(len(matrix) - 1):
                trial = [*chosen[:position], i, *chosen[position + 1 :]]
                if i not in chosen and (rss := _rss(matrix, trial)) < best:
                    chosen[:], best, improved = trial, rss, True
