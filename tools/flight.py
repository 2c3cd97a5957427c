"""Frames that a sensor took of a sky in which some stars are not as the catalog has them.

    python tools/flight.py DATABASE -o frames.json

writes 500 frames along a great circle, as a camera that points away from the Earth takes them on
an orbit, and prints which stars were altered: four are fainter by 0.8 mag, four are 30 arcsec
away, two vary by up to 1 mag and two are missing. The sensor has a zero point of 0.2 mag and a
colour term of 0.30.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.database.reader import open_database_folder
from starcat.frames.calibration.answers import SkyStars
from starcat.frames.calibration.learn import sky_stars
from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import radec_from_directions
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.database import open_database
from starcat.pipeline.simulation.simulate import Noise, Sky, simulate_frame

ZERO_POINT, COLOUR_TERM = 0.2, 0.30
FAINTER_MAG, MOVED_ARCSEC, AMPLITUDE_MAG = 0.8, 30.0, 1.0
KINDS = ("too_faint",) * 4 + ("moved",) * 4 + ("variable",) * 2 + ("missing",) * 2
OFTEN = 10  # an altered star is in at least this many frames
NOISE = Noise(0.2, drop_probability=0.02, false_stars=3, noise_mag=0.1)


@dataclass(frozen=True)
class Flight:
    """Frames, and which rows of the database are altered how."""

    frames: list[MeasuredFrame]
    altered: dict[int, str]


def orbit(count: int, generator: np.random.Generator) -> list[NDArray[np.float64]]:
    """Attitudes along a great circle that is inclined by 50 deg, with any roll."""
    angle = 2.0 * np.pi * np.arange(count) / count
    tilt = np.radians(50.0)
    axis = np.column_stack(
        [np.cos(angle), np.sin(angle) * np.cos(tilt), np.sin(angle) * np.sin(tilt)]
    )
    ra, dec = radec_from_directions(axis)
    roll = generator.uniform(0.0, 360.0, count)
    return [matrix_from_radec_roll(*each) for each in zip(ra, dec, roll, strict=True)]


def fly(stars: SkyStars, camera: Camera, count: int, seed: int, noise: Noise = NOISE) -> Flight:
    """Simulate the frames of a flight."""
    generator = np.random.default_rng(seed)
    attitudes = orbit(count, generator)
    visits = np.zeros(len(stars), dtype=int)
    for matrix in attitudes:
        visits += camera.contains(camera.pixels_from_directions(stars.directions @ matrix.T))
    clearly = stars.mag < noise.limit_mag - 1.5
    often = np.flatnonzero((visits >= OFTEN) & np.isfinite(stars.colour) & clearly)
    altered = dict(
        zip(generator.choice(often, len(KINDS), replace=False).tolist(), KINDS, strict=True)
    )
    return Flight(list(_frames(stars, camera, attitudes, altered, noise, generator)), altered)


def _frames(
    stars: SkyStars,
    camera: Camera,
    attitudes: list[NDArray[np.float64]],
    altered: dict[int, str],
    noise: Noise,
    generator: np.random.Generator,
) -> Iterator[MeasuredFrame]:
    rows = {kind: [row for row, own in altered.items() if own == kind] for kind in KINDS}
    colour = np.nan_to_num(stars.colour, nan=float(np.nanmedian(stars.colour)))
    true = stars.mag + ZERO_POINT + COLOUR_TERM * colour
    true[rows["too_faint"]] += FAINTER_MAG
    directions = stars.directions.copy()
    for row in rows["moved"]:
        way = np.cross(directions[row], generator.normal(size=3))
        directions[row] += np.radians(MOVED_ARCSEC / 3600.0) * way / np.linalg.norm(way)
        directions[row] /= np.linalg.norm(directions[row])
    there = ~np.isin(np.arange(len(stars)), rows["missing"])
    for number, matrix in enumerate(attitudes):
        mag = true.copy()
        mag[rows["variable"]] += AMPLITUDE_MAG * generator.uniform(-1.0, 1.0, len(rows["variable"]))
        sky = Sky(directions[there], mag[there], np.flatnonzero(there).astype(np.int32))
        frame = simulate_frame(sky, camera, matrix, noise, generator)
        yield MeasuredFrame(f"frame {number}", frame.centroids_px, frame.mag)


def main() -> None:
    """Write the frames of a flight."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("database", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    stars, _ = sky_stars(open_database_folder(given.database))
    flight = fly(stars, open_database(given.database).camera, given.frames, given.seed)
    content = [
        {"name": one.name, "centroids_px": one.centroids_px.round(4).tolist(),
         "mag": np.asarray(one.mag).round(4).tolist()}
        for one in flight.frames
    ]  # fmt: skip
    given.output.write_text(json.dumps(content))
    for row, kind in sorted(flight.altered.items()):
        print(f"{stars.designation[row]}: {kind}")


if __name__ == "__main__":
    main()
