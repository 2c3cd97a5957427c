"""Every archive: its records are kept, in any blocks and order, or damaged in many ways.

Every reader has the same property for every file: it raises one of starcat's own errors, or
every record is either kept or rejected, the tables follow their schemas, and every kept star
has a place on the sky. The records are synthetic, so that no excerpt is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from archives import archive_records, file_header, with_field
from catalog_folder import bright_sky
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from starcat.catalog.doubles import WDS_COLUMNS, PairTable, read_wds
from starcat.catalog.ingest import Ingested, ingest_catalog
from starcat.catalog.parts import archive_of
from starcat.catalog.readers import blocks
from starcat.catalog.source import RecordFile, SourceColumn, data_source, source_names
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.catalog.variability import GCVS_COLUMNS, VSX_COLUMNS, AmplitudeTable, read_amplitudes
from starcat.errors import ParseError, StarcatError
from starcat.storage.schema import product_schema

TARGETS = [
    (name, layout.name)
    for name in source_names()
    for layout in data_source(name).files
    if layout.table is None
]
"""Every source and layout that has a reader."""

MADE_ONLY = ("hipparcos2", "vsx", "wds")
"""Sources without genuine records in the repository: the slow tests read many damaged records."""

JOINED = {"gcvs": {"gcvs": GCVS_COLUMNS}, "vsx": {"vsx": VSX_COLUMNS}, "wds": WDS_COLUMNS}
"""The sources that are joined to stars, and the columns of theirs that are read."""

TEXTS = [
    *("", "-", "+", ".", "*", "\\N", "NULL", "nan", "inf", "-inf", "Infinity", "x.2", "--1", "1 1"),
    *("0", "-0", "1", "-1", "7", "90.0", "-90.0", "91", "359.99999999", "360.0", "360.00000001"),
    *("1e308", "-1e308", "1e400", "1E99", "9e18", "1d5", "1D-400", "99.9", "100000", "0x10", "1_0"),
    *("9" * 10, "9" * 19, "9" * 20, "-9223372036854775808", "9223372036854775807", "65536.5"),
    *("\u0663\u0664", "\uff11\uff12", "\u00b2\u00b3", "\u0967", "\x00", "\xff\xfe", "\u2212 5"),
    *("|" * 3, "\t", "#", "\r", '"', "D", "X", "T", "A", "\u00e9" * 9, "7" * 20_000, "z" * 20_000),
]
"""Texts to put into fields: null texts, limits, huge numbers, digits of other scripts, marks."""

NUMBERS = (
    np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0, -0.0, 360.0, -90.0, 1e5, -(2.0**63), 2.0**62,
)  # fmt: skip
"""Bytes to put into the fields of packed records."""

KINDS = ("flip", "text", "text", "text", "swap", "blank", "cut", "lengthen", "join", "repeat")


@dataclass(frozen=True)
class Damage:
    """One thing that happens to one record; which of the numbers count depends on the kind."""

    record: int
    kind: str
    column: int
    other: int
    text: str
    number: float
    byte: int


DAMAGE = st.builds(
    Damage,
    record=st.integers(0, 59),
    kind=st.sampled_from(KINDS),
    column=st.integers(0, 99),
    other=st.integers(0, 99),
    text=st.sampled_from(TEXTS) | st.text(max_size=12),
    number=st.sampled_from(NUMBERS) | st.floats(),
    byte=st.integers(0, 255),
)


whole_sky = cache(bright_sky)


@cache
def good_records(source_name: str, layout_name: str) -> tuple[bytes, ...]:
    """60 records of stars that do not exist."""
    # The supplement has only the brightest stars, and the catalogue of variables only those.
    sky = whole_sky().where(np.arange(1500 if source_name in JOINED else 70))
    if layout_name == "suppl_1":
        sky = replace(sky, v_mag=sky.v_mag - 5.0)
    return tuple(archive_records(source_name, sky)[layout_name][:60])


def layout_of(source_name: str, layout_name: str) -> RecordFile:
    return next(file for file in data_source(source_name).files if file.name == layout_name)


def columns_read(source_name: str, layout: RecordFile) -> list[SourceColumn]:
    """The columns that the catalog's module asks for: damage elsewhere is not seen."""
    if source_name in JOINED:
        names: Sequence[str] = JOINED[source_name][layout.name]
    else:
        names = archive_of(source_name).COLUMNS[layout.name]
    return [layout.column(name) for name in names]


def damaged(source_name: str, layout: RecordFile, record: bytes, damage: Damage) -> bytes:
    columns = columns_read(source_name, layout)
    column = columns[damage.column % len(columns)]
    other = columns[damage.other % len(columns)]
    place = damage.other * 7 % max(1, len(record) - 1)
    if damage.kind == "flip":
        return record[:place] + bytes([damage.byte]) + record[place + 1 :]
    if damage.kind == "cut":
        return record[:place] + (b"" if layout.layout == "binary" else b"\n")
    if damage.kind == "lengthen":
        return record[:place] + damage.text.encode() + record[place:]
    if damage.kind == "join":
        return record.removesuffix(b"\n")
    if damage.kind == "repeat":
        return record * 2
    if damage.kind == "swap":
        mine, theirs = (field_of(layout, record, each) for each in (column, other))
        return with_field(layout, with_field(layout, record, column, theirs), other, mine)
    if damage.kind == "blank":
        return with_field(layout, record, column, b"")
    if layout.layout == "binary":
        return with_field(layout, record, column, packed(column, damage.number))
    return with_field(layout, record, column, damage.text.encode())


def packed(column: SourceColumn, number: float) -> bytes:
    if "i" in column.format:
        number = max(-(2**63), min(2**63 - 1024, int(np.nan_to_num(number))))
    with np.errstate(over="ignore"):
        return np.array(number).astype(column.format).tobytes()


def field_of(layout: RecordFile, record: bytes, column: SourceColumn) -> bytes:
    if layout.layout == "delimited":
        fields = record.rstrip(b"\n").split(layout.delimiter.encode())
        place = layout.columns.index(column)
        return fields[place] if place < len(fields) else b""
    first, last = column.bytes or (1, 1)
    return record[first - 1 : last]


def written(folder: Path, layout: RecordFile, *records: bytes) -> Path:
    """Write records as a file of an archive."""
    path = folder / layout.file_names[0].replace("{part}", "aaa")
    path.write_bytes(file_header(layout, len(records)) + b"".join(records))
    return path


def read_any(source_name: str, path: Path) -> tuple[int, dict[str, int], Ingested | None]:
    """Return how many records are kept, the reasons of the others, and the stars of a catalog."""
    if source_name in JOINED:
        table = read_joined(source_name, path)
        return table.kept, table.rejected, None
    read = ingest_catalog(source_name, [path], epoch_jyear=2026.0)
    return len(read.stars), read.rejected_by_reason, read


def check_archive(folder: Path, source_name: str, layout_name: str, hits: list[Damage]) -> None:
    layout = layout_of(source_name, layout_name)
    records = list(good_records(source_name, layout_name))
    for hit in hits:
        which = hit.record % len(records)
        records[which] = damaged(source_name, layout, records[which], hit)
    path = written(folder, layout, *records)
    said = ""
    try:
        check_joined(source_name, path) if source_name in JOINED else check_stars(source_name, path)
    except StarcatError as error:
        said = str(error)
    assert len(said) < 1000 + len(str(path)), "a message quotes too much of its input"


def check_stars(source_name: str, path: Path) -> None:
    read = ingest_catalog(source_name, [path], epoch_jyear=2026.0)
    assert read.rows_read == len(read.stars) + len(read.rejected)
    assert sum(read.rejected_by_reason.values()) == len(read.rejected)
    product_schema("stars").check(read.stars)
    product_schema("rejected").check(read.rejected)
    ra_deg, dec_deg = (floats_of(read.stars, name) for name in ("ra_deg", "dec_deg"))
    assert ((ra_deg >= 0.0) & (ra_deg < 360.0)).all()
    assert ((dec_deg >= -90.0) & (dec_deg <= 90.0)).all()
    length = np.linalg.norm(directions_of(read.stars), axis=1)
    np.testing.assert_allclose(length, 1.0, rtol=0, atol=1e-12)
    for name in ("mag", "second_mag", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "epoch_jyear"):
        assert not np.isinf(floats_of(read.stars, name)).any()
    assert all(len(problem) < 400 for problem in read.problems)


def read_joined(source_name: str, path: Path) -> AmplitudeTable | PairTable:
    return read_wds([path]) if source_name == "wds" else read_amplitudes(source_name, [path])


def check_joined(source_name: str, path: Path) -> None:
    read = read_joined(source_name, path)
    values = read.separation_arcsec if isinstance(read, PairTable) else read.amplitude_mag
    assert len(values) == read.kept
    assert sum(file.rows for file in read.files) == read.kept + sum(read.rejected.values())
    assert not (values < 0.0).any()
    assert not np.isinf(values).any()
    if source_name == "gcvs":
        numbers = read.keys.numbers
        assert ((numbers["hip_number"] > 0) ^ (numbers["gaia"] > 0)).all()
    elif read.keys.places is not None:
        length = np.linalg.norm(read.keys.places, axis=1)
        np.testing.assert_allclose(length[np.isfinite(length)], 1.0, rtol=0, atol=1e-12)


def run(folder: Path, source_name: str, layout_name: str, cases: int) -> None:
    check: Callable[..., None] = given(hits=st.lists(DAMAGE, min_size=1, max_size=5))(
        lambda hits: check_archive(folder, source_name, layout_name, hits)
    )
    settings(max_examples=cases, suppress_health_check=list(HealthCheck))(check)()


@pytest.mark.parametrize(("source_name", "layout_name"), TARGETS)
class TestEveryArchive:
    """Properties of each layout of each source, also of a source that comes later."""

    @pytest.fixture
    def layout(self, source_name: str, layout_name: str) -> RecordFile:
        return layout_of(source_name, layout_name)

    @pytest.fixture
    def records(self, source_name: str, layout_name: str) -> tuple[bytes, ...]:
        return good_records(source_name, layout_name)

    def test_undamaged_records_are_kept(self, tmp_path, source_name, layout_name, layout, records):
        check_archive(tmp_path, source_name, layout_name, [])
        kept, _, _ = read_any(source_name, written(tmp_path, layout, *records))
        assert kept == len(records) > 50

    def test_blocks_do_not_matter(self, tmp_path, monkeypatch, source_name, layout, records):
        path = written(tmp_path, layout, *records)
        *whole, read = read_any(source_name, path)
        monkeypatch.setattr(blocks, "BLOCK_BYTES", 2000)
        *parts, again = read_any(source_name, path)
        assert parts == whole
        assert read is None or again.stars.equals(read.stars)

    def test_stars_are_sorted_and_remember_their_line(self, tmp_path, source_name, layout, records):
        """Of the records of one star the first counts."""
        *_, read = read_any(source_name, written(tmp_path, layout, *records))
        kept, rejected, found = read_any(
            source_name, written(tmp_path, layout, *records[::-1], *records[:1])
        )
        if read is None or found is None:
            return
        assert (kept, rejected) == (len(records), {"duplicate_record": 1})
        assert found.rejected["source_line"].to_pylist() == [len(records) + 1]
        assert (np.diff(found.stars["star_id"].to_numpy()) > 0).all()
        lines = np.array([one["source_line"].to_numpy() for one in (read.stars, found.stars)])
        assert (lines.sum(axis=0) == len(records) + 1).all()

    def test_a_file_cut_off_in_its_last_line(self, tmp_path, source_name, layout, records):
        path = written(tmp_path, layout, records[0], records[1][:20])
        kept, rejected, read = read_any(source_name, path)
        assert (kept, rejected) == (1, {"malformed_record": 1})
        if read is not None:
            assert read.problems[0].startswith(f"{path.name} line 2, record: found ")
            details = [f"{path.name} {text}" for text in read.rejected["detail"].to_pylist()]
            assert details == list(read.problems)
            assert read.rejected["source_line"].to_pylist() == [2]

    def test_a_block_may_have_no_good_record(
        self, tmp_path, monkeypatch, source_name, layout, records
    ):
        monkeypatch.setattr(blocks, "BLOCK_BYTES", 600)
        bad = b"\xff" * (layout.record_bytes or 8) if layout.layout == "binary" else b"bad\n"
        kept, rejected, _ = read_any(
            source_name, written(tmp_path, layout, *records[:4], *[bad] * 9)
        )
        assert (kept, rejected) == (4, {"malformed_record": 9})

    def test_a_number_that_its_column_cannot_hold_is_malformed(
        self, tmp_path, source_name, layout, records
    ):
        for column in columns_read(source_name, layout):
            # Only errors, correlations and epochs may have any number.
            assert column.is_text or column.range or column.unit in (None, "mas", "yr", "arcsec")
            if column.is_text or column.range is None:
                continue
            if layout.layout == "binary":
                numbers = (-9e30,) if column.is_integer else (-9e30, 9e30)
                wrong = [packed(column, number) for number in numbers]
            else:
                width = len(range(*column.bytes)) + 1 if column.bytes else 20
                large = b"9E30" if width > 4 else b"9E9"
                texts = [large, b"-" + large, *([b"1.5"] * column.is_integer)]
                wrong = [text for text in texts if len(text) <= width]
            bad = [with_field(layout, records[0], column, content) for content in wrong]
            path = written(tmp_path, layout, *records[1:4], *bad)
            kept, rejected, read = read_any(source_name, path)
            expected = {"malformed_record": len(wrong)} if wrong else {}
            assert (kept, rejected) == (3, expected), column.name
            for problem in () if read is None else read.problems:
                assert f"{column.name}: found " in problem
                assert " to " in problem

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            (b"hello\n", "Is this the right archive"),
            (b"<html>\n<body>\n", "Is this the right archive"),
            (b"\x00\xff\n", "Is this the right archive"),
            (b"\n\n", "no record in the file"),
        ],
    )
    def test_another_file_is_not_taken_for_it(
        self, tmp_path, source_name, layout, records, content, words
    ):
        path = written(tmp_path, layout, *records)
        path.write_bytes(content)
        with pytest.raises(ParseError, match="begins with" if layout.magic else words) as e:
            read_any(source_name, path)
        assert (e.value.source, e.value.path) == (source_name, path)


@pytest.mark.parametrize(
    ("source_name", "layout_name"), [one for one in TARGETS if one[0] not in MADE_ONLY]
)
def test_damaged_records(tmp_path, source_name, layout_name):
    run(tmp_path, source_name, layout_name, 15)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("source_name", "layout_name"), TARGETS)
def test_many_damaged_records(tmp_path, source_name, layout_name):
    run(tmp_path, source_name, layout_name, 2000)
