"""Why a frame was not identified, and what to try that the caller has not tried yet."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from starcat.errors import advice_in_words
from starcat.geometry.camera import Camera
from starcat.matcher.chance import MIN_STARS

Reason = Literal[
    "too_few_stars", "no_candidate", "prior", "chance", "share_of_frame", "scale", "other_field",
    "mirrored", "exchanged", "time", "steps", "few_guide_stars",
]  # fmt: skip

Fact = Literal[
    "magnitudes", "noise_mag", "noise_px", "dropped", "explained", "picture", "bright_picture",
    "range",
]  # fmt: skip
"""Facts that decide which advice a hint gives: inputs that the caller gave, attempts made."""

MESSAGES: dict[Reason, str] = {
    "too_few_stars": f"fewer than {MIN_STARS} centroids of the frame are usable",
    "no_candidate": "no pattern of the frame is in the database",
    "prior": "no attitude within the stated error of the prior explains the frame",
    "chance": "no attitude fits better than chance",
    "share_of_frame": "the best agreement does not determine the whole frame",
    "scale": "the scale or the shape of the frame is out of range",
    "other_field": "the frame fits another field of view",
    "mirrored": "the frame matches only mirrored: its y counts up",
    "exchanged": "the frame matches only with x and y exchanged",
    "time": "the time limit ended the search",
    "steps": "the limit of steps ended the search",
    "few_guide_stars": "the database has too few stars for so narrow a field",
}
"""Each reason in words."""


@dataclass(frozen=True)
class Clause:
    """One piece of advice, and its conditions."""

    text: str
    unless: Fact | None = None
    only_if: Fact | None = None


def stated_facts(
    has_magnitudes: bool, noise_px: float | None, noise_mag: float | None, has_dropped: bool
) -> frozenset[Fact]:
    """Return the inputs that the caller of a search has given."""
    stated: dict[Fact, bool] = {
        "magnitudes": has_magnitudes,
        "noise_px": noise_px is not None,
        "noise_mag": noise_mag is not None,
        "dropped": has_dropped,
    }
    return frozenset(name for name, is_stated in stated.items() if is_stated)


_MAGNITUDES = Clause("give magnitudes", unless="magnitudes")
_FALSE_STARS = Clause("leave out centroids that are not stars")
_FIELD = Clause("check the field of view and the size of the camera ({camera})")
_EXPLAIN = Clause(
    "have other fields and the mirrored frame tried: {explain:True}", unless="explained"
)

CLAUSES: dict[Reason, tuple[Clause, ...]] = {
    "too_few_stars": (
        Clause("find more stars, with a longer exposure or a lower threshold"),
        Clause("see 'dropped' for the centroids that were not used", only_if="dropped"),
    ),
    "no_candidate": (
        _FIELD,
        Clause("allow a wider tolerance of centroids ({tolerance_px})"),
        Clause("use a database of fainter stars"),
        _EXPLAIN,
    ),
    "prior": (
        Clause("state a larger error of the prior ({prior_error_deg})"),
        Clause("identify without a prior"),
    ),
    "chance": (
        _MAGNITUDES,
        Clause(
            "state the noise of magnitudes ({noise_mag})", unless="noise_mag", only_if="magnitudes"
        ),
        Clause(
            "state the noise of centroids in place of a tolerance ({noise_px})", unless="noise_px"
        ),
        _FIELD,
        Clause("find more stars"),
        _EXPLAIN,
    ),
    "share_of_frame": (
        _FALSE_STARS,
        Clause("give the camera its distortion"),
        Clause("use a database that is as deep as the frame"),
        Clause("find more stars, far from each other"),
    ),
    "scale": (
        Clause("give the camera its true focal length"),
        Clause("allow a larger error of it ({fov_error})"),
    ),
    "other_field": (
        Clause("state the field that fits ({fov_deg})"),
        Clause("build a database for it"),
    ),
    "mirrored": (Clause("turn the frame over ({flip})"),),
    "exchanged": (Clause("give x, to the right, first and y, down, second"),),
    "time": (Clause("allow more time ({time_limit_s})"), _MAGNITUDES, _FALSE_STARS),
    "steps": (Clause("allow more steps ({max_steps})"), _MAGNITUDES, _FALSE_STARS),
    "few_guide_stars": (
        Clause("use a database that is built for such a field, of a catalog with fainter stars"),
        Clause("state the true field if it is wider ({fov_deg})"),
    ),
}
"""Advice by reason. Parameters stand in braces."""


_PICTURE = (
    Clause("state the range of the field of view across the width ({fov_deg})", unless="range"),
    Clause("state a wider range of the field of view ({fov_deg})", only_if="range"),
    Clause("turn the picture over ({flip})"),
    Clause("cut lights, clouds and the ground off"),
    Clause("allow a wider tolerance for a lens that distorts ({tolerance_px})"),
)

CLAUSES_OF_PICTURES: dict[Reason, tuple[Clause, ...]] = {
    "too_few_stars": (
        Clause(
            "use a shorter exposure, or invert the picture if it is a negative: most of it is "
            "bright",
            only_if="bright_picture",
        ),
        *CLAUSES["too_few_stars"],
    ),
    "no_candidate": _PICTURE,
    "chance": _PICTURE,
    "time": (Clause("allow more time ({time_limit_s})"), *_PICTURE[:4]),
    "steps": (Clause("allow more steps ({max_steps})"), *_PICTURE[:4]),
}
"""Advice for pictures, whose magnitudes and noise nobody has stated, by reason."""


HINTS: dict[Reason, tuple[str, ...]] = {
    reason: tuple(clause.text for clause in clauses) for reason, clauses in CLAUSES.items()
}
"""All advice of a hint, by reason."""


@dataclass(frozen=True)
class Refusal:
    """Why a frame was not identified.

    Attributes
    ----------
    reason : str
        ``too_few_stars``, ``no_candidate`` (no pattern of the frame is in the database),
        ``prior`` (no attitude near the prior explains the frame), ``chance``,
        ``share_of_frame`` and ``scale`` (why the best agreement was withheld),
        ``scale`` and ``other_field`` (another field explains it, by at most 15 % and by more),
        ``mirrored`` (it would be found upside down), ``exchanged`` (its x are y), ``time`` and
        ``steps`` (the limit that ended the search), or ``few_guide_stars`` (such fields have too
        few stars of the database).
    n_matched : int
        Centroids with a star in the best agreement; 0 without an agreement.
    false_match_probability : float
        Bound on the probability that chance agrees as well; 1 without an agreement.
    share : float
        Share of the centroids, or of the stars in the frame if they are fewer, that the best
        agreement identifies; 0 without an agreement.
    n_centroids : int
        Usable centroids of the frame; 0 if not known.
    camera : Camera or None
        The camera that explains the frame in another field of view or mirrored, if one does.
    focal_error : float or None
        By how much its focal length is longer than stated, relative; None if it is mirrored.
    flip : bool or None
        Whether the caller stated that the frame is turned over (``flip``); None without a
        statement. It changes the words about a mirrored frame.
    rolls_deg : (float, float) or None
        If a mirrored frame also fits with x and y exchanged: the roll if its y counts up, and the
        roll if x and y are exchanged. Nothing in the frame shows which is right.
    stated_fov_deg : float or None
        Field across the width that was stated, if ``focal_error`` is known.
    is_of_database : bool
        Whether that is the field of the database's own camera.
    tried_fov_deg : (float, float) or None
        Narrowest and widest field that was searched, if other fields were.
    mean_stars : float or None
        Mean number of stars of the database in such a frame, if it is too small.
    searched_fov_deg : float or None
        Field across the width that was searched, if ``mean_stars`` is known.
    known : frozenset of str
        Inputs that the caller gave, and attempts that were made: the hint does not advise them.
    candidate : MatchResult or None
        The best attitude of the search, with its stars; None if no attitude fits better than
        chance. If the reason is ``chance``, it is the answer of this frame if
        ``max_false_match_probability`` were as high as its ``false_match_probability``. Otherwise
        it is a best guess that the reason speaks against.
    """

    reason: Reason
    n_matched: int = 0
    false_match_probability: float = 1.0
    share: float = 0.0
    n_centroids: int = 0
    camera: Camera | None = None
    focal_error: float | None = None
    flip: bool | None = None
    rolls_deg: tuple[float, float] | None = None
    stated_fov_deg: float | None = None
    is_of_database: bool = False
    tried_fov_deg: tuple[float, float] | None = None
    mean_stars: float | None = None
    searched_fov_deg: float | None = None
    facts: frozenset[Fact] = field(default=frozenset(), repr=False, compare=False)
    # A MatchResult or None; its module imports this one.
    candidate: Any = field(default=None, repr=False, compare=False)

    @property
    def fits_fov_deg(self) -> float | None:
        """Field across the width that explains the frame, degrees; None if none is known."""
        if self.camera is None or self.focal_error is None:
            return None
        return self.camera.fov_x_deg

    @property
    def message(self) -> str:
        """The reason as the start of a sentence, with the numbers of the best agreement."""
        text = MESSAGES[self.reason]
        if self.reason == "mirrored" and self.flip:
            text = "the frame matches only mirrored: it was turned over, and was upright before"
        elif self.rolls_deg is not None:
            text += ", or its x and y are exchanged"
        if self.fits_fov_deg is not None:
            text = f"the frame fits a field of {self.fits_fov_deg:.4g} deg"
            if self.stated_fov_deg is not None:
                stated = "the database is for" if self.is_of_database else "the camera has"
                text += f"; {stated} {self.stated_fov_deg:.4g} deg"
        if self.mean_stars is not None and self.reason == "few_guide_stars":
            return (
                f"{text}: {self.searched_fov_deg:.3g} deg hold {self.mean_stars:.1f} stars of it "
                f"on average, and {MIN_STARS} are needed"
            )
        if self.n_matched == 0:
            return text
        of_all = f" of {self.n_centroids}" if self.n_centroids else ""
        best = f"best: {self.n_matched}{of_all} centroids"
        if self.false_match_probability < 1.0:
            best += f", chance {self.false_match_probability:.1e}"
            best += f", {self.share:.0%} of the frame" if self.share else ""
        return f"{text} ({best})"

    @property
    def advice(self) -> tuple[str, ...]:
        """Alternatives of what to try, in which parameters stand in braces."""
        if self.reason == "mirrored" and self.flip is not None:
            return ("leave this option out ({flip})",)
        if self.rolls_deg is not None:
            up_deg, exchanged_deg = self.rolls_deg
            return (
                f"turn the frame over if y counts up ({{flip}}), which gives a roll of "
                f"{up_deg:.4f} deg",
                f"exchange x and y, which gives {exchanged_deg:.4f} deg",
            )
        if self.fits_fov_deg is not None:
            fov = f"{self.fits_fov_deg:.4g}"
            fits = f"state a field of {fov} deg ({{fov_deg:{fov}}})"
            if self.reason == "scale":
                return fits, "allow a larger error ({fov_error})"
            return fits, "build a database for it"
        clauses = CLAUSES[self.reason]
        if "picture" in self.facts:
            clauses = CLAUSES_OF_PICTURES.get(self.reason, clauses)
        *others, last = [clause.text for clause in clauses if self._is_of_use(clause)]
        if self.tried_fov_deg is not None:
            low, high = self.tried_fov_deg
            last += f"; fields of {low:.3g} to {high:.3g} deg and the mirrored frame were tried"
        return *others, last

    @property
    def hint(self) -> str:
        """What to try."""
        return advice_in_words(self.advice)

    def _is_of_use(self, clause: Clause) -> bool:
        is_needed = clause.only_if is None or clause.only_if in self.facts
        return is_needed and clause.unless not in self.facts

    def __repr__(self) -> str:
        return f"<Refusal {self.reason}: {self.message}>"
