"""Patches: what flight software makes the next onboard image of, with the one that it has.

``docs/onboard-format.md`` describes every byte. A patch release leaves out a few stars of
thousands; what stays is copied, the rows of stars in triangles and pairs are renumbered, and the
K-vector's numbers are old ones and how they differ.
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ConfigError, OnboardImageError
from starcat.onboard import layout
from starcat.onboard.layout import in_order
from starcat.onboard.reading import OnboardImage

MAGIC = b"STARPAT\0"
VERSION = 1
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
    ]
)
LITERAL, COPY, RENUMBER_16, RENUMBER_32, ADD_16, ADD_32, ZEROS = range(7)
WIDTHS = (1, 1, 2, 4, 2, 4, 1)
"""Bytes of what each kind of step counts."""

_ZEROS = re.compile(rb"\0{8,}")

Rows = NDArray[np.int64]


def make_patch(old: OnboardImage, new: OnboardImage) -> bytes:
    """Return the patch that makes one image of another."""
    for what, name in (("method", "method"), ("byte_order", "endian")):
        before, after = getattr(old, what), getattr(new, what)
        if before != after:
            raise ConfigError(
                f"patch_from: the old image is {before}, the new one {after}; export with "
                f"{name}={before}",
                key="patch_from",
                fields=("patch_from", f"{name}={before}"),
            )
    source = _found(new.star_id, old.star_id)
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
    return header.tobytes() + table + bytes(steps.written)


def _found(wanted: Rows, among: Rows) -> Rows:
    """Return where each number is among others that do not repeat; -1: nowhere."""
    order = np.argsort(among, kind="stable")
    at = np.searchsorted(among[order], wanted)
    place = order[np.minimum(at, len(among) - 1)] if len(among) else np.zeros_like(wanted)
    found = among[place] == wanted if len(among) else np.zeros(len(wanted), dtype=bool)
    return np.where(found, place, -1)


def _runs_of_rows(source: Rows) -> Rows:
    """Return the first old row of each run of stars and what is added to its rows, shape (R, 2)."""
    new_rows = np.flatnonzero(source >= 0)
    order = np.argsort(source[new_rows])
    old_rows, shift = source[new_rows][order], (new_rows - source[new_rows])[order]
    begins = np.flatnonzero(np.diff(shift, prepend=0) != 0)
    return np.stack([old_rows[begins], shift[begins]], axis=1)


def renumbered(rows: NDArray[Any], runs: Rows) -> Rows:
    """Return the rows in the new image of stars of the old one, in any shape."""
    run = np.searchsorted(runs[:, 0], rows, side="right")
    return np.asarray(rows + np.concatenate([[0], runs[:, 1]])[run], dtype=np.int64)


def _sources_of_features(old: OnboardImage, new: OnboardImage, source: Rows) -> Rows:
    """Return the row of each new feature in the old image; -1: it is not there."""
    before, after = old.features, source[new.features]
    radix = len(old.star_id) ** np.arange(before.shape[1])
    keys = np.sort(after, axis=1) @ radix
    return np.where((after >= 0).all(axis=1), _found(keys, before @ radix), -1)


def _number(value: int) -> bytes:
    """Seven bits a byte, the lowest first; the highest bit says that another byte follows."""
    written = bytearray()
    while value >= 0x80:
        written.append(value & 0x7F | 0x80)
        value >>= 7
    written.append(value)
    return bytes(written)


def _difference(value: int) -> bytes:
    return _number(2 * value if value >= 0 else -2 * value - 1)


class _Steps:
    """The steps of a patch, one after the other."""

    def __init__(self, old: OnboardImage, new: OnboardImage) -> None:
        self.old, self.new = old, new
        self.written = bytearray()
        self.old_at = self.made = 0

    def rest(self, until: int) -> None:
        """Write the new image's next bytes as they are, up to a place."""
        part = self.new.data[self.made : until]
        ends = [0, *(end for found in _ZEROS.finditer(part) for end in found.span()), len(part)]
        for n, (start, end) in enumerate(pairwise(ends)):
            if end > start:
                self._begin(ZEROS if n % 2 else LITERAL, end - start)
                self.written += b"" if n % 2 else part[start:end]
        self.made = until

    def rows(self, name: str, source: Rows, expected: NDArray[Any]) -> None:
        """Write rows of a section: those of the old one by runs, where they are as expected."""
        made = self.new.sections[name]
        kind = COPY
        if name in ("triangles", "pairs"):
            kind = RENUMBER_16 if made.itemsize == 2 else RENUMBER_32
        if made.itemsize != self.old.sections[name].itemsize:
            source = np.full_like(source, -1)
        same = source >= 0
        is_equal = expected[source[same]] == made[same]
        same[same] = is_equal.all(axis=1) if is_equal.ndim == 2 else is_equal
        if name == "magnitudes" and 8 * same.sum() < 7 * len(same):
            self.add(name, source)
            return
        start = self.made
        row_bytes = made.nbytes // max(1, len(made))
        source = np.where(same, source, -1)
        for first, end in _runs(source):
            if source[first] < 0:
                self.rest(start + end * row_bytes)
            else:
                self._from_old(
                    kind, name, int(source[first]) * row_bytes, (end - first) * row_bytes
                )

    def add(self, name: str, source: Rows) -> None:
        """Write numbers of a section by how they differ from those of the old one."""
        before, made = self.old.sections[name], self.new.sections[name]
        kind = ADD_16 if made.itemsize == 2 else ADD_32
        source = np.where(source < len(before), source, -1)
        start = self.made
        for first, end in _runs(source):
            if source[first] < 0:
                self.rest(start + end * made.itemsize)
                continue
            row = int(source[first])
            shift = made[first:end].astype(np.int64) - before[row : row + end - first]
            self._from_old(kind, name, row * made.itemsize, (end - first) * made.itemsize)
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
        self.old_at, self.made = start + size, self.made + size


def _runs(source: Rows) -> list[tuple[int, int]]:
    """Return first and end of each run of rows that follow each other, or are not there."""
    follows = (np.diff(source) == 1) & (source[1:] > 0) | (source[1:] < 0) & (source[:-1] < 0)
    ends = [0, *(np.flatnonzero(~follows) + 1).tolist(), len(source)]
    return [(first, end) for first, end in pairwise(ends) if end > first]


def apply_patch(old: bytes, patch: bytes) -> bytes:
    """Return the new image, as flight software makes it."""
    order = next((o for o in layout.BYTE_ORDERS if _word(patch, 8, o) == layout.ORDER_WORD), None)
    if patch[: len(MAGIC)] != MAGIC or order is None:
        raise OnboardImageError("not a patch of an onboard image")
    header = np.frombuffer(patch, in_order(HEADER, order), 1)[0]
    if int(header["old_bytes"]) != len(old) or header["old_crc"] != layout.crc_of(old, order):
        raise OnboardImageError("the patch is for another image than this one")
    at = HEADER.itemsize + 8 * int(header["n_runs"])
    runs = np.frombuffer(patch[HEADER.itemsize : at], in_order("i4", order)).reshape(-1, 2)
    numbers = _Numbers(patch[at : int(header["patch_bytes"])])
    made, old_at = bytearray(), 0
    while len(made) < header["new_bytes"]:
        token = numbers.next()
        kind, size = token & 7, (token >> 3) * WIDTHS[token & 7]
        if kind == LITERAL:
            made += numbers.take(size)
            continue
        if kind == ZEROS:
            made += bytes(size)
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
        made += part
    if layout.crc_of(bytes(made), order) != header["new_crc"] or layout.scrub(bytes(made)):
        raise OnboardImageError("the patch does not make the image that it says; it is damaged")
    return bytes(made)


def _word(data: bytes, at: int, order: layout.ByteOrder) -> int:
    return int.from_bytes(data[at : at + 4], order)


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
