"""The command diagnose: a model's coefficients on a cohort, and how far to trust them."""

from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.fleet import Fleet
from fleet_slip.base import number_of
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.cli.options import command
from fleet_slip.cli.output import figures_cells, print_line, print_table, say
from fleet_slip.cli.selection import say_influential
from fleet_slip.models.diagnose import CohortComparison, Diagnosis, WhatIf
from fleet_slip.regression.inference import INTERCEPT, Estimate

SOUND = ("unexamined",)
"""Not an option of what trains no model."""


@command(Fleet.cohort, FleetCohort.diagnose, arguments=["model"], without=SOUND, echo=["condition"])
def diagnose(result: Diagnosis) -> None:
    """Fit a model's signals to a cohort and examine the fit, from Gram rows.

    Standard errors by drives, or by cars where there are several, are the ones to believe: at
    100 Hz a row says little that the one before did not say, and a car's drives share its biases.

    Example: **fleet-slip diagnose waterford**
    """
    coefficients = _coefficients(result)
    print_table(
        f"{number_of(result.drives, 'drive')}, {number_of(result.fitted.gram.n, 'row')}, worth "
        f"{result.evidence.rows:,.0f} independent ones; R squared {result.fitted.r_squared:.4f}, "
        f"condition number {result.condition_number:.3g} (1: no signal tells what another tells)",
        list(coefficients[0]),
        [list(row.values()) for row in coefficients],
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


def _coefficients(result: Diagnosis) -> list[dict[str, str]]:
    """Return what is told of each coefficient, by heading."""
    rows = []
    both = zip(result.robust.estimates, result.naive.estimates, strict=True)
    for robust, naive in both:
        name, constant = robust.name, robust.name == INTERCEPT
        row = {
            "signal": name,
            "unit": (catalogue()[catalogue().label] if constant else features().of(name)).unit,
            "coefficient": f"{robust.value:.6g}",
            f"s.e. by {result.cluster}s": f"{robust.standard_error:.2g}",
            "t": f"{robust.t:.1f}",
            "s.e. by rows": f"{naive.standard_error:.2g}",
            "VIF": "" if constant else f"{result.inflation[name]:.3g}",
        }
        rows.append(row)
    return rows


def _print_comparison(result: Diagnosis, found: CohortComparison) -> None:
    print_table(
        f"\nthe same signals where {found.condition}",
        ["signal", "coefficient here", "there", "s.e. there", "difference / s.e."],
        [
            [
                here.name,
                f"{here.value:.6g}",
                f"{there.value:.6g}",
                f"{there.standard_error:.2g}",
                f"{_standardised(here, there):+.1f}",
            ]
            for here, there in zip(result.robust.estimates, found.other.estimates, strict=True)
        ],
    )
    test = found.test
    if test is None:
        unit = "drive" if result.cluster == "row" else result.cluster
        say(
            f"there are too few {unit}s to compare so many coefficients by them. Choose "
            "fewer signals, or more drives."
        )
        return
    degrees = f"{test.numerator}, {_degrees(test.denominator)}"
    print_line(
        f"the same coefficients? Wald, by {result.cluster}s: F({degrees}) = {test.f:,.2f}, "
        f"p = {test.p:.2g}."
    )


def _degrees(many: float) -> str:
    return f"{many:.0f}" if many == round(many) else f"{many:.1f}"


def _standardised(here: Estimate, there: Estimate) -> float:
    spread = float((here.standard_error**2 + there.standard_error**2) ** 0.5)
    return (there.value - here.value) / spread


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
