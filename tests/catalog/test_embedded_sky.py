"""The embedded sky: completed with Hipparcos-2, and compared with all of its bright stars."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from scipy.spatial import cKDTree

from starcat.catalog.archives.gaia import completed_sky, embedded_sky
from starcat.catalog.archives.hipparcos2 import embedded_hipparcos2
from starcat.catalog.bands.relation import relation
from starcat.catalog.bands.response import shipped
from starcat.catalog.ingest import Ingested, ingest_catalog
from starcat.catalog.sensor_band import in_sensor_band
from starcat.catalog.source import data_source
from starcat.catalog.source_files import locate
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.catalog.stars.verdict import Quality
from starcat.database.products.crossmatch import Crossmatch
from starcat.geometry.sphere import chord_from_separation
from starcat.pipeline.merging import merged_catalog
from starcat.pipeline.reading import read_all
from starcat.pipeline.selection.merging import combined_magnitude

V_LIMIT_MAG = 7.0
WITHIN_ARCSEC = 15.0
ALLOWED_MAG = 0.3


@pytest.fixture(scope="module")
def sky() -> Ingested:
    return ingest_catalog("gaia", completed_sky(), neighbours=False)


@pytest.fixture(scope="module")
def hipparcos() -> Ingested:
    return ingest_catalog(
        "hipparcos2", [embedded_hipparcos2()], epoch_jyear=2016.0, neighbours=False
    )


def light(mag: np.ndarray) -> np.ndarray:
    return 10.0 ** (-0.4 * mag)


def test_the_light_of_every_bright_star_of_hipparcos(sky, hipparcos):
    """At each star to V 7 the sky has the light of Hipparcos, or a reason why not."""
    stars = hipparcos.stars
    v_mag = floats_of(in_sensor_band(stars, "hipparcos2", shipped("V")).stars, "mag")
    g_mag = floats_of(in_sensor_band(stars, "hipparcos2", shipped("G")).stars, "mag")
    bright = np.flatnonzero(v_mag <= V_LIMIT_MAG)
    assert len(bright) == 15_097
    radius = chord_from_separation(np.radians(WITHIN_ARCSEC / 3600.0))
    places, mag = directions_of(stars), floats_of(sky.stars, "mag")
    near = cKDTree(directions_of(sky.stars)).query_ball_point(places[bright], radius)
    group = cKDTree(places).query_ball_point(places[bright], radius)
    seen = np.array([light(mag[rows]).sum() for rows in near])
    expected = np.array([np.nansum(light(g_mag[rows])) for rows in group])
    with np.errstate(divide="ignore"):
        off = np.abs(2.5 * np.log10(seen / expected))
    number = stars["hip_number"].to_numpy()[bright]
    colour = floats_of(sky.stars, "colour_mag")
    reddest = np.array([np.nanmax([*colour[rows], 0.0]) for rows in near])
    is_red = np.fmax(reddest, floats_of(stars, "second_colour_mag")[bright]) > RED_MAG
    is_variable = stars["is_flagged_variable"].to_numpy()[bright]
    differs = off > ALLOWED_MAG
    found = {
        "red giants": set(number[differs & is_red].tolist()),
        "variables": set(number[differs & is_variable & ~is_red].tolist()),
        "others": set(number[differs & ~is_variable & ~is_red].tolist()),
    }
    assert found == {"red giants": RED_GIANTS, "variables": VARIABLES, "others": set(OTHERS)}


RED_MAG = 1.3
"""V-I or BP-RP of red giants: most of them vary, and the library has few spectra so red."""

RED_GIANTS = {
    7493,
    9748,
    10826,
    13502,
    18911,
    20243,
    22552,
    23680,
    29450,
    31363,
    34909,
    34922,
    36773,
    40534,
    48327,
    54518,
    58981,
    59265,
    63152,
    64569,
    67261,
    67665,
    74082,
    74386,
    74582,
    77442,
    80682,
    86476,
    86624,
    91061,
    93666,
    97365,
    102440,
    102558,
    104719,
    105259,
    110478,
    112078,
}

VARIABLES = {21148, 36521, 41564, 41599, 73129, 97607, 105268}

OTHERS = {
    2941: "Gaia has a third row of 6.8 mag, which no list of doubles has",
    7751: "p Eridani, 11 arcsec apart: its entry in Hipparcos has the light of one component",
    18350: "Gaia's BP-RP contradicts B-V, and its G is too bright for both",
    33210: "Gaia's BP-RP contradicts B-V, and its G is too bright for both",
    39825: "the entry HIP 39827 beside it has part of its light",
    39827: "the light of HIP 39825, 10 arcsec away, is in its Hp, which scatters by 0.13 mag",
    63121: "alpha-1 Canum Venaticorum: Hipparcos measured the companion of a bright star too faint",
    71502: "a bad record of Hipparcos-2, 15 arcsec off; the Gaia star is right",
    88817: "40 Draconis: the light of 41 Draconis is in its Hp, which scatters by 0.15 mag",
    106884: "a bad record of Hipparcos-2: its Hp scatters by 0.75 mag",
}


def test_stars_that_gaia_lacks_are_added_next_to_their_companions(sky):
    """Theta Aurigae, alpha Herculis and Gliese 667 A, each with its companion."""
    stars = sky.stars
    rows = {number: row for row, number in enumerate(stars["star_id"].to_pylist())}
    for hip, companion, mag in (
        (28380, 3456842228196516480, 2.63),
        (84345, 4541877995116193408, 2.54),
        (84709, 5975663422846187008, 5.94),
    ):
        for number, change in ((-hip, "added"), (companion, "companion")):
            found = stars.slice(rows[number], 1).to_pylist()[0]
            assert found["double_flag"] == f"hipparcos2={change}"
            assert found["is_flagged_double"]
        added = stars.slice(rows[-hip], 1).to_pylist()[0]
        assert added["mag"] == pytest.approx(mag, abs=0.01)
        assert added["mag_source"] == "hipparcos2 Hp"
        assert 0.01 < added["mag_error"] < 0.2
        assert (added["designation"], added["hip_number"]) == (f"HIP {hip}", hip)


def test_pairs_that_gaia_does_not_resolve_have_the_light_of_both(sky):
    """Zeta Sagittarii, beta Phoenicis and beta Delphini, and the flags of all of them."""
    stars = sky.stars
    is_combined = pc.fill_null(pc.equal(stars["double_flag"], "hipparcos2=combined"), False)
    combined = stars.filter(is_combined)
    assert len(combined) == 1950
    by_hip = dict(zip(combined["hip_number"].to_pylist(), combined["mag"].to_pylist(), strict=True))
    assert [round(by_hip[hip], 2) for hip in (93506, 5165, 101769)] == [2.59, 3.11, 3.54]
    assert combined["is_flagged_double"].to_numpy().all()
    assert (combined["quality_flags"].to_numpy() & Quality.BLENDED).all()
    assert combined["mag_error"].null_count == 0


def test_the_blended_bp_and_rp_confirm_the_light_of_both(sky):
    """Gaia measures BP and RP of close pairs together: G follows from them without Hipparcos."""
    raw = ingest_catalog("gaia", [embedded_sky()], neighbours=False).stars
    single = dict(zip(raw["star_id"].to_pylist(), floats_of(raw, "mag"), strict=True))
    is_combined = pc.fill_null(pc.equal(sky.stars["double_flag"], "hipparcos2=combined"), False)
    stars = sky.stars.filter(is_combined)
    before = np.array([single[number] for number in stars["star_id"].to_pylist()])
    from_colour = relation("BP", ("BP", "RP"), shipped("G")).predict(
        floats_of(stars, "second_mag"), floats_of(stars, "colour_mag"), *np.zeros((2, len(stars)))
    )
    now = floats_of(stars, "mag")
    assert abs(np.nanmedian(from_colour.mag - now)) < 0.015
    assert np.nanmedian(from_colour.mag - before) < -0.2
    # Of pairs wider than the windows of BP and RP only one component is in them.
    assert np.nanmean(np.abs(from_colour.mag - now) < np.abs(from_colour.mag - before)) > 0.75


def test_the_brightest_stars_have_colours_and_errors(sky):
    stars = sky.stars
    row = stars["star_id"].to_pylist().index(-32349)
    sirius = in_sensor_band(stars.slice(row, 1), "gaia", shipped("Hp")).stars
    [mag], [error] = floats_of(sirius, "mag"), floats_of(sirius, "mag_error")
    assert mag == pytest.approx(-1.0876, abs=0.02)
    assert abs(mag + 1.0876) < error < 0.06
    castor = stars["star_id"].to_pylist().index(-36850)
    # Hipparcos measured Castor A and B together; Gaia has B.
    b = float(floats_of(stars, "mag")[stars["star_id"].to_pylist().index(892348694913501952)])
    both = combined_magnitude(np.array([floats_of(stars, "mag")[castor], b]))
    assert both == pytest.approx(1.55, abs=0.02)


def test_colours_that_hipparcos_does_not_know_are_null(hipparcos):
    stars = hipparcos.stars
    number = stars["hip_number"].to_numpy()
    assert stars["colour_mag"].null_count == 1143
    [row] = np.flatnonzero(number == 76001)
    told = in_sensor_band(stars, "hipparcos2", shipped("G")).stars.slice(int(row), 1)
    assert told["mag_source"].to_pylist() == ["Hp alone"]
    assert floats_of(told, "mag_error")[0] > 0.2


def test_the_files_of_the_embedded_sky(sky):
    completed, merged = sky.files
    layouts = {file.name: file for file in data_source("gaia").files}
    assert completed.rows == layouts["gaia_completed"].rows
    assert merged.sha256 == layouts["gaia_merged"].sha256
    assert sky.rejected_by_reason == {"duplicate_record": completed.rows}
    assert len(sky.stars) == merged.rows


@pytest.mark.slow
@pytest.mark.parametrize("names", [("gaia", "hipparcos2"), ("hipparcos2", "gaia")])
def test_either_order_of_gaia_and_hipparcos_has_the_same_bright_sky(sky, names):
    """Within 15 arcsec of every star to V 6 there is the light of the embedded sky, once."""
    paths = {name: locate(name, {}) for name in names}
    read = read_all(names, paths, epoch_jyear=2016.0)
    stars = merged_catalog(read, Crossmatch(), workers=2, neighbours=False).stars
    is_own = pc.equal(stars["catalog"], "hipparcos2").to_numpy()
    converted = names[0] == "hipparcos2"
    mag = floats_of(stars, "catalog_mag" if converted else "mag")
    if converted:
        own = in_sensor_band(stars.filter(pa.array(is_own)), "hipparcos2", shipped("G")).stars
        mag[is_own] = floats_of(own, "mag")
    radius = chord_from_separation(np.radians(WITHIN_ARCSEC / 3600.0))
    here, there = (cKDTree(directions_of(table)) for table in (stars, sky.stars))
    known = floats_of(sky.stars, "mag")
    bright = np.flatnonzero(known <= 6.0)
    place = there.data[bright]
    light_here = [light(mag[rows]).sum() for rows in here.query_ball_point(place, radius)]
    light_there = [light(known[rows]).sum() for rows in there.query_ball_point(place, radius)]
    off = 2.5 * np.log10(np.array(light_here) / np.array(light_there))
    colour = floats_of(sky.stars, "colour_mag")
    odd = bright[np.abs(off) > ALLOWED_MAG]
    # Of the others the relation from Hp is wrong, or the star varies.
    hip = {int(number) for number in RED_GIANTS | VARIABLES | set(OTHERS)}
    numbers = [
        number
        for number, red in zip(odd.tolist(), (colour[odd] > RED_MAG).tolist(), strict=True)
        if not red
    ]
    near = cKDTree(directions_of(stars.filter(pa.array(stars["hip_number"].is_valid()))))
    hips = stars["hip_number"].drop_null().to_numpy()
    left = {int(hips[near.query(there.data[row])[1]]) for row in numbers} - hip
    assert left == set()
    gaia = stars.filter(pc.equal(stars["catalog"], "gaia"))["star_id"].to_pylist()
    # The star next to which Hipparcos-2 has the bad record HIP 71502.
    bad = stars.filter(pc.equal(stars["designation"], "HIP 71502"))
    assert len(bad) == 0
    assert 28380 in stars["hip_number"].to_pylist()
    assert len(gaia) > 300_000
