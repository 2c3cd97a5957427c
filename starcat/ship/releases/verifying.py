"""Verify a registry: compare its index with its releases, and check each of them like a pull."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from starcat.database.verify import Finding, Verification
from starcat.errors import ProductError, SchemaError, SourceError
from starcat.progress import Progress, no_progress
from starcat.ship.releases.files import check_blob
from starcat.ship.releases.publishing import recorded
from starcat.ship.releases.pulling import check_release
from starcat.ship.releases.registry import FolderRegistry, Registry, is_trusted, open_registry
from starcat.ship.releases.signing import signatures_of, signed_files
from starcat.ship.releases.tree import (
    INDEX_NAME,
    MAX_METADATA_BYTES,
    RELEASE_PATH,
    Blob,
    Listed,
    parse,
)
from starcat.storage.download import NotFound, part_of

_DAMAGES = (ProductError, SchemaError, SourceError)


@dataclass(frozen=True)
class _FilesInPlace(FolderRegistry):
    """A registry on disk whose files are not copied; each is checked once."""

    copies: ClassVar[bool] = False
    checked: set[Blob] = field(default_factory=set)

    def bring(self, blob: Blob, path: Path, progress: Progress) -> None:
        """Check content, and make a link to it at the part of a path."""
        content = Path(self.address, blob.path)
        if blob not in self.checked:
            check_blob(content, blob)
            self.checked.add(blob)
        part_of(path).symlink_to(content.absolute())


def verify_registry(
    text: str, trust: Path | None = None, progress: Progress = no_progress
) -> Verification:
    """Check files, databases and signatures of all releases, in a folder or at an address.

    The index is compared with the signed releases, and with the files of a folder: a release that
    it hides is a finding. ``trust`` is a public key or a root that must have signed the releases;
    it is stored as by a pull. The default is the root that was trusted before. The product of a
    finding is the release that it concerns.
    """
    opened = open_registry(text)
    registry = _FilesInPlace(opened.address) if isinstance(opened, FolderRegistry) else opened
    listed = registry.releases()
    signed = signed_files(text)
    findings = [*_hidden(registry, listed, signed)]
    if not listed and not findings:
        findings.append(Finding(INDEX_NAME, "", "lists no release, so nothing can be checked"))
    for release, state in zip(listed, signatures_of(signed, listed), strict=True):
        if state not in ("yes", "no"):
            findings.append(Finding(INDEX_NAME, release.title, state))
        for check in (_check_record, _check_signed, _check_content):
            try:
                check(registry, release, trust, progress)
            except _DAMAGES as error:
                findings.append(Finding(release.path, release.title, str(error)))
    files = sum(release.files for release in listed)
    return Verification(Path(text), files + len(listed), tuple(findings))


def _hidden(
    registry: Registry, listed: Sequence[Listed], signed: Mapping[str, Any]
) -> Iterator[Finding]:
    """Yield the releases that the index lacks, although they are signed or in the folder."""
    listed_paths = {release.path for release in listed}
    for path in sorted(signed.keys() - listed_paths):
        if match := RELEASE_PATH.fullmatch(path):
            title = f"{match['name']}-{match['version']}"
            yield Finding(INDEX_NAME, title, f"the signed release {title} is not in the index")
    if not isinstance(registry, FolderRegistry):
        return
    try:
        there = recorded(Path(registry.address))
    except ProductError as error:
        yield Finding(INDEX_NAME, "", str(error))
        return
    for release in there:
        if release.path not in listed_paths | signed.keys():
            what = f"{release.path} is in the registry, but {release.title} is not in the index"
            yield Finding(INDEX_NAME, release.title, what)


def _check_content(registry: Registry, release: Listed, _: Path | None, progress: Progress) -> None:
    with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
        check_release(registry, release, Path(folder), progress)


def _check_signed(registry: Registry, release: Listed, trust: Path | None, _: Progress) -> None:
    if trust is not None or is_trusted(registry.address):
        from starcat.ship.releases.trust import signed_release

        signed_release(registry, release.name, release.version, trust)


def _check_record(registry: Registry, release: Listed, _: Path | None, __: Progress) -> None:
    """Check that the file of a release has the content that the index lists."""
    where = f"{registry.address}: {release.path}"
    try:
        data = registry.read(release.path, MAX_METADATA_BYTES)
    except NotFound as error:
        raise ProductError(
            f"cannot be read ({error}); the registry is damaged", where=where
        ) from error
    if parse(Listed, data, where) != release:
        raise ProductError(
            f"not the release that {INDEX_NAME} lists; the registry is damaged", where=where
        )
