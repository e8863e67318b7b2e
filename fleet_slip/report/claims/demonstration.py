"""Claims of section III: the models, and what noise, mass, adhesion and another track do."""

from fleet_slip.report.blocks import BLOCK_S, blocks_won
from fleet_slip.report.claims.claim import (
    CLOSE,
    SLIGHT_DEG,
    WELL,
    NotEvaluatedError,
    Verdict,
    claim,
    complete,
    known,
    not_testable,
    verdict,
)
from fleet_slip.report.data import ReportData
from fleet_slip.report.paper_tables import PAPER_TABLE_TWO
from fleet_slip.report.text import count, degrees, listed, number
from fleet_slip.simulation.sensors import SAMPLE_RATE_HZ

GRAVITY_MPS2 = 9.81
LAST_TWO = frozenset({"4", "5"})


@claim(
    "III",
    "More than 2 million instances at a sample time of 0.01 s",
    "more than 2 million rows at 100 Hz",
)
def two_million(data: ReportData) -> Verdict:
    """Count the training rows."""
    rows = data.trained.selection.cohort.rows
    return verdict(
        rows > 2_000_000 and SAMPLE_RATE_HZ == 100,
        f"{count(rows)} rows at {SAMPLE_RATE_HZ} Hz",
        "Simulated with our own vehicle model, not with CarSim.",
    )


@claim(
    "III, Table I",
    "The last two models have the best predictive accuracy",
    "models 4 and 5 have the highest correlations",
)
def last_two_best(data: ReportData) -> Verdict:
    """Rank the models by their cross-validated correlation."""
    selection = data.trained.selection
    ranked = sorted(selection.models, key=lambda model: model.correlation, reverse=True)
    winner = selection.winner.model
    return verdict(
        {model.name for model in ranked[:2]} == LAST_TWO,
        ", ".join(f"model {model.name} {number(model.correlation, 4)}" for model in ranked),
        f"The smallest model within one standard error of the best is model {winner.name}, with "
        f"{len(winner.signals)} signals: more signals gain less than chance could give.",
    )


@claim(
    "III, Table I",
    "Models 4 and 5 are exactly as accurate, as their steering angles are closely related",
    "equal correlations to the four digits of Table I",
)
def exactly_as_accurate(data: ReportData) -> Verdict:
    """Compare the correlations of models 4 and 5."""
    values = {model.name: model.correlation for model in data.trained.selection.models}
    if not values.keys() >= LAST_TWO:
        raise NotEvaluatedError("models 4 and 5")
    four, five = (data.evaluated.models[name] for name in ("4", "5"))
    stds = [known(data, "car_rear_drive_sedan", name).std_deg for name in (four, five)]
    return verdict(
        round(values["4"], 4) == round(values["5"], 4),
        f"{number(values['4'], 5)} and {number(values['5'], 5)}",
        "That holds for the steering ratio that they were trained with. In a sedan with another "
        f"one their errors are {degrees(stds[0])} and {degrees(stds[1])}: model 5 goes on "
        "measuring road wheel angles, model 4 does not.",
    )


@claim(
    "III, Table II",
    "All models predict the side-slip angle accurately",
    "each model's error standard deviation is at most that of Table II",
)
def all_accurate(data: ReportData) -> Verdict:
    """Compare Table II with the paper's."""
    stds = {
        name: known(data, "nominal", estimator).std_deg
        for name, estimator in data.evaluated.models.items()
    }
    truth = data.evaluated.scenarios["nominal"]["truth"]["sideslip_std_deg"]
    return verdict(
        all(std <= PAPER_TABLE_TWO[name][1] for name, std in stds.items()),
        ", ".join(f"model {name} {degrees(std)}" for name, std in stds.items()),
        f"The angle itself has a standard deviation of {degrees(truth, 2)}. How it was driven in "
        "the paper is not known; slower bends are easier.",
    )


@claim(
    "III, Figure 1",
    "But for a short section, models 4 and 5 predict best",
    f"one of them has the smallest error in all but one block of {BLOCK_S:g} s",
)
def best_but_for_a_section(data: ReportData) -> Verdict:
    """Count in how many blocks of the nominal drive each model is best."""
    stds = {
        name: known(data, "nominal", estimator).std_deg
        for name, estimator in data.evaluated.models.items()
    }
    won = blocks_won(data.runs["nominal"], list(data.evaluated.models.values()))
    wins = {name: won[estimator] for name, estimator in data.evaluated.models.items()}
    told = ", ".join(f"model {name} in {times}" for name, times in wins.items())
    near = [std for name, std in stds.items() if name != "1"]
    return verdict(
        sum(wins[name] for name in LAST_TWO) >= sum(wins.values()) - 1,
        f"smallest error of {sum(wins.values())} blocks: {told}",
        f"From model 2 on they differ by {degrees(max(near) - min(near))} in standard deviation, "
        "so that chance decides a block.",
    )


@claim(
    "III.A",
    "Inertial sensors and gyroscope are noisy; wheel speeds and steering are measured well",
    "needs measurements of real sensors",
)
def sensor_quality(_: ReportData) -> Verdict:
    """What sensors are like is an assumption here."""
    return not_testable(
        "Noise is an input of the simulation: the paper's figures for inertial sensors and "
        "gyroscope, and a small one for wheel speeds and steering."
    )


@claim(
    "III.A, Figure 3",
    "More noise has only a slight effect on the prediction",
    f"the error's standard deviation grows by less than {SLIGHT_DEG}°",
)
def noise_is_slight(data: ReportData) -> Verdict:
    """Compare the drives with initial and doubled noise."""
    before, after = known(data, "nominal"), known(data, "noise_doubled")
    first = data.evaluated.models["1"]
    bare = [known(data, name, first).std_deg for name in ("nominal", "noise_doubled")]
    return verdict(
        after.std_deg - before.std_deg < SLIGHT_DEG,
        f"from {degrees(before.std_deg)} to {degrees(after.std_deg)}; the mean moves by "
        f"{degrees(after.mean_deg - before.mean_deg, sign=True)}",
        "Steering carries most of the estimate, and its sensor is quiet. Model 1, which has none, "
        f"goes from {degrees(bare[0])} to {degrees(bare[1])}. The mean moves because the intercept "
        "has learned the old biases.",
    )


@claim(
    "III.B, Figure 4",
    "The mass has no significant influence",
    f"standard deviations within {SLIGHT_DEG}° of the nominal one at both masses",
)
def mass_is_insignificant(data: ReportData) -> Verdict:
    """Compare the light and the heavy car with the nominal one."""
    names = ("mass_1000", "nominal", "mass_1740")
    light, nominal, heavy = (known(data, name).std_deg for name in names)
    masses = [data.evaluated.scenarios[name]["sprung_mass_kg"] for name in names]
    return verdict(
        max(abs(light - nominal), abs(heavy - nominal)) < SLIGHT_DEG,
        ", ".join(
            f"{degrees(std)} at {mass:.0f} kg"
            for std, mass in zip((light, nominal, heavy), masses, strict=True)
        ),
        f"Slight in degrees, but up to {max(light, heavy) / nominal:.1f} times the nominal error: "
        "the slip angles of tyres change with their load, and no signal tells the load.",
    )


@claim(
    "III.C, Figure 5",
    "At an adhesion of 0.7 the model is as accurate as normally",
    f"standard deviation within {SLIGHT_DEG}° of the nominal one",
)
def as_accurate_at_0_7(data: ReportData) -> Verdict:
    """Compare the damp road with the dry one."""
    nominal, damp = known(data, "nominal"), known(data, "adhesion_0_7")
    return verdict(
        damp.std_deg - nominal.std_deg < SLIGHT_DEG,
        f"{degrees(damp.std_deg)} against {degrees(nominal.std_deg)}, correlation "
        f"{number(damp.correlation)} against {number(nominal.correlation)}",
        f"{damp.std_deg / nominal.std_deg:.1f} times the nominal error: in the fast bends the "
        "tyres are nearer to their limit, and slip more.",
    )


@claim(
    "III.C, Figure 5",
    "At 0.4 the model works appropriately but for one section",
    f"correlation at least {WELL} while the car is stable",
)
def appropriate_at_0_4(data: ReportData) -> Verdict:
    """Take the correlation outside of the unstable section."""
    inside, outside = (
        complete(
            data.evaluated.part("adhesion_0_4", data.choice, side, "unstable"),
            "unstable section at an adhesion of 0.4",
        )
        for side in ("inside", "outside")
    )
    return verdict(
        outside.correlation >= WELL,
        f"correlation {number(outside.correlation)} while stable, {number(inside.correlation)} "
        "while not",
        "The model knows steering and lateral acceleration; a car that slides over its front "
        "wheels is steered more and turns no more, which no training drive has shown.",
    )


@claim(
    "III.C, Figure 5",
    "In that section the car loses its stability, being too fast for the adhesion",
    "tyres slip beyond their peak there, and nowhere in the nominal drive",
)
def loses_stability(data: ReportData) -> Verdict:
    """Look where tyres slip beyond their peak."""
    known(data, "nominal")
    known(data, "adhesion_0_4")
    found = data.evaluated.stretches("adhesion_0_4", "unstable")
    told = listed([f"{begin:.0f}\N{EN DASH}{end:.0f} s" for begin, end in found])
    scenarios = data.evaluated.scenarios
    asked = scenarios["nominal"]["truth"]["lateral_acceleration_p99_mps2"]
    given = scenarios["adhesion_0_4"]["adhesion"] * GRAVITY_MPS2
    return verdict(
        bool(found) and not data.evaluated.stretches("nominal", "unstable"),
        f"unstable at {told}" if found else "stable throughout",
        f"The dry-road speeds ask for {asked:.1f} m/s² (noise included); this road gives "
        f"{given:.1f}. The section follows from the true motion of the tyres, not from the "
        "estimator's error.",
    )


@claim(
    "III.C, Figure 5",
    "In all other sections the model is accurate",
    f"standard deviation while stable within {SLIGHT_DEG}° of the nominal one",
)
def accurate_elsewhere(data: ReportData) -> Verdict:
    """Take the error outside of the unstable section."""
    outside = data.evaluated.part("adhesion_0_4", data.choice, "outside", "unstable")
    found = known(data, "adhesion_0_4") if outside is None else complete(outside, "stable section")
    nominal = known(data, "nominal")
    return verdict(
        found.std_deg - nominal.std_deg < SLIGHT_DEG,
        f"{degrees(found.std_deg)} while stable, {degrees(nominal.std_deg)} on a dry road",
        "The estimate follows the angle, but tyres on a slippery road slip more for the same "
        "lateral acceleration, most of all just before and after the unstable section.",
    )


@claim(
    "III.D, Figure 7",
    "On another track the accuracy is close to normal",
    f"correlation lower by at most {CLOSE}",
)
def close_on_another_track(data: ReportData) -> Verdict:
    """Compare Melbourne with the nominal drive."""
    nominal, there = known(data, "nominal"), known(data, "melbourne")
    return verdict(
        nominal.correlation - there.correlation <= CLOSE,
        f"correlation {number(there.correlation)} against {number(nominal.correlation)}, error "
        f"{degrees(there.std_deg)} against {degrees(nominal.std_deg)}",
        "To the model a track is a mixture of speeds, steering angles and lateral accelerations.",
    )


@claim(
    "III.D",
    "The model is generally able to predict the side-slip angle",
    f"correlation at least {WELL} in all our further test drives with sound sensors",
)
def generally_able(data: ReportData) -> Verdict:
    """Look at all drives beyond the paper in which nothing fails."""
    beyond = [
        (scenario["description"], known(data, name).correlation)
        for name, scenario in data.evaluated.scenarios.items()
        if scenario["paper"] is None and not scenario["failures"]
    ]
    if not beyond:
        raise NotEvaluatedError("drive beyond the paper")
    short = [f"{text} ({number(value)})" for text, value in beyond if value < WELL]
    return verdict(
        not short,
        f"in {len(beyond) - len(short)} of {len(beyond)} drives",
        f"Not in: {'; '.join(short)}. A linear model ends where tyres are no longer linear."
        if short
        else "None of them goes beyond where tyres are linear.",
    )


DEMONSTRATION = (
    two_million,
    last_two_best,
    exactly_as_accurate,
    all_accurate,
    best_but_for_a_section,
    sensor_quality,
    noise_is_slight,
    mass_is_insignificant,
    as_accurate_at_0_7,
    appropriate_at_0_4,
    loses_stability,
    accurate_elsewhere,
    close_on_another_track,
    generally_able,
)
"""In the paper's order."""
