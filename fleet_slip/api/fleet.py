"""A fleet's warehouse in Python."""

import time
from datetime import date
from functools import partial
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
from fleet_slip.catalogue.features import PLAIN
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.request import DEFAULT_MODELS, WORTH
from fleet_slip.storage.runs import LOGGER, step

if TYPE_CHECKING:
    import duckdb

    from fleet_slip.api.session import RunReport, Session
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
        self, query: str | None = None, *, threads: int | None = None, scenarios: bool = False
    ) -> "Session":
        """Open the views of this moment for many queries, which all see the same commits.

        With a `query`, only those that it names, which is faster. For `scenarios` see `sql`. Raises
        `StorageError` without a data root.
        """
        from fleet_slip.api.session import Session
        from fleet_slip.views import connect

        opened = connect(self.root, threads=threads, query=query, scenarios=scenarios)
        return Session(opened)

    def unlocked_session(self, query: str | None = None, *, scenarios: bool = False) -> "Session":
        """Open a session that allows any statement, and any file that you may read or write.

        Only for SQL that you trust: it can overwrite the warehouse. Else like `session`.
        """
        from fleet_slip.api.session import Session, any_statement
        from fleet_slip.views import connect_unlocked

        return Session(connect_unlocked(self.root, query, scenarios=scenarios), any_statement)

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
        from fleet_slip.catalogue.features import features
        from fleet_slip.models.request import load_model_list, parse_worth
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
                gram = self.gram(workers=executor, progress=of_step(progress, f"gram {PLAIN}"))
                feature_set = load_model_list(models).features
                wide = None
                if feature_set != PLAIN:
                    wide = self.gram(
                        feature_set,
                        cohort=condition,
                        workers=executor,
                        progress=of_step(progress, f"gram {feature_set}"),
                    )
                for name_of_set in features().beside(feature_set):
                    self.gram(name_of_set, cohort=condition, workers=executor)
            refusal, selection = "", None
            training = Training(model_name, condition, models, worth)
            publication = training.made_already(self)
            if publication is None:
                with step("select"):
                    selection = training.select(self)
                with step("publish"):
                    publication, refusal = training.publish_if_not_worse(
                        self, selection, replace_marked=True
                    )
        return RunReport(
            campaign=chosen.name,
            simulation=simulation,
            gram=gram,
            gram_features=wide,
            selection=selection,
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
