"""The paper's claims in its order: each a function of a report's results.

The docstring is the statement of the paper. The decorator has its place in the paper, and the
criterion by which it counts as reproduced. The function returns whether that holds, the figures,
and the reason. A claim is not testable where `holds` is None or the evaluation lacks a drive.
"""

import math
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.evaluation.evaluated_drives import TestDrive
from fleet_slip.evaluation.evaluation_document import DRAWN_FILTERS, NotEvaluatedError, ReportData
from fleet_slip.evaluation.evaluator import EvaluatedDrive
from fleet_slip.export.c import COEFFICIENT_BYTES, describe_costs, dot_product_operations
from fleet_slip.pages.page import count, degrees, join_words, number, percent, scientific
from fleet_slip.regression.choice import nested_fits
from fleet_slip.regression.orders import RANKINGS, best_subsets, rank
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.vehicle.parameters import GRAVITY_MPS2

PAPER_TABLE_TWO = {
    "1": (0.0135, 0.3018),
    "2": (-0.0146, 0.1754),
    "3": (-0.0209, 0.1556),
    "4": (-0.0060, 0.1549),
    "5": (-0.0079, 0.1505),
}
"""Mean and standard deviation of the error in deg on the paper's nominal drive, Table II."""

SLIGHT = 1.5
"""Largest ratio of RMSE that counts as slight, or as close. A ratio, because an angle such as 0.1°
may exceed the whole error; RMSE, because a mean error is an error."""

ACCURATE = 0.44
"""Largest RMSE of an accurate estimate over the angle's own standard deviation: that of an unbiased
estimate with a correlation of 0.9."""

MIN_CORRELATION = 0.9
"""Smallest correlation of an estimate that follows the angle."""

MAX_MULTIPLICATIONS = 20
"""Largest number of multiplications that counts as little computation."""

NEGLIGIBLE_R_SQUARED = 0.001
"""Loss of explained variance up to which a model is as good as the full one."""

BLOCK_S = 5.0
"""Length of a block; errors of neighbouring samples are correlated, of blocks hardly."""

SIGNIFICANT = 0.05
SMALL_DEG = 1
"""Largest error that counts as acceptably small."""

NOMINAL = "nominal"
SLIPPERY = "adhesion_0_4"

Blocks = EvaluatedDrive[TestDrive]


def mean_squares(run: Blocks, estimator: str) -> FloatArray:
    """Return the mean squared error in deg² of each block of a drive, shape (blocks,)."""
    error = np.degrees(run.estimates[estimator] - run.drive.sideslip_rad)[run.rows]
    size = int(BLOCK_S * SAMPLE_RATE_HZ)
    count = len(error) // size
    squares: FloatArray = (error[: count * size].reshape(count, size) ** 2).mean(axis=1)
    return squares


def compare_errors(run: Blocks, first: str, second: str) -> tuple[float, float]:
    """Compare squared errors by a paired t test over blocks; return t (> 0: first wins) and p."""
    from scipy.special import stdtr  # noqa: PLC0415 - slow

    gain = mean_squares(run, second) - mean_squares(run, first)
    t = float(gain.mean() / (gain.std(ddof=1) / math.sqrt(len(gain))))
    return t, float(2 * stdtr(len(gain) - 1, -abs(t)))


def blocks_won(run: Blocks, estimators: Sequence[str]) -> list[int]:
    """Count the blocks of a drive in which each estimator has the smallest squared error."""
    squares = np.stack([mean_squares(run, name) for name in estimators])
    best: list[int] = np.bincount(squares.argmin(axis=0), minlength=len(estimators)).tolist()
    return best


class Finding(NamedTuple):
    """Result of a claim: `holds` (None if it cannot be tested), the figures, and the reason."""

    holds: bool | None
    figure: str
    why: str


class Claim(NamedTuple):
    """A statement of the paper, the criterion for it, and the function that applies it."""

    place: str
    statement: str
    criterion: str
    find: Callable[[ReportData], Finding]


def claim(place: str, criterion: str) -> Callable[[Callable[[ReportData], Finding]], Claim]:
    """Make a claim of a function, whose docstring is the statement of the paper."""
    return lambda find: Claim(place, str(find.__doc__).rstrip("."), criterion, find)


def change(report: ReportData, *scenarios: str) -> float:
    """Return the largest RMSE over that of the nominal drive."""
    largest_deg: float = max(report.errors(name).rmse_deg for name in scenarios)
    return largest_deg / float(report.errors(NOMINAL).rmse_deg)


def close_to_nominal(report: ReportData, scenario: str, why: str) -> Finding:
    """Return whether the RMSE of a drive is less than `SLIGHT` times that of the nominal drive."""
    figure = f"{report.rmse(scenario)} against {report.rmse(NOMINAL)}"
    return Finding(change(report, scenario) < SLIGHT, figure, why)


@claim("Abstract", "a fleet-trained model beats the one-car model in most cases on other classes")
def many_vehicles(report: ReportData) -> Finding:
    """Signals of many vehicles can be used to make the estimator."""
    nominal_model = report.scenario(NOMINAL)["vehicle_model"]
    rows = [
        row
        for row in report.document.content["comparisons"]
        if report.scenario(row["scenario"])["vehicle_model"] != nominal_model
    ]
    if not rows:
        raise NotEvaluatedError("fleet-trained model on cars of other classes")
    better = sum(row["better"] == row["fleet"] for row in rows)
    return Finding(
        better > len(rows) / 2,
        f"better in {better} of {len(rows)} cases",
        "Loads, tyres and sensor biases of many cars average out in a fleet's coefficients.",
    )


@claim("Abstract", f"at most {MAX_MULTIPLICATIONS} multiplications an estimate")
def little_computation(report: ReportData) -> Finding:
    """The mining is done off line, and an estimate on board takes little computation."""
    signals = len(report.estimators[report.choice]["signals"])
    multiplications, additions = dot_product_operations(signals)
    return Finding(
        multiplications <= MAX_MULTIPLICATIONS,
        f"{multiplications} multiplications and {additions} additions of integers, "
        f"{COEFFICIENT_BYTES * signals} bytes of coefficients",
        "An estimate is one dot product. All training is done off line.",
    )


@claim("I", "no learned rival is more accurate as it is")
def networks_are_hard(_: ReportData) -> Finding:
    """Neural networks can be efficient, but are hard to implement and to train."""
    return Finding(None, "", "`python -m benchmarks.rivals` trains networks on the same columns.")


@claim("I", "no filter without GPS is more accurate than the fusion")
def needs_gps(report: ReportData) -> Finding:
    """A precise Kalman filter can need a sensor fusion with accurate GPS."""
    without, fusion = (
        report.errors(NOMINAL, name).rmse_deg for name in ("ekf_class_tuned", "kalman_tuned")
    )
    soft = report.rmse("tyres_soft", "ekf_class_tuned")
    return Finding(
        without >= fusion,
        f"an extended Kalman filter without GPS {degrees(without)}, the fusion with GPS "
        f"{degrees(fusion)}, the regression {report.rmse(NOMINAL)}",
        "A filter without GPS needs mass, geometry and tyres. On softer tyres than assumed it has "
        f"{soft}, the regression {report.rmse('tyres_soft')}.",
    )


@claim("I", "the Kalman filter's error grows in both")
def gps_is_lost(report: ReportData) -> Finding:
    """GPS solutions suffer from lost signals in towns and tunnels."""
    urban, tunnel, clear = (
        report.errors(name, "kalman").rmse_deg for name in ("gps_urban", "gps_tunnel", "gps_clear")
    )
    return Finding(
        min(urban, tunnel) > clear,
        f"{degrees(clear)} with fixes throughout, {degrees(urban)} between high buildings, "
        f"{degrees(tunnel)} with a tunnel of 20 s",
        "Without a fix the filter integrates accelerations, and their biases with them.",
    )


@claim("I", "an estimate at every sample of the tunnel drive")
def no_loss(report: ReportData) -> Finding:
    """The signals used are on board and available without a loss in communication."""
    tunnel = report.errors("gps_tunnel")
    return Finding(
        tunnel.coverage == 1,
        f"{percent(tunnel.coverage)} of the tunnel drive has an estimate, error "
        f"{degrees(tunnel.rmse_deg)}",
        "All signals of the model are the car's own. A sensor that fails does harm.",
    )


@claim("II.B", "the subsets of the paper's own signals cannot all be compared")
def subsets_unfeasible(report: ReportData) -> Finding:
    """All 2ᵏ subset models are unfeasible to compute as k grows."""
    signals = len(report.all_signals)
    return Finding(
        False,
        f"all {2**signals} models of {signals} signals were compared for this page",
        "From a Gram matrix a subset costs a few additions, and a car has no more signals.",
    )


@claim("II.B", "some order needs more signals than the best subset")
def order_is_crucial(report: ReportData) -> Finding:
    """The order of the variables is crucial for nested models."""
    cohort, signals = report.trained.selection.cohort, report.all_signals
    label, total = cohort.catalog.signals.label, cohort.complete_cases(signals).table.total()
    subsets = best_subsets(total, signals, label)
    threshold = subsets[-1].r_squared - NEGLIGIBLE_R_SQUARED
    best = next(fit.size for fit in subsets if fit.r_squared >= threshold)
    needed = {}
    for ranking in RANKINGS:
        fits = nested_fits(total, rank(ranking, total, signals, label), label)
        needed[ranking] = next(fit.size for fit in fits if fit.r_squared >= threshold)
    sizes = ", ".join(f"{name} {size}" for name, size in needed.items())
    return Finding(
        max(needed.values()) > best,
        f"signals needed to leave 0.1 % of the variance to the full model: {sizes}; best subset "
        f"{best}",
        "The names are rankings.",
    )


@claim("III", "more than 2 million rows at 100 Hz")
def two_million(report: ReportData) -> Finding:
    """More than 2 million instances at a sample time of 0.01 s."""
    rows = report.trained.selection.cohort.rows
    return Finding(
        rows > 2_000_000 and SAMPLE_RATE_HZ == 100,
        f"{count(rows)} rows at {SAMPLE_RATE_HZ} Hz",
        "Simulated with our own vehicle model, not with CarSim.",
    )


@claim("III, Table I", "models 4 and 5 have the highest correlations")
def last_two_best(report: ReportData) -> Finding:
    """The last two models have the best predictive accuracy."""
    selection = report.trained.selection
    ranked = sorted(selection.models, key=lambda model: model.correlation, reverse=True)
    return Finding(
        sorted(model.name for model in ranked[:2]) == ["4", "5"],
        ", ".join(f"model {model.name} {number(model.correlation, 4)}" for model in ranked),
        selection.winner.reason,
    )


@claim("III, Table I", "equal correlations to four digits, with wheel angles that are measured")
def exactly_as_accurate(report: ReportData) -> Finding:
    """Models 4 and 5 are exactly as accurate, as their steering angles are closely related."""
    four, five = (report.rmse("car_rear_drive_sedan", report.models[name]) for name in ("4", "5"))
    return Finding(
        None,
        "",
        "The simulated wheel angles are functions of the steering wheel's, without compliance or "
        f"error. In a sedan with another steering ratio the errors are {four} and {five}.",
    )


@claim("III, Table II", "each model's root mean square error is at most that of Table II")
def all_accurate(report: ReportData) -> Finding:
    """All models predict the side-slip angle accurately."""
    errors = {n: report.errors(NOMINAL, name).rmse_deg for n, name in report.models.items()}
    std_deg = report.scenario(NOMINAL)["truth"]["sideslip_std_deg"]
    return Finding(
        all(error <= math.hypot(*PAPER_TABLE_TWO[name]) for name, error in errors.items()),
        ", ".join(f"model {name} {degrees(error)}" for name, error in errors.items()),
        f"The angle itself has a standard deviation of {degrees(std_deg, 2)}. The paper does not "
        "state how it was driven; slower bends are easier.",
    )


@claim("III, Figure 1", f"one of them has the smallest error in all but one block of {BLOCK_S:g} s")
def best_but_for_a_section(report: ReportData) -> Finding:
    """But for a short section, models 4 and 5 predict best."""
    won = blocks_won(report.runs[NOMINAL], list(report.models.values()))
    by_model = dict(zip(report.models, won, strict=True))
    counts = ", ".join(f"model {name} in {times}" for name, times in by_model.items())
    return Finding(
        by_model["4"] + by_model["5"] >= sum(won) - 1,
        f"smallest error of {sum(won)} blocks: {counts}",
        "From model 2 on the errors are so close that chance decides a block.",
    )


@claim("III.A", "needs measurements of real sensors")
def sensor_quality(_: ReportData) -> Finding:
    """Inertial sensors and gyroscope are noisy; wheel speeds and steering are measured well."""
    return Finding(None, "", "Noise is an input of the simulation.")


@claim("III.A, Figure 3", f"the root mean square error grows by less than a factor of {SLIGHT}")
def noise_is_slight(report: ReportData) -> Finding:
    """More noise has only a slight effect on the prediction."""
    why = "The mean error moves, because the intercept contains the former biases."
    return close_to_nominal(report, "noise_doubled", why)


@claim("III.B, Figure 4", f"root mean square errors at both masses below {SLIGHT} times nominal")
def mass_is_insignificant(report: ReportData) -> Finding:
    """The mass has no significant influence."""
    errors = (
        f"{report.rmse(name)} at {number(report.scenario(name)['sprung_mass_kg'], 0)} kg"
        for name in ("mass_1000", NOMINAL, "mass_1740")
    )
    return Finding(
        change(report, "mass_1000", "mass_1740") < SLIGHT,
        ", ".join(errors),
        "The slip angles of tyres change with their load, and no signal measures the load.",
    )


@claim("III.C, Figure 5", f"root mean square error below {SLIGHT} times nominal")
def as_accurate_at_0_7(report: ReportData) -> Finding:
    """At an adhesion of 0.7 the model is as accurate as normally."""
    why = "In the fast bends the tyres are nearer to their limit, and slip more."
    return close_to_nominal(report, "adhesion_0_7", why)


@claim("III.C, Figure 5", f"correlation at least {MIN_CORRELATION} while the car is stable")
def appropriate_at_0_4(report: ReportData) -> Finding:
    """At 0.4 the model works appropriately but for one section."""
    inside, outside = (report.errors(SLIPPERY, side=side) for side in ("inside", "outside"))
    return Finding(
        outside.correlation >= MIN_CORRELATION,
        f"correlation {number(outside.correlation)} and root mean square error "
        f"{degrees(outside.rmse_deg)} while stable, {number(inside.correlation)} and "
        f"{degrees(inside.rmse_deg)} while not",
        "A car that slides over its front wheels turns no more when it is steered more. No "
        "training drive contains this.",
    )


@claim("III.C, Figure 5", "tyres slip beyond their peak there, and nowhere in the nominal drive")
def loses_stability(report: ReportData) -> Finding:
    """In that section the car loses its stability, being too fast for the adhesion."""
    truth, slippery = report.scenario(NOMINAL)["truth"], report.scenario(SLIPPERY)
    unstable = report.unstable_s(SLIPPERY)
    times = join_words([f"{begin:.0f}\N{EN DASH}{end:.0f} s" for begin, end in unstable])
    return Finding(
        bool(unstable) and not report.unstable_s(NOMINAL),
        f"unstable at {times}" if unstable else "stable throughout",
        f"The dry-road speeds need {number(truth['lateral_acceleration_p99_mps2'], 1)} m/s² (noise "
        f"included); this road gives {number(slippery['adhesion'] * GRAVITY_MPS2, 1)}.",
    )


@claim("III.C, Figure 5", f"root mean square error while stable below {SLIGHT} times nominal")
def accurate_elsewhere(report: ReportData) -> Finding:
    """In all other sections the model is accurate."""
    side = "outside" if report.unstable_s(SLIPPERY) else ""
    stable, nominal = report.errors(SLIPPERY, side=side).rmse_deg, report.errors(NOMINAL).rmse_deg
    return Finding(
        stable < SLIGHT * nominal,
        f"{degrees(stable)} while stable, {degrees(nominal)} on a dry road",
        "Tyres on a slippery road slip more for the same lateral acceleration.",
    )


@claim("III.D, Figure 7", f"root mean square error below {SLIGHT} times nominal")
def close_on_another_track(report: ReportData) -> Finding:
    """On another track the accuracy is close to normal."""
    why = "To the model a track is a mixture of speeds, steering and lateral accelerations."
    return close_to_nominal(report, "melbourne", why)


@claim(
    "III.D",
    f"root mean square error at most {ACCURATE} of the angle's standard deviation in all our "
    "further test drives with sound sensors",
)
def generally_able(report: ReportData) -> Finding:
    """The model is generally able to predict the side-slip angle."""
    shares = {
        drive["description"]: report.errors(name).rmse_deg / drive["truth"]["sideslip_std_deg"]
        for name, drive in report.scenarios.items()
        if drive["paper"] is None and not drive["failures"]
    }
    if not shares:
        raise NotEvaluatedError("drive beyond the paper")
    misses = [f"{name} ({number(share, 2)})" for name, share in shares.items() if share > ACCURATE]
    return Finding(
        not misses,
        f"in {len(shares) - len(misses)} of {len(shares)} drives",
        f"Not in: {'; '.join(misses) or 'none'}. A linear model ends where tyres are not linear.",
    )


@claim(
    "IV, Figure 8", f"a larger error on the nominal drive, p < {SIGNIFICANT}, as it is and tuned"
)
def filter_is_less_accurate(report: ReportData) -> Finding:
    """The Kalman filter is significantly less accurate than the regression."""
    tests = [compare_errors(report.runs[NOMINAL], report.choice, name) for name in DRAWN_FILTERS]
    plain, tuned = (
        f"{report.rmse(NOMINAL, name)} (p = {scientific(p, 1)})"
        for name, (_, p) in zip(DRAWN_FILTERS, tests, strict=True)
    )
    return Finding(
        all(t > 0 and p < SIGNIFICANT for t, p in tests),
        f"regression {report.rmse(NOMINAL)}, Kalman filter {plain}, tuned {tuned}",
        f"By a paired t test of squared errors over blocks of {BLOCK_S:g} s. Each fix corrects the "
        "filter by the true velocity.",
    )


@claim("IV", "together, a smaller root mean square over the test drives than either alone")
def commercial_vehicles(report: ReportData) -> Finding:
    """The method can be used in commercial vehicles together with the Kalman filter."""
    about = report.estimators.get("combination")
    if about is None:
        raise NotEvaluatedError("combination of model and filter")
    drives = [name for name, drive in report.scenarios.items() if drive["paper"]]
    together, model, filtered = (
        math.sqrt(sum(report.errors(drive, name).rmse_deg ** 2 for drive in drives) / len(drives))
        for name in ("combination", *about["of"])
    )
    return Finding(
        together < min(model, filtered),
        f"over {len(drives)} drives of the paper: together {degrees(together)}, the model "
        f"{degrees(model)}, the extended Kalman filter {degrees(filtered)}",
        "A simulation does not show use in series cars.",
    )


@claim("V", f"at most {MAX_MULTIPLICATIONS} coefficients")
def easily_implemented(report: ReportData) -> Finding:
    """The algorithm is easily implemented, with little computation on line."""
    signals, version = len(report.estimators[report.choice]["signals"]), report.version
    return Finding(
        signals <= MAX_MULTIPLICATIONS,
        f"an intercept and {signals} coefficients",
        f"The published model, {version.reference}, on board: {describe_costs(version)}.",
    )


@claim("V", f"no error above {SMALL_DEG}° in any of the paper's drives")
def guarantees_small_errors(report: ReportData) -> Finding:
    """The method can guarantee acceptably small errors."""
    errors = [
        (report.errors(name).error_max_deg, drive["description"])
        for name, drive in report.scenarios.items()
        if drive["paper"]
    ]
    if not errors:
        raise NotEvaluatedError("drive of the paper")
    largest_deg, drive = max(errors)
    return Finding(
        largest_deg <= SMALL_DEG,
        f"largest error {degrees(largest_deg, 1)} ({drive}); 99 % of the nominal drive within "
        f"{degrees(report.errors(NOMINAL).error_p99_deg, 2)}",
        "Least squares minimises the mean square over the training rows. It bounds no single "
        "error, and none in a situation beyond training.",
    )


@claim("V", "needs a vehicle")
def real_vehicle(_: ReportData) -> Finding:
    """The method is to be verified with a real test vehicle."""
    return Finding(None, "", "For measured drives: fleet-slip evaluate MODEL --cohort CONDITION.")


CLAIMS = tuple(value for value in globals().values() if isinstance(value, Claim))
"""In the paper's order."""


class Status(StrEnum):
    """Verdict on a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    NOT_TESTABLE = "not testable here"


class Verdict(NamedTuple):
    """A claim with its status, figures and reason."""

    claim: Claim
    status: Status
    figure: str
    why: str


def evaluate_claim(claim: Claim, report: ReportData) -> Verdict:
    """Evaluate a claim; it is not testable where the evaluation lacks a result."""
    if missing := [name for name in PAPER_TABLE_TWO if name not in report.models]:
        why = (
            f"The training drives lack signals of model {join_words(missing)} of Table I, to which "
            "the paper's statements refer."
        )
        return Verdict(claim, Status.NOT_TESTABLE, "", why)
    try:
        holds, figure, why = claim.find(report)
    except NotEvaluatedError as error:
        command = f"fleet-slip evaluate {report.version.reference} --compare NAME"
        holds, figure, why = None, "", f"The evaluation has no {error}. Run: {command}"
    status = {True: Status.REPRODUCED, False: Status.NOT_REPRODUCED, None: Status.NOT_TESTABLE}
    return Verdict(claim, status[holds], figure, why)
