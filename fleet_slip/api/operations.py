"""The part of a `Fleet` that watches the warehouse and looks after it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from typing import TYPE_CHECKING, Annotated

from typing_extensions import Doc

from fleet_slip.api.calls import (
    COHORT,
    MODEL,
    ShowProgress,
    Workers,
    count_from_start,
    open_workers,
    record_call,
    unless_local,
    within_reach,
)
from fleet_slip.api.models import JudgedModels
from fleet_slip.base import date_of, normalize_name, pluralize
from fleet_slip.catalog.drive_sources import ALL_DRIVES, TRAINING_DRIVES
from fleet_slip.errors import QuestionError, RefusedError, UsageError
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.storage.runs import step

if TYPE_CHECKING:
    from fleet_slip.calibration.car_calibration import Calibration
    from fleet_slip.models.registry import ModelVersion
    from fleet_slip.operations.find_drives import VacuumReport
    from fleet_slip.operations.forget import ForgetReport, RetentionReport
    from fleet_slip.operations.monitor import Chart
    from fleet_slip.operations.quality_report import QualityReport
    from fleet_slip.operations.rewriting import CompactionReport
    from fleet_slip.operations.status import WarehouseStatus
    from fleet_slip.operations.verify import Verification
    from fleet_slip.warehouse.erasure_log import ErasureSubject


@dataclass(frozen=True)
class Compacted(Answer):
    """What `Fleet.compact` did, or, of a dry run, which files it would remove."""

    compacted: "CompactionReport | None"
    vacuumed: "VacuumReport"

    def parts(self) -> Iterator[Part]:
        """Return what was compacted, and removed."""
        found = self.compacted
        if found is None:
            if self.vacuumed.files:
                yield TextTable("", "would be removed", zip(self.vacuumed.files))
        elif found.changed:
            yield Remark(
                f"{pluralize(found.files_before, 'file')} became {found.files_after}; "
                f"{found.rows_rewritten:,} rows were written again, "
                f"{found.size_bytes_before:,} bytes became {found.size_bytes_after:,}"
            )
        else:
            files = pluralize(found.files_after, "file")
            yield Remark(f"nothing to compact: {files}, large or alone in the day")
        yield self.vacuumed.remark


class HealthAndUpkeep(JudgedModels):
    """Health, quality and drift; checking, compacting, forgetting. Answers say what is wrong."""

    def status(
        self,
        max_age_hours: Annotated[
            float | None, Doc("Data, or a backlog, older than this is a problem.")
        ] = None,
    ) -> "WarehouseStatus":
        """Return the warehouse's health: freshness, backlog, last runs, disk, champions."""
        from fleet_slip.operations.status import status_of

        return status_of(self.warehouse, max_age_hours)

    def quality(
        self,
        cohort: Annotated[
            str, Doc("SQL predicate on the view drives: which drives to examine together.")
        ] = TRAINING_DRIVES,
    ) -> "QualityReport":
        """Find stuck, saturated, biased, noisy, scaled, reversed and swapped sensors by drive.

        Drives are compared with each other, by Gram rows alone; `findings` are the faulty ones.
        Raises what `FleetCohort` raises.
        """
        from fleet_slip.operations.quality_report import examine_drives

        return examine_drives(self.warehouse, cohort)

    def calibrate(self, cohort: Annotated[str, COHORT] = ALL_DRIVES) -> "Calibration":
        """Return how the sensors of every car are off, and what else its drives tell of it.

        Offsets of gyroscope, accelerometer and steering with uncertainties, label or not, from the
        Gram rows of `calibration`. Raises `DataError` without these or without drives,
        and `QuestionError` for an invalid predicate.
        """
        from fleet_slip.calibration.car_calibration import calibrate
        from fleet_slip.warehouse.predicate import parse_cohort

        predicate = parse_cohort(self.warehouse.catalog.signals, cohort)
        return calibrate(self.warehouse, predicate, receivers=True)

    def monitor(
        self,
        model: Annotated["str | ModelVersion | None", MODEL] = None,
        cohort: Annotated[
            str | None,
            Doc("SQL predicate on the view drives. Default: the predicate of its training."),
        ] = None,
        *,
        since: Annotated[
            date | str | None,
            Doc("First new day, YYYY-MM-DD. Default: the one after the days it was trained on."),
        ] = None,
    ) -> "Chart":
        """Chart a model's error on each day since it was trained, with control limits, in degrees.

        `alarms` are the new days beyond the limits. Raises `DataError` for too few training days,
        `UsageError` for another text than a date such as 2024-05-01, and as `Fleet.model`.
        """
        from fleet_slip.operations.monitor import monitor

        return monitor(self.warehouse, self.model(model), cohort, date_of(since, "since"))

    def verify(
        self,
        *,
        full: Annotated[bool, Doc("Compute the Gram rows of all log files again.")] = False,
        grams: Annotated[
            bool,
            Doc(
                "Compute the Gram rows of some log files in several ways, too; compare bit for bit."
            ),
        ] = False,
        repair: Annotated[bool, Doc("Rebuild Gram rows from the logs.")] = False,
        accept_loss: Annotated[
            Sequence[str],
            Doc(
                "Go on without a lost document of which there is no backup: FOLDER/NUMBER.json, "
                "or FOLDER for all of it. May be repeated."
            ),
        ] = (),
        workers: Workers = None,
        progress: ShowProgress | None = None,
    ) -> "Verification":
        """Verify every byte against its checksum, and all tables against each other.

        Progress is in bytes. `damage` is what is wrong, after a repair what is left. Raises
        `StorageError` without a data root, `QuestionError` if nothing is lost at `accept_loss`, and
        `ClusterError`.
        """
        from fleet_slip.grams.check import check_grams
        from fleet_slip.operations.verify import verify

        def look() -> "Verification":
            return verify(
                within_reach(self.warehouse, executor),
                full=full,
                progress=count_from_start(progress),
                executor=unless_local(executor),
            )

        accepted = self.accept_losses(accept_loss) if accept_loss else ()
        with open_workers(self.root, workers) as executor:
            found = look()
            if repair:
                rebuilt = self.repair(found)
                found = look()
                found.rebuilt, found.repaired = rebuilt, True
        found.accepted = accepted
        if grams and not found.damage:
            found.compared = check_grams(self.warehouse)
        return found

    @record_call
    def accept_losses(self, paths: Sequence[str]) -> list[str]:
        """Go on without lost documents, given by files or folders below the root; return the files.

        Raises `QuestionError` if nothing is lost there.
        """
        from fleet_slip.storage.documents import accept_losses

        return accept_losses(self.warehouse.root, paths)

    @record_call
    def repair(self, found: "Verification") -> list[str]:
        """Rebuild what `verify` found damaged; return the paths, below the root."""
        from fleet_slip.operations.verify import repair

        return repair(self.warehouse, found)

    @record_call
    def compact(
        self,
        target_rows: Annotated[
            int | None, Doc("Rows of a file after it, or fewer. Default: 2,000,000.")
        ] = None,
        *,
        retention_hours: Annotated[
            float | None,
            Doc("Keep what a version of the last hours refers to. Default: 168, a week."),
        ] = None,
        dry_run: Annotated[bool, Doc("List the files to be removed, and change nothing.")] = False,
        progress: ShowProgress | None = None,
    ) -> "Compacted":
        """Turn the small log files of each day into large ones, and remove files out of use.

        These are replaced files and leftovers of killed jobs. Progress is in days. Raises
        `StorageError`, and `ConflictError` if others keep changing files.
        """
        from fleet_slip.operations.find_drives import RETENTION_HOURS, vacuum
        from fleet_slip.operations.rewriting import TARGET_ROWS, compact

        hours = RETENTION_HOURS if retention_hours is None else retention_hours
        if dry_run:
            return Compacted(None, vacuum(self.warehouse, hours, dry_run=True))
        with step("compact") as figures:
            report = compact(self.warehouse, target_rows or TARGET_ROWS, count_from_start(progress))
            figures.rows, figures.size_bytes = report.rows_rewritten, report.size_bytes_after
        with step("vacuum") as figures:
            removed = vacuum(self.warehouse, hours)
            figures.size_bytes = removed.size_bytes
        return Compacted(report, removed)

    @record_call
    def forget(
        self,
        *,
        vehicle: Annotated[str | None, Doc("The vehicle_id to forget.")] = None,
        drive: Annotated[str | None, Doc("The drive_id to forget.")] = None,
        now: Annotated[bool, Doc("Delete the old files at once; compact would later.")] = False,
        progress: ShowProgress | None = None,
    ) -> "ForgetReport":
        """Forget a vehicle or a drive; mark the models that were trained on it.

        It leaves logs, Gram rows and quarantine, and no job brings it back until `allow`. While
        anything is `pending` in the report, repeat it. Progress is in files. Raises `UsageError`
        unless one subject is given, `QuestionError` if there never was such a drive, `StorageError`
        and `ConflictError`.
        """
        from fleet_slip.operations.forget import forget

        subject = _subject(vehicle, drive)
        with step("forget") as figures:
            report = forget(self.warehouse, subject, now=now, progress=count_from_start(progress))
            figures.rows = report.rows
        return report

    @record_call
    def allow(self, *, vehicle: str | None = None, drive: str | None = None) -> bool:
        """Let a forgotten vehicle or drive land again; return whether that is new.

        What was forgotten stays so, until `ingest` is given its file again. Raises `UsageError`
        unless one subject is given, `QuestionError` if it was never forgotten, and `RefusedError`
        while it is being forgotten.
        """
        from fleet_slip.warehouse.erasure_log import ErasureLog

        self.warehouse.require()
        subject, erasure_log = _subject(vehicle, drive), ErasureLog(self.root)
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

    @record_call
    def retain(
        self, config: str | None = None, *, progress: ShowProgress | None = None
    ) -> "RetentionReport":
        """Forget drives that are older than a retention file says, then vacuum.

        `config` is its path, by default the one that ships. Progress is in files. Raises
        `RefusedError` if no drive would be left, and as `forget`.
        """
        from fleet_slip.operations.forget import load_retention, retain

        told = count_from_start(progress)
        with step("retain") as figures:
            retention = load_retention(config, self.warehouse.configs)
            report = retain(self.warehouse, retention, date.today(), told)
            figures.rows, figures.size_bytes = report.forgotten.rows, report.vacuumed.size_bytes
        return report


def _subject(vehicle: str | None, drive: str | None) -> "ErasureSubject":
    """Return the one that is given. Raises `UsageError` for none, for both and for a blank name."""
    from fleet_slip.warehouse.erasure_log import ErasureSubject

    names = {"vehicle": vehicle, "drive": drive}
    match [(kind, normalize_name(name)) for kind, name in names.items() if name is not None]:
        case [("vehicle" | "drive" as kind, name)] if name:
            return ErasureSubject(kind, name)
    raise UsageError("give a vehicle or a drive by its name.")
