"""Archives at full size: synthetic files with the true layout and number of records."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import SAO_ROWS, TYCHO2_ROWS, make_sao, make_tycho2

from starcat.catalog.ingest import Ingested, ingest_catalog
from starcat.catalog.stars.star_table import directions_of
from starcat.geometry.sphere import separation

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def check_neighbours(read: Ingested) -> None:
    """Compare the nearest neighbours of some stars with a search over all."""
    u = directions_of(read.stars)
    stated = read.stars["nearest_separation_arcsec"].to_numpy()
    for row in np.random.default_rng(5).integers(len(u), size=12):
        angle = np.degrees(separation(u[row], u)) * 3600.0
        angle[row] = np.inf
        # Both are a few rounding errors of an arc of arcminutes.
        assert stated[row] == pytest.approx(angle.min(), rel=1e-9, abs=1e-7)


def test_sao(tmp_path, catalogs):
    read = ingest_catalog("sao", [make_sao(tmp_path, catalogs)], epoch_jyear=2026.0)
    assert read.rows_read == len(read.stars) == SAO_ROWS
    assert read.stars["star_id"].to_pylist() == list(range(1, SAO_ROWS + 1))
    check_neighbours(read)


def test_tycho2_in_parts_and_in_one_file(tmp_path, catalogs):
    parts = make_tycho2(tmp_path / "parts", catalogs, compress=False)
    read = ingest_catalog("tycho2", [parts], epoch_jyear=2026.0)
    number = read.stars["star_id"].to_numpy()
    assert read.rows_read == len(read.stars) == TYCHO2_ROWS
    assert [file.name for file in read.files] == [f"tyc2.dat.{part:02d}" for part in range(20)]
    assert (np.diff(number) > 0).all()
    check_neighbours(read)
    whole = tmp_path / "tyc2.dat"
    with whole.open("wb") as file:
        for part in sorted(parts.iterdir()):
            file.write(part.read_bytes())
    again = ingest_catalog("tycho2", [whole], epoch_jyear=2026.0)
    place = {"source_file", "source_line"}
    names = [name for name in again.stars.column_names if name not in place]
    assert again.stars.select(names).equals(read.stars.select(names))
