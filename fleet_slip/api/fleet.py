"""A fleet's warehouse in Python."""

import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_slip.api.calls import ShowStep, Workers, of_step, open_workers, record_call
from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.health_and_upkeep import HealthAndUpkeep
from fleet_slip.api.logs_and_grams import LogsAndGrams
from fleet_slip.catalogue.car_numbers import CALIBRATION, DELAY
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.models.manifest import require_model_name
from fleet_slip.runs.log import step
from fleet_slip.selection.request import DEFAULT_MODELS

if TYPE_CHECKING:
    import duckdb

    from fleet_slip.api.run_report import RunReport
    from fleet_slip.api.session import Session
    from fleet_slip.monitoring.night_report import NightReport
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
        from fleet_slip.api.session import Session, query_of_many
        from fleet_slip.views import connect
        from fleet_slip.warehouse.minimum_cohort import VIEWS_WITHOUT_CARS, tells_single_cars

        if not tells_single_cars():
            return Session(connect(self.root, query=" ".join(VIEWS_WITHOUT_CARS)), query_of_many)
        opened = connect(self.root, threads=threads, query=query, scenarios=scenarios)
        return Session(opened)

    def unlocked_session(self, query: str | None = None, *, scenarios: bool = False) -> "Session":
        """Open a session that allows any statement, and any file that you may read or write.

        Only for SQL that you trust: it can overwrite the warehouse. Else like `session`.
        """
        from fleet_slip.api.session import Session, any_statement, require_many_cars
        from fleet_slip.views import connect_unlocked

        require_many_cars()
        return Session(connect_unlocked(self.root, query, scenarios=scenarios), any_statement)

    def cohort(self, condition: str = TRAINING_DRIVES) -> FleetCohort:
        """Return the drives of an SQL condition, by default all but evaluation scenarios."""
        return FleetCohort(self.warehouse, condition)

    @record_call
    def run(
        self,
        campaign: "str | Campaign" = "waterford",
        *,
        days: int | None = None,
        through: date | None = None,
        name: str | None = None,
        models: str = DEFAULT_MODELS,
        worth: str | None = None,
        sign_key: Path | None = None,
        workers: Workers = None,
        progress: ShowStep | None = None,
        waiting: Callable[[], None] = lambda: None,
    ) -> "RunReport":
        """Do the whole job: simulate what is missing, gram, select, publish if it is not worse.

        It can be repeated at any time, and after any interruption: what is done is not done again.
        A second run of the campaign on this machine at the same time waits for the first; `waiting`
        is called once before. `name` is that of the model, by default the campaign's; `models` the
        model list that is compared; `worth` the smallest gain that is worth a signal, by default
        what the list says; `sign_key` the private key that signs the version. A winner that is
        worse than the champion is no error: the report says so. Progress is in rows of each step.

        Raises what `simulate`, `gram`, `FleetCohort.select` and `publish` raise.
        """
        from fleet_slip.api.run_report import RunReport, Training
        from fleet_slip.catalogue.features import features
        from fleet_slip.selection.model_list import load_model_list
        from fleet_slip.selection.request import parse_worth
        from fleet_slip.simulation.campaign import load_campaign

        begun = time.monotonic()
        chosen = load_campaign(campaign) if isinstance(campaign, str) else campaign
        model_name = require_model_name(name or chosen.name)
        parse_worth(worth)  # before anything is written
        condition = f"campaign = '{chosen.name}'"
        with self.root.exclusive(f".run-{chosen.name}.lock", waiting):
            with open_workers(self.root, workers) as executor:
                simulation = self.simulate(
                    chosen,
                    days=days,
                    through=through,
                    workers=executor,
                    progress=of_step(progress, "simulate"),
                )
                gram = self.gram(workers=executor, progress=of_step(progress, "gram"))
                feature_set = load_model_list(models).features
                wide = None
                if feature_set != PLAIN:
                    wide = self.gram(
                        feature_set,
                        cohort=condition,
                        workers=executor,
                        progress=of_step(progress, f"gram {feature_set}"),
                    )
                if features().feature_set(feature_set).change_ticks:
                    # What the intercept follows from, and whether the course came in time.
                    for name_of_set in (CALIBRATION, DELAY):
                        self.gram(name_of_set, cohort=condition, workers=executor)
            refusal, selection = "", None
            training = Training(model_name, condition, models, worth, sign_key)
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
    def nightly(
        self,
        landing: Path | str,
        mapping: str,
        name: str,
        *,
        cohort: str = TRAINING_DRIVES,
        models: str = DEFAULT_MODELS,
        worth: str | None = None,
        candidate: bool = False,
        retention: str | None = None,
        night: date | None = None,
        sign_key: Path | None = None,
        workers: Workers = None,
        progress: ShowStep | None = None,
        waiting: Callable[[], None] = lambda: None,
    ) -> "NightReport":
        """Do all that a night with real cars asks for, and tell how each step went.

        Ingest what is new in the folder `landing`, a path or a URL, through a mapping, forget what
        is too old, update Gram rows, examine sensors, chart the champion's error, train again
        without the faulty drives, and verify some log files, the next ones on the next night. The
        winner becomes champion of the model `name` if it is not worse, else, or if `candidate`, a
        candidate. A night that was killed and is given again ends where it would have ended;
        `night` is its date, today unless told otherwise. A second one of the model on this machine
        waits for the first; `waiting` is called once before.

        What goes wrong in a step is in the report, whose `problem` is what a command fails with;
        later steps go on where they can. Raises `UsageError` for an invalid name or worth, and
        `StorageError` if the night cannot be recorded.
        """
        from fleet_slip.api.nightly import Night
        from fleet_slip.api.run_report import Training
        from fleet_slip.selection.request import parse_worth

        parse_worth(worth)
        training = Training(require_model_name(name), cohort, models, worth, sign_key)
        with self.root.exclusive(f".nightly-{name}.lock", waiting):
            return Night(
                fleet=self,
                landing=landing,
                mapping=mapping,
                training=training,
                night=night or date.today(),
                candidate=candidate,
                retention=retention,
                workers=workers,
                progress=progress,
            ).run()
