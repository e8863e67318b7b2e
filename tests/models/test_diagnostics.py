"""A model's fit examined, against the rows."""

from dataclasses import replace
from typing import cast

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.catalogue.features import input_scales
from fleet_slip.models.diagnose import diagnose
from fleet_slip.regression.drives import ClusterUnit
from tests.support.cohorts import INPUTS, LABEL, cohort_of, driven, rows_of
from tests.support.counts import by_rows, dense_fit

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
    document = found.as_dict()
    assert document["rows"] == len(rows)
    assert document["design_effect"] == found.evidence.design_effect


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
