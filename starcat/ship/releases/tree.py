"""The tree of a registry: names and contents of its files.

``blobs/sha256/ab/abcd...`` is content by digest, including manifests. A file
``versions/<name>/<version>.json`` is a release, ``index.json`` is the list of all releases. This
module checks all texts from a registry before they become part of a path. It opens no files.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from starcat.database.manifest import MANIFEST_NAME
from starcat.errors import ConfigError, ProductError, SchemaVersionError, SourceMissing
from starcat.failures import validation_message
from starcat.sections import NAME_PATTERN, VERSION_PATTERN, version_numbers
from starcat.storage.atomic import json_bytes

INDEX_NAME = "index.json"
REGISTRY_VERSION = "1.0.0"
LATEST = "latest"
MAX_INDEX_BYTES = MAX_MANIFEST_BYTES = 1 << 26
"""Largest size of an index or manifest: a larger file is refused without reading."""

INCOMING = ".incoming"
"""Folder for unfinished files; it may be removed when no publication is running."""

LOCK = ".lock"
"""Lock of the process that writes the index or signs."""

METADATA = "metadata"
"""Folder with the signed metadata of The Update Framework."""

MAX_METADATA_BYTES = 5_000_000
"""Largest size of a file of metadata: a thousand releases take 140 kB."""

RELEASE_PATH = re.compile(
    rf"versions/(?P<name>{NAME_PATTERN[1:-1]})/(?P<version>{VERSION_PATTERN[1:-1]})\.json", re.ASCII
)
"""Path of the file of a release."""

METADATA_PATH = re.compile(
    rf"{METADATA}/(root|timestamp|[1-9][0-9]{{0,8}}\.(root|targets|snapshot))\.json", re.ASCII
)
"""Path of a file of metadata."""

_STEP = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}"
_FILE_NAME = re.compile(rf"{_STEP}(/{_STEP}){{0,7}}")
_M = TypeVar("_M", bound=BaseModel)

Name = Annotated[str, StringConstraints(pattern=NAME_PATTERN)]
Version = Annotated[str, StringConstraints(pattern=VERSION_PATTERN)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True)


class Blob(_Model):
    """Content by its digest."""

    sha256: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]  # hexadecimal
    bytes: int = Field(ge=0)  # size

    @property
    def path(self) -> str:
        """Path in the tree."""
        return f"blobs/sha256/{self.sha256[:2]}/{self.sha256}"


class Release(_Model):
    """A version of a database."""

    # name, version: of the database
    name: Name
    version: Version
    manifest: Blob  # its file ``manifest.json``, which lists all other files

    @property
    def title(self) -> str:
        """Name of the database's folder."""
        return f"{self.name}-{self.version}"

    @property
    def order(self) -> tuple[str, int, int, int]:
        """Key for sorting by name, then by semantic version: 1.10.0 after 1.9.0."""
        return self.name, *version_numbers(self.version)


class Listed(Release):
    """A release in the list of a registry."""

    # files, bytes: number of files including the manifest, and their total size
    files: int = Field(ge=1)
    bytes: int = Field(ge=0)

    @property
    def path(self) -> str:
        """Path in the tree."""
        return f"versions/{self.name}/{self.version}.json"


_R = TypeVar("_R", bound=Release)


class _Head(_Model):
    format: Literal["starcat-registry"]
    registry_version: str


class _Index(_Head):
    releases: list[Listed]


class _Files(_Model):
    files: dict[str, Blob]


def release_bytes(release: Listed) -> bytes:
    """Return the file of a release."""
    return json_bytes(release.model_dump())


def index_bytes(releases: Iterable[Listed]) -> bytes:
    """Return the content of an index of releases."""
    content = {
        "format": "starcat-registry",
        "registry_version": REGISTRY_VERSION,
        "releases": [r.model_dump() for r in sorted(releases, key=lambda r: r.order)],
    }
    return json_bytes(content)


def read_registry_index(data: bytes, where: str) -> list[Listed]:
    """Read an index."""
    check_version("registry", parse(_Head, data, where).registry_version, REGISTRY_VERSION, where)
    index = parse(_Index, data, where)
    releases = sorted(index.releases, key=lambda release: release.order)
    for earlier, later in pairwise(releases):
        if earlier.order == later.order:
            raise ProductError(f"lists {earlier.title} twice; the registry is damaged", where=where)
    return releases


def check_version(kind: str, version: str, readable: str, where: str) -> None:
    """Refuse a file of another major version, whose layout is unknown."""
    if version.split(".")[0] != readable.split(".")[0]:
        raise SchemaVersionError(
            f"{kind} version {version}; this starcat reads {readable}",
            where=where,
            found=version,
            expected=readable,
            hint="Install a newer starcat",
        )


DAMAGED = "the registry is damaged"


def parse(model: type[_M], data: bytes, where: str, advice: str = DAMAGED) -> _M:
    """Read a JSON file of a registry, or a similar file."""
    with _explained(where, advice):
        return model.model_validate_json(data)


@contextmanager
def _explained(where: str, advice: str = DAMAGED) -> Iterator[None]:
    """Convert errors of pydantic to a message of one line."""
    try:
        yield
    except ValidationError as error:
        key, problem = validation_message(error, show_input=True)
        named = f"{key}: {problem}" if key else problem
        raise ProductError(f"not what starcat writes: {named}", where=where, hint=advice) from error


def tree_files(manifest: Mapping[str, Any], where: str) -> dict[str, Blob]:
    """Return the files that a manifest lists; raise if a path leads out of the database."""
    with _explained(where):
        files = _Files.model_validate({"files": manifest["files"]}).files
    folders = {name[:k] for name in files for k, letter in enumerate(name) if letter == "/"}
    for name in files:
        if not _FILE_NAME.fullmatch(name) or name == MANIFEST_NAME or name in folders:
            raise ProductError(
                f"lists a file {name[:200]!r}, not a plain path within a database; "
                "nothing was written",
                where=where,
            )
    return dict(sorted(files.items()))


def parse_name_version(text: str) -> tuple[str, str | None]:
    """Read ``NAME@VERSION``."""
    name, separator, version = text.partition("@")
    version = version if separator else LATEST
    zeros = Blob(sha256="0" * 64, bytes=0)
    try:
        Release(name=name, version="0.0.0" if version == LATEST else version, manifest=zeros)
    except ValidationError as error:
        raise ConfigError(
            f"{text!r} is not NAME@VERSION, such as gaia-12deg@1.0.0 or gaia-12deg@latest",
            key="name_version",
            value=text,
        ) from error
    return name, None if version == LATEST else version


def choose(releases: Iterable[_R], name: str, version: str | None, where: str) -> _R:
    """Find a release."""
    listed = list(releases)
    named = sorted((r for r in listed if r.name == name), key=lambda r: r.order)
    matching = [r for r in named if version in (None, r.version)]
    if matching:
        return matching[-1]
    if not named:
        there = ", ".join(sorted({r.name for r in listed})[:20]) or "nothing"
        raise SourceMissing(f"{where} has no database {name!r}; it has {there}")
    there = ", ".join(r.version for r in named[-20:])
    raise SourceMissing(f"{where} has no version {version} of {name}; it has {there}")
