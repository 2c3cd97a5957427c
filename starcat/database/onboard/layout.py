"""The layout of an onboard image: header, section table, kinds of sections, sizes, check blocks.

``docs/onboard-format.md`` describes it in words. All types are here for one byte order, and
`in_order` converts them to another. The positions of check blocks follow from the size of the image
alone, so that a damaged header cannot mislead a reader.
"""

from __future__ import annotations

import mmap
import zlib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

ByteOrder = Literal["little", "big"]
BYTE_ORDERS: tuple[ByteOrder, ...] = ("little", "big")

MAGIC = b"STARCAT\0"
ORDER_WORD = 0x01020304
VERSION = (1, 0)

HEADER_BYTES = 512
"""Header and section table."""
SECTION_ALIGNMENT = 64
MAX_SECTIONS = 16
BLOCK_BYTES = 4096
CRCS_PER_BLOCK = 1022
NAME_BYTES = 96
MAX_BYTES = 2**32 - 1

DIRECTION_SCALE = 2147483647
"""The stored value of a component of 1."""
MAG_SCALE = 1000
MAG_UNKNOWN = -32768
RADIUS_UNKNOWN = 65535
"""Value of circumradii that are too large to be useful."""
RADIUS_STEPS = 65534
RADIUS_RANGE = 2.5
"""The largest circumradius that is stored, in units of the camera's diagonal."""

FEATURES = {"triangle": ("triangles", ("i", "j", "k")), "pyramid": ("pairs", ("i", "j"))}
"""For each method of an image, the product that its features are from, and the columns of rows."""

METHODS = tuple(FEATURES)
METHOD_NUMBERS = {method: number for number, method in enumerate(METHODS, start=1)}

_COMMON = ("directions", "magnitudes", "star_ids", "grid", "kvector")
KINDS = {name: n for n, name in enumerate((*_COMMON, "triangles", "radii", "pairs"), start=1)}
SECTIONS = {"triangle": (*_COMMON, "triangles", "radii"), "pyramid": (*_COMMON, "pairs")}
"""The sections of an image by method, in order."""

HEADER = np.dtype(
    [
        ("magic", "S8"),
        ("byte_order", "u4"),
        ("version_major", "u2"),
        ("version_minor", "u2"),
        ("header_bytes", "u4"),
        ("total_bytes", "u4"),
        ("data_bytes", "u4"),
        ("method", "u4"),
        ("n_stars", "u4"),
        ("n_features", "u4"),
        ("n_kvector", "u4"),
        ("index_bytes", "u4"),
        ("grid_bands", "u4"),
        ("grid_sectors", "u4"),
        ("most_near", "u4"),
        ("n_sections", "u4"),
        ("width_px", "u4"),
        ("height_px", "u4"),
        ("focal_length_px", "f8"),
        ("epoch_jyear", "f8"),
        ("kvector_intercept", "f8"),
        ("kvector_slope", "f8"),
        ("radius_quantum_rad", "f8"),
        ("longest_rad", "f8"),
        ("block_bytes", "u4"),
        ("reserved", "u4"),
        ("manifest_sha256", "V32"),
        ("name", f"S{NAME_BYTES}"),
    ]
)
SECTION = np.dtype([("kind", "u4"), ("offset", "u4"), ("bytes", "u4"), ("element_bytes", "u4")])


@dataclass(frozen=True)
class Sizes:
    """The numbers that determine the size of an image."""

    method: str
    n_stars: int
    n_features: int  # triangles or pairs
    n_cells: int

    @property
    def index_bytes(self) -> int:
        """Size of a star's row number."""
        return 2 if self.n_stars <= 1 << 16 else 4

    @property
    def n_kvector(self) -> int:
        """Entries of the K-vector."""
        return self.n_features // 4 + 2

    def sections(self) -> list[tuple[str, str, tuple[int, ...]]]:
        """Return name, dtype and shape of each section, in order."""
        n, m, index = self.n_stars, self.n_features, f"u{self.index_bytes}"
        every = {
            "directions": ("i4", (n, 3)),
            "magnitudes": ("i2", (n,)),
            "star_ids": ("i8", (n,)),
            "grid": ("u4", (self.n_cells + 1,)),
            "kvector": ("u4", (self.n_kvector,)),
            "triangles": (index, (m, 3)),
            "radii": ("u2", (m,)),
            "pairs": (index, (m, 2)),
        }
        return [(name, *every[name]) for name in SECTIONS[self.method]]

    def table(self) -> NDArray[Any]:
        """Return the section table."""
        table = np.zeros(MAX_SECTIONS, dtype=[(name, "u8") for name in SECTION.names or ()])
        offset = HEADER_BYTES
        for row, (name, dtype, shape) in enumerate(self.sections()):
            element = np.dtype(dtype).itemsize * int(np.prod(shape[1:], dtype=np.int64))
            table[row] = (KINDS[name], offset, element * shape[0], element)
            offset = rounded_up(offset + element * shape[0], SECTION_ALIGNMENT)
        return table

    @property
    def data_bytes(self) -> int:
        """Size of header and sections, in whole blocks."""
        table = self.table()
        return rounded_up(int((table["offset"] + table["bytes"]).max()), BLOCK_BYTES)

    @property
    def total_bytes(self) -> int:
        """Size of the image."""
        return self.data_bytes + check_bytes(self.data_bytes)


def check_bytes(data_bytes: int) -> int:
    """Return the size of the check blocks."""
    return rounded_up(data_bytes // BLOCK_BYTES, CRCS_PER_BLOCK) // CRCS_PER_BLOCK * BLOCK_BYTES


def rounded_up(value: int, step: int) -> int:
    """Return the next multiple."""
    return -(-value // step) * step


def in_order(dtype: np.dtype[Any] | str, byte_order: ByteOrder) -> np.dtype[Any]:
    """Return a type in a byte order."""
    return np.dtype(dtype).newbyteorder(byte_order)


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
    """Return how many of an image's blocks are data."""
    blocks = size_bytes // BLOCK_BYTES
    return blocks - -(-blocks // (CRCS_PER_BLOCK + 1))


def crc_of(image: bytes, byte_order: ByteOrder) -> int:
    """Return the CRC-32 of all data of an image, which identifies the image."""
    at = len(image) - BLOCK_BYTES + _AT_WHOLE
    return int.from_bytes(image[at : at + 4], byte_order)


def has_check_blocks(image: bytes) -> bool:
    """Return whether bytes end with at least one check block that is whole."""
    return len(image) % BLOCK_BYTES == 0 and any(_sound_checks(image).values())


def scrub(image: bytes | mmap.mmap) -> list[int]:
    """Return the damaged blocks of an image."""
    if not image or len(image) % BLOCK_BYTES:
        return [len(image) // BLOCK_BYTES]
    n_data, view = data_blocks(len(image)), memoryview(image)
    crcs = _block_crcs(view[: n_data * BLOCK_BYTES])
    bad: list[int] = []
    for block, byte_order in _sound_checks(view).items():
        if byte_order is None:
            bad.append(block)
            continue
        start = block * BLOCK_BYTES
        first = (block - n_data) * CRCS_PER_BLOCK
        stored = np.frombuffer(image, in_order("u4", byte_order), CRCS_PER_BLOCK, start)
        computed = crcs[first : first + CRCS_PER_BLOCK]
        bad += (first + np.flatnonzero(computed != stored[: len(computed)])).tolist()
    return sorted(bad)


def _block_crcs(data: bytes | memoryview) -> NDArray[np.uint32]:
    view = memoryview(data)
    starts = range(0, len(data), BLOCK_BYTES)
    return np.array([zlib.crc32(view[n : n + BLOCK_BYTES]) for n in starts], dtype=np.uint32)


def _sound_checks(image: bytes | memoryview) -> dict[int, ByteOrder | None]:
    """Return the byte order of each check block, None if its own CRC does not fit."""
    checks: dict[int, ByteOrder | None] = {}
    for block in range(data_blocks(len(image)), len(image) // BLOCK_BYTES):
        part = image[block * BLOCK_BYTES : (block + 1) * BLOCK_BYTES]
        crc, stored = zlib.crc32(part[:_AT_ITSELF]), part[_AT_ITSELF:]
        fits = (order for order in BYTE_ORDERS if int.from_bytes(stored, order) == crc)
        checks[block] = next(fits, None)
    return checks
