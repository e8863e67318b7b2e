"""SQL on the views of one moment, for any number of queries."""

import types
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self, TypeVar

import duckdb
import pyarrow as pa

from fleet_slip.errors import QueryGoesOnError, QuestionError
from fleet_slip.warehouse.database import database_errors, interruptible, one_query, reading_files

Result = TypeVar("Result")


@dataclass(frozen=True)
class Session:
    """A connection with the views of one moment, for one thread; `Fleet.session` opens one.

    Close it, or use it in a `with` block. Queries raise `QuestionError` if invalid or, unless it is
    `unlocked`, writing.
    """

    database: duckdb.DuckDBPyConnection
    unlocked: bool = False

    def sql(self, query: str) -> duckdb.DuckDBPyRelation:
        """Return the answer as a relation; what is made of it keeps the connection open."""
        text = query if self.unlocked else one_query(self.database, query)
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
