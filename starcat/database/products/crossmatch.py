"""The product ``crossmatch``: which entry of another catalog is which guide star.

All pairs of a star and an entry within a radius are compared at one epoch. Each has one likelihood
ratio, from published numbers, separation and magnitudes, and a verdict against the other pairs of
its star and of its entry. The pipeline reads the catalogs (`starcat.pipeline.counterparts`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import scipy
from numpy.typing import NDArray
from pydantic import Field, model_validator

from starcat.arrays import Array, Directions, Mask
from starcat.catalog.stars.positions import Positions
from starcat.catalog.stars.proper_motion import MAS
from starcat.catalog.stars.star_table import floats_of
from starcat.database.products.kind import Extent, ProductKind, ProductSection, SpecFacts
from starcat.geometry.sphere import chord_from_separation, saff_kuijlaars, separation
from starcat.sections import CatalogName, Mag
from starcat.storage.schema import product_schema

Rows = NDArray[np.int64]

NEEDED = (
    *("star_id", "catalog", "designation", "ra_deg", "dec_deg", "epoch_jyear"),
    *("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "mag", "band"),
)
"""Columns of a star table that a cross-identification reads."""

NUMBERS = ("hip_number", "hd_number")
"""Columns with published numbers, which a star table can lack."""

VERDICTS = ("unique", "ambiguous", "none")
"""Verdicts on a candidate."""

OLD_VERDICTS = ("best", "taken", "doubtful", "other")
"""Verdicts of schema 1.0.0: ``best`` is ``unique`` now, and the others are ``none``."""

ARCSEC = 1000.0 * MAS  # rad

TILES = 3072
"""Number of pieces of the sky, 13 square degrees each, in which stars are counted."""

MIN_MEASURED = 20
"""Least number of pairs without competing pairs from which anything is measured."""

MIN_ERROR_ARCSEC = 0.01
"""Smallest credible error of a position: if measured errors are smaller, one catalog has copied
the positions of the other."""

SEPARATION_TOLERANCE_ARCSEC = 1e-6
"""Two ways to move a star a century differ by less (docs/algorithms.md, Positions)."""


class Crossmatch(ProductSection):
    """Counterparts of the guide stars in other catalogs."""

    enabled: bool = Field(False, description="whether the database has this product")
    catalogs: tuple[CatalogName, ...] = Field(
        (),
        strict=False,  # a list in TOML
        description="star catalogs to look for counterparts in",
        examples=[["hipparcos"]],
    )
    radius_arcsec: float = Field(
        10.0, ge=0.001, le=600.0, description="largest separation of a candidate"
    )
    position_error_arcsec: float | None = Field(
        None,
        ge=0.0001,
        le=60.0,
        description="standard deviation of the difference of two positions of a star, each axis; "
        "default: measured",
    )
    unknown_motion_mas_yr: float = Field(
        20.0,
        ge=0.0,
        le=10_000.0,
        description="standard deviation of the motion of a pair in which neither has one",
    )
    outlier_share: float = Field(
        0.02,
        ge=0.0,
        le=0.99,
        description="share of the stars that are off by more than their stated errors",
    )
    expected_delta_mag: Mag | None = Field(
        None, description="magnitude of the counterpart minus the star's; default: measured"
    )
    colour_spread_mag: float = Field(
        1.0, ge=0.01, le=30.0, description="standard deviation of that difference"
    )
    completeness: float | None = Field(
        None, ge=0.001, le=0.999, description="share of stars with a counterpart; default: measured"
    )
    ambiguous_odds: float = Field(
        10.0, ge=1.0, le=1e6, description="candidates that differ by no more are ambiguous"
    )
    min_probability: float = Field(
        0.5, ge=0.0, le=1.0, description="candidates that together have less are no counterparts"
    )
    read_limit_mag: Mag | None = Field(
        None, description="fainter counterparts are counted while reading, not listed"
    )

    @model_validator(mode="after")
    def _has_catalogs(self) -> Crossmatch:
        if self.enabled and not self.catalogs:
            raise ValueError('no catalogs; name some, such as catalogs = ["hipparcos"]')
        return self

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the catalogs that counterparts are looked for in."""
        return self.catalogs if self.enabled else ()

    def check_agrees(self, facts: SpecFacts) -> None:
        """Check that the catalog of the stars is not among the catalogs."""
        if facts.catalog in self.catalogs:
            raise ValueError(
                f"products.crossmatch.catalogs: {facts.catalog} is the catalog of the stars "
                "themselves; name others"
            )


@dataclass(frozen=True)
class Matches:
    """Every candidate of every star, in order of (star, rank), and the figures of the odds."""

    table: pa.Table  # rows of the product ``crossmatch``
    counterpart: Rows  # rows of the counterparts
    position_error_arcsec: float  # given or measured, as the others
    expected_delta_mag: float
    completeness: float  # share of the stars that have a counterpart


def crossmatch(stars: pa.Table, counterparts: pa.Table, options: Crossmatch) -> Matches:
    """Find the counterparts of the stars of one star table in another.

    The likelihood ratio of a pair is ``L = Q q(dm) f(r) / n(m)``: Q is the share of stars with a
    counterpart, f the density of a star's own counterpart at the separation r, q its density in
    magnitude, n the density of all others on the sky and in magnitude. A published number that the
    two share, and no other of their candidates, multiplies it by the number of counterparts, any
    of which could have the number.

    A pair weighs ``w = L / ((1 - Q) (1 - S))``: L compares the candidate with all stars of the
    neighbourhood, of which a share S are counterparts of other stars. The weights of competing
    pairs give probabilities, which decide ranks and verdicts. Of equally probable pairs the nearer
    one, then the lower row, comes first.

    References
    ----------
    Sutherland and Saunders 1992, MNRAS 259, 413, section 2. Q: Fleuren et al. 2012, MNRAS 423,
    2407.
    """
    radius_rad = options.radius_arcsec * ARCSEC
    positions, other_positions = Positions.of(stars), Positions.of(counterparts)
    i, j, epoch, angle = candidate_pairs(positions, other_positions, radius_rad)
    mag = floats_of(counterparts, "mag")
    delta = mag[j] - floats_of(stars, "mag")[i]
    n_candidates, n_stars = np.bincount(i)[i], np.bincount(j)[j]
    is_sure = (n_candidates == 1) & (n_stars == 1)
    density = _density(other_positions.directions, positions.directions)

    error_arcsec, middle_mag = options.position_error_arcsec, options.expected_delta_mag
    if error_arcsec is None:
        # Separations have Rayleigh's distribution, whose median is sqrt(2 ln 2) errors.
        apart = angle[is_sure] / (np.sqrt(2.0 * np.log(2.0)) * ARCSEC)
        error_arcsec = min(1.0, 0.2 * options.radius_arcsec)
        if len(apart) >= MIN_MEASURED:
            error_arcsec = max(float(np.median(apart)), MIN_ERROR_ARCSEC)
    if middle_mag is None:
        known_delta = delta[is_sure & ~np.isnan(delta)]
        middle_mag = float(np.median(known_delta)) if len(known_delta) >= MIN_MEASURED else 0.0
    if (share := options.completeness) is None:
        # Stars without a candidate, over the stars that would have none at random places.
        blank = 1.0 - np.count_nonzero(np.bincount(i)) / max(len(stars), 1)
        by_chance = np.exp(-np.sort(density) * np.pi * radius_rad**2)
        share = float(np.clip(1.0 - blank / by_chance.mean(), 0.001, 0.999)) if len(stars) else 0.5
    shared = min(share * len(stars) / max(len(counterparts), 1), 0.999)
    still = ~(positions.has_motion[i] | other_positions.has_motion[j])
    years = other_positions.epoch_jyear[j] - positions.epoch_jyear[i]
    unmoved_arcsec = 1e-3 * options.unknown_motion_mas_yr * np.where(still, years, 0.0)
    error = np.hypot(error_arcsec, unmoved_arcsec) * ARCSEC

    ratio = np.log(share) + np.logaddexp(
        *log_position_densities(angle, error, radius_rad, options.outlier_share)
    )
    ratio += _log_magnitude(delta - middle_mag, options.colour_spread_mag, mag, j)
    ratio -= np.log(density[i])
    ratio[_has_same_number(stars, counterparts, i, j)] += np.log(max(len(counterparts), 1))
    weight = np.exp(ratio) / ((1.0 - share) * (1.0 - shared))
    probability = pair_probabilities(i, j, weight)
    log_p = np.log(np.maximum(probability, 1e-300))
    rank, lead = _ranks(i, log_p, angle, j)
    star_rank, star_lead = _ranks(j, log_p, angle, i)
    near, of_star = float(np.log(options.ambiguous_odds)), np.bincount(i, weight)[i]
    verdict = np.full(len(i), "unique", dtype=object)
    verdict[(lead <= near) | (star_lead <= near)] = "ambiguous"
    verdict[(lead < -near) | (star_lead < -near)] = "none"
    verdict[of_star < options.min_probability * (1.0 + of_star)] = "none"

    other = counterparts.select(NEEDED).take(pa.array(j)).combine_chunks()
    columns = {name: other[name] for name in NEEDED} | {
        "star": i,
        "counterpart_id": other["star_id"],
        "rank": rank,
        "star_rank": star_rank,
        "n_candidates": n_candidates,
        "n_stars": n_stars,
        "compared_jyear": epoch,
        "separation_arcsec": np.degrees(angle) * 3600.0,
        "delta_mag": pa.array(delta, mask=np.isnan(delta)),
        "position_error_arcsec": error / ARCSEC,
        "log10_likelihood_ratio": ratio / np.log(10.0),
        "probability": probability,
        "verdict": verdict,
    }
    schema, order = product_schema("crossmatch").arrow_schema, np.lexsort((rank, i))
    table = pa.table([columns[name] for name in schema.names], schema.names).cast(schema)
    table = table.take(pa.array(order)).combine_chunks()
    return Matches(table, j[order], error_arcsec, middle_mag, share)


def pair_probabilities(i: Rows, j: Rows, weight: Array) -> Array:
    """Return the probability that star i and counterpart j of each pair are one star.

    The other pairs of the star and of the counterpart compete with the pair, but each of them only
    as far as its other end is free: a neighbour that has a better counterpart of its own does not
    make this pair less likely. Two rounds estimate how free each end of a pair is from the other
    pairs there. They average logarithms, or the estimates would swing; further rounds drift,
    because a claim comes back around a ring of pairs. The result is the smaller of two
    probabilities, among the pairs of the star and among the pairs of the counterpart, so that
    neither sum exceeds 1.
    """
    star_free = counterpart_free = np.ones(len(weight))
    for _ in range(2):
        star_claims = _sum_of_others(i, weight * counterpart_free)
        counterpart_claims = _sum_of_others(j, weight * star_free)
        star_free = np.sqrt(star_free / (1.0 + star_claims))
        counterpart_free = np.sqrt(counterpart_free / (1.0 + counterpart_claims))
    among_candidates, among_stars = weight * counterpart_free, weight * star_free
    return np.minimum(
        among_candidates / (1.0 + np.bincount(i, among_candidates)[i]),
        among_stars / (1.0 + np.bincount(j, among_stars)[j]),
    )


def _sum_of_others(group: Rows, values: Array) -> Array:
    """Return the sum over the other pairs of each pair's group.

    The largest is added last: a total less a value that is nearly all of it has no digits left.
    """
    largest = np.zeros(group.max(initial=-1) + 1)
    np.maximum.at(largest, group, values)
    is_largest = values == largest[group]
    smaller = np.where(is_largest, 0.0, values)
    others = np.bincount(group, is_largest)[group] - is_largest
    return np.asarray(np.bincount(group, smaller)[group] - smaller + others * largest[group])


def candidate_pairs(
    stars: Positions, counterparts: Positions, radius_rad: float
) -> tuple[Rows, Rows, Array, Array]:
    """Find every pair within a radius, itself included, in order of (star, counterpart).

    Returns rows of stars, rows of counterparts, the Julian year at which they are compared, and
    their separation there, radians. A star with proper motion is moved to its candidate's epoch,
    a candidate with proper motion to the epoch of a star without.

    In the middle of all epochs the two are farther apart than the radius by their motions at most:
    Barnard's star reaches 10 arcsec per year, most stars next to nothing.
    """
    epochs = np.append(stars.epoch_jyear, counterparts.epoch_jyear)
    first, last = (epochs.min(), epochs.max()) if len(epochs) else (0.0, 0.0)
    middle, years = 0.5 * (first + last), 0.5 * (last - first)
    near = [np.empty((2, 0), dtype=np.int64)]
    others = list(_by_reach(counterparts, middle, years, radius_rad))
    for rows, tree, reach in _by_reach(stars, middle, years, radius_rad):
        for other_rows, other_tree, other_reach in others:
            # Separations are compared exactly below.
            chord = chord_from_separation(radius_rad + reach + other_reach) * (1.0 + 1e-9) + 1e-14
            pairs = tree.sparse_distance_matrix(other_tree, chord, output_type="ndarray")
            near.append(np.stack([rows[pairs["i"]], other_rows[pairs["j"]]]))
    i, j = np.concatenate(near, axis=1)
    only_candidate = counterparts.has_motion[j] & ~stars.has_motion[i]
    epoch = np.where(only_candidate, stars.epoch_jyear[i], counterparts.epoch_jyear[j])
    angle = separation(stars.at(epoch, i), counterparts.at(epoch, j))
    order = np.lexsort((j, i))
    order = order[angle[order] <= radius_rad]
    return i[order], j[order], epoch[order], angle[order]


def _by_reach(
    positions: Positions, middle_jyear: float, years: float, radius_rad: float
) -> Iterator[tuple[Rows, scipy.spatial.cKDTree, float]]:
    """Yield groups of stars that move about as far in some years, the slow ones together.

    Each has rows, a tree of directions in the middle of the epochs, and the farthest motion of a
    star, radians.
    """
    motion = positions.motion.pm_ra_cosdec_mas_yr, positions.motion.pm_dec_mas_yr
    reach = np.where(positions.has_motion, np.hypot(*motion), 0.0) * MAS * years
    level = np.ceil(np.log2(np.maximum(reach / radius_rad, 1.0)))
    directions = positions.at(middle_jyear)
    for rows in (np.flatnonzero(level == number) for number in np.unique(level)):
        # A plain split by midpoints builds far faster and searches no slower on a sky of stars.
        tree = scipy.spatial.cKDTree(directions[rows], leafsize=32, balanced_tree=False)
        yield rows, tree, float(reach[rows].max())


def _density(directions: Directions, star_directions: Directions) -> Array:
    """Return the counterparts per steradian around stars, over 9 tiles of the sky, never 0."""
    middles = saff_kuijlaars(TILES)
    tree = scipy.spatial.cKDTree(middles)
    count = np.bincount(tree.query(directions)[1], minlength=TILES)
    around = np.maximum(count[tree.query(middles, k=9)[1]].sum(axis=1), 1)
    return np.asarray(around[tree.query(star_directions)[1]] * TILES / (9.0 * 4.0 * np.pi))


def log_position_densities(
    angle: Array, error: Array, radius_rad: float, outlier_share: float
) -> tuple[Array, Array]:
    """Return the logarithms of the two parts of f: of normal errors, and of outliers.

    Outliers have no scale of their own: between the error and the radius every factor of
    separation is as likely as any other, so that their density falls with its square.
    """
    normal = -0.5 * (angle / error) ** 2 - np.log(2.0 * np.pi * error**2)
    scales = 0.5 + np.log(np.maximum(radius_rad / error, 1.0))
    with np.errstate(divide="ignore"):  # there may be no outliers
        far = np.log(outlier_share / (2.0 * np.pi * np.maximum(angle, error) ** 2 * scales))
    return np.log1p(-outlier_share) + normal, far


def _log_magnitude(off_mag: Array, spread_mag: float, mag: Array, j: Rows) -> Array:
    """Return the logarithm of q over the density of all magnitudes, in bins of half a magnitude.

    It is 0 if a magnitude is unknown.
    """
    ratio, has_mags, mags = np.zeros(len(j)), ~np.isnan(off_mag), mag[~np.isnan(mag)]
    if has_mags.any():
        edges = np.arange(np.floor(mags.min()) - 1.0, mags.max() + 1.5, 0.5)
        density = np.histogram(mags, edges)[0] / (0.5 * len(mags))
        of_others = np.interp(mag[j[has_mags]], edges[:-1] + 0.25, density)
        of_counterpart = np.exp(-0.5 * (off_mag[has_mags] / spread_mag) ** 2) / (
            spread_mag * np.sqrt(2.0 * np.pi)
        )
        ratio[has_mags] = np.log(np.maximum(of_counterpart, 1e-300) / of_others)
    return ratio


def _has_same_number(stars: pa.Table, counterparts: pa.Table, i: Rows, j: Rows) -> Mask:
    """Return which pairs share a published number that no other candidate of either has."""
    alike = np.zeros(len(i), dtype=bool)
    for name in {*stars.column_names} & {*counterparts.column_names} & {*NUMBERS}:
        rows = np.flatnonzero(floats_of(stars, name)[i] == floats_of(counterparts, name)[j])
        once = (np.bincount(i[rows])[i[rows]] == 1) & (np.bincount(j[rows])[j[rows]] == 1)
        alike[rows[once]] = True
    return alike


def _ranks(group: Rows, log_p: Array, angle: Array, other: Rows) -> tuple[Rows, Array]:
    """Return each pair's rank within its group, from 1, and its lead over the likeliest other pair.

    Leads are differences of ``log_p``, infinite without another pair.
    """
    order = np.lexsort((other, angle, -log_p, group))
    rank = np.empty(len(group), dtype=np.int64)
    rank[order] = np.arange(len(group)) - np.searchsorted(group[order], group[order]) + 1
    first, second = np.full((2, group.max(initial=-1) + 1), -np.inf)
    first[group[rank == 1]] = log_p[rank == 1]
    second[group[rank == 2]] = log_p[rank == 2]
    return rank, log_p - np.where(rank == 1, second[group], first[group])


def matched_rows(table: pa.Table) -> NDArray[np.intp]:
    """Return the rows that name the counterpart of a star, including ambiguous ones."""
    named = pc.is_in(table["verdict"], pa.array(["unique", "ambiguous", OLD_VERDICTS[0]]))
    return np.flatnonzero(named.to_numpy() & (table["rank"].to_numpy() == 1))


def counterparts_of(table: pa.Table, catalog: str) -> int:
    """Return how many stars have a counterpart in a catalog."""
    return len(matched_rows(table.filter(pc.equal(table["catalog"], catalog))))


def counterpart_problems(table: pa.Table, stars: pa.Table) -> Iterator[str]:
    """Yield contradictions within the crossmatch product, and with the stars."""
    paired_stars = stars.take(table["star"].combine_chunks())
    epoch = floats_of(table, "compared_jyear")
    angle = separation(*(Positions.of(each).at(epoch) for each in (paired_stars, table)))
    off = np.abs(np.degrees(angle) * 3600.0 - floats_of(table, "separation_arcsec"))
    expected = floats_of(table, "mag") - floats_of(paired_stars, "mag")
    delta = floats_of(table, "delta_mag")
    same = (expected == delta) | (np.isnan(expected) & np.isnan(delta))
    star, catalog = table["star"].to_numpy(), table["catalog"].to_numpy()
    begins = np.diff(star, prepend=-1) != 0
    begins[1:] |= catalog[1:] != catalog[:-1]
    group = np.cumsum(begins) - 1
    ranks = np.arange(len(table)) - np.flatnonzero(begins)[group] + 1
    p = table["probability"].to_numpy()
    is_possible = (p >= 0.0) & (p <= 1.0) & (np.bincount(group, p)[group] <= 1.0 + 1e-9)  # rounding
    of_pair = "is not that of its star and its counterpart"
    for name, is_right, problem in (
        ("separation_arcsec", off <= SEPARATION_TOLERANCE_ARCSEC, of_pair),
        ("delta_mag", same, of_pair),
        ("rank", table["rank"].to_numpy() == ranks, "is not {}, its place among its candidates"),
        (
            "n_candidates",
            table["n_candidates"].to_numpy() == np.bincount(group)[group],
            "is not the number of its star's rows",
        ),
        ("probability", is_possible, "is over 1, or the candidates of its star share more than 1"),
    ):
        for row in np.flatnonzero(~is_right)[:1]:
            yield f"{name} of row {row} {problem.format(ranks[row])}"
    unknown = set(pc.unique(table["verdict"]).to_pylist()) - {*VERDICTS, *OLD_VERDICTS}
    if unknown:
        yield f"verdict {', '.join(sorted(unknown))}; expected one of {', '.join(VERDICTS)}"


KIND = ProductKind(
    name="crossmatch",
    section=Crossmatch,
    in_database=False,
    count=lambda inputs, section: Extent(float(len(inputs.directions) * len(section.catalogs))),
    problems=counterpart_problems,
    joined=(counterparts_of, "have a counterpart"),
)
