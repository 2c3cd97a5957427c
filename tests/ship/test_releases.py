"""Registries: publishing, pulling, pinning, and everything that a registry may get wrong.

Served over HTTP by the standard library's file server as it is, which ignores ranges, and by
one that heeds them.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from database_copies import copied, seal
from folder_bytes import bytes_of
from hypothesis import given
from hypothesis import strategies as st
from registry_files import (
    blob_of,
    change_byte,
    edit_index,
    edit_manifest,
    manifest_of,
    place_of,
    put_manifest,
    serving,
    sha256,
    write,
)

from starcat.database.verify import verify
from starcat.errors import ConfigError, DownloadError, OutputError, ProductError, SourceMissing
from starcat.ship.releases import lockfile, publishing
from starcat.ship.releases.lockfile import pull_pinned, read_pins
from starcat.ship.releases.publishing import publish
from starcat.ship.releases.pulling import Pulled
from starcat.ship.releases.registry import HttpRegistry, open_registry
from starcat.ship.releases.tree import (
    Blob,
    Listed,
    choose,
    index_bytes,
    parse_name_version,
    read_registry_index,
    tree_files,
)
from starcat.storage.atomic import replace_file
from starcat.storage.download import DownloadOptions

QUICK = DownloadOptions(retries=1, timeout_s=5.0, backoff_s=0.0)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def registry(published: Path, here: None) -> Path:
    """A registry with one release; ``registry`` below the current folder."""
    return Path(shutil.copytree(published, "registry"))


def pull(wanted: str, registry: str | Path, output: str = "out") -> Pulled:
    return lockfile.pull(
        wanted, str(registry), Path(output), lock=Path("starcat.lock"), options=QUICK
    )


def pull_locked(
    wanted: str | None = None, registry: str | None = None, output: str = "out",
    lock: Path = Path("starcat.lock"),
) -> list[Pulled]:  # fmt: skip
    return list(pull_pinned(wanted, registry, Path(output), lock))


# Round trips --------------------------------------------------------------------------------


def test_a_folder_gives_back_every_byte(small_database, registry):
    events: list[tuple[str, int, int | None]] = []
    pulled = lockfile.pull(
        "small@1.0.0",
        str(registry),
        Path("out"),
        lock=Path("starcat.lock"),
        progress=lambda *event: events.append(event),
    )
    assert (pulled.outcome, pulled.folder) == ("pulled", Path("out/small-1.0.0"))
    assert bytes_of(pulled.folder) == bytes_of(small_database)
    assert verify(pulled.folder).findings == ()
    for path in pulled.folder.rglob("*"):
        if path.is_file():  # a copy that can only be read
            assert (path.stat().st_nlink, path.stat().st_mode & 0o777) == (1, 0o444)
        else:
            assert path.stat().st_mode & 0o200
    assert {path.name for path in Path("out").iterdir()} == {"small-1.0.0"}
    done = [done for _, done, _ in events]
    assert done == sorted(done)
    assert events[-1] == ("pull small", events[-1][2], events[-1][2])


@pytest.mark.parametrize("heeds_ranges", [True, False])
def test_an_address_gives_back_every_byte(small_database, registry, heeds_ranges):
    with serving(registry, heeds_ranges=heeds_ranges) as server:
        pulled = pull("small@latest", server.url("/"))
        assert bytes_of(pulled.folder) == bytes_of(small_database)
        sent = len(server.sent)
        assert pull("small@latest", server.url("")).outcome == "unchanged"
        assert [path for path, *_ in server.sent[sent:]] == ["/index.json"]
    (pin,) = read_pins(Path("starcat.lock")).values()
    assert pin.registry == server.url("")


def test_blobs_are_named_by_their_content_and_shared(database_version, registry):
    before = bytes_of(registry / "blobs")
    published = publish(database_version("1.0.1"), "registry")
    after = bytes_of(registry / "blobs")
    assert all(Path(name).name == sha256(data) for name, data in after.items())
    assert all(name == f"sha256/{Path(name).name[:2]}/{Path(name).name}" for name in after)
    assert published.release.files > 20
    # The database, the manifest and the page of the report; tables and pictures are shared.
    assert published.new_blobs == len(after) - len(before) == 3
    assert published.new_bytes == sum(len(after[name]) for name in after.keys() - before.keys())


def test_verify_names_a_release_that_the_index_hides(registry, database_version, starcat):
    publish(database_version("1.0.1"), str(registry))
    edit_index(registry, lambda index: index["releases"].pop())
    ran = starcat(["verify", registry])
    assert ran.code == 5
    assert "versions/small/1.0.1.json is in the registry, but small-1.0.1 is not in" in words(ran)


def test_verify_is_never_sound_without_a_release(registry, starcat):
    edit_index(registry, lambda index: index["releases"].clear())
    shutil.rmtree(registry / "versions")
    ran = starcat(["verify", registry])
    assert (ran.code, "lists no release, so nothing can be checked" in ran.out) == (5, True)


def test_verify_checks_the_file_of_a_release_and_every_blob(registry, starcat):
    blob = max(registry.glob("blobs/sha256/*/*"), key=lambda path: path.stat().st_size)
    change_byte(blob)
    ran = starcat(["verify", registry])
    assert (ran.code, "not the content that its name says" in words(ran)) == (5, True)
    change_byte(registry / "versions/small/1.0.0.json")
    ran = starcat(["verify", registry, "--json"])
    assert ran.code == 5
    assert "versions/small/1.0.0.json" in ran.out


def words(ran: Any) -> str:
    return " ".join(ran.out.split())


def test_tables_fit(registry, starcat, database_version):
    for arguments, outcome in (
        (["publish", database_version("1.0.1"), "registry"], "published: small-1.0.1 in registry"),
        (["publish", database_version("1.0.1"), "registry"], "unchanged: small-1.0.1 in registry"),
        (
            ["pull", "small@1.0.0", "--registry", "registry"],
            "pulled: dist/small-1.0.0; this registry has no signatures",
        ),
        (["pull", "--locked"], "unchanged: dist/small-1.0.0"),
        (["releases", "registry"], ""),
    ):
        ran = starcat(arguments)
        assert (ran.code, ran.err.strip()) == (0, outcome)
        assert "small" in ran.out
        assert all(len(line) <= 100 for line in ran.out.splitlines())
    ran = starcat(["publish", database_version("1.0.1"), "registry", "--json"])
    assert json.loads(ran.out)["outcome"] == "unchanged"


# Names and versions -------------------------------------------------------------------------


def listed(version: str, name: str = "small") -> Listed:
    blob = Blob(sha256=sha256(f"{name} {version}".encode()), bytes=1)
    return Listed(name=name, version=version, manifest=blob, files=1, bytes=1)


triples = st.tuples(*[st.integers(0, 10**17)] * 3)


@given(st.lists(triples, min_size=1, max_size=6, unique=True))
def test_latest_is_the_highest_version(versions):
    texts = [".".join(map(str, version)) for version in versions]
    releases = read_registry_index(index_bytes(listed(text) for text in texts), "")
    assert [r.version for r in releases] == [".".join(map(str, v)) for v in sorted(versions)]
    assert choose(releases, "small", None, "").version == ".".join(map(str, max(versions)))


def test_the_order_of_publishing_does_not_show(database_version):
    """The latest is neither the newest nor the last of the alphabet."""
    for folder, versions in (("a", ("1.10.0", "1.9.0")), ("b", ("1.9.0", "1.10.0"))):
        for version in versions:
            publish(database_version(version), folder)
    assert bytes_of(Path("a")) == bytes_of(Path("b"))
    assert pull("small@latest", "a").release.version == "1.10.0"
    assert [r.version for r in open_registry("a").releases()] == ["1.9.0", "1.10.0"]
    with pytest.raises(SourceMissing, match=r"no version 2\.0\.0 of small; it has 1\.9\.0, 1\.10"):
        pull("small@2.0.0", "a")


@pytest.mark.parametrize(
    "text",
    ["", "@1.0.0", "small@", "small@1.0.0-rc1", "Small@1.0.0", "../small@1.0.0", "small@../1",
     "small@1.0.0@latest"],
)  # fmt: skip
def test_what_is_no_name_and_version(text):
    with pytest.raises(ConfigError, match="is not NAME@VERSION"):
        parse_name_version(text)


def test_a_name_alone_means_the_latest_version():
    assert parse_name_version("small@latest") == parse_name_version("small") == ("small", None)


def test_an_address_without_a_registry_and_one_without_a_server():
    with serving(Path("out"), heeds_ranges=False) as server:
        with pytest.raises(SourceMissing, match=r"no registry, .*404"):
            pull("small", server.url(""))
        url = server.url("")
    with pytest.raises(DownloadError, match=r"Connection refused.*\(attempts: 2\)"):
        pull("small", url)
    assert not Path("starcat.lock").exists()


# Immutability -------------------------------------------------------------------------------


def changed(database: Path, folder: Path) -> Path:
    """The same version with other content."""
    made = copied(database, folder)
    with (made / "report" / "index.html").open("ab") as page:
        page.write(b"<!-- more -->")
    seal(made)
    assert verify(made).findings == ()
    return made


def test_the_same_again_is_unchanged(small_database, registry):
    times = {path: path.stat().st_mtime_ns for path in registry.rglob("*") if path.is_file()}
    again = publish(small_database, "registry")
    assert (again.outcome, again.new_blobs, again.new_bytes) == ("unchanged", 0, 0)
    del times[registry / ".lock"]
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())


def test_a_version_whose_name_is_taken_at_the_last_moment(
    small_database, registry, tmp_path, monkeypatch
):
    other = changed(small_database, tmp_path / "other")
    record = registry / "versions/small/1.0.0.json"
    content = record.read_bytes()
    record.unlink()
    link = os.link

    def just_before(source: Path, target: Path) -> None:
        write(record, content)
        link(source, target)

    monkeypatch.setattr(os, "link", just_before)
    with pytest.raises(OutputError, match=r"has small-1.0.0 already, with another content"):
        publish(other, "registry")
    assert record.read_bytes() == content


def test_a_file_system_without_hard_links(small_database, tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    assert publish(small_database, "registry").outcome == "published"
    assert publish(small_database, "registry").outcome == "unchanged"
    with pytest.raises(OutputError, match="already, with another content"):
        publish(changed(small_database, tmp_path / "other"), "registry")
    assert pull("small", "registry").outcome == "pulled"


def test_an_index_written_late_has_what_came_meanwhile(
    small_database, database_version, monkeypatch
):
    """Another publisher, on a file system without locks, comes and goes in the middle."""

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    def late(path: Path, data: bytes, beside: Path) -> None:
        monkeypatch.setattr(publishing, "replace_file", replace_file)
        publish(database_version("1.0.1"), "registry")
        replace_file(path, data, beside)

    monkeypatch.setattr(fcntl, "flock", no_locks)
    monkeypatch.setattr(publishing, "replace_file", late)
    publish(small_database, "registry")
    assert [r.version for r in open_registry("registry").releases()] == ["1.0.0", "1.0.1"]


def test_a_damaged_database_at_the_final_name_stays(registry):
    other = pull("small", registry).folder
    (other / "pairs.parquet").chmod(0o644)
    (other / "pairs.parquet").write_bytes(b"damaged")
    with pytest.raises(OutputError, match=r"is damaged: pairs.parquet .* 7 bytes"):
        pull("small", registry)
    assert (other / "pairs.parquet").read_bytes() == b"damaged"


def test_versions_that_are_not_semantic(database_version):
    with pytest.raises(ProductError, match=r"version '01\.0\.0': cannot be published"):
        publish(database_version("01.0.0"), "registry")
    assert not Path("registry").exists()


def test_links_are_not_published(small_database, tmp_path):
    copy = copied(small_database, tmp_path)
    (copy / "pairs.parquet").unlink()
    (copy / "pairs.parquet").symlink_to(small_database / "pairs.parquet")
    with pytest.raises(ProductError, match=r"pairs.parquet: a symbolic link; expected a file"):
        publish(copy, "registry")


# The lock file ------------------------------------------------------------------------------


def test_the_lock_file_is_sorted_and_the_same_every_time(registry, database_version):
    publish(database_version("1.0.1"), "registry")
    pull("small@1.0.0", registry)
    first = Path("starcat.lock").read_bytes()
    pull("small@1.0.1", registry)
    assert Path("starcat.lock").read_bytes() != first
    pull("small@1.0.0", registry, "elsewhere")
    assert Path("starcat.lock").read_bytes() == first
    content = json.loads(first)
    assert list(content) == sorted(content)
    (entry,) = content["artifacts"]
    manifest = (database_version("1.0.1").parent / "small-1.0.1/manifest.json").read_bytes()
    assert entry["version"] == "1.0.0"
    assert entry["registry"] == "registry"
    assert entry["manifest"]["sha256"] == manifest_of(registry).name != sha256(manifest)


def test_locked_pulls_what_is_pinned_whatever_the_index_says(registry, database_version):
    pull("small@1.0.0", registry)
    publish(database_version("1.0.1"), "registry")
    write(registry / "index.json", "damaged")
    before = Path("starcat.lock").read_bytes()
    lock = Path("starcat.lock")
    for wanted in (None, "small@latest"):
        (pulled,) = pull_locked(wanted, output=f"out-{wanted}")
        assert (pulled.outcome, pulled.release.version) == ("pulled", "1.0.0")
    with pytest.raises(ConfigError, match=r"pins small 1\.0\.0, not 1\.0\.1"):
        pull_locked("small@1.0.1")
    with pytest.raises(ConfigError, match="pins small, not gaia"):
        pull_locked("gaia")
    assert lock.read_bytes() == before


def test_locked_works_from_another_folder_and_another_registry(registry, tmp_path, monkeypatch):
    lock = Path("project/starcat.lock")
    lockfile.pull("small", "registry", Path("out"), lock=lock)
    assert read_pins(lock)["small"].registry == "../registry"
    monkeypatch.chdir(tmp_path / "out")
    lock = Path("../project/starcat.lock")
    assert pull_locked(output="a", lock=lock)[0].outcome == "pulled"
    shutil.move(tmp_path / "registry", tmp_path / "moved")
    with pytest.raises(ProductError, match="missing"):
        pull_locked(output="b", lock=lock)
    assert pull_locked(None, str(tmp_path / "moved"), "b", lock)[0].outcome == "pulled"
    assert lockfile.pull("small", str(tmp_path / "moved"), Path("c"), lock=lock).outcome == "pulled"
    assert read_pins(lock)["small"].registry == str(tmp_path / "moved")


def test_without_a_registry_the_pinned_one_is_asked(registry, database_version):
    lock = Path("starcat.lock")
    with pytest.raises(ConfigError, match=r"starcat.lock does not pin small.*registry"):
        lockfile.pull("small", None, Path("out"), lock=lock)
    pull("small", registry)
    publish(database_version("1.0.1"), "registry")
    assert lockfile.pull("small", None, Path("out"), lock=lock).release.version == "1.0.1"
    assert read_pins(lock)["small"].version == "1.0.1"


def test_a_lock_file_below_a_file(registry):
    Path("file").write_text("")
    with pytest.raises(OutputError, match="choose another file with lock"):
        lockfile.pull("small", "registry", Path("out"), lock=Path("file/starcat.lock"))


# Damaged and hostile registries -------------------------------------------------------------

Damage = Callable[[Path], object]


def add_file(registry: Path, name: str) -> None:
    data = b"outside"
    blob = Blob(sha256=sha256(data), bytes=len(data))
    write(registry / blob.path, data)
    edit_manifest(registry, lambda content: content["files"].update({name: blob.model_dump()}))


def database_of(registry: Path) -> tuple[str, int]:
    """The path of the largest file on a server, and its size."""
    blob = blob_of(registry, "database.h5")
    return f"/{blob.relative_to(registry).as_posix()}", blob.stat().st_size


def of_index(change: Callable[[dict[str, Any]], object]) -> Damage:
    return lambda registry: edit_index(registry, change)


def of_manifest(change: Callable[[dict[str, Any]], object]) -> Damage:
    return lambda registry: edit_manifest(registry, change)


def index_of(text: str) -> Damage:
    return lambda registry: write(registry / "index.json", text)


def first(**values: object) -> Damage:
    return of_index(lambda index: index["releases"][0].update(values))


def pairs(**values: object) -> Damage:
    return of_manifest(lambda manifest: manifest["files"]["pairs.parquet"].update(values))


OTHERS = "not what starcat writes"
DAMAGE: dict[str, tuple[Damage, str]] = {
    "blob missing": (lambda r: blob_of(r).unlink(), "missing|404"),
    "blob with wrong bytes": (lambda r: change_byte(blob_of(r)), "its sha256 begins with"),
    "blob cut off": (lambda r: write(blob_of(r), b"cut"), "3 bytes; expected|has 3 bytes"),
    "blob empty": (lambda r: write(blob_of(r), b""), "0 bytes; expected|has 0 bytes"),
    "manifest missing": (lambda r: manifest_of(r).unlink(), "missing|404"),
    "manifest with wrong bytes": (lambda r: change_byte(manifest_of(r)), "its sha256 begins"),
    "manifest not JSON": (lambda r: put_manifest(r, b"{"), "not a starcat manifest"),
    "manifest of deep lists": (lambda r: put_manifest(r, b"[" * 100_000), "registry is damaged"),
    "manifest without files": (of_manifest(lambda content: content.pop("files")), "no files"),
    "manifest of another name": (
        of_manifest(lambda content: content.update(name="other")), "belongs to other-1.0.0",
    ),
    "manifest of another version": (
        of_manifest(lambda content: content.update(version="2.0.0")), r"belongs to small-2\.0\.0",
    ),
    "manifest with a strange digest": (
        pairs(sha256="../" * 21 + "x"),
        "files.pairs.parquet.sha256: expected 64 hexadecimal digits in lower case",
    ),
    "manifest with a size that is none": (
        pairs(bytes=1e99), "files.pairs.parquet.bytes is '1e\\+99'",
    ),
    "no whole database": (
        of_manifest(lambda content: content["files"].pop("pairs.parquet")),
        "not a whole database: .*pairs.parquet is not among the files",
    ),
    "index not JSON": (index_of("<html>"), OTHERS),
    "index empty": (index_of(""), OTHERS),
    "index of deep lists": (index_of("[" * 100_000), OTHERS),
    "index of something else": (index_of("{}"), "format: missing"),
    "index with a release twice": (
        of_index(lambda index: index["releases"].append(index["releases"][0])),
        "lists small-1.0.0 twice",
    ),
    "index with a name that leads out": (first(name="../../x"), "name: expected 1 to 64"),
    "index with a version that leads out": (first(version="../../../x"), "releases.0.version"),
    "index with a digest that leads out": (
        first(manifest={"sha256": "../../x", "bytes": 1}), "releases.0.manifest.sha256",
    ),
    "index with a wrong size": (
        of_index(lambda index: index["releases"][0]["manifest"].update(bytes=7)), "expected 7",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_registry_is_refused(kind, registry, tmp_path):
    """In a folder nothing is left; behind an address the bytes that can be completed are kept."""
    damage, message = DAMAGE[kind]
    damage(registry)
    before = bytes_of(Path())
    with pytest.raises(ProductError, match=message) as caught:
        pull("small", registry)
    assert caught.value.exit_code == 5
    assert bytes_of(Path()) == before
    with serving(registry) as server, pytest.raises((ProductError, DownloadError)) as caught:
        pull("small", server.url(""))
    assert re.search(message, str(caught.value))
    assert isinstance(caught.value, ProductError) == (
        not re.search(r"missing|cut|empty$|wrong size", kind) or kind == "index empty"
    )
    assert not [*Path("out").glob("small*")]
    assert {path.name for path in tmp_path.iterdir()} <= {"registry", "out"}


@pytest.mark.parametrize(
    "name",
    ["../../x", "/tmp/starcat-x", "report/../../../x", "..", ".", "", "report/", "report//x",
     "./x", ".hidden", "report/.x", "a\\..\\x", "C:x", "x\n", "x\0", "manifest.json",
     "report/index.html/x", "~/x", "-x", "é", "x" * 200, "a/" * 20 + "x"],
)  # fmt: skip
def test_file_names_that_lead_out(registry, name):
    add_file(registry, name)
    before = bytes_of(Path())
    with pytest.raises(ProductError, match="not a plain path within a database; nothing was"):
        pull("small", registry)
    assert bytes_of(Path()) == before
    assert not Path("/tmp/starcat-x").exists()


@given(st.text())
def test_whatever_the_name_it_stays_inside(name):
    facts = {"sha256": "0" * 64, "bytes": 0}
    try:
        (found,) = tree_files({"files": {name: facts}}, "x")
    except ProductError:
        return
    path = Path(os.path.normpath(Path("/inside") / found))
    assert path.is_relative_to("/inside")
    assert path != Path("/inside")


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_a_blob_that_is_not_a_file_is_refused(registry, make):
    blob = blob_of(registry)
    blob.unlink()
    make(blob)
    with pytest.raises(ProductError, match="not a file"):
        pull("small", registry)


def test_links_in_the_output_folder_are_not_followed(small_database, registry, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    place = tmp_path / place_of(registry)
    for planted in (place, place / "artifact", place / "artifact" / "report", place / "parts"):
        planted.parent.mkdir(parents=True, exist_ok=True)
        planted.symlink_to(outside)
        assert bytes_of(pull("small", registry).folder) == bytes_of(small_database)
        assert [*outside.iterdir()] == []
        shutil.rmtree("out")


def test_a_damaged_registry_is_not_built_upon(registry, database_version):
    blob = blob_of(registry)
    change_byte(blob)
    with pytest.raises(ProductError, match="remove that blob and publish again"):
        publish(database_version("1.0.1"), "registry")
    assert [r.version for r in open_registry("registry").releases()] == ["1.0.0"]
    blob.unlink()
    publish(database_version("1.0.1"), "registry")
    assert pull("small@1.0.0", registry).outcome == "pulled"


def test_a_damaged_release_file_is_refused(registry, database_version):
    record = registry / "versions/small/1.0.0.json"
    good = record.read_bytes()
    write(record.with_name("1.0.7.json"), good)
    with pytest.raises(ProductError, match=r"1\.0\.7\.json: holds small-1\.0\.0"):
        publish(database_version("1.0.1"), "registry")
    record.with_name("1.0.7.json").unlink()
    write(record, good[:50])
    with pytest.raises(ProductError, match="not what starcat writes"):
        publish(database_version("1.0.1"), "registry")


def test_a_lost_index_is_made_again(registry, small_database):
    index = (registry / "index.json").read_bytes()
    for damage in (lambda: (registry / "index.json").unlink(), lambda: first(name="x")(registry)):
        damage()
        assert publish(small_database, "registry").outcome == "unchanged"
        assert (registry / "index.json").read_bytes() == index


def test_a_registry_of_a_later_minor_version_is_read(registry):
    edit_index(registry, lambda index: index.update(registry_version="1.7.0", news=1))
    assert pull("small", registry).outcome == "pulled"


# Going on -----------------------------------------------------------------------------------


@pytest.mark.parametrize("heeds_ranges", [True, False])
def test_an_interrupted_download_goes_on(small_database, registry, heeds_ranges):
    path, size = database_of(registry)
    with serving(registry, heeds_ranges=heeds_ranges) as server:
        server.cut_after[path] = [size // 2, 0]
        with pytest.raises(DownloadError, match=r"received \d+ of .* pull again to continue"):
            pull("small", server.url(""))
        before = server.sent
        server.requests.clear()
        assert not Path("out/small-1.0.0").exists()
        assert bytes_of(pull("small", server.url("")).folder) == bytes_of(small_database)
    came = [name for name, *_ in before if name != "/index.json"]
    assert not {name for name, *_ in server.sent} & {*came[: came.index(path)]}
    (rest,) = [(start, sent) for name, start, sent in server.sent if name == path]
    half = size // 2 if heeds_ranges else 0
    assert rest == (half, size - half)
    assert {path.name for path in Path("out").iterdir()} == {"small-1.0.0"}


def test_a_part_is_continued_from_another_address(small_database, registry):
    path, size = database_of(registry)
    with serving(registry) as server, serving(registry) as mirror:
        server.cut_after[path] = [1000, 0]
        with pytest.raises(DownloadError):
            pull("small", server.url(""))
        pulled = pull("small", mirror.url(""))
        assert (path, 1000, size - 1000) in mirror.sent
    assert bytes_of(pulled.folder) == bytes_of(small_database)


@pytest.mark.parametrize("over_http", [True, False])
@pytest.mark.parametrize("length", [1000, None, 1 << 22])
def test_a_wrong_part_is_not_built_upon(small_database, registry, over_http, length):
    blob = blob_of(registry, "database.h5")
    place = place_of(registry)
    length = blob.stat().st_size if length is None else length
    write(place / "parts" / f"{blob.name}.part", b"x" * length)
    write(place / "artifact" / "pairs.parquet", b"x" * blob_of(registry).stat().st_size)
    write(place / "artifact" / "not-listed", b"x")
    with serving(registry) as server:
        pulled = pull("small", server.url("") if over_http else registry)
    assert bytes_of(pulled.folder) == bytes_of(small_database)


def test_a_server_that_sends_more_or_other_than_it_should(registry):
    blob = blob_of(registry)
    size = blob.stat().st_size
    opened = open_registry("http://127.0.0.1:9", QUICK)
    assert isinstance(opened, HttpRegistry)
    with serving(registry) as server:
        write(blob, b"x" * (size + 1))
        with pytest.raises(DownloadError, match=f"has {size + 1} bytes; expected {size}"):
            pull("small", server.url(""))
        write(blob, b"x" * size)
        with pytest.raises(ProductError, match="something on the way changes files"):
            pull("small", server.url(""))
    assert not [*Path("out").iterdir()]


def limited(most: int, call: Callable[[], object]) -> None:
    """Fail to write as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        with pytest.raises(OutputError, match=r"(writing failed|cannot write).*[Tt]oo large"):
            call()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("over_http", [True, False])
def test_a_full_disk_ends_a_pull_which_goes_on_later(small_database, registry, over_http):
    with serving(registry) as server:
        address = server.url("") if over_http else registry
        limited(1_000_000, lambda: pull("small", address))
        assert not Path("out/small-1.0.0").exists()
        assert not Path("starcat.lock").exists()
        assert bytes_of(pull("small", address).folder) == bytes_of(small_database)
    if over_http:
        assert any(start == 1_000_000 for _, start, _ in server.sent)


def test_a_full_disk_ends_a_publication_which_goes_on_later(small_database):
    limited(1_000_000, lambda: publish(small_database, "registry"))
    there = bytes_of(Path("registry"))
    assert "index.json" not in there
    assert not [name for name in there if name.startswith("versions")]
    database = sha256((small_database / "database.h5").read_bytes())
    assert len(there[f".incoming/{database}.part"]) == 1_000_000
    published = publish(small_database, "registry")
    assert 0 < published.new_blobs < published.release.files
    assert pull("small", "registry").outcome == "pulled"
    assert [*Path("registry/.incoming").iterdir()] == []


def link_to_nothing(path: Path) -> None:
    path.symlink_to("nowhere")


@pytest.mark.parametrize(
    ("make", "what"), [(Path.touch, "is a file"), (link_to_nothing, "is a link to nothing")]
)
@pytest.mark.parametrize("below", ["", "below"])
def test_a_registry_is_a_folder_and_that_is_checked_first(make, what, below, tmp_path, monkeypatch):
    def work(_: Path) -> None:
        raise AssertionError

    monkeypatch.setattr(publishing, "check_database", work)
    make(tmp_path / "f.csv")
    with pytest.raises(OutputError, match=f"f.csv {what}; a registry is a folder: publish into"):
        publish(tmp_path, str(tmp_path / "f.csv" / below))


def test_a_registry_that_may_only_be_read(registry):
    for folder in [registry, *registry.rglob("*")]:
        folder.chmod(0o555 if folder.is_dir() else 0o444)
    try:
        assert pull("small", registry).outcome == "pulled"
    finally:
        for folder in [registry, *registry.rglob("*")]:
            folder.chmod(0o755)


def test_output_below_a_file(registry):
    Path("file").write_text("")
    with pytest.raises(OutputError, match="file: writing failed"):
        pull("small", registry, "file")
    with pytest.raises(OutputError, match="file is a file; a registry is a folder"):
        publish(pull("small", registry).folder, "file/registry")
