"""What `Fleet.run` did."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from fleet_slip.grams.rows.gram_job import GramReport
from fleet_slip.models.publish import Publication
from fleet_slip.selection.requested_selection import RequestedSelection

if TYPE_CHECKING:  # it brings a compiler
    from fleet_slip.simulation.job import SimulationReport


@dataclass(frozen=True)
class RunReport:
    """The report of each step.

    `gram_features` is of the feature set of the model list, if that is not the logged signals.
    There is no selection where the champion was made from the same data, list and program, and no
    publication where it was refused, with the reason.
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
