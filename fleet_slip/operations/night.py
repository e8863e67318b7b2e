"""The summary of a night, which `Fleet.nightly` returns, and the log of nights."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from pydantic import Field, PlainSerializer, TypeAdapter

from fleet_slip.base import Record, pluralize
from fleet_slip.errors import AlarmError, FleetSlipError, printable
from fleet_slip.rendering import Answer, Part
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.database import hash_drive

if TYPE_CHECKING:
    from fleet_slip.operations.monitor import Chart
    from fleet_slip.operations.sensor_screen import SensorFault

NIGHTS_FOLDER = "nights"
"""Folder of numbered documents: one when a night begins, one when it ends."""

Hashes: TypeAlias = Annotated[frozenset[str], PlainSerializer(sorted)]


@dataclass(frozen=True)
class Baseline:
    """The state of a data root when a night began; `known_faults` are hashes of faulty drives."""

    champion: str | None
    drives: int
    rows: int
    quarantined: int
    known_faults: Annotated[Hashes, Field(alias="known")] = frozenset()
    candidate: str | None = None


_BASELINE = TypeAdapter(Baseline)


@dataclass(frozen=True)
class NightlyLog:
    """The nights of one model in a data root."""

    root: Folder
    model: str

    def begin(self, night: date, state: Baseline) -> Baseline:
        """Record the beginning of a night; return its first record if it is repeated."""
        day, faults = night.isoformat(), frozenset[str]()
        for content in self._newest_first():
            if content["event"] == "begun" and content["night"] == day:
                return _BASELINE.validate_python(content)
            if content["event"] == "ended" and content["night"] < day:
                faults = frozenset(content["faulty"])
                break
        baseline = replace(state, known_faults=faults)
        content = _BASELINE.dump_python(baseline, mode="json", by_alias=True)
        self._append("begun", {"night": day, **content})
        return baseline

    def end(self, content: Mapping[str, Any]) -> None:
        """Record the end of a night."""
        self._append("ended", content)

    def _newest_first(self) -> Iterator[Mapping[str, Any]]:
        documents = DocumentFolder(self.root, NIGHTS_FOLDER)
        for number in reversed(documents.numbers()):
            content = documents.read(number).content
            if content["model"] == self.model:
                yield content

    def _append(self, event: str, content: Mapping[str, Any]) -> None:
        head = {"event": event, "model": self.model}
        DocumentFolder(self.root, NIGHTS_FOLDER).append({**head, **content})


State: TypeAlias = Literal["done", "attention", "failed", "left out"]


@dataclass(frozen=True)
class NightStep(Record):
    """One step of a night: its state, what it did in a sentence, and its error if it failed."""

    DOCUMENT = "name state told=summary exit_code=error.exit_code"

    name: str
    state: State
    summary: str
    seconds: float
    error: FleetSlipError | None = None


@dataclass(frozen=True)
class NightReport(Answer):
    """The summary of a night. Only `seconds` depends on whether the night was interrupted.

    Attributes
    ----------
    before, after : Baseline
        State of the data root when the night first began, and at its end.
    faults : tuple of SensorFault
        Drives with faulty sensors; `new_faults` are those of this night.
    chart : Chart or None
        Errors of the previous champion on each day since its training, if there are enough days.
    """

    DOCUMENT = (
        "model night exit_code verdict drives=after.drives new_drives rows=after.rows new_rows "
        "new_rows_quarantined champion=after.champion champion_before=before.champion "
        "candidate=after.candidate steps faults new_faults=new_faulty alarms seconds"
    )

    model: str
    night: date
    root: str
    steps: tuple[NightStep, ...]
    before: Baseline
    after: Baseline
    faults: "tuple[SensorFault, ...]"
    chart: "Chart | None"
    seconds: float

    @property
    def new_faults(self) -> "tuple[SensorFault, ...]":
        """The faulty drives that the previous night did not report."""
        return tuple(
            fault
            for fault in self.faults
            if hash_drive(self.model, fault.drive_id) not in self.before.known_faults
        )

    @property
    def new_faulty(self) -> list[str]:
        """The names of these drives."""
        return [fault.drive_id for fault in self.new_faults]

    @property
    def alarms(self) -> list[str]:
        """The days on which the previous champion was beyond its limits."""
        return [str(day.day) for day in self.chart.alarms] if self.chart else []

    @property
    def new_drives(self) -> int:
        """The drives of the night."""
        return self.after.drives - self.before.drives

    @property
    def new_rows(self) -> int:
        """The log rows of the night."""
        return self.after.rows - self.before.rows

    @property
    def new_rows_quarantined(self) -> int:
        """The rejected rows of the night."""
        return self.after.quarantined - self.before.quarantined

    @property
    def problem(self) -> FleetSlipError | None:
        """The first failure, else what needs attention; None after a good night."""
        night = f"the night of {self.night}"
        problem: FleetSlipError | None = None
        if failures := [(step.name, step.error) for step in self.steps if step.error]:
            name, error = failures[0]
            problem = type(error)(f"{night}: {name} failed: {error}")
        elif alarms := [step for step in self.steps if step.state == "attention"]:
            summaries = (f"{step.name}: {step.summary}" for step in alarms)
            problem = AlarmError(f"{night}: {' '.join(summaries)}")
        if problem:
            problem.headline = f"{night}: {self.verdict}"
        return problem

    @property
    def exit_code(self) -> int:
        """The exit code of the first failure, 10 if something needs attention, else 0."""
        return self.problem.exit_code if self.problem else 0

    @property
    def verdict(self) -> str:
        """The outcome in a few words."""
        states = {"failed": "failed", "attention": "calls for attention"}
        clauses = [f"{s.name} {states[s.state]}" for s in self.steps if s.state in states]
        return ", ".join(clauses) or "all went well"

    @property
    def gained(self) -> str:
        """The new drives, rows and rejected rows."""
        new = f"{pluralize(self.new_drives, 'drive')}, {pluralize(self.new_rows, 'row')}"
        rejected = self.new_rows_quarantined
        return f"{new}; in quarantine: {pluralize(rejected, 'row')}" if rejected else new

    def as_past(self) -> dict[str, Any]:
        """Return the document of the nightly log; `faulty` are hashes of the faulty drives."""
        return {
            "night": self.night.isoformat(),
            "exit_code": self.exit_code,
            "drives": self.after.drives,
            "rows": self.after.rows,
            "champion": self.after.champion,
            "steps": {step.name: step.state for step in self.steps},
            "faulty": sorted({hash_drive(self.model, f.drive_id) for f in self.faults}),
        }

    def parts(self) -> Iterator[Part]:
        """Render the summary as lines of text."""
        width = max(len(step.name) for step in self.steps)
        mark = {"done": "ok", "attention": "LOOK", "failed": "FAILED", "left out": "-"}
        lines = [
            f"{self.model}, night of {self.night}: {self.verdict} (exit code {self.exit_code})",
            f"new: {self.gained}; champion: {self.after.champion or 'none'}"
            + (f", was {self.before.champion}" if self.moved else ""),
            *(f"  {s.name:<{width}}  {mark[s.state]:<6}  {s.summary}" for s in self.steps),
            *(
                f"  {new.drive_id}: {new.fault.kind} {' '.join(new.fault.signals)}"
                for new in self.new_faults
            ),
        ]
        yield "\n".join(printable(line).rstrip() for line in lines)

    @property
    def moved(self) -> bool:
        """True if the night replaced a champion."""
        return self.before.champion not in (None, self.after.champion)


def write_summary(report: NightReport, folder: Path) -> list[Path]:
    """Write the summary as NIGHT.txt and NIGHT.json; return the files. Raises `StorageError`."""
    files = {
        f"{report.night}.txt": f"{report}\n",
        f"{report.night}.json": json.dumps(report.as_dict(), indent=2, default=str) + "\n",
    }
    target = LocalFolder(folder)
    for name, text in files.items():
        target.put(name, text.encode("utf-8", "backslashreplace"))
    return [folder / name for name in files]
