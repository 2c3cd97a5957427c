"""Frames of a camera whose field of view is only known as a range.

Each level of the database serves a part of the range: it is a database of its own, with the stars
and the triangles of that level alone, for frames of about one field of view; within that part the
focal length is found with the attitude. All levels are searched together, a batch of candidates
from each in turn, until one agreement is certain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import AsWritten, ConfigError, ProductError
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import checked_pair
from starcat.geometry.patterns import triangle_area
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.database import MatcherDatabase, ProductArrays, damaged
from starcat.matcher.numpy_engine import proposals, result_of_search
from starcat.matcher.observation import Candidates, Frame, Observation, observe
from starcat.matcher.options import OPTIONS
from starcat.matcher.pose import first_poses, pose_at
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import (
    Budget,
    BudgetSpentError,
    Limit,
    Settings,
    TriangleOrder,
    certainty,
    check_scale_free,
)
from starcat.matcher.verification import AT_ONCE, BestOf, agree, agreeing_centroids

MAX_CENTROIDS = 40
"""Number of brightest centroids of a frame that are compared with a level. A level has about 20
stars per field of its size, and 40 per frame that is wider by half."""

BRIGHTEST = TriangleOrder(most_centroids=10)
"""Triangles if magnitudes are known: of the same bright stars as the triangles of a level."""

BY_CHANCE = 1.0
"""Mean number of candidates of a batch that are worked out although they agree by chance."""

_OWN = 3
"""Number of centroids of a candidate, from which its attitude was computed."""

BEYOND = 1.25
"""Factor by which the outer levels are used beyond the focal lengths that they are made for: a
frame with other proportions than the camera has another width for the same area."""


@dataclass(frozen=True)
class BlindLevel:
    """One level."""

    # Tangent of half the field of view: the geometric mean of the tangents across width and
    # height, which does not depend on which of the two is longer.
    half_width: float
    database: MatcherDatabase  # its stars, and triangles with the rows of these
    rows: NDArray[np.int64]  # rows of its stars in the database; shape (N,)

    def focal_length_px(self, camera: Camera) -> float:
        """Return the focal length with which a detector has the level's field of view."""
        return _focal_length_px(self.half_width, camera)


def levels(database: MatcherDatabase) -> tuple[BlindLevel, ...]:
    """Return the levels of a database."""
    half_width, *others = half_widths(database)
    product = database.products["levels"]
    return (
        BlindLevel(half_width, database, np.arange(len(database.mag))),
        *(_level(database, product, row, half) for row, half in enumerate(others)),
    )


def half_widths(database: MatcherDatabase) -> list[float]:
    """Return `BlindLevel.half_width` of each level; `ProductError` without levels."""
    database.check_has_products("an onboard image serves one field of view", key="fov")
    for name in ("levels", "triangles"):
        if name not in database.products:
            raise ProductError(
                f"{database.name}: has no product {name!r}, so that it serves one field of view",
                product=name,
                hint=f"set 'products.{name}.enabled = true' in its spec and build it again",
            )
    camera, product = database.camera, database.products["levels"]
    if not len(product["level"]):
        raise damaged("levels", "level", "is empty")
    across, down = (np.tan(np.radians(0.5 * product[f"fov_{axis}_deg"])) for axis in "xy")
    half_width = 0.5 * math.sqrt(camera.width_px * camera.height_px) / camera.focal_length_px
    return [half_width, *np.sqrt(across * down).tolist()]


def _level(
    database: MatcherDatabase, product: ProductArrays, row: int, half_width: float
) -> BlindLevel:
    stars = _list(product, "stars", row)
    lists = [_list(product, name, row) for name in "ijk"]
    is_sound = len({len(column) for column in lists}) == 1 and bool((stars[1:] > stars[:-1]).all())
    if not is_sound or not all(np.isin(column, stars).all() for column in lists):
        raise damaged("levels", f"level {row + 1}", "has triangles that are not of its stars")
    corners = np.searchsorted(stars, np.stack(lists))
    part = replace(
        database,
        star_id=database.star_id[stars],
        directions=database.directions[stars],
        mag=database.mag[stars],
        designation=database.designation[stars],
        products={"triangles": _triangles(corners, database.directions[stars])},
    )
    return BlindLevel(half_width, part, stars)


def _list(product: ProductArrays, name: str, row: int) -> NDArray[np.int64]:
    offsets = product[f"{name}_offsets"]
    values = product[f"{name}_values"][offsets[row] : offsets[row + 1]]
    return np.asarray(values, dtype=np.int64)


def _triangles(corners: NDArray[np.int64], directions: NDArray[np.float64]) -> ProductArrays:
    """Return the columns by which triangles of an unknown scale are looked up."""
    u, v, w = (directions[rows] for rows in corners)
    a, b, c = (
        2.0 * np.arcsin(0.5 * np.linalg.norm(begin - end, axis=1))
        for begin, end in ((v, w), (u, w), (u, v))
    )
    area = triangle_area(a, b, c)
    radius = np.divide(a * b * c, 4.0 * area, out=np.full(len(a), np.inf), where=area > 0.0)
    columns: dict[str, NDArray[Any]] = dict(zip("ijk", corners, strict=True))
    columns |= {"area_rad2": area.astype(np.float32), "circumradius_rad": radius.astype(np.float32)}
    return ProductArrays(columns)


@dataclass(frozen=True)
class ImagePart:
    """A part of a range of focal lengths, and the level that serves it."""

    level: BlindLevel
    low_px: float
    high_px: float

    @property
    def focal_length_px(self) -> float:
        """The middle, of which both ends are the same factor away."""
        return math.sqrt(self.low_px * self.high_px)

    @property
    def fov_error(self) -> float:
        """Largest relative error of the middle."""
        return 1.0 - math.sqrt(self.low_px / self.high_px)


@dataclass(frozen=True)
class _Search:
    """The frame of one part, its candidates, and the best agreement so far."""

    part: ImagePart
    whole: Observation
    used: Observation
    best: BestOf


def parts_of_range(
    all_levels: Sequence[BlindLevel], camera: Camera, fov_deg: tuple[float, float]
) -> list[ImagePart]:
    """Return the parts of a range of fields of view."""
    narrow_deg, wide_deg = checked_fields(fov_deg)
    low_px, high_px = (_focal_px(camera, angle) for angle in (wide_deg, narrow_deg))
    ends = _ends_px([level.half_width for level in all_levels], camera)
    if high_px > ends[0] or low_px < ends[-1]:
        raise _beyond_levels(all_levels[0].database, camera, fov_deg, ends)
    parts = [
        ImagePart(level, max(low_px, low), min(high_px, high))
        for level, (high, low) in zip(all_levels, pairwise(ends), strict=True)
    ]
    return [part for part in reversed(parts) if part.low_px < part.high_px]


def fields_served(
    database: MatcherDatabase, camera: Camera, fov_deg: tuple[float, float]
) -> tuple[float, float]:
    """Return the part of a range of fields of view that a database serves for a camera's frames.

    `ConfigError` if it serves none of it; `ProductError` if it serves one field of view only.
    """
    narrow_deg, wide_deg = checked_fields(fov_deg)
    ends = _ends_px(half_widths(database), camera)
    # Rounded inwards, so that the search accepts the part that is returned.
    narrowest_deg = math.ceil(1e6 * _fov_deg(camera, ends[0])) / 1e6
    widest_deg = math.floor(1e6 * _fov_deg(camera, ends[-1])) / 1e6
    if wide_deg <= narrowest_deg or narrow_deg >= widest_deg:
        raise _beyond_levels(database, camera, fov_deg, ends)
    return max(narrow_deg, narrowest_deg), min(wide_deg, widest_deg)


def check_range_served(
    database: MatcherDatabase, camera: Camera, fov_deg: tuple[float, float]
) -> None:
    """Check that a database serves a whole range of fields of view for a camera's frames."""
    if fields_served(database, camera, fov_deg) != checked_fields(fov_deg):
        ends = _ends_px(half_widths(database), camera)
        raise _beyond_levels(database, camera, fov_deg, ends)


def checked_fields(fov_deg: Any) -> tuple[float, float]:
    """Return the narrowest and the widest field of view of a range."""
    narrow_deg, wide_deg = checked_pair("fov_deg", fov_deg)
    if not 0.0 < narrow_deg < wide_deg < 180.0:
        raise ConfigError(
            "expected two fields of view between 0 and 180 deg, the narrower one first",
            parameter="fov_deg",
            value=AsWritten(f"{narrow_deg:g} to {wide_deg:g}"),
        )
    return narrow_deg, wide_deg


def _ends_px(half_widths: Sequence[float], camera: Camera) -> list[float]:
    """Return the focal lengths at which the levels begin, descending, and where the last ends."""
    ends = [_focal_length_px(half, camera) for half in half_widths]
    ends.append(ends[-1] ** 2 / ends[-2])
    ends[0], ends[-1] = ends[0] * BEYOND, ends[-1] / BEYOND
    return ends


def _beyond_levels(
    database: MatcherDatabase, camera: Camera, fov_deg: tuple[float, float], ends: Sequence[float]
) -> ConfigError:
    # The fields that the levels are made for: the numbers of the message are rounded.
    narrowest_deg, widest_deg = (
        _fov_deg(camera, ends[0] / BEYOND),
        _fov_deg(camera, ends[-1] * BEYOND),
    )
    return ConfigError(
        f"{database.name} is for fields of {narrowest_deg:.4g} to {widest_deg:.4g} deg across the "
        f"width if a frame has {camera.width_px} x {camera.height_px} px",
        parameter="fov_deg",
        value=AsWritten(f"{fov_deg[0]:g} to {fov_deg[1]:g}"),
        hint=(
            "State a range within these",
            "build a database for such fields ('starcat init' with their range)",
        ),
    )


def _fov_deg(camera: Camera, focal_px: float) -> float:
    return 2.0 * math.degrees(math.atan(0.5 * camera.width_px / focal_px))


def _focal_length_px(half_width: float, camera: Camera) -> float:
    """Return the focal length with which a detector has a level's field of view."""
    return 0.5 * math.sqrt(camera.width_px * camera.height_px) / half_width


def _focal_px(camera: Camera, fov_x_deg: float) -> float:
    return 0.5 * camera.width_px / math.tan(math.radians(0.5 * fov_x_deg))


def identify_blind(
    settings: Settings, database: MatcherDatabase, frame: Frame, fov_deg: tuple[float, float]
) -> MatchResult:
    """Identify a frame of a camera if only a range of its field of view is known.

    The false-match probability of an answer is its level's probability times the number of levels
    that were searched. The bound of one level counts all attitudes and all focal lengths of its
    part of the range (`false_match_probability`), with the number of its own stars in the frame.
    The parts cover the whole range and do not overlap, and the probability that chance agrees in
    any of K parts is at most the sum of their K probabilities. So an answer is withheld if its
    bound in its part is above the limit divided by K. Only the brightest of many spots are
    compared. Which spots these are does not depend on their positions in the frame, so the bound
    holds for them as for a frame without other spots.
    """
    check_scale_free(settings)
    parts = parts_of_range(database.cached(levels), frame.camera, fov_deg)
    budget = Budget(settings.max_steps, settings.time_limit_s)
    certain = certainty(settings) / len(parts)
    searches = [_begun(part, settings, frame, budget, certain) for part in parts]
    if len(searches[0].whole) < MIN_STARS:
        return result_of_search(None, searches[0].whole, database)
    limit = _run(searches)
    best = searches[0]
    for other in searches[1:]:
        if other.best.agreement is not None and other.best.agreement.is_better_than(
            best.best.agreement
        ):
            best = other
    agreement = best.best.agreement
    if agreement is not None:
        rows = np.append(best.part.level.rows, -1)  # a centroid without a star has row -1
        index = np.full(len(best.whole), -1, dtype=np.int32)
        index[: len(agreement.star_index)] = rows[agreement.star_index]
        log_chance = min(0.0, agreement.log_chance + math.log(len(parts)))
        agreement = replace(agreement, star_index=index, log_chance=log_chance)
    return result_of_search(agreement, best.whole, database, limit)


def _begun(
    part: ImagePart, settings: Settings, frame: Frame, budget: Budget, certain: float
) -> _Search:
    eye = Camera(frame.camera.width_px, frame.camera.height_px, part.focal_length_px)
    error = min(part.fov_error, OPTIONS["fov_error"].high)
    whole = used = observe(replace(frame, camera=eye), settings, fov_error=error, budget=budget)
    if whole.mag is not None:
        used = whole.first(MAX_CENTROIDS)
        if settings.selection == TriangleOrder():
            used = replace(used, settings=replace(settings, selection=BRIGHTEST))
    return _Search(part, whole, used, BestOf(certain))


def _run(searches: Sequence[_Search]) -> Limit | None:
    """Search a batch of each part in turn, and return the limit that ended it."""
    waiting = [
        (search, filter(len, proposals(search.used, search.part.level.database)))
        for search in searches
    ]
    try:
        while waiting:
            remaining = []
            for search, batches in waiting:
                if (candidates := next(batches, None)) is None:
                    continue
                _verify(candidates, search)
                if search.best.is_certain:
                    return None
                remaining.append((search, batches))
            waiting = remaining
    except BudgetSpentError as spent:
        return spent.limit
    return None


def _verify(candidates: Candidates, search: _Search) -> None:
    """Work out the agreements of the candidates that stand out, until one is certain.

    Each level has thousands of candidates for a frame, nearly all of them false. Besides its own
    three centroids, a false candidate has as many agreeing centroids as chance brings near stars: a
    Poisson variate with the mean of the batch. Only unusually high numbers are worked out.
    """
    frame, database = search.used, search.part.level.database
    matrices, factors, counts = [], [], []
    for first in range(0, len(candidates), AT_ONCE):
        part = candidates[first : first + AT_ONCE]
        frame.budget.spend(len(part))
        turned, scaled = first_poses(part, frame, database.directions)
        matrices.append(turned)
        factors.append(scaled)
        counts.append(agreeing_centroids(turned, frame, database, scaled))
    count = np.concatenate(counts)
    order = np.argsort(-count, kind="stable")
    for row in order[count[order] >= _standing_out(count)].tolist():
        batch, offset = divmod(row, AT_ONCE)
        pose = pose_at(matrices[batch][offset], float(factors[batch][offset]), frame)
        search.best.offer(agree(pose, frame, database, search.best.certain))
        if search.best.is_certain:
            return


def _standing_out(count: NDArray[np.int64]) -> int:
    """Return how many centroids agree with no more than `BY_CHANCE` of some false candidates."""
    mean = float(np.maximum(count - _OWN, 0).mean())
    expected, term, more = float(len(count)), math.exp(-mean), 0
    while expected > BY_CHANCE:
        expected -= len(count) * term
        more += 1
        term *= mean / more
    return max(MIN_STARS, _OWN + more)
