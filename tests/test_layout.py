"""The package as a reader finds it: one name for one thing."""

import ast
from collections import defaultdict
from pathlib import Path

import fleet_slip

PACKAGE = Path(fleet_slip.__file__).parent
MODULES = {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}


def test_no_two_public_classes_have_one_name() -> None:
    places = defaultdict[str, list[Path]](list)
    for path, text in MODULES.items():
        for node in ast.parse(text).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(path.relative_to(PACKAGE))
    assert not {name: modules for name, modules in places.items() if len(modules) > 1}
