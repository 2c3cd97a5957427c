"""Why a frame was not identified, in words, and what to try."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from starcat.geometry.camera import Camera
from starcat.matcher.chance import MIN_STARS

Reason = Literal[
    "too_few_stars", "no_candidate", "prior", "chance", "share_of_frame", "scale", "mirrored",
    "time", "steps",
]  # fmt: skip

MESSAGES: dict[Reason, str] = {
    "too_few_stars": f"fewer than {MIN_STARS} centroids of the frame are usable",
    "no_candidate": "no pattern of the frame is one of the database",
    "prior": "no attitude as near to the prior as its error says explains the frame",
    "chance": "no attitude fits better than chance",
    "share_of_frame": "the best agreement explains too little of the frame",
    "scale": "the frame is of another scale than the camera",
    "mirrored": "the frame matches only mirrored: its y counts up",
    "time": "the time limit ended the search",
    "steps": "the limit of steps ended the search",
}
"""Each reason in words."""

HINTS: dict[Reason, str] = {
    "too_few_stars": (
        "find more stars, with a longer exposure or a lower threshold, and look at 'dropped' for "
        "those that were not used"
    ),
    "no_candidate": (
        "check the field of view of the camera, try the image flipped, allow a wider tolerance "
        "of centroids, or use a database of fainter stars"
    ),
    "prior": "state a larger error of the prior (prior_error_deg), or identify without a prior",
    "chance": (
        "give magnitudes, state their noise (noise_px, noise_mag) in place of a "
        "tolerance, or find more stars; check the field of view, and try the image flipped"
    ),
    "share_of_frame": (
        "leave out centroids that are no stars, give the camera its distortion, use a database "
        "that is as deep as the frame, or ask for a smaller share (min_share)"
    ),
    "scale": "give the camera its true focal length, or allow a larger error of it (fov_error)",
    "mirrored": "turn the frame over (flip)",
    "time": (
        "allow more time (time_limit_s), give magnitudes, or leave out centroids that are no stars"
    ),
    "steps": (
        "allow more steps (max_steps), give magnitudes, or leave out centroids that are no stars"
    ),
}
"""What to try, by reason. Parameters of Python and of the service stand in brackets."""

_BRACKETS = re.compile(r"\(([a-z_]+(?:, [a-z_]+)*)\)")


def bracketed(hint: str) -> list[str]:
    """Return the parameters that a hint names.

    Examples
    --------
    >>> bracketed(HINTS["chance"])
    ['noise_px', 'noise_mag']
    """
    return [name for names in _BRACKETS.findall(hint) for name in names.split(", ")]


@dataclass(frozen=True)
class Refusal:
    """Why a frame was not identified.

    Attributes
    ----------
    reason : str
        ``too_few_stars``, ``no_candidate`` (no pattern of the frame is in the database),
        ``prior`` (no attitude near the prior explains the frame), ``chance``,
        ``share_of_frame`` and ``scale`` (why the best agreement was withheld),
        ``mirrored`` (it would be found upside down), or ``time`` and ``steps`` (the limit that
        ended the search).
    n_matched : int
        Centroids with a star in the best agreement; 0 where there was none.
    false_match_probability : float
        Bound on the probability that chance agrees as well as it; 1 where there was none.
    share : float
        Share of the frame that it explains, by weight; 0 where there was none.
    n_centroids : int
        Usable centroids of the frame; 0 where that is not known.
    camera : Camera or None
        The camera that a second look found the frame with, if there was one.
    focal_error : float or None
        By how much its focal length is longer than stated, relative.
    flip : bool or None
        Whether the caller stated that the frame is turned over (``flip``); None without a
        statement. It changes the words about a mirrored frame.
    """

    reason: Reason
    n_matched: int = 0
    false_match_probability: float = 1.0
    share: float = 0.0
    n_centroids: int = 0
    camera: Camera | None = None
    focal_error: float | None = None
    flip: bool | None = None

    @property
    def message(self) -> str:
        """The reason as a sentence begins, with the numbers of the best agreement."""
        text = MESSAGES[self.reason]
        if self.reason == "mirrored" and self.flip:
            text = "the frame matches only mirrored: it was turned over, and was upright before"
        if self.focal_error is not None:
            longer = "longer" if self.focal_error > 0.0 else "shorter"
            text = f"the focal length is {abs(self.focal_error):.1%} {longer} than stated"
        if self.n_matched == 0:
            return text
        of_all = f" of {self.n_centroids}" if self.n_centroids else ""
        best = f"best: {self.n_matched}{of_all} centroids"
        if self.false_match_probability < 1.0:
            best += f", chance {self.false_match_probability:.1e}"
            best += f", {self.share:.0%} of the frame" if self.share else ""
        return f"{text} ({best})"

    @property
    def hint(self) -> str:
        """What to try."""
        if self.reason == "mirrored" and self.flip is not None:
            return "leave this option out (flip)"
        if self.focal_error is None or self.camera is None:
            return HINTS[self.reason]
        return (
            f"describe the camera with {self.camera.focal_length_px:.1f} px "
            f"({self.camera.fov_x_deg:.2f} deg across), or allow a larger error (fov_error)"
        )

    @property
    def fields(self) -> tuple[str, ...]:
        """Parameters that the hint names."""
        return tuple(bracketed(self.hint))

    def __repr__(self) -> str:
        return f"<Refusal {self.reason}: {self.message}>"
