"""Drift charts: the error of a published model on each day since its training.

Errors are exact, from Gram rows: with v = (coefficients, -1) the sum of squared errors of a day is
v'Gv. The chart is one of individuals, a day each: days differ more than their rows
explain (Montgomery, Introduction to Statistical Quality Control, ch. 6). The training days give
mean and standard deviation. Each is predicted by the model's signals, fitted on the other
training days: no day is predicted by a model trained on it. The limits of a new day are
mean +- t s sqrt(1 + 1/m), the prediction interval of a normal individual after m others, with
Student's t for m - 1 degrees of freedom: few days give wide limits.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from itertools import compress
from statistics import fmean, stdev

from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import AlarmError, DataError, StorageError
from fleet_slip.grams.cohort import remark_left_out, sum_days
from fleet_slip.models.registry import ModelVersion
from fleet_slip.quality.peers import thresholds
from fleet_slip.regression.folds import error_sums, least_squares
from fleet_slip.regression.gram import Gram
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.warehouse.database import Predicate, parse_cohort
from fleet_slip.warehouse.warehouse import Warehouse


@dataclass(frozen=True)
class Limits:
    """Centre line and control limits of one figure, in degrees; the lower may be missing."""

    centre: float
    lower: float | None
    upper: float

    @classmethod
    def from_values(cls, usual: Sequence[float], false_alarms: float) -> "Limits":
        """Return the two-sided prediction interval of one more individual."""
        from scipy.special import stdtrit  # noqa: PLC0415 - slow

        m = len(usual)
        t = float(stdtrit(m - 1, 1 - false_alarms / 2))
        half = t * stdev(usual) * math.sqrt(1 + 1 / m)
        return cls(fmean(usual), fmean(usual) - half, fmean(usual) + half)

    @classmethod
    def above(cls, usual: Sequence[float], false_alarms: float) -> "Limits":
        """Return the upper limit of a positive figure, made on its logarithm: less is no alarm."""
        logarithms = cls.from_values([math.log(value) for value in usual], 2 * false_alarms)
        return cls(math.exp(logarithms.centre), None, math.exp(logarithms.upper))

    def beyond(self, value: float) -> bool:
        """Return True if a value is outside."""
        return value > self.upper or (self.lower is not None and value < self.lower)


@dataclass(frozen=True)
class Day:
    """Errors of one day.

    Attributes
    ----------
    training
        The day made the model; its errors are those of the model without it.
    alarms
        Figures beyond their limits, of a new day.
    """

    day: date
    drives: int
    rows: int
    error_mean_deg: float
    error_std_deg: float
    rmse_deg: float
    training: bool
    alarms: tuple[str, ...] = ()


@dataclass(frozen=True)
class Chart(Answer):
    """A control chart of a model version.

    Attributes
    ----------
    drives_left_out
        Drives of the cohort without Gram rows of the model's feature set, since
        their cars sent no log.
    remark
        That the model's filter is not charted; empty without a filter.
    """

    DOCUMENT = "model cohort days mean_limits std_limits feature_set drives_left_out remark?"

    model: str
    cohort: str
    days: tuple[Day, ...]
    mean_limits: Limits
    std_limits: Limits
    feature_set: str = PLAIN
    drives_left_out: int = 0
    remark: str = ""

    @property
    def alarms(self) -> tuple[Day, ...]:
        """The days that are beyond a limit."""
        return tuple(day for day in self.days if day.alarms)

    def parts(self) -> Iterator[Part]:
        """Return a table of the days."""
        mean, std = self.mean_limits, self.std_limits
        yield TextTable(
            f"{self.model}, drives where {self.cohort}; limits from the training days: "
            f"mean {mean.lower:+.4f} to {mean.upper:+.4f}, std up to {std.upper:.4f} deg",
            "day||drives|rows|RMSE deg|mean deg|std deg|beyond",
            ({**vars(day), "kind": "training" if day.training else "new"} for day in self.days),
            "{day}|{kind}|{drives:,}|{rows:,}|{rmse_deg:.4f}|{error_mean_deg:+.4f}|"
            "{error_std_deg:.4f}|{alarms}",
            text_columns=2,
        )
        yield from remark_left_out(self.drives_left_out, self.feature_set)
        if self.remark:
            yield Remark(self.remark)

    @property
    def alarm(self) -> str:
        """The new days beyond a limit, and the figures that exceed it."""
        return ", ".join(f"{day.day} ({' and '.join(day.alarms)})" for day in self.alarms)

    @property
    def problem(self) -> AlarmError | None:
        """Alarm of a new day that is beyond a limit."""
        text = f"the error of {self.model} is beyond its limits on {self.alarm}"
        return AlarmError(text) if self.alarms else None


def monitor(
    warehouse: Warehouse,
    version: ModelVersion,
    predicate: str | Predicate | None = None,
    since: date | None = None,
) -> Chart:
    """Chart a model's error day by day. Reads Gram rows only.

    `predicate` chooses the drives; by default those that satisfy the predicate of its training.
    Days from `since` are new; by default those after the last day of the logs it was trained on.
    Raises `DataError` for fewer training days than `min_training_days`.
    """
    catalog = warehouse.catalog
    limits, manifest = thresholds(warehouse.configs).monitor, version.manifest
    predicate = parse_cohort(catalog.signals, predicate or manifest.trained_on.cohort)
    feature_set = catalog.name_of(manifest.trained_on.feature_set)
    sums = sum_days(warehouse, manifest.signals, predicate, feature_set)
    days, grams = sums.days, sums.grams
    last = _last_training_day(warehouse, version) if since is None else None
    training = [day < since if since else last is not None and day <= last for day in days]
    if sum(training) < limits.min_training_days:
        raise DataError(
            f"Drift charts need {limits.min_training_days} training days; {version.reference} has "
            f"{sum(training)} in the cohort {predicate.quoted}. Choose another cohort, or a later "
            "--since."
        )
    champion = manifest.counts_model(catalog, feature_set)
    refit = least_squares(champion.signals, champion.label)
    total = sum(compress(grams, training), Gram.zero(grams[0].signals))
    charted: list[Day] = []
    for day, gram, drives, is_training in zip(days, grams, sums.drives, training, strict=True):
        remaining = total - gram
        remaining = remaining.about_origin() if manifest.through_origin else remaining
        model = refit(remaining) if is_training else champion
        errors = error_sums(model, gram).figures(catalog.input_scales[model.label])
        mean_deg, std_deg = errors.error_mean_deg, errors.error_std_deg
        charted.append(Day(day, drives, gram.n, mean_deg, std_deg, errors.rmse_deg, is_training))
    usual = [charted_day for charted_day in charted if charted_day.training]
    mean = Limits.from_values([d.error_mean_deg for d in usual], limits.false_alarms_per_day)
    std = Limits.above([d.error_std_deg for d in usual], limits.false_alarms_per_day)
    for i, new in enumerate(charted):
        checked = (("mean", mean, new.error_mean_deg), ("std", std, new.error_std_deg))
        alarms = tuple(name for name, bounds, value in checked if bounds.beyond(value))
        charted[i] = new if new.training else replace(new, alarms=alarms)
    return Chart(
        version.reference,
        predicate.text,
        tuple(charted),
        mean,
        std,
        feature_set,
        sums.left_out,
        manifest.line_remark,
    )


_SINCE = "fleet-slip monitor {name} --since DAY"


def _last_training_day(warehouse: Warehouse, version: ModelVersion) -> date | None:
    """Return the newest day of the logs as they were when the model was trained."""
    logs = warehouse.logs
    number = version.manifest.trained_on.logs_version
    try:
        then = logs.snapshot(number)
    except StorageError:
        raise StorageError(
            f"{logs.folder}: version {number}, which {version.reference} was trained on, is no "
            "longer in the Delta log. Give the first day of new drives: "
            f"{_SINCE.format(name=version.manifest.name)}"
        ) from None
    return max((file.day for file in then.files if file.day), default=None)
