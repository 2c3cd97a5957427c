"""The options of an identification: the range and the description of each, for all interfaces.

Python, the command line, the REST interface and the forms of the service read this table. It
imports nothing, so that ``starcat --help`` stays fast. Descriptions name other options as Python
does; the command line replaces these names by its own.
"""

from __future__ import annotations

import math
from typing import NamedTuple


class Option(NamedTuple):
    """The description of an option, and the range of its numbers; both ends are included."""

    description: str
    low: float = -math.inf
    high: float = math.inf

    @property
    def range_words(self) -> str:
        """The range as the end of the sentence "expected ...".

        Examples
        --------
        >>> OPTIONS["tolerance_px"].range_words, OPTIONS["max_steps"].range_words
        ('0.001 to 200', 'a number, at least 1')
        """
        if self.high == math.inf:
            return f"a number, at least {self.low:g}"
        return f"{self.low:g} to {self.high:g}"


OPTIONS = {
    "method": Option("See 'starcat methods'; default: the best available method."),
    "tolerance_px": Option("Largest error of a centroid; default: 2.", 0.001, 200),
    "noise_px": Option("Noise of a centroid, each axis; instead of tolerance_px.", 0.001, 50),
    "noise_mag": Option("Noise of magnitudes in the database's band.", 0.0001, 10),
    "max_false_match_probability": Option("Answers less certain than this are withheld.", 0, 1),
    "min_share": Option(
        "Smallest share of the frame that an answer explains; default: none is required.", 0, 1
    ),
    "camera_error": Option(
        "Largest error of the camera at the corners, as a share of the half diagonal; default: "
        "wide ranges of the frame's shape.",
        1e-6,
        0.1,
    ),
    "max_steps": Option(
        "Candidates that the numpy matcher may compare, 2 to 20 microseconds each; default: "
        "100,000. Not for an onboard image, which counts other steps.",
        1,
    ),
    "time_limit_s": Option("Time limit per frame, seconds.", 1e-6),
    "fov_error": Option("Largest error of the field of view; default: 5 %.", 0, 0.5),
    "fov_deg": Option("Field across the width instead of the camera's, degrees; or its range."),
    "size_px": Option("Size of a frame of centroids, such as 1280x960; with fov_deg."),
    "prior_q": Option("Expected attitude, q_body_from_icrs: only stars near it are compared."),
    "prior_error_deg": Option("Largest error of prior_q, degrees.", 1e-9, 20),
    "flip": Option("First row at the bottom; y upwards."),
    "time": Option("Time, such as 2026-11-22T10:00:00 (UTC): aberration, planets."),
    "psf_sigma_px": Option("Width (sigma) of a star in an image; default: measured.", 0.3, 20),
    "threshold": Option("Smallest signal-to-noise ratio of a spot.", 1, 1000),
    # Measured: spots beyond the brightest 200 identify no further picture, and cost time.
    "most_spots": Option("Use this many of the brightest spots.", 4, 10_000),
    "plane": Option("Plane of a FITS cube, from 0; default: colours combined.", 0),
    "bayer": Option("The image is a raw colour mosaic, in any order."),
}
"""Options by the name of the parameter in Python and REST."""

SIMULATED = {
    "noise_px": Option("Noise of a centroid, each axis.", 0, 50),
    "noise_mag": Option("Noise of a magnitude.", 0, 10),
    "drop_probability": Option("Probability that a star is missing.", 0, 1),
}
"""Options of simulated frames, by the name of the parameter."""
