"""Blends: predicted against rendered and measured pairs, properties, and the rule of a spec."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from drafts import spec_with
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from starcat.catalog.stars.star_table import directions_of, floats_of, table_from_columns
from starcat.catalog.stars.verdict import Quality, count_by_reason
from starcat.database.products.blends import Blends, blends, widths_px
from starcat.database.verify import check_database
from starcat.errors import BuildError, ConfigError
from starcat.frames.images.centroiding import centres_of_mass, find_spots
from starcat.frames.images.render import Optics, render_image, star_electrons
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, tangent_axes
from starcat.pipeline.build import build
from starcat.pipeline.guide_stars import depth_notes
from starcat.pipeline.selection.rules.neighbours import NeighbourRule, NeighbourTally
from starcat.pipeline.selection.ruleset import ALL_REASONS, Selection
from starcat.pipeline.selection.selecting import Selected, select_guide_stars
from starcat.pipeline.specs.reading import preset, spec_from_dict

Values = NDArray[np.float64]

# --- The oracle: rendered stars through our own centroiding


CELL_PX = 40
OWN_MAG = 2.5  # 60,000 electrons: bright, and not saturated


@dataclass(frozen=True)
class Sight:
    """The measured and the predicted centroids of rendered stars."""

    measured: Values  # from the star to the nearest spot, pixels
    predicted: Blends
    mag: Values  # of that spot
    photocentre: Values  # from the star, pixels

    @property
    def small(self) -> NDArray[np.bool_]:
        return np.asarray(np.hypot(*self.predicted.offset.T) < 0.5)

    @property
    def apart_px(self) -> Values:
        """Between prediction and measurement."""
        return np.asarray(np.hypot(*(self.measured - self.predicted.offset).T))

    def rms_px(self, offset: Values) -> float:
        """Of the length of the difference, where the offset is small."""
        apart = np.sum((self.measured - offset) ** 2, axis=1)
        return float(np.sqrt(apart[self.small].mean()))


def around(count: int, most_px: float, generator: np.random.Generator) -> Values:
    """Uniform random offsets of up to this many pixels."""
    apart, angle = generator.uniform(0.0, (most_px, 2.0 * np.pi), (count, 2)).T
    return np.asarray(apart[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def measured(
    offset: Values, fainter: Values, psf_sigma_px: float, generator: np.random.Generator
) -> tuple[Values, Values, Values]:
    """Render stars with companions, shape (N, M, 2), and find the spots.

    Returns the places of the stars, the places of the spots, and the magnitudes of the spots.
    """
    count = len(offset)
    side = int(np.ceil(np.sqrt(count)))
    cells = np.stack(np.divmod(np.arange(count), side), axis=1)
    place = (cells + 0.5) * CELL_PX + generator.uniform(-0.5, 0.5, (count, 2))
    everything = np.concatenate([place, (place[:, None] + offset).reshape(-1, 2)])
    mag = OWN_MAG + np.concatenate([np.zeros(count), fainter.ravel()])
    optics = Optics(psf_sigma_px=psf_sigma_px)
    size = (side * CELL_PX, side * CELL_PX)
    image = render_image(everything, mag, size, optics, seed=count)
    spots = find_spots(image, psf_sigma_px=psf_sigma_px, gain_e_per_adu=1.0)
    return place, spots.centroids_px, spots.mag + 2.5 * np.log10(optics.zero_point_e)


def rendered(count: int, companions: int, psf_sigma_px: float, seed: int) -> Sight:
    """Render stars, each with companions 0 to 3 px apart and 0 to 5 mag fainter."""
    generator = np.random.default_rng(seed)
    offset = around(count * companions, 3.0, generator)
    fainter = generator.uniform(0.0, 5.0, count * companions)
    shape = (count, companions)
    place, spots, mag = measured(
        offset.reshape(*shape, 2), fainter.reshape(shape), psf_sigma_px, generator
    )
    _, nearest = cKDTree(spots).query(place)
    light, star = 10.0 ** (-0.4 * fainter), np.repeat(np.arange(count), companions)
    weighted = (offset * light[:, None]).reshape(*shape, 2).sum(axis=1)
    return Sight(
        spots[nearest] - place,
        blends(count, star, offset, light, light > 1.0, widths_px(psf_sigma_px)),
        mag[nearest],
        weighted / (1.0 + light.reshape(shape).sum(axis=1))[:, None],
    )


@pytest.mark.parametrize("psf_sigma_px", [0.6, 1.0, 1.5])
@pytest.mark.parametrize(
    "count", [pytest.param(20, id="few"), pytest.param(668, id="all", marks=pytest.mark.slow)]
)
def test_pairs_are_seen_as_predicted(psf_sigma_px, count):
    """More than 2,000 pairs in all, where the offset is below 0.5 px."""
    sight = rendered(count, 1, psf_sigma_px, seed=11)
    assert sight.small.sum() > 0.7 * count
    assert sight.rms_px(sight.predicted.offset) <= 0.03
    assert np.quantile(sight.apart_px[sight.small], 0.99) <= 0.04
    assert sight.rms_px(sight.photocentre) >= (0.05 if count > 100 else 0.02)
    assert np.hypot(*sight.measured[sight.small].T).max() > 0.2
    difference = (sight.mag - OWN_MAG + 2.5 * np.log10(sight.predicted.brightening))[sight.small]
    assert np.median(np.abs(difference)) <= 0.08


@pytest.mark.slow
@pytest.mark.parametrize("psf_sigma_px", [0.6, 1.0, 1.5])
def test_crowds_are_seen_as_predicted(psf_sigma_px):
    sight = rendered(400, 3, psf_sigma_px, seed=12)
    assert sight.small.sum() > 150
    assert np.quantile(sight.apart_px[sight.small], 0.99) <= 0.05


@pytest.mark.slow
@pytest.mark.parametrize("psf_sigma_px", [0.6, 1.0, 1.5])
def test_a_fainter_star_is_found_where_it_is_not_lost(psf_sigma_px):
    """Up to 4 mag fainter and so far apart that about half are found by themselves."""
    generator, widths = np.random.default_rng(13), widths_px(psf_sigma_px)
    offset = around(600, 6.0 * widths.smoothed, generator)
    fainter = generator.uniform(0.0, 4.0, 600)
    place, spots, _ = measured(offset[:, None], fainter[:, None], psf_sigma_px, generator)
    tree = cKDTree(spots)
    (_, of_star), (apart, of_other) = tree.query(place), tree.query(place + offset)
    is_found = (of_star != of_other) & (apart < 1.0)
    light = 10.0 ** (0.4 * fainter)
    other = blends(600, np.arange(600), -offset, light, light > 1.0, widths)
    assert 0.2 < other.is_lost.mean() < 0.8
    assert np.mean(is_found != other.is_lost) >= 0.93
    moved = (place + offset + other.offset - spots[of_star])[other.is_lost & ~is_found]
    assert np.median(np.hypot(*moved.T)) < 0.03


def settled_in_a_window(image: Values, place: Values, window_px: float) -> Values:
    """Return the point where a Gaussian window on the light of an image comes to rest."""
    row, column = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    for _ in range(500):
        apart2 = (column - place[0]) ** 2 + (row - place[1]) ** 2
        seen = image * np.exp(-0.5 * apart2 / window_px**2)
        mean = np.array([(seen * column).sum(), (seen * row).sum()]) / seen.sum()
        place, step = mean, np.abs(mean - place).max()
        if step < 1e-6:
            break
    return place


@pytest.mark.parametrize(
    ("psf_sigma_px", "box_px", "offset_px"),
    [(1.0, 3, 0.01), (1.0, 5, 0.10), (1.0, 7, 0.56), (1.0, None, 0.08), (1.443, 5, 0.26),
     (1.443, None, 1.62)],
)  # fmt: skip
def test_a_pair_is_where_its_centroid_is_measured(psf_sigma_px, box_px, offset_px):
    """Two equal stars 4.2 px apart: rendered without noise at all places in a pixel."""
    apart = np.array([4.2, 0.0])
    columns = (np.arange(40) + 0.5) / 40 - 0.5
    phases = np.stack(np.meshgrid(columns, columns[4::8]), axis=-1).reshape(-1, 2)
    optics, found = Optics(psf_sigma_px), []
    widths = widths_px(psf_sigma_px, None, box_px)
    for place in 20.5 + (phases if box_px else phases[2::19]):
        image = star_electrons(np.stack([place, place + apart]), np.full(2, 5.0), (41, 41), optics)
        if box_px is None:
            settled = settled_in_a_window(image, place, widths.window)
        else:
            settled = centres_of_mass(image, place[None], box_px)[0]
        found.append(settled - place)
    no = np.zeros(1, dtype=bool)
    predicted = blends(1, np.zeros(1, dtype=np.int64), apart[None], np.ones(1), no, widths)
    assert predicted.offset[0] == pytest.approx(np.mean(found, axis=0), abs=0.01)
    assert predicted.offset[0] == pytest.approx([offset_px, 0.0], abs=0.01)


# --- Properties


WIDTHS = widths_px(1.0)


def pair(apart_px: float, delta_mag: float, angle_rad: float = 0.0) -> Blends:
    offset = apart_px * np.array([[np.cos(angle_rad), np.sin(angle_rad)]])
    light = np.array([10.0 ** (-0.4 * delta_mag)])
    return blends(1, np.zeros(1, dtype=np.int64), offset, light, light > 1.0, WIDTHS)


@pytest.mark.parametrize("widths", [WIDTHS, widths_px(1.0, None, 5).times(3.0)])
def test_no_neighbours(widths):
    nobody = np.zeros(0, dtype=np.int64)
    found = blends(2, nobody, np.zeros((0, 2)), np.zeros(0), nobody > 0, widths)
    assert found.offset == pytest.approx(np.zeros((2, 2)), abs=1e-9)
    assert found.brightening == pytest.approx(np.ones(2))
    assert found.contamination == pytest.approx(np.zeros(2))
    none = blends(0, nobody, np.zeros((0, 2)), np.zeros(0), nobody > 0, widths)
    assert (none.offset.shape, none.brightening.shape) == ((0, 2), (0,))


@settings(max_examples=25)
@given(st.floats(-5.0, 10.0))
def test_a_star_at_the_same_place_adds_light_and_moves_nothing(delta_mag):
    found, light = pair(0.0, delta_mag), 10.0 ** (-0.4 * delta_mag)
    assert found.offset[0].tolist() == [0.0, 0.0]
    assert found.brightening[0] == pytest.approx(1.0 + light)
    assert found.contamination[0] == pytest.approx(light / (1.0 + light))


@settings(max_examples=25)
@given(st.floats(0.0, 12.0), st.floats(0.01, 10.0), st.floats(0.0, 6.3))
def test_a_fainter_star_pulls_no_farther_than_to_the_photocentre(apart_px, delta_mag, angle_rad):
    found, light = pair(apart_px, delta_mag, angle_rad), 10.0 ** (-0.4 * delta_mag)
    along, across = Rotation.from_euler("z", -angle_rad).apply([*found.offset[0], 0.0])[:2]
    assert -1e-9 <= along <= apart_px * light / (1.0 + light) + 1e-9
    assert across == pytest.approx(0.0, abs=1e-9)
    assert 0.0 <= found.contamination[0] < 0.5
    assert 0.6 < found.brightening[0] <= 1.0 + light + 1e-9


@settings(max_examples=25)
@given(st.floats(0.1, 2.9), st.floats(-3.0, 8.0), st.floats(0.01, 2.0))
def test_more_light_pulls_farther(apart_px, delta_mag, more_mag):
    """Below two widths of spot and window together, 2.9 px here, a pair is one maximum."""
    less, more = pair(apart_px, delta_mag), pair(apart_px, delta_mag - more_mag)
    assert more.offset[0, 0] >= less.offset[0, 0] - 1e-5
    assert more.brightening[0] > less.brightening[0]
    assert more.contamination[0] > less.contamination[0]


def test_a_star_in_the_light_of_a_bright_one_has_no_centroid_of_its_own():
    faint, bright = pair(2.5, -4.0), pair(2.5, 4.0)
    assert faint.offset[0, 0] == pytest.approx(2.5 + bright.offset[0, 0] * -1.0, abs=1e-4)
    assert faint.contamination[0] > 0.95


def test_the_centroid_is_where_the_moments_cancel():
    """By sums over a fine grid, without the closed form."""
    offset, light = np.array([[1.3, 0.4], [-0.8, 1.9]]), np.array([0.3, 0.5])
    found = blends(1, np.zeros(2, dtype=np.int64), offset, light, light > 1.0, WIDTHS)
    x, y = np.mgrid[-9.0:9.0:0.02, -9.0:9.0:0.02]
    image = np.zeros_like(x)
    for (a, b), f in zip([(0.0, 0.0), *offset], [1.0, *light], strict=True):
        image += f * np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / WIDTHS.spot**2)
    from_there = [axis - place for axis, place in zip((x, y), found.offset[0], strict=True)]
    apart2 = from_there[0] ** 2 + from_there[1] ** 2
    weighted = image * np.exp(-0.5 * apart2 / WIDTHS.window**2)
    moments = [(weighted * axis).sum() / weighted.sum() for axis in from_there]
    assert moments == pytest.approx([0.0, 0.0], abs=1e-5)
    alone = 2.0 * np.pi * WIDTHS.spot**2 * (1.0 - np.exp(-2.0)) / 0.02**2
    total = image[apart2 < (2.0 * WIDTHS.spot) ** 2].sum() / alone
    assert found.brightening[0] == pytest.approx(total, rel=1e-3)


# --- Tables of stars


PIXEL_ARCSEC = 40.0
PIXEL_DEG = PIXEL_ARCSEC / 3600.0


def sky(x_px: Any, mag: Any, dec_deg: float = 0.0, y_px: Any = 0.0, **columns: Any) -> pa.Table:
    """Stars by pixels east and north of (30 deg, ``dec_deg``), numbered from 1."""
    east, north = tangent_axes(30.0, dec_deg)
    x, y = np.broadcast_arrays(np.radians(np.multiply(x_px, PIXEL_DEG)), np.radians(y_px))
    y = y * PIXEL_DEG
    directions = directions_from_radec(30.0, dec_deg) + np.outer(x, east) + np.outer(y, north)
    return sky_of(directions / np.linalg.norm(directions, axis=1)[:, None], mag, **columns)


def sky_of(directions: Values, mag: Any, **columns: Any) -> pa.Table:
    ra, dec = radec_from_directions(directions)
    given_columns: dict[str, Any] = {"star_id": np.arange(1, len(mag) + 1), "ra_deg": ra}
    given_columns |= {"dec_deg": dec, "mag": np.array(mag, dtype=float), "quality_flags": 0}
    given_columns |= dict(zip("xyz", directions.T, strict=True)) | columns
    return table_from_columns("stars", given_columns, len(mag))


def judged(stars: pa.Table, **rule: Any) -> Selected:
    doubles = {"min_separation_deg": 4.0 * PIXEL_DEG}
    neighbours = NeighbourRule(psf_sigma_px=1.0, **rule)
    selection = Selection(faint_limit_mag=6.0, doubles=doubles, neighbours=neighbours)
    return select_guide_stars(stars, selection, PIXEL_ARCSEC)


def verdicts(selected: Selected) -> list[str]:
    kept = dict.fromkeys(selected.guide_stars["star_id"].to_pylist(), "kept")
    number, reason = (selected.rejected[name].to_pylist() for name in ("star_id", "reason"))
    return [name for _, name in sorted((kept | dict(zip(number, reason, strict=True))).items())]


@pytest.mark.parametrize(
    ("x_px", "mag", "rule", "expected"),
    [
        ([0.0, 1.0], [4.0, 4.5], {}, ["blended", "blended"]),
        # A star that is fainter than any guide star counts too, as far as it moves anything.
        ([0.0, 1.0], [4.0, 6.1], {}, ["blended", "too_faint"]),
        ([0.0, 1.0], [4.0, 7.5], {}, ["kept", "too_faint"]),
        ([0.0, 1.0], [4.0, 6.1], {"max_offset_px": 0.2, "max_contamination": 0.2},
         ["kept", "too_faint"]),
        ([0.0, 1.0], [4.0, 6.1], {"max_offset_px": 0.2}, ["blended", "too_faint"]),
        ([0.0, 1.0], [4.0, 6.1], {"max_offset_arcsec": 5.0}, ["blended", "too_faint"]),
        ([0.0, 1.0], [4.0, 6.1], {"max_offset_arcsec": 7.0, "max_contamination": 1.0},
         ["kept", "too_faint"]),
        # Bright stars hide faint stars; stars far from others keep their own centroid.
        ([0.0, 2.5], [1.0, 5.5], {}, ["kept", "blended"]),
        ([0.0, 6.0], [4.0, 4.5], {}, ["kept", "kept"]),
        ([0.0, 0.0], [4.0, 4.0], {}, ["blended", "blended"]),
        ([0.0, 1.0], [4.0, np.nan], {}, ["kept", "no_magnitude"]),
        ([0.0, 1.0], [4.0, 4.5], {"action": "keep"}, ["kept", "kept"]),
        ([0.0, 1.0], [4.0, 4.5], {"action": "merge"}, ["kept", "merged"]),
        ([0.0, 1.0], [4.0, 6.1], {"action": "merge"}, ["kept", "merged"]),
        ([0.0, 1.0], [4.0, 7.5], {"action": "merge"}, ["kept", "too_faint"]),
        # Two that are too faint are one that is not; fainter yet, they stay what they are.
        ([0.0, 0.5], [6.4, 6.5], {"action": "merge"}, ["kept", "merged"]),
        ([0.0, 0.5], [7.4, 7.5], {"action": "merge"}, ["too_faint", "too_faint"]),
        # A hidden star that changes nothing is not in the light of the other.
        ([0.0, 2.5], [1.0, 5.5], {"action": "merge"}, ["kept", "blended"]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("dec_deg", [0.0, -90.0])
def test_close_stars(x_px, mag, rule, expected, dec_deg):
    assert verdicts(judged(sky(x_px, mag, dec_deg), **rule)) == expected


def test_columns_say_what_was_predicted():
    selected = judged(sky([0.0, 1.2, 1.0], [4.0, 5.0, 8.0], 60.0, [0.0, 0.9, 0.0]), action="keep")
    offset, light = np.array([[1.2, 0.9], [1.0, 0.0]]), 10.0 ** (-0.4 * np.array([1.0, 4.0]))
    expected = blends(1, np.zeros(2, dtype=np.int64), offset, light, light > 1.0, WIDTHS)
    star = selected.guide_stars.to_pylist()[0]
    moved = float(np.hypot(*expected.offset[0])) * PIXEL_ARCSEC
    assert star["centroid_offset_arcsec"] == pytest.approx(moved, rel=1e-6)
    assert star["contamination"] == pytest.approx(expected.contamination[0], rel=1e-6)
    brighter = 2.5 * np.log10(expected.brightening[0])
    assert star["blend_mag"] == pytest.approx(4.0 - brighter, rel=1e-7)
    assert (star["mag"], star["quality_flags"]) == (4.0, 0)


def test_a_merged_star_is_where_and_as_bright_as_the_sensor_sees_it():
    stars = sky([0.0, 1.5, 300.0], [4.5, 4.0, 5.0], 60.0)
    selected = judged(stars, action="merge")
    assert verdicts(selected) == ["merged", "kept", "kept"]
    star, alone = selected.guide_stars.to_pylist()
    expected = pair(1.5, 0.5, np.pi)
    there = 1.5 + expected.offset[0, 0]
    assert 0.0 < there < 1.5
    at = directions_of(sky([there], [0.0], 60.0))[0]
    assert [star["x"], star["y"], star["z"]] == pytest.approx(at, abs=1e-10)
    assert np.array([star["ra_deg"], star["dec_deg"]]) == pytest.approx(
        np.ravel(radec_from_directions(at)), abs=1e-8
    )
    assert star["mag"] == star["blend_mag"] == pytest.approx(
        4.0 - 2.5 * np.log10(expected.brightening[0])
    )  # fmt: skip
    assert star["quality_flags"] == Quality.MERGED | Quality.PHOTOCENTRE
    before = stars.to_pylist()[2]
    blank = {"blend_mag": 5.0, "contamination": 0.0, "centroid_offset_arcsec": 0.0}
    assert alone == before | blank


def test_the_tally_compares_with_the_separation_rule():
    x_px = [0.0, 3.5, 100.0, 101.0, 200.0, 201.0]
    stars = sky(x_px, [3.0, 7.5, 4.0, 4.5, 4.0, 6.2])
    assert judged(stars).neighbours == NeighbourTally(regained=0, lost=1, absorbed=0)
    merged = judged(stars, action="merge")
    assert merged.neighbours == NeighbourTally(regained=1, lost=0, absorbed=2)
    assert count_by_reason(merged.rejected, reasons=ALL_REASONS) == {"too_faint": 1, "merged": 2}
    apart = sky([0.0, 3.5], [3.0, 5.9])
    assert judged(apart).neighbours == NeighbourTally(regained=1, lost=0, absorbed=0)


@pytest.mark.parametrize("action", ["remove", "merge"])
@pytest.mark.parametrize("seed", range(3))
def test_a_turned_sky_has_the_same_verdicts(seed, action):
    generator = np.random.default_rng(seed)
    place = generator.uniform(0.0, 30.0, (2, 80))
    stars = sky(place[0], generator.uniform(3.0, 9.0, 80), 0.0, place[1])
    turn = Rotation.random(rng=generator)
    before = judged(stars, action=action)
    after = judged(sky_of(turn.apply(directions_of(stars)), floats_of(stars, "mag")), action=action)
    assert verdicts(after) == verdicts(before)
    assert {"kept", "too_faint", "blended" if action == "remove" else "merged"} <= set(
        verdicts(before)
    )
    turned = turn.apply(directions_of(before.guide_stars))
    np.testing.assert_allclose(directions_of(after.guide_stars), turned, rtol=0, atol=1e-9)
    for name in ("mag", "blend_mag", "contamination"):
        here, there = (floats_of(each.guide_stars, name) for each in (before, after))
        np.testing.assert_allclose(there, here, atol=1e-5)


def test_too_many_neighbours_are_refused():
    stars = sky_of(np.tile([1.0, 0.0, 0.0], (5_000, 1)), np.full(5_000, 5.0))
    selection = Selection(faint_limit_mag=6.0, neighbours=NeighbourRule(psf_sigma_px=50.0))
    with pytest.raises(BuildError, match=r"5,000 stars have about .* Check psf_sigma_px"):
        select_guide_stars(stars, selection, 7200.0)


# --- Specs


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"neighbours.psf_sigma_px": ""}, "psf_sigma_px is missing: blends cannot"),
        ({"neighbours.psf_sigma_px": "0.0"}, "psf_sigma_px: found 0.0; expected at least"),
        ({"neighbours.centroid": "box"}, 'state both centroid = "box" and the size of the box'),
        (
            {"neighbours.centroid": "box", "neighbours.box_px": "4"},
            "a box has an odd number of pixels on a side",
        ),
        ({"neighbours.action": "mend"}, "action: found 'mend'"),
        (
            {"doubles.action": "merge"},
            'set neighbours.action = "merge" to merge them as the sensor does',
        ),
        (
            {"doubles.companion_limit_mag": "7.0"},
            "companion_limit_mag 7 is of the separation rule, which [selection.neighbours]",
        ),
    ],
)
def test_what_is_wrong_with_a_spec(changes, words):
    rule = {"neighbours.psf_sigma_px": "1.0", "neighbours.max_offset_px": "0.2"} | changes
    with pytest.raises(ConfigError) as caught:
        preset("sao-12deg", {f"selection.{key}": value for key, value in rule.items()})
    assert words in str(caught.value)


def test_a_spec_without_the_section_is_recorded_as_it_always_was():
    assert "neighbours" not in preset("sao-12deg").recorded()["selection"]
    spec = preset("sao-12deg", {"selection.neighbours.psf_sigma_px": "1.0"})
    recorded = spec.recorded()
    assert recorded["selection"]["neighbours"]["psf_sigma_px"] == 1.0
    assert {"centroid", "box_px"}.isdisjoint(recorded["selection"]["neighbours"])
    assert spec_from_dict(recorded, "manifest") == spec


def test_the_camera_must_be_known():
    selection = Selection(faint_limit_mag=6.0, neighbours=NeighbourRule(psf_sigma_px=1.0))
    with pytest.raises(ValueError, match="needs the camera's"):
        select_guide_stars(sky([0.0], [4.0]), selection)


@pytest.mark.parametrize(
    ("faintest", "rule", "words"),
    [
        (7.0, {}, "magnitude 7.00, and a neighbour 2.39 mag fainter than a guide star is still"),
        (8.3, {}, "Stars fainter than 5.91 are judged by some of their neighbours only"),
        (8.5, {}, None),
        (7.0, {"max_contamination": "0.5"}, None),
        (7.0, {"max_contamination": "0.0"}, "a neighbour 7.50 mag fainter"),
        (7.0, {"psf_sigma_px": ""}, None),
        (np.nan, {}, None),
    ],
)
def test_a_catalog_that_ends_too_early_is_named(faintest, rule, words):
    rule = {"psf_sigma_px": "1.0"} | rule
    changes = {f"selection.neighbours.{key}": value for key, value in rule.items()}
    notes = depth_notes(sky([0.0], [faintest]), preset("sao-12deg", changes))
    assert (words is None) == (notes == ())
    assert all(words in note for note in notes)


def test_a_build_reports_what_the_rule_did(small_spec, sao_file, tmp_path):
    # The spot is so wide that many stars have neighbours.
    neighbours = {"psf_sigma_px": 12.0, "action": "merge"}
    selection = {"faint_limit_mag": 5.0, "neighbours": neighbours}
    spec = spec_with(small_spec, selection=selection)
    built = build(spec, tmp_path, inputs={"sao": [sao_file]})
    check_database(built.folder)
    report = json.loads((built.folder / "report" / "report.json").read_bytes())
    assert set(report["neighbours"]) == {"regained", "lost", "absorbed"}
    assert report["neighbours"]["absorbed"] == report["sources"][0]["rejected"]["merged"]
    page = (built.folder / "report" / "index.html").read_text(encoding="utf-8")
    assert f"keeps {report['neighbours']['regained']:,} stars that the separation rule" in page
