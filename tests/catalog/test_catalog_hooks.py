"""Functions that complete the records of a map: only shipped maps may name one."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from starcat.catalog import source
from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.source import known_maps, read_source, source_given
from starcat.errors import ConfigError

MAP = """
name = "invented"
python = "invented_hook:add_zone"
frame = "ICRS"
epoch = 2000.0

[columns]
star_id = "number"
ra = { value = "ra", unit = "deg" }
dec = { value = "dec", unit = "deg" }

[magnitudes]
V = "v"
"""
TABLE = "number,ra,dec,v\n7,10.0,-89.5,3.5\n7,20.0,0.5,4.5\n"


def add_zone(records: ParsedRecords) -> ParsedRecords:
    """Number stars within their zone of declination, as the catalog does."""
    zone = np.floor(np.asarray(records["columns.dec"]) + 90.0).astype(np.int64)
    number = zone * 1_000_000 + records["columns.star_id"]
    return replace(records, columns={**records.columns, "columns.star_id": number})


def written(folder: Path) -> Path:
    (folder / "invented.csv").write_text(TABLE)
    path = folder / "invented.toml"
    path.write_text(MAP)
    return path


def test_a_shipped_map_completes_its_records_with_a_function(tmp_path, monkeypatch):
    path = written(tmp_path)
    hook = SimpleNamespace(add_zone=add_zone)
    monkeypatch.setitem(sys.modules, "invented_hook", hook)
    monkeypatch.setitem(source._registered, "invented", read_source(path))
    read = ingest_catalog("invented", [tmp_path / "invented.csv"])
    assert read.stars["star_id"].to_pylist() == [7, 90_000_007]


def test_a_map_of_a_user_or_of_a_manifest_names_no_function(tmp_path):
    path = written(tmp_path)
    with pytest.raises(ConfigError, match="only the maps that ship with starcat name a function"):
        source_given(str(path))
    table = read_source(path).table
    assert table is not None
    with pytest.raises(ConfigError, match="manifest: python"), known_maps([table.recorded()]):
        raise AssertionError
