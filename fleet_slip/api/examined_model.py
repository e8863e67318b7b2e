"""What is examined: a published model, or signals that are named."""

from dataclasses import dataclass

from fleet_slip.api.requests import ExaminedRequest
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.errors import UsageError
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.versions import Registry
from fleet_slip.selection.model_list import WHOLE_SET, inputs_of


@dataclass(frozen=True)
class ExaminedModel:
    """The inputs of a published model, or named ones."""

    feature_set: str
    named: str | None
    version: ModelVersion | None

    @property
    def intercept(self) -> bool:
        """Whether the model has one; inputs that are named alone have."""
        return self.version is None or not self.version.manifest.through_origin

    def inputs(self, cohort: Cohort) -> tuple[str, ...]:
        """Return the inputs; all that the cohort has, if that was asked for."""
        if self.version is not None:
            return self.version.manifest.signals
        return inputs_of(cohort, self.named or WHOLE_SET)


def subject_of(registry: Registry, request: ExaminedRequest) -> ExaminedModel:
    """Return what is examined, by default the only model. Raises `UsageError` for both kinds."""
    model = request.model
    if request.signals is not None or request.features is not None:
        if model is not None:
            raise UsageError("name a published model or signals (of a feature set), not both.")
        return ExaminedModel(request.features or PLAIN, request.signals, None)
    if model is None:
        model = registry.only(", or signals")
    version = model if isinstance(model, ModelVersion) else registry.resolve(model)
    identity = version.manifest.trained_on.feature_set
    return ExaminedModel(features().name_of(identity), None, version)
