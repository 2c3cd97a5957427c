"""Checks of an onboard image: its numbers against each other, and against its database.

Everything is computed again from directions and rows. Functions yield the faults in words.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.database.onboard.image import Contents, feature_values, longest_pair_rad, quantised
from starcat.database.onboard.layout import FEATURES, MAG_SCALE, RADIUS_STEPS, RADIUS_UNKNOWN, Sizes
from starcat.database.onboard.profiles import FULL, Profile
from starcat.database.onboard.reading import OnboardImage, rows_by_number
from starcat.database.products.tiling import FieldStars
from starcat.errors import OnboardSizeError
from starcat.geometry.sphere import separation
from starcat.results import entry, in_record

MIN_STARS = 4
"""Smallest number of stars in a field with which it can be identified."""


@dataclass(frozen=True)
class Shrunk:
    """Contents that fit, and the sizes before."""

    contents: Contents = field(repr=False)
    # stars of the database
    stars_before: int = field(metadata=entry(key="stars_in_database"))
    # features of the image without a limit
    features_before: int = field(metadata=entry(key="features_without_limit"))
    # The stars left are among this many brightest of a field; None if all are left.
    stars_per_field: int | None

    @property
    @in_record()
    def source(self) -> str:
        """Name and version of the database."""
        return self.contents.name

    @property
    @in_record()
    def method(self) -> str:
        """Method of the image."""
        return self.contents.method

    @property
    @in_record()
    def stars(self) -> int:
        """Stars that are left."""
        return len(self.contents.star_id)

    @property
    @in_record()
    def features(self) -> int:
        """Triangles or pairs that are left."""
        return len(self.contents.features)


def shrink(
    contents: Contents,
    times_seen: NDArray[np.int32] | None,
    fields: Callable[[], FieldStars],
    max_bytes: int | None,
    profile: Profile = FULL,
) -> Shrunk:
    """Leave out what a profile leaves out, and more only as far as the image is too large."""
    limit = math.inf if max_bytes is None else max_bytes
    least = profile.least[contents.method]
    whole, weight = _by_use(contents, times_seen)
    whole = replace(whole, stars_per_cell=profile.stars_per_cell)
    sizes = []
    for most, thinner, weights in _thinned(whole, weight, fields, profile.stars_per_field):
        if profile.most < 1.0:
            kept = thinner.features[: _count(weights, profile.most)]
            thinner = replace(thinner, features=kept)
        sizes.append(_sizes(thinner, _count(weights, least)).total_bytes)
        if sizes[-1] <= limit:
            fewer = _fewer_features(thinner, limit)
            return Shrunk(fewer, len(contents.star_id), len(whole.features), most)
    smallest = min(sizes)
    raise OnboardSizeError(
        f"{limit:,} bytes are too few for an onboard image for "
        f"{contents.method!r}; the smallest that is of use has {smallest:,} bytes",
        where=contents.name,
        max_bytes=int(limit),
        smallest_bytes=smallest,
        hint=("Raise {max_bytes}", "choose another {method}", "build a database with fewer stars"),
    )


def _by_use(
    contents: Contents, times_seen: NDArray[np.int32] | None
) -> tuple[Contents, NDArray[np.float64]]:
    """Return the features, the most useful first, and the use that each of them adds."""
    if times_seen is not None:
        order = np.argsort(-times_seen.astype(np.int64), kind="stable")
        weight = times_seen[order].astype(np.float64)
        return replace(contents, features=contents.features[order]), weight
    u = contents.directions[contents.features.reshape(-1, 2)]
    apart = separation(u[:, 0], u[:, 1])
    order = np.argsort(apart, kind="stable")
    order = order[apart[order] <= longest_pair_rad(contents.camera)]
    weight = np.diff(apart[order], prepend=0.0)
    return replace(contents, features=contents.features[order]), weight


def _count(weight: NDArray[np.float64], part: float) -> int:
    """Return the number of first features that have a fraction of the use of all features."""
    use = np.cumsum(weight)
    return int(np.searchsorted(use, part * use[-1])) + 1 if len(use) else 0


def _thinned(
    contents: Contents,
    weight: NDArray[np.float64],
    fields: Callable[[], FieldStars],
    stars_per_field: int | None,
) -> Iterator[tuple[int | None, Contents, NDArray[np.float64]]]:
    """Yield the contents with all stars or ``stars_per_field``, then with fewer per field."""
    if stars_per_field is None:
        yield None, contents, weight
    stars = fields()
    first = fullest = int(stars.count.max(initial=0))
    if stars_per_field is not None:
        first = min(stars_per_field, fullest)
        if first == fullest:
            yield None, contents, weight
    before = len(contents.star_id) if stars_per_field is None else -1
    for most in range(min(first, fullest - 1), MIN_STARS - 1, -1):
        is_kept = np.zeros(len(contents.star_id), dtype=bool)
        is_kept[stars.brightest(most)[1]] = True
        if np.count_nonzero(is_kept) == before:
            continue
        before = int(np.count_nonzero(is_kept))
        whole = is_kept[contents.features].all(axis=1)
        row = np.cumsum(is_kept) - 1
        thinner = replace(
            contents,
            star_id=contents.star_id[is_kept],
            directions=contents.directions[is_kept],
            mag=contents.mag[is_kept],
            features=row[contents.features[whole]],
        )
        yield most, thinner, weight[whole]


def _sizes(contents: Contents, n_features: int) -> Sizes:
    return Sizes(contents.method, len(contents.star_id), n_features, contents.grid.n_cells)


def _fewer_features(contents: Contents, max_bytes: float) -> Contents:
    counts = range(len(contents.features) + 1)
    fitting = bisect_right(counts, max_bytes, key=lambda n: _sizes(contents, n).total_bytes) - 1
    return replace(contents, features=contents.features[:fitting])


VALUE_TOLERANCE = 1e-12
"""Largest difference by rounding between two machines, square radians and radians."""

RADIUS_TOLERANCE = 1e-6
"""Largest relative difference of circumradii by rounding."""

MAX_PRODUCTS = 20_000_000


def value_problems(image: OnboardImage) -> Iterator[str]:
    """Yield how values, K-vector, circumradii and longest side contradict the stars."""
    values, radii, sides = feature_values(image.directions, image.features)
    if (np.diff(values) < -VALUE_TOLERANCE).any():
        yield f"section {FEATURES[image.method][0]}: not by ascending value"
        return
    if not _fits_line(image, values):
        yield "section kvector: not the numbers of values below its line"
    if "radii" in image.sections:
        steps = radii / image.header["radius_quantum_rad"]
        expected = np.where(steps < RADIUS_STEPS + 0.5, steps, RADIUS_UNKNOWN)
        stored = image.sections["radii"].astype(np.float64)
        far = np.flatnonzero(np.abs(stored - expected) > 0.5 + RADIUS_TOLERANCE * expected)
        if len(far):
            actual, computed = stored[far[0]], expected[far[0]]
            yield f"section radii: row {far[0]} is {actual:.0f}; expected {computed:.1f}"
    longest = float(sides.max(initial=0.0))
    if longest > image.header["longest_rad"] + VALUE_TOLERANCE:
        yield f"longest_rad is {image.header['longest_rad']:.9g}; a side has {longest:.9g} rad"


def _fits_line(image: OnboardImage, values: Array) -> bool:
    """Return whether the K-vector counts the values on or below its line."""
    counts = image.sections["kvector"].astype(np.int64)
    with np.errstate(over="ignore"):  # a line that leads to infinity does not fit
        steps = image.header["kvector_slope"] * np.arange(len(counts), dtype=np.float64)
        line = image.header["kvector_intercept"] + steps
    below = np.concatenate([[-np.inf], values])[counts]
    above = np.concatenate([values, [np.inf]])[counts]
    fits = (below <= line + VALUE_TOLERANCE) & (above >= line - VALUE_TOLERANCE)
    return bool(fits.all() and np.isfinite(line).all())


def capacity_problems(image: OnboardImage) -> Iterator[str]:
    """Yield a problem if a circle about a star has more stars than the header allows."""
    u = image.directions
    if not len(u):
        return
    least = np.cos(image.camera.radius_rad)
    tried = u[:: max(1, len(u) ** 2 // MAX_PRODUCTS)]
    step = max(1, 1_000_000 // len(u))
    most = max(
        int(np.count_nonzero(tried[n : n + step] @ u.T >= least, axis=1).max())
        for n in range(0, len(tried), step)
    )
    if most > image.header["most_near"]:
        yield f"most_near is {image.header['most_near']}; {most} stars are near one of them"


def database_problems(image: OnboardImage, contents: Contents) -> Iterator[str]:
    """Yield differences between an image and its database."""
    digest = contents.manifest_sha256.hex()
    if image.manifest_sha256 != digest:
        yield (
            f"the sha256 of its manifest begins with {image.manifest_sha256[:12]}; that of "
            f"{contents.name} with {digest[:12]}"
        )
    camera = (image.camera.width_px, image.camera.height_px, image.camera.focal_length_px)
    theirs = contents.camera
    for name, ours, other in (
        ("name", image.name, contents.name),
        ("epoch", image.header["epoch_jyear"], contents.epoch_jyear),
        ("camera", camera, (theirs.width_px, theirs.height_px, theirs.focal_length_px)),
    ):
        if ours != other:
            yield f"{name} is {ours}; the database says {other}"
    numbers, database_numbers = image.star_id, contents.star_id
    row = rows_by_number(numbers, image.directions, database_numbers, contents.directions)
    missing = row < 0
    if missing.any():
        named = ", ".join(map(str, numbers[missing][:5].tolist()))
        yield f"{int(missing.sum())} stars are not in the database: {named}"
        return
    yield from _star_problems(image, contents, row)
    features = np.sort(row[image.features], axis=1)
    if not _in_rows(features, np.sort(contents.features, axis=1), len(database_numbers)).all():
        yield f"section {FEATURES[image.method][0]}: not all of them are in the database"


def _star_problems(
    image: OnboardImage, contents: Contents, row: NDArray[np.int64]
) -> Iterator[str]:
    moved = (image.sections["directions"] != quantised(contents.directions[row])).any(axis=1)
    if moved.any():
        worst = separation(image.directions[moved], contents.directions[row][moved]).max()
        yield (
            f"section directions: {int(moved.sum())} stars lie elsewhere than in the database, by "
            f"up to {np.degrees(worst) * 3600.0:.4g} arcsec"
        )
    ours, theirs = image.mag, contents.mag[row]
    far = ~(np.abs(ours - theirs) <= 0.5 / MAG_SCALE + 1e-9)
    far &= ~(np.isnan(ours) & ~np.isfinite(theirs)) & ~(np.abs(theirs) > 32.7)
    if far.any():
        yield f"section magnitudes: {int(far.sum())} stars have other values in the database"


def _in_rows(rows: NDArray[np.int64], others: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """Return which rows are among others; rows are numbers below a count."""
    if count**3 < 2**62:
        scale = count ** np.arange(rows.shape[1])
        return np.isin(rows @ scale, others @ scale)
    _, group = np.unique(np.concatenate([others, rows]), axis=0, return_inverse=True)
    return np.isin(group.ravel()[len(others) :], group.ravel()[: len(others)])
