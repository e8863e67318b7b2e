"""How functions are compiled, and where the compiled code is kept."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from fleet_slip import compiling
from tests.support.commands import Finished, run

SOURCE = """
from fleet_slip.compiling import kernel

@kernel
def half(x):
    return x / 2

assert half(3.0) == 1.5
print(*half.stats.cache_hits.values())
"""


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of this user, with the code of a function that stands beside it."""
    folder = tmp_path_factory.mktemp("compiled") / "cache"
    folder.with_name("halving.py").write_text(SOURCE)
    halve(folder, folder)
    return folder


def halve(compiled: Path, cache: Path) -> Finished:
    """Compile the function in another process, or read its code; it prints 1 if that was kept."""
    done = run(
        [sys.executable, str(compiled.with_name("halving.py"))],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache)},
        cwd=Path(__file__).parents[2],
    )
    assert done.exit_code == 0, done.stderr
    return done


@pytest.fixture
def cache(compiled: Path, tmp_path: Path) -> Path:
    """A copy of the folder, which a test may change."""
    return shutil.copytree(compiled, tmp_path / "cache")


def stored_code(cache: Path, suffix: str) -> Path:
    (file,) = cache.glob(f"{compiling.PREFIX}*/*/*{suffix}")
    return file


def test_compiled_code_is_kept_and_found(compiled: Path) -> None:
    again = halve(compiled, compiled)
    assert (again.stdout.strip(), again.stderr) == ("1", "")


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", ["torn", "flipped"])
def test_damaged_code_is_deleted(
    cache: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, damage: str
) -> None:
    """A power cut leaves files empty or torn: numba renames them without flushing."""
    file = stored_code(cache, suffix)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content if damage == "flipped" else b"")
    found_by(cache, monkeypatch)
    assert not file.exists()


def found_by(cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path | None:
    """Return which folder a process is given that asks for it now."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    monkeypatch.setattr("fleet_slip.compiling.atexit.register", lambda *_: None)
    (user_folder,) = cache.glob(f"{compiling.PREFIX}*")
    return compiling.code_folder.__wrapped__(user_folder.name.removeprefix(compiling.PREFIX))


def run_if_unpickled(cache: Path, mark: Path) -> None:
    """Plant what makes a file when numba reads the code, and its checksum."""
    file = stored_code(cache, ".nbi")
    file.write_bytes(f"cos\nsystem\n(S'touch {mark}'\ntR.".encode())
    folder = file.parents[1]
    sums = json.dumps(compiling._checksums(folder))
    (folder / compiling.CHECKSUMS).write_text(sums)


def test_code_that_others_may_have_written_is_not_read(
    compiled: Path, cache: Path, tmp_path: Path
) -> None:
    mark = tmp_path / "ran"
    run_if_unpickled(cache, mark)
    cache.chmod(0o770)
    done = halve(compiled, cache)
    assert done.stdout.strip() == ""
    assert f"other users can write {cache}" in done.stderr
    assert "Set NUMBA_CACHE_DIR" in done.stderr
    assert done.stderr.count("compiled code cannot be cached") == 1
    assert not mark.exists()


def test_a_folder_is_refused_that_others_can_write_or_put_another_in_its_place(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(compiling.LOGGER, "propagate", True)
    (user_folder,) = cache.iterdir()
    assert found_by(cache, monkeypatch) == user_folder
    cache.chmod(0o1777)  # as /tmp is: nobody else can rename what is in it
    assert found_by(cache, monkeypatch) == user_folder
    assert not caplog.messages
    cache.chmod(0o777)
    assert found_by(cache, monkeypatch) is None
    assert f"other users can write {cache}" in caplog.text
    cache.chmod(0o700)
    (tmp_path / "link").symlink_to(cache)
    tmp_path.chmod(0o777)
    assert found_by(tmp_path / "link", monkeypatch) is None
    assert f"can write {tmp_path}" in caplog.text
    tmp_path.chmod(0o700)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(stored_code(cache, ".nbi")))  # no folder
    assert compiling.code_folder.__wrapped__("0") is None


def test_a_change_of_what_a_kernel_imports_or_of_the_compiler_takes_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kernel has constants and functions of other modules in it, and of no others."""
    monkeypatch.setattr(compiling, "PACKAGE", tmp_path)
    sources = {
        "kernel": "from fleet_slip.vehicle.pose import (\n    angle,\n)\n",
        "vehicle/pose": "    from fleet_slip.parts import speed\n",
        "parts/speed": "UNIT = 1\n",
        "beside": "import fleet_slip.kernel\n",
    }

    def digest(**changed: str) -> str:
        compiling._imported.cache_clear()
        for name, text in {**sources, **changed}.items():
            file = tmp_path / f"{name}.py"
            file.parent.mkdir(exist_ok=True)
            file.write_text(text)
        return compiling.digest_sources(tmp_path / "kernel.py")

    before = digest()
    assert digest(beside="changed") == digest() == before
    digests = {digest(**{name: f"{sources[name]}# changed"}) for name in [*sources][:3]}
    assert len(digests | {before}) == 4
    monkeypatch.setattr("numba.__version__", "another")
    assert digest() not in digests | {before}
    compiling._imported.cache_clear()
