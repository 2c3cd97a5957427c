"""The plan of a cross-identification of two catalog stores: how far to look, in which pieces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from starcat.artifact.crossmatch_table import moving_stars
from starcat.pipeline.star_rows import opened, rows_of_partition
from starcat.products.crossmatch import MovingStars
from starcat.products.match_figures import Figures, MatchModel
from starcat.products.star_counts import Census
from starcat.store.pixels import Pixel, border_order

PLACED = (
    "star_id",
    "ra_deg",
    "dec_deg",
    "epoch_jyear",
    "pm_ra_cosdec_mas_yr",
    "pm_dec_mas_yr",
    "mag",
)
"""Columns that place a star and tell how bright it is."""

PIECE_LOAD = 1 << 19
"""Stars of both catalogs and pairs that a piece should have at most: some 200 MB."""


@dataclass(frozen=True)
class Extent:
    """What is known of a catalog, or a part of it, before any pair is looked for."""

    census: Census  # counts of its stars
    speed_rad_yr: float  # the largest proper motion, radians a year
    has_still: bool  # whether any star has none
    # first_jyear, last_jyear: epochs of its positions
    first_jyear: float
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

    # a, b, scratch: the two stores, and the folder for what is not finished
    a: Path
    b: Path
    scratch: Path
    radius_rad: float  # largest separation of a candidate
    model: MatchModel  # what the odds assume
    # how far a candidate's position may be from that of its star, each at its own epoch
    hop_rad: float = 0.0
    figures: Figures | None = None  # what is known of both catalogs, once it is


@dataclass(frozen=True)
class Piece:
    """A piece of the sky and its place in the order of all."""

    number: int
    pixel: Pixel


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
) -> list[Piece]:
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
    chosen.sort(key=lambda pixel: pixel.first)
    return [Piece(number, pixel) for number, pixel in enumerate(chosen)]


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


def numbers_path(job: Job, kind: str, piece: Piece) -> Path:
    """Return the file of some numbers of a piece."""
    return job.scratch / f"{kind}-{piece.number}.f8"


def rows_path(job: Job, piece: Piece) -> Path:
    """Return the file of the rows of a piece."""
    return job.scratch / f"rows-{piece.number}.parquet"
