"""Claims of the abstract, the introduction and the section on the method."""

from collections.abc import Mapping
from typing import Any

from fleet_slip.comparison.report.claims.claim import (
    NotEvaluatedError,
    Verdict,
    claim,
    known,
    verdict,
)
from fleet_slip.comparison.report.findings.report_data import ReportData
from fleet_slip.pages.text import count, degrees, percent

LITTLE = 20
"""Most multiplications that count as little computation."""


@claim(
    "Abstract",
    "Signals of many vehicles can be used to make the estimator",
    "on cars of another class, a fleet-trained model beats the one-car model in most cases",
)
def many_vehicles(data: ReportData) -> Verdict:
    """Compare the models of a fleet with those of one car on cars of other classes."""
    scenarios = data.evaluated.scenarios
    if "nominal" not in scenarios:
        raise NotEvaluatedError("nominal drive")
    own = scenarios["nominal"]["vehicle_model"]
    rows = [
        row
        for row in data.evaluated.rows("comparisons")
        if scenarios[row["scenario"]]["vehicle_model"] != own
    ]
    if not rows:
        raise NotEvaluatedError("fleet-trained model on cars of other classes")
    better = sum(row["better"] == row["fleet"] for row in rows)
    change = sum(row["fleet_rmse_deg"] - row["one_car_rmse_deg"] for row in rows) / len(rows)
    return verdict(
        better > len(rows) / 2,
        f"better in {better} of {len(rows)} cases; on average its root mean square error differs "
        f"by {degrees(change, sign=True)}",
        "Loads, tyres and sensor biases of many cars average out in a fleet's coefficients. A car "
        "that is much like the trained one is served worse by them, a very different one better.",
    )


@claim(
    "Abstract",
    "The mining is done off line, and an estimate on board takes little computation",
    f"at most {LITTLE} multiplications an estimate",
)
def little_computation(data: ReportData) -> Verdict:
    """Count the terms of the dot product."""
    signals = len(data.evaluated.estimators[data.choice]["signals"])
    drives = data.version.manifest.trained_on.drives
    return verdict(
        signals <= LITTLE,
        f"{signals} multiplications and {signals} additions, {8 * (signals + 1)} bytes of numbers",
        f"An estimate is one dot product. All training is done off line, from {drives} Gram rows.",
    )


@claim(
    "I",
    "Neural networks can be efficient, but are hard to implement and to train",
    "no learned rival is more accurate as it is",
)
def networks_are_hard(data: ReportData) -> Verdict:
    """Compare the learned rivals with least squares on the same rows."""
    rivals = data.evaluated.rows("rivals")
    ours = max(
        (one for one in rivals if one["name"].startswith("regression")),
        key=lambda one: len(one["signals"]),
        default=None,
    )
    others = [one for one in rivals if ours and one["signals"] == ours["signals"] and one != ours]
    if ours is None or not others:
        raise NotEvaluatedError("learned rivals")
    best = min(others, key=_rmse)
    return verdict(
        _rmse(best) >= _rmse(ours),
        f"{best['learner']}: {degrees(_rmse(best))} cross-validated after {best['training_s']:.1f} "
        f"s of training; least squares on the same rows: {degrees(_rmse(ours))}",
        "All see the same columns of the same rows. On board this one costs "
        f"{count(best['size_bytes'])} bytes against {count(ours['size_bytes'])}, and "
        f"{best['one_estimate_us'] / ours['one_estimate_us']:.0f} times as long for an estimate.",
    )


def _rmse(rival: Mapping[str, Any]) -> float:
    return float(rival["cross_validated"]["rmse_deg"])


@claim(
    "I",
    "A precise Kalman filter can need a sensor fusion with accurate GPS",
    "no filter without GPS is more accurate than the fusion",
)
def needs_gps(data: ReportData) -> Verdict:
    """Compare the extended Kalman filter, which has no GPS, with the paper's filter."""
    ekf, fusion = (known(data, "nominal", name) for name in ("ekf_class_tuned", "kalman_tuned"))
    other, ours = known(data, "tyres_soft", "ekf_class_tuned"), known(data, "tyres_soft")
    return verdict(
        ekf.rmse_deg >= fusion.rmse_deg,
        f"an extended Kalman filter without GPS {degrees(ekf.rmse_deg)}, the fusion with GPS "
        f"{degrees(fusion.rmse_deg)}, the regression {degrees(known(data, 'nominal').rmse_deg)}",
        "A filter on the single-track model with wheel speeds needs no GPS. It needs to know mass, "
        "geometry and tyres instead: on softer tyres than it believes it has "
        f"{degrees(other.rmse_deg)}, the regression {degrees(ours.rmse_deg)}.",
    )


@claim(
    "I",
    "GPS solutions suffer from lost signals in towns and tunnels",
    "the Kalman filter's error grows in both",
)
def gps_is_lost(data: ReportData) -> Verdict:
    """Compare the paper's filter with and without outages."""
    clear, urban, tunnel = (
        known(data, name, "kalman").rmse_deg for name in ("gps_clear", "gps_urban", "gps_tunnel")
    )
    return verdict(
        min(urban, tunnel) > clear,
        f"{degrees(clear)} with fixes throughout, {degrees(urban)} between high buildings, "
        f"{degrees(tunnel)} with a tunnel of 20 s",
        "Without a fix the filter integrates accelerations, and their biases with them.",
    )


@claim(
    "I",
    "The signals used are on board and available without a loss in communication",
    "an estimate at every sample of the tunnel drive",
)
def no_loss(data: ReportData) -> Verdict:
    """Count the estimates in the tunnel drive."""
    found = known(data, "gps_tunnel")
    return verdict(
        found.coverage == 1,
        f"{percent(found.coverage)} of the tunnel drive has an estimate, error "
        f"{degrees(found.rmse_deg)}",
        "No signal of the model comes from outside the car. What it cannot stand is a sensor that "
        "fails: see the drives with a signal stuck or missing.",
    )


@claim(
    "II.B",
    "All 2ᵏ subset models are unfeasible to compute as k grows",
    "the subsets of the paper's own signals cannot all be compared",
)
def subsets_unfeasible(data: ReportData) -> Verdict:
    """All subsets were compared; that is how the best ones are known."""
    ordering = data.ordering
    return verdict(
        ordering.subsets != 2 ** len(ordering.signals),
        f"all {ordering.subsets} models of {len(ordering.signals)} signals were compared for this "
        "page",
        "From a Gram matrix a subset costs a handful of additions. The statement is true of a "
        "great many signals, but a car does not have them.",
    )


@claim(
    "II.B",
    "The order of the variables is crucial for nested models",
    "some order needs more signals than the best subset",
)
def order_is_crucial(data: ReportData) -> Verdict:
    """Compare how many signals the orders need."""
    needed, best = data.ordering.needed, data.ordering.best
    told = ", ".join(f"{name} {size}" for name, size in needed.items())
    return verdict(
        max(needed.values()) > best,
        f"signals needed to leave 0.1 % of the variance to the full model: {told}; best subset "
        f"{best}",
        f"In the order of the paper's list {needed['declared']} are needed; with a good ranking "
        f"{min(needed.values())}. (Two criteria have other names in the paper than with their "
        "authors: CIC is the covariance inflation criterion, RIC the risk inflation criterion.)",
    )


METHOD = (
    many_vehicles,
    little_computation,
    networks_are_hard,
    needs_gps,
    gps_is_lost,
    no_loss,
    subsets_unfeasible,
    order_is_crucial,
)
"""In the paper's order."""
