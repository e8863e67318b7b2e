"""Keeps the connection of a closed reader open for the next reader of the same warehouse."""

import ctypes
import os
from typing import TYPE_CHECKING, NamedTuple

from fleet_slip.storage.table import Snapshot

if TYPE_CHECKING:  # a class that refers to DuckDB's is reported as a leak at the end of a process
    import duckdb


class IdleConnection(NamedTuple):
    """A connection to the Gram rows of two snapshots, and how many readers have used it."""

    grams: Snapshot
    logs: Snapshot
    database: "duckdb.DuckDBPyConnection"
    uses: int


class ConnectionCache:
    """Holds at most one idle connection. A `Warehouse` owns it.

    DuckDB takes 20 ms to start, so that a second reader of the same snapshots reuses a connection.
    Threads and forked processes may use it at once: list operations are atomic, and no lock can be
    inherited in a locked state.
    """

    def __init__(self) -> None:
        """Start without a connection."""
        self._idle: list[tuple[int, IdleConnection]] = []
        self._is_closed = False

    def take(self, grams: Snapshot, logs: Snapshot) -> IdleConnection | None:
        """Return the idle connection if it is of these snapshots; close it otherwise."""
        connection = self._pop()
        if connection is None:
            return None
        if connection.grams is grams and connection.logs is logs:
            return connection
        connection.database.close()
        return None

    def put(self, connection: IdleConnection) -> None:
        """Keep a connection for the next reader, instead of the previous one."""
        if previous := self._pop():
            previous.database.close()
        if self._is_closed:
            connection.database.close()
        else:
            self._idle.append((os.getpid(), connection))

    def close(self) -> None:
        """Close the idle connection. Connections of later readers are closed with them."""
        self._is_closed = True
        if connection := self._pop():
            connection.database.close()

    def _pop(self) -> IdleConnection | None:
        """Remove and return the idle connection of this process."""
        try:
            process, connection = self._idle.pop()
        except IndexError:
            return None
        if process == os.getpid():
            return connection
        # Inherited by a fork, without its threads: to destroy it would crash the process.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(connection.database))
        return None

    def __del__(self) -> None:
        """Close the idle connection, unless another process owns it."""
        if connection := self._pop():
            connection.database.close()
