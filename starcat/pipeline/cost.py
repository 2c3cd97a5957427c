"""What a build will cost, before it makes anything: rows, memory and time from counts of stars.

The counts of pairs and neighbours are those around some of the stars, and the triangles that
several fields share are found from some of the triangles. Nothing here depends on the machine but
the memory that it has left. Times are those of a processor of 2020 that does nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from starcat.catalog.ingest import Ingested
from starcat.catalog.selection import Selected
from starcat.catalog.stars import directions_of
from starcat.errors import BuildError
from starcat.geometry.sphere import chord_from_separation
from starcat.pipeline.log import available_memory_bytes
from starcat.pipeline.recipes import RECIPES, Ingredients
from starcat.products.boresights import FieldStars
from starcat.specs.build_spec import BuildSpec

Array = NDArray[np.float64]

SAMPLE = 2000
"""Stars around which neighbours are counted, and triangles whose fields are."""

GOLDEN_RATIO = 0.5 * (1.0 + 5.0**0.5)

GIB = 2**30


@dataclass(frozen=True)
class Row:
    """What a row of a product costs.

    Attributes
    ----------
    held_bytes : float
        While the other products are made and written.
    working_bytes : float
        Beside that, while it is made itself.
    micros : float
        Microseconds to make, write and check it.
    """

    held_bytes: float
    working_bytes: float
    micros: float


ROWS: Mapping[str, Row] = {
    "pairs": Row(28.0, 110.0, 1.3),
    "triangles": Row(34.0, 50.0, 2.6),
    "neighbours": Row(44.0, 50.0, 2.4),
    "hausdorff_angular": Row(24.0, 40.0, 0.9),
    "hausdorff_l2": Row(24.0, 60.0, 1.2),
    "grid": Row(16.0, 60.0, 1.2),
    "radial": Row(12.0, 60.0, 1.2),
}
"""Measured with numpy 2 on products of 0.5 to 6 million rows."""

RECORD = Row(0.0, 32.0, 0.15)
"""A triangle of one field, before those that several fields have are made one."""

FIELD_STAR = Row(8.0, 60.0, 0.6)
"""A star in a field of the tiling."""

FIELD = Row(300.0, 1200.0, 40.0)
"""A field of the tiling, with its line and its dot in the report."""

BASE_BYTES = 320.0e6
"""The program and its libraries."""

CATALOG_FACTOR = 2.0
"""Bytes in memory over those of the star table."""

FRAME_SECONDS = 0.002
BASE_SECONDS = 3.0


@dataclass(frozen=True)
class Cost:
    """What a build will cost.

    Attributes
    ----------
    stars : int
        Guide stars.
    fields : int
        Boresights.
    rows : mapping of str to int
        Rows of each product that will be made.
    bytes : mapping of str to int
        Memory that leaving out each product would save.
    memory_bytes : int
        Most memory that the build will hold.
    seconds : float
        Time from here on.
    """

    stars: int
    fields: int
    rows: Mapping[str, int]
    bytes: Mapping[str, int]
    memory_bytes: int
    seconds: float

    @property
    def in_words(self) -> str:
        """One line for people."""
        named = [f"{_rounded(count)} {name}" for name, count in self.rows.items()]
        return (
            f"estimate: {self.stars:,} guide stars in {self.fields:,} fields; "
            f"{', '.join(named) or 'no products'}; {self.memory_bytes / GIB:.1f} GiB of memory, "
            f"{max(1, round(self.seconds)):,} s"
        )


def estimate_cost(
    catalog: Ingested, selected: Selected, fields: FieldStars, spec: BuildSpec
) -> Cost:
    """Estimate what the products of a build will cost.

    Parameters
    ----------
    catalog : Ingested
        All stars that were read.
    selected : Selected
        Guide stars.
    fields : FieldStars
        The tiling of the guide stars.
    spec : BuildSpec
        Which products, and their parameters.

    Returns
    -------
    Cost
        The same for the same input, on every machine.
    """
    given = Ingredients(directions_of(selected.guide_stars), fields, spec)
    base = BASE_BYTES + CATALOG_FACTOR * (catalog.stars.nbytes + catalog.rejected.nbytes)
    return product_cost(given, base)


def product_cost(given: Ingredients, base_bytes: float) -> Cost:
    """Estimate what products will cost.

    Parameters
    ----------
    given : Ingredients
        Guide stars, tiling and spec.
    base_bytes : float
        Memory that is taken before.

    Returns
    -------
    Cost
        The same for the same input, on every machine.
    """
    spec, fields = given.spec, given.fields
    wanted = [name for name in RECIPES if getattr(spec.products, name).enabled]
    radii = {name: _reach_rad(name, given) for name in wanted if name != "triangles"}
    counts = _neighbours_within(given.directions, sorted(set(radii.values())))
    rows = {name: float(len(given.directions) * counts[radius]) for name, radius in radii.items()}
    if "pairs" in rows:
        rows["pairs"] *= 0.5
    records = 0.0
    if "triangles" in wanted:
        records, distinct = _triangles(fields, len(given.directions), spec.boresights.brightest)
        rows["triangles"] = distinct
    parts = [(ROWS[name], rows[name]) for name in wanted]
    parts += [
        (FIELD, float(len(fields.count))),
        (FIELD_STAR, float(len(fields.star_index))),
        (RECORD, records),
    ]
    held = {name: rows[name] * ROWS[name].held_bytes for name in wanted}
    working = max((row.working_bytes * count for row, count in parts), default=0.0)
    memory = base_bytes + working + sum(row.held_bytes * count for row, count in parts)
    seconds = 1e-6 * sum(row.micros * count for row, count in parts)
    seconds += BASE_SECONDS + 3.0 * FRAME_SECONDS * spec.self_test.frames
    saved = {name: held[name] + rows[name] * ROWS[name].working_bytes for name in wanted}
    return Cost(
        len(given.directions),
        len(fields.count),
        {name: round(rows[name]) for name in wanted},
        {name: round(saved[name]) for name in wanted},
        round(memory),
        seconds,
    )


def check_memory(cost: Cost, spec: BuildSpec, max_memory_bytes: int | None = None) -> None:
    """Check that a build fits into the memory.

    Parameters
    ----------
    cost : Cost
        The estimate.
    spec : BuildSpec
        For the message.
    max_memory_bytes : int, optional
        The limit; by default what this process has and what the machine has left.

    Raises
    ------
    BuildError
        Naming the key that saves most.
    """
    limit, whose = max_memory_bytes, "the limit that was given"
    if limit is None:
        limit, whose = available_memory_bytes(), "what this machine has left"
    if limit is None or cost.memory_bytes <= limit:
        return
    largest = max(cost.bytes, key=lambda name: cost.bytes[name], default="")
    key = f"products.{largest}.enabled = false"
    if largest in ("", "triangles"):
        key = f"a smaller boresights.brightest than {spec.boresights.brightest}"
    raise BuildError(
        f"{spec.name}: the build would take about {cost.memory_bytes / GIB:.1f} GiB of memory, "
        f"more than {whose}, {limit / GIB:.1f} GiB; {key} saves most, and fewer stars "
        "(selection.max_stars_per_field, a brighter faint_limit_mag) save some of everything"
    )


def _reach_rad(name: str, given: Ingredients) -> float:
    """Return how far apart two stars of a row of a product may be."""
    wanted = getattr(given.spec.products, name)
    if name == "pairs":
        if wanted.max_separation_deg is None:
            return given.spec.camera.camera().diagonal_rad
        return float(np.radians(wanted.max_separation_deg))
    return given.radius_rad(wanted.radius_deg, 4.0 / 3.0 if name == "hausdorff_angular" else 1.0)


def _neighbours_within(directions: Array, radii_rad: list[float]) -> dict[float, float]:
    """Return the mean number of neighbours of a star within each radius, of some of the stars."""
    step = -(-len(directions) // SAMPLE)
    some, tree = directions[::step], cKDTree(directions)
    return {
        radius: float(
            np.mean(tree.query_ball_point(some, _chord(radius), return_length=True) - 1.0)
        )
        for radius in radii_rad
    }


def _chord(radius_rad: float) -> float:
    return float(chord_from_separation(min(radius_rad, np.pi)))


def _triangles(fields: FieldStars, stars: int, brightest: int) -> tuple[float, float]:
    """Return the triangles of all fields, and about how many of them are distinct.

    A triangle that t fields have is counted t times; so the distinct ones are as many as all times
    the mean of 1 / t.
    """
    offsets, star = fields.brightest(brightest)
    size = np.diff(offsets)
    each = size * (size - 1) * (size - 2) // 6
    records = int(each.sum())
    if not records:
        return 0.0, 0.0
    held = np.ones(len(star), dtype=np.int32)
    of_field = csr_array((held, star, offsets), shape=(len(size), stars))
    of_star = of_field.T.tocsr()
    # Multiples of the golden ratio are spread evenly, and never in step with the fields.
    chosen = (np.arange(min(records, SAMPLE)) * GOLDEN_RATIO % 1.0 * records).astype(np.int64)
    ends = np.cumsum(each)
    field = np.searchsorted(ends, chosen, side="right")
    within = chosen - (ends[field] - each[field])
    members = np.array(
        [_triples(int(size[f]))[int(n)] for f, n in zip(field, within, strict=True)], dtype=np.int64
    )
    i, j, k = star[offsets[field][:, None] + members].T
    shared = of_star[i].multiply(of_star[j]).multiply(of_star[k]).sum(axis=1)
    return float(records), float(records * np.mean(1.0 / np.asarray(shared).ravel()))


@lru_cache
def _triples(size: int) -> list[tuple[int, ...]]:
    return list(combinations(range(size), 3))


def _rounded(count: int) -> str:
    """Return a number in two digits, as an estimate is known."""
    digits = max(0, len(str(count)) - 2)
    return f"{round(count, -digits):,}"
