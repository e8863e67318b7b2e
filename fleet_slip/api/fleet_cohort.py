"""The drives that satisfy a predicate, and what their Gram rows answer."""

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import UsageError

if TYPE_CHECKING:
    from fleet_slip.grams.cohort import Cohort
    from fleet_slip.models.diagnose import Diagnosis
    from fleet_slip.models.registry import ModelVersion
    from fleet_slip.models.request import SelectionRequest
    from fleet_slip.models.summary import Selection
    from fleet_slip.operations.sensor_screen import SensorScreen
    from fleet_slip.warehouse.warehouse import Warehouse


@dataclass(frozen=True)
class FleetCohort:
    """The drives that satisfy an SQL predicate on the view `drives`; see `Fleet.cohort`.

    Each call reads the Gram rows of the newest commits. It raises `QuestionError` for an invalid
    predicate, feature set or input, `DataError` if there are no drives or no Gram rows (see
    `Fleet.gram`), and `RefusedError` for drives of evaluation scenarios.
    """

    warehouse: "Warehouse"
    predicate: str
    include_faulty: bool = False

    def __repr__(self) -> str:
        return f"FleetCohort({str(self.warehouse.root)!r}, {self.predicate!r})"

    def examine(self) -> "SensorScreen":
        """Find the drives that may train a model.

        Simulated drives are not checked. Results are cached until the data change. Missing Gram
        rows of the logged signals are computed if that takes seconds.

        Raises
        ------
        NotScreenedError
            If computing the missing Gram rows would take longer.
        """
        from fleet_slip.operations.sensor_screen import SensorScreen, screen_drives

        if self.include_faulty:
            return SensorScreen(self.predicate)
        return screen_drives(self.warehouse, self.predicate)

    def select(
        self, request: "SelectionRequest | None" = None, *, nested: bool = False, **options: Any
    ) -> "Selection":
        """Compare models by cross-validation and choose one; `FleetModels.publish` takes it.

        Without options the models of the list `estimator` are compared. Drives with faulty sensors
        are left out; see `examine`. Missing Gram rows of the default list are computed first if
        that takes seconds; the view `runs` records this as `ensure_grams`.

        Parameters
        ----------
        request
            The options, instead of keyword arguments.
        nested
            Repeat the choice without each measured drive, for an error to expect on new drives.
        options
            Attributes of `fleet_slip.models.request.SelectionRequest`, such as `models="table1"`.

        Raises
        ------
        UsageError
            If options are unknown or exclude each other, or the list is invalid.
        DataError
            If no model can be fitted.
        """
        from fleet_slip.models.request import SelectionPlan, SelectionRequest
        from fleet_slip.models.select import run_plan
        from fleet_slip.models.stacking import ensure_rows

        names = [field.name for field in fields(SelectionRequest)]
        if unknown := options.keys() - {*names}:
            raise UsageError(
                f"unknown option of select: {', '.join(sorted(unknown))}. Options: "
                f"{', '.join(names)}."
            )
        request = request or SelectionRequest(**options)
        plan = SelectionPlan.from_request(self.warehouse.catalog, request)
        screen = self.examine()
        plan = ensure_rows(self.warehouse, plan, self.predicate, screen.cohort)
        selection = run_plan(self.warehouse, plan, screen.cohort, nested=nested)
        return replace(selection, examined=str(screen))

    def diagnose(
        self,
        model: "str | ModelVersion | None" = None,
        *,
        signals: str | None = None,
        features: str | None = None,
    ) -> "Diagnosis":
        """Fit the signals of a model to the cohort and examine the fit.

        Parameters
        ----------
        model
            A reference `NAME`, `NAME@VERSION` or `NAME@ALIAS`, or a version. Default: the only
            published model, unless `signals` is given.
        signals
            Signals to fit instead, separated by commas; `catalogue` means all inputs.
        features
            Feature set of `signals`. Default: the logged signals.

        Raises
        ------
        UsageError
            If both a model and signals are given.
        QuestionError
            If there is no such model.
        """
        from fleet_slip.models.diagnose import diagnose
        from fleet_slip.models.registry import ModelVersion, Registry
        from fleet_slip.models.request import WHOLE_SET, inputs_of

        if signals is not None or features is not None:
            if model is not None:
                raise UsageError("name a published model or signals (of a feature set), not both.")
            cohort = self._load(features or PLAIN)
            return diagnose(cohort, inputs_of(cohort, signals or WHOLE_SET))
        registry = Registry.open(self.warehouse)
        if model is None:
            model = registry.only(", or signals")
        version = model if isinstance(model, ModelVersion) else registry.resolve(model)
        manifest = version.manifest
        diagnosis = diagnose(
            self._load(self.warehouse.catalog.name_of(manifest.trained_on.feature_set)),
            manifest.signals,
            intercept=not manifest.through_origin,
        )
        return replace(diagnosis, remark=manifest.line_remark)

    def _load(self, feature_set: str) -> "Cohort":
        from fleet_slip.grams.cohort import load_cohort

        return load_cohort(self.warehouse, self.predicate, feature_set)
