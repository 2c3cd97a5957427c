"""Pairs of rows of two tables in SQL, against all pairs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from starcat.errors import QueryError
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, separation
from starcat.query.session import Session, open_session

EDGES = [(0.0, 90.0), (200.0, 90.0), (0.0, 0.0), (359.9999999, 0.0), (1e-7, 0.0), (180.0, -90.0),
         (45.0, 89.9999), (225.0, 89.9999), (0.0, 89.9), (360.0 - 1e-9, 45.0)]  # fmt: skip


def scattered(seed: int, radius_deg: float) -> np.ndarray:
    """Return places around each edge of the sphere, within three radii and at random."""
    generator = np.random.default_rng(seed)
    centres = directions_from_radec(*np.array(EDGES).T)
    steps = generator.normal(scale=np.radians(radius_deg), size=(40, len(EDGES), 3))
    near = (centres + steps).reshape(-1, 3)
    far = generator.normal(size=(300, 3))
    unit = np.concatenate([near, far])
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    return np.concatenate([np.column_stack(radec_from_directions(unit)), EDGES])


def written(path: Path, places: np.ndarray, **columns: np.ndarray) -> str:
    content = {"ra_deg": places[:, 0], "dec_deg": places[:, 1], "row": np.arange(len(places))}
    pq.write_table(pa.table(content | columns), path)
    return str(path)


def pairs(session: Session, radius_arcsec: float, more: str = "") -> dict[tuple[int, int], float]:
    asked = f"SELECT a_row, b_row, separation_arcsec FROM crossmatch('a', 'b', $r{more})"
    with session.ask(asked, {"r": radius_arcsec}) as answer:
        rows = answer.batches().read_all().to_pydict()
    found = dict(zip(zip(rows["a_row"], rows["b_row"], strict=True), rows["separation_arcsec"],
                     strict=True))  # fmt: skip
    assert len(found) == len(rows["a_row"]), "no pair comes twice"
    return found


@pytest.mark.parametrize(
    "radius_arcsec",
    [
        60.0,
        40 * 3600.0,
        *(pytest.param(radius, marks=pytest.mark.slow) for radius in (0.5, 7200.0)),
    ],
)
def test_no_pair_is_missed_and_none_is_made_up(tmp_path, radius_arcsec):
    ones, others = (scattered(seed, radius_arcsec / 3600.0) for seed in (5, 6))
    given = [written(tmp_path / "one.parquet", ones), written(tmp_path / "two.parquet", others)]
    with open_session(given) as session:
        found = pairs(session, radius_arcsec)
        nearest = pairs(session, radius_arcsec, ", nearest := true")
    u_one, u_two = directions_from_radec(*ones.T), directions_from_radec(*others.T)
    apart = np.degrees(separation(u_one[:, None, :], u_two[None, :, :])) * 3600.0
    expected = set(zip(*(k.tolist() for k in np.nonzero(apart <= radius_arcsec)), strict=True))
    assert len(expected) > 300
    assert {pair for pair in found.keys() ^ expected
            if abs(apart[pair] - radius_arcsec) > 1e-9} == set()  # fmt: skip
    assert max(abs(apart[pair] - value) for pair, value in found.items()) < 1e-9
    least = apart.min(axis=1)
    assert {i for i, _ in nearest} == {i for i, _ in found}
    assert all(abs(value - least[i]) < 1e-9 for (i, _), value in nearest.items())


def test_motions_are_compared_at_the_epoch(tmp_path):
    """A star that moves 10 arcsec per year, and a star without a motion at its place of 1990."""
    moving = {
        "epoch_jyear": np.array([2016.0]),
        "pm_ra_cosdec_mas_yr": np.array([10_000.0]),
        "pm_dec_mas_yr": np.array([0.0]),
    }
    place, before = np.array([[0.05, 10.0]]), 26.0 * 10.0 / 3600.0 / np.cos(np.radians(10.0))
    ones = written(tmp_path / "one.parquet", place, **moving)
    twos = written(tmp_path / "two.parquet", (place - [before, 0.0]) % 360.0)
    with open_session([ones, twos]) as session:
        assert pairs(session, 5.0) == {}
        assert pairs(session, 5.0, ", epoch := NULL") == {}
        assert pairs(session, 5.0, ", epoch := 1990.0")[0, 0] < 0.1


def test_any_table_of_a_target_is_matched(small_database):
    queries = {
        "SELECT count(*) FROM crossmatch('stars', 'stars', 1, nearest := true) "
        "WHERE a_star_id = b_star_id": "SELECT count(*) FROM stars",
        "SELECT count(DISTINCT a_star_id) FROM crossmatch('REJECTED', 'stars', 60)":
        "SELECT count(DISTINCT r.star_id) FROM rejected r JOIN stars s ON separation(r.ra_deg, "
        "r.dec_deg, s.ra_deg, s.dec_deg) <= 60 / 3600",
    }  # fmt: skip
    with open_session([str(small_database)]) as session:
        for query, same in queries.items():
            with session.ask(query) as answer, session.ask(same) as expected:
                assert answer.rows(1) == expected.rows(1)
        for text in ("nosuch", 'a"."b', "/etc/passwd", "x'; DROP VIEW stars; --"):
            with pytest.raises(QueryError), session.ask(
                "FROM crossmatch($t, 'stars', 1)", {"t": text}
            ) as answer:  # fmt: skip
                answer.rows(1)


def test_a_new_process_answers_a_query_that_was_checked_before(tmp_path):
    path = written(tmp_path / "one.parquet", scattered(5, 0.1)[:20])
    with open_session([path]) as session:
        asked = "SELECT count(*) FROM crossmatch('main', 'main', 60)"
        with session.ask(asked) as answer:
            first = answer.rows(1)
        session._engine.close()  # as after a limit
        with session.ask(asked) as answer:
            assert answer.rows(1) == first
