"""Models of a camera with some terms of its lens, fitted to identified frames.

Every frame has an attitude of its own. Frames of a camera that turns while its rows are read
(rolling shutter) also have a stretch and a shear of their own, as `starcat.matcher.shape` has
them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc, ndtr, stdtrit

from starcat.arrays import Array, Directions, Mask, Pixels
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.results import entry, in_record, readable

Points = NDArray[np.complex128]

FOCAL = ("focal_length_px",)
CENTRE = ("principal_point_x_px", "principal_point_y_px")
RADIAL = ("k1", "k2", "k3")
TANGENTIAL = ("p1", "p2")
AXES = ("aspect", "skew")
PARAMETERS = (*FOCAL, *CENTRE, *RADIAL, *TANGENTIAL, *AXES)
"""Names of the numbers, in the order of the vector.

``aspect`` is the focal length along y over the one along x, minus 1. ``skew`` is how far x moves
with y: the tangent of the angle by which the axes are not perpendicular.
"""


def values_of(camera: Camera) -> Array:
    """Return the numbers of a camera."""
    lens = asdict(camera.distortion)
    values = {**lens, "focal_length_px": camera.focal_length_px}
    values |= dict(zip(CENTRE, camera.principal_point_px, strict=True))
    return np.array([values.get(name, 0.0) for name in PARAMETERS])


def camera_of(values: Array, size_px: tuple[int, int]) -> Camera:
    """Return the camera of numbers; aspect and skew are left out."""
    numbers = dict(zip(PARAMETERS, values.tolist(), strict=True))
    lens = Distortion(**{name: numbers[name] for name in (*RADIAL, *TANGENTIAL)})
    centre = [numbers[name] for name in CENTRE]
    focal_px = numbers["focal_length_px"]
    return Camera(*size_px, focal_px, principal_point_px=centre, distortion=lens)


def cropped(camera: Camera, share: float) -> tuple[Camera, Array]:
    """Return the middle of a camera as a camera of its own."""
    size = camera.width_px, camera.height_px
    left_px, top_px = (round(0.5 * side * (1.0 - share)) for side in size)
    x_px, y_px = camera.principal_point_px
    width, height, centre = (
        size[0] - 2 * left_px,
        size[1] - 2 * top_px,
        (x_px - left_px, y_px - top_px),
    )
    middle = replace(camera, width_px=width, height_px=height, principal_point_px=centre)
    return middle, np.array([left_px, top_px], dtype=np.float64)


def project(values: Array, body: Directions) -> Array:
    """Project directions with any numbers, even for a lens that folds the image."""
    w, focal_px = _image(values, _plane(body)), values[0]
    aspect, skew = values[-2:]
    x = values[1] + focal_px * (w.real + skew * w.imag)
    return np.column_stack([x, values[2] + focal_px * (1.0 + aspect) * w.imag])


def value_derivatives(values: Array, body: Directions) -> Array:
    """Return how pixels change with the numbers of the camera."""
    focal_px, (aspect, skew) = values[0], values[-2:]
    z = _plane(body)
    x, y, s = z.real, z.imag, z.real**2 + z.imag**2
    w = _image(values, z)
    of_lens = (z * s, z * s**2, z * s**3, 2.0 * y * z + 1j * s, 2.0 * x * z + s)
    by_value = np.zeros((len(z), 2, len(PARAMETERS)))
    by_value[:, :, 0] = _pair(w, aspect, skew)
    by_value[:, 0, 1] = by_value[:, 1, 2] = 1.0
    for column, change in enumerate(of_lens, start=3):
        by_value[:, :, column] = focal_px * _pair(change, aspect, skew)
    by_value[:, 1, 8] = by_value[:, 0, 9] = focal_px * w.imag
    return by_value


def turn_derivatives(values: Array, body: Directions) -> Array:
    """Return how pixels change with the attitude of the camera."""
    focal_px, (aspect, skew) = values[0], values[-2:]
    k1, k2, k3, p1, p2 = values[3:8]
    z = _plane(body)
    x, y, s = z.real, z.imag, z.real**2 + z.imag**2
    slope = k1 + s * (2.0 * k2 + 3.0 * k3 * s)
    across = 2.0 * p2 * x + 2.0 * p1 * y
    # The image moves with z and with the conjugate of z, and z with the rotation.
    by_z = 1.0 + s * (k1 + s * (k2 + s * k3)) + s * slope + 2.0 * across
    by_conjugate = z * (slope * z + 2.0 * complex(p2, p1))
    turned = (-x * y - 1j * (1.0 + y * y), 1.0 + x * x + 1j * x * y, -y + 1j * x)
    by_turn = np.empty((len(z), 2, 3))
    for column, change in enumerate(turned):
        moved = by_z * change + by_conjugate * np.conj(change)
        by_turn[:, :, column] = focal_px * _pair(moved, aspect, skew)
    return by_turn


def motion_derivatives(values: Array, centroids_px: Pixels) -> Array:
    """Return how pixels change with the shear and the stretch of their rows; shape (N, 2, 2)."""
    by_motion = np.zeros((len(centroids_px), 2, 2))
    by_motion[:, 0, 0] = by_motion[:, 1, 1] = centroids_px[:, 1] - values[2]
    return by_motion


def _plane(body: Directions) -> Points:
    return np.asarray((body[:, 0] + 1j * body[:, 1]) / body[:, 2])


def _image(values: Array, z: Points) -> Points:
    k1, k2, k3, p1, p2 = values[3:8]
    s = z.real**2 + z.imag**2
    factor = 1.0 + s * (k1 + s * (k2 + s * k3)) + 2.0 * (p2 * z.real + p1 * z.imag)
    return np.asarray(z * factor + s * complex(p2, p1))


def _pair(w: Points, aspect: float, skew: float) -> Array:
    return np.column_stack([w.real + skew * w.imag, (1.0 + aspect) * w.imag])


# Residual at which Huber's loss turns from a parabola to lines, in deviations of a centroid.
BEND = 3.0

# Variance of a normal variable of variance 1 if values beyond `BEND` are left out.
KEPT_VARIANCE = 0.9733
TURNS = 30  # most steps towards the attitudes of one camera; three are usual

# First steps, in which stars beyond the bend count as if the loss were a parabola through them.
CAREFUL = 2

# Curvature of a star beyond the bend in later steps, so that no step is infinitely long.
MIN_CURVE = 0.01

# A smaller step ends the search for attitudes: the remaining error is 1/1000 of it, 2e-4 arcsec.
STILL_RAD = 1e-6
STILL_MOTION = 1e-6  # smallest change of a shear or a stretch that goes on with the search

# Weight of a motion of 0 for each frame, px^2: as of one centroid with a noise of 1 px, whose
# motion of 0.1 is one standard deviation. It decides for frames whose stars are in one row.
PRIOR_PX2 = 100.0
MOTION_CHANCE = 1e-4  # frames have motions if noise alone lowers the residuals as much less often

EXACT = 1e-8  # a fit ends when a step lowers the sum of squares by less than this fraction
PASSES = 4  # most fits of one camera, until the noise is known


@dataclass(frozen=True, eq=False)
class Seen:
    """The stars that were identified in some frames."""

    # shape (N,): number of the frame of each star, ascending; every number from 0 to F - 1 occurs
    frame: NDArray[np.int64]
    centroids_px: Pixels  # shape (N, 2): measured positions
    icrs: Directions  # shape (N, 3): directions of the stars
    matrices: Array  # shape (F, 3, 3): approximate attitudes, ``body = matrix @ icrs``
    # shape (F, 2): shear and stretch of the rows of each frame; None if they are not fitted
    motion: Array | None = None

    def __len__(self) -> int:
        return len(self.frame)

    def of(self, is_kept: Mask) -> Seen:
        """Return the stars of some of the frames."""
        stars, number = is_kept[self.frame], np.cumsum(is_kept) - 1
        return Seen(
            number[self.frame[stars]],
            self.centroids_px[stars],
            self.icrs[stars],
            self.matrices[is_kept],
            None if self.motion is None else self.motion[is_kept],
        )

    @property
    def unknowns(self) -> int:
        """Numbers that are fitted to the frames, in addition to the camera's."""
        return (3 if self.motion is None else 5) * len(self.matrices)

    def with_motion(self) -> Seen:
        """Return the stars with a motion of each frame that is to be fitted, at first 0."""
        return replace(self, motion=np.zeros((len(self.matrices), 2)))

    def still_px(self, values: Array) -> Pixels:
        """Return where the centroids were when the row of the principal point was exposed."""
        if self.motion is None:
            return self.centroids_px
        rows = self.centroids_px[:, 1:] - values[2]
        return np.asarray(self.centroids_px - rows * self.motion[self.frame])


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """A camera that was fitted to stars.

    Attributes
    ----------
    free : tuple of str
        The parameters that were fitted.
    values : ndarray of float64, shape (P,)
        All parameters, in the order of `PARAMETERS`.
    covariance : ndarray of float64, shape (len(free), len(free))
        Covariance of the fitted parameters, with unknown attitudes.
    noise_px : float
        Standard deviation of a centroid on each axis about the fit.
    residual_px : ndarray of float64, shape (N, 2)
        Measured positions of the stars minus their positions by the camera.
    seen : Seen
        The stars, with the attitudes that were found.
    """

    free: tuple[str, ...] = field(metadata=entry(key="names"))
    values: Array = field(repr=False)
    covariance: Array
    noise_px: float
    residual_px: Array = field(repr=False)
    seen: Seen = field(repr=False)

    __repr__ = readable

    @property
    @in_record(key="values")
    def fitted_values(self) -> list[float]:
        """Values of the parameters that were fitted."""
        return [float(self.values[PARAMETERS.index(name)]) for name in self.free]

    @property
    @in_record(key="errors")
    def fitted_errors(self) -> list[float]:
        """Standard errors of these values."""
        return list(self.errors.values())

    @property
    def errors(self) -> dict[str, float]:
        """Standard error of each parameter that was fitted."""
        return dict(zip(self.free, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def fit_camera(
    seen: Seen,
    values: Array,
    free: Sequence[str] = FOCAL,
    noise_px: float = 1.0,
    *,
    passes: int = PASSES,
    accuracy: float = EXACT,
) -> Fit:
    """Fit a camera to stars."""
    rows = [PARAMETERS.index(name) for name in free]
    for _ in range(passes):
        fitted = _one_fit(seen, values, rows, BEND * noise_px, accuracy)
        values, before = fitted, noise_px
        residual_px, seen = turned_to(seen, values, BEND * noise_px)
        noise_px = _noise_px(residual_px, len(rows) + seen.unknowns)
        if abs(noise_px - before) <= 0.01 * before:
            break
    inside = np.abs(residual_px) <= BEND * noise_px
    reduced = reduced_derivatives(seen, values, rows, inside)[inside.ravel()]
    covariance = noise_px**2 * _inverse_of_square(reduced)
    return Fit(tuple(free), values, covariance, noise_px, residual_px, seen)


def turned_to(seen: Seen, values: Array, bend_px: float) -> tuple[Array, Seen]:
    """Find the attitudes, and motions if they are fitted, that fit the stars best with a camera.

    Returns the residuals, and the stars with these attitudes and motions.
    """
    first = np.flatnonzero(np.diff(seen.frame, prepend=-1))
    for turn in range(TURNS):
        residual = seen.still_px(values) - project(values, _body(seen))
        by_frame = _frame_derivatives(seen, values)
        weight = bend_px / np.maximum(np.abs(residual), bend_px)
        # Stars beyond the bend pull, but after the first steps add nothing to the curvature.
        curve = weight if turn < CAREFUL else np.where(weight < 1.0, MIN_CURVE, 1.0)
        normal = np.add.reduceat(np.swapaxes(by_frame * curve[:, :, None], 1, 2) @ by_frame, first)
        pull = np.add.reduceat(np.einsum("nij,ni->nj", by_frame, weight * residual), first)
        if seen.motion is not None:
            normal += _prior()
            pull[:, 3:] -= PRIOR_PX2 * seen.motion
        step = np.linalg.solve(normal, pull[:, :, None])[:, :, 0]
        matrices = Rotation.from_rotvec(step[:, :3]).as_matrix() @ seen.matrices
        motion = None if seen.motion is None else seen.motion + step[:, 3:]
        seen = replace(seen, matrices=matrices, motion=motion)
        if np.abs(step[:, :3]).max() < STILL_RAD and (
            motion is None or np.abs(step[:, 3:]).max() < STILL_MOTION
        ):
            break
    return seen.still_px(values) - project(values, _body(seen)), seen


def _prior() -> Array:
    """Return the weights that keep the motion of a frame small."""
    return np.diag([0.0, 0.0, 0.0, PRIOR_PX2, PRIOR_PX2])


def _frame_derivatives(seen: Seen, values: Array) -> Array:
    """Return how pixels change with the attitude, and the motion, of their frame."""
    by_turn = turn_derivatives(values, _body(seen))
    if seen.motion is None:
        return by_turn
    return np.concatenate([by_turn, motion_derivatives(values, seen.centroids_px)], axis=2)


def _one_fit(seen: Seen, values: Array, rows: list[int], bend_px: float, accuracy: float) -> Array:
    last: tuple[bytes, Array, Seen] = b"", np.empty(0), seen

    def at(x: Array) -> tuple[Array, Array, Seen]:
        nonlocal last
        tried = values.copy()
        tried[rows] = x
        if x.tobytes() != last[0]:
            # Start from the attitudes of the camera that was tried before: they are near.
            last = x.tobytes(), *turned_to(last[2], tried, bend_px)
        return tried, last[1], last[2]

    def residual(x: Array) -> Array:
        return at(x)[1].ravel()

    def slope(x: Array) -> Array:
        tried, residual_px, turned = at(x)
        return -reduced_derivatives(turned, tried, rows, np.abs(residual_px) <= bend_px)

    start = values[rows]
    low = np.where(np.array(rows) == 0, 1e-3, -np.inf)
    solution = least_squares(
        residual, start, slope, (low, np.inf), x_scale="jac", loss="huber", f_scale=bend_px,
        xtol=1e-8, ftol=accuracy, gtol=1e-8, max_nfev=60,
    )  # fmt: skip
    out = values.copy()
    out[rows] = solution.x
    return out


def reduced_derivatives(seen: Seen, values: Array, rows: list[int], inside: Mask) -> Array:
    """Return how pixels change with numbers of the camera if the attitudes are fitted again."""
    by_value = value_derivatives(values, _body(seen))[:, :, rows]
    by_frame = _frame_derivatives(seen, values)
    first = np.flatnonzero(np.diff(seen.frame, prepend=-1))
    across = np.swapaxes(by_frame * inside[:, :, None], 1, 2)
    normal = np.add.reduceat(across @ by_frame, first)
    if seen.motion is not None:
        normal += _prior()
    mixed = np.add.reduceat(across @ by_value, first)
    follows = np.linalg.pinv(normal, hermitian=True) @ mixed
    return np.asarray((by_value - by_frame @ follows[seen.frame]).reshape(-1, len(rows)))


def _inverse_of_square(slope: Array) -> Array:
    """Return the inverse of ``slope.T @ slope``, whose columns have very different sizes."""
    size = np.linalg.norm(slope, axis=0)
    size[size == 0.0] = 1.0
    _, single, rows = np.linalg.svd(slope / size, full_matrices=False)
    half = rows.T / np.maximum(single, 1e-12) / size[:, None]
    return np.asarray(half @ half.T)


def _body(seen: Seen) -> Array:
    return np.asarray(np.einsum("nij,nj->ni", seen.matrices[seen.frame], seen.icrs))


def _noise_px(residual_px: Array, unknowns: int) -> float:
    """Return the standard deviation of the residuals that belong to a normal distribution."""
    size = np.abs(residual_px).ravel()
    noise = 1.4826 * float(np.median(size))
    for _ in range(20):
        kept = size[size <= BEND * noise]
        if not len(kept):
            break
        noise = float(np.sqrt(np.mean(kept**2) / KEPT_VARIANCE))
    freedom = max(1, size.size - unknowns)
    return max(noise * float(np.sqrt(size.size / freedom)), 1e-9)


FOLDS = 5  # groups of frames that are left out in turn; with fewer frames each is its own group
FAR_PX = 1e6  # a bend of Huber's loss beyond all residuals: least squares of all stars
NEAR = 1e-5  # accuracy of the fits that are compared
MIN_STARS = 4  # smallest number of stars that a frame keeps

# A model loses to a better one if the difference is larger than this many standard errors. The
# number is for many frames; for five frames it is 1.9, for three 2.5.
SURE = 1.5

# The models that are compared: none to three radial terms, with and without a free principal
# point, with and without the tangential terms.
MODELS = tuple(
    (*FOCAL, *RADIAL[:radial], *centre, *tangential)
    for radial in range(4)
    for centre in ((), CENTRE)
    for tangential in ((), TANGENTIAL)
)

# The terms whose values and errors are reported whether they are supported or not.
COMPLETE = (*FOCAL, *CENTRE, *RADIAL[:2], *TANGENTIAL)


@dataclass(frozen=True)
class Trial:
    """The result of one model on the frames that were left out.

    Attributes
    ----------
    free : tuple of str
        Parameters that the model fits.
    held_out_px : float
        Root mean square residual on each axis over the frames that were left out, after fitting
        their attitudes; inf for a model whose image folds back on the detector.
    worse_px2 : float
        Mean square residual on each axis minus the best model's.
    worse_error_px2 : float
        Standard error of that difference, from its scatter between frames.
    is_chosen : bool
        Whether this is the model that the rule chooses.
    """

    free: tuple[str, ...] = field(metadata=entry(key="terms"))
    held_out_px: float
    worse_px2: float
    worse_error_px2: float
    is_chosen: bool


def choose_model(
    seen: Seen,
    values: Array,
    size_px: tuple[int, int],
    noise_px: float,
    models: Sequence[tuple[str, ...]] = MODELS,
) -> list[Trial]:
    """Compare models by the residuals of frames that they were not fitted to, and choose one."""
    kept = _without_strays(seen, values, noise_px)
    squares = np.array([_held_out(kept, values, free, size_px) for free in models])
    numbers, frames = 2 * len(kept), squares.shape[1]
    mean = squares.sum(axis=1) / numbers
    with np.errstate(invalid="ignore"):
        difference = squares - squares[int(mean.argmin())]
        worse = difference.sum(axis=1) / numbers
        error = difference.std(axis=1, ddof=1) * math.sqrt(frames) / numbers
    # A standard error of few frames is uncertain itself, which Student's distribution allows for.
    sure = float(stdtrit(frames - 1, ndtr(SURE)))
    tied = [k for k in range(len(models)) if worse[k] <= sure * error[k]]
    simplest = min(tied, key=lambda k: (*_complexity(models[k]), mean[k]), default=0)
    return [
        Trial(free, math.sqrt(mean[k]), float(worse[k]), float(error[k]), k == simplest)
        for k, free in enumerate(models)
    ]


def _complexity(free: tuple[str, ...]) -> tuple[int, bool]:
    """Return the number of terms, and whether there are tangential ones.

    In a narrow field these are nearly the same as a principal point, which every camera has.
    """
    return len(free), TANGENTIAL[0] in free


def chosen_terms(trials: Sequence[Trial]) -> tuple[str, ...]:
    """Return the terms of the model that was chosen."""
    (free,) = (trial.free for trial in trials if trial.is_chosen)
    return free


def is_enough(seen: Seen) -> bool:
    """Return whether models can be compared: two frames, and more numbers than unknowns."""
    return len(seen.matrices) > 1 and 4 * len(seen) > 3 * (seen.unknowns + len(COMPLETE))


def with_motion_if_seen(
    seen: Seen, values: Array, size_px: tuple[int, int], noise_px: float
) -> Seen:
    """Return the stars with a motion of each frame if the residuals show one.

    Pixels that are not square stretch and shear all frames alike. So the motions have to lower
    the squares more than aspect and skew do; both with the complete model of the lens.
    """
    moving, terms = replace(seen, motion=None).with_motion(), (*COMPLETE, *AXES)
    freedom = 2 * len(seen) - moving.unknowns - len(COMPLETE)
    more = moving.unknowns - replace(seen, motion=None).unknowns - len(AXES)
    if not is_enough(moving) or freedom < 1 or more < 1:
        return replace(seen, motion=None)
    start = start_of(values, COMPLETE, size_px)
    fit = fit_camera(moving, start, COMPLETE, noise_px)
    near = np.asarray((np.abs(fit.residual_px) <= BEND * fit.noise_px).all(axis=1))
    if (np.bincount(seen.frame[near], minlength=len(seen.matrices)) < MIN_STARS).any():
        near[:] = True
    kept = replace(
        fit.seen, frame=seen.frame[near], centroids_px=seen.centroids_px[near], icrs=seen.icrs[near]
    )
    squares = [
        float((fit_camera(stars, fit.values, free, FAR_PX, passes=1).residual_px ** 2).sum())
        for stars, free in ((kept, COMPLETE), (replace(kept, motion=None), terms))
    ]
    freedom -= 2 * int(np.count_nonzero(~near))
    ratio = (squares[1] - squares[0]) / more / max(squares[0] / max(freedom, 1), 1e-300)
    return fit.seen if fdtrc(more, freedom, ratio) < MOTION_CHANCE else replace(seen, motion=None)


def start_of(values: Array, free: Sequence[str], size_px: tuple[int, int]) -> Array:
    """Return the initial numbers of a model."""
    start = np.zeros_like(values)
    start[0] = values[0]
    start[1:3] = values[1:3] if CENTRE[0] in free else 0.5 * np.array(size_px)
    for row, name in enumerate((*RADIAL, *TANGENTIAL), start=3):
        start[row] = values[row] if name in free else 0.0
    return start


def _without_strays(seen: Seen, values: Array, noise_px: float) -> Seen:
    """Return the stars that the complete model fits, so that all models use the same stars.

    A frame with too few of them keeps all its stars.
    """
    fit = fit_camera(seen, values, COMPLETE, noise_px)
    near = (np.abs(fit.residual_px) <= BEND * fit.noise_px).all(axis=1)
    enough = np.bincount(seen.frame, near) >= MIN_STARS
    near |= ~enough[seen.frame]
    return replace(
        fit.seen, frame=seen.frame[near], centroids_px=seen.centroids_px[near], icrs=seen.icrs[near]
    )


def _held_out(seen: Seen, values: Array, free: tuple[str, ...], size_px: tuple[int, int]) -> Array:
    """Return the sum of squares of each frame with a camera that was made without it."""
    count = len(seen.matrices)
    group = np.arange(count) % min(FOLDS, count)
    whole = fit_camera(seen, start_of(values, free, size_px), free, FAR_PX, passes=1, accuracy=NEAR)
    out = np.full(count, np.inf)
    for fold, fitted in enumerate(_without_each(whole, group)):
        try:
            camera_of(fitted, size_px)
        except ConfigError:
            return np.full(count, np.inf)
        omitted = whole.seen.of(group == fold)
        residual_px, _ = turned_to(omitted, fitted, FAR_PX)
        out[group == fold] = np.bincount(omitted.frame, (residual_px**2).sum(axis=1))
    return out


def _without_each(whole: Fit, group: NDArray[np.int64]) -> Iterator[Array]:
    """Return, for each group, the camera of all frames that are not in the group.

    It is one step of Gauss and Newton from the camera of all frames: the remaining error is of
    second order in that step.
    """
    rows = [PARAMETERS.index(name) for name in whole.free]
    everywhere = np.ones_like(whole.residual_px, dtype=bool)
    slope = reduced_derivatives(whole.seen, whole.values, rows, everywhere)
    size = np.linalg.norm(slope, axis=0)
    size[size == 0.0] = 1.0
    of_row = np.repeat(group[whole.seen.frame], 2)
    for fold in range(group.max() + 1):
        kept = of_row != fold
        step = np.linalg.lstsq(slope[kept] / size, whole.residual_px.ravel()[kept])[0]
        values = whole.values.copy()
        values[rows] += step / size
        yield values
