"""The part of a `Fleet` that judges models: scores, evaluations, the report, pages of drives."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_slip.api.calls import ShowProgress, count_from_start, open_workers, record_call
from fleet_slip.api.published_models import PublishedModels
from fleet_slip.catalogue.sources import ALL_DRIVES, TRAINING_DRIVES
from fleet_slip.errors import UsageError
from fleet_slip.extras import needed
from fleet_slip.models.model_version import ModelVersion

if TYPE_CHECKING:
    from fleet_slip.comparison.evaluation.blind import BlindRow
    from fleet_slip.comparison.report.page import Written
    from fleet_slip.files.documents import Document
    from fleet_slip.models.estimates.score import Score
    from fleet_slip.monitoring.examined import Examined
    from fleet_slip.warehouse.condition import Condition


class JudgedModels(PublishedModels):
    """How good published models are. A model is given as `PublishedModels` has it."""

    def score(
        self,
        model: str | ModelVersion | None = None,
        cohort: str | None = None,
        *,
        unexamined: bool = False,
    ) -> "Score":
        """Evaluate a model on the rows of a cohort; angles are in degrees.

        By default on all drives that it was not trained on, or all if there are no others. Drives
        that may train no model are left out as in `FleetCohort.select`. Raises `DataError` if no
        row has the model's signals, `QuestionError` for an invalid condition, and what `model`
        raises.
        """
        from fleet_slip.models.estimates.score import score
        from fleet_slip.models.seen_drives import find_seen

        manifest = self.resolve(model).manifest
        rows, examined = self.scored_rows(cohort, unexamined=unexamined)
        with examined.explaining():
            seen = find_seen(self.warehouse, self.registry(), manifest, rows)
            found = score(self.warehouse, manifest, rows if cohort else seen.others)
        without = 0 if cohort or seen.trained == seen.drives else seen.trained or 0
        return replace(
            found,
            drives=seen.drives,
            drives_trained=seen.trained,
            drives_left_out=without,
            examined=str(examined),
        )

    def scored_rows(
        self, cohort: str | None = None, *, unexamined: bool = False
    ) -> "tuple[Condition, Examined]":
        """Return the rows of a cohort without drives that are not in order, and which these are."""
        from fleet_slip.models.estimates.score import cohort_of_rows
        from fleet_slip.monitoring.examined import Examined, leave_out_faulty

        asked = ALL_DRIVES if cohort is None else cohort
        rows = cohort_of_rows(asked)
        if unexamined:
            return rows, Examined(asked)
        examined = leave_out_faulty(self.warehouse, asked)
        return replace(rows, sql=cohort_of_rows(examined.cohort).sql), examined

    @record_call
    def evaluate(
        self,
        model: str | ModelVersion | None = None,
        others: Sequence[str | ModelVersion] = (),
        *,
        scenarios: Sequence[str] = (),
        threads: int | None = None,
        progress: ShowProgress | None = None,
    ) -> "Document":
        """Evaluate models on the paper's test drives and on others; simulate those missing.

        Models of Table I are fitted on the cohort of each and evaluated beside it. `scenarios` are
        names or paths, by default all that ship. Progress is in simulated rows. Returns the
        document kept below `evaluations/`. Raises `ConfigError` for an invalid scenario,
        `RefusedError` for one that changed since it was simulated, `DataError`, and what `model`
        raises.
        """
        from fleet_slip.comparison.evaluation.evaluate import evaluate, evaluations_of, keep
        from fleet_slip.comparison.evaluation.scenario_runs import simulate_scenarios
        from fleet_slip.files.documents import Document
        from fleet_slip.simulation.scenario import load_scenario, shipped_scenarios

        chosen = tuple(map(load_scenario, scenarios)) if scenarios else shipped_scenarios()
        first, *rest = [self.resolve(one) for one in (model, *others)]
        with open_workers(self.root, threads) as executor:
            told = count_from_start(progress)
            simulate_scenarios(self.warehouse, chosen, executor, told)
            found = evaluate(self.warehouse, chosen, first, rest, executor)
        content = found.as_dict()
        kept = keep(evaluations_of(self.warehouse), content)
        return Document(kept.number, content, kept.sha256)

    @record_call
    def evaluate_measured(
        self,
        model: str | ModelVersion | None = None,
        cohort: str = TRAINING_DRIVES,
        others: Sequence[str | ModelVersion] = (),
        *,
        vehicle: str | None = None,
        threads: int | None = None,
    ) -> "Document":
        """Evaluate models on measured drives with a label, beside Table I and filters.

        What is fitted or tuned never saw what it is judged by: a quarter of the drives after the
        other, or of their time, is left out. `vehicle` names the car's file, of which mass and
        geometry suffice for a car that is identified; without it no filter competes, unless a file
        ships for the drives' class. Returns the document kept below `evaluations/measured/`.
        Raises `DataError` without a label, `ConfigError` for an unknown
        car, and what `model` raises.
        """
        from fleet_slip.comparison.evaluation.evaluate import keep
        from fleet_slip.comparison.evaluation.own_car import evaluate_own_car, own_car_evaluations
        from fleet_slip.files.documents import Document

        versions = [self.resolve(one) for one in (model, *others)]
        with open_workers(self.root, threads) as executor:
            found = evaluate_own_car(self.warehouse, versions, cohort, vehicle, executor)
        content = found.as_dict()
        kept = keep(own_car_evaluations(self.warehouse), content)
        return Document(kept.number, content, kept.sha256)

    def evaluate_blind(
        self,
        model: str | ModelVersion | None = None,
        others: Sequence[str | ModelVersion] = (),
        *,
        threads: int | None = None,
    ) -> "tuple[BlindRow, ...]":
        """Judge models, and all that `evaluate` trains beside them, on drives of the first.

        Roads, cars, weather and noise are drawn from its version's hash, unknown before it was
        published (`configs/blind.toml`). Nothing is written. Returns figures over all drives, by
        class of road, by weather and by drive. Raises as `evaluate`.
        """
        from fleet_slip.comparison.evaluation.blind import judge_blindly
        from fleet_slip.comparison.evaluation.evaluate import train_competitors

        first, *rest = [self.resolve(one) for one in (model, *others)]
        with open_workers(self.root, threads) as executor:
            trained = train_competitors(self.warehouse, first, rest, executor)
        return judge_blindly(first.sha256, trained.estimators)

    def report(
        self, model: str | ModelVersion | None = None, output: Path | None = None
    ) -> "Written":
        """Write one page that lays our figures beside the paper's, from the latest evaluation.

        `output` is a folder, by default `report` in the root. Raises `DataError` without an
        evaluation on today's data, and what `model` raises.
        """
        from fleet_slip.files.local_folder import LocalFolder

        with needed("report", "the report"):
            from fleet_slip.comparison.report.page import write_report

        folder = LocalFolder(output) if output else self.root / "report"
        return write_report(self.warehouse, self.resolve(model), folder)

    @record_call
    def watch(
        self,
        what: str,
        model: str | ModelVersion | None,
        output: Path,
        *,
        from_s: float = 0.0,
        until_s: float | None = None,
        threads: int | None = None,
    ) -> Path:
        """Write a drive as a page that plays, `.html`; return the file.

        `what` is a scenario's name or path, simulated if missing, or a drive of the logs, shown
        from `from_s` until `until_s`. Raises `UsageError` for another suffix or an empty part,
        `QuestionError` for an unknown drive, `ExtraError` without the extra `watch`, and what
        `model` raises.
        """
        with needed("watch", "a page of a drive"):
            from fleet_slip.comparison.watch.drive_frames import drive_frames, is_scenario
            from fleet_slip.comparison.watch.playing import write_page
        if output.suffix != ".html":
            raise UsageError(f"{output}: a drive is shown as a page, which ends with .html.")
        version = self.resolve(model)
        if is_scenario(what):
            from fleet_slip.comparison.watch.scenario_frames import scenario_frames

            with open_workers(self.root, threads) as executor:
                frames = scenario_frames(self.warehouse, what, version, executor)
        else:
            frames = drive_frames(self.warehouse, what, version)
        write_page(frames.part(from_s, until_s), output)
        return output
