"""The answer to a frame: attitude, stars, and why there are none."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from html import escape
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcat.arguments import wrong_type
from starcat.arrays import Array, Directions, Matrix, Pixels
from starcat.database.onboard.flight_limits import centroids_in_flight
from starcat.errors import ConfigError, NotIdentifiedError, count_of
from starcat.geometry.attitude import HasAttitude, quaternion_from_matrix, radec_roll_from_matrix
from starcat.geometry.camera import Camera
from starcat.html_tables import html_table
from starcat.matcher import sky_objects
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.frame_shape import FrameShape, frame_shape, turn_in_words
from starcat.matcher.observation import (
    Dropped,
    Frame,
    HasCentroids,
    as_arrays,
    is_frame,
    remarks_on_pixels,
)
from starcat.matcher.pose import fit_by_weights, fit_shape_by_weights
from starcat.matcher.refusal import Refusal
from starcat.matcher.shape import Shape, half_ranges, undone_px
from starcat.matcher.stars import (
    ARCSEC,
    NO_STARS,
    MatchedStars,
    attitude_covariance,
    degrees_of_freedom,
    matched_stars,
    model_covariance,
    noises_px,
    reduced_chi_square,
)

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable
    from astropy.wcs import WCS
    from matplotlib.figure import Figure
    from scipy.spatial.transform import Rotation

Status = Literal["identified", "no_match", "too_few_stars"]

Origin = Literal["lost_in_space", "tracking"]

GivenAs = Literal["centroids", "upside_down", "picture"]


Q_AT, MATRIX_AT, COVARIANCE_AT, SHAPE_AT, IDS_AT = 72, 104, 176, 248, 304
"""Offsets in bytes of the arrays of ``starcat_frame_answer`` (``many.h``), the shape with the
number of its terms, and of the star numbers and star rows of the centroids that follow."""


@dataclass(frozen=True, eq=False)
class MatchResult(HasAttitude):
    """The answer to one frame of centroids.

    Attributes
    ----------
    status : {"identified", "no_match", "too_few_stars"}
        Only ``identified`` comes with stars and an attitude.
    star_index : ndarray of int32, shape (N,)
        Row of the database for each centroid, -1 without a star.
    matrix : ndarray of float64, shape (3, 3)
        Attitude, body from ICRS: ``v_body = matrix @ v_icrs``, with x right, y down and z along
        the boresight. NaN unless identified.
    residual_arcsec : float
        Root mean square angle between matched centroids and their stars.
    false_match_probability : float
        Bound on the probability that chance agrees as well; 1 unless identified.
    dropped : tuple of (int, str)
        Row and reason of every centroid that was not used: ``not_finite``, ``out_of_frame``
        or ``duplicate``.
    camera : Camera or None
        The camera that the answer holds for: the camera that was given, with the fitted focal
        length if it was fitted. None unless identified.
    focal_length_error_px : float or None
        Standard error of a fitted focal length; None if it was not fitted.
    shape : Shape or None
        The terms of the frame's shape that were fitted with the attitude, as numbers; None if the
        frame is as the camera says. `frame_shape` has them by name, with their errors.
    origin : {"lost_in_space", "tracking"}
        Whether the whole sky was searched, or the surroundings of a prior attitude.
    refusal : Refusal or None
        Why there is no answer, and the best candidate; None for an answer.
    time_s : float
        Time that the answer took; NaN if not measured. Answers are compared without it.
    n_not_searched : int
        Usable centroids that the search left out, because the frame has more than the 512
        brightest; their stars are not known. 0 in nearly all frames.
    given_as : {"centroids", "upside_down", "picture"}
        Whether the frame is a list of centroids, one that was turned over because its y counts
        up, or a picture in which they were found.
    other : MatchResult or None
        The attitude and stars of the centroids without a star here, if they are the same stars
        at other places, as after a double exposure: then the frame is ambiguous. None in nearly
        all frames.
    frame_remarks : tuple of str
        Remarks on how the frame was read, such as columns that were not used; part of `remarks`.

    Notes
    -----
    ``bool(result)`` is `ok`: false without an identification. Answers are equal if everything
    but their times is.
    """

    status: Status
    star_index: NDArray[np.int32]
    matrix: Matrix
    residual_arcsec: float
    false_match_probability: float
    dropped: Dropped = ()
    camera: Camera | None = None
    focal_length_error_px: float | None = None
    origin: Origin = "lost_in_space"
    time_s: float = field(default=math.nan, compare=False)
    n_not_searched: int = 0
    given_as: GivenAs = "centroids"
    frame_remarks: tuple[str, ...] = field(default=(), repr=False, compare=False)
    # The frame as it was given, the stars, and the noise of a centroid if it was stated. The
    # properties are computed from them when they are first used.
    frame: Frame | None = field(default=None, repr=False, compare=False)
    database: MatcherDatabase | None = field(default=None, repr=False, compare=False)
    noise_px: float | None = field(default=None, repr=False, compare=False)
    # Noise that the tolerance stands for where none is stated.
    otherwise_px: float = field(default=math.nan, repr=False, compare=False)
    refusal: Refusal | None = field(default=None, repr=False, compare=False)
    # Largest error of the focal length as it was stated.
    fov_error: float = field(default=0.0, repr=False, compare=False)
    shape: Shape | None = None  # how the frame differs from the camera; None if it does not
    other: MatchResult | None = field(default=None, repr=False, compare=False)
    # Derived properties that the C library computed, as views of its output.
    _record: ClassVar[bytearray | None] = None

    @classmethod
    def of(cls, content: dict[str, Any]) -> MatchResult:
        """Return an answer with these fields and cached properties; other fields have defaults.

        The constructor of a frozen dataclass would take a tenth of the time of an identification.
        """
        answer = cls.__new__(cls)
        object.__setattr__(answer, "__dict__", content)
        return answer

    def with_facts(self, **facts: Any) -> MatchResult:
        """Return the answer with other values of some fields, and its candidate with the same."""
        why = facts.pop("refusal", self.refusal)
        if why is not None and why.candidate is not None:
            why = replace(why, candidate=why.candidate.with_facts(**facts))
        answer = replace(self, refusal=why, **facts)
        shape = answer.frame_shape
        if shape is None:
            return answer
        return replace(answer, focal_length_error_px=shape.focal_length_error_px)

    @property
    def ok(self) -> bool:
        """Whether the frame was identified."""
        return self.status == "identified"

    def __bool__(self) -> bool:
        return self.ok

    def __eq__(self, other: object) -> bool:
        """Return whether another answer is the same, except for the time that it took."""
        if not isinstance(other, MatchResult):
            return NotImplemented
        compared = [
            member.name for member in fields(self) if member.compare and member.name not in _ARRAYS
        ]
        return all(
            np.array_equal(getattr(self, name), getattr(other, name), equal_nan=True)
            for name in _ARRAYS
        ) and all(_is_same(getattr(self, name), getattr(other, name)) for name in compared)

    def __hash__(self) -> int:
        return hash((self.status, self.star_index.tobytes()))

    @property
    def focal_length_px(self) -> float | None:
        """Focal length of `camera`, fitted if it was not known; None unless identified."""
        return None if self.camera is None else self.camera.focal_length_px

    @property
    def fits_fov_deg(self) -> float | None:
        """Another field across the width that explains the frame if the stated one does not, deg.

        None if the frame was identified, if no other field was searched (``explain``), or if none
        explains it.
        """
        return None if self.refusal is None else self.refusal.fits_fov_deg

    @property
    def n_matched(self) -> int:
        """Centroids with a star."""
        return int(np.count_nonzero(self.star_index >= 0))

    @cached_property
    def star_ids(self) -> NDArray[np.int64]:
        """Permanent star number of each centroid, shape (N,), -1 without a star."""
        if self._record is not None:
            return np.ndarray(len(self.star_index), np.int64, self._record, IDS_AT)
        if self.database is None or not self.ok:
            return np.full(len(self.star_index), -1, dtype=np.int64)
        ids = np.take(self.database.star_id, self.star_index, mode="wrap")
        ids[self.star_index < 0] = -1
        return ids

    @cached_property
    def q_body_from_icrs(self) -> NDArray[np.float64]:
        """Attitude [x, y, z, w], shape (4,); NaN unless identified.

        ``Rotation.from_quat(q).inv()`` of scipy converts ICRS components into camera components;
        `rotation` returns it.
        """
        if self._record is not None:
            return np.ndarray(4, np.float64, self._record, Q_AT)
        return quaternion_from_matrix(self.matrix)

    @cached_property
    def stars(self) -> MatchedStars:
        """The centroids that are stars, one row each; empty unless identified."""
        if not self.ok:
            return NO_STARS
        frame, camera, database = self.searched
        return matched_stars(
            self.star_index, self.matrix, camera, frame, database, self.noise_px, self.shape
        )

    @cached_property
    def covariance_arcsec2(self) -> NDArray[np.float64]:
        """Covariance of the attitude, shape (3, 3); NaN unless identified.

        It is for small rotations about the axes of the camera frame (x right, y down, z along the
        boresight), in square arcseconds. It uses the noise of a centroid if that is stated, else
        the noise of the residuals, widened so that three standard errors have the coverage of
        three standard deviations (Student's t). If a shape of the frame was fitted, its errors
        are included; otherwise the camera is taken as exact. If the residuals are larger than the
        noise, or than a third of the tolerance, by more than chance, the excess is added to the
        variances as it is: errors of the camera do not average out.
        """
        if self._record is not None:
            return np.ndarray((3, 3), np.float64, self._record, COVARIANCE_AT)
        stars = self.stars
        if self.frame is None or self.camera is None:
            return np.full((3, 3), np.nan)
        of_centroids = attitude_covariance(stars, self.camera, self._unknowns, self.shape)
        return of_centroids + model_covariance(
            stars, self.camera, self._unknowns, self.otherwise_px
        )

    @cached_property
    def frame_shape(self) -> FrameShape | None:
        """How the frame differs from the camera, with standard errors; None if it does not.

        The errors are of the same noise as those of `covariance_arcsec2`.
        """
        if self.shape is None or self.camera is None:
            return None
        stars = self.stars
        px = np.column_stack([stars.x_px, stars.y_px])
        return frame_shape(px, noises_px(stars, self._unknowns), self.camera, self.shape)

    @cached_property
    def reduced_chi_square(self) -> float:
        """Squared residuals over the stated noise, per degree of freedom; NaN without a noise.

        It is 1 on average if ``noise_px`` or ``sigma_px`` is right, and k^2 if the stated noise is
        k times too small. Errors of the camera raise it too.
        """
        return reduced_chi_square(self.stars, self._free)

    @property
    def _unknowns(self) -> int:
        if self.shape is not None:
            return 3 + self.shape.free
        return 3 if self.focal_length_error_px is None else 4

    @property
    def _free(self) -> int:
        return degrees_of_freedom(self.stars, self._unknowns)

    @property
    def remarks_on_frame(self) -> tuple[str, ...]:
        """Remarks on how the frame was read, and on coordinates that hardly are its pixels."""
        if self.frame is None:
            return self.frame_remarks
        on_pixels = remarks_on_pixels(self.frame.centroids_px, self.frame.camera)
        return (*self.frame_remarks, *on_pixels)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the answer, in sentences."""
        sentences, count = [*self.remarks_on_frame], len(self.star_index)
        if self.n_not_searched:
            searched = count - len(self.dropped) - self.n_not_searched
            sentences.append(
                f"{searched} of {count} centroids were searched: the brightest, or without "
                f"magnitudes a selection that disregards positions. The other "
                f"{self.n_not_searched} have no star; give fewer centroids"
            )
        is_of_flight = self.database is not None and self.database.image is not None
        if is_of_flight and self.given_as != "picture":  # no picture is searched in flight
            sentences += centroids_in_flight(count)
        if self.given_as == "upside_down" and self._roll_if_exchanged_deg is not None:
            sentences.append(
                "the frame was turned over, because its y counts up; if its x and y are exchanged "
                f"instead, the roll is {self._roll_if_exchanged_deg:.4f} deg"
            )
        if self.other is not None:
            sentences.append(
                f"ambiguous: {self.other.n_matched} of the other centroids show the same sky at RA "
                f"{self.other.boresight_ra_deg:.4f}, Dec {self.other.boresight_dec_deg:+.4f}, roll "
                f"{self.other.roll_deg:.4f} deg, as after a double exposure or with a ghost; the "
                "frame does not say which attitude is the camera's"
            )
        chi_square = self.reduced_chi_square
        if chi_square > max(NOTABLE_CHI_SQUARE, _chi_square_of_chance(self._free)):
            sentences.append(
                f"the residuals are {math.sqrt(chi_square):.1f} times the stated noise (reduced "
                f"chi-square {chi_square:.1f}): state a larger one, or give the camera its focal "
                "length and distortion; the covariance includes the excess"
            )
        scale = self._scale
        if self.fov_error and abs(scale) > half_ranges(self.fov_error)[0]:
            sentences.append(
                f"the focal length is {100.0 * abs(math.expm1(-math.log1p(-scale))):.2g} % "
                f"{'longer' if scale > 0.0 else 'shorter'} than stated, which is beyond the stated "
                f"error of {100.0 * self.fov_error:.2g} % (fov_error): allow a larger error, or "
                "give the camera its focal length"
            )
        if self.frame_shape is not None and self.camera is not None:
            sentences += turn_in_words(self.frame_shape, self.camera)
        return tuple(sentences)

    @property
    def _scale(self) -> float:
        """Term of the scale of a fitted focal length over the stated one; 0 if it is as stated."""
        if self.camera is None or self.frame is None:
            return 0.0
        return 1.0 - self.frame.camera.focal_length_px / self.camera.focal_length_px

    @property
    def _roll_if_exchanged_deg(self) -> float | None:
        """Roll of a frame that was turned over, if its x and y are exchanged instead.

        None unless both readings fit, on a square detector with the axis in its middle.
        """
        camera = self.camera
        if not self.ok or camera is None or camera.width_px != camera.height_px:
            return None
        if max(map(abs, camera.principal_point_px - camera.middle_px)) > MIDDLE_PX:
            return None
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return float(radec_roll_from_matrix(quarter @ self.matrix)[2])

    def with_noise(self, sigma_px: ArrayLike) -> MatchResult:
        """Return the same answer with its attitude fitted by the noises of the centroids.

        Parameters
        ----------
        sigma_px : array_like of float64, shape (N,)
            Noise of each centroid on each axis, px, as `Matcher.identify` takes it.

        Returns
        -------
        MatchResult
            Of a frame that was identified: the same stars, another attitude and covariance.
        """
        frame, _, _ = self.searched
        _, _, sigma = as_arrays(frame.centroids_px, sigma_px=sigma_px)
        if sigma is None:
            raise ConfigError(
                "missing", parameter="sigma_px", hint="give the noise of each centroid"
            )
        return replace(self, frame=replace(frame, sigma_px=sigma))._fitted()

    def without_stars(self, reasons: Mapping[int, str]) -> MatchResult:
        """Return the answer without the stars of some centroids.

        Parameters
        ----------
        reasons : mapping of int to str
            Rows of centroids that are no stars, and what they are instead: the reason in `dropped`.

        Returns
        -------
        MatchResult
            Of a frame that was identified. The attitude is fitted again if a centroid had a star.
            ``false_match_probability`` stays: it is that of the agreement that was accepted.
        """
        star_index = self.star_index.copy()
        star_index[list(reasons)] = -1
        dropped = tuple(sorted((dict(self.dropped) | dict(reasons)).items()))
        answer = replace(self, star_index=star_index, dropped=dropped)
        return answer if answer.n_matched == self.n_matched else answer._fitted()

    def _fitted(self) -> MatchResult:
        """Return the answer with the attitude that fits its stars best, its shape as it is."""
        frame, camera, database = self.searched
        rows = np.flatnonzero(self.star_index >= 0)
        seen = camera.directions_from_pixels(self.unshaped_px[rows])
        stars = database.directions[self.star_index[rows]]
        matrix, residual_rad = fit_by_weights(seen, stars, _noise_of(frame)[rows])
        return self.with_facts(matrix=matrix, residual_arcsec=residual_rad * ARCSEC)

    def attitude_of(self, directions: Directions) -> tuple[Matrix, float]:
        """Return the attitude that fits directions of the stars best, and its residual in radians.

        ``directions`` are those of the centroids with a star, shape (n, 3), in their order. The
        centroids are weighted by their noise where it was stated. If the frame has a shape, it is
        fitted again with the attitude.
        """
        frame, camera, _ = self.searched
        rows = np.flatnonzero(self.star_index >= 0)
        px, sigma_px = frame.centroids_px[rows], _noise_of(frame)[rows]
        if self.shape is None:
            return fit_by_weights(camera.directions_from_pixels(px), directions, sigma_px)
        return fit_shape_by_weights(px, directions, sigma_px, self.matrix, camera, self.shape)

    @property
    def unshaped_px(self) -> Pixels:
        """Places of the centroids that the camera would give without the frame's shape, (N, 2)."""
        frame, camera, _ = self.searched
        px = frame.centroids_px
        return px if self.shape is None else undone_px(px, self.shape.terms, camera)

    @property
    def searched(self) -> tuple[Frame, Camera, MatcherDatabase]:
        """The frame, the camera and the database of an answer.

        `ConfigError` unless identified, or if the result does not hold them, as after pickling.
        """
        if self.frame is None or self.camera is None or self.database is None:
            raise ConfigError("this MatchResult does not hold the frame that was asked about")
        return self.frame, self.camera, self.database

    def rotation(self) -> Rotation:
        """Return the attitude as a scipy rotation: ``rotation().apply(v_icrs)`` is ``v_body``.

        Returns
        -------
        scipy.spatial.transform.Rotation
            Of `matrix`. Its ``as_quat()`` is [-x, -y, -z, w] for `q_body_from_icrs` [x, y, z, w],
            or its negative: scipy uses the other convention of quaternions.

        Raises
        ------
        NotIdentifiedError
            Unless identified.
        ConfigError
            If scipy is not installed.
        """
        self._expect_ok("attitude")
        return sky_objects.rotation(self.matrix)

    def to_dict(self, frame: HasCentroids | None = None) -> dict[str, Any]:
        """Return the result as ``starcat identify --json`` prints it.

        Parameters
        ----------
        frame : frame, optional
            The frame to list in ``stars``, with as many centroids; by default the frame that was
            searched.

        Returns
        -------
        dict
            Only numbers, texts, lists, dicts and None, so that ``json.dumps`` writes it: None
            stands for NaN. ``stars`` has one entry per centroid, in the order of the frame.

        Raises
        ------
        ConfigError
            If the result does not hold its frame, as after pickling, and none is given.
        """
        listed = frame or self.frame
        if listed is None:
            raise ConfigError("this MatchResult does not hold the frame that was asked about")
        if not is_frame(listed):
            raise wrong_type("frame", listed, "a frame, as starcat.read_frames returns them")
        content = {**_facts(self), "stars": _star_rows(self, listed)}
        if self.other is not None:
            facts = _facts(self.other)
            other_facts = {name: facts[name] for name in facts if name not in _OF_ANSWER}
            content["other"] = {**other_facts, "stars": _star_rows(self.other, listed)}
        if self.refusal is not None and (candidate := self.refusal.candidate) is not None:
            facts = _facts(candidate)
            candidate_facts = {name: facts[name] for name in facts if name not in _OF_ANSWER}
            content["refusal"]["candidate"] = {
                **candidate_facts,
                "stars": _star_rows(candidate, listed),
            }
        return content

    def plot(
        self,
        output: str | os.PathLike[str] | None = None,
        *,
        image: ArrayLike | None = None,
        name: str = "",
    ) -> Figure:
        """Draw the frame with its stars circled and named, as ``starcat identify --picture``.

        Parameters
        ----------
        output : str or path-like, optional
            PNG or SVG file to write; the suffix decides.
        image : array_like, shape (height, width), optional
            The picture that the centroids were found in; by default the centroids are drawn on a
            dark sky.
        name : str, optional
            Name of the frame, with which the title begins.

        Returns
        -------
        matplotlib.figure.Figure
            Which a notebook shows.

        Raises
        ------
        ConfigError
            If the result does not hold its frame, as after pickling, the image has another size
            than the camera, the output is neither PNG nor SVG, or matplotlib is not installed.
        """
        return sky_objects.plot(self, output, image, name)

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
        if self.database is not None:
            facts |= {"database": self.database.name, "epoch_jyear": self.database.epoch_jyear}
        if self.ok:
            facts["q_body_from_icrs"] = self.q_body_from_icrs.tolist()
            facts["covariance_arcsec2"] = self.covariance_arcsec2.tolist()
        stars = {member.name: getattr(self.stars, member.name) for member in fields(MatchedStars)}
        stars["star"] = np.array(self.stars.star, dtype=np.str_)
        return sky_objects.sky_object_table(stars, facts)

    @property
    def skycoord(self) -> SkyCoord:
        """The boresight as a ``SkyCoord`` of astropy in ICRS.

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
            raise ConfigError("this MatchResult does not hold the camera that it was found with")
        return sky_objects.wcs(self.camera, self.matrix, bottom_up)

    def _expect_ok(self, what: str) -> None:
        if not self.ok:
            raise NotIdentifiedError(
                f"the frame has no {what}: its status is {self.status}",
                hint="look at 'ok' first, and at 'refusal' for what to try",
            )

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for another process: the stars without their database."""
        content = {**vars(self), "frame": None, "database": None, "_record": None}
        content["q_body_from_icrs"] = self.q_body_from_icrs
        content["frame_remarks"] = self.remarks_on_frame
        if self.database is not None:
            content["star_ids"] = self.star_ids
            if self.frame is not None and self.camera is not None:
                content["stars"] = self.stars
                content["covariance_arcsec2"] = self.covariance_arcsec2
                content["frame_shape"] = self.frame_shape
                content["reduced_chi_square"] = self.reduced_chi_square
        return content

    @property
    def _counted(self) -> str:
        dropped = f" ({len(self.dropped)} dropped)" if self.dropped else ""
        return f"{count_of(len(self.star_index), 'centroid')}{dropped}"

    def __repr__(self) -> str:
        if not self.ok:
            because = f", {self.refusal.reason}" if self.refusal else ""
            because = "" if because == f", {self.status}" else because
            return f"<MatchResult {self.status}: {self._counted}{because}>"
        return (
            f"<MatchResult identified: {self.n_matched} of {self._counted}, "
            f"RA {self.boresight_ra_deg:.4f}, Dec {self.boresight_dec_deg:+.4f}, "
            f"roll {self.roll_deg:.4f} deg, residual {self.residual_arcsec:.1f} arcsec, "
            f"chance {self.false_match_probability:.1e}>"
        )

    def _repr_html_(self) -> str:
        """Return the answer and its stars as a table for a notebook, or why there is none."""
        if not self.ok:
            why, head = self.refusal, f"<p>{escape(repr(self)[1:-1])}</p>"
            return head + (f"<p>{escape(f'{why.message}. Try: {why.hint}')}</p>" if why else "")
        heads = ("centroid", "star", "RA deg", "Dec deg", "mag", "dx px", "dy px")
        rows = [
            (star.spot, star.star, f"{star.ra_deg:.5f}", f"{star.dec_deg:+.5f}",
             f"{star.mag:.2f}", f"{star.dx_px:+.3f}", f"{star.dy_px:+.3f}")
            for star in self.stars
        ]  # fmt: skip
        return html_table(heads, rows, len(rows), repr(self)[1:-1])


def _facts(result: MatchResult) -> dict[str, Any]:
    """Return the values of an answer for the whole frame, as in its JSON."""
    facts: dict[str, Any] = {"status": result.status, "origin": result.origin}
    facts |= {"n_matched": result.n_matched, "remarks": list(result.remarks)}
    if result.ok:
        camera, database = result.camera, result.database
        facts |= {
            "database": None if database is None else database.name,
            "camera": None if camera is None else _camera_facts(camera),
            "boresight_ra_deg": result.boresight_ra_deg,
            "boresight_dec_deg": result.boresight_dec_deg,
            "roll_deg": result.roll_deg,
            "q_body_from_icrs": result.q_body_from_icrs.tolist(),
            "covariance_arcsec2": [
                [_or_none(value) for value in row] for row in result.covariance_arcsec2.tolist()
            ],
            "residual_arcsec": result.residual_arcsec,
            "reduced_chi_square": _or_none(result.reduced_chi_square),
            "false_match_probability": result.false_match_probability,
            "focal_length_px": result.focal_length_px,
            "focal_length_error_px": result.focal_length_error_px,
            "frame_shape": None if result.frame_shape is None else asdict(result.frame_shape),
        }
    elif result.refusal is not None:
        why = result.refusal
        facts["refusal"] = {
            "reason": why.reason,
            "message": why.message,
            "hint": why.hint,
            "advice": list(why.advice),
            "n_matched": why.n_matched,
            "false_match_probability": why.false_match_probability,
            "share": why.share,
        }
        if result.fits_fov_deg is not None:
            facts["fits_fov_deg"] = result.fits_fov_deg
    return {**facts, "time_s": _or_none(result.time_s)}


def _camera_facts(camera: Camera) -> dict[str, Any]:
    return {**asdict(camera), "principal_point_px": list(camera.principal_point_px)}


def _star_rows(result: MatchResult, frame: HasCentroids) -> list[dict[str, Any]]:
    """Return one entry per centroid of a frame, with its star if it has one."""
    reasons, stars = dict(result.dropped), result.stars
    row_of = {spot: row for row, spot in enumerate(stars.spot.tolist())}
    names = "mag", "ra_deg", "dec_deg", "dx_px", "dy_px", "separation_arcsec", "difference_mag"
    columns = {name: getattr(stars, name).tolist() for name in names}
    rows, mag = [], getattr(frame, "mag", None)
    for number, (x, y) in enumerate(frame.centroids_px.tolist()):
        seen = None if mag is None else _or_none(float(mag[number]))
        entry: dict[str, Any] = {"x_px": _or_none(x), "y_px": _or_none(y), "observed_mag": seen}
        entry |= {"star": None, "mag": None}
        row = row_of.get(number)
        if row is not None:
            entry |= {"star": stars.star[row], "star_id": str(stars.star_id[row])}
            entry |= {name: _or_none(column[row]) for name, column in columns.items()}
        if number in reasons:
            entry["dropped"] = reasons[number]
        rows.append(entry)
    return rows


_OF_ANSWER = ("status", "origin", "remarks", "database", "camera", "time_s")
"""Facts of an answer that its candidate and its other attitude do not repeat."""

_ARRAYS = ("star_index", "matrix")
"""Fields of an answer that are arrays."""


def _is_same(a: object, b: object) -> bool:
    if isinstance(a, Shape) and isinstance(b, Shape):
        return a.free == b.free and np.array_equal(a.terms, b.terms)
    is_nan = isinstance(a, float) and isinstance(b, float) and math.isnan(a) and math.isnan(b)
    return is_nan or a == b


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


NOTABLE_CHI_SQUARE = 2.0
"""Reduced chi-square above which an answer has a remark, if chance is unlikely to exceed it."""


MIDDLE_PX = 2.0
"""Distance of the axis from the middle of a detector up to which it counts as centred."""


def _chi_square_of_chance(free: int) -> float:
    """Return the reduced chi-square that chance exceeds once in a thousand (Wilson, Hilferty 1931).

    >>> round(_chi_square_of_chance(5), 2), round(_chi_square_of_chance(40), 2)
    (4.15, 1.84)
    """
    part = 2.0 / (9.0 * max(1, free))
    return (1.0 - part + 3.0902 * math.sqrt(part)) ** 3


NO_MATRIX = np.full((3, 3), np.nan)
NO_MATRIX.flags.writeable = False


def no_match(
    count: int, dropped: Dropped = (), refusal: Refusal | None = None, **facts: Any
) -> MatchResult:
    """Return the answer to a frame of ``count`` centroids that was not identified.

    ``facts`` are further fields of the answer.
    """
    is_too_few = refusal is not None and refusal.reason == "too_few_stars"
    return MatchResult(
        "too_few_stars" if is_too_few else "no_match",
        np.full(count, -1, dtype=np.int32),
        NO_MATRIX,
        math.nan,
        1.0,
        dropped,
        refusal=refusal,
        **facts,
    )


def _noise_of(frame: Frame) -> Array:
    """Return the noise of the centroids of a frame, the same for all if it is not stated."""
    return np.ones(len(frame)) if frame.sigma_px is None else frame.sigma_px
