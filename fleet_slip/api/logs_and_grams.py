"""The part of a `Fleet` that fills the warehouse: logs, and Gram rows made of them."""

from collections.abc import Callable, Iterable
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_slip.api.calls import (
    Rooted,
    ShowProgress,
    Workers,
    count_from_start,
    open_workers,
    record_call,
    unless_local,
    within_reach,
)
from fleet_slip.progress import Progress, no_progress
from fleet_slip.runs.log import step

if TYPE_CHECKING:
    from fleet_slip.grams.received.receiving import ReceiveReport
    from fleet_slip.grams.rows.check_grams import CheckReport
    from fleet_slip.grams.rows.gram_job import GramReport
    from fleet_slip.ingest.drafting.preview import Preview
    from fleet_slip.ingest.landing.ingest_job import IngestReport
    from fleet_slip.ingest.landing.same_recordings import Replace
    from fleet_slip.ingest.logs.log_files import Log
    from fleet_slip.ingest.mapping.mapping import Mapping
    from fleet_slip.maintenance.migration import MigrationReport
    from fleet_slip.simulation.campaign import Campaign
    from fleet_slip.simulation.job import SimulationReport


class LogsAndGrams(Rooted):
    """Simulated and measured logs, and Gram rows. Whatever was done is not done again."""

    @record_call
    def simulate(
        self,
        campaign: "str | Campaign",
        *,
        days: int | None = None,
        through: date | None = None,
        workers: Workers = None,
        progress: ShowProgress | None = None,
    ) -> "SimulationReport":
        """Simulate what is missing of a campaign and write it to the logs.

        `campaign` is the name of one that ships, the path of a TOML file, or a `Campaign`. Of its
        days the first `days` are simulated, up to the day `through`. Progress is in rows.

        Raises `ConfigError` for a campaign that is not valid, `UsageError` if it has no such days,
        `RefusedError` for one that was changed since its drives were written, and `ClusterError`.
        """
        from fleet_slip.simulation.campaign import load_campaign
        from fleet_slip.simulation.job import simulate_campaign

        chosen = load_campaign(campaign) if isinstance(campaign, str) else campaign
        wanted = chosen.chosen_days(days, through)
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
    def receive(
        self,
        files: Iterable[Path | str] | Path | str,
        *,
        each: "Callable[[ReceiveReport], None] | None" = None,
        progress: ShowProgress | None = None,
    ) -> "list[ReceiveReport]":
        """Take in messages of cars that send Gram rows, no logs; return a report of each file.

        A file is messages one behind the other. Of a folder all files are taken, at any depth.
        A file lands once, and so does a message. What is damaged, impossible or contradicts what is
        there goes to the view `quarantine` with a reason. `each` is called with a report once its
        file has landed. Progress is in files.

        Raises `InputError` for a file that cannot be read, when all others are in; `StorageError`;
        and `ConflictError` if other processes keep changing the tables.
        """
        from fleet_slip.grams.received.receiving import find_messages, receive_files

        given = [Path(files)] if isinstance(files, Path | str) else [Path(file) for file in files]
        paths = find_messages(given)
        reports = []
        with step("receive") as figures:
            figures.rows = 0
            for report in receive_files(self.warehouse, paths, count_from_start(progress)):
                reports.append(report)
                figures.rows += report.rows
                if each is not None:
                    each(report)
        return reports

    @record_call
    def ingest(
        self,
        files: Iterable[Path | str] | Path | str,
        mapping: "str | Mapping",
        *,
        as_one: bool = False,
        replace: "Replace" = "no",
        workers: Workers = None,
        each: "Callable[[IngestReport], None] | None" = None,
        progress: ShowProgress | None = None,
    ) -> "list[IngestReport]":
        """Bring measured logs in through a mapping of columns, units and axes.

        `mapping` is the name of one that ships, the path of a TOML file, or a `Mapping`. Rows that
        cannot be used go to the view `quarantine` with a reason. Of a folder all logs are taken, at
        any depth, and of a pattern what matches, but for those that have landed before and have
        not changed; with `as_one` they are parts of one log, whose drives go on from file to file.
        Files on an object store are given as URLs, and copied to the temporary folder to be read.
        Returns a report of each file that was read, in their order; `each` is called with it once
        the file is committed. Progress is in files for folders and patterns, else in rows, where a
        format tells about how many there are. Without a cluster, threads read the small files of
        folders, and large ones come one after the other, each read by all cores.

        A recording that is in the logs already, from another file or through another mapping, is
        told by its bytes and by its samples. If `replace` is `all`, its drives give way to the new
        ones, in one commit; if it is `corrected`, those of the same file do, whose mapping has the
        same name and was changed since.

        Raises `ConfigError` for a mapping that is not valid; `InputError`, when all others are in,
        for files that cannot be used, of which nothing is written, or `RepeatedError` where all of
        these are in already; `StorageError` and `ClusterError`.
        """
        from fleet_slip.ingest.landing.ingest_job import ingest_files
        from fleet_slip.ingest.landing.known_files import KnownFiles
        from fleet_slip.ingest.logs.log_files import find_logs, find_whole_logs, names_several
        from fleet_slip.ingest.mapping.mapping import load_mapping
        from fleet_slip.maintenance.superseding import TakingOut

        plan = load_mapping(mapping) if isinstance(mapping, str) else mapping
        given = [files] if isinstance(files, Path | str) else list(files)
        paths = find_whole_logs(given) if as_one else find_logs(given)
        folders = any(map(names_several, given))
        known = KnownFiles.of(self.warehouse, plan) if folders else None
        told = count_from_start(progress)
        reports = {}
        with open_workers(self.root, workers) as executor, step("ingest") as figures:
            elsewhere = unless_local(executor)
            if elsewhere:  # a worker has a working directory of its own
                paths = [one.absolute() if isinstance(one, Path) else one for one in paths]
            figures.rows = 0
            warehouse = within_reach(self.warehouse, executor)
            wanted = paths
            if known is not None and not as_one:  # what is in a folder its own size does not tell
                wanted = known.without_landed(paths, warehouse)
            if landed := len(paths) - len(wanted):
                told(landed, len(paths))
            by_file = folders and not as_one
            rows = no_progress if by_file or progress is None else _rows_of(wanted, told)
            try:
                threads = executor if by_file else elsewhere
                taking_out = TakingOut(self.warehouse)
                for report in ingest_files(
                    warehouse, wanted, plan, threads, known, rows, replace, taking_out
                ):
                    reports[report.file] = report
                    figures.rows += report.counts.ticks if report.new else 0
                    if each is not None:
                        each(report)
                    if by_file:
                        told(1, len(paths))
            finally:
                if known is not None:
                    known.save(warehouse)
        return [reports[str(path)] for path in wanted]

    @record_call
    def take_back(self, what: str) -> int:
        """Take out what was ingested from a file or through a mapping; return how many drives.

        `what` is the name of a file, or of a mapping, or what the names of a file's drives begin
        with, such as `logger-0123456789ab`. Their Gram rows and refused rows go with them. Other
        than what is forgotten, they land again when they are given again.

        Raises `QuestionError` if there is no such drive, `StorageError` and `ConflictError`.
        """
        from fleet_slip.maintenance.superseding import take_back

        with step("undo"):
            return take_back(self.warehouse, what)

    def preview(
        self,
        files: Iterable[Path | str] | Path | str,
        mapping: "str | Mapping",
        *,
        as_one: bool = False,
    ) -> "list[Preview]":
        """Read measured files as `ingest` does, and store nothing.

        A preview tells rows, drives, what would be rejected, the range of each signal, and what
        looks wrong in the longest drive: a sign, a unit, swapped wheels, a delay of the label.
        Of a folder every log is read, or with `as_one` all as one. Raises like `ingest`.
        """
        from fleet_slip.ingest.drafting.preview import preview_log
        from fleet_slip.ingest.logs.log_files import find_logs, find_whole_logs
        from fleet_slip.ingest.mapping.mapping import load_mapping

        plan = load_mapping(mapping) if isinstance(mapping, str) else mapping
        given = [files] if isinstance(files, Path | str) else list(files)
        logs = find_whole_logs(given) if as_one else find_logs(given)
        return [preview_log(log, plan) for log in logs]

    @record_call
    def gram(
        self,
        features: str = "signals",
        *,
        cohort: str | None = None,
        workers: Workers = None,
        progress: ShowProgress | None = None,
    ) -> "GramReport":
        """Reduce new log files to Gram rows, and drop the rows of files that are gone.

        `features` is a feature set of `configs/features.toml`; `signals` is the logged signals
        themselves. A set that is asked for the first time costs one pass over the logs; from then
        on only new files are read. With a `cohort`, an SQL condition on the view `drives`, only
        files are read that have a drive of it, as the Gram rows of `signals` tell. Progress is in
        rows.

        Raises `QuestionError` for an unknown set, `StorageError`, `ConflictError` and
        `ClusterError`.
        """
        from fleet_slip.grams.cohorts.reader import cohort_files
        from fleet_slip.grams.rows.gram_job import update_grams
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
        """Compute the Gram rows of some log files three ways and compare them, bit for bit.

        By the SQL statement, by float64 matrix products in which every partial sum is an exact
        integer, and by Python integers; and with the stored rows. The files are evenly chosen, and
        those of the next number `begin` are the next ones. Progress is in files.

        Raises `StorageError` naming the first drive whose Gram rows differ, and `DataError` if
        there is nothing to check.
        """
        from fleet_slip.grams.rows.check_grams import check_grams

        return check_grams(self.warehouse, files, count_from_start(progress), begin)

    @record_call
    def migrate(self, *, progress: ShowProgress | None = None) -> "MigrationReport":
        """Bring the logs to the signal catalogue: add columns, convert counts to other scales.

        See `docs/operations.md` before widening a scale. Progress is in rows.

        Raises `RefusedError` if counts would not fit a new scale, and `ConflictError`.
        """
        from fleet_slip.maintenance.migration import migrate

        with step("migrate") as figures:
            report = migrate(self.warehouse, count_from_start(progress))
            figures.rows = report.rows_rewritten
        return report


def _rows_of(logs: "Iterable[Log]", told: Progress) -> Progress:
    """Return what counts the rows read of each log among about so many that all have."""
    from fleet_slip.ingest.formats.reading import expected_rows

    total = sum(map(expected_rows, logs))
    left = total

    def count(more: int, _of_one: int) -> None:
        nonlocal left
        more = min(more, left)  # a guess may be too low, and a batch is written again at a conflict
        left -= more
        told(more, total)

    return count
