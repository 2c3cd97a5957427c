"""``starcat.lock``, the pins of a project: reading, writing, and pulling pinned databases.

It has one entry per database, sorted, without times: the same pins give the same bytes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from starcat.arguments import path_of, text_of_path
from starcat.errors import ConfigError, FileMissing, ProductError
from starcat.progress import Progress, no_progress
from starcat.resources import PathLike
from starcat.ship.releases.pulling import Pulled, pull_release
from starcat.ship.releases.registry import Registry, has_signatures, is_trusted, open_registry
from starcat.ship.releases.tree import Release, check_version, choose, parse, parse_name_version
from starcat.storage.atomic import json_bytes, locked, make_folder, replace_file, writing
from starcat.storage.download import DownloadOptions, is_address
from starcat.storage.regular_files import read_regular_file

LOCK_NAME = "starcat.lock"
LOCK_VERSION = "1.0.0"
MAX_LOCK_BYTES = 16 << 20


class Pin(Release):
    """A database that a lock file pins."""

    registry: str  # its registry: an address, or a folder relative to the lock file's folder


class _Head(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True)

    format: Literal["starcat-lock"]
    lock_version: str


class _Lock(_Head):
    artifacts: list[Pin]


def read_pins(path: Path) -> dict[str, Pin]:
    """Read a lock file."""
    try:
        data = read_regular_file(path, MAX_LOCK_BYTES)
    except FileMissing:
        return {}
    where, advice = str(path), "restore the lock file, or remove it and pull again"
    try:
        head = parse(_Head, data, where, advice)
        check_version("lock", head.lock_version, LOCK_VERSION, where)
        lock = parse(_Lock, data, where, advice)
    except ProductError as error:
        error.path = path
        raise
    return {pin.name: pin for pin in lock.artifacts}


def prepare(path: Path) -> None:
    """Make the folder of a lock file, so that a failure occurs before anything is pulled."""
    with _writing(path):
        make_folder(path.parent)


def _writing(path: Path) -> AbstractContextManager[None]:
    return writing(path, "choose another file with {lock}")


def write_pin(path: Path, release: Release, registry: str) -> None:
    """Pin a release, in place of another version of the same database."""
    address = registry if is_address(registry, "registry") else _seen_from(path.parent, registry)
    pin = Pin(
        name=release.name, version=release.version, manifest=release.manifest, registry=address
    )
    prepare(path)
    with _writing(path), locked(path.parent):
        pins = read_pins(path) | {pin.name: pin}
        data = _lock_bytes(pins)
        if not path.is_file() or path.read_bytes() != data:
            replace_file(path, data, path.parent)


def _lock_bytes(pins: Mapping[str, Pin]) -> bytes:
    content = {
        "format": "starcat-lock",
        "lock_version": LOCK_VERSION,
        "artifacts": [pins[name].model_dump() for name in sorted(pins)],
    }
    return json_bytes(content)


def _seen_from(folder: Path, registry: str) -> str:
    """Return a relative folder as seen from the lock file; keep an absolute folder."""
    if os.path.isabs(registry):
        return registry
    return Path(os.path.relpath(registry, folder)).as_posix()


def pinned_registry(path: Path, pin: Pin) -> str:
    """Return the registry of a pin as seen from the current folder."""
    return pin.registry if is_address(pin.registry, "registry") else str(path.parent / pin.registry)


def pin_of(path: Path, pins: Mapping[str, Pin], name: str, version: str | None) -> Pin:
    """Return the pin of a database."""
    if name not in pins:
        there = ", ".join(sorted(pins)) or "nothing"
        raise ConfigError(
            f"{path} pins {there}, not {name}", hint="pull it once without {locked:True}"
        )
    if version not in (None, pins[name].version):
        raise ConfigError(
            f"{path} pins {name} {pins[name].version}, not {version}",
            hint="leave {locked:True} out to pin another version",
        )
    return pins[name]


def pull(
    name_version: str,
    registry: PathLike | None = None,
    output: PathLike = "dist",
    *,
    trust: PathLike | None = None,
    lock: PathLike | None = None,
    max_bytes: int | None = None,
    options: DownloadOptions | None = None,
    progress: Progress | None = None,
) -> Pulled:
    """Get a published database, check every file of it, and pin it in a lock file.

    Parameters
    ----------
    name_version : str
        ``NAME@VERSION``, ``NAME@latest`` or ``NAME``.
    registry : str or path-like, optional
        A folder, or an http(s) address; by default the registry of its pin.
    output : str or path-like, default "dist"
        Folder in which the folder ``<name>-<version>`` is made.
    trust : str or path-like, optional
        A public key, or a root.json, that must have signed it; later pulls check it again.
    lock : str or path-like, optional
        File that pins the version; by default ``starcat.lock`` in ``output``.
    max_bytes : int, optional
        A database with more bytes is refused.
    options : DownloadOptions, optional
        Retries and limits of the downloads.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Pulled
        ``folder`` is the folder of the database.

    Raises
    ------
    ConfigError, ProductError, SourceError, OutputError
        In the same cases as ``starcat pull``.
    """
    folder = path_of("output", output)
    lock = folder / LOCK_NAME if lock is None else path_of("lock", lock)
    trust = None if trust is None else path_of("trust", trust)
    name, version = parse_name_version(text_of_path("name_version", name_version))
    pin = read_pins(lock).get(name)
    address = None if registry is None else text_of_path("registry", registry)
    opened = open_registry(address or _registry_of(lock, name, pin), options)
    if trust is not None or is_trusted(opened.address):
        from starcat.ship.releases.trust import signed_release

        checked = signed_release(opened, name, version, trust)
        release, signed, warnings = checked.release, "checked", checked.warnings
    else:
        release = choose(opened.releases(), name, version, opened.address)
        signed, warnings = "unchecked" if has_signatures(opened) else "unsigned", ()
    _check_pin(lock, pin, release, opened.address)
    prepare(lock)
    pulled = pull_release(opened, release, folder, progress or no_progress, max_bytes)
    write_pin(lock, release, opened.address)
    return replace(pulled, signed=signed, warnings=warnings)


def _registry_of(lock: Path, name: str, pin: Pin | None) -> str:
    if pin is None:
        raise ConfigError(
            f"{lock} does not pin {name}, so its registry is unknown",
            hint="name a folder or an address with {registry}",
        )
    return pinned_registry(lock, pin)


def _check_pin(lock: Path, pin: Pin | None, release: Release, address: str) -> None:
    """Refuse a version that is pinned with different content."""
    if pin and pin.version == release.version and pin.manifest != release.manifest:
        raise ProductError(
            f"the manifest of {release.title} is {release.manifest.sha256[:12]}; "
            f"{lock} pins {pin.manifest.sha256[:12]}",
            where=address,
            path=lock,
            hint="A published version never changes: find out who changed it, or remove the "
            "entry from the lock file to accept it",
        )


def pull_pinned(
    name_version: str | None,
    registry: str | None,
    output: Path,
    lock: Path,
    options: DownloadOptions | None = None,
    progress: Progress = no_progress,
    max_bytes: int | None = None,
    trust: Path | None = None,
) -> list[Pulled]:
    """Pull exactly the pins of a lock file, without reading an index or changing the lock file.

    Signatures are checked only if ``trust`` is given.
    """
    pins = read_pins(lock)
    if not pins:
        raise ConfigError(
            "pins nothing",
            where=lock,
            key="lock",
            value=str(lock),
            hint="'starcat pull NAME@VERSION --registry ...' writes it",
        )
    selected = [pins[name] for name in sorted(pins)]
    if name_version is not None:
        selected = [pin_of(lock, pins, *parse_name_version(name_version))]
    pulled = []
    for pin in selected:
        opened = open_registry(registry or pinned_registry(lock, pin), options)
        if trust is not None:
            _check_signed(lock, pin, opened, trust)
        result = pull_release(opened, pin, output, progress, max_bytes)
        pulled.append(replace(result, signed="pinned" if trust is None else "checked"))
    return pulled


def _check_signed(lock: Path, pin: Pin, registry: Registry, trust: Path) -> None:
    from starcat.ship.releases.trust import signed_release

    signed = signed_release(registry, pin.name, pin.version, trust, with_index=False)
    _check_pin(lock, pin, signed.release, registry.address)
