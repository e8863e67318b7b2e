"""A filter as a column: the same bits everywhere, near the filter in floating point, bounded."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.definitions import Observer
from fleet_slip.columns.drive_columns import ColumnPlan, DriveCounts, as_counts, compute_columns
from fleet_slip.columns.lowering import Lowering, largest_in, ranges_of
from fleet_slip.columns.observer import ANGLE_RAD
from fleet_slip.errors import RefusedError
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.evaluated_drives import LabelledDrive
from fleet_slip.evaluation.filter_column import observer_of
from fleet_slip.evaluation.identify import (
    NOISE_NAMES,
    PRIOR_STD,
    Coordinates,
    FitParameters,
    IdentifiedVehicle,
    vehicle_with_fit,
)
from fleet_slip.export.c import count_costs
from fleet_slip.export.files import export_files, program_content
from fleet_slip.export.program import Program
from fleet_slip.export.stepping import (
    Estimator,
    Sample,
    angles_by_kernel,
    compile_program,
    make_checks,
)
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import ModelVersion
from fleet_slip.vehicle.parameters import VehicleMeasures
from tests.export import plain
from tests.export.models import (
    BLENDS,
    CAR,
    FRONT,
    OBSERVERS,
    WITHOUT_AX,
    WITHOUT_STEER,
    filtered,
    hostile_drive,
    model_with,
)
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.drives import simulated_drive


def by_stepping(manifest: Manifest, program: Program, samples: Sequence[Sample]) -> list[float]:
    estimator = Estimator(CATALOG, manifest)
    angles = []
    for sample in samples:
        pairs = zip(program.signals, sample, strict=True)
        angle = estimator.step(
            {s.column: None if n is None else float(n * s.scale) for s, n in pairs}
        )
        angles.append(np.nan if angle is None else angle)
    return angles


simulated = cache(simulated_drive)


def counts_of(labelled: LabelledDrive, observer: Observer) -> DriveCounts:
    names = sorted({name for column in observer.columns for name in column.signals})
    return as_counts(SIGNALS, vars(labelled.signals), names, {})


def estimate(observer: Observer, counts: DriveCounts) -> FloatArray:
    plan = ColumnPlan.from_definitions(["angle"], {}, {"angle": filtered(observer)})
    angle_rad: FloatArray = compute_columns(plan, counts)[0] / 2**16
    return angle_rad


@pytest.mark.parametrize("name", ["rear", "front"])
def test_integers_are_near_the_filter_in_floating_point(name: str) -> None:
    labelled, measures = simulated(), CAR if name == "rear" else FRONT
    expected = ekf.estimate(labelled.signals, vehicle_with_fit(measures), ekf.EkfNoise())
    estimates = estimate(OBSERVERS[name], counts_of(labelled, OBSERVERS[name]))
    error = np.degrees(estimates - expected)[np.isfinite(estimates)]
    assert len(error) > 0.95 * len(expected)
    limit = 0.003 if name == "rear" else 0.03  # both front wheels as one
    assert np.sqrt(np.mean(error**2)) < limit < 0.05 * np.degrees(expected.std())


@pytest.mark.parametrize("name", BLENDS)
def test_kernel_estimator_and_document_agree_on_hostile_drives(name: str) -> None:
    manifest = model_with(BLENDS[name])
    program = compile_program(CATALOG, manifest)
    samples = hostile_drive(program, 250, 1)
    angles = angles_by_kernel(SIGNALS, manifest, program, {}, {}, samples)
    assert plain.angles(program_content(program), [], [], samples) == angles
    stepped = by_stepping(manifest, program, samples)
    scale = float(program.angle.scale)
    exact = [np.nan if a is None else a * scale for a in angles]
    assert np.allclose(stepped, exact, rtol=0, atol=scale, equal_nan=True)
    assert sum(angle is not None for angle in angles) > 100


def test_sql_is_refused_with_the_reason() -> None:
    version = ModelVersion(1, model_with(BLENDS["constant"]), "0" * 64, CATALOG)
    with pytest.raises(RefusedError, match="recursion over the ticks"):
        export_files(version, None, "sql")


def test_costs_stay_within_a_small_controller() -> None:
    costs = count_costs(compile_program(CATALOG, model_with(BLENDS["alone"])))
    assert costs.multiplications <= 600
    assert costs.divisions <= 60
    assert costs.memory_bytes <= 3000


def test_vectors_contain_the_states() -> None:
    manifest = model_with(BLENDS["constant"])
    program = compile_program(CATALOG, manifest)
    states = make_checks(CATALOG, manifest, program)[0].states
    assert {len(row) for row in states} == {len(program.states)}
    assert any(states[-1])


def test_no_number_overflows_in_any_car() -> None:
    random = np.random.default_rng(1)
    names = [*PRIOR_STD, *NOISE_NAMES]
    coordinates = Coordinates(FitParameters(), names)
    low, high = np.clip(coordinates.bounds, -6, 6)
    for trial in range(25):
        x = random.choice([0.0, 1.0, random.random()], len(names)) * (high - low) + low
        fit = coordinates.parameters(x)
        measures = VehicleMeasures(
            name="car",
            mass_kg=float(random.choice([400.0, 5000.0])),
            front_axle_m=float(random.uniform(0.5, 3)),
            rear_axle_m=float(random.uniform(0.5, 3)),
            height_m=float(random.uniform(0.2, 1.5)),
            front_drive_share=float(random.choice([0.0, 1.0])),
        )
        vehicle = IdentifiedVehicle(vehicle_with_fit(measures, fit), fit.noise, 0.0)
        logged = (SIGNALS.signals, WITHOUT_AX, WITHOUT_STEER)[trial % 3]
        observer = observer_of(vehicle, SIGNALS, logged, one_speed=trial % 2 == 0)
        signals = sorted({name for column in observer.columns for name in column.signals})
        lowered, _ = Lowering.from_columns(signals, [filtered(observer)])
        steps = tuple(lowered.steps)
        limits = [(SIGNALS[name].min_count, SIGNALS[name].max_count) for name in signals]
        ranges = ranges_of(steps, {"signal": limits})
        for number, step in enumerate(steps):
            assert largest_in(step, number, ranges) < 2**63
            if step.name == "nearest":
                assert ranges[step.operands[1]][0] > 0
            if step.name == "next":
                value, state = step.operands
                limit = steps[state].plain[1]
                assert -limit <= ranges[value][0] <= ranges[value][1] <= limit


NOISE = np.random.default_rng(7).uniform(-200, 200, 300)
Fault = Callable[[str, FloatArray], Any]
FAULTS: dict[str, Fault] = {
    "missing wheels": lambda name, values: np.nan if "wheel" in name else values,
    "nothing": lambda name, values: np.nan,
    "frozen yaw rate": lambda name, values: values[0] if "yaw_rate" in name else values,
    "standstill": lambda name, values: values if name.startswith("steer") else 0.0,
    "reverse": lambda name, values: -5.0 if name.startswith("wheel") else values,
    "spin": lambda name, values: {"yaw": 3.0, "ay_": -4.0}.get(name[:3], values),
    "one wheel on ice": lambda name, values: 1.7 * values if "wheel_rl" in name else 0.1 * values,
    "noise": lambda name, values: np.roll(NOISE, len(name)),
}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=[*FAULTS])
@pytest.mark.parametrize("name", OBSERVERS)
def test_recovers_from_faults_and_never_exceeds_its_limit(name: str, fault: Fault) -> None:
    labelled, observer = simulated(), OBSERVERS[name]
    undisturbed = estimate(observer, counts_of(labelled, observer))
    signals = {key: values.copy() for key, values in vars(labelled.signals).items()}
    for key, values in signals.items():
        values[1000:1300] = fault(key, values[1000:1300])
        column = next((s for s in SIGNALS.signals.values() if s.column == key), None)
        if column is not None:
            scale = float(column.scale)
            inside = (values >= column.min_count * scale) & (values <= column.max_count * scale)
            values[~inside] = np.nan
    names = sorted({n for column in observer.columns for n in column.signals})
    disturbed = estimate(observer, as_counts(SIGNALS, signals, names, {}))
    assert np.nanmax(np.abs(disturbed)) <= ANGLE_RAD
    difference = np.degrees(np.abs(disturbed - undisturbed))[2300:]
    assert np.nanmax(difference) < 0.5
