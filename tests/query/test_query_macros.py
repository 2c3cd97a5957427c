"""The macros of SQL, against astropy, cdshealpix and the camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy import units as u
from astropy.coordinates import angular_separation
from cdshealpix.nested import lonlat_to_healpix
from mocpy import MOC

from starcat.errors import QueryError
from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import directions_from_radec
from starcat.pipeline.selection.merging import combined_magnitude
from starcat.query.gallery import macros
from starcat.query.session import Session, open_session

POLES_AND_SEAMS = [(0.0, 90.0), (123.0, -90.0), (0.0, 0.0), (360.0, 0.0), (359.999999, 41.81),
                   (45.0, 41.8103148957786), (90.0, -41.8103148957786), (270.0, 89.9999999),
                   (180.0, -89.9999999), (-10.0, 12.0), (725.0, -3.0)]  # fmt: skip


@pytest.fixture(scope="module")
def session(small_database: Path) -> Iterator[Session]:
    with open_session([str(small_database)]) as opened:
        yield opened


@pytest.fixture(scope="module")
def places() -> np.ndarray:
    """Right ascensions and declinations, degrees: 2,000 at random, and the awkward ones."""
    generator = np.random.default_rng(29)
    ra = generator.uniform(0.0, 360.0, 2000)
    dec = np.degrees(np.arcsin(generator.uniform(-1.0, 1.0, 2000)))
    return np.concatenate([np.column_stack([ra, dec]), POLES_AND_SEAMS])


@pytest.fixture(scope="module")
def others(places: np.ndarray) -> np.ndarray:
    """Four other places for each place: near, anywhere, opposite, and the place itself."""
    generator = np.random.default_rng(31)
    near = places + generator.normal(scale=1e-7, size=places.shape)
    far = generator.permutation(places)
    opposite = np.column_stack([places[:, 0] + 180.0, -places[:, 1]])
    return np.concatenate([near, far, opposite, places])


@pytest.fixture(scope="module")
def numbers_of(
    places: np.ndarray, others: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[..., np.ndarray]]:
    """Values of an expression of ra, dec, other_ra and other_dec, for the first pairs of places."""
    ra, dec = np.tile(places, (4, 1)).T
    other_ra, other_dec = others.T
    columns = {"ra": ra, "dec": dec, "other_ra": other_ra, "other_dec": other_dec}
    path = tmp_path_factory.mktemp("places") / "places.parquet"
    pq.write_table(pa.table({**columns, "row": np.arange(len(ra))}), path)
    with open_session([str(path)]) as opened:
        yield lambda text, count=None: column(
            opened, f"SELECT {text} FROM places ORDER BY row LIMIT {count or len(places)}"
        )


def column(session: Session, text: str, **values: object) -> np.ndarray:
    with session.ask(text, values) as answer:
        return answer.batches().read_all()[0].to_numpy()


def test_separations_are_those_of_astropy(numbers_of, places, others):
    found = numbers_of("separation(ra, dec, other_ra, other_dec)", len(others))
    radians = np.radians(np.tile(places, (4, 1))), np.radians(others)
    expected = np.degrees(angular_separation(*radians[0].T, *radians[1].T))
    assert np.abs(found - expected).max() < 1e-13 * 180.0
    assert (found[: len(places)] > 0.0).all(), "a ten-thousandth of an arcsecond is not lost"


@pytest.mark.parametrize("order", [0, 1, 3, 10, 20, 29])
def test_healpix_cells_are_those_of_cdshealpix(numbers_of, places, order):
    ra_deg, dec_deg = places.T
    found = numbers_of(f"healpix({order}, ra, dec)")
    expected = lonlat_to_healpix(ra_deg * u.deg, dec_deg * u.deg, order)
    # At order 29 a cell is 0.4 mas: rounding decides for a few places, on lines between cells.
    different = (found != expected.astype(np.int64)).sum()
    assert different <= (len(POLES_AND_SEAMS) + 4 if order == 29 else 4)
    assert different == 0 or order > 0


@pytest.mark.parametrize(
    "cells", ["0/1 1/20-22", "3/5-7 100 4/9", "29/0-1000000000000000000", "0/"]
)
def test_positions_in_a_moc_are_those_of_mocpy(numbers_of, places, cells):
    ra_deg, dec_deg = places.T
    found = numbers_of(f"in_moc(ra, dec, '{cells}')::INT")
    moc = MOC.from_string(cells, "ascii")
    expected = moc.contains_lonlat(ra_deg * u.deg, dec_deg * u.deg)
    # A place on the line between two cells belongs to either.
    assert (found != expected).sum() <= 4
    assert found.sum() > 0 or cells == "0/"


@pytest.mark.parametrize(
    "cells", ["nonsense", "1e3/2", "3/1.5", "7", "30/1", "0/1" + " 2" * 25_000]
)
def test_a_text_that_is_not_a_moc_is_an_error(session, cells):
    with pytest.raises(QueryError, match="in_moc"):
        column(session, f"SELECT in_moc(ra_deg, dec_deg, '{cells}') FROM stars")


def test_magnitudes_merge_as_light_does(session):
    (found,) = column(session, "SELECT mag_merge(4.0, 5.5)")
    assert found == pytest.approx(combined_magnitude(np.array([4.0, 5.5])), abs=1e-12)


@pytest.mark.parametrize("radius_deg", [0.0, 7.0, 60.0, 180.0])
@pytest.mark.parametrize("place", [(10.0, 20.0), (0.0, 90.0), (359.0, -88.0)])
def test_a_cone_holds_what_is_near(session, place, radius_deg):
    ra, dec, ids = (
        column(session, f"SELECT {name} FROM stars") for name in ("ra_deg", "dec_deg", "star_id")
    )
    apart = np.degrees(angular_separation(*np.radians([*place]), np.radians(ra), np.radians(dec)))
    query = "SELECT star_id FROM cone($ra, $dec, $radius) ORDER BY star_id"
    found = column(session, query, ra=place[0], dec=place[1], radius=radius_deg)
    assert np.array_equal(found, np.sort(ids[apart <= radius_deg]))


@pytest.mark.parametrize("cone", ["10, -95, 5", "10, 95, 5", "10, 5, -1", "10, 5, 'nan'::DOUBLE"])
def test_a_cone_that_does_not_exist_is_an_error(session, cone):
    with pytest.raises(QueryError, match="does not exist: give "):
        column(session, f"SELECT count(*) FROM cone({cone})")
    assert column(session, "SELECT count(*) FROM cone(10, 5, 0)").tolist() == [0]


def test_a_cone_can_be_of_another_table(session):
    query = "SELECT count(*) FROM cone(0, 0, 180, of := '{}')"
    for view in ("rejected", "boresights"):
        (every,) = column(session, f"SELECT count(*) FROM {view}")
        assert column(session, query.format(view))[0] == every > 0


def test_a_box_goes_through_zero(session):
    (every,) = column(session, "SELECT count(*) FROM stars WHERE dec_deg BETWEEN -30 AND 30")
    (through,) = column(session, "SELECT count(*) FROM box(300, 100, -30, 30)")
    (rest,) = column(session, "SELECT count(*) FROM box(100, 300, -30, 30)")
    assert 0 < through < every
    assert through + rest == every, "no star is at either end"


@pytest.mark.parametrize("pointing", [(83.6, -5.4, 0.0), (200.0, 89.5, 123.0), (0.0, -70.0, 300.0)])
def test_a_field_is_what_the_camera_sees(session, pointing):
    camera = Camera(800, 600, fov_x_deg=40.0)
    stars = [column(session, f"SELECT {c} FROM stars ORDER BY star_id")
             for c in ("ra_deg", "dec_deg", "star_id")]  # fmt: skip
    body = directions_from_radec(stars[0], stars[1]) @ matrix_from_radec_roll(*pointing).T
    pixels = camera.pixels_from_directions(body)
    inside = (body[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels <= [800, 600]).all(axis=1)
    query = "SELECT {} FROM field($ra, $dec, $roll, $x, $y) ORDER BY star_id"
    values = dict(zip(("ra", "dec", "roll"), pointing, strict=True))
    values |= {"x": camera.fov_x_deg, "y": camera.fov_y_deg}
    assert np.array_equal(column(session, query.format("star_id"), **values), stars[2][inside])
    for name, part in (("field_x_deg", 0), ("field_y_deg", 1)):
        angle = np.degrees(np.arctan2(body[inside, part], body[inside, 2]))
        assert np.abs(column(session, query.format(name), **values) - angle).max() < 1e-11
    assert inside.any()


@pytest.mark.parametrize("macro", macros(), ids=lambda macro: macro.name)
def test_every_macro_has_help_and_an_example_that_runs(session, macro):
    assert macro.help.endswith(".")
    assert f"{macro.name}(" in macro.example
    with session.ask(macro.example) as answer:
        assert answer.columns
        answer.rows(10)
