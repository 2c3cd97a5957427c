"""What a project does with releases: pull what it asks for and pin it, or what is pinned."""

from __future__ import annotations

from pathlib import Path

from starcat.errors import ConfigError, ProductError
from starcat.progress import Progress, no_progress
from starcat.releases.lockfile import Pin, pin_of, pinned_registry, prepare, read_pins, write_pin
from starcat.releases.pulling import Pulled, pull_release
from starcat.releases.registry import open_registry
from starcat.releases.tree import Release, choose, parse_wanted
from starcat.storage.download import DownloadOptions


def pull_wanted(
    wanted: str,
    registry: str | None,
    output: Path,
    lock: Path,
    options: DownloadOptions | None = None,
    progress: Progress = no_progress,
    max_bytes: int | None = None,
) -> Pulled:
    """Pull what a registry lists, and pin it."""
    name, version = parse_wanted(wanted)
    pin = read_pins(lock).get(name)
    opened = open_registry(registry or _registry_of(lock, name, pin), options)
    release = choose(opened.releases(), name, version, opened.address)
    _check_pin(lock, pin, release, opened.address)
    prepare(lock)
    pulled = pull_release(opened, release, output, progress, max_bytes)
    write_pin(lock, release, opened.address)
    return pulled


def _registry_of(lock: Path, name: str, pin: Pin | None) -> str:
    """Return where an artifact was pulled from before."""
    if pin is None:
        raise ConfigError(
            f"{lock} does not pin {name}, so nothing says where it comes from; name a folder or "
            "an address with --registry",
            key="registry",
        )
    return pinned_registry(lock, pin)


def _check_pin(lock: Path, pin: Pin | None, release: Release, address: str) -> None:
    """Refuse a version that is pinned with another content."""
    if pin and pin.version == release.version and pin.manifest != release.manifest:
        raise ProductError(
            f"{address}: the manifest of {release.title} is "
            f"{release.manifest.sha256[:12]}; {lock} pins {pin.manifest.sha256[:12]}. A published "
            "version never changes: find out who changed it, or remove the entry from the lock "
            "file to accept it",
            path=lock,
        )


def pull_pinned(
    wanted: str | None,
    registry: str | None,
    output: Path,
    lock: Path,
    options: DownloadOptions | None = None,
    progress: Progress = no_progress,
    max_bytes: int | None = None,
) -> list[Pulled]:
    """Pull exactly what a lock file says; no index is read, and the lock file stays."""
    pins = read_pins(lock)
    if not pins:
        raise ConfigError(
            f"{lock}: pins nothing; 'starcat pull NAME@VERSION --registry ...' writes it",
            key="lock",
            value=str(lock),
        )
    chosen = [pins[name] for name in sorted(pins)]
    if wanted is not None:
        chosen = [pin_of(lock, pins, *parse_wanted(wanted))]
    return [
        pull_release(
            open_registry(registry or pinned_registry(lock, pin), options),
            pin,
            output,
            progress,
            max_bytes,
        )
        for pin in chosen
    ]
