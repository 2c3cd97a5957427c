"""Contents of an answer: its stars, the error of the attitude, directions of pixels, refusals."""

from __future__ import annotations

import math
import pickle
from dataclasses import fields, replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from frames import ARCSEC, both_engines, error_arcsec, needs_c

from starcat.errors import NotIdentifiedError
from starcat.geometry import attitude as attitudes
from starcat.geometry.attitude import matrix_from_quaternion, matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.geometry.sphere import directions_from_radec
from starcat.matcher import sky_objects
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.pose import student_widening
from starcat.matcher.refusal import HINTS, MESSAGES, Refusal
from starcat.matcher.result import MatchResult
from starcat.matcher.stars import MatchedStars, attitude_covariance
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, simulate_frames
from starcat.ship.exchange.onboard import export_image

ALL_TERMS = Distortion(k1=-0.2, k2=0.05, k3=0.3, p1=1e-3, p2=-2e-3)
OFF, WIDE = {"principal_point_px": (610.0, 510.5)}, {"principal_point_px": (600.0, 500.0)}
LENSES = {
    "pincushion": Camera(1024, 768, fov_x_deg=11.42, distortion=Distortion(k1=0.6, k2=-2.0)),
    "all terms, off the middle": Camera(1280, 960, fov_x_deg=20.0, distortion=ALL_TERMS, **OFF),
    "wide": Camera(1280, 960, fov_x_deg=50.0, distortion=Distortion(k1=-0.2, k2=0.05), **WIDE),
}

PINHOLES = {
    "narrow": Camera(1024, 1024, fov_x_deg=1.0),
    "usual": Camera(1024, 768, fov_x_deg=11.42),
    "wide, off the middle": Camera(1280, 960, fov_x_deg=90.0, **WIDE),
}

ATTITUDES = [(123.4, -34.5, 71.0), (0.0, 0.0, 0.0), (10.0, 89.99, 200.0), (0.0, -90.0, 33.0)]


def a_frame(
    sky: MatcherDatabase, camera: Camera, noise: Noise | None = None, seed: int = 5
) -> SimulatedFrame:
    frames = simulate_frames(sky.directions, camera, 1, noise or Noise(), seed, sky.mag)
    return next(iter(frames))


def answer(sky: MatcherDatabase, **stated: object) -> tuple[SimulatedFrame, MatchResult]:
    frame = a_frame(sky, sky.camera, Noise(0.4, 0.1, 3, noise_mag=0.2))
    matcher = Matcher(sky, **stated)  # type: ignore[arg-type]
    return frame, matcher.identify(frame.centroids_px, mag=frame.mag)


def found_by_hand(camera: Camera, matrix: np.ndarray) -> MatchResult:
    return MatchResult("identified", np.empty(0, np.int32), matrix, 0.0, 0.0, camera=camera)


def worst_px(camera: Camera, matrix: np.ndarray, *, bottom_up: bool = False) -> float:
    """Largest difference between camera and WCS, from pixels to the sky and from there back."""
    made = found_by_hand(camera, matrix).wcs(bottom_up=bottom_up)
    sides = np.linspace(0.0, camera.width_px, 47), np.linspace(0.0, camera.height_px, 39)
    px = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    in_file = px[:, 0] - 0.5, (camera.height_px - px[:, 1] if bottom_up else px[:, 1]) - 0.5
    place = made.pixel_to_world(*in_file)
    directions = directions_from_radec(place.icrs.ra.deg, place.icrs.dec.deg)
    there = np.abs(camera.pixels_from_directions(directions @ matrix.T) - px).max()
    true = camera.directions_from_pixels(px) @ matrix
    sky_place = SkyCoord(*true.T, representation_type="cartesian").represent_as("unitspherical")
    back = made.world_to_pixel(SkyCoord(sky_place, frame="icrs"))
    return max(float(there), float(np.abs(np.subtract(back, in_file)).max()))


@pytest.mark.parametrize("bottom_up", [False, True], ids=["top down", "bottom up"])
@pytest.mark.parametrize("attitude", ATTITUDES, ids=str)
@pytest.mark.parametrize("camera", PINHOLES.values(), ids=PINHOLES)
def test_the_wcs_of_a_pinhole_is_the_camera(camera, attitude, bottom_up):
    assert worst_px(camera, matrix_from_radec_roll(*attitude), bottom_up=bottom_up) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("bottom_up", [False, True], ids=["top down", "bottom up"])
@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_the_wcs_of_a_lens_is_the_camera_to_a_hundredth_of_a_pixel(camera, bottom_up):
    assert worst_px(camera, matrix_from_radec_roll(*ATTITUDES[0]), bottom_up=bottom_up) < 0.01


def test_the_polynomials_that_put_the_distortion_back_are_as_good():
    # astropy inverts the others; programs that take AP and BP as they are want these.
    camera = LENSES["all terms, off the middle"]
    made = found_by_hand(camera, np.eye(3)).wcs()
    px = np.random.default_rng(1).random((500, 2)) * [1280.0, 960.0]
    plain = made.pix2foc(px + 0.5, 1)
    seen = made.sip.foc2pix(plain - made.wcs.crpix, 1)
    assert np.abs(seen - (px + 0.5)).max() < 0.01
    again = WCS(made.to_header(relax=True))  # they outlive their header
    places = (wcs.pixel_to_world(*px.T - 0.5) for wcs in (made, again))
    assert next(places).separation(next(places)).arcsec.max() < 1e-6


def test_a_lens_beyond_the_polynomials_is_said(caplog):
    wide = Camera(1280, 960, fov_x_deg=90.0, distortion=Distortion(k1=-0.1, k2=0.01))
    sky_objects.wcs(wide, np.eye(3))
    assert "beyond polynomials of order 9" in caplog.text


def test_a_pixel_is_a_place_in_the_sky_with_any_of_many_frames(sky):
    frames = list(simulate_frames(sky.directions, sky.camera, 4, Noise(0.0), 3, sky.mag))
    answers = Matcher(sky).identify_many([frame.centroids_px for frame in frames])
    for frame, found in zip(frames, answers, strict=True):
        place, stars = found.wcs().pixel_to_world(*(frame.centroids_px.T - 0.5)), found.table()
        expected = SkyCoord(stars["ra_deg"], stars["dec_deg"])
        assert place[stars["spot"]].separation(expected).arcsec.max() < 1e-3


@both_engines
def test_the_stars_are_those_of_the_truth(sky, engine):
    frame, found = answer(sky, engine=engine)
    stars = found.stars
    assert len(stars) == found.n_matched > 10
    assert stars.spot.tolist() == np.flatnonzero(found.star_index >= 0).tolist()
    for row in range(len(stars)):
        spot, star = stars.spot[row], stars.star_index[row]
        assert (stars.star_id[row], stars.star[row]) == (sky.star_id[star], "star")
        assert (stars.x_px[row], stars.y_px[row]) == tuple(frame.centroids_px[spot])
        # One star after the other, by the definition of each number.
        direction = sky.directions[star]
        body = matrix_from_quaternion(found.q_body_from_icrs) @ direction
        place = 512.0 + sky.camera.focal_length_px * body[:2] / body[2]
        assert stars.dx_px[row] == pytest.approx(frame.centroids_px[spot, 0] - place[0], abs=1e-9)
        assert stars.dy_px[row] == pytest.approx(frame.centroids_px[spot, 1] - place[1], abs=1e-9)
        seen = sky.camera.directions_from_pixels(frame.centroids_px[spot][None])[0]
        angle = math.asin(float(np.linalg.norm(np.cross(seen, body)))) * ARCSEC
        assert stars.separation_arcsec[row] == pytest.approx(angle, abs=1e-6)
        same = directions_from_radec(stars.ra_deg[row], stars.dec_deg[row])
        assert np.abs(same - direction).max() < 1e-15 * 10
        assert stars.difference_mag[row] == frame.mag[spot] - sky.mag[star]
    rms = math.sqrt(float(np.mean(stars.separation_arcsec**2)))
    assert found.residual_arcsec == pytest.approx(rms, rel=1e-6)
    assert found.camera == sky.camera
    assert found.time_s > 0.0
    same = {field.name: getattr(stars, field.name)[:1] for field in fields(MatchedStars)}
    # Stars at one place determine no attitude.
    assert np.isnan(attitude_covariance(MatchedStars(**same), sky.camera)).all()


def test_the_table_has_units_and_says_what_it_is_of(sky):
    frame, found = answer(sky)
    stars = found.table()
    assert len(stars) == found.n_matched
    assert stars["ra_deg"].unit == u.deg
    assert stars["dx_px"].unit == u.pix
    assert stars["separation_arcsec"].unit == u.arcsec
    assert stars["mag"].unit == stars["difference_mag"].unit == u.mag
    assert stars["star_id"].dtype == np.int64
    assert stars.meta["epoch_jyear"] == 2026.0
    assert stars.meta["q_body_from_icrs"] == found.q_body_from_icrs.tolist()
    without = Matcher(sky).identify(frame.centroids_px).table()
    assert np.isnan(without["difference_mag"]).all()


def test_an_answer_is_shown_in_a_line_and_in_a_notebook(sky):
    named = replace(sky, designation=np.full(len(sky.mag), b"<b>"))
    _, found = answer(named)
    assert found.refusal is None
    assert "\n" not in repr(found)
    shown = found._repr_html_()
    assert shown.count("<tr>") == found.n_matched + 1
    assert "&lt;b&gt;" in shown
    assert "<b>" not in shown


def test_a_frame_without_an_answer_has_no_stars_and_no_place(sky):
    found = Matcher(sky).identify([[1.0, 2.0]])
    assert (found.ok, found.status) == (False, "too_few_stars")
    assert len(found.stars) == len(found.table()) == 0
    assert np.isnan(found.covariance_arcsec2).all()
    for ask in (found.wcs, lambda: found.skycoord):
        with pytest.raises(NotIdentifiedError, match=r"status is too_few_stars; look at 'ok'"):
            ask()


def test_an_answer_goes_to_another_process_without_its_database(sky):
    _, found = answer(sky)
    data = pickle.dumps(found)
    assert len(data) < 20_000
    again = pickle.loads(data)
    assert again.stars.ra_deg.tolist() == found.stars.ra_deg.tolist()
    assert again.covariance_arcsec2.tolist() == found.covariance_arcsec2.tolist()
    assert again.wcs().wcs.crval.tolist() == found.wcs().wcs.crval.tolist()
    assert len(again.table()) == found.n_matched


@both_engines
def test_answers_to_many_frames_go_to_another_process(sky, engine):
    frames = [a_frame(sky, sky.camera, seed=seed).centroids_px for seed in (5, 6)]
    # The last one has more centroids than the C library takes.
    crowd = np.random.default_rng(1).uniform(0.0, sky.camera.height_px, (600, 2))
    found = Matcher(sky, engine=engine).identify_many([*frames, [[1.0, 2.0]], crowd])
    data = pickle.dumps(found)
    again = pickle.loads(data)
    assert len(data) < 100_000
    assert list(again) == list(found)
    assert again.status == found.status
    assert again.q_body_from_icrs.tobytes() == found.q_body_from_icrs.tobytes()
    assert again.seconds.tolist() == found.seconds.tolist()
    assert again[0].stars.ra_deg.tolist() == found[0].stars.ra_deg.tolist()
    assert (len(again[1:3]), again[-1].status) == (2, found[-1].status)


def deviations(
    sky: MatcherDatabase, camera: Camera, noise_px: float, *, is_stated: bool
) -> tuple[np.ndarray, int]:
    """Squared errors of attitudes in units of their covariance, and the stars of a frame."""
    frame, generator = a_frame(sky, camera, Noise(0.0)), np.random.default_rng(8)
    stated = {"noise_px": noise_px} if is_stated else {"tolerance_px": 4.0 * noise_px}
    matcher, squares, stars = Matcher(sky, **stated), [], []
    for _ in range(200):
        px = frame.centroids_px + generator.normal(0.0, noise_px, frame.centroids_px.shape)
        found = matcher.identify(px, camera)
        assert found.ok
        angles = error_arcsec(found, frame.matrix)
        squares.append(angles @ np.linalg.solve(found.covariance_arcsec2, angles))
        stars.append(found.n_matched)
    return np.array(squares), int(np.median(stars))


CAMERAS = {
    "20 deg": Camera(1024, 1024, fov_x_deg=20.0),
    "70 deg": Camera(1024, 1024, fov_x_deg=70.0, principal_point_px=(400.0, 560.0)),
    "lens": Camera(1024, 1024, fov_x_deg=30.0, distortion=Distortion(k1=-0.5)),
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_errors_are_as_the_covariance_of_a_stated_noise_says(sky, camera):
    squares, _ = deviations(sky, camera, 0.3, is_stated=True)
    # The mean of 200 chi-squares of 3 degrees has a standard deviation of sqrt(6 / 200) = 0.17.
    assert abs(squares.mean() - 3.0) < 3.0 * 0.17
    # 5 % of them lie above 7.81.
    assert 2 <= (squares > 7.81).sum() <= 20


def test_errors_are_as_the_covariance_of_the_residuals_says(sky):
    squares, count = deviations(sky, CAMERAS["20 deg"], 0.3, is_stated=False)
    freedom = 2 * count - 3
    expected = 3.0 * freedom / (freedom - 2) / student_widening(freedom) ** 2  # of three times an F
    assert abs(squares.mean() - expected) < 0.2 * expected


def test_a_narrow_field_has_the_covariance_of_shuster(sky):
    camera = Camera(1024, 1024, fov_x_deg=20.0)
    _, found = answer(sky, noise_px=0.4)
    body = camera.directions_from_pixels(np.column_stack([found.stars.x_px, found.stars.y_px]))
    sigma = 0.4 / camera.focal_length_px * ARCSEC
    simple = sigma**2 * np.linalg.inv(len(body) * np.eye(3) - body.T @ body)
    np.testing.assert_allclose(found.covariance_arcsec2.diagonal(), simple.diagonal(), rtol=0.06)
    assert found.covariance_arcsec2[2, 2] > 20.0 * found.covariance_arcsec2[0, 0]


def test_every_reason_has_a_message_and_a_hint():
    assert MESSAGES.keys() == HINTS.keys()
    for reason in MESSAGES:
        for told in (Refusal(reason), Refusal(reason, 5, 3e-4, 0.25)):
            assert len(told.hint) > 20
            assert "\n" not in repr(told)
            assert len(repr(told)) < 200
    told = Refusal("chance", 5, 3e-4, 0.25, 9)
    assert "5 of 9 centroids, chance 3.0e-04, 25% of the frame" in told.message


@both_engines
def test_an_answer_says_why_it_is_none(sky, engine):
    matcher = Matcher(sky, engine=engine)
    found = matcher.identify([[1.0, 2.0], [30.0, 40.0], [np.nan, 1.0]])
    assert found.refusal == Refusal("too_few_stars")
    assert repr(found) == "<MatchResult too_few_stars: 3 centroids (1 dropped)>"
    assert "fewer than 4 centroids" in found._repr_html_()
    px = np.random.default_rng(3).random((8, 2)) * 1024.0
    found = matcher.identify(px)
    assert found.refusal == Matcher(sky, engine="numpy").identify(px).refusal
    assert repr(found) == f"<MatchResult no_match: 8 centroids, {found.refusal.reason}>"
    assert found.refusal.hint.split(",")[0] in found._repr_html_()


@needs_c
def test_an_attitude_that_is_not_near_the_prior_is_the_reason(sky):
    frame = a_frame(sky, sky.camera)
    away = matrix_from_radec_roll(0.0, 90.0, 0.0) @ frame.matrix
    found = Matcher(sky, engine="c").identify(
        frame.centroids_px, prior=attitudes.quaternion_from_matrix(away), prior_error_deg=0.1
    )
    assert found.status == "no_match"
    assert found.refusal is not None
    assert found.refusal.reason == "prior"


@needs_c
def test_an_onboard_image_tells_the_same(small_database, tmp_path):
    export_image(small_database, "onboard", tmp_path / "db.img")
    ground, flight = Matcher.open(small_database), Matcher.open(tmp_path / "db.img")
    frame = a_frame(ground.database, ground.database.camera)
    one, other = (matcher.identify(frame.centroids_px) for matcher in (ground, flight))
    assert one.stars.star_id.tolist() == other.stars.star_id.tolist()
    assert other.stars.star == tuple(map(str, other.stars.star_id))
    # The directions of an image are rounded, to some milliarcseconds.
    assert np.abs(one.stars.dx_px - other.stars.dx_px).max() < 1e-3
    px = np.random.default_rng(3).random((5, 2)) * 512.0
    assert flight.identify(px).status == "no_match"
    assert flight.identify(px).refusal == ground.identify(px).refusal is not None
    assert "no_match" in flight.identify(px)._repr_html_()
