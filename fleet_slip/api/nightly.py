"""A night with real cars: what is new comes in, is examined, and trains the model again."""

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_slip.api.calls import NightRequest, of_step
from fleet_slip.api.training import Training
from fleet_slip.base import date_of, pluralize
from fleet_slip.errors import DataError, FleetSlipError, InputError, RepeatedError
from fleet_slip.ingest.log_files import find_logs
from fleet_slip.models.registry import CANDIDATE, ModelVersion
from fleet_slip.operations.night import Beginning, NightReport, Nights, NightStep, State
from fleet_slip.storage.runs import step
from fleet_slip.warehouse.predicate import hash_drive
from fleet_slip.warehouse.warehouse import connect_tables, gram_snapshots

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet
    from fleet_slip.ingest.load import IngestReport
    from fleet_slip.operations.monitor import Chart
    from fleet_slip.operations.quality_report import SensorFault

SAMPLE_FILES = 4
"""Log files that a night verifies; the next night takes the next ones."""

NEEDS = {
    "quality": ("gram",),
    "monitor": ("gram", "quality"),
    "publish": ("gram", "quality"),
    "verify": ("gram",),
}
"""Steps that ask for what others make. No model is trained on drives that were not examined."""

TIMED = {"ingest", "retain", "gram"}
"""Steps whose calls put themselves into the history of runs."""

Told = tuple[State, str]


@dataclass
class Night:
    """One night of a model. `run` does the steps in their order, and goes on where it can.

    A step that needs one that failed is left out.
    """

    fleet: "Fleet"
    asked: NightRequest
    training: Training = field(init=False)
    before: Beginning = field(init=False)
    steps: list[NightStep] = field(default_factory=list)
    faults: "tuple[SensorFault, ...]" = ()
    chart: "Chart | None" = None
    counted: dict[tuple[int | None, int | None], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        one = self.asked
        self.training = Training(one.name, one.cohort, one.models, one.tolerance)
        self.night = date_of(one.night, "night") or date.today()

    def run(self) -> NightReport:
        """Do the night and record it."""
        began = time.monotonic()
        nights = Nights(self.fleet.root, self.training.name)
        self.before = nights.begin(self.night, self._now())
        for name, work in {
            "ingest": self._ingest,
            "retain": self._retain,
            "gram": self._gram,
            "quality": self._quality,
            "monitor": self._monitor,
            "publish": self._publish,
            "verify": self._verify,
        }.items():
            self._do(name, work)
        now = self._now()
        report = NightReport(
            model=self.training.name,
            night=self.night,
            root=str(self.fleet.root),
            steps=tuple(self.steps),
            before=self.before,
            drives=now.drives,
            rows=now.rows,
            quarantined=now.quarantined,
            champion=now.champion,
            candidate=now.candidate,
            faults=self.faults,
            chart=self.chart,
            seconds=round(time.monotonic() - began, 3),
        )
        nights.end(report.as_past())
        return report

    def _do(self, name: str, work: Callable[[], Told]) -> None:
        began = time.monotonic()
        if reason := self._hindrance(name):
            self.steps.append(NightStep(name, "left out", reason, 0.0))
            return
        error = None
        try:
            with nullcontext() if name in TIMED else step(name):
                state, told = work()
        except FleetSlipError as failure:
            state, told, error = "failed", str(failure), failure
        seconds = round(time.monotonic() - began, 3)
        self.steps.append(NightStep(name, state, told, seconds, error))

    def _hindrance(self, name: str) -> str:
        """Return why a step cannot be done."""
        warehouse = self.fleet.warehouse
        logs = warehouse.logs.snapshot().rows
        if name != "ingest" and not (logs or warehouse.grams.snapshot().rows):
            return "No drive is in the logs yet."
        if name == "verify" and not logs:
            return "There are no logs to verify."
        undone = [one.name for one in self.steps if one.state in ("failed", "left out")]
        missing = [one for one in NEEDS.get(name, ()) if one in undone]
        return f"{missing[0]} was not done." if missing else ""

    def _now(self) -> Beginning:
        warehouse, champion = self.fleet.warehouse, None
        if self.fleet.root.exists():
            champion = self.fleet.registry().champion(self.training.name)
        return Beginning(
            champion=champion.reference if champion else None,
            drives=self._count_drives(),
            rows=warehouse.logs.snapshot().rows,
            quarantined=warehouse.quarantine.snapshot().rows,
            candidate=self._candidate() if self.fleet.root.exists() else None,
        )

    def _count_drives(self) -> int:
        """Return the number of drives, counted again only where Gram rows or logs changed."""
        grams, logs = gram_snapshots(self.fleet.warehouse)
        state, query = (grams.version, logs.version), "SELECT count(DISTINCT drive_id) FROM grams"
        if not grams.rows:
            return 0
        if state not in self.counted:
            with connect_tables(self.fleet.warehouse, query) as database:
                self.counted = {state: int(database.sql(query).fetchall()[0][0])}
        return self.counted[state]

    def _candidate(self) -> str | None:
        registry, name = self.fleet.registry(), self.training.name
        pointed, champion = registry.history(name).pointed_at(CANDIDATE), registry.champion(name)
        waits = pointed and (champion is None or pointed > champion.version)
        return f"{name}@{pointed}" if waits else None

    def _ingest(self) -> Told:
        from fleet_slip.ingest.mapping import load_mapping

        mapping = load_mapping(self.asked.mapping, self.fleet.warehouse.catalog)
        landing = self.asked.landing
        if not Path(landing).is_dir():
            raise InputError(
                f"{landing}: no such folder. Name the inbox folder for logs, or mount it."
            )
        try:
            find_logs([self.asked.landing])
        except InputError:  # a night in which no car came home is no fault
            never = not self.before.drives
            return ("attention" if never else "done"), "No log is in the folder."
        reports: list[IngestReport] = []
        again = ""
        try:
            self.fleet.ingest(
                self.asked.landing,
                mapping,
                replace="corrected",
                workers=self.asked.workers,
                each=reports.append,
                progress=of_step(self.asked.progress, "ingest"),
            )
        except RepeatedError as error:  # all others are in
            again = str(error)
        rows = self.fleet.warehouse.logs.snapshot().rows - self.before.rows
        told = f"{pluralize(max(rows, 0), 'new row')}."
        if replaced := sum(one.drives_replaced for one in reports):
            drives = pluralize(replaced, "drive")
            told = f"{told} The mapping was corrected: {drives} replaced."
        if again:
            return "attention", f"{told} Left out: {again}"
        if wrong := {str(found): one.file for one in reports for found in one.alarms}:
            found, file = next(iter(wrong.items()))
            return "attention", f"{told} {file}: looks wrong: {found}"
        return "done", told

    def _gram(self) -> Told:
        self.training.gram(self.fleet, self.asked.workers, self.asked.progress)
        return "done", f"Of {pluralize(self._now().drives, 'drive')}."

    def _quality(self) -> Told:
        found = self.fleet.cohort(self.training.cohort).examine()
        self.faults = found.findings(self.fleet.warehouse)
        self.training = replace(self.training, cohort=found.cohort)
        hashes = {hash_drive(self.training.name, one.drive_id) for one in self.faults}
        new = len(hashes - self.before.known)
        told = (
            f"{pluralize(found.drives, 'drive')} checked: {new} newly faulty, {len(hashes)} "
            "faulty in all, left out of training."
        )
        return "attention" if new else "done", told

    def _monitor(self) -> Told:
        champion = self.before.champion
        if champion is None:
            return "left out", "There was no champion yet."
        version: ModelVersion = self.fleet.model(champion)
        try:
            self.chart = self.fleet.monitor(version, self.training.cohort)
        except DataError as error:
            return "left out", str(error)
        new = [day for day in self.chart.days if not day.training]
        drives = self.chart.drives_left_out
        left_out = f" {pluralize(drives, 'drive')} without a log left out." if drives else ""
        told = f"{champion} on {pluralize(len(new), 'new day')}: "
        if self.chart.alarms:
            return "attention", f"{told}beyond its limits on {self.chart.alarm}.{left_out}"
        return "done", f"{told}within its limits.{left_out}"

    def _publish(self) -> Told:
        if made := self.training.current_champion(self.fleet):
            return "done", f"{made.version.reference} is up to date."
        selection = self.training.select(self.fleet)
        name = self.training.name
        publication, refusal = None, ""
        if not self.asked.candidate:
            publication, refusal = self.training.publish_if_not_worse(
                self.fleet, selection, replace_marked=False
            )
        if publication is None:
            publication = self.fleet.publish(name, selection, candidate=True)
        told = f"{publication.version.reference}: {publication.reason}"
        said = publication.version.reference == self.before.candidate  # by an earlier night
        return "attention" if refusal and not said else "done", told

    def _verify(self) -> Told:
        told = of_step(self.asked.progress, "verify")
        checked = self.fleet.check(SAMPLE_FILES, begin=self.night.toordinal(), progress=told)
        return "done", (
            f"{pluralize(checked.rows, 'row')} of {pluralize(checked.files, 'file')} and their "
            "Gram rows verified."
        )

    def _retain(self) -> Told:
        told = of_step(self.asked.progress, "retain")
        report = self.fleet.retain(self.asked.retention, progress=told)
        forgotten, removed = report.forgotten.drives, len(report.vacuumed.files)
        return "done", (
            f"{pluralize(forgotten, 'drive')} before {report.before} forgotten, "
            f"{pluralize(removed, 'old file')} removed."
        )
