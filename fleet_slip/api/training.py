"""The training of a model in the pipelines `run`, `learn` and `nightly`, and their reports."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fleet_slip.api.calls import ShowStep, Workers, step_progress
from fleet_slip.base import pluralize
from fleet_slip.catalog.course import COURSE
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import AlarmError, ConfigError, FleetSlipError, InputError, RefusedError
from fleet_slip.models.request import COURSE_MODELS, DEFAULT_MODELS, Label, load_model_list
from fleet_slip.rendering import Answer, Part, Remark
from fleet_slip.storage.runs import step

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet
    from fleet_slip.grams.update import GramReport
    from fleet_slip.ingest.load import IngestReport
    from fleet_slip.ingest.mapping import Mapping
    from fleet_slip.models.publish import Publication
    from fleet_slip.models.select import Selection
    from fleet_slip.simulation.simulate import SimulationReport


@dataclass(frozen=True)
class Training:
    """How a pipeline trains a model: its name, cohort, model list, tolerance and label."""

    name: str
    cohort: str
    models: str
    tolerance: str | None = None
    label: "Label | None" = None

    @classmethod
    def on_mapping(cls, name: str, mapping: "Mapping") -> "Training":
        """Train on the side-slip angle of a mapping's drives, else on their course.

        Raises `ConfigError` for a mapping without either.
        """
        cohort, label = f"campaign = '{mapping.name}'", mapping.signal_catalog.label
        if label in mapping.signal_names:
            return cls(name, cohort, DEFAULT_MODELS)
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
        from fleet_slip.models.publish import Publication, is_current
        from fleet_slip.operations.marked_models import marked_models

        champion = fleet.models.registry.champion(self.name)
        if champion is None or champion.reference in marked_models(fleet.warehouse):
            return None
        manifest = champion.manifest
        if not is_current(manifest, fleet.warehouse, self.cohort, self.models, self.tolerance):
            return None
        return Publication(champion, False, "The champion was made from the same data and list.")

    def select(self, fleet: "Fleet") -> "Selection":
        """Compare the models of the list on the cohort, whose drives are checked already."""
        cohort = fleet.cohort(self.cohort, include_faulty=True)
        return cohort.select(models=self.models, tolerance=self.tolerance, label=self.label)

    def publish(
        self, fleet: "Fleet", *, replace_marked: bool = False
    ) -> "tuple[Selection | None, Publication | None, str]":
        """Select and publish; return the selection, the publication and the refusal.

        There is no selection if the champion is up to date.
        """
        if current := self.current_champion(fleet):
            return None, current, ""
        with step("select"):
            selection = self.select(fleet)
        with step("publish"):
            return selection, *self.publish_if_not_worse(
                fleet, selection, replace_marked=replace_marked
            )

    def publish_if_not_worse(
        self, fleet: "Fleet", selection: "Selection", *, replace_marked: bool
    ) -> "tuple[Publication | None, str]":
        """Return the publication, or None and the reason of the refusal.

        With `replace_marked`, a champion that was trained on erased drives is always replaced.
        """
        from fleet_slip.operations.marked_models import marked_models

        champion = fleet.models.registry.champion(self.name)
        force = (
            replace_marked
            and champion is not None
            and champion.reference in marked_models(fleet.warehouse)
        )
        try:
            return fleet.models.publish(self.name, selection, force=force), ""
        except RefusedError as error:
            return None, str(error)


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
    def new(self) -> bool:
        """True if rows were read or a version was published."""
        is_published = self.publication is not None and self.publication.new
        return is_published or any(report.changed for report in self.grams)

    @property
    def publish(self) -> "Publication | dict[str, Any]":
        """The publication, or the reason of the refusal."""
        return self.publication or {"new": False, "reason": self.refusal}

    def training_parts(self, everything: bool) -> Iterator[Part]:
        """Render the result of each step."""
        for gram in self.grams:
            name = "gram" if gram is self.grams[0] else f"gram {gram.feature_set}"
            rows, new = pluralize(gram.rows_read, "row"), pluralize(gram.gram_rows, "Gram row")
            if gram.changed or gram in self.grams[:2]:
                yield Remark(f"{name}: {rows} read, {new}")
        if self.selection:
            yield from self.selection.parts(everything)
        if self.publication:
            yield from self.publication.parts()
        else:
            yield Remark(self.refusal)
        yield Remark(f"done in {self.seconds:.1f} s")

    def nothing_done(self, subject: str) -> Remark:
        """Render the sentence for a call without new data."""
        champion = self.publication.version.reference if self.publication else self.refusal
        return Remark(f"{subject}: nothing to do, {champion} is up to date ({self.seconds:.1f} s)")


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
        if not self.changed:
            yield self.nothing_done(self.campaign)
            return
        yield from self.simulation.parts()
        yield from self.training_parts(everything)

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
        return self.new or self.simulation.changed


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
        return self.new or any(report.new for report in self.ingested)

    @property
    def problem(self) -> FleetSlipError | None:
        """The error of a file, the refusal, or the first alarm of a file."""
        if self.failure or self.refusal:
            return self.failure or RefusedError(self.refusal)
        alarms = (f"{log.file}: {alarm}" for log in self.ingested for alarm in log.alarms)
        return next((AlarmError(alarm) for alarm in alarms), None)

    def parts(self, everything: bool = False) -> Iterator[Part]:
        """Render the result of each step, and what was assumed."""
        suspicions = {str(text): log.file for log in self.ingested for text in log.suspicions}
        if self.changed:
            counts = [log.counts for log in self.ingested if log.new]
            drives, rows = sum(c.drives for c in counts), sum(c.ticks for c in counts)
            yield Remark(f"ingested {pluralize(drives, 'drive')}, {pluralize(rows, 'row')}")
            for text, file in suspicions.items():
                yield Remark(f"{file}: looks wrong: {text}")
            yield from self.training_parts(everything)
        else:
            yield self.nothing_done(self.model)
        if self.assumed:
            yield Remark(f"assumed, since {self.mapping} does not say otherwise:")
            yield from (Remark(f"  {value}") for value in self.assumed)
