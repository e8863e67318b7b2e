"""The command diagnose: a model's coefficients on a cohort, and how far to trust them."""

import typer

from fleet_slip.api.requests import DiagnosisRequest
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.cli.left_out import say_influential
from fleet_slip.cli.options import Cohort, request_options
from fleet_slip.cli.output import Json, print_json, print_line, print_table, say
from fleet_slip.regression.inference.standard_errors import INTERCEPT, Estimate
from fleet_slip.selection.diagnostics import CohortComparison, Diagnosis
from fleet_slip.words import number_of


@request_options(DiagnosisRequest, argument="model")
def diagnose(
    context: typer.Context,
    request: DiagnosisRequest,
    cohort: Cohort = TRAINING_DRIVES,
    json: Json = False,
) -> None:
    """Fit a model's signals to a cohort and examine the fit, from Gram rows.

    Standard errors by drives, or by cars where there are several, are the ones to believe: at
    100 Hz a row says little that the one before did not say, and a car's drives share its biases.

    Example: **fleet-slip diagnose waterford**
    """
    result = context.obj.cohort(cohort).diagnose(**vars(request))
    if json:
        print_json({"cohort": cohort, **result.as_dict()})
    else:
        _print_diagnosis(result)


def _print_diagnosis(result: Diagnosis) -> None:
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
    if result.serial is not None:
        found = result.serial
        print_line(
            f"residuals: correlation {found.correlation.rho:.4f} with the row before, "
            f"Durbin-Watson {found.correlation.durbin_watson:.4f} (2 if independent); AR(1) with "
            f"rho {found.autoregressive.rho:.4f}."
        )
    if result.comparison is not None:
        _print_comparison(result, result.comparison)


def _coefficients(result: Diagnosis) -> list[dict[str, str]]:
    """Return what is told of each coefficient, by heading."""
    rows = []
    both = zip(result.robust.estimates, result.naive.estimates, strict=True)
    for i, (robust, naive) in enumerate(both):
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
        if result.serial is not None:
            slope = result.serial.inference.estimates[i]
            row["AR(1)"] = "" if constant else f"{slope.value:.6g}"
            row["s.e. AR(1)"] = "" if constant else f"{slope.standard_error:.2g}"
        if (free := result.noise_free) is not None:
            row["without noise"] = f"{free.offset if constant else free.weights[name]:.6g}"
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
    for test, kind in (found.drives, f"Wald, by {result.cluster}s"), (found.rows, "Chow, by rows"):
        if test is not None:
            degrees = f"{test.numerator}, {_degrees(test.denominator)}"
            print_line(
                f"the same coefficients? {kind}: F({degrees}) = {test.f:,.2f}, p = {test.p:.2g}."
            )
    if found.drives is None:
        say(
            f"there are too few {result.cluster}s to compare so many coefficients by them. Chow's "
            "test takes neighbouring rows for independent evidence, which they are not: its p is "
            "far too small, and only a large one says something."
        )
    elif found.drives.p > 0.05 >= found.rows.p:
        say(
            f"by {result.cluster}s, the difference is no more than chance: the rows only look like "
            "evidence."
        )


def _degrees(many: float) -> str:
    return f"{many:.0f}" if many == round(many) else f"{many:.1f}"


def _standardised(here: Estimate, there: Estimate) -> float:
    spread = float((here.standard_error**2 + there.standard_error**2) ** 0.5)
    return (there.value - here.value) / spread
