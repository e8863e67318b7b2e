"""The part of a `Fleet` that serves published models."""

from typing import TYPE_CHECKING

from fleet_slip.api.root import Rooted
from fleet_slip.models.versions import Registry

if TYPE_CHECKING:
    import pyarrow as pa

    from fleet_slip.models.model_version import ModelVersion


class Serving(Rooted):
    """Published models: which there are, and each of them."""

    def models(self, name: str | None = None) -> "pa.Table":
        """Return all published versions, or those of one model, one row each.

        The columns are those of the view `models`, and `trained_on_forgotten`: whether the version
        was trained on drives that were forgotten since. Raises `QuestionError` for an unknown model
        and `StorageError` without a data root.
        """
        from fleet_slip.maintenance.marks import marked_models

        self.warehouse.require()
        registry = self._registry()
        if name is not None:
            registry.require(name)
        found = registry.as_table(name)
        marked = marked_models(self.root)
        pairs = zip(found["name"].to_pylist(), found["version"].to_pylist(), strict=True)
        return found.append_column(
            "trained_on_forgotten", [[f"{name}@{version}" in marked for name, version in pairs]]
        )

    def model(self, reference: str) -> "ModelVersion":
        """Return the version that `NAME`, `NAME@VERSION` or `NAME@ALIAS` names.

        `NAME` alone is its champion. Raises `QuestionError` for an unknown one, `StorageError` for
        one that was changed after it was published, and `RefusedError` for one without the
        signature that is asked for.
        """
        return self._registry().resolve(reference)

    def _registry(self) -> Registry:
        return Registry(self.root / "models")
