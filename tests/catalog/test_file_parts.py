"""Files read one by one: the same parts in every reader, and messages about bad files."""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path

import numpy as np
import pytest
from twomass_parts import PARTS, part_bytes

from starcat.catalog.ingest import Ingested, ingest_catalog
from starcat.catalog.parts import RANGES, FileReading, check_ranges
from starcat.catalog.source import SourceColumn, data_source
from starcat.catalog.source_files import InputFile
from starcat.catalog.stars.verdict import Verdicts
from starcat.errors import ParseError, SourceError

PSC = data_source("2mass").files[0]
ROWS = 250


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Six parts of 2MASS with 250 records each, among them malformed ones."""
    folder = tmp_path_factory.mktemp("psc")
    paths = []
    for number, name in enumerate(PARTS[:6]):
        lines = part_bytes(number, ROWS, 1 + number * ROWS).splitlines(keepends=True)
        lines[100] = b"no record\n"
        lines[200] = lines[200].replace(b"|", b"|x", 1)
        path = folder / f"psc_{name}.gz"
        path.write_bytes(gzip.compress(b"".join(lines), mtime=0))
        paths.append(path)
    return paths


def same(one: Ingested, other: Ingested) -> None:
    assert one.stars.equals(other.stars)
    assert one.rejected.equals(other.rejected)
    assert one.files == other.files
    assert one.problems == other.problems
    assert one.rejected_by_reason == other.rejected_by_reason


@pytest.mark.parametrize("limit_mag", [None, 13.0])
@pytest.mark.parametrize("count", [1, 6])
def test_the_number_of_workers_does_not_matter(parts, limit_mag, count, monkeypatch):
    monkeypatch.setattr("starcat.catalog.readers.blocks.BLOCK_BYTES", 10_000)  # 30 records or so
    read = [
        ingest_catalog(
            "2mass", parts[:count], read_limit_mag=limit_mag, neighbours=False, workers=workers
        )
        for workers in (1, 3)
    ]
    assert read[0].rows_read == count * ROWS
    assert read[0].rejected_by_reason["malformed_record"] == 2 * count
    assert (read[0].beyond_read_limit > 0) == (limit_mag is not None)
    same(*read)


def test_facts_of_a_file_that_was_not_read_to_its_end(parts):
    reading = FileReading(InputFile(parts[0], PSC, "2mass"))
    next(reading.blocks())
    with pytest.raises(SourceError, match="not read to its end"):
        _ = reading.facts


@pytest.mark.parametrize("workers", [1, 2])
def test_progress_counts_bytes_within_files_and_ends_with_all(parts, tmp_path, workers):
    large = tmp_path / "psc_bbi"
    lines = gzip.decompress(parts[0].read_bytes()).splitlines(keepends=True)[:100]
    large.write_bytes(b"".join(lines) * 300)
    events: list[tuple[str, int, int | None]] = []
    ingest_catalog(
        "2mass", [*parts, large], neighbours=False, workers=workers,
        progress=lambda *event: events.append(event),
    )  # fmt: skip
    sizes = [path.stat().st_size for path in (*parts, large)]
    assert {(stage, total) for stage, _, total in events} == {("read 2mass", sum(sizes))}
    done = [event[1] for event in events]
    assert done == sorted(done)
    assert done[-1] == sum(sizes)
    within = [each for each in done if sum(sizes[:-1]) < each < sum(sizes)]
    assert len(within) > 0, "nothing was reported within the file"


@pytest.mark.parametrize("workers", [1, 2])
def test_the_error_of_the_first_bad_file_is_reported(parts, tmp_path, workers):
    copies = [Path(shutil.copy(part, tmp_path)) for part in parts]
    for bad in (2, 4):
        copies[bad].write_bytes(gzip.compress(b"1|2|3\n" * 50, mtime=0))
    with pytest.raises(ParseError, match=r"psc_aac\.gz: none of the first 50 records") as caught:
        ingest_catalog("2mass", copies, workers=workers)
    assert caught.value.path == copies[2]


def test_an_interrupted_reading_stops(parts):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ingest_catalog("2mass", parts, progress=interrupt)


@pytest.mark.parametrize("name", sorted(RANGES))
def test_the_ends_of_ranges(name):
    least, greatest = RANGES[name]
    values = np.array([least, greatest, np.nextafter(least, -np.inf), np.nextafter(greatest, 1e99)])
    columns = {"ra_deg": np.ones(4), "dec_deg": np.ones(4), "epoch_jyear": 2000.0, name: values}
    verdicts = Verdicts(4)
    check_ranges(columns, verdicts)
    assert verdicts.is_kept.tolist() == [True, True, False, False]
    assert verdicts.reasons.to_pylist() == ["impossible_value"] * 2


def test_ranges_follow_limits_then_digits_then_units():
    assert SourceColumn(name="a", format="I3", unit="h").range == (-999.0, 999.0)
    assert SourceColumn(name="a", format="I3", limits=(1, 7)).range == (1.0, 7.0)
    assert SourceColumn(name="a", format="F5.2", unit="h").range == (0.0, 24.0)
    assert SourceColumn(name="a", format="F5.2", unit="deg").range is None
    with pytest.raises(ValueError, match=r"limits \(7.0, 1.0\) are not least <= greatest"):
        SourceColumn(name="a", format="I3", limits=(7, 1))
