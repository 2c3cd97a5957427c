"""The differences of two databases: spec, sources, software, stars and products.

Stars are paired by their permanent number, not by row. So the result shows which star of the sky
was added, removed or moved, and why. If a catalog uses other numbers, as a new release can, stars
are paired by position, motion and magnitude.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arguments import HasFolder, database_path
from starcat.catalog.stars.star_table import STAR_KEY, directions_of, floats_of, rows_of_stars
from starcat.catalog.stars.verdict import Reason
from starcat.database.products.crossmatch import NEEDED, Crossmatch, crossmatch
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.geometry.sphere import separation
from starcat.html_tables import html_table
from starcat.resources import PathLike
from starcat.results import in_record

MOVED_ARCSEC = 1e-3
"""A star counts as moved if its positions differ by more than this."""

PAIR_ARCSEC = 10.0
"""Largest separation of stars paired by position, at a common epoch."""

FAR_ARCSEC = 60.0
"""If half of the stars with equal numbers are farther apart, the numbering has changed."""

NOT_READ = "not in that catalog"

_NO_ROWS: NDArray[np.intp] = np.empty(0, dtype=np.intp)


@dataclass(frozen=True)
class Change:
    """A value that differs."""

    name: str  # name of the value; dotted for a key of the spec
    a: object  # the two values; None if one side has no value
    b: object


@dataclass(frozen=True)
class OneSided:
    """A guide star of one database that is not a guide star of the other."""

    star_id: int  # permanent number
    designation: str
    mag: float | None  # magnitude in the database with this guide star
    reason: str  # reason for its rejection by the other database, or that it was not read


@dataclass(frozen=True)
class Moved:
    """A guide star of both databases whose position or magnitude differs."""

    star_id: int  # permanent number
    designation: str
    moved_arcsec: float  # great-circle separation of the two positions
    mag_a: float | None  # magnitudes
    mag_b: float | None


@dataclass(frozen=True)
class ProductChange:
    """A product in both databases."""

    product: str
    rows_a: int | None  # records; None if a database lacks the product
    rows_b: int | None
    is_same: bool  # True if schema and content digest are equal
    content: str  # "same", "differs", or the columns that another schema added


@dataclass(frozen=True, repr=False)
class Difference:
    """The differences of database A and database B.

    Attributes
    ----------
    spec : tuple[Change, ...]
        Keys of the spec.
    sources : tuple[Change, ...]
        Catalogs, their files and counts.
    software : tuple[Change, ...]
        Versions of starcat and of libraries.
    came : tuple[OneSided, ...]
        Guide stars only in B.
    went : tuple[OneSided, ...]
        Guide stars only in A.
    moved : tuple[Moved, ...]
        Guide stars of both with another position or magnitude.
    paired_by_number : int
        Guide stars of both with the same number.
    paired_by_position : int
        Guide stars of both paired by position, motion and magnitude.
    products : tuple[ProductChange, ...]
        Every product of either.
    """

    spec: tuple[Change, ...]
    sources: tuple[Change, ...]
    software: tuple[Change, ...]
    came: tuple[OneSided, ...]
    went: tuple[OneSided, ...]
    moved: tuple[Moved, ...]
    paired_by_number: int
    paired_by_position: int
    products: tuple[ProductChange, ...]

    @property
    @in_record()
    def is_same(self) -> bool:
        """Whether both have the same products, made from the same spec and sources."""
        return not (self.spec or self.sources) and all(change.is_same for change in self.products)

    @property
    def _counts(self) -> dict[str, int]:
        """Numbers of differences, by kind."""
        return {
            "keys of the spec": len(self.spec),
            "sources": len(self.sources),
            "software": len(self.software),
            "guide stars only in B": len(self.came),
            "guide stars only in A": len(self.went),
            "guide stars moved": len(self.moved),
            "products": sum(not change.is_same for change in self.products),
        }

    def __repr__(self) -> str:
        counts = ", ".join(f"{name} {count:,}" for name, count in self._counts.items() if count)
        return f"<Difference: {'same' if self.is_same else 'not same'}{counts and ': '}{counts}>"

    def _repr_html_(self) -> str:
        """Return the numbers of differences as a table for a notebook."""
        rows = [(name, f"{count:,}") for name, count in self._counts.items()]
        return html_table(("differences", "number"), rows, len(rows), repr(self)[1:-1])


def diff(a: HasFolder | PathLike, b: HasFolder | PathLike) -> Difference:
    """Return the differences of two databases.

    Parameters
    ----------
    a, b : Database, str or path-like
        Results of `starcat.open`, or folders of databases.

    Returns
    -------
    Difference
        Stars, products, and keys of the specs that differ; ``is_same`` if nothing does.

    Raises
    ------
    ProductError, SchemaVersionError
        If a folder is not a database, or another version of starcat wrote it.
    """
    old, new = _opened("a", a), _opened("b", b)
    tables = [(side.table("stars"), side.table("rejected")) for side in (old, new)]
    (stars_a, rejected_a), (stars_b, rejected_b) = tables
    # Equal numbers mean the same star only within one catalog, and only with the same numbering.
    is_numbered_alike = _catalog(old) == _catalog(new) and _agree(stars_a, stars_b)
    rows_a, rows_b = _paired_rows(stars_a, stars_b, is_numbered_alike=is_numbered_alike)
    n_numbered = int(_is_same_star(stars_a.take(rows_a), stars_b.take(rows_b)).sum())
    known_a, known_b = rejected_a, rejected_b
    if not is_numbered_alike:
        known_a = _numbered_as(stars_b.take(_others(stars_b, rows_b)), rejected_a)
        known_b = _numbered_as(stars_a.take(_others(stars_a, rows_a)), rejected_b)
    return Difference(
        spec=changes_between(_dotted(old.manifest["spec"]), _dotted(new.manifest["spec"])),
        sources=changes_between(_source_facts(old), _source_facts(new)),
        software=changes_between(old.manifest["software"], new.manifest["software"]),
        came=_one_sided(stars_b, rows_b, known_a, _read_limit_mag(old, new)),
        went=_one_sided(stars_a, rows_a, known_b, _read_limit_mag(new, old)),
        moved=_moved(stars_a.take(rows_a), stars_b.take(rows_b)),
        paired_by_number=n_numbered,
        paired_by_position=len(rows_a) - n_numbered,
        products=_products(old, new),
    )


def _opened(name: str, database: HasFolder | PathLike) -> DatabaseFolder:
    if isinstance(database, DatabaseFolder):
        return database
    return open_database_folder(database_path(name, database))


def _read_limit_mag(database: DatabaseFolder, other: DatabaseFolder) -> float:
    """Return the limiting magnitude to which a database lists stars of the other's catalog."""
    mine, theirs = (side.manifest["spec"]["catalog"] for side in (database, other))
    limit_mag = mine.get("read_limit_mag")
    is_same = all(mine.get(key) == theirs.get(key) for key in ("source", "band"))
    return float("inf") if limit_mag is None or not is_same else float(limit_mag)


def _catalog(database: DatabaseFolder) -> str:
    return str(database.manifest["spec"]["catalog"]["source"])


def _is_same_star(a: pa.Table, b: pa.Table) -> NDArray[np.bool_]:
    """Return whether rows have the same number of the same catalog."""
    same = [pc.equal(a[name], b[name]) for name in STAR_KEY]
    return np.asarray(pc.and_(*same).to_numpy())


def _common_rows(a: pa.Table, b: pa.Table) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of stars with the same number of the same catalog, by number."""
    rows_b = rows_of_stars(a, b)
    rows_a = np.flatnonzero(rows_b >= 0)
    return rows_a, rows_b[rows_a]


def _others(stars: pa.Table, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.setdiff1d(np.arange(len(stars)), rows)


def _agree(a: pa.Table, b: pa.Table) -> bool:
    """Return whether stars with equal numbers are near each other in two databases."""
    rows_a, rows_b = _common_rows(a, b)
    off = separation(directions_of(a)[rows_a], directions_of(b)[rows_b])
    return bool(np.median(np.append(off, 0.0)) * 206264.8 < FAR_ARCSEC)


def _paired_rows(
    a: pa.Table, b: pa.Table, *, is_numbered_alike: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of common stars: paired by number if it is reliable, else by position."""
    numbered = _common_rows(a, b) if is_numbered_alike else (_NO_ROWS, _NO_ROWS)
    left_a, left_b = _others(a, numbered[0]), _others(b, numbered[1])
    placed = _rows_by_position(a.take(left_a), b.take(left_b))
    return np.append(numbered[0], left_a[placed[0]]), np.append(numbered[1], left_b[placed[1]])


def _rows_by_position(a: pa.Table, b: pa.Table) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of stars that are each other's unambiguous likeliest counterpart."""
    if not (len(a) and len(b) and {*NEEDED} <= {*a.column_names} & {*b.column_names}):
        return _NO_ROWS, _NO_ROWS
    matches = crossmatch(a, b, Crossmatch(radius_arcsec=PAIR_ARCSEC))
    rows_a, rows_b = matches.table["star"].to_numpy().astype(np.intp), matches.counterpart
    is_same_number = _is_same_star(a.take(pa.array(rows_a)), b.take(pa.array(rows_b)))
    is_unique = pc.equal(matches.table["verdict"], "unique").to_numpy() | is_same_number
    ranks = [matches.table[name].to_numpy() for name in ("rank", "star_rank")]
    taken = (ranks[0] == 1) & (ranks[1] == 1) & is_unique
    return rows_a[taken], rows_b[taken]


def _numbered_as(stars: pa.Table, rejected: pa.Table) -> pa.Table:
    """Return the rejected rows that match stars of another catalog, with their numbers there."""
    is_placed = np.isfinite([floats_of(rejected, name) for name in ("ra_deg", "epoch_jyear")])
    placed = rejected.filter(pa.array(is_placed.all(axis=0)))
    for name in sorted({*NEEDED} - {*placed.column_names}):  # rejected stars have no motions
        placed = placed.append_column(name, pa.nulls(len(placed), pa.float64()))
    rows, placed_rows = _rows_by_position(stars, placed)
    numbered = placed.take(placed_rows)
    for name in STAR_KEY:
        position = numbered.column_names.index(name)
        numbered = numbered.set_column(position, name, stars[name].take(rows))
    return numbered


def _dotted(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested keys as one level of dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            flat |= _dotted(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def _source_facts(database: DatabaseFolder) -> dict[str, Any]:
    """Return digests and counts, by names that are the same in both databases."""
    facts: dict[str, Any] = {}
    for source in database.manifest["sources"]:
        # A catalog can be read several times: also for amplitudes, motions and counterparts.
        role = source["role"]
        name = source["source"] + (
            f" {role}" if role in ("crossmatch", "motions", "photometry") else ""
        )
        facts |= {f"{name} {key}": source[key] for key in ("rows_read", "kept")}
        facts |= {f"{name} rejected {key}": count for key, count in source["rejected"].items()}
        for file in source["files"]:
            facts[f"{name} file {file['name']} sha256"] = file["sha256"]
            facts[f"{name} file {file['name']} rows"] = file["rows"]
    return facts


def changes_between(a: Mapping[str, Any], b: Mapping[str, Any]) -> tuple[Change, ...]:
    """Return the keys whose values differ.

    Examples
    --------
    >>> changes_between({"x": 1, "y": 2}, {"x": 1, "y": 3})
    (Change(name='y', a=2, b=3),)
    """
    names = dict.fromkeys([*a, *b])
    return tuple(
        Change(name, a.get(name), b.get(name)) for name in names if a.get(name) != b.get(name)
    )


def _one_sided(
    stars: pa.Table, common: NDArray[np.intp], rejected: pa.Table, read_limit_mag: float
) -> tuple[OneSided, ...]:
    alone = np.ones(len(stars), dtype=bool)
    alone[common] = False
    alone_stars = stars.filter(pa.array(alone))
    is_named = pc.and_(*(pc.is_valid(rejected[name]) for name in STAR_KEY))
    rejected = rejected.filter(is_named)
    rows = rows_of_stars(rejected, alone_stars)
    reasons: dict[int, str] = {}
    reason_of_row = rejected["reason"].to_pylist()
    for row, star in zip(np.flatnonzero(rows >= 0).tolist(), rows[rows >= 0].tolist(), strict=True):
        # Ignore the reason of a repeated record: the star's first record was judged.
        if reasons.get(star, Reason.duplicate_record.name) == Reason.duplicate_record.name:
            reasons[star] = reason_of_row[row]
    beyond = Reason.beyond_read_limit.name
    for star, mag in enumerate(alone_stars["mag"].to_pylist()):
        if mag is not None and mag > read_limit_mag:
            reasons.setdefault(star, beyond)
    return tuple(
        OneSided(**identity, reason=reasons.get(star, NOT_READ))
        for star, identity in enumerate(
            alone_stars.select(["star_id", "designation", "mag"]).to_pylist()
        )
    )


def _moved(a: pa.Table, b: pa.Table) -> tuple[Moved, ...]:
    arcsec = np.degrees(separation(directions_of(a), directions_of(b))) * 3600.0
    mag_a, mag_b = floats_of(a, "mag"), floats_of(b, "mag")
    same_mag = (mag_a == mag_b) | (np.isnan(mag_a) & np.isnan(mag_b))
    rows = np.flatnonzero((arcsec > MOVED_ARCSEC) | ~same_mag)
    both = zip(
        a.take(rows).select(["star_id", "designation", "mag"]).to_pylist(),
        b["mag"].take(pa.array(rows)).to_pylist(),
        arcsec[rows].tolist(),
        strict=True,
    )
    return tuple(
        Moved(star["star_id"], star["designation"], off, star["mag"], later)
        for star, later, off in both
    )


def _products(a: DatabaseFolder, b: DatabaseFolder) -> tuple[ProductChange, ...]:
    facts_a, facts_b = a.manifest["products"], b.manifest["products"]
    changes = []
    for name in dict.fromkeys([*facts_a, *facts_b]):
        before, after = facts_a.get(name), facts_b.get(name)
        has_both = before is not None and after is not None
        is_same = has_both and all(
            before[key] == after[key] for key in ("schema", "content_sha256")
        )
        content = "same" if is_same else "differs"
        if has_both and before["schema"] != after["schema"]:
            content = _change_of_schema(a.table(name), b.table(name))
        rows_a, rows_b = (facts and facts["rows"] for facts in (before, after))
        changes.append(ProductChange(name, rows_a, rows_b, is_same, content))
    return tuple(changes)


def _change_of_schema(a: pa.Table, b: pa.Table) -> str:
    """Return the added columns of a product of another schema, and whether the others are equal."""
    shared = [name for name in a.column_names if name in b.column_names]
    differences = [
        f"{len(names)} columns {which}"
        for which, names in (
            ("more", set(b.column_names) - set(shared)),
            ("fewer", set(a.column_names) - set(shared)),
        )
        if names
    ]
    is_equal = all(a[name].equals(b[name]) for name in shared)
    return ", ".join([*differences, "the others are the same" if is_equal else "others differ"])
