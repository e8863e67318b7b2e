"""The package as a reader finds it: one name for one thing."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.base import pluralize

PACKAGE = Path(fleet_slip.__file__).parent
MODULES = {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}


def test_no_two_public_classes_have_one_name() -> None:
    places = defaultdict[str, list[Path]](list)
    for path, text in MODULES.items():
        for node in ast.parse(text).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(path.relative_to(PACKAGE))
    assert not {name: found for name, found in places.items() if len(found) > 1}


@pytest.mark.parametrize(
    ("number", "noun", "said"),
    [
        (0, "drive", "0 drives"),
        (1, "car", "1 car"),
        (2, "row", "2 rows"),
        (1500, "Gram row", "1,500 Gram rows"),
    ],
)
def test_one_thing_is_singular(number: int, noun: str, said: str) -> None:
    assert pluralize(number, noun) == said
