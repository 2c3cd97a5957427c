"""Pull a release: check every file on arrival, then the whole database, then rename its folder.

Downloaded files are kept in ``.<name>-<version>.<digest>.partial`` next to the final folder until
all are there; if a pull is killed, the next pull continues from it. Files are copied, not linked: a
change of a pulled file must not change the registry's file.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from starcat.database.manifest import MANIFEST_NAME, parse_manifest
from starcat.database.verify import first_of, verify
from starcat.errors import OutputError, ProductError, SchemaError
from starcat.progress import Progress, no_progress
from starcat.results import entry
from starcat.ship.releases.registry import Registry
from starcat.ship.releases.tree import DAMAGED, MAX_MANIFEST_BYTES, Blob, Release, tree_files
from starcat.storage.atomic import file_sha256, locked, move_into_place, writing
from starcat.storage.download import part_of


@dataclass(frozen=True, repr=False)
class Pulled:
    """The result of a pull.

    Attributes
    ----------
    release : Release
        The release.
    registry : str
        The folder or address that it came from.
    folder : Path
        The folder of the database.
    outcome : Literal["pulled", "unchanged"]
        ``unchanged`` if it was complete already.
    signed : str
        Signatures: ``checked`` with trusted keys; ``unchecked`` although the registry has
        signatures; ``unsigned``; or ``pinned`` by its digest, without looking at
        signatures.
    """

    release: Release = field(metadata=entry(is_spread=True))
    registry: str
    folder: Path
    outcome: Literal["pulled", "unchanged"]
    signed: str = "unsigned"
    warnings: tuple[str, ...] = ()  # for the user, on what the registry lists

    def __repr__(self) -> str:
        return f"<Pulled {self.folder} from {self.registry}: {self.outcome}, {self.signed}>"


def pull_release(
    registry: Registry,
    release: Release,
    output: Path,
    progress: Progress = no_progress,
    max_bytes: int | None = None,
) -> Pulled:
    """Pull a release into a folder."""
    final = output / release.title
    if _is_there(final, release) and not _partial_folder(final, release).exists():
        return Pulled(release, registry.address, final, "unchanged")
    with (
        writing(
            output, "finished files are kept: pull again to continue, or into another {output}"
        ),
        _work_folder(final, release) as work,
    ):
        if _is_there(final, release):  # another pull was faster, or was killed after the last step
            return Pulled(release, registry.address, final, "unchanged")
        whole = _assemble(registry, release, work, progress, max_bytes)
        move_into_place(whole, final)
    return Pulled(release, registry.address, final, "pulled")


def check_release(
    registry: Registry, release: Release, folder: Path, progress: Progress = no_progress
) -> None:
    """Check every file of a release, and the database as a whole, in a temporary folder."""
    _assemble(registry, release, folder, progress, None)


def _is_there(final: Path, release: Release) -> bool:
    """Return whether the release is at its final name; refuse if it has other content."""
    if not os.path.lexists(final):
        return False
    manifest = final / MANIFEST_NAME
    if not manifest.is_file() or file_sha256(manifest) != release.manifest.sha256:
        raise OutputError(
            f"{final} already exists and is not {release.title} of the registry",
            path=final,
            hint=("move it away", "choose another {output}"),
        )
    findings = verify(final).findings
    if findings:
        raise OutputError(
            f"{final} already exists and is damaged: {findings[0]}",
            path=final,
            hint="move it away and pull again",
        )
    return True


def _partial_folder(final: Path, release: Release) -> Path:
    return final.with_name(f".{final.name}.{release.manifest.sha256[:12]}.partial")


class _TooLarge(OutputError):  # noqa: N818 - the name reads as the fact
    """A release that exceeds the size limit or the free space of the disk."""


def _files_in(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


@contextmanager
def _work_folder(final: Path, release: Release) -> Iterator[Path]:
    """Yield the folder for downloaded files; keep it if the pull can be continued later."""
    folder = _partial_folder(final, release)
    if folder.is_symlink():
        folder.unlink()
    with locked(folder / "lock"):
        try:
            yield folder
        except (ProductError, SchemaError):
            shutil.rmtree(folder, ignore_errors=True)
            raise
        except _TooLarge:
            if not any(path.name not in ("lock", MANIFEST_NAME) for path in _files_in(folder)):
                shutil.rmtree(folder, ignore_errors=True)
            raise
        shutil.rmtree(folder, ignore_errors=True)


def _assemble(
    registry: Registry, release: Release, work: Path, progress: Progress, max_bytes: int | None
) -> Path:
    whole, stage = work / "artifact", f"pull {release.name}"
    where = f"{registry.address}: {release.title}"
    _remove_links(work)
    if release.manifest.bytes > MAX_MANIFEST_BYTES:
        raise ProductError(
            f"a manifest of {release.manifest.bytes:,} bytes; expected at most "
            f"{MAX_MANIFEST_BYTES:,}",
            where=where,
            hint=DAMAGED,
        )
    _bring(registry, release.manifest, whole / MANIFEST_NAME, work)
    manifest = parse_manifest((whole / MANIFEST_NAME).read_bytes(), where, DAMAGED)
    if (manifest["name"], manifest["version"]) != (release.name, release.version):
        raise ProductError(
            f"its manifest belongs to {manifest['name']}-{manifest['version']}; the "
            "registry is damaged",
            where=where,
        )
    files = tree_files(manifest, where)
    _remove_unlisted(whole, files)
    done, total = 0, sum(blob.bytes for blob in files.values())
    if registry.copies:
        _check_size(where, release.manifest.bytes + total, work, max_bytes)
    for name, blob in files.items():
        _bring(registry, blob, whole / name, work, _from(done, total, stage, progress))
        done += blob.bytes
    progress(stage, done, total)
    findings = verify(whole).findings
    if findings:
        raise ProductError(
            f"not a whole database: {first_of(findings)}",
            where=where,
            hint="Build the database again, and publish that",
        )
    return whole


def _check_size(where: str, total: int, work: Path, max_bytes: int | None) -> None:
    """Refuse a release that exceeds the size limit or the free space of the disk."""
    if max_bytes is not None and total > max_bytes:
        raise _TooLarge(
            f"{where}: {total:,} bytes; {max_bytes:,} are allowed",
            path=work.parent,
            hint="Allow more with {max_bytes} if you trust the registry",
        )
    there = sum(path.stat().st_size for path in _files_in(work))
    free = shutil.disk_usage(work).free
    if total - there > free:
        raise _TooLarge(
            f"{where}: {total - there:,} bytes are missing, and {work.parent} has only "
            f"{free:,} free",
            path=work.parent,
            hint=("make space", "choose another {output}"),
        )


def _from(offset: int, total: int, stage: str, progress: Progress) -> Progress:
    return lambda name, done, of: progress(stage, offset + done, total)


def _remove_links(folder: Path) -> None:
    for path in [*folder.rglob("*")]:
        if path.is_symlink():
            path.unlink()


def _remove_unlisted(folder: Path, files: Mapping[str, Blob]) -> None:
    for path in [*folder.rglob("*")]:
        name = path.relative_to(folder).as_posix()
        if path.is_file() and name not in files and name != MANIFEST_NAME:
            path.unlink()


def _bring(
    registry: Registry, blob: Blob, target: Path, work: Path, progress: Progress = no_progress
) -> None:
    """Get a file, either from an earlier pull or from the registry."""
    if target.is_file() and target.stat().st_size == blob.bytes:
        if file_sha256(target) == blob.sha256:
            return
        target.unlink()
    arriving = work / "parts" / blob.sha256
    for folder in (arriving.parent, target.parent):
        folder.mkdir(parents=True, exist_ok=True)
    registry.bring(blob, arriving, progress)
    part_of(arriving).replace(target)
