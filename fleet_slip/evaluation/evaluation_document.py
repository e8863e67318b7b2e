"""Documents of evaluations: stored below evaluations/, and printed as tables."""

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from string import ascii_lowercase
from typing import Any

from fleet_slip.base import pluralize
from fleet_slip.errors import DataError
from fleet_slip.evaluation.evaluated_drives import TestDrive
from fleet_slip.evaluation.evaluator import ErrorStatistics, EvaluatedDrive
from fleet_slip.evaluation.filters import TrainedModels
from fleet_slip.models.registry import ModelVersion
from fleet_slip.pages.page import degrees
from fleet_slip.rendering import Answer, Part, Remark, TextTable
from fleet_slip.storage.documents import Document, DocumentFolder, checksum
from fleet_slip.warehouse.database import describe_cohort
from fleet_slip.warehouse.warehouse import Warehouse

BLIND_COLUMNS = 5
"""Estimators of the table that is printed first: published models, then the best of the others."""


@dataclass(frozen=True)
class Evaluation(Answer):
    """The document of an evaluation, and the number under which it is stored.

    Attributes
    ----------
    content
        Estimators and their errors, as `--json` prints them.
    number
        Number of the document. None for a blind evaluation, which is not stored.
    sha256
        Checksum of the content; empty for a blind evaluation.
    """

    DOCUMENT = "number? sha256? *content"

    content: Mapping[str, Any]
    number: int | None = None
    sha256: str = ""

    def parts(self, everything: bool = False) -> Iterator[Part]:
        """Yield the summary, or the errors of all estimators on every drive besides.

        Parameters
        ----------
        everything
            Include the table of every drive and estimator.
        """
        content, is_measured = self.content, "cohort" in self.content
        names = list(content["estimators"])
        if "scenarios" in content:
            drives, title = content["scenarios"], "Test drives: RMSE in deg"
            yield _ranking_table(content["ranking"])
            yield f"Pictures: fleet-slip report {shlex.quote(content['ranking']['estimator'])}"
        elif is_measured:
            drives, title = content["drives"], "RMSE in deg by drive"
            yield from _measured_tables(content)
        else:
            drives, title = content["drives"], "Blind drives: RMSE in deg against the exact angle"
            errors = {name: row["rmse_deg"] for name, row in drives[0]["results"].items()}
            names.sort(key=lambda name: ("@" not in name, errors[name] is None, errors[name]))
            if not everything:
                groups = [group for group in drives if group["drives"] > 1]
                columns = [name for name in names if "/" not in name]
                yield _error_table(title, groups, columns[:BLIND_COLUMNS])
        if everything:
            yield _error_table(f"\n{title}", drives, names)
        else:
            yield "Every drive and estimator: --all; as JSON: --json."
        if self.number:
            folder = "measured/" if is_measured else ""
            yield Remark(f"stored as evaluations/{folder}{self.number}.json")


def _error_table(
    title: str, drives: Sequence[Mapping[str, Any]], names: Sequence[str]
) -> TextTable:
    """Tabulate RMSE by drive and estimator, with the coverage unless it is 100 %."""
    headings = [name.replace("_", " ") for name in names]  # which a terminal can wrap

    def cell(statistics: Mapping[str, Any]) -> str:
        if statistics["rmse_deg"] is None:
            return "none"
        coverage = statistics["coverage"]
        return f"{statistics['rmse_deg']:.3f}" + ("" if coverage == 1 else f" ({coverage:.0%})")

    rows = (
        [
            drive["name"],
            f"{drive.get('truth', drive)['sideslip_std_deg']:.2f}",
            *(cell(drive["results"][name]) for name in names),
        ]
        for drive in drives
    )
    return TextTable(title, "|".join(["drive", "side-slip std", *headings]), rows)


def _ranking_table(ranking: Mapping[str, Any]) -> TextTable:
    """Tabulate the winner of each test drive."""
    coverage, model = ranking["least_coverage"], ranking["estimator"]
    return TextTable(
        f"\n{model} has the smallest RMSE on {ranking['won']} of {ranking['drives']} test drives, "
        f"and at most {ranking['close_ratio']:g} times the smallest on {ranking['close']} others.\n"
        f"Compared are estimators without GPS that cover {coverage:.0%} of the rows. Drives that "
        f"differ only in GPS count once. {model}/3 is model 3 of Table I, trained on the same "
        "cohort.",
        f"scenario|won by|RMSE deg|{model} deg|ratio",
        (standing for standing in ranking["standings"] if standing["same_as"] is None),
        "{scenario}|{winner}|{winner_rmse_deg:.3f}|{rmse_deg:.3f}|{ratio:.2f}",
        text_columns=2,
    )


def _measured_tables(content: Mapping[str, Any]) -> Iterator[Part]:
    """Tabulate statistics on measured drives, the best estimator first."""
    drives = pluralize(len(content["drives"]), "drive") + describe_cohort(content["cohort"])
    if examined := content.get("examined"):
        yield Remark(examined)
    yield from (Remark(f"assumed: {text}") for text in content.get("assumed", ()))
    is_time = content["parts_of"] == "time"
    held_out, unit = ("in quarters of their time", "quarter") if is_time else ("whole", "drive")
    labels = dict.fromkeys(row["told"] for row in content["estimators"].values())
    sources = dict(zip(labels, ascii_lowercase, strict=False))
    kinds = ", ".join(f"{kind['name']} ({len(kind['drives'])})" for kind in content["kinds"])
    yield TextTable(
        f"{drives}, held out {held_out}, in {content['parts']} folds",
        "estimator|source|RMSE deg|±|mean|std|correlation|rows|worst|kinds held out",
        (
            {
                **row,
                "name": name,
                "kinds": (row["kinds_left_out"] or {}).get("rmse_deg"),
                "source": sources[row["told"]],
            }
            for name, row in content["estimators"].items()
        ),
        "{name}|{source}|{rmse_deg:.3f}|{rmse_standard_error_deg:.3f}|{error_mean_deg:+.3f}|"
        "{error_std_deg:.3f}|{correlation:.3f}|{coverage:.0%}|{worst_drive_rmse_deg:.3f}|"
        "{kinds:.3f}",
        text_columns=2,
    )
    yield "source: " + "; ".join(f"{letter} {text}" for text, letter in sources.items()) + "."
    yield (
        f"±: standard error over {unit}s; worst: RMSE of the worst {unit}; rows: share of the rows "
        "with an estimate. All RMSEs are of the rows that all estimators have.\n"
        + (f"Kinds of driving: {kinds}." if kinds else "All drives are of one kind of driving.")
    )
    if content["vehicle"] is None:
        yield (
            "No filter was evaluated, because no vehicle is known. Give --vehicle, a "
            "file with mass_kg, front_axle_m and rear_axle_m, or a vehicle of configs/vehicles."
        )


def evaluations_of(warehouse: Warehouse, kind: str = "") -> DocumentFolder:
    """Return the folder of stored evaluations; kind `measured` for those on measured drives."""
    return DocumentFolder(warehouse.root, f"evaluations/{kind}" if kind else "evaluations")


def store_evaluation(documents: DocumentFolder, content: Mapping[str, Any]) -> Evaluation:
    """Append an evaluation unless the latest one is equal; return the stored one."""

    def attempt(newest: int) -> Document | None:
        if newest in documents.numbers():  # else its loss was accepted
            latest = documents.read(newest)
            if latest.sha256 == checksum(content):
                return latest
        return documents.create(newest + 1, content)

    return Evaluation(**vars(documents.after_newest(attempt)))


# A report about a stored evaluation, with drives and models that are computed again.

PAPER_CHOICE = "4"
"""The model of Table I that the paper compares with the Kalman filter."""

DRAWN_FILTERS = ("kalman", "kalman_tuned")

TOLERANCE = 1e-6
"""Relative difference below which two errors of the same estimates are equal."""


class NotEvaluatedError(LookupError):
    """The evaluation lacks a drive or an estimator, which the message names."""


@dataclass(frozen=True)
class ReportData:
    """Data of a report.

    Attributes
    ----------
    version
        The model version.
    document
        Its latest evaluation.
    trained
        Its cohort, and the models of Table I on it.
    runs
        Drives of the evaluation's scenarios with the estimates that figures show.
    """

    version: ModelVersion
    document: Document
    trained: TrainedModels
    runs: Mapping[str, EvaluatedDrive[TestDrive]]

    @property
    def estimators(self) -> Mapping[str, Mapping[str, Any]]:
        """Descriptions of the estimators, by name."""
        estimators: Mapping[str, Mapping[str, Any]] = self.document.content["estimators"]
        return estimators

    @cached_property
    def scenarios(self) -> Mapping[str, Mapping[str, Any]]:
        """Results of the scenarios, by name, in the document's order."""
        return {scenario["name"]: scenario for scenario in self.document.content["scenarios"]}

    @cached_property
    def models(self) -> Mapping[str, str]:
        """Estimator name of each model of Table I whose signals the cohort has."""
        return {
            about["table_one"]: name
            for name, about in self.estimators.items()
            if about["group"] == self.version.reference and "table_one" in about
        }

    @property
    def choice_number(self) -> str:
        """Number of the model that the paper chooses, or of the last one that could be trained."""
        numbers = list(self.models)
        return PAPER_CHOICE if PAPER_CHOICE in numbers else numbers[-1]

    @property
    def choice(self) -> str:
        """Estimator name of this model."""
        return self.models[self.choice_number]

    def statistics(
        self, scenario: str, estimator: str, side: str = "", section: str = ""
    ) -> ErrorStatistics | None:
        """Return the errors over a drive, or `inside` or `outside` of a section of it."""
        result = self.scenarios.get(scenario, {}).get("results", {}).get(estimator, {})
        if side:
            result = result.get(side, {}).get(section)
        names = ErrorStatistics.__dataclass_fields__
        return ErrorStatistics(**{name: result[name] for name in names}) if result else None

    def errors(self, scenario: str, estimator: str = "", side: str = "") -> Any:
        """Return the statistics of an estimator, by default the paper's choice; none is None.

        Side `inside` or `outside` restricts them to the unstable section, or to the others. Raises
        `NotEvaluatedError`.
        """
        name = estimator or self.choice
        statistics = self.statistics(scenario, name, side, "unstable")
        if statistics is None or None in vars(statistics).values():
            section = "unstable section of " if side else ""
            raise NotEvaluatedError(f"{name} on the {section}drive {scenario}")
        return statistics

    def rmse(self, scenario: str, estimator: str = "") -> str:
        """Return the RMSE of an estimator over a drive, in words. Raises as `errors`."""
        return degrees(self.errors(scenario, estimator).rmse_deg)

    def scenario(self, name: str) -> Any:
        """Return the document of a scenario. Raises `NotEvaluatedError`."""
        try:
            return self.scenarios[name]
        except KeyError:
            raise NotEvaluatedError(f"drive {name}") from None

    def unstable_s(self, name: str) -> list[tuple[float, float]]:
        """Return begin and end in s of the unstable stretches. Raises as `scenario`."""
        return [
            (stretch["from_s"], stretch["until_s"])
            for section in self.scenario(name)["sections"]
            if section["name"] == "unstable"
            for stretch in section["stretches"]
        ]

    @property
    def all_signals(self) -> tuple[str, ...]:
        """Signals of the last model of Table I."""
        return tuple(dict.fromkeys(self.trained.selection.models[-1].signals))

    def require_unchanged(self) -> None:
        """Raise `DataError` if today's models or drives differ from the evaluation's.

        All numbers of a report are of the same data.
        """
        bank = self.trained.bank()
        changed = [
            f"the cohort of {self.version.reference}"
            for name in self.models.values()
            for key in ("intercept", "coefficients")
            if name not in bank or bank[name][1][key] != self.estimators[name][key]
        ]
        for scenario, run in self.runs.items():
            for name, current in run.statistics.items():
                stored = self.statistics(scenario, name)
                before, now = stored and stored.rmse_deg, current.rmse_deg
                if before != now and not math.isclose(before or 0, now or 0, rel_tol=TOLERANCE):
                    changed.append(f"the drive of {scenario}, or {name},")
        if changed:
            raise DataError(
                f"{changed[0]} has changed since evaluation {self.document.number}. Run: "
                f"fleet-slip evaluate {self.version.reference}"
            )


def latest_evaluation(warehouse: Warehouse, version: ModelVersion) -> Document:
    """Return the latest evaluation of a model version. Raises `DataError` if there is none."""
    documents = evaluations_of(warehouse)
    for number in reversed(documents.numbers()):
        document = documents.read(number)
        first = next(iter(document.content["estimators"].values()))
        if first["group"] == version.reference:
            return document
    raise DataError(
        f"{version.reference} has not been evaluated. Run: fleet-slip evaluate {version.reference}"
    )
