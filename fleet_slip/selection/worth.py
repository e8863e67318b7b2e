"""What a signal must gain to be worth it, as it is asked for."""

import math
import re

from fleet_slip.errors import UsageError
from fleet_slip.regression.choice.winner import Worth

WORTH = "0.005deg"
"""`fleet_slip.regression.choice.winner.DEFAULT_WORTH` as it is asked for."""

_WORTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+) ?(deg|%)")


def parse_worth(text: str) -> Worth:
    """Return a gain in RMSE from text such as `0.005deg` or `2%`. Raises `UsageError`."""
    found = _WORTH.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"worth = {text}: write an angle such as {WORTH}, or a share of the best RMSE such as "
            "2%."
        )
    amount = float(found[1])
    return Worth(amount / 100, relative=True) if found[2] == "%" else Worth(math.radians(amount))
