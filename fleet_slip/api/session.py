"""SQL on the views of one moment, for any number of queries."""

import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, TypeVar

import duckdb
import pyarrow as pa

from fleet_slip.base import number_of
from fleet_slip.errors import QueryGoesOnError, QuestionError, RefusedError
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.views import add_calibration
from fleet_slip.warehouse.database import database_errors, interruptible, one_query, reading_files

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet
    from fleet_slip.grams.job import GramReport
    from fleet_slip.models.publish import Publication
    from fleet_slip.models.select import Selection
    from fleet_slip.simulation.job import SimulationReport

Result = TypeVar("Result")


@dataclass(frozen=True)
class Session:
    """A connection with the views of one moment, for one thread; `Fleet.session` opens one.

    Close it, or use it in a `with` block. Queries raise `QuestionError` if invalid or writing;
    `allow` returns the text of one that may be asked.
    """

    database: duckdb.DuckDBPyConnection
    allow: Callable[[duckdb.DuckDBPyConnection, str], str] = one_query

    def sql(self, query: str) -> duckdb.DuckDBPyRelation:
        """Return the answer as a relation; what is made of it keeps the connection open."""
        text = self.allow(self.database, query)
        add_calibration(self.database, query)
        with database_errors("the query"):
            relation: duckdb.DuckDBPyRelation | None = self.database.sql(text)
        if relation is None:
            raise QuestionError("the query is empty.")
        return relation

    def table(self, query: str) -> pa.Table:
        """Return the answer as an Arrow table; see `compute`."""
        return self.compute(query, duckdb.DuckDBPyRelation.to_arrow_table)

    def compute(self, query: str, work: Callable[[duckdb.DuckDBPyRelation], Result]) -> Result:
        """Do work with the answer to a query; Ctrl-C ends it within a second.

        Raises `StorageError` if a file that was read is not what its checksum says.
        """

        def answer() -> Result:
            with reading_files(self.database, "the query"):
                return work(self.sql(query))

        return interruptible(self.database, answer)

    def close(self) -> None:
        """Close the connection."""
        self.database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: types.TracebackType | None,
    ) -> None:
        if not isinstance(error, QueryGoesOnError):
            self.close()


def any_statement(_database: duckdb.DuckDBPyConnection, text: str) -> str:
    """Return a text as it is: what an unlocked session may be asked."""
    return text


# What `Fleet.run` did; and training again by itself, as runs and nights do.


@dataclass(frozen=True)
class RunReport(Answer):
    """The report of each step; `gram_features` is that of the list's feature set.

    There is no selection where the champion is up to date, and no publication after a `refusal`.
    """

    DOCUMENT = (
        "campaign changed simulate=simulation gram gram_features? select=selection publish seconds"
    )

    campaign: str
    simulation: "SimulationReport"
    gram: "GramReport"
    gram_features: "GramReport | None"
    selection: "Selection | None"
    publication: "Publication | None"
    refusal: str
    seconds: float

    def parts(self, everything: bool = False) -> Iterator[Part]:
        """Return what each step did."""
        simulated, publication = self.simulation, self.publication
        took = f"{self.seconds:.1f} s"
        if not self.changed:
            kept = publication.version.reference if publication else self.refusal
            yield Remark(f"{self.campaign}: nothing to do, {kept} is up to date ({took})")
            return
        drives, rows = number_of(simulated.drives, "drive"), number_of(simulated.rows, "row")
        yield Remark(f"simulated {drives}, {rows}")
        for gram in filter(None, (self.gram, self.gram_features)):
            name = "gram" if gram is self.gram else f"gram {gram.feature_set}"
            read, made = number_of(gram.rows_read, "row"), number_of(gram.gram_rows, "Gram row")
            yield Remark(f"{name}: {read} read, {made}")
        if self.selection:
            yield from self.selection.parts(everything)
        if publication:
            yield from publication.parts()
        else:
            yield Remark(self.refusal)
        yield Remark(f"done in {took}")

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        published = self.publication is not None and self.publication.new
        steps = (self.simulation, self.gram, self.gram_features)
        return published or any(one.changed for one in steps if one)

    @property
    def publish(self) -> "Publication | dict[str, Any]":
        """The publication, or why there is none."""
        return self.publication or {"new": False, "reason": self.refusal}


@dataclass(frozen=True)
class Training:
    """What trains a model every night: cohort, model list, `worth` of a signal."""

    name: str
    cohort: str
    models: str
    worth: str | None

    def made_already(self, fleet: "Fleet") -> "Publication | None":
        """Return the champion if a selection would come to it again, whatever it looks at."""
        from fleet_slip.models.publish import Publication, is_up_to_date
        from fleet_slip.operations.marked_models import marked_models

        champion = fleet.registry().champion(self.name)
        if champion is None or champion.reference in marked_models(fleet.root):
            return None
        manifest = champion.manifest
        if not is_up_to_date(manifest, fleet.warehouse, self.cohort, self.models, self.worth):
            return None
        return Publication(champion, False, "The champion was made from the same data and list.")

    def select(self, fleet: "Fleet") -> "Selection":
        """Compare the models of the list on the cohort, which a night has examined."""
        cohort = fleet.cohort(self.cohort, unexamined=True)
        return cohort.select(models=self.models, worth=self.worth)

    def publish_if_not_worse(
        self, fleet: "Fleet", selection: "Selection", *, replace_marked: bool
    ) -> "tuple[Publication | None, str]":
        """Return the publication, or None and why it was refused.

        With `replace_marked`, what was trained on forgotten drives is replaced even by a worse one.
        """
        from fleet_slip.operations.marked_models import marked_models

        champion = fleet.registry().champion(self.name)
        force = (
            replace_marked
            and champion is not None
            and champion.reference in marked_models(fleet.root)
        )
        try:
            published = fleet.publish(self.name, selection, force=force)
        except RefusedError as error:
            return None, str(error)
        return published, ""
