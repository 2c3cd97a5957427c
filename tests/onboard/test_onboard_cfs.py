"""The app for cFS in ``onboard/integrations/cfs`` and its ICD.

The app is built and run if an archive of cFS is there, the component if fpp is there.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.onboard.test_onboard_c import make

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "onboard" / "integrations" / "cfs"
CFS = Path(os.environ.get("STARCAT_CFS", ROOT / "../shared/flight/cfs.tar.xz"))
needs_cfs = pytest.mark.real  # the source of cFS is not part of the repository


def icd_of(folder: Path) -> ModuleType:
    """Import the script that writes the ICD, which is in no package."""
    spec = importlib.util.spec_from_file_location("starcat_icd", folder / "test" / "icd.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["starcat_icd"] = module
    spec.loader.exec_module(module)
    return module


def test_the_icd_is_what_the_headers_say():
    icd = icd_of(FOLDER)
    assert (FOLDER / "starcat.xml").read_text() == icd.render(icd.read_headers())


def test_the_readme_lists_every_event_command_and_message():
    said = (FOLDER / "README.md").read_text()
    events = (FOLDER / "fsw/inc/starcat_app_eventids.h").read_text()
    codes = (FOLDER / "config/default_starcat_app_fcncodes.h").read_text()
    topics = (FOLDER / "config/default_starcat_app_topicids.h").read_text()
    for pattern, text in (
        (r"STARCAT_APP_(\w+)_EID +(\d+)", events),
        (r"STARCAT_APP_(\w+)_CC +(\d+)", codes),
    ):
        for name, number in re.findall(pattern, text):
            assert f"| {number} | `{name}` |" in said
    for name, number in re.findall(r"STARCAT_APP_(\w+)_TOPICID +0x(\w+)", topics):
        base = "08" if name.endswith("TLM") else "18"
        assert f"| `{name}` | 0x{base}{number} |" in said


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    copy = tmp_path_factory.mktemp("flight") / "onboard"
    shutil.copytree(ROOT / "onboard", copy, ignore=shutil.ignore_patterns("build", "target"))
    return copy


@needs_cfs
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_thousand_frames_over_the_bus_are_right(folder):
    said = make(folder, "cfs", f"CFS={CFS.resolve()}")
    assert "cfs: all is right" in said
    assert re.search(r"frames +1000 of 1000", said)
    assert re.search(r"wrong +0\n", said)
    assert re.search(r"warnings of the build +0\n", said)


@needs_cfs
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_unit_tests_execute_every_line(folder):
    said = make(folder, "cfs-coverage", f"CFS={CFS.resolve()}")
    covered, lines = re.search(r"(\d+) of (\d+) lines of the app", said).groups()
    assert covered == lines
