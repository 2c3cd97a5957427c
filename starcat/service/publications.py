"""What was published, by whom and why: beside the registry, which keeps the content."""

from __future__ import annotations

import time
from dataclasses import dataclass

from starcat.releases.publishing import Published
from starcat.service.records import Records


@dataclass(frozen=True)
class Publication:
    """That a release was published."""

    # name, version: which release
    name: str
    version: str
    database: str  # id of the database that it was
    # note, owner: what was said about it, and who published it
    note: str
    owner: str
    published_s: float  # seconds since 1970


class Publications:
    """The publications of a service."""

    def __init__(self, records: Records) -> None:
        self._records = records

    def add(self, published: Published, database: str, note: str, owner: str) -> None:
        """Remember a publication; one that is known keeps its first note."""
        release = published.release
        with self._records.writing() as connection:
            connection.execute(
                "INSERT OR IGNORE INTO publications "
                "(name, version, database, note, owner, published_s) VALUES (?, ?, ?, ?, ?, ?)",
                (release.name, release.version, database, note, owner, time.time()),
            )

    def all(self) -> dict[tuple[str, str], Publication]:
        """Return all publications."""
        with self._records.reading() as connection:
            rows = connection.execute(
                "SELECT name, version, database, note, owner, published_s FROM publications"
            ).fetchall()
        return {(row["name"], row["version"]): Publication(**dict(row)) for row in rows}
