"""Small files from outside: devices, pipes and files that are too large are refused at once."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from starcat.errors import FileMissing, SourceError
from starcat.storage.regular_files import read_regular_file


def test_a_regular_file_is_read_up_to_its_limit(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"12345")
    assert read_regular_file(path, 5) == b"12345"
    with pytest.raises(SourceError, match="more than 4 bytes"):
        read_regular_file(path, 4)


def test_a_link_to_a_regular_file_is_followed(tmp_path):
    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert read_regular_file(tmp_path / "b", 9) == b"1"


@pytest.mark.timeout(10)
def test_a_pipe_that_nobody_writes_to_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SourceError, match="not a regular file"):
        read_regular_file(tmp_path / "pipe", 9)


def test_what_is_no_regular_file_is_refused(tmp_path):
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "s"))
        for path in (Path("/dev/zero"), Path("/dev/null"), tmp_path, tmp_path / "s"):
            with pytest.raises(SourceError):
                read_regular_file(path, 9)


def test_a_file_of_the_kernel_that_states_no_size_is_limited():
    with pytest.raises(SourceError, match="more than 3 bytes"):
        read_regular_file(Path("/proc/self/status"), 3)


@pytest.mark.parametrize("name", ["", "missing", "a\0b", "x" * 5000])
def test_names_that_lead_nowhere(tmp_path, name):
    with pytest.raises((FileMissing, SourceError)):
        read_regular_file(tmp_path / name, 9)
