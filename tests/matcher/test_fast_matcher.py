"""The matcher in C identifies the same stars as the numpy matcher in every frame."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from frames import assert_same
from frames import frames_of as frames
from hypothesis import given
from hypothesis import strategies as st

from starcat.errors import ConfigError, ProductError
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.matcher import c_engine, search_tables
from starcat.matcher.batch import BatchResult
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import TriangleOrder
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame
from starcat.ship.exchange.onboard import export_image

pytestmark = pytest.mark.skipif(
    not c_engine.is_compiled(), reason="starcat was installed without a C compiler"
)

CAMERA = Camera(1024, 1024, fov_x_deg=20.0)
HARD = Noise(0.7, 0.15, 4, noise_mag=0.3)


@pytest.fixture(scope="module")
def sky(sky_of, random_directions) -> MatcherDatabase:
    return sky_of(random_directions(1200, 1))


def both(
    sky: MatcherDatabase, method: str = "triangle", **stated: float
) -> tuple[Matcher, Matcher]:
    """Return the matcher in C and the matcher in numpy."""
    return (
        Matcher(sky, method=method, engine="c", **stated),
        Matcher(sky, method=method, engine="numpy", **stated),
    )


def test_many_frames_are_identified_in_c_also_with_more_features(sky, monkeypatch):
    monkeypatch.setattr(c_engine, "MAX_FEATURES", 0)
    of_one = Matcher(replace(sky, star_id=sky.star_id.copy()))  # nothing is kept of another test
    assert of_one._c_engine is None
    of_many = of_one.for_many_frames()
    assert of_many.settings.engine == "c"
    for frame in frames(sky, 5, HARD, seed=12):
        assert_same(of_many.identify(frame), of_one.identify(frame))
    stated = Matcher(sky, engine="numpy")
    assert stated.for_many_frames() is stated


# --- The same stars


@pytest.mark.parametrize("method", c_engine.FEATURES)
@pytest.mark.parametrize("stated", [{}, {"noise_px": 0.7, "noise_mag": 0.3}, {"noise_mag": 0.5}])
@pytest.mark.parametrize("magnitudes", [False, True], ids=["places only", "magnitudes"])
def test_hard_frames_get_the_same_stars(sky, method, stated, magnitudes):
    in_c, in_numpy = both(sky, method, **stated)
    identified = others = 0
    for frame in frames(sky, 15, HARD, seed=11):
        mag = frame.mag if magnitudes else None
        found = in_c.identify(frame.centroids_px, mag=mag)
        expected = in_numpy.identify(frame.centroids_px, mag=mag)
        identified += expected.status == "identified"
        if method == "pyramid" and found.n_matched != expected.n_matched:
            # numpy starts from four stars and C from three: one faint star can be out of reach.
            both_have = (found.star_index >= 0) & (expected.star_index >= 0)
            assert found.star_index[both_have].tolist() == expected.star_index[both_have].tolist()
            others += 1
        else:
            assert_same(found, expected)
    assert identified > 9
    assert others <= 1


@given(
    seed=st.integers(0, 10_000),
    noise_px=st.floats(0.05, 0.7),
    missing=st.floats(0.0, 0.6),
    false_stars=st.integers(0, 25),
)
def test_a_frame_as_noisy_as_stated_gets_the_same_stars(sky, seed, noise_px, missing, false_stars):
    in_c, in_numpy = both(sky)
    (frame,) = frames(sky, 1, Noise(noise_px, missing, false_stars, noise_mag=0.5), seed)
    for mag in (None, frame.mag):
        expected = in_numpy.identify(frame.centroids_px, mag=mag)
        assert_same(in_c.identify(frame.centroids_px, mag=mag), expected)


@pytest.mark.parametrize("count", [5, pytest.param(40, marks=pytest.mark.slow)])
@pytest.mark.parametrize("stated", [{}, {"noise_px": 0.7, "noise_mag": 0.3}])
def test_false_spots_beside_stars_get_the_same_stars(sky, stated, count):
    in_c, in_numpy = both(sky, **stated)
    generator = np.random.default_rng(9)
    for frame in frames(sky, count, Noise(0.6, 0.3, noise_mag=0.3), seed=41):
        angle = generator.uniform(0.0, 2.0 * np.pi, len(frame.mag))
        beside = 6.0 * np.column_stack([np.cos(angle), np.sin(angle)])
        px = np.concatenate([frame.centroids_px, frame.centroids_px + beside])
        mag = np.concatenate([frame.mag, frame.mag + 0.1])
        expected = in_numpy.identify(px, mag=mag)
        assert_same(in_c.identify(px, mag=mag), expected)


LENSES = [Distortion(k1=-0.2), Distortion(k1=0.1, k2=-0.3, k3=0.2, p1=2e-3, p2=-1e-3)]


@pytest.mark.parametrize("lens", LENSES, ids=["barrel", "all terms"])
def test_a_distorted_camera_gets_the_same_stars(sky, lens):
    camera = Camera(
        1024, 768, CAMERA.focal_length_px, principal_point_px=(500.0, 400.5), distortion=lens
    )
    in_c, in_numpy = both(sky)
    generator = np.random.default_rng(5)
    whole = Sky(sky.directions, sky.mag, np.arange(len(sky.mag), dtype=np.int32))
    for frame in frames(sky, 12):
        seen = simulate_frame(whole, camera, frame.matrix, Noise(0.3), generator)
        expected = in_numpy.identify(seen.centroids_px, camera)
        assert expected.status == "identified"
        assert_same(in_c.identify(seen.centroids_px, camera), expected)


def test_what_cannot_be_used_is_reported_alike(sky):
    in_c, in_numpy = both(sky)
    (frame,) = frames(sky, 1, Noise(0.3))
    nan = np.nan
    odd = [[nan, 5], [5, nan], [-1, 5], [1024, 5], [5, 1024], [0, 0], *frame.centroids_px[:3]]
    given_px = np.concatenate([odd, frame.centroids_px])
    mag = np.concatenate([[nan, 1, 2, 3, 4, nan, 1.0, 9.0, nan], frame.mag])
    infinite = np.where(np.isnan(mag), -np.inf, mag)
    for magnitudes in (None, mag, infinite, np.full(len(mag), nan)):
        expected = in_numpy.identify(given_px, mag=magnitudes)
        assert len(expected.dropped) == 8
        assert_same(in_c.identify(given_px, mag=magnitudes), expected)
    for count in (0, 3, 4):
        few = frame.centroids_px[:count]
        assert_same(in_c.identify(few), in_numpy.identify(few))


def test_a_frame_that_is_too_large_for_the_library_is_answered(sky):
    (frame,) = frames(sky, 1)
    false = np.random.default_rng(8).random((600, 2)) * 1024.0
    mag = np.concatenate([frame.mag, np.full(600, 9.0)])
    found = Matcher(sky).identify(np.concatenate([frame.centroids_px, false]), mag=mag)
    assert len(found.star_index) > 600


def test_a_camera_that_is_too_wide_for_the_library_is_answered(sky):
    in_c, in_numpy = both(sky)
    (frame,) = frames(sky, 1)
    wide = Camera(1024, 1024, 1e-3)
    expected = in_numpy.identify(frame.centroids_px, wide)
    assert_same(in_c.identify(frame.centroids_px, wide), expected)
    assert [found.status for found in in_c.identify_many([frame.centroids_px], wide)] == [
        expected.status
    ]


# --- Many frames


def test_answers_do_not_depend_on_threads_or_on_company(sky):
    matcher = Matcher(sky, engine="c")
    some = frames(sky, 600, HARD, seed=21)
    px, mags = [frame.centroids_px for frame in some], [frame.mag for frame in some]
    one = matcher.identify_many(px, mag=mags, threads=1)
    four = matcher.identify_many(px, mag=mags, threads=4)
    assert isinstance(one, BatchResult)
    assert isinstance(four, BatchResult)
    assert one.status == four.status
    np.testing.assert_array_equal(one.q_body_from_icrs, four.q_body_from_icrs)
    assert (one.seconds > 0.0).all()
    for number in (0, 255, 256, 599, -1):
        alone = matcher.identify(px[number], mag=mags[number])
        for many in (one, four):
            assert many[number].star_ids.tolist() == alone.star_ids.tolist()
            assert np.array_equal(
                many[number].q_body_from_icrs, alone.q_body_from_icrs, equal_nan=True
            )
    assert [found.status for found in four[5:8]] == four.status[5:8]
    with pytest.raises(IndexError):
        one[600]


def test_frames_may_be_given_as_one_frame_may(sky):
    matcher = Matcher(sky, engine="c")
    frame, other = frames(sky, 2)
    px = [
        frame.centroids_px.tolist(),
        [],
        np.round(other.centroids_px).astype(int),
        np.asfortranarray(frame.centroids_px),
        np.repeat(frame.centroids_px, 2, axis=1)[:, ::2],
        frame.centroids_px.astype(np.float32),
    ]
    mags = [frame.mag.tolist(), [], None, frame.mag[::-1][::-1], frame.mag, frame.mag]
    for known in (None, mags):
        found = matcher.identify_many(px, mag=known)
        for number, given_px in enumerate(px):
            alone = matcher.identify(given_px, mag=known and known[number])
            assert_same(found[number], alone)
    assert [answer.ok for answer in found] == [True, False, True, True, True, True]
    assert len(matcher.identify_many([])) == 0
    for wrong in ([[1.0, 2.0, 3.0]], [1.0, 2.0], 5.0):
        with pytest.raises(ValueError, match="expected"):
            matcher.identify_many([frame.centroids_px, wrong])
    with pytest.raises(ValueError, match=r"mag has shape \(1,\); expected"):
        matcher.identify_many([frame.centroids_px], mag=[[1.0]])


def told(answer: MatchResult) -> list[str]:
    """Return all that an answer says."""
    facts = (answer.matrix, answer.q_body_from_icrs, answer.stars, answer.dropped, answer.frame)
    return [answer.status, repr(answer), *map(repr, facts), *map(str, answer.star_ids)]


def test_an_answer_keeps_its_values_when_the_next_frame_comes(sky):
    matcher = Matcher(sky, engine="c")
    some = frames(sky, 12, HARD, seed=5)
    expected = [told(matcher.identify(one.centroids_px, mag=one.mag)) for one in some]
    px, mag = np.empty((100, 2)), np.empty(100)
    found = []
    for one in some:  # the caller's memory is used again too
        count = len(one.mag)
        px[:count], mag[:count] = one.centroids_px, one.mag
        found.append(matcher.identify(px[:count], mag=mag[:count]))
    px[:], mag[:] = -1.0, 99.0
    assert [told(answer) for answer in found] == expected


def test_threads_that_share_a_matcher_get_the_answers_of_one(sky):
    matcher = Matcher(sky, engine="c")
    some = frames(sky, 200, HARD, seed=7)

    def ask(frame: SimulatedFrame) -> MatchResult:
        return matcher.identify(frame.centroids_px, mag=frame.mag)

    expected = [told(ask(frame)) for frame in some]
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(ask, some))
        assert list(pool.map(told, found)) == expected


def test_an_answer_that_was_not_read_is_whole(sky):
    matcher = Matcher(sky, engine="c")
    (frame,) = frames(sky, 1)
    expected = matcher.identify(frame.centroids_px)
    found = pickle.loads(pickle.dumps(matcher.identify(frame.centroids_px)))
    assert_same(found, expected)
    assert found.stars.star == expected.stars.star
    again = replace(matcher.identify(frame.centroids_px), residual_arcsec=1.0)
    assert (again.residual_arcsec, again.camera) == (1.0, sky.camera)
    assert again.star_ids.tolist() == expected.star_ids.tolist()
    assert type(again) is type(expected) is MatchResult
    with pytest.raises(AttributeError, match="no attribute 'attitude'"):
        _ = expected.attitude


# --- Engines


def test_the_library_serves_two_methods_as_they_are(sky):
    with pytest.raises(ConfigError, match="'pairs' is not in C; choose one of triangle, pyramid"):
        Matcher(sky, method="pairs", engine="c")
    with pytest.raises(ConfigError, match="no other selection"):
        Matcher(sky, engine="c", selection=TriangleOrder("inradius"))
    # Whoever asks for neither gets numpy.
    found = Matcher(sky, selection=TriangleOrder("inradius")).identify(np.zeros((0, 2)))
    assert found.status == "too_few_stars"


def test_a_matcher_goes_to_another_process(sky):
    (frame,) = frames(sky, 1)
    matcher = Matcher(sky, engine="c")
    expected = matcher.identify(frame.centroids_px)
    found = pickle.loads(pickle.dumps(matcher)).identify(frame.centroids_px)
    assert found.star_ids.tolist() == expected.star_ids.tolist()


# --- Images


def test_an_image_is_matched_as_its_database(small_database, tmp_path):
    for method in c_engine.FEATURES:
        path = tmp_path / f"{method}.img"
        export_image(small_database, "onboard", path, method=method)
        ground, flight = Matcher.open(small_database, method), Matcher.open(path)
        assert flight.settings.method == method
        assert flight.database.name == ground.database.name
        for frame in frames(ground.database, 10):
            expected, found = (matcher.identify(frame.centroids_px) for matcher in (ground, flight))
            assert found.star_ids.tolist() == expected.star_ids.tolist()
            # A direction is rounded by 0.0001 arcsec; three stars in a line make more of it.
            np.testing.assert_allclose(
                found.q_body_from_icrs, expected.q_body_from_icrs, atol=1e-7, equal_nan=True
            )


def test_an_image_has_nothing_for_a_camera_that_is_too_wide(small_database, tmp_path):
    path = tmp_path / "db.img"
    export_image(small_database, "onboard", path)
    frame, wide = np.random.default_rng(3).random((600, 2)) * 500.0, Camera(1024, 1024, 1e-3)
    matcher = Matcher.open(path)
    assert matcher.identify(frame).n_not_searched == 600 - 512
    with pytest.raises(ConfigError, match="512 centroids and this camera are beyond the C library"):
        matcher.identify(frame, wide)


def test_an_image_for_another_machine_is_refused(small_database, tmp_path):
    path = tmp_path / "db.img"
    export_image(small_database, "onboard", path, endian="big")
    with pytest.raises(ProductError, match="the other byte order"):
        Matcher.open(path)
    with pytest.raises(ConfigError, match="needs a database"):
        Matcher.open(path, engine="numpy")


def test_an_image_is_not_opened_where_a_field_is_too_full(sky, monkeypatch):
    crowded = replace(sky, camera=Camera(1024, 1024, fov_x_deg=110.0))
    made = search_tables.make_image
    monkeypatch.setattr(
        search_tables, "make_image", lambda one: replace(made(one), most_near=10**6)
    )
    assert c_engine.c_engine(crowded, "triangle") is None
    with pytest.raises(ConfigError, match="too many stars"):
        Matcher(crowded, engine="c")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("stated", [{}, {"noise_px": 0.5, "noise_mag": 0.3}])
def test_50_000_frames_of_random_points_get_no_answer(sky, stated):
    matcher = Matcher(sky, engine="c", **stated)
    generator = np.random.default_rng(17)
    for _ in range(50):
        counts = generator.integers(4, 21, 1000)
        px = [generator.random((count, 2)) * 1024.0 for count in counts]
        mags = [generator.choice(sky.mag, count) for count in counts]
        found = matcher.identify_many(px, mag=mags)
        assert set(found.status) == {"no_match"}
