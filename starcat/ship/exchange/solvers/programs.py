"""Solvers whose own programs write the files: tetra3rs, and the indexes of astrometry.net."""

from __future__ import annotations

import math
import shutil
import struct
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from starcat.errors import ConfigError, OutputError
from starcat.ship.exchange.solvers.sky import SolverSky

_SCALE_STEP = math.sqrt(2.0)
_SMALLEST, _LARGEST = 0.2, 0.7
"""Longest sides of groups of four stars, in units of the narrowest and widest field of view."""
_ARCMIN_PER_NSIDE = 3517.9
"""Side of a cell of HEALPix with nside 1; cells are as large as the smallest group of four."""


def write_tetra3rs(sky: SolverSky, path: Path) -> dict[str, Any]:
    """Run tetra3rs to make its database from the stars; return its figures."""
    try:
        import tetra3rs
    except ImportError as error:
        raise ConfigError(
            "tetra3rs writes its own files and is not installed: python -m pip install tetra3rs",
            key="to",
        ) from error
    fields = [("id", "<i8"), ("radec", "<f8", 2), ("mag", "<f4"), ("motion", "<f4", 2)]
    stars = np.zeros(len(sky.mag), dtype=fields)
    stars["id"], stars["mag"] = sky.star_id, sky.mag
    stars["radec"] = np.stack([sky.ra_deg, sky.dec_deg], axis=-1)
    with tempfile.TemporaryDirectory() as folder:
        catalog = Path(folder, "stars.bin")
        catalog.write_bytes(b"GDR3" + struct.pack("<IQ", 1, len(stars)) + stars.tobytes())
        # Positions are already at the database's epoch.
        solver_database = tetra3rs.SolverDatabase.generate_from_gaia(
            str(catalog),
            max_fov_deg=sky.fov_deg[1],
            min_fov_deg=sky.fov_deg[0],
            star_max_magnitude=float(sky.mag[-1]) + 0.01,
            epoch_proper_motion_year=None,
        )
    solver_database.save_to_file(str(path))
    return {"patterns": solver_database.num_patterns}


def write_astrometry_net(sky: SolverSky, folder: Path) -> dict[str, Any]:
    """Run build-astrometry-index for each size of groups of four; return the indexes' figures."""
    from astropy.io import fits

    program = shutil.which("build-astrometry-index")
    if program is None:
        raise ConfigError(
            "build-astrometry-index of astrometry.net writes its indexes and is not on the PATH",
            key="to",
            hint="on Debian: apt install astrometry.net",
        )
    folder.mkdir()
    smallest, largest = 60.0 * _SMALLEST * sky.fov_deg[0], 60.0 * _LARGEST * sky.fov_deg[1]
    steps = math.ceil(math.log(largest / smallest) / math.log(_SCALE_STEP))
    with tempfile.TemporaryDirectory() as work:
        stars = Path(work, "stars.fits")
        columns = [
            fits.Column("RA", "D", array=sky.ra_deg, unit="deg"),
            fits.Column("DEC", "D", array=sky.dec_deg, unit="deg"),
            fits.Column("MAG", "E", array=sky.mag, unit="mag"),
            fits.Column("STAR_ID", "K", array=sky.star_id),
        ]
        fits.BinTableHDU.from_columns(columns).writeto(stars)
        for step in range(steps):
            least = smallest * _SCALE_STEP**step
            sizes = ("-l", f"{least:.4f}", "-u", f"{least * _SCALE_STEP:.4f}")
            cells = ("-N", str(max(1, round(_ARCMIN_PER_NSIDE / least))))
            index = folder / f"index-{sky.name}-{step:02d}.fits"
            number = str(int(sky.manifest_sha256[:6], 16) * 100 + step)
            _run(
                program, "-i", str(stars), "-o", str(index), *sizes, *cells, "-S", "MAG", "-D",
                "DEC", "-E", "-M", "-I", number, "-t", work,
            )  # fmt: skip
    return {"indexes": steps, "smallest_arcmin": round(smallest), "largest_arcmin": round(largest)}


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        last_lines = (done.stderr or done.stdout).strip().splitlines()[-1:]
        raise OutputError(f"{Path(command[0]).name} failed ({''.join(last_lines)})", path=None)
