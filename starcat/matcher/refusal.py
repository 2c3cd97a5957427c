"""Why a frame got no answer: the best agreement that was withheld, and what to try."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from starcat.matcher.chance import MIN_STARS

Reason = Literal[
    "too_few_stars", "no_candidate", "chance", "share_of_frame", "scale", "time", "steps"
]

WORDS: dict[Reason, str] = {
    "too_few_stars": f"fewer than {MIN_STARS} spots of the frame are usable",
    "no_candidate": "no pattern of the frame is one of the database",
    "chance": "chance would agree as well",
    "share_of_frame": "the best agreement explains too little of the frame",
    "scale": "the frame is of another scale than the camera",
    "time": "the time limit ended the search",
    "steps": "the limit of steps ended the search",
}
"""Each reason in words."""

ADVICE: dict[Reason, str] = {
    "too_few_stars": (
        "find more spots, with a longer exposure or a lower threshold, and look at 'dropped' for "
        "those that were not used"
    ),
    "no_candidate": (
        "check the field of view of the camera, try the image flipped, allow a wider tolerance "
        "of centroids, or use a database of fainter stars"
    ),
    "chance": (
        "give brightnesses of the spots, state their noise (noise_px, noise_mag) in place of a "
        "tolerance, or find more spots; check the field of view, and try the image flipped"
    ),
    "share_of_frame": (
        "leave out spots that are no stars, give the camera its distortion, use a database that "
        "is as deep as the frame, or ask for a smaller share (min_share, --min-share)"
    ),
    "scale": (
        "give the camera its true focal length, or allow an error of it (fov_error, --fov-error)"
    ),
    "time": "allow more time, give brightnesses of the spots, or leave out spots that are no stars",
    "steps": (
        "allow more steps, give brightnesses of the spots, or leave out spots that are no stars"
    ),
}
"""What to try, by reason."""


@dataclass(frozen=True)
class Refusal:
    """Why a frame was not identified.

    Attributes
    ----------
    reason : str
        ``too_few_stars``, ``no_candidate`` (no pattern of the frame is in the database),
        ``chance``, ``share_of_frame`` and ``scale`` (why the best agreement was withheld), or
        ``time`` and ``steps`` (the limit that ended the search).
    n_matched : int
        Centroids with a star in the best agreement; 0 where there was none.
    false_match_probability : float
        Bound on the probability that chance agrees as well as it; 1 where there was none.
    share : float
        Share of the frame that it explains, by weight; 0 where there was none.
    """

    reason: Reason
    n_matched: int = 0
    false_match_probability: float = 1.0
    share: float = 0.0

    @property
    def words(self) -> str:
        """The reason as a sentence begins, with the numbers of the best agreement."""
        text = WORDS[self.reason]
        if self.n_matched == 0:
            return text
        chance, share = self.false_match_probability, self.share
        best = f"best agreement: {self.n_matched} spots, chance {chance:.1e}"
        return f"{text} ({best}, {share:.0%} of the frame)" if share else f"{text} ({best})"

    @property
    def advice(self) -> str:
        """What to try."""
        return ADVICE[self.reason]

    def __repr__(self) -> str:
        """Return the reason in one line."""
        return f"<Refusal {self.reason}: {self.words}>"
