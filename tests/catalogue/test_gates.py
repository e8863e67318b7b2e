"""Gates: hats that add up to one, that never jump, and configs that cannot be."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.definitions import WEIGHT, Definition, Gate
from fleet_slip.catalogue.features import features, load_features_over
from fleet_slip.columns.drive_columns import DriveColumns, DriveCounts
from fleet_slip.columns.plan import ColumnPlan
from fleet_slip.errors import ConfigError
from fleet_slip.models.request import load_model_list
from fleet_slip.resources import folder

BY = Definition(of="ay")
SHIPPED = folder("configs") / "features.toml"

knots = st.lists(st.integers(-2000, 2000), min_size=2, max_size=6, unique=True).map(sorted)


def family(edges: list[int]) -> list[Gate]:
    return [
        Gate(
            by=BY,
            low=edges[k - 1],
            peak=edges[k],
            high=edges[k + 1] if k + 1 < len(edges) else None,
        )
        for k in range(1, len(edges))
    ]


def columns_of(gates: list[Gate]) -> dict[str, Definition]:
    """A column for each gate that is its weight: what is gated is `WEIGHT` everywhere."""
    return {
        f"w{n}": Definition(of="full", sql=f"ay - ay + {WEIGHT}", gate=gate)
        for n, gate in enumerate(gates)
    }


def weights(gates: list[Gate], at: list[int]) -> FloatArray:
    """Weights by the kernel, shape (gates, counts)."""
    columns = columns_of(gates)
    drive = DriveCounts(np.arange(len(at)), {"ay": np.array(at, dtype=np.int16)})
    return DriveColumns(ColumnPlan.of(list(columns), {}, columns), drive).compute()


@given(knots)
def test_weights_add_up_to_one_above_the_second_knot(edges: list[int]) -> None:
    at = list(range(edges[1], edges[-1] + 50, 7))
    total = weights(family(edges), at).sum(axis=0)
    assert total.tolist() == [WEIGHT] * len(at)


@given(knots)
def test_a_weight_changes_by_no_more_than_its_slope(edges: list[int]) -> None:
    """From count to count: at most WEIGHT over the distance of the knots, and a rounding."""
    steepest = WEIGHT / min(high - low for low, high in pairwise(edges)) + 1
    at = list(range(edges[0] - 3, edges[-1] + 4))
    assert np.abs(np.diff(weights(family(edges), at))).max() <= steepest


def test_members_have_the_scale_of_their_column_and_neighbours_share_a_knot() -> None:
    known = features()
    first, second = known.of("rear_ay_mean_16_excess_1"), known.of("rear_ay_mean_16_excess_2")
    assert first.exact_scale == second.exact_scale == known.of("rear_ay_mean_16").exact_scale
    gates = [
        known.time_columns[f"rear_ay_mean_16_excess_{k}"].definition.gate for k in (1, 2, 3, 4)
    ]
    assert [gate.high for gate in gates if gate][:3] == [gate.peak for gate in gates if gate][1:]
    assert gates[-1] is not None
    assert gates[-1].high is None


def test_a_column_without_a_gate_says_nothing_of_gates() -> None:
    assert "gate" not in Definition(of="ay", over="mean", ticks=8).model_dump(mode="json")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('of = "ay_mean_16"\nknots = [1.0]\ncolumns = ["ay_mean_8"]', "knots"),
        ('of = "ay_mean_16"\nknots = [1.0, 0.5]\ncolumns = ["ay_mean_8"]', "must rise"),
        ('of = "ay_mean_16"\nknots = [0.0, 0.00001]\ncolumns = ["ay_mean_8"]', "must rise"),
        ('of = "ay_mean_16"\nknots = [0.0, 1e9]\ncolumns = ["ay_mean_8"]', "within what"),
        ('of = "nothing"\nknots = [0.0, 1.0]\ncolumns = ["ay_mean_8"]', "nothing"),
        ('of = "ay_mean_16"\nknots = [0.0, 1.0]\ncolumns = ["ay"]', "ay: no column over time"),
        ('of = "ay_mean_16_mass"\nknots = [0.0, 1.0]\ncolumns = ["ay_mean_8"]', "factor itself"),
    ],
)
def test_faults_are_named(tmp_path: Path, text: str, words: str) -> None:
    own = tmp_path / "features.toml"
    own.write_text(f'[gates.mine]\n{text}\ndescription = "x"\n')
    with pytest.raises(ConfigError, match=words) as caught:
        load_features_over(SHIPPED, own)
    assert "gates.mine" in str(caught.value)


def test_a_family_in_a_model_list_stands_for_its_members() -> None:
    models = {model.name: model.signals for model in load_model_list("gated").model}
    gates = [name for name in models["all"] if name not in models["no gate"]]
    families = ("excess", "road", "cornering")
    assert gates == [name for family in families for name in features().members(family)]
    assert set().union(*(models[family] for family in families)) == set(models["all"])
