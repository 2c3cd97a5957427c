"""Released schemas never change: ``schemas/RELEASED.sha256`` lists every one."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from release_schemas import LIST_NAME, SCHEMAS, broken, digests, release, released


@pytest.fixture
def schemas(tmp_path: Path) -> Path:
    folder = tmp_path / "schemas"
    folder.mkdir()
    for name in ("stars-1.0.0.json", "pairs-1.0.0.json"):
        shutil.copy(SCHEMAS / name, folder)
    release(folder)
    return folder


def test_no_released_schema_changed_or_went():
    assert broken(SCHEMAS) == []


def test_every_schema_is_released():
    assert list(digests(SCHEMAS).keys() - released(SCHEMAS).keys()) == [], "run 'make release'"


def test_the_list_is_one_that_sha256sum_checks(schemas: Path):
    if shutil.which("sha256sum") is None:
        pytest.skip("no sha256sum")
    subprocess.run(["sha256sum", "--check", "--strict", LIST_NAME], cwd=schemas, check=True)


def test_a_new_schema_is_appended(schemas: Path):
    before = (schemas / LIST_NAME).read_text()
    shutil.copy(schemas / "stars-1.0.0.json", schemas / "stars-1.1.0.json")
    assert release(schemas) == ["stars-1.1.0.json"]
    after = (schemas / LIST_NAME).read_text()
    assert after.startswith(before)
    assert len(after.splitlines()) == 3
    assert release(schemas) == []
    assert (schemas / LIST_NAME).read_text() == after


@pytest.mark.parametrize("damage", ["changed", "missing"])
def test_a_released_schema_is_not_released_again(damage: str, schemas: Path):
    before = (schemas / LIST_NAME).read_text()
    path = schemas / "pairs-1.0.0.json"
    if damage == "changed":
        path.write_text(path.read_text().replace("rad", "deg"))
    else:
        path.unlink()
    shutil.copy(schemas / "stars-1.0.0.json", schemas / "stars-1.1.0.json")
    assert [problem.split()[0] for problem in broken(schemas)] == ["pairs-1.0.0.json"]
    with pytest.raises(ValueError, match=f"pairs-1.0.0.json is released and {damage}"):
        release(schemas)
    assert (schemas / LIST_NAME).read_text() == before
