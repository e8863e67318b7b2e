"""The health of a warehouse as metrics, for the textfile collector of Prometheus' node exporter.

The text is OpenMetrics and, since all are gauges, Prometheus' own format as well. Times are seconds
since 1970; a figure that is not known is left out, so that an alert on `absent` sees it.
"""

from collections.abc import Iterator
from datetime import UTC, date, datetime

from prometheus_client.core import CollectorRegistry, GaugeMetricFamily
from prometheus_client.openmetrics.exposition import generate_latest

from fleet_slip.operations.status import WarehouseStatus

STATES = ("done", "failed", "interrupted", "killed", "running")
"""In which the last run of a command can be."""

Sample = tuple[str, str, float | None, dict[str, str]]
"""A figure: its name with its unit at the end, what it is, its value, and of what."""


def as_openmetrics(status: WarehouseStatus) -> str:
    """Return the metrics as text, grouped by name."""
    registry = CollectorRegistry()
    registry.register(_Figures(status))
    return str(generate_latest(registry).decode("utf-8"))


class _Figures:
    def __init__(self, status: WarehouseStatus) -> None:
        self.status = status

    def collect(self) -> list[GaugeMetricFamily]:
        families: dict[str, GaugeMetricFamily] = {}
        for name, text, value, of in _samples(self.status):
            if value is not None:
                family = families.setdefault(
                    name, GaugeMetricFamily(f"fleet_slip_{name}", f"{text}.", labels=["root", *of])
                )
                family.add_metric([self.status.root, *of.values()], value)
        return list(families.values())


def _samples(status: WarehouseStatus) -> Iterator[Sample]:
    age = None if status.data_age_hours is None else 3600 * status.data_age_hours
    newest, free = _seconds(status.newest_day), status.disk_free_fraction
    yield "status_timestamp_seconds", "When the root was examined", _seconds(status.checked_at), {}
    yield "problems", "What calls for attention", len(status.problems), {}
    yield "data_age_seconds", "Since the newest commit", age, {}
    yield "newest_day_timestamp_seconds", "Newest day of the logs, 0:00 UTC", newest, {}
    yield "backlog_files", "Log files without Gram rows", status.backlog_files, {}
    yield "backlog_rows", "Rows of these files", status.backlog_rows, {}
    yield "disk_free_bytes", "Free space of the disk", status.disk_free_bytes, {}
    yield "disk_free_ratio", "Share of the disk that is free", free, {}
    for name, table in status.tables.items():
        of, committed = {"table": name}, _seconds(table.committed_at)
        yield "table_files", "Active files of a table", table.files, of
        yield "table_rows", "Rows of a table", table.rows, of
        yield "table_size_bytes", "Size of a table's files", table.size_bytes, of
        yield "table_committed_timestamp_seconds", "Newest commit of a table", committed, of
    for run in status.last_runs:
        of, started = {"command": str(run["command"])}, _seconds(run["started_at"])
        yield "run_started_timestamp_seconds", "Begin of a command's last run", started, of
        yield "run_duration_seconds", "How long it took", run["seconds"], of
        yield "run_exit_code", "How it ended", run["exit_code"], of
        for state in STATES:
            here = {**of, "state": state}
            yield "run_state", "1 for the state that it is in", run["state"] == state, here
    for one in status.champions:
        of, published = {"model": one.model}, _seconds(one.published_at)
        yield "champion_version", "Number of the version in use", one.version, of
        yield "champion_published_timestamp_seconds", "Its publication", published, of
        yield "champion_logs_behind", "Commits of logs since its training", one.logs_behind, of
        yield "champion_grams_behind", "The same of Gram rows", one.grams_behind, of


def _seconds(moment: datetime | date | None) -> float | None:
    if moment is None:
        return None
    if not isinstance(moment, datetime):
        moment = datetime(moment.year, moment.month, moment.day)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
