"""Registries that answer with nonsense, and systems without some functions of POSIX."""

from __future__ import annotations

import gc
import os
import shutil
import socketserver
import tomllib
from collections import namedtuple
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from programs import printed_by
from registry_files import place_of, put_manifest, replace_by_link
from served import in_background

from starcat.errors import ConfigError, DownloadError, OutputError, ProductError, StarcatError
from starcat.pipeline.specs.reading import spec_from_dict
from starcat.ship.releases import files, lockfile
from starcat.ship.releases.lockfile import pull_pinned
from starcat.ship.releases.publishing import publish
from starcat.ship.releases.registry import FolderRegistry, open_registry
from starcat.ship.releases.tree import MAX_INDEX_BYTES, MAX_MANIFEST_BYTES, Blob, parse_name_version
from starcat.storage.atomic import file_sha256
from starcat.storage.download import DownloadOptions, download, part_of

ONCE = DownloadOptions(retries=0, timeout_s=5.0, backoff_s=0.0)


@contextmanager
def answering(*answers: bytes) -> Iterator[str]:
    """A server that sends these bytes, one answer a connection, the last one again and again."""
    waiting = list(answers)

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            while self.rfile.readline().strip():
                pass
            self.wfile.write(waiting.pop(0) if len(waiting) > 1 else waiting[0])

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True
        allow_reuse_address = True

        def handle_error(self, *_: object) -> None:
            """The client has gone: that is what is tested."""

    with Server(("127.0.0.1", 0), Handler) as server, in_background(server):
        yield f"http://127.0.0.1:{server.server_address[1]}"


def head(status: str = "200 OK", **fields: str) -> bytes:
    lines = [f"HTTP/1.1 {status}", "Connection: close"]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in fields.items()]
    return "\r\n".join([*lines, "", ""]).encode("latin-1")


REDIRECTS = [
    *("http://[::1", "http://[bad]/x", "http://:99999999/", "http://127.0.0.1:notaport/"),
    *("http://" + "a" * 70 + ".example/", "http://a..b/", "http://\xff\xfe/", "//", "http://"),
    *("file:///etc/passwd", "ftp://127.0.0.1/x", "x" * 3000, "http://%", "http:///x"),
    "http://user:pass@[/",
]
ANSWERS: dict[str, bytes] = {
    **{f"redirect to {where[:20]!r}": head("302 Found", Location=where) for where in REDIRECTS},
    "length of 5,000 digits": head(Content_Length="9" * 5000) + b"{}",
    "length of other digits": head(Content_Length="\xb2") + b"{}",
    "length below nothing": head(Content_Length="-1") + b"{}",
    "two lengths": head(Content_Length="2, 3") + b"{}",
    "length that is a word": head(Content_Length="two") + b"{}",
    "no answer": b"",
    "no HTTP": b"SSH-2.0-OpenSSH\r\n\r\n",
    "no status": b"HTTP/1.1\r\n\r\n",
    "status of words": b"HTTP/1.1 fine OK\r\n\r\n{}",
    "status of 5,000 digits": b"HTTP/1.1 " + b"2" * 5000 + b" OK\r\n\r\n{}",
    "reason of 50,000 letters": b"HTTP/1.1 404 " + b"x" * 50_000 + b"\r\n\r\n",
    "endless line": b"HTTP/1.1 200 OK\r\nX: " + b"x" * 200_000 + b"\r\n\r\n{}",
    "1,000 fields": b"HTTP/1.1 200 OK\r\n" + b"A: b\r\n" * 1000 + b"\r\n{}",
    "chunk of no size": head(Transfer_Encoding="chunked") + b"zz\r\n{}\r\n0\r\n\r\n",
    "chunk below nothing": head(Transfer_Encoding="chunked") + b"-5\r\n{}\r\n0\r\n\r\n",
    "chunk of 5,000 digits": head(Transfer_Encoding="chunked") + b"f" * 5000 + b"\r\n{}\r\n",
    "unknown coding": head(Transfer_Encoding="nonsense", Content_Encoding="nonsense") + b"{}",
    "odd cookie": head(Set_Cookie='a="\x01; expires=99999999999999999999') + b"{}",
}


# The libraries leave the sockets of answers that they cannot read to be closed by Python.
leaves_sockets = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@leaves_sockets
def test_nonsense_of_a_server_is_an_error_of_starcat(subtests):
    for name, answer in ANSWERS.items():
        with subtests.test(name):
            with answering(answer) as address, pytest.raises(StarcatError) as caught:
                open_registry(address, ONCE).releases()
            text = str(caught.value)
            assert address in text
            assert len(text) < 1000
    gc.collect()


def test_nonsense_where_a_part_goes_on(tmp_path):
    part_of(tmp_path / "blob").write_bytes(b"12345")
    ranges = ["bytes 5-9/" + "9" * 5000, "bytes ٥-9/10", "bytes 5-9/10/11", "bytes */*", "x"]
    for text in ranges:
        answer = head("206 Partial Content", Content_Range=text.encode().decode("latin-1"))
        with answering(answer + b"67890", head(Content_Length="10") + b"1234567890") as address:
            assert download(address, tmp_path / "blob", DownloadOptions(fixed_bytes=10)) == (
                "downloaded"
            )
        assert part_of(tmp_path / "blob").read_bytes() == b"1234567890"
        part_of(tmp_path / "blob").write_bytes(b"12345")


@pytest.mark.parametrize("fixed", [None, 100])
def test_a_body_without_end_is_not_read_on(fixed, tmp_path):
    endless = head() + b"x" * (1 << 22)
    options = DownloadOptions(retries=0, fixed_bytes=fixed, most_bytes=1 << 20)
    with answering(endless) as address, pytest.raises(DownloadError, match="longer than"):
        download(address, tmp_path / "blob", options)
    # A block more than allowed has come at most, and is not written.
    assert part_of(tmp_path / "blob").stat().st_size <= (fixed or 1 << 20)


ADDRESSES = [
    *("http://[::1", "http://[x]/", "http://host:port/", "http://host:99999999/", "http://"),
    *("https:///x", "https://host/?a=b", "ftp://host/registry", "file:///registry"),
]


@pytest.mark.parametrize("address", ADDRESSES)
def test_addresses_that_are_none(address, small_database):
    for call in (lambda: open_registry(address), lambda: publish(small_database, address)):
        with pytest.raises(ConfigError, match="expected a folder, or an address"):
            call()


# How much ---------------------------------------------------------------------------------------


@pytest.fixture
def registry(published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(published, "registry"))


def pull(registry: Path | str, max_bytes: int | None = None) -> Path:
    lock, output = Path("starcat.lock"), Path("out")
    return lockfile.pull(
        "small", str(registry), output, lock=lock, options=ONCE, max_bytes=max_bytes
    ).folder


def test_what_is_there_already_needs_no_room(registry, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(0, 0, 1000))
    with pytest.raises(OutputError, match="has only 1,000 free;"):
        pull(registry)
    assert not list(Path("out").iterdir())
    place = place_of(registry)
    place.mkdir()
    for blob in registry.glob("blobs/sha256/*/*"):
        (place / "parts").mkdir(exist_ok=True)
        shutil.copyfile(blob, part_of(place / "parts" / blob.name))
    assert pull(registry).name == "small-1.0.0"


def test_the_user_says_how_much(registry):
    with pytest.raises(
        OutputError, match=r"bytes; 1,000 are allowed\. Allow more with max_bytes if you"
    ):
        pull(registry, 1000)
    assert not list(Path("out").rglob("*.parquet"))
    size = sum(path.stat().st_size for path in registry.glob("blobs/sha256/*/*"))
    assert pull(registry, size).is_dir()
    with pytest.raises(OutputError, match="are allowed"):
        pull_pinned(None, None, Path("other"), Path("starcat.lock"), max_bytes=1000)


def test_a_manifest_too_large_to_be_one_is_not_brought(registry):
    put_manifest(registry, b"{}", MAX_MANIFEST_BYTES + 1)
    with pytest.raises(ProductError, match="a manifest of 67,108,865 bytes"):
        pull(registry)


def test_an_index_too_large_to_be_one_is_not_read(registry):
    os.truncate(registry / "index.json", MAX_INDEX_BYTES + 1)
    with pytest.raises(ProductError, match="longer than"):
        FolderRegistry(registry).releases()


# Versions ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "version",
    ["01.2.3", "1.02.3", "1.2.03", "１.2.3", "1.2.3\n", "1.2", "1.2.3.4", "1.2.3-rc1", "٣.0.0",
     "9" * 19 + ".0.0"],
)  # fmt: skip
def test_a_spec_and_a_registry_refuse_the_same_versions(version, small_spec):
    content = tomllib.loads(small_spec) | {"version": version}
    with pytest.raises(ConfigError, match="version"):
        spec_from_dict(content, "spec.toml")
    with pytest.raises(ConfigError, match="is not NAME@VERSION"):
        lockfile.pull(f"small@{version}", "registry", Path("out"), lock=Path("lock"))


@pytest.mark.parametrize("version", ["0.0.0", "1.10.0", "10.20.30", "9" * 18 + ".0.0"])
def test_a_spec_and_a_registry_take_the_same_versions(version, small_spec):
    content = tomllib.loads(small_spec) | {"version": version}
    assert spec_from_dict(content, "spec.toml").version == version
    assert parse_name_version(f"small@{version}") == ("small", version)


# Systems without POSIX --------------------------------------------------------------------------

WITHOUT_POSIX = """
import os, sys
sys.modules["fcntl"] = sys.modules["resource"] = None
for name in ("O_NOFOLLOW", "O_NONBLOCK", "pread", "pwrite"):
    delattr(os, name)
import shutil
shutil._use_fd_functions = False  # as it is there
from pathlib import Path
from starcat.ship.releases.publishing import publish
from starcat.ship.releases import files, lockfile
from starcat.storage import atomic
assert atomic.fcntl is None and not files._WITHOUT_LINKS
print(publish(Path(sys.argv[1]), "registry").outcome)
print(lockfile.pull("small", "registry", Path("out"), lock=Path("starcat.lock")).outcome)
print(lockfile.pull("small", "registry", Path("out"), lock=Path("starcat.lock")).outcome)
"""


@pytest.mark.slow
def test_publish_and_pull_without_what_posix_has(small_database, tmp_path):
    printed = printed_by("-c", WITHOUT_POSIX, small_database, cwd=tmp_path)
    assert printed.split() == ["published", "pulled", "unchanged"]
    assert (tmp_path / "starcat.lock").is_file()


def test_links_are_refused_where_the_system_cannot_refuse_them(registry, monkeypatch):
    monkeypatch.setattr(files, "_WITHOUT_LINKS", 0)
    blob = max(registry.glob("blobs/sha256/*/*"), key=lambda path: path.stat().st_size)
    replace_by_link(blob)
    with pytest.raises(ProductError, match="a symbolic link; expected a file"):
        pull(registry)


def test_a_file_that_grows_is_not_copied_on(tmp_path):
    source, part = tmp_path / "source", tmp_path / "part"
    source.write_bytes(b"x" * 100)
    blob = Blob(sha256=file_sha256(source), bytes=100)

    def grow(stage: str, done: int, total: int | None) -> None:
        with source.open("ab") as file:
            file.write(b"x" * 100)

    files.copy_to_part(source, blob, part, grow)
    assert part.stat().st_size == 100
