"""Data sources: what the model refuses, and that the shipped tables fit the archives' records.

A wrong byte in a column table gives wrong stars without an error, so the tables are checked
twice: against themselves (ranges, overlaps, separators) and against genuine records.
"""

from __future__ import annotations

import gzip
import importlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from starcat import resources
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.fixed_width import parse_fixed_width
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.source import (
    DataSource,
    RecordFile,
    SourceColumn,
    data_source,
    read_source,
    source_names,
)
from starcat.errors import ConfigError

SOURCES = (
    "2mass", "gaia", "gcvs", "hipparcos", "hipparcos2", "sao", "tycho1", "tycho2", "vsx", "wds",
)  # fmt: skip

OVERLAPS = {("sao", "dm", "dm_component")}
"""Columns that share bytes on purpose: the second is part of the first."""

EXCERPTS = (
    ("sao", "sao", "sao.dat.gz", 15_935, 8_647),
    ("hipparcos", "hip_main", "hip_main.dat.gz", 9_933, 8_647),
    ("tycho1", "tyc_main", "tyc_main.dat.gz", 45_978, 8_647),
    ("tycho1", "tyc_main", "samples/tycho1_I239_records.txt", 10, 2),
    ("tycho2", "tyc2", "tyc2.dat.gz", 44_626, 8_595),
    ("tycho2", "tyc2", "samples/tycho2_I259_records.txt", 3, 3),
    ("tycho2", "suppl_1", "samples/tycho2_I259_suppl_records.txt", 2, 2),
    ("2mass", "psc", "psc_measured.gz", 3_122, 4_502),
    ("2mass", "psc", "psc_estimated.gz", 48_717, 8_647),
    ("2mass", "psc", "samples/twomass_psc_record.txt", 1, 1),
    ("gcvs", "gcvs", "gcvs.tsv.gz", 49_992, 418),
    ("wds", "wds_hip", "wds_hip.dat.gz", 22_991, 513),
)

TINY = """\
name = "tiny"
title = "Tiny"
identifier = "none"
citation = "none"
licence = "none"
frame = "ICRS"
urls_retrieved = "never"

[[files]]
name = "tiny"
file_names = ["tiny.dat"]
layout = "fixed_width"
record_bytes = 10
columns = [
  { name = "number", bytes = [1, 4], format = "I4" },
  { name = "mag", bytes = [6, 10], format = "F5.2", unit = "mag" },
]
"""


def layouts() -> Iterator[tuple[DataSource, RecordFile]]:
    for name in SOURCES:
        source = data_source(name)
        yield from ((source, file) for file in source.files)


def with_bytes() -> list[tuple[str, RecordFile]]:
    return [(source.name, file) for source, file in layouts() if file.record_bytes]


def layout_of(source: str, name: str) -> RecordFile:
    return next(file for file in data_source(source).files if file.name == name)


def span(column: SourceColumn) -> range:
    assert column.bytes is not None
    return range(column.bytes[0], column.bytes[1] + 1)


def read(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


def tiny(folder: Path, old: str = "", new: str = "") -> DataSource:
    assert old in TINY
    path = folder / "tiny.toml"
    path.write_text(TINY.replace(old, new, 1) if old else TINY)
    return read_source(path)


# The model


@pytest.mark.parametrize(
    ("old", "new", "key", "message"),
    [
        ('citation = "none"', 'cite = "none"', "citation", "missing"),
        ('title = "Tiny"', 'title = "Tiny"\ncolour = 1', "colour", "Extra inputs"),
        ("record_bytes", "record_length", "record_length", "Extra inputs"),
        ('"I4"', '"I4", nulls = []', "nulls", "Extra inputs"),
        ('unit = "mag"', 'unit = "parsec"', "files.0.columns.1", "unknown unit 'parsec'"),
        ("[6, 10]", "[10, 6]", "files.0.columns.1", "not first <= last"),
        ("[1, 4]", "[0, 4]", "files.0.columns.0", "not first <= last"),
        ("[6, 10]", "[6, 11]", "files.0", "column mag has bytes (6, 11)"),
        ("bytes = [6, 10], ", "", "files.0", "column mag has bytes None"),
        ('"mag", bytes', '"number", bytes', "files.0", "named twice: number"),
        ('"F5.2"', '"R5.2"', "files.0.columns.1", "format 'R5.2' is not like I6"),
        ('"F5.2"', '"F5"', "files.0.columns.1", "format 'F5' is not like I6"),
        ('"mag", bytes', '"Vmag", bytes', "files.0.columns.1.name", "expected small letters"),
        ("record_bytes = 10\n", "", "files.0", "need record_bytes"),
        ('"fixed_width"', '"fits"', "files.0.layout", "'delimited'"),
        ('"ICRS"', '"B1950"', "frame", "'FK5'"),
        ('["tiny.dat"]', "[]", "files.0.file_names", "expected a list of at least 1"),
    ],
)
def test_a_bad_file_is_refused_with_its_name_and_key(tmp_path, old, new, key, message):
    with pytest.raises(ConfigError) as caught:
        tiny(tmp_path, old, new)
    assert str(caught.value).startswith("tiny.toml: ")
    assert key in str(caught.value)
    assert message in str(caught.value)
    assert (caught.value.key or "").endswith(key)


# The seven files against themselves


@pytest.mark.parametrize("name", SOURCES)
def test_source_is_named_as_its_file_and_says_where_it_is_from(name):
    source = data_source(name)
    assert source.name == name
    assert (source.kind == "stars") == bool(source.bands)
    assert (source.frame == "none") == (source.name == "gcvs")
    texts = (source.title, source.identifier, source.citation, source.licence, source.reference)
    assert all(texts)
    assert all(column.description for file in source.files for column in file.columns)


def test_rows_of_the_archives():
    archives = [name for name in source_names() if data_source(name).table is None]
    assert tuple(archives) == SOURCES
    assert {name: data_source(name).rows for name in archives} == {
        "2mass": 470_992_970, "gaia": 482_176 + 2_035, "gcvs": 49_992, "hipparcos": 118_218,
        "hipparcos2": 117_955, "sao": 258_997, "tycho1": 1_058_332,
        "tycho2": 2_539_913 + 17_588, "vsx": None, "wds": None,
    }  # fmt: skip


def test_each_part_has_its_own_name_and_address():
    for _, file in layouts():
        assert bool(file.parts) == ("{part}" in file.file_names[0])
        assert len(set(file.parts)) == len(file.parts)
        for url in file.urls:
            assert url.removesuffix(".gz").rsplit("/", 1)[-1] in file.file_names


@pytest.mark.parametrize(("source", "file"), with_bytes())
def test_columns_lie_within_the_record_in_order_and_do_not_overlap(source, file):
    owner: dict[int, str] = {}
    for column in file.columns:
        digits = column.format.lstrip("AIFDE<if").partition(".")[0]
        assert int(digits) == len(span(column)), (source, column.name)
        for byte in span(column):
            assert 1 <= byte <= (file.record_bytes or 0)
            if byte in owner:
                assert (source, owner[byte], column.name) in OVERLAPS
            else:
                owner[byte] = column.name
    starts = [span(column).start for column in file.columns]
    assert starts == sorted(starts)
    # Separators are outside the columns.
    assert not owner.keys() & {int(position) for position in file.literals}
    assert set(file.literals.values()) <= {"|"}


@pytest.mark.parametrize(
    ("source", "name", "blank"),
    [
        ("sao", "sao", set()),
        ("hipparcos", "hip_main", {*range(3, 9), 450}),
        ("tycho1", "tyc_main", {7, 13, 48, 259}),
        ("tycho2", "tyc2", {5, 11}),
        ("tycho2", "suppl_1", {5, 11}),
        ("gaia", "gaia_merged", set()),
    ],
)
def test_every_byte_is_a_column_a_separator_or_blank(source, name, blank):
    file = layout_of(source, name)
    known = {byte for column in file.columns for byte in span(column)}
    known |= {int(position) for position in file.literals}
    assert set(range(1, (file.record_bytes or 0) + 1)) - known == blank


def test_parts_of_2mass_and_tycho2():
    parts = data_source("2mass").files[0].parts
    assert [sum(part.startswith(one) for part in parts) for one in "ab"] == [57, 35]
    assert (parts[56], parts[57], parts[-1]) == ("ace", "baa", "bbi")
    assert parts == tuple(sorted(parts))
    main, supplement = data_source("tycho2").files
    assert main.parts == tuple(f"{number:02}" for number in range(20))
    assert (main.optional, supplement.optional) == (False, True)


def test_only_identifiers_and_delimited_positions_are_required():
    required = {
        file.name: " ".join(column.name for column in file.columns if column.required)
        for _, file in layouts()
    }
    assert required == {
        "psc": "ra dec designation", "gaia_merged": "source_id ra_deg dec_deg mag_g",
        "gaia_completed": "source_id ra_deg dec_deg mag_g hip change",
        "gcvs": "star_ref name", "hip_main": "hip", "hip2": "hip", "sao": "sao",
        **dict.fromkeys(("tyc_main", "tyc2", "suppl_1"), "tyc1 tyc2 tyc3"),
        "vsx": "var_flag ra_deg de_deg", "wds_hip": "hip wds", "wds": "wds obs_first",
    }  # fmt: skip


# The tables against genuine records


@pytest.mark.parametrize(("source", "name", "path", "rows", "made"), EXCERPTS)
def test_every_column_of_every_record_is_readable(
    catalogs, expected, source, name, path, rows, made
):
    file = layout_of(source, name)
    records = parsed(catalogs / path, file)
    assert records.problems == []
    assert len(records) == expected(genuine=rows, generated=made)
    if file.literals:
        # Both ways: a bar at each place, and no bar anywhere else.
        bars = {int(position) for position in file.literals}
        lines = read(catalogs / path).splitlines()
        assert {len(line) for line in lines} == {file.record_bytes}
        assert all(line.count(b"|") == len(bars) for line in lines)
        assert all({line[byte - 1] for line in lines} == {ord("|")} for byte in bars)


def parsed(path: Path, file: RecordFile) -> ParsedRecords:
    parse = parse_fixed_width if file.layout == "fixed_width" else parse_delimited
    return parse(read(path), file, [column.name for column in file.columns])


def test_sexagesimal_and_decimal_positions_of_hipparcos_agree(catalogs):
    hip = parsed(catalogs / "hip_main.dat.gz", layout_of("hipparcos", "hip_main"))
    degree, minute, second = np.array([text.split() for text in hip["de_dms"]], float).T
    size = abs(degree) + minute / 60.0 + second / 3600.0
    # Stars without an astrometric solution have the text only.
    solved = ~np.isnan(hip["de_deg"])
    assert (~solved).sum() == 5
    # The text has one decimal of an arcsecond.
    assert abs(size - abs(hip["de_deg"]))[solved].max() < 0.051 / 3600.0
    assert (hip["hip"] == hip["hip_repeated"]).all()


@pytest.mark.parametrize("year", ["", "2000"])
def test_sexagesimal_and_radian_positions_of_sao_agree(catalogs, year):
    sao = parsed(catalogs / "sao.dat.gz", layout_of("sao", "sao"))
    ra = sao[f"ra{year}_h"] + sao[f"ra{year}_m"] / 60.0 + sao[f"ra{year}_s"] / 3600.0
    dec = sao[f"de{year}_d"] + sao[f"de{year}_m"] / 60.0 + sao[f"de{year}_s"] / 3600.0
    sign = np.where(sao[f"de{year}_sign"] == b"-", -1.0, 1.0)
    # B1950 radians run from -pi to pi. Half a millisecond is 3.7e-8 rad, half of 0.01" 2.5e-8;
    # negative B1950 radians have one decimal less.
    difference = np.radians(15.0 * ra) - sao[f"ra{year}_rad"]
    assert abs(np.angle(np.exp(1j * difference))).max() < 1.1e-7
    assert abs(sign * np.radians(dec) - sao[f"de{year}_rad"]).max() < 3.1e-8


def test_a_list_that_supplies_something_names_the_function_that_reads_it():
    lists = [data_source(name) for name in SOURCES if data_source(name).kind != "stars"]
    assert {source.name for source in lists} == {"gcvs", "vsx", "wds"}
    for source in lists:
        wanted = {"variability": "amplitudes", "doubles": "companions"}[source.kind]
        assert source.supplies == wanted
        assert source.name in resources.sources_supplying(wanted)
        module, _, name = source.python.partition(":")
        assert callable(getattr(importlib.import_module(module), name))


def test_a_new_list_is_one_new_file(tmp_path, monkeypatch):
    (tmp_path / "mine.toml").write_text('name = "mine"\nsupplies = "amplitudes"\n')
    (tmp_path / "stars.toml").write_text('name = "stars"\n')
    monkeypatch.setattr(resources, "resource_folder", lambda _: tmp_path)
    monkeypatch.setattr(resources, "sources_supplying", resources.sources_supplying.__wrapped__)
    assert resources.sources_supplying("amplitudes") == ("mine",)
