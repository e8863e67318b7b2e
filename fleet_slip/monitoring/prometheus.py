"""The health of a warehouse as metrics, for the textfile collector of Prometheus' node exporter.

The text is OpenMetrics (https://prometheus.io/docs/specs/om/open_metrics_spec/) and, since all are
gauges, Prometheus' own format as well. Times are seconds since 1970; a figure that is not known is
left out, so that an alert on `absent` sees it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime

from fleet_slip.monitoring.status import WarehouseStatus

STATES = ("done", "failed", "interrupted", "killed", "running")
"""In which the last run of a command can be."""

Labels = Mapping[str, str]


@dataclass(frozen=True)
class Metric:
    """One figure: its name with its unit at the end, what it is, of what, and its value."""

    name: str
    help: str
    labels: Labels
    value: float | None


def as_openmetrics(status: WarehouseStatus) -> str:
    """Return the metrics as text, grouped by name."""
    groups: dict[str, list[Metric]] = {}
    for sample in _samples(status):
        if sample.value is not None:
            groups.setdefault(f"fleet_slip_{sample.name}", []).append(sample)
    lines = []
    for name, samples in groups.items():
        lines += [f"# HELP {name} {samples[0].help}.", f"# TYPE {name} gauge"]
        lines += [
            f"{name}{{{_told(status.root, one)}}} {float(one.value or 0)!r}" for one in samples
        ]
    return "\n".join([*lines, "# EOF", ""])


def _samples(status: WarehouseStatus) -> Iterator[Metric]:
    def of_root(name: str, text: str, value: float | None) -> Metric:
        return Metric(name, text, {}, value)

    age = None if status.data_age_hours is None else 3600 * status.data_age_hours
    checked = _seconds(status.checked_at)
    yield of_root("status_timestamp_seconds", "When the root was examined", checked)
    yield of_root("problems", "What calls for attention", len(status.problems))
    yield of_root("data_age_seconds", "Since the newest commit", age)
    newest = _seconds(status.newest_day)
    yield of_root("newest_day_timestamp_seconds", "Newest day of the logs, 0:00 UTC", newest)
    yield of_root("backlog_files", "Log files without Gram rows", status.backlog_files)
    yield of_root("backlog_rows", "Rows of these files", status.backlog_rows)
    yield of_root("disk_free_bytes", "Free space of the disk", status.disk_free_bytes)
    yield of_root("disk_free_ratio", "Share of the disk that is free", status.disk_free_fraction)
    yield from _of_tables(status)
    yield from _of_runs(status)
    yield from _of_champions(status)


def _of_tables(status: WarehouseStatus) -> Iterator[Metric]:
    for name, one in status.tables.items():
        of = {"table": name}
        yield Metric("table_files", "Active files of a table", of, one.files)
        yield Metric("table_rows", "Rows of a table", of, one.rows)
        yield Metric("table_size_bytes", "Size of a table's files", of, one.size_bytes)
        committed = _seconds(one.committed_at)
        yield Metric("table_committed_timestamp_seconds", "Newest commit of a table", of, committed)


def _of_runs(status: WarehouseStatus) -> Iterator[Metric]:
    for run in status.last_runs:
        of = {"command": str(run["command"])}
        started = _seconds(run["started_at"])
        yield Metric("run_started_timestamp_seconds", "Begin of a command's last run", of, started)
        yield Metric("run_duration_seconds", "How long it took", of, run["seconds"])
        yield Metric("run_exit_code", "How it ended", of, run["exit_code"])
        for state in STATES:
            here = {**of, "state": state}
            yield Metric("run_state", "1 for the state that it is in", here, run["state"] == state)


def _of_champions(status: WarehouseStatus) -> Iterator[Metric]:
    for one in status.champions:
        of, published = {"model": one.model}, _seconds(one.published_at)
        logs, grams = one.logs_behind, one.grams_behind
        yield Metric("champion_version", "Number of the version in use", of, one.version)
        yield Metric("champion_published_timestamp_seconds", "Its publication", of, published)
        yield Metric("champion_logs_behind", "Commits of logs since its training", of, logs)
        yield Metric("champion_grams_behind", "The same of Gram rows", of, grams)


def _seconds(moment: datetime | date | None) -> float | None:
    if moment is None:
        return None
    if not isinstance(moment, datetime):
        moment = datetime(moment.year, moment.month, moment.day)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _told(root: str, sample: Metric) -> str:
    labels = {"root": root, **sample.labels}
    escapes = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})
    return ",".join(f'{key}="{text.translate(escapes)}"' for key, text in labels.items())
