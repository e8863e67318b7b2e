"""Drives with a label, as filters and models read them: SI signals at 100 Hz, and counts.

Segments of drives are held out together: a drive and a quarter of its time. All four quarters are a
whole drive.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise

import duckdb
import numpy as np
import pyarrow as pa

from fleet_slip.arrays import BoolArray, FloatArray, IntArray
from fleet_slip.catalog.signals import SAMPLE_TIME_S, SignalCatalog
from fleet_slip.errors import QuestionError
from fleet_slip.evaluation.evaluator import MissingSignalError
from fleet_slip.grams.calibrated_columns import CarCounts
from fleet_slip.grams.compute import counts_of
from fleet_slip.models.predict import Predictor
from fleet_slip.quality.drive_signals import RADIUS_M, SPEEDS, is_slow
from fleet_slip.vehicle.parameters import VehicleParameters
from fleet_slip.views import open_views
from fleet_slip.warehouse.database import reading_files
from fleet_slip.warehouse.warehouse import Warehouse

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
