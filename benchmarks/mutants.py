"""Break the code in small ways, one at a time, and see whether a test of that folder fails.

    python -m benchmarks.mutants [--folder regression] [--each 3] [--seed 1] [--show]

Each module gives a sample of its mutants, the same for the same seed: an operator, comparison or
constant changed, a condition negated, a statement left out. The work is done in a copy of the
project. A mutant is killed when a test fails, or ends no more; what survives is printed, to be
judged by a person: some mutants change nothing that anyone could see.
"""

import argparse
import ast
import copy
import importlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings

PROJECT = Path(__file__).parents[1]
TESTED_BY = {
    "regression": ["tests/regression"],
    "grams": ["tests/grams", "tests/catalogue/test_features.py", "tests/warehouse"],
    "delta": ["tests/delta"],
    "ingest": ["tests/ingest", "tests/environment/test_hostile_names.py"],
}
PARTS = (
    "benchmarks",
    "configs",
    "docs",
    "fleet_slip",
    "jobs",
    "tests",
    "warehouse",
    "pyproject.toml",
)
PATIENCE_S = 1800.0
LIBRARIES = ("deltalake", "duckdb", "numpy", "pandas", "polars", "pyarrow.parquet", "pydantic")

SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Mult,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot,
    ast.IsNot: ast.Is, ast.And: ast.Or, ast.Or: ast.And, ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
    ast.Break: ast.Continue, ast.Continue: ast.Break,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """A module with one change."""

    path: Path
    line: int
    before: str
    after: str
    text: str


def sites(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield what may change: no annotation, message of an error, or `strict` of a `zip`."""
    if isinstance(tree, ast.keyword) and tree.arg == "strict":
        return
    for name, value in ast.iter_fields(tree):
        if name in {"annotation", "returns", "decorator_list", "type_comment"}:
            continue
        for node in value if isinstance(value, list) else [value]:
            if isinstance(node, ast.AST) and not isinstance(node, (ast.Raise, ast.JoinedStr)):
                yield node
                yield from sites(node)


def change(node: ast.AST) -> bool:
    """Change a node in place; say whether there was something to change."""
    match node:
        case ast.BinOp() | ast.AugAssign() | ast.BoolOp() if type(node.op) in SWAPS:
            node.op = SWAPS[type(node.op)]()  # type: ignore[assignment]
        case ast.Compare() if type(node.ops[0]) in SWAPS:
            node.ops[0] = SWAPS[type(node.ops[0])]()  # type: ignore[call-overload]
        case ast.If() | ast.IfExp() | ast.While() | ast.comprehension(ifs=[_, *_]):
            negated = node.ifs if isinstance(node, ast.comprehension) else [node.test]
            negated = [ast.UnaryOp(ast.Not(), negated[0]), *negated[1:]]
            if isinstance(node, ast.comprehension):
                node.ifs = negated
            else:
                node.test = negated[0]
        case ast.Constant(value=bool()):
            node.value = not node.value
        case ast.Constant(value=int() | float() as value):
            node.value = value + 1
        case ast.Expr(value=ast.Call() | ast.Yield()):
            node.value = ast.Constant(value=None)
        case ast.Return(value=ast.AST()):
            node.value = ast.Constant(value=None)
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            node.op = ast.UAdd() if isinstance(node.op, ast.USub) else ast.Not()
            node.operand = (
                ast.UnaryOp(ast.Not(), node.operand)
                if isinstance(node.op, ast.Not)
                else node.operand
            )
        case _:
            return False
    return True


def mutants(path: Path, each: int, seed: int) -> list[Mutant]:
    """Draw mutants of a module."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    count = sum(1 for _ in sites(tree))
    order = list(range(count))
    random.Random(f"{seed} {path.name}").shuffle(order)  # noqa: S311
    found: list[Mutant] = []
    for number in order:
        if len(found) == each:
            break
        changed = copy.deepcopy(tree)
        node = next(node for i, node in enumerate(sites(changed)) if i == number)
        before, line = ast.unparse(node), getattr(node, "lineno", 0)
        if change(node):
            after = ast.unparse(ast.fix_missing_locations(node))
            found.append(Mutant(path, line, before, after, ast.unparse(changed)))
    return found


def first_tests(project: Path, module: Path, tests: list[str]) -> list[str]:
    """Order the test files of a folder: those that name the module come first."""
    files = [f for test in tests for f in sorted((project / test).rglob("test_*.py"))]
    files += [project / test for test in tests if test.endswith(".py")]
    name = module.stem
    return [str(f) for f in sorted(files, key=lambda f: name not in f.read_text("utf-8"))]


def killed(project: Path, mutant: Mutant, tests: list[str]) -> bool:
    """Run the tests with a mutant in the place of its module."""
    place = project / mutant.path.relative_to(PROJECT)
    original = place.read_text(encoding="utf-8")
    place.write_text(mutant.text, encoding="utf-8")
    try:
        return run_tests(project, first_tests(project, mutant.path, tests)) != 0
    finally:
        place.write_text(original, encoding="utf-8")


def run_tests(project: Path, tests: list[str]) -> int:
    """Run tests in a fork of this process, which has loaded the libraries; return its exit code."""
    child = os.fork()
    if not child:
        os.setsid()
        _run_in_fork(project, tests)
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -signal.SIGKILL


def _run_in_fork(project: Path, tests: list[str]) -> None:
    code = 1
    try:
        silence = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):
            os.dup2(silence, stream)
        os.chdir(project)
        sys.path.insert(0, str(project))
        os.environ |= {"PYTHONPATH": str(project), "PYTHONDONTWRITEBYTECODE": "1"}
        sys.dont_write_bytecode = True
        without = [f"no:{plugin}" for plugin in ("randomly", "cacheprovider", "xdist")]
        plugins = [word for name in without for word in ("-p", name)]
        code = pytest.main(["-x", "-q", *plugins, "--hypothesis-profile=mutants", *tests])
    finally:
        os._exit(int(code))


def load_libraries() -> None:
    """Load what the tests load, but for the package itself; examples need not be made smaller."""
    for name in LIBRARIES:
        importlib.import_module(name)
    settings.register_profile(
        "mutants",
        derandomize=True,
        deadline=None,
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=[HealthCheck.too_slow],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--folder", choices=TESTED_BY, action="append")
    parser.add_argument("--module", help="only the modules with this name")
    parser.add_argument("--each", type=int, default=3, help="mutants of each module")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--show", action="store_true", help="show the mutants, run nothing")
    options = parser.parse_args()
    load_libraries()
    with tempfile.TemporaryDirectory() as folder:
        project = Path(folder)
        for part in PARTS:
            copied = shutil.copytree if (PROJECT / part).is_dir() else shutil.copy
            copied(PROJECT / part, project / part)
        for name in options.folder or TESTED_BY:
            score(project, name, options)


def score(project: Path, name: str, options: argparse.Namespace) -> None:
    """Try the mutants of a folder; print those that survive, and the score."""
    started, dead, tried = time.monotonic(), 0, 0
    if not options.show and run_tests(project, [str(project / test) for test in TESTED_BY[name]]):
        raise SystemExit(f"{name}: the tests fail as it is: {' '.join(TESTED_BY[name])}")
    for path in sorted((PROJECT / "fleet_slip" / name).glob("*.py")):
        if options.module and path.stem != options.module:
            continue
        for mutant in mutants(path, options.each, options.seed):
            where = f"{path.relative_to(PROJECT)}:{mutant.line}"
            what = f"{mutant.before!r} -> {mutant.after!r}"
            if options.show:
                print(where, what[:300])
                continue
            tried += 1
            if killed(project, mutant, TESTED_BY[name]):
                dead += 1
            else:
                print(f"survived: {where}: {what[:300]}", flush=True)
    print(
        f"{name}: {dead} of {tried} mutants killed, {time.monotonic() - started:.0f} s", flush=True
    )


if __name__ == "__main__":
    main()
