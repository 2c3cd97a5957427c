"""Cross-identification: candidates, epochs, odds and verdicts, by hand and by other means."""

from __future__ import annotations

import math

import erfa
import numpy as np
import pyarrow as pa
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from starcat.arrays import Mask
from starcat.catalog.stars.positions import Positions
from starcat.catalog.stars.proper_motion import Motion, propagate_directions
from starcat.catalog.stars.star_table import floats_of, table_from_columns, with_columns
from starcat.database.products.crossmatch import (
    ARCSEC,
    TILES,
    Crossmatch,
    Matches,
    candidate_pairs,
    crossmatch,
)
from starcat.geometry.sphere import radec_from_directions, saff_kuijlaars, separation

Array = NDArray[np.float64]

RADIUS = 10.0 * ARCSEC


def sure(**changes: object) -> Crossmatch:
    """A model of errors that is given, so that few stars do."""
    known = {"position_error_arcsec": 0.5, "expected_delta_mag": 0.0, "completeness": 0.9}
    return Crossmatch(**{**known, **changes})


SURE = sure()

# Both move the star along the same straight line; ERFA by way of space motion.
EPOCH_TOLERANCE_RAD = 1e-6 * ARCSEC


def moving(
    ra_deg: object, dec_deg: object, pm_ra_arcsec: object = 0.0, pm_dec_arcsec: object = 0.0,
    epoch: object = 2000.0, mag: object = 7.0, moves: object = True,
) -> pa.Table:  # fmt: skip
    ra, dec = np.atleast_1d(np.asarray(ra_deg, float)), np.atleast_1d(np.asarray(dec_deg, float))
    known = np.broadcast_to(moves, len(ra)).astype(bool)
    columns = {
        "star_id": np.arange(len(ra)), "ra_deg": ra, "dec_deg": dec,
        "epoch_jyear": epoch, "mag": mag,
        "pm_ra_cosdec_mas_yr": np.where(known, 1000.0 * np.asarray(pm_ra_arcsec), np.nan),
        "pm_dec_mas_yr": np.where(known, 1000.0 * np.asarray(pm_dec_arcsec), np.nan),
        "catalog": "sky", "designation": "star", "band": "V", "quality_flags": 0,
        "x": 0.0, "y": 0.0, "z": 0.0,
    }  # fmt: skip
    every = {name: np.broadcast_to(np.asarray(each), len(ra)) for name, each in columns.items()}
    return table_from_columns("stars", every, len(ra))


def numbers_of(found: Matches, name: str) -> Array:
    return floats_of(found.table, name)


def beside(*offsets_arcsec: float, mag: object = 7.0, **more: object) -> pa.Table:
    """Stars on the equator, this many arcsec east of right ascension 10 deg."""
    ra = 10.0 + np.array(offsets_arcsec) / 3600.0
    return moving(ra, np.zeros(len(ra)), mag=mag, **more)


def rows(found: Matches) -> list[tuple[int, int, int, str]]:
    columns = (found.table[name].to_pylist() for name in ("star", "rank", "verdict"))
    star, rank, verdict = columns
    return list(zip(star, found.counterpart.tolist(), rank, verdict, strict=True))


# Verdicts -----------------------------------------------------------------------------------


SURELY, HARDLY = pytest.approx(1.0, abs=1e-3), pytest.approx(0.0, abs=1e-2)
HALF, THIRD = pytest.approx(0.5, abs=0.02), pytest.approx(1.0 / 3.0, abs=0.01)


@pytest.mark.parametrize(
    ("stars", "others", "expected", "probability"),
    [
        ([0.0, 500.0], [0.3, 900.0], [(0, 0, 1, "unique")], [SURELY]),
        # The nearer of two alike is best.
        ([0.0], [6.0, 0.2], [(0, 1, 1, "unique"), (0, 0, 2, "none")], [SURELY, HARDLY]),
        ([0.0], [-0.41, 0.4], [(0, 1, 1, "ambiguous"), (0, 0, 2, "ambiguous")], [HALF, HALF]),
        # Neither star can be certain of a counterpart that only one can have.
        ([-0.41, 0.4], [0.0], [(0, 0, 1, "ambiguous"), (1, 0, 1, "ambiguous")], [HALF, HALF]),
        # A candidate that fits another star is taken.
        ([0.0, 6.0], [0.1], [(0, 0, 1, "unique"), (1, 0, 1, "none")], [SURELY, HARDLY]),
        # Equal odds and separations go by row.
        ([0.0], [0.5] * 3, [(0, k, k + 1, "ambiguous") for k in range(3)], [THIRD] * 3),
    ],
)
def test_verdicts_on_few_stars(stars, others, expected, probability):
    found = crossmatch(beside(*stars), beside(*others), SURE)
    assert rows(found) == expected
    assert numbers_of(found, "probability").tolist() == probability


def test_the_magnitude_decides_between_two_as_near():
    found = crossmatch(beside(0.0, mag=7.0), beside(-0.4, 0.4, mag=[11.0, 7.1]), SURE)
    assert rows(found) == [(0, 1, 1, "unique"), (0, 0, 2, "none")]
    assert numbers_of(found, "delta_mag") == pytest.approx([0.1, 4.0])


def test_a_resolved_double_is_two_sure_pairs():
    found = crossmatch(beside(0.0, 5.0), beside(0.1, 5.1), SURE)
    assert [row for row in rows(found) if row[2] == 1] == [(0, 0, 1, "unique"), (1, 1, 1, "unique")]
    assert (numbers_of(found, "probability")[numbers_of(found, "rank") == 1] > 0.99).all()


def test_a_faint_star_far_off_in_a_crowd_is_none(random_directions):
    crowd = random_directions(400_000, 3)
    ra, dec = radec_from_directions(crowd)
    others = moving(np.append(10.0 + 8.0 / 3600.0, ra), np.append(0.0, dec), mag=12.0, moves=False)
    found = crossmatch(beside(0.0, mag=7.0), others, SURE)
    assert rows(found)[0] == (0, 0, 1, "none")
    assert numbers_of(found, "probability")[0] < 0.5
    sure_of_all = crossmatch(beside(0.0, mag=7.0), others, sure(min_probability=0.0))
    assert rows(sure_of_all)[0] == (0, 0, 1, "unique")


@pytest.mark.parametrize("limit", [1.0, 10.0, 1e6])
def test_ambiguity_is_what_the_model_says(limit):
    model = sure(ambiguous_odds=limit, outlier_share=0.0)
    found = crossmatch(beside(0.0), beside(0.5, 1.5), model)
    # exp((1.5^2 - 0.5^2) / (2 * 0.5^2)) = exp(4) = 54.6
    assert rows(found)[0][3] == ("ambiguous" if limit > 54.6 else "unique")
    ratio = 10.0 ** -np.diff(numbers_of(found, "log10_likelihood_ratio"))
    assert ratio == pytest.approx([math.exp(4.0)], rel=1e-6)


# Published numbers --------------------------------------------------------------------------


def numbered(stars: pa.Table, *numbers: int | None, name: str = "hip_number") -> pa.Table:
    return with_columns(stars, {name: pa.array(numbers, pa.int32())})


@pytest.mark.parametrize("name", ["hip_number", "hd_number"])
def test_a_published_number_decides_between_two_alike(name):
    others = numbered(lattice_and(beside(-0.41, 0.4)), *[None] * TILES, 8, 7, name=name)
    found = crossmatch(numbered(beside(0.0), 8, name=name), others, SURE)
    assert [(row[1] - TILES, row[3]) for row in rows(found)] == [(0, "unique"), (1, "none")]
    # Any of the counterparts could have the number.
    ratio = numbers_of(found, "log10_likelihood_ratio") * math.log(10.0)
    plain = crossmatch(beside(0.0), others, SURE)
    before = numbers_of(plain, "log10_likelihood_ratio") * math.log(10.0)
    assert ratio[0] - before.min() == pytest.approx(math.log(TILES + 2), rel=1e-9)


@pytest.mark.parametrize("numbers", [(8, 8), (None, None), (9, 7)])
def test_numbers_of_both_components_or_of_others_decide_nothing(numbers):
    others = lattice_and(beside(-0.41, 0.4))
    found = crossmatch(numbered(beside(0.0), 8), numbered(others, *[None] * TILES, *numbers), SURE)
    assert [row[3] for row in rows(found)] == ["ambiguous", "ambiguous"]


# Odds ---------------------------------------------------------------------------------------


def lattice(per_tile: int) -> Array:
    """The same number of stars in every tile that the density is counted in."""
    return np.repeat(saff_kuijlaars(TILES), per_tile, axis=0)


def lattice_and(stars: pa.Table) -> pa.Table:
    """One star in every tile, and some others."""
    return pa.concat_tables([moving(*radec_from_directions(lattice(1)), moves=False), stars])


def test_without_magnitudes_the_ratio_is_the_bayes_factor():
    others = lattice(5)
    counterparts = moving(*radec_from_directions(others), mag=np.nan, moves=False)
    ra, dec = radec_from_directions(others[5 * 700][None])
    star = moving(ra, dec + 0.7 / 3600.0, mag=7.0)
    found = crossmatch(star, counterparts, sure(outlier_share=0.0, completeness=0.8))
    assert len(found.counterpart) == 5
    # B = 2 / s^2 exp(-psi^2 / (2 s^2)); the ratio is Q B / N, here with N stars on the sky.
    s = 0.5 * ARCSEC
    bayes = 2.0 / s**2 * math.exp(-((0.7 * ARCSEC) ** 2) / (2.0 * s**2))
    expected = 0.8 * bayes / len(others)
    ratio = 10.0 ** numbers_of(found, "log10_likelihood_ratio")
    assert ratio == pytest.approx([expected] * 5, rel=1e-6)
    weight = expected / (0.2 * (1.0 - 0.8 / len(others)))
    assert numbers_of(found, "probability") == pytest.approx(
        [weight / (5.0 * weight + 1.0)] * 5, rel=1e-6
    )


def test_the_ratio_with_magnitudes_by_hand():
    others = lattice(2)
    mag = np.where(np.arange(len(others)) % 2 == 0, 5.25, 9.25)  # the middles of two bins
    counterparts = moving(*radec_from_directions(others), mag=mag, moves=False)
    ra, dec = radec_from_directions(others[2 * 900][None])
    star = moving(ra, dec + 1.0 / 3600.0, mag=5.75)
    found = crossmatch(star, counterparts, sure(expected_delta_mag=0.2, colour_spread_mag=0.8))
    assert numbers_of(found, "delta_mag") == pytest.approx([-0.5, 3.5])
    s, r = 0.5 * ARCSEC, 1.0 * ARCSEC
    normal = math.exp(-((r / s) ** 2) / 2.0) / (2.0 * math.pi * s**2)
    tail = 1.0 / (2.0 * math.pi * r**2 * (0.5 + math.log(RADIUS / s)))
    place = 0.98 * normal + 0.02 * tail
    for row, delta in enumerate((-0.5, 3.5)):
        colour = math.exp(-(((delta - 0.2) / 0.8) ** 2) / 2.0) / (0.8 * math.sqrt(2.0 * math.pi))
        # Half of the stars are in either bin, which is half a magnitude wide.
        density = len(others) / (4.0 * math.pi) * 0.5 / 0.5
        expected = math.log10(0.9 * place * colour / density)
        found_ratio = numbers_of(found, "log10_likelihood_ratio")[row]
        assert found_ratio == pytest.approx(expected, abs=1e-9)


def test_the_density_of_a_place_integrates_to_one():
    # Over the circle, by rings: normal errors and outliers together are all true counterparts.
    offsets = np.linspace(0.0, 10.0, 401)[1:-1]
    star = beside(0.0, mag=np.nan)
    found = crossmatch(star, beside(*offsets, mag=np.nan), sure(completeness=0.5))
    r = numbers_of(found, "separation_arcsec") * ARCSEC
    density = 10.0 ** numbers_of(found, "log10_likelihood_ratio")
    order = np.argsort(r)
    integral = np.trapezoid((density * 2.0 * np.pi * r)[order], r[order])
    # The density on the sky is the same for all: it is divided out by a candidate's own.
    tiles = 9.0 * 4.0 * math.pi / TILES
    assert integral * len(offsets) / tiles / 0.5 == pytest.approx(1.0, abs=0.01)


def test_unknown_magnitudes_leave_the_place():
    found = crossmatch(beside(0.0, mag=np.nan), beside(0.2, mag=5.0), SURE)
    assert rows(found) == [(0, 0, 1, "unique")]
    assert np.isnan(numbers_of(found, "delta_mag")).all()


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
    found = crossmatch(stars, moved, Crossmatch())
    assert found.position_error_arcsec == pytest.approx(0.4, rel=0.03)
    assert found.expected_delta_mag == pytest.approx(1.3, abs=0.02)
    assert found.completeness == pytest.approx(0.7, abs=0.01)
    best = numbers_of(found, "rank") == 1
    assert (numbers_of(found, "star")[best] == found.counterpart[best]).mean() > 0.999


def crowded(
    count: int, unrelated: int, sigma: float, completeness: float, is_measured: bool = False
) -> tuple[Matches, Mask]:
    """Match a most confused sky, and return which pairs are one star."""
    generator = np.random.default_rng(21)

    def sky(count: int) -> tuple[Array, Array]:
        z = generator.uniform(-0.8, 0.8, count)
        return generator.uniform(0.0, 360.0, count), np.degrees(np.arcsin(z))

    (ra, dec), mag = sky(count), generator.uniform(4.0, 9.0, count)
    has = generator.uniform(size=count) < completeness
    error = generator.normal(scale=sigma / 3600.0, size=(2, count))
    other_ra, other_dec = sky(unrelated)
    other_mag = generator.normal(size=count), generator.uniform(4.0, 9.0, unrelated)
    others = moving(
        np.append((ra + error[0] / np.cos(np.radians(dec)))[has], other_ra),
        np.append((dec + error[1])[has], other_dec),
        mag=np.append((mag + other_mag[0])[has], other_mag[1]),
    )
    # An error and a radius beyond those that a spec can have.
    stated: dict[str, object] = {"radius_arcsec": 5.0 * sigma}
    if not is_measured:
        stated |= {"position_error_arcsec": sigma, "completeness": completeness}
        stated |= {"expected_delta_mag": 0.0}
    model = Crossmatch(unknown_motion_mas_yr=0.0, outlier_share=0.0).model_copy(update=stated)
    found = crossmatch(moving(ra, dec, mag=mag), others, model)
    truth = np.append(np.flatnonzero(has), np.full(unrelated, -1))
    return found, numbers_of(found, "star") == truth[found.counterpart]


@pytest.mark.parametrize("unrelated", [0, 40_000])
def test_verdicts_are_safe_in_a_crowd(unrelated):
    found, right = crowded(40_000, unrelated, 250.0, 0.8)
    assert (numbers_of(found, "n_candidates") > 1).mean() > 0.3
    verdict = np.array(found.table["verdict"].to_pylist())
    # Measured: 99.8 and 96.6 %. Half of the ambiguous ones are right, as nobody can tell.
    assert right[verdict == "unique"].mean() > (0.96 if unrelated else 0.997)
    assert 0.45 < right[verdict == "ambiguous"].mean() < 0.55
    p = numbers_of(found, "probability")
    assert p[verdict == "none"].max() < 0.5


@pytest.mark.parametrize(
    "crowd",
    [
        (40_000, 0, 250.0, 0.8),  # 48 % of the pairs are not the only ones of their star
        (40_000, 40_000, 250.0, 0.8),  # 74 %
        (40_000, 40_000, 400.0, 0.8),  # 95 %
        (40_000, 200_000, 150.0, 0.8),
        (40_000, 40_000, 250.0, 0.3),
        (40_000, 0, 250.0, 0.99),
        (40_000, 40_000, 250.0, 0.8, True),
    ],
)
def test_pairs_are_right_as_often_as_their_probability_says(crowd):
    found, right = crowded(*crowd)
    p = numbers_of(found, "probability")
    for lowest in np.arange(0.0, 1.0, 0.1):
        called = (p >= lowest) & (p < lowest + 0.1)
        assert called.sum() > 150
        # Measured: 0.049 at most. The standard error is 0.035 in the smallest bins.
        assert abs(right[called].mean() - p[called].mean()) < 0.06
    assert abs(right.sum() - p.sum()) < 0.02 * right.sum()


def test_a_neighbour_with_a_better_counterpart_takes_nothing_away():
    # The second candidate is as near to the first star as the first one, but is the second star.
    pair = crossmatch(beside(0.0), beside(-1.0, 1.0), SURE)
    assert numbers_of(pair, "probability") == pytest.approx([0.5, 0.5], abs=1e-3)
    found = crossmatch(beside(0.0, 1.0), beside(-1.0, 1.0), SURE)
    ends = zip(numbers_of(found, "star").tolist(), found.counterpart.tolist(), strict=True)
    ratio = dict(zip(ends, 10.0 ** numbers_of(found, "log10_likelihood_ratio"), strict=True))
    assert ratio[0, 0] == pytest.approx(ratio[0, 1])
    # All other sets of pairs without a common star or counterpart are a million times less likely.
    crossed = ratio[0, 1] * ratio[1, 0] / (ratio[0, 0] * ratio[1, 1])
    assert crossed < 1e-3
    expected = {(0, 0): 1.0 - crossed, (1, 1): 1.0 - crossed, (0, 1): crossed, (1, 0): crossed}
    probability = dict(zip(ratio, numbers_of(found, "probability"), strict=True))
    assert probability == pytest.approx(expected, abs=1e-4)
    assert [row[3] for row in rows(found)] == ["unique", "none", "unique", "none"]


# Epochs -------------------------------------------------------------------------------------


def test_a_fast_star_is_found_where_it_was():
    # Barnard's star, Hipparcos: 10.4 arcsec a year; the counterpart has no proper motion.
    star = moving(269.45402305, 4.66828815, -0.79871, 10.32777, epoch=1991.25)
    pm_ra = -0.79871 / math.cos(math.radians(4.66828815))
    place = 269.45402305 + 9.0 * pm_ra / 3600.0, 4.66828815 + 9.0 * 10.32777 / 3600.0
    later = moving(*place, epoch=[2000.25], moves=False)
    found = crossmatch(star, later, sure(radius_arcsec=1.0))
    assert rows(found) == [(0, 0, 1, "unique")]
    assert found.table["compared_jyear"].to_pylist() == [2000.25]
    assert numbers_of(found, "separation_arcsec")[0] < 0.1
    back = crossmatch(later, star, sure(radius_arcsec=1.0))
    assert back.table["compared_jyear"].to_pylist() == [2000.25]
    assert numbers_of(back, "separation_arcsec") == pytest.approx(
        numbers_of(found, "separation_arcsec"), abs=1e-6
    )


def test_where_neither_moves_the_error_is_wider():
    model = sure(unknown_motion_mas_yr=50.0)
    one = beside(0.0, moves=False, epoch=1991.5)
    found = crossmatch(one, beside(0.1, moves=False, epoch=1999.5), model)
    assert found.table["compared_jyear"].to_pylist() == [1999.5]
    expected = math.hypot(0.5, 8.0 * 0.05)
    assert numbers_of(found, "position_error_arcsec")[0] == pytest.approx(expected)
    alone = crossmatch(beside(0.0), beside(0.1, moves=False, epoch=1999.5), model)
    assert numbers_of(alone, "position_error_arcsec")[0] == pytest.approx(0.5)


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
    star, counterpart, epochs, angle = candidate_pairs(
        Positions.of(stars), Positions.of(others), RADIUS
    )
    assert star.tolist() == counterpart.tolist() == list(range(count))
    there = SkyCoord(end[0] * units.rad, end[1] * units.rad)
    expected = there.separation(SkyCoord(np.degrees(end[0]) * units.deg, placed * units.deg)).rad
    assert angle == pytest.approx(expected, abs=EPOCH_TOLERANCE_RAD)
    assert epochs.tolist() == epoch.tolist()


@st.composite
def crowds(draw: st.DrawFn) -> tuple[pa.Table, pa.Table, float]:
    """Two crowds in one field, with motions up to 12 arcsec a year or none, at any epochs."""
    seed = draw(st.integers(0, 2**32 - 1))
    generator = np.random.default_rng(seed)
    pole = draw(st.booleans())
    share = draw(st.sampled_from([0.0, 0.5, 1.0]))

    def crowd(count: int) -> pa.Table:
        ra = generator.uniform(0.0, 360.0 if pole else 0.05, count)
        north = generator.uniform(0.0, 0.05, count)
        dec = 90.0 - north if pole else north
        speed = np.where(generator.uniform(size=count) < 0.2, 12.0, 0.1)
        pm_ra, pm_dec = generator.uniform(-1.0, 1.0, (2, count)) * speed
        epoch = generator.choice([1991.25, 1998.3, 2000.0, 2016.0], count)
        moves = generator.uniform(size=count) < share
        return moving(ra, dec, pm_ra, pm_dec, epoch, generator.uniform(4, 9, count), moves)

    radius_arcsec = draw(st.sampled_from([1.0, 10.0, 60.0]))
    return crowd(draw(st.integers(1, 40))), crowd(draw(st.integers(1, 40))), radius_arcsec


def at(stars: pa.Table, rows: NDArray[np.int64], epoch_jyear: Array) -> Array:
    names = ("ra_deg", "dec_deg", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")
    motion = Motion(*(floats_of(stars, name)[rows] for name in names))
    return propagate_directions(motion, epoch_jyear - floats_of(stars, "epoch_jyear")[rows])[1]


@given(crowds())
def test_no_candidate_is_missed(case):
    stars, others, radius_arcsec = case
    i, j = (rows.ravel() for rows in np.indices((len(stars), len(others))))
    moves, other_moves = (~np.isnan(floats_of(table, "pm_dec_mas_yr")) for table in (stars, others))
    is_theirs = other_moves[j] & ~moves[i]
    epochs = floats_of(stars, "epoch_jyear")[i], floats_of(others, "epoch_jyear")[j]
    epoch = np.where(is_theirs, *epochs)
    near = separation(at(stars, i, epoch), at(others, j, epoch)) <= radius_arcsec * ARCSEC
    star, counterpart, _, _ = candidate_pairs(
        Positions.of(stars), Positions.of(others), radius_arcsec * ARCSEC
    )
    assert star.tolist() == i[near].tolist()
    assert counterpart.tolist() == j[near].tolist()


@settings(max_examples=30)
@given(crowds())
def test_every_result_is_consistent(case):
    stars, others, radius_arcsec = case
    found = crossmatch(stars, others, Crossmatch(radius_arcsec=radius_arcsec))
    star, rank, star_rank, count, star_count, angle, p = (
        numbers_of(found, name) for name in (
            "star", "rank", "star_rank", "n_candidates", "n_stars", "separation_arcsec",
            "probability",
        )
    )  # fmt: skip
    verdict = np.array(found.table["verdict"].to_pylist())
    keys = list(zip(star, rank, strict=True))
    assert keys == sorted(set(keys))
    assert len(set(zip(star, found.counterpart, strict=True))) == len(star)
    assert (angle <= radius_arcsec).all()
    assert ((p >= 0.0) & (p <= 1.0)).all()
    for row in np.unique(star):
        own = star == row
        assert rank[own].tolist() == list(range(1, own.sum() + 1))
        assert (count[own] == own.sum()).all()
        assert (np.diff(p[own]) <= 0.0).all()
        assert p[own].sum() <= 1.0 + 1e-9
        assert (verdict[own] == "unique").sum() <= 1
    for row in np.unique(found.counterpart):
        own = found.counterpart == row
        assert sorted(star_rank[own]) == list(range(1, own.sum() + 1))
        assert (star_count[own] == own.sum()).all()
        assert p[own].sum() <= 1.0 + 1e-9
        assert (verdict[own] == "unique").sum() <= 1
    is_unique = verdict == "unique"
    assert (rank[is_unique] == 1).all()
    assert (star_rank[is_unique] == 1).all()


@settings(max_examples=20)
@given(crowds(), st.integers(0, 2**32 - 1))
def test_the_order_of_the_rows_does_not_matter(case, seed):
    stars, others, radius_arcsec = case
    generator = np.random.default_rng(seed)
    model = sure(expected_delta_mag=0.3, radius_arcsec=radius_arcsec)
    order_a, order_b = (generator.permutation(len(table)) for table in (stars, others))
    one = crossmatch(stars, others, model)
    two = crossmatch(stars.take(order_a), others.take(order_b), model)
    before = {(i, j): (r, v) for i, j, r, v in rows(one)}
    after = {(order_a[i], order_b[j]): (r, v) for i, j, r, v in rows(two)}
    assert before == after


@pytest.mark.parametrize("empty", ["stars", "counterparts", "both", "far"])
def test_nothing_to_match_is_no_match(empty):
    none, some = moving(np.empty(0), np.empty(0)), beside(0.0)
    one = none if empty in ("stars", "both") else some
    other = none if empty in ("counterparts", "both") else beside(900.0)
    found = crossmatch(one, other, Crossmatch())
    assert len(found.table) == len(found.counterpart) == 0


def test_the_radius_itself_is_within():
    places = Positions.of(beside(0.0)), Positions.of(beside(4.0))
    exact = float(candidate_pairs(*places, 1.0)[3][0])
    assert len(candidate_pairs(*places, exact)[0]) == 1
    assert len(candidate_pairs(*places, np.nextafter(exact, 0.0))[0]) == 0
