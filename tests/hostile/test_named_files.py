"""Files that a config, a variable or a folder of configs names: pipes, devices, links, secrets."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fleet_slip.config import LONGEST_FILE_BYTES, load_config, read_named_file
from fleet_slip.errors import ConfigError, FleetSlipError, InputError
from fleet_slip.ingest.formats.can import CanBus, parse_database, read_can_database
from fleet_slip.models.acceptance import Floor
from fleet_slip.resources import CONFIG_VARIABLE, config_file, find_config
from tests.support.commands import RunCommand
from tests.support.waiting import within

LINE = "s3cret:x:0:0:root:/root:/bin/bash"


def read_database(file: Path) -> Any:
    return parse_database(read_can_database(CanBus(database=file.name), file.parent))


def test_no_error_quotes_a_file_that_is_not_what_a_config_says(tmp_path: Path) -> None:
    file = tmp_path / "car.dbc"
    for content in (LINE, f"{LINE}\n{LINE}\n", f"\n{LINE}", f'"{LINE}', f"\0{LINE}"):
        file.write_text(content)
        with pytest.raises(FleetSlipError) as caught:
            read_database(file)
        assert file.name in str(caught.value)
        assert "s3cret" not in str(caught.value)


def test_pipes_devices_and_folders_are_refused_at_once(tmp_path: Path) -> None:
    makers: tuple[Callable[[Path], object], ...] = (
        os.mkfifo,
        lambda file: file.symlink_to("/dev/zero"),
        lambda file: file.symlink_to("/dev/tty"),
        Path.mkdir,
        lambda file: file.symlink_to("nowhere"),
        lambda file: file.symlink_to(file.name),
    )
    for number, make in enumerate(makers):
        file = tmp_path / str(number) / "car.dbc"
        file.parent.mkdir()
        make(file)
        with within(), pytest.raises(FleetSlipError, match=r"car\.dbc"):
            read_database(file)


def test_a_file_is_read_up_to_a_size(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"x" * LONGEST_FILE_BYTES)
    assert len(read_named_file(file)) == LONGEST_FILE_BYTES
    with file.open("ab") as stream:
        stream.write(b"x")
    with pytest.raises(ConfigError, match="larger than"):
        read_named_file(file)


@pytest.mark.parametrize("target", ["nowhere", "publish.toml", "/dev/null", "."])
def test_a_config_that_cannot_be_read_is_not_replaced_by_the_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str
) -> None:
    monkeypatch.setenv(CONFIG_VARIABLE, str(tmp_path))
    (tmp_path / "publish.toml").symlink_to(target)
    with pytest.raises(ConfigError, match=r"publish\.toml"):
        load_config(config_file("publish.toml"), Floor)


def test_a_named_config_that_leads_nowhere_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CONFIG_VARIABLE, str(tmp_path))
    (tmp_path / "campaigns").mkdir()
    (tmp_path / "campaigns" / "smoke.toml").symlink_to("nowhere")
    with pytest.raises(ConfigError, match="a link to a file that does not exist"):
        read_named_file(find_config("campaigns", "smoke"))


@pytest.mark.parametrize("kind", ["models", "mappings"])
def test_a_folder_of_configs_that_leads_nowhere_does_not_count_as_empty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setenv(CONFIG_VARIABLE, str(tmp_path))
    (tmp_path / kind).symlink_to("nowhere")
    with pytest.raises(ConfigError, match=f"{kind}: not a folder that can be read"):
        find_config("campaigns", "smoke")


def test_a_pipe_given_to_a_command_is_refused_at_once(
    tmp_path: Path, run_command: RunCommand
) -> None:
    os.mkfifo(tmp_path / "pipe")
    done = run_command("ingest", str(tmp_path / "pipe"))
    assert done.exit_code == InputError.exit_code
    assert "pipe" in done.stderr


def test_the_list_of_configs_tells_of_a_link_that_leads_nowhere(
    tmp_path: Path, run_command: RunCommand
) -> None:
    own = tmp_path / "own"
    own.mkdir()
    (own / "publish.toml").symlink_to("nowhere")
    done = run_command("--config", str(own), "features", "--files")
    assert done.exit_code == ConfigError.exit_code
    assert "publish.toml: a link to a file that does not exist" in done.stderr
