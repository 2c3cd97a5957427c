"""Fixtures that several test modules share."""

from __future__ import annotations

import atexit
import gc
import json
import os
import shutil
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import settings
from numpy.typing import NDArray

if TYPE_CHECKING:
    from fastapi.testclient import TestClient

    from starcat.catalog.ingest import Ingested
    from starcat.matcher.database import MatcherDatabase

# Test modules are rewritten by each worker of each run where no byte code may be kept.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# The same examples on every machine and in every run: a test fails everywhere or nowhere.
settings.register_profile(
    "starcat", derandomize=True, deadline=None, max_examples=30, database=None
)
settings.load_profile("starcat")
# `make test-all` draws new examples; a failure prints how to draw its example again.
settings.register_profile(
    "new-examples", derandomize=False, deadline=None, max_examples=100, database=None,
    print_blob=True,
)  # fmt: skip


# Tests, benchmarks and tools share modules, which are found by path.
ROOT = Path(__file__).parent
sys.path.insert(0, str(ROOT / "tests" / "builders"))
pytest.register_assert_rewrite("query_conformance")  # it has tests that others inherit
sys.path.extend(str(ROOT / name) for name in ("benchmarks", "tools"))


def real_folder(variable: str, name: str) -> Path:
    """Return a folder of real data, which is not part of the repository.

    An environment variable names it. Without the variable it is searched in ``shared`` beside the
    checkout.
    """
    beside = Path(__file__).resolve().parents[1] / "shared" / name
    return Path(os.environ.get(variable) or beside)


REAL_FIXTURES = {"excerpts", "nights"}
"""Fixtures of real records and real photographs: tests that use one run with `make test-real`."""


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Search for garbage neither during the collection nor among the objects that it makes."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
        # The interpreter destroys the objects at its end, or nanobind reports them as leaks.
        atexit.register(gc.unfreeze)
        atexit.register(gc.disable)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that need data from outside the repository."""
    for item in items:
        if REAL_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.real)


@pytest.fixture(scope="session", autouse=True)
def own_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the state of commands in a folder of the tests, not in the user's own state folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _nothing_is_synchronised() -> Iterator[None]:
    """Leave it to the system when files reach the disk: thousands of small files wait for it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", os.fstat)  # it fails as well if a file is not open
        yield


@pytest.fixture(scope="session", autouse=True)
def _plots() -> Iterator[pytest.MonkeyPatch]:
    """Let builds write empty pictures into a report: drawing takes most of a small build's time."""

    def save_empty(figure: object, folder: Path, name: str) -> None:
        for kind in ("png", "svg"):
            (folder / f"{name}.{kind}").write_text(f"{name}.{kind}: the tests draw none\n")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("starcat.pipeline.report.report.save_plot", save_empty)
        yield patch


@pytest.fixture(scope="module")
def drawn_pictures(_plots: pytest.MonkeyPatch) -> Iterator[None]:
    """Let the builds of a module draw the pictures of their reports."""
    from starcat.pipeline.report.plots import save_plot

    with _plots.context() as patch:
        patch.setattr("starcat.pipeline.report.report.save_plot", save_plot)
        yield


@pytest.fixture(autouse=True)
def no_given_maps() -> Iterator[None]:
    """Forget the maps of tables that a test gives, as a process does when its command ends."""
    from starcat.catalog.source import known_maps

    with known_maps([]):
        yield


def present(request: pytest.FixtureRequest, variable: str, name: str) -> Path:
    """Return a folder of real data, or skip the test if the folder is absent."""
    if "not real" in request.config.option.markexpr:
        pytest.fail("this test uses real data: mark it with pytest.mark.real")
    folder = real_folder(variable, name)
    if not folder.is_dir():
        pytest.skip(
            f"this test needs real data: set {variable} to its folder, or put it at {folder}"
        )
    return folder


@pytest.fixture(scope="session")
def excerpts(request: pytest.FixtureRequest) -> Path:
    """The folder of catalog excerpts with genuine records."""
    return present(request, "STARCAT_CATALOGS", "catalogs")


@pytest.fixture(scope="session")
def nights(request: pytest.FixtureRequest) -> Path:
    """The folder of real photographs."""
    return present(request, "STARCAT_NIGHTS", "nights")


@pytest.fixture(scope="session")
def made_catalogs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the names of the excerpts, of stars that are made up; one for all workers."""
    from catalog_folder import write_catalog_folder

    common = tmp_path_factory.getbasetemp()
    common = common.parent if os.environ.get("PYTEST_XDIST_WORKER") else common
    folder = common / "made-catalogs"
    if not folder.is_dir():
        own = tmp_path_factory.mktemp("catalogs")
        write_catalog_folder(own)
        # If another worker was faster, its files, which are the same, are used.
        with suppress(OSError):
            own.rename(folder)
    return folder


@pytest.fixture(
    scope="session", params=["generated", pytest.param("genuine", marks=pytest.mark.real)]
)
def catalogs(request: pytest.FixtureRequest) -> Path:
    """Archive files: generated ones, and with `make test-real` the genuine excerpts as well."""
    fixtures = {"generated": "made_catalogs", "genuine": "excerpts"}
    return Path(request.getfixturevalue(fixtures[request.param]))


@pytest.fixture(scope="session")
def expected(catalogs: Path, made_catalogs: Path) -> Callable[..., Any]:
    """Choose the expected value for `catalogs`: ``expected(generated=..., genuine=...)``."""
    kind = "generated" if catalogs == made_catalogs else "genuine"
    return lambda **values: values[kind]


@pytest.fixture(scope="session")
def ingested(catalogs: Path) -> Callable[[str, str], Ingested]:
    """Ingest a file of `catalogs` as it is, once for all tests."""
    from starcat.catalog.ingest import ingest_catalog

    return cache(lambda source, name: ingest_catalog(source, [catalogs / name]))


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Have no test read or write the user's cache folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STARCAT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def random_directions() -> Callable[[int, int], NDArray[np.float64]]:
    """Directions uniform over the sphere: of a count and a seed."""

    def draw(count: int, seed: int) -> NDArray[np.float64]:
        v = np.random.default_rng(seed).normal(size=(count, 3))
        return v / np.linalg.norm(v, axis=1)[:, None]

    return draw


@pytest.fixture(scope="session")
def sky_of() -> Callable[..., MatcherDatabase]:
    """Databases in memory with pairs and triangles: of directions and a camera of 20 deg."""
    from skies import triangle_sky

    return triangle_sky


SMALL_SPEC = """\
name = "small"
version = "1.0.0"
epoch_jyear = 2026.0
catalog.source = "sao"
selection.faint_limit_mag = 6.0
camera = { width_px = 512, height_px = 512, fov_x_deg = 40.0 }
boresights.count = 200
self_test = { frames = 5, min_identified = 0.8 }
"""


@pytest.fixture(scope="session")
def sao_lines() -> list[bytes]:
    """600 records in the layout of SAO, of stars that do not exist, V 2.0 to 6.4."""
    from archives import plain_sao

    return plain_sao(600)


@pytest.fixture
def sao_file(tmp_path: Path, sao_lines: list[bytes]) -> Path:
    """A file ``sao.dat`` of `sao_lines`."""
    path = tmp_path / "sao.dat"
    path.write_bytes(b"".join(sao_lines))
    return path


@pytest.fixture(scope="session")
def small_spec() -> str:
    """A spec whose build from `sao_lines` takes a tenth of a second."""
    return SMALL_SPEC


@dataclass(frozen=True)
class Ran:
    """What a run of the command line gave."""

    code: int
    out: str
    err: str


@pytest.fixture
def starcat(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[[Sequence[object]], Ran]]:
    """The command line in this process: arguments in, exit code and output out.

    It finds only the catalogs that a test passes to it.
    """
    from starcat.cli.main import main

    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "no-cache"))
    monkeypatch.delenv("STARCAT_CATALOGS", raising=False)
    before = signal.getsignal(signal.SIGTERM)

    def run(arguments: Sequence[object]) -> Ran:
        monkeypatch.setattr(sys, "argv", ["starcat", *map(str, arguments)])
        capsys.readouterr()
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        captured = capsys.readouterr()
        return Ran(code, captured.out, captured.err)

    yield run
    signal.signal(signal.SIGTERM, before)


@pytest.fixture
def written_words(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The texts that matplotlib is given to write from now on."""
    import matplotlib.text

    written: list[str] = []
    write = matplotlib.text.Text.__init__

    def listen(self, x=0, y=0, text="", **options):
        written.append(text)
        write(self, x, y, text, **options)

    monkeypatch.setattr(matplotlib.text.Text, "__init__", listen)
    return written


@pytest.fixture(scope="session")
def small_database(tmp_path_factory: pytest.TempPathFactory, sao_lines: list[bytes]) -> Path:
    """The database of `small_spec`; a test that changes it makes a copy."""
    from starcat.pipeline.build import build
    from starcat.pipeline.specs.reading import spec_from_dict

    folder = tmp_path_factory.mktemp("small")
    (folder / "sao.dat").write_bytes(b"".join(sao_lines))
    spec = spec_from_dict(tomllib.loads(SMALL_SPEC), "small.toml")
    return build(spec, folder / "dist", inputs={"sao": [folder / "sao.dat"]}).folder


@pytest.fixture(scope="session")
def picky_database(tmp_path_factory: pytest.TempPathFactory, sao_lines: list[bytes]) -> Path:
    """The same without its brightest stars, so that stars are rejected for two reasons."""
    from starcat.pipeline.build import build
    from starcat.pipeline.specs.reading import spec_from_dict

    folder = tmp_path_factory.mktemp("picky")
    (folder / "sao.dat").write_bytes(b"".join(sao_lines))
    spec = tomllib.loads(SMALL_SPEC.replace("faint", "bright_limit_mag = 2.2\nselection.faint"))
    built = build(
        spec_from_dict(spec, "small.toml"), folder / "dist", inputs={"sao": [folder / "sao.dat"]}
    )
    return built.folder


@pytest.fixture(scope="session")
def published(tmp_path_factory: pytest.TempPathFactory, small_database: Path) -> Path:
    """A registry with the release of the small database; to be copied by who uses it."""
    from starcat.ship.releases.publishing import publish

    folder = tmp_path_factory.mktemp("published") / "registry"
    publish(small_database, str(folder))
    return folder


@pytest.fixture
def database_copy(small_database: Path, tmp_path: Path) -> Path:
    """A changeable copy of the small database; `database_copies.seal` updates its digests."""
    from database_copies import copied

    return copied(small_database, tmp_path)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, small_database: Path) -> Path:
    """The folder of a service that has the small database."""
    from services import add_database

    folder = tmp_path_factory.mktemp("service") / "service"
    add_database(folder, small_database)
    return folder


@pytest.fixture(scope="module")
def client(root: Path, request: pytest.FixtureRequest) -> Iterator[TestClient]:
    """A client of that service, with the settings that the module names ``SETTINGS``."""
    from services import client_of

    with client_of(root, **getattr(request.module, "SETTINGS", {})) as opened:
        yield opened


@pytest.fixture(scope="session")
def database_version(
    tmp_path_factory: pytest.TempPathFactory, small_database: Path
) -> Callable[[str], Path]:
    """The small database as another version: a sound database without the time of a build.

    The database, the manifest and the report differ between versions, as in a real build; the
    tables are the same files.
    """
    import h5py
    from database_copies import seal

    folder = tmp_path_factory.mktemp("versions")

    def make(version: str) -> Path:
        database = folder / f"small-{version}"
        if database.exists():
            return database
        shutil.copytree(small_database, database, copy_function=shutil.copyfile)
        spec = json.loads((database / "manifest.json").read_bytes())["spec"] | {"version": version}
        with h5py.File(database / "database.h5", "r+") as file:
            file.attrs["version"] = version
            file.attrs["spec"] = json.dumps(spec, sort_keys=True)
        page = database / "report" / "index.html"
        page.write_bytes(page.read_bytes() + f"<!-- {version} -->".encode())
        seal(database, lambda manifest: manifest.update(version=version, spec=spec))
        return database

    return make
