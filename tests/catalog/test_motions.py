"""Proper motions that a build takes from another catalog: which stars, from where, how far."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from archives import file_header
from astropy import units
from astropy.coordinates import Distance, SkyCoord
from astropy.time import Time
from database_copies import copied, seal
from drafts import merged, spec_with
from jsonschema import Draft202012Validator

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import Ingested
from starcat.catalog.source import data_source
from starcat.catalog.stars.star_table import floats_of, with_columns
from starcat.catalog.stars.verdict import Quality
from starcat.catalog.store.reading import read_catalog
from starcat.database.manifest import MANIFEST_VERSION
from starcat.database.products.motions import OUTCOMES, motion_problems
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.database.verify import verify
from starcat.pipeline.build import Built, build
from starcat.pipeline.draft import Draft, run
from starcat.pipeline.rebuild import rebuild
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.reading import preset
from starcat.pipeline.supply import guide_star_motions, supply_motions
from starcat.resources import resource_folder
from starcat.storage.atomic import file_sha256

FAINT_LIMIT_MAG = 6.3
FAST_MAS_YR = 500.0

SPEC = """\
name = "moved"
version = "1.0.0"
epoch_jyear = 2026.0
catalog = { source = "gaia", motions = ["tycho2", "hipparcos"] }
selection.faint_limit_mag = 5.0
camera = { width_px = 512, height_px = 512, fov_x_deg = 40.0 }
boresights.count = 200
self_test = { frames = 5, min_identified = 0.8 }
"""


def spec_of(*motions: str) -> BuildSpec:
    return spec_with(SPEC, catalog={"motions": motions} if motions else {})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bright stars of the embedded sky, in a file of its own layout."""
    layout = data_source("gaia").main_file
    kinds = np.dtype([(column.name, column.format) for column in layout.columns])
    sky = np.frombuffer(embedded_sky().read_bytes(), kinds, offset=layout.header_bytes)
    bright = sky[sky["mag_g"] <= FAINT_LIMIT_MAG]
    folder = tmp_path_factory.mktemp("sky")
    header = file_header(layout, len(bright))
    (folder / "gaia_merged.bin").write_bytes(header + bright.tobytes())
    return folder


@pytest.fixture(scope="module")
def inputs(folder: Path, catalogs: Path) -> dict[str, list[Path]]:
    return {
        "gaia": [folder / "gaia_merged.bin"],
        "tycho2": [catalogs / "tyc2.dat.gz"],
        "hipparcos": [catalogs / "hip_main.dat.gz"],
    }


@pytest.fixture(scope="module")
def sky(inputs: dict[str, list[Path]]) -> Ingested:
    """What a build reads of the embedded sky: no star moves."""
    return read_catalog("gaia", inputs["gaia"], epoch_jyear=2026.0, neighbours=False)


@pytest.fixture(scope="module")
def built(inputs: dict[str, list[Path]], tmp_path_factory: pytest.TempPathFactory) -> Built:
    return build(spec_of(), tmp_path_factory.mktemp("dist"), inputs=inputs)


@pytest.fixture(scope="module")
def database(built: Built) -> DatabaseFolder:
    return open_database_folder(built.folder)


def rows_of(table: pa.Table, star_id: pa.ChunkedArray) -> pa.Table:
    """Rows of a star table by star_id, in the order asked for."""
    place = {number: row for row, number in enumerate(table["star_id"].to_pylist())}
    return table.take([place[number] for number in star_id.to_pylist()])


def coordinates(stars: pa.Table, motions: SkyCoord | None = None) -> SkyCoord:
    """Stars for astropy, at 10 pc, where light travels as if the sky were flat."""
    own = {
        f"pm_{axis}": floats_of(stars, f"pm_{axis}_mas_yr") * units.mas / units.yr
        for axis in ("ra_cosdec", "dec")
    }
    count = len(stars)
    return SkyCoord(
        *(floats_of(stars, name) * units.deg for name in ("ra_deg", "dec_deg")),
        distance=Distance(np.full(count, 10.0) * units.pc),
        **{name: getattr(motions, name) if motions else values for name, values in own.items()},
        radial_velocity=np.zeros(count) * units.km / units.s,
        obstime=Time(floats_of(stars, "epoch_jyear"), format="jyear"),
    )


def at(stars: SkyCoord, epoch_jyear: float) -> SkyCoord:
    return stars.apply_space_motion(new_obstime=Time(epoch_jyear, format="jyear"))


def joined(database: DatabaseFolder) -> tuple[pa.Table, pa.Table]:
    """The guide stars with a motion from another catalog, and the row about each."""
    table, stars = database.table("motions"), database.table("stars")
    chosen = pc.equal(table["outcome"], "joined")
    return stars.filter(chosen), table.filter(chosen)


def entries(table: pa.Table, ingested: Callable[[str, str], Ingested]) -> pa.Table:
    """The entries of the catalogs that the motions are of, by the order of the table."""
    files = {"tycho2": "tyc2.dat.gz", "hipparcos": "hip_main.dat.gz"}
    read = {source: ingested(source, name).stars for source, name in files.items()}
    place = {
        (name, number): (name, row)
        for name, stars in read.items()
        for row, number in enumerate(stars["star_id"].to_pylist())
    }
    named = zip(table["catalog"].to_pylist(), table["counterpart_id"].to_pylist(), strict=True)
    found = [place[key] for key in named]
    return pa.concat_tables([read[name].slice(row, 1) for name, row in found])


# Places of the stars -------------------------------------------------------------------------


def test_stars_are_where_astropy_takes_them(database, ingested, sky):
    stars, table = joined(database)
    assert len(stars) > 1_500
    assert set(stars["epoch_jyear"].to_pylist()) == {2026.0}
    before = rows_of(sky.stars, stars["star_id"])
    assert set(before["epoch_jyear"].to_pylist()) == {2016.0}
    # The motions that the archives print for J2000 and J1991.25, as they are in 2016: that of
    # 61 Cygni has turned by 0.02 deg, which is 22 mas in ten years.
    then = at(coordinates(entries(table, ingested)), 2016.0)
    there = at(coordinates(before, then), 2026.0)
    off = there.separation(coordinates(stars)).to_value(units.mas)
    assert off.max() < 1.0
    way = coordinates(before, then).separation(coordinates(stars)).to_value(units.arcsec)
    assert way == pytest.approx(floats_of(table, "moved_arcsec"), abs=1e-6)
    assert way.max() > 9.0


def test_fast_stars_are_where_hipparcos_has_them(database, ingested, expected):
    """Stars with a motion of Tycho-2 against Hipparcos, 35 years after its epoch."""
    stars, table = joined(database)
    now = at(coordinates(ingested("hipparcos", "hip_main.dat.gz").stars), 2026.0)
    fast = np.flatnonzero(
        (floats_of(table, "moved_arcsec") > 10.0 * FAST_MAS_YR / 1000.0)
        & (np.array(table["catalog"].to_pylist()) == "tycho2")
    )
    assert len(fast) > expected(genuine=20, generated=15)
    _, off, _ = coordinates(stars.take(pa.array(fast))).match_to_catalog_sky(now)
    # They were 5 to 47 arcsec off. The remaining differences are orbits of double stars.
    assert np.median(off.arcsec) < 0.1
    assert off.arcsec.max() < 2.0


def test_stars_without_a_counterpart_stay_where_they_are(database, sky):
    table, stars = database.table("motions"), database.table("stars")
    moves = pc.equal(table["outcome"], "joined").to_numpy()
    assert 0 < (~moves).sum() < 0.1 * len(stars)
    before = rows_of(sky.stars, stars["star_id"])
    for name in ("ra_deg", "dec_deg", "x", "y", "z"):
        assert stars[name].to_numpy()[~moves].tobytes() == before[name].to_numpy()[~moves].tobytes()
    assert set(stars["epoch_jyear"].to_numpy()[~moves]) == {2016.0}
    flags = stars["quality_flags"].to_numpy() & int(Quality.NO_PROPER_MOTION)
    assert (flags > 0).tolist() == (~moves).tolist()
    # Nearest neighbours are computed at the present places of the stars.
    assert stars["nearest_separation_arcsec"].null_count == 0


# Rows and messages ---------------------------------------------------------------------------


def test_every_guide_star_is_listed_once(database, built):
    table, stars = database.table("motions"), database.table("stars")
    assert table["star"].to_pylist() == list(range(len(stars)))
    outcomes = table["outcome"].to_pylist()
    assert set(outcomes) <= set(OUTCOMES)
    stay = len(stars) - outcomes.count("joined")
    told = [text for text in built.warnings if "the product motions lists them" in text]
    assert len(told) == 1
    assert told[0].startswith(f"gaia: {stay:,} of {len(stars):,} guide stars have no motion in ")
    assert f"no_candidate {outcomes.count('no_candidate'):,}" in told[0]
    # What a build without motions says, that all stars stay at J2016, is not so here.
    assert not any("have no proper motion and stay" in text for text in built.warnings)
    assert any("suppl_1.dat is not among the inputs" in text for text in built.warnings)


def test_the_manifest_says_what_came_from_where(database, inputs):
    manifest = database.manifest
    schema = (resource_folder("schemas") / f"manifest-{MANIFEST_VERSION}.json").read_text()
    Draft202012Validator(json.loads(schema)).validate(manifest)
    assert [(s["source"], s["role"]) for s in manifest["sources"]] == [
        ("gaia", "stars"),
        ("tycho2", "motions"),
        ("hipparcos", "motions"),
    ]
    _, table = joined(database)
    for source in manifest["sources"][1:]:
        path = inputs[source["source"]][0]
        assert [file["sha256"] for file in source["files"]] == [file_sha256(path)]
        way = floats_of(table.filter(pc.equal(table["catalog"], source["source"])), "moved_arcsec")
        assert source["joined"] == len(way)
        if len(way):
            expected = {"median": np.median(way), "largest": way.max()}
            assert source["moved_arcsec"] == pytest.approx(expected, abs=1e-6)
    assert manifest["sources"][1]["joined"] > 1_000
    report = json.loads((database.folder / "report" / "report.json").read_text())
    assert report["sources"] == manifest["sources"]
    page = (database.folder / "report" / "index.html").read_text()
    assert "stars whose motion is from here" in page


@pytest.mark.slow
def test_the_database_is_sound_and_rebuilds(built, inputs, tmp_path):
    assert verify(built.folder).findings == ()
    assert rebuild(built.folder, inputs, tmp_path).is_identical


def test_a_damaged_table_is_reported(database):
    table, stars = database.table("motions"), database.table("stars")
    assert list(motion_problems(table, stars)) == []
    assert any("each once" in text for text in motion_problems(table.slice(1), stars))
    row = int(np.nanargmax(floats_of(table, "moved_arcsec")))
    for name, value, words in (
        ("moved_arcsec", 1e-4, f"moved_arcsec of row {row} is not the way that its star has gone"),
        ("outcome", "guessed", "outcome guessed; expected one of"),
        ("outcome", "ambiguous", "but the star has a motion"),
    ):
        values = table[name].to_pylist()
        values[row] = value if name == "outcome" else values[row] + value
        damaged = with_columns(table, {name: pa.array(values)})
        problems = list(motion_problems(damaged, stars))
        assert any(words in text for text in problems), problems
        assert len(problems) == 1 or name == "outcome"


@pytest.mark.parametrize("damage", ["count", "product"])
def test_a_manifest_that_says_otherwise_is_reported(damage, built, tmp_path):
    copy = copied(built.folder, tmp_path)
    more = built.manifest["sources"][1]["joined"] + 1
    expected = f"{more} stars have their motion from it, but the product motions holds"
    if damage == "product":
        (copy / "motions.parquet").unlink()
        expected = "tycho2: motions are from it, but there is no product motions"

    def change(manifest: dict[str, Any]) -> None:
        if damage == "count":
            manifest["sources"][1]["joined"] = more
        else:
            del manifest["products"]["motions"], manifest["files"]["motions.parquet"]

    seal(copy, change)
    found = [str(finding) for finding in verify(copy).findings]
    assert any(expected in text for text in found), found


# Which entry is which star -------------------------------------------------------------------


def motions_with(lines: list[bytes], sky: Ingested, folder: Path) -> Draft:
    """The motions of the sky's stars in a Tycho-2 of some records."""
    (folder / "tyc2.dat").write_bytes(b"".join(lines))
    inputs = {"tycho2": [folder / "tyc2.dat"]}
    return run(merged(sky, spec_of("tycho2"), inputs), (supply_motions,))


def outcome_of(found: Draft, star_id: int) -> dict[str, object]:
    rows = np.flatnonzero(found.stars["star_id"].to_numpy() == star_id)
    assert found.motions is not None
    (row,) = found.motions.take(pa.array(rows)).to_pylist()
    return row


def number_of(record: bytes) -> tuple[int, ...]:
    """The three parts of a record's TYC number."""
    return tuple(int(record[first:last]) for first, last in ((0, 4), (5, 10), (11, 12)))


def number_in(designation: str) -> tuple[int, ...]:
    return tuple(map(int, designation.removeprefix("TYC ").split("-")))


@pytest.fixture(scope="module")
def tycho2(catalogs: Path) -> list[bytes]:
    return gzip.decompress((catalogs / "tyc2.dat.gz").read_bytes()).splitlines(keepends=True)


def test_two_entries_that_fit_as_well_give_no_motion(tycho2, sky, database, tmp_path):
    stars, table = joined(database)
    is_tycho2 = np.array(table["catalog"].to_pylist()) == "tycho2"
    alone = np.flatnonzero((table["n_candidates"].to_numpy() == 1) & is_tycho2)
    twice, gone = (int(row) for row in alone[:2])
    begins = [number_in(table["designation"][row].as_py()) for row in (twice, gone)]
    lines = []
    for line in tycho2:
        if number_of(line) != begins[1]:
            lines.append(line)
        if number_of(line) == begins[0]:
            lines.append(line[:11] + b"3" + line[12:])
    found = motions_with(lines, sky, tmp_path)
    ambiguous = outcome_of(found, stars["star_id"][twice].as_py())
    assert (ambiguous["outcome"], ambiguous["n_candidates"]) == ("ambiguous", 2)
    assert ambiguous["catalog"] == "tycho2"
    lost = outcome_of(found, stars["star_id"][gone].as_py())
    assert (lost["outcome"], lost["n_candidates"]) == ("no_candidate", 0)
    assert [lost[name] for name in ("catalog", "counterpart_id", "moved_arcsec")] == [None] * 3
    for star_id in stars["star_id"].take([twice, gone]).to_pylist():
        moved = found.stars.filter(pc.equal(found.stars["star_id"], star_id))
        assert moved["epoch_jyear"].to_pylist() == [2016.0]
        assert moved["pm_dec_mas_yr"].null_count == 1
    # The other stars do not mind.
    others = np.setdiff1d(np.arange(len(stars)), [twice, gone])[:50]
    for row in others[is_tycho2[others]].tolist():
        assert outcome_of(found, stars["star_id"][row].as_py())["outcome"] == "joined"


def test_an_entry_without_motion_gives_none(tycho2, sky, database, tmp_path):
    """A record of Tycho-2 that has only its observed position (X)."""
    stars, table = joined(database)
    of_tycho2 = np.flatnonzero(np.array(table["catalog"].to_pylist()) == "tycho2")
    slow = int(of_tycho2[np.argmin(floats_of(table, "moved_arcsec")[of_tycho2])])
    begin = number_in(table["designation"][slow].as_py())
    lines = list(tycho2)
    row = next(n for n, line in enumerate(lines) if number_of(line) == begin)
    blank = bytearray(lines[row])
    # The observed position is the mean one, a few hundredths of an arcsec away.
    blank[152:164], blank[165:177] = blank[15:27], blank[28:40]
    blank[13:14] = b"X"
    for first, last in ((15, 27), (28, 40), (41, 48), (49, 56)):
        blank[first:last] = b" " * (last - first)
    lines[row] = bytes(blank)
    found = outcome_of(motions_with(lines, sky, tmp_path), stars["star_id"][slow].as_py())
    assert (found["outcome"], found["moved_arcsec"]) == ("no_motion", None)


def test_a_star_with_a_motion_keeps_it(sky, inputs, tmp_path):
    motion = {"pm_ra_cosdec_mas_yr": 12.5, "pm_dec_mas_yr": -3.0}
    own = replace(sky, stars=with_columns(sky.stars, motion))
    found = run(merged(own, spec_of(), inputs), (supply_motions,))
    assert found.motions is not None
    assert set(found.motions["outcome"].to_pylist()) == {"own_motion"}
    for name in ("ra_deg", "dec_deg", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "epoch_jyear"):
        assert found.stars[name].equals(own.stars[name])


def test_threads_do_not_matter(sky, inputs):
    one, two = (run(merged(sky, spec_of(), inputs, n), (supply_motions,)) for n in (1, 2))
    assert one.motions is not None
    assert one.motions.equals(two.motions)
    assert one.stars.equals(two.stars)


def test_without_the_key_nothing_is_said_of_motions(sky, small_database):
    spec = preset("gaia-12deg")
    assert spec.catalog.motions == ()
    # Manifests and databases without it have the same bytes as in earlier versions.
    assert "motions" not in spec.recorded()["catalog"]
    assert preset("gaia-12deg-2026").recorded()["catalog"]["motions"] == ["tycho2"]
    found = run(merged(sky, spec, {}), (supply_motions,))
    assert found.stars is sky.stars
    assert [facts.role for facts in found.sources] == ["stars"]
    assert guide_star_motions(found) == []
    assert open_database_folder(small_database).manifest["manifest_version"] == MANIFEST_VERSION


def test_the_preset_for_2026_is_the_default_one_moved():
    moved, plain = preset("gaia-12deg-2026"), preset("gaia-12deg")
    assert (moved.epoch_jyear, moved.catalog.motions) == (2026.0, ("tycho2",))
    assert moved.sources == ("gaia", "tycho2")
    assert "Tycho-2" in moved.description
    for section in ("selection", "camera", "boresights", "products", "self_test"):
        assert getattr(moved, section) == getattr(plain, section)
