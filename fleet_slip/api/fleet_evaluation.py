"""Accuracy of published models: scores, evaluations, reports and pages of drives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_slip.api import calls
from fleet_slip.api.fleet_models import FleetModels
from fleet_slip.catalog.signals import ALL_DRIVES, TRAINING_DRIVES
from fleet_slip.errors import UsageError
from fleet_slip.evaluation.evaluated_drives import simulate_scenarios
from fleet_slip.evaluation.filters import read_tuning_drives
from fleet_slip.evaluation.identify import IdentifiedVehicle, identify_held_out
from fleet_slip.evaluation.measured_evaluation import evaluate_measured
from fleet_slip.evaluation.scenario_evaluation import evaluate_simulated
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.registry import ModelVersion
from fleet_slip.models.score import Score, cohort_of_rows, find_training_overlap, score
from fleet_slip.operations.sensor_screen import SensorScreen, screen_computed_drives
from fleet_slip.simulation.scenario import load_scenario, load_scenarios
from fleet_slip.storage.local import LocalFolder
from fleet_slip.vehicle.parameters import VehicleMeasures, load_car, load_measures

if TYPE_CHECKING:
    from fleet_slip.evaluation.evaluation_document import Evaluation
    from fleet_slip.evaluation.report import WrittenReport
    from fleet_slip.warehouse.warehouse import Warehouse

WATCH_PAGE = Path("watch.html")


@dataclass(frozen=True)
class FleetEvaluation:
    """Evaluation of the published models of a data root; see `Fleet.evaluation`.

    Models are references or versions, as in `FleetModels`, with the same errors.
    """

    warehouse: "Warehouse"

    @property
    def _models(self) -> FleetModels:
        return FleetModels(self.warehouse)

    def _screen(self, cohort: str, include_faulty: bool) -> SensorScreen:
        if include_faulty:
            return SensorScreen(cohort)
        return screen_computed_drives(self.warehouse, cohort)

    def score(
        self,
        model: str | ModelVersion | None = None,
        cohort: str | None = None,
        *,
        include_faulty: bool = False,
    ) -> Score:
        """Evaluate a model on the log rows of a cohort; angles are in degrees.

        Parameters
        ----------
        model
            A reference or a version.
        cohort
            SQL predicate on the view `drives`. Default: all drives that the model was not trained
            on, or all drives if there are no others.
        include_faulty
            Include drives with faulty sensors.

        Raises
        ------
        DataError
            If no row has the signals of the model.
        QuestionError
            If the predicate is invalid.
        """
        version = self._models.get(model)
        predicate = ALL_DRIVES if cohort is None else cohort
        signals = self.warehouse.catalog.signals
        rows = cohort_of_rows(signals, predicate)
        examined = self._screen(predicate, include_faulty)
        rows = replace(rows, sql=cohort_of_rows(signals, examined.cohort).sql)
        overlap = find_training_overlap(
            self.warehouse, self._models.registry, version.manifest, rows
        )
        result = score(self.warehouse, version.manifest, rows if cohort else overlap.unseen)
        all_seen = overlap.trained == overlap.drives
        trained_cohort = cohort or version.manifest.trained_on.cohort
        return replace(
            result,
            drives=overlap.drives,
            drives_trained=overlap.trained,
            drives_left_out=0 if cohort or all_seen else overlap.trained,
            examined=str(examined),
            model=version.reference,
            cohort=predicate,
            measured_cohort=trained_cohort if overlap.measured else "",
        )

    @calls.record_call
    def evaluate(
        self,
        model: str | ModelVersion | None = None,
        challengers: Sequence[str | ModelVersion] = (),
        *,
        scenarios: Sequence[str] = (),
        threads: int | None = None,
        progress: calls.ShowProgress | None = None,
    ) -> "Evaluation":
        """Evaluate models on simulated test drives: those of the paper, and others.

        The models of the paper's Table I are fitted on the cohort of each model and evaluated
        beside it. The document is stored in `evaluations/` of the data root.

        Parameters
        ----------
        model
            A reference or a version.
        challengers
            Other models to compare with it.
        scenarios
            Scenarios of `configs/scenarios`, or TOML files. Default: all. Missing ones are
            simulated.
        threads
            Threads. None means one per core.
        progress
            Called with the simulated rows so far and in total.

        Raises
        ------
        ConfigError
            If a scenario is invalid.
        RefusedError
            If a scenario changed since it was simulated.
        DataError
            If the models cannot be compared.
        """
        from fleet_slip.evaluation.evaluation_document import evaluations_of, store_evaluation

        configs = self.warehouse.configs
        chosen = tuple(load_scenario(name, configs) for name in scenarios)
        chosen = chosen or load_scenarios(configs)
        first, *rivals = self._versions(model, challengers)
        with calls.open_workers(self.warehouse.root, threads) as executor:
            simulate_scenarios(self.warehouse, chosen, executor, calls.total_progress(progress))
            content = evaluate_simulated(self.warehouse, chosen, first, rivals, executor)
        return store_evaluation(evaluations_of(self.warehouse), content)

    @calls.record_call
    def evaluate_measured(
        self,
        model: str | ModelVersion | None = None,
        cohort: str = TRAINING_DRIVES,
        challengers: Sequence[str | ModelVersion] = (),
        *,
        vehicle: str | VehicleMeasures | None = None,
        include_faulty: bool = False,
        threads: int | None = None,
    ) -> "Evaluation":
        """Evaluate models on measured drives with a label, beside Table I and filters.

        Everything is selected, fitted, tuned and identified without the drives that it is evaluated
        on. Each drive is left out in turn, or each quarter of the time of one or two drives, and
        each kind of driving. The document is stored in `evaluations/measured/` of the data root.

        Parameters
        ----------
        model, challengers, threads
            As in `evaluate`.
        cohort
            SQL predicate on the view `drives`.
        vehicle
            The car, for filters: a vehicle of `configs/vehicles`, a TOML file of a vehicle or of
            measured data (`mass_kg`, `front_axle_m`, `rear_axle_m`), or `VehicleMeasures`. Without
            it no filter is evaluated, unless a file ships for the class of the drives.
        include_faulty
            Include drives with faulty sensors, which `FleetModels.publish` leaves out.

        Raises
        ------
        DataError
            If the drives have no label.
        ConfigError
            If there is no such vehicle, or its data are impossible for a car.
        """
        from fleet_slip.evaluation.evaluation_document import evaluations_of, store_evaluation

        versions = self._versions(model, challengers)
        car = load_car(vehicle, self.warehouse.configs) if isinstance(vehicle, str) else vehicle
        screen = self._screen(cohort, include_faulty)
        with calls.open_workers(self.warehouse.root, threads) as executor:
            content = evaluate_measured(self.warehouse, versions, screen.cohort, car, executor)
        content |= {"cohort": cohort, **({"examined": str(screen)} if str(screen) else {})}
        return store_evaluation(evaluations_of(self.warehouse, "measured"), content)

    def evaluate_blind(
        self,
        model: str | ModelVersion | None = None,
        challengers: Sequence[str | ModelVersion] = (),
        *,
        threads: int | None = None,
    ) -> "Evaluation":
        """Evaluate models on random test drives that depend on the version of the first.

        Roads, cars, weather and noise are drawn from the hash of the version, so they were unknown
        before it was published (`configs/blind.toml`). Nothing is written. Arguments, result and
        errors are those of `evaluate`.
        """
        from fleet_slip.evaluation.evaluation_document import Evaluation

        first, *rivals = self._versions(model, challengers)
        with calls.open_workers(self.warehouse.root, threads) as executor:
            return Evaluation(evaluate_simulated(self.warehouse, None, first, rivals, executor))

    def identify(
        self,
        name: str,
        vehicle: str | VehicleMeasures,
        cohort: str = TRAINING_DRIVES,
        *,
        threads: int | None = None,
    ) -> IdentifiedVehicle:
        """Identify the tyres and the yaw inertia of a car from labelled drives.

        An extended Kalman filter in the car is fitted to the labels of up to 24 drives. The result
        contains its error on drives that were left out.

        Parameters
        ----------
        name
            Name of the car in the result.
        vehicle
            Its measured data, as in `evaluate_measured`.
        cohort
            SQL predicate on the view `drives`: the drives of the car.
        threads
            Threads. None means one per core.

        Raises
        ------
        DataError
            If the drives lack the label or a signal of the filter.
        ConfigError
            If there is no such vehicle, or its data are impossible for a car.
        UsageError
            If the name is invalid.
        """
        require_model_name(name)
        if isinstance(vehicle, str):
            vehicle = load_measures(vehicle, self.warehouse.configs)
        car = vehicle.model_copy(update={"name": name})
        rows = load_cohort(self.warehouse, cohort)
        drives = read_tuning_drives(self.warehouse, rows)
        with calls.open_workers(self.warehouse.root, threads) as executor:
            return identify_held_out(car, drives, executor)

    def report(
        self, model: str | ModelVersion | None = None, output: Path | None = None
    ) -> "WrittenReport":
        """Write a page that compares the latest evaluation with the figures of the paper.

        Parameters
        ----------
        model
            A reference or a version.
        output
            Folder to write into. Default: `report/` in the data root.

        Raises
        ------
        DataError
            If there is no evaluation of the model on the current data.
        """
        from fleet_slip.evaluation.report import write_report

        folder = LocalFolder(output) if output else self.warehouse.root / "report"
        return write_report(self.warehouse, self._models.get(model), folder)

    @calls.record_call
    def watch(
        self,
        drive: str,
        model: str | ModelVersion | None = None,
        output: Path = WATCH_PAGE,
        *,
        from_s: float = 0.0,
        until_s: float | None = None,
    ) -> Path:
        """Write an animation of a drive as one HTML page; return the file.

        Parameters
        ----------
        drive
            A scenario of `configs/scenarios`, the path of a scenario file, or a drive: its
            `drive_id`, its name, or the name of its file.
        model
            A reference or a version.
        output
            The page, `.html`.
        from_s, until_s
            First and last second of the drive. None means its end.

        Raises
        ------
        UsageError
            If the file has another suffix, or the interval is empty.
        QuestionError
            If there is no such drive.
        """
        from fleet_slip.evaluation.watch import drive_frames, write_page

        if output.suffix != ".html":
            raise UsageError(f"{output}: a drive is shown as a page. Choose a name in .html.")
        frames = drive_frames(self.warehouse, drive, self._models.get(model))
        write_page(frames.part(from_s, until_s), output)
        return output

    def _versions(
        self, model: str | ModelVersion | None, challengers: Sequence[str | ModelVersion]
    ) -> list[ModelVersion]:
        return [self._models.get(reference) for reference in (model, *challengers)]
