"""How functions are compiled."""

from pathlib import Path
from typing import Any

import pytest

from fleet_slip.vehicle import kernel as lanes
from fleet_slip.vehicle.compiling import kernel


def test_a_kernel_compiles_where_nothing_can_be_kept_on_disk() -> None:
    """A function without a file has no place for its compiled code, as in a read-only system."""
    names: dict[str, Any] = {}
    exec("def half(x): return x / 2", names)  # noqa: S102
    assert kernel(names["half"])(3.0) == 1.5


def test_a_change_of_any_source_changes_the_key_of_the_kept_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("kernel.py", "tyre.py"):
        (tmp_path / name).write_text("one")
    monkeypatch.setattr(lanes, "__file__", str(tmp_path / "kernel.py"))
    before = lanes._source_digest()
    assert lanes._source_digest() == before
    (tmp_path / "tyre.py").write_text("other")
    assert lanes._source_digest() != before
