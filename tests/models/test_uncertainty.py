"""Drawing the drives again."""

from fractions import Fraction

import numpy as np
import pytest

from fleet_slip.errors import QuestionError
from fleet_slip.grams.folding import Folding, assign_folds
from fleet_slip.models.request import SelectionRequest
from fleet_slip.models.select import estimate_uncertainty
from fleet_slip.regression.drives import ClusterUnit
from fleet_slip.regression.folds import CrossValidation, cross_validate_inputs
from tests.support.cohorts import INPUTS, LABEL, Driven, cohort_of, driven, rows_of

FIVE = Folding(by="drive", count=5)
UNIT = dict.fromkeys([*INPUTS, LABEL], Fraction(1))


def validated(drives: list[Driven]) -> CrossValidation:
    return cross_validate_inputs("m", cohort_of(drives).folds("drive", 5), INPUTS, LABEL, UNIT)


def test_the_interval_holds_the_figure_and_narrows_with_more_drives() -> None:
    widths = []
    for count in (8, 80):
        drives = driven(1, (0.1, 0.2, 0.1, 0.05), drives=count, noise=150)
        model = validated(drives)
        found = estimate_uncertainty(cohort_of(drives), model, FIVE, 400, SelectionRequest())
        assert found.interval.low < model.correlation < found.interval.high
        assert (found.interval.level, found.interval.replicates) == (0.95, 400)
        widths.append(found.interval.high - found.interval.low)
    assert widths[0] > 2 * widths[1]


@pytest.mark.parametrize("cluster", ["drive", "vehicle"])
def test_the_interval_is_that_of_drawing_clusters_by_hand(cluster: ClusterUnit) -> None:
    """Predictions of each drive by the model that has not seen its fold; whole drives, or cars."""
    drives = driven(2, (0.1, 0.2, 0.1, 0.05), drives=20, noise=150)
    cohort = cohort_of(drives)
    asked = SelectionRequest(cluster=cluster)
    found = estimate_uncertainty(cohort, validated(drives), FIVE, 1000, asked)
    assert found.drawn == cluster
    assignment = assign_folds([one.drive for one in drives], "drive", 5).fold
    estimates = []
    for one, mine in zip(drives, assignment, strict=True):
        rest = rows_of([d for d, f in zip(drives, assignment, strict=True) if f != mine])
        x = np.column_stack([np.ones(len(rest)), rest[:, :-1]]).astype(float)
        b = np.linalg.lstsq(x, rest[:, -1].astype(float), rcond=None)[0]
        estimates.append((b[0] + one.counts[:, :-1] @ b[1:], one.counts[:, -1]))
    owners = cohort.drives[f"{cluster}_id"].to_pylist()
    members = [[i for i, one in enumerate(owners) if one == name] for name in sorted(set(owners))]
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(1000):
        clusters = rng.integers(0, len(members), len(members))
        at = [i for number in clusters for i in members[number]]
        p, y = (np.concatenate([estimates[i][k] for i in at]) for k in (0, 1))
        drawn.append(np.corrcoef(p, y)[0, 1])
    low, high = np.percentile(drawn, [2.5, 97.5])
    spread = np.std(drawn)
    assert found.interval.low == pytest.approx(low, abs=spread / 3)
    assert found.interval.high == pytest.approx(high, abs=spread / 3)


def test_rows_are_no_drives_to_draw() -> None:
    drives = driven(4, (0.1, 0.2, 0.1, 0.05))
    rows = Folding(by="row", count=5)
    with pytest.raises(QuestionError, match="no drives to hold out"):
        estimate_uncertainty(cohort_of(drives), validated(drives), rows, 100, SelectionRequest())
