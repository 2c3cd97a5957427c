"""What a user's jobs may take of the disk, and what is left free for everything else."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.errors import ProductError, TargetMissing
from starcat.service.problems import Problem

if TYPE_CHECKING:
    from starcat.service.service import Service

GIB = 2**30


def check_room(service: Service, owner: str) -> None:
    """Check that there is room for what a user wants to have made."""
    short = disk_shortage(service)
    if short is not None:
        raise Problem(507, short)
    full = owner_excess(service, owner)
    if full is not None:
        raise Problem(409, full)


def disk_shortage(service: Service) -> str | None:
    """Return what to say where the disk is nearly full."""
    free_gib = shutil.disk_usage(service.paths.root).free / GIB
    if free_gib >= service.settings.free_gib:
        return None
    return (
        f"the disk of the service has {free_gib:.2f} GiB free, and {service.settings.free_gib:g} "
        "have to be left (free_gib); remove unused databases, or ask the operator"
    )


def owner_excess(service: Service, owner: str, more_bytes: int = 0) -> str | None:
    """Return what to say where a user's databases take more of the disk than they may."""
    taken_gib = (owned_bytes(service, owner) + more_bytes) / GIB
    if taken_gib < service.settings.disk_gib:
        return None
    return (
        f"the databases of {owner} take {taken_gib:.2f} GiB, and {service.settings.disk_gib:g} "
        "are allowed (disk_gib); remove unused ones, or ask the operator"
    )


def owned_bytes(service: Service, owner: str) -> int:
    """Return how much of the disk the databases of a user take."""
    with service.records.reading() as connection:
        rows = connection.execute(
            "SELECT DISTINCT json_extract(result, '$.database') FROM jobs "
            "WHERE owner = ? AND kind = 'build' AND state = 'done'",
            (owner,),
        ).fetchall()
    taken = 0
    for [database_id] in rows:
        try:
            files = service.library.database(str(database_id)).manifest["files"]
        except (TargetMissing, ProductError, OSError):
            continue
        taken += sum(int(facts["bytes"]) for facts in files.values())
    return taken


def folder_bytes(folder: Path) -> int:
    """Return how much of the disk a folder takes, with all below it."""
    taken = 0
    for path in folder.rglob("*"):
        try:
            taken += 512 * path.lstat().st_blocks
        except OSError:  # removed meanwhile
            continue
    return taken
