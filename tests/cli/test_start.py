"""Starting the program: a command imports what it needs, and the list of commands is true."""

import inspect
import json
import os
import re
import shlex
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import pytest

from fleet_slip.api.calls import doc_of
from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.fleet import Fleet
from fleet_slip.cli.app import COMMANDS, GROUPS, CommandGroup, load_command
from fleet_slip.models.request import SelectionRequest
from tests.support.commands import COMMAND, run

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
        (["--help"], TABLES | ENGINES | {"rich", "pydantic", "email"}),
        (["select", "--help"], {"highway_env", "matplotlib"}),
        (["models"], ENGINES - {"duckdb"} | {"rich.table"}),
        (["show", "smoke"], ENGINES - {"duckdb"}),
        (["status"], ENGINES - {"duckdb"}),
        (["sql", "--csv", "FROM models"], ENGINES - {"duckdb"} | {"rich.table"}),
    ],
)
def test_a_command_does_not_wait_for_what_it_does_not_need(
    smoke_root: Path, arguments: list[str], spared: set[str]
) -> None:
    """Looking for pandas, pyarrow imports it: a quarter of what a small command takes."""
    imported = imported_by(smoke_root, *arguments)
    assert "fleet_slip.cli.main" in imported
    assert not imported & (spared | {"pandas"})


def test_every_command_is_listed_in_its_own_words() -> None:
    listed = CommandGroup().commands
    assert list(listed) == list(COMMANDS)
    for name, entry in listed.items():
        command = load_command(name)
        assert command.name == name
        assert command.help == entry.help
        assert (entry.help or "").strip()


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_has_an_example_that_can_be_typed(name: str) -> None:
    command = load_command(name)
    examples = re.findall(r": (fleet-slip [^:]+?)(?:\n\n|, then|$)", command.help or "")
    own = [words for words in map(shlex.split, examples) if name in words]
    assert own, examples
    for words in own:
        given = words[words.index(name) + 1 :]
        command.make_context(name, given).close()  # raises for what it does not know


def test_help_groups_the_commands_and_begins_with_eight() -> None:
    text = run([COMMAND, "--help"], env={**os.environ, "COLUMNS": "80"}).stdout
    places = [text.index(f"\n{group}:\n") for group in GROUPS]
    assert places == sorted(places)
    assert len(GROUPS["Start here"]) == 8
    assert len(COMMANDS) <= 34
    assert "\n  diagnose   Fit a model's signals" in text
    assert "Without logs: fleet-slip run --campaign smoke\n" in text
    assert max(map(len, text.splitlines())) <= 80


def test_summaries_are_read_without_running_a_module() -> None:
    program = (
        "import sys; from fleet_slip.cli.app import COMMANDS, docstrings;"
        "[docstrings(module) for module in COMMANDS.values()]; print(*sys.modules)"
    )
    loaded = set(run([sys.executable, "-c", program]).stdout.split())
    assert not {f"fleet_slip.cli.{module}" for module in COMMANDS.values()} & loaded


def test_a_selections_options_stand_once_and_are_those_of_the_api() -> None:
    options = {field.name for field in fields(SelectionRequest)}
    in_python = set(inspect.signature(FleetCohort.select).parameters) - {"self"}
    assert in_python == options
    taken = {name: {one.name for one in load_command(name).params} for name in COMMANDS}
    assert taken["select"] - {"json", "condition", "everything", "unexamined"} == options
    assert taken["publish"] & options == options


@pytest.mark.parametrize(
    ("command", "method"),
    [
        ("run", Fleet.run),
        ("nightly", Fleet.nightly),
        ("forget", Fleet.forget),
        ("monitor", Fleet.monitor),
        ("diagnose", FleetCohort.diagnose),
    ],
)
def test_options_are_the_parameters_of_a_method_with_their_words(
    command: str, method: Callable[..., object]
) -> None:
    parameters = inspect.signature(method).parameters
    told = {name: text for name, one in parameters.items() if (text := doc_of(one.annotation))}
    taken = {one.name: one.help for one in load_command(command).params}
    assert told
    assert {name: taken[name].replace("--signals", "`signals`") for name in told} == told
