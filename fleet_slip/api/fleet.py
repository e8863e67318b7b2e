"""A fleet's warehouse in Python."""

import time
from collections.abc import Iterable
from dataclasses import replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typing_extensions import Doc

from fleet_slip.api.calls import (
    CAMPAIGN,
    COHORT,
    DAYS,
    MODELS,
    THROUGH,
    UNEXAMINED,
    NightRequest,
    ShowStep,
    Workers,
    of_step,
    open_workers,
    record_call,
    takes,
)
from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.logs import LogsAndGrams
from fleet_slip.api.operations import HealthAndUpkeep
from fleet_slip.catalogue.facts import TRAINING_DRIVES
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.request import DEFAULT_MODELS, WORTH
from fleet_slip.storage.runs import LOGGER

if TYPE_CHECKING:
    import duckdb

    from fleet_slip.api.session import LearnReport, RunReport, Session
    from fleet_slip.ingest.load import IngestReport
    from fleet_slip.ingest.mapping import Mapping
    from fleet_slip.operations.night import NightReport
    from fleet_slip.simulation.campaign import Campaign


class Fleet(LogsAndGrams, HealthAndUpkeep):
    """All that can be asked of a data root, and done to it; `fleet_slip.open` makes one.

    A fleet holds no connection or file open, and threads may share it. Changes leave a record in
    the view `runs`. Every call raises `StorageError` where the root cannot be read or written.
    """

    def sql(
        self, query: str, *, threads: int | None = None, scenarios: bool = False
    ) -> "duckdb.DuckDBPyRelation":
        """Return the answer to an SQL query on the views as a DuckDB relation.

        It is computed when asked for rows: `.df()`, `.pl()`, `.to_arrow_table()`, `.fetchall()`;
        what is made of it keeps the connection open. Evaluation scenarios are there with
        `scenarios`, or if the query names the column `source`. Raises `QuestionError` for a query
        that is not valid or would write, and `StorageError` without a data root.
        """
        return self.session(query, threads=threads, scenarios=scenarios).sql(query)

    def session(
        self,
        query: str | None = None,
        *,
        threads: int | None = None,
        scenarios: bool = False,
        unlocked: bool = False,
    ) -> "Session":
        """Open the views of this moment for many queries, which all see the same commits.

        With a `query`, only those that it names, which is faster. For `scenarios` see `sql`. If it
        is `unlocked`, it allows any statement, and any file that you may read or write: only for
        SQL that you trust, since it can overwrite the warehouse. Raises `StorageError` without a
        data root.
        """
        from fleet_slip.api.session import Session
        from fleet_slip.views import open_views

        opened = open_views(self.root, query, threads, scenarios=scenarios, unlocked=unlocked)
        return Session(opened, unlocked)

    def cohort(
        self,
        condition: Annotated[str, COHORT] = TRAINING_DRIVES,
        *,
        unexamined: Annotated[bool, UNEXAMINED] = False,
    ) -> FleetCohort:
        """Return the drives of an SQL condition, by default all but evaluation scenarios."""
        return FleetCohort(self.warehouse, condition, unexamined)

    @record_call
    def run(
        self,
        campaign: Annotated["str | Campaign", CAMPAIGN] = "waterford",
        *,
        days: Annotated[int | None, DAYS] = None,
        through: Annotated[date | str | None, THROUGH] = None,
        name: Annotated[str | None, Doc("Name of the model. Default: the campaign's.")] = None,
        models: Annotated[str, MODELS] = DEFAULT_MODELS,
        worth: Annotated[str | None, WORTH] = None,
        workers: Workers = None,
        progress: ShowStep | None = None,
    ) -> "RunReport":
        """Do the whole job: simulate what is missing, gram, select, publish if it is not worse.

        It can be repeated at any time, and after any interruption: what is done is not done again.
        A second run of the campaign on this machine waits for the first, and says so. A winner that
        is worse than the champion is no error: the report says so. Progress is in rows of each
        step. Raises what `simulate`, `gram`, `FleetCohort.select` and `publish` raise.
        """
        from fleet_slip.api.session import RunReport, Training
        from fleet_slip.models.request import parse_worth
        from fleet_slip.simulation.campaign import load_campaign

        begun = time.monotonic()
        chosen = load_campaign(campaign) if isinstance(campaign, str) else campaign
        model_name = require_model_name(name or chosen.name)
        parse_worth(worth)  # before anything is written
        condition = f"campaign = '{chosen.name}'"
        waiting = partial(LOGGER.info, "%s: waiting for another run", chosen.name)
        with self.root.exclusive(f".run-{chosen.name}.lock", waiting):
            with open_workers(self.root, workers) as executor:
                simulation = self.simulate(
                    chosen,
                    days=days,
                    through=through,
                    workers=executor,
                    progress=of_step(progress, f"simulate {chosen.name}"),
                )
                training = Training(model_name, condition, models, worth)
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

        It is trained on the drives of this mapping, without those that are not in order; on their
        side-slip angle, or on the course where the mapping has no such angle. What is done is not
        done again. Drives give way to those of a corrected mapping. Files that cannot be used are
        passed over and are the `problem` of the report; so is a refusal.

        Raises `ConfigError` for an invalid mapping or one that has neither label, and what
        `ingest`, `gram` and `FleetCohort.select` raise.
        """
        from fleet_slip.api.session import LearnReport, Training
        from fleet_slip.errors import InputError
        from fleet_slip.ingest.mapping import load_mapping

        begun = time.monotonic()
        plan = load_mapping(mapping) if isinstance(mapping, str) else mapping
        training = Training.on_mapping(require_model_name(name), plan)
        reports: list[IngestReport] = []
        failure = None
        waiting = partial(LOGGER.info, "%s: waiting for another run", name)
        with (
            self.root.exclusive(f".learn-{name}.lock", waiting),
            open_workers(self.root, workers) as executor,
        ):
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
        later steps go on where they can. Raises `UsageError` for an invalid name or worth, and
        `StorageError` if the night cannot be recorded.
        """
        from fleet_slip.api.nightly import Night
        from fleet_slip.models.request import parse_worth

        parse_worth(request.worth)
        require_model_name(request.name)
        waiting = partial(LOGGER.info, "%s: waiting for another night", request.name)
        with self.root.exclusive(f".nightly-{request.name}.lock", waiting):
            return Night(self, request).run()
