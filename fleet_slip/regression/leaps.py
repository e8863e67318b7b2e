"""Leaps and bounds: best subsets of each size without computing all (Furnival and Wilson 1974)."""

import numpy as np

from fleet_slip.arrays import FloatArray, IntArray
from fleet_slip.compiling import kernel


def best_by_leaps(matrix: FloatArray, count: int) -> list[list[int]]:
    """Return bit masks of the `count` best subsets of each size 0..k, best first; k is at most 62.

    The label is last. A branch keeps some signals for good and may drop the others one by one; it
    is left once its largest model's residuals exceed what every size in reach already has.
    """
    k = len(matrix) - 1
    best = np.full((k + 1, count), np.inf)
    masks = np.full((k + 1, count), -1, dtype=np.int64)
    inverse: FloatArray = np.linalg.inv(matrix).astype(np.float64)
    _offer(best, masks, k, 1 / inverse[-1, -1], 2**k - 1)
    _branch(inverse, np.arange(k), 0, best, masks)
    return [
        [int(line[i]) for i in np.argsort(rss, kind="stable") if line[i] >= 0]
        for rss, line in zip(best, masks, strict=True)
    ]


@kernel
def _offer(best: FloatArray, masks: IntArray, size: int, rss: float, mask: int) -> None:
    worst = np.argmax(best[size])
    if rss < best[size, worst]:
        best[size, worst] = rss
        masks[size, worst] = mask


@kernel
def _branch(
    inverse: FloatArray, present: IntArray, kept: int, best: FloatArray, masks: IntArray
) -> None:
    """Visit the models that drop signals of `present[kept:]`; `inverse` is of present and label."""
    size = len(present)
    # The dearest signal first: dropping it has the most models below, and is cut off soonest.
    losses = np.empty(size - kept)
    for i in range(kept, size):
        losses[i - kept] = inverse[i, size] ** 2 / inverse[i, i]
    order = np.arange(size + 1)
    order[kept:size] = kept + np.argsort(-losses)
    inverse = inverse[order][:, order]
    present = present[order[:size]]
    mask = np.int64(0)
    for name in present:
        mask |= np.int64(1) << name
    rss = np.empty(size)
    for i in range(kept, size):
        rss[i] = 1 / (inverse[size, size] - inverse[i, size] ** 2 / inverse[i, i])
        _offer(best, masks, size - 1, rss[i], mask ^ (np.int64(1) << present[i]))
    for i in range(kept, size - 1):
        # Models below keep present[:i] and lack at least one more: i to size - 2 signals.
        reach = False
        for reached in range(i, size - 1):
            reach = reach or rss[i] < best[reached].max()
        if reach:
            _branch(_without(inverse, i), np.delete(present, i), i, best, masks)


@kernel
def _without(inverse: FloatArray, i: int) -> FloatArray:
    """Return the inverse of the moments without signal i: a Schur complement of the inverse."""
    keep = np.delete(np.arange(len(inverse)), i)
    smaller = np.empty((len(keep), len(keep)))
    for a, row in enumerate(keep):
        factor = inverse[row, i] / inverse[i, i]
        for b, column in enumerate(keep):
            smaller[a, b] = inverse[row, column] - factor * inverse[i, column]
    return smaller
