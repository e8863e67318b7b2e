"""Grams with repeated signals, and tables of other types than exact integers, are refused."""

import numpy as np
import pytest

from fleet_slip.regression.gram import Gram, GramTable


def test_a_repeated_signal_is_refused() -> None:
    with pytest.raises(ValueError, match="repeated"):
        Gram(("ax", "ax"), 1, (1, 1), (1, 1, 1))


@pytest.mark.parametrize("kind", [np.int32, np.float64])
def test_a_table_of_sums_that_overflow_or_round_is_refused(kind: type[np.generic]) -> None:
    sums = np.ones((1, 1), np.int64).astype(kind)
    with pytest.raises(ValueError, match="int64"):
        GramTable(("ax",), np.ones(1, np.int64), sums, np.ones((1, 1), np.int64))
