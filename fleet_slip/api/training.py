"""What trains a model, as runs, `learn` and nights do, and what `Fleet.run` and `learn` came to."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fleet_slip.api.calls import ShowStep, Workers, of_step
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
    """What trains a model every night: cohort, model list, `tolerance` of a signal."""

    name: str
    cohort: str
    models: str
    tolerance: str | None = None
    label: "Label | None" = None

    @classmethod
    def on_mapping(cls, name: str, mapping: "Mapping") -> "Training":
        """Return what trains on a mapping's drives: its side-slip angle, else its course.

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
        """Make the Gram rows that the list needs: of the signals, its feature set, and others."""
        catalog = fleet.warehouse.catalog
        models = load_model_list(catalog, self.models)
        if models.line:  # from what its rows tell, select makes those of the list
            models = load_model_list(catalog, models.line)
        auxiliary = catalog.auxiliary_sets(models.features)
        names = dict.fromkeys((PLAIN, models.features, *auxiliary))
        return tuple(
            fleet.gram(
                name,
                cohort=None if name == PLAIN else self.cohort,
                workers=workers,
                progress=of_step(progress, f"gram {name}"),
            )
            for name in names
        )

    def current_champion(self, fleet: "Fleet") -> "Publication | None":
        """Return the champion if a selection would come to it again, whatever it looks at."""
        from fleet_slip.models.publish import Publication, is_current
        from fleet_slip.operations.marked_models import marked_models

        champion = fleet.registry().champion(self.name)
        if champion is None or champion.reference in marked_models(fleet.warehouse):
            return None
        manifest = champion.manifest
        if not is_current(manifest, fleet.warehouse, self.cohort, self.models, self.tolerance):
            return None
        return Publication(champion, False, "The champion was made from the same data and list.")

    def select(self, fleet: "Fleet") -> "Selection":
        """Compare the models of the list on the cohort, which a night has examined."""
        cohort = fleet.cohort(self.cohort, include_faulty=True)
        return cohort.select(models=self.models, tolerance=self.tolerance, label=self.label)

    def publish(
        self, fleet: "Fleet", *, replace_marked: bool = False
    ) -> "tuple[Selection | None, Publication | None, str]":
        """Select and publish; return the selection, the publication, or why there is none.

        There is no selection if the champion is up to date.
        """
        if made := self.current_champion(fleet):
            return None, made, ""
        with step("select"):
            selection = self.select(fleet)
        with step("publish"):
            return selection, *self.publish_if_not_worse(
                fleet, selection, replace_marked=replace_marked
            )

    def publish_if_not_worse(
        self, fleet: "Fleet", selection: "Selection", *, replace_marked: bool
    ) -> "tuple[Publication | None, str]":
        """Return the publication, or None and why it was refused.

        With `replace_marked`, what was trained on forgotten drives is replaced even by a worse one.
        """
        from fleet_slip.operations.marked_models import marked_models

        champion = fleet.registry().champion(self.name)
        force = (
            replace_marked
            and champion is not None
            and champion.reference in marked_models(fleet.warehouse)
        )
        try:
            published = fleet.publish(self.name, selection, force=force)
        except RefusedError as error:
            return None, str(error)
        return published, ""


@dataclass(frozen=True)
class Trained(Answer):
    """What training came to.

    There is no selection where the champion is up to date, and no publication after a `refusal`.
    """

    grams: "tuple[GramReport, ...]"
    """Of the logged signals first, then of the list's feature set, and what that needs."""
    selection: "Selection | None"
    publication: "Publication | None"
    refusal: str
    seconds: float

    @property
    def new(self) -> bool:
        """Whether rows were read or a version was published."""
        published = self.publication is not None and self.publication.new
        return published or any(one.changed for one in self.grams)

    @property
    def publish(self) -> "Publication | dict[str, Any]":
        """The publication, or why there is none."""
        return self.publication or {"new": False, "reason": self.refusal}

    def training_parts(self, everything: bool) -> Iterator[Part]:
        """Return what each step did."""
        for gram in self.grams:
            name = "gram" if gram is self.grams[0] else f"gram {gram.feature_set}"
            read, made = pluralize(gram.rows_read, "row"), pluralize(gram.gram_rows, "Gram row")
            if gram.changed or gram in self.grams[:2]:
                yield Remark(f"{name}: {read} read, {made}")
        if self.selection:
            yield from self.selection.parts(everything)
        if self.publication:
            yield from self.publication.parts()
        else:
            yield Remark(self.refusal)
        yield Remark(f"done in {self.seconds:.1f} s")

    def nothing_done(self, what: str) -> Remark:
        """Return the sentence of a call that found nothing new."""
        kept = self.publication.version.reference if self.publication else self.refusal
        return Remark(f"{what}: nothing to do, {kept} is up to date ({self.seconds:.1f} s)")


@dataclass(frozen=True)
class RunReport(Trained):
    """What `Fleet.run` did; `gram_features` is the report of the list's feature set."""

    DOCUMENT = (
        "campaign changed simulate=simulation gram gram_features? select=selection publish seconds"
    )

    campaign: str
    simulation: "SimulationReport"

    def parts(self, everything: bool = False) -> Iterator[Part]:
        """Return what each step did."""
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
        """The report of the list's feature set, unless that is the logged signals."""
        return self.grams[1] if len(self.grams) > 1 else None

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        return self.new or self.simulation.changed


@dataclass(frozen=True)
class LearnReport(Trained):
    """What `Fleet.learn` did."""

    DOCUMENT = (
        "model mapping changed ingest=ingested gram=grams select=selection publish assumed seconds"
    )

    model: str
    mapping: str
    ingested: "tuple[IngestReport, ...]"
    failure: "InputError | None"
    """What was wrong with files that could not be read; all others are in."""

    @property
    def assumed(self) -> tuple[str, ...]:
        """Which values stand for what nobody said."""
        return self.publication.version.manifest.assumed if self.publication else ()

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        return self.new or any(one.new for one in self.ingested)

    @property
    def problem(self) -> FleetSlipError | None:
        """What was wrong with a file, why nothing was published, or what looks wrong."""
        if self.failure or self.refusal:
            return self.failure or RefusedError(self.refusal)
        alarms = (f"{one.file}: {found}" for one in self.ingested for found in one.alarms)
        return next((AlarmError(alarm) for alarm in alarms), None)

    def parts(self, everything: bool = False) -> Iterator[Part]:
        """Return what each step did, and what was assumed."""
        looks = {str(found): one.file for one in self.ingested for found in one.suspicions}
        if self.changed:
            new = [one for one in self.ingested if one.new]
            drives, rows = (sum(getattr(o.counts, n) for o in new) for n in ("drives", "ticks"))
            yield Remark(f"ingested {pluralize(drives, 'drive')}, {pluralize(rows, 'row')}")
            yield from (Remark(f"{file}: looks wrong: {found}") for found, file in looks.items())
            yield from self.training_parts(everything)
        else:
            yield self.nothing_done(self.model)
        if self.assumed:
            yield Remark(f"assumed, since {self.mapping} does not say otherwise:")
            yield from (Remark(f"  {one}") for one in self.assumed)
