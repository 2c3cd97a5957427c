"""Making an image fit: fewer features first, then fewer stars a field, or a refusal.

Triangles go that are seen from the fewest boresights, pairs that are the longest: they are those
that a frame shows most rarely. When too few would be left, stars go by the rule
that thins a build (`selection.max_stars_per_field`), and features with their stars.
"""

from __future__ import annotations

import math
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
from starcat.products.tiling import FieldStars

MIN_SHARE = {"triangle": 1.0 / 3.0, "pyramid": 0.5}
"""Of the sightings of all triangles, or of the longest pair's length, so much is left at least."""

MIN_STARS = 4
"""Fewer stars in a field identify nothing."""


@dataclass(frozen=True)
class Shrunk:
    """Contents that fit, and what it took."""

    contents: Contents
    stars_before: int  # of the database
    features_before: int  # of the image without a limit
    # The stars left are among so many brightest of a field; None where all are left.
    stars_per_field: int | None

    @property
    def stars(self) -> int:
        """Stars that are left."""
        return len(self.contents.star_id)

    @property
    def features(self) -> int:
        """Triangles or pairs that are left."""
        return len(self.contents.features)


def shrink(
    contents: Contents,
    times_seen: NDArray[np.int32] | None,
    fields: Callable[[], FieldStars],
    max_bytes: int | None,
) -> Shrunk:
    """Leave out as little as makes an image fit."""
    limit = math.inf if max_bytes is None else max_bytes
    whole, weight = _by_use(contents, times_seen)
    sizes = []
    for most, thinner, left in _thinned(whole, weight, fields):
        sizes.append(_sizes(thinner, _least(left, contents.method)).total_bytes)
        if sizes[-1] <= limit:
            fewer = _fewer_features(thinner, limit)
            return Shrunk(fewer, len(contents.star_id), len(whole.features), most)
    smallest = min(sizes)
    raise OnboardSizeError(
        f"{contents.name}: {limit:,} bytes are too few for an onboard image for "
        f"{contents.method!r}; the smallest that is of use has {smallest:,} bytes. Raise "
        "max_bytes, choose another method, or build a database with fewer stars",
        max_bytes=int(limit),
        smallest_bytes=smallest,
        fields=("max_bytes", "method"),
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
    use = np.cumsum(weight)
    return int(np.searchsorted(use, MIN_SHARE[method] * use[-1])) + 1 if len(use) else 0


def _thinned(
    contents: Contents, weight: NDArray[np.float64], fields: Callable[[], FieldStars]
) -> Iterator[tuple[int | None, Contents, NDArray[np.float64]]]:
    """Yield the contents, then what is left with ever fewer stars a field."""
    yield None, contents, weight
    stars = fields()
    before = len(contents.star_id)
    for most in range(int(stars.count.max(initial=0)) - 1, MIN_STARS - 1, -1):
        is_left = np.zeros(len(contents.star_id), dtype=bool)
        is_left[stars.brightest(most)[1]] = True
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


def _fewer_features(contents: Contents, max_bytes: float) -> Contents:
    counts = range(len(contents.features) + 1)
    fitting = bisect_right(counts, max_bytes, key=lambda n: _sizes(contents, n).total_bytes) - 1
    return replace(contents, features=contents.features[:fitting])
