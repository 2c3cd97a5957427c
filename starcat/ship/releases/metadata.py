"""The signatures of a registry: metadata of The Update Framework (TUF), below ``metadata/``.

There are four roles, each with its keys: ``root`` lists the valid keys, ``targets`` signs the files
of the releases, ``snapshot`` and ``timestamp`` identify the newest state. A file
``<version>.<role>.json`` never changes; ``timestamp.json`` is replaced as a whole, as last step.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from securesystemslib.signer import CryptoSigner
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import Key, Metadata, MetaFile, Root, Snapshot, T, Targets, Timestamp

from starcat.errors import ConfigError, ProductError, reason
from starcat.ship.releases.tree import INCOMING, METADATA
from starcat.storage.atomic import make_folder, replace_file, sync_to_disk, unique
from starcat.storage.keys import raw_public, read_private

ROOT_DAYS, TARGETS_DAYS, TIMESTAMP_DAYS = 3650, 1825, 90
"""Days that a signature is valid. After that a reader notices that newer states are hidden. The
days of a timestamp are the default; each registry can have its own."""

VALID_FIELD, NAME_FIELD = "x-starcat-valid-s", "x-starcat-name"
"""Additional fields: the seconds for which timestamps are signed (signed JSON has no fractions);
in a root, the name of a key."""

_DAY_S = 86400
_NAME = re.compile(r"[\w.@+-]{1,64}", re.ASCII)

ROLES = ("root", "targets", "snapshot", "timestamp")


@dataclass(frozen=True)
class Signing:
    """The keys that sign a registry, and the validity of its newest state."""

    keys: tuple[Ed25519PrivateKey, ...]
    threshold: int | None = None  # signatures needed for root and releases; for a new registry
    days: float | None = None  # default: as the last time
    now: datetime | None = None  # default: current time
    names: Mapping[str, str] = field(default_factory=dict)  # of public keys in hexadecimal

    def until(self, days: float) -> datetime:
        """Return the end of a signature that is valid for some days."""
        now = self.now or datetime.now(UTC)
        return (now + timedelta(days=days)).replace(microsecond=0)

    @property
    def signers(self) -> dict[str, CryptoSigner]:
        """The signers by key id."""
        signers = [CryptoSigner(key) for key in self.keys]
        return {signer.public_key.keyid: signer for signer in signers}


def read_signing(paths: Sequence[Path], threshold: int | None = None) -> Signing | None:
    """Read the keys for publishing; None without keys."""
    if paths:
        return signing_with(paths, threshold)
    if threshold is not None:
        raise ConfigError(
            "it is the number of signatures, and nothing is signed without a key",
            parameter="threshold",
            value=threshold,
            hint="name a key with {sign}",
        )
    return None


def signing_with(
    paths: Sequence[Path], threshold: int | None = None, days: float | None = None
) -> Signing:
    """Read the keys for signing; a key has the name of its file."""
    keys = tuple(read_private(path) for path in paths)
    names = {
        raw_public(key.public_key()).hex(): path.stem for key, path in zip(keys, paths, strict=True)
    }
    return Signing(keys, threshold, days, names=names)


@dataclass
class SignedTree:
    """The metadata of a registry on disk, checked against its root."""

    folder: Path
    root: Metadata[Root]
    targets: Metadata[Targets]
    snapshot: Metadata[Snapshot]
    timestamp: Metadata[Timestamp]
    is_new: bool = False  # True: it has not been written yet

    @property
    def key_ids(self) -> set[str]:
        """Ids of all keys with a role."""
        return {keyid for role in self.root.signed.roles.values() for keyid in role.keyids}

    def missing(self, role: str, keys: Iterable[str]) -> int:
        """Return the number of signatures of a role that are still missing with these keys."""
        needed = self.root.signed.roles[role]
        return max(0, needed.threshold - len(set(needed.keyids) & set(keys)))

    def is_signed(self, role: str) -> bool:
        """Return whether the metadata of a role has the signatures that the root requires."""
        metadata: Metadata[Any] = getattr(self, role)
        result = self.root.signed.get_verification_result(
            role, metadata.signed_bytes, metadata.signatures
        )
        return bool(result)


def is_signed(registry: Path) -> bool:
    """Return whether a registry on disk has metadata."""
    return (registry / METADATA).is_dir()


def new_tree(registry: Path, signing: Signing) -> SignedTree:
    """Return new metadata for a registry without metadata; nothing is written yet.

    Every key has every role.
    """
    root = Root(expires=signing.until(ROOT_DAYS), consistent_snapshot=True)
    for signer in signing.signers.values():
        for role in ROLES:
            root.add_key(signer.public_key, role)
    for role in ("root", "targets"):
        set_threshold(root, role, signing.threshold or 1)
    set_names(root, signing.names)
    return SignedTree(
        registry / METADATA,
        Metadata(root),
        Metadata(Targets(expires=signing.until(TARGETS_DAYS))),
        Metadata(Snapshot(expires=signing.until(TARGETS_DAYS))),
        Metadata(Timestamp(expires=signing.until(signing.days or TIMESTAMP_DAYS))),
        is_new=True,
    )


def set_names(root: Root, names: Mapping[str, str]) -> None:
    """Give the keys of a root their names, by public keys in hexadecimal."""
    for key in root.keys.values():
        name = names.get(key.keyval["public"], "")
        if _NAME.fullmatch(name):
            key.unrecognized_fields[NAME_FIELD] = name


def name_of_key(key: Key) -> str:
    """Return the name of a key in a root; empty if it has none that can be printed."""
    name = key.unrecognized_fields.get(NAME_FIELD)
    return name if isinstance(name, str) and _NAME.fullmatch(name) else ""


def timestamp_days(timestamp: Timestamp, signing: Signing) -> float:
    """Return the days that a timestamp is valid: as in ``signing``, else as in the last one."""
    if signing.days is not None:
        return signing.days
    valid_s = timestamp.unrecognized_fields.get(VALID_FIELD)
    if isinstance(valid_s, int) and 0 < valid_s <= ROOT_DAYS * _DAY_S:
        return valid_s / _DAY_S
    return TIMESTAMP_DAYS


def set_threshold(root: Root, role: str, threshold: int) -> None:
    """Set the number of signatures that a role needs."""
    has = len(root.roles[role].keyids)
    if not 1 <= threshold <= has:
        raise ConfigError(
            f"{threshold} signatures of the role {role}, which has {has} keys: expected 1 to {has}",
            key="threshold",
            value=threshold,
        )
    root.roles[role].threshold = threshold


def load_tree(registry: Path) -> SignedTree:
    """Read the metadata of a registry on disk, and check every signature and digest.

    This is needed before signing: nobody may sign files that an attacker has put there.
    """
    folder = registry / METADATA
    path = folder
    try:
        path, number = folder / "1.root.json", 1
        root = _read(Root, path)
        root.signed.verify_delegate("root", root.signed_bytes, root.signatures)
        while (path := folder / f"{number + 1}.root.json").is_file():
            newer, number = _read(Root, path), number + 1
            for signing_root in (root, newer):
                signing_root.signed.verify_delegate("root", newer.signed_bytes, newer.signatures)
            root = newer
        path = folder / "timestamp.json"
        timestamp = _read(Timestamp, path)
        path = folder / f"{timestamp.signed.snapshot_meta.version}.snapshot.json"
        timestamp.signed.snapshot_meta.verify_length_and_hashes(path.read_bytes())
        snapshot = _read(Snapshot, path)
        meta = snapshot.signed.meta["targets.json"]
        path = folder / f"{meta.version}.targets.json"
        meta.verify_length_and_hashes(path.read_bytes())
        tree = SignedTree(folder, root, _read(Targets, path), snapshot, timestamp)
        for role in ROLES[1:]:
            path, metadata = folder / f"{role}.json", getattr(tree, role)
            root.signed.verify_delegate(role, metadata.signed_bytes, metadata.signatures)
    except (RepositoryError, KeyError) as error:
        raise _not_ours(path, f"{error}") from error
    except OSError as error:
        raise _not_ours(path, f"cannot be read ({reason(error)})") from error
    return tree


def _read(kind: type[T], path: Path) -> Metadata[T]:
    metadata: Metadata[T] = Metadata.from_bytes(path.read_bytes())
    if metadata.signed.type != kind.type:
        raise RepositoryError(f"of the role {metadata.signed.type}")
    return metadata


def _not_ours(path: Path, what: str) -> ProductError:
    return ProductError(
        what,
        where=path,
        hint="A signed file of this registry was changed, and is not signed again: restore it "
        "from a copy, and find out who can write there",
    )


def check_keys(tree: SignedTree, signing: Signing, roles: Sequence[str]) -> None:
    """Refuse keys that are not valid for the roles, or too few."""
    registry, signers = tree.folder.parent, signing.signers
    for keyid, signer in signers.items():
        if keyid not in tree.key_ids:
            raise unknown_key(tree, signer)
    for role in roles:
        if lacking := tree.missing(role, signers):
            needed = tree.root.signed.roles[role].threshold
            raise ConfigError(
                f"signatures of the role {role} that are needed: {needed}, by the keys "
                f"{', '.join(sorted(names_of(tree, role)))}; that are missing: {lacking}",
                where=registry,
                hint="Give {sign} for each key",
            )


def unknown_key(tree: SignedTree, signer: CryptoSigner) -> ConfigError:
    """Return the error for a key without a role."""
    name = signer.public_key.keyval["public"][:16]
    return ConfigError(
        f"the key {name} is not one of the keys that sign {tree.folder.parent}: "
        f"{', '.join(sorted(names_of(tree, 'targets')))}",
        key="sign",
        value=name,
        hint="'starcat keys roles' can add it",
    )


def names_of(tree: SignedTree, role: str) -> list[str]:
    """Return the keys of a role for people: their names, if known, and beginnings."""
    keys = keys_of(tree, role)
    return [f"{name_of_key(key)} {key.keyval['public'][:16]}".strip() for key in keys]


def keys_of(tree: SignedTree, role: str) -> list[Key]:
    """Return the keys of a role."""
    root = tree.root.signed
    return [root.keys[keyid] for keyid in root.roles[role].keyids]


def sign_tree(
    tree: SignedTree, signing: Signing, roles: Sequence[str], before: Metadata[Root] | None = None
) -> None:
    """Sign new versions of roles and write them, the timestamp last.

    ``roles`` are in the order of `ROLES`, and include every role whose file names a file of another
    signed role. A root is also signed with the keys of the previous root (``before``).
    """
    written: dict[str, bytes] = {}
    for role in roles:
        metadata: Metadata[Any] = getattr(tree, role)
        _renew(metadata, role, signing, tree.is_new)
        keys = set(tree.root.signed.roles[role].keyids)
        if role == "root" and before is not None:
            keys |= set(before.signed.roles[role].keyids)
        for keyid, signer in signing.signers.items():
            if keyid in keys:
                metadata.sign(signer, append=True)
        data = metadata.to_bytes()
        version = metadata.signed.version
        written["timestamp.json" if role == "timestamp" else f"{version}.{role}.json"] = data
        if role == "root":
            written["root.json"] = data
        elif role == "targets":
            tree.snapshot.signed.meta["targets.json"] = _meta(version, data)
        elif role == "snapshot":
            tree.timestamp.signed.snapshot_meta = _meta(version, data)
    _write(tree.folder, written)


def _renew(metadata: Metadata[Any], role: str, signing: Signing, is_new: bool) -> None:
    days: float = ROOT_DAYS if role == "root" else TARGETS_DAYS
    if role == "timestamp":
        days = timestamp_days(metadata.signed, signing)
        metadata.signed.unrecognized_fields[VALID_FIELD] = round(days * _DAY_S)
    metadata.signed.version += 0 if is_new else 1
    metadata.signed.expires = signing.until(days)
    metadata.signatures.clear()


def _meta(version: int, data: bytes) -> MetaFile:
    return MetaFile.from_data(version, data, ["sha256"])


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write new files first, then a root, then the files that refer to them.

    A new folder gets its name when it is complete: a part of the metadata cannot be signed again.
    """
    beside = folder.parent / INCOMING
    make_folder(beside)
    target = folder if folder.is_dir() else unique(beside, folder.name)
    make_folder(target)
    order = ("targets", "snapshot", "root", "timestamp")
    for name in sorted(files, key=lambda name: order.index(name.split(".")[-2])):
        replace_file(target / name, files[name], beside)
    if target != folder:
        target.rename(folder)
        sync_to_disk(folder.parent)
