"""Error by regime, and whether each regime should have a model of its own."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet_slip.arrays import IntArray
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.errors import DataError, QuestionError
from fleet_slip.grams.cohort import Cohort
from fleet_slip.grams.compute import UNKNOWN_PART
from fleet_slip.grams.folding import FOLD_KEYS, PARTS, ROW_FOLDS, Folding, assign_folds
from fleet_slip.regression.choice import DEFAULT_WORTH, Worth
from fleet_slip.regression.drives import require_serving_drives
from fleet_slip.regression.figures import ErrorSums, Figures
from fleet_slip.regression.folds import held_out_errors
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import LinearModel, fit

ROWS_PER_COEFFICIENT = 100
"""A regime with fewer training rows, one second of driving a coefficient, uses the pooled model."""


@dataclass(frozen=True)
class RegimeFigures:
    """Held-out figures of a regime's rows, a `share`, by the common model and any of its `own`."""

    name: str
    rows: int
    share: float
    pooled: Figures
    split: Figures
    own: bool


@dataclass(frozen=True)
class RegimeComparison:
    """One model for all regimes against one for each, cross-validated on the same folds.

    `gain` is the mean over folds of what splitting adds to the correlation; `rmse_gain` is what it
    takes from the RMSE, in rad; standard errors are over the folds.
    """

    signals: tuple[str, ...]
    drives: int
    folds: int
    regimes: tuple[RegimeFigures, ...]
    pooled: Figures
    split: Figures
    gain: float
    gain_standard_error: float
    rmse_gain: float
    rmse_gain_standard_error: float
    worth: Worth

    @property
    def split_wins(self) -> bool:
        """Whether what splitting gains is worth it, and real: it costs many coefficients."""
        best = min(self.pooled.rmse, self.split.rmse)
        square = self.pooled.rmse**2 - self.split.rmse**2
        return square >= self.worth.squared(best) and self.real

    @property
    def real(self) -> bool:
        """Whether splitting gains more than one standard error."""
        return self.rmse_gain > self.rmse_gain_standard_error

    def as_dict(self) -> dict[str, Any]:
        """Return what `regimes --json` prints."""
        return {
            "signals": list(self.signals),
            "drives": self.drives,
            "folds": self.folds,
            "pooled": self.pooled.as_dict(),
            "split": self.split.as_dict(),
            "gain": self.gain,
            "gain_standard_error": self.gain_standard_error,
            "rmse_gain_deg": math.degrees(self.rmse_gain),
            "rmse_gain_standard_error_deg": math.degrees(self.rmse_gain_standard_error),
            "worth": str(self.worth),
            "winner": "split" if self.split_wins else "pooled",
            "regimes": [
                {
                    "regime": one.name,
                    "rows": one.rows,
                    "share": one.share,
                    "own_model": one.own,
                    "pooled": one.pooled.as_dict(),
                    "split": one.split.as_dict(),
                }
                for one in self.regimes
            ],
        }


def divided_set(signals: str | None) -> str:
    """Return the first feature set that divides rows by regimes and has inputs, comma-separated.

    The first at all if none has them: who takes its rows says which inputs are unknown.
    """
    wanted = {name.strip() for name in signals.split(",")} if signals else set()
    divided = [name for name in features().sets if features().feature_set(name).regimes]
    having = [name for name in divided if wanted <= set(features().feature_set(name).columns)]
    return (having or divided)[0]


def regime_names(cohort: Cohort, over: Sequence[str]) -> list[str]:
    """Return the regime of each Gram row, by some or all of its set's. Raises `QuestionError`."""
    divided = features().feature_set(cohort.feature_set).regimes
    unknown = [name for name in over if name not in divided]
    if unknown or not divided:
        having = ", ".join(name for name, one in features().sets.items() if one.regimes)
        raise QuestionError(
            f"the feature set {cohort.feature_set} is not divided by {', '.join(unknown) or 'any'} "
            f"regime; it has {', '.join(divided) or 'none'}. Sets with regimes: {having}."
        )
    at = [divided.index(name) for name in (over or divided)]
    return [
        part if part == UNKNOWN_PART else ", ".join(part.split(", ")[i] for i in at)
        for part in cohort.drives["part"].to_pylist()
    ]


def band_order(cohort: Cohort, names: Sequence[str]) -> list[str]:
    """Return the distinct regime names in the order of their bands, unknown ones last."""
    known = features()
    rank = {
        band: i
        for regime in known.feature_set(cohort.feature_set).regimes
        for i, band in enumerate(known.regimes[regime].bands)
    }
    return sorted(set(names), key=lambda name: [rank.get(b, len(rank)) for b in name.split(", ")])


def compare_regimes(
    cohort: Cohort,
    inputs: Sequence[str],
    folding: Folding,
    over: Sequence[str] = (),
    worth: Worth = DEFAULT_WORTH,
) -> RegimeComparison:
    """Cross-validate one model for all regimes and one for each, on drives that have the inputs.

    A split is advised if its gain is worth it and above a standard error, paired over folds. Raises
    `QuestionError` without regimes, `DataError` for absent signals or empty folds.
    """
    if folding.by in (ROW_FOLDS, PARTS):
        raise QuestionError("rows are divided by regime already: fold by drive, or by vehicle.")
    names = regime_names(cohort, over)
    order = band_order(cohort, names)
    regime = np.array([order.index(name) for name in names], dtype=np.int64)
    assignment = assign_folds(
        cohort.drives[FOLD_KEYS[folding.by]].to_pylist(), folding.by, folding.count
    )
    grid = _Grid.of(cohort, inputs, regime, len(order), assignment.fold, len(assignment.names))
    pooled = [grid.fit_together(f) for f in range(grid.folds)]
    sums = {
        (r, f): grid.test(r, f, pooled[f])
        for r in range(len(order))
        for f in range(grid.folds)
        if grid.grams[r][f].n
    }
    unit = input_scales()[catalogue().label]
    found = []
    for r, name in enumerate(order):
        mine = [sums[r, f] for f in range(grid.folds) if (r, f) in sums]
        if not mine:
            continue
        one, own = _total([s[0] for s in mine]), _total([s[1] for s in mine])
        share, alone = one.n / grid.total.n, all(s[2] for s in mine)
        figures = one.figures(unit), own.figures(unit)
        found.append(RegimeFigures(name, one.n, share, *figures, alone))
    by_fold = [[s for (_, f), s in sums.items() if f == fold] for fold in range(grid.folds)]
    pooled_folds = [_total([s[0] for s in fold]) for fold in by_fold]
    split_folds = [_total([s[1] for s in fold]) for fold in by_fold]
    pairs = [
        (before.figures(unit), after.figures(unit))
        for before, after in zip(pooled_folds, split_folds, strict=True)
    ]
    gains = [after.correlation - before.correlation for before, after in pairs]
    together, apart = _total(pooled_folds).figures(unit), _total(split_folds).figures(unit)
    return RegimeComparison(
        signals=tuple(inputs),
        drives=len(cohort.serving(inputs).table),
        folds=grid.folds,
        regimes=tuple(found),
        pooled=together,
        split=apart,
        gain=math.fsum(gains) / len(gains),
        gain_standard_error=_standard_error(gains),
        rmse_gain=together.rmse - apart.rmse,
        rmse_gain_standard_error=_standard_error([a.rmse - b.rmse for a, b in pairs]),
        worth=worth,
    )


@dataclass(frozen=True)
class _Grid:
    """The Gram of each regime and fold."""

    inputs: tuple[str, ...]
    grams: tuple[tuple[Gram, ...], ...]
    total: Gram

    @property
    def folds(self) -> int:
        return len(self.grams[0])

    @classmethod
    def of(
        cls,
        cohort: Cohort,
        inputs: Sequence[str],
        regime: IntArray,
        regimes: int,
        fold: IntArray,
        folds: int,
    ) -> "_Grid":
        signals = [*inputs, catalogue().label]
        require_serving_drives(cohort.tables, signals)
        cell = regime * folds + fold
        cells = [Gram.zero(signals)] * (regimes * folds)
        stops = np.cumsum([len(table) for table in cohort.tables])[:-1]
        for table, mine in zip(cohort.tables, np.split(cell, stops), strict=True):
            if set(signals) <= set(table.signals):
                found = table.restrict(signals).totals(mine, regimes * folds)
                cells = [a + b for a, b in zip(cells, found, strict=True)]
        grams = tuple(tuple(cells[r * folds : (r + 1) * folds]) for r in range(regimes))
        return cls(tuple(inputs), grams, sum(cells[1:], cells[0]))

    def fit_together(self, fold: int) -> tuple[LinearModel, Gram]:
        """Return the model of all regimes without a fold, and the rows it was fitted on."""
        mine = [row[fold] for row in self.grams]
        training = self.total - sum(mine[1:], mine[0])
        return fit(training, self.inputs, catalogue().label).model, training

    def test(
        self, regime: int, fold: int, pooled: tuple[LinearModel, Gram]
    ) -> tuple[ErrorSums, ErrorSums, bool]:
        """Return the errors on one regime and fold by the pooled model and the regime's own."""
        test = self.grams[regime][fold]
        model, everything = pooled
        by_pooled = held_out_errors(model, everything, test)
        others = [gram for f, gram in enumerate(self.grams[regime]) if f != fold]
        training = sum(others[1:], others[0])
        if training.n < ROWS_PER_COEFFICIENT * (len(self.inputs) + 1):
            return by_pooled, by_pooled, False
        try:
            own = fit(training, self.inputs, catalogue().label).model
        except (DataError, QuestionError):
            return by_pooled, by_pooled, False
        return by_pooled, held_out_errors(own, everything, test), True


def _total(sums: Sequence[ErrorSums]) -> ErrorSums:
    return sum(sums[1:], sums[0])


def _standard_error(values: Sequence[float]) -> float:
    mean = math.fsum(values) / len(values)
    square = math.fsum((value - mean) ** 2 for value in values)
    return math.sqrt(square / (len(values) - 1) / len(values))
