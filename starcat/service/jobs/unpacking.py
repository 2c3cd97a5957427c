"""A database that another machine has built: unpacked and checked, member by member."""

from __future__ import annotations

import re
import shutil
import tarfile
from pathlib import Path

from starcat.artifact.verify import check_artifact
from starcat.errors import ProductError
from starcat.service.jobs.job import Job
from starcat.storage.atomic import READ_ONLY

MOST_MEMBERS = 1000

_NAME = re.compile(r"(?!.*\.\.)[A-Za-z0-9_][A-Za-z0-9._-]*(/[A-Za-z0-9_][A-Za-z0-9._-]*){0,4}")


def unpack_database(archive: Path, job: Job, into: Path) -> None:
    """Unpack the database that a job was to make, and check it."""
    into.mkdir()
    try:
        with tarfile.open(archive, "r:") as tar:
            for number, member in enumerate(tar):
                _unpack(tar, member, number, into)
    except (tarfile.TarError, OSError, ValueError) as error:
        raise ProductError(f"the archive cannot be unpacked ({error}); send it again") from error
    spec = job.request["spec"]
    folder = into / f"{spec['name']}-{spec['version']}"
    if not folder.is_dir():
        raise ProductError(f"the archive holds no {folder.name}; send the database of the job")
    artifact = check_artifact(folder)
    if artifact.manifest["spec"] != spec:
        raise ProductError("the database was built by another spec; send that of the job")


def _unpack(tar: tarfile.TarFile, member: tarfile.TarInfo, number: int, into: Path) -> None:
    is_plain = member.isreg() and not member.issparse() and _NAME.fullmatch(member.name)
    if number >= MOST_MEMBERS or not is_plain:
        raise ProductError(
            f"the archive has the member {member.name[:80]!r}, number {number + 1:,}; expected at "
            f"most {MOST_MEMBERS:,} plain files with plain names"
        )
    path = into / member.name
    path.parent.mkdir(parents=True, exist_ok=True)
    source = tar.extractfile(member)
    if source is None:
        raise ProductError(f"the archive has no content for {member.name!r}; send it again")
    with source, path.open("xb") as file:
        shutil.copyfileobj(source, file)
    path.chmod(READ_ONLY)
