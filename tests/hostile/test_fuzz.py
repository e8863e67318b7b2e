"""Each target of the long fuzz run, briefly, with choices that hypothesis steers and shrinks."""

import random
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fleet_slip.errors import FleetSlipError
from tests.support.fuzz.targets import TARGETS

EXAMPLES = {"csv": 60, "parquet": 60, "config": 100, "sql": 60, "manifest": 40}
FEW = 6
AT_ONCE = ("csv", "parquet")
"""The targets that `make test` attacks as well."""


@pytest.fixture(scope="module")
def sandbox(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize(
    ("name", "examples"),
    [
        *((name, EXAMPLES[name] // 3) for name in AT_ONCE),
        *(pytest.param(n, EXAMPLES.get(n, FEW), marks=pytest.mark.long) for n in TARGETS),
    ],
)
def test_hostile_input_is_answered_or_refused(name: str, examples: int, sandbox: Path) -> None:
    target, _ = TARGETS[name]

    @settings(max_examples=examples, database=None, suppress_health_check=list(HealthCheck))
    @given(st.randoms(use_true_random=False))
    def attack(rng: random.Random) -> None:
        with TemporaryDirectory(dir=sandbox) as folder:
            try:
                target(rng, Path(folder))
            except FleetSlipError as error:
                assert str(error).isprintable()

    attack()
    assert {entry.name for entry in sandbox.iterdir()} <= {"template", "list.toml"}
