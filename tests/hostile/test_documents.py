"""Manifests, histories and configs that were made by someone else."""

import json
import re
import time
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.config import load_toml
from fleet_slip.errors import ConfigError, FleetSlipError, StorageError
from fleet_slip.models.registry import Registry
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.roads import load_track
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.local import LocalFolder, data_root
from tests.support.catalog import CATALOG
from tests.support.commands import RunCommand
from tests.support.logs import path_of
from tests.support.manifests import manifest, publish

NAME = manifest().name


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """A registry with one version."""
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    publish(registry, manifest())
    return registry


def forge(registry: Registry, kind: str, **changes: Any) -> None:
    """Change keys of a document, `term` in its first term, and make its checksum right."""
    file = path_of(registry.folder) / NAME / kind / "1.json"
    document = json.loads(file.read_text())
    term = changes.pop("term", {})
    for key, value in changes.items():
        part = document["content"].get(key)
        document["content"][key] = part | value if isinstance(part, dict) else value
    if term:
        document["content"]["terms"][0] |= term
    file.unlink()
    DocumentFolder(registry.root, f"models/{NAME}/{kind}").create(1, document["content"])


@pytest.mark.parametrize(
    "changes",
    [
        {"intercept_exact": "1/0"},
        {"intercept_exact": "1e999999999"},
        {"intercept_exact": "9" * 5000 + "/1"},
        {"intercept_exact": None},
        {"intercept": 0.123},  # not its exact fraction, rounded once
        {"intercept": "nan"},
        {"term": {"coefficient": 0.123}},
        {"term": {"scale": "NaN"}},
        {"term": {"scale": "1e999999"}},
        {"term": {"scale": 0}},
        {"term": {"column": "ay_mps2; DROP VIEW log"}},
        {"term": {"signal": "ay\n"}},
        {"term": {"sql": "(SELECT 1)"}},
        {"term": {"sql": "error('x')"}},
        {"term": {"sql": "1 -- "}},
        {"term": {"sql": "ay; COPY x TO 'y'"}},
        {"terms": []},
        {"name": "another"},
        {"unknown": 1},
        {"trained_on": {"cohort": "true", "drives": 2**70, "rows": 1}},
        {"trained_on": {"cohort": "true", "drives": -1, "rows": 1}},
        {"cross_validation": {"rmse_deg": -1}},
        {"cross_validation": {"correlation": 2}},
    ],
)
def test_a_forged_manifest_is_refused(registry: Registry, changes: dict[str, Any]) -> None:
    forge(registry, "versions", **changes)
    started = time.process_time()  # the machine may be busy
    with pytest.raises(StorageError, match="manifest"):
        registry.load(NAME, 1)
    with pytest.raises(StorageError):
        registry.as_table()
    assert time.process_time() - started < 5


@pytest.mark.parametrize("sql", ["", "ay::BIGINT * yaw_rate::BIGINT", "abs(ay::BIGINT)"])
def test_integer_arithmetic_is_what_a_feature_may_be(registry: Registry, sql: str) -> None:
    forge(registry, "versions", term={"sql": sql})
    assert registry.load(NAME, 1).manifest.terms[0].sql == sql


@pytest.mark.parametrize(
    "changes",
    [{"alias": "a b"}, {"version": "x"}, {"version": 10**30}, {"at": 0.5e300}, {"command": "rm"}],
)
def test_a_forged_history_is_refused(registry: Registry, changes: dict[str, Any]) -> None:
    forge(registry, "history", **changes)
    with pytest.raises(StorageError, match="move of an alias"):
        registry.history(NAME).aliases()


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"content": ' + "[" * 5000 + "]" * 5000 + ', "sha256": ""}',
        '{"content": ' + "9" * 5000 + ', "sha256": ""}',
        '{"content": NaN, "sha256": ""}',
        '{"content": {}, "content": {}, "sha256": ""}',  # which of the two would be read?
        '{"content": "\\ud800", "sha256": ""}',
        "[]",
        "",
    ],
)
def test_a_document_that_is_none_is_refused(registry: Registry, text: str) -> None:
    (path_of(registry.folder) / NAME / "versions" / "1.json").write_text(text, encoding="latin-1")
    with pytest.raises(StorageError, match="not a document"):
        registry.load(NAME, 1)


def test_only_numbers_are_documents(registry: Registry) -> None:
    folder = DocumentFolder(registry.root, f"models/{NAME}/versions")
    for stem in ("01", "0", "-1", "1e3", "٣", "9" * 200, "x"):
        (path_of(folder.folder) / f"{stem}.json").write_text("{}")
    assert folder.numbers() == [1]


@pytest.mark.parametrize("name", ["..", "Evil", "a b", "x\n", "x'; DROP TABLE y", "\x1b[2J"])
def test_folders_that_are_no_models_are_passed_over(registry: Registry, name: str) -> None:
    (path_of(registry.folder) / name / "versions").mkdir(parents=True)
    assert registry.names() == [NAME]
    with pytest.raises(FleetSlipError):
        registry.resolve(name)
    with pytest.raises(FleetSlipError):
        registry.load(name, 1)


@pytest.mark.parametrize("alias", ["", "a b", "x\n", "../x", "1", "x" * 100])
def test_an_alias_is_a_plain_name(registry: Registry, alias: str) -> None:
    with pytest.raises(FleetSlipError):
        fleet_slip.open(str(registry.root)).models.promote(f"{NAME}@1", alias)
    assert registry.history(NAME).aliases() == {"champion": 1}


TRACK = 'name = "x"\ndescription = "d"\nclosed = {closed}\nsegments = [{segments}]\n'


@pytest.mark.parametrize(
    "content",
    [
        b"x = " + b"9" * 5000,
        b"x = 1e999999999",
        b"x = " + b"[" * 50_000,
        b"#" * 2**21,
        b"\xff",
        b"x = 2024-13-45",
        b'x = "\x1b[2J',
        b"x = 1\nx = 2",
    ],
)
def test_text_that_is_not_toml_is_refused_on_one_line(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "x.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError) as raised:
        load_toml(file)
    assert str(raised.value).isprintable()


@pytest.mark.parametrize("closed", ["true", "false"])
@pytest.mark.parametrize("length", ["1e9", "1e300", "inf", "nan"])
def test_a_track_of_any_length_takes_little_memory(
    tmp_path: Path, length: str, closed: str
) -> None:
    segment = f"{{length_m = {length}, curvature_1pm = [0.0, 0.0]}}"
    file = tmp_path / "x.toml"
    file.write_text(TRACK.format(closed=closed, segments=segment))
    with pytest.raises(ConfigError, match="length_m"):
        load_track(str(file), SHIPPED_CONFIGS)
    half = "{length_m = 9e5, curvature_1pm = [0.0, 0.0]}"
    file.write_text(TRACK.format(closed=closed, segments=f"{half}, {half}"))
    with pytest.raises(ConfigError, match="long"):
        load_track(str(file), SHIPPED_CONFIGS)


@pytest.mark.parametrize("curvature", ["1.1", "-1e308", "inf", "nan"])
def test_a_track_bends_no_more_than_a_car_can(tmp_path: Path, curvature: str) -> None:
    segment = f"{{length_m = 1e5, curvature_1pm = [{curvature}, {curvature}]}}"
    file = tmp_path / "x.toml"
    file.write_text(TRACK.format(closed="true", segments=segment))
    with pytest.raises(ConfigError, match="curvature_1pm"):
        load_track(str(file), SHIPPED_CONFIGS)


def test_the_first_of_many_faults_are_listed(tmp_path: Path) -> None:
    file = tmp_path / "x.toml"
    file.write_text("\n".join(f"{'k' * 500}{i} = 1" for i in range(500)))
    with pytest.raises(ConfigError, match=r"and 49\d more") as raised:
        load_track(str(file), SHIPPED_CONFIGS)
    assert len(str(raised.value)) < 5000


@pytest.mark.parametrize("root", ["a\\b", "a*", "a?", "[a]", "a\nb", "\x1b[2J", "a%20b"])
def test_a_root_that_delta_or_duckdb_would_misread_is_refused(root: str) -> None:
    with pytest.raises(StorageError, match="data root") as raised:
        data_root(root)
    assert str(raised.value).isprintable()


def test_a_root_inside_a_table_is_refused(tmp_path: Path) -> None:
    (tmp_path / "logs" / "_delta_log").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "logs")
    for inside in ("logs", "logs/day=2024-05-01/x", "link"):
        with pytest.raises(StorageError, match="inside the table"):
            data_root(tmp_path / inside)
    data_root(tmp_path)


@pytest.mark.parametrize("kind", ["file", "link", "loop", "long"])
def test_a_root_that_is_no_folder_is_told(
    run_command: RunCommand, tmp_path: Path, kind: str
) -> None:
    root = tmp_path / ("a" * 300 if kind == "long" else "root")
    if kind == "file":
        root.touch()
    elif kind != "long":
        root.symlink_to(root if kind == "loop" else "nowhere")
    for command in (["run", "--campaign", "smoke"], ["sql", "FROM drives"], ["verify"]):
        result = run_command("--root", str(root), *command)
        assert result.exit_code == StorageError.exit_code
        assert re.search("hoose (another|a writable)|is not a folder", result.stderr)
        assert "Errno" not in result.stderr


def test_every_error_is_shown_on_one_line() -> None:
    text = str(FleetSlipError("a\nb\x1b[2J\u202e\ud800é"))
    assert text == r"a\nb\x1b[2J\u202e\ud800é"
