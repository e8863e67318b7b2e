"""Exported SQL, run by two engines on drives of counts."""

import sqlite3

import duckdb
import polars as pl


def by_duckdb(statement: str, log: pl.DataFrame) -> dict[tuple[str, int], int | None]:
    with duckdb.connect() as database:
        database.register("log", log.to_arrow())
        rows = database.sql(f"SELECT drive_id, tick, angle FROM ({statement})").fetchall()
    return {(drive, tick): angle for drive, tick, angle in rows}


def by_sqlite(statement: str, log: pl.DataFrame) -> dict[tuple[str, int], int | None]:
    database = sqlite3.connect(":memory:")
    database.execute(f"CREATE TABLE log ({', '.join(log.columns)})")
    database.executemany(f"INSERT INTO log VALUES ({', '.join('?' * log.width)})", log.rows())
    # SQLite computes a column again wherever it is named, unless told otherwise: docs/export.md.
    rows = database.execute(statement.replace(" AS (\n", " AS MATERIALIZED (\n")).fetchall()
    database.close()
    return {(drive, tick): angle for drive, tick, angle, _ in rows}
