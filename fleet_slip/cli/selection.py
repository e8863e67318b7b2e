"""What is printed of a selection, and the commands that examine a fit: diagnose, what-if."""

from collections.abc import Iterator, Mapping, Sequence

from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.fleet import Fleet
from fleet_slip.base import number_of
from fleet_slip.catalogue.facts import TRAINING_DRIVES
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.options import command
from fleet_slip.cli.output import (
    cell,
    figures_cells,
    print_line,
    print_records,
    print_table,
    print_text,
    say,
)
from fleet_slip.grams.folding import BANDS, PARTS, ROW_FOLDS
from fleet_slip.models.diagnose import CohortComparison, Diagnosis, WhatIf
from fleet_slip.models.search import SearchChoice
from fleet_slip.models.select import Selection, Uncertainty, WithoutLabel
from fleet_slip.regression.choice import CROSS_VALIDATION, NestedDistances
from fleet_slip.regression.drives import Influential
from fleet_slip.regression.folds import CrossValidation
from fleet_slip.regression.inference import INTERCEPT, Evidence

# Says which drives of a cohort what was computed leaves out.

TELLING = 0.01
"""Part of a cohort's rows without the label or a signal that is worth a remark."""


def say_without_log(drives: int, feature_set: str) -> None:
    """Say how many drives have no Gram rows of a feature set, since their cars sent no log."""
    if drives:
        say(
            f"{number_of(drives, 'drive')} without a log left out: cars send Gram rows of the "
            f"logged signals, not of the feature set {feature_set}."
        )


def say_influential(cars: Mapping[str, Influential], what: str) -> None:
    """Say which cars have an influence that no honest car has, and what becomes of them."""
    for car, one in cars.items():
        say(
            f"{car} {what}: its influence on the model is {one.times:.0f} times the median one, "
            f"by what its rows give it ({one.rows:.1%} of all)."
        )


def say_without_information(rows: int, of: int) -> None:
    """Say how many rows of a cohort told nothing, if they are more than windows begin with."""
    if rows > TELLING * of:
        say(
            f"{rows:,} of {number_of(of, 'row')} tell nothing: the label or a signal of the model "
            "is missing there."
        )


def say_examined(told: str) -> None:
    """Say which drives were left out since they are not in order, if there are any."""
    if told:
        say(told)


MANY_SIGNALS = 30
"""Of more, a table names families."""

DISTANCES = ("contribution A", "D to full", "expected D")

ERROR = ("correlation", "RMSE deg", "error mean deg", "error std deg")

BEST = 10
"""So many models are shown unless all are asked for."""
CONDITION_WIDTH = 120


def print_selection(selection: Selection, everything: bool = False) -> None:
    """Print the winner and why, the best models or all, and how sure that is."""
    winner = selection.winner
    print_text(f"winner: {winner.model.name}. {winner.reason}")
    if selection.searched is not None and winner.model in selection.searched.models:
        print_text(f"its columns: {in_families(winner.model.signals)}")
    if selection.choice is not None:
        _print_choice(selection.choice)
    if isinstance(selection.distances, NestedDistances):
        _print_distances(selection.distances)
    _print_models(selection, everything)
    _say_left_out(selection)
    if selection.cohort.unlabelled:
        say(
            f"a change of the course has {selection.cohort.weight} times the weight of a row with "
            "the label; the figures are of the angle about its mean in each drive with the label."
        )
    if selection.folds.by in (PARTS, BANDS):
        _print_folds(selection.winner.model)
    if selection.folds.by == ROW_FOLDS:
        say(
            "folds of rows leak: each test row's neighbours at 100 Hz are training rows, so that "
            "these figures are those of the fit, not of prediction. Compare with --by drive."
        )
    if isinstance(selection.distances, str):
        say(f"the distances of the nested models cannot be told: {selection.distances}")
    for name, reason in selection.skipped.items():
        one, *others = reason.split("; ")
        more = f"; and {number_of(len(others), 'relation')} more, see --json." if others else ""
        say(f"model {name} was left out: {one}{more}")
    if selection.choice is not None and (honest := selection.choice.honest) is not None:
        print_line(
            "made again inside every training fold, the whole choice has a correlation of "
            f"{honest.correlation:.4f} and an RMSE of {honest.pooled.rmse_deg:.4f} deg."
        )
    if selection.uncertainty is not None:
        _print_uncertainty(selection.uncertainty)


def _shortened(condition: str, everything: bool) -> str:
    """Return a condition; of a long one, such as one that names drives left out, its beginning."""
    long = not everything and len(condition) > CONDITION_WIDTH
    return f"{condition[:CONDITION_WIDTH].rstrip()} … (--all)" if long else condition


def _print_models(selection: Selection, everything: bool) -> None:
    """Print a table of the models, of many the best; without signals where a table above has them.

    A search changes some columns from size to size: how many there are stands here.
    """
    cohort, models, where = selection.cohort, selection.models, selection.cohort.condition.text
    ranked = sorted(models, key=lambda model: model.pooled.rmse)
    shown = models if everything else [one for one in models if one in ranked[:BEST]]
    found = () if everything or selection.searched is None else selection.searched.models
    title = f"{number_of(cohort.drive_count, 'drive')}, {number_of(cohort.rows, 'row')}"
    title += "" if where == TRAINING_DRIVES else f" where {_shortened(where, everything)}"
    title += f"; {number_of(len(models[0].folds), 'fold')} by {selection.folds.by}"
    title += "" if selection.intercept else "; no intercept"
    title += "" if len(shown) == len(models) else f"; the {BEST} best of {len(models)} (--all)"
    header, row = "model", "{model.name}"
    if listed := selection.choice is None:
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
            "model": one,
            "pooled": one.pooled,
            "signals": number_of(len(one.signals), "column")
            if one in found
            else in_families(one.signals),
        }
        for one in shown
    )
    print_records(title, header, row, rows, left=1 + listed)


def _say_label_noise(selection: Selection) -> None:
    """Say how much of the errors is noise of the label they are measured against."""
    noise = selection.label_noise_deg
    if noise is None:
        say("how noisy the label is, is not known: all errors have its noise in them.")
    else:
        say(
            f"all errors have the label's own noise in them, {noise:.4f} deg; without it the "
            f"winner has {selection.beyond_label_noise_deg:.4f} deg."
        )


def _say_without_label(told: WithoutLabel) -> None:
    """Say what changes of the course tell of the angle, and what they do not."""
    over = ", ".join(f"{one:g}" for one in told.change_s)
    figures = f"learned from changes of the course over {over} s: the figures are of these changes"
    if told.noise_deg is not None:
        figures += (
            f", which have {told.noise_deg:.4f} deg of noise where cars go straight on; the "
            f"angle's own error over so long is at most {told.angle_at_most_deg:.3f} deg"
        )
    say(f"{figures}.")
    if (side := told.one_way) is not None:
        say(
            f"cars turn to the {side} nearly always: columns that differ between left and right "
            "alone, such as ay and its square, cannot be told apart, nor can offsets. Add drives "
            "that turn to the other side."
        )
    say(
        "changes do not show the constant (see show of a published version), nor what a course "
        "that is late or an antenna in another place would add."
    )


def _say_left_out(selection: Selection) -> None:
    """Say which drives of the cohort the models were not made of, and what the label is worth."""
    if not selection.cohort.unlabelled:
        say_without_information(selection.rows_without, selection.cohort.rows)
    if without_log := selection.cohort.count_received_with():
        say(f"{number_of(without_log, 'drive')} of these without a log: their cars sent Gram rows.")
    say_without_log(selection.cohort.left_out, selection.cohort.feature_set)
    say_influential(selection.left_out, "left out")
    if selection.remark:
        say(selection.remark)
    if selection.without_label is not None:
        _say_without_label(selection.without_label)
    elif not selection.cohort.unlabelled:
        _say_label_noise(selection)


def _print_folds(model: CrossValidation) -> None:
    print_table(
        f"\nmodel {model.name}, each fold left out in turn",
        ["fold", "rows", *ERROR],
        [
            [name, f"{found.rows:,}", *figures_cells(found)]
            for name, found in zip(model.fold_names, model.folds, strict=True)
        ],
    )


def in_families(signals: Sequence[str]) -> str:
    """Return the names of signals; of more than `MANY_SIGNALS`, whole families by their own."""
    if len(signals) <= MANY_SIGNALS:
        return " ".join(signals)
    families = features().families(signals).items()
    told = (f"{name}({count})" if count else name for name, count in families)
    return f"{len(signals)}: " + " ".join(told)


def _worth(evidence: Evidence) -> str:
    return f"taking {evidence.kind} for independent, the cohort is worth {evidence.rows:,.0f} rows"


def _print_distances(found: NestedDistances) -> None:
    print_table(
        f"distance D of equation (2) by the number of signals; {_worth(found.evidence)}",
        ["", "added", *DISTANCES],
        _distance_rows(found.order, found.evidence),
        left=2,
    )
    print_line(f"without any signal: RMSE {found.null.pooled.rmse_deg:.4f} deg.\n")


def _print_choice(choice: SearchChoice) -> None:
    worth = _worth(choice.evidence)
    if choice.nested is not None:
        nested, by_folds = choice.nested, choice.rule.criterion == CROSS_VALIDATION
        criterion = "minus correlation" if by_folds else choice.rule.criterion
        print_table(
            f"order by {choice.rule.ranking}; {worth}",
            ["", "added", *DISTANCES, criterion],
            (
                [*line, f"{value:,.4f}{' <' if j == nested.size else '  '}"]
                for j, (line, value) in enumerate(
                    zip(_distance_rows(nested.order, nested.evidence), nested.values, strict=True)
                )
            ),
            left=2,
        )
    if choice.subsets is not None and choice.picks is not None:
        print_table(
            f"best subset of every size; {worth}",
            ["size", "signals", "picked by", "R squared", "gap to second"],
            [
                [
                    str(result.best.size),
                    " ".join(result.best.model.signals),
                    " ".join(c for c, size in choice.picks.items() if size == result.best.size),
                    f"{result.best.r_squared:.6f}",
                    cell(result.gap, ".2g"),
                ]
                for result in choice.subsets
            ],
            left=3,
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


def _print_uncertainty(found: Uncertainty) -> None:
    print_line(
        f"{found.interval.level:.0%} interval of the winner's correlation, drawing its "
        f"{found.drawn}s {found.interval.replicates:,} times: {found.interval.low:.4f} to "
        f"{found.interval.high:.4f}."
    )


# The commands that examine a fit on a cohort: diagnose and what-if.

SOUND = ("unexamined",)
"""Not an option of what trains no model."""


@command(Fleet.cohort, FleetCohort.diagnose, arguments=["model"], without=SOUND, echo=["condition"])
def diagnose(result: Diagnosis) -> None:
    """Fit a model's signals to a cohort and examine the fit, from Gram rows.

    Standard errors by drives, or by cars where there are several, are the ones to believe: at
    100 Hz a row says little that the one before did not say, and a car's drives share its biases.

    Example: **fleet-slip diagnose waterford**
    """
    both = zip(result.robust.estimates, result.naive.estimates, strict=True)
    units = {INTERCEPT: catalogue()[catalogue().label].unit}
    rows = (
        {
            "robust": robust,
            "naive": naive,
            "unit": units.get(robust.name) or features().of(robust.name).unit,
            "vif": result.inflation.get(robust.name),
        }
        for robust, naive in both
    )
    print_records(
        f"{number_of(result.drives, 'drive')}, {number_of(result.fitted.gram.n, 'row')}, worth "
        f"{result.evidence.rows:,.0f} independent ones; R squared {result.fitted.r_squared:.4f}, "
        f"condition number {result.condition_number:.3g} (1: no signal tells what another tells)",
        f"signal|unit|coefficient|s.e. by {result.cluster}s|t|s.e. by rows|VIF",
        "{robust.name}|{unit}|{robust.value:.6g}|{robust.standard_error:.2g}|{robust.t:.1f}|"
        "{naive.standard_error:.2g}|{vif:.3g}",
        rows,
        left=2,
    )
    if result.cluster == "row":
        say(
            "there is one drive only: its rows are taken for independent evidence, which they are "
            "not at 100 Hz, so that the standard errors are far too small."
        )
    say_influential(result.influential, "would be left out by select --robust")
    if result.comparison is not None:
        _print_comparison(result, result.comparison)


def _print_comparison(result: Diagnosis, found: CohortComparison) -> None:
    both = zip(result.robust.estimates, found.other.estimates, strict=True)
    print_records(
        f"\nthe same signals where {found.condition}",
        "signal|coefficient here|there|s.e. there",
        "{here.name}|{here.value:.6g}|{there.value:.6g}|{there.standard_error:.2g}",
        ({"here": here, "there": there} for here, there in both),
    )
    test = found.test
    if test is None:
        unit = "drive" if result.cluster == "row" else result.cluster
        say(
            f"there are too few {unit}s to compare so many coefficients by them. Choose "
            "fewer signals, or more drives."
        )
        return
    degrees = f"{test.numerator}, {test.denominator:.4g}"
    print_line(
        f"the same coefficients? Wald, by {result.cluster}s: F({degrees}) = {test.f:,.2f}, "
        f"p = {test.p:.2g}."
    )


# The command that predicts a model's error with worse sensors: what-if.


@command(
    Fleet.cohort,
    FleetCohort.what_if,
    arguments=["model"],
    without=SOUND,
    echo=["condition", "noise", "bias"],
)
def what_if(result: WhatIf) -> None:
    """Predict a model's error with worse sensors, in closed form; nothing is simulated.

    Bias and noise come on top of what the logs have. Shown too: the best model for such sensors.

    Example: **fleet-slip what-if waterford --noise ay=0.2 --bias yaw_rate=0.02**
    """
    print_table(
        f"{number_of(result.drives, 'drive')}, {number_of(result.before.rows, 'row')}",
        ["", "correlation", "RMSE deg", "mean deg", "std deg"],
        [
            ["as logged", *figures_cells(result.before)],
            ["with these sensors", *figures_cells(result.after)],
            ["best model for these sensors", *figures_cells(result.refitted_after)],
        ],
    )
    print_table(
        "\nbest model for these sensors",
        ["signal", "coefficient"],
        [[INTERCEPT, f"{result.refitted.offset:.6g}"]]
        + [[name, f"{weight:.6g}"] for name, weight in result.refitted.weights.items()],
    )
