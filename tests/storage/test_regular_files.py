"""Small files from outside: devices, pipes and files that are too large are refused at once."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from starcat.catalog.bands.response import read_response
from starcat.catalog.readers.blocks import open_input
from starcat.catalog.source import read_source
from starcat.database.manifest import read_manifest
from starcat.database.onboard.reading import read_onboard_image
from starcat.errors import FileMissing, SourceError, StarcatError
from starcat.frames.images.image_file import read_image as read_picture
from starcat.matcher.centroids import read_centroid_files
from starcat.pipeline.specs.camera_file import read_camera
from starcat.pipeline.specs.reading import read_spec
from starcat.ship.releases.lockfile import read_pins
from starcat.storage.keys import is_public_key
from starcat.storage.regular_files import read_regular_file


def test_a_regular_file_is_read_up_to_its_limit(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"12345")
    assert read_regular_file(path, 5) == b"12345"
    with pytest.raises(SourceError, match="more than 4 bytes"):
        read_regular_file(path, 4)
    assert read_regular_file(path, 1 << 60) == b"12345"  # takes no memory for the limit
    with pytest.raises(SourceError, match="more than 3 bytes"):
        read_regular_file(Path("/proc/self/status"), 3)  # which states no size
    (tmp_path / "link").symlink_to(path)
    assert read_regular_file(tmp_path / "link", 9) == b"12345"


READERS: tuple[Callable[[Path], object], ...] = (
    *(read_spec, read_camera, read_source, read_centroid_files, read_onboard_image, read_picture),
    *(read_pins, open_input, is_public_key, lambda path: read_response(path, "photon")),
    lambda path: read_manifest(path.parent),
)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
@pytest.mark.parametrize("number", range(len(READERS)))
def test_no_reader_waits_for_a_pipe_or_reads_a_device(tmp_path, number, make):
    path = tmp_path / "manifest.json"
    make(path)
    with pytest.raises(StarcatError, match="not a regular file"):
        READERS[number](path)


def test_a_path_that_is_not_a_regular_file_is_refused(tmp_path):
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "s"))
        for path in (Path("/dev/zero"), Path("/dev/null"), tmp_path, tmp_path / "s"):
            with pytest.raises(SourceError):
                read_regular_file(path, 9)


@pytest.mark.parametrize("name", ["", "missing", "a\0b", "x" * 5000])
def test_names_that_lead_nowhere(tmp_path, name):
    with pytest.raises((FileMissing, SourceError)):
        read_regular_file(tmp_path / name, 9)
