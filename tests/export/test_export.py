"""`export` of the smoke campaign's model, and models sample by sample in Python."""

import hashlib
import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.base import canonical_json
from fleet_slip.cli.app import app
from fleet_slip.errors import InputError, QuestionError, UsageError
from fleet_slip.export.stepping import Estimator
from fleet_slip.storage.documents import checksum
from tests.export import plain
from tests.export.models import export_texts, model_of


@pytest.fixture(scope="module")
def document(smoke_root: Path) -> Any:
    fleet = fleet_slip.open(smoke_root)
    ((name, text),) = export_texts(fleet.model("smoke"), fleet.warehouse, "json").items()
    assert name == "smoke-1.json"
    return json.loads(text)


def test_the_checks_hold_and_are_of_no_drive_of_the_logs(document: Any) -> None:
    names = [check["name"] for check in document["checks"]]
    assert names == ["smooth", "extremes", "holes", "standstill"]
    assert len(set(document["checks"][0]["angles"]) - {None}) > 50
    assert "2024-05-01-0000" not in json.dumps(document["checks"])
    for check in document["checks"]:
        given = (check["facts"], check["numbers"], check["samples"])
        assert plain.angles(document["program"], *given) == check["angles"]


def test_the_document_proves_what_it_is_of(smoke_root: Path, document: Any) -> None:
    version = fleet_slip.open(smoke_root).model("smoke")
    model = document["model"]
    assert model["reference"] == "smoke@1"
    assert model["sha256"] == checksum(model["manifest"]) == version.sha256
    assert model["drives_sha256"] == version.manifest.trained_on.drives_sha256
    stated = document.pop("sha256")
    text = canonical_json(document)
    assert stated == hashlib.sha256(text.encode()).hexdigest()
    document["sha256"] = stated


def test_an_export_is_the_same_again(smoke_root: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    one, other = (export_texts(fleet.model("smoke"), fleet.warehouse, "json") for _ in range(2))
    assert one == other


def test_what_cannot_be_exported_is_said(smoke_root: Path, tmp_path: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    with pytest.raises(QuestionError, match="no version"):
        fleet.export("smoke@9", "json", tmp_path)
    with pytest.raises(UsageError, match="export to one of json"):
        fleet.export("smoke", "pascal", tmp_path)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_the_files_and_names_them(
    smoke_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "new" / "folder"
    words = ["--root", str(smoke_root), "export", "smoke@1", "--to", "json", "--json"]
    with pytest.raises(SystemExit) as ended:
        app([*words, "--output", str(target)])
    assert ended.value.code == 0
    (path,) = json.loads(capsys.readouterr().out)["files"]
    assert json.loads(Path(path).read_text())["model"]["reference"] == "smoke@1"


@pytest.mark.parametrize("ticks", [1, 3, 4, 5, 10**12])
def test_ticks_that_are_skipped_are_missing(ticks: int) -> None:
    """A mean over 5 ticks: 1 m/s^2 before the hole, 3 m/s^2 after it."""
    estimator = Estimator(model_of({"mean_5": Fraction(1)}))
    for _ in range(5):
        estimator.step({"ay_mps2": 1.0})
    estimator.skip(ticks)
    there = max(5 - 1 - ticks, 0)
    counts = Fraction(1000 * there + 3000, 7 * (there + 1))
    nearest = int(counts + Fraction(1, 2))
    assert estimator.step({"ay_mps2": 3.0}) == nearest * 0.001


def test_what_is_missing_or_unknown_is_said() -> None:
    manifest = model_of({"ay": Fraction(1), "heavy": Fraction(1)})
    with pytest.raises(InputError, match=r"does not use adhesion of a car\. It uses: mass_kg"):
        Estimator(manifest, {"adhesion": 1.0})
    estimator = Estimator(manifest, {"mass_kg": 1500})
    with pytest.raises(InputError, match="needs ay_mps2 in every sample"):
        estimator.step({"ay": 3})
    with pytest.raises(InputError, match="no number"):
        estimator.step({"ay_mps2": "fast"})  # type: ignore[dict-item]
    assert estimator.step({"ay_mps2": None}) is None
    assert estimator.step({"ay_mps2": float("inf")}) is None
    assert estimator.step({"ay_mps2": 1.0}) is not None
    assert Estimator(manifest).step({"ay_mps2": 1.0}) is None
