"""Processor time of tests: the slowest, and the folders beyond `tests/budget.toml`."""

import resource
import tomllib
from collections import Counter
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

BUDGET = Path(__file__).parents[1] / "budget.toml"
DEAREST = 20


def processor_s() -> float:
    """Return what this process has taken, and those that it started and that have ended."""
    process, ended = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return process.ru_utime + process.ru_stime + ended.ru_utime + ended.ru_stime


class Budget:
    """Adds up what tests take, in the process that reports."""

    def __init__(self) -> None:
        self._taken = Counter[str]()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Generator[None, object, object]:
        item.user_properties.append(("began_at", processor_s()))
        return (yield)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_teardown(self, item: pytest.Item) -> Generator[None, object, object]:
        try:
            return (yield)
        finally:
            item.user_properties.append(("ended_at", processor_s()))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":
            at: dict[str, Any] = dict(report.user_properties)
            self._taken[report.nodeid] += at["ended_at"] - at["began_at"]

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        if self._taken.total() < 100:  # a few tests that somebody works at
            return
        write = terminalreporter.write_line
        write(f"{self._taken.total():.0f} s of processors, the dearest tests:")
        for name, seconds in self._taken.most_common(DEAREST):
            write(f"{seconds:6.1f} {name}")
        for folder, allowed_s in tomllib.loads(BUDGET.read_text("utf-8"))["processor_s"].items():
            prefix = f"tests/{folder}/"
            took_s = sum(s for name, s in self._taken.items() if name.startswith(prefix))
            if took_s > allowed_s:
                write(f"{prefix}: {took_s:.0f} s of processors, and its budget is {allowed_s}")
