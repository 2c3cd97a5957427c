"""Fixed-width catalogs against astropy: every number of every record is the same float.

Both parsers get their byte ranges from the column table. Some ranges are written out here
too, as the archives' ReadMe files print them, so that the table itself is checked.
"""

from __future__ import annotations

import gzip
import itertools
from pathlib import Path

import numpy as np
import pytest
from astropy.io import ascii as astropy_ascii
from astropy.table import Table
from numpy.typing import NDArray

from starcat.catalog.readers.fixed_width import parse_fixed_width
from starcat.catalog.source import RecordFile, data_source

READ_ME = {
    "hip_main": {
        "hip": (9, 14), "v_mag": (42, 46), "ra_deg": (52, 63), "de_deg": (65, 76),
        "plx": (80, 86), "pm_ra": (88, 95), "pm_de": (97, 104), "bt_mag": (218, 223),
        "vt_mag": (231, 236), "b_v": (246, 251), "hp_mag": (275, 281), "hp_max": (302, 306),
        "hp_min": (308, 312), "rho": (360, 366), "dhp": (374, 378), "hd": (391, 396),
    },
    "sao": {
        "sao": (1, 6), "p_mag": (77, 80), "v_mag": (81, 84), "r_vmag": (88, 89), "rem": (95, 95),
        "hd": (118, 123), "ra2000_h": (151, 152), "ra2000_m": (153, 154), "ra2000_s": (155, 160),
        "pm_ra2000": (161, 167), "de2000_d": (169, 170), "de2000_m": (171, 172),
        "de2000_s": (173, 177), "pm_de2000": (178, 183), "ra2000_rad": (184, 193),
        "de2000_rad": (194, 204),
    },
    "tyc_main": {
        "tyc1": (3, 6), "tyc2": (8, 12), "tyc3": (14, 14), "v_mag": (42, 46), "ra_deg": (52, 63),
        "de_deg": (65, 76), "pm_ra": (88, 95), "pm_de": (97, 104), "bt_mag": (218, 223),
        "vt_mag": (231, 236), "q": (261, 261), "vt_max": (280, 284), "vt_min": (286, 290),
        "hd": (310, 315),
    },
    "tyc2": {
        "tyc1": (1, 4), "tyc2": (6, 10), "tyc3": (12, 12), "ra_mean_deg": (16, 27),
        "de_mean_deg": (29, 40), "pm_ra": (42, 48), "pm_de": (50, 56), "bt_mag": (111, 116),
        "vt_mag": (124, 129), "prox": (137, 139), "hip": (143, 148), "ra_deg": (153, 164),
        "de_deg": (166, 177), "ep_ra_1990": (179, 182), "ep_de_1990": (184, 187),
    },
}  # fmt: skip

CASES = [
    ("hipparcos", "hip_main", "hip_main.dat.gz", None),
    ("sao", "sao", "sao.dat.gz", None),
    ("tycho1", "tyc_main", "tyc_main.dat.gz", 5_000),
    ("tycho2", "tyc2", "tyc2.dat.gz", 5_000),
]


def read_lines(path: Path, count: int | None) -> list[str]:
    with gzip.open(path, "rt", encoding="ascii") as file:
        return [line.rstrip("\n") for line in itertools.islice(file, count)]


def numeric_ranges(layout: RecordFile) -> dict[str, tuple[int, int]]:
    return {c.name: c.bytes for c in layout.columns if c.bytes and not c.is_text}


def astropy_columns(
    lines: list[str], ranges: dict[str, tuple[int, int]]
) -> dict[str, NDArray[np.float64]]:
    """The same fields as astropy reads them, NaN where blank."""
    table: Table = astropy_ascii.read(
        lines,
        format="fixed_width_no_header",
        names=list(ranges),
        col_starts=[first - 1 for first, _ in ranges.values()],
        col_ends=[last - 1 for _, last in ranges.values()],
        converters={"*": [astropy_ascii.convert_numpy(float)]},
        fill_values=[("", "nan")],
        guess=False,
    )
    return {name: np.ma.filled(table[name].astype(float), np.nan) for name in ranges}


@pytest.mark.parametrize(("source", "name", "path", "count"), CASES)
def test_every_number_is_the_one_that_astropy_reads(
    catalogs: Path, source: str, name: str, path: str, count: int | None
) -> None:
    (layout,) = (file for file in data_source(source).files if file.name == name)
    lines = read_lines(catalogs / path, count)
    assert len(numeric_ranges(layout)) > 25
    for ranges in (numeric_ranges(layout), READ_ME[name]):
        ours = parse_fixed_width("\n".join(lines).encode(), layout, list(ranges))
        theirs = astropy_columns(lines, ranges)
        assert len(ours) == len(lines) > 4_000
        assert sum(np.isfinite(values).any() for values in theirs.values()) >= 12
        for column, expected in theirs.items():
            for null in layout.column(column).null:
                expected[expected == float(null)] = np.nan
            np.testing.assert_array_equal(ours[column], expected, err_msg=column, strict=True)
