"""A filter as a column: the same bits everywhere, near the filter in floating point, bounded."""

from collections.abc import Callable, Sequence
from decimal import Decimal
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.definitions import Blend, Combination, Definition, Observer
from fleet_slip.columns.drive_columns import ColumnPlan, DriveCounts, as_counts, compute_columns
from fleet_slip.columns.lowering import Lowering, largest_in, plain_of, ranges_of
from fleet_slip.columns.observer import ANGLE_RAD
from fleet_slip.errors import RefusedError
from fleet_slip.evaluation import ekf
from fleet_slip.evaluation.filter_column import observer_of
from fleet_slip.evaluation.identify import (
    NOISE_NAMES,
    PRIOR_STD,
    FitParameters,
    IdentifiedVehicle,
    vehicle_with_fit,
)
from fleet_slip.evaluation.single_track import LabelledDrive
from fleet_slip.evaluation.tuning import Coordinates
from fleet_slip.export.compile import (
    Sample,
    angles_by_kernel,
    checks_csv,
    compile_program,
    make_checks,
)
from fleet_slip.export.costs import count_costs
from fleet_slip.export.files import export_files, program_content, with_states
from fleet_slip.export.program import UNKNOWN_CAR, Program
from fleet_slip.export.stepping import Estimator
from fleet_slip.models.manifest import CombinedWithFilter, Manifest, ModelTerm
from fleet_slip.models.registry import ModelVersion
from fleet_slip.vehicle.parameters import VehicleMeasures
from tests.export import plain
from tests.export.compiled import SANITIZED, build_driver, can_sanitize, drive, needs_cc
from tests.export.engines import in_si, open_session, run_drives
from tests.export.fmus import Fmu, drive_fmu, run_fmpy, simulate_with_fmpy, unpack
from tests.export.models import hostile_drive, model_of
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.drives import simulated_drive

CAR = VehicleMeasures(name="car", mass_kg=1480, front_axle_m=1.11, rear_axle_m=1.67)
FRONT = CAR.model_copy(update={"front_drive_share": 0.0})

WITHOUT_STEER = [name for name in SIGNALS.signals if not name.startswith("steer_f")]
WITHOUT_AX = [name for name in SIGNALS.signals if name != "ax"]

OBSERVERS: dict[str, Observer] = {
    "rear": observer_of(
        IdentifiedVehicle(vehicle_with_fit(CAR), ekf.EkfNoise(), 0.0), SIGNALS, SIGNALS.signals,
        one_speed=False,
    ),
    "front": observer_of(
        IdentifiedVehicle(vehicle_with_fit(FRONT), ekf.EkfNoise(), 0.0), SIGNALS, SIGNALS.signals,
        one_speed=False,
    ),
    "one_speed": observer_of(
        IdentifiedVehicle(vehicle_with_fit(CAR), ekf.EkfNoise(), 0.0), SIGNALS, WITHOUT_STEER,
        one_speed=True,
    ),
    "no_ax": observer_of(
        IdentifiedVehicle(vehicle_with_fit(CAR), ekf.EkfNoise(), 0.0), SIGNALS, WITHOUT_AX,
        one_speed=True,
    ),
}  # fmt: skip

LINE = Definition(
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
        filter=filtered(OBSERVERS["one_speed"]), line=LINE, shares=(27_000,), limits=(300,)
    ),
    "by_lateral": Blend(
        filter=filtered(OBSERVERS["front"]),
        line=LINE,
        shares=(60_000, 27_000, 0, 65_536),
        limits=(300, 2000, 0, 90_000),
        lateral=Definition(of="ay", over="mean", ticks=32),
        knots=(0, 300, 600, 900),
    ),
    "line": Blend(
        filter=filtered(OBSERVERS["no_ax"]),
        line=LINE,
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
    found = estimate(OBSERVERS[name], counts_of(labelled, OBSERVERS[name]))
    error = np.degrees(found - expected)[np.isfinite(found)]
    assert len(error) > 0.95 * len(expected)
    limit = 0.003 if name == "rear" else 0.03  # both front wheels as one
    assert np.sqrt(np.mean(error**2)) < limit < 0.05 * np.degrees(expected.std())


@pytest.mark.parametrize("name", BLENDS)
def test_kernel_estimator_and_document_agree_on_hostile_drives(name: str) -> None:
    manifest = model_with(BLENDS[name])
    program = compile_program(CATALOG, manifest)
    samples = hostile_drive(program, 250, 1)
    angles = angles_by_kernel(SIGNALS, manifest, program, UNKNOWN_CAR, samples)
    assert plain.angles(program_content(program), [], [], samples) == angles
    stepped = by_stepping(manifest, program, samples)
    scale = float(program.angle.scale)
    exact = [np.nan if a is None else a * scale for a in angles]
    assert np.allclose(stepped, exact, rtol=0, atol=scale, equal_nan=True)
    assert sum(angle is not None for angle in angles) > 100


@needs_cc
@pytest.mark.parametrize("name", BLENDS)
def test_compiled_c_has_the_same_bits(name: str, tmp_path: Path) -> None:
    manifest = model_with(BLENDS[name])
    program = compile_program(CATALOG, manifest)
    options = SANITIZED if can_sanitize() else ()
    version = ModelVersion(1, manifest, "0" * 64, CATALOG)
    driver = build_driver(tmp_path, version, program, *options)
    for check in make_checks(SIGNALS, manifest, program):
        assert drive(driver, program, UNKNOWN_CAR, check.samples) == list(check.angles)
    samples = hostile_drive(program, 500, 3)
    expected = angles_by_kernel(SIGNALS, manifest, program, UNKNOWN_CAR, samples)
    assert drive(driver, program, UNKNOWN_CAR, samples) == expected


def fmu_of(version: ModelVersion) -> bytes:
    return export_files(version, None, "fmu")["sideslip_any_fmi2.fmu"]


@needs_cc
@pytest.mark.long
@pytest.mark.parametrize("name", BLENDS)
def test_an_fmu_gives_the_angles_of_its_vectors(name: str, tmp_path: Path) -> None:
    manifest = model_with(BLENDS[name]).model_copy(update={"name": "any"})
    program = compile_program(CATALOG, manifest)
    instance = Fmu(*unpack(fmu_of(ModelVersion(1, manifest, "0" * 64, CATALOG)), tmp_path))
    checks = make_checks(SIGNALS, manifest, program)
    for check in checks:
        assert drive_fmu(instance, program, UNKNOWN_CAR, check.samples) == list(check.angles)
    assert (tmp_path / "resources/checks.csv").read_text() == checks_csv(program, checks)
    samples = hostile_drive(program, 500, 5)
    expected = angles_by_kernel(SIGNALS, manifest, program, UNKNOWN_CAR, samples)
    assert drive_fmu(instance, program, UNKNOWN_CAR, samples) == expected


@needs_cc
@pytest.mark.tools("fmpy")
def test_fmpy_gives_the_angles_of_a_vector(tmp_path: Path) -> None:
    manifest = model_with(BLENDS["by_lateral"]).model_copy(update={"name": "any"})
    program = compile_program(CATALOG, manifest)
    file = tmp_path / "combined.fmu"
    file.write_bytes(fmu_of(ModelVersion(1, manifest, "0" * 64, CATALOG)))
    assert "No problems found" in run_fmpy("validate", str(file))
    complete = [
        check
        for check in make_checks(SIGNALS, manifest, program)
        if all(None not in sample for sample in check.samples)
    ]
    assert complete, "FMPy reads no missing values"
    columns = [signal.column for signal in program.signals]
    scales = [float(signal.scale) for signal in program.signals]
    for check in complete:
        rows = [
            [float(count or 0) * scale for count, scale in zip(sample, scales, strict=True)]
            for sample in check.samples
        ]
        found = simulate_with_fmpy(file, columns, rows, program.angle.column)
        angles = [round(rad / float(program.angle.scale)) for rad in found]
        assert angles == [count or 0 for count in check.angles]


def test_onnx_has_the_same_angles() -> None:
    manifest = model_with(BLENDS["by_lateral"])
    program = compile_program(CATALOG, manifest)
    samples = hostile_drive(program, 150, 4)
    session = open_session(ModelVersion(1, manifest, "0" * 64, CATALOG), "float64")
    found = run_drives(session, program, [UNKNOWN_CAR], in_si(program, samples, "float64")[None])
    expected = by_stepping(manifest, program, samples)
    assert np.allclose(found[0], expected, rtol=0, atol=1e-12, equal_nan=True)


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
    check = make_checks(SIGNALS, manifest, program)[0]
    version = ModelVersion(1, manifest, "0" * 64, CATALOG)
    states = with_states(version, program, check).states
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
            if step[0] == "nearest":
                assert ranges[plain_of(step)[1]][0] > 0
            if step[0] == "next":
                value, state = plain_of(step)
                limit = plain_of(steps[state])[1]
                assert -limit <= ranges[value][0] <= ranges[value][1] <= limit


Fault = Callable[[dict[str, FloatArray], slice], None]


def _missing_wheels(signals: dict[str, FloatArray], rows: slice) -> None:
    for name, values in signals.items():
        if name.startswith("wheel"):
            values[rows] = np.nan


def _nothing(signals: dict[str, FloatArray], rows: slice) -> None:
    for values in signals.values():
        values[rows] = np.nan


def _frozen_yaw_rate(signals: dict[str, FloatArray], rows: slice) -> None:
    signals["yaw_rate_rad_s"][rows] = signals["yaw_rate_rad_s"][rows.start]


def _standstill(signals: dict[str, FloatArray], rows: slice) -> None:
    for name, values in signals.items():
        if not name.startswith("steer"):
            values[rows] = 0.0


def _reverse(signals: dict[str, FloatArray], rows: slice) -> None:
    for name, values in signals.items():
        if name.startswith("wheel"):
            values[rows] = -5.0


def _spin(signals: dict[str, FloatArray], rows: slice) -> None:
    signals["yaw_rate_rad_s"][rows] = 3.0
    signals["ay_mps2"][rows] = -4.0
    signals["wheel_rl_rad_s"][rows] = 0.0


def _ice(signals: dict[str, FloatArray], rows: slice) -> None:
    signals["ay_mps2"][rows] *= 0.1
    signals["yaw_rate_rad_s"][rows] *= 0.2
    signals["wheel_rl_rad_s"][rows] *= 1.7


def _noise(signals: dict[str, FloatArray], rows: slice) -> None:
    random = np.random.default_rng(7)
    for values in signals.values():
        values[rows] = random.uniform(-1, 1, len(values[rows])) * 200


@pytest.mark.parametrize(
    "fault",
    [
        _missing_wheels, _nothing, _frozen_yaw_rate, _standstill, _reverse, _spin, _ice, _noise,
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", OBSERVERS)
def test_recovers_from_faults_and_never_exceeds_its_limit(name: str, fault: Fault) -> None:
    labelled, observer = simulated(), OBSERVERS[name]
    undisturbed = estimate(observer, counts_of(labelled, observer))
    signals = {key: values.copy() for key, values in vars(labelled.signals).items()}
    fault(signals, slice(1000, 1300))
    for key, values in signals.items():
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
