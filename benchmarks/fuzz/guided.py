"""One target guided by coverage: python -m benchmarks.fuzz.guided config -runs=20000.

Needs atheris: pip install --group fuzz --constraint constraints.txt. What follows the target's name
goes to libFuzzer; -len_control=0 -max_len=4096 and a folder for the corpus are useful.
"""

import importlib
import sys
import tempfile
from pathlib import Path

import atheris

from tests.support.fuzz.mutate import ByteRandom

INSTRUMENTED = ("fleet_slip", "tomllib", "json")


def main() -> None:
    """Instrument the package, then feed the target until libFuzzer stops."""
    name, *options = sys.argv[1:]
    with atheris.instrument_imports(include=list(INSTRUMENTED)):
        targets = importlib.import_module("tests.support.fuzz.targets")
        errors = importlib.import_module("fleet_slip.errors")
    target, _ = targets.TARGETS[name]
    sandbox = Path(tempfile.mkdtemp(prefix="fleet-slip-fuzz-"))

    def one(data: bytes) -> None:
        with tempfile.TemporaryDirectory(dir=sandbox) as folder:
            try:
                target(ByteRandom(data), Path(folder))
            except errors.FleetSlipError as error:
                if not str(error).isprintable():
                    raise AssertionError(repr(str(error))) from error

    atheris.Setup([sys.argv[0], *options], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
