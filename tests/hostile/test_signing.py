"""Signed model versions: made with one key, refused with any other, and not needed by default."""

import json
import os
import stat
from fractions import Fraction
from pathlib import Path

import pytest

from fleet_slip.errors import ConfigError, RefusedError
from fleet_slip.files.documents import checksum
from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.models.signing import VERIFY_VARIABLE, make_keys
from fleet_slip.models.versions import Registry
from tests.support.commands import RunCommand
from tests.support.logs import path_of
from tests.support.manifests import manifest, publish

pytest.importorskip("cryptography", reason="signatures need the extra 'signing'")


@pytest.fixture
def key(tmp_path: Path) -> Path:
    make_keys(tmp_path / "key")
    return tmp_path / "key"


@pytest.fixture
def signed(tmp_path: Path, key: Path, monkeypatch: pytest.MonkeyPatch) -> Registry:
    """A registry with one signed version, where signatures are asked for."""
    registry = Registry(LocalFolder(tmp_path / "models"), key)
    publish(registry, manifest())
    monkeypatch.setenv(VERIFY_VARIABLE, f"{key}.pub")
    return registry


def version_file(registry: Registry, number: int = 1, suffix: str = "json") -> Path:
    return path_of(registry.folder) / manifest().name / "versions" / f"{number}.{suffix}"


def test_keys_are_private_and_never_replaced(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        public = make_keys(tmp_path / "key")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "key").stat().st_mode) == 0o600
    assert stat.S_IMODE(public.stat().st_mode) == 0o644
    before = (tmp_path / "key").read_bytes()
    with pytest.raises(ConfigError, match="never replaced"):
        make_keys(tmp_path / "key")
    assert (tmp_path / "key").read_bytes() == before


def test_a_signed_version_is_loaded(signed: Registry) -> None:
    assert signed.load(manifest().name, 1).manifest == manifest()
    assert signed.champion(manifest().name) is not None


def test_a_signature_leaves_the_document_as_it_is(signed: Registry, tmp_path: Path) -> None:
    unsigned = Registry(LocalFolder(tmp_path / "others"))
    publish(unsigned, manifest())
    assert version_file(signed).read_bytes() == version_file(unsigned).read_bytes()
    assert not version_file(unsigned, suffix="sig").exists()


def test_a_forged_manifest_is_refused_although_its_checksum_is_right(signed: Registry) -> None:
    file = version_file(signed)
    document = json.loads(file.read_text())
    document["content"] |= {"intercept": 0.25, "intercept_exact": "1/4"}
    document["sha256"] = checksum(document["content"])
    file.write_text(json.dumps(document))
    with pytest.raises(RefusedError, match="is not what the key"):
        signed.load(manifest().name, 1)


def test_a_signed_version_cannot_take_another_number(signed: Registry) -> None:
    for suffix in ("json", "sig"):
        version_file(signed, 2, suffix).write_bytes(version_file(signed, 1, suffix).read_bytes())
    with pytest.raises(RefusedError, match="is not what the key"):
        signed.load(manifest().name, 2)


@pytest.mark.parametrize("content", [b"", b"AAAA", b"\xff", b"A" * 100_000])
def test_a_damaged_signature_is_refused(signed: Registry, content: bytes) -> None:
    version_file(signed, suffix="sig").write_bytes(content)
    with pytest.raises(RefusedError):
        signed.load(manifest().name, 1)


def test_another_key_is_refused(
    signed: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = make_keys(tmp_path / "other")
    monkeypatch.setenv(VERIFY_VARIABLE, str(other))
    with pytest.raises(RefusedError, match="another key"):
        signed.load(manifest().name, 1)


def test_an_unsigned_version_is_refused_until_it_is_signed(
    tmp_path: Path, key: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish(Registry(LocalFolder(tmp_path / "models")), manifest())
    monkeypatch.setenv(VERIFY_VARIABLE, f"{key}.pub")
    registry = Registry(LocalFolder(tmp_path / "models"), key)
    with pytest.raises(RefusedError, match=r"is not signed.*fleet-slip sign"):
        registry.load(manifest().name, 1)
    registry.sign(manifest().name, 1)
    assert registry.load(manifest().name, 1).version == 1


@pytest.mark.parametrize("name", ["", " "])
def test_an_empty_name_of_a_key_does_not_switch_verification_off(
    signed: Registry, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv(VERIFY_VARIABLE, name)
    with pytest.raises(ConfigError, match="is set and empty"):
        signed.load(manifest().name, 1)


def test_keys_that_are_none_are_told_without_quoting_them(
    signed: Registry, tmp_path: Path, key: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        signed.sign(manifest().name, 1)
    for content in (b"", b"SECRET", key.read_bytes().replace(b"M", b"SECRET", 1)):
        bad = tmp_path / "bad"
        bad.touch(0o600)
        bad.write_bytes(content)
        with pytest.raises(ConfigError, match="Ed25519 private key") as raised:
            Registry(signed.folder, bad).sign(manifest().name, 1)
        assert "SECRET" not in str(raised.value)
        monkeypatch.setenv(VERIFY_VARIABLE, str(bad))
        with pytest.raises(ConfigError, match="Ed25519 public key"):
            signed.load(manifest().name, 1)


def test_a_key_that_cannot_sign_leaves_no_version_behind(signed: Registry, key: Path) -> None:
    key.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        publish(signed, manifest(Fraction(1, 2)))
    assert signed.versions(manifest().name) == [1]


def test_there_is_no_way_back_to_what_is_not_signed(signed: Registry, key: Path) -> None:
    publish(signed, manifest(Fraction(1, 2)))
    version_file(signed, suffix="sig").unlink()
    with pytest.raises(RefusedError, match="not signed"):
        signed.rollback(manifest().name, "champion")
    assert signed.history(manifest().name).aliases() == {"champion": 2}


def test_the_command_line_makes_keys_signs_and_refuses(
    run_command: RunCommand, tmp_path: Path
) -> None:
    made = run_command("keygen", "mine")
    assert made.exit_code == 0
    assert "\\n" not in made.stderr
    assert (tmp_path / "mine").read_text().splitlines()[1] not in made.stderr
    publish(Registry(LocalFolder(tmp_path / "data" / "models")), manifest())
    asking = {**os.environ, VERIFY_VARIABLE: "mine.pub"}
    name = manifest().name
    assert run_command("show", name, env=asking).exit_code == 7
    assert "not signed" in run_command("verify", env=asking).stdout
    assert "not signed" in run_command("status", env=asking).stderr
    assert run_command("sign", f"{name}@1").exit_code == 2
    assert run_command("sign", f"{name}@1", "--sign-key", "mine").exit_code == 0
    assert run_command("show", name, env=asking).exit_code == 0
    assert "not signed" not in run_command("verify", env=asking).stdout
    missing = {**os.environ, VERIFY_VARIABLE: "none.pub"}
    assert run_command("verify", env=missing).exit_code == 3
    history = "".join(f.read_text() for f in (tmp_path / "data").rglob("*.jsonl"))
    assert "PRIVATE" not in history
