"""Reads the drives of scenarios: what estimators see, and the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_slip.arrays import BoolArray, FloatArray, float_column
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import SCENARIO
from fleet_slip.errors import DataError, QuestionError, RefusedError
from fleet_slip.resources import read_sql
from fleet_slip.simulation.drives import MOTION, DriveLog, exact_motion, simulate_logs
from fleet_slip.simulation.scenario import Failure, Scenario
from fleet_slip.simulation.sensing.sensors import GPS_SIGNALS, SAMPLE_RATE_HZ
from fleet_slip.views import connect
from fleet_slip.warehouse.database import reading_files
from fleet_slip.warehouse.tables import Warehouse

SLOWEST_MPS = 2.0
"""Speed below which a side-slip angle is not evaluated: at standstill there is none."""


@dataclass(frozen=True)
class EvaluatedDrive:
    """One drive. Arrays have shape (ticks,).

    Attributes:
        scenario: what it is a test of.
        time_s: time since the drive began.
        signals: what an estimator may see, by SI column: the inputs of the catalogue and satellite
            navigation; NaN where null.
        vx_mps, vy_mps: true velocity of the centre of gravity.
        station_m: distance along the track within the lap.
        lateral_offset_m: distance from the track's centre line, positive to the left.
        lost_control_s: when the driver lost the car; None where he did not.
    """

    scenario: Scenario
    time_s: FloatArray
    signals: Mapping[str, FloatArray]
    vx_mps: FloatArray
    vy_mps: FloatArray
    station_m: FloatArray
    lateral_offset_m: FloatArray
    lost_control_s: float | None

    @property
    def facts(self) -> dict[str, Any]:
        """What the car knows of itself: its model and its stated mass, by drive column."""
        scenario = self.scenario
        return {"vehicle_model": scenario.vehicle.name, "mass_kg": scenario.car.body.sprung_mass_kg}

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
        """Where the car moves forward, so that it has a side-slip angle."""
        return self.vx_mps > SLOWEST_MPS


def visible_signals() -> tuple[str, ...]:
    """Return the names of the signals that an estimator may see: never a truth."""
    return (*catalogue().inputs, *GPS_SIGNALS)


def load_drives(warehouse: Warehouse, scenarios: Sequence[Scenario]) -> tuple[EvaluatedDrive, ...]:
    """Read the drives of scenarios, failures applied; the truth is the simulator's, not the log's.

    A log keeps vy in steps of 0.005 m/s, which at 25 m/s is half of what good estimates err. Raises
    `DataError` if a drive is not there, and `RefusedError` if this program drives it otherwise.
    """
    signals = catalogue().signals
    names = [name for name in signals if name != catalogue().label]
    statement = read_sql("jobs", "scenario.sql").format(
        columns=",\n    ".join(signals[name].column for name in names), source=SCENARIO
    )
    drives = sorted({scenario.drive_id for scenario in scenarios})
    with (
        connect(warehouse.root, query=statement) as database,
        reading_files(database, "reading the drives of scenarios"),
    ):
        rows = database.sql(statement, params={"drives": drives}).to_arrow_table()
    logged = [_drive(scenario, rows) for scenario in scenarios]
    once = {one.scenario.drive_id: one.scenario for one in logged}
    motions = exact_motion([scenario.batch().drives[0] for scenario in once.values()])
    exact = dict(zip(once, motions, strict=True))
    return tuple(_exact(one, exact[one.scenario.drive_id]) for one in logged)


def _exact(drive: EvaluatedDrive, truth: Mapping[str, FloatArray]) -> EvaluatedDrive:
    """Return a logged drive with the exact truth, from which the log may differ by its rounding."""
    for name, exact in truth.items():
        logged, signal = getattr(drive, name), catalogue()[name.rpartition("_")[0]]
        seen = np.clip(exact, float(signal.min), float(signal.max))
        if len(logged) != len(exact) or np.abs(logged - seen).max() > float(signal.scale):
            raise RefusedError(
                f"the drive {drive.scenario.drive_id} of the logs is not the one that this version "
                "of the program drives, so that its exact angle is not known. Evaluate in another "
                "data root, or forget the drive."
            )
    vx_mps, vy_mps, station_m, lateral_offset_m = (truth[name] for name in MOTION)
    return replace(
        drive, vx_mps=vx_mps, vy_mps=vy_mps, station_m=station_m, lateral_offset_m=lateral_offset_m
    )


def simulate_drives(scenarios: Sequence[Scenario]) -> tuple[EvaluatedDrive, ...]:
    """Simulate the drives of scenarios for this evaluation alone: nothing is written.

    Estimators see what the log would hold; the truth is exact.
    """
    specs = [scenario.batch().drives[0] for scenario in scenarios]
    logs, truths = simulate_logs(specs), exact_motion(specs)
    return tuple(
        _measured(scenario, log, truth)
        for scenario, log, truth in zip(scenarios, logs, truths, strict=True)
    )


def _measured(scenario: Scenario, log: DriveLog, truth: Mapping[str, FloatArray]) -> EvaluatedDrive:
    signals = {}
    for name in visible_signals():
        values = log.measurement.counts[name] * float(catalogue()[name].scale)
        missing = name in GPS_SIGNALS and ~log.measurement.gps_fix
        signals[catalogue()[name].column] = np.where(missing, np.nan, values)
    return EvaluatedDrive(
        scenario=scenario,
        time_s=np.arange(log.rows) / SAMPLE_RATE_HZ,
        signals=signals,
        **truth,
        lost_control_s=log.lost_control_s,
    )


def _drive(scenario: Scenario, all_rows: pa.Table) -> EvaluatedDrive:
    rows = all_rows.filter(pc.equal(all_rows["drive_id"], scenario.drive_id))
    if not rows.num_rows:
        raise DataError(
            f"the drive {scenario.drive_id} is not in the logs. Run: fleet-slip evaluate"
        )
    time_s = float_column(rows, "time_s")
    measured = {name: float_column(rows, catalogue()[name].column) for name in visible_signals()}
    for failure in scenario.failures:
        measured = apply_failure(measured, time_s, failure)
    return EvaluatedDrive(
        scenario=scenario,
        time_s=time_s,
        signals={catalogue()[name].column: values for name, values in measured.items()},
        vx_mps=float_column(rows, "vx_mps"),
        vy_mps=float_column(rows, "vy_mps"),
        station_m=float_column(rows, "station_m"),
        lateral_offset_m=float_column(rows, "lateral_offset_m"),
        lost_control_s=rows["lost_control_s"][0].as_py(),
    )


def apply_failure(
    signals: Mapping[str, FloatArray], time_s: FloatArray, failure: Failure
) -> dict[str, FloatArray]:
    """Return signals, by name, as a car with the failure logs them; the given ones stay.

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
        kept = signals[name][np.argmax(failed)] if failure.kind == "stuck" else np.nan
        changed[name] = np.where(failed, kept, signals[name])
    return changed
