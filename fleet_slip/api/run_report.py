"""What `Fleet.run` did; and training again by itself, as runs and nights do."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from fleet_slip.errors import RefusedError
from fleet_slip.grams.rows.gram_job import GramReport
from fleet_slip.models.publish import Publication
from fleet_slip.selection.select_models import RequestedSelection

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet
    from fleet_slip.simulation.simulation_job import SimulationReport


@dataclass(frozen=True)
class RunReport:
    """The report of each step; `gram_features` is that of the list's feature set.

    There is no selection where the champion is up to date, and no publication after a `refusal`.
    """

    campaign: str
    simulation: "SimulationReport"
    gram: GramReport
    gram_features: GramReport | None
    selection: RequestedSelection | None
    publication: Publication | None
    refusal: str
    seconds: float

    @property
    def changed(self) -> bool:
        """Whether there was anything to do."""
        published = self.publication is not None and self.publication.new
        steps = (self.simulation, self.gram, self.gram_features)
        return published or any(one.changed for one in steps if one)

    def as_dict(self) -> dict[str, Any]:
        """Return what `run --json` prints."""
        refused = {"new": False, "reason": self.refusal}
        return {
            "campaign": self.campaign,
            "changed": self.changed,
            "simulate": asdict(self.simulation),
            "gram": asdict(self.gram),
            **({"gram_features": asdict(self.gram_features)} if self.gram_features else {}),
            "select": self.selection.as_dict() if self.selection else None,
            "publish": self.publication.as_dict() if self.publication else refused,
            "seconds": self.seconds,
        }


@dataclass(frozen=True)
class Training:
    """What trains a model every night: cohort, model list, `worth` of a signal."""

    name: str
    cohort: str
    models: str
    worth: str | None

    def made_already(self, fleet: "Fleet") -> "Publication | None":
        """Return the champion if a selection would come to it again, whatever it looks at."""
        from fleet_slip.maintenance.marked_models import marked_models
        from fleet_slip.models.publish import Publication
        from fleet_slip.models.recipe import is_up_to_date

        champion = fleet.registry().champion(self.name)
        if champion is None or champion.reference in marked_models(fleet.root):
            return None
        manifest = champion.manifest
        if not is_up_to_date(manifest, fleet.warehouse, self.cohort, self.models, self.worth):
            return None
        return Publication(champion, False, "The champion was made from the same data and list.")

    def select(self, fleet: "Fleet") -> "RequestedSelection":
        """Compare the models of the list on the cohort, which a night has examined."""
        cohort = fleet.cohort(self.cohort, unexamined=True)
        return cohort.select(models=self.models, worth=self.worth)

    def publish_if_not_worse(
        self, fleet: "Fleet", selection: "RequestedSelection", *, replace_marked: bool
    ) -> "tuple[Publication | None, str]":
        """Return the publication, or None and why it was refused.

        With `replace_marked`, what was trained on forgotten drives is replaced even by a worse one.
        """
        from fleet_slip.maintenance.marked_models import marked_models

        champion = fleet.registry().champion(self.name)
        force = (
            replace_marked
            and champion is not None
            and champion.reference in marked_models(fleet.root)
        )
        try:
            published = fleet.publish(self.name, selection, force=force)
        except RefusedError as error:
            return None, str(error)
        return published, ""
