"""Publish a database into a registry on disk.

The order of the steps makes it safe. First the content is written, each blob under its digest,
then the release, a file that never changes, and last the index, made from all releases. If the
process is killed in between, it leaves content that nothing refers to, and the next run continues.
If a release is missing in the index, the next publisher adds it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from starcat.arguments import HasFolder, database_path, paths_of, text_of_path
from starcat.database.manifest import MANIFEST_NAME
from starcat.database.verify import check_database
from starcat.errors import ConfigError, OutputError, ProductError
from starcat.progress import Progress, no_progress
from starcat.resources import PathLike
from starcat.results import entry
from starcat.ship.releases.files import check_blob, copy_to_part, damaged_file
from starcat.ship.releases.tree import (
    INCOMING,
    INDEX_NAME,
    LOCK,
    METADATA,
    Blob,
    Listed,
    index_bytes,
    parse,
    release_bytes,
    tree_files,
)
from starcat.storage.atomic import (
    file_sha256,
    json_bytes,
    locked,
    make_folder,
    replace_file,
    sync_to_disk,
    unique,
    writing,
)
from starcat.storage.download import is_address

if TYPE_CHECKING:  # only needed for signing
    from starcat.ship.releases.metadata import Signing

_PARTS = {INCOMING, LOCK, INDEX_NAME, METADATA, "blobs", "versions"}


@dataclass(frozen=True, repr=False)
class Published:
    """The result of a publication.

    Attributes
    ----------
    release : Listed
        The release.
    registry : Path
        The folder of the registry.
    outcome : Literal["published", "unchanged"]
        ``unchanged`` if it was already there with the same manifest.
    new_blobs, new_bytes : int
        Files, and their bytes, that were new in the registry.
    is_signed : bool
        True if it was signed.
    """

    release: Listed = field(metadata=entry(is_spread=True))
    registry: Path
    outcome: Literal["published", "unchanged"]
    new_blobs: int
    new_bytes: int
    is_signed: bool = False

    def __repr__(self) -> str:
        signed = " and signed" if self.is_signed else ""
        return f"<Published {self.release.title} in {self.registry}: {self.outcome}{signed}>"


def publish(
    database: HasFolder | PathLike,
    registry: PathLike,
    *,
    sign: PathLike | Sequence[PathLike] | Signing = (),
    threshold: int | None = None,
    progress: Progress | None = None,
) -> Published:
    """Check a database and put it into a registry (a folder), where it will never change.

    Parameters
    ----------
    database : Database, str or path-like
        The result of `starcat.open`, or the folder of a database.
    registry : str or path-like
        A folder; made if it does not exist.
    sign : path or sequence of paths, default none
        Files of private keys to sign with, made by ``starcat keys new``; or a `Signing`.
    threshold : int, optional
        Number of signatures required from now on; only for a registry without signatures.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Published
        The release, and whether it is new in the registry.

    Raises
    ------
    ProductError
        If the database is damaged.
        Also if the registry has the version with other content.
    ConfigError
        If the registry is not a folder, or a key is not one of the registry's.
    OutputError
        If the registry cannot be written.
    """
    signing: Signing | None = None
    if sign or threshold is not None:
        from starcat.ship.releases.metadata import Signing, read_signing

        if isinstance(sign, Signing):
            signing = sign
        else:
            signing = read_signing(paths_of("sign", sign), threshold)
    registry = text_of_path("registry", registry)
    if is_address(registry, "registry"):
        raise ConfigError(
            "a registry behind an address can only be read",
            where=registry,
            key="registry",
            value=registry,
            hint="publish into a folder, and upload that folder to the server of the address",
        )
    root = Path(registry)
    _check_root(root)
    if signing is not None or (root / METADATA).is_dir():
        from starcat.ship.releases.signing import check_can_sign

        check_can_sign(root, signing)
    contents, release = _contents(database_path("database", database))
    with writing(root, "finished files are kept: publish again to continue"):
        make_folder(root / INCOMING)
        _check_not_taken(root, release)
        new = _add_all(root, contents, progress or no_progress)
        is_new = _record(root, release)
        _make_index(root)
        if signing is not None:  # last, so that every signed release is in the index
            from starcat.ship.releases.signing import sign_release

            sign_release(root, release, signing)
    return Published(
        release,
        root,
        "published" if is_new else "unchanged",
        len(new),
        sum(blob.bytes for blob in new),
        signing is not None,
    )


def _contents(database: Path) -> tuple[dict[Path, Blob], Listed]:
    manifest = check_database(database).manifest
    files = tree_files(manifest, str(database / MANIFEST_NAME))
    path = database / MANIFEST_NAME
    itself = Blob(sha256=file_sha256(path), bytes=path.stat().st_size)
    contents = {**{database / name: blob for name, blob in files.items()}, path: itself}
    facts = {
        "name": manifest["name"],
        "version": manifest["version"],
        "manifest": itself.model_dump(),
        "files": len(contents),
        "bytes": sum(blob.bytes for blob in contents.values()),
    }
    try:
        return contents, parse(Listed, json_bytes(facts), str(path))
    except ProductError as error:
        raise ProductError(
            f"name {manifest['name']!r}, version {manifest['version']!r}: cannot be "
            "published; expected lower-case letters, digits and hyphens, and a version like "
            "1.10.0 without leading zeros",
            where=path,
            hint="Change the spec and build again",
        ) from error


def _check_root(root: Path) -> None:
    """Refuse what is not a folder, and a folder with other content, before the work begins."""
    for path in (root, *root.parents):
        if os.path.lexists(path) and not path.is_dir():
            what = "a link to nothing" if path.is_symlink() else "a file"
            raise OutputError(
                f"{path} is {what}; a registry is a folder: publish into another", path=root
            )
    with writing(root, "publish into another folder"):
        there = {path.name for path in root.iterdir()} if root.is_dir() else set()
    if there and not there & _PARTS:
        raise OutputError(
            "neither empty nor a registry", where=root, hint="publish into a folder of its own"
        )


def _check_not_taken(root: Path, release: Listed) -> bool:
    """Return whether the release is there; refuse if its content differs."""
    path = root / release.path
    if not path.is_file():
        return False
    there = parse(Listed, path.read_bytes(), str(path))
    if there != release:
        raise OutputError(
            f"has {release.title} already, with another content (manifest "
            f"{there.manifest.sha256[:12]}, here {release.manifest.sha256[:12]})",
            where=root,
            path=path,
            hint="A published version never changes: raise the version in the spec, build, and "
            "publish that",
        )
    return True


def _add_all(root: Path, contents: dict[Path, Blob], progress: Progress) -> set[Blob]:
    """Add all content to the registry, and return the new blobs."""
    total, done, new = sum(blob.bytes for blob in contents.values()), 0, set()
    for path, blob in contents.items():
        progress("publish", done, total)
        if _add_blob(root, path, blob):
            new.add(blob)
        done += blob.bytes
    progress("publish", done, total)
    return new


def _add_blob(root: Path, source: Path, blob: Blob) -> bool:
    """Add content to the registry, and return whether it is new there."""
    final = root / blob.path
    part = root / INCOMING / f"{blob.sha256}.part"
    with locked(part) as is_mine:
        if os.path.lexists(final):
            part.unlink(missing_ok=True)
            check_blob(final, blob)
            return False
        arriving = part if is_mine else unique(part.parent, part.name)
        try:
            copy_to_part(source, blob, arriving)
            make_folder(final.parent)
            arriving.replace(final)
        except OSError as error:
            # A part is normally kept for a later attempt, but not if the disk is full.
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                arriving.unlink(missing_ok=True)
            raise
        # Not earlier: a part must stay writable, so that another process can continue it.
        final.chmod(final.stat().st_mode & 0o555)
        if not is_mine:
            part.unlink(missing_ok=True)
        sync_to_disk(final.parent)
    return True


def _record(root: Path, release: Listed) -> bool:
    """Make the complete file of a release in one step; return False if it exists already."""
    final = root / release.path
    make_folder(final.parent)
    new = unique(root / INCOMING, f"{release.title}.json")
    try:
        new.write_bytes(release_bytes(release))
        sync_to_disk(new)
        new.chmod(new.stat().st_mode & 0o555)
        _give_free_name(root, new, final)
    except FileExistsError:
        return not _check_not_taken(root, release)
    finally:
        new.unlink(missing_ok=True)
    sync_to_disk(final.parent)
    return True


def _give_free_name(root: Path, new: Path, final: Path) -> None:
    """Rename a file without replacing another: a hard link fails if the name is taken."""
    try:
        os.link(new, final)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
        with locked(root / LOCK):  # this file system has no hard links
            if os.path.lexists(final):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from error
            new.rename(final)


def _make_index(root: Path) -> None:
    """Make the index from the existing releases.

    It uses a lock, and looks for new releases again afterwards, as a file system can lack locks.
    The last writer also looks again after writing, so no other publisher's release is lost.
    """
    path = root / INDEX_NAME
    with locked(root / LOCK):
        releases: list[Listed] | None = None
        while releases != (current := recorded(root)):
            releases = current
            data = index_bytes(releases)
            if not path.is_file() or path.read_bytes() != data:
                replace_file(path, data, root / INCOMING)


def recorded(root: Path) -> list[Listed]:
    """Return the releases of a registry from their own files, from which the index is made."""
    releases = []
    for path in root.glob("versions/[!.]*/[!.]*.json"):
        release = parse(Listed, path.read_bytes(), str(path))
        if root / release.path != path:
            raise damaged_file(path, f"holds {release.title}; the registry is damaged")
        releases.append(release)
    return sorted(releases, key=lambda release: release.order)
