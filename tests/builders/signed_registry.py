"""A signed registry to be attacked: its keys, its earlier state, and a forger of its metadata.

Two keys sign roots, and both are needed; two of three sign releases; one only renews. All are made
of their names, so that every run has the same.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from registry_files import write
from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import Metadata, MetaFile

from starcat.ship.releases.metadata import Signing
from starcat.ship.releases.publishing import publish
from starcat.ship.releases.signing import change_roles

CHIEFS, CREW, CLOCK = ("chief", "deputy"), ("anna", "bert", "cleo"), ("clock",)


def key_of(name: str) -> Ed25519PrivateKey:
    return Ed25519PrivateKey.from_private_bytes(hashlib.sha256(name.encode()).digest())


def signing(*names: str, **options: Any) -> Signing:
    return Signing(tuple(key_of(name) for name in names), **options)


def publics(names: Sequence[str]) -> list[Any]:
    return [key_of(name).public_key() for name in names]


def begin(registry: Path, **options: Any) -> None:
    """Give a registry its roles, before anything is published in it."""
    change_roles(
        registry,
        signing(*CHIEFS, *CREW, *CLOCK, **options),
        {"root": publics(CHIEFS), "targets": publics(CREW), "timestamp": publics(CLOCK)},
        {"root": 2, "targets": 2},
    )


def make(folder: Path, database_version: Callable[[str], Path], first: Path) -> tuple[Path, Path]:
    """Make a registry of two releases, and a copy of it from before the second."""
    registry, earlier = folder / "registry", folder / "earlier"
    registry.mkdir()
    begin(registry)
    publish(first, str(registry), sign=signing("anna", "bert"))
    shutil.copytree(registry, earlier)
    publish(database_version("1.0.1"), str(registry), sign=signing("anna", "cleo"))
    return registry, earlier


@dataclass(frozen=True)
class Forger:
    """Somebody who can write into a registry, and has some keys."""

    registry: Path

    def path(self, role: str) -> Path:
        """The newest file of a role."""
        folder = self.registry / "metadata"
        if role == "timestamp":
            return folder / "timestamp.json"
        found = folder.glob(f"[0-9]*.{role}.json")
        return max(found, key=lambda path: int(path.name.split(".")[0]))

    def read(self, role: str) -> Metadata[Any]:
        return Metadata.from_bytes(self.path(role).read_bytes())

    def sign(self, held: Metadata[Any], role: str, names: Sequence[str]) -> bytes:
        """Write metadata with the signatures of some keys and no others."""
        held.signatures.clear()
        for name in names:
            held.sign(CryptoSigner(key_of(name)), append=True)
        data = held.to_bytes()
        name = f"{held.signed.version}.{role}.json" if role != "timestamp" else "timestamp.json"
        write(self.registry / "metadata" / name, data)
        return data

    def change(
        self, role: str, names: Sequence[str], change: Callable[[Any], object]
    ) -> Metadata[Any]:
        """Change the newest metadata of a role, and sign it as its next version."""
        held = self.read(role)
        held.signed.version += 1
        change(held.signed)
        self.sign(held, role, names)
        return held

    def name_upwards(self, role: str, snapshot_keys: Sequence[str] = ("anna",)) -> None:
        """Let snapshot and timestamp name the newest file of a role, signed with their own keys."""
        if role == "targets":
            meta = self._meta(role)
            self.change(
                "snapshot", snapshot_keys, lambda one: one.meta.update({"targets.json": meta})
            )
        meta = self._meta("snapshot")
        self.change("timestamp", CLOCK, lambda one: setattr(one, "snapshot_meta", meta))

    def _meta(self, role: str) -> MetaFile:
        path = self.path(role)
        return MetaFile.from_data(int(path.name.split(".")[0]), path.read_bytes(), ["sha256"])

    def edit_json(self, role: str, change: Callable[[dict[str, Any]], object]) -> None:
        """Change a file of metadata without any key."""
        path = self.path(role)
        content = json.loads(path.read_bytes())
        change(content)
        write(path, json.dumps(content))
