"""A frame as it was given and as the methods see it, and the candidates that they propose."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, TypeGuard, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcat.arguments import columns_of, numbers_of, wrong_type
from starcat.arrays import Array, Deviations, Directions, Mask, Pixels, Rows
from starcat.database.onboard.layout import MAG_SCALE
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.matcher.centroid_columns import PIXELS, ColumnValues, values_of_columns
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.chance import INCOMPATIBLE, LOG_ALL_ATTITUDES, MIN_STARS
from starcat.matcher.settings import Budget, Settings
from starcat.matcher.shape import WIDER_RANGE, half_ranges

Dropped = tuple[tuple[int, str], ...]
"""Row and reason of every centroid that is not used: ``not_finite``, ``out_of_frame`` or
``duplicate``."""


LARGEST_MAG = 100.0
"""Magnitudes from -100 to 100 are known ones; any other number is as unknown as NaN. Instrumental
magnitudes, of light in any unit, lie far within. ``binding/many.c`` has the same
limit."""


class HasCentroids(Protocol):
    """A frame of `starcat.simulate`, of `starcat.read_frames` or of a result.

    ``mag`` and ``sigma_px`` are read too, if it has them.
    """

    @property
    def centroids_px(self) -> Pixels:
        """Return the centroids, shape (N, 2)."""


FrameLike = ArrayLike | HasCentroids | Mapping[str, ArrayLike]
"""Types that a caller can give for the centroids of a frame: numbers, a frame, or a table."""


@dataclass(eq=False)  # a frozen one would take three times as long to make
class Frame:
    """The centroids of a frame and the camera, as the caller gave them."""

    centroids_px: Pixels
    mag: Array | None  # NaN for a centroid without one
    camera: Camera
    # Standard deviation of each centroid on each axis; NaN or infinite if not known.
    sigma_px: Array | None = None

    def __len__(self) -> int:
        return len(self.centroids_px)

    def at(self, rows: Rows | slice) -> Frame:
        """Return the frame with some of its centroids."""
        mag, sigma = (None if each is None else each[rows] for each in (self.mag, self.sigma_px))
        return Frame(self.centroids_px[rows], mag, self.camera, sigma)


@dataclass(frozen=True, eq=False)
class Frames(Sequence[Frame]):
    """A sequence of frames of one camera."""

    # The centroids of frame n are rows ``starts[n]`` to ``starts[n + 1]``.
    starts: NDArray[np.int64]
    centroids_px: Pixels
    mag: Array | None  # NaN for a centroid without one
    camera: Camera
    sigma_px: Array | None = None
    # Remarks on how a frame was read, by its number.
    remarks: Mapping[int, tuple[str, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.starts) - 1

    @overload
    def __getitem__(self, frame: int) -> Frame: ...
    @overload
    def __getitem__(self, frame: slice) -> list[Frame]: ...
    def __getitem__(self, frame: int | slice) -> Frame | list[Frame]:
        if isinstance(frame, slice):
            return [self[n] for n in range(*frame.indices(len(self)))]
        frame = range(len(self))[frame]
        rows = slice(self.starts[frame], self.starts[frame + 1])
        return Frame(self.centroids_px, self.mag, self.camera, self.sigma_px).at(rows)


def as_frame(
    centroids_px: FrameLike,
    camera: Camera,
    mag: ArrayLike | None = None,
    sigma_px: ArrayLike | None = None,
) -> Frame:
    """Return a copy of the arrays of a caller as a frame; raise errors as `as_arrays` does."""
    px, mags, sigma = as_arrays(centroids_px, mag, sigma_px)
    return copied(Frame(px, mags, camera, sigma))


def copied(frame: Frame) -> Frame:
    """Return a frame of other arrays with the same numbers."""
    mag, sigma = (None if each is None else each.copy() for each in (frame.mag, frame.sigma_px))
    return Frame(frame.centroids_px.copy(), mag, frame.camera, sigma)


def as_arrays(
    centroids_px: FrameLike, mag: ArrayLike | None = None, sigma_px: ArrayLike | None = None
) -> tuple[Pixels, Array | None, Array | None]:
    """Return the arrays of a frame; `ConfigError` unless numbers are as expected.

    A frame is read by its attributes, a table by the names of its columns. Their magnitudes and
    noises count unless others are given separately.
    """
    if type(centroids_px) is not np.ndarray or centroids_px.dtype.names:
        centroids_px = frame_of_table(centroids_px)
        if is_frame(centroids_px):
            mag = getattr(centroids_px, "mag", None) if mag is None else mag
            sigma_px = getattr(centroids_px, "sigma_px", None) if sigma_px is None else sigma_px
            centroids_px = centroids_px.centroids_px
    px = numbers_of("centroids_px", centroids_px, "(N, 2)")
    if px.ndim != 2 or px.shape[1] != 2:
        if px.size:
            raise _error_of_shape("centroids_px has", px, "(N, 2)", "centroids_px")
        px = px.reshape(0, 2)
    mags = sigma = None
    if mag is not None:
        mags = _per_centroid("mag", mag, len(px))
    if sigma_px is not None:
        sigma = _checked_sigma(_per_centroid("sigma_px", sigma_px, len(px)))
    return px, mags, sigma


def is_frame(values: object) -> TypeGuard[HasCentroids]:
    """Return whether this is a frame, as `HasCentroids` describes it."""
    return hasattr(values, "centroids_px")


def frame_of_table(values: Any) -> Any:
    """Return the frame of a table, with remarks; a frame or plain numbers stay as they are."""
    if is_frame(values):
        return values
    if isinstance(values, list | tuple) and any(map(is_frame, values)):
        raise TypeError(
            f"{PIXELS} is a {type(values).__name__} with {len(values)} frames; give one of them, "
            "such as frames[0], or give all of them to identify_many"
        )
    columns = columns_of(values)
    if columns is None:
        return values
    table = values_of_columns(columns, "centroids_px is a table with", _error_of_column)
    names = [] if table.frame is None else list(dict.fromkeys(np.asarray(table.frame).tolist()))
    if len(names) > 1:
        raise ConfigError(
            f"the column frame of this table has {len(names)} values, such as {names[0]!r} and "
            f"{names[1]!r}",
            parameter=PIXELS,
            hint=("give the rows of one frame", "a table for each to identify_many"),
        )
    return table


def remarks_of(frame: object) -> tuple[str, ...]:
    """Return the remarks on how a frame was read; none on frames that starcat did not read."""
    remarks = getattr(frame, "remarks", ())
    return remarks if isinstance(frame, ColumnValues | MeasuredFrame) else ()


def _error_of_column(what: str, values: Array, expected: str) -> ConfigError:
    return _error_of_shape(what, values, expected, PIXELS)


def _per_centroid(name: str, values: ArrayLike, count: int) -> Array:
    numbers = numbers_of(name, values, (count,))
    if numbers.shape != (count,):
        if name == "sigma_px" and numbers.ndim == 0:  # one noise for all
            return np.full(count, numbers)
        raise _error_of_shape(f"{name} has", numbers, f"({count},), one a centroid", name)
    return numbers


def _checked_sigma(sigma_px: Array) -> Array:
    wrong = np.flatnonzero(sigma_px <= 0.0)
    if len(wrong):
        raise ConfigError(
            f"{sigma_px[wrong[0]]:g} for centroid {wrong[0]}; expected above 0, or NaN if it is "
            "not known",
            parameter="sigma_px",
        )
    return sigma_px


def as_frames(
    centroids_px: Iterable[FrameLike],
    camera: Camera,
    mag: Iterable[ArrayLike] | None = None,
    sigma_px: Iterable[ArrayLike] | None = None,
) -> Frames:
    """Return copies of the arrays of a caller as frames; raise errors as `as_arrays` does."""
    pixels = _sequence("frames", centroids_px)
    beside = {
        name: None if arrays is None else _sequence(name, arrays)
        for name, arrays in (("mag", mag), ("sigma_px", sigma_px))
    }
    for name, arrays in beside.items():
        if arrays is not None and len(arrays) != len(pixels):
            text = f"it has {len(arrays)} frames; expected {len(pixels)}"
            raise ConfigError(text, parameter=name)
    remarks: dict[int, tuple[str, ...]] = {}
    joined = _joined(pixels, *beside.values())
    if joined is None:  # check each frame on its own, to find which one is wrong
        none = [None] * len(pixels)
        columns = [none if arrays is None else arrays for arrays in beside.values()]
        pixels = [frame_of_table(frame) for frame in pixels]
        remarks = {n: notes for n, frame in enumerate(pixels) if (notes := remarks_of(frame))}
        each = [_of_frame(n, *row) for n, row in enumerate(zip(pixels, *columns, strict=True))]
        counts = [len(px) for px, *_ in each]
        mag, sigma = (_joined_with_nan([row[n] for row in each], counts) for n in (1, 2))
        joined = counts, np.concatenate([np.empty((0, 2)), *(px for px, *_ in each)]), mag, sigma
    counts, all_px, all_mags, all_sigmas = joined
    starts = np.zeros(len(counts) + 1, dtype=np.int64)
    np.cumsum(counts, out=starts[1:])
    return Frames(starts, all_px, all_mags, camera, all_sigmas, remarks)


def _of_frame(number: int, *arrays: Any) -> tuple[Pixels, Array | None, Array | None]:
    """Return the arrays of one of many frames; errors name the frame."""
    try:
        return as_arrays(*arrays)
    except ConfigError as error:
        error.at(f"frame {number}")
        raise


def _sequence(name: str, values: Any) -> Sequence[Any]:
    """Return an argument that needs one entry per frame; an iterator becomes a list."""
    if not isinstance(values, str | bytes) and columns_of(values) is None:
        with suppress(TypeError):
            return values if hasattr(values, "__len__") else list(values)
    raise wrong_type(name, values, "a sequence with one array per frame")


def _joined_with_nan(arrays: Sequence[Array | None], counts: Sequence[int]) -> Array | None:
    """Return arrays of frames joined; NaN for a frame that has None, None if no frame has one."""
    if all(values is None for values in arrays):
        return None
    with_counts = zip(arrays, counts, strict=True)
    whole = [np.full(count, np.nan) if values is None else values for values, count in with_counts]
    return np.concatenate([np.empty(0), *whole])


def _joined(
    centroids_px: Sequence[ArrayLike], *beside: Sequence[ArrayLike] | None
) -> tuple[list[int], Pixels, Array | None, Array | None] | None:
    """Return the sizes of frames and their arrays joined in one go.

    None if they do not fit, or are not all plain arrays of numbers: `as_arrays` reads lists,
    tables, masked arrays and quantities.
    """
    arrays: list[Array | None] = []
    for column in (centroids_px, *beside):
        if column is not None and not all(_is_plain(values) for values in column):
            return None
    try:
        counts = [len(values) for values in centroids_px]  # type: ignore[arg-type]
        px = np.asarray(np.concatenate(centroids_px, dtype=np.float64))
        for column in beside:
            if column is not None and [len(values) for values in column] != counts:  # type: ignore[arg-type]
                return None
            joined = (
                None if column is None else np.asarray(np.concatenate(column, dtype=np.float64))
            )
            if joined is not None and joined.shape != (sum(counts),):
                return None
            arrays.append(joined)
    except (TypeError, ValueError):
        return None
    mag, sigma = arrays
    if px.shape != (sum(counts), 2):
        return None
    if sigma is not None and (sigma <= 0.0).any():
        return None  # the error names the frame
    return counts, px, mag, sigma


def _is_plain(values: object) -> bool:
    return type(values) is np.ndarray and values.dtype.kind in "fiu"


def _error_of_shape(what: str, values: Array, expected: str, key: str) -> ConfigError:
    return ConfigError(f"{what} shape {values.shape}; expected {expected}", key=key, value=values)


@dataclass(frozen=True)
class Observation:
    """The usable centroids of a frame.

    They are in order of brightness if magnitudes are known, else the nearest to the centre is
    first, so that nothing depends on the order in which they were given.
    """

    rows: Rows  # row of each centroid in the frame as it was given
    centroids_px: Pixels
    body: Directions  # directions in the camera frame
    mag: Array | None  # NaN for a centroid without one; None if no magnitude is known
    camera: Camera
    settings: Settings
    dropped: Dropped = ()
    fov_error: float = 0.0  # largest relative error of the focal length, 0 if known
    budget: Budget = field(default_factory=Budget, compare=False, repr=False)
    sigma_px: Array | None = None  # noise of each centroid; None if not known
    log_attitudes: float = LOG_ALL_ATTITUDES  # logarithm of the volume that is searched

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def tolerance_px(self) -> float:
        """Largest error of a centroid, as a radius."""
        return self.settings.tolerance_px

    @property
    def tolerance_rad(self) -> float:
        """Largest error of a direction."""
        return self.settings.tolerance_px / self.camera.focal_length_px

    @property
    def noise_px(self) -> float:
        """Stated noise of a centroid on each axis, else what the tolerance stands for."""
        return self.settings.assumed_noise_px

    def noises_px(self, rows: Rows) -> tuple[Array, bool]:
        """Return the noises of centroids on each axis, and whether they are stated."""
        noise_px = np.full(len(rows), self.noise_px)
        is_stated = self.settings.noise_px is not None
        if self.sigma_px is not None:
            sigma_px = self.sigma_px[rows]
            has_sigma = np.isfinite(sigma_px)
            noise_px[has_sigma] = sigma_px[has_sigma]
            is_stated = bool(has_sigma.all())
        return noise_px, is_stated

    @cached_property
    def half_ranges(self) -> Array:
        """Largest terms of the frame's shape, shape (6,)."""
        return half_ranges(self.fov_error, self.camera, self.settings.camera_error)

    @cached_property
    def widest_ranges(self) -> Array:
        """Largest terms of an answer: the scale can be outside of its range, with a remark."""
        widest = self.half_ranges.copy()
        widest[0] *= WIDER_RANGE
        return widest

    @property
    def side_tolerance_rad(self) -> float:
        """Largest error of a separation.

        It is less than twice the error of a centroid, because both ends rarely err by the most
        and in opposite directions.
        """
        return 1.5 * self.tolerance_rad

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest focal length over the given one; the error is of it or the true."""
        return 1.0 - self.fov_error, 1.0 / (1.0 - self.fov_error)

    @cached_property
    def separation_rad(self) -> Array:
        """Separations between all centroids, radians, shape (N, N)."""
        x, y, z = self.body.T
        dx, dy, dz = x[:, None] - x, y[:, None] - y, z[:, None] - z
        # The chord loses no digits at small angles, where the cosine would.
        return np.asarray(2.0 * np.arcsin(0.5 * np.sqrt(dx * dx + dy * dy + dz * dz)))

    def deviations(self, star_mag: Array) -> Deviations | None:
        """Return by how many whole deviations centroids and stars differ; None without magnitudes.

        It is 0, or `INCOMPATIBLE`, if the noise of a centroid is not stated: the noise of its place
        is the unit with which magnitudes are compared.
        """
        if self.mag is None or self.settings.noise_mag is None:
            return None
        found = whole_deviations(self.mag, star_mag, self.settings.noise_mag)
        if self.settings.noise_px is None:
            found[found < INCOMPATIBLE] = 0
        return found

    def compatible(self, star_mag: Array, rows: Rows | slice = slice(None)) -> Mask | None:
        """Return which centroids can be which stars by their magnitudes; None if all can be.

        ``rows`` are the rows of the centroids, by default all.
        """
        if self.mag is None or self.settings.noise_mag is None:
            return None
        return _are_compatible(self.mag[rows][:, None], star_mag, self.settings.noise_mag)

    def are_compatible(self, rows: Rows, star_mag: Array) -> Mask:
        """Return whether each centroid can be its star by its magnitude; both of one shape."""
        if self.mag is None or self.settings.noise_mag is None:
            return np.ones(rows.shape, dtype=bool)
        return _are_compatible(self.mag[rows], star_mag, self.settings.noise_mag)

    def in_frame(self, star_index: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the stars of usable centroids in the order of the frame, -1 elsewhere."""
        index = np.full(len(self) + len(self.dropped), -1, dtype=np.int32)
        index[self.rows] = star_index
        return index

    def first(self, count: int) -> Observation:
        """Return the observation of the first centroids alone."""
        return replace(
            self,
            rows=self.rows[:count],
            centroids_px=self.centroids_px[:count],
            body=self.body[:count],
            mag=None if self.mag is None else self.mag[:count],
            sigma_px=None if self.sigma_px is None else self.sigma_px[:count],
        )


def observe(
    frame: Frame, settings: Settings, *, fov_error: float = 0.0, budget: Budget | None = None
) -> Observation:
    """Return the usable centroids of a frame, in order."""
    px, mag, camera = frame.centroids_px, frame.mag, frame.camera
    if mag is not None:
        mag = known_magnitudes(mag)
    usable = camera.contains(px)
    if usable.all():
        dropped, rows = [], _own_order(px, mag, camera)
    else:
        rows, dropped = usable.nonzero()[0], unusable(px, usable)
        rows = rows[_own_order(px[rows], None if mag is None else mag[rows], camera)]
    rows, repeats = without_repeats(rows, px)
    kept = px[rows]
    return Observation(
        rows,
        kept,
        camera.directions_from_pixels(kept),
        None if mag is None or not np.isfinite(mag[rows]).any() else mag[rows],
        camera,
        settings,
        (*dropped, *repeats),
        fov_error,
        budget or Budget(),
        None if frame.sigma_px is None else frame.sigma_px[rows],
    )


BEYOND_PX = 5.0
"""Distance from the frame that no noise explains: an answer has a remark on centroids beyond it.

With a noise of 2 px, no star of 1000 frames was as far outside. If the size of a frame is larger
than the camera's, hardly any other sign of it is left: the stars are right and the attitude is not.
"""

CENTRED_OUTSIDE = 1.0 / 3.0
"""Least fraction outside of the frame if pixels count from its centre; three quarters are usual."""

SMALL_EXTENT = 0.1
"""Fraction of the frame's width and height within which centroids are hardly pixels of it."""

CHANCE_OF_EXTENT = 1e-6
"""Probability that chance puts all centroids so near each other, below which there is a remark."""


def remarks_on_pixels(px: Pixels, camera: Camera) -> tuple[str, ...]:
    """Return remarks on coordinates that hardly are pixels of the camera's frame.

    Pixels fill the frame. Fractions of it, millimetres and degrees lie in a small part of it, and
    pixels that count from the centre are negative in half of the cases.
    """
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    size_text = f"{camera.width_px} x {camera.height_px} px"
    finite = px[np.isfinite(px).all(axis=1)]
    count = len(finite)
    if count < MIN_STARS:
        return ()
    low, high = finite.min(axis=0), finite.max(axis=0)
    part = np.minimum((high - low) / size, 1.0)
    # The probability that n points of an interval have at most this distance from each other.
    chance = np.prod(count * part ** (count - 1) - (count - 1) * part**count)
    if (part < SMALL_EXTENT).all() and chance < CHANCE_OF_EXTENT:
        wide, high_px = high - low
        remark = (
            f"all {count} centroids lie within {wide:.3g} x {high_px:.3g} px of a frame of "
            f"{size_text}: "
        )
        if low.min() >= 0.0 and high.max() <= 1.0:
            return (
                f"{remark}they seem to be fractions of the frame, 0 to 1; multiply x by "
                f"{camera.width_px} and y by {camera.height_px}",
            )
        return (
            f"{remark}they seem to have another unit, such as millimetres or degrees; give pixels "
            "from the outer corner of the top-left pixel",
        )
    outside, beyond_px = outside_of(px, camera)
    if beyond_px <= BEYOND_PX:
        return ()
    lie, were = ("lies", "was") if outside == 1 else ("lie", "were")
    remark = (
        f"{outside} of {len(px)} centroids {lie} outside of the frame of {size_text}, by up to "
        f"{beyond_px:.0f} px, and {were} dropped"
    )
    # One pixel: the centroid of a star at the edge can lie a little beyond it.
    is_centred = (low < 0.0).all() and (np.maximum(-low, high) <= 0.5 * size + 1.0).all()
    if is_centred and outside >= CENTRED_OUTSIDE * count:
        return (
            f"{remark}: x and y seem to count from the centre of the frame; add "
            f"{0.5 * camera.width_px:g} to x and {0.5 * camera.height_px:g} to y. An attitude that "
            "was found without this is wrong",
        )
    return (
        f"{remark}: if the frame has another size, state that or its camera, because an attitude "
        "that was found without it is wrong; pixels count from the outer corner of the top-left "
        "pixel, x to the right and y down",
    )


def outside_of(px: Pixels, camera: Camera) -> tuple[int, float]:
    """Return how many centroids lie outside of the frame, and how far, px; 0 if none does."""
    finite = px[np.isfinite(px).all(axis=1)]
    beyond_px = np.maximum(-finite, finite - 2.0 * camera.middle_px)
    return int(np.count_nonzero(~camera.contains(finite))), float(beyond_px.max(initial=0.0))


def known_magnitudes(mag: Array) -> Array:
    """Return magnitudes with NaN for those outside of -`LARGEST_MAG` to `LARGEST_MAG`."""
    return np.where(np.abs(mag) <= LARGEST_MAG, mag, np.nan)


def unusable(px: Pixels, usable: Mask) -> list[tuple[int, str]]:
    """Return row and reason of the centroids that are not usable."""
    finite = np.asarray(np.isfinite(px).all(axis=1))
    return [
        (int(row), "out_of_frame" if finite[row] else "not_finite")
        for row in np.flatnonzero(~usable)
    ]


def _own_order(centroids_px: Pixels, mag: Array | None, camera: Camera) -> Rows:
    """Return the brightest first (unknown ones last), or the nearest to the centre."""
    x, y = (centroids_px - camera.middle_px).T
    distance = x * x + y * y
    return np.lexsort((y, x, distance) if mag is None else (y, x, distance, mag))


def without_repeats(rows: Rows, px: Pixels) -> tuple[Rows, list[tuple[int, str]]]:
    """Return rows without repeats of exactly the same place, and the repeats."""
    x = np.sort(px[rows, 0])
    if not (x[1:] == x[:-1]).any():
        return rows, []
    position = px[rows, 0] + 1j * px[rows, 1]
    order = np.argsort(position, kind="stable")
    same = np.diff(position[order]) == 0.0
    if not same.any():
        return rows, []
    repeats = order[1:][same]
    return np.delete(rows, repeats), [(int(row), "duplicate") for row in np.sort(rows[repeats])]


MAG_DEVIATIONS = 3.5
"""Largest difference of the magnitudes of a centroid and its star, in standard deviations."""


def whole_deviations(mag: Array, star_mag: Array, noise_mag: float) -> Deviations:
    """Return by how many whole standard deviations magnitudes differ, or `INCOMPATIBLE`.

    Magnitudes of stars are rounded as in an image. A magnitude that is not known differs from none.
    """
    apart = _mag_apart(mag[:, None], star_mag)
    whole = np.nan_to_num(apart / noise_mag, posinf=INCOMPATIBLE)
    return np.where(_is_beyond(apart, noise_mag), INCOMPATIBLE, whole).astype(np.int8)


def _are_compatible(mag: Array, star_mag: Array, noise_mag: float) -> Mask:
    return ~_is_beyond(_mag_apart(mag, star_mag), noise_mag)


def _is_beyond(mag_apart: Array, noise_mag: float) -> Mask:
    return np.asarray(mag_apart > MAG_DEVIATIONS * noise_mag)


def _mag_apart(mag: Array, star_mag: Array) -> Array:
    rounded = np.rint(np.asarray(star_mag) * MAG_SCALE) / MAG_SCALE
    return np.asarray(np.abs(mag - rounded))


@dataclass(frozen=True)
class Candidates:
    """Correspondences of m >= 2 centroids and stars, one per row, the most promising first."""

    centroids: NDArray[np.integer[Any]]  # rows of the observation, shape (K, m)
    stars: NDArray[np.integer[Any]]  # rows of the database's stars, in the same order
    # Number of patterns looked up until each was found; None if not counted.
    patterns: NDArray[np.integer[Any]] | None = None
    looked_up: int = 0  # number of patterns looked up in the search so far

    def __len__(self) -> int:
        return len(self.stars)

    def __getitem__(self, rows: slice | NDArray[Any]) -> Candidates:
        patterns = None if self.patterns is None else self.patterns[rows]
        return Candidates(self.centroids[rows], self.stars[rows], patterns, self.looked_up)
