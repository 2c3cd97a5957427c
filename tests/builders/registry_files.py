"""A registry on disk for tests that damage it: its files, and a file server that supports ranges.

If a manifest changes, everything that names it changes too, as a skilled attacker would do.
"""

from __future__ import annotations

import hashlib
import http.server
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from served import in_background

from starcat.artifact.manifest import manifest_digest
from starcat.releases.tree import Blob, read_registry_index
from starcat.storage.atomic import json_bytes


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def write(path: Path, data: bytes | str) -> None:
    """Write a file of a registry, whose files are read-only."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


@dataclass
class Served(http.server.ThreadingHTTPServer):
    """A folder behind an address, with a record of the bytes sent."""

    folder: Path
    heeds_ranges: bool = True
    cut_after: dict[str, list[int]] = field(default_factory=dict)
    sent: list[tuple[str, int, int]] = field(default_factory=list)
    stall: threading.Event | None = None

    def __post_init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def handle_error(self, *_: object) -> None:
        """Say nothing: clients that go away are part of the tests."""


class Handler(http.server.SimpleHTTPRequestHandler):
    server: Served

    def translate_path(self, path: str) -> str:
        return str(self.server.folder / path.lstrip("/"))

    def do_GET(self) -> None:
        asked = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        self.start = int(asked[1]) if asked and self.server.heeds_ranges else 0
        super().do_GET()

    def send_response(self, code: int, message: str | None = None) -> None:
        super().send_response(206 if self.start and code == 200 else code, message)

    def send_header(self, keyword: str, value: str) -> None:
        if self.start and keyword == "Content-Length":
            total = int(value)
            value = str(total - self.start)
            super().send_header("Content-Range", f"bytes {self.start}-{total - 1}/{total}")
        super().send_header(keyword, value)

    def copyfile(self, source: Any, outputfile: Any) -> None:
        source.seek(self.start)
        body = source.read()
        cuts = self.server.cut_after.get(self.path)
        body = body[: cuts.pop(0)] if cuts else body
        self.server.sent.append((self.path, self.start, len(body)))
        outputfile.write(body)
        if cuts is not None and self.server.stall:
            outputfile.flush()
            self.server.stall.wait(20)

    def log_message(self, *_: object) -> None:
        pass


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
