"""Votes for the turn of a frame about a centroid, for frames that triangles do not solve.

If centroids are far from their places, an observed triangle is like thousands of triangles of
stars. If most centroids are false, hardly any triangle has three stars. Votes still work then. One
centroid is the reference, and each star in turn is tried as its star. Every neighbour of that star
votes with every centroid that is as far from the reference and as bright: for the difference of
their position angles, which is the turn of the frame. The neighbours of the right star agree on
one turn; the neighbours of a wrong star do not agree. Fu et al. 2025 compare such patterns.

``onboard/src/votes.c`` follows the same rules in the same units, so that both propose the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Rows
from starcat.geometry.sphere import separation
from starcat.matcher.chance import least_matches
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.observation import MAG_DEVIATIONS, Candidates, Observation
from starcat.matcher.settings import LOOKUP, TriangleOrder
from starcat.matcher.star_cells import cells_for, rows_between

MIN_REFERENCES, MAX_REFERENCES = 12, 32
"""Numbers of centroids that are tried as the reference, in the order of the observation. If more
than the largest number are needed, the smallest number is tried, and the triangles go on."""

MISS_PROBABILITY = 1e-4
"""Largest probability that a frame which can be identified has false references only."""

MAX_VOTERS = 32
"""Number of centroids around a reference, the nearest ones."""

MAX_KEPT = 6
"""Number of stars of one reference that are proposed."""

TURN = 256
"""Units of position angles in a turn."""

BINS = 64
"""Bins of the turn; a star is judged by two that are side by side."""

PER_BIN = TURN // BINS
"""Units of position angles in a bin."""

MIN_VOTES = 3
"""Smallest number of votes of a star that is proposed."""

MIN_EXPECTED = 0.3
"""Smallest number of votes by chance that is assumed for two bins."""

APART = 32767.0
"""Units of the largest separation of neighbours."""

PER_MAGNITUDE, BRIGHTEST, UNKNOWN = 16.0, -2.0, 255
"""Units per magnitude, the magnitude of unit 0, and the unit of an unknown magnitude."""

MIN_LISTED_STARS = 32
"""Fewest stars of a database with votes: the table in C has 32 rings of separation."""

MAX_NEIGHBOURS = 16_000_000
"""Largest number of neighbours of all stars together with which there are votes."""

STARS_OF_LOOKUP = 100
"""Number of stars whose votes take the time of looking one pattern up."""

AT_ONCE = 512
"""Number of stars whose neighbours are searched together."""


@dataclass(frozen=True)
class NeighbourTable:
    """The stars around every star of a database, in small units."""

    radius_rad: float
    # The neighbours of star s are at offsets[s] to offsets[s + 1]; shape (N + 1,).
    offsets: NDArray[np.int64]
    star: NDArray[np.int32]  # row of the database; shape (M,)
    apart: NDArray[np.uint16]  # separation, the radius over `APART`; shape (M,)
    turn: NDArray[np.uint8]  # position angle, a turn over 256; shape (M,)
    magnitude: NDArray[np.uint8]  # in units from `BRIGHTEST` on; `UNKNOWN` if not known


@dataclass(frozen=True)
class Voters:
    """The centroids around a reference, the nearest first, in the units of `NeighbourTable`."""

    centroids: Rows  # rows of the observation; shape (V,)
    nearest: NDArray[np.int64]  # separations from the reference that their stars may have
    farthest: NDArray[np.int64]
    brightest: NDArray[np.int64]  # magnitudes that their stars may have
    faintest: NDArray[np.int64]
    turn: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.centroids)


VOTING = ("triangle", "pyramid")
"""Methods whose frames are solved by votes if their own patterns do not solve them soon."""


def can_vote(observation: Observation, database: MatcherDatabase) -> bool:
    """Return whether votes can be counted: with the default search, if the scale is known."""
    settings = observation.settings
    is_own = settings.method in VOTING and settings.selection == TriangleOrder()
    return is_own and not observation.fov_error and has_few_neighbours(database)


def references_needed(observation: Observation, database: MatcherDatabase) -> int:
    """Return the number of references that include a star, except with `MISS_PROBABILITY`.

    The frame has as few stars as can typically be accepted, n of N centroids, and its first
    centroids are stars as often as any. Then r references are false with the probability
    ``C(N - n, r) / C(N, r)``. If more references than `MAX_REFERENCES` are needed, the votes decide
    little, and the triangles have to be looked up for longer.
    """
    camera, settings = observation.camera, observation.settings
    area = camera.width_px * camera.height_px / camera.focal_length_px**2
    stars = int(len(database.mag) * min(area / (4.0 * math.pi), 1.0) + 0.5)
    limit = max(settings.max_false_match_probability, 1e-300)
    count = len(observation)
    others = count - least_matches(count, stars, camera, observation.noise_px, limit)
    miss, needed = 1.0, 0
    while needed < count and miss > MISS_PROBABILITY:
        miss *= max(0, others - needed) / (count - needed)
        needed += 1
    return needed


def has_few_neighbours(database: MatcherDatabase) -> bool:
    """Return whether there are stars for a table of the neighbours, and it is small enough."""
    pairs = (len(database.mag) * math.sin(0.5 * database.camera.radius_rad)) ** 2
    return len(database.mag) >= MIN_LISTED_STARS and pairs <= MAX_NEIGHBOURS


def candidates(
    reference: int, observation: Observation, database: MatcherDatabase
) -> Iterator[Candidates]:
    """Propose the stars that have the most votes, each with the centroids that voted for it."""
    table = database.cached(neighbours, database.camera.radius_rad)
    voters = voters_of(reference, observation, table.radius_rad)
    compatible = observation.compatible(database.mag, np.array([reference]))
    stars = np.arange(len(database.mag)) if compatible is None else compatible[0].nonzero()[0]
    # Of stars with equal votes the southern ones come first, as in C, which has another order.
    stars = stars[np.argsort(database.directions[stars, 2], kind="stable")]
    observation.budget.spend(LOOKUP * (1 + len(stars) // STARS_OF_LOOKUP))
    for star, turn in leaders(stars, voters, table):
        proposed = _agreeing(reference, star, turn, voters, observation, database, table)
        if proposed is not None:
            yield proposed


def neighbours(database: MatcherDatabase, radius_rad: float) -> NeighbourTable:
    """Return the neighbours of every star within a separation."""
    u, cells = database.directions, cells_for(database, radius_rad)
    reach = 2.0 * math.sin(0.5 * radius_rad)
    counts, stars, aparts, turns = [], [], [], []
    for first in range(0, len(u), AT_ONCE):
        centre = u[first : first + AT_ONCE]
        centre_row, near = cells.near(centre, reach)
        other = near != centre_row + first
        centre_row, near = centre_row[other], near[other]
        counts.append(np.bincount(centre_row, minlength=len(centre)))
        stars.append(near.astype(np.int32))
        aparts.append(
            _apart_units(separation(centre[centre_row], u[near]), radius_rad).astype(np.uint16)
        )
        turns.append(_turn_units(position_angle(centre[centre_row], u[near])).astype(np.uint8))
    star = np.concatenate(stars)
    return NeighbourTable(
        radius_rad,
        np.concatenate([[0], np.cumsum(np.concatenate(counts))]),
        star,
        np.concatenate(aparts),
        np.concatenate(turns),
        _magnitude_units(np.asarray(database.mag, dtype=np.float64)).astype(np.uint8)[star],
    )


def voters_of(reference: int, observation: Observation, radius_rad: float) -> Voters:
    """Return the centroids around a reference that are far enough to have a position angle."""
    error = observation.side_tolerance_rad
    apart = observation.separation_rad[reference]
    votes = (apart >= 2.0 * error) & (apart - error <= radius_rad)
    votes[reference] = False
    rows = votes.nonzero()[0]
    rows = rows[np.argsort(apart[rows], kind="stable")][:MAX_VOTERS]
    bright, faint = np.zeros(len(rows), dtype=np.int64), np.full(len(rows), UNKNOWN - 1)
    if observation.mag is not None and observation.settings.noise_mag is not None:
        reach, mag = MAG_DEVIATIONS * observation.settings.noise_mag, observation.mag[rows]
        has_mag = np.isfinite(mag)
        bright = np.where(has_mag, _magnitude_units(mag - reach), bright)
        faint = np.where(has_mag, _magnitude_units(mag + reach), faint)
    body = observation.body
    return Voters(
        rows,
        _apart_units(apart[rows] - error, radius_rad),
        _apart_units(apart[rows] + error, radius_rad),
        bright,
        faint,
        _turn_units(position_angle(body[np.full(len(rows), reference)], body[rows])),
    )


def leaders(stars: Rows, voters: Voters, table: NeighbourTable) -> list[tuple[int, int]]:
    """Return the stars with more votes than chance would give, and their turns, the best first."""
    run, entry = rows_between(table.offsets[stars], table.offsets[stars + 1])
    order = np.argsort(table.apart[entry], kind="stable")
    run, entry = run[order], entry[order]
    apart, magnitude = table.apart[entry], table.magnitude[entry]
    turn = table.turn[entry].astype(np.int64)
    voted = np.zeros(len(stars) * BINS, dtype=np.uint32)
    total = np.zeros(len(stars), dtype=np.int64)
    first = np.searchsorted(apart, voters.nearest, side="left")
    stop = np.searchsorted(apart, voters.farthest, side="right")
    for n in range(len(voters)):
        part = slice(first[n], stop[n])
        like = (magnitude[part] >= voters.brightest[n]) & (magnitude[part] <= voters.faintest[n])
        like |= magnitude[part] == UNKNOWN
        owner = run[part][like]
        bins = (turn[part][like] - voters.turn[n]) % TURN // PER_BIN
        voted[owner * BINS + bins] |= np.uint32(1 << n)
        total += np.bincount(owner, minlength=len(stars))
    pairs = voted.reshape(len(stars), BINS)
    pairs = pairs | np.roll(pairs, -1, axis=1)
    votes = np.bitwise_count(pairs)
    best = votes.argmax(axis=1)
    most = votes[np.arange(len(stars)), best].astype(np.float64)
    expected = 2.0 / BINS * total + MIN_EXPECTED
    rows = np.flatnonzero((most >= MIN_VOTES) & (most > expected))
    most, expected = most[rows], expected[rows]
    weight = most * (np.log(most / expected) - 1.0) + expected
    rows = rows[np.argsort(-weight, kind="stable")[:MAX_KEPT]]
    return list(zip(stars[rows].tolist(), (PER_BIN * best[rows]).tolist(), strict=True))


def _agreeing(
    reference: int,
    star: int,
    turn: int,
    voters: Voters,
    observation: Observation,
    database: MatcherDatabase,
    table: NeighbourTable,
) -> Candidates | None:
    """Return a star with the pairs that voted for it and agree with one of them."""
    entry = slice(*table.offsets[star : star + 2])
    apart = table.apart[entry, None]
    votes = (apart >= voters.nearest) & (apart <= voters.farthest)
    votes &= (table.turn[entry, None] - voters.turn - turn) % TURN < 2 * PER_BIN
    near = table.star[entry]
    compatible = observation.compatible(database.mag[near], voters.centroids)
    if compatible is not None:
        votes &= compatible.T
    row, n = votes.nonzero()
    if not len(n):
        return None
    near, centroids = near[row], voters.centroids[n]
    body, u = observation.body, database.directions
    seen = position_angle(np.broadcast_to(body[reference], (len(n), 3)), body[centroids])
    angle = position_angle(np.broadcast_to(u[star], (len(n), 3)), u[near])
    middle = (turn + PER_BIN - 0.5) / TURN * math.tau
    deviation = np.remainder(angle - seen - middle + math.pi, math.tau) - math.pi
    error = observation.side_tolerance_rad / np.sin(
        observation.separation_rad[reference, centroids]
    )
    # Votes in rows, what they agree with in columns.
    agree = np.abs(deviation[:, None] - deviation) <= error[:, None]
    first = np.lexsort((np.abs(deviation), centroids))
    best = first[agree.sum(axis=0)[first].argmax()]
    kept = agree[:, best]
    return Candidates(
        np.concatenate([[reference], centroids[kept]])[None, :],
        np.concatenate([[star], near[kept]])[None, :],
    )


def position_angle(centre: Directions, other: Directions) -> Array:
    """Return the position angles of directions at centres, radians, shape (N,).

    Both of shape (N, 3). Each centre has an axis of its own, so that only differences at one
    centre have a meaning.
    """
    x, y, z = centre.T
    none = np.zeros(len(centre))
    polar = z * z > 0.5
    # The cross product of an axis with the centre; a second axis if the centre is near the first.
    east = np.where(polar, [z, none, -x], [-y, x, none]).T
    east /= np.linalg.norm(east, axis=1)[:, None]
    north = np.cross(centre, east)
    return np.asarray(
        np.arctan2(np.einsum("ij,ij->i", east, other), np.einsum("ij,ij->i", north, other))
    )


def _turn_units(angle_rad: Array) -> NDArray[np.int64]:
    return np.asarray((TURN / math.tau * angle_rad + TURN + 0.5).astype(np.int64) % TURN)


def _apart_units(apart_rad: Array, radius_rad: float) -> NDArray[np.int64]:
    units = np.clip(APART * apart_rad / radius_rad + 0.5, 0.0, APART)
    return np.asarray(units.astype(np.int64))


def _magnitude_units(mag: Array) -> NDArray[np.int64]:
    units = np.clip(PER_MAGNITUDE * (mag - BRIGHTEST) + 0.5, 0.0, UNKNOWN - 1.0)
    return np.asarray(np.where(np.isnan(mag), UNKNOWN, np.nan_to_num(units)).astype(np.int64))
