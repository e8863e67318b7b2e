"""The part of a `Fleet` that publishes models and serves them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from typing_extensions import Doc

from fleet_slip.api.calls import (
    ALIAS,
    MODEL,
    UNEXAMINED,
    VERSION,
    CarMeasures,
    Rooted,
    ShowProgress,
    count_from_start,
    open_workers,
    record_call,
)
from fleet_slip.api.cohort import FleetCohort
from fleet_slip.catalog.drive_sources import ALL_DRIVES, TRAINING_DRIVES
from fleet_slip.errors import RefusedError, UsageError
from fleet_slip.export.program import Target
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.registry import CHAMPION, ModelVersion, Registry

if TYPE_CHECKING:
    import pyarrow as pa

    from fleet_slip.evaluation.evaluation_document import Evaluation
    from fleet_slip.evaluation.report import WrittenReport
    from fleet_slip.export.stepping import Estimator
    from fleet_slip.models.publish import DryRun, Publication
    from fleet_slip.models.registry import Difference
    from fleet_slip.models.score import Score
    from fleet_slip.models.select import Selection


class PublishedModels(Rooted):
    """Published models. A reference is `NAME@VERSION`, `NAME@ALIAS`, or `NAME` for its champion.

    None stands for the only model that there is.
    """

    def models(self, name: str | None = None) -> "pa.Table":
        """Return all published versions, or those of one model, as the view `models` has them.

        `trained_on_forgotten`: whether drives were forgotten since. Raises `QuestionError`,
        `StorageError`.
        """
        from fleet_slip.operations.marked_models import marked_models

        self.warehouse.require()
        registry = self.registry()
        if name is not None:
            registry.require(name)
        found = registry.as_table(name)
        marked = marked_models(self.warehouse)
        pairs = zip(found["name"].to_pylist(), found["version"].to_pylist(), strict=True)
        return found.append_column(
            "trained_on_forgotten", [[f"{name}@{version}" in marked for name, version in pairs]]
        )

    def model(self, model: Annotated[str | ModelVersion | None, MODEL] = None) -> ModelVersion:
        """Return the version that a reference names; a version is returned as it is.

        Raises `QuestionError` for an unknown one, `StorageError` for one that was changed, and
        `RefusedError` for one without a required signature.
        """
        return model if isinstance(model, ModelVersion) else self.registry().resolve(model)

    @record_call
    def publish(
        self,
        name: Annotated[str, Doc("Name of the model, such as sideslip.")],
        choice: "Selection | FleetCohort | None" = None,
        *,
        force: Annotated[bool, Doc("Publish even what is worse than the champion.")] = False,
        candidate: Annotated[
            bool, Doc("Publish as a candidate, which becomes champion by promote.")
        ] = False,
    ) -> "Publication":
        """Make a selection's winner the next version of a model, and its champion.

        `choice` is what `FleetCohort.select` returned; or a cohort, None for that of before, on
        which the model is trained as it was before, or from the usual list. A winner that is worse
        than the champion on the same cohort and folds needs `force`. A `candidate` waits for
        `promote`, and so does any winner while the champion is held.

        Raises `RefusedError` for a worse winner, a late or false course, or first measured drives
        that contradict any car; `UsageError` for an invalid name, and
        what `FleetCohort.select` raises.
        """
        from fleet_slip.models.publish import build_challenger, publish_challenger

        how = {"force": force, "candidate": candidate}
        registry, selection = self.registry(), self._chosen(name, choice)
        manifest = build_challenger(self.warehouse, registry, selection, name, **how)
        return publish_challenger(registry, manifest, selection, **how)

    def would_publish(
        self,
        name: str,
        choice: "Selection | FleetCohort | None" = None,
        *,
        force: bool = False,
        candidate: bool = False,
    ) -> "DryRun":
        """Tell what `publish` of the same would come to, a refusal too; nothing is written."""
        from fleet_slip.models.publish import DryRun, build_challenger, would_publish

        how = {"force": force, "candidate": candidate}
        registry = self.registry()
        try:
            selection = self._chosen(name, choice)
            manifest = build_challenger(self.warehouse, registry, selection, name, **how)
            return would_publish(registry, manifest, selection, **how)
        except RefusedError as error:
            return DryRun(name, False, str(error), refused=True)

    def _chosen(self, name: str, choice: "Selection | FleetCohort | None") -> "Selection":
        """Return a selection, made by the recipe of a model if none is given."""
        from fleet_slip.models.publish import recipe_for
        from fleet_slip.models.request import SelectionRequest

        require_model_name(name)
        if choice is not None and not isinstance(choice, FleetCohort):
            return choice
        predicate, include_faulty = (
            (choice.predicate, choice.include_faulty) if choice else (None, False)
        )
        recipe = recipe_for(self.registry(), name, SelectionRequest(), predicate)
        cohort = FleetCohort(self.warehouse, recipe.cohort, include_faulty)
        return cohort.select(**vars(recipe.request))

    @record_call
    def promote(
        self,
        reference: Annotated[
            str, Doc("NAME@VERSION to point the alias at; with `previous` NAME alone.")
        ],
        alias: Annotated[str, ALIAS] = CHAMPION,
        *,
        previous: Annotated[
            bool, Doc("Roll back to the version that the alias had before, and pin it.")
        ] = False,
    ) -> ModelVersion:
        """Point an alias at a version; return the version. Raises `UsageError`, and as `model`.

        With `previous`, raises `QuestionError`, and `RefusedError` if it never had another.
        """
        registry = self.registry()
        if previous:
            if "@" in reference:
                raise UsageError(
                    f"{reference}: with previous, give the model's name without a version."
                )
            registry.require(reference)
            return registry.load(reference, registry.rollback(reference, alias))
        require_model_name(alias)
        version = self.model(reference)
        registry.promote(version.manifest.name, version.version, alias)
        return version

    @record_call
    def pin(
        self,
        name: Annotated[str, Doc("Name of the model.")],
        alias: Annotated[str, ALIAS] = CHAMPION,
        *,
        off: Annotated[bool, Doc("Let publications move the alias again.")] = False,
    ) -> ModelVersion:
        """Keep an alias where it is until `promote` or `off`; return its version, as `model`."""
        registry = self.registry()
        return registry.load(name, registry.hold(name, alias, "unpin" if off else "pin"))

    def diff(
        self,
        one: Annotated[str | ModelVersion, VERSION],
        other: Annotated[str | ModelVersion, VERSION],
    ) -> "Difference":
        """Compare two versions by their manifests and their drives. Raises as `model`."""
        from fleet_slip.models.registry import compare_versions

        return compare_versions(self.registry(), self.model(one), self.model(other))

    def estimator(
        self, model: str | ModelVersion, car: Mapping[str, Any] | None = None
    ) -> "Estimator":
        """Return a version that estimates a drive sample by sample, as a car does.

        `car` is what the car knows of itself, by name: drive columns such as `mass_kg`, and numbers
        of `Fleet.calibrate`, in SI units. Raises `InputError` for what the version does not
        use, and what `export` and `model` raise.
        """
        from fleet_slip.export.stepping import Estimator

        version = self.model(model)
        return Estimator(version.catalog, version.manifest, car)

    def export(
        self,
        model: Annotated[str | ModelVersion | None, MODEL],
        to: Annotated[Target, Doc("What to export to.")],
        output: Annotated[
            Path, Doc("Folder to write into; files of the same names are replaced.")
        ] = Path(),
        *,
        with_gram: Annotated[
            bool, Doc("With C: also what counts Gram rows in the car, for ingest.")
        ] = False,
    ) -> list[Path]:
        """Export a version as a program into a folder; return the files.

        Exports carry the version's checksum, the hash of its drives, and checks of made-up inputs;
        no tick of a log. Raises `RefusedError` if the angle's error has no bound or counts mean
        something else now, `UsageError` for an unknown target, `ConfigError` without what it needs,
        and what `model` raises.
        """
        from fleet_slip.export.files import export_files
        from fleet_slip.storage.local import LocalFolder

        folder = LocalFolder(output)
        files = export_files(self.model(model), self.warehouse, to, with_gram=with_gram)
        for name, content in files.items():
            folder.put(name, content)
        return [output / name for name in files]

    def log_to_mlflow(self, model: str | ModelVersion, uri: str) -> str:
        """Log a version to an MLflow server and register it, once; return its number there.

        It is a pyfunc model with signature, input example, metrics and tags. Raises `ConfigError`
        without the library, `UsageError` for a password in the URI, `StorageError` if the server
        does not take it, and what `export` and `model` raise.
        """
        from fleet_slip.export.files import log_version

        return log_version(self.model(model), self.warehouse, uri)

    def registry(self) -> Registry:
        """Return the registry of models."""
        return Registry.of(self.warehouse)


# The part of a `Fleet` that judges models: scores, evaluations, the report, pages of drives.


WATCH_PAGE = Path("watch.html")


class JudgedModels(PublishedModels):
    """How good published models are. A model is given as `PublishedModels` has it."""

    def score(
        self,
        model: Annotated[str | ModelVersion | None, MODEL] = None,
        cohort: Annotated[
            str | None,
            Doc(
                "SQL predicate on the view drives. Default: what the model was not trained on, or "
                "all if there is nothing else."
            ),
        ] = None,
        *,
        include_faulty: Annotated[bool, UNEXAMINED] = False,
    ) -> "Score":
        """Evaluate a model on the rows of a cohort; angles are in degrees.

        By default on all drives that it was not trained on, or all if there are no others. Drives
        that may train no model are left out as in `FleetCohort.select`. Raises `DataError` if no
        row has the model's signals, `QuestionError` for an invalid predicate, and what `model`
        raises.
        """
        from fleet_slip.models.score import cohort_of_rows, find_seen, score
        from fleet_slip.operations.sensor_screen import SensorScreen, screen_computed_drives

        version = self.model(model)
        asked = ALL_DRIVES if cohort is None else cohort
        signals = self.warehouse.catalog.signals
        rows = cohort_of_rows(signals, asked)
        examined = (
            SensorScreen(asked) if include_faulty else screen_computed_drives(self.warehouse, asked)
        )
        rows = replace(rows, sql=cohort_of_rows(signals, examined.cohort).sql)
        with examined.explaining():
            seen = find_seen(self.warehouse, self.registry(), version.manifest, rows)
            found = score(self.warehouse, version.manifest, rows if cohort else seen.others)
        without = 0 if cohort or seen.trained == seen.drives else seen.trained
        return replace(
            found,
            drives=seen.drives,
            drives_trained=seen.trained,
            drives_left_out=without,
            examined=str(examined),
            model=version.reference,
            cohort=asked,
        )

    @record_call
    def evaluate(
        self,
        model: Annotated[str | ModelVersion | None, MODEL] = None,
        others: Annotated[
            Sequence[str | ModelVersion],
            Doc("Another model, to be compared with the first. May be repeated."),
        ] = (),
        *,
        scenarios: Annotated[
            Sequence[str],
            Doc("A scenario of configs/scenarios, or a TOML file. May be repeated. Default: all."),
        ] = (),
        threads: int | None = None,
        progress: ShowProgress | None = None,
    ) -> "Evaluation":
        """Evaluate models on the paper's test drives and on others; simulate those missing.

        Models of Table I are fitted on the cohort of each and evaluated beside it. Progress is in
        simulated rows. The document is kept below `evaluations/`. Raises `ConfigError` for an
        invalid scenario, `RefusedError` for one that changed since it was simulated, `DataError`,
        and what `model` raises.
        """
        from fleet_slip.evaluation.evaluation_document import evaluations_of, store_evaluation
        from fleet_slip.evaluation.scenario_evaluation import evaluate_scenarios
        from fleet_slip.evaluation.test_drives import simulate_scenarios
        from fleet_slip.simulation.scenario import load_scenario, load_scenarios

        configs = self.warehouse.configs
        chosen = tuple(load_scenario(name, configs) for name in scenarios)
        chosen = chosen or load_scenarios(configs)
        first, *rest = [self.model(one) for one in (model, *others)]
        with open_workers(self.root, threads) as executor:
            told = count_from_start(progress)
            simulate_scenarios(self.warehouse, chosen, executor, told)
            content = evaluate_scenarios(self.warehouse, chosen, first, rest, executor)
        return store_evaluation(evaluations_of(self.warehouse), content)

    @record_call
    def evaluate_measured(
        self,
        model: str | ModelVersion | None = None,
        cohort: str = TRAINING_DRIVES,
        others: Sequence[str | ModelVersion] = (),
        *,
        vehicle: Annotated[
            str | None, Doc("With `cohort`: the car's file, for filters; or its mass and axles.")
        ] = None,
        threads: int | None = None,
        **measured: Unpack[CarMeasures],
    ) -> "Evaluation":
        """Evaluate models on measured drives with a label, beside Table I and filters.

        What is chosen, fitted, tuned or identified never saw what it is judged by: each drive is
        left out in turn, or each quarter of the time of one or two, and each kind of driving.
        Without a `vehicle` or what was `measured` of it no filter competes, unless a file ships for
        the drives' class. Returns the document, kept below `evaluations/measured/`. Raises
        `DataError` without a label, `ConfigError` for an unknown car, `UsageError` for one that no
        car can be, and what `model` raises.
        """
        from fleet_slip.evaluation.evaluation_document import evaluations_of, store_evaluation
        from fleet_slip.evaluation.identify import VehicleMeasures, measures_of
        from fleet_slip.evaluation.measured_evaluation import evaluate_measured
        from fleet_slip.vehicle.parameters import VehicleParameters, load_vehicle

        versions = [self.model(one) for one in (model, *others)]
        car: VehicleParameters | VehicleMeasures | None = None
        if vehicle:
            car = load_vehicle(vehicle, self.warehouse.configs)
        if any(measured.values()):
            if car is not None:
                raise UsageError("give a vehicle file or measurements of the car, not both.")
            car = measures_of("measured", measured)
        with open_workers(self.root, threads) as executor:
            content = evaluate_measured(self.warehouse, versions, cohort, car, executor)
        return store_evaluation(evaluations_of(self.warehouse, "measured"), content)

    def evaluate_blind(
        self,
        model: str | ModelVersion | None = None,
        others: Sequence[str | ModelVersion] = (),
        *,
        threads: int | None = None,
    ) -> "Evaluation":
        """Evaluate models, and all that `evaluate` trains beside them, on drives of the first.

        Roads, cars, weather and noise are drawn from its version's hash, unknown before it was
        published (`configs/blind.toml`). Nothing is written. Returns a document as `evaluate`
        does: over all drives, by class of road, by weather and by drive. Raises as `evaluate`.
        """
        from fleet_slip.evaluation.evaluation_document import Evaluation
        from fleet_slip.evaluation.scenario_evaluation import evaluate_blind

        first, *rest = [self.model(one) for one in (model, *others)]
        with open_workers(self.root, threads) as executor:
            return Evaluation(evaluate_blind(self.warehouse, first, rest, executor))

    def report(
        self,
        model: Annotated[str | ModelVersion | None, MODEL] = None,
        output: Annotated[Path | None, Doc("Folder. Default: report/ in the data root.")] = None,
    ) -> "WrittenReport":
        """Write a page that compares the latest evaluation with the paper's figures.

        Raises `DataError` without an
        evaluation on today's data, and what `model` raises.
        """
        from fleet_slip.evaluation.report import write_report
        from fleet_slip.storage.local import LocalFolder

        folder = LocalFolder(output) if output else self.root / "report"
        return write_report(self.warehouse, self.model(model), folder)

    @record_call
    def watch(
        self,
        what: Annotated[
            str, Doc("A scenario of configs/scenarios, the path of one, or a drive of the logs.")
        ],
        model: Annotated[str | ModelVersion | None, MODEL] = None,
        output: Annotated[Path, Doc("The page, .html, which plays in a browser.")] = WATCH_PAGE,
        *,
        from_s: Annotated[float, Doc("First second that is shown.")] = 0.0,
        until_s: Annotated[float | None, Doc("Last second. Default: the last.")] = None,
    ) -> Path:
        """Write a drive as a page that plays; return the file.

        A scenario is simulated for it. Raises `UsageError` for another suffix or an empty part,
        `QuestionError` for an unknown drive, and what
        `model` raises.
        """
        from fleet_slip.evaluation.watch import (
            drive_frames,
            is_scenario,
            scenario_frames,
            write_page,
        )

        if output.suffix != ".html":
            raise UsageError(f"{output}: a drive is shown as a page, which ends with .html.")
        version = self.model(model)
        if is_scenario(what, self.warehouse.configs):
            frames = scenario_frames(what, version)
        else:
            frames = drive_frames(self.warehouse, what, version)
        write_page(frames.part(from_s, until_s), output)
        return output
