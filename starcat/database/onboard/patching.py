"""Patches: flight software makes the next onboard image from its old image and a patch.

``docs/onboard-format.md`` describes every byte. A patch release leaves out a few stars of
thousands. The other stars are copied, the rows of stars in triangles and pairs are renumbered, and
the numbers of the K-vector are stored as differences from the old ones.
"""

from __future__ import annotations

import hashlib
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from numpy.typing import NDArray

from starcat.database.onboard import layout
from starcat.database.onboard.layout import ByteOrder, check_blocks, in_order, rounded_up
from starcat.database.onboard.reading import OnboardImage, rows_by_number
from starcat.errors import ConfigError, OnboardImageError
from starcat.storage.keys import raw_public, short_name

IMAGE_KIND = 9
"""Kind of the section with the signatures."""

IMAGE_PREFIX = b"starcat-image-1\0"
"""Beginning of a signed message, so that no signature can be used for another purpose."""

RECORD_BYTES = 96
"""A public key of 32 bytes and a signature of 64."""

MAX_SIGNATURES = 16

MAX_ADDED_BYTES = 2 * layout.BLOCK_BYTES
"""Largest number of bytes that signatures add to an image: a data block and its check block."""

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
    """Return an unsigned image with signatures; without keys it stays unsigned."""
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
    signatures = [signed(message, key) for key in keys]
    whole[start : start + room] = b"".join(
        signature.public_key + signature.signature for signature in signatures
    )
    done = bytes(whole)
    return done + check_blocks(done, byte_order)


def image_message(data: bytes, byte_order: ByteOrder) -> bytes:
    """Return the message that is signed, for an image with a section for signatures."""
    end, _ = _signature_range(_table(data, byte_order))
    return IMAGE_PREFIX + hashlib.sha512(data[:end]).digest()


def image_signatures(data: bytes, byte_order: ByteOrder) -> list[Signature]:
    """Return the signatures of an image that was read without complaint, unchecked."""
    start, size = _signature_range(_table(data, byte_order))
    records = [data[n : n + RECORD_BYTES] for n in range(start, start + size, RECORD_BYTES)]
    return [
        Signature(record[:32], record[32:]) for record in records if len(record) == RECORD_BYTES
    ]


def signature_problems(image: OnboardImage, trusted: bytes | None = None) -> Iterator[str]:
    """Yield what is wrong with the signatures of an image, one of which has to be of a key."""
    message = image_message(image.data, image.byte_order)
    signatures = image_signatures(image.data, image.byte_order)
    for signature in signatures:
        if not signature.is_of(message):
            name = short_name(signature.public_key)
            yield f"the signature of the image by the key {name} does not fit"
    if trusted is not None and trusted not in {signature.public_key for signature in signatures}:
        signers = (
            ", ".join(short_name(signature.public_key) for signature in signatures) or "nobody"
        )
        yield f"signed by {signers}, not by the key {short_name(trusted)}"


def _table(data: bytes, byte_order: ByteOrder) -> NDArray[Any]:
    entry = in_order(layout.SECTION, byte_order)
    return np.frombuffer(data, entry, layout.MAX_SECTIONS, layout.HEADER.itemsize)


def _signature_range(table: NDArray[Any]) -> tuple[int, int]:
    for entry in table:
        if entry["kind"] == IMAGE_KIND:
            return int(entry["offset"]), int(entry["bytes"])
    return 0, 0


MAGIC = b"STARPAT\0"
VERSION = 2
HEADER = np.dtype(
    [
        ("magic", "S8"),
        ("byte_order", "u4"),
        ("version", "u4"),
        ("old_bytes", "u4"),
        ("old_crc", "u4"),
        ("new_bytes", "u4"),
        ("new_crc", "u4"),
        ("n_runs", "u4"),
        ("patch_bytes", "u4"),
        ("patch_crc", "u4"),
    ]
)
LITERAL, COPY, RENUMBER_16, RENUMBER_32, ADD_16, ADD_32, ZEROS = range(7)
WIDTHS = (1, 1, 2, 4, 2, 4, 1)
"""Bytes of the unit that each kind of step counts."""

_ZEROS = re.compile(rb"\0{8,}")

Rows = NDArray[np.int64]


def make_patch(old: OnboardImage, new: OnboardImage) -> bytes:
    """Return the patch that makes the new image from the old image."""
    for what, name in (("method", "method"), ("byte_order", "endian")):
        before, after = getattr(old, what), getattr(new, what)
        if before != after:
            raise ConfigError(
                f"the old image is {before}, the new one {after}",
                parameter="patch_from",
                hint=f"export with {{{name}:{before}}}",
            )
    source = rows_by_number(new.star_id, new.directions, old.star_id, old.directions)
    runs = _runs_of_rows(source)
    steps = _Steps(old, new)
    of_features = _sources_of_features(old, new, source)
    for name in sorted(new.sections, key=new.offsets.__getitem__):
        steps.rest(new.offsets[name])
        if name in ("kvector", "grid"):
            steps.add(name, np.arange(len(new.sections[name])))
        elif name in ("triangles", "pairs"):
            steps.rows(name, of_features, renumbered(old.features, runs))
        else:
            steps.rows(name, of_features if name == "radii" else source, old.sections[name])
    steps.rest(int(new.header["data_bytes"]))
    steps.rest(len(new.data))
    word = in_order("u4", new.byte_order)
    table = runs.astype(np.uint32).astype(word).tobytes()
    header = np.zeros(1, dtype=in_order(HEADER, new.byte_order))
    header["magic"], header["byte_order"], header["version"] = MAGIC, layout.ORDER_WORD, VERSION
    header["old_bytes"], header["new_bytes"] = len(old.data), len(new.data)
    header["old_crc"], header["new_crc"] = old.crc, new.crc
    header["n_runs"] = len(runs)
    header["patch_bytes"] = HEADER.itemsize + len(table) + len(steps.written)
    body = table + bytes(steps.written)
    header["patch_crc"] = _crc_of_patch(header.tobytes() + body)
    return header.tobytes() + body


def _crc_of_patch(patch: bytes) -> int:
    """Return the CRC-32 of all bytes of a patch except the CRC itself."""
    return zlib.crc32(patch[HEADER.itemsize :], zlib.crc32(patch[: HEADER.itemsize - 4]))


def _runs_of_rows(source: Rows) -> Rows:
    """Return the first old row of each run of stars and the shift of its rows, shape (R, 2)."""
    new_rows = np.flatnonzero(source >= 0)
    order = np.argsort(source[new_rows])
    old_rows, shift = source[new_rows][order], (new_rows - source[new_rows])[order]
    begins = np.flatnonzero(np.diff(shift, prepend=0) != 0)
    return np.stack([old_rows[begins], shift[begins]], axis=1)


def renumbered(rows: NDArray[Any], runs: Rows) -> Rows:
    """Return the rows in the new image of stars of the old one, in any shape."""
    run = np.searchsorted(runs[:, 0], rows, side="right")
    return np.asarray(rows + np.concatenate([[0], runs[:, 1]])[run], dtype=np.int64)


def _rows_among(numbers: Rows, among: Rows) -> Rows:
    """Return the row of each number among others that do not repeat; -1 if it is missing."""
    order = np.argsort(among, kind="stable")
    at = np.searchsorted(among[order], numbers)
    row = order[np.minimum(at, len(among) - 1)] if len(among) else np.zeros_like(numbers)
    is_there = among[row] == numbers if len(among) else np.zeros(len(numbers), dtype=bool)
    return np.where(is_there, row, -1)


def _sources_of_features(old: OnboardImage, new: OnboardImage, source: Rows) -> Rows:
    """Return the row of each new feature in the old image; -1 if it is missing there."""
    before, after = old.features, source[new.features]
    radix = len(old.star_id) ** np.arange(before.shape[1])
    keys = np.sort(after, axis=1) @ radix
    return np.where((after >= 0).all(axis=1), _rows_among(keys, before @ radix), -1)


def _number(value: int) -> bytes:
    """Return a number as bytes of seven bits, lowest first; the highest bit means: more follow."""
    written = bytearray()
    while value >= 0x80:
        written.append(value & 0x7F | 0x80)
        value >>= 7
    written.append(value)
    return bytes(written)


def _difference(value: int) -> bytes:
    return _number(2 * value if value >= 0 else -2 * value - 1)


class _Steps:
    """The steps of a patch, in order."""

    def __init__(self, old: OnboardImage, new: OnboardImage) -> None:
        self.old, self.new = old, new
        self.written = bytearray()
        self.old_at = self.new_at = 0

    def rest(self, until: int) -> None:
        """Write the new image's next bytes unchanged, up to a position."""
        part = self.new.data[self.new_at : until]
        ends = [0, *(end for match in _ZEROS.finditer(part) for end in match.span()), len(part)]
        for n, (start, end) in enumerate(pairwise(ends)):
            if end > start:
                self._begin(ZEROS if n % 2 else LITERAL, end - start)
                self.written += b"" if n % 2 else part[start:end]
        self.new_at = until

    def rows(self, name: str, source: Rows, expected: NDArray[Any]) -> None:
        """Write rows of a section: runs of the old section if they are as expected."""
        after = self.new.sections[name]
        kind = COPY
        if name in ("triangles", "pairs"):
            kind = RENUMBER_16 if after.itemsize == 2 else RENUMBER_32
        if after.itemsize != self.old.sections[name].itemsize:
            source = np.full_like(source, -1)
        same = source >= 0
        is_equal = expected[source[same]] == after[same]
        same[same] = is_equal.all(axis=1) if is_equal.ndim == 2 else is_equal
        if name == "magnitudes" and 8 * same.sum() < 7 * len(same):
            self.add(name, source)
            return
        start = self.new_at
        row_bytes = after.nbytes // max(1, len(after))
        source = np.where(same, source, -1)
        for first, end in _runs(source):
            if source[first] < 0:
                self.rest(start + end * row_bytes)
            else:
                self._from_old(
                    kind, name, int(source[first]) * row_bytes, (end - first) * row_bytes
                )

    def add(self, name: str, source: Rows) -> None:
        """Write numbers of a section as differences from the old section."""
        before, after = self.old.sections[name], self.new.sections[name]
        kind = ADD_16 if after.itemsize == 2 else ADD_32
        source = np.where(source < len(before), source, -1)
        start = self.new_at
        for first, end in _runs(source):
            if source[first] < 0:
                self.rest(start + end * after.itemsize)
                continue
            row = int(source[first])
            shift = after[first:end].astype(np.int64) - before[row : row + end - first]
            self._from_old(kind, name, row * after.itemsize, (end - first) * after.itemsize)
            self._changes(np.diff(shift, prepend=0))

    def _changes(self, changes: Rows) -> None:
        ends = [*np.flatnonzero(changes).tolist(), len(changes)]
        if ends[0] > 0:
            self.written += _number(0) + _number(ends[0] - 1)
        for at, after in pairwise(ends):
            self.written += _difference(int(changes[at]))
            if after > at + 1:
                self.written += _number(0) + _number(after - at - 2)

    def _begin(self, kind: int, count: int) -> None:
        self.written += _number(count << 3 | kind)

    def _from_old(self, kind: int, name: str, offset: int, size: int) -> None:
        start = self.old.offsets[name] + offset
        self._begin(kind, size // WIDTHS[kind])
        self.written += _difference(start - self.old_at)
        self.old_at, self.new_at = start + size, self.new_at + size


def _runs(source: Rows) -> list[tuple[int, int]]:
    """Return first and end of each run of consecutive rows, or of missing rows."""
    follows = (np.diff(source) == 1) & (source[1:] > 0) | (source[1:] < 0) & (source[:-1] < 0)
    ends = [0, *(np.flatnonzero(~follows) + 1).tolist(), len(source)]
    return [(first, end) for first, end in pairwise(ends) if end > first]


def apply_patch(old: bytes, patch: bytes) -> bytes:
    """Return the new image, as flight software makes it."""
    orders = {int.from_bytes(patch[8:12], order): order for order in layout.BYTE_ORDERS}
    order = orders.get(layout.ORDER_WORD)
    if patch[: len(MAGIC)] != MAGIC or order is None:
        raise OnboardImageError("not a patch of an onboard image")
    header = np.frombuffer(patch, in_order(HEADER, order), 1)[0]
    if header["version"] != VERSION:
        raise OnboardImageError(
            f"a patch of format {header['version']}; this version reads format {VERSION}: "
            "make the patch again from both images"
        )
    if header["patch_bytes"] > len(patch) or header["patch_crc"] != _crc_of_patch(
        patch[: int(header["patch_bytes"])]
    ):
        raise OnboardImageError("the patch is damaged: its CRC differs", hint="transfer it again")
    if int(header["old_bytes"]) != len(old) or header["old_crc"] != layout.crc_of(old, order):
        raise OnboardImageError("the patch is for another image than this one")
    at = HEADER.itemsize + 8 * int(header["n_runs"])
    runs = np.frombuffer(patch[HEADER.itemsize : at], in_order("i4", order)).reshape(-1, 2)
    numbers = _Numbers(patch[at : int(header["patch_bytes"])])
    new, old_at = bytearray(), 0
    while len(new) < header["new_bytes"]:
        token = numbers.next()
        kind, size = token & 7, (token >> 3) * WIDTHS[token & 7]
        if kind == LITERAL:
            new += numbers.take(size)
            continue
        if kind == ZEROS:
            new += bytes(size)
            continue
        old_at += numbers.difference()
        part, dtype = old[old_at : old_at + size], in_order(f"u{WIDTHS[kind]}", order)
        old_at += size
        if kind in (RENUMBER_16, RENUMBER_32):
            part = (
                renumbered(np.frombuffer(part, dtype), runs.astype(np.int64))
                .astype(dtype)
                .tobytes()
            )
        elif kind in (ADD_16, ADD_32):
            before = np.frombuffer(part, dtype)
            part = (before + numbers.shifts(len(before))).astype(dtype).tobytes()
        new += part
    if layout.crc_of(bytes(new), order) != header["new_crc"] or layout.scrub(bytes(new)):
        raise OnboardImageError("the patch does not make the image that it says; it is damaged")
    return bytes(new)


class _Numbers:
    """The numbers of a patch's steps."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def next(self) -> int:
        value, bits = 0, 0
        while True:
            byte = self.data[self.at]
            self.at += 1
            value |= (byte & 0x7F) << bits
            bits += 7
            if byte < 0x80:
                return value

    def difference(self) -> int:
        value = self.next()
        return value >> 1 if value % 2 == 0 else -(value >> 1) - 1

    def take(self, size: int) -> bytes:
        self.at += size
        return self.data[self.at - size : self.at]

    def shifts(self, count: int) -> Rows:
        changes = np.zeros(count, dtype=np.int64)
        n = 0
        while n < count:
            changes[n] = self.difference()
            n += 1 if changes[n] else 1 + self.next()
        return np.cumsum(changes)
