"""Training again by itself: whether there is anything to do, and what becomes of a worse winner."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_slip.errors import RefusedError

if TYPE_CHECKING:
    from fleet_slip.api.fleet import Fleet
    from fleet_slip.models.publish import Publication
    from fleet_slip.selection.requested_selection import RequestedSelection


@dataclass(frozen=True)
class Training:
    """What a model is trained on, and how it is chosen: the same from night to night.

    Attributes:
        name: of the model.
        cohort: an SQL condition on the view `drives`.
        models: the model list that is compared.
        worth: the smallest gain in RMSE that is worth a signal.
        sign_key: the private key that signs versions.
    """

    name: str
    cohort: str
    models: str
    worth: str
    sign_key: Path | None = None

    def made_already(self, fleet: "Fleet") -> "Publication | None":
        """Return the champion if a selection would come to it again, whatever it looks at."""
        from fleet_slip.maintenance.marks import marked_models
        from fleet_slip.models.publish import Publication
        from fleet_slip.models.up_to_date import is_up_to_date

        champion = fleet.registry().champion(self.name)
        if champion is None or champion.reference in marked_models(fleet.root):
            return None
        manifest = champion.manifest
        if not is_up_to_date(manifest, fleet.warehouse, self.cohort, self.models, self.worth):
            return None
        return Publication(champion, False, "The champion was made from the same data and list.")

    def select(self, fleet: "Fleet") -> "RequestedSelection":
        """Compare the models of the list on the cohort."""
        return fleet.cohort(self.cohort).select(models=self.models, worth=self.worth)

    def publish_if_not_worse(
        self, fleet: "Fleet", selection: "RequestedSelection", *, replace_marked: bool
    ) -> "tuple[Publication | None, str]":
        """Return the publication, or None and why it was refused.

        With `replace_marked`, what was trained on forgotten drives is replaced even by a worse one.
        """
        from fleet_slip.maintenance.marks import marked_models

        champion = fleet.registry().champion(self.name)
        force = (
            replace_marked
            and champion is not None
            and champion.reference in marked_models(fleet.root)
        )
        try:
            published = fleet.publish(self.name, selection, force=force, sign_key=self.sign_key)
        except RefusedError as error:
            return None, str(error)
        return published, ""
