"""Ed25519 keys in PEM, through the library `cryptography`; nothing here touches a file."""

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

_NOT_A_KEY = (ValueError, TypeError, UnsupportedAlgorithm)


def generate() -> tuple[bytes, bytes]:
    """Return a new private key, unencrypted, and its public key."""
    key = Ed25519PrivateKey.generate()
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    public = key.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    return private, public


def sign_message(private: bytes, message: bytes) -> bytes:
    """Return the signature of a message. Raises `ValueError` if that is no such key."""
    try:
        key = serialization.load_pem_private_key(private, password=None)
    except _NOT_A_KEY:
        raise ValueError from None  # without the reason, which might quote the key
    if not isinstance(key, Ed25519PrivateKey):
        raise ValueError  # noqa: TRY004 - the bytes are of the wrong value, not the wrong type
    return bytes(key.sign(message))


def is_signed(public: bytes, signature: bytes, message: bytes) -> bool:
    """Whether the key signed the message. Raises `ValueError` if that is no such key."""
    try:
        key = serialization.load_pem_public_key(public)
    except _NOT_A_KEY:
        raise ValueError from None
    if not isinstance(key, Ed25519PublicKey):
        raise ValueError  # noqa: TRY004
    try:
        key.verify(signature, message)
    except InvalidSignature:
        return False
    return True
