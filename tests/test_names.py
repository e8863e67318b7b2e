"""Names and docstrings of the package, tests, benchmarks and jobs, and imports between tests."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

import fleet_slip

PACKAGE = Path(fleet_slip.__file__).parent
TESTS = Path(__file__).parent
TREES = {
    path.relative_to(PACKAGE): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(PACKAGE.rglob("*.py"))
}
FOLDERS = (PACKAGE, TESTS, TESTS.parent / "benchmarks", TESTS.parent / "jobs")
MODULES = {
    str(path.relative_to(folder.parent)): ast.parse(path.read_text(encoding="utf-8"))
    for folder in FOLDERS
    for path in sorted(folder.rglob("*.py"))
}

VAGUE_NAMES = frozenset(
    {
        *("one", "found", "known", "of", "most", "left", "some", "wanted", "there", "others"),
        *("own", "kept", "told", "whole", "given", "rest", "asked", "what", "made", "each"),
        *("mine", "near", "said", "every", "gone", "which", "few", "far", "such", "here", "thing"),
    }
)
"""Pronouns, participles and prepositions: they do not name a value."""

STORED_KEYS = frozenset({"of", "made"})
"""Keys of `configs/features.toml` and of manifests, which are fields of the same names."""

VAGUE_OPENINGS = ("Of ", "What ", "That ", "Whether ", "So many ", "Which ", "Where ", "Those ")
"""Beginnings of docstrings without a subject or a verb."""

VAGUE_TESTS = tuple(
    f"test_{word}_" for word in ("what", "whatever", "of", "that", "where", "who", "whoever")
)
"""Beginnings of names of tests without a subject."""


def assigned_names(tree: ast.AST) -> Iterator[str]:
    """Yield the names of variables, parameters, attributes, functions and classes of a module."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield name
            case ast.Attribute(attr=name, ctx=ast.Store()):
                yield name
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.alias(asname=str(name)):
                yield name


def stored_fields(tree: ast.AST) -> Iterator[str]:
    """Yield the fields of classes that hold stored keys."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            for statement in node.body:
                match statement:
                    case ast.AnnAssign(target=ast.Name(id=name)) if name in STORED_KEYS:
                        yield name


def vague_names(tree: ast.AST) -> list[str]:
    """Return the vague names that a module assigns."""
    vague = Counter(name for name in assigned_names(tree) if name.strip("_") in VAGUE_NAMES)
    return sorted((vague - Counter(stored_fields(tree))).elements())


def vague_docstrings(tree: ast.AST) -> list[str]:
    """Return the docstrings of a module, and of its constants and fields, that begin vaguely."""
    docstrings = [
        node.value.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node.value.value, str)
    ]
    return [text.splitlines()[0] for text in docstrings if text.startswith(VAGUE_OPENINGS)]


def test_every_name_says_what_it_is() -> None:
    assert not {path: names for path, tree in MODULES.items() if (names := vague_names(tree))}


def test_docstrings_have_a_subject_and_a_verb() -> None:
    texts = {path: vague_docstrings(tree) for path, tree in MODULES.items()}
    assert not {path: lines for path, lines in texts.items() if lines}


def test_names_of_tests_have_a_subject() -> None:
    tests = {
        node.name
        for path, tree in MODULES.items()
        for node in ast.walk(tree)
        if path.startswith("tests/") and isinstance(node, ast.FunctionDef)
    }
    assert not {name for name in tests if name.startswith(VAGUE_TESTS)}


@pytest.mark.parametrize(
    ("code", "names"),
    [
        ("for one in versions: pass", ["one"]),
        ("def f(known): self.found = known", ["known", "found"]),
        ("def told(): pass", ["told"]),
        ("_most: int = 3", ["_most"]),
        ("import fleet as whole", ["whole"]),
        ("[version for version in versions]", []),
        ("one.found(known)", []),
        ("class Window:\n    of: str\n    made: str", []),
        ("class Window:\n    told: str", ["told"]),
    ],
)
def test_a_vague_name_is_noticed(code: str, names: list[str]) -> None:
    assert vague_names(ast.parse(code)) == sorted(names)


def test_no_two_modules_have_one_name() -> None:
    names = Counter(path.name for path in TREES if path.name != "__init__.py")
    assert not {name: count for name, count in names.items() if count > 1}


def test_no_test_imports_another() -> None:
    modules = {path: ast.parse(path.read_text(encoding="utf-8")) for path in TESTS.rglob("*.py")}
    imports = {
        str(path.relative_to(TESTS)): node.module
        for path, tree in modules.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module
        if any(part.startswith("test_") for part in node.module.split("."))
        if node.module.startswith("tests.")
    }
    assert not imports
