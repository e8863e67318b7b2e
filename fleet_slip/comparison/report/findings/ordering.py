"""What the order of the variables is worth (paper, section II.B), from one Gram.

For every size: how much the nested model of an order explains, and how much the best of all
subsets of that size.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.regression.choice.nested import nested_fits
from fleet_slip.regression.choice.signal_orders import RANKINGS, rank
from fleet_slip.regression.choice.subsets import best_subsets

CLOSE = 0.001
"""A model explains nearly all if it leaves no more than this of the variance to the full one."""


@dataclass(frozen=True)
class Ordering:
    """How many signals each order needs to explain nearly as much as all of them.

    Attributes:
        signals: all of them.
        needed: by ranking algorithm.
        best: by the best subset.
        subsets: number of subsets that were compared.
    """

    signals: tuple[str, ...]
    needed: dict[str, int]
    best: int
    subsets: int


def compare_orders(cohort: Cohort, signals: Sequence[str]) -> Ordering:
    """Rank the signals in every way, and compare with all subsets.

    Raises `DataError` if no drive of the cohort has them all.
    """
    label = catalogue().label
    total = cohort.serving(signals).table.total()
    best = best_subsets(total, signals, label, count=1)
    enough = best[-1].best.r_squared - CLOSE
    needed = {}
    for ranking in RANKINGS:
        fits = nested_fits(total, rank(ranking, total, signals, label), label)
        needed[ranking] = next(fit.size for fit in fits if fit.r_squared >= enough)
    return Ordering(
        signals=tuple(signals),
        needed=needed,
        best=next(size.best.size for size in best if size.best.r_squared >= enough),
        subsets=2 ** len(signals),
    )
