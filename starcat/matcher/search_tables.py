"""The search tables of a database for the C library: an onboard image in memory.

They are made at the first search. For a large database that takes seconds, so they are kept in the
cache folder under the digest of ``database.h5`` and are mapped by every later process.
"""

from __future__ import annotations

import logging
import mmap
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.database.onboard import layout
from starcat.database.onboard.image import Contents, make_image, rows_of_image
from starcat.errors import ConfigError
from starcat.matcher.database import MatcherDatabase
from starcat.storage.cache import keep, map_kept, remove_kept

KEPT_FEATURES = 300_000
"""Smallest number of triangles or pairs whose tables are kept; fewer take 0.2 s to make."""

KEPT_FOLDER, KEPT_BYTES = "search-tables", 2 * 2**30
"""Folder of the cache with kept tables, and the largest size of all of them."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SearchTables:
    """An onboard image, and the origin of its stars."""

    data: bytes | mmap.mmap
    star_rows: NDArray[np.int64]  # row of the database of each star of the image; shape (N,)
    most_near: int  # upper bound of the stars in the camera's circle


def search_tables(database: MatcherDatabase, method: str) -> SearchTables | None:
    """Return the tables of a database, kept ones if there are any.

    None if they are larger than an image can be.
    """
    product, columns = layout.FEATURES[method]
    arrays = [database.products[product].arrays[column] for column in columns]
    name = None
    digest = database.file_digest() if len(arrays[0]) >= KEPT_FEATURES else None
    if digest is not None:
        version = ".".join(map(str, layout.VERSION))
        name = f"{digest}-{method}-{version}.img"
        kept = _kept(database, name)
        if kept is not None:
            return kept
        _logger.info(
            "making the search tables of %s, once: %s %s", database.name, f"{len(arrays[0]):,}",
            product,
        )  # fmt: skip
    contents = Contents(
        database.name,
        database.epoch_jyear,
        database.camera,
        database.star_id,
        database.directions,
        database.mag,
        method,
        np.stack(arrays, axis=-1),
    )
    try:
        image = make_image(contents)
    except ConfigError:  # larger than an image can say
        return None
    if name is not None and keep(KEPT_FOLDER, name, image.data, KEPT_BYTES):
        kept = _kept(database, name)  # other processes share its memory
        if kept is not None:
            return kept
    return SearchTables(image.data, image.star_rows, image.most_near)


def _kept(database: MatcherDatabase, name: str) -> SearchTables | None:
    """Return kept tables; None if there are none, or if they are damaged."""
    mapped = map_kept(KEPT_FOLDER, name)
    if mapped is None:
        return None
    star_rows = rows_of_image(database.star_id, database.directions, database.camera)
    most_near = _most_near(mapped, database.star_id[star_rows])
    if most_near is None:
        _logger.info("%s is damaged and is made again", name)
        remove_kept(KEPT_FOLDER, name)
        return None
    return SearchTables(mapped, star_rows, most_near)


def _most_near(image: mmap.mmap, star_ids: NDArray[np.int64]) -> int | None:
    """Return this number of an image; None if the image is damaged or has other stars."""
    if len(image) < layout.HEADER_BYTES or layout.scrub(image):
        return None
    header = np.frombuffer(image, layout.HEADER, 1)[0]
    table = np.frombuffer(image, layout.SECTION, layout.MAX_SECTIONS, layout.HEADER.itemsize)
    [offset] = table["offset"][table["kind"] == layout.KINDS["star_ids"]][:1].tolist() or [0]
    stored = image[offset : offset + star_ids.nbytes]
    return int(header["most_near"]) if stored == star_ids.tobytes() else None
