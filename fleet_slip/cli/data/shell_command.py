"""The command in which one types query after query: shell."""

import contextlib
import logging
import os
import readline
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import typer

from fleet_slip.api.session import Session
from fleet_slip.cli.begin.sql_command import Form, Scenarios, answer
from fleet_slip.cli.output import print_text, say
from fleet_slip.errors import FleetSlipError, QueryGoesOnError
from fleet_slip.warehouse.database import limit_memory

HISTORY_LINES = 1000
PRIVATE = 0o600


def shell(context: typer.Context, scenarios: Scenarios = False) -> None:
    """Type SQL queries against the warehouse, one after the other. End with .quit or Ctrl-D.

    A query ends with a semicolon or an empty line. Tab completes views, columns and commands; the
    arrow keys bring earlier lines back. **.help** lists the commands.

    Example: **fleet-slip shell**
    """
    limit_memory()
    with context.obj.session(scenarios=scenarios) as session, _kept_history(), _stdin_as_it_is():
        typed = Typed(session)
        readline.set_completer(partial(complete, typed.words()))
        readline.set_completer_delims(" \t\n,();=<>'\"")
        readline.parse_and_bind("tab: complete")
        say(f"Views: {', '.join(typed.views())}. Commands: .help")
        while (text := _read_statement()) is not None:
            try:
                if not typed.obey(text):
                    return
            except FleetSlipError as error:
                say(f"error: {error}", logging.ERROR)
            except QueryGoesOnError:
                raise
            except KeyboardInterrupt:
                say("interrupted")


class Typed:
    """What is typed, one statement or command at a time, and in which form it is answered."""

    def __init__(self, session: Session) -> None:
        """Answer in tables, until `.mode` says otherwise."""
        self._session, self._form = session, Form.TABLE
        self._commands: Mapping[str, tuple[str, Callable[[str], bool]]] = {
            ".tables": ("lists the views", self._tables),
            ".schema": ("VIEW: its columns, units and what they mean", self._schema),
            ".mode": (f"{'|'.join(Form)}: how answers are printed", self._mode),
            ".help": ("lists the commands", self._help),
            ".quit": ("ends; so do .exit and Ctrl-D", lambda _: False),
            ".exit": ("", lambda _: False),
        }

    def obey(self, text: str) -> bool:
        """Answer a query, or do what a command says; return whether to go on."""
        name, _, rest = text.strip().rstrip(";").strip().partition(" ")
        if name in ("quit", "exit") and not rest:
            return False
        if name.startswith("."):
            if name not in self._commands:
                say(f"error: there is no command {name}. .help lists them.", logging.ERROR)
                return True
            return self._commands[name][1](rest.strip())
        if text.strip():
            answer(self._session, text, self._form)
        return True

    def views(self) -> list[str]:
        """Return the names of the views."""
        found = self._session.table('SELECT DISTINCT "view" AS name FROM dictionary ORDER BY 1')
        return [*map(str, found["name"].to_pylist()), "dictionary"]

    def words(self) -> list[str]:
        """Return what Tab completes: views, columns, and commands."""
        columns = self._session.table('SELECT DISTINCT "column" AS name FROM dictionary')
        return sorted({*self.views(), *columns["name"].to_pylist(), *self._commands})

    def _tables(self, _: str) -> bool:
        print_text("\n".join(self.views()))
        return True

    def _schema(self, view: str) -> bool:
        if view and view not in self.views():
            say(f"error: there is no view {view}. .tables lists them.", logging.ERROR)
            return True
        chosen = f'SELECT "column", unit, description FROM dictionary WHERE "view" = \'{view}\''
        answer(self._session, chosen if view else "FROM dictionary", self._form)
        return True

    def _mode(self, name: str) -> bool:
        try:
            self._form = Form(name)
        except ValueError:
            say(f"error: .mode takes one of {', '.join(Form)}.", logging.ERROR)
        return True

    def _help(self, _: str) -> bool:
        for name, (meaning, _do) in self._commands.items():
            if meaning:
                print_text(f"{name:8s} {meaning}")
        return True


def complete(words: list[str], begun: str, number: int) -> str | None:
    """Return what completes a word, one candidate after the other; None after the last."""
    found = [word for word in words if word.startswith(begun.lower())]
    return found[number] if number < len(found) else None


@contextlib.contextmanager
def _kept_history() -> Iterator[None]:
    """Bring back what was typed before, and keep what is typed now, for this user alone.

    Where there is no home, or it cannot be written, nothing is kept.
    """
    state = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")  # noqa: PTH111 - "~" stays where there is no home
    file = Path(state) / "fleet_slip" / "shell_history"
    kept = sys.stdin.isatty() and file.is_absolute()
    if kept:
        with contextlib.suppress(OSError):
            readline.read_history_file(file)
    try:
        yield
    finally:
        if kept:
            with contextlib.suppress(OSError):
                file.parent.mkdir(parents=True, exist_ok=True)
                file.touch(mode=PRIVATE)
                readline.set_history_length(HISTORY_LINES)
                readline.write_history_file(file)


@contextlib.contextmanager
def _stdin_as_it_is() -> Iterator[None]:
    """Let text that is not UTF-8 be a wrong query and not the end of the program."""
    if hasattr(sys.stdin, "reconfigure"):
        sys.stdin.reconfigure(errors="replace")
    yield


def _read_statement() -> str | None:
    """Read lines until one ends with a semicolon or is empty; None at the end of the input.

    A line that begins with a dot is a command, whole.
    """
    lines: list[str] = []
    while True:
        try:
            prompt = "   ...> " if lines else "slip> "
            line = input(prompt if sys.stdin.isatty() else "")
        except EOFError:
            return "\n".join(lines) or None
        except KeyboardInterrupt:
            return ""
        if not lines and line.strip().startswith((".", "quit", "exit")):
            return line
        lines.append(line)
        if line.rstrip().endswith(";") or not line.strip():
            return "\n".join(lines)
