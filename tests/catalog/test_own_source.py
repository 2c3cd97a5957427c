"""Tables of the user: nine formats, names, units and frames by maps alone; refused maps."""

from __future__ import annotations

import hashlib
import json
import tomllib
from decimal import Decimal
from pathlib import Path

import jsonschema
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from own_tables import CASES, COUNT, NO_MAG, NO_MOTION, Case, Sky, make_sky

from starcat.catalog import source
from starcat.catalog.archives.mapped import identity
from starcat.catalog.ingest import Ingested, ingest_catalog
from starcat.catalog.readers import tables
from starcat.catalog.source_files import locate
from starcat.catalog.stars.star_table import floats_of
from starcat.catalog.store.ingest import ingest_to_store
from starcat.catalog.store.reading import read_catalog
from starcat.catalog.table_check import check_map
from starcat.catalog.table_draft import draft_map
from starcat.errors import ConfigError, SourceError, SourceMissing
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.pipeline.build import build
from starcat.pipeline.rebuild import rebuild
from starcat.pipeline.specs.reading import preset
from starcat.resources import resource_folder
from starcat.results import to_dict

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def sky() -> Sky:
    return make_sky()


@pytest.fixture(scope="module", params=CASES, ids=[case.name for case in CASES])
def case(request: pytest.FixtureRequest) -> Case:
    return request.param


def read_case(case: Case, sky: Sky, folder: Path) -> Ingested:
    """Read the table of a case with its map."""
    name = "gaia_dr3_hats"
    if case.toml:
        (folder / "map.toml").write_text(case.toml)
        name = source.give_map(folder / "map.toml").name
    return read_catalog(name, [case.make(sky, folder)], neighbours=False)


@pytest.fixture(scope="module")
def read(case: Case, sky: Sky, tmp_path_factory: pytest.TempPathFactory) -> Ingested:
    with source.known_maps([]):
        return read_case(case, sky, tmp_path_factory.mktemp(case.name))


@pytest.fixture(scope="module")
def order(sky: Sky, read: Ingested) -> np.ndarray:
    """Row of the sky of each star that was read."""
    first = {int(one): n for n, one in reversed(list(enumerate(sky.ids)))}
    known = dict(first.items())
    known |= {identity(f"P{key}"): n for key, n in first.items()}
    known |= {identity(f"SURVEY J{key}+12"): n for key, n in first.items()}
    return np.array([known[one] for one in read.stars["star_id"].to_pylist()])


class TestEveryFormat:
    """The same stars from tables of all formats, names, units and frames."""

    def test_every_row_is_kept_or_rejected(self, case: Case, read: Ingested):
        lacking = {} if case.name == "hats" else {"no_position": 1}
        assert read.rejected_by_reason == {**lacking, "duplicate_record": 1}
        assert read.rows_read == COUNT == len(read.stars) + len(read.rejected)
        assert not read.problems

    def test_positions(self, case: Case, sky: Sky, read: Ingested, order: np.ndarray):
        ra, dec, _, _ = sky.at(case.epoch_jyear)
        found = directions_from_radec(
            floats_of(read.stars, "ra_deg"), floats_of(read.stars, "dec_deg")
        )
        apart = np.degrees(separation(found, directions_from_radec(ra, dec)[order])) * 3600.0
        assert apart.max() < case.arcsec
        np.testing.assert_allclose(
            floats_of(read.stars, "epoch_jyear"), case.epoch_jyear, atol=1e-9
        )

    def test_motions(self, case: Case, sky: Sky, read: Ingested, order: np.ndarray):
        _, _, pm_ra, pm_dec = sky.at(case.epoch_jyear)
        found = [floats_of(read.stars, f"pm_{axis}_mas_yr") for axis in ("ra_cosdec", "dec")]
        unknown = np.isnan(found[0])
        assert set(order[unknown]) == (({NO_MOTION}) if case.has_motion else set(order))
        for values, expected in zip(found, (pm_ra, pm_dec), strict=True):
            np.testing.assert_allclose(
                values[~unknown], expected[order][~unknown], atol=case.mas_yr
            )

    def test_magnitudes(self, read: Ingested, sky: Sky, order: np.ndarray):
        mag = floats_of(read.stars, "mag")
        assert set(order[np.isnan(mag)]) == {NO_MAG}
        known = ~np.isnan(mag)
        np.testing.assert_allclose(mag[known], sky.v[order][known], atol=6e-4)

    def test_flags(self, case: Case, read: Ingested, sky: Sky, order: np.ndarray):
        for kind, expected in (("double", sky.is_double), ("variable", sky.is_variable)):
            found = read.stars[f"is_flagged_{kind}"].to_numpy()
            wanted = f"{kind} =" in case.toml or case.name == "hats"
            assert (found == (expected[order] if wanted else False)).all()
            assert (pc.is_valid(read.stars[f"{kind}_flag"]).to_numpy() == found).all()


def test_drafts_get_the_columns_right(sky: Sky, tmp_path: Path):
    right = total = 0
    for case in CASES:
        (tmp_path / case.name).mkdir()
        draft = draft_map(case.make(sky, tmp_path / case.name))
        content = tomllib.loads(draft.as_toml())
        assert source.mapped({"epoch": 2000.0, **content}).table is not None
        hits = sum(draft.used.get(column) == key for column, key in case.meant.items())
        assert hits >= 0.8 * len(case.meant), case.name
        right, total = right + hits, total + len(case.meant)
    assert right >= 0.95 * total


TABLE = "id,ra,dec,pmra,pmdec,v,flag\n" + "".join(
    f"{n},{n}.5,{n / 4},1.0,2.0,{n / 10 + 3},{'D' if n % 2 else ''}\n" for n in range(1, 31)
)
MAP = """name = "mine"
epoch = 2000.0
[columns]
star_id = "id"
ra = "ra"
dec = "dec"
pm_ra_cosdec = { value = "pmra", unit = "mas/yr" }
pm_dec = { value = "pmdec", unit = "mas/yr" }
[magnitudes]
V = "v"
[flags]
double = "flag = 'D'"
"""
EDITS_OF_MAP = (
    ('name = "mine"', "name = mine", "mine.toml: not a readable TOML file: Invalid value (at "),
    ('name = "mine"\n', "", "mine.toml: name: missing; every map needs it"),
    ('"mine"', '"sao"', "name: sao is a source of starcat; choose another name"),
    ("2000.0", '"2000-13-45"', "epoch: '2000-13-45' is not a date; write it like 2016-01-01"),
    ("epoch", 'frame = "B1950"\nepoch', "frame: found 'B1950'; expected 'ICRS', 'FK5', 'FK4'"),
    ("epoch", 'frame = "FK5"\nequinox = "1975"\nepoch', "equinox: '1975' is not like J2000 or"),
    ("epoch", 'colour = "B-V"\nepoch', "colour: 'B-V' is not two of the bands V"),
    ('ra = "ra"\n', "", "mine.toml: columns.ra: missing; every map needs it"),
    ('V = "v"\n', "", "mine.toml: magnitudes: "),
    ('pm_dec = { value = "pmdec", unit = "mas/yr" }\n', "", "motion has two parts; give both"),
    ('"pmra", unit = "mas/yr"', '"pmra", unit = "mas per yr"', "'mas per yr' is no unit of"),
    ('"pmra", unit = "mas/yr"', '"pmra", unit = "mag"', "unit 'mag' (of the map) cannot be"),
    ('"pmra", unit = "mas/yr"', '"pmra", unit = "arcsec/cyr"', "write a century as hyr, such as"),
    ('"pmra", unit = "mas/yr"', '"pmra", unit = "arcsec/(100 yr)"', "and a century as hyr"),
    ('"v"', '"random()"', "there is no function random; did you mean 'round'?"),
    ('"v"', '"v); DROP TABLE x; SELECT (1"', "an expression: it is more than one"),
    ('"v"', '"flag + 1"', "magnitudes.V: 'flag + 1' cannot be computed: Binder Error"),
    ('"v"', '"upper(flag)"', "magnitudes.V: 'upper(flag)' gives string; expected numbers"),
    ("flag = 'D'", "flag", "flags.double: 'flag' gives texts; write a condition, such as flag = "),
    ("flag = 'D'", 'flag = \\"D\\"', "texts in single ones"),
    ("[flags]", '[quality]\nbad = "v > 3"\n[flags]', "quality.bad: no such one; choose of "),
)
EDITS_OF_TABLE = (
    (TABLE, "", "the file is empty; expected a table of stars"),
    (TABLE, TABLE.splitlines()[0], "the table (text) has no row; expected stars"),
    (TABLE.splitlines()[0] + "\n", "", "the first line has no names of columns but '1, 1.5"),
    ("pmra,pmdec", "pmra,pmra", "two columns are called 'pmra'; rename one of each"),
    (",1.0,2.0,", ",", "row 1, fields: found 5; expected 7"),
    (".5,", "x,", "row 1, columns.ra: found '1x'; expected a number"),
    (TABLE, "PAR1" + TABLE, "not a table that can be read (Parquet magic bytes not found in"),
    (TABLE, "SIMPLE  =   T" + TABLE, "not a table that can be read ("),
    (TABLE, "<?xml version='1.0'?><html></html>", "does not appear to be a VOTABLE"),
    (TABLE, "ARROW1\0\0" + TABLE, "not a table that can be read ("),
    ("D", "\udce9", "is not utf-8; if it is a text, state its 'encoding' in the map"),
    ("id,", "# %ECSV 1.0\n# ---\n# datatype: [\nid,", "its header in YAML is damaged"),
)


def read_own(folder: Path, table_map: str = MAP, table: str = TABLE) -> Ingested:
    (folder / "mine.toml").write_text(table_map)
    (folder / "t.csv").write_bytes(table.encode("utf-8", "surrogateescape"))
    name = source.give_map(folder / "mine.toml").name
    return read_catalog(name, [folder / "t.csv"], neighbours=False)


@pytest.mark.parametrize(("old", "new", "told"), EDITS_OF_MAP)
def test_a_wrong_map_is_refused_with_its_key(tmp_path, old, new, told):
    assert old in MAP
    with pytest.raises(ConfigError) as caught:
        read_own(tmp_path, MAP.replace(old, new, 1))
    assert told in str(caught.value)


def test_the_unit_of_a_century_is_hyr(tmp_path):
    read = read_own(tmp_path, MAP.replace('"pmra", unit = "mas/yr"', '"pmra", unit = "arcsec/hyr"'))
    assert read.stars["pm_ra_cosdec_mas_yr"][0].as_py() == pytest.approx(10.0)


def test_a_hundredth_of_a_year_in_the_header_of_a_table_is_refused(tmp_path):
    (tmp_path / "mine.toml").write_text(MAP.replace(', unit = "mas/yr"', ""))
    made = Table.read(TABLE, format="ascii.csv")
    made["pmra"].unit = made["pmdec"].unit = "arcsec/cyr"
    made.write(tmp_path / "t.ecsv")
    with pytest.raises(ConfigError, match=r"t\.ecsv\) is refused: .* write a century as hyr"):
        read_catalog(source.give_map(tmp_path / "mine.toml").name, [tmp_path / "t.ecsv"])


@pytest.mark.parametrize(("factor", "code"), [(1, 0), (1_000_000, 1)])
def test_a_table_that_is_mostly_rejected_is_not_understood(starcat, tmp_path, factor, code):
    (tmp_path / "mine.toml").write_text(MAP.replace('"pmra"', f'"pmra * {factor}"'))
    (tmp_path / "t.csv").write_text(TABLE)
    with source.known_maps([]):
        ran = starcat(["sources", tmp_path / "t.csv", "--check", tmp_path / "mine.toml"])
    assert ran.code == code
    assert ("mine: understood" in ran.err + ran.out) == (code == 0)
    refusal = "30 of 30 rows are rejected, most of them as impossible_value; check the units"
    assert (refusal in ran.err + ran.out) == (code == 1)


@pytest.mark.parametrize(("old", "new", "told"), EDITS_OF_TABLE, ids=range(len(EDITS_OF_TABLE)))
def test_a_wrong_table_is_refused_with_its_place(tmp_path, old, new, told):
    assert old in TABLE
    with pytest.raises(SourceError) as caught:
        read_own(tmp_path, table=TABLE.replace(old, new))
    assert told in str(caught.value)
    assert str(tmp_path / "t.csv") in str(caught.value)


def test_a_bad_row_is_rejected_with_its_number_and_reason(tmp_path: Path):
    lines = TABLE.splitlines()
    lines[2] += ",one more"
    lines[3] = lines[3].replace("3.5", "three")
    lines[4] = lines[4].replace("4,", ",", 1)
    lines[5] = lines[5].replace("5.5", "")
    lines[6] = lines[6].replace(",1.5,", ",91.5,")
    lines[8] = lines[7]
    read = read_own(tmp_path, table="\n".join(["# a comment", *lines]) + "\n")
    found = {row["source_line"]: row["reason"] for row in read.rejected.to_pylist()}
    assert found == {
        2: "malformed_record", 3: "malformed_record", 4: "no_identity", 5: "no_position",
        6: "impossible_value", 8: "duplicate_record",
    }  # fmt: skip
    assert read.problems == (
        "t.csv row 2, fields: found 8; expected 7",
        "t.csv row 3, columns.ra: found 'three'; expected a number",
    )


@pytest.mark.slow
def test_the_size_of_blocks_leaves_no_trace(case, sky, read, tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "BLOCK_ROWS", 7)
    monkeypatch.setattr(tables, "BLOCK_BYTES", 2000)
    parts = read_case(case, sky, tmp_path)
    assert parts.stars.equals(read.stars)
    assert parts.rejected.equals(read.rejected)


class TestNames:
    """One function finds a source by its name, wherever its map is."""

    @pytest.fixture
    def mine(self, tmp_path, monkeypatch):
        """A map in the folder of the user."""
        assert "mine" not in source.source_names()
        (tmp_path / "mine.toml").write_text(MAP)
        monkeypatch.setenv("STARCAT_SOURCES", str(tmp_path))

    @pytest.mark.usefixtures("mine")
    def test_maps_in_a_folder_are_known_by_the_names_of_their_files(self, tmp_path):
        assert "mine" in source.source_names()
        assert source.data_source("mine").bands == ("V",)
        (tmp_path / "other.toml").write_text(MAP)
        with pytest.raises(ConfigError, match=r"rename it to mine\.toml"):
            source.data_source("other")
        assert {"mine", "sao"} <= set(source.star_sources())
        assert "other" not in source.star_sources()

    @pytest.mark.usefixtures("mine")
    def test_a_map_of_a_manifest_comes_before_those_of_the_folder(self):
        recorded = source.map_of("mine")
        assert recorded == source.mapped(recorded).table.recorded()
        two = source.mapped({**recorded, "magnitudes": {"V": "v", "B": "v"}, "bands": ["V", "B"]})
        again = json.loads(json.dumps(two.table.recorded(), sort_keys=True))
        assert source.mapped(again).bands == ("V", "B")
        with source.known_maps([{**recorded, "epoch": 1990.0}]):
            assert source.data_source("mine").epoch_jyear == 1990.0
        assert source.data_source("mine").epoch_jyear == 2000.0

    def test_an_unknown_name_says_how_a_table_becomes_a_source(self):
        with pytest.raises(ConfigError, match=r"source=MAP\.toml"):
            source.data_source("mine")


def test_each_row_may_have_its_own_julian_year(tmp_path: Path):
    own = MAP.replace("epoch = 2000.0", 'epoch = { value = "2000 + id", scale = "jyear" }')
    stars = read_own(tmp_path, own).stars
    assert stars["epoch_jyear"].to_pylist() == [2000.0 + n for n in range(1, 31)]


def test_check_says_units_ranges_and_what_is_missing(tmp_path: Path):
    (tmp_path / "mine.toml").write_text(MAP)
    (tmp_path / "t.csv").write_text(TABLE.replace("30,30.5,", "30,,"))
    found = to_dict(check_map(source.give_map(tmp_path / "mine.toml"), tmp_path / "t.csv"))
    values = {one["key"]: one for one in found["values"]}
    assert (values["columns.ra"]["least"], values["columns.ra"]["missing"]) == (1.5, 1)
    assert values["columns.pm_dec"]["unit"] == "mas/yr"
    assert values["flags.double"]["true"] == 15
    assert [row["row"] for row in found["first_rows"]] == [1, 2, 3, 4, 5]
    assert found["rejected"] == {"no_position": 1}
    assert found["unused_columns"] == []


@pytest.mark.parametrize(
    ("more", "files"),
    [
        ("", "mine.csv, mine.tsv, mine.ecsv, mine.fits, .* or mine.feather"),
        ('file_names = ["my stars.csv"]\n', "my stars.csv"),
    ],
)
def test_a_table_that_is_not_found_is_named_as_it_is_searched(tmp_path, monkeypatch, more, files):
    monkeypatch.setenv("STARCAT_CATALOGS", str(tmp_path))
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path))
    with (
        source.known_maps([tomllib.loads(more + MAP)]),
        pytest.raises(SourceMissing, match=rf"set \$STARCAT_CATALOGS to .* that has {files}$"),
    ):
        locate("mine", {})


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_database_of_an_own_table_is_built_again_from_its_manifest(tmp_path, monkeypatch):
    """From a file and from a store made of it: the same database, and again from the manifest."""
    monkeypatch.chdir(tmp_path)
    stars = ingest_catalog("gaia", locate("gaia", {}), read_limit_mag=6.2, neighbours=False).stars
    table = stars.select(["star_id", "designation", "ra_deg", "dec_deg", "mag"])
    pq.write_table(table.rename_columns(["no", "who", "alpha", "delta", "g"]), "bright.parquet")
    Path("bright.toml").write_text(
        'name = "bright"\nepoch = 2016.0\n[columns]\nstar_id = "no"\ndesignation = "who"\n'
        'ra = "alpha"\ndec = "delta"\n[magnitudes]\nG = "g"\n'
    )
    changes = {"selection.faint_limit_mag": "5.5", "catalog.source": "bright", "name": "own"}
    spec = preset("gaia-12deg", changes)
    source.give_map(Path("bright.toml"))
    built = build(spec, Path("dist"), inputs={"bright": [Path("bright.parquet")]})
    ingest_to_store("bright", [Path("bright.parquet")], Path("store"))
    again = build(spec, Path("again"), inputs={"bright": [Path("store")]})
    assert built.manifest["manifest_version"] == "1.0.0"
    schema = json.loads((resource_folder("schemas") / "manifest-1.0.0.json").read_text())
    jsonschema.validate(built.manifest, schema)
    assert again.manifest["products"] == built.manifest["products"]
    rebuilt = rebuild(built.folder, {"bright": [Path("bright.parquet")]})
    assert rebuilt.is_identical


IDS = (5, 4260750323735821843, 9000000000000000001, 2**63, 2**64 - 1)
LARGER = {text: int(hashlib.sha256(text.encode()).hexdigest()[:16], 16) >> 2
          for text in map(str, IDS[3:])}  # fmt: skip


def read_short(folder: Path, path: Path, more: str = "") -> Ingested:
    """Read a table without motions and flags, with a map of its columns."""
    short = MAP.split("pm_ra_cosdec")[0] + f'[magnitudes]\nV = "v"\n{more}'
    (folder / "mine.toml").write_text(short)
    return read_catalog(source.give_map(folder / "mine.toml").name, [path], neighbours=False)


def identified(folder: Path, form: str, ids: tuple[int, ...]) -> Path:
    """Write stars with identifiers in a format of tables."""
    dtype = np.uint64 if max(ids) >= 2**63 else np.int64
    columns = {"id": np.array(ids, dtype), "ra": np.arange(1.0, len(ids) + 1), "dec": 1.0, "v": 5.0}
    path = folder / f"t.{form}"
    table = Table({name: np.broadcast_to(one, len(ids)) for name, one in columns.items()})
    if form == "parquet":
        pq.write_table(pa.table({name: np.array(table[name]) for name in columns}), path)
    else:
        table.write(path, format={"csv": "ascii.csv", "vot": "votable"}.get(form, form))
    return path


@pytest.mark.parametrize("form", ["csv", "parquet", "fits", "vot"])
@pytest.mark.parametrize("count", [3, 5])
def test_a_number_of_64_bits_is_the_same_star_in_every_format(tmp_path, form, count):
    if (form, count) == ("vot", 5):
        pytest.skip("VOTable has no unsigned numbers of 64 bits")
    read = read_short(tmp_path, identified(tmp_path, form, IDS[:count]))
    stars = zip(*(read.stars[name].to_pylist() for name in ("star_id", "designation")), strict=True)
    assert dict(stars) == {LARGER.get(str(one), one): f"mine {one}" for one in IDS[:count]}


def test_null_values_of_fits_are_compared_as_they_are_stored(tmp_path: Path):
    ids, ra, v = [1, 2, 3], [10.0, 20.0, 30.0], [5000, -32768, 7000]
    columns = [
        fits.Column("id", "K", array=ids), fits.Column("ra", "D", array=ra),
        fits.Column("dec", "D", array=ra), fits.Column("v", "I", array=v),
        fits.Column("w", "I", array=np.array([5, 65535, 7], np.uint16), bzero=32768, null=32767),
    ]  # fmt: skip
    binary = fits.BinTableHDU.from_columns(columns)
    binary.header.update({"TSCAL4": 0.001, "TNULL4": -32768})
    binary.writeto(tmp_path / "binary.fits")
    columns[3:] = [fits.Column(c, "F7.3", array=[5, -9, 7], null="-9.000") for c in "vw"]
    columns[0] = fits.Column("id", "I5", array=ids)
    columns[1:3] = [fits.Column(c, "F7.3", array=ra) for c in ("ra", "dec")]
    fits.TableHDU.from_columns(columns).writeto(tmp_path / "text.fits")
    for form in ("binary", "text"):
        read = read_short(tmp_path, tmp_path / f"{form}.fits", 'W = "w"\n')
        assert read.stars["mag"].to_pylist() == [5.0, None, 7.0]
        assert read.stars["second_mag"].to_pylist() == [5.0, None, 7.0]


def readings(tmp_path: Path, table: str, form: str = "csv", more: str = "") -> Ingested:
    """Read a table of the columns id, ra, dec and v with the plainest map."""
    (tmp_path / f"mine.{form}").write_text(table)
    (tmp_path / "mine.toml").write_text(
        f'name = "mine"\nepoch = 2000.0\n{more}[columns]\nstar_id = "id"\nra = "ra"\ndec = "dec"\n'
        '[magnitudes]\nV = "v"\n'
    )
    name = source.give_map(tmp_path / "mine.toml").name
    return ingest_catalog(name, [tmp_path / f"mine.{form}"], neighbours=False)


def test_rounded_seconds_and_typeset_minus_signs_are_read(tmp_path: Path):
    read = readings(
        tmp_path,
        "id,ra,dec,v\n1,12:00:60.0,+10:00:00,\u22121.46\n2,10:00:00,\u221212:59:60,4\n"
        "3,00 59 60,\u201300 30 00,4\n4,10:00:00,+12:60:00,4\n5,10:00:60.5,+12:00:00,4\n"
        "6,10:61:00,+12:00:00,4\n",
    )
    assert read.stars["ra_deg"].to_pylist() == pytest.approx([180.25, 150.0, 15.0])
    assert read.stars["dec_deg"].to_pylist() == pytest.approx([10.0, -13.0, -0.5])
    assert read.stars["mag"].to_pylist() == [-1.46, 4.0, 4.0]
    assert [one.split(":")[0] for one in read.problems] == [
        f"mine.csv row {row}, columns.{key}" for row, key in ((4, "dec"), (5, "ra"), (6, "ra"))
    ]
    decimal = readings(tmp_path, "id,ra,dec,v\n1,10.5,\u221212.25,4\n2,11.5,1.5,4\n")
    assert decimal.stars["dec_deg"].to_pylist() == [-12.25, 1.5]


def test_dashes_and_the_nulls_of_a_map_mean_no_value(tmp_path: Path):
    values = ["3.0", "---", "-", "-----", "99.999", "", "-9.9900", "NULL"]
    table = "id,ra,dec,v\n" + "".join(f"{n},1{n}.5,20.5,{v}\n" for n, v in enumerate(values, 1))
    nothing = readings(tmp_path, table)
    assert nothing.stars["mag"].to_pylist() == [3.0, None, None, None, 99.999, None, -9.99, None]
    nulls = readings(tmp_path, table, more="null = [99.999, -9.99]\n")
    assert nulls.stars["mag"].to_pylist() == [3.0] + [None] * 7
    assert not nothing.problems
    assert not nulls.problems


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_null_numbers_of_four_bytes_are_the_nearest_ones(tmp_path: Path, kind: type):
    table = {"id": [1, 2], "ra": [1.0, 2.0], "dec": [3.0, 4.0]}
    Table({**table, "v": np.array([99.999, 5.5], kind)}).write(tmp_path / "a.fits")
    (tmp_path / "mine.toml").write_text(
        'name = "mine"\nepoch = 2000.0\nnull = [99.999]\n[columns]\nstar_id = "id"\nra = "ra"\n'
        'dec = "dec"\n[magnitudes]\nV = "v"\n'
    )
    name = source.give_map(tmp_path / "mine.toml").name
    assert ingest_catalog(name, [tmp_path / "a.fits"]).stars["mag"].to_pylist() == [None, 5.5]


@pytest.mark.parametrize("signs", [["-", "-"], ["", "-"], ["-", "+"]])
def test_a_single_dash_is_a_sign_in_an_expression(tmp_path: Path, signs: list[str]):
    rows = "".join(f"{n},10.5,{sign},30,4.0\n" for n, sign in enumerate(signs, 1))
    (tmp_path / "mine.csv").write_text(f"id,ra,DE-,DEd,v\n{rows}")
    (tmp_path / "mine.toml").write_text(
        'name = "mine"\nepoch = 2000.0\n[columns]\nstar_id = "id"\nra = "ra"\n'
        """dec = '''CASE WHEN "DE-" = '-' THEN -1 ELSE 1 END * DEd'''\n"""
        '[magnitudes]\nV = "v"\n'
    )
    read = ingest_catalog(source.give_map(tmp_path / "mine.toml").name, [tmp_path / "mine.csv"])
    expected = [-30.0 if sign == "-" else 30.0 for sign in signs]
    assert read.stars["dec_deg"].to_pylist() == pytest.approx(expected)


ROUNDED = [5853498713190525696, 4472832130942575872, 762815470562110464]


@pytest.mark.parametrize("form", ["csv", "text.fits", "fits", "float.fits", "vot", "parquet"])
def test_rounded_identifiers_are_refused(tmp_path: Path, form: str):
    ids: object = np.array(ROUNDED, np.float64)
    if form in ("csv", "text.fits"):
        ids = ["5.853498713190526e+18", "4472832130942576000.0", "7.62815470562110464E17"]
    elif form == "float.fits":
        ids = np.array([33554434, 33554436, 67108868], np.float32)
    columns = {"id": ids, "ra": [1.0, 2.0, 3.0], "dec": [4.0, 5.0, 6.0], "v": [7.0, 8.0, 9.0]}
    path = tmp_path / f"mine.{form}"
    if form == "parquet":
        pq.write_table(pa.table(columns), path)
    else:
        Table(columns).write(path, **({"format": "votable"} if form == "vot" else {}))
    (tmp_path / "mine.toml").write_text(MAP.split("pm_ra")[0] + '[magnitudes]\nV = "v"\n')
    name = source.give_map(tmp_path / "mine.toml").name
    with pytest.raises(SourceError) as told:
        ingest_catalog(name, [path])
    limit = 24 if form == "float.fits" else 53
    assert f"identifiers above 2^{limit} are rounded in floating-point numbers" in str(told.value)
    assert "whole numbers of 64 bits or as texts" in str(told.value)
    assert "archive" not in str(told.value)


def test_whole_identifiers_in_floating_notation_are_the_numbers(tmp_path: Path):
    texts = ["4.295806720000000000e+09", "17.0", "4.2958e+09", "12.5", "3E10", "1.5E+1x"]
    rows = "".join(f"{text},{n}.5,20.5,5.0\n" for n, text in enumerate(texts, 1))
    read = readings(tmp_path, f"id,ra,dec,v\n{rows}")
    expected = {4295806720: "mine 4295806720", 17: "mine 17.0"}
    expected |= {identity(text): f"mine {text}" for text in ("12.5", "3E10", "1.5E+1x")}
    rows = read.stars.select(["star_id", "designation"]).to_pylist()
    assert {row["star_id"]: row["designation"] for row in rows} == expected
    assert read.problems == (
        "mine.csv row 3, columns.star_id: found '4.2958e+09'; expected a whole number with all of "
        "its digits, or a text",
    )


def test_decimal_identifiers_are_exact(tmp_path: Path):
    ids = pa.array([Decimal(one) for one in ROUNDED], pa.decimal128(38, 0))
    table = {"id": ids, "ra": [1.0, 2.0, 3.0], "dec": [4.0, 5.0, 6.0], "v": [7.0, 8.0, 9.0]}
    pq.write_table(pa.table(table), tmp_path / "mine.parquet")
    (tmp_path / "mine.toml").write_text(MAP.split("pm_ra")[0] + '[magnitudes]\nV = "v"\n')
    name = source.give_map(tmp_path / "mine.toml").name
    read = ingest_catalog(name, [tmp_path / "mine.parquet"])
    assert read.stars["star_id"].to_pylist() == sorted(ROUNDED)


IPAC = r"""\fixlen = T
\ 2MASS point sources
|ra        |dec       |id               |v      |flag|
|d         |double    |c                |real   |char|
|deg       |deg       |-                |mag    |    |
|null      |null      |null             |null   |-   |
  83.818610 -5.389680  05351646-0523228    4.834 A
  83.822000 -5.387000  05351728-0523132   null   -
\ a remark between rows

  83.8450x0 -5.416000  05352280-0524576    4.900 B
  83.900000       null 05352280-0524579    4.900
"""


def test_ipac_tables_are_those_of_astropy(tmp_path: Path):
    good = "".join(line for line in IPAC.splitlines(keepends=True) if "83.8450x0" not in line)
    read = readings(tmp_path, good, "tbl")
    expected = Table.read([line for line in good.splitlines() if line], format="ascii.ipac")
    kept = expected[~expected["dec"].mask]
    order = np.argsort([identity(one) for one in kept["id"]])
    for name, column in (("ra_deg", "ra"), ("dec_deg", "dec"), ("mag", "v")):
        values = [None if np.ma.is_masked(one) else one for one in kept[column][order]]
        assert read.stars[name].to_pylist() == pytest.approx(values)
    assert read.rejected_by_reason == {"no_position": 1}
    assert read.stars["designation"].to_pylist() == [f"mine {one}" for one in kept["id"][order]]


def test_a_bad_row_of_an_ipac_table_is_rejected_alone(tmp_path: Path):
    read = readings(tmp_path, IPAC, "tbl")
    assert read.problems == ("mine.tbl row 3, columns.ra: found '83.8450x0'; expected a number",)
    assert len(read.stars) == 2
    checked = check_map(source.data_source("mine"), tmp_path / "mine.tbl")
    assert checked.form == "IPAC"
    assert [one["unit"] for one in checked.values] == ["", "deg", "deg", "mag"]


def test_an_ipac_table_without_types_shows_them_by_its_rows(tmp_path: Path):
    lines = ["|id    |ra    |dec   |v  |flag|", " A1     10.5   20.5   4.5 D"]
    (tmp_path / "mine.tbl").write_text("\n".join([*lines, " B2     11.5   21.5   5.5 S", ""]))
    (tmp_path / "mine.toml").write_text(MAP.replace("pm_", "# pm_"))
    read = ingest_catalog(source.give_map(tmp_path / "mine.toml").name, [tmp_path / "mine.tbl"])
    assert sorted(read.stars["mag"].to_pylist()) == [4.5, 5.5]
    assert sum(read.stars["is_flagged_double"].to_pylist()) == 1


def test_rows_that_begin_with_a_bar_are_no_ipac_table(tmp_path: Path):
    read = readings(tmp_path, "|id|ra|dec|v\n|1|2.5|3.5|4.5\n", "txt", 'delimiter = "|"\n')
    assert read.stars["mag"].to_pylist() == [4.5]
    with pytest.raises(SourceError, match="two columns are called ''; rename one of each"):
        readings(tmp_path, "|id|ra|dec|v|\n|1|2.5|3.5|4.5|\n", "txt")


def test_stars_without_a_motion_are_counted(tmp_path: Path):
    rows = "".join(f"{n},{n}.5,20.5,{'' if n == 3 else 100},100,5.0\n" for n in range(1, 11))
    (tmp_path / "mine.csv").write_text(f"id,ra,dec,pmra,pmdec,v\n{rows}")
    (tmp_path / "mine.toml").write_text(MAP.split("[flags]")[0])
    name = source.give_map(tmp_path / "mine.toml").name
    assert ingest_catalog(name, [tmp_path / "mine.csv"]).notes == ()
    [note] = ingest_catalog(name, [tmp_path / "mine.csv"], epoch_jyear=2026.0).notes
    assert note.startswith(
        "mine: 1 of 10 stars have no proper motion and stay at J2000.00, not J2026.00; "
    )
    stored = ingest_to_store(name, [tmp_path / "mine.csv"], tmp_path / "store", epoch_jyear=2026.0)
    assert stored.notes == (note,)
    kept = read_catalog(name, [tmp_path / "store"], epoch_jyear=2026.0, neighbours=False)
    assert kept.notes == (note,)


def test_motions_per_century_are_per_hundred_years(tmp_path: Path):
    (tmp_path / "mine.csv").write_text("id,ra,dec,pmRA,pmDE,v\n1,10.5,60.0,0.2,3.0,5.0\n")
    text = (ROOT / "docs" / "howto-own-catalog.md").read_text()
    [example] = [block for block in text.split("```toml\n") if block.startswith("[columns]\npm_ra")]
    (tmp_path / "mine.toml").write_text(
        'name = "mine"\nepoch = 2000.0\n' + example.split("```")[0]
        + 'star_id = "id"\nra = "ra"\ndec = "dec"\n[magnitudes]\nV = "v"\n'
    )  # fmt: skip
    name = source.give_map(tmp_path / "mine.toml").name
    [star] = ingest_catalog(name, [tmp_path / "mine.csv"]).stars.to_pylist()
    # 0.2 s a century are 3 arcsec of the coordinate, half of it on the sky at 60 deg.
    assert star["pm_ra_cosdec_mas_yr"] == pytest.approx(15.0)
    assert star["pm_dec_mas_yr"] == pytest.approx(30.0)


def test_a_draft_marks_what_it_guesses(starcat, tmp_path: Path):
    (tmp_path / "plain.csv").write_text("id,ra,dec,mag,Bmag\n1,100.5,20.5,5.1,6.1\n")
    text = draft_map(tmp_path / "plain.csv").as_toml()
    assert 'V = "mag"  # the band is a guess: the table does not state it\n' in text
    assert 'B = "Bmag"\n' in text
    (tmp_path / "odd.csv").write_text("alpha,beta\none,two\n")
    run = starcat(["sources", "--draft", tmp_path / "odd.csv"])
    assert run.code == 0
    assert run.err == (
        "no column of odd.csv looks like star_id, dec, a magnitude; name them in the map\n"
    )


def test_a_draft_takes_a_column_in_magnitudes(tmp_path: Path):
    table = Table({"no": [1], "ra": [100.5], "dec": [20.5], "vt": [5.1] * u.mag})
    table.write(tmp_path / "tycho.fits")
    assert tomllib.loads(draft_map(tmp_path / "tycho.fits").as_toml())["magnitudes"] == {"VT": "vt"}
    odd = {"e_w4": [0.1] * u.mag, "w4-w3": [0.2] * u.mag, "w4": [5.1] * u.mag}
    Table({"no": [1], "ra": [100.5], "dec": [20.5], **odd}).write(tmp_path / "odd.fits")
    assert draft_map(tmp_path / "odd.fits").used["w4"] == "magnitudes.w4"


def test_a_draft_of_galactic_coordinates_states_their_frame(tmp_path: Path):
    (tmp_path / "gal.tsv").write_text("id\tl\tb\tV\n1\t100.5\t-20.5\t5.1\n2\t7\t3\t6.1\n")
    text = draft_map(tmp_path / "gal.tsv").as_toml()
    content = tomllib.loads(text)
    assert content["columns"] == {"star_id": "id", "ra": "l", "dec": "b"}
    assert (content["frame"], content["magnitudes"]) == ("galactic", {"V": "V"})
    assert 'frame = "galactic"  # a guess' in text
    # Gaia has both; without l a column b is a magnitude.
    for columns, magnitudes in (("l,b,g", {"G": "g"}), ("b,v", {"B": "b", "V": "v"})):
        row = "1,100.5,20.5," + ",".join(["5.1"] * (columns.count(",") + 1))
        (tmp_path / "both.csv").write_text(f"id,ra,dec,{columns}\n{row}\n")
        content = tomllib.loads(draft_map(tmp_path / "both.csv").as_toml())
        assert content["columns"] == {"star_id": "id", "ra": "ra", "dec": "dec"}
        assert ("frame" in content, content["magnitudes"]) == (False, magnitudes)


@pytest.mark.parametrize(
    ("column", "band"),
    [
        ("mag", "V"),
        ("m", "V"),
        ("magnitude", "V"),
        ("V", "V"),
        ("Vmag", "V"),
        ("mag_B", "B"),
        ("vt", "VT"),
        ("Hp", "Hp"),
    ],
)
def test_a_draft_of_the_plainest_table_finds_the_magnitudes(tmp_path, column, band):
    (tmp_path / "plain.csv").write_text(f"id,ra,dec,{column}\n1,10.5,20.5,5.1\n2,100.5,-2.5,6.1\n")
    draft = draft_map(tmp_path / "plain.csv")
    content = tomllib.loads(draft.as_toml())
    assert content["magnitudes"] == {band: column}
    assert "epoch" not in content
    assert "# epoch = 2000.0  # a guess" in draft.as_toml()
