"""What an identification returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from starcat.attitude import quaternion_from_matrix, radec_roll_from_matrix

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
        Expected number of chance agreements as good as this one; 1 unless identified.
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


def unidentified(status: Status, count: int) -> MatchResult:
    """Return the answer to a frame that was not identified.

    Parameters
    ----------
    status : {"no_match", "too_few_stars"}
        Why.
    count : int
        Number of centroids.

    Returns
    -------
    MatchResult
        Without stars.
    """
    none = np.full(count, -1)
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
    )


def identified(
    matrix: NDArray[np.float64],
    star_index: NDArray[np.int32],
    star_id: NDArray[np.int64],
    residual_arcsec: float,
    false_match_probability: float,
) -> MatchResult:
    """Return the answer to an identified frame.

    Parameters
    ----------
    matrix : ndarray of float64, shape (3, 3)
        Attitude, ``body = matrix @ icrs``.
    star_index : ndarray of int32, shape (N,)
        Row of each centroid's star, -1 where none.
    star_id : ndarray of int64, shape (S,)
        Permanent numbers of the database's stars.
    residual_arcsec, false_match_probability : float
        As in `MatchResult`.

    Returns
    -------
    MatchResult
        With quaternion and angles of one and the same attitude.
    """
    has_star = star_index >= 0
    ids = np.where(has_star, star_id[np.where(has_star, star_index, 0)], -1)
    ra_deg, dec_deg, roll_deg = radec_roll_from_matrix(matrix)
    return MatchResult(
        "identified",
        ids.astype(np.int64),
        star_index,
        quaternion_from_matrix(matrix),
        ra_deg,
        dec_deg,
        roll_deg,
        int(has_star.sum()),
        residual_arcsec,
        false_match_probability,
    )
