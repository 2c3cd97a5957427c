"""Reading gzip in large steps: the same bytes as the gzip module, and the same refusals."""

from __future__ import annotations

import gzip
import io

import pytest
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.readers import gunzip
from starcat.catalog.readers.gunzip import GzipReader

CONTENT = b"0123456789 the quick brown fox\n" * 40


def read_all(data: bytes, size: int) -> bytes:
    reader = GzipReader(io.BytesIO(data))
    parts = []
    while part := reader.read(size):
        assert len(part) <= size
        parts.append(part)
    assert all(len(part) == size for part in parts[:-1])
    return b"".join(parts)


@given(
    members=st.lists(st.binary(max_size=3000), max_size=4),
    size=st.integers(1, 5000),
    step=st.sampled_from([1, 7, 64, 1 << 20]),
    padding=st.integers(0, 40),
)
def test_equals_the_gzip_module(members: list[bytes], size: int, step: int, padding: int) -> None:
    data = b"".join(gzip.compress(member, mtime=0) for member in members) + bytes(padding)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gunzip, "STEP_BYTES", step)
        assert read_all(data, size) == b"".join(members)


@pytest.mark.parametrize("step", [3, 1 << 20])
def test_a_cut_at_any_byte_is_found(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    monkeypatch.setattr(gunzip, "STEP_BYTES", step)
    data = gzip.compress(CONTENT, mtime=0)
    for length in range(1, len(data)):
        with pytest.raises((EOFError, gzip.BadGzipFile)):
            read_all(data[:length], 100)


def test_a_changed_byte_never_passes_unseen() -> None:
    data = gzip.compress(CONTENT, mtime=0)
    for place in range(10, len(data)):  # the ten before hold the magic and facts without effect
        changed = bytearray(data)
        changed[place] ^= 1
        with pytest.raises((EOFError, gzip.BadGzipFile)):
            read_all(bytes(changed), 1000)


def test_other_bytes_behind_a_member_are_refused() -> None:
    with pytest.raises(gzip.BadGzipFile, match="Not a gzipped file"):
        read_all(gzip.compress(CONTENT) + b"rubbish", 100)
