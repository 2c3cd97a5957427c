"""Draw the pictures of README.md: ``python tests/builders/pictures.py [gaia-12deg artifact]``.

Without an artifact one is built from the embedded sky. The map is the one of the build's own
report, the field what ``starcat identify --picture`` draws.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from starcat.images.picture import draw
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.matcher import Matcher
from starcat.pipeline.build import build
from starcat.simulation.simulate import Noise, simulate_frames
from starcat.specs.reading import preset

FIGURES = Path(__file__).parents[2] / "docs" / "figures"
NAME, SEED = "orion", 552
"""A seed whose attitude has Orion upright in the frame."""
NOISE = Noise(0.5, false_stars=3)


def draw_coverage(artifact: Path, folder: Path) -> None:
    shutil.copyfile(artifact / "report" / "coverage_map.svg", folder / "coverage.svg")


def draw_field(artifact: Path, folder: Path) -> None:
    matcher = Matcher.open(artifact, None)
    database = matcher.database
    sky, camera = database.directions, database.camera
    frame = next(simulate_frames(sky, camera, 1, NOISE, SEED, database.mag))
    mag = np.round(frame.mag, 2)
    measured = MeasuredFrame(NAME, frame.centroids_px, mag)
    result = matcher.identify(frame.centroids_px, magnitudes=mag)
    draw(folder / "identified.png", measured, None, result, database, camera)


def main() -> None:
    """Write both pictures."""
    with tempfile.TemporaryDirectory() as scratch:
        given = sys.argv[1:]
        artifact = (
            Path(given[0]) if given else build(preset("gaia-12deg"), {}, Path(scratch)).folder
        )
        draw_coverage(artifact, FIGURES)
        draw_field(artifact, FIGURES)
    sys.stderr.write("wrote coverage.svg and identified.png in docs/figures/\n")


if __name__ == "__main__":
    main()
