"""Optional signatures of model versions: Ed25519, over what a version is called and contains.

    models/<name>/versions/1.sig     the signature of 1.json, in base64

A checksum finds damage, but whoever writes the data root can compute it anew; a signature needs the
private key. Number and name are signed too: no version can take another's place.
"""

import base64
import os
import stat
from pathlib import Path
from types import ModuleType

from fleet_slip.config import read_named_file
from fleet_slip.errors import ConfigError, RefusedError, StorageError
from fleet_slip.extras import needed
from fleet_slip.files.folder import Folder

SIGNING_VARIABLE = "FLEET_SLIP_SIGNING_KEY"
"""Environment variable: path of the private key that new versions are signed with."""

VERIFY_VARIABLE = "FLEET_SLIP_VERIFY_KEY"
"""Environment variable: path of the public key. If it is set, versions must have its signature."""

PRIVATE_MODE = 0o600
PUBLIC_MODE = 0o644
LONGEST_FILE_BYTES = 10_000


def make_keys(private: Path) -> Path:
    """Write a new private key and, beside it, its `.pub`; return that. Raises `ConfigError`."""
    public = private.with_name(private.name + ".pub")
    for path in (private, public):
        if os.path.lexists(path):
            raise ConfigError(f"{path}: exists, and keys are never replaced. Choose another name.")
    secret, known = _ed25519().generate()
    _write_new(private, secret, PRIVATE_MODE)
    _write_new(public, known, PUBLIC_MODE)
    return public


def require_signing_key(key: Path) -> None:
    """Raise `ConfigError` for a private key that cannot be used."""
    _signed(key, b"")


def sign_version(folder: Folder, number: int, name: str, sha256: str, key: Path) -> None:
    """Write the signature of a version beside it, durably. Raises `ConfigError` for the key."""
    signature = _signed(key, _message(number, name, sha256))
    folder.put(f"{number}.sig", base64.b64encode(signature) + b"\n")


def require_signature(folder: Folder, number: int, name: str, sha256: str) -> None:
    """Raise `RefusedError` if $FLEET_SLIP_VERIFY_KEY is set and did not sign this version."""
    configured = os.environ.get(VERIFY_VARIABLE)
    if configured is None:
        return
    if not configured.strip():
        raise ConfigError(
            f"${VERIFY_VARIABLE} is set and empty. Name the public key, or unset it: an empty name "
            "does not switch verification off."
        )
    public = _read_key(Path(configured))[0]
    shown, file = f"{name}@{number}", f"{number}.sig"
    if file not in folder.names():
        raise RefusedError(
            f"{shown} is not signed, and ${VERIFY_VARIABLE} asks for a signature. If the version "
            f"is yours: fleet-slip sign {shown} --sign-key FILE"
        )
    try:
        signature = base64.b64decode(folder.read(file, longest=LONGEST_FILE_BYTES))
    except (StorageError, ValueError) as error:
        raise RefusedError(f"{folder}/{file}: not a signature: {error}") from None
    try:
        signed = _ed25519().is_signed(public, signature, _message(number, name, sha256))
    except ValueError:
        raise ConfigError(
            f"{configured}: not an Ed25519 public key in PEM. ${VERIFY_VARIABLE} must name the "
            ".pub file that fleet-slip keygen wrote."
        ) from None
    if not signed:
        raise RefusedError(
            f"{shown} is not what the key {configured} signed: it was changed, or signed with "
            "another key. Do not use it."
        )


def _message(number: int, name: str, sha256: str) -> bytes:
    return f"fleet-slip model version\n{name}\n{number}\n{sha256}\n".encode()


def _signed(key: Path, message: bytes) -> bytes:
    secret = _read_private_key(key)
    try:
        signature = _ed25519().sign_message(secret, message)
    except ValueError:
        raise ConfigError(
            f"{key}: not an unencrypted Ed25519 private key in PEM. Make one with: fleet-slip "
            "keygen FILE"
        ) from None
    return bytes(signature)


def _read_private_key(path: Path) -> bytes:
    content, mode = _read_key(path)
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"{path}: others may read this private key. Run: chmod 600 {path}")
    return content


def _read_key(path: Path) -> tuple[bytes, int]:
    return read_named_file(path), path.stat().st_mode


def _write_new(path: Path, content: bytes, mode: int) -> None:
    """Create a file that at no time had a wider mode than this."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: the key cannot be written: {error}") from None


def _ed25519() -> ModuleType:
    with needed("signing", "a signature"):
        from fleet_slip.models import ed25519  # noqa: PLC0415 - of the extra
    return ed25519
