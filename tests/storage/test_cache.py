"""The user's cache folder: where it is, its limit, and a cache that cannot be used."""

import logging
import os

import pooch
import pytest

from starcat.storage.cache import cache_folder, keep, map_kept, remove_kept


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_the_folder_is_the_one_of_the_system(monkeypatch):
    monkeypatch.delenv("STARCAT_CACHE", raising=False)
    assert cache_folder() == pooch.os_cache("starcat")


def test_a_kept_file_is_mapped(cache):
    assert map_kept("kind", "a") is None
    assert keep("kind", "a", b"first", 100)
    assert bytes(map_kept("kind", "a")) == b"first"
    remove_kept("kind", "a")
    assert map_kept("kind", "a") is None


def test_the_files_that_were_used_the_longest_ago_are_removed(cache):
    for number, name in enumerate("abc"):
        keep("kind", name, bytes(30), 100)
        os.utime(cache / "kind" / name, (number, number))
    (cache / "kind" / ".d.0.partial").write_bytes(bytes(5))  # a process was killed
    os.utime(cache / "kind" / ".d.0.partial", (0, 0))
    assert map_kept("kind", "a") is not None  # used now
    assert keep("kind", "e", bytes(40), 100)
    assert {path.name for path in (cache / "kind").iterdir()} == {"a", "c", "e"}
    assert not keep("kind", "f", bytes(101), 100)  # larger than the limit: others stay
    assert {path.name for path in (cache / "kind").iterdir()} == {"a", "c", "e"}


def test_downloads_are_never_removed(cache):
    cache.mkdir()
    (cache / "sao.dat.gz").write_bytes(bytes(1000))
    assert keep("kind", "a", bytes(10), 10)
    assert (cache / "sao.dat.gz").stat().st_size == 1000


def test_a_cache_that_cannot_be_written_keeps_nothing(cache, caplog):
    cache.write_text("a file where the folder should be")
    with caplog.at_level(logging.INFO):
        assert not keep("kind", "a", b"first", 100)
    assert "a cannot be kept" in caplog.text
    assert map_kept("kind", "a") is None
    remove_kept("kind", "a")
