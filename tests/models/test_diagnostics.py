"""A model's fit examined: against the rows, and against a cohort with another law."""

from dataclasses import replace
from typing import cast

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.catalogue.features import input_scales
from fleet_slip.errors import QuestionError
from fleet_slip.models.diagnose import diagnose
from fleet_slip.regression.drives import ClusterUnit
from tests.support.cohorts import INPUTS, LABEL, cohort_of, driven, rows_of
from tests.support.counts import dense_fit
from tests.support.few_cars import by_rows, compared

COEFFICIENTS = (0.1, 0.4, 0.9, 0.2)


def test_figures_are_those_of_the_rows() -> None:
    drives = driven(1, COEFFICIENTS)
    found = diagnose(cohort_of(drives), INPUTS)
    rows = rows_of(drives).astype(float)
    b, rss = dense_fit(rows)
    scales = input_scales()
    units = [float(scales[LABEL] / scales[name]) for name in INPUTS]
    slopes = [estimate.value for estimate in found.naive.estimates[1:]]
    np.testing.assert_allclose(slopes, b[1:] * units, rtol=1e-9)
    assert [e.value for e in found.robust.estimates] == [e.value for e in found.naive.estimates]
    deviation = np.sqrt(rss / (len(rows) - 5)) * float(scales[LABEL])
    assert found.naive.residual_std == pytest.approx(deviation, rel=1e-9)
    correlations = np.corrcoef(rows[:, :-1].T)
    inflation = np.diag(np.linalg.inv(correlations))
    np.testing.assert_allclose([found.inflation[name] for name in INPUTS], inflation, rtol=1e-9)
    assert found.condition_number == pytest.approx(np.linalg.cond(correlations), rel=1e-9)
    assert (found.drives, found.fitted.gram.n) == (12, len(rows))
    assert found.comparison is None
    document = found.as_dict()
    assert document["rows"] == len(rows)
    assert document["design_effect"] == found.evidence.design_effect
    assert "against" not in document


def test_an_offset_of_each_drive_makes_the_naive_errors_too_small() -> None:
    """The rows of a drive repeat one draw of its offset."""
    drives = driven(2, COEFFICIENTS, drives=20, rows=200, noise=10)
    rng = np.random.default_rng(3)
    for one in drives:
        one.counts[:, -1] += int(rng.normal(0, 200))
    found = diagnose(cohort_of(drives), INPUTS, cluster="drive")
    naive, robust = found.naive.estimates[0], found.robust.estimates[0]
    assert robust.standard_error > 3 * naive.standard_error
    assert found.evidence.kind == "drives"
    assert found.evidence.rows < 20 * 200


def test_cohorts_of_one_law_agree_and_of_two_do_not() -> None:
    here = cohort_of(driven(3, COEFFICIENTS, drives=20, name="a"))
    same = cohort_of(driven(4, COEFFICIENTS, drives=20, name="b"), condition="mass_kg > 1")
    other = cohort_of(driven(5, (0.1, 0.4, 0.8, 0.2), drives=20, name="c"))
    agreeing = diagnose(here, INPUTS, against=same, cluster="drive").comparison
    differing = diagnose(here, INPUTS, against=other, cluster="drive").comparison
    assert agreeing is not None
    assert differing is not None
    assert differing.test is not None
    assert agreeing.test is not None
    assert agreeing.condition == "mass_kg > 1"
    assert agreeing.test.p > 0.01
    assert differing.test.p < 1e-6
    (yaw_rate,) = (e for e in differing.other.estimates if e.name == "yaw_rate")
    scales = input_scales()
    expected = 0.8 * float(scales[LABEL] / scales["yaw_rate"])
    assert yaw_rate.value == pytest.approx(expected, abs=5 * yaw_rate.standard_error)


def test_cohorts_that_share_drives_are_not_compared() -> None:
    drives = driven(6, COEFFICIENTS)
    here = cohort_of(drives)
    with pytest.raises(QuestionError, match=r"share 12 drives, such as d00: .* AND NOT \(adhesion"):
        diagnose(here, INPUTS, against=cohort_of(drives, condition="adhesion > 0.1"))


def test_drives_of_a_car_are_one_piece_of_evidence_unless_told_otherwise() -> None:
    """Against matrices of all rows, with the cars or the drives as clusters."""
    drives = driven(9, COEFFICIENTS, drives=22, rows=30)
    cohort = cohort_of(drives)
    owners = cohort.drives["vehicle_id"].to_pylist()
    units = [float(input_scales()[LABEL] / input_scales()[name]) for name in INPUTS]
    for cluster, groups in (("vehicle", owners), ("drive", [one.drive for one in drives])):
        parts = [
            rows_of([d for d, of in zip(drives, groups, strict=True) if of == group])
            for group in sorted(set(groups))
        ]
        expected, degrees = by_rows(parts)
        found = diagnose(cohort, INPUTS, cluster=cast(ClusterUnit, cluster))
        assert found.cluster == cluster
        slopes = found.robust.estimates[1:]
        errors = [estimate.standard_error for estimate in slopes]
        np.testing.assert_allclose(errors, expected[1:] * units, rtol=1e-7)
        of_t = [estimate.degrees_of_freedom for estimate in slopes]
        np.testing.assert_allclose(of_t, degrees[1:], rtol=1e-6)
        assert found.robust.degrees_of_freedom == len(set(groups)) - 1
        assert found.evidence.kind == f"{cluster}s"
    assert diagnose(cohort, INPUTS).cluster == "vehicle"
    at = cohort.drives.schema.get_field_index("vehicle_id")
    one_car = cohort.drives.set_column(at, "vehicle_id", pa.array(["a"] * len(drives)))
    assert diagnose(replace(cohort, drives=one_car), INPUTS).cluster == "drive"


def test_offsets_of_cars_are_seen_by_cars_alone() -> None:
    """What all drives of a car share makes the errors by drives too small, and rows worth more."""
    drives = driven(10, COEFFICIENTS, drives=160, rows=40, noise=10)
    cars = np.random.default_rng(11).normal(0, 300, 4)
    for number, one in enumerate(drives):
        one.counts[:, -1] += int(cars[number % 4])
    by_car, by_drive = (
        diagnose(cohort_of(drives), INPUTS, cluster=cluster) for cluster in (None, "drive")
    )
    errors = [one.robust.estimates[0].standard_error for one in (by_car, by_drive)]
    assert errors[0] > 3 * errors[1]


def test_cars_in_both_cohorts_are_not_counted_twice() -> None:
    """Which cars they are is told to the test, whose figures are compared with those of rows."""
    inputs = INPUTS[:1]
    parts = [driven(seed, (0.3,), drives=40, name=name) for seed, name in ((12, "a"), (13, "b"))]
    parts = [[replace(one, signals=(*inputs, LABEL)) for one in part] for part in parts]
    here, there = (cohort_of(part) for part in parts)
    comparison = diagnose(here, inputs, against=there).comparison
    assert comparison is not None
    assert comparison.test is not None
    cars = [i % 4 for i in range(40)]
    counts = [[one.counts for one in part] for part in parts]
    expected, apart = (
        compared(counts[0], counts[1], (cars, others)) for others in (cars, [n + 4 for n in cars])
    )
    assert comparison.test.f == pytest.approx(expected.f, rel=1e-9)
    assert comparison.test.denominator == pytest.approx(expected.denominator, rel=1e-9)
    assert expected.denominator < 4 < apart.denominator


def test_too_few_cars_are_not_compared() -> None:
    here = cohort_of(driven(14, COEFFICIENTS, name="a"))
    there = cohort_of(driven(15, COEFFICIENTS, name="b"))
    found = diagnose(here, INPUTS, against=there)
    assert found.comparison is not None
    assert found.comparison.test is None
    assert found.as_dict()["against"]["wald_clusters_independent"] is None
