"""Exported ONNX graphs, run by onnxruntime: the exact model within the stated error."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import onnx
import pytest

import fleet_slip
from fleet_slip.catalog.definitions import Definition
from fleet_slip.errors import ConfigError
from fleet_slip.export.files import export_files
from fleet_slip.export.onnx import FloatName, error_bound
from fleet_slip.export.stepping import compile_program, drive_counts
from fleet_slip.models.predict import Predictor
from fleet_slip.models.registry import ModelVersion
from tests.export.engines import in_si, open_session, run_drives
from tests.export.models import CARS, DEFINITIONS, MODELS, hostile_drive, model_of, version_of
from tests.support.catalog import CATALOG, SIGNALS


@pytest.mark.parametrize("kind", ["float32", "float64"])
@pytest.mark.parametrize("name", [*MODELS, "by_lateral"])
def test_hostile_drives_are_within_the_stated_error(name: str, kind: FloatName) -> None:
    version = version_of(name)
    program = compile_program(CATALOG, version.manifest)
    predictor = Predictor.from_manifest(SIGNALS, version.manifest)
    samples = [hostile_drive(program, 250, seed) for seed in range(len(CARS))]
    expected = np.array(
        [
            predictor(drive_counts(program, predictor, car.facts, car.numbers, drive))
            for car, drive in zip(CARS, samples, strict=True)
        ]
    )
    drives = np.array([in_si(program, drive, kind) for drive in samples])
    angles = run_drives(open_session(version, kind), program, CARS, drives)
    assert angles.dtype == kind
    assert np.array_equal(np.isnan(angles), np.isnan(expected))
    assert 10 < np.isfinite(angles).sum() < angles.size
    bound = error_bound(version, program, kind)
    assert np.nanmax(np.abs(angles - expected)) <= bound + 1e-12  # of `predict`, in float64
    assert bound < (1e-3 if kind == "float32" else 1e-11) * np.nanmax(np.abs(expected))


def test_a_feature_of_one_value_stands_beside_others(monkeypatch: pytest.MonkeyPatch) -> None:
    always = Definition(of="always", sql="CASE WHEN ay >= 0 THEN -(1000) END")
    monkeypatch.setitem(DEFINITIONS, "always", always)
    manifest = model_of({"always": Fraction(1, 7), "mean_3": Fraction(1, 9)})
    program, predictor = (
        compile_program(CATALOG, manifest),
        Predictor.from_manifest(SIGNALS, manifest),
    )
    samples = hostile_drive(program, 50, 1)
    session = open_session(ModelVersion(1, manifest, "0" * 64, CATALOG), "float64")
    angles = run_drives(session, program, CARS[:1], in_si(program, samples, "float64")[None])[0]
    expected = predictor(drive_counts(program, predictor, CARS[0].facts, CARS[0].numbers, samples))
    assert np.isfinite(expected).any()
    assert np.allclose(angles, expected, rtol=0, atol=1e-12, equal_nan=True)


def test_the_files_say_what_they_are_of(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    version = fleet.models.get("smoke")
    files = export_files(version, fleet.warehouse, "onnx")
    assert [*files] == [
        f"sideslip_smoke_{end}"
        for end in (
            "float32.onnx",
            "float64.onnx",
            "checks.csv",
            "onnx_README.md",
            "onnx_manifest.json",
        )
    ]
    model = onnx.load_from_string(files["sideslip_smoke_float32.onnx"])
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert (metadata["model"], metadata["sha256"]) == ("smoke@1", version.sha256)
    assert metadata["drives_sha256"] == version.manifest.trained_on.drives_sha256
    program = compile_program(CATALOG, version.manifest)
    assert metadata["error"] == f"{error_bound(version, program, 'float32'):.3g} rad"
    assert files == export_files(version, fleet.warehouse, "onnx")


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    monkeypatch.delitem(__import__("sys").modules, "fleet_slip.export.onnx")
    version = version_of("signals")
    with pytest.raises(ConfigError, match=r'onnx. Run: pip install "fleet-slip\[onnx\]"'):
        export_files(version, None, "onnx")
