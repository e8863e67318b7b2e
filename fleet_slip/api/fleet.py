"""The fleet of a data root: its logs, Gram rows, queries and pipelines."""

import dataclasses
import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Self

from fleet_slip.api import calls
from fleet_slip.base import date_of, last_day
from fleet_slip.catalog.features import PLAIN
from fleet_slip.catalog.signals import TRAINING_DRIVES
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.runs import LOGGER, step

if TYPE_CHECKING:
    import duckdb

    from fleet_slip.api.fleet_evaluation import FleetEvaluation
    from fleet_slip.api.fleet_maintenance import FleetMaintenance
    from fleet_slip.api.fleet_models import FleetCohort, FleetModels
    from fleet_slip.api.pipelines import LearnReport, RunReport
    from fleet_slip.grams.on_board import OnboardImport
    from fleet_slip.grams.update import GramReport
    from fleet_slip.ingest.logs import IngestReport, Preview
    from fleet_slip.ingest.mapping import Mapping
    from fleet_slip.ingest.recordings import Replace
    from fleet_slip.operations.night import NightReport
    from fleet_slip.simulation.campaign import Campaign
    from fleet_slip.simulation.simulate import Engine, SimulationReport
    from fleet_slip.views import Session
    from fleet_slip.warehouse.warehouse import Warehouse


class Fleet:
    """The fleet of a data root; `fleet_slip.open` returns one.

    Threads may share it. Close it, or use it in a `with` block, to release the tables and models
    that it keeps between calls; it can be used again afterwards. Calls that change the data root
    are recorded in the view `runs`. Every call raises `StorageError` if the root cannot be read or
    written.

    Attributes
    ----------
    models : FleetModels
        Publishes, lists, compares and exports models.
    evaluation : FleetEvaluation
        Scores models, and compares them with filters on test drives.
    maintenance : FleetMaintenance
        Reports health, sensor faults and drift; verifies, compacts and erases.
    """

    def __init__(self, warehouse: "Warehouse") -> None:
        self.warehouse = warehouse

    @property
    def root(self) -> Folder:
        """The data root: a local folder, or a folder of an object store."""
        return self.warehouse.root

    @property
    def models(self) -> "FleetModels":
        """The registry of published models, and what publishes and exports them."""
        from fleet_slip.api.fleet_models import FleetModels

        return FleetModels(self.warehouse)

    @property
    def evaluation(self) -> "FleetEvaluation":
        """Scores, evaluations, reports and pages of drives."""
        from fleet_slip.api.fleet_evaluation import FleetEvaluation

        return FleetEvaluation(self.warehouse)

    @property
    def maintenance(self) -> "FleetMaintenance":
        """Health, sensor quality and drift; verification, compaction and erasure."""
        from fleet_slip.api.fleet_maintenance import FleetMaintenance

        return FleetMaintenance(self.warehouse)

    def close(self) -> None:
        """Release the tables and models that are kept between calls."""
        self.warehouse.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Fleet({str(self.root)!r})"

    # Queries.

    def sql(self, query: str, *, threads: int | None = None) -> "duckdb.DuckDBPyRelation":
        """Query the views of the data root.

        Parameters
        ----------
        query
            One SQL statement that reads. Drives of evaluation scenarios are included only if the
            query names the column `source`.
        threads
            Threads of DuckDB. None means one per core.

        Returns
        -------
        duckdb.DuckDBPyRelation
            A relation that is computed by `.df()`, `.pl()`, `.to_arrow_table()` or `.fetchall()`.
            It keeps its connection open.

        Raises
        ------
        QuestionError
            If the query is invalid or would write.
        StorageError
            If there is no data root.
        """
        return self.session(query, threads=threads).sql(query)

    def session(
        self, query: str | None = None, *, threads: int | None = None, unlocked: bool = False
    ) -> "Session":
        """Open the views for several queries, which all read the same commits.

        Parameters
        ----------
        query
            If given, open only the views that it names, which is faster.
        threads
            Threads of DuckDB. None means one per core.
        unlocked
            Allow any statement, and any file that the user may read or write. Use it only for SQL
            that you trust: it can overwrite the data root.

        Raises
        ------
        StorageError
            If there is no data root.
        """
        from fleet_slip.views import Session, open_views

        database = open_views(self.warehouse, query, threads, unlocked=unlocked)
        return Session(database, unlocked)

    def cohort(
        self, predicate: str = TRAINING_DRIVES, *, include_faulty: bool = False
    ) -> "FleetCohort":
        """Select the drives that satisfy an SQL predicate.

        Parameters
        ----------
        predicate
            SQL predicate on the view `drives`, such as `"track = 'waterford_hills'"`. Default: all
            drives but those of evaluation scenarios.
        include_faulty
            Include drives with faulty sensors.
        """
        from fleet_slip.api.fleet_models import FleetCohort

        return FleetCohort(self.warehouse, predicate, include_faulty)

    # Logs and Gram rows. Completed work is never repeated.

    @calls.record_call
    def simulate(
        self,
        campaign: "str | Campaign",
        *,
        days: int | None = None,
        through: date | str | None = None,
        engine: "Engine" = "kernel",
        workers: calls.Workers = None,
        progress: calls.ShowProgress | None = None,
    ) -> "SimulationReport":
        """Simulate the drives of a campaign that are missing in the logs.

        Parameters
        ----------
        campaign
            Name of a campaign of `configs/campaigns`, path of a TOML file, or a `Campaign`.
        days
            Simulate only the first days of the campaign. None means all.
        through
            Last day to simulate: a date, `YYYY-MM-DD`, or `today`. None means all days.
        engine
            `kernel`, the compiled loop, or `highway-env`: its vehicle drives each sample, which
            is slower and writes the same logs.
        workers
            A number of threads, the address of a Dask scheduler, or an executor.
        progress
            Called with the rows done so far and the rows in total.

        Raises
        ------
        ConfigError
            If the campaign is invalid.
        UsageError
            If the campaign has no such days.
        RefusedError
            If the campaign changed since its logs were written.
        ClusterError
            If the cluster cannot be used.
        """
        from fleet_slip.simulation.campaign import load_campaign
        from fleet_slip.simulation.simulate import simulate_campaign

        if isinstance(campaign, str):
            campaign = load_campaign(campaign, self.warehouse.configs)
        chosen_days = campaign.chosen_days(days, last_day(through))
        with calls.open_workers(self.root, workers) as executor, step("simulate") as figures:
            report = simulate_campaign(
                calls.for_workers(self.warehouse, executor),
                campaign,
                chosen_days,
                executor,
                calls.total_progress(progress),
                engine,
            )
            figures.rows, figures.size_bytes = report.rows, report.size_bytes
        return report

    @calls.record_call
    def ingest(
        self,
        files: Iterable[Path | str] | Path | str,
        mapping: "str | Mapping",
        *,
        replace: "Replace" = "no",
        workers: calls.Workers = None,
        on_report: "Callable[[IngestReport], None] | None" = None,
        progress: calls.ShowProgress | None = None,
    ) -> "list[IngestReport]":
        """Bring measured logs into the data root.

        Rows that cannot be used go to the view `quarantine` with a reason. A recording that was
        ingested before is recognised by its bytes and samples.

        Parameters
        ----------
        files
            Log files, folders at any depth, or patterns. Of folders and patterns, files that were
            ingested unchanged are skipped.
        mapping
            The mapping of columns, units and axes: a name, the path of a TOML file, or a `Mapping`.
        replace
            `all` replaces the drives of the same recordings, in one commit. `corrected` replaces
            drives of the same file that an older state of this mapping wrote.
        workers
            A number of threads, the address of a Dask scheduler, or an executor. Threads read the
            small files of a folder; large files are read one by one by all cores.
        on_report
            Called with the report of each file after its commit.
        progress
            Called with the files done so far and the files in total.

        Returns
        -------
        list of IngestReport
            A report of each file that was read, in the order of the files.

        Raises
        ------
        ConfigError
            If the mapping is invalid.
        InputError
            If a file cannot be used; all other files are ingested first.
        RepeatedError
            If recordings are in the logs already; all others are ingested first.
        ClusterError
            If the cluster cannot be used.
        """
        from fleet_slip.ingest.logs import ingest_files
        from fleet_slip.ingest.mapping import store_assumptions
        from fleet_slip.ingest.recordings import IngestCache
        from fleet_slip.operations.rewriting import build_removal

        mapping = self._load_mapping(mapping)
        logs, from_folders = self._find_logs(files, mapping)
        count = calls.total_progress(progress)
        reports: list[IngestReport] = []
        with calls.open_workers(self.root, workers) as executor, step("ingest") as figures:
            remote = calls.remote_executor(executor)
            if remote:  # workers have their own working directory
                logs = [log.absolute() for log in logs]
            figures.rows = 0
            warehouse = calls.for_workers(self.warehouse, executor)
            uses_cache = from_folders or replace == "corrected"
            cache = IngestCache.load(self.warehouse, mapping) if uses_cache else None
            new_logs = logs if cache is None else cache.find_new_files(logs, warehouse)
            if skipped := len(logs) - len(new_logs):
                count(skipped, len(logs))
            # Threads read the small files of folders. A file that is named is read by all cores.
            readers = executor if from_folders else remote
            try:
                for report in ingest_files(
                    warehouse,
                    new_logs,
                    mapping,
                    readers,
                    cache,
                    replace,
                    partial(build_removal, self.warehouse),
                ):
                    reports.append(report)
                    figures.rows += report.counts.ticks if report.new else 0
                    if on_report is not None:
                        on_report(report)
                    count(1, len(logs))
            finally:
                if cache is not None:
                    cache.save()
                if any(report.new for report in reports):
                    store_assumptions(self.root, mapping)
        order = {str(log): number for number, log in enumerate(logs)}
        return sorted(reports, key=lambda report: order[report.file])

    @calls.record_call
    def import_onboard_grams(self, file: Path | str) -> "OnboardImport":
        """Bring in Gram rows that cars computed on board, in one commit.

        Parameters
        ----------
        file
            A Parquet table of Gram rows, as described in `docs/export.md`.

        Raises
        ------
        InputError
            If a row is impossible for any drive, or belongs to an erased drive or vehicle.
        RepeatedError
            If the Gram rows of a drive are in the data root already.
        ConflictError
            If other processes keep changing the table.
        """
        from fleet_slip.grams.on_board import import_onboard_grams

        with step("ingest") as figures:
            report = import_onboard_grams(self.warehouse, Path(file))
            figures.rows = report.rows if report.new else 0
        return report

    def preview(
        self, files: Iterable[Path | str] | Path | str, mapping: "str | Mapping"
    ) -> "list[Preview]":
        """Read measured logs as `ingest` does, and store nothing.

        Returns
        -------
        list of Preview
            For each file its rows, drives, rejected rows and ranges of signals, and what looks
            wrong: a sign, a unit, swapped wheels.

        Raises
        ------
        ConfigError, InputError
            As `ingest`.
        """
        from fleet_slip.ingest.logs import preview_logs

        mapping = self._load_mapping(mapping)
        logs, _ = self._find_logs(files, mapping)
        return preview_logs(logs, mapping)

    @calls.record_call
    def gram(
        self,
        features: str = PLAIN,
        *,
        cohort: str | None = None,
        workers: calls.Workers = None,
        progress: calls.ShowProgress | None = None,
    ) -> "GramReport":
        """Reduce new log files to Gram rows, and drop the Gram rows of deleted files.

        Parameters
        ----------
        features
            A feature set of `configs/features.toml`. The first call for a set reads all logs;
            later calls read new files. Default: the logged signals.
        cohort
            SQL predicate on the view `drives`. Only log files with a drive of this cohort are
            read; the Gram rows of the logged signals tell which. None means all files.
        workers
            A number of threads, the address of a Dask scheduler, or an executor.
        progress
            Called with the rows done so far and the rows in total.

        Raises
        ------
        QuestionError
            If there is no such feature set, or the predicate is invalid.
        ConflictError
            If other processes keep changing the tables.
        ClusterError
            If the cluster cannot be used.
        """
        from fleet_slip.grams.update import update_grams
        from fleet_slip.warehouse.database import parse_cohort
        from fleet_slip.warehouse.gram_reader import cohort_files

        files = None
        if cohort:
            signals = self.warehouse.catalog.signals
            files = cohort_files(self.warehouse, parse_cohort(signals, cohort))
        with calls.open_workers(self.root, workers) as executor, step("gram") as figures:
            report = update_grams(
                calls.for_workers(self.warehouse, executor),
                calls.total_progress(progress),
                features,
                calls.remote_executor(executor),
                files,
            )
            figures.rows = report.rows_read
        return report

    # Pipelines.

    @calls.record_call
    def run(
        self,
        campaign: "str | Campaign" = "waterford",
        *,
        days: int | None = None,
        through: date | str | None = None,
        name: str | None = None,
        models: str | None = None,
        workers: calls.Workers = None,
        progress: calls.ShowStep | None = None,
    ) -> "RunReport":
        """Simulate a campaign, update Gram rows, select a model, publish it if it is not worse.

        It can be repeated at any time, also after an interruption. A second run of the campaign on
        this machine waits for the first.

        Parameters
        ----------
        campaign, days, through, workers
            As in `simulate`.
        name
            Name of the model. Default: the campaign's.
        models
            A model list of `configs/models`, or a TOML file. Default: `estimator`.
        progress
            Called with the name of the step, the rows done so far and the rows in total.

        Returns
        -------
        RunReport
            Results of each step. A winner that is worse than the champion is not published; the
            report gives the reason.

        Raises
        ------
        FleetSlipError
            As `simulate`, `gram`, `FleetCohort.select` and `FleetModels.publish`.
        """
        from fleet_slip.api.pipelines import RunReport, Training
        from fleet_slip.models.manifest import require_model_name
        from fleet_slip.models.request import DEFAULT_MODELS
        from fleet_slip.simulation.campaign import load_campaign

        start = time.monotonic()
        if isinstance(campaign, str):
            campaign = load_campaign(campaign, self.warehouse.configs)
        model_name = require_model_name(name or campaign.name)
        predicate = f"campaign = '{campaign.name}'"
        with self._exclusive("run", campaign.name):
            with calls.open_workers(self.root, workers) as executor:
                simulation = self.simulate(
                    campaign,
                    days=days,
                    through=through,
                    workers=executor,
                    progress=calls.step_progress(progress, f"simulate {campaign.name}"),
                )
                training = Training(model_name, predicate, models or DEFAULT_MODELS)
                grams = training.gram(self, executor, progress)
            selection, publication, refusal = training.publish(self, replace_marked=True)
        return RunReport(
            campaign=campaign.name,
            simulation=simulation,
            grams=grams,
            selection=selection,
            publication=publication,
            refusal=refusal,
            seconds=round(time.monotonic() - start, 3),
        )

    @calls.record_call
    def learn(
        self,
        name: str,
        logs: Iterable[Path | str] | Path | str,
        mapping: "str | Mapping",
        *,
        workers: calls.Workers = None,
        progress: calls.ShowStep | None = None,
    ) -> "LearnReport":
        """Train a model on measured logs: ingest, update Gram rows, select and publish.

        The label is the side-slip angle of the mapping, else its course over ground. Drives with
        faulty sensors are left out. Drives of a corrected mapping replace the older ones.

        Parameters
        ----------
        name
            Name of the model, such as `golf`.
        logs, mapping, workers
            As `files`, `mapping` and `workers` of `ingest`.
        progress
            Called with the name of the step, the units done so far and the units in total.

        Returns
        -------
        LearnReport
            Results and assumptions of each step. Its `problem` is the error of files that could
            not be used, a refusal to publish, or a fault in the logs.

        Raises
        ------
        ConfigError
            If the mapping is invalid or has neither label.
        FleetSlipError
            As `ingest`, `gram` and `FleetCohort.select`.
        """
        from fleet_slip.api.pipelines import LearnReport, Training
        from fleet_slip.errors import InputError
        from fleet_slip.models.manifest import require_model_name

        start = time.monotonic()
        mapping = self._load_mapping(mapping)
        training = Training.on_mapping(require_model_name(name), mapping)
        reports: list[IngestReport] = []
        failure = None
        with self._exclusive("learn", name), calls.open_workers(self.root, workers) as executor:
            try:
                self.ingest(
                    logs,
                    mapping,
                    replace="corrected",
                    workers=executor,
                    on_report=reports.append,
                    progress=calls.step_progress(progress, "ingest"),
                )
            except InputError as error:
                if not reports:
                    raise
                failure = error
            grams = training.gram(self, executor, progress)
            examined = self.cohort(training.cohort).examine()
            training = dataclasses.replace(training, cohort=examined.cohort)
            selection, publication, refusal = training.publish(self)
        return LearnReport(
            model=name,
            mapping=mapping.name,
            ingested=tuple(reports),
            failure=failure,
            grams=grams,
            selection=selection and dataclasses.replace(selection, examined=str(examined)),
            publication=publication,
            refusal=refusal,
            seconds=round(time.monotonic() - start, 3),
        )

    @calls.record_call
    def nightly(
        self,
        inbox: Path | str,
        mapping: str,
        name: str,
        *,
        cohort: str = TRAINING_DRIVES,
        models: str | None = None,
        candidate: bool = False,
        retention: str | None = None,
        night: date | str | None = None,
        workers: calls.Workers = None,
        progress: calls.ShowStep | None = None,
    ) -> "NightReport":
        """Run the nightly job of a fleet of real cars.

        It ingests new logs, erases drives older than the retention period, updates Gram rows,
        checks sensors, charts the champion's error, trains again without faulty drives, and
        verifies a sample of log files. The winner becomes champion if it is not worse, else a
        candidate. A night that was killed and is repeated ends where it would have ended. A second
        night of the model on this machine waits for the first.

        Parameters
        ----------
        inbox
            Folder of logs. New logs in it are ingested.
        mapping
            Name of a mapping of `configs/mappings`, or the path of a TOML file.
        name
            Name of the model.
        cohort
            SQL predicate on the view `drives`: the drives that train the model.
        models
            A model list of `configs/models`, or a TOML file. Default: `estimator`.
        candidate
            Publish the winner as a candidate even if it is not worse.
        retention
            Path of a retention file. Default: `retention.toml` of the configs.
        night
            Date of the night. Default: today.
        workers, progress
            As in `run`.

        Returns
        -------
        NightReport
            Results of each step. Its `problem` is the first failure, else what needs attention.

        Raises
        ------
        UsageError
            If the name or the date is invalid.
        StorageError
            If the night cannot be recorded.
        """
        from fleet_slip.api.pipelines import NightlyPipeline, Training
        from fleet_slip.models.manifest import require_model_name
        from fleet_slip.models.request import DEFAULT_MODELS

        require_model_name(name)
        day = date_of(night, "night") or date.today()
        with self._exclusive("nightly", name):
            return NightlyPipeline(
                fleet=self,
                inbox=Path(inbox),
                mapping=mapping,
                training=Training(name, cohort, models or DEFAULT_MODELS),
                candidate=candidate,
                retention=retention,
                night=day,
                workers=workers,
                progress=progress,
            ).run()

    def _exclusive(self, job: str, name: str) -> AbstractContextManager[None]:
        """Wait while another process of this machine does the same job, with a remark."""
        waiting = partial(LOGGER.info, "%s: waiting for another fleet-slip %s", name, job)
        return self.root.exclusive(f".{job}-{name}.lock", waiting)

    def _load_mapping(self, mapping: "str | Mapping") -> "Mapping":
        from fleet_slip.ingest.mapping import load_mapping

        if isinstance(mapping, str):
            return load_mapping(mapping, self.warehouse.catalog)
        return mapping

    def _find_logs(
        self, files: Iterable[Path | str] | Path | str, mapping: "Mapping"
    ) -> tuple[list[Path], bool]:
        """Return the log files, and True if any is from a folder or pattern."""
        from fleet_slip.ingest.log_files import find_logs, names_several

        paths = [files] if isinstance(files, Path | str) else list(files)
        return find_logs(paths, mapping), any(map(names_several, paths))
