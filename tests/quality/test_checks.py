"""The list of checks, and its table on the page about faulty sensors."""

import re
from pathlib import Path

from fleet_slip.quality.checks import CHECKS, Check

PAGE = Path(__file__).parents[2] / "docs/quality.md"
PACKAGE = Path(__file__).parents[2] / "fleet_slip"


def bound(check: Check) -> str:
    low, high = f"{check.low:.3g}", f"{check.high:.3g}"
    if (low, high) == ("-inf", "inf"):
        text = check.source
    elif high == "inf":
        text = f"at least {low} {check.unit}"
    elif low == "-inf":
        text = f"at most {high} {check.unit}"
    else:
        text = f"{low} to {high} {check.unit}"
    return text or "–"


def row(name: str, check: Check) -> str:
    return f"| {name} | {check.kind} | {check.scope} | {', '.join(check.reads)} | {bound(check)} |"


def test_the_page_lists_the_checks_with_their_thresholds() -> None:
    table = "\n".join(row(name, check) for name, check in CHECKS.items())
    assert table in PAGE.read_text(), f"the table of docs/quality.md should be:\n{table}"


def test_each_check_runs_and_each_that_runs_is_in_the_table() -> None:
    source = "".join(path.read_text() for path in PACKAGE.rglob("*.py"))
    keys = re.findall(r"CHECKS\[(.+?)\]", source, re.DOTALL)
    names = {name for key in keys for name in re.findall(r'"([^"]+)"', key)}
    assert names <= set(CHECKS)
    for name, check in CHECKS.items():
        assert f'"{name}"' in source, name
        assert check.remedy, name
        assert check.scope in {"row", "drive", "label", "peers"}, name
        assert {"log", "rows", "Gram rows"}.issuperset(check.reads), name
