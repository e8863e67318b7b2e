"""Code blocks of a page, and how each is run as a reader would type it.

- `console`: every line that begins with `$ ` is a command. The lines after it are what it prints;
  `…` stands for any text, and a command without such lines may print anything.
- `bash`, `python` and `sql` run as they are.
- A block with a title, such as ```` ```toml title="mapping.toml" ````, becomes a file of that name.
- A block below `<!-- not run: reason -->` is not run.
- Blocks in the languages of `SHOWN` are for reading.
"""

import re
import shlex
import subprocess
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt

import fleet_slip
from fleet_slip.cli.app import app
from fleet_slip.errors import FleetSlipError
from tests.support.commands import PATIENCE_S

RUN = frozenset({"console", "bash", "python", "sql"})
SHOWN = frozenset({"text", "json", "toml", "yaml", "csv", "diff"})
_TITLE = re.compile(r'title="(?P<title>[\w.-]+)"')
_MARK = re.compile(r"<!-- not run: \S.* -->\n")


@dataclass(frozen=True)
class Block:
    """A code block of a page: its first line, and whether a comment above marks it as not run.

    Python blocks of a page share `names`.
    """

    page: Path
    line: int
    language: str
    options: str
    source: str
    is_marked: bool
    names: dict[str, Any]

    @property
    def title(self) -> str | None:
        """The name of the file that it stands for."""
        match = _TITLE.fullmatch(self.options)
        return match["title"] if match else None

    @property
    def fault(self) -> str | None:
        """Why it is neither run, nor marked, nor for reading."""
        if self.options and not self.title:
            return f"unknown options {self.options!r}"
        if self.language not in RUN | SHOWN:
            return f"{self.language or 'no language'}: use one of {sorted(RUN | SHOWN)}"
        if self.is_marked and self.language not in RUN:
            return "marked as not run, but blocks of its language never are"
        return None


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page, in order."""
    result, names, marked = [], dict[str, Any](), False
    for token in MarkdownIt("commonmark").parse(page.read_text(encoding="utf-8")):
        if token.type == "fence" and token.map:
            language, _, options = token.info.partition(" ")
            line, options = token.map[0] + 1, options.strip()
            result.append(Block(page, line, language, options, token.content, marked, names))
        marked = token.type == "html_block" and bool(_MARK.fullmatch(token.content))
    return result


def run(block: Block, variables: dict[str, str]) -> None:
    """Run a block in the working directory.

    `known` are the outputs of commands that were run before the page was opened.
    """
    assert block.fault is None, block.fault
    if block.title:
        Path(block.title).write_text(block.source, encoding="utf-8")
    elif block.language in SHOWN or block.is_marked:
        return
    elif block.language == "python":
        code = compile("\n" * block.line + block.source, str(block.page), "exec")
        exec(code, block.names)  # noqa: S102 - of our own pages
    elif block.language == "sql":
        with fleet_slip.connect("data") as database:
            assert database.execute(block.source).fetchall()
    elif block.language == "bash":
        printed_by_bash(block.source)
    else:
        for command, expected in _commands(block.source):
            printed = variables[command] if command in variables else printed_by(command)
            assert matches(printed, expected), f"{command}\nprinted\n{printed}\nnot\n{expected}"


def _commands(session: str) -> Iterator[tuple[str, str]]:
    first, *remaining = re.split(r"^\$ ", session, flags=re.M)
    assert not first.strip(), f"a console block begins with a command, not with {first!r}"
    for command in remaining:
        typed, _, printed = command.partition("\n")
        yield typed.strip(), printed


def matches(printed: str, expected: str) -> bool:
    """Return whether a text is as expected: `…` is any text, and runs of white space are equal."""
    texts = (re.escape(" ".join(text.split())) for text in expected.split("…"))
    pattern = r"\s?.*?\s?".join(texts)
    return not expected.strip() or re.fullmatch(pattern, " ".join(printed.split())) is not None


def printed_by(command: str) -> str:
    """Return what a command prints, on stdout and stderr; it must succeed.

    `fleet-slip` runs in this process: Python and its libraries are loaded once and not 60 times.
    """
    typed = shlex.split(command)
    if typed[0] != "fleet-slip" or {">", "|"} & set(typed):
        return printed_by_bash(command)
    printed = StringIO()
    with redirect_stdout(printed), redirect_stderr(printed):
        try:
            app(typed[1:])
        except SystemExit as end:
            assert not end.code, f"{command}\nended with {end.code} and\n{printed.getvalue()}"
        except FleetSlipError as error:
            raise AssertionError(f"{command}\nended with: {error}") from error
    return printed.getvalue()


def printed_by_bash(script: str) -> str:
    """Return what lines of a shell print; all of them must succeed."""
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 0, f"{script}\nended with {done.returncode} and\n{done.stdout}"
    return done.stdout
