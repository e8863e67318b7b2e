"""The part of a `Fleet` that fills the warehouse: logs, and Gram rows made of them."""

from collections.abc import Callable, Iterable
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typing_extensions import Doc

from fleet_slip.api.calls import (
    CAMPAIGN,
    DAYS,
    THROUGH,
    Rooted,
    ShowProgress,
    Workers,
    count_from_start,
    open_workers,
    record_call,
    unless_local,
    within_reach,
)
from fleet_slip.base import last_day
from fleet_slip.catalogue.features import PLAIN
from fleet_slip.storage.runs import step

if TYPE_CHECKING:
    from fleet_slip.grams.check import CheckReport
    from fleet_slip.grams.job import GramReport
    from fleet_slip.grams.on_board import CountedReport
    from fleet_slip.ingest.load import IngestReport, Preview
    from fleet_slip.ingest.log_files import Log
    from fleet_slip.ingest.mapping import Mapping
    from fleet_slip.ingest.recordings import Replace
    from fleet_slip.operations.rewriting import MigrationReport
    from fleet_slip.simulation.campaign import Campaign
    from fleet_slip.simulation.job import SimulationReport


class LogsAndGrams(Rooted):
    """Simulated and measured logs, and Gram rows. Whatever was done is not done again."""

    @record_call
    def simulate(
        self,
        campaign: Annotated["str | Campaign", CAMPAIGN],
        *,
        days: Annotated[int | None, DAYS] = None,
        through: Annotated[date | str | None, THROUGH] = None,
        workers: Workers = None,
        progress: ShowProgress | None = None,
    ) -> "SimulationReport":
        """Simulate what is missing of a campaign and write it to the logs.

        Progress is in rows. Raises `ConfigError` for an invalid campaign, `UsageError` if it has no
        such days, `RefusedError` for one changed since it was written, and `ClusterError`.
        """
        from fleet_slip.simulation.campaign import load_campaign
        from fleet_slip.simulation.job import simulate_campaign

        chosen = load_campaign(campaign) if isinstance(campaign, str) else campaign
        wanted = chosen.chosen_days(days, last_day(through, "through"))
        with open_workers(self.root, workers) as executor, step("simulate") as figures:
            report = simulate_campaign(
                within_reach(self.warehouse, executor),
                chosen,
                wanted,
                executor,
                count_from_start(progress),
            )
            figures.rows, figures.size_bytes = report.rows, report.size_bytes
        return report

    @record_call
    def ingest(
        self,
        files: Iterable[Path | str] | Path | str,
        mapping: "str | Mapping",
        *,
        replace: "Replace" = "no",
        workers: Workers = None,
        each: "Callable[[IngestReport], None] | None" = None,
        progress: ShowProgress | None = None,
    ) -> "list[IngestReport]":
        """Bring measured logs in through a mapping of columns, units and axes.

        `mapping` is a name, the path of a TOML file, or a `Mapping`. Rows that cannot be used go to
        the view `quarantine`. Of folders, at any depth, and patterns, the logs are taken that have
        not landed unchanged. Objects are given as URLs.
        Returns a report of each file read, in order; `each` gets it once the file is committed.
        Progress is in files.
        Without a cluster, threads read a folder's small files; large ones are read one by one, by
        all cores.

        A recording that is there already is recognised by its bytes and samples. With
        `replace="all"` its drives give way to the new ones, in one commit; with `corrected` those
        of the same file and an older state of the same mapping do. Raises `ConfigError` for an
        invalid mapping;
        `InputError`, when all others are in, for files that cannot be used, or `RepeatedError`
        where these are all in already; `StorageError` and `ClusterError`.
        """
        from fleet_slip.ingest.load import ingest_files
        from fleet_slip.ingest.mapping import keep_assumptions
        from fleet_slip.ingest.recordings import KnownFiles
        from fleet_slip.operations.rewriting import take_out

        plan, logs, folders = _chosen_logs(files, mapping)
        count = count_from_start(progress)
        reports: list[IngestReport] = []
        with open_workers(self.root, workers) as executor, step("ingest") as figures:
            elsewhere = unless_local(executor)
            if elsewhere:  # a worker has a working directory of its own
                logs = [one.absolute() if isinstance(one, Path) else one for one in logs]
            figures.rows = 0
            warehouse = within_reach(self.warehouse, executor)
            threads = executor if folders else elsewhere
            out = partial(take_out, self.warehouse)
            remembers = folders or replace == "corrected"
            known = KnownFiles.of(self.warehouse, plan) if remembers else None
            wanted = logs if known is None else known.without_landed(logs, warehouse)
            if landed := len(logs) - len(wanted):
                count(landed, len(logs))
            try:
                for report in ingest_files(warehouse, wanted, plan, threads, known, replace, out):
                    reports.append(report)
                    figures.rows += report.counts.ticks if report.new else 0
                    if each is not None:
                        each(report)
                    count(1, len(logs))
            finally:
                if known is not None:
                    known.save()
                if any(report.new for report in reports):
                    keep_assumptions(self.root, plan)
        order = {str(log): number for number, log in enumerate(logs)}
        return sorted(reports, key=lambda report: order[report.file])

    @record_call
    def ingest_counted(self, file: Path | str) -> "CountedReport":
        """Bring in Gram rows that cars counted: a Parquet table (`docs/export.md`).

        It lands whole and once. Raises `InputError` for a row that no drive can have or of what was
        forgotten, `RepeatedError` for a drive that is there, `StorageError` and `ConflictError`.
        """
        from fleet_slip.grams.on_board import ingest_counted

        with step("ingest") as figures:
            report = ingest_counted(self.warehouse, Path(file))
            figures.rows = report.rows if report.new else 0
        return report

    @record_call
    def take_back(self, what: str) -> int:
        """Take out what was ingested from a file or through a mapping; return how many drives.

        `what` is the name of either, or what a file's drives begin with, such as
        `logger-0123456789ab`. Gram rows and refused rows go too; all can land again. Raises
        `StorageError` and `ConflictError`.
        """
        from fleet_slip.operations.rewriting import take_back

        with step("undo"):
            return take_back(self.warehouse, what)

    def preview(
        self, files: Iterable[Path | str] | Path | str, mapping: "str | Mapping"
    ) -> "list[Preview]":
        """Read measured files as `ingest` does, and store nothing; raises the same.

        Reports rows, drives, rejections, each signal's range, and what `ingest` would find wrong: a
        sign, a unit, swapped wheels.
        """
        from fleet_slip.ingest.load import preview_logs

        plan, logs, _ = _chosen_logs(files, mapping)
        return preview_logs(logs, plan)

    @record_call
    def gram(
        self,
        features: Annotated[
            str,
            Doc(
                "A feature set of configs/features.toml; signals is the logged signals themselves."
            ),
        ] = PLAIN,
        *,
        cohort: Annotated[
            str | None,
            Doc(
                "Read only the log files that have a drive of this cohort, an SQL condition on the "
                "view drives. Default: all."
            ),
        ] = None,
        workers: Workers = None,
        progress: ShowProgress | None = None,
    ) -> "GramReport":
        """Reduce new log files to Gram rows, and drop the rows of files that are gone.

        A set's first time costs a pass over the logs. Which files have a cohort's drives is known
        from the Gram rows of `signals`. Progress is in rows. Raises `QuestionError` for an unknown
        set, `StorageError`, `ConflictError` and `ClusterError`.
        """
        from fleet_slip.grams.job import update_grams
        from fleet_slip.grams.reader import cohort_files
        from fleet_slip.warehouse.condition import parse_cohort

        among = cohort_files(self.warehouse, parse_cohort(cohort)) if cohort else None
        with open_workers(self.root, workers) as executor, step("gram") as figures:
            report = update_grams(
                within_reach(self.warehouse, executor),
                count_from_start(progress),
                features,
                unless_local(executor),
                among,
            )
            figures.rows = report.rows_read
        return report

    def check(
        self, files: int = 4, *, begin: int = 0, progress: ShowProgress | None = None
    ) -> "CheckReport":
        """Compute the Gram rows of some log files three ways; compare them bit for bit.

        By the compiled kernel, by SQL where a set has it, and as stored. Files are evenly chosen;
        those of `begin` + 1 are the next ones. Progress is in files. Raises `StorageError` naming
        the first drive that differs, and `DataError` if there is nothing to check.
        """
        from fleet_slip.grams.check import check_grams

        return check_grams(self.warehouse, files, count_from_start(progress), begin)

    @record_call
    def migrate(self) -> "MigrationReport":
        """Bring the tables to this program and its catalogue (`docs/configuration.md`).

        Raises `RefusedError` if the counts are in other scales, and `ConflictError`.
        """
        from fleet_slip.operations.rewriting import migrate

        with step("migrate"):
            return migrate(self.warehouse)


def _chosen_logs(
    files: Iterable[Path | str] | Path | str, mapping: "str | Mapping"
) -> "tuple[Mapping, list[Log], bool]":
    """Return a mapping, the logs that are meant, and whether these are in folders or patterns."""
    from fleet_slip.ingest.log_files import find_logs, names_several
    from fleet_slip.ingest.mapping import load_mapping

    plan = load_mapping(mapping) if isinstance(mapping, str) else mapping
    given = [files] if isinstance(files, Path | str) else list(files)
    return plan, find_logs(given), any(map(names_several, given))
