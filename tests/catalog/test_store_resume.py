"""Interrupted runs: finished parts are kept, checked and continued, to the same bytes."""

from __future__ import annotations

import gzip
import shutil
import subprocess
from pathlib import Path

import pytest
from folder_bytes import bytes_of
from twomass_parts import write_part

from starcat.catalog.store import finish as splitting
from starcat.catalog.store.ingest import ingest_to_store
from starcat.catalog.store.plan import StoreOptions
from starcat.catalog.store.runs import ResumePlan
from starcat.errors import BuildError, ConfigError, OutputError, ParseError, SourceError

ROWS = 4_000
SMALL = {"max_partition_rows": 3_000}


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    return [write_part(folder, part, ROWS, 1 + part * ROWS) for part in (0, 40, 91)]


@pytest.fixture(scope="module")
def whole(parts, tmp_path_factory):
    """A store that was made without disturbance."""
    folder = tmp_path_factory.mktemp("whole") / "store"
    ingest_to_store("2mass", parts, folder, options=StoreOptions(**SMALL))
    return bytes_of(folder)


def make(parts, folder: Path, **options):
    return ingest_to_store("2mass", parts, folder, options=StoreOptions(**{**SMALL, **options}))


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"workers": 1, "memory_bytes": 1 << 30}, {"workers": 3}])
def test_any_workers_and_memory_write_the_same_bytes(options, parts, whole, tmp_path):
    made = make(parts, tmp_path / "store", **options)
    assert bytes_of(tmp_path / "store") == whole
    assert made.outcome == "written"
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


@pytest.mark.parametrize(
    ("damage", "kind", "words"),
    [
        (lambda content: content[: len(content) // 2] + bytes([content[len(content) // 2] ^ 0xFF])
         + content[len(content) // 2 + 1 :], SourceError, ""),
        pytest.param(lambda content: content[: len(content) // 2], ParseError, ".*cut off",
                     marks=pytest.mark.slow),
    ],
    ids=["a byte", "cut off"],
)  # fmt: skip
def test_a_damaged_part_is_named_and_read_again_when_it_is_repaired(
    parts, whole, tmp_path, damage, kind, words
):
    copies = [Path(shutil.copy(part, tmp_path)) for part in parts]
    copies[1].write_bytes(damage(copies[1].read_bytes()))
    store = tmp_path / "store"
    with pytest.raises(kind, match=copies[1].name + words):
        make(copies, store, workers=1)
    assert not store.exists()
    work = ResumePlan.of(store)
    assert work.done("file-00000") is not None
    assert work.done("file-00001") is None
    shutil.copy(parts[1], copies[1])
    make(copies, store, resume=True)
    assert bytes_of(store) == whole


@pytest.mark.slow
def test_what_is_done_is_not_done_again_and_what_was_changed_is(
    parts, whole, tmp_path, monkeypatch
):
    copies = [Path(shutil.copy(part, tmp_path)) for part in parts]
    copies[1].write_bytes(bytes(copies[1].stat().st_size))
    store = tmp_path / "store"
    with pytest.raises(SourceError):
        make(copies, store, workers=1)
    shutil.copy(parts[1], copies[1])
    opened = []
    reading = splitting.read_files

    def spy(files, *rest):
        opened.extend(file.path.name for file in files)
        return reading(files, *rest)

    monkeypatch.setattr(splitting, "read_files", spy)
    assert ResumePlan.of(store).done("file-00000") is not None
    next((ResumePlan.of(store) / "runs").glob("file-00000*.arrow")).write_bytes(b"no longer")
    make(copies, store, resume=True)
    assert set(opened) >= {path.name for path in copies[:2]}
    assert bytes_of(store) == whole
    opened.clear()
    work = ResumePlan.of(tmp_path / "again")
    with monkeypatch.context() as patch:
        patch.setattr("starcat.catalog.store.ingest.make_manifest", _fail)
        with pytest.raises(BuildError):
            make(copies, tmp_path / "again")
    assert work.folder.exists()
    assert len(opened) == 3
    make(copies, tmp_path / "again", resume=True)
    assert len(opened) == 3
    assert bytes_of(tmp_path / "again").keys() == {
        name.replace("store", "again") for name in whole if name != "store.json"
    } | {"store.json"}


def _fail(*_):
    raise BuildError("stopped by the test")


@pytest.mark.slow
def test_an_input_that_has_changed_since_is_read_again(parts, whole, tmp_path, monkeypatch):
    copies = [Path(shutil.copy(part, tmp_path)) for part in parts]
    lines = gzip.decompress(copies[0].read_bytes()).splitlines(keepends=True)
    copies[0].write_bytes(gzip.compress(b"".join(lines[: ROWS // 2]), 1, mtime=0))
    store = tmp_path / "store"
    with monkeypatch.context() as patch:
        patch.setattr("starcat.catalog.store.ingest.make_manifest", _fail)
        with pytest.raises(BuildError):
            make(copies, store)
    shutil.copy(parts[0], copies[0])
    make(copies, store, resume=True)
    assert bytes_of(store) == whole


@pytest.mark.slow
def test_a_store_is_replaced_only_when_asked(parts, whole, tmp_path):
    store = tmp_path / "store"
    make(parts, store)
    with pytest.raises(OutputError, match="replace=True"):
        make(parts, store)
    assert make(parts, store, replace=True).outcome == "unchanged"
    assert make(parts, store, replace=True, max_partition_rows=2_000).outcome == "replaced"
    assert bytes_of(store) != whole
    (store / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"has files that starcat did not write: notes\.txt"):
        make(parts, store, replace=True)
    assert not list(tmp_path.glob(".*"))


def test_a_cluster_that_is_not_there_is_reported(parts, tmp_path, monkeypatch):
    monkeypatch.setattr("starcat.catalog.store.cluster._CONNECT_S", 0.5)
    with pytest.raises(
        ConfigError, match=r"scheduler is 'tcp://127.0.0.1:9'; no scheduler answers"
    ):
        make(parts, tmp_path / "store", scheduler="tcp://127.0.0.1:9")


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 2 MB, and a function that makes it larger."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(*options: str) -> bool:
        arguments = ["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(folder)]
        return subprocess.run(arguments, capture_output=True, check=False).returncode == 0

    if not mount("size=2m"):
        pytest.skip("needs a small file system, which this user may not mount")
    yield folder, lambda: mount("remount", "size=200m")
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.slow
def test_a_full_disk_is_reported_and_the_run_goes_on_when_there_is_room(parts, whole, small_disk):
    folder, make_room = small_disk
    with pytest.raises(OutputError, match=r"No space left on device.*make space.*resume=True"):
        make(parts, folder / "store")
    assert not (folder / "store").exists()
    assert make_room()
    make(parts, folder / "store", resume=True)
    assert bytes_of(folder / "store") == whole
