"""What an identification returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from starcat.geometry.attitude import quaternion_from_matrix, radec_roll_from_matrix
from starcat.geometry.camera import Camera
from starcat.matcher.observation import Observation
from starcat.matcher.pose import focal_length_error_px
from starcat.matcher.verification import Agreement

Status = Literal["identified", "no_match", "too_few_stars"]


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

    def __repr__(self) -> str:
        """Return the answer in one line."""
        spots = f"{self.n_matched} of {len(self.star_ids)} spots"
        if self.status != "identified":
            return f"<MatchResult {self.status}: {len(self.star_ids)} spots>"
        return (
            f"<MatchResult identified: {spots}, RA {self.boresight_ra_deg:.4f}, "
            f"Dec {self.boresight_dec_deg:+.4f}, roll {self.roll_deg:.4f} deg, residual "
            f"{self.residual_arcsec:.1f} arcsec, chance {self.false_match_probability:.1e}>"
        )

    def _repr_html_(self) -> str:
        """Return the answer and its stars as a table for a notebook."""
        head = "<thead><tr><th>spot</th><th>star</th></tr></thead>"
        named = enumerate(self.star_ids.tolist())
        rows = "".join(f"<tr><td>{k}</td><td>{star}</td></tr>" for k, star in named if star >= 0)
        return f"<p>{repr(self)[1:-1]}</p><table>{head}<tbody>{rows}</tbody></table>"


def unidentified(status: Status, observation: Observation) -> MatchResult:
    """Return the answer to a frame that was not identified.

    Parameters
    ----------
    status : {"no_match", "too_few_stars"}
        Why.
    observation : Observation
        The frame.

    Returns
    -------
    MatchResult
        An answer without stars and attitude.
    """
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
    )


def identified(
    found: Agreement, observation: Observation, star_id: NDArray[np.int64]
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

    Returns
    -------
    MatchResult
        An answer whose quaternion and angles are the same attitude.
    """
    count = len(observation) + len(observation.dropped)
    index = np.full(count, -1, dtype=np.int32)
    index[observation.rows] = found.star_index
    ids = np.full(count, -1, dtype=np.int64)
    has_star = index >= 0
    ids[has_star] = star_id[index[has_star]]
    pose, matched = found.pose, np.flatnonzero(found.star_index >= 0)
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
        float(np.degrees(found.residual_rad) * 3600.0),
        found.false_match_probability,
        observation.dropped,
        pose.camera,
        focal_length_error_px(pose, matched, found.residual_rad, observation)
        if observation.fov_error
        else None,
    )
