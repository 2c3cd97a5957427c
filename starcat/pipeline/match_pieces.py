"""Cross-identification of one piece of the sky, from two catalog stores.

A piece is a pixel. Its stars are matched with all that has a say in it: their candidates, the
other stars of these, and for the probabilities the whole cluster of pairs, however far it
reaches across the borders of partitions. So the result of a star does not depend on the pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from starcat.arrays import Mask
from starcat.artifact.other_catalogs import NEEDED, moving_stars, table_from_matches
from starcat.pipeline.counterparts import with_own_names
from starcat.pipeline.match_summary import Tally, differences_of, tally_of, write_numbers
from starcat.pipeline.star_rows import opened, rows_of_partition, rows_of_region
from starcat.products.crossmatch import candidate_pairs, judged
from starcat.products.match_figures import Census, Figures, MatchModel, MovingStars, Pairs, is_sure
from starcat.products.match_odds import ROUNDS
from starcat.storage.atomic import whole_file
from starcat.store.pixels import (
    HEALPIX_COLUMN,
    MAX_ORDER,
    Pixel,
    Pixels,
    border_order,
    region_around,
)

PLACED = (
    "star_id", "ra_deg", "dec_deg", "epoch_jyear", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "mag",
)  # fmt: skip
"""Columns that place a star and tell how bright it is."""

PIECE_LOAD = 1 << 19
"""Stars of both catalogs and pairs that a piece should have at most: some 200 MB."""


@dataclass(frozen=True)
class Extent:
    """What is known of a catalog, or a part of it, before any pair is looked for."""

    census: Census  # counts of its stars
    speed_rad_yr: float  # the largest proper motion, radians a year
    has_still: bool  # whether any star has none
    first_jyear: float  # earliest epoch of its positions
    last_jyear: float

    @classmethod
    def of(cls, stars: MovingStars) -> Extent:
        """Return what is known of stars."""
        speed = np.sqrt(np.einsum("ij,ij->i", stars.velocities, stars.velocities))
        return cls(
            Census.of(stars),
            float(speed.max(initial=0.0)),
            bool((~stars.has_motion).any()),
            float(stars.epoch_jyear.min(initial=np.inf)),
            float(stars.epoch_jyear.max(initial=-np.inf)),
        )

    @classmethod
    def of_none(cls) -> Extent:
        """Return what is known of no stars."""
        return cls.of(moving_stars(pa.table({name: pa.array([], pa.float64()) for name in PLACED})))

    def __add__(self, other: Extent) -> Extent:
        """Return what is known of both."""
        return Extent(
            self.census + other.census,
            max(self.speed_rad_yr, other.speed_rad_yr),
            self.has_still or other.has_still,
            min(self.first_jyear, other.first_jyear),
            max(self.last_jyear, other.last_jyear),
        )


@dataclass(frozen=True)
class Job:
    """What all tasks of a cross-identification need."""

    a: Path  # a store, as is b
    b: Path
    scratch: Path  # folder for what is not finished
    radius_rad: float  # largest separation of a candidate
    model: MatchModel  # what the odds assume
    # how far a candidate's position may be from that of its star, each at its own epoch
    hop_rad: float = 0.0
    figures: Figures | None = None  # what is known of both catalogs, once it is


def hop_of(a: Extent, b: Extent, radius_rad: float) -> float:
    """Return how far the positions of a star and a candidate may be apart."""
    years = max(a.last_jyear - b.first_jyear, b.last_jyear - a.first_jyear, 0.0)
    # Candidates are moved only to stars that cannot be moved themselves.
    speed = max(a.speed_rad_yr, b.speed_rad_yr if a.has_still else 0.0)
    return (radius_rad + speed * years) * (1.0 + 1e-9)


def pieces_of(
    a: Sequence[tuple[Pixel, int]],
    b: Sequence[tuple[Pixel, int]],
    job: Job,
    piece_load: int = PIECE_LOAD,
) -> list[Pixel]:
    """Divide the sky into pieces that one worker at a time can hold."""
    finest = border_order(job.hop_rad)
    share = np.pi * job.radius_rad**2 / (4.0 * np.pi / 12.0)
    chosen: list[Pixel] = []
    waiting = [(Pixel(0, number), a, b) for number in range(12)]
    while waiting:
        pixel, of_a, of_b = waiting.pop()
        of_a, of_b = _overlapping(of_a, pixel), _overlapping(of_b, pixel)
        stars, others = _rows_within(of_a, pixel), _rows_within(of_b, pixel)
        pairs = stars * others * share * 4.0**pixel.order
        if not stars:
            continue
        if pixel.order >= finest or stars + others + pairs <= piece_load:
            chosen.append(pixel)
        else:
            children = range(4 * pixel.number, 4 * pixel.number + 4)
            waiting += [(Pixel(pixel.order + 1, child), of_a, of_b) for child in children]
    return sorted(chosen, key=lambda pixel: pixel.first)


def _overlapping(parts: Sequence[tuple[Pixel, int]], pixel: Pixel) -> list[tuple[Pixel, int]]:
    return [part for part in parts if part[0].first < pixel.end and pixel.first < part[0].end]


def _rows_within(parts: Sequence[tuple[Pixel, int]], pixel: Pixel) -> float:
    """Return about how many stars of partitions a pixel has, if they are spread evenly."""
    return sum(rows / 4.0 ** max(pixel.order - part.order, 0) for part, rows in parts)


def extent_of_partition(job: Job, place: tuple[Path, int]) -> Extent:
    """Count the stars of a partition of a store."""
    store = opened(place[0], job.scratch)
    partition = store.catalog.partitions[place[1]]
    total = Extent.of_none()
    for rows in rows_of_partition(store, partition, PLACED):
        total += Extent.of(moving_stars(rows))
    return total


def numbers_path(job: Job, kind: str, piece: Pixel) -> Path:
    """Return the file of some numbers of a piece."""
    return job.scratch / f"{kind}-{piece.order}-{piece.number}.f8"


def rows_path(job: Job, piece: Pixel) -> Path:
    """Return the file of the rows of a piece."""
    return job.scratch / f"rows-{piece.order}-{piece.number}.parquet"


MOST_RINGS = 2 * ROUNDS + 8
"""Messages of a cluster go no farther than two pairs in a round: with so many rings a piece has
all that its probabilities depend on."""


@dataclass(frozen=True)
class _Local:
    """Stars of a piece and of the rings around it, their candidates, and all pairs of these."""

    piece: Pixel
    rings: int
    star_rows: pa.Table
    other_rows: pa.Table
    stars: MovingStars
    others: MovingStars
    pairs: Pairs
    levels: NDArray[np.int64]
    other_levels: NDArray[np.int64]

    @cached_property
    def pixels(self) -> Pixels:
        return np.asarray(self.star_rows[HEALPIX_COLUMN].to_numpy(), dtype=np.int64)

    @cached_property
    def is_own(self) -> Mask:
        """Which stars are of the piece itself."""
        first, end = self.piece.first, self.piece.end
        return (self.pixels >= first) & (self.pixels < end)

    def linked(self) -> tuple[Mask, bool]:
        """Return which pairs are in a cluster with a star of the piece, and if these are whole.

        A cluster is whole where all its stars are before the last ring: whatever they are pairs
        with is here then.
        """
        i, j = self.pairs.star, self.pairs.counterpart
        count = len(self.levels) + len(self.other_levels)
        edges = (np.ones(len(i), dtype=np.int8), (i, len(self.levels) + j))
        labels = connected_components(coo_array(edges, shape=(count, count)), directed=False)[1]
        has_own = np.zeros(count + 1, dtype=bool)
        has_own[labels[i[self.is_own[i]]]] = True
        kept = has_own[labels[i]]
        farthest = max(
            self.levels[i[kept]].max(initial=0), self.other_levels[j[kept]].max(initial=0)
        )
        return kept, bool(farthest < self.rings)


def _local(job: Job, piece: Pixel, rings: int, columns: Sequence[str]) -> _Local:
    """Read a piece and so many rings around it, and find all pairs there."""
    region = region_around(piece, job.hop_rad, rings)
    own = (*PLACED, "designation") if "designation" in columns else PLACED
    star_rows = rows_of_region(opened(job.a, job.scratch), region, own)
    other_rows = rows_of_region(opened(job.b, job.scratch), region, columns)
    stars, others = moving_stars(star_rows), moving_stars(other_rows)
    levels, other_levels = (
        region.level_of(rows[HEALPIX_COLUMN].to_numpy()) for rows in (star_rows, other_rows)
    )
    pairs = candidate_pairs(stars, others, job.radius_rad)
    return _Local(piece, rings, star_rows, other_rows, stars, others, pairs, levels, other_levels)


def measure_piece(job: Job, piece: Pixel) -> tuple[int, int]:
    """Find the sure pairs of a piece, whose separations and magnitudes go to the scratch folder.

    Returns the number of its stars, and of those that have candidates.
    """
    here = _local(job, piece, 2, PLACED)
    i, j = here.pairs.star, here.pairs.counterpart
    own = here.is_own[i]
    sure = is_sure(i, j) & own
    delta = here.others.mag[j[sure]] - here.stars.mag[i[sure]]
    known = delta[~np.isnan(delta)]
    write_numbers(here.pairs.separation_rad[sure], numbers_path(job, "sure", piece))
    write_numbers(known, numbers_path(job, "sure-delta", piece))
    return int(here.is_own.sum()), len(np.unique(i[own]))


def judge_piece(job: Job, piece: Pixel) -> tuple[Tally, dict[str, int]]:
    """Judge the candidates of the stars of a piece; they go to the scratch folder.

    Returns a tally of them, and the length of the longest text of each column.
    """
    if job.figures is None:
        raise ValueError("figures are missing; both catalogs have to be measured first")
    # Clusters mostly end within three rings, which cost nothing where these are narrow.
    rings = 4 if border_order(job.hop_rad) >= min(piece.order + 4, MAX_ORDER) else 2
    here = _local(job, piece, rings, NEEDED)
    kept, is_whole = here.linked()
    while not is_whole and rings < MOST_RINGS:
        rings = min(2 * rings, MOST_RINGS)
        here = _local(job, piece, rings, NEEDED)
        kept, is_whole = here.linked()
    found = judged(
        here.stars, here.others, here.pairs.take(kept), job.radius_rad, job.figures, job.model
    )
    own = np.flatnonzero(here.is_own[found.star])
    star = found.star[own]
    found = found.take(own[np.lexsort((found.rank[own], star, here.pixels[star]))])
    table = table_from_matches(found, here.other_rows)
    tally, differences = tally_of(found, table), differences_of(found, table)
    table = with_own_names(table, here.star_rows).drop_columns("star")
    write_numbers(differences[0], numbers_path(job, "matched", piece))
    write_numbers(differences[1], numbers_path(job, "matched-delta", piece))
    with whole_file(rows_path(job, piece)) as partial:
        pq.write_table(table, partial, compression="zstd")
    return tally, _longest(table)


def _longest(table: pa.Table) -> dict[str, int]:
    return {
        field.name: pc.max(pc.utf8_length(table[field.name])).as_py() or 0
        for field in table.schema
        if pa.types.is_string(field.type)
    }
