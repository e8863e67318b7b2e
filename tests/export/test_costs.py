"""The cost of a model in a car, and the bound of its fixed-point error."""

import json
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import fleet_slip
from fleet_slip.errors import RefusedError
from fleet_slip.export.c import (
    cost_on_board,
    costs_content,
    describe_costs,
    dot_product_operations,
)
from fleet_slip.export.files import export_files
from fleet_slip.export.program import MAX_SUM, OUTPUT_COUNTS, fixed_point
from fleet_slip.models.registry import ModelVersion
from tests.export.models import DEFINITIONS, model_of
from tests.support.catalog import CATALOG

ONE = Fraction(1, 1000)


def test_a_signal_costs_one_term() -> None:
    """Two words of a coefficient: two products and two sums, and two shifts that round."""
    cost = cost_on_board(CATALOG, model_of({"ay": ONE}))
    assert (cost.columns, cost.coefficient_bytes, cost.memory_bytes) == (1, 8, 1)
    assert (cost.multiplications, cost.additions, cost.divisions) == (2, 2 + 2, 0)
    assert dot_product_operations(1) == (2, 4), "as the report counts"


def test_windows_of_one_source_share_its_ring_buffer() -> None:
    """ay over 3 and 5 ticks: 5 words of 2 bytes, its place, two sums and two counters of 4."""
    single = cost_on_board(CATALOG, model_of({"mean_5": ONE}))
    two = cost_on_board(CATALOG, model_of({"mean_5": ONE, "mean_3": ONE}))
    assert (
        single.memory_bytes == 5 * 2 + 2 + 4 + 8
    )  # the place of a word of 4 bytes is one of its own
    assert two.memory_bytes == single.memory_bytes + 8
    # A further window: the oldest sample leaves, the newest enters, a quotient, a term.
    assert two.additions - single.additions == 2 + 4 + 1 + 2
    assert two.multiplications - single.multiplications == 1 + 2 + 2  # the scales are 16 to one
    assert (single.divisions, two.divisions, two.divisions_64) == (1, 2, 0)


def test_a_feature_is_computed_once() -> None:
    """Two looks at `change`: its arithmetic counts once, and needs a division of 64 bits."""
    alone, both, heavy = (
        cost_on_board(CATALOG, model_of(dict.fromkeys(names, ONE)))
        for names in (["change_mean"], ["change_mean", "heavy_above"], ["heavy"])
    )
    gated, divided = 1 + 2 + 1, 1 + 1  # the product, a rounding, what rises
    assert both.multiplications == alone.multiplications + heavy.multiplications + gated
    assert both.divisions == alone.divisions + heavy.divisions + divided
    assert (alone.divisions_64, both.divisions_64) == (1, 2)


def test_the_manifest_of_an_export_and_show_say_the_same(smoke_root: Path) -> None:
    version = fleet_slip.open(smoke_root).models.get("smoke")
    counted = costs_content(version)
    assert counted["columns"] == len(version.manifest.terms)
    assert counted["memory_bytes"] > 1000 < counted["estimated_instructions"]
    files = export_files(version, None, "c")
    manifest = json.loads(files["sideslip_smoke_c_manifest.json"])
    assert manifest["costs"] == counted
    assert (manifest["model"], manifest["sha256"]) == ("smoke@1", version.sha256)
    assert [*manifest["files"]] == [name for name in files if "manifest" not in name]
    document = json.loads(export_files(version, None, "json")["smoke-1.json"])
    assert document["costs"] == counted
    assert str(cost_on_board(CATALOG, version.manifest)) == describe_costs(version)


def test_each_kind_of_column_adds_to_the_costs() -> None:
    least = cost_on_board(CATALOG, model_of({"ay": ONE}))
    for name in DEFINITIONS:
        cost = cost_on_board(CATALOG, model_of({"ay": ONE, name: ONE}))
        assert cost.operations > least.operations, name
        assert cost.estimated_instructions > least.estimated_instructions, name
        assert cost.estimated_code_bytes > least.estimated_code_bytes, name


def test_models_that_cannot_be_exported_are_refused() -> None:
    wild = ModelVersion(1, model_of({"ay": Fraction(10**40)}), "0" * 64, CATALOG)
    assert describe_costs(wild).startswith("cannot be exported: the coefficients are too large")
    assert "too large to bound" in costs_content(wild)["error"]


COEFFICIENT = st.fractions(-1000, 1000, max_denominator=10**30)


@given(
    st.lists(st.tuples(COEFFICIENT, st.integers(1, 2**19)), min_size=1, max_size=8),
    COEFFICIENT,
    st.data(),
)
def test_the_angle_is_within_the_bound_and_no_sum_of_parts_overflows(
    terms: list[tuple[Fraction, int]], intercept: Fraction, data: st.DataObject
) -> None:
    scaled = fixed_point(intercept, [g for g, _ in terms], [n for _, n in terms])
    counts = [data.draw(st.integers(-n, n) | st.sampled_from([-n, n])) for _, n in terms]
    exact = intercept + sum(g * n for (g, _), n in zip(terms, counts, strict=True))
    total = scaled.intercept + sum(c * n for c, n in zip(scaled.coefficients, counts, strict=True))
    angle = (total + 2 ** (scaled.bits - 1)) >> scaled.bits
    assert abs(angle - exact) <= scaled.error < Fraction(OUTPUT_COUNTS, 2)
    assert abs(angle) <= scaled.largest
    sizes = [1, *(n for _, n in terms)]
    upper = sum(abs(part) * n for (part, _), n in zip(scaled.parts, sizes, strict=True))
    lower = sum(part * n for (_, part), n in zip(scaled.parts, sizes, strict=True))
    assert all(0 <= part < 2**scaled.low_bits for _, part in scaled.parts)
    half = 2 ** (scaled.bits - scaled.low_bits - 1)
    assert upper + (lower >> scaled.low_bits) + half < MAX_SUM
    assert lower < MAX_SUM
    coefficients = [(u << scaled.low_bits) + low for u, low in scaled.parts]
    assert coefficients == [scaled.intercept, *scaled.coefficients]
    assert all(-(2**31) < part < 2**31 for part, _ in scaled.parts[1:])


def test_one_bit_more_would_not_fit() -> None:
    """A coefficient of 1/3 takes 31 bits and 31 more: its upper part is the largest below 2^31."""
    scaled = fixed_point(Fraction(0), [Fraction(1, 3)], [2**19])
    assert scaled.bits == 31 + 32
    assert scaled.coefficients == (round(Fraction(2**63, 3)),)
    assert scaled.error == Fraction(1, 2) + Fraction(2**19 + 1, 2**64)


def test_coefficients_without_a_bound_are_refused() -> None:
    with pytest.raises(RefusedError, match="too large to bound"):
        fixed_point(Fraction(0), [Fraction(10**30)], [2**19])
