"""Ed25519 signatures within an onboard image: a section after all others, which it covers.

What is signed is ``IMAGE_PREFIX`` and the SHA-512 of the image up to that section: header, section
table, stars and features, and with the header the SHA-256 of the database's manifest. Blocks that
check or repair come after the data and are covered by nothing: whoever repairs a block checks the
signature then.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from numpy.typing import NDArray

from starcat.errors import ConfigError
from starcat.onboard import layout
from starcat.onboard.layout import ByteOrder, check_blocks, in_order, rounded_up
from starcat.onboard.reading import OnboardImage
from starcat.storage.keys import raw_public, short_name

IMAGE_KIND = 9
"""Kind of the section."""

IMAGE_PREFIX = b"starcat-image-1\0"
"""What a signed message begins with, so that no signature can be taken for another."""

RECORD_BYTES = 96
"""A public key of 32 bytes and a signature of 64."""

MAX_SIGNATURES = 16

MAX_ADDED_BYTES = 2 * layout.BLOCK_BYTES
"""What signatures add to an image at most: a block of data, and one that checks it."""

_MINOR_VERSION = 1


@dataclass(frozen=True)
class Signature:
    """A signature and the public key that it can be checked with."""

    public_key: bytes  # 32 bytes
    signature: bytes  # 64 bytes

    def is_of(self, message: bytes) -> bool:
        """Return whether the owner of the key has signed a message."""
        try:
            Ed25519PublicKey.from_public_bytes(self.public_key).verify(self.signature, message)
        except (InvalidSignature, ValueError):
            return False
        return True


def signed(message: bytes, key: Ed25519PrivateKey) -> Signature:
    """Sign a message."""
    return Signature(raw_public(key.public_key()), key.sign(message))


def sign_image(data: bytes, byte_order: ByteOrder, keys: Sequence[Ed25519PrivateKey]) -> bytes:
    """Return an unsigned image with signatures in it; without any it stays as it is."""
    if not keys:
        return data
    if len(keys) > MAX_SIGNATURES:
        raise ConfigError(
            f"{len(keys)} signatures; an image has room for {MAX_SIGNATURES}: sign with fewer keys",
            key="sign",
            value=len(keys),
        )
    header = np.frombuffer(data, in_order(layout.HEADER, byte_order), 1).copy()
    before = int(header["data_bytes"][0])
    table, count = _table(data, byte_order).copy(), int(header["n_sections"][0])
    end = int((table["offset"] + table["bytes"]).max())
    start, room = rounded_up(end, layout.SECTION_ALIGNMENT), RECORD_BYTES * len(keys)
    table[count] = (IMAGE_KIND, start, room, RECORD_BYTES)
    size = rounded_up(start + room, layout.BLOCK_BYTES)
    header["n_sections"], header["version_minor"] = count + 1, _MINOR_VERSION
    header["data_bytes"], header["total_bytes"] = size, size + layout.check_bytes(size)
    whole = bytearray(data[:before].ljust(size, b"\0"))
    head = header.tobytes() + table.tobytes()
    whole[: len(head)] = head
    message = image_message(bytes(whole), byte_order)
    made = [signed(message, key) for key in keys]
    whole[start : start + room] = b"".join(one.public_key + one.signature for one in made)
    done = bytes(whole)
    return done + check_blocks(done, byte_order)


def image_message(data: bytes, byte_order: ByteOrder) -> bytes:
    """Return what is signed of an image that has a section for it."""
    end, _ = _place(_table(data, byte_order))
    return IMAGE_PREFIX + hashlib.sha512(data[:end]).digest()


def image_signatures(data: bytes, byte_order: ByteOrder) -> list[Signature]:
    """Return the signatures of an image that was read without complaint, unchecked."""
    start, size = _place(_table(data, byte_order))
    records = [data[n : n + RECORD_BYTES] for n in range(start, start + size, RECORD_BYTES)]
    return [Signature(one[:32], one[32:]) for one in records if len(one) == RECORD_BYTES]


def signature_problems(image: OnboardImage, trusted: bytes | None = None) -> Iterator[str]:
    """Yield what is wrong with the signatures of an image, one of which has to be of a key."""
    message = image_message(image.data, image.byte_order)
    signatures = image_signatures(image.data, image.byte_order)
    for one in signatures:
        if not one.is_of(message):
            yield f"the signature of the image by the key {short_name(one.public_key)} does not fit"
    if trusted is not None and trusted not in {one.public_key for one in signatures}:
        signers = ", ".join(short_name(one.public_key) for one in signatures) or "nobody"
        yield f"signed by {signers}, not by the key {short_name(trusted)}"


def _table(data: bytes, byte_order: ByteOrder) -> NDArray[Any]:
    entry = in_order(layout.SECTION, byte_order)
    return np.frombuffer(data, entry, layout.MAX_SECTIONS, layout.HEADER.itemsize)


def _place(table: NDArray[Any]) -> tuple[int, int]:
    for entry in table:
        if entry["kind"] == IMAGE_KIND:
            return int(entry["offset"]), int(entry["bytes"])
    return 0, 0
