"""Making an image fit: fewer features first, then fewer stars a field, or a refusal.

Triangles go that are seen from the fewest boresights, pairs that are the longest: they are those
that a frame shows most rarely. When too few would be left, stars go by the rule
that thins a build (`selection.max_stars_per_field`), and features with their stars.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from starcat.errors import OnboardSizeError
from starcat.geometry.sphere import separation
from starcat.onboard.grid import grid_for
from starcat.onboard.image import Contents, longest_pair_rad
from starcat.onboard.layout import Sizes
from starcat.products.boresights import FieldStars

LEAST_SHARE = {"triangle": 1.0 / 3.0, "pyramid": 0.5}
"""Of the sightings of all triangles, or of the longest pair's length, so much is left at least."""

LEAST_STARS = 4
"""Fewer stars in a field identify nothing."""


@dataclass(frozen=True)
class Shrunk:
    """Contents that fit, and what it took."""

    # What is left.
    contents: Contents
    # Of the artifact, and left.
    stars_before: int
    stars: int
    # Of the image without a limit, and left.
    features_before: int
    features: int
    # The stars left are among so many brightest of a field; None where all are left.
    stars_per_field: int | None = None


def shrink(
    contents: Contents,
    times_seen: NDArray[np.int32] | None,
    fields: Callable[[], FieldStars],
    max_bytes: int | None,
) -> Shrunk:
    """Leave out as little as makes an image fit."""
    kept, weight = _by_use(contents, times_seen)
    n_stars, n_features = len(contents.star_id), len(kept.features)
    if max_bytes is None:
        return Shrunk(kept, n_stars, n_stars, n_features, n_features)
    smallest = _sizes(kept, _least(weight, kept.method)).total_bytes
    if smallest <= max_bytes:
        fewer = _fewer_features(kept, max_bytes)
        return Shrunk(fewer, n_stars, n_stars, n_features, len(fewer.features))
    for most, thinner, left in _thinned(kept, weight, fields()):
        size = _sizes(thinner, _least(left, kept.method)).total_bytes
        smallest = min(smallest, size)
        if size <= max_bytes:
            fewer = _fewer_features(thinner, max_bytes)
            left_over = (n_features, len(fewer.features))
            return Shrunk(fewer, n_stars, len(fewer.star_id), *left_over, most)
    raise OnboardSizeError(
        f"{contents.name}: {max_bytes:,} bytes are too few for an onboard image for the method "
        f"{contents.method}; the smallest that is of use has {smallest:,} bytes. Raise "
        "--max-bytes, choose another --method, or build an artifact with fewer stars",
        max_bytes=max_bytes,
        smallest_bytes=smallest,
    )


def _by_use(
    contents: Contents, times_seen: NDArray[np.int32] | None
) -> tuple[Contents, NDArray[np.float64]]:
    """Return the features, the most useful first, with what each adds to the use of all."""
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


def _least(weight: NDArray[np.float64], method: str) -> int:
    """Return how many features have to be left."""
    use = np.cumsum(weight)
    return int(np.searchsorted(use, LEAST_SHARE[method] * use[-1])) + 1 if len(use) else 0


def _thinned(
    contents: Contents, weight: NDArray[np.float64], fields: FieldStars
) -> Iterator[tuple[int, Contents, NDArray[np.float64]]]:
    """Yield what is left with ever fewer stars a field."""
    before = len(contents.star_id)
    for most in range(int(fields.count.max(initial=0)) - 1, LEAST_STARS - 1, -1):
        is_left = np.zeros(len(contents.star_id), dtype=bool)
        is_left[fields.brightest(most)[1]] = True
        if np.count_nonzero(is_left) == before:
            continue
        before = int(np.count_nonzero(is_left))
        whole = is_left[contents.features].all(axis=1)
        row = np.cumsum(is_left) - 1
        thinner = replace(
            contents,
            star_id=contents.star_id[is_left],
            directions=contents.directions[is_left],
            mag=contents.mag[is_left],
            features=row[contents.features[whole]],
        )
        yield most, thinner, weight[whole]


def _sizes(contents: Contents, n_features: int) -> Sizes:
    n_stars = len(contents.star_id)
    n_cells = grid_for(n_stars, contents.camera.radius_rad).n_cells
    return Sizes(contents.method, n_stars, n_features, n_cells)


def _fewer_features(contents: Contents, max_bytes: int) -> Contents:
    """Return the contents with as many features as fit."""
    counts = range(len(contents.features) + 1)
    fitting = bisect_right(counts, max_bytes, key=lambda n: _sizes(contents, n).total_bytes) - 1
    return replace(contents, features=contents.features[:fitting])
