"""Files of earlier versions: every later version opens what they wrote.

`compatibility/version_0_2.tar.xz` has a registry with the release of a database, the database's
image for flight software, and a frame, all written by version 0.2.0 from made-up stars.
"""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from frames import needs_c

ARCHIVES = sorted((Path(__file__).parents[1] / "compatibility").glob("*.tar.xz"))
BORESIGHT_DEG = (118.2333, -54.9888)


@pytest.fixture(params=ARCHIVES, ids=lambda path: path.name.partition(".")[0])
def old(request, tmp_path, monkeypatch):
    """The unpacked files of one earlier version, in the working folder."""
    monkeypatch.chdir(tmp_path)  # pull writes its lock file there
    with tarfile.open(request.param) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


def test_there_are_files_of_an_earlier_version():
    assert ARCHIVES


def test_an_old_release_is_pulled_checked_and_identifies_a_frame(starcat, old):
    run = starcat(["pull", "tiny@1.0.0", "--registry", old / "registry", "-o", old / "got"])
    assert run.code == 0, run.err
    assert starcat(["verify", old / "got" / "tiny-1.0.0"]).code == 0
    run = starcat(["identify", old / "got" / "tiny-1.0.0", old / "frame.csv", "--json"])
    [found] = json.loads(run.out)
    assert found["status"] == "identified"
    boresight = (found["boresight_ra_deg"], found["boresight_dec_deg"])
    assert np.allclose(boresight, BORESIGHT_DEG, atol=0.02)
    manifest = json.loads((old / "got" / "tiny-1.0.0" / "manifest.json").read_text())
    run = starcat(["sql", old / "got" / "tiny-1.0.0", "SELECT count(*) AS n FROM stars", "--json"])
    assert json.loads(run.out) == [{"n": manifest["products"]["stars"]["rows"]}]


def test_an_old_image_is_checked(starcat, old):
    assert starcat(["verify", old / "tiny-1.0.0.img"]).code == 0


@needs_c
def test_an_old_image_identifies_a_frame(starcat, old):
    run = starcat(["identify", old / "tiny-1.0.0.img", old / "frame.csv", "--json"])
    assert json.loads(run.out)[0]["status"] == "identified"
