"""Ed25519 keys in PEM files like OpenSSL's; only the owner can read a private key."""

from __future__ import annotations

import os
from pathlib import Path

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from starcat.errors import ConfigError, FileMissing, OutputError, SourceError, reason
from starcat.storage.regular_files import read_regular_file

PRIVATE_SUFFIX, PUBLIC_SUFFIX = ".key", ".pub"
MAX_KEY_BYTES = 1 << 20
"""Largest size of the file of a key."""

_PRIVATE_MARK, _PUBLIC_MARK = b"PRIVATE KEY-----", b"-----BEGIN PUBLIC KEY-----"


def new_key(name: Path) -> tuple[Path, Path]:
    """Make a key pair: ``NAME.key`` for signing, and ``NAME.pub`` for checking signatures."""
    private, public = (name.with_name(name.name + end) for end in (PRIVATE_SUFFIX, PUBLIC_SUFFIX))
    key = Ed25519PrivateKey.generate()
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    for path in (private, public):
        if os.path.lexists(path):
            raise OutputError(
                f"{path} already exists; a key is never overwritten: choose another name", path=path
            )
    _write_new(private, pem, 0o600)
    _write_new(public, public_pem(key.public_key()), 0o644)
    return private, public


def public_pem(key: Ed25519PublicKey) -> bytes:
    """Return the content of the file of a public key."""
    return key.public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )


def raw_public(key: Ed25519PublicKey) -> bytes:
    """Return the 32 bytes of a public key."""
    return key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)


def short_name(raw: bytes) -> str:
    """Return the first eight bytes of a public key in hexadecimal, its name in messages."""
    return raw.hex()[:16]


def read_private(path: Path) -> Ed25519PrivateKey:
    """Read a private key, for signing."""
    data = _read(path)
    if _PRIVATE_MARK not in data:
        is_public = _PUBLIC_MARK in data
        problem = "a public key, which only checks" if is_public else "no private key in PEM"
        raise _no_key(
            path, problem, "sign with the file NAME.key that 'starcat keys new NAME' wrote"
        )
    try:
        key = serialization.load_pem_private_key(data, None)
    except TypeError as error:
        advice = f"write it without one, with 'openssl pkey -in {path.name} -out NAME.key'"
        raise _no_key(path, "a key under a passphrase", advice) from error
    except (ValueError, UnsupportedAlgorithm) as error:
        raise _no_key(path, "a damaged private key", "take a copy of it that is whole") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise _other_kind(path)
    return key


def read_public(path: Path) -> Ed25519PublicKey:
    """Read a public key, for checking signatures."""
    data = _read(path)
    if _PUBLIC_MARK not in data:
        is_private = _PRIVATE_MARK in data
        problem = "a private key; keep it to yourself" if is_private else "no public key in PEM"
        advice = "give the file NAME.pub that 'starcat keys new NAME' wrote"
        raise _no_key(path, problem, advice)
    try:
        key = serialization.load_pem_public_key(data)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise _no_key(path, "a damaged public key", "ask its owner for it again") from error
    if not isinstance(key, Ed25519PublicKey):
        raise _other_kind(path)
    return key


def is_public_key(path: Path) -> bool:
    """Return whether a file begins like a key in PEM, public or private."""
    return _read(path).lstrip().startswith(b"-----BEGIN ")


def _read(path: Path) -> bytes:
    try:
        return read_regular_file(path, MAX_KEY_BYTES)
    except FileMissing as error:
        raise FileMissing(
            "no such key",
            where=path,
            key="key",
            value=str(path),
            hint="'starcat keys new NAME' makes one",
        ) from error
    except SourceError as error:
        raise ConfigError(f"{error}; expected a key", key="key", value=str(path)) from error


def _no_key(path: Path, problem: str, advice: str) -> ConfigError:
    return ConfigError(problem, where=path, key="key", value=str(path), hint=advice)


def _other_kind(path: Path) -> ConfigError:
    advice = "only Ed25519 is used: make one with 'starcat keys new NAME'"
    return _no_key(path, "a key of another kind", advice)


def _write_new(path: Path, data: bytes, mode: int) -> None:
    """Write a new file; from the first moment only its owner can read it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(path, flags, mode), "wb") as file:
            file.write(data)
    except OSError as error:
        raise OutputError(
            f"cannot be written ({reason(error)})", where=path, hint="choose another name"
        ) from error
