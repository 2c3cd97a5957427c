"""Tables in other tools' formats: those tools read back what was written."""

from __future__ import annotations

import io
import json
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import pytest
from astropy import units
from astropy.io import fits
from astropy.io.votable import parse, validate
from astropy.table import Table
from hypothesis import given
from hypothesis import strategies as st
from table_formats import ASTROPY, EVERY_FORMAT, READERS, SERVED, VOTABLES, check_read, written

from starcat.database.reader import open_database_folder
from starcat.errors import ConfigError, OutputError, SchemaError
from starcat.resources import resource_folder
from starcat.ship.exchange.columns import Label
from starcat.ship.exchange.export import export_tables, tables_of
from starcat.ship.exchange.formats import FILE_FORMATS, FORMATS, TEXT_FORMATS, format_of
from starcat.ship.exchange.writers import result_chunks, write_batches, write_text_batches
from starcat.storage.schema import product_schema

GAIA_ID = 4472832130942575872  # Barnard's star: 2^62 and more
PRODUCTS = sorted(
    {path.stem.rpartition("-")[0] for path in resource_folder("schemas").glob("*-*.json")}
    - {"manifest"}
)


# Metadata of a file --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def exported(small_database: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three products in all formats that say what they are."""
    folder, products = tmp_path_factory.mktemp("exported"), ["stars", "pairs", "boresights"]
    for file_format in ("votable", "fits", "ecsv"):
        tables = tables_of(small_database)
        export_tables(tables, file_format, folder / file_format, products=products)
    return folder


def test_files_name_product_database_and_version(exported):
    paths = {path.name: sorted(path.iterdir()) for path in exported.iterdir()}
    assert min(map(len, paths.values())) == 3
    for path in paths["fits"]:
        with fits.open(path) as file:
            file.verify("exception")
            header = file[1].header
            named = [header[key] for key in ("EXTNAME", "ARTIFACT", "VERSION", "LONGSTRN")]
            assert named == [path.stem, "small", "1.0.0", "OGIP 1.0"]
            # Before the first text that needs it.
            cards = [card.keyword for card in header.cards]
            assert cards.index("LONGSTRN") < cards.index("TCOMM1")
    known = {"artifact": "small", "version": "1.0.0"}
    for path in paths["votable"]:
        (resource,) = parse(path, verify="exception").resources
        assert {info.name: info.value for info in resource.infos} == known
        assert resource.tables[0].name == path.stem
    for path in paths["ecsv"]:
        assert Table.read(path).meta == {"name": path.stem, **known}


@pytest.mark.skipif(shutil.which("fitsverify") is None, reason="fitsverify is not installed")
def test_fitsverify_finds_nothing(exported):
    for path in sorted((exported / "fits").iterdir()):
        done = subprocess.run(
            ["fitsverify", str(path)], capture_output=True, text=True, check=False
        )
        assert "found 0 warning(s) and 0 error(s)" in done.stdout, done.stdout


def test_votable_positions_are_in_a_coordinate_system(exported):
    stars = parse(exported / "votable" / "stars.vot", verify="exception")
    (system,) = stars.resources[0].coordinate_systems
    assert (system.system, system.epoch) == ("ICRS", "J2026")
    refer = {field.name for field in stars.get_first_table().fields if field.ref == system.ID}
    assert refer == {"ra_deg", "dec_deg", "x", "y", "z", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr"}
    pairs = parse(exported / "votable" / "pairs.vot", verify="exception")
    assert not pairs.resources[0].coordinate_systems


def test_a_table_of_no_database_says_nothing_of_one(tmp_path):
    # Its name is that of a column, which has an identifier too.
    table = pa.table({"mag": [1.0]})
    write_batches(table.to_reader(), tmp_path / "a.vot", "votable", Label("mag"))
    found = parse(tmp_path / "a.vot", verify="exception")
    assert found.resources[0].infos == []
    assert found.get_first_table().name == "mag"
    write_batches(table.to_reader(), tmp_path / "a.fits", "fits")
    with fits.open(tmp_path / "a.fits") as file:
        assert not {"EXTNAME", "ARTIFACT", "VERSION"} & set(file[1].header)


@pytest.mark.parametrize("file_format", ["votable", "fits", "ecsv", "npz"])
def test_a_column_without_a_name_is_refused(file_format, tmp_path):
    for table in (pa.table({"": [1]}), pa.table({"a": [1], "": ["x"]})):
        with pytest.raises(SchemaError, match=f"an empty name, which {file_format} cannot hold"):
            write_batches(table.to_reader(), tmp_path / "a", file_format)


@pytest.mark.filterwarnings("ignore:It is strongly recommended")
@pytest.mark.parametrize(
    ("file_format", "longest"),
    [("fits", "x" * 68), ("fits", "'" * 34), ("npz", "x" * 65_531), ("npz", "é" * 32_765)],
)
def test_names_as_long_as_can_be(file_format, longest, tmp_path):
    path = tmp_path / f"a{FORMATS[file_format].suffix}"
    write_batches(pa.table({longest: [7]}).to_reader(), path, file_format)
    if file_format == "fits":
        assert Table.read(path)[longest][0] == 7
    else:
        with np.load(path) as file:
            assert file[longest][0] == 7
    longer = pa.table({f"{longest}{longest[0]}": [7]})
    with pytest.raises(SchemaError, match=r"has a name of .* letters") as caught:
        write_batches(longer.to_reader(), path, file_format)
    assert len(str(caught.value)) < 200


# Products ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def products(small_database: Path) -> dict[str, pa.Table]:
    database = open_database_folder(small_database)
    return {name: database.table(name) for name in database.products}


@pytest.mark.parametrize("product", PRODUCTS)
def test_every_unit_is_one_of_fits_and_votable(product):
    for column in product_schema(product).columns:
        if column.unit:
            unit = units.Unit(column.unit)
            for standard in ("fits", "vounit", "generic"):
                assert units.Unit(unit.to_string(standard), format=standard) == unit
        assert column.description.isascii()


def test_meanings_and_ucds_come_along(products, tmp_path):
    stars = products["stars"]
    column = {c.name: c for c in product_schema("stars").columns}["ra_deg"]
    votable = parse(written(stars, tmp_path, "votable")).get_first_table()
    field = {f.name: f for f in votable.fields}["ra_deg"]
    assert (field.ucd, field.description) == (column.ucd, column.description)
    header = fits.getheader(written(stars, tmp_path, "fits"), 1)
    place = stars.column_names.index("ra_deg") + 1
    assert header[f"TCOMM{place}"] == column.description
    assert header[f"TUCD{place}"] == column.ucd
    ecsv = Table.read(written(stars, tmp_path, "ecsv"))["ra_deg"]
    assert (ecsv.meta["ucd"], ecsv.description) == (column.ucd, column.description)
    parquet = pq.read_table(written(stars, tmp_path, "parquet"))
    assert parquet.schema.field("ra_deg").metadata == stars.schema.field("ra_deg").metadata
    assert Table.read(tmp_path / "table.parquet")["ra_deg"].unit == units.deg


@pytest.mark.parametrize("form", VOTABLES)
def test_votable_is_valid(products, tmp_path, form):
    path = written(products["stars"], tmp_path, form)
    report = io.StringIO()
    assert validate(path, output=report, xmllint=False), report.getvalue()


# Any table ---------------------------------------------------------------------------------

INTEGERS = [pa.int8(), pa.int16(), pa.int32(), pa.int64(), pa.uint8(), pa.uint16(), pa.uint32()]


def bounds(kind: pa.DataType) -> dict[str, int]:
    info = np.iinfo(kind.to_pandas_dtype())
    return {"min_value": int(info.min), "max_value": int(info.max)}


def texts(file_format: str) -> st.SearchStrategy[str]:
    """Texts without what a format cannot hold: control characters, blanks at the ends."""
    if file_format in VOTABLES:
        return st.text(st.characters(codec="utf-8", exclude_categories=["Cc"]), max_size=6)
    letters = st.characters(exclude_categories=["Cs", "Cc", "Zl", "Zp", "Zs", "Cn"]) | st.just(" ")
    return st.text(letters, max_size=6).map(str.strip).filter(lambda text: text[:1] != "#")


def values_of(kind: pa.DataType, file_format: str) -> st.SearchStrategy[Any]:
    if pa.types.is_list(kind):
        return st.lists(values_of(kind.value_type, file_format), max_size=3)
    if pa.types.is_integer(kind):
        return st.integers(**bounds(kind))
    if pa.types.is_floating(kind):
        return st.floats(width=32 if kind == pa.float32() else 64)
    return st.booleans() if pa.types.is_boolean(kind) else texts(file_format)


KINDS = [
    *INTEGERS, pa.float32(), pa.float64(), pa.bool_(), pa.string(), pa.list_(pa.int16()),
    pa.list_(pa.int32()), pa.list_(pa.int64()), pa.list_(pa.float32()), pa.list_(pa.float64()),
]  # fmt: skip


@st.composite
def tables(draw: st.DrawFn, file_format: str) -> pa.Table:
    kinds = draw(st.lists(st.sampled_from(KINDS), min_size=1, max_size=4))
    rows = draw(st.integers(0, 5))
    columns = []
    for kind in kinds:
        values = st.none() | values_of(kind, file_format)
        columns.append(pa.array(draw(st.lists(values, min_size=rows, max_size=rows)), kind))
    fields = [
        pa.field(f"c{k}", kind, metadata={"unit": draw(st.sampled_from(["deg", "mas/yr", "mag"]))})
        for k, kind in enumerate(kinds)
    ]
    return pa.Table.from_arrays(columns, schema=pa.schema(fields))


def ascii_only(table: pa.Table) -> pa.Table:
    """The table with letters outside ASCII written out, as FITS needs it."""
    for k, field in enumerate(table.schema):
        if pa.types.is_string(field.type):
            plain = [text and ascii(text) for text in table[field.name].to_pylist()]
            table = table.set_column(k, field, pa.array(plain, pa.string()))
    return table


TABLES = {
    "infinite and missing": {
        "a": [math.inf, -math.inf, math.nan, None, 1.0], "b": [None, 2, 3, None, 5]
    },
    "constant": {
        "null": pa.nulls(5, pa.string()), "same": ["<a>"] * 5, "number": [2.0] * 5,
        "differs": [1, 2, 3, 4, 5], "truth": [True] * 5, "none": pa.nulls(5, pa.float64()),
    },
    "texts of all planes": {
        "a": ["\U0001f52d", "", None, "α Cen", "a<b>&c]]>", "plain", "é\U0001f52dé", "  spaces "],
        "n": list(range(8)),
        "b": ["  spaces ", "é\U0001f52dé", "plain", "a<b>&c]]>", "α Cen", None, "", "\U0001f52d"],
    },
    "all constant": {"a": ["<a>"] * 5, "b": [2.0] * 5, "c": pa.nulls(5, pa.string())},
    "mixed": {
        "a": [1.5, None, 3.5, 4.5, 4.5, 4.5], "b": [True, None, False, True, True, True],
        "c": ["x", "yy", None, "z", "z", "z"], "d": [[1], [], None, [2, 3], [2], [4]],
        "e": [7, 8, 9, 5, 5, 5],
    },
    "no rows": {"a": [], "b": [], "c": []},
    **{
        f"{width} wide": {f"c{k}": [None if k % 3 else k, k] for k in range(width)}
        for width in (1, 7, 8, 9, 16, 17, 33)
    },
    **{
        f"with {text}": {"a": [f"x{text}y", "", None], "b": [1, 2, 3]}
        for text in (
            "'", '"', ",", ";", "\\", "\t", "\n", "a\nb", "<&>]]>", "nan", "--", "é \U0001f52dé",
        )
    },
}  # fmt: skip
SCHEMAS = {"no rows": pa.schema({"a": pa.int64(), "b": pa.list_(pa.float64()), "c": pa.string()})}


@pytest.mark.parametrize("file_format", EVERY_FORMAT)
class TestEveryFormat:
    """Another library reads back what was written: values, units and nulls."""

    def test_holds_every_product(self, file_format, products, tmp_path):
        expected = {"stars", "rejected", "pairs", "neighbours", "hausdorff_l2", "boresights"}
        assert expected <= set(products)
        for table in products.values():
            short = table.slice(0, 80)
            path = written(short, tmp_path, file_format)
            check_read(short, path, file_format)
            if file_format == "csv":
                count = duckdb.sql(f"select count(*) from '{path}'").fetchall()
                assert count == [(len(short),)]
            if file_format == "parquet":
                assert pq.read_table(path).cast(table.schema).equals(short)
                assert b"IVOA.VOTable-Parquet.content" in pq.read_metadata(path).metadata
            assert written(short, tmp_path, file_format, 33).read_bytes() == path.read_bytes()

    @pytest.mark.slow
    @given(data=st.data())
    def test_holds_any_table(self, file_format, tmp_path_factory, data):
        table = data.draw(tables(file_format))
        chosen = ascii_only(table) if file_format == "fits" else table
        rows_a_batch = data.draw(st.integers(1, 6))
        path = written(chosen, tmp_path_factory.mktemp("any"), file_format, rows_a_batch)
        check_read(chosen, path, file_format)
        if file_format in TEXT_FORMATS:
            stream, reader = io.StringIO(newline=""), table.to_reader(rows_a_batch)
            assert write_text_batches(reader, stream, file_format) == len(table)
            assert stream.getvalue() == path.read_bytes().decode()

    def test_holds_the_smallest_and_largest_numbers_exactly(self, file_format, tmp_path):
        doubles = [5e-324, 1.7976931348623157e308, 0.1, 1 / 3, -0.0, 1e22, 123456789.12345679]
        singles = np.array([1e-45, 3.4028235e38, 0.1, 1 / 3, 0.0, 1e22, 16777217], np.float32)
        longs = [-(2**63), 2**63 - 1, GAIA_ID, 0, -1, 2**53 + 1, 7]
        table = pa.table({"a": doubles, "b": singles, "c": longs})
        path = written(table, tmp_path, file_format)
        check_read(table, path, file_format)
        if file_format in ASTROPY:
            read = Table.read(path)
            assert read["a"].astype("<f8").tobytes() == np.array(doubles).tobytes()
            assert read["b"].astype("<f4").tobytes() == singles.tobytes()

    @pytest.mark.parametrize("name", TABLES)
    def test_holds_parts_of_a_table(self, file_format, name, tmp_path):
        table = pa.table(TABLES[name], SCHEMAS.get(name))
        if file_format == "fits":
            table = ascii_only(table)
        path = written(table, tmp_path, file_format)
        check_read(table, path, file_format)
        if file_format == "parquet":
            assert pq.read_table(path).schema.equals(table.schema)
        if file_format == "csv" and name.startswith("with "):
            # An empty text and null are two things in CSV as well.
            lines = pcsv.ParseOptions(newlines_in_values=True)
            convert = pcsv.ConvertOptions(
                strings_can_be_null=True, quoted_strings_can_be_null=False
            )
            read = pcsv.read_csv(path, parse_options=lines, convert_options=convert)
            assert read.to_pydict() == TABLES[name]
        for start in range(6 if name == "mixed" else 0):
            part = table.slice(start, 3)
            check_read(part, written(part, tmp_path, file_format), file_format)


# What SQL gives ----------------------------------------------------------------------------

SQL = """select 1::tinyint a, 2::utinyint b, 3::uhugeint c, sum(4) d, date '2026-01-31' e,
timestamp '2026-01-31 12:00:00.5' f, timestamptz '2026-01-31 12:00:00+02' g,
{'p': 1.5, 'q': 'x'} h, ['é', null] i, [[1], []] j, null k, 1.25 l, time '01:02:03' m,
'dim'::enum('dim', 'bright') n, [1, 2]::int[2] o, 65535::usmallint p, 4294967295::uinteger q,
4472832130942575872 r, 7::ubigint s, true t"""
IN_TEXT = {
    "a": 1, "b": 2, "c": 3, "d": 4, "e": "2026-01-31", "f": "2026-01-31T12:00:00.500000",
    "g": "2026-01-31T10:00:00.000000Z", "h": {"p": 1.5, "q": "x"}, "i": ["é", None], "j": [[1], []],
    "k": None, "l": 1.25, "m": "01:02:03.000000", "n": "dim", "o": [1, 2], "p": 65535,
    "q": 4294967295, "r": GAIA_ID, "s": 7, "t": True,
}  # fmt: skip


@pytest.fixture
def result() -> pa.Table:
    connection = duckdb.connect()
    connection.execute("set timezone = 'UTC'")
    return connection.sql(SQL).to_arrow_reader(10).read_all()


@pytest.mark.parametrize("file_format", ["csv", "tsv", "json", *ASTROPY])
def test_a_format_holds_what_sql_gives(result, tmp_path, file_format):
    if file_format == "fits":
        result = result.drop_columns("i")
    columns = READERS[file_format](written(result, tmp_path, file_format))
    assert list(columns) == result.column_names
    for name, (value,) in columns.items():
        wanted = IN_TEXT[name]
        if file_format in ("csv", "tsv") and isinstance(wanted, dict | list | bool):
            value = json.loads(value)
        elif file_format in ("csv", "tsv"):
            wanted = "" if wanted is None else str(wanted)
        elif file_format != "json" and name in ("h", "i", "j"):
            value = json.loads(value)  # records, and lists of anything but numbers
        assert value in (None, "") if wanted is None else value == wanted, name


def test_parquet_keeps_the_types_of_sql(result, tmp_path):
    again = pq.read_table(written(result, tmp_path, "parquet"))
    assert again.to_pylist() == result.to_pylist()
    assert again.schema.field("e").type == pa.date32()
    assert again.schema.field("h").type == result.schema.field("h").type


BINARY = ("votable", "fits", "npz")


@pytest.mark.parametrize(
    ("query", "names", "words"),
    [
        ("select interval 1 day a", FILE_FORMATS, r"column 'a' .* epoch\(a\)"),
        ("select 'x'::blob b", FILE_FORMATS, r"column 'b' .* hex\(b\)"),
        ("select map {'k': 1} c", FILE_FORMATS, r"column 'c' .* map_entries\(c\)"),
        ("select {'p': interval 1 day} d", FILE_FORMATS, r"column 'd.p' .* epoch"),
        ("select 1 e, 2 e", FILE_FORMATS, r"column 'e' is there twice.* AS"),
        ("select 1e30::hugeint f", [*BINARY, "ecsv"], r"column 'f'.*VARCHAR"),
        ("select 18446744073709551615::ubigint g", ["votable", "fits"], r"column 'g'.*VARCHAR"),
        ("select [1, null] h", [*BINARY, "ecsv"], r"column 'h'.*DOUBLE"),
        ("select 'é' i", ["fits"], r"column 'i': text is ASCII .*votable"),
        ('select 1 as "é"', ["fits"], r"names are ASCII in FITS; rename it with AS"),
        ("select chr(1) j", ["votable"], r"column 'j'.*XML cannot hold"),
        ("select 'a' || chr(13) k", ["votable", "ecsv"], r"column 'k'.*another format"),
        ("select '#' l", ["ecsv"], r"column 'l'.*misread"),
        ("select chr(0) m", [*BINARY, "ecsv"], r"column 'm'.*another format|ASCII"),
        ("select 1 a, 2 A", ["fits"], r"'a' and 'A'.*rename one"),
        ('select [1] n, 2 as "n.offsets"', ["npz"], r"'n.offsets'.* rename"),
    ],
)
def test_what_a_format_cannot_hold_is_refused_by_name(tmp_path, query, names, words):
    for file_format in names:
        target = tmp_path / f"refused.{file_format}"
        target.write_text("before")
        with pytest.raises(SchemaError, match=words):
            write_batches(duckdb.sql(query).to_arrow_reader(10), target, file_format)
        assert [path.name for path in tmp_path.iterdir()] == [target.name]
        assert target.read_text() == "before"
        target.unlink()


def test_an_unknown_unit_is_refused_where_units_are_written(tmp_path):
    field = pa.field("a", pa.float64(), metadata={"unit": "furlong/fortnight"})
    table = pa.Table.from_arrays([pa.array([1.0])], schema=pa.schema([field]))
    for file_format in ("votable", "fits", "ecsv"):
        with pytest.raises(SchemaError, match="column 'a': unit 'furlong/fortnight'"):
            written(table, tmp_path, file_format)
    assert written(table, tmp_path, "csv").read_text() == '"a"\n1\n'


def test_fits_chooses_a_null_that_no_value_is(tmp_path):
    low = int(np.iinfo(np.int32).min)
    table = pa.table({"a": pa.array([low, low + 1, None], pa.int32()), "b": [True, None, False]})
    path = written(table, tmp_path, "fits")
    assert fits.getheader(path, 1)["TNULL1"] == low + 2
    check_read(table, path, "fits")


def test_numbers_that_are_none(tmp_path):
    table = pa.table({"a": [math.nan, math.inf, -math.inf, None, 0.1], "b": [1, 2, 3, 4, 5]})
    path = written(table, tmp_path, "csv")
    assert path.read_text() == '"a","b"\nnan,1\ninf,2\n-inf,3\n,4\n0.1,5\n'
    read = json.loads(written(table, tmp_path, "json").read_text())
    assert [row["a"] for row in read] == [None, None, None, None, 0.1]


def test_a_null_alone_in_its_row_is_no_empty_line(tmp_path):
    path = written(pa.table({"a": [1, None, 3]}), tmp_path, "csv")
    assert path.read_text() == '"a"\n"1"\n""\n"3"\n'
    assert duckdb.sql(f"select a::int from '{path}'").fetchall() == [(1,), (None,), (3,)]


def test_streamed_formats_never_hold_the_table(tmp_path):
    held = []

    def batches() -> Any:
        for k in range(20):
            held.append(pa.total_allocated_bytes())
            yield pa.record_batch({"a": pa.array(np.full(100_000, k, dtype=np.int64))})

    schema = pa.schema({"a": pa.int64()})
    for file_format in ("csv", "json", "parquet", "votable", "votable/b2", "tsv"):
        held.clear()
        before = pa.total_allocated_bytes()
        reader = pa.RecordBatchReader.from_batches(schema, batches())
        if file_format in SERVED:
            assert sum(map(len, result_chunks(reader, SERVED[file_format], tmp_path))) > 4e6
        else:
            assert write_batches(reader, tmp_path / "large", file_format) == 2_000_000
        assert max(held) - before < 8e6, file_format  # the table is 16 MB


@pytest.mark.parametrize(
    ("name", "file_format"),
    [
        ("a.csv", "csv"), ("a.JSON", "json"), ("b.parquet", "parquet"), ("c.vot", "votable"),
        ("c.xml", "votable"), ("d/e.fits", "fits"), ("f.ecsv", "ecsv"), ("g.npz", "npz"),
    ],
)  # fmt: skip
def test_the_suffix_says_the_format(name, file_format):
    assert format_of(name) == format_of(Path(name)) == file_format
    assert file_format in FILE_FORMATS


def test_formats_and_places_that_are_not_there(tmp_path):
    reader = pa.table({"a": [1]}).to_reader()
    with pytest.raises(ConfigError, match="'xlsx' is unknown here; choose one of csv, json"):
        write_batches(reader, tmp_path / "a.xlsx", "xlsx")
    with pytest.raises(ConfigError, match="'fits' is unknown here; choose one of csv, json"):
        write_text_batches(reader, io.StringIO(), "fits")
    (tmp_path / "file").write_text("")
    for file_format in FILE_FORMATS:
        with pytest.raises(OutputError, match="cannot be written"):
            write_batches(pa.table({"a": [1]}).to_reader(), tmp_path / "file" / "a", file_format)


def test_a_query_that_fails_halfway_is_no_error_of_the_file(tmp_path):
    query = "select if(i = 150000, error('boom'), i::varchar) a from range(200000) t(i)"
    for file_format in FILE_FORMATS:
        with pytest.raises(OSError, match="boom") as raised:
            write_batches(duckdb.sql(query).to_arrow_reader(1000), tmp_path / "a", file_format)
        assert not isinstance(raised.value, OutputError)
        assert list(tmp_path.iterdir()) == []
