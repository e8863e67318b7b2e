"""Errors of the Python API speak its language."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import fleet_slip

PACKAGE = Path(fleet_slip.__file__).parent
MODULES = sorted(file.relative_to(PACKAGE) for file in PACKAGE.rglob("*.py"))


def messages(module: Path) -> Iterator[str]:
    """Yield the texts of errors that a module makes."""
    for node in ast.walk(ast.parse((PACKAGE / module).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("Error"):
            parts = [part.value for part in ast.walk(node) if isinstance(part, ast.Constant)]
            yield "".join(part for part in parts if isinstance(part, str))


@pytest.mark.parametrize(
    "module", [module for module in MODULES if module.parts[0] != "cli"], ids=str
)
def test_an_error_names_an_option_only_in_a_whole_command(module: Path) -> None:
    """A notebook has no `--folds`; a command that helps can be typed beside it."""
    for text in messages(module):
        outside = re.sub(r"(fleet-slip|pip) .*", "", text)
        assert not re.search(r"--[a-z]", outside), text


def test_messages_are_found() -> None:
    found = [text for module in MODULES for text in messages(module)]
    assert sum("fleet-slip gram" in text for text in found) > 1
