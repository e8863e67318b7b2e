"""Starting the program: a command imports what it needs, and the list of commands is true."""

import json
import sys
from pathlib import Path

import pytest

from fleet_slip.cli.commands import COMMANDS, Command, load_commands
from tests.support.commands import run

TABLES = {"deltalake", "numpy", "pyarrow"}
ENGINES = {"duckdb", "highway_env", "jinja2", "matplotlib", "numba", "pint", "polars"}
PROGRAM = """
import atexit, json, sys
atexit.register(lambda: print(json.dumps(sorted(sys.modules)), file=sys.stderr))
from fleet_slip.cli.main import main
main()
"""


def imported_by(root: Path, *arguments: str) -> set[str]:
    done = run([sys.executable, "-c", PROGRAM, "--root", str(root), *arguments])
    return set(json.loads(done.stderr.splitlines()[-1]))


@pytest.mark.parametrize(
    ("arguments", "spared"),
    [
        (["--help"], TABLES | ENGINES),
        (["models"], ENGINES),
        (["show", "sideslip"], ENGINES),
        (["status"], ENGINES - {"duckdb"}),
        (["sql", "SELECT 1"], ENGINES - {"duckdb"}),
    ],
)
def test_a_command_does_not_wait_for_what_it_does_not_need(
    tmp_path: Path, arguments: list[str], spared: set[str]
) -> None:
    imported = imported_by(tmp_path / "nothing-here", *arguments)
    assert "fleet_slip.cli.main" in imported
    assert not imported & spared


def test_every_command_is_listed_in_its_own_words() -> None:
    modules = {
        module: load_commands(module) for module in {one.module for one in COMMANDS.values()}
    }
    found = {
        name: Command(module, " ".join(command.help.partition("\n\n")[0].split()))
        for module, commands in modules.items()
        for name, command in commands.items()
    }
    assert found == COMMANDS
