"""How a table names the columns of a large model."""

from fleet_slip.models.request import load_model_list
from fleet_slip.models.summary import in_families
from tests.support.catalog import CATALOG


def test_a_large_model_is_named_by_families_and_what_belongs_to_none() -> None:
    models = {model.name: model.signals for model in load_model_list(CATALOG, "gated").model}
    shown = in_families(CATALOG, models["excess"])
    assert shown.startswith(f"{len(models['excess'])}: ax ay yaw_rate steering_wheel wheel_fl")
    assert " ax_mean(6) ay_mean(6) " in shown
    assert " excess(" in shown
    assert "excess_1" not in shown
    assert "road(" not in shown


def test_a_part_of_a_family_is_named_column_by_column() -> None:
    models = {model.name: model.signals for model in load_model_list(CATALOG, "gated").model}
    shown = in_families(CATALOG, [name for name in models["no gate"] if name != "ax_mean_16"])
    assert "ax_mean_8 ax_mean_32 " in shown
    assert " ax_mean(" not in shown
