"""A generated folder of catalogs for machines without excerpts: the same file names, other stars.

Positions, magnitudes and colours come from the embedded sky of Gaia, so that clusters, gaps and
poles are in their true places. Proper motions, doubles, variables and star numbers are random,
except the Hipparcos numbers of the brightest stars and Polaris (SAO 308). The Hipparcos, FK5 and
SKY2000 files name the same stars, so that they can be identified with each other.
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from itertools import islice
from pathlib import Path

import erfa
import numpy as np
from archives import Sky, archive_records, file_header, hms
from genuine_records import PSC, SUPPL_1, TYC2, TYC_MAIN

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.source import RecordFile, data_source

FAINT_LIMIT_MAG = 6.5

POLARIS = (308, 37.9546, 89.2641)
"""SAO number and rough position, degrees."""

FAST_STARS, FAST_MAS_YR = 60, 1500.0

NO_POSITION = 5
"""Stars of Hipparcos without an astrometric solution; the first one has no magnitude either."""

SOLUTION = ("ra_deg", "de_deg", "pm_ra", "pm_de")

PRINTED_ONLY = (208759, 208795, 212470)
"""SAO numbers whose proper motion is only in the printed catalog."""


def bright_sky(faint_limit_mag: float = FAINT_LIMIT_MAG, seed: int = 1) -> Sky:
    """Return the stars of the embedded sky to a V magnitude, by right ascension."""
    layout = data_source("gaia").main_file
    kinds = np.dtype([(column.name, column.format) for column in layout.columns])
    gaia = np.frombuffer(embedded_sky().read_bytes(), kinds, offset=layout.header_bytes)
    has_colour = (gaia["bp_mag"] > 0) & (gaia["rp_mag"] > 0)
    c = np.where(has_colour, gaia["bp_mag"] - gaia["rp_mag"], 0.8).astype(float)
    # Gaia DR3's documentation, section 5.5.1, table 5.9: G - V from BP - RP.
    v_mag = gaia["mag_g"] + 0.02704 - 0.01424 * c + 0.2156 * c**2 - 0.01426 * c**3
    order = np.argsort(gaia["ra_deg"], kind="stable")
    order = order[v_mag[order] <= faint_limit_mag]
    gaia, generator, count = gaia[order], np.random.default_rng(seed), len(order)
    pm_ra, pm_dec = np.round(generator.laplace(0.0, 40.0, (2, count)), 1)
    fast = generator.choice(count, FAST_STARS, replace=False)
    turn = generator.uniform(0.0, 2.0 * np.pi, FAST_STARS)
    pm_ra[fast], pm_dec[fast] = np.round(FAST_MAS_YR * np.array([np.cos(turn), np.sin(turn)]), 1)
    known = gaia["source_id"] < 0
    free = np.setdiff1d(np.arange(1, 118_323), -gaia["source_id"][known])
    hip = np.where(known, -gaia["source_id"], generator.choice(free, count, replace=False))
    others = np.setdiff1d(np.arange(1, 258_997), [POLARIS[0], *PRINTED_ONLY])
    sky = Sky(
        ra_deg=gaia["ra_deg"],
        dec_deg=gaia["dec_deg"],
        pm_ra_cosdec_mas_yr=pm_ra,
        pm_dec_mas_yr=pm_dec,
        v_mag=v_mag[order],
        b_v=np.clip(c[order] / 1.25, -0.3, 2.0),
        rho_arcsec=np.where(generator.random(count) < 0.06, generator.uniform(0.1, 9.0, count), 0),
        amplitude_mag=np.where(
            generator.random(count) < 0.05, generator.exponential(0.3, count), 0
        ),
        hip=hip,
        hd=1 + generator.permutation(359_083)[:count],
        sao=generator.choice(others, count, replace=False),
        gaia_id=np.where(known, 10**17 + hip, gaia["source_id"]),
    )
    number, ra_deg, dec_deg = POLARIS
    polaris = np.argmin(np.hypot(sky.ra_deg - ra_deg, sky.dec_deg - dec_deg))
    sky.sao[polaris], sky.rho_arcsec[polaris], sky.amplitude_mag[polaris] = number, 5.0, 0.1
    sky.pm_ra_cosdec_mas_yr[polaris], sky.pm_dec_mas_yr[polaris] = 44.2, -11.7
    # `sky` is the sky of J2016; 16 years back it is the sky of J2000.
    return sky.at(2000.0 - 16.0)


def write_catalog_folder(folder: Path) -> None:
    """Write the files that stand in for the excerpts."""
    sky = bright_sky()
    bright_in_k = sky.where(np.flatnonzero(sky.v_mag - 2.2 * sky.b_v <= 4.4))
    files = {
        "sao.dat.gz": archive_records("sao", sky)["sao"],
        "hip_main.dat.gz": _without_solution(archive_records("hipparcos", sky)["hip_main"]),
        "tyc_main.dat.gz": archive_records("tycho1", sky)["tyc_main"],
        "tyc2.dat.gz": archive_records("tycho2", sky)["tyc2"],
        "psc_estimated.gz": archive_records("2mass", sky)["psc"],
        "psc_measured.gz": archive_records("2mass", bright_in_k)["psc"],
        "gcvs.tsv.gz": [
            file_header(data_source("gcvs").files[0], 0), *archive_records("gcvs", sky)["gcvs"]
        ],
        "wds_hip.dat.gz": [
            file_header(data_source("wds").files[0], 0), *archive_records("wds", sky)["wds_hip"]
        ],
        "sky2000_v6.5.edb.gz": _sky2000(sky.where(np.arange(len(sky)) % 4 == 0)),
    }  # fmt: skip
    (folder / "samples").mkdir(parents=True, exist_ok=True)
    for name, lines in files.items():
        (folder / name).write_bytes(gzip.compress(b"".join(lines), 6, mtime=0))
    fk5 = _fk5_index(sky.where(np.arange(len(sky)) % 6 == 0))
    (folder / "fk5_sao_cross_index.txt").write_bytes(b"".join(fk5))
    for name, lines in {
        "tycho1_I239_records.txt": TYC_MAIN,
        "tycho2_I259_records.txt": TYC2,
        "tycho2_I259_suppl_records.txt": SUPPL_1,
        "twomass_psc_record.txt": [PSC],
    }.items():
        (folder / "samples" / name).write_bytes(b"\n".join(lines) + b"\n")


def _patched(line: bytes, layout: RecordFile, fields: Mapping[str, str]) -> bytes:
    edited = bytearray(line)
    for name, text in fields.items():
        first, last = layout.column(name).bytes or (1, 0)
        edited[first - 1 : last] = text.rjust(last - first + 1).encode()
    return bytes(edited)


def _without_solution(lines: list[bytes]) -> list[bytes]:
    """Leave a few stars of Hipparcos without a solution."""
    layout, nothing = data_source("hipparcos").files[0], dict.fromkeys(SOLUTION, "")
    rows = range(len(lines) // 20, len(lines), len(lines) // NO_POSITION)
    for number, row in enumerate(islice(rows, NO_POSITION)):
        fields = nothing if number else {**nothing, "v_mag": ""}
        lines[row] = _patched(lines[row], layout, fields)
    return lines


def _fk5_index(sky: Sky) -> list[bytes]:
    """Stars with FK5 positions of J2000, SAO and HD numbers, in the columns of CDS IV/22."""
    rad_yr = np.radians(1.0 / 3.6e6)
    ra, dec = np.radians(sky.ra_deg), np.radians(sky.dec_deg)
    motion = sky.pm_ra_cosdec_mas_yr * rad_yr / np.cos(dec), sky.pm_dec_mas_yr * rad_yr
    ra, dec, *_ = erfa.h2fk5(ra, dec, *motion, 0.1, 0.0)
    lines = []
    places = zip(*(values.tolist() for values in hms(*np.degrees([ra, dec]))), dec, strict=True)
    for row, (ms, cas, d) in enumerate(places):
        text = (
            f"{row + 1:4d}{ms // 3_600_000:4d}{ms // 60_000 % 60:3d}{ms % 60_000 / 1000:7.3f}"
            f"         {'-' if d < 0 else '+'}{cas // 360_000:2d}{cas // 6_000 % 60:3d}"
            f"{cas % 6_000 / 100:6.2f}"
        )
        names = f"CP-77 1596{sky.sao[row]:7d} {sky.hd[row]:06d}\n"
        lines.append((text.ljust(68) + names).encode())
    return lines


def _sky2000(sky: Sky) -> list[bytes]:
    """Stars with their names in SAO and HD, as the lines of XEphem begin."""
    numbers = zip(sky.sao.tolist(), sky.hd.tolist(), strict=True)
    lines = [f"SAO {sao}|HD {hd},f|S|A0,0:00:00.0,0:00:00.0,6.0,2000\n" for sao, hd in numbers]
    return [b"# stars that do not exist\n", *(line.encode() for line in lines)]
