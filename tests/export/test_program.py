"""Programs of published models compute what `score` computes, by an implementation of their own."""

import hashlib
import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import polars as pl
import pytest

import fleet_slip
from fleet_slip.base import canonical_json, sha256_of
from fleet_slip.catalog.definitions import Combination, Definition
from fleet_slip.errors import InputError, QuestionError, RefusedError, UsageError
from fleet_slip.export import stepping
from fleet_slip.export.files import export_files, program_content
from fleet_slip.export.stepping import Estimator, compile_program, make_checks
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.registry import ModelVersion
from fleet_slip.storage.documents import checksum
from tests.export import plain
from tests.export.engines import by_sqlite
from tests.export.models import (
    DEFINITIONS,
    LEARNING,
    MODELS,
    export_texts,
    hostile_version,
    model_of,
    version_of,
)
from tests.support.catalog import CATALOG


def test_division_by_a_negative_constant_has_no_program(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(DEFINITIONS, "by_minus_3", Definition(of="x", sql="ay // (-(3))"))
    with pytest.raises(QuestionError, match="not positive"):
        compile_program(CATALOG, model_of({"by_minus_3": Fraction(1, 7)}))


def test_every_kind_of_column_has_an_angle_in_the_checks() -> None:
    """Else the checks that travel with a program would check nothing of it."""
    for name in (*DEFINITIONS, *LEARNING):
        manifest = model_of({name: Fraction(1, 3)})
        program = compile_program(CATALOG, manifest)
        checks = make_checks(CATALOG, manifest, program)
        angles = {angle for check in checks for angle in check.angles}
        assert (None in angles) == (name not in ("slope", "one_below")), name  # always there
        assert len(angles) > (2 if name == "tyres" else 5), name
        for check in checks:
            content = program_content(program)
            facts, numbers = list(check.facts), list(check.numbers)
            assert plain.angles(content, facts, numbers, list(check.samples)) == list(check.angles)


@pytest.mark.parametrize("sign", [1, -1])
def test_columns_of_more_than_63_bits_have_no_program(
    monkeypatch: pytest.MonkeyPatch, sign: int
) -> None:
    """20 bits times 2^43 have 62, which rounding doubles: computed exactly, by the kernel, too."""
    column = Definition(of="ay", over="sum", ticks=9, ratio=Fraction(16), bits=20)
    for times in (2**43, 2**44):
        combination = Combination(terms=((sign * times + 1, column),), divisor=2**40)
        monkeypatch.setitem(LEARNING, "large", Definition(of="large", made=combination, bits=20))
        manifest = model_of({"large": Fraction(1, 7)})
        if times > 2**43:
            with pytest.raises(QuestionError, match="63 bits"):
                compile_program(CATALOG, manifest)
            continue
        program = compile_program(CATALOG, manifest)
        for check in make_checks(CATALOG, manifest, program):
            samples = list(check.samples)
            assert plain.angles(program_content(program), [], [], samples) == list(check.angles)


@pytest.mark.parametrize(("operation", "name"), [("nearest", "every_kind"), ("*", "learning")])
def test_a_program_that_differs_from_the_kernel_is_not_exported(
    monkeypatch: pytest.MonkeyPatch, operation: str, name: str
) -> None:
    version = version_of(name)
    export_files(version, None, "json")
    compute = stepping._OPERATIONS[operation]

    def wrong(a: int, b: int) -> int | None:
        result = compute(a, b)
        return result if result is None or abs(result) < 50 else result + 1000

    monkeypatch.setitem(stepping._OPERATIONS, operation, wrong)
    with pytest.raises(RefusedError, match=r"at tick \d+ of the check .* the kernel"):
        export_files(version, None, "json")


def test_a_feature_defined_in_two_ways_is_refused() -> None:
    manifest = model_of({"change_mean": Fraction(1), "heavy": Fraction(1)})
    other = Definition(of="change", sql="ay", of_bits=18, over="mean", ticks=2)
    term = manifest.terms[1].model_copy(update={"definition": other})
    with pytest.raises(QuestionError, match="two ways"):
        compile_program(CATALOG, manifest.model_copy(update={"terms": (manifest.terms[0], term)}))


def test_the_angle_is_rounded_halves_up() -> None:
    """0.00005 rad for each of ay's counts, 0.001 m/s^2: 5 counts of the angle; halves of 1/2."""
    program = compile_program(CATALOG, model_of({"ay": Fraction(1, 200)}))
    assert program.angle.bits > 40
    assert np.isclose(program.angle.terms[0][1] / 2**program.angle.bits, 0.5)
    angles = plain.angles(program_content(program), [], [], [[-3], [-1], [0], [1], [3]])
    assert angles == [-1, 0, 0, 1, 2]


@pytest.mark.parametrize(
    ("name", "sha256"), [("every_kind", "0d2839d120079dea"), ("features", "eab847943463cf02")]
)
def test_a_version_exported_again_has_the_same_steps_in_the_same_order(
    name: str, sha256: str
) -> None:
    """Digests of programs of version 0.2.0: exports of a version do not change."""
    program = compile_program(CATALOG, model_of(MODELS[name]))
    steps = program_content(program)["steps"]
    assert sha256_of(canonical_json(steps)).startswith(sha256)


@pytest.fixture(scope="module")
def document(smoke_root: Path) -> Any:
    fleet = fleet_slip.open(smoke_root)
    program_content_, again = (
        export_texts(fleet.models.get("smoke"), fleet.warehouse, "json") for _ in range(2)
    )
    assert program_content_ == again
    return json.loads(program_content_["smoke-1.json"])


def test_the_checks_hold_and_are_of_no_drive_of_the_logs(document: Any) -> None:
    names = [check["name"] for check in document["checks"]]
    assert names == ["smooth", "extremes", "holes", "standstill"]
    assert len(set(document["checks"][0]["angles"]) - {None}) > 50
    assert "2024-05-01-0000" not in json.dumps(document["checks"])
    for check in document["checks"]:
        arguments = (check["facts"], check["numbers"], check["samples"])
        assert plain.angles(document["program"], *arguments) == check["angles"]


def test_the_document_proves_what_it_is_of(smoke_root: Path, document: Any) -> None:
    version = fleet_slip.open(smoke_root).models.get("smoke")
    model = document["model"]
    assert model["reference"] == "smoke@1"
    assert model["sha256"] == checksum(model["manifest"]) == version.sha256
    assert model["drives_sha256"] == version.manifest.trained_on.drives_sha256
    stated = document.pop("sha256")
    text = canonical_json(document)
    assert stated == hashlib.sha256(text.encode()).hexdigest()
    document["sha256"] = stated


def test_models_without_a_program_are_refused(smoke_root: Path, tmp_path: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    with pytest.raises(QuestionError, match="no version"):
        fleet.models.export("smoke@9", "json", tmp_path)
    with pytest.raises(UsageError, match="Choose from: json"):
        fleet.models.export("smoke", "pascal", tmp_path)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ticks", [1, 3, 4, 5, 10**12])
def test_ticks_that_are_skipped_are_missing(ticks: int) -> None:
    """A mean over 5 ticks: 1 m/s^2 before the hole, 3 m/s^2 after it."""
    estimator = Estimator(CATALOG, model_of({"mean_5": Fraction(1)}))
    for _ in range(5):
        estimator.step({"ay_mps2": 1.0})
    estimator.skip(ticks)
    present = max(5 - 1 - ticks, 0)
    counts = Fraction(1000 * present + 3000, 7 * (present + 1))
    nearest = int(counts + Fraction(1, 2))
    assert estimator.step({"ay_mps2": 3.0}) == nearest * 0.001


def test_missing_and_unknown_signals_are_named() -> None:
    manifest = model_of({"ay": Fraction(1), "heavy": Fraction(1)})
    with pytest.raises(InputError, match=r"does not use adhesion of a car\. It uses: mass_kg"):
        Estimator(CATALOG, manifest, {"adhesion": 1.0})
    estimator = Estimator(CATALOG, manifest, {"mass_kg": 1500})
    with pytest.raises(InputError, match="needs ay_mps2 in every sample"):
        estimator.step({"ay": 3})
    with pytest.raises(InputError, match="is not a number"):
        estimator.step({"ay_mps2": "fast"})  # type: ignore[dict-item]
    assert estimator.step({"ay_mps2": None}) is None
    assert estimator.step({"ay_mps2": float("inf")}) is None
    assert estimator.step({"ay_mps2": 1.0}) is not None
    assert Estimator(CATALOG, manifest).step({"ay_mps2": 1.0}) is None


MANIFESTS = [model_of(coefficients, name=name) for name, coefficients in MODELS.items()] + [
    hostile_version().manifest
]


def test_the_statement_says_what_it_is_of() -> None:
    manifest = model_of(dict.fromkeys(DEFINITIONS, Fraction(1, 10**6)))
    files = export_texts(ModelVersion(3, manifest, "ab" * 32, CATALOG), None, "sql")
    for text in (files["sideslip_sideslip.sql"], files["sideslip_sideslip_macro.sql"]):
        assert text.startswith("-- sideslip@3: sideslip_rad")
        assert "ab" * 32 in text


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda manifest_: manifest_.name)
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
        table = database.sql(f"SELECT drive_id, tick, angle FROM sideslip_{name}('checks')")
        assert {(drive, tick): angle for drive, tick, angle in table.fetchall()} == expected
