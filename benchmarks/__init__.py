"""Measurements of speed, scale and accuracy. A missing package ends in one sentence."""

import sys
from types import TracebackType


def _say(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    package = (error.name or "").partition(".")[0] if isinstance(error, ImportError) else ""
    if isinstance(error, ModuleNotFoundError) and package != "fleet_slip":
        print(
            f"This benchmark needs the package {package}, which is not installed. "
            "Run: pip install -e . --group dev -c constraints.txt",
            file=sys.stderr,
        )
    elif kind.__name__ == "ExtraError":
        print(error, file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


if sys.argv[:1] == ["-m"]:  # a benchmark is run, none is imported
    sys.excepthook = _say
