"""Tables of centroids in Python: the names that files have, too, and remarks on what is unusual."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from astropy import units as u
from astropy.table import QTable, Table
from frames import both_engines

import starcat
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.matcher.centroid_columns import BRIGHTNESS, POSITIONS
from starcat.matcher.observation import BEYOND_PX, remarks_on_pixels
from starcat.pipeline.simulation.simulate import Noise, simulate_frames


@pytest.fixture(scope="module")
def matcher(small_database):
    return starcat.Matcher.open(small_database)


@pytest.fixture(scope="module")
def frame(small_database):
    return starcat.simulate(small_database, seed=7)[0]


@pytest.fixture(scope="module")
def crowded(frame, matcher):
    """A frame with more false centroids than are searched, with the light of each."""
    generator = np.random.default_rng(2)
    px = np.vstack([frame.centroids_px, generator.uniform(0, 512, (600, 2))])
    light = np.concatenate([10.0 ** (-0.4 * (frame.mag - 15.0)), generator.uniform(1, 50, 600)])
    return px, light


def tables_of(columns: dict[str, Any]) -> dict[str, Any]:
    pandas = pytest.importorskip("pandas")
    return {
        "dict": columns,
        "astropy": Table(columns),
        "units": QTable({**columns, "flux": columns["flux"] * u.count}),
        "arrow": pa.table(columns),
        "pandas": pandas.DataFrame(columns),
        "records": np.rec.fromarrays(list(columns.values()), names=list(columns)),
    }


def test_light_of_a_table_is_read_as_in_a_file(matcher, crowded, tmp_path):
    px, light = crowded
    columns = {"x_px": px[:, 0], "y_px": px[:, 1], "flux": light}
    rows = "\n".join(
        f"{x!r},{y!r},{v!r}" for (x, y), v in zip(px.tolist(), light.tolist(), strict=True)
    )
    (tmp_path / "a.csv").write_text(f"x_px,y_px,flux\n{rows}\n")
    expected = starcat.identify_file(matcher, tmp_path / "a.csv", fov_error=0.0)
    assert expected.ok
    assert not matcher.identify(px).ok  # light decides which centroids are searched
    for kind, table in tables_of(columns).items():
        found = matcher.identify(table)
        assert found.star_index.tolist() == expected.star_index.tolist(), kind
        assert found.frame.mag.tolist() == expected.frame.mag.tolist(), kind
        assert found.remarks == expected.remarks, kind


def test_names_of_programs_are_read_with_their_first_pixel(matcher, frame):
    x, y = frame.centroids_px.T
    expected = matcher.identify(frame)
    for names, offset in ((("xcentroid", "ycentroid"), -0.5), (("X_IMAGE", "Y_IMAGE"), 0.5)):
        columns = {names[0]: x + offset, names[1]: y + offset, "flux": 10.0 ** (-0.4 * frame.mag)}
        for kind, table in tables_of(columns).items():
            found = matcher.identify(table)
            np.testing.assert_allclose(found.frame.centroids_px, frame.centroids_px, atol=1e-9)
            assert found.star_index.tolist() == expected.star_index.tolist(), kind
            assert found.frame.mag == pytest.approx(frame.mag)
            assert found.remarks == ()


def test_columns_that_are_not_used_are_reported(matcher, frame):
    x, y = frame.centroids_px.T
    table = {"x_px": x, "y_px": y, "magnitudes": frame.mag, "snr": frame.mag}
    found = matcher.identify(table)
    assert found.remarks[0].startswith("not used: magnitudes, snr; used are x_px, y_px (a column")
    assert found.to_dict()["remarks"] == list(found.remarks)
    assert pickle.loads(pickle.dumps(found)).remarks == found.remarks
    many = matcher.identify_many([frame, table, frame.centroids_px])
    assert [len(one.remarks) for one in many] == [0, 1, 0]
    assert many[1].remarks == found.remarks
    assert matcher.identify(table, mag=frame.mag).frame.mag.tolist() == frame.mag.tolist()
    assert matcher.identify({"centroids_px": frame.centroids_px, "light": x}).remarks
    assert not matcher.identify({"centroids_px": frame.centroids_px, "name": "a"}).remarks
    assert starcat.Tracker(matcher).identify(table).remarks == found.remarks


def test_the_documentation_has_every_name():
    text = (Path(starcat.__file__).parents[1] / "docs" / "formats.md").read_text()
    for one in POSITIONS:
        assert f"`{one.x}`" in text
    for one in BRIGHTNESS:
        assert f"`{one.name}`" in text or f"`{one.name.partition('_')[2]}`" in text


def test_a_table_of_several_frames_is_refused(matcher, frame):
    x, y = frame.centroids_px.T
    table = {"x_px": x, "y_px": y, "frame": np.arange(len(x)) // 4}
    with pytest.raises(ConfigError, match=r"column frame of this table has \d+ values.*0 and 1"):
        matcher.identify(table)
    one = matcher.identify({**table, "frame": ["a"] * len(x)})
    assert (one.ok, one.remarks) == (True, ())


CAMERA = Camera(1024, 1024, fov_x_deg=12.0)
WRONG = {
    "fractions": (lambda px: px / 1024.0, "fractions of the frame, 0 to 1; multiply x by 1024"),
    "millimetres": (lambda px: px * 0.0055, "another unit, such as millimetres or degrees"),
    "degrees": (lambda px: (px - 512.0) * 12.0 / 1024.0, "another unit"),
    "from -1 to 1": (lambda px: (px - 512.0) / 512.0, "another unit"),
    "from the centre": (lambda px: px - 512.0, "count from the centre of the frame; add 512 to x"),
    "micrometres": (lambda px: px * 5.5, "pixels count from the outer corner of the top-left"),
}


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize("count", [6, 19, 400])
def test_coordinates_that_are_not_pixels_are_reported(kind, count):
    change, words = WRONG[kind]
    px = np.random.default_rng(count).uniform(0.0, 1024.0, (count, 2))
    assert remarks_on_pixels(px, CAMERA) == ()
    [remark] = remarks_on_pixels(change(px), CAMERA)
    assert words in remark
    assert remarks_on_pixels(np.vstack([change(px), [[np.nan, 1.0]]]), CAMERA)


@both_engines
def test_a_frame_of_another_size_has_a_remark(small_database, engine):
    """All its stars are found, and the attitude is that of another boresight."""
    matcher = starcat.Matcher.open(small_database, engine=engine)
    camera = matcher.database.camera
    larger = Camera(640, 480, camera.focal_length_px)
    made = simulate_frames(
        matcher.database.directions, larger, 40, Noise(0.2), 3, matcher.database.mag
    )
    few = 0
    for one in made:
        found = matcher.identify(one.centroids_px, mag=one.mag)
        outside_px = float((one.centroids_px - (camera.width_px, camera.height_px)).max())
        if not found.ok or outside_px <= BEYOND_PX:
            continue
        few += len(found.dropped) < len(one.centroids_px) / 3
        [remark] = found.remarks
        assert remark.startswith(f"{len(found.dropped)} of {len(one.centroids_px)} centroids lie")
        assert f"outside of the frame of 512 x 512 px, by up to {outside_px:.0f} px" in remark
        assert "if the frame has another size, state that or its camera" in remark
        assert starcat.Matcher.open(small_database).identify(one, larger).remarks == ()
    assert few >= 5


def test_one_centroid_outside_is_reported_and_no_noise_at_the_border():
    px = np.random.default_rng(1).uniform(0.0, 1024.0, (30, 2))
    border = np.array([[-1.0, 3.0], [1025.0, 1024.9], [500.0, -4.0], [1028.0, 9.0]])
    assert remarks_on_pixels(np.vstack([px, border]), CAMERA) == ()
    [remark] = remarks_on_pixels(np.vstack([px, [[1100.2, 50.0]]]), CAMERA)
    assert remark.startswith("1 of 31 centroids lies outside of the frame of 1024 x 1024 px, by up")
    assert "76 px, and was dropped" in remark
    # Few centroids about a corner do not count from the centre.
    [remark] = remarks_on_pixels(np.vstack([px[:8] / 3.0, [[-20.0, -9.0]]]), CAMERA)
    assert "count from the centre" not in remark


def test_frames_of_stars_have_no_remarks_on_their_pixels(matcher):
    database = matcher.database
    for camera in (database.camera, database.camera.with_focal_length(3000.0)):
        made = simulate_frames(
            database.directions, camera, 300, Noise(0.5, false_stars=2), 3, database.mag
        )
        assert not any(remarks_on_pixels(one.centroids_px, camera) for one in made)
    few = np.array([[10.0, 10.0], [12.0, 11.0], [11.0, 13.0]])
    assert remarks_on_pixels(few, CAMERA) == ()  # three stars of a cluster
    assert remarks_on_pixels(np.empty((0, 2)), CAMERA) == ()
    assert remarks_on_pixels(np.full((3, 2), np.nan), CAMERA) == ()
