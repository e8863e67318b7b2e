"""How functions are compiled, and where the compiled code is kept."""

import json
import os
import sys
from pathlib import Path

import pytest

from fleet_slip import caches
from tests.support.commands import Finished, run

SOURCE = """
from fleet_slip.compiling import kernel

@kernel
def half(x):
    return x / 2

assert half(3.0) == 1.5
print(*half.stats.cache_hits.values())
"""


def halve(folder: Path, cache: Path, **environment: str) -> Finished:
    """Compile a function in another process, or read its code; it prints 1 if that was kept."""
    (folder / "halving.py").write_text(SOURCE)
    given = {**os.environ, "NUMBA_CACHE_DIR": str(cache), **environment}
    done = run(
        [sys.executable, str(folder / "halving.py")], env=given, cwd=Path(__file__).parents[2]
    )
    assert done.exit_code == 0, done.stderr
    return done


def kept(cache: Path, suffix: str) -> Path:
    (file,) = cache.glob(f"{caches.PREFIX}*/*/*{suffix}")
    return file


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """A folder of this user, with the code of a function."""
    folder = tmp_path / "cache"
    halve(tmp_path, folder)
    return folder


def test_compiled_code_is_kept_and_found(cache: Path, tmp_path: Path) -> None:
    again = halve(tmp_path, cache)
    assert (again.stdout.strip(), again.stderr) == ("1", "")
    kept(cache, ".nbc").unlink()
    assert halve(tmp_path, cache).stdout.strip() == ""
    assert halve(tmp_path, cache).stdout.strip() == "1"


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", ["torn", "flipped"])
def test_damaged_code_is_compiled_anew(
    cache: Path, tmp_path: Path, suffix: str, damage: str
) -> None:
    """A power cut leaves files empty or torn: numba renames them without flushing."""
    file = kept(cache, suffix)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content if damage == "flipped" else b"")
    assert halve(tmp_path, cache).stdout.strip() == ""
    assert halve(tmp_path, cache).stdout.strip() == "1"


def run_if_unpickled(cache: Path, mark: Path) -> None:
    """Plant what makes a file when numba reads the code, and its checksum."""
    file = kept(cache, ".nbi")
    file.write_bytes(f"cos\nsystem\n(S'touch {mark}'\ntR.".encode())
    folder = file.parents[1]
    sums = json.dumps(caches._checksums(folder))
    (folder / caches.CHECKSUMS).write_text(sums)


def test_code_that_others_may_have_written_is_not_read(cache: Path, tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    run_if_unpickled(cache, mark)
    for mode in (0o777, 0o770):
        cache.chmod(mode)
        done = halve(tmp_path, cache)
        assert done.stdout.strip() == ""
        assert f"others than this user can write {cache}" in done.stderr
        assert "Set NUMBA_CACHE_DIR" in done.stderr
    assert not mark.exists()
    cache.chmod(0o700)
    (tmp_path / "link").symlink_to(cache)
    tmp_path.chmod(0o777)
    assert f"can write {tmp_path}" in halve(tmp_path, tmp_path / "link").stderr
    tmp_path.chmod(0o700)
    assert not mark.exists()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder away")
def test_nor_is_code_in_a_folder_of_another_user(cache: Path, tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    run_if_unpickled(cache, mark)
    (own,) = cache.iterdir()
    for folder in (own, cache):
        os.chown(folder, 12345, 12345)
        assert f"can write {folder}" in halve(tmp_path, cache).stderr
        os.chown(folder, 0, 0)
    assert not mark.exists()


def test_beside_others_a_folder_of_this_user_is_safe_where_nobody_else_can_rename_it(
    cache: Path, tmp_path: Path
) -> None:
    cache.chmod(0o1777)
    assert halve(tmp_path, cache).stdout.strip() == "1"


def test_where_nothing_can_be_kept_a_kernel_compiles_and_says_so_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = halve(tmp_path, tmp_path / "file")
    assert done.stderr.count("there is no folder where compiled code can be kept") == 1


def test_a_change_of_any_source_and_of_the_compiler_takes_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kernel has constants and functions of other modules in it."""
    monkeypatch.setattr(caches, "PACKAGE", tmp_path)
    (tmp_path / "vehicle").mkdir()
    digests = set()
    for text in ("one", "other"):
        (tmp_path / "vehicle" / "pose.py").write_text(text)
        digests |= {caches.digest_sources(version) for version in ("1", "2")}
    assert len(digests) == 4


LANES = """
from fleet_slip.vehicle.batch_kernel import simulate, simulate_imperfect

for kernel in (simulate, simulate_imperfect):
    print(kernel._cache._index_key("signature", kernel.targetctx.codegen()))
"""


def test_another_process_finds_the_code_of_the_lanes_by_the_same_key() -> None:
    one, other = (run([sys.executable, "-c", LANES]) for _ in range(2))
    assert len(set(one.stdout.splitlines())) == 2
    assert other.stdout == one.stdout
