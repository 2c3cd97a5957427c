"""Disk space: what a user takes, and how much one may take."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from starcat.errors import ProductError, TargetMissing
from starcat_service.access import ANONYMOUS
from starcat_service.library import Library
from starcat_service.records import Records
from starcat_service.security.request_limits import GIB
from starcat_service.settings import ServiceSettings


class Quota:
    """The disk space that users take, compared with ``disk_gib``."""

    def __init__(self, settings: ServiceSettings, records: Records, library: Library) -> None:
        self._settings, self._records, self._library = settings, records, library

    def owns(self, owner: str, database_id: str) -> bool:
        """Return whether a user had a database built."""
        return database_id in self._databases(owner)

    def database_bytes(self, owner: str) -> int:
        """Return the size of the databases that a user had built."""
        taken = 0
        for database_id in self._databases(owner):
            try:
                files = self._library.database(database_id).manifest["files"]
            except (TargetMissing, ProductError, OSError):
                continue
            taken += sum(int(facts["bytes"]) for facts in files.values())
        return taken

    def database_excess(self, owner: str, more_bytes: int = 0) -> str | None:
        """Return a message if a user's databases take more than allowed, else None."""
        taken = self.database_bytes(owner) + more_bytes
        # Without a token nobody may remove what others may have built.
        advice = "sign in" if owner == ANONYMOUS else "remove unused ones"
        return self.excess(taken, f"the databases of {owner}", advice)

    def excess(self, taken_bytes: int, what: str, advice: str) -> str | None:
        """Return a message if files of a user take more than allowed, else None."""
        if taken_bytes / GIB < self._settings.disk_gib:
            return None
        return (
            f"{what} take {taken_bytes / GIB:.2f} GiB, and {self._settings.disk_gib:g} are allowed "
            f"(disk_gib); {advice}, or ask the operator"
        )

    def _databases(self, owner: str) -> set[str]:
        rows = self._records.rows(
            "SELECT DISTINCT json_extract(result, '$.database') FROM jobs "
            "WHERE owner = ? AND kind = 'build' AND state = 'done'",
            owner,
        )
        return {str(database_id) for [database_id] in rows}


def folder_bytes(folder: Path) -> int:
    """Return the disk space of all below a folder; files removed meanwhile are not counted."""
    taken = 0
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            with suppress(OSError):
                taken += 512 * os.lstat(os.path.join(parent, name)).st_blocks
    return taken
