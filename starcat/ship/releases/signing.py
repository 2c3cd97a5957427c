"""Sign a registry on disk: its releases, the roles of keys, and the validity of signatures."""

from __future__ import annotations

import copy
import dataclasses
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from securesystemslib.signer import SSlibKey
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import Metadata, Root, Snapshot, TargetFile, Timestamp

from starcat.errors import ConfigError, ProductError
from starcat.ship.releases.metadata import (
    ROLES,
    TARGETS_DAYS,
    SignedTree,
    Signing,
    check_keys,
    is_signed,
    keys_of,
    load_tree,
    name_of_key,
    new_tree,
    set_names,
    set_threshold,
    sign_tree,
    timestamp_days,
    unknown_key,
)
from starcat.ship.releases.registry import FolderRegistry, Registry, has_signatures, open_registry
from starcat.ship.releases.tree import LOCK, MAX_METADATA_BYTES, METADATA, Listed, release_bytes
from starcat.storage.atomic import locked, writing
from starcat.storage.download import NotFound

PUBLISHING = ROLES[1:]
"""The roles that sign a publication."""


@dataclass(frozen=True)
class RoleFacts:
    """A role of a registry, with its keys."""

    role: str
    keys: tuple[str, ...]  # beginnings of the public keys
    names: tuple[str, ...]  # names of the keys; empty if a name is unknown
    threshold: int  # number of signatures that it needs
    version: int
    until: str  # end of its signatures


def check_can_sign(registry: Path, signing: Signing | None) -> None:
    """Raise an error if a release could not be signed, before anything is written."""
    if not is_signed(registry):
        if signing is not None:
            new_tree(registry, signing)
        return
    if signing is None:
        raise ConfigError(
            "is signed, so pulls with a trusted key would refuse an unsigned release",
            where=registry,
            hint="publish with a key ({sign})",
        )
    tree = load_tree(registry)
    if signing.threshold not in (None, tree.root.signed.roles["targets"].threshold):
        raise ConfigError(
            f"{registry} is signed already",
            parameter="threshold",
            value=signing.threshold,
            hint="'starcat keys roles' changes what it needs",
        )
    check_keys(tree, signing, PUBLISHING)


def sign_release(registry: Path, release: Listed, signing: Signing) -> None:
    """Sign a release of a registry, unless it is signed already."""
    with locked(registry / LOCK):
        tree = load_tree(registry) if is_signed(registry) else new_tree(registry, signing)
        check_keys(tree, signing, PUBLISHING)
        target = TargetFile.from_data(release.path, release_bytes(release), ["sha256"])
        signed = tree.targets.signed.targets
        if signed.get(release.path) != target:
            signed[release.path] = target
            sign_tree(tree, signing, ROLES if tree.is_new else PUBLISHING)


def renew(registry: Path, signing: Signing) -> tuple[RoleFacts, ...]:
    """Extend the validity of a registry's newest state; sign older roles again if needed."""
    with writing(registry, "sign where the registry can be written"), locked(registry / LOCK):
        tree = _signed(registry)
        limit = signing.until(TARGETS_DAYS) - timedelta(days=TARGETS_DAYS / 2)
        old = [role for role in ROLES[1:3] if getattr(tree, role).signed.expires < limit]
        first = old[0] if old else "timestamp"
        roles = ROLES[ROLES.index(first) :]
        check_keys(tree, signing, roles)
        sign_tree(tree, signing, roles)
    return _facts(tree)


def renew_if_old(registry: Path, signing: Signing) -> bool:
    """Renew a registry if more than half of the validity is over; return whether it was renewed."""
    if not is_signed(registry):
        return False
    timestamp = load_tree(registry).timestamp.signed
    is_old = timestamp.expires < signing.until(timestamp_days(timestamp, signing) / 2)
    if is_old:
        renew(registry, signing)
    return is_old


def change_roles(
    registry: Path,
    signing: Signing,
    keys: Mapping[str, Sequence[Ed25519PublicKey]],
    thresholds: Mapping[str, int],
    names: Mapping[str, str] | None = None,
) -> tuple[RoleFacts, ...]:
    """Set the valid keys: make a new root, signed with keys of the new and of the last root.

    ``keys`` and ``thresholds`` are by role, ``root``, ``targets`` or ``timestamp``; a missing role
    keeps its keys. Keys of ``targets`` sign snapshots and timestamps too. ``names`` are by public
    keys in hexadecimal. Timestamps stay valid for as many days as before.
    """
    with writing(registry, "sign where the registry can be written"), locked(registry / LOCK):
        tree = load_tree(registry) if is_signed(registry) else new_tree(registry, signing)
        before = None if tree.is_new else copy.deepcopy(tree.root)
        _set_roles(tree.root.signed, keys, thresholds)
        set_names(tree.root.signed, {**signing.names, **(names or {})})
        last = tree if before is None else dataclasses.replace(tree, root=before)
        for keyid, signer in signing.signers.items():
            if keyid not in tree.key_ids | last.key_ids:
                raise unknown_key(tree, signer)
        check_keys(last, _with_keys_of(last, signing), ["root"])
        unsigned = [role for role in PUBLISHING if not tree.is_signed(role)]
        roles = ROLES[ROLES.index(unsigned[0]) :] if unsigned else ()
        check_keys(tree, _with_keys_of(tree, signing), ["root", *roles])
        sign_tree(tree, signing, ["root", *roles], before)
    return _facts(tree)


def roles_of(registry: str) -> tuple[RoleFacts, ...]:
    """Return the roles of a registry (folder or address), after checking all signatures."""
    return _facts(_checked_tree(registry))


def signed_files(registry: str) -> Mapping[str, TargetFile]:
    """Return the signed files of a registry by their paths; empty if it has no signatures.

    The signatures are checked with the registry's own keys, which may not be trusted.
    """
    opened = open_registry(registry)
    is_folder = isinstance(opened, FolderRegistry)
    if not (is_signed(Path(registry)) if is_folder else has_signatures(opened)):
        return {}
    return _checked_tree(registry).targets.signed.targets


def signatures_of(targets: Mapping[str, TargetFile], listed: Sequence[Listed]) -> list[str]:
    """Return for each release whether it is signed: yes, no, or changed since."""
    states = []
    for release in listed:
        expected = TargetFile.from_data(release.path, release_bytes(release), ["sha256"])
        signed = targets.get(release.path)
        states.append(
            "no"
            if signed is None
            else "yes"
            if signed == expected
            else "changed since it was signed"
        )
    return states


def _checked_tree(registry: str) -> SignedTree:
    opened = open_registry(registry)
    if isinstance(opened, FolderRegistry):
        return _signed(Path(registry))
    with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
        copy = Path(folder)
        _copy_metadata(opened, copy / METADATA)
        try:
            return load_tree(copy)
        except ProductError as error:
            problem = str(error).removeprefix(f"{copy / METADATA}/").split(". ")[0]
            raise ProductError(
                f"its signatures do not agree ({problem})",
                where=registry,
                hint="do not trust it, and ask who publishes it",
            ) from error


MAX_ROOTS = 1000
"""Most roots to read from an address; each change of the roles makes one."""


def _copy_metadata(registry: Registry, folder: Path) -> None:
    """Copy the signed metadata of a web server, so that `load_tree` can check them."""

    def fetch(name: str) -> bytes:
        data = registry.read(f"{METADATA}/{name}", MAX_METADATA_BYTES)
        (folder / name).write_bytes(data)
        return data

    folder.mkdir()
    number = 1
    try:
        fetch("1.root.json")
    except NotFound:
        registry.releases()  # raises a better error if there is no registry
        raise _unsigned(registry.address) from None
    with suppress(NotFound):
        while number < MAX_ROOTS:
            number += 1
            fetch(f"{number}.root.json")
    try:
        timestamp = Metadata[Timestamp].from_bytes(fetch("timestamp.json")).signed
        version = timestamp.snapshot_meta.version
        snapshot = Metadata[Snapshot].from_bytes(fetch(f"{version}.snapshot.json")).signed
        fetch(f"{snapshot.meta['targets.json'].version}.targets.json")
    except (RepositoryError, KeyError) as error:
        raise ProductError(
            f"the signed metadata is damaged ({error})",
            where=registry.address,
            hint="ask who publishes it",
        ) from error


def _unsigned(registry: str) -> ConfigError:
    return ConfigError(
        f"nothing is signed there, as it has no {METADATA}/",
        where=registry,
        key="registry",
        value=registry,
        hint="'starcat publish --sign KEY' signs what it publishes",
    )


def _signed(registry: Path) -> SignedTree:
    if not is_signed(registry):
        raise _unsigned(str(registry))
    return load_tree(registry)


def _facts(tree: SignedTree) -> tuple[RoleFacts, ...]:
    roles = tree.root.signed.roles
    return tuple(
        RoleFacts(
            role,
            tuple(key.keyval["public"][:16] for key in keys_of(tree, role)),
            tuple(name_of_key(key) for key in keys_of(tree, role)),
            roles[role].threshold,
            getattr(tree, role).signed.version,
            f"{getattr(tree, role).signed.expires:%Y-%m-%d}",
        )
        for role in ROLES
    )


def _with_keys_of(tree: SignedTree, signing: Signing) -> Signing:
    """Return only the keys that a root contains: two roots can have different keys."""
    ids = [SSlibKey.from_crypto(key.public_key()).keyid for key in signing.keys]
    keys = [key for key, keyid in zip(signing.keys, ids, strict=True) if keyid in tree.key_ids]
    return dataclasses.replace(signing, keys=tuple(keys))


def _set_roles(
    root: Root, keys: Mapping[str, Sequence[Ed25519PublicKey]], thresholds: Mapping[str, int]
) -> None:
    new_keys = {role: [SSlibKey.from_crypto(key) for key in some] for role, some in keys.items()}
    present_keys = {role: [root.keys[keyid] for keyid in root.roles[role].keyids] for role in ROLES}
    targets = new_keys.get("targets") or present_keys["targets"]
    others = [key for key in present_keys["timestamp"] if key not in present_keys["targets"]]
    keys_by_role = {
        "root": new_keys.get("root") or present_keys["root"],
        "targets": targets,
        "snapshot": targets,
        "timestamp": [*targets, *(new_keys.get("timestamp") or others)],
    }
    for role, role_keys in keys_by_role.items():
        _set_keys(root, role, role_keys)
        if role in ("root", "targets"):
            held_threshold = min(root.roles[role].threshold, len(set(_ids(role_keys))))
            set_threshold(root, role, thresholds.get(role, held_threshold))


def _set_keys(root: Root, role: str, keys: Sequence[Any]) -> None:
    for key in keys:
        root.add_key(root.keys.get(key.keyid, key), role)  # a known key keeps its name
    for keyid in set(root.roles[role].keyids) - set(_ids(keys)):
        root.revoke_key(keyid, role)


def _ids(keys: Iterable[Any]) -> list[str]:
    return [key.keyid for key in keys]
