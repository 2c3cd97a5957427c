"""Bytes of onboard images against identification rate and steps.

Two databases, gaia-12deg and sao15 (sao-12deg with a field of 15 degrees), each with every image of
`IMAGES`: by profile, method and `max_bytes`. The C library identifies simulated frames with its
default options and limits in flight, without and with votes. *clean* and *hard* frames are made as
in ``starcat export --profile``: 0.5 px of noise, and in hard frames a tenth of the stars missing, 3
false spots and magnitudes with errors of 0.3. *poor* frames have 0.3 of their stars missing and 6
false spots. Frames show all stars of the database; the library gets the brightest 64 centroids.

    python benchmarks/small_images.py [--frames 1000]

It prints a Markdown table, and fails if an answer is wrong or the small profile has more than
161,000 bytes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rows import LackingError, Options, Rows, database, ended

from starcat.errors import OnboardSizeError
from starcat.matcher.c_engine import is_compiled
from starcat.pipeline.simulation.in_flight import KINDS, NOISE_PX, FlightRates, flight_rates
from starcat.pipeline.simulation.simulate import Noise
from starcat.ship.exchange.onboard import ExportedImage, export_image

MAX_BYTES = 161_000

DATABASES = {
    "gaia-12deg": ("gaia-12deg", {}),
    "sao15": ("sao-12deg", {"name": '"sao15"', "camera.fov_x_deg": "15"}),
}

IMAGES: dict[str, tuple[dict[str, Any], tuple[int | None, ...]]] = {
    "full, triangle": ({}, (None, 500_000, 300_000, MAX_BYTES)),
    "full, pyramid": ({"method": "pyramid"}, (None, 500_000, 300_000, MAX_BYTES)),
    "small": ({"profile": "small"}, (None, 140_000, 120_000, 100_000, 80_000, 65_000)),
}

HEADINGS = (
    "profile", "bytes", "stars", "features", "identified, %", "steps", "bytes for votes",
    "identified, %", "steps",
)  # fmt: skip
"""Steps are the mean and the most of the hard frames; the last three columns are with votes."""

FRAMES = {**KINDS, "poor": Noise(NOISE_PX, 0.3, 6, noise_mag=0.3)}


def images(folder: Path, place: Path) -> Iterator[tuple[str, ExportedImage]]:
    """Yield the images of a database, with names; skip an image as small as the previous image."""
    for name, (options, sizes) in IMAGES.items():
        last = None
        for size in sizes:
            try:
                image = export_image(
                    folder, "onboard", place, max_bytes=size, replace=True, **options
                )
            except OnboardSizeError:
                break
            if len(image.image.data) != last:
                yield name, image
            last = len(image.image.data)


def told(image: ExportedImage, name: str, rates: tuple[FlightRates, ...]) -> str:
    """Return a row of the table."""
    by_votes = [[one for one in rates if one.votes == votes] for votes in (False, True)]
    identified = [
        ", ".join(f"{100.0 * one.identified / one.frames:.1f}" for one in some) for some in by_votes
    ]
    steps = [
        f"{one.mean_steps:,}; {one.most_steps:,}"
        for some in by_votes
        for one in some
        if one.kind == "hard"
    ]
    fitted = image.fitted
    cells = [
        name, f"{len(image.image.data):,}", f"{fitted.stars:,}", f"{fitted.features:,}",
        identified[0], steps[0], f"{image.voting_bytes:,}", identified[1], steps[1],
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def main(rows: Rows) -> None:
    """Build, export, identify, print."""
    options = Options(__doc__)
    options.size("--frames", 1000, 30, "of each kind")
    given = options.asked()
    if not is_compiled():
        raise LackingError("the C library of the matcher, which needs a compiler")
    with tempfile.TemporaryDirectory() as scratch:
        for name, (preset, changes) in DATABASES.items():
            with rows.row(name):
                built = database(preset, Path(scratch), changes)
                print(f"\n{name}: {', '.join(FRAMES)} frames, {given.frames} of each\n")
                print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}")
                for image_name, image in images(built.folder, Path(scratch, "db.img")):
                    rates = flight_rates(image.fitted.contents, image.sky, given.frames, FRAMES)
                    print(told(image, image_name, rates), flush=True)
                    wrong = sum(one.wrong for one in rates)
                    rows.expect(wrong == 0, f"{name}, {image_name}: {wrong} wrong answers")
                    if image.profile == "small":
                        size = len(image.image.data)
                        rows.expect(
                            size <= MAX_BYTES, f"{name}: the small profile has {size:,} bytes"
                        )


if __name__ == "__main__":
    ended(main)
