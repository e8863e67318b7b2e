"""The descriptions of columns beside the SQL, and the table `dictionary` that is made of them."""

from pathlib import Path

from fleet_slip.views import VIEWS, connect
from fleet_slip.warehouse.table_views import COMMON, column_descriptions
from tests.support.catalog import SIGNALS


def columns(root: Path) -> dict[str, dict[str, tuple[str, str]]]:
    """Return unit and description of every column, by view."""
    descriptions: dict[str, dict[str, tuple[str, str]]] = {}
    with connect(root, query="FROM dictionary") as database:
        for view, column, unit, description in database.sql(
            'SELECT "view", "column", unit, description FROM dictionary'
        ).fetchall():
            descriptions.setdefault(view, {})[column] = unit, description
    return descriptions


def test_every_description_is_of_a_column_and_every_column_has_one(tmp_path: Path) -> None:
    descriptions = columns(tmp_path)
    assert {*descriptions, "dictionary"} == VIEWS
    for view, described in column_descriptions().items():
        shown = {name for of_view in descriptions.values() for name in of_view}
        assert described.keys() <= (shown if view == COMMON else descriptions[view].keys()), view
    for view, described_columns in descriptions.items():
        for column, (_, description) in described_columns.items():
            assert description, (view, column)


def test_a_column_has_the_unit_of_its_view(tmp_path: Path) -> None:
    descriptions = columns(tmp_path)
    signal = SIGNALS["ay"]
    assert descriptions["log_counts"]["ay"] == (f"{signal.scale} {signal.unit}", signal.description)
    assert descriptions["log"][signal.column] == (signal.unit, signal.description)
    assert descriptions["log"]["time_s"][0] == "s"
    assert descriptions["grams"]["products"][0] == "counts^2"
