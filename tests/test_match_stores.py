"""Cross-identification of catalog stores: what it is in memory, however the sky is divided."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hats_stores import write_catalog, write_facts
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from starcat.artifact.other_catalogs import NEEDED
from starcat.errors import OutputError, ParseError, ProductError, SchemaError
from starcat.geometry.sphere import (
    directions_from_radec,
    radec_from_directions,
    separation,
    tangent_axes,
)
from starcat.pipeline.counterparts import match_files
from starcat.pipeline.match_pieces import MOST_RINGS
from starcat.pipeline.match_stores import match_stores
from starcat.pipeline.match_summary import Summary, median_of, write_numbers
from starcat.products.match_figures import ARCSEC
from starcat.specs.product_sections import Crossmatch
from starcat.storage.parquet import read_parquet, write_parquet, write_parts
from starcat.storage.schema import product_schema
from starcat.store.pixels import MAX_ORDER, Pixel, healpix_29, region_around

pytest.importorskip("cdshealpix")

Array = NDArray[np.float64]

# A pole, a corner where three base pixels meet, one where four do, the meridian, and a border.
PLACES = [(77.0, 90.0), (0.0, 41.8103149), (45.0, 0.0), (0.0, -20.0), (200.0, -90.0), (123.4, 5.6)]


def star_table(
    ra_deg: Array, dec_deg: Array, generator: np.random.Generator, first_id: int = 1, **own: Any
) -> pa.Table:
    """Stars with all columns that are needed; numbers are shuffled over the sky."""
    count = len(ra_deg)
    moves = own.get("moves", generator.random(count) < 0.5)
    speed = own.get("speed_mas_yr", generator.exponential(200.0, (2, count)))
    columns = {
        "star_id": first_id + generator.permutation(count),
        "catalog": ["sao"] * count,
        "designation": [f"star {k}" for k in range(count)],
        "ra_deg": ra_deg,
        "dec_deg": dec_deg,
        "epoch_jyear": own.get("epoch", generator.choice([1950.0, 1991.25, 2016.0], count)),
        "pm_ra_cosdec_mas_yr": pa.array(speed[0], mask=~np.asarray(moves)),
        "pm_dec_mas_yr": pa.array(-speed[1], mask=~np.asarray(moves)),
        "mag": pa.array(generator.uniform(3.0, 9.0, count), mask=generator.random(count) < 0.1),
        "band": ["V"] * count,
    }
    known = product_schema("stars").arrow_schema
    schema = pa.schema([known.field(name) for name in NEEDED])
    return pa.table({name: columns[name] for name in NEEDED}, schema=schema).sort_by("star_id")


def beside(ra_deg: Array, dec_deg: Array, east_rad: Array, north_rad: Array) -> tuple[Array, Array]:
    """Return places so far from others, also at a pole."""
    east, north = tangent_axes(ra_deg, dec_deg)
    moved = directions_from_radec(ra_deg, dec_deg)
    moved = moved + east * east_rad[:, None] + north * north_rad[:, None]
    return radec_from_directions(moved / np.linalg.norm(moved, axis=1)[:, None])


def sky(seed: int, radius_arcsec: float, crowding: float) -> tuple[pa.Table, pa.Table]:
    """Two catalogs around awkward places that share stars, about as far apart as a radius."""
    generator = np.random.default_rng(seed)
    tables = []
    for count in (60, 25):
        place = np.array(PLACES)[generator.integers(0, len(PLACES), count)]
        offsets = generator.normal(scale=crowding * radius_arcsec * ARCSEC, size=(2, count))
        ra_deg, dec_deg = beside(place[:, 0], place[:, 1], *offsets)
        tables.append(star_table(ra_deg, dec_deg, generator, first_id=1000 * len(tables)))
    a, others = tables
    shared = a.slice(0, 40)
    offsets = generator.normal(scale=0.02 * radius_arcsec * ARCSEC, size=(2, 40))
    moved = beside(shared["ra_deg"].to_numpy(), shared["dec_deg"].to_numpy(), *offsets)
    for name, values in zip(("ra_deg", "dec_deg"), moved, strict=True):
        place = shared.column_names.index(name)
        shared = shared.set_column(place, shared.schema.field(name), pa.array(values))
    return a, pa.concat_tables([shared, others])


def sorted_as_a_store(table: pa.Table, stars: pa.Table) -> pa.Table:
    """Return what `match_files` wrote in the order of the sky, without the numbers of rows."""
    places = healpix_29(stars["ra_deg"].to_numpy(), stars["dec_deg"].to_numpy())
    place = places[table["star"].to_numpy()]
    order = np.lexsort((table["rank"].to_numpy(), table["star_id"].to_numpy(), place))
    return table.take(pa.array(order)).drop_columns("star")


def check_same(
    a: pa.Table,
    b: pa.Table,
    radius_arcsec: float,
    folder: Path,
    *,
    max_rows: int = 3,
    piece_load: int = 60,
) -> Summary:
    """Check that stores of two catalogs are matched as the whole tables are, bit for bit."""
    for name, table in (("a", a), ("b", b)):
        write_parquet(table, folder / f"{name}.parquet")
        write_catalog(table, folder / name, max_rows)
    wanted = Crossmatch(radius_arcsec=radius_arcsec)
    expected = match_files(
        folder / "a.parquet", folder / "b.parquet", folder / "whole.parquet", wanted
    )
    found = match_stores(
        folder / "a", folder / "b", folder / "parts.parquet", wanted, piece_load=piece_load
    )
    whole = sorted_as_a_store(read_parquet(folder / "whole.parquet"), a)
    assert read_parquet(folder / "parts.parquet").equals(whole)
    assert found == expected
    # Not even the bytes tell in how many parts it was made.
    whole = whole.replace_schema_metadata(None).combine_chunks()
    write_parquet(whole, folder / "sorted.parquet")
    assert (folder / "parts.parquet").read_bytes() == (folder / "sorted.parquet").read_bytes()
    return expected


@pytest.mark.parametrize(("radius_arcsec", "max_rows"), [(0.5, 40), (10.0, 1), (600.0, 5)])
def test_stores_are_matched_as_whole_tables_are(radius_arcsec, max_rows, tmp_path):
    a, b = sky(8, radius_arcsec, 3.0)
    found = check_same(a, b, radius_arcsec, tmp_path, max_rows=max_rows, piece_load=25)
    assert found.matched > 30
    assert found.position_error_arcsec == pytest.approx(0.02 * radius_arcsec, rel=0.5)


@pytest.mark.slow
@pytest.mark.timeout(600)
@settings(max_examples=20)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.5, 10.0, 60.0, 600.0]),
    st.floats(1.0, 12.0),
    st.sampled_from([1, 5, 40]),
    st.sampled_from([1, 25, 1 << 19]),
)
def test_any_stores_are_matched_as_whole_tables_are(
    seed, radius_arcsec, crowding, max_rows, piece_load
):
    a, b = sky(seed, radius_arcsec, crowding)
    with tempfile.TemporaryDirectory() as folder:
        check_same(a, b, radius_arcsec, Path(folder), max_rows=max_rows, piece_load=piece_load)


@pytest.mark.slow
def test_a_cluster_longer_than_messages_go(tmp_path):
    """Each star of a row of them is a candidate of the next: all hang together."""
    generator = np.random.default_rng(4)
    count = 2 * MOST_RINGS
    ra_deg = 40.0 + np.arange(count) * 570.0 / 3600.0
    dec_deg = generator.normal(scale=1e-4, size=count)
    still = np.zeros(count, dtype=bool)
    a = star_table(ra_deg, dec_deg, generator, moves=still, epoch=np.full(count, 2000.0))
    b = star_table(
        ra_deg + 285.0 / 3600.0, dec_deg, generator, moves=still, epoch=np.full(count, 2000.0)
    )
    found = check_same(a, b, 600.0, tmp_path, max_rows=20)
    assert found.no_candidate == 0
    table = read_parquet(tmp_path / "parts.parquet")
    assert sorted(table["n_stars"].to_pylist())[:2] == [1, 2]


@pytest.mark.slow
@pytest.mark.parametrize("who_moves", ["the star", "the candidate"])
def test_a_star_that_was_far_away_a_century_ago(who_moves, tmp_path):
    """Barnard's star moves 1,030 arcsec in a century, over several of the small partitions."""
    generator = np.random.default_rng(7)
    count = 150
    ra_deg, dec_deg = generator.uniform(269.0, 270.0, count), generator.uniform(4.0, 5.0, count)
    epochs = {"the star": (1900.0, 2000.0), "the candidate": (2000.0, 1900.0)}[who_moves]
    tables = []
    for epoch in epochs:
        moves = np.zeros(count, dtype=bool)
        moves[0] = (who_moves == "the star") == (epoch == epochs[0])
        speed = np.array([np.full(count, 0.0), np.full(count, -10_300.0)])
        dec = dec_deg.copy()
        dec[0] = 4.4 if epoch == 1900.0 else 4.4 + 1030.0 / 3600.0
        table = star_table(
            ra_deg, dec, generator, moves=moves, speed_mas_yr=speed, epoch=np.full(count, epoch)
        )
        tables.append(table)
    check_same(tables[0], tables[1], 5.0, tmp_path, max_rows=4)
    rows = read_parquet(tmp_path / "parts.parquet").filter(
        pa.compute.equal(pa.compute.field("star_designation"), "star 0")
    )
    assert rows["designation"].to_pylist()[0] == "star 0"
    assert rows["separation_arcsec"].to_pylist()[0] < 0.01


@pytest.mark.parametrize(("of_a", "of_b"), [(0, 5), (5, 0), (0, 0)])
def test_catalogs_without_stars(of_a, of_b, tmp_path):
    generator = np.random.default_rng(1)
    tables = [star_table(np.arange(n) + 0.5, np.zeros(n), generator) for n in (of_a, of_b)]
    found = check_same(tables[0], tables[1], 10.0, tmp_path)
    assert (found.stars, found.counterparts, found.matched) == (of_a, of_b, 0)


@pytest.fixture(scope="module")
def catalogs_made(ingested, tmp_path_factory):
    """SAO and Hipparcos as star tables and as catalogs of partitions."""
    folder = tmp_path_factory.mktemp("stores")
    for source, name in (("sao", "sao.dat.gz"), ("hipparcos", "hip_main.dat.gz")):
        stars = ingested(source, name).stars
        write_parquet(stars, folder / f"{source}.parquet")
        write_catalog(stars, folder / source, 2000, group_rows=256)
    return folder


@pytest.fixture(scope="module")
def whole(catalogs_made: Path) -> tuple[Summary, pa.Table]:
    """What `match_files` makes of the star tables, in the order of a store."""
    files = (catalogs_made / "sao.parquet", catalogs_made / "hipparcos.parquet")
    output = catalogs_made / "whole.parquet"
    found = match_files(*files, output, Crossmatch(radius_arcsec=20.0))
    return found, sorted_as_a_store(read_parquet(output), read_parquet(files[0]))


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("sao", "hipparcos.parquet"),
        pytest.param("sao.parquet", "hipparcos", marks=pytest.mark.slow),
        pytest.param("sao", "hipparcos", marks=pytest.mark.slow),
    ],
)
def test_a_store_and_a_file(a, b, catalogs_made, whole, tmp_path):
    wanted = Crossmatch(radius_arcsec=20.0)
    found = match_stores(catalogs_made / a, catalogs_made / b, tmp_path / "x.parquet", wanted)
    assert found == whole[0]
    assert found.matched > 1000
    assert read_parquet(tmp_path / "x.parquet").equals(whole[1])
    assert [path.name for path in tmp_path.iterdir()] == ["x.parquet"]


@pytest.mark.slow
def test_the_command_takes_stores(catalogs_made, tmp_path, starcat):
    stores = (catalogs_made / "sao", catalogs_made / "hipparcos")
    output = tmp_path / "x.parquet"
    ran = starcat(["crossmatch", *stores, "-o", output, "--workers", 1, "--json"])
    assert ran.code == 0, ran.err
    expected = match_stores(*stores, tmp_path / "y.parquet", Crossmatch())
    shown = json.loads(ran.out)
    assert (shown["a"], shown["b"]) == ("sao", "hipparcos")
    assert {name: shown[name] for name in expected.as_dict()} == expected.as_dict()
    assert output.read_bytes() == (tmp_path / "y.parquet").read_bytes()


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_two_processes_give_the_same_bytes(catalogs_made, tmp_path):
    from starcat.store.cluster import cluster, run_tasks

    stores = (catalogs_made / "sao", catalogs_made / "hipparcos")
    wanted = Crossmatch(radius_arcsec=20.0)
    alone, both = tmp_path / "alone.parquet", tmp_path / "both.parquet"
    expected = match_stores(*stores, alone, wanted)
    stages: list[tuple[str, int, int | None]] = []
    with cluster(2) as client:
        found = match_stores(
            *stores,
            both,
            wanted,
            partial(run_tasks, client),
            lambda *event: stages.append(event),
            piece_load=1000,
        )
    assert found == expected
    assert both.read_bytes() == alone.read_bytes()
    assert [name for name, done, total in stages if done == total] == [
        "crossmatch counts",
        "crossmatch counts",
        "crossmatch pairs",
        "crossmatch verdicts",
    ]


# What it is made of --------------------------------------------------------------------------


@given(
    st.integers(0, 9),
    st.floats(0.0, 1.0, exclude_max=True),
    st.floats(1e-7, 0.6),
    st.integers(1, 5),
    st.integers(0, 2**32 - 1),
)
def test_a_hop_leads_no_farther_than_the_next_ring(order, share, hop_rad, rings, seed):
    generator = np.random.default_rng(seed)
    pixel = Pixel(order, int(share * 12 * 4**order))
    region = region_around(pixel, hop_rad, rings)
    # Places in each range of the region, and in the pixel itself.
    bounds = np.array([(pixel.first, pixel.end - 1), *((a, b - 1) for a, b in region.ranges)])
    chosen = bounds[generator.integers(0, len(bounds), 200)]
    chosen[:50] = bounds[0]
    inside = generator.integers(chosen[:, 0], chosen[:, 1], endpoint=True)
    from cdshealpix import nested

    lon, lat = nested.healpix_to_lonlat(inside, MAX_ORDER)
    ra_deg, dec_deg = lon.to_value("deg"), lat.to_value("deg")
    angle = generator.uniform(0.0, 2.0 * np.pi, 200)
    length = np.tan(hop_rad * 0.999999)
    there = beside(ra_deg, dec_deg, length * np.cos(angle), length * np.sin(angle))
    hop = separation(directions_from_radec(ra_deg, dec_deg), directions_from_radec(*there))
    assert hop == pytest.approx(hop_rad, rel=1e-5, abs=1e-9)
    before = region.level_of(healpix_29(ra_deg, dec_deg))
    after = region.level_of(healpix_29(*there))
    assert (before >= 0).all()
    assert (region.level_of(np.arange(pixel.first, pixel.first + 1)) == 0).all()
    reached = before < rings
    assert (after[reached] >= 0).all()
    assert (after[reached] <= before[reached] + 1).all()


@given(
    st.lists(
        st.lists(
            st.one_of(
                st.floats(allow_nan=False, allow_infinity=False, width=32),
                st.sampled_from([-0.0, 5e-324, 1.0, 1.0 + 2**-52]),
            ),
            max_size=12,
        ),
        min_size=1,
        max_size=5,
    )
)
def test_the_median_of_files_is_that_of_all_numbers(parts):
    together = [number for part in parts for number in part]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{k}.f8" for k in range(len(parts))]
        for path, part in zip(paths, parts, strict=True):
            write_numbers(np.array(part, dtype=np.float64), path)
        expected = float(np.median(together)) if together else None
        assert median_of(paths) == (len(together), expected)


def test_a_table_in_parts_is_the_same_file(tmp_path, monkeypatch):
    monkeypatch.setattr("starcat.storage.parquet.ROW_GROUP_ROWS", 1000)
    generator = np.random.default_rng(2)
    stars = star_table(generator.uniform(0, 360, 4500), np.zeros(4500), generator)
    write_parquet(stars.combine_chunks(), tmp_path / "whole.parquet")
    for step in (1, 700, 1000, 9000):
        rows = 40 if step == 1 else len(stars)
        table = stars.slice(0, rows)
        write_parquet(table.combine_chunks(), tmp_path / "whole.parquet")
        parts = [table.slice(start, step) for start in range(0, rows, step)]
        write_parts(parts, table, tmp_path / "parts.parquet")
        whole = (tmp_path / "whole.parquet").read_bytes()
        assert (tmp_path / "parts.parquet").read_bytes() == whole
        assert pq.read_metadata(tmp_path / "parts.parquet").num_row_groups == -(-rows // 1000)


# What is no catalog ---------------------------------------------------------------------------


@pytest.fixture
def store(tmp_path: Path) -> Path:
    generator = np.random.default_rng(3)
    stars = star_table(generator.uniform(0, 360, 60), generator.uniform(-80, 80, 60), generator)
    write_catalog(stars, tmp_path / "store", 20)
    return tmp_path / "store"


def matched(store: Path) -> Summary:
    return match_stores(store, store, store.parent / "x.parquet", Crossmatch())


def a_part(store: Path) -> Path:
    return sorted(store.rglob("Npix=*.parquet"))[0]


def changed(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    pq.write_table(change(pq.ParquetFile(path).read()), path)


@pytest.mark.slow
def test_a_store_that_matches_itself_also_with_larger_texts(store):
    expected = matched(store)
    assert (expected.stars, expected.matched, expected.verdicts["unique"]) == (60, 60, 60)
    assert expected.median_separation_arcsec == 0.0
    for path in store.rglob("Npix=*.parquet"):
        changed(
            path,
            lambda table: pa.table(
                {
                    name: table[name].cast(pa.large_string())
                    if pa.types.is_string(table[name].type)
                    else table[name]
                    for name in table.column_names
                }
            ),
        )
    assert matched(store) == expected


def test_stores_that_cannot_be_matched(store):
    part = a_part(store)
    whole = pq.ParquetFile(part).read()
    before = sorted(path.name for path in store.parent.iterdir())
    changed(part, lambda table: table.set_column(8, "mag", table["mag"].cast(pa.float32())))
    with pytest.raises(SchemaError, match=r"Npix=.*mag: found float; a star table has double"):
        matched(store)
    changed(part, lambda _: whole.set_column(3, "ra_deg", pa.array([np.nan] * len(whole))))
    with pytest.raises(SchemaError, match=r"ra_deg: found \d+ rows without a value"):
        matched(store)
    blank = pa.array([None] * len(whole), pa.int64())
    changed(part, lambda _: whole.set_column(10, "_healpix_29", blank))
    with pytest.raises(SchemaError, match=r"_healpix_29: found \d+ rows without a value"):
        matched(store)
    elsewhere = pa.array([12 * 4**29 - 1] * len(whole))
    changed(part, lambda _: whole.set_column(10, "_healpix_29", elsewhere))
    with pytest.raises(ProductError, match=r"has stars that are not in pixel \d+ of order"):
        matched(store)
    part.write_bytes(b"PAR1 and nothing else PAR1")
    with pytest.raises(ParseError, match=r"Npix=.*cannot be read as Parquet.*store is damaged"):
        matched(store)
    for path in store.rglob("Npix=*.parquet"):
        pq.write_table(whole.drop_columns(["band", "mag"]), path)
    with pytest.raises(SchemaError, match="no column mag, band; give a catalog store"):
        matched(store)
    properties = store / "hats.properties"
    properties.write_text("hats_col_healpix_order=19\n")
    with pytest.raises(ProductError, match="hats_col_healpix_order is 19; expected"):
        matched(store)
    # Nothing is left of what failed.
    assert sorted(path.name for path in store.parent.iterdir()) == before


def test_partitions_that_overlap_are_found(store):
    pixels = [Pixel(0, number) for number in range(12)]
    table = pa.concat_tables(pq.ParquetFile(path).read() for path in store.rglob("Npix=*.parquet"))
    inner = next(pixel for pixel in pixels if _within(table, pixel).num_rows)
    rows = _within(table, inner)
    smaller = Pixel(1, int(rows["_healpix_29"][0].as_py() >> 2 * (MAX_ORDER - 1)))
    folder = store.parent / "twice"
    for pixel in (inner, smaller):
        path = folder / "dataset" / pixel.path
        path.parent.mkdir(parents=True)
        pq.write_table(_within(table, pixel), path)
    write_facts(folder, (inner, smaller), len(rows))
    with pytest.raises(ProductError, match=r"partitions Norder=0/.* and Norder=1/.* overlap"):
        matched(folder)


def _within(table: pa.Table, pixel: Pixel) -> pa.Table:
    places = table["_healpix_29"].to_numpy()
    return table.filter(pa.array((places >= pixel.first) & (places < pixel.end)))


def test_a_place_that_cannot_be_written_is_known_first(store):
    with pytest.raises(OutputError, match="Is a directory"):
        match_stores(store, store, store, Crossmatch())
