"""The list of checks, and its table on the page about faulty sensors."""

import re
from pathlib import Path

from fleet_slip.quality import checks
from fleet_slip.quality.checks import CHECKS, Check, Data

PAGE = Path(__file__).parents[2] / "docs/quality.md"
PACKAGE = Path(__file__).parents[2] / "fleet_slip"


def bound(check: Check) -> str:
    low, high = (f"{value:.3g}" for value in check.threshold)
    if (low, high) == ("-inf", "inf"):
        text = check.source
    elif high == "inf":
        text = f"at least {low} {check.unit}"
    elif low == "-inf":
        text = f"at most {high} {check.unit}"
    else:
        text = f"{low} to {high} {check.unit}"
    return text or "–"


def row(check: Check) -> str:
    data = ", ".join(check.data)
    return f"| {check.name} | {check.kind} | {check.scope} | {data} | {bound(check)} |"


def test_the_page_lists_the_checks_with_their_thresholds() -> None:
    table = "\n".join(map(row, CHECKS))
    assert table in PAGE.read_text(), f"the table of docs/quality.md should be:\n{table}"


def test_each_check_has_a_name_a_remedy_and_a_place_where_it_runs() -> None:
    assert len({check.name for check in CHECKS}) == len(CHECKS)
    source = "".join(path.read_text() for path in PACKAGE.rglob("*.py") if path.name != "checks.py")
    for check in CHECKS:
        assert check.remedy and check.data, check.name
        assert set(check.data) <= set(Data)
    names = {name for name, value in vars(checks).items() if isinstance(value, Check)}
    assert len(names) == len(CHECKS)
    used = {name for name in names if len(re.findall(rf"\b{name}\b", source)) > 1}
    assert sorted(names - used) == []
