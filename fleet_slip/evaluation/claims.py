"""The paper's claims in its order: each a function of a report's results.

The docstring is the statement of the paper. The decorator has its place in the paper, and the
criterion by which it counts as reproduced. The function returns whether that holds, the figures,
and the reason. A claim is not testable where `holds` is None or the evaluation lacks a drive.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from fleet_slip.evaluation.report_data import (
    BLOCK_S,
    DRAWN_FILTERS,
    PAPER_TABLE_TWO,
    ReportData,
    blocks_won,
    compare_errors,
)
from fleet_slip.export.costs import (
    COEFFICIENT_BYTES,
    describe_costs,
    dot_product_operations,
)
from fleet_slip.pages.page import count, degrees, join_words, number, percent, scientific
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ
from fleet_slip.vehicle.parameters import GRAVITY_MPS2

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

SIGNIFICANT = 0.05
SMALL_DEG = 1
"""Largest error that counts as acceptably small."""

NOMINAL = "nominal"
SLIPPERY = "adhesion_0_4"


class NotEvaluatedError(LookupError):
    """The evaluation lacks a drive or an estimator, which the message names."""


class Errors(NamedTuple):
    """The statistics that claims use; none is missing."""

    coverage: float
    correlation: float
    error_mean_deg: float
    rmse_deg: float
    error_p99_deg: float
    error_max_deg: float


@dataclass(frozen=True)
class ReportContext:
    """Results of a report that several claims use. All raise `NotEvaluatedError`."""

    data: ReportData

    def errors(self, scenario: str, estimator: str = "", side: str = "") -> Errors:
        """Return the errors of an estimator, by default the paper's choice, over a drive.

        Side `inside` or `outside` restricts them to the unstable section, or to the others.
        """
        name = estimator or self.data.choice
        statistics = self.data.evaluated.statistics(scenario, name, side, "unstable")
        if statistics is None or None in vars(statistics).values():
            section = "unstable section of " if side else ""
            raise NotEvaluatedError(f"{name} on the {section}drive {scenario}")
        return Errors(*(getattr(statistics, field) for field in Errors._fields))

    def rmse(self, scenario: str, estimator: str = "") -> str:
        """Return the RMSE of an estimator over a drive, in words."""
        return degrees(self.errors(scenario, estimator).rmse_deg)

    def change(self, *scenarios: str) -> float:
        """Return the largest RMSE over that of the nominal drive."""
        largest_deg = max(self.errors(name).rmse_deg for name in scenarios)
        return largest_deg / self.errors(NOMINAL).rmse_deg

    def scenario(self, name: str) -> Any:
        """Return the document of a scenario."""
        try:
            return self.data.evaluated.scenarios[name]
        except KeyError:
            raise NotEvaluatedError(f"drive {name}") from None

    def nominal_errors(self) -> dict[str, float]:
        """Return the RMSE of each model of Table I on the nominal drive."""
        models = self.data.evaluated.models.items()
        return {name: self.errors(NOMINAL, estimator).rmse_deg for name, estimator in models}

    @property
    def signals(self) -> int:
        """Number of signals of the paper's choice."""
        return len(self.data.evaluated.estimators[self.data.choice]["signals"])


class Finding(NamedTuple):
    """Result of a claim: `holds` (None if it cannot be tested), the figures, and the reason."""

    holds: bool | None
    figure: str
    why: str


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, the criterion for it, and the function that applies it."""

    place: str
    statement: str
    criterion: str
    find: Callable[[ReportContext], Finding]


def claim(place: str, criterion: str) -> Callable[[Callable[[ReportContext], Finding]], Claim]:
    """Make a claim of a function, whose docstring is the statement of the paper."""
    return lambda find: Claim(place, str(find.__doc__).rstrip("."), criterion, find)


@claim("Abstract", "a fleet-trained model beats the one-car model in most cases on other classes")
def many_vehicles(report: ReportContext) -> Finding:
    """Signals of many vehicles can be used to make the estimator."""
    nominal_model = report.scenario(NOMINAL)["vehicle_model"]
    rows = [
        row
        for row in report.data.evaluated.document.content["comparisons"]
        if report.scenario(row["scenario"])["vehicle_model"] != nominal_model
    ]
    if not rows:
        raise NotEvaluatedError("fleet-trained model on cars of other classes")
    change_deg = sum(row["fleet_rmse_deg"] - row["one_car_rmse_deg"] for row in rows) / len(rows)
    better = sum(row["better"] == row["fleet"] for row in rows)
    return Finding(
        better > len(rows) / 2,
        f"better in {better} of {len(rows)} cases; on average its root mean square error differs "
        f"by {degrees(change_deg, sign=True)}",
        "Loads, tyres and sensor biases of many cars average out in a fleet's coefficients. This "
        "costs accuracy in a car like the trained one, and gains it in a very different car.",
    )


@claim("Abstract", f"at most {MAX_MULTIPLICATIONS} multiplications an estimate")
def little_computation(report: ReportContext) -> Finding:
    """The mining is done off line, and an estimate on board takes little computation."""
    multiplications, additions = dot_product_operations(report.signals)
    return Finding(
        multiplications <= MAX_MULTIPLICATIONS,
        f"{multiplications} multiplications and {additions} additions of integers, "
        f"{COEFFICIENT_BYTES * report.signals} bytes of coefficients",
        "An estimate is one dot product. All training is done off line, from "
        f"{report.data.version.manifest.trained_on.drives} Gram rows.",
    )


@claim("I", "no learned rival is more accurate as it is")
def networks_are_hard(_: ReportContext) -> Finding:
    """Neural networks can be efficient, but are hard to implement and to train."""
    rivals = "Networks, trees and neuro-fuzzy rules on the same columns"
    return Finding(None, "", f"{rivals}: `python -m benchmarks.rivals` of the source tree.")


@claim("I", "no filter without GPS is more accurate than the fusion")
def needs_gps(report: ReportContext) -> Finding:
    """A precise Kalman filter can need a sensor fusion with accurate GPS."""
    without, fusion = (
        report.errors(NOMINAL, name).rmse_deg for name in ("ekf_class_tuned", "kalman_tuned")
    )
    return Finding(
        without >= fusion,
        f"an extended Kalman filter without GPS {degrees(without)}, the fusion with GPS "
        f"{degrees(fusion)}, the regression {report.rmse(NOMINAL)}",
        "A filter on the single-track model needs mass, geometry and tyres instead of GPS. On "
        f"softer tyres than assumed it has {report.rmse('tyres_soft', 'ekf_class_tuned')}, the "
        f"regression {report.rmse('tyres_soft')}.",
    )


@claim("I", "the Kalman filter's error grows in both")
def gps_is_lost(report: ReportContext) -> Finding:
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
def no_loss(report: ReportContext) -> Finding:
    """The signals used are on board and available without a loss in communication."""
    tunnel = report.errors("gps_tunnel")
    return Finding(
        tunnel.coverage == 1,
        f"{percent(tunnel.coverage)} of the tunnel drive has an estimate, error "
        f"{degrees(tunnel.rmse_deg)}",
        "All signals of the model are the car's own. A failing sensor does harm: see the drives "
        "with a signal stuck or missing.",
    )


@claim("II.B", "the subsets of the paper's own signals cannot all be compared")
def subsets_unfeasible(report: ReportContext) -> Finding:
    """All 2ᵏ subset models are unfeasible to compute as k grows."""
    orders = report.data.orders
    return Finding(
        orders.subsets != 2 ** len(orders.signals),
        f"all {orders.subsets} models of {len(orders.signals)} signals were compared for this page",
        "From a Gram matrix a subset costs a few additions. Many more signals would be unfeasible, "
        "but a car has no more.",
    )


@claim("II.B", "some order needs more signals than the best subset")
def order_is_crucial(report: ReportContext) -> Finding:
    """The order of the variables is crucial for nested models."""
    orders = report.data.orders
    sizes = ", ".join(f"{name} {size}" for name, size in orders.needed.items())
    return Finding(
        max(orders.needed.values()) > orders.best,
        f"signals needed to leave 0.1 % of the variance to the full model: {sizes}; best subset "
        f"{orders.best}",
        f"The order of the paper's list needs {orders.needed['declared']} signals, a good ranking "
        f"{min(orders.needed.values())}. (The authors of two criteria call them covariance "
        "inflation criterion, CIC, and risk inflation criterion, RIC.)",
    )


@claim("III", "more than 2 million rows at 100 Hz")
def two_million(report: ReportContext) -> Finding:
    """More than 2 million instances at a sample time of 0.01 s."""
    rows = report.data.trained.selection.cohort.rows
    return Finding(
        rows > 2_000_000 and SAMPLE_RATE_HZ == 100,
        f"{count(rows)} rows at {SAMPLE_RATE_HZ} Hz",
        "Simulated with our own vehicle model, not with CarSim.",
    )


@claim("III, Table I", "models 4 and 5 have the highest correlations")
def last_two_best(report: ReportContext) -> Finding:
    """The last two models have the best predictive accuracy."""
    selection = report.data.trained.selection
    ranked = sorted(selection.models, key=lambda model: model.correlation, reverse=True)
    winner = selection.winner
    why = f"No model with fewer signals comes near model {winner.best.name}."
    if winner.model is not winner.best:
        gap = next(gap for gap in winner.gaps if gap.model is winner.model)
        why = (
            f"Model {winner.model.name}, with {len(winner.model.signals)} signals, has an RMSE "
            f"that is larger by {gap}: {'real' if gap.is_significant else 'not real'}, and "
            "negligible."
        )
    return Finding(
        sorted(model.name for model in ranked[:2]) == ["4", "5"],
        ", ".join(f"model {model.name} {number(model.correlation, 4)}" for model in ranked),
        why,
    )


@claim("III, Table I", "equal correlations to four digits, with wheel angles that are measured")
def exactly_as_accurate(report: ReportContext) -> Finding:
    """Models 4 and 5 are exactly as accurate, as their steering angles are closely related."""
    models, trained = report.data.evaluated.models, report.data.trained.selection.models
    correlation = {model.name: number(model.correlation, 5) for model in trained}
    sedan = [report.rmse("car_rear_drive_sedan", models[name]) for name in ("4", "5")]
    return Finding(
        None,
        "",
        f"Here they have {correlation['4']} and {correlation['5']}, but that is no reproduction. "
        "The simulated wheel angles are functions of the steering wheel's, without compliance, "
        "lash or error. In a sedan with another steering ratio the errors are "
        f"{sedan[0]} and {sedan[1]}.",
    )


@claim("III, Table II", "each model's root mean square error is at most that of Table II")
def all_accurate(report: ReportContext) -> Finding:
    """All models predict the side-slip angle accurately."""
    errors = report.nominal_errors()
    std_deg = report.scenario(NOMINAL)["truth"]["sideslip_std_deg"]
    return Finding(
        all(error <= math.hypot(*PAPER_TABLE_TWO[name]) for name, error in errors.items()),
        ", ".join(f"model {name} {degrees(error)}" for name, error in errors.items()),
        f"The angle itself has a standard deviation of {degrees(std_deg, 2)}. The paper does not "
        "state how it was driven; slower bends are easier.",
    )


@claim("III, Figure 1", f"one of them has the smallest error in all but one block of {BLOCK_S:g} s")
def best_but_for_a_section(report: ReportContext) -> Finding:
    """But for a short section, models 4 and 5 predict best."""
    errors, models = report.nominal_errors(), report.data.evaluated.models
    by_estimator = blocks_won(report.data.runs[NOMINAL], list(models.values()))
    won = {name: by_estimator[estimator] for name, estimator in models.items()}
    blocks, similar = sum(won.values()), [errors[name] for name in errors if name != "1"]
    counts = ", ".join(f"model {name} in {times}" for name, times in won.items())
    return Finding(
        won["4"] + won["5"] >= blocks - 1,
        f"smallest error of {blocks} blocks: {counts}",
        f"From model 2 on they differ by {degrees(max(similar) - min(similar))} in root mean "
        "square, so that chance decides a block.",
    )


@claim("III.A", "needs measurements of real sensors")
def sensor_quality(_: ReportContext) -> Finding:
    """Inertial sensors and gyroscope are noisy; wheel speeds and steering are measured well."""
    return Finding(None, "", "Noise is an input of the simulation.")


@claim("III.A, Figure 3", f"the root mean square error grows by less than a factor of {SLIGHT}")
def noise_is_slight(report: ReportContext) -> Finding:
    """More noise has only a slight effect on the prediction."""
    doubled, nominal = report.errors("noise_doubled"), report.errors(NOMINAL)
    ratio, first = report.change("noise_doubled"), report.data.evaluated.models["1"]
    return Finding(
        ratio < SLIGHT,
        f"from {degrees(nominal.rmse_deg)} to {degrees(doubled.rmse_deg)}, {number(ratio, 1)} "
        f"times; the mean moves by "
        f"{degrees(doubled.error_mean_deg - nominal.error_mean_deg, sign=True)}",
        "Steering, whose sensor is quiet, carries most of the estimate. Model 1, which has none, "
        f"goes from {report.rmse(NOMINAL, first)} to {report.rmse('noise_doubled', first)}. The "
        "mean moves because the intercept contains the former biases.",
    )


@claim("III.B, Figure 4", f"root mean square errors at both masses below {SLIGHT} times nominal")
def mass_is_insignificant(report: ReportContext) -> Finding:
    """The mass has no significant influence."""
    ratio = report.change("mass_1000", "mass_1740")
    errors = (
        f"{report.rmse(name)} at {number(report.scenario(name)['sprung_mass_kg'], 0)} kg"
        for name in ("mass_1000", NOMINAL, "mass_1740")
    )
    return Finding(
        ratio < SLIGHT,
        ", ".join(errors),
        f"Up to {number(ratio, 1)} times the nominal error: the slip angles of tyres change with "
        "their load, and no signal measures the load.",
    )


@claim("III.C, Figure 5", f"root mean square error below {SLIGHT} times nominal")
def as_accurate_at_0_7(report: ReportContext) -> Finding:
    """At an adhesion of 0.7 the model is as accurate as normally."""
    wet, nominal = report.errors("adhesion_0_7"), report.errors(NOMINAL)
    return Finding(
        report.change("adhesion_0_7") < SLIGHT,
        f"{degrees(wet.rmse_deg)} against {degrees(nominal.rmse_deg)}, correlation "
        f"{number(wet.correlation)} against {number(nominal.correlation)}",
        f"{number(report.change('adhesion_0_7'), 1)} times the nominal error: in the fast bends "
        "the tyres are nearer to their limit, and slip more.",
    )


@claim("III.C, Figure 5", f"correlation at least {MIN_CORRELATION} while the car is stable")
def appropriate_at_0_4(report: ReportContext) -> Finding:
    """At 0.4 the model works appropriately but for one section."""
    inside, outside, drive = (
        report.errors(SLIPPERY, side=side) for side in ("inside", "outside", "")
    )
    return Finding(
        outside.correlation >= MIN_CORRELATION,
        f"correlation {number(outside.correlation)} and root mean square error "
        f"{degrees(outside.rmse_deg)} while stable, {number(inside.correlation)} and "
        f"{degrees(inside.rmse_deg)} while not; the drive as a whole {number(drive.correlation)} "
        f"and {degrees(drive.rmse_deg)}",
        "A car that slides over its front wheels turns no more when it is steered more. No "
        "training drive contains this.",
    )


@claim("III.C, Figure 5", "tyres slip beyond their peak there, and nowhere in the nominal drive")
def loses_stability(report: ReportContext) -> Finding:
    """In that section the car loses its stability, being too fast for the adhesion."""
    truth, slippery = report.scenario(NOMINAL)["truth"], report.scenario(SLIPPERY)
    nominal, unstable = (
        report.data.evaluated.stretches(name, "unstable") for name in (NOMINAL, SLIPPERY)
    )
    times = join_words([f"{begin:.0f}\N{EN DASH}{end:.0f} s" for begin, end in unstable])
    return Finding(
        bool(unstable) and not nominal,
        f"unstable at {times}" if unstable else "stable throughout",
        f"The dry-road speeds need {number(truth['lateral_acceleration_p99_mps2'], 1)} m/s² (noise "
        f"included); this road gives {number(slippery['adhesion'] * GRAVITY_MPS2, 1)}. The section "
        "follows from the true motion of the tyres, not from the estimator's error.",
    )


@claim("III.C, Figure 5", f"root mean square error while stable below {SLIGHT} times nominal")
def accurate_elsewhere(report: ReportContext) -> Finding:
    """In all other sections the model is accurate."""
    is_unstable = report.data.evaluated.stretches(SLIPPERY, "unstable")
    stable = report.errors(SLIPPERY, side="outside" if is_unstable else "").rmse_deg
    nominal = report.errors(NOMINAL).rmse_deg
    return Finding(
        stable < SLIGHT * nominal,
        f"{degrees(stable)} while stable, {report.rmse(SLIPPERY)} as a whole, {degrees(nominal)} "
        "on a dry road",
        "The estimate follows the angle, but tyres on a slippery road slip more for the same "
        "lateral acceleration, most of all just before and after the unstable section.",
    )


@claim("III.D, Figure 7", f"root mean square error below {SLIGHT} times nominal")
def close_on_another_track(report: ReportContext) -> Finding:
    """On another track the accuracy is close to normal."""
    melbourne, nominal = report.errors("melbourne"), report.errors(NOMINAL)
    return Finding(
        report.change("melbourne") < SLIGHT,
        f"correlation {number(melbourne.correlation)} against {number(nominal.correlation)}, error "
        f"{degrees(melbourne.rmse_deg)} against {degrees(nominal.rmse_deg)}",
        "To the model a track is a mixture of speeds, steering angles and lateral accelerations.",
    )


@claim(
    "III.D",
    f"root mean square error at most {ACCURATE} of the angle's standard deviation in all our "
    "further test drives with sound sensors",
)
def generally_able(report: ReportContext) -> Finding:
    """The model is generally able to predict the side-slip angle."""
    shares = {
        drive["description"]: report.errors(name).rmse_deg / drive["truth"]["sideslip_std_deg"]
        for name, drive in report.data.evaluated.scenarios.items()
        if drive["paper"] is None and not drive["failures"]
    }
    if not shares:
        raise NotEvaluatedError("drive beyond the paper")
    misses = [f"{name} ({number(share, 2)})" for name, share in shares.items() if share > ACCURATE]
    return Finding(
        not misses,
        f"in {len(shares) - len(misses)} of {len(shares)} drives",
        f"Not in: {'; '.join(misses)}. A linear model ends where tyres are no longer linear."
        if misses
        else "None of them goes beyond where tyres are linear.",
    )


@claim(
    "IV, Figure 8", f"a larger error on the nominal drive, p < {SIGNIFICANT}, as it is and tuned"
)
def filter_is_less_accurate(report: ReportContext) -> Finding:
    """The Kalman filter is significantly less accurate than the regression."""
    choice, evaluated = report.data.choice, report.data.evaluated
    regression, *filters = (report.rmse(NOMINAL, name) for name in (choice, *DRAWN_FILTERS))
    run = report.data.runs[NOMINAL]
    tests = [compare_errors(run, choice, name) for name in DRAWN_FILTERS]
    plain, tuned = (
        f"{rmse} (p = {scientific(test.p, 1)})" for rmse, test in zip(filters, tests, strict=True)
    )
    why = (
        f"By a paired t test of squared errors over {tests[0].blocks} blocks of {BLOCK_S:g} s. "
        "Each fix corrects the filter by the true velocity."
    )
    outages = []
    for name, place in {"gps_urban": "between high buildings", "gps_tunnel": "in a tunnel"}.items():
        pair = [
            evaluated.statistics(name, estimator, "inside", "gps_outage")
            for estimator in ("kalman_tuned", choice)
        ]
        words = [degrees(statistics.rmse_deg) for statistics in pair if statistics]
        outages += [f"{place} {' against '.join(words)}"] if len(words) == 2 else []
    return Finding(
        all(test.t > 0 and test.p < SIGNIFICANT for test in tests),
        f"regression {regression}, Kalman filter {plain}, tuned {tuned}",
        f"{why} Without fixes the tuned filter has {join_words(outages)}." if outages else why,
    )


@claim("IV", "together, a smaller root mean square over the test drives than either alone")
def commercial_vehicles(report: ReportContext) -> Finding:
    """The method can be used in commercial vehicles together with the Kalman filter."""
    about = report.data.evaluated.estimators.get("combination")
    if about is None:
        raise NotEvaluatedError("combination of model and filter")
    names = ("combination", *about["of"])
    drives = [name for name, drive in report.data.evaluated.scenarios.items() if drive["paper"]]
    together, model, filtered = (
        math.sqrt(sum(report.errors(drive, name).rmse_deg ** 2 for drive in drives) / len(drives))
        for name in names
    )
    return Finding(
        together < min(model, filtered),
        f"over {len(drives)} drives of the paper: together {degrees(together)}, the model "
        f"{degrees(model)}, the extended Kalman filter {degrees(filtered)}",
        "The combination adds to the model a bounded share of the difference to the filter, by "
        "lateral acceleration. A simulation does not show use in series cars.",
    )


@claim("V", f"at most {MAX_MULTIPLICATIONS} coefficients")
def easily_implemented(report: ReportContext) -> Finding:
    """The algorithm is easily implemented, with little computation on line."""
    version = report.data.version
    return Finding(
        report.signals <= MAX_MULTIPLICATIONS,
        f"an intercept and {report.signals} coefficients",
        "It has no state, no matrix and no iteration. The published model, "
        f"{version.reference}, on board: {describe_costs(version)}.",
    )


@claim("V", f"no error above {SMALL_DEG}° in any of the paper's drives")
def guarantees_small_errors(report: ReportContext) -> Finding:
    """The method can guarantee acceptably small errors."""
    drives = report.data.evaluated.scenarios.items()
    errors = [
        (report.errors(name).error_max_deg, drive["description"])
        for name, drive in drives
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
def real_vehicle(_: ReportContext) -> Finding:
    """The method is to be verified with a real test vehicle."""
    command = "fleet-slip evaluate MODEL --cohort CONDITION"
    return Finding(None, "", f"The test drives are simulated. For measured drives: {command}.")


CLAIMS = tuple(value for value in globals().values() if isinstance(value, Claim))
"""In the paper's order."""


class Status(StrEnum):
    """Verdict on a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    NOT_TESTABLE = "not testable here"


@dataclass(frozen=True)
class Verdict:
    """A claim with its status, figures and reason."""

    claim: Claim
    status: Status
    figure: str
    why: str


def evaluate_claims(data: ReportData) -> tuple[Verdict, ...]:
    """Evaluate all claims."""
    return tuple(evaluate_claim(claim, data) for claim in CLAIMS)


def evaluate_claim(claim: Claim, data: ReportData) -> Verdict:
    """Evaluate a claim; it is not testable where the evaluation lacks a result."""
    holds, figure = None, ""
    if missing := [name for name in PAPER_TABLE_TWO if name not in data.evaluated.models]:
        why = (
            f"The training drives lack signals of model {join_words(missing)} of Table I, to which "
            "the paper's statements refer."
        )
    else:
        try:
            holds, figure, why = claim.find(ReportContext(data))
        except NotEvaluatedError as error:
            command = f"fleet-slip evaluate {data.evaluated.group} --compare NAME"
            why = f"The evaluation has no {error}. Run: {command}"
    status = {True: Status.REPRODUCED, False: Status.NOT_REPRODUCED, None: Status.NOT_TESTABLE}
    return Verdict(claim, status[holds], figure, why)
