"""Drives that satisfy a condition, and what Gram rows tell of them."""

from dataclasses import replace
from typing import TYPE_CHECKING

from fleet_slip.api.calls import Rooted, open_workers, takes
from fleet_slip.api.requests import DiagnosisRequest, ExaminedRequest, RegimesRequest, WhatIfRequest
from fleet_slip.errors import UsageError
from fleet_slip.models.request import SelectionRequest
from fleet_slip.warehouse.tables import Warehouse

if TYPE_CHECKING:
    from fleet_slip.api.requests import ExaminedModel
    from fleet_slip.evaluation.identify import Identified
    from fleet_slip.grams.cohort import Cohort
    from fleet_slip.models.diagnose import Diagnosis, WhatIf
    from fleet_slip.models.regimes import RegimeComparison
    from fleet_slip.models.select import RequestedSelection
    from fleet_slip.operations.examined import Examined


class FleetCohort(Rooted):
    """The drives that satisfy an SQL condition on the view `drives`; `Fleet.cohort` makes one.

    Each call reads the Gram rows of the newest commits, and raises `QuestionError` for an invalid
    condition, feature set or input, `DataError` without drives or Gram rows (see `Fleet.gram`), and
    `RefusedError` for drives of evaluation scenarios.
    """

    def __init__(self, warehouse: Warehouse, condition: str, unexamined: bool = False) -> None:
        super().__init__(warehouse)
        self.condition = condition
        self.unexamined = unexamined

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.root)!r}, {self.condition!r})"

    def examine(self) -> "Examined":
        """Return the drives that may train a model; raises as `Fleet.quality`.

        Simulated drives are passed over; what was found is kept while the data stay. Gram rows of
        `signals` that are missing are made. Raises `UnexaminedError` if that takes more than
        seconds.
        """
        from fleet_slip.operations.examined import Examined, find_trainable

        if self.unexamined:
            return Examined(self.condition)
        return find_trainable(self.warehouse, self.condition)

    @takes(SelectionRequest)
    def select(self, request: SelectionRequest) -> "RequestedSelection":
        """Compare models by cross-validation and choose one; `Fleet.publish` takes the answer.

        Drives that are not in order are left out: see `examine`, and `examined` of the answer.
        Raises what `examine` raises, `UsageError` for options that do not go together or an invalid
        list, and `DataError` if no model can be fitted.
        """
        from fleet_slip.models.select import answer_request

        examined = self.examine()
        with examined.explaining():
            answer = answer_request(self.warehouse, request, examined.cohort)
        return replace(answer, examined=str(examined))

    @takes(DiagnosisRequest)
    def diagnose(self, request: DiagnosisRequest) -> "Diagnosis":
        """Fit a model's signals to the cohort and examine the fit.

        Raises `UsageError` for both a model and signals, and what `Fleet.model` raises.
        """
        from fleet_slip.models.diagnose import diagnose

        examined = self._examined(request)
        cohort, against = self._load(examined.feature_set), request.against
        return diagnose(
            cohort,
            examined.inputs(cohort),
            against=self._load(examined.feature_set, against) if against else None,
            cluster=request.cluster,
            intercept=examined.intercept,
        )

    @takes(WhatIfRequest)
    def what_if(self, request: WhatIfRequest) -> "WhatIf":
        """Predict a model's error with worse sensors, in closed form, and the best model for these.

        Raises `UsageError` if nothing is added or both a model and signals are named,
        `QuestionError` for a signal inside a feature, and what `Fleet.model` raises.
        """
        from fleet_slip.catalogue.signals import catalogue
        from fleet_slip.models.diagnose import what_if
        from fleet_slip.models.predict import counts_model
        from fleet_slip.regression.least_squares import fit

        noise, bias = request.noise or {}, request.bias or {}
        if not noise and not bias:
            raise UsageError(
                "say what is added: noise such as ay=0.2, or bias such as yaw_rate=0.02."
            )
        examined = self._examined(request)
        cohort = self._load(examined.feature_set)
        if examined.version is not None:
            one = counts_model(examined.version.manifest)
        else:
            inputs = examined.inputs(cohort)
            one = fit(cohort.serving(inputs).table.total(), inputs, catalogue().label).model
        return what_if(cohort, one, bias=bias, noise=noise, intercept=examined.intercept)

    @takes(RegimesRequest)
    def regimes(self, request: RegimesRequest) -> "RegimeComparison":
        """Return a model's error by speed and lateral acceleration, and whether to split it there.

        One model for all rows is cross-validated against one a regime, from what
        `fleet.gram("regimes")` makes. Raises `UsageError` for both a model and signals, and
        `DataError` for a feature set without such regimes.
        """
        from fleet_slip.grams.folding import Folding, make_folding
        from fleet_slip.models.regimes import compare_regimes, divided_set
        from fleet_slip.models.request import WHOLE_SET, inputs_of, parse_worth

        gain, signals = parse_worth(request.worth), request.signals
        if request.model is not None:
            version = self._examined(ExaminedRequest(request.model, signals=signals)).version
            signals = ",".join(version.manifest.signals) if version else None
        features = request.features or divided_set(signals)
        folding = make_folding(request.by, request.folds, Folding().count)
        cohort = self._load(features)
        inputs = inputs_of(cohort, signals or WHOLE_SET)
        return compare_regimes(cohort, inputs, folding, request.over, gain)

    def identify(self, name: str, *, threads: int | None = None, **measured: float) -> "Identified":
        """Identify the tyres and the yaw inertia of the car that made the cohort's drives.

        `measured` is what scales and a tape measure say, in the words of
        `fleet_slip.evaluation.identify.Measured`. The extended Kalman filter in the
        car is fitted to the labels of up to 24 drives; its error on drives that were left out
        stands beside. Raises `DataError` if the drives lack the label or what the filter needs, and
        `UsageError` for a name or number that no car can have.
        """
        from pydantic import ValidationError

        from fleet_slip.config import faults_of
        from fleet_slip.evaluation.filters import TuningDrives
        from fleet_slip.evaluation.identify import Measured, identify_held_out

        try:
            car = Measured.model_validate({"name": name, **measured})
        except ValidationError as error:
            raise UsageError(f"what was measured of the car: {faults_of(error)}.") from None
        chosen = TuningDrives.of(self.warehouse, self._load("signals"), weighed=False)
        with open_workers(self.root, threads) as executor:
            return identify_held_out(car, chosen.read(), executor)

    def _load(self, feature_set: str, condition: str | None = None) -> "Cohort":
        from fleet_slip.grams.cohort import load_cohort

        return load_cohort(self.warehouse, condition or self.condition, feature_set)

    def _examined(self, request: ExaminedRequest) -> "ExaminedModel":
        from fleet_slip.api.requests import subject_of
        from fleet_slip.models.registry import Registry

        return subject_of(Registry(self.root / "models"), request)
