"""The pipelines `run`, `learn` and `nightly`: the training of a model, its steps and reports."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from datetime import date, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fleet_slip.api.calls import ShowStep, Workers, step_progress
from fleet_slip.base import pluralize
from fleet_slip.catalog.course import COURSE
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import (
    AlarmError,
    ConfigError,
    DataError,
    FleetSlipError,
    InputError,
    RefusedError,
    RepeatedError,
)
from fleet_slip.ingest.log_files import find_logs
from fleet_slip.ingest.mapping import load_mapping
from fleet_slip.models.publish import Publication, is_current
from fleet_slip.models.registry import CANDIDATE
from fleet_slip.models.request import (
    COURSE_MODELS,
    DEFAULT_MODELS,
    Label,
    SelectionRequest,
    load_model_list,
)
from fleet_slip.operations.forget import load_retention, marked_models
from fleet_slip.operations.night import Baseline, NightlyLog, NightReport, NightStep, State
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.storage.runs import step
from fleet_slip.warehouse.database import hash_drive
from fleet_slip.warehouse.table_views import connect_tables

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet
    from fleet_slip.grams.update import GramReport
    from fleet_slip.ingest.logs import IngestReport
    from fleet_slip.ingest.mapping import Mapping
    from fleet_slip.models.summary import Selection
    from fleet_slip.operations.monitor import Chart
    from fleet_slip.operations.sensor_screen import SensorFault
    from fleet_slip.simulation.simulate import SimulationReport
    from fleet_slip.vehicle.parameters import VehicleMeasures


@dataclass(frozen=True)
class Training:
    """How a pipeline trains a model: its name, cohort, model list and label."""

    name: str
    cohort: str
    models: str
    label: "Label | None" = None
    vehicle: "VehicleMeasures | None" = None
    """Measured data of the car: the model is combined with a filter in it."""

    @classmethod
    def on_mapping(cls, name: str, mapping: "Mapping") -> "Training":
        """Train on the side-slip angle of a mapping's drives, else on their course.

        Raises `ConfigError` for a mapping without either.
        """
        cohort, label = f"campaign = '{mapping.name}'", mapping.signal_catalog.label
        if label in mapping.signal_names:
            return cls(name, cohort, DEFAULT_MODELS, vehicle=mapping.vehicle)
        if COURSE not in mapping.signals:
            raise ConfigError(
                f"mapping {mapping.name!r}: nothing to learn from. Map {label} (the angle of a "
                f"reference sensor) or {COURSE} (the velocity of a satellite receiver: "
                "docs/course.md)."
            )
        return cls(name, cohort, COURSE_MODELS, label="course")

    def gram(
        self, fleet: "Fleet", workers: "Workers", progress: "ShowStep | None" = None
    ) -> "tuple[GramReport, ...]":
        """Update the Gram rows that the model list needs: signals, its features and auxiliaries."""
        catalog = fleet.warehouse.catalog
        models = load_model_list(catalog, self.models)
        if models.line:  # select computes the rows of the stacked list from those of this one
            models = load_model_list(catalog, models.line)
        auxiliary = catalog.auxiliary_sets(models.features)
        names = dict.fromkeys((PLAIN, models.features, *auxiliary))
        return tuple(
            fleet.gram(
                name,
                cohort=None if name == PLAIN else self.cohort,
                workers=workers,
                progress=step_progress(progress, f"gram {name}"),
            )
            for name in names
        )

    def current_champion(self, fleet: "Fleet") -> "Publication | None":
        """Return the champion if it was selected from the same data, list and program."""
        champion = fleet.models.registry.champion(self.name)
        if champion is None or champion.reference in marked_models(fleet.warehouse):
            return None
        manifest, warehouse = champion.manifest, fleet.warehouse
        measures = manifest.combination.measures if manifest.combination else None
        if self.vehicle not in (None, measures):
            return None
        if not is_current(manifest, warehouse, self.cohort, self.models):
            return None
        return Publication(champion, False, "The champion was trained with the same data and list.")

    def publish(
        self, fleet: "Fleet", *, candidate: bool = False, replace_marked: bool = False
    ) -> "tuple[Selection | None, Publication | None, str]":
        """Select and publish; return the selection, the publication and the refusal.

        There is no selection if the champion is up to date. With `replace_marked`, a champion that
        was trained on erased drives is always replaced.
        """
        if current := self.current_champion(fleet):
            return None, current, ""
        request = SelectionRequest(models=self.models, label=self.label)
        with step("select"):  # the drives are checked already
            checked = fleet.cohort(self.cohort, include_faulty=True)
            selection = checked.select(request, nested=True)
        champion = fleet.models.registry.champion(self.name) if replace_marked else None
        options = {
            "force": champion is not None and champion.reference in marked_models(fleet.warehouse),
            "candidate": candidate,
        }
        try:
            with step("publish"):
                published = fleet.models.publish(
                    self.name, selection, with_filter=self.vehicle, **options
                )
        except RefusedError as error:
            return selection, None, str(error)
        return selection, published, ""


@dataclass(frozen=True)
class Trained(Answer):
    """The result of a training.

    `selection` is None if the champion is up to date, `publication` is None after a `refusal`.
    """

    grams: "tuple[GramReport, ...]"
    """Reports of the logged signals, the feature set of the list, and auxiliary sets."""
    selection: "Selection | None"
    publication: "Publication | None"
    refusal: str
    seconds: float

    @property
    def publish(self) -> "Publication | dict[str, Any]":
        """The publication, or the reason of the refusal."""
        return self.publication or {"new": False, "reason": self.refusal}

    @property
    def changed(self) -> bool:
        """True if Gram rows changed or a version was published."""
        is_published = self.publication is not None and self.publication.new
        return is_published or any(report.changed for report in self.grams)

    def training_parts(
        self, subject: str, before: Iterable[Part], everything: bool
    ) -> Iterator[Part]:
        """Render the steps `before` the training and its own, or that there was nothing to do."""
        if not self.changed:
            champion = self.publication.version.reference if self.publication else self.refusal
            yield Remark(
                f"{subject}: nothing to do, {champion} is up to date ({self.seconds:.1f} s)"
            )
            return
        yield from before
        for gram in self.grams:
            yield Remark(
                f"gram {gram.feature_set.split('-')[0]}: {pluralize(gram.rows_read, 'row')} read, "
                f"{gram.total}"
            )
        if self.selection:
            yield from self.selection.parts(everything, "--all")
        yield from self.publication.parts() if self.publication else (Remark(self.refusal),)
        yield Remark(f"done in {self.seconds:.1f} s")


@dataclass(frozen=True)
class RunReport(Trained):
    """The report of `Fleet.run`; `gram_features` is the report of the list's feature set."""

    DOCUMENT = (
        "campaign changed simulate=simulation gram gram_features? select=selection publish seconds"
    )

    campaign: str
    simulation: "SimulationReport"

    def parts(self, everything: bool = False) -> Iterator[Part]:
        """Render the result of each step."""
        yield from self.training_parts(self.campaign, self.simulation.parts(), everything)

    @property
    def gram(self) -> "GramReport":
        """The report of the logged signals."""
        return self.grams[0]

    @property
    def gram_features(self) -> "GramReport | None":
        """The report of the list's feature set, None if that is the logged signals."""
        return self.grams[1] if len(self.grams) > 1 else None

    @property
    def changed(self) -> bool:
        """True if there was anything to do."""
        return super().changed or self.simulation.changed


@dataclass(frozen=True)
class LearnReport(Trained):
    """The report of `Fleet.learn`."""

    DOCUMENT = (
        "model mapping changed ingest=ingested gram=grams select=selection publish assumed seconds"
    )

    model: str
    mapping: str
    ingested: "tuple[IngestReport, ...]"
    failure: "InputError | None"
    """The error of files that could not be read; all other files are ingested."""

    @property
    def assumed(self) -> tuple[str, ...]:
        """The values that were assumed because the mapping does not give them."""
        return self.publication.version.manifest.assumed if self.publication else ()

    @property
    def changed(self) -> bool:
        """True if there was anything to do."""
        return super().changed or any(report.new for report in self.ingested)

    @property
    def problem(self) -> FleetSlipError | None:
        """The error of a file, the refusal, or the first alarm of a file."""
        if self.failure:
            return self.failure
        if self.refusal:
            refused = RefusedError(self.refusal)
            refused.headline = f"{self.model} was not published, see above"
            return refused
        alarms = (f"{log.file}: {alarm}" for log in self.ingested for alarm in log.alarms)
        return next((AlarmError(alarm) for alarm in alarms), None)

    def parts(self, everything: bool = False) -> Iterator[Part]:
        """Render the result of each step, and the assumptions."""
        counts = [log.counts for log in self.ingested if log.new]
        drives, rows = sum(c.drives for c in counts), sum(c.ticks for c in counts)
        ingested = f"ingested {pluralize(drives, 'drive')}, {pluralize(rows, 'row')}"
        suspicions = {
            (fault.kind, fault.signals): f"{log.file}: looks wrong: {fault}"
            for log in reversed(self.ingested)
            for fault in log.suspicions
        }
        before = map(Remark, (ingested, *suspicions.values()))
        yield from self.training_parts(self.model, before, everything)
        if self.assumed:
            yield Remark(f"assumptions, since {self.mapping} has no other values:")
            yield from (Remark(f"  {value}") for value in self.assumed)


# Nights.

SAMPLE_FILES = 4
"""Log files that a night verifies. The next night verifies the next ones."""

REQUIRED_STEPS = {
    "ingest": (),
    "retain": (),
    "gram": (),
    "quality": ("gram",),
    "monitor": ("gram", "quality"),
    "publish": ("gram", "quality"),
    "verify": ("gram",),
}
"""Steps in their order, with those that must succeed before. Unchecked drives train no model."""

RECORDED_STEPS = {"ingest", "retain", "gram", "publish"}
"""Steps whose calls add themselves to the run record."""

StepResult = tuple[State, str]
"""The state of a step, and a sentence for the summary."""


@dataclass
class NightlyPipeline:
    """One night of a model. `run` executes the steps in order, and continues after a failure.

    A step is skipped if a step that it requires failed.
    """

    fleet: "Fleet"
    inbox: Path
    mapping: str
    training: Training
    candidate: bool
    retention: str | None
    night: date
    workers: Workers = None
    progress: ShowStep | None = None
    baseline: Baseline = field(init=False)
    steps: list[NightStep] = field(default_factory=list)
    files_before: set[str] = field(default_factory=set)
    """Log files that were stored before the night."""
    faults: "tuple[SensorFault, ...]" = ()
    chart: "Chart | None" = None

    def run(self) -> NightReport:
        """Execute and record the night."""
        start = time.monotonic()
        log = NightlyLog(self.fleet.root, self.training.name)
        self.baseline = log.begin(self.night, self._state())
        self.files_before = {file.path for file in self.fleet.warehouse.logs.snapshot().files}
        for name in REQUIRED_STEPS:
            self._execute(name, getattr(self, f"_{name}"))
        report = NightReport(
            model=self.training.name,
            night=self.night,
            root=str(self.fleet.root),
            steps=tuple(self.steps),
            before=self.baseline,
            after=self._state(),
            faults=self.faults,
            chart=self.chart,
            seconds=round(time.monotonic() - start, 3),
        )
        log.end(report.as_past())
        return report

    def _execute(self, name: str, work: Callable[[], StepResult]) -> None:
        start, error = time.monotonic(), None
        state: State
        if reason := self._blocked_by(name):
            state, summary = "left out", reason
        else:
            try:
                with nullcontext() if name in RECORDED_STEPS else step(name):
                    state, summary = work()
            except FleetSlipError as failure:
                state, summary, error = "failed", str(failure), failure
        seconds = round(time.monotonic() - start, 3)
        self.steps.append(NightStep(name, state, summary, seconds, error))

    def _blocked_by(self, name: str) -> str:
        """Return the reason why a step cannot run, empty if it can."""
        warehouse = self.fleet.warehouse
        logs = warehouse.logs.snapshot().rows
        if name != "ingest" and not (logs or warehouse.grams.snapshot().rows):
            return "No drive is in the logs yet."
        if name == "verify" and not logs:
            return "There are no logs to verify."
        undone = [step.name for step in self.steps if step.state in ("failed", "left out")]
        missing = [step for step in REQUIRED_STEPS[name] if step in undone]
        return f"{missing[0]} was not done." if missing else ""

    def _state(self) -> Baseline:
        """Return the present state of the data root."""
        warehouse, name = self.fleet.warehouse, self.training.name
        champion = candidate = None
        drives, query = 0, "SELECT count(DISTINCT drive_id) FROM grams"
        if self.fleet.root.exists():
            registry = self.fleet.models.registry
            champion = registry.champion(name)
            candidate = registry.history(name).pointed_at(CANDIDATE)
        if warehouse.grams.snapshot().rows:
            with connect_tables(warehouse, query) as database:
                drives = int(database.sql(query).fetchall()[0][0])
        waits = candidate and (champion is None or candidate > champion.version)
        return Baseline(
            champion=champion.reference if champion else None,
            drives=drives,
            rows=warehouse.logs.snapshot().rows,
            quarantined=warehouse.quarantine.snapshot().rows,
            candidate=f"{name}@{candidate}" if waits else None,
        )

    def _ingest(self) -> StepResult:
        mapping = load_mapping(self.mapping, self.fleet.warehouse.catalog)
        if not self.inbox.is_dir():
            raise InputError(
                f"{self.inbox}: no such folder. Name the inbox folder for logs, or mount it."
            )
        try:
            logs = find_logs([self.inbox], mapping)
        except InputError:  # a night without new logs is normal
            return "done" if self.baseline.drives else "attention", "No log is in the folder."
        reports: list[IngestReport] = []
        problem = ""
        try:
            self.fleet.ingest(
                self.inbox,
                mapping,
                replace="corrected",
                workers=self.workers,
                on_report=reports.append,
                progress=step_progress(self.progress, "ingest"),
            )
        except RepeatedError as error:  # all other files are ingested
            problem = f"Left out: {error}"
        alarms = (f"{log.file}: looks wrong: {alarm}" for log in reports for alarm in log.alarms)
        problem = problem or next(alarms, "")
        rows = self.fleet.warehouse.logs.snapshot().rows - self.baseline.rows
        replaced = sum(report.drives_replaced for report in reports)
        text = f"The mapping was corrected: {pluralize(replaced, 'drive')} replaced."
        sentences = text * bool(replaced), logs.describe_passed_over(), problem
        summary = " ".join(filter(None, (f"{pluralize(max(rows, 0), 'new row')}.", *sentences)))
        return "attention" if problem else "done", summary

    def _retain(self) -> StepResult:
        warehouse = self.fleet.warehouse
        retention = load_retention(self.retention, warehouse.configs)
        before = date.today() - timedelta(days=retention.drives_days)
        files = warehouse.logs.snapshot().files
        days = [f.day for f in files if f.day is not None and f.path not in self.files_before]
        if day := min((day for day in days if day < before), default=None):
            return "attention", (
                f"Nothing was erased: new drives of {day} already exceed the retention. Check "
                "the clock of their logger; if it is right, run: fleet-slip forget --expired"
            )
        progress = step_progress(self.progress, "retain")
        report = self.fleet.maintenance.apply_retention(self.retention, progress=progress)
        summary = (
            f"{pluralize(report.forgotten.drives, 'drive')} before {report.before} forgotten, "
            f"{pluralize(len(report.vacuumed.files), 'old file')} removed."
        )
        if problem := report.problem:
            return "attention", f"{summary} {problem}"
        return "done", summary

    def _gram(self) -> StepResult:
        self.training.gram(self.fleet, self.workers, self.progress)
        return "done", f"Of {pluralize(self._state().drives, 'drive')}."

    def _quality(self) -> StepResult:
        examined = self.fleet.cohort(self.training.cohort).examine()
        self.faults = examined.findings(self.fleet.warehouse)
        self.training = replace(self.training, cohort=examined.cohort)
        hashes = {hash_drive(self.training.name, fault.drive_id) for fault in self.faults}
        new = len(hashes - self.baseline.known_faults)
        summary = (
            f"{pluralize(examined.drives, 'drive')} checked: {new} newly faulty, {len(hashes)} "
            "faulty in all, left out of training."
        )
        return "attention" if new else "done", summary

    def _monitor(self) -> StepResult:
        champion = self.baseline.champion
        if champion is None:
            return "left out", "There was no champion yet."
        try:
            chart = self.fleet.maintenance.monitor(champion, self.training.cohort)
        except DataError as error:
            return "left out", str(error)
        self.chart = chart
        days = pluralize(sum(not day.training for day in chart.days), "new day")
        limits = f"beyond its limits on {chart.alarm}" if chart.alarms else "within its limits"
        without_log = f"{pluralize(chart.drives_left_out, 'drive')} without a log left out."
        sentences = (
            f"{champion} on {days}: {limits}.",
            without_log * bool(chart.drives_left_out),
            chart.remark,
        )
        return "attention" if chart.alarms else "done", " ".join(filter(None, sentences))

    def _publish(self) -> StepResult:
        selection, publication, refusal = self.training.publish(
            self.fleet, candidate=self.candidate
        )
        if publication is None:
            name = self.training.name
            publication = self.fleet.models.publish(name, selection, candidate=True)
        elif selection is None:
            return "done", f"{publication.version.reference} is up to date."
        reference = publication.version.reference
        is_new = reference != self.baseline.candidate
        state: State = "attention" if refusal and is_new else "done"
        return state, f"{reference}: {publication.reason}"

    def _verify(self) -> StepResult:
        progress = step_progress(self.progress, "verify")
        report = self.fleet.maintenance.check_grams(
            SAMPLE_FILES, begin=self.night.toordinal(), progress=progress
        )
        rows, files = pluralize(report.rows, "row"), pluralize(report.files, "file")
        return "done", f"{rows} of {files} and their Gram rows verified."
