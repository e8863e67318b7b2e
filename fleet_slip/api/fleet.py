"""A fleet's warehouse in Python."""

import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from typing_extensions import Doc

from fleet_slip.api.calls import (
    CAMPAIGN,
    COHORT,
    DAYS,
    MODELS,
    THROUGH,
    UNEXAMINED,
    NightRequest,
    ShowProgress,
    ShowStep,
    Workers,
    count_from_start,
    of_step,
    open_workers,
    record_call,
    takes,
    unless_local,
    within_reach,
)
from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.operations import HealthAndUpkeep
from fleet_slip.base import last_day
from fleet_slip.catalog.drive_sources import TRAINING_DRIVES
from fleet_slip.catalog.features import PLAIN
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.request import DEFAULT_MODELS, TOLERANCE
from fleet_slip.storage.runs import LOGGER, step

if TYPE_CHECKING:
    import duckdb

    from fleet_slip.api.session import Session
    from fleet_slip.api.training import LearnReport, RunReport
    from fleet_slip.grams.check import CheckReport
    from fleet_slip.grams.on_board import OnboardImport
    from fleet_slip.grams.update import GramReport
    from fleet_slip.ingest.load import IngestReport, Preview
    from fleet_slip.ingest.mapping import Mapping
    from fleet_slip.ingest.recordings import Replace
    from fleet_slip.operations.night import NightReport
    from fleet_slip.operations.rewriting import MigrationReport
    from fleet_slip.simulation.campaign import Campaign
    from fleet_slip.simulation.simulate import SimulationReport


class Fleet(HealthAndUpkeep):
    """All that can be asked of a data root, and done to it; `fleet_slip.open` makes one.

    Threads may share it. Close it, or use it in a `with` block, to release what it keeps between
    calls; it can be used again afterwards. Changes leave a record in the view `runs`. Every call
    raises `StorageError` where the root cannot be read or written.
    """

    def close(self) -> None:
        """Release the connections and models that the warehouse keeps between calls."""
        self.warehouse.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def sql(self, query: str, *, threads: int | None = None) -> "duckdb.DuckDBPyRelation":
        """Return the answer to an SQL query on the views as a DuckDB relation.

        It is computed when asked for rows: `.df()`, `.pl()`, `.to_arrow_table()`, `.fetchall()`;
        what is made of it keeps the connection open. Evaluation scenarios are there if the query
        names the column `source`. Raises `QuestionError` for a query
        that is not valid or would write, and `StorageError` without a data root.
        """
        return self.session(query, threads=threads).sql(query)

    def session(
        self,
        query: str | None = None,
        *,
        threads: int | None = None,
        unlocked: bool = False,
    ) -> "Session":
        """Open the views of this moment for many queries, which all see the same commits.

        With a `query`, only those that it names, which is faster. For scenarios see `sql`. If it
        is `unlocked`, it allows any statement, and any file that you may read or write: only for
        SQL that you trust, since it can overwrite the warehouse. Raises `StorageError` without a
        data root.
        """
        from fleet_slip.api.session import Session
        from fleet_slip.views import open_views

        opened = open_views(self.warehouse, query, threads, unlocked=unlocked)
        return Session(opened, unlocked)

    def cohort(
        self,
        predicate: Annotated[str, COHORT] = TRAINING_DRIVES,
        *,
        include_faulty: Annotated[bool, UNEXAMINED] = False,
    ) -> FleetCohort:
        """Return the drives of an SQL predicate, by default all but evaluation scenarios."""
        return FleetCohort(self.warehouse, predicate, include_faulty)

    # Logs, and Gram rows made of them. Whatever was done is not done again.

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
        from fleet_slip.simulation.simulate import simulate_campaign

        chosen = campaign
        if isinstance(chosen, str):
            chosen = load_campaign(chosen, self.warehouse.configs)
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
        not landed unchanged.
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
        from fleet_slip.ingest.recordings import IngestCache
        from fleet_slip.operations.rewriting import build_removal

        plan, logs, folders = self._chosen_logs(files, mapping)
        count = count_from_start(progress)
        reports: list[IngestReport] = []
        with open_workers(self.root, workers) as executor, step("ingest") as figures:
            elsewhere = unless_local(executor)
            if elsewhere:  # a worker has a working directory of its own
                logs = [one.absolute() for one in logs]
            figures.rows = 0
            warehouse = within_reach(self.warehouse, executor)
            threads = executor if folders else elsewhere
            out = partial(build_removal, self.warehouse)
            remembers = folders or replace == "corrected"
            known = IngestCache.of(self.warehouse, plan) if remembers else None
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
    def import_onboard_grams(self, file: Path | str) -> "OnboardImport":
        """Bring in Gram rows that cars counted: a Parquet table (`docs/export.md`).

        It lands whole and once. Raises `InputError` for a row that no drive can have or of what was
        forgotten, `RepeatedError` for a drive that is there, `StorageError` and `ConflictError`.
        """
        from fleet_slip.grams.on_board import import_onboard_grams

        with step("ingest") as figures:
            report = import_onboard_grams(self.warehouse, Path(file))
            figures.rows = report.rows if report.new else 0
        return report

    def preview(
        self, files: Iterable[Path | str] | Path | str, mapping: "str | Mapping"
    ) -> "list[Preview]":
        """Read measured files as `ingest` does, and store nothing; raises the same.

        Reports rows, drives, rejections, each signal's range, and what `ingest` would find wrong: a
        sign, a unit, swapped wheels.
        """
        from fleet_slip.ingest.load import preview_logs

        plan, logs, _ = self._chosen_logs(files, mapping)
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
                "Read only the log files that have a drive of this cohort, an SQL predicate on the "
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
        from fleet_slip.grams.update import update_grams
        from fleet_slip.warehouse.gram_reader import cohort_files
        from fleet_slip.warehouse.predicate import parse_cohort

        among = None
        if cohort:
            predicate = parse_cohort(self.warehouse.catalog.signals, cohort)
            among = cohort_files(self.warehouse, predicate)
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
        """Bring the tables to this program and its catalog (`docs/configuration.md`).

        Raises `RefusedError` if the counts are in other scales, and `ConflictError`.
        """
        from fleet_slip.operations.rewriting import migrate

        with step("migrate"):
            return migrate(self.warehouse)

    # The whole job.

    @record_call
    def run(
        self,
        campaign: Annotated["str | Campaign", CAMPAIGN] = "waterford",
        *,
        days: Annotated[int | None, DAYS] = None,
        through: Annotated[date | str | None, THROUGH] = None,
        name: Annotated[str | None, Doc("Name of the model. Default: the campaign's.")] = None,
        models: Annotated[str, MODELS] = DEFAULT_MODELS,
        tolerance: Annotated[str | None, TOLERANCE] = None,
        workers: Workers = None,
        progress: ShowStep | None = None,
    ) -> "RunReport":
        """Do the whole job: simulate what is missing, gram, select, publish if it is not worse.

        It can be repeated at any time, and after any interruption: what is done is not done again.
        A second run of the campaign on this machine waits for the first, and says so. A winner that
        is worse than the champion is no error: the report says so. Progress is in rows of each
        step. Raises what `simulate`, `gram`, `FleetCohort.select` and `publish` raise.
        """
        from fleet_slip.api.training import RunReport, Training
        from fleet_slip.models.request import parse_tolerance
        from fleet_slip.simulation.campaign import load_campaign

        begun = time.monotonic()
        chosen = campaign
        if isinstance(chosen, str):
            chosen = load_campaign(chosen, self.warehouse.configs)
        model_name = require_model_name(name or chosen.name)
        parse_tolerance(tolerance)  # before anything is written
        predicate = f"campaign = '{chosen.name}'"
        with self._alone("run", chosen.name):
            with open_workers(self.root, workers) as executor:
                simulation = self.simulate(
                    chosen,
                    days=days,
                    through=through,
                    workers=executor,
                    progress=of_step(progress, f"simulate {chosen.name}"),
                )
                training = Training(model_name, predicate, models, tolerance)
                grams = training.gram(self, executor, progress)
            selection, publication, refusal = training.publish(self, replace_marked=True)
        return RunReport(
            campaign=chosen.name,
            simulation=simulation,
            grams=grams,
            selection=selection,
            publication=publication,
            refusal=refusal,
            seconds=round(time.monotonic() - begun, 3),
        )

    @record_call
    def learn(
        self,
        name: Annotated[str, Doc("Name of the model, such as golf.")],
        logs: Annotated[
            Iterable[Path | str] | Path | str,
            Doc("Measured logs, or folders of them, of which what is new is taken."),
        ],
        mapping: Annotated["str | Mapping", Doc("A mapping: of configs/mappings, or a TOML file.")],
        *,
        workers: Workers = None,
        progress: ShowStep | None = None,
    ) -> "LearnReport":
        """Make a model of measured logs: ingest, gram, select and publish.

        It is trained on the drives of this mapping, without faulty ones; on their
        side-slip angle, or on the course where the mapping has no such angle. What is done is not
        done again. Drives give way to those of a corrected mapping. Files that cannot be used are
        passed over and are the `problem` of the report; so is a refusal.

        Raises `ConfigError` for an invalid mapping or one that has neither label, and what
        `ingest`, `gram` and `FleetCohort.select` raise.
        """
        from fleet_slip.api.training import LearnReport, Training
        from fleet_slip.errors import InputError

        begun = time.monotonic()
        plan = self._chosen_mapping(mapping)
        training = Training.on_mapping(require_model_name(name), plan)
        reports: list[IngestReport] = []
        failure = None
        with self._alone("learn", name), open_workers(self.root, workers) as executor:
            try:
                self.ingest(
                    logs,
                    plan,
                    replace="corrected",
                    workers=executor,
                    each=reports.append,
                    progress=of_step(progress, "ingest"),
                )
            except InputError as error:
                if not reports:
                    raise
                failure = error
            grams = training.gram(self, executor, progress)
            examined = self.cohort(training.cohort).examine()
            training = replace(training, cohort=examined.cohort)
            with examined.explaining():
                selection, publication, refusal = training.publish(self)
        return LearnReport(
            model=name,
            mapping=plan.name,
            ingested=tuple(reports),
            failure=failure,
            grams=grams,
            selection=selection and replace(selection, examined=str(examined)),
            publication=publication,
            refusal=refusal,
            seconds=round(time.monotonic() - begun, 3),
        )

    @record_call
    @takes(NightRequest)
    def nightly(self, request: NightRequest) -> "NightReport":
        """Do all that a night with real cars asks for, and tell how each step went.

        Ingest what is new, forget what is too old, update Gram rows, examine sensors, chart the
        champion's error, train again without the faulty drives, and verify some log files, the next
        ones on the next night. The winner becomes champion if it is not worse, else a candidate. A
        night that was killed and is given again ends where it would have ended. A second one of the
        model on this machine waits for the first, and says so.

        What goes wrong in a step is in the report, whose `problem` is what a command fails with;
        later steps go on where they can. Raises `UsageError` for an invalid name or tolerance, and
        `StorageError` if the night cannot be recorded.
        """
        from fleet_slip.api.nightly import Night
        from fleet_slip.models.request import parse_tolerance

        parse_tolerance(request.tolerance)
        require_model_name(request.name)
        with self._alone("nightly", request.name):
            return Night(self, request).run()

    def _alone(self, job: str, name: str) -> AbstractContextManager[None]:
        """Wait while another process of this machine does the same, and say so."""
        waiting = partial(LOGGER.info, "%s: waiting for another fleet-slip %s", name, job)
        return self.root.exclusive(f".{job}-{name}.lock", waiting)

    def _chosen_mapping(self, mapping: "str | Mapping") -> "Mapping":
        from fleet_slip.ingest.mapping import load_mapping

        if isinstance(mapping, str):
            return load_mapping(mapping, self.warehouse.catalog)
        return mapping

    def _chosen_logs(
        self, files: Iterable[Path | str] | Path | str, mapping: "str | Mapping"
    ) -> "tuple[Mapping, list[Path], bool]":
        """Return a mapping, the chosen logs, and whether these are in folders or patterns."""
        from fleet_slip.ingest.log_files import find_logs, names_several

        plan = self._chosen_mapping(mapping)
        paths = [files] if isinstance(files, Path | str) else list(files)
        return plan, find_logs(paths), any(map(names_several, paths))
