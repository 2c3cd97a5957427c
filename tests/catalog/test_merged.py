"""Several catalogs as one: one row per star, a reason for every other record, all traced."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from starcat.catalog.ingest import Ingested
from starcat.catalog.source import give_map, known_maps
from starcat.catalog.stars.star_table import rows_of_stars
from starcat.database.diff import diff
from starcat.database.onboard.checking import database_problems
from starcat.database.onboard.image import make_image
from starcat.database.onboard.reading import read_onboard_image, rows_by_number
from starcat.database.products.crossmatch import Crossmatch
from starcat.database.reader import open_database_folder
from starcat.database.verify import check_database
from starcat.errors import BuildError, ConfigError
from starcat.pipeline.build import build
from starcat.pipeline.merging import merged_catalog
from starcat.pipeline.observed import with_observed
from starcat.pipeline.reading import read_all
from starcat.pipeline.rebuild import rebuild
from starcat.pipeline.selection.rules.distrust import Observed, rows_named
from starcat.pipeline.specs.reading import spec_from_dict
from starcat.ship.exchange.onboard import contents_of

STARS = 4000
BRIGHT = 600
AMONG = 0.5 / 3600.0
"""How far, in degrees, the two components of a double are apart."""

_MAP = """name = "{name}"
frame = "ICRS"
epoch = {epoch}
{more}
[columns]
star_id = "number"
ra = {{ value = "ra", unit = "deg" }}
dec = {{ value = "dec", unit = "deg" }}
pm_ra_cosdec = {{ value = "pm_ra", unit = "mas/yr" }}
pm_dec = {{ value = "pm_dec", unit = "mas/yr" }}
[magnitudes]
{magnitudes}
"""


@pytest.fixture(scope="module")
def sky(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    """Write a bright catalog of 1991.25 in V, and a deep one of 2016 in G with colours.

    Star k is number k of one, and number 10,000 + k of the other; the deep one has every star,
    and each tenth of the bright ones is double in it.
    """
    folder = tmp_path_factory.mktemp("sky")
    generator = np.random.default_rng(8)
    unit = generator.normal(size=(STARS, 3))
    dec = np.degrees(np.arcsin(unit[:, 2] / np.linalg.norm(unit, axis=1)))
    ra = np.degrees(np.arctan2(unit[:, 1], unit[:, 0])) % 360.0
    pm_dec = generator.normal(scale=200.0, size=STARS)
    mag = np.sort(generator.uniform(2.0, 7.0, STARS))
    years = 2016.0 - 1991.25
    own = {"ra": ra, "dec": dec, "pm_ra": np.zeros(STARS), "pm_dec": pm_dec}
    bright = {name: column[:BRIGHT] for name, column in own.items()}
    bright |= {"number": np.arange(BRIGHT) + 1, "v": mag[:BRIGHT] + 0.25}
    colour = np.full(STARS, 0.82)
    deep = {**own, "number": np.arange(STARS) + 10_001, "g": mag,
            "bp": mag + 0.33, "rp": mag + 0.33 - colour}  # fmt: skip
    deep["dec"] = np.clip(dec + years * pm_dec / 3600e3, -90.0, 90.0)
    second = {name: column[:BRIGHT:10].copy() for name, column in deep.items()}
    second["number"] += 100_000
    second["dec"] += AMONG * np.where(second["dec"] > 0.0, -1.0, 1.0)
    second["g"] += 1.0
    deep = {name: np.concatenate([deep[name], second[name]]) for name in deep}
    magnitudes = {"bright": 'V = "v"', "deep": 'G = "g"\nBP = "bp"\nRP = "rp"'}
    for name, columns in (("bright", bright), ("deep", deep)):
        pq.write_table(pa.table(columns), folder / f"{name}.parquet")
        epoch = 1991.25 if name == "bright" else 2016.0
        content = _MAP.format(name=name, epoch=epoch, magnitudes=magnitudes[name],
                               more='colour = "BP-RP"' if name == "deep" else "")  # fmt: skip
        (folder / f"{name}.toml").write_text(content)
    with known_maps(()):
        for name in ("bright", "deep"):
            give_map(folder / f"{name}.toml")
        yield {name: folder / f"{name}.parquet" for name in ("bright", "deep")}


@pytest.fixture(scope="module")
def merged(sky: dict[str, Path]) -> Ingested:
    paths = {name: [path] for name, path in sky.items()}
    return merged_catalog(
        read_all(("bright", "deep"), paths, epoch_jyear=2026.0), Crossmatch(), workers=2
    )


def test_there_is_one_row_a_star_and_a_reason_for_every_other_record(merged):
    reasons = merged.rejected_by_reason
    assert merged.rows_read == len(merged.stars) + sum(reasons.values())
    assert sum(reasons.values()) == BRIGHT, "each star of the bright catalog takes one record"
    number = merged.stars["star_id"].to_numpy()
    assert (number[:BRIGHT] == np.arange(BRIGHT) + 1).all()
    is_single = (merged.rejected["star_id"].to_numpy() - 10_001) % 10 != 0
    own = merged.rejected.filter(pa.array(is_single))
    assert set(own["reason"].to_pylist()) == {"counterpart"}
    named = [int(text.split(",")[0].split()[-1]) for text in own["detail"].to_pylist()]
    assert named == (own["star_id"].to_numpy() - 10_000).tolist()
    # The other component of a double stays, so that the selection recognises the double.
    near = np.flatnonzero(merged.stars["nearest_separation_arcsec"].to_numpy() < 1.0)
    assert len(near) == 2 * (BRIGHT // 10)


def test_magnitudes_are_in_the_band_of_the_first_catalog(merged):
    assert merged.stars["band"].unique().to_pylist() == ["V"]
    added = merged.stars.filter(pc.equal(merged.stars["catalog"], "deep"))
    assert added["mag_source"].unique().to_pylist() == ["deep G, BP-RP"]
    assert added["catalog_band"].unique().to_pylist() == ["G"]
    step = added["mag"].to_numpy() - added["catalog_mag"].to_numpy()
    # V - G of a star of BP - RP 0.82 is 0.14 by the relation of Gaia's documentation (EDR3 5.5.1).
    assert np.abs(step - 0.16).max() < 0.08
    assert (added["mag_error"].to_numpy() > 0.0).all()
    own = merged.stars.filter(pc.equal(merged.stars["catalog"], "bright"))
    assert own["mag_source"].null_count == len(own)


def spec_of(**catalog: object) -> object:
    camera = {"width_px": 512, "height_px": 512, "fov_x_deg": 15.0}
    content = {
        "name": "merged", "version": "1.0.0", "epoch_jyear": 2026.0, "catalog": catalog,
        "selection": {"faint_limit_mag": 7.0}, "camera": camera, "boresights": {"count": 400},
        "self_test": {"frames": 5, "min_identified": 0.0},
    }  # fmt: skip
    return spec_from_dict(content, "merged")


@pytest.mark.slow
def test_a_database_of_merged_catalogs_is_traced_and_rebuilt(sky, tmp_path):
    spec = spec_of(source="bright", merged=["deep"])
    inputs = {name: [path] for name, path in sky.items()}
    built = build(spec, tmp_path, inputs=inputs)
    check_database(built.folder)
    facts = {one["source"]: one for one in built.manifest["sources"]}
    assert [one["role"] for one in facts.values()] == ["stars", "stars"]
    assert facts["deep"]["rows_read"] == STARS + BRIGHT // 10
    duplicates = facts["deep"]["rejected"]
    found = duplicates["counterpart"] + duplicates.get("ambiguous_counterpart", 0)
    assert found == BRIGHT
    assert min(one["kept"] for one in facts.values()) > 0
    assert rebuild(built.folder, inputs).is_identical


@pytest.mark.parametrize(
    ("merged", "camera", "words"),
    [
        ("gaia", {}, "merged: gaia is the catalog of the stars themselves"),
        ("a/b", {}, "merged"),
        ("hipparcos", {"response": {"name": "silicon"}}, "response"),
    ],
)
def test_what_cannot_be_merged_is_refused(merged, camera, words):
    content = spec_of(source="gaia").recorded()
    content["catalog"] = {"source": "gaia", "merged": [merged]}
    content["camera"] |= camera
    with pytest.raises(ConfigError, match=words):
        spec_from_dict(content, "merged")


def merged_pairs(folder: Path, first: str) -> Ingested:
    """Merge a catalog that has one record per pair with one that has each star.

    The pairs: 1 is a double whose stars one catalog does not resolve; 2 has a companion 4.7 mag
    fainter, of which the other catalog has only the companion; 3 is a wide pair that both have; 4
    has a faint neighbour that is no part of its light; the other stars are single.
    """
    generator = np.random.default_rng(3)
    ra, dec = np.arange(300) * 1.1, generator.uniform(-60.0, 60.0, 300)
    v = generator.uniform(4.0, 6.0, 300)
    one = {"number": np.arange(300), "ra": ra, "dec": dec, "v": v.copy()}
    each = {"number": np.arange(300) + 50_000, "ra": ra, "dec": dec + 2e-6, "v": v.copy()}
    one["v"][1:5], each["v"][1:5] = (4.0, 2.6, 5.0, 5.0), (4.6, 7.3, 5.0, 5.0)
    each["dec"][2] += 4.2 / 3600.0
    more = {"number": [60_001, 60_003, 60_004], "ra": ra[[1, 3, 4]], "v": [4.93, 5.5, 10.0]}
    more["dec"] = dec[[1, 3, 4]] + np.array([1.0, 8.0, 8.0]) / 3600.0
    one_too = {"number": [1003], "ra": ra[[3]], "dec": more["dec"][[1]], "v": [5.5]}
    tables = {"one": (one, one_too), "each": (each, more)}
    paths = {}
    for name, parts in tables.items():
        columns = {key: np.concatenate([part[key] for part in parts]) for key in one}
        columns |= dict.fromkeys(("pm_ra", "pm_dec"), np.zeros(len(columns["ra"])))
        pq.write_table(pa.table(columns), folder / f"{name}.parquet")
        (folder / f"{name}.toml").write_text(
            _MAP.format(name=name, epoch=2016.0, more="", magnitudes='V = "v"')
        )
        give_map(folder / f"{name}.toml")
        paths[name] = [folder / f"{name}.parquet"]
    names = ("one", "each") if first == "one" else ("each", "one")
    return merged_catalog(read_all(names, paths), Crossmatch(), workers=2)


@pytest.mark.parametrize("first", ["one", "each"])
def test_light_is_counted_once_and_companions_stay(tmp_path, first):
    with known_maps(()):
        merged = merged_pairs(tmp_path, first)
    stars = {row["star_id"]: row for row in merged.stars.to_pylist()}
    pair = {1, 50_001, 60_001} & set(stars)
    assert pair == ({1} if first == "one" else {50_001, 60_001})
    # The brighter star and the companion: neither is the other's counterpart.
    assert {2, 50_002} <= set(stars)
    assert all(stars[number]["is_flagged_double"] for number in (2, 50_002))
    assert all("=companion" in stars[number]["double_flag"] for number in (2, 50_002))
    wide = {3, 1003, 50_003, 60_003} & set(stars)
    assert wide == ({3, 1003} if first == "one" else {50_003, 60_003})
    assert 60_004 in stars
    reasons = {row["star_id"]: row for row in merged.rejected.to_pylist()}
    if first == "one":
        assert "whose light includes it" in reasons[60_001]["detail"]
        assert stars[1]["double_flag"] == "each=combined"
    light = sum(10.0 ** (-0.4 * row["mag"]) for row in stars.values())
    with known_maps(()):
        other = merged_pairs(tmp_path, "each" if first == "one" else "one").stars
    its_light = sum(10.0 ** (-0.4 * mag) for mag in other["mag"].to_pylist())
    assert light == pytest.approx(its_light, rel=2e-4)


@pytest.fixture
def twins(sky: dict[str, Path]) -> dict[str, list[Path]]:
    """The bright catalog, and another one with the same numbers for stars 0.2 deg away."""
    bright, twin = (sky["bright"].with_name(f"{name}.toml") for name in ("bright", "twin"))
    twin.write_text(bright.read_text().replace('"bright"', '"twin"'))
    shifted = pq.read_table(sky["bright"])
    shifted = shifted.set_column(0, "ra", pc.add(shifted["ra"], 0.2))
    shifted = shifted.set_column(shifted.column_names.index("v"), "v", pc.add(shifted["v"], 0.1))
    pq.write_table(shifted, twin.with_suffix(".parquet"))
    for each in (bright, twin):
        give_map(each)
    return {"bright": [sky["bright"]], "twin": [twin.with_suffix(".parquet")]}


def test_a_star_is_identified_by_its_catalog_and_number(twins):
    read = read_all(("bright", "twin"), twins)
    merged = merged_catalog(read, Crossmatch(), workers=2)
    apart = [pq.read_table(paths[0])["ra"].to_numpy() for paths in twins.values()]
    both = merged.stars.to_pylist()
    assert [(row["star_id"], row["catalog"]) for row in both[:4]] == [
        (1, "bright"), (1, "twin"), (2, "bright"), (2, "twin"),
    ]  # fmt: skip
    for number, name in enumerate(("bright", "twin")):
        own = merged.stars.filter(pc.equal(merged.stars["catalog"], name))
        rows = rows_of_stars(own, merged.stars)
        assert merged.stars.take(pa.array(rows)).equals(own)
        place = dict(zip(own["star_id"].to_pylist(), own["ra_deg"].to_pylist(), strict=True))
        assert place[7] == pytest.approx(apart[number][6] % 360.0)


def test_a_listed_number_of_two_catalogs_needs_its_catalog(twins):
    merged = merged_catalog(read_all(("bright", "twin"), twins), Crossmatch(), workers=2)
    with pytest.raises(BuildError, match=r'5 is a star_id of 2 .* "bright 5" or "twin 5"'):
        with_observed(merged.stars, Observed(reject=(5,)))
    listed = Observed(reject=("twin 5",))
    with_observed(merged.stars, listed)
    [row] = rows_named(merged.stars, listed.reject)["twin 5"]
    assert merged.stars.slice(row, 1)["catalog"].to_pylist() == ["twin"]
    with pytest.raises(BuildError, match="deep 5: 1 of 1 are not a star_id"):
        with_observed(merged.stars, Observed(reject=("deep 5",)))


@pytest.mark.slow
def test_a_database_of_stars_with_equal_numbers(twins, tmp_path):
    """Products, checks, comparison, SQL, image and patch keep the two apart."""
    spec = spec_of(source="bright", merged=["twin"])
    built = build(spec, tmp_path, inputs=twins)
    check_database(built.folder)
    database = open_database_folder(built.folder)
    stars = database.table("stars")
    numbers = stars["star_id"].to_numpy()
    assert (numbers[1:] == numbers[:-1]).sum() > 100
    assert diff(database, database).paired_by_number == len(stars)
    contents = contents_of(database, "triangle")
    image = read_onboard_image(make_image(contents).data)
    assert list(database_problems(image, contents)) == []
    rows = rows_by_number(image.star_id, image.directions, contents.star_id, contents.directions)
    assert sorted(rows.tolist()) == list(range(len(stars)))


@pytest.mark.slow
def test_hipparcos_stars_are_found_in_tycho_2_by_their_own_numbers(starcat, excerpts, tmp_path):
    """Through the command: Tycho-2 names the HIP number of most of its bright stars itself."""
    output = tmp_path / "both.parquet"
    run = starcat(["ingest", "hipparcos", "--merge", "tycho2", "--band", "V",
                   "--read-limit-mag", "6.5", "--epoch-jyear", "2016", "-o", output,
                   "--input", f"hipparcos={excerpts / 'hip_main.dat.gz'}",
                   "--input", f"tycho2={excerpts / 'tyc2.dat.gz'}"])  # fmt: skip
    assert run.code == 0, run.err
    rejected = pq.read_table(tmp_path / "both.rejected.parquet")
    found = rejected.filter(pc.equal(rejected["reason"], "counterpart"))
    known = found.filter(pc.is_valid(found["hip_number"]))
    named = [text.split(",")[0] for text in known["detail"].to_pylist()]
    assert len(known) > 8000
    assert named == [f"HIP {number}" for number in known["hip_number"].to_pylist()]


def test_several_catalogs_become_no_store(starcat, tmp_path):
    run = starcat(["ingest", "hipparcos", "--merge", "tycho2", "--to", "hats",
                   "-o", tmp_path / "x"])  # fmt: skip
    assert run.code == 2
    assert "several catalogs become one Parquet file" in run.err
