"""Claims of the comparison with the Kalman filter, and of the conclusions."""

from fleet_slip.comparison.report.claims.claim import (
    NotEvaluatedError,
    Verdict,
    claim,
    known,
    not_testable,
    verdict,
)
from fleet_slip.comparison.report.claims.method import LITTLE
from fleet_slip.comparison.report.findings.report_data import DRAWN_FILTERS, ReportData
from fleet_slip.comparison.report.findings.stretches import BLOCK_S, difference
from fleet_slip.export.costs import describe_costs
from fleet_slip.pages.text import degrees, listed, scientific

SIGNIFICANT = 0.05
SMALL_DEG = 1.0
"""Largest error that counts as acceptably small."""


@claim(
    "IV, Figure 8",
    "The Kalman filter is significantly less accurate than the regression",
    f"a larger error on the nominal drive with p < {SIGNIFICANT}, as it is and tuned",
)
def filter_is_less_accurate(data: ReportData) -> Verdict:
    """Test the difference of the squared errors on the nominal drive."""
    ours = known(data, "nominal").rmse_deg
    theirs = [known(data, "nominal", name).rmse_deg for name in DRAWN_FILTERS]
    tests = [difference(data.runs["nominal"], data.choice, name) for name in DRAWN_FILTERS]
    plain, tuned = (
        f"{degrees(error)} (p = {scientific(test.p, 1)})"
        for error, test in zip(theirs, tests, strict=True)
    )
    return verdict(
        all(test.t > 0 and test.p < SIGNIFICANT for test in tests),
        f"regression {degrees(ours)}, Kalman filter {plain}, tuned {tuned}",
        f"By a paired t test of squared errors over {tests[0].blocks} blocks of {BLOCK_S:g} s. "
        f"{_over_noise(data)}{_in_outages(data)}",
    )


def _over_noise(data: ReportData) -> str:
    """Tell at which noise of GPS the tuned filter is as accurate as the regression."""
    sweep = data.evaluated.gps_noise
    if sweep is None:
        return ""
    levels = [level["velocity_std_mps"] for level in sweep["levels"]]
    span = f"noises of GPS velocity from {min(levels):g} to {max(levels):g} m/s"
    equal = sweep["equal_at_mps"].get("kalman_tuned", {}).get(data.choice)
    if equal is None:
        return f"Among {span} there is none at which both are equal. "
    return (
        f"It hangs on GPS: of {span}, the tuned filter is better below {equal:.3f} and the "
        "regression above. "
    )


def _in_outages(data: ReportData) -> str:
    told = []
    for name, place in (("gps_urban", "between high buildings"), ("gps_tunnel", "in the tunnel")):
        ours = data.evaluated.part(name, data.choice, "inside", "gps_outage")
        theirs = data.evaluated.part(name, "kalman_tuned", "inside", "gps_outage")
        if ours and theirs:
            told.append(f"{place} {degrees(theirs.rmse_deg)} against {degrees(ours.rmse_deg)}")
    fixes = "While fixes come, each corrects the filter by the true velocity."
    return f"{fixes} Without them the tuned filter has {listed(told)}." if told else fixes


@claim(
    "IV",
    "The method can be used in commercial vehicles together with the Kalman filter",
    "needs vehicles",
)
def commercial_vehicles(_: ReportData) -> Verdict:
    """Nothing here says so."""
    return not_testable("Use in series cars is not a matter of simulation.")


@claim(
    "V",
    "The algorithm is easily implemented, with little computation on line",
    f"at most {LITTLE} coefficients",
)
def easily_implemented(data: ReportData) -> Verdict:
    """Count the coefficients of the model that the paper settles on."""
    signals = data.evaluated.estimators[data.choice]["signals"]
    return verdict(
        len(signals) <= LITTLE,
        f"an intercept and {len(signals)} coefficients",
        "It has no state, no matrix and no iteration. The published model, "
        f"{data.version.reference}, on board: {describe_costs(data.version.manifest)}.",
    )


@claim(
    "V",
    "The method can guarantee acceptably small errors",
    f"no error above {SMALL_DEG:g}° in any of the paper's drives",
)
def guarantees_small_errors(data: ReportData) -> Verdict:
    """Look for the largest error in the paper's drives."""
    worst = [
        (known(data, name).max_deg, scenario["description"])
        for name, scenario in data.evaluated.scenarios.items()
        if scenario["paper"]
    ]
    if not worst:
        raise NotEvaluatedError("drive of the paper")
    largest, where = max(worst)
    return verdict(
        largest <= SMALL_DEG,
        f"largest error {degrees(largest, 1)} ({where}); 99 % of the nominal drive within "
        f"{degrees(known(data, 'nominal').p99_deg, 2)}",
        "Least squares makes the mean square over the training rows small, and promises nothing of "
        "a single row, or of a situation that was not trained.",
    )


@claim(
    "V",
    "The method is to be verified with a real test vehicle",
    "needs a vehicle",
)
def real_vehicle(_: ReportData) -> Verdict:
    """All drives of a report are simulated."""
    return not_testable(
        "All drives of this report are simulated. Measured logs come in through fleet-slip ingest."
    )


OUTCOME = (
    filter_is_less_accurate,
    commercial_vehicles,
    easily_implemented,
    guarantees_small_errors,
    real_vehicle,
)
"""In the paper's order."""
