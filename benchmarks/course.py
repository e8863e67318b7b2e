"""What a model that the course taught is worth, beside one that the label taught.

    fleet-slip --root data simulate fleet_course --days 7
    for s in signals delay calibration fleet course_fleet; do
        fleet-slip --root data gram --features $s; done
    python -m benchmarks.course data --changes course_fleet --labels 5,2

Errors are those of the angle, against the reference sensor with its noise. The label teaches all
but the drives (of several cars: the cars) that are tested; the course teaches from all drives, and
what it taught has never seen the sensor. Of several cars a line more has the errors where the
course of each half of them taught, on the cars of the other half. With `--labels` so many cars keep
their label, and the course of the others stands beside them; those cars are not tested.
"""

import argparse
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

import fleet_slip
from fleet_slip.catalogue.features import features, input_scales
from fleet_slip.catalogue.signals import catalogue
from fleet_slip.catalogue.sources import TRAINING_DRIVES
from fleet_slip.grams.cohorts.folding import Folding, FoldKey
from fleet_slip.grams.cohorts.gram_cohort import Cohort, load_cohort
from fleet_slip.grams.cohorts.taught_cohort import taught_by
from fleet_slip.models.describe_winner import manifest_of, with_straight_intercept
from fleet_slip.models.estimates.counts_model import counts_model
from fleet_slip.models.estimates.score import score
from fleet_slip.models.straight_on import COLUMNS as OFFSETS
from fleet_slip.regression.exact.figures import error_sums
from fleet_slip.regression.exact.least_squares import fit
from fleet_slip.regression.validation.folds import hash_number
from fleet_slip.selection.answer_request import weigh
from fleet_slip.selection.model_list import CandidateModel, ModelList
from fleet_slip.selection.request import BOTH, SelectionRequest
from fleet_slip.selection.select_models import RequestedSelection

LABEL = catalogue().label
FIGURES = ("rmse_deg", "error_mean_deg", "error_std_deg")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root")
    parser.add_argument("--changes", default="course", help="feature set of changes")
    parser.add_argument("--cohort", default=TRAINING_DRIVES)
    parser.add_argument("--columns", help="separated by commas; by default what the search finds")
    parser.add_argument("--most", type=int, default=6, help="columns that a search finds")
    parser.add_argument("--labels", default="", help="numbers of cars, separated by commas")
    given = parser.parse_args()
    data = Data(fleet_slip.open(given.root), given.cohort, given.changes)
    columns = given.columns.split(",") if given.columns else None
    selection = data.fleet.cohort(given.cohort).select(
        label="course",
        features=given.changes,
        model=given.columns,
        search=None if columns else "exchange",
        most=None if columns else given.most,
    )
    inputs = selection.winner.model.signals
    show(taught="course", columns=len(inputs), **data.figures(selection))
    if data.by == "vehicle":
        show(taught="course of other cars", columns=len(inputs), **data.held_out(inputs))
    own = [name for name in OFFSETS if name in data.base.inputs]
    show(taught="label", columns=len(inputs), **data.by_label(inputs))
    show(taught="label, offsets of cars", columns=len(inputs), **data.by_label([*inputs, *own]))
    for number in filter(None, given.labels.split(",")):
        show(columns=len(inputs), **data.by_few(inputs, int(number)))


class Data:
    """A cohort as changes, and as what they are the changes of."""

    def __init__(self, fleet: fleet_slip.Fleet, cohort: str, changes: str) -> None:
        """Read the Gram rows."""
        base = features().feature_set(changes).of
        if base is None:
            raise SystemExit(f"{changes} is not the changes of another feature set.")
        self.fleet = fleet
        self.base = load_cohort(fleet.warehouse, cohort, base)
        self.course = load_cohort(fleet.warehouse, cohort, changes)
        self.cars = sorted(set(self.base.drives["vehicle_id"].to_pylist()), key=hash_number)
        self.by: FoldKey = "vehicle" if len(self.cars) > 1 else "drive"

    def figures(self, selection: RequestedSelection, without: Sequence[str] = ()) -> dict[str, Any]:
        """Return the errors of what a selection would publish, on all cars but some."""
        manifest = manifest_of(selection, "measured")
        manifest = with_straight_intercept(self.fleet.warehouse, manifest, selection)
        model = counts_model(manifest)
        cars = self.base.drives["vehicle_id"].to_pylist()
        tested = self.base.part(np.array([car not in without for car in cars]))
        if not set(model.signals) <= set(tested.inputs):  # then from the logs
            found = score(self.fleet.warehouse, manifest, self.base.condition.text)
            return told_of(found)
        learned = manifest.learned_from
        weight = str(learned.weight) if learned and learned.weight else None
        sums = error_sums(model, tested.serving(model.signals).table.total())
        told = told_of(sums.figures(input_scales()[LABEL]))
        return {**told, **({"weight": weight} if weight else {})}

    def held_out(self, inputs: Sequence[str]) -> dict[str, Any]:
        """Return the errors where the course of each half of the cars taught, on the other."""
        squares, means = [], []
        for half in (self.cars[::2], self.cars[1::2]):
            cars = ", ".join(f"'{car}'" for car in half)
            condition = f"({self.base.condition.text}) AND vehicle_id IN ({cars})"
            selection = self.fleet.cohort(condition).select(
                label="course", features=self.course.feature_set, model=",".join(inputs)
            )
            told = self.figures(selection, half)
            squares.append(told["rmse_deg"] ** 2)
            means.append(told["error_mean_deg"])
        rmse, mean = math.sqrt(sum(squares) / 2), sum(means) / 2
        std = math.sqrt(rmse**2 - mean**2)
        return dict(zip(FIGURES, (round(one, 4) for one in (rmse, mean, std)), strict=True))

    def by_label(self, inputs: Sequence[str]) -> dict[str, Any]:
        """Return the errors where the label taught, held out."""
        folds = self.base.folds(self.by, 5).serving(inputs, LABEL)
        parts = [error_sums(fit(a, inputs, LABEL).model, b) for a, b in folds.splits()]
        return told_of(sum(parts[1:], parts[0]).figures(input_scales()[LABEL]))

    def by_few(self, inputs: Sequence[str], number: int) -> dict[str, Any]:
        """Return the errors where so many cars have the label, and the course of others."""
        few = self.cars[:number]
        cars = self.base.drives["vehicle_id"].to_pylist()
        labelled: Cohort = self.base.part(np.array([car in few for car in cars]))
        one = CandidateModel(name="given", signals=tuple(inputs))
        models = ModelList(
            description="One model", label=BOTH, features=self.course.feature_set, model=(one,)
        )
        folds = Folding(by="vehicle" if number > 1 else "drive")
        cohort = taught_by(labelled, self.course, folds.by)
        selection = weigh(cohort, SelectionRequest(label=BOTH), models, folds)
        return {"taught": f"course, label of {number}", **self.figures(selection, few)}


def told_of(found: Any) -> dict[str, Any]:
    """Return errors in degrees."""
    return {name: round(getattr(found, name), 4) for name in FIGURES}


def show(**figures: Any) -> None:
    """Print a line."""
    print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
