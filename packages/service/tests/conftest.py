"""Services that the modules share: their processes take longer to start than to answer a test."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browsing import launched, opened
from fastapi.testclient import TestClient
from served import Served, serve
from services import CATALOG, OTHER, add_database, client_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@pytest.fixture(scope="session", autouse=True)
def _no_spare_processes() -> Iterator[None]:
    """Start no process of queries in advance: most services of tests need one or none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("starcat_service.sandbox.pool.SPARE", 0)
        yield


@pytest.fixture(scope="session")
def shared_root(
    tmp_path_factory: pytest.TempPathFactory,
    small_database: Path,
    database_version: Callable[[str], Path],
) -> Path:
    """The folder of a service with two versions of the small database, and catalogs as tables."""
    root = tmp_path_factory.mktemp("shared") / "service"
    add_database(root, small_database)
    add_database(root, database_version("1.1.0"), OTHER)
    for folder in ("bright", "unfinished"):
        (root / "catalogs" / folder).mkdir(parents=True)
    for name in ("bright/stars.parquet", "faint.parquet", f"{CATALOG}.parquet"):
        shutil.copyfile(small_database / "stars.parquet", root / "catalogs" / name)
    (root / "catalogs" / "other.parquet").touch()
    return root


@pytest.fixture(scope="session")
def shared(shared_root: Path) -> Iterator[TestClient]:
    """A client of that service, in which everybody may publish; it has no workers."""
    limits = {"jobs_waiting": 1_000, "upload_mib": 2.0, "rows_mib": 1.0}
    settings = {"anonymous": "publisher", "requests_per_minute": 1_000_000}
    with client_of(shared_root, **settings, **limits) as opened:
        yield opened


@pytest.fixture(scope="module")
def client(request: pytest.FixtureRequest) -> Iterator[TestClient]:
    """The shared client; in a module that names ``SETTINGS``, one of its own service in `root`."""
    settings = getattr(request.module, "SETTINGS", None)
    if settings is None:
        yield request.getfixturevalue("shared")
        return
    with client_of(request.getfixturevalue("root"), **settings) as opened:
        yield opened


@pytest.fixture
def own_root(tmp_path: Path, small_database: Path) -> Path:
    """The folder of a service that no other test uses, with the small database."""
    add_database(tmp_path / "service", small_database)
    return tmp_path / "service"


@pytest.fixture(scope="session")
def served(
    tmp_path_factory: pytest.TempPathFactory,
    small_database: Path,
    picky_database: Path,
    sao_lines: list[bytes],
) -> Iterator[Served]:
    """A server of two databases in a process of its own, in which everybody may publish."""
    folder = tmp_path_factory.mktemp("served")
    (folder / "catalogs").mkdir()
    (folder / "catalogs" / "sao.dat").write_bytes(b"".join(sao_lines))
    add_database(folder / "root", small_database)
    add_database(folder / "root", picky_database, OTHER)
    patch = pytest.MonkeyPatch()
    patch.setenv("STARCAT_CATALOGS", str(folder / "catalogs"))
    patch.setenv("STARCAT_CACHE", str(folder / "no-cache"))
    with serve(folder / "root", folder / "log", anonymous="publisher") as server:
        patch.undo()
        yield server


@pytest.fixture
def archive(tmp_path: Path, sao_lines: list[bytes], monkeypatch: pytest.MonkeyPatch) -> Path:
    """The first folder of the search for catalogs, with SAO's file."""
    folder = tmp_path / "archive"
    folder.mkdir()
    (folder / "sao.dat").write_bytes(b"".join(sao_lines))
    monkeypatch.setenv("STARCAT_CATALOGS", str(folder))
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "no-cache"))
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A browser; another module may use asyncio, which a browser of the session would forbid."""
    with launched() as browser:
        yield browser


@pytest.fixture(scope="module")
def page(browser: Browser, served: Served) -> Iterator[Page]:
    """The one page in which a module does everything; its console complains of nothing."""
    with opened(browser, served.address) as page:
        page.clicks = 0
        yield page
        assert page.complaints == []
