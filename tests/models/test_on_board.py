"""What a model costs in a car, against what is counted by hand."""

from decimal import Decimal
from fractions import Fraction

from fleet_slip.catalogue.features import features
from fleet_slip.models.manifest import Manifest, ModelTerm
from fleet_slip.models.on_board import OnBoard, cost_on_board
from tests.support.manifests import manifest


def model_of(*names: str) -> Manifest:
    """A manifest whose terms are columns over time of the shipped features."""
    known = features().time_columns
    terms = [
        ModelTerm(
            signal=name,
            column=known[name].column,
            unit=known[name].unit,
            scale=Decimal(known[name].scale),
            definition=known[name].definition,
            coefficient=1.0,
            coefficient_exact=Fraction(1),
        )
        for name in names
    ]
    return manifest().model_copy(update={"terms": tuple(terms)})


def test_a_signal_costs_a_multiplication_and_an_addition() -> None:
    assert cost_on_board(manifest()) == OnBoard(
        columns=1,
        coefficient_bytes=16,
        memory_bytes=0,
        multiplications=1,
        additions=1,
        divisions=0,
    )


def test_windows_of_one_source_share_its_ring_buffer() -> None:
    """ay over 16 and over 8 ticks: 16 numbers of 2 bytes, two sums and two counters of 4."""
    found = cost_on_board(model_of("ay_mean_16", "ay_mean_8"))
    assert found.memory_bytes == 16 * 2 + 2 * (4 + 4)
    # Each: sample in, sample out, term; ratio of scales 16 and coefficient; quotient.
    assert (found.additions, found.multiplications, found.divisions) == (6, 4, 2)


def test_a_source_is_computed_once() -> None:
    """ay * abs(ay) / 50000, rounded: 2 * x and sign(x) * 50000 are multiplications."""
    one, two = (
        cost_on_board(model_of(*names))
        for names in (["ay_square_mean_8"], ["ay_square_mean_8", "ay_square_mean_64"])
    )
    assert one.memory_bytes == 8 * 2 + 4 + 4
    assert (one.additions, one.multiplications, one.divisions) == (1 + 3, 3 + 2, 1 + 1)
    assert two.memory_bytes == 64 * 2 + 2 * (4 + 4)
    assert two.multiplications - one.multiplications == 2
    assert two.divisions - one.divisions == 1


def test_wide_sources_and_means_since_the_start() -> None:
    """A source of 18 bits takes 4 bytes; a mean since the start keeps no values, and a long sum."""
    assert cost_on_board(model_of("course_sum_16")).memory_bytes == 16 * 4 + 4 + 4
    bias = cost_on_board(model_of("yaw_rate_bias"))
    assert bias.memory_bytes == 8 + 4
    assert (bias.additions, bias.divisions) == (1 + 1 + 2, 1)
