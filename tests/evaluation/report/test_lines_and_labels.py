"""Series with few points."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet_slip.evaluation.charts import band


@given(
    arrays(np.float64, st.integers(1, 300), elements=st.floats(-10, 10)),
    st.integers(1, 40),
)
def test_a_band_holds_every_sample(values: np.ndarray, bins: int) -> None:
    x = np.arange(len(values), dtype=np.float64)
    found = band(x, values, bins)
    assert len(found.x) <= bins
    assert found.low.min() == values.min()
    assert found.high.max() == values.max()
    assert (found.low <= found.mean + 1e-9).all()
    assert (found.mean <= found.high + 1e-9).all()


def test_a_band_has_a_gap_where_there_is_no_value() -> None:
    values = np.array([1.0, 2.0, np.nan, np.nan, 5.0])
    found = band(np.arange(5.0), values, 3)
    np.testing.assert_array_equal(found.mean, [1.5, np.nan, 5.0])
    np.testing.assert_array_equal(found.x, [0.5, 2.5, 4.0])
