"""Search tables: made by the first process, mapped by the others, never wrong."""

import logging
import pickle
from dataclasses import replace

import numpy as np
import pytest

import starcat
from starcat.database.onboard.image import Contents, make_image
from starcat.database.onboard.layout import BLOCK_BYTES
from starcat.matcher import search_tables
from starcat.matcher.c_engine import is_compiled
from starcat.matcher.matcher import Matcher
from starcat.storage.atomic import file_sha256

pytestmark = pytest.mark.skipif(not is_compiled(), reason="needs the C library")

MADE = "making the search tables of small-1.0.0, once: "


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(search_tables, "KEPT_FEATURES", 1)
    return tmp_path / "cache" / "search-tables"


@pytest.fixture
def frames(small_database):
    return starcat.simulate(small_database, 5, seed=3)


@pytest.fixture
def answers(small_database, frames, caplog):
    """Answers of a new matcher, and whether it made its tables."""

    def identify(**options):
        caplog.clear()
        with caplog.at_level(logging.INFO, logger="starcat"):
            matcher = Matcher.open(small_database, **options)
            found = [matcher.identify(frame.centroids_px, mag=frame.mag) for frame in frames]
        return [one.q_body_from_icrs.tolist() for one in found], MADE in caplog.text

    return identify


def image_of(database, **changes):
    """Return the bytes of the image of a database's triangles."""
    triangles = np.stack([database.products["triangles"][name] for name in "ijk"], axis=-1)
    names = ("name", "epoch_jyear", "camera", "star_id", "directions", "mag")
    facts = {name: getattr(database, name) for name in names} | changes
    return make_image(Contents(**facts, method="triangle", features=triangles)).data


@pytest.mark.parametrize("method", ["triangle", "pyramid"])
def test_the_second_process_finds_the_tables_of_the_first(cache, answers, small_database, method):
    first, is_made = answers(method=method)
    assert is_made
    [path] = cache.iterdir()
    digest = file_sha256(small_database / "database.h5")
    assert path.name == f"{digest}-{method}-1.0.img"
    assert answers(method=method) == (first, False)
    assert list(cache.iterdir()) == [path]


def test_the_kept_file_is_the_image_of_the_database(cache, answers, small_database):
    answers()
    [path] = cache.iterdir()
    assert path.read_bytes() == image_of(Matcher.open(small_database).database)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: data[:-BLOCK_BYTES],
        lambda data: data[:9000] + bytes([data[9000] ^ 1]) + data[9001:],
        lambda data: bytes(len(data)),
    ],
)
def test_damaged_tables_are_made_again(cache, answers, damage):
    first, _ = answers()
    [path] = cache.iterdir()
    sound = path.read_bytes()
    path.write_bytes(damage(sound))
    assert answers() == (first, True)
    assert path.read_bytes() == sound


def test_tables_of_other_stars_are_not_used(cache, answers, small_database):
    first, _ = answers()
    [path] = cache.iterdir()
    known = Matcher.open(small_database).database
    path.write_bytes(image_of(known, star_id=known.star_id + 1))
    assert answers() == (first, True)


def test_without_a_cache_the_tables_are_in_memory(cache, answers):
    first, _ = answers()
    for path in cache.iterdir():
        path.unlink()
    cache.rmdir()
    cache.write_text("a file where the folder should be")
    assert answers() == (first, True)
    assert answers() == (first, True)


def test_a_database_that_was_not_verified_has_the_same_tables(cache, answers):
    assert answers(verify=False) == (answers()[0], True)
    assert answers(verify=False) == (answers()[0], False)
    assert len(list(cache.iterdir())) == 1


@pytest.mark.parametrize("verify", [False, True])
def test_only_a_file_as_it_is_has_kept_tables(cache, small_database, verify):
    known = Matcher.open(small_database, verify=verify).database
    assert known.file_digest() == file_sha256(small_database / "database.h5")
    changed = replace(known, mag=known.mag + 1.0)
    assert changed.file_digest() is None
    assert search_tables.search_tables(changed, "triangle") is not None
    assert not cache.exists()
    assert pickle.loads(pickle.dumps(known)).sha256 == known.sha256


def test_small_databases_write_nothing(cache, answers, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("STARCAT_CACHE", str(cache.parent))
    assert not answers()[1]
    assert not cache.exists()


def test_the_command_says_that_it_makes_them(
    cache, starcat, small_database, frames, tmp_path, monkeypatch
):
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "cache"))
    px = frames[0].centroids_px
    path = tmp_path / "frame.csv"
    path.write_text("x_px,y_px\n" + "".join(f"{x},{y}\n" for x, y in px))
    assert MADE in starcat(["identify", small_database, path]).err
    assert MADE not in starcat(["identify", small_database, path]).err
