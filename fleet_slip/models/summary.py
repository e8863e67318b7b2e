"""The result of a selection, as a document and as text."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fleet_slip.base import Record, pluralize
from fleet_slip.calibration.course_label import CourseLabelQuality
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.grams.cohort import (
    Cohort,
    DownweightedDrive,
    remark_left_out,
)
from fleet_slip.models.request import ModelList, Search, SelectionRequest
from fleet_slip.regression.choice import NestedChoice, Winner
from fleet_slip.regression.folds import CrossValidation, Figures
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.warehouse.database import describe_cohort


@dataclass(frozen=True)
class SearchedModels:
    """Models of a search, of sizes 1, 2, ...; the search was repeated for each training fold."""

    search: Search
    inputs: tuple[str, ...]
    models: tuple[CrossValidation, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the content of a JSON document."""
        main = self.search.as_dict(include={"method", "max_features", "rule"})
        options = self.search.as_dict(exclude_defaults=True, exclude={"inputs"})
        return {**main, **options, "inputs": len(self.inputs), "sizes": len(self.models)}


@dataclass(frozen=True)
class NestedErrors(Record):
    """Held-out errors of a choice, repeated without each group of drives."""

    DOCUMENT = "groups correlation=figures.correlation rmse_deg=figures.rmse_deg"

    groups: int
    figures: Figures


@dataclass(frozen=True)
class Selection(Answer):
    """All candidates with their figures, in the order of the list, and the winner.

    Attributes
    ----------
    models
        Figures on the rows that all candidates can use.
    winner
        The winner, fitted to all rows that it can use.
    skipped
        Candidates that were not compared, with the reason.
    choice
        Choice from an order; None for a list of models.
    searched
        The models of each search, which are among `models`.
    model_list, config_sha256
        Name of what was compared, such as `table1`, and its checksum.
    candidate_list
        The compared models and searches; for an order only the winner. Another selection from it on
        the same data has the same winner.
    weighted
        The drives that `robust` down-weights, the most unusual first.
    full
        Integer weight of a row without down-weighting.
    without_label
        Quality of the winner if changes of the course replaced the label.
    label_noise_deg
        Noise of the label, which is part of every error; None if unknown.
    request, requested_cohort
        The options and the predicate of the user.
    remark
        Reason for comparing another list than the default.
    examined
        Sentence on the drives that were left out for faulty sensors.
    nested
        Errors with the whole choice repeated without the drives to test; None if not computed.
    """

    DOCUMENT = (
        "winner=winner.model.name reason=winner.reason cohort=cohort.predicate.text "
        "drives=cohort.drive_count rows=cohort.rows rows_without drives_left_out=cohort.left_out "
        "intercept=candidate_list.intercept skipped drives_weighed=weighted label_noise_deg "
        "choice? without_label? remark? examined? nested_cross_validation=nested?"
    )

    cohort: Cohort
    candidate_list: ModelList
    models: tuple[CrossValidation, ...]
    winner: Winner
    skipped: dict[str, str]
    choice: NestedChoice | None = None
    searched: tuple[SearchedModels, ...] = ()
    model_list: str = ""
    config_sha256: str = ""
    weighted: Mapping[str, DownweightedDrive] = field(default_factory=dict)
    full: int = 1
    without_label: CourseLabelQuality | None = None
    label_noise_deg: float | None = None
    request: SelectionRequest = field(default_factory=SelectionRequest)
    requested_cohort: str = TRAINING_DRIVES
    remark: str = ""
    examined: str = ""
    nested: NestedErrors | None = None

    def __repr__(self) -> str:
        winner = self.winner.model
        return (
            f"<{type(self).__name__}: {winner.name}, {len(winner.signals)} signals, RMSE "
            f"{winner.pooled.rmse_deg:.4f} deg, correlation {winner.correlation:.4f}, of "
            f"{len(self.models)} models; {self.cohort.drive_count:,} drives where "
            f"{self.cohort.predicate.text}>"
        )

    def parts(self, everything: bool = False, hint: str = "") -> Iterator[Part]:
        """Return the winner, the reason, and the best models or all; see `summarize`."""
        return summarize(self, everything, hint)

    @property
    def searched_winner(self) -> SearchedModels | None:
        """The search that found the winner; None without one."""
        signals = self.winner.model.signals
        of_search = (s for s in self.searched if signals in [model.signals for model in s.models])
        return next(of_search, None)

    @property
    def rows_without(self) -> int:
        """Rows of the cohort without the label or a column of the winner."""
        return max(self.cohort.rows - self.trained_rows, 0)

    @property
    def trained_rows(self) -> int:
        """Rows that the winner was trained on; down-weighted rows count by their weight."""
        return self.winner.model.pooled.rows // self.full

    @property
    def beyond_label_noise_deg(self) -> float | None:
        """The winner's RMSE without the label's noise."""
        if self.label_noise_deg is None:
            return None
        rmse_deg = self.winner.model.pooled.rmse_deg
        return math.sqrt(max(rmse_deg**2 - self.label_noise_deg**2, 0.0))

    def as_dict(self) -> dict[str, Any]:
        """Return what `select --json` prints."""
        cohort, folds = self.cohort, len(self.models[0].folds)
        models = [
            {**model.as_dict(), "gram_rows": cohort.gram_condition(model.signals)}
            for model in self.models
        ]
        for model, gap in zip(models, self.winner.gaps, strict=False):
            model["shortfall"] = gap.as_dict()
        document = {"models": models, **super().as_dict()} | {
            "feature_set": cohort.catalog.identity(cohort.feature_set),
            "drives_without_log": cohort.count_onboard_with(),
            "folds": {"by": self.candidate_list.folds.by, "count": folds},
        }
        if self.searched:
            document["search"] = (self.searched_winner or self.searched[0]).as_dict()
        if cohort.prior:
            campaign = str(self.request.prior)
            document["prior"] = {"campaign": campaign, "weight": str(cohort.weight)}
        return document


MIN_REPORTED_SHARE = 0.01
"""Minimum share of rows without the label or a signal that is reported."""


def remark_skipped_rows(rows: int, total: int) -> Iterator[Remark]:
    """Yield the number of rows without the label or a signal, unless their share is small."""
    if rows > MIN_REPORTED_SHARE * total:
        yield Remark(
            f"{rows:,} of {pluralize(total, 'row')} skipped: the label or a signal of the model is "
            "null."
        )


def outlier_remarks(drives: Mapping[str, DownweightedDrive]) -> Iterator[Remark]:
    """Yield the drives that `robust` down-weights, with the reason."""
    for name, drive in drives.items():
        yield Remark(f"{name}: {drive.reason}.")


MANY_SIGNALS = 30
"""A table names families if a model has more signals than this."""

BEST = 10
"""Number of models in a table without --all."""
CONDITION_WIDTH = 120
"""Maximum number of characters of a cohort in a table without --all."""


def summarize(selection: Selection, everything: bool = False, hint: str = "") -> Iterator[Part]:
    """Return the winner, the reason, a table of the best models or all, and remarks.

    `hint` is the option that prints all models.
    """
    cohort, winner = selection.cohort, selection.winner.model
    if selection.examined:
        yield Remark(selection.examined)
    yield f"winner: {winner.name}. {selection.winner.reason}"
    if selection.searched_winner is not None:
        search, count = selection.searched_winner.search, pluralize(len(winner.signals), "column")
        columns = in_families(cohort.catalog, winner.signals)
        yield f"{count}, found by {search.method} search {search.title!r}: {columns}"
    if selection.choice is not None:
        yield _order_table(selection.choice)
    yield _model_table(selection, everything, hint)
    yield from remark_skipped_rows(selection.rows_without, cohort.rows)
    if without_log := cohort.count_onboard_with():
        without = pluralize(without_log, "drive")
        yield Remark(f"{without} of these have no log: their cars sent Gram rows.")
    yield from remark_left_out(cohort.left_out, cohort.feature_set)
    yield from outlier_remarks(selection.weighted)
    if selection.remark:
        yield Remark(selection.remark)
    if selection.without_label is not None:
        yield from _course_remarks(selection.without_label)
    elif selection.label_noise_deg is None:
        yield Remark("label noise unknown: it is part of every RMSE here.")
    else:
        yield Remark(
            f"every RMSE here includes the label's noise, {selection.label_noise_deg:.4f} deg; "
            f"without it the winner has {selection.beyond_label_noise_deg:.4f} deg."
        )
    for names, reason in group_reasons(selection.skipped):
        yield Remark(f"Skipped {'models' if names[1:] else 'model'} {', '.join(names)}: {reason}")
    if (nested := selection.nested) is not None:
        yield Remark(
            f"RMSE of {winner.name}: {winner.pooled.rmse_deg:.4f} deg in the folds that chose it; "
            f"{nested.figures.rmse_deg:.4f} deg on held-out drives with the choice repeated "
            f"without them, in {nested.groups} groups: expect this one."
        )


_LACKING = re.compile(r"these drives lack \w+")


def group_reasons(reasons: Mapping[str, str]) -> Iterator[tuple[list[str], str]]:
    """Yield each reason once, after the names that it applies to.

    Reasons with the same first missing signal count as one.
    """
    groups: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        lacking = _LACKING.search(reason)
        groups.setdefault(lacking[0] if lacking else reason, []).append(name)
    for reason, names in groups.items():
        yield names, reasons[names[0]] if len(names) == 1 else f"{reason.rstrip('.')}."


def _model_table(selection: Selection, everything: bool, hint: str) -> TextTable:
    """Return a table of the models, or of the best listed ones and the winner.

    For models of a search it shows the number of columns instead of their names.
    """
    cohort, models, where = selection.cohort, selection.models, selection.cohort.predicate.text
    searched = [] if everything else [m for s in selection.searched for m in s.models]
    listed = [model for model in models if model not in searched] or list(models)
    best = sorted(listed, key=lambda model: model.pooled.rmse)[:BEST]
    names = {selection.winner.model.name, *(model.name for model in best)}
    shown = models if everything else [model for model in models if model.name in names]
    if everything:
        condition = f" where {where}"
    elif len(condition := describe_cohort(where)) > CONDITION_WIDTH:
        condition = f"{condition[:CONDITION_WIDTH].rstrip()} …{hint and f' ({hint})'}"
    title = f"{pluralize(cohort.drive_count, 'drive')}, {pluralize(cohort.rows, 'row')}{condition}"
    title += f"; {pluralize(len(models[0].folds), 'fold')} by {selection.candidate_list.folds.by}"
    title += "" if selection.candidate_list.intercept else "; no intercept"
    if len(shown) < len(models):
        title += f"; {len(shown)} of {len(models)} models{hint and f' ({hint})'}"
    header = "model|signals|correlation|RMSE deg"
    row = "{model.name}|{signals}|{pooled.correlation:.4f}|{pooled.rmse_deg:.4f}"
    if everything:
        header += "|error mean deg|error std deg|condition number|drives"
        row += (
            "|{pooled.error_mean_deg:+.4f}|{pooled.error_std_deg:.4f}"
            "|{model.condition_number:.3g}|{model.drives:,}"
        )
    rows = (
        {
            "model": model,
            "pooled": model.pooled,
            "signals": pluralize(len(model.signals), "column")
            if model in searched
            else in_families(cohort.catalog, model.signals),
        }
        for model in shown
    )
    return TextTable(title, header, rows, row, text_columns=2)


def _course_remarks(quality: CourseLabelQuality) -> Iterator[Remark]:
    """Yield the quality of a label from course changes, and its limits."""
    over = ", ".join(f"{seconds:g}" for seconds in quality.change_s)
    figures = f"learned from changes of the course over {over} s: the figures are of these changes"
    if quality.noise_deg is not None:
        figures += (
            f", whose noise is {quality.noise_deg:.4f} deg on straights; the angle's own error "
            f"over these times is at most {quality.angle_at_most_deg:.3f} deg"
        )
    yield Remark(f"{figures}.")
    if (side := quality.one_way) is not None:
        yield Remark(
            f"nearly all turns are to the {side}: ay and its square cannot be separated, nor can "
            "offsets. Add drives with turns to the other side."
        )
    yield Remark(
        "course changes do not reveal the intercept (see fleet-slip show), a late course or a "
        "misplaced antenna."
    )


def in_families(catalog: Catalog, signals: Sequence[str]) -> str:
    """Return the names of signals, or of their families if there are many."""
    if len(signals) <= MANY_SIGNALS:
        return " ".join(signals)
    families = catalog.families(signals).items()
    names = (f"{name}({count})" if count else name for name, count in families)
    return f"{len(signals)}: " + " ".join(names)


def _order_table(choice: NestedChoice) -> TextTable:
    """Return the table of the k+1 models of an order, the empty one first.

    D is the distance of the paper's equation (2), in units of the noise: to the full model, and the
    expected one to the true model.
    """
    evidence, criterion = choice.evidence, choice.rule.criterion
    size = len(choice.winner.model.signals)
    columns = zip(evidence.excess, evidence.distances, choice.values, strict=True)
    return TextTable(
        f"order by {choice.rule.ranking}; with {evidence.kind} as independent observations: "
        f"{evidence.rows:,.0f} effective rows",
        "|added|contribution A|D to full|expected D|"
        + ("minus correlation" if criterion == "cv" else criterion),
        (
            [
                str(j),
                choice.order[j - 1] if j else "(none)",
                f"{evidence.contributions[j - 1]:,.1f}" if j else "",
                f"{to_full:,.1f}",
                f"{expected:,.1f}",
                f"{value:,.4f}{' <' if j == size else '  '}",
            ]
            for j, (to_full, expected, value) in enumerate(columns)
        ),
        text_columns=2,
    )
