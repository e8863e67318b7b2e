"""A version that is exported and imported elsewhere is the same estimator, and says its origin."""

import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fleet_slip
from fleet_slip.base import canonical_json, sha256_of
from fleet_slip.cli.app import app
from fleet_slip.errors import DataError, InputError, RefusedError, UsageError
from fleet_slip.export.files import export_files
from fleet_slip.models.publish import is_up_to_date
from fleet_slip.models.registry import ModelVersion
from fleet_slip.operations.monitor import monitor
from fleet_slip.operations.verify import Verification, verify_models
from fleet_slip.storage.documents import checksum
from tests.export.models import model_of
from tests.support.commands import PATIENCE_S

Document = dict[str, Any]


@pytest.fixture(scope="module")
def exported(smoke_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    (file,) = fleet_slip.open(smoke_root).export("smoke", "json", tmp_path_factory.mktemp("out"))
    return file


def test_an_imported_version_is_the_same_estimator(
    exported: Path, smoke_root: Path, tmp_path: Path
) -> None:
    home, away = fleet_slip.open(smoke_root), fleet_slip.open(tmp_path / "away")
    made, brought = home.model("smoke"), away.import_model(exported)
    assert brought.reference == "smoke@1"
    origin = brought.manifest.imported_from
    assert origin is not None
    assert (origin.reference, origin.sha256) == ("smoke@1", made.sha256)
    assert brought.manifest.model_copy(update={"imported_from": None}) == made.manifest
    one, other = (fleet.registry().trained_drives(made.manifest) for fleet in (home, away))
    assert one is not None
    assert other is not None
    assert np.array_equal(one.salted, other.salted)
    assert away.import_model(exported) == brought
    assert away.registry().versions("smoke") == [1]
    assert away.registry().champion("smoke") is None
    away.promote("smoke@1")
    frame = home.sql("FROM log WHERE tick < 50 AND drive_id = 'smoke-2024-05-01-0003'").pl()
    assert away.model("smoke").predict(frame).equals(made.predict(frame))


def test_the_tables_here_are_not_those_that_made_it(
    exported: Path, smoke_root: Path, tmp_path: Path
) -> None:
    """Their numbers would be taken for those of tables here, by chance the same."""
    home, away = fleet_slip.open(smoke_root), fleet_slip.open(tmp_path / "away")
    brought, made = away.import_model(exported), home.model("smoke")
    trained = made.manifest.trained_on
    arguments = (home.warehouse, trained.cohort, "estimator", None)
    assert is_up_to_date(made.manifest, *arguments)
    assert not is_up_to_date(brought.manifest, *arguments)
    with pytest.raises(DataError, match="monitor smoke --since DAY"):
        monitor(home.warehouse, brought)
    report = Verification()
    verify_models(away.warehouse, {}, report)
    assert report.findings == []


def test_an_import_of_an_import_names_the_first_origin(
    exported: Path, smoke_root: Path, tmp_path: Path
) -> None:
    second, third = (fleet_slip.open(tmp_path / name) for name in ("second", "third"))
    second.import_model(exported)
    (file,) = second.export("smoke@1", "json", tmp_path)
    origin = third.import_model(file).manifest.imported_from
    assert origin is not None
    assert origin.sha256 == fleet_slip.open(smoke_root).model("smoke").sha256


def sealed(document: Document) -> Document:
    """A document whose checksum is right again."""
    content = {key: value for key, value in document.items() if key != "sha256"}
    return {**content, "sha256": sha256_of(canonical_json(content))}


def with_model(**changes: Any) -> Callable[[Document], Document]:
    return lambda document: sealed({**document, "model": document["model"] | changes})


def with_another_manifest(document: Document) -> Document:
    document["model"]["manifest"]["trained_on"]["rows"] += 1
    return sealed(document)


def flipped(document: Document) -> Document:
    document["checks"][0]["angles"][7] += 1
    return document


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (with_model(drives=None), "lacks the hashes"),
        (with_another_manifest, "is not that of"),
        (with_model(reference="other@1"), "is not that of"),
        (lambda document: sealed({**document, "schema": 1}), "schema 1. Export it again"),
        (lambda document: sealed({**document, "schema": 3}), "schema 3"),
        (flipped, "changed or damaged"),
        (lambda document: document["program"], "no exported version"),
        (lambda document: [document], "no exported version"),
        (lambda _: None, "no exported version"),
    ],
)
def test_what_is_no_sound_export_is_refused_and_nothing_is_written(
    change: Callable[[Document], Any], said: str, exported: Path, tmp_path: Path
) -> None:
    file = tmp_path / "changed.json"
    file.write_text(json.dumps(change(json.loads(exported.read_text()))))
    away = fleet_slip.open(tmp_path / "away")
    with pytest.raises(InputError, match=said):
        away.import_model(file)
    assert away.registry().names() == []


def small_export(folder: Path, coefficient: Fraction, name: str = "small") -> Path:
    """A document of a model of one signal."""
    folder.mkdir(exist_ok=True)
    manifest = model_of({"ay": coefficient}, name=name)
    ((stem, content),) = export_files(
        ModelVersion(1, manifest, checksum(manifest.model_dump(mode="json"))), None, "json"
    ).items()
    (folder / stem).write_bytes(content)
    return folder / stem


def test_a_flipped_bit_is_refused_wherever_it_is(tmp_path: Path) -> None:
    """But in white space, where the document stays what it was."""
    file = small_export(tmp_path, Fraction(1, 3))
    whole, random = file.read_bytes(), np.random.default_rng(1)
    before = json.loads(whole)
    away = fleet_slip.open(tmp_path / "away")
    for place in random.integers(0, len(whole), 150).tolist():
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(random.integers(8))
        file.write_bytes(damaged)
        try:
            same = json.loads(damaged.decode()) == before
        except ValueError:
            same = False
        if not same:
            with pytest.raises((InputError, RefusedError)):
                away.import_model(file)
    assert away.registry().names() == []


def test_a_name_that_exists_gets_another_version(tmp_path: Path) -> None:
    one, other = (small_export(tmp_path / str(n), Fraction(1, n)) for n in (3, 7))
    away = fleet_slip.open(tmp_path / "away")
    assert away.import_model(one).reference == "small@1"
    away.promote("small@1")
    assert away.import_model(other).reference == "small@2"
    assert away.import_model(other).reference == "small@2"
    champion = away.registry().champion("small")
    assert champion is not None
    assert champion.version == 1
    assert away.import_model(one).manifest.terms[0].coefficient_exact == Fraction(1, 3)
    assert len(away.registry().versions("small")) == 3  # it is not the newest any more


def test_imports_at_once_are_versions_of_their_own(tmp_path: Path) -> None:
    """Eight at once, of four estimators: the same one twice is one version, or its repetition."""
    files = [small_export(tmp_path / str(n), Fraction(1, n)) for n in (3, 5, 7, 9)] * 2
    away = tmp_path / "away"
    start = threading.Barrier(len(files))

    def bring(file: Path) -> ModelVersion:
        start.wait(PATIENCE_S)
        return fleet_slip.open(away).import_model(file)

    with ThreadPoolExecutor(len(files)) as pool:
        brought = [*pool.map(bring, files)]
    fleet = fleet_slip.open(away)
    numbers = fleet.registry().versions("small")
    assert numbers == [*range(1, len(numbers) + 1)]
    assert 4 <= len(numbers) <= 8
    for file, version in zip(files, brought, strict=True):
        there = fleet.model(version.reference)
        stated = json.loads(file.read_text())["model"]["sha256"]
        assert there.manifest.imported_from is not None
        assert there.manifest.imported_from.sha256 == stated
    report = Verification()
    verify_models(fleet.warehouse, {}, report)
    assert report.findings == []


def test_a_file_that_is_not_there_or_not_json_is_said(tmp_path: Path) -> None:
    away, file = fleet_slip.open(tmp_path / "away"), tmp_path / "x"
    with pytest.raises(InputError, match="no such file"):
        away.import_model(file)
    file.write_bytes(b"\xff\x00[[[[")
    with pytest.raises(InputError, match="no exported version"):
        away.import_model(file)


def test_other_ranges_of_signals_are_refused(exported: Path, tmp_path: Path) -> None:
    document = json.loads(exported.read_text())
    document["program"]["signals"][0]["max"] -= 1
    file = tmp_path / "changed.json"
    file.write_text(json.dumps(sealed(document)))
    with pytest.raises(RefusedError, match="other scales or ranges"):
        fleet_slip.open(tmp_path / "away").import_model(file)


def test_the_command_imports_and_show_says_from_where(
    exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = ["--root", str(tmp_path / "away")]
    assert ended(*root, "models", "import", str(exported), "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["model"] == "smoke@1"
    assert said["imported_from"]["reference"] == "smoke@1"
    assert ended(*root, "show", "smoke@1") == 0
    assert "from smoke@1 of another data root" in capsys.readouterr().out
    with pytest.raises(UsageError, match="unknown action 'smoke'"):
        ended(*root, "models", "smoke", str(exported))
    with pytest.raises(UsageError, match=r"name the file"):
        ended(*root, "models", "import")


def ended(*words: str) -> object:
    with pytest.raises(SystemExit) as end:
        app(list(words))
    return end.value.code
