"""Cross-identification: candidates, epochs, odds and verdicts, by hand and by other means."""

from __future__ import annotations

import math
from dataclasses import replace

import erfa
import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from starcat.geometry.sphere import (
    directions_from_radec,
    radec_from_directions,
    saff_kuijlaars,
    separation,
    tangent_axes,
)
from starcat.products.match_figures import ARCSEC, TILES, MagnitudeCounts, MatchModel
from starcat.products.match_odds import pair_probabilities
from starcat.products.match_stars import VERDICTS, Matches, MovingStars, candidate_pairs, crossmatch

Array = NDArray[np.float64]

RADIUS = 10.0 * ARCSEC
SURE = MatchModel(
    position_error_rad=0.5 * ARCSEC, expected_delta_mag=0.0, completeness=0.9, outlier_share=0.02
)

# Both move the star along the same straight line; ERFA by way of space motion.
EPOCH_TOLERANCE_RAD = 1e-6 * ARCSEC


def moving(
    ra_deg: object, dec_deg: object, pm_ra_arcsec: object = 0.0, pm_dec_arcsec: object = 0.0,
    epoch: object = 2000.0, mag: object = 7.0, moves: object = True,
) -> MovingStars:  # fmt: skip
    ra, dec = np.atleast_1d(np.asarray(ra_deg, float)), np.atleast_1d(np.asarray(dec_deg, float))
    pm_ra, pm_dec, epoch_jyear, mags, known = (
        np.broadcast_to(values, len(ra)).astype(kind)
        for values, kind in (
            (pm_ra_arcsec, float), (pm_dec_arcsec, float), (epoch, float), (mag, float),
            (moves, bool),
        )
    )  # fmt: skip
    east, north = tangent_axes(ra, dec)
    velocity = (east * pm_ra[:, None] + north * pm_dec[:, None]) * ARCSEC * known[:, None]
    return MovingStars(directions_from_radec(ra, dec), velocity, known, epoch_jyear, mags)


def beside(*offsets_arcsec: float, mag: object = 7.0, **more: object) -> MovingStars:
    """Stars on the equator, this many arcsec east of right ascension 10 deg."""
    ra = 10.0 + np.array(offsets_arcsec) / 3600.0
    return moving(ra, np.zeros(len(ra)), mag=mag, **more)


def rows(found: Matches) -> list[tuple[int, int, int, str]]:
    words = [VERDICTS[k] for k in found.verdict]
    return list(zip(found.star, found.counterpart, found.rank, words, strict=True))


# Verdicts -----------------------------------------------------------------------------------


SURELY, HARDLY = pytest.approx(1.0, abs=1e-3), pytest.approx(0.0, abs=1e-2)
HALF, THIRD = pytest.approx(0.5, abs=0.02), pytest.approx(1.0 / 3.0, abs=0.01)


@pytest.mark.parametrize(
    ("stars", "others", "expected", "probability"),
    [
        ([0.0, 500.0], [0.3, 900.0], [(0, 0, 1, "unique")], [SURELY]),
        # The nearer of two alike is best.
        ([0.0], [6.0, 0.2], [(0, 1, 1, "best"), (0, 0, 2, "other")], [SURELY, HARDLY]),
        ([0.0], [-0.41, 0.4], [(0, 1, 1, "ambiguous"), (0, 0, 2, "ambiguous")], [HALF, HALF]),
        # Neither star can be certain of a counterpart that only one can have.
        ([-0.41, 0.4], [0.0], [(0, 0, 1, "ambiguous"), (1, 0, 1, "ambiguous")], [HALF, HALF]),
        # A candidate that fits another star is taken.
        ([0.0, 6.0], [0.1], [(0, 0, 1, "best"), (1, 0, 1, "taken")], [SURELY, HARDLY]),
        # Equal odds and separations go by row.
        ([0.0], [0.5] * 3, [(0, k, k + 1, "ambiguous") for k in range(3)], [THIRD] * 3),
    ],
)
def test_verdicts_on_few_stars(stars, others, expected, probability):
    found = crossmatch(beside(*stars), beside(*others), RADIUS, SURE)
    assert rows(found) == expected
    assert found.odds.probability.tolist() == probability


def test_the_magnitude_decides_between_two_as_near():
    found = crossmatch(beside(0.0, mag=7.0), beside(-0.4, 0.4, mag=[11.0, 7.1]), RADIUS, SURE)
    assert rows(found) == [(0, 1, 1, "best"), (0, 0, 2, "other")]
    assert found.delta_mag == pytest.approx([0.1, 4.0])


def test_a_resolved_double_is_two_sure_pairs():
    found = crossmatch(beside(0.0, 5.0), beside(0.1, 5.1), RADIUS, SURE)
    assert [row for row in rows(found) if row[2] == 1] == [(0, 0, 1, "best"), (1, 1, 1, "best")]
    assert (found.odds.probability[found.rank == 1] > 0.99).all()


def test_a_faint_star_far_off_in_a_crowd_is_doubtful(random_directions):
    crowd = random_directions(400_000, 3)
    near = beside(8.0, mag=12.0)
    directions = np.concatenate([near.directions, crowd])
    others = moving(*radec_from_directions(directions), mag=12.0, moves=False)
    found = crossmatch(beside(0.0, mag=7.0), others, RADIUS, SURE)
    assert rows(found)[0] == (0, 0, 1, "doubtful")
    assert found.odds.any_probability[0] < 0.5


@pytest.mark.parametrize("limit", [1.0, 10.0, 1e6])
def test_ambiguity_is_what_the_model_says(limit):
    model = replace(SURE, ambiguous_odds=limit, outlier_share=0.0)
    found = crossmatch(beside(0.0), beside(0.5, 1.5), RADIUS, model)
    # exp((1.5^2 - 0.5^2) / (2 * 0.5^2)) = exp(4) = 54.6
    expected = "ambiguous" if limit > 54.6 else "best"
    assert VERDICTS[found.verdict[0]] == expected
    ratio = math.exp(found.odds.log_ratio[0] - found.odds.log_ratio[1])
    assert ratio == pytest.approx(math.exp(4.0), rel=1e-6)


# Odds ---------------------------------------------------------------------------------------


def lattice(per_tile: int) -> Array:
    """The same number of stars in every tile that the density is counted in."""
    return np.repeat(saff_kuijlaars(TILES), per_tile, axis=0)


def test_without_magnitudes_the_ratio_is_the_bayes_factor():
    others = lattice(5)
    counterparts = moving(*radec_from_directions(others), mag=np.nan, moves=False)
    counterparts = replace(counterparts, error_rad=np.full(len(others), 0.3 * ARCSEC))
    ra, dec = radec_from_directions(others[5 * 700][None])
    star = moving(ra, dec + 0.7 / 3600.0, mag=7.0)
    star = replace(star, error_rad=np.array([0.4 * ARCSEC]))
    model = MatchModel(outlier_share=0.0, completeness=0.8)
    found = crossmatch(star, counterparts, RADIUS, model)
    assert len(found.star) == 5
    # B = 2 / s^2 exp(-psi^2 / (2 s^2)); the ratio is Q B / N, here with N stars on the sky.
    s = 0.5 * ARCSEC
    bayes = 2.0 / s**2 * math.exp(-((0.7 * ARCSEC) ** 2) / (2.0 * s**2))
    expected = math.log(0.8 * bayes / len(others))
    assert found.odds.log_ratio == pytest.approx([expected] * 5, abs=1e-9)
    weight = math.exp(expected) / (0.2 * (1.0 - 0.8 / len(others)))
    assert found.odds.probability == pytest.approx([weight / (5.0 * weight + 1.0)] * 5, rel=1e-9)
    assert math.isnan(found.odds.position_error_rad)


def test_the_ratio_with_magnitudes_by_hand():
    others = lattice(2)
    mag = np.where(np.arange(len(others)) % 2 == 0, 5.0, 9.0)
    counterparts = moving(*radec_from_directions(others), mag=mag, moves=False)
    ra, dec = radec_from_directions(others[2 * 900][None])
    star = moving(ra, dec + 1.0 / 3600.0, mag=5.5)
    model = replace(SURE, outlier_share=0.02, expected_delta_mag=0.2, colour_spread_mag=0.8)
    found = crossmatch(star, counterparts, RADIUS, model)
    assert found.delta_mag == pytest.approx([-0.5, 3.5])
    s, r = 0.5 * ARCSEC, 1.0 * ARCSEC
    normal = math.exp(-((r / s) ** 2) / 2.0) / (2.0 * math.pi * s**2)
    tail = 1.0 / (2.0 * math.pi * r**2 * (0.5 + math.log(RADIUS / s)))
    place = 0.98 * normal + 0.02 * tail
    for row, delta in enumerate((-0.5, 3.5)):
        colour = math.exp(-(((delta - 0.2) / 0.8) ** 2) / 2.0) / (0.8 * math.sqrt(2.0 * math.pi))
        # Half of the stars at either magnitude, smoothed by 0.5 mag.
        share = 0.5 / (0.5 * math.sqrt(2.0 * math.pi))
        density = len(others) / (4.0 * math.pi) * share
        expected = math.log(0.9 * place * colour / density)
        assert found.odds.log_ratio[row] == pytest.approx(expected, abs=0.02)


def test_the_density_of_a_place_integrates_to_one():
    # Over the circle, by rings: normal errors and outliers together are all true counterparts.
    offsets = np.linspace(0.0, 10.0, 401)[1:-1]
    star = beside(0.0, mag=np.nan)
    found = crossmatch(star, beside(*offsets, mag=np.nan), RADIUS, replace(SURE, completeness=0.5))
    r = found.separation_rad
    density = np.exp(found.odds.log_ratio)
    order = np.argsort(r)
    integral = np.trapezoid((density * 2.0 * np.pi * r)[order], r[order])
    # The density on the sky is the same for all: it is divided out by a candidate's own.
    tiles = 9.0 * 4.0 * math.pi / TILES
    assert integral * len(offsets) / tiles / 0.5 == pytest.approx(1.0, abs=0.01)


def test_magnitudes_are_distributed_as_they_are():
    from scipy.stats import gaussian_kde

    mag = 9.0 - np.random.default_rng(5).exponential(1.0, 20_000)
    wanted = np.linspace(2.0, 9.0, 50)
    found = MagnitudeCounts.of(np.append(mag, np.nan)).density(wanted)
    smooth = gaussian_kde(mag, bw_method=0.5 / mag.std(ddof=1))
    assert found == pytest.approx(smooth(wanted), rel=0.05, abs=2e-4)
    everywhere = np.linspace(-8.0, 12.0, 20_001)
    total = np.trapezoid(MagnitudeCounts.of(mag).density(everywhere), everywhere)
    assert total == pytest.approx(1.0, abs=0.01)


def test_unknown_magnitudes_leave_the_place():
    found = crossmatch(beside(0.0, mag=np.nan), beside(0.2, mag=5.0), RADIUS, SURE)
    assert rows(found) == [(0, 0, 1, "unique")]
    assert found.count("unique") == 1
    assert np.isnan(found.delta_mag).all()


def test_what_is_not_given_is_measured(random_directions):
    generator = np.random.default_rng(8)
    u = random_directions(20_000, 8)
    ra, dec = radec_from_directions(u)
    mag = generator.uniform(4.0, 9.0, len(u))
    stars = moving(ra, dec, mag=mag)
    kept = np.arange(len(u)) < 14_000
    error = generator.normal(scale=0.4 / 3600.0, size=(2, len(u)))
    moved_ra = ra + error[0] / np.maximum(np.cos(np.radians(dec)), 1e-6)
    fainter = mag + generator.normal(1.3, 0.3, len(u))
    moved = moving(moved_ra[kept], (dec + error[1])[kept], mag=fainter[kept])
    found = crossmatch(stars, moved, RADIUS, MatchModel())
    assert found.odds.position_error_rad / ARCSEC == pytest.approx(0.4, rel=0.03)
    assert found.odds.delta_mag == pytest.approx(1.3, abs=0.02)
    assert found.odds.completeness == pytest.approx(0.7, abs=0.01)
    best = found.rank == 1
    assert (found.star[best] == found.counterpart[best]).mean() > 0.999


def all_matchings(
    star: list[int], candidate: list[int], ratio: list[float], none: float
) -> list[float]:
    """The probability of each pair, by writing down every matching there is."""
    total, having = 0.0, [0.0] * len(star)
    for chosen in range(1 << len(star)):
        pairs = [k for k in range(len(star)) if chosen >> k & 1]
        if len({star[k] for k in pairs}) < len(pairs):
            continue
        if len({candidate[k] for k in pairs}) < len(pairs):
            continue
        weight = math.prod(ratio[k] / none for k in pairs)
        total += weight
        for k in pairs:
            having[k] += weight
    return [part / total for part in having]


@pytest.mark.parametrize(
    ("star", "candidate", "tolerance"),
    [
        ([0], [0], 1e-12),
        ([0, 0], [0, 1], 1e-12),
        ([0, 1], [0, 0], 1e-12),
        ([0, 0, 1], [0, 1, 1], 1e-9),
        ([0, 1, 1, 2, 2], [0, 0, 1, 1, 2], 1e-6),
        ([0, 0, 0, 1, 2, 3], [0, 1, 2, 0, 0, 0], 1e-6),
        ([0, 0, 1, 1], [0, 1, 0, 1], 1e-12),  # a ring
        ([0, 0, 1, 1, 2, 2, 2, 3], [0, 1, 1, 2, 2, 0, 3, 3], 1e-12),
    ],
)
@pytest.mark.parametrize("scale", [1.0, 1e3, 1e12])
def test_probabilities_are_those_of_all_matchings(star, candidate, tolerance, scale):
    generator = np.random.default_rng(len(star))
    for _ in range(20):
        ratio = np.exp(generator.normal(scale=1.5, size=len(star))) * scale
        found, _ = pair_probabilities(
            np.array(star), np.array(candidate), np.log(ratio), completeness=0.8, shared=0.5
        )
        expected = all_matchings(star, candidate, ratio.tolist(), 0.2 * 0.5)
        assert found == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize("unrelated", [0, 40_000])
def test_probabilities_are_calibrated(unrelated):
    """Of the pairs called 70 % probable seven in ten are right, in a most confused field."""
    generator = np.random.default_rng(21)

    def sky(count: int) -> tuple[Array, Array]:
        z = generator.uniform(-0.8, 0.8, count)
        return generator.uniform(0.0, 360.0, count), np.degrees(np.arcsin(z))

    count, sigma = 40_000, 250.0
    (ra, dec), mag = sky(count), generator.uniform(4.0, 9.0, count)
    has = generator.uniform(size=count) < 0.8
    error = generator.normal(scale=sigma / 3600.0, size=(2, count))
    other_ra, other_dec = sky(unrelated)
    other_mag = generator.normal(size=count), generator.uniform(4.0, 9.0, unrelated)
    others = moving(
        np.append((ra + error[0] / np.cos(np.radians(dec)))[has], other_ra),
        np.append((dec + error[1])[has], other_dec),
        mag=np.append((mag + other_mag[0])[has], other_mag[1]),
    )
    model = MatchModel(sigma * ARCSEC, 0.0, 0.0, 0.0, 1.0, 0.8)
    found = crossmatch(moving(ra, dec, mag=mag), others, 1250.0 * ARCSEC, model)
    truth = np.append(np.flatnonzero(has), np.full(unrelated, -1))
    right = found.star == truth[found.counterpart]
    p = found.odds.probability
    assert (found.n_candidates > 1).mean() > 0.3
    for lowest in np.arange(0.0, 1.0, 0.1):
        called = (p >= lowest) & (p < lowest + 0.1)
        assert called.sum() > 150
        assert right[called].mean() == pytest.approx(p[called].mean(), abs=0.06)


# Epochs -------------------------------------------------------------------------------------


def test_a_fast_star_is_found_where_it_was():
    # Barnard's star, Hipparcos: 10.4 arcsec a year; the counterpart has no proper motion.
    star = moving(269.45402305, 4.66828815, -0.79871, 10.32777, epoch=1991.25)
    pm_ra = -0.79871 / math.cos(math.radians(4.66828815))
    place = 269.45402305 + 9.0 * pm_ra / 3600.0, 4.66828815 + 9.0 * 10.32777 / 3600.0
    later = moving(*place, epoch=[2000.25], moves=False)
    found = crossmatch(star, later, 1.0 * ARCSEC, SURE)
    assert rows(found) == [(0, 0, 1, "unique")]
    assert found.epoch_jyear.tolist() == [2000.25]
    assert found.separation_rad[0] < 0.1 * ARCSEC
    back = crossmatch(later, star, 1.0 * ARCSEC, SURE)
    assert back.epoch_jyear.tolist() == [2000.25]
    assert back.separation_rad[0] == pytest.approx(found.separation_rad[0], abs=1e-12)


def test_where_neither_moves_the_error_is_wider():
    model = replace(SURE, unknown_motion_rad_yr=0.05 * ARCSEC)
    one = beside(0.0, moves=False, epoch=1991.5)
    found = crossmatch(one, beside(0.1, moves=False, epoch=1999.5), RADIUS, model)
    assert found.epoch_jyear.tolist() == [1999.5]
    expected = math.hypot(0.5, 8.0 * 0.05)
    assert found.odds.error_rad[0] / ARCSEC == pytest.approx(expected)
    alone = crossmatch(beside(0.0), beside(0.1, moves=False, epoch=1999.5), RADIUS, model)
    assert alone.odds.error_rad[0] / ARCSEC == pytest.approx(0.5)


def test_separations_are_those_of_erfa_and_astropy():
    generator = np.random.default_rng(4)
    count = 200
    ra, dec = generator.uniform(0.0, 360.0, count), generator.uniform(-85.0, 85.0, count)
    pm_ra, pm_dec = generator.uniform(-3.0, 3.0, (2, count))
    epoch = generator.uniform(1997.0, 2001.0, count)
    stars = moving(ra, dec, pm_ra, pm_dec, epoch=1991.25)
    days = np.array([erfa.epj2jd(float(year))[1] for year in epoch])
    end = erfa.pmsafe(
        np.radians(ra), np.radians(dec), pm_ra * ARCSEC / np.cos(np.radians(dec)), pm_dec * ARCSEC,
        1000.0, 0.0,  # no light time
        2400000.5, erfa.epj2jd(1991.25)[1], 2400000.5, days,
    )  # fmt: skip
    off = generator.uniform(0.0, 8.0, count) / 3600.0
    placed = np.degrees(end[1]) + off
    others = moving(np.degrees(end[0]), placed, epoch=epoch, moves=False)
    pairs = candidate_pairs(stars, others, RADIUS)
    assert pairs.star.tolist() == pairs.counterpart.tolist() == list(range(count))
    there = SkyCoord(end[0] * units.rad, end[1] * units.rad)
    expected = there.separation(SkyCoord(np.degrees(end[0]) * units.deg, placed * units.deg)).rad
    assert pairs.separation_rad == pytest.approx(expected, abs=EPOCH_TOLERANCE_RAD)
    assert pairs.epoch_jyear.tolist() == epoch.tolist()


@st.composite
def crowds(draw: st.DrawFn) -> tuple[MovingStars, MovingStars, float]:
    """Two crowds in one field, with motions up to 12 arcsec a year or none, at any epochs."""
    seed = draw(st.integers(0, 2**32 - 1))
    generator = np.random.default_rng(seed)
    pole = draw(st.booleans())
    share = draw(st.sampled_from([0.0, 0.5, 1.0]))

    def crowd(count: int) -> MovingStars:
        ra = generator.uniform(0.0, 360.0 if pole else 0.05, count)
        north = generator.uniform(0.0, 0.05, count)
        dec = 90.0 - north if pole else north
        speed = np.where(generator.uniform(size=count) < 0.2, 12.0, 0.1)
        pm_ra, pm_dec = generator.uniform(-1.0, 1.0, (2, count)) * speed
        epoch = generator.choice([1991.25, 1998.3, 2000.0, 2016.0], count)
        moves = generator.uniform(size=count) < share
        return moving(ra, dec, pm_ra, pm_dec, epoch, generator.uniform(4, 9, count), moves)

    radius = draw(st.sampled_from([1.0, 10.0, 60.0])) * ARCSEC
    return crowd(draw(st.integers(1, 40))), crowd(draw(st.integers(1, 40))), radius


@given(crowds())
def test_no_candidate_is_missed(case):
    stars, others, radius = case
    i, j = (rows.ravel() for rows in np.indices((len(stars.mag), len(others.mag))))
    is_theirs = others.has_motion[j] & ~stars.has_motion[i]
    epoch = np.where(is_theirs, stars.epoch_jyear[i], others.epoch_jyear[j])
    near = separation(stars.at(i, epoch), others.at(j, epoch)) <= radius
    pairs = candidate_pairs(stars, others, radius)
    assert pairs.star.tolist() == i[near].tolist()
    assert pairs.counterpart.tolist() == j[near].tolist()


@settings(max_examples=30)
@given(crowds())
def test_every_result_is_consistent(case):
    stars, others, radius = case
    found = crossmatch(stars, others, radius, MatchModel())
    keys = list(zip(found.star, found.rank, strict=True))
    assert keys == sorted(set(keys))
    assert len(set(zip(found.star, found.counterpart, strict=True))) == len(found.star)
    assert (found.separation_rad <= radius).all()
    p = found.odds.probability
    assert ((p >= 0.0) & (p <= 1.0)).all()
    for row in np.unique(found.star):
        own = found.star == row
        assert found.rank[own].tolist() == list(range(1, own.sum() + 1))
        assert (found.n_candidates[own] == own.sum()).all()
        assert (np.diff(found.odds.log_ratio[own]) <= 0.0).all()
        assert p[own].sum() <= 1.0 + 1e-9
    for row in np.unique(found.counterpart):
        own = found.counterpart == row
        assert sorted(found.star_rank[own]) == list(range(1, own.sum() + 1))
        assert (found.n_stars[own] == own.sum()).all()
        assert p[own].sum() <= 1.0 + 1e-9


@settings(max_examples=20)
@given(crowds(), st.integers(0, 2**32 - 1))
def test_the_order_of_the_rows_does_not_matter(case, seed):
    stars, others, radius = case
    generator = np.random.default_rng(seed)
    model = replace(SURE, expected_delta_mag=0.3)

    def shuffled(stars: MovingStars) -> tuple[MovingStars, NDArray[np.int64]]:
        order = generator.permutation(len(stars.mag))
        fields = {k: v[order] for k, v in vars(stars).items() if v is not None}
        return MovingStars(**fields), order

    (a, order_a), (b, order_b) = shuffled(stars), shuffled(others)
    one, two = crossmatch(stars, others, radius, model), crossmatch(a, b, radius, model)
    before = {(i, j): (r, v) for i, j, r, v in rows(one)}
    after = {(order_a[i], order_b[j]): (r, v) for i, j, r, v in rows(two)}
    assert before == after


@pytest.mark.parametrize("empty", ["stars", "counterparts", "both", "far"])
def test_nothing_to_match_is_no_match(empty):
    none, some = moving(np.empty(0), np.empty(0)), beside(0.0)
    one = none if empty in ("stars", "both") else some
    other = none if empty in ("counterparts", "both") else beside(900.0)
    found = crossmatch(one, other, RADIUS, MatchModel())
    assert len(found.star) == len(found.odds.probability) == 0
    assert sum(found.count(word) for word in VERDICTS) == 0


def test_the_radius_itself_is_within():
    pairs = candidate_pairs(beside(0.0), beside(4.0), 1.0)
    exact = float(pairs.separation_rad[0])
    assert len(candidate_pairs(beside(0.0), beside(4.0), exact).star) == 1
    assert len(candidate_pairs(beside(0.0), beside(4.0), np.nextafter(exact, 0.0)).star) == 0


@pytest.mark.parametrize("radius", [0.0, -1.0, math.nan])
def test_a_radius_that_is_invalid_is_refused(radius):
    with pytest.raises(ValueError, match="radius_rad"):
        crossmatch(beside(0.0), beside(0.0), radius, SURE)


def test_searches_in_pieces_find_the_same(random_directions, monkeypatch):
    u = random_directions(5000, 9)
    stars, others = moving(*radec_from_directions(u)), moving(*radec_from_directions(u[::-1]))
    whole = candidate_pairs(stars, others, 0.01)
    monkeypatch.setattr("starcat.products.match_stars.CHUNK", 700)
    pieces = candidate_pairs(stars, others, 0.01)
    assert whole.star.tolist() == pieces.star.tolist()
    assert whole.counterpart.tolist() == pieces.counterpart.tolist()
