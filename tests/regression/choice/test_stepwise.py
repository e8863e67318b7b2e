"""The search in extended precision against exact arithmetic."""

import time
from collections.abc import Iterable
from fractions import Fraction

import numpy as np
import pytest

from fleet_slip.errors import QuestionError
from fleet_slip.regression import orders
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.orders import METHODS, rank, stepwise_order
from tests.support.counts import greedy_order


def correlated(seed: int, inputs: int, rows: int = 400) -> Gram:
    """Columns that are mixtures of a few, as windows of one signal are, and a label of some."""
    rng = np.random.default_rng(seed)
    hidden = rng.normal(size=(rows, max(3, inputs // 3)))
    mixed = hidden @ rng.normal(size=(hidden.shape[1], inputs))
    columns = mixed + 0.05 * rng.normal(size=(rows, inputs))
    label = columns[:, : inputs // 2].sum(axis=1) + rng.normal(size=rows)
    counts = np.rint(np.column_stack([columns, label]) * 1000).astype(np.int64)
    return Gram.from_counts([*names(inputs), "y"], counts)


def names(inputs: int) -> list[str]:
    return [f"x{i}" for i in range(inputs)]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("method", ["forward", "backward"])
def test_the_order_is_that_of_exact_arithmetic(seed: int, method: str) -> None:
    gram = correlated(seed, 12)
    found = stepwise_order(gram, names(12), "y", method, 12)
    assert found[-1] == rank(method, gram, names(12), "y") == greedy_order(gram, method)
    assert [len(chosen) for chosen in found] == list(range(1, 13))


@pytest.mark.parametrize("seed", range(4))
def test_exchange_ends_where_no_exchange_helps(seed: int) -> None:
    gram = correlated(seed, 9)
    found = stepwise_order(gram, names(9), "y", "exchange", 9)
    forward = stepwise_order(gram, names(9), "y", "forward", 9)

    def rss(chosen: Iterable[str]) -> Fraction:
        return fit(gram, tuple(chosen), "y").rss

    for chosen, added in zip(found, forward, strict=True):
        assert rss(chosen) <= rss(added)
        others = {name: {*chosen} - {name} for name in chosen}
        for left in others.values():
            assert all(rss({*left, new}) >= rss(chosen) for new in {*names(9)} - {*chosen})


def test_of_equal_columns_the_first_declared_is_taken() -> None:
    rng = np.random.default_rng(3)
    x, z = rng.integers(-1000, 1000, (2, 300))
    y = 3 * x + z + rng.integers(-50, 50, 300)
    gram = Gram.from_counts(["z", "b", "a", "y"], np.column_stack([z, x, -x, y]))
    for method in METHODS:
        chosen = stepwise_order(gram, ["z", "b", "a"], "y", method, 3)
        assert {"b", "a"} - set(chosen[-1]), method
        assert len(chosen) == 2
    assert stepwise_order(gram, ["z", "b", "a"], "y", "forward", 3)[0] == ("b",)


def test_a_close_call_is_decided_exactly() -> None:
    """Two columns whose gains differ in the ninth digit: no matter which, it is the exact one."""
    rng = np.random.default_rng(8)
    for sign in (1, -1):
        x = rng.integers(-(2**19), 2**19, 5000)
        z = x[::-1].copy()
        y = x + z
        y[:2] += sign * np.sign(x[:2] - z[:2])
        gram = Gram.from_counts(["x", "z", "y"], np.column_stack([x, z, y]))
        exact = greedy_order(gram, "forward")
        assert stepwise_order(gram, ["x", "z"], "y", "forward", 1)[0] == exact[:1]


def test_a_hundred_columns_are_searched_in_a_moment() -> None:
    gram = correlated(1, 75, 3000)
    started = time.process_time()
    for method in METHODS:
        assert len(stepwise_order(gram, names(75), "y", method, 24)) == 24
    assert time.process_time() - started < 10  # exact elimination takes minutes


@pytest.mark.parametrize("method", METHODS)
def test_what_shortens_a_search_changes_no_order(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Inputs far from dependent need no elimination; taken ones leave the work by and by."""
    gram = correlated(5, 40)
    found = stepwise_order(gram, names(40), "y", method, 40)
    assert len(found) == 40
    monkeypatch.setattr(orders, "DEPENDENT", 1e-13)
    monkeypatch.setattr(np.linalg, "cholesky", _singular)
    assert stepwise_order(gram, names(40), "y", method, 40) == found


def _singular(_: object) -> None:
    raise np.linalg.LinAlgError


def test_an_unknown_search_is_refused() -> None:
    with pytest.raises(QuestionError, match="Known: forward, backward, exchange"):
        stepwise_order(correlated(0, 3), names(3), "y", "psychic", 2)
