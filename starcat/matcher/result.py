"""What an identification returns."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from starcat.errors import NotIdentifiedError
from starcat.geometry.attitude import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    radec_roll_from_matrix,
)
from starcat.geometry.camera import Camera
from starcat.matcher import sky_objects
from starcat.matcher.observation import Observation
from starcat.matcher.pose import focal_length_error_px
from starcat.matcher.refusal import Refusal
from starcat.matcher.stars import (
    NO_STARS,
    Asked,
    MatchedStars,
    attitude_covariance,
    matched_stars,
)
from starcat.matcher.verification import Agreement

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable
    from astropy.wcs import WCS

Status = Literal["identified", "no_match", "too_few_stars"]

Origin = Literal["lost_in_space", "tracking"]


@dataclass(frozen=True)
class MatchResult:
    """The answer to one frame of centroids.

    Attributes
    ----------
    status : {"identified", "no_match", "too_few_stars"}
        Only ``identified`` comes with stars and an attitude.
    star_ids : ndarray of int64, shape (N,)
        Permanent star number of each centroid, -1 where none.
    star_index : ndarray of int32, shape (N,)
        Row of the database, -1 where none.
    q_body_from_icrs : ndarray of float64, shape (4,)
        Scalar-last attitude; NaN unless identified.
    boresight_ra_deg, boresight_dec_deg, roll_deg : float
        The same attitude as angles; NaN unless identified.
    n_matched : int
        Centroids with a star.
    residual_arcsec : float
        Root mean square angle between matched centroids and their stars.
    false_match_probability : float
        Bound on the probability that chance agrees as well; 1 unless identified.
    dropped : tuple of (int, str)
        Row and reason of every centroid that was not used: ``not_finite``, ``out_of_frame``
        or ``duplicate``.
    camera : Camera or None
        The camera that the answer holds for: the one that was given, with the focal length that
        was found where it was looked for. None unless identified.
    focal_length_error_px : float or None
        Standard error of that focal length; None where it was not looked for.
    origin : {"lost_in_space", "tracking"}
        Whether the whole sky was searched, or what is near a prior attitude.
    time_s : float
        Time that the answer took; NaN where nobody measured. It is no part of the answer.
    """

    status: Status
    star_ids: NDArray[np.int64]
    star_index: NDArray[np.int32]
    q_body_from_icrs: NDArray[np.float64]
    boresight_ra_deg: float
    boresight_dec_deg: float
    roll_deg: float
    n_matched: int
    residual_arcsec: float
    false_match_probability: float
    dropped: tuple[tuple[int, str], ...] = ()
    camera: Camera | None = None
    focal_length_error_px: float | None = None
    origin: Origin = "lost_in_space"
    time_s: float = field(default=math.nan, compare=False)
    # What follows is what the properties are made of, when they are asked for.
    asked: Asked | None = field(default=None, repr=False, compare=False)
    why: Refusal | Callable[[], Refusal | None] | None = field(
        default=None, repr=False, compare=False
    )

    @property
    def ok(self) -> bool:
        """Whether the frame was identified."""
        return self.status == "identified"

    @cached_property
    def refusal(self) -> Refusal | None:
        """Why there is no answer; None for an answer, and where nothing can tell.

        The C library does not say why: for its answers the frame is searched again with numpy,
        once, when this is asked for. An onboard image holds nothing to search with.
        """
        return self.why() if callable(self.why) else self.why

    @cached_property
    def stars(self) -> MatchedStars:
        """The centroids that are stars, one row each; empty unless identified."""
        if not self.ok:
            return NO_STARS
        if self.asked is None or self.camera is None:
            raise ValueError("this MatchResult does not hold the frame that was asked about")
        return matched_stars(self.star_index, self._matrix, self.camera, self.asked)

    @cached_property
    def covariance_arcsec2(self) -> NDArray[np.float64]:
        """Covariance of the attitude, shape (3, 3); NaN unless identified.

        Of the small rotations about the axes of the camera frame (x right, y down, z along the
        boresight), square arcseconds. With the stated noise of a centroid where there is one,
        else with that of the residuals. The camera is taken as exact.
        """
        stars = self.stars
        if self.asked is None or self.camera is None:
            return np.full((3, 3), np.nan)
        return attitude_covariance(stars, self.camera, self.asked.noise_px)

    def table(self) -> QTable:
        """Return the stars as an astropy table.

        Returns
        -------
        astropy.table.QTable
            The columns of `MatchedStars`, with units; attitude and epoch are in its ``meta``.
            No rows unless identified.

        Raises
        ------
        ConfigError
            If astropy is not installed.
        """
        facts: dict[str, Any] = {"status": self.status}
        if self.asked is not None:
            database = self.asked.database
            facts |= {"database": database.name, "epoch_jyear": database.epoch_jyear}
        if self.ok:
            facts["q_body_from_icrs"] = self.q_body_from_icrs.tolist()
            facts["covariance_arcsec2"] = self.covariance_arcsec2.tolist()
        return sky_objects.table(self.stars, facts)

    @property
    def skycoord(self) -> SkyCoord:
        """The boresight, as astropy has it: a ``SkyCoord`` in ICRS.

        `NotIdentifiedError` unless identified, `ConfigError` where astropy is not installed.
        """
        self._expect_ok("boresight")
        return sky_objects.skycoord(self.boresight_ra_deg, self.boresight_dec_deg)

    def wcs(self, *, bottom_up: bool = False) -> WCS:
        """Return the world coordinates of the picture.

        Parameters
        ----------
        bottom_up : bool, default False
            Whether the first row of the picture's file is its bottom: with the file read as it
            is, ``y`` then counts from the bottom.

        Returns
        -------
        astropy.wcs.WCS
            ICRS in a gnomonic projection (TAN) about the principal point, with SIP polynomials
            where the camera has distortion. ``pixel_to_world(x, y)`` is the direction of any
            pixel; as everywhere in FITS and astropy the *centre* of the first pixel is (0, 0)
            there: subtract 0.5 from coordinates of starcat, whose origin is that pixel's outer
            corner.

        Raises
        ------
        NotIdentifiedError
            Unless identified.
        ConfigError
            If astropy is not installed.
        """
        self._expect_ok("WCS")
        if self.camera is None:
            raise ValueError("this MatchResult does not hold the camera that it was found with")
        return sky_objects.wcs(self.camera, self._matrix, bottom_up)

    @property
    def _matrix(self) -> NDArray[np.float64]:
        return matrix_from_quaternion(self.q_body_from_icrs)

    def _expect_ok(self, what: str) -> None:
        if not self.ok:
            raise NotIdentifiedError(
                f"the frame has no {what}: its status is {self.status}; look at 'ok' first, and "
                "at 'refusal' for what to try"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Return what goes to another process: the stars, not the database they are of."""
        if self.asked is None or self.camera is None:
            return {**vars(self), "asked": None, "why": None}
        made = {"stars": self.stars, "covariance_arcsec2": self.covariance_arcsec2}
        known = vars(self).get("refusal", None if callable(self.why) else self.why)
        return {**vars(self), **made, "asked": None, "why": known}

    def __repr__(self) -> str:
        """Return the answer in one line."""
        if not self.ok:
            # What is not known yet is not searched for, as that may take long.
            known = vars(self).get("refusal", self.why)
            because = f", {known.reason}" if isinstance(known, Refusal) else ""
            because = "" if because == f", {self.status}" else because
            return f"<MatchResult {self.status}: {len(self.star_ids)} spots{because}>"
        return (
            f"<MatchResult identified: {self.n_matched} of {len(self.star_ids)} spots, "
            f"RA {self.boresight_ra_deg:.4f}, Dec {self.boresight_dec_deg:+.4f}, "
            f"roll {self.roll_deg:.4f} deg, residual {self.residual_arcsec:.1f} arcsec, "
            f"chance {self.false_match_probability:.1e}>"
        )

    def _repr_html_(self) -> str:
        """Return the answer and its stars as a table for a notebook, or why there is none."""
        head = f"<p>{escape(repr(self)[1:-1])}</p>"
        if not self.ok:
            why = self.refusal
            return head + (f"<p>{escape(f'{why.words}. Try: {why.advice}')}</p>" if why else "")
        stars = self.stars
        columns = {
            "spot": stars.spot.tolist(),
            "star": [escape(name) for name in stars.star],
            "RA deg": [f"{value:.5f}" for value in stars.ra_deg],
            "Dec deg": [f"{value:+.5f}" for value in stars.dec_deg],
            "mag": [f"{value:.2f}" for value in stars.mag],
            "dx px": [f"{value:+.3f}" for value in stars.dx_px],
            "dy px": [f"{value:+.3f}" for value in stars.dy_px],
        }
        heads = "".join(f"<th>{name}</th>" for name in columns)
        rows = "".join(
            f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>"
            for row in zip(*columns.values(), strict=True)
        )
        return f"{head}<table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>"


def unidentified(
    status: Status,
    observation: Observation,
    refusal: Refusal | None = None,
    origin: Origin = "lost_in_space",
) -> MatchResult:
    """Return the answer to a frame that was not identified.

    Parameters
    ----------
    status : {"no_match", "too_few_stars"}
        Why.
    observation : Observation
        The frame.
    refusal : Refusal, optional
        The best agreement that was withheld, and why; that there were too few stars is said
        without it.
    origin : {"lost_in_space", "tracking"}
        Where the stars were looked for.

    Returns
    -------
    MatchResult
        An answer without stars and attitude.
    """
    if refusal is None and status == "too_few_stars":
        refusal = Refusal("too_few_stars")
    none = np.full(len(observation) + len(observation.dropped), -1)
    nan = float("nan")
    return MatchResult(
        status,
        none.astype(np.int64),
        none.astype(np.int32),
        np.full(4, nan),
        nan,
        nan,
        nan,
        0,
        nan,
        1.0,
        observation.dropped,
        origin=origin,
        why=refusal,
    )


def identified(
    found: Agreement,
    observation: Observation,
    star_id: NDArray[np.int64],
    origin: Origin = "lost_in_space",
) -> MatchResult:
    """Return the answer to an identified frame.

    Parameters
    ----------
    found : Agreement
        Attitude and stars.
    observation : Observation
        The frame.
    star_id : ndarray of int64, shape (S,)
        Permanent numbers of the database's stars.
    origin : {"lost_in_space", "tracking"}
        Where the stars were looked for.

    Returns
    -------
    MatchResult
        An answer whose quaternion and angles are the same attitude.
    """
    count = len(observation) + len(observation.dropped)
    index, ids = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int64)
    index.fill(-1)
    index[observation.rows] = found.star_index
    np.take(star_id, index, out=ids, mode="wrap")
    ids[index < 0] = -1
    pose = found.pose
    ra_deg, dec_deg, roll_deg = radec_roll_from_matrix(pose.matrix)
    return MatchResult(
        "identified",
        ids,
        index,
        quaternion_from_matrix(pose.matrix),
        ra_deg,
        dec_deg,
        roll_deg,
        found.n_matched,
        math.degrees(found.residual_rad) * 3600.0,
        found.false_match_probability,
        observation.dropped,
        pose.camera,
        _focal_length_error_px(found, observation) if observation.fov_error else None,
        origin,
    )


def _focal_length_error_px(found: Agreement, observation: Observation) -> float:
    matched = np.flatnonzero(found.star_index >= 0)
    return focal_length_error_px(found.pose, matched, found.residual_rad, observation)


def withheld(answer: MatchResult, refusal: Refusal) -> MatchResult:
    """Return the answer to a frame whose stars and attitude are not given away.

    Parameters
    ----------
    answer : MatchResult
        An identified frame.
    refusal : Refusal
        Why it is withheld.

    Returns
    -------
    MatchResult
        ``no_match``.
    """
    nan, count = math.nan, len(answer.star_ids)
    return replace(
        answer,
        status="no_match",
        star_ids=np.full(count, -1, dtype=np.int64),
        star_index=np.full(count, -1, dtype=np.int32),
        q_body_from_icrs=np.full(4, nan),
        boresight_ra_deg=nan,
        boresight_dec_deg=nan,
        roll_deg=nan,
        n_matched=0,
        residual_arcsec=nan,
        false_match_probability=1.0,
        camera=None,
        focal_length_error_px=None,
        why=refusal,
    )
