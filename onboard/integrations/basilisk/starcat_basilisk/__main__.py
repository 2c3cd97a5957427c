# SPDX-License-Identifier: MIT
"""Fly one orbit and print the results of its frames: `python -m starcat_basilisk IMAGE`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from Basilisk.architecture.bskLogging import BasiliskError

from starcat_basilisk.results import content_of, drawing_of, flight_of, rows_of, table_of
from starcat_basilisk.scenario import SEED, simulate, the_orbit

LONGEST_MIN = 1440.0
LARGEST_SEED = 2**32 - 2  # Basilisk's seeds have 32 bits; gyro and orbit use the next two


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return 1 if an attitude was wrong."""
    reader = argparse.ArgumentParser(prog="python -m starcat_basilisk", description=__doc__)
    reader.add_argument("image", type=Path, help="file of: starcat export DATABASE --to onboard")
    reader.add_argument("--output", type=Path, help="folder for table, figures and drawing")
    reader.add_argument("--minutes", type=float, help="of the orbit; all of it by default")
    reader.add_argument("--seed", type=int, default=SEED, help="of noise and dropped frames")
    reader.add_argument(
        "--without-prior", action="store_true", help="identify each frame as if lost in space"
    )
    given = reader.parse_args(arguments)
    if not given.image.is_file():
        reader.error(
            f"{given.image} is not there; write one with "
            "starcat export DATABASE --to onboard -o FILE"
        )
    minutes = the_orbit().period_min if given.minutes is None else given.minutes
    if not 0.0 < minutes <= LONGEST_MIN:
        reader.error(f"--minutes is {minutes:g}; expected a number above 0, to {LONGEST_MIN:g}")
    if not 0 <= given.seed < LARGEST_SEED:
        reader.error(f"--seed is {given.seed}; expected a number from 0, below {LARGEST_SEED:,}")
    try:
        orbit, records, tracker = simulate(
            given.image, minutes, given.seed, with_prior=not given.without_prior
        )
    except BasiliskError as error:
        reader.error(str(error))
    flight = flight_of(orbit, records)
    scale_arcsec = np.degrees(1.0 / tracker.focalLength()) * 3600.0
    rows = rows_of(orbit, flight, scale_arcsec, tracker.cornerAngle())
    table = table_of(rows)
    sys.stdout.write(table)
    if given.output is not None:
        given.output.mkdir(parents=True, exist_ok=True)
        (given.output / "closed_loop.md").write_text(table, encoding="utf-8")
        text = json.dumps(content_of(rows), indent=1) + "\n"
        (given.output / "closed_loop.json").write_text(text, encoding="utf-8")
        (given.output / "closed_loop.svg").write_bytes(drawing_of(orbit, flight))
    return 1 if rows[-1].wrong else 0


if __name__ == "__main__":
    sys.exit(main())
