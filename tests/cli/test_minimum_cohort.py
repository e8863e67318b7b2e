"""With a minimum cohort every command asks for enough cars, or tells nothing of single ones."""

import inspect
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import fleet_slip
from fleet_slip.api.cohort import FleetCohort
from fleet_slip.api.fleet import Fleet
from fleet_slip.cli.commands import COMMANDS
from fleet_slip.errors import CohortError
from fleet_slip.warehouse.minimum_cohort import MINIMUM_VARIABLE
from tests.support.commands import run_on
from tests.support.messages import gram_of, message_of

FEW = CohortError.exit_code
DRIVE = "smoke-2024-05-02-0001"
NAME = re.compile(r"smoke-\d{4}-\d\d-\d\d-\d{4}|VIN\d")
"""What drives and cars of the root are called."""

ASK: dict[str, list[str]] = {
    "run": ["run --campaign smoke --models table1"],
    "sql": ["sql|FROM drives", "sql|SELECT count(*) FROM log", "sql|--unsafe|FROM drives"],
    "select": [
        "select",
        "select --by drive --folds each --json",
        "select --rank backward --criterion bic",
        "select --robust",
        "select|--cohort|day = '2024-05-02'",
    ],
    "publish": ["publish other"],
    "score": [
        "score smoke",
        f"score|smoke|--cohort|drive_id = '{DRIVE}'",
        f"score|smoke|--cohort|drive_id = '{DRIVE}' AND tick = 5",
        "score|smoke|--cohort|vx_mps > 10",
        f"score|smoke|--against|smoke@1|--cohort|drive_id = '{DRIVE}' AND tick = 5",
    ],
    "evaluate": ["evaluate smoke --scenario nominal", "evaluate smoke --cohort true"],
    "identify": ["identify mine --mass 1480 --front-axle 1.11 --rear-axle 1.67 --output mine.toml"],
    "report": ["report smoke"],
    "watch": [f"watch {DRIVE} smoke"],
    "explore": ["explore --headless"],
    "diagnose": ["diagnose smoke", f"diagnose|smoke|--cohort|drive_id = '{DRIVE}'"],
    "regimes": ["regimes"],
    "what-if": ["what-if smoke --noise ay=0.2"],
    "quality": ["quality", "quality --json", f"quality|--cohort|drive_id = '{DRIVE}'"],
    "calibrate": ["calibrate", "calibrate --json"],
    "monitor": ["monitor smoke --since 2024-05-02"],
}
"""Commands that have figures of cars, and ways to ask for them: all end with exit code 14."""

SILENT: dict[str, list[str]] = {
    "show": ["show smoke", "show smoke --json"],
    "simulate": ["simulate smoke"],
    "mapping": ["mapping list"],
    "ingest": ["ingest . --mapping nothing"],
    "receive": ["receive messages --json"],
    "gram": ["gram", "gram --json"],
    "check": ["check", "check --json"],
    "features": ["features"],
    "init": ["init project"],
    "models": ["models", "models --json"],
    "diff": ["diff smoke@1 smoke@1"],
    "promote": ["promote smoke@1"],
    "rollback": ["rollback smoke"],
    "pin": ["pin smoke"],
    "unpin": ["unpin smoke"],
    "export": [f"export smoke --to {to} --output out" for to in ("json", "c", "sql", "dbc")],
    "nightly": [
        "nightly --landing landing --mapping unused --model smoke --output night",
        "nightly --landing landing --mapping unused --model smoke --json",
    ],
    "status": ["status", "status --json", "status --prometheus"],
    "verify": ["verify --full --json"],
    "compact": ["compact --json"],
    "vacuum": ["vacuum"],
    "forget": ["forget --vehicle nobody"],
    "retain": ["retain"],
    "migrate": ["migrate"],
}
"""Commands that have no figures of cars: no name of one is in what they print and write."""


@pytest.fixture(scope="module")
def root(smoke_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    copy = shutil.copytree(smoke_root, tmp_path_factory.mktemp("few") / "data")
    fleet_slip.open(copy).gram("regimes")
    return copy


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(MINIMUM_VARIABLE, "20")


def first_and_further(lines_of: dict[str, list[str]]) -> list[Any]:
    """Each command with its first way to be asked; with the others in `make test-all`."""
    first = [pytest.param(lines[:1], id=name) for name, lines in lines_of.items()]
    further = {name: lines[1:] for name, lines in lines_of.items() if lines[1:]}
    return first + [
        pytest.param(lines, id=f"{name}, further", marks=pytest.mark.long)
        for name, lines in further.items()
    ]


def words_of(line: str) -> list[str]:
    return line.split("|") if "|" in line else line.split()


def test_every_command_is_known_to_ask_or_to_tell_nothing_of_cars() -> None:
    assert {*ASK} | {*SILENT} == {*COMMANDS}
    assert not {*ASK} & {*SILENT}


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("lines", first_and_further(ASK))
def test_figures_of_few_cars_are_refused(root: Path, tmp_path: Path, lines: list[str]) -> None:
    for line in lines:
        done = run_on(root, *words_of(line), cwd=tmp_path)
        assert done.exit_code == FEW, (line, done.stderr)
        assert done.stdout == "", line
        assert not list(tmp_path.iterdir()), line


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("lines", first_and_further(SILENT))
def test_what_has_no_figures_names_no_car(root: Path, tmp_path: Path, lines: list[str]) -> None:
    (tmp_path / "landing").mkdir()
    (tmp_path / "messages").write_bytes(message_of(gram_of(1), "VIN1"))
    before = {*tmp_path.iterdir()}
    for line in lines:
        done = run_on(root, *words_of(line), cwd=tmp_path)
        assert done.exit_code in (0, 2, 3, 4, 5, 7, 10, FEW), (line, done.stderr)
        assert not NAME.search(done.stdout + done.stderr), line
    for new in {*tmp_path.iterdir()} - before:
        for file in [new] if new.is_file() else filter(Path.is_file, new.rglob("*")):
            assert not NAME.search(file.read_bytes().decode("latin-1")), file


CALLS: dict[str, Callable[[Fleet], Any]] = {
    "sql": lambda fleet: fleet.sql("FROM drives"),
    "session": lambda fleet: fleet.session().sql("FROM drives"),
    "unlocked_session": lambda fleet: fleet.unlocked_session(),
    "run": lambda fleet: fleet.run("smoke", models="table1"),
    "publish": lambda fleet: fleet.publish("other", fleet.cohort()),
    "would_publish": lambda fleet: fleet.would_publish("other", fleet.cohort()),
    "score": lambda fleet: fleet.score("smoke"),
    "evaluate": lambda fleet: fleet.evaluate("smoke", scenarios=["nominal"]),
    "evaluate_measured": lambda fleet: fleet.evaluate_measured("smoke", "true"),
    "evaluate_blind": lambda fleet: fleet.evaluate_blind("smoke"),
    "report": lambda fleet: fleet.report("smoke"),
    "watch": lambda fleet: fleet.watch(DRIVE, "smoke", Path("never.html")),
    "quality": lambda fleet: fleet.quality(),
    "calibrate": lambda fleet: fleet.calibrate(),
    "monitor": lambda fleet: fleet.monitor("smoke"),
}
OF_COHORT: dict[str, Callable[[FleetCohort], Any]] = {
    "select": lambda cohort: cohort.select(),
    "diagnose": lambda cohort: cohort.diagnose("smoke"),
    "what_if": lambda cohort: cohort.what_if("smoke", noise={"ay": 0.2}),
    "regimes": lambda cohort: cohort.regimes(),
    "identify": lambda cohort: cohort.identify(
        "mine", mass_kg=1480.0, front_axle_m=1.11, rear_axle_m=1.67
    ),
}
OF_NO_CAR = {
    *("models", "model", "promote", "rollback", "pin", "unpin", "diff", "import_model"),
    *("estimator", "export", "log_to_mlflow", "registry", "resolve", "simulate", "receive"),
    *("ingest", "preview", "gram", "check", "migrate", "status", "examine", "verify", "repair"),
    *("compact", "vacuum", "preview_vacuum", "forget", "allow", "retain", "nightly", "cohort"),
    *("take_back", "scored_rows"),
}
"""Calls without figures of cars in the warehouse: of versions, of jobs, of files that are given."""


def test_every_call_is_known_to_ask_or_to_tell_nothing_of_cars() -> None:
    def public(of: type) -> set[str]:
        return {n for n, _ in inspect.getmembers(of, inspect.isfunction) if not n.startswith("_")}

    assert public(Fleet) == {*CALLS} | OF_NO_CAR
    assert public(FleetCohort) == {*OF_COHORT}


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("name", [*CALLS, *OF_COHORT])
def test_calls_refuse_figures_of_few_cars(root: Path, name: str) -> None:
    fleet = fleet_slip.open(root)
    with pytest.raises(CohortError):
        CALLS[name](fleet) if name in CALLS else OF_COHORT[name](fleet.cohort())
