"""Grams: exact, additive, independent of how they were formed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fleet_slip.errors import DataError
from fleet_slip.regression.gram import Gram, GramTable, exact_sum, require_signals
from tests.support.counts import table_of

SIGNALS = ("ax", "ay", "sideslip")

counts_of_drive = hnp.arrays(
    np.int16, st.tuples(st.integers(0, 30), st.just(3)), elements=st.integers(-(2**15), 2**15 - 1)
)


def python_gram(signals: tuple[str, ...], counts: np.ndarray) -> Gram:
    rows = [[int(count) for count in row] for row in counts]
    k = range(len(signals))
    return Gram(
        signals,
        len(rows),
        tuple(sum(row[i] for row in rows) for i in k),
        tuple(sum(row[i] * row[j] for row in rows) for i in k for j in range(i + 1)),
    )


@given(counts_of_drive)
def test_blas_equals_python_integers(counts: np.ndarray) -> None:
    assert Gram.from_counts(SIGNALS, counts) == python_gram(SIGNALS, counts)


@given(hnp.arrays(np.int64, (5, 2), elements=st.integers(-(2**62), 2**62)), st.integers(1, 2**80))
def test_counts_of_any_size_are_exact(counts: np.ndarray, factor: int) -> None:
    large = counts.astype(object) * factor
    assert Gram.from_counts(("a", "b"), large) == python_gram(("a", "b"), large)


@given(counts_of_drive, counts_of_drive)
def test_addition_is_concatenation_and_subtraction_undoes_it(
    first: np.ndarray, second: np.ndarray
) -> None:
    a, b = Gram.from_counts(SIGNALS, first), Gram.from_counts(SIGNALS, second)
    both = Gram.from_counts(SIGNALS, np.concatenate([second, first]))
    assert a + b == b + a == both
    assert both - a == b
    assert a + Gram.zero(SIGNALS) == a


@given(counts_of_drive, st.permutations(range(3)), st.integers(1, 3))
def test_restriction_is_the_gram_of_the_columns(
    counts: np.ndarray, order: list[int], size: int
) -> None:
    chosen = order[:size]
    names = tuple(SIGNALS[i] for i in chosen)
    assert Gram.from_counts(SIGNALS, counts).restrict(names) == Gram.from_counts(
        names, counts[:, chosen]
    )


@given(counts_of_drive)
def test_linear_combinations_equal_those_of_the_counts(counts: np.ndarray) -> None:
    wide = counts.astype(np.int64)
    expected = np.column_stack([wide[:, 0] - 3 * wide[:, 2], 2 * wide[:, 1]])
    combined = Gram.from_counts(SIGNALS, counts).combine(
        {"mix": {"ax": 1, "sideslip": -3}, "twice": {"ay": 2}}
    )
    assert combined == Gram.from_counts(("mix", "twice"), expected)


def test_mistakes_are_named() -> None:
    gram = Gram.from_counts(SIGNALS, np.array([[1, 2, 3]]))
    larger = Gram.from_counts(SIGNALS, np.array([[1, 2, 4]]))
    with pytest.raises(DataError, match="these drives lack yaw_rate"):
        gram.restrict(["ax", "yaw_rate"])
    with pytest.raises(DataError, match="different signals"):
        _ = gram + gram.restrict(["ax"])
    with pytest.raises(DataError, match="not part of the total"):
        _ = gram - larger
    with pytest.raises(ValueError, match="integers"):
        Gram.from_counts(SIGNALS, np.zeros((2, 3)))


@given(st.lists(counts_of_drive, min_size=1, max_size=8), st.randoms())
def test_table_totals_equal_sums_of_grams(drives: list[np.ndarray], random) -> None:  # type: ignore[no-untyped-def]
    grams = [Gram.from_counts(SIGNALS, counts) for counts in drives]
    table = table_of(grams)
    fold = np.array([random.randrange(3) for _ in grams])
    expected = [
        sum((g for g, f in zip(grams, fold, strict=True) if f == number), Gram.zero(SIGNALS))
        for number in range(3)
    ]
    assert table.totals(fold, 3) == expected
    assert table.total() == sum(expected, Gram.zero(SIGNALS))
    assert table.take(fold == 1).total() == expected[1]
    assert [table.row(i) for i in range(len(table))] == grams
    names = ("sideslip", "ax")
    assert table.restrict(names).total() == table.total().restrict(names)


@given(hnp.arrays(np.int64, (7, 2), elements=st.integers(-(2**63), 2**63 - 1)))
def test_totals_beyond_64_bits_are_exact(values: np.ndarray) -> None:
    assert exact_sum(values) == [sum(column) for column in values.T.tolist()]


@settings(max_examples=30)
@given(counts_of_drive, st.lists(st.integers(-(2**15), 2**15 - 1), min_size=3, max_size=3))
def test_moments_about_an_origin_are_those_of_shifted_counts(
    counts: np.ndarray, origin: list[int]
) -> None:
    table = table_of([Gram.from_counts(SIGNALS, counts)])
    shifted = Gram.from_counts(SIGNALS, counts.astype(np.int64) - np.array(origin))
    assert table.about(origin).row(0) == shifted


def test_moments_about_an_origin_survive_wrapping() -> None:
    rows = 2**33
    table = GramTable(
        ("a",), np.array([rows]), np.array([[rows * 30_000]]), np.array([[rows * 30_000**2]])
    )
    assert table.about([29_999]).row(0) == Gram(("a",), rows, (rows,), (rows,))


@pytest.mark.parametrize(
    ("names", "fault"),
    [("b", "lack b."), ("bc", "lack b and c."), ("bcdefgh", "lack b, c, d, e and 3 more.")],
)
def test_absent_signals_are_named_of_many_the_first(names: str, fault: str) -> None:
    with pytest.raises(DataError, match=f"{fault}$".replace(".", r"\.")):
        require_signals("a", names)


def test_blas_is_exact_at_the_largest_counts_over_many_blocks() -> None:
    rows = 2**19 + 3
    counts = np.full((rows, 2), -(2**15), dtype=np.int16)
    gram = Gram.from_counts(("a", "b"), counts)
    assert gram.products == (rows * 2**30,) * 3
    assert gram.sums == (-rows * 2**15,) * 2
