"""The name ``starcat`` among other projects, and the commands that messages give to install it."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from starcat import version
from starcat.version import OTHER_PROJECTS, install_command

ROOT = Path(__file__).parents[2]
THEIRS = '__version__ = "1.2.0"\n__all__ = ["StarCatalog", "__version__"]\n'


@pytest.fixture
def site(tmp_path):
    """A folder of packages with those modules of starcat that notice files of another project."""
    (tmp_path / "starcat").mkdir()
    for name in ("__init__.py", "__main__.py", "version.py"):
        shutil.copy(ROOT / "starcat" / name, tmp_path / "starcat")
    return tmp_path


def run(site, *arguments):
    return subprocess.run(
        [sys.executable, "-S", *arguments],  # so the starcat of a clone is not found
        env={"PYTHONPATH": str(site)},
        cwd=site,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(("name", "project"), OTHER_PROJECTS.items())
def test_files_of_another_project_are_refused_with_what_to_do(site, name, project):
    """The one that was installed last has replaced ``__init__.py``; the other has its files."""
    assert run(site, "-c", "import starcat").returncode == 0
    (site / "starcat" / name).write_text("")
    ran = run(site, "-c", "import starcat")
    last = ran.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: {site}/starcat has files of the project {project} and of")
    assert f"pip uninstall {project} starcat-guide-stars" in last
    (site / "starcat" / "__init__.py").write_text(THEIRS)  # and here it was theirs
    ran = run(site, "-m", "starcat", "identify", "db", "frame.csv")
    assert (ran.returncode, ran.stdout) == (1, "")
    assert ran.stderr.startswith(f"starcat: error: {site}/starcat has files of the project")
    assert ran.stderr.count("\n") == 1


@pytest.mark.parametrize("text", [THEIRS, None], ids=["of an unknown project", "removed"])
def test_the_command_notices_that_its_package_was_replaced_or_removed(site, text):
    """As after ``pip uninstall rms-starcat``, which takes the common file with it."""
    (site / "starcat" / "__init__.py").unlink()
    if text is not None:
        (site / "starcat" / "__init__.py").write_text(text)
    ran = run(site, "-m", "starcat", "build")
    assert ran.returncode == 1
    assert "__init__.py is missing or of another project" in ran.stderr
    assert "Install starcat-guide-stars again: pip uninstall" in ran.stderr
    assert ran.stderr.count("\n") == 1


def test_in_a_clone_the_clone_is_installed():
    words = shlex.split(install_command("images"))
    assert words == ["pip", "install", "-e", f"{ROOT}[images]"]
    assert shlex.split(install_command()) == ["pip", "install", "-e", str(ROOT)]


@pytest.mark.parametrize(
    ("origin", "source"),
    [
        (None, ""),
        ({"url": "file:///home/a/star%20cat", "dir_info": {}}, " @ file:///home/a/star%20cat"),
        (
            {"url": "https://a.org/s.git", "vcs_info": {"vcs": "git", "commit_id": "1a2b"}},
            " @ git+https://a.org/s.git@1a2b",
        ),
    ],
    ids=["PyPI", "a folder", "a repository"],
)
def test_elsewhere_what_pip_installed_is_installed_again(origin, source, tmp_path, monkeypatch):
    info = tmp_path / "starcat_guide_stars-0.2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: starcat-guide-stars\nVersion: 0\n")
    if origin is not None:
        (info / "direct_url.json").write_text(json.dumps(origin))
    monkeypatch.setattr(metadata, "distribution", lambda name: metadata.PathDistribution(info))
    monkeypatch.setattr(version, "_FOLDER", str(tmp_path / "starcat"))
    words = shlex.split(install_command("images"))
    assert words == ["pip", "install", f"starcat-guide-stars[images]{source}"]
