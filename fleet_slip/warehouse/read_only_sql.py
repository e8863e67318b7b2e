"""Which SQL may come from people: one statement that reads, and calls nothing that could write.

The type of a statement does not tell. DuckDB lets a SELECT begin with a common table expression
that copies rows to a file or changes a table, and has table functions that run SQL from a string.
So what the parser made of the text is searched, where neither comments nor quotes hide anything.
"""

import json
from itertools import accumulate
from typing import Any

import duckdb

from fleet_slip.errors import QuestionError
from fleet_slip.warehouse.database import duckdb_message

LONGEST_QUERY = 100_000
"""Characters of one query. Planning takes more than linear time in some of them."""

QUERY_NODES = frozenset({"SELECT_NODE", "SET_OPERATION_NODE", "RECURSIVE_CTE_NODE", "CTE_NODE"})
"""Parts of a statement that read. Others, such as COPY_QUERY_NODE, write."""

TABLE_FUNCTIONS = frozenset(
    {
        "generate_series",
        "histogram",
        "histogram_values",
        "json_each",
        "json_tree",
        "parquet_file_metadata",
        "parquet_full_metadata",
        "parquet_metadata",
        "parquet_schema",
        "pragma_table_info",
        "range",
        "read_parquet",
        "repeat",
        "repeat_row",
        "summary",
        "unnest",
    }
)
"""What may stand after FROM like a function, beside duckdb_tables() and its like."""

CATALOGUE_PREFIX = "duckdb_"


def one_query(database: duckdb.DuckDBPyConnection, text: str) -> str:
    """Return the text if it is one statement that only reads.

    Raises `QuestionError` otherwise: a query must not write files, change settings or run text.
    """
    if len(text) > LONGEST_QUERY:
        raise QuestionError(
            f"the query has {len(text):,} characters, at most {LONGEST_QUERY:,} are read."
        )
    try:
        text.encode()
        statements = database.extract_statements(text)
    except UnicodeEncodeError:
        raise QuestionError("not valid SQL: it is not Unicode text.") from None
    except duckdb.Error as error:
        raise QuestionError(f"not valid SQL: {duckdb_message(error)}") from None
    if len(statements) != 1:
        raise QuestionError(f"one SQL statement is expected, not {len(statements)}.")
    explained = statements[0].type == duckdb.StatementType.EXPLAIN
    _require_reading(database, _explained(text) if explained else text)
    return text


def _explained(text: str) -> str:
    """Return what an EXPLAIN statement explains; EXPLAIN ANALYZE runs it."""
    encoded = text.encode()
    tokens = [start for start, kind in duckdb.tokenize(text) if kind != duckdb.token_type.comment]
    ends = [*tokens[1:], len(encoded)]
    words = [encoded[a:b].split()[0].lower() for a, b in zip(tokens, ends, strict=True)]
    begin = 2 if words[1] == b"analyze" else 1
    if words[1] == b"(":  # options in parentheses, or a query in parentheses
        depths = accumulate((word == b"(") - (word == b")") for word in words[1:])
        after = 2 + next(i for i, depth in enumerate(depths) if depth == 0)
        begin = after if after < len(tokens) else 1
    return encoded[tokens[begin] :].decode()


def _require_reading(database: duckdb.DuckDBPyConnection, text: str) -> None:
    statement = "SELECT json_serialize_sql($text::VARCHAR)"
    [(serialised,)] = database.execute(statement, {"text": text}).fetchall()
    try:
        tree = json.loads(serialised, object_hook=_checked)
    except RecursionError:
        raise QuestionError("the query is nested too deeply. Divide it into parts.") from None
    if tree["error"]:
        raise QuestionError(
            "only queries are allowed here (SELECT, WITH, DESCRIBE, SUMMARIZE, EXPLAIN; a PIVOT "
            "with IN): the warehouse is written by the jobs alone."
        )


def _checked(node: dict[str, Any]) -> dict[str, Any]:
    """Return a node of the parsed statement. Raises `QuestionError` if it may do harm."""
    kind = node.get("type")
    if not isinstance(kind, str):
        return node
    if kind.endswith("_NODE") and kind not in QUERY_NODES:
        raise QuestionError(
            "the query would write: only reading is allowed here. The warehouse is written by the "
            "jobs alone."
        )
    if kind == "VALUE_PARAMETER":
        raise QuestionError("the query has a parameter, and nothing gives it a value.")
    if kind == "TABLE_FUNCTION":
        name = str(node["function"]["function_name"]).lower()
        if name not in TABLE_FUNCTIONS and not name.startswith(CATALOGUE_PREFIX):
            raise QuestionError(
                f"the function {name!r} cannot be called after FROM here. Functions: "
                f"{', '.join(sorted(TABLE_FUNCTIONS))}, and those that begin with duckdb_."
            )
    return node
