"""The arithmetic of features by numpy, against DuckDB running their SQL."""

import numpy as np
import pyarrow as pa
import pytest

from fleet_slip.catalogue.arithmetic import parse
from fleet_slip.catalogue.feature_counts import feature_counts
from fleet_slip.catalogue.features import features
from fleet_slip.columns.column_sql import with_features
from fleet_slip.warehouse.database import open_database

HOSTILE = {
    "by_any": "(7 * ay) // (ax - 9000)",
    "guarded": "CASE WHEN abs(ax) >= 300 THEN ay * 1000 // (abs(ax) - 299) END",
    "constant_steps": "-(-3) * 5 - ay // 2 + sign(-ax)",
    "beyond_2_53": "(ay * ax * yaw_rate * 100) // 30000001",
}


@pytest.mark.parametrize("name", [*features().features, *HOSTILE])
def test_every_feature_has_the_counts_of_its_sql(name: str) -> None:
    known = features().features
    sql, limit = (known[name].sql, known[name].limit) if name in known else (HOSTILE[name], 32767)
    arithmetic = parse(sql)
    random = np.random.default_rng(3)
    counts = {one: random.integers(-32768, 32768, 400) for one in arithmetic.inputs}
    for values in counts.values():
        values[100:] //= 20
        values[200:210] = random.choice([-32768, 32767, -1, 0, 1], 10)
    table = pa.table({one: pa.array(x, pa.int64()) for one, x in counts.items()})
    with open_database() as database:
        database.register("counts", table)
        rows = with_features("counts", {name: sql}, {name: limit})
        expected = [row[0] for row in database.sql(f"SELECT {name} FROM {rows}").fetchall()]
    present = np.ones(400, dtype=np.bool_)
    values, there = feature_counts(arithmetic, limit, counts, present)
    assert [int(x) if y else None for x, y in zip(values, there, strict=True)] == expected
    assert any(expected)


def test_a_quotient_by_what_is_not_positive_is_missing() -> None:
    counts = {"ay": np.array([9, 9, 9]), "ax": np.array([3, 0, -3])}
    values, there = feature_counts(parse("ay // ax"), 99, counts, np.array([True] * 3))
    assert (values[0], there.tolist()) == (3, [True, False, False])
    guarded = parse("CASE WHEN abs(ax) >= 0 THEN ay // ax END")
    assert feature_counts(guarded, 99, counts, there)[1].tolist() == there.tolist()
