"""Drives that satisfy a predicate, and what Gram rows tell of them."""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Unpack

from typing_extensions import Doc

from fleet_slip.api.calls import CarMeasures, Rooted, open_workers, takes
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import UsageError
from fleet_slip.models.registry import ModelVersion, Registry
from fleet_slip.models.request import (
    CLUSTER,
    DEFAULT_MODELS,
    WHOLE_SET,
    SelectionRequest,
    inputs_of,
)
from fleet_slip.regression.drives import ClusterUnit
from fleet_slip.warehouse.warehouse import Warehouse

if TYPE_CHECKING:
    from fleet_slip.evaluation.identify import IdentifiedVehicle
    from fleet_slip.grams.cohort import Cohort
    from fleet_slip.models.diagnose import Diagnosis
    from fleet_slip.models.select import Selection
    from fleet_slip.operations.sensor_screen import SensorScreen

OR_SIGNALS = Doc(
    "NAME, NAME@VERSION or NAME@ALIAS of a published model. Default: the only one that there is, "
    "unless `signals` is given."
)
SIGNALS = Doc(
    "Instead of a published model: signals to fit, separated by commas; 'catalogue' is all inputs."
)
OF_SIGNALS = Doc("Feature set that `signals` are of. Default: the logged signals.")

WINDOW_ROWS = 4_000_000
"""Maximum number of log rows whose window columns `select` computes: they take seconds."""


class FleetCohort(Rooted):
    """The drives that satisfy an SQL predicate on the view `drives`; `Fleet.cohort` makes one.

    Each call reads the Gram rows of the newest commits, and raises `QuestionError` for an invalid
    predicate, feature set or input, `DataError` without drives or Gram rows (see `Fleet.gram`), and
    `RefusedError` for drives of evaluation scenarios.
    """

    def __init__(self, warehouse: Warehouse, predicate: str, include_faulty: bool = False) -> None:
        super().__init__(warehouse)
        self.predicate = predicate
        self.include_faulty = include_faulty

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.root)!r}, {self.predicate!r})"

    def examine(self) -> "SensorScreen":
        """Return the drives that may train a model; raises as `Fleet.quality`.

        Passes over simulated drives, and caches the result. Computes missing Gram rows of
        `signals` first, as `select` does. Raises `NotScreenedError` if that takes longer than
        seconds.
        """
        from fleet_slip.operations.sensor_screen import SensorScreen, screen_drives

        if self.include_faulty:
            return SensorScreen(self.predicate)
        return screen_drives(self.warehouse, self.predicate)

    @takes(SelectionRequest)
    def select(self, request: SelectionRequest) -> "Selection":
        """Compare models by cross-validation and choose one; `Fleet.publish` takes the answer.

        Drives with faulty sensors are left out: see `examine`, and `examined` of the answer. The
        comparison only reads. Missing Gram rows that the default list needs are computed first, if
        that takes seconds: the view `runs` records this as `ensure_grams`, and a remark reports it.
        Raises what `examine` raises, `UsageError` for options that do not go together or an invalid
        list, and `DataError` if no model can be fitted.
        """
        from fleet_slip.grams.update import ensure_grams
        from fleet_slip.models.line import with_line_fitted
        from fleet_slip.models.select import SelectionPlan, run_selection

        examined = self.examine()
        with examined.explaining():
            request = with_line_fitted(self.warehouse, request, self.predicate, examined.cohort)
            plan = SelectionPlan.of(self.warehouse.catalog, request)
            if plan.request.models == DEFAULT_MODELS:
                ensure_grams(
                    self.warehouse,
                    plan.feature_set,
                    examined.cohort,
                    reason=f"model list {DEFAULT_MODELS} needs them",
                    max_rows=WINDOW_ROWS,
                )
            found = run_selection(self.warehouse, request, examined.cohort)
        return replace(found, examined=str(examined))

    def diagnose(
        self,
        model: Annotated["str | ModelVersion | None", OR_SIGNALS] = None,
        *,
        signals: Annotated[str | None, SIGNALS] = None,
        features: Annotated[str | None, OF_SIGNALS] = None,
        cluster: Annotated[ClusterUnit | None, CLUSTER] = None,
    ) -> "Diagnosis":
        """Fit a model's signals to the cohort and examine the fit.

        Raises `UsageError` for both a model and signals, and what `Fleet.model` raises.
        """
        from fleet_slip.models.diagnose import diagnose

        cohort, inputs, version = self._opened(model, signals, features)
        return diagnose(
            cohort,
            inputs,
            cluster=cluster,
            intercept=version is None or not version.manifest.through_origin,
        )

    def identify(
        self,
        name: Annotated[str, Doc("What the car is to be called.")],
        *,
        threads: int | None = None,
        **measured: Unpack[CarMeasures],
    ) -> "IdentifiedVehicle":
        """Identify the tyres and the yaw inertia of the car that made the cohort's drives.

        Mass and axles must be known. The extended Kalman filter in the car is fitted to the labels
        of up to 24 drives; its error on drives that were left out stands beside. Raises `DataError`
        if the drives lack the label or what the filter needs, and `UsageError` for a name or number
        that no car can have.
        """
        from fleet_slip.evaluation.filters import TuningDrives
        from fleet_slip.evaluation.identify import identify_held_out, measures_of

        car = measures_of(name, measured)
        chosen = TuningDrives.choose(self.warehouse, self._load(PLAIN), with_mass=False)
        with open_workers(self.root, threads) as executor:
            return identify_held_out(car, chosen.drives, executor)

    def _load(self, feature_set: str) -> "Cohort":
        from fleet_slip.grams.cohort import load_cohort

        return load_cohort(self.warehouse, self.predicate, feature_set)

    def _opened(
        self, model: str | ModelVersion | None, signals: str | None, features: str | None
    ) -> "tuple[Cohort, tuple[str, ...], ModelVersion | None]":
        """Return Gram rows, and the inputs of a published model, by default the only one, or named.

        Raises `UsageError` for both a model and signals.
        """
        if signals is not None or features is not None:
            if model is not None:
                raise UsageError("name a published model or signals (of a feature set), not both.")
            cohort = self._load(features or PLAIN)
            return cohort, inputs_of(cohort, signals or WHOLE_SET), None
        registry = Registry.of(self.warehouse)
        if model is None:
            model = registry.only(", or signals")
        version = model if isinstance(model, ModelVersion) else registry.resolve(model)
        identity = version.manifest.trained_on.feature_set
        cohort = self._load(self.warehouse.catalog.name_of(identity))
        return cohort, version.manifest.signals, version
