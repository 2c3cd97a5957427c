"""The interface of nova.astrometry.net: its clients have their pictures solved by the service."""

from __future__ import annotations

import io
import json
import os
from dataclasses import dataclass

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from database_copies import copied
from rendered import picture_of
from served import serve
from services import DATABASE, OTHER, add_database, client_of, token_of

from starcat.geometry.attitude import radec_roll_from_matrix
from starcat.geometry.camera import Camera
from starcat.matcher.database import open_database
from starcat.pipeline.build import build
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
from starcat.pipeline.specs.build_spec import CameraSpec
from starcat.pipeline.starter import starter_spec
from starcat_service.api.nova import calibration_of
from starcat_service.candidates import try_each


def sent(client, address, arguments, **files):
    """Send what nova's clients send: JSON in a field of a form."""
    return client.post(address, data={"request-json": json.dumps(arguments)}, files=files or None)


@pytest.fixture(scope="module")
def frame(small_database):
    """A frame with many stars of the small database."""
    database = open_database(small_database)
    frames = simulate_frames(
        database.directions, database.camera, 10, Noise(noise_px=0.05), 5, database.mag
    )
    return max(frames, key=lambda frame: len(frame.mag))


def test_a_picture_is_solved(client, frame, small_database):
    camera = open_database(small_database).camera
    session = sent(client, "/api/login", {"apikey": "any"}).json()["session"]
    answer = sent(
        client, "/api/upload", {"session": session}, file=("a.fits", picture_of(frame, camera))
    ).json()
    assert answer["status"] == "success"
    number = answer["subid"]
    assert client.get(f"/api/submissions/{number}").json()["jobs"] == [number]
    assert client.get(f"/api/jobs/{number}").json() == {"status": "success"}
    calibration = client.get(f"/api/jobs/{number}/calibration/").json()
    ra_deg, dec_deg, _ = radec_roll_from_matrix(frame.matrix)
    truth = SkyCoord(ra_deg, dec_deg, unit="deg")
    assert truth.separation(SkyCoord(calibration["ra"], calibration["dec"], unit="deg")).arcsec < 60
    assert calibration["width_arcsec"] / 3600 == pytest.approx(
        np.degrees(camera.width_px / camera.focal_length_px), rel=0.01
    )
    info = client.get(f"/api/jobs/{number}/info/").json()
    assert info["calibration"] == calibration
    assert len(info["objects_in_field"]) >= 4
    objects = client.get(f"/api/jobs/{number}/objects_in_field/").json()
    assert objects["objects_in_field"] == info["objects_in_field"]
    wcs = WCS(fits.Header.fromstring(client.get(f"/wcs_file/{number}").text), naxis=2)
    for star in client.get(f"/api/jobs/{number}/annotations/").json()["annotations"]:
        assert star["names"][0] in info["objects_in_field"]
        assert 0.5 <= star["pixelx"] <= camera.width_px + 0.5  # pixels of FITS
    middle = wcs.pixel_to_world(0.5 * camera.width_px - 0.5, 0.5 * camera.height_px - 0.5)
    assert truth.separation(middle).arcsec < 60


def test_centroids_are_solved_whichever_way_y_counts(client, frame, small_database):
    camera = open_database(small_database).camera
    x, y = frame.centroids_px.T + 0.5
    size = {"image_width": camera.width_px, "image_height": camera.height_px}
    for rows in (y, camera.height_px + 1 - y):
        answer = sent(client, "/api/upload", {"x": x.tolist(), "y": rows.tolist(), **size}).json()
        calibration = client.get(f"/api/jobs/{answer['subid']}/calibration").json()
        ra_deg, dec_deg, _ = radec_roll_from_matrix(frame.matrix)
        truth = SkyCoord(ra_deg, dec_deg, unit="deg")
        assert (
            truth.separation(SkyCoord(calibration["ra"], calibration["dec"], unit="deg")).arcsec
            < 60
        )


@pytest.mark.parametrize("turn_deg", [-170.0, -30.0, 0.0, 75.0])
@pytest.mark.parametrize("parity", [1.0, -1.0])
def test_a_calibration_says_where_up_is(turn_deg, parity):
    """Up is the second axis; its position angle by astropy is what nova calls orientation."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], [40.0, 20.0]
    wcs.wcs.crpix = [500.5, 400.5]
    turn = np.radians(turn_deg)
    flip = np.diag([parity, 1.0]) * 0.01
    wcs.wcs.cd = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) @ flip
    header = wcs.to_header()
    header["IMAGEW"], header["IMAGEH"] = 1000, 800
    calibration = calibration_of(header.tostring())
    assert (calibration["ra"], calibration["dec"]) == pytest.approx((40.0, 20.0))
    assert calibration["pixscale"] == pytest.approx(36.0)
    assert calibration["parity"] == parity
    centre, above = wcs.pixel_to_world(499.5, 399.5), wcs.pixel_to_world(499.5, 400.5)
    up_deg = centre.position_angle(above).deg
    assert (calibration["orientation"] - up_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=0.05)


def without_stars():
    """A small picture of noise."""
    buffer = io.BytesIO()
    image = np.random.default_rng(1).normal(100.0, 5.0, (64, 64))
    fits.PrimaryHDU(image.astype(np.float32)).writeto(buffer)
    return "a.fits", buffer.getvalue()


def test_a_picture_without_stars_is_a_failure(client):
    number = sent(client, "/api/upload", {}, file=without_stars()).json()["subid"]
    assert client.get(f"/api/jobs/{number}/info").json()["status"] == "failure"
    assert client.get(f"/api/submissions/{number}").json()["job_calibrations"] == []
    for path in (f"/wcs_file/{number}", f"/api/jobs/{number}/calibration"):
        answer = client.get(path)
        assert answer.status_code == 404
        assert "not solved" in answer.json()["errormessage"]
    assert client.get("/api/jobs/1").status_code == 404


def test_a_session_alone_lets_an_upload_in_and_bad_json_gets_none(tmp_path):
    token = token_of(tmp_path, "anna")
    with client_of(tmp_path, anonymous="none") as client:
        login = sent(client, "/api/login", {"apikey": token}).json()
        # Without a picture its centroids are missed; the session is not.
        answer = sent(client, "/api/upload", {"session": login["session"]}).json()
        assert "centroids" in answer["errormessage"]
        picture = ("a.fits", b"x" * 200_000)
        answer = sent(client, "/api/upload", {"session": login["session"]}, file=picture).json()
        assert "session" not in answer["errormessage"]
        assert sent(client, "/api/login", {"apikey": "wrong"}).status_code == 401
        for arguments in ({}, {"session": "wrong"}):
            assert sent(client, "/api/upload", arguments, file=picture).status_code == 401
        for text in ("{", "[]", "[" * 200_000):
            answer = client.post("/api/login", data={"request-json": text}).json()
            assert answer["status"] == "error"
            assert "request-json" in answer["errormessage"]


@pytest.fixture(scope="module")
def wide_database(tmp_path_factory):
    """A database of another field than the small one."""
    spec = starter_spec("wide", CameraSpec(width_px=640, height_px=480, fov_x_deg=60.0)).spec
    content = {**spec.model_dump(mode="json", exclude_defaults=True), "self_test": {"frames": 20}}
    built = build(type(spec).model_validate(content), tmp_path_factory.mktemp("wide"))
    return built.folder


@pytest.fixture
def both(small_database, wide_database, tmp_path):
    """The folder of a service with both databases, the wide one the newer."""
    old = add_database(tmp_path, small_database)
    add_database(tmp_path, wide_database, OTHER)
    os.utime(old, (1e9, 1e9))
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("first", [None, "wide-1.0.0"])
def test_the_scale_chooses_the_database_and_others_are_tried(both, frame, small_database, first):
    """Without a scale the newest database does not identify the picture, and the other database
    does; a scale selects the database. The setting names the first database, not the only one."""
    camera = open_database(small_database).camera
    file = ("a.fits", picture_of(frame, camera))
    field = camera.fov_x_deg
    scales = (
        {},
        {"scale_units": "degwidth", "scale_lower": 0.9 * field, "scale_upper": 1.1 * field},
        {"scale_units": "arcminwidth", "scale_est": 60 * field, "scale_err": 10},
    )
    with client_of(both, plate_solver=first) as client:
        for scale in scales:
            number = sent(client, "/api/upload", scale, file=file).json()["subid"]
            info = client.get(f"/api/jobs/{number}/info").json()
            assert (info["status"], info["database"]) == ("success", small_database.name)
            log = client.get(f"/joblog/{number}").text
            assert ("wide-1.0.0: " in log) == (not scale or first is not None)
        number = sent(client, "/api/upload", {}, file=without_stars()).json()["subid"]
        for path in (f"/api/jobs/{number}", f"/api/jobs/{number}/info"):
            reason = client.get(path).json()["errormessage"]
            assert f"{small_database.name}: " in reason
            assert "wide-1.0.0: " in reason


def test_the_field_that_an_attempt_has_found_chooses_the_next_database(wide_titles):
    tried: list[tuple[str, object]] = []

    def in_order(fields_deg):
        right = [database for database in wide_titles if database.id == "9" and fields_deg]
        return [*right, *(database for database in wide_titles if database not in right)]

    def identify(database, fields_deg):
        tried.append((database.id, fields_deg and round(sum(fields_deg) / 2, 6)))
        frame = {"status": "identified"} if database.id == "9" else {"status": "no_match"}
        refusal = {"message": "the frame fits a field of 20 deg"}
        return frame if database.id == "9" else {**frame, "refusal": refusal, "fits_fov_deg": 20.0}

    attempts = try_each(in_order, None, identify, lambda answer: answer)
    assert tried == [("0", None), ("9", 20.0)]
    assert attempts.is_identified
    assert attempts.words == "t: the frame fits a field of 20 deg"


@dataclass(frozen=True)
class Listed:
    id: str
    title: str = "t"


@pytest.fixture
def wide_titles():
    return [Listed(str(number)) for number in range(10)]


@pytest.mark.slow
def test_the_page_chooses_a_database_too(both, frame, small_database):
    camera = open_database(small_database).camera
    name, content = "a.fits", picture_of(frame, camera)
    with client_of(both, anonymous="reader") as client:
        for form in ({}, {"camera.fov_x_deg": f"{camera.fov_x_deg}"}):
            form["camera.flip"] = "on"
            page = client.post("/identify", data=form, files={"file": (name, content)}).text
            assert f"<dd>{small_database.name}, method" in page
            assert "not identified" not in page
        # With the wrong database the page explains how to find the right database.
        page = client.post(
            "/identify", data={"database": OTHER}, files={"file": (name, content)}
        ).text
        assert "If you are not sure of the field of view" in page or "px, the camera" in page
        assert "more steps" not in page


@pytest.mark.slow
def test_the_size_of_a_picture_is_taken_from_the_file(both, small_database):
    """A picture of another size than the database's camera, of which only the field is stated."""
    database = open_database(small_database)
    camera = database.camera
    other = Camera(camera.width_px, camera.height_px * 3 // 4, camera.focal_length_px)
    frames = simulate_frames(database.directions, other, 10, Noise(noise_px=0.05), 5, database.mag)
    content = picture_of(max(frames, key=lambda frame: len(frame.mag)), other)
    form = {"database": DATABASE, "camera.flip": "on"}
    form["camera.fov_x_deg"] = f"{other.fov_x_deg}"
    with client_of(both, anonymous="reader") as client:
        page = client.post("/identify", data=form, files={"file": ("a.fits", content)}).text
    assert f"<dd>{small_database.name}, method" in page


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_astroquery_solves_photographs(tmp_path, nights):
    """Twenty photographs, blind among fields of 20 to 60 deg, with only another address."""
    from astroquery.astrometry_net import AstrometryNet

    spec = starter_spec("levels", CameraSpec(width_px=1024, height_px=1024, fov_x_deg=20.0)).spec
    content = spec.model_dump(mode="json", exclude_defaults=True)
    content["products"] = {"levels": {"enabled": True, "widest_fov_x_deg": 60.0}}
    content["self_test"] = {"frames": 20}
    folder = build(type(spec).model_validate(content), tmp_path / "built").folder
    root = tmp_path / "root"
    copied(folder, root / "databases" / "0123456789abcdef")
    right = 0
    with serve(root, tmp_path / "log.txt") as served:
        client = AstrometryNet()
        client.URL, client.API_URL, client.api_key = served.address, f"{served.address}/api", "any"
        for path in sorted((nights / "spel").iterdir())[:20]:
            header = client.solve_from_image(path, verbose=False)
            wcs = WCS(header, naxis=2)
            width = header["IMAGEW"]
            west, other = wcs.pixel_to_world([0, width - 1], [0, 0])
            right += 40 < west.separation(other).deg < 60
    assert right == 20
