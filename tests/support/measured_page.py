"""Records of measured figures, and the page that is written from them (docs/measured.md).

A file of `benchmarks/figures` with a title is a section of the page. Each of its figures has its
command, commit, date, machine, and the code that it depends on, with its checksum. If the code
has changed since, the page marks the figure.
"""

import ast
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parents[2]
FIGURES = HERE / "benchmarks/figures"
PAGE = HERE / "docs/measured.md"
STALE = "older than the code"

Figure = dict[str, Any]


def load_sections(folder: Path = FIGURES) -> dict[Path, dict[str, Any]]:
    """Return the sections by file, in the order of the page."""
    contents = {file: json.loads(file.read_text("utf-8")) for file in sorted(folder.glob("*.json"))}
    sections = {file: content for file, content in contents.items() if "title" in content}
    return dict(sorted(sections.items(), key=lambda item: item[1]["position"]))


def digest_code(paths: list[str], root: Path = HERE) -> str:
    """Return the checksum of the source files at or below some paths.

    Docstrings, lines of comment and blank lines of Python code do not count.
    """
    checksum = hashlib.sha256()
    for name in sorted(paths):
        place = root / name
        files = sorted(place.rglob("*")) if place.is_dir() else [place]
        for file in files:
            if file.suffix in {".py", ".sql", ".toml", ".c", ".h", ".jinja"}:
                checksum.update(file.relative_to(root).as_posix().encode())
                checksum.update(_program(file))
    return checksum.hexdigest()[:16]


def _program(file: Path) -> bytes:
    """Return the lines of a source file that do something."""
    text = file.read_text(encoding="utf-8")
    lines = text.splitlines()
    if file.suffix == ".py":
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                lines[node.lineno - 1 : node.end_lineno] = [""] * len(
                    lines[node.lineno - 1 : node.end_lineno]
                )
        lines = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    return "\n".join(lines).encode()


def is_stale(figure: Figure, root: Path = HERE) -> bool:
    """Return True if the code of a figure has changed since, or was not recorded."""
    return bool(figure["code"]) and figure["code_sha256"] != digest_code(figure["code"], root)


def write_page(sections: dict[Path, dict[str, Any]], root: Path = HERE) -> str:
    """Return the page."""
    return "\n".join(line for content in sections.values() for line in _section(content, root))


def _section(content: dict[str, Any], root: Path) -> Iterator[str]:
    yield f"{content.get('heading', '##')} {content['title']}\n"
    if note := content.get("note"):
        yield f"{note}\n"
    values = [figure for figure in content["figures"] if "value" in figure]
    if values:
        rows = [
            [figure["figure"], figure["value"], _command(figure), _age(figure, root)]
            for figure in values
        ]
        yield from _table(["quantity", "figure", "command", "measured"], rows)
    for table in content["figures"]:
        if "rows" in table:
            yield f"{table['figure']}\n"
            yield from _table(table["columns"], table["rows"])
            yield f"{' · '.join(filter(None, [_command(table), _age(table, root)]))}\n"
    if remarks := content.get("remarks"):
        yield "".join(f"- {remark}\n" for remark in remarks)


def _command(figure: Figure) -> str:
    command = figure["command"]
    return f"`{command}`" if command else ""


def _age(figure: Figure, root: Path) -> str:
    """Return date and commit of a figure, and whether the code is newer."""
    at = f" at {figure['commit']}" if figure["commit"] else ""
    age = f"{figure['date']}{at}"
    return f"{age}, **{STALE}**" if is_stale(figure, root) else age


def _table(columns: list[str], rows: list[list[str]]) -> Iterator[str]:
    yield f"| {' | '.join(columns)} |"
    yield f"| {' | '.join('---' for _ in columns)} |"
    yield from (f"| {' | '.join(row)} |" for row in rows)
    yield ""
