"""Test drives: the simulated drives of scenarios, with their signals and the exact truth."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.base import Progress, no_progress
from fleet_slip.catalog.signals import Identifier, SignalCatalog
from fleet_slip.config import Config, load_config
from fleet_slip.errors import QuestionError
from fleet_slip.grams.update import update_grams
from fleet_slip.quality.drive_signals import MOVING_MPS
from fleet_slip.resources import Configs
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.drive_plans import Drivers, FleetPlan, load_by_name
from fleet_slip.simulation.imperfections import ImperfectionRanges, NotNegative, Range, Uniform
from fleet_slip.simulation.roads import CLASSES, draw_road, random_generator
from fleet_slip.simulation.scenario import Failure, Scenario
from fleet_slip.simulation.sensors import GPS_SIGNALS, SAMPLE_RATE_HZ
from fleet_slip.simulation.simulate import (
    MOTION,
    DriveLog,
    SimulationReport,
    simulate_batches,
    simulate_logs,
)
from fleet_slip.vehicle.dynamics import brush_force
from fleet_slip.vehicle.parameters import VehicleParameters, constants
from fleet_slip.warehouse.warehouse import Warehouse


@dataclass(frozen=True)
class TestDrive:
    """The drive of a scenario. Arrays have shape (ticks,).

    Attributes
    ----------
    scenario
        Car, road, driver and failures.
    time_s
        Time since the drive began.
    signals
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
    signals: Mapping[str, FloatArray]
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

    @property
    def ay_mps2(self) -> FloatArray:
        """Lateral acceleration as the car measures it."""
        return self.signals["ay_mps2"]

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
    def sections(self) -> "tuple[Section, ...]":
        """Sections with rows of their own: unstable, and without satellite navigation."""
        ticks = np.arange(len(self.time_s))
        fixes = np.isfinite(self.signals["gps_vx_mps"])
        last_fix = np.maximum.accumulate(np.where(fixes, ticks, 0))
        sections = (
            Section("unstable", CRITERION, find_unstable(self)),
            Section(
                "gps_outage",
                f"more than {GPS_OUTAGE_S:g} s since the last fix of satellite navigation",
                (ticks - last_fix) > GPS_OUTAGE_S * SAMPLE_RATE_HZ,
            ),
        )
        return tuple(section for section in sections if section.rows.any())


GPS_OUTAGE_S = 1.0
"""Time without a fix after which satellite navigation counts as lost."""


@dataclass(frozen=True)
class Section:
    """A part of a drive with statistics of its own; `rows` has shape (ticks,)."""

    name: str
    criterion: str
    rows: BoolArray


def visible_signals(signals: SignalCatalog) -> tuple[str, ...]:
    """Return the names of the signals that an estimator may read: never a truth."""
    return (*signals.inputs, *GPS_SIGNALS)


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
    return tuple(_test_drive(signals, scenario, logs[scenario.drive_id]) for scenario in scenarios)


def _test_drive(signals: SignalCatalog, scenario: Scenario, log: DriveLog) -> TestDrive:
    time_s = np.arange(log.rows) / SAMPLE_RATE_HZ
    visible = {}
    for name in visible_signals(signals):
        values = log.measurement.counts[name] * float(signals[name].scale)
        missing = name in GPS_SIGNALS and ~log.measurement.gps_fix
        visible[name] = np.where(missing, np.nan, values)
    for failure in scenario.failures:
        visible = apply_failure(visible, time_s, failure)
    return TestDrive(
        scenario=scenario,
        time_s=time_s,
        signals={signals[name].column: values for name, values in visible.items()},
        **log.motion,
        lost_control_s=log.lost_control_s,
    )


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

CRITERION = (
    "an axle's tyres slip beyond the peak of their lateral force (brush tyre, static load, "
    f"stretches less than {SMALLEST_GAP_S:g} s apart joined)"
)


class PeakSlip(NamedTuple):
    """Slip angles at which the axles' lateral forces are largest, in rad."""

    front_rad: float
    rear_rad: float


@dataclass(frozen=True)
class Stretch:
    """A stretch of a drive, in time and along the track."""

    from_s: float
    until_s: float
    from_m: float
    until_m: float


@cache
def peak_slip(vehicle: VehicleParameters, adhesion: float) -> PeakSlip:
    """Return the slip angles of the peaks, both wheels at their static load, without drive."""
    c = constants(vehicle, adhesion)

    def peak(load: float, stiffness: float) -> float:
        v = PEAK_SPEED_MPS
        forces = [abs(brush_force(v, slip * v, v, load, stiffness, c).y) for slip in SLIPS]
        return float(np.arctan(SLIPS[np.argmax(forces)]))

    return PeakSlip(peak(c.static_front, c.stiffness_front), peak(c.static_rear, c.stiffness_rear))


def slip_angles(drive: TestDrive) -> tuple[FloatArray, FloatArray]:
    """Return the slip angles of front and rear axle in rad, positive when sliding to the left.

    The yaw rate is the gyroscope's, less the bias that the scenario states; where it is null there
    is no slip angle.
    """
    body, sensors = drive.scenario.car.body, drive.scenario.sensors
    yaw_rate = drive.signals["yaw_rate_rad_s"] - sensors.yaw_rate_bias_rad_s
    steer = (drive.signals["steer_fl_rad"] + drive.signals["steer_fr_rad"]) / 2
    front = np.arctan2(drive.vy_mps + body.front_axle_m * yaw_rate, drive.vx_mps) - steer
    rear = np.arctan2(drive.vy_mps - body.rear_axle_m * yaw_rate, drive.vx_mps)
    return front, rear


def find_unstable(drive: TestDrive) -> BoolArray:
    """Return the mask of ticks within an unstable stretch, shape (ticks,)."""
    peak = peak_slip(drive.scenario.car, drive.scenario.adhesion)
    front, rear = slip_angles(drive)
    beyond = (np.abs(front) > peak.front_rad) | (np.abs(rear) > peak.rear_rad)
    return join(beyond & drive.evaluated, round(SMALLEST_GAP_S * SAMPLE_RATE_HZ))


def join(mask: BoolArray, gap: int) -> BoolArray:
    """Fill the gaps of a mask that are shorter than `gap` entries."""
    joined = mask.copy()
    runs = list(_runs(mask))
    for (_, end), (begin, _) in pairwise(runs):
        if begin - end < gap:
            joined[end:begin] = True
    return joined


def find_stretches(drive: TestDrive, mask: BoolArray) -> tuple[Stretch, ...]:
    """Return the stretches of a drive on which a mask over its ticks is true."""
    return tuple(
        Stretch(
            from_s=float(drive.time_s[begin]),
            until_s=float(drive.time_s[end - 1]),
            from_m=float(drive.station_m[begin]),
            until_m=float(drive.station_m[end - 1]),
        )
        for begin, end in _runs(mask)
    )


def _runs(mask: BoolArray) -> Iterator[tuple[int, int]]:
    """Yield begin and end (exclusive) of each run of true entries."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


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

    @property
    def _fleet(self) -> tuple[FleetPlan, ImperfectionRanges]:
        """The plan of the campaign's cars, and their imperfections."""
        plan = self.campaign.plan
        if not isinstance(plan, FleetPlan) or plan.imperfections is None:
            raise ValueError(
                f"{self.campaign.name} is not a campaign of a fleet with imperfections"
            )
        return plan, plan.imperfections

    @model_validator(mode="after")
    def _is_valid(self) -> Self:
        _ = self._fleet
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
        plan, flaws = self._fleet
        name = f"{kind}_{number}_{weather}"
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
