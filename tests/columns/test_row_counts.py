"""The arithmetic of features by numpy, against DuckDB running their SQL."""

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.catalogue.definitions import plain_column
from fleet_slip.catalogue.features import features
from fleet_slip.columns.drive_columns import row_counts
from fleet_slip.columns.sql import with_columns
from fleet_slip.warehouse.database import open_database

HOSTILE = {
    "by_any": "(7 * ay) // (ax - 9000)",
    "guarded": "CASE WHEN abs(ax) >= 300 THEN ay * 1000 // (abs(ax) - 299) END",
    "constant_steps": "-(-3) * 5 - ay // 2 + sign(-ax)",
    "beyond_2_53": "(ay * ax * yaw_rate * 100) // 30000001",
}


@pytest.mark.parametrize("name", [*features().features, *HOSTILE])
def test_every_feature_has_the_counts_of_its_sql(name: str) -> None:
    one = features().rows([name]).get(name) or plain_column(name, HOSTILE[name])
    random = np.random.default_rng(3)
    counts = {one: random.integers(-32768, 32768, 400) for one in one.signals}
    for values in counts.values():
        values[100:] //= 20
        values[200:210] = random.choice([-32768, 32767, -1, 0, 1], 10)
    table = pa.table({one: pa.array(x, pa.int64()) for one, x in counts.items()})
    with open_database() as database:
        database.register("counts", table)
        rows = with_columns("counts", {name: one}, {})
        expected = [row[0] for row in database.sql(f"SELECT {name} FROM {rows}").fetchall()]
    present = np.ones(400, dtype=np.bool_)
    values, there = row_counts(one, counts, present)
    assert [int(x) if y else None for x, y in zip(values, there, strict=True)] == expected
    assert any(expected)


def test_a_quotient_by_what_is_not_positive_is_missing() -> None:
    counts = {"ay": np.array([9, 9, 9]), "ax": np.array([3, 0, -3])}
    values, there = row_counts(plain_column("x", "ay // ax"), counts, np.array([True] * 3))
    assert (values[0], there.tolist()) == (3, [True, False, False])
    guarded = plain_column("x", "CASE WHEN abs(ax) >= 0 THEN ay // ax END")
    assert row_counts(guarded, counts, there)[1].tolist() == there.tolist()
