"""A fleet's warehouse in Python."""

from typing import TYPE_CHECKING

from fleet_slip.api.serving import Serving
from fleet_slip.errors import QuestionError

if TYPE_CHECKING:
    import duckdb


class Fleet(Serving):
    """All that can be asked of a data root, and done to it; `fleet_slip.open` makes one."""

    def sql(self, query: str, *, threads: int | None = None) -> "duckdb.DuckDBPyRelation":
        """Return the answer to an SQL query on the views as a DuckDB relation.

        The views are those of `fleet_slip.connect`, of the newest commits at the time of the call.
        A relation is computed when it is asked for rows: `.df()`, `.pl()`, `.to_arrow_table()`,
        `.fetchall()`; it and all that is made of it keep their connection open. It can read the
        warehouse and nothing else, and write nothing.

        Raises `QuestionError` for a query that is not valid or would write, and `StorageError`
        without a data root.
        """
        from fleet_slip.views import connect
        from fleet_slip.warehouse.database import database_errors
        from fleet_slip.warehouse.read_only_sql import one_query

        database = connect(self.root, threads=threads, query=query)
        text = one_query(database, query)
        with database_errors("the query"):
            relation = database.sql(text)
        if relation is None:
            raise QuestionError("the query has no result.")
        return relation
