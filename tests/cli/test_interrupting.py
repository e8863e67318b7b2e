"""Ctrl-C in long work: what is said, and that the same command does the rest."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip import errors
from fleet_slip.cli import app as program
from fleet_slip.cli.app import COMMANDS, EXIT_CODES, GROUPS, CommandGroup, load_command
from fleet_slip.models.request import SelectionRequest
from fleet_slip.regression.choice import CRITERIA
from fleet_slip.regression.orders import METHODS, RANKINGS
from fleet_slip.storage.runs import LOGGER
from tests.support.budget import processor_s
from tests.support.commands import COMMAND, PATIENCE_S, run
from tests.support.measured import MAPPING_TEXT, csv_text, good_columns


@pytest.fixture
def messages(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Remarks, as they come."""
    remarks: list[str] = []
    monkeypatch.setattr(LOGGER, "log", lambda _level, text, **_: remarks.append(text))
    return remarks


def test_the_command_ends_with_130_and_may_be_given_again(
    monkeypatch: pytest.MonkeyPatch, messages: list[str]
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(program, "app", interrupted)
    assert program._exit_code_of_app() == 130
    (remark,) = messages
    assert remark.endswith("Repeat the command to continue.")


INTERRUPTED_AT_IMPORT = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == MODULE:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
from fleet_slip.cli.main import main
main()
"""


@pytest.mark.parametrize("module", ["typer", "pyarrow", "fleet_slip.cli.app", "numpy"])
def test_an_interrupt_while_modules_are_imported_is_one_line(module: str, tmp_path: Path) -> None:
    program = INTERRUPTED_AT_IMPORT.replace("MODULE", repr(module))
    done = run([sys.executable, "-c", program, "--root", str(tmp_path / "data"), "status"])
    assert done.exit_code == 130
    assert "interrupted: " in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("error", "is_reported"),
    [
        (MemoryError(), True),
        (ImportError("x.so: failed to map segment from shared object"), True),
        (OSError(12, "Cannot allocate memory"), True),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("a bug"), False),
        (ImportError("No module named x"), False),
    ],
)
def test_a_want_of_memory_is_told_with_an_amount_and_a_bug_is_not_hidden(
    error: Exception, is_reported: bool, monkeypatch: pytest.MonkeyPatch, messages: list[str]
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(program, "app", fail)
    if is_reported:
        assert program._exit_code_of_app() == 6
        assert re.search(r"out of memory: the limit of this process is [\d,]+ MiB", messages[0])
    else:
        with pytest.raises(type(error)):
            program._exit_code_of_app()


def test_a_gram_job_that_was_interrupted_goes_on(smoke_copy: Path) -> None:
    fleet = fleet_slip.open(smoke_copy)
    seen: list[tuple[int, int]] = []

    def interrupt(done: int, total: int) -> None:
        seen.append((done, total))
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fleet.gram("motion", workers=1, progress=interrupt)
    done, total = seen[-1]
    assert 0 < done <= total
    assert 0 < fleet.gram("motion", workers=1).rows_read <= total


BEGUN = "the query has begun"
SAYS_SO = f"""
import sys
from fleet_slip.views import Session
from fleet_slip.cli.main import main

ask = Session.sql
def sql(self, query):
    print({BEGUN!r}, file=sys.stderr, flush=True)
    return ask(self, query)
Session.sql = sql
main()
"""
"""The command line, which says when it asks a query."""


@pytest.mark.parametrize(
    "query",
    [
        "SELECT length(bitstring('1', 2000000000))",
        *(
            pytest.param(query, marks=pytest.mark.long)
            for query in (
                "SELECT sum(length(repeat('a', 100000000 + i::INT))) FROM range(50) t(i)",
                "SELECT regexp_replace(repeat('ab', 100000000), '(a|b)*c', 'x')",
            )
        ),
    ],
)
def test_a_query_that_cannot_be_stopped_ends_with_the_process(smoke_root: Path, query: str) -> None:
    words = [sys.executable, "-c", SAYS_SO, "--root", str(smoke_root), "sql", query]
    before = processor_s()
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        assert BEGUN in process.stderr.readline()
        time.sleep(0.5)
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert processor_s() - before < 10  # two of them to start
    assert (process.returncode, out) == (130, "")
    assert "interrupted: committed work is kept" in err
    assert "Traceback" not in err


TABLES = {"deltalake", "numpy", "pyarrow"}
ENGINES = {"duckdb", "highway_env", "jinja2", "matplotlib", "numba", "pint", "polars"}
PROGRAM = """
import json, sys
from fleet_slip.cli.main import main
for words in json.loads(sys.argv[1]):
    sys.argv = ["fleet-slip", *words]
    try:
        main()
    except SystemExit as ended:
        assert not ended.code, words
    print(json.dumps(sorted(sys.modules)), file=sys.stderr)
"""


def test_a_command_does_not_wait_for_what_it_does_not_need(
    smoke_root: Path, tmp_path: Path
) -> None:
    """Looking for pandas, pyarrow imports it: a quarter of what a small command takes."""
    columns = good_columns()
    columns["t"][10:] = [f"{i / 100 + 0.305:.3f}" for i in range(10, 20)]  # ticks without a value
    columns["ax"][0] = columns["beta"][1] = None
    (tmp_path / "log.csv").write_text(csv_text(columns))
    (tmp_path / "test.toml").write_text(MAPPING_TEXT)
    at, files = ["--root", str(smoke_root)], ["log.csv", "--mapping", "test.toml"]
    spared_by = [
        (["--help"], TABLES | ENGINES | {"rich", "pydantic", "email"}),
        ([*at, "sql", "--csv", "FROM models"], ENGINES - {"duckdb"} | {"rich.table"}),
        ([*at, "status"], ENGINES - {"duckdb"}),
        ([*at, "select", "--help"], {"highway_env", "matplotlib"}),
        (["--root", "data", "ingest", *files], {"highway_env", "matplotlib"}),
    ]
    commands = json.dumps([words for words, _ in spared_by])
    done = run([sys.executable, "-c", PROGRAM, commands], cwd=tmp_path)
    assert done.exit_code == 0, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("[")]
    for (words, spared), modules in zip(spared_by, map(json.loads, lines), strict=True):
        assert "fleet_slip.cli.main" in modules
        assert not spared.union(["pandas"]).intersection(modules), words
    assert "polars" in json.loads(lines[-1])


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
    own_examples = [words for words in map(shlex.split, examples) if name in words]
    assert own_examples, examples
    for words in own_examples:
        arguments = words[words.index(name) + 1 :]
        command.make_context(name, arguments).close()  # raises for what it does not know


def test_help_groups_the_commands_and_begins_with_nine() -> None:
    text = run([COMMAND, "--help"], env={**os.environ, "COLUMNS": "80"}).stdout
    places = [text.index(f"\n{group}:\n") for group in GROUPS]
    assert places == sorted(places)
    assert len(GROUPS["Start here"].split()) == 9
    assert len(COMMANDS) <= 37
    assert "\n  diagnose   Fit a model's signals" in text
    assert "Without logs: fleet-slip demo\n" in text
    assert max(map(len, text.splitlines())) <= 80


def test_summaries_are_read_without_running_a_module() -> None:
    program = (
        "import sys; from fleet_slip.cli.app import COMMANDS, docstrings;"
        "[docstrings(module) for module in COMMANDS.values()]; print(*sys.modules)"
    )
    loaded = set(run([sys.executable, "-c", program]).stdout.split())
    assert not {f"fleet_slip.cli.{module}" for module in COMMANDS.values()} & loaded


@pytest.mark.parametrize(
    ("command", "absent"),
    [
        (["show", "smoke"], {"numpy", "pyarrow", "duckdb", "deltalake", "flint", "ssl", "rich"}),
        (["sql", "SELECT 1 FROM drives"], {"pandas", "polars", "flint", "numba", "rich"}),
    ],
    ids=["show", "sql"],
)
def test_a_short_command_imports_no_large_library_in_vain(
    smoke_root: Path, command: list[str], absent: set[str]
) -> None:
    program = (
        "import sys; from fleet_slip.cli.main import main\n"
        "try: main()\n"
        "except SystemExit as end: print(end.code, *sys.modules, file=sys.stderr)"
    )
    words = [sys.executable, "-c", program, "--root", str(smoke_root), *command]
    code, *modules = run(words).stderr.split()
    assert code == "0"
    assert not absent & {*modules}


def test_select_and_publish_take_the_options_of_the_api() -> None:
    """Their help names every ranking, criterion and method."""
    options = {field.name for field in fields(SelectionRequest)}
    taken = {name: {parameter.name for parameter in load_command(name).params} for name in COMMANDS}
    assert taken["select"] - {"json", "cohort", "everything", "include_faulty", "save"} == options
    assert taken["publish"] & options == {"models", "label", "robust", "half_life", "prior"}
    assert len(taken["publish"] - {"name", "help", "context"}) <= 12
    helps = {parameter.name: parameter.help for parameter in load_command("select").params}
    for option, names in (("ranking", RANKINGS), ("criterion", CRITERIA), ("search", METHODS)):
        assert all(re.search(rf"\b{name}\b", helps[option]) for name in names)


def test_exit_codes_in_help_are_those_of_the_errors() -> None:
    classes = [errors.FleetSlipError]
    for kind in classes:
        classes += kind.__subclasses__()
    codes = {kind.exit_code for kind in classes}
    assert {*EXIT_CODES} == {0, errors.INTERRUPTED, *codes}
    page = (Path(__file__).parents[2] / "docs/commands.md").read_text(encoding="utf-8")
    assert {int(code) for code in re.findall(r"^\| (\d+) \|", page, re.MULTILINE)} == {*EXIT_CODES}
