"""A registry on disk for tests that damage it: its files, and a file server that supports ranges.

If a manifest changes, everything that names it changes too, as a skilled attacker would do.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from archive_server import Archive, Remote, sha256
from served import in_background

from starcat.database.manifest import manifest_digest
from starcat.ship.releases.tree import Blob, read_registry_index
from starcat.storage.atomic import json_bytes


def write(path: Path, data: bytes | str) -> None:
    """Write a file of a registry, whose files are read-only."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


class Served(Archive):
    """A folder behind an address: every request reads the file again."""

    def __init__(self, folder: Path, heeds_ranges: bool) -> None:
        super().__init__()
        self.folder, self.heeds_ranges = folder, heeds_ranges
        self.cut_after: dict[str, list[int]] = {}
        self.stall: threading.Event | None = None
        self.remotes = self  # type: ignore[assignment]

    def get(self, path: str) -> Remote | None:
        file, cuts = self.folder / path.lstrip("/"), self.cut_after.get(path)
        if not file.is_file():
            return None
        stall = None if cuts is None else self.stall
        return Remote(file.read_bytes(), self.heeds_ranges, cut_after=cuts or [], stall=stall)

    @property
    def sent(self) -> list[tuple[str, int, int]]:
        """For each answer: the path, the first byte that was sent, and the number of bytes."""
        starts = (re.findall(r"\d+", each.range or "") for each in self.requests)
        return [
            (each.path, int(start[0]) if each.status == 206 else 0, each.sent)
            for each, start in zip(self.requests, starts, strict=True)
            if each.status < 400
        ]


@contextmanager
def serving(folder: Path, *, heeds_ranges: bool = True) -> Iterator[Served]:
    with Served(folder, heeds_ranges) as server, in_background(server):
        yield server


def manifest_of(registry: Path) -> Path:
    """The blob of the first listed release's manifest."""
    return (
        registry / read_registry_index((registry / "index.json").read_bytes(), "")[0].manifest.path
    )


def edit_index(registry: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads((registry / "index.json").read_bytes())
    change(content)
    write(registry / "index.json", json.dumps(content))


def edit_manifest(registry: Path, change: Callable[[dict[str, Any]], object]) -> None:
    manifest = json.loads(manifest_of(registry).read_bytes())
    change(manifest)
    manifest["manifest_sha256"] = manifest_digest(manifest)
    put_manifest(registry, json_bytes(manifest))


def put_manifest(registry: Path, data: bytes, declared_bytes: int | None = None) -> None:
    """Have a registry list another manifest, under its own digest."""
    blob = Blob(sha256=sha256(data), bytes=declared_bytes or len(data))
    write(registry / blob.path, data)
    edit_index(registry, lambda index: index["releases"][0].update(manifest=blob.model_dump()))


def change_byte(path: Path) -> None:
    """Change one bit of the byte in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    write(path, bytes(data))


def replace_by_link(path: Path) -> None:
    """Put a link in place of a file, which moves to the current folder."""
    moved = Path("elsewhere").resolve()
    path.rename(moved)
    path.symlink_to(moved)


def place_of(registry: Path) -> Path:
    """The folder of partial downloads."""
    return Path("out") / f".small-1.0.0.{manifest_of(registry).name[:12]}.partial"


def blob_of(registry: Path, name: str = "pairs.parquet") -> Path:
    manifest = json.loads(manifest_of(registry).read_bytes())
    return registry / Blob(**manifest["files"][name]).path
