"""Config files that are too large, too deep, or not what they seem."""

import re
from pathlib import Path

import pytest

from fleet_slip.config import load_toml
from fleet_slip.errors import ConfigError, FleetSlipError, StorageError
from fleet_slip.resources import find_config
from fleet_slip.simulation.roads import load_track
from fleet_slip.storage.data_root import data_root
from tests.support.commands import RunCommand

TRACK = 'name = "x"\ndescription = "d"\nclosed = {closed}\nsegments = [{segments}]\n'


@pytest.mark.parametrize(
    "content",
    [
        b"x = " + b"9" * 5000,
        b"x = 1e99999999999999999999",
        b"x = 1e999999999",
        b"x = " + b"[" * 50_000,
        b"x = " + b"{a = " * 5000,
        b"#" * 2**21,
        b"\xff",
        b"\xef\xbb\xbfx = 1",
        b"x = 2024-13-45",
        b"x = 9999-12-31T23:59:60Z",
        b'x = "\x1b[2J',
        b"x = 1\nx = 2",
    ],
)
def test_what_is_not_toml_is_refused_on_one_line(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "x.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError) as raised:
        load_toml(file)
    assert str(raised.value).isprintable()


@pytest.mark.parametrize("name", ["a\0.toml", "x" * 300, "x" * 5000 + ".toml", "..", "", "\ud800"])
def test_a_name_that_no_file_can_have_is_unknown(name: str) -> None:
    with pytest.raises(ConfigError):
        find_config("tracks", name)


@pytest.mark.parametrize("closed", ["true", "false"])
@pytest.mark.parametrize("length", ["1e9", "1e300", "inf", "nan"])
def test_a_track_of_any_length_takes_little_memory(
    tmp_path: Path, length: str, closed: str
) -> None:
    segment = f"{{length_m = {length}, curvature_1pm = [0.0, 0.0]}}"
    file = tmp_path / "x.toml"
    file.write_text(TRACK.format(closed=closed, segments=segment))
    with pytest.raises(ConfigError, match="length_m"):
        load_track(str(file))
    half = "{length_m = 9e5, curvature_1pm = [0.0, 0.0]}"
    file.write_text(TRACK.format(closed=closed, segments=f"{half}, {half}"))
    with pytest.raises(ConfigError, match="long"):
        load_track(str(file))


@pytest.mark.parametrize("curvature", ["1.1", "-1e308", "inf", "nan"])
def test_a_track_bends_no_more_than_a_car_can(tmp_path: Path, curvature: str) -> None:
    segment = f"{{length_m = 1e5, curvature_1pm = [{curvature}, {curvature}]}}"
    file = tmp_path / "x.toml"
    file.write_text(TRACK.format(closed="true", segments=segment))
    with pytest.raises(ConfigError, match="curvature_1pm"):
        load_track(str(file))


def test_of_many_faults_the_first_are_told(tmp_path: Path) -> None:
    file = tmp_path / "x.toml"
    file.write_text("\n".join(f"{'k' * 500}{i} = 1" for i in range(500)))
    with pytest.raises(ConfigError, match=r"and 49\d more") as raised:
        load_track(str(file))
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
