"""``starcat.lock``: which version of which artifact a project uses, from where, by digest.

One entry an artifact, sorted, without a clock: the same pins are the same bytes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from starcat.errors import ConfigError, ProductError
from starcat.releases.registry import is_address
from starcat.releases.tree import Release, check_version, parse
from starcat.storage.atomic import make_folder, replace_file, writing
from starcat.storage.digests import json_bytes
from starcat.storage.locks import locked

LOCK_NAME = "starcat.lock"
LOCK_VERSION = "1.0.0"


class Pin(Release):
    """An artifact that a lock file pins.

    Attributes
    ----------
    registry : str
        Where it came from: an address, or a folder relative to the lock file's.
    """

    registry: str


class _Head(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True)

    format: Literal["starcat-lock"]
    lock_version: str


class _Lock(_Head):
    artifacts: list[Pin]


def read_pins(path: Path) -> dict[str, Pin]:
    """Read a lock file."""
    try:
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
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
    """Make the folder of a lock file, before anything is pulled that could not be pinned."""
    with _writing(path):
        make_folder(path.parent)


def _writing(path: Path) -> AbstractContextManager[None]:
    return writing(path, "choose another file with --lock")


def write_pin(path: Path, release: Release, registry: str) -> None:
    """Pin a release, in place of another version of the same artifact."""
    given = registry if is_address(registry) else _seen_from(path.parent, registry)
    pin = Pin(name=release.name, version=release.version, manifest=release.manifest, registry=given)
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
    """Return a relative folder as seen from the lock file; an absolute one stays."""
    if os.path.isabs(registry):
        return registry
    return Path(os.path.relpath(registry, folder)).as_posix()


def pinned_registry(path: Path, pin: Pin) -> str:
    """Return the registry of a pin as seen from here."""
    return pin.registry if is_address(pin.registry) else str(path.parent / pin.registry)


def pin_of(path: Path, pins: Mapping[str, Pin], name: str, version: str | None) -> Pin:
    """Return the pin of an artifact."""
    if name not in pins:
        there = ", ".join(sorted(pins)) or "nothing"
        raise ConfigError(
            f"{path} pins {there}, not {name}; pull it once without --locked",
            key="locked",
            value=name,
        )
    if version not in (None, pins[name].version):
        raise ConfigError(
            f"{path} pins {name} {pins[name].version}, not {version}; leave --locked out to pin "
            "another version",
            key="locked",
            value=version,
        )
    return pins[name]
