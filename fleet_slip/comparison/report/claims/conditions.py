"""Claims of section III, A to D: what noise, mass, adhesion and another track do."""

from fleet_slip.comparison.report.claims.claim import (
    SLIGHT,
    WELL,
    NotEvaluatedError,
    Verdict,
    claim,
    complete,
    known,
    not_testable,
    require_known,
    verdict,
)
from fleet_slip.comparison.report.findings.report_data import ReportData
from fleet_slip.pages.text import degrees, listed, number

GRAVITY_MPS2 = 9.81

FOLLOWS = 0.9
"""Least correlation of an estimate that follows the angle; a part of a drive has no other scale."""


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
    f"the root mean square error grows by less than a factor of {SLIGHT:g}",
)
def noise_is_slight(data: ReportData) -> Verdict:
    """Compare the drives with initial and doubled noise."""
    before, after = known(data, "nominal"), known(data, "noise_doubled")
    first = data.evaluated.models["1"]
    bare = [known(data, name, first).rmse_deg for name in ("nominal", "noise_doubled")]
    return verdict(
        after.rmse_deg < SLIGHT * before.rmse_deg,
        f"from {degrees(before.rmse_deg)} to {degrees(after.rmse_deg)}, "
        f"{after.rmse_deg / before.rmse_deg:.1f} times; the mean moves by "
        f"{degrees(after.mean_deg - before.mean_deg, sign=True)}",
        "Steering carries most of the estimate, and its sensor is quiet. Model 1, which has none, "
        f"goes from {degrees(bare[0])} to {degrees(bare[1])}. The mean moves because the intercept "
        "has learned the old biases.",
    )


@claim(
    "III.B, Figure 4",
    "The mass has no significant influence",
    f"root mean square errors at both masses below {SLIGHT:g} times the nominal one",
)
def mass_is_insignificant(data: ReportData) -> Verdict:
    """Compare the light and the heavy car with the nominal one."""
    names = ("mass_1000", "nominal", "mass_1740")
    light, nominal, heavy = (known(data, name).rmse_deg for name in names)
    masses = [data.evaluated.scenarios[name]["sprung_mass_kg"] for name in names]
    return verdict(
        max(light, heavy) < SLIGHT * nominal,
        ", ".join(
            f"{degrees(rmse)} at {mass:.0f} kg"
            for rmse, mass in zip((light, nominal, heavy), masses, strict=True)
        ),
        f"Up to {max(light, heavy) / nominal:.1f} times the nominal error: the slip angles of "
        "tyres change with their load, and no signal tells the load.",
    )


@claim(
    "III.C, Figure 5",
    "At an adhesion of 0.7 the model is as accurate as normally",
    f"root mean square error below {SLIGHT:g} times the nominal one",
)
def as_accurate_at_0_7(data: ReportData) -> Verdict:
    """Compare the damp road with the dry one."""
    nominal, damp = known(data, "nominal"), known(data, "adhesion_0_7")
    return verdict(
        damp.rmse_deg < SLIGHT * nominal.rmse_deg,
        f"{degrees(damp.rmse_deg)} against {degrees(nominal.rmse_deg)}, correlation "
        f"{number(damp.correlation)} against {number(nominal.correlation)}",
        f"{damp.rmse_deg / nominal.rmse_deg:.1f} times the nominal error: in the fast bends the "
        "tyres are nearer to their limit, and slip more.",
    )


@claim(
    "III.C, Figure 5",
    "At 0.4 the model works appropriately but for one section",
    f"correlation at least {FOLLOWS} while the car is stable",
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
    whole = known(data, "adhesion_0_4")
    return verdict(
        outside.correlation >= FOLLOWS,
        f"correlation {number(outside.correlation)} and root mean square error "
        f"{degrees(outside.rmse_deg)} while stable, {number(inside.correlation)} and "
        f"{degrees(inside.rmse_deg)} while not; the drive as a whole {number(whole.correlation)} "
        f"and {degrees(whole.rmse_deg)}",
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
    require_known(data, "nominal", "adhesion_0_4")
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
    f"root mean square error while stable below {SLIGHT:g} times the nominal one",
)
def accurate_elsewhere(data: ReportData) -> Verdict:
    """Take the error outside of the unstable section."""
    outside = data.evaluated.part("adhesion_0_4", data.choice, "outside", "unstable")
    found = known(data, "adhesion_0_4") if outside is None else complete(outside, "stable section")
    nominal = known(data, "nominal")
    return verdict(
        found.rmse_deg < SLIGHT * nominal.rmse_deg,
        f"{degrees(found.rmse_deg)} while stable, {degrees(known(data, 'adhesion_0_4').rmse_deg)} "
        f"as a whole, {degrees(nominal.rmse_deg)} on a dry road",
        "The estimate follows the angle, but tyres on a slippery road slip more for the same "
        "lateral acceleration, most of all just before and after the unstable section.",
    )


@claim(
    "III.D, Figure 7",
    "On another track the accuracy is close to normal",
    f"root mean square error below {SLIGHT:g} times the nominal one",
)
def close_on_another_track(data: ReportData) -> Verdict:
    """Compare Melbourne with the nominal drive."""
    nominal, there = known(data, "nominal"), known(data, "melbourne")
    return verdict(
        there.rmse_deg < SLIGHT * nominal.rmse_deg,
        f"correlation {number(there.correlation)} against {number(nominal.correlation)}, error "
        f"{degrees(there.rmse_deg)} against {degrees(nominal.rmse_deg)}",
        "To the model a track is a mixture of speeds, steering angles and lateral accelerations.",
    )


@claim(
    "III.D",
    "The model is generally able to predict the side-slip angle",
    f"root mean square error at most {WELL:g} of the angle's standard deviation in all our further "
    "test drives with sound sensors",
)
def generally_able(data: ReportData) -> Verdict:
    """Look at all drives beyond the paper in which nothing fails."""
    beyond = [
        (
            scenario["description"],
            known(data, name).rmse_deg / scenario["truth"]["sideslip_std_deg"],
        )
        for name, scenario in data.evaluated.scenarios.items()
        if scenario["paper"] is None and not scenario["failures"]
    ]
    if not beyond:
        raise NotEvaluatedError("drive beyond the paper")
    short = [f"{text} ({number(share, 2)})" for text, share in beyond if share > WELL]
    return verdict(
        not short,
        f"in {len(beyond) - len(short)} of {len(beyond)} drives",
        f"Not in: {'; '.join(short)}. A linear model ends where tyres are no longer linear."
        if short
        else "None of them goes beyond where tyres are linear.",
    )


CONDITIONS = (
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
