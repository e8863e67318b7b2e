"""Text of a selection: the winner and the reason, the best models, the excluded drives."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from fleet_slip.base import pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.grams.cohort import BANDS, PARTS, remark_left_out
from fleet_slip.regression.choice import CROSS_VALIDATION, NestedDistances
from fleet_slip.regression.inference import Evidence
from fleet_slip.rendering import Part, Remark, TextTable
from fleet_slip.warehouse.predicate import describe_cohort

if TYPE_CHECKING:
    from fleet_slip.calibration.course_label import CourseLabelQuality
    from fleet_slip.grams.cohort import DownweightedDrive
    from fleet_slip.models.search import SearchChoice
    from fleet_slip.models.select import Selection

MIN_REPORTED_SHARE = 0.01
"""Minimum share of rows without the label or a signal that is reported."""


def remark_skipped_rows(rows: int, total: int) -> Iterator[Remark]:
    """Yield how many rows lack the label or a signal, if more than the first rows of windows."""
    if rows > MIN_REPORTED_SHARE * total:
        yield Remark(
            f"{rows:,} of {pluralize(total, 'row')} skipped: the label or a signal of the model is "
            "null."
        )


def outlier_remarks(drives: Mapping[str, "DownweightedDrive"]) -> Iterator[Remark]:
    """Yield the drives that `robust` down-weights, with the reason."""
    for name, drive in drives.items():
        yield Remark(f"{name}: {drive.reason}.")


MANY_SIGNALS = 30
"""A table names families if a model has more signals than this."""

DISTANCES = "contribution A|D to full|expected D"

BEST = 10
"""Number of models in a table without --all."""
CONDITION_WIDTH = 120


def summarize(selection: "Selection", everything: bool = False, hint: str = "") -> Iterator[Part]:
    """Return the winner and why, the best models or all, and how sure that is.

    `hint` is the option that prints all models.
    """
    if selection.examined:
        yield Remark(selection.examined)
    winner = selection.winner
    yield f"winner: {winner.model.name}. {winner.reason}"
    if selection.searched_winner is not None:
        count = pluralize(len(winner.model.signals), "column")
        columns = in_families(selection.cohort.catalog, winner.model.signals)
        search = selection.searched_winner.search
        yield f"{count}, found by {search.method} search {search.title!r}: {columns}"
    if selection.choice is not None:
        yield from _choice(selection.choice)
    if isinstance(selection.distances, NestedDistances):
        yield from _distances(selection.distances)
    yield _models(selection, everything, hint)
    yield from _left_out(selection)
    if selection.folds.by in (PARTS, BANDS):
        model = winner.model
        yield TextTable(
            f"\nmodel {model.name}, each fold left out in turn",
            "fold|rows|correlation|RMSE deg|error mean deg|error std deg",
            zip(model.fold_names, model.folds, strict=True),
            "{0}|{1.rows:,}|{1.correlation:.4f}|{1.rmse_deg:.4f}|{1.error_mean_deg:+.4f}|"
            "{1.error_std_deg:.4f}",
        )
    if isinstance(selection.distances, str):
        yield Remark(f"distances of the nested models unknown: {selection.distances}")
    for names, reason in group_skipped(selection.skipped):
        first, *relations = reason.split("; ")
        more = pluralize(len(relations), "relation")
        more = f"; and {more} more, see --json." if relations else ""
        yield Remark(f"Skipped {names}: {first}{more}")
    if selection.nested is not None:
        chosen_deg, nested = winner.model.pooled.rmse_deg, selection.nested
        yield Remark(
            f"RMSE of {winner.model.name}: {chosen_deg:.4f} deg in the folds that chose it; "
            f"{nested.figures.rmse_deg:.4f} deg on held-out drives with the choice repeated "
            f"without them, in {nested.groups} groups: expect this one."
        )
    if selection.choice is not None and (honest := selection.choice.honest) is not None:
        yield (
            "with the whole selection repeated inside every fold: correlation "
            f"{honest.correlation:.4f}, RMSE {honest.pooled.rmse_deg:.4f} deg."
        )


_LACKING = re.compile(r"these drives lack \w+")


def group_reasons(reasons: Mapping[str, str]) -> Iterator[tuple[list[str], str]]:
    """Yield each reason once, after the names that it applies to.

    Reasons with the same first missing signal are one.
    """
    groups: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        lacking = _LACKING.search(reason)
        groups.setdefault(lacking[0] if lacking else reason, []).append(name)
    for reason, names in groups.items():
        yield names, reasons[names[0]] if len(names) == 1 else f"{reason.rstrip('.')}."


def group_skipped(skipped: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield each reason once, after the candidates and searches that it applies to."""
    for names, reason in group_reasons(skipped):
        searches = [name for name in names if name.endswith(")")]
        models = ", ".join(name for name in names if name not in searches)
        if models:
            searches.insert(0, f"models {models}" if ", " in models else f"model {models}")
        yield ", ".join(searches), reason


def _shortened(predicate: str, everything: bool, hint: str) -> str:
    """Return a cohort for display; a long predicate is cut."""
    text = describe_cohort(predicate)
    if everything:
        return text and f" where {predicate}"
    beginning = text[:CONDITION_WIDTH].rstrip()
    return f"{beginning} …{hint and f' ({hint})'}" if len(text) > CONDITION_WIDTH else text


def _models(selection: "Selection", everything: bool, hint: str) -> TextTable:
    """Return a table of the models, or of the best listed ones and the winner.

    It omits signals if a table above has them. For models of a search it has the number of columns:
    these change from size to size.
    """
    cohort, models, where = selection.cohort, selection.models, selection.cohort.predicate.text
    searched = [] if everything else [m for s in selection.searched for m in s.models]
    listed = [model for model in models if model not in searched] or list(models)
    best = sorted(listed, key=lambda model: model.pooled.rmse)[:BEST]
    names = {selection.winner.model.name, *(model.name for model in best)}
    shown = models if everything else [model for model in models if model.name in names]
    title = f"{pluralize(cohort.drive_count, 'drive')}, {pluralize(cohort.rows, 'row')}"
    title += _shortened(where, everything, hint)
    title += f"; {pluralize(len(models[0].folds), 'fold')} by {selection.folds.by}"
    title += "" if selection.intercept else "; no intercept"
    title += "" if len(shown) == len(models) else f"; {len(shown)} of {len(models)} models"
    title += f" ({hint})" if hint and len(shown) < len(models) else ""
    header, row = "model", "{model.name}"
    if has_signals := selection.choice is None:
        header, row = f"{header}|signals", f"{row}|{{signals}}"
    header += "|correlation|RMSE deg"
    row += "|{pooled.correlation:.4f}|{pooled.rmse_deg:.4f}"
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
    return TextTable(title, header, rows, row, text_columns=1 + has_signals)


def _label_noise(selection: "Selection") -> Remark:
    """Return the share of the label's noise in the errors."""
    noise = selection.label_noise_deg
    if noise is None:
        return Remark("label noise unknown: it is part of every RMSE here.")
    return Remark(
        f"every RMSE here includes the label's noise, {noise:.4f} deg; without it the winner has "
        f"{selection.beyond_label_noise_deg:.4f} deg."
    )


def _without_label(quality: "CourseLabelQuality") -> Iterator[Remark]:
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


def _left_out(selection: "Selection") -> Iterator[Remark]:
    """Yield which drives of the cohort the models were not made of, and what the label is worth."""
    yield from remark_skipped_rows(selection.rows_without, selection.cohort.rows)
    if without_log := selection.cohort.count_onboard_with():
        without = pluralize(without_log, "drive")
        yield Remark(f"{without} of these have no log: their cars sent Gram rows.")
    yield from remark_left_out(selection.cohort.left_out, selection.cohort.feature_set)
    yield from outlier_remarks(selection.weighted)
    if selection.remark:
        yield Remark(selection.remark)
    if selection.without_label is not None:
        yield from _without_label(selection.without_label)
    else:
        yield _label_noise(selection)


def in_families(catalog: Catalog, signals: Sequence[str]) -> str:
    """Return the names of signals, or of their families if there are many."""
    if len(signals) <= MANY_SIGNALS:
        return " ".join(signals)
    families = catalog.families(signals).items()
    names = (f"{name}({count})" if count else name for name, count in families)
    return f"{len(signals)}: " + " ".join(names)


def _evidence_text(evidence: Evidence) -> str:
    """Return the unit and the effective number of rows of evidence."""
    return f"with {evidence.kind} as independent observations: {evidence.rows:,.0f} effective rows"


def _distances(distances: NestedDistances) -> Iterator[Part]:
    """Yield the distances of nested models."""
    yield TextTable(
        "distance D of equation (2) by the number of signals; "
        f"{_evidence_text(distances.evidence)}",
        f"|added|{DISTANCES}",
        _distance_rows(distances.order, distances.evidence),
        text_columns=2,
    )
    yield f"without any signal: RMSE {distances.null.pooled.rmse_deg:.4f} deg.\n"


def _choice(choice: "SearchChoice") -> Iterator[Part]:
    """Yield the tables of an order, or of best subsets."""
    evidence = _evidence_text(choice.evidence)
    if (nested := choice.nested) is not None:
        by_folds = choice.rule.criterion == CROSS_VALIDATION
        criterion = "minus correlation" if by_folds else choice.rule.criterion
        rows = zip(_distance_rows(nested.order, nested.evidence), nested.values, strict=True)
        yield TextTable(
            f"order by {choice.rule.ranking}; {evidence}",
            f"|added|{DISTANCES}|{criterion}",
            (
                [*line, f"{value:,.4f}{' <' if j == nested.size else '  '}"]
                for j, (line, value) in enumerate(rows)
            ),
            text_columns=2,
        )
    if choice.subsets is not None and (picks := choice.picks) is not None:
        rows_of_sizes = (
            {
                "best": subset.best,
                "picked_by": [name for name, size in picks.items() if size == subset.best.size],
                "gap": subset.gap,
            }
            for subset in choice.subsets
        )
        yield TextTable(
            f"best subset of every size; {evidence}",
            "size|signals|picked by|R squared|gap to second",
            rows_of_sizes,
            "{best.size}|{best.model.signals}|{picked_by}|{best.r_squared:.6f}|{gap:.2g}",
            text_columns=3,
        )


def _distance_rows(order: Sequence[str], evidence: Evidence) -> Iterator[list[str]]:
    """Return a line for each of the k+1 models of an order, the empty one first.

    The distance D is that of the paper's equation (2), in units of the noise: from the full model,
    and as it is to be expected from the true one.
    """
    columns = zip(evidence.excess(), evidence.distances(), strict=True)
    for j, (to_full, expected) in enumerate(columns):
        added = order[j - 1] if j else "(none)"
        contribution = f"{evidence.contributions[j - 1]:,.1f}" if j else ""
        yield [str(j), added, contribution, f"{to_full:,.1f}", f"{expected:,.1f}"]
