"""Drives to evaluate estimators on: of the logs with a label, and of simulated scenarios.

Segments of labelled drives are held out together: a drive and a quarter of its time. All four
quarters are a whole drive. Drives of scenarios have the exact truth.
"""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property
from itertools import pairwise
from typing import Annotated, Any, NamedTuple, Self

import duckdb
import numpy as np
import pyarrow as pa
from pydantic import Field, model_validator

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.base import Progress, no_progress
from fleet_slip.catalog.signals import SAMPLE_TIME_S, Identifier, SignalCatalog
from fleet_slip.config import Config, load_config
from fleet_slip.errors import QuestionError
from fleet_slip.evaluation.evaluator import MissingSignalError
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.compute import counts_of
from fleet_slip.grams.update import update_grams
from fleet_slip.models.predict import Predictor
from fleet_slip.quality.drive_signals import MOVING_MPS, RADIUS_M, SPEEDS, is_slow
from fleet_slip.resources import Configs
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.drive_plans import Drivers, FleetPlan, load_by_name
from fleet_slip.simulation.imperfections import NotNegative, Range, Uniform
from fleet_slip.simulation.roads import CLASSES, draw_road, random_generator
from fleet_slip.simulation.scenario import Failure, Scenario
from fleet_slip.simulation.sensors import GPS_SIGNALS, SAMPLE_RATE_HZ
from fleet_slip.simulation.simulate import (
    MOTION,
    SimulationReport,
    simulate_batches,
    simulate_logs,
)
from fleet_slip.vehicle.dynamics import brush_force
from fleet_slip.vehicle.parameters import VehicleParameters, constants
from fleet_slip.views import open_views
from fleet_slip.warehouse.database import reading_files
from fleet_slip.warehouse.warehouse import Warehouse

# Drives with a label, as filters and models read them: SI signals at 100 Hz, and counts.

STEP_S = float(SAMPLE_TIME_S)
"""Time Δt between two rows."""

QUARTERS = 4
SPEEDS_MPS = (8.0, 15.0, 25.0)
LATERAL_MPS2 = (1.0, 2.5, 4.0)
"""Limits between kinds of driving, by mean speed and by root mean square of ay."""

Segments = frozenset[tuple[str, int]]
"""Segments held out together: name of a drive, and quarter of its time from 0."""


@dataclass(frozen=True)
class DriveSignals:
    """One drive in float64, axes as in docs/conventions.md; NaN where nothing was measured."""

    ax_mps2: FloatArray
    ay_mps2: FloatArray
    yaw_rate_rad_s: FloatArray
    wheel_fl_rad_s: FloatArray
    wheel_fr_rad_s: FloatArray
    wheel_rl_rad_s: FloatArray
    wheel_rr_rad_s: FloatArray
    steer_fl_rad: FloatArray
    steer_fr_rad: FloatArray
    gps_vx_mps: FloatArray
    gps_vy_mps: FloatArray
    steering_wheel_rad: FloatArray

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.ax_mps2)

    @property
    def has_road_wheels(self) -> bool:
        """True if the angle of a front wheel is logged."""
        return bool(np.isfinite([self.steer_fl_rad, self.steer_fr_rad]).any())


@dataclass(frozen=True)
class LabelledDrive:
    """A drive with its side-slip angle, for evaluation and tuning.

    Attributes
    ----------
    name
        Identifier of the drive.
    signals
        Signals that filters read.
    sideslip_rad
        The label; NaN without it.
    car
        The car of this drive, as filters assume it; None for the car of all drives.
    rows
        Rows as logged, which models read.
    trip
        Trip of the drive: drives of one trip are held out together.
    """

    name: str
    signals: DriveSignals
    sideslip_rad: FloatArray
    car: VehicleParameters | None = None
    rows: pa.Table = field(default_factory=lambda: pa.table({}))
    trip: str = ""

    @property
    def evaluated(self) -> BoolArray:
        """Rows with a label."""
        return np.isfinite(self.sideslip_rad)

    @property
    def ay_mps2(self) -> FloatArray:
        """Lateral acceleration."""
        return self.signals.ay_mps2

    @cached_property
    def quarter(self) -> IntArray:
        """Quarter of the drive's time, by row."""
        return np.arange(len(self.signals)) * QUARTERS // len(self.signals)

    @cached_property
    def kind(self) -> str:
        """Kind of driving, by `SPEEDS_MPS` and `LATERAL_MPS2`."""
        signals = self.signals
        wheel = _first_logged(signals.wheel_rl_rad_s, signals.wheel_fl_rad_s)
        lateral = _first_logged(signals.ay_mps2)
        words = []
        if len(wheel):
            words.append(f"{_band(float(wheel.mean()) * RADIUS_M, SPEEDS_MPS)} m/s")
        if len(lateral):
            size = float(np.sqrt(np.mean(lateral**2)))
            words.append(f"ay {_band(size, LATERAL_MPS2)} m/s²")
        return ", ".join(words)

    def beginning(self, rows: int) -> "LabelledDrive":
        """Return the first rows."""
        arrays = {name: values[:rows] for name, values in vars(self.signals).items()}
        return replace(
            self,
            signals=DriveSignals(**arrays),
            sideslip_rad=self.sideslip_rad[:rows],
            rows=self.rows[:rows],
        )

    def rows_in(self, segments: Segments) -> BoolArray:
        """Return the mask of rows in segments."""
        return np.isin(self.quarter, [part for name, part in segments if name == self.name])

    def without(self, segments: Segments) -> "LabelledDrive":
        """Return the drive without the labels of segments."""
        label = np.where(self.rows_in(segments), np.nan, self.sideslip_rad)
        return replace(self, sideslip_rad=label)


def _first_logged(*signals: FloatArray) -> FloatArray:
    """Return the values of the first signal that has any."""
    values = [signal[np.isfinite(signal)] for signal in signals]
    return next((logged for logged in values if len(logged)), values[0])


def _band(value: float, edges: Sequence[float]) -> str:
    names = [f"below {edges[0]:g}"]
    names += [f"{lower:g} to {upper:g}" for lower, upper in pairwise(edges)]
    return [*names, f"above {edges[-1]:g}"][int(np.searchsorted(edges, value, side="right"))]


def read_drive(
    signals: SignalCatalog, database: duckdb.DuckDBPyConnection, name: str
) -> LabelledDrive:
    """Read a drive from the view `log`, without labels where the car `is_slow`.

    Raises `QuestionError` if there is no such drive.
    """
    label = signals[signals.label].column
    speeds = {key: signals[key].column for key in SPEEDS if key in signals.signals}
    read = [field.name for field in fields(DriveSignals)]
    columns = list(dict.fromkeys([*read, label, *speeds.values()]))
    with reading_files(database, f"reading the drive {name!r}"):
        rows = database.execute(
            f"SELECT {', '.join(columns)} FROM log WHERE drive_id = $drive ORDER BY time_s",
            {"drive": name},
        ).fetchnumpy()
    if not len(rows[label]):
        raise QuestionError(f"no drive is called {name!r}. The view drives lists them.")
    arrays = {key: np.ma.filled(rows[key].astype(np.float64), np.nan) for key in columns}
    slow = is_slow({key: arrays[column] for key, column in speeds.items()})
    sideslip_rad = np.where(slow, np.nan, arrays[label])
    return LabelledDrive(name, DriveSignals(**{key: arrays[key] for key in read}), sideslip_rad)


def read_drives(warehouse: Warehouse, names: Iterable[str]) -> list[LabelledDrive]:
    """Read drives with their rows as logged. Raises as `read_drive`."""
    query = "SELECT * FROM log_counts WHERE drive_id = $drive ORDER BY tick"
    with open_views(warehouse, "SELECT 1 FROM log, log_counts") as database:
        return [
            replace(
                read_drive(warehouse.catalog.signals, database, name),
                rows=database.sql(query, params={"drive": name}).to_arrow_table(),
            )
            for name in names
        ]


def predict_drive(model: Predictor, cars: CarCounts, drive: LabelledDrive) -> FloatArray:
    """Estimate a drive by a model, shape (rows,); `cars` are calibration parameters of cars."""
    numbers = cars.get(drive.rows["vehicle_id"][0].as_py())
    return model(counts_of(drive.rows, model.plan, None, numbers))


def hold_last(values: FloatArray, name: str) -> FloatArray:
    """Fill the gaps of a signal by the last value. Raises `MissingSignalError` without any."""
    valid = np.isfinite(values)
    if valid.all():
        return values
    if not valid.any():
        raise MissingSignalError(
            f"the drive has no {name}, which this estimator needs. Choose drives that have it, or "
            "another estimator."
        )
    latest = np.maximum.accumulate(np.where(valid, np.arange(len(values)), valid.argmax()))
    return values[latest]


# Drives of scenarios, with their signals and the exact truth.


@dataclass(frozen=True)
class TestDrive:
    """The drive of a scenario. Arrays have shape (ticks,).

    Attributes
    ----------
    scenario
        Car, road, driver and failures.
    time_s
        Time since the drive began.
    columns
        Signals that estimators may read, by SI column: the inputs of the catalog and satellite
        navigation; NaN where null.
    vx_mps, vy_mps
        True velocity of the centre of gravity.
    station_m
        Distance along the track within the lap.
    lateral_offset_m
        Distance from the track's centre line, positive to the left.
    lost_control_s
        Time at which the driver lost the car; None if he did not.
    """

    __test__ = False  # pytest collects classes of this name

    scenario: Scenario
    time_s: FloatArray
    columns: Mapping[str, FloatArray]
    vx_mps: FloatArray
    vy_mps: FloatArray
    station_m: FloatArray
    lateral_offset_m: FloatArray
    lost_control_s: float | None

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.scenario.name

    @property
    def vehicle_attributes(self) -> dict[str, Any]:
        """Vehicle model and stated mass, by drive column."""
        scenario = self.scenario
        return {"vehicle_model": scenario.vehicle.name, "mass_kg": scenario.car.body.sprung_mass_kg}

    @cached_property
    def signals(self) -> DriveSignals:
        """Signals that filters read."""
        names = (column.name for column in fields(DriveSignals))
        return DriveSignals(**{name: self.columns[name] for name in names})

    @property
    def ay_mps2(self) -> FloatArray:
        """Lateral acceleration as the car measures it."""
        return self.signals.ay_mps2

    @cached_property
    def sideslip_rad(self) -> FloatArray:
        """True side-slip angle arctan(vy / vx)."""
        return np.arctan2(self.vy_mps, self.vx_mps)

    @cached_property
    def speed_mps(self) -> FloatArray:
        """True speed."""
        return np.hypot(self.vx_mps, self.vy_mps)

    @cached_property
    def evaluated(self) -> BoolArray:
        """Rows on which the car moves forward, so that it has a side-slip angle."""
        return self.vx_mps > MOVING_MPS

    @cached_property
    def sections(self) -> dict[str, BoolArray]:
        """Rows, by the name of their `CRITERIA`, of sections with statistics of their own."""
        ticks = np.arange(len(self.time_s))
        fixes = np.isfinite(self.columns["gps_vx_mps"])
        last_fix = np.maximum.accumulate(np.where(fixes, ticks, 0))
        outage = (ticks - last_fix) > GPS_OUTAGE_S * SAMPLE_RATE_HZ
        sections = {"unstable": find_unstable(self), "gps_outage": outage}
        return {name: rows for name, rows in sections.items() if rows.any()}


GPS_OUTAGE_S = 1.0
"""Time without a fix after which satellite navigation counts as lost."""


def simulate_scenarios(
    warehouse: Warehouse,
    scenarios: Sequence[Scenario],
    executor: Executor,
    progress: Progress = no_progress,
) -> SimulationReport:
    """Write drives that are missing, and update Gram rows. Raises `RefusedError` if changed."""
    batches = {scenario.drive_id: scenario.batch() for scenario in scenarios}
    report = simulate_batches(warehouse, list(batches.values()), executor, progress)
    if report.changed:
        update_grams(warehouse)
    return report


def simulate_drives(signals: SignalCatalog, scenarios: Sequence[Scenario]) -> tuple[TestDrive, ...]:
    """Simulate the drives of scenarios with their failures; write nothing.

    Signals are those of the log, the truth is exact. A log quantises vy to 0.005 m/s, which at
    25 m/s is half the error of good estimates.
    """
    drives = {scenario.drive_id: scenario.batch().drives[0] for scenario in scenarios}
    logs = dict(zip(drives, simulate_logs(signals, list(drives.values()), MOTION), strict=True))
    tests = []
    for scenario in scenarios:
        log = logs[scenario.drive_id]
        time_s = np.arange(log.rows) / SAMPLE_RATE_HZ
        visible = {}
        for name in (*signals.inputs, *GPS_SIGNALS):  # never a truth
            values = log.measurement.counts[name] * float(signals[name].scale)
            missing = name in GPS_SIGNALS and ~log.measurement.gps_fix
            visible[name] = np.where(missing, np.nan, values)
        for failure in scenario.failures:
            visible = apply_failure(visible, time_s, failure)
        columns = {signals[name].column: values for name, values in visible.items()}
        lost_s = log.lost_control_s
        tests.append(TestDrive(scenario, time_s, columns, **log.motion, lost_control_s=lost_s))
    return tuple(tests)


def apply_failure(
    signals: Mapping[str, FloatArray], time_s: FloatArray, failure: Failure
) -> dict[str, FloatArray]:
    """Return signals, by name, as a car with the failure logs them.

    Raises `QuestionError` if the drive ends before the failure begins.
    """
    until_s = np.inf if failure.until_s is None else failure.until_s
    failed = (time_s >= failure.from_s) & (time_s < until_s)
    if not failed.any():
        raise QuestionError(
            f"the drive lasts {time_s[-1]:.1f} s, and its failure begins at {failure.from_s} s. "
            "Choose an earlier from_s."
        )
    changed = dict(signals)
    for name in failure.signals:
        value = signals[name][np.argmax(failed)] if failure.kind == "stuck" else np.nan
        changed[name] = np.where(failed, value, signals[name])
    return changed


# Where a car is unstable on a drive, and how far its axles slip.
#
# Past the slip at which its lateral force is largest, an axle gives less force the more it slips
# (Pacejka 2012, section 1.3). Slip angles follow from velocity, yaw rate and road wheel angles:
#
#     tan(alpha_rear) = (vy - b r) / vx,    alpha_front = arctan((vy + a r) / vx) - delta.

SMALLEST_GAP_S = 1.0
"""Unstable stretches with less time between them are one."""

PEAK_SPEED_MPS = 15.0
"""Rolling speed at which the peak is looked up; from 10 to 30 m/s it moves by a tenth."""

SLIPS = np.linspace(0.0, 0.5, 2001)

CRITERIA = {
    "unstable": "an axle's tyres slip beyond the peak of their lateral force (brush tyre, static "
    f"load, stretches less than {SMALLEST_GAP_S:g} s apart joined)",
    "gps_outage": f"more than {GPS_OUTAGE_S:g} s since the last fix of satellite navigation",
}
"""Sections of drives."""


class PeakSlip(NamedTuple):
    """Slip angles at which the axles' lateral forces are largest, in rad."""

    front_rad: float
    rear_rad: float


@cache
def peak_slip(vehicle: VehicleParameters, adhesion: float) -> PeakSlip:
    """Return the slip angles of the peaks, both wheels at their static load, without drive."""
    c = constants(vehicle, adhesion)

    def peak(load: float, stiffness: float) -> float:
        v = PEAK_SPEED_MPS
        forces = [abs(brush_force(v, slip * v, v, load, stiffness, c).y) for slip in SLIPS]
        return float(np.arctan(SLIPS[np.argmax(forces)]))

    return PeakSlip(peak(c.static_front, c.stiffness_front), peak(c.static_rear, c.stiffness_rear))


def find_unstable(drive: TestDrive) -> BoolArray:
    """Return the mask of ticks within an unstable stretch, shape (ticks,).

    The yaw rate is the gyroscope's, less the bias that the scenario states; where it is null there
    is no slip angle.
    """
    peak = peak_slip(drive.scenario.car, drive.scenario.adhesion)
    body, sensors = drive.scenario.car.body, drive.scenario.sensors
    yaw_rate = drive.columns["yaw_rate_rad_s"] - sensors.yaw_rate_bias_rad_s
    steer = (drive.columns["steer_fl_rad"] + drive.columns["steer_fr_rad"]) / 2
    front = np.arctan2(drive.vy_mps + body.front_axle_m * yaw_rate, drive.vx_mps) - steer
    rear = np.arctan2(drive.vy_mps - body.rear_axle_m * yaw_rate, drive.vx_mps)
    beyond = (np.abs(front) > peak.front_rad) | (np.abs(rear) > peak.rear_rad)
    return join(beyond & drive.evaluated, round(SMALLEST_GAP_S * SAMPLE_RATE_HZ))


def join(mask: BoolArray, gap: int) -> BoolArray:
    """Fill the gaps of a mask that are shorter than `gap` entries."""
    joined = mask.copy()
    for (_, end), (begin, _) in pairwise(_runs(mask)):
        if begin - end < gap:
            joined[end:begin] = True
    return joined


def find_stretches(drive: TestDrive, mask: BoolArray) -> list[dict[str, float]]:
    """Return the stretches of a drive on which a mask is true, in time and along the track."""
    return [
        {
            "from_s": float(drive.time_s[begin]),
            "until_s": float(drive.time_s[end - 1]),
            "from_m": float(drive.station_m[begin]),
            "until_m": float(drive.station_m[end - 1]),
        }
        for begin, end in _runs(mask)
    ]


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Return begin and end (exclusive) of each run of true entries."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


# Blind drives, which cannot be drawn before a model is published.
#
# Roads, cars, loads, tyres, weather, drivers and noise are drawn from the hash of the version under
# test, by configs/blind.toml.


class Weather(Config):
    """Adhesion of the road, and the share of it that drivers use."""

    adhesion: Uniform
    friction_use: Uniform
    """Planned lateral acceleration over μ g."""


class BlindSet(Config):
    """Distributions of blind drives; each road is driven once in every weather."""

    campaign: Annotated[Campaign, load_by_name(load_campaign)]
    """Campaign of the cars, tyres, sensors and road surfaces."""
    roads: tuple[Identifier, ...] = Field(min_length=1)
    """The class of each road."""
    weather: dict[Identifier, Weather] = Field(min_length=1)
    load_kg: Range
    load_position_m: Range
    tyre_stiffness: Uniform
    """Stiffness of a new tyre over that of the vehicle's file."""
    tyre_wear_days: NotNegative
    """Maximum age of the tyres."""
    drivers: Drivers

    @model_validator(mode="after")
    def _is_valid(self) -> Self:
        plan = self.campaign.plan
        if not isinstance(plan, FleetPlan) or plan.imperfections is None:
            raise ValueError(
                f"{self.campaign.name} is not a campaign of a fleet with imperfections"
            )
        if unknown := [kind for kind in self.roads if kind not in CLASSES]:
            raise ValueError(f"{unknown[0]!r} is not a class of roads: {', '.join(CLASSES)}")
        return self

    def scenarios(self, seed: int) -> tuple[Scenario, ...]:
        """Draw the drives: one for each road and weather, in this order."""
        return tuple(
            self._scenario(seed, number, kind, weather)
            for number, kind in enumerate(self.roads)
            for weather in self.weather
        )

    def _scenario(self, seed: int, number: int, kind: str, weather: str) -> Scenario:
        plan: Any = self.campaign.plan
        name, flaws = f"{kind}_{number}_{weather}", plan.imperfections
        generator = random_generator(seed, "blind", name)
        road = draw_road(kind, seed + number)
        adhesion = self.weather[weather].adhesion.draw(generator)
        use = self.weather[weather].friction_use.draw(generator)
        vehicle = plan.vehicles[generator.integers(len(plan.vehicles))]
        days = round(generator.uniform(0, self.tyre_wear_days))
        stiffer, smaller = flaws.wear(generator, days)
        content = {
            "name": name,
            "description": f"A {kind} road, {weather}",
            "vehicle": vehicle,
            "sprung_mass_kg": vehicle.body.sprung_mass_kg + self.load_kg.draw(generator),
            "load_position_m": self.load_position_m.draw(generator),
            "tyre_stiffness": self.tyre_stiffness.draw(generator) * stiffer,
            "tyre_radius": plan.tyre_radius.draw(generator) * smaller,
            "track": self.drivers.line(road, kind, generator),
            "adhesion": adhesion,
            "limits": self.drivers.limits(kind, adhesion, use, generator),
            "laps": 1,
            "seed": seed,
            "sensors": plan.sensor_bias_std.draw(self.campaign.sensors, generator),
            "imperfections": flaws.draw(generator, generator),
        }
        return Scenario.model_validate(content)


def blind_scenarios(sha256: str, configs: Configs) -> tuple[Scenario, ...]:
    """Draw the blind drives of the model version with this hash."""
    blind_set = load_config(configs.file("blind.toml"), BlindSet, configs)
    return blind_set.scenarios(int(sha256[:15], 16))
