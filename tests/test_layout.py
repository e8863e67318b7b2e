"""The package as a reader finds it: one name for one thing, rooms of a size to look over."""

import ast
from collections import Counter, defaultdict
from pathlib import Path

import fleet_slip

PACKAGE = Path(fleet_slip.__file__).parent
MODULES = {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
MOST_MODULES, MOST_LINES = 20, 300


def test_no_two_modules_have_one_name() -> None:
    names = Counter(path.stem for path in MODULES if path.stem != "__init__")
    assert not [name for name, count in names.items() if count > 1]


def test_no_two_public_classes_have_one_name() -> None:
    places = defaultdict[str, list[Path]](list)
    for path, text in MODULES.items():
        for node in ast.parse(text).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(path.relative_to(PACKAGE))
    assert not {name: found for name, found in places.items() if len(found) > 1}


def test_no_folder_has_more_modules_than_can_be_looked_over() -> None:
    folders = Counter(path.parent for path in MODULES if path.stem != "__init__")
    assert not {folder: count for folder, count in folders.items() if count > MOST_MODULES}


def test_no_module_is_longer_than_can_be_read_at_once() -> None:
    lines = {path.name: text.count("\n") for path, text in MODULES.items()}
    assert not {name: count for name, count in lines.items() if count > MOST_LINES}
