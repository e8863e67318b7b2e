"""Health of a data root: quality, drift, verification, compaction and erasure."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from typing import TYPE_CHECKING

from fleet_slip.api import calls
from fleet_slip.base import date_of, normalize_name, pluralize
from fleet_slip.catalog.signals import ALL_DRIVES, TRAINING_DRIVES
from fleet_slip.errors import QuestionError, RefusedError, UsageError
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.storage.runs import recorded_step, step

if TYPE_CHECKING:
    from fleet_slip.calibration.car_calibration import Calibration
    from fleet_slip.models.registry import ModelVersion
    from fleet_slip.operations.forget import ForgetReport, RetentionReport
    from fleet_slip.operations.monitor import Chart
    from fleet_slip.operations.rewriting import CompactionReport, MigrationReport, VacuumReport
    from fleet_slip.operations.sensor_screen import QualityReport
    from fleet_slip.operations.status import WarehouseStatus
    from fleet_slip.operations.verify import CheckReport, Verification
    from fleet_slip.warehouse.erasure_log import ErasureSubject
    from fleet_slip.warehouse.warehouse import Warehouse


@dataclass(frozen=True)
class Compacted(Answer):
    """Result of `FleetMaintenance.compact`; of a dry run, the files that it would remove."""

    compacted: "CompactionReport | None"
    vacuumed: "VacuumReport"

    def parts(self) -> Iterator[Part]:
        """Render what was compacted and removed."""
        if self.compacted is None and self.vacuumed.files:
            yield TextTable("", "would be removed", zip(self.vacuumed.files))
        if report := self.compacted:
            yield Remark(
                f"{pluralize(report.files_before, 'file')} became {report.files_after}; "
                f"{report.rows_rewritten:,} rows were written again, "
                f"{report.size_bytes_before:,} bytes became {report.size_bytes_after:,}"
            )
        yield self.vacuumed.remark


@dataclass(frozen=True)
class FleetMaintenance:
    """Maintenance of a data root; see `Fleet.maintenance`.

    Reports return what is wrong; a command ends with an exit code for it.
    """

    warehouse: "Warehouse"

    # Health.

    def status(self, max_age_hours: float | None = None) -> "WarehouseStatus":
        """Report freshness, backlog, last runs, disk space and champions.

        Parameters
        ----------
        max_age_hours
            Report data or a backlog older than this as a problem. None means any age is fine.
        """
        from fleet_slip.operations.status import status_of

        return status_of(self.warehouse, max_age_hours)

    def quality(self, cohort: str = TRAINING_DRIVES) -> "QualityReport":
        """Find stuck, saturated, biased, noisy, scaled, reversed and swapped sensors.

        Drives are compared with each other, by Gram rows alone. `findings` are the faulty drives.

        Parameters
        ----------
        cohort
            SQL predicate on the view `drives`: the drives to compare.

        Raises
        ------
        QuestionError, DataError
            As `FleetCohort`.
        """
        from fleet_slip.operations.sensor_screen import examine_drives

        return examine_drives(self.warehouse, cohort)

    def calibrate(self, cohort: str = ALL_DRIVES) -> "Calibration":
        """Estimate the sensor errors of every car from its own drives, without a label.

        Parameters
        ----------
        cohort
            SQL predicate on the view `drives`.

        Returns
        -------
        Calibration
            Offsets of gyroscope, accelerometer and steering, and other parameters, each with its
            uncertainty.

        Raises
        ------
        DataError
            If there are no drives, or no Gram rows of the feature set `calibration`.
        QuestionError
            If the predicate is invalid.
        """
        from fleet_slip.calibration.car_calibration import calibrate
        from fleet_slip.warehouse.database import parse_cohort

        predicate = parse_cohort(self.warehouse.catalog.signals, cohort)
        return calibrate(self.warehouse, predicate, receivers=True)

    def monitor(
        self,
        model: "str | ModelVersion | None" = None,
        cohort: str | None = None,
        *,
        since: date | str | None = None,
    ) -> "Chart":
        """Chart the error of a model on each day since its training, with control limits.

        Parameters
        ----------
        model
            A reference or a version, as in `FleetModels`.
        cohort
            SQL predicate on the view `drives`. Default: the predicate of its training.
        since
            First new day: a date or `YYYY-MM-DD`. Default: the day after the training data.

        Returns
        -------
        Chart
            Errors in degrees. `alarms` are the new days beyond the limits.

        Raises
        ------
        DataError
            If there are too few training days.
        UsageError
            If `since` is no date.
        """
        from fleet_slip.api.fleet_models import FleetModels
        from fleet_slip.operations.monitor import monitor

        version = FleetModels(self.warehouse).get(model)
        return monitor(self.warehouse, version, cohort, date_of(since, "since"))

    # Integrity and space.

    def verify(
        self,
        *,
        full: bool = False,
        grams: bool = False,
        repair: bool = False,
        accept_loss: Sequence[str] = (),
        workers: calls.Workers = None,
        progress: calls.ShowStep | None = None,
    ) -> "Verification":
        """Verify every byte against its checksum, and all tables against each other.

        Parameters
        ----------
        full
            Compute the Gram rows of all log files again.
        grams
            Also compute the Gram rows of some log files in several ways and compare the bits.
        repair
            Rebuild damaged Gram rows from the logs.
        accept_loss
            Lost documents without a backup to give up: files or folders below the root, such as
            `models/golf/3.json` or `models/golf`.
        workers
            A number of threads, the address of a Dask scheduler, or an executor.
        progress
            Called with the name of the step, and the bytes or files done so far and in total.

        Returns
        -------
        Verification
            `damage` is what is wrong; after a repair, what is still wrong.

        Raises
        ------
        StorageError
            If there is no data root.
        QuestionError
            If nothing is lost at `accept_loss`.
        ClusterError
            If the cluster cannot be used.
        """
        from fleet_slip.operations.verify import check_grams, verify
        from fleet_slip.operations.verify import repair as repair_damage
        from fleet_slip.storage.documents import accept_losses

        steps, root = calls.progress_of_steps(progress), self.warehouse.root
        accepted: Sequence[str] = ()
        if accept_loss:
            with recorded_step(root, "accept_losses", accept_loss):
                accepted = accept_losses(root, accept_loss)
        with calls.open_workers(self.warehouse.root, workers) as executor:
            warehouse = calls.for_workers(self.warehouse, executor)
            remote = calls.remote_executor(executor)
            verify_all = partial(verify, warehouse, full=full, steps=steps, executor=remote)
            result = verify_all()
            if repair:
                with recorded_step(root, "repair", ()):
                    rebuilt = repair_damage(self.warehouse, result)
                result = verify_all()
                result.rebuilt, result.repaired = rebuilt, True
        result.accepted = accepted
        if grams and not result.damage:
            result.compared = check_grams(self.warehouse, progress=steps("compare Gram rows"))
        return result

    def check_grams(
        self, files: int = 4, *, begin: int = 0, progress: calls.ShowProgress | None = None
    ) -> "CheckReport":
        """Compute the Gram rows of some log files in several ways and compare the bits.

        These are the kernel, SQL where the set has a statement, and the stored rows.

        Parameters
        ----------
        files
            Number of log files, evenly spaced.
        begin
            Offset of the sample. `begin + 1` checks the next files.
        progress
            Called with the files done so far and in total.

        Raises
        ------
        StorageError
            If a drive differs.
        DataError
            If there is nothing to check.
        """
        from fleet_slip.operations.verify import check_grams

        return check_grams(self.warehouse, files, calls.total_progress(progress), begin)

    @calls.record_call
    def compact(
        self,
        target_rows: int | None = None,
        *,
        retention_hours: float | None = None,
        dry_run: bool = False,
        progress: calls.ShowProgress | None = None,
    ) -> "Compacted":
        """Merge the small log files of each day, and remove files that are out of use.

        Parameters
        ----------
        target_rows
            Maximum number of rows of a merged file. Default: 2,000,000.
        retention_hours
            Keep files that a version of the last hours refers to. Default: 168, a week.
        dry_run
            List the files that would be removed, and change nothing.
        progress
            Called with the days done so far and in total.

        Raises
        ------
        ConflictError
            If other processes keep changing files.
        """
        from fleet_slip.operations.rewriting import RETENTION_HOURS, TARGET_ROWS, compact, vacuum

        hours = RETENTION_HOURS if retention_hours is None else retention_hours
        if dry_run:
            return Compacted(None, vacuum(self.warehouse, hours, dry_run=True))
        with step("compact") as figures:
            report = compact(
                self.warehouse, target_rows or TARGET_ROWS, calls.total_progress(progress)
            )
            figures.rows, figures.size_bytes = report.rows_rewritten, report.size_bytes_after
        with step("vacuum") as figures:
            removed = vacuum(self.warehouse, hours)
            figures.size_bytes = removed.size_bytes
        return Compacted(report, removed)

    @calls.record_call
    def migrate(self) -> "MigrationReport":
        """Bring the tables to this version of the program and to the signal catalog.

        Raises
        ------
        RefusedError
            If the counts in the logs have other scales.
        ConflictError
            If other processes keep changing the tables.
        """
        from fleet_slip.operations.rewriting import migrate

        with step("migrate"):
            return migrate(self.warehouse)

    # Erasure.

    @calls.record_call
    def forget(
        self,
        *,
        vehicle: str | None = None,
        drive: str | None = None,
        now: bool = False,
        progress: calls.ShowProgress | None = None,
    ) -> "ForgetReport":
        """Erase a vehicle or a drive from logs, Gram rows and quarantine.

        Models that were trained on it are marked. No job brings it back until `allow`. While the
        report has anything `pending`, repeat the call.

        Parameters
        ----------
        vehicle
            The `vehicle_id`.
        drive
            The `drive_id`, instead of a vehicle.
        now
            Delete the old files at once, instead of at the next `compact`.
        progress
            Called with the files done so far and in total.

        Raises
        ------
        UsageError
            Unless either a vehicle or a drive is given.
        QuestionError
            If there never was such a vehicle or drive.
        ConflictError
            If other processes keep changing the tables.
        """
        from fleet_slip.operations.forget import forget

        subject = _subject(vehicle, drive)
        with step("forget") as figures:
            report = forget(
                self.warehouse, subject, now=now, progress=calls.total_progress(progress)
            )
            figures.rows = report.rows
        return report

    @calls.record_call
    def allow(self, *, vehicle: str | None = None, drive: str | None = None) -> bool:
        """Accept new rows of an erased vehicle or drive again; return False if it was allowed.

        Erased rows stay erased until `ingest` reads their file again.

        Raises
        ------
        UsageError
            Unless either a vehicle or a drive is given.
        QuestionError
            If it was never erased.
        RefusedError
            While the erasure is not finished.
        """
        from fleet_slip.warehouse.erasure_log import ErasureLog

        self.warehouse.require()
        subject, erasure_log = _subject(vehicle, drive), ErasureLog(self.warehouse.root)
        state = erasure_log.state(subject)
        if state is None:
            raise QuestionError(f"{subject.kind} {subject.value!r} was never forgotten.")
        if state == "begun":
            raise RefusedError(
                f"{subject.kind} {subject.value!r} is still being forgotten. Repeat that command "
                "until it is done, then allow it."
            )
        if state == "done":
            erasure_log.allow(subject)
        return state == "done"

    @calls.record_call
    def apply_retention(
        self, config: str | None = None, *, progress: calls.ShowProgress | None = None
    ) -> "RetentionReport":
        """Erase drives older than the retention period, then vacuum.

        Parameters
        ----------
        config
            Path of a retention file. Default: `retention.toml` of the configs.
        progress
            Called with the files done so far and in total.

        Raises
        ------
        RefusedError
            If no drive would remain.
        FleetSlipError
            As `forget`.
        """
        from fleet_slip.operations.forget import load_retention, retain

        with step("retain") as figures:
            retention = load_retention(config, self.warehouse.configs)
            report = retain(self.warehouse, retention, date.today(), calls.total_progress(progress))
            figures.rows, figures.size_bytes = report.forgotten.rows, report.vacuumed.size_bytes
        return report


def _subject(vehicle: str | None, drive: str | None) -> "ErasureSubject":
    """Return the subject of an erasure. Raises `UsageError` for none, both or a blank name."""
    from fleet_slip.warehouse.erasure_log import ErasureSubject

    names = {"vehicle": vehicle, "drive": drive}
    match [(kind, normalize_name(name)) for kind, name in names.items() if name is not None]:
        case [("vehicle" | "drive" as kind, name)] if name:
            return ErasureSubject(kind, name)
    raise UsageError("give a vehicle or a drive by its name.")
