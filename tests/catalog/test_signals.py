import os
import re
from decimal import Decimal
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_slip.catalog.signals import Signal, SignalCatalog
from fleet_slip.config import load_config
from fleet_slip.errors import ConfigError, QuestionError
from fleet_slip.resources import folder
from tests.support.catalog import SIGNALS, configs_with
from tests.support.commands import RunCommand

SHIPPED = (folder("configs") / "signals.toml").read_text()


def edited(tmp_path: Path, old: str, new: str) -> Path:
    assert SHIPPED.count(old) >= 1
    file = tmp_path / "signals.toml"
    file.write_text(SHIPPED.replace(old, new, 1))
    return file


def test_the_paper_s_signals_are_inputs_and_side_slip_is_the_label() -> None:
    signals = SIGNALS
    assert signals.inputs == (
        "ax", "ay", "yaw_rate", "steering_wheel",
        "wheel_fl", "wheel_fr", "wheel_rl", "wheel_rr", "steer_fl", "steer_fr",
    )  # fmt: skip
    assert signals.label == "sideslip"
    assert {name for name, s in signals.signals.items() if s.role == "truth"} >= {"vx", "vy"}


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ('unit = "m/s^2"', 'unit = "km/h"', "signals.ax.unit"),
        ("scale = 0.001", "scale = 0.0001", "signals.ax: the range needs counts up to 300000"),
        ("scale = 0.001", "scale = 0", "signals.ax.scale"),
        ("min = -30.0", "min = 31.0", "signals.ax: min 31.0 is not below max 30.0"),
        ('role = "input"', 'role = "label"', "exactly one signal must have the role 'label'"),
        ('column = "ay_mps2"', 'column = "ax_mps2"', "names must differ: ax_mps2"),
        ("[signals.ax]", '[signals."ax; DROP"]', "signals.ax; DROP"),
        ("description", "descripton", "signals.ax.descripton: unknown key"),
        ("[signals.ax]", "[signals.ax", "not valid TOML"),
    ],
)
def test_a_mistake_is_told_with_file_key_and_reason(
    tmp_path: Path, old: str, new: str, fault: str
) -> None:
    file = edited(tmp_path, old, new)
    with pytest.raises(ConfigError) as caught:
        load_config(file, SignalCatalog)
    assert str(file) in str(caught.value)
    assert fault in str(caught.value)


def test_a_missing_catalog_and_an_unknown_signal_are_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        load_config(tmp_path / "none.toml", SignalCatalog)
    with pytest.raises(QuestionError, match=r"unknown signal 'beta'. Known signals: ax, ay"):
        SIGNALS["beta"]


@given(
    scale=st.decimals("0.00001", "0.01", places=5),
    low=st.integers(-30000, -1),
    high=st.integers(1, 30000),
)
def test_valid_counts_are_those_whose_physical_value_is_in_range(
    scale: Decimal, low: int, high: int
) -> None:
    signal = Signal(
        unit="m", column="x_m", scale=scale, min=low * scale, max=high * scale, role="input",
        description="x",
    )  # fmt: skip
    assert (signal.min_count, signal.max_count) == (low, high)
    assert signal.exact_scale * high <= signal.max


def reordered(text: str) -> str:
    """Return a catalog with its signals, and its drive columns, in reverse order."""
    comment, *tables = re.split(r"(?m)^(?=\[)", text)
    kinds = ("[signals.", "[drive.")
    tables = [table if table.endswith("\n") else table + "\n" for table in tables]
    sorted_out = [[t for t in tables if t.startswith(kind)] for kind in kinds]
    assert sum(map(len, sorted_out)) == len(tables)
    return comment + "".join(t for group in sorted_out for t in reversed(group))


@pytest.fixture
def other(tmp_path: Path) -> dict[str, str]:
    """The environment of a user whose signals are in reverse order."""
    text = reordered((folder("configs") / "signals.toml").read_text())
    configs = configs_with(tmp_path / "configs", signals=text)
    return {**os.environ, "FLEET_SLIP_CONFIG": str(configs.folder)}


def test_an_order_of_signals_is_no_damage(
    run_command: RunCommand, other: dict[str, str], smoke_copy: Path
) -> None:
    report = run_command("verify", "--grams", "--json", env=other).json["grams"]
    assert report["drives"] >= report["files"] > 0 < report["wide_drives"]
    for name in ("signals", "windows"):
        after = run_command("gram", "--features", name, "--json", env=other).json
        assert (after["files_read"], after["files_dropped"]) == (0, 0)


@pytest.mark.long
def test_models_and_rewritten_files_do_not_depend_on_the_order(
    run_command: RunCommand, other: dict[str, str], smoke_copy: Path
) -> None:
    chosen = [run_command("select", "--json", **options).json for options in ({}, {"env": other})]
    assert chosen[0]["models"] == chosen[1]["models"]
    assert run_command("compact", env=other).exit_code == 0
    for environment in ({}, {"env": other}):
        done = run_command("verify", "--full", **environment)
        assert done.exit_code == 0, done.stderr
