"""Further attempts at an image that was not identified: with other spots of the same image.

Each attempt measures the image in another way and searches for its spots. Every search makes an
answer by chance more likely, so the bound of an answer of a further attempt is multiplied by the
number of all searches that a frame can have (`counted`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from starcat.arrays import Pixels
from starcat.matcher.options import IdentifyOptions
from starcat.matcher.result import MatchResult

DEEPER_THRESHOLD, DEEPER_SPOTS = 0.7, 100
"""Factor of the threshold of the second attempt, and most spots of attempts that measure again."""

HIGHER_THRESHOLDS = (8.0, 15.0)
BRIGHTEST = 40
"""Number of brightest spots of the first measurement that the last attempt uses."""

SAME_SPOT_PX = 0.5
"""Centroids of one spot in two measurements are nearer to each other than this."""

MAX_SEARCHES = 7
"""Number of searches whose answer can be returned: two of the first attempt, which also tries the
focal length as stated, and one of each further attempt."""


@dataclass(frozen=True)
class FurtherAttempt:
    """A further measurement of an image."""

    number: int  # 2 for the first further attempt
    words: str  # description of its spots
    threshold: float | None = None  # None: use fewer of the spots of the first measurement
    without_hot_pixels: bool = False
    without_blocks: bool = False

    def options(self, options: IdentifyOptions) -> IdentifyOptions:
        """Return the options that the image is measured with."""
        fewer = min(options.most_spots, DEEPER_SPOTS)
        return replace(options, threshold=self.threshold or options.threshold, most_spots=fewer)


def further_attempts(options: IdentifyOptions, *, is_limited: bool) -> Iterator[FurtherAttempt]:
    """Return the attempts after the first; only attempts with fewer spots if a limit ended it."""
    deeper = max(1.0, DEEPER_THRESHOLD * options.threshold)
    if not is_limited:
        yield FurtherAttempt(
            2, "a lower threshold, without hot pixels", deeper, without_hot_pixels=True
        )
    yield FurtherAttempt(
        3, "without the edges of JPEG blocks", options.threshold, without_blocks=True
    )
    for number, threshold in enumerate(HIGHER_THRESHOLDS, start=4):
        if threshold > options.threshold:
            yield FurtherAttempt(number, f"a threshold of {threshold:g} times the noise", threshold)
    if options.most_spots > BRIGHTEST:
        yield FurtherAttempt(6, f"the {BRIGHTEST} brightest spots")


def is_new(centroids_px: Pixels, searched: Sequence[Pixels]) -> bool:
    """Return whether the spots differ from the spots of all searches so far.

    Searching the same spots again would cost time and hardly give another answer.
    """
    for earlier in searched:
        if len(earlier) == len(centroids_px):
            apart_px = np.linalg.norm(earlier[:, None] - centroids_px, axis=2)
            if not (apart_px.min(axis=0, initial=np.inf) >= SAME_SPOT_PX).any():
                return False
    return True


def counted(result: MatchResult, limit: float) -> MatchResult | None:
    """Return the answer of a further attempt with its bound for all searches; None without one.

    The probability that chance agrees in any of K searches is at most the sum of all K of them.
    An answer whose bound times K is above the limit is withheld.
    """
    if not result.ok:
        return None
    chance = min(1.0, MAX_SEARCHES * result.false_match_probability)
    return replace(result, false_match_probability=chance) if chance <= limit else None
