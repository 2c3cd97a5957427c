"""Files on disk: the files found, the order of reading, and that damage never passes."""

from __future__ import annotations

import gzip
import hashlib
import random
import struct
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from starcat.catalog.readers import blocks as blocks_module
from starcat.catalog.readers.blocks import Block, DigestReader, read_blocks
from starcat.catalog.source import DataSource, RecordFile, SourceColumn
from starcat.catalog.source_files import InputFile, SourceFiles, lacking
from starcat.errors import ParseError, SourceError, SourceMissing
from starcat.threads import map_in_order

LINES = b"".join(b"%05d\n" % number for number in range(1, 2001))


def text_file(name: str = "tiny", **rest: object) -> RecordFile:
    columns = (SourceColumn(name="n", bytes=(1, 5), format="I5"),)
    keys = {"layout": "fixed_width", "record_bytes": 5, "file_names": (f"{name}.dat",)} | rest
    return RecordFile(name=name, columns=columns, **keys)


def source_of(*layouts: RecordFile) -> DataSource:
    names = ("title", "identifier", "citation", "licence", "urls_retrieved")
    return DataSource(name="tiny", frame="ICRS", files=layouts, **dict.fromkeys(names, "none"))


PARTED = text_file("many", file_names=("many.{part}", "many.dat"), parts=("00", "01", "02"))
SOURCE = source_of(PARTED, text_file("extra", optional=True))

BINARY = RecordFile(
    name="packed", file_names=("packed.bin",), layout="binary", record_bytes=12, header_bytes=8,
    magic="PACK", columns=(
        SourceColumn(name="n", bytes=(1, 4), format="<i4"),
        SourceColumn(name="x", bytes=(5, 12), format="<f8"),
    ),
)  # fmt: skip


def pack(count: int) -> bytes:
    return b"PACK\0\0\0\0" + b"".join(struct.pack("<id", n, n / 7) for n in range(count))


def read(path: Path, layout: RecordFile) -> tuple[list[Block], list[DigestReader]]:
    ends: list[DigestReader] = []
    blocks = list(read_blocks(InputFile(path, layout, "tiny"), ends.append))
    return blocks, ends


def names_found(paths: list[Path], source: DataSource = SOURCE) -> list[tuple[str, str]]:
    return [(file.path.name, file.layout.name) for file in SourceFiles.find(source, paths).files]


@pytest.mark.parametrize("block_bytes", [1, 7, 100, 1 << 22])
@pytest.mark.parametrize("is_gzip", [False, True])
@pytest.mark.parametrize("end", [b"\n", b""])
def test_blocks_are_whole_lines_in_order_plain_or_gzipped(
    tmp_path, monkeypatch, block_bytes, is_gzip, end
):
    monkeypatch.setattr(blocks_module, "BLOCK_BYTES", block_bytes)
    content = LINES[:600].rstrip(b"\n") + end
    # Compression is recognised by the content, not by the name.
    path = tmp_path / ("tiny.dat" if is_gzip else "tiny.dat.gz")
    path.write_bytes(gzip.compress(content) if is_gzip else content)
    blocks, ends = read(path, text_file())
    assert b"".join(block.data for block in blocks) == content
    assert all(block.data.endswith(b"\n") for block in blocks[:-1])
    assert [int(block.data[:5]) for block in blocks] == [block.first_line for block in blocks]
    (digest,) = ends
    assert digest.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert digest.bytes_read == path.stat().st_size


def test_gzip_members_one_after_another_are_one_file(tmp_path):
    path = tmp_path / "tiny.dat.gz"
    path.write_bytes(gzip.compress(LINES[:60]) + gzip.compress(LINES[60:120]))
    blocks, (digest,) = read(path, text_file())
    assert b"".join(block.data for block in blocks) == LINES[:120]
    assert digest.bytes_read == path.stat().st_size


def test_truncated_gzip_names_the_file_and_the_last_line(tmp_path, monkeypatch):
    monkeypatch.setattr(blocks_module, "BLOCK_BYTES", 100)
    noise = random.Random(1)
    content = b"".join(b"%05d\n" % noise.randrange(100_000) for _ in range(10_000))
    path = tmp_path / "tiny.dat.gz"
    compressed = gzip.compress(content)
    path.write_bytes(compressed[: len(compressed) // 2])
    seen, ends = [], []
    with pytest.raises(ParseError, match=r"cut off after line \d+ .*fetch") as caught:
        seen.extend(read_blocks(InputFile(path, text_file(), "tiny"), ends.append))
    assert caught.value.path == path
    assert str(path) in str(caught.value)
    assert caught.value.line == sum(block.data.count(b"\n") for block in seen)
    assert 2_500 < caught.value.line < 7_500
    assert ends == []


def test_no_cut_and_no_changed_byte_gives_other_lines(tmp_path):
    whole = gzip.compress(LINES[:600], mtime=0)
    path = tmp_path / "tiny.dat.gz"
    unseen = 0
    for place in range(10, len(whole)):  # the ten before hold the magic and facts without effect
        changed = bytearray(whole)
        changed[place] ^= 1
        path.write_bytes(whole[:place])
        with pytest.raises(ParseError, match="the compressed data is cut off"):
            read(path, text_file())
        path.write_bytes(bytes(changed))
        try:
            assert b"".join(block.data for block in read(path, text_file())[0]) == LINES[:600]
            unseen += 1
        except ParseError:
            continue
    assert unseen < 3  # a code length of a letter that does not occur


WRONG_SUM = bytearray(gzip.compress(LINES, mtime=0))
WRONG_SUM[-8] ^= 1


@pytest.mark.parametrize(
    ("layout", "content", "message"),
    [
        (text_file(), WRONG_SUM, "damaged"),
        (text_file(), gzip.compress(LINES, mtime=0) + b"rubbish" * 2, "damaged"),
        (text_file(), b"", r"tiny\.dat: the file is empty; expected records of tiny"),
        (text_file(), gzip.compress(b"", mtime=0), r"tiny\.dat: the file is empty"),
        (BINARY, pack(0), "empty"),
        (BINARY, gzip.compress(pack(5), mtime=0)[:12], "cut off"),
    ],
)
def test_damaged_and_empty_files_are_refused(tmp_path, layout, content, message):
    path = tmp_path / "tiny.dat"
    path.write_bytes(content)
    with pytest.raises(ParseError, match=message):
        read(path, layout)


def test_a_file_that_cannot_be_opened(tmp_path):
    with pytest.raises(SourceError, match="cannot be read"):
        read(tmp_path / "missing.dat", text_file())


def put(folder: Path, names: Iterable[str]) -> Path:
    """Put empty files into a folder."""
    for name in names:
        (folder / name).write_bytes(b"")
    return folder


@pytest.mark.parametrize(
    ("present", "expected"),
    [
        (["many.02", "many.00.gz", "many.01"], ["many.00.gz", "many.01", "many.02"]),
        (["many.dat"], ["many.dat"]),
        (["many.dat.gz"], ["many.dat.gz"]),
        (["many.dat", "many.dat.gz"], ["many.dat"]),
        (["many.dat", "extra.dat"], ["many.dat", "extra.dat"]),
        (["many.dat", "many.00", "many.01", "many.02"], ["many.00", "many.01", "many.02"]),
        (["many.dat", "unrelated.txt"], ["many.dat"]),
    ],
)
def test_what_a_folder_gives(tmp_path, present, expected):
    found = names_found([put(tmp_path, present)])
    assert found == [(name, name.split(".")[0]) for name in expected]


TEN_TO_40 = source_of(text_file(file_names=("t.{part}",), parts=tuple(map(str, range(10, 40)))))


@pytest.mark.parametrize(
    ("source", "present", "message"),
    [
        (SOURCE, ["many.00", "many.02"], r"has 2 of 3 parts of many.\{part\}; missing: 01\."),
        (TEN_TO_40, ["t.10"], "missing: 11, 12, 13, 14, 15, 16, 17, 18 …"),
        (SOURCE, [], "starcat fetch tiny"),
        (SOURCE, ["extra.dat"], "starcat fetch tiny"),
        (SOURCE, ["other.dat"], "starcat fetch tiny"),
    ],
)
def test_a_folder_without_a_file_that_is_needed(tmp_path, source, present, message):
    with pytest.raises(SourceMissing, match=message) as caught:
        SourceFiles.find(source, [put(tmp_path, present)])
    assert caught.value.path == tmp_path


@pytest.mark.parametrize(
    ("name", "layout"),
    [
        ("many.01", "many"), ("many.07.gz", "many"), ("extra.dat", "extra"),
        ("extra.dat.gz", "extra"), ("renamed.txt", "many"), ("extraxdat", "many"),
    ],
)  # fmt: skip
def test_layout_of_a_file_by_its_name_or_the_first(tmp_path, name, layout):
    assert names_found([put(tmp_path, [name]) / name]) == [(name, layout)]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["many.00", "many.01.gz", "many.02"], ()),
        (["many.dat"], ()),
        (["many.dat.gz", "many.01"], ()),
        (["many.01", "many.00"], ("many.02",)),
        (["extra.dat.gz"], ("many.00, many.01, many.02",)),
        (["many.03"], None),
        (["many.dat.zip"], None),
        ([], None),
    ],
)
def test_what_a_folder_lacks_of_a_source(tmp_path, names, expected):
    (tmp_path / "folder" / "many.dat").mkdir(parents=True)  # of the name of a file
    assert lacking(SOURCE, tmp_path / "folder") is None
    assert lacking(SOURCE, put(tmp_path, names)) == expected


@pytest.mark.parametrize("workers", [0, 1, 2, 5])
def test_results_come_in_the_order_of_the_items(workers):
    delays = random.Random(7)
    waits = [delays.uniform(0.0, 0.004) for _ in range(60)]

    def slow(item: int) -> int:
        time.sleep(waits[item])
        return item * item

    assert list(map_in_order(slow, iter(range(60)), workers)) == [n * n for n in range(60)]


def test_two_items_are_worked_on_at_once():
    both = threading.Barrier(2, timeout=5.0)
    assert len(list(map_in_order(lambda _: both.wait(), iter(range(4))))) == 4


def test_no_more_than_a_few_items_are_read_ahead():
    taken = []
    items = (taken.append(n) or n for n in range(100))
    results = map_in_order(str, items, workers=2)
    assert [next(results) for _ in range(3)] == ["0", "1", "2"]
    assert len(taken) <= 3 + 2 + 1
    results.close()


def test_a_dropped_generator_may_be_closed_by_its_own_thread():
    box = []
    dropped, closed = threading.Event(), threading.Event()

    def work(item: int) -> int:
        if item == 3:  # as the garbage collector does, in whatever thread it runs
            dropped.wait(5.0)
            box.pop().close()
            closed.set()
        return item

    results = map_in_order(work, iter(range(100)), workers=1)
    box.append(results)
    assert [next(results), next(results)] == [0, 1]
    del results
    dropped.set()
    assert closed.wait(5.0)


@pytest.mark.parametrize("bad", [0, 3, 9])
def test_an_error_in_the_function_reaches_the_caller_in_its_place(bad):
    def fail(item: int) -> int:
        if item == bad:
            raise ZeroDivisionError
        return item

    done = []
    with pytest.raises(ZeroDivisionError):
        done.extend(map_in_order(fail, iter(range(10))))
    assert done == list(range(bad))


def test_an_error_in_the_items_reaches_the_caller():
    def items() -> Iterator[int]:
        yield from (1, 2, 3)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(map_in_order(str, items()))
