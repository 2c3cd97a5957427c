"""The check blocks of an onboard image: making them, and finding the damaged block with them.

Which bytes are check blocks follows from the size of the image alone, so that a damaged header
does not lead astray.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from starcat.onboard.layout import (
    BLOCK_BYTES,
    BYTE_ORDERS,
    CRCS_PER_BLOCK,
    ByteOrder,
    check_bytes,
    in_order,
)

_AT_WHOLE = 4 * CRCS_PER_BLOCK
_AT_ITSELF = _AT_WHOLE + 4


def check_blocks(data: bytes, byte_order: ByteOrder) -> bytes:
    """Return the check blocks of data."""
    word = in_order("u4", byte_order)
    whole = np.array(zlib.crc32(data), dtype=word).tobytes()
    crcs = np.zeros(check_bytes(len(data)) // BLOCK_BYTES * CRCS_PER_BLOCK, dtype=word)
    crcs[: len(data) // BLOCK_BYTES] = _block_crcs(data)
    blocks = []
    for of_blocks in crcs.reshape(-1, CRCS_PER_BLOCK):
        block = of_blocks.tobytes() + whole
        blocks.append(block + np.array(zlib.crc32(block), dtype=word).tobytes())
    return b"".join(blocks)


def data_blocks(size_bytes: int) -> int:
    """Return how many of an image's blocks are data.

    Examples
    --------
    >>> [data_blocks(4096 * blocks) for blocks in (2, 1023, 1025)]
    [1, 1022, 1023]
    """
    blocks = size_bytes // BLOCK_BYTES
    return blocks - -(-blocks // (CRCS_PER_BLOCK + 1))


def has_check_blocks(image: bytes) -> bool:
    """Return whether bytes end with at least one check block that is whole."""
    return len(image) % BLOCK_BYTES == 0 and any(_sound_checks(image).values())


def scrub(image: bytes) -> list[int]:
    """Return the damaged blocks of an image.

    Examples
    --------
    >>> sound = bytes(8192)
    >>> sound += check_blocks(sound, "little")
    >>> scrub(sound), scrub(sound[:5000] + b"x" + sound[5001:])
    ([], [1])
    """
    if not image or len(image) % BLOCK_BYTES:
        return [len(image) // BLOCK_BYTES]
    n_data = data_blocks(len(image))
    found = _block_crcs(image[: n_data * BLOCK_BYTES])
    bad: list[int] = []
    for block, byte_order in _sound_checks(image).items():
        if byte_order is None:
            bad.append(block)
            continue
        start = block * BLOCK_BYTES
        first = (block - n_data) * CRCS_PER_BLOCK
        stored = np.frombuffer(image, in_order("u4", byte_order), CRCS_PER_BLOCK, start)
        own = found[first : first + CRCS_PER_BLOCK]
        bad += (first + np.flatnonzero(own != stored[: len(own)])).tolist()
    return sorted(bad)


def _block_crcs(data: bytes) -> NDArray[np.uint32]:
    view = memoryview(data)
    starts = range(0, len(data), BLOCK_BYTES)
    return np.array([zlib.crc32(view[n : n + BLOCK_BYTES]) for n in starts], dtype=np.uint32)


def _sound_checks(image: bytes) -> dict[int, ByteOrder | None]:
    """Return the byte order of each check block, None where its own CRC does not fit."""
    checks: dict[int, ByteOrder | None] = {}
    for block in range(data_blocks(len(image)), len(image) // BLOCK_BYTES):
        part = image[block * BLOCK_BYTES : (block + 1) * BLOCK_BYTES]
        crc, stored = zlib.crc32(part[:_AT_ITSELF]), part[_AT_ITSELF:]
        fits = (order for order in BYTE_ORDERS if int.from_bytes(stored, order) == crc)
        checks[block] = next(fits, None)
    return checks
