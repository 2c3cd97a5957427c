"""Names that people know stars by, constellation lines, and the picture that shows them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib.colors
import matplotlib.image
import matplotlib.text
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from matplotlib.figure import Figure
from numpy.typing import NDArray

from starcat.frames.images.overlay import FrameAxes, Overlay, draw_overlay, overlay_from_attitude
from starcat.frames.images.picture import draw_identified, names_by_place, picture_name
from starcat.frames.sky.in_time import BodyInFrame
from starcat.frames.sky.names import common_names, constellation_lines, named_stars
from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.geometry.sphere import separation
from starcat.matcher.database import open_database

Array = NDArray[np.float64]

# The IAU Catalog of Star Names of 2018-06-19, about every tenth row, and the names that other
# lists give to other stars.
IAU = {
    "Acamar": 13847, "Achernar": 7588, "Acrab": 78820, "Acrux": 60718, "Albireo": 95947,
    "Alcor": 65477, "Alnair": 109268, "Angetenar": 13288, "Anser": 95771, "Antares": 80763,
    "Arcturus": 69673, "Atik": 17448, "Beemim": 20535, "Bellatrix": 25336, "Betelgeuse": 27989,
    "Bharani": 13209, "Castula": 4422, "Cujam": 80463, "Dziban": 86614, "Fafnir": 90344,
    "Fuyue": 87261, "Grumium": 87585, "Intercrus": 46471, "Khambalia": 69974, "Larawag": 82396,
    "Lilii Borea": 13061, "Markeb": 45941, "Minchir": 42402, "Miram": 13268, "Muliphein": 34045,
    "Muscida": 41704, "Nembus": 7607, "Piautos": 40881, "Pipirima": 82545, "Pleione": 17851,
    "Polaris": 11767, "Propus": 29655, "Rigel": 24436, "Sadr": 100453, "Schedar": 3179,
    "Sirius": 32349, "Tania Borealis": 50372, "Terebellum": 98066, "Tiaki": 112122,
    "Titawin": 7513, "Ukdah": 47431, "Unurgunite": 33856, "Vega": 91262, "Xamidimura": 82514,
    "Zubenelgenubi": 72622, "Zubeneschamali": 74785,
}  # fmt: skip


def place_of(label: str) -> Array:
    stars = named_stars()
    return stars.directions[stars.labels.index(label)]


def test_names_are_those_of_the_iau():
    stars = named_stars()
    label_of = dict(zip(stars.hip.tolist(), stars.labels, strict=True))
    assert {name: label_of[hip] for name, hip in IAU.items()} == {name: name for name in IAU}
    proper = [label for label in stars.labels if " " not in label]
    assert len(proper) == len(set(proper)) > 300


def test_letters_stand_where_there_is_no_name_and_numbers_where_there_is_no_letter():
    assert named_stars().label_of("HIP 26311") == "Alnilam"
    assert named_stars().label_of("HIP 17959") is not None
    # β¹ Tucanae, and a star of magnitude 6.5 in Lyra that has neither.
    assert named_stars().label_of("HIP 2484") == "β¹ Tuc"
    assert named_stars().label_of("HIP 19") == "HIP 19"
    for other in ("HIP 118999", "SAO 308", "HIP", "HIP x", "", "Gaia DR3 27989"):
        assert named_stars().label_of(other) is None
    assert picture_name("") == ""


def test_letters_are_in_the_constellation_that_they_name():
    stars = named_stars()
    lettered = [row for row, label in enumerate(stars.labels) if label[0] in "αβγδεζηθικλμνξοπρστ"]
    assert len(lettered) > 900
    x, y, z = stars.directions[lettered].T
    there = SkyCoord(x, y, z, representation_type="cartesian").get_constellation(short_name=True)
    named = [stars.labels[row].split()[1] for row in lettered]
    # Some letters are older than the borders: of 1930, ten stars have moved across.
    assert np.mean(np.array(named) == np.asarray(there)) > 0.985


def test_stars_of_any_catalog_get_their_names_by_place():
    stars = named_stars()
    rows = [stars.labels.index(name) for name in ("Sirius", "Betelgeuse", "Arcturus", "β¹ Tuc")]
    u = stars.at(2026.0)[rows]
    names = common_names(["Gaia DR3 1"] * 4, u, stars.mag[rows] - 0.8, 2026.0)
    assert names == ["Sirius", "Betelgeuse", "Arcturus", "β¹ Tuc"]
    # Arcturus moves by 59 arcsec in 26 years.
    assert common_names([""], u[2:3], np.array([0.0]), 2000.0) == [None]
    # A much fainter star next to it is another star.
    assert common_names([""], u[:1], np.array([5.0]), 2026.0) == [None]
    # In Ks, Betelgeuse is five magnitudes brighter than in V.
    assert common_names([""], u[1:2], np.array([-4.4]), 2026.0) == ["Betelgeuse"]
    assert common_names(["HIP 27989"], -u[:1], np.array([9.0]), 2026.0) == ["Betelgeuse"]
    # Of two close stars, the star of similar magnitude has the name.
    pair = stars.directions[[stars.labels.index(name) for name in ("Rigil Kentaurus", "Toliman")]]
    middle = pair.sum(axis=0) / np.linalg.norm(pair.sum(axis=0))
    assert np.degrees(separation(pair[0], middle)) * 3600.0 < 20.0
    both = common_names(["", ""], np.stack([middle] * 2), np.array([-0.1, 1.4]), 2000.0)
    assert both == ["Rigil Kentaurus", "Toliman"]


def test_lines_lead_along_stars_that_are_known():
    stars, lines = named_stars(), constellation_lines()
    assert len(lines) > 88
    for hips in lines:
        assert len(hips) >= 2
        ends = stars.directions[stars.rows_of(hips)]
        assert separation(ends[:-1], ends[1:]).max() < np.radians(35.0)
    # The belt of Orion and the handle of the Plough.
    pairs = {frozenset(pair) for hips in lines for pair in pairwise(hips)}
    assert frozenset((26727, 26311)) in pairs
    assert frozenset((67301, 65378)) in pairs


def test_the_files_say_where_they_come_from():
    folder = Path(named_stars.__wrapped__.__code__.co_filename).parent
    names = (folder / "star_names.csv").read_text(encoding="utf-8")
    for word in ("ESA SP-1200", "IV/27A", "IAU Catalog of Star Names", "CC BY 4.0", "BSD 3-Clause"):
        assert word in names
    lines = (folder / "constellation_lines.csv").read_text(encoding="utf-8")
    for word in ("Olaf Frohn", "Redistributions of source code must retain", "d3-celestial 0.7.35"):
        assert word in lines


# --- pictures ---------------------------------------------------------------------------------

ORION = Camera(1000, 800, fov_x_deg=30.0)
LENS = Camera(1000, 800, fov_x_deg=30.0, distortion=Distortion(k1=-0.2))


@pytest.mark.parametrize("camera", [ORION, LENS], ids=["plain", "lens"])
@pytest.mark.parametrize("roll_deg", [0.0, 77.0])
def test_grid_and_lines_are_where_the_camera_sees_them(camera, roll_deg):
    matrix = matrix_from_radec_roll(84.0, 2.0, roll_deg)
    overlay = overlay_from_attitude(matrix, camera, 2026.0)
    names = [name for name, _ in overlay.grid]
    assert "+0°" in names
    assert "80°" in names
    for name, points in overlay.grid:
        points = points[np.isfinite(points[:, 0])]
        icrs = camera.directions_from_pixels(points) @ matrix
        ra = np.degrees(np.arctan2(icrs[:, 1], icrs[:, 0]))
        dec = np.degrees(np.arcsin(icrs[:, 2]))
        found = dec if name[0] in "+-" else ra
        np.testing.assert_allclose(found, float(name.rstrip("°")), atol=1e-6)
        assert camera.contains(points).any()
    # Betelgeuse, Bellatrix and the belt are ends of lines.
    ends = np.vstack([points[[0, -1]] for points in overlay.figures])
    for star in ("Betelgeuse", "Bellatrix", "Alnitak"):
        place = camera.pixels_from_directions(place_of(star)[None] @ matrix.T)
        assert np.hypot(*(ends - place).T).min() < 0.05


@pytest.mark.parametrize("dec_deg", [90.0, -89.0, 60.0])
@pytest.mark.parametrize("fov_deg", [1.0, 12.0, 100.0])
def test_any_field_has_a_grid_that_can_be_read(dec_deg, fov_deg):
    camera = Camera(1024, 1024, fov_x_deg=fov_deg)
    overlay = overlay_from_attitude(matrix_from_radec_roll(200.0, dec_deg, 10.0), camera, 2026.0)
    parallels = [name for name, _ in overlay.grid if name[0] in "+-"]
    assert 2 <= len(parallels) <= 14
    assert 2 <= len(overlay.grid) - len(parallels) <= 36


def draw(path: Path, overlay: Overlay | None) -> bytes:
    spots = np.array([[500.0, 400.0], [200.0, 300.0]])
    draw_identified(
        path, None, (1000, 800), spots, ["Alnilam", None], "a frame",
        mag=np.array([1.7, 4.0]), overlay=overlay,
    )  # fmt: skip
    return path.read_bytes()


def test_a_picture_shows_the_grid_the_lines_and_the_planets(tmp_path, written_words):
    matrix = matrix_from_radec_roll(84.0, 2.0, 0.0)
    jupiter = BodyInFrame("Jupiter", 700.0, 600.0, -2.7, 23.0, 5.0, None)
    overlay = overlay_from_attitude(matrix, ORION, 2026.0, (jupiter,))
    first = draw(tmp_path / "a.png", overlay)
    for word in ("Alnilam", "Jupiter", "+0°", "80°"):
        assert word in written_words
    assert draw(tmp_path / "b.png", overlay) == first
    pixels = matplotlib.image.imread(tmp_path / "a.png")[:, :, :3]
    for colour in ("#8f86c9", "#ffe08a"):
        rgb = np.array(matplotlib.colors.to_rgb(colour))
        assert (np.abs(pixels - rgb).max(axis=2) < 0.25).sum() > 50
    written_words.clear()
    draw(tmp_path / "c.png", None)
    assert "Alnilam" in written_words
    assert not {"Jupiter", "+0°", "80°"} & set(written_words)


def test_a_bright_star_that_is_no_guide_star_has_its_name(small_database, tmp_path, written_words):
    """Doubles such as alpha Centauri are not in the database; their places are known."""
    camera, matrix = Camera(1024, 1024, fov_x_deg=48.0), matrix_from_radec_roll(215.0, -55.0, 20.0)
    known, stars = open_database(small_database), named_stars()
    at = {
        name: camera.pixels_from_directions(stars.at(known.epoch_jyear)[row][None] @ matrix.T)[0]
        for row, name in enumerate(stars.labels)
        if name in ("Rigil Kentaurus", "Hadar", "Menkent")
    }
    faint = stars.directions[int(np.argmax(stars.mag > known.mag.max()))]
    spots = np.array([
        at["Hadar"], at["Rigil Kentaurus"] + 0.4, at["Menkent"] + 9.0, [np.nan, 1.0],
        camera.pixels_from_directions(faint[None] @ matrix.T)[0],
    ])  # fmt: skip
    labels = ["Hadar", None, None, None, None]
    names = names_by_place(spots, labels, matrix, camera, known, residual_arcsec=60.0)
    assert names == {1: "Rigil Kentaurus"}
    # Every name has one centroid, the nearest; the companion of alpha Centauri has a name, too.
    thrice = spots[1] + np.array([[0.0], [0.2], [0.4]])
    found = names_by_place(thrice, [None] * 3, matrix, camera, known, 60.0)
    assert found == {0: "Rigil Kentaurus", 1: "Toliman"}
    assert not names_by_place(spots[2:], [None] * 3, matrix, camera, known, 60.0)
    draw_identified(tmp_path / "a.png", None, (1024, 1024), spots[:3], labels[:3], "a frame",
                    places=names)  # fmt: skip
    assert {"Hadar", "Rigil Kentaurus", "named by place: 1", "not identified: 1"} <= set(
        written_words
    )


def test_names_of_planets_stay_in_the_frame(tmp_path, monkeypatch):
    places = []
    write = matplotlib.text.Text.__init__

    def listen(self: Any, x: float = 0, y: float = 0, text: str = "", **options: Any) -> None:
        if text == "Jupiter":
            places.append(x)
        write(self, x, y, text, **options)

    monkeypatch.setattr(matplotlib.text.Text, "__init__", listen)
    ends = (BodyInFrame("Jupiter", x_px, 400.0, -2.7, 23.0, 5.0, None) for x_px in (5.0, 995.0))
    draw(tmp_path / "a.png", Overlay(bodies=tuple(ends)))
    assert places[0] > 5.0
    assert places[1] < 995.0


def test_names_of_the_grid_do_not_cover_each_other():
    overlay = overlay_from_attitude(matrix_from_radec_roll(112.9, 24.2, 20.0), ORION, 2026.0)
    axes = Figure().add_axes((0.0, 0.0, 1.0, 1.0))
    plate = FrameAxes(axes, 0.6, (1000, 800), np.empty((0, 2)), [], np.empty(0))
    twice = Overlay(overlay.grid + overlay.grid)
    boxes = draw_overlay(plate, twice)
    assert 4 <= len(boxes) <= len(overlay.grid)
    for row, (left, top, right, bottom) in enumerate(boxes):
        others = np.delete(boxes, row, axis=0)
        apart = (others[:, 0] >= right) | (others[:, 2] <= left)
        apart |= (others[:, 1] >= bottom) | (others[:, 3] <= top)
        assert apart.all()
