"""Simulates the drives of a campaign and commits them to the logs.

Each batch of drives becomes one file, committed once by an application transaction. Its version is
derived from the content of the batch, so that a changed campaign is detected.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from datetime import date
from functools import partial
from typing import Literal

import numpy as np
import pyarrow as pa
from deltalake.transaction import AddAction

from fleet_slip.arrays import FloatArray
from fleet_slip.base import Progress, no_progress, pluralize
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.compute.tasks import run_tasks
from fleet_slip.errors import RefusedError
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.simulation.campaign import Batch, Campaign, DriveSpec
from fleet_slip.simulation.roads import SLOWEST_MPS, Manoeuvre, road_with
from fleet_slip.simulation.sensors import (
    GPS_SIGNALS,
    SAMPLE_RATE_HZ,
    Measurement,
    measure,
    receive,
)
from fleet_slip.storage.table import AppTransaction, Change, Snapshot, retry_conflicts, retrying
from fleet_slip.vehicle.batch import LaneDrive, Road, simulate_drives, simulate_lanes
from fleet_slip.vehicle.parameters import PERFECT
from fleet_slip.warehouse.erasure_log import ErasureLog, skipped_drives
from fleet_slip.warehouse.warehouse import Warehouse

TOLERANCE = 1e-9
"""Largest difference from highway-env, relative to the largest value of a quantity."""


@dataclass(frozen=True)
class DriveLog:
    """The log of a drive."""

    spec: DriveSpec
    measurement: Measurement
    lost_control_s: float | None
    fixes: Measurement | None = None
    """Log of the satellite receiver, if the campaign has receivers."""
    motion: Mapping[str, FloatArray] = field(default_factory=dict)
    """Requested channels of the truth at 100 Hz, not rounded to counts."""

    @property
    def rows(self) -> int:
        """Number of ticks."""
        return len(self.measurement.gps_fix)

    @property
    def metadata(self) -> dict[str, object]:
        """Values of the columns of `SignalCatalog.drive_schema`."""
        spec = self.spec
        return {
            "drive_id": spec.drive_id,
            "vehicle_id": spec.vehicle_id,
            "vehicle_model": spec.vehicle.name,
            "source": spec.source,
            "campaign": spec.campaign,
            "track": spec.track.name,
            "mass_kg": spec.vehicle.body.sprung_mass_kg,
            "receiver": spec.receiver.name if spec.receiver else None,
            "adhesion": spec.adhesion,
            "speed_factor": spec.speed_factor,
            "duration_s": (self.rows - 1) / SAMPLE_RATE_HZ,
            "rows": self.rows,
            "lost_control_s": self.lost_control_s,
            "saturated": self.measurement.saturated,
        }


def lane_drive(spec: DriveSpec) -> LaneDrive:
    """Return a drive as the input of the simulator."""
    profile = spec.profile
    road = Road(
        spacing_m=profile.spacing_m,
        curvature_1pm=profile.track.curvature(profile.station_m),
        speed_mps=spec.speed_factor * profile.speed_mps,
        length_m=profile.track.length_m,
        closed=profile.track.closed,
        surface=spec.surface(profile.station_m),
    )
    road = road_with(road, spec.script)
    return LaneDrive(spec.vehicle, road, spec.adhesion, spec.laps, spec.flaws.car)


def check_against_highway_env(drives: Sequence[DriveSpec]) -> None:
    """Compare the first seconds of the first drive with highway-env, in a slalom.

    Raises `RefusedError` if the kernel, highway-env or its traffic differs from the tested version.
    """
    from fleet_slip.simulation.traffic import require_known_traffic  # noqa: PLC0415 - highway-env
    from fleet_slip.vehicle.highway import require_agreement  # noqa: PLC0415 - as above

    for name in sorted({name for spec in drives if spec.traffic for name in spec.traffic.roads}):
        require_known_traffic(name)
    spec = drives[0]
    drive = lane_drive(spec)
    rolling = np.maximum(drive.road.speed_mps, SLOWEST_MPS)
    slalom = Manoeuvre("slalom", 0.0, 2.0, 2.0 * spec.adhesion, 1.0)
    road = road_with(drive.road._replace(speed_mps=rolling, surface=None), [slalom])
    perfect = replace(drive, road=road, flaws=PERFECT)
    require_agreement(perfect, spec.drive_id, TOLERANCE)


Engine = Literal["kernel", "highway-env"]
"""Advances the cars: the compiled kernel, or highway-env's vehicle sample by sample."""


def simulate_batch(signals: SignalCatalog, batch: Batch, engine: Engine = "kernel") -> pa.Table:
    """Simulate and measure the drives of a batch. The result depends on the batch alone.

    Columns are in the order of `SignalCatalog.log_schema`, without extra signals that no drive has.
    Strings are dictionaries. Rows are in the order of drives and ticks.
    """
    return tabulate(signals, batch, simulate_logs(signals, batch.drives, engine=engine))


MOTION = ("vx_mps", "vy_mps", "station_m", "lateral_offset_m")
"""Channels of the truth that an evaluation needs and no sensor measures."""


def simulate_logs(
    signals: SignalCatalog,
    specs: Sequence[DriveSpec],
    channels: Sequence[str] = (),
    engine: Engine = "kernel",
) -> list[DriveLog]:
    """Simulate drives together and measure each with its own sensors.

    `motion` of the logs contains the named channels of the truth.
    """
    drives = [lane_drive(spec) for spec in specs]
    engine_lanes: Callable[..., None] = simulate_lanes
    if engine == "highway-env":
        from fleet_slip.vehicle.highway import HighwayLanes  # noqa: PLC0415 - imports highway-env

        engine_lanes = HighwayLanes(drives)
    logs: dict[int, DriveLog] = {}
    for drive in simulate_drives(drives, simulate_lanes=engine_lanes):
        spec, lost = specs[drive.drive], drive.lost_control_tick
        truth = at_reference(drive.channels, spec.vehicle.body.reference_m)
        generator, fixes = spec.generator("sensors"), None
        if spec.receiver:
            fixes = receive(signals, spec.receiver, spec.generator("satellites"), truth)
        logs[drive.drive] = DriveLog(
            spec,
            measure(signals, spec.sensors, generator, spec.distorted(truth)),
            None if lost is None else lost / SAMPLE_RATE_HZ,
            fixes,
            {name: truth[name] for name in channels},
        )
    return [logs[drive] for drive in range(len(specs))]


def at_reference(channels: dict[str, FloatArray], reference_m: float) -> dict[str, FloatArray]:
    """Move velocity and side-slip angle to a point `reference_m` before the centre of gravity."""
    if not reference_m:
        return channels
    vy_mps = channels["vy_mps"] + reference_m * channels["yaw_rate_rad_s"]
    angle_rad = np.arctan2(vy_mps, channels["vx_mps"])
    return {**channels, "vy_mps": vy_mps, "sideslip_rad": angle_rad}


def tabulate(signals: SignalCatalog, batch: Batch, logs: Sequence[DriveLog]) -> pa.Table:
    """Return the rows of logs as a table."""
    rows = [log.rows for log in logs]
    drive_of_row = pa.array(np.repeat(np.arange(len(rows)), rows))
    columns = {"day": pa.repeat(pa.scalar(batch.day), sum(rows))}
    for column in signals.drive_schema:
        values = pa.array([log.metadata.get(column.name) for log in logs], type=column.type)
        if column.name not in signals.optional or values.null_count < len(values):
            is_text = pa.types.is_string(column.type)
            distinct = values.dictionary_encode() if is_text else values
            columns[column.name] = distinct.take(drive_of_row)
    ticks = pa.array(np.arange(max(rows), dtype=np.int32))
    columns["tick"] = pa.chunked_array([ticks[:n] for n in rows])
    for name in signals.signals:
        counts = pa.chunked_array([_counts(log, name) for log in logs])
        if name not in signals.extras or counts.null_count < len(counts):
            columns[name] = counts
    names = [name for name in signals.log_schema.names if name in columns]
    return pa.table({name: columns[name] for name in names})


def _counts(log: DriveLog, name: str) -> pa.Array:
    source = log.fixes if log.fixes and name in log.fixes.counts else log.measurement
    if name not in source.counts:
        return pa.nulls(log.rows, pa.int16())
    at_fixes = source is log.fixes or name in GPS_SIGNALS
    return pa.array(source.counts[name], mask=~source.gps_fix if at_fixes else None)


def batch_transaction(batch: Batch) -> AppTransaction:
    """Return the transaction that lands a batch; its version is from the batch's content."""
    name = f"{day_name(batch.campaign, batch.day)}/{batch.index}"
    return AppTransaction(name, int(batch.digest[:15], base=16))


def day_transaction(campaign: Campaign, day: date) -> AppTransaction:
    """Return the transaction that records that a day is complete."""
    return AppTransaction(day_name(campaign.name, day), int(campaign.digest[:15], base=16))


def day_name(campaign: str, day: date) -> str:
    """Return the name of the transaction of a day, a prefix of the names of its batches."""
    return f"simulate/{campaign}/{day}"


def has_landed(snapshot: Snapshot, transaction: AppTransaction) -> bool:
    """Return True if a transaction is in the logs. Raises `RefusedError` for another version."""
    landed = snapshot.transaction_version(transaction.name)
    if landed not in (None, transaction.version):
        _, campaign, day, *_ = transaction.name.split("/")
        raise RefusedError(
            f"{day}: the campaign {campaign!r} has changed since this day was simulated. Logs are "
            "not replaced. Give the changed campaign another name, or use another data root."
        )
    return landed is not None


@dataclass
class SimulationReport(Answer):
    """Result of a simulation."""

    batches_written: int = 0
    batches_present: int = 0
    """Batches of incomplete days that were in the logs before."""
    days_present: int = 0
    """Days that were complete before."""
    drives: int = 0
    drives_checked: int = 0
    """Drives that were compared with highway-env, one for each file."""
    drives_forgotten: int = 0
    """Drives that were skipped, because they or their cars are erased."""
    rows: int = 0
    size_bytes: int = 0
    logs_version: int | None = None
    seconds: float = 0.0
    campaign: str = ""

    @property
    def changed(self) -> bool:
        """True if logs were written."""
        return bool(self.batches_written)

    def parts(self) -> Iterator[Part]:
        """Return the counts of drives, rows and files, and of drives compared with highway-env."""
        if not self.changed:
            yield Remark(f"{self.campaign}: nothing to do, all days are simulated")
            return
        drives, rows = pluralize(self.drives, "drive"), pluralize(self.rows, "row")
        yield Remark(
            f"{self.campaign}: simulated {drives}, {rows} in "
            f"{pluralize(self.batches_written, 'file')}, "
            f"{self.size_bytes / max(self.rows, 1):.1f} bytes a row"
            + skipped_drives(self.drives_forgotten)
        )
        checked = pluralize(self.drives_checked, "drive")
        yield Remark(f"checked against highway-env: {checked}, equal within {TOLERANCE:g}")
        yield Remark(f"{self.seconds:.1f} s, {self.rows / self.seconds:,.0f} rows/s")


@dataclass(frozen=True)
class _Written:
    batch: Batch
    drives: tuple[DriveSpec, ...]
    """Drives of the batch that are not erased."""
    files: list[AddAction]
    """The file of the drives, if there are any."""
    rows: int


def simulate_campaign(
    warehouse: Warehouse,
    campaign: Campaign,
    days: Iterable[date],
    executor: Executor,
    progress: Progress = no_progress,
    engine: Engine = "kernel",
) -> SimulationReport:
    """Simulate and commit the batches of days that are not in the logs.

    Days are planned one by one. A complete day is recorded and never planned again, so that nightly
    runs stay short. Raises as `simulate_batches`.
    """
    snapshot = warehouse.logs.snapshot()
    days = tuple(days)
    open_days = _open_days(snapshot, campaign, days)
    begun = {name.rpartition("/")[0] for name in snapshot.transactions}
    for day in open_days:  # before the first write, so that a changed campaign is refused
        if day_name(campaign.name, day) in begun:
            for batch in campaign.batches(day):
                has_landed(snapshot, batch_transaction(batch))
    plan = (campaign.batches(day) for day in open_days)
    report = _simulate(warehouse, plan, len(open_days), executor, progress, engine)
    report.campaign, report.days_present = campaign.name, len(days) - len(open_days)
    _complete(warehouse, campaign, open_days)
    report.logs_version = warehouse.logs.snapshot().version
    return report


def _open_days(snapshot: Snapshot, campaign: Campaign, days: Iterable[date]) -> list[date]:
    """Return the incomplete days. Raises `RefusedError` for a changed campaign."""
    return [day for day in days if not has_landed(snapshot, day_transaction(campaign, day))]


@retrying
def _complete(warehouse: Warehouse, campaign: Campaign, days: Iterable[date]) -> None:
    snapshot = warehouse.logs.snapshot()
    transactions = [day_transaction(campaign, day) for day in _open_days(snapshot, campaign, days)]
    if transactions:
        snapshot.commit(
            Change(transactions=transactions, note={"job": "simulate", "campaign": campaign.name})
        )


def simulate_batches(
    warehouse: Warehouse,
    batches: Sequence[Batch],
    executor: Executor,
    progress: Progress = no_progress,
) -> SimulationReport:
    """Simulate and commit the batches that are not in the logs.

    Raises `RefusedError` if the logs contain another version of a batch or a car departs from
    highway-env, `StorageError`, and at the end `ClusterError` for batches whose workers died.
    """
    snapshot = warehouse.logs.snapshot()
    for batch in batches:
        has_landed(snapshot, batch_transaction(batch))
    return _simulate(warehouse, [batches], 1, executor, progress)


def _simulate(
    warehouse: Warehouse,
    plan: Iterable[Sequence[Batch]],
    days: int,
    executor: Executor,
    progress: Progress,
    engine: Engine = "kernel",
) -> SimulationReport:
    start = time.perf_counter()
    snapshot, report = warehouse.logs.snapshot(), SimulationReport()
    days_planned = rows = 0

    def backlog() -> Iterator[Batch]:
        """Yield the missing batches, planned day by day on demand."""
        nonlocal days_planned, rows
        for batches in plan:
            missing = [
                batch for batch in batches if not has_landed(snapshot, batch_transaction(batch))
            ]
            report.batches_present += len(batches) - len(missing)
            days_planned += 1
            rows += sum(drive.expected_rows for batch in missing for drive in batch.drives)
            yield from missing

    def name(batch: Batch) -> str:
        return f"{batch.campaign}, {batch.day}, file {batch.index}"

    write = partial(_write, warehouse, engine)
    for _, result in run_tasks(executor, write, backlog(), name):
        if landed := _commit(warehouse, result, write):
            report.batches_written += 1
            report.drives += len(landed.drives)
            report.drives_checked += bool(landed.drives)
            report.drives_forgotten += len(landed.batch.drives) - len(landed.drives)
            report.rows += landed.rows
            report.size_bytes += sum(file.size for file in landed.files)
        # Days that are not planned yet are assumed to have the mean number of rows.
        progress(result.rows, rows * days // days_planned)
    report.logs_version = warehouse.logs.snapshot().version
    report.seconds = time.perf_counter() - start
    return report


def _write(warehouse: Warehouse, engine: Engine, batch: Batch) -> _Written:
    drives = _not_erased(warehouse, batch.drives)
    if not drives:
        return _Written(batch, (), [], 0)
    check_against_highway_env(drives)
    rows = simulate_batch(warehouse.catalog.signals, replace(batch, drives=drives), engine)
    name = f"{batch.campaign}-{batch.index:04d}-{batch.digest[:12]}"  # before its checksum
    action = warehouse.logs.put(name, warehouse.logs.encode(rows), batch.day)
    return _Written(batch, drives, [action], rows.num_rows)


def _not_erased(warehouse: Warehouse, drives: tuple[DriveSpec, ...]) -> tuple[DriveSpec, ...]:
    erased = ErasureLog(warehouse.root).erased(
        {drive.vehicle_id for drive in drives}, {drive.drive_id for drive in drives}
    )
    return tuple(
        drive
        for drive in drives
        if drive.vehicle_id not in erased.vehicles and drive.drive_id not in erased.drives
    )


def _commit(
    warehouse: Warehouse, written: _Written, write: Callable[[Batch], _Written]
) -> _Written | None:
    """Commit a batch and return it; None if another process committed it first."""

    def attempt() -> _Written | None:
        nonlocal written
        snapshot = warehouse.logs.snapshot()
        transaction, batch = batch_transaction(written.batch), written.batch
        landed = has_landed(snapshot, transaction)
        # Read after the snapshot: a later erasure makes this commit a conflict.
        if landed or written.drives != _not_erased(warehouse, written.drives):
            warehouse.logs.discard(written.files)
            if landed:
                return None
            written = write(batch)
        note = {"job": "simulate", "campaign": batch.campaign, "digest": batch.digest}
        snapshot.commit(Change(add=written.files, transactions=[transaction], note=note))
        return written

    return retry_conflicts(attempt)
