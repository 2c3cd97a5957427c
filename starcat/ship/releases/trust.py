"""Check the signatures of a release, by the workflow of The Update Framework.

The last state of a registry is stored in the user's state folder, so that an attacker cannot
present an older state later. Every refusal states the finding, its place, and what to do.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from securesystemslib.signer import SSlibKey
from tuf.api import exceptions
from tuf.api.metadata import Metadata, Root, Targets
from tuf.api.serialization import DeserializationError
from tuf.ngclient import Updater, UpdaterConfig
from tuf.ngclient.fetcher import FetcherInterface

from starcat.errors import ConfigError, FileMissing, ProductError, StarcatError
from starcat.ship.releases.registry import ANCHOR, Registry, remembered
from starcat.ship.releases.tree import (
    INDEX_NAME,
    MAX_METADATA_BYTES,
    METADATA,
    RELEASE_PATH,
    Blob,
    Listed,
    Release,
    choose,
    parse,
)
from starcat.storage.atomic import locked, make_folder, replace_file, writing
from starcat.storage.download import NotFound
from starcat.storage.keys import is_public_key, raw_public, read_public, short_name
from starcat.storage.regular_files import read_regular_file

_NOT_USED = "nothing of it is used"
_SIGNED_BY = re.compile(r"was signed by (\d+)/(\d+) keys")
_CONFIG = UpdaterConfig(prefix_targets_with_hash=False, targets_max_length=MAX_METADATA_BYTES)


@dataclass(frozen=True)
class SignedRelease:
    """A release with the signatures of trusted keys."""

    release: Listed
    warnings: tuple[str, ...] = ()  # for the user


def signed_release(
    registry: Registry,
    name: str,
    version: str | None,
    trust: Path | None = None,
    *,
    with_index: bool = True,
) -> SignedRelease:
    """Return a release that the trusted keys of a registry have signed.

    ``trust`` is a public key or a root; the default is the root that was trusted before. The
    signatures must agree with the state that is stored for each name of the registry.
    """
    states = remembered(registry.address)
    with writing(states[0].parent, "make it writable"), ExitStack() as locks:
        for state in sorted(states):
            make_folder(state)
            locks.enter_context(locked(state))
        last_roots = [_content(state / ANCHOR) for state in states]
        # A name that is new to the user has the trust of the registry's other name.
        other = next(filter(None, last_roots), None)
        anchors = [_anchor(registry, last or other, trust) for last in last_roots]
        updated = [_updated(registry, *each) for each in zip(states, anchors, strict=True)]
        for state, last, anchor in zip(states, last_roots, anchors, strict=True):
            if last != anchor:
                replace_file(state / ANCHOR, anchor, state)
    targets = updated[0]
    selected = _choose(targets, name, version, registry.address)
    path = f"versions/{selected.name}/{selected.version}.json"
    data = _read_target(registry, targets, path)
    release = parse(Listed, data, f"{registry.address}: {path}")
    if release.path != path:
        raise _refused(registry, path, f"is of {release.title}")
    warnings = _check_index(registry, release, version) if with_index else ()
    return SignedRelease(release, warnings)


def _content(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _anchor(registry: Registry, last_root: bytes | None, trust: Path | None) -> bytes:
    """Return the root to start with: the given root, a root signed by a given key, or the last."""
    if trust is None and last_root is not None:
        return last_root
    if trust is None or not trust.is_file():
        raise FileMissing(
            "no such file",
            where=trust,
            hint="{trust:FILE} takes a public key, NAME.pub, or the root.json of the registry, "
            "from somebody you trust",
        )
    if not is_public_key(trust):
        data = read_regular_file(trust, MAX_METADATA_BYTES)
        _check_root(data, trust)
        return data
    key = SSlibKey.from_crypto(read_public(trust))
    if last_root is not None and _is_by(last_root, key):
        return last_root
    for path in (f"{METADATA}/root.json", f"{METADATA}/1.root.json"):
        try:
            data = registry.read(path, _CONFIG.root_max_length)
        except NotFound as error:
            raise _unsigned(registry, path) from error
        if _is_by(data, key):
            return data
    name = short_name(raw_public(read_public(trust)))
    raise _refused(registry, path, f"is not a root that the key {name} ({trust}) has signed")


def _check_root(data: bytes, trust: Path) -> None:
    try:
        root = Metadata[Root].from_bytes(data)
        if root.signed.type != Root.type:
            raise DeserializationError(f"it is of the role {root.signed.type}")
        root.signed.verify_delegate(Root.type, root.signed_bytes, root.signatures)
    except exceptions.RepositoryError as error:
        raise ConfigError(
            f"neither a public key nor a root that its keys have signed ({error})",
            where=trust,
            hint="{trust:FILE} takes NAME.pub, or metadata/root.json of the registry, from "
            "somebody you trust",
        ) from error


def _is_by(data: bytes, key: SSlibKey) -> bool:
    """Return whether a root lists a key and is signed by it."""
    try:
        root = Metadata[Root].from_bytes(data)
        if root.signed.type != Root.type or key.keyid not in root.signed.roles["root"].keyids:
            return False
        return (
            key.keyid
            in root.signed.get_verification_result(
                "root", root.signed_bytes, root.signatures
            ).signed
        )
    except exceptions.RepositoryError:
        return False


@dataclass
class _Fetcher(FetcherInterface):
    """Reads metadata from a registry, and keeps the name of the last file for messages."""

    registry: Registry
    last: str = ""
    came: dict[str, bytes] = field(default_factory=dict)

    def _fetch(self, url: str) -> Iterator[bytes]:
        self.last = url
        try:
            data = self.registry.read(url, MAX_METADATA_BYTES)
        except NotFound as error:
            raise exceptions.DownloadHTTPError(str(error), 404) from error
        self.came[url] = data
        return iter([data])


def _updated(registry: Registry, state: Path, anchor: bytes) -> Targets:
    fetcher = _Fetcher(registry)
    with _explained(registry, fetcher):
        updater = Updater(
            str(state), f"{METADATA}/", fetcher=fetcher, config=_CONFIG, bootstrap=anchor
        )
        updater.refresh()
    return Metadata[Targets].from_bytes((state / "targets.json").read_bytes()).signed


@contextmanager
def _explained(registry: Registry, fetcher: _Fetcher) -> Iterator[None]:
    """Convert refusals of the library to errors of starcat."""
    try:
        yield
    except exceptions.DownloadHTTPError as error:
        raise _unsigned(registry, fetcher.last) from error
    except exceptions.DownloadLengthMismatchError as error:
        raise _refused(registry, fetcher.last, "is longer than any such file") from error
    except exceptions.DownloadError as error:
        if isinstance(error.__cause__, StarcatError):
            raise error.__cause__ from error
        raise _refused(registry, fetcher.last, f"cannot be read ({error})") from error
    except exceptions.ExpiredMetadataError as error:
        raise _expired(registry, fetcher, str(error)) from error
    except exceptions.RepositoryError as error:
        raise _refused(registry, fetcher.last, _what(error)) from error


def _what(error: exceptions.RepositoryError) -> str:
    if isinstance(error, exceptions.UnsignedMetadataError):
        counted = _SIGNED_BY.search(str(error))
        many = f"{counted[1]} of the {counted[2]}" if counted else "too few of the"
        return f"is signed by {many} trusted keys that it needs"
    if isinstance(error, exceptions.LengthOrHashMismatchError):
        return "is not the file that was signed: changed, or of another state of the registry"
    if isinstance(error, exceptions.BadVersionNumberError):
        if ">=" in str(error) or "Expected targets.json" in str(error):
            return f"is older than the last known state of this registry ({error})"
        return f"has another version than it was signed for ({error})"
    if isinstance(error, DeserializationError):
        return "is not metadata of a registry"
    return f"is not as it was signed ({error})"


def _refused(registry: Registry, path: str, what: str) -> ProductError:
    return ProductError(
        f"{path} {what}; {_NOT_USED}",
        where=registry.address,
        hint="Ask the publisher by mail or phone, not through this registry",
    )


def _unsigned(registry: Registry, path: str) -> ProductError:
    return ProductError(
        f"{path} is missing, so the registry is not signed; {_NOT_USED}",
        where=registry.address,
        hint="Ask its publisher to sign with 'starcat publish --sign KEY'",
    )


def _expired(registry: Registry, fetcher: _Fetcher, text: str) -> ProductError:
    """Return the error with the name of the expired file and its date."""
    role = next((word for word in ("timestamp", "snapshot", "targets") if word in text), "root")
    named = [name for name in fetcher.came if name.endswith(f"{role}.json")]
    until = ""
    if named:
        content = json.loads(fetcher.came[named[-1]])
        until = f" on {str(content['signed']['expires'])[:10]}"
    return ProductError(
        f"the signatures of {METADATA}/{role}.json have ended{until}: newer "
        f"ones are hidden from you, or were never made; {_NOT_USED}. The publisher can run "
        f"'starcat keys {'roles' if role == 'root' else 'renew'} REGISTRY --sign KEY'",
        where=registry.address,
    )


def _choose(targets: Targets, name: str, version: str | None, address: str) -> Release:
    """Choose among the signed releases by their paths."""
    zeros = Blob(sha256="0" * 64, bytes=0)
    matches = [RELEASE_PATH.fullmatch(path) for path in targets.targets]
    signed = [Release(name=m["name"], version=m["version"], manifest=zeros) for m in matches if m]
    return choose(signed, name, version, f"{address}, among signed releases,")


def _read_target(registry: Registry, targets: Targets, path: str) -> bytes:
    target = targets.targets[path]
    try:
        data = registry.read(path, target.length)
        target.verify_length_and_hashes(data)
    except (NotFound, ProductError, exceptions.LengthOrHashMismatchError) as error:
        if isinstance(error, exceptions.LengthOrHashMismatchError):
            raise _refused(registry, path, "is not the file that was signed") from error
        raise _refused(registry, path, f"is not the file that was signed ({error})") from error
    return data


def _check_index(registry: Registry, release: Listed, version: str | None) -> tuple[str, ...]:
    """Refuse an index that contradicts the signed release; warn if it lists newer releases.

    While a release is published, and if that is interrupted, the index is newer than the
    signatures. An index that lacks a signed release hides it.
    """
    listed = [entry for entry in registry.releases() if entry.name == release.name]
    if release not in listed:
        same = [entry for entry in listed if entry.version == release.version]
        there = (same or (listed if version is None else []))[-1:]
        what = f"lists {there[0].title} with another content" if same else "does not list it"
        if there and not same:
            what = f"lists {there[0].title} as the latest"
        raise _refused(registry, INDEX_NAME, f"{what}; signed is {release.title}")
    newer = [entry.title for entry in listed if entry.order > release.order]
    if version is not None or not newer:
        return ()
    are = "is" if len(newer) == 1 else "are"
    return (
        f"{registry.address}: {INDEX_NAME} lists {', '.join(newer)}, which {are} not signed; "
        f"{release.title} is the latest signed release. If this stays so, ask the publisher to "
        "publish again with 'starcat publish --sign KEY'",
    )
