"""Read a registry: a folder, or the same tree on a static web server."""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from starcat.errors import DownloadError, ProductError, SourceMissing, StarcatError, reason
from starcat.progress import Progress
from starcat.ship.releases.files import copy_to_part, damaged_file, read_small
from starcat.ship.releases.tree import (
    INDEX_NAME,
    MAX_INDEX_BYTES,
    MAX_METADATA_BYTES,
    METADATA,
    Blob,
    Listed,
    read_registry_index,
)
from starcat.storage.atomic import file_sha256, state_folder
from starcat.storage.download import (
    DownloadOptions,
    NotFound,
    download,
    forget_part,
    is_address,
    part_of,
)


@dataclass(frozen=True)
class FolderRegistry:
    """A registry on disk."""

    address: str  # its folder, as given
    copies: ClassVar[bool] = True  # whether `bring` needs space on the disk

    def releases(self) -> list[Listed]:
        """Return the releases in the index, sorted by name, then by version."""
        path = Path(self.address, INDEX_NAME)
        try:
            data = self.read(INDEX_NAME, MAX_INDEX_BYTES)
        except NotFound as error:
            raise SourceMissing(
                f"no registry, {INDEX_NAME} cannot be read ({error})",
                where=self.address,
                path=path,
                hint="'starcat publish' makes one",
            ) from error
        return read_registry_index(data, str(path))

    def read(self, name: str, most_bytes: int) -> bytes:
        """Return the content of a small regular file; raise for links and pipes."""
        path = Path(self.address, name)
        try:
            return read_small(path, most_bytes)
        except OSError as error:
            if error.errno == errno.ELOOP:
                what = "a symbolic link; expected a file. The registry is damaged"
                raise damaged_file(path, what) from error
            raise NotFound(reason(error)) from error

    def bring(self, blob: Blob, path: Path, progress: Progress) -> None:
        """Copy content to the part of a path and check it; continue an earlier copy."""
        try:
            copy_to_part(Path(self.address, blob.path), blob, part_of(path), progress)
        except ProductError as error:
            error.hint = (
                "The registry is damaged: remove that blob if it is there, and publish the "
                "database again"
            )
            raise


@dataclass(frozen=True)
class HttpRegistry:
    """A registry that a web server offers as files."""

    address: str  # address without a slash at the end
    options: DownloadOptions
    copies: ClassVar[bool] = True

    def releases(self) -> list[Listed]:
        """Return the releases in the index."""
        try:
            data = self.read(INDEX_NAME, MAX_INDEX_BYTES)
        except NotFound as error:
            raise SourceMissing(
                f"no registry, {INDEX_NAME}: {error}", where=self.address
            ) from error
        return read_registry_index(data, f"{self.address}/{INDEX_NAME}")

    def read(self, name: str, most_bytes: int) -> bytes:
        """Return the content of a small file."""
        url = f"{self.address}/{name}"
        with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
            path = Path(folder) / "file"
            try:
                download(url, path, replace(self.options, most_bytes=most_bytes))
            except NotFound:
                raise
            except DownloadError as error:
                raise DownloadError(str(error), where=url, hint="Try again later") from error
            return part_of(path).read_bytes()

    def bring(self, blob: Blob, path: Path, progress: Progress) -> None:
        """Download content, or continue an earlier download."""
        url = f"{self.address}/{blob.path}"
        options = replace(self.options, fixed_bytes=blob.bytes, progress=progress)
        arrival = "resumed"
        # If a resumed download is wrong, the earlier part can be the cause: start from zero.
        while arrival == "resumed":
            try:
                arrival = download(url, path, options)
            except NotFound as error:
                raise DownloadError(
                    f"{error}. The registry is damaged, or not yet uploaded as a whole", where=url
                ) from error
            except DownloadError as error:
                raise DownloadError(
                    str(error), where=url, hint="Finished files are kept: pull again to continue"
                ) from error
            digest = file_sha256(part_of(path))
            if digest == blob.sha256:
                return
            forget_part(path)
        raise ProductError(
            f"its sha256 begins with {digest[:12]}; expected {blob.sha256[:12]}. The "
            "registry is damaged, or something on the way changes files",
            where=url,
        )


Registry = FolderRegistry | HttpRegistry


def open_registry(text: str, options: DownloadOptions | None = None) -> Registry:
    """Return the registry of a folder or an address, without reading it."""
    if is_address(text, "registry"):
        return HttpRegistry(text.rstrip("/"), options or DownloadOptions())
    return FolderRegistry(str(Path(text)))


ANCHOR = "trusted.json"
"""File with the trusted root of a registry, in the folders that `remembered` returns."""


def remembered(address: str) -> tuple[Path, ...]:
    """Return the user's folders with the last checked signatures of a registry.

    There is one folder for each name of the registry, first for the name that the user gave.
    Somebody who replaces a folder by a link changes where a name leads, but not the name.
    """
    folder = state_folder() / "trust"
    return tuple(
        folder / hashlib.sha256(os.fsencode(name)).hexdigest()[:32] for name in _names_of(address)
    )


def _names_of(address: str) -> list[str]:
    """Return an address, or the absolute names of a folder: as given, and without links."""
    if is_address(address, "registry"):
        return [address]
    names = [os.path.abspath(address), os.path.realpath(address)]
    # The system knows the current folder without links; the shell knows what the user named.
    shell = os.environ.get("PWD", "")
    with suppress(OSError):
        if os.path.isabs(shell) and os.path.samefile(shell, os.curdir):
            names.insert(0, os.path.abspath(os.path.join(shell, address)))
    return list(dict.fromkeys(names))


def is_registry(text: str) -> bool:
    """Return whether a text is the address or the folder of a registry, without reading it."""
    return is_address(text, "registry") or Path(text, INDEX_NAME).is_file()


def is_trusted(address: str) -> bool:
    """Return whether an earlier pull from a registry used a trusted key."""
    return any((state / ANCHOR).is_file() for state in remembered(address))


def has_signatures(registry: Registry) -> bool:
    """Return whether a registry claims to have signatures; they are not checked."""
    try:
        return bool(registry.read(f"{METADATA}/timestamp.json", MAX_METADATA_BYTES))
    except StarcatError:
        return False
