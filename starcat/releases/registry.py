"""Reading a registry: a folder, or the same tree behind an address of static hosting."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from starcat.errors import DownloadError, ProductError, SourceMissing, reason
from starcat.progress import Progress
from starcat.releases.files import copy_to_part
from starcat.releases.tree import INDEX_NAME, MAX_INDEX_BYTES, Blob, Listed, read_index
from starcat.storage.digests import file_sha256
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

    address: str  # its folder, as it was given

    def releases(self) -> list[Listed]:
        """Return what the index lists, by name, then by version."""
        path = Path(self.address, INDEX_NAME)
        try:
            with path.open("rb") as file:
                data = file.read(MAX_INDEX_BYTES + 1)
        except OSError as error:
            raise SourceMissing(
                f"{self.address}: no registry, {INDEX_NAME} cannot be read ({reason(error)}); "
                "'starcat publish' makes one",
                path=path,
            ) from error
        if len(data) > MAX_INDEX_BYTES:
            raise ProductError(
                f"{path}: longer than {MAX_INDEX_BYTES} bytes; the registry is damaged", path=path
            )
        return read_index(data, str(path))

    def bring(self, blob: Blob, path: Path, progress: Progress) -> None:
        """Copy content, checked, to the part of a path; go on where an earlier copy ended."""
        try:
            copy_to_part(Path(self.address, blob.path), blob, part_of(path), progress)
        except ProductError as error:
            error.args = (
                f"{error}. The registry is damaged: remove that blob if it is there, and "
                "publish the database again",
            )
            raise


@dataclass(frozen=True)
class HttpRegistry:
    """A registry that a web server offers as files."""

    address: str  # without a slash at the end
    options: DownloadOptions

    def releases(self) -> list[Listed]:
        """Return what the index lists."""
        url = f"{self.address}/{INDEX_NAME}"
        with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
            path = Path(folder) / INDEX_NAME
            try:
                download(url, path, replace(self.options, most_bytes=MAX_INDEX_BYTES))
            except NotFound as error:
                raise SourceMissing(
                    f"{self.address}: no registry, {INDEX_NAME}: {error}"
                ) from error
            except DownloadError as error:
                raise DownloadError(f"{url}: {error}. Try again later") from error
            return read_index(part_of(path).read_bytes(), url)

    def bring(self, blob: Blob, path: Path, progress: Progress) -> None:
        """Download content, going on where an earlier download ended."""
        url = f"{self.address}/{blob.path}"
        options = replace(self.options, fixed_bytes=blob.bytes, progress=progress)
        arrival = "resumed"
        # What is wrong in a part of an earlier attempt may be the part.
        while arrival == "resumed":
            try:
                arrival = download(url, path, options)
            except NotFound as error:
                raise DownloadError(
                    f"{url}: {error}. The registry is damaged, or not yet uploaded as a whole"
                ) from error
            except DownloadError as error:
                raise DownloadError(
                    f"{url}: {error}. What has arrived is kept: pull again to go on"
                ) from error
            digest = file_sha256(part_of(path))
            if digest == blob.sha256:
                return
            forget_part(path)
        raise ProductError(
            f"{url}: its sha256 begins with {digest[:12]}; expected {blob.sha256[:12]}. The "
            "registry is damaged, or something on the way changes files"
        )


Registry = FolderRegistry | HttpRegistry


def open_registry(text: str, options: DownloadOptions | None = None) -> Registry:
    """Return the registry at a folder or an address; nothing is read yet."""
    if is_address(text, "registry"):
        return HttpRegistry(text.rstrip("/"), options or DownloadOptions())
    return FolderRegistry(str(Path(text)))
