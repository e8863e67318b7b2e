"""Published models of every kind of column, and drives of counts for them."""

from collections.abc import Collection, Mapping
from decimal import Decimal
from fractions import Fraction

import numpy as np
from hypothesis import strategies as st

from fleet_slip.catalog.definitions import (
    AttributeFactor,
    Blend,
    Combination,
    Definition,
    Equation,
    Gate,
    Observer,
    ParameterFactor,
    Product,
    Slope,
)
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.filter_column import observer_of
from fleet_slip.evaluation.identify import IdentifiedVehicle, vehicle_with_fit
from fleet_slip.export.files import export_files
from fleet_slip.export.program import Program
from fleet_slip.export.stepping import Sample
from fleet_slip.models.manifest import CombinedWithFilter, Manifest, ModelTerm
from fleet_slip.models.registry import ModelVersion
from fleet_slip.vehicle.parameters import VehicleMeasures
from fleet_slip.warehouse.warehouse import Warehouse
from tests.export.cars import Car
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.manifests import manifest


def export_texts(version: ModelVersion, warehouse: Warehouse | None, to: str) -> dict[str, str]:
    """The files of an export that consists of texts."""
    return {name: text.decode() for name, text in export_files(version, warehouse, to).items()}


COURSE = CATALOG.features["course_difference"]
SPEED = Definition(of="wheel_fl", over="mean", ticks=4, bits=16)
EVER = Definition(of="yaw_rate", over="running_mean", ratio=Fraction(16))

DEFINITIONS = {
    "mean_3": Definition(of="ay", over="mean", ticks=3, ratio=Fraction(16)),
    "mean_5": Definition(of="ay", over="mean", ticks=5, ratio=Fraction(1, 7), bits=16),
    "sum_4": Definition(of="ax", over="sum", ticks=4, ratio=Fraction(3, 2), bits=17),
    "lag_2": Definition(of="yaw_rate", over="lag", ticks=2),
    "ever": Definition(of="ay", over="running_mean", ratio=Fraction(16)),
    "change_mean": Definition(
        of="change", sql=COURSE.sql, of_bits=18, over="mean", ticks=2, ratio=Fraction(5)
    ),
    "heavy": Definition(
        of="ay",
        over="mean",
        ticks=2,
        fact=AttributeFactor(name="mass_kg", less=1320, ratio=Fraction(1, 100)),
        bits=18,
    ),
    "of_suv": Definition(of="ax", fact=AttributeFactor(name="vehicle_model", equals="suv")),
    "below": Definition(
        of="ay",
        over="mean",
        ticks=3,
        ratio=Fraction(16),
        gate=Gate(by=SPEED, low=-3, peak=500, high=1501),
    ),
    "heavy_above": Definition(
        of="ay",
        over="mean",
        ticks=2,
        fact=AttributeFactor(name="mass_kg", less=1320, ratio=Fraction(1, 100)),
        bits=18,
        gate=Gate(by=Definition(of="change", sql=COURSE.sql, of_bits=18), low=-2000, peak=3),
    ),
    "offset": Definition(
        of="wheel_rl",
        over="mean",
        ticks=2,
        number=ParameterFactor(name="yaw_rate_offset", grain=Decimal("0.00000625"), running=EVER),
    ),
    "radius": Definition(
        of="ay", number=ParameterFactor(name="speed_ratio", grain=Decimal("0.0005"), less=2000)
    ),
    "tyres": Definition(
        of="ay",
        number=ParameterFactor(name="understeer", grain=Decimal("0.00002"), less=-7, alone=True),
    ),
}

LINE = Definition(
    of="line",
    made=Combination(
        intercept=-700,
        terms=((3000, DEFINITIONS["mean_3"]), (-20000, DEFINITIONS["below"])),
        divisor=2**10,
    ),
)
SPEED_NOW = Definition(of="wheel_fl", bits=16)
PACE = Definition(of="pace", made=Product(of=(SPEED_NOW, LINE), ratio=Fraction(1, 1000)))
CHANGES = tuple(
    Definition(
        of=first_stage.of,
        made=first_stage.made,
        of_bits=first_stage.of_bits,
        over="change",
        ticks=ticks,
        bits=16,
    )
    for first_stage in (PACE, LINE)
    for ticks in (2, 5)
)
SLOPE = Definition(
    of="slope",
    made=Slope(
        equations=(
            Equation(y=CHANGES[0], x=(CHANGES[2], 3000, SPEED_NOW)),
            Equation(y=CHANGES[1], x=(CHANGES[3], -7000, SPEED_NOW), weight=Fraction(2, 5)),
        ),
        ridge=(5000, 2**20, 1),
        ratio=Fraction(700, 3),
    ),
)
LEARNING = {
    "line": LINE,
    "pace_2": CHANGES[0],
    "slope": SLOPE,
    "slope_above": SPEED.model_copy(update={"gate": Gate(by=SLOPE, low=-90, peak=7)}),
    "one_below": Definition(
        of="one", made=Product(of=(), ratio=Fraction(9)), gate=Gate(by=SLOPE, low=-99, peak=-9)
    ),
}
"""Columns that are computed from columns, and that learn in the car."""


def model_of(
    coefficients: Mapping[str, Fraction], intercept: Fraction = Fraction(0), name: str = "sideslip"
) -> Manifest:
    """A manifest of columns of `DEFINITIONS`, of features of 16 bits and of signals."""
    terms = tuple(_term(first_stage, value) for first_stage, value in coefficients.items())
    return manifest(name=name).model_copy(
        update={"terms": terms, "intercept": float(intercept), "intercept_exact": intercept}
    )


def _term(name: str, coefficient: Fraction) -> ModelTerm:
    signal = SIGNALS.signals.get(name)
    feature = CATALOG.features.get(name)
    return ModelTerm(
        signal=name,
        column=signal.column if signal else name,
        unit="1",
        scale=signal.scale if signal else Decimal("0.001"),
        sql=feature.sql if feature else "",
        definition=None if signal or feature else (DEFINITIONS | LEARNING)[name],
        coefficient=float(coefficient),
        coefficient_exact=coefficient,
    )


@st.composite
def cars(draw: st.DrawFn) -> Car:
    """A car of which anything may be known, or nothing."""
    mass = draw(st.sampled_from([None, 1320.0, 1320.5, 1999.4, 900.0, 1e9, float("nan")]))
    facts = {"mass_kg": mass, "vehicle_model": draw(st.sampled_from([None, "suv", "van"]))}
    number = st.sampled_from([-32767, -3, 0, 2000, 32767])
    names = draw(st.sets(st.sampled_from(["yaw_rate_offset", "speed_ratio", "understeer"])))
    return Car(facts, {name: draw(number) for name in sorted(names)})


SMALL = Fraction(1, 10**4)
MODELS: Mapping[str, Mapping[str, Fraction]] = {
    "every_kind": {name: SMALL * (-1) ** i for i, name in enumerate(DEFINITIONS)},
    "learning": {name: SMALL * (-1) ** i for i, name in enumerate(LEARNING)},
    "signals": {"ay": Fraction(1, 3), "yaw_rate": Fraction(-22, 7)},
    "features": {"curvature": Fraction(1, 3), "ay_signed_square": SMALL},
    "a_lag": {"lag_2": Fraction(1)},
    "numbers_alone": {"tyres": SMALL, "radius": SMALL},
}
CARS = (
    Car({}, {}),
    Car({"mass_kg": 1320.5, "vehicle_model": "suv"}, {"yaw_rate_offset": -32767}),
    Car({"mass_kg": 1e9, "vehicle_model": "van"}, {"speed_ratio": 2003, "understeer": 32767}),
    Car({"mass_kg": 900.0}, {"yaw_rate_offset": 3, "speed_ratio": -5, "understeer": 0}),
)


def hostile_drive(program: Program, ticks: int, seed: int) -> list[Sample]:
    """Counts anywhere in 16 bits, in and beyond the ranges, with holes; long calm parts."""
    random = np.random.default_rng(seed)
    width = len(program.signals)
    counts = random.integers(-(2**15), 2**15, (ticks, width))
    calm = random.random(ticks) < 0.7
    counts[calm] //= 40
    ends = random.random((ticks, width)) < 0.1
    counts[ends] = random.choice([-32768, -30000, 30000, 32767, 0, 1, -1], ends.sum())
    counts[np.repeat(random.random(ticks // 10 + 1) < 0.1, 10)[:ticks]] = -32768
    counts[: ticks // 5] = np.clip(counts[: ticks // 5], 20_000, 30_000)  # sums at their largest
    return [tuple(None if count == -32768 else count for count in row) for row in counts.tolist()]


LONGEST = "n" + "_" * 39 + "1"
TEXTS = ("a-b", "a.b", "a_b_2", "A_B", "-" * 60, "." * 60)
"""Facts whose names are the same, once they are names of C."""


def hostile_version() -> ModelVersion:
    plain_model = model_of({"ay": Fraction(1, 3), "of_suv": Fraction(1, 700)}, name=LONGEST)
    signal, suv = plain_model.terms
    facts = [
        Definition(of="ax", fact=AttributeFactor(name="vehicle_model", equals=text))
        for text in TEXTS
    ]
    terms = [
        suv.model_copy(update={"signal": f"f{i}", "column": f"f{i}", "definition": fact})
        for i, fact in enumerate(facts)
    ]
    manifest = plain_model.model_copy(update={"terms": (signal, *terms)})
    return ModelVersion(1, manifest, "0123" * 16, CATALOG)


# Combinations of a line and a filter.

CAR = VehicleMeasures(name="car", mass_kg=1480, front_axle_m=1.11, rear_axle_m=1.67)
FRONT = CAR.model_copy(update={"front_drive_share": 0.0})

WITHOUT_STEER = [name for name in SIGNALS.signals if not name.startswith("steer_f")]
WITHOUT_AX = [name for name in SIGNALS.signals if name != "ax"]


def _observer(measures: VehicleMeasures, logged: Collection[str], *, one_speed: bool) -> Observer:
    vehicle = IdentifiedVehicle(vehicle_with_fit(measures), ekf.EkfNoise(), 0.0)
    return observer_of(vehicle, SIGNALS, logged, one_speed=one_speed)


OBSERVERS: dict[str, Observer] = {
    "rear": _observer(CAR, SIGNALS.signals, one_speed=False),
    "front": _observer(FRONT, SIGNALS.signals, one_speed=False),
    "one_speed": _observer(CAR, WITHOUT_STEER, one_speed=True),
    "no_ax": _observer(CAR, WITHOUT_AX, one_speed=True),
}

ESTIMATE = Definition(
    of="line_estimate",
    made=Combination(
        intercept=7, terms=((-9, Definition(of="ay", over="mean", ticks=3)),), divisor=16
    ),
)


def filtered(observer: Observer) -> Definition:
    return Definition(of="filter_estimate", made=observer, of_bits=20)


BLENDS: dict[str, Blend] = {
    "alone": Blend(filter=filtered(OBSERVERS["rear"])),
    "constant": Blend(
        filter=filtered(OBSERVERS["one_speed"]), line=ESTIMATE, shares=(27_000,), limits=(300,)
    ),
    "by_lateral": Blend(
        filter=filtered(OBSERVERS["front"]),
        line=ESTIMATE,
        shares=(60_000, 27_000, 0, 65_536),
        limits=(300, 2000, 0, 90_000),
        lateral=Definition(of="ay", over="mean", ticks=32),
        knots=(0, 300, 600, 900),
    ),
    "line": Blend(
        filter=filtered(OBSERVERS["no_ax"]),
        line=ESTIMATE,
        anchor="line",
        shares=(60_000, 27_000),
        limits=(300, 2000),
        lateral=Definition(of="ay", over="mean", ticks=32),
        knots=(0, 300),
    ),
}


def model_with(blend: Blend, name: str = "sideslip") -> Manifest:
    definition = Definition(of="combined", made=blend, of_bits=20)
    term = ModelTerm(
        signal="combined_with_filter",
        column="sideslip_rad",
        unit="rad",
        scale=Decimal(1) / 2**16,
        definition=definition,
        signal_scales={name: SIGNALS[name].scale for name in definition.signals},
        coefficient=1.0,
        coefficient_exact=Fraction(1),
    )
    combination = CombinedWithFilter(
        method="constant", term=term, rmse_deg={}, worst_rmse_deg={}, groups=1, measures=CAR
    )
    line = model_of({"ay": Fraction(1, 700)}, name=name)
    return line.model_copy(update={"combination": combination})


def version_of(name: str) -> ModelVersion:
    """A version of a model of `MODELS` or `BLENDS`, of the same name."""
    manifest = (
        model_with(BLENDS[name], name)
        if name in BLENDS
        else model_of(MODELS[name], Fraction(-1, 700), name)
    )
    return ModelVersion(1, manifest, "0123" * 16, CATALOG)
