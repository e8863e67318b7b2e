"""A signal catalogue in another order is the same catalogue."""

import os
import re
import shutil
from pathlib import Path

import pytest

from fleet_slip.resources import folder
from tests.support.commands import RunCommand


def reordered(text: str) -> str:
    """Return a catalogue with its signals, and its drive columns, in reverse order."""
    comment, *tables = re.split(r"(?m)^(?=\[)", text)
    kinds = ("[signals.", "[drive.")
    tables = [one if one.endswith("\n") else one + "\n" for one in tables]
    sorted_out = [[t for t in tables if t.startswith(kind)] for kind in kinds]
    assert sum(map(len, sorted_out)) == len(tables)
    return comment + "".join(t for group in sorted_out for t in reversed(group))


@pytest.fixture
def other(tmp_path: Path) -> dict[str, str]:
    """The environment of a user whose catalogue is in reverse order."""
    file = tmp_path / "signals.toml"
    file.write_text(reordered((folder("configs") / "signals.toml").read_text()))
    return {**os.environ, "FLEET_SLIP_SIGNALS": str(file)}


def test_an_order_of_signals_is_no_damage(
    run_command: RunCommand, other: dict[str, str], smoke_root: Path, tmp_path: Path
) -> None:
    shutil.copytree(smoke_root, tmp_path / "data")
    done = run_command("verify", "--grams", env=other)
    assert done.exit_code == 0, done.stderr
    for name in ("signals", "windows"):
        after = run_command("gram", "--features", name, "--json", env=other).json
        assert (after["files_read"], after["files_dropped"]) == (0, 0)


@pytest.mark.long
def test_models_and_rewritten_files_do_not_depend_on_the_order(
    run_command: RunCommand, other: dict[str, str], smoke_root: Path, tmp_path: Path
) -> None:
    shutil.copytree(smoke_root, tmp_path / "data")
    chosen = [run_command("select", "--json", **given).json for given in ({}, {"env": other})]
    assert chosen[0]["models"] == chosen[1]["models"]
    assert run_command("compact", env=other).exit_code == 0
    for environment in ({}, {"env": other}):
        done = run_command("verify", "--full", **environment)
        assert done.exit_code == 0, done.stderr
