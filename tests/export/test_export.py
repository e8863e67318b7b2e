"""`export` of the smoke campaign's model: whole drives, sample by sample."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.base import canonical_json
from fleet_slip.cli.app import app
from fleet_slip.errors import QuestionError, UsageError
from fleet_slip.storage.documents import checksum
from tests.export import plain
from tests.export.models import export_texts


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
