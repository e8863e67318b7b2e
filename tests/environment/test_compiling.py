"""How functions are compiled, and where the compiled code is kept."""

import logging
import sys
from importlib import util
from pathlib import Path
from types import ModuleType

import pytest

import fleet_slip.vehicle.tyre
from fleet_slip import kept_code
from fleet_slip.vehicle.lanes import lane_kernel as lanes
from tests.support.commands import run

SOURCE = """
from fleet_slip.compiling import kernel

@kernel
def half(x):
    return x / 2
"""


@pytest.fixture(autouse=True)
def remarks_of_this_test(monkeypatch: pytest.MonkeyPatch) -> None:
    kept_code._remark.cache_clear()
    monkeypatch.setattr(logging.getLogger("fleet_slip"), "propagate", True)


def load(folder: Path, name: str = "halving") -> ModuleType:
    """Import a new module with one kernel, which numba keeps beside it."""
    (folder / f"{name}.py").write_text(SOURCE)
    spec = util.spec_from_file_location(name, folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def kept(folder: Path) -> list[Path]:
    return sorted((folder / "__pycache__").glob("halving.half*"))


def test_compiled_code_is_kept_and_found(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first = load(tmp_path).half
    assert (first(3.0), first(4.0)) == (1.5, 2.0)
    again = load(tmp_path).half
    assert again(3.0) == 1.5
    assert sum(again.stats.cache_hits.values()) == 1
    assert not caplog.messages


KEYS = """
from fleet_slip.vehicle.lanes.lane_kernel import simulate, simulate_imperfect

for kernel in (simulate, simulate_imperfect):
    print(kernel._cache._index_key("signature", kernel.targetctx.codegen()))
"""


def test_another_process_finds_the_code_of_the_lanes_by_the_same_key() -> None:
    one, other = (run([sys.executable, "-c", KEYS]) for _ in range(2))
    assert len(set(one.stdout.splitlines())) == 2
    assert other.stdout == one.stdout


def test_where_nothing_can_be_kept_a_kernel_compiles_and_says_so_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither beside the source nor below the home can a folder be made: files are in the way."""
    (tmp_path / "__pycache__").write_text("")
    monkeypatch.setenv("HOME", str(tmp_path / "__pycache__"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "__pycache__"))
    assert load(tmp_path).half(3.0) == 1.5
    assert load(tmp_path, "other").half(3.0) == 1.5
    assert len(caplog.messages) == 1
    assert "Set NUMBA_CACHE_DIR" in caplog.text


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("left", [0, 100])
def test_damaged_code_is_compiled_anew(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, suffix: str, left: int
) -> None:
    """A power cut leaves files empty or torn: numba renames them without flushing."""
    load(tmp_path).half(3.0)
    (torn,) = (file for file in kept(tmp_path) if file.suffix == suffix)
    torn.write_bytes(torn.read_bytes()[:left])
    assert load(tmp_path).half(3.0) == 1.5
    assert "damaged" in caplog.text
    mended = load(tmp_path).half
    assert mended(3.0) == 1.5
    assert sum(mended.stats.cache_hits.values()) == 1


def test_code_with_a_flipped_bit_is_not_executed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It would compute something else, or end the process."""
    half = load(tmp_path).half
    half(3.0)
    for file in kept(tmp_path):
        content = file.read_bytes()
        for bit in range(0, 8 * len(content), 997):
            flipped = bytearray(content)
            flipped[bit // 8] ^= 1 << bit % 8
            file.write_bytes(flipped)
            with pytest.raises(kept_code._DamagedCodeError):
                half._cache._cache_file._load_data(file.name)
    assert load(tmp_path).half(3.0) == 1.5
    assert "damaged" in caplog.text


def test_a_full_disk_keeps_nothing_and_fails_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    half = load(tmp_path).half

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(half._cache._cache_file, "save", full)
    assert half(3.0) == 1.5
    assert "cannot be kept (No space left on device)" in caplog.text


def test_a_change_of_any_source_changes_the_key_of_the_kept_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The equations stand in the folder above the kernel's."""
    folder = tmp_path / "vehicle" / "lanes"
    folder.mkdir(parents=True)
    kernel, tyre = folder / "lane_kernel.py", folder.parent / "tyre.py"
    for file in (kernel, tyre):
        file.write_text("one")
    assert Path(lanes.__file__).parents[1] == Path(fleet_slip.vehicle.tyre.__file__).parent
    monkeypatch.setattr(lanes, "__file__", str(kernel))
    before = lanes._source_digest()
    assert lanes._source_digest() == before
    tyre.write_text("other")
    assert lanes._source_digest() != before


def test_code_is_kept_no_longer_where_what_it_calls_in_another_folder_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Brakes and receivers, of the simulation, call equations of the vehicle."""
    package = tmp_path / "fleet_slip"
    for name, text in {
        "simulation/environment.py": "from fleet_slip.vehicle import (\n    tyre,\n)\n",
        "vehicle/tyre.py": "from fleet_slip.vehicle.pose import turn\n",
        "vehicle/pose.py": "one",
        "vehicle/driver.py": "",
    }.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    monkeypatch.setattr(kept_code, "PACKAGE", package)
    stamp = kept_code._sources_stamp.__wrapped__
    braking = str(package / "simulation" / "environment.py")
    before = stamp(braking)
    (package / "vehicle" / "driver.py").write_text("not imported")
    assert stamp(braking) == before
    (package / "vehicle" / "pose.py").write_text("other")
    assert stamp(braking) != before
