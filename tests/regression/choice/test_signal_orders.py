"""Rankings, criteria and subsets against published diabetes answers and brute force."""

import math
import time
from collections.abc import Iterable
from fractions import Fraction
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_slip.errors import DataError, QuestionError
from fleet_slip.regression import orders
from fleet_slip.regression.choice import PRICES, criterion_values, nested_fits
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.inference import DriveMoments, Evidence
from fleet_slip.regression.least_squares import correlation_matrix, fit
from fleet_slip.regression.orders import (
    METHODS,
    RANKINGS,
    all_rss,
    best_subsets,
    rank,
    signals_of,
    stepwise_order,
)
from tests.support.counts import (
    dense_fit,
    evidence,
    gram_of,
    greedy_order,
    names,
    random_drives,
    table_of,
)

ORDERS = {
    "forward": "forward_order",
    "backward": "backward_order_kept_first",
}


@pytest.fixture(scope="module")
def diabetes() -> tuple[Gram, dict[str, Any]]:
    """Gram of the unscaled diabetes data as integers, and the outside answers."""
    exact = evidence("weka/diabetes_raw_exact.json")
    answers = evidence("subsets/diabetes_reference.json")
    raw = [[int(value) for value in row] for row in exact["gram_integer_ones_x_y"]]
    products = tuple(raw[i][j] for i in range(1, 12) for j in range(1, i + 1))
    return Gram((*answers["names"], "y"), raw[0][0], tuple(raw[0][1:]), products), answers


@pytest.mark.parametrize("name", ORDERS)
def test_diabetes_orders(name: str, diabetes: tuple[Gram, dict[str, Any]]) -> None:
    gram, answers = diabetes
    assert rank(name, gram, answers["names"], "y") == tuple(answers[ORDERS[name]])


def test_diabetes_best_subsets(diabetes: tuple[Gram, dict[str, Any]]) -> None:
    gram, answers = diabetes
    inputs = answers["names"]
    results = best_subsets(gram, inputs, "y")
    full, n = results[-1], gram.n
    size = np.arange(len(inputs) + 1)
    rss = np.array([float(best.rss) for best in results])
    cp = rss / float(full.rss / full.degrees_of_freedom) - n + 2 * (size + 1)
    bic = n * np.log(rss / rss[0]) + size * math.log(n)
    for j, (best, expected) in enumerate(zip(results, answers["best_subsets"], strict=True)):
        assert (j, list(best.model.signals)) == (expected["size"], expected["vars"])
        assert best.r_squared == pytest.approx(expected["r2"], rel=1e-12)
        assert rss[j] == pytest.approx(expected["rss"], rel=1e-12)
        assert cp[j] == pytest.approx(expected["cp"], rel=1e-9)
        shift = answers["best_subsets"][0]["bic_leaps"]
        assert bic[j] + shift == pytest.approx(expected["bic_leaps"], rel=1e-9)


def test_aic_orders_as_the_published_cp(diabetes: tuple[Gram, dict[str, Any]]) -> None:
    """For nested models C_p = AIC + 1 - k, with the variance of the full model."""
    gram, answers = diabetes
    order = answers["forward_order"]
    fits = nested_fits(gram, order, "y")
    values = criterion_values("aic", Evidence.measure(fits)) + 1 - len(order)
    for expected in answers["best_subsets"]:
        if {*order[: expected["size"]]} == {*expected["vars"]}:
            assert values[expected["size"]] == pytest.approx(expected["cp"], rel=1e-9)


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_all_subsets_equal_brute_force(seed: int, k: int) -> None:
    counts = np.concatenate(random_drives(seed, drives=2, inputs=k))
    gram = gram_of(counts)
    rss = all_rss(correlation_matrix(gram)) * float(fit(gram, [], "y").tss)
    for mask in range(2**k):
        chosen = [i for i in range(k) if mask >> i & 1]
        assert signals_of(mask, names(k)) == [names(k)[i] for i in chosen]
        assert rss[mask] == pytest.approx(dense_fit(counts[:, [*chosen, k]])[1], rel=1e-7)
    for size, result in enumerate(best_subsets(gram, names(k)[:-1], "y")):
        exact = min(fit(gram, c, "y").rss for c in combinations(names(k)[:-1], size))
        assert (result.size, result.rss) == (size, exact)


def test_exchange_gives_up_what_was_best_alone() -> None:
    """x1 is nearly x2 + x3, as is y: best alone, and of no use beside the other two."""
    rng = np.random.default_rng(0)
    u, v = rng.integers(-1000, 1000, (2, 300))
    proxy, y = (u + v + rng.integers(-100, 101, 300), u + v + rng.integers(-5, 6, 300))
    gram = gram_of(np.column_stack([proxy, u, v, y]))
    inputs = names(3)[:-1]
    assert rank("forward", gram, inputs, "y")[0] == "x1"
    exchanged = stepwise_order(gram, inputs, "y", "exchange", 3)
    assert [set(chosen) for chosen in exchanged] == [{"x1"}, {"x2", "x3"}, {"x1", "x2", "x3"}]


@pytest.mark.parametrize("name", RANKINGS)
def test_equals_keep_their_declared_order(name: str) -> None:
    # Two orthogonal signals with the same effect: every rank is a tie.
    counts = np.array([[1, 1, 2], [1, -1, 0], [-1, 1, 0], [-1, -1, -2], [0, 0, 1], [0, 0, -1]])
    gram = gram_of(counts)
    assert rank(name, gram, ["x1", "x2"], "y") == ("x1", "x2")
    assert rank(name, gram, ["x2", "x1"], "y") == ("x2", "x1")


def test_ranking_mistakes_are_named() -> None:
    counts = np.concatenate(random_drives(1))
    twin = gram_of(np.column_stack([counts[:, 0], counts[:, [0, -1]]]))
    for name in set(RANKINGS) - {"declared"}:
        with pytest.raises(DataError, match="x2 is a linear combination of x1"):
            rank(name, twin, ["x1", "x2"], "y")


def test_criteria_are_prices_on_contributions() -> None:
    evidence = Evidence((50.0, 9.0, 3.0, 0.5), 1000.0, 1.0, "rows")
    sizes = {name: int(np.argmin(criterion_values(name, evidence))) for name in PRICES}
    assert sizes == {"aic": 3, "bic": 2}
    np.testing.assert_allclose(evidence.excess, [62.5, 12.5, 3.5, 0.5, 0])
    np.testing.assert_allclose(evidence.distances, [58.5, 10.5, 3.5, 2.5, 4])


def test_independent_rows_have_about_as_many_effective_rows() -> None:
    rng = np.random.default_rng(9)
    drives = [np.rint(rng.normal(size=(30, 4)) * 500).astype(int) for _ in range(300)]
    for counts in drives:
        counts[:, 3] += counts[:, 0]
    moments = DriveMoments.from_table(table_of([gram_of(counts) for counts in drives]))
    fits = nested_fits(gram_of(np.concatenate(drives)), ["x1", "x2", "x3"], "y")
    assert Evidence.measure(fits, moments).design_effect == pytest.approx(1, abs=0.2)


def test_a_label_without_noise_is_an_error() -> None:
    counts = np.concatenate(random_drives(1))[:, :3]
    counts[:, 2] = counts[:, 0] + 2 * counts[:, 1]
    with pytest.raises(DataError, match="y is an exact linear combination of x1, x2"):
        Evidence.measure(nested_fits(gram_of(counts), ["x1", "x2"], "y"))


def correlated(seed: int, inputs: int, rows: int = 400) -> Gram:
    """Columns that are mixtures of a few, as windows of one signal are, and a label of some."""
    rng = np.random.default_rng(seed)
    hidden = rng.normal(size=(rows, max(3, inputs // 3)))
    mixed = hidden @ rng.normal(size=(hidden.shape[1], inputs))
    columns = mixed + 0.05 * rng.normal(size=(rows, inputs))
    label = columns[:, : inputs // 2].sum(axis=1) + rng.normal(size=rows)
    counts = np.rint(np.column_stack([columns, label]) * 1000).astype(np.int64)
    return Gram.from_counts([*named(inputs), "y"], counts)


def named(inputs: int) -> list[str]:
    return [f"x{i}" for i in range(inputs)]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("method", ["forward", "backward"])
def test_the_order_is_that_of_exact_arithmetic(seed: int, method: str) -> None:
    gram = correlated(seed, 12)
    order = stepwise_order(gram, named(12), "y", method, 12)
    assert order[-1] == rank(method, gram, named(12), "y") == greedy_order(gram, method)
    assert [len(chosen) for chosen in order] == list(range(1, 13))


@pytest.mark.parametrize("seed", range(4))
def test_exchange_ends_where_no_exchange_helps(seed: int) -> None:
    gram = correlated(seed, 9)
    order = stepwise_order(gram, named(9), "y", "exchange", 9)
    forward = stepwise_order(gram, named(9), "y", "forward", 9)

    def rss(chosen: Iterable[str]) -> Fraction:
        return fit(gram, tuple(chosen), "y").rss

    for chosen, added in zip(order, forward, strict=True):
        assert rss(chosen) <= rss(added)
        subsets = {name: {*chosen} - {name} for name in chosen}
        for subset in subsets.values():
            assert all(rss({*subset, new}) >= rss(chosen) for new in {*named(9)} - {*chosen})


def test_the_first_declared_of_equal_columns_is_chosen() -> None:
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
        assert len(stepwise_order(gram, named(75), "y", method, 24)) == 24
    assert time.process_time() - started < 10  # exact elimination takes minutes


@pytest.mark.parametrize("method", METHODS)
def test_shortcuts_of_a_search_keep_the_order(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs far from dependent need no elimination."""
    gram = correlated(5, 40)
    order = stepwise_order(gram, named(40), "y", method, 40)
    assert len(order) == 40
    monkeypatch.setattr(orders, "DEPENDENT", 1e-13)
    monkeypatch.setattr(np.linalg, "cholesky", _singular)
    assert stepwise_order(gram, named(40), "y", method, 40) == order


def _singular(_: object) -> None:
    raise np.linalg.LinAlgError


def test_an_unknown_search_is_refused() -> None:
    with pytest.raises(QuestionError, match="Known: forward, backward, exchange"):
        stepwise_order(correlated(0, 3), named(3), "y", "psychic", 2)
