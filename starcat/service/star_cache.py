"""Catalogs that were read, on disk: what an estimate starts from, under what it depends on.

A folder holds the star table and, where a spec asks for motions, where these are from. It is whole
or absent; one that cannot be read is made again, and the oldest go when there are many.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from starcat.errors import OutputError
from starcat.pipeline.stars_read import StarsRead
from starcat.storage.atomic import move_into_place, whole_folder
from starcat.storage.digests import json_bytes
from starcat.storage.parquet import read_parquet, write_parquet
from starcat.storage.schema import product_schema

FACTS, STARS, MOTIONS = "facts.json", "stars.parquet", "motions.parquet"

MOST_FOLDERS, MOST_BYTES = 24, 4 << 30
"""Kept on disk at the most; the least recently used are removed beyond it."""

FIGURES = (
    "rejected",
    "rejected_rows",
    "rejected_bytes",
    "held_bytes",
    "records",
    "notes",
)
"""Of `StarsRead`, but for its tables."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CatalogRead:
    """What is known of a catalog that was read.

    Attributes
    ----------
    source, band : str
        Which catalog, and of which magnitudes.
    epoch_jyear : float
        Julian year that its stars were moved to.
    stars : int
        Stars that can be chosen from.
    brightest_mag, faintest_mag : float, optional
        Of the stars that have a magnitude.
    """

    source: str
    band: str
    epoch_jyear: float
    stars: int
    brightest_mag: float | None
    faintest_mag: float | None


class StarCache:
    """The folder of catalogs that were read."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load(self, key: str) -> StarsRead | None:
        """Return the catalogs that were kept under a key."""
        folder = self._folder / key
        if not (folder / FACTS).is_file():
            return None
        try:
            facts = json.loads((folder / FACTS).read_bytes())
            stars = _table(folder / STARS, "stars")
            motions = _table(folder / MOTIONS, "motions") if facts["has_motions"] else None
            figures = {name: facts[name] for name in FIGURES}
            figures["notes"] = tuple(figures["notes"])
            with suppress(OSError):
                os.utime(folder)  # the least recently used goes first
            return StarsRead(stars=stars, motions=motions, **figures)
        except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
            _logger.warning("%s cannot be read (%s); it is made again", folder, error)
            shutil.rmtree(folder, ignore_errors=True)
            return None

    def keep(self, key: str, read: StarsRead, catalog: CatalogRead) -> None:
        """Keep catalogs; a disk that is full is no failure."""
        final = self._folder / key
        facts: dict[str, Any] = {name: getattr(read, name) for name in FIGURES}
        facts |= {"has_motions": read.motions is not None, "catalog": asdict(catalog)}
        try:
            with whole_folder(final) as partial:
                write_parquet(read.stars, partial / STARS)
                if read.motions is not None:
                    write_parquet(read.motions, partial / MOTIONS)
                (partial / FACTS).write_bytes(json_bytes(facts))
                move_into_place(partial, final, replace=True)
        except OutputError as error:
            _logger.warning("a catalog that was read is not kept: %s", error)
        self._remove_oldest()

    def catalogs(self) -> dict[str, CatalogRead]:
        """Return what is known of all catalogs that are kept."""
        found = {}
        for _, folder in self._by_age():
            with suppress(OSError, ValueError, KeyError, TypeError):
                facts = json.loads((folder / FACTS).read_bytes())
                found[folder.name] = CatalogRead(**facts["catalog"])
        return found

    def _by_age(self) -> list[tuple[int, Path]]:
        aged = []
        for path in self._folder.glob(f"*/{FACTS}"):
            with suppress(OSError):  # removed meanwhile
                aged.append((path.parent.stat().st_mtime_ns, path.parent))
        return sorted(aged)

    def _remove_oldest(self) -> None:
        sizes = []
        for _, folder in self._by_age():
            with suppress(OSError):
                sizes.append((folder, sum(path.stat().st_size for path in folder.iterdir())))
        total = sum(size for _, size in sizes)
        while len(sizes) > MOST_FOLDERS or (total > MOST_BYTES and len(sizes) > 1):
            folder, size = sizes.pop(0)
            shutil.rmtree(folder, ignore_errors=True)
            total -= size


def _table(path: Path, product: str) -> pa.Table:
    """Read a table as it was in memory, and check that it is of its schema."""
    schema = product_schema(product)
    table = read_parquet(path).select(schema.arrow_schema.names).cast(schema.arrow_schema)
    schema.check(table)
    return table.combine_chunks()
