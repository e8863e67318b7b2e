"""What a night came to: `Fleet.nightly` returns it, and the next night knows it."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from pydantic import PlainSerializer, TypeAdapter

from fleet_slip.base import Record, pluralize
from fleet_slip.errors import AlarmError, FleetSlipError, printable
from fleet_slip.rendering import Answer, Part
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.folder import Folder
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.predicate import hash_drive

if TYPE_CHECKING:
    from fleet_slip.operations.monitor import Chart
    from fleet_slip.operations.quality_report import SensorFault

NIGHTS_FOLDER = "nights"
"""Of numbered documents, two of a night: its beginning and its end."""

Hashes: TypeAlias = Annotated[frozenset[str], PlainSerializer(sorted)]


@dataclass(frozen=True)
class Beginning:
    """What a root had when a night began; `known` are hashes of its faulty drives."""

    champion: str | None
    drives: int
    rows: int
    quarantined: int
    known: Hashes = frozenset()
    candidate: str | None = None


_BEGINNING = TypeAdapter(Beginning)


@dataclass(frozen=True)
class Nights:
    """The nights of one model in a data root."""

    root: Folder
    model: str

    def begin(self, night: date, now: Beginning) -> Beginning:
        """Record the beginning of a night; return the one that is there, if the night has one."""
        day, known = night.isoformat(), frozenset[str]()
        for content in self._newest_first():
            if content["event"] == "begun" and content["night"] == day:
                return _BEGINNING.validate_python(content)
            if content["event"] == "ended" and content["night"] < day:
                known = frozenset(content["faulty"])
                break
        begun = replace(now, known=known)
        self._append("begun", {"night": day, **_BEGINNING.dump_python(begun, mode="json")})
        return begun

    def end(self, content: Mapping[str, Any]) -> None:
        """Record how a night ended."""
        self._append("ended", content)

    def _newest_first(self) -> Iterator[Mapping[str, Any]]:
        documents = DocumentFolder(self.root, NIGHTS_FOLDER)
        for number in reversed(documents.numbers()):
            content = documents.read(number).content
            if content["model"] == self.model:
                yield content

    def _append(self, event: str, content: Mapping[str, Any]) -> None:
        known = {"event": event, "model": self.model}
        DocumentFolder(self.root, NIGHTS_FOLDER).append({**known, **content})


State: TypeAlias = Literal["done", "attention", "failed", "left out"]


@dataclass(frozen=True)
class NightStep(Record):
    """One step of a night.

    Attributes:
        state: whether it was done, calls for attention, failed, or could not be asked for.
        told: what it did or found, in a sentence.
        error: what it failed with.
    """

    DOCUMENT = "name state told exit_code=error.exit_code"

    name: str
    state: State
    told: str
    seconds: float
    error: FleetSlipError | None = None


@dataclass(frozen=True)
class NightReport(Answer):
    """The summary of a night. All but `seconds` is the same if the night was killed on its way.

    Attributes:
        before: what the root had when the night first began.
        faults: the drives with faulty sensors; `new_faults` came with this night. The
            summary names them.
        chart: the errors of the champion of before on the days since it was trained, if there are
            enough days to tell what is usual.
    """

    model: str
    night: date
    root: str
    steps: tuple[NightStep, ...]
    before: Beginning
    drives: int
    rows: int
    quarantined: int
    champion: str | None
    candidate: str | None
    faults: "tuple[SensorFault, ...]"
    chart: "Chart | None"
    seconds: float

    @property
    def new_faults(self) -> "tuple[SensorFault, ...]":
        """The faulty drives that the night before did not know of."""
        known = self.before.known
        return tuple(
            one for one in self.faults if hash_drive(self.model, one.drive_id) not in known
        )

    @property
    def problem(self) -> FleetSlipError | None:
        """The first failure, else what calls for attention; None after a good night."""
        night = f"the night of {self.night}"
        found: FleetSlipError | None = None
        for step in self.steps:
            if step.error is not None:
                found = type(step.error)(f"{night}: {step.name} failed: {step.error}")
                break
        calling = [f"{one.name}: {one.told}" for one in self.steps if one.state == "attention"]
        if calling and found is None:
            found = AlarmError(f"{night}: {' '.join(calling)}")
        if found is not None:
            found.headline = f"{night}: {self.verdict}"
        return found

    @property
    def exit_code(self) -> int:
        """That of the first failure, 10 if something calls for attention, else 0."""
        return self.problem.exit_code if self.problem else 0

    @property
    def verdict(self) -> str:
        """How the night went, in a few words."""
        failed = [step.name for step in self.steps if step.state == "failed"]
        calling = [step.name for step in self.steps if step.state == "attention"]
        parts = [f"{' and '.join(failed)} failed"] if failed else []
        if calling:
            calls = "calls" if len(calling) == 1 else "call"
            parts.append(f"{' and '.join(calling)} {calls} for attention")
        return ", ".join(parts) or "all went well"

    @property
    def gained(self) -> str:
        """What the night brought in."""
        rows, drives = self.rows - self.before.rows, self.drives - self.before.drives
        held = self.quarantined - self.before.quarantined
        new = f"{pluralize(drives, 'drive')}, {pluralize(rows, 'row')}"
        return f"{new}; in quarantine: {pluralize(held, 'row')}" if held else new

    def as_past(self) -> dict[str, Any]:
        """Return the night as the record keeps it; `faulty` are hashes of the faulty drives."""
        return {
            "night": self.night.isoformat(),
            "exit_code": self.exit_code,
            "drives": self.drives,
            "rows": self.rows,
            "champion": self.champion,
            "steps": {step.name: step.state for step in self.steps},
            "faulty": sorted({hash_drive(self.model, one.drive_id) for one in self.faults}),
        }

    def parts(self) -> Iterator[Part]:
        """Return the summary for people, lines of text."""
        wide = max(len(step.name) for step in self.steps)
        mark = {"done": "ok", "attention": "LOOK", "failed": "FAILED", "left out": "-"}
        lines = [
            f"{self.model}, night of {self.night}: {self.verdict} (exit code {self.exit_code})",
            f"new: {self.gained}; champion: {self.champion or 'none'}"
            + (f", was {self.before.champion}" if self.moved else ""),
            *(f"  {one.name:<{wide}}  {mark[one.state]:<6}  {one.told}" for one in self.steps),
            *(
                f"  {one.drive_id}: {one.fault.kind} {' '.join(one.fault.signals)}"
                for one in self.new_faults
            ),
        ]
        yield "\n".join(printable(line).rstrip() for line in lines)

    @property
    def moved(self) -> bool:
        """Whether the night replaced a champion."""
        return self.before.champion not in (None, self.champion)

    def as_dict(self) -> dict[str, Any]:
        """Return what `nightly --json` prints."""
        return {
            "model": self.model,
            "night": self.night,
            "exit_code": self.exit_code,
            "verdict": self.verdict,
            "drives": self.drives,
            "new_drives": self.drives - self.before.drives,
            "rows": self.rows,
            "new_rows": self.rows - self.before.rows,
            "new_rows_quarantined": self.quarantined - self.before.quarantined,
            "champion": self.champion,
            "champion_before": self.before.champion,
            "candidate": self.candidate,
            "steps": [step.as_dict() for step in self.steps],
            "faults": [one.as_dict() for one in self.faults],
            "new_faults": [one.drive_id for one in self.new_faults],
            "alarms": [str(day.day) for day in self.chart.alarms] if self.chart else [],
            "seconds": self.seconds,
        }


def write_summary(report: NightReport, folder: Path) -> list[Path]:
    """Write NIGHT.txt and .json, each as a whole; return them. Raises `StorageError`."""
    files = {
        f"{report.night}.txt": f"{report}\n",
        f"{report.night}.json": json.dumps(report.as_dict(), indent=2, default=str) + "\n",
    }
    place = LocalFolder(folder)
    for name, text in files.items():
        place.put(name, text.encode("utf-8", "backslashreplace"))
    return [folder / name for name in files]
