"""Cohorts, and the models that are selected on them: publish, list, promote and export them."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fleet_slip.api.calls import open_workers, record_call
from fleet_slip.catalog.features import PLAIN
from fleet_slip.errors import RefusedError, UsageError
from fleet_slip.models.manifest import Manifest, require_model_name
from fleet_slip.models.registry import (
    CHAMPION,
    Difference,
    ModelVersion,
    Registry,
    compare_versions,
)
from fleet_slip.storage.local import LocalFolder
from fleet_slip.vehicle.parameters import VehicleMeasures, load_measures

if TYPE_CHECKING:
    import pyarrow as pa

    from fleet_slip.export.program import Target
    from fleet_slip.export.stepping import Estimator
    from fleet_slip.grams.cohort import Cohort
    from fleet_slip.ingest.mapping import Mapping as LogMapping
    from fleet_slip.models.diagnose import Diagnosis
    from fleet_slip.models.log_predictions import Predictions
    from fleet_slip.models.publish import DryRun, Publication
    from fleet_slip.models.request import SelectionRequest
    from fleet_slip.models.summary import Selection
    from fleet_slip.operations.sensor_screen import SensorScreen
    from fleet_slip.warehouse.warehouse import Warehouse

T = TypeVar("T")


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
        return dataclasses.replace(selection, examined=str(screen))

    def diagnose(
        self,
        model: str | ModelVersion | None = None,
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
        from fleet_slip.models.request import WHOLE_SET, inputs_of

        if signals is not None or features is not None:
            if model is not None:
                raise UsageError("name a published model or signals (of a feature set), not both.")
            cohort = self._load(features or PLAIN)
            return diagnose(cohort, inputs_of(cohort, signals or WHOLE_SET))
        registry = Registry.open(self.warehouse)
        if model is None:
            model = registry.only_name(", or signals")
        version = model if isinstance(model, ModelVersion) else registry.resolve(model)
        manifest = version.manifest
        diagnosis = diagnose(
            self._load(self.warehouse.catalog.name_of(manifest.trained_on.feature_set)),
            manifest.signals,
            intercept=not manifest.through_origin,
        )
        return dataclasses.replace(diagnosis, remark=manifest.line_remark)

    def _load(self, feature_set: str) -> "Cohort":

        from fleet_slip.grams.cohort import load_cohort

        return load_cohort(self.warehouse, self.predicate, feature_set)


@dataclass(frozen=True)
class FleetModels:
    """The published models of a data root; see `Fleet.models`.

    A reference is `NAME@VERSION`, `NAME@ALIAS`, or `NAME` for the champion. None means the only
    published model. Calls that take a reference also take a `ModelVersion`. They raise
    `QuestionError` for an unknown reference, `StorageError` for a damaged version, and
    `RefusedError` for a version without a required signature.
    """

    warehouse: "Warehouse"

    @property
    def registry(self) -> Registry:
        """The registry that stores the versions and aliases."""
        return Registry.open(self.warehouse)

    def get(self, model: str | ModelVersion | None = None) -> ModelVersion:
        """Return the version of a reference; a version is returned as it is."""
        return model if isinstance(model, ModelVersion) else self.registry.resolve(model)

    def versions(self, name: str | None = None) -> "pa.Table":
        """List published versions, as the view `models` does.

        Parameters
        ----------
        name
            Name of a model. None means all models.

        Returns
        -------
        pyarrow.Table
            One row per version. `trained_on_forgotten` is true if a training drive of the version
            was erased since.
        """
        from fleet_slip.operations.forget import marked_models

        self.warehouse.require()
        if name is not None:
            self.registry.require(name)
        table = self.registry.as_table(name)
        marked = marked_models(self.warehouse)
        pairs = zip(table["name"].to_pylist(), table["version"].to_pylist(), strict=True)
        return table.append_column(
            "trained_on_forgotten", [[f"{name}@{version}" in marked for name, version in pairs]]
        )

    @record_call
    def publish(
        self,
        name: str,
        choice: "Selection | FleetCohort | None" = None,
        *,
        force: bool = False,
        candidate: bool = False,
        with_filter: str | VehicleMeasures | None = None,
    ) -> "Publication":
        """Publish the winner of a selection as the next version of a model, and its champion.

        Parameters
        ----------
        name
            Name of the model, such as `sideslip`.
        choice
            The result of `FleetCohort.select`. Or a cohort, None for the cohort of the current
            champion: the model is then selected again with the options of its champion.
        force
            Publish even if the winner is worse than the champion.
        candidate
            Publish as a candidate, which becomes champion by `promote`. A winner also becomes a
            candidate while the champion is pinned.
        with_filter
            A car, as in `FleetEvaluation.evaluate_measured`. The model is combined with an extended
            Kalman filter in it, which is identified from the drives, where that is better in
            cross-validation. `none`: without a filter. Default: as the champion.

        Raises
        ------
        RefusedError
            If the winner is worse than the champion on the same cohort and folds, its course label
            is delayed or wrong, or the first measured drives contradict any car.
        UsageError
            If the name is invalid.
        FleetSlipError
            As `FleetCohort.select`.
        """
        from fleet_slip.models.publish import publish_challenger

        return self._challenge(
            publish_challenger, name, choice, with_filter, force=force, candidate=candidate
        )

    def preview(
        self,
        name: str,
        choice: "Selection | FleetCohort | None" = None,
        *,
        with_filter: str | VehicleMeasures | None = None,
        **options: bool,
    ) -> "DryRun":
        """Return what `publish` with these arguments would do, also a refusal; write nothing."""
        from fleet_slip.models.publish import DryRun, would_publish

        try:
            return self._challenge(would_publish, name, choice, with_filter, **options)
        except RefusedError as error:
            return DryRun(name, False, str(error), refused=True)

    def _challenge(
        self,
        publish: Callable[..., T],
        name: str,
        choice: "Selection | FleetCohort | None",
        with_filter: str | VehicleMeasures | None,
        *,
        force: bool = False,
        candidate: bool = False,
    ) -> T:
        """Build the challenger of a choice and publish it, or return what would be published."""
        from fleet_slip.models.publish import build_challenger

        options = {"force": force, "candidate": candidate}
        registry, selection = self.registry, self._selection(name, choice)
        manifest = build_challenger(self.warehouse, registry, selection, name, **options)
        manifest = self._with_filter(manifest, selection, with_filter)
        return publish(registry, manifest, selection, **options)

    def _with_filter(
        self,
        manifest: Manifest,
        selection: "Selection",
        car: str | VehicleMeasures | None,
    ) -> Manifest:
        """Combine a model with a filter in a car, by default the champion's."""
        champion = self.registry.champion(manifest.name)
        if car is None and champion and champion.manifest.combination:
            car = champion.manifest.combination.measures
        if car in (None, "none"):
            return manifest
        from fleet_slip.evaluation.filter_column import with_filter

        measures = load_measures(car, self.warehouse.configs) if isinstance(car, str) else car
        with open_workers(self.warehouse.root, None) as executor:
            return with_filter(self.warehouse, manifest, selection, measures, executor)

    def _selection(self, name: str, choice: "Selection | FleetCohort | None") -> "Selection":
        """Return a selection, by the recipe of the model if none is given."""
        from fleet_slip.models.publish import recipe_for
        from fleet_slip.models.request import SelectionRequest

        require_model_name(name)
        if choice is not None and not isinstance(choice, FleetCohort):
            return choice
        predicate = choice.predicate if choice else None
        recipe = recipe_for(self.registry, name, SelectionRequest(), predicate)
        drives = FleetCohort(self.warehouse, recipe.cohort, bool(choice and choice.include_faulty))
        return drives.select(recipe.request)

    @record_call
    def promote(self, reference: str, alias: str = CHAMPION) -> ModelVersion:
        """Point an alias, by default `champion`, at a version; return the version.

        Raises
        ------
        UsageError
            If the alias is no valid name.
        """
        require_model_name(alias)
        version = self.get(reference)
        self.registry.promote(version.manifest.name, version.version, alias)
        return version

    @record_call
    def rollback(self, name: str, alias: str = CHAMPION) -> ModelVersion:
        """Point an alias at its previous version and pin it there; return the version.

        Raises
        ------
        UsageError
            If `name` has a version or alias.
        RefusedError
            If the alias never pointed at another version.
        """
        require_model_name(name)
        self.registry.require(name)
        return self.registry.load(name, self.registry.rollback(name, alias))

    @record_call
    def pin(self, name: str, alias: str = CHAMPION) -> ModelVersion:
        """Keep an alias at its version until `promote` or `unpin`; return the version."""
        return self.registry.load(name, self.registry.hold(name, alias, "pin"))

    @record_call
    def unpin(self, name: str, alias: str = CHAMPION) -> ModelVersion:
        """Let publications move an alias again; return its version."""
        return self.registry.load(name, self.registry.hold(name, alias, "unpin"))

    def diff(self, first: str | ModelVersion, second: str | ModelVersion) -> Difference:
        """Compare the manifests and training drives of two versions."""
        return compare_versions(self.registry, self.get(first), self.get(second))

    def estimator(
        self, model: str | ModelVersion, car: Mapping[str, Any] | None = None
    ) -> "Estimator":
        """Return a version as an estimator that takes one sample at a time, as a car does.

        Parameters
        ----------
        model
            A reference or a version.
        car
            Constants of the car by name, in SI units: drive columns such as `mass_kg`, and
            parameters of `FleetMaintenance.calibrate`.

        Raises
        ------
        InputError
            If `car` has a constant that the version does not use.
        """
        from fleet_slip.export.stepping import Estimator

        version = self.get(model)
        return Estimator(version.catalog, version.manifest, car)

    def export(
        self,
        model: str | ModelVersion | None,
        to: "Target",
        output: Path = Path(),
        *,
        with_gram: bool = False,
    ) -> list[Path]:
        """Export a version as a program.

        Exports contain the checksum of the version, the hash of its training drives, and synthetic
        test vectors. They contain no logged data.

        Parameters
        ----------
        model
            A reference or a version.
        to
            `c`, `sql`, `onnx`, `fmu`, `dbc` or `json`.
        output
            Folder to write into. Files of the same names are replaced.
        with_gram
            With `c`: also export the code that computes Gram rows on board.

        Returns
        -------
        list of Path
            The files that were written.

        Raises
        ------
        RefusedError
            If the error of the angle has no bound, or the scales of the counts changed since.
        UsageError
            If there is no such target.
        ConfigError
            If the target needs something that the configs lack.
        """
        from fleet_slip.export.files import export_files

        folder = LocalFolder(output)
        files = export_files(self.get(model), self.warehouse, to, with_gram=with_gram)
        for name, content in files.items():
            folder.put(name, content)
        return [output / name for name in files]

    def predict(
        self,
        model: str | ModelVersion | None,
        files: "Iterable[Path | str] | Path | str",
        mapping: "str | LogMapping",
        output: Path,
        *,
        replace: bool = False,
    ) -> "Predictions":
        """Predict the side-slip angle of log files, beside the reference where they have one.

        The files are read like those of `Fleet.ingest`, and not stored.

        Parameters
        ----------
        model
            A reference or a version.
        files
            Log files, folders at any depth, or patterns.
        mapping
            The mapping of columns, units and axes: a name, the path of a TOML file, or a `Mapping`.
        output
            File to write, `.parquet`, `.csv` or `.mf4`: `drive_id`, `time_s` since the drive began,
            `sideslip_estimate_deg` and `sideslip_reference_deg`. An MDF file has a channel group
            for each drive.
        replace
            Replace an existing file.

        Raises
        ------
        UsageError
            If the output has another suffix, or exists.
        InputError
            If a file cannot be read.
        DataError
            If the logs lack a signal of the model.
        """
        from fleet_slip.ingest.log_files import find_logs
        from fleet_slip.ingest.mapping import load_mapping
        from fleet_slip.models.log_predictions import predict_logs

        if isinstance(mapping, str):
            mapping = load_mapping(mapping, self.warehouse.catalog)
        logs = find_logs([files] if isinstance(files, Path | str) else list(files), mapping)
        return predict_logs(self.warehouse, self.get(model), logs, mapping, output, replace=replace)

    def log_to_mlflow(self, model: str | ModelVersion, uri: str) -> str:
        """Register a version in an MLflow server, once, as a pyfunc model.

        Parameters
        ----------
        model
            A reference or a version.
        uri
            URI of the MLflow server, without a password.

        Returns
        -------
        str
            The version number in MLflow.

        Raises
        ------
        ConfigError
            If MLflow is not installed.
        UsageError
            If the URI has a password.
        StorageError
            If the server does not accept the model.
        """
        from fleet_slip.export.files import log_version

        return log_version(self.get(model), self.warehouse, uri)
