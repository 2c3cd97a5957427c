"""Files and folders that are whole at their final name, or not there."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from starcat.errors import OutputError
from starcat.storage import atomic


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def usual_mode(folder: Path) -> int:
    (folder / "usual").write_bytes(b"")
    mode = mode_of(folder / "usual")
    (folder / "usual").unlink()
    return mode


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "new" / "table.csv"
    with atomic.whole_file(path) as partial:
        partial.write_bytes(b"half")
        assert not path.exists()
        assert partial.parent == path.parent
        assert partial.name.startswith(".table.csv.")
        partial.write_bytes(b"whole")
    assert path.read_bytes() == b"whole"
    assert names_in(path.parent) == ["table.csv"]
    assert mode_of(path) == usual_mode(tmp_path)


def test_a_file_that_fails_leaves_the_one_before(tmp_path):
    path = tmp_path / "table.csv"
    path.write_bytes(b"before")

    def fail() -> None:
        with atomic.whole_file(path) as partial:
            partial.write_bytes(b"half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert path.read_bytes() == b"before"
    assert names_in(tmp_path) == ["table.csv"]


def test_two_writers_of_one_process_do_not_share_a_file(tmp_path):
    path = tmp_path / "table.csv"
    with atomic.whole_file(path) as one, atomic.whole_file(path) as other:
        assert one != other
        one.write_bytes(b"one")
        other.write_bytes(b"other")
    assert path.read_bytes() == b"one"
    assert names_in(tmp_path) == ["table.csv"]


def test_a_file_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="choose another output"):
        atomic.whole_file(tmp_path / "file" / "table.csv").__enter__()
    with pytest.raises(OutputError, match=r"table.csv: cannot be written \(Not a directory\)$"):
        atomic.write_file(tmp_path / "file" / "table.csv", b"")


def test_a_small_file_that_fails_leaves_the_one_before(tmp_path, monkeypatch):
    path = tmp_path / "picture.png"
    atomic.write_file(path, b"before")

    def fail(self: Path, _: bytes) -> None:
        self.touch()
        raise OSError(28, "full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OutputError, match=r"picture.png: cannot be written \(No space left on"):
        atomic.write_file(path, b"after")
    assert path.read_bytes() == b"before"
    assert names_in(tmp_path) == ["picture.png"]


def test_a_pipe_is_written_itself(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with atomic.placed(tmp_path / "pipe") as path:
        assert path == tmp_path / "pipe"
    assert names_in(tmp_path) == ["pipe"]


def test_replaced_for_good(tmp_path, monkeypatch):
    done: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: done.append(os.fstat(descriptor).st_mode))
    (tmp_path / "beside").mkdir()
    path = tmp_path / "index.json"
    path.write_bytes(b"before")
    atomic.replace_file(path, b"after", tmp_path / "beside")
    assert path.read_bytes() == b"after"
    assert names_in(tmp_path / "beside") == []
    # The content first, then the name.
    assert [stat.S_ISDIR(mode) for mode in done] == [False, True]


def test_a_folder_appears_when_it_is_whole_and_cannot_be_changed(tmp_path):
    final = tmp_path / "dist" / "small-1.0.0"
    with atomic.whole_folder(final) as partial:
        (partial / "report").mkdir()
        (partial / "report" / "index.html").write_text("page")
        (partial / "stars.parquet").write_text("stars")
        assert not final.exists()
        assert atomic.move_into_place(partial, final) == "written"
    assert names_in(tmp_path / "dist") == ["small-1.0.0"]
    files = [path for path in final.rglob("*") if path.is_file()]
    assert [mode_of(path) for path in files] == [0o444, 0o444]
    assert mode_of(final) == 0o755


def test_an_error_of_an_unfinished_folder_names_the_final_one(tmp_path):
    final = tmp_path / "tables"
    with (
        pytest.raises(OutputError) as caught,
        atomic.whole_folder(final) as partial,
        atomic.whole_file(partial / "more" / "stars.csv"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert str(caught.value) == (
        f"{final}: more/stars.csv: cannot be written (No space left on device); "
        "choose another output"
    )
    assert caught.value.path == final
    assert names_in(tmp_path) == []


def filled(folder: Path, **files: str) -> Path:
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("new", "replace", "outcome"),
    [
        ({"a": "1", "b": "2"}, False, "unchanged"),
        ({"a": "1", "b": "2"}, True, "unchanged"),
        ({"a": "1"}, False, "unchanged"),
        ({"a": "3", "b": "2"}, False, "refused"),
        ({"a": "3", "b": "2"}, True, "replaced"),
        ({"a": "1", "c": "2"}, True, "replaced"),
    ],
)
def test_a_folder_in_place_of_another(new, replace, outcome, tmp_path):
    final, made = tmp_path / "small", filled(tmp_path / "new", **new)
    atomic.move_into_place(filled(tmp_path / "old", a="1", b="2"), final)
    listed = (lambda _: {"a", "b"}) if replace else None
    if outcome == "refused":
        with pytest.raises(OutputError, match="already exists and differs"):
            atomic.move_into_place(made, final, listed)
    else:
        assert atomic.move_into_place(made, final, listed) == outcome
    kept = {path.name: path.read_text() for path in final.iterdir()}
    assert kept == (new if outcome == "replaced" else {"a": "1", "b": "2"})
    assert outcome != "replaced" or names_in(tmp_path) == ["small"]


def test_what_the_system_refuses_becomes_an_output_error(tmp_path):
    with (
        pytest.raises(OutputError, match=r"space left on device\); try later"),
        atomic.writing(tmp_path, "try later"),
    ):
        raise OSError(28, "wrapped")
    with pytest.raises(ConnectionResetError), atomic.writing(tmp_path, "try later"):
        raise ConnectionResetError(104, "reset")


def test_folders_above_are_made_and_synchronised(tmp_path, monkeypatch):
    seen: list[Path] = []
    monkeypatch.setattr("starcat.storage.atomic.sync_to_disk", seen.append)
    atomic.make_folder(tmp_path / "a" / "b")
    atomic.make_folder(tmp_path / "a" / "b")
    assert seen == [tmp_path, tmp_path / "a"]


def test_nothing_is_synchronised_where_the_system_cannot(tmp_path, monkeypatch):
    def refuse(*_: Any) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(PermissionError):
        atomic.sync_to_disk(tmp_path)
    monkeypatch.setattr(os, "name", "nt")
    atomic.sync_to_disk(tmp_path)


def test_what_a_killed_process_left_is_removed_and_what_a_living_one_writes_is_kept(tmp_path):
    final = tmp_path / "dist" / "cube-1.0.0"
    abandoned = final.parent / ".cube-1.0.0.dead.partial"
    aside = final.parent / ".cube-1.0.0.dead.partial.old.partial"
    other = final.parent / ".cube-1.0.0-b.dead.partial"
    for path in (abandoned, aside, other, final):
        path.mkdir(parents=True)
    (final / "stars").write_text("new")
    with atomic.whole_folder(final) as first, atomic.whole_folder(final) as second:
        assert first.is_dir()
        assert second.is_dir()
        assert not abandoned.exists()
    assert sorted(final.parent.iterdir()) == [other, final]
    assert not aside.exists()


def test_a_folder_that_was_put_aside_gets_its_name_back(tmp_path):
    final = tmp_path / "cube-1.0.0"
    filled(tmp_path / ".cube-1.0.0.dead.old.partial", stars="old")
    with atomic.whole_folder(final):
        assert (final / "stars").read_text() == "old"
    assert names_in(tmp_path) == ["cube-1.0.0"]


def link_to_nothing(final: Path) -> None:
    final.symlink_to("nowhere")


def link_to_folder(final: Path) -> None:
    final.symlink_to(filled(final.with_name("behind"), mine="1"))


def foreign_file(final: Path) -> None:
    final.write_text("mine")


def foreign_folder(final: Path) -> None:
    filled(final, mine="1", a="2")


def foreign_files_below(final: Path) -> None:
    filled(filled(final, a="1") / "deep", **{f"mine{k}": "1" for k in range(5)})


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (link_to_nothing, "is a symbolic link to nowhere; expected a folder or nothing"),
        (link_to_folder, "is a symbolic link to .*behind; expected a folder or nothing"),
        (foreign_file, "is a file; expected a folder or nothing"),
        (foreign_folder, "has files that starcat did not write: mine. Nothing was replaced"),
        (foreign_files_below, "write: deep/mine0, deep/mine1, deep/mine2 and 2 more. Nothing was"),
    ],
)
def test_what_starcat_did_not_write_is_never_replaced(make, words, tmp_path):
    final, made = tmp_path / "small", filled(tmp_path / "new", a="3")
    make(final)
    before = {path: path.lstat().st_ino for path in tmp_path.rglob("*")}
    for call in (
        lambda: atomic.check_final(final, lambda _: {"a"}),
        lambda: atomic.move_into_place(made, final, lambda _: {"a"}),
    ):
        with pytest.raises(OutputError, match=words):
            call()
    assert {path: path.lstat().st_ino for path in tmp_path.rglob("*")} == before


def test_an_empty_folder_is_free(tmp_path):
    (tmp_path / "small").mkdir()
    made = filled(tmp_path / "new", a="1")
    assert atomic.move_into_place(made, tmp_path / "small") == "written"


def test_folders_and_the_name_are_synchronised(tmp_path, monkeypatch):
    synchronised: list[Path] = []
    monkeypatch.setattr("starcat.storage.atomic.sync_to_disk", synchronised.append)
    for text in ("1", "2"):
        synchronised.clear()
        made = filled(tmp_path / "new", a=text)
        filled(made / "report", page=text)
        atomic.move_into_place(made, tmp_path / "small", lambda _: {"a", "report/page"})
        inside = [made / "report/page", made / "report", made / "a", made]
        assert synchronised == [*inside, tmp_path]


REPLACE = """
import os, signal, sys
from pathlib import Path
from starcat.storage import atomic

final, exchanges = Path(sys.argv[1]), sys.argv[2] == "True"
if not exchanges:
    atomic.exchange_names = lambda one, other: False

def replace():
    with atomic.whole_folder(final) as made:
        (made / "report").mkdir()
        for name in ("a", "b", "report/c"):
            (made / name).write_text("new")
        atomic.move_into_place(made, final, lambda folder: ["a", "b", "report/c"])

def restore():
    with atomic.whole_folder(final) as made:
        pass

def reset():
    import shutil
    shutil.rmtree(final.parent, ignore_errors=True)
    (final / "report").mkdir(parents=True)
    for name in ("a", "b", "report/c"):
        (final / name).write_text("old")

def texts():
    return {path.read_text() for path in final.rglob("*") if path.is_file()}

def child(step):
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    steps = 0
    def hook(event, _):
        nonlocal steps
        if event.partition(".")[0] in ("open", "os", "shutil", "fcntl", "ctypes"):
            steps += 1
            if steps == step and event != "os.kill":
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hook)
    replace()
    os._exit(0)

step, killed = 0, 0
while True:
    step += 1
    reset()
    code = child(step)
    there = texts()
    assert there in ({"old"}, {"new"}) or (not exchanges and not there), (step, there)
    if code == 0:
        break
    assert code == -signal.SIGKILL, code
    restore()
    assert texts() in ({"old"}, {"new"}), step
    assert [path.name for path in final.parent.iterdir()] == [final.name], step
print(step)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="names are exchanged on Linux only")
@pytest.mark.parametrize("exchanges", [True, False])
def test_a_kill_at_any_step_of_replacing_leaves_one_of_the_two(tmp_path, exchanges):
    arguments = [str(tmp_path / "dist" / "small"), str(exchanges)]
    ran = subprocess.run(
        [sys.executable, "-c", REPLACE, *arguments], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    assert int(ran.stdout) > 40


def test_a_folder_that_was_made_for_nothing_is_removed(tmp_path):
    with pytest.raises(ValueError, match="stop"), atomic.whole_folder(tmp_path / "new" / "a"):
        raise ValueError("stop")
    assert not (tmp_path / "new").exists()
