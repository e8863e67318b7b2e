"""Exported SQL, run by two engines, computes what `score` does."""

from fractions import Fraction
from pathlib import Path

import duckdb
import polars as pl
import pytest

from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import ModelVersion
from tests.export.engines import by_sqlite
from tests.export.models import (
    DEFINITIONS,
    MODELS,
    export_texts,
    hostile_version,
    model_of,
)
from tests.support.catalog import CATALOG

MANIFESTS = [model_of(of, name=name) for name, of in MODELS.items()] + [hostile_version().manifest]


def test_the_statement_says_what_it_is_of() -> None:
    manifest = model_of(dict.fromkeys(DEFINITIONS, Fraction(1, 10**6)))
    files = export_texts(ModelVersion(3, manifest, "ab" * 32, CATALOG), None, "sql")
    for text in (files["sideslip_sideslip.sql"], files["sideslip_sideslip_macro.sql"]):
        assert text.startswith("-- sideslip@3: sideslip_rad")
        assert "ab" * 32 in text


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda one: one.name)
def test_two_engines_give_the_angles_of_the_checks(tmp_path: Path, manifest: Manifest) -> None:
    """Every kind of column: `car` of the check `extremes` knows all facts and numbers."""
    name = manifest.name
    files = export_texts(ModelVersion(1, manifest, "0" * 64, CATALOG), None, "sql")
    checks = tmp_path / "checks.csv"
    checks.write_text(files[f"sideslip_{name}_checks.csv"])
    rows = pl.read_csv(checks, infer_schema_length=None)
    expected = {(d, t): a for d, t, a in rows.select("drive_id", "tick", "expected_angle").rows()}
    assert len(expected) == 900
    assert len({*expected.values()}) > 10
    assert by_sqlite(files[f"sideslip_{name}.sql"], rows.drop("expected_angle")) == expected
    with duckdb.connect() as database:
        database.execute(f"CREATE TABLE checks AS FROM read_csv('{checks}')")
        database.execute(files[f"sideslip_{name}_macro.sql"])
        found = database.sql(f"SELECT drive_id, tick, angle FROM sideslip_{name}('checks')")
        assert {(drive, tick): angle for drive, tick, angle in found.fetchall()} == expected
